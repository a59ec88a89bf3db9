//! The operations of a step, for all stages in lanes; each carries the tag of its result in docs/derivation.md.
//!
//! Invariant: an operation reads what is newest, and decides nothing.

use std::mem::swap;

use super::{End, Forces, StageSlot, StageValues, Step, Unknowns, Velocity};
use crate::failure::Failure;
use crate::lanes::{Real, StageScalar, in_lanes};
use crate::nonlinear::{SMALLEST_SIZE, relative};
use crate::stack::{Dimension, StageMatrices};
use crate::stepper::galerkin::convergence::Solved;
use crate::tableau::TableauInLanes;

impl<R: StageScalar<StepScalar = f64>, D: Dimension> Step<'_, R, D> {
    pub(super) fn gradients(&mut self) -> Result<(), Failure> {
        self.begin_sweep()?;
        if matches!(self.forces, Forces::Rescaled { .. }) {
            self.evaluate_time_scale();
            return Ok(());
        }
        let Unknowns { c, mu, omega, gradient, slopes, .. } = &mut *self.u;
        match &mut self.forces {
            Forces::None { .. } | Forces::Rescaled { .. } => {}
            Forces::Body { torques, work, .. } => {
                work.add_gradients(self.coefficients.tableau.stages as u64);
                torques.gradient(c, slopes, gradient);
            }
            Forces::Stages(system) => {
                let stages = self.coefficients.tableau.stages;
                system.gradients(stages, R::LANES, StageValues { c, mu, omega }, gradient);
            }
        }
        Ok(())
    }

    /// Evaluates [time]: the forces and the time of the stages, and the length of a step that is to
    /// last a given time, `h = t / sum_k b_k sigma_k`.
    pub(super) fn evaluate_time_scale(&mut self) {
        if let Forces::Rescaled { work, .. } = &self.forces {
            work.add_gradients(self.coefficients.tableau.stages as u64);
        }
        self.scales();
        self.velocities_in_lanes();
        if let Some(lasting) = self.start.lasting {
            let TableauInLanes { weights, stages, .. } = &self.coefficients.tableau;
            let sigma = self.u.rescaled.sigma();
            let mean: f64 = (0..*stages).map(|k| weights[k] * sigma[k]).sum();
            self.h = lasting / mean;
            self.weights = self.stack.lanes.row(weights) * self.h;
        }
    }

    in_lanes! {
    /// Evaluates sigma and the forces.
    pub(super) fn scales(&mut self) {
        if let Forces::Rescaled { torques, scale, .. } = &mut self.forces {
            let Unknowns { c, rescaled, .. } = &mut *self.u;
            rescaled.evaluate_forces(torques, scale, c);
        }
    }

    pub(super) fn velocities_in_lanes(&mut self) {
        self.velocities();
    }

    /// Spreads p0, and the weights of a body, over all lanes.
    pub(super) fn load(&mut self) {
        let Self { stack, start, u, forces, .. } = self;
        if let Forces::None { velocity: Velocity::Weights(weights, _), .. }
        | Forces::Body { velocity: Velocity::Weights(weights, _), .. }
        | Forces::Rescaled { weights, .. } = forces
        {
            stack.spread(weights, &mut u.inertia);
        }
        stack.spread(start.momentum, &mut u.p0);
    }

    /// Remembers the solution.
    pub(super) fn keep(&mut self) {
        let without = usize::from(self.has_weights());
        let (extrapolation, smooth) = self.u.smooth(self.end);
        let count = smooth.len() - without;
        extrapolation.add(smooth.into_iter().take(count).map(|matrix| &matrix[..]));
    }

    /// Extrapolates the unknowns from the last steps, if enough of them are known.
    pub(super) fn extrapolate(&mut self) -> bool {
        let without = usize::from(self.has_weights());
        let (extrapolation, smooth) = self.u.smooth(self.end);
        let count = smooth.len() - without;
        let is_known = extrapolation.is_known();
        if is_known {
            let matrices = smooth.into_iter().take(count).map(|matrix| &mut matrix[..]);
            extrapolation.extrapolate(self.stack.lanes, matrices);
        }
        is_known
    }

    /// [w], [D], [K] and [C] with the current F, also of the end point.
    pub(super) fn attitudes_of_factors(&mut self) {
        let Self { stack, coefficients, weights, u, end, .. } = self;
        let Unknowns { w, c, d, f, k, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
        stack.combination(w, &coefficients.tableau.columns, d);
        stack.plus_product(f, d, f, k);
        stack.difference(d, k, c);
        let (one, End { c, d, f, k, .. }) = (stack.whole(), &mut **end);
        stack.sum_of_stages(w, d);
        one.plus_product(f, d, f, k);
        one.difference(d, k, c);
    }

    /// Guesses the unknowns from the initial velocity, kept constant.
    pub(super) fn guess(&mut self) {
        let Self { stack, start, coefficients, u, .. } = self;
        u.previous.defect = f64::INFINITY;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let angle = lanes.row(&coefficients.tableau.nodes) * start.h;
        let Unknowns { p0, omega, mu, c, .. } = &mut **u;
        let velocity = &start.velocity[..n * n];
        let (omega, c) = (&mut omega[..len], &mut c[..len]);
        for i in 0..n {
            for j in 0..n {
                let turning = lanes.spread(velocity[i * n + j]);
                stack.put(omega, i, j, turning);
                let mut square = 0.0;
                for k in 0..n {
                    square += velocity[i * n + k] * velocity[k * n + j];
                }
                // exp(c h Omega) - I up to the square
                stack.put(c, i, j, angle * (turning + angle * (0.5 * square)));
            }
        }
        mu.copy_from_slice(p0);
        self.guess_no_defect();
    }

    /// Guesses momenta and attitudes from the last step, continued as polynomials in time: `mu_j`
    /// and, relative to its end, `f^T U_j`.
    pub(super) fn continue_stages(&mut self) {
        let Self { stack, coefficients, u, end, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { p0, mu, c, scratch: [rotation, seen, _], .. } = &mut **u;
        stack.spread(&end.c, rotation);
        stack.plus_transposed_product(c, rotation, c, seen);
        let columns = stack.lanes.rows(&coefficients.ahead);
        let at_end = stack.lanes.row(&coefficients.ahead_of_end);
        {
            let (c, rotation, seen) = (&mut c[..len], &rotation[..len], &mut seen[..len]);
            for i in 0..n {
                for j in 0..n {
                    stack.put(seen, i, j, stack.get(seen, i, j) + stack.get(rotation, j, i));
                    // zero at the end
                    let ahead = R::combination(&seen[(i * n + j) * R::LANES..], &columns);
                    stack.put(c, i, j, ahead);
                }
            }
            let (p0, mu) = (&p0[..len], &mut mu[..len]);
            for i in 0..n {
                for j in i + 1..n {
                    let ahead = R::combination(&mu[(i * n + j) * R::LANES..], &columns);
                    stack.put_skew(mu, i, j, at_end * stack.get(p0, i, j) + ahead);
                }
            }
        }
        self.velocities();
        self.u.delta.fill(0.0);
        // The attitudes that these momenta lead to: the first torque depends on them.
        self.attitudes();
    }

    /// Computes `mu_k = p0 + sum_j e_kj h b_j ([mu_j, Omega_j] - dH/dg_j)`, and Omega. This is
    /// Gauss collocation of `mu' = [mu, Omega] - dH/dg` in the body, which differs from [transport]
    /// by the order h^(s+1), that of delta. It needs one product, where [transport] needs two to
    /// turn pi into the body, and a polar factor. Returns the largest change of a momentum.
    pub(super) fn momenta_in_body(&mut self) -> f64 {
        self.rates();
        let Self { stack, coefficients, u, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { p0, mu, scratch: [rate, ..], .. } = &mut **u;
        let (p0, mu, rate) = (&p0[..len], &mut mu[..len], &rate[..len]);
        let columns = lanes.rows(&coefficients.tableau.columns);
        let mut jump = lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let momentum_increment = R::combination(&rate[(i * n + j) * R::LANES..], &columns);
                let now = stack.get(p0, i, j) + momentum_increment;
                jump = jump.max_or_nan((now - stack.get(mu, i, j)).abs());
                stack.put_skew(mu, i, j, now);
            }
        }
        self.velocities().max(jump.largest())
    }

    /// [w]
    pub(super) fn spatial_velocities(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let Unknowns { w, c, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
    }

    /// [w], [D] and [C], with the current K: (24c, vih3).
    pub(super) fn attitudes(&mut self) {
        let Self { stack, coefficients, weights, u, .. } = self;
        let Unknowns { w, c, d, k, omega, .. } = &mut **u;
        spatial_velocities(*stack, *weights, c, omega, w);
        stack.combination(w, &coefficients.tableau.columns, d);
        stack.difference(d, k, c);
    }

    /// Measures the largest momentum, and the largest turn of a step by a stage's velocity.
    pub(super) fn measure(&mut self) {
        let Self { stack, h, u, size, angle, .. } = self;
        let (len, lanes) = (stack.numbers(), stack.lanes);
        let (omega, mu) = (&u.omega[..len], &u.mu[..len]);
        let (mut square, mut largest) = (lanes.constant(0.0), lanes.constant(0.0));
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                let omega = stack.get(omega, i, j);
                square = square + omega * omega;
                largest = largest.max_or_nan(stack.get(mu, i, j).abs());
            }
        }
        // Avoids 0 / 0 for a body at rest.
        *size = largest.largest().max_or_nan(SMALLEST_SIZE);
        *angle = h.abs() * square.largest().sqrt();
    }

    /// [F], [K] and [C]: (24c, vih3).
    pub(super) fn polar_factors(&mut self) {
        let Self { stack, u, .. } = self;
        let Unknowns { d, c, f, k, scratch: [scratch, ..], .. } = &mut **u;
        stack.polar_factor(d, c, f, k, scratch);
    }

    /// [transport]: pi - p0.
    pub(super) fn transport(&mut self) {
        let Self { stack, coefficients, weights, u, forces, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { c, kappa, momentum_increment, delta, gradient, slopes, rescaled, .. } = &mut **u;
        match forces {
            Forces::None { .. } => {
                momentum_increment.copy_from_slice(delta);
                return;
            }
            Forces::Body { torques, .. } => torques.spatial_gradient(c, slopes, kappa),
            Forces::Rescaled { torques, .. } => rescaled.spatial_gradient(torques, c, slopes, kappa),
            Forces::Stages(system) => {
                for stage in 0..coefficients.tableau.stages {
                    system.to_space(StageSlot { stage, stride: R::LANES }, c, gradient, kappa);
                }
            }
        }
        let (kappa, momentum_increment, delta) = (&mut kappa[..len], &mut momentum_increment[..len], &delta[..len]);
        let columns = lanes.rows(&coefficients.tableau.columns);
        for i in 0..n {
            for j in i + 1..n {
                stack.put(kappa, i, j, *weights * stack.get(kappa, i, j));
            }
        }
        for i in 0..n {
            for j in i + 1..n {
                let impulses = R::combination(&kappa[(i * n + j) * R::LANES..], &columns);
                stack.put_skew(momentum_increment, i, j, stack.get(delta, i, j) - impulses);
            }
        }
    }

    /// Computes `mu = U^T pi U`, as `p0 + (pi - p0) + asym(pi C) + C^T pi C`, and Omega. Returns
    /// the largest change of a momentum.
    pub(super) fn momenta_from_space(&mut self) -> f64 {
        let Self { stack, u, .. } = self;
        let (n, len, lanes) = (stack.n(), stack.numbers(), stack.lanes);
        let Unknowns { p0, mu, c, momentum_increment, scratch: [pi, turned, twice], .. } = &mut **u;
        let (p0, mu, c, momentum_increment) = (&p0[..len], &mut mu[..len], &c[..len], &momentum_increment[..len]);
        let (pi, turned, twice) = (&mut pi[..len], &mut turned[..len], &mut twice[..len]);
        stack.sum(p0, momentum_increment, pi);
        stack.product(pi, c, turned);
        stack.upper_of_transposed_product(c, turned, twice);
        let mut jump = lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let once = stack.get(turned, i, j) - stack.get(turned, j, i);
                let momentum_increment = stack.get(momentum_increment, i, j) + (once + stack.get(twice, i, j));
                let now = stack.get(p0, i, j) + momentum_increment;
                jump = jump.max_or_nan((now - stack.get(mu, i, j)).abs());
                stack.put_skew(mu, i, j, now);
            }
        }
        self.velocities().max(jump.largest())
    }

    /// [S] to first order: `-sum_j e_jk h b_j (Omega_j mu_j + mu_j Omega_j) / 4`.
    pub(super) fn first_symmetric_parts(&mut self) {
        let Self { stack, coefficients, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, s, scratch: [product, both, _], .. } = &mut **u;
        stack.product(omega, mu, product);
        let (product, both, s) = (&product[..len], &mut both[..len], &mut s[..len]);
        for i in 0..n {
            for j in i..n {
                // mu Omega = (Omega mu)^T
                let sum = stack.get(product, i, j) + stack.get(product, j, i);
                stack.put(both, i, j, *weights * sum * -0.25);
            }
        }
        let columns = stack.lanes.rows(&coefficients.tableau.rows);
        for i in 0..n {
            for j in i..n {
                let part = R::combination(&both[(i * n + j) * R::LANES..], &columns);
                stack.put(s, i, j, part);
                stack.put(s, j, i, part);
            }
        }
    }

    /// Computes [end] and [Lambda]: the polar factor of the end point, (24b, vih2), in `passes`
    /// passes, pi1, and the multiplier by (6) of the derivation, `Lambda_s = -(pi1 + asym(E_s Lambda_s)) / 2` with
    /// `Lambda_s = f Lambda f^T` and `E_s = f E f^T = k f^T`, which is (24e, vih5).
    pub(super) fn end_point(&mut self, passes: usize) {
        let Self { stack, start, u, end, .. } = self;
        let (n, len, one) = (stack.n(), stack.numbers(), stack.whole());
        let Unknowns { w, kappa, .. } = &mut **u;
        let (kappa, whole) = (&kappa[..len], one.numbers());
        let End { c, d, k, f: end_f, multiplier, impulse, pi, scratch: [a, b], .. } = &mut **end;
        let (c, d, k) = (&mut c[..whole], &mut d[..whole], &mut k[..whole]);
        let (multiplier, impulse) = (&mut multiplier[..whole], &mut impulse[..whole]);
        let (pi, a, b) = (&mut pi[..whole], &mut a[..whole], &mut b[..whole]);
        stack.sum_of_stages(w, d);
        one.difference(d, k, c);
        for _ in 0..passes {
            one.polar_factor(d, c, end_f, k, a);
        }
        for i in 0..n {
            for j in i + 1..n {
                one.put_skew(impulse, i, j, -stack.get(kappa, i, j).sum());
            }
        }
        one.sum(start.momentum, impulse, pi);
        // E_s = k f^T, symmetric: f k^T = k^T + c k^T
        for i in 0..n {
            for j in 0..n {
                b[i * n + j] = k[j * n + i];
            }
        }
        one.plus_product(b, c, b, a);
        one.product(a, multiplier, b);
        for i in 0..n {
            for j in i + 1..n {
                let stretched = b[i * n + j] - b[j * n + i];
                one.put_skew(multiplier, i, j, (pi[i * n + j] + stretched) * -0.5);
            }
        }
    }

    /// Takes `f Lambda = Lambda_s f` to all stages, and computes [E] there.
    pub(super) fn end_at_stages(&mut self) {
        let Self { stack, u, end, .. } = self;
        let Unknowns { f, e, f_lambda, scratch: [next, ..], .. } = &mut **u;
        let End { c, multiplier, scratch: [f_lambda_once, _], .. } = &mut **end;
        stack.whole().plus_product(multiplier, multiplier, c, f_lambda_once);
        stack.spread(f_lambda_once, f_lambda);
        stack.plus_product(f, f, e, next);
        swap(e, next);
    }

    /// [gain]: `p1 - p0 = sum_k h b_k ([mu_k, Omega_k] - dH/dg(U_k))`, the equations of X summed
    /// over the stages.
    pub(super) fn momentum_increment(&mut self) {
        self.rates();
        let Self { stack, u, end, .. } = self;
        let (rate, momentum_increment) = (&u.scratch[0][..stack.numbers()], &mut *end.momentum_increment);
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                stack.whole().put_skew(momentum_increment, i, j, stack.get(rate, i, j).sum());
            }
        }
    }

    /// Computes [X], by (5) of the derivation:
    /// `X = -(h b / 2) (asym(S Omega) - [mu, Omega] / 2 + dH/dg) - asym(E X) / 2`, which is
    /// (17a, f1) and (19a, fff1).
    pub(super) fn multipliers(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, s, e, x, gradient, scratch: [half, load, stretched], .. } = &mut **u;
        // [mu, Omega] = asym(mu Omega); for skew B, asym(A B) = -asym(A B^T)
        let (mu, s, half) = (&mu[..len], &s[..len], &mut half[..len]);
        for entry in 0..len {
            half[entry] = 0.5 * mu[entry] - s[entry];
        }
        stack.asym_of_product(half, omega, load);
        stack.asym_of_product(e, x, stretched);
        let (load, stretched, gradient) = (&load[..len], &stretched[..len], &gradient[..len]);
        let x = &mut x[..len];
        for i in 0..n {
            for j in i + 1..n {
                let load = stack.get(load, i, j) + stack.get(gradient, i, j);
                let part = stack.get(stretched, i, j) - *weights * load;
                stack.put_skew(x, i, j, part * 0.5);
            }
        }
    }

    /// [T], [Y] and [S]
    pub(super) fn embed(&mut self) {
        let Self { stack, coefficients, u, .. } = self;
        let Unknowns { c, x, t, y, s, f_lambda, scratch: [w, turned, _], .. } = &mut **u;
        stack.plus_product(x, c, x, t);
        stack.combination(t, &coefficients.tableau.rows, y);
        stack.sum(f_lambda, y, w);
        stack.plus_transposed_product(w, c, w, turned);
        stack.symmetric_part(turned, s);
    }

    /// Evaluates the part of [defect] that does not depend on K:
    /// `-asym(Y_k C_k^T) - sum_j e_kj asym(T_j D_j^T - Y_j w_j^T)`.
    pub(super) fn slow_defects(&mut self) {
        let Self { stack, coefficients, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { c, d, w, t, y, delta_rest, scratch: [part, of_y, of_stage], .. } = &mut **u;
        stack.asym_of_product(t, d, part);
        stack.asym_of_product(y, w, of_y);
        stack.asym_of_product(y, c, of_stage);
        let (part, of_y, of_stage) = (&mut part[..len], &of_y[..len], &of_stage[..len]);
        let delta_rest = &mut delta_rest[..len];
        for i in 0..n {
            for j in i + 1..n {
                stack.put(part, i, j, stack.get(part, i, j) - stack.get(of_y, i, j));
            }
        }
        let columns = stack.lanes.rows(&coefficients.tableau.columns);
        for i in 0..n {
            for j in i + 1..n {
                let sum = R::combination(&part[(i * n + j) * R::LANES..], &columns);
                stack.put(delta_rest, i, j, -(stack.get(of_stage, i, j) + sum));
            }
        }
    }

    /// [defect] with the newest K; its change is added to pi. Returns the largest change.
    pub(super) fn newest_defects(&mut self) -> f64 {
        let Self { stack, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { k, momentum_increment, delta, delta_rest, f_lambda, scratch: [newest, ..], .. } = &mut **u;
        stack.asym_of_product(f_lambda, k, newest);
        let (momentum_increment, delta) = (&mut momentum_increment[..len], &mut delta[..len]);
        let (delta_rest, newest) = (&delta_rest[..len], &newest[..len]);
        let mut jump = stack.lanes.constant(0.0);
        for i in 0..n {
            for j in i + 1..n {
                let now = stack.get(newest, i, j) + stack.get(delta_rest, i, j);
                let change = now - stack.get(delta, i, j);
                jump = jump.max_or_nan(change.abs());
                stack.put_skew(delta, i, j, now);
                stack.put_skew(momentum_increment, i, j, stack.get(momentum_increment, i, j) + change);
            }
        }
        jump.largest()
    }

    /// Returns the largest change of an attitude since it was copied into t (scratch space here),
    /// in units of momenta.
    pub(super) fn turned(&mut self) -> f64 {
        let Self { stack, u, size, .. } = self;
        let mut change = stack.lanes.constant(0.0);
        for (now, before) in u.c.chunks_exact(R::LANES).zip(u.t.chunks_exact(R::LANES)) {
            change = change.max_or_nan((stack.lanes.get(now) - stack.lanes.get(before)).abs());
        }
        change.largest() * *size
    }

    /// Computes the measures by which a solution is judged.
    pub(super) fn judged(&mut self, sweeps: u32, increment: f64) -> Solved {
        let Self { stack, u, end, forces, h, .. } = self;
        let (len, lanes) = (stack.numbers(), stack.lanes);
        let (c, f) = (&u.c[..len], &u.f[..len]);
        let (mut stretch, mut end_stretch) = (lanes.constant(0.0), 0.0);
        for i in 0..stack.n() {
            for j in i..stack.n() {
                stretch = stretch.max_or_nan(stack.get(f, i, j).abs());
                end_stretch = Real::max_or_nan(end_stretch, end.f[i * stack.n() + j].abs());
            }
        }
        let (square, end_square) = (stack.square(c), stack.whole().square(&end.c));
        Solved {
            sweeps,
            h: *h,
            increment,
            stretch: Real::max_or_nan(end_stretch, stretch.largest()),
            change_square: Real::max_or_nan(end_square, square.largest()),
            proximity: match forces {
                Forces::Body { torques, .. } | Forces::Rescaled { torques, .. } => torques.proximity,
                Forces::None { .. } | Forces::Stages(_) => -1.0,
            },
        }
    }
    }

    /// Guesses that the step is one of collocation.
    #[inline(always)]
    pub(super) fn guess_no_defect(&mut self) {
        let Self { start, u, end, .. } = self;
        for (multiplier, momentum) in end.multiplier.iter_mut().zip(start.momentum) {
            *multiplier = -0.5 * momentum;
        }
        let Unknowns { k, f, e, x, delta, momentum_increment, gradient, kappa, .. } = &mut **u;
        for matrices in [k, f, e, x, delta, momentum_increment, gradient, kappa] {
            matrices.fill(0.0);
        }
        end.k.fill(0.0);
        end.f.fill(0.0);
        end.impulse.fill(0.0);
    }

    pub(super) fn defects(&mut self) -> f64 {
        self.embed();
        self.slow_defects();
        self.newest_defects()
    }

    /// Writes `h b ([mu, Omega] - dH/dg)` to the first matrix of `scratch`.
    #[inline(always)]
    pub(super) fn rates(&mut self) {
        let Self { stack, weights, u, .. } = self;
        let (n, len) = (stack.n(), stack.numbers());
        let Unknowns { mu, omega, gradient, scratch: [rate, ..], .. } = &mut **u;
        // asym(mu Omega) = -asym(mu Omega^T)
        stack.asym_of_product(mu, omega, rate);
        let (rate, gradient) = (&mut rate[..len], &gradient[..len]);
        for i in 0..n {
            for j in i + 1..n {
                let turning = stack.get(rate, i, j) + stack.get(gradient, i, j);
                stack.put(rate, i, j, -(*weights * turning));
            }
        }
    }

    /// Updates Omega by (24f, vih6). Returns how far it still is from the velocity of mu, in units
    /// of mu.
    #[inline(always)]
    pub(super) fn velocities(&mut self) -> f64 {
        let Unknowns { inertia, c, mu, omega, gradient, rescaled, .. } = &mut *self.u;
        let system = match &mut self.forces {
            Forces::Rescaled { scale, .. } => {
                // [time]
                rescaled.derivatives(self.stack, scale, inertia, [c, mu], omega, gradient);
                return 0.0;
            }
            Forces::None { velocity: Velocity::Weights(..), .. }
            | Forces::Body { velocity: Velocity::Weights(..), .. } => {
                self.stack.entrywise_product(inertia, mu, omega);
                return 0.0;
            }
            Forces::None { velocity: Velocity::Stages(system), .. }
            | Forces::Body { velocity: Velocity::Stages(system), .. }
            | Forces::Stages(system) => system,
        };
        let (mut change, mut size) = (0.0_f64, 0.0_f64);
        for stage in 0..self.coefficients.tableau.stages {
            let at = StageSlot { stage, stride: R::LANES };
            let [changed, now] = system.velocity(at, c, mu, omega);
            (change, size) = (Real::max_or_nan(change, changed), size.max(now));
        }
        relative(change, size) * self.size
    }
}

/// [w]
#[inline(always)]
fn spatial_velocities<R: StageScalar<StepScalar = f64>, D: Dimension>(
    stack: StageMatrices<R, D>,
    weights: R,
    c: &[f64],
    omega: &[f64],
    w: &mut [f64],
) {
    stack.plus_product(omega, c, omega, w);
    stack.scale(weights, w);
}
