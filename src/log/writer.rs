//! Writes the log of one job.
//!
//! Invariant: the final name appears with a complete, synced file whose last record is the outcome,
//! or not at all. After an error nothing more is written. A writer that is dropped before
//! [`LogWriter::finish`] takes its `.part` file with it, unless the file system refused something that it may do
//! later; that, [`LogWriter::leave`] and a killed process leave one behind. Every chunk but the last ends with a
//! checkpoint, from which such a file can be resumed ([`LogWriter::resume`]).

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use foxglove::messages::log::Level as FoxgloveLevel;
use foxglove::messages::{FrameTransforms, Log};
use prost::Message;

use super::background::{ChunkWriter, Refusal, WriterThread};
use super::container::{Catalog, Chunk, Container};
use super::end::End;
use super::messages::{self, EnsembleStatistics, Figures, Member, Message as SampleMessage};
use super::overview::Curves;
use super::part::{Durable, Part, Syncer, folder, irreplaceable, sync_folder};
use super::scene::{BodyHeader, SceneGeometry, body_frame};
use super::schema::{BodyName, Channel, Compression, Scenery, Topic, timestamp};
use super::{
    BODIES_ENTRY, CHECKPOINT_OPCODE, JOB_RECORD, LogError, MAX_CHUNK_BYTES, OUTCOME_RECORD,
    SCENARIO_ATTACHMENT, is_transient,
};
use crate::solve::bodies::trajectory as bodies;
use crate::solve::state::Checkpoint;
use crate::solve::trajectory::{Sample, Sink};

/// Library name in the file's header; part of the bytes.
const LIBRARY: &str = concat!("vpd/", env!("CARGO_PKG_VERSION"));

/// Contents of the beginning of a log.
#[derive(Clone, Debug)]
pub struct LogHeader {
    /// n: the recorded system moves on SO(n).
    pub dimension: usize,
    /// Log time of t = 0, in nanoseconds since 1970.
    pub epoch_ns: u64,
    /// Channels to write. Those that need n = 3 are passed over for other n.
    pub channels: Vec<Channel>,
    /// Members of an ensemble whose samples are written; 0 for a single run.
    pub members: Vec<u64>,
    /// The bodies of a scene of several; empty for one.
    pub bodies: Vec<BodyHeader>,
    /// Compression of chunks.
    pub compression: Compression,
    /// A chunk is closed, and so is safe from a kill, after this many samples; fewer where the chunk
    /// would outgrow [`MAX_CHUNK_BYTES`].
    pub samples_per_chunk: u64,
    /// The scenario, as attachment; `None` if there is none: such a log cannot be run again from itself.
    pub scenario_json: Option<Vec<u8>>,
    /// Entries of the record [`JOB_RECORD`]; the writer adds `bodies`, the list of their names as JSON, if there are several.
    pub job: BTreeMap<String, String>,
    /// Objects that viewers draw.
    pub scene: SceneGeometry,
}

/// Outcome of the job.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// `succeeded`, `failed` or `cancelled`; becomes the entry `state`.
    pub state: String,
    /// Further entries of the record [`OUTCOME_RECORD`]. The writer adds `samples`.
    pub entries: BTreeMap<String, String>,
    /// Charts to attach, SVG by file name.
    pub charts: Vec<(&'static str, String)>,
}

/// Severity of a line of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// For the record.
    Info,
    /// The user should know.
    Warning,
    /// The job failed.
    Error,
}

/// Writes the log of one job.
///
/// Messages are encoded into a chunk in memory. From the second chunk on a thread compresses and writes closed ones: a closed
/// chunk is with the operating system soon, where it survives a kill of the process, and on the disk soon after:
/// [`LogWriter::durable_step`] says how far.
pub struct LogWriter {
    path: PathBuf,
    /// n of SO(n).
    pub(super) dimension: usize,
    /// Empty once the file is no longer ours to remove.
    pub(super) part: PathBuf,
    /// The open chunk.
    chunk: Chunk,
    catalog: Catalog,
    place: Place,
    part_file: Part,
    /// How far the file is on the disk.
    durable: Arc<Durable>,
    given_up: bool,
    /// Fate of the file when the writer is dropped.
    rest: Rest,
    pub(super) epoch_ns: u64,
    scene: SceneGeometry,
    /// Names of several bodies, in their order.
    pub(super) bodies: Vec<BodyName>,
    samples_per_chunk: u64,
    /// Topics to be written, in the order of the channel ids.
    topics: Vec<Topic>,
    /// Their ids, once registered.
    ids: Vec<u16>,
    /// Whether a message shows a quaternion.
    shows_turns: bool,
    pub(super) samples: u64,
    /// Number of samples when the last chunk was closed.
    closed_at: u64,
    last_ns: u64,
    /// The last quaternion of each body, by the numbers of member and body: the next has the nearer sign.
    pub(super) turns: BTreeMap<(u64, usize), [f64; 4]>,
    /// Chart data of a long log.
    pub(super) curves: Curves,
}

/// What writes closed chunks.
enum Place {
    /// This thread, which waits: most logs end within their first chunk.
    Here(Box<ChunkWriter>),
    /// A thread of its own.
    There(WriterThread),
    /// Nothing: something failed.
    Lost,
}

/// Fate of an unfinished file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rest {
    /// No run can resume from it.
    Removed,
    /// The next run goes on from its last whole chunk.
    Kept,
    /// The next run goes on from the last chunk known to be on the disk: a sync failed, and what it
    /// lost is not known.
    KeptWhereSynced,
}

/// Refuses a place where something is that no file may replace.
fn may_write(path: &Path) -> Result<(), LogError> {
    match irreplaceable(path) {
        Some(kind) => Err(LogError::NoFile { path: path.to_owned(), kind }),
        None => Ok(()),
    }
}

/// Returns whether it is the log of a job of this name, and one that failed. A link is none.
fn is_of_failed(path: &Path, name: Option<&String>) -> bool {
    let outcome = || {
        let mut file = path.symlink_metadata().ok()?.is_file().then(|| File::open(path).ok())??;
        let end = End::read(&mut file)?;
        let job = end.metadata(&mut file, JOB_RECORD)?;
        let outcome = end.metadata(&mut file, OUTCOME_RECORD)?;
        (job.get("name") == name).then_some(outcome)
    };
    outcome().is_some_and(|outcome| outcome.get("state").is_some_and(|state| state == "failed"))
}

impl LogWriter {
    /// Starts the log of `path` under the name of [`super::part_path`], over any file of that name.
    ///
    /// # Errors
    /// If the file cannot be created or written.
    pub fn create(path: &Path, header: &LogHeader) -> Result<Self, LogError> {
        may_write(path)?;
        let part = super::part_path(path);
        let file = Part::create(&part).map_err(|source| LogError::io(path, "create", source))?;
        let mut log = Self::begin(path, header, file).inspect_err(|_| {
            let _ = fs::remove_file(&part);
        })?;
        log.part = part;
        // Flushed for readers that follow: the first chunk may take a while.
        log.part_file.flush().map_err(|source| LogError::io(path, "write", source))?;
        let start = log.time(0.0)?;
        log.put(Channel::SceneBody, start, &header.scene.body(start))?;
        for body in &header.bodies {
            let topic = Topic { body: Some(body.name), ..Channel::SceneBodies.into() };
            log.put_on(topic, start, &body.drawn(start))?;
        }
        if let Some(sources) = header.scene.sources(start) {
            log.put(Channel::SceneSources, start, &sources)?;
        }
        let name = header.job.get("name").map_or("", String::as_str);
        log.message(Level::Info, 0.0, &format!("started: {name}"))?;
        Ok(log)
    }

    /// Does the same, but leaves a file in its place alone if it is a finished log, or one that
    /// this job did not leave unfinished. Only the log of a failed job of this name is replaced
    /// when this one is finished.
    ///
    /// # Errors
    /// The errors of [`LogWriter::create`], and [`LogError::Exists`].
    pub fn create_new(path: &Path, header: &LogHeader) -> Result<Self, LogError> {
        may_write(path)?;
        let exists =
            |path: &Path, finished| Err(LogError::Exists { path: path.to_owned(), finished });
        if path.symlink_metadata().is_ok() && !is_of_failed(path, header.job.get("name")) {
            return exists(path, true);
        }
        let part = super::part_path(path);
        match Part::compare(&part) {
            Ok(file) if Self::begin(path, header, file.clone()).is_err() && file.differs() => {
                return exists(&part, false);
            }
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                return Err(LogError::io(path, "resume", source));
            }
            // There is none, or one of this job that ended before its first checkpoint.
            _ => {}
        }
        Self::create(path, header)
    }

    /// Writes everything before the first message.
    pub(super) fn begin(
        path: &Path,
        header: &LogHeader,
        part_file: Part,
    ) -> Result<Self, LogError> {
        may_write(path)?;
        let file = Container::begin(part_file.clone(), LIBRARY, header.compression)
            .map_err(|source| LogError::io(path, "create", source))?;
        let wanted = |channel: &Channel| {
            header.channels.contains(channel)
                && channel.exists(Scenery {
                    three: header.dimension == 3,
                    one: header.bodies.is_empty(),
                    several: !header.bodies.is_empty(),
                    sources: header.scene.has_sources(),
                    ..Scenery::ALL
                })
        };
        let channels: Vec<_> = Channel::all().into_iter().filter(wanted).collect();
        let bodies: Vec<BodyName> = header.bodies.iter().map(|body| body.name).collect();
        let bytes = |channel: &Channel| {
            let by_body = channel.is_of_each_body() || *channel == Channel::Tf;
            let times = if by_body { bodies.len().max(1) as u64 } else { 1 };
            times * channel.bytes_per_sample(header.dimension)
        };
        let sample_bytes: u64 = channels.iter().map(bytes).sum();
        let of_members = header.members.iter().flat_map(|&member| {
            let sampled =
                channels.iter().filter(move |channel| member == 0 || channel.is_sampled());
            sampled.flat_map({
                let bodies = &bodies;
                move |&channel| {
                    let of_each = channel.is_of_each_body();
                    let named = bodies.iter().filter(move |_| of_each).map(|&body| Some(body));
                    named.chain((!of_each).then_some(None)).map(move |body| Topic {
                        member,
                        channel,
                        body,
                    })
                }
            })
        });
        let topics: Vec<Topic> = of_members.collect();
        let syncer = Syncer::new(part_file.clone(), path);
        let turns = |topic: &Topic| {
            matches!(topic.channel, Channel::State | Channel::BodyState | Channel::Tf)
        };
        let mut log = Self {
            path: path.to_owned(),
            dimension: header.dimension,
            part: PathBuf::new(),
            chunk: Chunk::default(),
            catalog: Catalog::default(),
            durable: syncer.durable(),
            place: Place::Here(Box::new(ChunkWriter::new(file, syncer))),
            part_file,
            given_up: false,
            rest: Rest::Removed,
            epoch_ns: header.epoch_ns,
            scene: header.scene.clone(),
            bodies,
            samples_per_chunk: header
                .samples_per_chunk
                .min(MAX_CHUNK_BYTES / 2 / sample_bytes.max(1))
                .max(1),
            shows_turns: topics.iter().any(turns),
            topics,
            ids: Vec::new(),
            samples: 0,
            closed_at: 0,
            last_ns: header.epoch_ns,
            turns: BTreeMap::new(),
            curves: Curves::default(),
        };
        let start = log.time(0.0)?;
        let mut job = Cow::Borrowed(&header.job);
        if !log.bodies.is_empty() {
            let names: Vec<&str> = log.bodies.iter().map(BodyName::as_str).collect();
            let names = serde_json::Value::from(names).to_string();
            job.to_mut().insert(BODIES_ENTRY.to_owned(), names);
        }
        log.attempt(|writer| writer.container().metadata(JOB_RECORD, &job))?;
        if let Some(scenario) = &header.scenario_json {
            log.attach(start, SCENARIO_ATTACHMENT, "application/json", scenario)?;
        }
        Ok(log)
    }

    fn attach(
        &mut self,
        time_ns: u64,
        name: &str,
        media_type: &str,
        data: &[u8],
    ) -> Result<(), LogError> {
        self.attempt(|writer| writer.container().attach(time_ns, name, media_type, data))
    }

    /// Adds a line to `/log`, if that is written; its time is never before that of the last
    /// message.
    ///
    /// # Errors
    /// If the file cannot be written, or the log cannot hold the time.
    pub fn message(&mut self, level: Level, time_s: f64, text: &str) -> Result<(), LogError> {
        let time_ns = self.time(time_s)?.max(self.last_ns);
        let level = match level {
            Level::Info => FoxgloveLevel::Info,
            Level::Warning => FoxgloveLevel::Warning,
            Level::Error => FoxgloveLevel::Error,
        };
        let line = Log {
            timestamp: timestamp(time_ns),
            level: level.into(),
            message: text.to_owned(),
            name: "vpd".to_owned(),
            ..Log::default()
        };
        self.put(Channel::Log, time_ns, &line)
    }

    /// Returns the number of samples recorded so far.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Returns the step up to which the log is on the disk: what a reader finds after a power cut.
    pub fn durable_step(&self) -> u64 {
        self.durable.step()
    }

    /// Returns the number of bytes of the unfinished log that are on the disk.
    pub fn durable_bytes(&self) -> u64 {
        self.durable.bytes()
    }

    /// Writes a checkpoint and closes the chunk with it.
    ///
    /// # Errors
    /// If the file cannot be written, or an earlier write or sync failed.
    pub fn checkpoint(&mut self, checkpoint: &messages::Checkpoint) -> Result<(), LogError> {
        if !self.chunk.has_messages() {
            return self.close_chunk(None);
        }
        self.close_chunk(Some((&checkpoint.encode_to_vec(), checkpoint.step)))?;
        // The samples that follow need not wait for it.
        if let Place::Here(_) = &self.place
            && let Place::Here(writer) = std::mem::replace(&mut self.place, Place::Lost)
        {
            let thread =
                WriterThread::start(writer).map_err(|source| self.refused(("write", source)))?;
            self.place = Place::There(thread);
        }
        Ok(())
    }

    /// Leaves the log unfinished, to be resumed by [`LogWriter::resume`].
    pub fn leave(mut self) {
        // What fails now is as if it had not been tried.
        let _ = self.recall();
        self.part_file.leave();
        self.part = PathBuf::new();
    }

    /// Closes the log and gives it its name. Afterwards it is on the disk, its name included.
    ///
    /// # Errors
    /// If the file cannot be written, synced or renamed, or an earlier write failed.
    pub fn finish(mut self, outcome: Outcome) -> Result<(), LogError> {
        for (name, svg) in &outcome.charts {
            self.attach(self.last_ns, name, "image/svg+xml", svg.as_bytes())?;
        }
        for (name, overview) in std::mem::take(&mut self.curves).overviews(self.samples) {
            let bytes = overview.encode_to_vec();
            self.attach(self.last_ns, &name, "application/protobuf", &bytes)?;
        }
        let mut metadata = outcome.entries;
        metadata.insert("state".to_owned(), outcome.state);
        metadata.insert("samples".to_owned(), self.samples.to_string());
        self.attempt(|writer| writer.container().metadata(OUTCOME_RECORD, &metadata))?;
        let Place::Here(writer) = std::mem::replace(&mut self.place, Place::Lost) else {
            return Err(LogError::GivenUp { path: self.path.clone() });
        };
        let (container, mut syncer) = writer.into_parts();
        let ended = container.finish(&self.catalog);
        ended.map_err(|source| self.refused(("write", source)))?;

        let synced = syncer.settle().and_then(|()| self.part_file.close());
        // The file stays locked until it has its name.
        let _file = synced.map_err(|source| self.refused(("sync", source)))?;
        let renamed = fs::rename(&self.part, &self.path);
        renamed.map_err(|source| self.refused(("rename", source)))?;
        self.part = PathBuf::new();
        // The rename is durable with its directory.
        sync_folder(folder(&self.path)).map_err(|source| LogError::io(&self.path, "sync", source))
    }

    /// Takes note that the file system refused something: no more is written, and the file stays if
    /// that may succeed later.
    fn refused(&mut self, (action, source): Refusal) -> LogError {
        self.given_up = true;
        self.rest = match (is_transient(&source), action) {
            (false, _) => self.rest,
            (true, "sync") => Rest::KeptWhereSynced,
            (true, _) => Rest::Kept,
        };
        LogError::io(&self.path, action, source)
    }

    fn time(&self, time_s: f64) -> Result<u64, LogError> {
        let epoch_ns = self.epoch_ns;
        super::log_time(epoch_ns, time_s).ok_or(LogError::Time { time_s, epoch_ns })
    }

    /// Writes one message, if its channel is wanted.
    fn put(
        &mut self,
        channel: Channel,
        time_ns: u64,
        message: &impl Message,
    ) -> Result<(), LogError> {
        self.put_on(channel.into(), time_ns, message)
    }

    fn put_on(
        &mut self,
        topic: Topic,
        time_ns: u64,
        message: &impl Message,
    ) -> Result<(), LogError> {
        if let Some(at) = self.topics.iter().position(|of| *of == topic) {
            self.put_at(at, time_ns, self.samples as u32, |out| encode(message, out))?;
        }
        Ok(())
    }

    /// Writes a message of the topic at a place in their list, which `encode` puts into bytes.
    fn put_at(
        &mut self,
        at: usize,
        time_ns: u64,
        sequence: u32,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), LogError> {
        if self.given_up {
            return Err(LogError::GivenUp { path: self.path.clone() });
        }
        self.last_ns = time_ns;
        // Registered only now, with a message at hand: channels without one leave an empty chunk
        // that starts in 1970, and viewers with it.
        if self.ids.is_empty() {
            for topic in &self.topics {
                let schema = topic.channel.schema();
                let schema = (schema.name, &*schema.descriptors);
                self.ids.push(self.chunk.channel(&mut self.catalog, topic.name(), schema));
            }
        }
        self.chunk.message(self.ids[at], sequence, time_ns, encode);
        Ok(())
    }

    /// Writes a message of an earlier run again; nothing if its topic is not written.
    pub(super) fn put_again(
        &mut self,
        topic: Topic,
        time_ns: u64,
        sequence: u32,
        data: &[u8],
    ) -> Result<(), LogError> {
        let at = self.topics.iter().position(|of| *of == topic);
        at.map_or(Ok(()), |at| {
            self.put_at(at, time_ns, sequence, |out| out.extend_from_slice(data))
        })
    }

    /// Ends a chunk of an earlier run, which is on the disk or soon will be.
    pub(super) fn close_chunk_again(&mut self, record: &[u8]) -> Result<(), LogError> {
        self.chunk.private(CHECKPOINT_OPCODE, record);
        self.close_chunk(None)
    }

    /// Takes note that the file is on the disk up to `step`.
    pub(super) fn settled(&self, step: u64) {
        if let Place::Here(writer) = &self.place {
            writer.syncer().settled(step);
        }
    }

    /// Ends the chunk, with the record of a checkpoint and its step if there is one.
    fn close_chunk(&mut self, checkpoint: Option<(&[u8], u64)>) -> Result<(), LogError> {
        self.closed_at = self.samples;
        if let Some((record, _)) = checkpoint {
            self.chunk.private(CHECKPOINT_OPCODE, record);
        }
        let step = checkpoint.map(|(_, step)| step);
        if self.given_up {
            return Err(LogError::GivenUp { path: self.path.clone() });
        }
        let done = match &mut self.place {
            Place::Here(writer) => {
                let done = writer.write(&self.chunk, step);
                self.chunk.clear();
                done
            }
            Place::There(thread) => match thread.hand_over(std::mem::take(&mut self.chunk), step) {
                Some(chunk) => {
                    self.chunk = chunk;
                    Ok(())
                }
                None => return self.recall(),
            },
            Place::Lost => return Err(LogError::GivenUp { path: self.path.clone() }),
        };
        done.map_err(|refusal| self.refused(refusal))
    }

    /// Waits until all chunks are written, and takes back what writes them.
    fn recall(&mut self) -> Result<(), LogError> {
        if let Place::There(_) = &self.place
            && let Place::There(thread) = std::mem::replace(&mut self.place, Place::Lost)
        {
            let (writer, done) = thread.stop();
            if let Some(writer) = writer {
                self.place = Place::Here(writer);
            }
            done.map_err(|refusal| self.refused(refusal))?;
        }
        Ok(())
    }

    /// Writes something behind the open chunk, unless an earlier attempt failed.
    fn attempt(
        &mut self,
        action: impl FnOnce(&mut ChunkWriter) -> std::io::Result<()>,
    ) -> Result<(), LogError> {
        if self.given_up {
            return Err(LogError::GivenUp { path: self.path.clone() });
        }
        if self.chunk.has_messages() {
            self.close_chunk(None)?;
        }
        self.recall()?;
        let Place::Here(writer) = &mut self.place else {
            return Err(LogError::GivenUp { path: self.path.clone() });
        };
        action(writer).map_err(|source| self.refused(("write", source)))
    }

    /// Takes a sample of a member of an ensemble.
    ///
    /// # Errors
    /// If it holds values that a log cannot hold, or the file cannot be written.
    ///
    /// # Panics
    /// If it is of another dimension than the log.
    pub fn record_member<const N: usize>(
        &mut self,
        member: u64,
        sample: &Sample<N>,
    ) -> Result<(), LogError> {
        assert_eq!(N, self.dimension, "a log is of one dimension");
        let attitude = sample.attitude.as_ref().filter(|_| self.shows_turns);
        let seen = SampleSeen {
            step: sample.step,
            time_s: sample.time_s,
            finite: sample.is_finite(),
            poses: &[(attitude.and_then(messages::quaternion), [0.0; 3])],
            reference: sample.pointing.map(|pointed| pointed.frame),
        };
        let message = |channel, _, turn| SampleMessage::of_sample(channel, sample, turn);
        self.record_seen(member, seen, &message)
    }

    /// Takes a sample of several bodies, of a member of an ensemble; of a run is member 0.
    ///
    /// # Errors
    /// If it holds values that a log cannot hold, or the file cannot be written.
    ///
    /// # Panics
    /// If it is of another dimension than the log, or of another number of bodies.
    pub fn record_bodies<const N: usize>(
        &mut self,
        member: u64,
        sample: &bodies::Sample<N>,
    ) -> Result<(), LogError> {
        assert_eq!(N, self.dimension, "a log is of one dimension");
        assert_eq!(sample.bodies.len(), self.bodies.len(), "the bodies of a log stay");
        let shows_turns = self.shows_turns;
        let poses = sample.bodies.iter().map(|body| {
            let turn = shows_turns.then(|| messages::quaternion(&body.attitude)).flatten();
            let place = body.position.as_slice();
            (turn, std::array::from_fn(|i| place.get(i).copied().unwrap_or_default()))
        });
        let seen = SampleSeen {
            step: sample.step,
            time_s: sample.time_s,
            finite: sample.is_finite(),
            poses: &poses.collect::<Vec<_>>(),
            reference: None,
        };
        let message = |channel, body, turn| SampleMessage::of_bodies(channel, body, sample, turn);
        self.record_seen(member, seen, &message)
    }

    /// Does the same, compiled once for all dimensions.
    fn record_seen(
        &mut self,
        member: u64,
        sample: SampleSeen<'_>,
        message: &dyn Fn(Channel, usize, Option<[f64; 4]>) -> Option<SampleMessage>,
    ) -> Result<(), LogError> {
        let time_ns = self.time(sample.time_s)?;
        if time_ns < self.last_ns {
            return Err(LogError::Time { time_s: sample.time_s, epoch_ns: self.epoch_ns });
        }
        if !sample.finite {
            return Err(LogError::NotFinite { step: sample.step });
        }
        if self.wants_checkpoint() {
            // No checkpoint was offered.
            self.close_chunk(None)?;
        }
        // The sample's number; it wraps, as the format's counter does.
        let sequence = self.samples as u32;
        for (body, (found, _)) in sample.poses.iter().enumerate() {
            let Some(found) = *found else { continue };
            let before = self.turns.get(&(member, body)).copied();
            self.turns.insert((member, body), messages::nearer_sign(before, found));
        }
        // The number of the next body, on a channel of each.
        let mut next = 0;
        for i in 0..self.topics.len() {
            let topic = self.topics[i];
            if topic.member != member {
                continue;
            }
            let body = if topic.body.is_some() { next } else { 0 };
            next = if topic.body.is_some() { (next + 1) % self.bodies.len() } else { 0 };
            if topic.channel == Channel::Tf {
                let frames = self.frames(member, &sample, time_ns);
                if !frames.transforms.is_empty() {
                    self.put_at(i, time_ns, sequence, |out| encode(&frames, out))?;
                }
                continue;
            }
            let turn = sample.poses.get(body).and_then(|(found, _)| *found);
            let turn = turn.and(self.turns.get(&(member, body)).copied());
            if let Some(message) = message(topic.channel, body, turn) {
                self.curves.note(topic, time_ns - self.epoch_ns, &message);
                self.put_at(i, time_ns, sequence, |out| message.encode(out))?;
            }
        }
        self.samples += 1;
        Ok(())
    }

    /// Returns the frames of a sample: of the bodies that have a quaternion, and behind them of what moves around them; none
    /// without such a body.
    fn frames(&self, member: u64, sample: &SampleSeen<'_>, time_ns: u64) -> FrameTransforms {
        let frame = |(body, (found, place)): (usize, &Pose)| {
            let turn = found.and(self.turns.get(&(member, body)).copied())?;
            let name = match (self.bodies.get(body).map(BodyName::as_str), member) {
                (None, _) => body_frame(member),
                (Some(name), 0) => Cow::Borrowed(name),
                (Some(name), _) => Cow::Owned(format!("{name}/{member}")),
            };
            Some(messages::frame(turn, *place, time_ns, &name))
        };
        let mut transforms: Vec<_> = sample.poses.iter().enumerate().filter_map(frame).collect();
        // Moving objects move alike for all members.
        if member == 0 && !transforms.is_empty() {
            transforms.extend(self.scene.frames(sample.time_s, time_ns));
            transforms.extend(messages::reference_frame(sample.reference, time_ns));
        }
        FrameTransforms { transforms }
    }

    /// Adds how a member of an ensemble began and ended; its time is that of the whole run.
    ///
    /// # Errors
    /// If the file cannot be written, or the log cannot hold the time.
    pub fn member(&mut self, time_s: f64, member: &Member) -> Result<(), LogError> {
        let time_ns = self.time(time_s)?.max(self.last_ns);
        self.put(Channel::EnsembleMembers, time_ns, member)
    }

    /// Adds mean and spread of the members of an ensemble.
    ///
    /// # Errors
    /// If the file cannot be written, or the log cannot hold the time.
    pub fn statistics(&mut self, statistics: &EnsembleStatistics) -> Result<(), LogError> {
        let time_ns = self.time(statistics.time_s)?.max(self.last_ns);
        self.put(Channel::EnsembleStatistics, time_ns, statistics)
    }

    /// Returns whether the open chunk is full.
    pub fn wants_checkpoint(&self) -> bool {
        self.samples - self.closed_at == self.samples_per_chunk
    }
}

/// Adds the bytes of a message.
fn encode(message: &impl Message, out: &mut Vec<u8>) {
    message.encode(out).expect("a vector has room");
}

/// Quaternion of a body, where messages show one, and its place in space.
type Pose = (Option<[f64; 4]>, [f64; 3]);

/// Parts of a sample that the writer looks at.
struct SampleSeen<'a> {
    step: u64,
    time_s: f64,
    finite: bool,
    /// Of the body, or of several.
    poses: &'a [Pose],
    /// The frame relative to which the body points.
    reference: Option<[f64; 4]>,
}

impl<const N: usize> Sink<N> for LogWriter {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), LogError> {
        self.record_member(0, sample)
    }

    fn wants_checkpoint(&self) -> bool {
        self.wants_checkpoint()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<N>) -> Result<(), LogError> {
        self.checkpoint(&messages::Checkpoint::of(checkpoint, Figures::default()))
    }
}

impl Drop for LogWriter {
    fn drop(&mut self) {
        // Chunks that wait are not needed: no run resumes from them, or they failed.
        self.part_file.leave();
        let _ = self.recall();
        if let Place::Here(writer) = std::mem::replace(&mut self.place, Place::Lost) {
            let _ = writer.into_parts().1.settle();
        }
        if self.part.as_os_str().is_empty() {
            return;
        }
        // If any of this fails, the file is `.part` and has no outcome.
        let _ = match self.rest {
            Rest::Removed => fs::remove_file(&self.part),
            Rest::Kept => Ok(()),
            Rest::KeptWhereSynced => fs::File::options()
                .write(true)
                .open(&self.part)
                .and_then(|file| file.set_len(self.durable.bytes())),
        };
    }
}
