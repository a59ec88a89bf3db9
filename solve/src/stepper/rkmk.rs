//! Explicit Runge-Kutta-Munthe-Kaas: a classical method in the Lie algebra, pulled to the group by exp.
//!
//! Left-trivialised, `g = g0 exp(sigma)`, the momentum by the same tableau in its own linear space:
//!
//! ```text
//! sigma_i = h sum_j a_ij k_j          mu_i = mu_0 + h sum_j a_ij l_j
//! k_i = dexpinv(sigma_i, Omega_i)     l_i = [mu_i, Omega_i] - dH/dg(g0 exp(sigma_i))
//! g1 = g0 exp(h sum_j b_j k_j)        mu_1 = mu_0 + h sum_j b_j l_j
//! dexpinv(sigma, Omega) = sum_{k <= p - 2} (-1)^k B_k / k! ad_sigma^k Omega
//!                       = Omega + [sigma, Omega] / 2 + [sigma, [sigma, Omega]] / 12 - ...
//! ```
//!
//! Munthe-Kaas (1999), Applied Numerical Mathematics 29; Hairer, Lubich, Wanner, Geometric Numerical
//! Integration, IV.8.2 (there with `g' = A g`, which turns the sign of the odd terms). The sum is cut at
//! p - 2, p the order of the tableau: sigma is O(h), and the last term counts once more h.
//!
//! Invariant: the attitude is on the group to round-off. The method is not symplectic and not symmetric.

use super::explicit_stages::{
    AtStage, End, Law, NUMBERS, Rates, attitude_and_momentum, packed, parts, with_rates,
};
use crate::failure::Failure;
use crate::hamiltonian::{RigidBody, WorkAndImpulse};
use crate::lanes::StageScalar;
use crate::nonlinear::Convergence;
use crate::so::{self, Mat, Vector};
use crate::space::{
    SERIES_UP_TO, cross, dot, exp, matrix_product, mended, norm_error, plus, scaled,
};
use crate::state::State;
use crate::stepper::{Clock, Stepper};
use crate::tableau::Tableau;

/// `(-1)^k B_k / k!`, k = 1, 2, ...
pub(crate) const DEXPINV: [f64; 6] = [0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30_240.0];

/// The stepper: an explicit tableau and its scratch.
#[derive(Clone, Debug)]
pub struct Rkmk<const N: usize> {
    tableau: Tableau,
    order: u32,
    state: State<N>,
    /// k_i and l_i.
    rates: Vec<(Mat<N>, Mat<N>)>,
    seen: Vec<Vector<N>>,
    clock: Clock<N>,
}

impl<const N: usize> Rkmk<N> {
    /// Creates a stepper for an explicit tableau; `None` for any other.
    pub fn new(tableau: Tableau) -> Option<Self> {
        tableau.is_explicit().then(|| Self {
            order: tableau.classical_order(),
            state: State { attitude: Mat::identity(), momentum: Mat::zeros() },
            rates: vec![(Mat::zeros(), Mat::zeros()); tableau.stages()],
            seen: Vec::new(),
            clock: Clock::default(),
            tableau,
        })
    }

    /// The attitude in the frame of g0 and the momentum after the given parts of the rates so far.
    fn at(
        &self,
        stage: Option<usize>,
        part: impl Fn(usize) -> f64,
    ) -> Result<(Mat<N>, Mat<N>, Mat<N>), Failure> {
        let (mut sigma, mut mu) = (Mat::zeros(), self.state.momentum);
        for (j, (k, l)) in self.rates.iter().enumerate().take(stage.unwrap_or(usize::MAX)) {
            let part = part(j);
            if part != 0.0 {
                sigma += k * part;
                mu += l * part;
            }
        }
        let u = so::exp(&sigma);
        if u.iter().chain(&mu).all(|x| x.is_finite()) {
            Ok((sigma, u, mu))
        } else {
            Err(Failure::not_finite(stage))
        }
    }

    /// Number of brackets of dexpinv.
    pub(super) fn terms(&self) -> usize {
        self.order.saturating_sub(2) as usize
    }

    fn dexpinv(&self, sigma: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let (mut nested, mut sum) = (*omega, *omega);
        for coefficient in DEXPINV.iter().take(self.terms()) {
            // [A, B] = AB - (AB)^T for skew A and B.
            nested = so::asym(&so::product(sigma, &nested));
            if *coefficient != 0.0 {
                sum += nested * *coefficient;
            }
        }
        sum
    }
}

/// The step for n = 3 in vectors: see `explicit_so3`. The bracket of so(3) is the cross product.
#[inline(always)]
pub(super) fn in_vectors<R: StageScalar, const EXTRAS: u8>(
    tableau: &Tableau,
    terms: usize,
    law: &mut Law<'_, R>,
    h: f64,
    state: &[R; NUMBERS],
    rates: &mut [Rates<R::Storage>],
) -> End<R> {
    let (g0, mu0) = attitude_and_momentum(state);
    let zero = mu0[0].constant(0.0);
    let mut doubt = zero.constant(-1.0);
    for i in 0..tableau.stages() {
        let parts = parts(tableau, h, Some(i));
        let sigma = with_rates([zero; 3], &parts[..i], rates, 0);
        let mu = with_rates(mu0, &parts[..i], rates, 3);
        let square = dot(&sigma, &sigma);
        let g = if i == 0 { g0 } else { matrix_product(&g0, &exp(&sigma, square)) };
        let at = law.at::<EXTRAS>(i, h * tableau.b(i), &g, &mu);
        let AtStage { omega, momentum_rate, doubt: of_stage } = at;
        doubt = doubt.max_or_nan(of_stage).max_or_nan(square + -SERIES_UP_TO);
        let (mut nested, mut rate) = (omega, omega);
        // The first sigma is zero.
        for coefficient in DEXPINV.iter().take(if i == 0 { 0 } else { terms }) {
            nested = cross(&sigma, &nested);
            if *coefficient != 0.0 {
                rate = plus(&rate, &scaled(&nested, zero.constant(*coefficient)));
            }
        }
        for j in 0..3 {
            rate[j].store(&mut rates[i][0][j]);
            momentum_rate[j].store(&mut rates[i][3][j]);
        }
    }
    let parts = parts(tableau, h, None);
    let parts = &parts[..tableau.stages()];
    let sigma = with_rates([zero; 3], parts, rates, 0);
    let square = dot(&sigma, &sigma);
    let g = matrix_product(&g0, &exp(&sigma, square));
    // The product drifts off the group like any product; one correction puts it back.
    End {
        state: packed(&mended(&g, &norm_error(&g)), &with_rates(mu0, parts, rates, 3)),
        doubt: doubt.max_or_nan(square + -SERIES_UP_TO),
    }
}

impl<const N: usize> Stepper<N> for Rkmk<N> {
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
        body.seen_from(&self.state.attitude, &mut self.seen);
        let mut work_and_impulse = WorkAndImpulse::default();
        for i in 0..self.tableau.stages() {
            let (sigma, u, mu) = self.at(Some(i), |j| h * self.tableau.a(i, j))?;
            let body_at_time =
                body.is_driven().then(|| body.at(self.clock.at(h, h * self.tableau.c(i))));
            let g = || so::product(&self.state.attitude, &u);
            body_at_time
                .as_ref()
                .map_or_else(
                    || body.check_distances_seen(&u, &self.seen),
                    |body_at_time| body_at_time.check(&g()),
                )
                .map_err(|failure| Failure { stage: Some(i), ..failure })?;
            let now = body_at_time.as_ref().map_or(body, |body_at_time| &body_at_time.body);
            let omega = now.velocity(&mu);
            let k = self.dexpinv(&sigma, &omega);
            let rate = match &body_at_time {
                Some(body_at_time) => {
                    body.count(1);
                    work_and_impulse
                        .add(h * self.tableau.b(i), &body_at_time.input(&g(), &mu, &omega));
                    body_at_time.momentum_rate(&g(), &mu, &omega)
                }
                None => body.momentum_rate(&u, &mu, &omega, &self.seen),
            };
            self.rates[i] = (k, rate);
        }
        let (_, f, momentum) = self.at(None, |j| h * self.tableau.b(j))?;
        // The product drifts off the group like any product; one correction puts it back.
        let attitude = so::orthonormalised(&so::product(&self.state.attitude, &f));
        self.state = State { attitude, momentum };
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
