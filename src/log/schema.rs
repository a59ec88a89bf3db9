//! The channels of a log, one row each: topic, message type, the scenes that have it, what it needs and what it takes.
//!
//! A new channel is its message in `vpd.proto`, its row here, and in [`super::messages`] its columns
//! and how a sample fills it.
//!
//! Invariant: one channel per topic and one schema per message type; topics and names are fixed.

use std::borrow::Cow;
use std::fmt;

use foxglove::Encode;
use foxglove::messages::{FrameTransforms, Log, SceneUpdate, Timestamp};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::solve::so;
use crate::solve::trajectory::Observables;

/// Descriptors of our own messages, written by `build.rs`.
const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/vpd.descriptors"));

/// The encoding of every schema and message.
pub(crate) const ENCODING: &str = "protobuf";

/// Compression of chunks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Smallest.
    #[default]
    Zstd,
    /// Fastest of the compressed ones.
    Lz4,
    /// Not at all.
    None,
}

macro_rules! channels {
    ($($(#[doc = $doc:literal])* $channel:ident = $topic:tt,)*) => {
        /// A channel of the log, named by its topic.
        #[derive(
            Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
        )]
        pub enum Channel {
            $($(#[doc = $doc])* #[serde(rename = $topic)] $channel,)*
        }

        impl Channel {
            /// Returns every channel, in the order in which logs list them.
            pub const fn all() -> [Self; [$($topic),*].len()] {
                [$(Self::$channel),*]
            }

            /// Returns the topic.
            pub const fn topic(self) -> &'static str {
                match self {
                    $(Self::$channel => $topic,)*
                }
            }
        }
    };
}

channels! {
    /// Attitude and body momentum.
    State = "/state",
    /// Attitude, momenta and place of each of several bodies, whose name stands for the star.
    BodyState = "/bodies/*/state",
    /// Energy and its error.
    Energy = "/energy",
    /// Distance of the attitude from the group.
    Orthogonality = "/orthogonality",
    /// Spatial momentum and the drift of its conserved part.
    Momentum = "/momentum",
    /// How the steps were solved.
    Solver = "/solver",
    /// Rate of time for adaptive steps.
    Pace = "/pace",
    /// Samples of the control.
    Control = "/control",
    /// Where the body points, relative to a frame.
    Pointing = "/pointing",
    /// Derivatives by the start and by fields of the scenario.
    Derivatives = "/derivatives",
    /// The frame of the body, or of each body, for viewers; n = 3.
    Tf = "/tf",
    /// The body's box of inertia and its points, once; n = 3.
    SceneBody = "/scene/body",
    /// The box of inertia and the points of each of several bodies, once; n = 3.
    SceneBodies = "/scene/bodies/*",
    /// Charges, anchors and directions in space, once; those that move by frames in `/tf`; n = 3.
    SceneSources = "/scene/sources",
    /// How each member of an ensemble began and ended.
    EnsembleMembers = "/ensemble/members",
    /// Mean and spread of the members of an ensemble.
    EnsembleStatistics = "/ensemble/statistics",
    /// Start, warnings, the diagnosis.
    Log = "/log",
}

/// The scenes that have a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scope {
    All,
    OneBody,
    SeveralBodies,
    /// n = 3.
    ThreeDimensions,
    /// n = 3, and one body.
    OneDrawn,
    /// n = 3, and several bodies.
    SeveralDrawn,
    /// n = 3, and something in space to draw.
    WithSources,
    Ensembles,
    /// Steps that adapt.
    OwnSteps,
    Controlled,
    /// Where the body points is asked for.
    Pointed,
    /// Derivatives are carried along.
    Differentiated,
}

/// What a scene is, as far as channels depend on it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scenery {
    /// n = 3.
    pub(crate) three: bool,
    /// It is one of one body.
    pub(crate) one: bool,
    /// It is one of several bodies.
    pub(crate) several: bool,
    /// There is something in space to draw.
    pub(crate) sources: bool,
    pub(crate) ensemble: bool,
    /// Steps adapt.
    pub(crate) own_steps: bool,
    pub(crate) controlled: bool,
    /// Where the body points is asked for.
    pub(crate) pointed: bool,
    /// Derivatives are carried along.
    pub(crate) differentiated: bool,
}

impl Scenery {
    /// Of a scene that has all there is.
    pub(crate) const ALL: Self = Self {
        three: true,
        one: true,
        several: true,
        sources: true,
        ensemble: true,
        own_steps: true,
        controlled: true,
        pointed: true,
        differentiated: true,
    };
}

/// Bytes of a message before compression.
#[derive(Clone, Copy, Debug)]
struct Bytes {
    /// Bytes of matrices and vectors, whose digits do not compress.
    dense: usize,
    rest: usize,
}

/// Properties of a channel.
struct Row {
    /// Full name of the message type.
    schema: &'static str,
    descriptors: fn() -> Cow<'static, [u8]>,
    scope: Scope,
    /// Description of what is computed for it.
    computes: &'static str,
    /// The figures that a sample must have for it.
    needs: Observables,
    /// Whether it shows the attitude.
    attitude: bool,
    /// Approximate size of the message of a sample; `None` if it is not written with every sample.
    sample: Option<Bytes>,
}

/// The name and descriptor set of a message type.
pub struct Schema {
    /// Full name of the message.
    pub name: &'static str,
    /// Binary `FileDescriptorSet`, imports included.
    pub descriptors: Cow<'static, [u8]>,
}

impl Channel {
    fn row(self, n: usize) -> Row {
        // The size of tag and value; a list has its tag and length once.
        const DOUBLE: usize = 9;
        const LIST: usize = 4;
        let nothing = Observables::default();
        let ours = || Cow::Borrowed(DESCRIPTORS);
        let momentum = 8 * so::dimension(n);
        let plain = |schema, computes| Row {
            schema,
            descriptors: ours,
            scope: Scope::All,
            computes,
            needs: nothing,
            attitude: false,
            sample: None,
        };
        let sample = |dense, rest| Some(Bytes { dense, rest });
        match self {
            Self::State => Row {
                attitude: true,
                sample: sample(
                    state_bytes(n) as usize,
                    DOUBLE + 3 * LIST + if n == 3 { LIST } else { 0 },
                ),
                scope: Scope::OneBody,
                ..plain("vpd.State", "the state itself")
            },
            Self::BodyState => Row {
                attitude: true,
                sample: sample(
                    state_bytes(n) as usize + 3 * 8 * n,
                    DOUBLE + 6 * LIST + if n == 3 { LIST } else { 0 },
                ),
                scope: Scope::SeveralBodies,
                ..plain("vpd.BodyState", "the state of each body")
            },
            Self::Energy => Row {
                needs: Observables { energy: true, ..nothing },
                sample: sample(0, 5 * DOUBLE),
                ..plain("vpd.Energy", "kinetic and potential energy")
            },
            Self::Orthogonality => Row {
                needs: Observables { orthogonality: true, ..nothing },
                attitude: true,
                sample: sample(0, 2 * DOUBLE),
                ..plain("vpd.Orthogonality", "the spectral norm of g g^T - I")
            },
            Self::Momentum => Row {
                needs: Observables { momentum: true, ..nothing },
                sample: sample(momentum, LIST + 2 * DOUBLE),
                ..plain("vpd.Momentum", "the spatial momentum and the drift of its conserved part")
            },
            Self::Solver => Row {
                needs: Observables { sigma_min: true, ..nothing },
                sample: sample(0, 2 + 2 * DOUBLE + 13),
                ..plain(
                    "vpd.Solver",
                    "the smallest singular value of the step's interpolated matrices",
                )
            },
            Self::Pace => Row {
                needs: Observables { pace: true, ..nothing },
                scope: Scope::OwnSteps,
                sample: sample(0, 4 * DOUBLE + 6),
                ..plain("vpd.Pace", "the length and number of the adaptive steps")
            },
            Self::Control => Row {
                needs: Observables { control: true, ..nothing },
                scope: Scope::Controlled,
                sample: sample(6 * momentum, 7 * LIST + 2 * DOUBLE),
                ..plain("vpd.Control", "the errors and commands of the control")
            },
            Self::Pointing => Row {
                needs: Observables { pointing: true, ..nothing },
                scope: Scope::Pointed,
                attitude: true,
                sample: sample(8 * 11, 2 * LIST + 4),
                ..plain("vpd.Pointing", "attitude, rate and an axis relative to a frame")
            },
            Self::Derivatives => Row {
                needs: Observables { derivatives: true, ..nothing },
                scope: Scope::Differentiated,
                // Those by the start.
                sample: sample(8 * (2 * so::dimension(n)).pow(2), 2 * LIST),
                ..plain(
                    "vpd.Derivatives",
                    "the derivatives by the start and by parameters, and the covariance",
                )
            },
            Self::Tf => Row {
                descriptors: well_known::<FrameTransforms>,
                scope: Scope::ThreeDimensions,
                attitude: true,
                // Sizes of the time stamp, two names, translation and four doubles, each part with
                // tag and length.
                sample: sample(0, 75),
                ..plain("foxglove.FrameTransforms", "the attitude as a quaternion")
            },
            Self::SceneBody => Row {
                descriptors: well_known::<SceneUpdate>,
                scope: Scope::OneDrawn,
                ..plain("foxglove.SceneUpdate", "the body's box and points, once")
            },
            Self::SceneBodies => Row {
                descriptors: well_known::<SceneUpdate>,
                scope: Scope::SeveralDrawn,
                ..plain("foxglove.SceneUpdate", "the box and points of each body, once")
            },
            Self::SceneSources => Row {
                descriptors: well_known::<SceneUpdate>,
                scope: Scope::WithSources,
                ..plain("foxglove.SceneUpdate", "sources, anchors and directions, once")
            },
            Self::EnsembleMembers => Row {
                scope: Scope::Ensembles,
                ..plain("vpd.Member", "start and end of each member")
            },
            Self::EnsembleStatistics => Row {
                scope: Scope::Ensembles,
                ..plain(
                    "vpd.EnsembleStatistics",
                    "mean and spread of the members, at the start and at the end",
                )
            },
            Self::Log => Row {
                descriptors: well_known::<Log>,
                ..plain("foxglove.Log", "start, warnings, diagnosis")
            },
        }
    }

    /// Returns whether only ensembles have it.
    pub fn is_of_ensembles(self) -> bool {
        self.row(3).scope == Scope::Ensembles
    }

    /// Returns the channel of a topic: of one of a body, of its name or of the star.
    pub fn from_topic(topic: &str) -> Option<Self> {
        Self::with_body(topic).map(|(channel, _)| channel)
    }

    /// Returns the channel of a topic, and its body if it names one.
    pub(super) fn with_body(topic: &str) -> Option<(Self, Option<BodyName>)> {
        Self::all().into_iter().find_map(|channel| {
            if channel.topic() == topic {
                return Some((channel, None));
            }
            let (before, after) = channel.topic().split_once('*')?;
            let name = topic.strip_prefix(before)?.strip_suffix(after)?;
            Some((channel, Some(BodyName::of(name)?)))
        })
    }

    /// Returns whether each of several bodies has a topic of it.
    pub fn is_of_each_body(self) -> bool {
        self.topic().contains('*')
    }

    /// Returns whether a scene has the channel.
    pub(crate) fn exists(self, scene: Scenery) -> bool {
        match self.row(3).scope {
            Scope::All => true,
            Scope::OneBody => scene.one,
            Scope::SeveralBodies => scene.several,
            Scope::ThreeDimensions => scene.three,
            Scope::OneDrawn => scene.three && scene.one,
            Scope::SeveralDrawn => scene.three && scene.several,
            Scope::WithSources => scene.three && scene.sources,
            Scope::Ensembles => scene.ensemble,
            Scope::OwnSteps => scene.own_steps,
            Scope::Controlled => scene.controlled,
            Scope::Pointed => scene.pointed,
            Scope::Differentiated => scene.differentiated,
        }
    }

    /// Returns whether the channel is for n = 3 only.
    pub fn needs_three(self) -> bool {
        !self.exists(Scenery { three: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for scenes of one body only.
    pub fn needs_one_body(self) -> bool {
        !self.exists(Scenery { one: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for scenes of several bodies only.
    pub fn needs_several_bodies(self) -> bool {
        !self.exists(Scenery { several: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for ensembles only.
    pub fn needs_ensemble(self) -> bool {
        !self.exists(Scenery { ensemble: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for adaptive steps only.
    pub fn needs_own_steps(self) -> bool {
        !self.exists(Scenery { own_steps: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for scenes with control only.
    pub fn needs_control(self) -> bool {
        !self.exists(Scenery { controlled: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for scenarios that ask where the body points only.
    pub fn needs_pointing(self) -> bool {
        !self.exists(Scenery { pointed: false, ..Scenery::ALL })
    }

    /// Returns whether the channel is for scenarios with derivatives only.
    pub fn needs_derivatives(self) -> bool {
        !self.exists(Scenery { differentiated: false, ..Scenery::ALL })
    }

    /// Returns a description of what is computed for it.
    pub(crate) fn computes(self) -> &'static str {
        self.row(3).computes
    }

    /// Returns the figures that a sample must have for all of `channels`.
    pub(crate) fn observables(channels: impl IntoIterator<Item = Self>) -> Observables {
        let needs = channels.into_iter().map(|channel| channel.row(3).needs);
        needs.fold(Observables::default(), |all, needs| all | needs)
    }

    /// Returns whether it shows the attitude.
    pub(crate) fn shows_attitude(self) -> bool {
        self.row(3).attitude
    }

    /// Returns whether a message of the channel belongs to a sample.
    pub fn is_sampled(self) -> bool {
        self.row(3).sample.is_some()
    }

    /// Returns the name of the channel's message type.
    pub fn schema_name(self) -> &'static str {
        self.row(3).schema
    }

    /// Returns the channel's message type with its descriptors.
    pub fn schema(self) -> Schema {
        let Row { schema: name, descriptors, .. } = self.row(3);
        Schema { name, descriptors: descriptors() }
    }

    /// Returns about how many bytes a sample takes on this channel before compression, message
    /// header and index included: for estimates of the size of a log and of its chunks; for several
    /// bodies, about how many for each. 0 for channels that are not written with every sample.
    pub fn bytes_per_sample(self, n: usize) -> u64 {
        // The size of opcode, length, channel, sequence and two times; then an entry of the index.
        const HEADER: usize = 1 + 8 + 2 + 4 + 8 + 8;
        const INDEX: usize = 16;
        let bytes = |Bytes { dense, rest }| (HEADER + INDEX + dense + rest) as u64;
        self.row(n).sample.map_or(0, bytes)
    }

    /// Returns how many of these bytes are of matrices and vectors, whose digits do not compress.
    pub fn dense_bytes_per_sample(self, n: usize) -> u64 {
        self.row(n).sample.map_or(0, |bytes| bytes.dense as u64)
    }
}

/// Returns the size of the numbers of a state: attitude, momentum, velocity, and for n = 3 the
/// quaternion.
const fn state_bytes(n: usize) -> u64 {
    (8 * (n * n + 2 * so::dimension(n)) + if n == 3 { 32 } else { 0 }) as u64
}

/// Returns about how many bytes the end of a member of an ensemble takes before compression, with
/// `waypoints` points on its way; `bodies` of several, 0 for one.
pub const fn bytes_per_member(n: usize, bodies: u64, waypoints: u64) -> u64 {
    const FIGURES: u64 = 180;
    const TIME: u64 = 8;
    /// Name, tags and lengths of one of several bodies.
    const OF_BODY: u64 = 80;
    let dense = dense_bytes_per_member(n, bodies, waypoints);
    dense + FIGURES + bodies * OF_BODY + waypoints * TIME
}

/// Returns how many of these bytes are of its two states and of its points, whose digits do not
/// compress.
pub const fn dense_bytes_per_member(n: usize, bodies: u64, waypoints: u64) -> u64 {
    const ERRORS: u64 = 3;
    // Attitude, angles and velocity.
    let turned = (n * n + n + 1) as u64;
    let n = n as u64;
    let of_bodies = if bodies == 0 {
        2 * state_bytes(n as usize) + waypoints * 4 * turned
    } else {
        bodies * (2 * (state_bytes(n as usize) + 3 * 8 * n) + waypoints * 4 * (turned + n))
    };
    of_bodies + waypoints * 4 * ERRORS
}

/// Name of one of several bodies: 1 to 40 letters, digits, `_` or `-`, a letter first.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct BodyName {
    /// Zeros after its end.
    bytes: [u8; Self::MOST],
}

impl BodyName {
    /// Most bytes of a name.
    pub const MOST: usize = 40;

    /// Returns a text as a name; `None` if it is none.
    pub fn of(text: &str) -> Option<Self> {
        let allowed = |c: u8| c.is_ascii_alphanumeric() || c == b'_' || c == b'-';
        let begins = text.bytes().next().is_some_and(|c| c.is_ascii_alphabetic());
        let mut bytes = [0; Self::MOST];
        bytes.get_mut(..text.len())?.copy_from_slice(text.as_bytes());
        (begins && text.bytes().all(allowed)).then_some(Self { bytes })
    }

    /// Returns it as text.
    pub fn as_str(&self) -> &str {
        let length = self.bytes.iter().position(|&c| c == 0).unwrap_or(Self::MOST);
        std::str::from_utf8(&self.bytes[..length]).unwrap_or_default()
    }
}

impl fmt::Debug for BodyName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

/// Topic of a message: its channel and, for an ensemble, the member. Member 0, and a run that is no
/// ensemble, have the channel's own topic; the others stand below `/members`. On a channel of each of several bodies, also the
/// body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Topic {
    /// Number of the member.
    pub member: u64,
    /// The channel.
    pub channel: Channel,
    /// The body.
    pub body: Option<BodyName>,
}

impl Topic {
    /// Returns its name in the log.
    pub fn name(self) -> String {
        let Self { member, channel, body } = self;
        let topic = match &body {
            Some(body) => channel.topic().replace('*', body.as_str()),
            None => channel.topic().to_owned(),
        };
        if member == 0 { topic } else { format!("/members/{member}{topic}") }
    }

    /// Returns the topic of a name.
    pub fn parse(name: &str) -> Option<Self> {
        let (member, channel) = match name.strip_prefix("/members/") {
            None => (0, name),
            Some(rest) => {
                let (digits, _) = rest.split_once('/')?;
                (digits.parse().ok().filter(|&member| member > 0)?, &rest[digits.len()..])
            }
        };
        let (channel, body) = Channel::with_body(channel)?;
        // The star is no body.
        (body.is_some() == channel.is_of_each_body()).then_some(Self { member, channel, body })
    }
}

impl From<Channel> for Topic {
    fn from(channel: Channel) -> Self {
        Self { member: 0, channel, body: None }
    }
}

fn well_known<M: Encode>() -> Cow<'static, [u8]> {
    M::get_schema().map_or(Cow::Borrowed(&[]), |schema| schema.data)
}

/// Returns a log time as the viewers' time stamp.
pub(super) fn timestamp(time_ns: u64) -> Option<Timestamp> {
    let seconds = u32::try_from(time_ns / 1_000_000_000).ok()?;
    Timestamp::new_checked(seconds, (time_ns % 1_000_000_000) as u32)
}
