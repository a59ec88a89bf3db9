//! A clock that is wrong: before 1970, and ahead by a year.

use std::path::Path;
use std::time::{Duration, Instant};

use chrono::{DateTime, Utc};
use serde_json::{Value, json};

use super::dipole;
use super::disk::Faults;
use super::process::{PATIENCE, Service};

const YEAR_S: i64 = 365 * 86_400;

fn said(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("stderr")).expect("the service's own log")
}

#[test]
fn a_clock_before_1970_is_told_and_ends_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    let service = faults.start(folder.path());
    let scenario = dipole(100_000);
    let digest = service.reference(&scenario);
    let id = service.submit(&scenario);
    let text = scenario.to_string();
    let refused = |service: &Service| {
        for _ in 0..20 {
            for (method, path, body) in
                [("GET", "/healthz", None), ("GET", "/jobs", None), ("POST", "/jobs", Some(&*text))]
            {
                let answer = service.send(method, path, body);
                assert_eq!((answer.status, answer.code().as_str()), (503, "clock_wrong"));
            }
        }
    };
    // In 1961 or so, and in the year 10026.
    for ahead_s in [-65 * YEAR_S, 8_000 * YEAR_S] {
        faults.set_clock(ahead_s);
        refused(&service);
    }
    faults.set_clock(0);
    // The job has gone on, whatever it met.
    let job = service.ended(&id);
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!(service.digest(&id), digest);
    // A job that ends in such a time has an end.
    let id = service.submit(&scenario);
    faults.set_clock(-65 * YEAR_S);
    let result = folder.path().join("data/jobs").join(&id).join("result.json");
    let begun = Instant::now();
    while !result.exists() {
        assert!(begun.elapsed() < PATIENCE, "the job does not end");
        std::thread::sleep(Duration::from_millis(5));
    }
    faults.set_clock(0);
    assert_eq!(service.ended(&id)["state"], "succeeded");
    assert!(service.terminate().0.success());

    faults.set_clock(-65 * YEAR_S);
    let service = faults.start(folder.path());
    refused(&service);
    faults.set_clock(0);
    assert_eq!(service.get("/jobs").json()["jobs"].as_array().map(Vec::len), Some(3));
    assert!(service.terminate().0.success());
    assert!(!said(folder.path()).contains("panicked"), "{}", said(folder.path()));
}

#[test]
fn jobs_and_studies_are_listed_as_they_came_whatever_the_clock_did() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    let small = dipole(100);
    let study = json!({ "kind": "precision", "scenario": dipole(100), "until_s": 0.5 }).to_string();
    let (mut jobs, mut studies) = (Vec::new(), Vec::new());
    // Each time a start, with a clock that is set once more while the service runs.
    for ahead_s in [0, YEAR_S, 0, -YEAR_S] {
        let service = faults.start(folder.path());
        for ahead_s in [YEAR_S, ahead_s] {
            faults.set_clock(ahead_s);
            jobs.push(service.submit(&small));
            let answer = service.send("POST", "/studies", Some(&study));
            assert_eq!(answer.status, 202, "{}", String::from_utf8_lossy(&answer.body));
            studies.push(answer.json()["id"].as_str().expect("an id").to_owned());
        }
        // A job says when it came by the clock of then.
        let created = service.job(&jobs[jobs.len() - 1])["created"].clone();
        let created: DateTime<Utc> = serde_json::from_value(created).expect("a time");
        let off_s = (created - Utc::now()).num_seconds() - ahead_s;
        assert!(off_s.abs() < 3600, "{created}");
        let listed = |path: &str, what: &str| -> Vec<Value> {
            let list = service.get(path).json();
            list[what].as_array().expect("a list").iter().map(|one| one["id"].clone()).collect()
        };
        let newest_first =
            |ids: &[String]| ids.iter().rev().map(|id| json!(id)).collect::<Vec<_>>();
        assert_eq!(listed("/jobs", "jobs"), newest_first(&jobs));
        assert_eq!(listed("/studies", "studies"), newest_first(&studies));
        assert!(service.terminate().0.success());
    }
}
