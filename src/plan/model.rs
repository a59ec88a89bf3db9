//! The mathematical objects of a scene: inertia, attitude, momentum, potential, tableau. Numbers that make none
//! are refused here, with the pointer of their field.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::control::{ModelControl, ModelWheels};
use super::rotation::{rows, skew};
use crate::method::{Integrator, Takes};
use crate::scenario::{
    DrivenTerm, Framed, Inertia, Method, Path, PotentialTerm, Scenario, ScenarioError, SolverKind,
    TableauChoice, TableauName, Torque,
};
use crate::solve::hamiltonian::CLOSEST_APPROACH;
use crate::solve::nonlinear::{Rungs, StopRule};
use crate::solve::so;
use crate::solve::tableau::{Tableau, TableauError};

/// The mathematical objects of the scene, of runtime size; [`crate::run`] gives them their const size.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    pub(crate) kinetic: ModelKinetic,
    /// The terms that are computed, every default filled in.
    pub(crate) terms: Vec<PotentialTerm>,
    /// The terms of the scene that depend on the attitude, as viewers draw them.
    pub(crate) shown: Vec<PotentialTerm>,
    /// The sum of the terms that do not depend on the attitude.
    pub(crate) constant: f64,
    /// The terms that change with time, every default filled in.
    pub(crate) driven: Vec<DrivenTerm>,
    pub(crate) torques: Vec<Torque>,
    /// Angular momentum of wheels, skew, in the body frame.
    pub(crate) wheels: Option<DMatrix<f64>>,
    pub(crate) control: ModelControl,
    /// Attitude at the start, n x n, a rotation to 1e-8.
    pub(crate) attitude: DMatrix<f64>,
    /// Momentum at the start, n x n, skew, in the body frame.
    pub(crate) momentum: DMatrix<f64>,
    pub(crate) tableau: Tableau,
    pub(crate) stop: StopRule,
}

/// Relation between velocity and momentum.
#[derive(Clone, Debug)]
pub(crate) enum ModelKinetic {
    /// `Omega_ij = w_ij mu_ij`.
    Principal { weights: DMatrix<f64> },
    /// n = 3: the inertia matrix.
    Tensor { inertia: Matrix3<f64> },
}

impl Model {
    /// Returns the objects of a scene of several bodies: method and stop rule alone, their own are in [`super::bodies`].
    pub(super) fn of_none(n: usize, tableau: Tableau, stop: StopRule) -> Self {
        let weight = |i, j| if i == j { 0.0 } else { 1.0 };
        Self {
            kinetic: ModelKinetic::Principal { weights: DMatrix::from_fn(n, n, weight) },
            terms: Vec::new(),
            shown: Vec::new(),
            constant: 0.0,
            driven: Vec::new(),
            torques: Vec::new(),
            wheels: None,
            control: ModelControl::default(),
            attitude: DMatrix::identity(n, n),
            momentum: DMatrix::zeros(n, n),
            tableau,
            stop,
        }
    }

    /// Refuses a body point that lies on its place at the start, where the law of the term is singular.
    pub(super) fn check_distances(&self, given: &[PotentialTerm]) -> Result<(), ScenarioError> {
        for (index, term) in given.iter().enumerate() {
            let Some((body_point, position)) = term.law().singular_points() else { continue };
            let (y, z) =
                (DVector::from_column_slice(body_point), DVector::from_column_slice(position));
            let distance = (&y - self.attitude.tr_mul(&z)).norm();
            if !(distance > CLOSEST_APPROACH * (y.norm() + z.norm())) {
                let pointer = format!("/scene/potential/{index}/body_point");
                let message = format!(
                    "lies on `position` at the start (distance {distance:e}); the potential is singular there"
                );
                return Err(ScenarioError::invalid(pointer, message));
            }
        }
        Ok(())
    }
}

impl Model {
    /// Returns the number of directions of space that rotations of the potential leave free at all
    /// times.
    pub(super) fn free_directions(&self, n: usize) -> usize {
        let of_path = |driven: &'_ DrivenTerm| -> Vec<Vec<f64>> {
            let own = driven.term.law().space_vector().to_vec();
            match &driven.path {
                None => vec![own],
                Some(Path::Turning(turning)) => {
                    vec![own, turning.from.clone(), turning.towards.clone()]
                }
                // Its plane turns about z, too.
                Some(Path::Orbit(orbit)) if orbit.j2.is_some() => {
                    vec![own, orbit.towards.clone(), vec![1.0, 0.0, 0.0], vec![0.0, 1.0, 0.0]]
                }
                Some(Path::Orbit(orbit)) => vec![own, orbit.towards.clone()],
            }
        };
        let moving: Vec<Vec<f64>> = self.driven.iter().flat_map(of_path).collect();
        let fixed = self.terms.iter().map(|term| term.law().space_vector());
        if self.control.is_magnetic() {
            return 0;
        }
        super::free_directions(n, fixed.chain(moving.iter().map(Vec::as_slice)))
    }

    /// Describes what is kept instead of the energy in a scene that changes with time or has torques; `None` for any
    /// other.
    pub(super) fn balance(&self) -> Option<String> {
        let control = &self.control;
        let parts = [
            (!self.driven.is_empty(), "what the terms that change with time have put in (H + p_t)"),
            (!self.torques.is_empty(), "the work of the torques"),
            (control.has_wheels(), "the work of the motors of the wheels"),
            (control.is_pushed(), "the work of the control"),
            (control.is_disturbed(), "the work of the torque noise"),
            (control.is_magnetic(), "what the magnetic field and its moments have put in"),
        ];
        let parts: Vec<&str> =
            parts.into_iter().filter(|(is, _)| *is).map(|(_, part)| part).collect();
        let (last, others) = parts.split_last()?;
        let less = if others.is_empty() {
            (*last).to_owned()
        } else {
            format!("{} and {last}", others.join(", "))
        };
        Some(format!("the energy less {less}"))
    }

    /// Describes what is kept of the momentum, and logged as its drift, where torques act and the
    /// potential leaves `free` of n directions free; `None` for a scene without torques, or one
    /// that leaves none.
    pub(super) fn momentum_balance(
        &self,
        n: usize,
        free: usize,
        method: Integrator,
    ) -> Option<String> {
        let pushed =
            !self.torques.is_empty() || self.control.is_pushed() || self.control.is_disturbed();
        if !pushed || free < 2 {
            return None;
        }
        let part = if free == n {
            "the whole spatial momentum".to_owned()
        } else {
            format!(
                "the spatial momentum among the {free} directions that the potential leaves free,"
            )
        };
        let kept = if method.facts().symplectic { "rounding" } else { "the order of the method" };
        Some(format!("{part} less the impulse of the torques, kept to {kept}"))
    }

    /// Describes the Jacobi integral, where there is one.
    pub(super) fn jacobi_integral(&self) -> Option<String> {
        self.turns_alike().then(|| {
            "H - w.m, because everything that changes turns at one constant rate w; m is the spatial momentum".to_owned()
        })
    }

    /// Refuses a method that cannot run a scene that changes with time or has torques or wheels.
    pub(super) fn allows(&self, method: Integrator) -> Result<(), ScenarioError> {
        let facts = method.facts();
        let refused = |what: &str, names: String| {
            let name = method.as_str();
            let message = format!("{name} cannot run {what}; {names} can");
            Err(ScenarioError::invalid("/method/name", message))
        };
        if self.is_driven() && !facts.driven {
            return refused(
                "scenes that change with time or have torques that do not come from a potential",
                Integrator::names(|method| method.facts().driven),
            );
        }
        if (self.wheels.is_some() || self.control.has_wheels()) && !facts.wheels {
            return refused(
                "bodies with wheels",
                Integrator::names(|method| method.facts().wheels),
            );
        }
        Ok(())
    }

    /// Returns, for n = 3, the inverse principal moments of inertia, and the momentum at the start
    /// along their axes.
    pub(super) fn in_principal_axes(&self) -> (Vector3<f64>, Vector3<f64>) {
        let m = &self.momentum;
        let momentum = Vector3::new(m[(2, 1)], m[(0, 2)], m[(1, 0)]);
        match &self.kinetic {
            ModelKinetic::Principal { weights: w } => {
                (Vector3::new(w[(2, 1)], w[(0, 2)], w[(1, 0)]), momentum)
            }
            ModelKinetic::Tensor { inertia } => {
                let eigen = inertia.symmetric_eigen();
                (eigen.eigenvalues.map(|moment| 1.0 / moment), eigen.eigenvectors.tr_mul(&momentum))
            }
        }
    }
}

impl ModelKinetic {
    /// Returns a bound on the velocity for a momentum of one.
    pub(crate) fn mobility(&self) -> f64 {
        match self {
            Self::Principal { weights } => weights.amax(),
            Self::Tensor { inertia } => {
                inertia.try_inverse().map_or(f64::INFINITY, |inverse| inverse.norm())
            }
        }
    }
}

/// Returns the rungs of the solver that a scenario allows.
pub(super) fn rungs(kind: SolverKind) -> Rungs {
    match kind {
        SolverKind::Auto => Rungs::Both,
        SolverKind::FixedPoint => Rungs::FixedPoint,
        SolverKind::Newton => Rungs::Newton,
    }
}

/// Returns the inertia matrix in body coordinates: `J = tr(D) I - D` for second moments D.
pub(crate) fn inertia_matrix(inertia: &Inertia) -> DMatrix<f64> {
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

pub(super) fn kinetic(
    given: &Inertia,
    matrix: &DMatrix<f64>,
) -> Result<ModelKinetic, ScenarioError> {
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
            // Finite, so that a few iterations are enough.
            const MOST_ROUNDS: usize = 1000;
            let tensor = Matrix3::from_iterator(matrix.iter().copied());
            let eigen = tensor.try_symmetric_eigen(f64::EPSILON, MOST_ROUNDS);
            let smallest = eigen.map_or(f64::NAN, |eigen| eigen.eigenvalues.min());
            if !(smallest > 1e-12 * matrix.amax() && smallest >= 1e-12) {
                let message =
                    format!("is not positive definite: its smallest eigenvalue is {smallest:e}");
                return Err(ScenarioError::invalid(pointer, message));
            }
            Ok(of_matrix(&tensor))
        }
    }
}

/// Returns the kinetic energy of a body with principal moments of inertia: for n = 3 the plane (i, j) turns about the third axis k,
/// d_i + d_j = J_k.
fn principal(moments: [f64; 3]) -> ModelKinetic {
    let weight = |i: usize, j: usize| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] };
    ModelKinetic::Principal { weights: DMatrix::from_fn(3, 3, weight) }
}

/// Returns the kinetic energy of a body of three dimensions with a positive definite inertia matrix.
pub(super) fn of_matrix(matrix: &Matrix3<f64>) -> ModelKinetic {
    // Relative to its two moments such a product of inertia is rounding.
    let none = |i: usize, j: usize| {
        matrix[(i, j)].abs() <= f64::EPSILON * (matrix[(i, i)] * matrix[(j, j)]).sqrt()
    };
    let diagonal = (0..3).all(|i| (0..i).all(|j| none(i, j) && none(j, i)));
    if diagonal {
        let moments = [matrix[(0, 0)], matrix[(1, 1)], matrix[(2, 2)]];
        return principal(moments);
    }
    ModelKinetic::Tensor { inertia: *matrix }
}

/// Returns the body momentum at the start.
pub(super) fn momentum(
    scenario: &Scenario,
    kinetic: &ModelKinetic,
    attitude: &DMatrix<f64>,
    driven_wheels: Option<&ModelWheels>,
) -> DMatrix<f64> {
    let in_body = |framed: &Framed| match framed {
        Framed::Body(entries) => skew(entries),
        Framed::Space(entries) => attitude.transpose() * skew(entries) * attitude,
    };
    let initial = &scenario.scene.initial;
    let zero = || DMatrix::zeros(attitude.nrows(), attitude.nrows());
    let wheels = scenario.scene.wheels.as_deref().map(skew);
    let wheels = wheels.or_else(|| Some(driven_wheels?.momentum())).unwrap_or_else(zero);
    match (&initial.momentum, &initial.angular_velocity) {
        (Some(momentum), _) => in_body(momentum),
        (None, Some(velocity)) => {
            let omega = in_body(velocity);
            let own = match kinetic {
                ModelKinetic::Principal { weights } => {
                    omega.zip_map(weights, |omega, w| if w == 0.0 { 0.0 } else { omega / w })
                }
                ModelKinetic::Tensor { inertia } => {
                    let mu = inertia * Vector3::new(omega[(2, 1)], omega[(0, 2)], omega[(1, 0)]);
                    DMatrix::from_iterator(3, 3, so::hat::<3>(mu.as_slice()).iter().copied())
                }
            };
            own + wheels
        }
        // At rest only the wheels turn.
        (None, None) => wheels,
    }
}

/// Returns the tableau asked for, or the method's own.
pub(super) fn tableau_choice(method: &Method) -> TableauChoice {
    let is_explicit = method.name.integrator().is_some_and(Integrator::is_explicit);
    let usual = if is_explicit { TableauName::Rk4 } else { TableauName::Gauss2 };
    method.tableau.clone().unwrap_or(TableauChoice::Named(usual))
}

/// Returns the tableau, checked to be one that the method takes.
pub(super) fn tableau(choice: &TableauChoice, method: &Method) -> Result<Tableau, ScenarioError> {
    let tableau = coefficients(choice)?;
    let name = method.name.as_str();
    let wrong = |message| Err(ScenarioError::invalid("/method/tableau", message));
    let takes = method.name.integrator().map_or(Takes::Tableau, |method| method.facts().takes);
    if takes == Takes::Explicit && !tableau.is_explicit() {
        return wrong(format!(
            "{name} is explicit; it takes rk3, rk4, rk8 or explicit coefficients"
        ));
    }
    let paired = if takes == Takes::Explicit { Ok(()) } else { tableau.check_conjugate() };
    paired.map_err(|error| refused(choice, &error))?;
    let gauss = Tableau::gauss(tableau.stages());
    if takes == Takes::Gauss && gauss.as_ref() != Some(&tableau) {
        return wrong(format!("{name} takes gauss1 to gauss8"));
    }
    Ok(tableau)
}

fn coefficients(choice: &TableauChoice) -> Result<Tableau, ScenarioError> {
    match choice {
        TableauChoice::Named(name) => name.tableau().ok_or_else(|| {
            ScenarioError::invalid("/method/tableau", "this tableau cannot be made")
        }),
        TableauChoice::Custom(given) => {
            Tableau::new(given.a.clone(), given.b.clone()).map_err(|error| refused(choice, &error))
        }
    }
}

/// Returns the error for a tableau that cannot be used.
fn refused(choice: &TableauChoice, error: &TableauError) -> ScenarioError {
    let pointer = match (choice, error) {
        (TableauChoice::Named(_), _) | (_, TableauError::Size) => "/method/tableau".to_owned(),
        (_, TableauError::Shape { .. }) => "/method/tableau/a".to_owned(),
        (_, TableauError::ZeroWeight { stage, .. }) => format!("/method/tableau/b/{stage}"),
        (_, TableauError::Inconsistent { .. }) => "/method/tableau/b".to_owned(),
    };
    let message = match (choice, error) {
        (TableauChoice::Named(_), TableauError::ZeroWeight { .. }) => {
            "has weights that are zero, and the momenta of the stages are divided by them: it is for explicit methods (rk, \
             rk_projected, rkmk); this one takes gauss1 to gauss8, rk3, rk4 or coefficients"
                .to_owned()
        }
        _ => error.to_string(),
    };
    ScenarioError::invalid(pointer, message)
}

pub(super) fn with_matrix(term: &PotentialTerm, inertia: &DMatrix<f64>) -> PotentialTerm {
    let mut term = term.clone();
    if let PotentialTerm::GravityGradient(t) = &mut term {
        let rows = || inertia.row_iter().map(|row| row.iter().copied().collect()).collect();
        t.matrix.get_or_insert_with(rows);
    }
    term
}
