//! 2 · Scenario → [`Plan`]: what will be modelled and why.
//!
//! The plan builds the mathematical objects of the scene (and refuses what is none: an attitude that is no
//! rotation, an inertia that is not positive), drops what the scene does not need, and says so.
//!
//! Invariant: a [`Plan`] can be run. What it dropped changes no number of the run but its cost.

use nalgebra::{DMatrix, DVector, Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde::Serialize;

use crate::log::schema::Channel;
use crate::log::writer::Compression;
use crate::scenario::{
    Attitude, Entry, Framed, Inertia, Method, MethodName, PotentialTerm, Scenario, ScenarioError,
    Solver, TableauChoice, TableauName,
};
use crate::solve::composition::Composition;
use crate::solve::hamiltonian::CLOSEST_APPROACH;
use crate::solve::nonlinear::StopRule;
use crate::solve::so;
use crate::solve::tableau::{Tableau, TableauError};

/// What a job will do, for people and for [`crate::run`].
#[derive(Clone, Debug, Serialize)]
pub struct Plan {
    /// n of SO(n).
    pub dimension: usize,
    /// The integrator.
    pub formulation: Formulation,
    /// The step in seconds.
    pub step_s: f64,
    /// Number of steps.
    pub steps: u64,
    /// A sample is taken every so many steps.
    pub every: u64,
    /// Number of samples of a run that ends well.
    pub samples: u64,
    /// The terms of the potential, kept and dropped.
    pub potential: Vec<TermPlan>,
    /// Directions of space that the potential leaves free; the spatial momentum among them is conserved.
    pub free_directions: usize,
    /// The channels of the log and what each costs.
    pub channels: Vec<ChannelPlan>,
    /// Samples in a chunk of the log.
    pub samples_per_chunk: u64,
    /// Estimated size of the log in bytes.
    pub log_bytes: u64,
    /// Estimated cost of a step in nanoseconds, on one core of a common machine.
    pub step_ns: f64,
    /// Estimated time of the run in seconds.
    pub run_s: f64,
    #[serde(skip)]
    pub(crate) model: Model,
}

/// The integrator and the reason for it.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Formulation {
    /// Its name in a scenario.
    pub method: MethodName,
    /// The tableau's name, or `custom`; absent for a composition.
    pub tableau: Option<String>,
    /// Number of stages, of a composition of substeps.
    pub stages: usize,
    /// Order of the scheme.
    pub order: u32,
    /// Is the attitude computed? Only where a term of the potential or a channel needs it.
    pub carries_attitude: bool,
    /// Why it was chosen.
    pub why: &'static str,
}

/// What becomes of one term of the potential.
#[derive(Clone, Debug, Serialize)]
pub struct TermPlan {
    /// JSON pointer of the term.
    pub pointer: String,
    /// Is it modelled?
    pub kept: bool,
    /// Why, or why not.
    pub why: &'static str,
}

/// One channel of the log.
#[derive(Clone, Debug, Serialize)]
pub struct ChannelPlan {
    /// Its topic.
    pub topic: Channel,
    /// What is computed for it at each sample.
    pub computes: &'static str,
}

/// The mathematical objects of the scene, of runtime size; [`crate::run`] gives them their const size.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub(crate) kinetic: ModelKinetic,
    /// The terms kept, every default filled in.
    pub(crate) terms: Vec<PotentialTerm>,
    /// The sum of the terms that do not depend on the attitude.
    pub(crate) constant: f64,
    /// n x n, a rotation to 1e-8.
    pub(crate) attitude: DMatrix<f64>,
    /// n x n, skew, in the body frame.
    pub(crate) momentum: DMatrix<f64>,
    pub(crate) tableau: Tableau,
    pub(crate) stop: StopRule,
}

/// How velocity follows from momentum.
#[derive(Clone, Debug)]
pub(crate) enum ModelKinetic {
    /// `Omega_ij = w_ij mu_ij`.
    Principal { weights: DMatrix<f64> },
    /// n = 3: the inertia matrix.
    Tensor { inertia: Matrix3<f64> },
}

impl Plan {
    /// Plans a scenario.
    ///
    /// # Errors
    /// Where the numbers make no body, no rotation or no tableau, with the pointer of the field.
    pub fn new(scenario: &Scenario) -> Result<Self, ScenarioError> {
        let n = scenario.dimension();
        let inertia = inertia_matrix(&scenario.scene.inertia);
        let kinetic = kinetic(&scenario.scene.inertia, &inertia)?;
        let attitude = attitude(scenario.scene.initial.attitude.as_ref(), n)?;
        let momentum = momentum(scenario, &kinetic, &attitude);
        let choice = tableau_choice(&scenario.method);
        let tableau = tableau(&choice, &scenario.method)?;
        let Solver { tolerance, max_iterations, .. } = scenario.method.solver;
        let mut plan = Self {
            dimension: n,
            formulation: Formulation::default(),
            step_s: scenario.step_s,
            steps: scenario.step_count(),
            every: scenario.sample_every(),
            samples: 0,
            potential: Vec::new(),
            free_directions: n,
            channels: channels(scenario),
            samples_per_chunk: 0,
            log_bytes: 0,
            step_ns: 0.0,
            run_s: 0.0,
            model: Model {
                kinetic,
                terms: Vec::new(),
                constant: 0.0,
                attitude,
                momentum,
                tableau,
                stop: StopRule { tolerance, max_iterations },
            },
        };
        plan.samples = 1 + plan.steps.div_ceil(plan.every);
        for (index, term) in scenario.scene.potential.iter().enumerate() {
            plan.add_term(format!("/scene/potential/{index}"), term, &inertia)?;
        }
        plan.formulation = plan.formulate(scenario)?;
        if !plan.formulation.carries_attitude {
            let momentum = plan.channels.iter_mut().find(|plan| plan.topic == Channel::Momentum);
            if let Some(channel) = momentum {
                channel.computes = "how far the body momentum leaves its coadjoint orbit";
            }
        }
        plan.free_directions = free_directions(n, &plan.model.terms);
        plan.estimate(scenario.log.compression);
        Ok(plan)
    }

    /// Is the channel logged?
    pub fn logs(&self, channel: Channel) -> bool {
        self.channels.iter().any(|plan| plan.topic == channel)
    }

    /// Keeps a term, or drops it if it does not depend on the attitude.
    fn add_term(
        &mut self,
        pointer: String,
        term: &PotentialTerm,
        inertia: &DMatrix<f64>,
    ) -> Result<(), ScenarioError> {
        let (constant, why) = match constant_part(term, inertia) {
            Some((value, why)) => (Some(value), why),
            None => (None, "depends on the attitude"),
        };
        if let Some((body_point, position)) = singular_points(term) {
            let (y, z) =
                (DVector::from_column_slice(body_point), DVector::from_column_slice(position));
            let distance = (&y - self.model.attitude.tr_mul(&z)).norm();
            if !(distance > CLOSEST_APPROACH * (y.norm() + z.norm())) {
                let message = format!(
                    "lies on `position` at the start (distance {distance:e}); the potential is singular there"
                );
                return Err(ScenarioError::invalid(format!("{pointer}/body_point"), message));
            }
        }
        match constant {
            Some(value) => self.model.constant += value,
            None => self.model.terms.push(with_matrix(term, inertia)),
        }
        self.potential.push(TermPlan { pointer, kept: constant.is_none(), why });
        Ok(())
    }

    /// Chooses the integrator.
    fn formulate(&self, scenario: &Scenario) -> Result<Formulation, ScenarioError> {
        let free = self.model.terms.is_empty();
        let asked = scenario.method.name;
        if asked == MethodName::VpdReduced && !free {
            let term =
                self.potential.iter().find(|term| term.kept).map_or("", |term| &term.pointer);
            let message =
                format!("vpd_reduced is for free bodies, but {term} depends on the attitude");
            return Err(ScenarioError::invalid("/method/name", message));
        }
        let (method, why) = match asked {
            MethodName::Auto if free => (
                MethodName::VpdReduced,
                "no term depends on the attitude, so the momentum moves by itself",
            ),
            MethodName::Auto => (
                MethodName::Vpd,
                "symplectic, on the group to round-off, of the tableau's order, for any potential",
            ),
            method => (method, "asked for"),
        };
        let shown = [Channel::State, Channel::Orthogonality, Channel::Tf];
        let carries_attitude =
            method != MethodName::VpdReduced || shown.into_iter().any(|channel| self.logs(channel));
        let tableau = &self.model.tableau;
        let (name, stages, order) = match (scenario.method.order.unwrap_or(4), method) {
            (order, method) if method.is_composition() => (
                None,
                Composition::new(order).map_or(1, |composition| composition.parts().len()),
                order,
            ),
            (_, method) if method.is_explicit() => {
                (tableau_name(scenario), tableau.stages(), tableau.classical_order())
            }
            _ => (tableau_name(scenario), tableau.stages(), tableau.order()),
        };
        Ok(Formulation { method, tableau: name, stages, order, carries_attitude, why })
    }

    /// Fills in the estimates of size and time.
    fn estimate(&mut self, compression: Compression) {
        let n = self.dimension;
        let raw: u64 = self.channels.iter().map(|plan| plan.topic.bytes_per_sample(n)).sum();
        // Measured on the dipole with all channels.
        let ratio = match compression {
            Compression::Zstd => 0.6,
            Compression::Lz4 => 0.7,
            Compression::None => 1.0,
        };
        const FIXED: u64 = 40_000;
        self.log_bytes = FIXED + (self.samples as f64 * raw as f64 * ratio) as u64;
        // Chunks of half a mebibyte: what a kill may cost, and what a viewer fetches at once.
        const CHUNK: u64 = 1 << 19;
        self.samples_per_chunk = (CHUNK / raw.max(1)).max(1);
        self.step_ns = self.step_cost_ns();
        self.run_s = self.steps as f64 * self.step_ns * 1e-9;
    }

    /// About what a step costs on one core of a common machine, in nanoseconds: measured on the dipole
    /// at h = 0.01, where implicit methods take ten sweeps, and scaled to other n by the size of a product.
    fn step_cost_ns(&self) -> f64 {
        let stages = self.formulation.stages as f64;
        let size = (self.dimension as f64 / 3.0).powi(3).max(1.0);
        match self.formulation.method {
            MethodName::Auto | MethodName::Vpd | MethodName::VpdReduced => {
                1400.0 * (stages + 1.0) * size
            }
            MethodName::VpdLagrangian => 2000.0 * (stages + 1.0) * size,
            MethodName::Vrkmk | MethodName::VrkmkProjected => 2000.0 * stages * size,
            MethodName::Rkmk => 120.0 * stages * size,
            MethodName::Rk | MethodName::RkProjected => 60.0 * stages * size,
            MethodName::Splitting | MethodName::Lgvi => 250.0 * stages,
            MethodName::QuaternionGauss => 900.0 * stages,
        }
    }
}

fn rows(rows: &[Vec<f64>]) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), rows.len(), |i, j| rows[i][j])
}

/// The inertia matrix in body coordinates: `J = tr(D) I - D` for second moments D.
fn inertia_matrix(inertia: &Inertia) -> DMatrix<f64> {
    match inertia {
        Inertia::Principal(moments) => DMatrix::from_diagonal(&DVector::from_column_slice(moments)),
        Inertia::Matrix(matrix) => rows(matrix),
        Inertia::SecondMoments(moments) => {
            let trace: f64 = moments.iter().sum();
            DMatrix::from_diagonal(&DVector::from_iterator(
                moments.len(),
                moments.iter().map(|d| trace - d),
            ))
        }
    }
}

fn kinetic(given: &Inertia, matrix: &DMatrix<f64>) -> Result<ModelKinetic, ScenarioError> {
    // For n = 3 the plane (i, j) turns about the third axis k: d_i + d_j = J_k.
    let principal = |moments: [f64; 3]| ModelKinetic::Principal {
        weights: DMatrix::from_fn(3, 3, |i, j| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] }),
    };
    match given {
        Inertia::Principal(moments) => Ok(principal(*moments)),
        Inertia::SecondMoments(d) => {
            let n = d.len();
            let weights =
                DMatrix::from_fn(n, n, |i, j| if i == j { 0.0 } else { 1.0 / (d[i] + d[j]) });
            Ok(ModelKinetic::Principal { weights })
        }
        Inertia::Matrix(_) => {
            let pointer = "/scene/inertia/matrix";
            let smallest = matrix.symmetric_eigenvalues().min();
            if !(smallest > 1e-12 * matrix.amax() && smallest >= 1e-12) {
                let message =
                    format!("is not positive definite: its smallest eigenvalue is {smallest:e}");
                return Err(ScenarioError::invalid(pointer, message));
            }
            let diagonal = matrix.iter().enumerate().all(|(k, &x)| k % 4 == 0 || x == 0.0);
            if diagonal {
                return Ok(principal([matrix[(0, 0)], matrix[(1, 1)], matrix[(2, 2)]]));
            }
            Ok(ModelKinetic::Tensor { inertia: Matrix3::from_iterator(matrix.iter().copied()) })
        }
    }
}

fn attitude(given: Option<&Attitude>, n: usize) -> Result<DMatrix<f64>, ScenarioError> {
    // Decimal text of a rotation is off by its last digit; more than this is another matrix.
    const TOLERANCE: f64 = 1e-8;
    let from_quaternion = |w: f64, x: f64, y: f64, z: f64| {
        let rotation =
            UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
        DMatrix::from_iterator(3, 3, rotation.matrix().iter().copied())
    };
    match given {
        None => Ok(DMatrix::identity(n, n)),
        Some(Attitude::Quaternion([w, x, y, z])) => Ok(from_quaternion(*w, *x, *y, *z)),
        Some(Attitude::AxisAngle(turn)) => {
            let axis = Vector3::from(turn.axis).normalize();
            let half = 0.5 * turn.angle_rad;
            let (w, v) = (libm::cos(half), axis * libm::sin(half));
            Ok(from_quaternion(w, v.x, v.y, v.z))
        }
        Some(Attitude::Matrix(given)) => {
            let g = rows(given);
            let pointer = "/scene/initial/attitude/matrix";
            let defect = (g.transpose() * &g - DMatrix::identity(n, n)).amax();
            if !(defect <= TOLERANCE) {
                let message = format!(
                    "is not orthogonal: g^T g differs from I by {defect:e}, at most {TOLERANCE:e} is allowed"
                );
                return Err(ScenarioError::invalid(pointer, message));
            }
            if g.determinant() < 0.0 {
                let message = "is a reflection: its determinant is -1, a rotation has +1";
                return Err(ScenarioError::invalid(pointer, message));
            }
            Ok(g)
        }
    }
}

/// The skew matrix of a 3-vector or of rows.
fn skew(entries: &[Entry]) -> DMatrix<f64> {
    let numbers: Vec<f64> = entries
        .iter()
        .filter_map(|e| if let Entry::Number(x) = e { Some(*x) } else { None })
        .collect();
    if let Ok(vector) = <[f64; 3]>::try_from(numbers.as_slice()) {
        return DMatrix::from_iterator(3, 3, so::hat::<3>(&vector).iter().copied());
    }
    let given: Vec<Vec<f64>> = entries
        .iter()
        .filter_map(|e| if let Entry::Row(row) = e { Some(row.clone()) } else { None })
        .collect();
    let a = rows(&given);
    // Exactly skew: text may leave the two halves a digit apart.
    (&a - a.transpose()) * 0.5
}

/// The body momentum at the start.
fn momentum(scenario: &Scenario, kinetic: &ModelKinetic, attitude: &DMatrix<f64>) -> DMatrix<f64> {
    let in_body = |framed: &Framed| match framed {
        Framed::Body(entries) => skew(entries),
        Framed::Space(entries) => attitude.transpose() * skew(entries) * attitude,
    };
    let initial = &scenario.scene.initial;
    match (&initial.momentum, &initial.angular_velocity) {
        (Some(momentum), _) => in_body(momentum),
        (None, Some(velocity)) => {
            let omega = in_body(velocity);
            match kinetic {
                ModelKinetic::Principal { weights } => {
                    omega.zip_map(weights, |omega, w| if w == 0.0 { 0.0 } else { omega / w })
                }
                ModelKinetic::Tensor { inertia } => {
                    let mu = inertia * Vector3::new(omega[(2, 1)], omega[(0, 2)], omega[(1, 0)]);
                    DMatrix::from_iterator(3, 3, so::hat::<3>(mu.as_slice()).iter().copied())
                }
            }
        }
        (None, None) => DMatrix::zeros(attitude.nrows(), attitude.nrows()),
    }
}

/// The tableau asked for, or the method's own.
fn tableau_choice(method: &Method) -> TableauChoice {
    let usual = if method.name.is_explicit() { TableauName::Rk4 } else { TableauName::Gauss2 };
    method.tableau.clone().unwrap_or(TableauChoice::Named(usual))
}

/// The tableau's name in a scenario, or `custom`.
fn tableau_name(scenario: &Scenario) -> Option<String> {
    match tableau_choice(&scenario.method) {
        TableauChoice::Named(name) => {
            serde_json::to_value(name).ok().and_then(|v| v.as_str().map(str::to_owned))
        }
        TableauChoice::Custom(_) => Some("custom".to_owned()),
    }
}

/// The tableau, checked to be one that the method takes.
fn tableau(choice: &TableauChoice, method: &Method) -> Result<Tableau, ScenarioError> {
    let tableau = coefficients(choice)?;
    let name = method.name.as_str();
    let wrong = |message| Err(ScenarioError::invalid("/method/tableau", message));
    if method.name.is_explicit() && !tableau.is_explicit() {
        return wrong(format!("{name} is explicit; it takes rk3, rk4 or explicit coefficients"));
    }
    let gauss = Tableau::gauss(tableau.stages());
    if method.name == MethodName::QuaternionGauss && gauss.as_ref() != Some(&tableau) {
        return wrong(format!("{name} takes gauss1 to gauss8"));
    }
    Ok(tableau)
}

fn coefficients(choice: &TableauChoice) -> Result<Tableau, ScenarioError> {
    let named = |name: TableauName| match name {
        TableauName::Gauss1 => Tableau::gauss(1),
        TableauName::Gauss2 => Tableau::gauss(2),
        TableauName::Gauss3 => Tableau::gauss(3),
        TableauName::Gauss4 => Tableau::gauss(4),
        TableauName::Gauss5 => Tableau::gauss(5),
        TableauName::Gauss6 => Tableau::gauss(6),
        TableauName::Gauss7 => Tableau::gauss(7),
        TableauName::Gauss8 => Tableau::gauss(8),
        TableauName::Rk3 => Some(Tableau::rk3()),
        TableauName::Rk4 => Some(Tableau::rk4()),
    };
    match choice {
        TableauChoice::Named(name) => named(*name).ok_or_else(|| {
            ScenarioError::invalid("/method/tableau", "this tableau cannot be made")
        }),
        TableauChoice::Custom(given) => {
            Tableau::new(given.a.clone(), given.b.clone()).map_err(|error| {
                let pointer = match error {
                    TableauError::Shape { .. } => "/method/tableau/a".to_owned(),
                    TableauError::Size => "/method/tableau".to_owned(),
                    TableauError::ZeroWeight { stage, .. } => format!("/method/tableau/b/{stage}"),
                    TableauError::Inconsistent { .. } => "/method/tableau/b".to_owned(),
                };
                ScenarioError::invalid(pointer, error.to_string())
            })
        }
    }
}

fn channels(scenario: &Scenario) -> Vec<ChannelPlan> {
    use Channel as C;
    let all = [
        (C::State, "the state itself"),
        (C::Energy, "kinetic and potential energy"),
        (C::Orthogonality, "the spectral norm of g g^T - I"),
        (C::Momentum, "the spatial momentum and the drift of its conserved part"),
        (C::Solver, "the smallest singular value of the step's interpolated matrices"),
        (C::Tf, "the attitude as a quaternion"),
        (C::SceneBody, "the body's box and points, once"),
        (C::SceneSources, "sources, anchors and directions, once"),
        (C::Log, "start, warnings, diagnosis"),
    ];
    let three = scenario.dimension() == 3;
    let potential = !scenario.scene.potential.is_empty();
    let has = |channel: C| match channel {
        C::SceneSources => three && potential,
        channel => three || !channel.needs_three(),
    };
    let asked =
        |channel: C| scenario.log.channels.as_ref().is_none_or(|asked| asked.contains(&channel));
    all.into_iter()
        .filter(|&(topic, _)| has(topic) && asked(topic))
        .map(|(topic, computes)| ChannelPlan { topic, computes })
        .collect()
}

/// The value of a term that does not depend on the attitude, and the reason; `None` if it does.
fn constant_part(term: &PotentialTerm, inertia: &DMatrix<f64>) -> Option<(f64, &'static str)> {
    let zero = |v: &[f64]| v.iter().all(|&x| x == 0.0);
    let distance =
        |y: &[f64], z: &[f64]| y.iter().zip(z).map(|(y, z)| (y - z) * (y - z)).sum::<f64>().sqrt();
    const NOTHING: &str = "has no strength";
    const FIXED: &str =
        "is the same at every attitude: its body point or its place is the fixed point";
    match term {
        PotentialTerm::Uniform(t) if t.weight == 0.0 => Some((0.0, NOTHING)),
        PotentialTerm::Uniform(t) if zero(&t.body_point) => Some((0.0, FIXED)),
        PotentialTerm::PointSource(t) if t.strength == 0.0 => Some((0.0, NOTHING)),
        PotentialTerm::PointSource(t) if zero(&t.body_point) || zero(&t.position) => {
            Some((t.strength / distance(&t.body_point, &t.position), FIXED))
        }
        PotentialTerm::Spring(t) if t.stiffness == 0.0 => Some((0.0, NOTHING)),
        PotentialTerm::Spring(t) if zero(&t.body_point) || zero(&t.position) => {
            let stretch = distance(&t.body_point, &t.position) - t.rest_length;
            Some((0.5 * t.stiffness * stretch * stretch, FIXED))
        }
        PotentialTerm::GravityGradient(t) if t.strength == 0.0 => Some((0.0, NOTHING)),
        PotentialTerm::GravityGradient(t) => {
            let m = t.matrix.as_ref().map_or_else(|| inertia.clone(), |given| rows(given));
            let level = m[(0, 0)];
            let round = (&m - DMatrix::identity(m.nrows(), m.nrows()) * level).amax() == 0.0;
            let square: f64 = t.direction.iter().map(|x| x * x).sum();
            round.then_some((
                0.5 * t.strength * level * square,
                "is the same at every attitude: its matrix is a multiple of I",
            ))
        }
        _ => None,
    }
}

/// Body point and place of a term whose law is singular where the two meet.
fn singular_points(term: &PotentialTerm) -> Option<(&[f64], &[f64])> {
    match term {
        PotentialTerm::PointSource(t) if t.strength != 0.0 => Some((&t.body_point, &t.position)),
        PotentialTerm::Spring(t) if t.stiffness != 0.0 && t.rest_length > 0.0 => {
            Some((&t.body_point, &t.position))
        }
        _ => None,
    }
}

fn with_matrix(term: &PotentialTerm, inertia: &DMatrix<f64>) -> PotentialTerm {
    let mut term = term.clone();
    if let PotentialTerm::GravityGradient(t) = &mut term {
        let rows = || inertia.row_iter().map(|row| row.iter().copied().collect()).collect();
        t.matrix.get_or_insert_with(rows);
    }
    term
}

/// n less the rank of the terms' space vectors.
fn free_directions(n: usize, terms: &[PotentialTerm]) -> usize {
    let vectors: Vec<&[f64]> = terms.iter().map(space_vector).collect();
    if vectors.is_empty() {
        return n;
    }
    let columns = DMatrix::from_fn(n, vectors.len(), |i, j| {
        vectors[j][i] / DVector::from_column_slice(vectors[j]).norm()
    });
    n - columns.rank(1e-12)
}

/// The space vector through whose body image a term depends on the attitude.
pub(crate) fn space_vector(term: &PotentialTerm) -> &[f64] {
    match term {
        PotentialTerm::Uniform(t) => &t.direction,
        PotentialTerm::PointSource(t) => &t.position,
        PotentialTerm::Spring(t) => &t.position,
        PotentialTerm::GravityGradient(t) => &t.direction,
    }
}
