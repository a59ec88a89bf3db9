//! A service, asked from Python.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use pyo3::prelude::*;
use vpd::client::{self, ClientError, Stop};

use crate::errors::{json, other, refused};
use crate::watched::{Follow, watched};

/// Signals are looked for this often.
const LOOK: Duration = Duration::from_millis(50);
/// Events that wait for who iterates over them.
const WAITING: usize = 64;

/// The native half of `vpdsim.Client`.
#[pyclass(frozen, module = "vpdsim._native")]
pub(crate) struct Client {
    inner: client::Client,
}

#[pymethods]
impl Client {
    #[new]
    fn new(py: Python<'_>, url: &str, token: Option<String>, patience_s: f64) -> PyResult<Self> {
        let patience = Duration::try_from_secs_f64(patience_s);
        let patience =
            patience.map_err(|error| other(py, &format!("{patience_s} s given: {error}")))?;
        let inner =
            client::Client::new(url, token, patience).map_err(|error| refused(py, &error))?;
        Ok(Self { inner })
    }

    fn submit(&self, py: Python<'_>, text: &[u8], key: Option<&str>) -> PyResult<String> {
        self.asked(py, |client, stop| client.submit(text, key, stop))
    }

    fn job(&self, py: Python<'_>, id: &str) -> PyResult<String> {
        self.asked(py, |client, stop| client.job(id, stop))
    }

    fn cancel(&self, py: Python<'_>, id: &str) -> PyResult<String> {
        self.asked(py, |client, stop| client.cancel(id, stop))
    }

    fn jobs(
        &self,
        py: Python<'_>,
        state: Option<&str>,
        name: Option<&str>,
        limit: u64,
    ) -> PyResult<String> {
        self.asked(py, |client, stop| {
            client.jobs(state, name, limit, stop).map(serde_json::Value::from)
        })
    }

    fn wait(
        &self,
        py: Python<'_>,
        id: &str,
        progress: Option<Bound<'_, PyAny>>,
    ) -> PyResult<String> {
        let counts = [AtomicU64::new(0), AtomicU64::new(1)];
        let seen = |job: &serde_json::Value| {
            for (count, key) in counts.iter().zip(["steps_done", "steps"]) {
                count.store(job["progress"][key].as_u64().unwrap_or(0), Ordering::Relaxed);
            }
        };
        let follow = |stop: &Stop| self.inner.wait(id, seen, stop);
        followed(py, progress.as_ref(), &counts, follow).and_then(|job| json(py, &job))
    }

    fn fetch(
        &self,
        py: Python<'_>,
        id: &str,
        to: PathBuf,
        progress: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let counts = [AtomicU64::new(0), AtomicU64::new(1)];
        let seen = |have, whole| {
            counts[0].store(have, Ordering::Relaxed);
            counts[1].store(whole, Ordering::Relaxed);
        };
        followed(py, progress.as_ref(), &counts, |stop| self.inner.fetch(id, &to, seen, stop))
    }

    fn events(&self, id: &str) -> Events {
        let (send, receive) = mpsc::sync_channel(WAITING);
        let stop = Arc::new(Stop::default());
        let (client, id, stopped) = (self.inner.clone(), id.to_owned(), stop.clone());
        thread::spawn(move || {
            let seen = |name: &str, data: serde_json::Value| {
                send.send(Ok((name.to_owned(), data.to_string()))).is_ok()
            };
            if let Err(error) = client.events(&id, seen, &stopped) {
                // Whoever iterated may be gone.
                let _ = send.send(Err(error));
            }
        });
        Events { receive: Mutex::new(receive), stop }
    }
}

impl Client {
    fn asked(
        &self,
        py: Python<'_>,
        ask: impl FnOnce(&client::Client, &Stop) -> Result<serde_json::Value, ClientError> + Send,
    ) -> PyResult<String> {
        let stop = Stop::default();
        let set = || stop.store(true, Ordering::Relaxed);
        let answer = watched(py, set, Follow::default(), || ask(&self.inner, &stop))?;
        json(py, &answer.map_err(|error| refused(py, &error))?)
    }
}

/// Does something that takes long, and tells how far it is.
fn followed<T: Send>(
    py: Python<'_>,
    progress: Option<&Bound<'_, PyAny>>,
    counts: &[AtomicU64; 2],
    work: impl FnOnce(&Stop) -> Result<T, ClientError> + Send,
) -> PyResult<T> {
    let stop = Stop::default();
    let done = || (counts[0].load(Ordering::Relaxed), counts[1].load(Ordering::Relaxed));
    let follow = Follow { progress, done: Some(&done) };
    let set = || stop.store(true, Ordering::Relaxed);
    watched(py, set, follow, || work(&stop))?.map_err(|error| refused(py, &error))
}

/// The events of a job: pairs of a name and JSON.
#[pyclass(frozen, module = "vpdsim._native")]
pub(crate) struct Events {
    receive: Mutex<Receiver<Result<(String, String), ClientError>>>,
    stop: Arc<Stop>,
}

#[pymethods]
impl Events {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<(String, String)>> {
        loop {
            let next = py.detach(|| {
                let receive = self.receive.lock().unwrap_or_else(PoisonError::into_inner);
                receive.recv_timeout(LOOK)
            });
            match next {
                Ok(Ok(event)) => return Ok(Some(event)),
                Ok(Err(error)) => return Err(refused(py, &error)),
                Err(RecvTimeoutError::Disconnected) => return Ok(None),
                Err(RecvTimeoutError::Timeout) => py.check_signals()?,
            }
        }
    }
}

impl Drop for Events {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}
