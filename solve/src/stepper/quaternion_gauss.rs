//! Gauss collocation on unit quaternions, in canonical variables of T*S^3, for n = 3.
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
//! Rounding must not drift either (Hairer, McLachlan, Razakarivony 2008, BIT 48). The method is symplectic if
//! `b_i a_ij + b_j a_ji = b_i b_j`: with `a_ij = b_j (1/2 + s_ij)` and s skew to the last bit it is, however b
//! and s are rounded. What rounding takes off the state is carried to the next step.
//!
//! Invariant: symplectic, symmetric, order 2 s; |q| = 1 and q . pi = 0 to round-off, without projection.

use nalgebra::{Matrix3, Quaternion, Vector3, Vector4};

use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::RigidBody;
use crate::nonlinear::{Convergence, StopRule, fixed_point};
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::stepper::Stepper;
use crate::tableau::Tableau;
use crate::trajectory::State;

/// The stepper: a Gauss tableau, a stop rule and its scratch.
#[derive(Clone, Debug)]
pub struct QuaternionGauss {
    tableau: Tableau,
    /// b.
    weights: Vec<f64>,
    /// `s_ij = a_ij / b_j - 1/2`, skew to the last bit.
    skew: Vec<Vec<f64>>,
    stop: StopRule,
    now: Point,
    /// What is still to be added to `now`.
    carry: Point,
    stages: Vec<Stage>,
    seen: Vec<Vector<3>>,
}

/// A point of T*R^4, or a change of one.
#[derive(Clone, Copy, Debug)]
struct Point {
    q: Quaternion<f64>,
    pi: Quaternion<f64>,
}

const ZERO: Quaternion<f64> = Quaternion { coords: Vector4::new(0.0, 0.0, 0.0, 0.0) };

#[derive(Clone, Copy, Debug)]
struct Stage {
    at: Point,
    /// `h b_i (q', pi')`.
    change: Point,
}

impl Point {
    fn zero() -> Self {
        Self { q: ZERO, pi: ZERO }
    }

    /// The body momentum.
    fn momentum(&self) -> Vector3<f64> {
        Vector3::from((self.q.conjugate() * self.pi).vector()) * 0.5
    }

    fn q_is_finite(&self) -> bool {
        self.q.coords.iter().all(|x| x.is_finite())
    }

    fn is_finite(&self) -> bool {
        self.q_is_finite() && self.pi.coords.iter().all(|x| x.is_finite())
    }
}

impl QuaternionGauss {
    /// A stepper with 1 to 8 stages that solves each step until `stop`; `None` for any other number.
    pub fn new(stages: usize, stop: StopRule) -> Option<Self> {
        let stage = Stage { at: Point::zero(), change: Point::zero() };
        let tableau = Tableau::gauss(stages)?;
        let part = |i: usize, j: usize| tableau.a(i, j) / tableau.b(j);
        let skew = (0..stages)
            .map(|i| (0..stages).map(|j| 0.5 * (part(i, j) - part(j, i))).collect())
            .collect();
        Some(Self {
            weights: (0..stages).map(|j| tableau.b(j)).collect(),
            tableau,
            skew,
            stop: stop.to_the_floor(),
            now: Point { q: Quaternion::identity(), pi: ZERO },
            carry: Point::zero(),
            stages: vec![stage; stages],
            seen: Vec::new(),
        })
    }

    /// Starts the stages from the velocity at the beginning of the step, kept constant.
    fn guess(&mut self, inverse: &Matrix3<f64>, h: f64) {
        let mu = self.now.momentum();
        let omega = inverse * mu;
        for (i, stage) in self.stages.iter_mut().enumerate() {
            let turn = Quaternion::from_parts(1.0, omega * (0.5 * h * self.tableau.c(i)));
            let turn = turn.normalize();
            stage.at = Point { q: self.now.q * turn, pi: self.now.pi * turn };
            let half = so3::pure(&(omega * (0.5 * h * self.weights[i])));
            stage.change = Point { q: stage.at.q * half, pi: stage.at.pi * half };
        }
    }
}

/// One sweep over all stages, each variable from the newest of the others; returns the largest change of a
/// stage relative to the largest momentum, or to |q| = 1.
fn sweep(
    (b, skew): (&[f64], &[Vec<f64>]),
    body: &RigidBody<3>,
    inverse: &Matrix3<f64>,
    seen: &[Vector<3>],
    h: f64,
    (now, carry): (&Point, &Point),
    stages: &mut [Stage],
) -> f64 {
    let s = stages.len();
    let (mut turned, mut change, mut size) = (0.0_f64, 0.0_f64, now.pi.norm());
    let middle = carry.q + stages.iter().fold(ZERO, |sum, stage| sum + stage.change.q) * 0.5;
    for i in 0..s {
        let sum = (0..s).fold(middle, |sum, j| sum + stages[j].change.q * skew[i][j]);
        let q = now.q + sum;
        turned = larger(turned, (q - stages[i].at.q).coords.amax());
        stages[i].at.q = q;
    }
    for (stage, b) in stages.iter_mut().zip(b) {
        let Point { q, pi } = stage.at;
        let omega = so3::pure(&(inverse * stage.at.momentum()));
        let torque = so3::vector(&body.gradient(&so3::rotation(&q), seen));
        let rate = pi * omega * 0.5 - q * so3::pure(&(torque * (2.0 / q.norm_squared())));
        stage.change.pi = rate * (h * b);
    }
    let middle = carry.pi + stages.iter().fold(ZERO, |sum, stage| sum + stage.change.pi) * 0.5;
    for i in 0..s {
        let sum = (0..s).fold(middle, |sum, j| sum + stages[j].change.pi * skew[i][j]);
        let pi = now.pi + sum;
        change = larger(change, (pi - stages[i].at.pi).coords.amax());
        size = larger(size, pi.norm());
        stages[i].at.pi = pi;
    }
    for (stage, b) in stages.iter_mut().zip(b) {
        let omega = so3::pure(&(inverse * stage.at.momentum()));
        stage.change.q = stage.at.q * omega * (0.5 * h * b);
    }
    larger(turned, if change == 0.0 { 0.0 } else { change / size })
}

/// The larger of two sizes; unlike a plain maximum it keeps a NaN.
fn larger(a: f64, b: f64) -> f64 {
    if b <= a { a } else { b }
}

/// `at + change`, and what rounding left over.
fn add(at: &Quaternion<f64>, change: &Quaternion<f64>) -> (Quaternion<f64>, Quaternion<f64>) {
    let sum = at + change;
    (sum, (at - sum) + change)
}

impl Stepper<3> for QuaternionGauss {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<3>) {
        let Top { attitude, momentum } = Top::from_state(state);
        self.now = Point { q: attitude, pi: attitude * so3::pure(&momentum) * 2.0 };
        self.carry = Point::zero();
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        body.seen_from(&Mat::identity(), &mut self.seen);
        let inverse = body.inverse_inertia();
        self.guess(&inverse, h);
        let Self { weights, skew, stop, now, carry, stages, seen, .. } = self;
        let solved = fixed_point(*stop, || {
            body.work().begin_sweep()?;
            Ok(sweep((weights, skew), body, &inverse, seen, h, (now, carry), stages))
        });
        // A charge met explains non-finite values and divergence better than they do; an iterate that is
        // not finite itself has met nothing.
        for (i, stage) in stages.iter().enumerate().filter(|(_, stage)| stage.at.q_is_finite()) {
            body.check_distances(&so3::rotation(&stage.at.q), seen)
                .map_err(|met| Failure { stage: Some(i), ..met })?;
        }
        let convergence = solved?;
        let mut change = *carry;
        for stage in stages.iter() {
            change.q += stage.change.q;
            change.pi += stage.change.pi;
        }
        let (q, q_left) = add(&now.q, &change.q);
        let (pi, pi_left) = add(&now.pi, &change.pi);
        let end = Point { q, pi };
        if !end.is_finite() {
            return Err(Failure::new(FailureCode::NonFinite, None, f64::INFINITY, f64::MAX));
        }
        (*now, *carry) = (end, Point { q: q_left, pi: pi_left });
        Ok(convergence)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        Some(so3::rotation(&self.now.q))
    }

    fn momentum(&self) -> Mat<3> {
        so3::skew(&self.now.momentum())
    }
}
