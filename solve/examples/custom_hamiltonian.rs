//! A Hamiltonian of one's own that is no sum of kinetic and potential energy: a charged body in a magnetic field.
//!
//!     cargo run --release -p vpd-solve --example custom_hamiltonian

use std::error::Error;

use vpd_solve::hamiltonian::Hamiltonian;
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::system::{Energy, System, free_directions};
use vpd_solve::tableau::Tableau;

/// `H = <w nu, nu> / 2` with `nu = mu - g^T A g`, w entry by entry: the field A stands in space.
struct Charged {
    weights: Mat<3>,
    field: Mat<3>,
}

impl Charged {
    fn field(&self, g: &Mat<3>) -> Mat<3> {
        g.transpose() * self.field * g
    }
}

impl System<3> for Charged {
    fn energy(&self, g: &Mat<3>, mu: &Mat<3>) -> Energy {
        let nu = mu - self.field(g);
        Energy { kinetic: 0.5 * so::inner(&nu, &nu.component_mul(&self.weights)), potential: 0.0 }
    }

    fn conserved_directions(&self) -> Option<Mat<3>> {
        // Turns about the axis of the field leave it as it is.
        let axis = Vector::<3>::from_vec(so::vee(&self.field));
        free_directions([&axis])
    }
}

impl Hamiltonian<3> for Charged {
    fn velocity(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
        (mu - self.field(g)).component_mul(&self.weights)
    }

    fn gradient(&self, g: &Mat<3>, mu: &Mat<3>) -> Mat<3> {
        // With b = g^T A g: db = [b, eta], so dH = -<Omega, [b, eta]> = <[b, Omega], eta>.
        let (b, omega) = (self.field(g), self.velocity(g, mu));
        b * omega - omega * b
    }
}

/// The largest error of the energy over 100 seconds in steps of `step_s`, the distance from the group at the end, and the
/// drift of the momentum about the field.
pub(crate) fn run(step_s: f64) -> Result<[f64; 3], Box<dyn Error>> {
    let weights = Mat::<3>::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (i + j) as f64 });
    let system = Charged { weights, field: so::hat(&[0.0, 0.0, 0.8]) };
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.5, 0.4, 1.0]) };
    let tableau = Tableau::gauss(2).ok_or("1 to 8 stages")?;
    let mut stepper = Vpd::new(tableau, StopRule::default());
    stepper.start(&start);
    let at_start = system.energy(&start.attitude, &start.momentum).total();
    let (mut error, mut g) = (0.0_f64, start.attitude);
    for _ in 0..(100.0 / step_s) as u32 {
        stepper.step(&system, step_s)?;
        g = stepper.attitude().unwrap_or(g);
        let energy = system.energy(&g, &stepper.momentum()).total();
        error = error.max((energy - at_start).abs());
    }
    let free = system.conserved_directions().ok_or("two directions")?;
    let change = so::conjugate(&g, &stepper.momentum()) - start.momentum;
    Ok([error, so::orthogonality_error(&g), (free * change * free).amax()])
}

#[allow(clippy::print_stdout, dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    for step_s in [0.1, 0.05] {
        let [energy, group, drift] = run(step_s)?;
        println!("step {step_s} s: energy {energy:.1e}, group {group:.1e}, momentum {drift:.1e}");
    }
    Ok(())
}
