//! A stretch of a log for drawing: attitudes one after another, of several bodies also their places, and the objects of
//! the scene.
//!
//! Invariant: what is kept is bounded by what is asked for, and so is what is read of a finished log of ours; of an unfinished
//! one only the beginning is read.

use std::fs::File;
use std::ops::ControlFlow;
use std::path::Path;

use foxglove::messages::{Color, Pose, SceneUpdate, Vector3};
use mcap::McapError;
use prost::Message as _;
use schemars::JsonSchema;
use serde::Serialize;

use super::LogError;
use super::end::End;
use super::messages::{BodyState, State};
use super::order::read_by_time;
use super::reader::{self, Item, is_foreign};
use super::schema::{BodyName, Channel};

/// Number of attitudes of several bodies together, at most, of more than one time.
const MAX_OF_ALL: usize = 8000;

/// Attitudes one after another, and the drawings of the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Attitudes")]
pub struct Stretch {
    /// Time of each sample in seconds.
    pub time_s: Vec<f64>,
    /// The n x n matrix from body to space coordinates of each sample, row by row; empty for several bodies.
    pub attitude: Vec<Vec<f64>>,
    /// Angular momentum in body coordinates of each sample, in kg m^2/s, ordered as in the log.
    pub body_momentum: Vec<Vec<f64>>,
    /// Angular velocity in body coordinates of each sample, in rad/s; empty where the inertia is unknown.
    pub angular_velocity: Vec<Vec<f64>>,
    /// Each of several bodies, in the order of the scene; empty for one.
    pub bodies: Vec<BodyStretch>,
    /// Time of the last sample of the log in seconds; absent while it is being written.
    pub end_s: Option<f64>,
    /// Shapes that viewers draw; empty unless n = 3.
    pub scene: Vec<Drawing>,
}

/// One of several bodies at the times of a stretch.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "BodyAttitudes")]
pub struct BodyStretch {
    /// Its name, also that of its frame.
    pub name: String,
    /// The n x n matrix from body to space coordinates of each sample, row by row.
    pub attitude: Vec<Vec<f64>>,
    /// Angular momentum in body coordinates of each sample, in kg m^2/s, ordered as in the log.
    pub body_momentum: Vec<Vec<f64>>,
    /// Angular velocity in body coordinates of each sample, in rad/s, ordered likewise.
    pub angular_velocity: Vec<Vec<f64>>,
    /// The centre of mass in space of each sample, of a pinned body its pivot, in m: n numbers.
    pub position: Vec<Vec<f64>>,
    /// Velocity of that point in space coordinates, in m/s.
    pub velocity: Vec<Vec<f64>>,
}

/// Shapes that stand still in a frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Drawing {
    /// `body` or `space`; of several bodies the name of one.
    pub frame: String,
    /// Boxes; the size is that of the edges.
    pub boxes: Vec<Shape>,
    /// Balls; the size is that of the diameters.
    pub balls: Vec<Shape>,
    /// Arrows along their own x axis; the size is length, diameter, diameter.
    pub arrows: Vec<Shape>,
}

/// A shape where it stands.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Shape {
    /// Its middle, or the foot of an arrow.
    pub position: [f64; 3],
    /// Unit quaternion (w, x, y, z).
    pub orientation: [f64; 4],
    /// Its extent along its own axes.
    pub size: [f64; 3],
    /// Red, green, blue, opacity, from 0 to 1.
    pub color: [f64; 4],
}

/// Query for a stretch of a log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    /// Time of the first attitude in seconds, for a finished log.
    pub from_s: f64,
    /// Least time between two attitudes in seconds.
    pub every_s: f64,
    /// Largest number of times; of many bodies fewer, so that there are at most 8000 attitudes.
    pub samples: usize,
}

/// Reads attitudes from a time on; from the start if the log is unfinished.
///
/// # Errors
/// If the file cannot be read, or its index is damaged.
pub fn read_stretch(path: &Path, wanted: Wanted) -> Result<Stretch, LogError> {
    let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
    let damaged = |source| LogError::mcap(path, "read", source);
    match End::read(&mut file) {
        Some(end) => finished(&mut file, &end, wanted).map_err(damaged),
        None if is_foreign(&mut file) => rewritten(path, wanted),
        None => beginning(path, wanted),
    }
}

fn finished(file: &mut File, end: &End, wanted: Wanted) -> Result<Stretch, McapError> {
    let mut stretch = Stretch::default();
    let (start_ns, end_ns) = end.span_ns;
    stretch.end_s = Some((end_ns - start_ns) as f64 * 1e-9);
    // The scene belongs to the start.
    end.messages(file, is_drawn, start_ns..start_ns.saturating_add(1), |_, _, data| {
        stretch.draw(data);
        ControlFlow::Continue(())
    })?;
    let from_ns = start_ns.saturating_add((wanted.from_s.max(0.0) * 1e9) as u64);
    let moves = |topic: &str| Moving::of(topic).is_some();
    end.messages(file, moves, from_ns..u64::MAX, |topic, _, data| {
        stretch.take(topic, data, wanted)
    })?;
    Ok(stretch.whole())
}

/// Reads a log that another program wrote anew.
fn rewritten(path: &Path, wanted: Wanted) -> Result<Stretch, LogError> {
    let mut stretch = Stretch::default();
    let mut last_s = 0.0_f64;
    let ending = read_by_time(path, |item| {
        let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
        if let Some(moving) = Moving::of(topic) {
            let time_s = moving.time_s(data);
            last_s = last_s.max(time_s);
            if time_s >= wanted.from_s {
                // The scene may come behind, and so does the end.
                let _ = stretch.take(topic, data, wanted);
            }
        } else if is_drawn(topic) {
            stretch.draw(data);
        }
        ControlFlow::Continue(())
    })?;
    // As a log of ours has them.
    stretch.scene.sort_by(|a, b| a.frame.cmp(&b.frame));
    stretch.end_s = ending.finished.then_some(last_s);
    Ok(stretch.whole())
}

/// Reads the first samples of a log that is being written.
fn beginning(path: &Path, wanted: Wanted) -> Result<Stretch, LogError> {
    let mut stretch = Stretch::default();
    reader::read(path, |item| {
        let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
        if is_drawn(topic) {
            stretch.draw(data);
        }
        stretch.take(topic, data, wanted)
    })?;
    Ok(stretch.whole())
}

/// Returns whether a topic holds a drawing of the scene.
fn is_drawn(topic: &str) -> bool {
    use Channel::{SceneBodies, SceneBody, SceneSources};
    matches!(Channel::from_topic(topic), Some(SceneBody | SceneBodies | SceneSources))
}

/// What a message of a state tells of.
enum Moving {
    TheBody,
    OneOfSeveral(BodyName),
}

impl Moving {
    /// Returns it by the topic; `None` for other messages.
    fn of(topic: &str) -> Option<Self> {
        match Channel::with_body(topic)? {
            (Channel::State, _) => Some(Self::TheBody),
            (Channel::BodyState, Some(name)) => Some(Self::OneOfSeveral(name)),
            _ => None,
        }
    }

    fn time_s(&self, data: &[u8]) -> f64 {
        match self {
            Self::TheBody => State::decode(data).map_or(0.0, |state| state.time_s),
            Self::OneOfSeveral(_) => BodyState::decode(data).map_or(0.0, |state| state.time_s),
        }
    }
}

impl Stretch {
    /// Takes a message of a state, until there are enough; one without attitude ends the stretch.
    fn take(&mut self, topic: &str, data: &[u8], wanted: Wanted) -> ControlFlow<()> {
        match Moving::of(topic) {
            None => ControlFlow::Continue(()),
            Some(Moving::TheBody) => self.add(data, wanted),
            Some(Moving::OneOfSeveral(name)) => self.add_body(&name, data, wanted),
        }
    }

    /// Returns the shortest time of the next sample. Times that differ by rounding are the same.
    fn next_s(&self, wanted: Wanted) -> f64 {
        self.time_s.last().map_or(0.0, |last| last + wanted.every_s * (1.0 - 1e-9))
    }

    fn add(&mut self, data: &[u8], wanted: Wanted) -> ControlFlow<()> {
        match State::decode(data) {
            Ok(state) if !state.attitude.is_empty() && self.time_s.len() < wanted.samples => {
                if self.time_s.is_empty() || state.time_s >= self.next_s(wanted) {
                    self.time_s.push(state.time_s);
                    self.attitude.push(state.attitude);
                    self.body_momentum.push(state.body_momentum);
                }
                ControlFlow::Continue(())
            }
            _ => ControlFlow::Break(()),
        }
    }

    /// Takes the state of one of several bodies: those of a time come one after another.
    fn add_body(&mut self, name: &BodyName, data: &[u8], wanted: Wanted) -> ControlFlow<()> {
        let Some(state) = BodyState::decode(data).ok().filter(|state| !state.attitude.is_empty())
        else {
            return ControlFlow::Break(());
        };
        let time_s = Some(&state.time_s);
        if self.time_s.last() != time_s {
            self.drop_part();
            let most = wanted.samples.min(MAX_OF_ALL / self.bodies.len().max(1)).max(1);
            if self.time_s.len() >= most {
                return ControlFlow::Break(());
            }
            if !self.time_s.is_empty() && state.time_s < self.next_s(wanted) {
                return ControlFlow::Continue(());
            }
            self.time_s.push(state.time_s);
        }
        let at = self.time_s.len() - 1;
        let known = self.bodies.iter().position(|body| body.name == name.as_str());
        let body = match known {
            Some(k) => &mut self.bodies[k],
            None if at == 0 => {
                let name = name.as_str().to_owned();
                self.bodies.push(BodyStretch { name, ..BodyStretch::default() });
                let last = self.bodies.len() - 1;
                &mut self.bodies[last]
            }
            None => return ControlFlow::Continue(()),
        };
        if body.attitude.len() == at {
            body.attitude.push(state.attitude);
            body.body_momentum.push(state.body_momentum);
            body.angular_velocity.push(state.angular_velocity);
            body.position.push(state.position);
            body.velocity.push(state.velocity);
        }
        ControlFlow::Continue(())
    }

    /// Drops the last sample of several bodies if one of them is missing, as at the end of an unfinished log.
    fn drop_part(&mut self) {
        let Some(last) = self.time_s.len().checked_sub(1) else { return };
        if self.bodies.iter().all(|body| body.attitude.len() > last) {
            return;
        }
        self.time_s.truncate(last);
        for body in &mut self.bodies {
            let BodyStretch {
                name: _,
                attitude,
                body_momentum,
                angular_velocity,
                position,
                velocity,
            } = body;
            for kept in [attitude, body_momentum, angular_velocity, position, velocity] {
                kept.truncate(last);
            }
        }
    }

    fn whole(mut self) -> Self {
        self.drop_part();
        self
    }

    /// Takes a message of `/scene/…`.
    fn draw(&mut self, data: &[u8]) {
        let Ok(update) = SceneUpdate::decode(data) else { return };
        self.scene.extend(update.entities.into_iter().map(|entity| Drawing {
            frame: entity.frame_id,
            boxes: shapes(entity.cubes, |cube| (cube.pose, edges(cube.size), cube.color)),
            balls: shapes(entity.spheres, |ball| (ball.pose, edges(ball.size), ball.color)),
            arrows: shapes(entity.arrows, |arrow| {
                let length = arrow.shaft_length + arrow.head_length;
                (arrow.pose, [length, arrow.shaft_diameter, arrow.shaft_diameter], arrow.color)
            }),
        }));
    }
}

fn edges(size: Option<Vector3>) -> [f64; 3] {
    size.map_or([0.0; 3], |size| [size.x, size.y, size.z])
}

/// Returns the shapes of their messages; one without a place is not drawn.
fn shapes<T>(
    primitives: Vec<T>,
    parts: impl Fn(T) -> (Option<Pose>, [f64; 3], Option<Color>),
) -> Vec<Shape> {
    let shape = |primitive| {
        let (pose, size, color) = parts(primitive);
        let pose = pose?;
        let (position, turn, color) = (pose.position?, pose.orientation?, color?);
        Some(Shape {
            position: [position.x, position.y, position.z],
            orientation: [turn.w, turn.x, turn.y, turn.z],
            size,
            color: [color.r, color.g, color.b, color.a],
        })
    };
    primitives.into_iter().filter_map(shape).collect()
}
