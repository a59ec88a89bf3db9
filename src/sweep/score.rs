//! The scores of a sweep, taken sample by sample.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::file::{Condition, Lyapunov, Measure, Quantity, Score, Tilt};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::so::{self, Mat};
use crate::solve::state::State;
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::trajectory::Sample;

/// A score during a run.
pub(super) enum Tally<'a, const N: usize> {
    Largest(Gauge<N>, Option<f64>),
    Smallest(Gauge<N>, Option<f64>),
    FirstTime(Gauge<N>, &'a Condition, Option<f64>),
    Exponent(Box<Shadow<'a, N>>),
}

impl<'a, const N: usize> Tally<'a, N> {
    /// Returns the tallies of the scores; a Lyapunov exponent takes the shadow.
    pub(super) fn all(scores: &'a [Score], mut shadow: Option<Shadow<'a, N>>) -> Vec<Self> {
        let tally = |score: &'a Score| {
            Some(match &score.measure {
                Measure::Largest(quantity) => Self::Largest(Gauge::of(quantity), None),
                Measure::Smallest(quantity) => Self::Smallest(Gauge::of(quantity), None),
                Measure::FirstTime(condition) => {
                    Self::FirstTime(Gauge::of(&condition.of), condition, None)
                }
                Measure::LyapunovExponent(_) => Self::Exponent(Box::new(shadow.take()?)),
            })
        };
        scores.iter().filter_map(tally).collect()
    }

    pub(super) fn note(&mut self, body: &RigidBody<N>, sample: &Sample<N>) {
        let kept = |old: &mut Option<f64>, new: Option<f64>, better: fn(f64, f64) -> f64| {
            if let Some(new) = new {
                *old = Some(old.map_or(new, |old| better(old, new)));
            }
        };
        match self {
            Self::Largest(gauge, value) => kept(value, gauge.read(sample), f64::max),
            Self::Smallest(gauge, value) => kept(value, gauge.read(sample), f64::min),
            Self::FirstTime(gauge, Condition { above, below, .. }, time_s) => {
                let beyond = |x: f64| {
                    above.is_some_and(|limit| x > limit) || below.is_some_and(|limit| x < limit)
                };
                if time_s.is_none() && gauge.read(sample).is_some_and(beyond) {
                    *time_s = Some(sample.time_s);
                }
            }
            Self::Exponent(shadow) => shadow.note(body, sample),
        }
    }

    /// Returns the cell of a run that has ended; `completed` if it made all its steps.
    pub(super) fn value(&self, completed: bool) -> Option<f64> {
        match self {
            Self::Largest(_, value) | Self::Smallest(_, value) | Self::FirstTime(_, _, value) => {
                *value
            }
            Self::Exponent(shadow) => shadow.exponent().filter(|_| completed),
        }
    }
}

/// A quantity that a sample has; vectors of length one.
pub(super) enum Gauge<const N: usize> {
    Tilt { body: [f64; N], space: [f64; N] },
    AngularSpeed,
    KineticEnergy,
    AxisError,
}

impl<const N: usize> Gauge<N> {
    fn of(quantity: &Quantity) -> Self {
        let unit = |axis: &[f64]| {
            // Divided by the largest first, so that no square is lost.
            let largest = axis.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
            let length = axis.iter().map(|x| (x / largest) * (x / largest)).sum::<f64>().sqrt();
            std::array::from_fn(|i| axis[i] / largest / length)
        };
        match quantity {
            Quantity::Tilt(Tilt { body_axis, space_axis }) => {
                Self::Tilt { body: unit(body_axis), space: unit(space_axis) }
            }
            Quantity::AngularSpeed => Self::AngularSpeed,
            Quantity::KineticEnergy => Self::KineticEnergy,
            Quantity::AxisError => Self::AxisError,
        }
    }

    /// Returns the value at a sample; `None` without an attitude, where one is needed.
    fn read(&self, sample: &Sample<N>) -> Option<f64> {
        match self {
            Self::Tilt { body, space } => {
                let g = sample.attitude?;
                let seen: [f64; N] =
                    std::array::from_fn(|i| (0..N).map(|j| g[(i, j)] * body[j]).sum());
                // Twice the angle of the half: exact next to 0 and to pi (Kahan 2006).
                let length = |sign: f64| {
                    let square = |(a, b): (&f64, &f64)| (a + sign * b) * (a + sign * b);
                    seen.iter().zip(space).map(square).sum::<f64>().sqrt()
                };
                Some(2.0 * libm::atan2(length(-1.0), length(1.0)))
            }
            Self::AngularSpeed => sample.angular_velocity.as_ref().map(norm),
            Self::KineticEnergy => sample.energy.map(|energy| energy.kinetic),
            Self::AxisError => sample.pointing.map(|pointed| pointed.axis_error_rad),
        }
    }
}

/// A trajectory that begins close to a run and is brought back at each sample: the growth of its
/// distance until then, as a logarithm and summed, is the exponent times the time (Benettin,
/// Galgani, Strelcyn 1976; with Giorgilli 1980, part 2).
///
/// The distance of two states is `(|g - g'|_F^2 / 2 + |I^-1 (mu - mu')|^2 / rate^2)^(1/2)`: for n = 3 the sine of the angle
/// between the attitudes, and the difference of the body velocities by how fast the body moves. Another one changes the
/// exponent of a run of time T by O(1 / T).
pub(super) struct Shadow<'a, const N: usize> {
    stepper: Box<dyn Stepper<N>>,
    knots: Knots,
    asked: &'a Lyapunov,
    step_s: f64,
    rate_rad_s: f64,
    /// Steps made, and the time of the sample that came last.
    made: u64,
    time_s: f64,
    /// Sum of the logarithms, and the time over which it was taken.
    sum: f64,
    over_s: f64,
    /// Whether it was lost.
    lost: bool,
}

impl<'a, const N: usize> Shadow<'a, N> {
    /// Farthest distance at which the equations of small distances hold.
    const FARTHEST: f64 = 1e-2;

    /// Creates the shadow; `rate_rad_s` is how fast the body moves at the start.
    pub(super) fn new(
        stepper: Box<dyn Stepper<N>>,
        asked: &'a Lyapunov,
        step_s: f64,
        rate_rad_s: f64,
    ) -> Self {
        // A body at rest without torques has no scale of its own.
        let rate_rad_s = if rate_rad_s > 0.0 { rate_rad_s } else { 1.0 };
        let (made, time_s, sum, over_s, lost) = (0, 0.0, 0.0, 0.0, false);
        let knots = Knots::default();
        Self { stepper, knots, asked, step_s, rate_rad_s, made, time_s, sum, over_s, lost }
    }

    /// Returns the mean so far, in 1/s.
    fn exponent(&self) -> Option<f64> {
        (!self.lost && self.over_s > 0.0).then(|| self.sum / self.over_s)
    }

    fn note(&mut self, body: &RigidBody<N>, sample: &Sample<N>) {
        let run = State {
            attitude: sample.attitude.unwrap_or_else(Mat::identity),
            momentum: sample.momentum,
        };
        let distance = self.asked.distance;
        if sample.step == 0 {
            // Begins in a direction that no symmetry of a scene singles out.
            let mut random = ChaCha8Rng::seed_from_u64(0);
            let mut somewhere = || {
                let normal =
                    (0..so::dimension(N)).map(|_| -> f64 { StandardNormal.sample(&mut random) });
                so::hat::<N>(&normal.collect::<Vec<f64>>())
            };
            let turn = somewhere();
            let turn = if sample.attitude.is_some() { turn } else { Mat::zeros() };
            let momentum = body.momentum(&(somewhere() * self.rate_rad_s));
            let length = self.length(body, &turn, &momentum);
            self.place(&run, &(turn * (distance / length)), &(momentum * (distance / length)));
            return;
        }
        while self.made < sample.step && !self.lost {
            let begun_s = self.made as f64 * self.step_s;
            let stepper = self.stepper.as_mut();
            self.lost = self.knots.step(body, stepper, begun_s, self.step_s).is_err()
                || self.stepper.synchronise(body, self.step_s).is_err();
            self.made += 1;
        }
        let attitude = self.stepper.attitude().unwrap_or(run.attitude);
        // The skew part of a small turn: the remainder is of third order.
        let turn = so::asym(&so::transposed_product(&run.attitude, &attitude)) * 0.5;
        let momentum = self.stepper.momentum() - run.momentum;
        let reached = self.length(body, &turn, &momentum);
        if self.lost || !(reached > 0.0 && reached < Self::FARTHEST) {
            self.lost = true;
            return;
        }
        if self.time_s >= self.asked.skip_s {
            self.sum += libm::log(reached / distance);
            self.over_s += sample.time_s - self.time_s;
        }
        self.time_s = sample.time_s;
        let back = distance / reached;
        self.place(&run, &(turn * back), &(momentum * back));
    }

    /// Returns the length of a small difference of two states.
    fn length(&self, body: &RigidBody<N>, turn: &Mat<N>, momentum: &Mat<N>) -> f64 {
        // Wheels have no part in a difference.
        let velocity = norm(&body.velocity_rate(momentum)) / self.rate_rad_s;
        (so::inner(turn, turn) + velocity * velocity).sqrt()
    }

    fn place(&mut self, run: &State<N>, turn: &Mat<N>, momentum: &Mat<N>) {
        self.stepper.start(&State {
            attitude: so::product(&run.attitude, &so::exp(turn)),
            momentum: run.momentum + momentum,
        });
    }
}

fn norm<const N: usize>(x: &Mat<N>) -> f64 {
    so::inner(x, x).sqrt()
}
