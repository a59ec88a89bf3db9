//! Sums a log up: how it ended, what it holds, how large the errors became.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::ControlFlow;
use std::path::Path;

use prost::Message as _;
use serde::Serialize;

use super::messages::Checkpoint;
use super::reader::{self, Item, Message};
use super::{JOB_RECORD, LogError, OUTCOME_RECORD, shown};

/// The sum of a log.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Inspection {
    /// Whether the log is whole and says how the job ended.
    pub finished: bool,
    /// Damage that keeps it from being whole.
    pub damage: Option<String>,
    /// What no checksum covers, in a log that another program wrote anew.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unchecked: Option<String>,
    /// Entries of the outcome; `state` is `succeeded`, `failed` or `cancelled`.
    pub outcome: Option<BTreeMap<String, String>>,
    /// The job that was run: scenario, plan, versions.
    pub job: Option<BTreeMap<String, String>>,
    /// Topics with at least one message, in the order of their first.
    pub topics: Vec<Topic>,
    /// Log times of the first and the last message.
    pub span: Option<Span>,
    /// Samples: messages of the fullest of the topics that carry samples.
    pub samples: u64,
    /// Chunks.
    pub chunks: u64,
    /// The step of the last checkpoint, from which the run would go on.
    pub resumes_at_step: Option<u64>,
    /// Bytes of the file.
    pub bytes: u64,
    /// The largest errors and similar figures.
    pub extremes: Extremes,
}

/// A topic of a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Topic {
    /// Its name.
    pub topic: String,
    /// Its message type.
    pub schema: String,
    /// Its messages.
    pub messages: u64,
}

/// A stretch of log time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Span {
    /// First message, in nanoseconds since 1970.
    pub start_ns: u64,
    /// Last message, in nanoseconds since 1970.
    pub end_ns: u64,
    /// Seconds between the two.
    pub duration_s: f64,
}

/// Extremes over all samples; `None` where the log does not hold the topic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Extremes {
    /// Largest |H - H0|.
    pub energy_max_abs_error: Option<f64>,
    /// Largest distance of the attitude from the group.
    pub orthogonality_max: Option<f64>,
    /// Largest drift of the conserved part of the spatial momentum.
    pub momentum_drift_max: Option<f64>,
    /// Most sweeps of the solver in a step that was sampled.
    pub solver_iterations_max: Option<u32>,
    /// Sweeps of the solver on average over the steps that were sampled.
    pub solver_iterations_mean: Option<f64>,
    /// Smallest singular value met.
    pub sigma_min_min: Option<f64>,
    /// The shortest step in parts of the longest, where they adapt.
    pub sigma_least: Option<f64>,
    /// Steps made until the last sample, where they adapt.
    pub own_steps: Option<u64>,
}

/// Reads the log at `path`, finished or not, and sums it up.
///
/// # Errors
/// If the file cannot be opened or read; damage is no error but part of the result.
pub fn inspect(path: &Path) -> Result<Inspection, LogError> {
    let mut sum = Inspection::default();
    let mut sweeps = Sweeps::default();
    let ending = reader::read(path, |item| {
        match item {
            Item::Metadata { name: JOB_RECORD, entries } => sum.job = Some(entries.clone()),
            Item::Metadata { name: OUTCOME_RECORD, entries } => sum.outcome = Some(entries.clone()),
            Item::Checkpoint { data } => {
                sum.resumes_at_step = Checkpoint::decode(data).ok().map(|found| found.step);
            }
            Item::Message { topic, schema, time_ns, data, .. } => {
                sum.count(topic, schema, time_ns);
                if let Some(message) = Message::decode(topic, schema, data) {
                    sum.extremes.take_in(&message);
                    sweeps.take_in(&message);
                    let count = sum.topics.iter().find(|entry| entry.topic == topic);
                    sum.samples = sum.samples.max(count.map_or(0, |entry| entry.messages));
                }
            }
            Item::Metadata { .. } | Item::Attachment { .. } => {}
        }
        ControlFlow::Continue(())
    })?;
    sum.extremes.solver_iterations_mean = sweeps.mean();
    sum.finished = ending.finished;
    sum.damage = ending.damage;
    sum.unchecked = ending.unchecked;
    sum.chunks = ending.chunks;
    sum.bytes = ending.bytes;
    Ok(sum)
}

impl Inspection {
    fn count(&mut self, topic: &str, schema: &str, time_ns: u64) {
        match self.topics.iter_mut().find(|entry| entry.topic == topic) {
            Some(entry) => entry.messages += 1,
            None => self.topics.push(Topic {
                topic: topic.to_owned(),
                schema: schema.to_owned(),
                messages: 1,
            }),
        }
        let span =
            self.span.get_or_insert(Span { start_ns: time_ns, end_ns: time_ns, duration_s: 0.0 });
        span.start_ns = span.start_ns.min(time_ns);
        span.end_ns = span.end_ns.max(time_ns);
        span.duration_s = (span.end_ns - span.start_ns) as f64 / 1e9;
    }
}

impl Extremes {
    fn take_in(&mut self, message: &Message) {
        let largest = |old: &mut Option<f64>, new: f64| {
            *old = Some(old.map_or(new, |old| old.max(new)));
        };
        match message {
            Message::Pace(pace) => {
                let least =
                    self.sigma_least.map_or(pace.least_sigma, |old| old.min(pace.least_sigma));
                self.sigma_least = Some(least);
                self.own_steps = Some(pace.own_steps);
            }
            Message::Energy(energy) => largest(&mut self.energy_max_abs_error, energy.error.abs()),
            Message::Orthogonality(defect) => largest(&mut self.orthogonality_max, defect.error),
            Message::Momentum(momentum) => {
                if let Some(drift) = momentum.drift {
                    largest(&mut self.momentum_drift_max, drift);
                }
            }
            Message::Solver(solver) => {
                let most = self.solver_iterations_max.unwrap_or(0).max(solver.iterations);
                self.solver_iterations_max = Some(most);
                if let Some(sigma) = solver.sigma_min {
                    let least = self.sigma_min_min.map_or(sigma, |old| old.min(sigma));
                    self.sigma_min_min = Some(least);
                }
            }
            // Other messages have no extremes.
            _ => {}
        }
    }
}

/// The sum behind a mean.
#[derive(Default)]
struct Sweeps {
    sum: u64,
    steps: u64,
}

impl Sweeps {
    fn take_in(&mut self, message: &Message) {
        if let Message::Solver(solver) = message {
            self.sum += u64::from(solver.iterations);
            self.steps += 1;
        }
    }

    fn mean(&self) -> Option<f64> {
        (self.steps > 0).then(|| self.sum as f64 / self.steps as f64)
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let state = self.outcome.as_ref().and_then(|outcome| outcome.get("state"));
        match (self.finished, state) {
            (true, Some(state)) => writeln!(f, "finished: {}", shown(state))?,
            (true, None) => writeln!(f, "finished")?,
            (false, _) => {
                writeln!(
                    f,
                    "not finished: {}",
                    shown(self.damage.as_deref().unwrap_or("unknown reason"))
                )?;
            }
        }
        if let Some(unchecked) = &self.unchecked {
            writeln!(f, "not checked: {unchecked}")?;
        }
        let duration_s = self.span.map_or(0.0, |span| span.duration_s);
        writeln!(
            f,
            "{} samples over {duration_s} s of simulated time, {} chunks, {} bytes",
            self.samples, self.chunks, self.bytes
        )?;
        let width = self.topics.iter().map(|entry| entry.topic.len()).max().unwrap_or(0);
        let kind = self.topics.iter().map(|entry| entry.schema.len()).max().unwrap_or(0);
        for Topic { topic, schema, messages } in &self.topics {
            let (topic, schema) = (shown(topic), shown(schema));
            writeln!(f, "  {topic:width$}  {schema:kind$}  {messages}")?;
        }
        let extremes = &self.extremes;
        for (name, value, unit) in [
            ("energy, largest error", extremes.energy_max_abs_error, " J"),
            ("orthogonality, largest |g g^T - I|", extremes.orthogonality_max, ""),
            ("momentum, largest drift", extremes.momentum_drift_max, " kg m^2/s"),
            ("smallest singular value", extremes.sigma_min_min, ""),
            ("shortest step, relative to the longest", extremes.sigma_least, ""),
        ] {
            if let Some(value) = value {
                writeln!(f, "{name}: {value:.3e}{unit}")?;
            }
        }
        if let Some((most, mean)) =
            extremes.solver_iterations_max.zip(extremes.solver_iterations_mean)
        {
            writeln!(f, "solver iterations per step: {mean:.2} on average, {most} at most")?;
        }
        if let Some(own_steps) = extremes.own_steps {
            writeln!(f, "steps that adapt: {own_steps}")?;
        }
        for (title, entries) in [("outcome", &self.outcome), ("job", &self.job)] {
            for (key, value) in entries.iter().flatten() {
                // Whole documents ride in the entries: here their beginning is enough.
                let line: String = value.chars().take(100).collect();
                let more = if line.len() < value.len() { " ..." } else { "" };
                let line = shown(&line.replace('\n', " "));
                writeln!(f, "{title}.{}: {line}{more}", shown(key))?;
            }
        }
        Ok(())
    }
}
