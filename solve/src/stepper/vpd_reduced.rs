//! VPD for a free body, reduced to the Lie-Poisson equations on so(n)*: Shen, Tran, Leok (2022), (25, lp) with
//! the reduced adjoint maps (26, nf), (27, nnf).
//!
//! The shared step in the frame of g0 is that integrator: with f_0 = f and Theta_i = U_i^T f, g0
//! drops out of it. (The paper's (27b, nnf2) has a wrong index: the reduced phi~ map has weight 1,
//! as in (19b, fff2).) The body momentum is the whole state; the attitude is composed of the
//! rotations of the steps, g_{k+1} = g_k f_k, only on request. There are no forces, so sweeps start
//! from a guess by the preceding steps ([`crate::nonlinear::StepHistory`]).
//!
//! Invariant: the momentum stays on its coadjoint orbit to round-off.

use super::Stepper;
use super::galerkin::{BodyView, Dynamics, GalerkinStep};
use crate::compensated::Sum;
use crate::failure::Failure;
use crate::hamiltonian::RigidBody;
use crate::nonlinear::{Convergence, StopRule};
use crate::so::{self, Mat};
use crate::state::State;
use crate::tableau::Tableau;

/// The stepper: the shared step, the momentum, and the attitude if requested.
#[derive(Clone, Debug)]
pub struct VpdReduced<const N: usize> {
    step: GalerkinStep<N>,
    momentum: Sum<Mat<N>>,
    attitude: Option<Mat<N>>,
}

impl<const N: usize> VpdReduced<N> {
    /// Creates a stepper for `tableau` that solves each step until `stop`, and reconstructs the
    /// attitude if `with_attitude`.
    pub fn new(tableau: Tableau, stop: StopRule, with_attitude: bool) -> Self {
        Self {
            step: GalerkinStep::new(tableau, stop).continued(),
            momentum: Sum::new(Mat::zeros(), Mat::zeros()),
            attitude: with_attitude.then(Mat::identity),
        }
    }
}

/// (25f, lp6): `Omega = dh/dmu`; nothing depends on the attitude.
struct Free<'a, const N: usize>(&'a RigidBody<N>);

impl<const N: usize> Dynamics<N> for Free<'_, N> {
    fn velocity(&self, _k: usize, _u: &Mat<N>, mu: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        self.0.velocity(mu)
    }

    fn gradient(
        &self,
        _k: usize,
        _u: &Mat<N>,
        _mu: &dyn Fn() -> Mat<N>,
        _omega: &Mat<N>,
    ) -> Option<Mat<N>> {
        None
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.0.work().begin_sweep()
    }

    fn body(&self) -> Option<BodyView<'_, N>> {
        Some(BodyView { body: self.0, vectors: &[], scale: None, weights: self.0.principal() })
    }
}

/// Returns `f^T p f - p` for skew p and `f = I + turn`, the change of the momentum by (25, lp):
/// `asym(p turn) + turn^T p turn`.
///
/// The deviation of f from a rotation would make the Casimirs drift, so it is removed first:
/// everything that is rounded after that is small relative to p.
fn coadjoint_change<const N: usize>(turn: &Mat<N>, p: &Mat<N>) -> Mat<N> {
    // f^T f - I
    let defect = turn + turn.transpose() + so::transposed_product(turn, turn);
    let turn = turn - (defect + so::product(turn, &defect)) * 0.5;
    let turned = so::product(p, &turn);
    so::asym(&turned) + so::skew(&so::transposed_product(&turn, &turned))
}

impl<const N: usize> Stepper<N> for VpdReduced<N> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.step.forget();
        self.momentum = Sum::new(state.momentum, Mat::zeros());
        self.attitude = self.attitude.map(|_| state.attitude);
    }

    /// # Assumes
    /// A free body: a potential is ignored.
    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        debug_assert!(body.is_free(), "the reduced integrator is for free bodies");
        let p0 = self.momentum.value;
        let convergence = self.step.solve(&Free(body), h, &p0, &body.velocity(&p0))?;
        let turn = &self.step.solution().rotation_increment;
        self.momentum.add(&coadjoint_change(turn, &p0));
        self.attitude = self.attitude.map(|g| so::orthonormalised(&(g + so::product(&g, turn))));
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        self.attitude
    }

    fn momentum(&self) -> Mat<N> {
        self.momentum.value
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.step.sigma_min())
    }
}
