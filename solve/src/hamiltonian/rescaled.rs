//! A body whose time is rescaled near the points of its potential: steps of one length in a new time tau, with
//! `dt = sigma(g) dtau`, are steps along
//!
//! ```text
//! H~(g, mu) = sigma(g) (H(g, mu) - H0),      sigma = (1 + sum (near / rho)^3)^(-1/2)
//! ```
//!
//! (Poincaré's transformation: Hairer 1997, Applied Numerical Mathematics 25; Reich 1999, SIAM J. Numer. Anal. 36). H0, the
//! energy at the start, is minus the momentum of time and stays; along the motion H is H0, so that H~ is zero and
//!
//! ```text
//! dH~/dmu = sigma dH/dmu        dH~/dg = sigma dH/dg + (H - H0) dsigma/dg        dt/dtau = -dH~/dH0 = sigma
//! ```
//!
//! rho are the distances of body points to the point sources. The square of a frequency near one grows as `1 / rho^3`,
//! and squares add: hence the cube and the root.
//!
//! Invariant: a step along H~ is one of a Hamiltonian system, so a symplectic scheme stays symplectic, in the state and in
//! the time with its momentum.

use super::term::{BodyVector, Lanes, Law, LawRef};
use super::torque::Torques;
use super::{Hamiltonian, RigidBody};
use crate::failure::Failure;
use crate::lanes::StageScalar;
use crate::so::{self, Mat};
use crate::space::{Mat3, Vec3, cross, dot, minus, plus, scaled, transposed_product, vec3};
use crate::stack::{Dimension, Known, StageMatrices};
use crate::system::{Energy, System};

/// sigma(g), a function of the distances to the point sources of a body.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeScale {
    /// Distance for each term of the body, in m, below which its time slows down; 0 for a term that
    /// is no point source.
    near_m: Vec<f64>,
}

impl TimeScale {
    /// Creates a time scale from a length for each term of the body, in m; 0 if time does not look
    /// at it.
    pub fn new(near_m: Vec<f64>) -> Self {
        Self { near_m }
    }

    /// Returns the time scale with, for each point source, the distance of its body point from the
    /// fixed point; `None` if there are none.
    pub fn of<const N: usize>(body: &RigidBody<N>) -> Option<Self> {
        let arm = |law: &Law<N>| match law {
            Law::PointSource { body_point, .. } => so::norm(body_point.as_slice()),
            _ => 0.0,
        };
        let near_m: Vec<f64> = body.terms.iter().map(|term| arm(&term.law)).collect();
        near_m.iter().any(|&near| near > 0.0).then(|| Self::new(near_m))
    }

    /// sigma at `g`, in (0, 1].
    pub fn sigma<const N: usize>(&self, body: &RigidBody<N>, g: &Mat<N>) -> f64 {
        self.with_gradient(body, g).0
    }

    /// Returns sigma at `g`, and its left-trivialised derivative: for a distance d at `q = g^T v`,
    /// up to multiples of q, `dsigma/dq = -3/2 sigma^3 near^3 y / d^5`.
    fn with_gradient<const N: usize>(&self, body: &RigidBody<N>, g: &Mat<N>) -> (f64, Mat<N>) {
        let (mut sum, mut gradient) = (1.0, Mat::zeros());
        for (term, near) in body.terms.iter().zip(&self.near_m) {
            let Law::PointSource { body_point: y, .. } = &term.law else { continue };
            let q = so::to_body(g, &term.space);
            let arm = y - q;
            let square = so::dot(arm.as_slice(), arm.as_slice());
            let cube = near * near * near / (square * square.sqrt());
            sum += cube;
            let slope = y * (cube / square);
            gradient += so::wedge(&q, &slope);
        }
        let sigma = 1.0 / sum.sqrt();
        (sigma, gradient * (-1.5 * sigma * sigma * sigma))
    }
}

/// The system with the Hamiltonian H~.
#[derive(Clone, Copy, Debug)]
pub struct Rescaled<'a, const N: usize> {
    pub(crate) body: &'a RigidBody<N>,
    pub(crate) scale: &'a TimeScale,
    /// H0 in J.
    pub(crate) energy: f64,
}

impl<'a, const N: usize> Rescaled<'a, N> {
    /// Creates the system of `body`, which is not driven, in the time of `scale`, on the motion
    /// with this `energy` in J.
    pub fn new(body: &'a RigidBody<N>, scale: &'a TimeScale, energy: f64) -> Self {
        Self { body, scale, energy }
    }

    /// H0 in J.
    pub fn energy_of_motion(&self) -> f64 {
        self.energy
    }

    /// Returns the system on the motion with this `energy` in J.
    pub fn with_energy(self, energy: f64) -> Self {
        Self { energy, ..self }
    }

    /// dt / dtau at `g`.
    pub fn sigma(&self, g: &Mat<N>) -> f64 {
        self.scale.sigma(self.body, g)
    }
}

impl<const N: usize> System<N> for Rescaled<'_, N> {
    /// H~.
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        let k = self.sigma(g) * (self.body.energy(g, mu).total() - self.energy);
        Energy { kinetic: k, potential: 0.0 }
    }

    fn conserved_directions(&self) -> Option<Mat<N>> {
        self.body.conserved_directions()
    }

    fn check(&self, g: &Mat<N>) -> Result<(), Failure> {
        self.body.check_distances(g)
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.body.work().begin_sweep()
    }
}

impl<const N: usize> Hamiltonian<N> for Rescaled<'_, N> {
    fn velocity(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        self.body.velocity(mu) * self.sigma(g)
    }

    fn gradient(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        let (sigma, of_sigma) = self.scale.with_gradient(self.body, g);
        let above = self.body.energy(g, mu).total() - self.energy;
        self.body.gradient(g) * sigma + of_sigma * above
    }

    fn as_rescaled(&self) -> Option<&Rescaled<'_, N>> {
        Some(self)
    }
}

/// sigma as the stages see it.
pub(crate) struct Scale<'a> {
    /// See [`TimeScale`].
    pub(crate) near_m: &'a [f64],
    /// H0 less the part of H that does not depend on the state.
    pub(crate) energy: f64,
}

impl<'a, const N: usize> From<&Rescaled<'a, N>> for Scale<'a> {
    fn from(of: &Rescaled<'a, N>) -> Self {
        Self { near_m: &of.scale.near_m, energy: of.energy - of.body.constant }
    }
}

/// Values at the attitudes of the stages, in vectors, for n = 3.
pub(crate) struct StageForces<R> {
    /// vee(dH/dg).
    pub(crate) torque: Vec3<R>,
    /// Nearness as returned by [`RigidBody::torque`].
    pub(crate) proximity: R,
    /// The potential energy less its constant.
    pub(crate) potential: R,
    /// `S = 1 + sum (near / d)^3`.
    pub(crate) sum: R,
    /// vee(dS/dg).
    pub(crate) of_sum: Vec3<R>,
}

impl RigidBody<3> {
    /// Looks from the attitudes `g0 U`, with the space vectors `seen` from g0.
    #[inline(always)]
    pub(crate) fn evaluate_forces<R: StageScalar<StepScalar = f64>>(
        &self,
        scale: &Scale<'_>,
        u: &Mat3<R>,
        seen: &[Vec3<f64>],
    ) -> StageForces<R> {
        let lanes = u[0][0];
        let zero = lanes.constant(0.0);
        let mut forces = StageForces {
            torque: [zero; 3],
            proximity: lanes.constant(-1.0),
            potential: zero,
            sum: lanes.constant(1.0),
            of_sum: [zero; 3],
        };
        let terms = self.terms.iter().zip(&self.inverse_arms_squared).zip(scale.near_m);
        for (((term, inverse_arm_squared), near), v) in terms.zip(seen) {
            let v: Vec3<R> = vec3!(i => lanes.spread(v[i]));
            let q = transposed_product(u, &v);
            let in_lanes = Lanes { dimension: Known::<3>, numbers: q };
            let law = term.law.numbers();
            let slope = law.slope(&in_lanes, *inverse_arm_squared, &mut forces.proximity).numbers;
            forces.torque = plus(&forces.torque, &cross(&slope, &q));
            forces.potential = forces.potential + law.value(&in_lanes);
            if let Law::PointSource { body_point, .. } = &term.law {
                // dS/dq = 3 near^3 y / d^5, up to multiples of q
                let y: Vec3<R> = vec3!(i => lanes.constant(body_point[i]));
                let arm = minus(&y, &q);
                let square = dot(&arm, &arm);
                let cube = lanes.constant(near * near * near) / (square * square.sqrt());
                forces.sum = forces.sum + cube;
                forces.of_sum = plus(&forces.of_sum, &scaled(&cross(&y, &q), cube / square * 3.0));
            }
        }
        forces
    }
}

/// Part of H~ that depends on the attitudes of the stages alone, in lanes.
///
/// Torques are taken at attitudes `I + C0`; the passes that follow change them to `I + C`. The
/// distances and the potential in H~ follow to first order,
///
/// ```text
/// U = U0 + sum_ij (v s^T)_ij (C - C0)_ij      S = S0 + 3 sum_ij (v (y near^3 / d^5)^T)_ij (C - C0)_ij      sigma = S^(-1/2)
/// ```
///
/// with s the slope of a term; else H - H0 would be that of a momentum at one attitude and a
/// potential at another.
#[derive(Clone, Debug, Default)]
pub(crate) struct AtStages {
    /// C0.
    before: Vec<f64>,
    /// `v s^T` and `v (y near^3 / d^5)^T`, summed over the terms.
    energy_rate: Vec<f64>,
    distance_rate: Vec<f64>,
    /// S0.
    sum: Vec<f64>,
    /// dH/dg, and `sum y near^3 / d^5` in the same form: dsigma/dg is `-3/2 sigma^3` of it.
    of_energy: Vec<f64>,
    of_distances: Vec<f64>,
    /// The slopes of both, term by term.
    energy_slopes: Vec<f64>,
    distance_slopes: Vec<f64>,
    /// sigma, U, and H - H0 with the newest momenta.
    sigma: Vec<f64>,
    potential: Vec<f64>,
    above: Vec<f64>,
}

impl AtStages {
    /// sigma of the stages.
    pub(crate) fn sigma(&self) -> &[f64] {
        &self.sigma
    }

    /// Evaluates all of it at attitudes `I + C_k`, with the new torques.
    #[inline(always)]
    pub(crate) fn evaluate_forces<R: StageScalar<StepScalar = f64>, D: Dimension>(
        &mut self,
        torques: &mut Torques<'_, R, D>,
        scale: &Scale<'_>,
        c: &[f64],
    ) {
        let StageMatrices { lanes, dimension } = torques.stack;
        let (n, stack) = (dimension.n(), torques.stack);
        let (matrix, vector) = (stack.numbers(), n * R::LANES);
        let count = torques.terms.count();
        self.of_energy.resize(matrix, 0.0);
        self.of_distances.resize(matrix, 0.0);
        self.before.resize(matrix, 0.0);
        self.before.copy_from_slice(&c[..matrix]);
        for rate in [&mut self.energy_rate, &mut self.distance_rate] {
            rate.resize(matrix, 0.0);
            rate.fill(0.0);
        }
        self.energy_slopes.resize(count * vector, 0.0);
        self.distance_slopes.resize(count * vector, 0.0);
        for numbers in [&mut self.sigma, &mut self.sum, &mut self.potential, &mut self.above] {
            numbers.resize(R::LANES, 0.0);
        }
        self.of_distances.fill(0.0);
        let mut proximity = lanes.constant(-1.0);
        let (mut sum, mut potential) = (lanes.constant(1.0), lanes.constant(0.0));
        for i in 0..count {
            let (law, inverse_arm_squared) = torques.terms.term(i);
            let q = Lanes { dimension, numbers: torques.seen_by_stages(i, c) };
            potential = potential + law.value(&q);
            let slope = law.slope(&q, inverse_arm_squared, &mut proximity).numbers;
            stack.add_wedge(i == 0, &q.numbers, &slope, &mut self.of_energy);
            stack.put_vector(&slope, &mut self.energy_slopes[i * vector..(i + 1) * vector]);
            torques.add_outer(i, &slope, &mut self.energy_rate);
            let kept = &mut self.distance_slopes[i * vector..(i + 1) * vector];
            match law {
                LawRef::PointSource { body_point, .. } => {
                    let (y, near) = (q.vector(body_point), scale.near_m[i]);
                    let square = y.minus(&q).square();
                    let cube = lanes.constant(near * near * near) / (square * square.sqrt());
                    sum = sum + cube;
                    let slope = y.scaled(cube / square).numbers;
                    stack.add_wedge(false, &q.numbers, &slope, &mut self.of_distances);
                    torques.add_outer(i, &slope, &mut self.distance_rate);
                    stack.put_vector(&slope, kept);
                }
                _ => kept.fill(0.0),
            }
        }
        torques.proximity = proximity.largest();
        sum.put(&mut self.sum);
        (lanes.constant(1.0) / sum.sqrt()).put(&mut self.sigma);
        potential.put(&mut self.potential);
    }

    /// `w = sigma J^-1 mu` and dH~/dg, with the newest momenta and attitudes.
    #[inline(always)]
    pub(crate) fn derivatives<R: StageScalar<StepScalar = f64>, D: Dimension>(
        &mut self,
        stack: StageMatrices<R, D>,
        scale: &Scale<'_>,
        inertia: &[f64],
        [c, mu]: [&[f64]; 2],
        omega: &mut [f64],
        gradient: &mut [f64],
    ) {
        let (n, lanes) = (stack.n(), stack.lanes);
        /// Least fraction of S that a diverging step may leave.
        const LEAST: f64 = 0.25;
        let (mut gained, mut nearer) = (lanes.constant(0.0), lanes.constant(0.0));
        let len = stack.numbers();
        let (c, before) = (&c[..len], &self.before[..len]);
        let (energy_rate, distance_rate) = (&self.energy_rate[..len], &self.distance_rate[..len]);
        for i in 0..n {
            for j in 0..n {
                let change = stack.get(c, i, j) - stack.get(before, i, j);
                gained = gained + stack.get(energy_rate, i, j) * change;
                nearer = nearer + stack.get(distance_rate, i, j) * change;
            }
        }
        let sum = lanes.get(&self.sum);
        let sum = (sum + nearer * 3.0).max_or_nan(sum * LEAST);
        let sigma = lanes.constant(1.0) / sum.sqrt();
        let potential = lanes.get(&self.potential) + gained;
        let mut twice = lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let mu = stack.get(mu, i, j);
                let velocity = stack.get(inertia, i, j) * mu;
                twice = twice + mu * velocity;
                stack.put_skew(omega, i, j, sigma * velocity);
            }
        }
        let above = twice * 0.5 + (potential + -scale.energy);
        let factor = above * (sigma * sigma * sigma) * -1.5;
        for i in 0..n {
            for j in i + 1..n {
                let (energy, distances) =
                    (stack.get(&self.of_energy, i, j), stack.get(&self.of_distances, i, j));
                stack.put_skew(gradient, i, j, sigma * energy + factor * distances);
            }
        }
        sigma.put(&mut self.sigma);
        above.put(&mut self.above);
    }

    /// `U_k (dH~/dg) U_k^T` at the stages.
    #[inline(always)]
    pub(crate) fn spatial_gradient<R: StageScalar<StepScalar = f64>, D: Dimension>(
        &self,
        torques: &Torques<'_, R, D>,
        c: &[f64],
        slopes: &mut Vec<f64>,
        turned: &mut [f64],
    ) {
        let lanes = torques.stack.lanes;
        let sigma = lanes.get(&self.sigma);
        let factor = lanes.get(&self.above) * (sigma * sigma * sigma) * -1.5;
        slopes.resize(self.energy_slopes.len(), 0.0);
        let both = self.energy_slopes.chunks_exact(R::LANES);
        let both = both.zip(self.distance_slopes.chunks_exact(R::LANES));
        for (slope, (energy, distance)) in slopes.chunks_exact_mut(R::LANES).zip(both) {
            (sigma * lanes.get(energy) + factor * lanes.get(distance)).put(slope);
        }
        torques.spatial_gradient(c, slopes, turned);
    }
}
