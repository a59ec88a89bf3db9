//! A uniform field: `U = weight y . q`.

use super::{BodyVector, Space, Vector};

pub(super) const SPACE: Space = Space::Direction;

#[inline(always)]
pub(super) fn value<V: BodyVector>(weight: f64, y: &[f64], q: &V) -> V::Number {
    q.vector(y).dot(q) * weight
}

/// `dU/dq = weight y`.
#[inline(always)]
pub(super) fn slope<V: BodyVector>(weight: f64, y: &[f64], q: &V, _: f64, _: &mut V::Number) -> V {
    q.vector(y).scaled(q.number(weight))
}

#[inline(always)]
pub(super) fn change<V: BodyVector>(weight: f64, y: &[f64], q: &V, rate: &V) -> V::Number {
    q.vector(y).dot(rate) * weight
}

/// The rate of [`slope`]: `weight' y + weight y'`.
#[inline(always)]
pub(super) fn slope_rate<V: BodyVector>(
    (weight, y): (f64, &[f64]),
    (weight_rate, y_rate): (f64, &[f64]),
    q: &V,
    _: &V,
) -> V {
    let by_weight = q.vector(y).scaled(q.number(weight_rate));
    by_weight.plus(&q.vector(y_rate).scaled(q.number(weight)))
}

pub(super) fn singular_point<const N: usize>(_: f64, _: &Vector<N>) -> Option<&Vector<N>> {
    None
}
