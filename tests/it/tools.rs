//! Exports for other programs: tables that read back to the bit, and comparisons of two logs.

use std::collections::BTreeMap;
use std::path::Path;

use prost::Message as _;
use serde_json::Value;
use vpd::log::messages::{Energy, State};
use vpd::log::rows::{Row, read_rows};

use crate::cli::{scenario, text, vpd};
use crate::verify::forge;

/// Runs a shipped scenario with changes, to `NAME.mcap`.
fn run(at: &Path, name: &str, log: &str, changes: &[&str]) {
    let scenario = scenario(name);
    let mut arguments = vec!["run", &scenario, "-o", log, "--set", "/expect=null"];
    changes.iter().for_each(|change| arguments.extend(["--set", *change]));
    let ran = vpd(at, &arguments);
    assert_eq!(ran.status.code(), Some(0), "{}", text(&ran.stderr));
}

fn rows(log: &Path, member: u64) -> Vec<Row> {
    let mut rows = Vec::new();
    let ending = read_rows(log, member, |row| {
        rows.push(row);
        std::ops::ControlFlow::Continue(())
    });
    assert!(ending.expect("a log").finished);
    rows
}

/// Returns the cells of a table by column; an empty one is `None`.
fn columns(csv: &[u8]) -> BTreeMap<String, Vec<Option<String>>> {
    let mut lines = text(csv).lines();
    let head: Vec<&str> = lines.next().expect("a head").split(',').collect();
    let mut columns: BTreeMap<String, Vec<_>> =
        head.iter().map(|name| ((*name).to_owned(), Vec::new())).collect();
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        assert_eq!(cells.len(), head.len(), "{line}");
        for (name, cell) in head.iter().zip(cells) {
            let cell = (!cell.is_empty()).then(|| cell.to_owned());
            columns.get_mut(*name).expect("a column").push(cell);
        }
    }
    columns
}

fn bits(cells: &[Option<String>]) -> Vec<Option<u64>> {
    let bits = |cell: &String| cell.parse::<f64>().expect("a number").to_bits();
    cells.iter().map(|cell| cell.as_ref().map(bits)).collect()
}

#[test]
fn a_table_reads_back_to_the_bit() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "heavy-top", "top.mcap", &["/duration_s=1", "/log/every=1"]);
    let wanted = rows(&at.join("top.mcap"), 0);
    assert_eq!(wanted.len(), 501);
    let exported = vpd(at, &["export", "top.mcap"]);
    assert_eq!(exported.status.code(), Some(0), "{}", text(&exported.stderr));
    let table = columns(&exported.stdout);
    let check = |name: &str, of: &dyn Fn(&Row) -> Option<f64>| {
        let wanted: Vec<_> = wanted.iter().map(|row| of(row).map(f64::to_bits)).collect();
        assert_eq!(bits(&table[name]), wanted, "{name}");
    };
    let state =
        |of: fn(&vpd::log::messages::State) -> f64| move |row: &Row| row.state.as_ref().map(of);
    check("time_s", &state(|state| state.time_s));
    check("attitude_1_2", &state(|state| state.attitude[1]));
    check("attitude_3_3", &state(|state| state.attitude[8]));
    check("quaternion_w", &state(|state| state.quaternion[0]));
    check("quaternion_z", &state(|state| state.quaternion[3]));
    check("body_momentum_y", &state(|state| state.body_momentum[1]));
    check("angular_velocity_x", &state(|state| state.angular_velocity[0]));
    check("energy_total", &|row| row.energy.as_ref().map(|energy| energy.total));
    check("energy_error", &|row| row.energy.as_ref().map(|energy| energy.error));
    check("orthogonality_error", &|row| row.orthogonality.as_ref().map(|found| found.error));
    check("spatial_momentum_x", &|row| {
        row.momentum.as_ref().map(|found| found.spatial_momentum[0])
    });
    check("momentum_drift", &|row| row.momentum.as_ref().and_then(|found| found.drift));
    // The start was not solved for.
    check("solver_increment", &|row| row.solver.as_ref().map(|solver| solver.increment));
    assert_eq!(table["solver_rung"][0], None);
    let rungs: Vec<_> =
        wanted.iter().map(|row| row.solver.as_ref().map(|s| s.rung.clone())).collect();
    assert_eq!(table["solver_rung"], rungs);
    let times: Vec<_> = wanted.iter().map(|row| Some(row.time_ns.to_string())).collect();
    assert_eq!(table["log_time_ns"], times);
    let few = vpd(at, &["export", "top.mcap", "--channels", "/energy", "-o", "energy.csv"]);
    assert_eq!(few.status.code(), Some(0), "{}", text(&few.stderr));
    let few = columns(&std::fs::read(at.join("energy.csv")).expect("a table"));
    let names: Vec<&str> = few.keys().map(String::as_str).collect();
    let energies = ["energy_error", "energy_kinetic", "energy_potential", "energy_total"];
    // No energy is put in, and nothing turns.
    assert_eq!(names, [&energies[..], &["log_time_ns", "time_s"]].concat());
    assert_eq!(few["energy_error"], table["energy_error"]);
}

#[test]
fn other_dimensions_and_members_are_exported() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "so4-free", "four.mcap", &["/duration_s=null", "/steps=50", "/log/every=1"]);
    let four = columns(&vpd(at, &["export", "four.mcap"]).stdout);
    for name in ["attitude_4_4", "body_momentum_1_2", "body_momentum_3_4", "spatial_momentum_2_4"] {
        assert_eq!(four[name].len(), 51, "{name}");
    }
    assert!(!four.contains_key("quaternion_w") && !four.contains_key("body_momentum_4_4"));
    let many = r#"/ensemble={"members":5,"in_full":[3],"attitude_spread_rad":0.1,"seed":1}"#;
    run(at, "heavy-top", "many.mcap", &["/duration_s=0.1", many]);
    let third = columns(&vpd(at, &["export", "many.mcap", "--member", "3"]).stdout);
    let wanted = rows(&at.join("many.mcap"), 3);
    let first = |row: &Row| row.state.as_ref().map(|state| state.attitude[0].to_bits());
    assert_eq!(bits(&third["attitude_1_1"]), wanted.iter().map(first).collect::<Vec<_>>());
    assert!(wanted.len() > 3);
    let members = vpd(at, &["export", "many.mcap", "--channels", "/ensemble/members"]);
    let members = columns(&members.stdout);
    let mut numbers: Vec<_> = members["member"].iter().flatten().cloned().collect();
    numbers.sort();
    assert_eq!(numbers, ["0", "1", "2", "3", "4"]);
    assert!(members["outcome"].iter().all(|outcome| outcome.as_deref() == Some("succeeded")));
    let place = members["member"].iter().position(|member| member.as_deref() == Some("3"));
    let last = third["quaternion_w"].last().expect("a sample");
    // The last state of the member, with w >= 0.
    let (end, last) = (&members["quaternion_w"][place.expect("a member")], last);
    let size =
        |cell: &Option<String>| cell.as_ref().map(|cell| cell.trim_start_matches('-').to_owned());
    assert_eq!(size(end), size(last));
    let both = vpd(at, &["export", "many.mcap", "--channels", "/ensemble/members,/state"]);
    assert_eq!(both.status.code(), Some(2));
    assert!(text(&both.stderr).contains("alone"), "{}", text(&both.stderr));
    // Arrays are of samples.
    let members =
        vpd(at, &["export", "many.mcap", "-o", "x.npz", "--channels", "/ensemble/members"]);
    assert_eq!(members.status.code(), Some(2));
    assert!(text(&members.stderr).contains("/ensemble/members"), "{}", text(&members.stderr));
    let none = vpd(at, &["export", "many.mcap", "-o", "x.npz", "--member", "4"]);
    assert_eq!(none.status.code(), Some(2));
    let none = vpd(at, &["export", "many.mcap", "--member", "4"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(text(&none.stderr).contains("samples of member 4"), "{}", text(&none.stderr));
    // Times alone are no table.
    let none = vpd(at, &["export", "many.mcap", "--channels", "/pace"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(text(&none.stderr).contains("holds no /pace"), "{}", text(&none.stderr));
}

#[test]
fn a_table_replaces_nothing_and_its_format_is_known() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "heavy-top", "top.mcap", &["/duration_s=0.1"]);
    std::fs::write(at.join("x.csv"), "mine").expect("writable");
    let refused = vpd(at, &["export", "top.mcap", "-o", "x.csv"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("--force"), "{}", text(&refused.stderr));
    assert_eq!(std::fs::read(at.join("x.csv")).expect("kept"), b"mine");
    assert_eq!(vpd(at, &["export", "top.mcap", "-o", "x.csv", "--force"]).status.code(), Some(0));
    for (name, said) in [("x.xlsx", ".csv, .npz, .parquet or .arrow"), ("x", "not a format")] {
        let refused = vpd(at, &["export", "top.mcap", "-o", name]);
        assert_eq!(refused.status.code(), Some(2));
        assert!(text(&refused.stderr).contains(said), "{}", text(&refused.stderr));
        assert!(!at.join(name).exists());
    }
    // The contents of an unfinished log are exported, with a note that it is unfinished.
    let log = std::fs::read(at.join("top.mcap")).expect("a log");
    std::fs::write(at.join("cut.mcap"), &log[..log.len() - 100]).expect("writable");
    let cut = vpd(at, &["export", "cut.mcap"]);
    assert_eq!(cut.status.code(), Some(0), "{}", text(&cut.stderr));
    assert!(
        text(&cut.stderr).contains("everything before that is exported"),
        "{}",
        text(&cut.stderr)
    );
}

#[cfg(not(feature = "parquet"))]
#[test]
fn a_build_without_parquet_says_which_has_it() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "heavy-top", "top.mcap", &["/duration_s=0.1"]);
    for name in ["x.parquet", "x.arrow"] {
        let refused = vpd(at, &["export", "top.mcap", "-o", name]);
        assert_eq!(refused.status.code(), Some(2));
        assert!(text(&refused.stderr).contains("--features parquet"), "{}", text(&refused.stderr));
    }
}

#[cfg(feature = "parquet")]
#[test]
fn parquet_and_arrow_read_back_to_the_bit() {
    use arrow_array::RecordBatch;
    use arrow_array::cast::AsArray;
    use arrow_array::types::{Float64Type, UInt64Type};
    use std::fs::File;

    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    // There are more rows than one batch has.
    run(at, "heavy-top", "top.mcap", &["/duration_s=20", "/log/every=1"]);
    let table = columns(&vpd(at, &["export", "top.mcap"]).stdout);
    for name in ["top.parquet", "top.arrow"] {
        let exported = vpd(at, &["export", "top.mcap", "-o", name]);
        assert_eq!(exported.status.code(), Some(0), "{}", text(&exported.stderr));
    }
    let open = |name: &str| File::open(at.join(name)).expect("a table");
    let parquet =
        parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(open("top.parquet"));
    let parquet = parquet.and_then(|builder| builder.build()).expect("Parquet");
    let arrow = arrow_ipc::reader::FileReader::try_new(open("top.arrow"), None).expect("Arrow");
    let batches: [Vec<RecordBatch>; 2] = [
        parquet.map(|batch| batch.expect("rows")).collect(),
        arrow.map(|batch| batch.expect("rows")).collect(),
    ];
    for batches in batches {
        assert!(batches.len() > 1);
        let mut seen = 0;
        for (k, field) in batches[0].schema().fields().iter().enumerate() {
            let mut cells: Vec<Option<String>> = Vec::new();
            for batch in &batches {
                let column = batch.column(k);
                if let Some(numbers) = column.as_primitive_opt::<Float64Type>() {
                    cells.extend(numbers.iter().map(|x| x.map(|x| x.to_bits().to_string())));
                } else if let Some(counts) = column.as_primitive_opt::<UInt64Type>() {
                    cells.extend(counts.iter().map(|x| x.map(|x| x.to_string())));
                } else {
                    let words = column.as_string::<i32>().iter();
                    cells.extend(words.map(|word| word.map(str::to_owned)));
                }
            }
            let wanted = &table[field.name()];
            if batches[0].column(k).as_primitive_opt::<Float64Type>().is_some() {
                let wanted: Vec<_> =
                    bits(wanted).iter().map(|x| x.map(|x| x.to_string())).collect();
                assert_eq!(cells, wanted, "{}", field.name());
            } else {
                assert_eq!(&cells, wanted, "{}", field.name());
            }
            seen += 1;
        }
        assert_eq!(seen, table.len());
    }
}

#[test]
fn two_logs_are_compared() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    let short = ["/duration_s=2", "/log/every=10"];
    run(at, "heavy-top", "a.mcap", &short);
    run(at, "heavy-top", "same.mcap", &[&short[..], &["/name=other"]].concat());
    // The same times in twice as many samples.
    run(at, "heavy-top", "b.mcap", &["/duration_s=2", "/log/every=5", "/method/tableau=gauss1"]);
    let same = vpd(at, &["diff", "a.mcap", "same.mcap"]);
    assert_eq!(same.status.code(), Some(0), "{}", text(&same.stdout));
    assert!(text(&same.stdout).contains("they agree"));
    let diff = vpd(at, &["diff", "a.mcap", "b.mcap", "--json", "--rows", "7", "--chart", "d.svg"]);
    assert_eq!(diff.status.code(), Some(1), "{}", text(&diff.stderr));
    let found: Value = serde_json::from_slice(&diff.stdout).expect("JSON");
    assert_eq!((&found["samples"], &found["only_second"]), (&101.into(), &100.into()));
    // The expected difference, from the samples themselves.
    let angle = |a: &Row, b: &Row| {
        let (a, b) = (a.state.as_ref().expect("logged"), b.state.as_ref().expect("logged"));
        let cosine: f64 = a.quaternion.iter().zip(&b.quaternion).map(|(a, b)| a * b).sum();
        2.0 * cosine.abs().min(1.0).acos()
    };
    let (a, b) = (rows(&at.join("a.mcap"), 0), rows(&at.join("b.mcap"), 0));
    let wanted = a.iter().zip(b.iter().step_by(2)).map(|(a, b)| angle(a, b)).fold(0.0, f64::max);
    let of = |name: &str| {
        let largest = found["largest"].as_array().expect("a list");
        largest.iter().find(|one| one["quantity"] == name).expect(name)["largest"]
            .as_f64()
            .expect(name)
    };
    assert!(wanted > 1e-5 && (of("angle") - wanted).abs() < 1e-6 * wanted.max(1.0), "{wanted}");
    let energy = |row: &Row| row.energy.as_ref().expect("logged").total;
    let wanted = a.iter().zip(b.iter().step_by(2)).map(|(a, b)| (energy(a) - energy(b)).abs());
    assert_eq!(of("energy"), wanted.fold(0.0, f64::max));
    let over_time = found["over_time"].as_array().expect("rows");
    assert!(over_time.len() <= 7 && over_time.last().expect("a row")["time_s"] == 2.0);
    let most = over_time.iter().filter_map(|row| row["angle"].as_f64()).fold(0.0, f64::max);
    assert_eq!(most, of("angle"));
    let svg = std::fs::read_to_string(at.join("d.svg")).expect("a chart");
    assert!(svg.contains("angle in rad") && svg.contains("<polyline") && !svg.contains("NaN"));

    // Within a tolerance for everything; then beyond the one for the angle, which is said first.
    let wide = vpd(at, &["diff", "a.mcap", "b.mcap", "--tolerance", "10"]);
    assert_eq!(wide.status.code(), Some(0), "{}", text(&wide.stdout));
    let limit = format!("angle={}", 0.5 * of("angle"));
    let tight = vpd(at, &["diff", "a.mcap", "b.mcap", "--json", "--tolerance", &limit]);
    assert_eq!(tight.status.code(), Some(1));
    let tight: Value = serde_json::from_slice(&tight.stdout).expect("JSON");
    let first = &tight["first_beyond"];
    assert_eq!(first["quantity"], "angle");
    let pairs = a.iter().zip(b.iter().step_by(2));
    let wanted = pairs.clone().find(|(a, b)| angle(a, b) > 0.5 * of("angle"));
    let time_s = wanted.and_then(|(a, _)| Some(a.state.as_ref()?.time_s)).expect("beyond it");
    assert!((first["time_s"].as_f64().expect("a time") - time_s).abs() < 1e-9, "{first}");

    run(at, "so4-free", "four.mcap", &["/duration_s=null", "/steps=50"]);
    for (other, said) in [("four.mcap", "dimension"), ("d.svg", "is not a log"), ("none", "none")] {
        let refused = vpd(at, &["diff", "a.mcap", other]);
        assert_eq!(refused.status.code(), Some(2), "{}", text(&refused.stdout));
        assert!(text(&refused.stderr).contains(said), "{}", text(&refused.stderr));
    }
    for wrong in ["-1", "nan", "speed=1", "angle=x"] {
        let refused = vpd(at, &["diff", "a.mcap", "b.mcap", &format!("--tolerance={wrong}")]);
        assert_eq!(refused.status.code(), Some(2), "{wrong}");
    }
}

/// No log of ours holds a NaN; a forged one may, and programs take it for a large number or for none.
#[test]
fn no_table_holds_a_nan() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "heavy-top", "top.mcap", &["/duration_s=0.1", "/log/every=1"]);
    let (mut count, mut spoiled) = (0, 0);
    forge(&at.join("top.mcap"), &at.join("forged.mcap"), |message| {
        if message.channel.topic == "/energy" {
            let mut energy = Energy::decode(&*message.data).expect("an energy");
            if count == 3 {
                energy.error = f64::NAN;
                spoiled += 1;
            }
            message.data = energy.encode_to_vec().into();
            count += 1;
        }
    });
    assert_eq!(spoiled, 1);
    let exported = vpd(at, &["export", "forged.mcap"]);
    assert_eq!(exported.status.code(), Some(0), "{}", text(&exported.stderr));
    assert!(!text(&exported.stdout).contains("NaN"), "{}", text(&exported.stdout));
    let table = columns(&exported.stdout);
    let empty: Vec<usize> =
        (0..count).filter(|&row| table["energy_error"][row].is_none()).collect();
    assert_eq!(empty, [3]);
    assert!(table["energy_total"].iter().all(Option::is_some));
}

/// Zero is zero, whichever sign a writer gave it.
#[test]
fn the_sign_of_a_zero_is_no_difference() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let at = directory.path();
    run(at, "heavy-top", "top.mcap", &["/duration_s=0.1", "/log/every=1"]);
    let mut turned = 0;
    forge(&at.join("top.mcap"), &at.join("forged.mcap"), |message| {
        if message.channel.topic == "/state" {
            let mut state = State::decode(&*message.data).expect("a state");
            for x in state.attitude.iter_mut().chain(&mut state.body_momentum) {
                if *x == 0.0 {
                    *x = -*x;
                    turned += 1;
                }
            }
            message.data = state.encode_to_vec().into();
        }
    });
    assert!(turned > 0);
    let same = vpd(at, &["diff", "top.mcap", "forged.mcap"]);
    assert_eq!(same.status.code(), Some(0), "{}", text(&same.stdout));
}
