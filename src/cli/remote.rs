//! `vpd submit`, `vpd jobs` and `vpd fetch`: the jobs of a service.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use clap::Args;
use clap::builder::{PathBufValueParser, TypedValueParser};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;

use super::{CliError, ScenarioArgs, Status, log_path, may_write, print_json, show};
use crate::client::{Client, Stop, token_of};
use crate::log::shown;

/// The service that is asked.
#[derive(Debug, Args)]
struct ServiceArgs {
    /// The service: http://localhost:8080. A token is read from VPD_TOKEN or a file, never from here.
    #[arg(long, value_name = "URL")]
    to: String,
    /// A file that holds the token.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Seconds for which a service that does not answer, or has no room, is asked again.
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    patience: f64,
}

impl ServiceArgs {
    fn client(&self) -> Result<Client, CliError> {
        let token = match &self.token_file {
            Some(path) => {
                let read = token_of(path);
                Some(read.map_err(|source| CliError::Read { path: path.clone(), source })?)
            }
            None => std::env::var("VPD_TOKEN").ok(),
        };
        let wrong = || CliError::Format(format!("{} s of patience given", self.patience));
        let patience = Duration::try_from_secs_f64(self.patience).map_err(|_| wrong())?;
        Ok(Client::new(&self.to, token, patience)?.telling(|error| {
            let _ = writeln!(io::stderr(), "vpd: {error}; it is tried again");
        }))
    }
}

#[derive(Debug, Args)]
pub(super) struct SubmitArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    #[command(flatten)]
    service: ServiceArgs,
    /// A name of the request: sent twice under the same one, a scenario is one job.
    #[arg(long, value_name = "TEXT")]
    key: Option<String>,
    /// Wait until the job has ended.
    #[arg(long)]
    wait: bool,
    /// Wait, and fetch the log.
    #[arg(short, long, value_name = "FILE.mcap", value_parser = PathBufValueParser::new().try_map(log_path))]
    output: Option<PathBuf>,
    /// Replace a log that stands in its place.
    #[arg(long)]
    force: bool,
    /// Print the job as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
pub(super) struct JobsArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Only jobs in this state: queued, running, succeeded, failed, cancelled.
    #[arg(long)]
    state: Option<String>,
    /// Only jobs with this text in their names.
    #[arg(long, value_name = "TEXT")]
    name: Option<String>,
    /// Number of jobs, the newest first.
    #[arg(long, value_name = "N", default_value_t = 20)]
    limit: u64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
pub(super) struct FetchArgs {
    /// The job.
    id: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// The log; by default ID.mcap, here.
    #[arg(short, long, value_name = "FILE.mcap", value_parser = PathBufValueParser::new().try_map(log_path))]
    output: Option<PathBuf>,
    /// Replace a log that stands in its place.
    #[arg(long)]
    force: bool,
}

/// Sends a job, and waits for it and its log if that is asked for.
pub(super) fn submit(args: &SubmitArgs) -> Result<Status, CliError> {
    if let Some(log) = &args.output {
        may_take(log, args.force)?;
    }
    let client = args.service.client()?;
    let stop = stopped_by_ctrl_c();
    let refused = |source| CliError::Refused { path: args.scenario.path().to_owned(), source };
    let text = args.scenario.text()?;
    let mut job = client.submit(&text, args.key.as_deref(), &stop).map_err(refused)?;
    let id = job["id"].as_str().unwrap_or_default().to_owned();
    if args.wait || args.output.is_some() {
        let _ = writeln!(io::stderr(), "job {}", shown(&id));
        let bar = bar("{msg} {wide_bar} {percent:>3} % {pos}/{len} steps, {eta} left");
        let follow = |job: &Value| {
            let count = |key: &str| job["progress"][key].as_u64().unwrap_or(0);
            bar.set_length(count("steps").max(1));
            bar.set_position(count("steps_done"));
            bar.set_message(shown(job["state"].as_str().unwrap_or_default()));
        };
        job = client.wait(&id, follow, &stop)?;
        bar.finish_and_clear();
    }
    // A job that failed has a log, one that was cancelled while it waited has none.
    if let Some(log) = args.output.as_deref().filter(|_| job["log"].is_object()) {
        fetched(&client, &id, log, &stop)?;
    }
    if args.json {
        print_json(&job)?;
    } else {
        show(line(&job) + "\n")?;
    }
    let failed = matches!(job["state"].as_str(), Some("failed" | "cancelled"));
    Ok(if failed { Status::from(1) } else { Status::SUCCESS })
}

/// Lists jobs.
pub(super) fn jobs(args: &JobsArgs) -> Result<Status, CliError> {
    let JobsArgs { service, state, name, limit, json } = args;
    let stop = Stop::default();
    let jobs = service.client()?.jobs(state.as_deref(), name.as_deref(), *limit, &stop)?;
    if *json {
        print_json(&jobs)?;
    } else {
        show(jobs.iter().map(|job| line(job) + "\n").collect::<String>())?;
    }
    Ok(Status::SUCCESS)
}

/// Fetches a log.
pub(super) fn fetch(args: &FetchArgs) -> Result<Status, CliError> {
    let named = || log_path(format!("{}.mcap", args.id).into()).map_err(CliError::Format);
    let log = args.output.clone().map_or_else(named, Ok)?;
    may_take(&log, args.force)?;
    fetched(&args.service.client()?, &args.id, &log, &stopped_by_ctrl_c())?;
    Ok(Status::SUCCESS)
}

fn fetched(client: &Client, id: &str, log: &Path, stop: &Stop) -> Result<(), CliError> {
    let bar = bar("{msg} {wide_bar} {percent:>3} % {bytes}/{total_bytes}, {eta} left");
    bar.set_message("log");
    let follow = |have, whole: u64| {
        bar.set_length(whole.max(1));
        bar.set_position(have);
    };
    client.fetch(id, log, follow, stop)?;
    bar.finish_and_clear();
    let _ = writeln!(io::stderr(), "log {}", log.display());
    Ok(())
}

fn may_take(log: &Path, force: bool) -> Result<(), CliError> {
    may_write(log)?;
    if !force && log.symlink_metadata().is_ok() {
        return Err(CliError::Exists(log.to_owned()));
    }
    Ok(())
}

/// Returns what ctrl-c sets. Without a handler it ends the process; the job goes on in any case.
fn stopped_by_ctrl_c() -> Arc<Stop> {
    let stop = Arc::new(Stop::default());
    let set = stop.clone();
    let _ = ctrlc::set_handler(move || set.store(true, Ordering::Relaxed));
    stop
}

/// Returns a progress bar, on a terminal.
fn bar(template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template).expect("the template is fixed and valid");
    if io::stderr().is_terminal() {
        ProgressBar::new(1).with_style(style)
    } else {
        ProgressBar::hidden()
    }
}

/// Returns a line about a job.
fn line(job: &Value) -> String {
    let word = |key: &str| shown(job[key].as_str().unwrap_or_default());
    let percent = job["progress"]["percent"].as_f64().unwrap_or(0.0);
    let mut line =
        format!("{}  {:<9}  {percent:>5.1} %  {}", word("id"), word("state"), word("name"));
    if let Some(code) = job["diagnosis"]["code"].as_str() {
        line += &format!("  {}", shown(code));
    }
    line
}
