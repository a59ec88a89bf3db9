//! Drawings of a scene for viewers: the body's box of inertia, its points, and its surroundings.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::log::scene::{BodyHeader, Marker, Mover, SceneGeometry, Sign};
use crate::log::schema::BodyName;
use crate::plan::{ModelKinetic, Plan, driven_term, inertia_matrix};
use crate::scenario::{Bodies, Body, Drawn, DrivenTerm, Interaction, Joint, PairLaw};

/// Returns the drawing of a scene; empty unless n = 3.
pub(super) fn scene(plan: &Plan) -> SceneGeometry {
    if plan.dimension != 3 {
        return SceneGeometry::default();
    }
    if let Some(bodies) = plan.settled.bodies() {
        return surroundings(bodies);
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

/// Returns what stands in space around several bodies: anchors, charges, directions.
fn surroundings(scene: &Bodies) -> SceneGeometry {
    let mut drawn = SceneGeometry::default();
    for term in &scene.potential {
        let Interaction::On { term, .. } = term else { continue };
        let Drawn { position, direction, charge, .. } = term.law().drawn();
        let marker = |point: &[f64]| Marker { position: three(point), sign: sign(charge) };
        drawn.space_points.extend(position.map(marker));
        if let Some(direction) = direction.map(three)
            && !drawn.directions.contains(&direction)
        {
            drawn.directions.push(direction);
        }
    }
    drawn
}

/// Returns the drawing of each of several bodies; without a box unless n = 3.
pub(super) fn bodies(plan: &Plan) -> Vec<BodyHeader> {
    let Some(scene) = plan.settled.bodies() else { return Vec::new() };
    let named = scene.bodies.iter().filter_map(|body| Some((body, BodyName::of(&body.name)?)));
    let header = |(body, name): (&Body, BodyName)| {
        let (box_size, box_axes) = if plan.dimension == 3 {
            let inertia = inertia_matrix(&body.inertia);
            inertia_box(&ModelKinetic::Tensor { inertia: Matrix3::from_fn(|i, j| inertia[(i, j)]) })
        } else {
            ([0.0; 3], [1.0, 0.0, 0.0, 0.0])
        };
        let mass = body.mass.filter(|_| body.pivot.is_none());
        // Edges of a body of unit mass: those of its own are shorter by the root of its mass.
        let box_size = box_size.map(|edge| edge / mass.unwrap_or(1.0).sqrt());
        let mut points = Vec::new();
        let mut mark = |point: &[f64], charge: f64| {
            if plan.dimension == 3 {
                points.push(Marker { position: three(point), sign: sign(charge) });
            }
        };
        for term in &scene.potential {
            match term {
                Interaction::On { body: at, term } if *at == body.name => {
                    let Drawn { body_point, charge, .. } = term.law().drawn();
                    body_point.into_iter().for_each(|point| mark(point, charge));
                }
                Interaction::Between { between, law } => {
                    let (points, charge) = match law {
                        PairLaw::Spring(spring) => (&spring.points, 0.0),
                        PairLaw::PointSource(source) => (&source.points, source.strength),
                        PairLaw::MutualGravity(_) => continue,
                    };
                    let own = between.iter().zip(points).filter(|(at, _)| **at == body.name);
                    own.for_each(|(_, point)| mark(point, charge));
                }
                Interaction::On { .. } => {}
            }
        }
        for Joint { between, points, .. } in &scene.joints {
            let own = between.iter().zip(points).filter(|(at, _)| **at == body.name);
            own.for_each(|(_, point)| mark(point, 0.0));
        }
        BodyHeader { name, box_size, box_axes, points }
    };
    named.map(header).collect()
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
