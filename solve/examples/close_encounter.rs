//! An arm that swings past an attracting point at a hundredth of its length: steps that adapt next to steps of one length.
//!
//!     cargo run --release -p vpd-solve --example close_encounter

use std::convert::Infallible;
use std::error::Error;

use vpd_solve::hamiltonian::{Kinetic, Law, RigidBody, Term, TimeScale};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Vector};
use vpd_solve::state::State;
use vpd_solve::stepper::Stepper;
use vpd_solve::stepper::vpd::Vpd;
use vpd_solve::stepper::vpd_adaptive::VpdAdaptive;
use vpd_solve::tableau::Tableau;
use vpd_solve::trajectory::{Ending, Observables, Sample, Schedule, Sink, integrate};

/// The largest |H - H0| of the samples, in J.
#[derive(Default)]
struct Largest(f64);

impl Sink<3> for Largest {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<3>) -> Result<(), Infallible> {
        self.0 = self.0.max(sample.energy_error.unwrap_or(f64::NAN).abs());
        Ok(())
    }
}

/// The largest energy error, and the torques that it took; `None` if a step failed.
type Tried = Option<(f64, u64)>;

/// Eight seconds of steps that adapt, and of steps of one length.
pub(crate) fn run() -> Result<[Tried; 2], Box<dyn Error>> {
    let moments = [1.0, 1.2, 0.4];
    let weight = Law::Uniform { weight: 1.0, body_point: Vector::<3>::new(0.0, 0.0, -1.0) };
    let charge = Law::PointSource { strength: -1.0, body_point: Vector::<3>::new(0.0, 0.05, -1.0) };
    let terms = vec![
        Term { law: weight, space: Vector::<3>::new(0.0, 0.0, 1.0) },
        Term { law: charge, space: Vector::<3>::new(0.0, 0.0, -1.011_249_2) },
    ];
    let body = RigidBody::new(Kinetic::of_moments(moments), terms, 0.0);
    let turn = Vector::<3>::new(1.0, 0.2, 0.0).normalize();
    let start = State {
        attitude: so::exp(&so::hat(turn.as_slice())),
        momentum: body.momentum(&so::hat(&[0.1, 0.0, 0.05])),
    };
    let tableau = Tableau::gauss(4).ok_or("1 to 8 stages")?;
    let scale = TimeScale::of(&body).ok_or("a point source")?;
    // Samples every 0.02 s, whatever the steps are.
    let schedule = Schedule { step_s: 0.02, steps: 400, every: 1 };
    let observables = Observables { energy: true, ..Observables::default() };
    let mut torques = body.work().gradients();
    let mut tried = |stepper: &mut dyn Stepper<3>| {
        let mut largest = Largest::default();
        let Ok(end) =
            integrate(&body, stepper, &start, schedule, observables, &mut largest, |_| true);
        let taken = body.work().gradients() - torques;
        torques += taken;
        (end.ending == Ending::Completed).then_some((largest.0, taken))
    };
    let stop = StopRule::default();
    let adaptive = tried(&mut VpdAdaptive::new(tableau.clone(), stop, scale).with_steps_of(0.2));
    Ok([adaptive, tried(&mut Vpd::new(tableau, stop))])
}

#[allow(clippy::print_stdout, dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    for (name, tried) in ["steps that adapt", "steps of one length"].iter().zip(run()?) {
        match tried {
            Some((energy, torques)) => {
                println!("{name}: |H - H0| {energy:.1e} J, {torques} torques")
            }
            None => println!("{name}: a step failed"),
        }
    }
    Ok(())
}
