//! Runs whose samples stay in memory, and runs that their caller steps: the states of a log, to the bit.

use std::borrow::Cow;

use vpd::advise;
use vpd::log::columns::{Columns, Values};
use vpd::run::{self, Advanced, Control, JobContext, Outcome, RunError, Simulation};
use vpd::scenario::{SHIPPED, Scenario};
use vpd::verify::verify;

/// Returns a shipped scenario with a sample of each of `steps` steps.
fn shipped(name: &str, steps: u64) -> Scenario {
    let text = SHIPPED.iter().find(|(shipped, _)| *shipped == name).expect("shipped").1;
    let mut scenario = Scenario::from_json(text.as_bytes()).expect("valid");
    scenario.log.every = Some(1);
    scenario.log.every_s = None;
    scenario.expect = None;
    if scenario.step_s.is_some() {
        (scenario.steps, scenario.duration_s) = (Some(steps), None);
    }
    scenario
}

/// Returns the numbers of some columns as they are stored: a NaN is one there, too.
fn bits(columns: Columns) -> Vec<(Cow<'static, str>, Vec<u64>)> {
    let all = columns.into_all().into_iter();
    all.map(|(name, values)| match values {
        Values::Numbers { values, .. } => (name, values.iter().map(|x| x.to_bits()).collect()),
        Values::Counts(counts) => (name, counts),
        Values::Words(words) => (name, words.iter().map(|word| word.len() as u64).collect()),
    })
    .collect()
}

#[test]
fn samples_in_memory_are_those_of_the_log() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, _) in SHIPPED.iter().filter(|(name, _)| !name.contains("ensemble")) {
        // Over the end of a chunk, where the steps begin anew.
        let plan = advise::plan(&shipped(name, 1500)).expect("a plan");
        let log = folder.path().join(format!("{name}.mcap"));
        let control = Control::default();
        let logged =
            run::execute(&plan, &JobContext { log: &log, control: &control }).expect("a log");
        let (summary, columns) = run::collect(&plan, &control).expect("a run");
        assert_eq!(summary.last, logged.last, "{name}");
        assert_eq!((summary.samples, columns.len() as u64), (logged.samples, logged.samples));
        let (read, ending) = Columns::read(&log, 0, &[]).expect("a log");
        assert!(ending.finished);
        assert_eq!(bits(columns), bits(read), "{name}");
    }
    let ensemble = advise::plan(&shipped("satellite-ensemble", 10)).expect("a plan");
    let refused = run::collect(&ensemble, &Control::default()).expect_err("it has members");
    assert!(matches!(refused, RunError::Invalid(_)));
}

#[test]
fn a_stepped_run_is_that_of_its_job() {
    let folder = tempfile::tempdir().expect("a folder");
    for name in ["dipole", "heavy-top", "satellite", "dual-spin", "so4-free", "so5-spring"] {
        let mut simulation = Simulation::new(&shipped(name, 10)).expect("a simulation");
        let places = simulation.torque().len();
        for k in 0..300_u32 {
            if k % 7 == 0 {
                // Small enough for the lightest of them; where it is next to nothing, as of a controller at its target, it is none.
                let torque = vec![1e-7 * f64::from(k % 5) + 3e-33; places];
                simulation.set_torque(&torque).expect("numbers");
                assert_eq!(simulation.torque()[0] == 0.0, k % 5 == 0, "{name}");
            }
            assert_eq!(simulation.advance(5, |_| true), Advanced::Whole, "{name}");
        }
        assert_eq!((simulation.steps(), simulation.outcome()), (1500, Outcome::Succeeded));
        let job = simulation.job().expect("a job");
        let log = folder.path().join(format!("{name}.mcap"));
        let plan = advise::plan(&job).expect("a plan");
        let control = Control::default();
        run::execute(&plan, &JobContext { log: &log, control: &control }).expect("a log");
        let (columns, _) = Columns::read(&log, 0, &[]).expect("a log");
        let all = columns.into_all();
        let last = |wanted: &str| {
            let found = all.iter().find(|(name, _)| *name == wanted).expect("a column");
            let Values::Numbers { shape, values } = &found.1 else { unreachable!("numbers") };
            values[values.len() - shape.iter().product::<usize>()..].to_vec()
        };
        assert_eq!(last("attitude"), simulation.attitude(), "{name}");
        assert_eq!(last("body_momentum"), simulation.body_momentum(), "{name}");
        assert_eq!(last("angular_velocity"), simulation.angular_velocity(), "{name}");
        assert!(verify(&log).expect("a log").same, "{name}");
    }
}

#[test]
fn a_stepped_run_stops_and_fails_like_any() {
    let mut dipole = shipped("dipole", 10);
    let mut simulation = Simulation::new(&dipole).expect("a simulation");
    assert_eq!(simulation.advance(10, |step| step < 4), Advanced::Stopped);
    assert_eq!(simulation.steps(), 4);
    for (torque, at) in [(vec![1.0; 2], "/torque"), (vec![0.0, f64::NAN, 0.0], "/torque/1")] {
        assert_eq!(simulation.set_torque(&torque).expect_err("no torque").pointer, at);
    }
    dipole.step_s = Some(5.0);
    let mut simulation = Simulation::new(&dipole).expect("a simulation");
    let Advanced::Failed(diagnosis) = simulation.advance(1000, |_| true) else {
        panic!("steps of 5 s")
    };
    assert_eq!(diagnosis.step, simulation.steps() + 1);
    assert_eq!(simulation.outcome(), Outcome::Failed);
    let plan = advise::plan(&simulation.job().expect("a job")).expect("a plan");
    let (summary, _) = run::collect(&plan, &Control::default()).expect("a run");
    assert_eq!(summary.outcome, Outcome::Failed);
    assert_eq!(summary.diagnosis.expect("a failed step").code, diagnosis.code);
    for (name, at) in [("satellite-ensemble", "/ensemble"), ("flyby", "/step")] {
        let refused = Simulation::new(&shipped(name, 10)).map(drop).expect_err("no single run");
        assert_eq!(refused.pointer, at, "{refused}");
    }
}
