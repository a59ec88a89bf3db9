//! dH/dg for the stages of a step side by side: for n = 3 in vectors, for any n in matrices.

use super::RigidBody;
use super::term::{Lanes, LawRef};
use crate::lanes::extras::USER;
use crate::lanes::{StageScalar, StepScalar};
use crate::so::Mat;
use crate::so3;
use crate::space::{Mat3, Vec3, cross, plus, transposed_product, vec3};
use crate::stack::{Dimension, Known, StageMatrices};

impl RigidBody<3> {
    /// vee(dH/dg) at `g = g0 U`, given the space vectors `seen` from g0:
    /// [`RigidBody::gradient_seen`] in lanes. With it comes the proximity, minus the square of the
    /// smallest relative distance to a point of the potential; -1 if there is none;
    /// [`RigidBody::check_distances_seen`] refuses from `-CLOSEST_APPROACH^2` on. The caller counts
    /// the evaluations: not every lane is a stage. Without `USER` in `EXTRAS`, user-defined potentials are left
    /// out (`in_stage_lanes`).
    ///
    /// A term U(q) with `q = U^T v` has `dH/dg = q s^T - s q^T = hat(s x q)`, s its slope dU/dq.
    #[inline(always)]
    pub(crate) fn torque<R: StageScalar, const EXTRAS: u8>(
        &self,
        u: &Mat3<R>,
        seen: &[Vec3<<R::StepScalar as StepScalar>::Storage>],
    ) -> (Vec3<R>, R) {
        let lanes = u[0][0];
        let mut torque = [lanes.constant(0.0); 3];
        let mut proximity = lanes.constant(-1.0);
        for ((term, inverse_arm_squared), v) in
            self.terms.iter().zip(&self.inverse_arms_squared).zip(seen)
        {
            let v: Vec3<R> = vec3!(i => lanes.spread(lanes.stage(0).load(&v[i])));
            let q = transposed_product(u, &v);
            let q = Lanes { dimension: Known::<3>, numbers: q };
            let slope = term.law.numbers().slope(&q, *inverse_arm_squared, &mut proximity);
            torque = plus(&torque, &cross(&slope.numbers, &q.numbers));
        }
        if EXTRAS & USER != 0 && self.has_user_potential() {
            let (own, refused) = self.own_torque(u, seen);
            (torque, proximity) = (plus(&torque, &own), proximity.max_or_nan(refused));
        }
        (torque, proximity)
    }

    /// Returns the torque of user-defined potentials, which know no lanes; with it 0 where one of
    /// them refuses the attitude, else -1.
    fn own_torque<R: StageScalar>(
        &self,
        u: &Mat3<R>,
        seen: &[Vec3<<R::StepScalar as StepScalar>::Storage>],
    ) -> (Vec3<R>, R) {
        let lanes = u[0][0];
        let mut g = *u;
        // Row i is U^T (g0^T e_i).
        for (row, v) in g.iter_mut().zip(seen.iter().skip(self.terms.len())) {
            let v: Vec3<R> = vec3!(i => lanes.spread(lanes.stage(0).load(&v[i])));
            *row = transposed_product(u, &v);
        }
        let [x, y, z, refused] = R::out_of_lanes(g, &mut |g, found| {
            let g: Vec<_> = g.iter().map(|g| Mat::<3>::from_fn(|i, j| g[i][j])).collect();
            for ((found, g), gradient) in found.iter_mut().zip(&g).zip(self.user.gradients(&g)) {
                let torque = so3::vee(&gradient);
                let refused = if self.user.check(g).is_err() { 0.0 } else { -1.0 };
                *found = [torque.x, torque.y, torque.z, refused];
            }
        });
        ([x, y, z], refused)
    }
}

/// The terms of a rigid body's potential, of whatever n.
pub(crate) trait Terms {
    /// Number of terms.
    fn count(&self) -> usize;
    /// A term's law, and [`Term::inverse_arm_squared`] of it.
    fn term(&self, i: usize) -> (LawRef<'_>, f64);
}

impl<const N: usize> Terms for RigidBody<N> {
    fn count(&self) -> usize {
        self.terms.len()
    }

    fn term(&self, i: usize) -> (LawRef<'_>, f64) {
        (self.terms[i].law.numbers(), self.inverse_arms_squared[i])
    }
}

/// The torques of a rigid body at the stages of a step side by side, at attitudes `g = g0 (I + C_k)`, in any dimension.
///
/// A term U(q) with `q = v + C^T v` has `dH/dg = q s^T - s q^T`, s its slope dU/dq; turned to the frame of g0 this is
/// `v z^T - z v^T` with `z = s + C s`.
pub(crate) struct Torques<'a, R: StageScalar, D: Dimension> {
    pub(super) stack: StageMatrices<R, D>,
    pub(super) terms: &'a dyn Terms,
    /// The space vectors of the potential, as seen from g0, one after the other.
    seen: &'a [f64],
    /// Largest proximity, as returned by [`RigidBody::torque`].
    pub(crate) proximity: f64,
}

impl<'a, R: StageScalar<StepScalar = f64>, D: Dimension> Torques<'a, R, D> {
    pub(crate) fn new(stack: StageMatrices<R, D>, terms: &'a dyn Terms, seen: &'a [f64]) -> Self {
        Self { stack, terms, seen, proximity: -1.0 }
    }

    /// `dH/dg` at the stages; keeps the slopes of the terms, one after the other.
    #[inline(never)]
    pub(crate) fn gradient(&mut self, c: &[f64], slopes: &mut Vec<f64>, gradient: &mut [f64]) {
        self.stack.lanes.vectorized(
            #[inline(always)]
            || self.gradient_in_lanes(c, slopes, gradient),
        );
    }

    #[inline(always)]
    fn gradient_in_lanes(&mut self, c: &[f64], slopes: &mut Vec<f64>, gradient: &mut [f64]) {
        let StageMatrices { lanes, dimension } = self.stack;
        let (n, len) = (self.stack.n(), self.stack.numbers());
        let gradient = &mut gradient[..len];
        let mut proximity = lanes.constant(-1.0);
        slopes.resize(self.seen.len() * R::LANES, 0.0);
        for (i, kept) in slopes.chunks_exact_mut(n * R::LANES).enumerate() {
            let (law, inverse_arm_squared) = self.terms.term(i);
            let q = Lanes { dimension, numbers: self.seen_by_stages(i, c) };
            let slope = law.slope(&q, inverse_arm_squared, &mut proximity).numbers;
            self.stack.add_wedge(i == 0, &q.numbers, &slope, gradient);
            self.stack.put_vector(&slope, kept);
        }
        self.proximity = proximity.largest();
    }

    /// Adds `v s^T` of term i.
    #[inline(always)]
    pub(super) fn add_outer(&self, i: usize, s: &D::Vector<R>, sum: &mut [f64]) {
        let n = self.stack.n();
        let (v, sum) = (&self.seen[i * n..(i + 1) * n], &mut sum[..self.stack.numbers()]);
        for (row, &v) in v.iter().enumerate() {
            for j in 0..n {
                self.stack.put(sum, row, j, self.stack.get(sum, row, j) + s[j] * v);
            }
        }
    }

    /// `q = U_k^T v` of term i at the stages.
    #[inline(always)]
    pub(super) fn seen_by_stages(&self, i: usize, c: &[f64]) -> D::Vector<R> {
        let StageMatrices { lanes, dimension } = self.stack;
        let (n, c) = (dimension.n(), &c[..self.stack.numbers()]);
        let v = &self.seen[i * n..(i + 1) * n];
        let mut q = dimension.vector(lanes.constant(0.0));
        for k in 0..n {
            for i in 0..n {
                q[i] = q[i] + self.stack.get(c, k, i) * v[k];
            }
        }
        for i in 0..n {
            q[i] = q[i] + v[i];
        }
        q
    }

    /// `U_k (dH/dg) U_k^T` at the stages, with the last slopes.
    #[inline(always)]
    pub(crate) fn spatial_gradient(&self, c: &[f64], slopes: &[f64], turned: &mut [f64]) {
        let StageMatrices { lanes, dimension } = self.stack;
        let (n, len) = (self.stack.n(), self.stack.numbers());
        let (c, turned) = (&c[..len], &mut turned[..len]);
        let slopes = slopes.chunks_exact(n * R::LANES);
        for (i, (v, slope)) in self.seen.chunks_exact(n).zip(slopes).enumerate() {
            let mut z = dimension.vector(lanes.constant(0.0));
            let mut spread = z;
            for i in 0..n {
                for k in 0..n {
                    z[i] = z[i] + self.stack.get(c, i, k) * lanes.get(&slope[k * R::LANES..]);
                }
                z[i] = z[i] + lanes.get(&slope[i * R::LANES..]);
                spread[i] = lanes.constant(v[i]);
            }
            self.stack.add_wedge(i == 0, &spread, &z, turned);
        }
    }
}
