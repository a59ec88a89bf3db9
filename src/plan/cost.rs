//! Cost of a run: time, log, memory, chunks.
//!
//! The cost of a step is the sum of those per step, per sweep and per gradient: figures for each
//! method, number of stages and n, measured on one core of a common machine and kept in
//! `costs.json`, which `cargo bench --bench costs` writes anew when a solver has changed. The
//! numbers of sweeps and gradients are counted in the first steps. Where these were timed as well,
//! times are estimated by that: machines differ by up to eight times, and not alike in all methods.
//!
//! Invariant: estimates are finite; everything that shapes a log or ends a search depends on the
//! plan and the table alone.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use super::{EnsemblePlan, Formulation, LOG_FIXED_BYTES, Motion, Plan};
use crate::log::overview;
use crate::log::schema::{Channel, Compression, bytes_per_member, dense_bytes_per_member};
use crate::method::Integrator;
use crate::solve::composition::Composition;
use crate::solve::free_top;
use crate::solve::lanes::WIDTH;
use crate::solve::nonlinear::Rungs;
use crate::solve::so;
use crate::solve::tableau::Tableau;
use crate::solve::trajectory::Observables;

/// Work that was counted, or is expected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Number of steps.
    pub steps: f64,
    /// Number of sweeps, those of Newton's method included; for a method without sweeps, of its
    /// steps.
    pub sweeps: f64,
    /// Number of passes within sweeps: [`crate::solve::work::Work::passes`].
    #[serde(default)]
    pub passes: f64,
    /// Number of gradients of the potential, each at one attitude.
    pub gradients: f64,
    /// Number of pieces of the exact free body, beyond the first of each of its motions: the faster
    /// it turns, the more there are.
    #[serde(default)]
    pub pieces: f64,
}

/// Measurements of the first steps of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FirstSteps {
    /// Work of a step; absent where the first fails.
    pub(crate) step: Option<Counts>,
    /// Nanoseconds that it took on the machine that made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) step_ns: Option<f64>,
    /// Cost of a first step that fails: there are no others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) fails: Option<Fails>,
}

/// Cost of runs whose first step fails.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Fails {
    /// The fraction of the examined members that fail: 1 for a single run.
    pub(crate) part: f64,
    /// The nanoseconds that the step took on the machine that made it.
    pub(crate) ns: f64,
}

impl Counts {
    /// Returns the mean of `of`, if there are any.
    pub(crate) fn mean(of: &[Self]) -> Option<Self> {
        let part = |part: fn(&Self) -> f64| of.iter().map(part).sum::<f64>() / of.len() as f64;
        (!of.is_empty()).then(|| Self {
            steps: part(|work| work.steps),
            sweeps: part(|work| work.sweeps),
            passes: part(|work| work.passes),
            gradients: part(|work| work.gradients),
            pieces: part(|work| work.pieces),
        })
    }
}

/// Cost of the parts of a method.
#[derive(Clone, Copy, Debug, Deserialize)]
struct Scheme {
    step_ns: f64,
    /// Cost of a sweep without the terms of the potential.
    sweep_ns: f64,
    #[serde(default)]
    pass_ns: f64,
    /// Cost of a term here, relative to that in [`Table::terms`].
    terms: f64,
}

#[derive(Debug, Deserialize)]
struct SchemeRow {
    method: Integrator,
    /// Whether the unknowns are found by sweeps over them: for a tableau that is not
    /// symplectic, or by Newton's method alone.
    #[serde(default)]
    swept: bool,
    stages: usize,
    n: usize,
    #[serde(flatten)]
    costs: Scheme,
}

/// Cost of a gradient of one term, in nanoseconds, by its kind.
#[derive(Debug, Deserialize)]
struct TermRow {
    n: usize,
    #[serde(flatten)]
    of_kind: BTreeMap<String, f64>,
}

impl TermRow {
    /// Returns the cost of a kind; one that was not measured yet counts as the most expensive.
    fn of(&self, kind: &str) -> f64 {
        let most = || self.of_kind.values().copied().fold(0.0, f64::max);
        self.of_kind.get(kind).copied().unwrap_or_else(most)
    }
}

#[derive(Debug, Deserialize)]
struct Table {
    schemes: Vec<SchemeRow>,
    terms: Vec<TermRow>,
}

static TABLE: LazyLock<Table> = LazyLock::new(|| {
    serde_json::from_slice(include_bytes!("costs.json")).expect("a table that the bench wrote")
});

/// Returns the value at `x` on straight lines through points that ascend, in the given measure of
/// both; beyond their ends the last line goes on, and never below zero.
fn between(points: &[(f64, f64)], x: f64, measure: fn(f64) -> f64) -> f64 {
    let Some(&(_, only)) = points.first() else { return 0.0 };
    let after = points.iter().position(|&(at, _)| at >= x).unwrap_or(points.len());
    let after = after.clamp(1, points.len().max(2) - 1);
    let (Some(&(x0, y0)), Some(&(x1, y1))) = (points.get(after - 1), points.get(after)) else {
        return only;
    };
    // A value near zero has no logarithm to draw a line by.
    let part = (measure(x) - measure(x0)) / (measure(x1) - measure(x0));
    (y0 + (y1 - y0) * part).max(0.0)
}

impl Plan {
    /// Fills in the estimates of size and time, by the work of a step if it was counted, and by the nanoseconds that it
    /// took here if it was timed.
    pub(crate) fn estimate(&mut self, first: FirstSteps) {
        let FirstSteps { step: of_step, step_ns: timed_ns, fails } = first;
        let Fails { part, ns: failing_ns } = fails.unwrap_or_default();
        let compression = self.settled.log.compression;
        let n = self.dimension;
        let dense = |channel: Channel| channel.dense_bytes_per_sample(n);
        // Of each of several bodies there is one, and a frame.
        let bodies = self.bodies.len().max(1) as u64;
        let times = |channel: Channel| {
            let each = channel.is_of_each_body() || channel == Channel::Tf;
            if each { bodies } else { 1 }
        };
        let put_in = self.put_in_bytes();
        let raw: u64 = self
            .channels
            .iter()
            .map(|plan| times(plan.topic) * plan.topic.bytes_per_sample(n))
            .sum();
        let raw_dense: u64 =
            self.channels.iter().map(|plan| times(plan.topic) * dense(plan.topic)).sum();
        let (raw, raw_dense) = (raw + put_in, raw_dense + put_in);
        let in_full = self.ensemble.as_ref().map_or(1, |ensemble| ensemble.in_full.len() as u64);
        let samples = self.samples.saturating_mul(in_full) as f64;
        let mut log = LOG_FIXED_BYTES as f64
            + samples * compressed(raw, raw_dense, compression)
            + overview::bytes(self.samples, n) as f64;
        let step_ns = self.work_ns(of_step.unwrap_or_else(|| self.usual_work()));
        (self.work_step_ns, self.step_ns) = (step_ns, timed_ns.unwrap_or(step_ns));
        let (sample_ns, written_ns) = (self.sample_cost_ns(raw), self.written_ns(raw));
        let samples_ns = self.samples as f64 * sample_ns;
        // A knot of a table ends a step, and makes two of it. Samples of a control that each step has are in the work of the
        // first.
        let steps = self.steps as f64;
        let knots = self.model.knots_within(steps * self.step_s, self.step_s);
        let in_each = self.model.control.knots_within(steps * self.step_s, self.step_s);
        let counted = of_step.is_some() && in_each >= steps;
        let steps = steps + if counted { knots - in_each } else { knots };
        let run_ns = |step_ns: f64| START_NS + steps * step_ns + samples_ns;
        self.work_s = 1e-9 * run_ns(step_ns);
        self.run_s = 1e-9 * (part * failing_ns + (1.0 - part) * run_ns(self.step_ns));
        self.samples_per_chunk =
            samples_per_chunk(raw, 1e-9 * (self.every as f64 * step_ns + sample_ns));
        let mut kept = 0.0;
        let mut chunks = samples / self.samples_per_chunk as f64;
        if let Some(ensemble) = &mut self.ensemble {
            let points = ensemble.waypoints(self.samples);
            let several = self.bodies.len() as u64;
            let end_bytes = bytes_per_member(n, several, points);
            let dense = dense_bytes_per_member(n, several, points);
            let members = ensemble.members as f64;
            log += members * compressed(end_bytes, dense, compression);
            // The samples of the other members are looked at and not written; each begins and ends
            // once.
            let looked_at_ns = self.samples as f64 * (sample_ns - written_ns);
            let ends_ns = bodies as f64 * (10_000.0 + 30.0 * libm::pow(n as f64, 3.0));
            let member_s = |step_ns: f64| 1e-9 * (steps * step_ns + looked_at_ns + ends_ns);
            let others = members - in_full as f64;
            self.work_s = in_full as f64 * self.work_s + others * member_s(step_ns);
            let each_s = part * 1e-9 * failing_ns + (1.0 - part) * member_s(self.step_ns);
            self.run_s = in_full as f64 * self.run_s + others * each_s;
            ensemble.members_per_chunk = samples_per_chunk(end_bytes, member_s(step_ns));
            chunks += members / ensemble.members_per_chunk as f64;
            kept = members * EnsemblePlan::KEPT_BYTES;
        }
        self.run_s += 1e-9 * LOG_NS;
        self.log_bytes = log as u64;
        self.memory_bytes = (self.memory(raw) + kept + chunks * CHUNK_INDEX_BYTES) as u64;
    }

    /// Returns the plan as a log holds it: with the times of a common machine in the place of those
    /// of this one, because logs have the same bytes wherever they are made.
    pub fn on_a_common_machine(&self) -> Self {
        let run_s = self.work_s + 1e-9 * LOG_NS;
        Self { step_ns: self.work_step_ns, run_s, ..self.clone() }
    }

    /// Returns about what `work` costs, in nanoseconds.
    pub(crate) fn work_ns(&self, work: Counts) -> f64 {
        /// Cost of a step that keeps the state.
        const AT_REST_NS: f64 = 5.0;
        /// Cost in a plane, relative to that in three dimensions.
        const IN_PLANE: f64 = 0.7;
        const PIECE_NS: f64 = 70.0;
        if !self.bodies.is_empty() {
            return self.work_of_bodies_ns(work);
        }
        let part = match self.formulation.motion {
            Motion::AtRest => return work.steps * AT_REST_NS,
            Motion::InPlane => IN_PLANE,
            Motion::General => 1.0,
        };
        let Scheme { step_ns, sweep_ns, pass_ns, terms } = self.scheme();
        let [driven_gradient_ns, driven_stage_ns] = self.driven_ns();
        let gradient_ns = terms * self.terms_cost_ns() + driven_gradient_ns;
        let step_ns = step_ns + driven_stage_ns * self.formulation.stages as f64;
        let parts = [
            work.steps * step_ns,
            work.sweeps * sweep_ns,
            work.passes * pass_ns,
            work.gradients * gradient_ns,
            work.pieces * PIECE_NS,
            work.steps * self.derivatives_ns(),
        ];
        part * parts.iter().sum::<f64>()
    }

    /// Returns the bytes of a sample for the energy and momentum put in, in a driven scene, and for
    /// its Jacobi integral.
    fn put_in_bytes(&self) -> u64 {
        /// The size of a tag and eight bytes.
        const DOUBLE: u64 = 9;
        let logged = |topic| self.channels.iter().any(|plan| plan.topic == topic);
        let mut bytes = 0;
        if self.model.is_driven() && logged(Channel::Energy) {
            bytes += DOUBLE * (1 + u64::from(self.jacobi_integral.is_some()));
        }
        if !self.model.torques.is_empty() && logged(Channel::Momentum) {
            bytes += 4 + 8 * so::dimension(self.dimension) as u64;
        }
        if logged(Channel::Pointing) && logged(Channel::Tf) {
            // Another frame.
            bytes += Channel::Tf.bytes_per_sample(self.dimension);
        }
        if self.model.control.is_disturbed() {
            let channels = [Channel::Momentum, Channel::Control];
            let with = channels.into_iter().filter(|&topic| logged(topic)).count() as u64;
            bytes += with * (4 + 8 * so::dimension(self.dimension) as u64);
        }
        bytes
    }

    /// Returns about what a driven body, or one with wheels, costs in addition: in a gradient, and at a stage once a step.
    fn driven_ns(&self) -> [f64; 2] {
        const STAGE_NS: f64 = 250.0;
        const PART_NS: f64 = 60.0;
        /// In lanes (`cargo bench -p vpd-solve --bench ratios -- driven`).
        const GRADIENT_IN_LANES_NS: f64 = 14.0;
        let disturbed = usize::from(self.model.control.is_disturbed());
        // Not measured: taken to cost what a term does, which is more.
        let faces = self.model.faces();
        let parts = self.model.driven.len() + self.model.torques.len() + disturbed + faces;
        if parts == 0 && self.model.wheels.is_none() {
            return [0.0; 2];
        }
        let in_vectors = self.dimension == 3 && self.formulation.method.is_explicit();
        if self.is_in_lanes() || in_vectors {
            let gradient = GRADIENT_IN_LANES_NS * (1.0 + faces as f64);
            return [gradient, PART_NS * (0.5 + parts as f64)];
        }
        let n = self.dimension as f64;
        let look = STAGE_NS + PART_NS * parts as f64 + 2.0 * n * n * n;
        [look, look]
    }

    /// Returns about what the derivatives of a step cost, by the number of equations that are factored.
    fn derivatives_ns(&self) -> f64 {
        const EQUATION_NS: f64 = 250.0;
        const FACTOR_NS: f64 = 0.7;
        if self.settled.derivatives.is_none() {
            return 0.0;
        }
        let stages = self.formulation.stages as f64;
        // In vectors and lanes (`cargo test --release the_derivative_costs -- --ignored --nocapture`).
        if self.dimension == 3 && self.formulation.stages <= WIDTH {
            return 300.0 + stages * (550.0 + 50.0 * stages);
        }
        let equations = (2.0 * stages + 2.0) * so::dimension(self.dimension) as f64;
        EQUATION_NS * equations + FACTOR_NS * equations * equations * equations
    }

    /// Returns about which part of the time of a run by itself a member of an ensemble takes, where up to eight go side by side in
    /// lanes; one where they do not (`cargo bench -p vpd-solve --bench ratios -- ensembles explicit_ensembles`).
    pub(crate) fn part_of_member(&self, members: u64) -> f64 {
        /// By the number of stages.
        const OF_VPD: [f64; 4] = [0.14, 0.23, 0.4, 0.55];
        const EXPLICIT: f64 = 0.26;
        let Formulation { method, stages, .. } = self.formulation;
        let side_by_side = match method {
            _ if self.dimension != 3 || self.settled.scene.control.is_some() => 1.0,
            Integrator::Vpd => OF_VPD.get(stages - 1).copied().unwrap_or(1.0),
            Integrator::Splitting => EXPLICIT,
            method if method.is_explicit() => EXPLICIT,
            _ => 1.0,
        };
        // Lanes without a member take their time, too.
        let filled = members.min(WIDTH as u64) as f64 / WIDTH as f64;
        (side_by_side / filled).min(1.0)
    }

    /// Is a step computed in lanes of n = 3? More stages than lanes are computed as for general n.
    fn is_in_lanes(&self) -> bool {
        let Formulation { method, stages, .. } = self.formulation;
        let lanes = method != Integrator::VpdAdaptive && method.costs_as().facts().lanes;
        lanes && self.dimension == 3 && stages <= WIDTH
    }

    /// Returns the pieces of a step of `splitting` beyond the first of each free part, as the body
    /// turns at the start.
    fn usual_pieces(&self) -> f64 {
        let Formulation { method: Integrator::Splitting, order, .. } = self.formulation else {
            return 0.0;
        };
        if !self.bodies.is_empty() {
            return 0.0;
        }
        let (inverse, momentum) = self.model.in_principal_axes();
        let spread = self.asked.ensemble.as_ref().map_or(0.0, |members| members.momentum_spread);
        let momentum = momentum.map(|x| x.abs() + spread);
        let pieces = |part: &f64| free_top::pieces(&inverse, &momentum, part * self.step_s) - 1.0;
        let parts = Composition::new(order);
        parts.map_or(0.0, |composition| composition.parts().iter().map(pieces).sum())
    }

    /// Returns the work assumed for a step whose sweeps were not counted.
    fn usual_work(&self) -> Counts {
        /// Passes in a sweep, for a method that has them.
        const PASSES_OF_SWEEP: f64 = 1.5;
        let Formulation { method, stages, .. } = self.formulation;
        let sweeps = method.facts().sweeps[usize::from(self.dimension != 3)];
        let (passes, gradients) = (PASSES_OF_SWEEP * sweeps, sweeps * stages as f64);
        Counts { steps: 1.0, sweeps, passes, gradients, pieces: self.usual_pieces() }
    }

    /// Returns about what one sweep over all stages costs with all that belongs to it, in
    /// nanoseconds; for a method without sweeps, a step.
    pub fn sweep_cost_ns(&self) -> f64 {
        let Counts { sweeps, passes, gradients, pieces, .. } = self.usual_work();
        let steps = if sweeps == 1.0 { 1.0 } else { 0.0 };
        let (passes, gradients) = (passes / sweeps, gradients / sweeps);
        self.work_ns(Counts { steps, sweeps: 1.0, passes, gradients, pieces }).max(1.0)
    }

    /// Returns the same for adaptive steps, by a Gauss tableau of `stages` stages.
    pub(crate) fn own_sweep_cost_ns(&self, stages: usize) -> f64 {
        let Some(tableau) = Tableau::gauss(stages) else { return self.sweep_cost_ns() };
        let mut adapting = self.clone();
        adapting.model.tableau = tableau;
        let formulation = &mut adapting.formulation;
        (formulation.method, formulation.stages) = (Integrator::VpdAdaptive, stages);
        adapting.sweep_cost_ns()
    }

    /// Returns the cost of the method's parts with this number of stages, in this dimension.
    fn scheme(&self) -> Scheme {
        let Formulation { method, stages, .. } = self.formulation;
        let in_lanes = self.is_in_lanes();
        let method = method.costs_as();
        let general = method.facts().lanes && !in_lanes;
        let tableau = &self.model.tableau;
        let by_sweeps =
            stages > WIDTH || !tableau.is_symplectic() || self.model.stop.rungs == Rungs::Newton;
        let of_method = |swept: bool| {
            let row_fits = move |row: &&SchemeRow| {
                row.method == method && row.swept == swept && !(general && row.n == 3)
            };
            TABLE.schemes.iter().filter(row_fits).collect::<Vec<_>>()
        };
        let mut rows = of_method(by_sweeps && !in_lanes);
        if rows.is_empty() {
            rows = of_method(false);
        }
        // A method that was not measured yet counts as one of the most expensive.
        if rows.is_empty() {
            let dear = |row: &&SchemeRow| row.method == Integrator::VpdLagrangian && !row.swept;
            rows = TABLE.schemes.iter().filter(dear).collect();
        }
        let n = self.dimension as f64;
        let mut counts: Vec<usize> = rows.iter().map(|row| row.stages).collect();
        counts.sort_unstable();
        counts.dedup();
        let at = |stages: usize| {
            let line = rows.iter().filter(|row| row.stages == stages);
            let part = |of: fn(&Scheme) -> f64| {
                let points: Vec<(f64, f64)> =
                    line.clone().map(|row| (row.n as f64, of(&row.costs))).collect();
                between(&points, n, libm::log)
            };
            [
                part(|costs| costs.step_ns),
                part(|costs| costs.sweep_ns),
                part(|costs| costs.pass_ns),
                part(|costs| costs.terms),
            ]
        };
        let lines: Vec<(f64, [f64; 4])> =
            counts.into_iter().map(|count| (count as f64, at(count))).collect();
        let [step_ns, sweep_ns, pass_ns, terms] = std::array::from_fn(|part| {
            let points: Vec<(f64, f64)> =
                lines.iter().map(|(count, costs)| (*count, costs[part])).collect();
            between(&points, stages as f64, |x| x)
        });
        Scheme { step_ns, sweep_ns, pass_ns, terms }
    }

    /// Returns about what the gradient of the potential costs at a single attitude.
    fn terms_cost_ns(&self) -> f64 {
        let n = self.dimension as f64;
        let mut kinds: BTreeMap<&str, f64> = BTreeMap::new();
        for term in &self.model.terms {
            *kinds.entry(term.kind()).or_default() += 1.0;
        }
        let of_one = |kind: &str| {
            let points: Vec<(f64, f64)> =
                TABLE.terms.iter().map(|row| (row.n as f64, row.of(kind))).collect();
            between(&points, n, libm::log)
        };
        kinds.into_iter().map(|(kind, count)| count * of_one(kind)).sum()
    }

    /// Returns about what a sample of `raw` bytes costs: its figures, its messages and its part of
    /// a compressed chunk.
    fn sample_cost_ns(&self, raw: u64) -> f64 {
        let n = self.dimension as f64;
        let matrix_ns = if self.dimension == 3 { 200.0 } else { 50.0 * n * n };
        let Observables { energy, orthogonality, sigma_min, .. } = self.observables();
        let of = |asked: bool, count: f64| if asked { count } else { 0.0 };
        let Formulation { method, stages, .. } = self.formulation;
        let singular = method.interpolates() && self.formulation.motion != Motion::AtRest;
        let matrices = of(orthogonality, 1.0) + of(sigma_min && singular, 1.0 + stages as f64);
        self.written_ns(raw) + matrices * matrix_ns + of(energy, 0.5) * self.terms_cost_ns()
    }

    /// Returns about what it costs to write `raw` bytes of a sample. Bytes that repeat are
    /// compressed in half the time.
    fn written_ns(&self, raw: u64) -> f64 {
        let part = if self.formulation.motion == Motion::AtRest { 0.5 } else { 1.0 };
        part * WRITTEN_BYTE_NS * raw as f64
    }

    /// Returns the memory of a run in addition to that of its members.
    fn memory(&self, sample_bytes: u64) -> f64 {
        let n = self.dimension as f64;
        // The program with its charts, and the two parts of a chunk, before and after compression.
        const RUN_BYTES: f64 = 14e6;
        let overview = overview::bytes(self.samples, self.dimension) as f64;
        let chunk = 2.0 * (self.samples_per_chunk * sample_bytes) as f64;
        // Terms are held as JSON, as numbers, and in the form that the threads compute with.
        let terms = self.model.terms.len() as f64 * (2_000.0 + 16.0 * 8.0 * n * n);
        RUN_BYTES + overview + chunk + terms
    }
}

/// Cost of a run before its first steps reach their usual speed.
const START_NS: f64 = 5_000.0;
/// Cost of beginning and ending a log: files, charts, and the disk that has to have it.
const LOG_NS: f64 = 3e6;
/// Cost of a byte of a sample on its way into the log: 700 of them take 5.9 us,
/// `docs/performance.md`.
const WRITTEN_BYTE_NS: f64 = 8.0;
/// Memory that the writer keeps of a chunk until the log is finished.
const CHUNK_INDEX_BYTES: f64 = 350.0;

impl EnsemblePlan {
    /// Memory that is kept of a member until all have ended: its figures.
    const KEPT_BYTES: f64 = 40.0;
}

/// Returns about how many bytes `raw` bytes compress to, `dense` of them numbers whose digits are
/// unpredictable.
fn compressed(raw: u64, dense: u64, compression: Compression) -> f64 {
    let (of_dense, of_rest) = match compression {
        Compression::Zstd => (0.98, 0.5),
        Compression::Lz4 => (1.0, 0.6),
        Compression::None => (1.0, 1.0),
    };
    dense as f64 * of_dense + (raw - dense) as f64 * of_rest
}

/// Returns the number of samples of `sample_bytes` bytes, each computed in `sample_s` seconds, in a
/// chunk of the log. A chunk is what a viewer fetches at once, and what a kill costs:
/// `docs/decisions/0004-the-log-is-the-checkpoint.md`.
fn samples_per_chunk(sample_bytes: u64, sample_s: f64) -> u64 {
    const USUAL_BYTES: u64 = 512 << 10;
    // An estimate may be wrong by a few times: a chunk is promised to take at most 15 s.
    const MOST_S: f64 = 3.0;
    let in_time = (MOST_S / sample_s) as u64;
    (USUAL_BYTES / sample_bytes.max(1)).min(in_time).max(1)
}

#[cfg(test)]
mod tests {
    use super::TABLE;
    use crate::method::Integrator;

    #[test]
    fn each_method_that_is_chosen_by_its_costs_has_its_own() {
        for method in Integrator::tried(false).map(|(method, _)| method.costs_as()) {
            let has_row = TABLE.schemes.iter().any(|row| row.method == method);
            assert!(has_row, "{}: cargo bench --bench costs", method.as_str());
        }
    }
}
