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
pub(super) fn slope_rate<const N: usize>(
    (strength, y): (f64, &[f64]),
    (strength_rate, y_rate): (f64, &[f64]),
    q: &Vector<N>,
    q_rate: &Vector<N>,
) -> Vector<N> {
    let (y, y_rate) = (Vector::from_column_slice(y), Vector::from_column_slice(y_rate));
    let (arm, arm_rate) = (y - q, y_rate - q_rate);
    let square = arm.square();
    let cube = square * square.sqrt();
    let fall = 3.0 * strength * BodyVector::dot(&arm, &arm_rate) / square;
    (y * (strength_rate - fall) + y_rate * strength) / cube
}

pub(super) fn singular_point<const N: usize>(_: f64, y: &Vector<N>) -> Option<&Vector<N>> {
    Some(y)
}
