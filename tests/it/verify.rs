//! A log is verified by running its job again.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use mcap::records::Record;
use vpd::advise;
use vpd::log::inspect::inspect;
use vpd::run::{Control, JobContext, execute};
use vpd::scenario::{Accuracy, Method, Scenario};
use vpd::verify::{VerifyError, verify};

use crate::log::NAMED;

/// Returns the dipole with some of its text replaced, and without its expectations.
fn dipole(steps: u64) -> Scenario {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/dipole.json");
    let mut scenario = Scenario::from_json(&fs::read(path).expect("a scenario")).expect("accepted");
    scenario.steps = Some(steps);
    scenario.expect = None;
    scenario
}

fn log(scenario: &Scenario, at: &Path, control: &Control) -> PathBuf {
    let log = at.join("log.mcap");
    execute(&advise::plan(scenario).expect("a plan"), &JobContext { log: &log, control })
        .expect("a log");
    log
}

/// Returns the number of messages of a log of the dipole, all but its words.
fn messages(log: &Path, samples: u64) -> u64 {
    let mut topics = inspect(log).expect("readable").topics;
    topics.retain(|entry| entry.topic != "/log");
    let named = topics.iter().filter(|entry| NAMED.contains(&entry.topic.as_str()));
    // Samples on six channels, all but one of /solver, and two drawings.
    assert_eq!(named.map(|entry| entry.messages).sum::<u64>(), samples * 6 - 1 + 2);
    topics.iter().map(|entry| entry.messages).sum()
}

#[test]
fn a_log_is_what_its_job_gives_again() {
    let place = tempfile::tempdir().expect("a directory");
    let log = log(&dipole(2000), place.path(), &Control::default());
    let verification = verify(&log).expect("verified");
    assert!(verification.same, "{verification}");
    assert_eq!(verification.messages, messages(&log, 201));
}

/// Scenes that change with time, or have torques or wheels, run again to the same bytes, with any
/// method.
#[test]
fn so_is_the_log_of_a_scene_that_is_driven() {
    for method in ["vpd", "vpd_lagrangian", "vrkmk", "rkmk", "rk_projected"] {
        for name in ["satellite-elliptic", "dual-spin"] {
            let place = tempfile::tempdir().expect("a directory");
            let path = format!("{}/scenarios/{name}.json", env!("CARGO_MANIFEST_DIR"));
            let mut scenario: serde_json::Value =
                serde_json::from_slice(&fs::read(path).expect("a scenario")).expect("JSON");
            let fields = scenario.as_object_mut().expect("an object");
            fields.insert("method".into(), serde_json::json!({ "name": method }));
            fields.insert("duration_s".into(), serde_json::json!(100));
            let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("accepted");
            let log = log(&scenario, place.path(), &Control::default());
            let verification = verify(&log).expect("verified");
            assert!(verification.same, "{name}, {method}: {verification}");
        }
    }
}

#[test]
fn so_is_the_log_of_a_cancelled_job() {
    let place = tempfile::tempdir().expect("a directory");
    let control = Control::default();
    let scenario = dipole(1_000_000_000);
    let log = std::thread::scope(|scope| {
        let worker = scope.spawn(|| log(&scenario, place.path(), &control));
        while control.steps_done.load(Ordering::Relaxed) < 100 {
            std::thread::yield_now();
        }
        control.cancelled.store(true, Ordering::Relaxed);
        worker.join().expect("no panic")
    });
    let verification = verify(&log).expect("verified");
    assert!(verification.same && verification.state == "cancelled", "{verification}");
}

#[test]
fn and_of_one_that_chose_its_own_step() {
    let place = tempfile::tempdir().expect("a directory");
    let mut scenario = dipole(0);
    (scenario.steps, scenario.duration_s) = (None, Some(5.0));
    (scenario.step_s, scenario.accuracy) =
        (None, Some(Accuracy { error: 1e-6, symplectic: false }));
    (scenario.method, scenario.log.every) = (Method::default(), Some(1));
    let control = Control { cancelled_at: Some(7), ..Control::default() };
    let log = log(&scenario, place.path(), &control);
    let verification = verify(&log).expect("verified");
    assert!(verification.same && verification.state == "cancelled", "{verification}");
    assert_eq!(verification.messages, messages(&log, 8));
}

/// Copies a log with its messages changed, every checksum right.
pub(crate) fn forge(log: &Path, forged: &Path, mut change: impl FnMut(&mut mcap::Message<'_>)) {
    let bytes = fs::read(log).expect("bytes");
    let mut out = mcap::Writer::new(fs::File::create(forged).expect("a file")).expect("a writer");
    let mut outcome = None;
    for record in mcap::read::LinearReader::new(&bytes).expect("a log") {
        match record.expect("a record") {
            Record::Metadata(metadata) if metadata.name == "vpd.outcome" => {
                outcome = Some(metadata)
            }
            Record::Metadata(metadata) => out.write_metadata(&metadata).expect("written"),
            Record::Attachment { header, data, .. } => {
                let attachment = mcap::Attachment {
                    log_time: header.log_time,
                    create_time: header.create_time,
                    name: header.name,
                    media_type: header.media_type,
                    data,
                };
                out.attach(&attachment).expect("written");
            }
            Record::DataEnd(_) => break,
            _ => {}
        }
    }
    for message in mcap::MessageStream::new(&bytes).expect("a log") {
        let mut message = message.expect("a message");
        change(&mut message);
        out.write(&message).expect("written");
    }
    out.write_metadata(&outcome.expect("an outcome")).expect("written");
    out.finish().expect("finished");
}

#[test]
fn one_bit_is_found() {
    let place = tempfile::tempdir().expect("a directory");
    let log = log(&dipole(200), place.path(), &Control::default());
    let forged = place.path().join("forged.mcap");
    forge(&log, &forged, |message| {
        if message.channel.topic == "/state" && message.sequence == 12 {
            let data = message.data.to_mut();
            let last = data.len() - 1;
            data[last] ^= 1;
        }
    });
    let verification = verify(&forged).expect("verified");
    let difference = verification.difference.expect("a difference");
    assert_eq!((difference.topic.as_str(), difference.what), ("/state", "content"));
    // Samples are counted from 0, one every 0.1 s.
    assert!((difference.time_s - 1.2).abs() < 0.11, "{difference:?}");
    assert!(!verification.same);
}

#[test]
fn an_unfinished_log_is_not_verified() {
    let place = tempfile::tempdir().expect("a directory");
    let log = log(&dipole(200), place.path(), &Control::default());
    let bytes = fs::read(&log).expect("bytes");
    fs::write(&log, &bytes[..bytes.len() / 2]).expect("written");
    assert!(matches!(verify(&log), Err(VerifyError::Unfinished { .. })));
}
