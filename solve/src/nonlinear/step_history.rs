//! A first guess from the previous steps: the polynomial in time through their solutions, continued by a step.
//!
//! On the smooth orbit of a free body such a guess is as near as a sweep or two would come, and how well sweeps contract
//! is known from the steps before, too: one sweep solves the step. (Where it does not pay: docs/decisions/0008.)
//!
//! Invariant: a guess is a function of the steps since [`Extrapolation::forget`]; a bad one costs time and no more.

use super::{Convergence, Equations, Progress, Rungs, Solver, swept};
use crate::failure::Failure;
use crate::lanes::{Row, Stored, WIDTH};

/// Increment above which the next one is not yet rounding.
const CLEAR: f64 = 1e-12;

/// The solutions of the last `DEPTH` steps, and the polynomial through them. A solution consists of parts, always as many
/// and as long.
#[derive(Clone, Debug, Default)]
pub struct Extrapolation<const DEPTH: usize> {
    /// Eight numbers of each solution after the other, and again; a part begins with a row of its own.
    rows: Vec<[Row; DEPTH]>,
    /// Index of the newest solution: they lie in a ring.
    newest: usize,
    /// Number of solutions.
    known: usize,
}

impl<const DEPTH: usize> Extrapolation<DEPTH> {
    /// `z_{n+1} = sum_i (-1)^i C(DEPTH, i + 1) z_{n-i}`
    const COEFFICIENTS: [f64; DEPTH] = {
        let mut coefficients = [DEPTH as f64; DEPTH];
        let mut i = 1;
        while i < DEPTH {
            coefficients[i] = -coefficients[i - 1] * (DEPTH - i) as f64 / (i + 1) as f64;
            i += 1;
        }
        coefficients
    };

    /// Forgets all solutions.
    pub fn forget(&mut self) {
        (self.newest, self.known) = (0, 0);
    }

    /// Does the polynomial have its full degree?
    pub fn is_known(&self) -> bool {
        self.known == DEPTH
    }

    /// Adds a solution.
    #[inline(always)]
    pub fn add<'a>(&mut self, parts: impl IntoIterator<Item = &'a [f64]>) {
        self.newest = (self.newest + 1) % DEPTH;
        self.known = DEPTH.min(self.known + 1);
        let mut count = 0;
        for part in parts {
            let (whole, rest) = part.as_chunks::<WIDTH>();
            let first = count;
            count += part.len().div_ceil(WIDTH);
            if self.rows.len() < count {
                self.rows.resize(count, [Row::splat(0.0); DEPTH]);
            }
            for (numbers, rows) in whole.iter().zip(&mut self.rows[first..]) {
                rows[self.newest].0 = *numbers;
            }
            if !rest.is_empty() {
                self.rows[count - 1][self.newest].0[..rest.len()].copy_from_slice(rest);
            }
        }
    }

    /// Computes the polynomial a step ahead, part by part, in such lanes.
    #[inline(always)]
    pub fn extrapolate<'a, R: Stored>(
        &self,
        lanes: R,
        parts: impl IntoIterator<Item = &'a mut [f64]>,
    ) {
        let mut coefficients = [0.0; DEPTH];
        for (back, coefficient) in Self::COEFFICIENTS.into_iter().enumerate() {
            coefficients[(self.newest + DEPTH - back) % DEPTH] = coefficient;
        }
        let mut rows = self.rows.iter();
        for part in parts {
            let (whole, rest) = part.as_chunks_mut::<WIDTH>();
            for (next, rows) in whole.iter_mut().zip(&mut rows) {
                extrapolated_row(lanes, &coefficients, rows, next);
            }
            if !rest.is_empty()
                && let Some(rows) = rows.next()
            {
                let mut next = [0.0; WIDTH];
                extrapolated_row(lanes, &coefficients, rows, &mut next);
                rest.copy_from_slice(&next[..rest.len()]);
            }
        }
    }
}

/// Computes eight numbers of the polynomial from those of each solution.
#[inline(always)]
fn extrapolated_row<R: Stored, const DEPTH: usize>(
    lanes: R,
    coefficients: &[f64; DEPTH],
    rows: &[Row; DEPTH],
    next: &mut [f64; WIDTH],
) {
    for at in (0..WIDTH).step_by(R::LANES * R::GROUP) {
        let mut sum = lanes.get_wide(&rows[0].0[at..]) * coefficients[0];
        for k in 1..DEPTH {
            sum = sum + lanes.get_wide(&rows[k].0[at..]) * coefficients[k];
        }
        R::put_wide(sum, &mut next[at..]);
    }
}

/// The last steps of sweeps.
#[derive(Clone, Debug, Default)]
pub struct StepHistory {
    /// Eight: the polynomial through more multiplies their rounding errors too much.
    extrapolation: Extrapolation<8>,
    /// The newest solution, then the first guess of the next.
    numbers: Vec<f64>,
    /// The largest first increment from the guess of the equations themselves.
    first: f64,
    /// Worst contraction seen.
    contraction: Option<f64>,
}

/// Equations whose solutions change smoothly from step to step.
pub trait Continued: Equations {
    /// Appends the numbers that change smoothly.
    fn keep(&self, numbers: &mut Vec<f64>);

    /// Takes numbers in the order of [`Continued::keep`] as a first guess; returns how many sweeps that took.
    ///
    /// # Errors
    /// Those of a sweep.
    fn continue_from(&mut self, numbers: &[f64]) -> Result<u32, Failure>;
}

impl StepHistory {
    /// Forgets all steps.
    pub fn forget(&mut self) {
        self.extrapolation.forget();
        (self.first, self.contraction) = (0.0, None);
    }

    /// Solves `equations` by sweeps from where the steps before lead, or as `solver` does if that is no better.
    fn solve(
        &mut self,
        solver: &mut Solver,
        equations: &mut impl Continued,
    ) -> Result<Convergence, Failure> {
        if self.extrapolation.is_known() && solver.rule.rungs != Rungs::Newton {
            if let Some(solved) = self.continued(solver, equations) {
                return Ok(solved);
            }
            self.forget();
        }
        let mut seen = IncrementStats::NOTHING;
        let solved = solver.watched(equations, |increment| seen.note(increment))?;
        self.first = self.first.max(seen.first);
        self.note(equations, &seen);
        Ok(solved)
    }

    fn continued(
        &mut self,
        solver: &Solver,
        equations: &mut impl Continued,
    ) -> Option<Convergence> {
        self.extrapolation.extrapolate(0.0, [&mut self.numbers[..]]);
        let sweeps = equations.continue_from(&self.numbers).ok()?;
        let expected = self.contraction.unwrap_or(f64::INFINITY);
        let progress = Progress { expected, ..Progress::new(solver.rule, true) };
        let mut seen = IncrementStats::NOTHING;
        let sweep = || equations.sweep().inspect(|increment| seen.note(*increment));
        let mut solved = swept(progress, sweep).ok()??;
        solved.iterations += sweeps;
        if seen.first <= self.first {
            self.note(equations, &seen);
        } else {
            // The guess does better: the motion is too fast for the polynomial.
            self.forget();
        }
        Some(solved)
    }

    fn note(&mut self, equations: &impl Continued, seen: &IncrementStats) {
        if let Some(contraction) = seen.contraction {
            let worst = self.contraction.map_or(contraction, |worst| worst.max(contraction));
            self.contraction = Some(worst);
        }
        self.numbers.clear();
        equations.keep(&mut self.numbers);
        self.extrapolation.add([&self.numbers[..]]);
    }
}

impl Solver {
    /// Solves `equations` from where the steps before lead, if they are remembered.
    ///
    /// # Errors
    /// Those of [`Solver::solve`].
    pub fn solve_after(
        &mut self,
        history: &mut Option<StepHistory>,
        equations: &mut impl Continued,
    ) -> Result<Convergence, Failure> {
        match history {
            Some(history) => history.solve(self, equations),
            None => self.solve(equations),
        }
    }
}

/// Measures of the increments of a step.
#[derive(Debug)]
struct IncrementStats {
    /// The first increment.
    first: f64,
    last: f64,
    /// The last contraction that rounding does not hide.
    contraction: Option<f64>,
}

impl IncrementStats {
    const NOTHING: Self = Self { first: f64::NAN, last: 0.0, contraction: None };

    fn note(&mut self, increment: f64) {
        if self.first.is_nan() {
            self.first = increment;
        }
        if self.last > CLEAR {
            self.contraction = Some(increment / self.last);
        }
        self.last = increment;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nonlinear::StopRule;

    /// `z = target + contraction (z - target)`: solved by the target.
    struct Moving {
        target: f64,
        z: f64,
        sweeps: u32,
    }

    impl Equations for Moving {
        fn guess(&mut self) -> Result<(), Failure> {
            self.z = 0.0;
            Ok(())
        }

        fn sweep(&mut self) -> Result<f64, Failure> {
            self.sweeps += 1;
            let next = self.target + 1e-4 * (self.z - self.target);
            let change = (next - self.z).abs();
            self.z = next;
            Ok(change)
        }

        fn unknowns(&self, values: &mut Vec<f64>) {
            values.push(self.z);
        }

        fn set(&mut self, values: &[f64]) {
            self.z = values[0];
        }
    }

    impl Continued for Moving {
        fn keep(&self, numbers: &mut Vec<f64>) {
            numbers.push(self.z);
        }

        fn continue_from(&mut self, numbers: &[f64]) -> Result<u32, Failure> {
            self.z = numbers[0];
            Ok(0)
        }
    }

    #[test]
    fn a_smooth_motion_takes_one_sweep_and_a_jump_is_followed() {
        let (mut history, mut solver) = (StepHistory::default(), Solver::new(StopRule::default()));
        let mut equations = Moving { target: 0.0, z: 0.0, sweeps: 0 };
        let mut made = Vec::new();
        for step in 0..60 {
            let jump = if step < 30 { 0.0 } else { 3.0 };
            equations.target = libm::cos(0.01 * f64::from(step)) + jump;
            equations.sweeps = 0;
            let solved = history.solve(&mut solver, &mut equations).expect("contracts");
            assert_eq!(solved.iterations, equations.sweeps);
            assert!((equations.z - equations.target).abs() < 1e-15 * equations.target);
            made.push(solved.iterations);
        }
        assert!(made[..8].iter().all(|&sweeps| sweeps >= 4), "{made:?}");
        assert!(made[8..30].iter().all(|&sweeps| sweeps == 1), "{made:?}");
        assert!(made[30] > 1, "{made:?}");
        assert!(made[50..].iter().all(|&sweeps| sweeps == 1), "{made:?}");
    }

    #[test]
    fn what_was_never_seen_to_contract_is_not_foreseen() {
        let (mut history, mut solver) = (StepHistory::default(), Solver::new(StopRule::default()));
        let mut equations = Moving { target: 0.0, z: 0.0, sweeps: 0 };
        for step in 0..30 {
            // The guess is the solution, and then it is not.
            equations.target = if step < 20 { 0.0 } else { 2.0 };
            history.solve(&mut solver, &mut equations).expect("contracts");
            assert!((equations.z - equations.target).abs() < 1e-15, "step {step}");
        }
    }
}
