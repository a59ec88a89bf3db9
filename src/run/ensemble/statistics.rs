//! Mean and spread of the members of an ensemble.
//!
//! Invariant: a member is forgotten once it is counted; what is kept does not grow with the size of a state.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::DMatrix;

use super::SUCCEEDED;
use crate::log::messages::{BodyStatistics, EnsembleStatistics, Figures, Member, Quantiles};
use crate::run::summary::{BodySpread, EnsembleSummary};
use crate::solve::bodies::trajectory::BodySample;
use crate::solve::so::{self, Mat, Vector};
use crate::solve::state::State;

/// Where a member is: a body, or several.
pub(in crate::run) enum Place<const N: usize> {
    One(State<N>),
    Several(Vec<BodySample<N>>),
}

impl<const N: usize> Place<N> {
    /// Returns where a member ended; `None` if it says nothing of that in this dimension.
    pub(super) fn of_end(end: &Member) -> Option<Self> {
        if let Some(last) = &end.last {
            return last.point().map(Self::One);
        }
        let bodies = end.bodies.iter().map(|body| body.last.as_ref()?.body());
        bodies.collect::<Option<_>>().map(Self::Several)
    }
}

/// Sums over where members are.
#[derive(Default)]
pub(super) struct Spreads<const N: usize> {
    count: u64,
    one: Spread<N>,
    several: Vec<SpreadOfBody<N>>,
}

impl<const N: usize> Spreads<N> {
    pub(super) fn add(&mut self, place: &Place<N>) {
        self.count += 1;
        match place {
            Place::One(state) => self.one.add(state),
            Place::Several(bodies) => {
                self.several.resize_with(bodies.len(), SpreadOfBody::default);
                for (spread, body) in self.several.iter_mut().zip(bodies) {
                    spread.add(body);
                }
            }
        }
    }

    /// Returns mean and spread; those of several bodies have these names.
    pub(super) fn statistics(&self, bodies: &[String]) -> EnsembleStatistics {
        if bodies.is_empty() {
            return self.one.statistics();
        }
        let of_body = |(name, spread): (&String, &SpreadOfBody<N>)| spread.statistics(name);
        EnsembleStatistics {
            members: self.count,
            bodies: bodies.iter().zip(&self.several).map(of_body).collect(),
            ..EnsembleStatistics::default()
        }
    }
}

/// Sums over the states of one of several bodies.
#[derive(Default)]
struct SpreadOfBody<const N: usize> {
    turning: Spread<N>,
    position: SpreadOfVector<N>,
    velocity: SpreadOfVector<N>,
}

impl<const N: usize> SpreadOfBody<N> {
    fn add(&mut self, body: &BodySample<N>) {
        self.turning.add(&State { attitude: body.attitude, momentum: body.momentum });
        self.position.add(&body.position);
        self.velocity.add(&body.velocity);
    }

    fn statistics(&self, name: &str) -> BodyStatistics {
        let turning = self.turning.statistics();
        let ([mean_position, position_deviation], [mean_velocity, velocity_deviation]) =
            (self.position.statistics(), self.velocity.statistics());
        BodyStatistics {
            name: name.to_owned(),
            mean_attitude: turning.mean_attitude,
            attitude_spread_rad: turning.attitude_spread_rad,
            mean_body_momentum: turning.mean_body_momentum,
            body_momentum_deviation: turning.body_momentum_deviation,
            mean_position,
            position_deviation,
            mean_velocity,
            velocity_deviation,
        }
    }
}

/// Sums over vectors, each taken from the first.
struct SpreadOfVector<const N: usize> {
    first: Option<Vector<N>>,
    count: u64,
    sum: Vector<N>,
    squares: Vector<N>,
}

impl<const N: usize> Default for SpreadOfVector<N> {
    fn default() -> Self {
        Self { first: None, count: 0, sum: Vector::zeros(), squares: Vector::zeros() }
    }
}

impl<const N: usize> SpreadOfVector<N> {
    fn add(&mut self, x: &Vector<N>) {
        let from_first = x - *self.first.get_or_insert(*x);
        self.count += 1;
        self.sum += from_first;
        self.squares += from_first.component_mul(&from_first);
    }

    /// Returns their mean and the standard deviation of each component.
    fn statistics(&self) -> [Vec<f64>; 2] {
        let count = self.count.max(1) as f64;
        let mean = self.sum / count;
        let variance = self.squares / count - mean.component_mul(&mean);
        let first = self.first.unwrap_or_else(Vector::zeros);
        [first + mean, variance.map(|x| x.max(0.0).sqrt())].map(|x| x.as_slice().to_vec())
    }
}

/// Sums over states, each taken from the first: what they have in common would hide their
/// differences.
struct Spread<const N: usize> {
    first: Option<State<N>>,
    count: u64,
    turns: Mat<N>,
    /// The sum of |turn|_F^2 / 2.
    turns_squared: f64,
    momenta: Mat<N>,
    momenta_squared: Mat<N>,
}

impl<const N: usize> Default for Spread<N> {
    fn default() -> Self {
        let zero = Mat::zeros();
        Self {
            first: None,
            count: 0,
            turns: zero,
            turns_squared: 0.0,
            momenta: zero,
            momenta_squared: zero,
        }
    }
}

impl<const N: usize> Spread<N> {
    fn add(&mut self, state: &State<N>) {
        let first = self.first.get_or_insert_with(|| state.clone());
        let turn = state.attitude - first.attitude;
        let momentum = state.momentum - first.momentum;
        self.count += 1;
        self.turns += turn;
        self.turns_squared += so::inner(&turn, &turn);
        self.momenta += momentum;
        self.momenta_squared += momentum.component_mul(&momentum);
    }

    fn statistics(&self) -> EnsembleStatistics {
        let Some(first) = &self.first else {
            let zeros = vec![0.0; so::dimension(N)];
            return EnsembleStatistics {
                mean_body_momentum: zeros.clone(),
                body_momentum_deviation: zeros,
                ..EnsembleStatistics::default()
            };
        };
        let count = self.count as f64;
        let momentum = self.momenta / count;
        let variance = self.momenta_squared / count - momentum.component_mul(&momentum);
        // The same on both sides of the diagonal: vee does no more than pick.
        let deviation = so::vee(&variance.map(|x| x.max(0.0).sqrt()));
        let attitude = nearest_rotation(&(first.attitude + self.turns / count));
        let spread = attitude.map(|nearest| {
            let from_first = nearest - first.attitude;
            let squares = self.turns_squared - 2.0 * so::inner(&self.turns, &from_first)
                + count * so::inner(&from_first, &from_first);
            (squares.max(0.0) / count).sqrt()
        });
        EnsembleStatistics {
            members: self.count,
            mean_attitude: attitude.map_or_else(Vec::new, |g| g.transpose().as_slice().to_vec()),
            attitude_spread_rad: spread,
            mean_body_momentum: so::vee(&(first.momentum + momentum)),
            body_momentum_deviation: deviation,
            ..EnsembleStatistics::default()
        }
    }
}

/// The members that have ended.
#[derive(Default)]
pub(super) struct Ends<const N: usize> {
    /// Names of several bodies.
    bodies: Vec<String>,
    members: BTreeSet<u64>,
    steps: u64,
    /// Member 0.
    nominal: Option<Member>,
    arrived: Spreads<N>,
    energy: Vec<f64>,
    orthogonality: Vec<f64>,
    drift: Vec<f64>,
    /// Number of failed members, by code.
    failed: BTreeMap<String, u64>,
    /// Number of stopped members, by the pointer of the condition.
    stopped: BTreeMap<String, u64>,
}

impl<const N: usize> Ends<N> {
    /// Returns that none has ended, of bodies of these names if there are several.
    pub(super) fn none(bodies: &[String]) -> Self {
        Self { bodies: bodies.to_vec(), ..Self::default() }
    }

    pub(super) fn add(&mut self, end: Member) {
        self.members.insert(end.member);
        self.steps += end.steps;
        if let Some(condition) = end.stopped_by_pointer() {
            *self.stopped.entry(condition).or_default() += 1;
        }
        if end.outcome == SUCCEEDED {
            if let Some(place) = Place::of_end(&end) {
                self.arrived.add(&place);
            }
            let Figures { energy_max_abs_error, orthogonality_max, momentum_max_drift, .. } =
                end.figures.unwrap_or_default();
            self.energy.extend(energy_max_abs_error);
            self.orthogonality.extend(orthogonality_max);
            self.drift.extend(momentum_max_drift);
        } else {
            *self.failed.entry(end.outcome.clone()).or_default() += 1;
        }
        if end.member == 0 {
            self.nominal = Some(end);
        }
    }

    /// Returns the number of members.
    pub(super) fn count(&self) -> u64 {
        self.members.len() as u64
    }

    pub(super) fn contains(&self, member: u64) -> bool {
        self.members.contains(&member)
    }

    /// Returns the number of steps of all members.
    pub(super) fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns member 0, once it has ended.
    pub(super) fn nominal(&self) -> Option<&Member> {
        self.nominal.as_ref()
    }

    /// Returns the statistics of the members that succeeded, each where it ended.
    pub(super) fn statistics(&self, time_s: f64) -> EnsembleStatistics {
        EnsembleStatistics {
            time_s,
            failed: self.failed.values().sum(),
            energy_max_abs_error: quantiles(self.energy.clone()),
            orthogonality_max: quantiles(self.orthogonality.clone()),
            momentum_max_drift: quantiles(self.drift.clone()),
            ..self.arrived.statistics(&self.bodies)
        }
    }

    /// Returns their part of a summary.
    pub(super) fn summary(&self, statistics: &EnsembleStatistics) -> EnsembleSummary {
        let of_body = |body: &BodyStatistics| {
            let spread = BodySpread {
                attitude_spread_rad: body.attitude_spread_rad,
                body_momentum_deviation: body.body_momentum_deviation.clone(),
                position_deviation_m: body.position_deviation.clone(),
                velocity_deviation_m_s: body.velocity_deviation.clone(),
            };
            (body.name.clone(), spread)
        };
        EnsembleSummary {
            members: self.count(),
            succeeded: statistics.members,
            stopped: self.stopped.clone(),
            failed: self.failed.clone(),
            attitude_spread_rad: statistics.attitude_spread_rad,
            body_momentum_deviation: statistics.body_momentum_deviation.clone(),
            energy_max_abs_error: statistics.energy_max_abs_error.map(|values| values.largest),
            orthogonality_max: statistics.orthogonality_max.map(|values| values.largest),
            bodies: statistics.bodies.iter().map(of_body).collect(),
        }
    }
}

/// Returns the nearest rotation: of `U S V^T` it is `U diag(1, .., det(U V^T)) V^T`. `None` where
/// many are nearest.
fn nearest_rotation<const N: usize>(matrix: &Mat<N>) -> Option<Mat<N>> {
    let finite = matrix.iter().all(|x| x.is_finite());
    let matrix = finite.then(|| DMatrix::from_column_slice(N, N, matrix.as_slice()))?;
    let svd = matrix.try_svd(true, true, 5.0 * f64::EPSILON, 100 * N)?;
    let (mut u, v) = (svd.u?, svd.v_t?);
    let singular = svd.singular_values.as_slice();
    let mirrored = (&u * &v).determinant() < 0.0;
    if mirrored {
        u.column_mut(N - 1).neg_mut();
    }
    // The choice must not depend on rounding.
    let last = if mirrored { -singular[N - 1] } else { singular[N - 1] };
    (singular[N - 2] + last > 1e-6).then(|| Mat::from_column_slice((u * v).as_slice()))
}

fn quantiles(mut values: Vec<f64>) -> Option<Quantiles> {
    values.sort_unstable_by(f64::total_cmp);
    // The least value that this part of them does not exceed.
    let at = |part: f64| values[(part * (values.len() - 1) as f64).ceil() as usize];
    (!values.is_empty()).then(|| Quantiles {
        least: at(0.0),
        median: at(0.5),
        percentile_95: at(0.95),
        largest: at(1.0),
    })
}
