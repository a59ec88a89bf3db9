//! Mean and spread of the members of an ensemble.
//!
//! Invariant: a member is forgotten once it is counted; what is kept does not grow with the size of a state.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::DMatrix;

use super::SUCCEEDED;
use crate::log::messages::{EnsembleStatistics, Figures, Member, Quantiles};
use crate::run::summary::EnsembleSummary;
use crate::solve::so::{self, Mat};
use crate::solve::state::State;

/// Sums over states, each taken from the first: what they have in common would hide their
/// differences.
pub(super) struct Spread<const N: usize> {
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
    pub(super) fn add(&mut self, state: &State<N>) {
        let first = self.first.get_or_insert_with(|| state.clone());
        let turn = state.attitude - first.attitude;
        let momentum = state.momentum - first.momentum;
        self.count += 1;
        self.turns += turn;
        self.turns_squared += so::inner(&turn, &turn);
        self.momenta += momentum;
        self.momenta_squared += momentum.component_mul(&momentum);
    }

    pub(super) fn statistics(&self) -> EnsembleStatistics {
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
    members: BTreeSet<u64>,
    steps: u64,
    /// Member 0.
    nominal: Option<Member>,
    arrived: Spread<N>,
    energy: Vec<f64>,
    orthogonality: Vec<f64>,
    drift: Vec<f64>,
    /// Number of failed members, by code.
    failed: BTreeMap<String, u64>,
    /// Number of stopped members, by the pointer of the condition.
    stopped: BTreeMap<String, u64>,
}

impl<const N: usize> Ends<N> {
    pub(super) fn add(&mut self, end: Member) {
        self.members.insert(end.member);
        self.steps += end.steps;
        if let Some(condition) = end.stopped_by_pointer() {
            *self.stopped.entry(condition).or_default() += 1;
        }
        if end.outcome == SUCCEEDED {
            if let Some(state) = end.last.as_ref().and_then(|last| last.point()) {
                self.arrived.add(&state);
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
            ..self.arrived.statistics()
        }
    }

    /// Returns their part of a summary.
    pub(super) fn summary(&self, statistics: &EnsembleStatistics) -> EnsembleSummary {
        EnsembleSummary {
            members: self.count(),
            succeeded: statistics.members,
            stopped: self.stopped.clone(),
            failed: self.failed.clone(),
            attitude_spread_rad: statistics.attitude_spread_rad,
            body_momentum_deviation: statistics.body_momentum_deviation.clone(),
            energy_max_abs_error: statistics.energy_max_abs_error.map(|values| values.largest),
            orthogonality_max: statistics.orthogonality_max.map(|values| values.largest),
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
