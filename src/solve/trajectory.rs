//! The one time loop: a stepper carries a state forward, samples go to a sink.
//!
//! Invariant: a sample holds finite numbers only, belongs to an accepted step, and comes in order of
//! time; time is `k h`, never a sum.

use super::failure::{Failure, FailureCode};
use super::hamiltonian::{Energy, RigidBody};
use super::nonlinear::Convergence;
use super::so::{self, Mat};
use super::stepper::vpd::Vpd;

/// A point of T*SO(n), left-trivialised: `g' = g Omega`.
#[derive(Clone, Debug, PartialEq)]
pub struct State<const N: usize> {
    /// The attitude g in SO(n): body coordinates to space coordinates.
    pub attitude: Mat<N>,
    /// The body momentum mu in so(n)*, skew.
    pub momentum: Mat<N>,
}

/// How far and how finely to go.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// The step h in seconds.
    pub step_s: f64,
    /// Number of steps.
    pub steps: u64,
    /// A sample is taken every so many steps, at the start and at the end.
    pub every: u64,
}

/// What is computed at a sample beside the state: what somebody asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observables {
    /// Kinetic and potential energy.
    pub energy: bool,
    /// Distance of the attitude from the group.
    pub orthogonality: bool,
    /// Spatial momentum and the drift of its conserved part.
    pub momentum: bool,
    /// The smallest singular value met in the step.
    pub sigma_min: bool,
}

/// One sample. What was not asked for is `None`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample<'a, const N: usize> {
    /// Number of the step that ended here; 0 at the start.
    pub step: u64,
    /// Time in seconds since the start.
    pub time_s: f64,
    /// Attitude and body momentum.
    pub state: &'a State<N>,
    /// Energy H = T + U.
    pub energy: Option<Energy>,
    /// Energy now minus energy at the start.
    pub energy_error: Option<f64>,
    /// Spectral norm of g g^T - I.
    pub orthogonality_error: Option<f64>,
    /// Spatial momentum g mu g^T.
    pub spatial_momentum: Option<Mat<N>>,
    /// Size of the change of the conserved part of the spatial momentum since the start; `None` also
    /// where the scene conserves none.
    pub momentum_drift: Option<f64>,
    /// How the nonlinear solver ended the step; `None` at the start.
    pub convergence: Option<Convergence>,
    /// Smallest singular value of the interpolated matrices of the step; `None` at the start.
    pub sigma_min: Option<f64>,
}

/// Where samples go: the MCAP log, a `Vec` in tests and studies.
pub trait Sink<const N: usize> {
    /// What may go wrong when a sample is kept.
    type Error;

    /// Takes one sample.
    ///
    /// # Errors
    /// Ends the trajectory.
    fn record(&mut self, sample: &Sample<'_, N>) -> Result<(), Self::Error>;
}

/// How a trajectory ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Ending {
    /// All steps were made.
    Completed,
    /// The caller asked to stop.
    Cancelled,
    /// A step failed; `Trajectory::steps` were made before it.
    Failed(Failure),
}

/// What a trajectory leaves behind.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory<const N: usize> {
    /// How it ended.
    pub ending: Ending,
    /// Steps made.
    pub steps: u64,
    /// Samples recorded.
    pub samples: u64,
    /// The state after the last step made.
    pub state: State<N>,
    /// Sweeps of the nonlinear solver in all.
    pub iterations: u64,
}

/// Carries `initial` forward along `schedule` and gives the samples to `sink`: the first at the start,
/// then one every `schedule.every` steps, and the last accepted state whatever happens.
/// `go_on(steps_done)` is asked before each step.
///
/// # Errors
/// Those of the sink. A step that fails is not an error but an [`Ending`].
pub fn integrate<const N: usize, S: Sink<N>>(
    body: &RigidBody<N>,
    stepper: &mut Vpd<N>,
    initial: State<N>,
    schedule: Schedule,
    observables: Observables,
    sink: &mut S,
    mut go_on: impl FnMut(u64) -> bool,
) -> Result<Trajectory<N>, S::Error> {
    let mut run = Trajectory {
        ending: Ending::Completed,
        steps: 0,
        samples: 0,
        state: initial,
        iterations: 0,
    };
    let observer = Observer::new(body, &run.state, observables);
    match observer.sample(body, 0, 0.0, &run.state, None, None) {
        Ok(first) => sink.record(&first)?,
        Err(failure) => {
            run.ending = Ending::Failed(failure);
            return Ok(run);
        }
    }
    run.samples = 1;
    let mut recorded = 0;
    let mut last = None;
    while run.steps < schedule.steps {
        if !go_on(run.steps) {
            run.ending = Ending::Cancelled;
            break;
        }
        let mut next = run.state.clone();
        let convergence = match stepper.step(body, schedule.step_s, &mut next) {
            Ok(convergence) => convergence,
            Err(failure) => {
                run.ending = Ending::Failed(failure);
                break;
            }
        };
        let step = run.steps + 1;
        if step.is_multiple_of(schedule.every) || step == schedule.steps {
            let time_s = step as f64 * schedule.step_s;
            let sigma_min = observables.sigma_min.then(|| stepper.sigma_min());
            match observer.sample(body, step, time_s, &next, Some(convergence), sigma_min) {
                Ok(sample) => sink.record(&sample)?,
                Err(failure) => {
                    run.ending = Ending::Failed(failure);
                    break;
                }
            }
            recorded = step;
            run.samples += 1;
        }
        last = Some(convergence);
        run.state = next;
        run.steps = step;
        run.iterations += u64::from(convergence.iterations);
    }
    if recorded < run.steps {
        let time_s = run.steps as f64 * schedule.step_s;
        if let Ok(sample) = observer.sample(body, run.steps, time_s, &run.state, last, None) {
            sink.record(&sample)?;
            run.samples += 1;
        }
    }
    Ok(run)
}

/// Computes what a sample holds beside the state, measured against the start.
struct Observer<const N: usize> {
    observables: Observables,
    initial_energy: f64,
    initial_momentum: Mat<N>,
    conserved: Option<Mat<N>>,
}

impl<const N: usize> Observer<N> {
    fn new(body: &RigidBody<N>, initial: &State<N>, observables: Observables) -> Self {
        Self {
            observables,
            initial_energy: if observables.energy { body.energy(initial).total() } else { 0.0 },
            initial_momentum: spatial_momentum(initial),
            conserved: body.conserved_directions(),
        }
    }

    fn sample<'a>(
        &self,
        body: &RigidBody<N>,
        step: u64,
        time_s: f64,
        state: &'a State<N>,
        convergence: Option<Convergence>,
        sigma_min: Option<f64>,
    ) -> Result<Sample<'a, N>, Failure> {
        let Observables { energy, orthogonality, momentum, .. } = self.observables;
        let energy = energy.then(|| body.energy(state));
        let spatial_momentum = momentum.then(|| spatial_momentum(state));
        let sample = Sample {
            step,
            time_s,
            state,
            energy,
            energy_error: energy.map(|now| now.total() - self.initial_energy),
            orthogonality_error: orthogonality.then(|| so::orthogonality_error(&state.attitude)),
            momentum_drift: spatial_momentum.zip(self.conserved).map(|(now, q)| {
                let change = q * (now - self.initial_momentum) * q;
                so::inner(&change, &change).sqrt()
            }),
            spatial_momentum,
            convergence,
            sigma_min,
        };
        let numbers = [
            sample.energy_error,
            sample.energy.map(|energy| energy.kinetic),
            sample.orthogonality_error,
            spatial_momentum.map(|m| m.sum()),
            sample.momentum_drift,
            sigma_min,
        ];
        let finite = state.attitude.iter().chain(&state.momentum).all(|x| x.is_finite())
            && numbers.into_iter().flatten().all(f64::is_finite);
        if finite {
            Ok(sample)
        } else {
            Err(Failure::new(FailureCode::NonFinite, None, f64::INFINITY, f64::MAX))
        }
    }
}

/// The momentum in space coordinates, `g mu g^T`.
pub fn spatial_momentum<const N: usize>(state: &State<N>) -> Mat<N> {
    state.attitude * state.momentum * state.attitude.transpose()
}
