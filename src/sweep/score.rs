//! The scores of a sweep, taken sample by sample.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::file::{Condition, Lyapunov, Measure, Quantity, Score, Separation, Tilt};
use crate::plan::bodies::sites;
use crate::scenario::Bodies;
use crate::solve::bodies::trajectory as bodies;
use crate::solve::bodies::{Site, distance};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::so::{self, Mat};
use crate::solve::state::State;
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::trajectory::Sample;

/// A score during a run.
pub(super) enum Tally<'a, const N: usize> {
    Of(Gauge<N>, Kept<'a>),
    Exponent(Box<Shadow<'a, N>>),
}

impl<'a, const N: usize> Tally<'a, N> {
    /// Returns the tallies of the scores; a Lyapunov exponent takes the shadow.
    pub(super) fn all(scores: &'a [Score], mut shadow: Option<Shadow<'a, N>>) -> Vec<Self> {
        let tally = |score: &'a Score| match Kept::of(&score.measure) {
            Some((quantity, kept)) => Some(Self::Of(Gauge::of(quantity)?, kept)),
            None => Some(Self::Exponent(Box::new(shadow.take()?))),
        };
        scores.iter().filter_map(tally).collect()
    }

    pub(super) fn note(&mut self, body: &RigidBody<N>, sample: &Sample<N>) {
        match self {
            Self::Of(gauge, kept) => kept.take(sample.time_s, || gauge.read(sample)),
            Self::Exponent(shadow) => shadow.note(body, sample),
        }
    }

    /// Returns the cell of a run that has ended; `completed` if it made all its steps.
    pub(super) fn value(&self, completed: bool) -> Option<f64> {
        match self {
            Self::Of(_, kept) => kept.value(),
            Self::Exponent(shadow) => shadow.exponent().filter(|_| completed),
        }
    }
}

/// A score of several bodies during a run.
pub(super) struct BodiesTally<'a, const N: usize> {
    gauge: BodiesGauge<N>,
    kept: Kept<'a>,
}

impl<'a, const N: usize> BodiesTally<'a, N> {
    /// Returns the tallies of the scores.
    pub(super) fn all(scores: &'a [Score], scene: &Bodies) -> Vec<Self> {
        let tally = |score: &'a Score| {
            let (quantity, kept) = Kept::of(&score.measure)?;
            let body = score.body.as_ref().and_then(|name| scene.number(name));
            Some(Self { gauge: BodiesGauge::of(quantity, body, scene)?, kept })
        };
        scores.iter().filter_map(tally).collect()
    }

    pub(super) fn note(&mut self, sample: &bodies::Sample<N>) {
        let Self { gauge, kept } = self;
        kept.take(sample.time_s, || gauge.read(sample));
    }

    /// Returns the cell of a run that has ended.
    pub(super) fn value(&self) -> Option<f64> {
        self.kept.value()
    }
}

/// What is kept of the values of a quantity.
pub(super) enum Kept<'a> {
    Largest(Option<f64>),
    Smallest(Option<f64>),
    Last(Option<f64>),
    /// The first time in s at which a condition held.
    FirstTime(&'a Condition, Option<f64>),
    /// The time in s since which a condition has held.
    SettledTime(&'a Condition, Option<f64>),
}

impl<'a> Kept<'a> {
    /// Returns the quantity of a measure, and that nothing is kept of it yet; `None` for a measure of another kind.
    fn of(measure: &'a Measure) -> Option<(&'a Quantity, Self)> {
        let kept = match measure {
            Measure::Largest(_) => Self::Largest(None),
            Measure::Smallest(_) => Self::Smallest(None),
            Measure::Last(_) => Self::Last(None),
            Measure::FirstTime(condition) => Self::FirstTime(condition, None),
            Measure::SettledTime(condition) => Self::SettledTime(condition, None),
            Measure::LyapunovExponent(_) => return None,
        };
        Some((measure.quantity()?, kept))
    }

    fn take(&mut self, time_s: f64, value: impl FnOnce() -> Option<f64>) {
        let kept = |old: &mut Option<f64>, new: Option<f64>, better: fn(f64, f64) -> f64| {
            if let Some(new) = new {
                *old = Some(old.map_or(new, |old| better(old, new)));
            }
        };
        match self {
            Self::Largest(old) => kept(old, value(), f64::max),
            Self::Smallest(old) => kept(old, value(), f64::min),
            Self::Last(last) => *last = value(),
            Self::FirstTime(condition, first_s) => {
                if first_s.is_none() && value().is_some_and(|x| condition.holds(x)) {
                    *first_s = Some(time_s);
                }
            }
            Self::SettledTime(condition, since_s) => {
                let holds = value().is_some_and(|x| condition.holds(x));
                *since_s = holds.then(|| since_s.unwrap_or(time_s));
            }
        }
    }

    fn value(&self) -> Option<f64> {
        match self {
            Self::Largest(value)
            | Self::Smallest(value)
            | Self::Last(value)
            | Self::FirstTime(_, value)
            | Self::SettledTime(_, value) => *value,
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
    /// Returns what reads a quantity; `None` if one body does not have it.
    fn of(quantity: &Quantity) -> Option<Self> {
        Some(match quantity {
            Quantity::Tilt(Tilt { body_axis, space_axis }) => {
                Self::Tilt { body: unit(body_axis), space: unit(space_axis) }
            }
            Quantity::AngularSpeed => Self::AngularSpeed,
            Quantity::KineticEnergy => Self::KineticEnergy,
            Quantity::AxisError => Self::AxisError,
            Quantity::Distance(_) => return None,
        })
    }

    /// Returns the value at a sample; `None` without an attitude, where one is needed.
    fn read(&self, sample: &Sample<N>) -> Option<f64> {
        match self {
            Self::Tilt { body, space } => Some(tilt(sample.attitude.as_ref()?, body, space)),
            Self::AngularSpeed => sample.angular_velocity.as_ref().map(norm),
            Self::KineticEnergy => sample.energy.map(|energy| energy.kinetic),
            Self::AxisError => sample.pointing.map(|pointed| pointed.axis_error_rad),
        }
    }
}

/// A quantity that a sample of several bodies has; bodies by number.
enum BodiesGauge<const N: usize> {
    Tilt { of: usize, body: [f64; N], space: [f64; N] },
    AngularSpeed(usize),
    KineticEnergy,
    Distance([Site<N>; 2]),
}

impl<const N: usize> BodiesGauge<N> {
    /// Returns what reads a quantity, that of a body; `None` if several bodies do not have it.
    fn of(quantity: &Quantity, body: Option<usize>, scene: &Bodies) -> Option<Self> {
        Some(match quantity {
            Quantity::Tilt(Tilt { body_axis, space_axis }) => {
                Self::Tilt { of: body?, body: unit(body_axis), space: unit(space_axis) }
            }
            Quantity::AngularSpeed => Self::AngularSpeed(body?),
            Quantity::KineticEnergy => Self::KineticEnergy,
            Quantity::Distance(Separation { between, points }) => {
                Self::Distance(sites(scene, between, points.as_ref()))
            }
            Quantity::AxisError => return None,
        })
    }

    fn read(&self, sample: &bodies::Sample<N>) -> Option<f64> {
        match self {
            Self::Tilt { of, body, space } => {
                Some(tilt(&sample.bodies.get(*of)?.attitude, body, space))
            }
            Self::AngularSpeed(of) => Some(norm(&sample.bodies.get(*of)?.angular_velocity)),
            Self::KineticEnergy => sample.energy.map(|energy| energy.kinetic),
            Self::Distance(sites) => Some(distance(sites, &sample.bodies)),
        }
    }
}

/// Returns an axis of length one.
fn unit<const N: usize>(axis: &[f64]) -> [f64; N] {
    // Divided by the largest first, so that no square is lost.
    let largest = axis.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
    let length = axis.iter().map(|x| (x / largest) * (x / largest)).sum::<f64>().sqrt();
    std::array::from_fn(|i| axis[i] / largest / length)
}

/// Returns the angle between an axis of the body and one of space.
fn tilt<const N: usize>(g: &Mat<N>, body: &[f64; N], space: &[f64; N]) -> f64 {
    let seen: [f64; N] = std::array::from_fn(|i| (0..N).map(|j| g[(i, j)] * body[j]).sum());
    // Twice the angle of the half: exact next to 0 and to pi (Kahan 2006).
    let length = |sign: f64| {
        let square = |(a, b): (&f64, &f64)| (a + sign * b) * (a + sign * b);
        seen.iter().zip(space).map(square).sum::<f64>().sqrt()
    };
    2.0 * libm::atan2(length(-1.0), length(1.0))
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
