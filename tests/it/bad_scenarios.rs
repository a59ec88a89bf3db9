//! Bad input gets an error that names the field: one table, tried at all three entry points.

use serde_json::{Value, json};
use vpd::plan::Plan;
use vpd::scenario::{PotentialTerm, Scenario, ScenarioError, ScenarioErrorKind};

/// A scenario with one thing wrong, and the pointer of the field that must be named.
pub(crate) struct Bad {
    pub(crate) text: String,
    pub(crate) pointer: String,
}

pub(crate) fn dipole() -> Value {
    serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped")
}

pub(crate) fn so4() -> Value {
    serde_json::from_str(include_str!("../../scenarios/so4-free.json")).expect("shipped")
}

/// Returns a dipole with every optional field written out, so that each can be spoiled.
fn full() -> Value {
    let mut full = dipole();
    full["method"]["solver"] = json!({"kind": "auto", "tolerance": 1e-15, "max_iterations": 50});
    full["log"] = json!({"every": 1, "channels": ["/state"], "compression": "lz4", "epoch": "2026-01-01T00:00:00Z"});
    full["scene"]["potential"] = json!([
        {"kind": "uniform", "weight": 1, "body_point": [0, 0, 1], "direction": [0, 0, 1]},
        {"kind": "point_source", "strength": 1, "body_point": [0, 0.1, -1], "position": [0, 0, -1.5]},
        {"kind": "spring", "stiffness": 1, "rest_length": 0.1, "body_point": [1, 0, 0], "position": [0, 0, 2]},
        {"kind": "gravity_gradient", "strength": 1, "direction": [0, 1, 0], "matrix": [[1, 0, 0], [0, 2, 0], [0, 0, 3]]},
    ]);
    full
}

/// Returns a dipole with everything that can change with time, apply a torque or spin.
fn driven() -> Value {
    let mut driven = full();
    let weight =
        || json!({"kind": "uniform", "weight": 1, "body_point": [0, 0, 1], "direction": [0, 0, 1]});
    let table = || json!({"times_s": [0, 1, 1e4], "values": [1, 2, 3]});
    driven["scene"]["driven"] = json!([
        {"term": weight(), "path": {"turning": {"from": [1, 0, 0], "towards": [0, 1, 0], "rate_rad_s": 1}}},
        {"term": weight(), "path": {"orbit": {"towards": [0, 1, 0], "mean_motion_rad_s": 1, "eccentricity": 0.1}},
         "factor": {"harmonic": {"amplitude": 0.5, "rate_rad_s": 1}}},
        {"term": weight(), "factor": {"table": table()}},
    ]);
    driven["scene"]["torques"] = json!([
        {"constant": {"body": [0, 0, 0.1]}},
        {"table": {"along": {"space": [0, 0, 1]}, "table": table()}},
        {"viscous": {"coefficients": [0.1, 0.1, 0.2]}},
        {"of_momentum": {"rate_per_s": 0.1}},
    ]);
    driven["scene"]["wheels"] = json!([0, 0, 0.1]);
    driven
}

/// Returns `base` with the raw JSON text `raw` at `pointer` (its parent must exist).
fn with(mut base: Value, pointer: &str, raw: &str) -> String {
    const MARK: &str = "@spoiled@";
    let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
    match base.pointer_mut(parent).expect("parent exists") {
        Value::Object(map) => {
            map.insert(key.to_owned(), MARK.into());
        }
        Value::Array(list) => list[key.parse::<usize>().expect("an index")] = MARK.into(),
        _ => panic!("{parent} has no children"),
    }
    base.to_string().replace(&format!("\"{MARK}\""), raw)
}

/// Returns `base` without the field at `pointer`.
fn without(mut base: Value, pointer: &str) -> String {
    let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
    let map = base.pointer_mut(parent).and_then(Value::as_object_mut).expect("parent exists");
    map.remove(key).expect("the field was there");
    base.to_string()
}

#[allow(clippy::too_many_lines)]
pub(crate) fn table() -> Vec<Bad> {
    let mut table = Vec::new();
    let mut add =
        |text: String, pointer: &str| table.push(Bad { text, pointer: pointer.to_owned() });

    // Wrong type: every field against every type it is not.
    let numbers = [
        "/step_s",
        "/steps",
        "/scene/inertia/principal/0",
        "/scene/potential/0/weight",
        "/scene/potential/0/body_point/2",
        "/scene/potential/0/direction/1",
        "/scene/potential/1/strength",
        "/scene/potential/1/position/0",
        "/scene/potential/2/stiffness",
        "/scene/potential/2/rest_length",
        "/scene/potential/3/strength",
        "/scene/potential/3/matrix/1/1",
        "/scene/initial/attitude/matrix/0/0",
        "/scene/initial/momentum/body/2",
        "/method/solver/tolerance",
        "/method/solver/max_iterations",
        "/log/every",
        "/expect/energy_error_max",
    ];
    for pointer in numbers {
        for raw in ["true", "\"1.0\"", "{}", "NaN", "Infinity", "-Infinity", "1e400", "-1e999"] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    // `null` stands for an absent field where a field may be absent.
    let optional = ["/steps", "/log/every", "/expect/energy_error_max"];
    for pointer in numbers.iter().filter(|p| !optional.contains(p)) {
        add(with(full(), pointer, "null"), pointer);
    }
    let lists = [
        "/scene/potential",
        "/scene/potential/0/body_point",
        "/scene/potential/0/direction",
        "/scene/inertia/principal",
        "/scene/initial/attitude/matrix",
        "/scene/initial/momentum/body",
        "/log/channels",
    ];
    for pointer in lists {
        for raw in ["1", "\"text\"", "{}", "false"] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    for pointer in [
        "/scene",
        "/method",
        "/log",
        "/expect",
        "/scene/initial",
        "/scene/potential/0",
        "/method/solver",
    ] {
        for raw in ["1", "\"text\"", "true"] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    for pointer in [
        "/name",
        "/description",
        "/method/name",
        "/log/compression",
        "/log/epoch",
        "/log/channels/0",
    ] {
        for raw in ["1", "[]", "{}", "null"] {
            add(with(full(), pointer, raw), pointer);
        }
    }

    // Missing fields are named by their object, unknown and duplicate keys by themselves.
    for pointer in [
        "/name",
        "/scene",
        "/step_s",
        "/scene/inertia",
        "/scene/potential/0/weight",
        "/scene/potential/0/body_point",
        "/scene/potential/1/position",
        "/scene/potential/2/stiffness",
        "/scene/potential/3/direction",
        "/scene/potential/0/kind",
    ] {
        add(without(full(), pointer), pointer.rsplit_once('/').expect("a pointer").0);
    }
    for parent in [
        "",
        "/scene",
        "/scene/initial",
        "/scene/potential/0",
        "/scene/potential/3",
        "/method",
        "/method/solver",
        "/log",
        "/expect",
    ] {
        for key in ["stepsize", "Name", "weigth"] {
            let pointer = format!("{parent}/{key}");
            add(with(full(), &pointer, "1"), &pointer);
        }
    }
    for (pointer, key) in [
        ("/step_s", "step_s"),
        ("/name", "name"),
        ("/scene/inertia", "inertia"),
        ("/scene/potential/0/weight", "weight"),
        ("/scene/potential/0/kind", "kind"),
        ("/log/every", "every"),
        ("/method/tableau", "tableau"),
    ] {
        add(with(full(), pointer, &format!("1,\"{key}\":1")), pointer);
    }

    // Dimensions that do not fit.
    add(
        with(full(), "/scene/inertia", r#"{"second_moments":[1,2,3,4]}"#),
        "/scene/potential/0/body_point",
    );
    add(
        with(full(), "/scene/inertia", r#"{"second_moments":[1,2]}"#),
        "/scene/potential/0/body_point",
    );
    add(
        with(full(), "/scene/inertia", r#"{"second_moments":[1]}"#),
        "/scene/inertia/second_moments",
    );
    add(
        with(full(), "/scene/inertia", r#"{"second_moments":[]}"#),
        "/scene/inertia/second_moments",
    );
    add(with(full(), "/scene/inertia", "{}"), "/scene/inertia");
    add(with(full(), "/scene/inertia", r#"{"principal":[1,1,1],"matrix":[]}"#), "/scene/inertia");
    add(
        with(full(), "/scene/inertia", r#"{"matrix":[[1,0,0],[0,1e13,0],[0,0,1e13]]}"#),
        "/scene/inertia/matrix/1/1",
    );
    add(with(full(), "/scene/inertia", r#"{"moments":[1,1,1]}"#), "/scene/inertia");
    for n in [17, 31, 33] {
        add(
            with(full(), "/scene/inertia", &format!("{{\"second_moments\":{:?}}}", vec![1.0; n])),
            "/scene/inertia/second_moments",
        );
    }
    for raw in ["[1,2]", "[1,2,3,4]", "[]"] {
        for pointer in [
            "/scene/potential/0/body_point",
            "/scene/potential/1/position",
            "/scene/potential/2/body_point",
            "/scene/potential/3/direction",
            "/scene/initial/momentum/body",
            "/scene/inertia/principal",
        ] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    add(
        with(full(), "/scene/potential/3/matrix", "[[1,0,0],[0,1,0]]"),
        "/scene/potential/3/matrix",
    );
    add(with(full(), "/scene/potential/3/matrix/1", "[1,0]"), "/scene/potential/3/matrix/1");
    add(with(full(), "/scene/potential/3/matrix/1/0", "0.5"), "/scene/potential/3/matrix/1/0");
    add(
        with(full(), "/scene/initial/attitude/matrix/2", "[0,1]"),
        "/scene/initial/attitude/matrix/2",
    );
    add(
        with(so4(), "/scene/initial", r#"{"attitude":{"quaternion":[1,0,0,0]}}"#),
        "/scene/initial/attitude/quaternion",
    );
    add(
        with(
            so4(),
            "/scene/initial",
            r#"{"attitude":{"axis_angle":{"axis":[1,0,0],"angle_rad":1}}}"#,
        ),
        "/scene/initial/attitude/axis_angle",
    );
    add(
        with(so4(), "/scene/initial", r#"{"attitude":{"matrix":[[1,0,0],[0,1,0],[0,0,1]]}}"#),
        "/scene/initial/attitude/matrix",
    );
    add(
        with(so4(), "/scene/initial", r#"{"momentum":{"body":[0,0,1]}}"#),
        "/scene/initial/momentum/body",
    );
    add(
        with(so4(), "/scene/initial", r#"{"momentum":{"space":[[0,1],[-1,0]]}}"#),
        "/scene/initial/momentum/space",
    );
    for channel in ["/tf", "/scene/body", "/scene/sources"] {
        add(
            with(so4(), "/log", &format!("{{\"channels\":[\"/state\",\"{channel}\"]}}")),
            "/log/channels/1",
        );
    }

    // Inertia that is not valid.
    for raw in ["0", "-1", "1e-400", "1e-13", "1e13", "-0.0"] {
        add(with(full(), "/scene/inertia/principal/2", raw), "/scene/inertia/principal/2");
    }
    for raw in
        ["[[1,0,0],[0,1,0],[0,0,0]]", "[[1,2,0],[2,1,0],[0,0,1]]", "[[-1,0,0],[0,1,0],[0,0,1]]"]
    {
        add(
            with(full(), "/scene/inertia", &format!("{{\"matrix\":{raw}}}")),
            "/scene/inertia/matrix",
        );
    }
    add(
        with(full(), "/scene/inertia", r#"{"matrix":[[1,0,0.1],[0,1,0],[0,0,1]]}"#),
        "/scene/inertia/matrix/2/0",
    );
    add(with(so4(), "/scene/inertia/second_moments/0", "-2"), "/scene/inertia/second_moments/1");
    add(with(so4(), "/scene/inertia/second_moments/3", "-1"), "/scene/inertia/second_moments/3");

    // Attitude and momentum that are not valid.
    let attitude = "/scene/initial/attitude";
    for raw in [
        "[[1,0,0],[0,0,-1],[0,1.001,0]]",
        "[[1,0,0],[0,1,0],[0,0,1.0001]]",
        "[[0,0,0],[0,0,0],[0,0,0]]",
        "[[1,0,0],[0,1,0],[0,0,-1]]",
        "[[2,0,0],[0,0.5,0],[0,0,1]]",
        "[[1,0,0.000001],[0,1,0],[0,0,1]]",
    ] {
        add(
            with(full(), attitude, &format!("{{\"matrix\":{raw}}}")),
            "/scene/initial/attitude/matrix",
        );
    }
    for raw in ["[0,0,0,0]", "[2,0,0,0]", "[1,0,0]", "[0.9,0,0,0]", "[1,0,0,0,0]"] {
        add(
            with(full(), attitude, &format!("{{\"quaternion\":{raw}}}")),
            "/scene/initial/attitude/quaternion",
        );
    }
    add(
        with(full(), attitude, r#"{"axis_angle":{"axis":[0,0,0],"angle_rad":1}}"#),
        "/scene/initial/attitude/axis_angle/axis",
    );
    add(
        with(full(), attitude, r#"{"axis_angle":{"axis":[0,0,1],"angle_rad":1e9}}"#),
        "/scene/initial/attitude/axis_angle/angle_rad",
    );
    add(
        with(full(), attitude, r#"{"axis_angle":{"axis":[0,0,1]}}"#),
        "/scene/initial/attitude/axis_angle",
    );
    add(
        with(full(), attitude, r#"{"axis_angle":{"axis":[0,0,1],"angle_rad":1,"angle_deg":90}}"#),
        "/scene/initial/attitude/axis_angle/angle_deg",
    );
    add(
        with(full(), attitude, r#"{"axis_angle":{"axis":[0,0,1],"angle_deg":1e9}}"#),
        "/scene/initial/attitude/axis_angle/angle_deg",
    );
    add(with(full(), attitude, r#"{"rodrigues":[0,0,1]}"#), attitude);
    for (raw, at) in [
        (r#"{"euler":{"sequence":"xxz","angles_rad":[0,0,1]}}"#, "/euler/sequence"),
        (r#"{"euler":{"sequence":"zxz"}}"#, "/euler"),
        (r#"{"euler":{"angles_rad":[0,0,1]}}"#, "/euler"),
        (
            r#"{"euler":{"sequence":"zxz","angles_rad":[0,0,1],"angles_deg":[0,0,1]}}"#,
            "/euler/angles_deg",
        ),
        (r#"{"euler":{"sequence":"zxz","angles_rad":[0,1e7,1]}}"#, "/euler/angles_rad/1"),
        (r#"{"roll_pitch_yaw":{}}"#, "/roll_pitch_yaw"),
        (r#"{"roll_pitch_yaw":{"angles_deg":[1e9,0,0]}}"#, "/roll_pitch_yaw/angles_deg/0"),
        (r#"{"mrp":[0,1e10,0]}"#, "/mrp/1"),
    ] {
        add(with(full(), attitude, raw), &format!("{attitude}{at}"));
    }
    for (raw, at) in [
        (r#"{"euler":{"sequence":"zxz","angles_rad":[0,0,1]}}"#, "euler"),
        (r#"{"roll_pitch_yaw":{"angles_rad":[0,0,1]}}"#, "roll_pitch_yaw"),
        (r#"{"mrp":[0,0,1]}"#, "mrp"),
    ] {
        let initial = format!("{{\"attitude\":{raw}}}");
        add(with(so4(), "/scene/initial", &initial), &format!("{attitude}/{at}"));
    }
    add(with(full(), attitude, "\"identity\""), "/scene/initial/attitude");
    let momentum = "/scene/initial/momentum";
    add(with(full(), momentum, r#"{"inertial":[0,0,1]}"#), momentum);
    add(with(full(), momentum, "[0,0,1]"), momentum);
    add(with(full(), momentum, r#"{"body":[0,[0],1]}"#), "/scene/initial/momentum/body/1");
    add(with(full(), momentum, r#"{"body":[[0,1,0],1,0]}"#), "/scene/initial/momentum/body/1");
    add(
        with(full(), momentum, r#"{"body":[[0,1,0],[1,0,0],[0,0,0]]}"#),
        "/scene/initial/momentum/body/1/0",
    );
    add(
        with(full(), momentum, r#"{"space":[[0.1,0,0],[0,0,0],[0,0,0]]}"#),
        "/scene/initial/momentum/space/0/0",
    );
    add(with(full(), momentum, r#"{"body":[0,0,1e16]}"#), "/scene/initial/momentum/body/2");
    add(
        with(full(), "/scene/initial/angular_velocity", r#"{"body":[0,0,1]}"#),
        "/scene/initial/angular_velocity",
    );

    // A body point on a source at the start; a length below zero; directions without a length.
    add(with(full(), "/scene/potential/1/position", "[0,1,0.1]"), "/scene/potential/1/body_point");
    add(with(full(), "/scene/potential/2/position", "[1,0,0]"), "/scene/potential/2/body_point");
    add(
        with(
            full(),
            "/scene/potential/1",
            r#"{"kind":"point_source","strength":1,"body_point":[0,0,0],"position":[0,0,0]}"#,
        ),
        "/scene/potential/1/body_point",
    );
    add(with(full(), "/scene/potential/2/rest_length", "-0.5"), "/scene/potential/2/rest_length");
    add(with(full(), "/scene/potential/0/direction", "[0,0,0]"), "/scene/potential/0/direction");
    add(
        with(full(), "/scene/potential/3/direction", "[0,1e-400,0]"),
        "/scene/potential/3/direction",
    );
    // Sizes next to zero that are not zero: what follows from them underflows.
    let tiny = [
        "/scene/potential/0/body_point",
        "/scene/potential/0/direction",
        "/scene/potential/1/position",
        "/scene/potential/2/position",
        "/scene/potential/2/body_point",
        "/scene/potential/3/direction",
        "/scene/initial/momentum/body",
    ];
    for pointer in tiny {
        for raw in ["[0,1e-200,0]", "[5e-324,0,1e-320]", "[9e-16,-9e-16,0]"] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    add(
        with(full(), "/scene/potential/3/matrix", "[[1e-200,0,0],[0,0,0],[0,0,0]]"),
        "/scene/potential/3/matrix",
    );
    for pointer in [
        "/scene/potential/0/weight",
        "/scene/potential/1/strength",
        "/scene/potential/2/stiffness",
        "/scene/potential/2/rest_length",
        "/scene/potential/3/strength",
    ] {
        for raw in ["5e-324", "1e-200", "9e-31"] {
            add(with(full(), pointer, raw), pointer);
        }
    }
    add(
        with(full(), "/scene/initial", r#"{"angular_velocity":{"space":[0,0,1e-200]}}"#),
        "/scene/initial/angular_velocity/space",
    );
    add(
        with(
            so4(),
            "/scene/initial",
            r#"{"momentum":{"body":[[0,1e-200,0,0],[-1e-200,0,0,0],[0,0,0,0],[0,0,0,0]]}}"#,
        ),
        "/scene/initial/momentum/body",
    );
    add(with(full(), "/scene/potential/0/kind", "\"magnetic\""), "/scene/potential/0/kind");
    add(with(full(), "/scene/potential/0/kind", "null"), "/scene/potential/0/kind");
    for pointer in [
        "/scene/potential/0/weight",
        "/scene/potential/1/strength",
        "/scene/potential/0/body_point/0",
    ] {
        add(with(full(), pointer, "1e300"), pointer);
    }

    // Steps and durations.
    for raw in
        ["0", "18446744073709551615", "1000000000001", "18446744073709551616", "-1", "1.5", "1e3"]
    {
        add(with(full(), "/steps", raw), "/steps");
    }
    for raw in ["0", "-0.01", "1e-400", "5e-324", "1e-13", "1e10", "-0.0"] {
        add(with(full(), "/step_s", raw), "/step_s");
    }
    for raw in ["0", "2", "1.5", "-1", "\"1\"", "null", "[1]", "true"] {
        add(with(full(), "/format", raw), "/format");
    }
    add(with(full(), "/duration_s", "1000"), "/duration_s");
    add(without(full(), "/steps"), "");
    let timed = || {
        let mut base = full();
        base.as_object_mut().expect("an object").remove("steps");
        base
    };
    for raw in ["0", "-1", "0.015", "1e-3", "1e10", "1e400", "\"10\"", "NaN"] {
        add(with(timed(), "/duration_s", raw), "/duration_s");
    }
    let long = with(full(), "/step_s", "1e5");
    add(with(serde_json::from_str(&long).expect("JSON"), "/steps", "100000"), "/steps");

    // Past the year 2106, in which log times end.
    let mut sparse = timed();
    sparse["log"]["every"] = json!(1_000_000);
    add(with(sparse, "/duration_s", "3.9e9"), "/duration_s");
    let mut long = full();
    (long["step_s"], long["log"]["epoch"]) = (json!(1e3), json!("2099-12-31T23:59:59Z"));
    add(with(long.clone(), "/steps", "200000"), "/steps");
    long["log"]["epoch"] = json!("1990-01-01T00:00:00Z");
    add(with(long, "/steps", "3900000"), "/steps");

    // Tableaux and solvers.
    let tableau = "/method/tableau";
    for raw in ["\"gauss9\"", "\"Gauss2\"", "\"\"", "2", "[[0.5],[1]]"] {
        add(with(full(), tableau, raw), tableau);
    }
    add(with(full(), tableau, r#"{"a":[[0.5]],"b":[1],"c":[0.5]}"#), "/method/tableau/c");
    add(with(full(), tableau, r#"{"a":[[0.5]]}"#), tableau);
    add(with(full(), tableau, r#"{"a":[],"b":[]}"#), "/method/tableau/a");
    add(with(full(), tableau, r#"{"a":[[0,0],[1,0]],"b":[0,1]}"#), "/method/tableau/b/0");
    add(with(full(), tableau, r#"{"a":[[0,0],[1,0]],"b":[1,1e-400]}"#), "/method/tableau/b/1");
    add(with(full(), tableau, r#"{"a":[[0,0],[1,0]],"b":[0.5,0.6]}"#), "/method/tableau/b");
    add(with(full(), tableau, r#"{"a":[[0,0],[1]],"b":[0.5,0.5]}"#), "/method/tableau/a/1");
    add(with(full(), tableau, r#"{"a":[[0]],"b":[0.5,0.5]}"#), "/method/tableau/a");
    add(with(full(), tableau, r#"{"a":[[1e9]],"b":[1]}"#), tableau);
    add(with(full(), tableau, r#"{"a":[["x"]],"b":[1]}"#), "/method/tableau/a/0/0");
    for raw in ["0", "1", "-1e-15", "1e-17", "1e-400"] {
        add(with(full(), "/method/solver/tolerance", raw), "/method/solver/tolerance");
    }
    for raw in ["0", "10001", "-5", "4294967296", "2.5"] {
        add(with(full(), "/method/solver/max_iterations", raw), "/method/solver/max_iterations");
    }
    add(with(full(), "/method/solver/kind", "\"anderson\""), "/method/solver/kind");
    let mut compared = full();
    compared["method"]["name"] = json!("quaternion_gauss");
    add(with(compared, "/method/solver/kind", "\"newton\""), "/method/solver/kind");
    for raw in ["\"leapfrog\"", "\"VPD\"", "\"\""] {
        add(with(full(), "/method/name", raw), "/method/name");
    }

    // Methods that do not go with the scene, the tableau or the order.
    add(with(full(), "/method", r#"{"name":"vpd_reduced"}"#), "/method/name");
    for name in ["splitting", "lgvi", "quaternion_gauss"] {
        add(with(so4(), "/method", &format!("{{\"name\":\"{name}\"}}")), "/method/name");
    }
    for name in ["rkmk", "rk", "rk_projected"] {
        let method = format!("{{\"name\":\"{name}\",\"tableau\":\"gauss2\"}}");
        add(with(full(), "/method", &method), "/method/tableau");
    }
    add(
        with(full(), "/method", r#"{"name":"quaternion_gauss","tableau":"rk3"}"#),
        "/method/tableau",
    );
    add(with(full(), "/method", r#"{"name":"splitting","tableau":"gauss2"}"#), "/method/tableau");
    add(with(full(), "/method", r#"{"name":"vpd","order":4}"#), "/method/order");
    for raw in ["3", "0", "10", "-2", "\"4\""] {
        let method = format!("{{\"name\":\"lgvi\",\"order\":{raw}}}");
        add(with(full(), "/method", &method), "/method/order");
    }

    // Adaptive steps.
    let adaptive = |raw: &str| with(full(), "/step", raw);
    for (raw, at) in [
        ("{}", ""),
        ("{\"adaptive\": 1}", "/adaptive"),
        ("{\"adaptive\": {\"dstar\": 1}}", "/adaptive/dstar"),
        ("{\"adaptive\": {\"largest_step_s\": 0}}", "/adaptive/largest_step_s"),
        ("{\"adaptive\": {\"largest_step_s\": 1e10}}", "/adaptive/largest_step_s"),
        ("{\"adaptive\": {\"largest_step_s\": -1}}", "/adaptive/largest_step_s"),
        ("{\"adaptive\": {\"near_m\": 1}}", "/adaptive/near_m"),
        ("{\"adaptive\": {\"near_m\": [1, 2]}}", "/adaptive/near_m"),
        ("{\"adaptive\": {\"near_m\": [0]}}", "/adaptive/near_m/0"),
        ("{\"adaptive\": {\"near_m\": [1e16]}}", "/adaptive/near_m/0"),
    ] {
        add(adaptive(raw), &format!("/step{at}"));
    }
    for name in ["rk", "vrkmk", "splitting", "vpd_lagrangian"] {
        let mut other: Value = serde_json::from_str(&adaptive("{\"adaptive\": {}}")).expect("JSON");
        other["method"] = json!({"name": name});
        add(other.to_string(), "/step/adaptive");
    }
    let mut nothing_near: Value =
        serde_json::from_str(&adaptive("{\"adaptive\": {}}")).expect("JSON");
    nothing_near["scene"]["potential"] = json!([]);
    add(nothing_near.to_string(), "/step/adaptive");
    let mut named = full();
    named["scene"]["potential"] = json!([]);
    named["method"] = json!({"name": "vpd_adaptive"});
    add(named.to_string(), "/method/name");
    let mut pace = full();
    pace["log"]["channels"] = json!(["/pace"]);
    add(pace.to_string(), "/log/channels/0");
    let mut both: Value = serde_json::from_str(&adaptive("{\"adaptive\": {}}")).expect("JSON");
    for field in ["method", "step_s", "steps", "log"] {
        both.as_object_mut().expect("an object").remove(field);
    }
    (both["accuracy"], both["duration_s"]) = (json!({"error": 1e-6}), json!(10));
    add(both.to_string(), "/step");

    // The log.
    for raw in ["0", "-1", "18446744073709551616", "0.5"] {
        add(with(full(), "/log/every", raw), "/log/every");
    }
    let endless = with(full(), "/steps", "1000000000000");
    let endless: Value = serde_json::from_str(&with(
        serde_json::from_str(&endless).expect("JSON"),
        "/step_s",
        "0.001",
    ))
    .expect("JSON");
    add(with(endless, "/log/every", "1"), "/log/every");
    let spread = json!({"members": 10, "seed": 1, "attitude_spread_rad": 0.1, "momentum_spread": 0.1, "in_full": [1]});
    let ensemble = || {
        let mut scenario = full();
        scenario["ensemble"] = spread.clone();
        scenario
    };
    for (field, values) in [
        ("members", &["0", "1", "100001", "-1", "2.5", "\"many\"", "null"][..]),
        ("seed", &["-1", "0.5", "9007199254740992", "\"x\""]),
        ("attitude_spread_rad", &["-0.1", "3.2", "1e400", "[]", "1e-200"]),
        ("momentum_spread", &["-1", "1e16", "NaN", "5e-324"]),
    ] {
        for value in values {
            let pointer = format!("/ensemble/{field}");
            add(with(ensemble(), &pointer, value), &pointer);
        }
    }
    add(without(ensemble(), "/ensemble/members"), "/ensemble");
    add(with(ensemble(), "/ensemble/spread", "1"), "/ensemble/spread");
    for field in ["position_spread_m", "velocity_spread_m_s"] {
        let pointer = format!("/ensemble/{field}");
        add(with(ensemble(), &pointer, "0.1"), &pointer);
    }
    add(with(full(), "/ensemble", r#"{"members": 10}"#), "/ensemble");
    add(with(ensemble(), "/ensemble/in_full", "[1, 2, 3, 4, 5, 6, 7, 8]"), "/ensemble/in_full");
    for bad in ["[2, 2]", "[3, 0]", "[4, 10]"] {
        add(with(ensemble(), "/ensemble/in_full", bad), "/ensemble/in_full/1");
    }
    add(with(full(), "/log/channels", r#"["/state","/ensemble/members"]"#), "/log/channels/1");
    add(with(full(), "/log/channels", "[]"), "/log/channels");
    add(with(full(), "/log/channels", r#"["/state","/state"]"#), "/log/channels/1");
    add(with(full(), "/log/channels", r#"["/state","/imu"]"#), "/log/channels/1");
    add(with(full(), "/log/compression", "\"gzip\""), "/log/compression");
    for raw in [
        "\"yesterday\"",
        "\"2026-13-01T00:00:00Z\"",
        "\"1970-01-01T00:00:00Z\"",
        "\"2200-01-01T00:00:00Z\"",
        "\"2026-01-01\"",
        "\"\"",
    ] {
        add(with(full(), "/log/epoch", raw), "/log/epoch");
    }

    // Derivatives.
    for (raw, pointer) in [
        ("true", ""),
        ("{}", ""),
        ("{\"state\": 1}", "/state"),
        ("{\"state\": false}", ""),
        ("{\"state\": true, \"parameter\": []}", "/parameter"),
        ("{\"parameters\": \"/step_s\"}", "/parameters"),
        ("{\"parameters\": [1]}", "/parameters/0"),
        ("{\"parameters\": [\"/step_s\"]}", "/parameters/0"),
        ("{\"parameters\": [\"/scene/potential/0\"]}", "/parameters/0"),
        ("{\"parameters\": [\"/scene/potential/4/weight\"]}", "/parameters/0"),
        ("{\"parameters\": [\"/scene/initial/attitude/matrix/0/0\"]}", "/parameters/0"),
        (
            "{\"parameters\": [\"/scene/inertia/principal/0\", \"/scene/inertia/principal/0\"]}",
            "/parameters/1",
        ),
    ] {
        add(with(full(), "/derivatives", raw), &format!("/derivatives{pointer}"));
    }
    let ones = |diagonal: [i32; 6]| -> Vec<Vec<i32>> {
        (0..6).map(|i| (0..6).map(|j| if i == j { diagonal[i] } else { 0 }).collect()).collect()
    };
    let negative = json!({ "matrix": ones([1, 1, -1, 1, 1, 1]) }).to_string();
    let mut correlated = ones([1; 6]);
    (correlated[0][1], correlated[1][0]) = (2, 2);
    let indefinite = json!({ "matrix": correlated }).to_string();
    correlated[1][0] = 1;
    let skewed = json!({ "matrix": correlated }).to_string();
    let both = json!({ "matrix": ones([1; 6]), "momentum_spread": 1 }).to_string();
    for (raw, pointer) in [
        ("1", ""),
        ("{}", ""),
        ("{\"attitude_spread_rad\": 0}", ""),
        ("{\"attitude_spread_rad\": -1}", "/attitude_spread_rad"),
        ("{\"attitude_spread_rad\": 4}", "/attitude_spread_rad"),
        ("{\"momentum_spread\": 1e-20}", "/momentum_spread"),
        ("{\"momentum\": 1}", "/momentum"),
        ("{\"parameter_spreads\": [1]}", "/parameter_spreads"),
        ("{\"matrix\": [[1]]}", "/matrix"),
        (negative.as_str(), "/matrix/2/2"),
        (indefinite.as_str(), "/matrix"),
        (skewed.as_str(), "/matrix/1/0"),
        (both.as_str(), "/matrix"),
    ] {
        let asked = format!("{{\"state\": true, \"covariance\": {raw}}}");
        let pointer = format!("/derivatives/covariance{pointer}");
        add(with(full(), "/derivatives", &asked), &pointer);
    }
    let asked = "{\"parameters\": [\"/scene/inertia/principal/0\"], \"covariance\": ";
    for (raw, pointer) in [
        ("{\"momentum_spread\": 1}", ""),
        ("{\"parameter_spreads\": [0]}", ""),
        ("{\"parameter_spreads\": [-1]}", "/parameter_spreads/0"),
        ("{\"parameter_spreads\": [1, 1]}", "/parameter_spreads"),
    ] {
        let pointer = format!("/derivatives/covariance{pointer}");
        add(with(full(), "/derivatives", &format!("{asked}{raw}}}")), &pointer);
    }
    let asked = "{\"state\": true}";
    for name in ["rk", "vrkmk", "vpd_lagrangian", "splitting"] {
        let mut other = full();
        other["method"] = json!({"name": name});
        add(with(other, "/derivatives", asked), "/method/name");
    }
    let mut many = full();
    many["ensemble"] = json!({"members": 10, "attitude_spread_rad": 0.1});
    let mut adaptive = full();
    adaptive["step"] = json!({"adaptive": {}});
    let mut magnetic: Value =
        serde_json::from_str(include_str!("../../scenarios/detumble.json")).expect("shipped");
    magnetic["scene"]["field"]["dipole"]["permanent_moment_a_m2"] = json!([0.1, 0, 0.2]);
    if let Some(scene) = magnetic["scene"].as_object_mut() {
        scene.remove("control");
    }
    for base in [many, adaptive, driven(), magnetic] {
        add(with(base, "/derivatives", asked), "/derivatives");
    }
    add(with(full(), "/log/channels", "[\"/derivatives\"]"), "/log/channels/0");

    // An accuracy in the place of method and step.
    let accurate = || {
        let mut accurate = dipole();
        let map = accurate.as_object_mut().expect("an object");
        for field in ["method", "step_s", "steps"] {
            map.remove(field);
        }
        accurate["accuracy"] = json!({"error": 1e-8});
        accurate["duration_s"] = json!(1.0);
        accurate
    };
    for raw in ["0", "-1e-8", "1e-14", "1", "null", "\"1e-8\"", "[]"] {
        add(with(accurate(), "/accuracy/error", raw), "/accuracy/error");
    }
    for raw in ["{}", "1e-8"] {
        add(with(accurate(), "/accuracy", raw), "/accuracy");
    }
    add(with(accurate(), "/accuracy/digits", "8"), "/accuracy/digits");
    add(with(accurate(), "/method", r#"{"name":"vpd"}"#), "/method");
    add(with(accurate(), "/step_s", "0.01"), "/step_s");
    add(with(accurate(), "/steps", "100"), "/steps");
    add(with(accurate(), "/duration_s", "0"), "/duration_s");
    add(with(accurate(), "/duration_s", "3.9e9"), "/duration_s");
    add(without(accurate(), "/duration_s"), "");

    // Samples `every_s` seconds apart.
    let spaced = |every_s: &str| {
        let mut spaced = dipole();
        spaced["log"] = json!({});
        with(spaced, "/log/every_s", every_s)
    };
    for raw in ["0", "-0.1", "4.1e9", "0.001", "0.015", "\"1\"", "[]"] {
        add(spaced(raw), "/log/every_s");
    }
    add(with(full(), "/log/every_s", "0.1"), "/log/every_s");
    let chosen = |every_s: &str| {
        let mut chosen = accurate();
        chosen["log"] = json!({});
        with(chosen, "/log/every_s", every_s)
    };
    for raw in ["0", "2", "0.3", "1e-10"] {
        add(chosen(raw), "/log/every_s");
    }

    // Names and expectations.
    add(with(full(), "/name", "\"\""), "/name");
    add(with(full(), "/name", "\"  \""), "/name");
    add(with(full(), "/name", &format!("\"{}\"", "n".repeat(304))), "/name");
    add(with(full(), "/name", &format!("\"{}\"", "x".repeat(201))), "/name");
    for raw in ["\"a\\nb\"", "\"a\\r\\nb\"", "\"a\\u0000b\"", "\"a\\u202eb\"", "\"a\\u001b[2J\""] {
        add(with(full(), "/name", raw), "/name");
    }
    // Characters that are invisible, or that reverse the text.
    for mark in ["200b", "200d", "200e", "200f", "061c", "2060", "2067", "feff", "00ad", "3164"] {
        add(with(full(), "/name", &format!("\"a\\u{mark}b\"")), "/name");
        add(with(full(), "/description", &format!("\"a\\u{mark}b\"")), "/description");
    }
    add(with(full(), "/name", "\"\\u200b\""), "/name");
    add(with(full(), "/description", "\"a\\u0007b\""), "/description");
    add(with(full(), "/description", &format!("\"{}\"", "x".repeat(4001))), "/description");
    add(with(full(), "/expect/energy_error_max", "-1"), "/expect/energy_error_max");
    add(with(full(), "/expect/final_attitude", "[[1,0,0],[0,1,0],[0,0,1]]"), "/expect");
    let numbers = [
        "/scene/driven/0/term/weight",
        "/scene/driven/0/path/turning/from/1",
        "/scene/driven/0/path/turning/rate_rad_s",
        "/scene/driven/1/path/orbit/towards/0",
        "/scene/driven/1/path/orbit/mean_motion_rad_s",
        "/scene/driven/1/path/orbit/eccentricity",
        "/scene/driven/1/factor/harmonic/amplitude",
        "/scene/driven/1/factor/harmonic/rate_rad_s",
        "/scene/driven/2/factor/table/times_s/1",
        "/scene/driven/2/factor/table/values/0",
        "/scene/torques/0/constant/body/2",
        "/scene/torques/1/table/table/values/2",
        "/scene/torques/3/of_momentum/rate_per_s",
        "/scene/wheels/2",
    ];
    for pointer in numbers {
        for raw in ["true", "\"1.0\"", "{}", "NaN", "1e400", "1e16"] {
            add(with(driven(), pointer, raw), pointer);
        }
    }
    for (pointer, raw) in [
        ("/scene/driven/0/path/turning/from", "[0,0,0]"),
        ("/scene/driven/0/path/turning/from", "[1,0]"),
        ("/scene/driven/0/path/turning/towards", "[2,0,0]"),
        ("/scene/driven/1/path/orbit/towards", "[0,0,-3]"),
        ("/scene/driven/1/path/orbit/eccentricity", "1"),
        ("/scene/driven/1/path/orbit/eccentricity", "-0.1"),
        ("/scene/driven/1/path/orbit/mean_motion_rad_s", "1e-40"),
        ("/scene/driven/2/factor/table/times_s", "[0]"),
        ("/scene/driven/2/factor/table/values", "[1,2]"),
        ("/scene/driven/2/factor/table/interpolation", "\"cubic\""),
        ("/scene/driven/2/factor/table/interpolation", "true"),
        ("/scene/driven/2/factor/table/smooth", "\"hold\""),
        ("/scene/initial/orbit_frame", "7"),
        ("/scene/initial/orbit_frame", "-1"),
        ("/scene/torques/0/constant/body", "[1,2]"),
        ("/scene/torques/2/viscous/coefficients", "[1,2]"),
        ("/scene/wheels", "[1,2]"),
    ] {
        add(with(driven(), pointer, raw), pointer);
    }
    // Times ascend and cover the run.
    for (raw, at) in [
        ("[0,2,1]", 2),
        ("[0,1,1]", 2),
        ("[0.5,1,1e4]", 0),
        ("[0,1,2]", 2),
        ("[0,1e-13,1e4]", 1),
        ("[0,0,0]", 2),
    ] {
        let pointer = "/scene/driven/2/factor/table/times_s";
        add(with(driven(), pointer, raw), &format!("{pointer}/{at}"));
    }
    add(with(driven(), "/scene/torques/2/viscous/coefficient", "1"), "/scene/torques/2/viscous");
    let mut both = driven();
    both["scene"]["driven"][2]["factor"]["table"]["smooth"] = json!(true);
    both["scene"]["driven"][2]["factor"]["table"]["interpolation"] = json!("linear");
    add(both.to_string(), "/scene/driven/2/factor/table/smooth");
    for name in ["splitting", "lgvi", "quaternion_gauss", "vpd_reduced"] {
        let mut driven = driven();
        driven["method"] = json!({ "name": name });
        add(driven.to_string(), "/method/name");
    }
    // Fields in a list are no object.
    add(with(full(), "/expect", "[null,null]"), "/expect");
    add(with(full(), "/log", "[5]"), "/log");
    add(with(full(), "/method/solver", "[\"auto\",1e-15,100]"), "/method/solver");
    add(
        with(full(), "/scene/potential/0", "[\"uniform\",1,[0,0,1],[0,0,1]]"),
        "/scene/potential/0",
    );
    for raw in ["[]", "1", "\"scenario\"", "null"] {
        add(raw.to_owned(), "");
    }
    table.extend(crate::bodies_scenes::bad());
    table
}

fn refused(text: &[u8]) -> Option<ScenarioError> {
    match Scenario::from_json(text) {
        Ok(scenario) => Plan::new(&scenario).err(),
        Err(error) => Some(error),
    }
}

#[test]
fn the_unspoiled_scenarios_are_good() {
    for base in [dipole(), so4(), full(), driven()] {
        assert_eq!(refused(base.to_string().as_bytes()), None);
    }
}

#[test]
fn every_bad_scenario_is_refused_at_its_field() {
    let table = table();
    println!("{} bad scenarios", table.len());
    assert!(table.len() >= 300, "{} rows", table.len());
    let mut wrong = Vec::new();
    for Bad { text, pointer } in &table {
        match refused(text.as_bytes()) {
            None => wrong.push(format!("accepted, {pointer}: {text}")),
            Some(error)
                if error.pointer != *pointer || error.kind != ScenarioErrorKind::Invalid =>
            {
                wrong.push(format!("{pointer} expected: {:?} {error}", error.kind));
            }
            Some(error) => assert!(error.message.len() > 10, "{pointer}: {error}"),
        }
    }
    assert!(wrong.is_empty(), "{} of {} wrong:\n{}", wrong.len(), table.len(), wrong.join("\n"));
}

/// Every kind of term, a new one included, is read back as it was written, and every field that is
/// missing, unknown, of the wrong type or of the wrong size is refused by its pointer.
#[test]
fn every_term_is_read_back_and_refuses_bad_fields() {
    const TERM: &str = "/scene/potential/0";
    let mut wrong = Vec::new();
    for (n, base) in [(3, dipole()), (4, so4())] {
        for term in PotentialTerm::examples(n) {
            let mut good = base.clone();
            good["scene"]["potential"] = json!([term]);
            good.as_object_mut().expect("an object").remove("expect");
            let text = good.to_string();
            assert_eq!(refused(text.as_bytes()), None, "{text}");
            let read = Scenario::from_json(text.as_bytes()).expect("accepted");
            assert_eq!(read.scene.potential, [term]);

            let mut refuse = |text: String, pointer: &str| match refused(text.as_bytes()) {
                Some(error) if error.pointer == pointer => {}
                other => wrong.push(format!("{pointer} expected: {other:?}: {text}")),
            };
            let optional = ["rest_length", "matrix"];
            let fields = good.pointer(TERM).and_then(Value::as_object).expect("an object").clone();
            for (field, value) in fields {
                let pointer = format!("{TERM}/{field}");
                if !optional.contains(&field.as_str()) {
                    refuse(without(good.clone(), &pointer), TERM);
                    refuse(with(good.clone(), &pointer, "null"), &pointer);
                }
                for raw in ["true", "{}", "\"text\"", if value.is_array() { "1" } else { "[1]" }] {
                    refuse(with(good.clone(), &pointer, raw), &pointer);
                }
                if let Value::Array(mut numbers) = value {
                    numbers.pop();
                    refuse(
                        with(good.clone(), &pointer, &Value::Array(numbers).to_string()),
                        &pointer,
                    );
                } else if value.is_number() {
                    refuse(with(good.clone(), &pointer, "1e400"), &pointer);
                }
            }
            let unknown = format!("{TERM}/colour");
            refuse(with(good.clone(), &unknown, "1"), &unknown);
        }
    }
    assert!(wrong.is_empty(), "{} wrong:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn what_is_not_json_is_malformed() {
    let deep = "[".repeat(100_000);
    for text in [
        "",
        "{",
        "{\"name\":",
        "{\"name\":\"a\"} x",
        "\u{feff}\u{feff}{}",
        deep.as_str(),
        "{'name':1}",
    ] {
        let error = refused(text.as_bytes()).expect("refused");
        assert_eq!(error.kind, ScenarioErrorKind::Malformed, "{error}");
    }
    assert_eq!(
        refused(b"{\"name\":\"\xff\"}").expect("refused").kind,
        ScenarioErrorKind::Malformed
    );
}

#[test]
fn what_was_given_is_not_repeated_at_length() {
    let long = "x".repeat(486_000);
    let mut unknown = full();
    unknown[&long] = json!(1);
    let mut nested = full();
    nested["scene"][&long] = json!({ &long: 1 });
    let epoch = with(full(), "/log/epoch", &format!("\"{long}\""));
    let method = with(full(), "/method/name", &format!("\"{long}\""));
    let twice = format!("{{\"{long}\": 1, \"{long}\": 1}}");
    for text in [unknown.to_string(), nested.to_string(), epoch, method, twice] {
        let error = refused(text.as_bytes()).expect("refused");
        assert!(error.pointer.chars().count() <= 200, "{} bytes", error.pointer.len());
        assert!(error.message.chars().count() <= 600, "{} bytes", error.message.len());
    }
    // The end of a sentence says what is allowed.
    let error = refused(with(full(), "/method/name", &format!("\"{long}\"")).as_bytes());
    assert!(error.is_some_and(|error| error.message.ends_with("`quaternion_gauss`")));
}

/// If the number itself is at fault, the answer gives one that works, in few characters.
#[test]
fn answers_say_what_would_do() {
    let mut short = dipole();
    short.as_object_mut().expect("an object").remove("steps");
    let change = |base: &Value, at: &[(&str, Value)]| {
        let mut changed = base.clone();
        for (pointer, value) in at {
            let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
            changed.pointer_mut(parent).expect("it is there")[key] = value.clone();
        }
        changed.to_string()
    };
    for (text, at, says) in [
        (
            change(&short, &[("/step_s", json!(0.1)), ("/duration_s", json!(0.15))]),
            "/duration_s",
            "the nearest are 0.1 s and 0.2 s",
        ),
        (
            change(&short, &[("/step_s", json!(20)), ("/duration_s", json!(10))]),
            "/duration_s",
            "the nearest is 20 s",
        ),
        (
            change(
                &short,
                &[
                    ("/step_s", json!(0.1)),
                    ("/duration_s", json!(1)),
                    ("/until", json!([{ "angle_above_rad": { "angle_rad": 3.2 } }])),
                ],
            ),
            "/until/0/angle_above_rad/angle_rad",
            "no angle is above 3.141593 rad",
        ),
        (
            change(
                &short,
                &[
                    ("/step_s", json!(0.1)),
                    ("/duration_s", json!(2e8)),
                    ("/log", json!({ "every_s": 0.1 })),
                ],
            ),
            "/log/every_s",
            "the smallest allowed is 0.2 s",
        ),
        (
            change(&short, &[("/duration_s", json!(1)), ("/log", json!({ "every_s": 1e-308 }))]),
            "/log/every_s",
            "1e-308 s is not a whole number of steps",
        ),
        (
            change(&dipole(), &[("/steps", json!(1.0))]),
            "/steps",
            "a whole number in digits, 0 to 2^64 - 1",
        ),
        (
            change(&dipole(), &[("/steps", json!(1.8446744073709552e19))]),
            "/steps",
            "a whole number in digits, 0 to 2^64 - 1",
        ),
        ("[]".to_owned(), "", "is a list where an object belongs"),
        (change(&short, &[("/scene", json!([]))]), "/scene", "is a list where an object belongs"),
    ] {
        let ScenarioError { pointer, message, .. } = refused(text.as_bytes()).expect("refused");
        assert_eq!(pointer, at, "{message}");
        assert!(message.contains(says), "{message}");
    }
    // A value that would not be accepted either is not suggested.
    let viscous = change(&short, &[("/scene/torques", json!([{ "viscous": null }]))]);
    let error = refused(viscous.as_bytes()).expect("refused");
    assert!(
        error.pointer.starts_with("/scene/torques/0") && !error.message.contains("write"),
        "{error}"
    );
}

/// 311 bytes that hung the planner: a square that underflows made a rank of NaN.
#[test]
fn near_zero_is_planned_or_refused() {
    let mut scene = dipole();
    // Their points are independent, or they were one field.
    let spring = |z: f64| json!({"kind": "spring", "stiffness": 1, "body_point": [0, 0, 1], "position": [0, z, 0]});
    let weight = |body_point: [f64; 3], direction: [f64; 3]| json!({"kind": "uniform", "weight": 1, "body_point": body_point, "direction": direction});
    for (z, free) in [(1e-200, None), (1e-15, Some(0)), (0.0, Some(1))] {
        scene["scene"]["potential"] = json!([
            weight([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
            weight([0.0, 1.0, 0.0], [1.0, 1e-200, 1.0]),
            spring(z)
        ]);
        let plan = Scenario::from_json(scene.to_string().as_bytes()).and_then(|s| Plan::new(&s));
        assert_eq!(plan.ok().map(|plan| plan.free_directions), free, "{z:e}");
    }
}

#[test]
fn the_format_may_say_its_version() {
    let text = with(dipole(), "/format", "1");
    let scenario = Scenario::from_json(text.as_bytes()).expect("the version of this build");
    let without = Scenario::from_json(dipole().to_string().as_bytes()).expect("shipped");
    assert_eq!(scenario, without);
    let refused =
        Scenario::from_json(with(dipole(), "/format", "2").as_bytes()).expect_err("newer");
    assert!(refused.message.contains("a newer vpd may read it"), "{refused}");
}
