//! Inputs and unknowns of a step of VPD for n = 3, as they lie in memory.
//!
//! Invariant: lanes beyond the stages hold numbers, and have zero weight.

use crate::hamiltonian::{Drive, DriveInFrame, RigidBody};
use crate::lanes::Row;
use crate::space::{Quaternion, Sym3, Vec3, dot, vec3};
use crate::stepper::so3_equations::Inertia;
use crate::tableau::{Tableau, TableauInLanes};

/// Largest number of stages that counts as few.
pub(super) const FEW_STAGES: usize = 4;

/// Least number of stages with which the error left is in the last digits, and biased:
/// the end is brought up to the newest sweep.
const FINISHED_STAGES: usize = 3;

/// Least number of stages with which the last increment, which the stop rule leaves, shows in the
/// energy: finishing begins with the momenta.
pub(super) const RENEWED_STAGES: usize = 4;

/// Number of sweeps of the first guess that use the same torque.
pub(super) const TORQUE_EVERY: u32 = 3;

/// Numbers of passes within a sweep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Passes {
    /// Over the kinematics.
    pub(super) kinematic: u32,
    /// Over the linear system of x.
    pub(super) linear: u32,
    /// The same in the first sweep, which has only a guess of x.
    pub(super) linear_at_first: u32,
}

impl Passes {
    /// Returns the passes for a number of stages. Fewer passes take more sweeps; many stages are
    /// used for large steps, which need more passes.
    fn of_stages(stages: usize) -> Self {
        match stages {
            0..3 => Self { kinematic: 2, linear: 2, linear_at_first: 2 },
            3..=FEW_STAGES => Self { kinematic: 2, linear: 1, linear_at_first: 2 },
            _ => Self { kinematic: 3, linear: 2, linear_at_first: 5 },
        }
    }

    /// Returns half of them, and at least one.
    pub(super) fn halved(self) -> Self {
        let Self { kinematic, linear, linear_at_first } = self;
        let [kinematic, linear, linear_at_first] =
            [kinematic, linear, linear_at_first].map(|passes| passes.div_ceil(2));
        Self { kinematic, linear, linear_at_first }
    }

    /// Returns the passes over the kinematics and over the linear system in the first sweep, or in
    /// a later one.
    pub(super) fn of_sweep(&self, at_first: bool) -> [u32; 2] {
        [self.kinematic, if at_first { self.linear_at_first } else { self.linear }]
    }
}

/// The tableau, and how a sweep and the first guess go over it.
#[derive(Clone, Debug)]
pub(super) struct SweepPlan {
    pub(super) tableau: TableauInLanes,
    /// The number one in the lane of each stage.
    pub(super) present: Row,
    pub(super) passes: Passes,
    /// Is a solved step finished? See [`super::sweep::finish`].
    pub(super) is_finished: bool,
    /// Sweeps of plain collocation in the first guess.
    pub(super) guess_sweeps: u32,
    /// Is a step tried in the body frame first? See [`super::body_frame`].
    pub(super) collocates: bool,
}

impl SweepPlan {
    /// Returns the plan for a tableau; `None` if it has more stages than there are lanes.
    pub(super) fn new(tableau: &Tableau) -> Option<Self> {
        let stages = tableau.stages();
        let few = stages <= FEW_STAGES;
        let mut present = Row::splat(0.0);
        present.0.iter_mut().take(stages).for_each(|one| *one = 1.0);
        Some(Self {
            tableau: TableauInLanes::new(tableau)?,
            present,
            passes: Passes::of_stages(stages),
            is_finished: stages >= FINISHED_STAGES,
            collocates: !few && tableau.is_symplectic(),
            guess_sweeps: if few { stages as u32 - 1 } else { stages as u32 + 2 },
        })
    }

    /// Returns how often the first guess evaluates the torque at the stages: before its sweeps, in
    /// them, and after.
    pub(super) fn torques_of_guess(&self) -> u32 {
        2 + self.guess_sweeps / TORQUE_EVERY
    }
}

/// Inputs of a step. `S` holds a number for each stage in memory, `P` a number, or one for each member.
pub(super) struct Start<'a, S, P> {
    pub(super) plan: &'a SweepPlan,
    pub(super) body: &'a RigidBody<3>,
    pub(super) inertia: Inertia<f64>,
    /// The space vectors of the potential, as seen from g0.
    pub(super) seen: &'a [Vec3<P>],
    pub(super) drive: &'a Drive,
    /// The drive as it is seen from g0.
    pub(super) drive_seen: &'a DriveInFrame<S>,
    pub(super) step: f64,
    /// Passes over the kinematics and over the linear system: numbers that the compiler does not
    /// know, or it would unroll their loops into more code than a cache holds.
    pub(super) passes: [u32; 2],
    /// p0.
    pub(super) momentum: Vec3<P>,
}

/// The unknowns of a step in the frame of g0, as they lie in memory; `S` holds a number for each stage.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unknowns<S, P> {
    /// U_k.
    pub(super) attitude: Quaternion<S>,
    /// pi_k - p0.
    pub(super) momentum: Vec3<S>,
    /// x_k.
    pub(super) x: Vec3<S>,
    /// f.
    pub(super) end: Quaternion<P>,
    /// `Q(P_k)^-1 - I / 2`.
    pub(super) inverse: Sym3<S>,
    /// E_k = P_k - I.
    pub(super) stretch: Sym3<S>,
    /// The same for the end point.
    pub(super) end_stretch: Sym3<P>,
    /// pi1 - p0.
    pub(super) impulse: Vec3<P>,
    /// p1 - p0, if it is needed to the last digit.
    pub(super) momentum_increment: Vec3<P>,
    /// Largest proximity over the stages, as returned by [`RigidBody::torque`].
    pub(super) proximity: P,
    /// Energy that time and torques put in.
    pub(super) work: P,
    /// Momentum that torques put in, in the frame of g0.
    pub(super) torque_impulse: Vec3<P>,
}

impl<S: Copy, P: Copy> Unknowns<S, P> {
    /// Creates blank unknowns, of the sizes of `stages` and `whole`.
    pub(super) fn blank(stages: S, whole: P) -> Self {
        Self {
            attitude: Quaternion { w: stages, v: [stages; 3] },
            momentum: [stages; 3],
            x: [stages; 3],
            end: Quaternion { w: whole, v: [whole; 3] },
            inverse: [stages; 6],
            stretch: [stages; 6],
            end_stretch: [whole; 6],
            impulse: [whole; 3],
            momentum_increment: [whole; 3],
            proximity: whole,
            work: whole,
            torque_impulse: [whole; 3],
        }
    }
}

impl Unknowns<Row, f64> {
    /// Appends the numbers that change smoothly from step to step in the first `L` lanes; for
    /// turns, these are the vector parts.
    pub(super) fn keep<const L: usize>(&self, numbers: &mut Vec<f64>) {
        let Self { attitude, momentum, x, end, .. } = self;
        for row in attitude.v.iter().chain(momentum).chain(x) {
            if let Some(row) = row.0.first_chunk::<L>() {
                numbers.extend_from_slice(row);
            }
        }
        numbers.extend_from_slice(&end.v);
    }

    /// Takes numbers that [`Unknowns::keep`] has appended, or a prediction of them.
    pub(super) fn continue_from<const L: usize>(&mut self, numbers: &[f64]) {
        let Self { attitude, momentum, x, end, .. } = self;
        let Some((numbers, v)) = numbers.split_last_chunk::<3>() else { return };
        let scalar = |square: f64| (1.0 - square).max(0.0).sqrt();
        *end = Quaternion { w: scalar(dot(v, v)).copysign(end.w), v: *v };
        let rows = attitude.v.iter_mut().chain(momentum).chain(x);
        for (row, numbers) in rows.zip(numbers.as_chunks::<L>().0) {
            if let Some(row) = row.0.first_chunk_mut::<L>() {
                *row = *numbers;
            }
        }
        for k in 0..L {
            let v = vec3!(i => attitude.v[i].0[k]);
            attitude.w.0[k] = scalar(dot(&v, &v));
        }
    }

    /// Calls `visit` with each number from which a sweep begins, and its unit. Lanes beyond the
    /// stages must be numbers, too: zero times a NaN is a NaN.
    pub(super) fn visit_mut(
        &mut self,
        lanes: usize,
        momentum: f64,
        mut visit: impl FnMut(&mut f64, f64),
    ) {
        let Self { attitude, momentum: momenta, x, end, inverse, .. } = self;
        let turns = [&mut attitude.w].into_iter().chain(&mut attitude.v).chain(inverse);
        let rows = turns
            .map(|row| (row, 1.0))
            .chain(momenta.iter_mut().chain(x).map(|row| (row, momentum)));
        for (row, unit) in rows {
            row.0[..lanes].iter_mut().for_each(|number| visit(number, unit));
        }
        [&mut end.w].into_iter().chain(&mut end.v).for_each(|number| visit(number, 1.0));
    }

    /// Does the same without changing the numbers.
    pub(super) fn visit(&self, lanes: usize, momentum: f64, mut visit: impl FnMut(f64, f64)) {
        let mut copy = *self;
        copy.visit_mut(lanes, momentum, |number, unit| visit(*number, unit));
    }
}
