//! A log as a bag of ROS 2: an MCAP file of the profile `ros2` with messages in CDR, for PlotJuggler, `ros2 bag` and RViz.
//!
//! Invariant: every number is that of the log to the bit, and so is every time. (CDR: the OMG's DDSI-RTPS, little-endian.)

use std::collections::BTreeMap;
use std::io::{BufWriter, Seek, Write};
use std::ops::ControlFlow;
use std::path::Path;

use foxglove::messages::FrameTransforms;
use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions};
use prost::Message as _;

use super::ExportError;
use crate::log::messages::{Energy, Momentum, Orthogonality, State};
use crate::log::order::read_by_time;
use crate::log::reader::{Ending, Item};
use crate::log::scene::{SPACE_FRAME, body_frame};
use crate::log::schema::{Channel, Topic};

/// A bag that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bag {
    /// Number of messages by topic.
    pub topics: BTreeMap<&'static str, u64>,
    /// State in which the end of the log was found.
    pub ending: Ending,
}

/// Topics of the bag and their message types.
const TOPICS: [(&str, &str); 6] = [
    ("/imu", "sensor_msgs/msg/Imu"),
    ("/attitude", "geometry_msgs/msg/QuaternionStamped"),
    ("/tf", "tf2_msgs/msg/TFMessage"),
    ("/energy/error", "std_msgs/msg/Float64"),
    ("/orthogonality/error", "std_msgs/msg/Float64"),
    ("/momentum/drift", "std_msgs/msg/Float64"),
];

/// The fields of each type, and the types of which it is made.
fn definition(of: &str) -> (&'static str, &'static [&'static str]) {
    const POINT: &str = "float64 x\nfloat64 y\nfloat64 z\n";
    match of {
        "sensor_msgs/Imu" => (
            "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
            &["std_msgs/Header", "geometry_msgs/Quaternion", "geometry_msgs/Vector3"],
        ),
        "geometry_msgs/QuaternionStamped" => (
            "std_msgs/Header header\nQuaternion quaternion\n",
            &["std_msgs/Header", "geometry_msgs/Quaternion"],
        ),
        "tf2_msgs/TFMessage" => {
            ("geometry_msgs/TransformStamped[] transforms\n", &["geometry_msgs/TransformStamped"])
        }
        "geometry_msgs/TransformStamped" => (
            "std_msgs/Header header\nstring child_frame_id\nTransform transform\n",
            &["std_msgs/Header", "geometry_msgs/Transform"],
        ),
        "geometry_msgs/Transform" => (
            "Vector3 translation\nQuaternion rotation\n",
            &["geometry_msgs/Vector3", "geometry_msgs/Quaternion"],
        ),
        "std_msgs/Header" => {
            ("builtin_interfaces/Time stamp\nstring frame_id\n", &["builtin_interfaces/Time"])
        }
        "builtin_interfaces/Time" => ("int32 sec\nuint32 nanosec\n", &[]),
        "geometry_msgs/Quaternion" => ("float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n", &[]),
        "geometry_msgs/Vector3" => (POINT, &[]),
        _ => ("float64 data\n", &[]),
    }
}

/// Returns the text of a type with all of which it is made, as `ros2msg` has it.
fn schema(of: &str) -> String {
    let mut types = vec![of.replace("/msg/", "/")];
    let mut at = 0;
    let mut text = String::new();
    while at < types.len() {
        let (fields, parts) = definition(&types[at]);
        if at > 0 {
            text += &format!("{}\nMSG: {}\n", "=".repeat(80), types[at]);
        }
        text += fields;
        for part in parts {
            if !types.iter().any(|known| known == part) {
                types.push((*part).to_owned());
            }
        }
        at += 1;
    }
    text
}

/// Bytes of a message in CDR.
struct Cdr(Vec<u8>);

impl Cdr {
    /// Bytes before a message, from which places are not counted: its encoding, little-endian.
    const HEAD: [u8; 4] = [0, 1, 0, 0];

    fn new() -> Self {
        Self(Self::HEAD.to_vec())
    }

    /// A number stands at a multiple of its size.
    fn put(mut self, bytes: &[u8]) -> Self {
        let off = (self.0.len() - Self::HEAD.len()) % bytes.len();
        self.0.resize(self.0.len() + (bytes.len() - off) % bytes.len(), 0);
        self.0.extend_from_slice(bytes);
        self
    }

    fn numbers(self, values: &[f64]) -> Self {
        values.iter().fold(self, |cdr, value| cdr.put(&value.to_le_bytes()))
    }

    fn length(self, length: usize) -> Self {
        self.put(&(length as u32).to_le_bytes())
    }

    /// A text ends with a zero, which counts.
    fn text(self, text: &str) -> Self {
        let mut cdr = self.length(text.len() + 1);
        cdr.0.extend_from_slice(text.as_bytes());
        cdr.0.push(0);
        cdr
    }

    fn header(self, time_ns: u64, frame: &str) -> Option<Self> {
        let seconds = i32::try_from(time_ns / 1_000_000_000).ok()?;
        let nanoseconds = (time_ns % 1_000_000_000) as u32;
        Some(self.put(&seconds.to_le_bytes()).put(&nanoseconds.to_le_bytes()).text(frame))
    }

    /// From (w, x, y, z), as logs have it.
    fn quaternion(self, [w, x, y, z]: [f64; 4]) -> Self {
        self.numbers(&[x, y, z, w])
    }
}

/// Messages of a bag for one message of a log: the place of the topic in [`TOPICS`], and the bytes. `None` beyond the year
/// 2038, where the times of ROS end.
fn converted(topic: Topic, time_ns: u64, data: &[u8]) -> Option<Vec<(usize, Vec<u8>)>> {
    // Covariances of zeros: the numbers are exact. One that begins with -1: there is none.
    const EXACT: [f64; 9] = [0.0; 9];
    const UNKNOWN: [f64; 9] = [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let figure = |at, value: Option<f64>| {
        Some(value.map(|value| (at, Cdr::new().numbers(&[value]).0)).into_iter().collect())
    };
    match topic.channel {
        Channel::State => {
            let Ok(state) = State::decode(data) else { return Some(Vec::new()) };
            let Ok(turn) = <[f64; 4]>::try_from(state.quaternion) else { return Some(Vec::new()) };
            let velocity = <[f64; 3]>::try_from(state.angular_velocity);
            let imu = Cdr::new().header(time_ns, &body_frame(topic.member))?.quaternion(turn);
            let imu = imu.numbers(&EXACT).numbers(velocity.as_ref().unwrap_or(&[0.0; 3]));
            let imu = imu.numbers(if velocity.is_ok() { &EXACT } else { &UNKNOWN });
            let imu = imu.numbers(&[0.0; 3]).numbers(&UNKNOWN);
            let attitude = Cdr::new().header(time_ns, SPACE_FRAME)?.quaternion(turn);
            Some(vec![(0, imu.0), (1, attitude.0)])
        }
        Channel::Tf => {
            let Ok(FrameTransforms { transforms }) = FrameTransforms::decode(data) else {
                return Some(Vec::new());
            };
            let mut cdr = Cdr::new().length(transforms.len());
            for frame in transforms {
                let at = frame.translation.unwrap_or_default();
                let turn = frame.rotation.unwrap_or_default();
                cdr = cdr.header(time_ns, &frame.parent_frame_id)?.text(&frame.child_frame_id);
                cdr = cdr.numbers(&[at.x, at.y, at.z]);
                cdr = cdr.quaternion([turn.w, turn.x, turn.y, turn.z]);
            }
            Some(vec![(2, cdr.0)])
        }
        Channel::Energy => figure(3, Energy::decode(data).ok().map(|found| found.error)),
        Channel::Orthogonality => {
            figure(4, Orthogonality::decode(data).ok().map(|found| found.error))
        }
        Channel::Momentum => figure(5, Momentum::decode(data).ok().and_then(|found| found.drift)),
        _ => Some(Vec::new()),
    }
}

/// Writes the motion of a run with n = 3, or of a member of an ensemble, as a bag of ROS 2.
///
/// # Errors
/// If the log cannot be read, holds no quaternions, or times beyond the year 2038; if the bag cannot be written.
pub fn ros2(log: &Path, member: u64, out: impl Write + Seek) -> Result<Bag, ExportError> {
    let failed = |error| match error {
        McapError::Io(error) => ExportError::Write(error),
        other => ExportError::Write(std::io::Error::other(other)),
    };
    let options = WriteOptions::new()
        .profile("ros2")
        .library(concat!("vpd-export/", env!("CARGO_PKG_VERSION")));
    // No clock and no thread shows in it.
    let mut bag = options.compression_threads(0).create(BufWriter::new(out)).map_err(failed)?;
    let mut ids: [Option<u16>; TOPICS.len()] = [None; TOPICS.len()];
    let mut counts = [0_u32; TOPICS.len()];
    let mut done = Ok(());
    let mut put = |time_ns, at: usize, data: &[u8]| -> Result<(), McapError> {
        let channel_id = match ids[at] {
            Some(id) => id,
            None => {
                let (topic, kind) = TOPICS[at];
                let schema = bag.add_schema(kind, "ros2msg", schema(kind).as_bytes())?;
                let known = BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())]);
                *ids[at].insert(bag.add_channel(schema, topic, "cdr", &known)?)
            }
        };
        let sequence = counts[at];
        counts[at] += 1;
        let header =
            MessageHeader { channel_id, sequence, log_time: time_ns, publish_time: time_ns };
        bag.write_to_known_channel(&header, data)
    };
    let ending = read_by_time(log, |item| {
        let Item::Message { topic, time_ns, data, .. } = item else {
            return ControlFlow::Continue(());
        };
        let Some(topic) = Topic::parse(topic).filter(|topic| topic.member == member) else {
            return ControlFlow::Continue(());
        };
        let Some(messages) = converted(topic, time_ns, data) else {
            done = Err(ExportError::Time { log: log.display().to_string() });
            return ControlFlow::Break(());
        };
        for (at, data) in messages {
            if let Err(error) = put(time_ns, at, &data) {
                done = Err(failed(error));
                return ControlFlow::Break(());
            }
        }
        ControlFlow::Continue(())
    })?;
    done?;
    if counts[1] == 0 && counts[2] == 0 {
        let of = if member == 0 { String::new() } else { format!(" of member {member}") };
        let asked = format!("quaternions in /state or /tf{of}, which only n = 3 has");
        return Err(ExportError::Empty { log: log.display().to_string(), asked });
    }
    bag.finish().map_err(failed)?;
    bag.into_inner().flush().map_err(ExportError::Write)?;
    let topics = TOPICS.iter().zip(counts).filter(|(_, count)| *count > 0);
    Ok(Bag { topics: topics.map(|((topic, _), count)| (*topic, count.into())).collect(), ending })
}
