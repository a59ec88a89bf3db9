//! A body of n = 3 that stays in a plane, as a body of n = 2.

use super::{Kinetic, Law, RigidBody, Term};
use crate::so::{Mat, Vector};

/// What rounding may make of a space vector that lies in the plane, in parts of its length.
const ROUNDED: f64 = 8.0 * f64::EPSILON;

impl RigidBody<3> {
    /// The body in the plane across its axis `k`, with space as it is seen from the attitude `frame`. `None` unless the axis
    /// is a principal one and every term by itself pulls along the plane alone, at every attitude about the axis: then a
    /// momentum along the axis stays along it.
    pub fn across(&self, k: usize, frame: &Mat<3>) -> Option<RigidBody<2>> {
        // Of a potential of one's own nothing is known.
        if self.has_own() {
            return None;
        }
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let is_axis = |m: &Mat<3>| [m[(i, k)], m[(j, k)], m[(k, i)], m[(k, j)]] == [0.0; 4];
        let weight = match &self.kinetic {
            Kinetic::Principal { weights } => weights[(i, j)],
            Kinetic::Tensor { inertia, .. } => is_axis(inertia).then_some(1.0 / inertia[(k, k)])?,
        };
        let point = |y: &Vector<3>| (y[k] == 0.0).then_some(Vector::<2>::new(y[i], y[j]));
        let term = |Term { law, space }: &Term<3>| {
            let seen = frame.tr_mul(space);
            if !(seen[k].abs() <= ROUNDED * space.norm()) {
                return None;
            }
            let law = match law {
                Law::Uniform { weight, body_point } => {
                    Law::Uniform { weight: *weight, body_point: point(body_point)? }
                }
                Law::PointSource { strength, body_point } => {
                    Law::PointSource { strength: *strength, body_point: point(body_point)? }
                }
                Law::Spring { stiffness, rest_length, body_point } => Law::Spring {
                    stiffness: *stiffness,
                    rest_length: *rest_length,
                    body_point: point(body_point)?,
                },
                Law::GravityGradient { strength, matrix } => {
                    let m = is_axis(matrix).then_some(matrix)?;
                    let block = Mat::<2>::new(m[(i, i)], m[(i, j)], m[(j, i)], m[(j, j)]);
                    Law::GravityGradient { strength: *strength, matrix: block }
                }
            };
            Some(Term { law, space: Vector::<2>::new(seen[i], seen[j]) })
        };
        let terms = self.terms.iter().map(term).collect::<Option<Vec<_>>>()?;
        let weights = Mat::<2>::new(0.0, weight, weight, 0.0);
        Some(RigidBody::new(Kinetic::Principal { weights }, terms, self.constant))
    }
}
