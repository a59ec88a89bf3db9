//! VPD and its comparison methods from n = 3 to 32, on a body that two springs pull:
//! `cargo bench --bench any_n -- docs/any-n` prints the table of docs/performance.md and draws its
//! charts: time against error, and the cost of an accuracy against n.
//!
//! Steps are halved until the error is that of the reference; times are the least of several turns in which all runs take
//! part. A few minutes.

use std::error::Error;
use std::io::Write;
use std::path::PathBuf;

use serde_json::{Value, json};
use vpd::chart::{Axis, Line, Plot, Scale, Style, precision as charts, write};
use vpd::scenario::Scenario;
use vpd::study::precision::{Precision, precision};
use vpd::study::table::Row;
use vpd::study::{Entry, Watch};

/// Values of n that have a row; those with a chart of time against error have `true`.
const DIMENSIONS: [(usize, bool); 8] =
    [(3, true), (4, true), (5, true), (6, false), (8, true), (12, false), (16, false), (32, false)];
const METHODS: [(&str, &str); 9] = [
    ("vpd", "gauss2"),
    ("vpd", "gauss4"),
    ("vpd", "gauss8"),
    ("vrkmk", "gauss2"),
    ("vrkmk", "gauss4"),
    ("vrkmk", "gauss8"),
    ("rk_projected", "rk4"),
    ("rk_projected", "rk8"),
    ("rkmk", "rk8"),
];
/// The implicit comparison method takes minutes beyond this n.
const LARGEST_OF_VRKMK: usize = 16;
/// The accuracies of the table; the charts over n are drawn of the second.
const ERRORS: [f64; 3] = [1e-5, 1e-8, 1e-11];
const UNTIL_S: f64 = 1.0;

fn main() -> Result<(), Box<dyn Error>> {
    // Arguments of cargo's own begin with dashes.
    let directory = std::env::args().skip(1).find(|arg| !arg.starts_with('-'));
    let directory = directory.map(PathBuf::from);
    say(
        "| n | error at most | method | h, s | error | us a step | us a unit |\n|---|---|---|---|---|---|---|",
    );
    let mut curves: Vec<Curve> = Vec::new();
    for (n, charted) in DIMENSIONS {
        let (scene, entries) = scene(n)?;
        let study = precision(&scene, &entries, Some(UNTIL_S), &Watch::default())?;
        for error in ERRORS {
            for (k, entry) in entries.iter().enumerate() {
                let Some((row, step_us)) = cheapest_row(&study, k, error) else { continue };
                let unit_us = step_us / row.step_s;
                say(&format!(
                    "| {n} | {error:.0e} | {} | {:.4} | {:.1e} | {step_us:.2} | {unit_us:.1} |",
                    entry.label(),
                    row.step_s,
                    row.error.unwrap_or(f64::NAN),
                ));
                if error == ERRORS[1] {
                    let label = entry.label();
                    let at = curves.iter().position(|curve| curve.label == label);
                    let at = at.unwrap_or_else(|| {
                        curves.push(Curve { label, steps: Vec::new(), units: Vec::new() });
                        curves.len() - 1
                    });
                    curves[at].steps.push((n as f64, step_us));
                    curves[at].units.push((n as f64, unit_us));
                }
            }
        }
        if let Some(directory) = directory.as_ref().filter(|_| charted) {
            let drawn = charts(&format!("n = {n}"), &entries, &study)?;
            let time = drawn.into_iter().filter(|(name, _)| *name == "time.svg");
            let time: Vec<_> = time.map(|(_, svg)| (format!("time-{n}.svg"), svg)).collect();
            write(directory, &time)?;
        }
    }
    if let Some(directory) = directory {
        let mut families: Vec<&str> = METHODS.iter().map(|(name, _)| *name).collect();
        families.dedup();
        let line = |(label, points): (String, Vec<(f64, f64)>)| {
            let of = |name: &&str| label.split(' ').next() == Some(*name);
            let color = families.iter().position(of).unwrap_or(0);
            let before = METHODS.iter().filter(|(name, _)| of(name));
            let member = before.take_while(|(_, tableau)| !label.ends_with(tableau)).count();
            Line { label, points, style: Style { color, shade: 0, member, marked: true } }
        };
        let plot = |what: &str, lines: Vec<(String, Vec<(f64, f64)>)>| Plot {
            title: format!("{what}, at an error of {:.0e}", ERRORS[1]),
            x: Axis { label: "n", scale: Scale::Log },
            y: Axis { label: "time, us", scale: Scale::Log },
            lines: lines.into_iter().map(line).collect(),
            points: Vec::new(),
            rings: Vec::new(),
            guides: vec![[(3.0, 1.0), (30.0, 316.0)]],
            guide_label: "n^2.5".to_owned(),
        };
        let (steps, units) = curves
            .into_iter()
            .map(|Curve { label, steps, units }| ((label.clone(), steps), (label, units)))
            .unzip();
        let step = plot("The cost of a step against n", steps).draw()?;
        let unit = plot("The cost of a unit of time against n", units).draw()?;
        write(&directory, &[("step.svg", step), ("unit.svg", unit)])?;
    }
    Ok(())
}

/// Costs of a method for each n, in microseconds.
struct Curve {
    label: String,
    /// Cost of a step.
    steps: Vec<(f64, f64)>,
    /// Cost of a unit of time.
    units: Vec<(f64, f64)>,
}

fn say(line: &str) {
    // A reader that has gone away is no failure of a bench.
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Returns the cheapest of the runs of a method whose error is small enough, with the microseconds
/// of a step.
fn cheapest_row(study: &Precision, line: usize, error: f64) -> Option<(&Row, f64)> {
    let rows = study.table.rows[study.lines[line].clone()].iter();
    let fits = rows.filter(|row| row.error.is_some_and(|of| of <= error));
    let timed = fits.filter_map(|row| Some((row, row.ns_per_step? * 1e-3)));
    timed.min_by(|a, b| (a.1 / a.0.step_s).total_cmp(&(b.1 / b.0.step_s)))
}

/// Returns two springs and a body that turns by about one radian a second, and the methods that run
/// there.
fn scene(n: usize) -> Result<(Scenario, Vec<Entry>), Box<dyn Error>> {
    let vector =
        |a: f64, b: f64| -> Vec<f64> { (0..n).map(|i| a + b * (i as f64 * 1.7).sin()).collect() };
    let rate = |i: usize, j: usize| 1.0 / (1 + i + j) as f64;
    let squares: f64 = (0..n).flat_map(|i| (0..i).map(move |j| rate(i, j) * rate(i, j))).sum();
    let entry = |i: usize, j: usize| match i.cmp(&j) {
        std::cmp::Ordering::Less => rate(i, j) / squares.sqrt(),
        std::cmp::Ordering::Equal => 0.0,
        std::cmp::Ordering::Greater => -rate(i, j) / squares.sqrt(),
    };
    let velocity: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
    let moments: Vec<f64> = (0..n).map(|i| 1.0 + 0.2 * i as f64).collect();
    let with = |method: Value| -> Result<Scenario, Box<dyn Error>> {
        let scene = json!({
            "name": format!("springs-{n}"),
            "scene": {
                "inertia": { "second_moments": moments },
                "potential": [
                    {"kind": "spring", "stiffness": 0.8, "rest_length": 0.4,
                     "body_point": vector(0.1, 0.6), "position": vector(1.0, -0.4)},
                    {"kind": "spring", "stiffness": 0.5, "rest_length": 0.1,
                     "body_point": vector(-0.3, 0.5), "position": vector(-1.2, 0.3)},
                ],
                "initial": { "angular_velocity": { "body": velocity } },
            },
            "method": method,
            "step_s": 0.01,
            "steps": 100,
        });
        Ok(Scenario::from_json(scene.to_string().as_bytes())?)
    };
    let methods = METHODS.iter().filter(|(name, _)| *name != "vrkmk" || n <= LARGEST_OF_VRKMK);
    let mut entries = Vec::new();
    for (name, tableau) in methods {
        let scenario = with(json!({ "name": name, "tableau": tableau }))?;
        entries.push(Entry::new(&scenario, scenario.method.clone())?);
    }
    Ok((with(json!({ "name": "vpd", "tableau": "gauss2" }))?, entries))
}
