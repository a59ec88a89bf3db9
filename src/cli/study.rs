//! `vpd chart` and `vpd stability`: studies of scenarios, and the charts of logs.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use clap::builder::{PathBufValueParser, TypedValueParser};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error as WordError, StrDeserializer};

use super::{Change, CliError, ScenarioArgs, Status, output_path, planned, show};
use crate::chart;
use crate::log::course::LogChart;
use crate::log::reader::is_log;
use crate::scenario::{
    Coefficients, Method, MethodName, Scenario, SolverKind, TableauChoice, TableauName,
};
use crate::study::long_term::long_term;
use crate::study::precision::{Precision, precision, timing};
use crate::study::stability::{Border, Resonance, stability_so_far};
use crate::study::{Entry, StudyError, Watch, all_methods, tell_apart, usual_methods};

#[derive(Debug, Args)]
pub(super) struct ChartArgs {
    /// Scenarios to study, or logs to draw; several logs go on one axis and are named after their files.
    #[arg(required = true, value_name = "SCENARIO|LOG.mcap")]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    study: StudyArgs,
    /// Compare the errors at this time, in seconds; by default after about one turn.
    #[arg(long, value_name = "SECONDS", value_parser = until, allow_negative_numbers = true)]
    until: Option<f64>,
}

fn until(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds @ 1e-9..=1e9) => Ok(seconds),
        _ => Err(format!("{text:?} given, 1e-9 to 1e9 s are allowed")),
    }
}

#[derive(Debug, Args)]
pub(super) struct StabilityArgs {
    /// The scenario, a JSON file; - reads it from stdin.
    scenario: PathBuf,
    #[command(flatten)]
    study: StudyArgs,
}

/// Arguments of all studies.
#[derive(Debug, Args)]
struct StudyArgs {
    /// Change a field of the scenario, named by its JSON pointer: --set /step_s=0.02
    #[arg(long = "set", value_name = "POINTER=VALUE")]
    changes: Vec<Change>,
    /// Study these methods in the place of the usual ones: vpd:gauss2, splitting:4, vpd:gauss4:fixed_point; coefficients go
    /// in the place of a tableau: 'vpd:{"a": [[0.5]], "b": [1]}'
    #[arg(long = "method", value_name = "NAME[:TABLEAU[:SOLVER]]")]
    methods: Vec<MethodWord>,
    /// Where charts and tables go; of several scenarios each gets a directory below it.
    #[arg(short, long, value_name = "DIR", default_value = ".", value_parser = PathBufValueParser::new().try_map(output_path))]
    output: PathBuf,
}

impl StudyArgs {
    fn scenario(&self, path: &Path) -> Result<Scenario, CliError> {
        let args = ScenarioArgs { scenario: path.to_owned(), changes: self.changes.clone() };
        Ok(planned(&args)?.settled)
    }

    fn entries(
        &self,
        path: &Path,
        scene: &Scenario,
        usual: fn(&Scenario) -> Vec<Entry>,
    ) -> Result<Vec<Entry>, CliError> {
        if self.methods.is_empty() {
            return Ok(usual(scene));
        }
        let wrong = |source| CliError::Scenario { path: path.to_owned(), source };
        let entry = |word: &MethodWord| Entry::new(scene, word.0.clone()).map_err(wrong);
        let mut entries: Vec<_> = self.methods.iter().map(entry).collect::<Result<_, _>>()?;
        tell_apart(&mut entries);
        Ok(entries)
    }
}

/// A method in one word, as in `vpd:gauss2`, or with coefficients for its tableau.
#[derive(Clone, Debug)]
struct MethodWord(Method);

impl FromStr for MethodWord {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        /// Parses a word as it is written in a scenario.
        fn word<'a, T: Deserialize<'a>>(text: &'a str) -> Result<T, String> {
            let reader: StrDeserializer<'a, WordError> = text.into_deserializer();
            T::deserialize(reader).map_err(|error| error.to_string())
        }
        let (name, mut rest) =
            text.split_once(':').map_or((text, None), |(name, rest)| (name, Some(rest)));
        let mut method = Method { name: word::<MethodName>(name)?, ..Method::default() };
        if let Some(json) = rest.filter(|rest| rest.starts_with('{')) {
            let end = json.rfind('}').ok_or("coefficients end with }")? + 1;
            let found = serde_json::from_slice::<Coefficients>(&json.as_bytes()[..end]);
            let found = found.map_err(|error| format!("the coefficients: {error}"))?;
            method.tableau = Some(TableauChoice::Custom(found));
            rest = match &json[end..] {
                "" => None,
                solver => Some(solver.strip_prefix(':').ok_or("a solver stands behind a colon")?),
            };
        }
        let mut parts = rest.into_iter().flat_map(|rest| rest.split(':'));
        if method.tableau.is_none()
            && let Some(part) = parts.next()
        {
            match part.parse() {
                Ok(order) => method.order = Some(order),
                Err(_) => method.tableau = Some(TableauChoice::Named(word::<TableauName>(part)?)),
            }
        }
        if let Some(part) = parts.next() {
            method.solver.kind = word::<SolverKind>(part)?;
        }
        match parts.next() {
            Some(_) => {
                Err("NAME, NAME:TABLEAU or NAME:ORDER is needed, perhaps with :SOLVER behind it"
                    .to_owned())
            }
            None => Ok(Self(method)),
        }
    }
}

/// Draws logs, or studies scenarios.
pub(super) fn draw(args: &ChartArgs) -> Result<Status, CliError> {
    // A file that cannot be read is reported when it is read as a scenario.
    let logs = args.inputs.iter().filter(|path| matches!(is_log(path), Ok(true))).count();
    if logs == args.inputs.len() {
        let drawn = chart::draw_logs(&args.inputs, &args.study.output)?;
        list(&drawn)?;
        for chart in [LogChart::Energy, LogChart::Orthogonality, LogChart::Momentum] {
            if !drawn.iter().any(|path| path.ends_with(chart.file())) {
                let _ = writeln!(
                    io::stderr(),
                    "{} is not drawn: no log holds this error",
                    chart.file()
                );
            }
        }
        return Ok(Status::SUCCESS);
    }
    if logs > 0 {
        return Err(CliError::Mixed);
    }
    may_hold(&args.study.output)?;
    for path in &args.inputs {
        let scene = args.study.scenario(path)?;
        let entries = args.study.entries(path, &scene, usual_methods)?;
        let directory = if args.inputs.len() == 1 {
            args.study.output.clone()
        } else {
            args.study.output.join(path.file_stem().unwrap_or_default())
        };
        let (exact, long) = followed(scene.name(), |watch| {
            let exact = precision(&scene, &entries, args.until, watch)?;
            Ok((exact, long_term(&scene, &entries, watch)?))
        })?;
        show(orders(&entries, &exact))?;
        let mut files = chart::precision(scene.name(), &entries, &exact)?;
        files.extend(chart::long_term(scene.name(), &entries, &long)?);
        files.push(("table.csv", exact.table.to_csv()));
        files.push(("table.json", exact.table.to_json()));
        files.push(("long-term.csv", long.table.to_csv()));
        files.push(("long-term.json", long.table.to_json()));
        list(&chart::write(&directory, &files)?)?;
    }
    Ok(Status::SUCCESS)
}

/// Refuses a folder that is something else, before anything is computed for it.
fn may_hold(folder: &Path) -> Result<(), CliError> {
    if folder.exists() && !folder.is_dir() {
        let source = io::ErrorKind::NotADirectory.into();
        return Err(CliError::Write { path: folder.to_owned(), source });
    }
    Ok(())
}

/// Draws the map of a scenario and lists the largest usable steps.
pub(super) fn map(args: &StabilityArgs) -> Result<Status, CliError> {
    may_hold(&args.study.output)?;
    let scene = args.study.scenario(&args.scenario)?;
    let entries = args.study.entries(&args.scenario, &scene, all_methods)?;
    let map = followed(scene.name(), |watch| stability_so_far(&scene, &entries, watch))?;
    let made = map.borders.len();
    if made < entries.len() {
        let all = entries.len();
        let _ = writeln!(io::stderr(), "stopped: what follows is of {made} of {all} methods");
    }
    let table = map.table();
    let borders = borders(&map.borders);
    show(&borders)?;
    let files = [
        ("stability.svg", chart::stability_map(scene.name(), &map)?),
        ("stability.csv", table.to_csv()),
        ("stability.json", table.to_json()),
        ("borders.txt", borders),
    ];
    list(&chart::write(&args.study.output, &files)?)?;
    Ok(Status::SUCCESS)
}

fn list(paths: &[PathBuf]) -> io::Result<()> {
    show(paths.iter().map(|path| format!("{}\n", path.display())).collect::<String>())
}

/// Formats the reference and the orders measured against it.
fn orders(entries: &[Entry], study: &Precision) -> String {
    let reference = &study.reference;
    let mut text = format!(
        "reference: t = {} s, known to {:.1e}; two methods agree to {:.1e}\n",
        reference.time_s, reference.error, reference.cross_check
    );
    for (line, entry) in entries.iter().enumerate() {
        let measured = study.measured_order(line);
        let measured = measured.map_or_else(|| "-".to_owned(), |order| format!("{order:.2}"));
        text += &format!("{:28} order {:>2}, measured {measured}\n", entry.label(), entry.order);
    }
    text += &format!("times: {}\n", timing());
    text
}

/// Formats the largest usable steps.
fn borders(borders: &[Border]) -> String {
    let mut text = format!("{:28} {:>12} {:>8}  beyond it\n", "method", "usable step", "turn");
    for border in borders {
        let figure = |x: Option<f64>, digits: usize| {
            x.map_or_else(|| "-".to_owned(), |x| format!("{x:.digits$}"))
        };
        let step = border.usable_step_s.map_or_else(|| "-".to_owned(), |x| format!("{x:.2e}"));
        text += &format!(
            "{:28} {step:>10} s {:>4} rad  {}\n",
            border.label,
            figure(border.turn_rad, 2),
            border.broken.unwrap_or("-"),
        );
        for Resonance {
            steps_per_swing, window_s: [from, to], worst_step_s, energy_error, ..
        } in &border.resonances
        {
            text += &format!(
                "{:28} from {from:.4e} to {to:.4e} s: energy off by {energy_error:.1e} J at {worst_step_s:.4e} s\n",
                format!("  resonance, {steps_per_swing} steps a swing")
            );
        }
    }
    text
}

/// Runs a study on its own thread. On a terminal a progress bar follows; elsewhere a line says how long it will take if that
/// is more than a minute, and then one a minute how far it is. Ctrl-C cancels it.
fn followed<T: Send>(
    name: &str,
    study: impl FnOnce(&Watch) -> Result<T, StudyError> + Send,
) -> Result<T, CliError> {
    /// Times between two lines: the first says how long it takes as soon as some runs have shown it.
    const FIRST_LINE: Duration = Duration::from_secs(3);
    const LINES: Duration = Duration::from_secs(60);
    let watch = Watch::default();
    let stop = watch.cancelled.clone();
    // Without a handler, ctrl-c ends the process.
    let _ = ctrlc::set_handler(move || stop.store(true, Ordering::Relaxed));
    let style = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} runs, {eta} left")
        .expect("the template is fixed and valid");
    let bar = if io::stderr().is_terminal() {
        ProgressBar::new(1).with_style(style).with_message(name.to_owned())
    } else {
        ProgressBar::hidden()
    };
    let begun = Instant::now();
    let mut line = FIRST_LINE;
    thread::scope(|scope| {
        let worker = scope.spawn(|| study(&watch));
        while !worker.is_finished() {
            let (done, total) =
                (watch.done.load(Ordering::Relaxed), watch.total.load(Ordering::Relaxed).max(1));
            bar.set_length(total);
            bar.set_position(done);
            let passed = begun.elapsed();
            if passed >= line && done > 0 {
                let left = passed.mul_f64(total.saturating_sub(done) as f64 / done as f64);
                if left >= LINES || passed >= LINES {
                    let text = format!(
                        "{name}: {done} of {total} runs, about {} min left; ctrl-c stops it",
                        left.as_secs().div_ceil(60)
                    );
                    bar.suspend(|| {
                        let _ = writeln!(io::stderr(), "{text}");
                    });
                }
                line = passed + LINES;
            }
            thread::sleep(Duration::from_millis(50));
        }
        bar.finish_and_clear();
        Ok(worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?)
    })
}
