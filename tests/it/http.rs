//! The service over HTTP: a real listener, a real client, real directories.

mod follow;
mod guard;
mod jobs;
mod life;
mod links;
mod log;
mod page;
mod studies;
mod viewers;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::sync::oneshot;
use ureq::http::{HeaderMap, Request};
use vpd::serve::{Cors, Limits, ServeConfig, ServeError, serve};

/// Longest wait for anything that should happen soon: long, for machines under load.
const PATIENCE: Duration = Duration::from_secs(30);

/// Returns a dipole of a hundred steps.
fn short() -> Value {
    json!({
        "name": "dipole",
        "scene": {
            "inertia": { "principal": [1.01, 1.0, 0.01] },
            "potential": [
                { "kind": "uniform", "weight": 1.0, "body_point": [0, 0, 1], "direction": [0, 0, 1] },
                { "kind": "point_source", "strength": 1.0, "body_point": [0, 0.1, -1], "position": [0, 0, -1.5] },
                { "kind": "point_source", "strength": -1.0, "body_point": [0, -0.1, -1], "position": [0, 0, -1.5] }
            ],
            "initial": {
                "attitude": { "matrix": [[1, 0, 0], [0, 0, -1], [0, 1, 0]] },
                "momentum": { "body": [0, 0, -0.01] }
            }
        },
        "method": { "name": "vpd", "tableau": "gauss2" },
        "step_s": 0.01,
        "steps": 100,
        "log": { "every": 10 }
    })
}

/// Returns a dipole that runs for hours.
fn long() -> Value {
    let mut scenario = short();
    scenario["steps"] = json!(10_000_000_000_u64);
    scenario["log"]["every"] = json!(1_000_000);
    scenario
}

/// A service on a port of its own, stopped when dropped.
struct Server {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<Result<(), ServeError>>>,
}

/// Options of the service of a test.
struct Setup {
    config: ServeConfig,
}

fn service(data: &TempDir) -> Setup {
    let mut config = ServeConfig::new(data.path().join("data"));
    config.limits.queue = 100;
    // The tests are one client, and a busy one.
    config.limits.requests_per_s = 100_000;
    Setup { config }
}

impl Setup {
    fn queue_limit(mut self, limit: usize) -> Self {
        self.config.limits.queue = limit;
        self
    }

    fn workers(mut self, workers: usize) -> Self {
        self.config.workers = workers;
        self
    }

    fn cors(mut self, cors: Cors) -> Self {
        self.config.cors = cors;
        self
    }

    fn public_url(mut self, url: &str) -> Self {
        self.config.public_url = Some(url.to_owned());
        self
    }

    fn limits(mut self, change: impl FnOnce(&mut Limits)) -> Self {
        change(&mut self.config.limits);
        self
    }

    fn tokens(mut self, text: &str) -> Self {
        self.config.tokens = text.parse().expect("tokens");
        self
    }

    fn host(mut self, name: &str) -> Self {
        self.config.hosts.push(name.to_owned());
        self
    }

    fn live(mut self) -> Self {
        self.config.live = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
        self
    }

    fn start(self) -> Server {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        listener.set_nonblocking(true).expect("a socket");
        let address = listener.local_addr().expect("an address");
        let (stop, stopped) = oneshot::channel::<()>();
        let thread = std::thread::spawn(move || {
            let runtime =
                tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
            let runtime = runtime.expect("a runtime");
            let result = runtime.block_on(async {
                let listener = tokio::net::TcpListener::from_std(listener)?;
                let stopped = async {
                    let _ = stopped.await;
                };
                serve(listener, self.config, stopped).await
            });
            runtime.shutdown_background();
            result
        });
        Server { address, stop: Some(stop), thread: Some(thread) }
    }
}

impl Server {
    /// Stops in order; returns how long that took.
    fn stop(mut self) -> (Result<(), ServeError>, Duration) {
        let start = Instant::now();
        drop(self.stop.take());
        let result = self.thread.take().expect("stopped once").join().expect("no panic");
        (result, start.elapsed())
    }

    fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    fn send(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: Option<&[u8]>,
    ) -> Answer {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(PATIENCE))
            .allow_non_standard_methods(true)
            .build()
            .into();
        let mut request = Request::builder().method(method).uri(self.url(path));
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let answer = match body {
            Some(body) => agent.run(request.body(body.to_vec()).expect("a request")),
            None => agent.run(request.body(()).expect("a request")),
        };
        let (parts, mut body) = answer.expect("an answer").into_parts();
        let body = if method == "HEAD" {
            Vec::new()
        } else {
            body.with_config().limit(u64::MAX).read_to_vec().expect("a body")
        };
        Answer { status: parts.status.as_u16(), headers: parts.headers, body }
    }

    fn get(&self, path: &str) -> Answer {
        self.send("GET", path, &[], None)
    }

    fn get_with(&self, path: &str, headers: &[(&str, &str)]) -> Answer {
        self.send("GET", path, headers, None)
    }

    fn post(&self, path: &str, body: &[u8]) -> Answer {
        self.send("POST", path, &[("content-type", "application/json")], Some(body))
    }

    fn submit(&self, scenario: &Value) -> String {
        let answer = self.post("/jobs", scenario.to_string().as_bytes());
        assert_eq!(answer.status, 202, "{:?}", answer.json());
        let id = answer.json()["id"].as_str().expect("an id").to_owned();
        assert_eq!(answer.header("location"), format!("/jobs/{id}"));
        id
    }

    fn job(&self, id: &str) -> Value {
        let answer = self.get(&format!("/jobs/{id}"));
        assert_eq!(answer.status, 200);
        answer.json()
    }

    /// Returns the job once it is in this state.
    fn wait(&self, id: &str, state: &str) -> Value {
        until(&format!("job {state}"), || Some(self.job(id)).filter(|job| job["state"] == state))
    }

    /// Returns a long job that has made steps.
    fn running(&self) -> String {
        let id = self.submit(&long());
        until("steps", || {
            self.job(&id)["progress"]["steps_done"].as_u64().filter(|done| *done > 0)
        });
        id
    }

    /// Returns a short job that has ended.
    fn finished(&self) -> String {
        let id = self.submit(&short());
        self.wait(&id, "succeeded");
        id
    }

    /// Sends bytes as they are; returns the answer up to the end of the connection.
    fn raw(&self, bytes: &[u8]) -> String {
        let mut stream = TcpStream::connect(self.address).expect("a connection");
        stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
        stream.write_all(bytes).expect("sent");
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Answer {
    status: u16,
    headers: HeaderMap,
    body: Vec<u8>,
}

impl Answer {
    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    fn text(&self) -> &str {
        std::str::from_utf8(&self.body).expect("text")
    }

    fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().expect("text"))
    }

    /// Asserts that this is a whole problem, and returns it.
    fn problem(&self, status: u16, code: &str) -> Value {
        let text = String::from_utf8_lossy(&self.body);
        assert_eq!(self.status, status, "{text}");
        assert_eq!(self.header("content-type"), "application/problem+json", "{text}");
        assert_eq!(self.header("x-content-type-options"), "nosniff");
        let problem = self.json();
        assert_eq!(problem["status"], status);
        assert_eq!(problem["code"], code, "{text}");
        for field in ["type", "title", "detail"] {
            assert!(
                problem[field].as_str().is_some_and(|text| !text.is_empty()),
                "{field}: {text}"
            );
        }
        problem
    }
}

/// Asks until there is an answer.
fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(start.elapsed() < PATIENCE, "waited too long for: {what}");
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

fn directory() -> TempDir {
    tempfile::tempdir().expect("a directory")
}

/// Returns the path of a job's record.
fn record(data: &TempDir, id: &str) -> PathBuf {
    data.path().join("data/jobs").join(id)
}

/// Returns a text as the store keeps it, with its checksum.
fn sealed(text: &str) -> String {
    format!("{text}\ncrc32 {:08x}\n", crc32fast::hash(text.as_bytes()))
}

fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).expect("a directory");
    let mut names: Vec<_> = entries
        .map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

fn assert_whole_log(bytes: &[u8]) {
    assert!(bytes.len() > 2 * MAGIC.len());
    assert!(bytes.starts_with(MAGIC) && bytes.ends_with(MAGIC));
}
