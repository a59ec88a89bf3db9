//! `vpd export` and `vpd diff`: tables of logs, and comparisons of two.

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use clap::builder::{PathBufValueParser, PossibleValuesParser, TypedValueParser};

use super::{CliError, Status, a_log, enough, may_write, output_path, print_json, show, to_file};
use crate::diff::{self, Comparison, Quantity, Tolerance};
use crate::export::{self, Choice, ExportError, Format};
use crate::log::schema::Channel;
use crate::log::shown;

#[derive(Debug, Args)]
pub(super) struct ExportArgs {
    /// The log, finished or not.
    log: PathBuf,
    /// The table: .csv, .npz, .parquet or .arrow; CSV on stdout if absent.
    #[arg(short, long, value_name = "FILE", value_parser = PathBufValueParser::new().try_map(output_path))]
    output: Option<PathBuf>,
    /// Channels, separated by commas: any of samples, or /ensemble/members or /ensemble/statistics; all of samples if absent.
    #[arg(long = "channels", value_name = "TOPIC", value_delimiter = ',',
        value_parser = PossibleValuesParser::new(Channel::all().map(Channel::topic)))]
    channels: Vec<String>,
    /// The member of an ensemble whose samples are meant.
    #[arg(long, value_name = "K", default_value_t = 0)]
    member: u64,
    /// Write a bag of ROS 2 (.mcap): Imu, QuaternionStamped, TFMessage and Float64, n = 3.
    #[arg(long, requires = "output", conflicts_with = "channels")]
    ros2: bool,
    /// Replace a file that stands in its place.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
pub(super) struct DiffArgs {
    /// One log, finished or not.
    first: PathBuf,
    /// The other one.
    second: PathBuf,
    /// Largest difference that counts as none, in rad, kg m^2/s and J; or of one quantity alone: angle=1e-6, energy=1e-9. With
    /// none given each difference counts.
    #[arg(long = "tolerance", value_name = "[QUANTITY=]X")]
    tolerances: Vec<Tolerance>,
    /// The member of ensembles whose samples are compared.
    #[arg(long, value_name = "K", default_value_t = 0)]
    member: u64,
    /// Rows of the table over time, at most.
    #[arg(long, value_name = "N", default_value_t = 20)]
    rows: usize,
    /// Draw the differences over time.
    #[cfg(feature = "chart")]
    #[arg(long, value_name = "PICTURE.svg", value_parser = super::picture_path)]
    chart: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Writes a table.
pub(super) fn export(args: &ExportArgs) -> Result<Status, CliError> {
    let log = a_log(&args.log)?;
    let channels = args.channels.iter().filter_map(|topic| Channel::from_topic(topic)).collect();
    let choice = Choice { channels, member: args.member };
    let ending = match &args.output {
        None => match export::export(log, &choice, Format::Csv, BufWriter::new(io::stdout())) {
            Err(ExportError::Write(error)) => {
                return Ok(enough(Err(error)).map(|()| Status::SUCCESS)?);
            }
            exported => exported?.ending,
        },
        Some(path) => {
            may_write(path)?;
            let ending = path.extension().unwrap_or_default().to_string_lossy();
            let format = if args.ros2 {
                let is_bag = ending == "mcap";
                let wrong = || format!("{ending:?} is not the ending of a bag of ROS 2: use .mcap");
                is_bag.then_some(None).ok_or_else(wrong).map_err(CliError::Format)?
            } else {
                Some(ending.parse::<Format>().map_err(CliError::Format)?)
            };
            if !args.force && path.symlink_metadata().is_ok() {
                return Err(CliError::Exists(path.clone()));
            }
            let Some(format) = format else {
                let bag = to_file(path, |out| Ok(export::ros2(log, args.member, out)?))?;
                let topics = bag.topics.iter().map(|(topic, count)| format!("{count} of {topic}"));
                let topics = topics.collect::<Vec<_>>().join(", ");
                show(format!("bag             {}, messages: {topics}\n", path.display()))?;
                return Ok(reported(log, bag.ending.damage));
            };
            let exported = to_file(path, |out| Ok(export::export(log, &choice, format, out)?))?;
            let columns = exported.columns.len();
            show(format!(
                "table           {}, {} rows of {columns} columns\n",
                path.display(),
                exported.rows
            ))?;
            exported.ending
        }
    };
    Ok(reported(log, ending.damage))
}

/// Reports damage of a log on stderr: the table may be on stdout.
fn reported(log: &Path, damage: Option<String>) -> Status {
    if let Some(damage) = damage {
        let _ = writeln!(
            io::stderr(),
            "vpd: {}: {}; everything before that is exported",
            log.display(),
            shown(&damage)
        );
    }
    Status::SUCCESS
}

/// Compares two logs: 0 if they agree, 1 if they do not.
pub(super) fn diff(args: &DiffArgs) -> Result<Status, CliError> {
    let logs = [a_log(&args.first)?, a_log(&args.second)?];
    let mut found = diff::diff(logs, args.member, &args.tolerances)?;
    #[cfg(feature = "chart")]
    if let Some(path) = &args.chart {
        may_write(path)?;
        let names = logs.map(|log| log.display().to_string());
        let svg = crate::chart::differences(&names.join(" and "), &found)?;
        super::write_whole(path, svg.as_bytes())?;
    }
    let agree = found.agrees();
    found.over_time = found.rows(args.rows);
    if args.json {
        print_json(&found)?;
    } else {
        show(text(&found))?;
    }
    Ok(if agree { Status::SUCCESS } else { Status::from(1) })
}

/// Formats a comparison as a table and a few lines.
fn text(found: &Comparison) -> String {
    let columns: Vec<Quantity> = found.largest.iter().map(|largest| largest.quantity).collect();
    let mut text = format!("{:>14}", "time in s");
    for quantity in &columns {
        text += &format!("  {:>26}", format!("{} in {}", quantity.name(), quantity.unit()));
    }
    text += "\n";
    for row in &found.over_time {
        text += &format!("{:>14.6}", row.time_s);
        for (by, quantity) in row.by.iter().zip(Quantity::ALL) {
            if columns.contains(&quantity) {
                let by = by.map_or_else(|| "-".to_owned(), |by| format!("{by:.3e}"));
                text += &format!("  {by:>26}");
            }
        }
        text += "\n";
    }
    let Comparison { samples, only_first, only_second, .. } = found;
    text += &format!("samples           {samples} at the same times");
    if only_first + only_second > 0 {
        text += &format!(", {only_first} only in the first log, {only_second} only in the second");
    }
    text += "\n";
    for diff::Largest { quantity, unit, largest, time_s, last } in &found.largest {
        text += &format!(
            "{:<17} {largest:.3e} {unit} at most, at t = {time_s} s; {last:.3e} {unit} at the end\n",
            quantity.name()
        );
    }
    for (log, unfinished) in ["first", "second"].iter().zip(&found.unfinished) {
        if let Some(why) = unfinished {
            text += &format!("unfinished        the {log} log: {}\n", crate::log::shown(why));
        }
    }
    text += &match &found.first_beyond {
        None if !found.agrees() => {
            "they agree as far as both go, and one goes on alone\n".to_owned()
        }
        None => "they agree\n".to_owned(),
        Some(diff::Beyond { time_s, quantity, difference, tolerance }) => format!(
            "first beyond      t = {time_s} s: {} differs by {difference:.3e} {unit}, more than {tolerance:e} {unit}\n",
            quantity.name(),
            unit = quantity.unit()
        ),
    };
    text
}
