//! The system as the time loop sees it, whatever the law by which it moves.
//!
//! A system has its energy here and its law in one of two forms: [`crate::hamiltonian::Hamiltonian`] or
//! [`crate::lagrangian::Lagrangian`]. A body with built-in terms, [`crate::hamiltonian::RigidBody`], has both.

use super::failure::Failure;
use super::pointing::Pointed;
use super::so::{self, Mat, Vector};
use super::stop::Stop;

/// Kinetic and potential energy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Energy {
    /// T.
    pub kinetic: f64,
    /// U.
    pub potential: f64,
}

impl Energy {
    /// H = T + U.
    pub fn total(&self) -> f64 {
        self.kinetic + self.potential
    }
}

/// A system on T*SO(n). States are left-trivialised: the attitude `g` turns body coordinates into space coordinates
/// (n x n, on the group to rounding), the momentum `mu` is the skew n x n matrix in the body frame, in kg m^2/s.
pub trait System<const N: usize> {
    /// Energy at a state, in J. A system that does not fall into kinetic and potential energy gives H as the kinetic
    /// part and zero for the other. Where there is no energy the answer is NaN: the run then ends with a named failure.
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy;

    /// Energy at a time in seconds, for a system that changes with it.
    fn energy_at(&self, _time_s: f64, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        self.energy(g, mu)
    }

    /// dH/dmu at a time in seconds, the body angular velocity, for observers: for a Hamiltonian its `velocity`. `None`
    /// for a system that does not name it.
    fn observed_velocity(&self, _time_s: f64, _g: &Mat<N>, _mu: &Mat<N>) -> Option<Mat<N>> {
        None
    }

    /// Does the energy change with time, or by torques that are no potential's? Then the answer of
    /// [`super::stepper::Stepper::work`] counts.
    fn is_driven(&self) -> bool {
        false
    }

    /// Do torques act that are no potential's? Then the answer of
    /// [`super::stepper::Stepper::impulse`] counts.
    fn is_pushed(&self) -> bool {
        false
    }

    /// The first time later than `after_s`, in seconds, at which the law is not smooth: a knot of a table. The time loop
    /// ends a step there, so that methods keep their order. Infinite if there is none.
    fn next_knot(&self, _after_s: f64) -> f64 {
        f64::INFINITY
    }

    /// The energy in J by which the potential jumps at a knot, at the attitude `g`.
    fn jump(&self, _knot_s: f64, _g: &Mat<N>) -> f64 {
        0.0
    }

    /// The impulse of torques that are given over time, from t = 0 to `time_s`, in N m s: the exact integral of their
    /// strengths, each times the size of its torque, added up. `None` if there are none. Steps must have put in the same.
    fn table_impulse(&self, _time_s: f64) -> Option<f64> {
        None
    }

    /// The projection `Q` (symmetric, n x n, space coordinates) onto directions whose rotations leave the energy as it is, two or
    /// more: then `Q m Q` is conserved, `m = g mu g^T`, but for the impulse of torques that are no potential's. `None` if
    /// there are none, or none are known. See [`free_directions`].
    fn conserved_directions(&self) -> Option<Mat<N>> {
        None
    }

    /// The rate `W` (skew, n x n, space coordinates, rad/s) of a uniformly turning frame in which nothing of a driven system changes:
    /// then the Jacobi integral `H - <W, m>` is conserved, `m = g mu g^T` and `<A, B> = tr(A^T B) / 2`. `None` if there is
    /// none, or none is known.
    fn turning_frame(&self) -> Option<Mat<N>> {
        None
    }

    /// Conditions that end a run early, looked at after each step.
    fn stops(&self) -> &[Stop<N>] {
        &[]
    }

    /// Where the body points at a time in seconds, with the angular velocity `omega`; `None` unless the scene asks for it.
    fn pointed(&self, _time_s: f64, _g: &Mat<N>, _omega: &Mat<N>) -> Option<Pointed> {
        None
    }

    /// Refuses an attitude at which the law has lost its meaning.
    ///
    /// # Errors
    /// The failure to report.
    fn check(&self, _g: &Mat<N>) -> Result<(), Failure> {
        Ok(())
    }

    /// Takes note of a sweep of the nonlinear solver that begins.
    ///
    /// # Errors
    /// Fails if it is not to begin: see [`super::work`].
    fn begin_sweep(&self) -> Result<(), Failure> {
        Ok(())
    }
}

/// The projection onto the space directions across all of `vectors`, for [`System::conserved_directions`] of a system
/// that depends on the attitude through their body images `g^T v` alone. `None` if fewer than two are left.
pub fn free_directions<'a, const N: usize>(
    vectors: impl IntoIterator<Item = &'a Vector<N>>,
) -> Option<Mat<N>> {
    // Gram and Schmidt, twice for round-off.
    let mut q = Mat::<N>::identity();
    let mut free = N;
    for vector in vectors {
        let rest = so::to_space(&q, &so::to_space(&q, vector));
        let size = so::norm(rest.as_slice());
        if size > 1e-12 * so::norm(vector.as_slice()) {
            let direction = rest / size;
            for j in 0..N {
                for i in 0..N {
                    q[(i, j)] -= direction[i] * direction[j];
                }
            }
            free -= 1;
        }
        if free < 2 {
            return None;
        }
    }
    Some(q)
}
