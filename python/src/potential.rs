//! A potential energy that Python computes.

use std::sync::{Arc, Mutex, PoisonError};

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyBytes;
use vpd::run::{Control, PotentialOfRows};

use crate::arrays::array;

/// Two functions of attitudes. The first exception of either ends the run.
#[derive(Debug)]
pub(crate) struct Law {
    energy: Py<PyAny>,
    gradient: Py<PyAny>,
    dimension: usize,
    control: Arc<Control>,
    raised: Mutex<Option<PyErr>>,
}

impl Law {
    pub(crate) fn new(
        potential: &Bound<'_, PyAny>,
        dimension: usize,
        control: Arc<Control>,
    ) -> PyResult<Self> {
        let energy = potential.getattr("energy")?.unbind();
        let gradient = potential.getattr("gradient")?.unbind();
        Ok(Self { energy, gradient, dimension, control, raised: Mutex::default() })
    }

    /// Returns the exception that was raised.
    pub(crate) fn raised(&self) -> Option<PyErr> {
        self.raised.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Calls a function with the attitudes as an array (k, n, n); returns its numbers, k times `each` of them.
    fn called(&self, function: &Py<PyAny>, g: &[f64], each: &[usize]) -> Option<Vec<f64>> {
        Python::attach(|py| {
            let n = self.dimension;
            let attitudes = g.len() / (n * n);
            let shape = [&[attitudes], each].concat();
            let found = array(py, &[attitudes, n, n], g)
                .and_then(|g| function.bind(py).call1((g,)))
                .and_then(|found| numbers(&found, &shape));
            match found {
                Ok(numbers) => Some(numbers),
                Err(error) => {
                    let mut raised = self.raised.lock().unwrap_or_else(PoisonError::into_inner);
                    raised.get_or_insert(error);
                    self.control.cancel();
                    None
                }
            }
        })
    }
}

/// Returns the numbers of an array of a given shape, or of what makes one.
fn numbers(found: &Bound<'_, PyAny>, shape: &[usize]) -> PyResult<Vec<f64>> {
    static AS_ARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let as_array = AS_ARRAY.import(found.py(), "numpy", "asarray")?;
    let found = as_array.call1((found, "=f8"))?;
    let given: Vec<usize> = found.getattr("shape")?.extract()?;
    if given != shape {
        let text = format!(
            "energy(g) must return an array of shape (k,), gradient(g) one of (k, n, n), dU/dg_ij, for g of shape (k, n, n): {shape:?} is needed here, {given:?} was returned"
        );
        return Err(PyValueError::new_err(text));
    }
    let bytes = found.call_method0("tobytes")?;
    let (numbers, _) = bytes.cast::<PyBytes>()?.as_bytes().as_chunks();
    Ok(numbers.iter().map(|&number| f64::from_ne_bytes(number)).collect())
}

impl PotentialOfRows for Law {
    fn energy(&self, g: &[f64]) -> f64 {
        let found = self.called(&self.energy, g, &[]);
        found.and_then(|found| found.first().copied()).unwrap_or(f64::NAN)
    }

    fn gradients(&self, g: &[f64]) -> Vec<f64> {
        let n = self.dimension;
        self.called(&self.gradient, g, &[n, n]).unwrap_or_default()
    }
}
