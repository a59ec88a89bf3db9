//! A finished log that is read from the bucket while it is sent: only the requested part is
//! transferred.

use std::future::{Ready, ready};
use std::io::{self, SeekFrom};
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::{Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::SystemTime;

use axum::body::Bytes;
use chrono::{DateTime, Utc};
use futures_util::TryStreamExt;
use futures_util::future::BoxFuture;
use tokio::io::{AsyncRead, AsyncSeek, ReadBuf};
use tower_http::services::fs::{Backend, File, Metadata};
use uuid::Uuid;

use crate::serve::store::LogSum;
use crate::serve::store::bucket::Bucket;

/// Number of bytes that are requested at once where much is read.
const WINDOW: u64 = 4 << 20;

/// A reader that takes fewer bytes than this at once gets no more than these.
const LITTLE: usize = 64 << 10;

/// A finished log in the bucket.
#[derive(Clone, Debug)]
pub(in crate::serve) struct Served {
    bucket: Bucket,
    id: Uuid,
    sum: LogSum,
    finished: Option<DateTime<Utc>>,
}

impl Served {
    pub(super) fn new(
        bucket: Bucket,
        id: Uuid,
        sum: LogSum,
        finished: Option<DateTime<Utc>>,
    ) -> Self {
        Self { bucket, id, sum, finished }
    }

    fn about(&self) -> About {
        About { bytes: self.sum.bytes, finished: self.finished }
    }
}

impl Backend for Served {
    type File = Reading;
    type Metadata = About;
    type OpenFuture = Ready<io::Result<Reading>>;
    type MetadataFuture = Ready<io::Result<About>>;

    fn open(&self, _: PathBuf) -> Self::OpenFuture {
        ready(Ok(Reading {
            log: self.clone(),
            position: 0,
            fetched: Bytes::new(),
            fetching: Mutex::default(),
        }))
    }

    fn metadata(&self, _: PathBuf) -> Self::MetadataFuture {
        ready(Ok(self.about()))
    }
}

/// HTTP headers of the log: the same from every service.
#[derive(Clone, Copy, Debug)]
pub(in crate::serve) struct About {
    bytes: u64,
    finished: Option<DateTime<Utc>>,
}

impl Metadata for About {
    fn is_dir(&self) -> bool {
        false
    }

    fn modified(&self) -> io::Result<SystemTime> {
        self.finished.map(SystemTime::from).ok_or_else(|| io::ErrorKind::Unsupported.into())
    }

    fn len(&self) -> u64 {
        self.bytes
    }
}

/// A place in the log.
pub(in crate::serve) struct Reading {
    log: Served,
    position: u64,
    fetched: Bytes,
    /// Behind a lock, because a future may not be shared between threads.
    fetching: Mutex<Option<BoxFuture<'static, io::Result<Bytes>>>>,
}

impl File for Reading {
    type Metadata = About;
    type MetadataFuture<'a> = Ready<io::Result<About>>;

    fn metadata(&self) -> Self::MetadataFuture<'_> {
        ready(Ok(self.log.about()))
    }
}

impl AsyncSeek for Reading {
    fn start_seek(mut self: Pin<&mut Self>, to: SeekFrom) -> io::Result<()> {
        let (base, by) = match to {
            SeekFrom::Start(place) => (place, 0),
            SeekFrom::Current(by) => (self.position, by),
            SeekFrom::End(by) => (self.log.sum.bytes, by),
        };
        let place = base.checked_add_signed(by);
        self.position = place.ok_or(io::ErrorKind::InvalidInput)?;
        (self.fetched, self.fetching) = (Bytes::new(), Mutex::default());
        Ok(())
    }

    fn poll_complete(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<u64>> {
        Poll::Ready(Ok(self.position))
    }
}

impl AsyncRead for Reading {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let left = self.log.sum.bytes.saturating_sub(self.position);
        if left == 0 || buffer.remaining() == 0 {
            return Poll::Ready(Ok(()));
        }
        if self.fetched.is_empty() {
            let wanted = match buffer.remaining() {
                little @ ..LITTLE => little as u64,
                _ => WINDOW,
            };
            let place = self.position..self.position + wanted.min(left);
            let log = self.log.clone();
            let fetching = self.fetching.get_mut().unwrap_or_else(PoisonError::into_inner);
            let under_way = fetching.get_or_insert_with(|| Box::pin(fetch(log, place)));
            let fetched = std::task::ready!(under_way.as_mut().poll(context));
            *fetching = None;
            self.fetched = fetched?;
            if self.fetched.is_empty() {
                return Poll::Ready(Err(io::ErrorKind::UnexpectedEof.into()));
            }
        }
        let length = self.fetched.len().min(buffer.remaining());
        buffer.put_slice(&self.fetched.split_to(length));
        self.position += length as u64;
        Poll::Ready(Ok(()))
    }
}

async fn fetch(log: Served, place: std::ops::Range<u64>) -> io::Result<Bytes> {
    let Served { bucket, id, sum, .. } = log;
    let pieces = bucket.log_bytes(id, &sum, place).await.map_err(io::Error::other)?;
    let pieces: Vec<Bytes> = pieces.try_collect().await?;
    match <[Bytes; 1]>::try_from(pieces) {
        Ok([one]) => Ok(one),
        Err(several) => Ok(several.concat().into()),
    }
}
