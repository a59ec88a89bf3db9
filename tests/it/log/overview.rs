//! A chart of a long log: from the overview at its end, with every extreme of the samples.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use vpd::advise;
use vpd::log::OVERVIEW_ATTACHMENTS;
use vpd::log::reader::{Message, read_samples};
use vpd::log::samples::{Curve, Samples, Window, read_course};
use vpd::run::{Control, JobContext, execute};
use vpd::scenario::Scenario;

fn course(log: &Path, curve: Curve, from_s: f64, to_s: f64, points: usize) -> Samples {
    let window = Window { from_s, to_s, points };
    let read = read_course(log, curve, window, &|_| Vec::new(), &|| false);
    read.expect("readable").expect("nobody stopped it")
}

#[test]
fn a_chart_of_a_long_log_is_drawn_from_its_overview_and_loses_no_extreme() {
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../../scenarios/dipole.json")).expect("shipped");
    scenario["steps"] = json!(150_000);
    scenario["log"] = json!({ "every": 1 });
    scenario.as_object_mut().expect("an object").remove("expect");
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
    let folder = tempfile::tempdir().expect("a folder");
    let log = folder.path().join("long.mcap");
    let plan = advise::plan(&scenario).expect("a plan");
    execute(&plan, &JobContext { log: &log, control: &Control::default() }).expect("a log");

    // Every sample of two quantities, as they stand in the log.
    let (mut errors, mut momenta) = (Vec::new(), Vec::new());
    let mut start_ns = None;
    read_samples(&log, |time_ns, message| {
        let since_s = (time_ns - *start_ns.get_or_insert(time_ns)) as f64 * 1e-9;
        match message {
            Message::Energy(energy) => errors.push((since_s, energy.error)),
            Message::State(state) => momenta.push((since_s, state.body_momentum[1])),
            _ => {}
        }
    })
    .expect("readable");
    assert_eq!((errors.len(), momenta.len()), (150_001, 150_001));

    let check = |log: &Path, from_s: f64, to_s: f64, points: usize| {
        let few = |curve| course(log, curve, from_s, to_s, points);
        let [energy, momentum] = [few(Curve::EnergyError), few(Curve::BodyMomentum)];
        for (found, line, samples) in [(&energy, 0, &errors), (&momentum, 1, &momenta)] {
            let count = found.time_s.len();
            assert!(count <= points && count > points / 2, "{count} of {points}");
            assert_eq!(found.end_s, Some(1500.0));
            // Each point has the extremes of just the samples from its time to the next.
            let mut seen = 0;
            for (k, &begin_s) in found.time_s.iter().enumerate() {
                let end_s = found.time_s.get(k + 1).copied().unwrap_or(f64::INFINITY);
                let behind =
                    samples.iter().filter(|(t, _)| *t <= to_s && *t < end_s && *t >= begin_s);
                let (mut low, mut high, mut number) = (f64::INFINITY, f64::NEG_INFINITY, 0);
                for (_, value) in behind {
                    (low, high, number) = (low.min(*value), high.max(*value), number + 1);
                }
                assert_eq!((found.low[line][k], found.high[line][k]), (low, high), "point {k}");
                assert!(number <= found.each, "{number} behind point {k}");
                seen += number;
            }
            let inside = samples.iter().filter(|(t, _)| *t >= from_s && *t <= to_s).count() as u64;
            assert_eq!(seen, inside, "from {from_s} to {to_s}");
        }
    };
    for (from_s, to_s, points) in [
        (0.0, f64::MAX, 800),
        (0.0, f64::MAX, 50),
        (100.005, 1400.0, 600),
        (700.0, 701.0, 90),
        (0.0, f64::MAX, 5000),
    ] {
        check(&log, from_s, to_s, points);
    }

    // If the samples are damaged the chart of the whole is unchanged: it reads none of them.
    let mut bytes = fs::read(&log).expect("a log");
    let summary = mcap::Summary::read(&bytes).expect("whole").expect("has a summary");
    assert!(summary.attachment_indexes.iter().any(|at| at.name.starts_with(OVERVIEW_ATTACHMENTS)));
    let [mut of_chunks, mut of_overview] = [0, 0];
    for chunk in &summary.chunk_indexes {
        let (from, length) = (chunk.chunk_start_offset as usize, chunk.chunk_length as usize);
        bytes[from + 64..from + length].fill(0);
        of_chunks += length;
    }
    for at in
        summary.attachment_indexes.iter().filter(|at| at.name.starts_with(OVERVIEW_ATTACHMENTS))
    {
        of_overview += at.length as usize;
    }
    assert!(of_overview * 25 < of_chunks, "{of_overview} bytes next to {of_chunks}");
    let holed = folder.path().join("holed.mcap");
    fs::write(&holed, &bytes).expect("written");
    check(&holed, 0.0, f64::MAX, 800);
    let window = Window { from_s: 0.0, to_s: f64::MAX, points: 5000 };
    let direct = read_course(&holed, Curve::EnergyError, window, &|_| Vec::new(), &|| false);
    assert!(direct.is_err(), "samples that are gone were found");
}
