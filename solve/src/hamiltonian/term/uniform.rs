//! A uniform field: `U = weight y . q`.

use super::Image;

#[inline(always)]
pub(super) fn value<V: Image>(weight: f64, y: &[f64], q: &V) -> V::Number {
    q.vector(y).dot(q) * weight
}

/// `dU/dq = weight y`.
#[inline(always)]
pub(super) fn slope<V: Image>(weight: f64, y: &[f64], q: &V) -> V {
    q.vector(y).scaled(q.number(weight))
}
