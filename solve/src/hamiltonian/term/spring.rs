//! A spring: `U = stiffness / 2 (r - rest_length)^2`, `r = |y - q|`.

use super::{Image, Real, Vector};

pub(super) fn value<const N: usize>(
    stiffness: f64,
    rest_length: f64,
    y: &Vector<N>,
    q: &Vector<N>,
) -> f64 {
    let stretch = (y - q).norm() - rest_length;
    0.5 * stiffness * stretch * stretch
}

/// `dU/dq = -stiffness (1 - rest_length / r) (y - q)`; the part along q has no torque.
#[inline(always)]
pub(super) fn slope<V: Image>(
    stiffness: f64,
    rest_length: f64,
    y: &[f64],
    q: &V,
    reach: f64,
    nearness: &mut V::Number,
) -> V {
    let y = q.vector(y);
    if rest_length == 0.0 {
        return y.scaled(q.number(-stiffness));
    }
    let square = y.minus(q).square();
    *nearness = nearness.larger(square * -reach);
    let ratio = q.number(rest_length) / square.root();
    y.scaled((ratio + -1.0) * stiffness)
}
