//! dH/dg for n = 3, for the stages of a step side by side.

use super::RigidBody;
use crate::lanes::{Stages, Whole};
use crate::so::Mat;
use crate::so3;
use crate::space::{Mat3, Vec3, cross, plus, transposed_product, vec3};

impl RigidBody<3> {
    /// vee(dH/dg) at `g = g0 U`, given the space vectors `seen` from g0: [`RigidBody::gradient`] in lanes. Next to
    /// it the nearness, minus the square of the smallest relative distance to a point of the potential; -1 if
    /// there is none; [`RigidBody::check_distances`] refuses from `-CLOSEST_APPROACH^2` on. The caller
    /// counts the evaluations: not every lane is a stage.
    ///
    /// A term U(q) with `q = U^T v` has `dH/dg = q s^T - s q^T = hat(s x q)`, s its slope dU/dq.
    #[inline(always)]
    pub fn torque<R: Stages>(
        &self,
        u: &Mat3<R>,
        seen: &[Vec3<<R::Whole as Whole>::Plain>],
    ) -> (Vec3<R>, R) {
        let like = u[0][0];
        let mut torque = [like.constant(0.0); 3];
        let mut nearness = like.constant(-1.0);
        for ((term, reach), v) in self.terms.iter().zip(&self.reaches).zip(seen) {
            let v: Vec3<R> = vec3!(i => like.spread(like.stage(0).load(&v[i])));
            let q = transposed_product(u, &v);
            let slope = term.law.slope(&q, *reach, &mut nearness);
            torque = plus(&torque, &cross(&slope, &q));
        }
        if self.has_own() {
            let (own, refused) = self.own_torque(u, seen);
            (torque, nearness) = (plus(&torque, &own), nearness.larger(refused));
        }
        (torque, nearness)
    }

    /// The same of the potentials of one's own, which know no lanes; with it 0 where one of them refuses the attitude,
    /// else -1.
    fn own_torque<R: Stages>(
        &self,
        u: &Mat3<R>,
        seen: &[Vec3<<R::Whole as Whole>::Plain>],
    ) -> (Vec3<R>, R) {
        let like = u[0][0];
        let mut g = *u;
        // Row i is U^T (g0^T e_i).
        for (row, v) in g.iter_mut().zip(seen.iter().skip(self.terms.len())) {
            let v: Vec3<R> = vec3!(i => like.spread(like.stage(0).load(&v[i])));
            *row = transposed_product(u, &v);
        }
        let [x, y, z, refused] = R::lane_by_lane(g, &mut |g| {
            let g = Mat::<3>::from_fn(|i, j| g[i][j]);
            let torque = so3::vector(&self.own.gradient(&g));
            let refused = if self.own.check(&g).is_err() { 0.0 } else { -1.0 };
            [torque.x, torque.y, torque.z, refused]
        });
        ([x, y, z], refused)
    }
}
