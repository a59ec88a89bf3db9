//! A charge: `U = strength / r`, `r = |y - q|`.

use super::{BodyVector, Real, Space, Vector};

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

#[inline(always)]
pub(super) fn change<V: BodyVector>(strength: f64, y: &[f64], q: &V, rate: &V) -> V::Number {
    let arm = q.vector(y).minus(q);
    let square = arm.square();
    arm.dot(rate) * strength / (square * square.sqrt())
}

/// The rate of [`slope`]: `(strength y)' / r^3 - 3 strength y (a . a') / r^5`, `a = y - q`.
#[inline(always)]
pub(super) fn slope_rate<V: BodyVector>(
    (strength, y): (f64, &[f64]),
    (strength_rate, y_rate): (f64, &[f64]),
    q: &V,
    q_rate: &V,
) -> V {
    let (y, y_rate) = (q.vector(y), q.vector(y_rate));
    let (arm, arm_rate) = (y.minus(q), y_rate.minus(q_rate));
    let square = arm.square();
    let fall = arm.dot(&arm_rate) * (3.0 * strength) / square;
    let slope = y.scaled(-fall + strength_rate).plus(&y_rate.scaled(q.number(strength)));
    slope.scaled(q.number(1.0) / (square * square.sqrt()))
}

pub(super) fn singular_point<const N: usize>(_: f64, y: &Vector<N>) -> Option<&Vector<N>> {
    Some(y)
}
