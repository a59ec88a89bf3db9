//! The command line: arguments → one call each. Errors go to stderr, data to stdout.
//!
//! Exit codes: 0 ok, 1 the run failed (its log is kept and finished) or two logs differ, 2 bad input or a file that is not to
//! be replaced, 130 interrupted. A reader that closes the pipe has read enough: that is no error.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use clap::builder::{PathBufValueParser, TypedValueParser};
use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use crate::advise;
#[cfg(feature = "chart")]
use crate::chart;
#[cfg(feature = "serve")]
use crate::client::ClientError;
use crate::diff::DiffError;
use crate::export::ExportError;
use crate::fit::FitError;
use crate::log::inspect::inspect;
use crate::log::part::irreplaceable;
use crate::log::reader::is_log;
use crate::log::{self, LAYOUT, LogError};
use crate::plan::Plan;
use crate::run::{self, Control, JobContext, Outcome, RunError, Summary};
use crate::scenario::{self, Scenario, ScenarioError};
#[cfg(feature = "serve")]
use crate::serve::{ServeError, apart};
use crate::study::StudyError;
use crate::study::lyapunov::ExponentsError;
use crate::sweep::SweepError;
use crate::verify::{self, VerifyError};

mod fit;
mod logs;
mod lyapunov;
mod report;
#[cfg(feature = "serve")]
mod process;
#[cfg(feature = "serve")]
mod remote;
#[cfg(feature = "serve")]
mod serve;
#[cfg(feature = "chart")]
mod study;
mod sweep;
mod text;
#[cfg(feature = "serve")]
mod worker;

/// Rotating bodies on SO(n): symplectic, on the group to round-off, logged as MCAP.
#[derive(Debug, Parser)]
#[command(name = "vpd", version, about)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a scenario here and write its log.
    Run(RunArgs),
    /// Say what a scenario will model and why, without running it.
    Plan(PlanArgs),
    /// Draw a scenario's speed against accuracy, orders and long-term energy, or what logs hold, as SVG.
    #[cfg(feature = "chart")]
    Chart(study::ChartArgs),
    /// Find the steps at which each method fails on a scenario: a map and the largest usable steps.
    #[cfg(feature = "chart")]
    Stability(study::StabilityArgs),
    /// Find out how fast neighbouring motions of a scenario part: all its Lyapunov exponents.
    Lyapunov(lyapunov::LyapunovArgs),
    /// Fit fields of a scenario, an inertia say, to attitudes that were seen.
    Fit(fit::FitArgs),
    /// Run a scenario many times over values of its fields: one table, with a line a run.
    Sweep(sweep::SweepArgs),
    /// Say what the table of a sweep says: quantiles, probabilities, which field matters, and how sure all that is.
    Report(report::ReportArgs),
    /// Put the parts of a sweep, from --shard, together to its table.
    Merge(sweep::MergeArgs),
    /// Take jobs over HTTP, run them on worker threads, hand out their logs.
    #[cfg(feature = "serve")]
    Serve(serve::ServeArgs),
    /// Run jobs that a service with --engine cluster takes, one of many workers.
    #[cfg(feature = "serve")]
    #[command(hide = !process::CLUSTER)]
    Worker(worker::WorkerArgs),
    /// Send a scenario to a service as a job.
    #[cfg(feature = "serve")]
    Submit(remote::SubmitArgs),
    /// List the newest jobs of a service.
    #[cfg(feature = "serve")]
    Jobs(remote::JobsArgs),
    /// Fetch the log of a job of a service.
    #[cfg(feature = "serve")]
    Fetch(remote::FetchArgs),
    /// Sum up a log, finished or not.
    Inspect(InspectArgs),
    /// Run the job inside a log again and compare every sample bit for bit.
    Verify(InspectArgs),
    /// Write what a log holds as a table: CSV, or Parquet and Arrow.
    Export(logs::ExportArgs),
    /// Compare the motions in two logs over time.
    Diff(logs::DiffArgs),
    /// Print the JSON Schema of a scenario or of a sweep.
    Schema(SchemaArgs),
    /// Print a script that completes this command line in a shell: vpd completions bash > ~/.local/share/bash-completion/completions/vpd
    Completions {
        /// For which shell.
        #[arg(value_enum)]
        shell: Shell,
    },
    /// Carry out what a service asks for on stdin: its own affair.
    #[cfg(feature = "serve")]
    #[command(hide = true, name = apart::SUBCOMMAND)]
    Apart,
}

/// A scenario from a file, with changes.
#[derive(Debug, Args)]
struct ScenarioArgs {
    /// The scenario, a JSON file; - reads it from stdin.
    scenario: PathBuf,
    /// Change a field, named by its JSON pointer: --set /method/tableau=gauss3 --set /step_s=0.02; null removes it.
    #[arg(long = "set", value_name = "POINTER=VALUE")]
    changes: Vec<Change>,
}

impl ScenarioArgs {
    fn is_stdin(&self) -> bool {
        self.scenario == Path::new("-")
    }

    /// Returns the file for messages.
    fn path(&self) -> &Path {
        if self.is_stdin() { Path::new("stdin") } else { &self.scenario }
    }

    /// Reads the text and applies the changes.
    fn text(&self) -> Result<Vec<u8>, CliError> {
        let path = self.path();
        let read = if self.is_stdin() {
            scenario::read_text(io::stdin())
        } else {
            fs::File::open(path).and_then(scenario::read_text)
        };
        let text = read.map_err(|source| CliError::Read { path: path.to_owned(), source })?;
        if self.changes.is_empty() {
            return Ok(text);
        }
        let wrong = |source| CliError::Scenario { path: path.to_owned(), source };
        let changes =
            self.changes.iter().map(|Change { pointer, value }| (pointer.clone(), value.clone()));
        scenario::with_changes(&text, changes).map_err(wrong)
    }
}

/// One change of a scenario.
#[derive(Clone, Debug)]
struct Change {
    pointer: String,
    value: serde_json::Value,
}

impl FromStr for Change {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wanted = || format!("{text:?} is not of the form /pointer/to/field=value");
        let (pointer, value) = text.split_once('=').ok_or_else(wanted)?;
        if !pointer.starts_with('/') {
            let slash = if pointer.is_empty() { String::new() } else { format!("; write /{text}") };
            return Err(wanted() + &slash);
        }
        // Text that is not JSON is taken as a string, so that names need no quotes.
        let value = serde_json::from_slice(value.as_bytes()).unwrap_or_else(|_| value.into());
        Ok(Self { pointer: pointer.to_owned(), value })
    }
}

#[derive(Debug, Args)]
struct RunArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// The log; by default the scenario's file name with .mcap, in the current directory; of stdin the scenario's `name`.
    #[arg(short, long, value_name = "FILE.mcap", value_parser = PathBufValueParser::new().try_map(log_path))]
    output: Option<PathBuf>,
    /// Keep no log: only the summary is wanted. A run that is stopped then begins anew.
    #[arg(long, conflicts_with_all = ["output", "layouts"])]
    no_log: bool,
    /// Print one JSON summary on stdout.
    #[arg(long)]
    json: bool,
    /// Write layouts for Foxglove and Lichtblick next to the log.
    #[arg(long)]
    layouts: bool,
    /// Compute a reference afterwards and report the error of the last state.
    #[arg(long)]
    error: bool,
    /// Overwrite an existing log: a finished one, or an unfinished one of another scenario. That of a run of the same name
    /// that failed needs no force.
    #[arg(long)]
    force: bool,
}

/// Checks the names in the path of an output: one that is too long is refused before anything is computed for it.
fn output_path(path: PathBuf) -> Result<PathBuf, String> {
    /// File systems take 255 bytes, and `.part` is added while a file is written.
    const MOST: usize = 250;
    match path.iter().map(OsStr::len).max().unwrap_or(0) {
        ..=MOST => Ok(path),
        bytes => Err(format!(
            "a file or folder with a name of {bytes} bytes, at most {MOST} are allowed"
        )),
    }
}

/// Checks the path of a log to be written: other programs must not read its name as another format.
fn log_path(path: PathBuf) -> Result<PathBuf, String> {
    let path = output_path(path)?;
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    if path == Path::new("-") {
        return Err(
            "a log needs its place on the disk, so that it can be resumed: name a file".to_owned()
        );
    }
    let other = match ending.to_str() {
        Some("csv" | "npz" | "parquet" | "arrow") => {
            format!("`vpd export LOG.mcap -o {}` makes a table of it", path.display())
        }
        Some("json") => "`vpd inspect LOG.mcap --json` sums it up as JSON".to_owned(),
        _ => return Ok(path),
    };
    Err(format!("the output is an MCAP log, name it .mcap; {other}"))
}

/// Checks the path of a picture: it may replace another, but not a log or a table.
#[cfg(feature = "chart")]
fn picture_path(path: &str) -> Result<PathBuf, String> {
    let path = output_path(PathBuf::from(path))?;
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("svg")) {
        Ok(path)
    } else {
        Err("the picture is an SVG file, name it .svg".to_owned())
    }
}

#[derive(Debug, Args)]
struct PlanArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct InspectArgs {
    /// The log.
    log: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct SchemaArgs {
    /// Kind of file that the schema describes.
    #[arg(value_enum, default_value_t)]
    of: SchemaOf,
}

#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum SchemaOf {
    #[default]
    Scenario,
    Sweep,
}

/// Error that ends a command early.
#[derive(Debug, thiserror::Error)]
enum CliError {
    #[error("{}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("cannot write {}: {source}", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("{}: {source}", path.display())]
    Scenario { path: PathBuf, source: ScenarioError },
    #[error("{}: {}: {}", path.display(), if source.pointer.is_empty() { "the sweep" } else { &source.pointer }, source.message)]
    Sweep { path: PathBuf, source: ScenarioError },
    #[error("{}: member {member}: {source}", path.display())]
    Member { path: PathBuf, member: u64, source: ScenarioError },
    #[error(transparent)]
    Table(#[from] SweepError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("{0}")]
    Log(#[from] LogError),
    #[error("{} already exists; --force replaces it, -o names another file", .0.display())]
    Exists(PathBuf),
    #[error("cannot write {}: it is {kind}, which nothing replaces; name a regular file", path.display())]
    NoFile { path: PathBuf, kind: &'static str },
    #[error("{0}")]
    Format(String),
    #[error(transparent)]
    Export(#[from] ExportError),
    #[error(transparent)]
    Diff(#[from] DiffError),
    #[error("{}: {source}", path.display())]
    Verify { path: PathBuf, source: VerifyError },
    #[cfg(feature = "chart")]
    #[error(transparent)]
    Chart(#[from] chart::ChartError),
    #[error(transparent)]
    Study(#[from] StudyError),
    #[error(transparent)]
    Fit(FitError),
    #[error(transparent)]
    Exponents(ExponentsError),
    #[cfg(feature = "chart")]
    #[error("scenarios and logs cannot be mixed: give only scenarios, or only logs")]
    Mixed,
    #[cfg(feature = "serve")]
    #[error(transparent)]
    Serve(#[from] ServeError),
    #[cfg(feature = "serve")]
    #[error(transparent)]
    Client(#[from] ClientError),
    #[cfg(feature = "serve")]
    #[error("{}: {source}", path.display())]
    Refused { path: PathBuf, source: ClientError },
    #[cfg(feature = "serve")]
    #[error("{0}")]
    Tokens(String),
    #[cfg(feature = "serve")]
    #[error("cannot listen on {address}: {source}")]
    Listen { address: std::net::SocketAddr, source: io::Error },
    #[cfg(all(feature = "serve", not(feature = "cluster")))]
    #[error(
        "{wanted} needs a program that was built with the feature {feature}: cargo build --release --features {feature}"
    )]
    Feature { wanted: &'static str, feature: &'static str },
    #[cfg(feature = "cluster")]
    #[error(transparent)]
    SweepOn(#[from] crate::serve::SweepOnError),
    #[cfg(feature = "cluster")]
    #[error("{wanted} is needed to work with other machines")]
    Needed { wanted: &'static str },
    #[cfg(feature = "cluster")]
    #[error("--bucket (or VPD_BUCKET) can be used only with --engine cluster")]
    BucketAlone,
    #[cfg(feature = "cluster")]
    #[error(
        "--foxglove-listen (or VPD_FOXGLOVE_LISTEN) shows jobs of this machine; with --engine cluster there are none"
    )]
    NoView,
    #[error("cannot write to stdout: {0}")]
    Output(#[from] io::Error),
}

impl CliError {
    fn exit_code(&self) -> Status {
        match self {
            Self::Read { .. }
            | Self::Scenario { .. }
            | Self::Sweep { .. }
            | Self::Member { .. }
            | Self::Exists(_)
            | Self::NoFile { .. }
            | Self::Format(_)
            | Self::Log(_)
            | Self::Export(ExportError::Log(_) | ExportError::Channel { .. } | ExportError::Empty { .. } | ExportError::Time { .. })
            // 1 says that they differ.
            | Self::Diff(_)
            | Self::Fit(FitError::Scenario(_) | FitError::Seen(_) | FitError::Undetermined(_))
            | Self::Study(StudyError::Scenario(_)) => Status::from(2),
            Self::Table(error) if error.is_bad_input() => Status::from(2),
            Self::Table(SweepError::Interrupted { .. }) => Status::from(130),
            Self::Run(RunError::Log(error))
                if error.is_busy() || matches!(error.code(), "log_exists" | "not_a_file") =>
            {
                Status::from(2)
            }
            #[cfg(feature = "chart")]
            Self::Chart(chart::ChartError::NoFile { .. }) => Status::from(2),
            // As a shell reports a program that SIGINT ended.
            Self::Run(RunError::Interrupted) | Self::Exponents(ExponentsError::Cancelled) => {
                Status::from(130)
            }
            #[cfg(feature = "chart")]
            Self::Mixed => Status::from(2),
            #[cfg(feature = "serve")]
            Self::Client(ClientError::Stopped) | Self::Refused { source: ClientError::Stopped, .. } => {
                Status::from(130)
            }
            #[cfg(feature = "serve")]
            Self::Client(ClientError::Address { .. } | ClientError::Problem { .. })
            | Self::Refused { source: ClientError::Address { .. } | ClientError::Problem { .. }, .. } => {
                Status::from(2)
            }
            #[cfg(feature = "serve")]
            Self::Tokens(_) | Self::Serve(ServeError::Unguarded { .. }) => Status::from(2),
            #[cfg(feature = "serve")]
            Self::Serve(ServeError::Data { source, .. })
                if matches!(source.kind(), ErrorKind::NotADirectory | ErrorKind::InvalidFilename) =>
            {
                Status::from(2)
            }
            #[cfg(all(feature = "serve", not(feature = "cluster")))]
            Self::Feature { .. } => Status::from(2),
            #[cfg(feature = "cluster")]
            Self::Needed { .. } | Self::BucketAlone | Self::NoView => Status::from(2),
            #[cfg(feature = "cluster")]
            Self::Serve(ServeError::Cluster(error)) if error.is_bad_input() => Status::from(2),
            #[cfg(feature = "cluster")]
            Self::SweepOn(error) if error.is_bad_input() => Status::from(2),
            _ => Status::from(1),
        }
    }
}

/// The exit code of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Status(u8);

impl Status {
    const SUCCESS: Self = Self(0);
}

impl From<u8> for Status {
    fn from(code: u8) -> Self {
        Self(code)
    }
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    // Bad arguments end in clap with exit code 2.
    ExitCode::from(obey(Cli::parse()).0)
}

/// Runs a command line that another program was given, under the name that comes first, and returns its exit code. A service
/// starts `program` in this place for what it does in a separate process.
pub fn run_as(program: PathBuf, arguments: impl IntoIterator<Item = OsString>) -> u8 {
    #[cfg(feature = "serve")]
    process::set_program(program);
    #[cfg(not(feature = "serve"))]
    drop(program);
    match Cli::try_parse_from(arguments) {
        Ok(cli) => obey(cli).0,
        Err(said) => {
            let _ = said.print();
            said.exit_code() as u8
        }
    }
}

fn obey(cli: Cli) -> Status {
    let done = match cli.command {
        Command::Run(args) => run(&args),
        Command::Plan(args) => plan(&args),
        #[cfg(feature = "chart")]
        Command::Chart(args) => study::draw(&args),
        #[cfg(feature = "chart")]
        Command::Stability(args) => study::map(&args),
        Command::Lyapunov(args) => lyapunov::lyapunov(&args),
        Command::Fit(args) => fit::fit(&args),
        Command::Sweep(args) => sweep::sweep(&args),
        Command::Report(args) => report::report(&args),
        Command::Merge(args) => sweep::merge(&args),
        #[cfg(feature = "serve")]
        Command::Serve(args) => serve::serve(&args),
        #[cfg(feature = "serve")]
        Command::Worker(args) => worker::work(&args),
        #[cfg(feature = "serve")]
        Command::Submit(args) => remote::submit(&args),
        #[cfg(feature = "serve")]
        Command::Jobs(args) => remote::jobs(&args),
        #[cfg(feature = "serve")]
        Command::Fetch(args) => remote::fetch(&args),
        Command::Inspect(args) => sum_up(&args),
        Command::Verify(args) => verify(&args),
        Command::Export(args) => logs::export(&args),
        Command::Diff(args) => logs::diff(&args),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "vpd", &mut script);
            show(script).map(|()| Status::SUCCESS).map_err(CliError::Output)
        }
        #[cfg(feature = "serve")]
        Command::Apart => apart::child().map(|()| Status::SUCCESS).map_err(CliError::Output),
        Command::Schema(SchemaArgs { of }) => {
            let schema = match of {
                SchemaOf::Scenario => scenario::schema(),
                SchemaOf::Sweep => crate::sweep::schema(),
            };
            print_json(&schema).map(|()| Status::SUCCESS)
        }
    };
    done.unwrap_or_else(|error| {
        // What is said may quote a file, and a closed stderr must not turn an answer into a panic.
        let said: Vec<String> = error.to_string().lines().map(log::shown).collect();
        let _ = writeln!(io::stderr(), "vpd: {}", said.join("\n"));
        error.exit_code()
    })
}

/// Reads a scenario and plans it.
fn planned(args: &ScenarioArgs) -> Result<Plan, CliError> {
    let wrong = |source| CliError::Scenario { path: args.path().to_owned(), source };
    let text = args.text()?;
    let hinted = |error| wrong(hinted(error, &text, SchemaOf::Scenario));
    advise::plan(&Scenario::from_json(&text).map_err(hinted)?).map_err(wrong)
}

/// Adds to the error of a file that is something else what it is, at the field that shows it.
fn hinted(error: ScenarioError, text: &[u8], wanted: SchemaOf) -> ScenarioError {
    let text = scenario::without_mark(text).unwrap_or_default();
    let tree: serde_json::Value = serde_json::from_slice(text).unwrap_or_default();
    let (message, pointer) = match (wanted, tree.get("scene"), tree.get("scenario")) {
        (SchemaOf::Scenario, None, Some(_)) => {
            ("this is a sweep, not a scenario: `vpd sweep` runs it", "/scenario")
        }
        (SchemaOf::Sweep, Some(_), None) => {
            ("this is a scenario, not a sweep: `vpd run` runs it", "/scene")
        }
        _ => return error,
    };
    ScenarioError { message: message.to_owned(), pointer: pointer.to_owned(), ..error }
}

fn run(args: &RunArgs) -> Result<Status, CliError> {
    let plan = planned(&args.scenario)?;
    let log = match &args.output {
        Some(path) => path.clone(),
        None if args.scenario.is_stdin() => {
            let plain = |c: char| if c.is_alphanumeric() { c } else { '-' };
            format!("{}.mcap", plan.asked.name().chars().map(plain).collect::<String>()).into()
        }
        None => named_after(&args.scenario.scenario, "mcap")?,
    };
    // Without a log, it is written where nobody sees it: a run is its samples.
    let unseen = args.no_log.then(tempfile::tempdir).transpose()?;
    let log = unseen.as_ref().map_or(log, |folder| folder.path().join("unseen.mcap"));
    let mut summary = watched(&plan, &log, args.force)?;
    if unseen.is_some() {
        summary.log = String::new();
    }
    if args.layouts {
        let place = log.parent().unwrap_or(Path::new(""));
        for viewer in ["foxglove", "lichtblick"] {
            let path = place.join(format!("vpd-{viewer}.json"));
            fs::write(&path, LAYOUT).map_err(|source| CliError::Write { path, source })?;
        }
    }
    let is_asked = args.error && summary.outcome == Outcome::Succeeded;
    let found = is_asked.then(|| advise::error_at_end(&plan)).transpose();
    match &found {
        Ok(Some(advise::ErrorAtEnd::About(error))) => summary.error = Some(*error),
        Ok(Some(advise::ErrorAtEnd::Below(bound))) => summary.error_below = Some(*bound),
        Ok(None) | Err(_) => {}
    }
    if args.json {
        print_json(&summary)?;
    } else {
        show(text::summary(&summary, &plan))?;
    }
    // The run, its log and its summary stand even if its error cannot be computed.
    found?;
    Ok(exit_code(summary.outcome))
}

/// Returns the output that is named after an input, in the current directory.
fn named_after(input: &Path, ending: &str) -> Result<PathBuf, CliError> {
    let path = PathBuf::from(input.file_name().unwrap_or_default()).with_extension(ending);
    output_path(path).map_err(|why| CliError::Format(format!("{why}; name the output with -o")))
}

/// Runs a plan to a log and reports how it ended.
fn logged(plan: &Plan, log: &Path, force: bool) -> Result<Status, CliError> {
    let summary = watched(plan, log, force)?;
    show(text::summary(&summary, plan))?;
    Ok(exit_code(summary.outcome))
}

/// Refuses to write where something is that no file may replace.
fn may_write(path: &Path) -> Result<(), CliError> {
    match irreplaceable(path) {
        Some(kind) => Err(CliError::NoFile { path: path.to_owned(), kind }),
        None => Ok(()),
    }
}

/// Writes a file under another name first, so that whatever is at `path` is whole.
fn to_file<T>(
    path: &Path,
    write: impl FnOnce(&fs::File) -> Result<T, CliError>,
) -> Result<T, CliError> {
    let failed = |source| CliError::Write { path: path.to_owned(), source };
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let mut builder = tempfile::Builder::new();
    builder.prefix(".vpd-");
    // The usual permissions of a file of this user, as umask leaves them.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let new = builder.tempfile_in(folder.unwrap_or(Path::new("."))).map_err(failed)?;
    let written = write(new.as_file())?;
    new.persist(path).map_err(|error| failed(error.error))?;
    Ok(written)
}

/// Writes a whole file, under another name first.
fn write_whole(path: &Path, text: &[u8]) -> Result<(), CliError> {
    let failed = |source| CliError::Write { path: path.to_owned(), source };
    to_file(path, |mut out| out.write_all(text).map_err(failed))
}

fn exit_code(outcome: Outcome) -> Status {
    match outcome {
        Outcome::Succeeded => Status::SUCCESS,
        Outcome::Failed | Outcome::Cancelled => Status::from(1),
    }
}

/// Runs on a thread of its own. On a terminal a progress bar with the time left follows; elsewhere a line says what a long
/// run will take. Ctrl-c ends the run with a log that the same command resumes.
fn watched(plan: &Plan, log: &Path, force: bool) -> Result<Summary, RunError> {
    /// A run that takes longer than this many seconds is announced.
    const LONG_S: f64 = 10.0;
    let control = Arc::new(Control { replaces_nothing: !force, ..Control::default() });
    let interrupted = control.clone();
    // Without a handler, ctrl-c ends the process; the log is resumed all the same.
    let _ = ctrlc::set_handler(move || interrupted.interrupt());
    let style = ProgressStyle::with_template(
        "{msg} {wide_bar} {percent:>3} % {pos}/{len} steps, {eta} left",
    )
    .expect("the template is fixed and valid");
    let name = plan.asked.name();
    let bar = if io::stderr().is_terminal() {
        ProgressBar::new(plan.total_steps()).with_style(style).with_message(name.to_owned())
    } else {
        ProgressBar::hidden()
    };
    if bar.is_hidden() && plan.run_s > LONG_S {
        let (steps, run_s) = (plan.total_steps(), plan.run_s);
        let _ = writeln!(io::stderr(), "{name}: {steps} steps, about {run_s:.0} s on one core");
    }
    let mut from = 0;
    let mut follow = || {
        let resumed = control.resumed_step.load(Ordering::Relaxed);
        if resumed > from {
            from = resumed;
            bar.suspend(|| {
                let _ = writeln!(io::stderr(), "resuming at step {resumed}");
            });
            // The time left is judged by the steps of this run.
            bar.set_position(resumed);
            bar.reset_eta();
        }
        bar.set_position(control.steps_done.load(Ordering::Relaxed).max(resumed));
    };
    thread::scope(|scope| {
        let context = JobContext { log, control: &control };
        let (running, ended) = mpsc::channel::<()>();
        let worker = scope.spawn(move || {
            let _running = running;
            run::execute(plan, &context)
        });
        while ended.recv_timeout(Duration::from_millis(50)) == Err(RecvTimeoutError::Timeout) {
            follow();
        }
        follow();
        bar.finish_and_clear();
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

fn plan(args: &PlanArgs) -> Result<Status, CliError> {
    let plan = planned(&args.scenario)?;
    if args.json {
        print_json(&plan)?;
    } else {
        show(text::plan(plan.asked.name(), &plan))?;
    }
    Ok(Status::SUCCESS)
}

fn sum_up(args: &InspectArgs) -> Result<Status, CliError> {
    let inspection = inspect(a_log(&args.log)?)?;
    if args.json {
        print_json(&inspection)?;
    } else {
        show(format!("{inspection}\n"))?;
    }
    Ok(Status::SUCCESS)
}

fn verify(args: &InspectArgs) -> Result<Status, CliError> {
    a_log(&args.log)?;
    let wrong = |source| CliError::Verify { path: args.log.clone(), source };
    let verification = verify::verify(&args.log).map_err(wrong)?;
    if args.json {
        print_json(&verification)?;
    } else {
        show(format!("{verification}\n"))?;
    }
    Ok(if verification.same { Status::SUCCESS } else { Status::from(1) })
}

/// Returns the path if its file begins as a log does.
fn a_log(path: &Path) -> Result<&Path, CliError> {
    if is_log(path)? { Ok(path) } else { Err(LogError::NotALog { path: path.to_owned() }.into()) }
}

fn print_json(value: &impl Serialize) -> Result<(), CliError> {
    let mut text = serde_json::to_vec_pretty(value).map_err(io::Error::from)?;
    text.push(b'\n');
    Ok(show(text)?)
}

/// Writes to stdout; a reader that closes it has read enough.
fn show(text: impl AsRef<[u8]>) -> io::Result<()> {
    let mut out = io::stdout().lock();
    enough(out.write_all(text.as_ref()).and_then(|()| out.flush()))
}

/// Takes a closed pipe as no error.
fn enough(written: io::Result<()>) -> io::Result<()> {
    written.or_else(|error| match error.kind() {
        ErrorKind::BrokenPipe => Ok(()),
        _ => Err(error),
    })
}
