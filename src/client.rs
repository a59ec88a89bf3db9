//! 7 · A client of the service: jobs sent, followed and fetched.
//!
//! Invariant: a request that is repeated is one that may be. A job is sent under a key, so however often the connection or the
//! service fails, there is one job; a log is what the service says it is, by its SHA-256, or there is none.

use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use sha2::{Digest, Sha256};
use thiserror::Error;
use ureq::Agent;
use ureq::http::Response;
use uuid::Uuid;

/// A wait is looked after this often: whether it was stopped.
const LOOK: Duration = Duration::from_millis(50);
/// Pauses between looks at a job, and after a connection that failed: from the first to the last.
const PAUSES: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(2)];
/// A server that says nothing for this long, in the middle of an answer, is gone. Events come more often.
const SILENCE: Duration = Duration::from_secs(60);
/// Largest answer that is not a log, in bytes.
const MOST_BYTES: u64 = 64 << 20;
/// Jobs on a page of a list.
const PAGE: u64 = 100;

/// Reason why a request has no answer, or another than was hoped for.
#[derive(Debug, Error)]
pub enum ClientError {
    /// The address cannot be one of a service.
    #[error("{url:?} is not the address of a service: http://HOST:PORT or https://HOST is needed")]
    Address {
        /// The address.
        url: String,
    },
    /// The service refuses, by a problem of RFC 9457.
    #[error("{}{detail} ({code}, HTTP status {status})", if pointer.is_empty() { String::new() } else { format!("{pointer}: ") })]
    Problem {
        /// The HTTP status.
        status: u16,
        /// The code to match on.
        code: String,
        /// Description, for a person.
        detail: String,
        /// JSON pointer of the field at fault; empty if it is none.
        pointer: String,
        /// The whole answer.
        problem: Box<Value>,
    },
    /// The service does not answer, although it was tried for some time.
    #[error("{url} does not answer: {source}")]
    Unreachable {
        /// The address.
        url: String,
        /// The last failure.
        source: Box<ureq::Error>,
    },
    /// An answer is not what a service of vpd says.
    #[error("{url} does not answer as a service of vpd does: {what}")]
    Strange {
        /// The address.
        url: String,
        /// What is strange.
        what: String,
    },
    /// A file cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The caller stopped it.
    #[error(
        "interrupted; what the service has taken goes on there: `vpd jobs` shows it, and `vpd fetch` brings its log"
    )]
    Stopped,
}

/// A service, as its clients see it.
#[derive(Clone, Debug)]
pub struct Client {
    base: String,
    token: Option<String>,
    agent: Agent,
    patience: Duration,
    tell: fn(&ClientError),
}

/// A client that a stop ends, in the middle of a wait or of a download.
pub type Stop = AtomicBool;

impl Client {
    /// Returns a client of the service at `url`, which is not asked yet. A service that does not answer, or asks for a pause, is
    /// tried again until `patience` is over.
    ///
    /// # Errors
    /// If it is no address of HTTP.
    pub fn new(url: &str, token: Option<String>, patience: Duration) -> Result<Self, ClientError> {
        let base = url.trim_end_matches('/').to_owned();
        let host = base.strip_prefix("http://").or_else(|| base.strip_prefix("https://"));
        if host.is_none_or(|host| host.is_empty() || host.contains(char::is_whitespace)) {
            return Err(ClientError::Address { url: url.to_owned() });
        }
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_connect(Some(Duration::from_secs(10)))
            .timeout_recv_response(Some(SILENCE))
            .timeout_per_read(Some(SILENCE))
            .user_agent(concat!("vpd/", env!("CARGO_PKG_VERSION")))
            .build();
        Ok(Self { base, token, agent: config.new_agent(), patience, tell: |_| () })
    }

    /// Has the reason told for which a request is tried again, the first time.
    #[must_use]
    pub fn telling(self, tell: fn(&ClientError)) -> Self {
        Self { tell, ..self }
    }

    /// Sends a scenario as a job; returns the job as the service took it. The same `key` gives the same job; without one, the
    /// job has a key of its own.
    ///
    /// # Errors
    /// If the service refuses the scenario, or does not answer.
    pub fn submit(
        &self,
        scenario: &[u8],
        key: Option<&str>,
        stop: &Stop,
    ) -> Result<Value, ClientError> {
        let key = key.map_or_else(|| Uuid::new_v4().to_string(), str::to_owned);
        let send = || {
            let request = self.agent.post(format!("{}/jobs", self.base));
            let request = request.header("content-type", "application/json");
            self.with_token(request.header("idempotency-key", &key)).send(scenario)
        };
        self.json(self.answer(send, stop)?)
    }

    /// Returns a job.
    ///
    /// # Errors
    /// If there is none of this number, or the service does not answer.
    pub fn job(&self, id: &str, stop: &Stop) -> Result<Value, ClientError> {
        self.get(&format!("/jobs/{}", escaped(id)), stop)
    }

    /// Returns the newest jobs, at most `limit`, of a state and with a text in their names, where these are given.
    ///
    /// # Errors
    /// If the service refuses one of these, or does not answer.
    pub fn jobs(
        &self,
        state: Option<&str>,
        name: Option<&str>,
        limit: u64,
        stop: &Stop,
    ) -> Result<Vec<Value>, ClientError> {
        let mut jobs = Vec::new();
        let mut cursor = None;
        while (jobs.len() as u64) < limit {
            let left = (limit - jobs.len() as u64).min(PAGE);
            let mut path = format!("/jobs?limit={left}");
            for (field, value) in [("state", state), ("name", name), ("cursor", cursor.as_deref())]
            {
                if let Some(value) = value {
                    path += &format!("&{field}={}", escaped(value));
                }
            }
            let mut page = self.get(&path, stop)?;
            let Some(Value::Array(found)) = page.get_mut("jobs").map(Value::take) else {
                return Err(self.strange("a list of jobs without jobs"));
            };
            jobs.extend(found);
            cursor = page["next_cursor"].as_str().map(str::to_owned);
            if cursor.is_none() {
                break;
            }
        }
        Ok(jobs)
    }

    /// Stops a job; returns it.
    ///
    /// # Errors
    /// If there is none that could be stopped, or the service does not answer.
    pub fn cancel(&self, id: &str, stop: &Stop) -> Result<Value, ClientError> {
        let url = format!("{}/jobs/{}/cancel", self.base, escaped(id));
        self.json(self.answer(|| self.with_token(self.agent.post(&url)).send_empty(), stop)?)
    }

    /// Waits for the end of a job; returns it. `seen` gets the job each time that it was looked at.
    ///
    /// # Errors
    /// If there is none, or the service does not answer.
    pub fn wait(
        &self,
        id: &str,
        mut seen: impl FnMut(&Value),
        stop: &Stop,
    ) -> Result<Value, ClientError> {
        let [mut pause, longest] = PAUSES;
        loop {
            let job = self.job(id, stop)?;
            seen(&job);
            if has_ended(&job) {
                return Ok(job);
            }
            slept(pause, stop)?;
            pause = (pause * 2).min(longest);
        }
    }

    /// Gives the events of a job to `seen`, each with its name, until the job has ended or `seen` says that it is enough. After a
    /// connection that broke, they begin again with the state of the job.
    ///
    /// # Errors
    /// If there is no such job, or the service does not answer.
    pub fn events(
        &self,
        id: &str,
        mut seen: impl FnMut(&str, Value) -> bool,
        stop: &Stop,
    ) -> Result<(), ClientError> {
        let url = format!("{}/jobs/{}/events", self.base, escaped(id));
        loop {
            let get = || self.with_token(self.agent.get(&url)).call();
            let answer = self.answer(get, stop)?;
            let (mut name, mut ended) = (String::new(), false);
            for line in BufReader::new(answer.into_body().into_reader()).lines() {
                if stop.load(Ordering::Relaxed) {
                    return Err(ClientError::Stopped);
                }
                // A connection that breaks is opened again.
                let Ok(line) = line else { break };
                if let Some(event) = line.strip_prefix("event:") {
                    name = event.trim().to_owned();
                } else if let Some(data) = line.strip_prefix("data:") {
                    let data = serde_json::from_slice(data.trim().as_bytes()).unwrap_or_default();
                    ended |= has_ended(&data);
                    if !seen(&name, data) {
                        return Ok(());
                    }
                }
            }
            // Opened again, a stream begins with the state of the job, also of one that has ended meanwhile.
            if ended {
                return Ok(());
            }
            slept(PAUSES[0], stop)?;
        }
    }

    /// Fetches the log of a job that has ended, and compares its checksum with that of the service. A connection that breaks
    /// goes on where it was; `seen` gets the bytes so far and those of the whole.
    ///
    /// # Errors
    /// If there is no such log, the service does not answer, or the file cannot be written: nothing is left then.
    pub fn fetch(
        &self,
        id: &str,
        to: &Path,
        mut seen: impl FnMut(u64, u64),
        stop: &Stop,
    ) -> Result<(), ClientError> {
        let failed = |source| ClientError::Write { path: to.to_owned(), source };
        let folder = to.parent().filter(|folder| !folder.as_os_str().is_empty());
        let mut builder = tempfile::Builder::new();
        builder.prefix(".vpd-");
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let mut file = builder.tempfile_in(folder.unwrap_or(Path::new("."))).map_err(failed)?;
        let url = format!("{}/jobs/{}/log.mcap", self.base, escaped(id));
        let (mut have, mut sum) = (0_u64, Sha256::new());
        let mut block = vec![0; 1 << 16];
        let mut deadline = Instant::now() + self.patience;
        loop {
            let get = || {
                let request = self.with_token(self.agent.get(&url));
                request.header("range", format!("bytes={have}-")).call()
            };
            let answer = self.answer(get, stop)?;
            if answer.status() != 206 && have > 0 {
                return Err(self.strange("no range of the log is given"));
            }
            let of_answer = header(&answer, "content-length").and_then(|text| text.parse().ok());
            let whole = have + of_answer.unwrap_or(0_u64);
            let mut body = answer.into_body().into_reader();
            let broken = loop {
                if stop.load(Ordering::Relaxed) {
                    return Err(ClientError::Stopped);
                }
                match body.read(&mut block) {
                    Ok(0) => {
                        break (have < whole)
                            .then(|| io::Error::from(io::ErrorKind::UnexpectedEof));
                    }
                    Ok(count) => {
                        file.write_all(&block[..count]).map_err(failed)?;
                        sum.update(&block[..count]);
                        have += count as u64;
                        deadline = Instant::now() + self.patience;
                        seen(have, whole);
                    }
                    Err(error) => break Some(error),
                }
            };
            let Some(source) = broken else { break };
            if Instant::now() > deadline {
                let source = Box::new(ureq::Error::Io(source));
                return Err(ClientError::Unreachable { url, source });
            }
            slept(PAUSES[0], stop)?;
        }
        let told = self.job(id, stop)?;
        let found: String = sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        if told["log"]["sha256"].as_str().is_some_and(|sha256| sha256 != found) {
            return Err(self.strange("the log has another checksum than the job says"));
        }
        file.as_file().sync_all().map_err(failed)?;
        file.persist(to).map_err(|error| failed(error.error))?;
        // The name is on the disk with its folder.
        let _ = File::open(folder.unwrap_or(Path::new("."))).and_then(|folder| folder.sync_all());
        Ok(())
    }

    fn with_token<B>(&self, request: ureq::RequestBuilder<B>) -> ureq::RequestBuilder<B> {
        match &self.token {
            Some(token) => request.header("authorization", format!("Bearer {token}")),
            None => request,
        }
    }

    fn get(&self, path: &str, stop: &Stop) -> Result<Value, ClientError> {
        let url = format!("{}{path}", self.base);
        self.json(self.answer(|| self.with_token(self.agent.get(&url)).call(), stop)?)
    }

    fn json(&self, mut answer: Response<ureq::Body>) -> Result<Value, ClientError> {
        let limited = answer.body_mut().with_config().limit(MOST_BYTES);
        let text = limited.read_to_vec().map_err(|error| self.strange(&error.to_string()))?;
        serde_json::from_slice(&text).map_err(|error| self.strange(&error.to_string()))
    }

    fn strange(&self, what: &str) -> ClientError {
        ClientError::Strange { url: self.base.clone(), what: what.to_owned() }
    }

    /// Returns the answer to a request that may be repeated: after a connection that failed, and where the service asks for it.
    fn answer(
        &self,
        send: impl Fn() -> Result<Response<ureq::Body>, ureq::Error>,
        stop: &Stop,
    ) -> Result<Response<ureq::Body>, ClientError> {
        let deadline = Instant::now() + self.patience;
        let [mut pause, longest] = PAUSES;
        let mut told = false;
        loop {
            let (wait, error) = match send() {
                Ok(answer) if answer.status().as_u16() < 400 => return Ok(answer),
                Ok(mut answer) => {
                    let after = header(&answer, "retry-after").and_then(|text| text.parse().ok());
                    let status = answer.status().as_u16();
                    let text = answer.body_mut().with_config().limit(MOST_BYTES).read_to_vec();
                    let problem: Value =
                        serde_json::from_slice(&text.unwrap_or_default()).unwrap_or_default();
                    let word = |key: &str| problem[key].as_str().unwrap_or_default().to_owned();
                    let (code, detail, pointer) = (word("code"), word("detail"), word("pointer"));
                    // A log that is not finished is not worth the wait here.
                    let again = match status {
                        429 | 503 | 507 => after,
                        // The first of two requests under one key is still looked at.
                        409 if code == "key_busy" => after,
                        502 | 504 => Some(1),
                        _ => None,
                    };
                    let problem = ClientError::Problem {
                        status,
                        code,
                        detail,
                        pointer,
                        problem: problem.into(),
                    };
                    match again {
                        Some(seconds) => (Duration::from_secs(seconds), problem),
                        None => return Err(problem),
                    }
                }
                Err(error @ (ureq::Error::BadUri(_) | ureq::Error::Http(_))) => {
                    return Err(self.strange(&error.to_string()));
                }
                Err(error) => {
                    let wait = pause;
                    pause = (pause * 2).min(longest);
                    let (url, source) = (self.base.clone(), Box::new(error));
                    (wait, ClientError::Unreachable { url, source })
                }
            };
            if Instant::now() + wait > deadline {
                return Err(error);
            }
            if !std::mem::replace(&mut told, true) {
                (self.tell)(&error);
            }
            slept(wait, stop)?;
        }
    }
}

/// Reads a token from a file, without the line break at its end.
///
/// # Errors
/// If it cannot be read.
pub fn token_of(file: &Path) -> io::Result<String> {
    Ok(fs::read_to_string(file)?.trim().to_owned())
}

/// Returns whether a job is in a state that it stays in.
pub fn has_ended(job: &Value) -> bool {
    matches!(job["state"].as_str(), Some("succeeded" | "failed" | "cancelled"))
}

fn header<'a>(answer: &'a Response<ureq::Body>, name: &str) -> Option<&'a str> {
    answer.headers().get(name)?.to_str().ok()
}

/// Waits, unless it is stopped.
fn slept(wait: Duration, stop: &Stop) -> Result<(), ClientError> {
    let end = Instant::now() + wait;
    loop {
        if stop.load(Ordering::Relaxed) {
            return Err(ClientError::Stopped);
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(());
        }
        thread::sleep(left.min(LOOK));
    }
}

/// Returns a part of an address with all but plain characters escaped.
fn escaped(text: &str) -> String {
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte);
    let one = |byte: u8| if plain(byte) { char::from(byte).into() } else { format!("%{byte:02X}") };
    text.bytes().map(one).collect()
}
