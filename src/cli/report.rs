//! `vpd report`: what the table of a sweep says.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;

use super::{CliError, Status, named_after, print_json, show};
use crate::sweep::statistics::Figure;
use crate::sweep::{Asked, Holds, Report};

#[derive(Debug, Args)]
pub(super) struct ReportArgs {
    /// The sweep, a JSON file.
    sweep: PathBuf,
    /// Its table, finished or not; by default the sweep's file name with .csv, here.
    #[arg(short, long, value_name = "TABLE.csv")]
    table: Option<PathBuf>,
    /// The quantiles of each column of results.
    #[arg(long, value_name = "PART,..", value_delimiter = ',', default_value = "0.05,0.5,0.95", value_parser = part)]
    quantiles: Vec<f64>,
    /// A condition whose probability is wanted: --probability 'axis_error<0.01'; may be repeated.
    #[arg(long, value_name = "COLUMN<NUMBER")]
    probability: Vec<Holds>,
    /// The probability with which an interval holds the true figure.
    #[arg(long, value_name = "PART", default_value = "0.95", value_parser = part)]
    confidence: f64,
    /// Write a page with tables and pictures.
    #[cfg(feature = "chart")]
    #[arg(long, value_name = "FILE.html")]
    html: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

fn part(text: &str) -> Result<f64, String> {
    let part: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    if part > 0.0 && part < 1.0 {
        Ok(part)
    } else {
        Err(format!("{part} given, a part is above 0 and below 1"))
    }
}

pub(super) fn report(args: &ReportArgs) -> Result<Status, CliError> {
    let path = &args.sweep;
    let sweep = super::sweep::read(path)?;
    let table = match &args.table {
        Some(table) => table.clone(),
        None => named_after(path, "csv")?,
    };
    // Until it is finished it has another name.
    let part = crate::log::part_path(&table);
    let table = if !table.exists() && part.exists() { part } else { table };
    let asked = Asked {
        quantiles: args.quantiles.clone(),
        holds: args.probability.clone(),
        confidence: args.confidence,
    };
    let found = sweep.report(&table, &asked)?;
    #[cfg(feature = "chart")]
    if let Some(path) = &args.html {
        super::may_write(path)?;
        let page = crate::chart::report(&found)?;
        super::write_whole(path, page.as_bytes())?;
    }
    if args.json {
        print_json(&found)?;
    } else {
        show(text(&found))?;
    }
    Ok(Status::SUCCESS)
}

/// Formats an interval.
fn between(figure: &Figure) -> String {
    let end = |end: Option<f64>| end.map_or_else(|| "open".to_owned(), |x| format!("{x:.3e}"));
    format!("({} to {})", end(figure.low), end(figure.high))
}

fn text(found: &Report) -> String {
    let mut text = String::new();
    let counts = found.counts;
    let _ = writeln!(
        text,
        "{}: {} members succeeded, {} failed, {} were refused, {} have no line yet; intervals hold with {} %",
        found.name,
        counts.succeeded,
        counts.failed,
        counts.refused,
        found.missing,
        100.0 * found.confidence
    );
    for column in &found.columns {
        let _ = writeln!(
            text,
            "\n{}\n  mean      {:.4e} +- {:.1e}, of {}",
            column.name, column.mean, column.standard_error, column.count
        );
        if !column.quantiles.is_empty() && column.count < counts.succeeded {
            let none = counts.succeeded - column.count;
            let _ = writeln!(text, "  quantiles of those that have one: {none} have none");
        }
        for (part, figure) in &column.quantiles {
            let _ = writeln!(
                text,
                "  {:<8}  {:.4e} {}",
                format!("{} %", 100.0 * part),
                figure.value,
                between(figure)
            );
        }
        for (field, figure) in &column.rank_correlations {
            let _ = writeln!(
                text,
                "  with {field}  rank correlation {:.3} {}",
                figure.value,
                between(figure)
            );
        }
        for (field, sobol) in &column.sobol {
            let (first, total) = (&sobol.first, &sobol.total);
            let _ = writeln!(
                text,
                "  of {field}  first index {:.3} {}, total {:.3} {}",
                first.value,
                between(first),
                total.value,
                between(total)
            );
        }
    }
    for one in &found.probabilities {
        let sign = if one.holds.below { '<' } else { '>' };
        let _ = writeln!(
            text,
            "\nP({} {sign} {}) = {:.4} {}",
            one.holds.column,
            one.holds.limit,
            one.part.value,
            between(&one.part)
        );
    }
    if let Some(mean) = &found.attitude {
        let [w, x, y, z] = mean.quaternion;
        let spread = (0..3).map(|i| mean.covariance_rad2[i][i].sqrt());
        let spread: Vec<String> = spread.map(|x| format!("{x:.3e}")).collect();
        let _ = writeln!(
            text,
            "\nlast attitudes about ({w:.6}, {x:.6}, {y:.6}, {z:.6}), standard deviations {} rad about the axes of the body",
            spread.join(", ")
        );
    }
    text
}
