//! The stages of a step side by side in lanes, in the frame of q0.
//!
//! With `Q_k = q0 u_k`, `P_k = 2 q0 r_k` and `r_k = p0 u_k + d_k` the equations of the stages are
//!
//! ```text
//! u_i = 1 + sum_j e_ij w_j               w_k = h b_k u_k Omega_k / 2                 Omega_k = J^-1 mu_k
//! d_i = sum_j e_ij z_j                   z_k = h b_k (d_k Omega_k / 2 - u_k tau_k / |u_k|^2)
//! mu_k = vec(u_k* r_k)                   tau_k = vee(dH/dg) at u_k / |u_k|
//! ```
//!
//! d is the effect of torques, zero for a free body. Small numbers are computed as such: u as
//! `x = u - 1`, mu as p0 and what is added to it.
//!
//! Invariant: lanes beyond the stages stay at the beginning of the step, and have zero weight.

use crate::hamiltonian::RigidBody;
use crate::lanes::{self, Real, Row};
use crate::nonlinear::SMALLEST_SIZE;
use crate::space::{
    Mat3, Quaternion, Sym3, Vec3, cross, dot, mat3, minus, plus, product, scaled,
    symmetric_product, vec3, with_one,
};
use crate::tableau::{Tableau, TableauInLanes};

/// Largest number of stages that counts as few: their steps are small, and need fewer sweeps of the guess and
/// passes.
pub(super) const FEW_STAGES: usize = 4;
/// Number of sweeps of the guess that use the same torque.
const TORQUE_EVERY: u32 = 3;
/// Largest deviation of |u|^2 from one allowed after the last sweep of the guess.
const MOST_NORM_ERROR: f64 = 0.1;

/// A Gauss tableau, and how the guess and a sweep go over it.
#[derive(Clone, Debug)]
pub(super) struct GaussPlan {
    tableau: TableauInLanes,
    /// Sweeps of the guess.
    guess_sweeps: u32,
    /// Passes over the kinematics in a sweep.
    passes: u32,
}

impl GaussPlan {
    /// Returns the plan for a Gauss tableau; `None` if it has more stages than there are lanes.
    pub(super) fn new(tableau: &Tableau) -> Option<Self> {
        let stages = tableau.stages();
        let (guess_sweeps, passes) =
            if stages <= FEW_STAGES { (4, 2) } else { (stages as u32 + 2, 3) };
        Some(Self { tableau: TableauInLanes::new(tableau)?, guess_sweeps, passes })
    }

    /// Returns how often the guess evaluates the torque at the stages.
    pub(super) fn torques_of_guess(&self) -> u64 {
        2 + u64::from(self.guess_sweeps / TORQUE_EVERY)
    }
}

/// Inputs of a step.
pub(super) struct Start<'a> {
    plan: &'a GaussPlan,
    body: &'a RigidBody<3>,
    /// J^-1.
    inverse: Sym3<f64>,
    /// Is it diagonal?
    principal: bool,
    /// The space vectors of the potential, as seen from q0.
    seen: &'a [Vec3<f64>],
    step: f64,
    momentum: Vec3<f64>,
}

impl<'a> Start<'a> {
    pub(super) fn new(
        plan: &'a GaussPlan,
        body: &'a RigidBody<3>,
        seen: &'a [Vec3<f64>],
        step: f64,
        momentum: Vec3<f64>,
    ) -> Self {
        let m = body.inverse_inertia();
        let inverse = [m.m11, m.m22, m.m33, m.m23, m.m13, m.m12];
        let principal = inverse[3..] == [0.0; 3];
        Self { plan, body, inverse, principal, seen, step, momentum }
    }
}

/// The stages, as they lie in memory.
#[derive(Clone, Debug)]
pub(super) struct Stages {
    /// u - 1.
    x: [Row; 4],
    d: [Row; 4],
    /// tau.
    torque: [Row; 3],
    /// `h b tau / |u|^2`
    weighted_torque: [Row; 3],
    /// Largest proximity, as returned by [`RigidBody::torque`].
    pub(super) proximity: f64,
}

impl Stages {
    pub(super) fn blank() -> Self {
        let zero = Row::splat(0.0);
        Self {
            x: [zero; 4],
            d: [zero; 4],
            torque: [zero; 3],
            weighted_torque: [zero; 3],
            proximity: -1.0,
        }
    }

    /// Stores the start of a sweep.
    #[inline(always)]
    fn keep<R: Lanes>(
        &mut self,
        data: &StepData<'_, R>,
        x: &Quaternion<R>,
        d: &Quaternion<R>,
        torque: &Vec3<R>,
        inverse_square_error: R,
    ) {
        store(x, &mut self.x);
        store(d, &mut self.d);
        for i in 0..3 {
            torque[i].store(&mut self.torque[i]);
            let weighted_torque = torque[i] * data.weight;
            (weighted_torque + weighted_torque * inverse_square_error)
                .store(&mut self.weighted_torque[i]);
        }
    }

    /// u_k.
    pub(super) fn rotation(&self, k: usize) -> nalgebra::Quaternion<f64> {
        let [w, x, y, z] = self.x.each_ref().map(|row| row.0[k]);
        nalgebra::Quaternion::new(1.0 + w, x, y, z)
    }
}

/// End of a step.
pub(super) struct End {
    /// `q0* q1`
    pub(super) turn: Quaternion<f64>,
    /// Change of the spatial momentum, in the frame of q0.
    pub(super) impulse: Vec3<f64>,
    /// `p1 - p0`
    pub(super) momentum_increment: Vec3<f64>,
}

/// The stages in lanes, of one body.
pub(super) trait Lanes: lanes::StageScalar<StepScalar = f64, Storage = Row> {}
impl<R: lanes::StageScalar<StepScalar = f64, Storage = Row>> Lanes for R {}

/// Inputs that are the same in all passes.
struct StepData<'a, R> {
    start: &'a Start<'a>,
    momentum: Vec3<R>,
    /// h b
    weight: R,
    inverse: Sym3<R>,
}

impl<'a, R: Lanes> StepData<'a, R> {
    #[inline(always)]
    fn new(lanes: R, start: &'a Start<'a>) -> Self {
        let mut inverse = [lanes; 6];
        for i in 0..6 {
            inverse[i] = lanes.constant(start.inverse[i]);
        }
        Self {
            start,
            momentum: vec3!(i => lanes.constant(start.momentum[i])),
            weight: lanes.row(&start.plan.tableau.weights) * start.step,
            inverse,
        }
    }

    /// `J^-1 v`
    #[inline(always)]
    fn velocity(&self, v: &Vec3<R>) -> Vec3<R> {
        if self.start.principal {
            vec3!(i => self.inverse[i] * v[i])
        } else {
            symmetric_product(&self.inverse, v)
        }
    }

    /// `mu = vec(u* r) = p0 + vec(y + x* r)` with `r = p0 + y`, `y = p0 x + d`.
    #[inline(always)]
    fn body_momentum(&self, x: &Quaternion<R>, d: &Quaternion<R>) -> Vec3<R> {
        let p = &self.momentum;
        let c = cross(p, &x.v);
        let y: Vec3<R> = vec3!(i => (p[i] * x.w + c[i]) + d.v[i]);
        let r_w = d.w - dot(p, &x.v);
        let r = plus(p, &y);
        let c = cross(&r, &x.v);
        vec3!(i => p[i] + (y[i] + (x.w * r[i] - r_w * x.v[i] + c[i])))
    }

    /// Returns w, given h b Omega / 2.
    #[inline(always)]
    fn turning(&self, x: &Quaternion<R>, half: &Vec3<R>) -> Quaternion<R> {
        let Quaternion { w, v } = x.rate(half);
        Quaternion { w, v: plus(half, &v) }
    }

    /// `sum_j e_ij z_j`
    #[inline(always)]
    fn collocated(&self, z: &Quaternion<R>) -> Quaternion<R> {
        let columns = &self.start.plan.tableau.columns;
        Quaternion { w: z.w.apply_tableau(columns), v: vec3!(i => z.v[i].apply_tableau(columns)) }
    }

    /// Returns the next u and d, with h b tau / |u|^2 kept.
    #[inline(always)]
    fn pass(
        &self,
        x: &Quaternion<R>,
        d: &Quaternion<R>,
        weighted_torque: &Vec3<R>,
    ) -> (Quaternion<R>, Quaternion<R>) {
        let omega = self.velocity(&self.body_momentum(x, d));
        let half = scaled(&omega, self.weight * 0.5);
        let (turned, torque_rate) = (d.rate(&half), self.turning(x, weighted_torque));
        let z = Quaternion { w: turned.w - torque_rate.w, v: minus(&turned.v, &torque_rate.v) };
        (self.collocated(&self.turning(x, &half)), self.collocated(&z))
    }

    /// Returns tau, the proximity and 1 / |u|^2 - 1.
    #[inline(always)]
    fn torque<const EXTRAS: u8>(&self, x: &Quaternion<R>) -> (Vec3<R>, R, R) {
        let (u, inverse_square_error) = self.rotation(x);
        let (torque, proximity) = self.start.body.torque::<R, EXTRAS>(&u, self.start.seen);
        (torque, proximity, inverse_square_error)
    }

    /// Returns the rotation u / |u|, and 1 / |u|^2 - 1: a quotient within 1e-8 above one would be
    /// rounded up as often as not, and never down, and the torque of the stages would be too large
    /// by that.
    #[inline(always)]
    fn rotation(&self, x: &Quaternion<R>) -> (Mat3<R>, R) {
        let u = Quaternion { w: x.w + 1.0, v: x.v };
        // |u|^2 - 1
        let square = (x.w + x.w) + (x.w * x.w + dot(&x.v, &x.v));
        let inverse_square_error = -square / (square + 1.0);
        let change = u.change();
        (
            with_one(&mat3!(i, j => change[i][j] + change[i][j] * inverse_square_error)),
            inverse_square_error,
        )
    }
}

/// Makes the first guess: Gauss collocation in the body,
///
/// ```text
/// mu_i = p0 + h sum_j a_ij (mu_j x Omega_j - tau_j),      u_i = 1 + h sum_j a_ij u_j Omega_j / 2
/// ```
///
/// in which the momenta depend on the attitudes through the torques alone: however thin the body,
/// its sweeps contract by the angle through which it turns. Its stages are those of the step except
/// for terms of the order of the quadrature. The torque couples weakly: every third sweep evaluates it.
/// The guess is a function of the state alone: a resumed run repeats it to the bit.
#[inline(always)]
pub(super) fn guess<R: Lanes, const EXTRAS: u8>(lanes: R, start: &Start<'_>, stages: &mut Stages) {
    let data = StepData::new(lanes, start);
    let TableauInLanes { columns, nodes, .. } = &start.plan.tableau;
    let p = data.momentum;
    let half_weight = data.weight * 0.5;
    let elapsed = lanes.row(nodes) * (0.5 * start.step);
    let zero = lanes.constant(0.0);
    let kept_on = Quaternion { w: zero, v: vec3!(i => elapsed * data.velocity(&p)[i]) };
    let (mut x, mut mu) = (kept_on, p);
    let (mut torque, _, mut inverse_square_error) = data.torque::<EXTRAS>(&x);
    for sweep in 1..=start.plan.guess_sweeps {
        let omega = data.velocity(&mu);
        let turned = cross(&mu, &omega);
        mu = vec3!(i => p[i] + (data.weight * (turned[i] - torque[i])).apply_tableau(columns));
        let half = scaled(&data.velocity(&mu), half_weight);
        x = data.collocated(&data.turning(&x, &half));
        if sweep % TORQUE_EVERY == 0 {
            (torque, _, inverse_square_error) = data.torque::<EXTRAS>(&x);
        }
    }
    // d = u mu / |u|^2 - p0 u
    let mu: Vec3<R> = vec3!(i => mu[i] + mu[i] * inverse_square_error);
    let (r, s) = (x.rate(&mu), cross(&p, &x.v));
    let d_w = r.w + dot(&p, &x.v);
    let d_v: Vec3<R> = vec3!(i => (mu[i] - p[i]) + (r.v[i] - (p[i] * x.w + s[i])));
    // If they diverged, the constant velocity is the better guess.
    let square = Quaternion { w: x.w + 1.0, v: x.v }.square();
    let norm_error = lanes.constant((square + -1.0).abs().largest());
    let x = x.select(norm_error, MOST_NORM_ERROR, &kept_on);
    let d = Quaternion { w: d_w, v: d_v }.select(
        norm_error,
        MOST_NORM_ERROR,
        &Quaternion { w: zero, v: [zero; 3] },
    );
    let (torque, _, inverse_square_error) = data.torque::<EXTRAS>(&x);
    stages.keep(&data, &x, &d, &torque, inverse_square_error);
}

/// Makes passes over u and d with the torques kept, then evaluates the torques: passes cost a third of
/// these, and couple the stages by J^-1. Returns the largest change of u, or of d relative to the
/// momentum; not finite if an unknown is not.
#[inline(always)]
pub(super) fn sweep<R: Lanes, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_>,
    stages: &mut Stages,
) -> f64 {
    let data = StepData::new(lanes, start);
    let (old_x, old_d) = (load(lanes, &stages.x), load(lanes, &stages.d));
    let weighted_torque: Vec3<R> = vec3!(i => lanes.load(&stages.weighted_torque[i]));
    let (mut x, mut d) = (old_x, old_d);
    for _ in 0..start.plan.passes {
        (x, d) = data.pass(&x, &d, &weighted_torque);
    }
    let (torque, proximity, inverse_square_error) = data.torque::<EXTRAS>(&x);
    stages.keep(&data, &x, &d, &torque, inverse_square_error);
    let p = start.momentum[0]
        .abs()
        .max_or_nan(start.momentum[1].abs())
        .max_or_nan(start.momentum[2].abs());
    let size = largest(&d).max_or_nan(lanes.constant(p.max_or_nan(SMALLEST_SIZE)));
    let change = largest(&less(&x, &old_x)).max_or_nan(largest(&less(&d, &old_d)) / size);
    // Zero where all is finite.
    let total = (x.w + (x.v[0] + x.v[1]) + x.v[2]) + (d.w + (d.v[0] + d.v[1]) + d.v[2]);
    stages.proximity = proximity.largest();
    change.largest() + total.sum() * 0.0
}

/// Computes the end of the step from the newest stages: a last pass brings u and d up to the newest
/// torques, whose lag would be a bias.
#[inline(always)]
pub(super) fn end<R: Lanes, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_>,
    stages: &mut Stages,
) -> End {
    let data = StepData::new(lanes, start);
    let weighted_torque: Vec3<R> = vec3!(i => lanes.load(&stages.weighted_torque[i]));
    let old_x = load(lanes, &stages.x);
    let (x, d) = data.pass(&old_x, &load(lanes, &stages.d), &weighted_torque);
    let mu = data.body_momentum(&x, &d);
    let omega = data.velocity(&mu);
    // The angle of a stage as in the equations of the stages: its rounding error is then that of another body,
    // and symplectic.
    let half = scaled(&omega, data.weight * 0.5);
    let w = data.turning(&x, &half);
    let turned = cross(&mu, &half);
    let torque: Vec3<R> = vec3!(i => lanes.load(&stages.torque[i]));
    // In the frame of q0, by the matrices at which the torques were evaluated: a spatial component that
    // that no potential drives is constant.
    let torque_rate = product(&data.rotation(&old_x).0, &torque);
    End {
        turn: Quaternion { w: w.w.sum() + 1.0, v: vec3!(i => w.v[i].sum()) },
        impulse: vec3!(i => -(data.weight * torque_rate[i]).sum()),
        momentum_increment: vec3!(i => ((turned[i] + turned[i]) - data.weight * torque[i]).sum()),
    }
}

#[inline(always)]
fn less<R: Real>(a: &Quaternion<R>, b: &Quaternion<R>) -> Quaternion<R> {
    Quaternion { w: a.w - b.w, v: minus(&a.v, &b.v) }
}

/// Returns the largest component.
#[inline(always)]
fn largest<R: Real>(a: &Quaternion<R>) -> R {
    let [x, y, z] = a.v;
    (a.w.abs().max_or_nan(x.abs())).max_or_nan(y.abs().max_or_nan(z.abs()))
}

#[inline(always)]
fn load<R: Lanes>(lanes: R, [w, x, y, z]: &[Row; 4]) -> Quaternion<R> {
    Quaternion { w: lanes.load(w), v: [lanes.load(x), lanes.load(y), lanes.load(z)] }
}

#[inline(always)]
fn store<R: Lanes>(value: &Quaternion<R>, plain: &mut [Row; 4]) {
    let [w, v @ ..] = plain;
    value.w.store(w);
    for i in 0..3 {
        value.v[i].store(&mut v[i]);
    }
}
