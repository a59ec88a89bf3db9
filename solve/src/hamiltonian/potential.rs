//! User-defined potentials, in addition to the built-in terms.

use std::fmt::Debug;
use std::sync::Arc;

use super::RigidBody;
use crate::failure::Failure;
use crate::so::{self, Mat, Vector};

/// A potential energy U(g) by its value and its derivative.
///
/// `g` turns body coordinates into space coordinates, `x = g y`. It is on the group to rounding, except in the stages of
/// [`crate::stepper::rk::Rk`], which leaves the group; while an iteration diverges it may hold NaN. A law that has no
/// value answers NaN: the step then fails by name.
///
/// ```
/// use std::sync::Arc;
/// use vpd_solve::hamiltonian::{Kinetic, Potential, RigidBody, gradient_error};
/// use vpd_solve::so::{self, Mat, Vector};
///
/// /// `U = stiffness / 2 g_33^2`: the axis e_3 of the body is drawn to the plane across e_3 of space.
/// #[derive(Debug)]
/// struct Hinge { stiffness: f64 }
///
/// impl Potential<3> for Hinge {
///     fn energy(&self, g: &Mat<3>) -> f64 {
///         0.5 * self.stiffness * g[(2, 2)] * g[(2, 2)]
///     }
///
///     fn gradient(&self, g: &Mat<3>) -> Mat<3> {
///         // D = dU/dg entry by entry, then asym(g^T D).
///         let mut d = Mat::zeros();
///         d[(2, 2)] = self.stiffness * g[(2, 2)];
///         so::asym(&(g.transpose() * d))
///     }
///
///     // A turn about e_3 of space changes nothing: the momentum about it is conserved, and its drift measured.
///     fn space_vectors(&self) -> Vec<Vector<3>> {
///         vec![Vector::z()]
///     }
/// }
///
/// let hinge = Hinge { stiffness: 0.3 };
/// // A gradient of the wrong sign or size runs, too; the energy error then does not fall with the step.
/// assert!(gradient_error(&hinge, &so::exp(&so::hat(&[0.3, -0.5, 0.9]))) < 1e-8);
/// let kinetic = Kinetic::of_moments([1.0, 2.0, 2.5]);
/// let body = RigidBody::new(kinetic, Vec::new(), 0.0).with_potential(Arc::new(hinge));
/// ```
pub trait Potential<const N: usize>: Debug + Send + Sync {
    /// U(g) in J.
    fn energy(&self, g: &Mat<N>) -> f64;

    /// dU/dg in J (per radian), left-trivialised and skew, n x n, in the body frame:
    /// `<gradient, eta> = d/de U(g exp(e eta))` for every skew eta, with `<X, Y> = tr(X Y^T) / 2`. It is minus the torque
    /// on the body, and `asym(g^T D)` for the matrix `D_ij = dU/dg_ij`. Only its skew part is used.
    fn gradient(&self, g: &Mat<N>) -> Mat<N>;

    /// The gradients at several attitudes, most often the stages of a step: for a law that it takes longer to call than to
    /// compute. One for each attitude.
    fn gradients(&self, g: &[Mat<N>]) -> Vec<Mat<N>> {
        g.iter().map(|g| self.gradient(g)).collect()
    }

    /// Space vectors v through whose body images `g^T v` alone U depends on g: rotations of space that keep them are
    /// symmetries. Unless it says otherwise a potential depends on all axes, and has none. A list that is too short makes a
    /// drift of a momentum that is not conserved.
    fn space_vectors(&self) -> Vec<Vector<N>> {
        axes().collect()
    }

    /// Refuses an attitude at which the potential has lost its meaning.
    ///
    /// # Errors
    /// The failure to report: [`crate::failure::FailureCode::PotentialSingularity`] is meant for this.
    fn check(&self, _g: &Mat<N>) -> Result<(), Failure> {
        Ok(())
    }
}

/// Returns how far `gradient` is from the derivative of `energy` at `g`: the largest difference
/// from central differences of the energy along the axes of so(n), in parts of the largest of
/// either. About 1e-9 where the two agree, 2 where the sign is wrong; NaN where one of them is.
pub fn gradient_error<const N: usize>(potential: &dyn Potential<N>, g: &Mat<N>) -> f64 {
    /// Half the interval of a difference, in radians: the errors by curvature and by rounding are
    /// then about equal.
    const TURN_RAD: f64 = 1e-5;
    let gradient = so::vee(&so::skew(&potential.gradient(g)));
    let slope = |k: usize| {
        let energy = |turn: f64| {
            let mut eta = vec![0.0; so::dimension(N)];
            eta[k] = turn;
            potential.energy(&so::product(g, &so::exp(&so::hat(&eta))))
        };
        (energy(TURN_RAD) - energy(-TURN_RAD)) / (2.0 * TURN_RAD)
    };
    let (mut difference, mut largest) = (0.0_f64, 0.0_f64);
    for (k, given) in gradient.into_iter().enumerate() {
        let slope = slope(k);
        if !(given - slope).is_finite() {
            return f64::NAN;
        }
        difference = difference.max((given - slope).abs());
        largest = largest.max(given.abs()).max(slope.abs());
    }
    if largest > 0.0 { difference / largest } else { 0.0 }
}

/// The axes of space.
pub(super) fn axes<const N: usize>() -> impl Iterator<Item = Vector<N>> {
    (0..N).map(|k| Vector::from_fn(|i, _| if i == k { 1.0 } else { 0.0 }))
}

/// The potentials that are no built-in terms. They see the attitude through the axes of space.
#[derive(Clone, Debug, Default)]
pub(super) struct UserPotentials<const N: usize> {
    laws: Vec<Arc<dyn Potential<N>>>,
    /// The axes of space, if there is a law.
    pub(super) axes: Vec<Vector<N>>,
}

impl<const N: usize> UserPotentials<N> {
    pub(super) fn push(&mut self, law: Arc<dyn Potential<N>>) {
        self.laws.push(law);
        self.axes = axes().collect();
    }

    pub(super) fn is_empty(&self) -> bool {
        self.laws.is_empty()
    }

    pub(super) fn space_vectors(&self) -> Vec<Vector<N>> {
        self.laws.iter().flat_map(|law| law.space_vectors()).collect()
    }

    /// Returns `start` plus the energies of the laws.
    pub(super) fn energy(&self, start: f64, g: &Mat<N>) -> f64 {
        self.laws.iter().fold(start, |sum, law| sum + law.energy(g))
    }

    pub(super) fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let sum = self.laws.iter().fold(Mat::zeros(), |sum, law| sum + law.gradient(g));
        // A sum that is skew to the bit stays as it is.
        so::skew(&sum)
    }

    /// [`Self::gradient`] at each of the attitudes; NaN where a law answers for too few.
    pub(super) fn gradients(&self, g: &[Mat<N>]) -> Vec<Mat<N>> {
        let mut sums = vec![Mat::zeros(); g.len()];
        for law in &self.laws {
            let found = law.gradients(g).into_iter();
            let found = found.chain(std::iter::repeat(Mat::repeat(f64::NAN)));
            sums.iter_mut().zip(found).for_each(|(sum, gradient)| *sum += gradient);
        }
        sums.iter().map(so::skew).collect()
    }

    pub(super) fn check(&self, g: &Mat<N>) -> Result<(), Failure> {
        self.laws.iter().try_for_each(|law| law.check(g))
    }

    /// `g = g0 u`, given the axes as they are seen from g0: row i of g is `u^T (g0^T e_i)`.
    pub(super) fn attitude(u: &Mat<N>, axes: &[Vector<N>]) -> Mat<N> {
        let mut g = Mat::<N>::zeros();
        for (i, axis) in axes.iter().enumerate().take(N) {
            let row = so::to_body(u, axis);
            for j in 0..N {
                g[(i, j)] = row[j];
            }
        }
        g
    }
}

impl<const N: usize> RigidBody<N> {
    /// Adds a user-defined potential, which acts in addition to the built-in terms.
    pub fn with_potential(mut self, potential: Arc<dyn Potential<N>>) -> Self {
        self.user.push(potential);
        self
    }

    /// Is there a potential that is no built-in term?
    pub(crate) fn has_user_potential(&self) -> bool {
        !self.user.is_empty()
    }
}
