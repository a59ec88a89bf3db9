//! Steps in a time of their own against steps of one length, near charges: `cargo bench -p vpd-solve --bench adaptive`.
//!
//! For each scene the least torques, and the least time, with which each reaches an error `|g - g_ref| + |p - p_ref|` at the
//! end, over 1, 2, 4 and 8 stages and steps a quarter of an octave apart. The reference is the adaptive scheme with 8 stages;
//! how well it is known stands next to it. Times are the least of several repeats, in which both take turns.

use std::time::Instant;

use vpd_solve::hamiltonian::{Rescaled, TimeScale};
use vpd_solve::nonlinear::{Rungs, StopRule};
use vpd_solve::so;
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_adaptive::VpdAdaptive;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::tableau::Tableau;

#[allow(dead_code, reason = "the tests use more of it")]
#[path = "../tests/it/encounters.rs"]
mod encounters;

use encounters::{Scene, scenes};

fn main() {
    // Arguments that cargo passes itself begin with dashes.
    let asked: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    for scene in scenes() {
        if asked.is_empty() || asked.iter().any(|asked| scene.name.contains(asked.as_str())) {
            compare(&scene);
            steps(&scene);
        }
    }
}

fn say(line: &str) {
    use std::io::Write;
    // A reader that has gone away is no failure of a bench.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn gauss(stages: usize) -> Tableau {
    Tableau::gauss(stages).expect("1 to 8 stages")
}

#[derive(Clone, Copy)]
struct Tried {
    stages: usize,
    /// Steps of one length, or 1 / dtau.
    fineness: f64,
    torques: u64,
    error: f64,
    us: f64,
}

fn fixed(scene: &Scene, stages: usize, steps: u64) -> Option<(State<3>, u64)> {
    let stop = StopRule { rungs: Rungs::Both, ..StopRule::default() };
    let mut stepper = VpdSo3::new(gauss(stages), stop).expect("at most 8 stages");
    stepper.start(&scene.start);
    let begun = scene.body.work().gradients();
    for _ in 0..steps {
        stepper.step(&scene.body, scene.until / steps as f64).ok()?;
    }
    let state = State { attitude: stepper.attitude()?, momentum: stepper.momentum() };
    Some((state, scene.body.work().gradients() - begun))
}

fn adaptive(scene: &Scene, scale: &TimeScale, stages: usize, h: f64) -> Option<(State<3>, u64)> {
    let mut stepper =
        VpdAdaptive::new(gauss(stages), StopRule::default(), scale.clone()).with_steps_of(h);
    stepper.start(&scene.start);
    let begun = scene.body.work().gradients();
    stepper.step(&scene.body, scene.until).ok()?;
    stepper.synchronise(&scene.body, scene.until).ok()?;
    let state = State { attitude: stepper.attitude()?, momentum: stepper.momentum() };
    Some((state, scene.body.work().gradients() - begun))
}

fn difference(a: &State<3>, b: &State<3>) -> f64 {
    let momentum = a.momentum - b.momentum;
    (a.attitude - b.attitude).singular_values().max() + so::inner(&momentum, &momentum).sqrt()
}

/// The least torques, or the least time, with which an error is reached.
fn least(tried: &[Tried], error: f64, by: fn(&Tried) -> f64) -> Option<Tried> {
    tried.iter().filter(|of| of.error <= error).min_by(|a, b| by(a).total_cmp(&by(b))).copied()
}

/// Returns the result of a run, and its microseconds, the least of a few.
fn timed(run: impl Fn() -> Option<(State<3>, u64)>) -> Option<(State<3>, u64, f64)> {
    let mut us = f64::INFINITY;
    let mut found = None;
    for _ in 0..3 {
        let begun = Instant::now();
        found = Some(run()?);
        us = us.min(begun.elapsed().as_secs_f64() * 1e6);
    }
    found.map(|(state, torques)| (state, torques, us))
}

fn compare(scene: &Scene) {
    const STAGES: [usize; 4] = [1, 2, 4, 8];
    let octave = |k: i32| 2.0_f64.powf(f64::from(k) / 4.0);
    let truth = |h: f64| adaptive(scene, &scene.scale, 8, h).expect("small steps").0;
    let reference = truth(0.02);
    let known = difference(&truth(0.03), &reference);
    let (mut of_fixed, mut of_adaptive) = (Vec::new(), Vec::new());
    for stages in STAGES {
        for k in 16..62 {
            let steps = octave(k).round();
            if let Some((state, torques, us)) = timed(|| fixed(scene, stages, steps as u64)) {
                let error = difference(&state, &reference);
                of_fixed.push(Tried { stages, fineness: steps, torques, error, us });
                if error < 1e-11 {
                    break;
                }
            }
        }
        for k in -4..40 {
            let fineness = octave(k);
            let run = || adaptive(scene, &scene.scale, stages, 1.0 / fineness);
            if let Some((state, torques, us)) = timed(run) {
                let error = difference(&state, &reference);
                of_adaptive.push(Tried { stages, fineness, torques, error, us });
                if error < 1e-11 {
                    break;
                }
            }
        }
    }
    say(&format!("\n{} to t = {}, reference known to {known:.0e}", scene.name, scene.until));
    say(
        "   error   torques: fixed (stages), adaptive (stages)    us: fixed (stages, steps), adaptive (stages, dtau)",
    );
    let torques = |of: &Tried| of.torques as f64;
    let us = |of: &Tried| of.us;
    for error in [1e-2, 1e-4, 1e-6, 1e-8, 1e-10] {
        let (Some(few), Some(quick)) =
            (least(&of_adaptive, error, torques), least(&of_adaptive, error, us))
        else {
            continue;
        };
        let (a, b) = (least(&of_fixed, error, torques), least(&of_fixed, error, us));
        let none = || "none".to_owned();
        let fixed_torques = a.map_or_else(none, |a| format!("{} ({})", a.torques, a.stages));
        let ratio = a.map_or(f64::INFINITY, |a| a.torques as f64 / few.torques as f64);
        let fixed_us =
            b.map_or_else(none, |b| format!("{:.0} ({}, {})", b.us, b.stages, b.fineness));
        let faster = b.map_or(f64::INFINITY, |b| b.us / quick.us);
        say(&format!(
            "  {error:.0e}   {fixed_torques:>12}, {} ({}): {ratio:.1}     {fixed_us:>16}, {:.0} ({}, {:.3}): {faster:.1}",
            few.torques,
            few.stages,
            quick.us,
            quick.stages,
            1.0 / quick.fineness
        ));
    }
}

/// A step along K next to one of the same length along H, where both are easy.
fn steps(scene: &Scene) {
    const STEPS: u32 = 8;
    let energy = scene.body.energy(&scene.start.attitude, &scene.start.momentum).total();
    let system = Rescaled::new(&scene.body, &scene.scale, energy);
    let h = 0.02;
    let own_h = h / system.sigma(&scene.start.attitude);
    let torques = |run: &mut dyn FnMut()| {
        let before = scene.body.work().gradients();
        let begun = Instant::now();
        run();
        let ns = begun.elapsed().as_secs_f64() * 1e9 / f64::from(STEPS);
        (ns, (scene.body.work().gradients() - before) as f64 / f64::from(STEPS))
    };
    for stages in [1, 2, 4, 8] {
        let (mut plain, mut own) = ((f64::INFINITY, 0.0), (f64::INFINITY, 0.0));
        for _ in 0..200 {
            let mut stepper = VpdSo3::new(gauss(stages), StopRule::default()).expect("8 at most");
            stepper.start(&scene.start);
            let (ns, counted) = torques(&mut || {
                for _ in 0..STEPS {
                    stepper.step(&scene.body, h).expect("easy");
                }
            });
            plain = (plain.0.min(ns), counted);
            let mut stepper = Vpd::new(gauss(stages), StopRule::default());
            stepper.start(&scene.start);
            let (ns, counted) = torques(&mut || {
                for _ in 0..STEPS {
                    stepper.step(&system, own_h).expect("easy");
                }
            });
            own = (own.0.min(ns), counted);
        }
        say(&format!(
            "  a step of {stages} stages: {:.0} ns and {:.1} torques, in its own time {:.0} ns and {:.1}: {:.2} and {:.2} times",
            plain.0,
            plain.1,
            own.0,
            own.1,
            own.0 / plain.0,
            own.1 / plain.1
        ));
    }
}
