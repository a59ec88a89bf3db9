//! VPD in Hamiltonian form for several bodies: the paper's map for each attitude, the partitioned Runge-Kutta pair of the same
//! tableau for each place, with the forces of all stages of all bodies at once.
//!
//! ```text
//! attitudes   (24, vih) of each body, dH/dg and dH/dmu taken at the stages of all bodies
//! places      X_i = x0 + h sum_j a_ij P_j / M       P_i = p0 - h sum_j b_j (1 - a_ji / b_i) dH/dx_j
//!             x1 = x0 + h sum_j b_j P_j / M         p1 = p0 - h sum_j b_j dH/dx_j
//! ```
//!
//! The polar factor of a matrix of blocks is that of its blocks: this is the map of the paper on SO(nk), restricted to attitudes
//! of k bodies. A sweep goes over the bodies, in blocks side by side in lanes, and then over the forces. The same map takes
//! steps of bodies in a rescaled time (`rescaled.rs`): all velocities times sigma, and the forces of H~.
//!
//! Invariant: only forces change linear momenta, and only torques spatial ones; a step that fails leaves the state as it was.

use fearless_simd::Level;

use super::block::{Block, MOST_BODIES, Task};
use super::coefficients::Coefficients;
use super::motion::BodiesMotion;
use super::rescaled::{BodiesTimeScale, Rescaling};
use super::trajectory::BodiesStepper;
use super::{Bodies, BodiesState, Configuration, Forces};
use crate::failure::{Failure, FailureCode};
use crate::lanes::Real;
use crate::nonlinear::{
    Continued, Convergence, Equations, Rungs, SMALLEST_SIZE, Solver, StepHistory, StopRule,
};
use crate::so::{self, Mat, Vector};
use crate::stepper::checks::{check_continuity, check_singular_value};
use crate::stepper::galerkin::Length;
use crate::tableau::Tableau;

/// Passes over velocities and attitudes in a sweep.
const PASSES: usize = 2;

/// The stepper.
#[derive(Clone, Debug)]
pub struct BodiesVpd<const N: usize> {
    tableau: Tableau,
    coefficients: Coefficients,
    solver: Solver,
    level: Option<Level>,
    /// The state, with the parts lost to rounding.
    pub(super) motion: BodiesMotion<N>,
    blocks: Vec<Block>,
    /// `P - p0` of the trees at the stages, one stage after the other.
    impulses: Vec<Vector<N>>,
    forces: Forces<N>,
    stage: StageState<N>,
    history: Option<StepHistory>,
    rescaling: Option<Rescaling<N>>,
}

/// All bodies at one stage, gathered from the blocks.
#[derive(Clone, Debug, Default)]
struct StageState<const N: usize> {
    attitudes: Vec<Mat<N>>,
    momenta: Vec<Mat<N>>,
    velocities: Vec<Mat<N>>,
    places: Vec<Vector<N>>,
    /// Forces on the trees at all stages, one stage after the other.
    forces: Vec<Vector<N>>,
    /// The largest sizes of what is added up to the torques of each body.
    sizes: Vec<f64>,
    /// Sizes of what is added up to the forces on the trees at all stages.
    force_sizes: Vec<f64>,
}

impl<const N: usize> BodiesVpd<N> {
    /// Creates the stepper for `tableau`, which solves each step until `stop`, by sweeps. It is for systems of as many bodies
    /// and trees as `state`.
    pub fn new(tableau: Tableau, stop: StopRule, state: &BodiesState<N>) -> Self {
        let stages = tableau.stages();
        let (bodies, trees) = (state.attitudes.len(), state.places.len());
        let blocks = (0..bodies)
            .step_by(MOST_BODIES)
            .map(|first| Block::new(N, stages, first, MOST_BODIES.min(bodies - first)));
        Self {
            coefficients: Coefficients::new(&tableau),
            tableau,
            solver: Solver::new(StopRule { rungs: Rungs::FixedPoint, ..stop }),
            level: Some(Level::new()),
            motion: BodiesMotion::new(state),
            blocks: blocks.collect(),
            impulses: vec![Vector::zeros(); stages * trees],
            forces: Forces::none(bodies, trees),
            stage: StageState {
                attitudes: vec![Mat::identity(); bodies],
                momenta: vec![Mat::zeros(); bodies],
                velocities: vec![Mat::zeros(); bodies],
                places: state.places.clone(),
                forces: vec![Vector::zeros(); stages * trees],
                sizes: vec![0.0; bodies],
                force_sizes: vec![0.0; stages * trees],
            },
            history: Some(StepHistory::default()),
            rescaling: None,
        }
    }

    /// Returns the stepper on an older instruction set, or without one: a test compares the bits.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { level, ..self }
    }

    /// Returns the stepper in the time of `scale`, on the motion with this `energy` in J: its steps are of H~.
    pub fn rescaled(self, scale: BodiesTimeScale, energy: f64) -> Self {
        let (bodies, trees) = (self.stage.attitudes.len(), self.stage.places.len());
        let sizes = [self.coefficients.stages, bodies, trees];
        Self { rescaling: Some(Rescaling::new(scale, energy, sizes)), ..self }
    }

    /// Returns the stepper that begins each step with a guess from its state alone, for steps of different lengths.
    pub(super) fn without_history(self) -> Self {
        Self { history: None, ..self }
    }

    /// Makes a step of `h` in the time of the scheme; returns also how long it lasts, in seconds.
    ///
    /// # Errors
    /// Those of [`BodiesStepper::step`].
    pub fn timed_step(
        &mut self,
        bodies: &Bodies<N>,
        h: f64,
    ) -> Result<(Convergence, f64), Failure> {
        let length = Length { h, lasting: None };
        self.advanced(bodies, length).map(|(solved, [_, lasts_s])| (solved, lasts_s))
    }

    /// Refuses a solution whose polar factors are ill-conditioned, or jump.
    fn check(&self) -> Result<(), Failure> {
        /// Entries of `U - I` of turns below an eighth of a circle, and of `I - P^-1` far from one.
        const MODEST: [f64; 2] = [0.3, 0.1];
        let stages = self.coefficients.stages;
        let limit = N as f64 - 2.0;
        for block in &self.blocks {
            let [turn, stretch] = block.largest();
            // A NaN does not pass.
            if turn <= MODEST[0] && stretch <= MODEST[1] {
                continue;
            }
            for lane in 0..block.bodies {
                for k in (0..stages).map(Some).chain([None]) {
                    let f: Mat<N> = block.stretch(k, lane);
                    check_singular_value(1.0 / (1.0 - so::smallest_eigenvalue(&f)), k)?;
                }
                let ascending = self.tableau.ascending().iter().map(|&k| Some(k));
                let attitude = |k| Mat::<N>::identity() + block.turn::<N>(k, lane);
                let nodes = ascending.chain([None]).map(|k| (k, attitude(k)));
                let trace = |u: &Mat<N>, v: &Mat<N>| so::dot(u.as_slice(), v.as_slice());
                check_continuity(Mat::identity(), nodes, limit, trace)?;
            }
        }
        Ok(())
    }

    fn advance(&mut self, bodies: &Bodies<N>, h: f64) {
        for block in &self.blocks {
            for lane in 0..block.bodies {
                let (turn, impulse) = (block.turn(None, lane), block.impulse(lane));
                let gain = block.gain(lane);
                self.motion.turn(self.level, block.first + lane, [&turn, &impulse], &gain);
            }
        }
        let Coefficients { stages, weights, .. } = &self.coefficients;
        let trees = bodies.places();
        for tree in 0..trees {
            let Some(mass) = bodies.mass_of_place(tree) else { continue };
            let p0 = *self.motion.linear_momentum(tree);
            let (mut way, mut impulse) = (Vector::zeros(), Vector::zeros());
            for k in 0..*stages {
                let gained = self.impulses[k * trees + tree];
                way += match &self.rescaling {
                    Some(own) => (p0 + gained) * (own.sigma[k] * weights[k]),
                    None => gained * weights[k],
                };
                impulse += self.stage.forces[k * trees + tree] * (h * weights[k]);
            }
            let way = if self.rescaling.is_some() { way } else { p0 + way };
            self.motion.shift(tree, &(way * (h / mass)), &impulse);
        }
    }

    /// Makes a step; returns also its length in the time of the scheme, and in seconds.
    pub(super) fn advanced(
        &mut self,
        bodies: &Bodies<N>,
        length: Length,
    ) -> Result<(Convergence, [f64; 2]), Failure> {
        let Self {
            coefficients,
            solver,
            level,
            motion,
            blocks,
            impulses,
            forces,
            stage,
            history,
            rescaling,
            ..
        } = self;
        for block in blocks.iter_mut() {
            for lane in 0..block.bodies {
                let body = block.first + lane;
                block.begin(lane, motion.attitude(body), motion.momentum(body));
                if let Some(weights) = bodies.weights(body) {
                    block.set_weights(lane, weights);
                }
            }
        }
        let mut equations = StepEquations {
            bodies,
            h: length.h,
            lasting: length.lasting,
            coefficients,
            level: *level,
            motion,
            blocks,
            impulses,
            forces,
            stage,
            rescaling,
            stage_of_failure: None,
        };
        let solved = solver
            .solve_after(history, &mut equations)
            .and_then(|solved| equations.finish().map(|()| solved));
        let (stage, h) = (equations.stage_of_failure, equations.h);
        let solved = solved.map_err(|mut failure| {
            // The state is finite: an iterate that is not has grown without bound.
            if failure.code == FailureCode::NonFinite && failure.iterations > 1 {
                failure.code = FailureCode::Diverged;
            }
            Failure { stage: failure.stage.or(stage), ..failure }
        })?;
        self.check()?;
        let finite = self.blocks.iter().all(|block| {
            (0..block.bodies).all(|lane| block.gain::<N>(lane).iter().all(|x| x.is_finite()))
        });
        if !finite || self.stage.forces.iter().flatten().any(|x| !x.is_finite()) {
            return Err(Failure::not_finite(None));
        }
        self.advance(bodies, h);
        let mean = self.rescaling.as_ref().map(|own| own.mean(&self.coefficients.weights));
        Ok((solved, [h, mean.map_or(h, |mean| mean * h)]))
    }
}

impl<const N: usize> BodiesStepper<N> for BodiesVpd<N> {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &BodiesState<N>) {
        self.motion = BodiesMotion::new(state);
        if let Some(history) = &mut self.history {
            history.forget();
        }
    }

    fn step(&mut self, bodies: &Bodies<N>, h: f64) -> Result<Convergence, Failure> {
        self.advanced(bodies, Length { h, lasting: None }).map(|(solved, _)| solved)
    }

    fn state(&self) -> BodiesState<N> {
        self.motion.state()
    }
}

/// The equations of a step.
struct StepEquations<'a, const N: usize> {
    bodies: &'a Bodies<N>,
    h: f64,
    lasting: Option<f64>,
    coefficients: &'a Coefficients,
    level: Option<Level>,
    motion: &'a BodiesMotion<N>,
    blocks: &'a mut [Block],
    impulses: &'a mut [Vector<N>],
    forces: &'a mut Forces<N>,
    stage: &'a mut StageState<N>,
    rescaling: &'a mut Option<Rescaling<N>>,
    stage_of_failure: Option<usize>,
}

impl<const N: usize> StepEquations<'_, N> {
    /// Does a part of a sweep in all blocks; returns the largest change.
    fn perform(&mut self, task: Task) -> f64 {
        let (level, coefficients, h) = (self.level, self.coefficients, self.h);
        self.blocks.iter_mut().fold(0.0, |most, block| {
            let change = block.perform(level, coefficients, h, task);
            Real::max_or_nan(most, change)
        })
    }

    /// Are the velocities of all bodies their momenta times weights?
    fn has_weights(&self) -> bool {
        (0..self.bodies.bodies().len()).all(|body| self.bodies.weights(body).is_some())
    }

    fn velocities(&mut self) -> Result<(), Failure> {
        self.perform(Task::Momenta);
        if self.rescaling.is_none() && self.has_weights() {
            self.perform(Task::Velocities);
            return Ok(());
        }
        if self.bodies.has_joints() {
            self.perform(Task::ToSpace);
        }
        for k in 0..self.coefficients.stages {
            let StageState { attitudes, momenta, velocities, .. } = &mut *self.stage;
            for block in self.blocks.iter() {
                for lane in 0..block.bodies {
                    momenta[block.first + lane] = block.momentum(k, lane);
                    if self.bodies.has_joints() {
                        attitudes[block.first + lane] = block.attitude(k, lane);
                    }
                }
            }
            self.bodies.velocities(attitudes, momenta, velocities)?;
            let own = self.rescaling.as_mut();
            let sigma = own.map_or(1.0, |own| own.note_velocities(k, momenta, velocities));
            for block in self.blocks.iter_mut() {
                for lane in 0..block.bodies {
                    block.set_velocity(k, lane, &(velocities[block.first + lane] * sigma));
                }
            }
        }
        Ok(())
    }

    /// Sets attitudes and places to those at a stage.
    fn go_to_stage(&mut self, k: usize) {
        let trees = self.bodies.places();
        let StageState { attitudes, places, .. } = &mut *self.stage;
        for block in self.blocks.iter() {
            for lane in 0..block.bodies {
                attitudes[block.first + lane] = block.attitude(k, lane);
            }
        }
        let Coefficients { stages, part, weights, nodes, .. } = self.coefficients;
        for tree in 0..trees {
            places[tree] = *self.motion.place(tree);
            let Some(mass) = self.bodies.mass_of_place(tree) else { continue };
            let p0 = self.motion.linear_momentum(tree);
            let a = |j: usize| part[k * stages + j] * weights[j];
            let gained = |j: usize| &self.impulses[j * trees + tree];
            let way = match &*self.rescaling {
                // X_k = x0 + h sum_j a_kj sigma_j P_j / M
                Some(own) => (0..*stages).map(|j| (p0 + gained(j)) * (a(j) * own.sigma[j])).sum(),
                // X_k = x0 + h c_k p0 / M + h sum_j a_kj (P_j - p0) / M
                None => {
                    let mut way = p0 * nodes[k];
                    for j in 0..*stages {
                        way += gained(j) * a(j);
                    }
                    way
                }
            };
            places[tree] += way * (self.h / mass);
        }
    }

    /// Renews sigma at all stages, and the length of a step that is to last a given time.
    fn pace(&mut self) -> Result<(), Failure> {
        if self.rescaling.is_none() {
            return Ok(());
        }
        self.perform(Task::ToSpace);
        let mut renewed = Vec::with_capacity(self.coefficients.stages);
        for k in 0..self.coefficients.stages {
            self.go_to_stage(k);
            let StageState { attitudes, places, .. } = &*self.stage;
            if let Some(own) = &mut *self.rescaling {
                own.look_at_stage(self.bodies, k, attitudes, places, &mut renewed)?;
            }
        }
        if let Some(own) = &mut *self.rescaling {
            own.sigma = renewed;
            if let Some(lasting) = self.lasting {
                self.h = lasting / own.mean(&self.coefficients.weights);
            }
        }
        Ok(())
    }

    /// Computes the forces of all stages; returns the largest change of an impulse of a place, relative to its momentum.
    fn push(&mut self) -> Result<f64, Failure> {
        self.perform(Task::ToSpace);
        let (stages, h) = (self.coefficients.stages, self.h);
        let trees = self.bodies.places();
        let has_joints = self.bodies.has_joints();
        self.stage.sizes.fill(0.0);
        for k in 0..stages {
            self.go_to_stage(k);
            let StageState {
                attitudes,
                velocities,
                places,
                forces: on_places,
                sizes,
                force_sizes,
                ..
            } = &mut *self.stage;
            match &*self.rescaling {
                Some(own) => velocities.copy_from_slice(own.velocities(k)),
                None if has_joints => {
                    for block in self.blocks.iter() {
                        for lane in 0..block.bodies {
                            velocities[block.first + lane] = block.velocity(k, lane);
                        }
                    }
                }
                None => {}
            }
            let at = Configuration { attitudes, places, velocities };
            let of_stage = k * trees..(k + 1) * trees;
            let (bodies, motion, impulses) =
                (self.bodies, self.motion, &self.impulses[of_stage.clone()]);
            let force_sizes = &mut force_sizes[of_stage.clone()];
            let pushed = self.bodies.forces(at, self.forces).and_then(|()| {
                let Some(own) = &mut *self.rescaling else {
                    for (size, force) in force_sizes.iter_mut().zip(&self.forces.forces) {
                        *size = so::norm(force.as_slice());
                    }
                    return Ok(());
                };
                let moving = (0..trees).filter_map(|tree| {
                    let p = motion.linear_momentum(tree) + impulses[tree];
                    bodies.mass_of_place(tree).map(|mass| p.norm_squared() / (2.0 * mass))
                });
                own.rescale(bodies, k, at, moving.sum(), self.forces, force_sizes)
            });
            pushed.inspect_err(|_| self.stage_of_failure = Some(k))?;
            for block in self.blocks.iter_mut() {
                for lane in 0..block.bodies {
                    block.set_torque(k, lane, &self.forces.torques[block.first + lane]);
                }
            }
            for (size, of_stage) in sizes.iter_mut().zip(&self.forces.sizes) {
                *size = size.max(*of_stage);
            }
            on_places[of_stage].copy_from_slice(&self.forces.forces);
        }
        let StageState { forces: on_places, sizes, force_sizes, .. } = &*self.stage;
        self.bodies.work().add_gradients(stages as u64);
        for block in self.blocks.iter_mut() {
            for lane in 0..block.bodies {
                block.set_noise(lane, h.abs() * sizes[block.first + lane]);
            }
        }
        // P_k - p0 = h sum_j b_j (1 - a_jk / b_k) F_j
        let mut change = 0.0_f64;
        for tree in 0..trees {
            if self.bodies.mass_of_place(tree).is_none() {
                continue;
            }
            let mut size = so::norm(self.motion.linear_momentum(tree).as_slice());
            let mut changed = 0.0_f64;
            for k in 0..stages {
                let mut impulse = Vector::zeros();
                for j in 0..stages {
                    let weight = self.coefficients.conjugate[k * stages + j]
                        * (h * self.coefficients.weights[j]);
                    impulse += on_places[j * trees + tree] * weight;
                }
                let before = &mut self.impulses[k * trees + tree];
                changed = Real::max_or_nan(changed, (impulse - *before).amax());
                size = size.max(impulse.amax());
                size = size.max(h.abs() * force_sizes[k * trees + tree]);
                *before = impulse;
            }
            change = Real::max_or_nan(change, changed / size.max(SMALLEST_SIZE));
        }
        self.perform(Task::FromSpace);
        Ok(change)
    }

    /// Brings all up to the solution: after a sweep the end is one iteration behind, and that error is biased.
    fn finish(&mut self) -> Result<(), Failure> {
        self.velocities()?;
        self.perform(Task::Turn);
        self.pace()?;
        self.push()?;
        self.perform(Task::Finish);
        Ok(())
    }
}

impl<const N: usize> Equations for StepEquations<'_, N> {
    fn guess(&mut self) -> Result<(), Failure> {
        self.impulses.fill(Vector::zeros());
        for block in self.blocks.iter_mut() {
            block.unknowns_mut().into_iter().for_each(|numbers| numbers.fill(0.0));
        }
        // Velocities at the beginning: those of stages that have not turned.
        if let Some(own) = &mut *self.rescaling {
            let StageState { attitudes, places, .. } = &mut *self.stage;
            for (body, attitude) in attitudes.iter_mut().enumerate() {
                *attitude = *self.motion.attitude(body);
            }
            for (tree, place) in places.iter_mut().enumerate() {
                *place = *self.motion.place(tree);
            }
            own.sigma.fill(own.scale.sigma(self.bodies, attitudes, places)?);
        }
        self.velocities()?;
        let (coefficients, h) = (self.coefficients, self.h);
        self.blocks.iter_mut().for_each(|block| block.guess(coefficients, h));
        Ok(())
    }

    fn sweep(&mut self) -> Result<f64, Failure> {
        self.bodies.work().begin_sweep()?;
        let mut turned = 0.0;
        let paces = self.rescaling.as_ref().map_or_else(Vec::new, |own| own.sigma.clone());
        for _ in 0..PASSES {
            self.velocities()?;
            turned = self.perform(Task::Turn);
            self.pace()?;
        }
        let pushed = self.push()?;
        let changed = self.perform(Task::Transport);
        let most = Real::max_or_nan(pushed, changed);
        let paced = self.rescaling.as_ref().map_or(0.0, |own| own.change_since(&paces));
        Ok(Real::max_or_nan(Real::max_or_nan(most, paced), turned))
    }

    fn unknowns(&self, values: &mut Vec<f64>) {
        for block in self.blocks.iter() {
            block.unknowns().into_iter().for_each(|numbers| values.extend_from_slice(numbers));
        }
        self.impulses.iter().for_each(|impulse| values.extend_from_slice(impulse.as_slice()));
        if let Some(own) = &*self.rescaling {
            values.extend_from_slice(&own.sigma);
        }
    }

    fn set(&mut self, values: &[f64]) {
        let mut rest = values;
        let mut take = |numbers: &mut [f64]| {
            let (mine, others) = rest.split_at(numbers.len());
            numbers.copy_from_slice(mine);
            rest = others;
        };
        for block in self.blocks.iter_mut() {
            block.unknowns_mut().into_iter().for_each(&mut take);
        }
        self.impulses.iter_mut().for_each(|impulse| take(impulse.as_mut_slice()));
        if let Some(own) = &mut *self.rescaling {
            take(&mut own.sigma);
        }
    }
}

impl<const N: usize> Continued for StepEquations<'_, N> {
    fn keep(&self, numbers: &mut Vec<f64>) {
        self.unknowns(numbers);
    }

    fn continue_from(&mut self, numbers: &[f64]) -> Result<u32, Failure> {
        self.set(numbers);
        Ok(0)
    }
}
