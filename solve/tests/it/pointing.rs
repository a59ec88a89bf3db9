//! Where a body points: frames of orbits, angles and rates relative to them.

use vpd_solve::control::Target;
use vpd_solve::hamiltonian::{Kinetic, RigidBody};
use vpd_solve::pointing::{Frame, Pointed, Pointing};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::system::System as _;

fn unit(v: [f64; 3]) -> Vector<3> {
    Vector::from(v).normalize()
}

/// Turns by roll, pitch and yaw, as they stand in any book.
fn turned([roll, pitch, yaw]: [f64; 3]) -> Mat<3> {
    let about = |k: usize, angle: f64| {
        let mut x = [0.0; 3];
        x[k] = angle;
        so::exp(&so::hat::<3>(&x))
    };
    about(2, yaw) * about(1, pitch) * about(0, roll)
}

fn seen(frame: &Frame<3>, time_s: f64, g: &Mat<3>, omega: &Mat<3>) -> Pointed {
    let pointing = Pointing {
        frame: frame.clone(),
        axis: unit([0.0, 0.0, 1.0]),
        towards: unit([0.0, 0.0, 1.0]),
    };
    let body = RigidBody::new(Kinetic::of_moments([1.0, 2.0, 2.5]), Vec::new(), 0.0);
    body.with_pointing(pointing).pointed(time_s, g, omega).expect("it was asked for")
}

/// The rotation of a unit quaternion.
fn rotation([w, x, y, z]: [f64; 4]) -> Mat<3> {
    let q = nalgebra::Quaternion::new(w, x, y, z);
    nalgebra::UnitQuaternion::from_quaternion(q).to_rotation_matrix().into_inner()
}

fn orbits() -> Vec<Frame<3>> {
    let p = unit([0.3, -0.4, 1.0]);
    let q = unit([1.0, 0.0, 0.2]);
    let q = (q - p * p.dot(&q)).normalize();
    let orbit = |mean_motion: f64, eccentricity: f64, node_rate: f64| Frame::Orbit {
        plane: [p, q],
        mean_motion,
        eccentricity,
        mean_anomaly: 0.7,
        node_rate,
    };
    let turning = Target { start: turned([0.3, 0.2, -0.5]), plane: [p, q], rate: 0.02 };
    vec![
        orbit(1e-2, 0.0, 0.0),
        orbit(1e-2, 0.4, 0.0),
        orbit(-1e-2, 0.4, 0.0),
        orbit(1e-2, 0.4, -2e-3),
        Frame::Target(turning),
    ]
}

/// The frame of an orbit: z as Kepler has it, y against the angular momentum, x = y cross z, ahead if z points to the planet; its rate
/// is the derivative of the frame, for which the rate of a body that follows it vanishes.
#[test]
fn frames_of_orbits_are_those_of_kepler() {
    for frame in orbits() {
        let at =
            |time_s: f64| rotation(seen(&frame, time_s, &Mat::identity(), &Mat::zeros()).frame);
        for time_s in [0.0, 100.0, 333.0, 612.0] {
            let axes = at(time_s);
            let [x, y, z] = [0, 1, 2].map(|k| Vector::<3>::from(axes.column(k)));
            assert!((y.cross(&z) - x).norm() < 1e-14);
            if let Frame::Orbit {
                plane: [p, q],
                mean_motion,
                eccentricity: e,
                mean_anomaly,
                node_rate,
            } = &frame
            {
                let node = so::exp(&so::hat(&[0.0, 0.0, node_rate * time_s]));
                let [p, q] = [node * p, node * q];
                let mean = mean_anomaly + mean_motion * time_s;
                let mut anomaly = mean;
                for _ in 0..200 {
                    anomaly = mean + e * anomaly.sin();
                }
                let place = p * (anomaly.cos() - e) + q * ((1.0 - e * e).sqrt() * anomaly.sin());
                assert!((z - place.normalize()).norm() < 1e-12, "{time_s}");
                let momentum = p.cross(&q) * mean_motion.signum();
                assert!((y + momentum).norm() < 1e-14, "{time_s}");
            }
            let h = 1e-2;
            let rate = (at(time_s + h) - at(time_s - h)) / (2.0 * h) * axes.transpose();
            let g = turned([0.4, -0.9, 2.0]);
            let follows = g.transpose() * rate * g;
            let found = seen(&frame, time_s, &g, &((follows - follows.transpose()) * 0.5));
            let size = found.rate_rad_s.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            assert!(size < 1e-8, "{time_s}: {size:e}");
        }
    }
}

/// Roll, pitch and yaw are those by which the body was turned, and the error of the axis the angle between two lines; also next to half
/// a turn and where the pitch is at its end.
#[test]
fn angles_are_those_by_which_a_body_was_turned() {
    for frame in orbits() {
        let time_s = 250.0;
        let axes = rotation(seen(&frame, time_s, &Mat::identity(), &Mat::zeros()).frame);
        for angles in
            [[0.0; 3], [0.3, -0.4, 1.2], [-3.1, 1.5, 3.1], [3.0, -1.2, -2.0], [1e-9, 2e-9, -3e-9]]
        {
            let found = seen(&frame, time_s, &(axes * turned(angles)), &Mat::zeros());
            for (found, right) in found.roll_pitch_yaw_rad.iter().zip(angles) {
                assert!((found - right).abs() < 1e-14 / angles[1].cos(), "{angles:?}: {found}");
            }
            let cosine: f64 = angles[0].cos() * angles[1].cos();
            let error = found.axis_error_rad;
            assert!((error.cos() - cosine).abs() < 1e-14, "{angles:?}: {error}");
        }
        let small = seen(&frame, time_s, &(axes * turned([3e-9, 4e-9, 0.0])), &Mat::zeros());
        assert!((small.axis_error_rad - 5e-9).abs() < 2e-15, "{:e}", small.axis_error_rad);
        for pitch in [0.5, -0.5].map(|x| x * std::f64::consts::PI) {
            let found = seen(&frame, time_s, &(axes * turned([0.7, pitch, 0.2])), &Mat::zeros());
            let again = axes * turned(found.roll_pitch_yaw_rad);
            assert!((again - axes * turned([0.7, pitch, 0.2])).amax() < 1e-9);
        }
    }
}
