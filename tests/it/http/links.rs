//! Links for viewers: what they open, and that no token is in them.

use std::io::Read;
use std::time::{SystemTime, UNIX_EPOCH};

use hmac::{Hmac, Mac};
use serde_json::Value;
use sha2::Sha256;
use tempfile::TempDir;

use super::{Answer, Server, assert_whole_log, directory, long, service, short, until};

const READ: &str = "read-token-0123456789";
const ADMIN: &str = "admin-token-0123456789";

fn guarded(data: &TempDir) -> Server {
    service(data).tokens(&format!("read {READ}\nadmin {ADMIN}")).live().start()
}

/// Sends a request with the token of the administrator.
fn ask(server: &Server, method: &str, path: &str, body: Option<&Value>) -> Answer {
    let bearer = format!("Bearer {ADMIN}");
    let headers = [("authorization", bearer.as_str()), ("content-type", "application/json")];
    let body = body.map(|body| body.to_string().into_bytes());
    server.send(method, path, &headers, body.as_deref())
}

/// Returns a job in a state.
fn job(server: &Server, scenario: &Value, state: &str) -> Value {
    let id = ask(server, "POST", "/jobs", Some(scenario)).json()["id"].clone();
    let path = format!("/jobs/{}", id.as_str().expect("an id"));
    until(state, || {
        Some(ask(server, "GET", &path, None).json()).filter(|job| job["state"] == state)
    })
}

fn link<'a>(job: &'a Value, name: &str) -> &'a str {
    job["links"][name].as_str().expect("a link")
}

/// Returns a link's path and query.
fn parts(link: &str) -> (&str, &str) {
    link.split_once('?').expect("a signed link")
}

/// Returns the query of a link as the service would sign it, by the key on the disk.
fn signed(data: &TempDir, what: &str, expires: u64) -> String {
    let key = std::fs::read(data.path().join("data/link-key")).expect("a key");
    assert_eq!(key.len(), 32);
    let mac = Hmac::<Sha256>::new_from_slice(&key).expect("any length is right");
    let mac = mac.chain_update(format!("read {what} until {expires}")).finalize().into_bytes();
    let hex: String = mac.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("expires={expires}&signature={hex}")
}

fn now_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs()
}

#[test]
fn no_answer_holds_a_token() {
    let data = directory();
    let server = guarded(&data);
    let done = job(&server, &short(), "succeeded");
    let running = job(&server, &long(), "running");
    let path =
        |job: &Value, rest: &str| format!("/jobs/{}{rest}", job["id"].as_str().expect("an id"));
    let (of_done, of_running) = (path(&done, ""), path(&running, ""));
    let events = path(&done, "/events");
    for place in
        ["/", "/docs", "/openapi.json", "/jobs", "/metrics", &of_done, &of_running, &events]
    {
        let answer = ask(&server, "GET", place, None);
        assert_eq!(answer.status, 200, "{place}");
        let text = String::from_utf8_lossy(&answer.body).into_owned();
        for token in [READ, ADMIN] {
            assert!(!text.contains(token) && !text.contains("?token"), "{place}");
            assert!(!format!("{:?}", answer.headers).contains(token), "{place}");
        }
    }
    for (job, name) in [(&done, "viewers"), (&running, "live_viewers")] {
        for (viewer, link) in job["links"][name].as_object().expect("links") {
            let link = link.as_str().expect("a link");
            let plain = viewer == "address" && link.contains("/?expires=");
            assert!(plain || link.contains("%3Fexpires%3D"), "{viewer}: {link}");
        }
    }
    ask(&server, "POST", &path(&running, "/cancel"), None);
}

#[test]
fn a_link_opens_its_log_and_nothing_else() {
    let data = directory();
    let server = guarded(&data);
    let (first, second) =
        (job(&server, &short(), "succeeded"), job(&server, &short(), "succeeded"));
    let own = first["id"].as_str().expect("an id");
    let other = second["id"].as_str().expect("an id");
    let (log, query) = parts(link(&first, "log"));
    let whole = server.get(link(&first, "log"));
    assert_eq!(whole.status, 200);
    assert_whole_log(&whole.body);
    assert_eq!(server.send("HEAD", link(&first, "log"), &[], None).status, 200);
    assert_eq!(server.get_with(link(&first, "log"), &[("range", "bytes=0-7")]).status, 206);
    assert_eq!(server.get(link(&first, "live")).body, whole.body);
    assert_eq!(server.get(&format!("/jobs/{own}/live.mcap?{query}")).status, 200);
    // The link of the viewers is the same.
    let rerun = first["links"]["viewers"]["rerun"].as_str().expect("a link");
    let encoded = query.replace('=', "%3D").replace('&', "%26");
    assert!(rerun.ends_with(&format!("log.mcap%3F{encoded}")), "{rerun}");

    for (method, path) in [
        ("GET", format!("/jobs/{other}/log.mcap?{query}")),
        ("GET", format!("/jobs/{own}?{query}")),
        ("GET", format!("/jobs/{own}/events?{query}")),
        ("GET", format!("/jobs/{own}/scenario.json?{query}")),
        ("GET", format!("/jobs/{own}/attitudes.json?{query}")),
        ("GET", format!("/jobs/{own}/charts/energy.svg?{query}")),
        ("GET", format!("/jobs?{query}")),
        ("GET", format!("/metrics?{query}")),
        ("DELETE", format!("/jobs/{own}?{query}")),
        ("POST", format!("/jobs/{own}/cancel?{query}")),
        ("POST", format!("/jobs?{query}")),
    ] {
        server.send(method, &path, &[], None).problem(401, "unauthorized");
    }
    assert_eq!(server.send("DELETE", &format!("{log}?{query}"), &[], None).status, 405);

    let (expires, signature) = query.split_once('&').expect("two fields");
    let end_s: u64 =
        expires.strip_prefix("expires=").and_then(|end| end.parse().ok()).expect("a time");
    let left_s = end_s - now_s();
    assert!((22 * 3600..=24 * 3600).contains(&left_s), "{left_s} s left");
    let digit = signature.len() - 1;
    let flipped = if signature.ends_with('0') { '1' } else { '0' };
    for query in [
        expires.to_owned(),
        signature.to_owned(),
        format!("{expires}&signature="),
        format!("{expires}&{}", &signature[..digit]),
        format!("{expires}&{}{flipped}", &signature[..digit]),
        format!("expires={}&{signature}", end_s + 1),
        format!("expires=&{signature}"),
        format!("token={ADMIN}"),
        format!("token={READ}"),
        signed(&data, "the live view", end_s),
        signed(&data, &format!("the log of {own}"), now_s() - 1),
        signed(&data, &format!("the log of {other}"), end_s),
    ] {
        server.get(&format!("{log}?{query}")).problem(401, "unauthorized");
    }
    // The same signing is accepted for the right log and time.
    let good = signed(&data, &format!("the log of {own}"), now_s() + 60);
    assert_eq!(server.get(&format!("{log}?{good}")).status, 200);
    // A token goes before the link, and one that is wrong does not spoil it.
    for token in [READ, "another-token-0123456789"] {
        let bearer = format!("Bearer {token}");
        let answer = server.get_with(link(&first, "log"), &[("authorization", &bearer)]);
        assert_eq!(answer.status, 200);
    }
}

#[test]
fn links_outlive_a_restart_and_a_damaged_key_voids_them() {
    let data = directory();
    let server = guarded(&data);
    let job = job(&server, &short(), "succeeded");
    let log = link(&job, "log").to_owned();
    server.stop().0.expect("stops in order");
    let place = data.path().join("data/link-key");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode = place.metadata().expect("a key").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }
    let server = guarded(&data);
    assert_eq!(server.get(&log).status, 200);
    server.stop().0.expect("stops in order");
    std::fs::write(&place, "half a key").expect("written");
    let server = guarded(&data);
    server.get(&log).problem(401, "unauthorized");
    assert_eq!(std::fs::read(&place).expect("a key").len(), 32);
}

#[test]
fn without_tokens_links_are_plain() {
    let data = directory();
    let server = service(&data).start();
    let job = server.job(&server.finished());
    assert!(link(&job, "log").ends_with("/log.mcap"));
    assert!(!data.path().join("data/link-key").exists());
}

#[test]
fn a_growing_log_is_followed_by_its_link() {
    let data = directory();
    let server = guarded(&data);
    let mut scenario = long();
    scenario["steps"] = serde_json::json!(100_000_000);
    scenario["log"] = serde_json::json!({ "every": 10, "channels": ["/state"] });
    let running = job(&server, &scenario, "running");
    let answer = ureq::get(server.url(link(&running, "live"))).call().expect("an answer");
    let mut magic = [0; 8];
    answer.into_body().into_reader().read_exact(&mut magic).expect("a log");
    assert_eq!(&magic, super::MAGIC);
    let id = running["id"].as_str().expect("an id");
    ask(&server, "POST", &format!("/jobs/{id}/cancel"), None);
}
