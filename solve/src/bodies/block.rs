//! The equations of a step of up to eight bodies, side by side in lanes; operations carry the tags of
//! docs/derivation.md, where the equations of one body are derived. Bodies know nothing of each other here: velocities of
//! bodies in joints, and all torques, come from outside.
//!
//! In the frame of its attitude at the beginning, each body has at the stages
//!
//! ```text
//! [w] w_j = h b_j U_j Omega_j        [D] D_k = sum_j e_kj w_j      [F], [K], [C]   the polar factor of I + D
//! [transport]  pi_k = p0 - sum_j (1 - e_jk) kappa_j + delta_k      kappa_j = h b_j g0^T (dH/dg of stage j, in space) g0
//! [defect]     delta_k = asym(f Lambda K'_k^T) - asym(Y_k C_k^T) - sum_j (1 - e_jk) asym(T_j D_j^T - Y_j w_j^T)
//! ```
//!
//! with `K'_k = K_k + sum_j (1 - e_jk - e_kj) w_j`, which is K for a symplectic tableau.
//!
//! Invariant: the result in a lane does not depend on the other lanes, nor on the instruction set.

use fearless_simd::{Level, f64x4, f64x8, prelude::*};

use super::coefficients::{Coefficients, combination};
use crate::lanes::{Real, Rows, StageScalar, in_lanes, widest};
use crate::nonlinear::SMALLEST_SIZE;
use crate::so::Mat;
use crate::stack::{AlignedBuffer, Any, Dimension, Known, StageMatrices};

/// The most bodies in a block.
pub(super) const MOST_BODIES: usize = 8;

/// The unknowns of up to eight bodies, and scratch space: matrices in lanes row by row, those of the stages one after the
/// other. Of `pull`, `delta` and the scratch only entries above the diagonal count where they are skew, unless said.
#[derive(Clone, Debug)]
pub(super) struct Block {
    n: usize,
    /// Lanes: 4 or 8.
    width: usize,
    /// Number of the first body, and how many there are.
    pub(super) first: usize,
    pub(super) bodies: usize,
    /// p0 and g0.
    p0: AlignedBuffer,
    g0: AlignedBuffer,
    /// `Omega_ij = w_ij mu_ij`
    weights: AlignedBuffer,
    /// Sizes of the torques that were added up, times h: one number for each lane.
    noise: AlignedBuffer,
    mu: AlignedBuffer,
    omega: AlignedBuffer,
    c: AlignedBuffer,
    f: AlignedBuffer,
    k: AlignedBuffer,
    e: AlignedBuffer,
    d: AlignedBuffer,
    w: AlignedBuffer,
    /// `pi - p0`
    momentum_increment: AlignedBuffer,
    /// `g0^T (dH/dg, in space) g0`, full; before it is turned, `-dH/dg` in space.
    pull: AlignedBuffer,
    gradient: AlignedBuffer,
    x: AlignedBuffer,
    s: AlignedBuffer,
    t: AlignedBuffer,
    y: AlignedBuffer,
    delta: AlignedBuffer,
    /// Attitudes in space.
    attitude: AlignedBuffer,
    scratch: [AlignedBuffer; 3],
    end: End,
}

/// The unknowns of the end points.
#[derive(Clone, Debug)]
struct End {
    c: AlignedBuffer,
    d: AlignedBuffer,
    f: AlignedBuffer,
    k: AlignedBuffer,
    /// `f Lambda f^T`
    multiplier: AlignedBuffer,
    /// `pi1 - p0`
    impulse: AlignedBuffer,
    f_lambda: AlignedBuffer,
    /// `p1 - p0`
    momentum_increment: AlignedBuffer,
}

/// A part of a sweep.
#[derive(Clone, Copy, Debug)]
pub(super) enum Task {
    /// Momenta in the body, from those of the stages.
    Momenta,
    /// Velocities from momenta, by weights.
    Velocities,
    /// The attitudes that the velocities lead to.
    Turn,
    /// Attitudes in space.
    ToSpace,
    /// Torques as the bodies feel them.
    FromSpace,
    /// What the torques do: the rest of a sweep.
    Transport,
    /// The end of the step.
    Finish,
}

impl Block {
    /// Creates the block of `bodies` bodies from `first` on, in n dimensions.
    pub(super) fn new(n: usize, stages: usize, first: usize, bodies: usize) -> Self {
        let width = if bodies <= 4 { 4 } else { MOST_BODIES };
        let one = || AlignedBuffer::zeros(n * n * width);
        let all = || AlignedBuffer::zeros(stages * n * n * width);
        let mut g0 = one();
        // Lanes without a body hold one that does not move.
        for i in 0..n {
            g0[(i * n + i) * width..(i * n + i + 1) * width].fill(1.0);
        }
        Self {
            n,
            width,
            first,
            bodies,
            p0: one(),
            g0,
            weights: one(),
            noise: AlignedBuffer::zeros(width),
            mu: all(),
            omega: all(),
            c: all(),
            f: all(),
            k: all(),
            e: all(),
            d: all(),
            w: all(),
            momentum_increment: all(),
            pull: all(),
            gradient: all(),
            x: all(),
            s: all(),
            t: all(),
            y: all(),
            delta: all(),
            attitude: all(),
            scratch: [all(), all(), one()],
            end: End {
                c: one(),
                d: one(),
                f: one(),
                k: one(),
                multiplier: one(),
                impulse: one(),
                f_lambda: one(),
                momentum_increment: one(),
            },
        }
    }

    /// Writes the matrix of a body to a lane.
    fn put<const N: usize>(to: &mut [f64], width: usize, lane: usize, matrix: &Mat<N>) {
        for i in 0..N {
            for j in 0..N {
                to[(i * N + j) * width + lane] = matrix[(i, j)];
            }
        }
    }

    /// Reads the matrix of a lane.
    fn get<const N: usize>(from: &[f64], width: usize, lane: usize) -> Mat<N> {
        Mat::from_fn(|i, j| from[(i * N + j) * width + lane])
    }

    fn stage(&self, k: usize) -> std::ops::Range<usize> {
        let len = self.n * self.n * self.width;
        k * len..(k + 1) * len
    }

    /// Begins a step of a body.
    pub(super) fn begin<const N: usize>(
        &mut self,
        lane: usize,
        attitude: &Mat<N>,
        momentum: &Mat<N>,
    ) {
        Self::put(&mut self.g0, self.width, lane, attitude);
        Self::put(&mut self.p0, self.width, lane, momentum);
    }

    /// Sets the weights of a body.
    pub(super) fn set_weights<const N: usize>(&mut self, lane: usize, weights: &Mat<N>) {
        Self::put(&mut self.weights, self.width, lane, weights);
    }

    /// Sets the size of what is added up to the torques of a body, times h.
    pub(super) fn set_noise(&mut self, lane: usize, noise: f64) {
        self.noise[lane] = noise;
    }

    /// The momentum of a body at a stage, in the body.
    pub(super) fn momentum<const N: usize>(&self, k: usize, lane: usize) -> Mat<N> {
        Self::get(&self.mu[self.stage(k)], self.width, lane)
    }

    /// Its velocity.
    pub(super) fn velocity<const N: usize>(&self, k: usize, lane: usize) -> Mat<N> {
        Self::get(&self.omega[self.stage(k)], self.width, lane)
    }

    /// Sets its velocity.
    pub(super) fn set_velocity<const N: usize>(&mut self, k: usize, lane: usize, omega: &Mat<N>) {
        let stage = self.stage(k);
        Self::put(&mut self.omega[stage], self.width, lane, omega);
    }

    /// Its attitude in space.
    pub(super) fn attitude<const N: usize>(&self, k: usize, lane: usize) -> Mat<N> {
        Self::get(&self.attitude[self.stage(k)], self.width, lane)
    }

    /// Sets the torque on it, in space.
    pub(super) fn set_torque<const N: usize>(&mut self, k: usize, lane: usize, torque: &Mat<N>) {
        let stage = self.stage(k);
        Self::put(&mut self.pull[stage], self.width, lane, torque);
    }

    /// `U_k - I`, or `f - I` after the last stage.
    pub(super) fn turn<const N: usize>(&self, k: Option<usize>, lane: usize) -> Mat<N> {
        match k {
            Some(k) => Self::get(&self.c[self.stage(k)], self.width, lane),
            None => Self::get(&self.end.c, self.width, lane),
        }
    }

    /// `I - P_k^-1`, or of the end point after the last stage.
    pub(super) fn stretch<const N: usize>(&self, k: Option<usize>, lane: usize) -> Mat<N> {
        match k {
            Some(k) => Self::get(&self.f[self.stage(k)], self.width, lane),
            None => Self::get(&self.end.f, self.width, lane),
        }
    }

    /// `pi1 - p0`, in the frame of g0.
    pub(super) fn impulse<const N: usize>(&self, lane: usize) -> Mat<N> {
        Self::get(&self.end.impulse, self.width, lane)
    }

    /// `p1 - p0`
    pub(super) fn gain<const N: usize>(&self, lane: usize) -> Mat<N> {
        Self::get(&self.end.momentum_increment, self.width, lane)
    }

    /// The largest entries of a turn and of a stretch in the step.
    pub(super) fn largest(&self) -> [f64; 2] {
        let of = |all: [&AlignedBuffer; 2]| {
            all.into_iter()
                .flat_map(|m| m.iter())
                .fold(0.0, |most: f64, x| Real::max_or_nan(most, x.abs()))
        };
        [of([&self.c, &self.end.c]), of([&self.f, &self.end.f])]
    }

    /// Guesses the unknowns: velocities that stay, given at each stage, and a step of collocation.
    pub(super) fn guess(&mut self, coefficients: &Coefficients, h: f64) {
        let Self { n, width, p0, omega, c, end, .. } = self;
        let (n, width) = (*n, *width);
        let len = n * n * width;
        for (k, &node) in coefficients.nodes.iter().enumerate() {
            let angle = node * h;
            let (omega, c) = (&omega[k * len..(k + 1) * len], &mut c[k * len..(k + 1) * len]);
            for i in 0..n {
                for j in 0..n {
                    for lane in 0..width {
                        let at = |i: usize, j: usize| (i * n + j) * width + lane;
                        let square: f64 = (0..n).map(|m| omega[at(i, m)] * omega[at(m, j)]).sum();
                        // exp(c h Omega) - I up to the square
                        c[at(i, j)] = angle * (omega[at(i, j)] + angle * (0.5 * square));
                    }
                }
            }
        }
        for (multiplier, momentum) in end.multiplier.iter_mut().zip(p0.iter()) {
            *multiplier = -0.5 * momentum;
        }
        let Self { f, k, e, x, s, momentum_increment, .. } = self;
        for matrices in [f, k, e, x, s, momentum_increment] {
            matrices.fill(0.0);
        }
        self.end.f.fill(0.0);
        self.end.k.fill(0.0);
    }

    /// The unknowns from which a sweep begins.
    pub(super) fn unknowns(&self) -> [&[f64]; 10] {
        let Self { momentum_increment, c, f, k, e, x, s, end, .. } = self;
        let End { f: end_f, k: end_k, multiplier, .. } = end;
        [momentum_increment, c, f, k, e, x, s, end_f, end_k, multiplier]
    }

    /// The same, to be set.
    pub(super) fn unknowns_mut(&mut self) -> [&mut [f64]; 10] {
        let Self { momentum_increment, c, f, k, e, x, s, end, .. } = self;
        let End { f: end_f, k: end_k, multiplier, .. } = end;
        [momentum_increment, c, f, k, e, x, s, end_f, end_k, multiplier]
    }

    /// Does a part of a sweep; returns the largest change of what it improves, relative to its size.
    pub(super) fn perform(
        &mut self,
        level: Option<Level>,
        coefficients: &Coefficients,
        h: f64,
        task: Task,
    ) -> f64 {
        match (self.width, level) {
            (4, Some(level)) => widest!(
                level below Avx512, f64x4,
                lanes => dimensioned(lanes, self, coefficients, h, task),
                else dimensioned(Rows([0.0; 4]), self, coefficients, h, task)
            ),
            (4, None) => dimensioned(Rows([0.0; 4]), self, coefficients, h, task),
            (_, Some(level)) => widest!(
                level, f64x8,
                lanes => dimensioned(lanes, self, coefficients, h, task),
                else dimensioned(Rows([0.0; 8]), self, coefficients, h, task)
            ),
            (_, None) => dimensioned(Rows([0.0; 8]), self, coefficients, h, task),
        }
    }
}

/// Selects the code for n rows.
fn dimensioned<R: StageScalar>(
    lanes: R,
    block: &mut Block,
    coefficients: &Coefficients,
    h: f64,
    task: Task,
) -> f64 {
    match block.n {
        3 => {
            let stack = StageMatrices { lanes, dimension: Known::<3> };
            Sweep { stack, block, coefficients, h }.perform(task)
        }
        n => {
            let stack = StageMatrices { lanes, dimension: Any(n) };
            Sweep { stack, block, coefficients, h }.perform(task)
        }
    }
}

/// A sweep over the equations of a block.
struct Sweep<'a, R, D> {
    stack: StageMatrices<R, D>,
    block: &'a mut Block,
    coefficients: &'a Coefficients,
    h: f64,
}

impl<R: StageScalar, D: Dimension> Sweep<'_, R, D> {
    fn perform(&mut self, task: Task) -> f64 {
        match task {
            Task::Momenta => self.momenta(),
            Task::Velocities => self.velocities(),
            Task::Turn => return self.turn(),
            Task::ToSpace => self.attitudes_in_space(),
            Task::FromSpace => self.torques_in_body(),
            Task::Transport => {
                self.end_point(1);
                self.multipliers();
                self.multipliers();
                return self.transport();
            }
            Task::Finish => {
                self.end_point(2);
                self.gain();
            }
        }
        0.0
    }

    #[inline(always)]
    fn lanes(&self) -> R {
        self.stack.lanes
    }

    /// The numbers of the matrices of a stage.
    #[inline(always)]
    fn len(&self) -> usize {
        self.stack.numbers()
    }

    in_lanes! {
    /// Computes `mu = U^T pi U`, as `p0 + (pi - p0) + asym(pi C) + C^T pi C`.
    fn momenta(&mut self) {
        let (len, stack) = (self.len(), self.stack);
        let Block { p0, mu, c, momentum_increment, scratch: [pi, turned, twice], .. } = &mut *self.block;
        for k in 0..self.coefficients.stages {
            let stage = k * len..(k + 1) * len;
            let (mu, c, increment) = (&mut mu[stage.clone()], &c[stage.clone()], &momentum_increment[stage.clone()]);
            let (pi, turned) = (&mut pi[stage.clone()], &mut turned[stage]);
            stack.sum(p0, increment, pi);
            stack.product(pi, c, turned);
            stack.upper_of_transposed_product(c, turned, twice);
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let once = stack.get(turned, i, j) - stack.get(turned, j, i);
                    let gained = stack.get(increment, i, j) + (once + stack.get(twice, i, j));
                    stack.put_skew(mu, i, j, stack.get(p0, i, j) + gained);
                }
            }
        }
    }

    /// Computes Omega by (24f, vih6), of bodies in principal axes.
    fn velocities(&mut self) {
        let (len, stack) = (self.len(), self.stack);
        let Block { weights, mu, omega, .. } = &mut *self.block;
        for k in 0..self.coefficients.stages {
            let stage = k * len..(k + 1) * len;
            stack.entrywise_product(weights, &mu[stage.clone()], &mut omega[stage]);
        }
    }

    /// [w], [D], [F], [K] and [C]: one pass. Returns the largest change of an attitude.
    fn turn(&mut self) -> f64 {
        let (len, stack, stages) = (self.len(), self.stack, self.coefficients.stages);
        let Block { omega, c, d, w, f, k, scratch: [before, .., room], .. } = &mut *self.block;
        for j in 0..stages {
            let stage = j * len..(j + 1) * len;
            let (omega, c, w) = (&omega[stage.clone()], &c[stage.clone()], &mut w[stage]);
            stack.plus_product(omega, c, omega, w);
            stack.scale(stack.lanes.constant(self.h * self.coefficients.weights[j]), w);
        }
        combination(&self.coefficients.part, stages, w, d);
        before.copy_from_slice(c);
        let mut change = stack.lanes.constant(0.0);
        for j in 0..stages {
            let stage = j * len..(j + 1) * len;
            let (c, d) = (&mut c[stage.clone()], &d[stage.clone()]);
            let (f, k) = (&mut f[stage.clone()], &mut k[stage.clone()]);
            stack.difference(d, k, c);
            stack.polar_factor(d, c, f, k, room);
            for (now, before) in c.chunks_exact(R::LANES).zip(before[stage].chunks_exact(R::LANES)) {
                change = change.max_or_nan((stack.lanes.get(now) - stack.lanes.get(before)).abs());
            }
        }
        largest(change)
    }

    /// `g = g0 + g0 C`
    fn attitudes_in_space(&mut self) {
        let (len, stack) = (self.len(), self.stack);
        let Block { g0, c, attitude, .. } = &mut *self.block;
        for k in 0..self.coefficients.stages {
            let stage = k * len..(k + 1) * len;
            stack.plus_product(g0, g0, &c[stage.clone()], &mut attitude[stage]);
        }
    }

    /// Takes the torques in space to the frame of g0, as gradients, and to the body: `U^T A U = A + asym(A C) + C^T A C`.
    fn torques_in_body(&mut self) {
        let (len, stack) = (self.len(), self.stack);
        let Block { g0, c, pull, gradient, scratch: [once, turned, room], .. } = &mut *self.block;
        for k in 0..self.coefficients.stages {
            let stage = k * len..(k + 1) * len;
            let (c, pull, gradient) = (&c[stage.clone()], &mut pull[stage.clone()], &mut gradient[stage.clone()]);
            let (once, turned) = (&mut once[stage.clone()], &mut turned[stage]);
            stack.product(pull, g0, once);
            stack.upper_of_transposed_product(g0, once, room);
            for i in 0..stack.n() {
                stack.put(pull, i, i, stack.lanes.constant(0.0));
                for j in i + 1..stack.n() {
                    stack.put_skew(pull, i, j, -stack.get(room, i, j));
                }
            }
            stack.product(pull, c, turned);
            stack.upper_of_transposed_product(c, turned, room);
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let once = stack.get(turned, i, j) - stack.get(turned, j, i);
                    stack.put_skew(gradient, i, j, stack.get(pull, i, j) + (once + stack.get(room, i, j)));
                }
            }
        }
    }

    /// [end] and [Lambda]: the polar factor of the end point in `passes` passes, pi1, and the multiplier, `Lambda_s = -(pi1 +
    /// asym(E_s Lambda_s)) / 2` with `E_s = k f^T`; `f Lambda = Lambda_s f`. [E] of the stages.
    fn end_point(&mut self, passes: usize) {
        let (len, stack, stages) = (self.len(), self.stack, self.coefficients.stages);
        let Block { p0, w, pull, f: stage_f, e, scratch: [a, next, room], end, .. } = &mut *self.block;
        let End { c, d, f, k, multiplier, impulse, f_lambda, .. } = end;
        d.copy_from_slice(&w[..len]);
        for j in 1..stages {
            for (d, w) in d.iter_mut().zip(&w[j * len..(j + 1) * len]) {
                *d += w;
            }
        }
        stack.difference(d, k, c);
        for _ in 0..passes {
            stack.polar_factor(d, c, f, k, room);
        }
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                let mut sum = stack.lanes.constant(0.0);
                for stage in 0..stages {
                    let weight = self.h * self.coefficients.weights[stage];
                    sum = sum + stack.get(&pull[stage * len..(stage + 1) * len], i, j) * -weight;
                }
                stack.put_skew(impulse, i, j, sum);
            }
        }
        let (a, next) = (&mut a[..len], &mut next[..len]);
        // E_s = k f^T, symmetric: f k^T = k^T + c k^T
        for i in 0..stack.n() {
            for j in 0..stack.n() {
                stack.put(room, i, j, stack.get(k, j, i));
            }
        }
        stack.plus_product(room, c, room, a);
        stack.product(a, multiplier, next);
        for i in 0..stack.n() {
            for j in i + 1..stack.n() {
                let pi = stack.get(p0, i, j) + stack.get(impulse, i, j);
                let stretched = stack.get(next, i, j) - stack.get(next, j, i);
                stack.put_skew(multiplier, i, j, (pi + stretched) * -0.5);
            }
        }
        stack.plus_product(multiplier, multiplier, c, f_lambda);
        for stage in 0..stages {
            let stage = stage * len..(stage + 1) * len;
            let (f, e) = (&stage_f[stage.clone()], &mut e[stage]);
            stack.plus_product(f, f, e, next);
            e.copy_from_slice(next);
        }
    }

    /// [X], by (5) of the derivation, then [T], [Y] and [S].
    fn multipliers(&mut self) {
        let (len, stack, stages) = (self.len(), self.stack, self.coefficients.stages);
        let Block { mu, omega, gradient, s, e, x, t, y, c, scratch: [half, load, stretched], end, .. } = &mut *self.block;
        let (half, load) = (&mut half[..len], &mut load[..len]);
        for k in 0..stages {
            let stage = k * len..(k + 1) * len;
            let (mu, s) = (&mu[stage.clone()], &s[stage.clone()]);
            let (x, c) = (&mut x[stage.clone()], &c[stage.clone()]);
            for entry in 0..len {
                half[entry] = 0.5 * mu[entry] - s[entry];
            }
            stack.asym_of_product(half, &omega[stage.clone()], load);
            stack.asym_of_product(&e[stage.clone()], x, stretched);
            let (gradient, weight) = (&gradient[stage.clone()], self.h * self.coefficients.weights[k]);
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let load = stack.get(load, i, j) + stack.get(gradient, i, j);
                    let part = stack.get(stretched, i, j) - load * weight;
                    stack.put_skew(x, i, j, part * 0.5);
                }
            }
            stack.plus_product(x, c, x, &mut t[stage]);
        }
        combination(&self.coefficients.transposed, stages, t, y);
        for k in 0..stages {
            let stage = k * len..(k + 1) * len;
            let c = &c[stage.clone()];
            stack.sum(&end.f_lambda, &y[stage.clone()], half);
            stack.plus_transposed_product(half, c, half, load);
            stack.symmetric_part(load, &mut s[stage]);
        }
    }

    /// [defect] and [transport]. Returns the largest change of a momentum of the stages, relative to those of its body.
    fn transport(&mut self) -> f64 {
        let (len, stack, stages) = (self.len(), self.stack, self.coefficients.stages);
        let Block { p0, c, d, w, k, t, y, pull, delta, momentum_increment, noise, scratch: [part, other, room], end, .. } =
            &mut *self.block;
        for j in 0..stages {
            let stage = j * len..(j + 1) * len;
            let weight = self.h * self.coefficients.weights[j];
            let part = &mut part[stage.clone()];
            stack.asym_of_product(&t[stage.clone()], &d[stage.clone()], part);
            stack.asym_of_product(&y[stage.clone()], &w[stage.clone()], room);
            let pull = &pull[stage];
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let of_defect = stack.get(part, i, j) - stack.get(room, i, j);
                    stack.put(part, i, j, of_defect + stack.get(pull, i, j) * weight);
                }
            }
        }
        combination(&self.coefficients.conjugate, stages, part, delta);
        if let Some(conjugate_defect) = &self.coefficients.conjugate_defect {
            combination(conjugate_defect, stages, w, other);
            for (other, k) in other.iter_mut().zip(k.iter()) {
                *other += k;
            }
        } else {
            other.copy_from_slice(k);
        }
        let zero = stack.lanes.constant(0.0);
        let (mut change, mut size) = (zero, stack.lanes.get(noise).max_or_nan(zero));
        let part = &mut part[..len];
        for j in 0..stages {
            let stage = j * len..(j + 1) * len;
            stack.asym_of_product(&end.f_lambda, &other[stage.clone()], part);
            stack.asym_of_product(&y[stage.clone()], &c[stage.clone()], room);
            let (delta, increment) = (&delta[stage.clone()], &mut momentum_increment[stage]);
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let own = stack.get(part, i, j) - stack.get(room, i, j);
                    let now = own - stack.get(delta, i, j);
                    change = change.max_or_nan((now - stack.get(increment, i, j)).abs());
                    size = size.max_or_nan((stack.get(p0, i, j) + now).abs());
                    size = size.max_or_nan(stack.get(p0, i, j).abs());
                    stack.put_skew(increment, i, j, now);
                }
            }
        }
        largest(change / size.max_or_nan(stack.lanes.constant(SMALLEST_SIZE)))
    }

    /// [gain]: `p1 - p0 = sum_k h b_k ([mu_k, Omega_k] - dH/dg(U_k))`.
    fn gain(&mut self) {
        let (len, stack, stages) = (self.len(), self.stack, self.coefficients.stages);
        let Block { mu, omega, gradient, scratch: [rate, ..], end, .. } = &mut *self.block;
        let (rate, gain) = (&mut rate[..len], &mut end.momentum_increment);
        gain.fill(0.0);
        for k in 0..stages {
            let stage = k * len..(k + 1) * len;
            // asym(mu Omega) = -asym(mu Omega^T)
            stack.asym_of_product(&mu[stage.clone()], &omega[stage.clone()], rate);
            let (gradient, weight) = (&gradient[stage], self.h * self.coefficients.weights[k]);
            for i in 0..stack.n() {
                for j in i + 1..stack.n() {
                    let turning = stack.get(rate, i, j) + stack.get(gradient, i, j);
                    let sum = stack.get(gain, i, j) - turning * weight;
                    stack.put_skew(gain, i, j, sum);
                }
            }
        }
    }
    }
}

/// The largest over the lanes.
#[inline(always)]
fn largest<R: StageScalar>(x: R) -> f64 {
    let mut lanes = [0.0; MOST_BODIES];
    x.put(&mut lanes);
    lanes[..R::LANES].iter().fold(0.0, |most, &x| Real::max_or_nan(most, x))
}
