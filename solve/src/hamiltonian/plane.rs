//! A body of n = 3 that stays in a plane, as a body of n = 2.

use super::{Kinetic, RigidBody, Term};
use crate::so::{Mat, Vector};
use crate::so3::is_axis;

/// Rounding error of a space vector that lies in the plane, in parts of its length.
const ROUNDED: f64 = 8.0 * f64::EPSILON;

impl RigidBody<3> {
    /// The body in the plane across its axis `k`, with space as it is seen from the attitude `frame`. `None` unless the axis
    /// is a principal one and every term by itself pulls along the plane alone, at every attitude about the axis: then a
    /// momentum along the axis stays along it.
    pub fn across(&self, k: usize, frame: &Mat<3>) -> Option<RigidBody<2>> {
        // Nothing is known of a user-defined potential, and a drive or a wheel may turn it out of the plane.
        if self.has_user_potential() || self.is_driven() || self.wheels.is_some() {
            return None;
        }
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let weight = match &self.kinetic {
            Kinetic::Principal { weights } => weights[(i, j)],
            Kinetic::Tensor { inertia, .. } => {
                is_axis(inertia, [i, j, k]).then_some(1.0 / inertia[(k, k)])?
            }
        };
        let term = |Term { law, space }: &Term<3>| {
            let seen = frame.tr_mul(space);
            if !(seen[k].abs() <= ROUNDED * space.norm()) {
                return None;
            }
            let law = law.in_plane([i, j, k])?;
            Some(Term { law, space: Vector::<2>::new(seen[i], seen[j]) })
        };
        let terms = self.terms.iter().map(term).collect::<Option<Vec<_>>>()?;
        let weights = Mat::<2>::new(0.0, weight, weight, 0.0);
        Some(RigidBody::new(Kinetic::Principal { weights }, terms, self.constant))
    }
}
