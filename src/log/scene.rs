//! Drawings for viewers: the body's box of inertia with its points, and its surroundings.
//!
//! Invariant: body and sources move by their frames alone, so each drawing is sent once, at the start.
//!
//! Drawings are in units of the scene's own length, not in metres, so that one camera sees a gyroscope of
//! centimetres as well as a satellite. Several bodies are in metres, as their positions are.

use std::borrow::Cow;

use foxglove::messages::{
    ArrowPrimitive, Color, CubePrimitive, Duration, FrameTransform, Pose, Quaternion, SceneEntity,
    SceneUpdate, SpherePrimitive, Vector3,
};

use super::schema::{BodyName, timestamp};
use crate::solve::hamiltonian::DrivenTerm;

/// Name of the inertial frame.
pub const SPACE_FRAME: &str = "space";
/// Name of the frame that turns with the body.
pub const BODY_FRAME: &str = "body";

/// Name of the frame relative to which the body points.
pub const REFERENCE_FRAME: &str = "reference";

/// Returns the name of the frame that turns with a member of an ensemble; that of member 0 is the
/// body's.
pub fn body_frame(member: u64) -> Cow<'static, str> {
    if member == 0 { BODY_FRAME.into() } else { format!("{BODY_FRAME}/{member}").into() }
}

/// Returns the name of the frame of the k-th source that moves.
fn source_frame(k: usize) -> String {
    format!("source/{k}")
}

/// Objects to draw; empty unless n = 3.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneGeometry {
    /// Edge lengths of the box with the body's inertia; zeros for none.
    pub box_size: [f64; 3],
    /// Orientation of the box in the body frame: unit quaternion (w, x, y, z).
    pub box_axes: [f64; 4],
    /// Points of the body on which forces act, in the body frame.
    pub body_points: Vec<Marker>,
    /// Charges and anchors, in the space frame.
    pub space_points: Vec<Marker>,
    /// Directions of uniform fields and of gravity, in the space frame; lengths are ignored.
    pub directions: Vec<[f64; 3]>,
    /// Objects that move, each in a frame of its own.
    pub moving: Vec<Mover>,
}

/// One of several bodies in the head of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyHeader {
    /// Its name, also that of its frame.
    pub name: BodyName,
    /// Edge lengths of the box with its inertia, in m; zeros for none.
    pub box_size: [f64; 3],
    /// Orientation of the box in the body frame: unit quaternion (w, x, y, z).
    pub box_axes: [f64; 4],
    /// Points on which forces and joints act, in the body frame.
    pub points: Vec<Marker>,
}

impl BodyHeader {
    /// Returns the body with its points and axes, in its own frame, in metres: bodies stand at their distances.
    pub fn drawn(&self, time_ns: u64) -> SceneUpdate {
        let name = self.name.as_str();
        let Self { box_size, box_axes, points, .. } = self;
        let length = unit(points, *box_size);
        update(body(entity(name, name, time_ns), (*box_size, *box_axes), points, [1.0, length]))
    }
}

/// A source that moves.
#[derive(Clone, Debug, PartialEq)]
pub struct Mover {
    /// The term that moves it.
    pub term: DrivenTerm<3>,
    /// Colour of a charge or an anchor at its place; `None` for a direction.
    pub ball: Option<Sign>,
}

/// A point to draw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker {
    /// Position of the point.
    pub position: [f64; 3],
    /// Colour of the point.
    pub sign: Sign,
}

/// The colour of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// A positive charge: red.
    Positive,
    /// A negative charge: blue.
    Negative,
    /// An anchor or a weight: grey.
    Neutral,
}

impl SceneGeometry {
    /// Returns the body with its points and axes, in its own frame.
    pub fn body(&self, time_ns: u64) -> SceneUpdate {
        let entity = entity("body", BODY_FRAME, time_ns);
        let inertia = (self.box_size, self.box_axes);
        update(body(entity, inertia, &self.body_points, [self.unit(), 1.0]))
    }

    /// Returns whether anything stands around the body.
    pub fn has_sources(&self) -> bool {
        !self.space_points.is_empty() || !self.directions.is_empty() || !self.moving.is_empty()
    }

    /// Returns charges, anchors and directions, in space coordinates; `None` if there are none.
    pub fn sources(&self, time_ns: u64) -> Option<SceneUpdate> {
        if !self.has_sources() {
            return None;
        }
        let unit = self.unit();
        let mut entity = entity("sources", SPACE_FRAME, time_ns);
        entity.spheres.extend(self.space_points.iter().map(|point| sphere(point, unit, 0.12)));
        let yellow = [0.93, 0.75, 0.15];
        entity.arrows.extend(self.directions.iter().map(|&along| arrow(along, 1.5, 0.03, yellow)));
        let fixed = !entity.spheres.is_empty() || !entity.arrows.is_empty();
        let mut entities: Vec<SceneEntity> = fixed.then_some(entity).into_iter().collect();
        entities.extend(self.moving.iter().enumerate().map(|(k, mover)| {
            let frame = source_frame(k);
            let mut entity = self::entity(&frame, &frame, time_ns);
            match mover.ball {
                Some(sign) => {
                    entity.spheres.push(sphere(&Marker { position: [0.0; 3], sign }, unit, 0.12));
                }
                None => entity.arrows.push(arrow([1.0, 0.0, 0.0], 1.5, 0.03, yellow)),
            }
            entity
        }));
        Some(SceneUpdate { deletions: Vec::new(), entities })
    }

    /// Returns the frames of the moving objects as seen from space, for viewers: a charge is at the
    /// origin of its frame, a direction along the x axis.
    pub fn frames(&self, time_s: f64, time_ns: u64) -> Vec<FrameTransform> {
        let frame = |(k, mover): (usize, &Mover)| {
            let now = <[f64; 3]>::from(mover.term.space_at(time_s));
            let pose = match mover.ball {
                Some(_) => pose(now.map(|x| x / self.unit()), [1.0, 0.0, 0.0, 0.0]),
                None => pose([0.0; 3], turn_to(now)),
            };
            let Pose { position, orientation } = pose.unwrap_or_default();
            FrameTransform {
                timestamp: timestamp(time_ns),
                parent_frame_id: SPACE_FRAME.to_owned(),
                child_frame_id: source_frame(k),
                translation: position,
                rotation: orientation,
            }
        };
        self.moving.iter().enumerate().map(frame).collect()
    }

    /// Returns the length that is drawn as 1: half the longest edge, or the distance of the
    /// farthest body point.
    fn unit(&self) -> f64 {
        unit(&self.body_points, self.box_size)
    }
}

/// Returns half the longest edge of a box, or the distance of the farthest point; 1 if there are none.
fn unit(points: &[Marker], box_size: [f64; 3]) -> f64 {
    let points = points.iter().map(|point| norm(point.position));
    let edges = box_size.into_iter().map(|edge| 0.5 * edge);
    let size = points.chain(edges).fold(0.0, f64::max);
    if size > 0.0 { size } else { 1.0 }
}

/// Adds a box, its points and the axes to an entity. The length `unit` is drawn as 1; axes and thickness are in parts of
/// the drawn `length`.
fn body(
    mut entity: SceneEntity,
    (box_size, box_axes): ([f64; 3], [f64; 4]),
    points: &[Marker],
    [unit, length]: [f64; 2],
) -> SceneEntity {
    if box_size.iter().any(|&edge| edge > 0.0) {
        // A flat or thin body keeps a visible thickness.
        let [x, y, z] = box_size.map(|edge| (edge / unit).max(0.01 * length));
        entity.cubes.push(CubePrimitive {
            pose: pose([0.0; 3], box_axes),
            size: Some(Vector3 { x, y, z }),
            color: color([0.62, 0.66, 0.72], 0.7),
        });
    }
    entity.spheres.extend(points.iter().map(|point| sphere(point, unit, 0.08 * length)));
    // The usual colours: x red, y green, z blue. Their tips come out of the box.
    for k in 0..3 {
        let axis = std::array::from_fn(|i| if i == k { 1.0 } else { 0.0 });
        entity.arrows.push(arrow(axis, 1.3 * length, 0.02 * length, axis));
    }
    entity
}

fn entity(id: &str, frame: &str, time_ns: u64) -> SceneEntity {
    SceneEntity {
        timestamp: timestamp(time_ns),
        frame_id: frame.to_owned(),
        id: id.to_owned(),
        // Zero means: until replaced.
        lifetime: Some(Duration::new(0, 0)),
        frame_locked: true,
        ..SceneEntity::default()
    }
}

fn update(entity: SceneEntity) -> SceneUpdate {
    SceneUpdate { deletions: Vec::new(), entities: vec![entity] }
}

fn sphere(point: &Marker, unit: f64, diameter: f64) -> SpherePrimitive {
    let rgb = match point.sign {
        Sign::Positive => [0.86, 0.20, 0.18],
        Sign::Negative => [0.16, 0.38, 0.85],
        Sign::Neutral => [0.45, 0.45, 0.45],
    };
    SpherePrimitive {
        pose: pose(point.position.map(|x| x / unit), [1.0, 0.0, 0.0, 0.0]),
        size: Some(Vector3 { x: diameter, y: diameter, z: diameter }),
        color: color(rgb, 1.0),
    }
}

/// Returns an arrow from the origin.
fn arrow(along: [f64; 3], length: f64, diameter: f64, rgb: [f64; 3]) -> ArrowPrimitive {
    ArrowPrimitive {
        pose: pose([0.0; 3], turn_to(along)),
        shaft_length: 0.85 * length,
        shaft_diameter: diameter,
        head_length: 0.15 * length,
        head_diameter: 2.5 * diameter,
        color: color(rgb, 1.0),
    }
}

/// Returns the rotation that turns the x axis, along which viewers draw arrows, to a direction.
fn turn_to(direction: [f64; 3]) -> [f64; 4] {
    let length = norm(direction);
    if !(length > 0.0 && length.is_finite()) {
        return [1.0, 0.0, 0.0, 0.0];
    }
    let [x, y, z] = direction.map(|c| c / length);
    // Half-way quaternion (1 + e_x . d, e_x cross d); for d = -e_x half a turn about z.
    let q = [1.0 + x, 0.0, -z, y];
    let size = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if size < 1e-8 { [0.0, 0.0, 0.0, 1.0] } else { q.map(|c| c / size) }
}

fn pose([x, y, z]: [f64; 3], [qw, qx, qy, qz]: [f64; 4]) -> Option<Pose> {
    Some(Pose {
        position: Some(Vector3 { x, y, z }),
        orientation: Some(Quaternion { x: qx, y: qy, z: qz, w: qw }),
    })
}

fn color([r, g, b]: [f64; 3], a: f64) -> Option<Color> {
    Some(Color { r, g, b, a })
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}
