//! Many clients at once. Times are printed and decide nothing.

use std::fs;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::dipole;
use super::process::{PATIENCE, Service};

/// Returns the resident memory of a process in KiB.
pub(super) fn memory(pid: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|text| text.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

/// Pause between two requests of a polling client: four a second, as a script or a page would make.
const POLL: Duration = Duration::from_millis(250);

/// Returns a client with a connection of its own.
fn client() -> ureq::Agent {
    // No time limit for the whole: it would start a thread for each request, to look the name up.
    ureq::Agent::config_builder()
        .http_status_as_error(false)
        .timeout_recv_response(Some(PATIENCE))
        .timeout_recv_body(Some(PATIENCE))
        .build()
        .into()
}

fn percentile(times: &mut [Duration], part: f64) -> Duration {
    times.sort_unstable();
    times[((times.len() - 1) as f64 * part) as usize]
}

fn queued(jobs: usize, submitters: usize, downloads: usize, pollers: usize) {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1", "--queue", "100000"]);
    let small = dipole(10_000);
    let finished = service.submit(&small);
    service.ended(&finished);
    // The queue fills behind it.
    let mut long = dipole(10_000_000_000);
    long["log"]["every"] = json!(10_000_000);
    let running = service.submit(&long);
    let before = memory(service.pid());
    let (left, over) = (AtomicUsize::new(jobs), AtomicBool::new(false));
    let text = small.to_string();
    let base = format!("http://{}", service.address);
    let log = service.get(&format!("/jobs/{finished}/log.mcap")).body;
    let begun = Instant::now();
    let poll = |path: &str| {
        let (agent, mut times) = (client(), Vec::new());
        while !over.load(Ordering::Relaxed) {
            let asked = Instant::now();
            let mut answer = agent.get(format!("{base}{path}")).call().expect("an answer");
            assert_eq!(answer.status(), 200);
            answer.body_mut().read_to_vec().expect("a body");
            times.push(asked.elapsed());
            std::thread::sleep(POLL);
        }
        times
    };
    let (mut taken, mut polled, mut bare, fetched) = std::thread::scope(|scope| {
        let submitters: Vec<_> = (0..submitters)
            .map(|_| {
                scope.spawn(|| {
                    let (agent, mut times) = (client(), Vec::new());
                    while left
                        .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |n| n.checked_sub(1))
                        .is_ok()
                    {
                        let asked = Instant::now();
                        let request =
                            agent.post(format!("{base}/jobs")).content_type("application/json");
                        let mut answer = request.send(&text).expect("an answer");
                        assert_eq!(answer.status(), 202);
                        answer.body_mut().read_to_vec().expect("a body");
                        times.push(asked.elapsed());
                    }
                    times
                })
            })
            .collect();
        let pollers: Vec<_> =
            (0..pollers).map(|_| scope.spawn(|| poll(&format!("/jobs/{running}")))).collect();
        // Time of an answer without content: the machine's share, and the client's.
        let bare: Vec<_> = (0..8).map(|_| scope.spawn(|| poll("/healthz"))).collect();
        let downloads: Vec<_> = (0..downloads)
            .map(|_| {
                scope.spawn(|| {
                    let answer = client().get(format!("{base}/jobs/{finished}/log.mcap")).call();
                    let body = answer
                        .expect("an answer")
                        .into_body()
                        .into_with_config()
                        .limit(u64::MAX)
                        .read_to_vec();
                    assert!(body.expect("a body") == log);
                })
            })
            .collect();
        let submitted: Vec<Duration> =
            submitters.into_iter().flat_map(|client| client.join().expect("no panic")).collect();
        let downloaded =
            downloads.into_iter().map(|client| client.join().expect("no panic")).count();
        over.store(true, Ordering::Relaxed);
        let times = |clients: Vec<std::thread::ScopedJoinHandle<'_, Vec<Duration>>>| {
            clients
                .into_iter()
                .flat_map(|client| client.join().expect("no panic"))
                .collect::<Vec<_>>()
        };
        (submitted, times(pollers), times(bare), downloaded)
    });
    let took = begun.elapsed();
    let grown = memory(service.pid()).saturating_sub(before);
    println!(
        "{jobs} jobs in {took:.1?} ({:.0} a second, p99 {:.1?}); {} status answers, each client {} a second, p50 {:.1?}, p99 {:.1?} (of /healthz {:.1?} and {:.1?}); {fetched} downloads; memory grew by {:.1} MiB",
        jobs as f64 / took.as_secs_f64(),
        percentile(&mut taken, 0.99),
        polled.len(),
        1000 / POLL.as_millis(),
        percentile(&mut polled, 0.5),
        percentile(&mut polled, 0.99),
        percentile(&mut bare, 0.5),
        percentile(&mut bare, 0.99),
        grown as f64 / 1024.0,
    );
    assert_eq!(taken.len(), jobs);
    assert!(grown < 64 << 10, "memory grew by {grown} KiB");
    assert_eq!(service.job(&running)["state"], "running");
}

#[test]
fn a_queue_of_many_jobs_slows_nobody_down() {
    queued(1000, 64, 100, 200);
}

#[test]
#[ignore = "the full size takes a minute: cargo nextest run --release --run-ignored all full_size"]
fn a_queue_of_full_size_slows_nobody_down() {
    queued(10_000, 64, 100, 200);
}

#[test]
fn overload_is_answered_and_accepted_jobs_end() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "2", "--queue", "16"]);
    let mut small = dipole(2_000);
    small["log"]["every"] = json!(100);
    let text = small.to_string();
    let base = format!("http://{}", service.address);
    let answers: Vec<(u16, Option<Value>)> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..64)
            .map(|_| {
                scope.spawn(|| {
                    let agent = client();
                    let ask = |_| {
                        let request =
                            agent.post(format!("{base}/jobs")).content_type("application/json");
                        let mut answer = request.send(&text).expect("an answer");
                        let status = answer.status().as_u16();
                        let waits = answer.headers().contains_key("retry-after");
                        assert!(status == 202 || waits, "{status} without Retry-After");
                        let job: Option<Value> = answer.body_mut().read_json().ok();
                        (status, job)
                    };
                    (0..25).map(ask).collect::<Vec<_>>()
                })
            })
            .collect();
        clients.into_iter().flat_map(|client| client.join().expect("no panic")).collect()
    });
    let accepted: Vec<_> = answers.iter().filter(|(status, _)| *status == 202).collect();
    let refused = answers.len() - accepted.len();
    assert!(answers.iter().all(|(status, _)| [202, 429, 503].contains(status)));
    for (_, job) in &accepted {
        let id = job.as_ref().and_then(|job| job["id"].as_str()).expect("an id");
        assert_eq!(service.ended(id)["state"], "succeeded");
    }
    println!("{} accepted and done, {refused} refused until later", accepted.len());
    assert!(refused > 0, "there was no overload");
}
