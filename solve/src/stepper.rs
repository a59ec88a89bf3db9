//! One-step schemes, one a file.
//!
//! Invariant: a stepper owns the state it carries, in the variables of its scheme, and gives attitude and
//! body momentum out on demand; a step that fails leaves that state as it was.

use super::control::{ControlSample, ControlState};
use super::failure::Failure;
use super::hamiltonian::RigidBody;
use super::nonlinear::Convergence;
use super::so::Mat;
use super::state::{Checkpoint, Derivatives, OwnTime, Pace, State};
pub use clock::Clock;
pub(crate) use galerkin::Motion as TurningMotion;
pub use knots::Knots;

pub(crate) mod checks;
mod clock;
pub mod controlled;
pub(crate) mod galerkin;
mod knots;
mod motion;
pub(crate) mod own_steps;
mod so3_equations;
pub mod vpd;
pub mod vpd_adaptive;
pub mod vpd_lagrangian;
pub mod vpd_reduced;
pub mod vpd_so3;
pub mod vpd_plane;
pub mod at_rest;
pub mod vrkmk;
pub mod rkmk;
pub mod rk;
pub mod explicit_so3;
mod explicit_stages;
pub mod splitting;
pub mod lgvi;
pub mod quaternion_gauss;

/// A scheme that carries a state of T*SO(n) forward, along systems of the type `S`.
pub trait Stepper<const N: usize, S: ?Sized = RigidBody<N>>: Send {
    /// Order of the scheme.
    fn order(&self) -> u32;

    /// Begins at a state; whatever was there before is forgotten.
    fn start(&mut self, state: &State<N>);

    /// Carries the state forward by `h` seconds.
    ///
    /// # Errors
    /// Any failure; the state is then untouched.
    fn step(&mut self, system: &S, h: f64) -> Result<Convergence, Failure>;

    /// Goes on from a checkpoint of a trajectory that was begun by [`Stepper::start`].
    fn resume(&mut self, checkpoint: &Checkpoint<N>) {
        self.start(&checkpoint.state());
    }

    /// Brings attitude and momentum to the end of the last step of `h` seconds, if the steps of the scheme do not end there;
    /// to be called before they are read. Returns the sweeps that it needed.
    ///
    /// # Errors
    /// Any failure.
    fn synchronise(&mut self, _system: &S, _h: f64) -> Result<u32, Failure> {
        Ok(0)
    }

    /// Returns the longest own step of a scheme with a time of its own, which may be changed from
    /// now on.
    fn own_step_s(&mut self) -> Option<&mut f64> {
        None
    }

    /// Returns the position of the scheme in its own time, for a checkpoint; `None` for one that
    /// has none.
    fn own_time(&self) -> Option<OwnTime<N>> {
        None
    }

    /// Returns the pace of time for the scheme at the state that was read last; `None` for one
    /// with no time of its own.
    fn pace(&self) -> Option<Pace> {
        None
    }

    /// Returns the system with the command that acts now; `None` if it is not controlled.
    fn acting(&self) -> Option<&S> {
        None
    }

    /// Returns what the controller of the system knows; `None` if it is not controlled.
    fn control(&self) -> Option<&ControlState> {
        None
    }

    /// Sets that, for a system that is controlled.
    fn set_control(&mut self, _control: &ControlState) {}

    /// Takes the noise of a member of an ensemble from now on, for a system whose control has noise: the stream of the control,
    /// `member` streams on.
    fn set_member(&mut self, _member: u64) {}

    /// Returns the last sample of the control since [`Stepper::start`] or [`Stepper::resume`].
    fn control_sample(&self) -> Option<&ControlSample> {
        None
    }

    /// Returns the clock of a scheme for driven systems; `None` for one that has none.
    fn clock(&self) -> Option<&Clock<N>> {
        None
    }

    /// Returns the same clock, to set it.
    fn clock_mut(&mut self) -> Option<&mut Clock<N>> {
        None
    }

    /// Sets the time at which the next step begins, in seconds; a scheme for systems that do not
    /// change with time ignores it.
    fn set_time(&mut self, time_s: f64) {
        if let Some(clock) = self.clock_mut() {
            clock.time = time_s;
        }
    }

    /// Returns the energy put in by time and torques that are no potential's since
    /// [`Stepper::start`], in J, by the weights of the scheme; zero for a system that is not
    /// driven.
    fn work(&self) -> f64 {
        self.clock().map_or(0.0, |clock| clock.work.value)
    }

    /// Returns the spatial momentum put in by torques that are no potential's since
    /// [`Stepper::start`], skew, in N m s, by the weights of the scheme; `None` for a scheme that
    /// takes no such torques.
    fn impulse(&self) -> Option<Mat<N>> {
        self.clock().map(|clock| clock.impulse.value)
    }

    /// Returns the part of [`crate::system::System::table_impulse`] put in since [`Stepper::start`], by the weights of the scheme.
    fn table_impulse(&self) -> f64 {
        self.clock().map_or(0.0, |clock| clock.table_impulse.value)
    }

    /// The attitude g; `None` from a scheme that carries none.
    fn attitude(&self) -> Option<Mat<N>>;

    /// The body momentum mu, skew.
    fn momentum(&self) -> Mat<N>;

    /// The smallest singular value of the matrices interpolated in the last step; `None` from a scheme
    /// that interpolates none.
    fn sigma_min(&self) -> Option<f64> {
        None
    }

    /// The derivatives of the state by the start and by parameters, and their covariance; `None` from a stepper that does not carry them along.
    fn derivatives(&self) -> Option<Derivatives> {
        None
    }

    /// Stage `k` (from 0) of the last step of VPD, solved: U_k in the frame of the attitude before the step, and the body
    /// momentum mu_k. `None` where there is none, or from a scheme that does not tell.
    fn stage(&self, _k: usize) -> Option<State<N>> {
        None
    }
}
