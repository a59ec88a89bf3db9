//! Symmetric compositions of a second-order step: higher order from many short steps, some of them back.
//!
//! ```text
//! Phi_h = S_{g_s h} o ... o S_{g_1 h},   g_i = g_{s+1-i},   sum g_i = 1,   sum g_i^3 = 0, ...
//! ```
//!
//! where S is symmetric and of second order (Yoshida 1990; Hairer, Lubich, Wanner, Geometric Numerical
//! Integration, V.3.2). Here S is kick, drift, kick: half a step of the potential's torque, a step of the
//! free body, the other half; kicks that meet are made at once.
//!
//! Many small changes add up to a step; the part of a sum lost to rounding is carried to the next,
//! so that it makes a random walk and no line (Hairer, McLachlan, Razakarivony 2008, BIT 48).
//!
//! Invariant: a composition of a symplectic and symmetric S is symplectic and symmetric.

use nalgebra::{Quaternion, Vector3};

use super::compensated::two_sum;
use super::failure::Failure;
use super::hamiltonian::RigidBody;
use super::nonlinear::Convergence;
use super::so::{Mat, Vector};
use super::so3::{self, Top};

/// Suzuki (1990), Physics Letters A 146: five steps, `1 / (4 - 4^(1/3))` four times around the rest.
const ORDER_4: [f64; 3] =
    [0.414_490_771_794_375_7, 0.414_490_771_794_375_7, -0.657_963_087_177_503];

/// Kahan and Li (1997), Mathematics of Computation 66: nine steps.
const ORDER_6: [f64; 5] = [
    0.392_161_444_007_314_1,
    0.332_599_136_789_359_43,
    -0.706_246_172_557_639_3,
    0.082_213_596_293_550_8,
    0.798_543_990_934_83,
];

/// Kahan and Li (1997), s17odr8a: seventeen steps.
const ORDER_8: [f64; 9] = [
    0.130_202_483_088_890_07,
    0.561_162_981_775_108_4,
    -0.389_474_962_644_847_27,
    0.158_841_906_555_155_6,
    -0.395_903_894_133_237_57,
    0.184_539_640_978_315_7,
    0.258_374_387_686_322_04,
    0.295_011_723_609_310_3,
    -0.605_508_533_830_034_6,
];

/// Effect of a drift on the free body.
#[derive(Clone, Copy, Debug)]
pub struct Drift {
    /// f of `g1 = g0 f`.
    pub turn: Quaternion<f64>,
    /// Change of the body momentum.
    pub momentum_increment: Vector3<f64>,
}

/// A point of T*SO(3) as a sum: its value, and the part still to be added.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TopSum {
    /// The point.
    pub top: Top,
    pub(crate) carry: Top,
}

impl From<Top> for TopSum {
    fn from(top: Top) -> Self {
        let attitude = Quaternion::from_imag(Vector3::zeros());
        Self { top, carry: Top { attitude, momentum: Vector3::zeros() } }
    }
}

impl TopSum {
    /// Adds to the body momentum.
    fn add_impulse(&mut self, momentum_increment: &Vector3<f64>) {
        for i in 0..3 {
            let momentum_increment = momentum_increment[i] + self.carry.momentum[i];
            let (sum, left) = two_sum(self.top.momentum[i], momentum_increment);
            (self.top.momentum[i], self.carry.momentum[i]) = (sum, left);
        }
    }

    /// `q1 = q0 + q0 (f - 1)`, and the deficit of its length from one.
    fn turn(&mut self, turn: &Quaternion<f64>) {
        let Self { top: Top { attitude, .. }, carry: Top { attitude: carry, .. } } = self;
        // The quaternion of the rotation that is close to one, with 1 - w = |v|^2 / (1 + w).
        let turn = turn * 1.0_f64.copysign(turn.w);
        let v = turn.vector();
        let small = Quaternion::from_parts(-v.norm_squared() / (1.0 + turn.w), v.into_owned());
        let norm_error = 0.5 - 0.5 * attitude.norm_squared();
        let change = *attitude * small + (*carry + *carry * small + *attitude * norm_error);
        for i in 0..4 {
            let (sum, left) = two_sum(attitude.coords[i], change.coords[i]);
            (attitude.coords[i], carry.coords[i]) = (sum, left);
        }
    }
}

/// The steps of a composition, as parts of h.
#[derive(Clone, Debug, PartialEq)]
pub struct Composition {
    order: u32,
    parts: Vec<f64>,
}

impl Composition {
    /// The composition of order 2 (one step), 4, 6 or 8; `None` for any other.
    pub fn new(order: u32) -> Option<Self> {
        let half: &[f64] = match order {
            2 => &[1.0],
            4 => &ORDER_4,
            6 => &ORDER_6,
            8 => &ORDER_8,
            _ => return None,
        };
        let parts = half.iter().chain(half.iter().rev().skip(1)).copied().collect();
        Some(Self { order, parts })
    }

    /// The order.
    pub fn order(&self) -> u32 {
        self.order
    }

    /// The steps, as parts of h.
    pub fn parts(&self) -> &[f64] {
        &self.parts
    }

    /// Makes one step of `h` from `state`; `drift` carries the free body on. Convergence counts the
    /// iterations of all drifts and the largest last increment.
    ///
    /// `seen` is scratch.
    ///
    /// # Errors
    /// Those of the drift, a potential met, values that are not finite.
    pub fn step(
        &self,
        body: &RigidBody<3>,
        seen: &mut Vec<Vector<3>>,
        mut state: TopSum,
        h: f64,
        mut drift: impl FnMut(&Top, f64) -> Result<(Drift, Convergence), Failure>,
    ) -> Result<(TopSum, Convergence), Failure> {
        body.work().begin_sweep()?;
        body.seen_from(&Mat::identity(), seen);
        let mut total = Convergence { iterations: 0, ..Convergence::EXPLICIT };
        let mut before = 0.0;
        for &part in &self.parts {
            state.add_impulse(&kick(body, seen, &state.top, 0.5 * h * (before + part))?);
            let (Drift { turn, momentum_increment }, solved) = drift(&state.top, h * part)?;
            state.turn(&turn);
            state.add_impulse(&momentum_increment);
            total = Convergence {
                iterations: total.iterations + solved.iterations,
                increment: total.increment.max(solved.increment),
                rung: solved.rung,
            };
            before = part;
        }
        state.add_impulse(&kick(body, seen, &state.top, 0.5 * h * before)?);
        state.top.finite()?;
        Ok((state, total))
    }
}

/// Returns `-h dH/dg`, the change of the body momentum by the potential.
fn kick(
    body: &RigidBody<3>,
    seen: &[Vector<3>],
    top: &Top,
    h: f64,
) -> Result<Vector3<f64>, Failure> {
    let g = so3::rotation(&top.attitude);
    body.check_distances_seen(&g, seen)?;
    Ok(so3::vee(&body.gradient_seen(&g, seen)) * -h)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_symmetric_and_meet_the_first_conditions() {
        for order in [2, 4, 6, 8] {
            let composition = Composition::new(order).expect("in the table");
            let parts = composition.parts();
            assert!(parts.iter().eq(parts.iter().rev()));
            let sum = |power: i32| parts.iter().map(|part| part.powi(power)).sum::<f64>();
            assert!((sum(1) - 1.0).abs() < 1e-15);
            for power in (3..order as i32).step_by(2) {
                assert!(sum(power).abs() < 1e-14, "order {order}, power {power}");
            }
        }
        assert_eq!(Composition::new(3), None);
        assert_eq!(Composition::new(10), None);
    }
}
