//! The command line: exit codes, streams, and what a newcomer types.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

use crate::bad_scenarios::{self, Bad};

/// Runs the program in a directory.
pub(crate) fn vpd(directory: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vpd"))
        .current_dir(directory)
        .args(arguments)
        .output()
        .expect("the binary starts")
}

fn scenario(name: &str) -> String {
    format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"))
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).expect("text")
}

#[test]
fn run_writes_a_log_and_sums_it_up() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let run = vpd(at, &["run", &scenario("heavy-top"), "--json"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    let summary: Value = serde_json::from_slice(&run.stdout).expect("one JSON object on stdout");
    assert_eq!(summary["outcome"], "succeeded");
    assert_eq!(summary["log"], "heavy-top.mcap");
    for pointer in [
        "/steps",
        "/time_s",
        "/energy/initial",
        "/energy/max_abs_error",
        "/energy/final_error",
        "/orthogonality/max",
        "/solver/iterations_per_step",
        "/wall_s",
        "/ns_per_step",
    ] {
        assert!(summary.pointer(pointer).is_some_and(Value::is_number), "{pointer}");
    }
    assert_eq!(summary["final"]["body_momentum"].as_array().map(Vec::len), Some(3));
    assert!(at.join("heavy-top.mcap").exists() && !at.join("heavy-top.mcap.part").exists());

    let inspect = vpd(at, &["inspect", "heavy-top.mcap", "--json"]);
    assert_eq!(inspect.status.code(), Some(0));
    let inspection: Value = serde_json::from_slice(&inspect.stdout).expect("JSON");
    assert_eq!(inspection["finished"], true);
    assert_eq!(inspection["samples"], summary["samples"]);

    let chart = vpd(at, &["chart", "heavy-top.mcap", "-o", "charts"]);
    assert_eq!(chart.status.code(), Some(0), "{}", text(&chart.stderr));
    for name in ["energy.svg", "orthogonality.svg", "momentum.svg"] {
        let svg = std::fs::read_to_string(at.join("charts").join(name)).expect("a chart");
        assert!(
            svg.starts_with("<svg") && svg.contains("<polyline") && !svg.contains("NaN"),
            "{name}"
        );
    }
    let human = vpd(at, &["run", &scenario("heavy-top"), "-o", "other.mcap"]);
    assert!(text(&human.stdout).starts_with("outcome"));
    assert!(at.join("other.mcap").exists());
}

#[test]
fn a_failed_run_exits_with_one() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let spoiled = std::fs::read_to_string(scenario("dipole"))
        .expect("shipped")
        .replace("0.01,\n  \"steps\"", "0.5,\n  \"steps\"");
    std::fs::write(at.join("fast.json"), spoiled).expect("writable");
    let run = vpd(at, &["run", "fast.json", "--json"]);
    assert_eq!(run.status.code(), Some(1));
    let summary: Value = serde_json::from_slice(&run.stdout).expect("JSON");
    assert_eq!(summary["outcome"], "failed");
    assert!(summary["diagnosis"]["advice"].is_string());
    assert!(at.join("fast.mcap").exists());
}

#[test]
fn bad_input_exits_with_two_and_names_the_field() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    for Bad { text: bad, pointer } in bad_scenarios::table() {
        std::fs::write(at.join("bad.json"), &bad).expect("writable");
        let run = vpd(at, &["run", "bad.json"]);
        let stderr = text(&run.stderr);
        assert_eq!(run.status.code(), Some(2), "{pointer}: {stderr}");
        assert!(
            stderr.contains(if pointer.is_empty() { "the scenario" } else { &pointer }),
            "{pointer}: {stderr}"
        );
        assert!(run.stdout.is_empty() && !at.join("bad.mcap").exists(), "{pointer}");
    }
    assert_eq!(vpd(at, &["run", "nowhere.json"]).status.code(), Some(2));
    assert_eq!(vpd(at, &["run"]).status.code(), Some(2));
    assert_eq!(vpd(at, &["fly"]).status.code(), Some(2));
}

#[test]
fn a_log_that_cannot_be_written_exits_with_one() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let run = vpd(directory.path(), &["run", &scenario("heavy-top"), "-o", "missing/top.mcap"]);
    assert_eq!(run.status.code(), Some(1));
    assert!(text(&run.stderr).contains("missing/top.mcap"), "{}", text(&run.stderr));
    assert_eq!(vpd(directory.path(), &["inspect", "nothing.mcap"]).status.code(), Some(1));
}

#[test]
fn fields_can_be_set_on_the_command_line() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    let set = |changes: &[&str]| {
        let mut arguments = vec!["run", &top, "--json"];
        for change in changes {
            arguments.extend(["--set", change]);
        }
        vpd(at, &arguments)
    };
    let run = set(&["/method/name=vrkmk", "/method/tableau=gauss1", "/duration_s=1"]);
    let summary: Value = serde_json::from_slice(&run.stdout).expect("JSON");
    assert_eq!(summary["steps"], 500);
    let wrong = [
        (vec!["/scene/inertia/principal/1=-2"], "/scene/inertia/principal/1"),
        (vec!["/nowhere/at/all=1"], "/nowhere"),
        (vec!["/step_s/deeper=1"], "/step_s/deeper"),
        (vec!["/scene/potential/7/weight=1"], "/scene/potential/7/weight"),
        (vec!["step_s=1"], "/pointer/to/field=value"),
    ];
    for (changes, said) in wrong {
        let run = set(&changes);
        assert_eq!(run.status.code(), Some(2), "{changes:?}");
        assert!(text(&run.stderr).contains(said), "{}", text(&run.stderr));
    }
}

#[test]
fn plan_says_what_is_modelled() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let plan = vpd(directory.path(), &["plan", &scenario("dipole"), "--json"]);
    let plan: Value = serde_json::from_slice(&plan.stdout).expect("JSON");
    assert_eq!(plan["formulation"]["order"], 4);
    assert_eq!(plan["samples"], 10_001);
    assert_eq!(plan["free_directions"], 2);
    let human = vpd(directory.path(), &["plan", &scenario("free-body")]);
    assert!(text(&human.stdout).contains("the whole spatial momentum"));
    let schema = vpd(directory.path(), &["schema"]);
    assert!(text(&schema.stdout).contains("\"$schema\""));
}

#[test]
fn verify_says_yes_or_no_and_layouts_lie_beside_the_log() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let run = vpd(at, &["run", &scenario("heavy-top"), "--layouts"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run.stderr));
    for layout in ["vpd-foxglove.json", "vpd-lichtblick.json"] {
        let layout = std::fs::read(at.join(layout)).expect("a layout");
        let layout: Value = serde_json::from_slice(&layout).expect("JSON");
        assert!(layout["configById"]["3D!body"].is_object());
    }
    let verified = vpd(at, &["verify", "heavy-top.mcap"]);
    assert_eq!(verified.status.code(), Some(0), "{}", text(&verified.stderr));
    assert!(text(&verified.stdout).starts_with("the same "), "{}", text(&verified.stdout));
    let verified = vpd(at, &["verify", "vpd-foxglove.json"]);
    assert_eq!(verified.status.code(), Some(1));
    assert!(text(&verified.stderr).contains("not finished"), "{}", text(&verified.stderr));
}
