//! Drawings of a scene for viewers: the body's box of inertia, its points, and its surroundings.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::log::scene::{Marker, Mover, SceneGeometry, Sign};
use crate::plan::{ModelKinetic, Plan, driven_term};
use crate::scenario::{Drawn, DrivenTerm};

/// Returns the drawing of a scene; empty unless n = 3.
pub(super) fn scene(plan: &Plan) -> SceneGeometry {
    if plan.dimension != 3 {
        return SceneGeometry::default();
    }
    let (box_size, box_axes) = inertia_box(&plan.model.kinetic);
    let mut scene = SceneGeometry { box_size, box_axes, ..SceneGeometry::default() };
    let mut directions = Vec::new();
    let stays = |driven: &DrivenTerm| driven.path.is_none();
    let driven = plan.model.driven.iter();
    for term in plan
        .model
        .shown
        .iter()
        .chain(driven.clone().filter(|term| stays(term)).map(|fixed| &fixed.term))
    {
        let Drawn { body_point, position, direction, charge } = term.law().drawn();
        let marker = |point: &[f64]| Marker { position: three(point), sign: sign(charge) };
        scene.body_points.extend(body_point.map(marker));
        scene.space_points.extend(position.map(marker));
        directions.extend(direction.map(three));
    }
    for mover in driven.filter(|driven| !stays(driven)) {
        let Drawn { body_point, position, direction: _, charge } = mover.term.law().drawn();
        let sign = sign(charge);
        scene.body_points.extend(body_point.map(|at| Marker { position: three(at), sign }));
        scene.moving.push(Mover { term: driven_term(mover), ball: position.map(|_| sign) });
    }
    for direction in directions {
        if !scene.directions.contains(&direction) {
            scene.directions.push(direction);
        }
    }
    scene
}

fn sign(charge: f64) -> Sign {
    match charge {
        0.0 => Sign::Neutral,
        charge if charge > 0.0 => Sign::Positive,
        _ => Sign::Negative,
    }
}

fn three(v: &[f64]) -> [f64; 3] {
    [v[0], v[1], v[2]]
}

/// Returns edges and orientation (w, x, y, z) of the homogeneous box of unit mass with the body's
/// inertia: an edge a has the second moment a^2 / 12. A negative second moment, which no real body
/// has, is drawn flat.
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
