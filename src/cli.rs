//! The command line: arguments → one call each. Errors go to stderr, data to stdout.
//!
//! Exit codes: 0 ok, 1 the run failed (its log is kept and finished), 2 bad input.

use std::fs;
use std::io::{self, IsTerminal, Write};
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use tokio::net::{TcpListener, TcpSocket};
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder};
use tracing_subscriber::EnvFilter;

use crate::advise;
use crate::chart;
use crate::log::inspect::inspect;
use crate::plan::Plan;
use crate::run::{self, Control, JobContext, Outcome, RunError, Summary};
use crate::scenario::{Scenario, ScenarioError};
use crate::serve::{self, Cors, LAYOUT, Limits, ServeConfig, ServeError, Tokens, apart};
use crate::study::{StudyError, Watch};
use crate::verify::{self, VerifyError};

mod study;
mod text;

use study::{ChartArgs, StabilityArgs};

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
    Chart(ChartArgs),
    /// Find the steps at which each method fails on a scenario: a map and the largest usable steps.
    Stability(StabilityArgs),
    /// Take jobs over HTTP, run them on worker threads, hand out their logs.
    Serve(ServeArgs),
    /// Sum up a log, finished or not.
    Inspect(InspectArgs),
    /// Run the job inside a log again and compare every sample bit for bit.
    Verify(InspectArgs),
    /// Print the JSON Schema of a scenario.
    Schema,
    /// Carry out what a service asks for on stdin: its own affair.
    #[command(hide = true, name = apart::SUBCOMMAND)]
    Apart,
}

/// A scenario from a file, with changes.
#[derive(Debug, Args)]
struct ScenarioArgs {
    /// The scenario, a JSON file.
    scenario: PathBuf,
    /// Change a field, named by its JSON pointer: --set /method/tableau=gauss3 --set /step_s=0.02
    #[arg(long = "set", value_name = "POINTER=VALUE")]
    changes: Vec<Change>,
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
            return Err(wanted());
        }
        // What is not JSON is text, so that names need no quotes.
        let value = serde_json::from_str(value).unwrap_or_else(|_| value.into());
        Ok(Self { pointer: pointer.to_owned(), value })
    }
}

#[derive(Debug, Args)]
struct RunArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// The log; by default the scenario's file name with .mcap, here.
    #[arg(short, long, value_name = "FILE.mcap")]
    output: Option<PathBuf>,
    /// Print one JSON summary on stdout.
    #[arg(long)]
    json: bool,
    /// Write layouts for Foxglove and Lichtblick beside the log.
    #[arg(long)]
    layouts: bool,
    /// Compute a reference afterwards and tell the error of the last state.
    #[arg(long)]
    error: bool,
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
struct ServeArgs {
    /// Address to listen on.
    #[arg(long, env = "VPD_LISTEN", default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
    /// Directory of the jobs and their logs; made if it is not there.
    #[arg(long, env = "VPD_DATA", default_value = "vpd-data", value_name = "DIR")]
    data: PathBuf,
    /// Jobs that run at once; one a core by default.
    #[arg(long, env = "VPD_WORKERS", value_name = "N")]
    workers: Option<NonZeroUsize>,
    /// Jobs that may wait; one more is answered 429.
    #[arg(long, env = "VPD_QUEUE", default_value_t = Limits::default().queue, value_name = "N")]
    queue: usize,
    /// Pages that may read logs: `*`, `none`, or origins separated by commas.
    #[arg(long, env = "VPD_CORS", default_value = "*", value_name = "ORIGINS")]
    cors: Cors,
    /// Address under which viewers reach the service, if it is not the one that clients use.
    #[arg(long, env = "VPD_PUBLIC_URL", value_name = "URL")]
    public_url: Option<String>,
    /// Names under which clients may call the service, beside localhost and its addresses.
    #[arg(long = "host", env = "VPD_HOSTS", value_name = "NAME", value_delimiter = ',')]
    hosts: Vec<String>,
    /// File with lines of SCOPE TOKEN; the scopes are read, submit, admin. Or the lines in VPD_TOKENS.
    #[arg(long, env = "VPD_TOKENS_FILE", value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Serve other machines without tokens.
    #[arg(long)]
    insecure: bool,
    /// Longest job that is taken, in seconds of estimated computing.
    #[arg(long, env = "VPD_MAX_RUN_S", default_value_t = Limits::default().run_s, value_name = "S")]
    max_run_s: f64,
    /// Largest log that is taken on, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_LOG_BYTES", default_value_t = Limits::default().log_bytes, value_name = "N")]
    max_log_bytes: u64,
    /// Memory that runs may take at one time, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_MEMORY_BYTES", default_value_t = Limits::default().memory_bytes, value_name = "N")]
    max_memory_bytes: u64,
    /// Bytes of the disk that logs leave free.
    #[arg(long, env = "VPD_RESERVE_BYTES", default_value_t = Limits::default().reserve_bytes, value_name = "N")]
    reserve_bytes: u64,
    /// Connections at once.
    #[arg(long, env = "VPD_CONNECTIONS", default_value_t = Limits::default().connections, value_name = "N")]
    connections: usize,
    /// Connections at once from one address.
    #[arg(long, env = "VPD_CONNECTIONS_PER_CLIENT", default_value_t = Limits::default().connections_per_client, value_name = "N")]
    connections_per_client: usize,
    /// Requests a second from one address.
    #[arg(long, env = "VPD_REQUESTS_PER_S", default_value_t = Limits::default().requests_per_s, value_name = "N")]
    requests_per_s: u32,
    /// Address on which Foxglove and Lichtblick watch a running job live, as 127.0.0.1:8765.
    #[arg(long, env = "VPD_FOXGLOVE_LISTEN", value_name = "ADDRESS")]
    foxglove_listen: Option<SocketAddr>,
    /// How the service's own log is written, on stderr: text, or JSON with one object a line.
    #[arg(long, env = "VPD_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
}

/// How the service writes its own log.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    Text,
    Json,
}

#[derive(Debug, Args)]
struct InspectArgs {
    /// The log.
    log: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Lines of the service's own log that wait to be written; more are lost, and counted.
const LOG_LINES: usize = 10_000;

/// Pause between looks at how many were lost.
const LOST_LINES_PAUSE: Duration = Duration::from_secs(10);

/// What ends a command early.
#[derive(Debug, thiserror::Error)]
enum CliError {
    #[error("{}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("cannot write {}: {source}", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("{}: {source}", path.display())]
    Scenario { path: PathBuf, source: ScenarioError },
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("{0}")]
    Log(#[from] crate::log::LogError),
    #[error("{}: {source}", path.display())]
    Verify { path: PathBuf, source: VerifyError },
    #[error(transparent)]
    Chart(#[from] chart::ChartError),
    #[error(transparent)]
    Study(#[from] StudyError),
    #[error("scenarios and logs are mixed: give either")]
    Mixed,
    #[error(transparent)]
    Serve(#[from] ServeError),
    #[error("{0}")]
    Tokens(String),
    #[error("cannot listen on {address}: {source}")]
    Listen { address: SocketAddr, source: io::Error },
    #[error("cannot write to stdout: {0}")]
    Output(#[from] io::Error),
}

impl CliError {
    fn exit_code(&self) -> ExitCode {
        match self {
            Self::Read { .. }
            | Self::Scenario { .. }
            | Self::Tokens(_)
            | Self::Mixed
            | Self::Serve(ServeError::Unguarded { .. })
            | Self::Study(StudyError::Scenario(_))
            | Self::Run(RunError::Scenario(_)) => ExitCode::from(2),
            _ => ExitCode::from(1),
        }
    }
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    // Bad arguments end in clap with exit code 2.
    let cli = Cli::parse();
    let done = match cli.command {
        Command::Run(args) => run(&args),
        Command::Plan(args) => plan(&args),
        Command::Chart(args) => study::draw(&args),
        Command::Stability(args) => study::map(&args),
        Command::Serve(args) => serve(&args),
        Command::Inspect(args) => sum_up(&args),
        Command::Verify(args) => verify(&args),
        Command::Apart => apart::child().map(|()| ExitCode::SUCCESS).map_err(CliError::Output),
        Command::Schema => print_json(&crate::scenario::schema()).map(|()| ExitCode::SUCCESS),
    };
    done.unwrap_or_else(|error| {
        // A closed stderr must not turn an answer into a panic.
        let _ = writeln!(io::stderr(), "vpd: {error}");
        error.exit_code()
    })
}

/// A scenario as it was asked for and as it is run, with a method and a step.
struct Planned {
    asked: Scenario,
    settled: Scenario,
    plan: Plan,
}

/// Reads a scenario, applies the changes and plans it.
fn planned(args: &ScenarioArgs) -> Result<Planned, CliError> {
    let path = &args.scenario;
    let wrong = |source| CliError::Scenario { path: path.clone(), source };
    let mut text =
        fs::read(path).map_err(|source| CliError::Read { path: path.clone(), source })?;
    if !args.changes.is_empty() {
        // The file is held to its own rules first, duplicate keys among them.
        Scenario::from_json(&text).map_err(wrong)?;
        text = changed(&text, &args.changes).map_err(wrong)?;
    }
    let asked = Scenario::from_json(&text).map_err(wrong)?;
    let (settled, advice) = advise::settled(&asked, &Watch::default())
        .map_err(|unsettled| wrong(ScenarioError::from(unsettled)))?;
    let plan = advise::plan_of(&settled, advice).map_err(wrong)?;
    Ok(Planned { asked, settled, plan })
}

/// The text of a scenario with some fields replaced or added.
fn changed(text: &[u8], changes: &[Change]) -> Result<Vec<u8>, ScenarioError> {
    let mut document: serde_json::Value =
        serde_json::from_slice(text).expect("the text was read as a scenario before");
    for Change { pointer, value } in changes {
        let missing = || ScenarioError::invalid(pointer.as_str(), "there is no such field to set");
        let mut place = &mut document;
        for key in pointer.split('/').skip(1) {
            place = match place {
                serde_json::Value::Array(items) => {
                    let index = key.parse::<usize>().ok();
                    index.and_then(|index| items.get_mut(index)).ok_or_else(missing)?
                }
                // Sections may be left out of a file; one that does not exist is refused when it is read.
                serde_json::Value::Object(map) => {
                    map.entry(key).or_insert_with(|| serde_json::json!({}))
                }
                _ => return Err(missing()),
            };
        }
        *place = value.clone();
    }
    Ok(document.to_string().into_bytes())
}

fn run(args: &RunArgs) -> Result<ExitCode, CliError> {
    let Planned { asked: scenario, settled, plan } = planned(&args.scenario)?;
    let log = args.output.clone().unwrap_or_else(|| {
        PathBuf::from(args.scenario.scenario.file_name().unwrap_or_default()).with_extension("mcap")
    });
    let mut summary = watched(&scenario, &plan, &log)?;
    if args.layouts {
        let place = log.parent().unwrap_or(Path::new(""));
        for viewer in ["foxglove", "lichtblick"] {
            let path = place.join(format!("vpd-{viewer}.json"));
            fs::write(&path, LAYOUT).map_err(|source| CliError::Write { path, source })?;
        }
    }
    if args.error && summary.outcome == Outcome::Succeeded {
        match advise::error_at_end(&settled)? {
            advise::ErrorAtEnd::About(error) => summary.error = Some(error),
            advise::ErrorAtEnd::Below(bound) => summary.error_below = Some(bound),
        }
    }
    if args.json {
        print_json(&summary)?;
    } else {
        io::stdout().write_all(text::summary(&summary).as_bytes())?;
    }
    Ok(match summary.outcome {
        Outcome::Succeeded => ExitCode::SUCCESS,
        Outcome::Failed | Outcome::Cancelled => ExitCode::from(1),
    })
}

/// Runs on a thread of its own while a progress bar with the time left follows, if somebody looks.
fn watched(scenario: &Scenario, plan: &Plan, log: &Path) -> Result<Summary, RunError> {
    let control = Control::default();
    let context = JobContext { log, control: &control };
    if !io::stderr().is_terminal() {
        return run::execute_planned(scenario, plan, &context);
    }
    let style = ProgressStyle::with_template(
        "{msg} {wide_bar} {percent:>3} % {pos}/{len} steps, {eta} left",
    )
    .expect("the template is fixed and valid");
    let bar = ProgressBar::new(plan.total_steps())
        .with_style(style)
        .with_message(scenario.name().to_owned());
    thread::scope(|scope| {
        let worker = scope.spawn(|| run::execute_planned(scenario, plan, &context));
        while !worker.is_finished() {
            bar.set_position(control.steps_done.load(Ordering::Relaxed));
            thread::sleep(Duration::from_millis(50));
        }
        bar.finish_and_clear();
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

fn plan(args: &PlanArgs) -> Result<ExitCode, CliError> {
    let Planned { asked: scenario, plan, .. } = planned(&args.scenario)?;
    if args.json {
        print_json(&plan)?;
    } else {
        io::stdout().write_all(text::plan(scenario.name(), &plan).as_bytes())?;
    }
    Ok(ExitCode::SUCCESS)
}

fn serve(args: &ServeArgs) -> Result<ExitCode, CliError> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // Written by a thread of its own: a stderr that nobody reads must not stall who answers. The rest is written when
    // the guard goes.
    let (out, _rest) =
        NonBlockingBuilder::default().buffered_lines_limit(LOG_LINES).finish(io::stderr());
    let lost = out.error_counter();
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(out)
        // A closed stderr must not turn a line of the log into a panic.
        .log_internal_errors(false)
        .with_ansi(io::stderr().is_terminal());
    match args.log_format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().init(),
    }
    let tokens = tokens(args.tokens.as_deref())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let served = runtime.block_on(async {
        let stop = stop_signal().map_err(ServeError::System)?;
        tokio::spawn(tell_of_lost_lines(lost));
        let listener = listener(args.listen)
            .map_err(|source| CliError::Listen { address: args.listen, source })?;
        tracing::info!("listening on http://{}", listener.local_addr()?);
        let workers = args.workers.or_else(|| thread::available_parallelism().ok());
        let config = ServeConfig {
            data: args.data.clone(),
            workers: workers.map_or(1, NonZeroUsize::get),
            limits: Limits {
                queue: args.queue,
                run_s: args.max_run_s,
                log_bytes: args.max_log_bytes,
                memory_bytes: args.max_memory_bytes,
                reserve_bytes: args.reserve_bytes,
                connections: args.connections,
                connections_per_client: args.connections_per_client,
                requests_per_s: args.requests_per_s,
            },
            cors: args.cors.clone(),
            public_url: args.public_url.clone(),
            hosts: args.hosts.clone(),
            tokens,
            insecure: args.insecure,
            live: args.foxglove_listen,
            program: program(),
        };
        serve::serve(listener, config, stop).await?;
        Ok(ExitCode::SUCCESS)
    });
    // A blocking task of a client that is gone must not hold up the exit.
    runtime.shutdown_background();
    served
}

/// The program of this process, for others like it.
fn program() -> Option<PathBuf> {
    // Also where the file was replaced since.
    if cfg!(target_os = "linux") {
        Some("/proc/self/exe".into())
    } else {
        std::env::current_exe().ok()
    }
}

/// Says in the service's own log how many of its lines nobody took in time, each time there are more.
async fn tell_of_lost_lines(lost: ErrorCounter) {
    let mut told = 0;
    loop {
        tokio::time::sleep(LOST_LINES_PAUSE).await;
        let lines = lost.dropped_lines();
        if lines > told {
            told = lines;
            tracing::warn!(lines, "lines of this log are lost: they were not read in time");
        }
    }
}

/// Listens with room for many clients that come at once; the usual 128 make the others wait a second.
fn listener(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
    // As usual: a restart need not wait for the connections of before.
    socket.set_reuseaddr(cfg!(unix))?;
    socket.bind(address)?;
    socket.listen(4096)
}

/// The tokens in a file, or else in the environment.
fn tokens(path: Option<&Path>) -> Result<Tokens, CliError> {
    let text = match path {
        Some(path) => fs::read_to_string(path)
            .map_err(|source| CliError::Read { path: path.to_owned(), source })?,
        None => std::env::var("VPD_TOKENS").unwrap_or_default(),
    };
    text.parse().map_err(CliError::Tokens)
}

/// Ends when the process is asked to stop: SIGTERM or ctrl-c. From this call on neither ends the process by itself.
#[cfg(unix)]
fn stop_signal() -> io::Result<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) =
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    })
}

/// Ends when the process is asked to stop by ctrl-c. From this call on that does not end the process by itself.
#[cfg(not(unix))]
fn stop_signal() -> io::Result<impl Future<Output = ()>> {
    let mut interrupt = tokio::signal::windows::ctrl_c()?;
    Ok(async move {
        interrupt.recv().await;
    })
}

fn sum_up(args: &InspectArgs) -> Result<ExitCode, CliError> {
    let inspection = inspect(&args.log)?;
    if args.json {
        print_json(&inspection)?;
    } else {
        writeln!(io::stdout(), "{inspection}")?;
    }
    Ok(ExitCode::SUCCESS)
}

fn verify(args: &InspectArgs) -> Result<ExitCode, CliError> {
    let wrong = |source| CliError::Verify { path: args.log.clone(), source };
    let verification = verify::verify(&args.log).map_err(wrong)?;
    if args.json {
        print_json(&verification)?;
    } else {
        writeln!(io::stdout(), "{verification}")?;
    }
    Ok(if verification.same { ExitCode::SUCCESS } else { ExitCode::from(1) })
}

fn print_json(value: &impl Serialize) -> Result<(), CliError> {
    let mut out = io::stdout();
    serde_json::to_writer_pretty(&mut out, value).map_err(io::Error::from)?;
    writeln!(out)?;
    Ok(())
}
