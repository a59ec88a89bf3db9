//! One sweep over the equations of a VPD step for n = 3, the stages side by side in lanes.
//!
//! The equations are those of [`crate::stepper::galerkin`] in the vectors of so(3). With
//! `w_j = h b_j U_j hat(Omega_j)`, `e_ij = a_ij / b_j` and `Q(P) = tr(P) I - P`:
//!
//! ```text
//! U_i P_i = I + sum_j e_ij w_j                      f P_e = I + sum_j w_j
//! pi1 = p0 - h sum_k b_k U_k tau_k                  tau = vee(dH/dg)
//! Q(P_e) lambda = -f^T pi1
//! W_k = f hat(lambda) + sum_i e_ik U_i hat(x_i)
//! Q(P_k) x_k = -h b_k ((tr(N_k) I - N_k^T) Omega_k + tau_k)                  N_k = U_k^T W_k
//! pi_k = -vee asym(W_k U_k^T)                       Omega_k = J^-1 U_k^T pi_k
//! ```
//!
//! The second line is (24d, vih4) and (24e, vih5) solved exactly: when the equations of the stages
//! are summed, everything but the torques cancels. So the spatial momentum changes by the torques
//! alone, and a free body keeps it to the bit.
//!
//! The stiff coupling, J^-1 times the momentum, is in the kinematics (first and last line), which
//! are therefore repeated within a sweep. So is the linear system of x, which must be consistent
//! with them. The torque is computed once.
//!
//! Small quantities are computed as such; otherwise a thin body, which turns fast about its axis
//! with little momentum, would pick up rounding errors of the large components. Momenta are kept
//! minus p0, and rotations are used minus I. With `C_k = U_k - I`, `C_f = f - I` and
//! `Y_k = W_k - f hat(lambda)`, one or two stages have
//! ```text
//! pi_k - p0 = (pi1 - p0) + C_f^T pi1 - Q(P_e)^-1 (Q(P_e) - 2) p1 - vee asym(C_f hat(lambda) + W_k C_k^T + Y_k)
//! ```
//!
//! There terms as large as the momentum times the turn cancel. Their rounding left 1e-17 of the
//! torque, the same at each stage, and many stages are used for the last digits: the energy of a
//! heavy top rose linearly. Three or more stages use [transport] and [defect] of
//! docs/derivation.md, in which each term is small; with `T_k = U_k hat(x_k)`,
//! `K'_k = U_k E_k + sum_j (1 - e_jk - e_kj) w_j` and `D_k = C_k + U_k E_k`
//!
//! ```text
//! pi_k - p0 = delta_k - h sum_j (1 - e_jk) b_j U_j tau_j
//! delta_k = vee asym(f hat(lambda) K'_k^T - Y_k C_k^T - sum_j (1 - e_jk) (T_j D_j^T - Y_j w_j^T))
//! ```
//!
//! This is the same momentum where the equations are solved. Before that, one or two stages need a
//! tenth more sweeps with it; many stages need fewer, and converge at steps a tenth longer.
//!
//! For the same reason Q(P)^-1 is kept minus I / 2 (docs/derivation.md, section 4).
//!
//! Each pass corrects U_k rather than computing a polar factor: `theta = Q^-1 vee asym(U^T A)` and
//! `U <- U (1 + theta / 2)` normalised, with the K of the previous sweep. At the end U^T A is
//! symmetric, and P its polar factor. What a correction itself causes at the other stages is added
//! to first order, with all turns and stretches replaced by the identity, in vectors where a pass
//! works with matrices:
//!
//! ```text
//! theta_k <- theta_k + h sum_j a_kj (J^-1 (mu_j x theta_j) + theta_j x Omega_j / 2)
//! x_k <- x_k + h b_k Omega_k x (sum_i e_ik dx_i) / 2                  dx the change of x in the pass
//! ```

use super::unknowns::{RENEWED_STAGES, Start, TORQUE_EVERY, Unknowns};
use crate::hamiltonian::{Drive, DriveInFrame};
use crate::lanes::extras::DRIVEN;
use crate::lanes::{Real, Row, StageScalar, StepScalar};
use crate::nonlinear::SMALLEST_SIZE;
use crate::space::{
    Mat3, Quaternion, Sym3, Vec3, cross, dot, mat3, minus, plus, product, scaled,
    symmetric_product, times_hat, transposed_product, vec3, vee_asym, with_one,
};
use crate::stepper::so3_equations::{
    Inertia, defect, embedded, inverse_of_q, over_q, residual, store, stretch_of,
};
use crate::tableau::TableauInLanes;

/// Largest deviation of the square of a quaternion from one allowed after the last sweep of the first
/// guess.
const MOST_NORM_ERROR: f64 = 0.1;

/// Runs [`sweep`] for members, and returns the increment of each in memory.
#[inline(always)]
pub(super) fn sweep_to_row<
    R: StageScalar<StepScalar: StepScalar<Storage = Row>>,
    const EXTRAS: u8,
>(
    lanes: R,
    start: &Start<'_, R::Storage, Row>,
    unknowns: &mut Unknowns<R::Storage, Row>,
) -> Row {
    let mut increments = Row::splat(0.0);
    sweep::<R, EXTRAS>(lanes, start, unknowns).store(&mut increments);
    increments
}

/// The velocity of a body momentum at the stages, `J^-1 (mu - wheels)`.
#[inline(always)]
pub(super) fn velocity_of<R: StageScalar, const EXTRAS: u8>(
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    inertia: &Inertia<R>,
    mu: &Vec3<R>,
) -> Vec3<R> {
    if EXTRAS & DRIVEN != 0 {
        let (lanes, wheels) = (mu[0], &start.drive.wheels.at_stages);
        inertia.divides(&vec3!(i => mu[i] - lanes.row(&wheels[i])))
    } else {
        inertia.divides(mu)
    }
}

/// The same where the step begins.
#[inline(always)]
pub(super) fn velocity_at_start<T: StepScalar, const EXTRAS: u8>(
    inertia: &Inertia<f64>,
    drive: &Drive,
    mu: &Vec3<T>,
) -> Vec3<T> {
    let inertia = inertia.in_lanes(mu[0]);
    if EXTRAS & DRIVEN != 0 {
        inertia.divides(&vec3!(i => mu[i] + -drive.wheels.at_start[i]))
    } else {
        inertia.divides(mu)
    }
}

/// Makes the first guess: from the velocity at the beginning, kept constant, and the torque along
/// it, a few sweeps of plain collocation,
///
/// ```text
/// q_k = 1 + h sum_j a_kj q_j Omega_j / 2,    pi_k = p0 - h sum_j a_kj U_j tau_j
/// ```
///
/// each a small part of the time of a sweep of the step. Each gains an order of h, until the
/// guess is as close as the stages of the step are to those of the collocation: some more
/// than there are stages if these are many, one less if they are few. The torque couples weakly: it
/// is evaluated in every third of them, and once more at the end. The guess is a function of the state
/// alone: a resumed run repeats it to the bit.
#[inline(always)]
pub(super) fn guess<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) {
    let whole = lanes.stage(0);
    let TableauInLanes { columns, weights, nodes, .. } = &start.plan.tableau;
    let at_start = vec3!(i => whole.load(&start.momentum[i]));
    let velocity = velocity_at_start::<_, EXTRAS>(&start.inertia, start.drive, &at_start);
    let inertia = start.inertia.in_lanes(lanes);
    let p0 = vec3!(i => lanes.spread(at_start[i]));
    let weight = lanes.row(weights) * start.step;
    let elapsed = lanes.row(nodes) * start.step;
    let half = elapsed * 0.5;
    let turned = Quaternion::cayley(&vec3!(i => half * lanes.spread(velocity[i])));
    let u = turned.matrix();
    let (torque, _) = torque_at::<R, EXTRAS>(lanes, start, &u, &p0);
    let guessed_momentum = scaled(&product(&u, &torque), -elapsed);
    let (mut attitude, mut momentum) = (turned, guessed_momentum);
    let mut norm_error = lanes.constant(0.0);
    for sweep in 0..start.plan.guess_sweeps {
        let u = attitude.matrix();
        if sweep % TORQUE_EVERY == TORQUE_EVERY - 1 {
            let (torque, _) = torque_at::<R, EXTRAS>(lanes, start, &u, &plus(&p0, &momentum));
            let impulse = scaled(&product(&u, &torque), weight);
            momentum = vec3!(i => -impulse[i].apply_tableau(columns));
        }
        let mu = transposed_product(&u, &plus(&p0, &momentum));
        let rate =
            attitude.rate(&scaled(&velocity_of::<R, EXTRAS>(start, &inertia, &mu), weight * 0.5));
        let next = Quaternion {
            w: rate.w.apply_tableau(columns) + 1.0,
            v: vec3!(i => rate.v[i].apply_tableau(columns)),
        };
        norm_error = (next.square() + -1.0).abs();
        attitude = next.lengthened();
    }
    // If they diverged, the constant velocity is the better guess.
    let last_norm_error = norm_error.largest();
    let norm_error = lanes.spread(last_norm_error);
    let attitude = attitude.select(norm_error, MOST_NORM_ERROR, &turned);
    let u = attitude.matrix();
    let (torque, _) = torque_at::<R, EXTRAS>(lanes, start, &u, &plus(&p0, &momentum));
    let impulse = scaled(&product(&u, &torque), weight);
    let collocated: Vec3<R> = vec3!(i => -impulse[i].apply_tableau(columns));
    let momentum =
        vec3!(i => collocated[i].select(norm_error, MOST_NORM_ERROR, guessed_momentum[i]));
    let mu = transposed_product(&u, &plus(&p0, &momentum));
    let omega = velocity_of::<R, EXTRAS>(start, &inertia, &mu);
    let rate = attitude.rate(&scaled(&omega, weight * 0.5));
    let end = Quaternion { w: rate.w.sum() + 1.0, v: vec3!(i => rate.v[i].sum()) };
    let kept_on = Quaternion::cayley(&scaled(&velocity, whole.constant(0.5 * start.step)));
    let end = end.normalised().select(last_norm_error, MOST_NORM_ERROR, &kept_on);
    // With P = I and N = -hat(mu) / 2 the equation of x is x = h b (mu x Omega / 2 - tau) / 2.
    let c = cross(&mu, &omega);
    let weight = weight * 0.5;
    let x: Vec3<R> = vec3!(i => weight * (c[i] * 0.5 - torque[i]));
    store_turn(&attitude, &mut unknowns.attitude);
    store(&momentum, &mut unknowns.momentum);
    store(&x, &mut unknowns.x);
    // The inverse of Q(I), kept minus I / 2.
    for entry in &mut unknowns.inverse {
        lanes.constant(0.0).store(entry);
    }
    end.w.store(&mut unknowns.end.w);
    for i in 0..3 {
        end.v[i].store(&mut unknowns.end.v[i]);
    }
}

/// Improves the unknowns in place; returns the largest change of a stage momentum, relative to the
/// largest, or of an attitude in the last pass. The result is NaN or infinite if an unknown is.
#[inline(always)]
pub(super) fn sweep<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) -> R::StepScalar {
    let whole = lanes.stage(0);
    let (TableauInLanes { rows, .. }, present) = (&start.plan.tableau, &start.plan.present);
    let [kinematic, linear] = &start.passes;
    let momentum: Vec3<R> = load(lanes, &unknowns.momentum);
    let stages = kinematics::<R, EXTRAS>(lanes, start, &momentum, unknowns, *kinematic);
    let u = with_one(&stages.c);
    let end = end_of_stages(lanes, &stages.w, unknowns);
    let forces = forces::<R, EXTRAS>(lanes, start, &u, &momentum, stages.weight, unknowns);
    let last = end_momentum(lanes, start, &end, &forces);
    let Kinematics { omega, weight, inverse_q, turned, .. } = &stages;
    let f_lambda: Mat3<R> = mat3!(i, j => lanes.spread(last.f_lambda[i][j]));

    // The embedded momenta W_k.
    let half_weight = *weight * 0.5;
    let mut x: Vec3<R> = load(lanes, &unknowns.x);
    let [mut t, mut y] = embedded(&u, &x, rows);
    let mut m: Mat3<R> = mat3!(i, j => f_lambda[i][j] + y[i][j]);
    // h b N^T Omega = W^T U (h b Omega)
    let turning = scaled(omega, *weight);
    let turned_out = product(&u, &turning);
    let weighted_torque = scaled(&forces.torque, *weight);
    for _ in 0..*linear {
        // tr(U^T W)
        let trace = dot(&u[0], &m[0]) + dot(&u[1], &m[1]) + dot(&u[2], &m[2]);
        let turned = transposed_product(&m, &turned_out);
        let load: Vec3<R> = vec3!(i => -((trace * turning[i] - turned[i]) + weighted_torque[i]));
        let next = over_q(inverse_q, &load);
        // What the change itself causes.
        let change: Vec3<R> = vec3!(i => (next[i] - x[i]).apply_tableau(rows));
        let follows = cross(omega, &change);
        x = vec3!(i => next[i] + follows[i] * half_weight);
        [t, y] = embedded(&u, &x, rows);
        m = mat3!(i, j => f_lambda[i][j] + y[i][j]);
    }
    let next = if R::STAGES <= 2 {
        embedded_momenta(lanes, &stages, &end, &last, &m, &y)
    } else {
        transported_momenta(&start.plan.tableau, &stages, &u, &forces.impulses, &f_lambda, [&t, &y])
    };
    // A lane without a stage must not show as a change made by the sweeps.
    let present = lanes.row(present);
    let next: Vec3<R> = vec3!(i => present * next[i]);
    let change = minus(&next, &momentum);
    let change = change[0].abs().max_or_nan(change[1].abs()).max_or_nan(change[2].abs()).largest();
    let size = next[0].abs().max_or_nan(next[1].abs()).max_or_nan(next[2].abs()).largest();
    let pi1 = &forces.pi1;
    let size = size.max_or_nan(pi1[0].abs()).max_or_nan(pi1[1].abs()).max_or_nan(pi1[2].abs());
    // Zero where all is finite.
    let total = ((next[0] + next[1]) + next[2]).sum();
    let poison = total * 0.0;
    store(&next, &mut unknowns.momentum);
    store(&x, &mut unknowns.x);
    // Avoids 0 / 0 for a body at rest.
    let relative = change / size.max_or_nan(whole.constant(SMALLEST_SIZE));
    relative.max_or_nan(turned.largest()) + poison
}

/// Brings the end point, the impulse and the body momentum, of which the state is made, up to the
/// newest stage momenta: after a sweep they are one iteration behind, and that error is biased. With many
/// stages the momenta are brought up to the attitudes first.
///
/// In `p1 - p0 = (pi1 - p0) + C_f^T pi1` the momentum about a thin axis is the small difference of
/// large numbers. The equations of x, summed over the stages with the x of (24d, vih4), give the
/// same in terms that are small by themselves:
///
/// ```text
/// p1 - p0 = sum_k h b_k (mu_k x Omega_k - tau_k)                             mu_k = J Omega_k
/// ```
///
/// About the axis of a symmetric top each term is zero, so the momentum about it is conserved
/// (Noether's theorem, for turns of the body about it). `h b Omega` is rounded as in the equations
/// of x: the rounding error of the constant Omega about that axis is then that of another body, and
/// symplectic.
#[inline(always)]
pub(super) fn finish<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) {
    let mut momentum: Vec3<R> = load(lanes, &unknowns.momentum);
    let mut stages = kinematics::<R, EXTRAS>(lanes, start, &momentum, unknowns, 1);
    let u = with_one(&stages.c);
    let end = end_of_stages(lanes, &stages.w, unknowns);
    let forces = forces::<R, EXTRAS>(lanes, start, &u, &momentum, stages.weight, unknowns);
    let p0 = vec3!(i => lanes.spread(lanes.stage(0).load(&start.momentum[i])));
    if R::STAGES > 2 && start.plan.tableau.stages >= RENEWED_STAGES {
        let last = end_momentum(lanes, start, &end, &forces);
        let f_lambda: Mat3<R> = mat3!(i, j => lanes.spread(last.f_lambda[i][j]));
        let [t, y] = embedded(&u, &load(lanes, &unknowns.x), &start.plan.tableau.rows);
        momentum = transported_momenta(
            &start.plan.tableau,
            &stages,
            &u,
            &forces.impulses,
            &f_lambda,
            [&t, &y],
        );
        let pi = plus(&p0, &momentum);
        let inertia = start.inertia.in_lanes(lanes);
        let turned_by = transposed_product(&stages.c, &pi);
        stages.omega =
            plus(&velocity_of::<R, EXTRAS>(start, &inertia, &pi), &inertia.divides(&turned_by));
        let w = times_hat(&u, &scaled(&stages.omega, stages.weight));
        end_of_stages(lanes, &w, unknowns);
    }
    let Kinematics { c, omega, weight, .. } = &stages;
    let pi = plus(&p0, &momentum);
    let mu = plus(&pi, &transposed_product(c, &pi));
    let turned = cross(&mu, &scaled(omega, *weight));
    let momentum_increment: Vec3<R::StepScalar> =
        vec3!(i => (turned[i] - *weight * forces.torque[i]).sum());
    for i in 0..3 {
        momentum_increment[i].store(&mut unknowns.momentum_increment[i]);
    }
}

/// The stages for given momenta.
struct Kinematics<R> {
    /// [C]: U - I
    c: Mat3<R>,
    omega: Vec3<R>,
    /// h b
    weight: R,
    /// P - I
    stretch: Sym3<R>,
    inverse_q: Sym3<R>,
    /// The largest change of an attitude in the last pass.
    turned: R,
    /// [w]: h b U hat(Omega)
    w: Mat3<R>,
}

/// Computes U_k and Omega_k for the momenta p0 + `momentum`.
#[inline(always)]
fn kinematics<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    momentum: &Vec3<R>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
    passes: u32,
) -> Kinematics<R> {
    let TableauInLanes { columns, weights, .. } = &start.plan.tableau;
    let weight = lanes.row(weights) * start.step;
    let inertia = start.inertia.in_lanes(lanes);
    let mut attitude = load_turn(lanes, &unknowns.attitude);
    let mut inverse_q: Sym3<R> = [lanes; 6];
    for i in 0..6 {
        inverse_q[i] = lanes.load(&unknowns.inverse[i]);
    }
    let p0 = vec3!(i => lanes.spread(lanes.stage(0).load(&start.momentum[i])));
    let momentum = plus(&p0, momentum);
    // J^-1 (U^T pi - wheels) = J^-1 (pi - wheels) + J^-1 (U - I)^T pi
    let unturned = velocity_of::<R, EXTRAS>(start, &inertia, &momentum);
    let mut c = attitude.change();
    let mut u = with_one(&c);
    let mut turned_by = transposed_product(&c, &momentum);
    let mut omega = plus(&unturned, &inertia.divides(&turned_by));
    let mut w = times_hat(&u, &scaled(&omega, weight));
    let mut turned = lanes.constant(0.0);
    let mut stretch = inverse_q;
    for pass in 1..=passes {
        let d: Mat3<R> = mat3!(i, j => w[i][j].apply_tableau(columns));
        let half = over_q(&inverse_q, &residual(&attitude, &u, &d));
        let half = scaled(&half, lanes.constant(0.5));
        // What the correction itself causes, through the velocities.
        let faster = inertia.divides(&cross(&plus(&momentum, &turned_by), &half));
        let bent = cross(&half, &scaled(&omega, lanes.constant(0.5)));
        let follows: Vec3<R> = vec3!(i => (weight * (faster[i] + bent[i])).apply_tableau(columns));
        let half = plus(&half, &follows);
        // The last pass computes the stretch for what follows; the others use that of the previous
        // sweep.
        if pass == passes {
            stretch = stretch_of(&attitude, &u, &d);
            inverse_q = inverse_of_q(&stretch);
        }
        attitude = attitude.turned(&half);
        turned = half[0].abs().max_or_nan(half[1].abs()).max_or_nan(half[2].abs());
        c = attitude.change();
        u = with_one(&c);
        turned_by = transposed_product(&c, &momentum);
        omega = plus(&unturned, &inertia.divides(&turned_by));
        w = times_hat(&u, &scaled(&omega, weight));
    }
    store_turn(&attitude, &mut unknowns.attitude);
    for i in 0..6 {
        inverse_q[i].store(&mut unknowns.inverse[i]);
        stretch[i].store(&mut unknowns.stretch[i]);
    }
    Kinematics { c, omega, weight, stretch, inverse_q, turned, w }
}

/// The end point, to which the stages lead.
pub(super) struct EndPoint<R: StageScalar> {
    /// f - I
    pub(super) change: Mat3<R::StepScalar>,
    /// P_e - I.
    stretch: Sym3<R::StepScalar>,
    /// Q(P_e)^-1 - I / 2.
    pub(super) inverse: Sym3<R::StepScalar>,
}

/// Computes the end point for the w of the stages.
#[inline(always)]
pub(super) fn end_of_stages<R: StageScalar>(
    lanes: R,
    w: &Mat3<R>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) -> EndPoint<R> {
    let whole = lanes.stage(0);
    let d: Mat3<R::StepScalar> = mat3!(i, j => w[i][j].sum());
    let end = Quaternion {
        w: whole.load(&unknowns.end.w),
        v: vec3!(i => whole.load(&unknowns.end.v[i])),
    };
    let f = end.matrix();
    let stretch = stretch_of(&end, &f, &d);
    let inverse = inverse_of_q(&stretch);
    let half = over_q(&inverse, &residual(&end, &f, &d));
    let half = scaled(&half, whole.constant(0.5));
    let end = end.turned(&half);
    for i in 0..6 {
        stretch[i].store(&mut unknowns.end_stretch[i]);
    }
    end.w.store(&mut unknowns.end.w);
    for i in 0..3 {
        end.v[i].store(&mut unknowns.end.v[i]);
    }
    EndPoint { change: end.change(), stretch, inverse }
}

/// Computes `tau = vee(dH/dg - F_tau)` at the stages, given their spatial momenta in the frame of g0; with it the proximity, as
/// returned by [`crate::hamiltonian::RigidBody::torque`].
#[inline(always)]
fn torque_at<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    u: &Mat3<R>,
    pi: &Vec3<R>,
) -> (Vec3<R>, R) {
    let of_terms = start.body.torque::<R, EXTRAS>(u, start.seen);
    if EXTRAS & DRIVEN == 0 {
        return of_terms;
    }
    let mu = transposed_product(u, pi);
    let omega = velocity_of::<R, EXTRAS>(start, &start.inertia.in_lanes(lanes), &mu);
    start.body.driven_torque(u, [&mu, &omega], start.drive, start.drive_seen, of_terms)
}

/// The same, given their body momenta.
#[inline(always)]
pub(super) fn torque_in_body<R: StageScalar, const EXTRAS: u8>(
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    u: &Mat3<R>,
    inertia: &Inertia<R>,
    mu: &Vec3<R>,
) -> (Vec3<R>, R) {
    let of_terms = start.body.torque::<R, EXTRAS>(u, start.seen);
    if EXTRAS & DRIVEN == 0 {
        return of_terms;
    }
    let omega = velocity_of::<R, EXTRAS>(start, inertia, mu);
    start.body.driven_torque(u, [mu, &omega], start.drive, start.drive_seen, of_terms)
}

/// Brings what the body sees of its drive up to `attitude`, the quaternion at the beginning of the step; `blank` is anything.
#[inline(always)]
pub(super) fn see_drive<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    [w, x, y, z]: &[<R::StepScalar as StepScalar>::Storage; 4],
    drive: &Drive,
    seen: &mut DriveInFrame<R::Storage>,
    blank: R::Storage,
) {
    if EXTRAS & DRIVEN != 0 {
        let whole = lanes.stage(0);
        let v = [whole.load(x), whole.load(y), whole.load(z)];
        seen.update(lanes, &Quaternion { w: whole.load(w), v }.matrix(), drive, blank);
    }
}

/// Computes what time and torques put in during the solved step: energy, and momentum in the frame of g0.
#[inline(always)]
pub(super) fn work_and_impulse<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) {
    if EXTRAS & DRIVEN == 0 {
        return;
    }
    let u = load_turn(lanes, &unknowns.attitude).matrix();
    let momentum: Vec3<R> = load(lanes, &unknowns.momentum);
    let pi = vec3!(i => lanes.spread(lanes.stage(0).load(&start.momentum[i])) + momentum[i]);
    let mu = transposed_product(&u, &pi);
    let omega = velocity_of::<R, EXTRAS>(start, &start.inertia.in_lanes(lanes), &mu);
    let weight = lanes.row(&start.plan.tableau.weights) * start.step;
    let (work, impulse) =
        start.body.work_and_impulse(&u, [&mu, &omega], weight, start.drive, start.drive_seen);
    work.store(&mut unknowns.work);
    for i in 0..3 {
        impulse[i].store(&mut unknowns.torque_impulse[i]);
    }
}

/// Torques on the body, and their effects.
struct Forces<R: StageScalar> {
    /// tau
    torque: Vec3<R>,
    /// -h b U tau
    impulses: Vec3<R>,
    /// pi1 - p0
    impulse: Vec3<R::StepScalar>,
    pi1: Vec3<R::StepScalar>,
}

/// Computes the torques at the stages, for the momenta p0 + `momentum`, and their effects.
#[inline(always)]
fn forces<R: StageScalar, const EXTRAS: u8>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    u: &Mat3<R>,
    momentum: &Vec3<R>,
    weight: R,
    unknowns: &mut Unknowns<R::Storage, <R::StepScalar as StepScalar>::Storage>,
) -> Forces<R> {
    let p0 = vec3!(i => lanes.spread(lanes.stage(0).load(&start.momentum[i])));
    let (torque, proximity) = torque_at::<R, EXTRAS>(lanes, start, u, &plus(&p0, momentum));
    let impulses = scaled(&product(u, &torque), -weight);
    let impulse: Vec3<R::StepScalar> = vec3!(i => impulses[i].sum());
    for i in 0..3 {
        impulse[i].store(&mut unknowns.impulse[i]);
    }
    proximity.largest().store(&mut unknowns.proximity);
    let pi1 = vec3!(i => lanes.stage(0).load(&start.momentum[i]) + impulse[i]);
    Forces { torque, impulses, impulse, pi1 }
}

/// The momentum at the end point.
struct EndMomentum<R: StageScalar> {
    /// p1 - p0
    momentum_increment: Vec3<R::StepScalar>,
    p1: Vec3<R::StepScalar>,
    lambda: Vec3<R::StepScalar>,
    /// f hat(lambda)
    f_lambda: Mat3<R::StepScalar>,
}

/// Computes `p1 = f^T pi1` and [Lambda]: `Q(P_e) lambda = -p1`.
#[inline(always)]
fn end_momentum<R: StageScalar>(
    lanes: R,
    start: &Start<'_, R::Storage, <R::StepScalar as StepScalar>::Storage>,
    EndPoint { change, inverse, .. }: &EndPoint<R>,
    Forces { impulse, pi1, .. }: &Forces<R>,
) -> EndMomentum<R> {
    let momentum_increment = plus(impulse, &transposed_product(change, pi1));
    let p1 = vec3!(i => lanes.stage(0).load(&start.momentum[i]) + momentum_increment[i]);
    let lambda = over_q(inverse, &vec3!(i => -p1[i]));
    let f_lambda = times_hat(&with_one(change), &lambda);
    EndMomentum { momentum_increment, p1, lambda, f_lambda }
}

/// Computes `pi - p0` of the stages by (24a, vih1), `pi = -vee asym(W U^T)`.
#[inline(always)]
fn embedded_momenta<R: StageScalar>(
    lanes: R,
    Kinematics { c, .. }: &Kinematics<R>,
    EndPoint { change, stretch, inverse }: &EndPoint<R>,
    EndMomentum { momentum_increment, p1, lambda, .. }: &EndMomentum<R>,
    m: &Mat3<R>,
    y: &Mat3<R>,
) -> Vec3<R> {
    // -vee asym(f hat(lambda)) - p0
    let stretched = over_q(inverse, &q_less_two(stretch, p1));
    let beyond = vee_asym(&times_hat(change, lambda));
    let common: Vec3<R> =
        vec3!(i => lanes.spread(momentum_increment[i] - (stretched[i] + beyond[i])));
    let turned_off = [
        dot(&m[1], &c[2]) - dot(&m[2], &c[1]),
        dot(&m[2], &c[0]) - dot(&m[0], &c[2]),
        dot(&m[0], &c[1]) - dot(&m[1], &c[0]),
    ];
    let own = vee_asym(y);
    vec3!(i => common[i] + (turned_off[i] - own[i]))
}

/// Computes the same by [transport].
#[inline(always)]
fn transported_momenta<R: StageScalar>(
    TableauInLanes { conjugate, conjugate_defect, .. }: &TableauInLanes,
    Kinematics { c, stretch, w, .. }: &Kinematics<R>,
    u: &Mat3<R>,
    impulses: &Vec3<R>,
    f_lambda: &Mat3<R>,
    embedded: [&Mat3<R>; 2],
) -> Vec3<R> {
    // [K] and [D]
    let mut k: Mat3<R> = vec3!(i => symmetric_product(stretch, &u[i]));
    let d: Mat3<R> = mat3!(i, j => c[i][j] + k[i][j]);
    if let Some(conjugate_defect) = conjugate_defect {
        k = mat3!(i, j => k[i][j] + w[i][j].apply_tableau(conjugate_defect));
    }
    let delta = defect(f_lambda, [c, &d, &k], w, embedded, conjugate);
    vec3!(i => delta[i] + impulses[i].apply_tableau(conjugate))
}

/// `(Q(P) - 2) v` for `P = I + E`.
#[inline(always)]
fn q_less_two<T: Real>(stretch: &Sym3<T>, v: &Vec3<T>) -> Vec3<T> {
    let trace = stretch[0] + stretch[1] + stretch[2];
    let stretched = symmetric_product(stretch, v);
    vec3!(i => trace * v[i] - stretched[i])
}

#[inline(always)]
fn load<R: StageScalar>(lanes: R, plain: &Vec3<R::Storage>) -> Vec3<R> {
    vec3!(i => lanes.load(&plain[i]))
}

#[inline(always)]
fn load_turn<R: StageScalar>(lanes: R, plain: &Quaternion<R::Storage>) -> Quaternion<R> {
    Quaternion { w: lanes.load(&plain.w), v: load(lanes, &plain.v) }
}

#[inline(always)]
fn store_turn<R: StageScalar>(value: &Quaternion<R>, plain: &mut Quaternion<R::Storage>) {
    value.w.store(&mut plain.w);
    store(&value.v, &mut plain.v);
}
