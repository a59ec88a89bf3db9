//! What is made for the eye: frames, drawings, logarithms.

use nalgebra::{Matrix3, Vector3};
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
    // What a baseline without projection may arrive at.
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
