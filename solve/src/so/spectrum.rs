//! Eigenvalues and singular values, as guards and samples need them.
//!
//! Invariant: what cannot be computed is NaN, which no guard lets pass.

use nalgebra::{DMatrix, DVector, SVD, SymmetricEigen};

use super::{Mat, inner, product};

/// The smallest eigenvalue of a symmetric matrix, to 1e-11 of its largest entry; NaN where it has none. May allocate: for guards and samples,
/// not for sweeps.
pub fn smallest_eigenvalue<const N: usize>(p: &Mat<N>) -> f64 {
    smallest_of_three(p).unwrap_or_else(|| eigenvalues(p).map_or(f64::NAN, |values| values.min()))
}

/// For n = 3, by Newton's method for `det(P - x I) = 0` from a bound below all roots, which are real: it comes nearer
/// monotonically. `None` for other n, and where a second eigenvalue is next to it.
fn smallest_of_three<const N: usize>(p: &Mat<N>) -> Option<f64> {
    // With so small an entry the determinant would be rounded to zero.
    const SMALLEST: f64 = 1e-90;
    const STEPS: u32 = 12;
    let size = p.amax();
    if N != 3 || !(size >= SMALLEST) {
        return None;
    }
    let (xy, xz, yz) = (p[(0, 1)], p[(0, 2)], p[(1, 2)]);
    let mut x = smallest_eigenvalue_bound(p);
    for _ in 0..STEPS {
        let (a, b, c) = (p[(0, 0)] - x, p[(1, 1)] - x, p[(2, 2)] - x);
        let minors = [b * c - yz * yz, a * c - xz * xz, a * b - xy * xy];
        let determinant = a * minors[0] - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
        // The product of the distances to the others, once x is there.
        let slope = minors[0] + minors[1] + minors[2];
        let step = determinant / slope;
        x += step;
        if step.abs() <= f64::EPSILON * size {
            return (slope >= 1e-4 * size * size).then_some(x);
        }
    }
    None
}

/// The frequencies of a skew matrix, ascending, each twice (and a zero for odd n): its singular values.
/// Rotations leave them alone: they label the coadjoint orbit. For n = 3 the larger is the length of the
/// vector. Allocates: for samples.
pub fn frequencies<const N: usize>(x: &Mat<N>) -> Vec<f64> {
    if N == 3 {
        let length = inner(x, x).sqrt();
        return vec![0.0, length, length];
    }
    let mut frequencies = match singular_values(x) {
        Some(values) => values.as_slice().to_vec(),
        None => vec![f64::NAN; N],
    };
    frequencies.sort_by(f64::total_cmp);
    frequencies
}

/// The angle of a rotation R, in rad: the norm `<X, X>^(1/2)` of the smallest X with `exp(X) = R`, that is the root of the sum of the
/// squares of its angles in planes, each up to pi. NaN where R is not finite. Allocates: for samples.
///
/// Of an eigenvector q of `(R + R^T) / 2` the eigenvalue is the cosine, and `|(R - R^T) q / 2|` the sine, of the angle of its plane.
pub fn angle<const N: usize>(r: &Mat<N>) -> f64 {
    if !r.iter().all(|x| x.is_finite()) {
        return f64::NAN;
    }
    let cosines = DMatrix::from_fn(N, N, |i, j| 0.5 * (r[(i, j)] + r[(j, i)]));
    let sines = DMatrix::from_fn(N, N, |i, j| 0.5 * (r[(i, j)] - r[(j, i)]));
    let Some(solved) = SymmetricEigen::try_new(cosines, f64::EPSILON, MOST_ROUNDS * N) else {
        return f64::NAN;
    };
    let mut square = 0.0;
    for (cosine, q) in solved.eigenvalues.iter().zip(solved.eigenvectors.column_iter()) {
        let angle = libm::atan2((&sines * q).norm(), *cosine);
        // Each plane has two of them.
        square += 0.5 * angle * angle;
    }
    square.sqrt()
}

/// A cheap lower bound of the smallest eigenvalue of a symmetric matrix (Gershgorin's discs).
pub fn smallest_eigenvalue_bound<const N: usize>(p: &Mat<N>) -> f64 {
    (0..N)
        .map(|i| {
            let off: f64 = (0..N).filter(|&j| j != i).map(|j| p[(i, j)].abs()).sum();
            p[(i, i)] - off
        })
        .fold(f64::INFINITY, f64::min)
}

/// Returns the distance of `g` from the group: the spectral norm of `g g^T - I`; NaN where that
/// overflows.
pub fn orthogonality_error<const N: usize>(g: &Mat<N>) -> f64 {
    let defect = product(g, &g.transpose()) - Mat::<N>::identity();
    let size = defect.amax();
    // In parts of the largest entry: a defect is a few roundings, the squares of which may be lost.
    let mut parts = defect;
    parts /= if size > 0.0 { size } else { 1.0 };
    let finite = parts.iter().all(|x| x.is_finite());
    let largest = match N {
        _ if !finite => f64::NAN,
        3 => largest_of_three(&parts),
        _ => largest_of_symmetric(parts.as_mut_slice(), N),
    };
    size * largest
}

/// For n = 3, the largest size of an eigenvalue of a symmetric matrix by the angle of its cubic (Smith 1961). The largest
/// and the smallest eigenvalue do not feel an error of the angle where two of them meet.
fn largest_of_three<const N: usize>(p: &Mat<N>) -> f64 {
    let (xy, xz, yz) = (p[(0, 1)], p[(0, 2)], p[(1, 2)]);
    let mean = (p[(0, 0)] + p[(1, 1)] + p[(2, 2)]) / 3.0;
    let (a, b, c) = (p[(0, 0)] - mean, p[(1, 1)] - mean, p[(2, 2)] - mean);
    let spread = ((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0).sqrt();
    if spread == 0.0 {
        return mean.abs();
    }
    let determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    let cosine = determinant / (2.0 * spread * spread * spread);
    let angle = libm::acos(cosine.clamp(-1.0, 1.0)) / 3.0;
    let third = 2.0 * std::f64::consts::FRAC_PI_3;
    let [highest, lowest] = [angle, angle + third].map(|at| mean + 2.0 * spread * libm::cos(at));
    highest.abs().max(lowest.abs())
}

/// The largest size of an eigenvalue of a symmetric n x n matrix of finite numbers, whose columns stand one after another: by
/// Householder's reflections to three diagonals, then QL steps with Wilkinson's shifts (Bowdler, Martin, Reinsch, Wilkinson
/// 1968). NaN where that does not end. Overwrites the matrix; compiled once for all n.
fn largest_of_symmetric(p: &mut [f64], n: usize) -> f64 {
    let mut reflected = vec![0.0; 3 * n];
    let (diagonal, rest) = reflected.split_at_mut(n);
    let (beside, v) = rest.split_at_mut(n);
    for k in 0..n {
        diagonal[k] = p[k * n + k];
        let below = (k + 1).min(n)..n;
        let norm = p[k * n..][below.clone()].iter().map(|x| x * x).sum::<f64>().sqrt();
        let Some(&first) = p[k * n..][below.clone()].first() else { break };
        // The reflection sends the column to (alpha, 0, ..); no digits are lost in its first entry.
        let alpha = if first > 0.0 { -norm } else { norm };
        beside[k] = alpha;
        let square = norm * norm - first * alpha;
        if below.len() < 2 || square == 0.0 {
            beside[k] = first;
            continue;
        }
        // Of the rest P: P - v w^T - w v^T with w = q - (v.q / 2 square) v and q = P v / square.
        let (column, rows) = p[k * n..].split_at_mut(n);
        let u = &mut column[below.clone()];
        u[0] -= alpha;
        let entry = |i: usize, j: usize| j * n + k + 1 + i;
        let count = u.len();
        for i in 0..count {
            v[i] = (0..count).map(|j| rows[entry(i, j)] * u[j]).sum::<f64>() / square;
        }
        let along = (0..count).map(|i| u[i] * v[i]).sum::<f64>() / (2.0 * square);
        for i in 0..count {
            v[i] -= along * u[i];
        }
        for j in 0..count {
            for i in 0..count {
                rows[entry(i, j)] -= u[i] * v[j] + v[i] * u[j];
            }
        }
    }
    largest_of_tridiagonal(diagonal, beside)
}

/// The largest size of an eigenvalue of a symmetric matrix of a diagonal and the entries beside it, the last of which counts
/// for nothing.
fn largest_of_tridiagonal(d: &mut [f64], e: &mut [f64]) -> f64 {
    let n = d.len();
    for first in 0..n {
        let mut rounds = 0;
        loop {
            let small = |k: &usize| e[*k].abs() <= f64::EPSILON * (d[*k].abs() + d[*k + 1].abs());
            let last = (first..n - 1).find(small).unwrap_or(n - 1);
            if last == first {
                break;
            }
            rounds += 1;
            if rounds > MOST_ROUNDS {
                return f64::NAN;
            }
            let half = (d[first + 1] - d[first]) / (2.0 * e[first]);
            let root = (half * half + 1.0).sqrt().copysign(half);
            let mut g = d[last] - d[first] + e[first] / (half + root);
            let (mut sin, mut cos, mut moved) = (1.0, 1.0, 0.0);
            let mut whole = true;
            for k in (first..last).rev() {
                let (f, b) = (sin * e[k], cos * e[k]);
                let r = (f * f + g * g).sqrt();
                e[k + 1] = r;
                if r == 0.0 {
                    d[k + 1] -= moved;
                    e[last] = 0.0;
                    whole = false;
                    break;
                }
                (sin, cos) = (f / r, g / r);
                g = d[k + 1] - moved;
                let r = (d[k] - g) * sin + 2.0 * cos * b;
                moved = sin * r;
                d[k + 1] = g + moved;
                g = cos * r - b;
            }
            if whole {
                d[first] -= moved;
                e[first] = g;
                e[last] = 0.0;
            }
        }
    }
    d.iter().fold(0.0, |largest, x| x.abs().max(largest))
}

/// Iterations of an eigenvalue problem for each row of its matrix: three are usual.
const MOST_ROUNDS: usize = 100;

/// The eigenvalues of a symmetric matrix; `None` where it is not finite: the iteration would not end.
fn eigenvalues<const N: usize>(p: &Mat<N>) -> Option<DVector<f64>> {
    let finite = p.iter().all(|x| x.is_finite());
    let matrix = finite.then(|| DMatrix::from_column_slice(N, N, p.as_slice()))?;
    let solved = SymmetricEigen::try_new(matrix, f64::EPSILON, MOST_ROUNDS * N)?;
    Some(solved.eigenvalues)
}

/// The singular values of a matrix; `None` as for [`eigenvalues`].
fn singular_values<const N: usize>(x: &Mat<N>) -> Option<DVector<f64>> {
    let finite = x.iter().all(|x| x.is_finite());
    let matrix = finite.then(|| DMatrix::from_column_slice(N, N, x.as_slice()))?;
    let solved = SVD::try_new(matrix, false, false, 5.0 * f64::EPSILON, MOST_ROUNDS * N)?;
    Some(solved.singular_values)
}
