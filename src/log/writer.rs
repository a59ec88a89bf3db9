//! Writes the log of one job.
//!
//! Invariant: the final name appears with a complete, synced file whose last record is the outcome,
//! or not at all. After an error nothing more is written, and a writer that is dropped before
//! [`LogWriter::finish`] takes its `.part` file with it; only a killed process leaves one behind.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use foxglove::messages::Log;
use foxglove::messages::log::Level as FoxgloveLevel;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, McapResult, WriteOptions};
use prost::Message;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::messages::{self, Energy, Momentum, Orthogonality, Solver, State, timestamp};
use super::scene::SceneGeometry;
use super::schema::{Channel, ENCODING};
use super::{JOB_RECORD, LogError, MAX_CHUNK_BYTES, OUTCOME_RECORD, SCENARIO_ATTACHMENT};
use crate::solve::trajectory::{Sample, Sink};

/// Goes into the file's header; part of the bytes.
const LIBRARY: &str = concat!("vpd/", env!("CARGO_PKG_VERSION"));

/// How chunks are compressed.
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

/// What a log starts with.
#[derive(Clone, Debug)]
pub struct LogHeader {
    /// Log time of t = 0, in nanoseconds since 1970.
    pub epoch_ns: u64,
    /// What to write. Channels that need n = 3 are passed over for other n.
    pub channels: Vec<Channel>,
    /// How chunks are compressed.
    pub compression: Compression,
    /// A chunk is closed, and so is safe from a kill, every so many samples; fewer where the chunk
    /// would outgrow [`MAX_CHUNK_BYTES`].
    pub samples_per_chunk: u64,
    /// The scenario, as attachment.
    pub scenario_json: Vec<u8>,
    /// Entries of the record [`JOB_RECORD`].
    pub job: BTreeMap<String, String>,
    /// What viewers draw.
    pub scene: SceneGeometry,
}

/// How the job ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// `succeeded`, `failed` or `cancelled`; becomes the entry `state`.
    pub state: String,
    /// Further entries of the record [`OUTCOME_RECORD`]. The writer adds `samples`.
    pub entries: BTreeMap<String, String>,
}

/// How grave a line of the log is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// For the record.
    Info,
    /// The user should know.
    Warning,
    /// The job failed.
    Error,
}

/// Writes the log of one job in SO(`N`).
///
/// Nothing is synced to the disk before `finish`; closed chunks are with the operating system,
/// where they survive a kill of the process but not a power cut.
pub struct LogWriter<const N: usize> {
    path: PathBuf,
    part: PathBuf,
    /// `None` once finished.
    file: Option<mcap::Writer<BufWriter<File>>>,
    given_up: bool,
    epoch_ns: u64,
    samples_per_chunk: u64,
    /// What is to be written, in the order of the channel ids.
    channels: Vec<Channel>,
    /// Ids by channel, once registered.
    ids: Option<BTreeMap<Channel, u16>>,
    samples: u64,
    last_ns: u64,
}

impl<const N: usize> LogWriter<N> {
    /// Starts the log of `path` under the name of [`super::part_path`], over anything of that name.
    ///
    /// # Errors
    /// If the file cannot be created or written.
    pub fn create(path: &Path, header: LogHeader) -> Result<Self, LogError> {
        let part = super::part_path(path);
        let file = File::create(&part).map_err(|source| LogError::io(path, "create", source))?;
        let compression = match header.compression {
            Compression::Zstd => Some(mcap::Compression::Zstd),
            Compression::Lz4 => Some(mcap::Compression::Lz4),
            Compression::None => None,
        };
        let file = WriteOptions::new()
            .profile("")
            .library(LIBRARY)
            .compression(compression)
            // Other numbers give other bytes.
            .compression_threads(0)
            // A chunk goes to the file in one piece: a kill leaves whole records.
            .disable_seeking(true)
            // Chunks end by the count of samples alone.
            .chunk_size(None)
            .create(BufWriter::new(file))
            .map_err(|source| LogError::mcap(path, "create", source))?;

        let scene = header.scene;
        let sources = scene.sources(header.epoch_ns);
        let wanted = |channel: &Channel| {
            header.channels.contains(channel)
                && (N == 3 || !channel.needs_three())
                && (*channel != Channel::SceneSources || sources.is_some())
        };
        let channels: Vec<_> = Channel::all().into_iter().filter(wanted).collect();
        let sample_bytes: u64 = channels.iter().map(|channel| channel.bytes_per_sample(N)).sum();
        let mut log = Self {
            path: path.to_owned(),
            part,
            file: Some(file),
            given_up: false,
            epoch_ns: header.epoch_ns,
            samples_per_chunk: header
                .samples_per_chunk
                .min(MAX_CHUNK_BYTES / 2 / sample_bytes.max(1))
                .max(1),
            channels,
            ids: None,
            samples: 0,
            last_ns: header.epoch_ns,
        };

        let start = log.time(0.0)?;
        let job = Metadata { name: JOB_RECORD.to_owned(), metadata: header.job };
        log.attempt(|file| file.write_metadata(&job))?;
        log.attempt(|file| {
            file.attach(&Attachment {
                log_time: start,
                create_time: start,
                name: SCENARIO_ATTACHMENT.to_owned(),
                media_type: "application/json".to_owned(),
                data: Cow::Owned(header.scenario_json),
            })
        })?;
        log.put(Channel::SceneBody, start, &scene.body(start))?;
        if let Some(sources) = sources {
            log.put(Channel::SceneSources, start, &sources)?;
        }
        log.message(Level::Info, 0.0, "started")?;
        Ok(log)
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

    /// Samples recorded so far.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Closes the log and gives it its name. Afterwards it is on the disk, its name included.
    ///
    /// # Errors
    /// If the file cannot be written, synced or renamed, or an earlier write failed.
    pub fn finish(mut self, outcome: Outcome) -> Result<(), LogError> {
        let mut metadata = outcome.entries;
        metadata.insert("state".to_owned(), outcome.state);
        metadata.insert("samples".to_owned(), self.samples.to_string());
        let record = Metadata { name: OUTCOME_RECORD.to_owned(), metadata };
        self.attempt(|file| file.write_metadata(&record))?;
        self.attempt(|file| file.finish().map(drop))?;

        let storage = |action| {
            let path = self.path.clone();
            move |source| LogError::io(&path, action, source)
        };
        let Some(file) = self.file.take() else {
            return Err(LogError::GivenUp { path: self.path.clone() });
        };
        let file =
            file.into_inner().into_inner().map_err(|error| storage("write")(error.into_error()))?;
        file.sync_all().map_err(storage("sync"))?;
        fs::rename(&self.part, &self.path).map_err(storage("rename"))?;
        self.part = PathBuf::new();
        // The rename is durable with its directory.
        let folder = match self.path.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        File::open(folder).and_then(|folder| folder.sync_all()).map_err(storage("sync"))
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
        if !self.channels.contains(&channel) {
            return Ok(());
        }
        // Only now, with a message at hand: channels without one leave an empty chunk that starts
        // in 1970, and viewers with it.
        if self.ids.is_none() {
            self.register()?;
        }
        let Some(&channel_id) = self.ids.as_ref().and_then(|ids| ids.get(&channel)) else {
            return Ok(());
        };
        let payload = message.encode_to_vec();
        let header = MessageHeader {
            channel_id,
            // The sample's number; it wraps, as the format's counter does.
            sequence: self.samples as u32,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.last_ns = time_ns;
        self.attempt(|file| file.write_to_known_channel(&header, &payload))
    }

    fn put_some(
        &mut self,
        channel: Channel,
        time_ns: u64,
        message: Option<impl Message>,
    ) -> Result<(), LogError> {
        message.map_or(Ok(()), |message| self.put(channel, time_ns, &message))
    }

    fn register(&mut self) -> Result<(), LogError> {
        let mut ids = BTreeMap::new();
        for channel in self.channels.clone() {
            let schema = channel.schema();
            let id = self.attempt(|file| {
                let schema = file.add_schema(schema.name, ENCODING, &schema.descriptors)?;
                file.add_channel(schema, channel.topic(), ENCODING, &BTreeMap::new())
            })?;
            ids.insert(channel, id);
        }
        self.ids = Some(ids);
        Ok(())
    }

    /// Does something to the file, unless an earlier attempt failed.
    fn attempt<T>(
        &mut self,
        action: impl FnOnce(&mut mcap::Writer<BufWriter<File>>) -> McapResult<T>,
    ) -> Result<T, LogError> {
        let file = match &mut self.file {
            Some(file) if !self.given_up => file,
            _ => {
                return Err(LogError::GivenUp { path: self.path.clone() });
            }
        };
        action(file).map_err(|source| {
            self.given_up = true;
            LogError::mcap(&self.path, "write", source)
        })
    }
}

impl<const N: usize> Sink<N> for LogWriter<N> {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), LogError> {
        let time_ns = self.time(sample.time_s)?;
        if time_ns < self.last_ns {
            return Err(LogError::Time { time_s: sample.time_s, epoch_ns: self.epoch_ns });
        }
        if !finite(sample) {
            return Err(LogError::NotFinite { step: sample.step });
        }
        for channel in self.channels.clone() {
            match channel {
                Channel::State => self.put(channel, time_ns, &State::of(sample))?,
                Channel::Energy => self.put_some(channel, time_ns, Energy::of(sample))?,
                Channel::Orthogonality => {
                    self.put_some(channel, time_ns, Orthogonality::of(sample))?;
                }
                Channel::Momentum => self.put_some(channel, time_ns, Momentum::of(sample))?,
                Channel::Solver => self.put_some(channel, time_ns, Solver::of(sample))?,
                Channel::Tf => {
                    self.put_some(channel, time_ns, messages::frames(sample, time_ns))?;
                }
                Channel::SceneBody | Channel::SceneSources | Channel::Log => {}
            }
        }
        self.samples += 1;
        if self.samples.is_multiple_of(self.samples_per_chunk) {
            self.attempt(mcap::Writer::flush)?;
        }
        Ok(())
    }
}

impl<const N: usize> Drop for LogWriter<N> {
    fn drop(&mut self) {
        if self.part.as_os_str().is_empty() {
            return;
        }
        // First the name, then the file: the MCAP writer completes its file when dropped, and that
        // must not be seen.
        let removed = fs::remove_file(&self.part);
        self.file = None;
        if removed.is_err() {
            // Systems that keep open files. If this fails too, the file has no outcome and is
            // `.part`.
            let _ = fs::remove_file(&self.part);
        }
    }
}

/// Whether every number of a sample can be plotted.
fn finite<const N: usize>(sample: &Sample<N>) -> bool {
    let scalars = [
        sample.energy.map(|energy| energy.kinetic),
        sample.energy.map(|energy| energy.potential),
        sample.energy.map(|energy| energy.total()),
        sample.energy_error,
        sample.orthogonality_error,
        sample.momentum_drift,
        sample.convergence.map(|convergence| convergence.increment),
        sample.sigma_min,
    ];
    let state = sample.attitude.iter().flatten().chain(&sample.momentum);
    let spatial = sample.spatial_momentum.iter().flatten();
    scalars.iter().flatten().chain(state).chain(spatial).all(|x| x.is_finite())
}
