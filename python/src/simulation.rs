//! A run that Python steps.

use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use pyo3::exceptions::{PyRuntimeError, PyTypeError, PyValueError};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyList, PyTuple};
use vpd::advise;
use vpd::run::{self, Advanced, Control, JobContext, Outcome};
use vpd::scenario::{Scenario, ScenarioError};

use crate::arrays::{array, vector};
use crate::errors::{failed, no_scenario, other, run_failed};
use crate::watched::{Follow, watched};

/// Steps that are made without giving the interpreter to others: it costs more than they.
const FEW_STEPS: u64 = 16;
/// Signals are looked for this often in many steps.
const LOOK: Duration = Duration::from_millis(50);
/// The clock is read once in so many steps.
const STEPS_PER_LOOK: u64 = 64;
/// Duration of a call as a part of a step by which it may differ from a whole number of steps.
const WHOLE: f64 = 1e-9;

/// The native half of `vpdsim.Simulation`.
#[pyclass(subclass, module = "vpdsim._native")]
pub(crate) struct Simulation {
    /// Behind a lock because steppers are not shared; it is never waited for.
    inner: Mutex<run::Simulation>,
    text: Vec<u8>,
    log: Option<PathBuf>,
    force: bool,
    controller: Option<Py<PyAny>>,
    closed: bool,
}

#[pymethods]
impl Simulation {
    #[new]
    fn new(
        py: Python<'_>,
        text: Vec<u8>,
        log: Option<PathBuf>,
        force: bool,
        controller: Option<Py<PyAny>>,
    ) -> PyResult<Self> {
        if let Some(log) = log.as_ref().filter(|log| !force && log.symlink_metadata().is_ok()) {
            return Err(other(
                py,
                &format!("{} already exists; force=True replaces it", log.display()),
            ));
        }
        let begun = py.detach(|| run::Simulation::new(&Scenario::from_json(&text)?));
        let inner = begun.map_err(|error| no_scenario(py, &error, &text))?;
        Ok(Self { inner: Mutex::new(inner), text, log, force, controller, closed: false })
    }

    #[getter]
    fn time(&self) -> f64 {
        self.inner().time_s()
    }

    #[getter]
    fn step_s(&self) -> f64 {
        self.inner().step_s()
    }

    #[getter]
    fn steps(&self) -> u64 {
        self.inner().steps()
    }

    #[getter]
    fn attitude<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let n = self.inner().dimension();
        array(py, &[n, n], &self.inner().attitude())
    }

    #[getter]
    fn angular_velocity<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        vector(py, &self.inner().angular_velocity())
    }

    #[getter]
    fn body_momentum<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        vector(py, &self.inner().body_momentum())
    }

    #[getter]
    fn torque<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        vector(py, self.inner().torque())
    }

    #[setter]
    fn set_torque(&mut self, py: Python<'_>, torque: &Bound<'_, PyAny>) -> PyResult<()> {
        self.open()?;
        let full = self.log.is_some() && self.inner().changes() >= run::Simulation::MOST_CHANGES;
        if full {
            let most = run::Simulation::MOST_CHANGES;
            return Err(other(
                py,
                &format!("the torque has changed {most} times, as often as a log can hold"),
            ));
        }
        let is_list = torque.is_instance_of::<PyList>() || torque.is_instance_of::<PyTuple>();
        // Of an array the numbers are read as a list: one by one they would be objects of NumPy.
        let listed = (!is_list).then(|| torque.getattr(intern!(py, "tolist")).ok()).flatten();
        let numbers = match listed {
            Some(listed) => listed.call0()?.extract(),
            None => torque.extract(),
        };
        let numbers: Vec<f64> = numbers.map_err(|_| {
            PyTypeError::new_err(format!(
                "a torque is a list or an array of {} numbers in N m, one for each plane of the body",
                self.inner().torque().len()
            ))
        })?;
        let has_log = self.log.is_some();
        let inner = self.inner_mut();
        let set = inner.set_torque(&numbers);
        set.map_err(|error| PyValueError::new_err(error.to_string()))?;
        // More than a job can hold need not be kept.
        if !has_log && inner.changes() > run::Simulation::MOST_CHANGES {
            inner.forget();
        }
        Ok(())
    }

    #[getter]
    fn wheel_torque(&self, py: Python<'_>) -> PyResult<()> {
        Err(no_wheels(py))
    }

    #[setter]
    fn set_wheel_torque(&mut self, py: Python<'_>, _torque: &Bound<'_, PyAny>) -> PyResult<()> {
        Err(no_wheels(py))
    }

    /// Makes as many steps as `seconds` are; or `steps`.
    #[pyo3(signature = (seconds=None, *, steps=None))]
    fn advance(
        mut slf: PyRefMut<'_, Self>,
        py: Python<'_>,
        seconds: Option<f64>,
        steps: Option<u64>,
    ) -> PyResult<()> {
        slf.open()?;
        let step_s = slf.inner().step_s();
        let steps = match (seconds, steps) {
            (Some(seconds), None) => {
                let count = seconds / step_s;
                let whole = count.round();
                if !(whole >= 0.0 && (count - whole).abs() <= WHOLE * whole.max(1.0)) {
                    return Err(PyValueError::new_err(format!(
                        "{seconds} s is not a whole number of steps of {step_s} s"
                    )));
                }
                whole as u64
            }
            (None, Some(steps)) => steps,
            (None, None) => 1,
            (Some(_), Some(_)) => {
                return Err(PyValueError::new_err("give seconds or steps, not both"));
            }
        };
        if slf.controller.is_none() {
            return slf.make(py, steps);
        }
        // A controller looks at the simulation between two steps, so it must not be borrowed then.
        let this: Py<Self> = slf.into_pyobject(py)?.unbind();
        for _ in 0..steps {
            let (controller, time, attitude, velocity) = {
                let this = this.borrow(py);
                let controller =
                    this.controller.as_ref().map(|controller| controller.clone_ref(py));
                (controller, this.time(), this.attitude(py)?, this.angular_velocity(py)?)
            };
            if let Some(controller) = controller {
                let torque = controller.call1(py, (time, attitude, velocity))?;
                this.borrow_mut(py).set_torque(py, torque.bind(py))?;
            }
            this.borrow_mut(py).make(py, 1)?;
        }
        Ok(())
    }

    /// Returns the job that makes the same run, as JSON.
    fn job(&self, py: Python<'_>) -> PyResult<String> {
        let job = self.inner().job().map_err(|error| no_scenario(py, &error, &self.text))?;
        Ok(String::from_utf8_lossy(&job.to_json()).into_owned())
    }

    /// Writes the log, if there is to be one, and makes no further step.
    fn close(&mut self, py: Python<'_>) -> PyResult<()> {
        if self.closed {
            return Ok(());
        }
        // A job has one step at least.
        let Some(log) = self.log.as_ref().filter(|_| self.begun()) else {
            self.closed = true;
            return Ok(());
        };
        let job = self.inner().job().map_err(|error| no_scenario(py, &error, &self.text))?;
        let control = Control { replaces_nothing: !self.force, ..Control::default() };
        let written = watched(
            py,
            || control.interrupt(),
            Follow::default(),
            || {
                let plan = advise::plan(&job)?;
                Ok::<_, ScenarioError>(run::execute(&plan, &JobContext { log, control: &control }))
            },
        )?;
        let written = written.map_err(|error| no_scenario(py, &error, &self.text))?;
        written.map_err(|error| failed(py, &error))?;
        self.closed = true;
        Ok(())
    }
}

impl Simulation {
    /// Was a step made, or tried?
    fn begun(&self) -> bool {
        self.inner().steps() > 0 || self.inner().outcome() == Outcome::Failed
    }

    fn open(&self) -> PyResult<()> {
        if self.closed { Err(PyRuntimeError::new_err("the simulation is closed")) } else { Ok(()) }
    }

    fn inner(&self) -> MutexGuard<'_, run::Simulation> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn inner_mut(&mut self) -> &mut run::Simulation {
        self.inner.get_mut().unwrap_or_else(PoisonError::into_inner)
    }

    fn make(&mut self, py: Python<'_>, steps: u64) -> PyResult<()> {
        let inner = self.inner_mut();
        let end = inner.steps() + steps;
        loop {
            let left = end - inner.steps();
            let advanced = if left <= FEW_STEPS {
                inner.advance(left, |_| true)
            } else {
                let inner = &mut *inner;
                py.detach(|| {
                    let begun = Instant::now();
                    let goes_on =
                        |step: u64| !step.is_multiple_of(STEPS_PER_LOOK) || begun.elapsed() < LOOK;
                    inner.advance(left, goes_on)
                })
            };
            match advanced {
                Advanced::Whole => return Ok(()),
                Advanced::Stopped => py.check_signals()?,
                Advanced::Failed(diagnosis) => {
                    return Err(run_failed(py, &diagnosis, py.None().into_bound(py)));
                }
            }
        }
    }
}

fn no_wheels(py: Python<'_>) -> PyErr {
    other(
        py,
        "this scene has no driven wheels, whose torque could be set; `torque` turns the body from outside",
    )
}
