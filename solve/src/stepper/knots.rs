//! Steps of a system that is not smooth at known times, its knots.
//!
//! Invariant: no step goes over a knot; a method keeps its order, wherever the knots are.

use super::Stepper;
use crate::failure::Failure;
use crate::nonlinear::{Convergence, Rung};
use crate::so::Mat;
use crate::state::State;
use crate::system::System;
use crate::time::rounding_s;

/// The knots of a system along a run.
#[derive(Clone, Copy, Debug)]
pub struct Knots {
    /// The first one after the last step that was made, in seconds.
    next_s: f64,
}

impl Default for Knots {
    /// Returns the knots before any is known.
    fn default() -> Self {
        Self { next_s: f64::NEG_INFINITY }
    }
}

impl Knots {
    /// The first knot after a time.
    fn after<const N: usize, Y: System<N> + ?Sized>(&mut self, system: &Y, time_s: f64) -> f64 {
        let time_s = time_s + rounding_s(time_s);
        if self.next_s <= time_s {
            self.next_s = system.next_knot(time_s);
        }
        self.next_s
    }

    /// Do knots lie in, or at the end of, the `h` seconds from `begun_s` on?
    pub(super) fn lie_in<const N: usize, Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        begun_s: f64,
        h: f64,
    ) -> bool {
        let ends_s = begun_s + h;
        self.after(system, begun_s) <= ends_s + rounding_s(ends_s)
    }

    /// Makes a step of `h` seconds from the time `begun_s`, in parts that end at the knots in between. Times do not go back
    /// from one step to the next.
    ///
    /// # Errors
    /// Those of [`Stepper::step`]; the state is then that at the beginning.
    pub fn step<const N: usize, Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
        begun_s: f64,
        h: f64,
    ) -> Result<Convergence, Failure> {
        stepper.set_time(begun_s);
        if !self.lie_in(system, begun_s, h) {
            return stepper.step(system, h);
        }
        let attitude = stepper.attitude().unwrap_or_else(Mat::identity);
        let state = State { attitude, momentum: stepper.momentum() };
        let clock = stepper.clock().cloned();
        let control = stepper.control().cloned();
        self.parts(system, stepper, begun_s, h).inspect_err(|_| {
            stepper.start(&state);
            if let Some(then) = &control {
                stepper.set_control(then);
            }
            if let (Some(now), Some(then)) = (stepper.clock_mut(), clock) {
                *now = then;
            }
        })
    }

    fn parts<const N: usize, Y: System<N> + ?Sized>(
        &mut self,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
        begun_s: f64,
        h: f64,
    ) -> Result<Convergence, Failure> {
        let ends_s = begun_s + h;
        let last_s = ends_s - rounding_s(ends_s);
        let mut time_s = begun_s;
        let mut solved: Option<Convergence> = None;
        loop {
            let knot_s = self.after(system, time_s);
            let is_last = knot_s >= last_s;
            // Not what is left after one part and the next: the roundings of many would add up.
            let part = if is_last { h - (time_s - begun_s) } else { knot_s - time_s };
            stepper.set_time(time_s);
            let convergence = stepper.step(system, part)?;
            solved = Some(solved.map_or(convergence, |before| both(before, convergence)));
            if knot_s <= ends_s + rounding_s(ends_s) {
                let g = stepper.attitude().unwrap_or_else(Mat::identity);
                let jump = system.jump(knot_s, &g);
                if let Some(clock) = stepper.clock_mut() {
                    clock.add_jump(jump);
                }
            }
            if let (true, Some(solved)) = (is_last, solved) {
                return Ok(solved);
            }
            time_s = knot_s;
        }
    }
}

/// How two parts of a step were solved.
fn both(a: Convergence, b: Convergence) -> Convergence {
    let rung = if a.rung == Rung::Newton { a.rung } else { b.rung };
    let increment = a.increment.max(b.increment);
    Convergence { iterations: a.iterations + b.iterations, increment, rung }
}
