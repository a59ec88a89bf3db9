//! Samples as arrays of NumPy, each over memory of its own, which the caller may change.
//!
//! Made by NumPy from a `bytearray`: the crate `numpy` would bring the crate `ndarray`, which changes features of what `vpd` is
//! built from, so that all of it would be built twice.

use std::borrow::Cow;

use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyByteArray, PyDict, PyTuple, PyType};
use vpd::log::columns::{Columns, Values};

/// Returns an array of a shape, which has as many places as there are numbers.
pub(crate) fn array<'py>(
    py: Python<'py>,
    shape: &[usize],
    numbers: &[f64],
) -> PyResult<Bound<'py, PyAny>> {
    /// Found once: NumPy would parse the name for each array of a controller.
    static KIND: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let kind = KIND.get_or_try_init(py, || {
        Ok::<_, PyErr>(py.import("numpy")?.getattr("dtype")?.call1(("=f8",))?.unbind())
    })?;
    made(py, shape, kind.bind(py), numbers, |x| x.to_ne_bytes())
}

/// Returns an array of one dimension.
pub(crate) fn vector<'py>(py: Python<'py>, numbers: &[f64]) -> PyResult<Bound<'py, PyAny>> {
    array(py, &[numbers.len()], numbers)
}

fn made<'py, T: Copy, const SIZE: usize>(
    py: Python<'py>,
    shape: &[usize],
    kind: impl IntoPyObject<'py>,
    values: &[T],
    bytes: impl Fn(T) -> [u8; SIZE],
) -> PyResult<Bound<'py, PyAny>> {
    static ARRAY: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let memory = PyByteArray::new_with(py, SIZE * values.len(), |memory| {
        for (place, &value) in memory.as_chunks_mut::<SIZE>().0.iter_mut().zip(values) {
            *place = bytes(value);
        }
        Ok(())
    })?;
    ARRAY.import(py, "numpy", "ndarray")?.call1((PyTuple::new(py, shape)?, kind, memory))
}

/// Returns the arrays by name. Words are a pair: the number of the word of each sample, and the words.
pub(crate) fn arrays(py: Python<'_>, columns: Columns) -> PyResult<Bound<'_, PyDict>> {
    let arrays = PyDict::new(py);
    for (name, values) in columns.into_all() {
        match values {
            Values::Numbers { shape, values } => {
                let samples = values.len() / shape.iter().product::<usize>().max(1);
                let shape: Vec<usize> = std::iter::once(samples).chain(shape).collect();
                arrays.set_item(name, array(py, &shape, &values)?)?;
            }
            Values::Counts(counts) => {
                let counts = made(py, &[counts.len()], "=u8", &counts, u64::to_ne_bytes)?;
                arrays.set_item(name, counts)?;
            }
            Values::Words(words) => {
                let mut distinct: Vec<Cow<'static, str>> = Vec::new();
                let mut number = |word: &Cow<'static, str>| {
                    let found = distinct.iter().position(|other| other == word);
                    found.unwrap_or_else(|| {
                        distinct.push(word.clone());
                        distinct.len() - 1
                    })
                };
                let numbers: Vec<u32> = words.iter().map(|word| number(word) as u32).collect();
                let distinct: Vec<&str> = distinct.iter().map(AsRef::as_ref).collect();
                let numbers = made(py, &[numbers.len()], "=u4", &numbers, u32::to_ne_bytes)?;
                arrays.set_item(name, (numbers, distinct))?;
            }
        }
    }
    Ok(arrays)
}
