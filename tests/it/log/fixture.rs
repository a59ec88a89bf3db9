//! A small job to log: the dipole on a stick, and functions to inspect the result.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use mcap::records::op;
use tempfile::TempDir;
use vpd::log::inspect::{Inspection, inspect};
use vpd::log::messages::quaternion;
use vpd::log::reader::{self, Item, Message};
use vpd::log::scene::{Marker, SceneGeometry, Sign};
use vpd::log::schema::{Channel, Compression};
use vpd::log::writer::{Level, LogHeader, LogWriter, Outcome};
use vpd::log::{LogError, part_path};
use vpd::solve::hamiltonian::RigidBody;
use vpd::solve::nonlinear::StopRule;
use vpd::solve::so;
use vpd::solve::state;
use vpd::solve::stepper::vpd::Vpd;
use vpd::solve::tableau::Tableau;
use vpd::solve::trajectory::{Observables, Sample, Schedule, Sink, integrate};

pub(super) const EPOCH_NS: u64 = 1_767_225_600_000_000_000;
pub(super) const EVERYTHING: Observables = Observables {
    energy: true,
    orthogonality: true,
    momentum: true,
    sigma_min: true,
    pace: false,
    control: false,
    pointing: false,
    derivatives: false,
};

/// The channels that tests call by name: those of a single run. A log may have others in addition.
pub(crate) const NAMED: [&str; 10] = [
    "/state",
    "/energy",
    "/orthogonality",
    "/momentum",
    "/solver",
    "/pace",
    "/tf",
    "/scene/body",
    "/scene/sources",
    "/log",
];

/// Sink that keeps a copy of the samples that the log should hold.
pub(super) struct Copying {
    pub(super) log: LogWriter,
    pub(super) sent: Vec<(u64, Message)>,
}

impl Sink<3> for Copying {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<3>) -> Result<(), LogError> {
        let time_ns = EPOCH_NS + sample.step * 10_000_000;
        let turn = sample.attitude.as_ref().and_then(quaternion);
        let messages = Channel::all().map(|channel| Message::of_sample(channel, sample, turn));
        self.sent.extend(messages.into_iter().flatten().map(|message| (time_ns, message)));
        self.log.record(sample)
    }
}

pub(super) fn place() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("job.mcap");
    (folder, path)
}

pub(super) fn header() -> LogHeader {
    let point = |position, sign| Marker { position, sign };
    LogHeader {
        dimension: 3,
        epoch_ns: EPOCH_NS,
        channels: Channel::all()
            .into_iter()
            .filter(|channel| !channel.needs_ensemble() && !channel.needs_several_bodies())
            .collect(),
        members: vec![0],
        bodies: Vec::new(),
        compression: Compression::Zstd,
        samples_per_chunk: 10,
        scenario_json: Some(b"{\"name\":\"dipole\"}".to_vec()),
        job: BTreeMap::from([("name".to_owned(), "dipole".to_owned())]),
        scene: SceneGeometry {
            moving: Vec::new(),
            box_size: [0.2, 0.2, 2.0],
            box_axes: [1.0, 0.0, 0.0, 0.0],
            body_points: vec![
                point([0.0, 0.1, -1.0], Sign::Positive),
                point([0.0, -0.1, -1.0], Sign::Negative),
            ],
            space_points: vec![point([0.0, 0.0, -1.5], Sign::Positive)],
            directions: vec![[0.0, 0.0, -1.0]],
        },
    }
}

pub(super) fn succeeded() -> Outcome {
    Outcome { state: "succeeded".to_owned(), entries: BTreeMap::new(), charts: Vec::new() }
}

pub(super) fn run_dipole<S: Sink<3, Error = LogError>>(sink: &mut S, steps: u64) {
    let (body, state) = crate::given::dipole();
    run(&body, state, sink, steps);
}

pub(super) fn run<const N: usize, S: Sink<N, Error = LogError>>(
    body: &RigidBody<N>,
    state: state::State<N>,
    sink: &mut S,
    steps: u64,
) {
    try_run(body, state, sink, steps).expect("the log takes every sample");
}

pub(super) fn try_run<const N: usize, S: Sink<N, Error = LogError>>(
    body: &RigidBody<N>,
    state: state::State<N>,
    sink: &mut S,
    steps: u64,
) -> Result<(), LogError> {
    let mut stepper = Vpd::new(Tableau::gauss(2).expect("tableau"), StopRule::default());
    let schedule = Schedule { step_s: 0.01, steps, every: 1 };
    let run = integrate(body, &mut stepper, &state, schedule, EVERYTHING, sink, |_| true)?;
    assert_eq!((run.reached.step, run.reached.samples), (steps, steps + 1));
    assert!(so::orthogonality_error(&run.reached.attitude.expect("carried")) < 1e-13);
    Ok(())
}

pub(super) fn write_dipole(steps: u64) -> (TempDir, PathBuf) {
    let (folder, path) = place();
    let mut log = LogWriter::create(&path, &header()).expect("create");
    run_dipole(&mut log, steps);
    log.message(Level::Info, steps as f64 * 0.01, "done").expect("message");
    log.finish(succeeded()).expect("finish");
    assert!(!part_path(&path).exists());
    (folder, path)
}

pub(super) fn sample(state: &state::State<3>, time_s: f64) -> Sample<3> {
    Sample {
        step: 0,
        time_s,
        attitude: Some(state.attitude),
        momentum: state.momentum,
        angular_velocity: None,
        energy: None,
        energy_error: None,
        orthogonality_error: None,
        spatial_momentum: None,
        jacobi_error: None,
        work: None,
        impulse: None,
        table_impulse_error: None,
        momentum_drift: None,
        convergence: None,
        sigma_min: None,
        pace: None,
        control: None,
        pointing: None,
        derivatives: None,
    }
}

pub(super) fn topics(path: &Path) -> Vec<String> {
    let found: Inspection = inspect(path).expect("read");
    assert!(found.finished, "{found}");
    found.topics.into_iter().map(|entry| entry.topic).collect()
}

/// Returns those of the topics that tests call by name.
pub(super) fn named(topics: impl IntoIterator<Item = String>) -> Vec<String> {
    topics.into_iter().filter(|topic| NAMED.contains(&topic.as_str())).collect()
}

pub(super) fn all_messages(path: &Path) -> Vec<(String, u64, Vec<u8>)> {
    let mut messages = Vec::new();
    let visit = |item: Item<'_>| {
        if let Item::Message { topic, time_ns, data, .. } = item {
            messages.push((topic.to_owned(), time_ns, data.to_vec()));
        }
        ControlFlow::Continue(())
    };
    reader::read(path, visit).expect("read");
    messages
}

/// Returns the ends of the top-level records of a whole file.
pub(super) fn record_ends(bytes: &[u8]) -> Vec<usize> {
    let mut ends = vec![mcap::MAGIC.len()];
    let mut at = mcap::MAGIC.len();
    loop {
        let opcode = bytes[at];
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes"));
        at += 9 + length as usize;
        ends.push(at);
        if opcode == op::FOOTER {
            return ends;
        }
    }
}

/// Returns the next number of Vigna's xorshift64* generator: the same numbers on every machine.
pub(crate) fn next(state: &mut u64) -> u64 {
    *state ^= *state >> 12;
    *state ^= *state << 25;
    *state ^= *state >> 27;
    state.wrapping_mul(0x2545_f491_4f6c_dd1d)
}
