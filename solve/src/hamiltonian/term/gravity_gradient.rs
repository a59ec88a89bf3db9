//! The gradient of gravity: `U = strength / 2 q . M q`.

use super::{BodyVector, Mat, Space, Vector};

pub(super) const SPACE: Space = Space::Tide;

#[inline(always)]
pub(super) fn value<V: BodyVector>(strength: f64, m: &[f64], q: &V) -> V::Number {
    q.dot(&q.times(m)) * (0.5 * strength)
}

/// `dU/dq = strength M q`.
#[inline(always)]
pub(super) fn slope<V: BodyVector>(
    strength: f64,
    m: &[f64],
    q: &V,
    _: f64,
    _: &mut V::Number,
) -> V {
    q.times(m).scaled(q.number(strength))
}

#[inline(always)]
pub(super) fn change<V: BodyVector>(strength: f64, m: &[f64], q: &V, rate: &V) -> V::Number {
    q.times(m).dot(rate) * strength
}

/// The rate of [`slope`]: `strength' M q + strength (M' q + M q')`.
#[inline(always)]
pub(super) fn slope_rate<V: BodyVector>(
    (strength, m): (f64, &[f64]),
    (strength_rate, m_rate): (f64, &[f64]),
    q: &V,
    q_rate: &V,
) -> V {
    let by_strength = q.times(m).scaled(q.number(strength_rate));
    by_strength.plus(&q.times(m_rate).plus(&q_rate.times(m)).scaled(q.number(strength)))
}

pub(super) fn singular_point<const N: usize>(_: f64, _: &Mat<N>) -> Option<&Vector<N>> {
    None
}
