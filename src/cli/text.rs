//! Text output for runs and plans.

use std::fmt::Write;

use crate::plan::{EnsemblePlan, Formulation, Plan};
use crate::run::{ControlSummary, DerivativesSummary, EnergySummary, Summary};
use crate::scenario::twelve_digits;

/// What an error at the end counts: see [`crate::study::Reference::distance`].
const ERROR_IS: &str = "radians of attitude, and the momentum in parts of its largest";

/// Formats a run in a few lines, with what its plan chose and warns of.
pub(super) fn summary(summary: &Summary, plan: &Plan) -> String {
    let mut text = String::new();
    let mut line = |name: &str, value: String| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{name:<15} {value}");
    };
    line(
        "outcome",
        format!(
            "{}, {} steps to t = {} s",
            summary.outcome.as_str(),
            summary.steps,
            twelve_digits(summary.time_s)
        ),
    );
    if let Some(start) = &plan.start {
        line("start", start.to_string());
    }
    if let Some(stopped) = &summary.stopped {
        line("stopped", stopped.clone());
    }
    if let Some(diagnosis) = &summary.diagnosis {
        line("diagnosis", diagnosis.to_string());
    }
    if let Some(advice) = &plan.advice {
        let (scheme, expected) = (scheme(&plan.formulation), advice.expected_error);
        line(
            "method",
            format!("{scheme}, steps of {} s: error {expected:.1e} expected", plan.step_s),
        );
    }
    for warning in plan.warnings.iter().chain(&summary.warning) {
        line("warning", warning.clone());
    }
    if let Some(error) = summary.error {
        line("error", format!("{error:.2e} at the end, against a reference: {ERROR_IS}"));
    }
    if let Some(bound) = summary.error_below {
        /// Factor with which a bound stays one when it is rounded to three digits.
        const UPWARDS: f64 = 1.005;
        let bound = UPWARDS * bound;
        line(
            "error",
            format!(
                "below {bound:.2e} at the end: {ERROR_IS}; the reference itself is no more accurate"
            ),
        );
    }
    if let Some(energy) = summary.energy {
        let EnergySummary { initial, max_abs_error: max, final_error: end, .. } = energy;
        match (&plan.balance, energy.least, energy.largest, energy.last) {
            (Some(balance), Some(least), Some(largest), Some(last)) => {
                let range = format!(
                    "{initial:.6e} J at the start, from {least:.6e} to {largest:.6e} J, {last:.6e} J at the end"
                );
                line("energy", range);
                line(
                    "balance",
                    format!("{balance}: off by at most {max:.2e} J, {end:.2e} J at the end"),
                );
            }
            _ => line(
                "energy",
                format!(
                    "{initial:.6e} J at the start, error at most {max:.2e} J, {end:.2e} J at the end"
                ),
            ),
        }
    }
    if let Some(orthogonality) = summary.orthogonality {
        line(
            "orthogonality",
            format!(
                "error at most {:.2e}, {:.2e} on average",
                orthogonality.max, orthogonality.mean
            ),
        );
    }
    if let Some(momentum) = summary.momentum {
        line(
            "momentum",
            format!("drift of the conserved part at most {:.2e} kg m^2/s", momentum.max_drift),
        );
    }
    if let Some(error) = summary.table_impulse_max_error {
        line("impulse", format!("that of the tables to {error:.2e} N m s"));
    }
    if let Some(ControlSummary { samples, saturated, pointing_error_rad }) = summary.control {
        let cut = match saturated {
            0 => "no limit cut a command".to_owned(),
            saturated => format!("a limit cut the command at {saturated} of {samples} samples"),
        };
        let error = pointing_error_rad.map_or_else(String::new, |error| {
            format!(", pointing error {error:.2e} rad at the last sample")
        });
        // Of an ensemble the table of members says it of each.
        let whose = if summary.ensemble.is_some() { "of member 0: " } else { "" };
        line("control", format!("{whose}{cut}{error}"));
    }
    if let Some(DerivativesSummary { transition_norm, symplectic_error }) = summary.derivatives {
        line(
            "derivatives",
            format!(
                "transition matrix of norm {transition_norm:.3e}, symplectic to {symplectic_error:.1e} of its square"
            ),
        );
    }
    if let Some(covariance) = &summary.covariance {
        line(
            "covariance",
            format!(
                "attitude to {:.3e} rad, at most {:.3e} rad in a direction",
                covariance.attitude_spread_rad, covariance.largest_attitude_deviation_rad
            ),
        );
    }
    line(
        "solver",
        format!(
            "{:.2} iterations a step ({})",
            summary.solver.iterations_per_step,
            summary.solver.kind.as_deref().unwrap_or("none")
        ),
    );
    let of_a_step = match summary.ns_per_step {
        0.0 => String::new(),
        ns => format!(", {ns:.0} ns a step in the integrator"),
    };
    line("time", format!("{:.3} s{of_a_step}", summary.wall_s));
    if let Some(ensemble) = &summary.ensemble {
        let stopped = ensemble.stopped.iter().map(|(at, count)| format!(", {count} by {at}"));
        let failed = ensemble.failed.iter().map(|(code, count)| format!(", {count} {code}"));
        let ends: String = stopped.chain(failed).collect();
        let members = format!("{} of {} succeeded{ends}", ensemble.succeeded, ensemble.members);
        line("members", members);
        if let Some(spread) = ensemble.attitude_spread_rad {
            line("spread", format!("{spread:.3e} rad of attitude at the end"));
        }
        for (name, spread) in &ensemble.bodies {
            let size = |deviations: &[f64]| deviations.iter().map(|x| x * x).sum::<f64>().sqrt();
            let turned = spread.attitude_spread_rad;
            let turned = turned.map_or_else(String::new, |rad| format!("{rad:.3e} rad, "));
            let moved = size(&spread.position_deviation_m);
            line("spread", format!("{name}: {turned}{moved:.3e} m at the end"));
        }
        if let Some(error) = ensemble.energy_max_abs_error {
            line("worst energy", format!("error at most {error:.2e} J in any member"));
        }
    }
    let log = if summary.log.is_empty() { "none kept" } else { &summary.log };
    line("log", format!("{log}, {} samples", summary.samples));
    for unmet in &summary.unmet {
        line("not as expected", unmet.clone());
    }
    text
}

/// Names a method with its tableau, its stages and its order.
fn scheme(formulation: &Formulation) -> String {
    let Formulation { method, tableau, stages, order, .. } = formulation;
    let tableau = tableau.as_deref().unwrap_or("composed");
    format!("{}, {tableau} ({stages} stages, order {order})", method.as_str())
}

/// Formats a plan in a few lines.
pub(super) fn plan(name: &str, plan: &Plan) -> String {
    let mut text = String::new();
    let formulation = &plan.formulation;
    let mut line = |name: &str, value: String| {
        let _ = writeln!(text, "{name:<12} {value}");
    };
    line("scenario", format!("{name}, on SO({})", plan.dimension));
    line("method", format!("{}: {}", scheme(formulation), formulation.why));
    if let Some(words) = formulation.motion.words() {
        line("motion", words.to_owned());
    }
    if let Some(advice) = &plan.advice {
        line(
            "accuracy",
            format!(
                "{:.1e} asked for, {:.1e} expected at the end, a margin of {:.1}; trial runs went to t = {:.6} s",
                advice.error, advice.expected_error, advice.margin, advice.pilot_time_s
            ),
        );
        for candidate in &advice.candidates {
            let found = match (candidate.step_s, candidate.cost_us, candidate.expected_error) {
                (Some(step_s), Some(cost_us), Some(error)) => {
                    format!(
                        "step {step_s:.3e} s, error {error:.1e}, {cost_us:.2e} us of computing per second of motion"
                    )
                }
                (_, _, Some(error)) => {
                    format!(
                        "given up as too expensive or out of reach; smallest error tried {error:.1e}"
                    )
                }
                _ => "no step works".to_owned(),
            };
            let name = candidate.method.as_str();
            line("candidate", format!("{name} {}: {found}", candidate.tableau));
        }
    }
    line(
        "steps",
        format!(
            "{} of {} s, every {}: {} samples",
            plan.steps,
            plan.step_s,
            match plan.every {
                1 => "step a sample".to_owned(),
                every => format!("{every} steps a sample"),
            },
            plan.samples
        ),
    );
    if let Some(own) = &plan.own_steps {
        let near: Vec<String> = own
            .near_m
            .iter()
            .filter(|&&near| near > 0.0)
            .map(|near| format!("{near:.3}"))
            .collect();
        let (longest, near) = (own.largest_step_s, near.join(", "));
        line(
            "adaptive",
            format!("steps of at most {longest:.4} s, shorter within {near} m of a point source"),
        );
    }
    if let Some(EnsemblePlan { members, in_full, .. }) = &plan.ensemble {
        let in_full: Vec<String> = in_full.iter().map(u64::to_string).collect();
        let text = format!("{members}; logged in full: member {}", in_full.join(", "));
        line("members", text);
    }
    if let Some(start) = &plan.start {
        line("start", start.to_string());
    }
    for warning in &plan.warnings {
        line("warning", warning.clone());
    }
    for body in &plan.bodies {
        line("body", format!("{} is {}: {}", body.name, body.hold, body.why));
    }
    if plan.potential.is_empty() {
        let of = if plan.bodies.is_empty() { "a free body" } else { "nothing acts on the bodies" };
        line("potential", format!("none: {of}"));
    }
    for term in &plan.potential {
        let verdict = if term.kept { "kept" } else { "dropped" };
        line("potential", format!("{} {verdict}: {}", term.pointer, term.why));
    }
    // For a scene with torques it is a balance, or nothing.
    let conserved = match plan.free_directions {
        0 | 1 => "no part of the spatial momentum".to_owned(),
        free if free == plan.dimension => "the whole spatial momentum".to_owned(),
        free => format!(
            "the spatial momentum in the planes of the {free} directions along which nothing acts"
        ),
    };
    match &plan.momentum_balance {
        None => line("conserved", conserved),
        Some(balance) => line("balance", format!("{balance}; logged as the momentum drift")),
    }
    if let Some(balance) = &plan.balance {
        line("balance", format!("{balance}; logged as the energy error"));
    }
    if let Some(integral) = &plan.jacobi_integral {
        line("conserved", format!("{integral}; its change is logged as the Jacobi error"));
    }
    if !formulation.carries_attitude {
        line("attitude", "not computed: no term and no channel needs it".to_owned());
    }
    for channel in &plan.channels {
        line("channel", format!("{}: {}", channel.topic.topic(), channel.computes));
    }
    line(
        "estimate",
        format!(
            "{:.1} us a step and {:.2} s in all on one core, {:.1} MB of log",
            plan.step_ns * 1e-3,
            plan.run_s,
            plan.log_bytes as f64 / 1e6
        ),
    );
    text
}
