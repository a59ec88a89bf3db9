//! The gradient of gravity: `U = strength / 2 q . M q`.

use super::Image;

#[inline(always)]
pub(super) fn value<V: Image>(strength: f64, m: &[f64], q: &V) -> V::Number {
    q.dot(&q.times(m)) * (0.5 * strength)
}

/// `dU/dq = strength M q`.
#[inline(always)]
pub(super) fn slope<V: Image>(strength: f64, m: &[f64], q: &V) -> V {
    q.times(m).scaled(q.number(strength))
}
