//! Chunks on their way into the file of a log: compressed, written and synced on threads of their own, so that the
//! integrator need not wait.
//!
//! Invariant: chunks are written in their order, at most [`WAITING`] wait, and what fails first is what is reported: nothing
//! is written after it.

use std::io;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, channel, sync_channel};
use std::thread::JoinHandle;

use super::container::{Chunk, Container};
use super::part::Syncer;

/// Most chunks that wait to be compressed, in addition to the one that is.
const WAITING: usize = 1;

/// What failed: the action and the error of the system.
pub(super) type Refusal = (&'static str, io::Error);

/// Writes chunks, and has them brought to the disk.
pub(super) struct ChunkWriter {
    container: Container,
    syncer: Syncer,
}

impl ChunkWriter {
    pub(super) fn new(container: Container, syncer: Syncer) -> Self {
        Self { container, syncer }
    }

    pub(super) fn container(&mut self) -> &mut Container {
        &mut self.container
    }

    pub(super) fn syncer(&self) -> &Syncer {
        &self.syncer
    }

    pub(super) fn into_parts(self) -> (Container, Syncer) {
        (self.container, self.syncer)
    }

    /// Writes a chunk; if it ends with the checkpoint of a step, it soon is on the disk.
    pub(super) fn write(&mut self, chunk: &Chunk, step: Option<u64>) -> Result<(), Refusal> {
        self.container.chunk(chunk).map_err(|source| ("write", source))?;
        match step {
            Some(step) => self.syncer.request(step).map_err(|source| ("sync", source)),
            None => Ok(()),
        }
    }
}

/// The thread that writes, and the way to it.
pub(super) struct WriterThread {
    chunks: SyncSender<(Chunk, Option<u64>)>,
    /// Chunks that were written, for their room.
    empty: Receiver<Chunk>,
    thread: JoinHandle<(Box<ChunkWriter>, Result<(), Refusal>)>,
}

impl WriterThread {
    pub(super) fn start(mut writer: Box<ChunkWriter>) -> io::Result<Self> {
        let (chunks, filled) = sync_channel::<(Chunk, Option<u64>)>(WAITING);
        let (written, empty) = channel();
        let thread = std::thread::Builder::new().name("log-write".to_owned()).spawn(move || {
            let mut done = Ok(());
            for (mut chunk, step) in filled {
                done = writer.write(&chunk, step);
                if done.is_err() {
                    break;
                }
                chunk.clear();
                // Nobody fills it any more at the end.
                let _ = written.send(chunk);
            }
            (writer, done)
        })?;
        Ok(Self { chunks, empty, thread })
    }

    /// Hands a chunk over and returns an empty one; waits while others wait. `None` if the thread has failed.
    pub(super) fn hand_over(&self, chunk: Chunk, step: Option<u64>) -> Option<Chunk> {
        self.chunks.send((chunk, step)).ok()?;
        match self.empty.try_recv() {
            Ok(chunk) => Some(chunk),
            Err(TryRecvError::Empty | TryRecvError::Disconnected) => Some(Chunk::default()),
        }
    }

    /// Waits until all chunks are written; returns what wrote them, unless the thread panicked.
    pub(super) fn stop(self) -> (Option<Box<ChunkWriter>>, Result<(), Refusal>) {
        drop(self.chunks);
        match self.thread.join() {
            Ok((writer, done)) => (Some(writer), done),
            Err(_) => (None, Err(("write", io::Error::other("the thread that writes panicked")))),
        }
    }
}
