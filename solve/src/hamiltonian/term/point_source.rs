//! A charge: `U = strength / r`, `r = |y - q|`.

use super::{BodyVector, Real, Space, Vector, so};

pub(super) const SPACE: Space = Space::Place;

#[inline(always)]
pub(super) fn value<V: BodyVector>(strength: f64, y: &[f64], q: &V) -> V::Number {
    q.number(strength) / q.vector(y).minus(q).square().sqrt()
}

/// `dU/dq = strength (y - q) / r^3`; the part along q has no torque.
#[inline(always)]
pub(super) fn slope<V: BodyVector>(
    strength: f64,
    y: &[f64],
    q: &V,
    inverse_arm_squared: f64,
    proximity: &mut V::Number,
) -> V {
    let y = q.vector(y);
    let square = y.minus(q).square();
    *proximity = proximity.max_or_nan(square * -inverse_arm_squared);
    y.scaled(q.number(strength) / (square * square.sqrt()))
}

pub(super) fn change<const N: usize>(
    strength: f64,
    y: &Vector<N>,
    q: &Vector<N>,
    rate: &Vector<N>,
) -> f64 {
    let arm = y - q;
    let distance = so::norm(arm.as_slice());
    strength * so::dot(arm.as_slice(), rate.as_slice()) / (distance * distance * distance)
}

pub(super) fn singular_point<const N: usize>(_: f64, y: &Vector<N>) -> Option<&Vector<N>> {
    Some(y)
}
