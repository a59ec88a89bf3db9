//! The command line: exit codes, streams, and what a newcomer types.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;
use vpd::log::resume::last_checkpoint;

use crate::bad_scenarios::{self, Bad};

/// Runs the program in a directory.
pub(crate) fn vpd(directory: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_vpd"))
        .current_dir(directory)
        .args(arguments)
        .output()
        .expect("the binary starts")
}

pub(crate) fn scenario(name: &str) -> String {
    format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"))
}

pub(crate) fn text(bytes: &[u8]) -> &str {
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
    for said in ["missing/top.mcap", "no folder missing; create it"] {
        assert!(text(&run.stderr).contains(said), "{}", text(&run.stderr));
    }
    assert_eq!(vpd(directory.path(), &["inspect", "nothing.mcap"]).status.code(), Some(2));
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
    // A value may be set in the place of one that is wrong in the file.
    let spoiled = std::fs::read_to_string(&top).expect("shipped").replace("0.002", "0");
    std::fs::write(at.join("spoiled.json"), spoiled).expect("writable");
    assert_eq!(vpd(at, &["run", "spoiled.json"]).status.code(), Some(2));
    let mended = vpd(at, &["run", "spoiled.json", "--set", "/step_s=0.002"]);
    assert_eq!(mended.status.code(), Some(0), "{}", text(&mended.stderr));
    let wrong = [
        (vec!["/scene/inertia/principal/1=-2"], "/scene/inertia/principal/1"),
        (vec!["/nowhere/at/all=1"], "/nowhere"),
        (vec!["/step_s/deeper=1"], "/step_s/deeper"),
        (vec!["/scene/potential/7/weight=1"], "/scene/potential/7/weight"),
        (vec!["step_s=1"], "/pointer/to/field=value; write /step_s=1"),
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
    for command in ["verify", "inspect", "export"] {
        std::fs::write(at.join("empty"), "").expect("writable");
        for no_log in ["vpd-foxglove.json", "empty"] {
            let refused = vpd(at, &[command, no_log]);
            assert_eq!(refused.status.code(), Some(2), "{command} {no_log}");
            assert!(text(&refused.stderr).contains("is not a log"), "{}", text(&refused.stderr));
        }
    }
}

#[test]
fn a_closed_pipe_is_no_error() {
    use std::io::Read;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let log = ["run", &scenario("heavy-top"), "-o", "it.mcap"];
    assert_eq!(vpd(at, &log).status.code(), Some(0));
    let top = scenario("heavy-top");
    // The reader closes at once, or after the beginning of a table longer than a pipe holds.
    for (arguments, read) in [
        (&["schema"][..], 0),
        (&["completions", "bash"], 0),
        (&["plan", &top], 0),
        (&["inspect", "it.mcap"], 0),
        (&["export", "it.mcap"], 0),
        (&["export", "it.mcap"], 1000),
    ] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_vpd"))
            .current_dir(at)
            .args(arguments)
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped())
            .spawn()
            .expect("the binary starts");
        let mut out = child.stdout.take().expect("a pipe");
        out.read_exact(&mut vec![0; read]).expect("so much is written");
        drop(out);
        let ended = child.wait_with_output().expect("a child");
        assert_eq!(ended.status.code(), Some(0), "{arguments:?}: {}", text(&ended.stderr));
        assert_eq!(text(&ended.stderr), "", "{arguments:?}");
    }
}

#[test]
fn a_scenario_comes_from_stdin() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let given = |arguments: &[&str], scenario: &str| {
        use std::io::Write;
        let mut child = Command::new(env!("CARGO_BIN_EXE_vpd"))
            .current_dir(at)
            .args(arguments)
            .stdin(std::process::Stdio::piped())
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped())
            .spawn()
            .expect("the binary starts");
        // A command that refuses its arguments reads nothing.
        let _ = child.stdin.take().expect("a pipe").write_all(scenario.as_bytes());
        child.wait_with_output().expect("a child")
    };
    let top = std::fs::read_to_string(scenario("heavy-top")).expect("shipped");
    let named = top.replacen("heavy-top", "a top/1", 1);
    let ran = given(&["run", "-", "--set", "/duration_s=0.1", "--set", "/expect=null"], &named);
    assert_eq!(ran.status.code(), Some(0), "{}", text(&ran.stderr));
    assert!(at.join("a-top-1.mcap").exists());
    let bad = given(&["run", "-"], &top.replacen("0.002", "-1", 1));
    assert_eq!(bad.status.code(), Some(2));
    assert!(text(&bad.stderr).contains("stdin: /step_s"), "{}", text(&bad.stderr));
    assert_eq!(given(&["plan", "-"], &top).status.code(), Some(0));
}

#[test]
fn shells_complete_what_there_is() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    for shell in ["bash", "zsh", "fish"] {
        let script = vpd(directory.path(), &["completions", shell]);
        assert_eq!(script.status.code(), Some(0));
        for word in ["stability", "export", "tolerance", "force"] {
            assert!(text(&script.stdout).contains(word), "{shell}: {word}");
        }
    }
    // Runs bash on the script, if it is installed.
    std::fs::write(
        directory.path().join("vpd.bash"),
        vpd(directory.path(), &["completions", "bash"]).stdout,
    )
    .expect("writable");
    let asked = "source ./vpd.bash; COMP_WORDS=(vpd exp); COMP_CWORD=1; _vpd vpd exp vpd; echo ${COMPREPLY[@]}";
    let asked = Command::new("bash").current_dir(directory.path()).args(["-c", asked]).output();
    if let Ok(asked) = asked {
        assert_eq!(text(&asked.stdout).trim(), "export", "{}", text(&asked.stderr));
    }
}

#[test]
fn figures_have_units() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let ran = vpd(at, &["run", &scenario("heavy-top"), "-o", "it.mcap"]);
    let inspected = vpd(at, &["inspect", "it.mcap"]);
    for (said, wanted) in [
        (&ran, ["J at the start", "J at the end", "kg m^2/s", " s, "]),
        (&inspected, ["J\n", "kg m^2/s\n", " s of simulated time", " bytes"]),
    ] {
        for unit in wanted {
            assert!(text(&said.stdout).contains(unit), "{unit}: {}", text(&said.stdout));
        }
    }
}

#[test]
fn null_takes_a_field_away_wherever_it_stands() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    let plan = |changes: &[&str]| {
        let mut arguments = vec!["plan", &top, "--json"];
        changes.iter().for_each(|change| arguments.extend(["--set", *change]));
        vpd(at, &arguments)
    };
    // Sections, fields with and without a default, items of lists, and fields that do not exist.
    for change in [
        "/expect=null",
        "/method=null",
        "/method/tableau=null",
        "/method/solver/tolerance=null",
        "/log/every=null",
        "/log/compression=null",
        "/scene/potential=null",
        "/scene/potential/0=null",
        "/scene/initial/attitude=null",
        "/accuracy=null",
        "/ensemble=null",
    ] {
        let planned = plan(&[change]);
        assert_eq!(planned.status.code(), Some(0), "{change}: {}", text(&planned.stderr));
    }
    assert_eq!(plan(&["/duration_s=null", "/steps=10"]).status.code(), Some(0));
    let free = plan(&["/scene/potential/0=null"]);
    let free: Value = serde_json::from_slice(&free.stdout).expect("JSON");
    assert_eq!(free["free_directions"], 3);
    for (change, said) in [
        ("/step_s=null", "missing field `step_s`"),
        ("/scene/potential/0/weight=null", "missing field `weight`"),
        ("/nowhere=null", "/nowhere: there is no such field to set: the scenario has "),
        (
            "/scene/initial/omega=null",
            "/scene/initial has attitude, orbit_frame, momentum, angular_velocity",
        ),
    ] {
        let refused = plan(&[change]);
        assert_eq!(refused.status.code(), Some(2), "{change}");
        assert!(text(&refused.stderr).contains(said), "{change}: {}", text(&refused.stderr));
    }
}

#[test]
fn first_mistakes_are_answered_by_what_to_write() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let top = scenario("heavy-top");
    let said = |change: &str| {
        let refused = vpd(directory.path(), &["plan", &top, "--set", change]);
        assert_eq!(refused.status.code(), Some(2), "{change}");
        text(&refused.stderr).to_owned()
    };
    for (change, wanted) in [
        (
            "/scene/initial/angular_velocity=[0,0,1]",
            r#"expected an object with one of `body`, `space`; write {"body":[0,0,1]}"#,
        ),
        ("/scene/initial={\"momentum\":[0,0,1]}", r#"write {"body":[0,0,1]}"#),
        ("/scene/initial/attitude=[1,0,0,0]", r#"write {"quaternion":[1,0,0,0]}"#),
        (
            "/scene/initial/attitude=[[1,0,0],[0,1,0],[0,0,1]]",
            r#"write {"matrix":[[1,0,0],[0,1,0],[0,0,1]]}"#,
        ),
        ("/scene/inertia=[1,2,3]", r#"write {"principal":[1,2,3]}"#),
        (
            "/scene/inertia=1",
            "expected an object with one of `principal`, `matrix`, `second_moments`",
        ),
        ("/method=vpd", r#"write {"name":"vpd"}"#),
        ("/accuracy=1e-6", r#"write {"error":1e-6}"#),
        ("/log/channels=\"/state\"", r#"write ["/state"]"#),
        ("/step_s=\"0.5\"", "write 0.5"),
        ("/ensemble=5", r#"write {"members":5}"#),
        ("step_s=0.5", "write /step_s=0.5"),
        ("/method/name=3", "expected one of `auto`, `vpd`"),
        ("/scene/potential/0/kind=3", "expected one of `uniform`"),
        ("/log/compression=false", "expected one of `"),
        ("/step=0.5", "give a number as `step_s`"),
        ("/stride=0.5", "expected one of `$schema`, `format`, `name`"),
        ("/step_s/deeper=1", "/step_s is a number"),
        ("/scene/potential/7/weight=1", "/scene/potential is a list with the items 0 to 0"),
    ] {
        let said = said(change);
        assert!(said.contains(wanted), "{change}: {said}");
    }
}

#[test]
fn a_sweep_and_a_scenario_are_told_apart() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let said = |arguments: &[&str]| {
        let refused = vpd(directory.path(), arguments);
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}");
        text(&refused.stderr).to_owned()
    };
    let run = said(&["run", &scenario("sweeps/pendulum-chaos")]);
    assert!(
        run.contains("/scenario: this is a sweep, not a scenario: `vpd sweep` runs it"),
        "{run}"
    );
    let sweep = said(&["sweep", &scenario("heavy-top")]);
    assert!(
        sweep.contains("/scene: this is a scenario, not a sweep: `vpd run` runs it"),
        "{sweep}"
    );
}

#[test]
fn a_picture_does_not_take_the_place_of_a_log() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    assert_eq!(vpd(at, &["run", &top, "-o", "top.mcap"]).status.code(), Some(0));
    let log = std::fs::read(at.join("top.mcap")).expect("a log");
    let sweep = scenario("sweeps/pendulum-chaos");
    for arguments in [
        vec!["diff", "top.mcap", "top.mcap", "--chart", "top.mcap"],
        vec!["sweep", &sweep, "--svg", "top.mcap"],
    ] {
        let refused = vpd(at, &arguments);
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}");
        assert!(text(&refused.stderr).contains("name it .svg"), "{}", text(&refused.stderr));
    }
    assert!(std::fs::read(at.join("top.mcap")).expect("still a log") == log);
    let drawn = vpd(at, &["diff", "top.mcap", "top.mcap", "--chart", "none.svg"]);
    assert_eq!(drawn.status.code(), Some(0), "{}", text(&drawn.stderr));
}

#[test]
fn a_log_is_not_written_under_the_name_of_a_table() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    for (name, wanted) in [
        ("top.csv", "`vpd export LOG.mcap -o top.csv`"),
        ("top.PARQUET", "`vpd export LOG.mcap -o top.PARQUET`"),
        ("top.arrow", "`vpd export LOG.mcap -o top.arrow`"),
        ("top.json", "`vpd inspect LOG.mcap --json`"),
    ] {
        let refused = vpd(at, &["run", &top, "-o", name]);
        assert_eq!(refused.status.code(), Some(2), "{name}");
        let said = text(&refused.stderr);
        assert!(said.contains(name) && said.contains("name it .mcap"), "{said}");
        assert!(said.contains(wanted), "{said}");
        assert!(!at.join(name).exists(), "{name}");
    }
    for name in ["top", "top.log"] {
        let ran = vpd(at, &["run", &top, "-o", name]);
        assert_eq!(ran.status.code(), Some(0), "{name}: {}", text(&ran.stderr));
    }
    let sweep = scenario("sweeps/pendulum-chaos");
    let refused = vpd(at, &["sweep", &sweep, "--member", "0", "--log", "member.csv"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("name it .mcap"), "{}", text(&refused.stderr));
}

/// Returns the dipole with `steps` steps, each in the log.
fn every_step(steps: &str) -> Vec<String> {
    let steps = format!("/steps={steps}");
    ["run", &scenario("dipole"), "-o", "it.mcap", "--set", &steps, "--set", "/log/every=1"]
        .into_iter()
        .chain(["--set", "/expect=null"])
        .map(str::to_owned)
        .collect()
}

fn begun(at: &Path, arguments: &[String]) -> std::process::Child {
    let child = Command::new(env!("CARGO_BIN_EXE_vpd"))
        .current_dir(at)
        .args(arguments)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the binary starts");
    let logged = || last_checkpoint(&at.join("it.mcap")).ok().flatten();
    while logged().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    child
}

#[test]
fn a_long_run_says_at_its_start_what_it_will_take() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let steps = "400000000";
    let mut long = begun(directory.path(), &every_step(steps));
    long.kill().expect("it runs");
    let said = long.wait_with_output().expect("it ended").stderr;
    let said = text(&said);
    assert!(said.starts_with(&format!("dipole: {steps} steps, about ")), "{said}");
    let short = vpd(directory.path(), &["run", &scenario("heavy-top")]);
    assert_eq!(text(&short.stderr), "");
}

#[cfg(unix)]
#[test]
fn a_log_that_is_being_written_is_locked() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let first = begun(at, &every_step("400000"));
    let (mut again, words) = (every_step("1000"), ["--force".to_owned()]);
    again.extend(words);
    let again: Vec<&str> = again.iter().map(String::as_str).collect();
    let second = vpd(at, &again);
    assert_eq!(second.status.code(), Some(2), "{}", text(&second.stderr));
    let holder = format!("another process ({}) is writing it", first.id());
    assert!(text(&second.stderr).contains(&holder), "{}", text(&second.stderr));
    let ended = first.wait_with_output().expect("a child");
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    assert_eq!(vpd(at, &["verify", "it.mcap"]).status.code(), Some(0));
}

#[test]
fn a_log_is_replaced_by_force_alone() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    let short = ["run", &top, "-o", "it.mcap", "--set", "/duration_s=0.5"];
    assert_eq!(vpd(at, &short).status.code(), Some(0));
    let kept = std::fs::read(at.join("it.mcap")).expect("a log");
    // This run would fail at its first step.
    let fails = ["run", &top, "-o", "it.mcap", "--set", "/step_s=5"];
    for arguments in [&short[..], &fails[..]] {
        let refused = vpd(at, arguments);
        assert_eq!(refused.status.code(), Some(2), "{}", text(&refused.stderr));
        assert!(text(&refused.stderr).contains("--force"), "{}", text(&refused.stderr));
        assert_eq!(std::fs::read(at.join("it.mcap")).expect("a log"), kept);
    }
    let forced = vpd(at, &[&fails[..], &["--force"]].concat());
    assert_eq!(forced.status.code(), Some(1), "{}", text(&forced.stderr));
    assert_ne!(std::fs::read(at.join("it.mcap")).expect("a log"), kept);
}

/// A user who follows the advice of a failure runs the same command again.
#[test]
fn a_log_of_a_failed_run_is_replaced_by_one_of_its_name() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let top = scenario("heavy-top");
    let run = ["run", &top, "-o", "it.mcap", "--set"];
    let code = |set: &[&str]| vpd(at, &[&run[..], set].concat()).status.code();
    let log = || std::fs::read(at.join("it.mcap")).expect("a log");
    let fails = &["/step_s=5"];
    assert_eq!(code(fails), Some(1));
    let failed = log();
    assert_eq!(code(&["/name=another"]), Some(2), "of another name");
    assert_eq!(log(), failed);
    assert_eq!(code(fails), Some(1), "as often as it fails");
    assert_eq!(code(&["/duration_s=0.5"]), Some(0));
    let succeeded = log();
    assert_eq!(code(fails), Some(2), "what has succeeded stays");
    assert_eq!(log(), succeeded);
    // The target of a link is not looked at.
    #[cfg(unix)]
    {
        std::fs::write(at.join("failed.mcap"), failed).expect("a copy");
        std::fs::remove_file(at.join("it.mcap")).expect("removed");
        std::os::unix::fs::symlink("failed.mcap", at.join("it.mcap")).expect("a link");
        assert_eq!(code(fails), Some(2));
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_resumes_and_nothing_else_takes_its_place() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let whole = every_step("400000");
    let child = begun(at, &whole);
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().expect("kill").success());
    let stopped = child.wait_with_output().expect("a child");
    assert_eq!(stopped.status.code(), Some(130), "{}", text(&stopped.stderr));
    assert!(text(&stopped.stderr).contains("the same command resumes it"));
    let part = std::fs::read(at.join("it.mcap.part")).expect("an unfinished log");
    let other = every_step("1000");
    let other: Vec<&str> = other.iter().map(String::as_str).collect();
    let refused = vpd(at, &other);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused.stderr));
    assert_eq!(std::fs::read(at.join("it.mcap.part")).expect("as before"), part);
    let whole: Vec<&str> = whole.iter().map(String::as_str).collect();
    let resumed = vpd(at, &whole);
    assert_eq!(resumed.status.code(), Some(0), "{}", text(&resumed.stderr));
    assert!(text(&resumed.stderr).contains("resuming at step "), "{}", text(&resumed.stderr));
    assert_eq!(vpd(at, &["verify", "it.mcap"]).status.code(), Some(0));
}
