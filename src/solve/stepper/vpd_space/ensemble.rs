//! Up to eight members of an ensemble side by side, one in each lane.
//!
//! A lane goes through the sweeps of [`VpdSpace`] with the same bits; its solution is taken when its own iteration has
//! converged, whatever the others still do. A member whose sweeps do not get on makes that step by itself, with
//! Newton's method where that helps. Without AVX2, and with more than four stages, which fill the lanes of one
//! member, this would gain nothing: then every member goes by itself.
//!
//! Invariant: each member ends with the bits, and with the failure, of its own run.

use fearless_simd::{Level, f64x8, prelude::*};

use super::sweep::{self, Start, Unknowns};
use super::{Carried, VpdSpace, symmetric};
use crate::solve::failure::Failure;
use crate::solve::hamiltonian::RigidBody;
use crate::solve::lanes::{Row, Rows, WIDTH};
use crate::solve::nonlinear::{Convergence, Progress, Rungs, StopRule, Verdict};
use crate::solve::so::Mat;
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

/// The members, and one stepper that knows the way.
#[derive(Clone, Debug)]
pub struct VpdEnsemble {
    stepper: VpdSpace,
    stop: StopRule,
    members: Vec<Carried>,
    lanes: Lanes,
    seen: Vec<Vec3<Row>>,
    /// The solution of each member, as it would hold it by itself.
    solutions: Vec<Unknowns<Row, f64>>,
    results: Vec<Result<Convergence, Failure>>,
}

/// The unknowns of all members, for as many stages as there are rows.
#[derive(Clone, Debug)]
enum Lanes {
    Two(Box<Unknowns<[Row; 2], Row>>),
    Four(Box<Unknowns<[Row; 4], Row>>),
    /// The stages of one member fill the lanes: members go by themselves.
    Stages,
}

impl VpdEnsemble {
    /// Members for `tableau` that solve each step until `stop`. `None` if it has more than eight stages.
    pub fn new(tableau: &Tableau, stop: StopRule) -> Option<Self> {
        let stepper = VpdSpace::new(tableau.clone(), stop, true)?;
        let zero = Row::splat(0.0);
        let lanes = match tableau.stages() {
            1 | 2 => Lanes::Two(Box::new(Unknowns::blank([zero; 2], zero))),
            3 | 4 => Lanes::Four(Box::new(Unknowns::blank([zero; 4], zero))),
            _ => Lanes::Stages,
        };
        Some(Self {
            solutions: vec![stepper.unknowns; WIDTH],
            stepper,
            stop,
            members: Vec::new(),
            lanes,
            seen: Vec::new(),
            results: Vec::new(),
        })
    }

    /// Takes up the members, at most [`WIDTH`] of them.
    pub fn start(&mut self, states: impl IntoIterator<Item = State<3>>) {
        self.members.clear();
        for state in states.into_iter().take(WIDTH) {
            self.stepper.start(&state);
            self.members.push(self.stepper.state);
        }
    }

    /// Carries the members forward by `h`; one that fails stays where it was.
    pub fn step(&mut self, body: &RigidBody<3>, h: f64) -> &[Result<Convergence, Failure>] {
        let solved = self.swept(body, h);
        let Self { stepper, members, solutions, results, .. } = self;
        results.clear();
        for ((member, solution), solved) in members.iter_mut().zip(solutions).zip(solved) {
            stepper.state = *member;
            results.push(match solved {
                Some(convergence) => {
                    stepper.unknowns = *solution;
                    stepper.look(body);
                    stepper.accepted(body, h, convergence)
                }
                None => stepper.step(body, h),
            });
            *member = stepper.state;
        }
        results
    }

    /// Member `m` as it is.
    pub fn state(&mut self, m: usize) -> State<3> {
        self.stepper.state = self.members[m];
        let attitude = self.stepper.attitude().unwrap_or_else(Mat::identity);
        State { attitude, momentum: self.stepper.momentum() }
    }

    /// Which members' sweeps converge; their solutions are in `self.solutions`.
    fn swept(&mut self, body: &RigidBody<3>, h: f64) -> [Option<Convergence>; WIDTH] {
        let mut solved = [None; WIDTH];
        let level = self.stepper.level;
        if self.stop.rungs == Rungs::Newton
            || self.members.is_empty()
            || !has_lanes(level)
            || matches!(self.lanes, Lanes::Stages)
        {
            return solved;
        }
        // Lanes without a member repeat the last.
        let mut momentum = [Row::splat(0.0); 3];
        self.seen.clear();
        self.seen.resize(body.space_vectors().count(), [Row::splat(0.0); 3]);
        for lane in 0..WIDTH {
            self.stepper.state = self.members[lane.min(self.members.len() - 1)];
            self.stepper.look(body);
            let p0 = self.stepper.body_momentum();
            for i in 0..3 {
                momentum[i].0[lane] = p0[i];
                for (all, one) in self.seen.iter_mut().zip(&self.stepper.seen) {
                    all[i].0[lane] = one[i];
                }
            }
        }
        let start = Start {
            tableau: &self.stepper.lanes,
            body,
            inverse_inertia: symmetric(&body.inverse_inertia()),
            seen: &self.seen,
            step: h,
            momentum,
        };
        let leave = self.stop.rungs == Rungs::Both;
        let mut iterations = [Some(Progress::new(self.stop, leave)); WIDTH];
        let solutions = &mut self.solutions;
        macro_rules! iterate {
            ($unknowns:ident, $stages:literal) => {{
                in_member_lanes!(level, $stages, guess, &start, $unknowns);
                while iterations.iter().any(Option::is_some) {
                    let increments =
                        in_member_lanes!(level, $stages, sweep_to_row, &start, $unknowns);
                    for lane in 0..WIDTH {
                        let Some(progress) = &mut iterations[lane] else { continue };
                        match progress.judged(increments.0[lane]) {
                            Ok(Verdict::GoOn) => {}
                            Ok(Verdict::Converged(convergence)) => {
                                solved[lane] = Some(convergence);
                                solutions[lane] = $unknowns.lane(lane);
                                iterations[lane] = None;
                            }
                            Ok(Verdict::Leave) | Err(_) => iterations[lane] = None,
                        }
                    }
                }
            }};
        }
        match &mut self.lanes {
            Lanes::Two(unknowns) => iterate!(unknowns, 2),
            Lanes::Four(unknowns) => iterate!(unknowns, 4),
            Lanes::Stages => return solved,
        }
        let own = solved.iter().take(self.members.len()).flatten();
        let evaluations: u64 = own.map(|solved| u64::from(solved.iterations) + 1).sum();
        body.count(evaluations * self.stepper.tableau.stages() as u64);
        solved
    }
}

/// Has the machine an instruction set on which members side by side gain?
fn has_lanes(level: Level) -> bool {
    #[cfg(target_arch = "x86_64")]
    return level.as_avx2().is_some();
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

impl<const K: usize> Unknowns<[Row; K], Row> {
    /// The unknowns of one member, as it would hold them by itself.
    fn lane(&self, lane: usize) -> Unknowns<Row, f64> {
        let stages = |rows: &[Row; K]| {
            let mut row = Row::splat(0.0);
            for k in 0..K {
                row.0[k] = rows[k].0[lane];
            }
            row
        };
        let whole = |row: &Row| row.0[lane];
        self.mapped(stages, whole)
    }
}
