//! Left-trivialised Lagrangians L(g, Omega) on TSO(n).
//!
//! The Lagrangian form of VPD asks for no more than the derivatives below: a system need not have, or
//! need not give, its Hamiltonian.

use nalgebra::DMatrix;

use super::hamiltonian::RigidBody;
use super::nonlinear::SMALLEST_SIZE;
use super::so::{self, Mat};
use super::system::{Energy, System};

/// A Lagrangian L(g, Omega), for [`crate::stepper::vpd_lagrangian::VpdLagrangian`]: the steps ask for its two derivatives,
/// [`energy`] for its value.
///
/// The attitude `g` turns body into space coordinates; `omega` is the angular velocity in the body frame, skew n x n, in
/// rad/s, with `g' = g omega`. Pairings are `<X, Y> = tr(X Y^T) / 2`.
pub trait Lagrangian<const N: usize>: System<N> {
    /// L in J.
    fn value(&self, g: &Mat<N>, omega: &Mat<N>) -> f64;

    /// dL/dOmega at attitude `g` and body velocity `omega`: the body momentum, skew, in kg m^2/s. Its derivative in
    /// Omega must be invertible (the Lagrangian is hyperregular).
    fn momentum(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N>;

    /// dL/dg at `g` and a fixed `omega`, left-trivialised and skew, in J, in the body frame:
    /// `<force, eta> = d/de L(g exp(e eta), omega)`.
    fn force(&self, g: &Mat<N>, omega: &Mat<N>) -> Mat<N>;

    /// The velocity whose momentum at `g` is `mu`, where a formula gives it: the inverse Legendre transform. Without one it
    /// is found by Newton's method from [`Lagrangian::momentum`].
    fn inverse_legendre(&self, _g: &Mat<N>, _mu: &Mat<N>) -> Option<Mat<N>> {
        None
    }

    /// The system as a rigid body, if it is one: it may be driven.
    fn as_body(&self) -> Option<&RigidBody<N>> {
        None
    }
}

impl<const N: usize> Lagrangian<N> for RigidBody<N> {
    fn as_body(&self) -> Option<&RigidBody<N>> {
        Some(self)
    }

    fn value(&self, g: &Mat<N>, omega: &Mat<N>) -> f64 {
        let Energy { kinetic, potential } = self.energy(g, &self.momentum(omega));
        kinetic - potential
    }

    fn momentum(&self, _g: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        self.momentum(omega)
    }

    fn inverse_legendre(&self, _g: &Mat<N>, mu: &Mat<N>) -> Option<Mat<N>> {
        Some(self.velocity(mu))
    }

    fn force(&self, g: &Mat<N>, _omega: &Mat<N>) -> Mat<N> {
        // L = T - U
        -self.gradient(g)
    }
}

/// The energy `<mu, Omega> - L` of a Lagrangian at a state, for its [`System::energy`]: `-L(g, 0)`
/// is the potential part and the rest the kinetic one, as for `L = T - U`. NaN where the momentum
/// `mu` has no velocity.
pub fn energy<const N: usize>(
    lagrangian: &(impl Lagrangian<N> + ?Sized),
    g: &Mat<N>,
    mu: &Mat<N>,
) -> Energy {
    let potential = -lagrangian.value(g, &Mat::zeros());
    match velocity_of_momentum(lagrangian, g, mu, &Mat::zeros()) {
        Some(omega) => {
            let total = so::inner(mu, &omega) - lagrangian.value(g, &omega);
            Energy { kinetic: total - potential, potential }
        }
        None => Energy { kinetic: f64::NAN, potential },
    }
}

/// The inverse of the Legendre transform's derivative, d^2L/dOmega^2, at one attitude and velocity: a dense
/// n(n-1)/2 square from central differences, for Newton's method on Omega.
///
/// `None` if it is singular: the Lagrangian is not hyperregular there.
pub fn inverse_hessian<const N: usize>(
    lagrangian: &(impl Lagrangian<N> + ?Sized),
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

/// The velocity with the body momentum `mu` at `g`: the inverse Legendre transform, by its formula if there is one, else by
/// Newton's method from `guess`.
///
/// `None` if the method does not converge.
pub fn velocity_of_momentum<const N: usize>(
    lagrangian: &(impl Lagrangian<N> + ?Sized),
    g: &Mat<N>,
    mu: &Mat<N>,
    guess: &Mat<N>,
) -> Option<Mat<N>> {
    const MAX_ITERATIONS: usize = 50;
    if let Some(omega) = lagrangian.inverse_legendre(g, mu) {
        return Some(omega);
    }
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
        let whole = omega.amax().max(SMALLEST_SIZE);
        if size <= 1e-15 * whole || (size >= previous && size <= 1e-12 * whole) {
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
