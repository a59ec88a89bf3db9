//! SO(3) in coordinates of its own: vectors for so(3) and its dual, unit quaternions for attitudes.
//!
//! A unit quaternion q turns body vectors y into space vectors `q y q*`; `g' = g hat(Omega)` is
//! `q' = q Omega / 2`. Only arithmetic and square roots: the same bits everywhere.
//!
//! Invariant: [`unit()`] and [`rotation`] are inverse to each other up to the sign of q, to round-off.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::failure::Failure;
use super::state::State;

/// A point of T*SO(3): attitude and body momentum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Top {
    /// The attitude as a unit quaternion.
    pub attitude: Quaternion<f64>,
    /// The body momentum.
    pub momentum: Vector3<f64>,
}

impl Top {
    /// Creates the top at rest in the attitude 1.
    pub fn at_rest() -> Self {
        Self { attitude: Quaternion::identity(), momentum: Vector3::zeros() }
    }

    /// Converts `state` to the coordinates of this module.
    pub fn from_state(state: &State<3>) -> Self {
        Self { attitude: unit(&state.attitude), momentum: vee(&state.momentum) }
    }

    /// The point itself.
    ///
    /// # Errors
    /// [`super::failure::FailureCode::NonFinite`].
    pub fn finite(self) -> Result<Self, Failure> {
        if self.attitude.coords.iter().chain(&self.momentum).all(|x| x.is_finite()) {
            Ok(self)
        } else {
            Err(Failure::not_finite(None))
        }
    }
}

/// The skew matrix of a vector, `hat(v) y = v cross y`: [`crate::so::hat`] for a vector of fixed
/// size.
pub fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// The vector of a skew matrix: the inverse of [`hat`].
pub fn vee(x: &Matrix3<f64>) -> Vector3<f64> {
    Vector3::new(x[(2, 1)], x[(0, 2)], x[(1, 0)])
}

/// The quaternion `(0, v)`.
pub fn pure(v: &Vector3<f64>) -> Quaternion<f64> {
    Quaternion::from_imag(*v)
}

/// The unit quaternion of a rotation matrix; of the two, one is chosen by the entries.
pub fn unit(g: &Matrix3<f64>) -> Quaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*g)).normalize()
}

/// Normalises a quaternion whose length is one to about 1e-8, to round-off: one step of Newton's
/// for `1 / |q|`.
pub fn renormalised(q: &Quaternion<f64>) -> Quaternion<f64> {
    q * (1.5 - 0.5 * q.norm_squared())
}

/// The rotation matrix of a quaternion of any length but zero.
pub fn rotation(q: &Quaternion<f64>) -> Matrix3<f64> {
    unit_rotation(&q.normalize())
}

/// The rotation matrix of a quaternion that is of length one to round-off.
pub fn unit_rotation(q: &Quaternion<f64>) -> Matrix3<f64> {
    UnitQuaternion::new_unchecked(*q).to_rotation_matrix().into_inner()
}

/// Does the matrix map axis k to a multiple of itself, and the plane across it to itself?
pub(crate) fn is_axis(m: &Matrix3<f64>, [i, j, k]: [usize; 3]) -> bool {
    [m[(i, k)], m[(j, k)], m[(k, i)], m[(k, j)]] == [0.0; 4]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_and_matrices_agree() {
        let axis = Vector3::new(0.36, 0.48, -0.8);
        for (cos, sin) in [(1.0, 0.0), (0.8, 0.6), (0.0, 1.0), (-0.6, 0.8)] {
            let q = Quaternion::from_parts(cos, axis * sin);
            let g = rotation(&q);
            let y = Vector3::new(0.3, -0.2, 0.7);
            assert!((g * y - (q * pure(&y) * q.conjugate()).vector()).amax() < 1e-15);
            let back = unit(&g);
            assert!((back * back.dot(&q).signum() - q).norm() < 1e-15);
            assert!((vee(&hat(&y)) - y).amax() == 0.0);
        }
    }
}
