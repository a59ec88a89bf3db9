//! `vpd lyapunov`: the Lyapunov exponents of a scenario.

use std::fmt::Write as _;
use std::io::{self, IsTerminal};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use super::{CliError, ScenarioArgs, Status, planned, show};
use crate::solve::tangent::Lyapunov;
use crate::study::Watch;
use crate::study::lyapunov::{ExponentsError, exponents};

#[derive(Debug, Args)]
pub(super) struct LyapunovArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Computes the exponents along a run and prints them, the largest first.
pub(super) fn lyapunov(args: &LyapunovArgs) -> Result<Status, CliError> {
    let plan = planned(&args.scenario)?;
    let watch = Watch::default();
    let cancelled = watch.cancelled.clone();
    // Without a handler, ctrl-c ends the process; nothing is written before the end.
    let _ = ctrlc::set_handler(move || cancelled.store(true, Ordering::Relaxed));
    let style =
        ProgressStyle::with_template("{wide_bar} {percent:>3} % {pos}/{len} steps, {eta} left")
            .expect("the template is fixed and valid");
    let bar = if io::stderr().is_terminal() {
        ProgressBar::new(plan.steps).with_style(style)
    } else {
        ProgressBar::hidden()
    };
    let found = thread::scope(|scope| {
        let (running, ended) = mpsc::channel::<()>();
        let worker = scope.spawn(|| {
            let _running = running;
            exponents(&plan.settled, &watch)
        });
        while ended.recv_timeout(Duration::from_millis(50)) == Err(RecvTimeoutError::Timeout) {
            bar.set_position(watch.done.load(Ordering::Relaxed));
        }
        bar.finish_and_clear();
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    let found = found.map_err(|error| match error {
        ExponentsError::Scenario(source) => {
            CliError::Scenario { path: args.scenario.path().to_owned(), source }
        }
        error => CliError::Exponents(error),
    })?;
    let time_s = plan.step_s * plan.steps as f64;
    show(if args.json { as_json(&found, time_s, plan.steps) } else { as_text(&found, time_s) })?;
    Ok(Status::SUCCESS)
}

fn as_json(found: &Lyapunov, time_s: f64, steps: u64) -> String {
    let Lyapunov { exponents, errors, sum } = found;
    let value = json!({
        "exponents_per_s": exponents, "standard_errors_per_s": errors, "sum_per_s": sum,
        "time_s": time_s, "steps": steps,
    });
    format!("{value:#}\n")
}

fn as_text(found: &Lyapunov, time_s: f64) -> String {
    let mut text = String::new();
    for (exponent, error) in found.exponents.iter().zip(&found.errors) {
        let _ = writeln!(text, "{exponent:>12.4e} 1/s, standard error {error:.1e}");
    }
    let sum = found.sum;
    // Of regular motion the exponents of a finite run fall like this.
    let least = libm::log(time_s.max(1.0)) / time_s;
    let _ = writeln!(
        text,
        "their sum    {sum:.1e} 1/s, zero but for rounding: the steps are symplectic\n\
         over         {time_s} s, in which exponents below about {least:.1e} 1/s are no sign of chaos"
    );
    text
}
