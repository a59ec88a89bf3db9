//! Disks that are full or fail: each change of a file in turn, and a real file system without room.

use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;

use super::process::Service;
use super::{dipole, scale};

/// The shim that makes calls fail, and the file that controls it.
pub(super) struct Faults {
    library: PathBuf,
    plan: File,
    place: PathBuf,
}

impl Faults {
    /// Returns `None`, with a message, where there is no C compiler or no preloading.
    pub(super) fn new(folder: &Path) -> Option<Self> {
        let library = folder.join("inject.so");
        let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/faults/inject.c");
        let compiler = std::env::var("CC").unwrap_or_else(|_| "cc".to_owned());
        let built = Command::new(compiler)
            .args(["-shared", "-fPIC", "-O1", "-o"])
            .arg(&library)
            .args([source, "-ldl"])
            .status();
        if !cfg!(target_os = "linux") || !built.is_ok_and(|status| status.success()) {
            println!("SKIPPED: faults are injected with a C compiler on Linux");
            return None;
        }
        let place = folder.join("plan");
        fs::write(&place, [0; 48]).expect("written");
        let plan = File::options().read(true).write(true).open(&place).expect("a file");
        Some(Self { library, plan, place })
    }

    pub(super) fn start(&self, folder: &Path) -> Service {
        self.start_on(folder, &folder.join("data"))
    }

    /// Starts a service with faults for the files whose paths begin with `folder`.
    pub(super) fn start_on(&self, folder: &Path, data: &Path) -> Service {
        let environment = [
            ("LD_PRELOAD", self.library.as_path()),
            ("VPD_FAULTS", &self.place),
            ("VPD_FAULTS_DIR", data),
        ];
        Service::start_with(folder, &["--workers", "2"], &environment)
    }

    /// Lets the `nth` call from now fail, and `more` after it.
    pub(super) fn arm(&mut self, nth: i64, errno: i64, more: i64) {
        let [_, _, _, fired, ..] = self.read();
        // The countdown is written last: it arms the fault.
        for (slot, value) in [(1, errno), (2, more), (3, fired), (4, 0), (0, nth)] {
            self.write(slot, value);
        }
    }

    /// Sets the time of day that the processes see ahead by `ahead_s`, or back if it is negative.
    pub(super) fn set_clock(&mut self, ahead_s: i64) {
        self.write(5, ahead_s);
    }

    fn write(&mut self, slot: u64, value: i64) {
        self.plan.seek(SeekFrom::Start(8 * slot)).expect("a file");
        self.plan.write_all(&value.to_ne_bytes()).expect("written");
    }

    fn read(&mut self) -> [i64; 6] {
        let mut bytes = [0; 48];
        self.plan.seek(SeekFrom::Start(0)).expect("a file");
        self.plan.read_exact(&mut bytes).expect("read");
        std::array::from_fn(|slot| {
            i64::from_ne_bytes(bytes[8 * slot..8 * slot + 8].try_into().expect("eight bytes"))
        })
    }

    pub(super) fn given(&mut self) -> i64 {
        self.read()[3]
    }
}

/// Checks that a job on a bad disk that is mended has the result of one on a good disk.
fn check(service: &Service, id: &str, digest: &str) {
    let job = service.ended(id);
    assert_eq!(job["state"], "succeeded", "{job}");
    assert_eq!(service.digest(id), digest);
    assert_eq!(job["log"]["sha256"], digest);
}

/// Returns the trouble that a job is in, if any.
fn trouble(job: &Value) -> Option<&str> {
    job["trouble"]["code"].as_str()
}

fn advance(errno: i64, code: &str) {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    let service = faults.start(folder.path());
    let scenario = dipole(10_000);
    let text = scenario.to_string();
    let digest = service.reference(&scenario);
    let (mut refused, mut waited, mut nth) = (0, 0, 1);
    loop {
        // Usually a single fault; every fourth time the disk stays bad until it is mended.
        let more = if nth % 4 == 0 { i64::MAX } else { 0 };
        let before = faults.given();
        faults.arm(nth, errno, more);
        let answer = service.send("POST", "/jobs", Some(&text));
        let begun = Instant::now();
        while faults.given() == before && answer.status == 202 {
            let id = answer.json()["id"].as_str().expect("an id").to_owned();
            if service.job(&id)["state"] == "succeeded" || begun.elapsed() > Duration::from_secs(20)
            {
                break;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        let given = faults.given() - before;
        assert_eq!(service.get("/healthz").status, 200);
        match answer.status {
            202 => {
                let id = answer.json()["id"].as_str().expect("an id").to_owned();
                if more > 0 && given > 0 {
                    // The job waits as long as the disk is bad, and says why; its readable files
                    // are whole.
                    std::thread::sleep(Duration::from_millis(30));
                    let job = service.job(&id);
                    waited += usize::from(trouble(&job) == Some(code));
                    assert!(trouble(&job).is_none_or(|reported| reported == code), "{job}");
                    assert_ne!(job["state"], "failed", "{job}");
                }
                faults.arm(0, errno, 0);
                check(&service, &id, &digest);
            }
            status => {
                faults.arm(0, errno, 0);
                let wanted = if errno == ENOSPC { 507 } else { 500 };
                assert_eq!((status, answer.code()), (wanted, code.to_owned()));
                refused += 1;
            }
        }
        // No restart, and the next job runs.
        assert_eq!(service.reference(&scenario), digest);
        if given == 0 {
            break;
        }
        nth += 1;
    }
    println!(
        "{code} at each of {} calls: {refused} refused, all others done in the end, {waited} seen waiting",
        nth - 1
    );
    assert!(nth > 20 && refused > 0 && waited > 0, "{nth}: {refused} refused, {waited} waited");
}

const EIO: i64 = 5;
const EMFILE: i64 = 24;
const ENOSPC: i64 = 28;

#[test]
fn no_space_at_each_write_in_turn() {
    advance(ENOSPC, "storage_full");
}

#[test]
fn an_io_error_at_each_write_in_turn() {
    advance(EIO, "storage_error");
}

#[test]
fn no_file_handle_at_each_write_in_turn() {
    advance(EMFILE, "storage_error");
}

/// The end of a study is on the disk before it is shown.
#[test]
fn a_study_waits_for_room_for_its_result() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(mut faults) = Faults::new(folder.path()) else { return };
    let studies = folder.path().join("data/studies");
    let service = faults.start_on(folder.path(), &studies);
    let question = serde_json::json!({ "kind": "precision", "scenario": dipole(10),
        "methods": [{"name": "vpd", "tableau": "gauss2"}] });
    let answer = service.send("POST", "/studies", Some(&question.to_string()));
    let id = answer.json()["id"].as_str().expect("an id").to_owned();
    while service.get(&format!("/studies/{id}")).json()["state"] == "queued" {
        std::thread::sleep(Duration::from_millis(1));
    }
    faults.arm(1, ENOSPC, i64::MAX);
    while faults.given() < 3 {
        let state = service.get(&format!("/studies/{id}")).json()["state"].clone();
        assert!(state == "running" || state == "queued", "{state}");
        std::thread::sleep(Duration::from_millis(20));
    }
    faults.arm(0, ENOSPC, 0);
    assert_eq!(service.study(&id)["state"], "succeeded");
    assert!(studies.join(&id).join("result.json").is_file());
}

/// A small file system, unmounted when dropped.
pub(crate) struct Disk(PathBuf);

impl Disk {
    pub(crate) fn mount(place: &Path, bytes: u64) -> Option<Self> {
        fs::create_dir_all(place).expect("a folder");
        let options = format!("size={bytes}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "none"])
            .arg(place)
            .stderr(std::process::Stdio::null())
            .status();
        mounted.is_ok_and(|status| status.success()).then(|| Self(place.to_owned()))
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_job_waits_for_room_on_a_disk_that_fills_up() {
    let folder = tempfile::tempdir().expect("a folder");
    let place = folder.path().join("disk");
    let Some(_disk) = Disk::mount(&place, 24 << 20) else {
        println!(
            "SKIPPED: cannot mount a tmpfs here; no_space_at_each_write_in_turn stands in for it"
        );
        return;
    };
    let service = Service::start(&place, &["--workers", "1", "--reserve-bytes", "0"]);
    let scenario = dipole(20_000);
    let reference = service.submit(&scenario);
    assert_eq!(service.ended(&reference)["state"], "succeeded");
    let digest = service.digest(&reference);
    let log = fs::metadata(service.data.join("jobs").join(&reference).join("log.mcap"));
    let size = log.expect("a log").len();
    let blocker = {
        let mut scenario = dipole(10_000_000_000);
        scenario["log"]["every"] = 10_000_000.into();
        scenario
    };
    let ballast = place.join("ballast");
    let (mut full, mut fitted) = (0, 0);
    let sizes = 32 * scale() as u64;
    for k in 0..sizes {
        // From no room at all to enough.
        let room = (size + 400_000) * k / sizes;
        let first = service.submit(&blocker);
        let id = service.submit(&scenario);
        fill(&ballast, room);
        let cancelled = service.send("POST", &format!("/jobs/{first}/cancel"), Some("")).status;
        // On a slow machine its own chunk may have met the full disk by now.
        assert!(cancelled / 100 == 2 || cancelled == 409, "{cancelled}");
        // A job without room waits for it.
        let begun = Instant::now();
        let mut job = service.job(&id);
        while job["state"] != "succeeded"
            && trouble(&job).is_none()
            && begun.elapsed() < Duration::from_secs(2)
        {
            std::thread::sleep(Duration::from_millis(10));
            job = service.job(&id);
        }
        assert_eq!(service.get("/healthz").status, 200);
        *if trouble(&job) == Some("storage_full") { &mut full } else { &mut fitted } += 1;
        fs::remove_file(&ballast).expect("removed");
        check(&service, &id, &digest);
        service.ended(&first);
        for id in [&first, &id] {
            assert_eq!(service.send("DELETE", &format!("/jobs/{id}"), None).status, 204);
        }
        // No restart, and the next job runs.
        let next = service.submit(&scenario);
        assert_eq!(service.ended(&next)["state"], "succeeded");
        assert_eq!(service.send("DELETE", &format!("/jobs/{next}"), None).status, 204);
    }
    println!("{sizes} sizes: {full} times full, {fitted} times enough");
    assert!(full > 0 && fitted > 0);
}

#[test]
fn what_a_running_job_has_written_is_not_counted_twice() {
    let folder = tempfile::tempdir().expect("a folder");
    let place = folder.path().join("disk");
    let Some(_disk) = Disk::mount(&place, 24 << 20) else {
        println!("SKIPPED: cannot mount a tmpfs here");
        return;
    };
    let service = Service::start(&place, &["--workers", "1", "--reserve-bytes", "0"]);
    let sized = |samples: u64| {
        let mut scenario = dipole(samples * 100);
        scenario["log"] = serde_json::json!({ "every": 100, "compression": "none" });
        scenario
    };
    // About 10 MiB, and 12 MiB that have room next to it from first to last.
    let first = service.submit(&sized(15_000));
    let mut job = service.job(&first);
    while job["progress"]["percent"].as_f64() < Some(40.0) {
        std::thread::sleep(Duration::from_millis(5));
        job = service.job(&first);
    }
    let answer = service.send("POST", "/jobs", Some(&sized(18_000).to_string()));
    let state = service.job(&first)["state"].clone();
    println!("at {} % of a job that is now {state}: {}", job["progress"]["percent"], answer.status);
    assert_eq!(answer.status, 202, "{}", answer.code());
    // The room is still taken: a third log of that size is refused.
    let answer = service.send("POST", "/jobs", Some(&sized(18_000).to_string()));
    assert_eq!((answer.status, answer.code().as_str()), (507, "storage_full"));
}

/// Leaves `room` bytes.
fn fill(ballast: &Path, room: u64) {
    let mut file = File::create(ballast).expect("a file");
    let block = vec![0; 4096];
    while file.write_all(&block).is_ok() {}
    let length = file.metadata().expect("a file").len();
    file.set_len(length.saturating_sub(room)).expect("shorter");
}
