//! One-step schemes, one a file.
//!
//! Invariant: a stepper owns the state it carries, in the variables of its scheme, and gives attitude and
//! body momentum out on demand; a step that fails leaves that state as it was.

use super::failure::Failure;
use super::hamiltonian::RigidBody;
use super::nonlinear::Convergence;
use super::so::Mat;
use super::trajectory::State;

mod galerkin;
pub mod vpd;
pub mod vpd_lagrangian;
pub mod vpd_reduced;
pub mod vpd_space;
pub mod vpd_plane;
pub mod at_rest;
pub mod vrkmk;
pub mod rkmk;
pub mod rk;
pub mod splitting;
pub mod lgvi;
pub mod quaternion_gauss;

/// A scheme that carries a state of T*SO(n) forward.
pub trait Stepper<const N: usize> {
    /// Order of the scheme.
    fn order(&self) -> u32;

    /// Takes up a state; whatever was there before is forgotten.
    fn start(&mut self, state: &State<N>);

    /// Carries the state forward by `h`.
    ///
    /// # Errors
    /// Any failure; the state is then untouched.
    fn step(&mut self, body: &RigidBody<N>, h: f64) -> Result<Convergence, Failure>;

    /// The attitude g; `None` from a scheme that carries none.
    fn attitude(&self) -> Option<Mat<N>>;

    /// The body momentum mu, skew.
    fn momentum(&self) -> Mat<N>;

    /// The smallest singular value of the matrices interpolated in the last step; `None` from a scheme
    /// that interpolates none.
    fn sigma_min(&self) -> Option<f64> {
        None
    }
}
