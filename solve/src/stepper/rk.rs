//! Explicit Runge-Kutta on (g, mu) as plain matrices, the baseline that knows nothing of the group.
//!
//! ```text
//! g' = g Omega,   mu' = [mu, Omega] - dH/dg,   Omega = dH/dmu
//! ```
//!
//! Kutta (1901), Zeitschrift fuer Mathematik und Physik 46, in R^(n x n). The attitude leaves the group by the
//! order of the method; optionally it is projected back after each step, to its orthogonal polar factor
//! (Hairer, Lubich, Wanner, Geometric Numerical Integration, IV.4), which mends the attitude but not the
//! energy.
//!
//! Invariant: the momentum is skew; with projection the attitude is on the group to round-off, and no step begins
//! with a turn of more than a quarter.

use std::f64::consts::FRAC_PI_2;

use super::checks::check_branch;
use super::explicit_stages::{
    AtStage, End, Law, NUMBERS, Rates, attitude_and_momentum, packed, parts, with_rates,
};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{RigidBody, WorkAndImpulse};
use crate::lanes::StageScalar;
use crate::nonlinear::Convergence;
use crate::so::{self, Mat, Vector};
use crate::space::{Mat3, dot, mended, norm_error, times_hat, vec3};
use crate::state::State;
use crate::stepper::{Clock, Stepper};
use crate::tableau::Tableau;

/// The stepper: an explicit tableau and its scratch.
#[derive(Clone, Debug)]
pub struct Rk<const N: usize> {
    tableau: Tableau,
    order: u32,
    projected: bool,
    state: State<N>,
    /// g' and mu' of each stage.
    rates: Vec<(Mat<N>, Mat<N>)>,
    seen: Vec<Vector<N>>,
    clock: Clock<N>,
}

impl<const N: usize> Rk<N> {
    /// Creates a stepper for an explicit tableau, with a polar projection after each step if
    /// `projected`; `None` for any other tableau.
    pub fn new(tableau: Tableau, projected: bool) -> Option<Self> {
        tableau.is_explicit().then(|| Self {
            order: tableau.classical_order(),
            projected,
            state: State { attitude: Mat::identity(), momentum: Mat::zeros() },
            rates: vec![(Mat::zeros(), Mat::zeros()); tableau.stages()],
            seen: Vec::new(),
            clock: Clock::default(),
            tableau,
        })
    }

    /// The state after the given parts of the rates so far.
    fn at(&self, stage: Option<usize>, part: impl Fn(usize) -> f64) -> Result<State<N>, Failure> {
        let State { attitude: mut g, momentum: mut mu } = self.state;
        for (j, (k, l)) in self.rates.iter().enumerate().take(stage.unwrap_or(usize::MAX)) {
            // At eighth order a third of them is zero.
            let part = part(j);
            if part != 0.0 {
                g += k * part;
                mu += l * part;
            }
        }
        if g.iter().chain(&mu).all(|x| x.is_finite()) {
            Ok(State { attitude: g, momentum: mu })
        } else {
            Err(Failure::not_finite(stage))
        }
    }
}

/// A projection does not distinguish turns that differ by a whole one, and what four stages make of a turn past 3 rad looks
/// like one of less than a quarter: the check of the projection cannot tell. So the turn is checked by the
/// velocity as well, by the same limit.
fn check_turn<const N: usize>(omega: &Mat<N>, h: f64) -> Result<(), Failure> {
    // No plane turns faster than all of them together.
    let turn = if h * so::inner(omega, omega).sqrt() > FRAC_PI_2 {
        h * so::frequencies(omega).last().copied().unwrap_or_default()
    } else {
        0.0
    };
    if turn > FRAC_PI_2 {
        return Err(Failure::new(FailureCode::BranchJump, Some(0), turn, FRAC_PI_2));
    }
    Ok(())
}

/// Largest entry of `I - g^T g` from which [`ROUNDS`] of Newton and Schulz reach round-off.
const NEAR: f64 = 1e-2;
/// Minus the square of a quarter turn, to within rounding: beyond it a turn is in doubt.
const QUARTER: f64 = 1e-9 - FRAC_PI_2 * FRAC_PI_2;
/// Number of rounds of Newton and Schulz.
const ROUNDS: usize = 3;

/// The step for n = 3 in vectors: see `explicit_so3`.
#[inline(always)]
pub(super) fn in_vectors<R: StageScalar, const EXTRAS: u8>(
    tableau: &Tableau,
    projected: bool,
    law: &mut Law<'_, R>,
    h: f64,
    state: &[R; NUMBERS],
    rates: &mut [Rates<R::Storage>],
) -> End<R> {
    let (g0, mu0) = attitude_and_momentum(state);
    let mut doubt = mu0[0].constant(-1.0);
    for i in 0..tableau.stages() {
        let parts = parts(tableau, h, Some(i));
        let g: Mat3<R> = vec3!(row => with_rates(g0[row], &parts[..i], rates, row));
        let mu = with_rates(mu0, &parts[..i], rates, 3);
        let at = law.at::<EXTRAS>(i, h * tableau.b(i), &g, &mu);
        let AtStage { omega, momentum_rate, doubt: of_stage } = at;
        doubt = doubt.max_or_nan(of_stage);
        if projected && i == 0 {
            doubt = doubt.max_or_nan(dot(&omega, &omega) * (h * h) + QUARTER);
        }
        let attitude_rate = times_hat(&g, &omega);
        for j in 0..3 {
            for row in 0..3 {
                attitude_rate[row][j].store(&mut rates[i][row][j]);
            }
            momentum_rate[j].store(&mut rates[i][3][j]);
        }
    }
    let parts = parts(tableau, h, None);
    let parts = &parts[..tableau.stages()];
    let mut g: Mat3<R> = vec3!(row => with_rates(g0[row], parts, rates, row));
    let momentum = with_rates(mu0, parts, rates, 3);
    if projected {
        for round in 0..ROUNDS {
            let error = norm_error(&g);
            if round == 0 {
                for entry in error {
                    doubt = doubt.max_or_nan(entry.abs() + -NEAR);
                }
            }
            g = mended(&g, &error);
        }
        // A quarter turn: see [`check_branch`].
        let trace = dot(&g0[0], &g[0]) + dot(&g0[1], &g[1]) + dot(&g0[2], &g[2]);
        doubt = doubt.max_or_nan(-trace + (1.0 + 1e-9));
    }
    End { state: packed(&g, &momentum), doubt }
}

/// Returns the orthogonal polar factor of the end of a step. Close to the group the iteration of
/// Newton and Schulz needs no inverse: each round squares the defect, `E <- 3/4 E^2 + E^3 / 4` for
/// `E = I - g^T g`.
fn projection<const N: usize>(g: &Mat<N>) -> Option<Mat<N>> {
    let mut u = *g;
    for _ in 0..=ROUNDS {
        let defect = Mat::<N>::identity() - so::transposed_product(&u, &u);
        let size = defect.amax();
        if !(size <= NEAR) {
            return so::polar(g);
        }
        u += u * defect * 0.5;
        if size <= 1e-8 {
            return Some(u);
        }
    }
    so::polar(g)
}

impl<const N: usize> Stepper<N> for Rk<N> {
    fn order(&self) -> u32 {
        self.order
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
        self.clock = Clock::default();
    }

    fn clock(&self) -> Option<&Clock<N>> {
        Some(&self.clock)
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        Some(&mut self.clock)
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        body.work().begin_sweep()?;
        body.seen_from(&Mat::identity(), &mut self.seen);
        let mut work_and_impulse = WorkAndImpulse::default();
        for i in 0..self.tableau.stages() {
            let State { attitude: g, momentum: mu } =
                self.at(Some(i), |j| h * self.tableau.a(i, j))?;
            let body_at_time =
                body.is_driven().then(|| body.at(self.clock.at(h, h * self.tableau.c(i))));
            body_at_time
                .as_ref()
                .map_or_else(
                    || body.check_distances_seen(&g, &self.seen),
                    |body_at_time| body_at_time.check(&g),
                )
                .map_err(|failure| Failure { stage: Some(i), ..failure })?;
            let now = body_at_time.as_ref().map_or(body, |body_at_time| &body_at_time.body);
            let omega = now.velocity(&mu);
            if self.projected && i == 0 {
                check_turn(&omega, h)?;
            }
            let rate = match &body_at_time {
                Some(body_at_time) => {
                    body.count(1);
                    work_and_impulse
                        .add(h * self.tableau.b(i), &body_at_time.input(&g, &mu, &omega));
                    body_at_time.momentum_rate(&g, &mu, &omega)
                }
                None => body.momentum_rate(&g, &mu, &omega, &self.seen),
            };
            self.rates[i] = (so::product(&g, &omega), rate);
        }
        let mut end = self.at(None, |j| h * self.tableau.b(j))?;
        if self.projected {
            let left = Failure::new(FailureCode::LeftGlPlus, None, 0.0, 0.0);
            let factor = projection(&end.attitude).ok_or(left)?;
            // A quarter turn in one plane, or a reflection: tr(U^T V) <= n - 2.
            let trace = so::dot(self.state.attitude.as_slice(), factor.as_slice());
            let limit = N as f64 - 2.0;
            check_branch(trace, limit, None)?;
            end.attitude = factor;
        }
        self.state = end;
        self.clock.advance(h, &work_and_impulse);
        Ok(Convergence::EXPLICIT)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.state.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        self.state.momentum
    }
}
