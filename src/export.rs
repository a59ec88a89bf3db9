//! 6 · Tables of what a log holds, for programs that cannot read MCAP.
//!
//! Invariant: every number reads back to the bit; one row per sample, one column per number, in any
//! format.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::Path;
use std::str::FromStr;

use prost::Message as _;
use serde::Serialize;
use thiserror::Error;

use crate::log::LogError;
use crate::log::messages::{EnsembleStatistics, Member, Quantiles, State};
use crate::log::reader::{self, Ending, Item};
use crate::log::rows::{Row, read_rows};
use crate::log::schema::Channel;

#[cfg(feature = "parquet")]
mod columnar;

/// The columns of every table of samples.
const TIMES: [&str; 2] = ["log_time_ns", "time_s"];

/// Reason why there is no table.
#[derive(Debug, Error)]
pub enum ExportError {
    /// The log could not be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log holds none of the requested data.
    #[error("{log} holds no {asked}")]
    Empty {
        /// The log.
        log: String,
        /// The channels and the member.
        asked: String,
    },
    /// A channel that cannot be exported, or not together with the others.
    #[error(
        "{channel} cannot be exported{with}; a table can hold any of /state, /energy, /orthogonality, /momentum, /solver, /pace, or /ensemble/members or /ensemble/statistics alone"
    )]
    Channel {
        /// The channel.
        channel: &'static str,
        /// The other requested channels.
        with: &'static str,
    },
    /// The table could not be written.
    #[error("cannot write the table: {0}")]
    Write(io::Error),
}

/// Format of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Text with a head, comma-separated; numbers in the fewest digits that give them back.
    Csv,
    /// Apache Parquet, compressed with zstd.
    #[cfg(feature = "parquet")]
    Parquet,
    /// Apache Arrow's file format (Feather, version 2).
    #[cfg(feature = "parquet")]
    Arrow,
}

impl FromStr for Format {
    type Err = String;

    /// Parses the ending of a file's name.
    fn from_str(ending: &str) -> Result<Self, String> {
        match ending {
            "csv" => Ok(Self::Csv),
            #[cfg(feature = "parquet")]
            "parquet" => Ok(Self::Parquet),
            #[cfg(feature = "parquet")]
            "arrow" => Ok(Self::Arrow),
            #[cfg(not(feature = "parquet"))]
            "parquet" | "arrow" => Err(format!(
                ".{ending} needs a build with the feature parquet (cargo build --release --features parquet), like the one in the container image; this build writes .csv"
            )),
            _ => Err(format!("{ending:?} is not a format of tables: use .csv, .parquet or .arrow")),
        }
    }
}

/// Part of a log that becomes a table.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Choice {
    /// Channels: any that go with samples, or one of `/ensemble/members` and
    /// `/ensemble/statistics`. All that go with samples if empty.
    pub channels: Vec<Channel>,
    /// Member of an ensemble whose samples are exported; 0 is the run of the scene as given.
    pub member: u64,
}

/// A table that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Its rows.
    pub rows: u64,
    /// The names of its columns.
    pub columns: Vec<String>,
    /// State in which the end of the log was found.
    pub ending: Ending,
}

/// A value of a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
enum Cell {
    Number(Option<f64>),
    Count(Option<u64>),
    Word(Option<String>),
}

/// Type of the values of a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Number,
    Count,
    Word,
}

impl Kind {
    fn nothing(self) -> Cell {
        match self {
            Self::Number => Cell::Number(None),
            Self::Count => Cell::Count(None),
            Self::Word => Cell::Word(None),
        }
    }
}

/// One column or several: a number, a vector, a matrix.
struct Field {
    name: String,
    kind: Kind,
    cells: Vec<Cell>,
}

/// Fields of a row; the same ones in every row of a table, though some may be without cells.
struct Fields(Vec<Field>);

impl Fields {
    fn put(&mut self, name: impl Into<String>, kind: Kind, cells: Vec<Cell>) {
        self.0.push(Field { name: name.into(), kind, cells });
    }

    fn number(&mut self, name: impl Into<String>, value: Option<f64>) {
        let cells = value.into_iter().map(|value| Cell::Number(Some(value))).collect();
        self.put(name, Kind::Number, cells);
    }

    fn numbers(&mut self, name: impl Into<String>, values: &[f64]) {
        let cells = values.iter().map(|&value| Cell::Number(Some(value))).collect();
        self.put(name, Kind::Number, cells);
    }

    fn count(&mut self, name: impl Into<String>, value: Option<u64>) {
        let cells = value.into_iter().map(|value| Cell::Count(Some(value))).collect();
        self.put(name, Kind::Count, cells);
    }

    fn word(&mut self, name: impl Into<String>, value: Option<String>) {
        let cells = value.into_iter().map(|value| Cell::Word(Some(value))).collect();
        self.put(name, Kind::Word, cells);
    }

    /// Adds a state without its time.
    fn state(&mut self, before: &str, state: Option<&State>) {
        let list = |list: fn(&State) -> &Vec<f64>| state.map_or(&[][..], |state| list(state));
        self.numbers(format!("{before}attitude"), list(|state| &state.attitude));
        self.numbers(format!("{before}quaternion"), list(|state| &state.quaternion));
        self.numbers(format!("{before}body_momentum"), list(|state| &state.body_momentum));
        self.numbers(format!("{before}angular_velocity"), list(|state| &state.angular_velocity));
    }

    fn quantiles(&mut self, name: &str, of: Option<&Quantiles>) {
        let mut one = |end: &str, value: fn(&Quantiles) -> f64| {
            self.number(format!("{name}_{end}"), of.map(value))
        };
        one("least", |of| of.least);
        one("median", |of| of.median);
        one("percentile_95", |of| of.percentile_95);
        one("largest", |of| of.largest);
    }

    /// Returns the fields of a sample on the chosen channels.
    fn of_row(row: &Row, channels: &[Channel], start_ns: u64) -> Self {
        let mut fields = Self(Vec::new());
        let since_s = row.time_ns.saturating_sub(start_ns) as f64 / 1e9;
        let time_s = row.state.as_ref().map_or(since_s, |state| state.time_s);
        fields.count(TIMES[0], Some(row.time_ns));
        fields.number(TIMES[1], Some(time_s));
        for channel in channels {
            match channel {
                Channel::State => fields.state("", row.state.as_ref()),
                Channel::Energy => {
                    let energy = row.energy.as_ref();
                    fields.number("energy_kinetic", energy.map(|energy| energy.kinetic));
                    fields.number("energy_potential", energy.map(|energy| energy.potential));
                    fields.number("energy_total", energy.map(|energy| energy.total));
                    fields.number("energy_error", energy.map(|energy| energy.error));
                    fields.number("jacobi_error", energy.and_then(|energy| energy.jacobi_error));
                    fields.number("energy_work", energy.and_then(|energy| energy.work));
                }
                Channel::Orthogonality => {
                    let error = row.orthogonality.as_ref().map(|found| found.error);
                    fields.number("orthogonality_error", error);
                }
                Channel::Momentum => {
                    let momentum = row.momentum.as_ref();
                    let vector = momentum.map_or(&[][..], |momentum| &momentum.spatial_momentum);
                    fields.numbers("spatial_momentum", vector);
                    fields.number("momentum_drift", momentum.and_then(|momentum| momentum.drift));
                    let impulse = momentum.map_or(&[][..], |momentum| &momentum.impulse);
                    fields.numbers("momentum_impulse", impulse);
                }
                Channel::Solver => {
                    let solver = row.solver.as_ref();
                    fields.count("solver_iterations", solver.map(|s| s.iterations.into()));
                    fields.number("solver_increment", solver.map(|s| s.increment));
                    fields.word("solver_rung", solver.map(|s| s.rung.clone()));
                    fields.number("solver_sigma_min", solver.and_then(|s| s.sigma_min));
                }
                Channel::Pace => {
                    let pace = row.pace.as_ref();
                    fields.number("pace_sigma", pace.map(|pace| pace.sigma));
                    fields.number("pace_step_s", pace.map(|pace| pace.step_s));
                    fields.count("pace_own_steps", pace.map(|pace| pace.own_steps));
                    fields.number("pace_least_sigma", pace.map(|pace| pace.least_sigma));
                    fields.number("pace_time_error_s", pace.map(|pace| pace.time_error_s));
                }
                _ => {}
            }
        }
        fields
    }

    /// Returns how a member began and ended.
    fn of_member(member: &Member) -> Self {
        let mut fields = Self(Vec::new());
        fields.count("member", Some(member.member));
        fields.word("outcome", Some(member.outcome.clone()));
        fields.count("steps", Some(member.steps));
        fields.count("samples", Some(member.samples));
        fields.count("iterations", Some(member.iterations));
        fields.state("initial_", member.initial.as_ref());
        fields.number("time_s", member.last.as_ref().map(|state| state.time_s));
        fields.state("", member.last.as_ref());
        let figures = member.figures.as_ref();
        fields.number("energy_initial", figures.and_then(|f| f.energy_initial));
        fields.number("energy_error_max", figures.and_then(|f| f.energy_max_abs_error));
        fields.number("energy_error", figures.and_then(|f| f.energy_final_error));
        fields.number("orthogonality_error_max", figures.and_then(|f| f.orthogonality_max));
        fields.number("momentum_drift_max", figures.and_then(|f| f.momentum_max_drift));
        fields.number("kinetic_max", figures.and_then(|f| f.kinetic_max));
        fields
    }

    /// Returns mean and spread at one time.
    fn of_statistics(found: &EnsembleStatistics) -> Self {
        let mut fields = Self(Vec::new());
        fields.number("time_s", Some(found.time_s));
        fields.count("members", Some(found.members));
        fields.count("failed", Some(found.failed));
        fields.numbers("mean_attitude", &found.mean_attitude);
        fields.number("attitude_spread_rad", found.attitude_spread_rad);
        fields.numbers("mean_body_momentum", &found.mean_body_momentum);
        fields.numbers("body_momentum_deviation", &found.body_momentum_deviation);
        fields.quantiles("energy_error_max", found.energy_max_abs_error.as_ref());
        fields.quantiles("orthogonality_error_max", found.orthogonality_max.as_ref());
        fields.quantiles("momentum_drift_max", found.momentum_max_drift.as_ref());
        fields
    }
}

/// The columns of a table: each field with as many as it has anywhere in the log.
#[derive(Default)]
struct Columns(Vec<(String, Kind, usize)>);

impl Columns {
    fn take_in(&mut self, Fields(fields): &Fields) {
        if self.0.is_empty() {
            self.0 = fields.iter().map(|field| (field.name.clone(), field.kind, 0)).collect();
        }
        for ((.., width), field) in self.0.iter_mut().zip(fields) {
            *width = field.cells.len().max(*width);
        }
    }

    fn names(&self) -> Vec<String> {
        self.0.iter().flat_map(|(name, _, width)| names(name, *width)).collect()
    }

    #[cfg(feature = "parquet")]
    fn kinds(&self) -> Vec<Kind> {
        self.0.iter().flat_map(|(_, kind, width)| std::iter::repeat_n(*kind, *width)).collect()
    }

    /// Returns a row with a cell in each column.
    fn row(&self, Fields(fields): Fields) -> Vec<Cell> {
        let wide = self.0.iter().zip(fields).flat_map(|((_, kind, width), Field { cells, .. })| {
            let missing = width.saturating_sub(cells.len());
            cells.into_iter().chain(std::iter::repeat_n(kind.nothing(), missing))
        });
        wide.collect()
    }
}

/// Returns the names of the columns of a field: with the axes of vectors for n = 3, else with row
/// and column from 1 on.
fn names(field: &str, width: usize) -> Vec<String> {
    let label = |labels: &[&str]| labels.iter().map(|label| format!("{field}_{label}")).collect();
    let pairs = |n: usize| (1..=n).flat_map(move |i| (1..=n).map(move |j| (i, j)));
    let quantity = field.rsplit_once("initial_").map_or(field, |(_, quantity)| quantity);
    match (quantity, width) {
        (_, 0) => Vec::new(),
        ("quaternion", 4) => label(&["w", "x", "y", "z"]),
        ("attitude" | "mean_attitude", _) => {
            pairs(width.isqrt()).map(|(i, j)| format!("{field}_{i}_{j}")).collect()
        }
        (
            "body_momentum"
            | "spatial_momentum"
            | "momentum_impulse"
            | "angular_velocity"
            | "mean_body_momentum"
            | "body_momentum_deviation",
            _,
        ) => {
            if width == 3 {
                return label(&["x", "y", "z"]);
            }
            // n (n - 1) / 2 entries above the diagonal.
            let n = (8 * width + 1).isqrt().div_ceil(2);
            let above = pairs(n).filter(|(i, j)| i < j);
            above.map(|(i, j)| format!("{field}_{i}_{j}")).collect()
        }
        _ => vec![field.to_owned()],
    }
}

/// Takes the rows of a table.
trait Table {
    fn put(&mut self, row: Vec<Cell>) -> io::Result<()>;
    fn finish(self: Box<Self>) -> io::Result<()>;
}

impl<W: Write> Table for csv::Writer<W> {
    fn put(&mut self, row: Vec<Cell>) -> io::Result<()> {
        self.serialize(row).map_err(plain)
    }

    fn finish(mut self: Box<Self>) -> io::Result<()> {
        self.flush()
    }
}

/// Returns the error of the file system alone, whose kind says what happened.
fn plain(error: csv::Error) -> io::Error {
    match error.into_kind() {
        csv::ErrorKind::Io(error) => error,
        other => io::Error::other(format!("{other:?}")),
    }
}

/// Writes the chosen part of a log, finished or not, as a table. Columns of vectors for n = 3 end
/// in x, y, z, those of a matrix in its row and column; the logarithms of the log, which follow
/// from its errors, are left out.
///
/// If the log cannot be read or holds nothing of the chosen part, a chosen channel is no table, or
/// the table cannot be written.
pub fn export<'a>(
    log: &Path,
    choice: &Choice,
    format: Format,
    out: impl Write + Send + 'a,
) -> Result<Exported, ExportError> {
    // The head comes first, so the log is read twice.
    let mut columns = Columns::default();
    each(log, choice, |fields| {
        columns.take_in(&fields);
        ControlFlow::Continue(())
    })?;
    let names = columns.names();
    if names.iter().all(|name| TIMES.contains(&name.as_str())) {
        let topics: Vec<&str> = choice.channels.iter().map(|channel| channel.topic()).collect();
        let topics = if topics.is_empty() { "samples".to_owned() } else { topics.join(", ") };
        let asked = match choice.member {
            0 => topics,
            member => format!("{topics} of member {member}"),
        };
        return Err(ExportError::Empty { log: log.display().to_string(), asked });
    }
    let mut table: Box<dyn Table + 'a> = match format {
        Format::Csv => {
            let mut table = csv::Writer::from_writer(out);
            table.write_record(&names).map_err(plain).map_err(ExportError::Write)?;
            Box::new(table)
        }
        #[cfg(feature = "parquet")]
        Format::Parquet => {
            columnar::parquet(&names, &columns.kinds(), out).map_err(ExportError::Write)?
        }
        #[cfg(feature = "parquet")]
        Format::Arrow => {
            columnar::arrow(&names, &columns.kinds(), out).map_err(ExportError::Write)?
        }
    };
    let (mut rows, mut written) = (0, Ok(()));
    let ending = each(log, choice, |fields| {
        rows += 1;
        written = table.put(columns.row(fields));
        if written.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    })?;
    written.and_then(|()| table.finish()).map_err(ExportError::Write)?;
    Ok(Exported { rows, columns: names, ending })
}

/// Passes on the rows of the chosen part.
fn each(
    log: &Path,
    choice: &Choice,
    mut visit: impl FnMut(Fields) -> ControlFlow<()>,
) -> Result<Ending, ExportError> {
    use Channel::{Energy, EnsembleMembers, EnsembleStatistics as Statistics, Momentum};
    use Channel::{Orthogonality, Pace, Solver, State};
    const OF_SAMPLES: [Channel; 6] = [State, Energy, Orthogonality, Momentum, Solver, Pace];
    let channels = if choice.channels.is_empty() { &OF_SAMPLES } else { &choice.channels[..] };
    if let [channel @ (EnsembleMembers | Statistics)] = *channels {
        return Ok(reader::read(log, |item| {
            let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
            if topic != channel.topic() {
                return ControlFlow::Continue(());
            }
            let fields = if channel == EnsembleMembers {
                Member::decode(data).map(|found| Fields::of_member(&found))
            } else {
                EnsembleStatistics::decode(data).map(|found| Fields::of_statistics(&found))
            };
            fields.map_or(ControlFlow::Continue(()), &mut visit)
        })?);
    }
    if let Some(channel) = channels.iter().find(|channel| !OF_SAMPLES.contains(channel)) {
        let with = if channels.len() > 1 { " together with others" } else { "" };
        return Err(ExportError::Channel { channel: channel.topic(), with });
    }
    let mut start_ns = None;
    Ok(read_rows(log, choice.member, |row| {
        let start_ns = *start_ns.get_or_insert(row.time_ns);
        visit(Fields::of_row(&row, channels, start_ns))
    })?)
}
