//! The content of a picture of a table: a map over two varied fields, or points over one.
//!
//! Invariant: it does not grow with the table beyond what can be distinguished in a picture.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use super::file::{Combine, Values};
use super::{Sweep, SweepError};

/// Largest number of cells of a map along a side, and of places of points.
const MOST_CELLS: u64 = 200;
const PLACES: (f64, f64) = (400.0, 200.0);

/// A picture's content.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Shown {
    /// The name of the scenario.
    pub(crate) name: String,
    /// The column whose values are shown.
    pub(crate) column: String,
    pub(crate) kind: Kind,
    /// Number of members without a value in that column.
    pub(crate) without: u64,
}

/// Map or points.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Kind {
    /// Row by row, from the first value of `y`; a cell that stands for several members has the largest of their values.
    Map { x: Side, y: Side, cells: Vec<Cell> },
    /// Points over the values of a field; where many fall on one place, one.
    Points { x: String, points: Vec<(f64, f64)> },
}

/// A side of a map.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Side {
    /// The column of the field.
    pub(crate) name: String,
    /// A value for each cell along the side.
    pub(crate) values: Vec<String>,
    /// Number of members in a cell, along this side.
    pub(crate) per_cell: u64,
}

impl Side {
    fn new(sweep: &Sweep, field: usize) -> Self {
        let vary = &sweep.file.vary[field];
        let count = vary.values.count();
        let per_cell = count.div_ceil(MOST_CELLS);
        let word = |cell: u64| word(&sweep.axes[field].value(cell * per_cell));
        let values = (0..count.div_ceil(per_cell)).map(word).collect();
        Self { name: vary.column().to_owned(), values, per_cell }
    }
}

/// Returns a value in words; of an object, such as a method, those of its fields.
fn word(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Number(number) => short(number.as_f64().unwrap_or_default()),
        Value::Object(fields) => fields.values().map(word).collect::<Vec<_>>().join(" "),
        value => value.to_string(),
    }
}

/// Formats a number in three digits, as short as possible.
fn short(x: f64) -> String {
    let rounded = format!("{x:.2e}").parse().unwrap_or(x);
    super::figure(Some(rounded)).trim_end_matches(".0").to_owned()
}

/// Content of a cell of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Cell {
    /// No member of it has a line yet.
    #[default]
    Waiting,
    /// Its members were refused.
    Refused,
    /// They failed.
    Failed,
    /// They ran, and have no value here.
    Empty,
    /// The largest of their values.
    Value(f64),
}

impl Cell {
    /// Returns the cell that says more.
    fn or(self, other: Self) -> Self {
        let rank = |cell: Self| match cell {
            Self::Waiting => 0,
            Self::Refused => 1,
            Self::Failed => 2,
            Self::Empty => 3,
            Self::Value(_) => 4,
        };
        match (self, other) {
            (Self::Value(a), Self::Value(b)) => Self::Value(a.max(b)),
            (a, b) if rank(a) >= rank(b) => a,
            (_, b) => b,
        }
    }
}

impl Sweep {
    /// Returns the column that a picture shows by default.
    fn usual_column(&self) -> &str {
        let first = self.file.scores.first().map(|score| score.name.as_str());
        self.file.picture.as_deref().or(first).unwrap_or("energy_error_max")
    }

    /// Reads a table of this sweep, finished or not, for a picture of `column`.
    ///
    /// # Errors
    /// If it cannot be read, is not of this sweep, or has no such column.
    pub(crate) fn shown(&self, table: &Path, column: Option<&str>) -> Result<Shown, SweepError> {
        let column = column.unwrap_or_else(|| self.usual_column());
        let place = |name: &str| self.columns.iter().position(|known| known == name);
        let at = place(column).ok_or_else(|| {
            crate::scenario::ScenarioError::invalid("", format!("there is no column {column:?}"))
        })?;
        let outcome = place("outcome").unwrap_or_default();
        let mut shown = Collected::new(self);
        self.lines(table, |member, values, cells| {
            // Figures of a run until it failed are no value of the whole.
            let cell = match (cells[outcome].as_str(), cells[at].parse::<f64>()) {
                ("refused", _) => Cell::Refused,
                ("failed", _) => Cell::Failed,
                (_, Ok(value)) if value.is_finite() => Cell::Value(value),
                _ => Cell::Empty,
            };
            shown.add(self, member, values, cell);
        })?;
        let (kind, without) = shown.end();
        Ok(Shown { name: self.name().to_owned(), column: column.to_owned(), kind, without })
    }
}

/// The lines of a table, as far as they are read.
struct Collected {
    kind: Kind,
    /// Numbers of the fields of x and y.
    fields: (Option<usize>, usize),
    without: u64,
}

impl Collected {
    fn new(sweep: &Sweep) -> Self {
        let fields = &sweep.file.vary;
        let wide: Vec<usize> =
            (0..fields.len()).filter(|&at| fields[at].values.count() > 1).collect();
        let numeric = |at: &usize| match &fields[*at].values {
            Values::List(values) => values.iter().all(Value::is_number),
            _ => true,
        };
        let (kind, fields) = match (sweep.file.combine, wide.as_slice()) {
            (Combine::Product, &[y, x]) => {
                let sides = [x, y].map(|field| Side::new(sweep, field));
                let cells = vec![Cell::Waiting; sides[0].values.len() * sides[1].values.len()];
                let fields = (Some(x), y);
                let [x, y] = sides;
                (Kind::Map { x, y, cells }, fields)
            }
            (_, wide) => {
                let x = wide.iter().copied().find(numeric);
                let name = x.map_or("member", |x| fields[x].column()).to_owned();
                (Kind::Points { x: name, points: Vec::new() }, (x, 0))
            }
        };
        Self { kind, fields, without: 0 }
    }

    fn add(&mut self, sweep: &Sweep, member: u64, values: &[Value], cell: Cell) {
        if !matches!(cell, Cell::Value(_)) {
            self.without += 1;
        }
        match (&mut self.kind, self.fields) {
            (Kind::Map { x, y, cells }, (Some(x_field), y_field)) => {
                let places = sweep.places(member);
                let column = (places[x_field] / x.per_cell) as usize;
                let row = (places[y_field] / y.per_cell) as usize;
                let place = &mut cells[row * x.values.len() + column];
                *place = place.or(cell);
            }
            (_, (x, _)) => {
                let x = x.and_then(|x| values[x].as_f64()).unwrap_or(member as f64);
                if let (Kind::Points { points, .. }, Cell::Value(y)) = (&mut self.kind, cell) {
                    points.push((x, y));
                }
            }
        }
    }

    fn end(mut self) -> (Kind, u64) {
        if let Kind::Points { points, .. } = &mut self.kind {
            thin(points);
        }
        (self.kind, self.without)
    }
}

/// Leaves one of all points that fall on one place.
fn thin(points: &mut Vec<(f64, f64)>) {
    let range = |of: fn(&(f64, f64)) -> f64| {
        let ends = (f64::INFINITY, f64::NEG_INFINITY);
        let wider = |(low, high): (f64, f64), x: f64| (low.min(x), high.max(x));
        let (low, high) = points.iter().map(of).fold(ends, wider);
        (low, (high - low).max(f64::MIN_POSITIVE))
    };
    let (x, y) = (range(|point| point.0), range(|point| point.1));
    let place =
        |value: f64, (low, width): (f64, f64), places| ((value - low) / width * places) as u32;
    // Small values stay apart on a logarithmic axis, too.
    let decade = |y: f64| (libm::log10(y.abs().max(f64::MIN_POSITIVE)) * 16.0) as i32;
    let mut kept = BTreeMap::new();
    for &point in points.iter() {
        let key = (place(point.0, x, PLACES.0), place(point.1, y, PLACES.1), decade(point.1));
        kept.entry(key).or_insert(point);
    }
    *points = kept.into_values().collect();
}
