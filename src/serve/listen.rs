//! Connections: taken, counted, timed.
//!
//! Invariants: a connection that says nothing, or reads nothing, is closed in the end; there are never more
//! than the limits allow, and one too many harms no other; a failed accept does not end the service.

use std::collections::HashMap;
use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio_io_timeout::TimeoutStream;
use tower::ServiceExt;

use super::Limits;

/// Longest time for the head of a request, seconds; also how long a connection may idle.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest time in which a client takes nothing of an answer.
const WRITE_TIMEOUT: Duration = Duration::from_secs(60);

/// Largest head of a request, bytes; a longer one is answered 431.
const MAX_HEAD: usize = 16 << 10;

/// Pause after a failed accept: the system may be out of file handles.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// The address of the client, in the extensions of each request.
#[derive(Clone, Copy, Debug)]
pub(super) struct Peer(pub(super) IpAddr);

/// Open connections by address.
#[derive(Clone, Debug, Default)]
struct Open(Arc<Mutex<HashMap<IpAddr, usize>>>);

impl Open {
    /// Counts a connection; `None` if it is one too many.
    fn enter(&self, peer: IpAddr, limits: &Limits) -> Option<Entry> {
        let mut open = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if open.values().sum::<usize>() >= limits.connections {
            return None;
        }
        let count = open.entry(peer).or_default();
        if *count >= limits.connections_per_client {
            return None;
        }
        *count += 1;
        Some(Entry { open: self.clone(), peer })
    }
}

/// A counted connection.
struct Entry {
    open: Open,
    peer: IpAddr,
}

impl Drop for Entry {
    fn drop(&mut self) {
        let mut open = self.open.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = open.get_mut(&self.peer) {
            *count -= 1;
            if *count == 0 {
                open.remove(&self.peer);
            }
        }
    }
}

/// Serves connections until `stop` changes; returns once the answers in flight are given.
pub(super) async fn listen(
    listener: TcpListener,
    app: Router,
    limits: Limits,
    mut stop: watch::Receiver<bool>,
) {
    let open = Open::default();
    let (alive, mut gone) = mpsc::channel::<()>(1);
    let stopping = stop.clone();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stop.changed() => break,
        };
        let (stream, peer) = match accepted {
            Ok((stream, address)) => (stream, address.ip()),
            Err(error) => {
                tracing::warn!(%error, "connection not accepted");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let Some(entry) = open.enter(peer, &limits) else {
            tracing::debug!(%peer, "one connection too many");
            continue;
        };
        let (app, stopping, alive) = (app.clone(), stopping.clone(), alive.clone());
        tokio::spawn(async move {
            serve(stream, peer, app, stopping).await;
            drop((entry, alive));
        });
    }
    drop((listener, alive));
    // Nobody sends: this returns when the last connection is closed.
    let _ = gone.recv().await;
}

async fn serve(stream: TcpStream, peer: IpAddr, app: Router, mut stop: watch::Receiver<bool>) {
    // Small answers go out at once.
    let _ = stream.set_nodelay(true);
    let mut stream = TimeoutStream::new(stream);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(Peer(peer));
        let answer = app.clone().oneshot(request.map(Body::new));
        async { answer.await.map_err(|never: Infallible| never) }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_header_size(MAX_HEAD)
        .serve_connection(TokioIo::new(Box::pin(stream)), service)
        .with_upgrades();
    let mut connection = std::pin::pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        _ = stop.changed() => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        // A client that leaves, or talks nonsense, is no concern of ours.
        tracing::debug!(%peer, %error, "connection ended early");
    }
}
