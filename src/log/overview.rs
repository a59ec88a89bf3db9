//! What charts of a long log show, gathered while it is written and attached at its end: with it a chart of
//! 10^7 samples takes some 20 ms.
//!
//! Invariant: memory is bounded, no extreme is lost, and a resumed writer gathers what the one before it did: both take
//! what stands in the messages.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;

use mcap::Summary;
use mcap::records::{Record, op};
use prost::Message as _;

use super::messages::{Message, Overview, OverviewCurve, OverviewLine};
use super::samples::Curve;
use super::schema::Topic;
use super::{MAX_CHUNK_BYTES, OVERVIEW_ATTACHMENT};
use crate::solve::so;

/// Samples from which on a log has an overview: fewer are read themselves in no time.
const LEAST_SAMPLES: u64 = 1 << 16;

/// Samples behind a point of it, at least: so the log grows by 3 % at most.
const LEAST_EACH: u64 = 1 << 6;

/// Values of a quantity, points times components: what bounds the memory.
const VALUES: usize = 1 << 17;

/// Points of a quantity, at most, and at least: with too many components for these there is no overview of it.
const POINTS: Range<usize> = 1 << 10..1 << 15;

/// A quantity over time in few points, each the smallest and the largest value of as many samples.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Points {
    /// Time of the first sample behind each point since the start, in nanoseconds.
    pub(super) since_ns: Vec<u64>,
    /// The smallest value behind each point, one list a component.
    pub(super) low: Vec<Vec<f64>>,
    /// The largest value behind each point, one list a component.
    pub(super) high: Vec<Vec<f64>>,
    /// What was pushed behind each point but the last.
    pub(super) each: u64,
    /// What was pushed behind the last point.
    held: u64,
}

impl Default for Points {
    fn default() -> Self {
        let [low, high] = [Vec::new(), Vec::new()];
        Self { since_ns: Vec::new(), low, high, each: 1, held: 1 }
    }
}

impl Points {
    /// Takes the values between `low` and `high` at a time; two neighbours become one point each time there are more
    /// than `limit`, which is 2 or more. What has no value, or another number of them, is passed over.
    pub(super) fn push(&mut self, since_ns: u64, low: &[f64], high: &[f64], limit: usize) {
        if self.since_ns.is_empty() {
            self.low = vec![Vec::new(); low.len()];
            self.high = self.low.clone();
        }
        if low.len() != self.low.len() || low.is_empty() {
            return;
        }
        if self.held == self.each && self.since_ns.len() >= limit {
            self.halve();
        }
        let lines = self.low.iter_mut().zip(&mut self.high).zip(low.iter().zip(high));
        if self.held < self.each {
            self.held += 1;
            for ((lows, highs), (&low, &high)) in lines {
                if let Some((last_low, last_high)) = lows.last_mut().zip(highs.last_mut()) {
                    (*last_low, *last_high) = (last_low.min(low), last_high.max(high));
                }
            }
            return;
        }
        self.held = 1;
        self.since_ns.push(since_ns);
        for ((lows, highs), (&low, &high)) in lines {
            lows.push(low);
            highs.push(high);
        }
    }

    /// Makes one point of two neighbours. Of an odd number the last one has room for as many again.
    fn halve(&mut self) {
        if self.since_ns.len().is_multiple_of(2) {
            self.held += self.each;
        }
        self.each *= 2;
        self.since_ns = self.since_ns.iter().step_by(2).copied().collect();
        let halve = |lines: &mut [Vec<f64>], keep: fn(f64, f64) -> f64| {
            for line in lines {
                let pairs = line.chunks(2).map(|pair| pair.iter().copied().reduce(keep));
                *line = pairs.flatten().collect();
            }
        };
        halve(&mut self.low, f64::min);
        halve(&mut self.high, f64::max);
    }

    /// Takes the points of the part of time that follows.
    pub(super) fn append(&mut self, part: Self) {
        if part.since_ns.is_empty() {
            return;
        }
        if self.since_ns.is_empty() {
            *self = part;
            return;
        }
        self.each = self.each.max(part.each);
        self.since_ns.extend(part.since_ns);
        for (mine, others) in [(&mut self.low, part.low), (&mut self.high, part.high)] {
            mine.iter_mut().zip(others).for_each(|(mine, other)| mine.extend(other));
        }
    }

    /// Of these points those of a range, in as many as are wanted.
    pub(super) fn part(&self, range: Range<usize>, limit: usize) -> Self {
        let mut part = Self::default();
        let [mut low, mut high] = [Vec::new(), Vec::new()];
        for at in range {
            for (values, lines) in [(&mut low, &self.low), (&mut high, &self.high)] {
                values.clear();
                values.extend(lines.iter().map(|line| line[at]));
            }
            part.push(self.since_ns[at], &low, &high, limit);
        }
        Self { each: part.each * self.each, ..part }
    }
}

/// The quantities of a run, or of member 0, on their way into an overview.
#[derive(Debug, Default)]
pub(super) struct Curves {
    /// In the order of [`Curve::ALL`].
    points: [Points; Curve::ALL.len()],
    values: Vec<f64>,
}

impl Curves {
    /// Takes note of what a message says at a time since the start, in nanoseconds.
    pub(super) fn note(&mut self, topic: Topic, since_ns: u64, message: &Message) {
        if topic.member > 0 {
            return;
        }
        for (curve, points) in Curve::ALL.into_iter().zip(&mut self.points) {
            if curve.channel() == topic.channel {
                self.values.clear();
                curve.values(message, &|_| Vec::new(), &mut self.values);
                if let Some(limit) = limit(self.values.len()) {
                    points.push(since_ns, &self.values, &self.values, limit);
                }
            }
        }
    }

    /// What a log of so many samples has attached.
    pub(super) fn overview(self, samples: u64) -> Option<Overview> {
        if samples < LEAST_SAMPLES {
            return None;
        }
        let curve = |(curve, mut points): (Curve, Points)| {
            while points.each < LEAST_EACH {
                points.halve();
            }
            let lines = points.low.into_iter().zip(points.high);
            OverviewCurve {
                curve: curve.name().to_owned(),
                each: points.each,
                since_ns: points.since_ns,
                lines: lines.map(|(low, high)| OverviewLine { low, high }).collect(),
            }
        };
        let curves = Curve::ALL.into_iter().zip(self.points);
        let curves = curves.filter(|(_, points)| !points.since_ns.is_empty()).map(curve).collect();
        Some(Overview { curves })
    }
}

/// About how many bytes the overview of so many samples takes with all channels.
pub(crate) fn bytes(samples: u64, n: usize) -> u64 {
    let vectors = so::dimension(n);
    let points = limit(vectors).unwrap_or(0).min((samples / LEAST_EACH) as usize);
    let components = 3 + 3 * vectors + n;
    if samples < LEAST_SAMPLES {
        0
    } else {
        (points * (16 * components + 8 * Curve::ALL.len())) as u64
    }
}

/// Points of a quantity with so many components.
fn limit(components: usize) -> Option<usize> {
    let points = (VALUES / components.max(1)).min(POINTS.end);
    (components > 0 && points >= POINTS.start).then_some(points)
}

/// The overview of a quantity that a finished log has attached; `None` if there is none, or none that can be read: the
/// samples say the same.
pub(super) fn read(file: &mut File, summary: &Summary, curve: Curve) -> Option<Points> {
    let index = summary.attachment_indexes.iter().find(|at| at.name == OVERVIEW_ATTACHMENT)?;
    if index.length > MAX_CHUNK_BYTES {
        return None;
    }
    // Its opcode, its length, and the rest.
    let mut record = vec![0; index.length as usize];
    file.seek(SeekFrom::Start(index.offset)).ok()?;
    file.read_exact(&mut record).ok()?;
    let body = record.get(9..)?;
    let Ok(Record::Attachment { data, crc, .. }) = mcap::parse_record(op::ATTACHMENT, body) else {
        return None;
    };
    let covered = body.get(..body.len().checked_sub(4)?)?;
    if record[0] != op::ATTACHMENT || (crc != 0 && crc32fast::hash(covered) != crc) {
        return None;
    }
    let overview = Overview::decode(data.as_ref()).ok()?;
    let found = overview.curves.into_iter().find(|found| found.curve == curve.name())?;
    let (low, high): (Vec<_>, Vec<_>) =
        found.lines.into_iter().map(|line| (line.low, line.high)).unzip();
    let count = found.since_ns.len();
    let whole = low.iter().chain(&high).all(|line| line.len() == count);
    let ascending = found.since_ns.windows(2).all(|pair| pair[0] <= pair[1]);
    (whole && ascending && count > 0 && found.each > 0).then_some(Points {
        since_ns: found.since_ns,
        low,
        high,
        each: found.each,
        held: found.each,
    })
}

#[cfg(test)]
mod tests {
    use super::Points;

    #[test]
    fn every_extreme_is_kept_in_as_many_points_as_asked_for() {
        for limit in [2, 3, 7, 500] {
            let mut points = Points::default();
            let value = |k: u64| if k == 77_777 { -5.0 } else { (k % 7) as f64 };
            for k in 0..100_000 {
                let values = [value(k), -value(k)];
                points.push(k, &values, &values, limit);
            }
            let count = points.since_ns.len();
            assert!(count <= limit && count > limit / 2, "{count} of {limit}");
            for line in points.low.iter().chain(&points.high) {
                assert_eq!(line.len(), count);
            }
            let least = |line: &[f64]| line.iter().copied().fold(f64::INFINITY, f64::min);
            assert_eq!((least(&points.low[0]), least(&points.low[1])), (-5.0, -6.0));
            for (k, since_ns) in points.since_ns.iter().enumerate() {
                assert_eq!(*since_ns, k as u64 * points.each);
            }
            // The peak stands where it was.
            let peak = points.low[0].iter().position(|low| *low == -5.0).expect("kept");
            assert!((points.since_ns[peak]..points.since_ns[peak] + points.each).contains(&77_777));
            // So it does in fewer points of a part.
            let part = points.part(count / 2..count, 2);
            assert!(part.since_ns.len() <= 2 && part.since_ns[0] == points.since_ns[count / 2]);
            assert_eq!(least(&part.low[0]), least(&points.low[0][count / 2..]));
        }
    }
}
