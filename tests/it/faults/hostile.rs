//! Clients that ask for the worst and leave. Times are printed and decide nothing but what is promised: a stop ends
//! within ten seconds.

use std::collections::VecDeque;
use std::io::Write;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::process::Service;
use super::{dipole, heavy, pendulum, scale};

/// Returns the most expensive requests that validation lets through, by what makes them expensive.
fn worst() -> Vec<(&'static str, String)> {
    let accurate = |mut scenario: Value, duration_s: f64| {
        for field in ["method", "step_s", "steps"] {
            scenario.as_object_mut().expect("an object").remove(field);
        }
        scenario["accuracy"] = json!({ "error": 1e-12 });
        scenario["duration_s"] = json!(duration_s);
        scenario.to_string()
    };
    let mut ensemble = heavy(16, 1, 1000);
    ensemble["ensemble"] = json!({ "members": 100_000, "seed": 1, "attitude_spread_rad": 0.1 });
    let terms = |count: usize| {
        let mut scenario = heavy(16, count, 1_000_000);
        scenario["log"] = json!({ "every": 1000 });
        scenario
    };
    vec![
        ("SO(16), 60 springs, an accuracy", accurate(terms(60), 1e6)),
        ("SO(16), 1000 springs, an accuracy", accurate(terms(1000), 1e6)),
        ("SO(16), 1000 springs, a million steps", terms(1000).to_string()),
        ("SO(16), 100000 members", ensemble.to_string()),
        (
            "a study of SO(16) with 60 springs",
            json!({ "kind": "stability", "scenario": terms(60) }).to_string(),
        ),
        ("a place that underflows", {
            let mut scenario = dipole(100);
            scenario["scene"]["potential"] = json!([
                { "kind": "uniform", "body_point": [0, 0, 1], "direction": [0, 0, 1], "weight": 1 },
                { "kind": "uniform", "body_point": [0, 1, 0], "direction": [0, 1, 0], "weight": 1 },
                { "kind": "spring", "body_point": [1, 0, 0], "position": [0, 1e-200, 0], "stiffness": 1 },
            ]);
            scenario.to_string()
        }),
    ]
}

/// Sends a request and does not read its answer; the client leaves when the stream is dropped.
fn send(service: &Service, path: &str, body: &str) -> TcpStream {
    let mut stream = TcpStream::connect(service.address).expect("a connection");
    let head =
        format!("POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n");
    let _ = write!(stream, "{head}Content-Length: {}\r\n\r\n{body}", body.len());
    stream
}

#[test]
fn the_worst_requests_of_clients_that_leave_stall_nobody() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "2"]);
    let finished = service.submit(&dipole(2_000));
    assert_eq!(service.ended(&finished)["state"], "succeeded");
    let (worst, over) = (worst(), AtomicBool::new(false));
    let ask = |path: String| {
        let mut times = Vec::new();
        while !over.load(Ordering::Relaxed) {
            let asked = Instant::now();
            assert_eq!(service.get(&path).status, 200);
            times.push(asked.elapsed());
            std::thread::sleep(Duration::from_millis(50));
        }
        times.sort_unstable();
        times
    };
    let posts = 100 * scale();
    let [mut alive, mut read] = std::thread::scope(|scope| {
        let alive = scope.spawn(|| ask("/healthz".to_owned()));
        let read = scope.spawn(|| ask(format!("/jobs/{finished}/log.mcap")));
        let mut patience = VecDeque::new();
        for k in 0..posts {
            let (name, body) = &worst[k % worst.len()];
            let path = if name.starts_with("a study") { "/studies" } else { "/jobs" };
            patience.push_back(send(&service, path, body));
            // Some stay a little, and leave while they are being served.
            if patience.len() > 20 {
                patience.pop_front();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        drop(patience);
        std::thread::sleep(Duration::from_secs(3));
        over.store(true, Ordering::Relaxed);
        [alive, read].map(|asker| asker.join().expect("no panic"))
    });
    let p99 = |times: &mut Vec<Duration>| times[(times.len() - 1) * 99 / 100];
    println!(
        "{posts} posts: /healthz p99 {:.1?} of {}, a log p99 {:.1?} of {}",
        p99(&mut alive),
        alive.len(),
        p99(&mut read),
        read.len()
    );
    // A valid request among them is taken, and answers to refused ones name the field.
    let body = &worst[5].1;
    let answer = service.send("POST", "/jobs", Some(body));
    assert_eq!(answer.status, 422, "{}", String::from_utf8_lossy(&answer.body));
    let honest = service.submit(&pendulum(1e-6, 10.0));
    assert_ne!(service.job(&honest)["state"], "failed");
    let taken = service.get("/jobs?limit=500").json();
    println!("{} jobs taken", taken["jobs"].as_array().map_or(0, Vec::len));
    let (status, took) = service.terminate();
    println!("stopped in {took:.1?}");
    assert!(status.success() && took < Duration::from_secs(10), "{status}, {took:?}");
}

/// A worker settles a job for an accuracy: neither an answer nor a start waits for it.
#[test]
fn a_start_plans_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let mut long = dipole(10_000_000_000);
    long["log"]["every"] = json!(10_000_000);
    let running = service.submit(&long);
    while service.job(&running)["state"] != "running" {
        std::thread::sleep(Duration::from_millis(1));
    }
    let count = 100 * scale();
    let ids: Vec<_> = (0..count).map(|_| service.submit(&pendulum(1e-8, 30.0))).collect();
    assert!(service.terminate().0.success());
    // Neither with the index nor without it.
    for index in [true, false] {
        if !index {
            std::fs::remove_file(folder.path().join("data/index.jsonl")).expect("removed");
        }
        let begun = Instant::now();
        let service = Service::start(folder.path(), &["--workers", "1"]);
        let listening = begun.elapsed();
        while service.get("/readyz").status != 200 {
            std::thread::sleep(Duration::from_millis(1));
        }
        println!(
            "{count} jobs wait: ready after {:.1?}, listening after {listening:.1?}",
            begun.elapsed()
        );
        let job = service.job(&ids[count - 1]);
        assert_eq!((&job["state"], &job["plan"]), (&"queued".into(), &Value::Null), "{job}");
        // Not even for the job that runs.
        assert_eq!(pilot_runs(&service), 0);
        assert!(service.terminate().0.success());
    }
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let cancelled = service.send("POST", &format!("/jobs/{running}/cancel"), Some("")).status;
    assert_eq!(cancelled / 100, 2);
    let job = service.ended(&ids[0]);
    assert_eq!(job["state"], "succeeded", "{job}");
    assert!(job["plan"]["advice"]["expected_error"].as_f64() < Some(1e-8), "{job}");
    let digest = service.digest(&ids[0]);
    assert!(service.terminate().0.success());
    // It was settled once: the result is kept with the job, and is enough to run it.
    let jobs = folder.path().join("data/jobs");
    let text = |name: &str| std::fs::read(jobs.join(&ids[0]).join(name)).expect("kept");
    let (scenario, plan) = (text("scenario.json"), text("plan.json"));
    let again = folder.path().join("again");
    let jobs = again.join("data/jobs");
    let add = |files: &[(&str, &[u8])]| {
        let id = uuid::Uuid::now_v7().to_string();
        std::fs::create_dir_all(jobs.join(&id)).expect("a directory");
        for (name, text) in files {
            std::fs::write(jobs.join(&id).join(name), text).expect("written");
        }
        id
    };
    let waiting: Vec<_> =
        (0..50).map(|_| add(&[("scenario.json", &scenario), ("plan.json", &plan)])).collect();
    // The file as the version before kept it.
    let end = plan.len() - b"\ncrc32 00000000\n".len();
    let kept: Value = serde_json::from_slice(&plan[..end]).expect("JSON");
    let choice = &kept["settled"]["choice"];
    let chosen = json!({ "scenario": choice[0], "advice": choice[1] }).to_string();
    let chosen = format!("{chosen}\ncrc32 {:08x}\n", crc32fast::hash(chosen.as_bytes()));
    let older = add(&[("scenario.json", &scenario), ("settled.json", chosen.as_bytes())]);
    let service = Service::start(&again, &["--workers", "1"]);
    assert_eq!(service.get("/readyz").status, 200);
    assert_eq!(service.ended(&older)["state"], "succeeded");
    for id in &waiting {
        assert_eq!(service.ended(id)["state"], "succeeded");
        assert_eq!(service.digest(id), digest);
    }
    assert_eq!(pilot_runs(&service), 0);
    // A job without either is planned by a worker.
    let unplanned = service.submit(&pendulum(1e-8, 30.0));
    assert_eq!(service.ended(&unplanned)["state"], "succeeded");
    assert!(pilot_runs(&service) > 0);
}

/// Returns the number of runs that a service has made to plan jobs.
fn pilot_runs(service: &Service) -> u64 {
    let text = String::from_utf8(service.get("/metrics").body).expect("text");
    let figure = text.lines().find_map(|line| line.strip_prefix("vpd_pilot_runs "));
    figure.and_then(|figure| figure.parse().ok()).expect("a figure")
}

#[test]
fn an_accuracy_that_cannot_be_had_fails_its_job_and_says_why() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let mut scenario = pendulum(1e-13, 2e9);
    scenario["log"] = json!({ "every": 1_000_000 });
    let id = service.submit(&scenario);
    let job = service.ended(&id);
    assert_eq!(job["state"], "failed", "{job}");
    let diagnosis = &job["diagnosis"];
    assert!(
        ["accuracy_out_of_reach", "too_expensive"]
            .contains(&diagnosis["code"].as_str().expect("a code")),
        "{job}"
    );
    assert!(diagnosis["message"].as_str().is_some_and(|text| text.len() > 30), "{job}");
    assert_eq!(service.get(&format!("/jobs/{id}/log.mcap")).code(), "no_log");
    // A search is stopped like a run.
    let mut hard = heavy(16, 60, 1);
    for field in ["method", "step_s", "steps"] {
        hard.as_object_mut().expect("an object").remove(field);
    }
    hard["accuracy"] = json!({ "error": 1e-9 });
    hard["duration_s"] = json!(1000.0);
    let id = service.submit(&hard);
    while service.job(&id)["state"] == "queued" {
        std::thread::sleep(Duration::from_millis(1));
    }
    let asked = Instant::now();
    assert_eq!(service.send("POST", &format!("/jobs/{id}/cancel"), Some("")).status / 100, 2);
    let job = service.ended(&id);
    println!("a search was stopped in {:.1?}", asked.elapsed());
    assert!(["cancelled", "failed"].contains(&job["state"].as_str().expect("a state")), "{job}");
}

/// A job that alone exceeds the memory is refused; the others wait for each other.
#[test]
fn memory_is_admitted_like_the_disk() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut ensemble = heavy(16, 1, 20);
    ensemble["ensemble"] = json!({ "members": 200, "seed": 1, "attitude_spread_rad": 0.1 });
    let plan = vpd::plan::Plan::new(
        &vpd::scenario::Scenario::from_json(ensemble.to_string().as_bytes()).expect("a scenario"),
    );
    let one = plan.expect("a plan").memory_bytes;
    let limit = (one + one / 5).to_string();
    let service = Service::start(folder.path(), &["--workers", "2", "--max-memory-bytes", &limit]);
    let ids = [service.submit(&ensemble), service.submit(&ensemble)];
    let mut most = 0;
    loop {
        // Both at one moment: one after the other, the first may end and the second begin in between.
        let running = service.get("/jobs?state=running").json();
        most = most.max(running["jobs"].as_array().map_or(0, Vec::len));
        let states = ids.each_ref().map(|id| service.job(id)["state"].clone());
        if states.iter().all(|state| state == "succeeded") {
            break;
        }
        assert!(states.iter().all(|state| state != "failed"), "{states:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(most, 1);
    ensemble["ensemble"]["members"] = json!(100_000);
    let answer = service.send("POST", "/jobs", Some(&ensemble.to_string()));
    assert_eq!((answer.status, answer.code().as_str()), (422, "too_much_memory"));
}
