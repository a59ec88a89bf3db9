//! Gauss collocation on unit quaternions, in canonical variables of T*S^3, for n = 3; its stages side by side in SIMD
//! lanes.
//!
//! With `pi = 2 q mu` (mu as the quaternion (0, mu)) and H extended to all of T*R^4:
//!
//! ```text
//! mu = vec(q* pi) / 2          H(q, pi) = mu . J^-1 mu / 2 + U(g(q / |q|))
//! q' = q Omega / 2             pi' = pi Omega / 2 - 2 q (dH/dg) / |q|^2
//! Q_i = q0 + h sum_j a_ij q'_j,     P_i = pi0 + h sum_j a_ij pi'_j          (and b_j at the end)
//! ```
//!
//! H does not change under `q -> c q, pi -> pi / c` nor under `pi -> pi + c q`: `q . pi = 0` and
//! `|q|^2 = 1` are kept, and being quadratic Gauss methods keep them too (Cooper 1987; Hairer, Lubich,
//! Wanner, Geometric Numerical Integration, IV.2.1 and VI.4). So a canonical symplectic method in R^8 is one on
//! T*S^3, and on SO(3). The quaternion form of the equations: Betsch and Siebert (2009), International Journal
//! for Numerical Methods in Engineering 79.
//!
//! mu is bilinear in q and pi, and a Gauss method changes a bilinear quantity by the quadrature of
//! its rate at the stages (the same theorem). The spatial momentum m = vec(pi q*) / 2 is bilinear,
//! too, and its rate is -g(q / |q|) tau: with `q* q` in |q|^2 of the second equation the lengths of
//! the stages cancel. So the state is q, m, and with many stages the body momentum p; a step adds a
//! small change to each:
//!
//! ```text
//! q1 = q0 + q0 sum_k h b_k u_k Omega_k / 2            Q_k = q0 u_k
//! m1 = m0 - g0 sum_k h b_k g(u_k / |u_k|) tau_k       tau = vee(dH/dg)
//! p1 = p0 + sum_k h b_k (mu_k x Omega_k - tau_k)      or g1^T m1, with up to four stages and of a free body
//! ```
//!
//! VPD carries the same (`stepper/motion.rs`): only torques change the spatial momentum.
//!
//! Rounding must not drift either (Hairer, McLachlan, Razakarivony 2008, BIT 48). The method is
//! symplectic if `b_i a_ij + b_j a_ji = b_i b_j`: with `a_ij = b_j e_ij` and `e_ij + e_ji = 1` to
//! the last bit it is, however b and e are rounded. The part of the state lost to rounding is
//! carried to the next step, and the sweeps stop where the error they leave is smaller than it.
//!
//! Invariant: symplectic, symmetric, order 2 s; |q| = 1 to round-off, without projection; the same bits on every
//! instruction set.

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{CLOSEST_APPROACH, RigidBody};
use crate::lanes::{Rows, in_stage_lanes, widest};
use crate::nonlinear::{Convergence, StopRule, fixed_point};
use crate::so::{Mat, Vector};
use crate::so3;
use crate::space::{Quaternion, Vec3};
use crate::state::State;
use crate::stepper::Stepper;
use crate::stepper::motion::Motion;
use crate::tableau::Tableau;

mod stages;

use stages::{End, GaussPlan, Stages, Start};

/// The stepper: a Gauss tableau in lanes, a stop rule, the state and the stages of the last step.
#[derive(Clone, Debug)]
pub struct QuaternionGauss {
    tableau: Tableau,
    plan: GaussPlan,
    stop: StopRule,
    /// The instruction set; without one, one number at a time.
    level: Option<Level>,
    motion: Motion<f64>,
    stages: Stages,
    seen: Vec<Vec3<f64>>,
}

impl QuaternionGauss {
    /// Creates a stepper with 1 to 8 stages that solves each step until `stop`; `None` for any
    /// other number.
    pub fn new(stages: usize, stop: StopRule) -> Option<Self> {
        let tableau = Tableau::gauss(stages)?;
        Some(Self {
            plan: GaussPlan::new(&tableau)?,
            tableau,
            // On the dipole the energy moves no less with sweeps to the last digit; stopping a sweep earlier saves nothing.
            stop: StopRule { stop_early: false, ..stop },
            level: Some(Level::new()),
            motion: Motion::blank(0.0, 1.0),
            stages: Stages::blank(),
            seen: Vec::new(),
        })
    }

    /// Returns the stepper on an older instruction set, or without lanes: a test compares the bits,
    /// a bench the time.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { level, ..self }
    }

    /// Refuses stages too close to a point of the potential.
    fn check_distances(&self, body: &RigidBody<3>) -> Result<(), Failure> {
        let seen: Vec<Vector<3>> = self.seen.iter().map(|v| Vector::<3>::from(*v)).collect();
        let turns = (0..self.tableau.stages()).map(|k| (k, self.stages.rotation(k)));
        // The distance of an iterate that is not finite says nothing.
        turns.filter(|(_, u)| u.coords.iter().all(|x| x.is_finite())).try_for_each(|(k, u)| {
            body.check_distances_seen(&so3::rotation(&u), &seen)
                .map_err(|met| Failure { stage: Some(k), ..met })
        })
    }
}

impl Stepper<3> for QuaternionGauss {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<3>) {
        self.motion = Motion::of(state);
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let Self { tableau, plan, stop, level, motion, stages, seen, .. } = self;
        motion.space_vectors(0.0, body, seen);
        let (level, count) = (*level, tableau.stages());
        let start = &Start::new(plan, body, seen, h, motion.body_momentum.value);
        in_stage_lanes!(level, count, body, stages::guess, start, stages);
        let mut torques = plan.torques_of_guess();
        let solved = fixed_point(*stop, || {
            body.work().begin_sweep()?;
            torques += 1;
            Ok(in_stage_lanes!(level, count, body, stages::sweep, start, stages))
        });
        let End { turn, impulse, momentum_increment } =
            in_stage_lanes!(level, count, body, stages::end, start, stages);
        body.count(torques * count as u64);
        // A singularity of the potential explains non-finite values and divergence better than they do. A NaN is checked,
        // too.
        if !(solved.is_ok() && self.stages.proximity <= -CLOSEST_APPROACH * CLOSEST_APPROACH) {
            self.check_distances(body)?;
        }
        let convergence = solved.map_err(|failure| match failure.code {
            // The state is finite: an iterate that is not has grown out of all bounds.
            FailureCode::NonFinite => Failure { code: FailureCode::Diverged, ..failure },
            _ => failure,
        })?;
        let mut motion = self.motion;
        motion.advance(0.0, &turn, &impulse);
        // As in VPD, a free body keeps the spatial momentum to the bit.
        if self.seen.is_empty() {
            motion.turn_momentum(0.0);
        } else {
            motion.add_momentum_increment(0.0, &momentum_increment);
        }
        if !motion.is_finite() {
            return Err(Failure::not_finite(None));
        }
        self.motion = motion;
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        let Quaternion { w, v: [x, y, z] } = self.motion.quaternion();
        Some(so3::rotation(&nalgebra::Quaternion::new(w, x, y, z)))
    }

    fn momentum(&self) -> Mat<3> {
        so3::hat(&self.motion.body_momentum.value.into())
    }
}
