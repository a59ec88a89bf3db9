//! The step of [`super`] for a symplectic tableau (Gauss), solved as Gauss collocation
//! with a deferred defect: the same equations in another order. The tags are those of
//! docs/derivation.md, where they are derived.
//!
//! With `e_kj = a_kj / b_j`, `W_k = V_k / (h b_k)` and matrices near zero in place of those near I,
//!
//! ```text
//! [C] C_k = U_k - I    c = f - I        [w] w_j = h b_j U_j Omega_j      [D] D_k = sum_j e_kj w_j    d = sum_j w_j
//! [F] U = A (I - F), A = I + D          [K] K = D - C = F + D F          [E] E = P - I = F + F E
//! [T] T_j = U_j X_j                     [Y] Y_k = sum_j e_jk T_j         [S] S_k = sym(U_k^T W_k)
//! ```
//!
//! summing the equations over the stages leaves, for the momentum `pi_k = U_k mu_k U_k^T`,
//!
//! ```text
//! [transport]  pi_k = p0 - sum_j e_kj kappa_j + delta_k          kappa_j = h b_j U_j dH/dg(U_j) U_j^T
//! [end]        pi1 = p0 - sum_j kappa_j
//! [defect]     delta_k = asym(f Lambda K_k^T) - asym(Y_k C_k^T) - sum_j e_kj asym(T_j D_j^T - Y_j w_j^T)
//! ```
//!
//! Without the defect this is Gauss collocation, which takes few products. The defect is small:
//! like K and F it is of order h^(s+1), to which its last two terms, of order h^2 each, cancel. So
//! collocation is solved first, and the defect is evaluated one to three times up to a turn of
//! 0.15 rad, four to eight times in larger steps.
//!
//! The guess continues the polynomials through the stages of the last step (`continue_stages`), which saves
//! sweeps of collocation. Short steps with few stages start from the polynomial through the last
//! nine solutions (`extrapolate`), which saves all sweeps and an evaluation.
//!
//! Everything is computed for all stages at once, in lanes. An operation carries the tag of its
//! result.
//!
//! Invariant: a step that is not solved here to round-off is left to [`super`].

use std::mem::swap;

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use super::convergence::{
    Contraction, LAST_DIGIT, LEAST_TURN_RAD, MODEST_TURN_RAD, MOST_ITERATIONS, PASSES_PER_TORQUE,
    REMEMBERED_STEPS, ROUND_OFF, ROUNDING_CHANGE, SAME_SIGN, SolveError, Solved, USUAL_PASSES,
};
use crate::failure::Failure;
use crate::hamiltonian::{AtStages, Scale, Terms, Torques};
use crate::lanes::{Real, Row, Rows, StageScalar, Stored, WIDTH, in_lanes, widest};
use crate::nonlinear::{Extrapolation, SMALLEST_SIZE, relative};
use crate::stack::{AlignedBuffer, Any, Dimension, Known, StageMatrices};
use crate::tableau::{Tableau, TableauInLanes};
use crate::work;

/// A system as the step sees it.
pub(super) enum SystemView<'a> {
    /// A rigid body in principal axes and a potential of built-in terms.
    Body {
        velocity: Velocity<'a>,
        terms: &'a dyn Terms,
        /// The space vectors of the terms as seen from g0, one after the other.
        seen: &'a [f64],
        work: &'a work::Work,
    },
    /// Any other system, evaluated stage by stage.
    Stages(&'a dyn AtStage),
}

/// How the velocity of a body follows from its momentum.
pub(super) enum Velocity<'a> {
    /// `Omega_ij = w_ij mu_ij`; perhaps in a time of its own.
    Weights(&'a [f64], Option<Scale<'a>>),
    /// Computed by the system, stage by stage.
    Stages(&'a dyn AtStage),
}

/// A system at one stage, whose matrices are stored among those of the others.
pub(super) trait AtStage {
    /// Records that a sweep begins, or refuses it.
    fn begin_sweep(&self) -> Result<(), Failure>;
    /// Computes dH/dg; c is U - I.
    fn gradient(&self, at: StageSlot, c: &[f64], mu: &[f64], omega: &[f64], gradient: &mut [f64]);
    /// Computes `U X U^T`.
    fn to_space(&self, at: StageSlot, c: &[f64], x: &[f64], turned: &mut [f64]);
    /// Improves Omega. Returns its largest change and its size.
    fn velocity(&self, at: StageSlot, c: &[f64], mu: &[f64], omega: &mut [f64]) -> [f64; 2];
}

/// Position of the matrix of a stage: entry e is number `e * stride + stage`.
#[derive(Clone, Copy, Debug)]
pub(super) struct StageSlot {
    pub(super) stage: usize,
    pub(super) stride: usize,
}

/// Start of a step.
pub(super) struct StepStart<'a> {
    /// n.
    pub(super) n: usize,
    pub(super) h: f64,
    /// The angle h |Omega| in rad at its beginning.
    pub(super) angle: f64,
    /// Time that the step is to last, if it is known, for a system in a time of its own; h is then
    /// a guess.
    pub(super) lasting: Option<f64>,
    /// As of [`crate::nonlinear::StopRule`]: whether to stop before an evaluation of the defect whose predicted change is
    /// negligible.
    pub(super) stop_early: bool,
    /// p0 and its velocity, row by row.
    pub(super) momentum: &'a [f64],
    pub(super) velocity: &'a [f64],
}

/// A symplectic tableau in lanes, and the polynomials through the stages of a step.
#[derive(Clone, Debug)]
struct Coefficients {
    tableau: TableauInLanes,
    /// `l_j(1 + c_k)`, column by column: the polynomials that are one at the stage j of a step, and
    /// zero at the others and at its end, at the stages of the next step.
    ahead: [Row; WIDTH],
    /// The same for the end: one there, and zero at the stages.
    ahead_of_end: Row,
}

impl Coefficients {
    fn new(tableau: &Tableau) -> Option<Self> {
        let stages = tableau.stages();
        if !tableau.is_symplectic() {
            return None;
        }
        let in_lanes = TableauInLanes::new(tableau)?;
        let zero = Row::splat(0.0);
        let mut lanes = Self { tableau: in_lanes, ahead: [zero; WIDTH], ahead_of_end: zero };
        let nodes: Vec<f64> = (0..stages).map(|i| tableau.c(i)).chain([1.0]).collect();
        // The polynomial that is one at nodes[j], at t.
        let polynomial = |j: usize, t: f64| -> f64 {
            let others = nodes.iter().enumerate().filter(|(m, _)| *m != j);
            others.map(|(_, node)| (t - node) / (nodes[j] - node)).product()
        };
        for i in 0..stages {
            lanes.ahead_of_end[i] = polynomial(stages, 1.0 + tableau.c(i));
            for j in 0..stages {
                lanes.ahead[j][i] = polynomial(j, 1.0 + tableau.c(i));
            }
        }
        Some(lanes)
    }
}

/// The unknowns of the stages, and scratch space: n x n matrices in lanes, row by row. Skew and
/// symmetric ones are stored in full, except `kappa`, `delta_rest` and some in `scratch`, of which
/// only the entries above the diagonal count (for symmetric ones also those on it).
#[derive(Clone, Debug)]
struct Unknowns {
    /// p0, and the weights of a body, in every lane.
    p0: AlignedBuffer,
    inertia: AlignedBuffer,
    omega: AlignedBuffer,
    mu: AlignedBuffer,
    c: AlignedBuffer,
    d: AlignedBuffer,
    w: AlignedBuffer,
    k: AlignedBuffer,
    f: AlignedBuffer,
    e: AlignedBuffer,
    gradient: AlignedBuffer,
    kappa: AlignedBuffer,
    /// `pi - p0`
    momentum_increment: AlignedBuffer,
    delta: AlignedBuffer,
    /// Part of delta that does not depend on K.
    delta_rest: AlignedBuffer,
    s: AlignedBuffer,
    x: AlignedBuffer,
    t: AlignedBuffer,
    y: AlignedBuffer,
    /// f Lambda, at each stage.
    f_lambda: AlignedBuffer,
    scratch: [AlignedBuffer; 3],
    slopes: Vec<f64>,
    /// Values at the stages, for a system in a time of its own.
    rescaled: AtStages,
    previous: PreviousSteps,
}

/// The last steps, all of one length.
#[derive(Clone, Debug, Default)]
struct PreviousSteps {
    /// The matrices of [`Unknowns::smooth`], of short steps.
    extrapolation: Extrapolation<REMEMBERED_STEPS>,
    /// Length of the last step, whose unknowns are still there.
    h: Option<f64>,
    /// The largest entry of its delta; infinite where that is not known.
    defect: f64,
}

impl Unknowns {
    /// The matrices that change smoothly from step to step, and lead to all others; last Omega,
    /// which the weights of a body lead to.
    fn smooth<'b>(
        &'b mut self,
        end: &'b mut End,
    ) -> (&'b mut Extrapolation<REMEMBERED_STEPS>, [&'b mut AlignedBuffer; 9]) {
        let Self { momentum_increment, c, f, s, x, delta, omega, previous, .. } = self;
        let End { f: end_f, multiplier, .. } = end;
        (
            &mut previous.extrapolation,
            [momentum_increment, c, f, s, x, delta, end_f, multiplier, omega],
        )
    }

    fn new(n: usize, lanes: usize) -> Self {
        let zeros = || AlignedBuffer::zeros(n * n * lanes);
        Self {
            p0: zeros(),
            inertia: zeros(),
            omega: zeros(),
            mu: zeros(),
            c: zeros(),
            d: zeros(),
            w: zeros(),
            k: zeros(),
            f: zeros(),
            e: zeros(),
            gradient: zeros(),
            kappa: zeros(),
            momentum_increment: zeros(),
            delta: zeros(),
            delta_rest: zeros(),
            s: zeros(),
            x: zeros(),
            t: zeros(),
            y: zeros(),
            f_lambda: zeros(),
            scratch: [zeros(), zeros(), zeros()],
            slopes: Vec::new(),
            rescaled: AtStages::default(),
            previous: PreviousSteps::default(),
        }
    }
}

/// The unknowns of the end point.
#[derive(Clone, Debug)]
struct End {
    c: AlignedBuffer,
    d: AlignedBuffer,
    k: AlignedBuffer,
    f: AlignedBuffer,
    /// `f Lambda f^T`
    multiplier: AlignedBuffer,
    /// `pi1 - p0`
    impulse: AlignedBuffer,
    /// `p1 - p0`
    momentum_increment: AlignedBuffer,
    pi: AlignedBuffer,
    scratch: [AlignedBuffer; 2],
}

/// First guess of the unknowns of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum InitialGuess {
    /// [`Step::guess`]
    ConstantVelocity,
    /// From the last step ([`Step::continue_stages`]).
    StagePolynomial,
    /// From the last nine ([`Step::extrapolate`]).
    Extrapolated,
}

/// Solver of the collocation, kept from step to step.
#[derive(Clone, Debug)]
pub(super) struct Collocation {
    coefficients: Coefficients,
    /// The instruction set; without one, one number at a time.
    pub(super) level: Option<Level>,
    /// 2, 4 or 8.
    lanes: usize,
    unknowns: Unknowns,
    end: End,
}

impl Collocation {
    /// Creates the solver for `tableau` in n dimensions; `None` if the tableau is not symplectic, or has more stages than there are lanes.
    pub(super) fn new(tableau: &Tableau, n: usize) -> Option<Self> {
        let coefficients = Coefficients::new(tableau)?;
        // One number at a time would be slower than two.
        let lanes = coefficients.tableau.stages.next_power_of_two().max(2);
        let zeros = || AlignedBuffer::zeros(n * n);
        let end = End {
            c: zeros(),
            d: zeros(),
            k: zeros(),
            f: zeros(),
            multiplier: zeros(),
            impulse: zeros(),
            momentum_increment: zeros(),
            pi: zeros(),
            scratch: [zeros(), zeros()],
        };
        let unknowns = Unknowns::new(n, lanes);
        Some(Self { coefficients, level: Some(Level::new()), lanes, unknowns, end })
    }

    /// Solves a step.
    ///
    /// # Errors
    /// [`SolveError`].
    pub(super) fn solve<'a>(
        &'a mut self,
        start: &'a StepStart<'a>,
        source: SystemView<'a>,
    ) -> Result<Solved, SolveError> {
        let Self { coefficients, level, lanes, unknowns: u, end } = self;
        match (lanes, *level) {
            (2, Some(level)) => {
                widest!(level below Avx512, f64x2, lanes => solve(lanes, coefficients, start, source, u, end),
                else solve_any(Rows([0.0; 2]), coefficients, start, source, u, end))
            }
            (2, None) => solve_any(Rows([0.0; 2]), coefficients, start, source, u, end),
            (4, Some(level)) => {
                widest!(level, f64x4, lanes => solve(lanes, coefficients, start, source, u, end),
                else solve_any(Rows([0.0; 4]), coefficients, start, source, u, end))
            }
            (4, None) => solve_any(Rows([0.0; 4]), coefficients, start, source, u, end),
            (_, Some(level)) => {
                widest!(level, f64x8, lanes => solve(lanes, coefficients, start, source, u, end),
                else solve_any(Rows([0.0; 8]), coefficients, start, source, u, end))
            }
            (_, None) => solve_any(Rows([0.0; 8]), coefficients, start, source, u, end),
        }
    }

    /// Forgets the last steps.
    pub(super) fn forget(&mut self) {
        self.unknowns.previous = PreviousSteps::default();
    }

    /// `f - I`, row by row.
    pub(super) fn rotation_increment(&self) -> &[f64] {
        &self.end.c
    }

    /// `pi1 - p0`, row by row.
    pub(super) fn impulse(&self) -> &[f64] {
        &self.end.impulse
    }

    /// `p1 - p0` of a body, row by row.
    pub(super) fn momentum_increment(&self) -> &[f64] {
        &self.end.momentum_increment
    }

    /// Entry e of `U_k - I`, or of `f - I` after the last stage.
    pub(super) fn change(&self, k: usize, e: usize) -> f64 {
        if k == self.coefficients.tableau.stages {
            self.end.c[e]
        } else {
            self.unknowns.c[e * self.lanes + k]
        }
    }

    /// Returns sigma_k of a system in a time of its own, if it has been evaluated.
    pub(super) fn sigma(&self, k: usize) -> Option<f64> {
        self.unknowns.rescaled.sigma().get(k).copied()
    }

    /// Entry e of mu_k.
    pub(super) fn momentum(&self, k: usize, e: usize) -> f64 {
        self.unknowns.mu[e * self.lanes + k]
    }

    /// Entry e of Omega_k.
    pub(super) fn velocity(&self, k: usize, e: usize) -> f64 {
        self.unknowns.omega[e * self.lanes + k]
    }

    /// Entry e of `I - P_k^-1`, or of the end point after the last stage.
    pub(super) fn stretch(&self, k: usize, e: usize) -> f64 {
        if k == self.coefficients.tableau.stages {
            self.end.f[e]
        } else {
            self.unknowns.f[e * self.lanes + k]
        }
    }
}

/// Selects the code for `start.n` rows.
fn solve<'a, R: StageScalar<StepScalar = f64>>(
    lanes: R,
    coefficients: &'a Coefficients,
    start: &'a StepStart<'a>,
    source: SystemView<'a>,
    unknowns: &'a mut Unknowns,
    end: &'a mut End,
) -> Result<Solved, SolveError> {
    match start.n {
        3 => Step::new(lanes, Known::<3>, coefficients, start, source, unknowns, end).solve(),
        4 => Step::new(lanes, Known::<4>, coefficients, start, source, unknowns, end).solve(),
        5 => Step::new(lanes, Known::<5>, coefficients, start, source, unknowns, end).solve(),
        6 => Step::new(lanes, Known::<6>, coefficients, start, source, unknowns, end).solve(),
        7 => Step::new(lanes, Known::<7>, coefficients, start, source, unknowns, end).solve(),
        8 => Step::new(lanes, Known::<8>, coefficients, start, source, unknowns, end).solve(),
        16 => Step::new(lanes, Known::<16>, coefficients, start, source, unknowns, end).solve(),
        _ => solve_any(lanes, coefficients, start, source, unknowns, end),
    }
}

/// Solves the step for any number of rows.
fn solve_any<'a, R: StageScalar<StepScalar = f64>>(
    lanes: R,
    coefficients: &'a Coefficients,
    start: &'a StepStart<'a>,
    source: SystemView<'a>,
    unknowns: &'a mut Unknowns,
    end: &'a mut End,
) -> Result<Solved, SolveError> {
    Step::new(lanes, Any(start.n), coefficients, start, source, unknowns, end).solve()
}

/// Forces that turn the body, at all stages.
enum Forces<'a, R: StageScalar<StepScalar = f64>, D: Dimension> {
    /// No forces.
    None {
        velocity: Velocity<'a>,
        work: &'a work::Work,
    },
    Body {
        velocity: Velocity<'a>,
        torques: Torques<'a, R, D>,
        work: &'a work::Work,
    },
    Rescaled {
        weights: &'a [f64],
        torques: Torques<'a, R, D>,
        work: &'a work::Work,
        scale: Scale<'a>,
    },
    Stages(&'a dyn AtStage),
}

impl<'a, R: StageScalar<StepScalar = f64>, D: Dimension> Forces<'a, R, D> {
    fn new(stack: StageMatrices<R, D>, source: SystemView<'a>) -> Self {
        match source {
            SystemView::Body { velocity, terms, work, .. } if terms.count() == 0 => {
                Self::None { velocity, work }
            }
            SystemView::Body { velocity, terms, seen, work } => {
                let torques = Torques::new(stack, terms, seen);
                match velocity {
                    Velocity::Weights(weights, Some(scale)) => {
                        Self::Rescaled { weights, torques, work, scale }
                    }
                    velocity => Self::Body { velocity, torques, work },
                }
            }
            SystemView::Stages(system) => Self::Stages(system),
        }
    }
}

/// A step being solved.
struct Step<'a, R: StageScalar<StepScalar = f64>, D: Dimension> {
    stack: StageMatrices<R, D>,
    coefficients: &'a Coefficients,
    start: &'a StepStart<'a>,
    h: f64,
    /// h b_k.
    weights: R,
    /// The largest entry of a momentum.
    size: f64,
    /// The largest angle h |Omega_k| through which the velocity of a stage would turn the body in
    /// the step.
    angle: f64,
    u: &'a mut Unknowns,
    end: &'a mut End,
    forces: Forces<'a, R, D>,
}

impl<'a, R: StageScalar<StepScalar = f64>, D: Dimension> Step<'a, R, D> {
    #[inline(always)]
    fn lanes(&self) -> R {
        self.stack.lanes
    }

    fn new(
        lanes: R,
        dimension: D,
        coefficients: &'a Coefficients,
        start: &'a StepStart<'a>,
        source: SystemView<'a>,
        u: &'a mut Unknowns,
        end: &'a mut End,
    ) -> Self {
        let stack = StageMatrices { lanes, dimension };
        let forces = Forces::new(stack, source);
        let weights = lanes.row(&coefficients.tableau.weights) * start.h;
        let (h, size, angle) = (start.h, 0.0, 0.0);
        Self { stack, coefficients, start, h, weights, size, angle, u, end, forces }
    }

    fn solve(mut self) -> Result<Solved, SolveError> {
        self.load();
        // In a time of its own the last step of a run has another length.
        let is_even = !matches!(self.forces, Forces::Rescaled { .. });
        let continues = is_even && self.u.previous.h.take() == Some(self.h);
        let is_short = is_even && self.is_short();
        if !(is_short && continues) {
            self.u.previous.extrapolation.forget();
        }
        let initial_guess = if is_short && self.extrapolate() {
            InitialGuess::Extrapolated
        } else if continues && self.start.angle <= MODEST_TURN_RAD {
            self.continue_stages();
            InitialGuess::StagePolynomial
        } else {
            self.guess();
            InitialGuess::ConstantVelocity
        };
        let mut solved = self.solve_from(initial_guess);
        if initial_guess != InitialGuess::ConstantVelocity
            && matches!(solved, Err(SolveError::NotConverged))
        {
            self.u.previous.extrapolation.forget();
            self.guess();
            solved = self.solve_from(InitialGuess::ConstantVelocity);
        }
        let solved = solved?;
        if is_short {
            self.keep();
        }
        self.u.previous.h = is_even.then_some(self.h);
        Ok(solved)
    }

    /// Is the step so short that extrapolation of the last steps is nearer to its solution than the guess, and
    /// the order of the stages so low that this saves evaluations of the defect?
    fn is_short(&self) -> bool {
        // rad; with more stages collocation needs few sweeps, and the first evaluation is often the last.
        let short = match self.coefficients.tableau.stages {
            1..=3 => 0.08,
            4 => 0.03,
            _ => 0.0,
        };
        self.start.angle <= short
    }

    /// Is Omega the momentum times weights?
    fn has_weights(&self) -> bool {
        matches!(
            self.forces,
            Forces::None { velocity: Velocity::Weights(..), .. }
                | Forces::Body { velocity: Velocity::Weights(..), .. }
        )
    }

    /// Solves the step from such a guess.
    fn solve_from(&mut self, initial_guess: InitialGuess) -> Result<Solved, SolveError> {
        let stages = self.coefficients.tableau.stages;
        let is_extrapolated = initial_guess == InitialGuess::Extrapolated;
        let mut sweeps = 0;
        if is_extrapolated {
            self.momenta_from_space();
            self.measure();
            self.attitudes_of_factors();
        } else {
            sweeps = self.collocate()?;
        }
        self.polar_factors();
        self.gradients()?;
        self.transport();
        if !is_extrapolated {
            self.first_symmetric_parts();
        }
        let angle = self.angle.min(1.0);
        let expected = self.contraction_of_an_evaluation();
        // Error allowed in the momenta at the end, and in the estimate of the defect.
        let goal = SAME_SIGN * self.rounding();
        let allowed = if is_extrapolated { goal } else { self.allowed() };
        // X and S depend on each other: one Gauss-Seidel pass over both leaves a relative error of turn / 2.
        let is_small = !is_extrapolated
            && 0.5 * angle * self.u.previous.defect <= allowed.min(self.rounding());
        let passes_twice = !is_extrapolated && !is_small && (stages >= 4 || angle > 0.3);
        // From a cold start a small first increment says nothing about convergence. X and S of a polynomial have equal
        // errors, and the first evaluation leaves the error of S, times half the turn, in X.
        let mut evaluations = match (is_extrapolated, is_small) {
            (true, _) => Contraction::new(0.1 * angle, 0.0),
            (false, true) => Contraction::new(0.5 * angle, self.u.previous.defect),
            (false, false) => Contraction::new(
                expected,
                self.coefficients.tableau.order_of_defect(self.angle) * self.size,
            ),
        };
        let mut residual = 0.0;
        for evaluation in 1..=MOST_ITERATIONS {
            sweeps += 1;
            if evaluation > 1 || !is_extrapolated {
                self.end_point(1);
            }
            self.end_at_stages();
            self.multipliers();
            if evaluation > 1 || passes_twice {
                self.embed();
                self.multipliers();
            }
            let jump = self.defects();
            let momenta = self.momenta_from_space();
            if evaluation == 1 {
                self.u.previous.defect = if is_extrapolated { f64::INFINITY } else { jump };
            }
            let floor = evaluations.at_floor(jump, self.size);
            // The defect contains the error of the attitudes at its evaluation, times the turn.
            let left = evaluations.left(jump).max(angle * residual);
            // With few stages the first evaluation has not reached its order yet.
            let is_last =
                (left <= allowed || floor) && (stages >= 4 || evaluation > 1 || is_extrapolated);
            if is_last {
                // At first, where it follows, the forces are those of these attitudes.
                let is_solved = is_extrapolated
                    && evaluation == 1
                    && momenta * self.contraction_of_a_pass() <= goal;
                let increment =
                    if is_solved { momenta } else { self.pass_until(momenta, goal, true)?.last };
                self.end_step(if is_extrapolated { 1 } else { 2 });
                return Ok(self.judged(sweeps, increment / self.size));
            }
            let enough = (0.3 * left * expected / self.clear_angle()).max(0.3 * goal);
            residual = self.pass_until(momenta, enough, false)?.left;
            self.gradients()?;
            if !jump.is_finite() {
                break;
            }
        }
        Err(SolveError::NotConverged)
    }

    /// Contraction of the error of the defect by an evaluation, assumed until it is measured.
    fn contraction_of_an_evaluation(&self) -> f64 {
        let angle = self.angle.min(1.0);
        (0.2 * if self.coefficients.tableau.stages == 1 { angle } else { angle * angle }).min(0.1)
    }

    /// The error of a momentum that, times the turn, rotates the end of the step by a rounding error.
    fn rounding(&self) -> f64 {
        ROUND_OFF * self.size / self.clear_angle()
    }

    /// The turn by which errors are divided, bounded below: a body that hardly turns keeps the digits of its momentum.
    fn clear_angle(&self) -> f64 {
        self.angle.clamp(LEAST_TURN_RAD, 1.0)
    }

    /// Error allowed in the defect, by the estimate; with up to four stages the true one is far below that.
    fn allowed(&self) -> f64 {
        self.rounding()
            * match (self.start.stop_early, self.coefficients.tableau.stages) {
                (false, _) => LAST_DIGIT,
                (true, ..=4) => 10.0,
                (true, _) => 1.0,
            }
    }

    /// Computes what the step changes, the turn in such a number of passes.
    fn end_step(&mut self, passes: usize) {
        self.spatial_velocities();
        self.transport();
        self.end_point(passes);
        if !matches!(self.forces, Forces::Stages(_)) {
            self.momentum_increment();
        }
    }

    /// Solves Gauss collocation, without the defect, until the error left is smaller than the
    /// defect.
    fn collocate(&mut self) -> Result<u32, SolveError> {
        let is_rescaled = matches!(self.forces, Forces::Rescaled { .. });
        let mut last = f64::INFINITY;
        for sweep in 1..=MOST_ITERATIONS {
            self.gradients()?;
            let jump = self.momenta_in_body();
            if is_rescaled {
                // Momenta and attitudes depend on each other through sigma and H - H0.
                for _ in 0..PASSES_PER_TORQUE {
                    self.attitudes();
                    self.momenta_in_body();
                }
                self.attitudes();
            } else {
                // A second evaluation costs little compared with a torque.
                self.momenta_in_body();
                self.attitudes();
            }
            self.measure();
            if !(jump <= 1e3 * self.size) {
                break;
            }
            let ratio = if sweep == 1 { 0.05 * self.angle * self.angle } else { jump / last };
            // The error left here enters the defect times the turn, and stays in it if one evaluation suffices.
            let is_evaluated_once =
                self.contraction_of_an_evaluation() * self.u.previous.defect <= self.allowed();
            let goal = if is_evaluated_once {
                0.1 * self.rounding() / self.clear_angle()
            } else {
                (0.1 * self.coefficients.tableau.order_of_defect(self.angle)).max(ROUND_OFF)
                    * self.size
            };
            let is_last = jump * ratio.min(1.0) <= goal;
            // The next torque needs no better attitudes in a step of less than 0.25 rad.
            if (is_last || self.angle > 0.25) && !is_rescaled {
                self.attitudes();
            }
            if is_last {
                return Ok(sweep);
            }
            last = jump;
        }
        Err(SolveError::NotConverged)
    }

    /// Contraction of an error by a pass, assumed until it is measured.
    fn contraction_of_a_pass(&self) -> f64 {
        (0.15 * self.angle).clamp(0.01, 0.3)
    }

    /// Repeats passes over attitudes and momenta, with the slow part of the defect kept, until the
    /// error left in the momenta is `goal`; with new forces in each pass, or with the last ones.
    fn pass_until(&mut self, before: f64, goal: f64, forced: bool) -> Result<Passed, SolveError> {
        let mut passes = Contraction::new(self.contraction_of_a_pass(), before);
        for pass in 0..MOST_ITERATIONS {
            // New forces count as a sweep by themselves.
            self.begin_pass(if forced { 0 } else { pass })?;
            // Stiff forces contract slowly; after half the passes accept one rounding error.
            let is_slow = forced && pass >= MOST_ITERATIONS / 2;
            let goal = if is_slow { goal.max(self.rounding()) } else { goal };
            // In a plane a momentum does not depend on the attitude.
            let sees = self.start.n > 2;
            if !sees {
                self.u.t.copy_from_slice(&self.u.c);
            }
            self.attitudes();
            self.polar_factors();
            self.newest_defects();
            if forced {
                self.gradients()?;
            }
            self.transport();
            let momenta = self.momenta_from_space();
            let jump = if sees { momenta } else { momenta.max(self.turned()) };
            let floor = passes.at_floor(jump, self.size)
                || forced && jump <= ROUNDING_CHANGE * ROUND_OFF * self.size;
            let mut left = passes.left(jump);
            if forced && pass == 0 {
                // What forces leave depends on how stiff they are.
                left = left.max(jump * (jump / before).min(1.0));
            }
            if left <= goal || floor {
                return Ok(Passed { last: jump, left: if floor { 0.0 } else { left } });
            }
            if !jump.is_finite() {
                break;
            }
        }
        Err(SolveError::NotConverged)
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        match &self.forces {
            Forces::None { work, .. }
            | Forces::Body { work, .. }
            | Forces::Rescaled { work, .. } => work.begin_sweep(),
            Forces::Stages(system) => system.begin_sweep(),
        }
    }

    fn begin_pass(&self, pass: u32) -> Result<(), Failure> {
        if pass >= USUAL_PASSES {
            self.begin_sweep()?;
        } else if let Forces::None { work, .. }
        | Forces::Body { work, .. }
        | Forces::Rescaled { work, .. } = &self.forces
        {
            work.add_pass();
        }
        Ok(())
    }

    fn gradients(&mut self) -> Result<(), Failure> {
        self.begin_sweep()?;
        if matches!(self.forces, Forces::Rescaled { .. }) {
            self.evaluate_time_scale();
            return Ok(());
        }
        let Unknowns { c, mu, omega, gradient, slopes, .. } = &mut *self.u;
        match &mut self.forces {
            Forces::None { .. } | Forces::Rescaled { .. } => {}
            Forces::Body { torques, work, .. } => {
                work.add_gradients(self.coefficients.tableau.stages as u64);
                torques.gradient(c, slopes, gradient);
            }
            Forces::Stages(system) => {
                for stage in 0..self.coefficients.tableau.stages {
                    system.gradient(StageSlot { stage, stride: R::LANES }, c, mu, omega, gradient);
                }
            }
        }
        Ok(())
    }

    /// Evaluates [time]: the forces and the time of the stages, and the length of a step that is to
    /// last a given time, `h = t / sum_k b_k sigma_k`.
    fn evaluate_time_scale(&mut self) {
        if let Forces::Rescaled { work, .. } = &self.forces {
            work.add_gradients(self.coefficients.tableau.stages as u64);
        }
        self.scales();
        self.velocities_in_lanes();
        if let Some(lasting) = self.start.lasting {
            let TableauInLanes { weights, stages, .. } = &self.coefficients.tableau;
            let sigma = self.u.rescaled.sigma();
            let mean: f64 = (0..*stages).map(|k| weights[k] * sigma[k]).sum();
            self.h = lasting / mean;
            self.weights = self.stack.lanes.row(weights) * self.h;
        }
    }

    in_lanes! {
    /// Evaluates sigma and the forces.
    fn scales(&mut self) {
        if let Forces::Rescaled { torques, scale, .. } = &mut self.forces {
            let Unknowns { c, rescaled, .. } = &mut *self.u;
            rescaled.evaluate_forces(torques, scale, c);
        }
    }

    fn velocities_in_lanes(&mut self) {
        self.velocities();
    }

    /// Spreads p0, and the weights of a body, over all lanes.
    fn load(&mut self) {
        let Self { stack, start, u, forces, .. } = self;
        if let Forces::None { velocity: Velocity::Weights(weights, _), .. }
        | Forces::Body { velocity: Velocity::Weights(weights, _), .. }
        | Forces::Rescaled { weights, .. } = forces
        {
            stack.spread(weights, &mut u.inertia);
        }
        stack.spread(start.momentum, &mut u.p0);
    }

    /// Remembers the solution.
    fn keep(&mut self) {
        let without = usize::from(self.has_weights());
        let (extrapolation, smooth) = self.u.smooth(self.end);
        let count = smooth.len() - without;
        extrapolation.add(smooth.into_iter().take(count).map(|matrix| &matrix[..]));
    }

    /// Extrapolates the unknowns from the last steps, if enough of them are known.
    fn extrapolate(&mut self) -> bool {
        let without = usize::from(self.has_weights());
        let (extrapolation, smooth) = self.u.smooth(self.end);
        let count = smooth.len() - without;
        let is_known = extrapolation.is_known();
        if is_known {
            let matrices = smooth.into_iter().take(count).map(|matrix| &mut matrix[..]);
            extrapolation.extrapolate(self.stack.lanes, matrices);
        }
        is_known
    }

    /// [w], [D], [K] and [C] with the current F, also of the end point.
    fn attitudes_of_factors(&mut self) {
        let Self { stack, coefficients, weights, u, end, .. } = self;
        let Unknowns { w, c, d, f, k, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
        stack.combination(w, &coefficients.tableau.columns, d);
        stack.plus_product(f, d, f, k);
        stack.difference(d, k, c);
        let (one, End { c, d, f, k, .. }) = (stack.whole(), &mut **end);
        stack.sum_of_stages(w, d);
        one.plus_product(f, d, f, k);
        one.difference(d, k, c);
    }

    /// Guesses the unknowns from the initial velocity, kept constant.
    fn guess(&mut self) {
        let Self { stack, start, coefficients, u, .. } = self;
        u.previous.defect = f64::INFINITY;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let angle = lanes.row(&coefficients.tableau.nodes) * start.h;
        let Unknowns { p0, omega, mu, c, .. } = &mut **u;
        let velocity = &start.velocity[..n * n];
        let (omega, c) = (&mut omega[..len], &mut c[..len]);
        for i in 0..n {
            for j in 0..n {
                let turning = lanes.spread(velocity[i * n + j]);
                stack.put(omega, i, j, turning);
                let mut square = 0.0;
                for k in 0..n {
                    square += velocity[i * n + k] * velocity[k * n + j];
                }
                // exp(c h Omega) - I up to the square
                stack.put(c, i, j, angle * (turning + angle * (0.5 * square)));
            }
        }
        mu.copy_from_slice(p0);
        self.guess_no_defect();
    }

    /// Guesses momenta and attitudes from the last step, continued as polynomials in time: `mu_j`
    /// and, relative to its end, `f^T U_j`.
    fn continue_stages(&mut self) {
        let Self { stack, coefficients, u, end, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { p0, mu, c, scratch: [rotation, seen, _], .. } = &mut **u;
        stack.spread(&end.c, rotation);
        stack.plus_transposed_product(c, rotation, c, seen);
        let columns = stack.lanes.rows(&coefficients.ahead);
        let at_end = stack.lanes.row(&coefficients.ahead_of_end);
        {
            let (c, rotation, seen) = (&mut c[..len], &rotation[..len], &mut seen[..len]);
            for i in 0..n {
                for j in 0..n {
                    stack.put(seen, i, j, stack.get(seen, i, j) + stack.get(rotation, j, i));
                    // zero at the end
                    let ahead = R::combination(&seen[(i * n + j) * R::LANES..], &columns);
                    stack.put(c, i, j, ahead);
                }
            }
            let (p0, mu) = (&p0[..len], &mut mu[..len]);
            for i in 0..n {
                for j in i + 1..n {
                    let ahead = R::combination(&mu[(i * n + j) * R::LANES..], &columns);
                    stack.put_skew(mu, i, j, at_end * stack.get(p0, i, j) + ahead);
                }
            }
        }
        self.velocities();
        self.u.delta.fill(0.0);
        // The attitudes that these momenta lead to: the first torque depends on them.
        self.attitudes();
    }

    /// Computes `mu_k = p0 + sum_j e_kj h b_j ([mu_j, Omega_j] - dH/dg_j)`, and Omega. This is
    /// Gauss collocation of `mu' = [mu, Omega] - dH/dg` in the body, which differs from [transport]
    /// by the order h^(s+1), that of delta. It needs one product, where [transport] needs two to
    /// turn pi into the body, and a polar factor. Returns the largest change of a momentum.
    fn momenta_in_body(&mut self) -> f64 {
        self.rates();
        let Self { stack, coefficients, u, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { p0, mu, scratch: [rate, ..], .. } = &mut **u;
        let (p0, mu, rate) = (&p0[..len], &mut mu[..len], &rate[..len]);
        let columns = lanes.rows(&coefficients.tableau.columns);
        let mut jump = lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let momentum_increment = R::combination(&rate[(i * n + j) * R::LANES..], &columns);
                let now = stack.get(p0, i, j) + momentum_increment;
                jump = jump.max_or_nan((now - stack.get(mu, i, j)).abs());
                stack.put_skew(mu, i, j, now);
            }
        }
        self.velocities().max(jump.largest())
    }

    /// [w]
    fn spatial_velocities(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let Unknowns { w, c, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
    }

    /// [w], [D] and [C], with the current K: (24c, vih3).
    fn attitudes(&mut self) {
        let Self { stack, coefficients, weights, u, .. } = self;
        let Unknowns { w, c, d, k, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
        stack.combination(w, &coefficients.tableau.columns, d);
        stack.difference(d, k, c);
    }

    /// Measures the largest momentum, and the largest turn of a step by a stage's velocity.
    fn measure(&mut self) {
        let Self { stack, h, u, size, angle, .. } = self;
        let (len, lanes) = (stack.numbers(), stack.lanes);
        let (omega, mu) = (&u.omega[..len], &u.mu[..len]);
        let (mut square, mut largest) = (lanes.constant(0.0), lanes.constant(0.0));
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                let omega = stack.get(omega, i, j);
                square = square + omega * omega;
                largest = largest.max_or_nan(stack.get(mu, i, j).abs());
            }
        }
        // Avoids 0 / 0 for a body at rest.
        *size = largest.largest().max_or_nan(SMALLEST_SIZE);
        *angle = h.abs() * square.largest().sqrt();
    }

    /// [F], [K] and [C]: (24c, vih3).
    fn polar_factors(&mut self) {
        let Self { stack, u, .. } = self;
        let Unknowns { d, c, f, k, scratch: [scratch, ..], .. } = &mut **u;
        polar_factor(*stack, d, c, f, k, scratch);
    }

    /// [transport]: pi - p0.
    fn transport(&mut self) {
        let Self { stack, coefficients, weights, u, forces, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { c, kappa, momentum_increment, delta, gradient, slopes, rescaled, .. } = &mut **u;
        match forces {
            Forces::None { .. } => {
                momentum_increment.copy_from_slice(delta);
                return;
            }
            Forces::Body { torques, .. } => torques.spatial_gradient(c, slopes, kappa),
            Forces::Rescaled { torques, .. } => rescaled.spatial_gradient(torques, c, slopes, kappa),
            Forces::Stages(system) => {
                for stage in 0..coefficients.tableau.stages {
                    system.to_space(StageSlot { stage, stride: R::LANES }, c, gradient, kappa);
                }
            }
        }
        let (kappa, momentum_increment, delta) = (&mut kappa[..len], &mut momentum_increment[..len], &delta[..len]);
        let columns = lanes.rows(&coefficients.tableau.columns);
        for i in 0..n {
            for j in i + 1..n {
                stack.put(kappa, i, j, *weights * stack.get(kappa, i, j));
            }
        }
        for i in 0..n {
            for j in i + 1..n {
                let impulses = R::combination(&kappa[(i * n + j) * R::LANES..], &columns);
                stack.put_skew(momentum_increment, i, j, stack.get(delta, i, j) - impulses);
            }
        }
    }

    /// Computes `mu = U^T pi U`, as `p0 + (pi - p0) + asym(pi C) + C^T pi C`, and Omega. Returns
    /// the largest change of a momentum.
    fn momenta_from_space(&mut self) -> f64 {
        let Self { stack, u, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { p0, mu, c, momentum_increment, scratch: [pi, turned, twice], .. } = &mut **u;
        let (p0, mu, c, momentum_increment) = (&p0[..len], &mut mu[..len], &c[..len], &momentum_increment[..len]);
        let (pi, turned, twice) = (&mut pi[..len], &mut turned[..len], &mut twice[..len]);
        stack.sum(p0, momentum_increment, pi);
        stack.product(pi, c, turned);
        stack.upper_of_transposed_product(c, turned, twice);
        let mut jump = lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let once = stack.get(turned, i, j) - stack.get(turned, j, i);
                let momentum_increment = stack.get(momentum_increment, i, j) + (once + stack.get(twice, i, j));
                let now = stack.get(p0, i, j) + momentum_increment;
                jump = jump.max_or_nan((now - stack.get(mu, i, j)).abs());
                stack.put_skew(mu, i, j, now);
            }
        }
        self.velocities().max(jump.largest())
    }

    /// [S] to first order: `-sum_j e_jk h b_j (Omega_j mu_j + mu_j Omega_j) / 4`.
    fn first_symmetric_parts(&mut self) {
        let Self { stack, coefficients, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, s, scratch: [product, both, _], .. } = &mut **u;
        stack.product(omega, mu, product);
        let (product, both, s) = (&product[..len], &mut both[..len], &mut s[..len]);
        for i in 0..n {
            for j in i..n {
                // mu Omega = (Omega mu)^T
                let sum = stack.get(product, i, j) + stack.get(product, j, i);
                stack.put(both, i, j, *weights * sum * -0.25);
            }
        }
        let columns = stack.lanes.rows(&coefficients.tableau.rows);
        for i in 0..n {
            for j in i..n {
                let part = R::combination(&both[(i * n + j) * R::LANES..], &columns);
                stack.put(s, i, j, part);
                stack.put(s, j, i, part);
            }
        }
    }

    /// Computes [end] and [Lambda]: the polar factor of the end point, (24b, vih2), in `passes`
    /// passes, pi1, and the multiplier by (6) of the derivation, `Lambda_s = -(pi1 + asym(E_s Lambda_s)) / 2` with
    /// `Lambda_s = f Lambda f^T` and `E_s = f E f^T = k f^T`, which is (24e, vih5).
    fn end_point(&mut self, passes: usize) {
        let Self { stack, start, u, end, .. } = self;
        let (n, len, one) = (stack.n(), stack.numbers(), stack.whole());
        let Unknowns { w, kappa, .. } = &mut **u;
        let (kappa, whole) = (&kappa[..len], one.numbers());
        let End { c, d, k, f: end_f, multiplier, impulse, pi, scratch: [a, b], .. } = &mut **end;
        let (c, d, k) = (&mut c[..whole], &mut d[..whole], &mut k[..whole]);
        let (multiplier, impulse) = (&mut multiplier[..whole], &mut impulse[..whole]);
        let (pi, a, b) = (&mut pi[..whole], &mut a[..whole], &mut b[..whole]);
        stack.sum_of_stages(w, d);
        one.difference(d, k, c);
        for _ in 0..passes {
            polar_factor(one, d, c, end_f, k, a);
        }
        for i in 0..n {
            for j in i + 1..n {
                one.put_skew(impulse, i, j, -stack.get(kappa, i, j).sum());
            }
        }
        one.sum(start.momentum, impulse, pi);
        // E_s = k f^T, symmetric: f k^T = k^T + c k^T
        for i in 0..n {
            for j in 0..n {
                b[i * n + j] = k[j * n + i];
            }
        }
        one.plus_product(b, c, b, a);
        one.product(a, multiplier, b);
        for i in 0..n {
            for j in i + 1..n {
                let stretched = b[i * n + j] - b[j * n + i];
                one.put_skew(multiplier, i, j, (pi[i * n + j] + stretched) * -0.5);
            }
        }
    }

    /// Takes `f Lambda = Lambda_s f` to all stages, and computes [E] there.
    fn end_at_stages(&mut self) {
        let Self { stack, u, end, .. } = self;
        let Unknowns { f, e, f_lambda, scratch: [next, ..], .. } = &mut **u;
        let End { c, multiplier, scratch: [f_lambda_once, _], .. } = &mut **end;
        stack.whole().plus_product(multiplier, multiplier, c, f_lambda_once);
        stack.spread(f_lambda_once, f_lambda);
        stack.plus_product(f, f, e, next);
        swap(e, next);
    }

    /// [gain]: `p1 - p0 = sum_k h b_k ([mu_k, Omega_k] - dH/dg(U_k))`, the equations of X summed
    /// over the stages.
    fn momentum_increment(&mut self) {
        self.rates();
        let Self { stack, u, end, .. } = self;
        let (rate, momentum_increment) = (&u.scratch[0][..stack.numbers()], &mut *end.momentum_increment);
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                stack.whole().put_skew(momentum_increment, i, j, stack.get(rate, i, j).sum());
            }
        }
    }

    /// Computes [X], by (5) of the derivation:
    /// `X = -(h b / 2) (asym(S Omega) - [mu, Omega] / 2 + dH/dg) - asym(E X) / 2`, which is
    /// (17a, f1) and (19a, fff1).
    fn multipliers(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, s, e, x, gradient, scratch: [half, load, stretched], .. } = &mut **u;
        // [mu, Omega] = asym(mu Omega); for skew B, asym(A B) = -asym(A B^T)
        let (mu, s, half) = (&mu[..len], &s[..len], &mut half[..len]);
        for entry in 0..len {
            half[entry] = 0.5 * mu[entry] - s[entry];
        }
        stack.asym_of_product(half, omega, load);
        stack.asym_of_product(e, x, stretched);
        let (load, stretched, gradient) = (&load[..len], &stretched[..len], &gradient[..len]);
        let x = &mut x[..len];
        for i in 0..n {
            for j in i + 1..n {
                let load = stack.get(load, i, j) + stack.get(gradient, i, j);
                let part = stack.get(stretched, i, j) - *weights * load;
                stack.put_skew(x, i, j, part * 0.5);
            }
        }
    }

    /// [T], [Y] and [S]
    fn embed(&mut self) {
        let Self { stack, coefficients, u, .. } = self;
        let Unknowns { c, x, t, y, s, f_lambda, scratch: [w, turned, _], .. } = &mut **u;
        stack.plus_product(x, c, x, t);
        stack.combination(t, &coefficients.tableau.rows, y);
        stack.sum(f_lambda, y, w);
        stack.plus_transposed_product(w, c, w, turned);
        stack.symmetric_part(turned, s);
    }

    /// Evaluates the part of [defect] that does not depend on K:
    /// `-asym(Y_k C_k^T) - sum_j e_kj asym(T_j D_j^T - Y_j w_j^T)`.
    fn slow_defects(&mut self) {
        let Self { stack, coefficients, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { c, d, w, t, y, delta_rest, scratch: [part, of_y, of_stage], .. } = &mut **u;
        stack.asym_of_product(t, d, part);
        stack.asym_of_product(y, w, of_y);
        stack.asym_of_product(y, c, of_stage);
        let (part, of_y, of_stage) = (&mut part[..len], &of_y[..len], &of_stage[..len]);
        let delta_rest = &mut delta_rest[..len];
        for i in 0..n {
            for j in i + 1..n {
                stack.put(part, i, j, stack.get(part, i, j) - stack.get(of_y, i, j));
            }
        }
        let columns = stack.lanes.rows(&coefficients.tableau.columns);
        for i in 0..n {
            for j in i + 1..n {
                let sum = R::combination(&part[(i * n + j) * R::LANES..], &columns);
                stack.put(delta_rest, i, j, -(stack.get(of_stage, i, j) + sum));
            }
        }
    }

    /// [defect] with the newest K; its change is added to pi. Returns the largest change.
    fn newest_defects(&mut self) -> f64 {
        let Self { stack, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { k, momentum_increment, delta, delta_rest, f_lambda, scratch: [newest, ..], .. } = &mut **u;
        stack.asym_of_product(f_lambda, k, newest);
        let (momentum_increment, delta) = (&mut momentum_increment[..len], &mut delta[..len]);
        let (delta_rest, newest) = (&delta_rest[..len], &newest[..len]);
        let mut jump = stack.lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let now = stack.get(newest, i, j) + stack.get(delta_rest, i, j);
                let change = now - stack.get(delta, i, j);
                jump = jump.max_or_nan(change.abs());
                stack.put_skew(delta, i, j, now);
                stack.put_skew(momentum_increment, i, j, stack.get(momentum_increment, i, j) + change);
            }
        }
        jump.largest()
    }

    /// Returns the largest change of an attitude since it was copied into t (scratch space here),
    /// in units of momenta.
    fn turned(&mut self) -> f64 {
        let Self { stack, u, size, .. } = self;
        let mut change = stack.lanes.constant(0.0);
        for (now, before) in u.c.chunks_exact(R::LANES).zip(u.t.chunks_exact(R::LANES)) {
            change = change.max_or_nan((stack.lanes.get(now) - stack.lanes.get(before)).abs());
        }
        change.largest() * *size
    }

    /// Computes the measures by which a solution is judged.
    fn judged(&mut self, sweeps: u32, increment: f64) -> Solved {
        let Self { stack, u, end, forces, h, .. } = self;
        let (len, lanes) = (stack.numbers(), stack.lanes);
        let (c, f) = (&u.c[..len], &u.f[..len]);
        let (mut stretch, mut end_stretch) = (lanes.constant(0.0), 0.0);
        for i in 0..stack.n() {
            for j in i..stack.n() {
                stretch = stretch.max_or_nan(stack.get(f, i, j).abs());
                end_stretch = Real::max_or_nan(end_stretch, end.f[i * stack.n() + j].abs());
            }
        }
        let (square, end_square) = (stack.square(c), stack.whole().square(&end.c));
        Solved {
            sweeps,
            h: *h,
            increment,
            stretch: Real::max_or_nan(end_stretch, stretch.largest()),
            change_square: Real::max_or_nan(end_square, square.largest()),
            proximity: match forces {
                Forces::Body { torques, .. } | Forces::Rescaled { torques, .. } => torques.proximity,
                Forces::None { .. } | Forces::Stages(_) => -1.0,
            },
        }
    }
    }

    /// Guesses that the step is one of collocation.
    #[inline(always)]
    fn guess_no_defect(&mut self) {
        let Self { start, u, end, .. } = self;
        for (multiplier, momentum) in end.multiplier.iter_mut().zip(start.momentum) {
            *multiplier = -0.5 * momentum;
        }
        let Unknowns { k, f, e, x, delta, momentum_increment, gradient, kappa, .. } = &mut **u;
        for matrices in [k, f, e, x, delta, momentum_increment, gradient, kappa] {
            matrices.fill(0.0);
        }
        end.k.fill(0.0);
        end.f.fill(0.0);
        end.impulse.fill(0.0);
    }

    fn defects(&mut self) -> f64 {
        self.embed();
        self.slow_defects();
        self.newest_defects()
    }

    /// Writes `h b ([mu, Omega] - dH/dg)` to the first matrix of `scratch`.
    #[inline(always)]
    fn rates(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, gradient, scratch: [rate, ..], .. } = &mut **u;
        // asym(mu Omega) = -asym(mu Omega^T)
        stack.asym_of_product(mu, omega, rate);
        let (rate, gradient) = (&mut rate[..len], &gradient[..len]);
        for i in 0..n {
            for j in i + 1..n {
                let turning = stack.get(rate, i, j) + stack.get(gradient, i, j);
                stack.put(rate, i, j, -(*weights * turning));
            }
        }
    }

    /// Updates Omega by (24f, vih6). Returns how far it still is from the velocity of mu, in units
    /// of mu.
    #[inline(always)]
    fn velocities(&mut self) -> f64 {
        let Unknowns { inertia, c, mu, omega, gradient, rescaled, .. } = &mut *self.u;
        let system = match &mut self.forces {
            Forces::Rescaled { scale, .. } => {
                // [time]
                rescaled.derivatives(self.stack, scale, inertia, [c, mu], omega, gradient);
                return 0.0;
            }
            Forces::None { velocity: Velocity::Weights(..), .. }
            | Forces::Body { velocity: Velocity::Weights(..), .. } => {
                self.stack.entrywise_product(inertia, mu, omega);
                return 0.0;
            }
            Forces::None { velocity: Velocity::Stages(system), .. }
            | Forces::Body { velocity: Velocity::Stages(system), .. }
            | Forces::Stages(system) => system,
        };
        let (mut change, mut size) = (0.0_f64, 0.0_f64);
        for stage in 0..self.coefficients.tableau.stages {
            let at = StageSlot { stage, stride: R::LANES };
            let [changed, now] = system.velocity(at, c, mu, omega);
            (change, size) = (Real::max_or_nan(change, changed), size.max(now));
        }
        relative(change, size) * self.size
    }
}

/// [w]
#[inline(always)]
fn spatial_velocities<R: StageScalar<StepScalar = f64>, D: Dimension>(
    stack: StageMatrices<R, D>,
    weights: R,
    c: &[f64],
    omega: &[f64],
    w: &mut [f64],
) {
    stack.plus_product(omega, c, omega, w);
    stack.scale(weights, w);
}

/// [F], [K] and [C]: one step of Newton's method for the polar factor of `I + D`, with the
/// derivative at P = I, from the current F.
#[inline(always)]
fn polar_factor<R: Stored, D: Dimension>(
    stack: StageMatrices<R, D>,
    d: &[f64],
    c: &mut [f64],
    f: &mut [f64],
    k: &mut [f64],
    scratch: &mut [f64],
) {
    stack.add_half_defect(c, f, scratch);
    stack.plus_product(f, d, f, k);
    stack.difference(d, k, c);
}

/// Changes made by passes over attitudes and momenta, in units of momenta.
struct Passed {
    last: f64,
    /// Error left that more passes would remove.
    left: f64,
}
