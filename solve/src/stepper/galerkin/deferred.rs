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

mod control;
mod operations;

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use super::convergence::{REMEMBERED_STEPS, SolveError, Solved};
use crate::failure::Failure;
use crate::hamiltonian::{AtStages, Scale, Terms, Torques};
use crate::lanes::{Row, Rows, StageScalar, WIDTH, widest};
use crate::nonlinear::Extrapolation;
use crate::stack::{AlignedBuffer, Any, Dimension, Known, StageMatrices};
use crate::tableau::{Tableau, TableauInLanes};
use crate::work;

/// A system as the step sees it.
pub(super) enum SystemView<'a> {
    /// A rigid body and a potential of built-in terms.
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
    /// Computes dH/dg of the first `stages` stages, stored `stride` apart; c is U - I.
    fn gradients(&self, stages: usize, stride: usize, at: StageValues<'_>, gradient: &mut [f64]);
    /// Computes `U X U^T`.
    fn to_space(&self, at: StageSlot, c: &[f64], x: &[f64], turned: &mut [f64]);
    /// Improves Omega. Returns its largest change and its size.
    fn velocity(&self, at: StageSlot, c: &[f64], mu: &[f64], omega: &mut [f64]) -> [f64; 2];
}

/// Matrices of all stages: U - I, mu, Omega.
#[derive(Clone, Copy)]
pub(super) struct StageValues<'a> {
    pub(super) c: &'a [f64],
    pub(super) mu: &'a [f64],
    pub(super) omega: &'a [f64],
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
            // Of four lanes the registers of AVX-512 gain for this size alone.
            (4, Some(level)) if start.n == 16 => {
                widest!(level, f64x4, lanes => Step::new(lanes, Known::<16>, coefficients, start, source, u, end).solve(),
                else solve_any(Rows([0.0; 4]), coefficients, start, source, u, end))
            }
            (4, Some(level)) => {
                widest!(level below Avx512, f64x4, lanes => solve(lanes, coefficients, start, source, u, end),
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
}
