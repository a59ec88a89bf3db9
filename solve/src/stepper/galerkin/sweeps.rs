//! The equations of the step, solved by sweeps over all stages, as they stand in the documentation
//! of [`super`]: for tableaux that are not symplectic by themselves, and where the collocation with a
//! deferred defect does not converge.
//!
//! Invariant: a sweep computes each unknown from the newest of the others.

use super::Dynamics;
use crate::failure::{Failure, FailureCode};
use crate::nonlinear::{Continued, Equations, ROUND_OFF_FLOOR, SMALLEST_SIZE, relative};
use crate::so::{self, Mat};
use crate::stepper::checks::SMALLEST_SINGULAR_VALUE;
use crate::tableau::Tableau;

/// The unknowns of one stage, in the frame of g0.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stage<const N: usize> {
    /// Attitude U_k.
    pub(super) u: Mat<N>,
    /// E_k = P_k - I.
    pub(super) e: Mat<N>,
    /// Body momentum mu_k.
    pub(super) mu: Mat<N>,
    /// Body velocity Omega_k.
    pub(super) omega: Mat<N>,
    /// U_k Omega_k.
    pub(super) u_omega: Mat<N>,
    /// X_k.
    pub(super) x: Mat<N>,
    /// U_k X_k.
    pub(super) u_x: Mat<N>,
    /// V_k.
    pub(super) v: Mat<N>,
}

/// The unknowns of the end point.
#[derive(Clone, Copy, Debug)]
pub(super) struct End<const N: usize> {
    /// f = g0^T g1.
    pub(super) f: Mat<N>,
    /// E = P_e - I.
    pub(super) e: Mat<N>,
    /// The multiplier Lambda.
    pub(super) lambda: Mat<N>,
}

/// A step being solved.
pub(super) struct Sweeps<'a, const N: usize> {
    pub(super) tableau: &'a Tableau,
    pub(super) dynamics: &'a dyn Dynamics<N>,
    pub(super) h: f64,
    pub(super) p0: &'a Mat<N>,
    /// The velocity at the beginning.
    pub(super) omega: &'a Mat<N>,
    pub(super) stages: &'a mut [Stage<N>],
    pub(super) end: &'a mut End<N>,
    /// Cost of a sweep, in sweeps of the usual solver for the tableau.
    pub(super) cost_in_sweeps: u32,
}

impl<const N: usize> Equations for Sweeps<'_, N> {
    fn guess(&mut self) -> Result<(), Failure> {
        let Self { tableau, h, p0, omega, .. } = *self;
        let turn =
            |angle: f64| so::retraction(&(omega * angle)).ok_or_else(|| Failure::not_finite(None));
        *self.end = End { f: turn(h)?, e: Mat::zeros(), lambda: p0 * -0.5 };
        for (k, stage) in self.stages.iter_mut().enumerate() {
            let u = turn(h * tableau.c(k))?;
            *stage = Stage {
                u,
                e: Mat::zeros(),
                mu: *p0,
                omega: *omega,
                u_omega: so::product(&u, omega),
                x: Mat::zeros(),
                u_x: Mat::zeros(),
                v: so::product(&self.end.f, &self.end.lambda) * (h * tableau.b(k)),
            };
        }
        Ok(())
    }

    fn sweep(&mut self) -> Result<f64, Failure> {
        /// Iterations of a Lyapunov equation that are usual.
        const USUAL: u32 = 16;
        self.dynamics.begin_sweep()?;
        let mut iterations = 0;
        let swept = self.over_all(&mut iterations);
        // A sweep that takes as long as several counts as several.
        let equations = self.stages.len() as u32 + 1;
        let several = (iterations / (USUAL * equations)).max(1) * self.cost_in_sweeps;
        for _ in 1..several {
            self.dynamics.begin_sweep()?;
        }
        swept
    }

    fn unknowns(&self, values: &mut Vec<f64>) {
        let Units { turn, embedded, momentum } = self.units();
        for stage in self.stages.iter() {
            values.extend(stage.u_omega.iter().chain(&stage.omega).map(|x| x / turn));
            values.extend(stage.v.iter().map(|x| x / embedded));
            values.extend(stage.mu.iter().map(|x| x / momentum));
        }
    }

    fn set(&mut self, values: &[f64]) {
        let Units { turn, embedded, momentum } = self.units();
        for (stage, values) in self.stages.iter_mut().zip(values.chunks_exact(4 * N * N)) {
            let matrix =
                |k: usize, unit: f64| Mat::from_column_slice(&values[k * N * N..][..N * N]) * unit;
            (stage.u_omega, stage.omega) = (matrix(0, turn), matrix(1, turn));
            (stage.v, stage.mu) = (matrix(2, embedded), matrix(3, momentum));
        }
    }

    /// About a thin axis the rounding of a momentum turns the body by more than that, and the other momenta with it.
    fn floor(&self) -> f64 {
        let turned = self.h.abs() * self.dynamics.mobility() * self.p0.amax();
        ROUND_OFF_FLOOR.max(8.0 * f64::EPSILON * turned)
    }
}

impl<const N: usize> Continued for Sweeps<'_, N> {
    fn keep(&self, numbers: &mut Vec<f64>) {
        for Stage { u_omega, omega, v, .. } in self.stages.iter() {
            numbers.extend(u_omega.iter().chain(omega).chain(v));
        }
    }

    fn continue_from(&mut self, numbers: &[f64]) -> Result<u32, Failure> {
        let matrix =
            |k: usize, numbers: &[f64]| Mat::from_column_slice(&numbers[k * N * N..][..N * N]);
        for (stage, numbers) in self.stages.iter_mut().zip(numbers.chunks_exact(3 * N * N)) {
            (stage.u_omega, stage.omega, stage.v) =
                (matrix(0, numbers), matrix(1, numbers), matrix(2, numbers));
        }
        // A sweep computes f from the velocities before it, and the momenta against which the next
        // is measured.
        self.sweep().map(|_| 1)
    }
}

impl<const N: usize> Sweeps<'_, N> {
    /// One sweep over all unknowns, each from the newest of the others; returns the largest change of a
    /// stage momentum relative to the largest momentum. Counts the iterations of the Lyapunov equations.
    fn over_all(&mut self, iterations: &mut u32) -> Result<f64, Failure> {
        let Self { tableau, dynamics, h, p0, stages, end, .. } = self;
        let h = *h;
        let s = stages.len();
        // (24c, vih3)
        for i in 0..s {
            let mut d = Mat::zeros();
            for j in 0..s {
                d += stages[j].u_omega * (h * tableau.a(i, j));
            }
            let stage = &mut stages[i];
            (stage.u, stage.e) = polar(&d, Some(i))?;
            stage.u_omega = so::product(&stage.u, &stage.omega);
        }
        // (24b, vih2)
        let mut d = Mat::zeros();
        for j in 0..s {
            d += stages[j].u_omega * (h * tableau.b(j));
        }
        (end.f, end.e) = polar(&d, None)?;
        // (17a, f1), (19a, fff1)
        let mut sum = Mat::zeros();
        for k in 0..s {
            let stage = &mut stages[k];
            let mut load =
                -so::asym(&so::product(&so::transposed_product(&stage.u, &stage.v), &stage.omega));
            let weight = h * tableau.b(k);
            // From the unknowns, not from the sweep before.
            let mu = || -so::asym(&so::transposed_product(&stage.u, &stage.v)) / weight;
            if let Some(gradient) = dynamics.gradient(k, &stage.u, &mu, &stage.omega) {
                load -= gradient * weight;
            }
            stage.x = lyapunov(&(stage.e + Mat::identity()), &load, &stage.x, Some(k), iterations)?;
            stage.u_x = so::product(&stage.u, &stage.x);
            sum += stage.u_x;
        }
        // (24d, vih4): M X + X M^T is asym(M X) for skew X.
        end.lambda = lyapunov(&end.f, &(-*p0 - so::asym(&sum)), &end.lambda, None, iterations)?;
        let f_lambda = so::product(&end.f, &end.lambda);
        let (mut change, mut size) = (0.0_f64, p0.amax());
        for k in 0..s {
            let weight = h * tableau.b(k);
            let mut v = f_lambda * weight;
            for i in 0..s {
                v += stages[i].u_x * (h * tableau.a(i, k));
            }
            let stage = &mut stages[k];
            // (24a, vih1)
            let mu = -so::asym(&so::transposed_product(&stage.u, &v)) / weight;
            if !mu.iter().all(|x| x.is_finite()) {
                return Err(Failure::not_finite(Some(k)));
            }
            change = change.max((mu - stage.mu).amax());
            size = size.max(mu.amax());
            // (24f, vih6)
            stage.omega = dynamics.velocity(k, &stage.u, &mu, &stage.omega);
            stage.u_omega = so::product(&stage.u, &stage.omega);
            (stage.v, stage.mu) = (v, mu);
        }
        Ok(relative(change, size))
    }

    fn units(&self) -> Units {
        let unit = |size: f64| if size >= SMALLEST_SIZE { size } else { 1.0 };
        Units {
            turn: unit(self.omega.amax()),
            embedded: unit(self.h.abs() * self.p0.amax()),
            momentum: unit(self.p0.amax()),
        }
    }
}

/// The units of velocities, of the embedded momenta and of the momenta.
struct Units {
    turn: f64,
    embedded: f64,
    momentum: f64,
}

/// `U` and `P - I` of `I + d = U P`.
fn polar<const N: usize>(d: &Mat<N>, stage: Option<usize>) -> Result<(Mat<N>, Mat<N>), Failure> {
    if !d.iter().all(|x| x.is_finite()) {
        return Err(Failure::not_finite(stage));
    }
    let left = Failure::new(FailureCode::LeftGlPlus, stage, 0.0, SMALLEST_SINGULAR_VALUE);
    let u = so::polar(&(d + Mat::identity())).ok_or(left)?;
    Ok((u, so::stretch_of(&u, d)))
}

fn lyapunov<const N: usize>(
    m: &Mat<N>,
    c: &Mat<N>,
    guess: &Mat<N>,
    stage: Option<usize>,
    iterations: &mut u32,
) -> Result<Mat<N>, Failure> {
    if !c.iter().all(|x| x.is_finite()) {
        return Err(Failure::not_finite(stage));
    }
    let singular = Failure::new(FailureCode::LyapunovSingular, stage, 0.0, 0.0);
    so::lyapunov_in(m, c, guess, iterations).ok_or(singular)
}
