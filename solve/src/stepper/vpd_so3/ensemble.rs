//! Up to eight members of an ensemble side by side, one in each lane.
//!
//! A lane makes the sweeps of [`VpdSo3`] with the same bits. Its solution is accepted when its own
//! iteration has converged, whatever the others still do, and it holds the state of the member
//! until that is requested. A member whose sweeps do not converge makes that step individually,
//! with Newton's method where that helps. Without AVX2, and with more than four stages, which fill
//! the lanes of one member, this would gain nothing: then every member is stepped individually. So
//! are those of a body with user-defined potentials, which know no lanes. (Working stage by stage,
//! so that the data in use fit the registers, gains nothing either: the arithmetic itself is the
//! limit.)
//!
//! Invariant: each member ends with the bits, and with the failure, of its own run.

use fearless_simd::prelude::*;

use super::sweep;
use super::unknowns::{Start, Unknowns};
use super::{MotionState, VpdSo3, has_own_sum};
use crate::ensemble::Members;
use crate::failure::Failure;
use crate::hamiltonian::{CLOSEST_APPROACH, DriveInFrame, RigidBody};
use crate::lanes::extras::USER;
use crate::lanes::{Real, Row, StageScalar, StepScalar, WIDTH, has_member_lanes, in_member_lanes};
use crate::nonlinear::{Convergence, Progress, Rungs, StopRule, Verdict};
use crate::space::{Quaternion, Vec3, dot};
use crate::state::State;
use crate::stepper::motion::Motion;
use crate::stepper::so3_equations::Inertia;
use crate::stepper::{Knots, Stepper};
use crate::tableau::Tableau;

/// The members, each with its lane.
#[derive(Clone, Debug)]
pub struct VpdEnsemble {
    members: Vec<VpdSo3>,
    /// Stepper from which each member starts.
    blank: VpdSo3,
    lanes: Lanes,
    /// Whether the lane is ahead of its member, which is written only on request.
    stale: [bool; WIDTH],
    motion: Motion<Row>,
    seen: Vec<Vec3<Row>>,
    knots: Knots,
    iterations: [Progress; WIDTH],
}

/// The members side by side, for as many stages as there are rows.
#[derive(Clone, Debug)]
enum Lanes {
    One(Box<LaneState<1>>),
    Two(Box<LaneState<2>>),
    Three(Box<LaneState<3>>),
    Four(Box<LaneState<4>>),
    /// Members are stepped individually.
    None,
}

/// The unknowns that sweeps work on, and the solutions that were accepted from them.
#[derive(Clone, Debug)]
struct LaneState<const K: usize> {
    unknowns: Unknowns<[Row; K], Row>,
    accepted: Unknowns<[Row; K], Row>,
    drive_seen: DriveInFrame<[Row; K]>,
}

impl<const K: usize> LaneState<K> {
    fn blank() -> Box<Self> {
        let zero = Row::splat(0.0);
        let blank = Unknowns::blank([zero; K], zero);
        let drive_seen = DriveInFrame::nothing([zero; K]);
        Box::new(Self { unknowns: blank, accepted: blank, drive_seen })
    }
}

/// Result of a member's sweeps.
#[derive(Clone, Copy, Debug)]
enum Swept {
    /// The step is made.
    Made(Convergence),
    /// The step is solved, but has to be checked more closely.
    Doubtful(Convergence),
    /// The sweeps do not converge.
    Stuck,
}

impl VpdEnsemble {
    /// Creates members for `tableau` that solve each step until `stop`. `None` if it has more than
    /// eight stages.
    pub fn new(tableau: &Tableau, stop: StopRule) -> Option<Self> {
        let blank = VpdSo3::new(tableau.clone(), stop)?;
        let lanes = match tableau.stages() {
            _ if stop.rungs == Rungs::Newton || !has_member_lanes(blank.level) => Lanes::None,
            1 => Lanes::One(LaneState::blank()),
            2 => Lanes::Two(LaneState::blank()),
            3 => Lanes::Three(LaneState::blank()),
            4 => Lanes::Four(LaneState::blank()),
            _ => Lanes::None,
        };
        Some(Self {
            members: Vec::new(),
            blank,
            lanes,
            stale: [false; WIDTH],
            motion: Motion::blank(Row::splat(0.0), Row::splat(1.0)),
            seen: Vec::new(),
            knots: Knots::default(),
            iterations: [Progress::new(stop, stop.rungs == Rungs::Both); WIDTH],
        })
    }

    /// Makes the step of the members whose sweeps converge, together.
    fn swept(
        &mut self,
        body: &RigidBody<3>,
        begun_s: f64,
        h: f64,
        going: &[usize],
    ) -> [Swept; WIDTH] {
        let mut swept = [Swept::Stuck; WIDTH];
        let Self { members, blank, lanes, stale, motion, seen, iterations, .. } = self;
        let VpdSo3 { level: Some(level), plan, tableau, drive, .. } = blank else {
            return swept;
        };
        let extras = body.extras();
        // User-defined potentials have no lanes, and if the drive refuses a time, each member reports it.
        let refused = drive.begin(body, begun_s, h, tableau.nodes()).is_err();
        if refused || extras & USER != 0 {
            return swept;
        }
        let (sums, is_driven) = (plan.is_finished && has_own_sum(body), body.is_driven());
        let drive = &*drive;
        let inertia = Inertia::of(body);
        let passes = plan.passes.of_sweep(true);
        let (mut sweeps, mut guesses) = (0, 0);
        macro_rules! step {
            ($side:ident, $stages:literal) => {{
                let LaneState { unknowns, accepted, drive_seen } = &mut **$side;
                in_member_lanes!(level, $stages, extras, lanes => motion.space_vectors(lanes.0[0], body, seen));
                let (attitude, blank) = (motion.attitude.value, [Row::splat(0.0); $stages]);
                in_member_lanes!(level, $stages, extras, lanes => {
                    sweep::see_drive::<_, EXTRAS>(lanes, &attitude, drive, drive_seen, blank)
                });
                let momentum = motion.body_momentum.value;
                let drive_seen = &*drive_seen;
                let mut start = Start {
                    plan, body, inertia, seen, drive, drive_seen, step: h, passes, momentum
                };
                in_member_lanes!(level, $stages, extras, lanes => sweep::guess::<_, EXTRAS>(lanes, &start, unknowns));
                let mut goes_on = [false; WIDTH];
                for &m in going {
                    iterations[m].restart();
                    goes_on[m] = true;
                }
                while goes_on.contains(&true) {
                    let increments = in_member_lanes!(level, $stages, extras, lanes => {
                        sweep::sweep_to_row::<_, EXTRAS>(lanes, &start, unknowns)
                    });
                    start.passes = plan.passes.of_sweep(false);
                    for &m in going {
                        if !goes_on[m] {
                            continue;
                        }
                        match iterations[m].judged(increments[m]) {
                            Ok(Verdict::Continue) => continue,
                            Ok(Verdict::Converged(convergence)) => {
                                sweeps += u64::from(convergence.iterations);
                                guesses += 1;
                                swept[m] = Swept::Made(convergence);
                                accepted.take(m, unknowns);
                                stale[m] = true;
                            }
                            Ok(Verdict::SwitchToNewton) | Err(_) => {}
                        }
                        goes_on[m] = false;
                    }
                }
                if plan.is_finished {
                    in_member_lanes!(level, $stages, extras, lanes => sweep::finish::<_, EXTRAS>(lanes, &start, accepted));
                }
                if is_driven {
                    in_member_lanes!(level, $stages, extras, lanes => {
                        sweep::work_and_impulse::<_, EXTRAS>(lanes, &start, accepted)
                    });
                }
                let before = *motion;
                let order = tableau.ascending();
                let doubts = in_member_lanes!(level, $stages, extras, lanes => {
                    motion.advance(lanes.0[0], &accepted.end, &accepted.impulse);
                    if sums {
                        motion.add_momentum_increment(lanes.0[0], &accepted.momentum_increment);
                    } else {
                        motion.turn_momentum(lanes.0[0]);
                    }
                    doubts(lanes, order, accepted)
                });
                for lane in 0..WIDTH {
                    match swept[lane] {
                        Swept::Made(_) if doubts[lane] < 0.0 => {
                            if is_driven {
                                let before = MotionState::Full(before.member(lane));
                                let impulse = accepted.torque_impulse.map(|row| row[lane]);
                                let member = &mut members[lane];
                                let put_in =
                                    member.put_in(drive, &before, h, accepted.work[lane], &impulse);
                                member.clock.advance(h, &put_in);
                            }
                            continue;
                        }
                        Swept::Made(convergence) => swept[lane] = Swept::Doubtful(convergence),
                        _ => {}
                    }
                    motion.take(lane, &before.member(lane));
                }
            }};
        }
        match lanes {
            Lanes::One(side) => step!(side, 1),
            Lanes::Two(side) => step!(side, 2),
            Lanes::Three(side) => step!(side, 3),
            Lanes::Four(side) => step!(side, 4),
            Lanes::None => {}
        }
        let ends = u64::from(plan.torques_of_guess()) + u64::from(plan.is_finished);
        let torques = sweeps + guesses * ends;
        body.count(torques * tableau.stages() as u64);
        swept
    }

    /// Brings the lane of member `m` up to date.
    fn take_in(&mut self, m: usize) {
        if let Some(own) = self.members[m].motion() {
            self.motion.take(m, own);
        }
    }

    /// Returns member `m`, brought up to date with its lane.
    fn written(&mut self, m: usize) -> &mut VpdSo3 {
        let Self { members, lanes, stale, motion, .. } = self;
        let stepper = &mut members[m];
        if std::mem::take(&mut stale[m]) {
            stepper.state = MotionState::Full(motion.member(m));
            match lanes {
                Lanes::One(side) => side.accepted.scatter(m, &mut stepper.unknowns),
                Lanes::Two(side) => side.accepted.scatter(m, &mut stepper.unknowns),
                Lanes::Three(side) => side.accepted.scatter(m, &mut stepper.unknowns),
                Lanes::Four(side) => side.accepted.scatter(m, &mut stepper.unknowns),
                Lanes::None => {}
            }
        }
        stepper
    }
}

/// Returns a number below zero where the quick tests of [`VpdSo3::check`] find nothing:
/// Gershgorin's discs, the turns from stage to stage in the order of their times, and the
/// distances. NaN where the solution is not finite.
#[inline(always)]
fn doubts<R: StageScalar<StepScalar: StepScalar<Storage = Row>>>(
    lanes: R,
    ascending: &[usize],
    solution: &Unknowns<R::Storage, Row>,
) -> Row {
    let Unknowns { attitude, stretch, end, end_stretch, proximity, .. } = solution;
    let whole = lanes.stage(0);
    let proximity = whole.load(proximity);
    let mut doubt = proximity + CLOSEST_APPROACH * CLOSEST_APPROACH;
    let mut total = proximity;
    let mut before = Quaternion { w: whole.constant(1.0), v: [whole.constant(0.0); 3] };
    for k in 0..=ascending.len() {
        let (mut e, mut turn) = ([whole; 6], before);
        if k < ascending.len() {
            let k = ascending[k];
            for i in 0..6 {
                e[i] = lanes.load(&stretch[i]).stage(k);
            }
            turn.w = lanes.load(&attitude.w).stage(k);
            for i in 0..3 {
                turn.v[i] = lanes.load(&attitude.v[i]).stage(k);
            }
        } else {
            for i in 0..6 {
                e[i] = whole.load(&end_stretch[i]);
            }
            turn.w = whole.load(&end.w);
            for i in 0..3 {
                turn.v[i] = whole.load(&end.v[i]);
            }
        }
        let [xx, yy, zz, yz, xz, xy] = e;
        let [yz, xz, xy] = [yz.abs(), xz.abs(), xy.abs()];
        for norm_error in [(xy + xz) - xx, (xy + yz) - yy, (xz + yz) - zz] {
            doubt = doubt.max_or_nan(norm_error + -0.5);
            total = total + norm_error;
        }
        let cosine = before.w * turn.w + dot(&before.v, &turn.v);
        doubt = doubt.max_or_nan(cosine * cosine * -4.0 + 2.0);
        total = total + cosine;
        before = turn;
    }
    let mut doubts = Row::splat(0.0);
    (doubt + total * 0.0).store(&mut doubts);
    doubts
}

impl Members<3> for VpdEnsemble {
    fn start(&mut self, states: &[State<3>]) {
        let Self { members, blank, stale, motion, knots, .. } = self;
        *knots = Knots::default();
        members.resize_with(states.len().min(WIDTH), || blank.clone());
        for (stepper, state) in members.iter_mut().zip(states) {
            stepper.start(state);
        }
        *stale = [false; WIDTH];
        // Unused lanes repeat the others.
        for (lane, own) in members.iter().filter_map(VpdSo3::motion).cycle().take(WIDTH).enumerate()
        {
            motion.take(lane, own);
        }
    }

    fn step(
        &mut self,
        body: &RigidBody<3>,
        begun_s: f64,
        h: f64,
        going: &[usize],
        stepped: &mut dyn FnMut(usize, Result<Convergence, Failure>),
    ) {
        self.members.iter_mut().for_each(|member| member.set_time(begun_s));
        let before = self.knots;
        let in_parts = self.knots.lie_in(body, begun_s, h);
        if matches!(self.lanes, Lanes::None) || in_parts {
            for &m in going {
                let mut knots = before;
                stepped(m, knots.step(body, self.written(m), begun_s, h));
                self.knots = knots;
                self.take_in(m);
            }
            return;
        }
        let swept = self.swept(body, begun_s, h, going);
        for &m in going {
            if let Swept::Made(convergence) = swept[m] {
                stepped(m, Ok(convergence));
                continue;
            }
            let stepper = self.written(m);
            let result = if let Swept::Doubtful(convergence) = swept[m] {
                let updated = stepper.update_space_vectors(body, h);
                let made = updated.and_then(|()| stepper.accepted(body, h, convergence));
                stepper.or_in_matrices(body, h, made)
            } else {
                stepper.step(body, h)
            };
            self.take_in(m);
            stepped(m, result);
        }
    }

    fn member(&mut self, m: usize) -> &mut dyn Stepper<3> {
        self.written(m)
    }
}

impl<const K: usize> Unknowns<[Row; K], Row> {
    /// Takes from `solved` the values by which the step of a member is judged and made.
    fn take(&mut self, lane: usize, solved: &Self) {
        let stages = |rows: &mut [Row; K], from: &[Row; K]| {
            for k in 0..K {
                rows[k][lane] = from[k][lane];
            }
        };
        let Self {
            attitude,
            momentum,
            x,
            inverse,
            stretch,
            end,
            end_stretch,
            impulse,
            proximity,
            ..
        } = self;
        stages(&mut attitude.w, &solved.attitude.w);
        for i in 0..3 {
            stages(&mut attitude.v[i], &solved.attitude.v[i]);
            stages(&mut momentum[i], &solved.momentum[i]);
            stages(&mut x[i], &solved.x[i]);
            end.v[i][lane] = solved.end.v[i][lane];
            impulse[i][lane] = solved.impulse[i][lane];
        }
        for i in 0..6 {
            stages(&mut inverse[i], &solved.inverse[i]);
            stages(&mut stretch[i], &solved.stretch[i]);
            end_stretch[i][lane] = solved.end_stretch[i][lane];
        }
        end.w[lane] = solved.end.w[lane];
        proximity[lane] = solved.proximity[lane];
    }

    /// Hands the values of a lane over to its member.
    fn scatter(&self, lane: usize, own: &mut Unknowns<Row, f64>) {
        let stages = |rows: &[Row; K], row: &mut Row| {
            for k in 0..K {
                row[k] = rows[k][lane];
            }
        };
        let Self { attitude, stretch, end, end_stretch, impulse, proximity, .. } = self;
        own.work = self.work[lane];
        own.torque_impulse = self.torque_impulse.map(|row| row[lane]);
        stages(&attitude.w, &mut own.attitude.w);
        for i in 0..3 {
            stages(&attitude.v[i], &mut own.attitude.v[i]);
            own.end.v[i] = end.v[i][lane];
            own.impulse[i] = impulse[i][lane];
        }
        for i in 0..6 {
            stages(&stretch[i], &mut own.stretch[i]);
            own.end_stretch[i] = end_stretch[i][lane];
        }
        own.end.w = end.w[lane];
        own.proximity = proximity[lane];
    }
}
