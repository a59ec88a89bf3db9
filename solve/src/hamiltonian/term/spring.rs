//! A spring: `U = stiffness / 2 (r - rest_length)^2`, `r = |y - q|`.

use super::{BodyVector, Real, Space, Vector};

pub(super) const SPACE: Space = Space::Place;

#[inline(always)]
pub(super) fn value<V: BodyVector>(
    stiffness: f64,
    rest_length: f64,
    y: &[f64],
    q: &V,
) -> V::Number {
    let stretch = q.vector(y).minus(q).square().sqrt() + -rest_length;
    stretch * (0.5 * stiffness) * stretch
}

/// `dU/dq = -stiffness (1 - rest_length / r) (y - q)`; the part along q has no torque.
#[inline(always)]
pub(super) fn slope<V: BodyVector>(
    stiffness: f64,
    rest_length: f64,
    y: &[f64],
    q: &V,
    inverse_arm_squared: f64,
    proximity: &mut V::Number,
) -> V {
    let y = q.vector(y);
    if rest_length == 0.0 {
        return y.scaled(q.number(-stiffness));
    }
    let square = y.minus(q).square();
    *proximity = proximity.max_or_nan(square * -inverse_arm_squared);
    let ratio = q.number(rest_length) / square.sqrt();
    y.scaled((ratio + -1.0) * stiffness)
}

#[inline(always)]
pub(super) fn change<V: BodyVector>(
    stiffness: f64,
    rest_length: f64,
    y: &[f64],
    q: &V,
    rate: &V,
) -> V::Number {
    let arm = q.minus(&q.vector(y));
    let pull = arm.dot(rate) * stiffness;
    if rest_length == 0.0 {
        return pull;
    }
    let ratio = q.number(rest_length) / arm.square().sqrt();
    (-ratio + 1.0) * pull
}

/// The rate of [`slope`]: of `pull y` with `pull = stiffness (rest_length / r - 1)`, where `r' = a . a' / r`, `a = y - q`.
#[inline(always)]
pub(super) fn slope_rate<V: BodyVector>(
    (stiffness, rest_length, y): (f64, f64, &[f64]),
    (stiffness_rate, rest_length_rate, y_rate): (f64, f64, &[f64]),
    q: &V,
    q_rate: &V,
) -> V {
    let (y, y_rate) = (q.vector(y), q.vector(y_rate));
    if rest_length == 0.0 && rest_length_rate == 0.0 {
        let by_stiffness = y.scaled(q.number(-stiffness_rate));
        return by_stiffness.plus(&y_rate.scaled(q.number(-stiffness)));
    }
    let (arm, arm_rate) = (y.minus(q), y_rate.minus(q_rate));
    let r = arm.square().sqrt();
    let (ratio, r_rate) = (q.number(rest_length) / r, arm.dot(&arm_rate) / r);
    let ratio_rate = (-(ratio * r_rate) + rest_length_rate) / r;
    let pull_rate = (ratio + -1.0) * stiffness_rate + ratio_rate * stiffness;
    y.scaled(pull_rate).plus(&y_rate.scaled((ratio + -1.0) * stiffness))
}

pub(super) fn singular_point<'a, const N: usize>(
    _: f64,
    rest_length: &f64,
    y: &'a Vector<N>,
) -> Option<&'a Vector<N>> {
    (*rest_length > 0.0).then_some(y)
}
