//! Resumes a log that was left unfinished.
//!
//! The chunks that are whole are fed to a new writer, whose bytes must be those of the file: then the
//! writer stands where the old one stood, with all that it will say in its index, and goes on behind the
//! last checkpoint. A log of another job or another build differs at its first record.
//!
//! Invariant: nothing of the file changes before all of it up to the last checkpoint was found to be
//! what this build writes; and then only what stands behind it is cut off.

use std::ops::ControlFlow;
use std::path::Path;

use foxglove::messages::FrameTransforms;
use prost::Message as _;

use super::messages::{BodyState, Checkpoint, Member, State};
use super::part::Part;
use super::reader::{self, Item, Message};
use super::schema::{Channel, Topic};
use super::writer::{LogHeader, LogWriter};
use super::{LogError, part_path};

/// Part of the contents of an unfinished log.
#[derive(Debug)]
pub enum Seen<'a> {
    /// A message of ours, of a run or of member 0, with its log time.
    Message(u64, &'a Message),
    /// The end of a member.
    Member(Box<Member>),
}

/// A message between two checkpoints.
struct Pending {
    topic: Topic,
    time_ns: u64,
    sequence: u32,
    data: Vec<u8>,
}

impl LogWriter {
    /// Resumes the unfinished log of `path` behind its last checkpoint. `None` if there is none that
    /// this build would write for this job, or none with a checkpoint; nothing is changed then.
    ///
    /// Everything before the checkpoint is shown to `seen`, even if the log is not resumed in the
    /// end. The reading ends once `stopped`, and the file stays as it is.
    ///
    /// # Errors
    /// If the file cannot be read, or not be cut off behind the checkpoint, or the reading was stopped.
    pub fn resume(
        path: &Path,
        header: &LogHeader,
        seen: &mut dyn FnMut(Seen<'_>),
        stopped: &dyn Fn() -> bool,
    ) -> Result<Option<(Self, Checkpoint)>, LogError> {
        let part = part_path(path);
        let failed = |source| LogError::io(path, "resume", source);
        let file = match Part::compare(&part) {
            Ok(file) => file,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(failed(error)),
        };
        let (mut log, mut found) = match Self::begin(path, header, file.clone()) {
            Ok(log) => (log, None),
            Err(_) if file.differs() => return Ok(None),
            Err(error) => return Err(error),
        };
        let mut pending = Vec::new();
        let mut fed = Ok(());
        reader::read(&part, |item| {
            match item {
                _ if stopped() => return ControlFlow::Break(()),
                Item::Message { topic, time_ns, sequence, data, .. } => {
                    let Some(topic) = Topic::parse(topic) else {
                        return ControlFlow::Break(());
                    };
                    pending.push(Pending { topic, time_ns, sequence, data: data.to_vec() });
                }
                Item::Checkpoint { data } => {
                    let checkpoint = Checkpoint::decode(data).ok();
                    let ours = |found: &Checkpoint| {
                        let one = header.bodies.is_empty();
                        if one { found.is_of(header.dimension) } else { found.is_of_bodies() }
                    };
                    let Some(checkpoint) = checkpoint.filter(ours) else {
                        return ControlFlow::Break(());
                    };
                    for Pending { topic, time_ns, data, .. } in &pending {
                        let Topic { member, channel, .. } = *topic;
                        if channel == Channel::EnsembleMembers {
                            if let Ok(member) = Member::decode(data.as_slice()) {
                                seen(Seen::Member(Box::new(member)));
                            }
                        } else if member == 0
                            && let Some(message) =
                                Message::decode(channel.topic(), channel.schema_name(), data)
                        {
                            seen(Seen::Message(*time_ns, &message));
                        }
                    }
                    fed = log.feed(std::mem::take(&mut pending), data, &checkpoint);
                    if fed.is_err() {
                        return ControlFlow::Break(());
                    }
                    found = Some(checkpoint);
                }
                Item::Metadata { .. } | Item::Attachment { .. } => {}
            }
            ControlFlow::Continue(())
        })?;
        if stopped() {
            return Err(LogError::Interrupted { path: path.to_owned() });
        }
        match (fed, found) {
            (Err(error), _) if !file.differs() => Err(error),
            (Ok(()), Some(checkpoint)) => {
                file.go_on().map_err(failed)?;
                log.part = part;
                log.settled(checkpoint.step);
                Ok(Some((log, checkpoint)))
            }
            _ => Ok(None),
        }
    }

    /// Returns the quaternions of a message, each with the number of its body.
    fn turns_of(&self, topic: Topic, data: &[u8]) -> Vec<(usize, [f64; 4])> {
        let turn = |of: Vec<f64>| <[f64; 4]>::try_from(of).ok();
        let state = || turn(State::decode(data).ok()?.quaternion);
        let of_body = || {
            let number = self.bodies.iter().position(|name| Some(*name) == topic.body)?;
            Some((number, turn(BodyState::decode(data).ok()?.quaternion)?))
        };
        match topic.channel {
            Channel::State => state().map(|turn| (0, turn)).into_iter().collect(),
            Channel::BodyState => of_body().into_iter().collect(),
            Channel::Tf => {
                let frames = FrameTransforms::decode(data).unwrap_or_default().transforms;
                // Behind those of the bodies are those of the sources.
                let bodies = frames.into_iter().take(self.bodies.len().max(1)).enumerate();
                let turn = bodies.filter_map(|(body, frame)| Some((body, frame.rotation?)));
                turn.map(|(body, turn)| (body, [turn.w, turn.x, turn.y, turn.z])).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Writes the contents of a chunk again, up to its checkpoint.
    fn feed(
        &mut self,
        messages: Vec<Pending>,
        record: &[u8],
        checkpoint: &Checkpoint,
    ) -> Result<(), LogError> {
        for Pending { topic, time_ns, sequence, data } in messages {
            for (body, turn) in self.turns_of(topic, &data) {
                self.turns.insert((topic.member, body), turn);
            }
            let since_ns = time_ns.saturating_sub(self.epoch_ns);
            let Topic { member, channel, .. } = topic;
            if member == 0
                && let Some(message) =
                    Message::decode(channel.topic(), channel.schema_name(), &data)
            {
                self.curves.note(topic, since_ns, &message);
            }
            self.put_again(topic, time_ns, sequence, &data)?;
        }
        self.samples = checkpoint.samples;
        self.close_chunk_again(record)
    }
}

/// Returns the step of the last checkpoint of an unfinished log: how far an interrupted run has
/// come. `None` if there is no such log, or none that holds a checkpoint.
///
/// # Errors
/// If the file cannot be read.
pub fn last_checkpoint(path: &Path) -> Result<Option<u64>, LogError> {
    let part = part_path(path);
    let mut last = None;
    if part.exists() {
        reader::read(&part, |item| {
            if let Item::Checkpoint { data } = item {
                last = Checkpoint::decode(data).ok().map(|found| found.step);
            }
            ControlFlow::Continue(())
        })?;
    }
    Ok(last)
}
