//! What a step costs, beside what the plan says of it: `cargo bench --bench costs` prints a table, from which the
//! figures in `src/plan/cost.rs` are made. One part alone by the method's name, as in `cargo bench --bench costs -- vpd`.

use std::io::Write;

use serde_json::{Value, json};
use vpd::advise;
use vpd::run::{Control, JobContext, execute};
use vpd::scenario::Scenario;

/// Methods with the tableau or the order, and whether they are for n = 3 alone.
const METHODS: &[(&str, &str, bool)] = &[
    ("vpd", "gauss1", false),
    ("vpd", "gauss2", false),
    ("vpd", "gauss4", false),
    ("vpd", "gauss8", false),
    ("vpd_lagrangian", "gauss2", false),
    ("vpd_reduced", "gauss2", false),
    ("vpd_reduced", "gauss8", false),
    ("vrkmk", "gauss2", false),
    ("vrkmk", "gauss8", false),
    ("rkmk", "rk4", false),
    ("rk", "rk4", false),
    ("splitting", "4", true),
    ("splitting", "8", true),
    ("lgvi", "4", true),
    ("quaternion_gauss", "gauss2", true),
    ("quaternion_gauss", "gauss8", true),
];
const KINDS: [&str; 4] = ["uniform", "point_source", "spring", "gravity_gradient"];
/// Time of a run by the estimate, and the repeats of which the quickest counts.
const RUN_NS: f64 = 2e7;
const REPEATS: usize = 3;

fn main() {
    let asked: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    say("method,tableau,n,kind,terms,ns,iterations,estimate_ns");
    for &(method, tableau, three) in METHODS {
        if !asked.is_empty() && !asked.iter().any(|asked| asked == method) {
            continue;
        }
        for n in [2, 3, 4, 5, 6, 8, 12, 16].into_iter().filter(|&n| !three || n == 3) {
            measure(method, tableau, n, "none", 0);
            for (kind, count) in KINDS.into_iter().flat_map(|kind| [(kind, 3), (kind, 200)]) {
                if method != "vpd_reduced" && (count > 3 || kind == "uniform") {
                    measure(method, tableau, n, kind, count);
                }
            }
        }
    }
}

fn say(line: &str) {
    // A reader that has gone away is no failure of a bench.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn measure(method: &str, tableau: &str, n: usize, kind: &str, count: usize) {
    let scene = |steps: u64| scenario(method, tableau, n, kind, count, steps);
    let plan = advise::plan(&scene(1)).expect("a good scene");
    let steps = (RUN_NS / plan.step_ns).clamp(3.0, 50_000.0) as u64;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let (mut least, mut iterations) = (f64::INFINITY, 0.0);
    for _ in 0..REPEATS {
        let control = Control::default();
        let context = JobContext { log: &directory.path().join("log.mcap"), control: &control };
        let summary = execute(&scene(steps), &context).expect("a log");
        least = least.min(summary.ns_per_step);
        iterations = summary.solver.iterations_per_step;
    }
    let estimate = plan.step_ns;
    say(&format!("{method},{tableau},{n},{kind},{count},{least:.0},{iterations:.2},{estimate:.0}"));
}

fn scenario(
    method: &str,
    tableau: &str,
    n: usize,
    kind: &str,
    count: usize,
    steps: u64,
) -> Scenario {
    let vector = |seed: usize, size: f64| -> Vec<f64> {
        (0..n).map(|i| size * ((seed * n + i + 1) as f64 * 0.618).fract() - 0.5 * size).collect()
    };
    // All terms together pull about as much as one.
    let strength = 0.5 / count.max(1) as f64;
    let far = |seed: usize| vector(seed, 1.0).into_iter().map(|x| x + 2.0).collect::<Vec<f64>>();
    let term = |k: usize| match kind {
        "uniform" => {
            json!({"kind": kind, "weight": strength, "body_point": vector(k, 1.0), "direction": vector(k + 7, 1.0)})
        }
        "point_source" => {
            json!({"kind": kind, "strength": strength, "body_point": vector(k, 1.0), "position": far(k)})
        }
        "spring" => {
            json!({"kind": kind, "stiffness": strength, "rest_length": 0.5, "body_point": vector(k, 1.0), "position": far(k)})
        }
        _ => json!({"kind": kind, "strength": strength, "direction": vector(k, 1.0)}),
    };
    let moments: Vec<f64> = (0..n).map(|i| 0.5 + 0.1 * i as f64).collect();
    let momentum = |i: usize, j: usize| ((n * i + j + 1) as f64 * 0.317).fract() / n as f64;
    let momentum: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            (0..n)
                .map(|j| {
                    if i < j {
                        momentum(i, j)
                    } else if i > j {
                        -momentum(j, i)
                    } else {
                        0.0
                    }
                })
                .collect()
        })
        .collect();
    let mut method = json!({ "name": method });
    match tableau.parse::<u32>() {
        Ok(order) => method["order"] = json!(order),
        Err(_) => method["tableau"] = json!(tableau),
    }
    let scenario: Value = json!({
        "name": "cost", "method": method, "step_s": 0.01, "steps": steps, "log": {"every": steps},
        "scene": {
            "inertia": {"second_moments": moments},
            "potential": (0..count).map(term).collect::<Vec<_>>(),
            "initial": {"momentum": {"body": momentum}}
        }
    });
    Scenario::from_json(scenario.to_string().as_bytes()).expect("a good scene")
}
