//! A stretch of a log for drawing: attitudes one after another, and the objects of the scene.
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
use super::messages::State;
use super::order::read_by_time;
use super::reader::{self, Item, is_foreign};
use super::schema::Channel;

/// Attitudes one after another, and the drawings of the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Attitudes")]
pub struct Stretch {
    /// Time of each sample in seconds.
    pub time_s: Vec<f64>,
    /// The n x n matrix from body to space coordinates of each sample, row by row.
    pub attitude: Vec<Vec<f64>>,
    /// Angular momentum in body coordinates of each sample, in kg m^2/s, ordered as in the log.
    pub body_momentum: Vec<Vec<f64>>,
    /// Angular velocity in body coordinates of each sample, in rad/s; empty where the inertia is unknown.
    pub angular_velocity: Vec<Vec<f64>>,
    /// Time of the last sample of the log in seconds; absent while it is being written.
    pub end_s: Option<f64>,
    /// Shapes that viewers draw; empty unless n = 3.
    pub scene: Vec<Drawing>,
}

/// Shapes that stand still in a frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct Drawing {
    /// `body` or `space`.
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
    /// Largest number of attitudes.
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
    let scene = [Channel::SceneBody.topic(), Channel::SceneSources.topic()];
    // The scene belongs to the start.
    end.messages(file, &scene, start_ns..start_ns.saturating_add(1), |_, data| {
        stretch.draw(data);
        ControlFlow::Continue(())
    })?;
    let from_ns = start_ns.saturating_add((wanted.from_s.max(0.0) * 1e9) as u64);
    let topic = [Channel::State.topic()];
    end.messages(file, &topic, from_ns..u64::MAX, |_, data| stretch.add(data, wanted))?;
    Ok(stretch)
}

/// Reads a log that another program wrote anew.
fn rewritten(path: &Path, wanted: Wanted) -> Result<Stretch, LogError> {
    let mut stretch = Stretch::default();
    let mut last_s = 0.0_f64;
    let ending = read_by_time(path, |item| {
        let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
        match Channel::from_topic(topic) {
            Some(Channel::State) => {
                let time_s = State::decode(data).map_or(0.0, |state| state.time_s);
                last_s = last_s.max(time_s);
                if time_s >= wanted.from_s {
                    // The scene may come behind, and so does the end.
                    let _ = stretch.add(data, wanted);
                }
            }
            Some(Channel::SceneBody | Channel::SceneSources) => stretch.draw(data),
            _ => {}
        }
        ControlFlow::Continue(())
    })?;
    // As a log of ours has them.
    stretch.scene.sort_by(|a, b| a.frame.cmp(&b.frame));
    stretch.end_s = ending.finished.then_some(last_s);
    Ok(stretch)
}

/// Reads the first samples of a log that is being written.
fn beginning(path: &Path, wanted: Wanted) -> Result<Stretch, LogError> {
    let mut stretch = Stretch::default();
    reader::read(path, |item| {
        let Item::Message { topic, data, .. } = item else { return ControlFlow::Continue(()) };
        match Channel::from_topic(topic) {
            Some(Channel::State) => return stretch.add(data, wanted),
            Some(Channel::SceneBody | Channel::SceneSources) => stretch.draw(data),
            _ => {}
        }
        ControlFlow::Continue(())
    })?;
    Ok(stretch)
}

impl Stretch {
    /// Takes a message of `/state`, until there are enough; a state without attitude ends the stretch.
    fn add(&mut self, data: &[u8], wanted: Wanted) -> ControlFlow<()> {
        // Times that differ by rounding are the same.
        let next_s = self.time_s.last().map_or(0.0, |last| last + wanted.every_s * (1.0 - 1e-9));
        match State::decode(data) {
            Ok(state) if !state.attitude.is_empty() && self.time_s.len() < wanted.samples => {
                if self.time_s.is_empty() || state.time_s >= next_s {
                    self.time_s.push(state.time_s);
                    self.attitude.push(state.attitude);
                    self.body_momentum.push(state.body_momentum);
                }
                ControlFlow::Continue(())
            }
            _ => ControlFlow::Break(()),
        }
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
