//! The group SO(n) and its Lie algebra, in the conventions of Shen, Tran, Leok (2022), section 2.
//!
//! Skew matrices stand for both velocities and momenta; the pairing is `<X, Y> = tr(X Y^T) / 2`, the
//! sum over i < j, which for n = 3 is the dot product under the hat map.
//!
//! Products are plain loops here, for all code that is generic in n: at these sizes they are quicker than the general ones of
//! nalgebra, and a tenth of their length, which counts where each is compiled for sixteen n.
//!
//! Invariant: [`polar`] returns an orthogonal matrix to round-off or nothing.

use nalgebra::{DMatrix, Matrix3, SMatrix, SVector, Vector3};

mod spectrum;

pub use spectrum::{
    angle, frequencies, orthogonality_error, smallest_eigenvalue, smallest_eigenvalue_bound,
};

/// An n x n matrix.
pub type Mat<const N: usize> = SMatrix<f64, N, N>;
/// A vector of R^n.
pub type Vector<const N: usize> = SVector<f64, N>;

/// `asym(A) = A - A^T`, the projection to so(n) that is adjoint to the inclusion:
/// `<X, asym(A)> = tr(X A^T)`.
pub fn asym<const N: usize>(a: &Mat<N>) -> Mat<N> {
    a - a.transpose()
}

/// The skew part `asym(A) / 2`.
pub fn skew<const N: usize>(a: &Mat<N>) -> Mat<N> {
    asym(a) * 0.5
}

/// `A B`. Loops of constant length, which the compiler unrolls.
#[inline]
pub fn product<const N: usize>(a: &Mat<N>, b: &Mat<N>) -> Mat<N> {
    product_here(a, b)
}

/// `A B`, compiled for the instruction set of the caller.
#[inline(always)]
pub(crate) fn product_here<const N: usize>(a: &Mat<N>, b: &Mat<N>) -> Mat<N> {
    let mut c = Mat::zeros();
    for j in 0..N {
        for k in 0..N {
            let x = b[(k, j)];
            for i in 0..N {
                c[(i, j)] += a[(i, k)] * x;
            }
        }
    }
    c
}

/// `A^T B`.
#[inline]
pub fn transposed_product<const N: usize>(a: &Mat<N>, b: &Mat<N>) -> Mat<N> {
    let mut c = Mat::zeros();
    for j in 0..N {
        for i in 0..N {
            let mut sum = 0.0;
            for k in 0..N {
                sum += a[(k, i)] * b[(k, j)];
            }
            c[(i, j)] = sum;
        }
    }
    c
}

/// `g y`: a vector of the body in space coordinates.
#[inline]
pub fn to_space<const N: usize>(g: &Mat<N>, y: &Vector<N>) -> Vector<N> {
    let mut x = Vector::zeros();
    for k in 0..N {
        for i in 0..N {
            x[i] += g[(i, k)] * y[k];
        }
    }
    x
}

/// `g^T x`: a vector of space, seen in the body.
#[inline]
pub fn to_body<const N: usize>(g: &Mat<N>, x: &Vector<N>) -> Vector<N> {
    let mut y = Vector::zeros();
    for i in 0..N {
        for k in 0..N {
            y[i] += g[(k, i)] * x[k];
        }
    }
    y
}

/// `a b^T - b a^T`.
pub fn wedge<const N: usize>(a: &Vector<N>, b: &Vector<N>) -> Mat<N> {
    let mut x = Mat::zeros();
    for j in 0..N {
        for i in 0..N {
            x[(i, j)] = a[i] * b[j] - b[i] * a[j];
        }
    }
    x
}

/// `sum_i a_i b_i`, in four sums: a processor adds several at once.
#[inline]
pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (a.chunks_exact(4), b.chunks_exact(4));
    let (rest_of_a, rest_of_b) = (a.remainder(), b.remainder());
    let mut sums = [0.0; 4];
    for (a, b) in a.zip(b) {
        for i in 0..4 {
            sums[i] += a[i] * b[i];
        }
    }
    let rest = rest_of_a.iter().zip(rest_of_b).map(|(a, b)| a * b);
    rest.fold(sums[0] + sums[1] + sums[2] + sums[3], |sum, x| sum + x)
}

/// The square root of the sum of squares.
pub(crate) fn norm(x: &[f64]) -> f64 {
    dot(x, x).sqrt()
}

/// The symmetric part `(A + A^T) / 2`.
pub fn symmetric_part<const N: usize>(a: &Mat<N>) -> Mat<N> {
    (a + a.transpose()) * 0.5
}

/// The pairing `<X, Y> = sum_{i<j} X_ij Y_ij` of two skew matrices.
pub fn inner<const N: usize>(x: &Mat<N>, y: &Mat<N>) -> f64 {
    0.5 * dot(x.as_slice(), y.as_slice())
}

/// `g X g^T`: a skew matrix in body coordinates, in those of space (the adjoint action).
pub fn conjugate<const N: usize>(g: &Mat<N>, x: &Mat<N>) -> Mat<N> {
    product(&product(g, x), &g.transpose())
}

/// Number of coordinates of so(n): n (n - 1) / 2.
pub const fn dimension(n: usize) -> usize {
    n * (n - 1) / 2
}

/// Skew matrix from its n(n-1)/2 coordinates.
///
/// For n = 3 the hat map, `hat(x) y = x cross y`; else the entries above the diagonal, row by row.
///
/// # Panics
/// Panics if `coordinates` is not of length n(n-1)/2.
pub fn hat<const N: usize>(coordinates: &[f64]) -> Mat<N> {
    assert_eq!(coordinates.len(), dimension(N), "coordinates of so({N})");
    let mut x = Mat::<N>::zeros();
    for (&value, (i, j, sign)) in coordinates.iter().zip(coordinate_places::<N>()) {
        x[(i, j)] = sign * value;
        x[(j, i)] = -sign * value;
    }
    x
}

/// The n(n-1)/2 coordinates of a skew matrix: the inverse of [`hat`].
pub fn vee<const N: usize>(x: &Mat<N>) -> Vec<f64> {
    coordinate_places::<N>().map(|(i, j, sign)| sign * x[(i, j)]).collect()
}

/// Returns the place of each coordinate of so(n): row, column, sign.
pub(crate) fn coordinate_places<const N: usize>() -> impl Iterator<Item = (usize, usize, f64)> {
    // hat(x) = [[0, -x3, x2], [x3, 0, -x1], [-x2, x1, 0]]
    let vector = [(2, 1, 1.0), (0, 2, 1.0), (1, 0, 1.0)];
    let above = (0..N).flat_map(|i| (i + 1..N).map(move |j| (i, j, 1.0)));
    let three = if N == 3 { vector.as_slice() } else { &[] };
    let three: Vec<_> = three.to_vec();
    three.into_iter().chain(above.filter(|_| N != 3))
}

/// Returns the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix; `None` unless n = 3.
///
/// The largest of the four squared components gives the first one and the others follow by division
/// (Shepperd 1978): no cancellation and no trigonometry. A matrix that is not quite a rotation, as
/// some baseline methods leave it, gives the normalised result of the same formulas.
pub fn quaternion<const N: usize>(r: &Mat<N>) -> Option<[f64; 4]> {
    if N != 3 {
        return None;
    }
    let trace = r[(0, 0)] + r[(1, 1)] + r[(2, 2)];
    // Numbered as the components: 4 q_k^2 = 1 + 2 pivot_k - trace, and 1 + trace for w.
    let pivots = [trace, r[(0, 0)], r[(1, 1)], r[(2, 2)]];
    let largest = (1..4).fold(0, |best, k| if pivots[k] > pivots[best] { k } else { best });
    // Each is four times the product of q_largest with the component in its place.
    let difference = |i: usize, j: usize| r[(i, j)] - r[(j, i)];
    let sum = |i: usize, j: usize| r[(i, j)] + r[(j, i)];
    let mut q = match largest {
        0 => [1.0 + trace, difference(2, 1), difference(0, 2), difference(1, 0)],
        1 => [difference(2, 1), 1.0 + 2.0 * r[(0, 0)] - trace, sum(0, 1), sum(0, 2)],
        2 => [difference(0, 2), sum(0, 1), 1.0 + 2.0 * r[(1, 1)] - trace, sum(1, 2)],
        _ => [difference(1, 0), sum(0, 2), sum(1, 2), 1.0 + 2.0 * r[(2, 2)] - trace],
    };
    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    if !norm.is_finite() {
        // A baseline that blew up: no direction is left in such a matrix.
        return Some([1.0, 0.0, 0.0, 0.0]);
    }
    let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
    for x in &mut q {
        *x *= sign / norm;
    }
    Some(q)
}

/// The orthogonal polar factor `U` of `A = U P`, by Newton's iteration (4, newtoniterate)
/// `U <- (U + U^-T) / 2` from `U = A`.
///
/// `None` if `A` is singular or not finite. The sign of det A is kept: for det A < 0 the result is in
/// O(n) but not in SO(n).
pub fn polar<const N: usize>(a: &Mat<N>) -> Option<Mat<N>> {
    // From a singular value s the first sweep gives about 1 / 2s and each further one halves it until
    // the quadratic phase: 60 sweeps reach down to s = 1e-15.
    const MAX_SWEEPS: usize = 60;
    let mut u = *a;
    let mut previous = f64::INFINITY;
    for _ in 0..MAX_SWEEPS {
        let next = (u + inverse_transpose(&u)?) * 0.5;
        let change = (next - u).amax();
        u = next;
        // Quadratic: a change of 1e-8 leaves an error of 1e-16.
        if change <= 1e-8 {
            return Some(u);
        }
        if !change.is_finite() || (change >= previous && previous < 0.5) {
            return None;
        }
        previous = change;
    }
    None
}

/// `A^-T`; closed form (cofactors over determinant) for n = 3.
fn inverse_transpose<const N: usize>(a: &Mat<N>) -> Option<Mat<N>> {
    if N == 3 {
        let [r0, r1, r2] = [0, 1, 2].map(|i| Vector3::new(a[(i, 0)], a[(i, 1)], a[(i, 2)]));
        let c0 = r1.cross(&r2);
        let det = r0.dot(&c0);
        // A zero or non-finite determinant is the only way to fail.
        if !(det != 0.0 && det.is_finite()) {
            return None;
        }
        let scale = 1.0 / det;
        let cofactors = [c0 * scale, r2.cross(&r0) * scale, r0.cross(&r1) * scale];
        Some(Mat::from_fn(|i, j| cofactors[i][j]))
    } else {
        // With a length that the compiler does not know: compiled once.
        let inverse = DMatrix::from_column_slice(N, N, a.as_slice()).try_inverse()?;
        Some(Mat::from_row_slice(inverse.as_slice()))
    }
}

/// The stretch `E = P - I` of the symmetric polar factor of `A = I + D = U P`.
///
/// `E = sym(C + D + C^T D)` with `C = U - I`. Next to one, numbers above are spaced twice as wide as numbers
/// below: a P that is stored is rounded down by 2e-17 on average, and a momentum that passes through it
/// loses as much at every step. E has no such bias.
pub fn stretch_of<const N: usize>(u: &Mat<N>, d: &Mat<N>) -> Mat<N> {
    let f = u - Mat::<N>::identity();
    symmetric_part(&(f + d + transposed_product(&f, d)))
}

/// Tangent map of the polar factor (6, dP): the skew `Omega` with `dU = U Omega` for a change
/// `da` of `A = U P`, that is `P Omega + Omega P = asym(U^T dA)`.
///
/// `None` where the Lyapunov operator is singular.
pub fn polar_tangent<const N: usize>(u: &Mat<N>, p: &Mat<N>, da: &Mat<N>) -> Option<Mat<N>> {
    lyapunov(p, &asym(&transposed_product(u, da)), &Mat::zeros())
}

/// Adjoint of [`polar_tangent`] (paper, section 2.2.2): `U X` with `P X + X P = S`, so that
/// `tr(polar_tangent_adjoint(S) B^T) = <S, polar_tangent(B)>`.
///
/// `None` where the Lyapunov operator is singular.
pub fn polar_tangent_adjoint<const N: usize>(u: &Mat<N>, p: &Mat<N>, s: &Mat<N>) -> Option<Mat<N>> {
    lyapunov(p, s, &Mat::zeros()).map(|x| product(u, &x))
}

/// The retraction `P(I + Omega)` from so(n) to SO(n), defined for every skew `Omega`.
pub fn retraction<const N: usize>(omega: &Mat<N>) -> Option<Mat<N>> {
    polar(&(Mat::identity() + omega))
}

/// The inverse of [`retraction`] (5, pinverse): the skew `Omega` with
/// `U^T Omega + Omega U = U - U^T`.
///
/// `None` where some plane of `U` turns by a quarter or more: the retraction does not reach there.
pub fn inverse_retraction<const N: usize>(u: &Mat<N>) -> Option<Mat<N>> {
    // The smallest eigenvalue of the symmetric part is the cosine of the largest plane angle.
    if smallest_eigenvalue(&symmetric_part(u)) <= 0.0 {
        return None;
    }
    lyapunov(&u.transpose(), &asym(u), &Mat::zeros())
}

/// `sin(t) / t`, `(1 - cos t) / t^2` and `(t - sin t) / t^3` from `t^2`: the coefficients of the exponential
/// of so(3) and of its tangent map, without cancellation at any angle.
pub fn rotation_coefficients(square: f64) -> [f64; 3] {
    // Below half a radian Taylor's series: 8 terms leave 1e-18 of the first.
    const SERIES_BELOW: f64 = 0.25;
    if square < SERIES_BELOW {
        // sum_k (-t^2)^k / (2k + m)! by Horner, m = 2 and 3.
        let series = |m: u32| {
            (1..8).rev().fold(1.0, |sum, k| {
                let last = f64::from(2 * k + m);
                1.0 - sum * square / (last * (last - 1.0))
            })
        };
        let (b, c) = (series(2) / 2.0, series(3) / 6.0);
        [1.0 - square * c, b, c]
    } else {
        let t = square.sqrt();
        let (sine, half) = (libm::sin(t), libm::sin(0.5 * t));
        [sine / t, 2.0 * half * half / square, (t - sine) / (square * t)]
    }
}

/// The exponential of a skew matrix, a rotation to round-off.
///
/// n = 3: Rodrigues (1840), `I + sin(t)/t X + (1 - cos t)/t^2 X^2`, t the length of the vector. Else
/// scaling and squaring of Taylor's series. NaN where `x` is not finite or turns by more than 1e6 radians, which
/// leaves no digits of use.
pub fn exp<const N: usize>(x: &Mat<N>) -> Mat<N> {
    if N == 3 {
        let v = Vector3::new(x[(2, 1)], x[(0, 2)], x[(1, 0)]);
        let square = v.norm_squared();
        if !(square <= LARGEST_ANGLE * LARGEST_ANGLE) {
            return Mat::repeat(f64::NAN);
        }
        let [a, b, _] = rotation_coefficients(square);
        // X^2 = v v^T - t^2 I
        Mat::from_fn(|i, j| {
            let even = if i == j {
                1.0 - b * (v[(i + 1) % 3] * v[(i + 1) % 3] + v[(i + 2) % 3] * v[(i + 2) % 3])
            } else {
                b * v[i] * v[j]
            };
            even + a * x[(i, j)]
        })
    } else if inner(x, x) <= LARGEST_ANGLE * LARGEST_ANGLE {
        // Squaring doubles the rounding error; one correction takes it back.
        orthonormalised(&(Mat::identity() + exp_minus_one(x)))
    } else {
        Mat::repeat(f64::NAN)
    }
}

/// The largest angle in radians at which [`exp`] still resolves the place on the circle.
pub(super) const LARGEST_ANGLE: f64 = 1e6;

/// `exp(X) - I`: kept apart from I, so that squaring does not round at the size of one.
fn exp_minus_one<const N: usize>(x: &Mat<N>) -> Mat<N> {
    // X^14 / 14! is then below 1e-17.
    const LARGEST: f64 = 0.35;
    let (mut part, mut halvings) = (*x, 0);
    while inner(&part, &part).sqrt() > LARGEST {
        part *= 0.5;
        halvings += 1;
    }
    let mut e = series_of_exp_minus_one(&part);
    for _ in 0..halvings {
        // exp(2 Z) - 1 = 2 E + E^2 with E = exp(Z) - 1
        e = e * 2.0 + product(&e, &e);
    }
    e
}

fn series_of_exp_minus_one<const N: usize>(x: &Mat<N>) -> Mat<N> {
    let identity = Mat::<N>::identity();
    let x2 = product(x, x);
    let x4 = product(&x2, &x2);
    let x6 = product(&x4, &x2);
    // Even and odd powers up to 13 (Paterson, Stockmeyer 1973).
    let even = x2 / 2.0
        + x4 / 24.0
        + x6 / 720.0
        + product(&x6, &(x2 / 40_320.0 + x4 / 3_628_800.0 + x6 / 479_001_600.0));
    let odd = identity
        + x2 / 6.0
        + x4 / 120.0
        + x6 / 5_040.0
        + product(&x6, &(x2 / 362_880.0 + x4 / 39_916_800.0 + x6 / 6_227_020_800.0));
    even + product(x, &odd)
}

/// Solves `M X + X M^T = C` for skew `X`, given skew `C`.
///
/// This is the Lyapunov equation of the paper: with `M = P` symmetric positive definite the polar
/// tangent map, with `M = g0^T g1` the multiplier equation (24d, vih4). `guess` starts the iteration of
/// general n and is not used where there is a closed form (n = 2, 3).
///
/// `None` where the operator is singular to working precision.
pub fn lyapunov<const N: usize>(m: &Mat<N>, c: &Mat<N>, guess: &Mat<N>) -> Option<Mat<N>> {
    lyapunov_in(m, c, guess, &mut 0)
}

/// [`lyapunov`], adding its iterations to those before: a matrix far from the identity takes many
/// times the usual number.
pub(super) fn lyapunov_in<const N: usize>(
    m: &Mat<N>,
    c: &Mat<N>,
    guess: &Mat<N>,
    iterations: &mut u32,
) -> Option<Mat<N>> {
    const TINY: f64 = 1e-140;
    /// 2^900
    const UP: f64 = f64::from_bits((1023 + 900) << 52);
    match N {
        // M X + X M^T = tr(M) X
        2 => {
            let trace = m.trace();
            (trace.abs() > SINGULAR * m.amax()).then(|| c / trace)
        }
        3 => lyapunov_vector(m, c),
        // The squares of what is tiny are lost; a power of two loses nothing.
        _ if c.amax() < TINY => {
            lyapunov_gradient(m, &(c * UP), &Mat::zeros(), iterations).map(|x| x * (1.0 / UP))
        }
        _ => lyapunov_gradient(m, c, guess, iterations),
    }
}

/// Relative size at which a Lyapunov operator counts as singular.
const SINGULAR: f64 = 1e-13;

/// n = 3: `M hat(x) + hat(x) M^T = hat((tr(M) I - M^T) x)`, a 3 x 3 system.
fn lyapunov_vector<const N: usize>(m: &Mat<N>, c: &Mat<N>) -> Option<Mat<N>> {
    let trace = m[(0, 0)] + m[(1, 1)] + m[(2, 2)];
    let k = Matrix3::from_fn(|i, j| if i == j { trace } else { 0.0 } - m[(j, i)]);
    let (r0, r1, r2) = (k.column(0), k.column(1), k.column(2));
    // Cramer's rule with the cofactor columns of K.
    let c0 = r1.cross(&r2);
    let det = r0.dot(&c0);
    let size = k.amax();
    if !(det.abs() > SINGULAR * size * size * size) {
        return None;
    }
    let rhs = Vector3::new(c[(2, 1)], c[(0, 2)], c[(1, 0)]);
    let scale = 1.0 / det;
    let x =
        [c0.dot(&rhs) * scale, r2.cross(&r0).dot(&rhs) * scale, r0.cross(&r1).dot(&rhs) * scale];
    let mut skew = Mat::<N>::zeros();
    for (value, (i, j)) in x.into_iter().zip([(2, 1), (0, 2), (1, 0)]) {
        skew[(i, j)] = value;
        skew[(j, i)] = -value;
    }
    Some(skew)
}

/// General n: conjugate gradients on the normal equations.
///
/// The operator is `L(X) = asym(M X)` and its adjoint `Y -> asym(M^T Y)`: one product each. `M` is
/// near the identity in a step, so a handful of sweeps reaches round-off.
fn lyapunov_gradient<const N: usize>(
    m: &Mat<N>,
    c: &Mat<N>,
    guess: &Mat<N>,
    iterations: &mut u32,
) -> Option<Mat<N>> {
    let mut x = *guess;
    let mut residual = c - asym(&product(m, &x));
    let mut gradient = asym(&transposed_product(m, &residual));
    let mut direction = gradient;
    let mut gamma = inner(&gradient, &gradient);
    let goal = f64::EPSILON * 0.25 * c.amax();
    let mut best = (residual.amax(), x);
    let mut stalled = 0;
    for _ in 0..4 * dimension(N) + 20 {
        if best.0 <= goal || gamma == 0.0 || stalled == 3 {
            break;
        }
        *iterations += 1;
        let image = asym(&product(m, &direction));
        let alpha = gamma / inner(&image, &image);
        if !alpha.is_finite() {
            break;
        }
        x += direction * alpha;
        residual -= image * alpha;
        gradient = asym(&transposed_product(m, &residual));
        let next = inner(&gradient, &gradient);
        direction = gradient + direction * (next / gamma);
        gamma = next;
        let size = residual.amax();
        if size < best.0 {
            stalled = 0;
            best = (size, x);
        } else {
            stalled += 1;
        }
    }
    (best.0 <= 1e-12 * c.amax()).then_some(best.1)
}

/// The nearest rotation to a matrix that is already orthogonal to about 1e-8: one step of
/// Newton and Schulz, `g (3 I - g^T g) / 2`, which squares the defect.
pub fn orthonormalised<const N: usize>(g: &Mat<N>) -> Mat<N> {
    g + product(g, &norm_error(g)) * 0.5
}

/// `I - g^T g`, each product taken off the identity: a sum next to one is rounded twice as far from
/// above as from below, and what is mended by it would keep a bias.
#[inline(always)]
pub fn norm_error<const N: usize>(g: &Mat<N>) -> Mat<N> {
    let (transposed, mut norm_error) = (g.transpose(), Mat::identity());
    for j in 0..N {
        for k in 0..N {
            let x = g[(k, j)];
            for i in 0..N {
                norm_error[(i, j)] -= transposed[(i, k)] * x;
            }
        }
    }
    norm_error
}
