//! Contents of a log for viewers: frames, drawings, logarithms.

use foxglove::messages::{FrameTransforms, SceneUpdate};
use nalgebra::{Matrix3, Vector3};
use prost::Message;
use vpd::log::messages::{self, quaternion};
use vpd::log::scene::SceneGeometry;
use vpd::solve::so::Mat;

use super::fixture::*;

#[test]
fn logarithms_stay_finite() {
    assert_eq!(messages::log10_size(0.0), -20.0);
    assert_eq!(messages::log10_size(5e-324), -20.0);
    assert_eq!(messages::log10_size(-1e-12), -12.0);
    assert_eq!(messages::log10_size(1.0), 0.0);
}

#[test]
fn a_quaternion_turns_like_its_matrix() {
    let mut random = 0x5eed_0002_u64;
    let mut draw = || next(&mut random) as f64 / u64::MAX as f64 * 2.0 - 1.0;
    let half_turns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        .map(|axis| Vector3::from(axis) * std::f64::consts::PI);
    let random_turns: Vec<_> =
        (0..1000).map(|_| Vector3::new(draw(), draw(), draw()) * 3.0).collect();
    for turn in half_turns.into_iter().chain([Vector3::zeros()]).chain(random_turns) {
        let g: Mat<3> = *nalgebra::Rotation3::new(turn).matrix();
        let [w, x, y, z] = quaternion(&g).expect("n = 3");
        assert!(w >= 0.0);
        let back = Matrix3::new(
            w * w + x * x - y * y - z * z,
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
            2.0 * (x * y + w * z),
            w * w - x * x + y * y - z * z,
            2.0 * (y * z - w * x),
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            w * w - x * x - y * y + z * z,
        );
        assert!((back - g).amax() < 2e-15, "{turn}");
    }
    assert_eq!(quaternion(&Mat::<4>::identity()), None);
    // A baseline without projection may end there.
    for g in [Mat::<3>::repeat(1e200), Mat::<3>::zeros(), -Mat::<3>::identity()] {
        let q = quaternion(&g).expect("n = 3");
        assert!((q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-15, "{q:?}");
    }
}

#[test]
fn arrows_point_along_their_directions() {
    let directions = [[0.0, 0.0, -2.0], [-1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [1.0, -2.0, 0.5]];
    let scene = SceneGeometry { directions: directions.to_vec(), ..SceneGeometry::default() };
    let drawn = scene.sources(EPOCH_NS).expect("something to draw");
    let arrows = &drawn.entities[0].arrows;
    assert_eq!(arrows.len(), directions.len());
    for (arrow, along) in arrows.iter().zip(directions) {
        let turn = arrow.pose.and_then(|pose| pose.orientation).expect("a pose");
        let turn = nalgebra::Quaternion::new(turn.w, turn.x, turn.y, turn.z);
        assert!((turn.norm() - 1.0).abs() < 1e-15);
        let tip = nalgebra::Unit::new_unchecked(turn) * Vector3::x();
        assert!((tip - Vector3::from(along).normalize()).amax() < 1e-15, "{along:?}");
    }
    assert_eq!(SceneGeometry::default().sources(EPOCH_NS), None);
}

/// The frames of moving sources carry the drawings along.
#[test]
fn moving_sources_are_drawn_where_they_are() {
    let scenario = serde_json::json!({
        "name": "moving",
        "scene": {
            "inertia": { "principal": [1.0, 0.8, 0.5] },
            "driven": [
                { "term": { "kind": "uniform", "weight": 1.0, "body_point": [0, 0, 0.5], "direction": [1, 0, 0] },
                  "path": { "turning": { "from": [1, 0, 0], "towards": [0, 1, 0], "rate_rad_s": 2.0 } } },
                { "term": { "kind": "point_source", "strength": 0.1, "body_point": [0, 0, 0.5], "position": [0, 2, 0] },
                  "path": { "orbit": { "towards": [0, 0, 1], "mean_motion_rad_s": 0.5 } } },
                { "term": { "kind": "uniform", "weight": 0.1, "body_point": [0, 0.5, 0], "direction": [0, 0, 1] },
                  "factor": { "harmonic": { "mean": 1.0, "amplitude": 0.5, "rate_rad_s": 1.0 } } }
            ],
            "initial": { "angular_velocity": { "body": [0.1, 0.2, 0.3] } }
        },
        "step_s": 0.01, "steps": 100, "log": { "every": 10, "channels": ["/tf", "/scene/sources"] }
    });
    let scenario = vpd::scenario::Scenario::from_json(scenario.to_string().as_bytes())
        .expect("a good scenario");
    let plan = vpd::advise::plan(&scenario).expect("a plan");
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = directory.path().join("moving.mcap");
    let control = vpd::run::Control::default();
    vpd::run::execute(&plan, &vpd::run::JobContext { log: &path, control: &control })
        .expect("a log");
    let bytes = std::fs::read(&path).expect("a log");
    let (mut frames, mut drawings) = (Vec::new(), Vec::new());
    for message in mcap::MessageStream::new(&bytes).expect("a log") {
        let message = message.expect("a message");
        match message.channel.topic.as_str() {
            "/tf" => frames.push(FrameTransforms::decode(&*message.data).expect("frames")),
            "/scene/sources" => drawings.push(SceneUpdate::decode(&*message.data).expect("drawn")),
            _ => {}
        }
    }
    let [drawn] = drawings.as_slice() else { panic!("{drawings:?}") };
    let names: Vec<&str> = drawn.entities.iter().map(|entity| entity.frame_id.as_str()).collect();
    assert_eq!(names, ["space", "source/0", "source/1"]);
    assert_eq!((drawn.entities[1].arrows.len(), drawn.entities[2].spheres.len()), (1, 1));
    assert_eq!(frames.len(), 11);
    // One unit is the distance at which the farthest part of the body is drawn.
    let unit = 2.0 / frames[0].transforms[2].translation.expect("a place").y;
    for (k, frame) in frames.iter().enumerate() {
        let t = 0.1 * k as f64;
        let [body, arrow, ball] = frame.transforms.as_slice() else { panic!("{frame:?}") };
        assert_eq!(body.child_frame_id, "body");
        let turn = arrow.rotation.expect("a rotation");
        let turn = nalgebra::Quaternion::new(turn.w, turn.x, turn.y, turn.z);
        let along = nalgebra::Unit::new_normalize(turn) * Vector3::x();
        let expected = Vector3::new((2.0 * t).cos(), (2.0 * t).sin(), 0.0);
        assert!((along - expected).amax() < 1e-14, "{along}");
        let place = ball.translation.expect("a place");
        let place = Vector3::new(place.x, place.y, place.z) * unit;
        let expected = Vector3::new(0.0, 2.0 * (0.5 * t).cos(), 2.0 * (0.5 * t).sin());
        assert!((place - expected).amax() < 1e-13, "{place}");
    }
}
