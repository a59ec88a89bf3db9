//! `kill -9` and `kill -TERM` at random moments.

use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use vpd::log::inspect::inspect;
use vpd::log::reader::{Message, read_samples};
use vpd::log::resume::last_checkpoint;

use super::disk::Faults;
use super::process::Service;
use super::{Random, dipole, heavy, pendulum, scale};

#[test]
fn nothing_that_was_accepted_is_lost_to_kills() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let scenarios: Vec<Value> = [40_000, 80_000, 120_000].into_iter().map(dipole).collect();
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
    // Only the reference jobs are left.
    assert_eq!(left.len(), scenarios.len(), "{left:?}");
}

/// Jobs of steps that take long, jobs that look for a method, and studies are not blamed for a kill
/// from outside.
#[test]
fn kills_from_outside_convict_nobody() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let start = || Service::start(folder.path(), &["--workers", "2"]);
    let mut service = start();
    let mut slow = heavy(16, 60, 300);
    slow["log"] = serde_json::json!({ "every": 1, "channels": ["/state"] });
    let reference = service.reference(&slow);
    let accurate = pendulum(1e-8, 30.0);
    let settled = service.reference(&accurate);
    let study = serde_json::json!({
        "kind": "precision", "scenario": dipole(10), "methods": [{"name": "vpd", "tableau": "gauss2"}]
    });
    let kills = 20 * scale();
    let (mut jobs, mut studies) = (Vec::new(), Vec::new());
    for kill in 0..kills {
        if kill % 4 == 0 {
            jobs.push((service.submit(&slow), &reference));
            jobs.push((service.submit(&accurate), &settled));
        }
        if kill % 10 == 0 {
            let answer = service.send("POST", "/studies", Some(&study.to_string()));
            studies.push(answer.json()["id"].as_str().expect("an id").to_owned());
        }
        // Most runs are too short for any job to come further; scaled up as in the field: 0.3 to 8
        // s.
        let longest = if scale() > 1 { 8_000 } else { 400 };
        std::thread::sleep(Duration::from_millis(50 + random.below(longest) as u64));
        service.kill();
        service = start();
    }
    let mut apart = 0;
    for (id, digest) in &jobs {
        let job = service.ended(id);
        assert_eq!(job["state"], "succeeded", "{job}");
        assert_eq!(service.digest(id), **digest, "{job}");
        apart += usize::from(job["attempts"].as_u64() > Some(1));
    }
    for id in &studies {
        let study = service.study(id);
        assert_eq!(study["state"], "succeeded", "{study}");
    }
    println!(
        "{kills} kills: {} jobs and {} studies done, {apart} of the jobs in a process of their own",
        jobs.len(),
        studies.len()
    );
    assert!(apart > 0, "the kills came at the wrong moments");
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

/// A service that can be reached stops in order on a signal: its handler is in place by then.
#[test]
fn a_stop_is_clean_from_the_first_connection() {
    let folder = tempfile::tempdir().expect("a folder");
    for _ in 0..20 {
        let (status, _) = Service::start(folder.path(), &[]).terminate();
        assert!(status.success(), "{status}");
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

/// Submits a job that ends its process within its first chunk, next to others, until it is
/// abandoned; returns how many processes it ended. Ending its log ends a process, too, unless
/// `can_end`.
fn poison(can_end: bool) -> Option<i64> {
    let folder = tempfile::tempdir().expect("a folder");
    let mut faults = Faults::new(folder.path())?;
    // Queued behind two runs that last until they are cancelled, so that its id is known before it begins.
    let mut blocker = dipole(100_000_000);
    blocker["name"] = "blocker".into();
    blocker["log"]["every"] = 1_000_000.into();
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
    // First the service itself: at the creation of the log, its head, its first chunk. Then
    // processes of its own until it is abandoned, and two that try to end its log.
    let more = 3 + if can_end { 0 } else { 2 };
    faults.arm(3, -1, more);
    let status = faults.start_on(folder.path(), &part).dies();
    assert!(!status.success());
    assert_eq!(faults.given(), 1, "it died of something else: {status}");
    let service = faults.start_on(folder.path(), &part);
    let job = service.ended(&poison);
    assert_eq!(job["diagnosis"]["code"], "worker_crashed", "{job}");
    assert_eq!(faults.given(), 1 + more);
    for id in &innocents {
        assert_eq!(service.ended(id)["state"], "succeeded");
    }
    let log = service.get(&format!("/jobs/{poison}/log.mcap"));
    assert_eq!(log.status, if can_end { 200 } else { 404 });
    if can_end {
        let (samples, step) = abandoned(&folder.path().join("log.mcap"), &log.body);
        assert_eq!((samples.len(), step), (0, None));
    }
    for path in ["attitudes.json", "charts/energy.svg"] {
        assert!(service.get(&format!("/jobs/{poison}/{path}")).status < 500, "{path}");
    }
    Some(faults.given())
}

/// Returns the samples of the log of a job that was abandoned, and the step of its last checkpoint.
fn abandoned(path: &Path, log: &[u8]) -> (Vec<(u64, Message)>, Option<u64>) {
    std::fs::write(path, log).expect("written");
    let mut samples = Vec::new();
    let ending = read_samples(path, |time_ns, sample| samples.push((time_ns, sample)));
    assert!(ending.expect("readable").finished);
    let found = inspect(path).expect("readable");
    let outcome = found.outcome.as_ref().expect("an outcome");
    assert_eq!((outcome["state"].as_str(), outcome["code"].as_str()), ("failed", "worker_crashed"));
    assert!(outcome["diagnosis"].contains("the process ended"), "{found}");
    assert!(found.job.as_ref().is_some_and(|job| job.contains_key("scenario")), "{found}");
    assert_eq!(outcome["steps"], found.resumes_at_step.unwrap_or(0).to_string());
    (samples, found.resumes_at_step)
}

#[test]
fn a_job_that_aborts_its_process_is_abandoned_and_the_others_go_on() {
    if let Some(deaths) = poison(true) {
        println!("abandoned after {deaths} processes, with a log; 8 others done");
    }
}

#[test]
fn a_job_whose_log_can_have_no_end_is_abandoned_without() {
    if let Some(deaths) = poison(false) {
        println!("abandoned after {deaths} processes, without a log; 8 others done");
    }
}

#[test]
fn a_job_that_is_abandoned_keeps_the_chunks_it_had() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    // Long enough to be still running when it is killed, on a machine under load, too.
    let scenario = dipole(600_000);
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let whole = service.submit(&scenario);
    assert_eq!(service.ended(&whole)["state"], "succeeded");
    let whole = service.get(&format!("/jobs/{whole}/log.mcap")).body;
    let poison = service.submit(&scenario);
    while service.job(&poison)["progress"]["durable_step"] == 0 {
        std::thread::sleep(Duration::from_millis(1));
    }
    service.kill();
    let part = folder.path().join("data/jobs").join(&poison).join("log.mcap.part");
    // Cut behind the last whole chunk, synced: the third change is within the next chunk. After it each process ends
    // where it resumes the log.
    faults.arm(3, -1, 3);
    let service = faults.start_on(folder.path(), &part);
    let job = service.ended(&poison);
    assert_eq!(
        (&job["state"], &job["diagnosis"]["code"]),
        (&"failed".into(), &"worker_crashed".into())
    );
    let log = service.get(&format!("/jobs/{poison}/log.mcap"));
    assert_eq!(log.status, 200);
    let (kept, step) = abandoned(&folder.path().join("log.mcap"), &log.body);
    assert_eq!(job["summary"]["steps"].as_u64(), step);
    assert_eq!(job["progress"]["steps_done"].as_u64(), step);
    std::fs::write(folder.path().join("whole.mcap"), whole).expect("written");
    let mut all = Vec::new();
    let read = read_samples(&folder.path().join("whole.mcap"), |time_ns, sample| {
        all.push((time_ns, sample))
    });
    assert!(read.expect("readable").finished);
    println!("{} of {} messages kept, up to step {step:?}", kept.len(), all.len());
    assert!(!kept.is_empty() && kept.len() < all.len() && kept[..] == all[..kept.len()]);
}
