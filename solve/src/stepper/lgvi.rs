//! The Lie group variational integrator of Lee, Leok and McClamroch for n = 3, in Hamiltonian form.
//!
//! ```text
//! p = mu_k - h/2 dH/dg(g_k)
//! h hat(p) = F J_d - J_d F^T          J_d = tr(J) I / 2 - J
//! g_{k+1} = g_k F                     mu_{k+1} = F^T p - h/2 dH/dg(g_{k+1})
//! ```
//!
//! Lee, Leok, McClamroch (2005), IEEE Conference on Control Applications, and (2007), Computer Methods in
//! Applied Mechanics and Engineering 196. With the quaternion (s, v) of F, `s = sqrt(1 - v . v)`, their
//! vector form `h p = sin|f|/|f| J f + (1 - cos|f|)/|f|^2 f x J f` has no transcendental function left:
//!
//! ```text
//! s J v + v x J v = h p / 2
//! ```
//!
//! and is solved for v by Newton's method from `v = h J^-1 p / 2`. Second order; symmetric compositions reach
//! 4th, 6th and 8th: see [`crate::composition`].
//!
//! Invariant: symplectic and symmetric, on the group to round-off; the spatial momentum along the symmetries
//! of the potential is kept to round-off.

use nalgebra::{Matrix3, Quaternion, Vector3};

use crate::composition::{Composition, Drift, TopSum};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::RigidBody;
use crate::nonlinear::{Convergence, Rung, StopRule, fixed_point, relative};
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::state::State;
use crate::stepper::Stepper;

/// The stepper: a composition and a stop rule.
#[derive(Clone, Debug)]
pub struct Lgvi {
    composition: Composition,
    stop: StopRule,
    state: TopSum,
    seen: Vec<Vector<3>>,
}

impl Lgvi {
    /// Creates a stepper of order 2, 4, 6 or 8 that solves each implicit equation until `stop`;
    /// `None` for any other order.
    pub fn new(order: u32, stop: StopRule) -> Option<Self> {
        let composition = Composition::new(order)?;
        Some(Self { composition, stop, state: Top::at_rest().into(), seen: Vec::new() })
    }
}

impl Stepper<3> for Lgvi {
    fn order(&self) -> u32 {
        self.composition.order()
    }

    fn start(&mut self, state: &State<3>) {
        self.state = Top::from_state(state).into();
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let inverse = body.inverse_inertia();
        let inertia = inverse.try_inverse().ok_or(too_large(0.0, 0.0))?;
        let stop = self.stop;
        let (state, convergence) =
            self.composition.step(body, &mut self.seen, self.state, h, |top, h| {
                let half = top.momentum * (0.5 * h);
                let (turn, convergence) = solve(&inertia, &half, inverse * half, stop)?;
                // F^T p by its change, relative to which it is rounded: `2 (v x (v x p) - s v x p)`, s via 1 - s.
                let v = Vector3::from(turn.vector());
                let across = v.cross(&top.momentum);
                let momentum_increment =
                    (v.cross(&across) + across * norm_error(&v, turn.scalar()) - across) * 2.0;
                Ok((Drift { turn, momentum_increment }, convergence))
            })?;
        self.state = state;
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        Some(so3::rotation(&self.state.top.attitude))
    }

    fn momentum(&self) -> Mat<3> {
        so3::hat(&self.state.top.momentum)
    }
}

/// The quaternion (s, v) of `s J v + v x J v = half`, by Newton's method from `v`.
fn solve(
    inertia: &Matrix3<f64>,
    half: &Vector3<f64>,
    mut v: Vector3<f64>,
    stop: StopRule,
) -> Result<(Quaternion<f64>, Convergence), Failure> {
    let convergence = fixed_point(stop, || {
        let s = scalar(&v)?;
        let jv = inertia * v;
        let residual = (jv - half) + (v.cross(&jv) - jv * norm_error(&v, s));
        // d(s J v + v x J v): s J - J v v^T / s + hat(v) J - hat(J v)
        let slope = inertia * s - jv * v.transpose() / s + so3::hat(&v) * inertia - so3::hat(&jv);
        let change = slope.try_inverse().ok_or(too_large(0.0, 0.0))? * residual;
        v -= change;
        Ok(relative(change.amax(), v.amax()))
    })?;
    let turn = Quaternion::from_parts(scalar(&v)?, v);
    Ok((turn, Convergence { rung: Rung::Newton, ..convergence }))
}

/// s of a v within half a turn.
fn scalar(v: &Vector3<f64>) -> Result<f64, Failure> {
    let square = v.norm_squared();
    if square < 1.0 { Ok((1.0 - square).sqrt()) } else { Err(too_large(square.sqrt(), 1.0)) }
}

/// `1 - s = |v|^2 / (1 + s)`, rounded relative to itself: with s, rounded relative to one, the energy of a dipole moved in a line.
fn norm_error(v: &Vector3<f64>, s: f64) -> f64 {
    v.norm_squared() / (1.0 + s)
}

/// Newton's iterate has turned by half a turn, or its derivative is singular: the step is too large.
fn too_large(measured: f64, limit: f64) -> Failure {
    Failure::new(FailureCode::Diverged, None, measured, limit)
}
