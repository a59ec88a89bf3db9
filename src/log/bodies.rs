//! The samples of several bodies, as their solver gives them.

use crate::solve::nonlinear::Convergence;
use crate::solve::so::{Mat, Vector};
use crate::solve::system::Energy;

/// One sample of several bodies. Values that were not asked for are `None`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample<const N: usize> {
    /// Number of the step that ended here; 0 at the start.
    pub step: u64,
    /// Time in seconds since the start.
    pub time_s: f64,
    /// The bodies, in their order.
    pub bodies: Vec<BodySample<N>>,
    /// Energy H = T + U of all.
    pub energy: Option<Energy>,
    /// Energy now minus energy at the start.
    pub energy_error: Option<f64>,
    /// Largest spectral norm of g g^T - I of a body.
    pub orthogonality_error: Option<f64>,
    /// Total angular momentum about the origin, in space coordinates, skew.
    pub angular_momentum: Option<Mat<N>>,
    /// Total linear momentum in space coordinates, in kg m/s.
    pub linear_momentum: Option<Vector<N>>,
    /// Size of the change since the start of the momenta that are kept; `None` also where none is.
    pub momentum_drift: Option<f64>,
    /// How the nonlinear solver ended the step; `None` at the start.
    pub convergence: Option<Convergence>,
}

/// A body at the time of a sample.
#[derive(Clone, Debug, PartialEq)]
pub struct BodySample<const N: usize> {
    /// The attitude g.
    pub attitude: Mat<N>,
    /// The angular momentum in body coordinates, skew.
    pub momentum: Mat<N>,
    /// The angular velocity in body coordinates, skew.
    pub angular_velocity: Mat<N>,
    /// The centre of mass in space, in m; of a pinned body its pivot.
    pub position: Vector<N>,
    /// Its velocity in space coordinates, in m/s.
    pub velocity: Vector<N>,
    /// The linear momentum in space coordinates, in kg m/s.
    pub linear_momentum: Vector<N>,
}

/// State between two steps from which a trajectory of several bodies goes on to the bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Number of steps made.
    pub step: u64,
    /// Number of samples taken.
    pub samples: u64,
    /// Sweeps of the nonlinear solver in all.
    pub iterations: u64,
    /// How the last step was solved; `None` if none was made.
    pub convergence: Option<Convergence>,
    /// The whole state, in an order that only its solver knows.
    pub numbers: Vec<f64>,
}

impl<const N: usize> Sample<N> {
    /// Is every number of it finite?
    pub fn is_finite(&self) -> bool {
        let figures = [
            Some(self.time_s),
            self.energy.map(|energy| energy.kinetic),
            self.energy.map(|energy| energy.potential),
            self.energy.map(|energy| energy.total()),
            self.energy_error,
            self.orthogonality_error,
            self.momentum_drift,
            self.convergence.map(|convergence| convergence.increment),
        ];
        let finite = |x: &f64| x.is_finite();
        figures.iter().flatten().all(finite)
            && self.angular_momentum.iter().flat_map(|m| m.iter()).all(finite)
            && self.linear_momentum.iter().flat_map(|p| p.iter()).all(finite)
            && self.bodies.iter().all(BodySample::is_finite)
    }
}

impl<const N: usize> BodySample<N> {
    fn is_finite(&self) -> bool {
        let matrices = [&self.attitude, &self.momentum, &self.angular_velocity];
        let vectors = [&self.position, &self.velocity, &self.linear_momentum];
        matrices.iter().flat_map(|m| m.iter()).all(|x| x.is_finite())
            && vectors.iter().flat_map(|v| v.iter()).all(|x| x.is_finite())
    }
}
