//! The columns of a table, and their values.

use serde::Serialize;

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
    /// What stands before the name of the quantity: the name of a body, the beginning of a member.
    pub(crate) before: String,
    pub(crate) name: String,
    pub(crate) kind: Kind,
    pub(crate) cells: Vec<Cell>,
}

impl Field {
    pub(crate) fn numbers(name: impl Into<String>, values: &[f64]) -> Self {
        let cells = values.iter().map(|&value| Cell::Number(value)).collect();
        Self { before: String::new(), name: name.into(), kind: Kind::Number, cells }
    }

    pub(crate) fn number(name: impl Into<String>, value: &(impl Into<Option<f64>> + Copy)) -> Self {
        Self::numbers(name, (*value).into().as_slice())
    }

    pub(crate) fn count(name: &str, value: &(impl Into<u64> + Copy)) -> Self {
        let cells = vec![Cell::Count((*value).into())];
        Self { before: String::new(), name: name.to_owned(), kind: Kind::Count, cells }
    }

    pub(crate) fn word(name: &str, value: &str) -> Self {
        let cells = vec![Cell::Word(value.to_owned())];
        Self { before: String::new(), name: name.to_owned(), kind: Kind::Word, cells }
    }

    /// Returns it with `before` in front of its name.
    pub(crate) fn after(self, before: &str) -> Self {
        Self { before: before.to_owned(), ..self }
    }

    /// Returns the fields of a message, without cells if there is none.
    pub(crate) fn of<M: Default>(message: Option<&M>, fields: fn(&M) -> Vec<Self>) -> Vec<Self> {
        let empty = |field| Self { cells: Vec::new(), ..field };
        let without = || fields(&M::default()).into_iter().map(empty).collect();
        message.map_or_else(without, fields)
    }
}
