//! The gradient of gravity: `U = strength / 2 q . M q`.

use super::{BodyVector, Mat, Space, Vector, so};

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

pub(super) fn change<const N: usize>(
    strength: f64,
    m: &Mat<N>,
    q: &Vector<N>,
    rate: &Vector<N>,
) -> f64 {
    strength * so::dot(so::to_space(m, q).as_slice(), rate.as_slice())
}

pub(super) fn singular_point<const N: usize>(_: f64, _: &Mat<N>) -> Option<&Vector<N>> {
    None
}
