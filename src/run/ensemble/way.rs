//! Motion of a member of an ensemble, in a few points that keep every extreme.

use crate::log::messages::{BodyWaypoints, Waypoints};
use crate::solve::bodies::trajectory as bodies;
use crate::solve::so::{self, Mat, Vector};
use crate::solve::trajectory::Sample;

/// The points of one member as its samples come.
#[derive(Clone, Debug)]
pub(super) struct Way<const N: usize> {
    per_point: u64,
    samples: u64,
    /// Samples behind the next point.
    next: Option<Point>,
    /// Of each body likewise.
    turned: Vec<Turned<N>>,
    points: Waypoints,
    bodies: Vec<BodyWaypoints>,
}

/// The last of a few samples, and the largest figures of all of them.
#[derive(Clone, Debug)]
struct Point {
    time_s: f64,
    energy: Option<f64>,
    orthogonality: Option<f64>,
    drift: Option<f64>,
}

/// A body in it.
#[derive(Clone, Debug)]
struct Turned<const N: usize> {
    attitude: Option<Mat<N>>,
    /// Least cosine of each axis, which is that of its largest angle.
    cosines: [f64; N],
    velocity_squared: Option<f64>,
    position: Option<Vector<N>>,
}

impl<const N: usize> Way<N> {
    /// Creates the way of a member whose points lie `per_point` samples apart.
    pub(super) fn new(per_point: u64) -> Self {
        let (turned, bodies) = (Vec::new(), Vec::new());
        Self { per_point, samples: 0, next: None, turned, points: Waypoints::default(), bodies }
    }

    /// Takes a sample; the first is a point of its own.
    pub(super) fn keep(&mut self, sample: &Sample<N>) {
        let point = Point {
            time_s: sample.time_s,
            energy: sample.energy_error,
            orthogonality: sample.orthogonality_error,
            drift: sample.momentum_drift,
        };
        let turned = Turned::of(sample.attitude, sample.angular_velocity.as_ref(), None);
        self.keep_point(point, std::iter::once(turned));
    }

    /// Takes a sample of several bodies.
    pub(super) fn keep_bodies(&mut self, sample: &bodies::Sample<N>) {
        let point = Point {
            time_s: sample.time_s,
            energy: sample.energy_error,
            orthogonality: sample.orthogonality_error,
            drift: sample.momentum_drift,
        };
        let turned = |body: &bodies::BodySample<N>| {
            Turned::of(Some(body.attitude), Some(&body.angular_velocity), Some(body.position))
        };
        self.keep_point(point, sample.bodies.iter().map(turned));
    }

    fn keep_point(&mut self, fresh: Point, turned: impl Iterator<Item = Turned<N>>) {
        match self.next.take() {
            Some(before) => {
                self.next = Some(fresh.after(&before));
                for (before, turned) in self.turned.iter_mut().zip(turned) {
                    *before = turned.after(before);
                }
            }
            None => {
                self.next = Some(fresh);
                self.turned.clear();
                self.turned.extend(turned);
            }
        }
        if self.samples.is_multiple_of(self.per_point) {
            self.close();
        }
        self.samples += 1;
    }

    /// Returns all points; the last one ends with the last sample.
    pub(super) fn points(mut self) -> Waypoints {
        self.close();
        let Self { points, bodies, .. } = self;
        let BodyWaypoints { attitude, axis_angle, angular_velocity, .. } =
            bodies.into_iter().next().unwrap_or_default();
        Waypoints { attitude, axis_angle, angular_velocity, ..points }
    }

    /// Returns the same of several bodies, and the points of each.
    pub(super) fn points_of_bodies(mut self) -> (Waypoints, Vec<BodyWaypoints>) {
        self.close();
        (self.points, self.bodies)
    }

    fn close(&mut self) {
        let Some(point) = self.next.take() else { return };
        // For a baseline that blows up it may be too large for single precision.
        let single = |x: f64| (x as f32).clamp(f32::MIN, f32::MAX);
        let points = &mut self.points;
        points.time_s.push(point.time_s);
        points.energy_error.extend(point.energy.map(single));
        points.orthogonality_error.extend(point.orthogonality.map(single));
        points.momentum_drift.extend(point.drift.map(single));
        self.bodies.resize_with(self.turned.len(), BodyWaypoints::default);
        for (points, turned) in self.bodies.iter_mut().zip(&self.turned) {
            if let Some(attitude) = turned.attitude {
                points.attitude.extend(attitude.transpose().iter().map(|x| single(*x)));
                let angles = turned.cosines.map(|cosine| libm::acos(cosine.clamp(-1.0, 1.0)));
                points.axis_angle.extend(angles.map(single));
            }
            let velocity = turned.velocity_squared.map(|square| single(square.sqrt()));
            points.angular_velocity.extend(velocity);
            points.position.extend(turned.position.iter().flatten().map(|x| single(*x)));
        }
    }
}

fn larger(old: Option<f64>, new: Option<f64>) -> Option<f64> {
    match (old, new) {
        (Some(old), Some(new)) => Some(if new.abs() > old.abs() { new } else { old }),
        (old, new) => new.or(old),
    }
}

impl Point {
    fn after(self, before: &Self) -> Self {
        Self {
            energy: larger(before.energy, self.energy),
            orthogonality: larger(before.orthogonality, self.orthogonality),
            drift: larger(before.drift, self.drift),
            ..self
        }
    }
}

impl<const N: usize> Turned<N> {
    fn of(
        attitude: Option<Mat<N>>,
        velocity: Option<&Mat<N>>,
        position: Option<Vector<N>>,
    ) -> Self {
        Self {
            attitude,
            cosines: std::array::from_fn(|k| attitude.map_or(1.0, |g| g[(k, k)])),
            velocity_squared: velocity.map(|omega| so::inner(omega, omega)),
            position,
        }
    }

    fn after(self, before: &Self) -> Self {
        Self {
            cosines: std::array::from_fn(|k| self.cosines[k].min(before.cosines[k])),
            velocity_squared: larger(before.velocity_squared, self.velocity_squared),
            ..self
        }
    }
}
