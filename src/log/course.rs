//! Data of the charts of a log over time, kept while it is written or read.
//!
//! Invariant: memory is bounded, every extreme is kept, and a log and its writer give the same points.

use std::ops::ControlFlow;
use std::path::Path;

use prost::Message as _;

use super::LogError;
use super::messages::Member;
use super::order::read_by_time;
use super::reader::{Item, Message};
use super::resume::Seen;
use super::schema::Channel;
use super::spread::Spread;
use crate::solve::state;

/// Chart of a log over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogChart {
    /// The error of the energy.
    Energy,
    /// The distance of the attitude from the group.
    Orthogonality,
    /// The drift of the momentum that the scene conserves.
    Momentum,
    /// Factor by which adaptive steps are shorter than the longest.
    Pace,
    /// The angle between an axis of the body and its direction.
    Pointing,
    /// The spread of the attitude: by its covariance, or of the members of an ensemble.
    Spread,
}

impl LogChart {
    /// All charts.
    pub const ALL: [Self; 6] = [
        Self::Energy,
        Self::Orthogonality,
        Self::Momentum,
        Self::Pace,
        Self::Pointing,
        Self::Spread,
    ];

    /// Returns the name of its file.
    pub const fn file(self) -> &'static str {
        match self {
            Self::Energy => "energy.svg",
            Self::Orthogonality => "orthogonality.svg",
            Self::Momentum => "momentum.svg",
            Self::Pace => "pace.svg",
            Self::Pointing => "pointing.svg",
            Self::Spread => "spread.svg",
        }
    }
}

/// Data from which the charts of a log are drawn, gathered in bounded memory: from the log, or
/// while it is written. Both give the same charts to the byte.
#[derive(Clone, Debug, Default)]
pub struct Course {
    start_ns: Option<u64>,
    /// Series in the order of [`LogChart::ALL`].
    series: [Series; 6],
}

impl Course {
    /// Reads it from a log.
    ///
    /// # Errors
    /// If the log cannot be read.
    pub fn of(log: &Path) -> Result<Self, LogError> {
        const MEMBERS: Channel = Channel::EnsembleMembers;
        let (mut course, mut spread) = (Self::default(), Spread::default());
        read_by_time(log, |item| {
            if let Item::Message { topic, schema, time_ns, data, .. } = item {
                if let Some(message) = Message::decode(topic, schema, data) {
                    course.note_message(time_ns, &message);
                } else if topic == MEMBERS.topic() && schema == MEMBERS.schema_name() {
                    let way = Member::decode(data).ok().and_then(|member| member.way);
                    way.iter().for_each(|way| spread.add(way));
                }
            }
            ControlFlow::Continue(())
        })?;
        spread.points().for_each(|point| course.series[LogChart::Spread as usize].push(point));
        Ok(course)
    }

    /// Takes note of the contents of a resumed log.
    pub fn note_seen(&mut self, seen: &Seen<'_>) {
        if let Seen::Message(time_ns, message) = seen {
            self.note_message(*time_ns, message);
        }
    }

    /// Takes note of a message of the log.
    pub fn note_message(&mut self, time_ns: u64, message: &Message) {
        match message {
            Message::Energy(message) => self.note(time_ns, LogChart::Energy, message.error),
            Message::Orthogonality(message) => {
                self.note(time_ns, LogChart::Orthogonality, message.error);
            }
            Message::Momentum(message) => {
                if let Some(drift) = message.drift {
                    self.note(time_ns, LogChart::Momentum, drift);
                }
            }
            Message::Pace(message) => self.note(time_ns, LogChart::Pace, 1.0 / message.least_sigma),
            Message::Pointing(message) => {
                self.note(time_ns, LogChart::Pointing, message.axis_error_rad);
            }
            Message::Derivatives(message) => {
                if let Some(spread) = state::Derivatives::from(message).attitude_spread_rad() {
                    self.note(time_ns, LogChart::Spread, spread);
                }
            }
            _ => {}
        }
    }

    /// Takes note of the value of a chart at a log time; the first time is its zero.
    pub fn note(&mut self, time_ns: u64, which: LogChart, value: f64) {
        let since_ns = time_ns.saturating_sub(*self.start_ns.get_or_insert(time_ns));
        self.series[which as usize].push((since_ns as f64 * 1e-9, value));
    }

    /// Returns whether a chart would show a line.
    pub fn has_line(&self, which: LogChart) -> bool {
        let points = self.points(which);
        points.first().zip(points.last()).is_some_and(|(first, last)| first.0 < last.0)
    }

    /// Returns the points of a chart: seconds since the first sample, and the value.
    pub fn points(&self, which: LogChart) -> &[(f64, f64)] {
        &self.series[which as usize].points
    }
}

/// Points over time in bounded memory: once there are too many, the larger of two neighbours stays.
#[derive(Clone, Debug)]
struct Series {
    points: Vec<(f64, f64)>,
    /// Number of samples behind a point.
    each: usize,
    /// Number of samples behind the last point.
    held: usize,
}

impl Default for Series {
    fn default() -> Self {
        Self { points: Vec::new(), each: 1, held: 1 }
    }
}

impl Series {
    const LIMIT: usize = 1 << 16;

    fn push(&mut self, point: (f64, f64)) {
        if self.held < self.each {
            self.held += 1;
            if let Some(last) = self.points.last_mut() {
                *last = larger(*last, point);
            }
            return;
        }
        if self.points.len() == Self::LIMIT {
            self.points = self.points.chunks(2).map(|pair| larger(pair[0], pair[1])).collect();
            self.each *= 2;
        }
        self.held = 1;
        self.points.push(point);
    }
}

/// Returns the point with the larger size.
fn larger(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    if b.1.abs() > a.1.abs() { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::Series;

    #[test]
    fn a_long_series_keeps_its_extremes_in_bounded_memory() {
        let mut series = Series::default();
        let value = |k: usize| if k == 777_777 { -5.0 } else { (k % 7) as f64 * 1e-3 };
        for k in 0..1_000_000 {
            series.push((k as f64, value(k)));
        }
        let points = &series.points;
        assert!(points.len() <= Series::LIMIT && points.len() > Series::LIMIT / 2);
        assert!(points.contains(&(777_777.0, -5.0)));
        assert!(points.windows(2).all(|pair| pair[0].0 < pair[1].0));
        // A point is never far from the samples that it stands for.
        assert!(points.windows(2).all(|pair| pair[1].0 - pair[0].0 <= 2.0 * series.each as f64));
        assert!(points.last().is_some_and(|point| point.0 >= 1e6 - 2.0 * series.each as f64));
    }
}
