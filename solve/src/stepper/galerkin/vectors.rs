//! The step of [`super`] for a rigid body with n = 3 in a time of its own, in quaternions and
//! vectors: [`super::deferred`] with the attitudes collocated, too.
//!
//! With the tags of docs/derivation.md, `r_j = h b_j u_j Omega_j / 2` and vectors in place of skew
//! matrices,
//!
//! ```text
//! [turn]       u_k = 1 + sum_j e_kj r_j + theta_k
//! [transport]  pi_k = p0 - sum_j e_kj kappa_j + delta_k          kappa_j = h b_j U_j vee(dH~/dg(U_j))
//! [defect]     delta_k = vee(asym(f Lambda K_k^T) - asym(Y_k C_k^T) - sum_j e_kj asym(T_j D_j^T - Y_j w_j^T))
//! ```
//!
//! theta makes the quaternion u_k the polar factor of `I + D_k`. With theta and delta zero this is
//! collocation of quaternion and momentum; both are of order h^(s+1). So an inner pass takes seven
//! sums over the stages, and products of matrices are formed where theta and delta are evaluated.
//!
//! In a time of its own `Omega = sigma J^-1 mu` (with wheels, mu less their momentum), and dH~/dg is the gradient of
//! `H~ = sigma (H - H0)`. Between two torques both follow the momenta and, to first order, the
//! attitudes: with `eta = 2 vec(conj(u') u)`, u' being the attitude at which the torque was evaluated,
//!
//! ```text
//! potential = potential' + vee(dH/dg) . eta,      sigma^-2 = sigma'^-2 + vee(dsigma^-2/dg) . eta
//! ```
//!
//! Invariant: a step that is not solved here to round-off is left to [`super`].

use fearless_simd::{Level, f64x2, f64x4, f64x8, prelude::*};

use super::convergence::{
    COLLOCATION_ROUND_OFF, Contraction, LAST_DIGIT, LEAST_SCALE, MOST_ITERATIONS,
    PASSES_BETWEEN_TORQUES, PASSES_PER_DEFECT, PATIENCE, ROUND_OFF, SMALL_STRETCH, SolveError,
    Solved, TORQUE_CONTRACTION,
};
use crate::hamiltonian::{RigidBody, Scale, StageForces};
use crate::lanes::{Real, Row, Rows, StageScalar, in_lanes, widest};
use crate::nonlinear::SMALLEST_SIZE;
use crate::so::Mat;
use crate::space::{
    Mat3, Quaternion, Sym3, Vec3, cross, dot, mat3, minus, plus, product, scaled,
    symmetric_product, times_hat, transposed_product, vec3, with_one,
};
use crate::stepper::motion::unsigned_zeros;
use crate::stepper::so3_equations::{
    Inertia, defect, embedded, inverse_of_q, over_q, residual, store, stretch_of,
};
use crate::tableau::{Tableau, TableauInLanes};

/// Start of a step.
pub(super) struct Start {
    pub(super) h: f64,
    /// As in [`super::deferred::StepStart`].
    pub(super) lasting: Option<f64>,
    pub(super) momentum: Vec3<f64>,
    pub(super) velocity: Vec3<f64>,
}

/// Solver in vectors, kept from step to step.
#[derive(Clone, Debug)]
pub(super) struct InVectors {
    tableau: TableauInLanes,
    /// The instruction set; without one, one number at a time.
    pub(super) level: Option<Level>,
    seen: Vec<Vec3<f64>>,
    values: StageValues,
}

/// Solution of a step.
#[derive(Clone, Debug)]
pub(super) struct StageValues {
    attitude: Quaternion<Row>,
    mu: Vec3<Row>,
    omega: Vec3<Row>,
    stretch: Sym3<Row>,
    sigma: Row,
    end: Quaternion<f64>,
    end_stretch: Sym3<f64>,
    impulse: Vec3<f64>,
    momentum_increment: Vec3<f64>,
}

impl InVectors {
    /// Creates the solver for `tableau`; `None` if the tableau is not symplectic, or has more
    /// stages than there are lanes.
    pub(super) fn new(tableau: &Tableau) -> Option<Self> {
        if !tableau.is_symplectic() {
            return None;
        }
        let zero = Row::splat(0.0);
        let values = StageValues {
            attitude: Quaternion { w: Row::splat(1.0), v: [zero; 3] },
            mu: [zero; 3],
            omega: [zero; 3],
            stretch: [zero; 6],
            sigma: Row::splat(1.0),
            end: Quaternion { w: 1.0, v: [0.0; 3] },
            end_stretch: [0.0; 6],
            impulse: [0.0; 3],
            momentum_increment: [0.0; 3],
        };
        let (tableau, seen) = (TableauInLanes::new(tableau)?, Vec::new());
        Some(Self { tableau, level: Some(Level::new()), seen, values })
    }

    /// Solves a step of `body` in the time of `scale`; `seen` are its space vectors as seen from
    /// the beginning of the step.
    ///
    /// # Errors
    /// [`SolveError`].
    pub(super) fn solve(
        &mut self,
        start: &Start,
        body: &RigidBody<3>,
        vectors: impl Iterator<Item = Vec3<f64>>,
        scale: Scale<'_>,
    ) -> Result<Solved, SolveError> {
        self.seen.clear();
        self.seen.extend(vectors);
        self.solve_seen(start, body, scale)
    }

    /// Solves a step with the space vectors in `seen`: not generic, so that it is compiled here and
    /// nowhere else.
    fn solve_seen(
        &mut self,
        start: &Start,
        body: &RigidBody<3>,
        scale: Scale<'_>,
    ) -> Result<Solved, SolveError> {
        let Self { tableau, level, seen, values } = self;
        let (inertia, wheels) = (Inertia::of(body), body.wheels());
        let data = StepData { tableau, body, seen, scale, inertia, wheels, start };
        let data = &data;
        match (tableau.stages, *level) {
            (1, _) => solve(Rows([0.0; 1]), data, values),
            (2, Some(level)) => {
                widest!(level below Avx512, f64x2, lanes => solve(lanes, data, values), else solve(Rows([0.0; 2]), data, values))
            }
            (2, None) => solve(Rows([0.0; 2]), data, values),
            (3 | 4, Some(level)) => {
                widest!(level below Avx512, f64x4, lanes => solve(lanes, data, values), else solve(Rows([0.0; 4]), data, values))
            }
            (3 | 4, None) => solve(Rows([0.0; 4]), data, values),
            (_, Some(level)) => {
                widest!(level, f64x8, lanes => solve(lanes, data, values), else solve(Rows([0.0; 8]), data, values))
            }
            (_, None) => solve(Rows([0.0; 8]), data, values),
        }
    }

    /// `U_k - I`, or `f - I` after the last stage.
    pub(super) fn change(&self, k: usize) -> Mat<3> {
        let attitude = if k == self.tableau.stages {
            self.values.end
        } else {
            let Quaternion { w, v } = &self.values.attitude;
            Quaternion { w: w[k], v: vec3!(i => v[i][k]) }
        };
        let change = attitude.change();
        Mat::from_fn(|i, j| change[i][j])
    }

    /// vee of `pi1 - p0`.
    pub(super) fn impulse(&self) -> Vec3<f64> {
        self.values.impulse
    }

    /// vee of `p1 - p0`.
    pub(super) fn momentum_increment(&self) -> Vec3<f64> {
        self.values.momentum_increment
    }

    /// vee(mu_k) and vee(Omega_k).
    pub(super) fn motion(&self, k: usize) -> [Vec3<f64>; 2] {
        let StageValues { mu, omega, .. } = &self.values;
        [vec3!(i => mu[i][k]), vec3!(i => omega[i][k])]
    }

    /// sigma_k.
    pub(super) fn sigma(&self, k: usize) -> f64 {
        self.values.sigma[k]
    }

    /// `P_k - I`, or that of the end after the last stage.
    pub(super) fn stretch(&self, k: usize) -> Mat<3> {
        let stretch = if k == self.tableau.stages {
            self.values.end_stretch
        } else {
            self.values.stretch.each_ref().map(|row| row[k])
        };
        let [xx, yy, zz, yz, xz, xy] = stretch;
        Mat::<3>::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }
}

/// Inputs that are the same in all passes.
struct StepData<'a> {
    tableau: &'a TableauInLanes,
    body: &'a RigidBody<3>,
    seen: &'a [Vec3<f64>],
    scale: Scale<'a>,
    inertia: Inertia<f64>,
    wheels: Option<Vec3<f64>>,
    start: &'a Start,
}

fn solve<R: StageScalar<StepScalar = f64, Storage = Row>>(
    lanes: R,
    data: &StepData<'_>,
    values: &mut StageValues,
) -> Result<Solved, SolveError> {
    let step = lanes.vectorized(
        #[inline(always)]
        || Step::new(lanes, data),
    );
    step.solve(values)
}

/// A step being solved.
struct Step<'a, R> {
    lanes: R,
    data: &'a StepData<'a>,
    h: f64,
    /// h b
    weight: R,
    p0: Vec3<R>,
    /// u.
    attitude: Quaternion<R>,
    /// pi - p0
    momentum_increment: Vec3<R>,
    mu: Vec3<R>,
    omega: Vec3<R>,
    /// Values evaluated at the attitudes, and these attitudes.
    forces: StageForces<R>,
    at: Quaternion<R>,
    sigma: R,
    /// vee(dH~/dg).
    gradient: Vec3<R>,
    kappa: Vec3<R>,
    theta: Quaternion<R>,
    delta: Vec3<R>,
    x: Vec3<R>,
    y: Mat3<R>,
    w: Mat3<R>,
    d: Mat3<R>,
    /// P - I and Q(P)^-1 - I / 2.
    stretch: Sym3<R>,
    inverse: Sym3<R>,
    f: Quaternion<f64>,
    end_stretch: Sym3<f64>,
    /// f hat(Lambda)
    f_lambda: Mat3<f64>,
    evaluations: u32,
}

impl<'a, R: StageScalar<StepScalar = f64, Storage = Row>> Step<'a, R> {
    #[inline(always)]
    fn lanes(&self) -> R {
        self.lanes
    }

    /// Creates a step whose guess keeps the initial velocity constant.
    #[inline(always)]
    fn new(lanes: R, data: &'a StepData<'a>) -> Self {
        let TableauInLanes { weights, nodes, .. } = data.tableau;
        let Start { h, momentum, velocity, .. } = data.start;
        let half = lanes.row(nodes) * (0.5 * h);
        let attitude = Quaternion::cayley(&vec3!(i => half * velocity[i]));
        let p0: Vec3<R> = vec3!(i => lanes.spread(momentum[i]));
        let zero = lanes.constant(0.0);
        let none = [zero; 3];
        let forces = StageForces {
            torque: none,
            proximity: zero,
            potential: zero,
            sum: lanes.constant(1.0),
            of_sum: none,
        };
        Self {
            lanes,
            data,
            h: *h,
            weight: lanes.row(weights) * *h,
            p0,
            attitude,
            momentum_increment: none,
            mu: p0,
            omega: vec3!(i => lanes.spread(velocity[i])),
            forces,
            at: attitude,
            sigma: lanes.constant(1.0),
            gradient: none,
            kappa: none,
            theta: Quaternion { w: zero, v: none },
            delta: none,
            x: none,
            y: [none; 3],
            w: [none; 3],
            d: [none; 3],
            stretch: [zero; 6],
            inverse: [zero; 6],
            f: Quaternion { w: 1.0, v: [0.0; 3] },
            end_stretch: [0.0; 6],
            f_lambda: [[0.0; 3]; 3],
            evaluations: 0,
        }
    }

    fn solve(mut self, values: &mut StageValues) -> Result<Solved, SolveError> {
        let stages = self.data.tableau.stages;
        self.evaluate_forces()?;
        self.guess_momenta();
        let angle = self.collocate()?;
        let order = self.data.tableau.order_of_defect(angle);
        let first = if stages == 1 { angle } else { angle * angle };
        let mut evaluations = Contraction::new((0.4 * first).clamp(1e-4, 0.1), order);
        let mut last = f64::INFINITY;
        for evaluation in 1..=MOST_ITERATIONS {
            let jump = self.evaluate()?;
            if !(jump <= 1.0) || (evaluation > PATIENCE && jump > last.max(1e-12)) {
                break;
            }
            let floor = evaluations.at_floor(jump, 1.0);
            let left = evaluations.left(jump);
            let enough = 0.1 * left.max(LAST_DIGIT * ROUND_OFF);
            let mut passes = Contraction::new(contraction_of_a_pass(angle), jump);
            for _ in 0..PASSES_PER_DEFECT {
                if passes.left(self.inner_pass()) <= enough {
                    break;
                }
            }
            // With few stages the first evaluation has not reached its order yet.
            let is_sure = stages >= 4 || evaluation > 1;
            if (is_sure && left <= LAST_DIGIT * ROUND_OFF) || floor {
                let increment = self.finish(angle, jump)?;
                let lanes = self.lanes;
                return Ok(lanes.vectorized(
                    #[inline(always)]
                    || self.judged(increment, values),
                ));
            }
            last = jump;
        }
        Err(SolveError::NotConverged)
    }

    /// Evaluates the forces at the current attitudes.
    fn evaluate_forces(&mut self) -> Result<(), SolveError> {
        let StepData { tableau, body, .. } = self.data;
        let work = body.work();
        work.begin_sweep()?;
        work.add_gradients(tableau.stages as u64);
        self.evaluate_forces_in_lanes();
        Ok(())
    }

    in_lanes! {
    /// Evaluates the body for [`Step::evaluate_forces`], and the length of a step that is to last a given
    /// time.
    fn evaluate_forces_in_lanes(&mut self) {
        let StepData { tableau, body, seen, scale, start, .. } = self.data;
        self.forces = body.evaluate_forces(scale, &self.attitude.matrix(), seen);
        self.at = self.attitude;
        self.momenta();
        if let Some(lasting) = start.lasting {
            let weights = self.lanes.row(&tableau.weights);
            self.h = lasting / (weights * self.sigma).sum();
            self.weight = weights * self.h;
        }
    }
    }

    in_lanes! {
    /// Guesses the momenta as if the force at a stage had acted until then.
    fn guess_momenta(&mut self) {
        let elapsed = self.lanes.row(&self.data.tableau.nodes) * self.h;
        let impulse = product(&self.attitude.matrix(), &self.gradient);
        self.momentum_increment = vec3!(i => -(impulse[i] * elapsed));
        self.momenta();
    }

    /// Returns the largest turn of a velocity over the step.
    fn angle(&mut self) -> f64 {
        self.h.abs() * dot(&self.omega, &self.omega).largest().sqrt()
    }

    /// [transport] with the newest forces.
    fn transported(&mut self) {
        self.transport();
    }

    }

    /// Updates mu, Omega and what depends on them: `J^-1 U^T pi = J^-1 pi + J^-1 (U - I)^T pi`.
    #[inline(always)]
    fn momenta(&mut self) {
        let StepData { scale, inertia, wheels, .. } = self.data;
        let inertia = inertia.in_lanes(self.lanes);
        let pi = plus(&self.p0, &self.momentum_increment);
        let turned = transposed_product(&self.attitude.change(), &pi);
        self.mu = plus(&pi, &turned);
        let mut omega = plus(&inertia.divides(&pi), &inertia.divides(&turned));
        let mut own = self.mu;
        if let Some(wheels) = wheels {
            let wheels: Vec3<R> = vec3!(i => self.lanes.spread(wheels[i]));
            omega = minus(&omega, &inertia.divides(&wheels));
            own = minus(&own, &wheels);
        }
        let StageForces { torque, potential, sum, of_sum, .. } = &self.forces;
        let (a, u) = (&self.at, &self.attitude);
        let c = cross(&u.v, &a.v);
        let eta: Vec3<R> = vec3!(i => ((a.w * u.v[i] - u.w * a.v[i]) + c[i]) * 2.0);
        let sum = (*sum + dot(of_sum, &eta)).max_or_nan(*sum * LEAST_SCALE);
        self.sigma = self.lanes.constant(1.0) / sum.sqrt();
        let sigma = self.sigma;
        let potential = *potential + dot(torque, &eta);
        let above = dot(&own, &omega) * 0.5 + (potential + -scale.energy);
        let factor = above * (sigma * sigma * sigma) * -0.5;
        self.gradient = vec3!(i => sigma * torque[i] + factor * of_sum[i]);
        self.omega = scaled(&omega, sigma);
    }

    /// `sum_j e_kj r_j`
    #[inline(always)]
    fn collocated(&self) -> Quaternion<R> {
        let columns = &self.data.tableau.columns;
        let rate = self.attitude.rate(&scaled(&self.omega, self.weight * 0.5));
        Quaternion {
            w: rate.w.apply_tableau(columns),
            v: vec3!(i => rate.v[i].apply_tableau(columns)),
        }
    }

    in_lanes! {
    /// An inner pass: updates the attitudes by [turn], and the momenta there. Returns the largest change of an
    /// attitude.
    fn inner_pass(&mut self) -> f64 {
        let Quaternion { w, v } = self.collocated();
        let theta = &self.theta;
        let next = Quaternion { w: (w + theta.w) + 1.0, v: plus(&v, &theta.v) };
        let next = next.lengthened_by_w();
        let change = minus(&next.v, &self.attitude.v);
        self.attitude = next;
        self.transport();
        self.momenta();
        largest(&change)
    }
    }

    /// [transport]
    #[inline(always)]
    fn transport(&mut self) {
        let columns = &self.data.tableau.columns;
        let u = self.attitude.matrix();
        self.kappa = scaled(&product(&u, &self.gradient), self.weight);
        self.momentum_increment = vec3!(i => self.delta[i] - self.kappa[i].apply_tableau(columns));
    }

    /// Solves the collocation until the error left is smaller than the defects. Returns the largest
    /// turn of a velocity over the step.
    fn collocate(&mut self) -> Result<f64, SolveError> {
        let mut last = f64::INFINITY;
        for torques in 0..MOST_ITERATIONS {
            let first = self.inner_pass();
            let angle = self.angle();
            let enough =
                (0.1 * self.data.tableau.order_of_defect(angle)).max(COLLOCATION_ROUND_OFF);
            let mut passes = Contraction::new(contraction_of_a_pass(angle), first);
            let (mut change, mut of_passes) = (first, first * contraction_of_a_pass(angle));
            for _ in 0..PASSES_BETWEEN_TORQUES {
                if of_passes <= enough {
                    break;
                }
                change = self.inner_pass();
                of_passes = passes.left(change);
            }
            if !(change <= 2.0) || (torques > PATIENCE && first > 0.5 * last) {
                break;
            }
            // Errors left by the passes, and by the torques.
            let seen =
                if last < f64::INFINITY { (first / last).min(1.0) } else { TORQUE_CONTRACTION };
            if of_passes.max(first * seen) <= enough {
                return Ok(angle);
            }
            last = first;
            self.evaluate_forces()?;
        }
        Err(SolveError::NotConverged)
    }

    /// Evaluates theta and delta, with new forces. Returns their largest change, that of delta
    /// relative to the momentum.
    fn evaluate(&mut self) -> Result<f64, SolveError> {
        self.evaluations += 1;
        let turned = self.polar_factors();
        self.evaluate_forces()?;
        self.transported();
        let is_stretched = self.largest_stretch() > SMALL_STRETCH;
        if self.evaluations == 1 || is_stretched {
            self.end(is_stretched);
        }
        Ok(Real::max_or_nan(turned, self.defects()))
    }

    in_lanes! {
    /// [w], [D] and [turn]. Returns the largest change of theta.
    fn polar_factors(&mut self) -> f64 {
        let columns = &self.data.tableau.columns;
        let u = self.attitude.matrix();
        let w = times_hat(&u, &scaled(&self.omega, self.weight));
        let d: Mat3<R> = mat3!(i, j => w[i][j].apply_tableau(columns));
        self.stretch = stretch_of(&self.attitude, &u, &d);
        self.inverse = inverse_of_q(&self.stretch);
        let half = over_q(&self.inverse, &residual(&self.attitude, &u, &d));
        let polar = self.attitude.turned(&scaled(&half, self.lanes.constant(0.5)));
        let Quaternion { w: along, v } = self.collocated();
        let theta = Quaternion { w: (polar.w + -1.0) - along, v: minus(&polar.v, &v) };
        let turned = minus(&theta.v, &self.theta.v);
        (self.attitude, self.theta, self.w, self.d) = (polar, theta, w, d);
        largest(&turned)
    }

    /// Returns the largest entry of any P - I.
    fn largest_stretch(&mut self) -> f64 {
        largest_entry(&self.stretch)
    }

    /// X, [Y] and [defect], whose change is added to pi. Returns the largest change of delta,
    /// relative to the momentum.
    fn defects(&mut self) -> f64 {
        let lanes = self.lanes;
        let TableauInLanes { columns, rows, .. } = self.data.tableau;
        // [C] and [K]
        let c = self.attitude.change();
        let u = with_one(&c);
        let k: Mat3<R> = mat3!(i, j => self.d[i][j] - c[i][j]);
        let f_lambda: Mat3<R> = mat3!(i, j => lanes.spread(self.f_lambda[i][j]));
        let (mu, omega) = (&self.mu, &self.omega);
        // -[mu, Omega] / 2 + dH/dg
        let commutator = cross(mu, omega);
        let known: Vec3<R> = vec3!(i => self.gradient[i] - commutator[i] * 0.5);
        if self.evaluations == 1 {
            // [S] to first order: -sum_j e_jk h b_j (Omega mu + mu Omega)_j / 4
            let m = scaled(mu, self.weight * -0.25);
            let twice = dot(&m, omega) * -2.0;
            let mut s = [
                m[0] * omega[0] * 2.0 + twice,
                m[1] * omega[1] * 2.0 + twice,
                m[2] * omega[2] * 2.0 + twice,
                m[1] * omega[2] + m[2] * omega[1],
                m[0] * omega[2] + m[2] * omega[0],
                m[0] * omega[1] + m[1] * omega[0],
            ];
            for i in 0..6 {
                s[i] = s[i].apply_tableau(rows);
            }
            let trace = s[0] + s[1] + s[2];
            let stretched = symmetric_product(&s, omega);
            let load: Vec3<R> = vec3!(i => (stretched[i] - trace * omega[i]) - known[i]);
            self.x = over_q(&self.inverse, &scaled(&load, self.weight));
            [_, self.y] = embedded(&u, &self.x, rows);
        }
        // Q(P) x = -h b (vee(asym(S hat(Omega))) - vee([mu, Omega]) / 2 + vee(dH/dg)) with [S] of
        // the previous Y
        let m: Mat3<R> = mat3!(i, j => f_lambda[i][j] + self.y[i][j]);
        let trace = dot(&u[0], &m[0]) + dot(&u[1], &m[1]) + dot(&u[2], &m[2]);
        let one = transposed_product(&m, &product(&u, omega));
        let other = transposed_product(&u, &product(&m, omega));
        let load: Vec3<R> = vec3!(i => ((one[i] + other[i]) * 0.5 - trace * omega[i]) - known[i]);
        self.x = over_q(&self.inverse, &scaled(&load, self.weight));
        // [T], [Y] and [defect]
        let [t, y] = embedded(&u, &self.x, rows);
        let delta = defect(&f_lambda, [&c, &self.d, &k], &self.w, [&t, &y], columns);
        let change = minus(&delta, &self.delta);
        (self.delta, self.y) = (delta, y);
        self.momentum_increment = plus(&self.momentum_increment, &change);
        self.momenta();
        // Avoids 0 / 0 for a body at rest.
        largest(&change) / largest(&self.mu).max(SMALLEST_SIZE)
    }

    /// [end]: f and the multiplier, `Q(P_e) lambda = -f^T pi1`, with P_e = I unless `is_stretched`.
    fn end(&mut self, is_stretched: bool) {
        if self.evaluations <= 1 {
            let Quaternion { w, v } =
                self.attitude.rate(&scaled(&self.omega, self.weight * 0.5));
            self.f = Quaternion { w: w.sum() + 1.0, v: vec3!(i => v[i].sum()) }.normalised();
        }
        let mut inverse = [0.0; 6];
        if is_stretched {
            // It starts as close as the stages are to collocation of quaternions: the first time
            // that needs a second pass.
            inverse = self.turn_end(if self.evaluations == 1 { 2 } else { 1 });
        }
        let f = self.f.matrix();
        let pi1: Vec3<f64> = vec3!(i => self.data.start.momentum[i] - self.kappa[i].sum());
        let lambda = over_q(&inverse, &scaled(&transposed_product(&f, &pi1), -1.0));
        self.f_lambda = times_hat(&f, &lambda);
    }

    /// Computes the polar factor of the end in `passes` passes; returns Q(P_e)^-1 - I / 2.
    fn turn_end(&mut self, passes: u32) -> Sym3<f64> {
        let d: Mat3<f64> = mat3!(i, j => self.w[i][j].sum());
        let mut inverse = [0.0; 6];
        for _ in 0..passes {
            let f = self.f.matrix();
            self.end_stretch = stretch_of(&self.f, &f, &d);
            inverse = inverse_of_q(&self.end_stretch);
            let half = over_q(&inverse, &residual(&self.f, &f, &d));
            self.f = self.f.turned(&scaled(&half, 0.5));
        }
        inverse
    }

    /// Evaluates [w] and [transport] at the solution.
    fn last(&mut self) {
        self.transport();
        let u = self.attitude.matrix();
        self.w = times_hat(&u, &scaled(&self.omega, self.weight));
    }
    }

    /// Repeats inner passes with new forces until these change nothing, then computes the end point.
    fn finish(&mut self, angle: f64, jump: f64) -> Result<f64, SolveError> {
        // The forces also depend on the momenta.
        let mut forces = Contraction::new(3.0 * TORQUE_CONTRACTION, jump);
        for _ in 0..MOST_ITERATIONS {
            self.evaluate_forces()?;
            let change = self.inner_pass();
            if change * contraction_of_a_pass(angle) > ROUND_OFF {
                self.inner_pass();
            }
            if !(change <= 1.0) {
                break;
            }
            if forces.at_floor(change, 1.0) || forces.left(change) <= ROUND_OFF {
                self.last();
                // The first pass brings f to length one to the last digit: its turn is measured as
                // if it already had that.
                self.turn_end(2);
                return Ok(change);
            }
        }
        Err(SolveError::NotConverged)
    }

    /// Stores the solution in `found` and returns the measures by which it is judged.
    #[inline(always)]
    fn judged(&self, increment: f64, values: &mut StageValues) -> Solved {
        let Self { attitude, mu, omega, sigma, stretch, f, end_stretch, .. } = self;
        attitude.w.store(&mut values.attitude.w);
        store(&attitude.v, &mut values.attitude.v);
        store(mu, &mut values.mu);
        store(omega, &mut values.omega);
        sigma.store(&mut values.sigma);
        for i in 0..6 {
            stretch[i].store(&mut values.stretch[i]);
        }
        values.end = *f;
        values.end_stretch = unsigned_zeros(*end_stretch);
        // [gain]
        let turning = cross(mu, &scaled(omega, self.weight));
        let momentum_increment = vec3!(i => (turning[i] - self.weight * self.gradient[i]).sum());
        values.momentum_increment = unsigned_zeros(momentum_increment);
        values.impulse = unsigned_zeros(vec3!(i => -self.kappa[i].sum()));
        let most = end_stretch
            .iter()
            .fold(largest_entry(stretch), |most, x| Real::max_or_nan(most, x.abs()));
        // |U - I|_F^2 = 8 |v|^2
        let turn = dot(&attitude.v, &attitude.v).largest();
        Solved {
            sweeps: self.evaluations,
            h: self.h,
            increment,
            stretch: most,
            change_square: 8.0 * Real::max_or_nan(turn, dot(&f.v, &f.v)),
            proximity: self.forces.proximity.largest(),
        }
    }
}

/// Returns the contraction of an error by an inner pass, assumed until it is measured.
fn contraction_of_a_pass(angle: f64) -> f64 {
    (0.15 * angle).clamp(0.01, 0.3)
}

/// The largest entry of a symmetric matrix.
#[inline(always)]
fn largest_entry<R: StageScalar<StepScalar = f64>>(s: &Sym3<R>) -> f64 {
    s[1..].iter().fold(s[0].abs(), |most, entry| most.max_or_nan(entry.abs())).largest()
}

/// The largest component of a vector.
#[inline(always)]
fn largest<R: StageScalar<StepScalar = f64>>(v: &Vec3<R>) -> f64 {
    v[0].abs().max_or_nan(v[1].abs()).max_or_nan(v[2].abs()).largest()
}
