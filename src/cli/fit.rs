//! `vpd fit`: fields of a scenario from attitudes that were seen.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;

use super::{CliError, ScenarioArgs, Status, may_write, planned, print_json, show, write_whole};
use crate::fit::{Fit, FitError, Question, fit as fitted, read};

#[derive(Debug, Args)]
pub(super) struct FitArgs {
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// The attitudes: a log, or a CSV table with time_s and quaternion_w, _x, _y, _z or attitude_1_1 and so on.
    #[arg(long, value_name = "LOG_OR_CSV")]
    to: PathBuf,
    /// The fields to fit: numbers of the inertia, the potential, or the momentum or angular velocity at the start; they begin as
    /// the scenario gives them.
    #[arg(
        long,
        value_name = "POINTER,..",
        value_delimiter = ',',
        required_unless_present = "start_attitude"
    )]
    fields: Vec<String>,
    /// Fit the attitude at the start as well.
    #[arg(long)]
    start_attitude: bool,
    /// Where the fitted scenario goes.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Replace it if it exists.
    #[arg(long)]
    force: bool,
    /// Draw the residuals over time, before and after, as SVG.
    #[cfg(feature = "chart")]
    #[arg(long, value_name = "FILE")]
    chart: Option<PathBuf>,
    /// Print JSON, with the covariance and all residuals.
    #[arg(long)]
    json: bool,
}

/// Fits, prints what was found, and writes the scenario.
pub(super) fn fit(args: &FitArgs) -> Result<Status, CliError> {
    if let Some(path) = &args.output {
        may_write(path)?;
        if !args.force && path.symlink_metadata().is_ok() {
            return Err(CliError::Exists(path.clone()));
        }
    }
    #[cfg(feature = "chart")]
    if let Some(path) = &args.chart {
        may_write(path)?;
    }
    let plan = planned(&args.scenario)?;
    let seen = read(&args.to).map_err(|error| CliError::Fit(error.into()))?;
    let question = Question {
        scenario: &plan.asked,
        fields: &args.fields,
        start_attitude: args.start_attitude,
        seen: &seen,
    };
    let found = fitted(question).map_err(|error| match error {
        FitError::Scenario(source) => {
            CliError::Scenario { path: args.scenario.path().to_owned(), source }
        }
        error => CliError::Fit(error),
    })?;
    if let Some(path) = &args.output {
        write_whole(path, &found.scenario.to_json())?;
    }
    #[cfg(feature = "chart")]
    if let Some(path) = &args.chart {
        let svg = crate::chart::residuals(found.scenario.name(), &found)?;
        write_whole(path, svg.as_bytes())?;
    }
    if args.json {
        print_json(&found)?;
    } else {
        show(text(&found))?;
    }
    Ok(Status::SUCCESS)
}

fn text(found: &Fit) -> String {
    let wide = found.fitted.iter().map(|one| one.field.len()).max().unwrap_or_default();
    let mut text = String::new();
    for one in &found.fitted {
        let _ = writeln!(
            text,
            "{:wide$}  {} +- {:.1e}, was {}",
            one.field, one.value, one.standard_error, one.before
        );
    }
    let Fit { before_rad, after_rad, residuals, runs, .. } = found;
    let _ = writeln!(
        text,
        "residual  {after_rad:.3e} rad, was {before_rad:.3e}: root of the mean square of {} attitudes\n\
         work      {runs} runs",
        residuals.len()
    );
    text
}
