//! Scenes of several bodies: what is read, written back, and refused.

use serde_json::{Value, json};
use vpd::scenario::{Bodies, Body, BodyInitial, Inertia, Interaction, PairLaw, Scenario, Scene};

use crate::bad_scenarios::Bad;

/// Returns a scene with a body and a term of every kind.
fn several() -> Value {
    json!({
        "name": "several",
        "scene": {
            "joints": [
                {"kind": "ball", "between": ["space", "upper"], "points": [[5, 0, 0], [0, 0, 0.5]]},
                {"between": ["upper", "lower"], "kind": "ball", "points": [[0, 0, -0.5], [0, 0, 0.5]]},
            ],
            "potential": [
                {"kind": "uniform", "body": "mast", "weight": 9.81, "body_point": [0, 0, -1], "direction": [0, 0, 1]},
                {"stiffness": 3, "rest_length": 1, "points": [[1, 0, 0], [-0.5, 0, 0]], "between": ["primary", "secondary"], "kind": "spring"},
                {"kind": "spring", "between": ["lower", "mast"], "points": [[0, 0, 0], [0, 0, 0]], "stiffness": 0.1},
                {"kind": "point_source", "between": ["primary", "mast"], "points": [[0, 0, 0], [0, 0, 1]], "strength": -1},
                {"kind": "mutual_gravity", "between": ["primary", "secondary"], "constant": 6.674e-11},
                {"kind": "spring", "body": "secondary", "stiffness": 2, "body_point": [0, 1, 0], "position": [0, 9, 0]},
                {"kind": "gravity_gradient", "strength": 0.1, "direction": [1, 0, 0], "body": "primary"},
            ],
            "bodies": [
                {"name": "primary", "mass": 5, "inertia": {"principal": [2, 2.5, 3]},
                 "initial": {"position": [0, 0, 0], "velocity": [0, 0.1, 0], "angular_velocity": {"body": [0, 0, 0.3]},
                             "attitude": {"axis_angle": {"axis": [1, 0, 0], "angle_rad": 0.3}}}},
                {"name": "secondary", "mass": 1, "inertia": {"principal": [1, 1, 1.5]},
                 "initial": {"position": [3, 0, 0], "linear_momentum": [0, -0.5, 0], "momentum": {"space": [0, 0, 0.3]}}},
                {"name": "mast", "pivot": [0, 0, 2], "inertia": {"matrix": [[2, 0, 0], [0, 2, 0], [0, 0, 1]]}},
                {"name": "upper", "mass": 1, "inertia": {"principal": [0.1, 0.1, 0.01]}},
                {"name": "lower", "mass": 1, "inertia": {"principal": [0.1, 0.1, 0.01]}, "initial": {"angular_velocity": {"body": [1, 0, 0]}}},
            ],
        },
        "method": {"name": "vpd", "tableau": "gauss3"},
        "step_s": 0.01,
        "steps": 1000,
    })
}

fn detumble() -> Value {
    serde_json::from_str(include_str!("../../scenarios/detumble.json")).expect("shipped")
}

fn read(text: &Value) -> Result<Scenario, vpd::scenario::ScenarioError> {
    Scenario::from_json(text.to_string().as_bytes())
}

/// A field of a scene, its value (`null`: without it), the pointer that must be named, and words of the message.
type Row = (&'static str, Value, &'static str, &'static str);

#[rustfmt::skip]
fn rows() -> Vec<Row> {
    vec![
        ("/scene/inertia", json!({"principal": [1, 1, 1]}), "/scene/inertia", "together with `bodies`"),
        ("/scene/initial", json!({}), "/scene/initial", "together with `bodies`"),
        ("/scene/initial", json!({"attitude": {"mrp": [0, 0, 0.1]}}), "/scene/initial", "together with `bodies`"),
        ("/scene/driven", json!([{"term": {"kind": "spring", "stiffness": 1, "body_point": [1, 0, 0], "position": [1, 0, 0]}}]), "/scene/driven", "for scenes of one body"),
        ("/scene/torques", json!([{"viscous": {"coefficient": 1}}]), "/scene/torques", "for scenes of one body"),
        ("/scene/wheels", json!([0, 0, 1]), "/scene/wheels", "for scenes of one body"),
        ("/scene/control", detumble()["scene"]["control"].clone(), "/scene/control", "for scenes of one body"),
        ("/scene/field", detumble()["scene"]["field"].clone(), "/scene/field", "for scenes of one body"),
        ("/scene/gravity", json!(1), "/scene/gravity", "unknown field"),
        ("/ensemble", json!({"members": 10}), "/ensemble", "`position_spread_m` or `velocity_spread_m_s`"),
        ("/ensemble", json!({"members": 10, "position_spread_m": -1}), "/ensemble/position_spread_m", "-1.0 given"),
        ("/ensemble", json!({"members": 10, "velocity_spread_m_s": 1e16}), "/ensemble/velocity_spread_m_s", "from 0 to"),
        ("/until", json!([{"pointing_error_below_rad": 1}]), "/until/0/pointing_error_below_rad", "for scenes of one body"),
        ("/until", json!([{"body": "mast"}]), "/until/0", "`distance_below_m`, `distance_above_m` is needed"),
        ("/until", json!([{"rate_below_rad_s": 1}]), "/until/0", "missing field `body`"),
        ("/until", json!([{"rate_below_rad_s": 1, "body": "must"}]), "/until/0/body", "did you mean `mast`?"),
        ("/until", json!([{"rate_below_rad_s": 0, "body": "mast"}]), "/until/0/rate_below_rad_s", ""),
        ("/until", json!([{"energy_error_above_j": 1, "body": "mast"}]), "/until/0/body", "not that of one body"),
        ("/until", json!([{"body": "mast", "angle_above_rad": {"angle_rad": 1, "from": {"quaternion": [2, 0, 0, 0]}}}]), "/until/0/angle_above_rad/from/quaternion", "within 1 %"),
        ("/until", json!([{"distance_below_m": {"distance_m": 0, "between": ["primary", "mast"]}}]), "/until/0/distance_below_m/distance_m", "above 0"),
        ("/until", json!([{"distance_above_m": {"distance_m": 1, "between": ["primary", "primary"]}}]), "/until/0/distance_above_m/between", "two different bodies"),
        ("/until", json!([{"distance_above_m": {"distance_m": 1, "between": ["primary", "secondry"]}}]), "/until/0/distance_above_m/between/1", "did you mean `secondary`?"),
        ("/until", json!([{"distance_above_m": {"distance_m": 1, "between": ["primary", "space"], "points": [[0, 0], [0, 0, 0]]}}]), "/until/0/distance_above_m/points/0", "n = 3 are needed"),
        ("/step", json!({"adaptive": {"near_m": [1, 2, 3]}}), "/step/adaptive/near_m", "1 or 2 (one for each point source)"),
        ("/step", json!({"adaptive": {"near_m": [1, 0]}}), "/step/adaptive/near_m/1", "a distance must be"),
        ("/step", json!({"adaptive": {"largest_step_s": 0}}), "/step/adaptive/largest_step_s", "a step must be"),
        ("/expect", json!({"final_attitude": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "final_attitude_error_max": 1}), "/expect/final_attitude", "for scenes of one body"),
        ("/log", json!({"channels": ["/state"]}), "/log/channels/0", "for scenes of one body"),
        ("/log", json!({"channels": ["/bodies/*/state", "/scene/body"]}), "/log/channels/1", "for scenes of one body"),
        ("/log", json!({"channels": ["/pace"]}), "/log/channels/0", "steps that adapt"),
        ("/method", json!({"name": "vpd_lagrangian"}), "/method/name", "auto, vpd, vpd_adaptive, rk_projected, rkmk, splitting"),
        ("/method", json!({"name": "rk"}), "/method/name", "auto, vpd, vpd_adaptive, rk_projected, rkmk, splitting"),
        ("/method", json!({"name": "lgvi"}), "/method/name", "lgvi given"),
        ("/method", json!({"name": "splitting"}), "/method/name", "without joints"),
        ("/method", json!({"solver": {"kind": "newton"}}), "/method/solver/kind", "fixed_point and auto"),
        ("/scene/bodies", json!([]), "/scene/bodies", "0 bodies given, 1 to 64"),
        ("/scene/bodies", json!({}), "/scene/bodies", "expected a list"),
        ("/scene/bodies/0", json!(["a", 1, null, {"principal": [1, 1, 1]}, {}]), "/scene/bodies/0", "list where an object"),
        ("/scene/bodies/0/name", json!(""), "/scene/bodies/0/name", "a letter first"),
        ("/scene/bodies/0/name", json!("1st"), "/scene/bodies/0/name", "`1st` given"),
        ("/scene/bodies/0/name", json!("a b"), "/scene/bodies/0/name", "letters, digits"),
        ("/scene/bodies/0/name", json!("a/b"), "/scene/bodies/0/name", "letters, digits"),
        ("/scene/bodies/0/name", json!("é"), "/scene/bodies/0/name", "letters, digits"),
        ("/scene/bodies/0/name", json!("a".repeat(41)), "/scene/bodies/0/name", "1 to 40"),
        ("/scene/bodies/0/name", json!("space"), "/scene/bodies/0/name", "another name"),
        ("/scene/bodies/1/name", json!("primary"), "/scene/bodies/1/name", "an earlier body"),
        ("/scene/bodies/1/name", json!("primary_angular"), "/scene/bodies/1/name", "one name"),
        ("/scene/bodies/1/name", json!("primary_initial"), "/scene/bodies/1/name", "one name"),
        ("/scene/bodies/0/name", Value::Null, "/scene/bodies/0", "missing field `name`"),
        ("/scene/bodies/0/inertia", Value::Null, "/scene/bodies/0", "missing field `inertia`"),
        ("/scene/bodies/0/colour", json!("red"), "/scene/bodies/0/colour", "unknown field"),
        ("/scene/bodies/1/inertia", json!({"second_moments": [1, 1, 1, 1]}), "/scene/bodies/1/inertia", "n = 4, the first body has n = 3"),
        ("/scene/bodies/0/inertia", json!({"second_moments": [1, 1, 1, 1, 1, 1, 1, 1, 1]}), "/scene/bodies/0/inertia", "n = 2 to 8"),
        ("/scene/bodies/0/inertia/principal/1", json!(-1), "/scene/bodies/0/inertia/principal/1", "moment of inertia"),
        ("/scene/bodies/0/mass", Value::Null, "/scene/bodies/0/mass", "`primary` is a body without a pivot"),
        ("/scene/bodies/3/mass", Value::Null, "/scene/bodies/3/mass", "`upper` is a body with a joint"),
        ("/scene/bodies/0/mass", json!(0), "/scene/bodies/0/mass", "1e-15 to 1e15 kg"),
        ("/scene/bodies/0/mass", json!(-1), "/scene/bodies/0/mass", "1e-15 to 1e15 kg"),
        ("/scene/bodies/0/mass", json!("5"), "/scene/bodies/0/mass", "expected a number"),
        ("/scene/bodies/2/pivot", json!([0, 0]), "/scene/bodies/2/pivot", "n = 3 are needed"),
        ("/scene/bodies/3/pivot", json!([0, 0, 0]), "/scene/bodies/3/pivot", "a joint holds `upper`"),
        ("/scene/bodies/2/initial", json!({"position": [0, 0, 2]}), "/scene/bodies/2/initial/position", "`mast`, which a pivot holds"),
        ("/scene/bodies/2/initial", json!({"velocity": [0, 0, 2]}), "/scene/bodies/2/initial/velocity", "a pivot holds"),
        ("/scene/bodies/2/initial", json!({"linear_momentum": [0, 0, 2]}), "/scene/bodies/2/initial/linear_momentum", "a pivot holds"),
        ("/scene/bodies/3/initial", json!({"position": [0, 0, 2]}), "/scene/bodies/3/initial/position", "a joint holds"),
        ("/scene/bodies/4/initial/linear_momentum", json!([0, 0, 2]), "/scene/bodies/4/initial/linear_momentum", "a joint holds"),
        ("/scene/bodies/0/initial/position", json!([0, 0, 0, 0]), "/scene/bodies/0/initial/position", "n = 3 are needed"),
        ("/scene/bodies/0/initial/position/1", json!(1e16), "/scene/bodies/0/initial/position/1", "size of a number"),
        ("/scene/bodies/0/initial/linear_momentum", json!([1, 0, 0]), "/scene/bodies/0/initial/velocity", "together with `linear_momentum`"),
        ("/scene/bodies/0/initial/momentum", json!({"body": [1, 0, 0]}), "/scene/bodies/0/initial/angular_velocity", "together with `momentum`"),
        ("/scene/bodies/0/initial/attitude", json!({"quaternion": [2, 0, 0, 0]}), "/scene/bodies/0/initial/attitude/quaternion", "within 1 %"),
        ("/scene/bodies/0/initial/orbit_frame", json!(0), "/scene/bodies/0/initial/orbit_frame", "unknown field"),
        ("/scene/potential/0/body", json!("must"), "/scene/potential/0/body", "did you mean `mast`?"),
        ("/scene/potential/0/body", json!("zzz"), "/scene/potential/0/body", "no body has that name"),
        ("/scene/potential/0/body", Value::Null, "/scene/potential/0", "missing field `body` (or `between`)"),
        ("/scene/potential/0/body", json!(1), "/scene/potential/0/body", "expected a string"),
        ("/scene/potential/0/kind", json!("magnet"), "/scene/potential/0/kind", "unknown variant"),
        ("/scene/potential/0/kind", json!("mutual_gravity"), "/scene/potential/0/kind", "give `between`"),
        ("/scene/potential/0/kind", Value::Null, "/scene/potential/0", "missing field `kind`"),
        ("/scene/potential/0/body_point", json!([0, 0]), "/scene/potential/0/body_point", "n = 3 are needed"),
        ("/scene/potential/0/position", json!([0, 0, 1]), "/scene/potential/0/position", "unknown field"),
        ("/scene/potential/1/between/1", json!("secondry"), "/scene/potential/1/between/1", "did you mean `secondary`?"),
        ("/scene/potential/1/between/1", json!("primary"), "/scene/potential/1/between", "two different bodies"),
        ("/scene/potential/1/between/0", json!("space"), "/scene/potential/1/between/0", "no body has that name"),
        ("/scene/potential/1/between", json!(["primary"]), "/scene/potential/1/between", ""),
        ("/scene/potential/1/body", json!("primary"), "/scene/potential/1/body", "unknown field"),
        ("/scene/potential/1/kind", json!("uniform"), "/scene/potential/1/kind", "unknown variant"),
        ("/scene/potential/1/points", Value::Null, "/scene/potential/1", "missing field `points`"),
        ("/scene/potential/1/points/0", json!([1, 0]), "/scene/potential/1/points/0", "n = 3 are needed"),
        ("/scene/potential/1/points", json!([[1, 0, 0]]), "/scene/potential/1/points", ""),
        ("/scene/potential/1/stiffness", json!("3"), "/scene/potential/1/stiffness", "expected a number"),
        ("/scene/potential/1/rest_length", json!(-1), "/scene/potential/1/rest_length", "at least 0"),
        ("/scene/potential/3/strength", json!(1e-300), "/scene/potential/3/strength", "at least 1e-30"),
        ("/scene/potential/4/constant", json!(-1), "/scene/potential/4/constant", "at least 0"),
        ("/scene/potential/4/between/1", json!("mast"), "/scene/bodies/2/mass", "`mast` needs a mass"),
        ("/scene/joints/1/kind", json!("hinge"), "/scene/joints/1/kind", "unknown variant"),
        ("/scene/joints/1/between/0", json!("uper"), "/scene/joints/1/between/0", "did you mean `upper`?"),
        ("/scene/joints/1/between/1", json!("space"), "/scene/joints/1/between/1", "the first of the two"),
        ("/scene/joints/1/between/1", json!("upper"), "/scene/joints/1/between", "two different bodies"),
        ("/scene/joints/1/between", json!(["lower", "upper"]), "/scene/joints/1/between/1", "joint 0 holds already"),
        ("/scene/joints/0/between/0", json!("lower"), "/scene/joints/1", "loop of joints"),
        ("/scene/joints/1/points/1", json!([0]), "/scene/joints/1/points/1", "n = 3 are needed"),
        ("/scene/joints/1/axis", json!([0, 0, 1]), "/scene/joints/1/axis", "unknown field"),
    ]
}

/// Returns `several` with a field replaced, added, or taken out (`null`).
fn changed(pointer: &str, value: &Value) -> Value {
    let mut text = several();
    let (parent, key) = pointer.rsplit_once('/').expect("a pointer");
    match text.pointer_mut(parent).expect("the parent exists") {
        Value::Object(map) if value.is_null() => {
            map.remove(key).expect("the field was there");
        }
        Value::Object(map) => {
            map.insert(key.to_owned(), value.clone());
        }
        Value::Array(list) => list[key.parse::<usize>().expect("an index")] = value.clone(),
        _ => panic!("{parent} has no children"),
    }
    text
}

/// Returns a chain of links that hang on each other, the first of them free.
fn chain(links: usize) -> Value {
    let mut text = several();
    let name = |i: usize| format!("link{i}");
    let body = |i| json!({"name": name(i), "mass": 1, "inertia": {"principal": [1, 1, 1]}});
    let joint = |i| json!({"kind": "ball", "between": [name(i - 1), name(i)], "points": [[0, 0, 1], [0, 0, -1]]});
    text["scene"] = json!({
        "bodies": (0..links).map(body).collect::<Vec<_>>(),
        "joints": (1..links).map(joint).collect::<Vec<_>>(),
    });
    text
}

/// Returns scenes with one thing wrong, for the table that is tried at all entry points.
pub(crate) fn bad() -> Vec<Bad> {
    let row = |(at, value, pointer, _): &Row| Bad {
        text: changed(at, value).to_string(),
        pointer: (*pointer).to_owned(),
    };
    let of = |text: Value, pointer: &str| Bad { text: text.to_string(), pointer: pointer.into() };
    let mut bad: Vec<Bad> = rows().iter().map(row).collect();
    bad.push(of(chain(17), "/scene/joints"));
    let mut many = chain(1);
    let body = many["scene"]["bodies"][0].clone();
    let named = |i: usize| {
        let mut body = body.clone();
        body["name"] = json!(format!("body{i}"));
        body
    };
    many["scene"]["bodies"] = (0..65).map(named).collect();
    bad.push(of(many, "/scene/bodies"));
    // Of n = 4: gravity needs n = 3.
    let mut four = chain(2);
    for i in 0..2 {
        four["scene"]["bodies"][i]["inertia"] = json!({"second_moments": [1, 1, 1, 1]});
    }
    four["scene"]["joints"] = json!([]);
    four["scene"]["potential"] =
        json!([{"kind": "mutual_gravity", "between": ["link0", "link1"], "constant": 1}]);
    bad.push(of(four.clone(), "/scene/potential/0"));
    four["scene"]["potential"] = json!([]);
    four["method"] = json!({"name": "splitting"});
    bad.push(of(four, "/method/name"));
    // Nothing to which steps can adapt; another method than VPD; an end that is located within a step.
    let mut apart = several();
    apart["scene"]["potential"] = json!([several()["scene"]["potential"][1]]);
    apart["step"] = json!({"adaptive": {}});
    bad.push(of(apart.clone(), "/step/adaptive"));
    apart.as_object_mut().expect("an object").remove("step");
    apart["method"] = json!({"name": "vpd_adaptive"});
    bad.push(of(apart, "/method/name"));
    let mut adapting = several();
    adapting["step"] = json!({"adaptive": {}});
    read(&adapting).expect("a scene with two sources");
    let mut other = adapting.clone();
    other["method"] = json!({"name": "rkmk", "tableau": "rk4"});
    bad.push(of(other, "/step/adaptive"));
    let between = json!(["primary", "secondary"]);
    adapting["until"] =
        json!([{"distance_below_m": {"distance_m": 1, "between": between}, "exact": true}]);
    bad.push(of(adapting, "/until/0/exact"));
    // A term between bodies in a scene of one.
    let mut one = crate::bad_scenarios::dipole();
    one["scene"]["potential"][0]["between"] = json!(["a", "b"]);
    bad.push(of(one, "/scene/potential/0"));
    bad
}

#[test]
fn every_refusal_names_its_field_and_what_would_do() {
    for (at, value, pointer, words) in rows() {
        let error = read(&changed(at, &value)).expect_err(at);
        assert_eq!(error.pointer, pointer, "{at} = {value}: {error}");
        assert!(error.message.contains(words), "{at} = {value}: {error}");
    }
}

#[test]
fn an_unknown_first_field_is_named() {
    for text in [
        r#"{"name": "a", "scene": {"bodis": [], "potential": []}, "step_s": 1, "steps": 1}"#,
        r#"{"name": "a", "scene": {"bodis": [], "inertia": {"principal": [1, 1, 1]}}, "step_s": 1, "steps": 1}"#,
    ] {
        let error = Scenario::from_json(text.as_bytes()).expect_err("unknown");
        assert_eq!(error.pointer, "/scene/bodis");
        assert!(
            error.message.contains("`inertia`") && error.message.contains("`bodies`"),
            "{error}"
        );
    }
    let joints = r#"{"name": "a", "scene": {"joints": []}, "step_s": 1, "steps": 1}"#;
    assert_eq!(
        Scenario::from_json(joints.as_bytes()).expect_err("no bodies").pointer,
        "/scene/joints"
    );
}

#[test]
fn the_largest_scenes_are_read() {
    read(&chain(16)).expect("16 links make a tree");
    let mut grown = chain(16);
    // A second tree next to the first: the limit is one of a tree.
    let second = json!({"name": "other", "mass": 1, "inertia": {"principal": [1, 1, 1]}});
    let third = json!({"name": "another", "mass": 1, "inertia": {"principal": [1, 1, 1]}});
    let joint = |a: &str, b: &str| json!({"kind": "ball", "between": [a, b], "points": [[0, 0, 1], [0, 0, -1]]});
    let list = |text: &mut Value, key: &str, items: &[Value]| {
        text["scene"][key].as_array_mut().expect("a list").extend_from_slice(items);
    };
    list(&mut grown, "bodies", &[second, third]);
    list(&mut grown, "joints", &[joint("space", "other"), joint("other", "another")]);
    let scenario = read(&grown).expect("two trees");
    let held = scenario.bodies().expect("several").joint_of_each();
    assert_eq!(held[0], None);
    assert_eq!(held[16..], [Some(15), Some(16)]);
    // Held by space, two trees stay two.
    list(&mut grown, "joints", &[joint("space", "link0")]);
    read(&grown).expect("space joins no trees");
}

#[test]
fn a_scene_is_written_as_it_was_read() {
    let scenario = read(&several()).expect("a good scene");
    let bodies = scenario.bodies().expect("several bodies");
    assert_eq!((scenario.dimension(), bodies.bodies.len()), (3, 5));
    assert_eq!(bodies.number("mast"), Some(2));
    let again = Scenario::from_json(&scenario.to_json()).expect("canonical text is good");
    assert_eq!(scenario, again);
    assert_eq!(scenario.to_json(), again.to_json());
    // Nothing is added to a scene, or lost; only a length at rest that was left out is written.
    let written: Value = serde_json::from_slice(&scenario.to_json()).expect("JSON");
    let mut given = several();
    given["scene"]["potential"][2]["rest_length"] = json!(0);
    given["scene"]["potential"][5]["rest_length"] = json!(0);
    assert_eq!(of_floats(&written["scene"]), of_floats(&given["scene"]));
    // Any order of the keys: `kind` and `between` came last in some terms.
    let Interaction::Between { between, law: PairLaw::Spring(spring) } = &bodies.potential[1]
    else {
        panic!("a spring")
    };
    assert_eq!((between[1].as_str(), spring.rest_length), ("secondary", 1.0));
}

/// Returns a value whose numbers are all of one type.
fn of_floats(value: &Value) -> Value {
    match value {
        Value::Number(number) => json!(number.as_f64().expect("a double")),
        Value::Array(items) => items.iter().map(of_floats).collect(),
        Value::Object(map) => {
            let pairs = map.iter().map(|(key, value)| (key.clone(), of_floats(value)));
            Value::Object(pairs.collect())
        }
        other => other.clone(),
    }
}

#[test]
fn a_scene_can_be_made_in_rust() {
    let body = Body {
        name: "top".to_owned(),
        mass: Some(1.0),
        pivot: None,
        inertia: Inertia::SecondMoments(vec![1.0; 4]),
        initial: BodyInitial::default(),
    };
    let bodies = Bodies { bodies: vec![body], potential: Vec::new(), joints: Vec::new() };
    let scene = Scene::of_bodies(bodies);
    let scenario = Scenario::of("one", scene.clone(), 0.1, 10).expect("a good scene");
    assert_eq!(scenario.dimension(), 4);
    // What JSON cannot say is refused, too.
    let both = Scene { inertia: Some(Inertia::Principal([1.0; 3])), ..scene };
    let error = Scenario::of("both", both, 0.1, 10).expect_err("two kinds of scene");
    assert_eq!(error.pointer, "/scene/inertia");
}
