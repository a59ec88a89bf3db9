//! Requests that the service keeps out: other names, strangers, too many, too large; and requests
//! that are sent twice and done only once.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use serde_json::{Value, json};

use super::{Answer, PATIENCE, Server, directory, long, service, short};

const READ: &str = "read-token-0123456789";
const SUBMIT: &str = "submit-token-0123456789";
const ADMIN: &str = "admin-token-0123456789";

fn submit_with(server: &Server, key: &str, scenario: &Value) -> Answer {
    let headers = [("content-type", "application/json"), ("idempotency-key", key)];
    server.send("POST", "/jobs", &headers, Some(scenario.to_string().as_bytes()))
}

#[test]
fn one_key_is_one_job_however_often_and_whenever_it_comes() {
    let data = directory();
    let server = service(&data).start();
    let ids: Vec<String> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..20)
            .map(|_| {
                scope.spawn(|| {
                    loop {
                        let answer = submit_with(&server, "the key", &short());
                        if answer.status == 409 {
                            answer.problem(409, "idempotency_key_busy");
                            continue;
                        }
                        assert!([200, 202].contains(&answer.status), "{}", answer.status);
                        break answer.json()["id"].as_str().expect("an id").to_owned();
                    }
                })
            })
            .collect();
        clients.into_iter().map(|client| client.join().expect("an id")).collect()
    });
    assert!(ids.iter().all(|id| *id == ids[0]), "{ids:?}");
    assert_eq!(server.get("/jobs").json()["jobs"].as_array().map(Vec::len), Some(1));
    submit_with(&server, "the key", &long()).problem(422, "idempotency_key_reused");
    submit_with(&server, "", &short()).problem(400, "bad_header");
    submit_with(&server, &"k".repeat(256), &short()).problem(400, "bad_header");
    let other = submit_with(&server, "../../etc/passwd", &short()).json()["id"].clone();
    assert_ne!(other, ids[0].as_str());

    server.wait(&ids[0], "succeeded");
    server.stop().0.expect("stops in order");
    let server = service(&data).start();
    let again = submit_with(&server, "the key", &short());
    assert_eq!((again.status, again.json()["id"].as_str()), (200, Some(ids[0].as_str())));
    // A job that is forgotten takes its key with it.
    assert_eq!(server.send("DELETE", &format!("/jobs/{}", ids[0]), &[], None).status, 204);
    let anew = submit_with(&server, "the key", &short());
    assert_eq!(anew.status, 202);
    assert_ne!(anew.json()["id"], ids[0].as_str());
}

#[test]
fn a_name_that_is_not_ours_is_misdirected() {
    let data = directory();
    let server = service(&data).host("vpd.example").public_url("https://jobs.example/x").start();
    let port = server.address.port();
    for name in [
        "localhost",
        "127.0.0.1",
        "[::1]",
        "10.1.2.3",
        "vpd.example",
        "VPD.example",
        "jobs.example",
    ] {
        let host = format!("{name}:{port}");
        assert_eq!(server.get_with("/healthz", &[("host", &host)]).status, 200, "{name}");
    }
    for name in [
        "evil.example",
        "localhost.evil.example",
        "vpd.example.evil.example",
        "127.0.0.1.evil.example",
    ] {
        server.get_with("/healthz", &[("host", name)]).problem(421, "unknown_host");
    }
    for head in ["", "Host: localhost\r\nHost: evil.example\r\n"] {
        let answer = server
            .raw(format!("GET /healthz HTTP/1.1\r\n{head}Connection: close\r\n\r\n").as_bytes());
        assert!(answer.starts_with("HTTP/1.1 400 "), "{answer}");
    }
}

#[test]
fn a_page_of_another_origin_changes_nothing() {
    let data = directory();
    let listed = "https://app.foxglove.dev".parse().expect("an origin");
    for (setup, named) in [(service(&data), 403), (service(&data).cors(listed), 200)] {
        let server = setup.public_url("https://jobs.example/x").start();
        let id = server.finished();
        let cancel = format!("/jobs/{id}/cancel");
        let own = format!("http://{}", server.address);
        let send = |method: &str, path: &str, headers: &[(&str, &str)]| {
            let json = [&[("content-type", "application/json")], headers].concat();
            server.send(method, path, &json, Some(b"{}"))
        };
        // Programs, our page, our page behind a proxy: past the gate. The job has ended.
        for headers in [
            &[][..],
            &[("origin", own.as_str()), ("sec-fetch-site", "same-origin")],
            &[("origin", &own)],
            &[("origin", "https://jobs.example")],
            &[("origin", "https://elsewhere.example"), ("sec-fetch-site", "same-origin")],
        ] {
            send("POST", &cancel, headers).problem(409, "job_ended");
        }
        let foreign = [
            &[("origin", "https://evil.example")][..],
            &[("origin", "null")],
            &[("origin", "http://localhost:1")],
            &[("sec-fetch-site", "cross-site")],
            &[("origin", "https://evil.example"), ("sec-fetch-site", "same-site")],
        ];
        for headers in foreign {
            for path in ["/jobs", "/studies", &cancel] {
                send("POST", path, headers).problem(403, "foreign_page");
            }
            send("DELETE", &format!("/jobs/{id}"), headers).problem(403, "foreign_page");
            // Reading is another matter.
            assert_eq!(server.get_with(&format!("/jobs/{id}/log.mcap"), headers).status, 200);
        }
        // `*` is for reading; to change anything an origin has to be named.
        let answer = send("POST", &cancel, &[("origin", "https://app.foxglove.dev")]);
        match named {
            403 => answer.problem(403, "foreign_page"),
            _ => answer.problem(409, "job_ended"),
        };
    }
}

#[test]
fn tokens_open_what_their_scope_says() {
    let data = directory();
    let tokens = format!("# ours\nread {READ}\n\nsubmit {SUBMIT}\nadmin {ADMIN}\n");
    let server = service(&data).tokens(&tokens).start();
    let ask = |token: &str, method: &str, path: &str| {
        let bearer = format!("Bearer {token}");
        let headers = [("authorization", bearer.as_str()), ("content-type", "application/json")];
        let body = (method == "POST").then(|| short().to_string().into_bytes());
        server.send(method, path, &headers, body.as_deref())
    };
    for open in ["/healthz", "/readyz", "/openapi.json", "/docs"] {
        assert_eq!(server.get(open).status, 200, "{open}");
    }
    for path in ["/jobs", "/scenarios", "/metrics", "/jobs/01999999-9999-7999-8999-999999999999"] {
        let refused = server.get(path);
        refused.problem(401, "unauthorized");
        assert_eq!(refused.header("www-authenticate"), "Bearer");
    }
    let wrong = ask("read-token-0123456780", "GET", "/jobs").problem(401, "unauthorized");
    assert_eq!(wrong, server.get("/jobs").problem(401, "unauthorized"));
    assert_eq!(ask(READ, "GET", "/jobs").status, 200);
    ask(READ, "POST", "/jobs").problem(403, "forbidden");
    let id = ask(SUBMIT, "POST", "/jobs").json()["id"].as_str().expect("an id").to_owned();
    ask(READ, "POST", &format!("/jobs/{id}/cancel")).problem(403, "forbidden");
    ask(SUBMIT, "DELETE", &format!("/jobs/{id}")).problem(403, "forbidden");
    super::until("the end", || {
        (ask(READ, "GET", &format!("/jobs/{id}")).json()["state"] == "succeeded").then_some(())
    });
    // No address carries a token.
    server.get(&format!("/jobs/{id}/log.mcap?token={READ}")).problem(401, "unauthorized");
    assert_eq!(ask(ADMIN, "DELETE", &format!("/jobs/{id}")).status, 204);

    for bad in ["read", "read short", "write 0123456789abcdef", "read 0123456789 abcdef"] {
        let error = bad.parse::<vpd::serve::Tokens>().expect_err(bad);
        assert!(error.contains("line 1") && !error.contains("0123456789"), "{error}");
    }
}

#[test]
fn other_machines_are_not_served_without_tokens() {
    let data = directory();
    let vpd = |arguments: &[&str]| {
        std::process::Command::new(env!("CARGO_BIN_EXE_vpd"))
            .args(["serve", "--listen", "0.0.0.0:0", "--data"])
            .arg(data.path().join("data"))
            .args(arguments)
            .output()
            .expect("the binary starts")
    };
    let refused = vpd(&[]);
    assert_eq!(refused.status.code(), Some(2));
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("--insecure") && said.contains("--tokens"), "{said}");
    let file = data.path().join("tokens");
    std::fs::write(&file, "read 0123\n").expect("written");
    let refused = vpd(&["--tokens", &file.to_string_lossy()]);
    assert_eq!(refused.status.code(), Some(2));
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("line 1") && !said.contains("0123"), "{said}");
}

#[test]
fn jobs_beyond_the_limits_are_refused_with_the_figures() {
    let data = directory();
    let server = service(&data).limits(|limits| limits.run_s = 100.0).start();
    let refused = server.post("/jobs", long().to_string().as_bytes());
    let problem = refused.problem(422, "too_expensive");
    assert_eq!(problem["pointer"], "/steps");
    assert!(problem["detail"].as_str().is_some_and(|text| text.contains("100 s")), "{problem}");
    // The field that the scenario has is named.
    let mut by_time = long();
    let steps = by_time.as_object_mut().and_then(|fields| fields.remove("steps"));
    let steps = steps.and_then(|steps| steps.as_f64()).expect("a number of steps");
    by_time["duration_s"] = json!(steps * by_time["step_s"].as_f64().expect("a step"));
    let refused = server.post("/jobs", by_time.to_string().as_bytes());
    assert_eq!(refused.problem(422, "too_expensive")["pointer"], "/duration_s");
    drop(server);

    let server = service(&data).limits(|limits| limits.log_bytes = 1_000_000).start();
    let mut scenario = short();
    scenario["steps"] = json!(100_000);
    scenario["log"]["every"] = json!(1);
    let problem =
        server.post("/jobs", scenario.to_string().as_bytes()).problem(422, "log_too_large");
    assert_eq!(problem["pointer"], "/log/every");
    let detail = problem["detail"].as_str().expect("text");
    let advised = detail.split("every ").nth(1).and_then(|rest| rest.split(' ').next());
    let advised: u64 = advised.and_then(|text| text.parse().ok()).expect("a number of steps");
    scenario["log"]["every"] = json!(advised);
    server.submit(&scenario);
    // If samples are given in seconds, the answer is in seconds, too.
    scenario["log"].as_object_mut().expect("an object").remove("every");
    scenario["log"]["every_s"] = scenario["step_s"].clone();
    let problem =
        server.post("/jobs", scenario.to_string().as_bytes()).problem(422, "log_too_large");
    assert_eq!(problem["pointer"], "/log/every_s");
    let detail = problem["detail"].as_str().expect("text");
    let advised_s = detail.split("every ").nth(1).and_then(|rest| rest.split(" s,").next());
    let advised_s: f64 = advised_s.and_then(|text| text.parse().ok()).expect("seconds");
    scenario["log"]["every_s"] = json!(advised_s);
    server.submit(&scenario);
    drop(server);

    // Where not even two samples have room, no spacing is advised.
    let server = service(&data).limits(|limits| limits.log_bytes = 10_000).start();
    let problem =
        server.post("/jobs", scenario.to_string().as_bytes()).problem(422, "log_too_large");
    assert_eq!(problem["pointer"], "/log/channels");
    drop(server);

    let server = service(&data).limits(|limits| limits.reserve_bytes = 1 << 62).start();
    let refused = server.post("/jobs", short().to_string().as_bytes());
    refused.problem(507, "storage_full");
    assert!(refused.header("retry-after").parse::<u64>().is_ok());
}

#[test]
fn a_client_that_asks_too_often_waits() {
    let data = directory();
    let server = service(&data).limits(|limits| limits.requests_per_s = 5).start();
    let answers: Vec<_> = (0..200).map(|_| server.get("/scenarios")).collect();
    let refused: Vec<_> = answers.iter().filter(|answer| answer.status == 429).collect();
    assert!(answers.iter().take(5).all(|answer| answer.status == 200));
    for answer in &refused {
        answer.problem(429, "rate_limited");
        assert!(answer.header("retry-after").parse::<u64>().is_ok_and(|seconds| seconds >= 1));
    }
    // 200 requests at 5 a second would take 39 s; they do not here.
    assert!(!refused.is_empty());
    // Probes of a monitor are not limited.
    for probe in ["/healthz", "/readyz"].repeat(50) {
        assert_eq!(server.get(probe).status, 200);
    }
}

#[test]
fn a_body_that_is_too_large_is_answered_not_cut_off() {
    let data = directory();
    let server = service(&data).start();
    for size in [1 << 20, (1 << 20) + 1, 3 << 20, 12 << 20] {
        let body = vec![b' '; size];
        let answer = server.post("/jobs", &body);
        if size > 1 << 20 {
            answer.problem(413, "too_large");
        } else {
            answer.problem(400, "malformed_json");
        }
    }
    let long_head =
        format!("GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: {}\r\n\r\n", "x".repeat(20_000));
    assert!(server.raw(long_head.as_bytes()).starts_with("HTTP/1.1 431 "));
}

#[test]
fn one_connection_too_many_is_told_so_and_harms_no_other() {
    let data = directory();
    let server = service(&data).limits(|limits| limits.connections_per_client = 3).start();
    let connect = || {
        let mut stream = TcpStream::connect(server.address).expect("a connection");
        stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
        stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("sent");
        let mut begin = [0; 12];
        stream.read_exact(&mut begin).expect("an answer");
        (stream, String::from_utf8_lossy(&begin).into_owned())
    };
    let mut kept: Vec<_> = (0..3).map(|_| connect()).collect();
    assert!(kept.iter().all(|(_, begin)| begin == "HTTP/1.1 200"));
    let (mut refused, begin) = connect();
    assert_eq!(begin, "HTTP/1.1 503");
    let mut rest = String::new();
    // It ends, and not with a reset.
    refused.read_to_string(&mut rest).expect("the whole answer");
    assert!(rest.to_lowercase().contains("retry-after: 1\r\n"), "{rest}");
    assert!(rest.contains("\"code\":\"too_many_connections\""), "{rest}");
    kept.clear();
    super::until("a free place", || (connect().1 == "HTTP/1.1 200").then_some(()));
}

#[test]
fn waves_beyond_the_limit_are_all_answered() {
    const WAVES: usize = 5;
    const WAVE: usize = 60;
    let data = directory();
    let server = service(&data).limits(|limits| limits.connections_per_client = 20).start();
    let text = short().to_string();
    let post = format!(
        "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{text}",
        text.len()
    );
    let (mut taken, mut refused) = (0, 0);
    for _ in 0..WAVES {
        // All of a wave are open at once.
        let wave: Vec<TcpStream> =
            (0..WAVE).map(|_| TcpStream::connect(server.address).expect("a connection")).collect();
        for mut stream in &wave {
            stream.write_all(post.as_bytes()).expect("sent");
        }
        for mut stream in &wave {
            stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
            let mut begin = [0; 12];
            stream.read_exact(&mut begin).expect("an answer, no reset");
            match &begin {
                b"HTTP/1.1 202" => taken += 1,
                b"HTTP/1.1 503" => refused += 1,
                other => panic!("{}", String::from_utf8_lossy(other)),
            }
        }
    }
    assert_eq!(taken + refused, WAVES * WAVE);
    // Fewer places than a wave are there, and some of each wave have one.
    assert!(refused >= WAVES && taken >= WAVES, "{taken} taken, {refused} refused");
    // The clients of the last wave close at any time.
    let jobs = super::until("a free place", || {
        let answer = server.get("/jobs?limit=500");
        (answer.status == 200).then(|| answer.json())
    });
    assert_eq!(jobs["jobs"].as_array().map(Vec::len), Some(taken));
}

#[test]
fn who_says_nothing_is_closed() {
    let data = directory();
    let server = service(&data).start();
    let mut silent = TcpStream::connect(server.address).expect("a connection");
    let mut dripping = TcpStream::connect(server.address).expect("a connection");
    dripping.write_all(b"GET /healthz HT").expect("sent");
    for stream in [&mut silent, &mut dripping] {
        stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a socket");
        let mut rest = Vec::new();
        stream.read_to_end(&mut rest).expect("closed, not left waiting");
    }
    assert_eq!(server.get("/healthz").status, 200);
}

#[test]
fn what_is_wrong_is_told_shortly() {
    let data = directory();
    let server = service(&data).start();
    let key = "k".repeat(500_000);
    let mut scenario = short();
    scenario["scene"][&key] = json!(1);
    let refused = server.post("/jobs", scenario.to_string().as_bytes());
    let problem = refused.problem(422, "invalid_input");
    // The field is too long to name; the one it lies in is not.
    assert_eq!(problem["pointer"], "/scene");
    assert!(refused.body.len() < 2000, "{} bytes", refused.body.len());
    let mut scenario = short();
    scenario[&key] = json!(1);
    let problem =
        server.post("/jobs", scenario.to_string().as_bytes()).problem(422, "invalid_input");
    assert_eq!(problem["pointer"], "");
    let mut scenario = short();
    scenario["scene"]["unknown"] = json!(1);
    let problem =
        server.post("/jobs", scenario.to_string().as_bytes()).problem(422, "invalid_input");
    assert_eq!(problem["pointer"], "/scene/unknown");
}

#[test]
fn what_is_forgotten_while_it_is_read_is_not_found() {
    const ROUNDS: usize = 20;
    const PARTS: [&str; 5] =
        ["", "/log.mcap", "/scenario.json", "/attitudes.json", "/charts/energy.svg"];
    let data = directory();
    let server = service(&data).workers(2).start();
    for _ in 0..ROUNDS {
        let id = server.finished();
        std::thread::scope(|scope| {
            for part in PARTS {
                let path = format!("/jobs/{id}{part}");
                let server = &server;
                scope.spawn(move || {
                    loop {
                        match server.get(&path).status {
                            200 => {}
                            404 => break,
                            status => panic!("{status} for {path}"),
                        }
                    }
                });
            }
            assert_eq!(server.send("DELETE", &format!("/jobs/{id}"), &[], None).status, 204);
        });
    }
    // Files that another process removed: the job is known, and its log should be there.
    let id = server.finished();
    let place = super::record(&data, &id);
    for name in ["log.mcap", "scenario.json"] {
        std::fs::remove_file(place.join(name)).expect("removed");
    }
    server.get(&format!("/jobs/{id}/scenario.json")).problem(404, "unknown_job");
    for part in ["log.mcap", "attitudes.json", "charts/energy.svg"] {
        server.get(&format!("/jobs/{id}/{part}")).problem(500, "log_damaged");
    }
}
