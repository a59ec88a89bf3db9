//! A first guess from the steps before: the polynomial in time through their solutions, continued by a step.
//!
//! On the smooth orbit of a free body such a guess is as near as a sweep or two would come, and how well sweeps contract
//! is known from the steps before, too: one sweep solves the step. (Where it does not pay: docs/decisions/0008.)
//!
//! Invariant: a guess is a function of the steps since [`Trail::forget`]; one that leads astray costs time and no more.

use super::{Convergence, Equations, Progress, Rungs, Solver, swept};
use crate::failure::Failure;
use crate::lanes::{Stored, WIDTH};

/// Number of steps that are remembered.
const DEPTH: usize = 8;

/// `z_{n+1} = sum_i (-1)^i C(DEPTH, i + 1) z_{n-i}`
const COEFFICIENTS: [f64; DEPTH] = [8.0, -28.0, 56.0, -70.0, 56.0, -28.0, 8.0, -1.0];

/// Increment above which the next one is not yet rounding.
const CLEAR: f64 = 1e-12;

/// The solutions of the last steps, and the polynomial through them.
#[derive(Clone, Debug, Default)]
pub struct Trail {
    /// A ring of solutions.
    solutions: [Vec<f64>; DEPTH],
    /// Index of the newest.
    newest: usize,
    /// Number of them.
    known: usize,
    /// Numbers of a solution.
    count: usize,
    /// First guess of the next solution.
    next: Vec<f64>,
}

impl Trail {
    /// Forgets all solutions.
    pub fn forget(&mut self) {
        self.known = 0;
    }

    /// Adds a solution, whose numbers `keep` appends; always as many.
    pub fn add(&mut self, keep: impl FnOnce(&mut Vec<f64>)) {
        self.newest = (self.newest + 1) % DEPTH;
        self.known = DEPTH.min(self.known + 1);
        let newest = &mut self.solutions[self.newest];
        newest.clear();
        keep(newest);
        self.count = newest.len();
        // Whole registers.
        newest.resize(self.count.next_multiple_of(WIDTH), 0.0);
    }

    /// Returns the polynomial a step ahead, computed in such lanes; `None` while too few solutions are known.
    #[inline(always)]
    pub fn continued<R: Stored>(&mut self, lanes: R) -> Option<&[f64]> {
        if self.known < DEPTH {
            return None;
        }
        let Self { solutions, newest, next, count, .. } = self;
        let len = count.next_multiple_of(WIDTH);
        next.resize(len, 0.0);
        let backward: [&[f64]; DEPTH] =
            std::array::from_fn(|back| &solutions[(*newest + DEPTH - back) % DEPTH][..len]);
        for (k, next) in next.chunks_exact_mut(R::LANES * R::GROUP).enumerate() {
            let at = k * R::LANES * R::GROUP;
            // Register by register: there are too few numbers for a loop over each solution.
            let mut sum = lanes.get_wide(&backward[0][at..]) * COEFFICIENTS[0];
            for back in 1..DEPTH {
                sum = sum + lanes.get_wide(&backward[back][at..]) * COEFFICIENTS[back];
            }
            R::put_wide(sum, next);
        }
        Some(&next[..*count])
    }
}

/// The last steps of sweeps.
#[derive(Clone, Debug, Default)]
pub struct Past {
    trail: Trail,
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

impl Past {
    /// Forgets all steps.
    pub fn forget(&mut self) {
        self.trail.forget();
        (self.first, self.contraction) = (0.0, None);
    }

    /// Solves `equations` by sweeps from where the steps before lead, or as `solver` does if that is no better.
    fn solve(
        &mut self,
        solver: &mut Solver,
        equations: &mut impl Continued,
    ) -> Result<Convergence, Failure> {
        if self.trail.known == DEPTH && solver.rule.rungs != Rungs::Newton {
            if let Some(solved) = self.continued(solver, equations) {
                return Ok(solved);
            }
            self.forget();
        }
        let mut seen = Seen::NOTHING;
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
        let sweeps = equations.continue_from(self.trail.continued(0.0)?).ok()?;
        let expected = self.contraction.unwrap_or(f64::INFINITY);
        let progress = Progress { expected, ..Progress::new(solver.rule, true) };
        let mut seen = Seen::NOTHING;
        let sweep = || equations.sweep().inspect(|increment| seen.note(*increment));
        let mut solved = swept(progress, sweep).ok()??;
        solved.iterations += sweeps;
        if seen.first <= self.first {
            self.note(equations, &seen);
        } else {
            // The guess does better: the motion is too quick for the polynomial.
            self.forget();
        }
        Some(solved)
    }

    fn note(&mut self, equations: &impl Continued, seen: &Seen) {
        if let Some(contraction) = seen.contraction {
            let worst = self.contraction.map_or(contraction, |worst| worst.max(contraction));
            self.contraction = Some(worst);
        }
        self.trail.add(|numbers| equations.keep(numbers));
    }
}

impl Solver {
    /// Solves `equations` from where the steps before lead, if they are remembered.
    ///
    /// # Errors
    /// Those of [`Solver::solve`].
    pub fn solve_after(
        &mut self,
        past: &mut Option<Past>,
        equations: &mut impl Continued,
    ) -> Result<Convergence, Failure> {
        match past {
            Some(past) => past.solve(self, equations),
            None => self.solve(equations),
        }
    }
}

/// Measures of the increments of a step.
#[derive(Debug)]
struct Seen {
    /// The first increment.
    first: f64,
    last: f64,
    /// The last contraction that rounding does not hide.
    contraction: Option<f64>,
}

impl Seen {
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
        let (mut past, mut solver) = (Past::default(), Solver::new(StopRule::default()));
        let mut equations = Moving { target: 0.0, z: 0.0, sweeps: 0 };
        let mut made = Vec::new();
        for step in 0..60 {
            let jump = if step < 30 { 0.0 } else { 3.0 };
            equations.target = libm::cos(0.01 * f64::from(step)) + jump;
            equations.sweeps = 0;
            let solved = past.solve(&mut solver, &mut equations).expect("contracts");
            assert_eq!(solved.iterations, equations.sweeps);
            assert!((equations.z - equations.target).abs() < 1e-15 * equations.target);
            made.push(solved.iterations);
        }
        assert!(made[..DEPTH].iter().all(|&sweeps| sweeps >= 4), "{made:?}");
        assert!(made[DEPTH..30].iter().all(|&sweeps| sweeps == 1), "{made:?}");
        assert!(made[30] > 1, "{made:?}");
        assert!(made[50..].iter().all(|&sweeps| sweeps == 1), "{made:?}");
    }

    #[test]
    fn what_was_never_seen_to_contract_is_not_foreseen() {
        let (mut past, mut solver) = (Past::default(), Solver::new(StopRule::default()));
        let mut equations = Moving { target: 0.0, z: 0.0, sweeps: 0 };
        for step in 0..30 {
            // The guess is the solution, and then it is not.
            equations.target = if step < 20 { 0.0 } else { 2.0 };
            past.solve(&mut solver, &mut equations).expect("contracts");
            assert!((equations.z - equations.target).abs() < 1e-15, "step {step}");
        }
    }
}
