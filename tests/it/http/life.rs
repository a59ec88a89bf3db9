//! Stops, restarts and crashes: every accepted job is done, and done once.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;
use uuid::Uuid;
use vpd::serve::ServeError;

use super::{assert_whole_log, directory, long, names, record, sealed, service, short};

/// Writes the record of a process that died in its `attempts`-th run of a job.
fn crashed(data: &TempDir, attempts: u32) -> (String, PathBuf) {
    let id = Uuid::now_v7().to_string();
    let directory = record(data, &id);
    fs::create_dir_all(&directory).expect("a directory");
    fs::write(directory.join("scenario.json"), sealed(&short().to_string())).expect("written");
    for n in 1..=attempts {
        fs::write(directory.join(format!("attempt-{n}")), "").expect("written");
    }
    fs::write(directory.join("log.mcap.part"), "half a log").expect("written");
    (id, directory)
}

#[test]
fn jobs_survive_a_stop() {
    let data = directory();
    let server = service(&data).start();
    let ended = server.finished();
    let before = server.job(&ended);
    let log = server.get(&format!("/jobs/{ended}/log.mcap")).body;
    let interrupted = server.running();
    let waiting = server.submit(&short());
    let (result, took) = server.stop();
    result.expect("stops in order");
    assert!(took < Duration::from_secs(10), "took {took:?}");
    // An interruption is no crash.
    assert!(!names(&record(&data, &interrupted)).iter().any(|name| name.starts_with("attempt-")));
    assert!(!record(&data, &interrupted).join("result.json").exists());

    let server = service(&data).start();
    let mut after = server.job(&ended);
    for job in [&before, &after] {
        assert_eq!(job["state"], "succeeded");
    }
    // The links name the port, which has changed.
    after["links"] = before["links"].clone();
    assert_eq!(after, before);
    assert_eq!(server.get(&format!("/jobs/{ended}/log.mcap")).body, log);
    server.wait(&interrupted, "running");
    assert_eq!(server.job(&waiting)["state"], "queued");
    server.send("POST", &format!("/jobs/{interrupted}/cancel"), &[], Some(b""));
    server.wait(&interrupted, "cancelled");
    server.wait(&waiting, "succeeded");
}

#[test]
fn a_stop_under_load_takes_less_than_ten_seconds() {
    let data = directory();
    let server = service(&data).workers(2).start();
    let running = [server.running(), server.running()];
    let waiting: Vec<_> = (0..20).map(|_| server.submit(&long())).collect();
    // A client stops in the middle of its body.
    let mut idle = TcpStream::connect(server.address).expect("a connection");
    let head = "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n";
    write!(idle, "{head}Content-Length: 9\r\nExpect: 100-continue\r\n\r\n").expect("sent");
    let mut go_on = [0; 12];
    idle.read_exact(&mut go_on).expect("an answer");
    assert_eq!(&go_on, b"HTTP/1.1 100");
    let (result, took) = server.stop();
    result.expect("stops in order");
    assert!(took < Duration::from_secs(10), "took {took:?}");

    let server = service(&data).workers(2).start();
    for id in running {
        server.wait(&id, "running");
    }
    for id in waiting {
        assert_eq!(server.job(&id)["state"], "queued");
    }
}

#[test]
fn many_stops_do_not_count_as_crashes() {
    let data = directory();
    let mut id = None;
    for _ in 0..5 {
        let server = service(&data).start();
        let id = id.get_or_insert_with(|| server.running()).clone();
        assert_eq!(server.wait(&id, "running")["attempts"], 1);
        server.stop().0.expect("stops in order");
    }
}

#[test]
fn a_second_service_on_the_same_directory_is_refused() {
    let data = directory();
    let first = service(&data).start();
    let id = first.finished();
    let (refused, _) = service(&data).start().stop();
    assert!(matches!(refused, Err(ServeError::DataInUse { .. })), "{refused:?}");
    assert_eq!(first.job(&id)["state"], "succeeded");
    first.stop().0.expect("stops in order");
    service(&data).start().stop().0.expect("free again");
}

#[test]
fn a_job_whose_process_died_runs_again() {
    let data = directory();
    let (id, directory) = crashed(&data, 2);
    let server = service(&data).start();
    assert_eq!(server.wait(&id, "succeeded")["attempts"], 3);
    assert_whole_log(&server.get(&format!("/jobs/{id}/log.mcap")).body);
    let mut files = names(&directory);
    files.retain(|name| !name.starts_with("attempt-"));
    assert_eq!(files, ["log.mcap", "plan.json", "result.json", "scenario.json"]);
}

#[test]
fn a_job_is_not_blamed_for_the_end_of_its_process() {
    let data = directory();
    // The end of the process was not seen, so the job is not blamed.
    let (id, _) = crashed(&data, 30);
    let server = service(&data).start();
    assert_eq!(server.wait(&id, "succeeded")["attempts"], 31);
}

#[test]
fn a_cancellation_survives_a_crash() {
    let data = directory();
    let (id, directory) = crashed(&data, 1);
    fs::write(directory.join("cancel"), "").expect("written");
    let server = service(&data).start();
    server.wait(&id, "cancelled");
    // The samples of before are kept, in a log that can be read.
    assert_whole_log(&server.get(&format!("/jobs/{id}/log.mcap")).body);
}

#[test]
fn damage_in_the_record_harms_no_other_job() {
    let data = directory();
    let (torn, directory) = crashed(&data, 1);
    fs::write(directory.join("result.json"), "{\"name\": ").expect("written");
    let (unreadable, directory) = crashed(&data, 0);
    fs::write(directory.join("scenario.json"), "{\"name\": ").expect("written");
    let (half_forgotten, directory) = crashed(&data, 1);
    fs::remove_file(directory.join("scenario.json")).expect("removed");
    fs::create_dir_all(record(&data, "not-a-job")).expect("made");
    fs::write(record(&data, "not-a-job").join("kept"), "").expect("written");

    let server = service(&data).start();
    server.finished();
    assert_eq!(server.get("/jobs?state=failed").json()["jobs"].as_array().map(Vec::len), Some(2));
    assert_eq!(server.job(&unreadable)["diagnosis"]["code"], "record_damaged");
    let damaged = server.job(&torn);
    assert_eq!((&damaged["state"], &damaged["finished"]), (&"failed".into(), &Value::Null));
    assert_eq!(damaged["diagnosis"]["code"], "record_damaged");
    server.get(&format!("/jobs/{half_forgotten}")).problem(404, "unknown_job");
    // An entry that is not understood is reported, and left alone.
    assert_eq!(names(&directory), ["attempt-1", "log.mcap.part"]);
    assert!(server.get("/metrics").text().contains("vpd_set_aside_total 3"));
    assert!(record(&data, "not-a-job").join("kept").exists());
}

#[test]
fn a_start_needs_no_look_at_the_results() {
    let data = directory();
    let server = service(&data).start();
    let ids: Vec<_> = (0..3).map(|_| server.finished()).collect();
    server.stop().0.expect("stops in order");
    // If they were read, the jobs would have lost their names.
    for id in &ids {
        fs::write(record(&data, id).join("result.json"), "torn").expect("written");
    }
    let server = service(&data).start();
    let listed = server.get("/jobs?state=succeeded").json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(3));
    assert_eq!(listed["jobs"][0]["name"], "dipole");
    assert_eq!(server.job(&ids[0])["state"], "succeeded");
    assert_eq!(server.job(&ids[0])["diagnosis"]["code"], "record_damaged");
    assert_whole_log(&server.get(&format!("/jobs/{}/log.mcap", ids[0])).body);
    server.stop().0.expect("stops in order");

    // A damaged line is passed over, its job looked up.
    let index = data.path().join("data/index.jsonl");
    let text = fs::read_to_string(&index).expect("an index");
    let (before, after) = text.rsplit_once("dipole").expect("a name");
    fs::write(&index, format!("{before}DIPOLE{after}")).expect("written");
    let server = service(&data).start();
    let listed = server.get("/jobs?state=succeeded").json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(2));
}

#[test]
fn an_interrupted_job_goes_on_from_its_log() {
    let data = directory();
    let mut scenario = short();
    scenario["steps"] = 60_000.into();
    scenario["log"]["every"] = 1.into();
    let server = service(&data).start();
    let whole = server.submit(&scenario);
    server.wait(&whole, "succeeded");
    let whole = server.get(&format!("/jobs/{whole}/log.mcap")).body;
    let id = server.submit(&scenario);
    super::until("a checkpoint", || {
        let job = server.job(&id);
        (job["progress"]["durable_step"].as_u64() > Some(0)).then_some(())
    });
    server.stop().0.expect("stops in order");
    let ended = record(&data, &id).join("result.json").exists();
    let server = service(&data).start();
    let job = server.wait(&id, "succeeded");
    // On a machine that let the job end before the stop there was nothing to resume.
    assert!(ended || job["summary"]["resumed_step"].as_u64() > Some(0), "{job}");
    assert!(server.get(&format!("/jobs/{id}/log.mcap")).body == whole);
}

#[cfg(unix)]
#[test]
fn the_data_directory_is_private() {
    use std::os::unix::fs::PermissionsExt;
    let data = directory();
    let server = service(&data).start();
    server.finished();
    let mode = fs::metadata(data.path().join("data")).expect("a directory").permissions().mode();
    assert_eq!(mode & 0o777, 0o700);
}
