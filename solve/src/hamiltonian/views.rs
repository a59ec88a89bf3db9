//! A body for n = 3 as the stages of a step see it from where the step begins, side by side: what changes with time at the
//! time of each stage, torques that are no potential's, and what a time of its own asks for.
//!
//! Invariant: lanes beyond the stages see what the first stage sees.

use super::driven::{Moment, Torque};
use super::term::Lanes;
use super::{Law, RigidBody};
use crate::lanes::{Row, Stages, WIDTH};
use crate::so::{Mat, Vector};
use crate::so3;
use crate::space::{Mat3, Vec3, cross, dot, minus, plus, transposed_product, vec3};
use crate::stack::Known;

/// What the stages see.
#[derive(Clone, Debug, Default)]
pub(crate) struct Views {
    /// The space vectors of the terms: first of those that do not change with time.
    spaces: Vec<Vec3<Row>>,
    /// What the strengths of the terms that change are multiplied by.
    factors: Vec<Row>,
    /// Torques that are no potential's, if there are any.
    pushes: Option<Pushes>,
}

/// Torques that are no potential's.
#[derive(Clone, Debug)]
struct Pushes {
    in_body: Vec3<Row>,
    in_space: Vec3<Row>,
    /// `-c Omega`, axis by axis.
    viscous: Vec3<f64>,
    /// `-rate mu`
    of_momentum: f64,
}

/// What the attitudes of the stages say.
pub(crate) struct Looked<R> {
    /// dH/dg of the potential, less the torques that do not depend on the motion.
    pub(crate) torque: Vec3<R>,
    /// As of [`RigidBody::torque`].
    pub(crate) nearness: R,
    /// The potential energy less its constant, `S = 1 + sum (near / d)^3` and dS/dg: of a time of its own.
    pub(crate) potential: R,
    pub(crate) sum: R,
    pub(crate) of_sum: Vec3<R>,
}

impl Views {
    /// Looks at `body` from `g0`; of a driven body at its `moments`, one a stage and that of the end.
    pub(crate) fn look(&mut self, body: &RigidBody<3>, g0: &Mat<3>, moments: &[Moment<3>]) {
        let seen = |v: &Vector<3>| -> Vec3<f64> { g0.tr_mul(v).into() };
        let Self { spaces, factors, pushes } = self;
        spaces.clear();
        factors.clear();
        for term in &body.terms {
            spaces.push(seen(&term.space).map(Row::splat));
        }
        let of_stage = |lane: usize| if lane + 1 < moments.len() { lane } else { 0 };
        for i in 0..body.driven.terms.len() {
            let mut space = [Row::splat(0.0); 3];
            let mut factor = Row::splat(0.0);
            for lane in 0..WIDTH {
                let changing = &moments[of_stage(lane)].changing[i];
                factor[lane] = changing.factor;
                for (row, x) in space.iter_mut().zip(seen(&changing.space)) {
                    row[lane] = x;
                }
            }
            spaces.push(space);
            factors.push(factor);
        }
        *pushes = (!body.driven.torques.is_empty()).then(|| {
            let zero = [Row::splat(0.0); 3];
            let (mut in_body, mut in_space) = (zero, zero);
            let (mut viscous, mut of_momentum) = ([0.0; 3], 0.0);
            for lane in 0..WIDTH {
                for torque in &moments[of_stage(lane)].torques {
                    let (rows, torque) = match torque {
                        Torque::Body(torque) => (&mut in_body, so3::vector(torque)),
                        Torque::Space(torque) => (&mut in_space, g0.tr_mul(&so3::vector(torque))),
                        _ => continue,
                    };
                    for (row, x) in rows.iter_mut().zip(torque.iter()) {
                        row[lane] += x;
                    }
                }
            }
            for torque in &moments[0].torques {
                match torque {
                    Torque::Viscous(c) => {
                        for (sum, (i, j)) in viscous.iter_mut().zip([(2, 1), (0, 2), (1, 0)]) {
                            *sum += c[(i, j)];
                        }
                    }
                    Torque::OfMomentum(rate) => of_momentum += rate,
                    _ => {}
                }
            }
            Pushes { in_body, in_space, viscous, of_momentum }
        });
    }

    /// Do torques depend on the motion?
    pub(crate) fn follows_motion(&self) -> bool {
        let moving = |pushes: &Pushes| pushes.viscous != [0.0; 3] || pushes.of_momentum != 0.0;
        self.pushes.as_ref().is_some_and(moving)
    }

    /// Looks from the attitudes U of the stages; with `near_m`, the distances of [`super::TimeScale`], also at the time.
    #[inline(always)]
    pub(crate) fn at<R: Stages<Whole = f64, Plain = Row>>(
        &self,
        body: &RigidBody<3>,
        near_m: Option<&[f64]>,
        u: &Mat3<R>,
    ) -> Looked<R> {
        let lanes = u[0][0];
        let zero = lanes.constant(0.0);
        let mut looked = Looked {
            torque: [zero; 3],
            nearness: lanes.constant(-1.0),
            potential: zero,
            sum: lanes.constant(1.0),
            of_sum: [zero; 3],
        };
        let constant = body.terms.iter().zip(&body.reaches).map(|(term, reach)| (term, *reach));
        let driven = body.driven.terms.iter().map(|driven| (&driven.term, driven.term.reach()));
        for (i, ((term, reach), space)) in constant.chain(driven).zip(&self.spaces).enumerate() {
            let v: Vec3<R> = vec3!(i => lanes.load(&space[i]));
            let q = transposed_product(u, &v);
            let in_lanes = Lanes { dimension: Known::<3>, numbers: q };
            let law = term.law.numbers();
            let slope = law.slope(&in_lanes, reach, &mut looked.nearness).numbers;
            let mut torque = cross(&slope, &q);
            if i >= body.terms.len() {
                let factor = lanes.load(&self.factors[i - body.terms.len()]);
                torque = torque.map(|x| x * factor);
            }
            looked.torque = plus(&looked.torque, &torque);
            let Some(near_m) = near_m else { continue };
            looked.potential = looked.potential + law.value(&in_lanes);
            if let Law::PointSource { body_point, .. } = &term.law {
                let (y, near) = (body_point, near_m.get(i).copied().unwrap_or(0.0));
                let y: Vec3<R> = vec3!(i => lanes.constant(y[i]));
                let arm = minus(&y, &q);
                let square = dot(&arm, &arm);
                let cube = lanes.constant(near * near * near) / (square * square.sqrt());
                looked.sum = looked.sum + cube;
                let rate = cube / square * 3.0;
                let turned = cross(&y, &q);
                looked.of_sum = vec3!(i => looked.of_sum[i] + turned[i] * rate);
            }
        }
        if let Some(Pushes { in_body, in_space, .. }) = &self.pushes {
            let space: Vec3<R> = vec3!(i => lanes.load(&in_space[i]));
            let space = transposed_product(u, &space);
            looked.torque = vec3!(i => looked.torque[i] - (lanes.load(&in_body[i]) + space[i]));
        }
        looked
    }

    /// What torques that follow the motion add to `torque`, minus a torque: `c Omega + rate mu`.
    #[inline(always)]
    pub(crate) fn resistance<R: Stages<Whole = f64, Plain = Row>>(
        &self,
        torque: &Vec3<R>,
        omega: &Vec3<R>,
        mu: &Vec3<R>,
    ) -> Vec3<R> {
        match &self.pushes {
            None => *torque,
            Some(Pushes { viscous, of_momentum, .. }) => {
                vec3!(i => torque[i] + (omega[i] * viscous[i] + mu[i] * *of_momentum))
            }
        }
    }
}

/// The wheels of a body as a vector, in kg m^2/s.
pub(crate) fn wheels(body: &RigidBody<3>) -> Option<Vec3<f64>> {
    body.wheels.as_ref().map(|wheels| so3::vector(wheels).into())
}
