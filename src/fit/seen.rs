//! Attitudes that were seen, from a log or a table.
//!
//! Invariant: times are finite and rise, attitudes are rotations to 1e-2.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use nalgebra::{DMatrix, Quaternion, UnitQuaternion};
use thiserror::Error;

use crate::log::LogError;
use crate::log::reader::is_log;
use crate::log::rows::read_rows;

/// An attitude at a time.
#[derive(Clone, Debug, PartialEq)]
pub struct Attitude {
    /// The time since the start, in seconds.
    pub time_s: f64,
    /// The rotation matrix, n by n, from body to space.
    pub attitude: DMatrix<f64>,
}

/// Reason why attitudes cannot be used.
#[derive(Debug, Error)]
pub enum SeenError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error.
        source: csv::Error,
    },
    /// The log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The table has not the columns that are needed.
    #[error("{}: a column {missing} is needed: time_s, and either quaternion_w, _x, _y, _z or attitude_1_1, attitude_1_2 and so on, row by row, as `vpd export` writes them", path.display())]
    Column {
        /// The file.
        path: PathBuf,
        /// The column that is not there.
        missing: String,
    },
    /// A row holds no usable attitude.
    #[error("attitude {number}: {what}")]
    Row {
        /// The number of the row, from 1 on, without the head.
        number: usize,
        /// What is wrong.
        what: String,
    },
    /// They are fewer than the unknowns need.
    #[error("{count} attitudes given, more are needed for {unknowns} unknowns and their errors")]
    TooFew {
        /// Number of attitudes.
        count: usize,
        /// Number of unknowns.
        unknowns: usize,
    },
}

/// Reads the attitudes of a log's /state, or of a CSV table.
///
/// # Errors
/// [`SeenError`]; what is not finite, no rotation or out of order is refused by its row.
pub fn read(path: &Path) -> Result<Vec<Attitude>, SeenError> {
    if is_log(path)? { of_log(path) } else { of_table(path) }
}

fn of_log(path: &Path) -> Result<Vec<Attitude>, SeenError> {
    let mut seen = Vec::new();
    read_rows(path, 0, |row| {
        if let Some(state) = row.state {
            let n = state.attitude.len().isqrt();
            let attitude = DMatrix::from_row_slice(n, n, &state.attitude[..n * n]);
            seen.push(Attitude { time_s: state.time_s, attitude });
        }
        ControlFlow::Continue(())
    })?;
    Ok(seen)
}

fn of_table(path: &Path) -> Result<Vec<Attitude>, SeenError> {
    let unreadable = |source| SeenError::Read { path: path.to_owned(), source };
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).map_err(unreadable)?;
    let head = reader.headers().map_err(unreadable)?.clone();
    let head: Vec<&str> = head.iter().map(|name| name.trim_start_matches('\u{feff}')).collect();
    let place = |name: String| {
        let found = head.iter().position(|column| *column == name);
        found.ok_or(SeenError::Column { path: path.to_owned(), missing: name })
    };
    let time = place("time_s".into())?;
    let quaternion = ["w", "x", "y", "z"].map(|axis| place(format!("quaternion_{axis}")));
    let entries = head.iter().filter(|name| name.starts_with("attitude_")).count();
    let n = if entries == 0 { 0 } else { entries.isqrt() };
    let (places, n) = match quaternion {
        [Ok(w), Ok(x), Ok(y), Ok(z)] => (vec![w, x, y, z], 3),
        _ if n > 1 => {
            let all = (1..=n).flat_map(|i| (1..=n).map(move |j| format!("attitude_{i}_{j}")));
            (all.map(place).collect::<Result<Vec<_>, _>>()?, n)
        }
        given => {
            let missing = given.into_iter().find_map(Result::err);
            return Err(missing.unwrap_or_else(|| SeenError::Column {
                path: path.to_owned(),
                missing: "quaternion_w".into(),
            }));
        }
    };
    let mut seen = Vec::new();
    for (k, row) in reader.records().enumerate() {
        let row = row.map_err(unreadable)?;
        let number = |place: &usize| {
            let text = row.get(*place).unwrap_or_default();
            text.parse::<f64>().map_err(|_| SeenError::Row {
                number: k + 1,
                what: format!("{text:?} given for {}, a number is needed", head[*place]),
            })
        };
        let time_s = number(&time)?;
        let numbers = places.iter().map(number).collect::<Result<Vec<_>, _>>()?;
        let attitude = match numbers[..] {
            [w, x, y, z] if n == 3 => {
                let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
                let rotation = turn.to_rotation_matrix();
                DMatrix::from_fn(3, 3, |i, j| rotation[(i, j)])
            }
            _ => DMatrix::from_row_slice(n, n, &numbers),
        };
        seen.push(Attitude { time_s, attitude });
    }
    Ok(seen)
}

/// Refuses attitudes that are not in SO(n), or not in the order of time.
pub(super) fn check(seen: &[Attitude], n: usize) -> Result<(), SeenError> {
    /// Digits of a table, and noise that is added to its numbers one by one.
    const OFF_GROUP: f64 = 1e-2;
    let mut before = f64::NEG_INFINITY;
    for (k, Attitude { time_s, attitude }) in seen.iter().enumerate() {
        let wrong = |what: String| Err(SeenError::Row { number: k + 1, what });
        if !(time_s.is_finite() && *time_s >= 0.0 && *time_s > before) {
            return wrong(format!(
                "t = {time_s} s given after {before} s; times must rise, from 0 on"
            ));
        }
        before = *time_s;
        if attitude.shape() != (n, n) {
            let found = attitude.nrows();
            return wrong(format!("is of n = {found}, the scenario's body has n = {n}"));
        }
        let off = (attitude.tr_mul(attitude) - DMatrix::identity(n, n)).norm();
        if !(off < OFF_GROUP && attitude.determinant() > 0.0) {
            return wrong(format!(
                "is no rotation: |g^T g - I| = {off:.1e}, determinant {:.3}",
                attitude.determinant()
            ));
        }
    }
    Ok(())
}
