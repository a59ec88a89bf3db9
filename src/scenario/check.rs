//! Form and range of every field, before any mathematics.

use std::collections::HashSet;

use super::range::{
    Check, LARGEST_STEP_S, MAX_STEPS, SMALLEST_STEP_S, attitude, ensure, framed, inertia, matrix,
};
use super::{Accuracy, Method, Scenario, ScenarioError, Scene, SolverKind, TableauChoice};
use crate::method::Integrator;

/// Most terms of a potential.
const MAX_TERMS: usize = 1000;
/// Most samples of a log.
const MAX_SAMPLES: u64 = 1_000_000_000;
/// Smallest and largest error that may be asked for.
const ACCURACY_RANGE: (f64, f64) = (1e-13, 0.1);
/// Longest run in seconds of simulated time, so that log time fits its 64 bits.
const MAX_DURATION_S: f64 = 4e9;
/// Bounds of the relative tolerance of the solver.
const TOLERANCE_RANGE: (f64, f64) = (1e-16, 1e-3);
/// Most sweeps a step may ask for.
const MAX_ITERATIONS: u32 = 10_000;

/// Checks everything that can be checked without mathematics.
pub(super) fn check(scenario: &Scenario) -> Check {
    text("/name", &scenario.name, 200, false)?;
    text("/description", &scenario.description, 4000, true)?;
    if let Some(bodies) = scenario.bodies() {
        super::bodies::check(scenario, bodies)?;
    } else {
        one_body(scenario)?;
    }
    let n = scenario.dimension();
    method(scenario, n)?;
    super::steps::check(scenario)?;
    duration(scenario)?;
    if let Some(given) = &scenario.ensemble {
        given.check(scenario)?;
    }
    super::control::stops(scenario, n)?;
    scenario.pointing.as_ref().map_or(Ok(()), |pointing| pointing.check(scenario, n))?;
    super::derivatives::check(scenario, n)?;
    log(scenario, n)?;
    expect(scenario, n)
}

/// Checks the scene of one body.
fn one_body(scenario: &Scenario) -> Check {
    let Some(given) = &scenario.scene.inertia else {
        return Err(ScenarioError::invalid("/scene", "missing field `inertia` (or `bodies`)"));
    };
    inertia("/scene/inertia", given)?;
    let n = scenario.dimension();
    let terms = &scenario.scene.potential;
    ensure(terms.len() <= MAX_TERMS, "/scene/potential", || {
        format!("{} terms given, at most {MAX_TERMS} are allowed", terms.len())
    })?;
    for (index, term) in terms.iter().enumerate() {
        term.law().check(&format!("/scene/potential/{index}"), n)?;
    }
    driven(scenario, n)?;
    control(scenario, n)?;
    initial(scenario, n)
}

/// Checks the control and the field, and what stands next to them.
fn control(scenario: &Scenario, n: usize) -> Check {
    let Scene { control, field, wheels, .. } = &scenario.scene;
    if let Some(field) = field {
        field.check(n)?;
    }
    let Some(control) = control else { return Ok(()) };
    control.check(n, field.is_some())?;
    let driven = matches!(control.through, super::Through::Wheels(_));
    ensure(wheels.is_none() || !driven, "/scene/wheels", || {
        "is given together with driven wheels; give their momenta in /scene/control/through/wheels/momenta".into()
    })
}

/// Checks the terms that change with time, the torques and the wheels.
fn driven(scenario: &Scenario, n: usize) -> Check {
    let Scene { driven, torques, wheels, field, .. } = &scenario.scene;
    let most = |count: usize, pointer: &str| {
        ensure(count <= MAX_TERMS, pointer, || {
            format!("{count} given, at most {MAX_TERMS} are allowed")
        })
    };
    most(driven.len(), "/scene/driven")?;
    most(torques.len(), "/scene/torques")?;
    // An unknown number of steps is checked later.
    let steps = scenario.step_s.zip(scenario.steps).map(|(step_s, steps)| steps as f64 * step_s);
    let duration_s = scenario.duration_s.or(steps);
    for (index, term) in driven.iter().enumerate() {
        term.check(&format!("/scene/driven/{index}"), n, duration_s)?;
    }
    for (index, torque) in torques.iter().enumerate() {
        torque.check(&format!("/scene/torques/{index}"), n, duration_s, field.is_some())?;
    }
    wheels.as_ref().map_or(Ok(()), |wheels| super::driven::wheels(wheels, n))
}

fn text(pointer: &str, given: &str, most: usize, lines: bool) -> Check {
    ensure(lines || !given.trim().is_empty(), pointer, || {
        "is empty; at least one visible character is needed".into()
    })?;
    ensure(given.len() <= most, pointer, || {
        format!("has {} bytes, at most {most} are allowed", given.len())
    })?;
    let forbidden = |c: char| (c.is_control() && !(lines && c == '\n')) || is_unseen(c);
    match given.chars().find(|&c| forbidden(c)) {
        Some(c) => Err(ScenarioError::invalid(
            pointer,
            format!(
                "contains the character U+{:04X}; control characters, direction marks and characters without a width are not allowed",
                c as u32
            ),
        )),
        None => Ok(()),
    }
}

/// Returns whether a character is a direction mark or takes no room: with these two names look
/// alike, or a name looks empty.
fn is_unseen(c: char) -> bool {
    matches!(c,
        '\u{ad}' | '\u{34f}' | '\u{61c}' | '\u{115f}' | '\u{1160}' | '\u{17b4}' | '\u{17b5}'
        | '\u{180b}'..='\u{180f}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}'
        | '\u{2060}'..='\u{206f}' | '\u{2800}' | '\u{3164}' | '\u{fe00}'..='\u{fe0f}'
        | '\u{feff}' | '\u{ffa0}' | '\u{fff0}'..='\u{fffb}' | '\u{e0000}'..='\u{e0fff}')
}

fn initial(scenario: &Scenario, n: usize) -> Check {
    let initial = &scenario.scene.initial;
    let at = "/scene/initial";
    if let Some(index) = initial.orbit_frame {
        let pointer = format!("{at}/orbit_frame");
        ensure(n == 3, &pointer, || format!("is for n = 3, this body has n = {n}"))?;
        super::driven::orbit_frame(&pointer, &scenario.scene.driven, index)?;
    }
    if let Some(given) = &initial.attitude {
        attitude(&format!("{at}/attitude"), given, n)?;
    }
    ensure(
        initial.momentum.is_none() || initial.angular_velocity.is_none(),
        format!("{at}/angular_velocity"),
        || "is given together with `momentum`; give one of the two".into(),
    )?;
    if let Some(momentum) = &initial.momentum {
        framed(&format!("{at}/momentum"), momentum, n)?;
    }
    if let Some(velocity) = &initial.angular_velocity {
        framed(&format!("{at}/angular_velocity"), velocity, n)?;
    }
    Ok(())
}

fn method(scenario: &Scenario, n: usize) -> Check {
    let method = &scenario.method;
    let (name, asked) = (method.name.as_str(), method.name.integrator());
    let is_composition = asked.is_some_and(Integrator::is_composition);
    ensure(n == 3 || !asked.is_some_and(|method| method.facts().three), "/method/name", || {
        format!("{name} is for n = 3, this body has n = {n}")
    })?;
    ensure(method.order.is_none() || is_composition, "/method/order", || {
        let compositions = Integrator::names(Integrator::is_composition);
        format!("is for {compositions}; the order of {name} follows from its tableau")
    })?;
    ensure(
        method.order.is_none_or(|order| matches!(order, 2 | 4 | 6 | 8)),
        "/method/order",
        || format!("{} given, 2, 4, 6 or 8 is needed", method.order.unwrap_or_default()),
    )?;
    ensure(method.tableau.is_none() || !is_composition, "/method/tableau", || {
        format!("{name} has no tableau; give its `order`")
    })?;
    let solver = &method.solver;
    let has_newton = asked.is_none_or(|method| method.facts().newton);
    ensure(solver.kind != SolverKind::Newton || has_newton, "/method/solver/kind", || {
        format!("\"newton\" given, {name} takes fixed_point or auto")
    })?;
    let (low, high) = TOLERANCE_RANGE;
    ensure(
        solver.tolerance >= low && solver.tolerance <= high,
        "/method/solver/tolerance",
        || format!("{:?} given, a tolerance must be from {low:e} to {high:e}", solver.tolerance),
    )?;
    ensure(
        (1..=MAX_ITERATIONS).contains(&solver.max_iterations),
        "/method/solver/max_iterations",
        || format!("{} given, 1 to {MAX_ITERATIONS} are allowed", solver.max_iterations),
    )?;
    if let Some(TableauChoice::Custom(tableau)) = &method.tableau {
        for (i, row) in tableau.a.iter().enumerate() {
            ensure(row.len() == tableau.a.len(), format!("/method/tableau/a/{i}"), || {
                format!(
                    "{} numbers given, {n} are needed: the tableau has {n} rows",
                    row.len(),
                    n = tableau.a.len()
                )
            })?;
        }
    }
    Ok(())
}

/// Checks a scenario with an accuracy in the place of a method and a step.
fn accuracy(scenario: &Scenario, error: f64) -> Check {
    let (low, high) = ACCURACY_RANGE;
    ensure(error >= low && error <= high, "/accuracy/error", || {
        format!("{error:?} given, an error must be from {low:e} to {high:e}")
    })?;
    let together = |given: bool, pointer: &str| {
        ensure(!given, pointer, || "is given together with `accuracy`, which chooses it".into())
    };
    together(scenario.method != Method::default(), "/method")?;
    together(scenario.step_s.is_some(), "/step_s")?;
    together(scenario.step.is_some(), "/step")?;
    together(scenario.steps.is_some(), "/steps")?;
    let Some(duration_s) = scenario.duration_s else {
        return Err(ScenarioError::invalid("", "missing field `duration_s`, needed by `accuracy`"));
    };
    whole_duration(duration_s)
}

fn whole_duration(duration_s: f64) -> Check {
    ensure(duration_s > 0.0 && duration_s <= MAX_DURATION_S, "/duration_s", || {
        format!("{duration_s:?} given, a duration must be above 0 and at most {MAX_DURATION_S:e} s")
    })
}

/// Returns whether a duration is a whole number of steps, but for rounding.
pub(super) fn is_whole(duration_s: f64, step_s: f64) -> bool {
    let count = duration_s / step_s;
    let whole = count.round();
    (count - whole).abs() <= 1e-9 * count.max(1.0) && whole >= 1.0
}

/// Returns the longest step, but for rounding, that is no longer than `step_s` and of which a
/// duration is a whole number.
pub(crate) fn dividing(duration_s: f64, step_s: f64) -> f64 {
    twelve_digits(duration_s / (duration_s / step_s).ceil())
}

/// Formats a number in few characters, however small or large it is.
pub(crate) fn short(x: f64) -> String {
    let plain = x.to_string();
    if plain.len() > 24 { format!("{x:e}") } else { plain }
}

/// Rounds to twelve digits, which is enough for a whole number of steps.
pub(crate) fn twelve_digits(x: f64) -> f64 {
    format!("{x:.11e}").parse().unwrap_or(x)
}

fn duration(scenario: &Scenario) -> Check {
    if let Some(Accuracy { error, .. }) = scenario.accuracy {
        return accuracy(scenario, error);
    }
    let Some(h) = scenario.step_s else {
        if let (Some(_), Some(duration_s), None) =
            (scenario.adaptive(), scenario.duration_s, scenario.steps)
        {
            return whole_duration(duration_s);
        }
        return Err(ScenarioError::invalid("", "missing field `step_s` (or `accuracy`)"));
    };
    let (low, high) = (SMALLEST_STEP_S, LARGEST_STEP_S);
    ensure(h >= low && h <= high, "/step_s", || {
        format!("{h:?} given, a step must be from {low:e} to {high:e} s")
    })?;
    let (pointer, duration_s) = match (scenario.steps, scenario.duration_s) {
        (Some(_), Some(_)) => {
            return Err(ScenarioError::invalid(
                "/duration_s",
                "is given together with `steps`; give one of the two",
            ));
        }
        (None, None) => {
            return Err(ScenarioError::invalid("", "missing field `steps` (or `duration_s`)"));
        }
        (Some(steps), None) => ("/steps", steps as f64 * h),
        (None, Some(duration_s)) => {
            whole_duration(duration_s)?;
            ensure(is_whole(duration_s, h), "/duration_s", || {
                let count = duration_s / h;
                let [below, above] =
                    [count.floor(), count.ceil()].map(|count| twelve_digits(count * h));
                let nearest = if count < 1.0 {
                    format!("the nearest is {above} s")
                } else {
                    format!("the nearest are {below} s and {above} s")
                };
                let step = dividing(duration_s, h);
                let given = short(duration_s);
                format!(
                    "{given} s is not a whole number of steps of {h} s: {nearest}; or use steps of {step} s"
                )
            })?;
            ("/duration_s", duration_s)
        }
    };
    let steps = scenario.step_count();
    ensure((1..=MAX_STEPS).contains(&steps), pointer, || {
        format!("{steps} steps, 1 to {MAX_STEPS} are allowed")
    })?;
    ensure(duration_s <= MAX_DURATION_S, pointer, || {
        format!(
            "{steps} steps of {h} s last {duration_s:e} s, at most {MAX_DURATION_S:e} s are allowed"
        )
    })
}

/// Checks the spacing of samples in seconds.
fn every_s(scenario: &Scenario, every_s: f64) -> Check {
    let pointer = "/log/every_s";
    ensure(scenario.log.every.is_none(), pointer, || {
        "is given together with `every`; give one of the two".into()
    })?;
    ensure(every_s > 0.0 && every_s <= MAX_DURATION_S, pointer, || {
        format!("{every_s:?} given, a time must be above 0 and at most {MAX_DURATION_S:e} s")
    })?;
    match (scenario.step_s, scenario.duration_s) {
        (Some(step_s), _) => ensure(is_whole(every_s, step_s), pointer, || {
            let above = twelve_digits((every_s / step_s).ceil() * step_s);
            format!(
                "{} s is not a whole number of steps of {step_s} s; {above} s is",
                short(every_s)
            )
        }),
        // The step will be chosen later.
        (None, Some(duration_s)) => {
            ensure(is_whole(duration_s, every_s), pointer, || {
                let less = dividing(duration_s, every_s);
                format!(
                    "{} s given, but the duration of {duration_s} s is not a whole number of these; use {less} s",
                    short(every_s)
                )
            })?;
            let least_s = duration_s / MAX_SAMPLES as f64;
            ensure(every_s >= least_s, pointer, || {
                format!(
                    "{every_s:?} given, which makes more than {MAX_SAMPLES} samples; the smallest allowed is {least_s:e} s"
                )
            })
        }
        (None, None) => Ok(()),
    }
}

fn log(scenario: &Scenario, n: usize) -> Check {
    let log = &scenario.log;
    ensure(log.every != Some(0), "/log/every", || "0 given, at least 1 is needed".into())?;
    log.every_s.map_or(Ok(()), |given| every_s(scenario, given))?;
    let every = scenario.sample_every();
    let steps = scenario.step_count();
    let pointer = if log.every_s.is_some() { "/log/every_s" } else { "/log/every" };
    ensure(steps / every <= MAX_SAMPLES, pointer, || {
        let least = steps.div_ceil(MAX_SAMPLES);
        let least = match (log.every_s, scenario.step_s) {
            (Some(_), Some(step_s)) => format!("{} s", twelve_digits(least as f64 * step_s)),
            _ => least.to_string(),
        };
        format!(
            "{steps} steps with a sample every {every} make more than {MAX_SAMPLES} samples; the smallest allowed is {least}"
        )
    })?;
    if let Some(channels) = &log.channels {
        ensure(!channels.is_empty(), "/log/channels", || {
            "is empty; name at least one channel, or omit the field for all of them".into()
        })?;
        let mut seen = HashSet::new();
        for (i, &channel) in channels.iter().enumerate() {
            let pointer = format!("/log/channels/{i}");
            ensure(seen.insert(channel), pointer.clone(), || {
                "names a channel that was named before".into()
            })?;
            ensure(!channel.needs_three() || n == 3, pointer.clone(), || {
                format!("is for n = 3, this body has n = {n}")
            })?;
            let several = scenario.bodies().is_some();
            ensure(!channel.needs_one_body() || !several, pointer.clone(), || {
                "is for scenes of one body; of several, each has /bodies/*/state".into()
            })?;
            ensure(!channel.needs_several_bodies() || several, pointer.clone(), || {
                "is for scenes of several bodies, this one has one".into()
            })?;
            ensure(
                !channel.needs_ensemble() || scenario.ensemble.is_some(),
                pointer.clone(),
                || "is for ensembles, this scenario has none".into(),
            )?;
            ensure(
                !channel.needs_own_steps() || scenario.adaptive().is_some(),
                pointer.clone(),
                || "is for steps that adapt, this scenario has none".into(),
            )?;
            ensure(
                !channel.needs_control() || scenario.scene.control.is_some(),
                pointer.clone(),
                || "is for scenes with control, this one has none".into(),
            )?;
            ensure(
                !channel.needs_pointing() || scenario.pointing.is_some(),
                pointer.clone(),
                || "is for scenarios with `pointing`, this one has none".into(),
            )?;
            ensure(
                !channel.needs_derivatives() || scenario.derivatives.is_some(),
                pointer,
                || "is for scenarios with `derivatives`, this one has none".into(),
            )?;
        }
    }
    // Viewers' time stamps have 32 bits for the seconds.
    let most_s = f64::from(u32::MAX) - epoch_ns(&log.epoch.0)? as f64 * 1e-9;
    let (pointer, duration_s) = match (scenario.duration_s, scenario.step_s) {
        (Some(duration_s), _) => ("/duration_s", duration_s),
        (None, step_s) => ("/steps", steps as f64 * step_s.unwrap_or_default()),
    };
    ensure(duration_s < most_s, pointer, || {
        format!(
            "the run lasts {duration_s:e} s; log times end in the year 2106, {most_s:.0} s after the epoch"
        )
    })
}

/// Returns the nanoseconds since 1970 of an RFC 3339 moment.
pub(super) fn epoch_ns(text: &str) -> Result<u64, ScenarioError> {
    let wrong = |message: String| ScenarioError::invalid("/log/epoch", message);
    let allowed = "a moment like 2026-01-01T00:00:00Z, in the years 1990 to 2099, is needed";
    let moment = chrono::DateTime::parse_from_rfc3339(text)
        .map_err(|error| wrong(format!("{error}; {allowed}")))?;
    let ns = moment.timestamp_nanos_opt().and_then(|ns| u64::try_from(ns).ok());
    // Viewers take these years for calendar time; others for seconds since the start.
    let range = 631_152_000_000_000_000..4_102_444_800_000_000_000;
    ns.filter(|ns| range.contains(ns)).ok_or_else(|| wrong(format!("{text} given; {allowed}")))
}

fn expect(scenario: &Scenario, n: usize) -> Check {
    let Some(expect) = &scenario.expect else { return Ok(()) };
    let bounds = [
        ("energy_error_max", expect.energy_error_max),
        ("orthogonality_error_max", expect.orthogonality_error_max),
        ("momentum_drift_max", expect.momentum_drift_max),
        ("final_attitude_error_max", expect.final_attitude_error_max),
    ];
    for (name, bound) in bounds {
        ensure(bound.is_none_or(|x| x >= 0.0), format!("/expect/{name}"), || {
            "is negative; a bound is at least 0".into()
        })?;
    }
    ensure(
        expect.final_attitude.is_some() == expect.final_attitude_error_max.is_some(),
        "/expect",
        || "`final_attitude` and `final_attitude_error_max` must be given together".into(),
    )?;
    match &expect.final_attitude {
        Some(rows) => matrix("/expect/final_attitude", rows, n),
        None => Ok(()),
    }
}
