//! Nonsense on the wire: an answer that says so, or the end of the connection; never a fault of ours.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use serde_json::json;

use super::process::{PATIENCE, Service};
use super::{Random, dipole, scale};

/// Allowed answers to bad requests; 0 is the end of the connection.
const EXPECTED: [u16; 12] = [0, 400, 404, 405, 408, 411, 413, 414, 415, 421, 431, 505];

/// Returns the statuses that come back.
fn exchange(service: &Service, bytes: &[u8]) -> Vec<u16> {
    let mut stream = TcpStream::connect(service.address).expect("a connection");
    stream.set_read_timeout(Some(Duration::from_secs(30))).expect("a socket");
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let text = String::from_utf8_lossy(&answer);
    let statuses = text.split("HTTP/1.1 ").skip(1);
    statuses.filter_map(|rest| rest.get(..3)?.parse().ok()).collect()
}

#[test]
fn malformed_requests_are_refused_or_closed() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &[]);
    let body = "{}";
    let post = |head: &str| {
        format!(
            "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n{head}\r\n{body}"
        )
    };
    let coded = |head: &str| {
        let post = post(head);
        format!("{}2\r\n{body}\r\n0\r\n\r\n", post.strip_suffix(body).expect("the body"))
    };
    let get = |line: &str| format!("{line}\r\nHost: localhost\r\n\r\n");
    let long = "x".repeat(70_000);
    let many: String = (0..200).map(|n| format!("X-{n}: y\r\n")).collect();
    let table: Vec<(String, &[u16])> = vec![
        ("\x16\x03\x01\x02\x00\x01\x00\x01\u{fc}\x03\x03".to_owned(), &[0, 400]),
        ("nonsense\r\n\r\n".to_owned(), &[0, 400]),
        (get("GET /healthz HTTP/9.9"), &[0, 400, 505]),
        (get("GET  /healthz HTTP/1.1"), &[0, 400]),
        (get("GET /healthz HTTP/1.1\r\nBad Name: x"), &[0, 400]),
        (get("GET /healthz HTTP/1.1\r\nX: a\0b"), &[0, 400]),
        (get("GET /healthz HTTP/1.1\r\nX: a\r\n folded"), &[0, 400]),
        (get(&format!("GET /{long} HTTP/1.1")), &[0, 414, 431]),
        (get(&format!("GET /healthz HTTP/1.1\r\n{many}X: y")), &[0, 431]),
        (get(&format!("GET /healthz HTTP/1.1\r\nX: {long}")), &[0, 431]),
        ("GET /healthz HTTP/1.1\r\n\r\n".to_owned(), &[0, 400]),
        (post("Content-Length: -1\r\n"), &[0, 400]),
        (post("Content-Length: 2\r\nContent-Length: 3\r\n"), &[0, 400]),
        (post("Content-Length: 99999999999999999999\r\n"), &[0, 400, 413]),
        (post("Transfer-Encoding: xchunked\r\n"), &[0, 400]),
        (post("Transfer-Encoding: chunked\r\n\r\nzz\r\n"), &[0, 400]),
        (post("Content-Length: 2\r\nTransfer-Encoding: chunked\r\n"), &[0, 400]),
        (coded("Transfer-Encoding: gzip, chunked\r\n"), &[501]),
        (coded("Transfer-Encoding: chunked, chunked\r\n"), &[501]),
        (coded("Transfer-Encoding: gzip\r\nTransfer-Encoding: chunked\r\n"), &[501]),
        // One coding is known: this is a scenario without a scene.
        (coded("Transfer-Encoding: Chunked\r\n"), &[422]),
    ];
    for (request, expected) in &table {
        let statuses = exchange(&service, request.as_bytes());
        let status = statuses.first().copied().unwrap_or(0);
        assert!(expected.contains(&status), "{statuses:?} to {request:.200?}");
        assert!(statuses.len() <= 1, "a second answer: {statuses:?} to {request:.200?}");
    }

    let mut random = Random::new();
    let good = [
        get("GET /healthz HTTP/1.1"),
        get("GET /jobs?limit=3 HTTP/1.1"),
        get("HEAD /scenario.schema.json HTTP/1.1"),
        get("DELETE /jobs/01999999-9999-7999-8999-999999999999 HTTP/1.1"),
        get("GET /jobs/01999999-9999-7999-8999-999999999999/log.mcap HTTP/1.1\r\nRange: bytes=0-7"),
        post("Content-Length: 2\r\n"),
    ];
    let count = 2000 * scale();
    let (mut closed, mut answered) = (0, 0);
    for _ in 0..count {
        let mut bytes = good[random.below(good.len())].clone().into_bytes();
        for _ in 0..=random.below(4) {
            let at = random.below(bytes.len());
            match random.below(5) {
                0 => bytes[at] = random.below(256) as u8,
                1 => bytes.truncate(at + 1),
                2 => bytes.insert(at, b"\r\n\0 :/%?"[random.below(8)]),
                3 => {
                    bytes.remove(at);
                    bytes.push(b'\n');
                }
                _ => {
                    let end = (at + random.below(40)).min(bytes.len());
                    let piece = bytes[at..end].to_vec();
                    bytes.splice(at..at, piece);
                }
            }
        }
        let statuses = exchange(&service, &bytes);
        let text = String::from_utf8_lossy(&bytes);
        match statuses.first() {
            None => closed += 1,
            Some(status) => {
                answered += 1;
                // Some mutations leave a good request.
                let fine = EXPECTED.contains(status) || [200, 204, 422].contains(status);
                assert!(fine, "{statuses:?} to {text:?}");
            }
        }
        assert!(
            statuses.iter().all(|status| *status < 500 || *status == 505),
            "{statuses:?} to {text:?}"
        );
    }
    println!(
        "{count} mutations: {answered} answered, {closed} closed; {} by the table",
        table.len()
    );
    assert!(answered > 0 && closed > 0);
    assert_eq!(service.get("/healthz").status, 200);
}

/// Sends a request and closes the own side; returns the whole answer.
fn half_closed(service: &Service, request: &str) -> String {
    let mut stream = TcpStream::connect(service.address).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
    stream.write_all(request.as_bytes()).expect("sent");
    stream.shutdown(Shutdown::Write).expect("a socket");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    String::from_utf8_lossy(&answer).into_owned()
}

/// Proxies and plain tools close their side once the request is sent, and read on.
#[test]
fn a_client_that_closes_its_side_after_the_request_is_answered() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let scenario = dipole(2_000);
    let id = service.submit(&scenario);
    service.ended(&id);
    let body = scenario.to_string();
    let post = format!(
        "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    );
    let get = |path: &str| format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let table = [
        (get("/healthz"), "200", "\"ok\"}"),
        (get("/jobs"), "200", "}"),
        (get(&format!("/jobs/{id}")), "200", "}"),
        (get(&format!("/jobs/{id}/log.mcap")), "200", "MCAP0\r\n"),
        (get(&format!("/jobs/{id}/live.mcap")), "200", "\r\n0\r\n\r\n"),
        (get(&format!("/jobs/{id}/charts/energy.svg")), "200", "</svg>"),
        (get(&format!("/jobs/{id}/events")), "200", "\r\n0\r\n\r\n"),
        (post, "202", "}"),
    ];
    for (request, status, end) in &table {
        for _ in 0..10 {
            let answer = half_closed(&service, request);
            let given = answer.strip_prefix("HTTP/1.1 ").and_then(|rest| rest.get(..3));
            assert_eq!(given, Some(*status), "{answer:?} to {request:?}");
            assert!(
                answer.trim_end_matches('\n').ends_with(end.trim_end_matches('\n')),
                "{answer:?} to {request:?}"
            );
        }
    }
    // Half a body is still half a body.
    let answer = half_closed(
        &service,
        "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{}",
    );
    assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 400"), "{answer:?}");
}

/// A client that has left is not taken for one that reads on for ever.
#[test]
fn clients_that_leave_make_room() {
    let folder = tempfile::tempdir().expect("a folder");
    let service = Service::start(folder.path(), &["--workers", "1", "--connections", "16"]);
    let mut long = dipole(10_000_000_000);
    long["log"]["every"] = json!(10_000_000);
    service.submit(&long);
    let waiting = service.submit(&long);
    // Nothing comes of a log whose job waits.
    let request = format!("GET /jobs/{waiting}/live.mcap HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let clients: Vec<_> = (0..16)
        .map(|_| {
            let mut stream = TcpStream::connect(service.address).expect("a connection");
            stream.write_all(request.as_bytes()).expect("sent");
            stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
            let mut begin = [0; 12];
            stream.read_exact(&mut begin).expect("an answer");
            assert_eq!(&begin, b"HTTP/1.1 200");
            stream
        })
        .collect();
    assert_eq!(service.get("/healthz").status, 503);
    drop(clients);
    let begun = Instant::now();
    while service.get("/healthz").status != 200 {
        assert!(begun.elapsed() < PATIENCE, "no room after clients left");
        std::thread::sleep(Duration::from_millis(100));
    }
}
