//! The gradient of gravity: `U = strength / 2 q . M q`.

use super::{Image, Mat, Vector};

pub(super) fn value<const N: usize>(strength: f64, m: &Mat<N>, q: &Vector<N>) -> f64 {
    0.5 * strength * q.dot(&(m * q))
}

/// `dU/dq = strength M q`.
#[inline(always)]
pub(super) fn slope<V: Image>(strength: f64, m: &[f64], q: &V) -> V {
    q.times(m).scaled(q.number(strength))
}
