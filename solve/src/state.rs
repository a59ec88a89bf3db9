//! The state of a trajectory: where it is, at what pace of time, and what it takes to go on from there.

use nalgebra::DMatrix;

use super::control::ControlState;
use super::nonlinear::Convergence;
use super::so::{self, Mat};

/// A point of T*SO(n), left-trivialised: `g' = g Omega`. It is not checked: [`State::defect`] says how far it is from one.
#[derive(Clone, Debug, PartialEq)]
pub struct State<const N: usize> {
    /// The attitude g in SO(n): body coordinates to space coordinates.
    pub attitude: Mat<N>,
    /// The body momentum mu in so(n)*, skew.
    pub momentum: Mat<N>,
}

impl<const N: usize> State<N> {
    /// Returns the distance from a state: the largest entry of `g^T g - I`, or of `mu + mu^T` in
    /// parts of the largest of mu if that is larger; 2 for a reflection, NaN for what is not
    /// finite.
    pub fn defect(&self) -> f64 {
        let Self { attitude, momentum } = self;
        let group = (so::transposed_product(attitude, attitude) - Mat::identity()).amax();
        let size = momentum.amax();
        let skew = if size > 0.0 { (momentum + momentum.transpose()).amax() / size } else { 0.0 };
        let finite = attitude.iter().chain(momentum).all(|x| x.is_finite());
        if !finite {
            return f64::NAN;
        }
        let determinant = DMatrix::from_column_slice(N, N, attitude.as_slice()).determinant();
        if determinant < 0.0 { 2.0 } else { group.max(skew) }
    }
}

/// Pace of time for a scheme whose own steps differ in duration.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pace {
    /// dt / dtau at the sample.
    pub sigma: f64,
    /// Duration of the own step around the sample, in seconds; 0 at the start.
    pub step_s: f64,
    /// Own steps made before the sample.
    pub steps: u64,
    /// The least dt / dtau of an own step since the sample before.
    pub least_sigma: f64,
    /// Time of the state minus the time of the sample, in seconds.
    pub time_error_s: f64,
}

impl Pace {
    /// Is every number of it finite?
    pub(crate) fn is_finite(&self) -> bool {
        [self.sigma, self.step_s, self.least_sigma, self.time_error_s]
            .into_iter()
            .all(f64::is_finite)
    }
}

/// Position of a scheme in its own time: the end of its last own step.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnTime<const N: usize> {
    /// The attitude g there.
    pub attitude: Mat<N>,
    /// The body momentum mu there.
    pub momentum: Mat<N>,
    /// The time there, in seconds since the start.
    pub time_s: f64,
    /// Part of that time lost to rounding.
    pub carry_s: f64,
    /// Own steps made.
    pub steps: u64,
}

/// Derivatives of a state of a run, left-trivialised as in [`super::tangent`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Derivatives {
    /// By the state at the start: the state transition matrix, 2d x 2d, row by row. Empty if it is not asked for.
    pub transition: Vec<f64>,
    /// By parameters, one after another: 2d numbers for each.
    pub sensitivity: Vec<f64>,
    /// Covariance of the change of the state, 2d x 2d, row by row. Empty if none was given at the start.
    pub covariance: Vec<f64>,
}

impl Derivatives {
    /// Is every number of them finite?
    pub(super) fn is_finite(&self) -> bool {
        let Self { transition, sensitivity, covariance } = self;
        transition.iter().chain(sensitivity).chain(covariance).all(|x| x.is_finite())
    }

    /// Root mean square of |xi|, in radians: the root of the sum of the variances of the attitude. `None` without a covariance.
    pub fn attitude_spread_rad(&self) -> Option<f64> {
        let rows = self.covariance.len().isqrt();
        let variances = self.covariance.iter().step_by(rows + 1).take(rows / 2);
        (rows > 0).then(|| variances.sum::<f64>().max(0.0).sqrt())
    }
}

/// State of a trajectory at a sample: all that it needs, in addition to its start, to go on from
/// there.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint<const N: usize> {
    /// Steps made.
    pub step: u64,
    /// Samples recorded, that of this step included.
    pub samples: u64,
    /// The attitude g; `None` from a scheme that carries none.
    pub attitude: Option<Mat<N>>,
    /// The body momentum mu.
    pub momentum: Mat<N>,
    /// Sweeps of the nonlinear solver in all.
    pub iterations: u64,
    /// How the last step was solved; `None` if none was made.
    pub convergence: Option<Convergence>,
    /// Energy put in since the start, in J: see [`super::stepper::Stepper::work`].
    pub work: f64,
    /// Spatial momentum put in by torques that are no potential's since the start, in N m s: see
    /// [`super::stepper::Stepper::impulse`].
    pub impulse: Mat<N>,
    /// Impulse put in by torques by tables since the start, in N m s: see [`super::stepper::Stepper::table_impulse`].
    pub table_impulse: f64,
    /// Own time of a scheme that has one.
    pub own_time: Option<OwnTime<N>>,
    /// What a controller knows.
    pub control: Option<ControlState>,
    /// Since when each of the conditions that end the run holds, in seconds.
    pub holds_since_s: Vec<Option<f64>>,
    /// Derivatives of a stepper that carries them.
    pub derivatives: Option<Derivatives>,
}

impl<const N: usize> Checkpoint<N> {
    /// Attitude and momentum; the one of a scheme that carries no attitude is the identity, which it does not read.
    pub fn state(&self) -> State<N> {
        let attitude = self.attitude.unwrap_or_else(Mat::identity);
        State { attitude, momentum: self.momentum }
    }

    /// Creates the checkpoint before any step and sample.
    pub fn at_start(state: &State<N>) -> Self {
        Self {
            step: 0,
            samples: 0,
            attitude: Some(state.attitude),
            momentum: state.momentum,
            iterations: 0,
            convergence: None,
            work: 0.0,
            impulse: Mat::zeros(),
            table_impulse: 0.0,
            own_time: None,
            control: None,
            holds_since_s: Vec::new(),
            derivatives: None,
        }
    }
}
