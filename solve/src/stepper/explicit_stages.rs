//! What the stages of explicit methods for n = 3 have in common: the law of motion as their formulas see it, and sums of rates, in lanes.
//!
//! Invariant: what may be wrong shows as a doubt, which is below zero where no test has found anything.

use crate::hamiltonian::{CLOSEST_APPROACH, Drive, DriveInFrame, RigidBody};
use crate::lanes::extras::DRIVEN;
use crate::lanes::{Real, StageScalar, StepScalar};
use crate::space::{Mat3, Vec3, cross, mat3, minus, plus, vec3};
use crate::stepper::so3_equations::Inertia;
use crate::tableau::Tableau;

/// The most stages of a tableau.
pub(super) const MOST_STAGES: usize = 12;
/// Numbers of a state. By a tableau: the rows of the attitude and the momentum, then nothing. By splitting: the quaternion and
/// the momentum, then what is still to be added to them ([`crate::composition::TopSum`]).
pub(super) const NUMBERS: usize = 14;
/// Distances up to this many times [`CLOSEST_APPROACH`] are in doubt: here they are relative to the arms on the group.
const DOUBTFUL_APPROACH: f64 = 4.0 * CLOSEST_APPROACH;

/// Rates of a stage: of the attitude, row by row or in the Lie algebra, and of the momentum.
pub(super) type Rates<S> = [Vec3<S>; 4];

/// The law of motion as the formulas of a method see it.
pub(super) struct Law<'a, R: StageScalar> {
    pub(super) body: &'a RigidBody<3>,
    pub(super) inertia: Inertia<R>,
    pub(super) space: &'a [Vec3<<R::StepScalar as StepScalar>::Storage>],
    pub(super) drives: &'a [Drive],
    pub(super) drives_seen: &'a [DriveInFrame<R::Storage>],
    pub(super) work: R::StepScalar,
    pub(super) impulse: Vec3<R::StepScalar>,
}

/// The law at a stage.
pub(super) struct AtStage<R> {
    /// Omega
    pub(super) omega: Vec3<R>,
    /// mu'
    pub(super) momentum_rate: Vec3<R>,
    /// How close the potential is to losing its meaning: below zero if not in doubt.
    pub(super) doubt: R,
}

impl<R: StageScalar> Law<'_, R> {
    pub(super) fn inertia(&self) -> &Inertia<R> {
        &self.inertia
    }

    /// `vee(dH/dg)` of a body that nothing drives, and its doubt.
    #[inline(always)]
    pub(super) fn torque<const EXTRAS: u8>(&self, g: &Mat3<R>) -> (Vec3<R>, R) {
        let (torque, proximity) = self.body.torque::<R, EXTRAS>(g, self.space);
        (torque, proximity + DOUBTFUL_APPROACH * DOUBTFUL_APPROACH)
    }

    /// `Omega = J^-1 (mu - wheels)` and `mu' = mu x Omega - vee(dH/dg - F_tau)` at stage `k`, whose weight is `h b_k`, at an
    /// attitude that need not be on the group.
    #[inline(always)]
    pub(super) fn at<const EXTRAS: u8>(
        &mut self,
        k: usize,
        weight: f64,
        g: &Mat3<R>,
        mu: &Vec3<R>,
    ) -> AtStage<R> {
        let lanes = mu[0];
        let is_driven = EXTRAS & DRIVEN != 0;
        let mut own = *mu;
        if is_driven {
            let wheels = &self.drives[k].wheels.at_stages;
            own = vec3!(i => mu[i] - lanes.row(&wheels[i]));
        }
        let omega = self.inertia.divides(&own);
        let mut torque = self.body.torque::<R, EXTRAS>(g, self.space);
        if is_driven && self.body.is_driven() {
            let (drive, seen) = (&self.drives[k], &self.drives_seen[k]);
            torque = self.body.driven_torque(g, [mu, &omega], drive, seen, torque);
            let weight = lanes.constant(weight);
            let (work, impulse) = self.body.work_and_impulse(g, [mu, &omega], weight, drive, seen);
            self.work = self.work + work;
            self.impulse = plus(&self.impulse, &impulse);
        }
        let (torque, proximity) = torque;
        let doubt = proximity + DOUBTFUL_APPROACH * DOUBTFUL_APPROACH;
        AtStage { omega, momentum_rate: minus(&cross(mu, &omega), &torque), doubt }
    }
}

/// `value + sum_j parts_j rates_j` of one row of the rates.
#[inline(always)]
pub(super) fn with_rates<R: StageScalar>(
    mut value: Vec3<R>,
    parts: &[f64],
    rates: &[Rates<R::Storage>],
    row: usize,
) -> Vec3<R> {
    for (part, rate) in parts.iter().zip(rates) {
        // At eighth order a third of them is zero.
        if *part != 0.0 {
            for i in 0..3 {
                value[i] = value[i] + value[i].load(&rate[row][i]) * *part;
            }
        }
    }
    value
}

/// `h a_ij` of stage `i`, or `h b_j` of the end.
#[inline(always)]
pub(super) fn parts(tableau: &Tableau, h: f64, stage: Option<usize>) -> [f64; MOST_STAGES] {
    let mut parts = [0.0; MOST_STAGES];
    for j in 0..stage.unwrap_or(tableau.stages()) {
        parts[j] = h * stage.map_or(tableau.b(j), |i| tableau.a(i, j));
    }
    parts
}

/// State and doubt at the end of a step.
pub(super) struct End<R> {
    pub(super) state: [R; NUMBERS],
    pub(super) doubt: R,
}

/// Attitude and momentum of the numbers of a state by a tableau.
#[inline(always)]
pub(super) fn attitude_and_momentum<R: Real>(state: &[R; NUMBERS]) -> (Mat3<R>, Vec3<R>) {
    (mat3!(i, j => state[3 * i + j]), vec3!(i => state[9 + i]))
}

/// The numbers of a state by a tableau.
#[inline(always)]
pub(super) fn packed<R: Real>(g: &Mat3<R>, mu: &Vec3<R>) -> [R; NUMBERS] {
    let mut state = [mu[0].constant(0.0); NUMBERS];
    for i in 0..3 {
        for j in 0..3 {
            state[3 * i + j] = g[i][j];
        }
        state[9 + i] = mu[i];
    }
    state
}
