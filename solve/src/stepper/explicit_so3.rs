//! Explicit methods for n = 3 in vectors: their steps, for one body and for up to eight members of an ensemble side by side.
//!
//! The formulas of a method are in its file, written once for numbers in lanes. They make a step with quick tests that leave
//! a doubt too often rather than never; a step in doubt is made by the stepper in matrices instead, whose own tests decide, and
//! whose failure it is. So is that of a body which the formulas do not know.
//!
//! Invariant: each member ends with the bits, and with the failure, of its own run, on every instruction set.

use fearless_simd::{Level, prelude::*};

use super::{Clock, Knots, Stepper};
use crate::composition::TopSum;
use crate::ensemble::Members;
use crate::failure::Failure;
use crate::hamiltonian::{Drive, DriveInFrame, RigidBody, WorkAndImpulse};
use crate::lanes::extras::{DRIVEN, USER};
use crate::lanes::{
    Real, Row, Rows, StageScalar, StepScalar, WIDTH, has_member_lanes, in_member_lanes,
};
use crate::nonlinear::Convergence;
use crate::so::{self, Mat};
use crate::so3::{self, Top};
use crate::space::Vec3;
use crate::state::State;
use crate::stepper::explicit_stages::{End, Law, MOST_STAGES, NUMBERS, Rates};
use crate::stepper::rk::{self, Rk};
use crate::stepper::rkmk::{self, Rkmk};
use crate::stepper::so3_equations::Inertia;
use crate::stepper::splitting::Splitting;
use crate::tableau::Tableau;

/// Members up to this many are quicker one after the other: eight lanes take the time of two to four.
const FEW: usize = 2;

/// A method: its stepper in matrices, and what its formulas in vectors need.
#[derive(Clone, Debug)]
enum Scheme {
    Rk { tableau: Tableau, projected: bool, matrices: Rk<3> },
    Rkmk { tableau: Tableau, matrices: Rkmk<3> },
    Splitting(Splitting),
}

impl Scheme {
    /// The tableau; `None` for a composition.
    fn tableau(&self) -> Option<&Tableau> {
        match self {
            Self::Rk { tableau, .. } | Self::Rkmk { tableau, .. } => Some(tableau),
            Self::Splitting(_) => None,
        }
    }

    /// Stages at which drives are known.
    fn stages(&self) -> usize {
        self.tableau().map_or(0, Tableau::stages)
    }

    /// Gradients that a step takes.
    fn gradients(&self) -> u64 {
        match self {
            Self::Rk { tableau, .. } | Self::Rkmk { tableau, .. } => tableau.stages() as u64,
            Self::Splitting(splitting) => splitting.composition.parts().len() as u64 + 1,
        }
    }

    /// Do the formulas in vectors know what acts on the body?
    fn knows(&self, body: &RigidBody<3>) -> bool {
        self.tableau().is_some() || body.extras() & DRIVEN == 0
    }

    /// Takes note of the body before a step.
    fn see(&mut self, body: &RigidBody<3>) {
        if let Self::Splitting(splitting) = self {
            splitting.see(body);
        }
    }

    fn matrices(&mut self) -> &mut dyn Stepper<3> {
        match self {
            Self::Rk { matrices, .. } => matrices,
            Self::Rkmk { matrices, .. } => matrices,
            Self::Splitting(splitting) => splitting,
        }
    }

    /// The numbers of a state.
    fn numbers(&self, state: &State<3>) -> [f64; NUMBERS] {
        if self.tableau().is_none() {
            return numbers_of_top(&Top::from_state(state).into());
        }
        let (g, mu) = (&state.attitude, so3::vee(&state.momentum));
        let mut numbers = [0.0; NUMBERS];
        for i in 0..3 {
            (0..3).for_each(|j| numbers[3 * i + j] = g[(i, j)]);
            numbers[9 + i] = mu[i];
        }
        numbers
    }

    /// The state of numbers.
    fn state(&self, numbers: &[f64; NUMBERS]) -> State<3> {
        if self.tableau().is_none() {
            let Top { attitude, momentum } = top_of_numbers(numbers).top;
            return State { attitude: so3::rotation(&attitude), momentum: so3::hat(&momentum) };
        }
        State {
            attitude: Mat::<3>::from_row_slice(&numbers[..9]),
            momentum: so::hat(&numbers[9..12]),
        }
    }

    /// Makes a step in matrices.
    fn step_in_matrices(
        &mut self,
        numbers: &mut [f64; NUMBERS],
        clock: &mut Clock<3>,
        body: &RigidBody<3>,
        h: f64,
    ) -> Result<Convergence, Failure> {
        let begun = self.state(numbers);
        let matrices = self.matrices();
        matrices.start(&begun);
        if let Some(own) = matrices.clock_mut() {
            own.clone_from(clock);
        }
        if let Self::Splitting(splitting) = self {
            splitting.state = top_of_numbers(numbers);
        }
        let matrices = self.matrices();
        let made = matrices.step(body, h)?;
        if let Some(own) = matrices.clock() {
            clock.clone_from(own);
        }
        let momentum = matrices.momentum();
        let state = matrices.attitude().map(|attitude| State { attitude, momentum });
        match (&*self, state) {
            (Self::Splitting(splitting), _) => *numbers = numbers_of_top(&splitting.state),
            (_, Some(state)) => *numbers = self.numbers(&state),
            (_, None) => {}
        }
        Ok(made)
    }
}

fn numbers_of_top(sum: &TopSum) -> [f64; NUMBERS] {
    let mut numbers = [0.0; NUMBERS];
    for (Top { attitude: q, momentum }, numbers) in
        [&sum.top, &sum.carry].into_iter().zip(numbers.chunks_exact_mut(7))
    {
        numbers[..4].copy_from_slice(&[q.w, q.i, q.j, q.k]);
        numbers[4..].copy_from_slice(momentum.as_slice());
    }
    numbers
}

fn top_of_numbers(numbers: &[f64; NUMBERS]) -> TopSum {
    let top = |at: usize| {
        let [w, x, y, z] = [0, 1, 2, 3].map(|i| numbers[at + i]);
        let momentum = [4, 5, 6].map(|i| numbers[at + i]).into();
        Top { attitude: nalgebra::Quaternion::new(w, x, y, z), momentum }
    };
    TopSum { top: top(0), carry: top(7) }
}

/// Memory of a step, `P` a quantity of the step and `S` one of the stages.
#[derive(Clone, Debug)]
struct Scratch<P, S> {
    /// What drives the body at each stage.
    drives: Vec<Drive>,
    drives_seen: Vec<DriveInFrame<S>>,
    /// Space vectors of the potential.
    space: Vec<Vec3<P>>,
    rates: Vec<Rates<S>>,
    next: Next<P>,
}

/// The end of a step.
#[derive(Clone, Copy, Debug)]
struct Next<P> {
    state: [P; NUMBERS],
    /// Below zero where no test has found anything.
    doubt: P,
    work: P,
    /// Of torques that are no potential's.
    impulse: Vec3<P>,
}

impl<P: Copy, S: Copy> Scratch<P, S> {
    fn new(stages: usize, zero: P, of_stages: S) -> Self {
        Self {
            drives: vec![Drive::default(); stages],
            drives_seen: vec![DriveInFrame::nothing(of_stages); stages],
            space: Vec::new(),
            rates: vec![[[of_stages; 3]; 4]; stages],
            next: Next { state: [zero; NUMBERS], doubt: zero, work: zero, impulse: [zero; 3] },
        }
    }

    /// Brings the drives to the stages of the step of length `h` that begins at the time `begun_s`.
    fn begin(
        &mut self,
        body: &RigidBody<3>,
        begun_s: f64,
        h: f64,
        scheme: &Scheme,
    ) -> Result<(), Failure> {
        let Some(tableau) = scheme.tableau().filter(|_| body.extras() & DRIVEN != 0) else {
            return Ok(());
        };
        let nodes = tableau.nodes().chunks_exact(1);
        self.drives
            .iter_mut()
            .zip(nodes)
            .try_for_each(|(drive, c)| drive.begin(body, begun_s, h, c))
    }

    /// The input of a step whose impulse and work have been computed, by the weights of the tableau.
    fn put_in(&self, scheme: &Scheme, h: f64, work: f64, impulse: Vec3<f64>) -> WorkAndImpulse<3> {
        let mut tables = 0.0;
        for (j, drive) in self.drives.iter().enumerate() {
            let mut weights = Row::splat(0.0);
            weights[0] = scheme.tableau().map_or(0.0, |tableau| h * tableau.b(j));
            tables += drive.tables(&weights);
        }
        let pushes = self.drives.first().is_some_and(Drive::pushes);
        WorkAndImpulse { power: work, torque: pushes.then(|| so::hat(&impulse)), tables }
    }
}

/// Makes a step from `state`, up to its doubts.
#[inline(always)]
fn step<R: StageScalar<StepScalar: StepScalar<Storage = P>>, P: Copy, const EXTRAS: u8>(
    lanes: R,
    scheme: &Scheme,
    body: &RigidBody<3>,
    h: f64,
    state: &[P; NUMBERS],
    scratch: &mut Scratch<P, R::Storage>,
) {
    let whole = lanes.stage(0);
    let Scratch { drives, drives_seen, space, rates, next } = scratch;
    space.clear();
    for v in body.space_vectors() {
        let mut plain = next.impulse;
        for i in 0..3 {
            whole.constant(v[i]).store(&mut plain[i]);
        }
        space.push(plain);
    }
    if EXTRAS & DRIVEN != 0 {
        let zero = whole.constant(0.0);
        let mut identity = [[zero; 3]; 3];
        for i in 0..3 {
            identity[i][i] = whole.constant(1.0);
        }
        for (drive, seen) in drives.iter().zip(&mut *drives_seen) {
            seen.update(lanes, &identity, drive, rates[0][0][0]);
        }
    }
    let mut law = Law {
        body,
        inertia: Inertia::of(body).in_lanes(lanes),
        space,
        drives,
        drives_seen,
        work: whole.constant(0.0),
        impulse: [whole.constant(0.0); 3],
    };
    let mut begun = [lanes; NUMBERS];
    for i in 0..NUMBERS {
        begun[i] = lanes.spread(whole.load(&state[i]));
    }
    let End { state, doubt } = match scheme {
        Scheme::Rk { tableau, projected, .. } => {
            rk::in_vectors::<R, EXTRAS>(tableau, *projected, &mut law, h, &begun, rates)
        }
        Scheme::Rkmk { tableau, matrices } => {
            let terms = matrices.terms();
            rkmk::in_vectors::<R, EXTRAS>(tableau, terms, &mut law, h, &begun, rates)
        }
        Scheme::Splitting(splitting) => splitting.in_vectors::<R, EXTRAS>(&mut law, h, &begun),
    };
    let mut total = lanes.constant(0.0);
    for i in 0..NUMBERS {
        total = total + state[i];
        state[i].stage(0).store(&mut next.state[i]);
    }
    for i in 0..3 {
        law.impulse[i].store(&mut next.impulse[i]);
    }
    law.work.store(&mut next.work);
    // Zero where all is finite.
    (doubt + total * 0.0).stage(0).store(&mut next.doubt);
}

/// An explicit method for one body.
#[derive(Clone, Debug)]
pub struct ExplicitSo3 {
    scheme: Scheme,
    order: u32,
    state: [f64; NUMBERS],
    clock: Clock<3>,
    scratch: Box<Scratch<f64, Row>>,
}

impl ExplicitSo3 {
    /// Creates a stepper by [`Rk`], `projected` or not; `None` for a tableau that is not explicit or has more than twelve stages.
    pub fn rk(tableau: Tableau, projected: bool) -> Option<Self> {
        let matrices = Rk::new(tableau.clone(), projected)?;
        Self::new(Scheme::Rk { tableau, projected, matrices })
    }

    /// Creates a stepper by [`Rkmk`]; `None` for a tableau that is not explicit or has more than twelve stages.
    pub fn rkmk(tableau: Tableau) -> Option<Self> {
        let matrices = Rkmk::new(tableau.clone())?;
        Self::new(Scheme::Rkmk { tableau, matrices })
    }

    /// Creates a stepper by [`Splitting`]; `None` for an order that it does not have.
    pub fn splitting(order: u32) -> Option<Self> {
        Self::new(Scheme::Splitting(Splitting::new(order)?))
    }

    fn new(mut scheme: Scheme) -> Option<Self> {
        let (stages, order) = (scheme.stages(), scheme.matrices().order());
        (stages <= MOST_STAGES).then(|| Self {
            state: scheme.numbers(&State { attitude: Mat::identity(), momentum: Mat::zeros() }),
            scheme,
            order,
            clock: Clock::default(),
            scratch: Box::new(Scratch::new(stages, 0.0, Row::splat(0.0))),
        })
    }
}

impl Stepper<3> for ExplicitSo3 {
    fn order(&self) -> u32 {
        self.order
    }

    fn start(&mut self, state: &State<3>) {
        self.state = self.scheme.numbers(state);
        self.clock = Clock::default();
    }

    fn clock(&self) -> Option<&Clock<3>> {
        Some(&self.clock)
    }

    fn clock_mut(&mut self) -> Option<&mut Clock<3>> {
        Some(&mut self.clock)
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let Self { scheme, state, clock, scratch, .. } = self;
        scheme.see(body);
        if !scheme.knows(body) || scratch.begin(body, clock.time, h, scheme).is_err() {
            return scheme.step_in_matrices(state, clock, body, h);
        }
        let lanes = Rows([0.0; 1]);
        if body.extras() == 0 {
            step::<_, _, 0>(lanes, scheme, body, h, state, scratch);
        } else {
            step::<_, _, { USER | DRIVEN }>(lanes, scheme, body, h, state, scratch);
        }
        let Next { state: next, doubt, work, impulse } = &scratch.next;
        if !(*doubt < 0.0) {
            return scheme.step_in_matrices(state, clock, body, h);
        }
        body.work().begin_sweep()?;
        body.count(scheme.gradients());
        let put_in = if body.is_driven() {
            scratch.put_in(scheme, h, *work, *impulse)
        } else {
            WorkAndImpulse::default()
        };
        *state = *next;
        clock.advance(h, &put_in);
        Ok(Convergence::EXPLICIT)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        Some(self.scheme.state(&self.state).attitude)
    }

    fn momentum(&self) -> Mat<3> {
        self.scheme.state(&self.state).momentum
    }
}

/// Up to eight members of an ensemble side by side, one in each lane.
///
/// Without AVX2 this would gain nothing: then every member is stepped individually. So are those of a body with user-defined
/// potentials, which know no lanes.
#[derive(Clone, Debug)]
pub struct ExplicitEnsemble {
    members: Vec<ExplicitSo3>,
    /// Stepper from which each member starts.
    blank: ExplicitSo3,
    level: Option<Level>,
    state: [Row; NUMBERS],
    /// Whether the lane is ahead of its member, which is written only on request.
    stale: [bool; WIDTH],
    scratch: Box<Scratch<Row, [Row; 1]>>,
    knots: Knots,
}

impl ExplicitEnsemble {
    /// Creates members that step as `blank` does.
    pub fn new(blank: ExplicitSo3) -> Self {
        let zero = Row::splat(0.0);
        let stages = blank.scheme.stages();
        Self {
            members: Vec::new(),
            blank,
            level: Some(Level::new()),
            state: [zero; NUMBERS],
            stale: [false; WIDTH],
            scratch: Box::new(Scratch::new(stages, zero, [zero; 1])),
            knots: Knots::default(),
        }
    }

    /// Returns them on an older instruction set, or without lanes: a test compares the bits, a bench the time.
    pub fn on_level(self, level: Option<Level>) -> Self {
        Self { level, ..self }
    }

    /// Makes the step of all lanes in `scratch`, where lanes can.
    fn step_in_lanes(&mut self, body: &RigidBody<3>, begun_s: f64, h: f64) -> bool {
        let Self { blank, level, state, scratch, .. } = self;
        let (scheme, extras) = (&mut blank.scheme, body.extras());
        let Some(level) = level.filter(|level| has_member_lanes(Some(*level))) else {
            return false;
        };
        scheme.see(body);
        let is_known = extras & USER == 0 && scheme.knows(body);
        if !is_known || scratch.begin(body, begun_s, h, scheme).is_err() {
            return false;
        }
        let scheme = &*scheme;
        in_member_lanes!(level, 1, extras, lanes => {
            step::<_, _, EXTRAS>(lanes, scheme, body, h, state, scratch)
        });
        true
    }

    /// Brings the lane of member `m` up to date.
    fn take_in(&mut self, m: usize) {
        for (row, x) in self.state.iter_mut().zip(&self.members[m].state) {
            row[m] = *x;
        }
    }

    /// Returns member `m`, brought up to date with its lane.
    fn written(&mut self, m: usize) -> &mut ExplicitSo3 {
        let member = &mut self.members[m];
        if std::mem::take(&mut self.stale[m]) {
            member.state = self.state.each_ref().map(|row| row[m]);
        }
        member
    }
}

impl Members<3> for ExplicitEnsemble {
    fn start(&mut self, states: &[State<3>]) {
        let Self { members, blank, state, stale, knots, .. } = self;
        *knots = Knots::default();
        *stale = [false; WIDTH];
        members.resize_with(states.len().min(WIDTH), || blank.clone());
        members.iter_mut().zip(states).for_each(|(member, state)| member.start(state));
        // Unused lanes repeat the others.
        for (lane, member) in members.iter().cycle().take(WIDTH).enumerate() {
            state.iter_mut().zip(&member.state).for_each(|(row, x)| row[lane] = *x);
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
        if going.len() <= FEW
            || self.knots.lie_in(body, begun_s, h)
            || !self.step_in_lanes(body, begun_s, h)
        {
            for &m in going {
                let mut knots = before;
                stepped(m, knots.step(body, self.written(m), begun_s, h));
                self.knots = knots;
                self.take_in(m);
            }
            return;
        }
        let scheme = &self.blank.scheme;
        let Next { state, doubt, work, impulse } = self.scratch.next;
        let mut moves = [false; WIDTH];
        let mut made = [const { None }; WIDTH];
        for &m in going {
            if doubt[m] < 0.0 {
                let counted = body.work().begin_sweep();
                moves[m] = counted.is_ok();
                made[m] = Some(counted.map(|()| Convergence::EXPLICIT));
            }
        }
        let count = moves.iter().filter(|moves| **moves).count();
        body.count(count as u64 * scheme.gradients());
        if body.is_driven() {
            for m in (0..WIDTH).filter(|&m| moves[m]) {
                let impulse = impulse.map(|row| row[m]);
                let put_in = self.scratch.put_in(scheme, h, work[m], impulse);
                self.members[m].clock.advance(h, &put_in);
            }
        }
        if count == WIDTH {
            self.state = state;
            self.stale = moves;
        } else {
            for m in (0..WIDTH).filter(|&m| moves[m]) {
                self.state.iter_mut().zip(&state).for_each(|(row, next)| row[m] = next[m]);
                self.stale[m] = true;
            }
        }
        for &m in going {
            let result = made[m].take().unwrap_or_else(|| {
                let result = self.written(m).step(body, h);
                self.take_in(m);
                result
            });
            stepped(m, result);
        }
    }

    fn member(&mut self, m: usize) -> &mut dyn Stepper<3> {
        self.written(m)
    }
}
