//! Damaged files of the store: every one is noticed, none harms another job.

use std::fs;
use std::path::Path;

use uuid::Uuid;
use vpd::log::inspect::inspect;
use vpd::plan::Plan;
use vpd::scenario::Scenario;

use super::process::Service;
use super::{Random, damage, dipole, scale};

#[test]
fn every_damaged_file_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let service = Service::start(folder.path(), &[]);
    let sound = service.submit(&dipole(20_000));
    assert_eq!(service.ended(&sound)["state"], "succeeded");
    let digest = service.digest(&sound);
    assert!(service.terminate().0.success());

    let jobs = folder.path().join("data/jobs");
    let file = |name: &str| fs::read(jobs.join(&sound).join(name)).expect("a file");
    let (scenario, result, log) = (file("scenario.json"), file("result.json"), file("log.mcap"));
    let count = 200 * scale();
    let make = |files: &[(&str, &[u8])]| {
        let id = Uuid::now_v7().to_string();
        fs::create_dir_all(jobs.join(&id)).expect("made");
        for (name, bytes) in files {
            fs::write(jobs.join(&id).join(name), bytes).expect("written");
        }
        id
    };
    let results: Vec<_> = (0..count)
        .map(|_| {
            let result = damage(&mut random, &result);
            make(&[
                ("scenario.json", &scenario),
                ("log.mcap", &log[..100]),
                ("result.json", &result),
            ])
        })
        .collect();
    let scenarios: Vec<_> =
        (0..count).map(|_| make(&[("scenario.json", &damage(&mut random, &scenario))])).collect();
    let index = folder.path().join("data/index.jsonl");
    fs::write(&index, damage(&mut random, &fs::read(&index).expect("an index"))).expect("written");

    let service = Service::start(folder.path(), &[]);
    for id in &results {
        let job = service.job(id);
        assert_eq!(job["diagnosis"]["code"], "record_damaged", "{job}");
    }
    for id in &scenarios {
        let job = service.job(id);
        assert_eq!(
            (&job["state"], &job["diagnosis"]["code"]),
            (&"failed".into(), &"storage_error".into()),
            "{job}"
        );
    }
    assert_eq!(service.job(&sound)["state"], "succeeded");
    assert_eq!(service.digest(&sound), digest);
    assert_eq!(service.reference(&dipole(20_000)), digest);

    let damaged = folder.path().join("damaged.mcap");
    for _ in 0..count {
        fs::write(&damaged, damage(&mut random, &log)).expect("written");
        let found = inspect(&damaged).expect("readable");
        assert!(!found.finished && found.damage.is_some(), "{found}");
    }
    println!("{} damaged files, all reported", 3 * count);
}

#[test]
fn the_corpus_of_the_fuzzers_and_its_neighbours_are_read_without_a_panic() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let files = |name: &str| -> Vec<Vec<u8>> {
        let entries = fs::read_dir(corpus.join(name)).expect("a corpus");
        entries.map(|entry| fs::read(entry.expect("an entry").path()).expect("a file")).collect()
    };
    let (mut taken, mut refused) = (0, 0);
    for text in files("scenario") {
        Scenario::from_json(&text).expect("the corpus begins with good ones");
        for _ in 0..200 * scale() {
            match Scenario::from_json(&damage(&mut random, &text)) {
                Ok(scenario) => {
                    // What can be read can be planned, or is refused with its field.
                    let _ = Plan::new(&scenario);
                    assert_eq!(
                        Scenario::from_json(&scenario.to_json()).expect("read back"),
                        scenario
                    );
                    taken += 1;
                }
                Err(_) => refused += 1,
            }
        }
    }
    let part = folder.path().join("log.mcap.part");
    for bytes in files("log") {
        fs::write(&part, &bytes).expect("written");
        assert!(inspect(&part).expect("readable").finished);
        for _ in 0..100 * scale() {
            fs::write(&part, damage(&mut random, &bytes)).expect("written");
            assert!(!inspect(&part).expect("readable").finished);
        }
    }
    println!("scenarios: {taken} taken, {refused} refused");
    assert!(taken > 0 && refused > 0);
}
