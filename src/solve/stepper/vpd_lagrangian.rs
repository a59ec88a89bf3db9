//! VPD in Lagrangian form: Shen, Tran, Leok (2022), equations (vil).
//!
//! (vil1) gives the momentum that each stage must have, `dL/dOmega(U_k, Omega_k) = mu_k`, and is implicit for
//! Omega_k. Each sweep makes one Newton correction of it,
//!
//! ```text
//! Omega_k <- Omega_k - (d^2L/dOmega^2)^-1 (dL/dOmega(U_k, Omega_k) - mu_k)
//! ```
//!
//! with the second derivative of the beginning of the step, so that the sweeps converge to the
//! solution of (vil1) whatever the Lagrangian. For a hyperregular one this is the map of the Hamiltonian form.
//!
//! Invariant: nothing is asked of the system but the derivatives of its Lagrangian.

use nalgebra::DMatrix;

use super::Stepper;
use super::galerkin::{Dynamics, GalerkinStep};
use crate::solve::failure::{Failure, FailureCode};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::lagrangian::{Lagrangian, corrected, inverse_hessian, velocity_of_momentum};
use crate::solve::nonlinear::{Convergence, StopRule};
use crate::solve::so::{self, Mat};
use crate::solve::tableau::Tableau;
use crate::solve::trajectory::State;

/// The stepper: the shared step, the state, and the velocity that belongs to it.
#[derive(Clone, Debug)]
pub struct VpdLagrangian<const N: usize> {
    step: GalerkinStep<N>,
    state: State<N>,
}

impl<const N: usize> VpdLagrangian<N> {
    /// A stepper for `tableau` that solves each step until `stop`.
    pub fn new(tableau: Tableau, stop: StopRule) -> Self {
        let state = State { attitude: Mat::identity(), momentum: Mat::zeros() };
        Self { step: GalerkinStep::new(tableau, stop), state }
    }

    /// Carries the state forward by `h` along any Lagrangian.
    ///
    /// # Errors
    /// Any failure; the state is then untouched. [`FailureCode::Diverged`] also where the momentum has no
    /// velocity: the Lagrangian is not hyperregular there.
    pub fn advance(
        &mut self,
        lagrangian: &dyn Lagrangian<N>,
        h: f64,
    ) -> Result<Convergence, Failure> {
        let Self { step, state } = self;
        let singular = || Failure::new(FailureCode::Diverged, None, f64::INFINITY, f64::MAX);
        let g0 = state.attitude;
        let zero = Mat::zeros();
        let omega =
            velocity_of_momentum(lagrangian, &g0, &state.momentum, &zero).ok_or_else(singular)?;
        let inverse = inverse_hessian(lagrangian, &g0, &omega).ok_or_else(singular)?;
        let mut dynamics = Euler { lagrangian, g0, inverse };
        let convergence = step.solve(&mut dynamics, h, &state.momentum, &omega)?;
        state.momentum = step.momentum();
        state.attitude = so::orthonormalised(&so::product(&g0, step.rotation()));
        Ok(convergence)
    }
}

/// (vil1) and the force, in the frame of g0.
struct Euler<'a, const N: usize> {
    lagrangian: &'a dyn Lagrangian<N>,
    g0: Mat<N>,
    inverse: DMatrix<f64>,
}

impl<const N: usize> Dynamics<N> for Euler<'_, N> {
    fn velocity(&mut self, _k: usize, u: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let residual = self.lagrangian.momentum(&(self.g0 * u), omega) - mu;
        omega - corrected(&self.inverse, &residual)
    }

    fn gradient(&self, u: &Mat<N>, omega: &Mat<N>) -> Option<Mat<N>> {
        // dH/dg = -dL/dg
        Some(-self.lagrangian.force(&(self.g0 * u), omega))
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.lagrangian.begin_sweep()
    }

    fn check(&self, u: &Mat<N>) -> Result<(), Failure> {
        self.lagrangian.check(&(self.g0 * u))
    }
}

impl<const N: usize> Stepper<N> for VpdLagrangian<N> {
    fn order(&self) -> u32 {
        self.step.order()
    }

    fn start(&mut self, state: &State<N>) {
        self.state = state.clone();
    }

    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure> {
        self.advance(body, h)
    }

    fn attitude(&self) -> Option<Mat<N>> {
        Some(self.state.attitude)
    }

    fn momentum(&self) -> Mat<N> {
        self.state.momentum
    }

    fn sigma_min(&self) -> Option<f64> {
        Some(self.step.sigma_min())
    }
}
