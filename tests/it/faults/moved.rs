//! A data directory that is renamed under a running service, or that is none.

use std::fs;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::dipole;
use super::process::{PATIENCE, Service};

#[test]
fn a_service_whose_data_directory_is_renamed_writes_nowhere_else_and_goes_on_when_it_is_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1"]);
    // Long enough to be still running when the directory goes away, on a machine under load, too.
    let scenario = dipole(500_000);
    let digest = service.reference(&scenario);
    let (running, waiting) = (service.submit(&scenario), service.submit(&scenario));
    let cancelled = service.submit(&scenario);
    let [name, elsewhere] = ["data", "elsewhere"].map(|name| folder.path().join(name));
    fs::rename(&name, &elsewhere).expect("renamed");

    let other = Service::start(folder.path(), &["--workers", "1"]);
    let own = other.submit(&dipole(100));
    assert_eq!(other.ended(&own)["state"], "succeeded");
    let refused = |method: &str, path: &str, body: Option<&str>| {
        let answer = service.send(method, path, body);
        assert_eq!((answer.status, answer.code().as_str()), (503, "storage_moved"), "{path}");
    };
    let text = scenario.to_string();
    refused("GET", "/readyz", None);
    refused("POST", "/jobs", Some(&text));
    refused("POST", "/studies", Some(&format!(r#"{{"kind":"long_term","scenario":{text}}}"#)));
    refused("POST", &format!("/jobs/{cancelled}/cancel"), Some(""));
    refused("DELETE", &format!("/jobs/{cancelled}"), None);
    // A run that comes to its end has nowhere to say so.
    let begun = Instant::now();
    while service.job(&running)["trouble"]["code"] != "storage_moved" {
        let job = service.job(&running);
        assert!(begun.elapsed() < PATIENCE && job["state"] != "failed", "{job}");
        std::thread::sleep(Duration::from_millis(5));
    }
    let jobs = |of: &std::path::Path| {
        let entries = fs::read_dir(of.join("jobs")).expect("jobs");
        entries.map(|entry| entry.expect("an entry").file_name()).collect::<Vec<_>>()
    };
    assert_eq!(jobs(&name), [own.as_str()]);
    assert_eq!(jobs(&elsewhere).len(), 4);
    other.kill();

    fs::remove_dir_all(&name).expect("removed");
    fs::rename(&elsewhere, &name).expect("renamed");
    assert_eq!(service.get("/readyz").status, 200);
    for id in [&running, &waiting, &cancelled] {
        let job = service.ended(id);
        assert_eq!(job["state"], "succeeded", "{job}");
        assert_eq!(service.digest(id), digest);
    }
    assert!(service.terminate().0.success());
}

/// The directory goes away between a run's last step and its result, while the log is read through.
#[test]
fn a_result_that_is_not_published_yet_when_the_data_directory_is_renamed_is_when_it_is_back() {
    const TRIES: usize = 10;
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let scenario = dipole(1_000_000);
    let [name, elsewhere] = ["data", "elsewhere"].map(|name| folder.path().join(name));
    let met = (0..TRIES).any(|_| {
        let id = service.submit(&scenario);
        loop {
            let job = service.job(&id);
            let is_made = job["progress"]["steps_done"] == job["progress"]["steps"];
            if is_made || job["state"] == "succeeded" {
                break;
            }
        }
        fs::rename(&name, &elsewhere).expect("renamed");
        let begun = Instant::now();
        let job = loop {
            let job = service.job(&id);
            if job["state"] != "running" {
                break job;
            }
            assert!(begun.elapsed() < PATIENCE, "{job}");
            std::thread::sleep(Duration::from_millis(1));
        };
        fs::rename(&elsewhere, &name).expect("renamed");
        assert_eq!(service.ended(&id)["state"], "succeeded", "{job}");
        job["trouble"]["code"] == "storage_moved"
    });
    assert!(met, "{TRIES} results were published before the directory went away");
    assert!(service.terminate().0.success());
}

/// A name that is no directory is refused, with the cause, and not waited for.
#[cfg(unix)]
#[test]
fn what_is_no_directory_is_refused_as_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let [pipe, file, socket] = ["pipe", "file", "socket"].map(|name| folder.path().join(name));
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    fs::write(&file, "").expect("written");
    let _socket = std::os::unix::net::UnixListener::bind(&socket).expect("a socket");
    for data in [&pipe, &file, &socket] {
        let mut service = Command::new(env!("CARGO_BIN_EXE_vpd"))
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(data)
            .stderr(Stdio::piped())
            .spawn()
            .expect("the binary starts");
        let begun = Instant::now();
        while service.try_wait().expect("a child").is_none() {
            if begun.elapsed() > PATIENCE {
                let _ = service.kill();
                panic!("{} is waited for", data.display());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let ended = service.wait_with_output().expect("a child");
        let said = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(2), "{said}");
        let data = data.display();
        let wanted = format!("cannot use the data directory {data}: Not a directory");
        assert!(said.contains(&wanted), "{said}");
    }
}
