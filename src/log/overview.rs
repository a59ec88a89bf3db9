//! Chart data of a long log, gathered while it is written and attached at its end: each quantity by
//! itself, finely and coarsely, so that drawing a part of it reads little more than what is drawn.
//!
//! Invariant: memory is bounded, no extreme is lost, and a resumed writer gathers what the one
//! before it did: both take it from the messages.

use std::fs::File;
use std::ops::Range;

use mcap::records::AttachmentIndex;
use prost::Message as _;

use super::OVERVIEW_ATTACHMENTS;
use super::curve::Curve;
use super::end::{End, attachment};
use super::messages::{Message, Overview, OverviewLine};
use super::schema::Topic;
use crate::solve::so;

/// Least number of samples of a log with an overview: fewer are read themselves in no time.
const LEAST_SAMPLES: u64 = 1 << 16;

/// Least number of samples behind a point of it: the log grows by 3 % at most.
const LEAST_EACH: u64 = 1 << 6;

/// Largest number of values of a quantity, points times components: bounds the memory.
const VALUES: usize = 1 << 19;

/// Least and largest number of points of a quantity; one with too many components for these has no
/// overview.
const POINTS: Range<usize> = 1 << 10..1 << 17;

/// With more points than this, a coarser copy is kept as well, with [`COARSER`] of them to a point.
const FEW: usize = 1 << 13;

/// Number of points behind a coarser one, a power of two.
const COARSER: u64 = 1 << 4;

/// A quantity over time in few points, each the smallest and the largest value of as many samples.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Points {
    /// Time of the first sample behind each point since the start, in nanoseconds.
    pub(super) since_ns: Vec<u64>,
    /// The smallest value behind each point, one list a component.
    pub(super) low: Vec<Vec<f64>>,
    /// The largest value behind each point, one list a component.
    pub(super) high: Vec<Vec<f64>>,
    /// Number of entries behind each point but the last.
    pub(super) each: u64,
    /// Number of entries behind the last point.
    held: u64,
}

impl Default for Points {
    fn default() -> Self {
        let [low, high] = [Vec::new(), Vec::new()];
        Self { since_ns: Vec::new(), low, high, each: 1, held: 1 }
    }
}

impl Points {
    /// Takes the values between `low` and `high` at a time; two neighbours become one point each
    /// time there are more than `limit`, which is 2 or more. Entries without a value, or with
    /// another number of them, are skipped.
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

    /// Makes one point of two neighbours. If their number is odd, the last one has room for as many
    /// again.
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

    /// Makes points of at least `each` samples.
    fn coarsen(&mut self, each: u64) {
        while self.each < each {
            self.halve();
        }
    }

    fn overview(self, curve: Curve) -> Overview {
        let lines = self.low.into_iter().zip(self.high);
        Overview {
            curve: curve.name().to_owned(),
            each: self.each,
            since_ns: self.since_ns,
            lines: lines.map(|(low, high)| OverviewLine { low, high }).collect(),
        }
    }

    /// Decodes an overview; `None` if it is not one that [`Points::overview`] makes.
    fn of(overview: Overview, curve: Curve) -> Option<Self> {
        let Overview { curve: name, each, since_ns, lines } = overview;
        let (low, high): (Vec<_>, Vec<_>) =
            lines.into_iter().map(|line| (line.low, line.high)).unzip();
        let whole = low.iter().chain(&high).all(|line| line.len() == since_ns.len());
        let ascending = since_ns.windows(2).all(|pair| pair[0] <= pair[1]);
        let good = name == curve.name() && whole && ascending && !since_ns.is_empty() && each > 0;
        good.then_some(Self { since_ns, low, high, each, held: each })
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

    /// Returns the points of a range, reduced to as many as are wanted.
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
    /// Points in the order of [`Curve::ALL`].
    points: [Points; Curve::ALL.len()],
    values: Vec<f64>,
}

impl Curves {
    /// Takes note of a message at a time since the start, in nanoseconds.
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

    /// Returns the overviews that a log of `samples` samples has attached, by name.
    pub(super) fn overviews(self, samples: u64) -> impl Iterator<Item = (String, Overview)> {
        let curves = Curve::ALL.into_iter().zip(self.points);
        let long = move |(_, points): &(Curve, Points)| {
            samples >= LEAST_SAMPLES && !points.since_ns.is_empty()
        };
        curves.filter(long).flat_map(|(curve, mut points)| {
            points.coarsen(LEAST_EACH);
            let mut levels = vec![points.clone()];
            while points.since_ns.len() > FEW {
                points.coarsen(points.each * COARSER);
                levels.push(points.clone());
            }
            let name = move |each| format!("{OVERVIEW_ATTACHMENTS}{}-{each}.pb", curve.name());
            levels.into_iter().map(move |level| (name(level.each), level.overview(curve)))
        })
    }
}

/// Returns about how many bytes the overviews of `samples` samples take with all channels, in the
/// log and in memory.
pub(crate) fn bytes(samples: u64, n: usize) -> u64 {
    if samples < LEAST_SAMPLES {
        return 0;
    }
    let momentum = so::dimension(n);
    let of_curve = |components: usize| {
        let points = limit(components).unwrap_or(0).min((samples / LEAST_EACH) as usize);
        points * (8 + 16 * components)
    };
    let fine: usize = [1, 1, 1, 1, n, momentum, momentum, momentum].map(of_curve).iter().sum();
    fine as u64 * (COARSER + 1) / COARSER
}

/// Returns the largest number of points of a quantity with this many components.
fn limit(components: usize) -> Option<usize> {
    let points = (VALUES / components.max(1)).min(POINTS.end);
    (components > 0 && points >= POINTS.start).then_some(points)
}

/// Returns the overviews of a quantity in points, coarse ones first, as far as they can be read.
/// Those that cannot have `least` points in `part` of the log are not read: the samples give as
/// many.
pub(super) fn of_curve(
    end: &End,
    file: &mut File,
    curve: Curve,
    part: f64,
    least: usize,
) -> impl Iterator<Item = Points> {
    let prefix = format!("{OVERVIEW_ATTACHMENTS}{}-", curve.name());
    let mut found: Vec<&AttachmentIndex> =
        end.attachments.iter().filter(|at| at.name.starts_with(&prefix)).collect();
    found.sort_by_key(|at| at.length);
    // A point has a time and, for one component or more, two values.
    let most = move |at: &AttachmentIndex| part * (at.length / 24) as f64;
    let enough = found.into_iter().filter(move |at| most(at) >= least as f64);
    enough.filter_map(move |at| {
        let overview = Overview::decode(attachment(file, at)?.as_slice()).ok()?;
        Points::of(overview, curve)
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
            // The peak stayed in its place.
            let peak = points.low[0].iter().position(|low| *low == -5.0).expect("kept");
            assert!((points.since_ns[peak]..points.since_ns[peak] + points.each).contains(&77_777));
            // It also stays there in fewer points of a part.
            let part = points.part(count / 2..count, 2);
            assert!(part.since_ns.len() <= 2 && part.since_ns[0] == points.since_ns[count / 2]);
            assert_eq!(least(&part.low[0]), least(&points.low[0][count / 2..]));
        }
    }
}
