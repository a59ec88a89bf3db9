//! Starts of the members of an ensemble.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use crate::scenario::Ensemble;
use crate::solve::bodies::{Bodies, BodiesState, Change};
use crate::solve::so::{self, Mat, Vector};
use crate::solve::state::State;

/// Normally distributed numbers of a member.
struct Draws(ChaCha8Rng);

impl Draws {
    /// Each member has its own stream of random numbers, so that it does not depend on how many there are; and so has each of
    /// its bodies, by number, the first that of a member of one body.
    fn new(ensemble: &Ensemble, member: u64, body: usize) -> Self {
        const _: () = assert!(Ensemble::MOST < 1 << 32, "streams of bodies would meet");
        let mut random = ChaCha8Rng::seed_from_u64(ensemble.seed);
        random.set_stream(member + ((body as u64) << 32));
        Self(random)
    }

    fn normal(&mut self, deviation: f64) -> f64 {
        let x: f64 = StandardNormal.sample(&mut self.0);
        deviation * x
    }

    fn skew<const N: usize>(&mut self, deviation: f64) -> Mat<N> {
        let coordinates = (0..so::dimension(N)).map(|_| self.normal(deviation));
        so::hat(&coordinates.collect::<Vec<f64>>())
    }

    fn vector<const N: usize>(&mut self, deviation: f64) -> Vector<N> {
        Vector::from_fn(|_, _| self.normal(deviation))
    }
}

/// Returns the start of `member`: `g exp(hat(theta))` and `mu + hat(delta)`, with theta and delta
/// normally distributed.
pub(crate) fn start<const N: usize>(
    nominal: &State<N>,
    ensemble: &Ensemble,
    member: u64,
) -> State<N> {
    if member == 0 {
        return nominal.clone();
    }
    let mut draws = Draws::new(ensemble, member, 0);
    let turn = so::exp(&draws.skew(ensemble.attitude_spread_rad));
    let momentum = nominal.momentum + draws.skew(ensemble.momentum_spread);
    State { attitude: so::orthonormalised(&so::product(&nominal.attitude, &turn)), momentum }
}

/// Returns the same of several bodies: each changes by [`Change`], its parts normally distributed.
pub(crate) fn start_of_bodies<const N: usize>(
    bodies: &Bodies<N>,
    nominal: &BodiesState<N>,
    ensemble: &Ensemble,
    member: u64,
) -> BodiesState<N> {
    if member == 0 {
        return nominal.clone();
    }
    let change = |body: usize| {
        let mut draws = Draws::new(ensemble, member, body);
        Change {
            turn: draws.skew(ensemble.attitude_spread_rad),
            momentum: draws.skew(ensemble.momentum_spread),
            shift: draws.vector(ensemble.position_spread_m.unwrap_or_default()),
            velocity: draws.vector(ensemble.velocity_spread_m_s.unwrap_or_default()),
        }
    };
    let changes: Vec<Change<N>> = (0..bodies.bodies().len()).map(change).collect();
    bodies.beside(nominal, &changes).expect("the plan has seen the start")
}
