//! 4 · Studies: many runs of one scene, one table.
//!
//! Each answers a question on method and step: [`precision`] measures error and work against the
//! step, [`long_term`] the energy and the distance from the group over a long run, [`stability`]
//! where each method fails. All measure with [`measure`] and against a [`reference::Reference`]
//! that the program computes itself. [`own`] is work and precision on a system that no scenario
//! describes.
//!
//! Invariant: a study repeats to the bit but for its times, on any number of cores; no time is
//! measured while another run is made; it ends early only if it is cancelled.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use thiserror::Error;

use crate::in_order::{Turns, cores, in_order};
use crate::method::{Integrator, Variant};
use crate::plan::{NEAR_SIGMA, Plan};
use crate::scenario::{
    Method, MethodName, Scenario, ScenarioError, SolverKind, TableauChoice, TableauName,
};

pub mod long_term;
pub mod lyapunov;
pub mod measure;
pub mod own;
pub mod precision;
pub mod reference;
pub(crate) mod spread;
pub mod stability;
pub mod table;

use measure::{Probe, Rates};
use reference::ReferenceError;

/// Reason why a study has no result.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum StudyError {
    /// The scene cannot be planned with a method.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// There is no reference to measure against.
    #[error(transparent)]
    Reference(#[from] ReferenceError),
    /// The run whose error was asked for fails.
    #[error("the run fails, so there is no error at its end")]
    Failed,
    /// It was cancelled.
    #[error("the study was cancelled")]
    Cancelled,
    /// It used up the allowed work.
    #[error("the allowed computing time is used up")]
    TooExpensive,
}

/// State that a study shares with other threads.
#[derive(Debug, Default)]
pub struct Watch {
    /// Runs made so far.
    pub done: AtomicU64,
    /// Runs to be made, as far as that is known.
    pub total: AtomicU64,
    /// Stops the study within a sweep of its current step when set.
    pub cancelled: Arc<AtomicBool>,
    /// Work that may still be done, in nanoseconds by the plan's figures: counted, not timed.
    /// Unlimited if absent.
    pub allowance_ns: Option<AtomicU64>,
    /// Threads for runs that are not timed; all cores if absent.
    pub threads: Option<NonZeroUsize>,
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

    /// Subtracts the cost of a run from the work that may still be done.
    fn pay(&self, cost_ns: u64) {
        if let Some(left) = &self.allowance_ns {
            left.store(self.left_ns().saturating_sub(cost_ns), Ordering::Relaxed);
        }
    }
}

/// Returns the result for each of the methods, in their order, on several threads. Not for timings.
fn of_each<T: Send>(
    entries: &[Entry],
    watch: &Watch,
    one: impl Fn(&Entry) -> Result<T, StudyError> + Sync,
) -> Result<Vec<T>, StudyError> {
    let mut made = Vec::with_capacity(entries.len());
    let work = |turns: &Turns<'_, Result<T, StudyError>>| {
        while let Some(places) = turns.take() {
            let entry = &entries[places.start as usize];
            turns.give(places, one(entry))?;
        }
        Some(())
    };
    in_order(0..entries.len() as u64, 1, threads(watch), work, |found| {
        found.map(|found| made.push(found))
    })?;
    Ok(made)
}

/// Returns the results for the methods up to one at which the study was cancelled.
fn of_those_before<T: Send>(
    entries: &[Entry],
    watch: &Watch,
    one: impl Fn(&Entry) -> Result<T, StudyError> + Sync,
) -> Result<Vec<T>, StudyError> {
    let one = |entry: &Entry| match one(entry) {
        Err(StudyError::Cancelled) => Ok(None),
        found => found.map(Some),
    };
    Ok(of_each(entries, watch, one)?.into_iter().map_while(|found| found).collect())
}

/// Returns the number of threads for runs that are not timed: the cost of one may end others, and
/// then their order counts.
fn threads(watch: &Watch) -> usize {
    if watch.allowance_ns.is_some() {
        1
    } else {
        watch.threads.map_or_else(cores, NonZeroUsize::get)
    }
}

/// Checks that a scene is valid, whatever method and step it will run with.
///
/// # Errors
/// The errors of planning it.
#[cfg(feature = "serve")]
pub(crate) fn scene_of(scene: &Scenario) -> Result<(), ScenarioError> {
    measure::of_method(scene, &Method::default()).map(drop)
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
    /// Creates an entry for a method that runs on the scene.
    ///
    /// # Errors
    /// The errors of planning the scene with the method.
    pub fn new(scene: &Scenario, method: Method) -> Result<Self, ScenarioError> {
        let formulation = measure::of_method(scene, &method)?.formulation;
        let tableau = match (&method.tableau, formulation.tableau) {
            (Some(TableauChoice::Custom(_)), _) => "given".to_owned(),
            (_, Some(name)) => name,
            (_, None) => format!("order {}", formulation.order),
        };
        let (integrator, order) = (formulation.method, formulation.order);
        let of_parts = integrator.is_composition().then_some(order);
        let method = Method { name: integrator.into(), order: of_parts, ..method };
        Ok(Self { method, integrator, tableau, order })
    }

    /// Returns `vpd gauss2`, and the solver where it was asked for.
    pub fn label(&self) -> String {
        let name = self.integrator.as_str();
        match self.method.solver.kind {
            SolverKind::Auto => format!("{name} {}", self.tableau),
            kind => format!("{name} {}, {}", self.tableau, solver_word(kind)),
        }
    }
}

/// Numbers the entries whose tableaux have coefficients of their own, where there are several.
#[cfg(feature = "chart")]
pub(crate) fn tell_apart(entries: &mut [Entry]) {
    let given = entries.iter_mut().filter(|entry| entry.tableau == "given");
    let given: Vec<_> = given.collect();
    if given.len() > 1 {
        for (k, entry) in given.into_iter().enumerate() {
            entry.tableau = format!("given {}", k + 1);
        }
    }
}

/// Returns a solver's name in a scenario.
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

/// Returns those of the methods that run on the scene.
pub(crate) fn entries(
    scene: &Scenario,
    methods: impl Iterator<Item = (Integrator, Variant)>,
) -> Vec<Entry> {
    runnable(scene, methods.map(|(integrator, of)| variant(integrator, of)))
}

fn runnable(scene: &Scenario, methods: impl Iterator<Item = Method>) -> Vec<Entry> {
    let three = scene.dimension() == 3;
    let fits = |method: &Method| {
        let needs_three = method.name.integrator().is_some_and(|named| named.facts().three);
        // Steps that adapt are for a scene whose bodies come close, which nothing here looks for.
        let taken = scene.bodies().is_none_or(|bodies| {
            method.name != MethodName::VpdAdaptive && bodies.take(method).is_ok()
        });
        (three || !needs_three) && taken
    };
    methods.filter(fits).filter_map(|method| Entry::new(scene, method).ok()).collect()
}

/// Returns the method of the scene itself if its tableau is given by coefficients: it takes part next to the named ones.
fn given(scene: &Scenario) -> Option<Entry> {
    let own = matches!(scene.method.tableau, Some(TableauChoice::Custom(_)));
    own.then(|| Entry::new(scene, scene.method.clone()).ok()).flatten()
}

/// Returns the methods of a chart: a few of each family, so that its lines can be distinguished, and a tableau given by
/// coefficients.
pub fn usual_methods(scene: &Scenario) -> Vec<Entry> {
    given(scene).into_iter().chain(entries(scene, Integrator::charted())).collect()
}

/// Returns every method and tableau worth a row of the stability map, the VPD methods with each
/// solver, and a tableau given by coefficients.
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
    given(scene).into_iter().chain(runnable(scene, Integrator::mapped().flat_map(rows))).collect()
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
    /// Whether it is an adaptive step, because a point source is passed closely.
    pub adapts: bool,
}

impl Scales {
    /// Measures them on a run of at most `time_s` seconds.
    ///
    /// # Errors
    /// If the scene cannot be planned, or no step works.
    pub fn of(scene: &Scenario, time_s: f64, watch: &Watch) -> Result<Self, StudyError> {
        let is_near = nearest_sigma(scene, time_s)?.is_some_and(|sigma| sigma <= NEAR_SIGMA);
        let integrator = if is_near { Integrator::VpdAdaptive } else { Integrator::Vpd };
        let method = with_tableau(integrator, TableauName::Gauss4);
        Ok(Self { adapts: is_near, ..Self::measured(scene, &method, time_s, watch)? })
    }

    fn measured(
        scene: &Scenario,
        method: &Method,
        time_s: f64,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        /// A run longer than this shows no more.
        const MOST_STEPS: f64 = 5000.0;
        /// Angle of a step that a method of eighth order takes easily, rad.
        const EASY_TURN_RAD: f64 = 0.25;
        /// Step times rate of damping that it takes easily: a Gauss method damps nothing in steps far above one.
        const EASY_DAMPING: f64 = 1.0;
        let Rates { turn_rad_s, damping_per_s } = measure::initial_rates(scene)?;
        let rate = turn_rad_s.max(1.0 / time_s).max(EASY_TURN_RAD / EASY_DAMPING * damping_per_s);
        let mut step_s = (EASY_TURN_RAD / rate).min(time_s);
        for _ in 0..40 {
            let steps = (time_s / step_s).ceil().clamp(1.0, MOST_STEPS) as u64;
            let probe = Probe { every: 1, ..Probe::of(method, step_s, steps) };
            let run = measure::measure(scene, probe, watch)?;
            watch.advance(0)?;
            // Adaptive steps are shorter where the body is fast.
            let gentle =
                run.least_sigma.is_some() || run.fastest_rad_s * step_s <= 2.0 * EASY_TURN_RAD;
            if run.completed() && gentle && run.energy_error() <= 1e-6 * run.energies.moved() {
                return Ok(Self {
                    fastest_rad_s: run.fastest_rad_s.max(1.0 / time_s),
                    kinetic: run.energies.kinetic(),
                    easy_step_s: step_s,
                    adapts: false,
                });
            }
            step_s *= 0.5;
        }
        Err(ReferenceError::NoStep { time_s }.into())
    }
}

/// Returns the least sigma that adaptive steps meet within `time_s`, as far as a few milliseconds
/// of them come, as counted: how near a body point comes to a point source. `None` where there is
/// nothing to adapt to.
pub(crate) fn nearest_sigma(scene: &Scenario, time_s: f64) -> Result<Option<f64>, ScenarioError> {
    const MOST_NS: u64 = 10_000_000;
    const MOST_STEPS: f64 = 1e6;
    // One step of the whole time: that many samples of a control are refused.
    if scene.scene.control.is_some() {
        return Ok(None);
    }
    let plan = measure::variant(scene, &Method::default(), time_s, 1)?;
    if !plan.can_adapt() {
        return Ok(None);
    }
    let method = with_tableau(Integrator::VpdAdaptive, TableauName::Gauss2);
    let steps = (time_s / plan.easy_own_step_s(2)).ceil().clamp(1.0, MOST_STEPS) as u64;
    let watch = Watch { allowance_ns: Some(MOST_NS.into()), ..Watch::default() };
    let probe = Probe { every: 1, ..Probe::of(&method, time_s / steps as f64, steps) };
    Ok(measure::measure(scene, probe, &watch)?.least_sigma)
}

/// Returns the default time for which a scene is studied: about one turn, as far as it runs.
fn usual_time(scene: &Scenario) -> Result<f64, ScenarioError> {
    let plan = Plan::new(scene)?;
    let duration_s = plan.steps as f64 * plan.step_s;
    let rate = measure::initial_rates(scene)?.turn_rad_s;
    Ok(duration_s.min(if rate > 0.0 { std::f64::consts::TAU / rate } else { duration_s }))
}
