//! Vectors, matrices and quaternions of space, in lanes. Matrices are rows of columns.
//!
//! Invariant: the result in a lane does not depend on the other lanes.

use super::lanes::Real;

/// A vector of R^3.
pub type Vec3<T> = [T; 3];
/// A 3 x 3 matrix, row by row.
pub type Mat3<T> = [[T; 3]; 3];
/// A symmetric 3 x 3 matrix: xx, yy, zz, yz, xz, xy.
pub type Sym3<T> = [T; 6];

/// A vector by its components.
// A macro and no closure: a closure would not be compiled for the instruction set of its caller.
macro_rules! vec3 {
    ($i:ident => $component:expr) => {
        [
            {
                let $i = 0_usize;
                $component
            },
            {
                let $i = 1_usize;
                $component
            },
            {
                let $i = 2_usize;
                $component
            },
        ]
    };
}

/// A matrix by its entries.
macro_rules! mat3 {
    ($i:ident, $j:ident => $entry:expr) => {
        vec3!($i => vec3!($j => $entry))
    };
}

pub(crate) use {mat3, vec3};

/// `a x b`
#[inline(always)]
pub fn cross<T: Real>(a: &Vec3<T>, b: &Vec3<T>) -> Vec3<T> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a . b`
#[inline(always)]
pub fn dot<T: Real>(a: &Vec3<T>, b: &Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// `a + b`
#[inline(always)]
pub fn plus<T: Real>(a: &Vec3<T>, b: &Vec3<T>) -> Vec3<T> {
    vec3!(i => a[i] + b[i])
}

/// `a - b`
#[inline(always)]
pub fn minus<T: Real>(a: &Vec3<T>, b: &Vec3<T>) -> Vec3<T> {
    vec3!(i => a[i] - b[i])
}

/// `c a`
#[inline(always)]
pub fn scaled<T: Real>(a: &Vec3<T>, c: T) -> Vec3<T> {
    vec3!(i => a[i] * c)
}

/// `M v`
#[inline(always)]
pub fn product<T: Real>(m: &Mat3<T>, v: &Vec3<T>) -> Vec3<T> {
    vec3!(i => dot(&m[i], v))
}

/// `M^T`
#[inline(always)]
pub fn transposed<T: Real>(m: &Mat3<T>) -> Mat3<T> {
    mat3!(i, j => m[j][i])
}

/// `M^T v`
#[inline(always)]
pub fn transposed_product<T: Real>(m: &Mat3<T>, v: &Vec3<T>) -> Vec3<T> {
    vec3!(i => m[0][i] * v[0] + m[1][i] * v[1] + m[2][i] * v[2])
}

/// `S v`, S symmetric.
#[inline(always)]
pub fn symmetric_product<T: Real>([xx, yy, zz, yz, xz, xy]: &Sym3<T>, v: &Vec3<T>) -> Vec3<T> {
    [
        *xx * v[0] + *xy * v[1] + *xz * v[2],
        *xy * v[0] + *yy * v[1] + *yz * v[2],
        *xz * v[0] + *yz * v[1] + *zz * v[2],
    ]
}

/// `A^T B`
#[inline(always)]
pub fn transposed_matrix_product<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Mat3<T> {
    mat3!(i, j => a[0][i] * b[0][j] + a[1][i] * b[1][j] + a[2][i] * b[2][j])
}

/// `A B`
#[inline(always)]
pub fn matrix_product<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Mat3<T> {
    mat3!(i, j => a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j])
}

/// `M hat(v)`: each row r becomes `r x v`.
#[inline(always)]
pub fn times_hat<T: Real>(m: &Mat3<T>, v: &Vec3<T>) -> Mat3<T> {
    vec3!(i => cross(&m[i], v))
}

/// `vee(M - M^T)`
#[inline(always)]
pub fn vee_asym<T: Real>(m: &Mat3<T>) -> Vec3<T> {
    [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]
}

/// `vee(A B^T - B A^T)`
#[inline(always)]
pub fn asym_of_product<T: Real>(a: &Mat3<T>, b: &Mat3<T>) -> Vec3<T> {
    [
        dot(&a[2], &b[1]) - dot(&a[1], &b[2]),
        dot(&a[0], &b[2]) - dot(&a[2], &b[0]),
        dot(&a[1], &b[0]) - dot(&a[0], &b[1]),
    ]
}

/// `I + M`
#[inline(always)]
pub fn with_one<T: Real>(m: &Mat3<T>) -> Mat3<T> {
    let mut sum = *m;
    for i in 0..3 {
        sum[i][i] = sum[i][i] + 1.0;
    }
    sum
}

/// `(2 I + M)^-1 - I / 2` of a symmetric M: `(adj M - 2 M - (tr adj M + det M / 2) I) / det(2 I + M)`, adj M its cofactors.
///
/// In small numbers: where M is below 1e-8 an inverse is rounded to one and the same side as often as not.
#[inline(always)]
pub fn inverse_less_half<T: Real>([xx, yy, zz, yz, xz, xy]: &Sym3<T>) -> Sym3<T> {
    let x = *yy * *zz - *yz * *yz;
    let y = *xx * *zz - *xz * *xz;
    let z = *xx * *yy - *xy * *xy;
    let off_yz = *xy * *xz - *xx * *yz;
    let off_xz = *xy * *yz - *xz * *yy;
    let off_xy = *xz * *yz - *xy * *zz;
    let trace = *xx + *yy + *zz;
    let minors = x + y + z;
    let det = *xx * x + *xy * off_xy + *xz * off_xz;
    let common = minors + det * 0.5;
    let scale = det.constant(1.0) / ((trace + trace + minors) * 2.0 + det + 8.0);
    [
        (x - common - (*xx + *xx)) * scale,
        (y - common - (*yy + *yy)) * scale,
        (z - common - (*zz + *zz)) * scale,
        (off_yz - (*yz + *yz)) * scale,
        (off_xz - (*xz + *xz)) * scale,
        (off_xy - (*xy + *xy)) * scale,
    ]
}

/// `I - M^T M`, each product taken off the identity: see [`crate::so::norm_error`].
#[inline(always)]
pub fn norm_error<T: Real>(m: &Mat3<T>) -> Sym3<T> {
    let [a, b, c] = m;
    macro_rules! entry {
        ($one:literal, $i:literal, $j:literal) => {
            ((-(a[$i] * a[$j]) + $one) - b[$i] * b[$j]) - c[$i] * c[$j]
        };
    }
    [
        entry!(1.0, 0, 0),
        entry!(1.0, 1, 1),
        entry!(1.0, 2, 2),
        entry!(0.0, 1, 2),
        entry!(0.0, 0, 2),
        entry!(0.0, 0, 1),
    ]
}

/// `M + M E / 2` with `E = I - M^T M`, given E: a step of Newton and Schulz towards the nearest rotation, which squares E.
#[inline(always)]
pub fn mended<T: Real>(m: &Mat3<T>, error: &Sym3<T>) -> Mat3<T> {
    vec3!(i => {
        let change = symmetric_product(error, &m[i]);
        vec3!(j => m[i][j] + change[j] * 0.5)
    })
}

/// Largest square of an angle in radians for which [`sine_series`] is exact to round-off.
pub const SERIES_UP_TO: f64 = 1.0;

/// `sin(t) / t` and `(1 - cos(t)) / t^2`, given t^2 up to [`SERIES_UP_TO`]: Taylor's series, of which nine terms leave 1e-17.
#[inline(always)]
pub fn sine_series<T: Real>(square: T) -> [T; 2] {
    let (mut sine, mut versine) = (square.constant(1.0), square.constant(1.0));
    for k in (1..9_u32).rev() {
        let last = f64::from(2 * k + 1);
        sine = sine * square * (-1.0 / (last * (last - 1.0))) + 1.0;
        versine = versine * square * (-1.0 / ((last + 1.0) * last)) + 1.0;
    }
    [sine, versine * 0.5]
}

/// `exp(hat(v))`, given the square of v, at most [`SERIES_UP_TO`]: Rodrigues (1840), see [`crate::so::exp`].
#[inline(always)]
pub fn exp<T: Real>(v: &Vec3<T>, square: T) -> Mat3<T> {
    let [a, b] = sine_series(square);
    let [x, y, z] = *v;
    let (bx, by, bz) = (b * x, b * y, b * z);
    let (xy, xz, yz) = (bx * y, bx * z, by * z);
    let (xx, yy, zz) = (bx * x, by * y, bz * z);
    let (ax, ay, az) = (a * x, a * y, a * z);
    with_one(&[
        [-(yy + zz), xy - az, xz + ay],
        [xy + az, -(xx + zz), yz - ax],
        [xz - ay, yz + ax, -(xx + yy)],
    ])
}

/// A quaternion `w + v`; of length one it is a rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quaternion<T> {
    /// The real part.
    pub w: T,
    /// The imaginary part.
    pub v: Vec3<T>,
}

impl<T: Real> Quaternion<T> {
    /// The rotation of Cayley's with the vector `half`: `(1 + half) / |1 + half|`, about it by 2 atan |half|.
    #[inline(always)]
    pub fn cayley(half: &Vec3<T>) -> Self {
        Self { w: half[0].constant(1.0), v: *half }.normalised()
    }

    /// Normalises to second order in the deficit. It goes to w rather than to v, which holds the
    /// angle: (1 + v^2) w^2 + v^2 v^2 = 1. A common factor near one is biased, and the energy of a
    /// run with it.
    #[inline(always)]
    pub fn lengthened_by_w(&self) -> Self {
        let square = dot(&self.v, &self.v);
        let norm_error = ((-self.w + 1.0) * (self.w + 1.0) - square) * 0.5;
        let (for_w, for_v) = (norm_error * (square + 1.0), norm_error * square);
        Self { w: self.w + self.w * for_w, v: vec3!(i => self.v[i] + self.v[i] * for_v) }
    }

    /// `self (1 + half)`, normalised to the fourth order of `half` and the second of the deficit of
    /// `self`.
    #[inline(always)]
    pub fn turned(&self, half: &Vec3<T>) -> Self {
        let Self { w, v } = self.lengthened_by_w();
        // |q (1 + a)|^2 = |q|^2 + |a|^2, and 1 / sqrt(1 + e) = 1 - e / 2 to second order.
        let shrink = dot(half, half) * -0.5;
        let c = cross(&v, half);
        let turned_w = w - dot(&v, half);
        let turned_v: Vec3<T> = vec3!(i => v[i] + (w * half[i] + c[i]));
        Self { w: turned_w + turned_w * shrink, v: vec3!(i => turned_v[i] + turned_v[i] * shrink) }
    }

    /// `q v` for a vector v: the rate of change of q under the angular velocity 2 v of the body.
    #[inline(always)]
    pub fn rate(&self, v: &Vec3<T>) -> Self {
        let c = cross(&self.v, v);
        Self { w: -dot(&self.v, v), v: vec3!(i => self.w * v[i] + c[i]) }
    }

    /// |q|^2
    #[inline(always)]
    pub fn square(&self) -> T {
        self.w * self.w + dot(&self.v, &self.v)
    }

    /// Normalises to second order in the deficit of the square.
    #[inline(always)]
    pub fn lengthened(&self) -> Self {
        // 1 / sqrt(1 + e) = 1 - e / 2
        self.scaled(self.square() * -0.5 + 1.5)
    }

    /// Normalises to length one.
    #[inline(always)]
    pub fn normalised(&self) -> Self {
        let length = self.square().sqrt();
        self.scaled(length.constant(1.0) / length)
    }

    /// `self` where `measure` is a number up to `limit`, elsewhere `other`.
    #[inline(always)]
    pub fn select(&self, measure: T, limit: f64, other: &Self) -> Self {
        Self {
            w: self.w.select(measure, limit, other.w),
            v: vec3!(i => self.v[i].select(measure, limit, other.v[i])),
        }
    }

    #[inline(always)]
    fn scaled(&self, scale: T) -> Self {
        Self { w: self.w * scale, v: scaled(&self.v, scale) }
    }

    /// `q p`
    #[inline(always)]
    pub fn times(&self, p: &Self) -> Self {
        let c = cross(&self.v, &p.v);
        Self {
            w: self.w * p.w - dot(&self.v, &p.v),
            v: vec3!(i => self.w * p.v[i] + p.w * self.v[i] + c[i]),
        }
    }

    /// The rotation matrix.
    #[inline(always)]
    pub fn matrix(&self) -> Mat3<T> {
        with_one(&self.change())
    }

    /// The rotation matrix less one, without cancellation.
    #[inline(always)]
    pub fn change(&self) -> Mat3<T> {
        // 2 w hat(v) + 2 hat(v)^2
        let [x, y, z] = self.v;
        let (x2, y2, z2) = (x + x, y + y, z + z);
        let (xx, yy, zz) = (x * x2, y * y2, z * z2);
        let (xy, xz, yz) = (x * y2, x * z2, y * z2);
        let (wx, wy, wz) = (self.w * x2, self.w * y2, self.w * z2);
        [
            [-(yy + zz), xy - wz, xz + wy],
            [xy + wz, -(xx + zz), yz - wx],
            [xz - wy, yz + wx, -(xx + yy)],
        ]
    }
}
