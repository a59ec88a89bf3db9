//! Pages for people: the page, the layouts, the charts and the attitudes of a job.

use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::{Answer, Server, directory, long, service, short, until};

#[test]
fn the_pages_are_one_file_each_that_may_load_nothing_else() {
    let data = directory();
    let server = service(&data).tokens("admin a-token-of-the-tests").start();
    for path in ["/", "/docs"] {
        may_load_nothing_else(&server.get(path));
    }
}

fn may_load_nothing_else(page: &Answer) {
    assert_eq!((page.status, page.header("content-type")), (200, "text/html; charset=utf-8"));
    let text = String::from_utf8(page.body.clone()).expect("text");
    let policy = page.header("content-security-policy");
    for (open, close, directive) in
        [("<style>", "</style>", "style-src"), ("<script>", "</script>", "script-src")]
    {
        let (_, rest) = text.split_once(open).expect("an element");
        let (inside, _) = rest.split_once(close).expect("its end");
        assert!(inside.len() > 300);
        let hash = base64(&Sha256::digest(inside));
        assert!(policy.contains(&format!("{directive} 'sha256-{hash}'")), "{policy}");
    }
    assert!(policy.starts_with("default-src 'none';"), "{policy}");
    assert!(!text.contains("src=\"http") && !text.contains("href=\"http"));
}

/// RFC 4648, written independently.
fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |three: &[u8]| {
        let bits = three.iter().fold(0, |bits, byte| bits << 8 | u32::from(*byte));
        let bits = bits << (8 * (3 - three.len()));
        (0..4).map(move |k| bits >> (18 - 6 * k) & 63).enumerate().map({
            let length = three.len();
            move |(k, six)| if k > length { '=' } else { char::from(LETTERS[six as usize]) }
        })
    };
    bytes.chunks(3).flat_map(group).collect()
}

#[test]
fn layouts_name_topics_and_fields_that_logs_have() {
    let data = directory();
    let server = service(&data).start();
    for name in ["foxglove.json", "lichtblick.json"] {
        let layout =
            server.get_with(&format!("/layouts/{name}"), &[("origin", "https://a.example")]);
        assert_eq!(layout.header("access-control-allow-origin"), "*");
        let layout = layout.json();
        let panels = layout["configById"].as_object().expect("panels");
        let paths = panels.values().filter_map(|panel| panel["paths"].as_array()).flatten();
        let paths: Vec<_> = paths.filter_map(|path| path["value"].as_str()).collect();
        for path in [
            "/energy.log10_abs_error",
            "/orthogonality.log10_error",
            "/momentum.log10_drift",
            "/solver.iterations",
        ] {
            assert!(paths.contains(&path), "{path}");
        }
        let proto = include_str!("../../../src/log/vpd.proto");
        for path in paths {
            let (_, field) = path.split_once('.').expect("a field");
            let field = field.split('[').next().expect("a name");
            assert!(proto.contains(&format!(" {field} = ")), "{path}");
        }
        let energy = &layout["configById"]["Plot!energy"];
        assert_eq!((&energy["minYValue"], &energy["maxYValue"]), (&json!(-20), &json!(0)));
    }
    server.get("/layouts/other.json").problem(404, "not_found");
}

#[test]
fn a_running_job_leads_to_the_live_view() {
    let data = directory();
    let server = service(&data).live().start();
    let id = server.running();
    let links = &server.job(&id)["links"];
    let viewers = &links["live_viewers"];
    let address = viewers["address"].as_str().expect("an address");
    let port = address.strip_prefix("ws://127.0.0.1:").expect("of this machine");
    let encoded = format!("ds=foxglove-websocket&ds.url=ws%3A%2F%2F127.0.0.1%3A{port}");
    for viewer in ["foxglove", "foxglove_desktop", "lichtblick_desktop"] {
        let link = viewers[viewer].as_str().expect("a link");
        assert!(link.contains(&encoded), "{link}");
    }
    // A client that calls from elsewhere does not reach the loopback of this machine.
    let far = server.get_with(&format!("/jobs/{id}"), &[("host", "192.0.2.1")]).json();
    assert_eq!((far["id"].as_str(), far["links"].get("live_viewers")), (Some(id.as_str()), None));
    server.post(&format!("/jobs/{id}/cancel"), b"");
    let done = server.wait(&id, "cancelled");
    assert!(done["links"].get("live_viewers").is_none());
}

/// Returns a job of 20,000 steps that has ended, with a sample every k of them.
fn finished(server: &Server, every: u64) -> String {
    let mut scenario = short();
    scenario["steps"] = json!(20_000);
    scenario["log"]["every"] = json!(every);
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    id
}

#[test]
fn charts_are_drawn_from_the_finished_log() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let links = &server.job(&id)["links"];
    for chart in ["energy", "orthogonality", "momentum"] {
        let link = links["charts"][chart].as_str().expect("a link");
        let svg = server.get(link);
        assert_eq!((svg.status, svg.header("content-type")), (200, "image/svg+xml"));
        let text = String::from_utf8(svg.body).expect("text");
        assert!(text.starts_with("<svg") && text.contains("<polyline"), "{chart}");
    }
    server.get(&format!("/jobs/{id}/charts/other.svg")).problem(404, "not_found");
    server.get("/jobs/no-id/charts/energy.svg").problem(404, "unknown_job");

    let mut scenario = short();
    scenario["log"]["channels"] = json!(["/state"]);
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    server.get(&format!("/jobs/{id}/charts/energy.svg")).problem(404, "not_found");
    let id = server.running();
    server.get(&format!("/jobs/{id}/charts/energy.svg")).problem(409, "log_unfinished");
}

#[test]
fn attitudes_are_those_of_the_log_from_any_time_on() {
    let data = directory();
    let server = service(&data).start();
    let id = finished(&server, 10);
    let path = format!("/jobs/{id}/attitudes.json");
    let ask = |query: &str| server.get(&format!("{path}{query}")).json();
    let times = |answer: &Value| -> Vec<f64> {
        let times = answer["time_s"].as_array().expect("times").iter();
        times.map(|time| time.as_f64().expect("a number")).collect()
    };

    let first = ask("?samples=3");
    assert_eq!(times(&first), [0.0, 0.1, 0.2]);
    // The log keeps the state of the scheme: the start, projected to the group, rounding and all.
    let start = first["attitude"][0].as_array().expect("an attitude").iter();
    let given = [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0];
    assert!(start.zip(given).all(|(x, y)| (x.as_f64().expect("a number") - y).abs() < 1e-15));
    assert_eq!(first["end_s"], 200.0);
    assert_eq!(times(&ask("")).len(), 300);
    let late = ask("?from_s=150&samples=2");
    assert_eq!(times(&late), [150.0, 150.1]);
    assert_eq!(times(&ask("?from_s=199.95&samples=9")), [200.0]);
    assert_eq!(times(&ask("?from_s=1e300")), Vec::<f64>::new());
    // Fewer samples, with the angular velocity of the body.
    let sparse = ask("?from_s=10&every_s=0.25&samples=4");
    assert_eq!(times(&sparse), [10.0, 10.3, 10.6, 10.9]);
    for k in 0..4 {
        let part = |name: &str, axis: usize| sparse[name][k][axis].as_f64().expect("a number");
        for (axis, moment) in [1.01, 1.0, 0.01].into_iter().enumerate() {
            let off = part("angular_velocity", axis) * moment - part("body_momentum", axis);
            assert!(off.abs() < 1e-15, "{off}");
        }
    }

    let frames: Vec<_> = first["scene"].as_array().expect("drawings").iter().collect();
    assert_eq!((&frames[0]["frame"], &frames[1]["frame"]), (&json!("body"), &json!("space")));
    assert_eq!(frames[0]["balls"].as_array().map(Vec::len), Some(3));
    let time = "a time in seconds, 0 or more, is allowed";
    for (field, given, wanted) in [
        ("samples", "0", "1 to 2000 are allowed"),
        ("samples", "2001", "1 to 2000 are allowed"),
        ("samples", "few", "1 to 2000 are allowed"),
        ("from_s", "-1", time),
        ("from_s", "inf", time),
        ("every_s", "often", time),
    ] {
        let problem = server.get(&format!("{path}?{field}={given}")).problem(400, "bad_query");
        assert_eq!(problem["detail"], format!("{field}: {given:?} given, {wanted}"));
    }
    server.get(&format!("{path}?other=1")).problem(400, "bad_query");
}

#[test]
fn a_quantity_over_time_comes_in_few_points_with_its_extremes() {
    let data = directory();
    let server = service(&data).start();
    let id = finished(&server, 10);
    let path = server.job(&id)["links"]["samples"].as_str().expect("a link").to_owned();
    let ask = |query: &str| server.get(&format!("{path}{query}")).json();
    let numbers = |list: &Value| -> Vec<f64> {
        let list = list.as_array().expect("a list").iter();
        list.map(|x| x.as_f64().expect("a number")).collect()
    };

    // Every sample is a point of its own.
    let all = ask("?points=5000&channel=energy_error");
    assert_eq!(
        (&all["unit"], &all["each"], &all["end_s"]),
        (&json!("J"), &json!(1), &json!(200.0))
    );
    let whole = numbers(&all["low"][0]);
    assert_eq!((whole.len(), &all["low"]), (2001, &all["high"]));
    let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let few = ask("?points=9");
    let (low, high) = (numbers(&few["low"][0]), numbers(&few["high"][0]));
    assert!((5..=9).contains(&low.len()) && high.len() == low.len());
    assert_eq!((least(&low), most(&high)), (least(&whole), most(&whole)));
    let part = numbers(&ask("?from_s=50&to_s=50.25&points=10")["time_s"]);
    assert_eq!(part, [50.0, 50.1, 50.2]);

    // This log is so long that several threads read it.
    let id = finished(&server, 1);
    let dense = server.get(&format!("/jobs/{id}/samples?points=100")).json();
    let (low, high) = (numbers(&dense["low"][0]), numbers(&dense["high"][0]));
    assert!((50..=100).contains(&low.len()) && high.len() == low.len());
    let part = server.get(&format!("/jobs/{id}/samples?points=5000&from_s=0&to_s=49")).json();
    assert_eq!(part["each"], 1);
    let part = numbers(&part["low"][0]);
    assert!(least(&low) <= least(&part) && most(&high) >= most(&part));
    let times = numbers(&dense["time_s"]);
    let step = dense["each"].as_u64().expect("a number") as f64 * 0.01;
    assert!(times.windows(2).all(|pair| pair[0] < pair[1] && pair[1] - pair[0] < step + 1e-6));
    assert!(times[0] == 0.0 && times[times.len() - 1] > 200.0 - step - 1e-6);
    let all = server.get(&format!("/jobs/{id}/samples?points=5000&from_s=100&to_s=130")).json();
    assert_eq!((numbers(&all["time_s"]).len(), &all["each"]), (3001, &json!(1)));

    // The momentum at the start gives each quantity: J w = m, and g m = (0, 0, -0.01) turned by g.
    let first = |channel: &str| -> Vec<f64> {
        let answer = ask(&format!("?to_s=0&channel={channel}"));
        assert_eq!(answer["channel"], *channel);
        answer["low"].as_array().expect("lines").iter().map(|line| numbers(line)[0]).collect()
    };
    let near = |channel: &str, wanted: &[f64]| {
        let found = first(channel);
        let off = found.iter().zip(wanted).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max);
        assert!(found.len() == wanted.len() && off < 1e-14, "{channel}: {found:?}");
    };
    near("body_momentum", &[0.0, 0.0, -0.01]);
    near("angular_velocity", &[0.0, 0.0, -1.0]);
    near("spatial_momentum", &[0.0, 0.01, 0.0]);
    near("axis_angle", &[0.0, std::f64::consts::FRAC_PI_2, std::f64::consts::FRAC_PI_2]);
    near("orthogonality_error", &[0.0]);
    near("momentum_drift", &[0.0]);

    for (query, pointer, wanted) in [
        ("?channel=other", "/channel", "\"other\" given, one of energy_error, "),
        ("?points=1", "/points", "\"1\" given, 2 to 5000 are allowed"),
        ("?points=5001", "/points", "\"5001\" given, 2 to 5000 are allowed"),
        ("?points=x", "/points", "\"x\" given, 2 to 5000 are allowed"),
        ("?from_s=-1", "/from_s", "\"-1\" given, a time in seconds, 0 or more, is allowed"),
        ("?from_s=2&to_s=1", "/to_s", "\"1\" given, a time of from_s (2 s) or later is allowed"),
        ("?to_s=inf", "/to_s", "\"inf\" given, a time of from_s (0 s) or later is allowed"),
    ] {
        let problem = server.get(&format!("{path}{query}")).problem(422, "invalid_input");
        assert_eq!(problem["pointer"], pointer);
        let detail = problem["detail"].as_str().expect("text");
        assert!(detail.starts_with(wanted), "{query}: {detail}");
    }
    server.get(&format!("{path}?other=1")).problem(400, "bad_query");
    server.get("/jobs/no-id/samples").problem(404, "unknown_job");
    let mut scenario = short();
    scenario["log"]["channels"] = json!(["/state"]);
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    for channel in ["energy_error", "orthogonality_error", "momentum_drift", "spatial_momentum"] {
        let path = format!("/jobs/{id}/samples?channel={channel}");
        server.get(&path).problem(404, "not_found");
    }
    let mut scenario = short();
    scenario["log"]["channels"] = json!(["/energy"]);
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    let none = server.get(&format!("/jobs/{id}/attitudes.json")).json();
    assert_eq!(none["time_s"], json!([]));
}

#[test]
fn several_bodies_stand_where_the_log_says() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../../scenarios/chain.json")).expect("a scenario");
    scenario.as_object_mut().expect("fields").remove("expect");
    scenario["duration_s"] = json!(1.0);
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    let path = format!("/jobs/{id}/attitudes.json");
    let ask = |query: &str| server.get(&format!("{path}{query}")).json();
    let numbers = |list: &Value| -> Vec<f64> {
        list.as_array().expect("a list").iter().map(|x| x.as_f64().expect("a number")).collect()
    };

    let found = ask("");
    let times = numbers(&found["time_s"]);
    assert_eq!((times.len(), times[100], &found["end_s"]), (101, 1.0, &json!(1.0)));
    assert_eq!(found["attitude"], json!([]));
    let bodies = found["bodies"].as_array().expect("bodies");
    let names: Vec<_> = bodies.iter().map(|body| body["name"].as_str().expect("a name")).collect();
    assert_eq!(names, ["upper", "middle", "lower"]);
    for k in [0, 37, 100] {
        // Where a point of a body is: the joints of the chain are closed, and it hangs from its anchor.
        let at = |body: usize, z: f64| -> [f64; 3] {
            let of = |list: &str| numbers(&bodies[body][list][k]);
            let (position, attitude) = (of("position"), of("attitude"));
            std::array::from_fn(|i| position[i] + attitude[3 * i + 2] * z)
        };
        let apart =
            |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max);
        for (above, below) in [
            ([0.0, 0.0, 1.0], at(0, 0.25)),
            (at(0, -0.25), at(1, 0.25)),
            (at(1, -0.25), at(2, 0.25)),
        ] {
            assert!(apart(above, below) < 1e-14, "{above:?} {below:?}");
        }
    }
    // The end is the state that the job ended with, and velocities are those of the places.
    let job = server.get(&format!("/jobs/{id}")).json();
    for body in bodies {
        let last = &job["summary"]["final"]["bodies"][body["name"].as_str().expect("a name")];
        assert_eq!(numbers(&last["position"]), numbers(&body["position"][100]));
        assert_eq!(numbers(&last["body_momentum"]), numbers(&body["body_momentum"][100]));
        let (before, after) = (numbers(&body["position"][49]), numbers(&body["position"][51]));
        let velocity = numbers(&body["velocity"][50]);
        let off = (0..3).map(|i| ((after[i] - before[i]) / 0.02 - velocity[i]).abs());
        assert!(off.fold(0.0, f64::max) < 5e-3);
    }

    // From a time on, and fewer of them: all bodies at the same times.
    let few = ask("?from_s=0.5&every_s=0.02&samples=4");
    assert_eq!(numbers(&few["time_s"]), [0.5, 0.52, 0.54, 0.56]);
    for (few, all) in few["bodies"].as_array().expect("bodies").iter().zip(bodies) {
        for list in ["attitude", "body_momentum", "angular_velocity", "position", "velocity"] {
            assert_eq!(few[list].as_array().map(Vec::len), Some(4), "{list}");
            assert_eq!(few[list][3], all[list][56], "{list}");
        }
    }
    let frames: Vec<_> = found["scene"]
        .as_array()
        .expect("drawings")
        .iter()
        .map(|drawing| &drawing["frame"])
        .collect();
    for frame in names {
        assert!(frames.contains(&&json!(frame)), "{frame}");
    }
}

#[test]
fn the_members_of_an_ensemble_are_compared_and_each_is_a_run_of_its_own() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = short();
    scenario["log"]["channels"] =
        json!(["/state", "/energy", "/ensemble/members", "/ensemble/statistics"]);
    scenario["ensemble"] = json!({ "members": 40, "seed": 3, "attitude_spread_rad": 0.1 });
    let id = server.submit(&scenario);
    server.wait(&id, "succeeded");
    let path = format!("/jobs/{id}/members");
    let ask = |query: &str| server.get(&format!("{path}{query}")).json();
    let numbers = |list: &Value| -> Vec<f64> {
        let list = list.as_array().expect("a list").iter();
        list.map(|x| x.as_f64().expect("a number")).collect()
    };
    let rows = |answer: &Value| answer["rows"].as_array().expect("rows").clone();
    let named = |answer: &Value| -> Vec<u64> {
        rows(answer).iter().map(|row| row["member"].as_u64().expect("a number")).collect()
    };

    // The quantiles are those of the values of all members.
    for channel in ["distance", "axis_angle", "angular_velocity", "energy_error"] {
        let all = ask(&format!("?channel={channel}&order=member&limit=200"));
        assert_eq!((&all["channel"], &all["members"]), (&json!(channel), &json!(40)));
        assert_eq!(named(&all), (0..40).collect::<Vec<_>>());
        let times = numbers(&all["time_s"]);
        assert_eq!((times[0], times[times.len() - 1], times.len()), (0.0, 1.0, 11));
        assert_eq!(all["count"], json!(vec![40; 11]));
        for quantile in all["quantiles"].as_array().expect("quantiles") {
            let part = quantile["part"].as_f64().expect("a number");
            for (k, value) in numbers(&quantile["values"]).into_iter().enumerate() {
                let mut here: Vec<f64> =
                    rows(&all).iter().map(|row| numbers(&row["values"])[k]).collect();
                here.sort_by(f64::total_cmp);
                assert_eq!(value, here[(part * 39.0).ceil() as usize], "{channel} {part} {k}");
            }
        }
        // The order is that of the largest value, and pages follow one another.
        let size = |row: &Value| row["largest"].as_f64().expect("a number");
        let worst = rows(&ask(&format!("?channel={channel}&limit=200")));
        assert!(worst.windows(2).all(|pair| size(&pair[0]) >= size(&pair[1])));
        let best = ask(&format!("?channel={channel}&order=smallest&limit=200"));
        assert!(rows(&best).windows(2).all(|pair| size(&pair[0]) <= size(&pair[1])));
        let page = ask(&format!("?channel={channel}&offset=3&limit=2"));
        assert_eq!(rows(&page), worst[3..5]);
    }
    assert!(numbers(&rows(&ask("?order=member"))[0]["values"]).iter().all(|x| *x == 0.0));
    assert_ne!(ask("?channel=axis_angle&axis=3"), ask("?channel=axis_angle&axis=2"));

    // A member run alone moves as it did among the others.
    let worst = rows(&ask("?channel=axis_angle&axis=3&limit=1"))[0].clone();
    let alone = server.get(&format!("{path}/{}.json", worst["member"]));
    assert_eq!(alone.status, 200);
    assert_eq!(alone.json()["name"], format!("dipole, member {}", worst["member"]));
    assert_eq!(alone.json()["log"]["channels"], json!(["/state", "/energy"]));
    let run = server.submit(&alone.json());
    server.wait(&run, "succeeded");
    let samples = server.get(&format!("/jobs/{run}/samples?channel=axis_angle")).json();
    let single: Vec<f32> = numbers(&samples["high"][2]).iter().map(|x| *x as f32).collect();
    let among: Vec<f32> = numbers(&worst["values"]).iter().map(|x| *x as f32).collect();
    assert_eq!(single, among);

    for (query, pointer, wanted) in [
        ("?channel=other", "/channel", "\"other\" given, one of distance, "),
        ("?channel=axis_angle&axis=4", "/axis", "\"4\" given, the axes are numbered from 1 to 3"),
        ("?axis=0", "/axis", "\"0\" given, the axes are numbered from 1 to 3"),
        ("?axis=z", "/axis", "\"z\" given, the axes are numbered from 1 to 3"),
        ("?order=best", "/order", "\"best\" given, one of largest, "),
        ("?offset=-3", "/offset", "\"-3\" given, a whole number, 0 or more, is allowed"),
        ("?limit=0", "/limit", "\"0\" given, 1 to 200 are allowed"),
        ("?limit=201", "/limit", "\"201\" given, 1 to 200 are allowed"),
    ] {
        let problem = server.get(&format!("{path}{query}")).problem(422, "invalid_input");
        assert_eq!(problem["pointer"], pointer);
        let detail = problem["detail"].as_str().expect("text");
        assert!(detail.starts_with(wanted), "{query}: {detail}");
    }
    server.get(&format!("{path}?other=1")).problem(400, "bad_query");
    server.get(&format!("{path}?channel=momentum_drift")).problem(404, "not_found");
    for member in ["40.json", "-1.json", "1", "x.json"] {
        server.get(&format!("{path}/{member}")).problem(404, "not_found");
    }
    let single = server.finished();
    server.get(&format!("/jobs/{single}/members")).problem(404, "not_found");
    server.get("/jobs/no-id/members").problem(404, "unknown_job");
}

#[test]
fn a_running_job_shows_what_it_has_logged_and_a_waiting_one_nothing() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = long();
    scenario["log"] = json!({ "every": 10, "channels": ["/state", "/energy"] });
    scenario["steps"] = json!(100_000_000);
    let id = server.submit(&scenario);
    let waits = server.submit(&short());
    let samples = until("a chunk on the disk", || {
        let samples = server.get(&format!("/jobs/{id}/samples?points=100"));
        Some(samples)
            .filter(|samples| samples.status == 200)
            .map(|samples| samples.json())
            .filter(|samples| samples["time_s"][0].is_number())
    });
    assert_eq!((&samples["time_s"][0], &samples["end_s"]), (&json!(0.0), &Value::Null));
    let none = server.get(&format!("/jobs/{waits}/samples"));
    none.problem(409, "log_unfinished");
    assert!(none.header("retry-after").parse::<u64>().is_ok());
    server.post(&format!("/jobs/{waits}/cancel"), b"");
    server.get(&format!("/jobs/{waits}/samples")).problem(404, "no_log");
    server.post(&format!("/jobs/{id}/cancel"), b"");
    server.wait(&id, "cancelled");
    assert_eq!(server.get(&format!("/jobs/{id}/samples")).status, 200);
}

#[test]
fn a_running_job_shows_its_beginning() {
    let data = directory();
    let server = service(&data).start();
    let mut scenario = long();
    scenario["steps"] = json!(100_000_000);
    scenario["log"] = json!({ "every": 10, "channels": ["/state"] });
    let id = server.submit(&scenario);
    let stretch = until("a chunk on the disk", || {
        let stretch = server.get(&format!("/jobs/{id}/attitudes.json?samples=5"));
        assert_eq!(stretch.status, 200);
        Some(stretch.json()).filter(|stretch| stretch["time_s"][0].is_number())
    });
    assert_eq!(stretch["time_s"], json!([0.0, 0.1, 0.2, 0.3, 0.4]));
    assert_eq!(stretch["end_s"], Value::Null);
    server.send("POST", &format!("/jobs/{id}/cancel"), &[], Some(b""));
    server.wait(&id, "cancelled");
}
