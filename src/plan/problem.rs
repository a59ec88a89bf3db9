//! The planned model with its const size: the body, its potential, and the state at the start.

use super::{Model, ModelKinetic};
use crate::scenario::PotentialTerm;
use crate::solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use crate::solve::so::{self, Mat, Vector};
use crate::solve::trajectory::State;

impl Model {
    /// The body and its state at the start, with their const size.
    pub(crate) fn problem<const N: usize>(&self) -> (RigidBody<N>, State<N>) {
        let kinetic = match &self.kinetic {
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
        let terms = self.terms.iter().map(term).collect();
        let state = State {
            attitude: self.rotation(),
            momentum: Mat::from_fn(|i, j| self.momentum[(i, j)]),
        };
        (RigidBody::new(kinetic, terms, self.constant), state)
    }

    /// The value of a term at the start.
    pub(super) fn value_at_start(&self, given: &PotentialTerm) -> f64 {
        potential([given]).energy(&self.rotation(), &Mat::zeros()).potential
    }

    /// Does nothing move at the start, and nothing push?
    pub(super) fn is_at_rest(&self) -> bool {
        let torque = || potential(&self.terms).gradient_at(&self.rotation());
        self.momentum.iter().all(|&x| x == 0.0) && torque().iter().all(|&x| x == 0.0)
    }

    /// The attitude at the start. Decimal text puts a rotation a digit off the group; the run starts on it. In more
    /// dimensions than the body has it turns nothing.
    fn rotation<const N: usize>(&self) -> Mat<N> {
        let n = self.attitude.nrows();
        let own = |i: usize, j: usize| {
            if i.max(j) < n { self.attitude[(i, j)] } else { f64::from(i == j) }
        };
        so::polar(&Mat::from_fn(own)).expect("the plan checked that the attitude is a rotation")
    }
}

/// A size into which every body fits: the rest of it is zero.
const LARGEST: usize = 16;

/// Terms, and nothing that moves, in whatever dimension.
fn potential<'a>(terms: impl IntoIterator<Item = &'a PotentialTerm>) -> RigidBody<LARGEST> {
    let kinetic = Kinetic::Principal { weights: Mat::zeros() };
    RigidBody::new(kinetic, terms.into_iter().map(term).collect(), 0.0)
}

fn term<const N: usize>(given: &PotentialTerm) -> Term<N> {
    let point = |v: &[f64]| Vector::<N>::from_fn(|i, _| v.get(i).copied().unwrap_or(0.0));
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
            let entry =
                |i: usize, j: usize| rows.get(i).and_then(|row| row.get(j)).copied().unwrap_or(0.0);
            // Exactly symmetric: text may leave the two halves a digit apart.
            let matrix = so::symmetric_part(&Mat::from_fn(entry));
            Law::GravityGradient { strength: t.strength, matrix }
        }
    };
    Term { law, space: point(given.law().space_vector()) }
}
