//! What a run costs: time, log, memory, chunks.
//!
//! Measured with `cargo bench --bench costs`, on one core of a common machine; a figure that was fitted to its table is
//! good to a third, and a run whose sweeps were counted to about a half.
//!
//! Invariant: estimates are finite and depend on the plan alone.

use super::{EnsemblePlan, LOG_FIXED_BYTES, Plan};
use crate::log::schema::{Channel, bytes_per_member, dense_bytes_per_member};
use crate::log::writer::Compression;
use crate::scenario::{MethodName, PotentialTerm};
use crate::solve::lanes::WIDTH;

/// Stages up to which numbers go in four lanes.
const FEW_STAGES: f64 = 4.0;

impl Plan {
    /// Fills in the estimates of size and time, by the sweeps of a step if they were counted.
    pub(crate) fn estimate(&mut self, compression: Compression, sweeps: Option<f64>) {
        let n = self.dimension;
        let dense = |channel: Channel| channel.dense_bytes_per_sample(n);
        let raw: u64 = self.channels.iter().map(|plan| plan.topic.bytes_per_sample(n)).sum();
        let raw_dense: u64 = self.channels.iter().map(|plan| dense(plan.topic)).sum();
        let in_full = self.ensemble.as_ref().map_or(1, |ensemble| ensemble.in_full.len() as u64);
        let samples = self.samples.saturating_mul(in_full) as f64;
        let mut log = LOG_FIXED_BYTES as f64 + samples * compressed(raw, raw_dense, compression);
        self.step_ns = self.step_cost_ns(sweeps);
        let sample_ns = self.sample_cost_ns(raw);
        let steps_ns = self.steps as f64 * self.step_ns;
        let mut run_ns = steps_ns + self.samples as f64 * sample_ns;
        self.samples_per_chunk =
            samples_per_chunk(raw, 1e-9 * (self.every as f64 * self.step_ns + sample_ns));
        let mut kept = 0.0;
        let mut chunks = samples / self.samples_per_chunk as f64;
        if let Some(ensemble) = &mut self.ensemble {
            let end_bytes = bytes_per_member(n);
            let members = ensemble.members as f64;
            log += members * compressed(end_bytes, dense_bytes_per_member(n), compression);
            // Of the others samples are looked at and not written; each begins and ends once.
            let looked_at_ns = self.samples as f64 * (sample_ns - WRITTEN_BYTE_NS * raw as f64);
            let member_ns = steps_ns + looked_at_ns + 10_000.0 + 30.0 * libm::pow(n as f64, 3.0);
            run_ns = in_full as f64 * run_ns + (members - in_full as f64) * member_ns;
            ensemble.members_per_chunk = samples_per_chunk(end_bytes, 1e-9 * member_ns);
            chunks += members / ensemble.members_per_chunk as f64;
            kept = members * EnsemblePlan::KEPT_BYTES;
        }
        self.log_bytes = log as u64;
        self.run_s = 1e-9 * run_ns;
        self.memory_bytes = (self.memory(raw) + kept + chunks * CHUNK_INDEX_BYTES) as u64;
    }

    /// About what a step costs, in nanoseconds.
    fn step_cost_ns(&self, sweeps: Option<f64>) -> f64 {
        use MethodName as M;
        let sweeps = |usual: f64| sweeps.unwrap_or(usual);
        let space = self.dimension == 3 && self.formulation.stages <= WIDTH;
        let count = match self.formulation.method {
            // The first guess is worth a sweep and a half; what follows is cheaper than it.
            M::VpdReduced if space => 0.3 + 0.9 * sweeps(1.0),
            M::Auto | M::Vpd if space => 1.46 + 0.39 * sweeps(4.2),
            M::VpdReduced => sweeps(3.0),
            M::Auto | M::Vpd | M::VpdLagrangian | M::Vrkmk | M::VrkmkProjected => 0.5 + sweeps(5.5),
            // What each step begins and ends with.
            M::QuaternionGauss => return 500.0 + sweeps(5.0) * self.sweep_cost_ns(),
            M::Rkmk | M::Rk | M::RkProjected | M::Splitting | M::Lgvi => 1.0,
        };
        count * self.sweep_cost_ns()
    }

    /// About what a sweep over all stages costs, or a whole step where there are no sweeps or each is short
    /// (lgvi), in nanoseconds.
    pub(crate) fn sweep_cost_ns(&self) -> f64 {
        use MethodName as M;
        let n = self.dimension as f64;
        let stages = self.formulation.stages as f64;
        let space = self.dimension == 3 && self.formulation.stages <= WIDTH;
        // Between n^2 and n^3: products are quicker the larger they are.
        let size = libm::pow(n / 4.0, 2.75);
        let galerkin = 500.0 * (1.6 + stages) * size;
        let gradient = self.gradient_cost_ns();
        match self.formulation.method {
            // In four lanes or in eight, all stages at once.
            M::Auto | M::Vpd | M::VpdReduced if space => {
                let base = if stages <= FEW_STAGES { 342.0 } else { 1172.0 };
                base + self.terms_cost_ns(|term| match term {
                    PotentialTerm::Uniform(_) => 6.0,
                    PotentialTerm::GravityGradient(_) => 8.0,
                    PotentialTerm::PointSource(_) | PotentialTerm::Spring(_) => 11.0,
                })
            }
            M::Auto | M::Vpd | M::VpdReduced => galerkin + stages * gradient,
            M::VpdLagrangian => {
                // A dense inverse for each step.
                let coordinates = 0.5 * n * (n - 1.0);
                1.4 * galerkin + 0.25 * libm::pow(coordinates, 3.0) + stages * gradient
            }
            M::Vrkmk | M::VrkmkProjected if self.dimension == 3 => {
                stages * (132.0 + 50.0 * stages + gradient)
            }
            M::Vrkmk | M::VrkmkProjected => stages * ((1000.0 + 60.0 * stages) * size + gradient),
            M::Rkmk => stages * (400.0 * size + gradient),
            M::Rk => stages * (20.0 + 0.9 * n * n * n + gradient),
            M::RkProjected => 1500.0 * size + stages * (20.0 + 0.9 * n * n * n + gradient),
            M::Splitting | M::Lgvi => stages * (186.0 + gradient),
            M::QuaternionGauss => stages * (45.0 + gradient),
        }
    }

    /// The gradient of the potential at one attitude.
    fn gradient_cost_ns(&self) -> f64 {
        let n = self.dimension as f64;
        self.terms_cost_ns(|term| match term {
            PotentialTerm::Uniform(_) => 0.85 * n * n,
            PotentialTerm::GravityGradient(_) => 0.85 * n * n + 2.5 * n,
            PotentialTerm::PointSource(_) | PotentialTerm::Spring(_) => 0.85 * n * n + 3.5 * n,
        })
    }

    fn terms_cost_ns(&self, cost: impl Fn(&PotentialTerm) -> f64) -> f64 {
        self.model.terms.iter().map(cost).sum()
    }

    /// About what a sample of so many bytes costs: its figures, its messages and its part of a compressed chunk.
    fn sample_cost_ns(&self, raw: u64) -> f64 {
        let n = self.dimension as f64;
        let eigenvalues = if self.dimension == 3 { 100.0 } else { 10.0 * n * n * n };
        let of = |channel: Channel, count: f64| if self.logs(channel) { count } else { 0.0 };
        let matrices = of(Channel::Orthogonality, 1.0)
            + of(Channel::Solver, 1.0 + self.formulation.stages as f64);
        WRITTEN_BYTE_NS * raw as f64
            + matrices * eigenvalues
            + of(Channel::Energy, 0.5) * self.gradient_cost_ns()
    }

    /// What a run takes of the memory beside its members.
    fn memory(&self, sample_bytes: u64) -> f64 {
        let n = self.dimension as f64;
        // The program with its charts and the two parts of a chunk, before and after compression.
        const RUN_BYTES: f64 = 14e6;
        let chunk = 2.0 * (self.samples_per_chunk * sample_bytes) as f64;
        // As JSON, as numbers and as what the threads compute with.
        let terms = self.model.terms.len() as f64 * (2_000.0 + 16.0 * 8.0 * n * n);
        RUN_BYTES + chunk + terms
    }
}

/// What a byte of a sample costs on its way into the log: 700 of them take 5.9 us, `docs/performance.md`.
const WRITTEN_BYTE_NS: f64 = 8.0;
/// What the writer keeps of a chunk until the log is finished.
const CHUNK_INDEX_BYTES: f64 = 350.0;

impl EnsemblePlan {
    /// What is kept of a member until all have ended: its figures.
    const KEPT_BYTES: f64 = 40.0;
}

/// About what is left of so many bytes, `dense` of them numbers whose digits nobody can guess.
fn compressed(raw: u64, dense: u64, compression: Compression) -> f64 {
    let (of_dense, of_rest) = match compression {
        Compression::Zstd => (0.98, 0.5),
        Compression::Lz4 => (1.0, 0.6),
        Compression::None => (1.0, 1.0),
    };
    dense as f64 * of_dense + (raw - dense) as f64 * of_rest
}

/// Samples of so many bytes, each of which takes so long to compute, in a chunk of the log. A chunk is what a
/// viewer fetches at once, and what a kill costs: `docs/decisions/0004-the-log-is-the-checkpoint.md`.
fn samples_per_chunk(sample_bytes: u64, sample_s: f64) -> u64 {
    const USUAL_BYTES: u64 = 512 << 10;
    // An estimate may be wrong by a few times: a chunk is promised to take at most 15 s.
    const MOST_S: f64 = 3.0;
    let in_time = (MOST_S / sample_s) as u64;
    (USUAL_BYTES / sample_bytes.max(1)).min(in_time).max(1)
}
