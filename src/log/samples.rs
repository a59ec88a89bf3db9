//! The course of a quantity over a log, in few points that keep every extreme: for charts on
//! request.
//!
//! Invariant: memory is bounded by what is asked for, however long the log is; a point holds the smallest and the largest
//! of the samples behind it, so no peak is lost.

use std::fs::File;
use std::ops::{ControlFlow, Range};
use std::path::Path;

use schemars::JsonSchema;
use serde::Serialize;

use super::LogError;
pub use super::curve::{Curve, Velocity};
use super::end::End;
use super::messages::Message;
use super::order::read_by_time;
use super::overview::{self, Points};
use super::reader::Item;

/// Part of a log in time, and the number of points for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Its beginning in seconds.
    pub from_s: f64,
    /// Its end in seconds, at most.
    pub to_s: f64,
    /// Largest number of points.
    pub points: usize,
}

/// The course of a quantity.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Samples {
    /// Quantity whose course it is.
    pub channel: Curve,
    /// The unit of the values; empty for a number.
    pub unit: &'static str,
    /// Time of the first sample behind each point, in seconds.
    pub time_s: Vec<f64>,
    /// The smallest value behind each point, one list a component.
    pub low: Vec<Vec<f64>>,
    /// The largest value behind each point, one list a component.
    pub high: Vec<Vec<f64>>,
    /// Largest number of samples behind a point.
    pub each: u64,
    /// Time of the last sample of the log in seconds; absent while it is being written.
    pub end_s: Option<f64>,
}

/// Least number of messages of a log that several threads read, each a part of the time.
const LONG: u64 = 50_000;

/// Largest number of threads that read one log.
const MOST_THREADS: usize = 4;

/// Reads the course of a quantity, for an ensemble that of member 0. A log without an index of ours is read from its start;
/// of an unfinished one the whole chunks are. Returns `None` if `stopped` said so on the way.
///
/// # Errors
/// If the file cannot be read, or its index is damaged.
pub fn read_course(
    path: &Path,
    curve: Curve,
    window: Window,
    velocity: Velocity<'_>,
    stopped: &(dyn Fn() -> bool + Sync),
) -> Result<Option<Samples>, LogError> {
    let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
    // Saturating; the end belongs to the window.
    let nanos = |seconds: f64| (seconds * 1e9).round() as u64;
    let whole = nanos(window.from_s)..nanos(window.to_s).saturating_add(1);
    let reading = |span, limit| Reading {
        curve,
        points: Points::default(),
        span,
        limit,
        velocity,
        stopped,
        seen: 0,
        values: Vec::new(),
    };
    let Some(end) = End::read(&mut file) else {
        let mut reading = reading(whole, window.points);
        let (mut start_ns, mut stop) = (None, Ok(()));
        read_by_time(path, |item| {
            let Item::Message { topic, time_ns, data, .. } = item else {
                return ControlFlow::Continue(());
            };
            // The first message belongs to the start.
            let start_ns = *start_ns.get_or_insert(time_ns);
            if topic != curve.channel().topic() {
                return ControlFlow::Continue(());
            }
            stop = reading.note(time_ns.saturating_sub(start_ns), data);
            if stop.is_err() || reading.is_over(time_ns.saturating_sub(start_ns)) {
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        })?;
        return Ok(stop.ok().map(|()| Samples::of(curve, reading.points, None)));
    };
    let (start_ns, end_ns) = end.span_ns;
    let last_ns = end_ns - start_ns;
    let whole = whole.start..whole.end.min(last_ns.saturating_add(1));
    let one = |span: Range<u64>, limit: usize| {
        let mut reading = reading(span, limit.max(2));
        let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
        let log_time = |since_ns: u64| start_ns.saturating_add(since_ns);
        let stretch = log_time(reading.span.start)..log_time(reading.span.end);
        let mut stop = Ok(());
        let of_curve = |topic: &str| topic == curve.channel().topic();
        end.messages(&mut file, of_curve, stretch, |_, time_ns, data| {
            stop = reading.note(time_ns.saturating_sub(start_ns), data);
            if stop.is_err() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        })
        .map_err(|source| LogError::mcap(path, "read", source))?;
        Ok(stop.ok().map(|()| reading.points))
    };
    let part = whole.end.saturating_sub(whole.start) as f64 / last_ns.max(1) as f64;
    let inside = overview::of_curve(&end, &mut file, curve, part, window.points / 2)
        .find_map(|overview| Inside::of(overview, &whole, last_ns, window.points));
    let parts: Vec<Result<Option<Points>, LogError>> = match inside {
        Some(Inside { overview, range, span }) => vec![
            one(whole.start..span.start, EDGE_POINTS),
            Ok(Some(overview.part(range, window.points - 2 * EDGE_POINTS))),
            one(span.end..whole.end, EDGE_POINTS),
        ],
        None => {
            let threads = if end.messages < LONG { 1 } else { MOST_THREADS };
            in_parallel(&whole, threads, window.points, one)
        }
    };
    let mut all = Points::default();
    for part in parts {
        let Some(part) = part? else { return Ok(None) };
        all.append(part);
    }
    Ok(Some(Samples::of(curve, all, Some(last_ns))))
}

/// Number of points for the samples before what an overview holds of a window, and as many for
/// those after.
const EDGE_POINTS: usize = 2;

/// The part of a window that an overview covers.
struct Inside {
    overview: Points,
    /// Its points.
    range: Range<usize>,
    /// Time of the points since the start, in nanoseconds.
    span: Range<u64>,
}

impl Inside {
    /// Returns `None` if the overview has at most half of the points wanted of the window: the
    /// samples give as many.
    fn of(overview: Points, window: &Range<u64>, last_ns: u64, wanted: usize) -> Option<Self> {
        let times = &overview.since_ns;
        let first = times.partition_point(|&since_ns| since_ns < window.start);
        // A point ends where the next begins; the last one with the log.
        let whole = window.end > last_ns;
        let after = if whole {
            times.len()
        } else {
            times.partition_point(|&since_ns| since_ns <= window.end).saturating_sub(1)
        };
        let end_ns = times.get(after).copied().unwrap_or(window.end);
        let enough = wanted > 2 * EDGE_POINTS + 1 && after.saturating_sub(first) > wanted / 2;
        let range = first..after;
        enough.then(|| Self { span: overview.since_ns[first]..end_ns, range, overview })
    }
}

/// Reads a time in as many parts as are worth a thread each.
fn in_parallel<T: Send>(
    span: &Range<u64>,
    most: usize,
    points: usize,
    one: impl Fn(Range<u64>, usize) -> T + Sync,
) -> Vec<T> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(most);
    let threads = threads.min(points / 2).max(1);
    let length = span.end.saturating_sub(span.start);
    let border = |k: usize| span.start + (u128::from(length) * k as u128 / threads as u128) as u64;
    let part = |k: usize| one(border(k)..border(k + 1), points / threads);
    std::thread::scope(|scope| {
        let part = &part;
        let others: Vec<_> = (1..threads).map(|k| scope.spawn(move || part(k))).collect();
        let first = part(0);
        let joined = others.into_iter().map(|other| match other.join() {
            Ok(part) => part,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        std::iter::once(first).chain(joined).collect()
    })
}

/// One part of a log on its way into points.
struct Reading<'a> {
    curve: Curve,
    points: Points,
    /// Span in nanoseconds since the start.
    span: Range<u64>,
    limit: usize,
    velocity: Velocity<'a>,
    stopped: &'a (dyn Fn() -> bool + Sync),
    seen: u64,
    values: Vec<f64>,
}

/// The caller no longer waits.
struct Stopped;

impl Reading<'_> {
    /// Takes a message of the channel at a time since the start.
    fn note(&mut self, since_ns: u64, data: &[u8]) -> Result<(), Stopped> {
        self.seen += 1;
        if self.seen.is_multiple_of(1 << 10) && (self.stopped)() {
            return Err(Stopped);
        }
        let channel = self.curve.channel();
        if self.span.contains(&since_ns)
            && let Some(message) = Message::decode(channel.topic(), channel.schema_name(), data)
        {
            self.values.clear();
            self.curve.values(&message, self.velocity, &mut self.values);
            self.points.push(since_ns, &self.values, &self.values, self.limit);
        }
        Ok(())
    }

    /// Returns whether no message of the part comes at or after a time.
    fn is_over(&self, since_ns: u64) -> bool {
        since_ns >= self.span.end
    }
}

impl Samples {
    fn of(curve: Curve, points: Points, last_ns: Option<u64>) -> Self {
        let seconds = |since_ns: u64| since_ns as f64 * 1e-9;
        Self {
            channel: curve,
            unit: curve.unit(),
            time_s: points.since_ns.into_iter().map(seconds).collect(),
            low: points.low,
            high: points.high,
            each: points.each,
            end_s: last_ns.map(seconds),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Curve;

    #[test]
    fn names_are_those_of_answers() {
        for curve in Curve::ALL {
            assert_eq!(serde_json::to_value(curve).expect("a name"), curve.name());
        }
    }
}
