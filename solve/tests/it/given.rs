//! Data from which the tests of both crates begin: numbers from a seed, the paper's dipole, and its
//! known end.

use serde_json::Value;
use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;

/// Numbers in [-1, 1) from a seed, the same on every machine (an xorshift generator).
pub(crate) struct Numbers(pub(crate) u64);

impl Numbers {
    pub(crate) fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    pub(crate) fn matrix<const N: usize>(&mut self) -> Mat<N> {
        Mat::from_fn(|_, _| self.next())
    }

    pub(crate) fn vector<const N: usize>(&mut self) -> Vector<N> {
        Vector::from_fn(|_, _| self.next())
    }

    pub(crate) fn skew<const N: usize>(&mut self) -> Mat<N> {
        so::asym(&self.matrix()) * 0.5
    }

    pub(crate) fn rotation<const N: usize>(&mut self) -> Mat<N> {
        so::retraction(&self.skew()).expect("defined everywhere")
    }
}

/// The paper's dipole on a stick, J = diag(1.01, 1, 0.01), and its start.
pub(crate) fn dipole() -> (RigidBody<3>, State<3>) {
    let moments = [1.01, 1.0, 0.01];
    let vertical = Vector::<3>::new(0.0, 0.0, 1.0);
    let charge = Vector::<3>::new(0.0, 0.0, -1.5);
    let source = |strength: f64| Term {
        law: Law::PointSource { strength, body_point: Vector::<3>::new(0.0, 0.1 * strength, -1.0) },
        space: charge,
    };
    let weight = Term { law: Law::Uniform { weight: 1.0, body_point: vertical }, space: vertical };
    let body =
        RigidBody::new(Kinetic::of_moments(moments), vec![weight, source(1.0), source(-1.0)], 0.0);
    let attitude = Mat::<3>::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    (body, State { attitude, momentum: so::hat(&[0.0, 0.0, -0.01]) })
}

/// `|p - p_ref|_2 + |g - g_ref|_2`, the paper's measure.
pub(crate) fn distance(a: &State<3>, b: &State<3>) -> f64 {
    let difference = a.attitude - b.attitude;
    let spectral =
        (difference.transpose() * difference).symmetric_eigenvalues().max().max(0.0).sqrt();
    let momentum = a.momentum - b.momentum;
    so::inner(&momentum, &momentum).sqrt() + spectral
}

/// The dipole at t = 0.5, from two independent methods of 45 digits.
pub(crate) fn reference() -> State<3> {
    known("/points/0.5")
}

pub(crate) fn known(point: &str) -> State<3> {
    let data: Value =
        serde_json::from_str(include_str!("../data/dipole-reference.json")).expect("JSON");
    let point = data.pointer(point).expect("a point");
    let number =
        |v: &Value| v.as_str().and_then(|text| text.parse::<f64>().ok()).expect("a number as text");
    let momentum: Vec<f64> = (0..3).map(|i| number(&point["ptilde"][i])).collect();
    State { attitude: Mat::from_fn(|i, j| number(&point["g"][i][j])), momentum: so::hat(&momentum) }
}
