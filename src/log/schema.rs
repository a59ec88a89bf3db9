//! The channels of a log: topic, message type and descriptor of each.
//!
//! Invariant: one channel per topic and one schema per message type; topics and names are fixed.

use std::borrow::Cow;

use foxglove::Encode;
use foxglove::messages::{FrameTransforms, Log, SceneUpdate};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::solve::so;

/// Descriptors of our own messages, written by `build.rs`.
const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/vpd.descriptors"));

/// The encoding of every schema and message.
pub(crate) const ENCODING: &str = "protobuf";

/// A channel of the log, named by its topic.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
pub enum Channel {
    /// Attitude and body momentum.
    #[serde(rename = "/state")]
    State,
    /// Energy and its error.
    #[serde(rename = "/energy")]
    Energy,
    /// Distance of the attitude from the group.
    #[serde(rename = "/orthogonality")]
    Orthogonality,
    /// Spatial momentum and the drift of its conserved part.
    #[serde(rename = "/momentum")]
    Momentum,
    /// How the steps were solved.
    #[serde(rename = "/solver")]
    Solver,
    /// The body's frame for viewers; n = 3.
    #[serde(rename = "/tf")]
    Tf,
    /// The body's box of inertia and its points, once; n = 3.
    #[serde(rename = "/scene/body")]
    SceneBody,
    /// Charges, anchors and directions in space, once; n = 3.
    #[serde(rename = "/scene/sources")]
    SceneSources,
    /// How each member of an ensemble began and ended.
    #[serde(rename = "/ensemble/members")]
    EnsembleMembers,
    /// Mean and spread of the members of an ensemble.
    #[serde(rename = "/ensemble/statistics")]
    EnsembleStatistics,
    /// Start, warnings, the diagnosis.
    #[serde(rename = "/log")]
    Log,
}

/// The name and descriptor set of a message type.
pub struct Schema {
    /// Full name of the message.
    pub name: &'static str,
    /// Binary `FileDescriptorSet`, imports included.
    pub descriptors: Cow<'static, [u8]>,
}

impl Channel {
    /// Every channel, in the order in which logs list them.
    pub const fn all() -> [Self; 11] {
        use Channel::*;
        [
            State,
            Energy,
            Orthogonality,
            Momentum,
            Solver,
            Tf,
            SceneBody,
            SceneSources,
            EnsembleMembers,
            EnsembleStatistics,
            Log,
        ]
    }

    /// The topic.
    pub const fn topic(self) -> &'static str {
        match self {
            Self::State => "/state",
            Self::Energy => "/energy",
            Self::Orthogonality => "/orthogonality",
            Self::Momentum => "/momentum",
            Self::Solver => "/solver",
            Self::Tf => "/tf",
            Self::SceneBody => "/scene/body",
            Self::SceneSources => "/scene/sources",
            Self::EnsembleMembers => "/ensemble/members",
            Self::EnsembleStatistics => "/ensemble/statistics",
            Self::Log => "/log",
        }
    }

    /// The channel of a topic.
    pub fn from_topic(topic: &str) -> Option<Self> {
        Self::all().into_iter().find(|channel| channel.topic() == topic)
    }

    /// Whether the channel is for bodies in space only.
    pub const fn needs_three(self) -> bool {
        matches!(self, Self::Tf | Self::SceneBody | Self::SceneSources)
    }

    /// Whether the channel is for ensembles only.
    pub const fn needs_ensemble(self) -> bool {
        matches!(self, Self::EnsembleMembers | Self::EnsembleStatistics)
    }

    /// Whether a message of the channel belongs to a sample.
    pub const fn is_sampled(self) -> bool {
        self.bytes_per_sample(3) > 0
    }

    /// Name of the channel's message type.
    pub const fn schema_name(self) -> &'static str {
        match self {
            Self::State => "vpd.State",
            Self::Energy => "vpd.Energy",
            Self::Orthogonality => "vpd.Orthogonality",
            Self::Momentum => "vpd.Momentum",
            Self::Solver => "vpd.Solver",
            Self::Tf => "foxglove.FrameTransforms",
            Self::SceneBody | Self::SceneSources => "foxglove.SceneUpdate",
            Self::EnsembleMembers => "vpd.Member",
            Self::EnsembleStatistics => "vpd.EnsembleStatistics",
            Self::Log => "foxglove.Log",
        }
    }

    /// The channel's message type with its descriptors.
    pub fn schema(self) -> Schema {
        let descriptors = match self {
            Self::State
            | Self::Energy
            | Self::Orthogonality
            | Self::Momentum
            | Self::Solver
            | Self::EnsembleMembers
            | Self::EnsembleStatistics => Cow::Borrowed(DESCRIPTORS),
            Self::Tf => well_known::<FrameTransforms>(),
            Self::SceneBody | Self::SceneSources => well_known::<SceneUpdate>(),
            Self::Log => well_known::<Log>(),
        };
        Schema { name: self.schema_name(), descriptors }
    }

    /// About how many bytes a sample takes on this channel before compression, message header and
    /// index included: for estimates of the size of a log and of its chunks. 0 for channels that
    /// are not written with every sample.
    pub const fn bytes_per_sample(self, n: usize) -> u64 {
        // Opcode, length, channel, sequence and two times; then an entry of the index.
        const HEADER: usize = 1 + 8 + 2 + 4 + 8 + 8;
        const INDEX: usize = 16;
        // Tag and value; a list has its tag and length once.
        const DOUBLE: usize = 9;
        const LIST: usize = 4;
        let momentum = LIST + 8 * so::dimension(n);
        let quaternion = if n == 3 { LIST + 32 } else { 0 };
        let payload = match self {
            Self::State => DOUBLE + LIST + 8 * n * n + momentum + quaternion,
            Self::Energy => 5 * DOUBLE,
            Self::Orthogonality => 2 * DOUBLE,
            Self::Momentum => momentum + 2 * DOUBLE,
            Self::Solver => 2 + 2 * DOUBLE + 13,
            // Time stamp, two names, translation and four doubles, each part with tag and length.
            Self::Tf => 75,
            Self::SceneBody
            | Self::SceneSources
            | Self::EnsembleMembers
            | Self::EnsembleStatistics
            | Self::Log => return 0,
        };
        (HEADER + INDEX + payload) as u64
    }

    /// Of these the bytes of matrices and vectors, whose digits do not compress.
    pub const fn dense_bytes_per_sample(self, n: usize) -> u64 {
        match self {
            Self::State => state_bytes(n),
            Self::Momentum => 8 * so::dimension(n) as u64,
            _ => 0,
        }
    }
}

/// The numbers of a state: attitude, momentum, and for n = 3 the quaternion.
const fn state_bytes(n: usize) -> u64 {
    (8 * (n * n + so::dimension(n)) + if n == 3 { 32 } else { 0 }) as u64
}

/// About how many bytes the end of a member of an ensemble takes before compression.
pub const fn bytes_per_member(n: usize) -> u64 {
    const FIGURES: u64 = 180;
    dense_bytes_per_member(n) + FIGURES
}

/// Of these the bytes of its two states, whose digits do not compress.
pub const fn dense_bytes_per_member(n: usize) -> u64 {
    2 * state_bytes(n)
}

/// Where a message stands: its channel, and of an ensemble the member. Member 0, and a run that is no ensemble,
/// have the channel's own topic; the others stand below `/members`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Topic {
    /// Number of the member.
    pub member: u64,
    /// The channel.
    pub channel: Channel,
}

impl Topic {
    /// The name in the log.
    pub fn name(self) -> String {
        match self {
            Self { member: 0, channel } => channel.topic().to_owned(),
            Self { member, channel } => format!("/members/{member}{}", channel.topic()),
        }
    }

    /// The topic of a name.
    pub fn parse(name: &str) -> Option<Self> {
        let (member, channel) = match name.strip_prefix("/members/") {
            None => (0, name),
            Some(rest) => {
                let (digits, _) = rest.split_once('/')?;
                (digits.parse().ok().filter(|&member| member > 0)?, &rest[digits.len()..])
            }
        };
        Channel::from_topic(channel).map(|channel| Self { member, channel })
    }
}

impl From<Channel> for Topic {
    fn from(channel: Channel) -> Self {
        Self { member: 0, channel }
    }
}

fn well_known<M: Encode>() -> Cow<'static, [u8]> {
    M::get_schema().map_or(Cow::Borrowed(&[]), |schema| schema.data)
}
