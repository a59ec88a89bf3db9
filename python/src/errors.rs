//! Errors of the library as the exceptions of `package/vpdsim/_errors.py`.

use pyo3::exceptions::PyKeyboardInterrupt;
use pyo3::prelude::*;
use serde::Serialize;
use vpd::client::ClientError;
use vpd::run::{Diagnosis, RunError};
use vpd::scenario::ScenarioError;
use vpd::sweep::SweepError;

/// A text that becomes a `vpdsim.Error`.
pub(crate) struct Failed(pub(crate) String);

impl From<SweepError> for Failed {
    fn from(error: SweepError) -> Self {
        Self(error.to_string())
    }
}

fn raised<'py>(py: Python<'py>, class: &str, arguments: impl pyo3::call::PyCallArgs<'py>) -> PyErr {
    let made =
        py.import("vpdsim._errors").and_then(|module| module.getattr(class)?.call1(arguments));
    made.map_or_else(|error| error, PyErr::from_value)
}

/// Returns a `ScenarioError`, of the scenario of this text.
pub(crate) fn no_scenario(py: Python<'_>, error: &ScenarioError, text: &[u8]) -> PyErr {
    let given = serde_json::from_slice::<serde_json::Value>(text).ok();
    let given = given.as_ref().and_then(|tree| tree.pointer(&error.pointer));
    let given = given.filter(|_| !error.pointer.is_empty()).map(ToString::to_string);
    raised(py, "ScenarioError", (&error.pointer, &error.message, given))
}

/// Returns the error of a run without a result.
pub(crate) fn failed(py: Python<'_>, error: &RunError) -> PyErr {
    match error {
        RunError::Interrupted => PyKeyboardInterrupt::new_err(error.to_string()),
        error => other(py, &error.to_string()),
    }
}

/// Returns a `RunFailed`, with the run so far.
pub(crate) fn run_failed(py: Python<'_>, diagnosis: &Diagnosis, run: Bound<'_, PyAny>) -> PyErr {
    match json(py, diagnosis) {
        Ok(text) => raised(py, "RunFailed", (text, run, diagnosis.to_string())),
        Err(error) => error,
    }
}

/// Returns the error of a service.
pub(crate) fn refused(py: Python<'_>, error: &ClientError) -> PyErr {
    match error {
        ClientError::Stopped => PyKeyboardInterrupt::new_err(error.to_string()),
        ClientError::Problem { status, problem, .. } => {
            raised(py, "ServiceError", (error.to_string(), *status, problem.to_string()))
        }
        error => raised(py, "ServiceError", (error.to_string(),)),
    }
}

/// Returns an `Error`.
pub(crate) fn other(py: Python<'_>, text: &str) -> PyErr {
    raised(py, "Error", (text,))
}

/// Returns a result as JSON.
pub(crate) fn json(py: Python<'_>, value: &impl Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(|error| other(py, &error.to_string()))
}
