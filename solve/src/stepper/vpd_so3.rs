//! VPD in Hamiltonian form for n = 3 with up to eight stages: the map of [`super::vpd`] and
//! [`super::vpd_reduced`], computed in vectors and quaternions with the stages side by side in SIMD lanes.
//!
//! The state is the attitude as a unit quaternion and the momentum, spatial and in the body. A step
//! adds to each an increment that is small relative to it: `q1 = q0 + q0 (f - 1)`, the impulse of
//! the torques, and the gain of the body momentum. What rounding removes from a sum is carried to
//! the next step, so that rounding causes a random walk and no drift (Brouwer's law; Hairer,
//! McLachlan, Razakarivony 2008, BIT 48). Only torques change the spatial momentum. The body
//! momentum is `g^T pi`; but many stages are used for the last digits, and with torques that
//! product is too inaccurate for the small momentum about a thin axis, so the body momentum then
//! has a sum of its own.
//!
//! Invariant: the same bits on every instruction set; no sine, cosine or exponential; |q| = 1 to round-off.

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use super::checks::{check_continuity, check_root, check_singular_value};
use super::galerkin;
use super::motion::{Motion, unsigned_zeros};
use super::so3_equations::Inertia;
use super::{Clock, Stepper};
use crate::compensated::Sum;
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::{CLOSEST_APPROACH, Drive, DriveInFrame, RigidBody, WorkAndImpulse};
use crate::lanes::{Row, Rows, extras, in_eight_stage_lanes, in_stage_lanes, widest};
use crate::nonlinear::{
    Continued, Convergence, Equations, Rung, Rungs, SMALLEST_SIZE, Solver, StepHistory, StopRule,
};
use crate::so::{self, Mat, Vector};
use crate::so3;
use crate::space::{Quaternion, Sym3, Vec3, dot, product, scaled, transposed_product, vec3};
use crate::state::State;
use crate::system::System;
use crate::tableau::Tableau;

mod body_frame;
pub mod ensemble;
pub(super) mod sweep;
pub(super) mod unknowns;

use unknowns::{FEW_STAGES, Passes, Start, SweepPlan, Unknowns};

/// Turn of a step below which a free body takes half as many passes.
const CALM_RAD: f64 = 0.05;

/// Does the work in lanes, and counts its torques.
macro_rules! counted {
    ($work:ident, $equations:expr) => {{
        let InLanes { level, stages, start, unknowns, torques, .. } = $equations;
        *torques += *stages as u64;
        in_stage_lanes!(*level, *stages, start.body, sweep::$work also DRIVEN, start, unknowns)
    }};
}

/// The stepper: the tableau in lanes, the state, and the unknowns of the last step.
#[derive(Clone, Debug)]
pub struct VpdSo3 {
    tableau: Tableau,
    plan: SweepPlan,
    solver: Solver,
    /// The preceding steps, if the next one is guessed from them.
    history: Option<StepHistory>,
    /// The instruction set; without one, one number at a time.
    level: Option<Level>,
    state: MotionState,
    unknowns: Unknowns<Row, f64>,
    clock: Clock<3>,
    /// The space vectors of the potential, as seen from the beginning of the step.
    seen: Vec<Vec3<f64>>,
    drive: Drive,
    drive_seen: DriveInFrame<Row>,
    /// The same step in matrices, made where it was needed.
    matrices: Option<Box<galerkin::StepperState<3>>>,
    /// Was the last step solved there?
    by_matrices: bool,
}

/// State carried from step to step.
#[derive(Clone, Copy, Debug)]
enum MotionState {
    /// Attitude and momentum.
    Full(Motion<f64>),
    /// Only the body momentum of a free body (Lie-Poisson): nothing depends on the attitude. Its
    /// square labels the coadjoint orbit.
    Reduced { momentum: Sum<[f64; 3]>, square: f64 },
}

impl VpdSo3 {
    /// Creates a stepper for `tableau` that solves each step until `stop`. `None` if the tableau
    /// has more stages than there are lanes.
    pub fn new(tableau: Tableau, stop: StopRule) -> Option<Self> {
        // Many stages are used for the last digits.
        let stop = StopRule { stop_early: tableau.stages() <= FEW_STAGES, ..stop };
        Some(Self {
            plan: SweepPlan::new(&tableau)?,
            tableau,
            solver: Solver::new(stop),
            history: None,
            level: Some(Level::new()),
            state: MotionState::Full(Motion::blank(0.0, 1.0)),
            unknowns: Unknowns::blank(Row::splat(0.0), 0.0),
            clock: Clock::default(),
            seen: Vec::new(),
            drive: Drive::default(),
            drive_seen: DriveInFrame::nothing(Row::splat(0.0)),
            matrices: None,
            by_matrices: false,
        })
    }

    /// Restricts the stepper to free bodies, whose momentum evolves on its own: it carries an
    /// attitude only if `with_attitude`, and guesses a step from the preceding ones.
    pub fn reduced(self, with_attitude: bool) -> Self {
        let state = if with_attitude {
            self.state
        } else {
            MotionState::Reduced { momentum: Sum::new([0.0; 3], [0.0; 3]), square: 0.0 }
        };
        // With many stages the guess is better without the preceding steps.
        let history = (self.tableau.stages() <= FEW_STAGES).then(StepHistory::default);
        Self { history, state, ..self }
    }

    /// Returns the stepper on an older instruction set, or without lanes: a test compares the bits,
    /// a benchmark the time.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { level, ..self }
    }

    /// Returns E of stage `k`, or of the end point after the last stage.
    fn stretch(&self, k: usize) -> Sym3<f64> {
        let stretch = if k < self.tableau.stages() {
            self.unknowns.stretch.each_ref().map(|row| row[k])
        } else {
            self.unknowns.end_stretch
        };
        unsigned_zeros(stretch)
    }

    /// Returns U_k, or f after the last stage.
    fn rotation(&self, k: usize) -> Quaternion<f64> {
        if k < self.tableau.stages() {
            let Quaternion { w, v } = &self.unknowns.attitude;
            Quaternion { w: w.0[k], v: vec3!(i => v[i].0[k]) }
        } else {
            self.unknowns.end
        }
    }

    /// Refuses a solution whose polar factors are ill-conditioned or jump, or at which the potential is singular.
    fn check(&self, body: &RigidBody<3>, h: f64) -> Result<(), Failure> {
        let stages = self.tableau.stages();
        let stage = |k: usize| (k < stages).then_some(k);
        for k in 0..=stages {
            let [xx, yy, zz, yz, xz, xy] = self.stretch(k);
            // Gershgorin's discs decide nearly always.
            let [yz_, xz_, xy_] = [yz.abs(), xz.abs(), xy.abs()];
            let bound = (xx - xy_ - xz_).min(yy - xy_ - yz_).min(zz - xz_ - yz_);
            if !(bound >= -0.5) {
                check_singular_value(smallest_singular_value(&self.stretch(k)), stage(k))?;
            }
        }
        let ascending = self.tableau.ascending().iter().copied();
        let nodes = ascending.chain([stages]).map(|k| (stage(k), self.rotation(k)));
        // tr(U^T V) = 4 (p . q)^2 - 1, which is 1 for a quarter turn.
        let trace = |p: &Quaternion<f64>, q: &Quaternion<f64>| {
            let cosine = p.w * q.w + dot(&p.v, &q.v);
            4.0 * cosine * cosine - 1.0
        };
        check_continuity(Quaternion { w: 1.0, v: [0.0; 3] }, nodes, 1.0, trace)?;
        // A NaN does not pass, either.
        if self.unknowns.proximity <= -CLOSEST_APPROACH * CLOSEST_APPROACH {
            Ok(())
        } else {
            self.check_distances(body, h)
        }
    }

    /// Refuses stages too close to a point of the potential, in a step of length `h`.
    fn check_distances(&self, body: &RigidBody<3>, h: f64) -> Result<(), Failure> {
        let seen: Vec<Vector<3>> = self.seen.iter().map(|v| Vector::<3>::from(*v)).collect();
        // The distance of an iterate that is not a rotation, or not finite, says nothing.
        let turns = (0..self.tableau.stages()).map(|k| (k, self.rotation(k)));
        let is_rotation =
            |turn: &Quaternion<f64>| (turn.w * turn.w + dot(&turn.v, &turn.v) - 1.0).abs() < 1e-6;
        turns.filter(|(_, turn)| is_rotation(turn)).try_for_each(|(k, turn)| {
            let checked = match self.motion().filter(|_| body.is_driven()) {
                Some(motion) => {
                    let g = motion.quaternion().times(&turn).matrix();
                    let at_stage = body.at(self.clock.at(h, self.tableau.c(k) * h));
                    at_stage.check(&Mat::from_fn(|i, j| g[i][j]))
                }
                None => {
                    let u = turn.matrix();
                    body.check_distances_seen(&Mat::from_fn(|i, j| u[i][j]), &seen)
                }
            };
            checked.map_err(|failure| Failure { stage: Some(k), ..failure })
        })
    }

    /// Solves the step of length `h` from `momentum`, the body momentum at its beginning, with the space
    /// vectors of the potential in `self.seen`.
    fn solve(
        &mut self,
        body: &RigidBody<3>,
        h: f64,
        momentum: Vec3<f64>,
    ) -> Result<Convergence, Failure> {
        let inertia = Inertia::of(body);
        let Self {
            tableau, plan, solver, history, level, unknowns, seen, drive, drive_seen, ..
        } = self;
        // If a step is guessed from the preceding ones and turns little, half the passes suffice.
        let calm = history.is_some() && {
            let turn = scaled(&inertia.divides(&momentum), h);
            dot(&turn, &turn) <= CALM_RAD * CALM_RAD
        };
        let passes = if calm { plan.passes.halved() } else { plan.passes };
        let start = Start {
            plan,
            body,
            inertia,
            seen,
            drive,
            drive_seen,
            step: h,
            passes: passes.of_sweep(false),
            momentum,
        };
        let (level, stages) = (*level, tableau.stages());
        if plan.collocates && history.is_none() && solver.rule().allows_another() {
            let tolerance = solver.rule().looser_than_rounding();
            let done =
                in_eight_stage_lanes!(level, body, body_frame::solve, &start, tolerance, unknowns);
            body.count(u64::from(done.torques) * stages as u64);
            (0..done.evaluations).try_for_each(|_| body.work().begin_sweep())?;
            if done.is_solved {
                if body.is_driven() {
                    in_stage_lanes!(
                        level, stages, body, sweep::work_and_impulse also DRIVEN, &start, unknowns
                    );
                }
                return Ok(done.convergence());
            }
        }
        let mut equations = InLanes {
            level,
            stages,
            start,
            passes,
            at_first: false,
            unknowns,
            momentum_scale: 1.0,
            torques: 0,
        };
        let solved = solver.solve_after(history, &mut equations);
        if plan.is_finished && solved.is_ok() {
            counted!(finish, &mut equations);
        }
        body.count(equations.torques);
        if body.is_driven() && solved.is_ok() {
            counted!(work_and_impulse, &mut equations);
        }
        solved.map_err(|mut failure| {
            // The state is finite: an iterate that is not has grown without bound.
            if failure.code == FailureCode::NonFinite && failure.iterations > 1 {
                failure.code = FailureCode::Diverged;
            }
            failure.explained_by(self.check_distances(body, h))
        })
    }
}

/// The equations of a step, in as many lanes as the stages need.
struct InLanes<'a> {
    level: Option<Level>,
    stages: usize,
    start: Start<'a, Row, f64>,
    passes: Passes,
    /// Is the next sweep the first after a guess?
    at_first: bool,
    unknowns: &'a mut Unknowns<Row, f64>,
    /// The unit of momenta.
    momentum_scale: f64,
    /// Number of torques computed.
    torques: u64,
}

impl InLanes<'_> {
    fn lanes(&self) -> usize {
        self.stages.next_power_of_two()
    }
}

impl Equations for InLanes<'_> {
    fn guess(&mut self) -> Result<(), Failure> {
        counted!(guess, self);
        // Each piece of work already counts one torque at each stage.
        let more = self.start.plan.torques_of_guess() - 1;
        self.torques += u64::from(more) * self.stages as u64;
        self.at_first = true;
        let largest = |size: f64, row: &Row| row.0.iter().fold(size, |size, x| size.max(x.abs()));
        let size = self.start.momentum.iter().fold(0.0, |size: f64, x| size.max(x.abs()));
        let size = self.unknowns.momentum.iter().fold(size, largest);
        self.momentum_scale = if size >= SMALLEST_SIZE { size } else { 1.0 };
        Ok(())
    }

    /// Makes one sweep: x and Q^-1 of the guess are far from those of a sweep.
    fn prime(&mut self) -> Result<(), Failure> {
        if !self.sweep()?.is_finite() {
            self.guess()?;
            // Newton's method needs sweeps that are all alike.
            self.at_first = false;
        }
        Ok(())
    }

    fn sweep(&mut self) -> Result<f64, Failure> {
        self.start.body.work().begin_sweep()?;
        self.start.passes = self.passes.of_sweep(self.at_first);
        self.at_first = false;
        Ok(counted!(sweep, self))
    }

    fn unknowns(&self, values: &mut Vec<f64>) {
        self.unknowns.visit(self.lanes(), self.momentum_scale, |x, unit| values.push(x / unit));
    }

    fn set(&mut self, values: &[f64]) {
        let mut values = values.iter();
        self.unknowns.visit_mut(self.lanes(), self.momentum_scale, |x, unit| {
            *x = values.next().map_or(*x, |value| value * unit);
        });
    }
}

impl Continued for InLanes<'_> {
    fn keep(&self, numbers: &mut Vec<f64>) {
        match self.lanes() {
            1 => self.unknowns.keep::<1>(numbers),
            2 => self.unknowns.keep::<2>(numbers),
            _ => self.unknowns.keep::<FEW_STAGES>(numbers),
        }
    }

    fn continue_from(&mut self, numbers: &[f64]) -> Result<u32, Failure> {
        match self.lanes() {
            1 => self.unknowns.continue_from::<1>(numbers),
            2 => self.unknowns.continue_from::<2>(numbers),
            _ => self.unknowns.continue_from::<FEW_STAGES>(numbers),
        }
        Ok(0)
    }
}

impl Stepper<3> for VpdSo3 {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<3>) {
        if let Some(history) = &mut self.history {
            history.forget();
        }
        self.clock = Clock::default();
        self.state = match self.state {
            MotionState::Full(_) => MotionState::Full(Motion::of(state)),
            MotionState::Reduced { .. } => {
                let momentum = so3::vee(&state.momentum);
                let square = momentum.norm_squared();
                MotionState::Reduced { momentum: Sum::new(momentum.into(), [0.0; 3]), square }
            }
        };
    }

    fn clock(&self) -> Option<&Clock<3>> {
        Some(&self.clock)
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<3>> {
        Some(&mut self.clock)
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let p0 = self.body_momentum();
        let updated = self.update_space_vectors(body, h);
        updated.map_err(|failure| self.with_angle(body, h, failure))?;
        let solved = self.solve(body, h, p0).map_err(|failure| self.with_angle(body, h, failure));
        let made = solved.and_then(|solved| self.accepted(body, h, solved));
        self.or_in_matrices(body, h, made)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        let g = self.motion()?.quaternion().matrix();
        Some(so::orthonormalised(&Mat::from_fn(|i, j| g[i][j])))
    }

    fn momentum(&self) -> Mat<3> {
        so::hat(&self.body_momentum())
    }

    fn sigma_min(&self) -> Option<f64> {
        if let Some(matrices) = self.matrices.as_ref().filter(|_| self.by_matrices) {
            return Some(matrices.step.sigma_min());
        }
        let sigmas = (0..=self.tableau.stages()).map(|k| smallest_singular_value(&self.stretch(k)));
        Some(sigmas.fold(f64::INFINITY, f64::min))
    }

    fn stage(&self, k: usize) -> Option<State<3>> {
        if let Some(matrices) = self.matrices.as_ref().filter(|_| self.by_matrices) {
            return matrices.step.stage(k);
        }
        if k >= self.tableau.stages() {
            return None;
        }
        // pi_k - p0 is what is kept; p0 = f p1 f^T - (pi1 - p0).
        let Unknowns { momentum, end, impulse, .. } = &self.unknowns;
        let before = product(&end.matrix(), &self.body_momentum());
        let pi = vec3!(i => momentum[i].0[k] + (before[i] - impulse[i]));
        let u = self.rotation(k).matrix();
        let attitude = Mat::from_fn(|i, j| u[i][j]);
        let momentum = so::hat(&transposed_product(&u, &pi));
        Some(State { attitude, momentum })
    }
}

impl VpdSo3 {
    /// Updates the space vectors of the potential and the drive to the beginning of a step of length `h`.
    fn update_space_vectors(&mut self, body: &RigidBody<3>, h: f64) -> Result<(), Failure> {
        let Self { tableau, level, state, clock, seen, drive, drive_seen, .. } = self;
        match state {
            MotionState::Full(motion) => {
                motion.space_vectors(0.0, body, seen);
                if body.extras() & extras::DRIVEN != 0 {
                    drive.begin(body, clock.time, h, tableau.nodes())?;
                    let (level, stages, blank) = (*level, tableau.stages(), Row::splat(0.0));
                    let attitude = &motion.attitude.value;
                    in_stage_lanes!(
                        level, stages, body, sweep::see_drive also DRIVEN,
                        attitude, drive, drive_seen, blank
                    );
                }
            }
            MotionState::Reduced { .. } => {
                seen.clear();
                // Wheels alone, which need no frame.
                drive.begin(body, clock.time, h, tableau.nodes())?;
            }
        }
        Ok(())
    }

    /// Checks the solved step and applies it to the state.
    fn accepted(
        &mut self,
        body: &RigidBody<3>,
        h: f64,
        solved: Convergence,
    ) -> Result<Convergence, Failure> {
        self.check(body, h).map_err(|failure| self.with_angle(body, h, failure))?;
        // What a user-defined law returns after the last sweep has not been checked yet.
        let Unknowns { impulse, momentum_increment, .. } = &self.unknowns;
        if body.has_user_potential()
            && !impulse.iter().chain(momentum_increment).all(|x| x.is_finite())
        {
            let failure = Failure::not_finite(None);
            return Err(self.with_angle(body, h, failure));
        }
        let before = self.state;
        self.advance(body, self.plan.is_finished.then_some(self.unknowns.momentum_increment));
        if solved.rung == Rung::Newton
            && let Some(end) = self.attitude()
        {
            let solver = self.solver.by_sweeps();
            let mut halves = Self { solver, history: None, state: before, ..self.clone() };
            let half = || halves.step(body, 0.5 * h).map(|_| halves.attitude());
            if let Err(failure) = check_root(solved, self.order(), &end, half) {
                self.state = before;
                return Err(self.with_angle(body, h, failure));
            }
        }
        if body.is_driven() {
            let Unknowns { work, torque_impulse, .. } = self.unknowns;
            let put_in = self.put_in(&self.drive, &before, h, work, &torque_impulse);
            self.clock.advance(h, &put_in);
        }
        Ok(solved)
    }

    /// What was put in during a step of length `h` from `before`, given the work, and the impulse of torques in the frame of
    /// its beginning.
    fn put_in(
        &self,
        drive: &Drive,
        before: &MotionState,
        h: f64,
        work: f64,
        torque_impulse: &Vec3<f64>,
    ) -> WorkAndImpulse<3> {
        let torque = match before {
            MotionState::Full(motion) if drive.pushes() => {
                Some(so::hat(&product(&motion.quaternion().matrix(), torque_impulse)))
            }
            _ => None,
        };
        let tables = h * drive.tables(&self.plan.tableau.weights);
        WorkAndImpulse { power: work, torque, tables }
    }

    /// Makes the step in matrices where it was not solved here: their Newton's method solves steps of a thin body that
    /// turn it ten times as far. If they do not solve it either, the failure of the sweeps explains more.
    fn or_in_matrices(
        &mut self,
        body: &RigidBody<3>,
        h: f64,
        made: Result<Convergence, Failure>,
    ) -> Result<Convergence, Failure> {
        self.by_matrices = false;
        let unsolved = |failure: &Failure| {
            matches!(
                failure.code,
                FailureCode::NonFinite
                    | FailureCode::Diverged
                    | FailureCode::Stalled
                    | FailureCode::MaxIterations
            )
        };
        let failure = match made {
            Err(failure) if unsolved(&failure) && self.solver.rule().rungs == Rungs::Both => {
                failure
            }
            made => return made,
        };
        let attitude = self.attitude().unwrap_or_else(Mat::identity);
        let state = State { attitude, momentum: self.momentum() };
        let new =
            || Box::new(galerkin::StepperState::new(self.tableau.clone(), self.solver.rule()));
        let mut matrices = self.matrices.take().unwrap_or_else(new);
        matrices.start(&state);
        matrices.clock.time = self.clock.time;
        let solved = matrices.step(h, |carried, h| super::vpd::solve(carried, body, h));
        if solved.is_ok() {
            let galerkin::Solution {
                rotation_increment: turn, impulse, momentum_increment, ..
            } = matrices.step.solution();
            // f = I + 2 w hat(v) + 2 hat(v)^2
            let w = (1.0 + 0.25 * turn.trace()).sqrt();
            let v = so3::vee(&(so::asym(turn) * (0.25 / w)));
            self.unknowns.end = Quaternion { w, v: v.into() };
            self.unknowns.impulse = so3::vee(impulse).into();
            let momentum_increment =
                momentum_increment.map(|momentum_increment| so3::vee(&momentum_increment).into());
            self.advance(body, momentum_increment);
            if body.is_driven() {
                self.clock.advance(h, &matrices.clock.work_and_impulse());
            }
            self.by_matrices = true;
        }
        self.matrices = Some(matrices);
        match solved {
            Err(stopped) if stopped.code == FailureCode::Stopped => Err(stopped),
            solved => solved.map_err(|_| failure),
        }
    }

    /// Returns the failure with the angle by which the body would turn.
    fn with_angle(&self, body: &RigidBody<3>, h: f64, failure: Failure) -> Failure {
        let velocity = so3::vee(&body.velocity(&self.momentum()));
        Failure { turn_rad: Some(h.abs() * velocity.norm()), ..failure }
    }

    /// Applies the solved step to the state: that of the body momentum by its gain, where it is known by itself.
    fn advance(&mut self, body: &RigidBody<3>, momentum_increment: Option<Vec3<f64>>) {
        let Unknowns { end, impulse, .. } = &self.unknowns;
        match &mut self.state {
            MotionState::Full(motion) => {
                motion.advance(0.0, end, impulse);
                match momentum_increment {
                    Some(momentum_increment) if has_own_sum(body) => {
                        motion.add_momentum_increment(0.0, &momentum_increment)
                    }
                    _ => motion.turn_momentum(0.0),
                }
            }
            MotionState::Reduced { momentum, square } => {
                let Sum { value, carry } = &*momentum;
                let small = end.change();
                let change = transposed_product(&small, value);
                let carried = transposed_product(&small, carry);
                // Moves the momentum back onto the orbit, which it leaves only by rounding.
                let norm_error = 0.5 * (*square - dot(value, value));
                let norm_error = if *square > 0.0 { norm_error / *square } else { 0.0 };
                let change =
                    vec3!(i => change[i] + (carried[i] + norm_error * (value[i] + change[i])));
                momentum.add(&change);
            }
        }
    }

    /// Returns the motion, if the stepper carries an attitude.
    fn motion(&self) -> Option<&Motion<f64>> {
        match &self.state {
            MotionState::Full(motion) => Some(motion),
            MotionState::Reduced { .. } => None,
        }
    }

    fn body_momentum(&self) -> Vec3<f64> {
        match &self.state {
            MotionState::Full(motion) => motion.body_momentum.value,
            MotionState::Reduced { momentum, .. } => momentum.value,
        }
    }
}

/// Has the body momentum a sum of its own? A free body keeps the spatial momentum to the bit, and the sum would drift by 1e-18 a
/// step. Where a torque may take the momentum away, rounding errors of the size of what it was would stay.
fn has_own_sum(body: &RigidBody<3>) -> bool {
    !body.is_free() && !body.is_pushed()
}

/// Returns the smallest eigenvalue of `P = I + E`.
fn smallest_singular_value([xx, yy, zz, yz, xz, xy]: &Sym3<f64>) -> f64 {
    1.0 + so::smallest_eigenvalue(&Mat::<3>::new(*xx, *xy, *xz, *xy, *yy, *yz, *xz, *yz, *zz))
}
