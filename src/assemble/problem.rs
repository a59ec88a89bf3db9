//! The planned model with its const size: the body, its potential, and the state at the start.

use crate::plan::{Model, ModelKinetic, space_vector};
use crate::scenario::PotentialTerm;
use crate::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use crate::solve::so::{self, Mat, Vector};
use crate::solve::trajectory::State;

/// The body and its state at the start, with their const size.
pub(super) fn problem<const N: usize>(model: &Model) -> (RigidBody<N>, State<N>) {
    let kinetic = match &model.kinetic {
        ModelKinetic::Principal { weights } => {
            Kinetic::Principal { weights: Mat::from_fn(|i, j| weights[(i, j)]) }
        }
        ModelKinetic::Tensor { inertia } => Kinetic::Tensor {
            inertia: *inertia,
            inverse: inertia
                .cholesky()
                .expect("the plan checked that the inertia is positive definite")
                .inverse(),
        },
    };
    let terms = model.terms.iter().map(term).collect();
    let attitude = Mat::from_fn(|i, j| model.attitude[(i, j)]);
    let state = State {
        // Decimal text puts a rotation a digit off the group; the run starts on it.
        attitude: so::polar(&attitude).expect("the plan checked that the attitude is a rotation"),
        momentum: Mat::from_fn(|i, j| model.momentum[(i, j)]),
    };
    (RigidBody::new(kinetic, terms, model.constant), state)
}

fn term<const N: usize>(given: &PotentialTerm) -> Term<N> {
    let point = |v: &[f64]| Vector::<N>::from_column_slice(v);
    let law = match given {
        PotentialTerm::Uniform(t) => {
            Law::Uniform { weight: t.weight, body_point: point(&t.body_point) }
        }
        PotentialTerm::PointSource(t) => {
            Law::PointSource { strength: t.strength, body_point: point(&t.body_point) }
        }
        PotentialTerm::Spring(t) => Law::Spring {
            stiffness: t.stiffness,
            rest_length: t.rest_length,
            body_point: point(&t.body_point),
        },
        PotentialTerm::GravityGradient(t) => {
            let rows = t.matrix.as_ref().expect("the plan filled in the matrix");
            // Exactly symmetric: text may leave the two halves a digit apart.
            let matrix = so::symmetric_part(&Mat::from_fn(|i, j| rows[i][j]));
            Law::GravityGradient { strength: t.strength, matrix }
        }
    };
    Term { law, space: point(space_vector(given)) }
}
