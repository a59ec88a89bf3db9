//! Newton's method for `z = G(z)`, G one sweep, without a matrix: the linear equations `(I - G'(z)) d = G(z) - z`
//! are solved by GMRES (Saad, Schultz 1986), which asks for products `G'(z) v` alone, and a product is the
//! difference of two sweeps. What sweeps contract poorly are a few directions; GMRES finds them in as many
//! products, whatever the number of unknowns. Nothing is kept from step to step: there is no Jacobian to go stale,
//! and a resumed run repeats every bit.
//!
//! Invariant: the equations are left at the last accepted iterate.

use super::{Convergence, Equations, History, Rung, StopRule};
use crate::failure::{Failure, FailureCode};

/// Residual of the linear equations, relative to the right-hand side: Newton's own error is then not much larger
/// from an increment of 1e-4 on.
const FORCING: f64 = 1e-5;
/// Products that a linear solve may take.
const MAX_PRODUCTS: usize = 60;
/// Length of a difference, for unknowns of size one: the errors by rounding and by curvature are
/// then about equal.
const DIFFERENCE: f64 = 1e-7;
/// Part of the residual at most that a correction leaves where it makes the increment larger, and the increments, in parts of
/// those that rounding makes, for which it may.
const FALLS: f64 = 0.1;
const NEAR_ROUND_OFF: f64 = 1e3;
/// Number of times a correction is halved before it is abandoned.
const HALVINGS: u32 = 8;

/// Workspace of Newton's method, kept from step to step so that a step allocates nothing.
#[derive(Clone, Debug, Default)]
pub(super) struct Newton {
    /// z, and `G(z) - z`.
    at: Vec<f64>,
    residual: Vec<f64>,
    correction: Vec<f64>,
    image: Vec<f64>,
    /// The orthonormal basis of the Krylov space, and the Hessenberg matrix in it, column by column.
    basis: Vec<Vec<f64>>,
    hessenberg: Vec<Vec<f64>>,
    /// The rotations (cosine, sine) that make it upper triangular, and the right-hand side under them (Givens).
    turns: Vec<(f64, f64)>,
    right: Vec<f64>,
}

impl Newton {
    /// Solves `equations` from where they stand.
    ///
    /// # Errors
    /// Those of a sweep, and [`FailureCode::Diverged`], [`FailureCode::MaxIterations`], [`FailureCode::NonFinite`].
    pub(super) fn solve(
        &mut self,
        rule: StopRule,
        equations: &mut dyn Equations,
    ) -> Result<Convergence, Failure> {
        let mut history = History::new();
        // A correction squares the error: none is needed for an error at round-off.
        let tolerance = rule.tolerance.max(StopRule::default().tolerance);
        equations.prime()?;
        self.take(equations);
        let mut increment = equations.sweep()?;
        // A solution that the sweep before the first correction finds counts as one iteration.
        for corrections in 0..=rule.max_iterations {
            let previous = history.last();
            history.note(increment);
            if !increment.is_finite() {
                return Err(history.failure(FailureCode::NonFinite, f64::MAX));
            }
            if increment <= tolerance || (increment >= previous && increment <= equations.floor()) {
                let iterations = corrections.max(1);
                return Ok(Convergence { iterations, increment, rung: Rung::Newton });
            }
            self.take_residual(equations);
            self.linear_solve(equations).map_err(|failure| history.of(failure, corrections))?;
            increment = self.corrected(equations, increment, &history)?;
        }
        Err(history.failure(FailureCode::MaxIterations, tolerance))
    }

    fn take(&mut self, equations: &dyn Equations) {
        self.at.clear();
        equations.unknowns(&mut self.at);
    }

    /// `G(z) - z`, the equations standing at G(z).
    fn take_residual(&mut self, equations: &dyn Equations) {
        self.residual.clear();
        equations.unknowns(&mut self.residual);
        for (r, z) in self.residual.iter_mut().zip(&self.at) {
            *r -= z;
        }
    }

    /// Goes from z to z + d and sweeps; halves d while that makes the increment larger. An increment is of some unknowns
    /// alone: near round-off it may rise while what is left of all falls.
    fn corrected(
        &mut self,
        equations: &mut dyn Equations,
        before: f64,
        history: &History,
    ) -> Result<f64, Failure> {
        let left = norm(&self.residual);
        for _ in 0..=HALVINGS {
            self.image.clear();
            self.image.extend(self.at.iter().zip(&self.correction).map(|(z, d)| z + d));
            equations.set(&self.image);
            match equations.sweep() {
                // Near round-off an increment may rise a little.
                Ok(increment)
                    if increment <= before.max(equations.floor())
                        || increment <= NEAR_ROUND_OFF * equations.floor()
                            && self.left_at_image(equations) <= FALLS * left =>
                {
                    std::mem::swap(&mut self.at, &mut self.image);
                    return Ok(increment);
                }
                Err(stopped) if stopped.code == FailureCode::Stopped => return Err(stopped),
                _ => self.correction.iter_mut().for_each(|d| *d *= 0.5),
            }
        }
        Err(history.failure(FailureCode::Diverged, before))
    }

    /// `|G(z) - z|` of the image, the equations standing at its G(z).
    fn left_at_image(&mut self, equations: &dyn Equations) -> f64 {
        self.residual.clear();
        equations.unknowns(&mut self.residual);
        self.residual.iter_mut().zip(&self.image).for_each(|(r, z)| *r -= z);
        norm(&self.residual)
    }

    /// Solves `(I - G'(z)) d = G(z) - z` for the correction d.
    fn linear_solve(&mut self, equations: &mut dyn Equations) -> Result<(), Failure> {
        let Self { at, residual, correction, image, basis, hessenberg, turns, right } = self;
        let length = norm(residual);
        correction.clear();
        correction.resize(at.len(), 0.0);
        if length == 0.0 {
            return Ok(());
        }
        let most = MAX_PRODUCTS.min(at.len());
        while basis.len() <= most {
            basis.push(Vec::new());
        }
        while hessenberg.len() < most {
            hessenberg.push(Vec::new());
        }
        let first = &mut basis[0];
        first.clear();
        first.extend(residual.iter().map(|r| r / length));
        turns.clear();
        right.clear();
        right.push(length);
        let mut products = 0;
        while products < most {
            let k = products;
            // (I - G') v by a difference from G(z) = z + residual
            image.clear();
            image.extend(at.iter().zip(&basis[k]).map(|(z, v)| z + DIFFERENCE * v));
            equations.set(image);
            equations.sweep()?;
            image.clear();
            equations.unknowns(image);
            for (i, w) in image.iter_mut().enumerate() {
                *w = basis[k][i] - (*w - (at[i] + residual[i])) / DIFFERENCE;
            }
            let column = &mut hessenberg[k];
            column.clear();
            for v in &basis[..=k] {
                let part = inner(v, image);
                image.iter_mut().zip(v).for_each(|(w, v)| *w -= part * v);
                column.push(part);
            }
            let rest = norm(image);
            for (i, (cos, sin)) in turns.iter().enumerate() {
                let (a, b) = (column[i], column[i + 1]);
                (column[i], column[i + 1]) = (cos * a + sin * b, cos * b - sin * a);
            }
            let (a, hypotenuse) = (column[k], (column[k] * column[k] + rest * rest).sqrt());
            if !(hypotenuse > 0.0 && hypotenuse.is_finite()) {
                break;
            }
            let (cos, sin) = (a / hypotenuse, rest / hypotenuse);
            column[k] = hypotenuse;
            turns.push((cos, sin));
            let last = right[k];
            right[k] = cos * last;
            right.push(-sin * last);
            products += 1;
            if right[products].abs() <= FORCING * length || rest <= f64::EPSILON * hypotenuse {
                break;
            }
            let next = &mut basis[products];
            next.clear();
            next.extend(image.iter().map(|w| w / rest));
        }
        for k in (0..products).rev() {
            for j in k + 1..products {
                right[k] -= hessenberg[j][k] * right[j];
            }
            right[k] /= hessenberg[k][k];
        }
        for (v, c) in basis.iter().zip(&right[..products]) {
            correction.iter_mut().zip(v).for_each(|(d, v)| *d += c * v);
        }
        Ok(())
    }
}

fn inner(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: &[f64]) -> f64 {
    inner(a, a).sqrt()
}
