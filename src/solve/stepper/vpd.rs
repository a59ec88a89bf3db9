//! VPD in Hamiltonian form: the variational polar decomposition integrator of Shen, Tran, Leok (2022),
//! equations (vih), solved in a rearranged form.
//!
//! With one skew unknown X_i per stage for the paper's nested inverse of phi~*, and everything in the
//! frame of g0 (U_i here is the paper's g0^T U_i, f = g0^T g1):
//!
//! ```text
//! U_i P_i = I + h sum_j a_ij U_j Omega_j                                            (vih3)
//! f  P_e  = I + h sum_j b_j U_j Omega_j                                             (vih2)
//! V_k  = h b_k f Lambda + h sum_i a_ik U_i X_i
//! P_k X_k + X_k P_k = asym(U_k^T V_k Omega_k^T) - h b_k dH/dg(U_k, mu_k)            (f1), (fff1)
//! asym(f Lambda) = -p0 - asym(sum_i U_i X_i)                                        (vih4)
//! mu_k = -asym(U_k^T V_k) / (h b_k),    Omega_k = dH/dmu(mu_k)                      (vih1), (vih6)
//! p1 = -(P_e Lambda + Lambda P_e),    g1 = g0 f                                     (vih5)
//! ```
//!
//! In words: a symplectic partitioned Runge-Kutta method for g and the embedded momentum -V_k / (h b_k),
//! with the polar factor as constraint. The products h a_ij and h b_j enter both halves with the same bits,
//! so the pair is symplectic whatever their rounding.
//!
//! Invariant: on success the state has moved by one step of the tableau's order and its attitude is on the
//! group to round-off; on failure it has not moved. No sine, cosine or exponential is used.

use crate::solve::failure::{Failure, FailureCode};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::nonlinear::{Convergence, StopRule, fixed_point};
use crate::solve::so::{self, Mat, Vector};
use crate::solve::stepper::Stepper;
use crate::solve::tableau::Tableau;
use crate::solve::trajectory::State;

/// Smallest singular value of an interpolated matrix below which its polar factor is not trusted.
const SMALLEST_SINGULAR_VALUE: f64 = 0.1;

/// The stepper: a tableau, a stop rule and its scratch.
#[derive(Clone, Debug)]
pub struct Vpd<const N: usize> {
    tableau: Tableau,
    stop: StopRule,
    state: State<N>,
    stages: Vec<Stage<N>>,
    end: End<N>,
    seen: Vec<Vector<N>>,
}

/// The unknowns of one stage, in the frame of g0.
#[derive(Clone, Copy, Debug)]
struct Stage<const N: usize> {
    /// Attitude U_k.
    u: Mat<N>,
    /// E_k = P_k - I.
    e: Mat<N>,
    /// Body momentum mu_k.
    mu: Mat<N>,
    /// Body velocity Omega_k.
    omega: Mat<N>,
    /// U_k Omega_k.
    u_omega: Mat<N>,
    /// X_k.
    x: Mat<N>,
    /// U_k X_k.
    u_x: Mat<N>,
    /// V_k.
    v: Mat<N>,
}

/// The unknowns of the end point.
#[derive(Clone, Copy, Debug)]
struct End<const N: usize> {
    /// f = g0^T g1.
    f: Mat<N>,
    /// E = P_e - I.
    e: Mat<N>,
    /// The multiplier Lambda.
    lambda: Mat<N>,
}

impl<const N: usize> Vpd<N> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let zero = Mat::zeros();
        let u = Mat::identity();
        let stage =
            Stage { u, e: zero, mu: zero, omega: zero, u_omega: zero, x: zero, u_x: zero, v: zero };
        Self {
            stages: vec![stage; tableau.stages()],
            state: State { attitude: u, momentum: zero },
            end: End { f: u, e: zero, lambda: zero },
            seen: Vec::new(),
            tableau,
            stop,
        }
    }

    fn excesses(&self) -> impl Iterator<Item = &Mat<N>> {
        self.stages.iter().map(|stage| &stage.e).chain([&self.end.e])
    }

    /// Starts the unknowns from the velocity at the beginning of the step, kept constant. A function of
    /// the state alone: a resumed run repeats it to the bit.
    fn guess(&mut self, body: &RigidBody<N>, h: f64) -> Result<(), Failure> {
        let p0 = self.state.momentum;
        let omega = body.velocity(&p0);
        let turn = |angle: f64| {
            so::retraction(&(omega * angle)).ok_or(Failure::new(
                FailureCode::NonFinite,
                None,
                f64::INFINITY,
                f64::MAX,
            ))
        };
        self.end = End { f: turn(h)?, e: Mat::zeros(), lambda: p0 * -0.5 };
        for (k, stage) in self.stages.iter_mut().enumerate() {
            let u = turn(h * self.tableau.c(k))?;
            *stage = Stage {
                u,
                e: Mat::zeros(),
                mu: p0,
                omega,
                u_omega: u * omega,
                x: Mat::zeros(),
                u_x: Mat::zeros(),
                v: self.end.f * self.end.lambda * (h * self.tableau.b(k)),
            };
        }
        Ok(())
    }

    /// Refuses a solution on which the polar factor or the potential is not to be trusted.
    fn check(&self, body: &RigidBody<N>) -> Result<(), Failure> {
        for (k, e) in self.excesses().enumerate() {
            let stage = (k < self.stages.len()).then_some(k);
            // The cheap bound decides nearly always.
            if so::smallest_eigenvalue_bound(e) < -0.5 {
                let sigma = 1.0 + so::smallest_eigenvalue(e);
                if !(sigma >= SMALLEST_SINGULAR_VALUE) {
                    let code = if sigma > 0.0 {
                        FailureCode::IllConditioned
                    } else {
                        FailureCode::LeftGlPlus
                    };
                    return Err(Failure::new(code, stage, sigma, SMALLEST_SINGULAR_VALUE));
                }
            }
        }
        // A determinant is blind past half a turn: continuity from node to node is what tells.
        let mut nodes: Vec<(f64, usize)> =
            (0..self.stages.len()).map(|k| (self.tableau.c(k), k)).collect();
        nodes.sort_by(|a, b| a.0.total_cmp(&b.0));
        let identity = Mat::<N>::identity();
        let mut before = &identity;
        let path =
            nodes.iter().map(|&(_, k)| (Some(k), &self.stages[k].u)).chain([(None, &self.end.f)]);
        for (stage, u) in path {
            // A quarter turn in one plane: tr(U^T V) = n - 2 + 2 cos.
            let trace = before.dot(u);
            let limit = N as f64 - 2.0;
            if !(trace > limit) {
                return Err(Failure::new(FailureCode::BranchJump, stage, trace, limit));
            }
            before = u;
        }
        for (k, stage) in self.stages.iter().enumerate() {
            body.check_distances(&stage.u, &self.seen)
                .map_err(|failure| Failure { stage: Some(k), ..failure })?;
        }
        Ok(())
    }

    /// Names the reason behind a failed iteration where the iterate shows one: a charge met explains
    /// non-finite values and divergence better than they do.
    fn named(&self, body: &RigidBody<N>, failure: Failure) -> Failure {
        let met = self.stages.iter().enumerate().find_map(|(k, stage)| {
            let near = body.check_distances(&stage.u, &self.seen).err()?;
            Some(Failure { stage: Some(k), ..near })
        });
        match met {
            Some(near) => {
                Failure { iterations: failure.iterations, increments: failure.increments, ..near }
            }
            None => failure,
        }
    }
}

impl<const N: usize> Stepper<N> for Vpd<N> {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        body.seen_from(&self.state.attitude, &mut self.seen);
        self.guess(body, h)?;
        let Self { tableau, stop, stages, end, seen, state } = self;
        let solved =
            fixed_point(*stop, || sweep(tableau, body, seen, h, &state.momentum, stages, end));
        let convergence = solved.map_err(|failure| self.named(body, failure))?;
        self.check(body)?;
        let End { f, e, lambda } = &self.end;
        // (vih5): P_e Lambda + Lambda P_e is asym(P_e Lambda) for skew Lambda.
        self.state.momentum = -(lambda * 2.0 + so::asym(&(e * lambda)));
        // The product drifts off the group like any product; one correction in space puts it back.
        self.state.attitude = so::orthonormalised(&(self.state.attitude * f));
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.state.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        self.state.momentum
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(1.0 + self.excesses().map(so::smallest_eigenvalue).fold(f64::INFINITY, f64::min))
    }
}

/// One sweep over all unknowns, each from the newest of the others; returns the largest change of a
/// stage momentum relative to the largest momentum.
fn sweep<const N: usize>(
    tableau: &Tableau,
    body: &RigidBody<N>,
    seen: &[Vector<N>],
    h: f64,
    p0: &Mat<N>,
    stages: &mut [Stage<N>],
    end: &mut End<N>,
) -> Result<f64, Failure> {
    let s = stages.len();
    for i in 0..s {
        let mut d = Mat::zeros();
        for j in 0..s {
            d += stages[j].u_omega * (h * tableau.a(i, j));
        }
        let stage = &mut stages[i];
        (stage.u, stage.e) = polar(&d, Some(i))?;
        stage.u_omega = stage.u * stage.omega;
    }
    let mut d = Mat::zeros();
    for j in 0..s {
        d += stages[j].u_omega * (h * tableau.b(j));
    }
    (end.f, end.e) = polar(&d, None)?;
    let mut sum = Mat::zeros();
    for k in 0..s {
        let stage = &mut stages[k];
        let load = so::asym(&(stage.u.tr_mul(&stage.v) * stage.omega.transpose()))
            - body.gradient(&stage.u, seen) * (h * tableau.b(k));
        stage.x = lyapunov(&(stage.e + Mat::identity()), &load, &stage.x, Some(k))?;
        stage.u_x = stage.u * stage.x;
        sum += stage.u_x;
    }
    // M X + X M^T is asym(M X) for skew X.
    end.lambda = lyapunov(&end.f, &(-p0 - so::asym(&sum)), &end.lambda, None)?;
    let f_lambda = end.f * end.lambda;
    let (mut change, mut size) = (0.0_f64, p0.amax());
    for k in 0..s {
        let weight = h * tableau.b(k);
        let mut v = f_lambda * weight;
        for i in 0..s {
            v += stages[i].u_x * (h * tableau.a(i, k));
        }
        let stage = &mut stages[k];
        let mu = -so::asym(&stage.u.tr_mul(&v)) / weight;
        change = change.max(amax(&(mu - stage.mu)));
        size = size.max(amax(&mu));
        stage.omega = body.velocity(&mu);
        stage.u_omega = stage.u * stage.omega;
        (stage.v, stage.mu) = (v, mu);
    }
    Ok(if change == 0.0 { 0.0 } else { change / size })
}

/// Largest entry by size; unlike a plain maximum it keeps a NaN.
fn amax<const N: usize>(a: &Mat<N>) -> f64 {
    a.iter().fold(0.0, |largest: f64, x| if x.abs() <= largest { largest } else { x.abs() })
}

/// `U` and `P - I` of `I + d = U P`.
fn polar<const N: usize>(d: &Mat<N>, stage: Option<usize>) -> Result<(Mat<N>, Mat<N>), Failure> {
    if !d.iter().all(|x| x.is_finite()) {
        return Err(Failure::new(FailureCode::NonFinite, stage, f64::INFINITY, f64::MAX));
    }
    let u = so::polar(&(d + Mat::identity())).ok_or(Failure::new(
        FailureCode::LeftGlPlus,
        stage,
        0.0,
        SMALLEST_SINGULAR_VALUE,
    ))?;
    Ok((u, so::stretch_excess(&u, d)))
}

fn lyapunov<const N: usize>(
    m: &Mat<N>,
    c: &Mat<N>,
    guess: &Mat<N>,
    stage: Option<usize>,
) -> Result<Mat<N>, Failure> {
    if !c.iter().all(|x| x.is_finite()) {
        return Err(Failure::new(FailureCode::NonFinite, stage, f64::INFINITY, f64::MAX));
    }
    so::lyapunov(m, c, guess).ok_or(Failure::new(FailureCode::LyapunovSingular, stage, 0.0, 0.0))
}
