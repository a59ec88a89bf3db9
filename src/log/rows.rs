//! The samples of a log one after another, each with all that its channels say of it: for tables and comparisons.
//!
//! Invariant: one row a sample, in the order of the file; memory for one at a time.

use std::ops::ControlFlow;
use std::path::Path;

use serde::Serialize;

use super::LogError;
pub use super::messages::Row;
use super::reader::{self, Ending, Item, Message};
use super::schema::Topic;

/// A value of a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub(crate) enum Cell {
    Number(f64),
    Count(u64),
    Word(String),
}

/// Type of the values of a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Number,
    Count,
    Word,
}

/// One column of a table or several: a number, a vector, a matrix. Without cells where there is none.
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) kind: Kind,
    pub(crate) cells: Vec<Cell>,
}

impl Field {
    pub(crate) fn numbers(name: impl Into<String>, values: &[f64]) -> Self {
        let cells = values.iter().map(|&value| Cell::Number(value)).collect();
        Self { name: name.into(), kind: Kind::Number, cells }
    }

    pub(crate) fn number(name: impl Into<String>, value: &(impl Into<Option<f64>> + Copy)) -> Self {
        Self::numbers(name, (*value).into().as_slice())
    }

    pub(crate) fn count(name: &str, value: &(impl Into<u64> + Copy)) -> Self {
        let cells = vec![Cell::Count((*value).into())];
        Self { name: name.to_owned(), kind: Kind::Count, cells }
    }

    pub(crate) fn word(name: &str, value: &str) -> Self {
        let cells = vec![Cell::Word(value.to_owned())];
        Self { name: name.to_owned(), kind: Kind::Word, cells }
    }

    /// Returns the fields of a message, without cells if there is none.
    pub(crate) fn of<M: Default>(message: Option<&M>, fields: fn(&M) -> Vec<Self>) -> Vec<Self> {
        let empty = |field| Self { cells: Vec::new(), ..field };
        let without = || fields(&M::default()).into_iter().map(empty).collect();
        message.map_or_else(without, fields)
    }
}

/// Shows the samples of a run, or of a member of an ensemble (a run is member 0), to `visit`, until that breaks off.
///
/// Damage is no error: it ends the reading and is reported in the [`Ending`].
///
/// # Errors
/// If the file cannot be opened or read.
pub fn read_rows(
    path: &Path,
    member: u64,
    mut visit: impl FnMut(Row) -> ControlFlow<()>,
) -> Result<Ending, LogError> {
    let mut open: Option<(u32, Row)> = None;
    let mut stopped = false;
    let ending = reader::read(path, |item| {
        let Item::Message { topic, schema, time_ns, sequence, data } = item else {
            return ControlFlow::Continue(());
        };
        let message = Topic::parse(topic)
            .filter(|topic| topic.member == member)
            .and_then(|topic| Message::decode(topic.channel.topic(), schema, data));
        let Some(message) = message else { return ControlFlow::Continue(()) };
        if let Some((number, row)) = &mut open
            && (*number, row.time_ns) == (sequence, time_ns)
        {
            row.take_in(message);
            return ControlFlow::Continue(());
        }
        let mut row = Row { time_ns, ..Row::default() };
        row.take_in(message);
        match open.replace((sequence, row)) {
            Some((_, whole)) => {
                let flow = visit(whole);
                stopped = flow.is_break();
                flow
            }
            None => ControlFlow::Continue(()),
        }
    })?;
    if !stopped && let Some((_, row)) = open {
        // Nothing comes after it.
        let _ = visit(row);
    }
    Ok(ending)
}
