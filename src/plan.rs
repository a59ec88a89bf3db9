//! 2 · Scenario → [`Plan`]: what will be modelled and why.
//!
//! The plan builds the mathematical objects of the scene (and refuses what is not valid: an attitude that is no
//! rotation, an inertia that is not positive), drops what the scene does not need, and says so.
//!
//! Invariant: a [`Plan`] can be run. What it dropped changes no number of the run but its cost.

use std::fmt;

use nalgebra::{DMatrix, DVector};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::log::schema::{Channel, Scenery};
use crate::method::Integrator;
use crate::scenario::{
    Adaptive, Attitude, Coefficients, DrivenTerm, Ensemble, Field, Path, PotentialTerm, Scenario,
    ScenarioError, Solver, TableauChoice, Target, Through, Torque,
};
use crate::solve::composition::Composition;
use crate::solve::failure::two_digits;
use crate::solve::free_top;
use crate::solve::nonlinear::StopRule;
use crate::solve::stepper::vpd_plane::{Plane, VpdPlane};
use crate::solve::trajectory::Observables;

mod adaptive;
pub(crate) mod bodies;
mod control;
mod cost;
mod derivatives;
mod model;
mod problem;
mod rotation;
mod terms;

pub use adaptive::OwnSteps;
pub use bodies::BodyPlan;
use control::{ModelControl, ModelWheels};
pub(crate) use cost::Fails;
pub use cost::{Counts, FirstSteps};
pub(crate) use model::inertia_matrix;
pub(crate) use model::{Model, ModelKinetic};
use model::{kinetic, momentum, of_matrix, tableau, tableau_choice, with_matrix};
pub(crate) use problem::driven_term;
pub(crate) use rotation::MOST_DEFECT;
use rotation::{attitude, axis_and_angle, skew};
use terms::{Extent, Terms};

/// Approximate size of a log in addition to its samples: schemas, scenario, plan, index.
pub(crate) const LOG_FIXED_BYTES: u64 = 50_000;

/// Least sigma of adaptive steps for a body point within a tenth of its arm from a point source:
/// `(1 + 10^3)^(-1/2)`.
pub(crate) const NEAR_SIGMA: f64 = 0.0316;

/// Plan of a job, for people and for [`crate::run`].
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct Plan {
    /// n of SO(n).
    pub dimension: usize,
    /// The integrator.
    pub formulation: Formulation,
    /// The step in seconds.
    pub step_s: f64,
    /// Number of steps.
    pub steps: u64,
    /// A sample is taken every k steps.
    pub every: u64,
    /// Number of samples of a run that ends well.
    pub samples: u64,
    /// Steps in a time of their own; the step above is then the one between the times that samples may come at.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub own_steps: Option<OwnSteps>,
    /// Several bodies, and what holds them; empty for one.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(default)]
    pub bodies: Vec<BodyPlan>,
    /// The terms of the potential, kept and dropped.
    pub potential: Vec<TermPlan>,
    /// Directions of space that the potential leaves free; the spatial momentum among them is conserved, or changes by the
    /// torques alone.
    pub free_directions: usize,
    /// Balance that is kept instead of the energy, and logged as the energy error, in a scene that changes with time or
    /// has torques.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub balance: Option<String>,
    /// Balance of the momentum that is kept, and logged as its drift, in a scene with torques.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub momentum_balance: Option<String>,
    /// The Jacobi integral of a scene that has one; its change is logged as `jacobi_error`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub jacobi_integral: Option<String>,
    /// The attitude at the start as one turn; for n = 3.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<StartAttitude>,
    /// Warnings to the user before the run.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(default)]
    pub warnings: Vec<String>,
    /// The channels of the log and what each costs.
    pub channels: Vec<ChannelPlan>,
    /// Samples in a chunk of the log: half a mebibyte, or what is estimated to take 3 s if that is less. An interrupted
    /// run goes on from the last whole chunk.
    pub samples_per_chunk: u64,
    /// Estimated size of the log in bytes.
    pub log_bytes: u64,
    /// Estimated time of a step in nanoseconds, on one core: of the first steps where they were timed on this machine,
    /// see [`crate::advise::Settled`]; else what it takes a common machine.
    pub step_ns: f64,
    /// Estimated time of the run on one core in seconds, with its samples, and with the beginning and the end of its log.
    pub run_s: f64,
    /// Estimated peak of the run's memory in bytes.
    pub memory_bytes: u64,
    /// The members of an ensemble.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ensemble: Option<EnsemblePlan>,
    /// Choice of method and step for an accuracy; see [`crate::advise`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub advice: Option<Advice>,
    /// The scenario as it was asked for: an accuracy may stand in the place of method and step.
    #[serde(skip)]
    pub asked: Scenario,
    /// The scenario with method and step.
    #[serde(skip)]
    pub settled: Scenario,
    /// The time of the run on a common machine, in seconds, without a log's beginning and end: what searches are allowed by,
    /// for the same end on any machine.
    #[serde(skip)]
    pub(crate) work_s: f64,
    /// The nanoseconds of a step, likewise.
    #[serde(skip)]
    pub(crate) work_step_ns: f64,
    #[serde(skip)]
    pub(crate) model: Model,
}

/// The attitude at the start, as one turn from the axes of space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct StartAttitude {
    /// The axis, of length one; z for no turn.
    pub axis: [f64; 3],
    /// The angle in degrees, from 0 to 180.
    pub angle_deg: f64,
}

impl StartAttitude {
    /// Returns the turn of a rotation matrix; `None` for other n than 3.
    fn of(attitude: &DMatrix<f64>) -> Option<Self> {
        if attitude.nrows() != 3 {
            return None;
        }
        let (axis, angle) = axis_and_angle(attitude);
        Some(Self { axis, angle_deg: angle / std::f64::consts::PI * 180.0 })
    }
}

impl fmt::Display for StartAttitude {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { axis: [x, y, z], angle_deg } = self;
        if *angle_deg == 0.0 {
            return f.write_str("the axes of the body are those of space");
        }
        // Six decimals at most, and a zero without a sign.
        let short = |x: &f64| (x * 1e6).round() / 1e6 + 0.0;
        let [x, y, z] = [x, y, z].map(short);
        write!(f, "the body is turned by {} degrees about ({x}, {y}, {z})", short(angle_deg))
    }
}

/// The members of an ensemble.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct EnsemblePlan {
    /// Number of members.
    pub members: u64,
    /// Members whose samples are logged, in their order; member 0 is the first.
    pub in_full: Vec<u64>,
    /// Ends in a chunk of the log, by the same rule. An interrupted run goes on from there.
    pub members_per_chunk: u64,
}

/// The choice of method and step for an accuracy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Advice {
    /// The error asked for.
    pub error: f64,
    /// The error expected at the end of the run.
    pub expected_error: f64,
    /// Ratio of the error asked for to the expected one.
    pub margin: f64,
    /// The time to which the run chosen was seen; beyond it its error was extrapolated.
    pub pilot_time_s: f64,
    /// Error of the pilots' reference.
    pub reference_error: f64,
    /// Methods that were tried, the cheapest first.
    pub candidates: Vec<Candidate>,
}

/// A method that was tried.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Candidate {
    /// Its name in a scenario.
    pub method: Integrator,
    /// Its tableau, or the order of a composition.
    pub tableau: String,
    /// The largest step that was found to reach the accuracy, in seconds; absent if none did.
    pub step_s: Option<f64>,
    /// The error expected there, else the least that was met.
    pub expected_error: Option<f64>,
    /// Its estimated cost for a second of motion, in microseconds: sweeps counted, not timed.
    pub cost_us: Option<f64>,
}

/// The integrator and the reason for it.
#[derive(Clone, Debug, Default, Serialize, JsonSchema)]
pub struct Formulation {
    /// Its name in a scenario.
    pub method: Integrator,
    /// The tableau's name, or `custom`; absent for a composition.
    pub tableau: Option<String>,
    /// Number of stages, of a composition of substeps.
    pub stages: usize,
    /// Order of the scheme.
    pub order: u32,
    /// Whether the attitude is computed: only where a term of the potential or a channel needs it.
    pub carries_attitude: bool,
    /// Reason for the choice.
    pub why: &'static str,
    /// Simplification used in addition: a body at rest, a motion in a plane.
    #[serde(skip_serializing_if = "Motion::is_general")]
    #[schemars(default)]
    pub motion: Motion,
}

/// Treatment of one term of the potential.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct TermPlan {
    /// JSON pointer of the term.
    pub pointer: String,
    /// Whether it is modelled; one that is merged into another is not by itself.
    pub kept: bool,
    /// Reason why it is kept or dropped.
    pub why: String,
}

/// Kind of motion that follows from the start and the terms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// Nothing that could be made use of.
    #[default]
    General,
    /// Nothing moves and nothing pushes: the state stays as it is.
    AtRest,
    /// n = 3, and the body turns about one of its axes: the scheme is computed for n = 2.
    InPlane,
}

impl Motion {
    fn is_general(&self) -> bool {
        *self == Self::General
    }

    /// Returns the motion in words; `None` if there is nothing to be said.
    pub fn words(self) -> Option<&'static str> {
        match self {
            Self::General => None,
            Self::AtRest => {
                Some("at rest: nothing moves and no torque acts, so the state does not change")
            }
            Self::InPlane => Some("stays in a plane: computed for n = 2, logged for n = 3"),
        }
    }
}

/// One channel of the log.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct ChannelPlan {
    /// Its topic.
    pub topic: Channel,
    /// Description of what is computed for it at each sample.
    pub computes: &'static str,
}

impl EnsemblePlan {
    /// Points on the way of a member, at most, and of all members together; no member has fewer than the least.
    const MOST_WAYPOINTS: u64 = 128;
    const WAYPOINTS_OF_ALL: u64 = 1 << 20;
    const LEAST_WAYPOINTS: u64 = 8;

    /// Returns the number of samples from a point on the way of a member to the next; the member
    /// takes `samples` samples.
    pub fn samples_per_waypoint(&self, samples: u64) -> u64 {
        let points = Self::WAYPOINTS_OF_ALL / self.members.max(1);
        let points = points.clamp(Self::LEAST_WAYPOINTS, Self::MOST_WAYPOINTS);
        // The start is one of the points.
        samples.saturating_sub(1).div_ceil(points - 1).max(1)
    }

    /// Returns the number of points on the way of a member that takes `samples` samples.
    pub(crate) fn waypoints(&self, samples: u64) -> u64 {
        1 + samples.saturating_sub(1).div_ceil(self.samples_per_waypoint(samples))
    }

    fn new(ensemble: &Ensemble) -> Self {
        let mut in_full = ensemble.in_full.clone();
        in_full.push(0);
        in_full.sort_unstable();
        in_full.dedup();
        Self { members: ensemble.members, in_full, members_per_chunk: 0 }
    }
}

impl Plan {
    /// Plans a scenario that was checked ([`Scenario::check`]), with a method and a step, without
    /// any run: the estimates are those of a usual one. [`crate::advise::plan`] plans any scenario.
    ///
    /// # Errors
    /// Where the numbers make no body, no rotation or no tableau, with the pointer of the field.
    pub fn new(scenario: &Scenario) -> Result<Self, ScenarioError> {
        let n = scenario.dimension();
        let step_s = match (scenario.step_s, scenario.adaptive(), scenario.duration_s) {
            (Some(step_s), _, _) => step_s,
            (None, Some(_), Some(duration_s)) => return Self::in_easy_steps(scenario, duration_s),
            (None, _, _) => {
                let message = "has not been turned into a method and a step";
                return Err(ScenarioError::invalid("/accuracy", message));
            }
        };
        if let Some(scene) = scenario.bodies() {
            return Self::of_bodies(scenario, scene, step_s);
        }
        let given = scenario.scene.inertia.as_ref();
        let given = given.ok_or_else(|| ScenarioError::invalid("/scene", "has no `inertia`"))?;
        let inertia = inertia_matrix(given);
        let mut kinetic = kinetic(given, &inertia)?;
        let mut attitude = {
            let given = scenario.scene.initial.attitude.as_ref();
            attitude("/scene/initial/attitude", given, n)?
        };
        let frame = scenario.scene.initial.orbit_frame;
        let orbit = frame.and_then(|index| scenario.scene.driven.get(index as usize));
        if let Some(axes) = orbit.and_then(|driven| problem::orbit_axes(driven, &inertia)) {
            attitude = axes * attitude;
        }
        let wheels = match scenario.scene.control.as_ref().map(|control| &control.through) {
            Some(Through::Wheels(given)) => {
                let initial = &scenario.scene.initial;
                let (wheels, own) = ModelWheels::new(given, initial, &attitude, &inertia)?;
                if let Some(own) = own {
                    kinetic = of_matrix(&own);
                }
                Some(wheels)
            }
            _ => None,
        };
        let momentum = momentum(scenario, &kinetic, &attitude, wheels.as_ref());
        let control = ModelControl::new(scenario, wheels, &attitude)?;
        let choice = tableau_choice(&scenario.method);
        let tableau = tableau(&choice, &scenario.method)?;
        let Solver { kind, tolerance, max_iterations } = scenario.method.solver;
        let model = Model {
            kinetic,
            terms: Vec::new(),
            shown: Vec::new(),
            constant: 0.0,
            driven: scenario.scene.driven.clone(),
            torques: scenario.scene.torques_on_orbits(),
            wheels: scenario.scene.wheels.as_deref().map(skew),
            control,
            attitude,
            momentum,
            tableau,
            stop: StopRule {
                tolerance,
                max_iterations,
                rungs: model::rungs(kind),
                ..StopRule::default()
            },
        };
        let mut plan = Self::begun(scenario, step_s, model);
        plan.start = StartAttitude::of(&plan.model.attitude);
        plan.channels = channels(scenario);
        plan.model.control.check_samples(step_s, plan.steps)?;
        plan.model.check_distances(&scenario.scene.potential)?;
        plan.add_terms(&scenario.scene.potential, &inertia);
        plan.add_driven(&inertia);
        let mut sources =
            scenario.scene.potential.iter().filter_map(PotentialTerm::as_point_source);
        if scenario.adaptive().is_some() && sources.next().is_none() {
            let message = "adapts its steps to the point sources of the scene, and there are none";
            return Err(ScenarioError::invalid("/method/name", message));
        }
        plan.own_steps = scenario.adaptive().map(|asked| {
            OwnSteps::new(&asked, step_s, &scenario.scene.potential, &plan.model.terms)
        });
        plan.formulation = plan.formulate(scenario)?;
        if plan.formulation.method == Integrator::VpdAdaptive {
            plan.model.control.check_exact()?;
        }
        plan.free_directions = plan.model.free_directions(n);
        for ChannelPlan { topic, computes } in &mut plan.channels {
            *computes = match topic {
                Channel::Momentum if !plan.formulation.carries_attitude => {
                    "how far the body momentum leaves its coadjoint orbit"
                }
                // No plane is free, so nothing of it is conserved.
                Channel::Momentum if plan.free_directions < 2 => "the spatial momentum",
                Channel::Solver if !plan.formulation.method.interpolates() => {
                    "how the steps were solved"
                }
                _ => continue,
            };
        }
        plan.balance = plan.model.balance();
        plan.momentum_balance =
            plan.model.momentum_balance(n, plan.free_directions, plan.formulation.method);
        plan.jacobi_integral = plan.model.jacobi_integral();
        plan.warnings.extend(plan.low_order());
        plan.warnings.extend(whole_turns("the body", scenario.scene.initial.attitude.as_ref()));
        plan.warnings.extend(no_body(&inertia));
        plan.warnings.extend(below_parallel_axis(&scenario.scene.potential, &inertia));
        plan.warnings.extend(plan.weak_gradients());
        plan.warnings.extend(plan.orbits_differ());
        plan.warnings.extend(plan.times_coincide());
        plan.warnings.extend(plan.tumbles());
        plan.estimate(FirstSteps::default());
        Ok(plan)
    }

    /// Returns a plan of these objects, to be filled in.
    fn begun(scenario: &Scenario, step_s: f64, model: Model) -> Self {
        let n = scenario.dimension();
        let mut plan = Self {
            dimension: n,
            formulation: Formulation::default(),
            step_s,
            steps: scenario.step_count(),
            every: scenario.sample_every(),
            samples: 0,
            own_steps: None,
            bodies: Vec::new(),
            potential: Vec::new(),
            free_directions: n,
            balance: None,
            momentum_balance: None,
            jacobi_integral: None,
            start: None,
            warnings: Vec::new(),
            channels: Vec::new(),
            samples_per_chunk: 0,
            log_bytes: 0,
            step_ns: 0.0,
            run_s: 0.0,
            work_s: 0.0,
            work_step_ns: 0.0,
            memory_bytes: 0,
            ensemble: scenario.ensemble.as_ref().map(EnsemblePlan::new),
            advice: None,
            asked: scenario.clone(),
            settled: scenario.clone(),
            model,
        };
        plan.samples = 1 + plan.steps.div_ceil(plan.every);
        plan
    }

    /// Plans a scenario with adaptive steps that names none: with an easy one, of which the
    /// duration is a whole number.
    fn in_easy_steps(asked: &Scenario, duration_s: f64) -> Result<Self, ScenarioError> {
        let with = |steps: f64| Scenario {
            step_s: Some(duration_s / steps),
            steps: Some(steps as u64),
            duration_s: None,
            ..asked.clone()
        };
        let whole = Self::new(&with(1.0))?;
        let stages = whole.formulation.stages;
        let easy_s = match asked.bodies() {
            Some(scene) => bodies::easy_own_step_s(asked, scene, stages)?,
            None => {
                let near_m = whole.own_steps.as_ref().map_or(&[][..], |own| own.near_m.as_slice());
                whole.model.easy_own_step_s(near_m, stages)
            }
        };
        let multiple = asked.multiple_of_steps() as f64;
        let settled = with(multiple * (duration_s / easy_s / multiple).ceil().max(1.0));
        settled.check()?;
        Ok(Self { asked: asked.clone(), ..Self::new(&settled)? })
    }

    /// Returns a step in seconds that a Gauss tableau of `stages` stages takes easily where steps
    /// adapt.
    pub(crate) fn easy_own_step_s(&self, stages: usize) -> f64 {
        let asked = Adaptive::default();
        let terms = &self.model.terms;
        let near_m = OwnSteps::new(&asked, self.step_s, terms, terms).near_m;
        self.model.easy_own_step_s(&near_m, stages)
    }

    /// Returns whether there is a point source, and nothing that keeps steps from adapting to it.
    pub(crate) fn can_adapt(&self) -> bool {
        !self.model.is_driven()
            && self.model.wheels.is_none()
            && self.formulation.motion != Motion::AtRest
            && self.model.terms.iter().any(|term| term.as_point_source().is_some())
    }

    /// Warns of coefficients with an order below what their stages suggest: one is mistyped, most often.
    fn low_order(&self) -> Option<String> {
        let TableauChoice::Custom(Coefficients { a, .. }) = self.settled.method.tableau.as_ref()?
        else {
            return None;
        };
        let is_explicit =
            a.iter().enumerate().all(|(i, row)| row.iter().skip(i).all(|&a| a == 0.0));
        // More than four stages do not give an explicit tableau an order of their number (Butcher 1964).
        let suggested = if is_explicit { a.len().min(4) } else { a.len() };
        let order = self.formulation.order as usize;
        (order < suggested).then(|| {
            format!(
                "the tableau has {} stages and order {order}; its stages allow {suggested} or more: check its coefficients",
                a.len()
            )
        })
    }

    /// Says where adaptive steps would pay, and where they do not, by the least sigma of a pilot
    /// run.
    pub(crate) fn offer_own_steps(&mut self, nearest_sigma: Option<f64>) {
        let Some(sigma) = nearest_sigma else { return };
        let distance = libm::cbrt(sigma * sigma);
        match (&self.own_steps, sigma <= NEAR_SIGMA) {
            (None, true) => self.warnings.push(format!(
                "a body point comes within {distance:.1e} of its arm of a point source: steps that adapt pass it with far \
                 fewer torque evaluations (\"step\": {{ \"adaptive\": {{}} }})"
            )),
            (Some(_), false) => self.warnings.push(format!(
                "steps of one length do as well here: no body point comes nearer to a point source than {distance:.1e} of its arm"
            )),
            _ => {}
        }
    }

    /// Warns of what changes faster than the steps: they pass over it, and their balances do not show that.
    pub(crate) fn warn_of_fast_changes(&mut self) {
        /// Phase in rad that passes in a step, for each stage: more is not resolved, and half of it well.
        const MOST_RAD: f64 = 1.0;
        let Some((pointer, rate_rad_s)) = self.model.fastest_change() else { return };
        let stages = self.formulation.stages as f64;
        let passed_rad = rate_rad_s * self.step_s;
        if passed_rad > MOST_RAD * stages {
            let resolved_s = two_digits(0.5 * MOST_RAD * stages / rate_rad_s);
            self.warnings.push(format!(
                "{pointer} changes by {passed_rad:.1} rad of its period in a step of {} s, which {stages} stages \
                 do not resolve; steps of {resolved_s:e} s do",
                self.step_s
            ));
        }
    }

    /// Refuses a step over which doubles cannot give the motion of a free body that is solved exactly.
    ///
    /// # Errors
    /// At `/step_s`, with the step up to which they can.
    pub(crate) fn exact_motion(&self) -> Result<(), ScenarioError> {
        let free = self.model.terms.is_empty() && !self.model.is_driven();
        if self.formulation.method != Integrator::Splitting || !free {
            return Ok(());
        }
        let (inverse, momentum) = self.model.in_principal_axes();
        if free_top::flow(&inverse, &momentum, self.step_s).is_some() {
            return Ok(());
        }
        let rate = momentum.norm() * inverse.amax();
        let (turn, most) = (rate * self.step_s, free_top::MOST_TURN_RAD);
        let message = if turn > most {
            format!(
                "{} s given, in which the body turns by up to {turn:.1e} rad; doubles give its attitude for at most \
                 {most:e} rad: a step of at most {:.3e} s is needed",
                self.step_s,
                most / rate
            )
        } else {
            format!(
                "{} s given, but the body starts on a separatrix, to the last digit: it leaves its middle axis at a time \
                 that rounding decides; a shorter step is needed",
                self.step_s
            )
        };
        Err(ScenarioError::invalid("/step_s", message))
    }

    /// Warns of a gravity gradient on an orbit with the strength n^2, which the figure 3 n^2 of textbooks is easily
    /// mistaken for.
    fn weak_gradients(&self) -> Vec<String> {
        let mistaken = |(index, driven): (usize, &DrivenTerm)| {
            let (PotentialTerm::GravityGradient(gradient), Some(Path::Orbit(orbit))) =
                (&driven.term, &driven.path)
            else {
                return None;
            };
            let right = gradient.strength_on_orbit(orbit.mean_motion_rad_s);
            let strength = gradient.strength().abs();
            ((3.0 * strength - right).abs() <= 0.01 * right).then(|| {
                format!(
                    "/scene/driven/{index}/term/strength is {strength:e}, the square of the mean motion; gravity on this \
                     orbit has three times that, {right:e}; without `strength` that is taken"
                )
            })
        };
        self.model.driven.iter().enumerate().filter_map(mistaken).collect()
    }

    /// Warns of a target or a field on another orbit than gravity: their mean motions are given apart.
    fn orbits_differ(&self) -> Option<String> {
        /// Parts of the mean motion by which they may differ.
        const APART: f64 = 0.01;
        let scene = &self.settled.scene;
        let gravity = scene.driven.iter().enumerate().filter_map(|(index, driven)| {
            match (&driven.term, &driven.path) {
                (PotentialTerm::GravityGradient(_), Some(Path::Orbit(orbit))) => {
                    Some((format!("/scene/driven/{index}/path/orbit"), orbit.mean_motion_rad_s))
                }
                _ => None,
            }
        });
        let target = scene.control.as_ref().and_then(|control| match &control.target {
            Some(Target::Orbit(orbit)) => {
                Some(("/scene/control/target/orbit".to_owned(), orbit.mean_motion_rad_s))
            }
            _ => None,
        });
        let field = scene.field.as_ref().map(|Field::Dipole(dipole)| {
            ("/scene/field/dipole/orbit".to_owned(), dipole.orbit.mean_motion_rad_s)
        });
        let orbits: Vec<_> = gravity.chain(target).chain(field).collect();
        let (first, n) = orbits.first()?;
        let differs = |(_, other): &&(String, f64)| (other.abs() - n.abs()).abs() > APART * n.abs();
        let (other, m) = orbits.iter().find(differs)?;
        Some(format!(
            "{first} has the mean motion {n:e} rad/s, {other} has {m:e}: one body is on one orbit"
        ))
    }

    /// Warns of samples that are closer than the nanoseconds of log times.
    fn times_coincide(&self) -> Option<String> {
        const NANOSECOND_S: f64 = 1e-9;
        let apart_s = self.step_s * self.every as f64;
        (apart_s < NANOSECOND_S && self.steps > 1).then(|| {
            format!(
                "samples are {apart_s:e} s apart, but log times are whole nanoseconds: several samples share one, and \
                 viewers show the last of them; `time_s` in /state tells them apart"
            )
        })
    }

    /// Warns of a free body that spins about its middle axis.
    fn tumbles(&self) -> Option<String> {
        /// Part of the angular velocity that may lie across the axis.
        const ACROSS: f64 = 0.05;
        /// Distance of the middle moment from each of the others, in parts of it.
        const APART: f64 = 1e-3;
        let free = self.model.terms.is_empty() && self.model.wheels.is_none();
        if self.dimension != 3 || !free || self.model.is_driven() {
            return None;
        }
        let (inverse, momentum) = self.model.in_principal_axes();
        let moments = inverse.map(|w| 1.0 / w);
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| moments[i].total_cmp(&moments[j]));
        let [least, middle, most] = order.map(|i| moments[i]);
        let omega = momentum.component_mul(&inverse);
        let is_apart = middle - least > APART * middle && most - middle > APART * middle;
        let along = omega[order[1]].abs();
        let across = (omega.norm_squared() - along * along).max(0.0).sqrt();
        (is_apart && along > 0.0 && across < ACROSS * along).then(|| {
            // Linearised Euler equations about the middle axis (Landau, Lifshitz, Mechanics, section 37).
            let rate = along * ((middle - least) * (most - middle) / (least * most)).sqrt();
            format!(
                "the body spins about its middle axis, which is unstable: what is off that axis grows e-fold every {:.3e} s, \
                 and the body turns over",
                1.0 / rate
            )
        })
    }

    /// Returns the number of steps of all members, or of the one run.
    pub fn total_steps(&self) -> u64 {
        self.steps * self.ensemble.as_ref().map_or(1, |ensemble| ensemble.members)
    }

    /// Returns whether the channel is logged.
    pub fn logs(&self, channel: Channel) -> bool {
        self.channels.iter().any(|plan| plan.topic == channel)
    }

    /// Returns the figures that the logged channels need at a sample.
    pub(crate) fn observables(&self) -> Observables {
        Channel::observables(self.channels.iter().map(|plan| plan.topic))
    }

    /// Combines the terms into those that have to be modelled.
    fn add_terms(&mut self, given: &[PotentialTerm], inertia: &DMatrix<f64>) {
        let given: Vec<PotentialTerm> =
            given.iter().map(|term| with_matrix(term, inertia)).collect();
        let terms = Terms::new(&given);
        self.model.shown = terms.modelled().cloned().collect();
        let extent = Extent {
            duration_s: self.steps as f64 * self.step_s,
            momentum: self.model.momentum.norm(),
            mobility: self.model.kinetic.mobility(),
        };
        (self.model.terms, self.model.constant, self.potential) =
            terms.put_together(&extent, &self.model).into_parts();
    }

    /// Takes the terms that change with time, and the torques, as they are.
    fn add_driven(&mut self, inertia: &DMatrix<f64>) {
        for (index, driven) in self.model.driven.iter_mut().enumerate() {
            driven.term = with_matrix(&driven.with_strength(), inertia);
            let pointer = format!("/scene/driven/{index}");
            let why = "changes with time".to_owned();
            self.potential.push(TermPlan { pointer, kept: true, why });
        }
        for (index, torque) in self.model.torques.iter().enumerate() {
            let pointer = format!("/scene/torques/{index}");
            let why = match torque {
                Torque::Drag(_) => "a torque of the air along an orbit",
                Torque::SolarPressure(_) => "a torque of sunlight",
                _ => "a torque that does not come from a potential",
            };
            let why = why.to_owned();
            self.potential.push(TermPlan { pointer, kept: true, why });
        }
        for (pointer, kept, why) in self.model.control.parts() {
            let (pointer, why) = (pointer.to_owned(), why.to_owned());
            self.potential.push(TermPlan { pointer, kept, why });
        }
    }

    /// Chooses the integrator.
    fn formulate(&self, scenario: &Scenario) -> Result<Formulation, ScenarioError> {
        let driven = self.model.is_driven();
        let free = self.model.terms.is_empty() && !driven;
        let asked = match (scenario.method.name.integrator(), &self.own_steps) {
            (_, Some(_)) => Some(Integrator::VpdAdaptive),
            (asked, None) => asked,
        };
        if let Some(method) = asked.filter(|method| method.facts().free && !free) {
            let acts = match self.potential.iter().find(|term| term.kept) {
                Some(term) if self.model.terms.is_empty() => format!("{} acts", term.pointer),
                Some(term) => format!("{} depends on the attitude", term.pointer),
                None => "something acts on this one".to_owned(),
            };
            let name = method.as_str();
            let message = format!("{name} is for free bodies, but {acts}");
            return Err(ScenarioError::invalid("/method/name", message));
        }
        if let Some(method) = asked {
            self.model.allows(method)?;
        }
        let spins = self.model.wheels.is_some() || self.model.control.has_wheels();
        let (method, why) = match asked {
            Some(method) => (method, "asked for"),
            None if scenario.derivatives.is_some() => {
                (Integrator::Vpd, "the method whose derivatives are known")
            }
            // A named tableau asks for its scheme.
            None if free && !spins && self.dimension == 3 && scenario.method.tableau.is_none() => (
                Integrator::Splitting,
                "no term depends on the attitude, and this method solves a free body exactly, at any step",
            ),
            None if free => (
                Integrator::VpdReduced,
                "no term depends on the attitude, so the momentum is computed without it",
            ),
            None => (
                Integrator::Vpd,
                "symplectic, on the group to round-off, of the tableau's order, for any potential",
            ),
        };
        // Members are compared by where they end, attitude included.
        let carries_attitude = !method.facts().free
            || self.channels.iter().any(|plan| plan.topic.shows_attitude())
            || self.model.control.has_stops()
            || self.ensemble.is_some();
        let tableau = &self.model.tableau;
        // A free body needs no more than one part.
        let usual = if asked.is_none() { 2 } else { 4 };
        let (name, stages, order) = match (scenario.method.order.unwrap_or(usual), method) {
            (order, method) if method.is_composition() => (
                None,
                Composition::new(order).map_or(1, |composition| composition.parts().len()),
                order,
            ),
            (_, method) if method.is_explicit() => {
                (tableau_name(scenario), tableau.stages(), tableau.classical_order())
            }
            _ => (tableau_name(scenario), tableau.stages(), tableau.order()),
        };
        let motion = self.motion(method, stages);
        Ok(Formulation { method, tableau: name, stages, order, carries_attitude, why, motion })
    }

    /// Returns the kind of motion from the given start; members of an ensemble have others.
    fn motion(&self, method: Integrator, stages: usize) -> Motion {
        // The derivatives are those of all motions next to this one.
        if self.ensemble.is_some() || self.settled.derivatives.is_some() {
            return Motion::General;
        }
        if self.model.is_driven() || self.model.wheels.is_some() {
            return Motion::General;
        }
        if self.model.is_at_rest() {
            return Motion::AtRest;
        }
        let quicker = method.facts().plane && stages <= VpdPlane::MOST_STAGES;
        if self.dimension == 3 && quicker && !self.model.terms.is_empty() {
            let (body, start) = self.model.problem::<3>();
            if Plane::of(&body, &start).is_some() {
                return Motion::InPlane;
            }
        }
        Motion::General
    }
}

/// Returns the tableau's name in a scenario, or `custom`.
fn tableau_name(scenario: &Scenario) -> Option<String> {
    match tableau_choice(&scenario.method) {
        TableauChoice::Named(name) => {
            serde_json::to_value(name).ok().and_then(|v| v.as_str().map(str::to_owned))
        }
        TableauChoice::Custom(_) => Some("custom".to_owned()),
    }
}

fn channels(scenario: &Scenario) -> Vec<ChannelPlan> {
    let three = scenario.dimension() == 3;
    let potential = !(scenario.scene.potential.is_empty() && scenario.scene.driven.is_empty());
    let has = |channel: &Channel| {
        channel.exists(Scenery {
            three,
            one: scenario.bodies().is_none(),
            several: scenario.bodies().is_some(),
            sources: potential,
            ensemble: scenario.ensemble.is_some(),
            own_steps: scenario.adaptive().is_some(),
            controlled: scenario.scene.control.is_some(),
            pointed: scenario.pointing.is_some(),
            differentiated: scenario.derivatives.is_some(),
        })
    };
    let asked = |channel: &Channel| {
        scenario.log.channels.as_ref().is_none_or(|asked| asked.contains(channel))
    };
    let logged = Channel::all().into_iter().filter(|channel| has(channel) && asked(channel));
    logged.map(|topic| ChannelPlan { topic, computes: topic.computes() }).collect()
}

/// Warns of an angle in radians of more than a turn: most often it is one in degrees.
fn whole_turns(whose: &str, attitude: Option<&Attitude>) -> Option<String> {
    let angle_rad = attitude?.largest_angle_rad();
    let turns = angle_rad / std::f64::consts::TAU;
    (turns > 1.0).then(|| {
        format!(
            "an angle of {whose} at the start is {angle_rad} rad, or {turns:.1} turns: degrees have fields that end in `_deg`"
        )
    })
}

/// Returns a message about an inertia that no rigid body has: a moment is the sum of two second
/// moments, none of which is negative, so none of the three is more than the other two.
fn no_body(inertia: &DMatrix<f64>) -> Option<String> {
    /// Error that decimal text may cause for a flat body.
    const ROUNDED: f64 = 1e-9;
    let n = inertia.nrows();
    // J = tr(D) I - D
    let second = inertia.trace() / (n as f64 - 1.0);
    let moments = inertia.symmetric_eigenvalues();
    let largest = moments.max();
    (n > 2 && largest - second > ROUNDED * largest).then(|| {
        let least = second - largest;
        let words = if n == 3 {
            let others = inertia.trace() - largest;
            format!("{largest} is more than the sum of the other two, {others}")
        } else {
            format!("the least second moment is {least}, below zero")
        };
        format!("no rigid body has this inertia: {words}; the equations hold all the same")
    })
}

/// Warns of moments about the fixed point that are less than what a mass at the body point of a weight alone has, which
/// is so if they are about the centre of mass. Only for n = 3; whether a uniform field is a weight is not known.
fn below_parallel_axis(terms: &[PotentialTerm], inertia: &DMatrix<f64>) -> Vec<String> {
    /// Standard gravity in m/s^2; on Earth it differs by less than the part that is let pass.
    const GRAVITY_M_S2: f64 = 9.80665;
    const PART: f64 = 0.99;
    if inertia.nrows() != 3 {
        return Vec::new();
    }
    let warning = |(index, term): (usize, &PotentialTerm)| {
        let PotentialTerm::Uniform(uniform) = term else { return None };
        let point = DVector::from_column_slice(&uniform.body_point);
        let size = DVector::from_column_slice(&uniform.direction).norm();
        let mass_kg = (uniform.weight * size).abs() / GRAVITY_M_S2;
        let least = mass_kg * point.norm_squared();
        if least == 0.0 {
            return None;
        }
        // The smallest moment about an axis across the point: the third eigenvalue belongs to the point itself.
        let along = terms::unit(&point);
        let across = DMatrix::identity(3, 3) - &along * along.transpose();
        let far = &along * along.transpose() * inertia.norm();
        let moment = (&across * inertia * &across + far).symmetric_eigenvalues().min();
        (moment < PART * least).then(|| {
            format!(
                "if /scene/potential/{index} is a weight on Earth, its mass of {mass_kg:.3e} kg at its body point alone has \
                 the moment {least:.3e} kg m^2, but the inertia has only {moment:.3e} kg m^2: it is to be given about the \
                 fixed point, not about the centre of mass"
            )
        })
    };
    terms.iter().enumerate().filter_map(warning).collect()
}

/// Returns n less the rank of space vectors.
fn free_directions<'a>(n: usize, vectors: impl Iterator<Item = &'a [f64]>) -> usize {
    // Gram and Schmidt, twice for round-off, as in [`crate::solve::hamiltonian::RigidBody::conserved_directions`].
    let mut taken: Vec<DVector<f64>> = Vec::new();
    for vector in vectors {
        let mut rest = terms::unit(&DVector::from_column_slice(vector));
        for direction in taken.iter().chain(&taken) {
            let part = direction.dot(&rest);
            rest.axpy(-part, direction, 1.0);
        }
        let size = rest.norm();
        if size > 1e-12 {
            taken.push(rest / size);
        }
        if taken.len() == n {
            break;
        }
    }
    n - taken.len()
}
