//! 6 · Tables of what a log holds, for programs that cannot read MCAP, and bags for those of ROS 2 ([`ros2()`]).
//!
//! Invariant: every number reads back to the bit; one row per sample, one column per number, in any
//! format.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::Path;
use std::str::FromStr;

use prost::Message as _;
use thiserror::Error;

use crate::log::LogError;
use crate::log::columns::Columns as Arrays;
use crate::log::field::{Cell, Field, Kind};
use crate::log::messages::{BodyState, EnsembleStatistics, Member, MemberBody, Message, State};
use crate::log::reader::{self, Ending, Item};
use crate::log::rows::{Row, read_rows};
use crate::log::schema::Channel;

#[cfg(feature = "parquet")]
mod columnar;
mod npz;
mod ros2;

pub use ros2::{Bag, ros2};

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
        "{channel} cannot be exported{with}; a table can hold any of {}, or /ensemble/members or /ensemble/statistics alone",
        topics(Message::CHANNELS)
    )]
    Channel {
        /// The channel.
        channel: &'static str,
        /// The other requested channels.
        with: &'static str,
    },
    /// Its times are beyond those of ROS.
    #[error(
        "{log} has times after 2038-01-19, which the messages of ROS 2 cannot hold; give it an earlier /log/epoch"
    )]
    Time {
        /// The log.
        log: String,
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
    /// Arrays of NumPy, uncompressed: vectors and matrices whole.
    Npz,
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
            "npz" => Ok(Self::Npz),
            #[cfg(feature = "parquet")]
            "parquet" => Ok(Self::Parquet),
            #[cfg(feature = "parquet")]
            "arrow" => Ok(Self::Arrow),
            #[cfg(not(feature = "parquet"))]
            "parquet" | "arrow" => Err(format!(
                ".{ending} needs a build with the feature parquet (cargo build --release --features parquet), like the one in the container image; this build writes .csv and .npz"
            )),
            _ => Err(format!(
                "{ending:?} is not a format of tables: use .csv, .npz, .parquet or .arrow"
            )),
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

/// Returns the fields of a sample on the chosen channels.
fn of_row(row: &Row, channels: &[Channel], start_ns: u64) -> Vec<Field> {
    let since_s = row.time_ns.saturating_sub(start_ns) as f64 / 1e9;
    let time_s = row.time_s().unwrap_or(since_s);
    let mut fields = vec![Field::count(TIMES[0], &row.time_ns), Field::number(TIMES[1], &time_s)];
    fields.extend(channels.iter().flat_map(|&channel| row.fields(channel)));
    fields
}

/// Returns how a member began and ended.
fn of_member(member: &Member) -> Vec<Field> {
    let state = |before: &str, state: &Option<State>| {
        let fields = Field::of(state.as_ref(), State::fields);
        fields.into_iter().map(|field| field.after(before)).collect::<Vec<_>>()
    };
    let of_body = |before: &str, state: &Option<BodyState>| {
        let fields = Field::of(state.as_ref(), BodyState::fields);
        fields.into_iter().map(|field| field.after(before)).collect::<Vec<_>>()
    };
    let mut fields = vec![
        Field::count("member", &member.member),
        Field::word("outcome", &member.outcome),
        Field::word("stopped_by", &member.stopped_by_pointer().unwrap_or_default()),
        Field::count("steps", &member.steps),
        Field::count("samples", &member.samples),
        Field::count("iterations", &member.iterations),
    ];
    fields.extend(state("initial_", &member.initial));
    for MemberBody { name, initial, .. } in &member.bodies {
        fields.extend(of_body(&format!("{name}_initial_"), initial));
    }
    fields.push(Field::number("time_s", &member.end_s()));
    fields.extend(state("", &member.last));
    for MemberBody { name, last, .. } in &member.bodies {
        fields.extend(of_body(&format!("{name}_"), last));
    }
    let figures = member.figures.unwrap_or_default();
    fields.extend([
        Field::number("energy_initial", &figures.energy_initial),
        Field::number("energy_error_max", &figures.energy_max_abs_error),
        Field::number("energy_error", &figures.energy_final_error),
        Field::number("orthogonality_error_max", &figures.orthogonality_max),
        Field::number("momentum_drift_max", &figures.momentum_max_drift),
        Field::number("kinetic_max", &figures.kinetic_max),
        Field::number("control_saturated", &figures.control_saturated.map(|count| count as f64)),
        Field::number("pointing_error_rad", &figures.pointing_error_last),
    ]);
    fields
}

/// Returns mean and spread at one time.
fn of_statistics(found: &EnsembleStatistics) -> Vec<Field> {
    let mut fields = vec![
        Field::number("time_s", &found.time_s),
        Field::count("members", &found.members),
        Field::count("failed", &found.failed),
        Field::numbers("mean_attitude", &found.mean_attitude),
        Field::number("attitude_spread_rad", &found.attitude_spread_rad),
        Field::numbers("mean_body_momentum", &found.mean_body_momentum),
        Field::numbers("body_momentum_deviation", &found.body_momentum_deviation),
    ];
    for body in &found.bodies {
        let of_body = [
            Field::numbers("mean_attitude", &body.mean_attitude),
            Field::number("attitude_spread_rad", &body.attitude_spread_rad),
            Field::numbers("mean_body_momentum", &body.mean_body_momentum),
            Field::numbers("body_momentum_deviation", &body.body_momentum_deviation),
            Field::numbers("mean_position", &body.mean_position),
            Field::numbers("position_deviation", &body.position_deviation),
            Field::numbers("mean_velocity", &body.mean_velocity),
            Field::numbers("velocity_deviation", &body.velocity_deviation),
        ];
        let before = format!("{}_", body.name);
        fields.extend(of_body.map(|field| field.after(&before)));
    }
    for (name, of) in [
        ("energy_error_max", found.energy_max_abs_error),
        ("orthogonality_error_max", found.orthogonality_max),
        ("momentum_drift_max", found.momentum_max_drift),
    ] {
        let ends = [
            ("least", of.map(|of| of.least)),
            ("median", of.map(|of| of.median)),
            ("percentile_95", of.map(|of| of.percentile_95)),
            ("largest", of.map(|of| of.largest)),
        ];
        fields.extend(ends.map(|(end, value)| Field::number(format!("{name}_{end}"), &value)));
    }
    fields
}

/// The columns of a table: each field with as many as it has anywhere in the log.
#[derive(Default)]
struct Columns(Vec<Column>);

struct Column {
    before: String,
    name: String,
    #[cfg_attr(not(feature = "parquet"), expect(dead_code, reason = "CSV has no types"))]
    kind: Kind,
    width: usize,
}

impl Column {
    fn is_of(&self, field: &Field) -> bool {
        self.name == field.name && self.before == field.before
    }
}

impl Columns {
    fn take_in(&mut self, fields: &[Field]) {
        for (i, field) in fields.iter().enumerate() {
            // Nearly always at the same place: only a damaged log lacks a body in some samples.
            let same = self.0.get(i).is_some_and(|column| column.is_of(field)).then_some(i);
            let found = same.or_else(|| self.0.iter().position(|column| column.is_of(field)));
            let at = found.unwrap_or_else(|| {
                let Field { before, name, kind, .. } = field;
                let (before, name) = (before.clone(), name.clone());
                self.0.push(Column { before, name, kind: *kind, width: 0 });
                self.0.len() - 1
            });
            self.0[at].width = field.cells.len().max(self.0[at].width);
        }
    }

    fn names(&self) -> Vec<String> {
        let of = |column: &Column| names(&column.before, &column.name, column.width);
        self.0.iter().flat_map(of).collect()
    }

    #[cfg(feature = "parquet")]
    fn kinds(&self) -> Vec<Kind> {
        self.0.iter().flat_map(|column| std::iter::repeat_n(column.kind, column.width)).collect()
    }

    /// Returns a row with a cell in each column.
    fn row(&self, fields: Vec<Field>) -> Vec<Option<Cell>> {
        let count = fields.len();
        let mut fields: Vec<Option<Field>> = fields.into_iter().map(Some).collect();
        // Of the field after the one found last, which is nearly always the next.
        let mut next = 0;
        let wide = self.0.iter().flat_map(|column| {
            let is_it = |at: &usize| fields[*at].as_ref().is_some_and(|field| column.is_of(field));
            let found = (next..count).chain(0..next.min(count)).find(is_it);
            next = found.map_or(next, |at| at + 1);
            let cells = found.and_then(|at| fields[at].take()).map_or_else(Vec::new, |it| it.cells);
            let missing = column.width.saturating_sub(cells.len());
            // Programs differ in what they make of a NaN; a cell without a number is empty, of foreign logs, too.
            let filled = |cell| match cell {
                Cell::Number(value) if value.is_nan() => None,
                cell => Some(cell),
            };
            cells.into_iter().map(filled).chain(std::iter::repeat_n(None, missing))
        });
        wide.collect()
    }
}

/// Returns the names of the columns of a field: with the axes of vectors for n = 3, else with row
/// and column from 1 on.
fn names(before: &str, quantity: &str, width: usize) -> Vec<String> {
    let field = format!("{before}{quantity}");
    let label = |labels: &[&str]| labels.iter().map(|label| format!("{field}_{label}")).collect();
    let pairs = |n: usize| (1..=n).flat_map(move |i| (1..=n).map(move |j| (i, j)));
    match (quantity, width) {
        (_, 0) => Vec::new(),
        ("quaternion" | "frame_quaternion", 4) => label(&["w", "x", "y", "z"]),
        ("attitude" | "mean_attitude" | "transition" | "covariance", _) => {
            pairs(width.isqrt()).map(|(i, j)| format!("{field}_{i}_{j}")).collect()
        }
        (
            "body_momentum"
            | "spatial_momentum"
            | "momentum_impulse"
            | "angular_velocity"
            | "mean_body_momentum"
            | "body_momentum_deviation"
            | "control_wanted"
            | "attitude_error"
            | "rate_error"
            | "control_field"
            | "control_disturbance"
            | "relative_rate",
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
        (
            "position" | "velocity" | "linear_momentum" | "mean_position" | "position_deviation"
            | "mean_velocity" | "velocity_deviation",
            3,
        ) => label(&["x", "y", "z"]),
        // Of an axis, an actuator, a wheel or a parameter each.
        (
            "position" | "velocity" | "linear_momentum" | "mean_position" | "position_deviation"
            | "mean_velocity" | "velocity_deviation" | "control_command" | "wheel_momenta"
            | "wheel_speeds" | "sensitivity",
            _,
        ) => (1..=width).map(|number| format!("{field}_{number}")).collect(),
        _ => vec![field],
    }
}

fn topics(channels: &[Channel]) -> String {
    channels.iter().map(|channel| channel.topic()).collect::<Vec<_>>().join(", ")
}

/// Takes the rows of a table.
trait Table {
    fn put(&mut self, row: Vec<Option<Cell>>) -> io::Result<()>;
    fn finish(self: Box<Self>) -> io::Result<()>;
}

impl<W: Write> Table for csv::Writer<W> {
    fn put(&mut self, row: Vec<Option<Cell>>) -> io::Result<()> {
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
    if format == Format::Npz {
        return arrays(log, choice, out);
    }
    // The head comes first, so the log is read twice.
    let mut columns = Columns::default();
    each(log, choice, |fields| {
        columns.take_in(&fields);
        ControlFlow::Continue(())
    })?;
    let names = columns.names();
    if names.iter().all(|name| TIMES.contains(&name.as_str())) {
        return Err(empty(log, choice));
    }
    let mut table: Box<dyn Table + 'a> = match format {
        Format::Csv => {
            let mut table = csv::Writer::from_writer(out);
            table.write_record(&names).map_err(plain).map_err(ExportError::Write)?;
            Box::new(table)
        }
        Format::Npz => unreachable!("arrays are no rows"),
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

/// Writes the chosen part of a log as arrays, which are in memory meanwhile.
fn arrays(log: &Path, choice: &Choice, out: impl Write) -> Result<Exported, ExportError> {
    only_samples(&choice.channels)?;
    let (columns, ending) = Arrays::read(log, choice.member, &choice.channels)?;
    let rows = columns.len() as u64;
    let all = columns.into_all();
    if all.len() == TIMES.len() {
        return Err(empty(log, choice));
    }
    npz::write(&all, out).map_err(ExportError::Write)?;
    let names = all.iter().map(|(name, _)| name.to_string()).collect();
    Ok(Exported { rows, columns: names, ending })
}

fn empty(log: &Path, choice: &Choice) -> ExportError {
    let all = choice.channels.is_empty();
    let topics = if all { "samples".to_owned() } else { topics(&choice.channels) };
    let asked = match choice.member {
        0 => topics,
        member => format!("{topics} of member {member}"),
    };
    ExportError::Empty { log: log.display().to_string(), asked }
}

/// Refuses channels that are not of samples.
fn only_samples(channels: &[Channel]) -> Result<(), ExportError> {
    let other = channels.iter().find(|channel| !Message::CHANNELS.contains(channel));
    let with = if channels.len() > 1 { " together with others" } else { " as samples" };
    other.map_or(Ok(()), |channel| Err(ExportError::Channel { channel: channel.topic(), with }))
}

/// Passes on the rows of the chosen part.
fn each(
    log: &Path,
    choice: &Choice,
    mut visit: impl FnMut(Vec<Field>) -> ControlFlow<()>,
) -> Result<Ending, ExportError> {
    let all = choice.channels.is_empty();
    let channels = if all { Message::CHANNELS } else { &choice.channels[..] };
    if let [channel @ (Channel::EnsembleMembers | Channel::EnsembleStatistics)] = *channels {
        return Ok(reader::read(log, |item| {
            let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
            if topic != channel.topic() {
                return ControlFlow::Continue(());
            }
            let fields = if channel == Channel::EnsembleMembers {
                Member::decode(data).map(|found| of_member(&found))
            } else {
                EnsembleStatistics::decode(data).map(|found| of_statistics(&found))
            };
            fields.map_or(ControlFlow::Continue(()), &mut visit)
        })?);
    }
    only_samples(channels)?;
    let mut start_ns = None;
    Ok(read_rows(log, choice.member, |row| {
        let start_ns = *start_ns.get_or_insert(row.time_ns);
        visit(of_row(&row, channels, start_ns))
    })?)
}
