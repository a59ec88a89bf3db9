//! Starts of the members of an ensemble.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use crate::scenario::Ensemble;
use crate::solve::so;
use crate::solve::state::State;

/// Returns the start of `member`: `g exp(hat(theta))` and `mu + hat(delta)`, with theta and delta
/// normally distributed. Each member has its own stream of random numbers, so that it does not
/// depend on how many there are.
pub(crate) fn start<const N: usize>(
    nominal: &State<N>,
    ensemble: &Ensemble,
    member: u64,
) -> State<N> {
    if member == 0 {
        return nominal.clone();
    }
    let mut random = ChaCha8Rng::seed_from_u64(ensemble.seed);
    random.set_stream(member);
    let mut coordinates = |deviation: f64| {
        let normal = (0..so::dimension(N)).map(|_| -> f64 { StandardNormal.sample(&mut random) });
        so::hat::<N>(&normal.map(|x| deviation * x).collect::<Vec<f64>>())
    };
    let turn = so::exp(&coordinates(ensemble.attitude_spread_rad));
    let momentum = nominal.momentum + coordinates(ensemble.momentum_spread);
    State { attitude: so::orthonormalised(&so::product(&nominal.attitude, &turn)), momentum }
}
