//! Sweeps: values, lines, kills, parts and their whole.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};
use serde_json::{Value, json};
use vpd::advise;
use vpd::run::{Control, JobContext, execute};
use vpd::scenario::Scenario;
use vpd::sweep::statistics::sobol;
use vpd::sweep::{Sweep, schema};

use crate::cli::vpd;

/// Returns a top that runs for some milliseconds.
fn top(steps: u64) -> Value {
    json!({
        "name": "top",
        "scene": {
            "inertia": { "principal": [0.02, 0.021, 0.01] },
            "potential": [
                { "kind": "uniform", "weight": 4.905, "body_point": [0, 0, 0.1], "direction": [0, 0, 1] }
            ],
            "initial": {
                "attitude": { "axis_angle": { "axis": [1, 0, 0], "angle_rad": 0.3 } },
                "angular_velocity": { "body": [0, 0, 40] }
            }
        },
        "method": { "name": "vpd", "tableau": "gauss2" },
        "step_s": 0.002,
        "steps": steps,
        "log": { "every": 4 }
    })
}

const TILT: &str = "/scene/initial/attitude/axis_angle/angle_rad";
const SPIN: &str = "/scene/initial/angular_velocity/body/2";

const WEIGHT: &str = "/scene/potential/0/weight";

fn of(sweep: &Value) -> Sweep {
    Sweep::from_json(sweep.to_string().as_bytes()).expect("a good sweep")
}

/// Returns the value at a pointer in the scenario of each member.
fn values(sweep: &Sweep, pointer: &str) -> Vec<f64> {
    let value = |member| {
        let scenario = sweep.scenario(member).expect("a scenario").to_json();
        let scenario: Value = serde_json::from_slice(&scenario).expect("JSON");
        scenario.pointer(pointer).and_then(Value::as_f64).expect("a number")
    };
    (0..sweep.members()).map(value).collect()
}

/// Returns a sweep over one field with some values.
fn one(values: &Value) -> Value {
    json!({ "scenario": top(1), "vary": [{ "pointer": SPIN, "values": values }] })
}

fn varied(given: &Value) -> Vec<f64> {
    values(&of(&one(given)), SPIN)
}

#[test]
fn ranges_hold_their_ends_and_even_parts() {
    let linear = varied(&json!({ "linear": { "from": -1, "to": 2, "count": 7 } }));
    assert_eq!(linear, [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0]);
    assert_eq!(varied(&json!({ "linear": { "from": 3, "to": 4, "count": 1 } })), [3.0]);
    let logarithmic = varied(&json!({ "logarithmic": { "from": 1e-3, "to": 0.7, "count": 30 } }));
    assert_eq!((logarithmic[0], logarithmic[29]), (1e-3, 0.7));
    for three in logarithmic.windows(3) {
        assert!((three[0] * three[2] / (three[1] * three[1]) - 1.0).abs() < 1e-14, "{three:?}");
    }
    assert_eq!(varied(&json!({ "list": [3, 1, 2] })), [3.0, 1.0, 2.0]);
}

#[test]
fn random_values_follow_their_law_and_their_seed() {
    const COUNT: usize = 4000;
    let root = (COUNT as f64).sqrt();
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let uniform = varied(&json!({ "uniform": { "from": 2, "to": 6, "count": COUNT } }));
    assert!(uniform.iter().all(|x| (2.0..6.0).contains(x)));
    assert!((mean(&uniform) - 4.0).abs() < 5.0 * 4.0 / 12.0_f64.sqrt() / root);
    let normal = varied(&json!({ "normal": { "mean": 10, "deviation": 0.5, "count": COUNT } }));
    let deviation =
        mean(&normal.iter().map(|x| (x - 10.0) * (x - 10.0)).collect::<Vec<_>>()).sqrt();
    assert!((mean(&normal) - 10.0).abs() < 5.0 * 0.5 / root);
    assert!((deviation - 0.5).abs() < 5.0 * 0.5 / root / 2.0_f64.sqrt());
    // Another number of values or another field does not change one; another seed does.
    let fewer = varied(&json!({ "uniform": { "from": 2, "to": 6, "count": 7 } }));
    assert_eq!(fewer, uniform[..7]);
    let mut other = one(&json!({ "uniform": { "from": 2, "to": 6, "count": 7 } }));
    other["seed"] = json!(1);
    assert_ne!(values(&of(&other), SPIN), fewer);
    // A Latin hypercube: in each field one value in each part, not in order and not in the same order.
    let span = json!({ "latin_hypercube": { "from": 0, "to": 1, "count": COUNT } });
    let hypercube = of(&json!({
        "scenario": top(1), "combine": "side_by_side",
        "vary": [{ "pointer": SPIN, "values": span }, { "pointer": TILT, "values": span }]
    }));
    let parts = [SPIN, TILT].map(|pointer| {
        let part = |x: &f64| (x * COUNT as f64) as usize;
        values(&hypercube, pointer).iter().map(part).collect::<Vec<_>>()
    });
    for parts in &parts {
        let mut sorted = parts.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().copied().eq(0..COUNT) && *parts != sorted);
    }
    let agree = parts[0].iter().zip(&parts[1]).filter(|(a, b)| a == b).count();
    assert!(agree < 20, "{agree}");
}

/// Normal values have the correlation that is asked for, also where one follows from the others; those of fields that are not in the
/// matrix stay what they are.
#[test]
fn normal_values_are_correlated_by_a_matrix() {
    const COUNT: usize = 4000;
    let field = |pointer: &str, mean: f64, deviation: f64| json!({ "pointer": pointer, "values": { "normal": { "mean": mean, "deviation": deviation, "count": COUNT } } });
    let mut file = json!({
        "scenario": top(1), "combine": "side_by_side", "seed": 2,
        "vary": [field(WEIGHT, 5.0, 0.1), field(SPIN, 40.0, 2.0), field(TILT, 0.5, 0.05), field("/step_s", 1.0, 0.1)]
    });
    let pointers = [SPIN, TILT, WEIGHT];
    let columns = |file: &Value| {
        let sweep = of(file);
        pointers.map(|pointer| values(&sweep, pointer))
    };
    let independent = columns(&file);
    // The last is (first + second) / sqrt 3: singular.
    let by_both = 1.5 / 3.0_f64.sqrt();
    for (matrix, bound) in [
        ([[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]], None),
        ([[1.0, 0.5, by_both], [0.5, 1.0, by_both], [by_both, by_both, 1.0]], Some(3.0_f64.sqrt())),
    ] {
        file["correlation"] = json!({ "pointers": pointers, "matrix": matrix });
        let sweep = of(&file);
        assert_eq!(
            values(&sweep, "/step_s"),
            values(
                &of(&{
                    let mut plain = file.clone();
                    plain.as_object_mut().expect("fields").remove("correlation");
                    plain
                }),
                "/step_s"
            )
        );
        let found = columns(&file);
        assert_eq!(found[0], independent[0], "the first is as it was");
        let scaled: Vec<Vec<f64>> = found
            .iter()
            .zip([(40.0, 2.0), (0.5, 0.05), (5.0, 0.1)])
            .map(|(column, (mean, deviation))| {
                column.iter().map(|x| (x - mean) / deviation).collect()
            })
            .collect();
        for i in 0..3 {
            for j in 0..3 {
                let products = scaled[i].iter().zip(&scaled[j]).map(|(x, y)| x * y);
                let seen = products.sum::<f64>() / COUNT as f64;
                let expected: f64 = matrix[i][j];
                let standard_error = ((1.0 + expected * expected) / COUNT as f64).sqrt();
                assert!((seen - expected).abs() < 5.0 * standard_error, "{i}, {j}: {seen}");
            }
        }
        let Some(root) = bound else { continue };
        for ((x, y), z) in scaled[0].iter().zip(&scaled[1]).zip(&scaled[2]) {
            assert!(((x + y) / root - z).abs() < 1e-10, "{x}, {y}, {z}");
        }
    }
    // The table depends on it.
    let digest = of(&file).digest();
    file["correlation"]["matrix"] = json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]);
    assert_ne!(of(&file).digest(), digest);
    assert_eq!(columns(&file), independent);
}

/// Values for Sobol's indices: of each field even in both halves, follow their law, and give the indices of Ishigami's function better
/// than independent ones.
#[test]
fn values_for_indices_are_even() {
    const ROWS: usize = 1024;
    let pi = std::f64::consts::PI;
    let uniform = json!({ "uniform": { "from": -pi, "to": pi, "count": 2 * ROWS } });
    let normal = json!({ "normal": { "mean": 5, "deviation": 0.5, "count": 2 * ROWS } });
    let sweep = |seed: u64, values: &Value| {
        of(&json!({
            "scenario": top(1), "combine": "saltelli", "seed": seed,
            "vary": [
                { "pointer": SPIN, "values": values },
                { "pointer": TILT, "values": uniform },
                { "pointer": "/scene/initial/angular_velocity/body/0", "values": uniform },
            ]
        }))
    };
    let halves = |column: &[f64], kind: usize| -> Vec<f64> {
        column.iter().skip(kind).step_by(5).copied().collect()
    };
    // One value in each of the parts of equal probability.
    let of_spin = values(&sweep(1, &uniform), SPIN);
    let of_normal = values(&sweep(1, &normal), SPIN);
    for kind in [0, 1] {
        let mut parts: Vec<usize> = halves(&of_spin, kind)
            .iter()
            .map(|x| ((x + pi) / (2.0 * pi) * ROWS as f64) as usize)
            .collect();
        assert!(parts.windows(2).any(|pair| pair[0] > pair[1]), "not in order");
        parts.sort_unstable();
        assert!(parts.iter().copied().eq(0..ROWS), "{kind}");
        let found = halves(&of_normal, kind);
        let mean = found.iter().sum::<f64>() / ROWS as f64;
        let variance = found.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / ROWS as f64;
        assert!((mean - 5.0).abs() < 1e-3 && (variance.sqrt() - 0.5).abs() < 3e-3, "{mean}");
    }
    let ishigami = |x: [f64; 3]| {
        let (s, t) = (libm::sin(x[0]), libm::sin(x[1]));
        s + 7.0 * t * t + 0.1 * x[2].powi(4) * s
    };
    let truth = [(0.313_9, 0.557_6), (0.442_4, 0.442_4), (0.0, 0.243_7)];
    let squares = |rows: &[Vec<f64>]| {
        sobol(rows, 0.95).iter().zip(truth).fold(0.0, |sum, (found, (first, total))| {
            sum + (found.first.value - first).powi(2) + (found.total.value - total).powi(2)
        })
    };
    let (mut even, mut independent) = (0.0, 0.0);
    for seed in 0..4 {
        let sweep = sweep(seed, &uniform);
        let point = |member: u64| {
            let changed = sweep.scenario(member).expect("a scenario").to_json();
            let changed: Value = serde_json::from_slice(&changed).expect("JSON");
            let number = |pointer| changed.pointer(pointer).and_then(Value::as_f64);
            [SPIN, TILT, "/scene/initial/angular_velocity/body/0"]
                .map(|pointer| number(pointer).expect("a number"))
        };
        let rows = |point: &mut dyn FnMut(u64) -> [f64; 3]| -> Vec<Vec<f64>> {
            let row = |row: u64| (0..5).map(|kind| ishigami(point(5 * row + kind))).collect();
            (0..ROWS as u64).map(row).collect()
        };
        even += squares(&rows(&mut |member| point(member)));
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut unit = || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        let mut halves = [[0.0; 3]; 2];
        independent += squares(&rows(&mut |member| {
            let kind = member as usize % 5;
            if kind == 0 {
                halves =
                    std::array::from_fn(|_| std::array::from_fn(|_| pi * (2.0 * unit() - 1.0)));
            }
            let [a, b] = halves;
            std::array::from_fn(|k| if kind == 1 || kind == k + 2 { b[k] } else { a[k] })
        }));
    }
    println!(
        "root mean square of the errors: {:.1e}, {:.1e}",
        (even / 24.0).sqrt(),
        (independent / 24.0).sqrt()
    );
    assert!(4.0 * even < independent, "{even:e}, {independent:e}");
}

#[test]
fn fields_are_combined_and_whole_numbers_stay_whole() {
    let sweep = |combine: &str, steps: &Value| {
        of(&json!({
            "scenario": top(1), "combine": combine,
            "vary": [
                { "pointer": "/steps", "values": steps },
                { "pointer": SPIN, "values": { "list": [1, 2, 3] } }
            ]
        }))
    };
    let product = sweep("product", &json!({ "linear": { "from": 10, "to": 20, "count": 2 } }));
    assert_eq!(values(&product, "/steps"), [10.0, 10.0, 10.0, 20.0, 20.0, 20.0]);
    assert_eq!(values(&product, SPIN), [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]);
    let pairs = sweep("side_by_side", &json!({ "list": [10, 20, 30] }));
    assert_eq!(values(&pairs, "/steps"), [10.0, 20.0, 30.0]);
    assert_eq!(values(&pairs, SPIN), [1.0, 2.0, 3.0]);
    // Changes that make no difference to the table are not in its digest.
    let mut file = one(&json!({ "list": [1, 2] }));
    let digest = of(&file).digest();
    file["keep_logs"] = json!([1]);
    assert_eq!(of(&file).digest(), digest);
    file["seed"] = json!(2);
    assert_ne!(of(&file).digest(), digest);
}

#[test]
fn a_bad_sweep_is_refused_at_its_field() {
    let linear = |count: u64| json!({ "linear": { "from": 0, "to": 1, "count": count } });
    let score = |measure: Value| json!([{ "name": "it", "measure": measure }]);
    let tilt = json!({ "tilt": { "body_axis": [0, 0, 1], "space_axis": [0, 0] } });
    let spin = |values: Value| json!([{ "pointer": SPIN, "values": values }]);
    let twice = json!([{ "pointer": SPIN, "values": linear(1001) }, { "pointer": TILT, "values": linear(1000) }]);
    for (field, value, pointer) in [
        ("vary", json!([]), "/vary"),
        ("vary", spin(linear(0)), "/vary/0/values/linear/count"),
        ("vary", spin(linear(1_000_001)), "/vary/0/values/linear/count"),
        ("vary", spin(json!({ "list": [] })), "/vary/0/values/list"),
        ("vary", spin(json!({ "even": 3 })), "/vary/0/values"),
        (
            "vary",
            spin(json!({ "logarithmic": { "from": 0, "to": 1, "count": 2 } })),
            "/vary/0/values/logarithmic/from",
        ),
        (
            "vary",
            spin(json!({ "normal": { "mean": 0, "deviation": 0, "count": 2 } })),
            "/vary/0/values/normal/deviation",
        ),
        ("vary", twice, "/vary"),
        (
            "vary",
            json!([{ "pointer": "/scene/inertia/principal/7", "values": linear(2) }]),
            "/vary/0/pointer",
        ),
        ("vary", json!([{ "pointer": "/scene/initial/spin", "values": linear(2) }]), "/vary/0"),
        ("vary", json!([{ "pointer": "steps", "values": linear(2) }]), "/vary/0/pointer"),
        (
            "vary",
            json!([{ "pointer": SPIN, "name": "time_s", "values": linear(2) }]),
            "/vary/0/name",
        ),
        ("vary", json!([{ "pointer": SPIN, "name": "a,b", "values": linear(2) }]), "/vary/0/name"),
        ("combine", json!("all"), "/combine"),
        ("seed", json!(1_u64 << 53), "/seed"),
        ("picture", json!("nothing"), "/picture"),
        ("keep_logs", json!([2]), "/keep_logs/0"),
        ("scenario", json!("top.json"), "/scenario"),
        ("scores", score(json!({ "largest": tilt })), "/scores/0/measure/largest/tilt/space_axis"),
        ("scores", score(json!({ "largest": "height" })), "/scores/0/measure/largest"),
        ("scores", score(json!({ "largest": "axis_error" })), "/scores/0/measure"),
        (
            "scores",
            score(json!({ "first_time": { "of": "angular_speed" } })),
            "/scores/0/measure/first_time",
        ),
        (
            "scores",
            score(json!({ "lyapunov_exponent": { "distance": 1 } })),
            "/scores/0/measure/lyapunov_exponent/distance",
        ),
        (
            "scores",
            score(json!({ "lyapunov_exponent": { "skip_s": 1e6 } })),
            "/scores/0/measure/lyapunov_exponent/skip_s",
        ),
        ("number", json!(1), "/number"),
    ] {
        let mut sweep = one(&linear(2));
        sweep[field] = value.clone();
        let error = Sweep::from_json(sweep.to_string().as_bytes()).expect_err(pointer);
        assert_eq!(error.pointer, pointer, "{value}: {}", error.message);
    }
    let normal = |pointer: &str, count: u64| json!({ "pointer": pointer, "values": { "normal": { "mean": 1, "deviation": 0.1, "count": count } } });
    let pair = json!([SPIN, TILT]);
    for (pointers, matrix, combine, pointer) in [
        (pair.clone(), json!([[1, 2], [2, 1]]), "side_by_side", "/matrix/0/1"),
        (pair.clone(), json!([[1, 0.5], [0.4, 1]]), "side_by_side", "/matrix/1/0"),
        (pair.clone(), json!([[1, 0.5], [0.5, 0.9]]), "side_by_side", "/matrix/1/1"),
        (pair.clone(), json!([[1, 0.5]]), "side_by_side", "/matrix"),
        (pair.clone(), json!([[1, 0.5], [0.5, 1]]), "product", ""),
        (pair.clone(), json!([[1, 0.5], [0.5, 1]]), "saltelli", ""),
        (json!([SPIN, SPIN]), json!([[1, 1], [1, 1]]), "side_by_side", "/pointers/1"),
        (json!([SPIN, "/step_s"]), json!([[1, 0], [0, 1]]), "side_by_side", "/pointers/1"),
        (
            json!([SPIN, TILT, WEIGHT]),
            json!([[1, -0.9, -0.9], [-0.9, 1, -0.9], [-0.9, -0.9, 1]]),
            "side_by_side",
            "/matrix",
        ),
    ] {
        let mut sweep = one(&linear(2));
        sweep["vary"] = json!([normal(SPIN, 4), normal(TILT, 4), normal(WEIGHT, 4)]);
        sweep["combine"] = json!(combine);
        sweep["correlation"] = json!({ "pointers": pointers, "matrix": matrix });
        let error = Sweep::from_json(sweep.to_string().as_bytes()).expect_err(pointer);
        let pointer = format!("/correlation{pointer}");
        assert_eq!(error.pointer, pointer, "{sweep}: {}", error.message);
    }
    let mut many = one(&linear(2));
    many["scenario"]["ensemble"] = json!({ "members": 3, "momentum_spread": 0.1 });
    let error = Sweep::from_json(many.to_string().as_bytes()).expect_err("an ensemble");
    assert_eq!(error.pointer, "/scenario/ensemble");
}

#[test]
fn shipped_sweeps_are_good_and_the_schema_is_current() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios/sweeps");
    let kept = fs::read_to_string(folder.join("sweep.schema.json")).expect("the schema is kept");
    let kept: Value = serde_json::from_str(&kept).expect("JSON");
    assert!(
        kept == schema(),
        "write it anew: vpd schema sweep > scenarios/sweeps/sweep.schema.json"
    );
    for entry in fs::read_dir(&folder).expect("the folder of sweeps") {
        let path = entry.expect("readable").path();
        if path.ends_with("sweep.schema.json") {
            continue;
        }
        let sweep =
            Sweep::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        for member in [0, sweep.members() / 2, sweep.members() - 1] {
            sweep.plan(member).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        }
    }
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).expect("text")
}

pub(crate) fn succeeds(at: &Path, arguments: &[&str]) -> Output {
    let output = vpd(at, arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", text(&output.stderr));
    output
}

fn refused(at: &Path, arguments: &[&str], said: &str) {
    let output = vpd(at, arguments);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", text(&output.stderr));
    assert!(text(&output.stderr).contains(said), "{arguments:?}: {}", text(&output.stderr));
}

fn write(at: &Path, name: &str, sweep: &Value) {
    fs::write(at.join(name), sweep.to_string()).expect("writable");
}

/// Returns the lines of a table whose cells hold no quotes, by the heads of their columns.
pub(crate) fn lines(at: &Path, name: &str) -> Vec<BTreeMap<String, String>> {
    let table = fs::read_to_string(at.join(name)).expect("a table");
    assert!(!table.contains("NaN") && !table.contains("inf"), "{table}");
    let mut lines = table.lines();
    let heads: Vec<&str> = lines.next().expect("a head").split(',').collect();
    let cells = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        assert_eq!(cells.len(), heads.len(), "{line}");
        heads.iter().zip(cells).map(|(head, cell)| ((*head).to_owned(), cell.to_owned())).collect()
    };
    lines.map(cells).collect()
}

pub(crate) fn number(line: &BTreeMap<String, String>, column: &str) -> f64 {
    line[column].parse().unwrap_or_else(|_| panic!("{column}: {:?}", line[column]))
}

/// Returns tops, some of which fail (a step that no solver makes), some are no scenario (a negative
/// moment).
fn mixed(steps: u64) -> Value {
    json!({
        "scenario": top(steps),
        "vary": [
            { "name": "step_s", "pointer": "/step_s", "values": { "list": [0.002, 3.0] } },
            { "name": "moment", "pointer": "/scene/inertia/principal/0", "values": { "linear": { "from": -0.01, "to": 0.03, "count": 5 } } }
        ],
        "scores": [
            { "name": "tilt", "measure": { "largest": { "tilt": { "body_axis": [0, 0, 2], "space_axis": [0, 0, 1] } } } },
            { "name": "lyapunov", "measure": { "lyapunov_exponent": {} } }
        ]
    })
}

#[test]
fn a_member_that_fails_or_is_refused_has_a_line() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    write(at, "mixed.json", &mixed(200));
    let run = succeeds(at, &["sweep", "mixed.json", "--svg", "map.svg"]);
    let said = text(&run.stdout);
    assert!(said.contains("member 0: /scene/inertia/principal/0"), "{said}");
    let lines = lines(at, "mixed.csv");
    let outcomes: Vec<&str> = lines.iter().map(|line| line["outcome"].as_str()).collect();
    assert_eq!(outcomes[..5], ["refused", "refused", "succeeded", "succeeded", "succeeded"]);
    assert_eq!(outcomes[5..7], ["refused", "refused"]);
    assert!(outcomes[7..].contains(&"failed"), "{outcomes:?}");
    for line in &lines {
        match line["outcome"].as_str() {
            "succeeded" => {
                assert_eq!(line["code"], "");
                number(line, "lyapunov");
            }
            "failed" => {
                assert!(!line["code"].is_empty() && line["lyapunov"].is_empty(), "{line:?}");
                number(line, "quaternion_w");
            }
            _ => {
                assert_eq!(line["code"], "invalid_input");
                assert!(line["time_s"].is_empty() && line["tilt"].is_empty(), "{line:?}");
            }
        }
    }
    let map = fs::read_to_string(at.join("map.svg")).expect("a picture");
    assert!(map.contains("failed") && map.contains("refused") && !map.contains("NaN"));
    // Drawn from the table as it stands; and points, of another column.
    succeeds(at, &["sweep", "mixed.json", "--svg", "again.svg"]);
    assert_eq!(fs::read_to_string(at.join("again.svg")).expect("a picture"), map);
    refused(at, &["sweep", "mixed.json", "--svg", "x.svg", "--column", "height"], "height");
    refused(at, &["sweep", "mixed.json"], "--force");
    let mut points = mixed(200);
    points["combine"] = json!("side_by_side");
    points["vary"][0]["values"] = json!({ "linear": { "from": 0.001, "to": 0.002, "count": 5 } });
    points["vary"][1]["values"] = json!({ "linear": { "from": 0.011, "to": 0.02, "count": 5 } });
    write(at, "points.json", &points);
    succeeds(at, &["sweep", "points.json", "--svg", "points.svg", "--column", "energy_error_max"]);
    let drawn = fs::read_to_string(at.join("points.svg")).expect("a picture");
    assert_eq!(drawn.matches("<circle").count(), 5);
    // The table of another sweep is not drawn as that of this one.
    fs::copy(at.join("points.csv"), at.join("mixed.csv")).expect("copied");
    refused(at, &["sweep", "mixed.json", "--svg", "x.svg"], "not a table of this sweep");
    // No member succeeds: as for an ensemble, that is a failure.
    let mut bad = mixed(200);
    bad["vary"] = json!([{ "pointer": "/scene/inertia/principal/0", "values": { "list": [-1] } }]);
    write(at, "bad.json", &bad);
    assert_eq!(vpd(at, &["sweep", "bad.json"]).status.code(), Some(1));
}

#[test]
fn a_line_holds_the_figures_of_the_members_log() {
    line_of(&json!({}));
}

/// The same for a scene with torques, whose balances are logged.
#[test]
fn so_does_a_line_of_a_pushed_scene() {
    line_of(&json!({
        "torques": [{ "viscous": { "coefficient": 1e-4 } }, { "constant": { "space": [0, 1e-3, 0] } }],
        "wheels": [0, 0, 0.01]
    }));
}

/// Checks a line of a sweep over a top with more in its scene.
fn line_of(more: &Value) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    // Long enough for several chunks, at whose ends the stepper starts anew; and a motion that would show it.
    let mut scenario = top(40_000);
    scenario["log"] = json!({ "every": 1 });
    scenario["scene"]["initial"]["angular_velocity"] = json!({ "body": [3, 1, 5] });
    for (field, value) in more.as_object().expect("an object") {
        scenario["scene"][field] = value.clone();
    }
    fs::write(at.join("top.json"), scenario.to_string()).expect("writable");
    let sweep = json!({
        "scenario": "top.json", "keep_logs": [1],
        "vary": [{ "name": "tilt", "pointer": TILT, "values": { "list": [0.5, 1.5] } }]
    });
    write(at, "sweep.json", &sweep);
    succeeds(at, &["sweep", "sweep.json"]);
    let line = &lines(at, "sweep.csv")[1];
    let printed = succeeds(at, &["sweep", "sweep.json", "--member", "1"]).stdout;
    let scenario = Scenario::from_json(&printed).expect("a scenario");
    let (log, control) = (at.join("log.mcap"), Control::default());
    let plan = advise::plan(&scenario).expect("a plan");
    assert!(plan.samples > 2 * plan.samples_per_chunk);
    let summary = execute(&plan, &JobContext { log: &log, control: &control }).expect("a log");
    let momentum = summary.last.body_momentum.as_array().expect("a vector").clone();
    let momentum: Vec<f64> = momentum.iter().filter_map(Value::as_f64).collect();
    let cells = ["x", "y", "z"].map(|axis| number(line, &format!("body_momentum_{axis}")));
    assert_eq!(momentum, cells);
    assert_eq!(number(line, "energy_error_max"), summary.energy.expect("energy").max_abs_error);
    assert_eq!(number(line, "orthogonality_error_max"), summary.orthogonality.expect("it").max);
    assert_eq!(number(line, "momentum_drift_max"), summary.momentum.expect("momentum").max_drift);
    // The logs that are kept, and that of one member, are the log of its scenario.
    let log = fs::read(&log).expect("a log");
    assert!(fs::read(at.join("sweep.logs/1.mcap")).expect("a log that was kept") == log);
    succeeds(at, &["sweep", "sweep.json", "--member", "1", "--log", "one.mcap"]);
    assert!(fs::read(at.join("one.mcap")).expect("a log") == log);
    refused(at, &["sweep", "sweep.json", "--member", "2"], "from 0 to 1");
}

/// A line of several bodies: the last state of each, with the figures of the member's log.
#[test]
fn so_does_a_line_of_several_bodies() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let text = fs::read_to_string("scenarios/tether.json").expect("shipped");
    let mut scenario: Value = serde_json::from_str(&text).expect("JSON");
    scenario["duration_s"] = json!(20);
    fs::write(at.join("tether.json"), scenario.to_string()).expect("writable");
    let stiffness = json!({ "name": "stiffness", "pointer": "/scene/potential/0/stiffness", "values": { "list": [2, 3] } });
    let sweep = json!({ "scenario": "tether.json", "keep_logs": [1], "vary": [stiffness] });
    write(at, "sweep.json", &sweep);
    succeeds(at, &["sweep", "sweep.json"]);
    let table = lines(at, "sweep.csv");
    let printed = succeeds(at, &["sweep", "sweep.json", "--member", "1"]).stdout;
    let scenario = Scenario::from_json(&printed).expect("a scenario");
    let (log, control) = (at.join("log.mcap"), Control::default());
    let plan = advise::plan(&scenario).expect("a plan");
    let summary = execute(&plan, &JobContext { log: &log, control: &control }).expect("a log");
    let cells = |line, column: &str| -> Vec<f64> {
        ["x", "y", "z"].iter().map(|axis| number(line, &format!("{column}_{axis}"))).collect()
    };
    for name in ["primary", "secondary"] {
        let body = &summary.last.bodies[name];
        assert_eq!(cells(&table[1], &format!("{name}_position")), body.position);
        assert_eq!(cells(&table[1], &format!("{name}_linear_momentum")), body.linear_momentum);
        let momentum = body.body_momentum.as_array().expect("a vector").iter();
        let momentum: Vec<f64> = momentum.filter_map(Value::as_f64).collect();
        assert_eq!(cells(&table[1], &format!("{name}_body_momentum")), momentum);
        assert_ne!(cells(&table[0], &format!("{name}_position")), body.position);
    }
    assert_eq!(
        number(&table[1], "energy_error_max"),
        summary.energy.expect("energy").max_abs_error
    );
    let log = fs::read(&log).expect("a log");
    assert!(fs::read(at.join("sweep.logs/1.mcap")).expect("a log that was kept") == log);
    let named =
        json!({ "pointer": "/scene/bodies/0/name", "values": { "list": ["primary", "other"] } });
    write(at, "names.json", &json!({ "scenario": "tether.json", "vary": [named] }));
    succeeds(at, &["sweep", "names.json", "-o", "names.csv"]);
    let outcomes: Vec<String> =
        lines(at, "names.csv").iter().map(|line| line["outcome"].clone()).collect();
    assert_eq!(outcomes, ["succeeded", "refused"]);
}

#[test]
fn scores_are_those_of_known_motions() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    // About its axis x a free body turns evenly: z tilts by the angle of the turn.
    let sweep = json!({
        "scenario": {
            "name": "turn",
            "scene": {
                "inertia": { "principal": [1, 2, 3] },
                "initial": { "angular_velocity": { "body": [0.25, 0, 0] } }
            },
            "pointing": { "frame": { "turning": { "from": [0, 1, 0], "towards": [0, 0, 1], "rate_rad_s": 0.125 } } },
            "method": { "name": "vpd" }, "step_s": 0.01, "steps": 1000, "log": { "every": 10 }
        },
        "vary": [{ "name": "rate", "pointer": "/scene/initial/angular_velocity/body/0", "values": { "list": [0.25, 0.05] } }],
        "scores": [
            { "name": "largest", "measure": { "largest": { "tilt": { "body_axis": [0, 0, 3], "space_axis": [0, 0, 1] } } } },
            { "name": "off", "measure": { "first_time": { "of": "axis_error", "above": 0.405 } } },
            { "name": "smallest", "measure": { "smallest": { "tilt": { "body_axis": [0, 0, -1], "space_axis": [0, 0, 1] } } } },
            { "name": "first", "measure": { "first_time": { "of": { "tilt": { "body_axis": [0, 0, 1], "space_axis": [0, 0, 1] } }, "above": 1.01 } } },
            { "name": "slow", "measure": { "first_time": { "of": "angular_speed", "below": 0.1 } } },
            { "name": "energy", "measure": { "largest": "kinetic_energy" } },
            { "name": "last", "measure": { "last": { "tilt": { "body_axis": [0, 0, -1], "space_axis": [0, 0, 1] } } } },
            { "name": "settled", "measure": { "settled_time": { "of": { "tilt": { "body_axis": [0, 0, 1], "space_axis": [0, 0, 1] } }, "above": 0.303 } } },
            { "name": "unsettled", "measure": { "settled_time": { "of": "axis_error", "below": 0.405 } } }
        ]
    });
    write(at, "turn.json", &sweep);
    succeeds(at, &["sweep", "turn.json"]);
    let lines = lines(at, "turn.csv");
    let near = |line: usize, column: &str, value: f64| {
        let given = number(&lines[line], column);
        assert!((given - value).abs() < 1e-9, "{line} {column}: {given}, {value}");
    };
    near(0, "largest", 2.5);
    near(0, "smallest", std::f64::consts::PI - 2.5);
    // 0.25 t > 1.01 from t = 4.04 on; samples come each 0.1 s.
    near(0, "first", 4.1);
    near(0, "energy", 0.5 * 0.25 * 0.25);
    // Relative to the frame 0.125 t > 0.405 from t = 3.24 on.
    near(0, "off", 3.3);
    near(1, "largest", 0.5);
    near(1, "slow", 0.0);
    near(0, "last", std::f64::consts::PI - 2.5);
    // 0.25 t > 0.303 from t = 1.212 on, 0.05 t from t = 6.06 on, both to the end.
    near(0, "settled", 1.3);
    near(1, "settled", 6.1);
    // Relative to the frame 0.125 t passes 0.405, and 0.075 t does.
    assert!(lines[0]["unsettled"].is_empty() && lines[1]["unsettled"].is_empty());
    assert!(lines[0]["slow"].is_empty() && lines[1]["first"].is_empty());
}

#[test]
fn lyapunov_exponents_are_those_of_known_motions() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    // Turns of a free body: about the middle axis they are unstable with the rate
    // w sqrt((I2 - I1) (I3 - I2) / (I1 I3)), about the others they are stable.
    let sweep = json!({
        "scenario": {
            "name": "euler",
            "scene": {
                "inertia": { "principal": [1, 2, 4] },
                "initial": { "angular_velocity": { "body": [0, 0.7, 0] } }
            },
            "method": { "name": "vpd", "tableau": "gauss2" }, "step_s": 0.02, "steps": 2500, "log": { "every": 5 }
        },
        "combine": "side_by_side",
        "vary": [
            { "name": "number", "pointer": "/log/every", "values": { "list": [5, 6, 7, 8] } },
            { "pointer": "/scene/initial/angular_velocity/body", "values": { "list": [[0, 0.7, 0], [0, 1.4, 0], [0.7, 0, 0], [0, 0, 0.7]] } }
        ],
        "scores": [{ "name": "exponent", "measure": { "lyapunov_exponent": { "skip_s": 25 } } }]
    });
    write(at, "euler.json", &sweep);
    succeeds(at, &["sweep", "euler.json"]);
    let table = fs::read_to_string(at.join("euler.csv")).expect("a table");
    let last = |line: &str| line.rsplit(',').next().and_then(|cell| cell.parse::<f64>().ok());
    let exponents: Vec<f64> = table.lines().skip(1).filter_map(last).collect();
    let rate = (1.0 * 2.0 / 4.0_f64).sqrt();
    for (exponent, known) in exponents.iter().zip([0.7 * rate, 1.4 * rate]) {
        assert!((exponent / known - 1.0).abs() < 2e-3, "{exponent}, {known}");
    }
    // In a regular motion distances grow in proportion to time: ln(50 / 25) / 25 s.
    assert_eq!(exponents.len(), 4);
    assert!(exponents[2..].iter().all(|x| x.abs() < 0.035), "{exponents:?}");

    // A body at rest straight above its pivot is left with the rate (weight / I)^(1/2), whatever the method.
    let methods =
        ["vpd", "vpd_lagrangian", "splitting", "quaternion_gauss", "lgvi", "vrkmk", "rkmk"];
    let sweep = json!({
        "scenario": {
            "name": "upright",
            "scene": {
                "inertia": { "principal": [2, 2, 0.5] },
                "potential": [{ "kind": "uniform", "weight": 9.81, "body_point": [0, 0, 1], "direction": [0, 0, 1] }]
            },
            "step_s": 0.01, "steps": 2000, "log": { "every": 5 }
        },
        "vary": [{ "name": "method", "pointer": "/method/name", "values": { "list": methods } }],
        "scores": [{ "name": "exponent", "measure": { "lyapunov_exponent": { "skip_s": 5 } } }]
    });
    write(at, "upright.json", &sweep);
    succeeds(at, &["sweep", "upright.json"]);
    for line in lines(at, "upright.csv") {
        let relative = number(&line, "exponent") / (9.81_f64 / 2.0).sqrt() - 1.0;
        assert!(relative.abs() < 1e-7, "{line:?}");
    }
}

/// Returns a sweep of a second or so on one core.
fn busy() -> Value {
    json!({
        "scenario": top(8000),
        "vary": [
            { "name": "tilt", "pointer": TILT, "values": { "linear": { "from": 0.1, "to": 3, "count": 12 } } },
            { "name": "spin", "pointer": SPIN, "values": { "normal": { "mean": 30, "deviation": 9, "count": 8 } } }
        ],
        "scores": [{ "name": "lyapunov", "measure": { "lyapunov_exponent": { "skip_s": 1 } } }]
    })
}

fn begun(at: &Path, arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_vpd"))
        .current_dir(at)
        .args(arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the binary starts")
}

/// Waits until an unfinished table has `count` lines, or is finished; returns whether it has them.
fn has_lines(at: &Path, table: &str, count: usize) -> bool {
    let part = at.join(format!("{table}.part"));
    loop {
        let lines = fs::read_to_string(&part).map_or(0, |text| text.lines().count());
        if lines >= count {
            return true;
        }
        if at.join(table).exists() {
            return false;
        }
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
}

#[cfg(unix)]
#[test]
fn a_sweep_that_is_killed_or_stopped_goes_on_to_the_same_table() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    write(at, "busy.json", &busy());
    succeeds(at, &["sweep", "busy.json", "--out", "whole.csv", "--threads", "1"]);
    let whole = fs::read(at.join("whole.csv")).expect("a table");
    let arguments = ["sweep", "busy.json", "--out", "it.csv", "--threads", "3"];
    let (table, part) = (at.join("it.csv"), at.join("it.csv.part"));
    let mut kills = 0;
    for lines in [3, 20, 50] {
        if table.exists() {
            break;
        }
        let mut child = begun(at, &arguments);
        has_lines(at, "it.csv", lines);
        child.kill().expect("killed");
        child.wait().expect("gone");
        kills += usize::from(part.exists());
    }
    assert!(kills > 0);
    if part.exists() {
        stopped_and_resumed(at, &arguments);
    }
    assert!(fs::read(at.join("it.csv")).expect("a table") == whole);
    assert!(!part.exists());
}

/// Damages and locks the table of an interrupted sweep, stops it once more, and completes it.
#[cfg(unix)]
fn stopped_and_resumed(at: &Path, arguments: &[&str]) {
    let (table, part) = (at.join("it.csv"), at.join("it.csv.part"));
    // The remains of a torn write, and lines that no sweep wrote.
    let mut text = fs::read_to_string(&part).expect("lines");
    text.push_str("77,0.1,\n\0\0\0\n5,1,2\n");
    fs::write(&part, &text).expect("written");
    // While one process writes, no other does; stopped, it says how to resume.
    let first = begun(at, arguments);
    // More lines than before: it has begun.
    has_lines(at, "it.csv", text.lines().count() + 1);
    let holder = format!("another process ({}) is writing it", first.id());
    let second = vpd(at, arguments);
    if !table.exists() {
        assert_eq!(second.status.code(), Some(2), "{}", self::text(&second.stderr));
        assert!(self::text(&second.stderr).contains(&holder), "{}", self::text(&second.stderr));
    }
    let pid = first.id().to_string();
    let _ = Command::new("kill").args(["-INT", &pid]).status().expect("kill");
    let stopped = first.wait_with_output().expect("a child");
    if stopped.status.code() == Some(0) {
        return;
    }
    assert_eq!(stopped.status.code(), Some(130), "{}", self::text(&stopped.stderr));
    assert!(self::text(&stopped.stderr).contains("the same command resumes it"));
    // Another sweep does not replace it.
    let mut other = busy();
    other["seed"] = json!(3);
    write(at, "other.json", &other);
    refused(at, &["sweep", "other.json", "--out", "it.csv"], "of another sweep");
    let last = succeeds(at, arguments);
    assert!(self::text(&last.stdout).contains("resumed"), "{}", self::text(&last.stdout));
}

#[test]
fn parts_of_many_processes_make_the_whole() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    write(at, "mixed.json", &mixed(500));
    succeeds(at, &["sweep", "mixed.json"]);
    let whole = fs::read(at.join("mixed.csv")).expect("a table");
    // There is one shard more than members: the first is empty.
    let shards: Vec<String> = (1..=11).map(|number| format!("{number}/11")).collect();
    let children: Vec<Child> =
        shards.iter().map(|shard| begun(at, &["sweep", "mixed.json", "--shard", shard])).collect();
    for child in children {
        let ended = child.wait_with_output().expect("a child");
        // A part in which no member succeeds says so.
        assert!(matches!(ended.status.code(), Some(0 | 1)), "{}", text(&ended.stderr));
    }
    let parts: Vec<String> = (1..=11).map(|number| format!("mixed.{number}-of-11.csv")).collect();
    let merge = |parts: &[String], out: &str| {
        let mut arguments = vec!["merge", "-o", out];
        arguments.extend(parts.iter().map(String::as_str));
        vpd(at, &arguments)
    };
    let merged = |parts: &[String], out: &str| {
        let output = merge(parts, out);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(fs::read(at.join(out)).expect("a table") == whole);
    };
    let not_merged = |parts: &[String], said: &str| {
        let output = merge(parts, "no.csv");
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(text(&output.stderr).contains(said), "{said}: {}", text(&output.stderr));
        assert!(!at.join("no.csv").exists(), "{said}");
    };
    let reversed: Vec<String> = parts.iter().rev().cloned().collect();
    merged(&reversed, "merged.csv");
    // A part that is there twice counts once; a finished one is not made again.
    fs::copy(at.join(&parts[4]), at.join("copy.csv")).expect("copied");
    merged(&[parts.as_slice(), &["copy.csv".to_owned()]].concat(), "twice.csv");
    let again = vpd(at, &["sweep", "mixed.json", "--shard", "4/11"]);
    assert!(text(&again.stdout).contains("resumed"), "{}", text(&again.stderr));
    refused(at, &["merge", "-o", "merged.csv", &parts[0]], "--force");

    not_merged(
        &[&parts[..4], &parts[6..]].concat(),
        "shards 5/11, 6/11 are missing: no part holds members 3 to 4",
    );
    let part = fs::read_to_string(at.join(&parts[4])).expect("a part");
    let with = |name: &str, text: &str| {
        fs::write(at.join(name), text).expect("written");
        [&parts[..4], &[name.to_owned()], &parts[5..]].concat()
    };
    let build = part.split("\"build\":\"").nth(1).expect("a build")[..16].to_owned();
    not_merged(&with("older.csv", &part.replace(&build, "0123456789abcdef")), "different builds");
    let cut = part.rsplit_once("\n3,").expect("a line").0;
    not_merged(
        &with("cut.csv", &format!("{cut}\n")),
        "cut.csv is unfinished or damaged: members 3 to 3",
    );
    not_merged(&with("more.csv", &format!("{part}4,\n")), "more.csv is not a part");
    let other = part.replacen("succeeded", "succeedeD", 1);
    let two = [parts.as_slice(), &["other.csv".to_owned()]].concat();
    fs::write(at.join("other.csv"), other).expect("written");
    not_merged(&two, "hold the same members");
    write(at, "seed.json", &{
        let mut sweep = mixed(500);
        sweep["seed"] = json!(1);
        sweep
    });
    let _ = vpd(at, &["sweep", "seed.json", "--shard", "5/11"]);
    let strange = [&parts[..4], &["seed.5-of-11.csv".to_owned()], &parts[5..]].concat();
    not_merged(&strange, "parts of different sweeps");
    not_merged(&["mixed.csv".to_owned()], "is not a part of a sweep");
    for shard in ["0/4", "5/4", "1/0", "2", "1/2000000"] {
        assert_eq!(vpd(at, &["sweep", "mixed.json", "--shard", shard]).status.code(), Some(2));
    }
}

/// Scores of several bodies: those of the samples of the member's log.
#[test]
fn scores_of_several_bodies_are_those_of_their_samples() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let mut scenario = crate::bodies_run::shipped("tether");
    let fields = scenario.as_object_mut().expect("an object");
    for key in ["duration_s", "expect"] {
        fields.remove(key);
    }
    scenario["steps"] = json!(100);
    scenario["log"] = json!({ "every": 2 });
    let distance = json!({ "distance": { "between": ["primary", "secondary"] } });
    let tied = json!({ "distance": {
        "between": ["primary", "secondary"], "points": [[0.6, 0.1, 0], [-0.4, 0, 0.1]],
    } });
    let tilt = json!({ "tilt": { "body_axis": [0, 0, 1], "space_axis": [0, 0, 2] } });
    let scores = json!([
        { "name": "nearest", "measure": { "smallest": distance } },
        { "name": "tied", "measure": { "largest": tied } },
        { "name": "first", "measure": { "first_time": { "of": distance, "below": 4.5 } } },
        { "name": "spin", "body": "secondary", "measure": { "largest": "angular_speed" } },
        { "name": "tilt", "body": "primary", "measure": { "largest": tilt } },
        { "name": "kinetic", "measure": { "largest": "kinetic_energy" } },
    ]);
    let vary = json!({ "name": "speed", "pointer": "/scene/bodies/1/initial/velocity/1", "values": { "list": [0.1, 0.14] } });
    let document =
        json!({ "scenario": scenario, "keep_logs": [1], "vary": [vary], "scores": scores });
    write(at, "sweep.json", &document);
    succeeds(at, &["sweep", "sweep.json"]);
    let line = &lines(at, "sweep.csv")[1];
    let size = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>().sqrt();
    let (mut nearest, mut spin, mut kinetic, mut first_s) = (f64::INFINITY, 0.0, 0.0, None);
    let (mut tied, mut tilt) = (0.0, 0.0);
    vpd::log::rows::read_rows(&at.join("sweep.logs/1.mcap"), 0, |row| {
        let [(_, one), (_, other)] = row.bodies.as_slice() else { panic!("two bodies") };
        let point = |body: &vpd::log::messages::BodyState, y: [f64; 3]| -> Vec<f64> {
            let g = body.attitude.chunks(3);
            let turned = g.map(|row| row.iter().zip(y).map(|(g, y)| g * y).sum::<f64>());
            turned.zip(&body.position).map(|(y, x)| y + x).collect()
        };
        let apart = |a: [f64; 3], b: [f64; 3]| {
            let [a, b] = [point(one, a), point(other, b)];
            size(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f64>>())
        };
        let distance = apart([0.0; 3], [0.0; 3]);
        nearest = f64::min(nearest, distance);
        if distance < 4.5 && first_s.is_none() {
            first_s = Some(one.time_s);
        }
        tied = f64::max(tied, apart([0.6, 0.1, 0.0], [-0.4, 0.0, 0.1]));
        tilt = f64::max(tilt, one.attitude[8].acos());
        spin = f64::max(spin, size(&other.angular_velocity));
        kinetic = f64::max(kinetic, row.energy.expect("logged").kinetic);
        std::ops::ControlFlow::Continue(())
    })
    .expect("readable");
    assert!((number(line, "nearest") - nearest).abs() < 1e-14, "{nearest}");
    assert_eq!(Some(number(line, "first")), first_s);
    assert!((number(line, "tied") - tied).abs() < 1e-14, "{tied}");
    assert!((number(line, "tilt") - tilt).abs() < 1e-12 && tilt > 0.01, "{tilt}");
    assert!((number(line, "spin") - spin).abs() < 1e-15, "{spin}");
    assert_eq!(number(line, "kinetic"), kinetic);

    for (pointer, value, at, words) in [
        ("/scores/3/body", json!(null), "/scores/3", "missing field `body`"),
        ("/scores/3/body", json!("secondry"), "/scores/3/body", "did you mean `secondary`?"),
        ("/scores/0/body", json!("primary"), "/scores/0/body", "not that of one body"),
        (
            "/scores/0/measure/smallest/distance/between/1",
            json!("x"),
            "/scores/0/measure/smallest/distance/between/1",
            "no body has that name",
        ),
        (
            "/scores/2/measure/first_time/of/distance/between/1",
            json!("primary"),
            "/scores/2/measure/first_time/of/distance/between",
            "two different bodies",
        ),
        (
            "/scores/0/measure",
            json!({ "lyapunov_exponent": {} }),
            "/scores/0/measure",
            "for scenes of one body",
        ),
        (
            "/scores/0/measure",
            json!({ "largest": "axis_error" }),
            "/scores/0/measure",
            "for scenes of one body",
        ),
    ] {
        let mut bad = document.clone();
        if value.is_null() {
            bad["scores"][3].as_object_mut().expect("a score").remove("body");
        } else if pointer.ends_with("/body") {
            let score: usize = pointer[8..9].parse().expect("a digit");
            bad["scores"][score]["body"] = value;
        } else {
            *bad.pointer_mut(pointer).expect("a field") = value;
        }
        let error = Sweep::from_json(bad.to_string().as_bytes()).expect_err(pointer);
        assert_eq!(error.pointer, at, "{error}");
        assert!(error.message.contains(words), "{error}");
    }
    let mut one = document.clone();
    one["scenario"] = crate::bodies_run::shipped("heavy-top");
    one["vary"] = json!([{ "pointer": "/step_s", "values": { "list": [0.001] } }]);
    one["scores"] = json!([{ "name": "nearest", "measure": { "smallest": distance } }]);
    let error = Sweep::from_json(one.to_string().as_bytes()).expect_err("one body");
    assert_eq!(error.pointer, "/scores/0/measure");
}
