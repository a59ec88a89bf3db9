//! Scenes at the ends of what is accepted, drawn at random: each is planned or refused, and a few steps of it make a
//! log of finite numbers. `VPD_FAULTS=10` draws ten times as many; `VPD_SEED` draws others,
//! and `VPD_ONLY=12,345` tries these alone.
//!
//! Each is refused, or planned and run. Times are printed next to the estimates and decide nothing.

use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Instant;

use serde_json::{Value, json};
use vpd::advise::{self, Settled};
use vpd::log::reader::read_samples;
use vpd::plan::Plan;
use vpd::run::{Control, JobContext, Outcome, execute};
use vpd::scenario::Scenario;
use vpd::solve::so::{self, Mat};
use vpd::study::Watch;

/// Scenes in CI.
const SCENES: usize = 200;
/// Estimated time of the steps that are made; at least one is.
const RUN_NS: f64 = 2e7;
/// The shortest time of this many runs counts: the machine is shared.
const RUNS: usize = 3;

struct Draw(u64);

impl Draw {
    fn below(&mut self, end: usize) -> usize {
        (super::log::next(&mut self.0) >> 16) as usize % end
    }

    fn unit(&mut self) -> f64 {
        self.below(1 << 40) as f64 / (1_u64 << 40) as f64
    }

    fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    fn of<'a, T>(&mut self, list: &'a [T]) -> &'a T {
        &list[self.below(list.len())]
    }

    /// Draws a number from 10^low to 10^high, evenly in the exponent.
    fn size(&mut self, low: f64, high: f64) -> f64 {
        10_f64.powf(low + (high - low) * self.unit())
    }

    fn sign(&mut self) -> f64 {
        if self.one_in(2) { -1.0 } else { 1.0 }
    }

    /// Draws a scale; about one in two scenes is of usual size.
    fn scale(&mut self, wild: bool) -> f64 {
        if wild { self.size(-14.9, 14.9) } else { self.size(-1.0, 1.0) }
    }

    /// Components of one size, now and then of all sizes, denormal ones too.
    fn vector(&mut self, n: usize, wild: bool) -> Vec<f64> {
        let scale = self.scale(wild);
        let mut vector: Vec<f64> =
            (0..n).map(|_| scale * (0.1 + self.unit()) * self.sign()).collect();
        for x in &mut vector {
            match self.below(12) {
                0 => *x = 0.0,
                1 if wild => *x = self.size(-323.0, 14.9),
                _ => {}
            }
        }
        vector
    }

    fn skew(&mut self, n: usize, wild: bool) -> Vec<Vec<f64>> {
        let scale = self.scale(wild);
        let mut rows = vec![vec![0.0; n]; n];
        for i in 0..n {
            for j in 0..i {
                let x = scale * (2.0 * self.unit() - 1.0);
                (rows[i][j], rows[j][i]) = (x, -x);
            }
        }
        rows
    }

    fn term(&mut self, n: usize, wild: bool) -> Value {
        let strength =
            if wild { self.size(-29.0, 14.9) } else { self.size(-2.0, 1.0) } * self.sign();
        match self.below(4) {
            0 => {
                json!({"kind": "uniform", "weight": strength, "body_point": self.vector(n, wild), "direction": self.vector(n, wild)})
            }
            1 => {
                json!({"kind": "point_source", "strength": strength, "body_point": self.vector(n, wild), "position": self.vector(n, wild)})
            }
            2 => {
                json!({"kind": "spring", "stiffness": strength, "rest_length": self.scale(wild), "body_point": self.vector(n, wild), "position": self.vector(n, wild)})
            }
            _ => {
                json!({"kind": "gravity_gradient", "strength": strength, "direction": self.vector(n, wild)})
            }
        }
    }

    fn method(&mut self, n: usize) -> Value {
        let gauss = ["gauss1", "gauss2", "gauss3", "gauss4", "gauss6", "gauss8", "rk3"];
        let kind = *self.of(&["auto", "auto", "auto", "fixed_point", "newton"]);
        let any = if n == 3 { 12 } else { 8 };
        match self.below(any) {
            0 => json!({}),
            1 | 2 => json!({"name": "vpd", "tableau": self.of(&gauss), "solver": {"kind": kind}}),
            3 => {
                json!({"name": "vpd_lagrangian", "tableau": self.of(&gauss), "solver": {"kind": kind}})
            }
            4 => json!({"name": "vpd_reduced", "tableau": self.of(&gauss)}),
            5 => {
                json!({"name": self.of(&["vrkmk", "vrkmk_projected"]), "tableau": self.of(&gauss), "solver": {"kind": kind}})
            }
            6 => {
                json!({"name": self.of(&["rkmk", "rk", "rk_projected"]), "tableau": self.of(&["rk3", "rk4"])})
            }
            7 => json!({"tableau": {"a": [[0.3, -0.1], [0.5, 0.25]], "b": [0.6, 0.4]}}),
            8 => json!({"name": "splitting", "order": self.of(&[2, 4, 6, 8])}),
            9 => json!({"name": "lgvi", "order": self.of(&[2, 4, 6, 8])}),
            _ => json!({"name": "quaternion_gauss", "tableau": self.of(&gauss[..6])}),
        }
    }

    fn scenario(&mut self) -> Value {
        let n = if self.one_in(2) { 3 } else { 2 + self.below(15) };
        let wild = self.one_in(2);
        let inertia = match self.below(if n == 3 { 3 } else { 1 }) {
            1 => {
                let end = if wild { 11.99 } else { 2.0 };
                let moments: Vec<f64> = (0..3).map(|_| self.size(-end, end)).collect();
                json!({ "principal": moments })
            }
            // The matrix is nearly singular.
            2 => {
                json!({"matrix": [[1.0, 0.9999999, 0.0], [0.9999999, 1.0, 0.0], [0.0, 0.0, self.size(-3.0, 3.0)]]})
            }
            _ => {
                let scale = if wild { self.size(-11.0, 10.0) } else { 1.0 };
                json!({"second_moments": (0..n).map(|_| scale * self.size(-1.0, 0.5)).collect::<Vec<_>>()})
            }
        };
        let terms = match self.below(8) {
            0 | 1 => 0,
            2..=5 => 1 + self.below(5),
            _ => self.size(0.5, 3.0) as usize,
        };
        let steps = self.size(0.0, 9.0) as u64;
        let mut scenario = json!({
            "name": "extreme",
            "scene": {
                "inertia": inertia,
                "potential": (0..terms).map(|_| self.term(n, wild)).collect::<Vec<_>>(),
                "initial": {},
            },
            "log": {"every": (steps / 50).max(1)},
        });
        let frame = *self.of(&["body", "space"]);
        match self.below(3) {
            0 => {}
            1 => scenario["scene"]["initial"]["momentum"] = json!({frame: self.skew(n, wild)}),
            _ => {
                scenario["scene"]["initial"]["angular_velocity"] =
                    json!({frame: self.skew(n, wild)})
            }
        }
        if self.one_in(20) {
            scenario["accuracy"] = json!({"error": self.size(-12.9, -1.1)});
            scenario["duration_s"] = json!(self.size(-3.0, 9.3));
        } else {
            scenario["method"] = self.method(n);
            scenario["step_s"] =
                json!(if wild { self.size(-12.0, 0.0) } else { self.size(-3.0, -1.0) });
            scenario["steps"] = json!(steps);
        }
        if self.one_in(10) {
            scenario["ensemble"] = json!({"members": 2 + self.below(100_000), "attitude_spread_rad": self.size(-14.0, 0.4), "momentum_spread": self.scale(wild)});
        }
        scenario
    }
}

/// Results of the trials.
#[derive(Default)]
struct Seen {
    accepted: usize,
    refused: usize,
    run: usize,
    runs_s: Vec<(f64, usize)>,
    succeeded: usize,
    plans_s: Vec<(f64, usize)>,
    choices_s: Vec<(f64, usize)>,
    /// Time of the run, in parts of the estimate.
    ratios: Vec<(f64, usize)>,
    /// Time of a step, in parts of the estimate, where steps are half of the run.
    of_steps: Vec<(f64, usize)>,
    /// The same for runs that fail: they end earlier.
    failed: Vec<(f64, usize)>,
}

#[test]
fn extreme_scenes_are_planned_or_refused() {
    let seed = std::env::var("VPD_SEED").ok().and_then(|text| text.parse().ok());
    let seed = seed.unwrap_or(20_261_122);
    println!("VPD_SEED={seed}");
    // Only the scenes that a figure has pointed at.
    let only = std::env::var("VPD_ONLY").ok();
    let only: Option<Vec<usize>> =
        only.map(|text| text.split(',').filter_map(|number| number.parse().ok()).collect());
    let directory = tempfile::tempdir().expect("a temporary directory");
    let mut draw = Draw(seed);
    let mut seen = Seen::default();
    for number in 0..SCENES * super::faults::scale() {
        let scenario = draw.scenario();
        if !only.as_ref().is_none_or(|only| only.contains(&number)) {
            continue;
        }
        try_one(&scenario, number, directory.path(), &mut seen);
    }
    let Seen { accepted, refused, run, succeeded, .. } = seen;
    // Each accepted scene made its log: finite numbers, by an estimate that is finite.
    assert_eq!(run, accepted);
    println!("{accepted} planned, {refused} refused; {run} run, {succeeded} to their end");
    let slowest = |mut list: Vec<(f64, usize)>| {
        list.sort_by(|a, b| b.0.total_cmp(&a.0));
        list.iter().take(5).map(|(s, k)| format!("{s:.4} s (#{k})")).collect::<Vec<_>>().join(", ")
    };
    println!("slowest plans: {}", slowest(seen.plans_s));
    println!("slowest choices for an accuracy: {}", slowest(seen.choices_s));
    println!("slowest runs, failures and their advice included: {}", slowest(seen.runs_s));
    let ratios = |what: &str, mut list: Vec<(f64, usize)>| {
        list.sort_by(|a, b| a.0.total_cmp(&b.0));
        let within = |factor: f64| {
            let near = list.iter().filter(|(r, _)| (1.0 / factor..=factor).contains(r)).count();
            format!("{near} within {factor}")
        };
        println!(
            "{what} / estimate, of {}: {}, {}, {}",
            list.len(),
            within(1.5),
            within(2.0),
            within(5.0)
        );
        let ends = list.iter().take(8).chain(list.iter().rev().take(8));
        println!("furthest: {:?}", ends.map(|(r, k)| format!("{r:.2} (#{k})")).collect::<Vec<_>>());
    };
    ratios("run", seen.ratios);
    ratios("steps", seen.of_steps);
    ratios("runs that fail", seen.failed);
    assert!(only.is_some() || (accepted > 0 && refused > 0 && succeeded > 0));
}

/// A worker's thread has two mebibytes.
#[test]
fn a_large_turn_needs_little_stack() {
    let turned = std::thread::Builder::new().stack_size(512 << 10).spawn(|| {
        let mut turn = Mat::<16>::zeros();
        (turn[(0, 1)], turn[(1, 0)]) = (9e5, -9e5);
        so::orthogonality_error(&so::exp(&turn))
    });
    let error = turned.expect("a thread").join().expect("no panic");
    assert!(error < 1e-9, "{error:e}");
}

fn try_one(scenario: &Value, number: usize, directory: &Path, seen: &mut Seen) {
    let text = scenario.to_string();
    // Kept for finding the scene that ended the process.
    if std::env::var_os("VPD_TRACE").is_some() {
        println!("#{number} {text}");
    }
    let begun = Instant::now();
    // A choice may cost a fraction of the usual limit, unless a hundred times as many are drawn.
    let allowance_ns = (super::faults::scale() < 100).then(|| 300_000_000.into());
    let watch = Watch { allowance_ns, ..Watch::default() };
    let planned = Scenario::from_json(text.as_bytes())
        .and_then(|scenario| Settled::new(&scenario, &watch)?.plan());
    let time_s = begun.elapsed().as_secs_f64();
    let of_choice = scenario.get("accuracy").is_some();
    if of_choice { &mut seen.choices_s } else { &mut seen.plans_s }.push((time_s, number));
    let Ok(plan) = planned else {
        seen.refused += 1;
        return;
    };
    seen.accepted += 1;
    let estimates = [plan.run_s, plan.step_ns, plan.step_s];
    assert!(estimates.iter().all(|x| x.is_finite() && *x > 0.0), "{estimates:?}: {text}");
    assert!(plan.samples_per_chunk > 0 && plan.memory_bytes < u64::MAX, "{text}");
    let members = plan.ensemble.as_ref().map_or(1.0, |_| 8.0);
    let steps = (RUN_NS / plan.step_ns / members).clamp(1.0, 2000.0) as u64;
    // With the method and the step that were chosen for an accuracy.
    let mut short = plan.settled.clone();
    short.steps = Some(steps.min(plan.steps));
    short.log.every = Some((steps / 10).max(1));
    if let Some(ensemble) = &mut short.ensemble {
        ensemble.members = 8;
    }
    let estimate: Plan = advise::plan(&short).expect("it is shorter");
    let path = directory.join("log.mcap");
    let control = Control::default();
    // A search for a better step takes up to two seconds: for many scenes some are enough.
    if !number.is_multiple_of(super::faults::scale()) {
        control.settling.cancelled.store(true, Ordering::Relaxed);
    }
    let begun = Instant::now();
    let summary = execute(&estimate, &JobContext { log: &path, control: &control })
        .unwrap_or_else(|error| panic!("{error}: {text}"));
    seen.run += 1;
    seen.runs_s.push((begun.elapsed().as_secs_f64(), number));
    read_samples(&path, |_, message| {
        let numbers = format!("{message:?}");
        assert!(!numbers.contains("NaN") && !numbers.contains("inf"), "{numbers}: {text}");
    })
    .unwrap_or_else(|error| panic!("{error}: {text}"));
    let trace = std::env::var_os("VPD_TRACE").is_some();
    let estimated_ns = 1e9 * estimate.run_s;
    let all = summary.ensemble.as_ref().is_none_or(|members| members.succeeded == 8);
    let succeeded = summary.outcome == Outcome::Succeeded && all;
    seen.succeeded += usize::from(succeeded);
    // The time of a search for a better step is no part of the estimate.
    control.settling.cancelled.store(true, Ordering::Relaxed);
    let again = (1..RUNS).map(|_| {
        // Without this the run would be resumed.
        std::fs::remove_file(&path).expect("a log");
        let context = JobContext { log: &path, control: &control };
        let summary = execute(&estimate, &context).expect("as before");
        (summary.wall_s, summary.ns_per_step)
    });
    let (wall_s, step_ns) = again.fold((summary.wall_s, summary.ns_per_step), |least, next| {
        (least.0.min(next.0), least.1.min(next.1))
    });
    let ratio = 1e9 * wall_s / estimated_ns;
    let of_steps = step_ns / estimate.step_ns;
    if succeeded { &mut seen.ratios } else { &mut seen.failed }.push((ratio, number));
    let steps_ns = estimate.step_ns * estimate.steps as f64;
    let steps_matter = succeeded && members == 1.0 && 2.0 * steps_ns > estimated_ns;
    if steps_matter {
        seen.of_steps.push((of_steps, number));
    }
    if trace {
        let Plan { formulation, dimension, steps, step_ns, .. } = &estimate;
        println!(
            "#{number} {ratio:.2} {of_steps:.2} {steps_matter} {steps} steps of {step_ns:.0} ns, {members} members, ended at {}: {succeeded}, {} iterations, n = {dimension}, {:.1} ms: {formulation:?}",
            summary.steps,
            summary.solver.iterations_per_step,
            1e3 * wall_s,
        );
    }
}
