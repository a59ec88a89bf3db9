//! A step of VPD for n = 3 as collocation of body momenta and quaternions with two deferred defects, the stages side by side in
//! lanes; for symplectic tableaux.
//!
//! With the symbols of [`super::sweep`], `e_kj + e_jk = 1`, `D_k = sum_j e_kj w_j`, `K_k = D_k - C_k` and `T_k = U_k hat(x_k)`,
//! the equations of the step are ([body] in docs/derivation.md, section 6)
//!
//! ```text
//! mu_k = p0 + sum_j e_kj h b_j (mu_j x Omega_j - tau_j) + delta_k
//! u_k = 1 + sum_j e_kj h b_j u_j Omega_j / 2 + theta_k
//! delta_k = vee(asym(K_k^T f hat(lambda)) - asym(C_k^T Y_k) - sum_j e_kj asym(D_j^T T_j - w_j^T Y_j))
//! theta_k: u_k is the polar factor of I + D_k
//! ```
//!
//! The defects delta and theta are of the order of the tableau, and vary slowly. A *round* takes mu and u from each other with
//! the defects as they are: no matrix, and nothing stiff about a thin axis. A *block* is a torque and two rounds. An
//! *evaluation* computes the defects anew, and costs several blocks. So blocks are made until what they lack is small next to
//! the change of the defects that is expected, then the defects are evaluated, and so on, until the defects lack far less than
//! rounding, for what they lack has the same sign step after step; the last blocks go to rounding.
//!
//! `S_k = sym(U_k^T W_k)`, which the equation of x needs, is that of the evaluation before; before the first one it is the
//! solution of what it obeys for many stages, zero at the end of the step:
//!
//! ```text
//! S' = (Omega mu + mu Omega) / 4 - [Omega, S] / 2
//! ```
//!
//! Invariant: the start is a function of the state alone, and every decision one of computed numbers: a step repeats to the bit.

use super::sweep::{end_of_stages, torque_in_body, velocity_at_start, velocity_of};
use super::unknowns::{Start, Unknowns};
use crate::lanes::{Real, Row, StageScalar, WIDTH};
use crate::nonlinear::{Convergence, Rung, SMALLEST_SIZE};
use crate::space::{
    Mat3, Quaternion, Sym3, Vec3, asym_of_product, cross, dot, mat3, minus, plus, product, scaled,
    symmetric_product, times_hat, transposed, vec3, with_one,
};
use crate::stepper::so3_equations::{Inertia, inverse_of_q, over_q, residual, store, stretch_of};
use crate::tableau::TableauInLanes;

/// Rounds over momenta and attitudes for each torque.
const ROUNDS: u32 = 2;
/// Blocks and evaluations of a step at most: a step that needs more is not solved here.
const MOST_BLOCKS: u32 = 80;
const MOST_EVALUATIONS: u32 = 20;
/// Blocks go on until what they lack is this part of what the defects lack.
const PART_OF_DEFECTS: f64 = 0.3;
/// What the last blocks may lack.
const LEAST_SHORTFALL: f64 = 1e-17;
/// What the defects may lack, times the turn, with up to six stages and with more. It has the same sign step after step: with 1e-16
/// the momentum of a heavy top about the vertical drifted by 2e-19 a step of five stages and by 2e-20 of six.
const LEAST_OF_DEFECTS: [f64; 2] = [1e-19, 1e-17];
/// A change that no longer falls by half, and is below this, is rounding.
const ROUNDING: f64 = 1e-14;
/// A change below this is none.
const NOTHING: f64 = 2e-16;
/// Where every P - I is below this, the end is that of the quaternions: its error, of that size, enters delta times K, of that size too.
const NO_STRETCH: f64 = 1e-8;
/// A change above this is no step's.
const ASTRAY: f64 = 10.0;
/// Contraction of a block before it is seen, and at least.
const OF_BLOCK: [f64; 2] = [0.02, 1e-3];
/// Contraction of an evaluation, in parts of the square of the turn; its bounds.
const OF_EVALUATION: f64 = 0.1;
const BOUNDS_OF_EVALUATION: [f64; 2] = [1e-5, 0.1];

/// How a step was solved.
#[derive(Clone, Copy, Debug)]
pub(super) struct Collocated {
    /// Torques at all stages.
    pub(super) torques: u32,
    /// Evaluations of the defects.
    pub(super) evaluations: u32,
    /// The last change of a stage, relative to the largest momentum, or in radians.
    pub(super) change: f64,
    pub(super) is_solved: bool,
}

impl Collocated {
    /// Returns how the step was solved, its evaluations for sweeps.
    pub(super) fn convergence(&self) -> Convergence {
        let rung = Rung::FixedPoint;
        Convergence { iterations: self.evaluations, increment: self.change, rung }
    }
}

/// The iterate.
struct Iterate<'a, R: StageScalar> {
    start: &'a Start<'a, R::Storage, f64>,
    /// h b
    weight: R,
    p0: Vec3<R>,
    inertia: Inertia<R>,
    mu: Vec3<R>,
    u: Quaternion<R>,
    tau: Vec3<R>,
    proximity: R,
    /// h b tau
    push: Vec3<R>,
    /// h b Omega
    turning: Vec3<R>,
    delta: Vec3<R>,
    theta: Quaternion<R>,
    s: Sym3<R>,
    x: Vec3<R>,
    stretch: Sym3<R>,
    inverse_q: Sym3<R>,
}

/// The largest entry, over all stages.
#[inline(always)]
fn largest<R: StageScalar<StepScalar = f64>>(v: &Vec3<R>) -> f64 {
    v[0].abs().max_or_nan(v[1].abs()).max_or_nan(v[2].abs()).largest()
}

#[inline(always)]
fn applied<R: StageScalar>(v: &Vec3<R>, columns: &[Row; WIDTH]) -> Vec3<R> {
    R::apply_tableau_to(*v, columns)
}

#[inline(always)]
fn applied_to_turn<R: StageScalar>(q: &Quaternion<R>, columns: &[Row; WIDTH]) -> Quaternion<R> {
    let [w, x, y, z] = R::apply_tableau_to([q.w, q.v[0], q.v[1], q.v[2]], columns);
    Quaternion { w, v: [x, y, z] }
}

#[inline(always)]
fn applied_to_matrix<R: StageScalar>(m: &Mat3<R>, columns: &[Row; WIDTH]) -> Mat3<R> {
    let [[a, b, c], [d, e, f], [g, h, i]] = *m;
    let [a, b, c, d, e, f, g, h, i] = R::apply_tableau_to([a, b, c, d, e, f, g, h, i], columns);
    [[a, b, c], [d, e, f], [g, h, i]]
}

/// `vee asym(A^T B)`
#[inline(always)]
fn asym_of<R: Real>(a: &Mat3<R>, b: &Mat3<R>) -> Vec3<R> {
    asym_of_product(&transposed(a), &transposed(b))
}

impl<R: StageScalar<StepScalar = f64>> Iterate<'_, R> {
    #[inline(always)]
    fn velocity<const EXTRAS: u8>(&self, mu: &Vec3<R>) -> Vec3<R> {
        velocity_of::<R, EXTRAS>(self.start, &self.inertia, mu)
    }

    #[inline(always)]
    fn set_momentum<const EXTRAS: u8>(&mut self, mu: Vec3<R>) {
        self.mu = mu;
        self.turning = scaled(&self.velocity::<EXTRAS>(&mu), self.weight);
    }

    /// `h b (mu x Omega - tau)`
    #[inline(always)]
    fn momentum_rate(&self) -> Vec3<R> {
        minus(&cross(&self.mu, &self.turning), &self.push)
    }

    /// `h b q Omega / 2`
    #[inline(always)]
    fn turn_rate(&self, q: &Quaternion<R>) -> Quaternion<R> {
        q.rate(&scaled(&self.turning, self.weight.constant(0.5)))
    }

    #[inline(always)]
    fn evaluate_torque<const EXTRAS: u8>(&mut self) {
        let (u, mu) = (self.u.matrix(), self.mu);
        (self.tau, self.proximity) =
            torque_in_body::<R, EXTRAS>(self.start, &u, &self.inertia, &mu);
        self.push = scaled(&self.tau, self.weight);
    }

    /// Makes a round; returns the changes of the momenta and of the turns.
    #[inline(always)]
    fn round<const EXTRAS: u8>(&mut self) -> [Vec3<R>; 2] {
        let columns = &self.start.plan.tableau.columns;
        let sum = applied(&self.momentum_rate(), columns);
        let (p0, delta) = (&self.p0, &self.delta);
        let mu: Vec3<R> = vec3!(i => p0[i] + (sum[i] + delta[i]));
        let momenta = minus(&mu, &self.mu);
        self.set_momentum::<EXTRAS>(mu);
        let rate = self.turn_rate(&self.u);
        let sum = applied_to_turn(&rate, columns);
        let v = plus(&sum.v, &self.theta.v);
        let turns = minus(&v, &self.u.v);
        self.u = Quaternion { w: (sum.w + self.theta.w) + 1.0, v };
        [momenta, turns]
    }

    /// Makes a round over S in the limit of many stages.
    #[inline(always)]
    fn round_of_s<const EXTRAS: u8>(&mut self) {
        let (mu, s, omega) = (&self.mu, &self.s, self.velocity::<EXTRAS>(&self.mu));
        // [Omega, S] = B + B^T, B = hat(Omega) S
        let b = [
            cross(&omega, &[s[0], s[5], s[4]]),
            cross(&omega, &[s[5], s[1], s[3]]),
            cross(&omega, &[s[4], s[3], s[2]]),
        ];
        let along = dot(mu, &omega) * 2.0;
        let quarter = self.weight * -0.25;
        let diagonal = |i: usize| quarter * (mu[i] * omega[i] * 2.0 - along - b[i][i] * 4.0);
        let off = |i: usize, j: usize| {
            quarter * ((mu[i] * omega[j] + mu[j] * omega[i]) - (b[i][j] + b[j][i]) * 2.0)
        };
        let rate = [diagonal(0), diagonal(1), diagonal(2), off(1, 2), off(0, 2), off(0, 1)];
        self.s = R::apply_tableau_to(rate, &self.start.plan.tableau.rows);
    }

    /// Evaluates theta and delta; returns their changes.
    #[inline(always)]
    fn evaluate<const EXTRAS: u8>(
        &mut self,
        lanes: R,
        unknowns: &mut Unknowns<R::Storage, f64>,
    ) -> [Vec3<R>; 2] {
        let TableauInLanes { columns, rows, .. } = &self.start.plan.tableau;
        let turning = self.turning;
        // [body] theta: a correction towards the polar factor of I + D.
        let u = self.u.lengthened_by_w();
        let w = times_hat(&u.matrix(), &turning);
        let d = applied_to_matrix(&w, columns);
        let matrix = u.matrix();
        self.stretch = stretch_of(&u, &matrix, &d);
        self.inverse_q = inverse_of_q(&self.stretch);
        let half = over_q(&self.inverse_q, &residual(&u, &matrix, &d));
        let rate = self.turn_rate(&u);
        let polar = u.turned(&scaled(&half, lanes.constant(0.5)));
        let along = applied_to_turn(&rate, columns);
        let theta = Quaternion { w: (polar.w + -1.0) - along.w, v: minus(&polar.v, &along.v) };
        let turned = minus(&theta.v, &self.theta.v);
        (self.theta, self.u) = (theta, polar);
        // The end, and lambda.
        let sum = Quaternion { w: rate.w.sum() + 1.0, v: vec3!(i => rate.v[i].sum()) };
        unknowns.end = sum.normalised();
        let (mut change, mut inverse) = (unknowns.end.change(), [0.0; 6]);
        let [xx, yy, zz, yz, xz, xy] = self.stretch;
        if largest(&[xx, yy, zz]).max_or_nan(largest(&[yz, xz, xy])) > NO_STRETCH {
            let end = end_of_stages(lanes, &w, unknowns);
            (change, inverse) = (end.change, end.inverse);
        }
        let rate = self.momentum_rate();
        let p1: Vec3<f64> = vec3!(i => self.p0[i].stage(0) + rate[i].sum());
        let lambda = over_q(&inverse, &scaled(&p1, -1.0));
        let f_lambda = times_hat(&with_one(&change), &lambda);
        let f_lambda: Mat3<R> = mat3!(i, j => lanes.spread(f_lambda[i][j]));
        // x: Q(P) x = h b (S Omega - tr(S) Omega + mu x Omega / 2 - tau)
        let s = &self.s;
        let trace = s[0] + s[1] + s[2];
        let (stretched, turned_out) = (symmetric_product(s, &turning), cross(&self.mu, &turning));
        let load: Vec3<R> =
            vec3!(i => (stretched[i] - trace * turning[i]) + (turned_out[i] * 0.5 - self.push[i]));
        self.x = over_q(&self.inverse_q, &load);
        // [body] delta, and the S that belongs to it.
        let c = polar.change();
        let u = with_one(&c);
        let k: Mat3<R> = vec3!(i => minus(&d[i], &c[i]));
        let t = times_hat(&u, &self.x);
        let y = applied_to_matrix(&t, rows);
        let parts = minus(&asym_of(&d, &t), &asym_of(&w, &y));
        let parts = applied(&parts, columns);
        let of_end = asym_of(&k, &f_lambda);
        let of_turn = asym_of(&c, &y);
        let delta: Vec3<R> = vec3!(i => of_end[i] - (of_turn[i] + parts[i]));
        let gained = minus(&delta, &self.delta);
        self.delta = delta;
        self.set_momentum::<EXTRAS>(plus(&self.mu, &gained));
        let (u, m) = (transposed(&u), transposed(&mat3!(i, j => f_lambda[i][j] + y[i][j])));
        let n = |i: usize, j: usize| dot(&u[i], &m[j]);
        self.s = [
            n(0, 0),
            n(1, 1),
            n(2, 2),
            (n(1, 2) + n(2, 1)) * 0.5,
            (n(0, 2) + n(2, 0)) * 0.5,
            (n(0, 1) + n(1, 0)) * 0.5,
        ];
        [gained, turned]
    }
}

/// Brings f to the polar factor of `I + sum_k w_k`, and keeps its stretch.
///
/// With `|q|^2 = 1 - d` the matrix of q is `(1 - d) R + d I`, so that [`residual`] holds `4 d w v` too much. That is rounding, but of one
/// sign: left in, or with a single pass from a quaternion whose length is not one to the last digit, the energy of the dipole drifted
/// by 1e-19 to 1e-18 J a step.
#[inline(always)]
fn end_to_rounding<R: StageScalar<StepScalar = f64>>(
    w: &Mat3<R>,
    unknowns: &mut Unknowns<R::Storage, f64>,
) {
    let d: Mat3<f64> = mat3!(i, j => w[i][j].sum());
    for _ in 0..2 {
        let end = unknowns.end;
        let f = end.matrix();
        let stretch = stretch_of(&end, &f, &d);
        let deficit = (1.0 - end.w) * (1.0 + end.w) - dot(&end.v, &end.v);
        let measured = residual(&end, &f, &d);
        let too_much = 4.0 * deficit * end.w;
        let measured: Vec3<f64> = vec3!(i => measured[i] - too_much * end.v[i]);
        let half = over_q(&inverse_of_q(&stretch), &scaled(&measured, 0.5));
        unknowns.end = end.turned(&half);
        unknowns.end_stretch = stretch;
    }
}

/// Solves the step until it lacks `tolerance` at most, to rounding if that is zero, and leaves its solution in the unknowns.
#[inline(always)]
pub(super) fn solve<R: StageScalar<StepScalar = f64>, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, f64>,
    tolerance: f64,
    unknowns: &mut Unknowns<R::Storage, f64>,
) -> Collocated {
    let TableauInLanes { weights, nodes, .. } = &start.plan.tableau;
    let zero = lanes.constant(0.0);
    let none = [zero; 3];
    let weight = lanes.row(weights) * start.step;
    let p0: Vec3<R> = vec3!(i => lanes.spread(start.momentum[i]));
    let velocity = velocity_at_start::<f64, EXTRAS>(&start.inertia, start.drive, &start.momentum);
    let elapsed = lanes.row(nodes) * (0.5 * start.step);
    let mut at = Iterate {
        start,
        weight,
        p0,
        inertia: start.inertia.in_lanes(lanes),
        mu: p0,
        u: Quaternion::cayley(&vec3!(i => elapsed * lanes.spread(velocity[i]))),
        tau: none,
        proximity: lanes.constant(-1.0),
        push: none,
        turning: none,
        delta: none,
        theta: Quaternion { w: zero, v: none },
        s: [zero; 6],
        x: none,
        stretch: [zero; 6],
        inverse_q: [zero; 6],
    };
    at.set_momentum::<EXTRAS>(p0);
    let [with_few, with_many] = LEAST_OF_DEFECTS;
    let least_of_defects = if start.plan.tableau.stages <= 6 { with_few } else { with_many };
    let angle = |omega: f64| start.step.abs() * omega.sqrt();
    let mut turn = angle(dot(&velocity, &velocity));
    // What the defects lack, what that may be, and by how much an evaluation reduces it.
    let mut lacking = start.plan.tableau.order_of_defect(turn);
    let mut goal = (PART_OF_DEFECTS * lacking).max(LEAST_SHORTFALL);
    let mut of_evaluation = 0.0;
    let [mut of_block, mut least_of_block] = OF_BLOCK;
    let mut before = f64::INFINITY;
    let mut done =
        Collocated { torques: 0, evaluations: 0, change: f64::INFINITY, is_solved: false };
    let mut last = f64::INFINITY;
    let mut enough = false;
    // The unit of momenta.
    let mut size = 1.0;
    loop {
        // A block.
        at.evaluate_torque::<EXTRAS>();
        done.torques += 1;
        let [momenta, turns] = at.round::<EXTRAS>();
        for _ in 1..ROUNDS {
            at.round::<EXTRAS>();
        }
        if done.evaluations == 0 {
            size = largest(&at.mu).max_or_nan(largest(&p0)).max_or_nan(SMALLEST_SIZE);
        }
        let change = (largest(&momenta) / size).max_or_nan(largest(&turns));
        done.change = change;
        let ratio = if last < f64::INFINITY {
            (change / last).clamp(least_of_block, 1.0)
        } else {
            of_block
        };
        let shortfall = change * ratio;
        let is_rounding = (change >= 0.5 * last && change < ROUNDING) || change <= NOTHING;
        let astray = !(change < ASTRAY);
        if !(shortfall <= goal || is_rounding || astray || done.torques >= MOST_BLOCKS) {
            last = change;
            continue;
        }
        if enough || astray || done.torques >= MOST_BLOCKS || done.evaluations >= MOST_EVALUATIONS {
            break;
        }
        if done.evaluations == 0 {
            (of_block, least_of_block) = (ratio, ratio);
            for _ in 0..start.plan.tableau.stages + 1 {
                at.round_of_s::<EXTRAS>();
            }
            let omega = at.velocity::<EXTRAS>(&at.mu);
            turn = turn.max(angle(dot(&omega, &omega).largest()));
            let [least, most] = BOUNDS_OF_EVALUATION;
            of_evaluation = (OF_EVALUATION * turn * turn).clamp(least, most);
        }
        // An evaluation.
        let [gained, turned] = at.evaluate::<EXTRAS>(lanes, unknowns);
        done.evaluations += 1;
        let jump = (largest(&gained) / size).max_or_nan(largest(&turned));
        // Below rounding a change tells nothing of what is left: there the estimates of before go on.
        let left = if jump > NOTHING { jump } else { jump.min(lacking) };
        if done.evaluations > 1 && jump > NOTHING {
            // A ratio may be luck.
            of_evaluation = (jump / before).clamp(0.3 * of_evaluation, 1.0);
        }
        // The defects take a part of what the collocation lacked when they were evaluated.
        let of_blocks = if is_rounding { 0.0 } else { shortfall * turn.min(1.0) * PART_OF_DEFECTS };
        lacking = (left * of_evaluation).max(of_blocks);
        enough = lacking <= (least_of_defects / turn.min(1.0)).max(tolerance)
            || (done.evaluations > 1 && jump >= 0.3 * before && jump < ROUNDING);
        goal = if enough { LEAST_SHORTFALL.max(tolerance) } else { PART_OF_DEFECTS * lacking };
        if !(jump < ASTRAY) {
            break;
        }
        (before, last) = (jump, f64::INFINITY);
    }
    // The end, from the newest stages.
    let u = at.u.lengthened_by_w();
    let c = u.change();
    let matrix = with_one(&c);
    let w = times_hat(&matrix, &at.turning);
    end_to_rounding(&w, unknowns);
    let impulses = scaled(&product(&matrix, &at.tau), -weight);
    let gain = at.momentum_rate();
    unknowns.impulse = vec3!(i => impulses[i].sum());
    unknowns.momentum_increment = vec3!(i => gain[i].sum());
    unknowns.proximity = at.proximity.largest();
    // pi - p0 = (U - I) mu + (mu - p0)
    let beyond = product(&c, &at.mu);
    let momentum = vec3!(i => beyond[i] + (at.mu[i] - p0[i]));
    store(&momentum, &mut unknowns.momentum);
    store(&at.x, &mut unknowns.x);
    u.w.store(&mut unknowns.attitude.w);
    store(&u.v, &mut unknowns.attitude.v);
    for i in 0..6 {
        at.stretch[i].store(&mut unknowns.stretch[i]);
        at.inverse_q[i].store(&mut unknowns.inverse[i]);
    }
    let sum = unknowns.impulse.iter().chain(&unknowns.momentum_increment).chain(&unknowns.end.v);
    let is_finite = sum.sum::<f64>().is_finite() && largest(&momentum).is_finite();
    done.is_solved = enough && is_finite && done.torques < MOST_BLOCKS;
    done
}
