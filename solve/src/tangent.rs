//! The derivative of a step of VPD by the state at its beginning and by parameters of the body, and its adjoint.
//!
//! A state changes by `dg = g hat(xi)` and `dmu = hat(nu)`, left-trivialised; with the d = n(n-1)/2 coordinates of
//! [`so::hat`] each, a change is (xi, nu), 2d numbers, and the derivative of a step a matrix of 2d x 2d. It is computed from
//! the solved equations of the step (implicit differentiation), so it is exact to round-off and symplectic to round-off, as the
//! step is: [`symplectic_form`].
//!
//! Everything is in the frame of g0, as in `stepper/galerkin.rs`, with `dU_k = U_k eta_k`, `df = f phi`, `A_k = U_k P_k`,
//! `R_kj = U_k^T U_j`, `F_j = f^T U_j`, `Q_k = U_k^T V_k`, `G_k = dH/dg(g0 U_k)` and `L(A, B) E = asym(A E B)`. The
//! derivative of the equations there, each by its tag in docs/derivation.md, is
//!
//! ```text
//! [d-polar]   L(P_k, I) eta_k = h sum_j a_kj (L(R_kj, Omega_j) eta_j + L(R_kj, I) dOmega_j)
//! [d-end]     L(P_e, I) phi = h sum_j b_j (L(F_j, Omega_j) eta_j + L(F_j, I) dOmega_j)
//! [d-V]       U_k^T dV_k = h b_k F_k^T (phi Lambda + dLambda) + h sum_i a_ik R_ki (eta_i X_i + dX_i)
//! [d-mu]      h b_k dmu_k = L(I, Q_k) eta_k - asym(U_k^T dV_k),    dOmega_k = J^-1 dmu_k - J^-1 dJ Omega_k
//! [d-X]       L(P_k, I) dX_k + asym(dP_k X_k) + asym((U_k^T dV_k - eta_k Q_k) Omega_k + Q_k dOmega_k) + h b_k dG_k = 0
//!             dP_k = h sum_j a_kj R_kj (eta_j Omega_j + dOmega_j) - eta_k P_k
//!             dG_k = Hess_k (eta_k + U_k^T xi U_k) + the change of G with the parameters
//! [d-Lambda]  L(P_e, I) dLambda + asym(dP_e Lambda) + dp1 = 0
//! [d-p1]      dp1 = f^T dp0 f - L(I, p1) phi - h sum_k b_k F_k (L(I, G_k) eta_k + dG_k) F_k^T
//! ```
//!
//! The end changes by `dg1 = g1 (phi + f^T xi f)` and dp1. dOmega is substituted; what is left is one linear system of
//! (2 s + 2) d unknowns eta, dX, phi, dLambda. For n = 3 and up to eight stages, `vectors` solves it by blocks, from the stages
//! as the stepper has solved them.
//!
//! A parameter moves the end as the flow of a Hamiltonian would: a step is symplectic, and its rate with a parameter is the
//! field of `F = sum_k h b_k dH/dp` at the stages, as a function of the start, carried to the end. So the rates of the stages with the
//! start say all of the parameters:
//!
//! ```text
//! [parameter]  (dg1, dp1)/dp = M (dF/dmu, [mu, dF/dmu] - dF/dxi)
//! ```
//!
//! Invariant: the same state, step and body give the same bits.

use std::any::Any;
use std::borrow::Cow;

use fearless_simd::Level;

use super::failure::{Failure, FailureCode};
use super::hamiltonian::{BodyRate, RigidBody};
use super::nonlinear::ROUND_OFF_FLOOR;
use super::so::{self, Mat};
use super::state::State;
use super::stepper::Stepper;
use super::tableau::Tableau;
use dense::{Dense, Factors, add_scaled};
use vectors::Vectors;

mod adjoint;
mod carried;
mod dense;
mod lyapunov;
mod vectors;

pub use adjoint::Gradient;
pub use carried::{Parameter, Uncertainty, WithDerivatives};
pub use lyapunov::Lyapunov;

/// Why there is no derivative.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TangentError {
    /// The body is driven, pushed or controlled.
    #[error("the derivative of a step is known for a body that nothing drives, pushes or controls")]
    Driven,
    /// The potential is user-defined: its second derivative is not known.
    #[error("the second derivative of a user-defined potential is not known")]
    UserPotential,
    /// The step fails.
    #[error(transparent)]
    Step(#[from] Failure),
    /// The derivative of the equations is singular to working precision: where two solutions of the step meet.
    #[error("the equations of the step are singular to working precision")]
    Singular,
}

/// The matrix `J(mu)` (2d x 2d, row by row) of the symplectic form of T*SO(n), left-trivialised, at a body momentum:
///
/// ```text
/// omega((xi, nu), (xi', nu')) = <xi, nu'> - <nu, xi'> + <mu, [xi, xi']>        J = [[B(mu), I], [-I, 0]]
/// ```
///
/// with `B_ab = <mu, [E_a, E_b]>`: minus the exterior derivative of `<mu, g^-1 dg>` (Abraham, Marsden 1978, Foundations of
/// Mechanics, 4.4). The derivative M of a symplectic map from mu0 to mu1 obeys `M^T J(mu1) M = J(mu0)`.
pub fn symplectic_form<const N: usize>(mu: &Mat<N>) -> Vec<f64> {
    let d = so::dimension(N);
    let mut form = Dense::zeros(2 * d, 2 * d);
    for a in 0..d {
        // <mu, [E, E']> = <-[E, mu], E'>, [E, mu] = asym(E mu)
        let row = so::vee(&so::asym(&so::product(&basis::<N>(a), mu)));
        for (b, x) in row.iter().enumerate() {
            form.row_mut(a)[b] = -x;
        }
        form.row_mut(a)[d + a] = 1.0;
        form.row_mut(d + a)[a] = -1.0;
    }
    form.into_numbers()
}

/// How far a derivative M (2d x 2d, row by row) of a map from mu0 to mu1 is from a symplectic one: the largest entry of
/// `M^T J(mu1) M - J(mu0)` relative to the sum of the squares of M. See [`symplectic_form`].
pub fn symplectic_error<const N: usize>(m: &[f64], mu0: &Mat<N>, mu1: &Mat<N>) -> f64 {
    let rows = 2 * so::dimension(N);
    let m = Dense::of(rows, m.to_vec());
    let mut image = Dense::zeros(rows, rows);
    image.add_product(&Dense::of(rows, symplectic_form(mu1)), &m);
    let before = symplectic_form(mu0);
    let mut error = 0.0_f64;
    for i in 0..rows {
        let column: Vec<f64> = (0..rows).map(|k| m.row(k)[i]).collect();
        let row = image.transposed_times(&column);
        let pairs = row.iter().zip(&before[i * rows..]);
        error = pairs.fold(error, |error, (x, before)| error.max((x - before).abs()));
    }
    error / m.numbers().iter().fold(0.0, |sum, x| sum + x * x)
}

/// An element of the basis of so(n).
fn basis<const N: usize>(a: usize) -> Mat<N> {
    let mut coordinates = vec![0.0; so::dimension(N)];
    coordinates[a] = 1.0;
    so::hat(&coordinates)
}

/// The stages of the last step of a stepper, for [`Tangent::of_step`]; none from a scheme that does not tell.
pub fn stages_of<const N: usize>(stepper: &dyn Stepper<N>) -> Vec<State<N>> {
    (0..).map_while(|k| stepper.stage(k)).collect()
}

/// One solved stage, in the frame of g0.
#[derive(Clone, Copy, Debug)]
struct Stage<const N: usize> {
    u: Mat<N>,
    p: Mat<N>,
    mu: Mat<N>,
    omega: Mat<N>,
    x: Mat<N>,
    /// U^T V.
    q: Mat<N>,
    gradient: Mat<N>,
}

/// A step of VPD, solved, in the frame of g0.
#[derive(Clone, Debug)]
struct Solved<const N: usize> {
    stages: Vec<Stage<N>>,
    f: Mat<N>,
    p_e: Mat<N>,
    lambda: Mat<N>,
    p1: Mat<N>,
}

/// The derivatives of steps of VPD of one body.
#[derive(Clone, Debug)]
pub struct Tangent<const N: usize> {
    body: RigidBody<N>,
    tableau: Tableau,
    /// Row, column and sign of each coordinate of so(n).
    places: Vec<(usize, usize, f64)>,
    /// J^-1 by coordinates.
    mobility: Dense,
    /// For n = 3.
    vectors: Option<Vectors>,
    found: Found<N>,
}

/// The derivative of a step.
#[derive(Clone, Debug)]
struct Found<const N: usize> {
    h: f64,
    start: State<N>,
    /// U_k and Omega_k.
    stages: Vec<(Mat<N>, Mat<N>)>,
    f: Mat<N>,
    p1: Mat<N>,
    /// By the start: of the end, and of the stages, (eta + U^T xi U, dmu) of each; rows of 2d numbers. Those of the stages are left
    /// empty where [`Vectors`] have them.
    transition: Vec<f64>,
    changes: Vec<f64>,
}

impl<const N: usize> Tangent<N> {
    /// For steps of `tableau`.
    ///
    /// # Errors
    /// [`TangentError::Driven`], [`TangentError::UserPotential`].
    pub fn new(body: &RigidBody<N>, tableau: Tableau) -> Result<Self, TangentError> {
        if body.is_driven() || body.control().is_some() {
            return Err(TangentError::Driven);
        }
        if body.has_user_potential() {
            return Err(TangentError::UserPotential);
        }
        let places: Vec<_> = so::coordinate_places::<N>().collect();
        let d = places.len();
        let mut mobility = Dense::zeros(d, d);
        for b in 0..d {
            for (a, x) in so::vee(&body.velocity_rate(&basis(b))).into_iter().enumerate() {
                mobility.row_mut(a)[b] = x;
            }
        }
        let own = body as &dyn Any;
        let vectors = own.downcast_ref::<RigidBody<3>>();
        let vectors = vectors.and_then(|body| Vectors::new(body, &tableau));
        let blank = Mat::identity();
        let found = Found {
            h: 0.0,
            start: State { attitude: blank, momentum: Mat::zeros() },
            stages: Vec::new(),
            f: blank,
            p1: blank,
            transition: Vec::new(),
            changes: Vec::new(),
        };
        Ok(Self { body: body.clone(), tableau, places, mobility, vectors, found })
    }

    /// On another instruction set, or one number at a time: for a test of the bits.
    pub fn on_level(mut self, level: Option<Level>) -> Self {
        if let Some(vectors) = &mut self.vectors {
            vectors.set_level(level);
        }
        self
    }

    /// The derivative of the step of `h` seconds from `start`, given its `stages`, as the stepper that made it has them ([`stages_of`]).
    /// Where they do not solve the equations, or there are none, these are solved here to round-off, beginning with them.
    ///
    /// # Errors
    /// [`TangentError::Step`], [`TangentError::Singular`].
    pub fn of_step(
        &mut self,
        h: f64,
        start: &State<N>,
        stages: &[State<N>],
    ) -> Result<StepTangent<'_, N>, TangentError> {
        if !self.by_vectors(h, start, stages) {
            let step = Step { tangent: self, h, start };
            let solved = step.solved(stages)?;
            self.found = step.linearised(solved)?;
        }
        Ok(StepTangent { tangent: self })
    }

    /// Differentiates a step of n = 3 whose stages are solved. `false` where that cannot be.
    fn by_vectors(&mut self, h: f64, start: &State<N>, stages: &[State<N>]) -> bool {
        let Self { body, vectors: Some(vectors), found, .. } = self else { return false };
        // N is 3.
        let known = |m: &Mat<N>| Mat::<3>::from_fn(|i, j| m[(i, j)]);
        let state = |state: &State<N>| State {
            attitude: known(&state.attitude),
            momentum: known(&state.momentum),
        };
        found.stages.clear();
        let velocity = |stage: &State<N>| body.velocity(&stage.momentum);
        found.stages.extend(stages.iter().map(|stage| (stage.attitude, velocity(stage))));
        let given = stages.iter().zip(&found.stages);
        let given = given.map(|(stage, (_, omega))| (state(stage), known(omega)));
        if !vectors.differentiate(h, state(start), given) {
            return false;
        }
        let (f, p1) = vectors.end();
        (found.h, found.f, found.p1) =
            (h, Mat::from_fn(|i, j| f[(i, j)]), Mat::from_fn(|i, j| p1[(i, j)]));
        found.start.clone_from(start);
        found.transition.clear();
        found.transition.extend_from_slice(vectors.transition());
        found.changes.clear();
        true
    }

    /// Adds `factor L(A, B)` at a row and a column.
    fn add(
        &self,
        sum: &mut Dense,
        (row, column): (usize, usize),
        factor: f64,
        a: &Mat<N>,
        b: &Mat<N>,
    ) {
        for (r, &(i, j, sign)) in self.places.iter().enumerate() {
            let entries = &mut sum.row_mut(row + r)[column..];
            let factor = factor * sign;
            for (entry, &(p, q, sign)) in entries.iter_mut().zip(&self.places) {
                // asym(A E B), E = e_p e_q^T - e_q e_p^T
                let x = a[(i, p)] * b[(q, j)] - a[(i, q)] * b[(p, j)] - a[(j, p)] * b[(q, i)]
                    + a[(j, q)] * b[(p, i)];
                *entry += factor * sign * x;
            }
        }
    }

    /// The matrix of a linear map of so(n).
    fn columns(&self, map: impl Fn(&Mat<N>) -> Mat<N>) -> Dense {
        let d = self.places.len();
        let mut matrix = Dense::zeros(d, d);
        for b in 0..d {
            let image = map(&basis(b));
            for (a, &(i, j, sign)) in self.places.iter().enumerate() {
                matrix.row_mut(a)[b] = sign * image[(i, j)];
            }
        }
        matrix
    }
}

/// A step to be solved and differentiated.
#[derive(Clone, Copy)]
struct Step<'t, 's, const N: usize> {
    tangent: &'t Tangent<N>,
    h: f64,
    start: &'s State<N>,
}

impl<'t, const N: usize> Step<'t, '_, N> {
    /// `h a_ij` and `h b_j`.
    fn a(&self, i: usize, j: usize) -> f64 {
        self.h * self.tangent.tableau.a(i, j)
    }

    fn b(&self, j: usize) -> f64 {
        self.h * self.tangent.tableau.b(j)
    }

    /// Solves the equations of `stepper/galerkin.rs` by sweeps.
    fn solved(&self, known: &[State<N>]) -> Result<Solved<N>, Failure> {
        /// More than a step that can be solved takes.
        const MOST_SWEEPS: u32 = 200;
        let Self { tangent, start, .. } = *self;
        let s = tangent.tableau.stages();
        let (zero, p0) = (Mat::zeros(), start.momentum);
        let blank = Stage {
            u: Mat::identity(),
            p: Mat::identity(),
            mu: p0,
            omega: zero,
            x: zero,
            q: zero,
            gradient: zero,
        };
        let mut solved = Solved {
            stages: vec![blank; s],
            f: Mat::identity(),
            p_e: Mat::identity(),
            lambda: p0 * -0.5,
            p1: p0,
        };
        for (stage, known) in solved.stages.iter_mut().zip(known) {
            (stage.u, stage.mu) = (known.attitude, known.momentum);
        }
        for stage in &mut solved.stages {
            stage.omega = tangent.body.velocity(&stage.mu);
        }
        // X follows from attitudes and momenta that are known.
        let passes = if known.len() == s { 8 } else { 2 };
        let mut before = f64::INFINITY;
        for sweep in 0..MOST_SWEEPS {
            self.kinematics(&mut solved)?;
            self.forces(&mut solved)?;
            let change = self.momenta(&mut solved, if sweep == 0 { passes } else { 2 })?;
            if !change.is_finite() {
                return Err(Failure::not_finite(None));
            }
            // Until round-off, or until rounding alone changes it.
            if change <= 2.0 * f64::EPSILON || (change >= before && change <= ROUND_OFF_FLOOR) {
                return Ok(solved);
            }
            before = change;
        }
        Err(Failure::new(FailureCode::MaxIterations, None, before, ROUND_OFF_FLOOR))
    }

    /// U_k, P_k, f and P_e, given Omega_k and the U_k before.
    fn kinematics(&self, solved: &mut Solved<N>) -> Result<(), Failure> {
        let Solved { stages, f, p_e, .. } = solved;
        let s = stages.len();
        let mut moved: Vec<Mat<N>> =
            stages.iter().map(|stage| so::product(&stage.u, &stage.omega)).collect();
        let polar = |a: &Mat<N>, stage: Option<usize>| {
            let singular = Failure::new(FailureCode::LeftGlPlus, stage, 0.0, 0.0);
            let u = so::polar(a).ok_or(singular)?;
            Ok((u, so::symmetric_part(&so::transposed_product(&u, a))))
        };
        for i in 0..s {
            // (24c, vih3)
            let sum = (0..s).fold(Mat::identity(), |sum, j| sum + moved[j] * self.a(i, j));
            (stages[i].u, stages[i].p) = polar(&sum, Some(i))?;
            moved[i] = so::product(&stages[i].u, &stages[i].omega);
        }
        // (24b, vih2)
        let sum = (0..s).fold(Mat::identity(), |sum, j| sum + moved[j] * self.b(j));
        (*f, *p_e) = polar(&sum, None)?;
        Ok(())
    }

    /// dH/dg at the stages, p1 and Lambda: the equations of the stages summed, (24d, vih4) and (24e, vih5).
    fn forces(&self, solved: &mut Solved<N>) -> Result<(), Failure> {
        let start = self.start;
        let mut pi1 = start.momentum;
        for (k, stage) in solved.stages.iter_mut().enumerate() {
            stage.gradient = self.tangent.body.gradient(&so::product(&start.attitude, &stage.u));
            pi1 -= so::conjugate(&stage.u, &stage.gradient) * self.b(k);
        }
        let f = &solved.f;
        solved.p1 = so::transposed_product(f, &so::product(&pi1, f));
        solved.lambda = lyapunov(&solved.p_e, &-solved.p1, &solved.lambda)?;
        Ok(())
    }

    /// X_k, V_k, mu_k and Omega_k. Returns the largest change of a momentum relative to the largest momentum.
    fn momenta(&self, solved: &mut Solved<N>, passes: u32) -> Result<f64, Failure> {
        let Solved { stages, f, lambda, p1, .. } = solved;
        let s = stages.len();
        let f_lambda = so::product(f, lambda);
        let mut turned: Vec<Mat<N>> = stages.iter().map(|k| so::product(&k.u, &k.x)).collect();
        let embedded = |turned: &[Mat<N>], k: usize| {
            (0..s).fold(f_lambda * self.b(k), |v, i| v + turned[i] * self.a(i, k))
        };
        for _ in 0..passes {
            for k in 0..s {
                let stage = &mut stages[k];
                // (17a, f1), (19a, fff1)
                let q = so::transposed_product(&stage.u, &embedded(&turned, k));
                let load = -so::asym(&so::product(&q, &stage.omega)) - stage.gradient * self.b(k);
                stage.x = lyapunov(&stage.p, &load, &stage.x)?;
                turned[k] = so::product(&stage.u, &stage.x);
            }
        }
        let (mut change, mut size) = (0.0_f64, p1.amax());
        for (k, stage) in stages.iter_mut().enumerate() {
            // (24a, vih1), (24f, vih6)
            stage.q = so::transposed_product(&stage.u, &embedded(&turned, k));
            let mu = -so::asym(&stage.q) / self.b(k);
            change = change.max((mu - stage.mu).amax());
            size = size.max(mu.amax());
            stage.mu = mu;
            stage.omega = self.tangent.body.velocity(&mu);
        }
        Ok(if change == 0.0 { 0.0 } else { change / size })
    }

    /// Differentiates the solved equations.
    fn linearised(&self, solved: Solved<N>) -> Result<Found<N>, TangentError> {
        let Self { tangent, h, start } = *self;
        let (s, d) = (solved.stages.len(), tangent.places.len());
        let m = (2 * s + 2) * d;
        let (eta, x, phi, lambda) =
            (|k: usize| k * d, |k: usize| (s + k) * d, 2 * s * d, (2 * s + 1) * d);
        let identity = Mat::identity();
        let Solved { stages, f, p_e, lambda: multiplier, p1 } = &solved;
        let to_end: Vec<Mat<N>> = stages.iter().map(|k| so::transposed_product(f, &k.u)).collect();
        // The rows of the equations by the unknowns, by dOmega and by the start; the end by unknowns and start.
        let mut system = Dense::zeros(m, m);
        let mut by_velocity = Dense::zeros(m, s * d);
        let mut by_start = Dense::zeros(m, 2 * d);
        let mut momenta = Dense::zeros(s * d, m);
        let mut end = End { unknowns: Dense::zeros(2 * d, m), start: Dense::zeros(2 * d, 2 * d) };

        for k in 0..s {
            let Stage { u, p, omega, x: x_k, q, gradient, .. } = &stages[k];
            let b = self.b(k);
            let q_omega = so::product(q, omega);
            // [d-polar] and dP_k X_k of [d-X]
            tangent.add(&mut system, (eta(k), eta(k)), 1.0, p, &identity);
            tangent.add(&mut system, (x(k), x(k)), 1.0, p, &identity);
            tangent.add(
                &mut system,
                (x(k), eta(k)),
                -1.0,
                &identity,
                &(so::product(p, x_k) + q_omega),
            );
            for j in 0..s {
                let (a, other) = (self.a(k, j), &stages[j]);
                if a == 0.0 {
                    continue;
                }
                let r = so::transposed_product(u, &other.u);
                tangent.add(&mut system, (eta(k), eta(j)), -a, &r, &other.omega);
                tangent.add(&mut by_velocity, (eta(k), j * d), -a, &r, &identity);
                let omega_x = so::product(&other.omega, x_k);
                tangent.add(&mut system, (x(k), eta(j)), a, &r, &omega_x);
                tangent.add(&mut by_velocity, (x(k), j * d), a, &r, x_k);
            }
            // [d-V] in [d-mu] and [d-X]
            let back = to_end[k].transpose();
            let lambda_omega = so::product(multiplier, omega);
            tangent.add(&mut momenta, (k * d, eta(k)), 1.0 / b, &identity, q);
            tangent.add(&mut momenta, (k * d, phi), -1.0, &back, multiplier);
            tangent.add(&mut momenta, (k * d, lambda), -1.0, &back, &identity);
            tangent.add(&mut system, (x(k), phi), b, &back, &lambda_omega);
            tangent.add(&mut system, (x(k), lambda), b, &back, omega);
            tangent.add(&mut by_velocity, (x(k), k * d), 1.0, q, &identity);
            for i in 0..s {
                let (a, other) = (self.a(i, k), &stages[i]);
                if a == 0.0 {
                    continue;
                }
                let r = so::transposed_product(u, &other.u);
                tangent.add(&mut momenta, (k * d, eta(i)), -a / b, &r, &other.x);
                tangent.add(&mut momenta, (k * d, x(i)), -a / b, &r, &identity);
                tangent.add(&mut system, (x(k), eta(i)), a, &r, &so::product(&other.x, omega));
                tangent.add(&mut system, (x(k), x(i)), a, &r, omega);
            }
            // dG_k in [d-X] and [d-p1]
            let g = so::product(&start.attitude, u);
            let from_start = u.transpose();
            let hessian = tangent.columns(|e| tangent.body.gradient_rate(&g, e));
            let seen = tangent.columns(|e| {
                let e = so::product(&so::product(&from_start, e), u);
                tangent.body.gradient_rate(&g, &e)
            });
            let commutator = tangent.columns(|e| so::asym(&so::product(e, gradient)));
            let forward = tangent.columns(|e| so::conjugate(&to_end[k], e));
            let mut turned = Dense::zeros(d, d);
            turned.add_product(&forward, &seen);
            add_block(&mut end.start, (d, 0), -b, &turned);
            add_block(&mut by_start, (x(k), 0), b, &seen);
            add_block(&mut system, (x(k), eta(k)), b, &hessian);
            let mut force = hessian;
            add_block(&mut force, (0, 0), 1.0, &commutator);
            let mut turned = Dense::zeros(d, d);
            turned.add_product(&forward, &force);
            add_block(&mut end.unknowns, (d, eta(k)), -b, &turned);
            // [d-end] and dP_e Lambda of [d-Lambda]
            tangent.add(&mut system, (phi, eta(k)), -b, &to_end[k], omega);
            tangent.add(&mut by_velocity, (phi, k * d), -b, &to_end[k], &identity);
            let omega_lambda = so::product(omega, multiplier);
            tangent.add(&mut system, (lambda, eta(k)), b, &to_end[k], &omega_lambda);
            tangent.add(&mut by_velocity, (lambda, k * d), b, &to_end[k], multiplier);
        }
        tangent.add(&mut system, (phi, phi), 1.0, p_e, &identity);
        tangent.add(&mut system, (lambda, lambda), 1.0, p_e, &identity);
        tangent.add(&mut system, (lambda, phi), -1.0, &identity, &so::product(p_e, multiplier));
        // [d-p1], and the end: dg1 = g1 (phi + f^T xi f)
        tangent.add(&mut end.unknowns, (d, phi), -1.0, &identity, p1);
        let turn = tangent.columns(|e| so::transposed_product(f, &so::product(e, f)));
        add_block(&mut end.start, (0, 0), 1.0, &turn);
        add_block(&mut end.start, (d, d), 1.0, &turn);
        for a in 0..d {
            end.unknowns.row_mut(a)[phi + a] = 1.0;
            add_scaled(system.row_mut(lambda + a), end.unknowns.row(d + a), 1.0);
            add_scaled(by_start.row_mut(lambda + a), end.start.row(d + a), 1.0);
        }
        // dOmega_k = J^-1 dmu_k
        let mut velocities = Dense::zeros(s * d, m);
        for row in 0..s * d {
            let (k, a) = (row / d, row % d);
            for (b, &w) in tangent.mobility.row(a).iter().enumerate() {
                if w != 0.0 {
                    add_scaled(velocities.row_mut(row), momenta.row(k * d + b), w);
                }
            }
        }
        system.add_product(&by_velocity, &velocities);
        let factors = Factors::of(system).ok_or(TangentError::Singular)?;
        // M = E_0 - E_y K^-1 B
        let unknowns = factors.solve(&by_start);
        let mut transition = Dense::zeros(2 * d, 2 * d);
        transition.add_product(&end.unknowns, &unknowns);
        for i in 0..2 * d {
            let row = transition.row_mut(i).iter_mut();
            row.zip(end.start.row(i)).for_each(|(x, end)| *x = end - *x);
        }
        let mut of_momenta = Dense::zeros(s * d, 2 * d);
        of_momenta.add_product(&momenta, &unknowns);
        let mut changes = Vec::with_capacity(4 * s * d * d);
        for (k, Stage { u, .. }) in stages.iter().enumerate() {
            let turned = tangent.columns(|e| so::product(&so::product(&u.transpose(), e), u));
            for a in 0..d {
                let eta = changes.len();
                changes.extend(unknowns.row(k * d + a).iter().map(|x| -x));
                add_scaled(&mut changes[eta..], turned.row(a), 1.0);
            }
            for a in 0..d {
                changes.extend(of_momenta.row(k * d + a).iter().map(|x| -x));
            }
        }
        let (f, p1) = (*f, *p1);
        let stages = stages.iter().map(|stage| (stage.u, stage.omega)).collect();
        let (start, transition) = (start.clone(), transition.into_numbers());
        Ok(Found { h, start, stages, f, p1, transition, changes })
    }
}

fn add_block(sum: &mut Dense, (row, column): (usize, usize), factor: f64, block: &Dense) {
    for r in 0..block.rows() {
        add_scaled(&mut sum.row_mut(row + r)[column..], block.row(r), factor);
    }
}

fn lyapunov<const N: usize>(p: &Mat<N>, c: &Mat<N>, guess: &Mat<N>) -> Result<Mat<N>, Failure> {
    if !c.iter().all(|x| x.is_finite()) {
        return Err(Failure::not_finite(None));
    }
    let singular = Failure::new(FailureCode::LyapunovSingular, None, 0.0, 0.0);
    so::lyapunov(p, c, guess).ok_or(singular)
}

/// The change of the end by the unknowns and by the start, 2d rows.
#[derive(Clone, Debug)]
struct End {
    unknowns: Dense,
    start: Dense,
}

/// The derivative of one step, ready to be applied.
#[derive(Clone, Debug)]
pub struct StepTangent<'a, const N: usize> {
    tangent: &'a Tangent<N>,
}

impl<const N: usize> StepTangent<'_, N> {
    /// The end of the step.
    pub fn end(&self) -> State<N> {
        let Found { start, f, p1, .. } = &self.tangent.found;
        let attitude = so::orthonormalised(&so::product(&start.attitude, f));
        State { attitude, momentum: *p1 }
    }

    /// The derivative by the start: 2d x 2d, row by row.
    pub fn transition(&self) -> &[f64] {
        &self.tangent.found.transition
    }

    /// The derivatives by parameters, one after another: 2d numbers for each.
    pub fn by_parameters(&self, rates: &[BodyRate<N>]) -> Vec<f64> {
        let d = self.tangent.places.len();
        let mut columns = Vec::with_capacity(2 * d * rates.len());
        if rates.is_empty() {
            return columns;
        }
        let changes = self.changes();
        for rate in rates {
            // [parameter]
            let mut by_start = vec![0.0; 2 * d];
            let rates = self.rates_at_stages(rate);
            for (rate, row) in rates.iter().zip(changes.chunks_exact(2 * d)) {
                add_scaled(&mut by_start, row, *rate);
            }
            let (by_turn, by_momentum) = by_start.split_at(d);
            let velocity = so::hat::<N>(by_momentum);
            let turned = so::asym(&so::product(&self.tangent.found.start.momentum, &velocity));
            let mut change = by_momentum.to_vec();
            change.extend(so::vee(&turned).iter().zip(by_turn).map(|(x, slope)| x - slope));
            columns.extend(self.push_forward(&change));
        }
        columns
    }

    /// Carries a change of the start, 2d numbers, to the end.
    pub fn push_forward(&self, change: &[f64]) -> Vec<f64> {
        self.transition().chunks_exact(change.len()).map(|row| so::dot(row, change)).collect()
    }

    /// Carries a gradient by the end, 2d numbers, back to the start; also returns what it says of each parameter, the
    /// transpose of `parameter`: with `l = M^T gradient` the rate of F along `(-l_nu, l_xi + [l_nu, mu])`.
    pub fn pull_back(&self, gradient: &[f64], rates: &[BodyRate<N>]) -> (Vec<f64>, Vec<f64>) {
        let d = self.tangent.places.len();
        let mut start = vec![0.0; 2 * d];
        for (row, x) in self.transition().chunks_exact(2 * d).zip(gradient) {
            add_scaled(&mut start, row, *x);
        }
        if rates.is_empty() {
            return (start, Vec::new());
        }
        let (by_turn, by_momentum) = start.split_at(d);
        let momentum = &self.tangent.found.start.momentum;
        let turned = so::vee(&so::asym(&so::product(&so::hat::<N>(by_momentum), momentum)));
        let mut change: Vec<f64> = by_momentum.iter().map(|x| -x).collect();
        change.extend(turned.iter().zip(by_turn).map(|(x, slope)| x + slope));
        let changes = self.changes();
        let along: Vec<f64> =
            changes.chunks_exact(2 * d).map(|row| so::dot(row, &change)).collect();
        let of_parameter = |rate| so::dot(&self.rates_at_stages(rate), &along);
        (start, rates.iter().map(of_parameter).collect())
    }

    /// The changes of the stages with the start, as in [`Found`].
    fn changes(&self) -> Cow<'_, [f64]> {
        let Tangent { vectors, found, .. } = self.tangent;
        match vectors {
            Some(vectors) if found.changes.is_empty() => Cow::Owned(vectors.changes()),
            _ => Cow::Borrowed(&found.changes),
        }
    }

    /// The derivatives of `h b_k dH/dp` by (eta, mu) at the stages, 2d numbers each.
    fn rates_at_stages(&self, rate: &BodyRate<N>) -> Vec<f64> {
        let Tangent { body, tableau, found, .. } = self.tangent;
        let mut rates = Vec::with_capacity(2 * found.stages.len() * self.tangent.places.len());
        for (k, (u, omega)) in found.stages.iter().enumerate() {
            let weight = found.h * tableau.b(k);
            let g = so::product(&found.start.attitude, u);
            rates.extend(so::vee(&(body.gradient_rate_by(rate, &g) * weight)));
            rates.extend(so::vee(&(body.velocity_rate_by(rate, omega) * weight)));
        }
        rates
    }
}
