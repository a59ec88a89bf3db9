//! The Lyapunov exponents of a run, all of them.

use super::dense::{Dense, add_scaled};
use super::{Tangent, TangentError, stages_of};
use crate::so::Mat;
use crate::state::State;
use crate::stepper::Stepper;

/// Parts of a run that are taken as independent for the errors.
const PARTS: u64 = 16;

/// The Lyapunov exponents of a run, in 1/s.
#[derive(Clone, Debug, PartialEq)]
pub struct Lyapunov {
    /// The exponents, the largest first: 2d.
    pub exponents: Vec<f64>,
    /// The standard error of each, from the spread of parts of the run. It is that of a chaotic motion, whose parts are
    /// independent; where exponents are zero, those of a finite run fall like the logarithm of its length over the length. At least
    /// a rounding a step.
    pub errors: Vec<f64>,
    /// Their sum: zero but for rounding, as the steps are symplectic.
    pub sum: f64,
}

impl<const N: usize> Tangent<N> {
    /// The Lyapunov exponents along `steps` steps of `h` seconds of `stepper` from `start`: the rates at which a frame of changes of
    /// the state grows, made orthonormal after each step (Benettin, Galgani, Giorgilli, Strelcyn 1980). One part in 17 goes
    /// first, in which the frame turns into its directions. `go_on(steps_done)` is asked before each step; the answer is `None` once it
    /// says no.
    ///
    /// # Errors
    /// [`TangentError::Step`] of a step that fails, [`TangentError::Singular`].
    pub fn lyapunov(
        &mut self,
        stepper: &mut dyn Stepper<N>,
        start: &State<N>,
        (h, steps): (f64, u64),
        mut go_on: impl FnMut(u64) -> bool,
    ) -> Result<Option<Lyapunov>, TangentError> {
        let rows = 2 * self.places.len();
        let part = (steps / (PARTS + 1)).max(1);
        let first = steps.saturating_sub(PARTS * part);
        // The changes of the frame, one a row.
        let mut frame = Dense::zeros(rows, rows);
        (0..rows).for_each(|i| frame.row_mut(i)[i] = 1.0);
        let mut logarithms = vec![0.0; rows];
        let mut parts: Vec<Vec<f64>> = Vec::new();
        stepper.start(start);
        let mut state = start.clone();
        for step in 0..steps {
            if !go_on(step) {
                return Ok(None);
            }
            stepper.step(&self.body, h)?;
            let of_step = self.of_step(h, &state, &stages_of(stepper))?;
            for i in 0..rows {
                let carried = of_step.push_forward(frame.row(i));
                frame.row_mut(i).copy_from_slice(&carried);
            }
            for (sum, size) in logarithms.iter_mut().zip(orthonormalise(&mut frame)) {
                *sum += libm::log(size);
            }
            let attitude = stepper.attitude().unwrap_or_else(Mat::identity);
            state = State { attitude, momentum: stepper.momentum() };
            let done = step + 1;
            if done >= first && (done - first).is_multiple_of(part) {
                let rates = logarithms.iter().map(|sum| sum / (part as f64 * h)).collect();
                // What comes before the first part only turns the frame.
                if done > first {
                    parts.push(rates);
                }
                logarithms.fill(0.0);
            }
        }
        let count = parts.len().max(1) as f64;
        let mut found: Vec<[f64; 2]> = (0..rows)
            .map(|i| {
                let mean = parts.iter().map(|rates| rates[i]).sum::<f64>() / count;
                let square = |rates: &Vec<f64>| (rates[i] - mean) * (rates[i] - mean);
                let variance = parts.iter().map(square).sum::<f64>() / (count - 1.0).max(1.0);
                // A rounding of each step may have one sign.
                [mean, (variance / count).sqrt().max(f64::EPSILON / h.abs())]
            })
            .collect();
        found.sort_by(|a, b| b[0].total_cmp(&a[0]));
        Ok(Some(Lyapunov {
            sum: found.iter().map(|[mean, _]| mean).sum(),
            exponents: found.iter().map(|[mean, _]| *mean).collect(),
            errors: found.iter().map(|[_, error]| *error).collect(),
        }))
    }
}

/// Makes the rows orthonormal, each against those before it, twice for round-off. Returns by how much each was longer.
fn orthonormalise(frame: &mut Dense) -> Vec<f64> {
    let rows = frame.rows();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut sizes = Vec::with_capacity(rows);
    for i in 0..rows {
        let mut row = frame.row(i).to_vec();
        for _ in 0..2 {
            for j in 0..i {
                let along = dot(&row, frame.row(j));
                add_scaled(&mut row, frame.row(j), -along);
            }
        }
        let size = dot(&row, &row).sqrt();
        row.iter_mut().for_each(|x| *x /= size);
        frame.row_mut(i).copy_from_slice(&row);
        sizes.push(size);
    }
    sizes
}
