//! Work spread over threads, with its results in order.
//!
//! Invariant: the results depend neither on the number of threads nor on which of them is quick. A
//! thread that leaves early, or panics, ends the others: none waits for what never comes.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread;

/// Returns the number of cores that this process may use.
pub(crate) fn cores() -> usize {
    thread::available_parallelism().map_or(1, NonZeroUsize::get)
}

/// Hands out `places`, `width` at a time, to `worker` on each of `threads` threads, and gives the results to `put`, in order.
/// A worker returns `None` if it leaves early, while places may be left.
///
/// # Errors
/// The errors of `put`, which end all of it.
pub(crate) fn in_order<T: Send, E>(
    places: Range<u64>,
    width: u64,
    threads: usize,
    worker: impl Fn(&Turns<'_, T>) -> Option<()> + Sync,
    mut put: impl FnMut(T) -> Result<(), E>,
) -> Result<(), E> {
    let most = places.end.saturating_sub(places.start).div_ceil(width.max(1));
    let threads = threads.max(1).min(usize::try_from(most).unwrap_or(usize::MAX));
    let queue = Queue::new(&places, width.max(1));
    thread::scope(|scope| {
        let (send, receive) = mpsc::channel();
        for _ in 0..threads {
            let (turns, worker) = (Turns { queue: &queue, send: send.clone() }, &worker);
            scope.spawn(move || {
                let mut leaving = Leaving { queue: turns.queue, early: true };
                leaving.early = worker(&turns).is_none();
            });
        }
        drop(send);
        let (mut waiting, mut next) = (BTreeMap::new(), places.start);
        let done = receive.iter().try_for_each(|(turn, made): (Range<u64>, T)| {
            waiting.insert(turn.start, (turn.end, made));
            while let Some((end, made)) = waiting.remove(&next) {
                next = end;
                put(made)?;
                queue.written(next);
            }
            Ok(())
        });
        queue.close();
        done
    })
}

/// The turns of one thread.
pub(crate) struct Turns<'a, T> {
    queue: &'a Queue,
    send: mpsc::Sender<(Range<u64>, T)>,
}

impl<T> Turns<'_, T> {
    /// Returns the next places; waits while others are too far behind. `None` if none are left, or
    /// results are no longer taken.
    pub(crate) fn take(&self) -> Option<Range<u64>> {
        self.queue.take()
    }

    /// Hands on the results; `None` if they are no longer taken.
    pub(crate) fn give(&self, places: Range<u64>, made: T) -> Option<()> {
        self.send.send((places, made)).ok()
    }

    /// Returns whether results are no longer taken.
    pub(crate) fn is_closed(&self) -> bool {
        self.queue.is_closed()
    }
}

/// The places that wait for a thread.
struct Queue {
    end: u64,
    width: u64,
    places: Mutex<Places>,
    moved: Condvar,
    closed: AtomicBool,
}

/// Progress of the work.
struct Places {
    /// First place that no thread has taken.
    next: u64,
    /// First place that was not handed on.
    written: u64,
}

impl Queue {
    /// At most this many places may be done ahead of a slow one.
    const AHEAD: u64 = 1024;

    fn new(places: &Range<u64>, width: u64) -> Self {
        let Range { start, end } = *places;
        let places = Mutex::new(Places { next: start, written: start });
        Self { end, width, places, moved: Condvar::new(), closed: AtomicBool::new(false) }
    }

    fn places(&self) -> MutexGuard<'_, Places> {
        self.places.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Relaxed)
    }

    fn take(&self) -> Option<Range<u64>> {
        let mut places = self.places();
        while places.next >= places.written + Self::AHEAD && !self.is_closed() {
            places = self.moved.wait(places).unwrap_or_else(PoisonError::into_inner);
        }
        let from = places.next;
        if from >= self.end || self.is_closed() {
            return None;
        }
        places.next = self.end.min(from + self.width);
        Some(from..places.next)
    }

    /// Takes note that all places before this one were handed on.
    fn written(&self, place: u64) {
        self.places().written = place;
        self.moved.notify_all();
    }

    fn close(&self) {
        let places = self.places();
        self.closed.store(true, Ordering::Relaxed);
        drop(places);
        self.moved.notify_all();
    }
}

/// Closes the queue if a thread leaves it early, whatever the reason: the others wait for what it took.
struct Leaving<'a> {
    queue: &'a Queue,
    early: bool,
}

impl Drop for Leaving<'_> {
    fn drop(&mut self) {
        if self.early {
            self.queue.close();
        }
    }
}
