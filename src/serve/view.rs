//! Types of the answers.

use chrono::{DateTime, Utc};
use foxglove::remote_data_loader_backend::{DataSource, Manifest};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::Value;
use serde_json::value::RawValue;
use uuid::Uuid;

use super::job::{Fault, State, Trouble, View};
use super::link::{LinkKey, Subject};
use super::store::LogSum;
use crate::plan::Plan;
use crate::run::{Diagnosis, Summary};
use crate::scenario::SHIPPED;

/// A job in answers to clients.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "Job")]
pub(super) struct JobView {
    id: Uuid,
    name: String,
    state: State,
    /// Time when it was taken.
    created: Option<DateTime<Utc>>,
    /// Runs so far.
    attempts: u32,
    progress: Progress,
    /// Reason why it waits although a run of it began: the store refused something, and it is tried
    /// again.
    #[serde(skip_serializing_if = "Option::is_none")]
    trouble: Option<Trouble>,
    /// Size and checksum of the finished log.
    #[serde(skip_serializing_if = "Option::is_none")]
    log: Option<LogSum>,
    /// What will be modelled and why; absent in lists once the job has ended, and until an accuracy is
    /// turned into a method and a step.
    #[schemars(with = "Option<Plan>")]
    plan: Option<Box<RawValue>>,
    /// Time when it ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    finished: Option<DateTime<Utc>>,
    /// The figures of its run.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<Summary>")]
    summary: Option<Value>,
    /// Reason why it failed: code, cause, advice.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<JobDiagnosis>")]
    diagnosis: Option<Value>,
    links: Links,
}

/// Reason why a job failed, with a `code` for programs.
#[derive(JsonSchema)]
#[schemars(untagged)]
#[expect(dead_code, reason = "only its schema is used")]
enum JobDiagnosis {
    /// A step could not be made.
    Step(Diagnosis),
    /// There is no run to report on.
    Job(Fault),
}

/// Progress of a job.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub(super) struct Progress {
    steps: u64,
    steps_done: u64,
    /// The step up to which the log is on the disk: a crash costs no step before it.
    durable_step: u64,
    percent: f64,
    /// Seconds left.
    eta_s: Option<f64>,
}

/// Addresses by which the client, and so its viewers, reach the service.
#[derive(Clone, Debug, Default)]
pub(super) struct Reach {
    /// The address of the service.
    pub(super) base: Option<String>,
    /// The address of the live view, if there is one that they reach.
    pub(super) live: Option<String>,
    /// Key that signs the links that viewers follow, where there are tokens.
    pub(super) links: Option<LinkKey>,
}

impl Reach {
    /// Returns the query to add to an address, so that a viewer may read there.
    fn pass(&self, subject: Subject) -> String {
        self.links.as_ref().map_or(String::new(), |links| format!("?{}", links.query(subject)))
    }

    /// Returns the address of a finished log.
    fn log(&self, id: Uuid) -> String {
        format!("/jobs/{id}/log.mcap{}", self.pass(Subject::Log(id)))
    }
}

/// Links of a job.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "JobLinks")]
struct Links {
    #[serde(rename = "self")]
    this: String,
    scenario: String,
    /// The scenario as it was sent.
    sent: String,
    events: String,
    /// The finished log. Where there are tokens this address, and each that opens a log in a
    /// viewer, is signed: anyone who
    /// has it may read this log without a token, for a day.
    #[serde(skip_serializing_if = "Option::is_none")]
    log: Option<String>,
    /// The log as it grows.
    #[serde(skip_serializing_if = "Option::is_none")]
    live: Option<String>,
    /// Attitudes and shapes of the scene, for drawing.
    #[serde(skip_serializing_if = "Option::is_none")]
    attitudes: Option<String>,
    /// Quantities over time.
    #[serde(skip_serializing_if = "Option::is_none")]
    samples: Option<String>,
    /// Charts drawn from the finished log.
    #[serde(skip_serializing_if = "Option::is_none")]
    charts: Option<Charts>,
    /// Links that open the log in viewers.
    #[serde(skip_serializing_if = "Option::is_none")]
    viewers: Option<Viewers>,
    /// While the job runs, where the service has a live view: links that open it in viewers. It shows one
    /// job at a time.
    #[serde(skip_serializing_if = "Option::is_none")]
    live_viewers: Option<LiveViewers>,
}

/// Charts of a log.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "ChartLinks")]
struct Charts {
    energy: String,
    orthogonality: String,
    momentum: String,
}

/// Links that open a log in viewers. A desktop link does nothing where the program is not installed.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "ViewerLinks")]
struct Viewers {
    foxglove: String,
    foxglove_desktop: String,
    lichtblick_desktop: String,
    rerun: String,
}

/// The live view, and links that open it in viewers.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "LiveViewerLinks")]
struct LiveViewers {
    /// Its address, of Foxglove's WebSocket protocol.
    address: String,
    foxglove: String,
    foxglove_desktop: String,
    lichtblick_desktop: String,
}

/// A server-sent event; only its schema is used.
#[derive(JsonSchema)]
#[allow(dead_code, reason = "events are written by axum")]
pub(super) struct JobEvent {
    event: EventName,
    /// As JSON: the job for `state`, its progress for `progress`.
    data: String,
}

#[derive(JsonSchema)]
#[schemars(rename_all = "snake_case")]
#[allow(dead_code, reason = "events are written by axum")]
enum EventName {
    State,
    Progress,
}

/// Returns what Foxglove's remote data loader asks for, of a job with a finished log: where it is read, by ranges.
pub(super) fn manifest(view: View, reach: &Reach) -> Manifest {
    let supports_range_requests = Default::default();
    let log = DataSource::StaticFile { url: reach.log(view.id), supports_range_requests };
    Manifest { name: Some(view.name), sources: vec![log] }
}

/// A page of jobs.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct JobList {
    jobs: Vec<JobView>,
    /// Cursor of the next page; null on the last one.
    next_cursor: Option<Uuid>,
    links: PageLinks,
}

#[derive(Debug, Serialize, JsonSchema)]
struct PageLinks {
    next: Option<String>,
}

/// The shipped examples.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct ScenarioList {
    scenarios: Vec<ScenarioEntry>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct ScenarioEntry {
    name: &'static str,
    /// Description of the scene; absent if it has none.
    description: Option<String>,
    links: ScenarioLinks,
}

#[derive(Debug, Serialize, JsonSchema)]
struct ScenarioLinks {
    #[serde(rename = "self")]
    this: String,
}

/// State of the service.
#[derive(Debug, Serialize, JsonSchema)]
#[schemars(rename = "ServiceStatus")]
pub(super) struct Status {
    pub(super) status: &'static str,
}

impl JobView {
    /// Returns a job for a client that reaches us by `reach`.
    pub(super) fn new(view: View, reach: &Reach) -> Self {
        let progress = Progress::of(&view);
        let View { id, name, state, created, attempts, has_log, plan, record, .. } = view;
        let (trouble, sum) = (view.trouble, view.log);
        let (finished, summary, diagnosis) = record
            .map(|record| (record.finished, record.summary, record.diagnosis))
            .unwrap_or_default();
        let will_have_log = has_log || !state.is_final();
        let (pass, log) = (reach.pass(Subject::Log(id)), reach.log(id));
        let base = reach.base.as_deref();
        let viewers =
            base.filter(|_| has_log).map(|base| Viewers::of(base, &format!("{base}{log}")));
        let live = reach.live.as_deref().filter(|_| state == State::Running);
        let live = live.map(|address| match reach.pass(Subject::Live) {
            pass if pass.is_empty() => address.to_owned(),
            pass => format!("{address}/{pass}"),
        });
        Self {
            id,
            name,
            state,
            created,
            attempts,
            progress,
            trouble,
            log: sum,
            plan,
            finished,
            summary,
            diagnosis,
            links: Links {
                this: format!("/jobs/{id}"),
                scenario: format!("/jobs/{id}/scenario.json"),
                sent: format!("/jobs/{id}/sent.json"),
                events: format!("/jobs/{id}/events"),
                log: will_have_log.then_some(log),
                attitudes: will_have_log.then(|| format!("/jobs/{id}/attitudes.json")),
                samples: will_have_log.then(|| format!("/jobs/{id}/samples")),
                charts: has_log.then(|| Charts::of(id)),
                live: will_have_log.then(|| format!("/jobs/{id}/live.mcap{pass}")),
                viewers,
                live_viewers: live.map(|address| LiveViewers::of(base, &address)),
            },
        }
    }
}

impl Progress {
    pub(super) fn of(view: &View) -> Self {
        let View { steps, steps_done, durable_step, eta_s, .. } = *view;
        let percent = if steps == 0 { 0.0 } else { 100.0 * steps_done as f64 / steps as f64 };
        Self {
            steps,
            steps_done,
            durable_step,
            percent: (percent * 100.0).floor() / 100.0,
            eta_s: eta_s.map(|eta| (eta * 10.0).round() / 10.0),
        }
    }
}

impl JobList {
    pub(super) fn new(jobs: Vec<JobView>, next_cursor: Option<Uuid>, next: Option<String>) -> Self {
        Self { jobs, next_cursor, links: PageLinks { next } }
    }
}

impl ScenarioList {
    pub(super) fn shipped() -> Self {
        let scenarios = SHIPPED.iter().map(|&(name, text)| {
            let scenario: Value = serde_json::from_slice(text.as_bytes()).unwrap_or_default();
            let links = ScenarioLinks { this: format!("/scenarios/{name}") };
            let description = scenario["description"].as_str().map(str::to_owned);
            ScenarioEntry { name, description, links }
        });
        Self { scenarios: scenarios.collect() }
    }
}

impl Charts {
    fn of(id: Uuid) -> Self {
        let chart = |name: &str| format!("/jobs/{id}/charts/{name}.svg");
        Self {
            energy: chart("energy"),
            orthogonality: chart("orthogonality"),
            momentum: chart("momentum"),
        }
    }
}

impl Viewers {
    fn of(base: &str, log: &str) -> Self {
        let log = percent_encoded(log);
        let layout = percent_encoded(&format!("{base}/layouts/lichtblick.json"));
        Self {
            foxglove: format!("https://app.foxglove.dev/~/view?ds=remote-file&ds.url={log}"),
            foxglove_desktop: format!("foxglove://open?ds=remote-file&ds.url={log}"),
            lichtblick_desktop: format!(
                "lichtblick://open?ds=remote-file&ds.url={log}&layoutUrl={layout}"
            ),
            rerun: format!("https://rerun.io/viewer?url={log}"),
        }
    }
}

impl LiveViewers {
    fn of(base: Option<&str>, address: &str) -> Self {
        let source = format!("ds=foxglove-websocket&ds.url={}", percent_encoded(address));
        let layout = base.map_or(String::new(), |base| {
            format!("&layoutUrl={}", percent_encoded(&format!("{base}/layouts/lichtblick.json")))
        });
        Self {
            address: address.to_owned(),
            foxglove: format!("https://app.foxglove.dev/~/view?{source}"),
            foxglove_desktop: format!("foxglove://open?{source}"),
            lichtblick_desktop: format!("lichtblick://open?{source}{layout}"),
        }
    }
}

/// Returns a text with everything but RFC 3986's unreserved characters as `%XX`.
pub(super) fn percent_encoded(text: &str) -> String {
    let encode = |byte: u8| match byte {
        b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
            char::from(byte).to_string()
        }
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(encode).collect()
}
