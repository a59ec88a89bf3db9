//! A uniform field: `U = weight y . q`.

use super::{Image, Vector};

pub(super) fn value<const N: usize>(weight: f64, y: &Vector<N>, q: &Vector<N>) -> f64 {
    weight * y.dot(q)
}

/// `dU/dq = weight y`.
#[inline(always)]
pub(super) fn slope<V: Image>(weight: f64, y: &[f64], q: &V) -> V {
    q.vector(y).scaled(q.number(weight))
}
