//! VPD in Hamiltonian form for a body of n = 3 that stays in a plane: the map of [`super::vpd`] for n = 2, in complex
//! numbers.
//!
//! Across the axis e the skew matrices are `i` times a number, the stretches numbers, and all of them commute. With
//! `u_j` the turn of stage j from the start, `w_j = h b_j i omega_j u_j` and `e_ij = a_ij / b_j` the equations of
//! [`super::vpd_so3`] become
//!
//! ```text
//! u_i P_i = 1 + sum_j e_ij w_j                    f P_e = 1 + sum_j w_j
//! p1 = p0 - h sum_k b_k tau_k                     -2 P_e lambda = p1
//! N_k = lambda conj(u_k) f + sum_i e_ik x_i conj(u_k) u_i
//! 2 P_k x_k = h b_k (2 omega_k Im N_k - tau_k)    mu_k = -2 Re N_k,    omega_k = mu_k / J
//! ```
//!
//! (`i N_k = conj(u_k) W_k` of there.) Turn and momentum are sums, and their parts lost to
//! rounding are carried.
//!
//! Invariant: components across the axis stay zero to the bit. A start that is not in the plane,
//! and a step that cannot be solved here, go the way of n = 3, which also says why it fails.

use nalgebra::Complex;

use super::Stepper;
use super::checks::{SMALLEST_SINGULAR_VALUE, check_continuity};
use crate::compensated::{Sum, two_sum};
use crate::failure::{Failure, FailureCode};
use crate::hamiltonian::RigidBody;
use crate::nonlinear::{Convergence, Equations, SMALLEST_SIZE, Solver, StopRule, relative};
use crate::so::{self, Mat, Vector};
use crate::state::State;
use crate::tableau::Tableau;

/// Passes over the turns, and over the linear system of x, within a sweep: a torque costs more than they.
const KINEMATIC_PASSES: usize = 3;
const LINEAR_PASSES: usize = 2;
/// Distance from the plane that rounding may give an attitude.
const OFF_PLANE: f64 = 1e-14;

/// A plane of space in which a body moves.
#[derive(Clone, Debug)]
pub struct Plane {
    /// The axis of the body across it.
    axis: usize,
    /// The attitude from which turns are counted.
    frame: Mat<3>,
    /// The body in the plane, space seen from that attitude.
    body: RigidBody<2>,
}

impl Plane {
    /// The plane in which `body` stays if it starts from `state`; `None` if it leaves every one.
    pub fn of(body: &RigidBody<3>, state: &State<3>) -> Option<Self> {
        let frame = state.attitude;
        (0..3)
            .filter(|&axis| is_about(axis, &state.momentum))
            .find_map(|axis| Some(Self { axis, frame, body: body.across(axis, &frame)? }))
    }

    /// Returns turn and momentum of a state in the plane; `None` for any other.
    fn coordinates(&self, state: &State<3>) -> Option<(Complex<f64>, f64)> {
        let [i, j, k] = self.axes();
        let turned = self.frame.tr_mul(&state.attitude);
        let off = [turned[(i, k)], turned[(j, k)], turned[(k, k)] - 1.0];
        let inside = off.iter().all(|x| x.abs() <= OFF_PLANE) && is_about(k, &state.momentum);
        let turn = Complex::new(
            0.5 * (turned[(i, i)] + turned[(j, j)]),
            0.5 * (turned[(j, i)] - turned[(i, j)]),
        );
        inside.then(|| (turn / turn.norm_sqr().sqrt(), state.momentum[(j, i)]))
    }

    /// The attitude after a turn.
    fn attitude(&self, turn: Complex<f64>) -> Mat<3> {
        let [i, j, k] = self.axes();
        let mut turned = Mat::<3>::zeros();
        (turned[(i, i)], turned[(i, j)]) = (turn.re, -turn.im);
        (turned[(j, i)], turned[(j, j)]) = (turn.im, turn.re);
        turned[(k, k)] = 1.0;
        so::orthonormalised(&so::product(&self.frame, &turned))
    }

    /// The axes of the plane, and that across it.
    fn axes(&self) -> [usize; 3] {
        [(self.axis + 1) % 3, (self.axis + 2) % 3, self.axis]
    }
}

/// Is the momentum along the body's axis `k`, or zero?
fn is_about(k: usize, momentum: &Mat<3>) -> bool {
    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
    momentum[(k, i)] == 0.0 && momentum[(k, j)] == 0.0
}

/// The stepper: the step in the plane, and the one for n = 3.
pub struct VpdPlane {
    plane: Plane,
    space: Box<dyn Stepper<3>>,
    /// Does the body move in the plane? Else `space` has it.
    inside: bool,
    turn: Complex<f64>,
    /// Part of the turn lost to rounding.
    turn_carry: Complex<f64>,
    momentum: Sum<f64>,
    tableau: Tableau,
    /// `a_ij` row by row, and `e_ik` column by column.
    rows: Vec<f64>,
    columns: Vec<f64>,
    solver: Solver,
    step: Step,
    seen: Vec<Vector<2>>,
}

impl VpdPlane {
    /// With three stages and more the lanes of n = 3 are as fast. Of their time one stage takes 0.4 to 0.8 and two take 0.7
    /// to 0.8: `vpd run` on a pendulum with a spring, and in a gravity gradient.
    pub const MOST_STAGES: usize = 2;

    /// Creates a stepper for `tableau` that solves each step until `stop`; `space` is the same for
    /// n = 3.
    pub fn new(plane: Plane, tableau: Tableau, stop: StopRule, space: Box<dyn Stepper<3>>) -> Self {
        let stages = tableau.stages();
        // A sweep is cheap here, and with one stage, stopping one iteration early shows in the energy: 4e-13 in 200 steps of a
        // pendulum.
        let stop = StopRule { stop_early: false, ..stop };
        let places = (0..stages * stages).map(|at| (at / stages, at % stages));
        let rows = places.clone().map(|(i, j)| tableau.a(i, j)).collect();
        let columns = places.map(|(k, i)| tableau.a(i, k) / tableau.b(k)).collect();
        Self {
            plane,
            space,
            inside: false,
            turn: Complex::new(1.0, 0.0),
            turn_carry: Complex::new(0.0, 0.0),
            momentum: Sum::default(),
            step: Step::new(stages),
            tableau,
            rows,
            columns,
            solver: Solver::new(stop),
            seen: Vec::new(),
        }
    }

    /// The momentum, about the axis.
    fn about_axis(&self) -> Mat<3> {
        let mut vector = [0.0; 3];
        vector[self.plane.axis] = self.momentum.value;
        so::hat(&vector)
    }

    /// Solves the step in the plane and advances by it.
    fn step_in_plane(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        let Self { plane, turn, momentum, tableau, rows, columns, solver, step, seen, .. } = self;
        plane.body.seen_from(&matrix(*turn), seen);
        let gradients = plane.body.work().gradients();
        let (plane, p0) = (&plane.body, momentum.value);
        let mut equations = Sweeps { tableau, rows, columns, body, plane, seen, h, p0, step };
        let solved = solver.solve(&mut equations).and_then(|solved| {
            equations.check()?;
            Ok(solved)
        });
        body.count(plane.work().gradients() - gradients);
        let solved = solved?;
        self.advance();
        Ok(solved)
    }

    fn advance(&mut self) {
        let Step { end, impulse, .. } = &self.step;
        let f = end.turn;
        // f - 1, with 1 - cos = sin^2 / (1 + cos)
        let change = Complex::new(-f.im * f.im / (1.0 + f.re), f.im);
        // The deficit of the length from one; the carried part turns along.
        let norm_error = 0.5 * (1.0 - self.turn.norm_sqr());
        let change = self.turn * change + (self.turn_carry * f + self.turn * f * norm_error);
        let (re, lost_re) = two_sum(self.turn.re, change.re);
        let (im, lost_im) = two_sum(self.turn.im, change.im);
        self.turn = Complex::new(re, im);
        self.turn_carry = Complex::new(lost_re, lost_im);
        self.momentum.add(*impulse);
    }
}

impl Stepper<3> for VpdPlane {
    fn order(&self) -> u32 {
        self.tableau.order()
    }

    fn start(&mut self, state: &State<3>) {
        let found = self.plane.coordinates(state);
        self.inside = found.is_some();
        match found {
            Some((turn, momentum)) => {
                (self.turn, self.momentum) = (turn, Sum::new(momentum, 0.0));
                self.turn_carry = Complex::new(0.0, 0.0);
            }
            None => self.space.start(state),
        }
    }

    fn step(&mut self, body: &RigidBody<3>, h: f64) -> Result<Convergence, Failure> {
        if self.inside {
            match self.step_in_plane(body, h) {
                Err(failure) if failure.code != FailureCode::Stopped => {
                    let attitude = self.plane.attitude(self.turn);
                    self.space.start(&State { attitude, momentum: self.about_axis() });
                    self.inside = false;
                }
                solved => return solved,
            }
        }
        self.space.step(body, h)
    }

    fn attitude(&self) -> Option<Mat<3>> {
        if self.inside { Some(self.plane.attitude(self.turn)) } else { self.space.attitude() }
    }

    fn momentum(&self) -> Mat<3> {
        if self.inside { self.about_axis() } else { self.space.momentum() }
    }

    fn sigma_min(&self) -> Option<f64> {
        if !self.inside {
            return self.space.sigma_min();
        }
        // Across the plane nothing is stretched.
        Some(self.step.points().map(|point| point.stretch).fold(1.0, f64::min))
    }
}

/// `e^(i angle)` to seventh order, of length one: the diagonal approximant of Pade.
fn turn(angle: f64) -> Complex<f64> {
    let square = angle * angle;
    let half = Complex::new(120.0 - 12.0 * square, angle * (60.0 - square));
    half * half / half.norm_sqr()
}

fn matrix(turn: Complex<f64>) -> Mat<2> {
    Mat::<2>::new(turn.re, -turn.im, turn.im, turn.re)
}

/// A turn and its stretch: polar coordinates.
#[derive(Clone, Copy, Debug)]
struct Point {
    turn: Complex<f64>,
    stretch: f64,
}

impl Point {
    /// Splits a number into turn and stretch.
    fn of(z: Complex<f64>) -> Self {
        let stretch = z.norm_sqr().sqrt();
        Self { turn: z / stretch, stretch }
    }
}

/// The unknowns of a stage.
#[derive(Clone, Copy, Debug)]
struct Stage {
    point: Point,
    mu: f64,
    omega: f64,
    /// `i omega u`
    rate: Complex<f64>,
    tau: f64,
    x: f64,
}

/// The unknowns of a step.
#[derive(Clone, Debug)]
struct Step {
    stages: Vec<Stage>,
    end: Point,
    /// p1 - p0
    impulse: f64,
    /// The unit of momenta.
    unit: f64,
    /// `conj(u_k) u_i`, row by row.
    between: Vec<Complex<f64>>,
}

impl Step {
    fn new(stages: usize) -> Self {
        let zero = Complex::new(0.0, 0.0);
        let end = Point { turn: Complex::new(1.0, 0.0), stretch: 1.0 };
        let stage = Stage { point: end, mu: 0.0, omega: 0.0, rate: zero, tau: 0.0, x: 0.0 };
        let between = vec![zero; stages * stages];
        Self { stages: vec![stage; stages], end, impulse: 0.0, unit: 1.0, between }
    }

    fn points(&self) -> impl Iterator<Item = &Point> {
        self.stages.iter().map(|stage| &stage.point).chain([&self.end])
    }
}

/// A step being solved.
struct Sweeps<'a> {
    tableau: &'a Tableau,
    rows: &'a [f64],
    columns: &'a [f64],
    /// The body whose work is counted.
    body: &'a RigidBody<3>,
    plane: &'a RigidBody<2>,
    seen: &'a [Vector<2>],
    h: f64,
    p0: f64,
    step: &'a mut Step,
}

impl Sweeps<'_> {
    /// 1 / J
    fn weight(&self) -> f64 {
        self.plane.velocity(&Mat::<2>::new(0.0, -1.0, 1.0, 0.0))[(1, 0)]
    }

    fn torque(&self, turn: Complex<f64>) -> f64 {
        if self.plane.is_free() {
            0.0
        } else {
            self.plane.gradient_seen(&matrix(turn), self.seen)[(1, 0)]
        }
    }

    /// Refuses a solution whose turns are ill-conditioned or jump, or at which the potential is singular; the bounds are those of n = 3.
    fn check(&self) -> Result<(), Failure> {
        let Step { stages, end, .. } = &*self.step;
        for point in self.step.points() {
            if !(point.stretch >= SMALLEST_SINGULAR_VALUE) {
                let (found, limit) = (point.stretch, SMALLEST_SINGULAR_VALUE);
                return Err(Failure::new(FailureCode::IllConditioned, None, found, limit));
            }
        }
        let ascending = self.tableau.ascending().iter().map(|&k| stages[k].point.turn);
        let nodes = ascending.chain([end.turn]).map(|turn| (None, turn));
        let cosine = |u: &Complex<f64>, v: &Complex<f64>| (u.conj() * v).re;
        check_continuity(Complex::new(1.0, 0.0), nodes, 0.0, cosine)?;
        stages.iter().try_for_each(|stage| {
            self.plane.check_distances_seen(&matrix(stage.point.turn), self.seen)
        })
    }

    /// Returns the units of turns and of pushes.
    fn units(&self) -> [f64; 2] {
        [self.step.unit * self.weight(), self.h.abs() * self.step.unit]
    }
}

impl Equations for Sweeps<'_> {
    /// Guesses with the torque at the beginning, kept constant, and one round of plain collocation
    /// from there.
    fn guess(&mut self) -> Result<(), Failure> {
        let (h, p0, weight) = (self.h, self.p0, self.weight());
        let s = self.step.stages.len();
        let tau = self.torque(Complex::new(1.0, 0.0));
        let size = p0.abs().max((h * tau).abs());
        self.step.unit = if size >= SMALLEST_SIZE { size } else { 1.0 };
        for k in 0..s {
            let elapsed = h * self.tableau.c(k);
            let turn = turn(elapsed * weight * (p0 - 0.5 * elapsed * tau));
            self.step.stages[k].tau = self.torque(turn);
        }
        let stages = &mut self.step.stages;
        for k in 0..s {
            let row = &self.rows[k * s..][..s];
            stages[k].mu = p0 - h * (0..s).map(|j| row[j] * stages[j].tau).sum::<f64>();
        }
        for k in 0..s {
            let row = &self.rows[k * s..][..s];
            let angle = h * weight * (0..s).map(|j| row[j] * stages[j].mu).sum::<f64>();
            let stage = &mut stages[k];
            stage.point = Point { turn: turn(angle), stretch: 1.0 };
            stage.omega = weight * stage.mu;
            stage.rate = Complex::new(0.0, stage.omega) * stage.point.turn;
            stage.x = -0.5 * h * self.tableau.b(k) * stage.tau;
        }
        Ok(())
    }

    fn sweep(&mut self) -> Result<f64, Failure> {
        self.body.work().begin_sweep()?;
        let (h, p0, weight) = (self.h, self.p0, self.weight());
        let Self { tableau, rows, columns, .. } = *self;
        let s = self.step.stages.len();
        let stages = &mut self.step.stages;
        let mut turned = 0.0;
        for _ in 0..KINEMATIC_PASSES {
            turned = 0.0;
            for i in 0..s {
                let mut d = Complex::new(0.0, 0.0);
                for (a, stage) in rows[i * s..][..s].iter().zip(&*stages) {
                    d += stage.rate * *a;
                }
                let stage = &mut stages[i];
                let before = stage.point.turn;
                stage.point = Point::of(d * h + 1.0);
                let change = stage.point.turn - before;
                turned = change.re.abs().max(change.im.abs()).max(turned);
                stage.rate = Complex::new(0.0, stage.omega) * stage.point.turn;
            }
        }
        for k in 0..s {
            self.step.stages[k].tau = self.torque(self.step.stages[k].point.turn);
        }
        let Step { stages, end, impulse, between, .. } = &mut *self.step;
        let (mut d, mut torque_sum) = (Complex::new(0.0, 0.0), 0.0);
        for (k, stage) in stages.iter().enumerate() {
            d += stage.rate * tableau.b(k);
            torque_sum += tableau.b(k) * stage.tau;
        }
        (*end, *impulse) = (Point::of(d * h + 1.0), -h * torque_sum);
        let lambda = -0.5 * (p0 + *impulse) / end.stretch;
        for k in 0..s {
            let back = stages[k].point.turn.conj();
            for i in 0..s {
                between[k * s + i] = back * stages[i].point.turn;
            }
        }
        // N_k
        let embedded = |stages: &[Stage], k: usize| {
            let mut n = stages[k].point.turn.conj() * end.turn * lambda;
            for i in 0..s {
                n += between[k * s + i] * (columns[k * s + i] * stages[i].x);
            }
            n
        };
        for _ in 0..LINEAR_PASSES {
            for k in 0..s {
                let n = embedded(stages, k);
                let Stage { omega, tau, point, .. } = stages[k];
                stages[k].x = 0.5 * h * tableau.b(k) * (2.0 * omega * n.im - tau) / point.stretch;
            }
        }
        let (mut change, mut size) = (0.0_f64, p0.abs());
        for k in 0..s {
            let mu = -2.0 * embedded(stages, k).re;
            if !mu.is_finite() {
                return Err(Failure::not_finite(Some(k)));
            }
            let stage = &mut stages[k];
            change = change.max((mu - stage.mu).abs());
            size = size.max(mu.abs());
            (stage.mu, stage.omega) = (mu, weight * mu);
            stage.rate = Complex::new(0.0, stage.omega) * stage.point.turn;
        }
        // The change of the momenta, or of a turn in the last pass.
        let change = relative(change, size);
        Ok(change.max(turned))
    }

    fn unknowns(&self, values: &mut Vec<f64>) {
        let [turn, momentum] = self.units();
        for stage in &self.step.stages {
            let Stage { rate, omega, x, .. } = stage;
            values.extend([rate.re / turn, rate.im / turn, omega / turn, x / momentum]);
        }
    }

    fn set(&mut self, values: &[f64]) {
        let ([turn, momentum], weight) = (self.units(), self.weight());
        for (stage, values) in self.step.stages.iter_mut().zip(values.as_chunks::<4>().0) {
            let [re, im, omega, x] = *values;
            stage.rate = Complex::new(re, im) * turn;
            (stage.omega, stage.x) = (omega * turn, x * momentum);
            // Against it the next sweep is measured.
            stage.mu = stage.omega / weight;
        }
    }
}
