//! Figures for Prometheus.
//!
//! Invariant: counters only grow while the service lives; figures that the index knows are read
//! from it on request.

use std::sync::atomic::AtomicU64;

use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{EncodeLabelSet, EncodeLabelValue, LabelValueEncoder};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::Registry;

use super::job::State;
use super::store::Record;
use crate::study::measure::runs;

/// The type of the text.
pub(super) const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfState {
    state: State,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct OfCode {
    code: String,
}

impl EncodeLabelValue for State {
    fn encode(&self, encoder: &mut LabelValueEncoder<'_>) -> Result<(), std::fmt::Error> {
        self.as_str().encode(encoder)
    }
}

/// All figures.
#[derive(Debug)]
pub(super) struct Metrics {
    registry: Registry,
    accepted: Counter,
    ended: Family<OfState, Counter>,
    failures: Family<OfCode, Counter>,
    aside: Counter,
    steps: Counter,
    log_bytes: Counter,
    step_ns: Histogram,
    iterations: Histogram,
    jobs: Family<OfState, Gauge>,
    queue: Gauge,
    free_bytes: Gauge<u64, AtomicU64>,
    pilot_runs: Gauge<u64, AtomicU64>,
}

impl Metrics {
    /// Creates all figures. `aside` is the number of things in the data directory that a start set
    /// aside.
    pub(super) fn new(aside: usize) -> Self {
        let mut metrics = Self {
            registry: Registry::with_prefix("vpd"),
            accepted: Counter::default(),
            ended: Family::default(),
            failures: Family::default(),
            aside: Counter::default(),
            steps: Counter::default(),
            log_bytes: Counter::default(),
            // From an explicit step of n = 3 to an implicit one of n = 16.
            step_ns: Histogram::new(exponential_buckets(250.0, 2.0, 16)),
            iterations: Histogram::new(exponential_buckets(1.0, 1.5, 12)),
            jobs: Family::default(),
            queue: Gauge::default(),
            free_bytes: Gauge::default(),
            pilot_runs: Gauge::default(),
        };
        let registry = &mut metrics.registry;
        registry.register("jobs_accepted", "Jobs answered 202", metrics.accepted.clone());
        registry.register("jobs_ended", "Jobs that ended, by state", metrics.ended.clone());
        registry.register("job_failures", "Failed jobs, by code", metrics.failures.clone());
        registry.register(
            "set_aside",
            "Jobs and entries of the data directory that cannot be used, since the start",
            metrics.aside.clone(),
        );
        metrics.aside.inc_by(aside as u64);
        registry.register("steps", "Steps of ended jobs", metrics.steps.clone());
        registry.register("log_bytes", "Bytes of finished logs", metrics.log_bytes.clone());
        registry.register(
            "step_nanoseconds",
            "Time of a step within the integrator, mean of each job",
            metrics.step_ns.clone(),
        );
        registry.register(
            "step_iterations",
            "Sweeps of the solver per step, mean of each job",
            metrics.iterations.clone(),
        );
        registry.register("jobs", "Jobs on record, by state", metrics.jobs.clone());
        registry.register("queue_length", "Jobs that are waiting", metrics.queue.clone());
        registry.register(
            "disk_free_bytes",
            "Free bytes on the disk of the data directory",
            metrics.free_bytes.clone(),
        );
        registry.register(
            "pilot_runs",
            "Runs made to plan jobs and for studies, since the start",
            metrics.pilot_runs.clone(),
        );
        metrics
    }

    /// Counts a job whose record cannot be used.
    pub(super) fn set_aside(&self) {
        self.aside.inc();
    }

    /// Counts a job that was answered 202.
    pub(super) fn accept(&self) {
        self.accepted.inc();
    }

    /// Counts a job that has ended, with a log of `log_bytes` bytes.
    pub(super) fn end(&self, record: &Record, log_bytes: u64) {
        self.ended.get_or_create(&OfState { state: record.state }).inc();
        self.steps.inc_by(record.steps_done);
        self.log_bytes.inc_by(log_bytes);
        if record.state == State::Failed {
            let code = record.diagnosis.as_ref().and_then(|found| found["code"].as_str());
            let code = code.unwrap_or("unknown").to_owned();
            self.failures.get_or_create(&OfCode { code }).inc();
        }
        if let Some(summary) = &record.summary {
            if let Some(ns) = summary["ns_per_step"].as_f64().filter(|&ns| ns > 0.0) {
                self.step_ns.observe(ns);
            }
            if let Some(iterations) = summary["solver"]["iterations_per_step"].as_f64() {
                self.iterations.observe(iterations);
            }
        }
    }

    /// Returns the text, with what is known at this moment in addition to the counters.
    pub(super) fn text(&self, jobs: &[(State, usize)], queue: usize, free_bytes: u64) -> String {
        for (state, count) in jobs {
            self.jobs.get_or_create(&OfState { state: *state }).set(*count as i64);
        }
        self.queue.set(queue as i64);
        self.free_bytes.set(free_bytes);
        self.pilot_runs.set(runs());
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = encode(&mut text, &self.registry);
        text
    }
}
