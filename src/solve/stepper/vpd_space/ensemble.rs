//! Up to eight members of an ensemble side by side, one in each lane.
//!
//! A lane goes through the sweeps of [`VpdSpace`] with the same bits; its solution is taken when its own iteration has
//! converged, whatever the others still do. A member whose sweeps do not get on makes that step by itself, with
//! Newton's method where that helps. Without AVX2, and with more than four stages, which fill the lanes of one
//! member, this would gain nothing: then every member goes by itself. (Nor is anything gained by working stage by
//! stage, so that what is at work fits the registers: the arithmetic itself is the limit.)
//!
//! Invariant: each member ends with the bits, and with the failure, of its own run.

use fearless_simd::{Level, f64x8, prelude::*};

use super::VpdSpace;
use super::sweep;
use super::unknowns::{Inertia, Start, Unknowns};
use crate::solve::ensemble::Members;
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::RigidBody;
use crate::solve::lanes::{Row, Rows, WIDTH};
use crate::solve::nonlinear::{Convergence, Progress, Rungs, StopRule, Verdict};
use crate::solve::space::Vec3;
use crate::solve::stepper::Stepper;
use crate::solve::tableau::Tableau;
use crate::solve::trajectory::State;

/// Compiles the work for the instruction sets on which lanes gain, and does it on the widest.
macro_rules! in_member_lanes {
    ($level:ident, $stages:literal, $work:ident, $start:expr, $unknowns:ident) => {{
        #[cfg(target_arch = "x86_64")]
        match ($level.as_avx512(), $level.as_avx2()) {
            (Some(simd), _) => in_member_lanes!(@on simd, $stages, $work, $start, $unknowns),
            (None, Some(simd)) => in_member_lanes!(@on simd, $stages, $work, $start, $unknowns),
            (None, None) => unreachable!("members go by themselves here"),
        }
        #[cfg(not(target_arch = "x86_64"))]
        unreachable!("members go by themselves here")
    }};
    (@on $simd:ident, $stages:literal, $work:ident, $start:expr, $unknowns:ident) => {
        $simd.vectorize(
            #[inline(always)]
            || sweep::$work(Rows([f64x8::splat($simd, 0.0); $stages]), $start, $unknowns),
        )
    };
}

/// The members, and their lanes.
#[derive(Clone, Debug)]
pub struct VpdEnsemble {
    members: Vec<VpdSpace>,
    /// What each member starts from.
    blank: VpdSpace,
    stop: StopRule,
    lanes: Lanes,
    seen: Vec<Vec3<Row>>,
}

/// The unknowns of all members, for as many stages as there are rows.
#[derive(Clone, Debug)]
enum Lanes {
    Two(Box<Unknowns<[Row; 2], Row>>),
    Four(Box<Unknowns<[Row; 4], Row>>),
    /// Members go by themselves.
    None,
}

impl VpdEnsemble {
    /// Members for `tableau` that solve each step until `stop`. `None` if it has more than eight stages.
    pub fn new(tableau: &Tableau, stop: StopRule) -> Option<Self> {
        let blank = VpdSpace::new(tableau.clone(), stop)?;
        let zero = Row::splat(0.0);
        let lanes = match tableau.stages() {
            _ if stop.rungs == Rungs::Newton || !has_lanes(blank.level) => Lanes::None,
            1 | 2 => Lanes::Two(Box::new(Unknowns::blank([zero; 2], zero))),
            3 | 4 => Lanes::Four(Box::new(Unknowns::blank([zero; 4], zero))),
            _ => Lanes::None,
        };
        Some(Self { members: Vec::new(), blank, stop, lanes, seen: Vec::new() })
    }

    /// Solves the step of those whose sweeps converge, together: their solutions are with them then.
    fn swept(
        &mut self,
        body: &RigidBody<3>,
        h: f64,
        going: &[usize],
    ) -> [Option<Convergence>; WIDTH] {
        let mut solved = [None; WIDTH];
        let Self { members, blank: VpdSpace { level, lanes: tableau, .. }, stop, lanes, seen } =
            self;
        let Some(level) = *level else { return solved };
        if going.is_empty() || matches!(lanes, Lanes::None) {
            return solved;
        }
        let mut momentum = [Row::splat(0.0); 3];
        seen.clear();
        seen.resize(body.space_vectors().count(), [Row::splat(0.0); 3]);
        for lane in 0..WIDTH {
            // Lanes of nobody repeat the last that goes.
            let stepper = &mut members[going[lane.min(going.len() - 1)]];
            stepper.look(body);
            let p0 = stepper.body_momentum();
            for i in 0..3 {
                momentum[i].0[lane] = p0[i];
                for (all, one) in seen.iter_mut().zip(&stepper.seen) {
                    all[i].0[lane] = one[i];
                }
            }
        }
        let start = Start {
            tableau,
            body,
            inertia: Inertia::of(body),
            seen,
            step: h,
            passes: tableau.passes.of_sweep(false),
            momentum,
        };
        let leave = stop.rungs == Rungs::Both;
        let mut iterations = [None; WIDTH];
        iterations[..going.len()].fill(Some(Progress::new(*stop, leave)));
        let (mut sweeps, mut guesses) = (0, 0);
        macro_rules! iterate {
            ($unknowns:ident, $stages:literal) => {{
                in_member_lanes!(level, $stages, guess, &start, $unknowns);
                while iterations.iter().any(Option::is_some) {
                    let increments =
                        in_member_lanes!(level, $stages, sweep_to_row, &start, $unknowns);
                    for lane in 0..going.len() {
                        let Some(progress) = &mut iterations[lane] else { continue };
                        match progress.judged(increments.0[lane]) {
                            Ok(Verdict::GoOn) => {}
                            Ok(Verdict::Converged(convergence)) => {
                                sweeps += u64::from(convergence.iterations);
                                guesses += 1;
                                solved[lane] = Some(convergence);
                                $unknowns.hand_over(lane, &mut members[going[lane]].unknowns);
                                iterations[lane] = None;
                            }
                            Ok(Verdict::Leave) | Err(_) => iterations[lane] = None,
                        }
                    }
                }
            }};
        }
        match lanes {
            Lanes::Two(unknowns) => iterate!(unknowns, 2),
            Lanes::Four(unknowns) => iterate!(unknowns, 4),
            Lanes::None => {}
        }
        let torques = sweeps + guesses * u64::from(tableau.torques_of_guess());
        body.count(torques * self.blank.tableau.stages() as u64);
        solved
    }
}

impl Members<3> for VpdEnsemble {
    fn start(&mut self, states: &[State<3>]) {
        let Self { members, blank, .. } = self;
        members.resize_with(states.len().min(WIDTH), || blank.clone());
        for (stepper, state) in members.iter_mut().zip(states) {
            stepper.start(state);
        }
    }

    fn step(
        &mut self,
        body: &RigidBody<3>,
        h: f64,
        going: &[usize],
        results: &mut Vec<(usize, Result<Convergence, Failure>)>,
    ) {
        let solved = self.swept(body, h, going);
        for (&m, solved) in going.iter().zip(solved) {
            let stepper = &mut self.members[m];
            let result = match solved {
                Some(convergence) => stepper.accepted(body, h, convergence),
                None => stepper.step(body, h),
            };
            results.push((m, result));
        }
    }

    fn member(&self, m: usize) -> &dyn Stepper<3> {
        &self.members[m]
    }
}

/// Is this an instruction set on which members side by side gain?
fn has_lanes(level: Option<Level>) -> bool {
    #[cfg(target_arch = "x86_64")]
    return level.is_some_and(|level| level.as_avx2().is_some());
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

impl<const K: usize> Unknowns<[Row; K], Row> {
    /// Hands over to a member what its step is judged by and advanced with.
    fn hand_over(&self, lane: usize, own: &mut Unknowns<Row, f64>) {
        let stages = |rows: &[Row; K], row: &mut Row| {
            for k in 0..K {
                row[k] = rows[k][lane];
            }
        };
        let Self { attitude, excess, end, end_excess, kick, nearness, .. } = self;
        stages(&attitude.w, &mut own.attitude.w);
        for i in 0..3 {
            stages(&attitude.v[i], &mut own.attitude.v[i]);
            own.end.v[i] = end.v[i][lane];
            own.kick[i] = kick[i][lane];
        }
        for i in 0..6 {
            stages(&excess[i], &mut own.excess[i]);
            own.end_excess[i] = end_excess[i][lane];
        }
        own.end.w = end.w[lane];
        own.nearness = nearness[lane];
    }
}
