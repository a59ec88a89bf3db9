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
//! mu is bilinear in q and pi, and of what is bilinear a Gauss method makes the quadrature of its rate at the stages
//! (the same theorem). So the state is q and the body momentum p, and a step adds to each what is small:
//!
//! ```text
//! q1 = q0 + q0 sum_k h b_k u_k Omega_k / 2            Q_k = q0 u_k
//! p1 = p0 + sum_k h b_k (mu_k x Omega_k - tau_k)      tau = vee(dH/dg)
//! ```
//!
//! Rounding must not drift either (Hairer, McLachlan, Razakarivony 2008, BIT 48). The method is symplectic if
//! `b_i a_ij + b_j a_ji = b_i b_j`: with `a_ij = b_j e_ij` and `e_ij + e_ji = 1` to the last bit it is, however b
//! and e are rounded. What rounding takes off the state is carried to the next step, and the sweeps stop where what they
//! leave is smaller than it.
//!
//! Invariant: symplectic, symmetric, order 2 s; |q| = 1 to round-off, without projection; the same bits on every
//! instruction set.

use fearless_simd::{Level, dispatch, f64x2, f64x4, f64x8, prelude::*};
use nalgebra::Quaternion;

use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{CLOSEST_APPROACH, RigidBody};
use crate::lanes::{Rows, WIDTH};
use crate::nonlinear::{Convergence, StopRule, fixed_point};
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::space::{Turn, Vec3, sum, vec3};
use crate::stepper::Stepper;
use crate::tableau::Tableau;
use crate::trajectory::State;

mod stages;

use stages::{End, LaneTableau, Stages, Start};

/// Does the work in as many lanes as the stages need, compiled for the widest instruction set; or without lanes.
macro_rules! in_lanes {
    ($work:ident, $level:expr, $count:expr, $start:expr, $stages:expr) => {
        match ($level, $count) {
            (Some(level), 1) => {
                dispatch!(level, _simd => stages::$work(Rows([0.0; 1]), $start, $stages))
            }
            (Some(level), 2) => {
                dispatch!(level, simd => stages::$work(f64x2::splat(simd, 0.0), $start, $stages))
            }
            (Some(level), 3 | 4) => {
                dispatch!(level, simd => stages::$work(f64x4::splat(simd, 0.0), $start, $stages))
            }
            (Some(level), _) => {
                dispatch!(level, simd => stages::$work(f64x8::splat(simd, 0.0), $start, $stages))
            }
            (None, 1) => stages::$work(Rows([0.0; 1]), $start, $stages),
            (None, 2) => stages::$work(Rows([0.0; 2]), $start, $stages),
            (None, 3) => stages::$work(Rows([0.0; 3]), $start, $stages),
            (None, 4) => stages::$work(Rows([0.0; 4]), $start, $stages),
            (None, _) => stages::$work(Rows([0.0; 8]), $start, $stages),
        }
    };
}

/// The stepper: a Gauss tableau in lanes, a stop rule, the state and the stages of the last step.
#[derive(Clone, Debug)]
pub struct QuaternionGauss {
    tableau: Tableau,
    lanes: LaneTableau,
    stop: StopRule,
    /// The instruction set; without one, one number at a time.
    level: Option<Level>,
    /// q, as (w, v).
    attitude: Carried<4>,
    /// p.
    momentum: Carried<3>,
    stages: Stages,
    seen: Vec<Vec3<f64>>,
}

/// A number of the state, and what rounding has taken off it.
#[derive(Clone, Copy, Debug)]
struct Carried<const K: usize> {
    value: [f64; K],
    carry: [f64; K],
}

impl<const K: usize> Carried<K> {
    /// Begins with `value`, of which zeros lose their sign: a lane of no stage adds a zero of either.
    fn new(value: [f64; K]) -> Self {
        Self { value: value.map(|x| x + 0.0), carry: [0.0; K] }
    }

    /// With `change` and what was carried.
    fn plus(&self, change: &[f64; K]) -> Self {
        let mut next = *self;
        for i in 0..K {
            (next.value[i], next.carry[i]) = sum(self.value[i], change[i] + self.carry[i]);
        }
        next
    }

    fn is_finite(&self) -> bool {
        self.value.iter().all(|x| x.is_finite())
    }
}

impl QuaternionGauss {
    /// A stepper with 1 to 8 stages that solves each step until `stop`; `None` for any other number.
    pub fn new(stages: usize, stop: StopRule) -> Option<Self> {
        let tableau = Tableau::gauss(stages).filter(|_| stages <= WIDTH)?;
        Some(Self {
            lanes: LaneTableau::new(&tableau),
            tableau,
            // On the dipole the energy moves no less with sweeps to the last digit; to foresee the last sweep saves nothing.
            stop: StopRule { foresee: false, ..stop },
            level: Some(Level::new()),
            attitude: Carried::new([1.0, 0.0, 0.0, 0.0]),
            momentum: Carried::new([0.0; 3]),
            stages: Stages::blank(),
            seen: Vec::new(),
        })
    }

    /// The same stepper on an older instruction set, or without lanes: a test compares the bits, a bench the time.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { level, ..self }
    }

    fn quaternion(&self) -> Quaternion<f64> {
        let [w, x, y, z] = self.attitude.value;
        Quaternion::new(w, x, y, z)
    }

    /// Refuses stages too close to a point of the potential.
    fn check_distances(&self, body: &RigidBody<3>) -> Result<(), Failure> {
        let seen: Vec<Vector<3>> = self.seen.iter().map(|v| Vector::<3>::from(*v)).collect();
        let turns = (0..self.tableau.stages()).map(|k| (k, self.stages.turn(k)));
        // An iterate that is not finite has met nothing.
        turns.filter(|(_, u)| u.coords.iter().all(|x| x.is_finite())).try_for_each(|(k, u)| {
            body.check_distances(&so3::rotation(&u), &seen)
                .map_err(|met| Failure { stage: Some(k), ..met })
        })
    }
}

impl Stepper<3> for QuaternionGauss {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<3>) {
        let Top { attitude: q, momentum } = Top::from_state(state);
        self.attitude = Carried::new([q.w, q.i, q.j, q.k]);
        self.momentum = Carried::new(momentum.into());
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let g = so3::rotation(&self.quaternion());
        self.seen.clear();
        self.seen.extend(body.space_vectors().map(|v| <[f64; 3]>::from(g.tr_mul(v))));
        let Self { tableau, lanes, stop, level, momentum, stages, seen, .. } = self;
        let (level, count) = (*level, tableau.stages());
        let start = &Start::new(lanes, body, seen, h, momentum.value);
        in_lanes!(guess, level, count, start, stages);
        let mut torques = lanes.torques_of_guess();
        let solved = fixed_point(*stop, || {
            body.work().begin_sweep()?;
            torques += 1;
            Ok(in_lanes!(sweep, level, count, start, stages))
        });
        let End { turn, gain } = in_lanes!(end, level, count, start, stages);
        body.count(torques * count as u64);
        // A charge met explains non-finite values and divergence better than they do. What is not a number is looked at,
        // too.
        if !(solved.is_ok() && self.stages.nearness <= -CLOSEST_APPROACH * CLOSEST_APPROACH) {
            self.check_distances(body)?;
        }
        let convergence = solved?;
        // What is carried turns along.
        let of = |[w, x, y, z]: [f64; 4]| Turn { w, v: [x, y, z] };
        let change = of(self.attitude.value).times(&turn);
        let carried = of(self.attitude.carry).times(&turn);
        let v = vec3!(i => change.v[i] + carried.v[i]);
        let attitude = self.attitude.plus(&[change.w + carried.w, v[0], v[1], v[2]]);
        let momentum = self.momentum.plus(&gain);
        if !(attitude.is_finite() && momentum.is_finite()) {
            return Err(Failure::new(FailureCode::NonFinite, None, f64::INFINITY, f64::MAX));
        }
        (self.attitude, self.momentum) = (attitude, momentum);
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        Some(so3::rotation(&self.quaternion()))
    }

    fn momentum(&self) -> Mat<3> {
        so3::skew(&self.momentum.value.into())
    }
}
