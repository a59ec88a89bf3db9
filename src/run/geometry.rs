//! What viewers draw of a scene: the body's box of inertia, its points, and what stands around it.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::log::scene::{Marker, SceneGeometry, Sign};
use crate::plan::{ModelKinetic, Plan};
use crate::scenario::PotentialTerm;

/// The drawing of a scene; empty unless n = 3.
pub(super) fn scene(plan: &Plan) -> SceneGeometry {
    if plan.dimension != 3 {
        return SceneGeometry::default();
    }
    let (box_size, box_axes) = inertia_box(&plan.model.kinetic);
    let mut scene = SceneGeometry { box_size, box_axes, ..SceneGeometry::default() };
    let neutral = |position: &[f64]| Marker { position: three(position), sign: Sign::Neutral };
    let mut directions = Vec::new();
    for term in &plan.model.shown {
        match term {
            PotentialTerm::Uniform(term) => {
                scene.body_points.push(neutral(&term.body_point));
                directions.push(three(&term.direction));
            }
            PotentialTerm::PointSource(term) => {
                let sign = if term.strength > 0.0 { Sign::Positive } else { Sign::Negative };
                scene.body_points.push(Marker { position: three(&term.body_point), sign });
                scene.space_points.push(Marker { position: three(&term.position), sign });
            }
            PotentialTerm::Spring(term) => {
                scene.body_points.push(neutral(&term.body_point));
                scene.space_points.push(neutral(&term.position));
            }
            PotentialTerm::GravityGradient(term) => directions.push(three(&term.direction)),
        }
    }
    for direction in directions {
        if !scene.directions.contains(&direction) {
            scene.directions.push(direction);
        }
    }
    scene
}

fn three(v: &[f64]) -> [f64; 3] {
    [v[0], v[1], v[2]]
}

/// Edges and orientation (w, x, y, z) of the homogeneous box of unit mass with the body's inertia: an
/// edge a has the second moment a^2 / 12. A negative second moment, which no real body has, is drawn flat.
fn inertia_box(kinetic: &ModelKinetic) -> ([f64; 3], [f64; 4]) {
    let (moments, axes) = match kinetic {
        // w_ij = 1 / J_k for the plane (i, j) about the axis k.
        ModelKinetic::Principal { weights } => (
            Vector3::new(1.0 / weights[(1, 2)], 1.0 / weights[(0, 2)], 1.0 / weights[(0, 1)]),
            Matrix3::identity(),
        ),
        ModelKinetic::Tensor { inertia } => {
            let eigen = inertia.symmetric_eigen();
            let mut axes = eigen.eigenvectors;
            if axes.determinant() < 0.0 {
                axes = -axes;
            }
            (eigen.eigenvalues, axes)
        }
    };
    let edges = [0, 1, 2].map(|k| {
        let second_moment = 0.5 * moments.sum() - moments[k];
        (12.0 * second_moment.max(0.0)).sqrt()
    });
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    (edges, [turn.w, turn.i, turn.j, turn.k])
}
