//! The course of a quantity over a log, in few points that keep every extreme: for charts that people ask for.
//!
//! Invariant: memory is bounded by what is asked for, however long the log is; a point holds the smallest and the largest
//! of the samples behind it, so no peak is lost.

use std::fs::File;
use std::ops::{ControlFlow, Range};
use std::path::Path;

use prost::Message as _;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::LogError;
use super::messages::{Energy, Momentum, Orthogonality, State};
use super::reader::{self, Item};
use super::schema::Channel;
use super::stretch::{messages, start_and_end, summary};

/// What a chart shows over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Curve {
    /// Total energy minus that at the start, in joule.
    EnergyError,
    /// Distance of the attitude from the group.
    OrthogonalityError,
    /// Change of the part of the spatial momentum that the scene conserves, in kg m^2/s.
    MomentumDrift,
    /// In body coordinates, in rad/s.
    AngularVelocity,
    /// Angular momentum in body coordinates, in kg m^2/s.
    BodyMomentum,
    /// Angular momentum in space coordinates, in kg m^2/s.
    SpatialMomentum,
    /// Of each axis of the body to the axis of space of the same number, in rad.
    AxisAngle,
}

impl Curve {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::EnergyError,
        Self::OrthogonalityError,
        Self::MomentumDrift,
        Self::AngularVelocity,
        Self::BodyMomentum,
        Self::SpatialMomentum,
        Self::AxisAngle,
    ];

    /// Its name in questions and answers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::EnergyError => "energy_error",
            Self::OrthogonalityError => "orthogonality_error",
            Self::MomentumDrift => "momentum_drift",
            Self::AngularVelocity => "angular_velocity",
            Self::BodyMomentum => "body_momentum",
            Self::SpatialMomentum => "spatial_momentum",
            Self::AxisAngle => "axis_angle",
        }
    }

    /// The unit of its values; empty for a number.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::EnergyError => "J",
            Self::OrthogonalityError => "",
            Self::AngularVelocity => "rad/s",
            Self::AxisAngle => "rad",
            Self::MomentumDrift | Self::BodyMomentum | Self::SpatialMomentum => "kg m²/s",
        }
    }

    /// The channel whose messages say it.
    pub const fn channel(self) -> Channel {
        match self {
            Self::EnergyError => Channel::Energy,
            Self::OrthogonalityError => Channel::Orthogonality,
            Self::MomentumDrift | Self::SpatialMomentum => Channel::Momentum,
            Self::AngularVelocity | Self::BodyMomentum | Self::AxisAngle => Channel::State,
        }
    }

    /// What a message of its channel says; nothing if it does not say it.
    fn values(self, data: &[u8], velocity: Velocity<'_>) -> Vec<f64> {
        let read = |state: fn(State) -> Vec<f64>| State::decode(data).map(state);
        let read = match self {
            Self::EnergyError => Energy::decode(data).map(|energy| vec![energy.error]),
            Self::OrthogonalityError => Orthogonality::decode(data).map(|found| vec![found.error]),
            Self::MomentumDrift => {
                Momentum::decode(data).map(|momentum| momentum.drift.into_iter().collect())
            }
            Self::SpatialMomentum => {
                Momentum::decode(data).map(|momentum| momentum.spatial_momentum)
            }
            Self::BodyMomentum => read(|state| state.body_momentum),
            Self::AngularVelocity => State::decode(data).map(|state| {
                // Logs of builds before have the momentum alone.
                let found = state.angular_velocity;
                if found.is_empty() { velocity(&state.body_momentum) } else { found }
            }),
            Self::AxisAngle => read(|state| {
                let n = state.attitude.len().isqrt();
                let cosine = |k: usize| state.attitude[k * (n + 1)].clamp(-1.0, 1.0);
                (0..n).map(|k| libm::acos(cosine(k))).collect()
            }),
        };
        read.unwrap_or_default()
    }
}

/// The angular velocity of a momentum, both in body coordinates.
pub type Velocity<'a> = &'a (dyn Fn(&[f64]) -> Vec<f64> + Sync);

/// A part of a log in time, and in how many points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Its beginning in seconds.
    pub from_s: f64,
    /// Its end in seconds, at most.
    pub to_s: f64,
    /// Points, at most.
    pub points: usize,
}

/// The course of a quantity.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Samples {
    /// What it is the course of.
    pub channel: Curve,
    /// The unit of the values; empty for a number.
    pub unit: &'static str,
    /// Time of the first sample behind each point, in seconds.
    pub time_s: Vec<f64>,
    /// The smallest value behind each point, one list a component.
    pub low: Vec<Vec<f64>>,
    /// The largest value behind each point, one list a component.
    pub high: Vec<Vec<f64>>,
    /// Samples behind a point, at most.
    pub each: u64,
    /// Time of the last sample of the log in seconds; absent while it is being written.
    pub end_s: Option<f64>,
    /// Samples behind the last point.
    #[serde(skip)]
    held: u64,
}

/// Messages of a log from which on several threads read it: each a part of the time.
const LONG: u64 = 50_000;

/// Threads that read one log, at most.
const MOST_THREADS: usize = 4;

/// Reads the course of a quantity, of an ensemble that of member 0. Of an unfinished log what stands in whole chunks.
/// `None` if `stopped` said so on the way.
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
    let reading = |span, points| Reading {
        samples: Samples::new(curve),
        span,
        points,
        velocity,
        stopped,
        seen: 0,
    };
    // A log that grows ends nowhere in particular: what its end looks like means nothing.
    let Ok(Some(summary)) = summary(&mut file) else {
        let mut reading = reading(whole, window.points);
        let (mut start_ns, mut stop) = (None, Ok(()));
        reader::read(path, |item| {
            let Item::Message { topic, time_ns, data, .. } = item else {
                return ControlFlow::Continue(());
            };
            // Whatever comes first is of the start.
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
        return Ok(stop.ok().map(|()| reading.samples));
    };
    let (start_ns, end_ns) = start_and_end(&summary);
    let whole = whole.start..whole.end.min((end_ns - start_ns).saturating_add(1));
    let length = whole.end.saturating_sub(whole.start);
    let threads = match summary.stats.as_ref().map_or(0, |stats| stats.message_count) {
        LONG.. => std::thread::available_parallelism().map_or(1, usize::from).min(MOST_THREADS),
        _ => 1,
    };
    let threads = threads.min(window.points / 2).max(1);
    let border = |k: usize| whole.start + (u128::from(length) * k as u128 / threads as u128) as u64;
    let one = |k: usize| {
        let mut reading = reading(border(k)..border(k + 1), window.points / threads);
        let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
        let (from_ns, mut stop) = (start_ns.saturating_add(reading.span.start), Ok(()));
        messages(&mut file, &summary, &[curve.channel().topic()], from_ns, |time_ns, data| {
            let since_ns = time_ns.saturating_sub(start_ns);
            stop = reading.note(since_ns, data);
            if stop.is_err() || reading.is_over(since_ns) {
                return ControlFlow::Break(());
            }
            ControlFlow::Continue(())
        })
        .map_err(|source| LogError::mcap(path, "read", source))?;
        Ok(stop.ok().map(|()| reading.samples))
    };
    let parts: Vec<Result<Option<Samples>, LogError>> = std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads).map(|k| scope.spawn(move || one(k))).collect();
        let first = one(0);
        let joined = others.into_iter().map(|other| match other.join() {
            Ok(part) => part,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        std::iter::once(first).chain(joined).collect()
    });
    let mut all = Samples::new(curve);
    for part in parts {
        let Some(part) = part? else { return Ok(None) };
        all.append(part);
    }
    Ok(Some(Samples { end_s: Some((end_ns - start_ns) as f64 * 1e-9), ..all }))
}

/// One part of a log on its way into points.
struct Reading<'a> {
    samples: Samples,
    /// In nanoseconds since the start.
    span: Range<u64>,
    points: usize,
    velocity: Velocity<'a>,
    stopped: &'a (dyn Fn() -> bool + Sync),
    seen: u64,
}

/// Nobody waits any more.
struct Stopped;

impl Reading<'_> {
    /// Takes a message of the channel at a time since the start.
    fn note(&mut self, since_ns: u64, data: &[u8]) -> Result<(), Stopped> {
        self.seen += 1;
        if self.seen.is_multiple_of(1 << 10) && (self.stopped)() {
            return Err(Stopped);
        }
        if self.span.contains(&since_ns) {
            let values = self.samples.channel.values(data, self.velocity);
            self.samples.push(since_ns as f64 * 1e-9, &values, self.points);
        }
        Ok(())
    }

    /// Whether nothing of the part comes at or after a time.
    fn is_over(&self, since_ns: u64) -> bool {
        since_ns >= self.span.end
    }
}

impl Samples {
    fn new(curve: Curve) -> Self {
        Self {
            channel: curve,
            unit: curve.unit(),
            time_s: Vec::new(),
            low: Vec::new(),
            high: Vec::new(),
            each: 1,
            end_s: None,
            held: 1,
        }
    }

    /// Takes the points of the part that follows.
    fn append(&mut self, part: Self) {
        if self.time_s.is_empty() {
            *self = part;
            return;
        }
        self.each = self.each.max(part.each);
        self.time_s.extend(part.time_s);
        for (mine, others) in [(&mut self.low, part.low), (&mut self.high, part.high)] {
            mine.iter_mut().zip(others).for_each(|(mine, other)| mine.extend(other));
        }
    }

    /// Takes a sample; two neighbours become one point each time there are too many.
    fn push(&mut self, time_s: f64, values: &[f64], limit: usize) {
        if self.time_s.is_empty() {
            self.low = vec![Vec::new(); values.len()];
            self.high = self.low.clone();
        }
        if values.len() != self.low.len() || values.is_empty() {
            return;
        }
        let lines = self.low.iter_mut().zip(&mut self.high).zip(values);
        if self.held < self.each {
            self.held += 1;
            for ((low, high), &value) in lines {
                if let Some((low, high)) = low.last_mut().zip(high.last_mut()) {
                    (*low, *high) = (low.min(value), high.max(value));
                }
            }
            return;
        }
        if self.time_s.len() >= limit.max(2) {
            self.time_s = self.time_s.iter().step_by(2).copied().collect();
            for (lines, keep) in
                [(&mut self.low, f64::min as fn(f64, f64) -> f64), (&mut self.high, f64::max)]
            {
                for line in lines {
                    let pairs = line.chunks(2).map(|pair| pair.iter().copied().reduce(keep));
                    *line = pairs.flatten().collect();
                }
            }
            self.each *= 2;
            // Of an odd number the last one has room for as many again.
            if limit.max(2) % 2 == 1 {
                self.held = self.each / 2;
                return self.push(time_s, values, limit);
            }
        }
        self.held = 1;
        self.time_s.push(time_s);
        for ((low, high), &value) in self.low.iter_mut().zip(&mut self.high).zip(values) {
            low.push(value);
            high.push(value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Curve, Samples};

    #[test]
    fn every_extreme_is_kept_in_as_many_points_as_asked_for() {
        for limit in [2, 3, 7, 500] {
            let mut samples = Samples::new(Curve::BodyMomentum);
            let value = |k: u32| if k == 77_777 { -5.0 } else { f64::from(k % 7) };
            for k in 0..100_000 {
                samples.push(f64::from(k), &[value(k), -value(k)], limit);
            }
            let count = samples.time_s.len();
            assert!(count <= limit && count > limit / 2, "{count} of {limit}");
            for line in samples.low.iter().chain(&samples.high) {
                assert_eq!(line.len(), count);
            }
            let least = |line: &[f64]| line.iter().copied().fold(f64::INFINITY, f64::min);
            assert_eq!((least(&samples.low[0]), least(&samples.low[1])), (-5.0, -6.0));
            for (k, time_s) in samples.time_s.iter().enumerate() {
                assert_eq!(*time_s, k as f64 * samples.each as f64);
            }
            // The peak stands where it was.
            let peak = samples.low[0].iter().position(|low| *low == -5.0).expect("kept");
            let since = 77_777.0 - samples.time_s[peak];
            assert!(since >= 0.0 && since < samples.each as f64);
        }
    }

    #[test]
    fn names_are_those_of_answers() {
        for curve in Curve::ALL {
            assert_eq!(serde_json::to_value(curve).expect("a name"), curve.name());
        }
    }
}
