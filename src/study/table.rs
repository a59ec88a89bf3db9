//! The one table of all studies.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Entry;
use super::measure::{End, Measured};

/// One run. Figures that were not measured are absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Row {
    /// The method's name in a scenario.
    pub method: String,
    /// Its tableau, or the order of a composition.
    pub tableau: String,
    /// Its order.
    pub order: u32,
    /// The solver that made the last step, or that was asked for.
    pub solver: String,
    /// The step in seconds.
    pub step_s: f64,
    /// Steps made.
    pub steps: u64,
    /// Error of attitude and momentum at the end, against the reference.
    pub error: Option<f64>,
    /// Largest |H - H0| over the run, J.
    pub energy_error: Option<f64>,
    /// Largest spectral norm of g g^T - I over the run.
    pub orthogonality_error: Option<f64>,
    /// Mean number of sweeps of the nonlinear solver.
    pub iterations_per_step: Option<f64>,
    /// Gradients of the potential taken over the run; 0 for a free body.
    pub force_evaluations: u64,
    /// Time in the integrator for a step, least over the repeats. The one column that does not
    /// repeat.
    pub ns_per_step: Option<f64>,
    /// `succeeded`, `blew_up`, a class of the stability map, or the failure code.
    pub outcome: String,
    /// The step that failed, counted from 1.
    pub failed_step: Option<u64>,
}

impl Row {
    /// Creates the row of a run.
    pub(crate) fn new(entry: &Entry, step_s: f64, run: &Measured, error: Option<f64>) -> Self {
        let solver = super::solver_word(entry.method.solver.kind);
        let name = (entry.integrator.as_str(), entry.tableau.as_str(), entry.order);
        Self::named(name, solver, step_s, run, error)
    }

    /// Creates the row of a run of a method with this name, tableau and order.
    pub(super) fn named(
        (method, tableau, order): (&str, &str, u32),
        solver: &str,
        step_s: f64,
        run: &Measured,
        error: Option<f64>,
    ) -> Self {
        let (outcome, failed_step) = match &run.end {
            End::Completed => ("succeeded", None),
            End::Cancelled => ("cancelled", None),
            End::BlewUp => ("blew_up", None),
            End::Failed(failure) => (failure.code.as_str(), Some(run.steps + 1)),
        };
        let any = (run.steps > 0).then_some(());
        Self {
            method: method.to_owned(),
            tableau: tableau.to_owned(),
            order,
            solver: run.rung.map_or(solver, |rung| rung.as_str()).to_owned(),
            step_s,
            steps: run.steps,
            error: error.filter(|_| run.completed()),
            energy_error: any.map(|()| run.energy_error()),
            orthogonality_error: any.map(|()| run.orthogonality_error()),
            iterations_per_step: any.map(|()| run.iterations as f64 / run.steps as f64),
            force_evaluations: run.force_evaluations,
            ns_per_step: None,
            outcome: outcome.to_owned(),
            failed_step,
        }
    }
}

/// The rows of a study.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Table {
    /// Rows in the order of the methods, each with its steps from the largest down.
    pub rows: Vec<Row>,
}

impl Table {
    /// Returns comma-separated values with a head line; an empty cell is a figure that was not
    /// measured.
    pub fn to_csv(&self) -> String {
        const HEAD: [&str; 14] = [
            "method",
            "tableau",
            "order",
            "solver",
            "step_s",
            "steps",
            "error",
            "energy_error",
            "orthogonality_error",
            "iterations_per_step",
            "force_evaluations",
            "ns_per_step",
            "outcome",
            "failed_step",
        ];
        let number = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:e}"));
        let rows = self.rows.iter().map(|row| {
            let Row { method, tableau, order, solver, step_s, steps, .. } = row;
            [
                method.clone(),
                tableau.clone(),
                order.to_string(),
                solver.clone(),
                format!("{step_s:e}"),
                steps.to_string(),
                number(row.error),
                number(row.energy_error),
                number(row.orthogonality_error),
                number(row.iterations_per_step),
                row.force_evaluations.to_string(),
                row.ns_per_step.map_or_else(String::new, |ns| format!("{ns:.0}")),
                row.outcome.clone(),
                row.failed_step.map_or_else(String::new, |step| step.to_string()),
            ]
        });
        let mut out = csv::Writer::from_writer(Vec::new());
        for row in std::iter::once(HEAD.map(str::to_owned)).chain(rows) {
            out.write_record(row).expect("memory takes what is written");
        }
        let text = out.into_inner().expect("memory takes what is written");
        String::from_utf8(text).expect("cells are text")
    }

    /// Returns JSON, an array of rows.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a table is JSON by construction")
    }
}
