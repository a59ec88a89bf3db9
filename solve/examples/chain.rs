//! Three links that hang from a point of space by ball joints.
//!
//!     cargo run --release -p vpd-solve --example chain

use std::error::Error;

use vpd_solve::bodies::trajectory::{Course, Ending, integrate};
use vpd_solve::bodies::vpd::BodiesVpd;
use vpd_solve::bodies::{Bodies, Body, Hold, Interaction, Start};
use vpd_solve::nonlinear::StopRule;
use vpd_solve::so::{self, Mat, Vector};
use vpd_solve::tableau::Tableau;

/// The largest error of the energy in J, and the widest gap of a joint in m, of a run of 10 seconds.
pub(crate) fn run() -> Result<[f64; 2], Box<dyn Error>> {
    const LENGTH_M: f64 = 0.5;
    let end = |sign: f64| Vector::<3>::new(0.0, 0.0, 0.5 * LENGTH_M * sign);
    let link = |a: usize| Body {
        // A rod: the second moment along it, and little across.
        second_moments: Mat::from_diagonal(&Vector::<3>::new(1e-4, 1e-4, 0.02)),
        mass_kg: 1.0,
        hold: Hold::Joint {
            parent: a.checked_sub(1),
            parent_point: if a == 0 { Vector::zeros() } else { end(-1.0) },
            own_point: end(1.0),
        },
    };
    let weight = |body| Interaction::Uniform {
        body,
        point: Vector::zeros(),
        weight: 9.81,
        direction: Vector::<3>::new(0.0, 0.0, 1.0),
    };
    let bodies = Bodies::new((0..3).map(link).collect(), (0..3).map(weight).collect())?;
    let start = |a: usize| Start {
        attitude: so::exp(&so::hat(&[1.0 - 0.3 * a as f64, 0.0, 0.0])),
        angular_velocity: so::hat(&[0.0, 0.5, 2.0]),
        // The joints give the places.
        position: Vector::zeros(),
        velocity: Vector::zeros(),
    };
    let initial = bodies.state(&(0..3).map(start).collect::<Vec<_>>());
    let tableau = Tableau::gauss(3).ok_or("1 to 8 stages")?;
    let mut stepper = BodiesVpd::new(tableau, StopRule::default(), &initial);
    let course =
        Course { initial: &initial, checkpoint: None, step_s: 0.005, steps: 2000, every: 10 };
    let mut samples = Vec::new();
    let trajectory = integrate(&bodies, &mut stepper, course, &mut samples, |_| true)?;
    if let Ending::Failed(failure) = trajectory.ending {
        return Err(format!("a step fails: {failure:?}").into());
    }
    let (mut energy, mut gap) = (0.0_f64, 0.0_f64);
    for sample in &samples {
        energy = energy.max(sample.energy_error.ok_or("a figure")?.abs());
        let mut joint = Vector::<3>::zeros();
        for body in &sample.bodies {
            gap = gap.max((body.position + body.attitude * end(1.0) - joint).norm());
            joint = body.position + body.attitude * end(-1.0);
        }
    }
    Ok([energy, gap])
}

#[allow(clippy::print_stdout, dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    let [energy, gap] = run()?;
    println!("energy {energy:.1e} J, widest gap of a joint {gap:.1e} m");
    Ok(())
}
