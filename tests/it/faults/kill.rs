//! `kill -9` and `kill -TERM` at random moments.

use std::time::Duration;

use serde_json::Value;
use vpd::log::resume::last_checkpoint;

use super::disk::Faults;
use super::process::Service;
use super::{Random, dipole, scale};

#[test]
fn nothing_that_was_accepted_is_lost_to_kills() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let scenarios: Vec<Value> = [20_000, 40_000, 60_000].into_iter().map(dipole).collect();
    let mut service = Service::start(folder.path(), &["--workers", "2"]);
    let references: Vec<_> = scenarios.iter().map(|scenario| service.reference(scenario)).collect();
    let mut open: Vec<(String, usize)> = Vec::new();
    let (mut accepted, mut done, mut caught, mut resumed) = (0, 0, 0, 0);
    let kills = 50 * scale();
    for kill in 0..kills {
        // A client that does not get its answer asks again under the same key.
        let kind = random.below(scenarios.len());
        let key = format!("job {kill}");
        let headers = [("content-type", "application/json"), ("idempotency-key", key.as_str())];
        let text = scenarios[kind].to_string();
        let pause = Duration::from_micros(random.below(300_000) as u64);
        let early = random.below(4) == 0;
        let answer = std::thread::scope(|scope| {
            let client = scope.spawn(|| service.try_send("POST", "/jobs", &headers, Some(&text)));
            if !early {
                let answer = client.join().expect("no panic");
                std::thread::sleep(pause);
                return answer;
            }
            std::thread::sleep(pause / 100);
            None
        });
        let seen: Vec<(String, u64)> = open
            .iter()
            .filter_map(|(id, _)| {
                let job = service.try_send("GET", &format!("/jobs/{id}"), &[], None)?.json();
                let durable_step = job["progress"]["durable_step"].as_u64()?;
                (job["state"] == "running").then(|| (id.clone(), durable_step))
            })
            .collect();
        service.kill();
        caught += usize::from(!seen.is_empty());
        let data = folder.path().join("data/jobs");
        for (id, durable_step) in seen {
            let log = data.join(&id).join("log.mcap");
            let found = last_checkpoint(&log).expect("readable");
            assert!(
                log.exists() || found >= Some(durable_step).filter(|step| *step > 0),
                "{id}: {durable_step} was promised, {found:?} is there"
            );
        }

        service = Service::start(folder.path(), &["--workers", "2"]);
        let id = match answer {
            Some(answer) => answer.json()["id"].as_str().expect("an id").to_owned(),
            None => {
                let again = service.try_send("POST", "/jobs", &headers, Some(&text));
                again.expect("an answer").json()["id"].as_str().expect("an id").to_owned()
            }
        };
        accepted += 1;
        open.push((id, kind));
        if open.len() > 6 || kill + 1 == kills {
            let keep = if kill + 1 == kills { 0 } else { 3 };
            for (id, kind) in open.drain(..open.len() - keep) {
                let job = service.ended(&id);
                assert_eq!(job["state"], "succeeded", "{job}");
                assert_eq!(service.digest(&id), references[kind], "{job}");
                resumed += usize::from(job["summary"]["resumed_step"].as_u64() > Some(0));
                done += 1;
                assert_eq!(service.send("DELETE", &format!("/jobs/{id}"), None).status, 204);
            }
        }
    }
    println!(
        "{kills} kills, {caught} with a job running: {accepted} jobs accepted, {done} done, {resumed} resumed"
    );
    assert_eq!(done, accepted);
    assert!(caught > kills / 4 && resumed > 0, "the kills came at the wrong moments");
    let left: Vec<_> =
        std::fs::read_dir(folder.path().join("data/jobs")).expect("a folder").collect();
    // The references alone.
    assert_eq!(left.len(), scenarios.len(), "{left:?}");
}

#[test]
fn a_stop_is_clean() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let scenario = dipole(400_000);
    let mut ids = Vec::new();
    let mut longest = Duration::ZERO;
    for _ in 0..5 * scale() {
        let service = Service::start(folder.path(), &["--workers", "2"]);
        ids.push(service.submit(&scenario));
        std::thread::sleep(Duration::from_millis(random.below(200) as u64));
        let (status, took) = service.terminate();
        assert!(status.success(), "{status}");
        longest = longest.max(took);
    }
    println!("{} stops, {longest:?} at most", ids.len());
    let service = Service::start(folder.path(), &["--workers", "2"]);
    for id in &ids {
        let job = service.job(id);
        assert!(
            ["queued", "running", "succeeded"].contains(&job["state"].as_str().expect("a state"))
        );
    }
}

#[test]
fn any_number_of_workers_gives_the_same_bytes() {
    let scenarios: Vec<Value> = [5_000, 10_000, 20_000].into_iter().map(dipole).collect();
    let mut digests: Vec<Vec<String>> = vec![Vec::new(); scenarios.len()];
    for workers in ["1", "2", "4"] {
        let folder = tempfile::tempdir().expect("a folder");
        let service = Service::start(folder.path(), &["--workers", workers]);
        let ids: Vec<Vec<String>> = (0..3)
            .map(|_| scenarios.iter().map(|scenario| service.submit(scenario)).collect())
            .collect();
        for ids in ids {
            for (kind, id) in ids.iter().enumerate() {
                assert_eq!(service.ended(id)["state"], "succeeded");
                digests[kind].push(service.digest(id));
            }
        }
    }
    for digests in digests {
        println!("{} runs: {}", digests.len(), digests[0]);
        assert!(digests.iter().all(|digest| *digest == digests[0]), "{digests:?}");
    }
}

#[test]
fn a_job_that_aborts_its_process_is_given_up_and_the_others_go_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    // Queued behind two long runs, so that its id is known before it begins.
    let mut blocker = dipole(300_000);
    blocker["name"] = "blocker".into();
    let service = Service::start(folder.path(), &["--workers", "2"]);
    let blockers = [service.submit(&blocker), service.submit(&blocker)];
    let poison = service.submit(&dipole(20_000));
    let innocents: Vec<_> = (0..8).map(|_| service.submit(&dipole(5_000))).collect();
    assert!(service.terminate().0.success());
    for id in &blockers {
        std::fs::write(folder.path().join("data/jobs").join(id).join("cancel"), "")
            .expect("written");
    }
    let part = folder.path().join("data/jobs").join(&poison).join("log.mcap.part");
    let mut deaths = 0;
    loop {
        // The first two changes of a new file are its birth and its head; the fourth is within its first chunk.
        let _ = std::fs::remove_file(&part);
        faults.arm(4, -1, false);
        let before = faults.given();
        let service = faults.start_on(folder.path(), &part);
        if deaths == 3 {
            let job = service.ended(&poison);
            assert_eq!(job["diagnosis"]["code"], "worker_crashed", "{job}");
            for id in &innocents {
                assert_eq!(service.ended(id)["state"], "succeeded");
            }
            assert_eq!(faults.given(), before);
            break;
        }
        let status = service.dies();
        assert!(!status.success());
        assert_eq!(faults.given(), before + 1, "it died of something else: {status}");
        deaths += 1;
    }
    println!("given up after {deaths} deaths; {} others done", innocents.len());
}
