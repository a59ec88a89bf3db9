//! A free body for n = 3: 10000 steps of the reduced method, and the quantities it keeps.
//!
//!     cargo run --release -p vpd-solve --example free_body

use std::error::Error;

use vpd_solve::hamiltonian::{Kinetic, RigidBody};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd_so3::VpdSo3;
use vpd_solve::tableau::Tableau;

/// The largest errors of the energy (J) and of the length of the momentum (kg m^2/s) over the run.
pub(crate) fn run() -> Result<(f64, f64), Box<dyn Error>> {
    // Moments of inertia about the axes, in kg m^2: entry (i, j) is about the third axis.
    let moments = [1.0, 2.0, 3.0];
    let body = RigidBody::<3>::new(Kinetic::of_moments(moments), Vec::new(), 0.0);
    // About the middle axis, the unstable one.
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.01, 2.0, 0.01]) };
    let tableau = Tableau::gauss(2).ok_or("1 to 8 stages")?;
    let stepper = VpdSo3::new(tableau, StopRule::default()).ok_or("at most 8 stages")?;
    let mut stepper = stepper.reduced(true);

    stepper.start(&start);
    let energy = |mu: &Mat<3>| body.energy(&Mat::identity(), mu).total();
    let length = |mu: &Mat<3>| so::inner(mu, mu).sqrt();
    let (mut energy_error, mut length_error) = (0.0_f64, 0.0_f64);
    for _ in 0..10_000 {
        stepper.step(&body, 0.01)?;
        let mu = stepper.momentum();
        energy_error = energy_error.max((energy(&mu) - energy(&start.momentum)).abs());
        length_error = length_error.max((length(&mu) - length(&start.momentum)).abs());
    }
    Ok((energy_error, length_error))
}

#[allow(clippy::print_stdout, dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    let (energy, length) = run()?;
    println!("energy off by {energy:.1e} J, the momentum by {length:.1e} kg m^2/s");
    Ok(())
}
