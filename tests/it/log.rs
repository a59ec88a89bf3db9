//! The log through its public interface: what is written is read back.

mod damage;
mod fixture;
mod overview;
mod rewritten;
mod viewing;

use std::collections::BTreeSet;
use std::fs;
use std::ops::ControlFlow;

use foxglove::messages::FrameTransforms;
use mcap::records::Record;
use prost::Message as _;
use serde_json::{Value, json};
use vpd::advise;
use vpd::log::LogError;
use vpd::log::inspect::inspect;
use vpd::log::messages::State;
use vpd::log::reader::{self, Item, Message};
use vpd::log::schema::{Channel, Compression};
use vpd::log::writer::{Level, LogHeader, LogWriter};
use vpd::plan::Plan;
use vpd::run::{Control, JobContext};
use vpd::scenario::Scenario;
use vpd::solve::hamiltonian::{Kinetic, RigidBody};
use vpd::solve::so::{Mat, hat};
use vpd::solve::state;
use vpd::solve::trajectory::{Sample, Sink};

use fixture::*;
pub(super) use fixture::{NAMED, next};

#[test]
fn every_sample_is_read_back_to_the_bit() {
    for compression in [Compression::Zstd, Compression::Lz4, Compression::None] {
        let (folder, path) = place();
        let header = LogHeader { compression, ..header() };
        let mut sink =
            Copying { log: LogWriter::create(&path, &header).expect("create"), sent: vec![] };
        run_dipole(&mut sink, 100);
        sink.log.finish(succeeded()).expect("finish");

        let mut seen = Vec::new();
        let ending = reader::read_samples(&path, |time, message| seen.push((time, message)));
        assert!(ending.expect("read").finished);
        assert_eq!(seen, sink.sent);
        let found = inspect(&path).expect("read").topics;
        for topic in ["/state", "/energy", "/orthogonality", "/momentum", "/solver"] {
            let entry = found.iter().find(|entry| entry.topic == topic).expect(topic);
            // The start has no solver.
            assert_eq!(entry.messages, if topic == "/solver" { 100 } else { 101 }, "{topic}");
        }
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
fn quaternions_have_no_jumps_in_sign() {
    let (body, mut state) = crate::given::dipole();
    // Many turns about a slanted axis: w passes zero in each.
    state.momentum = hat(&[0.03, 0.02, 0.05]);
    let (_folder, path) = place();
    let mut log = LogWriter::create(&path, &header()).expect("create");
    run(&body, state, &mut log, 4000);
    log.finish(succeeded()).expect("finish");
    let (mut states, mut frames) = (Vec::new(), Vec::new());
    reader::read(&path, |item| {
        if let Item::Message { topic, data, .. } = item {
            match topic {
                "/state" => states.push(State::decode(data).expect("a state")),
                "/tf" => frames.push(FrameTransforms::decode(data).expect("a frame")),
                _ => {}
            }
        }
        ControlFlow::Continue(())
    })
    .expect("read");
    assert_eq!((states.len(), frames.len()), (4001, 4001));
    assert!(states[0].quaternion[0] >= 0.0);
    for pair in states.windows(2) {
        let along: f64 =
            pair[0].quaternion.iter().zip(&pair[1].quaternion).map(|(a, b)| a * b).sum();
        assert!(along > 0.9, "{} s: {along}", pair[1].time_s);
    }
    assert!(states.iter().any(|state| state.quaternion[0] < -0.1));
    for (state, frame) in states.iter().zip(&frames) {
        let turn = frame.transforms[0].rotation.expect("a turn");
        assert_eq!(state.quaternion, [turn.w, turn.x, turn.y, turn.z]);
        // The quaternion is still that of the attitude.
        let [w, x, y, z] = state.quaternion[..] else { panic!("four") };
        let first = [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)];
        for (entry, wanted) in first.iter().zip(&state.attitude) {
            assert!((entry - wanted).abs() < 1e-14);
        }
    }
}

#[test]
fn the_same_job_gives_the_same_bytes() {
    for compression in [Compression::Zstd, Compression::Lz4, Compression::None] {
        let write = || {
            let (_folder, path) = place();
            let header = LogHeader { compression, ..header() };
            let mut log = LogWriter::create(&path, &header).expect("create");
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
        // The line at the end goes into the chunk of the last sample, even if that one is full.
        assert_eq!(chunks.len() as u64, steps / 10 + 1);
        for chunk in &chunks {
            assert!(chunk.message_start_time >= EPOCH_NS, "no chunk starts in 1970");
            assert!(chunk.message_end_time >= chunk.message_start_time);
            assert!(!chunk.message_index_offsets.is_empty(), "no chunk is empty");
        }
        let stats = summary.stats.expect("statistics");
        let count = |topic: &str| {
            let id =
                summary.channels.values().find(|channel| channel.topic == topic).expect(topic).id;
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
    let indexes = order.iter().filter(|name| *name == "0x07").count();
    let messages = all_messages(&path);
    let chunk = |is_first: bool| -> BTreeSet<String> {
        let of = |time_ns| (time_ns < EPOCH_NS + 10 * 10_000_000) == is_first;
        messages.iter().filter(|message| of(message.1)).map(|message| message.0.clone()).collect()
    };
    let (first, second) = (chunk(true), chunk(false));
    assert_eq!(indexes, first.len() + second.len(), "one for each channel of a chunk");
    assert_eq!((named(first).len(), named(second).len()), (9, 7), "the scene is drawn once");
    assert_eq!(order.last().map(String::as_str), Some("vpd.outcome"));
}

#[test]
fn schemas_are_complete_and_one_per_type() {
    let (_folder, path) = write_dipole(1);
    let bytes = fs::read(&path).expect("read");
    let summary = mcap::Summary::read(&bytes).expect("whole").expect("has a summary");
    let asked = header().channels;
    let types: BTreeSet<_> = asked.iter().map(|channel| channel.schema_name()).collect();
    assert_eq!(summary.schemas.len(), types.len());
    assert_eq!(types.len(), asked.len() - 1, "two scene topics share one");
    assert_eq!(summary.channels.len(), asked.len());
    let topics = summary.channels.values().map(|channel| channel.topic.clone());
    assert_eq!(named(topics).len(), NAMED.len());
    for channel in summary.channels.values() {
        let known = Channel::from_topic(&channel.topic).expect("our topic");
        let schema = channel.schema.as_ref().expect("has a schema");
        assert_eq!(schema.name, known.schema_name());
        assert_eq!(
            (schema.encoding.as_str(), channel.message_encoding.as_str()),
            ("protobuf", "protobuf")
        );
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
    let mut log = LogWriter::create(&path, &LogHeader { channels, ..header() }).expect("create");
    run_dipole(&mut log, 12);
    log.message(Level::Warning, 0.12, "nobody reads this").expect("message");
    log.finish(succeeded()).expect("finish");
    assert_eq!(topics(&path), ["/state", "/solver"]);

    let (_folder, path) = place();
    let header = LogHeader { channels: vec![], ..header() };
    let log = LogWriter::create(&path, &header).expect("create");
    log.finish(succeeded()).expect("finish");
    let found = inspect(&path).expect("read");
    assert!(found.finished, "{found}");
    assert_eq!((found.samples, found.chunks), (0, 0));
}

#[test]
fn other_dimensions_have_no_frames() {
    let (_folder, path) = place();
    let mut log =
        LogWriter::create(&path, &LogHeader { dimension: 4, ..header() }).expect("create");
    let body = RigidBody::new(Kinetic::Principal { weights: Mat::<4>::repeat(0.5) }, vec![], 0.0);
    let momentum = hat::<4>(&[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]);
    let state = state::State { attitude: Mat::<4>::identity(), momentum };
    run(&body, state, &mut log, 20);
    log.finish(succeeded()).expect("finish");
    let found = topics(&path);
    let frames = |topic: &String| Channel::from_topic(topic).is_none_or(Channel::needs_three);
    assert!(!found.iter().any(frames), "{found:?}");
    assert_eq!(
        named(found),
        ["/log", "/state", "/energy", "/orthogonality", "/momentum", "/solver"]
    );
    let visit = |_, message| match message {
        Message::State(state) => {
            assert_eq!(state.attitude.len(), 16);
            assert_eq!(state.body_momentum.len(), 6);
            assert!(state.quaternion.is_empty());
        }
        Message::Momentum(momentum) => {
            assert!(momentum.drift.is_some(), "a free body keeps it all")
        }
        _ => {}
    };
    assert!(reader::read_samples(&path, visit).expect("read").finished);
}

#[test]
fn an_inspection_sums_up() {
    let (_folder, path) = place();
    let mut sink =
        Copying { log: LogWriter::create(&path, &header()).expect("create"), sent: vec![] };
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

#[cfg(target_os = "linux")]
#[test]
fn a_log_refuses_what_it_cannot_hold() {
    let (_folder, path) = place();
    let mut log = LogWriter::create(&path, &header()).expect("create");
    let (_, state) = crate::given::dipole();
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
fn what_a_sample_says_on_a_channel_of_ours_can_be_read() {
    let ours = |channel: &Channel| {
        channel.bytes_per_sample(3) > 0 && channel.schema_name().starts_with("vpd.")
    };
    for channel in Channel::all().into_iter().filter(ours) {
        let message = Message::decode(channel.topic(), channel.schema_name(), &[]);
        assert!(message.is_some(), "{} is not in the list of log/messages.rs", channel.topic());
    }
}

#[test]
fn the_estimate_of_the_size_is_close() {
    let (_folder, path) = place();
    let header = LogHeader { compression: Compression::None, samples_per_chunk: 100, ..header() };
    let mut log = LogWriter::create(&path, &header).expect("create");
    let steps = 2000;
    run_dipole(&mut log, steps);
    log.finish(succeeded()).expect("finish");
    let of_others = |channel: &Channel| {
        channel.needs_control()
            || channel.needs_several_bodies()
            || channel.needs_pointing()
            || channel.needs_derivatives()
    };
    let logged = Channel::all().into_iter().filter(|channel| !of_others(channel));
    let estimate: u64 = logged.map(|channel| channel.bytes_per_sample(3)).sum();
    let real = fs::metadata(&path).expect("file").len() as f64 / steps as f64;
    assert!(
        (real / estimate as f64 - 1.0).abs() < 0.1,
        "{real} bytes per sample, {estimate} estimated"
    );
}

/// Limits of a plan: half a mebibyte a chunk, or the samples of three seconds, a fifth of what is
/// promised.
#[test]
fn chunks_are_as_large_as_the_plan_says() {
    let shipped: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    let plan = |n: u64, every: u64, channels: Option<&[&str]>| {
        let mut scenario = shipped.clone();
        if n != 3 {
            scenario = serde_json::from_str(include_str!("../../scenarios/so4-free.json"))
                .expect("shipped");
            scenario.as_object_mut().expect("an object").remove("duration_s");
        }
        scenario["steps"] = json!(1_000_000_000);
        scenario["log"] = json!({ "every": every });
        if let Some(channels) = channels {
            scenario["log"]["channels"] = json!(channels);
        }
        let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
        Plan::new(&scenario).expect("a plan")
    };
    let (mut usual, mut slow) = (0, 0);
    for n in [3, 4] {
        for every in [1, 10, 100, 1000, 10_000, 100_000, 1_000_000, 10_000_000] {
            for channels in [None, Some(&["/energy"][..])] {
                let plan = plan(n, every, channels);
                let topics =
                    plan.channels.iter().map(|plan| plan.topic.bytes_per_sample(n as usize));
                // Entries of the index stand behind the chunk.
                let sample_bytes: u64 = topics.map(|bytes| bytes.saturating_sub(16)).sum();
                let bytes = plan.samples_per_chunk * sample_bytes;
                let time_s = plan.samples_per_chunk as f64 * every as f64 * plan.step_ns * 1e-9;
                assert!(bytes <= 512 << 10, "{n} {every}: {bytes}");
                assert!(time_s <= 3.0 || plan.samples_per_chunk == 1, "{n} {every}: {time_s} s");
                // Samples take their time as well: a few microseconds each.
                let next = (time_s + 1.0) * (1.0 + 1.0 / plan.samples_per_chunk as f64);
                assert!(bytes >= 256 << 10 || next > 3.0, "{n} {every}: {bytes} in {time_s} s");
                *if bytes >= 256 << 10 { &mut usual } else { &mut slow } += 1;
            }
        }
    }
    println!("{usual} plans with usual chunks, {slow} with those of 3 s");
    assert!(usual > 0 && slow > 0);
}

#[test]
fn chunks_of_a_file_have_between_64_kib_and_a_mebibyte() {
    let (_folder, path) = place();
    let mut scenario: Value =
        serde_json::from_str(include_str!("../../scenarios/dipole.json")).expect("shipped");
    scenario["steps"] = json!(8000);
    scenario["log"] = json!({ "every": 1 });
    let scenario = Scenario::from_json(scenario.to_string().as_bytes()).expect("good");
    let context = JobContext { log: &path, control: &Control::default() };
    vpd::run::execute(&advise::plan(&scenario).expect("a plan"), &context).expect("a log");
    let bytes = fs::read(&path).expect("a log");
    let summary = mcap::Summary::read(&bytes).expect("an index").expect("a summary");
    let sizes: Vec<u64> =
        summary.chunk_indexes.iter().map(|chunk| chunk.uncompressed_size).collect();
    println!("{sizes:?}");
    let (_, whole) = sizes.split_last().expect("chunks");
    assert!(!whole.is_empty());
    assert!(whole.iter().all(|size| (64 << 10..=1 << 20).contains(size)), "{sizes:?}");
}
