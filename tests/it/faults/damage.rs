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

/// Files of a corpus.
fn corpus(name: &str) -> Vec<Vec<u8>> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(name);
    let entries = fs::read_dir(corpus).expect("a corpus");
    entries.map(|entry| fs::read(entry.expect("an entry").path()).expect("a file")).collect()
}

#[test]
fn ranges_of_the_corpus_and_their_neighbours_give_the_whole_the_right_part_or_416() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let service = Service::start(folder.path(), &[]);
    let id = service.submit(&dipole(2_000));
    assert_eq!(service.ended(&id)["state"], "succeeded");
    let path = format!("/jobs/{id}/log.mcap");
    let whole = service.get(&path).body;
    let mut answers = [0; 3];
    for seed in corpus("range") {
        for k in 0..20 * scale() {
            let range = if k == 0 { seed.clone() } else { damage(&mut random, &seed) };
            // What no client sends; the fuzzer does.
            if !range.iter().all(|byte| (b' '..=b'~').contains(byte)) {
                continue;
            }
            let range = std::str::from_utf8(&range).expect("ASCII");
            let answer = service.try_send("GET", &path, &[("range", range)], None);
            let answer = answer.expect("an answer");
            match answer.status {
                200 => assert_eq!(answer.body, whole, "{range}"),
                206 => assert!(
                    whole.windows(answer.body.len().max(1)).any(|part| part == answer.body),
                    "{range}"
                ),
                416 => {}
                status => panic!("{range:?}: {status}"),
            }
            answers[usize::from(answer.status == 206) + 2 * usize::from(answer.status == 416)] += 1;
        }
    }
    println!("{} whole, {} parts, {} refused", answers[0], answers[1], answers[2]);
    assert!(answers[1] > 0 && answers[2] > 0);
}

#[test]
fn the_corpus_of_the_fuzzers_and_its_neighbours_are_read_without_a_panic() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let (mut taken, mut refused) = (0, 0);
    for text in corpus("scenario") {
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
    for bytes in corpus("log") {
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
