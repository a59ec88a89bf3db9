//! Logs of several bodies, written from samples made here: what every reader finds in them.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::Path;

use foxglove::messages::{FrameTransforms, SceneUpdate};
use prost::Message as _;
use vpd::diff::{Quantity, diff};
use vpd::export::{Choice, Format, export};
use vpd::log::columns::{Columns, Values};
use vpd::log::inspect::inspect;
use vpd::log::messages::{self, Figures};
use vpd::log::reader::{self, Item};
use vpd::log::rows::{Row, read_rows};
use vpd::log::scene::{BodyHeader, Marker, SceneGeometry, Sign};
use vpd::log::schema::{BodyName, Channel, Compression};
use vpd::log::writer::{LogHeader, LogWriter, Outcome};
use vpd::solve::nonlinear::{Convergence, Rung};
use vpd::solve::so::{self, Mat, Vector};
use vpd::solve::system::Energy;
use vpd_solve::bodies::trajectory::{BodySample, Checkpoint, OwnTime, Sample};

const NAMES: [&str; 2] = ["mast", "primary-2"];
const EPOCH_NS: u64 = 1_767_225_600_000_000_000;

fn names() -> Vec<BodyName> {
    NAMES.iter().filter_map(|name| BodyName::of(name)).collect()
}

fn header(dimension: usize) -> LogHeader {
    let body = |name| BodyHeader {
        name,
        box_size: [2.0, 2.0, 4.0],
        box_axes: [1.0, 0.0, 0.0, 0.0],
        points: vec![Marker { position: [0.0, 0.0, 3.0], sign: Sign::Neutral }],
    };
    LogHeader {
        dimension,
        epoch_ns: EPOCH_NS,
        channels: Channel::all().to_vec(),
        members: vec![0],
        bodies: names().into_iter().map(body).collect(),
        compression: Compression::Zstd,
        samples_per_chunk: 5,
        scenario_json: None,
        job: BTreeMap::from([("name".to_owned(), "two".to_owned())]),
        scene: SceneGeometry::default(),
    }
}

/// Returns a skew matrix with entries of one size.
fn skew<const N: usize>(size: f64) -> Mat<N> {
    let entry = |i: usize, j: usize| size * (1.0 + i as f64 + 0.1 * j as f64);
    Mat::from_fn(|i, j| if i < j { entry(i, j) } else { -entry(j, i) * f64::from(u8::from(i > j)) })
}

/// Returns sample number k of two bodies: the first turns quickly about the third axis, the second stands a distance away.
fn sample<const N: usize>(k: u64, away_m: f64) -> Sample<N> {
    let time_s = k as f64 * 0.125;
    let turn = |angle: f64| {
        let (s, c) = (angle.sin(), angle.cos());
        let mut g = Mat::<N>::identity();
        (g[(0, 0)], g[(0, 1)], g[(1, 0)], g[(1, 1)]) = (c, -s, s, c);
        g
    };
    let vector = |size: f64| Vector::<N>::from_fn(|i, _| size * (1.0 + i as f64));
    let body = |angle: f64, size: f64| BodySample {
        attitude: turn(angle),
        momentum: skew(size * time_s),
        angular_velocity: skew(-size),
        position: vector(size + time_s),
        velocity: vector(0.5 * size),
        linear_momentum: vector(3.0 * size),
    };
    let convergence = Convergence { iterations: 5, increment: 1e-16, rung: Rung::FixedPoint };
    Sample {
        step: k,
        time_s,
        // Beyond a full turn, where the quaternion with w >= 0 would jump.
        bodies: vec![body(k as f64 * 0.2 * PI, 1.0), body(0.0, away_m)],
        energy: Some(Energy { kinetic: 2.0 + time_s, potential: -time_s }),
        energy_error: Some(-1e-15 * k as f64),
        orthogonality_error: Some(2e-16),
        angular_momentum: Some(skew(7.0)),
        linear_momentum: Some(vector(9.0)),
        momentum_drift: Some(1e-15),
        convergence: (k > 0).then_some(convergence),
        pace: None,
    }
}

fn checkpoint(k: u64) -> Checkpoint {
    Checkpoint {
        step: k,
        samples: k + 1,
        iterations: 5 * k,
        convergence: sample::<3>(k, 1.0).convergence,
        numbers: vec![k as f64, -0.0, 1.0 / 3.0],
        holds_since_s: Vec::new(),
        own_time: Some(OwnTime {
            numbers: vec![-1.0, 2.0 / 3.0],
            time_s: k as f64,
            carry_s: 1e-17,
            steps: 3 * k,
        }),
    }
}

/// Records samples as a run does, and ends each full chunk with a checkpoint.
fn record<const N: usize>(log: &mut LogWriter, steps: std::ops::Range<u64>, away_m: f64) {
    let mut figures = Figures::default();
    for k in steps {
        let sample = sample::<N>(k, away_m);
        figures.keep_bodies(&sample);
        log.record_bodies(0, &sample).expect("recorded");
        if log.wants_checkpoint() {
            log.checkpoint(&messages::Checkpoint::of_bodies(&checkpoint(k), figures))
                .expect("kept");
        }
    }
}

fn finish(log: LogWriter) {
    let (state, entries) = ("succeeded".to_owned(), BTreeMap::new());
    log.finish(Outcome { state, entries, charts: Vec::new() }).expect("finished");
}

fn write<const N: usize>(path: &Path, samples: u64, away_m: f64) {
    let mut log = LogWriter::create(path, &header(N)).expect("created");
    record::<N>(&mut log, 0..samples, away_m);
    finish(log);
}

fn rows(path: &Path) -> Vec<Row> {
    let mut rows = Vec::new();
    let ending = read_rows(path, 0, |row| {
        rows.push(row);
        std::ops::ControlFlow::Continue(())
    });
    assert!(ending.expect("a log").finished);
    rows
}

#[test]
fn every_number_of_a_sample_is_in_the_log() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("two.mcap");
    write::<3>(&path, 12, 8.0);
    let rows = rows(&path);
    assert_eq!(rows.len(), 12);
    let mut before: Option<Vec<f64>> = None;
    for (k, row) in rows.iter().enumerate() {
        let sample = sample::<3>(k as u64, 8.0);
        assert_eq!(row.bodies.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), NAMES);
        assert!(row.state.is_none(), "that is of one body");
        for ((_, state), body) in row.bodies.iter().zip(&sample.bodies) {
            assert_eq!(state.time_s, sample.time_s);
            assert_eq!(state.attitude, body.attitude.transpose().as_slice());
            assert_eq!(state.body_momentum, so::vee(&body.momentum));
            assert_eq!(state.angular_velocity, so::vee(&body.angular_velocity));
            assert_eq!(state.position, body.position.as_slice());
            assert_eq!(state.velocity, body.velocity.as_slice());
            assert_eq!(state.linear_momentum, body.linear_momentum.as_slice());
        }
        let turn = row.bodies[0].1.quaternion.clone();
        if let Some(before) = before {
            let along: f64 = turn.iter().zip(before).map(|(a, b)| a * b).sum();
            assert!(along > 0.9, "no jump: {along}");
        }
        before = Some(turn);
        let momentum = row.momentum.as_ref().expect("momentum");
        assert_eq!(momentum.linear, [9.0, 18.0, 27.0]);
        assert_eq!(momentum.spatial_momentum, so::vee(&skew::<3>(7.0)));
        assert_eq!(momentum.drift, Some(1e-15));
        assert_eq!(row.energy.as_ref().map(|energy| energy.total), Some(2.0));
        assert_eq!(row.solver.is_some(), k > 0);
    }
    assert!(before.expect("a sample")[0] < 0.0, "beyond half a turn the sign stays");
}

#[test]
fn an_inspection_names_the_bodies_and_the_extremes() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("two.mcap");
    write::<3>(&path, 12, 8.0);
    let found = inspect(&path).expect("a log");
    assert!(found.finished, "{found}");
    assert_eq!(found.samples, 12);
    assert_eq!(found.job.expect("a job")["bodies"], r#"["mast","primary-2"]"#);
    let counts: BTreeMap<_, _> =
        found.topics.iter().map(|topic| (topic.topic.as_str(), topic.messages)).collect();
    let expected = [
        ("/bodies/mast/state", 12),
        ("/bodies/primary-2/state", 12),
        ("/energy", 12),
        ("/log", 1),
        ("/momentum", 12),
        ("/orthogonality", 12),
        ("/scene/bodies/mast", 1),
        ("/scene/bodies/primary-2", 1),
        ("/solver", 11),
        ("/tf", 12),
    ];
    assert_eq!(counts, BTreeMap::from(expected));
    assert_eq!(found.extremes.energy_max_abs_error, Some(1e-15 * 11.0));
    assert_eq!(found.extremes.orthogonality_max, Some(2e-16));
    assert_eq!(found.extremes.momentum_drift_max, Some(1e-15));
}

#[test]
fn viewers_get_a_frame_and_a_drawing_of_each_body() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("two.mcap");
    write::<3>(&path, 3, 8.0);
    let (mut frames, mut drawn) = (Vec::new(), Vec::new());
    reader::read(&path, |item| {
        match item {
            Item::Message { topic: "/tf", data, .. } => {
                frames.push(FrameTransforms::decode(data).expect("frames").transforms);
            }
            Item::Message { topic, data, .. } if topic.starts_with("/scene/") => {
                drawn.extend(SceneUpdate::decode(data).expect("a drawing").entities);
            }
            _ => {}
        }
        std::ops::ControlFlow::Continue(())
    })
    .expect("a log");
    let children: Vec<_> = frames[1].iter().map(|frame| frame.child_frame_id.as_str()).collect();
    assert_eq!(children, NAMES);
    let place = frames[1][1].translation.as_ref().expect("a place");
    assert_eq!([place.x, place.y, place.z], [8.125, 16.25, 24.375]);
    assert!(frames[1].iter().all(|frame| frame.parent_frame_id == "space"));
    // In metres: the box as it is, the axes in parts of the body's size.
    assert_eq!(drawn.iter().map(|entity| entity.frame_id.as_str()).collect::<Vec<_>>(), NAMES);
    let size = drawn[0].cubes[0].size.as_ref().expect("a size");
    assert_eq!([size.x, size.y, size.z], [2.0, 2.0, 4.0]);
    assert_eq!(drawn[0].arrows.len(), 3);
    let arrow = drawn[0].arrows[0].shaft_length + drawn[0].arrows[0].head_length;
    assert!((arrow - 1.3 * 3.0).abs() < 1e-12, "{arrow}");
}

#[test]
fn a_table_has_the_columns_of_every_body() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("two.mcap");
    write::<3>(&path, 12, 8.0);
    let mut csv = Vec::new();
    let table = export(&path, &Choice::default(), Format::Csv, &mut csv).expect("a table");
    assert_eq!(table.rows, 12);
    let text = String::from_utf8(csv).expect("text");
    let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
    let column = |name: &str| {
        let at = lines[0].iter().position(|head| *head == name);
        let at = at.unwrap_or_else(|| panic!("no column {name} in {:?}", lines[0]));
        lines[1..].iter().map(|line| line[at].to_owned()).collect::<Vec<_>>()
    };
    let of = |number: fn(Sample<3>) -> f64| {
        (0..12).map(|k| number(sample(k, 8.0)).to_bits()).collect::<Vec<_>>()
    };
    let bits = |name: &str| {
        let parse = |cell: &String| cell.parse::<f64>().expect("a number").to_bits();
        column(name).iter().map(parse).collect::<Vec<_>>()
    };
    assert_eq!(bits("time_s"), of(|sample| sample.time_s));
    assert_eq!(bits("mast_attitude_1_2"), of(|sample| sample.bodies[0].attitude[(0, 1)]));
    assert_eq!(bits("mast_body_momentum_x"), of(|sample| sample.bodies[0].momentum[(2, 1)]));
    assert_eq!(bits("primary-2_position_y"), of(|sample| sample.bodies[1].position[1]));
    assert_eq!(bits("primary-2_velocity_z"), of(|sample| sample.bodies[1].velocity[2]));
    assert_eq!(bits("mast_linear_momentum_x"), of(|sample| sample.bodies[0].linear_momentum[0]));
    assert_eq!(bits("linear_momentum_z"), of(|_| 27.0));
    assert_eq!(bits("energy_total"), of(|_| 2.0));
    column("mast_quaternion_w");
    column("mast_angular_velocity_z");
    assert_eq!(column("solver_rung")[..2], ["", "fixed_point"]);
    // The arrays of NumPy, and of a program that reads the log in memory.
    let (arrays, _) = Columns::read(&path, 0, &[]).expect("a log");
    let all: BTreeMap<_, _> = arrays.clone().into_all().into_iter().collect();
    let Values::Numbers { shape, values } = &all["mast_attitude"] else { panic!("numbers") };
    assert_eq!((shape.as_slice(), values.len()), (&[3, 3][..], 12 * 9));
    let Values::Numbers { shape, .. } = &all["primary-2_position"] else { panic!("numbers") };
    assert_eq!(shape, &[3]);
    let mut npz = Vec::new();
    let table = export(&path, &Choice::default(), Format::Npz, &mut npz).expect("arrays");
    assert_eq!(table.columns, all_names(&arrays));
    // The same columns without a log.
    let mut made = Columns::new(messages::Message::CHANNELS.to_vec(), EPOCH_NS, 12);
    (0..12).for_each(|k| assert!(made.record_bodies(&names(), &sample::<3>(k, 8.0))));
    assert_eq!(all_names(&made), all_names(&arrays));
    let text = |columns: &Columns| format!("{:?}", columns.clone().into_all());
    assert_eq!(text(&made), text(&arrays));
    // Channels by themselves.
    let choice = Choice { channels: vec![Channel::BodyState], member: 0 };
    let table = export(&path, &choice, Format::Csv, Vec::new()).expect("a table");
    assert_eq!(table.columns.len(), 2 + 2 * (9 + 4 + 3 + 3 + 3 + 3 + 3));
}

fn all_names(columns: &Columns) -> Vec<String> {
    columns.clone().into_all().into_iter().map(|(name, _)| name.into_owned()).collect()
}

#[cfg(feature = "parquet")]
#[test]
fn a_parquet_table_has_the_columns_of_the_text() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("two.mcap");
    write::<3>(&path, 4, 8.0);
    let columns = |format| {
        let table = export(&path, &Choice::default(), format, Vec::new()).expect("a table");
        (table.rows, table.columns)
    };
    assert_eq!(columns(Format::Csv), columns(Format::Parquet));
}

#[test]
fn other_dimensions_number_their_axes() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("four.mcap");
    write::<4>(&path, 3, 8.0);
    let table = export(&path, &Choice::default(), Format::Csv, Vec::new()).expect("a table");
    let has = |name: &str| table.columns.iter().any(|column| column == name);
    for name in
        ["mast_attitude_4_4", "mast_position_4", "mast_body_momentum_3_4", "linear_momentum_1"]
    {
        assert!(has(name), "{name} in {:?}", table.columns);
    }
    assert!(!has("mast_quaternion_w"));
    let found = inspect(&path).expect("a log");
    let frames = |topic: &str| topic == "/tf" || topic.starts_with("/scene");
    assert!(!found.topics.iter().any(|topic| frames(&topic.topic)), "{found}");
}

#[test]
fn an_interrupted_log_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let at = |name: &str| folder.path().join(name);
    write::<3>(&at("whole.mcap"), 23, 8.0);
    let path = at("cut.mcap");
    let mut log = LogWriter::create(&path, &header(3)).expect("created");
    record::<3>(&mut log, 0..13, 8.0);
    log.leave();
    let mut seen = 0;
    let resumed = LogWriter::resume(&path, &header(3), &mut |_| seen += 1, &|| false);
    let (mut log, found) = resumed.expect("readable").expect("a log to go on with");
    assert_eq!(found.bodies(), Some(checkpoint(9)));
    // A zero keeps its sign among others.
    assert!(found.numbers[1].is_sign_negative());
    assert!(found.trajectory::<3>().is_none(), "it is of several bodies");
    assert_eq!(found.figures.expect("figures").energy_max_abs_error, Some(1e-15 * 9.0));
    // Two bodies and four topics; the first sample has no step.
    assert_eq!(seen, 10 * 6 - 1);
    // The figures are the caller's, who keeps them from the checkpoint on.
    let mut figures = found.figures.expect("figures");
    for k in 10..23 {
        let sample = sample::<3>(k, 8.0);
        figures.keep_bodies(&sample);
        log.record_bodies(0, &sample).expect("recorded");
        if log.wants_checkpoint() {
            log.checkpoint(&messages::Checkpoint::of_bodies(&checkpoint(k), figures))
                .expect("kept");
        }
    }
    finish(log);
    let bytes = |name: &str| std::fs::read(at(name)).expect("readable");
    assert!(bytes("whole.mcap") == bytes("cut.mcap"), "the same bytes");
    // Of other bodies, it is another job's.
    let mut log = LogWriter::create(&path, &header(3)).expect("created");
    record::<3>(&mut log, 0..13, 8.0);
    log.leave();
    let mut other = header(3);
    other.bodies.swap(0, 1);
    let resumed = LogWriter::resume(&path, &other, &mut |_| {}, &|| false).expect("readable");
    assert!(resumed.is_none());
}

#[test]
fn two_logs_differ_by_the_body_that_differs_most() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let at = |name: &str| folder.path().join(name);
    write::<3>(&at("a.mcap"), 5, 8.0);
    write::<3>(&at("b.mcap"), 5, 8.5);
    let of = |a: &str, b: &str| diff([&at(a), &at(b)], 0, &[]).expect("comparable");
    assert!(of("a.mcap", "a.mcap").agrees());
    let found = of("a.mcap", "b.mcap");
    let largest = |quantity| {
        let found = found.largest.iter().find(|largest| largest.quantity == quantity);
        found.expect("compared").largest
    };
    let length = 14.0_f64.sqrt();
    assert!((largest(Quantity::Position) - 0.5 * length).abs() < 1e-14);
    assert!((largest(Quantity::LinearMomentum) - 1.5 * length).abs() < 1e-13);
    assert_eq!(largest(Quantity::Angle), 0.0);
    assert_eq!(largest(Quantity::Energy), 0.0);
    assert!(largest(Quantity::BodyMomentum) > 0.1);
    write::<4>(&at("c.mcap"), 5, 8.0);
    let other = diff([&at("a.mcap"), &at("c.mcap")], 0, &[]);
    assert!(other.expect_err("of two dimensions").to_string().contains("different dimension"));
}

#[test]
fn a_number_that_no_plot_shows_is_refused() {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let mut log = LogWriter::create(&folder.path().join("two.mcap"), &header(3)).expect("created");
    let mut bad = sample::<3>(0, 8.0);
    bad.bodies[1].velocity[2] = f64::NAN;
    assert!(log.record_bodies(0, &bad).is_err());
}
