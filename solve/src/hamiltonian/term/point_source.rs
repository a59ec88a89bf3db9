//! A charge: `U = strength / r`, `r = |y - q|`.

use super::{Image, Real, Vector};

pub(super) fn value<const N: usize>(strength: f64, y: &Vector<N>, q: &Vector<N>) -> f64 {
    strength / (y - q).norm()
}

/// `dU/dq = strength (y - q) / r^3`; the part along q has no torque.
#[inline(always)]
pub(super) fn slope<V: Image>(
    strength: f64,
    y: &[f64],
    q: &V,
    reach: f64,
    nearness: &mut V::Number,
) -> V {
    let y = q.vector(y);
    let square = y.minus(q).square();
    *nearness = nearness.larger(square * -reach);
    y.scaled(q.number(strength) / (square * square.root()))
}
