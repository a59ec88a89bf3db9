//! Jobs: taken, shown, listed, cancelled, forgotten; and refusals.

use std::time::Instant;

use serde_json::json;

use crate::bad_scenarios::Bad;

use super::{assert_whole_log, directory, long, service, short, until};

#[test]
fn a_job_is_taken_runs_and_says_how_it_ended() {
    let data = directory();
    let server = service(&data).start();
    let id = server.submit(&short());
    let job = server.wait(&id, "succeeded");
    assert_eq!(job["name"], "dipole");
    assert_eq!(job["attempts"], 1);
    assert_eq!(job["progress"]["steps"], 100);
    assert_eq!(job["progress"]["steps_done"], 100);
    assert_eq!(job["progress"]["percent"], 100.0);
    assert_eq!(job["plan"]["steps"], 100);
    assert_eq!(job["summary"]["outcome"], "succeeded");
    assert!(job["diagnosis"].is_null());
    let place = data.path().to_string_lossy().into_owned();
    assert!(!job.to_string().contains(&place), "an answer names a file: {job}");
    let time = |field: &str| -> chrono::DateTime<chrono::Utc> {
        job[field].as_str().expect("a time").parse().expect("RFC 3339")
    };
    assert!(time("created") <= time("finished"));
    assert_eq!(job["links"]["self"], format!("/jobs/{id}"));
    assert_eq!(job["links"]["log"], format!("/jobs/{id}/log.mcap"));
    let scenario = server.get(job["links"]["scenario"].as_str().expect("a link"));
    assert_eq!(scenario.header("content-type"), "application/json");
    assert_eq!(scenario.json()["steps"], 100);
    let encoded =
        format!("http%3A%2F%2F127.0.0.1%3A{}%2Fjobs%2F{id}%2Flog.mcap", server.address.port());
    for viewer in ["foxglove", "foxglove_desktop", "lichtblick_desktop", "rerun"] {
        let link = job["links"]["viewers"][viewer].as_str().expect("a link");
        assert!(link.contains(&format!("url={encoded}")), "{link}");
    }
}

/// Foxglove's remote data loader: its types read the manifest, and the address there, relative to that of the manifest, is that of a
/// log which answers ranges.
#[test]
fn a_remote_data_loader_finds_the_log_by_the_manifest() {
    use foxglove::remote_data_loader_backend::{DataSource, Manifest};
    let data = directory();
    let token = "manifest-token-0123456789";
    let server = service(&data).tokens(&format!("admin {token}\n")).workers(1).start();
    let bearer = format!("Bearer {token}");
    let ask = |path: &str, more: &[(&str, &str)]| {
        let headers = [&[("authorization", bearer.as_str())], more].concat();
        server.send("GET", path, &headers, None)
    };
    let submit = |scenario: &serde_json::Value| {
        let headers = [("authorization", bearer.as_str()), ("content-type", "application/json")];
        let body = scenario.to_string().into_bytes();
        let answer = server.send("POST", "/jobs", &headers, Some(&body));
        answer.json()["id"].as_str().expect("an id").to_owned()
    };
    let id = submit(&short());
    until("the end", || {
        (ask(&format!("/jobs/{id}"), &[]).json()["state"] == "succeeded").then_some(())
    });
    // As the loader asks: with fields of its own, too.
    let answer = ask(&format!("/manifest?job={id}&viewer=1"), &[]);
    assert_eq!((answer.status, answer.header("content-type")), (200, "application/json"));
    let manifest: Manifest = serde_json::from_slice(&answer.body).expect("a manifest");
    assert_eq!(manifest.name.as_deref(), Some("dipole"));
    let [DataSource::StaticFile { url, .. }] = &manifest.sources[..] else {
        panic!("{manifest:?}");
    };
    // The address is signed: the loader sends its own token to the manifest, not to the files.
    let whole = server.get(url);
    assert_whole_log(&whole.body);
    let part = server.send("GET", url, &[("range", "bytes=8-99")], None);
    assert_eq!((part.status, &part.body[..]), (206, &whole.body[8..100]));

    server.get(&format!("/manifest?job={id}")).problem(401, "unauthorized");
    ask("/manifest", &[]).problem(400, "bad_query");
    for unknown in ["", "nothing", "01999999-9999-7999-8999-999999999999"] {
        ask(&format!("/manifest?job={unknown}"), &[]).problem(404, "unknown_job");
    }
    let running = submit(&long());
    ask(&format!("/manifest?job={running}"), &[]).problem(409, "log_unfinished");
}

#[test]
fn a_scenario_is_given_back_as_it_was_sent() {
    let data = directory();
    let server = service(&data).start();
    let sent = format!("{{ \"$schema\": \"scenario.schema.json\",\n{}", &short().to_string()[1..]);
    let answer = server.post("/jobs", sent.as_bytes());
    assert_eq!(answer.status, 202, "{}", answer.text());
    let job = answer.json();
    let id = job["id"].as_str().expect("an id").to_owned();
    let path = job["links"]["sent"].as_str().expect("a link").to_owned();
    assert_eq!(server.get(&path).text(), sent);
    // The scenario that runs is without it, and with every default.
    let accepted = server.get(&format!("/jobs/{id}/scenario.json"));
    assert!(accepted.json()["$schema"].is_null() && accepted.json()["log"]["epoch"].is_string());
    server.wait(&id, "succeeded");
    let text = super::record(&data, &id).join("sent.json");
    std::fs::remove_file(text).expect("kept");
    assert_eq!(server.get(&path).body, accepted.body, "as a job of an older build");
    server.get("/jobs/no-id/sent.json").problem(404, "unknown_job");

    let mut wrong = short();
    wrong["$schema"] = json!(1);
    let refused = server.post("/jobs", wrong.to_string().as_bytes());
    assert_eq!(refused.problem(422, "invalid_input")["pointer"], "/$schema");
}

#[test]
fn jobs_are_found_by_a_part_of_their_names() {
    let data = directory();
    let server = service(&data).start();
    let named = |name: &str| {
        let mut scenario = short();
        scenario["name"] = json!(name);
        server.submit(&scenario)
    };
    let ids = ["Große Spindel 1", "top", "große spindel 2"].map(named);
    let page = server.get("/jobs?name=GRO%C3%9FE%20sp&limit=1").json();
    assert_eq!(page["jobs"][0]["id"], ids[2]);
    let next = server.get(page["links"]["next"].as_str().expect("more")).json();
    assert_eq!((&next["jobs"][0]["id"], &next["links"]["next"]), (&json!(ids[0]), &json!(null)));
    assert_eq!(server.get("/jobs?name=none").json()["jobs"], json!([]));
    server.get(&format!("/jobs?name={}", "x".repeat(201))).problem(400, "bad_query");
}

#[test]
fn an_ensemble_is_a_job_like_any_other() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = short();
    scenario["ensemble"] = json!({ "members": 20, "seed": 3, "attitude_spread_rad": 0.1 });
    let id = server.submit(&scenario);
    let job = server.wait(&id, "succeeded");
    assert_eq!(job["progress"]["steps"], 2000);
    assert_eq!(job["progress"]["steps_done"], 2000);
    assert_eq!(job["summary"]["steps"], 100, "of member 0");
    assert_eq!(job["summary"]["ensemble"]["members"], 20);
    assert_eq!(job["summary"]["ensemble"]["succeeded"], 20);
    assert_whole_log(&server.get(&format!("/jobs/{id}/log.mcap")).body);
    // For an ensemble, views of a single body show member 0.
    let attitudes = server.get(&format!("/jobs/{id}/attitudes.json"));
    assert_eq!(attitudes.status, 200);
    assert_eq!(server.get(&format!("/jobs/{id}/charts/energy.svg")).status, 200);
}

#[test]
fn a_numerical_failure_is_a_result_with_a_finished_log() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = short();
    scenario["step_s"] = json!(10);
    let id = server.submit(&scenario);
    let job = server.wait(&id, "failed");
    assert_eq!(job["summary"]["outcome"], "failed");
    assert!(job["diagnosis"]["code"].as_str().is_some_and(|code| !code.is_empty()), "{job}");
    assert!(job["diagnosis"]["step"].is_u64());
    assert_whole_log(&server.get(&format!("/jobs/{id}/log.mcap")).body);
}

#[test]
fn the_same_job_gives_the_same_bytes() {
    let data = directory();
    let server = service(&data).workers(2).start();
    let ids = [server.submit(&short()), server.submit(&short())];
    let logs = ids.map(|id| {
        server.wait(&id, "succeeded");
        server.get(&format!("/jobs/{id}/log.mcap")).body
    });
    assert!(logs[0] == logs[1]);
}

#[test]
fn viewers_use_the_public_address_where_there_is_one() {
    let data = directory();
    let server = service(&data).public_url("https://example.org/vpd/").start();
    let id = server.finished();
    let link = server.job(&id)["links"]["viewers"]["rerun"].as_str().expect("a link").to_owned();
    assert!(
        link.ends_with(&format!("https%3A%2F%2Fexample.org%2Fvpd%2Fjobs%2F{id}%2Flog.mcap")),
        "{link}"
    );
}

#[test]
fn a_running_job_is_cancelled_within_a_second_and_keeps_a_finished_log() {
    let data = directory();
    let server = service(&data).start();
    let id = server.running();
    let log = server.get(&format!("/jobs/{id}/log.mcap"));
    log.problem(409, "log_unfinished");
    assert!(
        log.header("retry-after").parse::<u64>().is_ok_and(|seconds| (1..=60).contains(&seconds))
    );
    let forget = server.send("DELETE", &format!("/jobs/{id}"), &[], None);
    forget.problem(409, "job_running");

    let asked = Instant::now();
    let cancel = server.send("POST", &format!("/jobs/{id}/cancel"), &[], Some(b""));
    assert!([200, 202].contains(&cancel.status));
    let job = server.wait(&id, "cancelled");
    println!("cancelled after {:?}", asked.elapsed());
    assert_eq!(job["summary"]["outcome"], "cancelled");
    assert_whole_log(&server.get(&format!("/jobs/{id}/log.mcap")).body);

    server.send("POST", &format!("/jobs/{id}/cancel"), &[], Some(b"")).problem(409, "job_ended");
    assert_eq!(server.send("DELETE", &format!("/jobs/{id}"), &[], None).status, 204);
    server.send("DELETE", &format!("/jobs/{id}"), &[], None).problem(404, "unknown_job");
    server.get(&format!("/jobs/{id}/log.mcap")).problem(404, "unknown_job");
    assert!(!super::record(&data, &id).exists());
}

#[test]
fn a_waiting_job_is_cancelled_or_forgotten_at_once() {
    let data = directory();
    let server = service(&data).start();
    server.running();
    let (first, second) = (server.submit(&short()), server.submit(&short()));
    let cancel = server.send("POST", &format!("/jobs/{first}/cancel"), &[], Some(b""));
    assert_eq!(cancel.status, 200);
    assert_eq!(cancel.json()["state"], "cancelled");
    server.get(&format!("/jobs/{first}/log.mcap")).problem(404, "no_log");
    assert_eq!(server.send("DELETE", &format!("/jobs/{second}"), &[], None).status, 204);
    server.get(&format!("/jobs/{second}")).problem(404, "unknown_job");
}

#[test]
fn the_list_is_newest_first_in_pages_and_by_state() {
    let data = directory();
    let server = service(&data).start();
    let mut ids: Vec<_> = (0..5).map(|_| server.finished()).collect();
    let running = server.running();
    ids.push(running.clone());
    ids.reverse();

    let (mut seen, mut link) = (Vec::new(), "/jobs?limit=4".to_owned());
    loop {
        let page = server.get(&link).json();
        let jobs = page["jobs"].as_array().expect("jobs");
        seen.extend(jobs.iter().map(|job| job["id"].as_str().expect("an id").to_owned()));
        match page["links"]["next"].as_str() {
            Some(next) => next.clone_into(&mut link),
            None => break assert!(page["next_cursor"].is_null()),
        }
    }
    assert_eq!(seen, ids);
    let listed = server.get("/jobs?state=running").json();
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(1));
    assert_eq!(listed["jobs"][0]["id"], running.as_str());
    let page = server.get("/jobs?state=succeeded&limit=2").json();
    let next = server.get(page["links"]["next"].as_str().expect("more")).json();
    assert_eq!(next["jobs"][0]["id"], ids[3].as_str());
    for (query, wanted) in [
        (
            "stat=running",
            "unknown field `stat`, expected one of `state`, `name`, `limit`, `cursor`",
        ),
        ("state=asleep", "state: unknown variant `asleep`, expected one of `queued`"),
        ("limit=0", "limit: \"0\" given, 1 to 500 are allowed"),
        ("limit=501", "limit: \"501\" given, 1 to 500 are allowed"),
        ("limit=abc", "limit: \"abc\" given, 1 to 500 are allowed"),
        ("cursor=1", "cursor: \"1\" given, a `next_cursor` of this list is needed"),
        ("limit=1&limit=2", "duplicate field `limit`"),
    ] {
        let problem = server.get(&format!("/jobs?{query}")).problem(400, "bad_query");
        let detail = problem["detail"].as_str().expect("text");
        assert!(detail.contains(wanted), "{query}: {detail}");
    }
}

#[test]
fn a_full_queue_says_so_and_takes_jobs_again() {
    let data = directory();
    let server = service(&data).queue_limit(2).start();
    let running = server.running();
    let waiting = [server.submit(&short()), server.submit(&short())];
    let refused = server.post("/jobs", short().to_string().as_bytes());
    refused.problem(429, "queue_full");
    assert!(refused.header("retry-after").parse::<u64>().is_ok());
    server.send("POST", &format!("/jobs/{running}/cancel"), &[], Some(b""));
    for id in waiting {
        server.wait(&id, "succeeded");
    }
    server.finished();
}

#[test]
fn two_workers_run_two_jobs_at_once() {
    let data = directory();
    let server = service(&data).workers(2).start();
    let ids = [server.running(), server.running()];
    assert!(ids.iter().all(|id| server.job(id)["state"] == "running"));
}

#[test]
fn ids_that_are_none_are_unknown_jobs() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let upper = id.to_uppercase();
    let long = "0".repeat(10_000);
    for id in [
        "01999999-9999-7999-8999-999999999999",
        "nonsense",
        "%2e%2e%2f%2e%2e%2fetc%2fpasswd",
        "%252e%252e%252f",
        "..%5c..%5c",
        "%00",
        "%ff",
        &upper,
        &id.replace('-', ""),
        &format!("{id}."),
        &long,
    ] {
        for tail in ["", "/log.mcap", "/scenario.json"] {
            server.get(&format!("/jobs/{id}{tail}")).problem(404, "unknown_job");
        }
        server
            .send("POST", &format!("/jobs/{id}/cancel"), &[], Some(b""))
            .problem(404, "unknown_job");
        server.send("DELETE", &format!("/jobs/{id}"), &[], None).problem(404, "unknown_job");
    }
    assert!(
        server
            .raw(b"GET /jobs/../../etc/passwd HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            .contains(" 404 ")
    );
}

#[test]
fn bad_bodies_are_refused_with_a_reason() {
    let data = directory();
    let server = service(&data).start();
    for body in ["", "{", "nonsense", "{} x", "\u{feff}\u{feff}{}", &"[".repeat(100_000)] {
        server.post("/jobs", body.as_bytes()).problem(400, "malformed_json");
    }
    server.post("/jobs", b"{\"name\": \"\xff\"}").problem(400, "malformed_json");

    let mut negative = short();
    negative["scene"]["inertia"]["principal"][2] = json!(-0.01);
    let problem =
        server.post("/jobs", negative.to_string().as_bytes()).problem(422, "invalid_input");
    let pointer = problem["pointer"].as_str().expect("a pointer");
    assert!(pointer.starts_with("/scene/inertia/principal"), "{pointer}");
    let mut none = short();
    none["steps"] = json!(0);
    let problem = server.post("/jobs", none.to_string().as_bytes()).problem(422, "invalid_input");
    assert_eq!(problem["pointer"], "/steps");
    let mut unknown = short();
    unknown["colour"] = json!("red");
    server.post("/jobs", unknown.to_string().as_bytes()).problem(422, "invalid_input");
    assert_eq!(server.get("/jobs").json()["jobs"], json!([]));
}

#[test]
fn only_plain_json_of_a_mebibyte_at_most_is_read() {
    let data = directory();
    let server = service(&data).start();
    let body = short().to_string();
    for kind in ["text/plain", "application/x-www-form-urlencoded", "application/jsonx", "json", ""]
    {
        let answer = server.send("POST", "/jobs", &[("content-type", kind)], Some(body.as_bytes()));
        answer.problem(415, "unsupported_media_type");
    }
    server.send("POST", "/jobs", &[], Some(body.as_bytes())).problem(415, "unsupported_media_type");
    let zipped = [("content-type", "application/json"), ("content-encoding", "gzip")];
    server
        .send("POST", "/jobs", &zipped, Some(body.as_bytes()))
        .problem(415, "unsupported_media_type");
    for kind in ["application/json; charset=utf-8", "Application/JSON", "application/vnd.vpd+json"]
    {
        let answer = server.send("POST", "/jobs", &[("content-type", kind)], Some(body.as_bytes()));
        assert_eq!(answer.status, 202, "{kind}");
    }

    let head = "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nConnection: close\r\n";
    let announced = server
        .raw(format!("{head}Expect: 100-continue\r\nContent-Length: 1048577\r\n\r\n").as_bytes());
    assert!(announced.starts_with("HTTP/1.1 413 "), "{announced}");
    assert!(announced.contains("\"code\":\"too_large\""), "{announced}");
    // A chunk of a mebibyte and a byte, and no more: the answer comes before the end of the body.
    let chunked =
        format!("{head}Transfer-Encoding: chunked\r\n\r\n100001\r\n{}", " ".repeat(0x10_0001));
    let answer = server.raw(chunked.as_bytes());
    assert!(answer.starts_with("HTTP/1.1 413 "), "{answer}");
}

#[test]
fn addresses_and_methods_that_are_not_there_are_problems() {
    let data = directory();
    let server = service(&data).start();
    for path in ["/nothing", "/jobs/", "/scenarios/nothing", "/scenarios/%2e%2e%2fCargo.toml"] {
        server.get(path).problem(404, "not_found");
    }
    let delete = server.send("DELETE", "/jobs", &[], None);
    delete.problem(405, "method_not_allowed");
    let mut allowed: Vec<_> = delete.header("allow").split(',').collect();
    allowed.sort_unstable();
    assert_eq!(allowed, ["GET", "HEAD", "POST"]);
    let put =
        server.send("PUT", "/jobs/01999999-9999-7999-8999-999999999999/log.mcap", &[], Some(b""));
    put.problem(405, "method_not_allowed");
    assert_eq!(put.header("allow"), "GET,HEAD");
}

#[test]
fn the_small_routes_answer() {
    let data = directory();
    let server = service(&data).start();
    assert_eq!(server.get("/healthz").json()["status"], "ok");
    assert_eq!(server.get("/readyz").json()["status"], "ready");
    assert!(server.get("/scenario.schema.json").json()["$schema"].is_string());
    let scenarios = server.get("/scenarios").json();
    for scenario in scenarios["scenarios"].as_array().expect("scenarios") {
        let answer = server.get(scenario["links"]["self"].as_str().expect("a link"));
        assert_eq!(answer.status, 200);
        assert_eq!(answer.header("x-content-type-options"), "nosniff");
        assert!(answer.json()["name"].is_string());
    }
    assert_eq!(server.get("/scenarios/dipole.json").body, server.get("/scenarios/dipole").body);
}

#[test]
fn a_client_that_leaves_does_not_undo_its_job() {
    use std::io::Write;
    let data = directory();
    let server = service(&data).start();
    let body = long().to_string();
    let head = "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n";
    let mut stream = std::net::TcpStream::connect(server.address).expect("a connection");
    write!(stream, "{head}Content-Length: {}\r\n\r\n{body}", body.len()).expect("sent");
    until("the job", || server.get("/jobs").json()["jobs"][0]["id"].as_str().map(str::to_owned));
    drop(stream);
    until("the run", || {
        (server.get("/jobs?state=running").json()["jobs"][0]["id"].is_string()).then_some(())
    });
}

#[test]
fn every_bad_scenario_is_answered_with_its_field() {
    let data = directory();
    let server = service(&data).start();
    for Bad { text, pointer } in crate::bad_scenarios::table() {
        let problem = server.post("/jobs", text.as_bytes()).problem(422, "invalid_input");
        assert_eq!(problem["pointer"], pointer, "{text}");
    }
    assert_eq!(server.get("/jobs").json()["jobs"].as_array().map(Vec::len), Some(0));
}
