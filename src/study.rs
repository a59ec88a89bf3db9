//! 4 · Studies: many runs of one scene, one table.
//!
//! Which method, which step: [`precision`] measures error and work against the step, [`long_term`] the energy
//! and the distance from the group over a long run, [`stability`] where each method fails. All measure with
//! [`measure`] and against a [`reference::Reference`] that the program computes itself. [`own`] is work and precision on
//! a system that no scenario describes.
//!
//! Invariant: a study repeats to the bit but for its times; it ends early only if it is cancelled.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use thiserror::Error;

use crate::method::{Integrator, Variant};
use crate::plan::Plan;
use crate::scenario::{Method, Scenario, ScenarioError, SolverKind, TableauChoice, TableauName};

pub mod long_term;
pub mod measure;
pub mod own;
pub mod precision;
pub mod reference;
pub mod stability;
pub mod table;

use measure::Probe;
use reference::ReferenceError;

/// Why a study has no result.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum StudyError {
    /// The scene cannot be planned with a method.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// There is no reference to measure against.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
    /// The run whose error was asked for fails.
    #[error("the run fails, so its end has no error")]
    Failed,
    /// Somebody stopped it.
    #[error("the study was cancelled")]
    Cancelled,
    /// It has cost all that it may.
    #[error("it has cost all that it may")]
    TooExpensive,
}

/// What a study shares with those who wait for it.
#[derive(Debug, Default)]
pub struct Watch {
    /// Runs made so far.
    pub done: AtomicU64,
    /// Runs to be made, as far as that is known.
    pub total: AtomicU64,
    /// Set it to stop the study within a sweep of its current step.
    pub cancelled: Arc<AtomicBool>,
    /// Work that may still be done, in nanoseconds by the plan's figures: counted, not timed. No end if absent.
    pub allowance_ns: Option<AtomicU64>,
}

impl Watch {
    fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }

    fn expect(&self, runs: u64) {
        self.total.fetch_add(runs, Ordering::Relaxed);
    }

    pub(crate) fn advance(&self, runs: u64) -> Result<(), StudyError> {
        self.done.fetch_add(runs, Ordering::Relaxed);
        if self.is_cancelled() {
            return Err(StudyError::Cancelled);
        }
        if self.left_ns() == 0 { Err(StudyError::TooExpensive) } else { Ok(()) }
    }

    pub(crate) fn left_ns(&self) -> u64 {
        self.allowance_ns.as_ref().map_or(u64::MAX, |left| left.load(Ordering::Relaxed))
    }

    /// Takes what a run has cost from what may still be done.
    fn pay(&self, cost_ns: u64) {
        if let Some(left) = &self.allowance_ns {
            left.store(self.left_ns().saturating_sub(cost_ns), Ordering::Relaxed);
        }
    }
}

/// Makes sure that a scene is one, whatever method and step it will run with.
///
/// # Errors
/// Those of planning it.
#[cfg(feature = "serve")]
pub(crate) fn scene_of(scene: &Scenario) -> Result<(), ScenarioError> {
    measure::variant(scene, &Method::default(), 1.0, 1).map(drop)
}

/// A method that takes part in a study.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The method with its tableau or order.
    pub method: Method,
    /// The integrator that it names.
    pub integrator: Integrator,
    /// Its tableau, or `order 4`, for tables and charts.
    pub tableau: String,
    /// Its order.
    pub order: u32,
}

impl Entry {
    /// An entry for a method that runs on the scene.
    ///
    /// # Errors
    /// Those of planning the scene with the method.
    pub fn new(scene: &Scenario, method: Method) -> Result<Self, ScenarioError> {
        let formulation = measure::variant(scene, &method, 1.0, 1)?.formulation;
        let tableau = formulation.tableau.unwrap_or_else(|| format!("order {}", formulation.order));
        let (integrator, order) = (formulation.method, formulation.order);
        let of_parts = integrator.is_composition().then_some(order);
        let method = Method { name: integrator.into(), order: of_parts, ..method };
        Ok(Self { method, integrator, tableau, order })
    }

    /// `vpd gauss2`, and the solver where it was asked for.
    pub fn label(&self) -> String {
        let name = self.integrator.as_str();
        match self.method.solver.kind {
            SolverKind::Auto => format!("{name} {}", self.tableau),
            kind => format!("{name} {}, {}", self.tableau, solver_word(kind)),
        }
    }
}

/// A solver's name in a scenario.
pub(crate) fn solver_word(kind: SolverKind) -> &'static str {
    match kind {
        SolverKind::Auto => "auto",
        SolverKind::FixedPoint => "fixed_point",
        SolverKind::Newton => "newton",
    }
}

/// The solvers that have rows of their own in the map of stability.
const SOLVERS: &[SolverKind] = &[SolverKind::FixedPoint, SolverKind::Newton];

pub(crate) fn with_tableau(integrator: Integrator, tableau: TableauName) -> Method {
    variant(integrator, Variant::Tableau(tableau))
}

fn variant(integrator: Integrator, of: Variant) -> Method {
    let (tableau, order) = match of {
        Variant::Tableau(name) => (Some(TableauChoice::Named(name)), None),
        Variant::Order(order) => (None, Some(order)),
    };
    Method { name: integrator.into(), tableau, order, ..Method::default() }
}

/// Those of the methods that run on the scene.
pub(crate) fn entries(
    scene: &Scenario,
    methods: impl Iterator<Item = (Integrator, Variant)>,
) -> Vec<Entry> {
    runnable(scene, methods.map(|(integrator, of)| variant(integrator, of)))
}

fn runnable(scene: &Scenario, methods: impl Iterator<Item = Method>) -> Vec<Entry> {
    let three = scene.dimension() == 3;
    let fits = |method: &Method| {
        three || !method.name.integrator().is_some_and(|named| named.facts().three)
    };
    methods.filter(fits).filter_map(|method| Entry::new(scene, method).ok()).collect()
}

/// The methods of a chart: a few of each family, so that its lines can be told apart.
pub fn usual_methods(scene: &Scenario) -> Vec<Entry> {
    entries(scene, Integrator::charted())
}

/// Every method and tableau worth a row of the stability map, the VPD methods with each solver.
pub fn all_methods(scene: &Scenario) -> Vec<Entry> {
    let rows = |(integrator, variants, each_solver): (Integrator, &'static [Variant], bool)| {
        let kinds = if each_solver { SOLVERS } else { &[SolverKind::Auto] };
        kinds.iter().flat_map(move |&kind| {
            variants.iter().map(move |&of| {
                let mut method = variant(integrator, of);
                method.solver.kind = kind;
                method
            })
        })
    };
    runnable(scene, Integrator::mapped().flat_map(rows))
}

/// A time and a length over which to study a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scales {
    /// Largest size of the body angular velocity met, rad/s.
    pub fastest_rad_s: f64,
    /// Largest kinetic energy met, J.
    pub kinetic: f64,
    /// A step in seconds at which a method of eighth order works.
    pub easy_step_s: f64,
}

impl Scales {
    /// Measures them on a run of at most `time_s` seconds.
    ///
    /// # Errors
    /// If the scene cannot be planned, or no step works.
    pub fn of(scene: &Scenario, time_s: f64, watch: &Watch) -> Result<Self, StudyError> {
        /// A run longer than this shows no more.
        const MOST_STEPS: f64 = 5000.0;
        /// Angle of a step that a method of eighth order takes easily, rad.
        const EASY_TURN_RAD: f64 = 0.25;
        let method = with_tableau(Integrator::Vpd, TableauName::Gauss4);
        let rate = measure::initial_rate(scene)?.max(1.0 / time_s);
        let mut step_s = (EASY_TURN_RAD / rate).min(time_s);
        for _ in 0..40 {
            let steps = (time_s / step_s).ceil().clamp(1.0, MOST_STEPS) as u64;
            let probe = Probe { every: 1, ..Probe::of(&method, step_s, steps) };
            let run = measure::measure(scene, probe, watch)?;
            watch.advance(0)?;
            let gentle = run.fastest_rad_s * step_s <= 2.0 * EASY_TURN_RAD;
            let energy = run.largest_kinetic;
            if run.completed() && gentle && run.energy_error() <= 1e-6 * energy {
                return Ok(Self {
                    fastest_rad_s: run.fastest_rad_s.max(1.0 / time_s),
                    kinetic: energy,
                    easy_step_s: step_s,
                });
            }
            step_s *= 0.5;
        }
        Err(ReferenceError::NoStep { time_s }.into())
    }
}

/// The time a scene is studied for unless the caller says otherwise: about one turn, as far as it runs.
fn usual_time(scene: &Scenario) -> Result<f64, ScenarioError> {
    let plan = Plan::new(scene)?;
    let duration_s = plan.steps as f64 * plan.step_s;
    let rate = measure::initial_rate(scene)?;
    Ok(duration_s.min(if rate > 0.0 { std::f64::consts::TAU / rate } else { duration_s }))
}
