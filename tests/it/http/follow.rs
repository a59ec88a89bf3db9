//! Following the service: events, the growing log, figures, and the description of its API.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::{PATIENCE, Server, assert_whole_log, directory, long, service, short};

/// Returns the body of an answer as it comes, without its chunk sizes.
fn follow(server: &Server, path: &str) -> BufReader<Box<dyn Read + Send>> {
    let agent: ureq::Agent =
        ureq::Agent::config_builder().timeout_global(Some(2 * PATIENCE)).build().into();
    let answer = agent.get(server.url(path)).call().expect("an answer");
    BufReader::new(Box::new(answer.into_body().into_reader()))
}

/// Returns name and data of each event, until the stream ends.
fn events(stream: impl BufRead) -> impl Iterator<Item = (String, Value)> {
    let mut name = String::new();
    stream.lines().filter_map(move |line| {
        let line = line.expect("text");
        if let Some(event) = line.strip_prefix("event: ") {
            event.clone_into(&mut name);
        }
        let data = line.strip_prefix("data: ")?;
        Some((name.clone(), serde_json::from_str(data).expect("JSON")))
    })
}

#[test]
fn events_tell_a_job_from_queue_to_end() {
    let data = directory();
    let server = service(&data).start();
    let first = server.running();
    let id = server.submit(&short());
    let mut stream = events(follow(&server, &format!("/jobs/{id}/events")));
    let (name, job) = stream.next().expect("an event");
    assert_eq!((name.as_str(), &job["state"]), ("state", &json!("queued")));
    server.send("POST", &format!("/jobs/{first}/cancel"), &[], Some(b""));
    let rest: Vec<_> = stream.collect();
    let (name, job) = rest.last().expect("an event");
    assert_eq!((name.as_str(), &job["state"]), ("state", &json!("succeeded")));
    assert_eq!(job["summary"]["outcome"], "succeeded");
    for (name, data) in &rest {
        match name.as_str() {
            "state" => assert_eq!(data["id"], id.as_str()),
            "progress" => assert!(data["steps_done"].is_u64() && data["durable_step"].is_u64()),
            other => panic!("{other}: {data}"),
        }
    }
    server.get("/jobs/01999999-9999-7999-8999-999999999999/events").problem(404, "unknown_job");
}

#[test]
fn events_of_a_running_job_are_few() {
    let data = directory();
    let server = service(&data).start();
    let id = server.running();
    let asked = Instant::now();
    let told = events(follow(&server, &format!("/jobs/{id}/events"))).take(15).count();
    assert_eq!(told, 15);
    // The first at once, and one in 100 ms from then on, however far the job gets.
    assert!(asked.elapsed() >= Duration::from_millis(1300), "{:?}", asked.elapsed());
    server.send("POST", &format!("/jobs/{id}/cancel"), &[], Some(b""));
}

#[test]
fn events_end_with_the_service() {
    let data = directory();
    let server = service(&data).start();
    let id = server.running();
    let mut stream = events(follow(&server, &format!("/jobs/{id}/events")));
    assert_eq!(stream.next().expect("an event").1["state"], "running");
    let (result, took) = server.stop();
    result.expect("stops in order");
    println!("stopped in {took:?}");
    assert!(stream.all(|(name, _)| name == "progress"));
}

#[test]
fn a_growing_log_streams_to_the_bytes_of_the_finished_one() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = short();
    scenario["steps"] = json!(30_000);
    scenario["log"]["every"] = json!(1);
    let first = server.running();
    let id = server.submit(&scenario);
    let mut live = follow(&server, &format!("/jobs/{id}/live.mcap"));
    server.send("POST", &format!("/jobs/{first}/cancel"), &[], Some(b""));
    let mut bytes = Vec::new();
    live.read_to_end(&mut bytes).expect("ends in order");
    assert_whole_log(&bytes);
    assert_eq!(server.job(&id)["state"], "succeeded");
    assert!(server.get(&format!("/jobs/{id}/log.mcap")).body == bytes);
    assert!(server.get(&format!("/jobs/{id}/live.mcap")).body == bytes);
}

#[test]
fn a_stream_without_an_end_breaks_off() {
    let data = directory();
    let server = service(&data).start();
    let id = server.running();
    let mut stream = TcpStream::connect(server.address).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
    write!(stream, "GET /jobs/{id}/live.mcap HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("sent");
    let mut begin = vec![0; 500];
    stream.read_exact(&mut begin).expect("the beginning");
    server.stop().0.expect("stops in order");
    let mut rest = Vec::new();
    let _ = stream.read_to_end(&mut rest);
    assert!(!rest.ends_with(b"0\r\n\r\n"), "it looks whole");

    let server = service(&data).start();
    server.wait(&id, "running");
    let waiting = server.submit(&long());
    server.send("POST", &format!("/jobs/{waiting}/cancel"), &[], Some(b""));
    server.get(&format!("/jobs/{waiting}/live.mcap")).problem(404, "no_log");
}

#[test]
fn figures_count_what_happened() {
    let data = directory();
    let server = service(&data).start();
    server.finished();
    let mut failing = short();
    failing["step_s"] = json!(10);
    let id = server.submit(&failing);
    let job = server.wait(&id, "failed");
    server.running();
    server.submit(&short());
    let answer = server.get("/metrics");
    assert!(answer.header("content-type").starts_with("application/openmetrics-text"));
    let text = String::from_utf8(answer.body).expect("text");
    let value = |name: &str| -> f64 {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("{name} is missing in\n{text}")).parse().expect("a number")
    };
    assert_eq!(value("vpd_jobs_accepted_total"), 4.0);
    assert_eq!(value("vpd_jobs_ended_total{state=\"succeeded\"}"), 1.0);
    assert_eq!(value("vpd_jobs_ended_total{state=\"failed\"}"), 1.0);
    let code = job["diagnosis"]["code"].as_str().expect("a code");
    assert_eq!(value(&format!("vpd_job_failures_total{{code=\"{code}\"}}")), 1.0);
    assert_eq!(value("vpd_jobs{state=\"queued\"}"), 1.0);
    assert_eq!(value("vpd_jobs{state=\"running\"}"), 1.0);
    assert_eq!(value("vpd_queue_length"), 1.0);
    assert!(value("vpd_log_bytes_total") > 1000.0);
    assert!(value("vpd_steps_total") >= 100.0);
    // The job that failed made no step.
    assert_eq!(value("vpd_step_nanoseconds_count"), 1.0);
    assert!(value("vpd_step_iterations_sum") > 0.0);
    assert!(value("vpd_disk_free_bytes") > 0.0);
    assert!(text.ends_with("# EOF\n"));
}

#[test]
fn the_description_names_every_route_and_nothing_elsewhere() {
    let data = directory();
    let server = service(&data).start();
    let api = server.get("/openapi.json").json();
    let paths = api["paths"].as_object().expect("paths");
    assert!(paths.len() >= 14, "{paths:?}");
    for (path, methods) in paths {
        for method in methods.as_object().expect("methods").keys() {
            let path = path
                .replace("{id}", "01999999-9999-7999-8999-999999999999")
                .replace("{name}", "dipole")
                .replace("{member}", if path.starts_with("/jobs") { "7.json" } else { "7" });
            let answer = server.send(&method.to_uppercase(), &path, &[], None);
            assert_ne!(answer.status, 405, "{method} {path}");
            let nothing = serde_json::from_slice::<Value>(&answer.body).unwrap_or_default();
            assert_ne!(nothing["code"], "not_found", "{method} {path}");
        }
    }
    // Every reference leads somewhere.
    let text = api.to_string();
    for part in text.split("\"$ref\":\"#/components/schemas/").skip(1) {
        let name = part.split('"').next().expect("a name");
        assert!(api["components"]["schemas"][name].is_object(), "{name}");
    }
    // Generators of clients take it: no schema is `true`, parts of a choice have names, each operation a group.
    without_booleans(&api["paths"], "");
    without_booleans(&api["components"], "");
    let schemas = &api["components"]["schemas"];
    for (of, title) in [("Framed", "FramedBody"), ("PotentialTerm", "PotentialTermSpring")] {
        let parts = schemas[of]["oneOf"].as_array().expect("a choice");
        assert!(parts.iter().any(|part| part["title"] == title), "{title}");
    }
    // Of two that have one name a generator leaves the second out.
    let mut titles: Vec<&str> =
        schemas.as_object().expect("schemas").keys().map(String::as_str).collect();
    for parts in ["oneOf", "anyOf"].iter().flat_map(|word| {
        schemas
            .as_object()
            .into_iter()
            .flat_map(|all| all.values())
            .filter_map(|schema| schema[*word].as_array())
    }) {
        titles.extend(parts.iter().filter_map(|part| part["title"].as_str()));
    }
    let count = titles.len();
    titles.sort_unstable();
    titles.dedup();
    assert_eq!(titles.len(), count, "{titles:?}");
    for (field, of) in [("plan", "Plan"), ("summary", "Summary"), ("diagnosis", "JobDiagnosis")] {
        let said = schemas["Job"]["properties"][field].to_string();
        assert!(said.contains(&format!("#/components/schemas/{of}\"")), "{said}");
    }
    for (path, methods) in paths {
        for (method, operation) in methods.as_object().expect("methods") {
            assert!(operation["tags"][0].is_string() && operation["operationId"].is_string());
            let body = &operation["requestBody"]["content"]["application/json"];
            assert_eq!(body["example"].is_object(), body.is_object(), "{method} {path}");
        }
    }
    let docs = String::from_utf8(server.get("/docs").body).expect("text");
    assert!(docs.contains("openapi.json") && !docs.contains("://"), "a page of our own alone");
}

/// Asserts that no schema within is `true` or `false`.
fn without_booleans(value: &Value, at: &str) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| without_booleans(value, at)),
        Value::Object(fields) => {
            for (key, value) in fields {
                let is_schema =
                    at.ends_with("/properties") || ["schema", "items"].contains(&key.as_str());
                assert!(!is_schema || !value.is_boolean(), "{at}/{key}");
                let is_choice = ["oneOf", "anyOf"].contains(&key.as_str());
                assert!(!is_choice || value.is_array(), "{at}/{key}");
                without_booleans(value, &format!("{at}/{key}"));
            }
        }
        _ => {}
    }
}

#[test]
fn what_is_described_of_a_job_is_what_comes() {
    let data = directory();
    let server = service(&data).start();
    let api = server.get("/openapi.json").json();
    let schemas = &api["components"]["schemas"];
    let succeeded = server.finished();
    let failed = {
        let mut scenario = super::short();
        scenario["step_s"] = 5.0.into();
        let id = server.submit(&scenario);
        server.wait(&id, "failed");
        id
    };
    for id in [succeeded, failed] {
        let job = server.get(&format!("/jobs/{id}")).json();
        let mut seen = 0;
        for (field, of) in [("plan", "Plan"), ("summary", "Summary"), ("diagnosis", "Diagnosis")] {
            let Some(found) = job[field].as_object() else { continue };
            seen += 1;
            let described = schemas[of]["properties"].as_object().expect("fields");
            for key in found.keys() {
                assert!(described.contains_key(key), "{of} has no {key}");
            }
            for key in schemas[of]["required"].as_array().expect("fields") {
                assert!(found.contains_key(key.as_str().expect("a name")), "{of} needs {key}");
            }
        }
        assert!(seen >= 2);
    }
}
