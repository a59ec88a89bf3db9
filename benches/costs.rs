//! Costs of the parts of a step: `cargo bench --bench costs > src/plan/costs.json` makes the table
//! by which plans are estimated and methods are chosen. Takes a few minutes on a machine that does
//! nothing else; a word after `--` keeps to the methods whose name contains it and prints their
//! estimates next to the measurements.

use std::io::Write;

use nalgebra::{DMatrix, DVector};
use serde_json::{Value, json};
use vpd::advise;
use vpd::method::{Integrator, Takes};
use vpd::scenario::Scenario;
use vpd::solve::tableau::Tableau;
use vpd::study::measure::{Effort, effort};

const GAUSS: &[&str] = &["gauss1", "gauss2", "gauss3", "gauss4", "gauss5", "gauss6", "gauss8"];
const FEW: &[&str] = &["gauss1", "gauss2", "gauss4"];
/// Prefix of the name of a tableau: one next to it that is not symplectic.
const BY_SWEEPS: &str = "next to ";
const EXPLICIT: &[&str] = &["rk3", "rk4", "rk8"];
const ORDERS: &[&str] = &["2", "4", "8"];
const DIMENSIONS: [usize; 8] = [2, 3, 4, 5, 6, 8, 12, 16];
const KINDS: [&str; 4] = ["uniform", "point_source", "spring", "gravity_gradient"];
/// Number of terms in the two scenes by which the cost of a term is found.
const TERMS: [usize; 2] = [2, 16];
/// A step that few sweeps solve, in radians.
const SMALL_RAD: f64 = 0.02;
/// Terms, and radians of a step, of the runs that a method's costs are fitted to.
const RUNS: [(usize, f64); 9] = [
    (1, SMALL_RAD),
    (1, 0.2),
    (1, 0.6),
    (1, LARGE_RAD),
    (4, 0.2),
    (16, SMALL_RAD),
    (16, 0.6),
    (16, LARGE_RAD),
    (200, 0.2),
];
/// A step that many stages can take and few cannot: a run that fails is left out.
const LARGE_RAD: f64 = 1.2;

fn main() {
    let asked: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    if !asked.is_empty() {
        compare(&asked);
        return;
    }
    let terms: Vec<Value> = DIMENSIONS.iter().map(|&n| terms_of(n)).collect();
    let mut schemes = Vec::new();
    for (method, tableau, n) in measured() {
        schemes.push(scheme(method, tableau, n, &terms));
    }
    for (method, tableau, n) in swept() {
        schemes.push(scheme(method, &format!("{BY_SWEEPS}{tableau}"), n, &terms));
    }
    let line = |row: &Value| format!("    {row}");
    let lines = |rows: &[Value]| rows.iter().map(line).collect::<Vec<_>>().join(",\n");
    say(&format!(
        "{{\n  \"terms\": [\n{}\n  ],\n  \"schemes\": [\n{}\n  ]\n}}",
        lines(&terms),
        lines(&schemes)
    ));
}

/// Returns the methods that have costs of their own, with tableaux or orders, in the dimensions
/// where each runs.
fn measured() -> impl Iterator<Item = (Integrator, &'static str, usize)> {
    let own = Integrator::ALL.iter().copied().filter(|method| method.costs_as() == *method);
    own.flat_map(|method| {
        let tableaux = match method.facts().takes {
            _ if method == Integrator::VpdLagrangian => FEW,
            Takes::Tableau | Takes::Gauss => GAUSS,
            Takes::Explicit => EXPLICIT,
            Takes::Order => ORDERS,
        };
        let dimensions =
            move || DIMENSIONS.into_iter().filter(move |n| !method.facts().three || *n == 3);
        tableaux.iter().flat_map(move |tableau| dimensions().map(move |n| (method, *tableau, n)))
    })
}

/// Returns those of them that solve by sweeps over the unknowns, where the tableau is not
/// symplectic.
fn swept() -> impl Iterator<Item = (Integrator, &'static str, usize)> {
    let methods = [Integrator::Vpd, Integrator::VpdLagrangian, Integrator::VpdReduced];
    methods.into_iter().flat_map(|method| {
        // The others have lanes for n = 3, of any tableau.
        let has = move |n: &usize| *n != 3 || method == Integrator::VpdLagrangian;
        let dimensions = move || DIMENSIONS.into_iter().filter(has);
        FEW.iter().flat_map(move |tableau| dimensions().map(move |n| (method, *tableau, n)))
    })
}

fn say(line: &str) {
    // A reader that has gone away is no failure of a bench.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn rounded(ns: f64) -> f64 {
    (ns.max(0.0) * 100.0).round() / 100.0
}

/// Returns the cost that a term of each kind adds to a gradient: by the classical method, whose
/// four stages are gradients and little else.
fn terms_of(n: usize) -> Value {
    let cost = |kind: &str| {
        let [few, many] = TERMS.map(|count| timed("rk", "rk4", n, &[kind], count, SMALL_RAD));
        (many.step_ns - few.step_ns) / (few.gradients * (TERMS[1] - TERMS[0]) as f64)
    };
    let mut row = json!({ "n": n });
    for kind in KINDS {
        row[kind] = json!(rounded(cost(kind)));
    }
    row
}

/// Fits `t = step + sweeps sweep + passes pass + gradients share (costs of their terms by
/// themselves)`: least squares of the relative misses.
fn scheme(method: Integrator, tableau: &str, n: usize, terms: &[Value]) -> Value {
    let row = terms.iter().find(|row| row["n"] == n).expect("a row for each n");
    let own = |count: usize| -> f64 {
        (0..count).filter_map(|k| row[KINDS[k % KINDS.len()]].as_f64()).sum()
    };
    let mut equations = Vec::new();
    for (count, turn) in RUNS {
        let count = if method.facts().free { 0 } else { count };
        let run = timed(method.as_str(), tableau, n, &KINDS, count, turn);
        if !run.step_ns.is_finite() {
            continue;
        }
        let gradients = if count > 0 { run.gradients } else { 0.0 };
        let row = [1.0, run.sweeps, run.passes, gradients * own(count)];
        equations.push(row.map(|part| part / run.step_ns));
    }
    let [step, sweep, pass, share] = fitted(&equations);
    let plan = advise::plan(&scenario(method.as_str(), tableau, n, &[], 0, SMALL_RAD))
        .expect("a good scene");
    let mut row = json!({
        "method": method.as_str(), "stages": plan.formulation.stages, "n": n, "step_ns": rounded(step),
        "sweep_ns": rounded(sweep), "terms": rounded(share),
    });
    if pass > 0.0 {
        row["pass_ns"] = json!(rounded(pass));
    }
    if tableau.starts_with(BY_SWEEPS) {
        row["swept"] = json!(true);
    }
    row
}

/// Returns the costs, none below zero, with which the rows come nearest to one: of all choices of
/// costs that are zero the best.
fn fitted(rows: &[[f64; 4]]) -> [f64; 4] {
    let mut best = ([0.0; 4], f64::INFINITY);
    for chosen in 1_u32..16 {
        let columns: Vec<usize> = (0..4).filter(|column| chosen >> column & 1 == 1).collect();
        let matrix = DMatrix::from_fn(rows.len(), columns.len(), |i, j| rows[i][columns[j]]);
        let ones = DVector::from_element(rows.len(), 1.0);
        let normal = matrix.tr_mul(&matrix);
        let Some(found) = normal.lu().solve(&matrix.tr_mul(&ones)) else { continue };
        let missed = (&matrix * &found - ones).norm();
        if found.iter().all(|&cost| cost >= 0.0) && missed < best.1 {
            let mut costs = [0.0; 4];
            for (&column, &cost) in columns.iter().zip(found.iter()) {
                costs[column] = cost;
            }
            best = (costs, missed);
        }
    }
    best.0
}

/// Prints estimates next to the measurements.
fn compare(asked: &[String]) {
    say("method,tableau,n,terms,turn_rad,ns,sweeps,passes,estimate_ns,ratio");
    for (method, tableau, n) in measured() {
        let name = method.as_str();
        if !asked.iter().any(|asked| name.contains(asked.as_str())) {
            continue;
        }
        for (count, turn) in [(0, 0.1), (3, 0.1), (3, 0.5), (3, LARGE_RAD), (100, 0.1)] {
            if method.facts().free && count > 0 {
                continue;
            }
            let scene = scenario(name, tableau, n, &KINDS, count, turn);
            let Effort { step_ns, sweeps, passes, .. } = effort(&scene).expect("a good scene");
            let estimate = advise::plan(&scene).expect("a good scene").step_ns;
            let ratio = estimate / step_ns;
            say(&format!(
                "{name},{tableau},{n},{count},{turn},{step_ns:.0},{sweeps:.2},{passes:.2},{estimate:.0},{ratio:.2}"
            ));
        }
    }
}

/// Returns a tableau so near to that of this name that it is no longer symplectic.
fn next_to(name: &str) -> Value {
    const OFF: f64 = 1e-9;
    let stages = name.strip_prefix("gauss").and_then(|stages| stages.parse().ok());
    let tableau = stages.and_then(Tableau::gauss).expect("a Gauss tableau");
    let stages = tableau.stages();
    let a = |i: usize, j: usize| tableau.a(i, j) + if i == j { OFF } else { 0.0 };
    let rows: Vec<Vec<f64>> = (0..stages).map(|i| (0..stages).map(|j| a(i, j)).collect()).collect();
    json!({ "a": rows, "b": (0..stages).map(|j| tableau.b(j)).collect::<Vec<f64>>() })
}

fn timed(method: &str, tableau: &str, n: usize, kinds: &[&str], count: usize, turn: f64) -> Effort {
    let scene = scenario(method, tableau, n, kinds, count, turn);
    let once = || effort(&scene).expect("a good scene");
    let (first, second) = (once(), once());
    if first.step_ns < second.step_ns { first } else { second }
}

/// Returns a body that turns by about `turn_rad` a step, with `count` terms of the kinds in turn,
/// which together pull about as much as one.
fn scenario(
    method: &str,
    tableau: &str,
    n: usize,
    kinds: &[&str],
    count: usize,
    turn_rad: f64,
) -> Scenario {
    let vector = |seed: usize, size: f64| -> Vec<f64> {
        (0..n).map(|i| size * ((seed * n + i + 1) as f64 * 0.618).fract() - 0.5 * size).collect()
    };
    let strength = 0.5 / count.max(1) as f64;
    let far = |seed: usize| vector(seed, 1.0).into_iter().map(|x| x + 2.0).collect::<Vec<f64>>();
    let term = |k: usize| match kinds[k % kinds.len()] {
        "uniform" => {
            json!({"kind": "uniform", "weight": strength, "body_point": vector(k, 1.0), "direction": vector(k + 7, 1.0)})
        }
        "point_source" => {
            json!({"kind": "point_source", "strength": strength, "body_point": vector(k, 1.0), "position": far(k)})
        }
        "spring" => {
            json!({"kind": "spring", "stiffness": strength, "rest_length": 0.5, "body_point": vector(k, 1.0), "position": far(k)})
        }
        "gravity_gradient" => {
            json!({"kind": "gravity_gradient", "strength": strength, "direction": vector(k, 1.0)})
        }
        kind => panic!("no term of the kind {kind}"),
    };
    let moments: Vec<f64> = (0..n).map(|i| 0.5 + 0.1 * i as f64).collect();
    let rate = |i: usize, j: usize| ((n * i + j + 1) as f64 * 0.317).fract() / n as f64;
    let velocity: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let entry = |j: usize| match i.cmp(&j) {
                std::cmp::Ordering::Less => rate(i, j),
                std::cmp::Ordering::Equal => 0.0,
                std::cmp::Ordering::Greater => -rate(j, i),
            };
            (0..n).map(entry).collect()
        })
        .collect();
    let mut chosen = json!({ "name": method });
    if let Some(tableau) = tableau.strip_prefix(BY_SWEEPS) {
        chosen["tableau"] = next_to(tableau);
    } else if let Ok(order) = tableau.parse::<u32>() {
        chosen["order"] = json!(order);
    } else {
        chosen["tableau"] = json!(tableau);
    }
    // The velocity's size is between a half and one.
    let scenario: Value = json!({
        "name": "cost", "method": chosen, "step_s": turn_rad, "steps": 40, "log": {"every": 40},
        "scene": {
            "inertia": {"second_moments": moments},
            "potential": (0..count).map(term).collect::<Vec<_>>(),
            "initial": {"angular_velocity": {"body": velocity}}
        }
    });
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scene")
}
