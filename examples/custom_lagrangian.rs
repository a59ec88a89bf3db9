//! A user-defined Lagrangian without a known Hamiltonian: quartic kinetic energy in a magnetic
//! field, in four dimensions, and its log.
//!
//!     cargo run --release --example custom_lagrangian

use std::error::Error;
use std::io::Write;
use std::path::Path;

use vpd::run::{Control, JobContext, Recording, Summary};
use vpd::solve::lagrangian::{self, Lagrangian};
use vpd::solve::nonlinear::StopRule;
use vpd::solve::so::{self, Mat};
use vpd::solve::state::State;
use vpd::solve::stepper::vpd_lagrangian::VpdLagrangian;
use vpd::solve::system::Energy;
use vpd::solve::system::System;
use vpd::solve::tableau::Tableau;
use vpd::solve::trajectory::Schedule;

/// `L = <Omega, Omega> / 2 + c <Omega, Omega>^2 / 4 + <g^T A g, Omega>`
struct Charged {
    quartic: f64,
    /// A, skew, in space.
    field: Mat<4>,
}

impl System<4> for Charged {
    fn energy(&self, g: &Mat<4>, mu: &Mat<4>) -> Energy {
        lagrangian::energy(self, g, mu)
    }
}

impl Lagrangian<4> for Charged {
    fn value(&self, g: &Mat<4>, omega: &Mat<4>) -> f64 {
        let square = so::inner(omega, omega);
        let field = g.transpose() * self.field * g;
        0.5 * square + 0.25 * self.quartic * square * square + so::inner(&field, omega)
    }

    fn momentum(&self, g: &Mat<4>, omega: &Mat<4>) -> Mat<4> {
        let stretch = 1.0 + self.quartic * so::inner(omega, omega);
        omega * stretch + g.transpose() * self.field * g
    }

    fn force(&self, g: &Mat<4>, omega: &Mat<4>) -> Mat<4> {
        let b = g.transpose() * self.field * g;
        omega * b - b * omega
    }
}

/// Writes `charged.mcap` into a folder.
pub(crate) fn run(folder: &Path) -> Result<Summary, Box<dyn Error>> {
    let field = so::hat(&[0.3, -0.2, 0.5, 0.1, 0.0, 0.4]);
    let system = Charged { quartic: 0.7, field };
    let momentum = so::hat(&[0.6, 0.2, -0.4, 0.3, 0.9, -0.1]);
    let start = State { attitude: Mat::identity(), momentum };

    let tableau = Tableau::gauss(3).ok_or("1 to 8 stages")?;
    let mut stepper = VpdLagrangian::new(tableau, StopRule::default());
    let schedule = Schedule { step_s: 0.05, steps: 2000, every: 10 };
    let log = folder.join("charged.mcap");
    let mut recording = Recording::new("charged");
    recording.notes.insert("system".to_owned(), "quartic kinetic energy, field A".to_owned());
    let context = JobContext { log: &log, control: &Control::default() };
    Ok(recording.run(&system, &mut stepper, &start, schedule, &context)?)
}

#[allow(dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    let summary = run(&std::env::temp_dir())?;
    let mut out = std::io::stdout();
    writeln!(out, "{}: {}, {:?}", summary.log, summary.outcome.as_str(), summary.energy)?;
    Ok(())
}
