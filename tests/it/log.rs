//! The log, through its doors: what is written is what is read, and nothing unfinished passes for whole.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use mcap::records::{Record, op};
use nalgebra::{Matrix3, Vector3};
use tempfile::TempDir;
use vpd::log::inspect::{Inspection, inspect};
use vpd::log::messages::{self, Energy, Momentum, Orthogonality, Solver, State, quaternion};
use vpd::log::reader::{self, Item, Message};
use vpd::log::scene::{Marker, SceneGeometry, Sign};
use vpd::log::schema::Channel;
use vpd::log::writer::{Level, LogCompression, LogHeader, LogWriter, Outcome};
use vpd::log::{LogError, part_path};
use vpd::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd::solve::nonlinear::StopRule;
use vpd::solve::so::{self, Mat, hat};
use vpd::solve::stepper::vpd::Vpd;
use vpd::solve::tableau::Tableau;
use vpd::solve::trajectory::{self, Observables, Sample, Schedule, Sink, integrate};

const EPOCH_NS: u64 = 1_767_225_600_000_000_000;
const EVERYTHING: Observables =
    Observables { energy: true, orthogonality: true, momentum: true, sigma_min: true };

#[test]
fn every_sample_is_read_back_to_the_bit() {
    for compression in [LogCompression::Zstd, LogCompression::Lz4, LogCompression::None] {
        let (folder, path) = place();
        let header = LogHeader { compression, ..header() };
        let mut sink = Copying { log: LogWriter::create(&path, header).expect("create"), sent: vec![] };
        run_dipole(&mut sink, 100);
        sink.log.finish(succeeded()).expect("finish");

        let mut seen = Vec::new();
        let ending = reader::read_samples(&path, |time, message| seen.push((time, message)));
        assert!(ending.expect("read").finished);
        // 101 samples on five topics; the start has no solver.
        assert_eq!(seen.len(), 504);
        assert_eq!(seen, sink.sent);
        drop(folder);
    }
}

#[test]
fn a_state_message_is_the_state() {
    let (_folder, path) = write_dipole(3);
    let mut states = Vec::new();
    let visit = |_, message| {
        if let Message::State(state) = message {
            states.push(state);
        }
    };
    reader::read_samples(&path, visit).expect("read");
    assert_eq!(states[0].attitude, [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0], "row by row");
    assert_eq!(states[0].body_momentum, [0.0, 0.0, -0.01]);
    let half = std::f64::consts::FRAC_1_SQRT_2;
    for (got, wanted) in states[0].quaternion.iter().zip([half, half, 0.0, 0.0]) {
        assert!((got - wanted).abs() < 1e-15, "{:?}", states[0].quaternion);
    }
    assert_eq!(states[3].time_s, 3.0 * 0.01);
}

#[test]
fn the_same_job_gives_the_same_bytes() {
    for compression in [LogCompression::Zstd, LogCompression::Lz4, LogCompression::None] {
        let write = || {
            let (_folder, path) = place();
            let header = LogHeader { compression, ..header() };
            let mut log = LogWriter::create(&path, header).expect("create");
            run_dipole(&mut log, 60);
            log.finish(succeeded()).expect("finish");
            fs::read(path).expect("read")
        };
        assert!(write() == write(), "{compression:?}");
    }
}

#[test]
fn the_index_is_right_and_no_chunk_is_empty() {
    // 9: samples end with a chunk; 1: nothing but the start; 7, 25: they do not.
    for steps in [0, 7, 9, 19, 25] {
        let (_folder, path) = write_dipole(steps);
        let bytes = fs::read(&path).expect("read");
        let summary = mcap::Summary::read(&bytes).expect("whole").expect("has a summary");
        let samples = steps + 1;
        let chunks = summary.chunk_indexes;
        // The diagnosis comes after the last sample: in a chunk of its own if that one was full.
        assert_eq!(chunks.len() as u64, samples / 10 + 1);
        for chunk in &chunks {
            assert!(chunk.message_start_time >= EPOCH_NS, "no chunk starts in 1970");
            assert!(chunk.message_end_time >= chunk.message_start_time);
            assert!(!chunk.message_index_offsets.is_empty(), "no chunk is empty");
        }
        let stats = summary.stats.expect("statistics");
        let count = |topic: &str| {
            let id = summary.channels.values().find(|channel| channel.topic == topic).expect(topic).id;
            stats.channel_message_counts.get(&id).copied().unwrap_or(0)
        };
        for topic in ["/state", "/energy", "/orthogonality", "/momentum", "/tf"] {
            assert_eq!(count(topic), samples, "{topic}");
        }
        assert_eq!(count("/solver"), steps);
        assert_eq!(count("/scene/body"), 1);
        assert_eq!(count("/scene/sources"), 1);
        assert_eq!(count("/log"), 2);
        assert_eq!(stats.message_start_time, EPOCH_NS);
        assert_eq!(stats.message_end_time, EPOCH_NS + steps * 10_000_000);
        assert_eq!(stats.attachment_count, 1);
        assert_eq!(stats.metadata_count, 2);
        assert_eq!(stats.chunk_count as usize, chunks.len());
    }
}

#[test]
fn times_are_those_of_the_simulation_and_never_fall() {
    let (_folder, path) = write_dipole(25);
    let bytes = fs::read(&path).expect("read");
    let mut last = 0;
    for message in mcap::MessageStream::new(&bytes).expect("whole") {
        let message = message.expect("whole");
        assert_eq!(message.log_time, message.publish_time);
        assert!(message.log_time >= last);
        last = message.log_time;
    }
    assert_eq!(last, EPOCH_NS + 250_000_000);
}

#[test]
fn the_job_comes_first_and_the_outcome_last() {
    let (_folder, path) = write_dipole(15);
    let bytes = fs::read(&path).expect("read");
    let mut order = Vec::new();
    for record in mcap::read::LinearReader::new(&bytes).expect("whole") {
        match record.expect("whole") {
            Record::DataEnd(_) => break,
            Record::Header(header) => {
                assert_eq!(header.profile, "");
                assert_eq!(header.library, concat!("vpd/", env!("CARGO_PKG_VERSION")));
                order.push("header".to_owned());
            }
            Record::Metadata(metadata) => order.push(metadata.name),
            Record::Attachment { header, data, .. } => {
                assert_eq!(data.as_ref(), b"{\"name\":\"dipole\"}");
                assert_eq!((header.log_time, header.create_time), (EPOCH_NS, EPOCH_NS));
                order.push(header.name);
            }
            record => order.push(format!("{:#04x}", record.opcode())),
        }
    }
    assert_eq!(order[..4], ["header", "vpd.job", "scenario.json", "0x06"]);
    let indexes: Vec<_> = order.iter().filter(|name| *name == "0x07").collect();
    assert_eq!(indexes.len(), 9 + 7, "the first chunk has nine channels, the second seven");
    assert_eq!(order.last().map(String::as_str), Some("vpd.outcome"));
}

#[test]
fn schemas_are_complete_and_one_per_type() {
    let (_folder, path) = write_dipole(1);
    let bytes = fs::read(&path).expect("read");
    let summary = mcap::Summary::read(&bytes).expect("whole").expect("has a summary");
    assert_eq!(summary.schemas.len(), 8, "two scene topics share one");
    assert_eq!(summary.channels.len(), 9);
    for channel in summary.channels.values() {
        let known = Channel::from_topic(&channel.topic).expect("our topic");
        let schema = channel.schema.as_ref().expect("has a schema");
        assert_eq!(schema.name, known.schema_name());
        assert_eq!((schema.encoding.as_str(), channel.message_encoding.as_str()), ("protobuf", "protobuf"));
        let set: prost_types::FileDescriptorSet =
            prost::Message::decode(schema.data.as_ref()).expect("a descriptor set");
        let names: Vec<_> = set.file.iter().map(|file| file.name()).collect();
        for import in set.file.iter().flat_map(|file| &file.dependency) {
            assert!(names.contains(&import.as_str()), "{import} is missing in {}", schema.name);
        }
        let (package, message) = schema.name.split_once('.').expect("full name");
        let holds = |file: &prost_types::FileDescriptorProto| {
            file.package() == package && file.message_type.iter().any(|m| m.name() == message)
        };
        assert!(set.file.iter().any(holds), "{} is not in its own set", schema.name);
    }
}

#[test]
fn only_what_was_asked_for_is_written() {
    let (_folder, path) = place();
    let channels = vec![Channel::State, Channel::Solver];
    let mut log = LogWriter::<3>::create(&path, LogHeader { channels, ..header() }).expect("create");
    run_dipole(&mut log, 12);
    log.message(Level::Warning, 0.12, "nobody reads this").expect("message");
    log.finish(succeeded()).expect("finish");
    assert_eq!(topics(&path), ["/state", "/solver"]);

    let (_folder, path) = place();
    let header = LogHeader { channels: vec![], ..header() };
    let log = LogWriter::<3>::create(&path, header).expect("create");
    log.finish(succeeded()).expect("finish");
    let found = inspect(&path).expect("read");
    assert!(found.finished, "{found}");
    assert_eq!((found.samples, found.chunks), (0, 0));
}

#[test]
fn other_dimensions_have_no_frames() {
    let (_folder, path) = place();
    let mut log = LogWriter::<4>::create(&path, header()).expect("create");
    let body = RigidBody::new(Kinetic::Principal { weights: Mat::<4>::repeat(0.5) }, vec![], 0.0);
    let momentum = hat::<4>(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
    let state = trajectory::State { attitude: Mat::<4>::identity(), momentum };
    run(&body, state, &mut log, 20);
    log.finish(succeeded()).expect("finish");
    assert_eq!(topics(&path), ["/log", "/state", "/energy", "/orthogonality", "/momentum", "/solver"]);
    let visit = |_, message| match message {
        Message::State(state) => {
            assert_eq!(state.attitude.len(), 16);
            assert_eq!(state.body_momentum.len(), 6);
            assert!(state.quaternion.is_empty());
        }
        Message::Momentum(momentum) => assert!(momentum.drift.is_some(), "a free body keeps it all"),
        _ => {}
    };
    assert!(reader::read_samples(&path, visit).expect("read").finished);
}

#[test]
fn an_inspection_sums_up() {
    let (_folder, path) = place();
    let mut sink = Copying { log: LogWriter::create(&path, header()).expect("create"), sent: vec![] };
    run_dipole(&mut sink, 50);
    sink.log.finish(succeeded()).expect("finish");
    let found = inspect(&path).expect("read");
    assert!(found.finished, "{found}");
    assert_eq!(found.damage, None);
    assert_eq!((found.samples, found.chunks), (51, 6));
    assert_eq!(found.span.expect("span").duration_s, 0.5);
    assert_eq!(found.outcome.as_ref().expect("outcome")["state"], "succeeded");
    assert_eq!(found.outcome.as_ref().expect("outcome")["samples"], "51");
    assert_eq!(found.job.as_ref().expect("job")["name"], "dipole");
    let worst = sink.sent.iter().filter_map(|(_, message)| match message {
        Message::Energy(energy) => Some(energy.error.abs()),
        _ => None,
    });
    assert_eq!(found.extremes.energy_max_abs_error, worst.reduce(f64::max));
    assert!(found.extremes.solver_iterations_mean.expect("mean") > 1.0);
    assert!(found.to_string().starts_with("finished: succeeded\n51 samples over 0.5 s"), "{found}");
    let json = serde_json::to_value(&found).expect("serialises");
    assert_eq!(json["topics"][0]["topic"], "/scene/body");
}

#[test]
fn a_dropped_writer_leaves_nothing() {
    let (folder, path) = place();
    let mut log = LogWriter::<3>::create(&path, header()).expect("create");
    run_dipole(&mut log, 25);
    assert!(part_path(&path).exists());
    assert!(!path.exists());
    drop(log);
    assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 0);
}

#[test]
fn a_running_log_reads_up_to_its_last_chunk() {
    let (_folder, path) = place();
    let mut log = LogWriter::<3>::create(&path, header()).expect("create");
    run_dipole(&mut log, 25);
    let found = inspect(&part_path(&path)).expect("read");
    assert!(!found.finished);
    assert_eq!((found.samples, found.chunks), (20, 2), "the third chunk of ten is open");
    assert!(found.job.is_some());
    assert!(found.outcome.is_none());
    log.finish(succeeded()).expect("finish");
}

#[test]
fn a_whole_file_without_outcome_is_not_finished() {
    // What the MCAP layer leaves when it is dropped in a panic.
    let (_folder, path) = place();
    mcap::Writer::new(fs::File::create(&path).expect("create")).expect("start").finish().expect("finish");
    let found = inspect(&path).expect("read");
    assert!(!found.finished);
    assert_eq!(found.damage.as_deref(), Some("the log does not say how the job ended"));
}

#[test]
fn a_cut_file_is_read_to_the_cut_and_reported() {
    let (_folder, path) = write_dipole(35);
    let bytes = fs::read(&path).expect("read");
    let whole = all_messages(&path);
    let stride = bytes.len() / 300 + 1;
    let mut cuts: Vec<_> = (0..bytes.len()).step_by(stride).collect();
    cuts.extend(record_ends(&bytes));
    cuts.extend(bytes.len() - 60..bytes.len());
    let cut = path.with_extension("cut");
    let mut most = 0;
    for at in cuts.into_iter().filter(|&at| at < bytes.len()) {
        fs::write(&cut, &bytes[..at]).expect("write");
        let found = inspect(&cut).expect("read");
        assert!(!found.finished, "cut at {at}");
        assert!(found.damage.is_some(), "cut at {at}");
        let messages = all_messages(&cut);
        assert!(whole.starts_with(&messages), "cut at {at}");
        most = most.max(messages.len());
    }
    assert_eq!(most, whole.len(), "a cut in the index costs no sample");
}

#[test]
fn a_flipped_bit_is_always_reported() {
    for compression in [LogCompression::Zstd, LogCompression::Lz4, LogCompression::None] {
        let (_folder, path) = place();
        let header = LogHeader { compression, ..header() };
        let mut log = LogWriter::<3>::create(&path, header).expect("create");
        run_dipole(&mut log, 25);
        log.finish(succeeded()).expect("finish");
        let bytes = fs::read(&path).expect("read");
        let whole = all_messages(&path);
        let flipped = path.with_extension("flipped");
        let seed = 0x5eed_0001_u64 + compression as u64;
        println!("{compression:?}: seed {seed:#x}");
        let mut random = seed;
        let ends = record_ends(&bytes);
        for k in 0..400 {
            let draw = next(&mut random);
            // Every other flip in the opcode or length of a record, where it hurts most.
            let byte = if k % 2 == 0 {
                (ends[draw as usize % ends.len()] + (draw >> 32) as usize % 9).min(bytes.len() - 1)
            } else {
                draw as usize % bytes.len()
            };
            let bit = next(&mut random) % 8;
            let mut damaged = bytes.clone();
            damaged[byte] ^= 1 << bit;
            fs::write(&flipped, damaged).expect("write");
            let found = inspect(&flipped).expect("read");
            assert!(!found.finished && found.damage.is_some(), "byte {byte} bit {bit}: {found}");
            let messages = all_messages(&flipped);
            assert!(messages.iter().all(|message| whole.contains(message)), "byte {byte} bit {bit}");
        }
    }
}

#[test]
fn storage_errors_are_told_and_nothing_stays() {
    let (folder, _) = place();
    let missing = folder.path().join("missing").join("a.mcap");
    let error = LogWriter::<3>::create(&missing, header()).err().expect("no such folder");
    assert_eq!(error.code(), "storage_error");
    assert!(error.to_string().contains("cannot create"), "{error}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_fails_the_log() {
    let (folder, path) = place();
    std::os::unix::fs::symlink("/dev/full", part_path(&path)).expect("symlink");
    let mut log = match LogWriter::<3>::create(&path, header()) {
        Ok(log) => log,
        Err(error) => {
            assert_eq!(error.code(), "storage_full");
            return;
        }
    };
    let (body, state) = dipole();
    let error = try_run(&body, state, &mut log, 1000).expect_err("no space");
    assert_eq!(error.code(), "storage_full", "{error}");
    assert_eq!(log.message(Level::Error, 10.0, "full").expect_err("given up").code(), "log_given_up");
    assert_eq!(log.finish(succeeded()).expect_err("given up").code(), "log_given_up");
    assert!(!path.exists());
    assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 0);
}

#[test]
fn a_log_refuses_what_it_cannot_hold() {
    let (_folder, path) = place();
    let mut log = LogWriter::<3>::create(&path, header()).expect("create");
    let (_, state) = dipole();
    let at = |time_s| sample(&state, time_s);
    log.record(&at(1.0)).expect("record");
    for time_s in [0.5, -1.0, f64::NAN, f64::INFINITY, 1e10] {
        assert_eq!(log.record(&at(time_s)).expect_err("bad time").code(), "log_time", "{time_s}");
    }
    let sick = Sample { orthogonality_error: Some(f64::NAN), ..at(2.0) };
    assert!(matches!(log.record(&sick), Err(LogError::NotFinite { step: 0 })));
    // A refusal spoils nothing, and a late message does not turn time back.
    log.record(&at(2.0)).expect("record");
    log.message(Level::Error, 1.5, "diagnosis").expect("message");
    log.finish(succeeded()).expect("finish");
    let found = inspect(&path).expect("read");
    assert!(found.finished);
    assert_eq!(found.samples, 2);
    assert_eq!(found.span.expect("span").duration_s, 2.0);
}

#[test]
fn logarithms_stay_finite() {
    assert_eq!(messages::log10_size(0.0), -20.0);
    assert_eq!(messages::log10_size(5e-324), -20.0);
    assert_eq!(messages::log10_size(-1e-12), -12.0);
    assert_eq!(messages::log10_size(1.0), 0.0);
}

#[test]
fn a_quaternion_turns_like_its_matrix() {
    let mut random = 0x5eed_0002_u64;
    let mut draw = || next(&mut random) as f64 / u64::MAX as f64 * 2.0 - 1.0;
    let half_turns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        .map(|axis| Vector3::from(axis) * std::f64::consts::PI);
    let random_turns: Vec<_> = (0..1000).map(|_| Vector3::new(draw(), draw(), draw()) * 3.0).collect();
    for turn in half_turns.into_iter().chain([Vector3::zeros()]).chain(random_turns) {
        let g: Mat<3> = *nalgebra::Rotation3::new(turn).matrix();
        let [w, x, y, z] = quaternion(&g).expect("n = 3");
        assert!(w >= 0.0);
        let back = Matrix3::new(
            w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z,
        );
        assert!((back - g).amax() < 2e-15, "{turn}");
    }
    assert_eq!(quaternion(&Mat::<4>::identity()), None);
    // What a baseline without projection may arrive at.
    for g in [Mat::<3>::repeat(1e200), Mat::<3>::zeros(), -Mat::<3>::identity()] {
        let q = quaternion(&g).expect("n = 3");
        assert!((q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-15, "{q:?}");
    }
}

#[test]
fn the_estimate_of_the_size_is_close() {
    let (_folder, path) = place();
    let header = LogHeader { compression: LogCompression::None, samples_per_chunk: 100, ..header() };
    let mut log = LogWriter::<3>::create(&path, header).expect("create");
    let steps = 2000;
    run_dipole(&mut log, steps);
    log.finish(succeeded()).expect("finish");
    let estimate: u64 = Channel::all().iter().map(|channel| channel.bytes_per_sample(3)).sum();
    let real = fs::metadata(&path).expect("file").len() as f64 / steps as f64;
    println!("{real} bytes per sample, {estimate} estimated");
    assert!((real / estimate as f64 - 1.0).abs() < 0.1, "{real} {estimate}");
}

/// A sink that keeps what the log should hold.
struct Copying {
    log: LogWriter<3>,
    sent: Vec<(u64, Message)>,
}

impl Sink<3> for Copying {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<'_, 3>) -> Result<(), LogError> {
        let time_ns = EPOCH_NS + sample.step * 10_000_000;
        self.sent.push((time_ns, Message::State(State::of(sample))));
        let others = [
            Energy::of(sample).map(Message::Energy),
            Orthogonality::of(sample).map(Message::Orthogonality),
            Momentum::of(sample).map(Message::Momentum),
            Solver::of(sample).map(Message::Solver),
        ];
        self.sent.extend(others.into_iter().flatten().map(|message| (time_ns, message)));
        self.log.record(sample)
    }
}

fn place() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("job.mcap");
    (folder, path)
}

fn header() -> LogHeader {
    let point = |position, sign| Marker { position, sign };
    LogHeader {
        epoch_ns: EPOCH_NS,
        channels: Channel::all().to_vec(),
        compression: LogCompression::Zstd,
        samples_per_chunk: 10,
        scenario_json: b"{\"name\":\"dipole\"}".to_vec(),
        job: BTreeMap::from([("name".to_owned(), "dipole".to_owned())]),
        scene: SceneGeometry {
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

fn succeeded() -> Outcome {
    Outcome { state: "succeeded".to_owned(), entries: BTreeMap::new() }
}

/// The dipole on a stick of Shen, Tran, Leok, section 5.
fn dipole() -> (RigidBody<3>, trajectory::State<3>) {
    let e3 = Vector3::z();
    let source = Vector3::new(0.0, 0.0, -1.5);
    let charge = |strength, y| Term {
        law: Law::PointSource { strength, body_point: Vector3::new(0.0, y, -1.0) },
        space: source,
    };
    let moments = [1.01, 1.0, 0.01];
    // mu_ij = J_k Omega_ij with k the third index.
    let weights = Mat::<3>::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] });
    let terms = vec![
        Term { law: Law::Uniform { weight: 1.0, body_point: e3 }, space: e3 },
        charge(1.0, 0.1),
        charge(-1.0, -0.1),
    ];
    let attitude = Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let state = trajectory::State { attitude, momentum: hat(&[0.0, 0.0, -0.01]) };
    (RigidBody::new(Kinetic::Principal { weights }, terms, 0.0), state)
}

fn run_dipole<S: Sink<3, Error = LogError>>(sink: &mut S, steps: u64) {
    let (body, state) = dipole();
    run(&body, state, sink, steps);
}

fn run<const N: usize, S: Sink<N, Error = LogError>>(
    body: &RigidBody<N>,
    state: trajectory::State<N>,
    sink: &mut S,
    steps: u64,
) {
    try_run(body, state, sink, steps).expect("the log takes every sample");
}

fn try_run<const N: usize, S: Sink<N, Error = LogError>>(
    body: &RigidBody<N>,
    state: trajectory::State<N>,
    sink: &mut S,
    steps: u64,
) -> Result<(), LogError> {
    let mut stepper = Vpd::new(Tableau::gauss(2).expect("tableau"), StopRule::default());
    let schedule = Schedule { step_s: 0.01, steps, every: 1 };
    let run = integrate(body, &mut stepper, state, schedule, EVERYTHING, sink, |_| true)?;
    assert_eq!((run.steps, run.samples), (steps, steps + 1));
    assert!(so::orthogonality_error(&run.state.attitude) < 1e-13);
    Ok(())
}

fn write_dipole(steps: u64) -> (TempDir, PathBuf) {
    let (folder, path) = place();
    let mut log = LogWriter::create(&path, header()).expect("create");
    run_dipole(&mut log, steps);
    log.message(Level::Info, steps as f64 * 0.01, "done").expect("message");
    log.finish(succeeded()).expect("finish");
    assert!(!part_path(&path).exists());
    (folder, path)
}

fn sample(state: &trajectory::State<3>, time_s: f64) -> Sample<'_, 3> {
    Sample {
        step: 0,
        time_s,
        state,
        energy: None,
        energy_error: None,
        orthogonality_error: None,
        spatial_momentum: None,
        momentum_drift: None,
        convergence: None,
        sigma_min: None,
    }
}

fn topics(path: &Path) -> Vec<String> {
    let found: Inspection = inspect(path).expect("read");
    assert!(found.finished, "{found}");
    found.topics.into_iter().map(|entry| entry.topic).collect()
}

fn all_messages(path: &Path) -> Vec<(String, u64, Vec<u8>)> {
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

/// Where the top-level records of a whole file end.
fn record_ends(bytes: &[u8]) -> Vec<usize> {
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

/// Vigna's xorshift64* generator: the same numbers on every machine.
fn next(state: &mut u64) -> u64 {
    *state ^= *state >> 12;
    *state ^= *state << 25;
    *state ^= *state >> 27;
    state.wrapping_mul(0x2545_f491_4f6c_dd1d)
}
