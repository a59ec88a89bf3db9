//! Studies over HTTP.

use serde_json::{Value, json};

use super::{Server, directory, service, short, until};

fn ask(server: &Server, study: &Value) -> String {
    let answer = server.post("/studies", study.to_string().as_bytes());
    assert_eq!(answer.status, 202, "{}", answer.json());
    let location = answer.header("location").to_owned();
    assert_eq!(location, format!("/studies/{}", answer.json()["id"].as_str().expect("an id")));
    location
}

fn ended(server: &Server, location: &str) -> Value {
    until("the study ends", || {
        let study = server.get(location).json();
        let state = study["state"].as_str().expect("a state").to_owned();
        (!["queued", "running"].contains(&state.as_str())).then_some(study)
    })
}

#[test]
fn a_study_has_a_table_and_charts() {
    let data = directory();
    let server = service(&data).start();
    let methods =
        json!([{ "name": "vpd", "tableau": "gauss2" }, { "name": "splitting", "order": 4 }]);
    let location = ask(
        &server,
        &json!({
            "kind": "precision", "scenario": short(), "methods": methods, "until_s": 0.5
        }),
    );
    let study = ended(&server, &location);
    assert_eq!(study["state"], "succeeded", "{study}");
    assert!(study["rows"].as_array().is_some_and(|rows| rows.len() >= 10));
    assert_eq!(study["runs"], study["runs_done"]);
    let links = study["links"].as_array().expect("links");
    assert_eq!(links.len(), 4, "{links:?}");
    for link in links {
        let link = link.as_str().expect("an address");
        let answer = server.get(link);
        assert_eq!(answer.status, 200, "{link}");
        let chart = link.ends_with(".svg");
        let kind = if chart { "image/svg+xml" } else { "text/csv" };
        assert_eq!(answer.header("content-type"), kind);
    }
    let map = ask(
        &server,
        &json!({
            "kind": "stability", "scenario": short(), "methods": [{ "name": "rkmk", "tableau": "rk4" }]
        }),
    );
    let map = ended(&server, &map);
    assert_eq!(map["borders"][0]["label"], "rkmk rk4", "{map}");
    server.get("/studies/0190b5a8-0000-7000-8000-000000000000").problem(404, "unknown_study");
    server.get(&format!("{location}/charts/nothing.svg")).problem(404, "no_file");
}

#[test]
fn studies_are_listed_and_outlive_the_service() {
    let data = directory();
    let methods = json!([{ "name": "vpd", "tableau": "gauss2" }]);
    let study = |kind: &str, steps: u64| {
        let mut scenario = short();
        scenario["steps"] = json!(steps);
        json!({ "kind": kind, "scenario": scenario, "methods": methods })
    };
    let server = service(&data).start();
    let done = ask(&server, &study("long_term", 100));
    let before = ended(&server, &done);
    let table = server.get(&format!("{done}/table.csv")).body;
    let stopped = ask(&server, &study("long_term", 100));
    server.post(&format!("{stopped}/cancel"), b"");
    let stopped_state = ended(&server, &stopped)["state"].clone();
    // It takes seconds: the stop comes while it runs or waits.
    let cut = ask(&server, &study("long_term", 1_000_000));
    drop(server);

    let server = service(&data).start();
    assert_eq!(server.get(&done).json(), before);
    assert_eq!(server.get(&format!("{done}/table.csv")).body, table);
    assert_eq!(server.get(&stopped).json()["state"], stopped_state);
    let list = server.get("/studies").json();
    let list = list["studies"].as_array().expect("studies");
    let id = |location: &str| json!(location.rsplit('/').next());
    let ids: Vec<_> = list.iter().map(|study| study["id"].clone()).collect();
    assert_eq!(ids, [id(&cut), id(&stopped), id(&done)]);
    assert!(list.iter().all(|study| study.get("rows").is_none() && study["created"].is_string()));
    // It is made again, and to its end.
    assert_eq!(ended(&server, &cut)["state"], "succeeded");
    assert_eq!(server.send("DELETE", &done, &[], None).status, 204);
    server.get(&done).problem(404, "unknown_study");
    drop(server);

    let result = data.path().join("data").join(&cut[1..]).join("result.json");
    let damaged =
        std::fs::read_to_string(&result).expect("a result").replace("succeeded", "cancelled");
    std::fs::write(&result, damaged).expect("written");
    let server = service(&data).start();
    server.get(&done).problem(404, "unknown_study");
    let cut = server.get(&cut).json();
    assert_eq!((&cut["state"], &cut["name"]), (&json!("failed"), &json!("dipole")), "{cut}");
}

#[test]
fn a_study_that_cannot_be_made_is_refused_at_its_field() {
    let data = directory();
    let server = service(&data).start();
    let mut bad = short();
    bad["scene"]["inertia"]["principal"][2] = json!(0);
    for (study, pointer) in [
        (json!({ "kind": "precision", "scenario": bad }), "/scenario/scene/inertia/principal/2"),
        (json!({ "kind": "guess", "scenario": short() }), "/kind"),
        (json!({ "kind": "stability" }), ""),
        (json!({ "kind": "precision", "scenario": short(), "until_s": -1 }), "/until_s"),
        (
            json!({ "kind": "precision", "scenario": short(), "methods": [{ "name": "rkmk", "tableau": "gauss2" }] }),
            "/methods/0/tableau",
        ),
    ] {
        let problem =
            server.post("/studies", study.to_string().as_bytes()).problem(422, "invalid_input");
        assert_eq!(problem["pointer"], pointer, "{problem}");
    }
}

#[test]
fn a_cancelled_study_has_no_result() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = short();
    scenario["steps"] = json!(1_000_000);
    let location = ask(&server, &json!({ "kind": "long_term", "scenario": scenario }));
    assert_eq!(server.post(&format!("{location}/cancel"), b"").status, 202);
    assert_eq!(ended(&server, &location)["state"], "cancelled");
    server.get(&format!("{location}/table.csv")).problem(404, "no_file");
}

/// Returns a sweep over the step of the dipole, of `members` members and `steps` steps.
fn sweep(members: u64, steps: u64) -> Value {
    let mut scenario = short();
    scenario["steps"] = json!(steps);
    json!({
        "kind": "sweep", "scenario": scenario,
        "vary": [{
            "name": "spin", "pointer": "/scene/initial/momentum/body/2",
            "values": { "linear": { "from": -0.01, "to": 0.01, "count": members } }
        }],
        "scores": [{ "name": "fastest", "measure": { "largest": "angular_speed" } }]
    })
}

#[test]
fn a_sweep_has_the_table_of_the_command_line() {
    let data = directory();
    let server = service(&data).start();
    let location = ask(&server, &sweep(5, 100));
    let study = ended(&server, &location);
    assert_eq!((&study["state"], &study["runs_done"]), (&json!("succeeded"), &json!(5)), "{study}");
    let table = server.get(&format!("{location}/table.csv"));
    assert_eq!(table.header("content-type"), "text/csv");
    let at = data.path();
    std::fs::write(at.join("sweep.json"), sweep(5, 100).to_string()).expect("written");
    assert_eq!(crate::cli::vpd(at, &["sweep", "sweep.json"]).status.code(), Some(0));
    assert_eq!(table.body, std::fs::read(at.join("sweep.csv")).expect("a table"));
    let links = study["links"].as_array().expect("links");
    assert_eq!(links.len(), 2, "{links:?}");
    let picture = server.get(links[0].as_str().expect("an address"));
    assert_eq!(picture.header("content-type"), "image/svg+xml");
    // A member is a scenario: submitted as a job, it has a log.
    let member = server.get(&format!("{location}/members/4.json"));
    assert_eq!(member.json()["scene"]["initial"]["momentum"]["body"][2], 0.01);
    assert_eq!(server.post("/jobs", &member.body).status, 202);
    server.get(&format!("{location}/members/5.json")).problem(422, "invalid_input");
    server.get(&format!("{location}/members/last.json")).problem(404, "no_file");
    server.get(&format!("{location}/charts/table.csv")).problem(404, "no_file");
}

#[test]
fn a_sweep_that_cannot_be_run_is_refused_at_its_field() {
    let data = directory();
    let server = service(&data).limits(|limits| limits.run_s = 100.0).start();
    let change = |field: &str, value: Value| {
        let mut sweep = sweep(5, 100);
        sweep[field] = value;
        sweep
    };
    for (sweep, pointer, code) in [
        (change("scenario", json!("dipole.json")), "/scenario", "invalid_input"),
        (change("keep_logs", json!([0])), "/keep_logs", "invalid_input"),
        (change("methods", json!([])), "/methods", "invalid_input"),
        (change("vary", json!([])), "/vary", "invalid_input"),
        (sweep(1_000_000, 100_000), "/vary", "too_expensive"),
    ] {
        let problem = server.post("/studies", sweep.to_string().as_bytes()).problem(422, code);
        assert_eq!(problem["pointer"], pointer, "{problem}");
    }
}

#[test]
fn a_sweep_shows_its_lines_gives_way_and_goes_on_after_a_restart() {
    let data = directory();
    let (members, steps) = (100_000, 2000);
    let server = service(&data).start();
    let location = ask(&server, &sweep(members, steps));
    let lines = |server: &Server| {
        let table = server.get(&format!("{location}/table.csv"));
        if table.status != 200 {
            return 0;
        }
        let text = String::from_utf8(table.body).expect("text");
        assert!(text.starts_with("member,spin,outcome") && text.ends_with('\n'), "{text}");
        text.lines().count() - 1
    };
    let first = until("lines", || Some(lines(&server)).filter(|&lines| lines > 10));
    let picture = server.get(&format!("{location}/charts/sweep.svg"));
    assert!(picture.status == 200 && picture.text().contains("<circle"), "{}", picture.status);
    // It would take minutes; a study that is sent later is answered before it ends.
    let later = ask(
        &server,
        &json!({
            "kind": "long_term", "scenario": short(), "methods": [{ "name": "vpd", "tableau": "gauss2" }]
        }),
    );
    assert_eq!(ended(&server, &later)["state"], "succeeded");
    let running = server.get(&location).json();
    assert!(
        ["queued", "running"].contains(&running["state"].as_str().expect("a state")),
        "{running}"
    );
    drop(server);

    let server = service(&data).start();
    let second = until("lines", || Some(lines(&server)).filter(|&lines| lines > first));
    until("progress", || {
        server.get(&location).json()["runs_done"].as_u64().filter(|&done| done > first as u64)
    });
    assert_eq!(server.post(&format!("{location}/cancel"), b"").status, 202);
    assert_eq!(ended(&server, &location)["state"], "cancelled");
    // Its results stay.
    assert!(lines(&server) >= second);
    assert_eq!(server.send("DELETE", &location, &[], None).status, 204);
    server.get(&format!("{location}/table.csv")).problem(404, "unknown_study");
}
