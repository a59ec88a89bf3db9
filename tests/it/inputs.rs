//! What others write and where others point: text in other encodings, files of other programs, places that no file may
//! replace, damaged tables; and the forms of a start.

use std::fs;
use std::path::Path;
use std::process::Command;

use mcap::records::{MessageHeader, Metadata};
use serde_json::{Value, json};
use vpd::advise;
use vpd::plan::Plan;
use vpd::scenario::{Scenario, ScenarioError};

use crate::cli::{scenario, text, vpd};
use crate::scenarios::run;

fn refused(at: &Path, arguments: &[&str], said: &[&str]) {
    let output = vpd(at, arguments);
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
    for said in said {
        assert!(stderr.contains(said), "{arguments:?}: {said} is not in {stderr}");
    }
}

fn succeeds(at: &Path, arguments: &[&str]) -> String {
    let output = vpd(at, arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", text(&output.stderr));
    text(&output.stdout).to_owned()
}

/// A free body with an initial state.
fn free(initial: Value) -> Value {
    json!({
        "name": "free",
        "scene": { "inertia": { "principal": [1, 2, 3] }, "initial": initial },
        "step_s": 0.1,
        "steps": 10
    })
}

fn planned(document: &Value) -> Plan {
    let scenario = Scenario::from_json(document.to_string().as_bytes()).expect("a scenario");
    Plan::new(&scenario).expect("a plan")
}

fn turning() -> Value {
    json!({ "angular_velocity": { "body": [0.1, 0.2, 0.3] } })
}

#[test]
fn a_byte_order_mark_is_read_over_and_wide_text_is_refused() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let plain = free(turning()).to_string();
    let sweep = json!({
        "scenario": free(turning()),
        "vary": [{ "pointer": "/step_s", "values": { "list": [0.1, 0.2] } }]
    });
    let marked = |text: &str| [b"\xEF\xBB\xBF".as_slice(), text.as_bytes()].concat();
    fs::write(at.join("marked.json"), marked(&plain)).expect("written");
    fs::write(at.join("sweep.json"), marked(&sweep.to_string())).expect("written");
    succeeds(at, &["run", "marked.json"]);
    succeeds(at, &["run", "marked.json", "-o", "set.mcap", "--set", "/steps=5"]);
    succeeds(at, &["sweep", "sweep.json"]);
    refused(at, &["run", "sweep.json"], &["this is a sweep, not a scenario"]);
    // The one reader of all entry points.
    let read = Scenario::from_json(&marked(&plain)).expect("a scenario");
    assert_eq!(read, Scenario::from_json(plain.as_bytes()).expect("a scenario"));

    let little: Vec<u8> = plain.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let big: Vec<u8> = plain.encode_utf16().flat_map(u16::to_be_bytes).collect();
    for wide in [[b"\xFF\xFE", &little[..]].concat(), [b"\xFE\xFF", &big[..]].concat(), little, big]
    {
        fs::write(at.join("wide.json"), wide).expect("written");
        refused(at, &["run", "wide.json"], &["wide.json", "UTF-16", "UTF-8"]);
    }
}

#[test]
fn names_that_are_too_long_for_files_are_refused_before_anything_is_computed() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    fs::write(at.join("a.json"), free(turning()).to_string()).expect("written");
    let sweep = json!({
        "scenario": free(turning()),
        "vary": [{ "pointer": "/step_s", "values": { "list": [0.1, 0.2] } }]
    });
    fs::write(at.join("sweep.json"), sweep.to_string()).expect("written");
    succeeds(at, &["run", "a.json"]);
    let named =
        |bytes: usize, ending: &str| format!("{}{ending}", "n".repeat(bytes - ending.len()));
    let (log, table, picture) = (named(304, ".mcap"), named(304, ".csv"), named(304, ".svg"));
    let inner = format!("{}/a.mcap", named(304, ""));
    let said = ["304 bytes", "at most 250 are allowed"];
    for arguments in [
        &["run", "a.json", "-o", &log][..],
        &["run", "a.json", "-o", &inner],
        &["export", "a.mcap", "-o", &table],
        &["diff", "a.mcap", "a.mcap", "--chart", &picture],
        &["chart", "a.json", "-o", &picture],
        &["stability", "a.json", "-o", &picture],
        &["sweep", "sweep.json", "-o", &table],
        &["sweep", "sweep.json", "--svg", &picture],
        &["sweep", "sweep.json", "--member", "0", "--log", &log],
        &["merge", "a.csv", "-o", &table],
    ] {
        refused(at, arguments, &said);
    }
    // The name of an input can be one that its output cannot have.
    for bytes in [251, 255] {
        let long = named(bytes, ".json");
        fs::copy(at.join("a.json"), at.join(&long)).expect("copied");
        succeeds(at, &["run", &long, "-o", "b.mcap", "--force"]);
        refused(at, &["run", &long], &[&format!("{bytes} bytes"), "name the output with -o"]);
    }
    let fits = named(250, ".json");
    fs::copy(at.join("a.json"), at.join(&fits)).expect("copied");
    succeeds(at, &["run", &fits]);
    assert!(at.join(named(250, ".mcap")).exists());
    // The longest name of a scenario is that of a file, too.
    for name in ["n".repeat(200), "é".repeat(100), "語".repeat(66)] {
        let mut document = free(turning());
        document["name"] = json!(name);
        fs::write(at.join("long.json"), document.to_string()).expect("written");
        let given = fs::File::open(at.join("long.json")).expect("there");
        let mut command = Command::new(env!("CARGO_BIN_EXE_vpd"));
        let ran = command.args(["run", "-"]).current_dir(at).stdin(given).output().expect("runs");
        assert_eq!(ran.status.code(), Some(0), "{}", text(&ran.stderr));
        assert!(at.join(format!("{name}.mcap")).exists());
    }
}

#[test]
fn a_text_without_end_is_refused() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let long = fs::File::create(at.join("long.json")).expect("created");
    long.set_len((64 << 20) + 1).expect("a hole takes no room");
    refused(at, &["run", "long.json"], &["long.json", "64 MiB"]);
    refused(at, &["sweep", "long.json"], &["long.json", "64 MiB"]);
}

#[test]
fn names_and_pointers_that_only_look_right_are_refused() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let dipole = scenario("dipole");
    refused(at, &["run", &dipole, "-o", "-"], &["name a file"]);
    assert!(!at.join("-").exists());
    for index in ["00", "+0", "-1", "01"] {
        let change = format!("/scene/potential/{index}/weight=1");
        refused(at, &["plan", &dipole, "--set", &change], &["the items 0 to 2"]);
    }
    succeeds(at, &["plan", &dipole, "--set", "/scene/potential/0/weight=1"]);
}

/// Writes a file with one message and one metadata record.
fn mcap_file(at: &Path, library: &str, chunked: bool, topic: &str, metadata: Metadata) {
    let file = std::io::BufWriter::new(fs::File::create(at).expect("created"));
    let options = mcap::WriteOptions::new().library(library).use_chunks(chunked);
    let mut writer = options.create(file).expect("a writer");
    writer.write_metadata(&metadata).expect("written");
    let schema = writer.add_schema("x", "jsonschema", b"{}").expect("a schema");
    let channel =
        writer.add_channel(schema, topic, "json", &Default::default()).expect("a channel");
    let header = MessageHeader { channel_id: channel, sequence: 0, log_time: 5, publish_time: 5 };
    writer.write_to_known_channel(&header, b"{}").expect("a message");
    writer.finish().expect("finished");
}

#[test]
fn a_file_of_another_program_is_called_so_and_its_text_is_escaped() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let other = || Metadata { name: "notes".to_owned(), metadata: Default::default() };
    for chunked in [true, false] {
        mcap_file(&at.join("imu.mcap"), "recorder/1.6.0 \u{1b}[2J", chunked, "/imu", other());
        for arguments in [
            &["inspect", "imu.mcap"][..],
            &["inspect", "imu.mcap", "--json"],
            &["verify", "imu.mcap"],
            &["export", "imu.mcap"],
            &["diff", "imu.mcap", "imu.mcap"],
        ] {
            let said = ["another program", r"recorder/1.6.0 \u{1b}[2J"];
            if arguments[0] == "verify" {
                let output = vpd(at, arguments);
                assert!(text(&output.stderr).contains(said[0]), "{}", text(&output.stderr));
                assert!(!text(&output.stderr).contains('\u{1b}'));
            } else {
                refused(at, arguments, &said);
            }
        }
    }
    // One of ours, by its job, that says what a terminal must not obey.
    let job = [("na\u{1b}[31mme".to_owned(), "a\u{1b}]0;title\u{7}\u{202e}b\r".to_owned())];
    let job = Metadata { name: "vpd.job".to_owned(), metadata: job.into_iter().collect() };
    mcap_file(&at.join("ours.mcap"), "mcap-tool/1", true, "/top\u{9b}31mic\u{202e}", job);
    let shown = succeeds(at, &["inspect", "ours.mcap"]);
    assert!(shown.contains(r"na\u{1b}[31mme: a\u{1b}]0;title\u{7}\u{202e}b\u{d}"), "{shown}");
    assert!(shown.contains(r"/top\u{9b}31mic\u{202e}"), "{shown}");
    assert!(!shown.contains(|c: char| c.is_control() && c != '\n'), "{shown:?}");
}

#[cfg(unix)]
#[test]
fn nothing_but_a_file_is_replaced() {
    use std::os::unix::fs::FileTypeExt;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let pipe = |name: &str| {
        let made = std::process::Command::new("mkfifo").arg(at.join(name)).status();
        assert!(made.expect("mkfifo").success());
    };
    let still = |name: &str| {
        let kind = at.join(name).symlink_metadata().expect("still there").file_type();
        assert!(kind.is_fifo() || kind.is_symlink() || kind.is_socket(), "{name}");
        assert!(!at.join(format!("{name}.part")).exists(), "{name}");
    };
    fs::write(at.join("free.json"), free(turning()).to_string()).expect("written");
    let sweep = json!({
        "scenario": free(turning()),
        "vary": [{ "pointer": "/step_s", "values": { "list": [0.1, 0.2] } }]
    });
    fs::write(at.join("sweep.json"), sweep.to_string()).expect("written");
    succeeds(at, &["run", "free.json"]);
    succeeds(at, &["sweep", "sweep.json", "--shard", "1/1", "-o", "part.csv"]);
    for name in ["pipe.mcap", "pipe.csv", "energy.svg", "pipe.svg"] {
        pipe(name);
    }
    std::os::unix::fs::symlink("/dev/null", at.join("device.mcap")).expect("a link");
    let _socket = std::os::unix::net::UnixListener::bind(at.join("socket.csv")).expect("a socket");
    refused(at, &["run", "free.json", "--force", "-o", "pipe.mcap"], &["a pipe", "--no-log"]);
    refused(at, &["run", "free.json", "-o", "pipe.mcap"], &["a pipe"]);
    refused(at, &["run", "free.json", "--force", "-o", "device.mcap"], &["a device"]);
    refused(at, &["export", "free.mcap", "--force", "-o", "pipe.csv"], &["a pipe"]);
    refused(at, &["sweep", "sweep.json", "--force", "-o", "pipe.csv"], &["a pipe"]);
    refused(at, &["sweep", "sweep.json", "--force", "-o", "socket.csv"], &["a socket"]);
    refused(at, &["merge", "part.csv", "--force", "-o", "socket.csv"], &["a socket"]);
    refused(at, &["chart", "free.mcap", "-o", "."], &["a pipe"]);
    refused(at, &["sweep", "sweep.json", "--svg", "pipe.svg"], &["a pipe"]);
    refused(at, &["diff", "free.mcap", "free.mcap", "--chart", "pipe.svg"], &["a pipe"]);
    for name in ["pipe.mcap", "pipe.csv", "energy.svg", "pipe.svg", "device.mcap", "socket.csv"] {
        still(name);
    }
    assert!(fs::metadata("/dev/null").expect("there").file_type().is_char_device());
}

#[test]
fn a_run_without_a_log_leaves_none() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    fs::write(at.join("free.json"), free(turning()).to_string()).expect("written");
    let summary = succeeds(at, &["run", "free.json", "--no-log", "--json"]);
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert_eq!((&summary["steps"], &summary["log"]), (&json!(10), &json!("")));
    assert!(succeeds(at, &["run", "free.json", "--no-log"]).contains("none kept"));
    assert_eq!(fs::read_dir(at).expect("a folder").count(), 1);
    assert_eq!(vpd(at, &["run", "free.json", "--no-log", "-o", "x.mcap"]).status.code(), Some(2));
}

#[test]
fn a_damaged_line_of_a_table_is_run_again() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let values: Vec<f64> = (1..=8).map(|k| 0.01 * f64::from(k)).collect();
    let sweep = json!({
        "scenario": free(turning()),
        "vary": [{ "pointer": "/step_s", "values": { "list": values } }]
    });
    fs::write(at.join("sweep.json"), sweep.to_string()).expect("written");
    succeeds(at, &["sweep", "sweep.json", "-o", "whole.csv"]);
    let whole = fs::read(at.join("whole.csv")).expect("a table");
    succeeds(at, &["sweep", "sweep.json", "--shard", "1/1", "-o", "part.csv"]);
    let part = fs::read_to_string(at.join("part.csv")).expect("a part");
    let rows: Vec<&str> = part.lines().collect();
    let damages: [(&str, &str); 3] = [("0.04", "0.05"), ("succeeded", "failed"), ("4,", "5,")];
    for (from, to) in damages {
        // Member 3, of which one word is another, as the disk may have it: the line still reads as one.
        let mut lines = rows.clone();
        let line = if from == "4," {
            lines[5].replacen(',', "0,", 4)
        } else {
            lines[5].replacen(from, to, 1)
        };
        assert_ne!(line, rows[5], "{from}");
        lines[5] = &line;
        fs::write(at.join("again.csv.part"), lines.join("\n") + "\n").expect("written");
        let said = succeeds(at, &["sweep", "sweep.json", "--shard", "1/1", "-o", "again.csv"]);
        assert!(said.contains("resumed         with 3 members"), "{said}");
        assert!(said.contains("the line of member 3"), "{said}");
        let again = fs::read_to_string(at.join("again.csv")).expect("a part");
        assert!(again == part, "{from}");
        fs::remove_file(at.join("again.csv")).expect("removed");
        // A merge has nothing to run again.
        fs::write(at.join("bad.csv"), lines.join("\n") + "\n").expect("written");
        refused(at, &["merge", "bad.csv", "-o", "no.csv"], &["damaged: members 3 to 7"]);
    }
    succeeds(at, &["merge", "part.csv", "-o", "merged.csv"]);
    assert!(fs::read(at.join("merged.csv")).expect("a table") == whole);
}

#[test]
fn a_cut_log_does_not_agree_with_a_whole_one() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let heavy = scenario("heavy-top");
    let log = ["/log/compression=none", "/log/every=1", "/duration_s=20"];
    let mut arguments = vec!["run", &heavy, "-o", "whole.mcap", "--set", "/expect=null"];
    log.iter().for_each(|change| arguments.extend(["--set", *change]));
    succeeds(at, &arguments);
    let whole = fs::read(at.join("whole.mcap")).expect("a log");
    fs::write(at.join("cut.mcap"), &whole[..whole.len() * 3 / 5]).expect("written");
    for [first, second, is_cut] in
        [["whole.mcap", "cut.mcap", "second"], ["cut.mcap", "whole.mcap", "first"]]
    {
        let output = vpd(at, &["diff", first, second]);
        let said = text(&output.stdout);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(&format!("unfinished        the {is_cut} log")), "{said}");
        assert!(said.contains("only in the") && !said.contains("they agree\n"), "{said}");
        let output = vpd(at, &["diff", first, second, "--json"]);
        let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
        let alone = ["only_first", "only_second"].map(|key| found[key].as_u64().expect("a count"));
        assert!(alone.iter().sum::<u64>() > 0 && alone.contains(&0), "{alone:?}");
        assert!(
            found["unfinished"].as_array().is_some_and(|both| both.iter().any(Value::is_string))
        );
    }
    assert!(succeeds(at, &["diff", "whole.mcap", "whole.mcap"]).contains("they agree\n"));
}

/// The axis and the angle in degrees at which a scene starts.
fn start(attitude: Value) -> ([f64; 3], f64) {
    let plan = planned(&free(json!({ "attitude": attitude })));
    let start = plan.start.expect("n = 3");
    (start.axis, start.angle_deg)
}

fn assert_start(attitude: Value, axis: [f64; 3], angle_deg: f64) {
    let (found, angle) = start(attitude.clone());
    let off = found.iter().zip(axis).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 1e-14 && (angle - angle_deg).abs() < 1e-12, "{attitude}: {found:?}, {angle}");
}

#[test]
fn a_start_may_be_given_by_angles_and_by_rodrigues() {
    let third = 1.0 / 3.0_f64.sqrt();
    // A quarter turn about z and one about the new x: y comes to z, z to x, x to y.
    let euler = |sequence: &str, angles: [f64; 3]| json!({"euler": {"sequence": sequence, "angles_deg": angles}});
    assert_start(euler("zxz", [90.0, 90.0, 0.0]), [third; 3], 120.0);
    assert_start(euler("zxz", [90.0, 0.0, -30.0]), [0.0, 0.0, 1.0], 60.0);
    assert_start(euler("xyz", [0.0, 25.0, 0.0]), [0.0, 1.0, 0.0], 25.0);
    // A turn about x and then about the new y, and the same about the axes of space in the other order.
    assert_start(euler("xyz", [90.0, 90.0, 0.0]), [third, third, third], 120.0);
    assert_start(euler("yxz", [90.0, 90.0, 0.0]), [third, third, -third], 120.0);
    let yaw = json!({"roll_pitch_yaw": {"angles_deg": [10, 20, 30]}});
    let (axis, angle) = start(euler("zyx", [30.0, 20.0, 10.0]));
    assert_start(yaw, axis, angle);
    // g = R_z(yaw) R_y(pitch) R_x(roll), from its half angles.
    let [roll, pitch, yaw] = [10.0_f64, 20.0, 30.0].map(|angle| 0.5 * angle.to_radians());
    let w = roll.cos() * pitch.cos() * yaw.cos() + roll.sin() * pitch.sin() * yaw.sin();
    assert!((angle - 2.0 * w.acos().to_degrees()).abs() < 1e-12);
    let radians = json!({"roll_pitch_yaw": {"angles_rad": [2.0 * roll, 2.0 * pitch, 2.0 * yaw]}});
    assert_start(radians, axis, angle);
    assert_start(
        json!({"axis_angle": {"axis": [0, 3, 0], "angle_deg": 12.5}}),
        [0.0, 1.0, 0.0],
        12.5,
    );
    let tan = 15.0_f64.to_radians().tan();
    assert_start(json!({"mrp": [0, tan, 0]}), [0.0, 1.0, 0.0], 60.0);
    assert_start(json!({"mrp": [0, 0, 1]}), [0.0, 0.0, 1.0], 180.0);
    assert_start(json!({"mrp": [0, 0, 0]}), [0.0, 0.0, 1.0], 0.0);
    // The scenario is written back as it was given.
    let given = free(json!({ "attitude": euler("zxz", [90.0, 0.0, -30.0]) }));
    let scenario = Scenario::from_json(given.to_string().as_bytes()).expect("a scenario");
    let back: Value = serde_json::from_slice(&scenario.to_json()).expect("JSON");
    assert_eq!(back["scene"]["initial"], given["scene"]["initial"]);
}

#[test]
fn half_turns_are_read_as_half_turns() {
    // nalgebra's own reading of a matrix ends 180 degrees off for some of these.
    let mut seen = 0;
    for k in 0..72 {
        let (longitude, latitude) =
            (f64::from(k % 12) * 30.0_f64.to_radians(), f64::from(k / 12 * 30 - 60).to_radians());
        let axis =
            [latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin()];
        let entry = |i: usize, j: usize| 2.0 * axis[i] * axis[j] - f64::from(u8::from(i == j));
        let matrix: Vec<Vec<f64>> = (0..3).map(|i| (0..3).map(|j| entry(i, j)).collect()).collect();
        let (found, angle_deg) = start(json!({ "matrix": matrix }));
        assert!((angle_deg - 180.0).abs() < 1e-6, "{axis:?}: {angle_deg}");
        // Either end of the axis.
        let along: f64 = found.iter().zip(axis).map(|(a, b)| a * b).sum();
        assert!((along.abs() - 1.0).abs() < 1e-14, "{axis:?}: {found:?}");
        seen += 1;
    }
    assert_eq!(seen, 72);
}

#[test]
fn the_plan_warns_of_what_is_easily_overlooked() {
    let warned = |document: &Value, said: &str| {
        let warnings = planned(document).warnings;
        warnings.iter().any(|warning| warning.contains(said))
    };
    // The middle axis, and the others.
    let spin = |omega: [f64; 3]| free(json!({ "angular_velocity": { "body": omega } }));
    assert!(warned(&spin([0.001, 1.0, 0.0]), "middle axis"));
    for steady in [[1.0, 0.001, 0.0], [0.0, 0.001, 1.0], [0.5, 0.5, 0.5], [0.0; 3]] {
        assert!(!warned(&spin(steady), "middle axis"), "{steady:?}");
    }
    // J1 = 1, J2 = 2, J3 = 3 at 1 rad/s: the rate is sqrt(1 * 1 / 3).
    assert!(warned(&spin([0.0, 1.0, 0.0]), "every 1.732e0 s"));

    // 1 kg at 0.5 m has 0.25 kg m^2.
    let weight = |moment: f64| {
        let mut document = free(turning());
        document["scene"]["inertia"]["principal"] = json!([moment, moment, 0.01]);
        document["scene"]["potential"] = json!([
            { "kind": "uniform", "weight": 9.81, "body_point": [0, 0, 0.5], "direction": [0, 0, 1] }
        ]);
        document
    };
    assert!(warned(&weight(0.1), "not about the centre of mass"));
    assert!(!warned(&weight(0.25), "centre of mass") && !warned(&weight(0.4), "centre of mass"));

    let orbit = |strength: f64| {
        let mut document = free(turning());
        document["scene"]["driven"] = json!([{
            "term": { "kind": "gravity_gradient", "strength": strength, "direction": [1, 0, 0] },
            "path": { "orbit": { "towards": [0, 1, 0], "mean_motion_rad_s": 0.001 } }
        }]);
        document
    };
    assert!(warned(&orbit(1e-6), "three times that"));
    assert!(!warned(&orbit(3e-6), "three times that"));
    let mut longer = orbit(0.25e-6);
    longer["scene"]["driven"][0]["term"]["direction"] = json!([0, -2, 0]);
    longer["scene"]["driven"][0]["path"]["orbit"]["towards"] = json!([1, 0, 0]);
    assert!(warned(&longer, "three times that, 7.5e-7"));

    let mut short = free(turning());
    short["step_s"] = json!(1e-10);
    assert!(warned(&short, "whole nanoseconds") == (planned(&short).every == 1));
    short["log"] = json!({ "every": 1 });
    assert!(warned(&short, "whole nanoseconds"));
    short["log"] = json!({ "every": 10 });
    assert!(!warned(&short, "whole nanoseconds"));
}

/// A gravity gradient on an orbit has the strength of that orbit if none is given: the bits of the same run with `3 n^2`. Elsewhere one
/// is needed.
#[test]
fn an_orbit_gives_a_gravity_gradient_its_strength() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let with = |strength: Option<f64>, direction: Value| {
        let mut document = free(turning());
        let term = json!({ "kind": "gravity_gradient", "direction": direction });
        document["scene"]["driven"] = json!([{
            "term": term,
            "path": { "orbit": { "towards": [0, 1, 0], "mean_motion_rad_s": 0.03, "eccentricity": 0.2 } }
        }]);
        if let Some(strength) = strength {
            document["scene"]["driven"][0]["term"]["strength"] = json!(strength);
        }
        document
    };
    let end = |document: &Value| {
        let log = directory.path().join("log.mcap");
        let last = run(&document.to_string(), &log).last;
        std::fs::remove_file(log).expect("written");
        last
    };
    assert_eq!(
        end(&with(None, json!([1, 0, 0]))),
        end(&with(Some(3.0 * (0.03 * 0.03)), json!([1, 0, 0])))
    );
    assert_eq!(
        end(&with(None, json!([2, 0, 0]))),
        end(&with(Some(0.75 * (0.03 * 0.03)), json!([2, 0, 0])))
    );
    assert!(planned(&with(None, json!([1, 0, 0]))).warnings.is_empty());
    let mut turning = with(None, json!([1, 0, 0]));
    turning["scene"]["driven"][0]["path"] =
        json!({ "turning": { "from": [1, 0, 0], "towards": [0, 1, 0], "rate_rad_s": 0.03 } });
    let refused = Scenario::from_json(turning.to_string().as_bytes()).expect_err("none to take");
    assert_eq!(refused.pointer, "/scene/driven/0/term");
    assert!(refused.message.contains("missing field `strength`"), "{refused}");
}

#[test]
fn a_free_body_takes_steps_of_any_length_or_is_refused_with_the_figure() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let mut document = free(turning());
    document["step_s"] = json!(1e8);
    document["steps"] = json!(2);
    fs::write(at.join("free.json"), document.to_string()).expect("written");
    let summary = succeeds(at, &["run", "free.json", "--json"]);
    let summary: Value = serde_json::from_str(&summary).expect("JSON");
    assert_eq!(summary["outcome"], "succeeded");
    document["scene"]["initial"]["angular_velocity"]["body"] = json!([1e5, 2e5, 3e5]);
    let scenario = Scenario::from_json(document.to_string().as_bytes()).expect("a scenario");
    let refused: ScenarioError = advise::plan(&scenario).expect_err("too far");
    let ScenarioError { pointer, message, .. } = refused;
    assert_eq!(pointer, "/step_s");
    assert!(message.contains("1e12 rad") && message.contains("at most"), "{message}");
}
