//! The order of a step: from where it begins, how many sweeps and defect evaluations it takes, and when it is solved.
//!
//! Invariant: a step ends where what more iterations would change is below rounding, or is not solved here.

use super::{Forces, InitialGuess, Step, Velocity};
use crate::failure::Failure;
use crate::lanes::StageScalar;
use crate::stack::Dimension;
use crate::stepper::galerkin::convergence::{
    Contraction, LAST_DIGIT, LEAST_TURN_RAD, MODEST_TURN_RAD, MOST_ITERATIONS, PASSES_PER_TORQUE,
    ROUND_OFF, ROUNDING_CHANGE, SAME_SIGN, SolveError, Solved, USUAL_PASSES,
};

impl<R: StageScalar<StepScalar = f64>, D: Dimension> Step<'_, R, D> {
    pub(super) fn solve(mut self) -> Result<Solved, SolveError> {
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
    pub(super) fn has_weights(&self) -> bool {
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
                (true, 5 | 6) => 0.1,
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

    pub(super) fn begin_sweep(&self) -> Result<(), Failure> {
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
}

/// Changes made by passes over attitudes and momenta, in units of momenta.
struct Passed {
    last: f64,
    /// Error left that more passes would remove.
    left: f64,
}
