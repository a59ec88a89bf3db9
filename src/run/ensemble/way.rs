//! Motion of a member of an ensemble, in a few points that keep every extreme.

use crate::log::messages::Waypoints;
use crate::solve::so::{self, Mat};
use crate::solve::trajectory::Sample;

/// The points of one member as its samples come.
#[derive(Clone, Debug)]
pub(super) struct Way<const N: usize> {
    per_point: u64,
    samples: u64,
    /// Samples behind the next point.
    next: Option<Point<N>>,
    points: Waypoints,
}

/// The last of a few samples, and the largest figures of all of them.
#[derive(Clone, Debug)]
struct Point<const N: usize> {
    time_s: f64,
    attitude: Option<Mat<N>>,
    /// Least cosine of each axis, which is that of its largest angle.
    cosines: [f64; N],
    velocity_squared: Option<f64>,
    energy: Option<f64>,
    orthogonality: Option<f64>,
    drift: Option<f64>,
}

impl<const N: usize> Way<N> {
    /// Creates the way of a member whose points lie `per_point` samples apart.
    pub(super) fn new(per_point: u64) -> Self {
        Self { per_point, samples: 0, next: None, points: Waypoints::default() }
    }

    /// Takes a sample; the first is a point of its own.
    pub(super) fn keep(&mut self, sample: &Sample<N>) {
        let fresh = Point::of(sample);
        self.next = Some(match self.next.take() {
            Some(before) => fresh.after(&before),
            None => fresh,
        });
        if self.samples.is_multiple_of(self.per_point) {
            self.close();
        }
        self.samples += 1;
    }

    /// Returns all points; the last one ends with the last sample.
    pub(super) fn points(mut self) -> Waypoints {
        self.close();
        self.points
    }

    fn close(&mut self) {
        let Some(point) = self.next.take() else { return };
        // For a baseline that blows up it may be too large for single precision.
        let single = |x: f64| (x as f32).clamp(f32::MIN, f32::MAX);
        let points = &mut self.points;
        points.time_s.push(point.time_s);
        if let Some(attitude) = point.attitude {
            points.attitude.extend(attitude.transpose().iter().map(|x| single(*x)));
            let angles = point.cosines.map(|cosine| libm::acos(cosine.clamp(-1.0, 1.0)));
            points.axis_angle.extend(angles.map(single));
        }
        points.angular_velocity.extend(point.velocity_squared.map(|square| single(square.sqrt())));
        points.energy_error.extend(point.energy.map(single));
        points.orthogonality_error.extend(point.orthogonality.map(single));
        points.momentum_drift.extend(point.drift.map(single));
    }
}

impl<const N: usize> Point<N> {
    fn of(sample: &Sample<N>) -> Self {
        let attitude = sample.attitude;
        Self {
            time_s: sample.time_s,
            attitude,
            cosines: std::array::from_fn(|k| attitude.map_or(1.0, |g| g[(k, k)])),
            velocity_squared: sample.angular_velocity.map(|omega| so::inner(&omega, &omega)),
            energy: sample.energy_error,
            orthogonality: sample.orthogonality_error,
            drift: sample.momentum_drift,
        }
    }

    fn after(self, before: &Self) -> Self {
        let larger = |old: Option<f64>, new: Option<f64>| match (old, new) {
            (Some(old), Some(new)) => Some(if new.abs() > old.abs() { new } else { old }),
            (old, new) => new.or(old),
        };
        Self {
            cosines: std::array::from_fn(|k| self.cosines[k].min(before.cosines[k])),
            velocity_squared: larger(before.velocity_squared, self.velocity_squared),
            energy: larger(before.energy, self.energy),
            orthogonality: larger(before.orthogonality, self.orthogonality),
            drift: larger(before.drift, self.drift),
            ..self
        }
    }
}
