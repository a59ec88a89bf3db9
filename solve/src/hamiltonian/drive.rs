//! What drives a body of three dimensions during a step: its driven terms and its torques at the stages, side by side in
//! lanes.
//!
//! Space vectors and strengths follow from the times of the stages alone, so they are computed once a step, in space
//! coordinates, and once for all members of an ensemble. The torques that are no potential's add up to
//!
//! ```text
//! F_tau = a + U^T b - c Omega - r mu + sum of the faces in streams
//! ```
//!
//! with a constant in the body, b constant in space, c a coefficient for each axis of the body.
//!
//! Invariant: the same motion and the same input as [`super::driven::BodyAtTime`] gives, up to rounding.

use super::RigidBody;
use super::driven::{Driving, Torque};
use super::term::Lanes;
use crate::failure::Failure;
use crate::lanes::{Row, StageScalar, WIDTH};
use crate::so::{self, Mat};
use crate::so3;
use crate::space::{
    Mat3, Vec3, cross, dot, mat3, minus, plus, product, scaled, transposed_product, vec3,
};
use crate::stack::Known;
use crate::time::Time;

/// The drive during a step; empty for a body that is not driven.
#[derive(Clone, Debug)]
pub(crate) struct Drive {
    terms: Vec<TermAtStages>,
    push: Option<PushAtStages>,
    /// Streams on faces, in the order of these among the torques.
    streams: Vec<StreamAtStages>,
    /// Momentum of wheels relative to the body.
    pub(crate) wheels: WheelsAtStages,
}

/// The momentum of wheels relative to the body, in body coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WheelsAtStages {
    /// Where the step begins.
    pub(crate) at_start: Vec3<f64>,
    pub(crate) at_stages: Vec3<Row>,
    /// Its rate, by motors.
    rate: Option<Vec3<f64>>,
}

impl Default for Drive {
    fn default() -> Self {
        let wheels =
            WheelsAtStages { at_start: [0.0; 3], at_stages: [Row::splat(0.0); 3], rate: None };
        Self { terms: Vec::new(), push: None, streams: Vec::new(), wheels }
    }
}

/// A driven term at the stages, in space coordinates.
#[derive(Clone, Copy, Debug)]
struct TermAtStages {
    space: Vec3<Row>,
    /// The rate of `space`.
    moving: Vec3<Row>,
    /// Factor on the strength of the law.
    factor: Row,
    /// The rate of `factor`.
    strengthening: Row,
    /// [`super::Law::inverse_arm_squared`]; one for a law that is nowhere singular.
    inverse_arm_squared: Row,
}

/// The torques that are no potential's.
#[derive(Clone, Copy, Debug)]
struct PushAtStages {
    /// a
    body: Vec3<Row>,
    /// b, in space coordinates.
    space: Vec3<Row>,
    /// c
    viscous: Vec3<f64>,
    /// r
    of_momentum: f64,
    /// Strengths of the torques by tables, added up.
    tables: Row,
}

/// A stream on faces.
#[derive(Clone, Copy, Debug)]
struct StreamAtStages {
    /// Where it comes from, in space coordinates.
    space: Vec3<Row>,
    /// Factor on the forces.
    factor: Row,
}

/// Vectors of a drive at the stages, as seen from where a step begins.
#[derive(Clone, Debug)]
pub(crate) struct DriveInFrame<S> {
    /// Space vectors of the terms.
    vectors: Vec<Vec3<S>>,
    /// Their rates.
    moving: Vec<Vec3<S>>,
    /// b, the torque that is constant in space.
    push: Vec3<S>,
    /// Where streams come from.
    streams: Vec<Vec3<S>>,
}

impl<S: Copy> DriveInFrame<S> {
    /// Nothing; `blank` is anything.
    pub(crate) fn nothing(blank: S) -> Self {
        Self { vectors: Vec::new(), moving: Vec::new(), push: [blank; 3], streams: Vec::new() }
    }

    /// Brings the vectors of `drive` up to the attitude `g`; `blank` is anything.
    #[inline(always)]
    pub(crate) fn update<R: StageScalar<Storage = S>>(
        &mut self,
        lanes: R,
        g: &Mat3<R::StepScalar>,
        drive: &Drive,
        blank: S,
    ) {
        let turn: Mat3<R> = mat3!(i, j => lanes.spread(g[i][j]));
        let Self { vectors, moving, push, streams } = self;
        vectors.clear();
        moving.clear();
        streams.clear();
        for term in &drive.terms {
            vectors.push(seen(&turn, &term.space, blank));
            moving.push(seen(&turn, &term.moving, blank));
        }
        if let Some(torques) = &drive.push {
            *push = seen(&turn, &torques.space, blank);
        }
        for stream in &drive.streams {
            streams.push(seen(&turn, &stream.space, blank));
        }
    }
}

/// `G^T v` at the stages for a vector of space at each.
#[inline(always)]
fn seen<R: StageScalar>(turn: &Mat3<R>, v: &Vec3<Row>, blank: R::Storage) -> Vec3<R::Storage> {
    let lanes = turn[0][0];
    let v = transposed_product(turn, &vec3!(i => lanes.row(&v[i])));
    let mut plain = [blank; 3];
    for i in 0..3 {
        v[i].store(&mut plain[i]);
    }
    plain
}

impl Drive {
    /// Brings the drive of `body` to the step of length `h` that begins at the time `begun`, with stages at the nodes c.
    ///
    /// # Errors
    /// [`crate::failure::FailureCode::OutsideTable`], [`crate::failure::FailureCode::OpenOrbit`], with the stage.
    pub(crate) fn begin(
        &mut self,
        body: &RigidBody<3>,
        begun: f64,
        h: f64,
        nodes: &[f64],
    ) -> Result<(), Failure> {
        self.terms.clear();
        self.streams.clear();
        self.push = None;
        let times = |k: usize| Time::in_step(begun, h, nodes[k] * h);
        // Lanes without a stage repeat the last one.
        let stage = |lane: usize| lane.min(nodes.len() - 1);
        let vector = |wheels: Option<Mat<3>>| -> Vec3<f64> {
            wheels.map_or([0.0; 3], |wheels| so3::vee(&wheels).into())
        };
        let spin = body.driven.spin.as_ref();
        self.wheels.at_start = vector(body.wheels_at(Time::in_step(begun, h, 0.0)));
        self.wheels.rate = spin.map(|spin| so3::vee(&spin.rate).into());
        for lane in 0..WIDTH {
            let wheels = match spin {
                Some(_) => vector(body.wheels_at(times(stage(lane)))),
                None => self.wheels.at_start,
            };
            (0..3).for_each(|i| self.wheels.at_stages[i][lane] = wheels[i]);
        }
        if !body.is_driven() {
            return Ok(());
        }
        for k in 0..nodes.len() {
            let at_stage = |failure| Failure { stage: Some(k), ..failure };
            body.driven.check(times(k)).map_err(at_stage)?;
        }
        for driven in &body.driven.terms {
            let zero = Row::splat(0.0);
            let mut term = TermAtStages {
                space: [zero; 3],
                moving: [zero; 3],
                factor: zero,
                strengthening: zero,
                inverse_arm_squared: zero,
            };
            for lane in 0..WIDTH {
                if stage(lane) < lane {
                    term.copy(stage(lane), lane);
                    continue;
                }
                let Driving { strength, strengthening, space, moving } =
                    driven.driving(times(lane));
                for i in 0..3 {
                    term.space[i][lane] = space[i];
                    term.moving[i][lane] = moving[i];
                }
                (term.factor[lane], term.strengthening[lane]) = (strength, strengthening);
                let inverse = driven.term.law.inverse_arm_squared(&space);
                term.inverse_arm_squared[lane] = if inverse > 0.0 { inverse } else { 1.0 };
            }
            self.terms.push(term);
        }
        if !body.driven.torques.is_empty() {
            self.push = Some(PushAtStages::of(&body.driven.torques, |lane| times(stage(lane))));
        }
        for faces in body.driven.faces() {
            let mut stream =
                StreamAtStages { space: [Row::splat(0.0); 3], factor: Row::splat(0.0) };
            for lane in 0..WIDTH {
                let (space, factor) = faces.driving(times(stage(lane)));
                (0..3).for_each(|i| stream.space[i][lane] = space[i]);
                stream.factor[lane] = factor;
            }
            self.streams.push(stream);
        }
        Ok(())
    }

    /// Do torques act that are no potential's?
    pub(crate) fn pushes(&self) -> bool {
        self.push.is_some()
    }

    /// `sum_k b_k` times the strengths of the torques by tables.
    pub(crate) fn tables(&self, weights: &Row) -> f64 {
        let Some(push) = &self.push else { return 0.0 };
        weights.0.iter().zip(&push.tables.0).map(|(weight, strength)| weight * strength).sum()
    }
}

impl TermAtStages {
    fn copy(&mut self, from: usize, to: usize) {
        let Self { space, moving, factor, strengthening, inverse_arm_squared } = self;
        for row in
            space.iter_mut().chain(moving).chain([factor, strengthening, inverse_arm_squared])
        {
            row[to] = row[from];
        }
    }
}

impl PushAtStages {
    fn of(torques: &[Torque<3>], time: impl Fn(usize) -> Time) -> Self {
        let zero = Row::splat(0.0);
        let mut push = Self {
            body: [zero; 3],
            space: [zero; 3],
            viscous: [0.0; 3],
            of_momentum: 0.0,
            tables: zero,
        };
        let add = |sum: &mut Vec3<Row>, torque: &Mat<3>, strength: &Row| {
            let torque = so3::vee(torque);
            for (row, torque) in sum.iter_mut().zip(&torque) {
                row.0.iter_mut().zip(&strength.0).for_each(|(sum, s)| *sum += torque * s);
            }
        };
        for torque in torques {
            match torque {
                Torque::Body(torque) => add(&mut push.body, torque, &Row::splat(1.0)),
                Torque::Space(torque) => add(&mut push.space, torque, &Row::splat(1.0)),
                Torque::Table { along, spatial, table } => {
                    let mut strength = zero;
                    for lane in 0..WIDTH {
                        strength[lane] = table.at(time(lane)).0[0];
                    }
                    let size = so::inner(along, along).sqrt();
                    push.tables.0.iter_mut().zip(&strength.0).for_each(|(sum, s)| *sum += size * s);
                    add(if *spatial { &mut push.space } else { &mut push.body }, along, &strength);
                }
                Torque::Viscous(coefficients) => {
                    let of_axis = [(2, 1), (0, 2), (1, 0)].map(|plane| coefficients[plane]);
                    push.viscous = plus(&push.viscous, &of_axis);
                }
                Torque::OfMomentum(rate) => push.of_momentum += rate,
                // At the stages: [`Drive::streams`].
                Torque::Faces(_) => {}
            }
        }
        push
    }
}

impl RigidBody<3> {
    /// Adds the torque of what drives the body, `vee(dH/dg - F_tau)` at `g = g0 U`, to that of its terms and their proximity
    /// ([`RigidBody::torque`]), given the body momentum and the velocity at the stages.
    #[inline(always)]
    pub(crate) fn driven_torque<R: StageScalar>(
        &self,
        u: &Mat3<R>,
        motion: [&Vec3<R>; 2],
        drive: &Drive,
        seen: &DriveInFrame<R::Storage>,
        (mut torque, mut proximity): (Vec3<R>, R),
    ) -> (Vec3<R>, R) {
        let lanes = u[0][0];
        for ((term, driven), v) in drive.terms.iter().zip(&self.driven.terms).zip(&seen.vectors) {
            let q = transposed_product(u, &vec3!(i => lanes.load(&v[i])));
            let q = Lanes { dimension: Known::<3>, numbers: q };
            let mut near = lanes.constant(-f64::MAX);
            let slope = driven.term.law.numbers().slope(&q, 1.0, &mut near);
            let part = scaled(&cross(&slope.numbers, &q.numbers), lanes.row(&term.factor));
            torque = plus(&torque, &part);
            proximity = proximity.max_or_nan(near * lanes.row(&term.inverse_arm_squared));
        }
        if let Some(push) = &drive.push {
            torque = minus(&torque, &push.torque(u, motion, &seen.push));
        }
        if !drive.streams.is_empty() {
            torque = minus(&torque, &self.torque_of_faces(u, drive, seen));
        }
        (torque, proximity)
    }

    /// The torque of streams on faces at the stages.
    #[inline(always)]
    fn torque_of_faces<R: StageScalar>(
        &self,
        u: &Mat3<R>,
        drive: &Drive,
        seen: &DriveInFrame<R::Storage>,
    ) -> Vec3<R> {
        let lanes = u[0][0];
        let mut sum = [lanes.constant(0.0); 3];
        for ((faces, stream), v) in self.driven.faces().zip(&drive.streams).zip(&seen.streams) {
            let q = transposed_product(u, &vec3!(i => lanes.load(&v[i])));
            let mut torque = [lanes.constant(0.0); 3];
            for face in &faces.faces {
                face.add_torque(&q, &mut torque);
            }
            sum = plus(&sum, &scaled(&torque, lanes.row(&stream.factor)));
        }
        sum
    }

    /// What time and torques put in during a step: at the stages `dH/dt + <F, Omega>` to the energy and `U F` to the
    /// momentum in the frame of g0, times `weight`; given the body momentum and the velocity there.
    #[inline(always)]
    pub(crate) fn work_and_impulse<R: StageScalar>(
        &self,
        u: &Mat3<R>,
        [mu, omega]: [&Vec3<R>; 2],
        weight: R,
        drive: &Drive,
        seen: &DriveInFrame<R::Storage>,
    ) -> (R::StepScalar, Vec3<R::StepScalar>) {
        let lanes = weight;
        let mut power = lanes.constant(0.0);
        let vectors = seen.vectors.iter().zip(&seen.moving);
        for ((term, driven), (v, moving)) in drive.terms.iter().zip(&self.driven.terms).zip(vectors)
        {
            let q = transposed_product(u, &vec3!(i => lanes.load(&v[i])));
            let rate = transposed_product(u, &vec3!(i => lanes.load(&moving[i])));
            let q = Lanes { dimension: Known::<3>, numbers: q };
            let rate = Lanes { dimension: Known::<3>, numbers: rate };
            let law = driven.term.law.numbers();
            let part = lanes.row(&term.strengthening) * law.value(&q)
                + lanes.row(&term.factor) * law.change(&q, &rate);
            power = power + part;
        }
        if let Some(rate) = &drive.wheels.rate {
            power = power - (omega[0] * rate[0] + omega[1] * rate[1] + omega[2] * rate[2]);
        }
        let mut impulse = [lanes.constant(0.0); 3];
        if let Some(push) = &drive.push {
            let mut torque = push.torque(u, [mu, omega], &seen.push);
            if !drive.streams.is_empty() {
                torque = plus(&torque, &self.torque_of_faces(u, drive, seen));
            }
            power = power + dot(&torque, omega);
            impulse = product(u, &torque);
        }
        ((power * weight).sum(), vec3!(i => (impulse[i] * weight).sum()))
    }
}

impl PushAtStages {
    /// F_tau at the stages, given b as it is seen from g0.
    #[inline(always)]
    fn torque<R: StageScalar>(
        &self,
        u: &Mat3<R>,
        [mu, omega]: [&Vec3<R>; 2],
        space: &Vec3<R::Storage>,
    ) -> Vec3<R> {
        let lanes = u[0][0];
        let turned = transposed_product(u, &vec3!(i => lanes.load(&space[i])));
        vec3!(i => (lanes.row(&self.body[i]) + turned[i])
            - (omega[i] * self.viscous[i] + mu[i] * self.of_momentum))
    }
}
