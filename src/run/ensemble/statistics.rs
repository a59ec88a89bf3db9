//! Mean and spread of the members of an ensemble.

use nalgebra::DMatrix;

use super::SUCCEEDED;
use crate::log::messages::{EnsembleStatistics, Figures, Member, Quantiles};
use crate::run::summary::EnsembleSummary;
use crate::solve::so::{self, Mat};
use crate::solve::trajectory::State;

/// Of the starts.
pub(super) fn at_start<const N: usize>(
    starts: impl Iterator<Item = State<N>>,
) -> EnsembleStatistics {
    let states: Vec<State<N>> = starts.collect();
    of_states(&states)
}

/// Of those that made all their steps.
pub(super) fn at_end<const N: usize>(time_s: f64, ends: &[Member]) -> EnsembleStatistics {
    let (arrived, failed): (Vec<&Member>, Vec<&Member>) =
        ends.iter().partition(|end| end.outcome == SUCCEEDED);
    let states: Vec<State<N>> =
        arrived.iter().filter_map(|end| end.last.as_ref()?.point()).collect();
    let quantiles = |figure: fn(&Figures) -> Option<f64>| {
        quantiles(arrived.iter().filter_map(|end| figure(end.figures.as_ref()?)).collect())
    };
    EnsembleStatistics {
        time_s,
        failed: failed.len() as u64,
        energy_max_abs_error: quantiles(|figures| figures.energy_max_abs_error),
        orthogonality_max: quantiles(|figures| figures.orthogonality_max),
        momentum_max_drift: quantiles(|figures| figures.momentum_max_drift),
        ..of_states(&states)
    }
}

fn of_states<const N: usize>(states: &[State<N>]) -> EnsembleStatistics {
    let count = states.len() as f64;
    let mean = |sum: Mat<N>| sum / count.max(1.0);
    let momentum = mean(states.iter().map(|state| state.momentum).sum());
    let mut squares = vec![0.0; so::dimension(N)];
    for state in states {
        let from_mean = so::vee(&(state.momentum - momentum));
        squares.iter_mut().zip(from_mean).for_each(|(sum, x)| *sum += x * x);
    }
    let attitude = nearest_rotation(&mean(states.iter().map(|state| state.attitude).sum()));
    let spread = attitude.map(|nearest| {
        let square = |state: &State<N>| (state.attitude - nearest).norm_squared() / 2.0;
        (states.iter().map(square).sum::<f64>() / count).sqrt()
    });
    EnsembleStatistics {
        members: states.len() as u64,
        mean_attitude: attitude.map_or_else(Vec::new, |g| g.transpose().as_slice().to_vec()),
        attitude_spread_rad: spread,
        mean_body_momentum: so::vee(&momentum),
        body_momentum_deviation: squares.iter().map(|sum| (sum / count.max(1.0)).sqrt()).collect(),
        ..EnsembleStatistics::default()
    }
}

/// The rotation that lies nearest: of `U S V^T` it is `U diag(1, .., det(U V^T)) V^T`. `None` where many do.
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
    // Which one it is must not hang on rounding.
    let last = if mirrored { -singular[N - 1] } else { singular[N - 1] };
    (singular[N - 2] + last > 1e-6).then(|| Mat::from_column_slice((u * v).as_slice()))
}

fn quantiles(mut values: Vec<f64>) -> Option<Quantiles> {
    values.sort_unstable_by(f64::total_cmp);
    // The least value that so large a part does not exceed.
    let at = |part: f64| values[(part * (values.len() - 1) as f64).ceil() as usize];
    (!values.is_empty()).then(|| Quantiles {
        least: at(0.0),
        median: at(0.5),
        percentile_95: at(0.95),
        largest: at(1.0),
    })
}

/// What a summary says of it.
pub(super) fn summary(statistics: &EnsembleStatistics, ends: &[Member]) -> EnsembleSummary {
    let mut summary = EnsembleSummary {
        members: ends.len() as u64,
        succeeded: statistics.members,
        attitude_spread_rad: statistics.attitude_spread_rad,
        body_momentum_deviation: statistics.body_momentum_deviation.clone(),
        energy_max_abs_error: statistics.energy_max_abs_error.map(|values| values.largest),
        orthogonality_max: statistics.orthogonality_max.map(|values| values.largest),
        ..EnsembleSummary::default()
    };
    for end in ends.iter().filter(|end| end.outcome != SUCCEEDED) {
        *summary.failed.entry(end.outcome.clone()).or_default() += 1;
    }
    summary
}
