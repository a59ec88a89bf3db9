//! The native half of the Python package `vpdsim`: each function is one call of the library, with the interpreter's lock released
//! and signals looked after. What users see, with its documentation, is in `package/vpdsim/`.
//!
//! Results go over as JSON and as arrays; errors as the exceptions of `package/vpdsim/_errors.py`, which this crate fills.

use pyo3::prelude::*;

mod arrays;
mod errors;
mod potential;
mod service;
mod simulation;
mod watched;

/// What `vpdsim` is made of.
#[pymodule]
mod _native {
    use std::ffi::OsString;
    use std::fs;
    use std::num::NonZeroUsize;
    use std::path::PathBuf;
    use std::sync::Arc;
    use std::sync::atomic::Ordering;

    use pyo3::prelude::*;
    use pyo3::types::PyDict;
    use vpd::advise::Settled;
    use vpd::chart::draw_course;
    use vpd::diff::{Tolerance, diff as compared};
    use vpd::fit::{FitError, Question, fit as fitted, read as seen};
    use vpd::log::LogError;
    use vpd::log::columns::Columns;
    use vpd::log::course::{Course, LogChart};
    use vpd::log::inspect::inspect;
    use vpd::plan::Plan;
    use vpd::run::{
        Control, JobContext, Outcome, PotentialError, RunError, Summary, collect, collect_with,
        execute, execute_with,
    };
    use vpd::scenario::{self, Scenario, ScenarioError};
    use vpd::study::Watch;
    use vpd::sweep::{
        Made, Options, Sweep, SweepError, run as run_sweep, schema as schema_of_sweeps,
    };
    use vpd::verify::{Repetition, VerifyError};

    use crate::arrays::arrays;
    use crate::errors::{Failed, failed, json, no_scenario, other, run_failed};
    use crate::potential::Law;
    use crate::watched::{Follow, watched};

    #[pymodule_export]
    use crate::service::{Client, Events};
    #[pymodule_export]
    use crate::simulation::Simulation;

    #[pymodule_export]
    #[allow(non_upper_case_globals, reason = "the name that Python expects")]
    const __version__: &str = env!("CARGO_PKG_VERSION");

    /// Returns the text of a scenario with changes: a JSON object of values by pointer.
    #[pyfunction]
    fn with_changes(py: Python<'_>, text: &[u8], changes: &[u8]) -> PyResult<Vec<u8>> {
        let changes = serde_json::from_slice::<serde_json::Map<String, serde_json::Value>>(changes);
        let changes = changes.map_err(|error| other(py, &error.to_string()))?;
        scenario::with_changes(text, changes).map_err(|error| no_scenario(py, &error, text))
    }

    /// Reads and checks a scenario, without a run.
    #[pyfunction]
    fn check(py: Python<'_>, text: &[u8]) -> PyResult<()> {
        let checked = py.detach(|| {
            let scenario = Scenario::from_json(text)?;
            // For an accuracy a plan would take runs.
            if scenario.accuracy.is_none() {
                Plan::new(&scenario)?;
            }
            Ok(())
        });
        checked.map_err(|error: ScenarioError| no_scenario(py, &error, text))
    }

    /// Plans a scenario; for an accuracy this makes runs.
    #[pyfunction]
    fn plan(py: Python<'_>, text: &[u8]) -> PyResult<String> {
        let control = Control::default();
        json(py, &settled(py, text, &control)?)
    }

    fn settled(py: Python<'_>, text: &[u8], control: &Control) -> PyResult<Plan> {
        let planned = watched(
            py,
            || control.cancel(),
            Follow::default(),
            || {
                let scenario = Scenario::from_json(text)?;
                Settled::new(&scenario, &control.settling).map_err(ScenarioError::from)?.plan()
            },
        )?;
        planned.map_err(|error| no_scenario(py, &error, text))
    }

    /// Runs a scenario: its summary, plan and scenario as JSON, and the arrays of its samples; of an ensemble, which has a log,
    /// those of member 0.
    #[pyfunction]
    fn run<'py>(
        py: Python<'py>,
        text: &[u8],
        log: Option<PathBuf>,
        force: bool,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(String, String, String, Bound<'py, PyDict>)> {
        let control = Control { replaces_nothing: !force, ..Control::default() };
        let plan = settled(py, text, &control)?;
        let total = plan.total_steps();
        let done = || (control.steps_done.load(Ordering::Relaxed), total);
        let follow = Follow { progress: progress.as_ref(), done: Some(&done) };
        let ran = watched(
            py,
            || control.interrupt(),
            follow,
            || match &log {
                None => collect(&plan, &control),
                Some(log) => {
                    let summary = execute(&plan, &JobContext { log, control: &control })?;
                    let (columns, _) = Columns::read(log, 0, &[])?;
                    Ok((summary, columns))
                }
            },
        )?;
        let (summary, columns) = ran.map_err(|error: RunError| failed(py, &error))?;
        let scenario = String::from_utf8_lossy(&plan.asked.to_json()).into_owned();
        Ok((json(py, &summary)?, json(py, &plan)?, scenario, arrays(py, columns)?))
    }

    /// Runs a scenario with a potential of Python in addition: as [`run`].
    #[pyfunction]
    fn run_with_potential<'py>(
        py: Python<'py>,
        text: &[u8],
        potential: &Bound<'py, PyAny>,
        log: Option<PathBuf>,
        force: bool,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(String, String, String, Bound<'py, PyDict>)> {
        let control = Arc::new(Control { replaces_nothing: !force, ..Control::default() });
        let plan = settled(py, text, &control)?;
        let law = Arc::new(Law::new(potential, plan.dimension, control.clone())?);
        let done = || (control.steps_done.load(Ordering::Relaxed), plan.total_steps());
        let follow = Follow { progress: progress.as_ref(), done: Some(&done) };
        let ran = watched(
            py,
            || control.interrupt(),
            follow,
            || match &log {
                None => collect_with(&plan.asked, law.clone(), &control),
                Some(log) => {
                    let context = JobContext { log, control: &control };
                    let summary = execute_with(&plan.asked, law.clone(), &context)?;
                    let (columns, _) = Columns::read(log, 0, &[]).map_err(RunError::from)?;
                    Ok((summary, columns))
                }
            },
        )?;
        if let Some(raised) = law.raised() {
            return Err(raised);
        }
        let (summary, columns) = ran.map_err(|error: PotentialError| match error {
            PotentialError::Scenario(error) => no_scenario(py, &error, text),
            PotentialError::Run(error) => failed(py, &error),
        })?;
        let scenario = String::from_utf8_lossy(&plan.asked.to_json()).into_owned();
        Ok((json(py, &summary)?, json(py, &plan)?, scenario, arrays(py, columns)?))
    }

    /// Reads a log, finished or not: its summary as JSON, the arrays of a member, and what is wrong with its end.
    #[pyfunction]
    fn read(
        py: Python<'_>,
        log: PathBuf,
        member: u64,
    ) -> PyResult<(String, Bound<'_, PyDict>, Option<String>)> {
        let read = watched(
            py,
            || (),
            Follow::default(),
            || {
                let inspection = inspect(&log)?;
                Ok::<_, LogError>((inspection, Columns::read(&log, member, &[])?))
            },
        )?;
        let (inspection, (columns, ending)) =
            read.map_err(|error| failed(py, &RunError::from(error)))?;
        if columns.is_empty() {
            return Err(other(
                py,
                &format!(
                    "there are no samples of member {member}: an ensemble keeps those of member 0 and of its `in_full`"
                ),
            ));
        }
        Ok((json(py, &inspection)?, arrays(py, columns)?, ending.damage))
    }

    /// Runs the job of a log again and compares.
    #[pyfunction]
    fn verify(py: Python<'_>, log: PathBuf) -> PyResult<String> {
        let refused = |error: VerifyError| other(py, &format!("{}: {error}", log.display()));
        let repetition = py.detach(|| Repetition::of(&log)).map_err(refused)?;
        let control = repetition.control();
        let verified = watched(py, || control.interrupt(), Follow::default(), || repetition.run())?;
        json(py, &verified.map_err(refused)?)
    }

    /// Compares two logs; returns the comparison as JSON, and whether they agree.
    #[pyfunction]
    fn diff(
        py: Python<'_>,
        first: PathBuf,
        second: PathBuf,
        member: u64,
        tolerances: Vec<String>,
        rows: usize,
    ) -> PyResult<(String, bool)> {
        let parsed: Result<Vec<Tolerance>, String> = tolerances
            .iter()
            .map(|text| text.parse().map_err(|why| format!("{text}: {why}")))
            .collect();
        let tolerances = parsed.map_err(|why| other(py, &why))?;
        let logs = [first.as_path(), second.as_path()];
        let made = watched(py, || (), Follow::default(), || compared(logs, member, &tolerances))?;
        let mut found = made.map_err(|error| other(py, &error.to_string()))?;
        let agree = found.agrees();
        found.over_time = found.rows(rows);
        Ok((json(py, &found)?, agree))
    }

    /// Fits fields of a scenario to the attitudes in a log or a table; returns what was found and the fitted scenario as JSON.
    #[pyfunction]
    fn fit(
        py: Python<'_>,
        text: &[u8],
        to: PathBuf,
        fields: Vec<String>,
        start_attitude: bool,
    ) -> PyResult<(String, String)> {
        let scenario = settled(py, text, &Control::default())?.asked;
        let made = watched(
            py,
            || (),
            Follow::default(),
            || {
                let seen = seen(&to)?;
                fitted(Question {
                    scenario: &scenario,
                    fields: &fields,
                    start_attitude,
                    seen: &seen,
                })
            },
        )?;
        let found = made.map_err(|error: FitError| match error {
            FitError::Scenario(mut error) => {
                // An argument, which the command line names as its own.
                error.pointer = error.pointer.trim_start_matches("--").to_owned();
                no_scenario(py, &error, text)
            }
            error => other(py, &error.to_string()),
        })?;
        Ok((json(py, &found)?, json(py, &found.scenario)?))
    }

    /// Runs a sweep into a table; returns its counts as JSON.
    #[pyfunction]
    fn sweep(
        py: Python<'_>,
        file: Option<PathBuf>,
        text: &[u8],
        table: PathBuf,
        threads: Option<usize>,
        force: bool,
        progress: Option<Bound<'_, PyAny>>,
    ) -> PyResult<String> {
        let read = || match &file {
            Some(file) => Sweep::read(file),
            None => Ok(Sweep::from_json(text)?),
        };
        let refused = |error: SweepError| match error {
            SweepError::Field(error) => no_scenario(py, &error, text),
            error => other(py, &error.to_string()),
        };
        let sweep = py.detach(read).map_err(refused)?;
        let (watch, control) = (Watch::default(), Control::default());
        let threads =
            threads.or_else(|| std::thread::available_parallelism().ok().map(NonZeroUsize::get));
        let options = Options { threads: threads.unwrap_or(1), shard: None, replaces: force };
        let stop = || {
            watch.cancelled.store(true, Ordering::Relaxed);
            control.interrupt();
        };
        let done = || (watch.done.load(Ordering::Relaxed), sweep.members());
        let follow = Follow { progress: progress.as_ref(), done: Some(&done) };
        let made = watched(py, stop, follow, || {
            run_sweep(&sweep, &table, options, &watch, |members| {
                let kept = sweep.kept_logs().iter().filter(|member| members.contains(member));
                kept.copied().try_for_each(|member| {
                    let Ok(plan) = sweep.plan(member) else { return Ok(()) };
                    let folder = table.with_extension("logs");
                    fs::create_dir_all(&folder).map_err(|error| Failed(error.to_string()))?;
                    let context = JobContext {
                        log: &folder.join(format!("{member}.mcap")),
                        control: &control,
                    };
                    execute(&plan, &context).map(drop).map_err(|error| Failed(error.to_string()))
                })
            })
        })?;
        let Made { counts, resumed, first_refused, .. } =
            made.map_err(|error| other(py, &error.0))?;
        let refusal = first_refused.map(|(member, why)| format!("member {member}: {why}"));
        json(
            py,
            &serde_json::json!({
                "succeeded": counts.succeeded, "failed": counts.failed, "refused": counts.refused,
                "resumed": resumed, "first_refused": refusal,
            }),
        )
    }

    /// Draws an error over time: SVG.
    #[pyfunction]
    fn chart(
        py: Python<'_>,
        which: &str,
        log_time_ns: Vec<u64>,
        values: Vec<f64>,
    ) -> PyResult<String> {
        let which = LogChart::ALL.into_iter().find(|chart| chart.file() == format!("{which}.svg"));
        let which = which.ok_or_else(|| other(py, "there is no such chart"))?;
        let drawn = py.detach(|| {
            let mut course = Course::default();
            let finite = log_time_ns.into_iter().zip(values).filter(|(_, value)| value.is_finite());
            finite.for_each(|(time_ns, value)| course.note(time_ns, which, value));
            draw_course(&course, which)
        });
        drawn.map_err(|error| other(py, &error.to_string()))
    }

    /// Returns the JSON Schema of a scenario or of a sweep.
    #[pyfunction]
    fn schema(py: Python<'_>, of: &str) -> PyResult<String> {
        json(py, &if of == "sweep" { schema_of_sweeps() } else { scenario::schema() })
    }

    /// Runs the command line; returns its exit code.
    #[pyfunction]
    fn command(py: Python<'_>, program: PathBuf, arguments: Vec<OsString>) -> u8 {
        py.detach(|| vpd::cli::run_as(program, arguments))
    }

    /// Raises the exception of a run that failed, if this one did.
    #[pyfunction]
    fn raise_if_failed(py: Python<'_>, summary: &str, run: Bound<'_, PyAny>) -> PyResult<()> {
        let summary: Summary =
            serde_json::from_str(summary).map_err(|error| other(py, &error.to_string()))?;
        match summary.diagnosis {
            Some(diagnosis) if summary.outcome == Outcome::Failed => {
                Err(run_failed(py, &diagnosis, run))
            }
            _ => Ok(()),
        }
    }
}
