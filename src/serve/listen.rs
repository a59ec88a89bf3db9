//! Connections: taken, counted, timed.
//!
//! Invariants: a connection that says nothing, or reads nothing, is closed in the end; there are
//! never more than the limits allow, and one too many is refused with an answer and harms none that
//! has sent its request; a failed accept does not end the service. A client that closes its side
//! after a request is given the answer; one that leaves is not kept for long.

use std::collections::{BTreeMap, HashMap};
use std::convert::Infallible;
use std::future::poll_fn;
use std::io;
use std::net::IpAddr;
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::Request;
use axum::response::IntoResponse;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt, Interest, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio_io_timeout::TimeoutStream;
use tower::ServiceExt;

use super::problem::{self, Problem};
use super::{Limits, gate, ids};

/// Longest time for the head of a request, seconds; also how long a connection may idle.
const HEAD_TIMEOUT: Duration = Duration::from_secs(10);

/// Longest time in which a client takes nothing of an answer.
const WRITE_TIMEOUT: Duration = Duration::from_secs(60);

/// Longest time in which nothing is written to a client that has closed its side: it may still read
/// (RFC 9112, 9.6), or has left, which looks the same.
const LEFT_TIMEOUT: Duration = Duration::from_secs(10);

/// Pause between looks at the side of a client that has sent what is not read yet.
const LOOK: Duration = Duration::from_secs(1);

/// Largest head of a request, bytes; a longer one is answered 431.
const MAX_HEAD: usize = 16 << 10;

/// Longest time in which one connection too many is answered.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(2);

/// Pause after a failed accept: the system may be out of file handles.
const ACCEPT_PAUSE: Duration = Duration::from_millis(50);

/// Open connections, of all doors.
#[derive(Clone, Debug)]
pub(super) struct Open(Arc<Mutex<Places>>);

#[derive(Debug)]
struct Places {
    limits: Limits,
    by_address: HashMap<IpAddr, usize>,
    /// Connections that have not sent a request yet, the longest waiting first.
    silent: BTreeMap<u64, JoinHandle<()>>,
    next_id: u64,
    /// Number of connections that are being refused with an answer.
    refused: usize,
}

/// Largest number of connections beyond a limit that are refused with an answer at the same time.
pub(super) const REFUSALS: usize = 128;

/// Returns how many are refused with an answer if `connections` are allowed; more are closed.
pub(super) fn refusals(connections: usize) -> usize {
    (connections / 4).clamp(1, REFUSALS)
}

impl Open {
    pub(super) fn new(limits: Limits) -> Self {
        let (by_address, silent) = (HashMap::new(), BTreeMap::new());
        Self(Arc::new(Mutex::new(Places { limits, by_address, silent, next_id: 0, refused: 0 })))
    }

    fn places(&self) -> MutexGuard<'_, Places> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts a connection and begins it; gives it back if it is one too many.
    fn begin<F>(
        &self,
        peer: IpAddr,
        stream: TcpStream,
        connection: impl FnOnce(TcpStream, Entry) -> F,
    ) -> Result<(), TcpStream>
    where
        F: Future<Output = ()> + Send + 'static,
    {
        let mut places = self.places();
        if places.is_full() {
            return Err(stream);
        }
        let limit = places.limits.connections_per_client;
        let count = places.by_address.entry(peer).or_default();
        if *count >= limit {
            return Err(stream);
        }
        *count += 1;
        places.next_id += 1;
        let id = places.next_id;
        // Under the lock: it cannot speak before it is known as silent.
        let task = tokio::spawn(connection(stream, Entry { open: self.clone(), peer, id }));
        places.silent.insert(id, task);
        Ok(())
    }

    /// Answers a connection that it is one too many; closes it if too many are being answered so.
    fn refuse(&self, stream: TcpStream) {
        let mut places = self.places();
        if places.refused < refusals(places.limits.connections) {
            places.refused += 1;
            let refused = Refused(self.clone());
            tokio::spawn(async move {
                let _ = tokio::time::timeout(REFUSAL_TIMEOUT, refuse(stream)).await;
                drop(refused);
            });
        }
    }

    /// Returns whether another one would be one too many.
    fn is_full(&self) -> bool {
        self.places().is_full()
    }

    /// Closes the connection that has been silent for longest: a client that has a request sends it at once.
    async fn shed(&self) {
        let longest = self.places().silent.pop_first();
        if let Some((_, task)) = longest {
            task.abort();
            // Its handle is free when this returns.
            let _ = task.await;
        }
    }
}

impl Places {
    fn is_full(&self) -> bool {
        self.by_address.values().sum::<usize>() >= self.limits.connections
    }
}

/// A counted connection.
struct Entry {
    open: Open,
    peer: IpAddr,
    id: u64,
}

impl Entry {
    /// Takes note that a whole head has come.
    fn speaks(&self) {
        self.open.places().silent.remove(&self.id);
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        let mut places = self.open.places();
        places.silent.remove(&self.id);
        if let Some(count) = places.by_address.get_mut(&self.peer) {
            *count -= 1;
            if *count == 0 {
                places.by_address.remove(&self.peer);
            }
        }
    }
}

/// A connection that is answered that it is one too many.
struct Refused(Open);

impl Drop for Refused {
    fn drop(&mut self) {
        self.0.places().refused -= 1;
    }
}

/// Serves connections until `stop` changes; returns once the answers in flight are given.
pub(super) async fn listen(
    listener: TcpListener,
    app: Router,
    open: Open,
    mut stop: watch::Receiver<bool>,
) {
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
                open.shed().await;
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        if open.is_full() {
            open.shed().await;
        }
        let (app, stopping, alive) = (app.clone(), stopping.clone(), alive.clone());
        let begun = open.begin(peer, stream, |stream, entry| async move {
            serve(stream, entry, app, stopping).await;
            drop(alive);
        });
        if let Err(stream) = begun {
            tracing::debug!(%peer, "one connection too many");
            open.refuse(stream);
        }
    }
    drop((listener, alive));
    // Nothing is sent: this returns when the last connection is closed.
    let _ = gone.recv().await;
}

async fn serve(stream: TcpStream, entry: Entry, app: Router, mut stop: watch::Receiver<bool>) {
    let peer = entry.peer;
    // Small answers go out at once.
    let _ = stream.set_nodelay(true);
    let line = Line::new(stream);
    let (watched, refused) = (line.clone(), line.clone());
    let mut stream = TimeoutStream::new(line);
    stream.set_write_timeout(Some(WRITE_TIMEOUT));
    let service = service_fn(|mut request: Request<Incoming>| {
        entry.speaks();
        request.extensions_mut().insert(gate::Peer(peer));
        let answer = app.clone().oneshot(request.map(Body::new));
        async { answer.await.map_err(|never: Infallible| never) }
    });
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_header_size(MAX_HEAD)
        .half_close(true)
        .serve_connection(TokioIo::new(Box::pin(stream)), service)
        .with_upgrades();
    let mut connection = pin!(connection);
    let (mut stopping, mut left) = (pin!(stop.changed()), pin!(watched.left()));
    let mut stops = false;
    let ended = poll_fn(|cx| {
        // The layer below panics at such a date.
        if !ids::is_sane() {
            return Poll::Ready(Ended::Timeless);
        }
        if !stops && stopping.as_mut().poll(cx).is_ready() {
            stops = true;
            connection.as_mut().graceful_shutdown();
        }
        if let Poll::Ready(ended) = connection.as_mut().poll(cx) {
            return Poll::Ready(Ended::Itself(ended));
        }
        left.as_mut().poll(cx).map(|()| Ended::Left)
    });
    match ended.await {
        Ended::Itself(Ok(())) => {}
        // A client that leaves, or talks nonsense, is no error of the service.
        Ended::Itself(Err(error)) => tracing::debug!(%peer, %error, "connection ended early"),
        Ended::Left => tracing::debug!(%peer, "client has left"),
        Ended::Timeless => refused.refuse_timeless().await,
    }
}

/// How a connection came to its end.
enum Ended {
    Itself(Result<(), hyper::Error>),
    /// The client is gone.
    Left,
    /// The clock of the machine shows a date that HTTP cannot express.
    Timeless,
}

/// A connection that can be watched while an answer is written to it; copies are the same.
#[derive(Clone, Debug)]
struct Line {
    stream: Arc<TcpStream>,
    /// Bytes written so far.
    written: Arc<AtomicU64>,
}

impl Line {
    fn new(stream: TcpStream) -> Self {
        Self { stream: Arc::new(stream), written: Arc::default() }
    }

    /// Returns once the client has closed its side, and takes nothing more.
    async fn left(&self) {
        // Without an error, unless the runtime goes down.
        while let Ok(ready) = self.stream.ready(Interest::READABLE).await
            && !ready.is_read_closed()
        {
            tokio::time::sleep(LOOK).await;
        }
        loop {
            let before = self.written.load(Ordering::Relaxed);
            tokio::time::sleep(LEFT_TIMEOUT).await;
            if self.written.load(Ordering::Relaxed) == before {
                return;
            }
        }
    }

    /// Answers whatever was asked, without a date, that there is no answer at this date; nothing
    /// behind the beginning of another answer.
    async fn refuse_timeless(mut self) {
        if self.written.load(Ordering::Relaxed) > 0 {
            return;
        }
        let body = Problem::timeless().text();
        let head = "HTTP/1.1 503 Service Unavailable\r\nConnection: close";
        let kind = problem::MEDIA_TYPE;
        let length = body.len();
        let answer =
            format!("{head}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\r\n{body}");
        let answered = async {
            self.write_all(answer.as_bytes()).await?;
            // A client still sending when the connection is closed would not see the answer.
            tokio::io::copy(&mut self, &mut tokio::io::sink()).await
        };
        let _ = tokio::time::timeout(REFUSAL_TIMEOUT, answered).await;
    }
}

impl AsyncRead for Line {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        loop {
            ready!(self.stream.poll_read_ready(cx))?;
            match self.stream.try_read_buf(buffer) {
                // The readiness was of the past, and is taken back by that.
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                read => return Poll::Ready(read.map(drop)),
            }
        }
    }
}

impl AsyncWrite for Line {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(cx, &[io::IoSlice::new(bytes)])
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        loop {
            ready!(self.stream.poll_write_ready(cx))?;
            match self.stream.try_write_vectored(parts) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Ok(count) => {
                    self.written.fetch_add(count as u64, Ordering::Relaxed);
                    return Poll::Ready(Ok(count));
                }
                failed => return Poll::Ready(failed),
            }
        }
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        // There is no buffer above the system's.
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        // The socket is closed with its last copy, which is next.
        Poll::Ready(Ok(()))
    }
}

/// Answers the first request of a connection that is one too many: come again later.
async fn refuse(stream: TcpStream) -> Result<(), hyper::Error> {
    if !ids::is_sane() {
        Line::new(stream).refuse_timeless().await;
        return Ok(());
    }
    let service = service_fn(|request: Request<Incoming>| async {
        // A client still sending when the connection is closed would not see the answer.
        gate::drain(Body::new(request.into_body()).into_data_stream()).await;
        Ok::<_, Infallible>(Problem::too_many_connections().into_response())
    });
    http1::Builder::new()
        .keep_alive(false)
        .half_close(true)
        .max_header_size(MAX_HEAD)
        .serve_connection(TokioIo::new(stream), service)
        .await
}
