//! A run that its caller carries forward, and turns by a torque that is held from one call to the next.
//!
//! Its log is that of a job: the scene with the torques that were held as tables over time, which [`super::execute`] runs. So
//! the log is written at the end, and [`crate::verify`] repeats it from itself.
//!
//! Invariant: the states are those of that job's log, to the bit.

use super::summary::{self, Advised};
use super::{Diagnosis, Outcome};
use crate::advise;
use crate::assemble::{Assembly, Task, assembled};
use crate::plan::Plan;
use crate::scenario::{
    Entry, Framed, Interpolation, MAX_SIZE, SMALLEST_STRENGTH, Scenario, ScenarioError, Table,
    Torque, TorqueTable, ensure,
};
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::{RigidBody, Torque as BodyTorque};
use crate::solve::so::{self, Mat};
use crate::solve::state::{Checkpoint, State};
use crate::solve::stepper::{Knots, Stepper};
use crate::solve::system::System as _;

/// A run that its caller steps.
///
/// ```
/// use vpd::run::{Advanced, Simulation};
/// use vpd::scenario::{Inertia, Scenario, Scene};
///
/// let body = Scene::free(Inertia::Principal([1.0, 2.0, 3.0]));
/// let scenario = Scenario::of("spun-up", body, 0.01, 1000)?;
/// let mut simulation = Simulation::new(&scenario)?;
/// simulation.set_torque(&[0.0, 0.0, 0.3])?;
/// assert_eq!(simulation.advance(100, |_| true), Advanced::Whole);
/// simulation.set_torque(&[0.0; 3])?;
/// assert_eq!(simulation.advance(100, |_| true), Advanced::Whole);
/// // A torque of 0.3 N m for 1 s about an axis of 3 kg m^2.
/// let [_, _, omega] = simulation.angular_velocity()[..] else { unreachable!("n = 3") };
/// assert!((omega - 0.1).abs() < 1e-12);
/// assert_eq!(simulation.job()?.step_count(), 200);
/// # Ok::<(), vpd::scenario::ScenarioError>(())
/// ```
pub struct Simulation {
    scenario: Scenario,
    plan: Plan,
    carried: Box<dyn Carried>,
    steps: u64,
    samples: u64,
    torque: Vec<f64>,
    /// The steps before which the torque was changed, and the torques from there on.
    changes: Vec<(u64, Vec<f64>)>,
    failed: Option<Box<Diagnosis>>,
}

/// How far a call of [`Simulation::advance`] came.
#[derive(Clone, Debug, PartialEq)]
pub enum Advanced {
    /// All steps were made.
    Whole,
    /// The caller asked to stop.
    Stopped,
    /// A step could not be made; the state is that before it, and no further step is made.
    Failed(Box<Diagnosis>),
}

impl Simulation {
    /// Most times that a torque may change: rows of a table, less its end.
    pub const MOST_CHANGES: usize = 99_999;

    /// Begins at the start of a scenario, without a torque. Its number of steps is not read.
    ///
    /// # Errors
    /// Those of planning it, and for an ensemble, control, conditions that end a run, adaptive steps and a method that takes no
    /// torques.
    pub fn new(scenario: &Scenario) -> Result<Self, ScenarioError> {
        ensure(scenario.ensemble.is_none(), "/ensemble", || {
            "is not allowed here: a simulation is one run".into()
        })?;
        ensure(scenario.scene.control.is_none(), "/scene/control", || {
            "is not allowed here: the caller sets the torque of a simulation".into()
        })?;
        scenario.one_body()?;
        ensure(scenario.until.is_empty(), "/until", || {
            "is not allowed here: the caller ends a simulation".into()
        })?;
        let settled = advise::plan(scenario)?.settled;
        ensure(settled.step.is_none(), "/step", || {
            "adaptive steps do not end where a torque changes; give `step_s`".into()
        })?;
        let scenario = Scenario { expect: None, ..settled };
        // The plan of a body that a torque turns, whatever torque that will be.
        let places = so_dimension(scenario.dimension());
        let torque = vec![0.0; places];
        let plan = Plan::new(&with_torques(
            &scenario,
            scenario.step_count().max(1),
            &[(0, torque.clone())],
        ))?;
        let carried = assembled(&plan, Begin { plan: &plan, tables: places });
        Ok(Self {
            scenario,
            plan,
            carried,
            steps: 0,
            samples: 0,
            changes: vec![(0, torque.clone())],
            torque,
            failed: None,
        })
    }

    /// Returns n of SO(n).
    pub fn dimension(&self) -> usize {
        self.plan.dimension
    }

    /// Returns the step in seconds.
    pub fn step_s(&self) -> f64 {
        self.plan.step_s
    }

    /// Returns the number of steps made.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the time in seconds since the start.
    pub fn time_s(&self) -> f64 {
        self.steps as f64 * self.plan.step_s
    }

    /// Returns the matrix from body to space coordinates, row by row.
    pub fn attitude(&self) -> Vec<f64> {
        self.carried.attitude()
    }

    /// Returns the angular velocity in body coordinates, in rad/s: 3 numbers, or those above the diagonal of the skew
    /// matrix.
    pub fn angular_velocity(&self) -> Vec<f64> {
        self.carried.angular_velocity()
    }

    /// Returns the momentum in body coordinates, in kg m^2/s, in the same order.
    pub fn body_momentum(&self) -> Vec<f64> {
        self.carried.momentum()
    }

    /// Returns the torque that is held, in body coordinates, in N m, in the same order.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// Returns how often the torque has changed so far.
    pub fn changes(&self) -> usize {
        self.changes.len() - 1
    }

    /// Sets the torque that is held from now on. A component below 1e-30 N m, which no scenario holds, is none.
    ///
    /// # Errors
    /// If it has the wrong length, or a number that a scenario cannot hold.
    pub fn set_torque(&mut self, torque: &[f64]) -> Result<(), ScenarioError> {
        let places = self.torque.len();
        ensure(torque.len() == places, "/torque", || {
            format!("{} numbers given, {places} are needed", torque.len())
        })?;
        for (at, x) in torque.iter().enumerate() {
            ensure(x.abs() <= MAX_SIZE, format!("/torque/{at}"), || {
                format!("{x:?} given, the size of a number is at most {MAX_SIZE:e}")
            })?;
        }
        let held = |x: &f64| if x.abs() < SMALLEST_STRENGTH { 0.0 } else { *x };
        let torque: Vec<f64> = torque.iter().map(held).collect();
        if torque == self.torque {
            return Ok(());
        }
        self.carried.set_torque(&torque);
        match self.changes.last_mut() {
            Some((step, held)) if *step == self.steps => held.clone_from(&torque),
            _ => self.changes.push((self.steps, torque.clone())),
        }
        self.torque = torque;
        Ok(())
    }

    /// Forgets the torques held before: of one that is never to be a job, and goes on for long.
    pub fn forget(&mut self) {
        self.changes.clear();
        self.changes.push((self.steps, self.torque.clone()));
    }

    /// Makes `steps` steps; `go_on` is asked before each, with the number made so far.
    pub fn advance(&mut self, steps: u64, mut go_on: impl FnMut(u64) -> bool) -> Advanced {
        if let Some(failed) = &self.failed {
            return Advanced::Failed(failed.clone());
        }
        for _ in 0..steps {
            if !go_on(self.steps) {
                return Advanced::Stopped;
            }
            if self.steps.is_multiple_of(self.plan.every) {
                self.samples += 1;
                // Where a chunk of the log ends, the steps begin anew.
                if self.samples.is_multiple_of(self.plan.samples_per_chunk) {
                    self.carried.begin_anew();
                }
            }
            let Self { plan, steps, .. } = self;
            if let Err(failure) = self.carried.step(*steps as f64 * plan.step_s, plan.step_s) {
                let untried = Advised::Untried;
                let found = summary::diagnosis(&failure, None, *steps, plan.step_s, untried);
                self.failed = Some(Box::new(found.clone()));
                return Advanced::Failed(Box::new(found));
            }
            self.steps += 1;
        }
        Advanced::Whole
    }

    /// Returns the job that makes the same run: the scene with the torques that were held as tables over time. Its run fails
    /// if this one did.
    ///
    /// # Errors
    /// If there are more changes than a table has rows.
    pub fn job(&self) -> Result<Scenario, ScenarioError> {
        let steps = self.steps + u64::from(self.failed.is_some());
        let job = with_torques(&self.scenario, steps, &self.changes);
        job.check()?;
        Ok(job)
    }

    /// Returns how it stands: failed, or succeeded so far.
    pub fn outcome(&self) -> Outcome {
        if self.failed.is_some() { Outcome::Failed } else { Outcome::Succeeded }
    }
}

/// Returns the number of coordinates of so(n).
fn so_dimension(n: usize) -> usize {
    n * (n - 1) / 2
}

/// Returns a scenario of `steps` steps that has torques in body coordinates, each held from the step of its number on.
fn with_torques(scenario: &Scenario, steps: u64, changes: &[(u64, Vec<f64>)]) -> Scenario {
    let n = scenario.dimension();
    let step_s = scenario.step_s.unwrap_or_default();
    let within = |(step, _): &&(u64, Vec<f64>)| *step < steps;
    let mut scenario = scenario.clone();
    (scenario.steps, scenario.duration_s) = (Some(steps), None);
    if steps == 0 {
        return scenario;
    }
    for place in 0..so_dimension(n) {
        let held: Vec<(f64, f64)> = changes
            .iter()
            .filter(within)
            .map(|(step, torque)| (*step as f64 * step_s, torque[place]))
            .collect();
        let last = held.last().map_or(0.0, |(_, value)| *value);
        let (mut times_s, mut values): (Vec<f64>, Vec<f64>) = held.into_iter().unzip();
        times_s.push(steps as f64 * step_s);
        values.push(last);
        let interpolation = Some(Interpolation::Hold);
        let table = Table { interpolation, ..Table::of(times_s, values) };
        let along = Framed::Body(unit(n, place));
        scenario.scene.torques.push(Torque::Table(TorqueTable { along, table }));
    }
    scenario
}

/// Returns an element of so(n) of which one coordinate is 1, as in a scenario.
fn unit(n: usize, place: usize) -> Vec<Entry> {
    if n == 3 {
        return (0..3).map(|at| Entry::Number(f64::from(at == place))).collect();
    }
    let above = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    let (i, j) = above.clone().nth(place).unwrap_or_default();
    let entry = |at: (usize, usize)| f64::from(at == (i, j)) - f64::from(at == (j, i));
    (0..n).map(|row| Entry::Row((0..n).map(|column| entry((row, column))).collect())).collect()
}

/// A body on its way, of any n.
trait Carried: Send {
    fn set_torque(&mut self, torque: &[f64]);
    fn step(&mut self, begun_s: f64, step_s: f64) -> Result<(), Failure>;
    fn begin_anew(&mut self);
    fn attitude(&self) -> Vec<f64>;
    fn momentum(&self) -> Vec<f64>;
    fn angular_velocity(&self) -> Vec<f64>;
}

/// Begins a run.
struct Begin<'a> {
    plan: &'a Plan,
    /// Tables of torques at the end of the list, in place of which the body gets the torque that is held.
    tables: usize,
}

impl Task for Begin<'_> {
    type Output = Box<dyn Carried>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Box<dyn Carried> {
        let Assembly { mut stepper, initial, .. } = assembly;
        let mut model = self.plan.model.clone();
        let own = model.torques.len() - self.tables;
        model.torques.truncate(own);
        let (bare, _) = model.problem::<N>();
        stepper.start(&initial);
        let body = pushed(&bare, &vec![0.0; self.tables]);
        Box::new(Body { bare, body, stepper, knots: Knots::default() })
    }
}

fn pushed<const N: usize>(bare: &RigidBody<N>, torque: &[f64]) -> RigidBody<N> {
    bare.clone().with_torque(BodyTorque::Body(so::hat(torque)))
}

struct Body<const N: usize> {
    /// Without the torque that is held.
    bare: RigidBody<N>,
    body: RigidBody<N>,
    stepper: Box<dyn Stepper<N>>,
    knots: Knots,
}

impl<const N: usize> Body<N> {
    fn state(&self) -> State<N> {
        let attitude = self.stepper.attitude().unwrap_or_else(Mat::identity);
        State { attitude, momentum: self.stepper.momentum() }
    }
}

impl<const N: usize> Carried for Body<N> {
    fn set_torque(&mut self, torque: &[f64]) {
        self.body = pushed(&self.bare, torque);
    }

    fn step(&mut self, begun_s: f64, step_s: f64) -> Result<(), Failure> {
        self.knots.step(&self.body, self.stepper.as_mut(), begun_s, step_s).map(drop)
    }

    fn begin_anew(&mut self) {
        self.stepper.resume(&Checkpoint::at_start(&self.state()));
    }

    fn attitude(&self) -> Vec<f64> {
        self.state().attitude.transpose().as_slice().to_vec()
    }

    fn momentum(&self) -> Vec<f64> {
        so::vee(&self.stepper.momentum())
    }

    fn angular_velocity(&self) -> Vec<f64> {
        let State { attitude, momentum } = self.state();
        let velocity = self.body.observed_velocity(0.0, &attitude, &momentum);
        velocity.map_or_else(Vec::new, |omega| so::vee(&omega))
    }
}
