//! How the law of a body changes with its attitude, its momentum and a parameter: the second derivatives of its Hamiltonian.
//!
//! Invariant: each is the derivative of the function of [`RigidBody`] that it names.

use super::super::lanes::StageScalar;
use super::super::so::{self, Mat, Vector};
use super::super::space::{Mat3, Vec3, cross, plus, transposed_product, vec3};
use super::super::stack::Known;
use super::term::Lanes;
use super::{Law, RigidBody, Term};

/// The rate at which a body changes with a parameter: with its inertia, or with a strength, a point or another number of its
/// potential.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyRate<const N: usize> {
    /// The rate of the matrix D of second moments, symmetric n x n: `mu = D Omega + Omega D`. For n = 3 the inertia
    /// tensor is `J = tr(D) I - D`, so `D' = tr(J') I / 2 - J'`.
    pub second_moments: Mat<N>,
    /// The terms of the potential that change, each with the rates of its fields and of its space vector: a law of the same
    /// kind ([`Term::quotient`]).
    pub terms: Vec<(Term<N>, Term<N>)>,
}

impl<const N: usize> Default for BodyRate<N> {
    /// Nothing changes.
    fn default() -> Self {
        Self { second_moments: Mat::zeros(), terms: Vec::new() }
    }
}

impl<const N: usize> RigidBody<N> {
    /// The rate of [`RigidBody::velocity`]: `Omega' = J^-1 mu'`, wheels staying as they are.
    pub fn velocity_rate(&self, mu_rate: &Mat<N>) -> Mat<N> {
        self.velocity_without_wheels(mu_rate)
    }

    /// The rate of [`RigidBody::velocity`] with a parameter, at a fixed momentum: from `mu = J Omega`,
    /// `Omega' = -J^-1 (D' Omega + Omega D')`.
    pub fn velocity_rate_by(&self, rate: &BodyRate<N>, omega: &Mat<N>) -> Mat<N> {
        self.velocity_rate(&-so::asym(&so::product(&rate.second_moments, omega)))
    }

    /// The rate of [`RigidBody::gradient`] where the body turns: `g' = g eta`, eta skew.
    ///
    /// A term with `q = g^T v` and the slope `s = dU/dq` has `dH/dg = q s^T - s q^T` and `q' = -eta q`.
    pub fn gradient_rate(&self, g: &Mat<N>, eta: &Mat<N>) -> Mat<N> {
        let mut sum = Mat::zeros();
        for Term { law, space } in &self.terms {
            let q = so::to_body(g, space);
            add_rate(law, &law.zero(), &q, &-so::to_space(eta, &q), &mut sum);
        }
        sum
    }

    /// The rate of [`RigidBody::gradient`] with a parameter, at a fixed attitude.
    pub fn gradient_rate_by(&self, rate: &BodyRate<N>, g: &Mat<N>) -> Mat<N> {
        let mut sum = Mat::zeros();
        for (Term { law, space }, rate) in &rate.terms {
            let q_rate = so::to_body(g, &rate.space);
            add_rate(law, &rate.law, &so::to_body(g, space), &q_rate, &mut sum);
        }
        sum
    }
}

impl RigidBody<3> {
    /// vee(dH/dg) at `g = g0 U` and the matrix of [`RigidBody::gradient_rate`] there, at the stages in lanes; without user-defined
    /// potentials.
    #[inline(always)]
    pub(crate) fn torque_and_rate<R: StageScalar<StepScalar = f64>>(
        &self,
        g0: &Mat<3>,
        u: &Mat3<R>,
    ) -> (Vec3<R>, Mat3<R>) {
        let zero = u[0][0].constant(0.0);
        let (mut torque, mut rate) = ([zero; 3], [[zero; 3]; 3]);
        for Term { law, space } in &self.terms {
            let (v, law_rate) = (so::to_body(g0, space), law.zero());
            let q = transposed_product(u, &vec3!(i => zero.constant(v[i])));
            let q = Lanes { dimension: Known::<3>, numbers: q };
            let slope = law.numbers().slope(&q, 0.0, &mut zero.constant(0.0)).numbers;
            let [x, y, z] = q.numbers;
            torque = plus(&torque, &cross(&slope, &q.numbers));
            // q x e of the three axes.
            let q_rates = [[zero, z, -y], [-z, zero, x], [y, -x, zero]];
            for c in 0..3 {
                let q_rate = Lanes { dimension: Known::<3>, numbers: q_rates[c] };
                if let Some(slope_rate) = law.slope_rate(&law_rate, &q, &q_rate) {
                    let (own, other) =
                        (cross(&slope_rate.numbers, &q.numbers), cross(&slope, &q_rates[c]));
                    for r in 0..3 {
                        rate[r][c] = rate[r][c] + (own[r] + other[r]);
                    }
                }
            }
        }
        (torque, rate)
    }
}

impl<const N: usize> Term<N> {
    /// `(self - other) / divisor`, field by field: the rate of a term from `other` to this one. `None` if they are of
    /// different kinds.
    pub fn quotient(&self, other: &Self, divisor: f64) -> Option<Self> {
        let law = self.law.quotient(&other.law, divisor)?;
        Some(Self { law, space: (self.space - other.space) / divisor })
    }
}

/// Adds the rate of `q s^T - s q^T`; nothing if that of the law is of another kind.
fn add_rate<const N: usize>(
    law: &Law<N>,
    law_rate: &Law<N>,
    q: &Vector<N>,
    q_rate: &Vector<N>,
    sum: &mut Mat<N>,
) {
    if let Some(slope_rate) = law.slope_rate(law_rate, q, q_rate) {
        let slope = law.numbers().slope(q, 0.0, &mut 0.0);
        *sum += so::wedge(q_rate, &slope) + so::wedge(q, &slope_rate);
    }
}
