//! Scenes that pass charges closely, for tests and benches: n = 3, a weight, and charges.

use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term, TimeScale};
use vpd_solve::so::{self, Vector};
use vpd_solve::state::State;

/// A body of n = 3 with a weight and charges (strength, body point, place), and its start.
pub(crate) struct Scene {
    pub(crate) name: &'static str,
    pub(crate) body: RigidBody<3>,
    pub(crate) scale: TimeScale,
    pub(crate) start: State<3>,
    pub(crate) until: f64,
}

fn scene(
    name: &'static str,
    moments: [f64; 3],
    weight: (f64, [f64; 3]),
    charges: &[(f64, [f64; 3], [f64; 3])],
    (axis, angle): ([f64; 3], f64),
    velocity: [f64; 3],
    until: f64,
) -> Scene {
    let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
    let uniform = Law::Uniform { weight: weight.0, body_point: weight.1.into() };
    let mut terms = vec![Term { law: uniform, space: vertical }];
    let mut near = vec![0.0];
    for (strength, y, z) in charges {
        let body_point = Vector::<3>::from(*y);
        near.push(body_point.norm());
        terms.push(Term {
            law: Law::PointSource { strength: *strength, body_point },
            space: (*z).into(),
        });
    }
    let body = RigidBody::new(Kinetic::of_moments(moments), terms, 0.0);
    let axis = Vector::<3>::from(axis).normalize() * angle;
    let attitude = so::exp(&so::hat::<3>(axis.as_slice()));
    let momentum = body.momentum(&so::hat(&velocity));
    Scene { name, body, scale: TimeScale::new(near), start: State { attitude, momentum }, until }
}

const UP: [f64; 3] = [0.0, 0.0, 1.0];
const DOWN: [f64; 3] = [0.0, 0.0, -1.0];

pub(crate) fn heavy_dipole() -> Scene {
    let at = [0.0, 0.0, -1.015];
    let charges = [(0.2, [0.0, 0.1, -1.0], at), (-0.2, [0.0, -0.1, -1.0], at)];
    let turn = ([1.0, 0.3, 0.0], 1.0);
    scene("heavy dipole", [1.01, 1.0, 0.1], (-1.0, UP), &charges, turn, [0.1, 0.15, 0.3], 6.0)
}

#[allow(dead_code, reason = "of the bench")]
fn dipole(height: f64, turn: ([f64; 3], f64), velocity: [f64; 3], name: &'static str) -> Scene {
    let at = [0.0, 0.0, height];
    let charges = [(1.0, [0.0, 0.1, -1.0], at), (-1.0, [0.0, -0.1, -1.0], at)];
    scene(name, [1.01, 1.0, 0.01], (-1.0, UP), &charges, turn, velocity, 10.0)
}

/// The gallery's: a charge swings past one that attracts it, at a distance of 1e-6.
pub(crate) fn close_charge() -> Scene {
    let charges = [(-1.0, DOWN, [0.0, 0.0, -1.000_001])];
    let turn = ([1.0, 0.0, 0.0], 0.5);
    scene("close charge", [1.0, 1.0, 0.5], (0.0, UP), &charges, turn, [-1.0, 0.0, 0.0], 0.5)
}

pub(crate) fn flyby() -> Scene {
    let charges = [(-1.0, [0.0, 0.05, -1.0], [0.0, 0.0, -1.011_249_2])];
    let turn = ([1.0, 0.2, 0.0], 1.0);
    scene("flyby", [1.0, 1.2, 0.4], (1.0, DOWN), &charges, turn, [0.1, 0.0, 0.05], 8.0)
}

#[allow(dead_code, reason = "the bench runs them all")]
pub(crate) fn scenes() -> Vec<Scene> {
    let kepler = [(-1.0, DOWN, [0.0, 0.0, -1.01])];
    vec![
        close_charge(),
        heavy_dipole(),
        dipole(-1.1, ([1.0, 0.1, 0.0], 1.2), [0.1, 0.0, -1.0], "dipole at 0.095"),
        flyby(),
        scene(
            "kepler-like",
            [1.0, 1.0, 0.5],
            (1.0, DOWN),
            &kepler,
            ([1.0, 0.0, 0.0], 0.8),
            [0.0, 0.15, 0.0],
            8.0,
        ),
        dipole(
            -1.5,
            ([1.0, 0.0, 0.0], std::f64::consts::FRAC_PI_2),
            [0.0, 0.0, -1.0],
            "dipole at 0.5",
        ),
    ]
}
