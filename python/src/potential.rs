//! A potential energy that Python computes.

use std::sync::{Arc, Mutex, PoisonError};

use pyo3::prelude::*;
use vpd::run::{Control, PotentialOfRows};

use crate::arrays::array;

/// Two functions of an attitude. The first exception of either ends the run.
#[derive(Debug)]
pub(crate) struct Law {
    energy: Py<PyAny>,
    slope: Py<PyAny>,
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
        let slope = potential.getattr("slope")?.unbind();
        Ok(Self { energy, slope, dimension, control, raised: Mutex::default() })
    }

    /// Returns the exception that was raised.
    pub(crate) fn raised(&self) -> Option<PyErr> {
        self.raised.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn called<T>(&self, g: &[f64], of: impl FnOnce(Bound<'_, PyAny>) -> PyResult<T>) -> Option<T> {
        Python::attach(|py| {
            let n = self.dimension;
            match array(py, &[n, n], g).and_then(of) {
                Ok(value) => Some(value),
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

impl PotentialOfRows for Law {
    fn energy(&self, g: &[f64]) -> f64 {
        let value = self.called(g, |g| self.energy.bind(g.py()).call1((&g,))?.extract());
        value.unwrap_or(f64::NAN)
    }

    fn slope(&self, g: &[f64]) -> Vec<f64> {
        let rows = self.called(g, |g| {
            let slope = self.slope.bind(g.py()).call1((&g,))?;
            let rows: Vec<Vec<f64>> = slope.call_method0("tolist").unwrap_or(slope).extract()?;
            let n = self.dimension;
            if rows.len() != n || rows.iter().any(|row| row.len() != n) {
                let text = format!("slope(g) must return {n} rows of {n} numbers, dU/dg_ij");
                return Err(pyo3::exceptions::PyValueError::new_err(text));
            }
            Ok(rows.concat())
        });
        rows.unwrap_or_default()
    }
}
