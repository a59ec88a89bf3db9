//! A body in four dimensions on a spring: the time loop, with its samples.
//!
//!     cargo run --release -p vpd-solve --example so4

use std::convert::Infallible;
use std::error::Error;

use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{Ending, Observables, Sample, Schedule, Sink, integrate};

/// Keeps the largest errors of the samples.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Largest {
    /// Error of the energy, in J.
    pub energy: f64,
    /// Spectral norm of g g^T - I.
    pub orthogonality: f64,
    /// Drift of the momentum that the scene conserves, in kg m^2/s.
    pub drift: f64,
}

impl Sink<4> for Largest {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<4>) -> Result<(), Infallible> {
        self.energy = self.energy.max(sample.energy_error.unwrap_or(f64::NAN).abs());
        self.orthogonality = self.orthogonality.max(sample.orthogonality_error.unwrap_or(1.0));
        self.drift = self.drift.max(sample.momentum_drift.unwrap_or(1.0));
        Ok(())
    }
}

/// The largest errors of a run of 20 seconds.
pub(crate) fn run() -> Result<Largest, Box<dyn Error>> {
    // Second moments d_i along the axes: mu_ij = (d_i + d_j) Omega_ij.
    let kinetic = Kinetic::of_second_moments([0.5, 0.8, 1.1, 1.4]);
    let law = Law::Spring {
        stiffness: 2.0,
        rest_length: 0.5,
        body_point: Vector::<4>::new(0.0, 0.0, 0.0, 1.0),
    };
    let anchor = Vector::<4>::new(0.0, 0.0, 1.0, 1.0);
    let spring = Term { law, space: anchor };
    let body = RigidBody::new(kinetic, vec![spring], 0.0);
    // The entries above the diagonal, row by row.
    let momentum = so::hat(&[0.4, -0.2, 0.3, 0.1, 0.5, -0.6]);
    let start = State { attitude: Mat::identity(), momentum };

    let tableau = Tableau::gauss(3).ok_or("1 to 8 stages")?;
    let mut stepper = Vpd::new(tableau, StopRule::default());
    let schedule = Schedule { step_s: 0.02, steps: 1000, every: 10 };
    let observables =
        Observables { energy: true, orthogonality: true, momentum: true, ..Observables::default() };
    let mut largest = Largest::default();
    let end =
        integrate(&body, &mut stepper, &start, schedule, observables, &mut largest, |_| true)?;
    match end.ending {
        Ending::Failed(failure) => Err(failure.into()),
        Ending::Completed | Ending::Stopped(_) | Ending::Cancelled => Ok(largest),
    }
}

#[allow(clippy::print_stdout, dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    println!("{:?}", run()?);
    Ok(())
}
