//! `vpd sweep` and `vpd merge`: the table of a sweep, in one piece or in parts.

use std::io::{self, IsTerminal};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use clap::Args;
use clap::builder::{PathBufValueParser, TypedValueParser};
use indicatif::{ProgressBar, ProgressStyle};

#[cfg(feature = "chart")]
use super::may_write;
#[cfg(feature = "serve")]
use super::process::ClusterArgs;
#[cfg(feature = "serve")]
use super::serve::EngineName;
use super::{CliError, SchemaOf, Status, hinted, log_path, logged, named_after, output_path, show};
#[cfg(feature = "chart")]
use crate::chart;
use crate::run::{self, Control, JobContext};
use crate::scenario::read_text;
use crate::study::Watch;
use crate::sweep::{self, Counts, Made, Options, Shard, Sweep, SweepError};

/// Seconds without a sign of life after which a part of a sweep goes to another worker.
#[cfg(feature = "cluster")]
const SWEEP_LEASE_S: f64 = 10.0;

#[derive(Debug, Args)]
pub(super) struct SweepArgs {
    /// The sweep, a JSON file.
    sweep: PathBuf,
    /// The table; by default the sweep's file name with .csv, here (of a shard with .i-of-N.csv). The logs of members that the
    /// sweep keeps go into a folder next to it.
    #[arg(short, long, visible_alias = "out", value_name = "TABLE.csv", value_parser = PathBufValueParser::new().try_map(output_path))]
    output: Option<PathBuf>,
    /// Number of threads; by default one for each core.
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
    /// Make this part of the table alone, for `vpd merge`: 1/N to N/N.
    #[arg(long, value_name = "i/N")]
    shard: Option<Shard>,
    /// Draw a column: a map over two fields, else points. A table that is finished is drawn as it stands.
    #[cfg(feature = "chart")]
    #[arg(long, value_name = "PICTURE.svg", conflicts_with = "shard", value_parser = super::picture_path)]
    svg: Option<PathBuf>,
    /// The column to draw; by default the one that the sweep names, else its first score.
    #[cfg(feature = "chart")]
    #[arg(long, value_name = "NAME", requires = "svg")]
    column: Option<String>,
    /// Print the scenario of one member, or run it to a log with --log.
    #[arg(long, value_name = "K", conflicts_with_all = ["shard", "output"])]
    member: Option<u64>,
    /// Run the member and write its log.
    #[arg(long, value_name = "FILE.mcap", requires = "member", value_parser = PathBufValueParser::new().try_map(log_path))]
    log: Option<PathBuf>,
    /// Engine that makes the members: this machine, or workers on many (vpd worker), which need
    /// --bucket and --temporal.
    #[cfg(feature = "serve")]
    #[arg(long, value_enum, default_value_t = EngineName::Local, hide = !super::process::CLUSTER, conflicts_with_all = ["shard", "threads", "member"])]
    engine: EngineName,
    #[cfg(feature = "serve")]
    #[command(flatten)]
    cluster: ClusterArgs,
    /// Replace what stands in the place of the table or the log: a finished one, or an unfinished one of something else.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// The parts, in any order.
    #[arg(required = true, value_name = "PART.csv")]
    parts: Vec<PathBuf>,
    /// The whole table.
    #[arg(short, long, visible_alias = "out", value_name = "TABLE.csv", value_parser = PathBufValueParser::new().try_map(output_path))]
    output: PathBuf,
    /// Replace a table that stands in its place.
    #[arg(long)]
    force: bool,
}

/// Reads a sweep; what else the file may be is said in the error.
pub(super) fn read(path: &Path) -> Result<Sweep, CliError> {
    Sweep::read(path).map_err(|error| match error {
        SweepError::Field(error) => {
            let text = std::fs::File::open(path).and_then(read_text).unwrap_or_default();
            let source = hinted(error, &text, SchemaOf::Sweep);
            CliError::Sweep { path: path.to_owned(), source }
        }
        other => other.into(),
    })
}

/// Makes a table or a part of one, or looks at one member.
pub(super) fn sweep(args: &SweepArgs) -> Result<Status, CliError> {
    let path = &args.sweep;
    let sweep = read(path)?;
    if let Some(member) = args.member {
        return one(args, &sweep, member);
    }
    let table = match &args.output {
        Some(table) => table.clone(),
        None => {
            let ending =
                args.shard.map_or_else(|| "csv".to_owned(), |shard| format!("{shard}.csv"));
            named_after(path, &ending)?
        }
    };
    #[cfg(feature = "chart")]
    args.svg.as_deref().map_or(Ok(()), may_write)?;
    #[cfg(feature = "chart")]
    if args.svg.is_some() && !args.force && table.exists() {
        draw(args, &sweep, &table)?;
        return Ok(Status::SUCCESS);
    }
    #[cfg(feature = "serve")]
    if args.engine == EngineName::Cluster {
        return elsewhere(args, &sweep, &table);
    }
    let made = followed(args, &sweep, &table)?;
    let Made { counts: Counts { succeeded, failed, refused }, resumed, damaged, first_refused } =
        made;
    let total = succeeded + failed + refused;
    let mut text = format!(
        "members         {total}: {succeeded} succeeded, {failed} failed, {refused} refused\n"
    );
    if let Some((member, why)) = first_refused {
        text += &format!("first refused   member {member}: {why}\n");
    }
    if resumed > 0 {
        text += &format!("resumed         with {resumed} members in the table\n");
    }
    if let Some(member) = damaged {
        text += &format!(
            "damaged         the line of member {member}: it and those after it were run again\n"
        );
    }
    show(format!("{text}table           {}\n", table.display()))?;
    #[cfg(feature = "chart")]
    draw(args, &sweep, &table)?;
    // As for an ensemble: it has failed if every member has.
    Ok(if succeeded > 0 || total == 0 { Status::SUCCESS } else { Status::from(1) })
}

/// Has the table made by workers on other machines. The logs that the sweep keeps are made here.
#[cfg(feature = "cluster")]
fn elsewhere(args: &SweepArgs, sweep: &Sweep, table: &Path) -> Result<Status, CliError> {
    let config = args.cluster.config(SWEEP_LEASE_S)?;
    let watch = Watch::default();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let (made, bar) =
        (crate::serve::sweep_on(&config, sweep, table, args.force, &watch), bar(sweep));
    let members = runtime.block_on(async {
        let mut made = std::pin::pin!(made);
        loop {
            tokio::select! {
                members = &mut made => break members,
                () = tokio::time::sleep(Duration::from_millis(200)) => {
                    bar.set_position(watch.done.load(Ordering::Relaxed));
                }
            }
        }
    })?;
    bar.finish_and_clear();
    let control = Control::default();
    sweep.kept_logs().iter().try_for_each(|&member| keep_log(sweep, member, table, &control))?;
    show(format!("members         {members}\ntable           {}\n", table.display()))?;
    #[cfg(feature = "chart")]
    draw(args, sweep, table)?;
    Ok(Status::SUCCESS)
}

/// Returns an error that names the missing feature.
#[cfg(all(feature = "serve", not(feature = "cluster")))]
fn elsewhere(_: &SweepArgs, _: &Sweep, _: &Path) -> Result<Status, CliError> {
    Err(CliError::Feature { wanted: "--engine cluster", feature: "cluster" })
}

/// Puts parts together.
pub(super) fn merge(args: &MergeArgs) -> Result<Status, CliError> {
    let members = sweep::merge(&args.parts, &args.output, args.force)?;
    show(format!("members         {members}\ntable           {}\n", args.output.display()))?;
    Ok(Status::SUCCESS)
}

/// Prints the scenario of a member, or writes its log.
fn one(args: &SweepArgs, sweep: &Sweep, member: u64) -> Result<Status, CliError> {
    let wrong = |source| CliError::Member { path: args.sweep.clone(), member, source };
    match &args.log {
        None => show(sweep.scenario(member).map_err(wrong)?.to_json())?,
        Some(log) => {
            let plan = sweep.plan(member).map_err(wrong)?;
            return logged(&plan, log, args.force);
        }
    }
    Ok(Status::SUCCESS)
}

/// Runs on its own thread. On a terminal a progress bar follows; ctrl-c leaves a part from which
/// the same command resumes.
fn followed(args: &SweepArgs, sweep: &Sweep, table: &Path) -> Result<Made, CliError> {
    let watch = Watch::default();
    let control = Arc::new(Control::default());
    let (stop, interrupted) = (watch.cancelled.clone(), control.clone());
    // Without a handler, ctrl-c ends the process; the sweep goes on all the same.
    let _ = ctrlc::set_handler(move || {
        stop.store(true, Ordering::Relaxed);
        interrupted.interrupt();
    });
    let bar = bar(sweep);
    let options = Options {
        threads: args.threads.map_or_else(sweep::cores, NonZeroUsize::get),
        shard: args.shard,
        replaces: args.force,
    };
    thread::scope(|scope| {
        let (running, ended) = mpsc::channel::<()>();
        let (watch, control) = (&watch, &control);
        let worker = scope.spawn(move || {
            let _running = running;
            sweep::run(sweep, table, options, watch, |members| {
                let kept = sweep.kept_logs().iter().filter(|member| members.contains(member));
                kept.copied().try_for_each(|member| keep_log(sweep, member, table, control))
            })
        });
        while ended.recv_timeout(Duration::from_millis(50)) == Err(RecvTimeoutError::Timeout) {
            bar.set_length(watch.total.load(Ordering::Relaxed).max(1));
            bar.set_position(watch.done.load(Ordering::Relaxed));
        }
        bar.finish_and_clear();
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Returns a progress bar, on a terminal.
fn bar(sweep: &Sweep) -> ProgressBar {
    let style = ProgressStyle::with_template(
        "{msg} {wide_bar} {percent:>3} % {pos}/{len} members, {eta} left",
    )
    .expect("the template is fixed and valid");
    if io::stderr().is_terminal() {
        ProgressBar::new(sweep.members()).with_style(style).with_message(sweep.name().to_owned())
    } else {
        ProgressBar::hidden()
    }
}

/// Writes the log of a member into the folder next to the table. A refused member has none.
fn keep_log(sweep: &Sweep, member: u64, table: &Path, control: &Control) -> Result<(), CliError> {
    let Ok(plan) = sweep.plan(member) else { return Ok(()) };
    let folder = table.with_extension("logs");
    let log = folder.join(format!("{member}.mcap"));
    std::fs::create_dir_all(&folder)
        .map_err(|source| CliError::Write { path: folder.clone(), source })?;
    // A log of another sweep would be mistaken for one of this.
    run::execute(&plan, &JobContext { log: &log, control })?;
    Ok(())
}

/// Draws a column of a table, if that is asked for.
#[cfg(feature = "chart")]
fn draw(args: &SweepArgs, sweep: &Sweep, table: &Path) -> Result<(), CliError> {
    let Some(svg) = &args.svg else { return Ok(()) };
    let picture = chart::sweep(&sweep.shown(table, args.column.as_deref())?)?;
    std::fs::write(svg, picture).map_err(|source| CliError::Write { path: svg.clone(), source })?;
    Ok(show(format!("picture         {}\n", svg.display()))?)
}
