//! Left-trivialised Lagrangians L(g, Omega) on TSO(n).
//!
//! The Lagrangian form of VPD asks for no more than the derivatives below: a system need not have, or
//! need not give, its Hamiltonian.

use nalgebra::DMatrix;

use super::hamiltonian::RigidBody;
use super::so::{self, Mat};

/// A Lagrangian by its two derivatives.
pub trait Lagrangian<const N: usize> {
    /// dL/dOmega at attitude `g` and body velocity `omega`: the body momentum, skew.
    fn momentum(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N>;

    /// dL/dg at `g` and `omega`, left-trivialised and skew.
    fn force(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N>;

    /// Refuses an attitude at which the Lagrangian has lost its meaning.
    ///
    /// # Errors
    /// The failure to report.
    fn check(&self, _g: &Mat<N>) -> Result<(), super::failure::Failure> {
        Ok(())
    }

    /// Takes note of a sweep that begins.
    ///
    /// # Errors
    /// If it is not to begin: see [`super::work`].
    fn begin_sweep(&self) -> Result<(), super::failure::Failure> {
        Ok(())
    }
}

impl<const N: usize> Lagrangian<N> for RigidBody<N> {
    fn momentum(&self, _g: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        self.momentum(omega)
    }

    fn force(&self, g: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        // L = T - U
        -self.gradient_at(g)
    }

    fn check(&self, g: &Mat<N>) -> Result<(), super::failure::Failure> {
        self.check_distances_at(g)
    }

    fn begin_sweep(&self) -> Result<(), super::failure::Failure> {
        self.work().begin_sweep()
    }
}

/// The inverse of the Legendre transform's derivative, d^2L/dOmega^2, at one attitude and velocity: a dense
/// n(n-1)/2 square from central differences, for Newton's method on Omega.
///
/// `None` if it is singular: the Lagrangian is not hyperregular there.
pub fn inverse_hessian<const N: usize>(
    lagrangian: &dyn Lagrangian<N>,
    g: &Mat<N>,
    omega: &Mat<N>,
) -> Option<DMatrix<f64>> {
    let dimension = so::dimension(N);
    // Exact for quadratic Lagrangians; else an error of 1e-10, which Newton's method forgives.
    let e = 1e-5 * omega.amax().max(1.0);
    let mut hessian = DMatrix::zeros(dimension, dimension);
    for j in 0..dimension {
        let mut unit = vec![0.0; dimension];
        unit[j] = e;
        let change = so::hat::<N>(&unit);
        let ahead = lagrangian.momentum(g, &(omega + change));
        let behind = lagrangian.momentum(g, &(omega - change));
        for (i, slope) in so::vee(&((ahead - behind) / (2.0 * e))).into_iter().enumerate() {
            hessian[(i, j)] = slope;
        }
    }
    hessian.try_inverse().filter(|inverse| inverse.iter().all(|x| x.is_finite()))
}

/// The velocity with the body momentum `mu` at `g`, by Newton's method from `guess`: the inverse Legendre
/// transform.
///
/// `None` if the method does not converge.
pub fn velocity_of_momentum<const N: usize>(
    lagrangian: &dyn Lagrangian<N>,
    g: &Mat<N>,
    mu: &Mat<N>,
    guess: &Mat<N>,
) -> Option<Mat<N>> {
    const MAX_ITERATIONS: usize = 50;
    let mut omega = *guess;
    let mut previous = f64::INFINITY;
    for _ in 0..MAX_ITERATIONS {
        let inverse = inverse_hessian(lagrangian, g, &omega)?;
        let change = corrected(&inverse, &(lagrangian.momentum(g, &omega) - mu));
        omega -= change;
        let size = change.amax();
        if !size.is_finite() {
            return None;
        }
        if size <= 1e-15 * omega.amax() || (size >= previous && size <= 1e-12 * omega.amax()) {
            return Some(omega);
        }
        previous = size;
    }
    None
}

/// `(d^2L/dOmega^2)^-1` applied to a residual of the momentum.
pub(super) fn corrected<const N: usize>(inverse: &DMatrix<f64>, residual: &Mat<N>) -> Mat<N> {
    let residual = nalgebra::DVector::from_vec(so::vee(residual));
    so::hat::<N>((inverse * residual).as_slice())
}
