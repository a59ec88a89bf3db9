//! Operations of a VPD step for n = 3 in vectors and quaternions, for all stages in lanes; those of a tagged
//! line of docs/derivation.md carry its tag.

use crate::hamiltonian::RigidBody;
use crate::lanes::{Real, Row, StageScalar, WIDTH};
use crate::space::{
    Mat3, Quaternion, Sym3, Vec3, asym_of_product, dot, inverse_less_half, mat3, minus,
    symmetric_product, times_hat, transposed, transposed_matrix_product, vec3,
};

/// The inertia J of the body, in the form in which it divides a momentum.
#[derive(Clone, Copy, Debug)]
pub(super) struct Inertia<T> {
    /// J^-1.
    inverse: Sym3<T>,
    /// Is it diagonal, as in principal axes?
    principal: bool,
}

impl Inertia<f64> {
    /// Returns the inertia of a body.
    pub(super) fn of(body: &RigidBody<3>) -> Self {
        let m = body.inverse_inertia();
        let inverse = [m.m11, m.m22, m.m33, m.m23, m.m13, m.m12];
        Self { inverse, principal: inverse[3..] == [0.0; 3] }
    }

    /// Returns the same for all lanes.
    #[inline(always)]
    pub(super) fn in_lanes<R: Real>(&self, lanes: R) -> Inertia<R> {
        let mut inverse = [lanes; 6];
        for i in 0..6 {
            inverse[i] = lanes.constant(self.inverse[i]);
        }
        Inertia { inverse, principal: self.principal }
    }
}

impl<R: Real> Inertia<R> {
    /// `J^-1 v`
    #[inline(always)]
    pub(super) fn divides(&self, v: &Vec3<R>) -> Vec3<R> {
        if self.principal {
            vec3!(i => self.inverse[i] * v[i])
        } else {
            symmetric_product(&self.inverse, v)
        }
    }
}

/// Computes [T] and [Y]: `T_k = U_k hat(x_k)` and `Y_k = sum_i e_ik T_i`, the part of W_k that
/// differs from stage to stage.
#[inline(always)]
pub(super) fn embedded<R: StageScalar>(
    u: &Mat3<R>,
    x: &Vec3<R>,
    rows: &[Row; WIDTH],
) -> [Mat3<R>; 2] {
    let t = times_hat(u, x);
    [t, mat3!(i, j => t[i][j].apply_tableau(rows))]
}

/// [defect]: `vee asym(f Lambda K_k^T - Y_k C_k^T - sum_j (1 - e_jk) (T_j D_j^T - Y_j w_j^T))`.
#[inline(always)]
pub(super) fn defect<R: StageScalar>(
    f_lambda: &Mat3<R>,
    [c, d, k]: [&Mat3<R>; 3],
    w: &Mat3<R>,
    [t, y]: [&Mat3<R>; 2],
    conjugate: &[Row; WIDTH],
) -> Vec3<R> {
    let parts = minus(&asym_of_product(t, d), &asym_of_product(y, w));
    let (of_end, of_turn) = (asym_of_product(f_lambda, k), asym_of_product(y, c));
    vec3!(i => of_end[i] - (of_turn[i] + parts[i].apply_tableau(conjugate)))
}

/// `vee asym(U^T A)` for `A = I + D`: vee asym(U^T) = -4 w v without cancellation.
#[inline(always)]
pub(super) fn residual<T: Real>(attitude: &Quaternion<T>, u: &Mat3<T>, d: &Mat3<T>) -> Vec3<T> {
    let [u, d] = [transposed(u), transposed(d)];
    let factor = attitude.w * -4.0;
    [
        factor * attitude.v[0] + (dot(&u[2], &d[1]) - dot(&u[1], &d[2])),
        factor * attitude.v[1] + (dot(&u[0], &d[2]) - dot(&u[2], &d[0])),
        factor * attitude.v[2] + (dot(&u[1], &d[0]) - dot(&u[0], &d[1])),
    ]
}

/// `E = P - I = sym(U^T A) - I` for `A = I + D`: sym(U) - I = 2 hat(v)^2 = 2 (v v^T - |v|^2 I) without cancellation.
#[inline(always)]
pub(super) fn stretch_of<T: Real>(attitude: &Quaternion<T>, u: &Mat3<T>, d: &Mat3<T>) -> Sym3<T> {
    let [x, y, z] = attitude.v;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let b = transposed_matrix_product(u, d);
    [
        (yy + zz) * -2.0 + b[0][0],
        (xx + zz) * -2.0 + b[1][1],
        (xx + yy) * -2.0 + b[2][2],
        y * z * 2.0 + (b[1][2] + b[2][1]) * 0.5,
        x * z * 2.0 + (b[0][2] + b[2][0]) * 0.5,
        x * y * 2.0 + (b[0][1] + b[1][0]) * 0.5,
    ]
}

/// `Q(P)^-1 - I / 2` for `P = I + E`: Q(P) = 2 I + tr(E) I - E.
#[inline(always)]
pub(super) fn inverse_of_q<T: Real>([xx, yy, zz, yz, xz, xy]: &Sym3<T>) -> Sym3<T> {
    inverse_less_half(&[*yy + *zz, *xx + *zz, *xx + *yy, -*yz, -*xz, -*xy])
}

/// Returns `Q(P)^-1 v`, given `Q(P)^-1 - I / 2`.
#[inline(always)]
pub(super) fn over_q<T: Real>(inverse: &Sym3<T>, v: &Vec3<T>) -> Vec3<T> {
    let rest = symmetric_product(inverse, v);
    vec3!(i => v[i] * 0.5 + rest[i])
}

/// Stores a vector.
#[inline(always)]
pub(super) fn store<R: StageScalar>(value: &Vec3<R>, plain: &mut Vec3<R::Storage>) {
    for i in 0..3 {
        value[i].store(&mut plain[i]);
    }
}
