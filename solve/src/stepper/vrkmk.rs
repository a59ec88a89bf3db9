//! VRKMK: the variational Runge-Kutta-Munthe-Kaas methods of Bogfjellmo and Marthinsen, High-order
//! symplectic partitioned Lie group methods, Found. Comput. Math. 16 (2016), with which the paper
//! compares its own.
//!
//! The discrete action `h sum b_i L(G_i, xi_i)` is made stationary, with the positions linked by
//! the exponential: `G_i = exp(X_i) g0`, `g1 = exp(Y) g0`. Everything is right-trivialised:
//! `g' = xi g`, and the momentum m is the spatial one. With `T(X) = sum_{k<=q} B_k / k! ad_X^k` for
//! the inverse of dexp and `W(X, xi, P)` the adjoint of its derivative,
//! `<W, D> = <P, (dT(X) D) xi>`:
//!
//! ```text
//! X_i = h sum_j a_ij k_j,              G_i = exp(X_i) g0
//! M_i = T(X_i)^* P_i                   spatial stage momentum
//! xi_i = dH/dm(G_i, M_i),              f_i = -dH/dg(G_i, M_i)
//! k_i = T(X_i) xi_i
//! Q_i = dexp_{-X_i} f_i - W(X_i, xi_i, P_i)
//! Y = h sum_i b_i k_i,                 n = m0 + h sum_i b_i Ad_{exp(-X_i)} f_i
//! P_j = dexp_Y n - h sum_i (b_i a_ij / b_j) Q_i
//! g1 = exp(Y) g0,                      m1 = Ad_{exp(Y)} n
//! ```
//!
//! A rotation of space rotates all of these, except for the potential; so, where the equations are
//! solved,
//!
//! ```text
//! m1 = m0 + h sum_i b_i (f_i + [xi_i, M_i])
//! ```
//!
//! in which each term is the effect of a force (Noether's theorem). m1 is computed this way: the
//! other formula rounds the whole momentum at every step, which made the energy of a body with a
//! thin axis grow linearly.
//!
//! The unknowns are k_i and P_i. dexp and exp are exact: truncating either would cost the
//! symplecticity. T may be truncated, since W is the derivative of the truncated series; q = p - 2
//! keeps the order p.
//!
//! Invariant: on success the state has moved by one symplectic step; on failure it has not moved.
//! Unless projected, the attitude is a product of exponentials and leaves the group as round-off
//! accumulates.

use nalgebra::Vector3;

use crate::compensated::Sum;
use crate::failure::Failure;
use crate::hamiltonian::{BodyAtTime, RigidBody, WorkAndImpulse};
use crate::nonlinear::{Convergence, Equations, Rung, SMALLEST_SIZE, Solver, StopRule, relative};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::stepper::checks::check_root;
use crate::stepper::{Clock, Stepper};
use crate::tableau::Tableau;

use maps::{Chains, MAX_TRUNCATION, Skew, greater, inverse_dexp_coefficients};

mod maps;

/// The stepper: a tableau, a stop rule, the attitude g and the spatial momentum m, and scratch
/// space.
#[derive(Clone, Debug)]
pub struct Vrkmk<const N: usize> {
    tableau: Tableau,
    solver: Solver,
    /// `B_k / k!` up to the truncation.
    beta: Vec<f64>,
    projected: bool,
    attitude: Mat<N>,
    /// Spatial momentum, skew.
    momentum: Sum<Mat<N>>,
    space: Vec<Vector<N>>,
    clock: Clock<N>,
    unknowns: Unknowns<N>,
}

/// The unknowns of a step, in one of the two representations of so(n).
#[derive(Clone, Debug)]
enum Unknowns<const N: usize> {
    /// n = 3.
    Vector(Stages<N, Vector3<f64>>),
    /// Any n.
    Bracket(Stages<N, Mat<N>>),
}

/// The stages, and the quantities that they share.
#[derive(Clone, Debug)]
struct Stages<const N: usize, A> {
    stages: Vec<Stage<N, A>>,
    chains: Chains<N, A>,
    /// Y: the step from g0 to g1 in the algebra.
    y: A,
    /// The momentum at the end of the step, as seen from its beginning.
    n: A,
}

/// The unknowns of one stage.
#[derive(Clone, Copy, Debug)]
struct Stage<const N: usize, A> {
    /// The slope k_i of X.
    k: A,
    /// The multiplier P_i of the definition of k_i.
    p: A,
    /// h b_i Q_i.
    load: A,
    /// h b_i (f_i + [xi_i, M_i]).
    impulse: A,
    /// Attitude G_i.
    g: Mat<N>,
    /// Input to a driven body at the stage.
    input: WorkAndImpulse<N>,
}

impl<const N: usize> Vrkmk<N> {
    /// Creates a stepper for `tableau` that solves each step until `stop`, with the truncation
    /// q = p - 2 that keeps the order p of the tableau (at most 20).
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let q = (tableau.order() as usize).saturating_sub(2).min(MAX_TRUNCATION);
        Self {
            beta: inverse_dexp_coefficients(q),
            unknowns: if N == 3 {
                Unknowns::Vector(Stages::new(tableau.stages(), q))
            } else {
                Unknowns::Bracket(Stages::new(tableau.stages(), q))
            },
            projected: false,
            attitude: Mat::identity(),
            momentum: Sum::new(Mat::zeros(), Mat::zeros()),
            space: Vec::new(),
            clock: Clock::default(),
            tableau,
            solver: Solver::new(stop.to_the_floor()),
        }
    }

    /// Puts the attitude back on the group after each step (`vrkmk_projected`), by the polar
    /// factor. The spatial momentum is left as it is.
    pub fn projected(mut self) -> Self {
        self.projected = true;
        self
    }

    /// Truncates the inverse of dexp after the power `q`, at most 20: the step stays symplectic,
    /// the order falls where q < p - 2.
    pub fn truncated(mut self, q: usize) -> Self {
        let q = q.min(MAX_TRUNCATION);
        self.beta = inverse_dexp_coefficients(q);
        match &mut self.unknowns {
            Unknowns::Vector(stages) => stages.chains = Chains::new(q),
            Unknowns::Bracket(stages) => stages.chains = Chains::new(q),
        }
        self
    }
}

impl<const N: usize> Stepper<N> for Vrkmk<N> {
    fn order(&self) -> u32 {
        // The odd Bernoulli numbers from B_3 on vanish: an even truncation covers the next power,
        // too.
        let q = self.beta.len() as u32 - 1;
        let reached = if q >= 2 && q.is_multiple_of(2) { q + 3 } else { q + 2 };
        self.tableau.order().min(reached)
    }

    fn start(&mut self, state: &State<N>) {
        self.attitude = state.attitude;
        self.momentum = Sum::new(Skew::<N>::turned(&state.momentum, &state.attitude), Mat::zeros());
        self.clock = Clock::default();
    }

    fn clock(&self) -> Option<&Clock<N>> {
        Some(&self.clock)
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        Some(&mut self.clock)
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        // The attitudes of the stages are absolute: the potential is as seen from space.
        body.seen_from(&Mat::identity(), &mut self.space);
        let Self { tableau, solver, beta, attitude, momentum, space, unknowns, clock, .. } = self;
        let nodes = (0..tableau.stages()).map(|k| tableau.c(k));
        let bodies = if body.is_driven() { body.over(clock.time, h, nodes) } else { Vec::new() };
        let step = Step { tableau, beta, body, bodies: &bodies, space, h, g0: attitude };
        let (convergence, (g1, impulse)) = match unknowns {
            Unknowns::Vector(stages) => step.solve(solver, &momentum.value, stages)?,
            Unknowns::Bracket(stages) => step.solve(solver, &momentum.value, stages)?,
        };
        let attitude = if self.projected { so::orthonormalised(&g1) } else { g1 };
        if convergence.rung == Rung::Newton {
            let mut halves = Self { solver: self.solver.by_sweeps(), ..self.clone() };
            let half = || halves.step(body, 0.5 * h).map(|_| Some(halves.attitude));
            check_root(convergence, Stepper::<N>::order(self), &attitude, half)?;
        }
        self.attitude = attitude;
        // The increment is skew to the last bit.
        self.momentum.add(&so::skew(&impulse));
        let work_and_impulse = match &self.unknowns {
            Unknowns::Vector(stages) => stages.work_and_impulse(&self.tableau, h),
            Unknowns::Bracket(stages) => stages.work_and_impulse(&self.tableau, h),
        };
        self.clock.advance(h, &work_and_impulse);
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        Skew::<N>::turned_back(&self.momentum.value, &self.attitude)
    }
}

impl<const N: usize, A: Skew<N>> Stages<N, A> {
    /// Returns the input to a driven body in the step.
    fn work_and_impulse(&self, tableau: &Tableau, h: f64) -> WorkAndImpulse<N> {
        let mut work_and_impulse = WorkAndImpulse::default();
        for (k, stage) in self.stages.iter().enumerate() {
            work_and_impulse.add(h * tableau.b(k), &stage.input);
        }
        work_and_impulse
    }

    fn new(stages: usize, q: usize) -> Self {
        let zero = A::zero();
        let (g, input) = (Mat::identity(), WorkAndImpulse::default());
        let stage = Stage { k: zero, p: zero, load: zero, impulse: zero, g, input };
        let chains = Chains::new(q);
        Self { stages: vec![stage; stages], chains, y: zero, n: zero }
    }
}

/// Quantities that stay fixed while a step is solved.
struct Step<'a, const N: usize> {
    tableau: &'a Tableau,
    beta: &'a [f64],
    body: &'a RigidBody<N>,
    /// A driven body at the moments of the stages.
    bodies: &'a [BodyAtTime<N>],
    space: &'a [Vector<N>],
    h: f64,
    g0: &'a Mat<N>,
}

impl<const N: usize> Step<'_, N> {
    /// Solves the step from the spatial momentum `m0`; returns g1 and `m1 - m0`.
    fn solve<A: Skew<N>>(
        &self,
        solver: &mut Solver,
        m0: &Mat<N>,
        unknowns: &mut Stages<N, A>,
    ) -> Result<(Convergence, (Mat<N>, Mat<N>)), Failure> {
        let m0 = A::from_matrix(m0);
        let (xi, _) = slopes(self.body, self.g0, &m0);
        let solved = solver.solve(&mut Sweeps { step: self, m0: &m0, xi: &xi, unknowns });
        // An iterate that is not finite meets no charge.
        let finite = |stage: &Stage<N, A>| stage.g.iter().all(|x| x.is_finite());
        let mut stages = unknowns.stages.iter().enumerate().filter(|(_, stage)| finite(stage));
        let check = stages.try_for_each(|(i, stage)| {
            let check = match self.bodies.get(i) {
                None => self.body.check_distances_seen(&stage.g, self.space),
                Some(body_at_time) => body_at_time.check(&stage.g),
            };
            check.map_err(|met| Failure { stage: Some(i), ..met })
        });
        let convergence = match solved {
            Ok(convergence) => check.map(|()| convergence)?,
            Err(failure) => return Err(failure.explained_by(check)),
        };
        let turn = so::exp(&unknowns.y.matrix());
        let mut impulse = A::zero();
        for stage in &unknowns.stages {
            impulse += stage.impulse;
        }
        Ok((convergence, (so::product(&turn, self.g0), impulse.matrix())))
    }

    /// Makes one sweep over all unknowns, with each slope computed from the newest of the others;
    /// returns the largest change of a stage's displacement h k_i, in radians, or of a multiplier,
    /// relative to the largest.
    ///
    /// Changes of the slopes themselves would be no measure: they contain the round-off of the
    /// momentum times the inverse of the smallest moment of inertia.
    fn sweep<A: Skew<N>>(&self, m0: &A, unknowns: &mut Stages<N, A>) -> Result<f64, Failure> {
        let Self { tableau, beta, body, bodies, h, g0, .. } = *self;
        let Stages { stages, chains, y, n } = unknowns;
        let s = stages.len();
        (*y, *n) = (A::zero(), *m0);
        let mut displacement = 0.0;
        for i in 0..s {
            let mut x = A::zero();
            for j in 0..s {
                x += stages[j].k * (h * tableau.a(i, j));
            }
            if !x.size().is_finite() {
                return Err(Failure::not_finite(Some(i)));
            }
            let stage = &mut stages[i];
            let turn = so::exp(&x.matrix());
            stage.g = so::product(&turn, g0);
            let m = chains.dual_image(beta, &x, &stage.p);
            let (xi, torque) = match bodies.get(i) {
                None => slopes(body, &stage.g, &m),
                Some(body_at_time) => {
                    body.count(1);
                    let (slopes, input) = driven_slopes(body_at_time, &stage.g, &m);
                    stage.input = input;
                    slopes
                }
            };
            let k = chains.image(beta, &x, &xi);
            displacement = greater(displacement, h.abs() * (k - stage.k).size());
            stage.k = k;
            let weight = h * tableau.b(i);
            let f = torque - xi.bracket(&m);
            stage.impulse = torque * weight;
            stage.load = ((-x).dexp(&f) - chains.adjoint_of_derivative(beta)) * weight;
            *y += k * weight;
            *n += f.turned_back(&turn) * weight;
        }
        let end = y.dexp(n);
        let (mut change, mut size) = (0.0, m0.size());
        for j in 0..s {
            let mut sum = A::zero();
            for i in 0..s {
                // The products h a_ij and h b_j of both halves have the same bits: the pair is
                // symplectic whatever their rounding.
                sum += stages[i].load * (h * tableau.a(i, j));
            }
            let p = end - sum * (1.0 / (h * tableau.b(j)));
            change = greater(change, (p - stages[j].p).size());
            size = greater(size, p.size());
            stages[j].p = p;
        }
        Ok(greater(displacement, relative(change, size)))
    }
}

/// A step being solved: `xi` is the slope at its beginning, kept constant for the first guess.
struct Sweeps<'a, 'b, const N: usize, A> {
    step: &'a Step<'b, N>,
    m0: &'a A,
    xi: &'a A,
    unknowns: &'a mut Stages<N, A>,
}

impl<const N: usize, A: Skew<N>> Equations for Sweeps<'_, '_, N, A> {
    fn guess(&mut self) -> Result<(), Failure> {
        for stage in &mut self.unknowns.stages {
            let (zero, input) = (A::zero(), WorkAndImpulse::default());
            let (k, p, g) = (*self.xi, *self.m0, *self.step.g0);
            *stage = Stage { k, p, load: zero, impulse: zero, g, input };
        }
        Ok(())
    }

    fn sweep(&mut self) -> Result<f64, Failure> {
        self.step.body.work().begin_sweep()?;
        self.step.sweep(self.m0, self.unknowns)
    }

    fn unknowns(&self, values: &mut Vec<f64>) {
        let (slope, momentum) = self.units();
        for stage in &self.unknowns.stages {
            values.extend(stage.k.matrix().iter().map(|x| x / slope));
            values.extend(stage.p.matrix().iter().map(|x| x / momentum));
        }
    }

    fn set(&mut self, values: &[f64]) {
        let (slope, momentum) = self.units();
        let skew = |values: &[f64], unit: f64| {
            A::from_matrix(&(Mat::<N>::from_column_slice(values) * unit))
        };
        for (stage, values) in self.unknowns.stages.iter_mut().zip(values.chunks_exact(2 * N * N)) {
            stage.k = skew(&values[..N * N], slope);
            stage.p = skew(&values[N * N..], momentum);
        }
    }
}

impl<const N: usize, A: Skew<N>> Sweeps<'_, '_, N, A> {
    /// Returns the units of slopes and of momenta.
    fn units(&self) -> (f64, f64) {
        let unit = |size: f64| if size >= SMALLEST_SIZE { size } else { 1.0 };
        (unit(self.xi.size()), unit(self.m0.size()))
    }
}

/// Returns `xi = dH/dm` and the part of `f = -dH/dg` that is the effect of a force, `f + [xi, m]`,
/// right-trivialised, at an attitude and a spatial momentum: `<f, eta> = -d/de H(exp(e eta) g, m)`.
///
/// With the body momentum `mu = g^T m g` and `Omega = dH/dmu` of the left-trivialised H,
/// `xi = Ad_g Omega` and `f = -[xi, m] - dU/dg`: turning g at a fixed spatial momentum turns mu.
fn slopes<const N: usize, A: Skew<N>>(body: &RigidBody<N>, g: &Mat<N>, m: &A) -> (A, A) {
    let omega = A::from_matrix(&body.velocity(&m.turned_back(g).matrix()));
    let xi = omega.turned(g);
    (xi, -A::from_matrix(&body.spatial_gradient(g)))
}

/// Does the same for a driven body at a moment; also returns the input to the body.
fn driven_slopes<const N: usize, A: Skew<N>>(
    body_at_time: &BodyAtTime<N>,
    g: &Mat<N>,
    m: &A,
) -> ((A, A), WorkAndImpulse<N>) {
    let mu = m.turned_back(g).matrix();
    let body_omega = body_at_time.body.velocity(&mu);
    let xi = A::from_matrix(&body_omega).turned(g);
    let torque = -A::from_matrix(&body_at_time.spatial_gradient(g, &mu, &body_omega));
    ((xi, torque), body_at_time.input(g, &mu, &body_omega))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hamiltonian::{Kinetic, Law, Term};

    /// The paper's dipole on a stick.
    fn dipole() -> RigidBody<3> {
        let bodies = [1.01, 1.0, 0.01];
        let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
        let source = |strength: f64| Term {
            law: Law::PointSource {
                strength,
                body_point: Vector::<3>::new(0.0, 0.1 * strength, -1.0),
            },
            space: Vector::<3>::new(0.0, 0.0, -1.5),
        };
        let weight =
            Term { law: Law::Uniform { weight: 1.0, body_point: vertical }, space: vertical };
        RigidBody::new(Kinetic::of_moments(bodies), vec![weight, source(1.0), source(-1.0)], 0.0)
    }

    fn start() -> State<3> {
        let attitude = so::exp(&so::hat(&[0.3, -0.5, 0.7]));
        let momentum = so::hat::<3>(&[0.4, -0.2, 0.1]);
        State { attitude, momentum: attitude.tr_mul(&momentum) * attitude }
    }

    #[test]
    fn slopes_of_the_dipole() {
        let (body, g) = (dipole(), start().attitude);
        let m = Vector3::new(0.4, -0.2, 0.1);
        let (xi, torque) = slopes(&body, &g, &m);
        let f = torque - xi.cross(&m);
        // Values from an independent program.
        let expected = [
            [-0.749_360_295_121_939_4, -1.649_027_840_870_673, 2.976_318_224_715_369_4],
            [0.221_236_330_894_681, -1.183_460_599_028_618_9, -0.809_483_195_372_657_1],
        ];
        assert!((xi - Vector3::from(expected[0])).amax() < 5e-14, "{xi}");
        assert!((f - Vector3::from(expected[1])).amax() < 5e-14, "{f}");
    }

    #[test]
    fn slopes_are_derivatives_of_the_energy() {
        fn law<const N: usize>() {
            let number = |seed: f64, place: usize| (seed * (place + 1) as f64).rem_euclid(1.0);
            let vector = |seed| Vector::<N>::from_fn(|i, _| number(seed, i));
            let skew = |seed| so::asym(&Mat::<N>::from_fn(|i, j| number(seed, N * i + j)));
            let weights = Mat::from_fn(|i, j| 1.0 / (1.0 + 0.3 * (i + j) as f64));
            let uniform = Law::Uniform { weight: 0.7, body_point: vector(0.414) };
            let source = Law::PointSource { strength: 0.5, body_point: vector(0.732) };
            let terms = vec![
                Term { law: uniform, space: vector(0.236) },
                Term { law: source, space: vector(0.646) * 3.0 },
            ];
            let body = RigidBody::new(Kinetic::Principal { weights }, terms, 0.0);
            let (g, m) = (so::exp(&skew(0.317)), skew(0.605));
            let (xi, torque) = slopes(&body, &g, &m);
            let f = torque - so::asym(&so::product(&xi, &m));
            let energy = |g: &Mat<N>, m: &Mat<N>| body.energy(g, &m.turned_back(g)).total();
            let e = 1e-3;
            let derivative = |at: &dyn Fn(f64) -> f64| {
                (8.0 * (at(e) - at(-e)) - (at(2.0 * e) - at(-2.0 * e))) / (12.0 * e)
            };
            for eta in [skew(0.828), skew(0.162), skew(0.873)] {
                let turned = derivative(&|e| energy(&(so::exp(&(eta * e)) * g), &m));
                assert!((turned + so::inner(&f, &eta)).abs() < 1e-9, "n = {N}");
                let pushed = derivative(&|e| energy(&g, &(m + eta * e)));
                assert!((pushed - so::inner(&xi, &eta)).abs() < 1e-11, "n = {N}");
            }
        }
        law::<2>();
        law::<3>();
        law::<4>();
        law::<5>();
    }

    #[test]
    fn brackets_agree_with_the_closed_forms() {
        let (body, start) = (dipole(), start());
        let tableaux = [Tableau::gauss(1), Some(Tableau::rk3()), Tableau::gauss(3)];
        for tableau in tableaux.into_iter().flatten() {
            let mut closed = Vrkmk::new(tableau.clone(), StopRule::default());
            let mut general = closed.clone();
            let q = closed.beta.len() - 1;
            general.unknowns = Unknowns::Bracket(Stages::new(tableau.stages(), q));
            for stepper in [&mut closed, &mut general] {
                stepper.start(&start);
                stepper.step(&body, 0.05).expect("a small step");
            }
            let attitude = (closed.attitude - general.attitude).amax();
            let momentum = (closed.momentum.value - general.momentum.value).amax();
            assert!(attitude.max(momentum) < 1e-14, "{attitude:e}, {momentum:e}");
        }
    }
}
