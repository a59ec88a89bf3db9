//! Splitting of H = T + V for several bodies without joints, n = 3: all free tops and straight lines between kicks of the
//! potential, composed as [`crate::composition`] says.
//!
//! ```text
//! S_h = K_{h/2} o E_h o K_{h/2}      K_h: mu += -h dH/dg, p += -h dH/dx      E_h: free tops, x += h p / M
//! ```
//!
//! Invariant: symplectic and symmetric; kicks of a pair are opposite to the bit.

use super::apart::principal_axes;
use super::motion::BodiesMotion;
use super::trajectory::BodiesStepper;
use super::{Bodies, BodiesState, Configuration, Forces};
use crate::composition::Composition;
use crate::failure::Failure;
use crate::nonlinear::Convergence;
use crate::so::{self, Mat, Vector};
use crate::so3::{self, Top};
use crate::stepper::splitting::PrincipalAxes;

/// The stepper.
#[derive(Clone, Debug)]
pub struct BodiesSplitting {
    composition: Composition,
    axes: Vec<PrincipalAxes>,
    motion: BodiesMotion<3>,
    forces: Forces<3>,
}

impl BodiesSplitting {
    /// Creates a stepper of order 2, 4, 6 or 8 for these bodies; `None` for any other order, and for bodies in joints.
    pub fn new(order: u32, bodies: &Bodies<3>, state: &BodiesState<3>) -> Option<Self> {
        if bodies.has_joints() {
            return None;
        }
        Some(Self {
            composition: Composition::new(order)?,
            axes: bodies.bodies().iter().map(principal_axes).collect::<Option<_>>()?,
            motion: BodiesMotion::new(state),
            forces: Forces::none(state.attitudes.len(), state.places.len()),
        })
    }

    fn kick(
        &mut self,
        bodies: &Bodies<3>,
        motion: &mut BodiesMotion<3>,
        h: f64,
    ) -> Result<(), Failure> {
        let BodiesState { attitudes, places, .. } = motion.state();
        let at = Configuration { attitudes: &attitudes, places: &places, velocities: &[] };
        bodies.forces(at, &mut self.forces)?;
        bodies.work().add_gradients(1);
        for (a, torque) in self.forces.torques.iter().enumerate() {
            let gain = so::skew(&so::conjugate(&attitudes[a].transpose(), torque)) * h;
            motion.turn(None, a, [&Mat::zeros(), &gain], &gain);
        }
        for (tree, force) in self.forces.forces.iter().enumerate() {
            if bodies.mass_of_place(tree).is_some() {
                motion.shift(tree, &Vector::zeros(), &(force * h));
            }
        }
        Ok(())
    }
}

impl BodiesStepper<3> for BodiesSplitting {
    fn order(&self) -> u32 {
        self.composition.order()
    }

    fn start(&mut self, state: &BodiesState<3>) {
        self.motion = BodiesMotion::new(state);
    }

    fn step(&mut self, bodies: &Bodies<3>, h: f64) -> Result<Convergence, Failure> {
        bodies.work().begin_sweep()?;
        let mut motion = self.motion.clone();
        let mut before = 0.0;
        for part in self.composition.parts().to_vec() {
            self.kick(bodies, &mut motion, 0.5 * h * (before + part))?;
            for (a, axes) in self.axes.iter().enumerate() {
                let top = Top { momentum: so3::vee(motion.momentum(a)), ..Top::at_rest() };
                let (drift, _) = axes.free(&top, h * part).ok_or(Failure::not_finite(None))?;
                let turn = so3::rotation(&drift.turn) - Mat::identity();
                let gain = so3::hat(&drift.momentum_increment);
                motion.turn(None, a, [&turn, &Mat::zeros()], &gain);
            }
            for tree in 0..bodies.places() {
                if let Some(mass) = bodies.mass_of_place(tree) {
                    let way = motion.linear_momentum(tree) * (h * part / mass);
                    motion.shift(tree, &way, &Vector::zeros());
                }
            }
            before = part;
        }
        self.kick(bodies, &mut motion, 0.5 * h * before)?;
        if motion.state().numbers().iter().any(|x| !x.is_finite()) {
            return Err(Failure::not_finite(None));
        }
        self.motion = motion;
        Ok(Convergence::EXPLICIT)
    }

    fn state(&self) -> BodiesState<3> {
        self.motion.state()
    }
}
