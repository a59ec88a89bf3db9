//! The real binary as a service of its own process.

use std::fs::{self, File};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use sha2::{Digest, Sha256};

/// Longest wait for anything that should happen soon: long, for machines under load.
pub(super) const PATIENCE: Duration = Duration::from_secs(60);

pub(super) struct Service {
    child: Child,
    pub(super) address: SocketAddr,
    pub(super) data: PathBuf,
}

/// An answer: status and body.
pub(super) struct Answer {
    pub(super) status: u16,
    pub(super) body: Vec<u8>,
}

impl Answer {
    pub(super) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    pub(super) fn code(&self) -> String {
        self.json()["code"].as_str().unwrap_or_default().to_owned()
    }
}

impl Service {
    /// Starts on `folder`/data and waits until it answers.
    pub(super) fn start(folder: &Path, arguments: &[&str]) -> Self {
        Self::start_with(folder, arguments, &[])
    }

    pub(super) fn start_with(
        folder: &Path,
        arguments: &[&str],
        environment: &[(&str, &Path)],
    ) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_vpd"));
        command.envs(environment.iter().copied());
        Self::start_as(command, folder, arguments)
    }

    /// Starts by a command that takes the arguments of the program; its output goes to
    /// `folder`/stderr.
    pub(super) fn start_as(mut command: Command, folder: &Path, arguments: &[&str]) -> Self {
        let log = File::options().create(true).append(true).open(folder.join("stderr"));
        command.stderr(log.expect("a file"));
        Self::start_unheard(command, folder, arguments)
    }

    /// Does the same, but its output goes where the command says.
    pub(super) fn start_unheard(mut command: Command, folder: &Path, arguments: &[&str]) -> Self {
        // The system chooses a free port; no other process takes it in the moment between.
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("an address");
        drop(listener);
        let data = folder.join("data");
        let child = command
            .args(["serve", "--listen", &address.to_string(), "--data"])
            .arg(&data)
            .args(["--requests-per-s", "1000000", "--connections-per-client", "1000"])
            .args(arguments)
            .stdout(Stdio::null())
            .spawn()
            .expect("the binary starts");
        let mut service = Self { child, address, data };
        let begun = Instant::now();
        while TcpStream::connect(address).is_err() {
            let ended = service.child.try_wait().expect("a child");
            let said = fs::read_to_string(folder.join("stderr")).unwrap_or_default();
            assert!(ended.is_none() && begun.elapsed() < PATIENCE, "no service: {said}");
            std::thread::sleep(Duration::from_millis(2));
        }
        service
    }

    pub(super) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits until it has ended by itself.
    pub(super) fn dies(mut self) -> ExitStatus {
        self.child.wait().expect("a child")
    }

    /// Sends `kill -9`.
    pub(super) fn kill(mut self) {
        self.child.kill().expect("killed");
        self.child.wait().expect("a child");
    }

    /// Sends `kill -TERM`; returns how it ended and how long that took.
    pub(super) fn terminate(mut self) -> (ExitStatus, Duration) {
        let begun = Instant::now();
        let sent = Command::new("kill").args(["-TERM", &self.pid().to_string()]).status();
        assert!(sent.expect("kill").success());
        (self.child.wait().expect("a child"), begun.elapsed())
    }

    /// Returns an answer, or none if the service is gone.
    pub(super) fn try_send(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: Option<&str>,
    ) -> Option<Answer> {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(PATIENCE))
            .build()
            .into();
        let mut request = ureq::http::Request::builder()
            .method(method)
            .uri(format!("http://{}{path}", self.address));
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let answer = match body {
            Some(body) => agent.run(request.body(body.to_owned()).expect("a request")),
            None => agent.run(request.body(()).expect("a request")),
        };
        let (parts, body) = answer.ok()?.into_parts();
        let body = body.into_with_config().limit(u64::MAX).read_to_vec().ok()?;
        Some(Answer { status: parts.status.as_u16(), body })
    }

    pub(super) fn send(&self, method: &str, path: &str, body: Option<&str>) -> Answer {
        let headers = [("content-type", "application/json")];
        self.try_send(method, path, &headers, body).expect("an answer")
    }

    pub(super) fn get(&self, path: &str) -> Answer {
        self.send("GET", path, None)
    }

    pub(super) fn submit(&self, scenario: &Value) -> String {
        let answer = self.send("POST", "/jobs", Some(&scenario.to_string()));
        assert_eq!(answer.status, 202, "{}", String::from_utf8_lossy(&answer.body));
        answer.json()["id"].as_str().expect("an id").to_owned()
    }

    pub(super) fn job(&self, id: &str) -> Value {
        let answer = self.get(&format!("/jobs/{id}"));
        assert_eq!(answer.status, 200, "{id}: {}", String::from_utf8_lossy(&answer.body));
        answer.json()
    }

    /// Returns the job once it has ended.
    pub(super) fn ended(&self, id: &str) -> Value {
        let begun = Instant::now();
        loop {
            let job = self.job(id);
            if !["queued", "running"].contains(&job["state"].as_str().expect("a state")) {
                return job;
            }
            assert!(begun.elapsed() < PATIENCE, "{id} does not end: {job}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Returns the study once it has ended.
    pub(super) fn study(&self, id: &str) -> Value {
        let begun = Instant::now();
        loop {
            let study = self.get(&format!("/studies/{id}")).json();
            if !["queued", "running"].contains(&study["state"].as_str().expect("a state")) {
                return study;
            }
            assert!(begun.elapsed() < PATIENCE, "{id} does not end: {study}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns the SHA-256 of a job's log.
    pub(super) fn digest(&self, id: &str) -> String {
        let answer = self.get(&format!("/jobs/{id}/log.mcap"));
        assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
        digest(&answer.body)
    }

    /// Returns the SHA-256 of the log of a scenario that nothing disturbs.
    pub(super) fn reference(&self, scenario: &Value) -> String {
        let id = self.submit(scenario);
        assert_eq!(self.ended(&id)["state"], "succeeded");
        self.digest(&id)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(super) fn digest(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
