//! 4 · Sweeps: many runs over fields of one scenario, one table.
//!
//! A member is the scenario with its values put in by pointer. It is made, run in memory and forgotten; its line of the table
//! stays. [`run`] makes a table or a part of one, [`merge`] the whole from its parts, [`Sweep::plan`] is where the log of a
//! member begins. The members of a scenario's `ensemble` are something else: they differ in their start alone, go side by
//! side in lanes, and their ends and statistics are in one log.
//!
//! Invariant: a line depends on the sweep and its number alone, not on threads, parts or interruptions. No member fails a
//! sweep, and no NaN reaches a table.

use std::fmt;
use std::fs::File;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::advise;
pub(crate) use crate::in_order::cores;
use crate::in_order::in_order;
use crate::log::part;
use crate::plan::Plan;
use crate::scenario::{Scenario, ScenarioError, ensure, from_tree, read_text, read_tree, set};
use crate::study::Watch;

mod file;
mod member;
mod report;
mod score;
#[cfg(feature = "chart")]
mod shown;
pub mod statistics;
mod table;
mod values;

pub use file::SweepFile;
use file::{Combine, Vary};
use member::{Outcome, Row};
pub use report::{Asked, Column, Histogram, Holds, Probability, Report};
#[cfg(feature = "chart")]
pub(crate) use shown::{Cell, Kind, Shown, Side};
pub use table::merge;
use table::{Identity, Part, cell, figure};
use values::{Axis, Sequence};

/// Largest number of members of a sweep.
pub const MOST_MEMBERS: u64 = 1_000_000;

/// A sweep that can be run.
#[derive(Clone, Debug)]
pub struct Sweep {
    file: SweepFile,
    /// The scenario that is varied.
    base: Scenario,
    /// The same scenario as a tree.
    tree: Value,
    axes: Vec<Axis>,
    members: u64,
    columns: Vec<String>,
}

impl Sweep {
    /// Reads and checks the file of a sweep; a relative path of its scenario starts at that file.
    ///
    /// # Errors
    /// [`SweepError::Io`] if it cannot be read, else those of [`Sweep::from_json`].
    pub fn read(path: &Path) -> Result<Self, SweepError> {
        let text = |path: &Path| File::open(path).and_then(read_text);
        let failed = |source| SweepError::io(path, "read", source);
        let tree = read_tree(&text(path).map_err(failed)?)?;
        let open = |name: &str| {
            let scenario = path.parent().unwrap_or(Path::new("")).join(name);
            text(&scenario).map_err(|error| {
                let message = format!("{}: {error}", scenario.display());
                ScenarioError::invalid("/scenario", message)
            })
        };
        Ok(Self::new(from_tree(tree)?, open)?)
    }

    /// Reads and checks a sweep that holds its scenario.
    ///
    /// # Errors
    /// The first fault found, with the pointer of its field. A fault of a member alone is none: it
    /// is reported in its line.
    pub fn from_json(text: &[u8]) -> Result<Self, ScenarioError> {
        Self::from_tree(read_tree(text)?)
    }

    /// Does the same for a text that was read as JSON.
    pub(crate) fn from_tree(tree: Value) -> Result<Self, ScenarioError> {
        let open = |_: &str| {
            let message = "is the path of a file; here the scenario itself is needed";
            Err(ScenarioError::invalid("/scenario", message))
        };
        Self::new(from_tree(tree)?, open)
    }

    fn new(
        mut file: SweepFile,
        open: impl FnOnce(&str) -> Result<Vec<u8>, ScenarioError>,
    ) -> Result<Self, ScenarioError> {
        let text = match &file.scenario {
            Value::String(path) => open(path)?,
            scenario => scenario.to_string().into_bytes(),
        };
        let within = |error: ScenarioError| ScenarioError {
            pointer: format!("/scenario{}", error.pointer),
            ..error
        };
        let base = Scenario::from_json(&text).map_err(within)?;
        ensure(base.ensemble.is_none(), "/scenario/ensemble", || {
            "is not allowed in a sweep: each member is one run".into()
        })?;
        let tree = serde_json::to_value(&base).expect("a scenario is JSON by construction");
        // The scenario is kept as it is now, whatever becomes of the file that it came from.
        file.scenario = tree.clone();
        let n = base.dimension();
        let ends = end_columns(&base);
        file.check(n, &ends.concat())?;
        file.check_bodies(&base)?;
        file.check_skips(&base)?;
        file.check_pointing(&base)?;
        let members = file.members()?;
        for (at, &member) in file.keep_logs.iter().enumerate() {
            ensure(member < members, format!("/keep_logs/{at}"), || {
                format!("{member} given, the members are numbered from 0 to {}", members - 1)
            })?;
        }
        let [head, tail] = ends;
        let varied = file.vary.iter().map(|field| field.column().to_owned());
        let scores = file.scores.iter().map(|score| score.name.clone());
        let columns = head[..1].iter().cloned().chain(varied).chain(head[1..].iter().cloned());
        let columns = columns.chain(tail).chain(scores).collect();
        let axis = |(at, field): (usize, &Vary)| {
            let weights = file.correlation.iter().flat_map(|it| it.weights(&file.vary, at));
            let axis = Axis::new(&field.values, file.seed, at, weights.collect());
            let (fields, rows) = (file.vary.len() as u64, field.values.count() / 2);
            match file.combine {
                Combine::Saltelli => axis.in_sequence(Sequence { fields, rows }),
                Combine::Product | Combine::SideBySide => axis,
            }
        };
        let axes = file.vary.iter().enumerate().map(axis).collect();
        let sweep = Self { file, base, tree, axes, members, columns };
        sweep.check_form()?;
        Ok(sweep)
    }

    /// Checks that the values of the first member are set in fields that a scenario has: a pointer
    /// with a slip in it would have every member refused.
    fn check_form(&self) -> Result<(), ScenarioError> {
        let mut document = self.tree.clone();
        for (at, (Vary { pointer, .. }, value)) in
            self.file.vary.iter().zip(self.values(0)).enumerate()
        {
            set(&mut document, pointer, value).map_err(|error| ScenarioError {
                pointer: format!("/vary/{at}/pointer"),
                message: format!("{pointer}: {}", error.message),
                ..error
            })?;
        }
        from_tree::<Scenario>(document).map(drop).map_err(|error| {
            let ScenarioError { pointer, message, .. } = error;
            let close = |field: &Vary| {
                field.pointer.starts_with(&pointer) || pointer.starts_with(&field.pointer)
            };
            let at = self.file.vary.iter().position(close);
            let at = at.map_or_else(|| "/vary".to_owned(), |at| format!("/vary/{at}"));
            ScenarioError::invalid(at, format!("with the values of member 0, {pointer}: {message}"))
        })
    }

    /// Returns the sweep as JSON, with the scenario that it varies.
    #[cfg(feature = "cluster")]
    pub(crate) fn to_json(&self) -> Vec<u8> {
        serde_json::to_vec(&self.file).expect("a sweep is JSON by construction")
    }

    /// Returns the name of the scenario.
    pub fn name(&self) -> &str {
        self.base.name()
    }

    /// Returns the number of members.
    pub fn members(&self) -> u64 {
        self.members
    }

    /// Returns the members whose logs are to be kept.
    pub fn kept_logs(&self) -> &[u64] {
        &self.file.keep_logs
    }

    /// Returns the heads of the table's columns.
    pub fn columns(&self) -> &[String] {
        &self.columns
    }

    /// Returns about how long it takes on one core, in seconds, and the bytes of its table: by the
    /// first, the middle and the last member, as far as they are runs.
    ///
    /// # Errors
    /// If one of them asks for an accuracy: its cost is not known before.
    #[cfg(feature = "serve")]
    pub(crate) fn estimate(&self) -> Result<(f64, u64), ScenarioError> {
        /// Bytes of a line, for each of its cells.
        const CELL_BYTES: u64 = 20;
        let looked_at = [0, self.members / 2, self.members - 1];
        let mut seconds = Vec::with_capacity(looked_at.len());
        for member in looked_at {
            let Ok(scenario) = self.scenario(member) else { continue };
            ensure(scenario.accuracy.is_none(), "/scenario/accuracy", || {
                "is not allowed in a sweep of the service; give `method` and `step_s`".into()
            })?;
            seconds.extend(Plan::new(&scenario).map(|plan| plan.work_s));
        }
        // The shadow of a Lyapunov exponent takes as long as the run.
        let runs = if self.file.has_exponent() { 2.0 } else { 1.0 };
        let mean = seconds.iter().sum::<f64>() / seconds.len().max(1) as f64;
        let bytes = self.members * self.columns.len() as u64 * CELL_BYTES;
        Ok((runs * mean * self.members as f64, bytes))
    }

    /// Returns the SHA-256 of everything that the table depends on, in hexadecimal digits.
    pub fn digest(&self) -> String {
        let SweepFile { scenario, vary, combine, correlation, seed, scores, .. } = &self.file;
        let mut text = json!({
            "scenario": scenario, "vary": vary, "combine": combine, "seed": seed, "scores": scores,
        });
        if let Some(correlation) = correlation {
            text["correlation"] = json!(correlation);
        }
        let digest = Sha256::digest(text.to_string().as_bytes());
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Returns the varied values of a member, in the order of their fields.
    fn values(&self, member: u64) -> Vec<Value> {
        let places = self.places(member);
        self.axes.iter().zip(places).map(|(axis, at)| axis.value(at)).collect()
    }

    /// Returns the number of the value of each field for a member.
    fn places(&self, member: u64) -> Vec<u64> {
        let counts = self.file.vary.iter().map(|field| field.values.count());
        match self.file.combine {
            Combine::SideBySide => counts.map(|_| member).collect(),
            Combine::Saltelli => {
                // A row is A, B, and A with field k of B for each k.
                let members = self.axes.len() as u64 + 2;
                let (row, kind) = (member / members, member % members);
                let second = |field: u64| kind == 1 || kind == field + 2;
                let place = |(field, count): (usize, u64)| {
                    if second(field as u64) { count / 2 + row } else { row }
                };
                counts.enumerate().map(place).collect()
            }
            Combine::Product => {
                let mut rest = member;
                let mut places: Vec<u64> = counts
                    .rev()
                    .map(|count| {
                        let place = rest % count;
                        rest /= count;
                        place
                    })
                    .collect();
                places.reverse();
                places
            }
        }
    }

    /// Returns the scenario of a member.
    ///
    /// # Errors
    /// An invalid value, with the pointer of the field in the scenario; a member past the last at
    /// the empty pointer.
    pub fn scenario(&self, member: u64) -> Result<Scenario, ScenarioError> {
        ensure(member < self.members, "", || {
            format!(
                "there is no member {member}: the members are numbered from 0 to {}",
                self.members - 1
            )
        })?;
        self.with(&self.values(member))
    }

    fn with(&self, values: &[Value]) -> Result<Scenario, ScenarioError> {
        let mut document = self.tree.clone();
        for (field, value) in self.file.vary.iter().zip(values) {
            set(&mut document, &field.pointer, value.clone())?;
        }
        let scenario: Scenario = from_tree(document)?;
        scenario.check()?;
        ensure(scenario.ensemble.is_none(), "/ensemble", || {
            "is not allowed in a sweep: each member is one run".into()
        })?;
        let (n, given) = (self.base.dimension(), scenario.dimension());
        ensure(given == n, "/scene/inertia", || {
            format!("n = {given} given; all members must have n = {n}, as in the table")
        })?;
        let names = |scenario: &Scenario| -> Vec<String> {
            let bodies = scenario.bodies().map(|scene| &scene.bodies);
            bodies.into_iter().flatten().map(|body| body.name.clone()).collect()
        };
        ensure(names(&scenario) == names(&self.base), "/scene/bodies", || {
            "has other names; all members must have the bodies of the scenario, as in the table"
                .into()
        })?;
        Ok(scenario)
    }

    /// Returns the plan of a member, for [`crate::run::execute`]: its log is that of `vpd run`, with the motion whose
    /// figures are in the table.
    ///
    /// # Errors
    /// The errors of [`Sweep::scenario`] and [`advise::plan`].
    pub fn plan(&self, member: u64) -> Result<Plan, ScenarioError> {
        advise::plan(&self.scenario(member)?)
    }

    /// Runs a member: returns its line of the table, and why it was refused if it was. `None` if
    /// `stop` was set.
    fn line(&self, member: u64, stop: &Arc<AtomicBool>) -> Option<Line> {
        let values = self.values(member);
        let planned = self.with(&values).and_then(|scenario| member::plan(&scenario, stop));
        let outcome = match planned {
            Ok(plan) => member::run(&plan, &self.file.scores, stop)?,
            // A member that was stopped is not refused.
            Err(_) if stop.load(Ordering::Relaxed) => return None,
            Err(error) => Outcome::Refused(error),
        };
        let mut cells = Vec::with_capacity(self.columns.len());
        cells.push(member.to_string());
        cells.extend(values.iter().map(cell));
        let (outcome, code, row, refusal) = match outcome {
            Outcome::Succeeded(row) => ("succeeded", "", Some(row), None),
            Outcome::Failed(code, row) => ("failed", code, Some(row), None),
            Outcome::Refused(error) => ("refused", "invalid_input", None, Some(error)),
        };
        cells.extend([outcome, code].map(str::to_owned));
        if let Some(Row { time_s, state, figures, scores }) = row {
            let errors = [
                figures.energy_max_abs_error,
                figures.orthogonality_max,
                figures.momentum_max_drift,
            ];
            let figures = [Some(time_s)].into_iter().chain(state).chain(errors).chain(scores);
            cells.extend(figures.map(figure));
        }
        cells.resize(self.columns.len(), String::new());
        Some(Line { text: table::line(&cells), outcome, refusal })
    }
}

/// A line of the table.
struct Line {
    text: String,
    outcome: &'static str,
    refusal: Option<ScenarioError>,
}

/// Names of the coordinates for n = 3.
const AXES: [&str; 3] = ["x", "y", "z"];

/// Returns the heads of the columns that every table has: before the varied values and after them
/// up to the outcome, then the rest.
fn end_columns(base: &Scenario) -> [Vec<String>; 2] {
    let n = base.dimension();
    let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect::<Vec<_>>();
    let head = names(&["member", "outcome", "code"]);
    let mut tail = names(&["time_s"]);
    let mut turning = Vec::new();
    if n == 3 {
        turning.extend(["w", "x", "y", "z"].map(|name| format!("quaternion_{name}")));
        turning.extend(AXES.map(|name| format!("body_momentum_{name}")));
    } else {
        let pairs = || (1..=n).flat_map(|i| (1..=n).map(move |j| (i, j)));
        turning.extend(pairs().map(|(i, j)| format!("attitude_{i}_{j}")));
        let above = pairs().filter(|(i, j)| i < j);
        turning.extend(above.map(|(i, j)| format!("body_momentum_{i}_{j}")));
    }
    match base.bodies() {
        None => tail.extend(turning),
        Some(scene) => {
            let axis = |i: usize| if n == 3 { AXES[i].to_owned() } else { (i + 1).to_string() };
            let of = |name: &str| (0..n).map(|i| format!("{name}_{}", axis(i))).collect::<Vec<_>>();
            let moving = ["position", "linear_momentum"].map(of).concat();
            for body in &scene.bodies {
                let columns = turning.iter().chain(&moving);
                tail.extend(columns.map(|column| format!("{}_{column}", body.name)));
            }
        }
    }
    tail.extend(names(&["energy_error_max", "orthogonality_error_max", "momentum_drift_max"]));
    [head, tail]
}

/// Returns the JSON Schema of a sweep, generated from the types.
pub fn schema() -> Value {
    schemars::schema_for!(SweepFile).to_value()
}

/// One of several parts of a sweep, for array jobs: the first is `1/N`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Number of the part, from 1 on.
    number: u64,
    /// Number of all parts.
    of: u64,
}

impl Shard {
    /// Returns the members that belong to it; all shards together have each once.
    fn range(self, members: u64) -> Range<u64> {
        let before =
            |number: u64| (u128::from(members) * u128::from(number) / u128::from(self.of)) as u64;
        before(self.number - 1)..before(self.number)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let shard = text.split_once('/').and_then(|(number, of)| {
            Some(Self { number: number.parse().ok()?, of: of.parse().ok()? })
        });
        shard
            .filter(|shard| (1..=MOST_MEMBERS).contains(&shard.of))
            .filter(|shard| (1..=shard.of).contains(&shard.number))
            .ok_or_else(|| {
                format!(
                    "{text:?} given; i/N is needed, with i from 1 to N and N up to {MOST_MEMBERS}"
                )
            })
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-of-{}", self.number, self.of)
    }
}

/// Outcomes of members.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Number of members that made all their steps.
    pub succeeded: u64,
    /// Number of members of which a step could not be made.
    pub failed: u64,
    /// Number of members whose values make no scenario.
    pub refused: u64,
}

impl Counts {
    fn add(&mut self, outcome: &str) {
        match outcome {
            "succeeded" => self.succeeded += 1,
            "failed" => self.failed += 1,
            _ => self.refused += 1,
        }
    }
}

/// Options of the run of a sweep.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Number of threads.
    pub threads: usize,
    /// The only part of it to run; the table is then one for [`merge`].
    pub shard: Option<Shard>,
    /// Whether a file in the place of the table is replaced: a finished table, or an unfinished one
    /// of something else.
    pub replaces: bool,
}

/// Summary of a table that was made.
#[derive(Clone, Debug, PartialEq)]
pub struct Made {
    /// Outcomes of the members.
    pub counts: Counts,
    /// Members whose lines an earlier run had made.
    pub resumed: u64,
    /// The member whose line in the unfinished table was damaged: it and those after it were run again.
    pub damaged: Option<u64>,
    /// The first member that was refused in this run, and why.
    pub first_refused: Option<(u64, ScenarioError)>,
}

/// Runs a sweep, or resumes what an interrupted run left in `table.part`: the table is the same,
/// byte for byte. Blocks. `watch` counts members, and stops it. `finish` is called when all lines
/// are there, before the table gets its name; it is given the members of this run.
///
/// # Errors
/// If the table cannot be written, something else is in its place, or the run is interrupted; those
/// of `finish`.
pub fn run<E: From<SweepError>>(
    sweep: &Sweep,
    table: &Path,
    options: Options,
    watch: &Watch,
    finish: impl FnOnce(Range<u64>) -> Result<(), E>,
) -> Result<Made, E> {
    /// Lines are brought to the disk about this often; a kill alone loses none.
    const SYNC: Duration = Duration::from_secs(10);
    let Options { threads, shard, replaces } = options;
    let Shard { number, of } = shard.unwrap_or(Shard { number: 1, of: 1 });
    let members = Shard { number, of }.range(sweep.members);
    let identity = Identity {
        sweep: sweep.digest(),
        build: env!("VPD_BUILD").to_owned(),
        members: sweep.members,
        first: members.start,
        end: members.end,
        shard: (number, of),
    };
    let head = table::line(&sweep.columns);
    let head = head.trim_end();
    let whole = shard.is_none();
    // An array job that is started again finds its finished part.
    if !whole
        && !replaces
        && let Some(counts) = table::finished(table, &identity, head)
    {
        let resumed = members.end - members.start;
        return Ok(Made { counts, resumed, damaged: None, first_refused: None });
    }
    let mut part = Part::open(table, &identity, head, replaces)?;
    watch.total.store(members.end - members.start, Ordering::Relaxed);
    let resumed = part.next - members.start;
    watch.done.store(resumed, Ordering::Relaxed);
    let mut first_refused = None;
    let mut synced = Instant::now();
    let stop = &watch.cancelled;
    in_order(
        part.next..members.end,
        1,
        threads,
        |turns| {
            while let Some(places) = turns.take() {
                let line = sweep.line(places.start, stop)?;
                turns.give(places, line)?;
            }
            Some(())
        },
        |Line { text, outcome, refusal }| {
            part.append(&text)?;
            part.counts.add(outcome);
            if let Some(refusal) = refusal.filter(|_| first_refused.is_none()) {
                first_refused = Some((part.next, refusal));
            }
            part.next += 1;
            watch.done.fetch_add(1, Ordering::Relaxed);
            if synced.elapsed() > SYNC {
                part.sync()?;
                synced = Instant::now();
            }
            Ok::<(), SweepError>(())
        },
    )?;
    if part.next < members.end {
        part.sync()?;
        return Err(SweepError::Interrupted { left: members.end - part.next }.into());
    }
    finish(members)?;
    let (counts, damaged) = (part.counts, part.damaged);
    part.finish(whole)?;
    Ok(Made { counts, resumed, damaged, first_refused })
}

/// Error that ends a sweep or a merge early.
#[derive(Debug, thiserror::Error)]
pub enum SweepError {
    /// A field of the sweep is wrong.
    #[error("{}: {}", if .0.pointer.is_empty() { "the sweep" } else { &.0.pointer }, .0.message)]
    Field(#[from] ScenarioError),
    /// A file cannot be read or written.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Operation that failed.
        action: &'static str,
        /// Error of the system.
        source: io::Error,
    },
    /// The file in the place of the table is to be kept.
    #[error("{} already exists{}; --force replaces it, -o names another file", path.display(), unfinished(*finished))]
    Exists {
        /// The file.
        path: PathBuf,
        /// Whether it is a finished table.
        finished: bool,
    },
    /// What is in the place of the table is no regular file.
    #[error("cannot write {}: it is {kind}, which nothing replaces; name a regular file", path.display())]
    NoFile {
        /// The place.
        path: PathBuf,
        /// What is there: "a device", "a pipe", ...
        kind: &'static str,
    },
    /// It was cancelled.
    #[error("the sweep was interrupted with {left} members left; the same command resumes it")]
    Interrupted {
        /// Members without a line.
        left: u64,
    },
    /// There is nothing to merge.
    #[error("no parts are given")]
    NoParts,
    /// A file that is no part, or has more lines than its first one says.
    #[error("{} is not a part of a sweep: `vpd sweep --shard i/N` writes parts", path.display())]
    NoPart {
        /// The file.
        path: PathBuf,
    },
    /// A part without all its lines.
    #[error("{} is unfinished or damaged: members {} to {} are missing", path.display(), missing.0, missing.1)]
    Unfinished {
        /// The file.
        path: PathBuf,
        /// The first and the last member without a line.
        missing: (u64, u64),
    },
    /// Parts of two sweeps.
    #[error("{} and {} are parts of different sweeps", .0.0.display(), .0.1.display())]
    OtherSweep(Box<(PathBuf, PathBuf)>),
    /// Parts of two builds.
    #[error("{} and {} were made by different builds of vpd: their numbers may differ", .0.0.display(), .0.1.display())]
    OtherBuild(Box<(PathBuf, PathBuf)>),
    /// Parts with the same members that are not the same part.
    #[error("{} and {} hold the same members, but are not the same part", .0.0.display(), .0.1.display())]
    Overlap(Box<(PathBuf, PathBuf)>),
    /// A part is not there.
    #[error("{} missing: no part holds members {} to {}", words(shards, *of), members.0, members.1)]
    Missing {
        /// The first and the last of the members.
        members: (u64, u64),
        /// The shards that hold them, at most ten.
        shards: Vec<u64>,
        /// Number of all shards.
        of: u64,
    },
    /// A table that is not of this sweep.
    #[error("{} is not a table of this sweep", path.display())]
    NoTable {
        /// The file.
        path: PathBuf,
    },
}

impl SweepError {
    pub(crate) fn io(path: &Path, action: &'static str, source: io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }

    /// Returns whether the input is wrong, and not the execution.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Io { action, source, .. } => *action == "read" || part::is_busy(source),
            Self::Interrupted { .. } => false,
            _ => true,
        }
    }
}

fn unfinished(finished: bool) -> &'static str {
    if finished { "" } else { ", unfinished and of another sweep, part or build" }
}

/// Returns `shard 2/4 is`, for a list of shards.
fn words(shards: &[u64], of: u64) -> String {
    let named: Vec<String> = shards.iter().map(|number| format!("{number}/{of}")).collect();
    match named.as_slice() {
        [one] => format!("shard {one} is"),
        many => format!("shards {} are", many.join(", ")),
    }
}
