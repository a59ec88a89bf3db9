//! A start relative to the frame of an orbit.

use serde_json::{Value, json};
use vpd::log::reader::{Message, read_samples};
use vpd::solve::so::Mat;

use crate::scenarios::run;

/// Returns a free body with a start.
fn free(initial: &Value) -> Value {
    json!({
        "name": "start",
        "scene": { "inertia": { "principal": [1.0, 2.0, 2.5] }, "initial": initial },
        "step_s": 0.1,
        "steps": 1,
        "log": { "channels": ["/state"] }
    })
}

/// Returns the attitude of the first sample.
fn started(scenario: &Value) -> Mat<3> {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("start.mcap");
    run(&scenario.to_string(), &log);
    let mut first = None;
    read_samples(&log, |_, message| {
        if let Message::State(state) = message {
            first.get_or_insert(Mat::from_row_slice(&state.attitude));
        }
    })
    .expect("a log");
    first.expect("a sample")
}

/// The matrix of a turn about axis `k`, as it stands in any book.
fn about(k: usize, angle_rad: f64) -> Mat<3> {
    let (c, s) = (angle_rad.cos(), angle_rad.sin());
    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
    let mut g = Mat::identity();
    (g[(i, i)], g[(i, j)], g[(j, i)], g[(j, j)]) = (c, -s, s, c);
    g
}

fn assert_near(found: &Mat<3>, right: &Mat<3>, what: &str) {
    let off = (found - right).amax();
    assert!(off <= 1e-14, "{what}: off by {off:e}\n{found}{right}");
}

/// The frame of an orbit, from Kepler's equation solved here, where the orbit is at t = 0.
#[test]
fn an_attitude_may_be_relative_to_the_frame_of_an_orbit() {
    let scene = |orbit: Value, initial: Value| {
        let mut scenario = free(&initial);
        let term = json!({ "kind": "gravity_gradient", "strength": 3e-6, "direction": [0, 0, 1] });
        let weight = json!({ "kind": "uniform", "weight": 0.1, "body_point": [1, 0, 0], "direction": [1, 0, 0] });
        scenario["scene"]["driven"] = json!([
            { "term": weight, "factor": { "harmonic": { "amplitude": 1, "rate_rad_s": 1 } } },
            { "term": term, "path": { "orbit": orbit } },
        ]);
        scenario
    };
    let orbits: [(f64, f64, f64); 4] =
        [(1e-3, 0.0, 0.0), (1e-3, 0.0, 1.0), (1e-3, 0.4, 2.0), (-1e-3, 0.4, -0.7)];
    for (rate, eccentricity, anomaly) in orbits {
        let mut eccentric: f64 = anomaly;
        for _ in 0..50 {
            let off = eccentric - eccentricity * eccentric.sin() - anomaly;
            eccentric -= off / (1.0 - eccentricity * eccentric.cos());
        }
        let half = ((1.0 + eccentricity) / (1.0 - eccentricity)).sqrt() * (0.5 * eccentric).tan();
        let angle = 2.0 * half.atan();
        // From z towards -y, at a negative rate the other way round.
        let turns = rate.signum();
        let z = [0.0, -angle.sin(), angle.cos()];
        let momentum = [turns, 0.0, 0.0];
        let y = momentum.map(|x: f64| -x);
        let x = [y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0]];
        let frame = Mat::<3>::from_fn(|i, j| [x[i], y[i], z[i]][j]);
        let orbit = json!({
            "towards": [0, -2, 0.5], "mean_motion_rad_s": rate, "eccentricity": eccentricity,
            "mean_anomaly_rad": anomaly,
        });
        let what = format!("{rate} rad/s, e = {eccentricity}, M = {anomaly}");
        let found = started(&scene(orbit.clone(), json!({ "orbit_frame": 1 })));
        assert_near(&found, &frame, &what);
        let tilted = json!({
            "orbit_frame": 1, "attitude": { "roll_pitch_yaw": { "angles_rad": [0.3, 0, 0] } },
        });
        assert_near(&started(&scene(orbit, tilted)), &(frame * about(0, 0.3)), &what);
    }
}
