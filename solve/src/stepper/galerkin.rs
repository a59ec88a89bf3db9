//! The step that all three forms of VPD share: the constrained Galerkin discretisation of Shen, Tran,
//! Leok (2022) on SO(n), solved in a rearranged form.
//!
//! With one skew unknown X_i per stage for the paper's nested inverse of phi~*, and everything in the
//! frame of g0 (U_i here is the paper's g0^T U_i, f = g0^T g1):
//!
//! ```text
//! U_i P_i = I + h sum_j a_ij U_j Omega_j                                            (24c, vih3)
//! f  P_e  = I + h sum_j b_j U_j Omega_j                                             (24b, vih2)
//! V_k  = h b_k f Lambda + h sum_i a_ik U_i X_i
//! P_k X_k + X_k P_k = asym(U_k^T V_k Omega_k^T) - h b_k dH/dg(U_k)                  (17a, f1), (19a, fff1)
//! asym(f Lambda) = -p0 - asym(sum_i U_i X_i)                                        (24d, vih4)
//! mu_k = -asym(U_k^T V_k) / (h b_k)                                                 (24a, vih1)
//! Omega_k = dH/dmu(U_k, mu_k)                                                       (24f, vih6)
//! p1 = -(P_e Lambda + Lambda P_e),    g1 = g0 f                                     (24e, vih5)
//! ```
//!
//! In words: a symplectic partitioned Runge-Kutta method for g and the embedded momentum -V_k / (h b_k),
//! with the polar factor as constraint. The products h a_ij and h b_j enter both halves with the same bits,
//! so the pair is symplectic whatever their rounding. The forms differ in how Omega_k follows from mu_k
//! and in the gradient: that is [`Dynamics`].
//!
//! g0 remains only in dH/dg and, where it depends on the attitude, in dH/dmu. For a free body the step is therefore the reduced
//! Lie-Poisson integrator (25, lp) as it stands, with f_0 = f and Theta_i = U_i^T f.
//!
//! Invariant: a solution is refused where its polar factors are ill-conditioned or on another branch.

use std::any::Any;

use fearless_simd::Level;

use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{BodyAtTime, Rescaled, RigidBody, Scale, WorkAndImpulse};
use crate::lanes::Real;
use crate::nonlinear::{Convergence, Rung, Rungs, Solver, StepHistory, StopRule};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::stepper::checks::{check_continuity, check_singular_value};
use crate::tableau::Tableau;

mod convergence;
mod deferred;
mod motion;
mod stepper_state;
mod sweeps;
mod vectors;

use convergence::{
    COST_OF_A_SWEEP, FAR_ENOUGH, MODEST_STRETCH, MODEST_TURN_SQUARE, MOST_OFF_THE_GROUP,
    SolveError, Solved,
};
use deferred::{AtStage, Collocation, StageSlot, StageValues, StepStart, SystemView, Velocity};
pub(crate) use motion::Motion;
pub(super) use stepper_state::StepperState;
use sweeps::{End, Stage, Sweeps};
use vectors::InVectors;

/// Equations that a form of VPD adds to the shared step. Attitudes `u` are in the frame of g0.
pub(super) trait Dynamics<const N: usize> {
    /// The velocity Omega_k of stage `k` at `u`, given its momentum `mu` and the `omega` before.
    fn velocity(&self, k: usize, u: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N>;

    /// dH/dg = -dL/dg of stage `k` at `u`, left-trivialised, for the momentum `mu`, which is
    /// computed on demand, and the velocity `omega`; less the torque of a driven body; `None` if it
    /// is zero everywhere.
    fn gradient(
        &self,
        k: usize,
        u: &Mat<N>,
        mu: &dyn Fn() -> Mat<N>,
        omega: &Mat<N>,
    ) -> Option<Mat<N>>;

    /// Counts a sweep that begins, or refuses it: see [`crate::work`].
    fn begin_sweep(&self) -> Result<(), Failure>;

    /// The rigid body that moves, if it is one.
    fn body(&self) -> Option<BodyView<'_, N>> {
        None
    }

    /// The largest velocity that belongs to a momentum of size one, in 1/(kg m^2); zero where that is not known.
    fn mobility(&self) -> f64 {
        0.0
    }

    /// Refuses an attitude of stage `k` at which the dynamics are singular.
    fn check(&self, _k: usize, _u: &Mat<N>) -> Result<(), Failure> {
        Ok(())
    }
}

/// A rigid body as a step sees it.
pub(super) struct BodyView<'a, const N: usize> {
    pub(super) body: &'a RigidBody<N>,
    /// The space vectors of its potential, as seen from g0.
    pub(super) vectors: &'a [Vector<N>],
    /// Time scale of a body in a time of its own.
    pub(super) scale: Option<Scale<'a>>,
    /// w in `Omega_ij = w_ij mu_ij`, for a body in principal axes whose velocity is not asked of
    /// its Lagrangian.
    pub(super) weights: Option<&'a Mat<N>>,
}

/// Returns `value` as its type for n = 3.
fn for_three<T: Any, U: Any>(value: &T) -> Option<&U> {
    (value as &dyn Any).downcast_ref()
}

/// The length of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Length {
    /// h.
    pub(crate) h: f64,
    /// Time that the step is to last, if that is what is known, for a system in a time of its own;
    /// h is then a guess, which need not be improved.
    pub(crate) lasting: Option<f64>,
}

impl From<f64> for Length {
    fn from(h: f64) -> Self {
        Self { h, lasting: None }
    }
}

/// The unknowns of a step and their solvers.
#[derive(Clone, Debug)]
pub(super) struct GalerkinStep<const N: usize> {
    tableau: Tableau,
    solver: Solver,
    /// Fast solver, for a tableau that has one.
    collocation: Option<Collocation>,
    /// Fast solver for a rigid body with n = 3 in a time of its own.
    in_vectors: Option<InVectors>,
    /// Previous steps, if they show where the next one leads.
    history: Option<StepHistory>,
    stages: Vec<Stage<N>>,
    end: End<N>,
    solution: Solution<N>,
    seen: Vec<f64>,
}

/// Changes made by a solved step, in the frame of g0, each small by itself.
#[derive(Clone, Debug)]
pub(super) struct Solution<const N: usize> {
    /// f - I.
    pub(super) rotation_increment: Mat<N>,
    /// `pi1 - p0`, added to the momentum by the forces.
    pub(super) impulse: Mat<N>,
    /// `p1 - p0` of an undriven rigid body, where it is known independently of the others.
    pub(super) momentum_increment: Option<Mat<N>>,
    /// The length of the step.
    h: f64,
    by: SolvedBy,
}

/// Solver of a step.
#[derive(Clone, Copy, Debug)]
enum SolvedBy {
    Sweeps,
    /// [`Collocation`].
    Matrices,
    /// [`InVectors`].
    Vectors,
}

/// Where the solution of a step is stored.
enum SolutionRef<'a> {
    /// In the stages of [`GalerkinStep`].
    Sweeps,
    Matrices(&'a Collocation),
    Vectors(&'a InVectors),
}

impl<const N: usize> Solution<N> {
    /// Returns how far f is from a rotation: the largest entry of `f^T f - I`.
    fn off_the_group(&self) -> f64 {
        let change = &self.rotation_increment;
        (change + change.transpose() + so::transposed_product(change, change)).amax()
    }

    /// Refuses a solution that is not finite.
    fn checked(&self) -> Result<(), Failure> {
        let finite = self.rotation_increment.iter().chain(&self.impulse).all(|x| x.is_finite());
        if finite { Ok(()) } else { Err(Failure::not_finite(None)) }
    }
}

impl<const N: usize> GalerkinStep<N> {
    /// A step of `tableau` that is solved until `stop`.
    pub(super) fn new(tableau: Tableau, stop: StopRule) -> Self {
        let zero = Mat::zeros();
        let u = Mat::identity();
        let stage =
            Stage { u, e: zero, mu: zero, omega: zero, u_omega: zero, x: zero, u_x: zero, v: zero };
        let end = End { f: u, e: zero, lambda: zero };
        let (stages, solver) = (vec![stage; tableau.stages()], Solver::new(stop));
        let by_sweeps_alone = stop.rungs == Rungs::Newton;
        let collocation = if by_sweeps_alone { None } else { Collocation::new(&tableau, N) };
        let in_vectors = if by_sweeps_alone || N != 3 { None } else { InVectors::new(&tableau) };
        let solution = Solution {
            rotation_increment: zero,
            impulse: zero,
            momentum_increment: None,
            h: 0.0,
            by: SolvedBy::Sweeps,
        };
        let (history, seen) = (None, Vec::new());
        Self { stages, end, tableau, solver, collocation, in_vectors, history, solution, seen }
    }

    /// Returns this step for steps that follow one another smoothly: each begins where the previous
    /// ones lead, until [`GalerkinStep::forget`].
    pub(super) fn continued(self) -> Self {
        Self { history: Some(StepHistory::default()), ..self }
    }

    /// Returns this step without Newton's method and without previous steps.
    pub(super) fn by_sweeps(&self) -> Self {
        Self { solver: self.solver.by_sweeps(), history: None, ..self.clone() }
    }

    /// Forgets the previous steps: where a stepper starts, so that a resumed run repeats every bit.
    pub(super) fn forget(&mut self) {
        if let Some(history) = &mut self.history {
            history.forget();
        }
        if let Some(collocation) = &mut self.collocation {
            collocation.forget();
        }
    }

    /// Returns this step on an older instruction set, or without lanes.
    pub(super) fn on_level(mut self, level: Option<Level>) -> Self {
        if let Some(collocation) = &mut self.collocation {
            collocation.level = level;
        }
        if let Some(in_vectors) = &mut self.in_vectors {
            in_vectors.level = level;
        }
        self
    }

    /// Order of the scheme.
    pub(super) fn order(&self) -> u32 {
        self.tableau.order()
    }

    /// Solves the step of such a length from the body momentum `p0`, starting from the velocity `omega` at its
    /// beginning, kept constant, or from where the previous steps lead ([`GalerkinStep::forget`]).
    ///
    /// # Errors
    /// Any [`FailureCode`].
    pub(super) fn solve(
        &mut self,
        dynamics: &dyn Dynamics<N>,
        length: impl Into<Length>,
        p0: &Mat<N>,
        omega: &Mat<N>,
    ) -> Result<Convergence, Failure> {
        let length = length.into();
        let turn_rad = Some(angle(length.h, omega));
        self.solved(dynamics, length, p0, omega).map_err(|failure| Failure { turn_rad, ..failure })
    }

    fn solved(
        &mut self,
        dynamics: &dyn Dynamics<N>,
        length: Length,
        p0: &Mat<N>,
        omega: &Mat<N>,
    ) -> Result<Convergence, Failure> {
        if let Some(solved) = self.collocated(dynamics, length, p0, omega)? {
            return Ok(solved);
        }
        if let Some(collocation) = &mut self.collocation {
            collocation.forget();
        }
        let h = length.h;
        (self.solution.by, self.solution.h, self.solution.momentum_increment) =
            (SolvedBy::Sweeps, h, None);
        let Self { tableau, solver, history, stages, end, collocation, .. } = self;
        let cost_in_sweeps = if collocation.is_some() { COST_OF_A_SWEEP } else { 1 };
        let mut equations = Sweeps { tableau, dynamics, h, p0, omega, stages, end, cost_in_sweeps };
        match solver.solve_after(history, &mut equations) {
            Ok(convergence) => {
                self.check(dynamics)?;
                (self.solution.rotation_increment, self.solution.impulse) =
                    self.changes(dynamics, h);
                self.solution.checked()?;
                // Where the equations have no solution nearby, Newton's method may stop at a point
                // that is not one.
                let defect = self.solution.off_the_group();
                if defect <= MOST_OFF_THE_GROUP {
                    Ok(convergence)
                } else {
                    Err(Failure::new(FailureCode::Diverged, None, defect, MOST_OFF_THE_GROUP))
                }
            }
            Err(failure) => Err(failure.explained_by(self.check_dynamics(dynamics))),
        }
    }

    /// Solves the step as collocation with a deferred defect; `None` if it does not converge or a cheap check fails.
    fn collocated(
        &mut self,
        dynamics: &dyn Dynamics<N>,
        length: Length,
        p0: &Mat<N>,
        omega: &Mat<N>,
    ) -> Result<Option<Convergence>, Failure> {
        let in_vectors = self.in_vectors(dynamics, length, p0, omega);
        let solved = match in_vectors.unwrap_or(Err(SolveError::NotConverged)) {
            // Not a body, or not solved there: matrices converge for slightly larger steps.
            Err(SolveError::NotConverged) => self.in_matrices(dynamics, length, p0, omega),
            solved => solved,
        };
        let solved = match solved {
            Ok(solved) => solved,
            Err(SolveError::Cancelled(stopped)) => return Err(stopped),
            Err(SolveError::NotConverged) => return Ok(None),
        };
        let allowed = solved.sweeps <= self.solver.rule().max_iterations;
        if !(allowed
            && solved.stretch * (N as f64) <= MODEST_STRETCH
            && solved.proximity <= FAR_ENOUGH)
        {
            return Ok(None);
        }
        // Where no attitude is far from where the step began, none is far from the next.
        if !(solved.change_square <= MODEST_TURN_SQUARE) && self.check_continuity().is_err() {
            return Ok(None);
        }
        if dynamics.body().is_none_or(|seen| seen.body.has_user_potential()) {
            self.check_dynamics(dynamics)?;
        }
        let Solved { sweeps: iterations, increment, .. } = solved;
        self.solution.checked()?;
        Ok(Some(Convergence { iterations, increment, rung: Rung::FixedPoint }))
    }

    /// Solves the step of a rigid body for n = 3 in a time of its own in vectors; `None` for
    /// anything else.
    fn in_vectors(
        &mut self,
        dynamics: &dyn Dynamics<N>,
        Length { h, lasting }: Length,
        p0: &Mat<N>,
        omega: &Mat<N>,
    ) -> Option<Result<Solved, SolveError>> {
        let in_vectors = self.in_vectors.as_mut()?;
        let BodyView { body, vectors, scale, .. } = dynamics.body()?;
        let (body, scale) = (for_three::<_, RigidBody<3>>(body)?, scale?);
        if body.has_user_potential() {
            return None;
        }
        let vee = |x: &Mat<N>| [x[(2, 1)], x[(0, 2)], x[(1, 0)]];
        let start = vectors::Start { h, lasting, momentum: vee(p0), velocity: vee(omega) };
        let seen = vectors.iter().map(|v| [v[0], v[1], v[2]]);
        let solved = in_vectors.solve(&start, body, seen, scale);
        if let Ok(solved) = &solved {
            let change = in_vectors.change(self.stages.len());
            self.solution = Solution {
                rotation_increment: Mat::from_fn(|i, j| change[(i, j)]),
                impulse: so::hat(&in_vectors.impulse()),
                momentum_increment: Some(so::hat(&in_vectors.momentum_increment())),
                h: solved.h,
                by: SolvedBy::Vectors,
            };
        }
        Some(solved)
    }

    /// Solves the step of any system in matrices.
    fn in_matrices(
        &mut self,
        dynamics: &dyn Dynamics<N>,
        length: Length,
        p0: &Mat<N>,
        omega: &Mat<N>,
    ) -> Result<Solved, SolveError> {
        let Some(collocation) = &mut self.collocation else { return Err(SolveError::NotConverged) };
        let (momentum, velocity) = (p0.transpose(), omega.transpose());
        let (momentum, velocity) = (momentum.as_slice(), velocity.as_slice());
        let Length { h, lasting } = length;
        let stop_early = self.solver.rule().stop_early;
        let angle = angle(h, omega);
        let start = StepStart { n: N, h, angle, lasting, stop_early, momentum, velocity };
        let one_stage = OneStage(dynamics);
        let source = match dynamics.body() {
            Some(BodyView { body, vectors, scale, weights })
                if !body.has_user_potential() && (scale.is_none() || weights.is_some()) =>
            {
                self.seen.clear();
                vectors.iter().for_each(|v| self.seen.extend(v.as_slice()));
                let velocity = match weights {
                    Some(weights) => Velocity::Weights(weights.as_slice(), scale),
                    None => Velocity::Stages(&one_stage),
                };
                SystemView::Body { velocity, terms: body, seen: &self.seen, work: body.work() }
            }
            _ => SystemView::Stages(&one_stage),
        };
        let is_body = matches!(source, SystemView::Body { .. });
        let solved = collocation.solve(&start, source)?;
        self.solution = Solution {
            rotation_increment: Mat::from_row_slice(collocation.rotation_increment()),
            impulse: Mat::from_row_slice(collocation.impulse()),
            momentum_increment: is_body
                .then(|| Mat::from_row_slice(collocation.momentum_increment())),
            h: solved.h,
            by: SolvedBy::Matrices,
        };
        Ok(solved)
    }

    /// Carries a motion from the beginning of the step to its end.
    pub(super) fn carry(&self, motion: &mut Motion<N>) {
        let level = self.collocation.as_ref().and_then(|collocation| collocation.level);
        let Solution { rotation_increment, impulse, momentum_increment, .. } = &self.solution;
        motion.advance(level, [rotation_increment, impulse], momentum_increment.as_ref());
    }

    /// Returns the changes made by the step.
    pub(super) fn solution(&self) -> &Solution<N> {
        &self.solution
    }

    /// Returns where the solution is stored.
    fn solution_ref(&self) -> SolutionRef<'_> {
        match (self.solution.by, &self.collocation, &self.in_vectors) {
            (SolvedBy::Matrices, Some(collocation), _) => SolutionRef::Matrices(collocation),
            (SolvedBy::Vectors, _, Some(in_vectors)) => SolutionRef::Vectors(in_vectors),
            _ => SolutionRef::Sweeps,
        }
    }

    /// U_k, or f after the last stage.
    fn attitude(&self, k: usize) -> Mat<N> {
        match self.solution_ref() {
            SolutionRef::Matrices(collocation) => {
                Mat::identity() + Mat::from_fn(|i, j| collocation.change(k, i * N + j))
            }
            SolutionRef::Vectors(in_vectors) => {
                let change = in_vectors.change(k);
                Mat::identity() + Mat::from_fn(|i, j| change[(i, j)])
            }
            SolutionRef::Sweeps => self.stages.get(k).map_or(self.end.f, |stage| stage.u),
        }
    }

    /// Returns the input of a driven body in a step of length `h`: `h sum_k b_k input_k`.
    pub(super) fn work_and_impulse(
        &self,
        h: f64,
        bodies: &[BodyAtTime<N>],
        g0: &Mat<N>,
    ) -> WorkAndImpulse<N> {
        let mut work_and_impulse = WorkAndImpulse::default();
        for (k, body_at_time) in bodies.iter().enumerate().take(self.stages.len()) {
            let [mu, omega] = self.motion_at(k);
            let g = so::product(g0, &self.attitude(k));
            work_and_impulse.add(h * self.tableau.b(k), &body_at_time.input(&g, &mu, &omega));
        }
        work_and_impulse
    }

    /// mu_k and Omega_k.
    fn motion_at(&self, k: usize) -> [Mat<N>; 2] {
        match self.solution_ref() {
            SolutionRef::Matrices(collocation) => [
                Mat::from_fn(|i, j| collocation.momentum(k, i * N + j)),
                Mat::from_fn(|i, j| collocation.velocity(k, i * N + j)),
            ],
            SolutionRef::Vectors(in_vectors) => {
                let [mu, omega] = in_vectors.motion(k);
                [so::hat(&mu), so::hat(&omega)]
            }
            SolutionRef::Sweeps => [self.stages[k].mu, self.stages[k].omega],
        }
    }

    /// Stage `k` of the last step, in the frame of g0: U_k and mu_k.
    pub(super) fn stage(&self, k: usize) -> Option<State<N>> {
        let there = k < self.stages.len();
        there.then(|| State { attitude: self.attitude(k), momentum: self.motion_at(k)[0] })
    }

    /// Returns how long the step lasted, for a system in a time of its own:
    /// `h sum_k b_k sigma(U_k)`, [time] of docs/derivation.md.
    pub(super) fn lasted(&self, system: &Rescaled<'_, N>, g0: &Mat<N>) -> f64 {
        let in_lanes = system.body.principal().is_some() && !system.body.has_user_potential();
        let sigma = |k: usize| {
            let seen = match self.solution_ref() {
                SolutionRef::Matrices(collocation) if in_lanes => collocation.sigma(k),
                SolutionRef::Vectors(in_vectors) => Some(in_vectors.sigma(k)),
                SolutionRef::Matrices(_) | SolutionRef::Sweeps => None,
            };
            seen.unwrap_or_else(|| system.sigma(&so::product(g0, &self.attitude(k))))
        };
        self.solution.h * (0..self.stages.len()).map(|k| self.tableau.b(k) * sigma(k)).sum::<f64>()
    }

    /// The length of the step that was solved.
    pub(super) fn length(&self) -> f64 {
        self.solution.h
    }

    /// Returns a driven body as it is at the stages and at the end, in a step of length `h` from `time`.
    pub(super) fn bodies(&self, body: &RigidBody<N>, time: f64, h: f64) -> Vec<BodyAtTime<N>> {
        body.over(time, h, (0..self.stages.len()).map(|k| self.tableau.c(k)))
    }

    /// The smallest singular value of the interpolated matrix of stage `k`, or of the end after the last.
    fn smallest_singular_value(&self, k: usize) -> f64 {
        match self.solution_ref() {
            SolutionRef::Vectors(in_vectors) => {
                1.0 + so::smallest_eigenvalue(&in_vectors.stretch(k))
            }
            SolutionRef::Matrices(collocation) => {
                // F = I - P^-1
                let f = Mat::<N>::from_fn(|i, j| collocation.stretch(k, i * N + j));
                1.0 / (1.0 - so::smallest_eigenvalue(&f))
            }
            SolutionRef::Sweeps => {
                let e = self.stages.get(k).map_or(&self.end.e, |stage| &stage.e);
                1.0 + so::smallest_eigenvalue(e)
            }
        }
    }

    /// Returns the changes made by the step of length `h`, in the frame of g0, each small by
    /// itself: `f - I = d - f E_e` for `I + d = f (I + E_e)`, and the impulse of the forces
    ///
    /// ```text
    /// pi1 - p0 = -h sum_k b_k U_k dH/dg(U_k) U_k^T,      p1 = f^T pi1 f
    /// ```
    ///
    /// which is (24d, vih4) and (24e, vih5) with the equations of the stages summed: everything but the forces cancels.
    fn changes(&self, dynamics: &dyn Dynamics<N>, h: f64) -> (Mat<N>, Mat<N>) {
        let (mut d, mut impulse) = (Mat::zeros(), Mat::zeros());
        for (k, stage) in self.stages.iter().enumerate() {
            let weight = h * self.tableau.b(k);
            d += stage.u_omega * weight;
            if let Some(gradient) = dynamics.gradient(k, &stage.u, &|| stage.mu, &stage.omega) {
                impulse -= so::conjugate(&stage.u, &gradient) * weight;
            }
        }
        (d - so::product(&self.end.f, &self.end.e), impulse)
    }

    /// The smallest singular value of the interpolated matrices.
    pub(super) fn sigma_min(&self) -> f64 {
        let values = (0..=self.stages.len()).map(|k| self.smallest_singular_value(k));
        values.fold(f64::INFINITY, f64::min)
    }

    fn stretches(&self) -> impl Iterator<Item = &Mat<N>> {
        self.stages.iter().map(|stage| &stage.e).chain([&self.end.e])
    }

    /// Refuses a solution whose polar factors are ill-conditioned or jump, or at which the dynamics are singular.
    fn check(&self, dynamics: &dyn Dynamics<N>) -> Result<(), Failure> {
        for (k, e) in self.stretches().enumerate() {
            let stage = (k < self.stages.len()).then_some(k);
            // The cheap bound decides nearly always.
            if so::smallest_eigenvalue_bound(e) < -0.5 {
                check_singular_value(1.0 + so::smallest_eigenvalue(e), stage)?;
            }
        }
        self.check_continuity()?;
        self.check_dynamics(dynamics)
    }

    /// See [`check_continuity`].
    fn check_continuity(&self) -> Result<(), Failure> {
        // A quarter turn in one plane: tr(U^T V) = n - 2 + 2 cos.
        let limit = N as f64 - 2.0;
        let stages = self.tableau.ascending().iter().map(|&k| (Some(k), k));
        let nodes = stages.chain([(None, self.stages.len())]);
        let attitudes = nodes.map(|(stage, k)| (stage, self.attitude(k)));
        let trace = |u: &Mat<N>, v: &Mat<N>| so::dot(u.as_slice(), v.as_slice());
        check_continuity(Mat::identity(), attitudes, limit, trace)
    }

    fn check_dynamics(&self, dynamics: &dyn Dynamics<N>) -> Result<(), Failure> {
        (0..self.stages.len()).try_for_each(|k| {
            dynamics
                .check(k, &self.attitude(k))
                .map_err(|failure| Failure { stage: Some(k), ..failure })
        })
    }
}

/// A system at one stage, for [`Collocation`].
struct OneStage<'a, const N: usize>(&'a dyn Dynamics<N>);

/// The angle in rad through which a velocity turns a body in a time: |Omega| is the length of the vector for n = 3, and at
/// least the largest frequency for any n.
fn angle<const N: usize>(h: f64, omega: &Mat<N>) -> f64 {
    h.abs() * so::inner(omega, omega).sqrt()
}

/// The matrix of a stage.
fn of_stage<const N: usize>(matrices: &[f64], StageSlot { stage, stride }: StageSlot) -> Mat<N> {
    Mat::from_fn(|i, j| matrices[(i * N + j) * stride + stage])
}

fn to_stage<const N: usize>(matrix: &Mat<N>, matrices: &mut [f64], at: StageSlot) {
    for i in 0..N {
        for j in 0..N {
            matrices[(i * N + j) * at.stride + at.stage] = matrix[(i, j)];
        }
    }
}

/// Returns U, given U - I.
fn attitude_of<const N: usize>(c: &[f64], at: StageSlot) -> Mat<N> {
    Mat::identity() + of_stage(c, at)
}

impl<const N: usize> AtStage for OneStage<'_, N> {
    fn begin_sweep(&self) -> Result<(), Failure> {
        self.0.begin_sweep()
    }

    fn gradients(&self, stages: usize, stride: usize, at: StageValues<'_>, gradient: &mut [f64]) {
        let StageValues { c, mu, omega } = at;
        let slots = (0..stages).map(|stage| StageSlot { stage, stride });
        let own = self.0.body().filter(|view| view.scale.is_none());
        if let Some(BodyView { body, vectors, .. }) =
            own.filter(|view| view.body.has_user_potential())
        {
            let u: Vec<_> = slots.clone().map(|at| attitude_of(c, at)).collect();
            for (at, found) in slots.zip(body.gradients_seen(&u, vectors)) {
                to_stage(&found, gradient, at);
            }
            return;
        }
        for at in slots {
            let (u, omega) = (attitude_of(c, at), of_stage(omega, at));
            let found = self.0.gradient(at.stage, &u, &|| of_stage(mu, at), &omega);
            to_stage(&found.unwrap_or_else(Mat::zeros), gradient, at);
        }
    }

    fn to_space(&self, at: StageSlot, c: &[f64], x: &[f64], turned: &mut [f64]) {
        to_stage(&so::conjugate(&attitude_of::<N>(c, at), &of_stage(x, at)), turned, at);
    }

    fn velocity(&self, at: StageSlot, c: &[f64], mu: &[f64], omega: &mut [f64]) -> [f64; 2] {
        let before = of_stage(omega, at);
        let now = self.0.velocity(at.stage, &attitude_of(c, at), &of_stage(mu, at), &before);
        to_stage(&now, omega, at);
        // The change of a NaN is a NaN.
        let change =
            (now - before).iter().fold(0.0, |most: f64, x| Real::max_or_nan(most, x.abs()));
        [change, now.amax()]
    }
}
