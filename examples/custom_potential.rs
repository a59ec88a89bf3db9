//! A user-defined potential in space: a log that viewers open, and the chart of its energy.
//!
//!     cargo run --release --example custom_potential

use std::error::Error;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use vpd::chart::draw_log;
use vpd::log::course::LogChart;
use vpd::run::{Control, JobContext, Recording, Summary};
use vpd::solve::hamiltonian::{Kinetic, Law, Potential, RigidBody, Term};
use vpd::solve::nonlinear::StopRule;
use vpd::solve::so::{self, Mat, Vector};
use vpd::solve::state::State;
use vpd::solve::stepper::vpd_so3::VpdSo3;
use vpd::solve::tableau::Tableau;
use vpd::solve::trajectory::Schedule;

/// Cubic anisotropy, as of a magnetised grain in a crystal: `U = strength (x^4 + y^4 + z^4)` for `(x, y, z) = g e_3`.
#[derive(Debug)]
struct Cubic {
    strength: f64,
}

impl Potential<3> for Cubic {
    fn energy(&self, g: &Mat<3>) -> f64 {
        self.strength * g.column(2).iter().map(|x| x * x * x * x).sum::<f64>()
    }

    fn gradient(&self, g: &Mat<3>) -> Mat<3> {
        // D = dU/dg entry by entry, then asym(g^T D).
        let mut d = Mat::zeros();
        for i in 0..3 {
            d[(i, 2)] = 4.0 * self.strength * g[(i, 2)] * g[(i, 2)] * g[(i, 2)];
        }
        so::asym(&(g.transpose() * d))
    }
}

/// Writes `cubic.mcap` and `energy.svg` into a folder.
pub(crate) fn run(folder: &Path) -> Result<Summary, Box<dyn Error>> {
    let moments = [0.02, 0.02, 0.01];
    // In addition to a built-in term, the weight of the body.
    let up = Vector::<3>::new(0.0, 0.0, 1.0);
    let weight = Term { law: Law::Uniform { weight: 0.3, body_point: up }, space: up };
    let body = RigidBody::new(Kinetic::of_moments(moments), vec![weight], 0.0)
        .with_potential(Arc::new(Cubic { strength: 0.5 }));
    let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.02, 0.05, 0.1]) };

    let tableau = Tableau::gauss(2).ok_or("1 to 8 stages")?;
    let mut stepper = VpdSo3::new(tableau, StopRule::default()).ok_or("at most 8 stages")?;
    let schedule = Schedule { step_s: 0.005, steps: 4000, every: 4 };
    let log = folder.join("cubic.mcap");
    let context = JobContext { log: &log, control: &Control::default() };
    let summary = Recording::new("cubic").run(&body, &mut stepper, &start, schedule, &context)?;
    std::fs::write(folder.join("energy.svg"), draw_log(&log, LogChart::Energy)?)?;
    Ok(summary)
}

#[allow(dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::temp_dir();
    let summary = run(&folder)?;
    let mut out = std::io::stdout();
    writeln!(out, "{}: {}, {:?}", summary.log, summary.outcome.as_str(), summary.energy)?;
    Ok(())
}
