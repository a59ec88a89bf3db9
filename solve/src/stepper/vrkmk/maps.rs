//! The maps of VRKMK on so(n), in two representations: vectors of R^3 with closed forms, and
//! matrices with brackets.
//!
//! Invariant: [`Chains::adjoint_of_derivative`] is the exact adjoint of the derivative of the
//! truncated series in [`Chains::image`], whatever the coefficients. This, not their values, makes
//! the step symplectic.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Mul, Neg, Sub};

use nalgebra::Vector3;

use crate::so::{self, Mat};

/// An element of so(n) or of its dual; the pairing identifies the two: `ad_X^* = -ad_X`,
/// `Ad_g^* = Ad_{g^T}`.
pub(super) trait Skew<const N: usize>:
    Copy
    + Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Neg<Output = Self>
    + Mul<f64, Output = Self>
    + AddAssign
{
    /// Converts from a skew matrix.
    fn from_matrix(x: &Mat<N>) -> Self;

    /// Returns the skew matrix.
    fn matrix(&self) -> Mat<N>;

    /// Returns zero.
    fn zero() -> Self;

    /// `ad_X Y = X Y - Y X`.
    fn bracket(&self, y: &Self) -> Self;

    /// `Ad_g X = g X g^T`.
    fn turned(&self, g: &Mat<N>) -> Self;

    /// `g^T X g`.
    fn turned_back(&self, g: &Mat<N>) -> Self;

    /// `dexp_X V = sum_k ad_X^k V / (k + 1)!`, right-trivialised, `d exp(X) V = (dexp_X V) exp(X)`; exact.
    fn dexp(&self, v: &Self) -> Self;

    /// Returns the largest absolute value of an entry; unlike a plain maximum it keeps a NaN.
    fn size(&self) -> f64;
}

/// n = 3 under the hat map: the bracket is the cross product and `Ad_g X = g X`.
///
/// # Assumes
/// N = 3.
impl<const N: usize> Skew<N> for Vector3<f64> {
    #[inline]
    fn from_matrix(x: &Mat<N>) -> Self {
        Self::new(x[(2, 1)], x[(0, 2)], x[(1, 0)])
    }

    #[inline]
    fn matrix(&self) -> Mat<N> {
        let mut x = Mat::zeros();
        for (value, (i, j)) in self.iter().zip([(2, 1), (0, 2), (1, 0)]) {
            x[(i, j)] = *value;
            x[(j, i)] = -value;
        }
        x
    }

    #[inline]
    fn zero() -> Self {
        Self::zeros()
    }

    #[inline]
    fn bracket(&self, y: &Self) -> Self {
        self.cross(y)
    }

    #[inline]
    fn turned(&self, g: &Mat<N>) -> Self {
        Self::from_fn(|i, _| g[(i, 0)] * self[0] + g[(i, 1)] * self[1] + g[(i, 2)] * self[2])
    }

    #[inline]
    fn turned_back(&self, g: &Mat<N>) -> Self {
        Self::from_fn(|i, _| g[(0, i)] * self[0] + g[(1, i)] * self[1] + g[(2, i)] * self[2])
    }

    #[inline]
    fn dexp(&self, v: &Self) -> Self {
        // ad^3 = -t^2 ad sums the series to V + (1 - cos t)/t^2 X x V + (t - sin t)/t^3 X x (X x V).
        let [_, b, c] = so::rotation_coefficients(self.norm_squared());
        let once = self.cross(v);
        v + once * b + self.cross(&once) * c
    }

    #[inline]
    fn size(&self) -> f64 {
        self.iter().fold(0.0, |most, x| greater(most, x.abs()))
    }
}

/// Any n, with products of matrices.
impl<const N: usize> Skew<N> for Mat<N> {
    #[inline]
    fn from_matrix(x: &Mat<N>) -> Self {
        *x
    }

    #[inline]
    fn matrix(&self) -> Mat<N> {
        *self
    }

    #[inline]
    fn zero() -> Self {
        Self::zeros()
    }

    #[inline]
    fn bracket(&self, y: &Self) -> Self {
        // Y X = (X Y)^T for skew X, Y.
        so::asym(&so::product(self, y))
    }

    #[inline]
    fn turned(&self, g: &Mat<N>) -> Self {
        // The result is skew to the last bit: the brackets rely on it.
        so::skew(&so::conjugate(g, self))
    }

    #[inline]
    fn turned_back(&self, g: &Mat<N>) -> Self {
        so::skew(&so::product(&so::transposed_product(g, self), g))
    }

    fn dexp(&self, v: &Self) -> Self {
        // ad_X is at most twice as large as X: the series then ends after about 25 terms.
        const LARGEST: f64 = 1.0;
        if !(so::inner(self, self) <= so::LARGEST_ANGLE * so::LARGEST_ANGLE) {
            return Mat::repeat(f64::NAN);
        }
        let (mut part, mut halvings) = (*self, 0);
        while so::inner(&part, &part) > LARGEST {
            part *= 0.5;
            halvings += 1;
        }
        let mut image = series_of_dexp(&part, v);
        for _ in 0..halvings {
            // dexp_{2 Z} = (1 + Ad_{exp Z}) dexp_Z / 2
            image = (image + image.turned(&so::exp(&part))) * 0.5;
            part *= 2.0;
        }
        image
    }

    #[inline]
    fn size(&self) -> f64 {
        self.iter().fold(0.0, |most, x| greater(most, x.abs()))
    }
}

/// Computes dexp of a small matrix by its series.
fn series_of_dexp<const N: usize>(x: &Mat<N>, v: &Mat<N>) -> Mat<N> {
    // Far below round-off: truncating the series earlier would cost the step its symplecticity.
    let negligible = 1e-18 * v.size();
    let (mut sum, mut term, mut k) = (*v, *v, 1.0);
    while term.size() > negligible {
        k += 1.0;
        term = x.bracket(&term) / k;
        sum += term;
    }
    sum
}

/// Returns the greater of two sizes, or NaN if one of them is NaN.
pub(super) fn greater(a: f64, b: f64) -> f64 {
    if b > a || b.is_nan() { b } else { a }
}

/// Highest power of the truncated inverse of dexp for which there is a coefficient here.
pub(super) const MAX_TRUNCATION: usize = 20;

/// Returns `B_k / k!` for k = 0 to `q`, B_k being the Bernoulli numbers with `B_1 = -1/2`: the
/// series of `dexp^-1`.
pub(super) fn inverse_dexp_coefficients(q: usize) -> Vec<f64> {
    // B_2, B_4, ..., B_20
    const EVEN: [(f64, f64); MAX_TRUNCATION / 2] = [
        (1.0, 6.0),
        (-1.0, 30.0),
        (1.0, 42.0),
        (-1.0, 30.0),
        (5.0, 66.0),
        (-691.0, 2730.0),
        (7.0, 6.0),
        (-3617.0, 510.0),
        (43867.0, 798.0),
        (-174_611.0, 330.0),
    ];
    let mut factorial = 1.0;
    (0..=q)
        .map(|k| {
            factorial *= k.max(1) as f64;
            match k {
                0 => 1.0,
                1 => -0.5,
                _ if k % 2 == 1 => 0.0,
                _ => EVEN[k / 2 - 1].0 / (EVEN[k / 2 - 1].1 * factorial),
            }
        })
        .collect()
}

/// `u_k = ad_X^k xi` and `v_k = (-ad_X)^k P`, k = 0 to q: the chains that the three truncated maps
/// share.
#[derive(Clone, Debug)]
pub(super) struct Chains<const N: usize, A> {
    u: Vec<A>,
    v: Vec<A>,
}

impl<const N: usize, A: Skew<N>> Chains<N, A> {
    /// Allocates chains up to `q`.
    pub(super) fn new(q: usize) -> Self {
        Self { u: vec![A::zero(); q + 1], v: vec![A::zero(); q + 1] }
    }

    /// Fills the chain of P and returns `T(X)^* P = sum_k beta_k v_k`.
    pub(super) fn dual_image(&mut self, beta: &[f64], x: &A, p: &A) -> A {
        fill(&mut self.v, beta, &-*x, p)
    }

    /// Fills the chain of xi and returns `T(X) xi = sum_k beta_k u_k`.
    pub(super) fn image(&mut self, beta: &[f64], x: &A, xi: &A) -> A {
        fill(&mut self.u, beta, x, xi)
    }

    /// Returns W with `<W, D> = <P, d/de T(X + e D) xi>`, computed from both chains:
    ///
    /// ```text
    /// W = sum_{k=1}^q beta_k sum_{m<k} [u_{k-1-m}, v_m]
    ///   = sum_{m<q} [sum_{l<q-m} beta_{l+m+1} u_l, v_m]
    /// ```
    ///
    /// The second form has q brackets instead of q (q + 1) / 2.
    pub(super) fn adjoint_of_derivative(&self, beta: &[f64]) -> A {
        let q = beta.len() - 1;
        let mut w = A::zero();
        for m in 0..q {
            let mut sum = A::zero();
            for l in 0..q - m {
                if beta[l + m + 1] != 0.0 {
                    sum += self.u[l] * beta[l + m + 1];
                }
            }
            w += sum.bracket(&self.v[m]);
        }
        w
    }
}

/// Fills `chain_k = ad_X^k start`; returns `sum_k beta_k chain_k`.
fn fill<const N: usize, A: Skew<N>>(chain: &mut [A], beta: &[f64], x: &A, start: &A) -> A {
    chain[0] = *start;
    let mut sum = *start * beta[0];
    for k in 1..beta.len() {
        chain[k] = x.bracket(&chain[k - 1]);
        if beta[k] != 0.0 {
            sum += chain[k] * beta[k];
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    const X: [f64; 3] = [0.1, -0.2, 0.15];
    const XI: [f64; 3] =
        [-0.749_360_295_121_939_4, -1.649_027_840_870_673, 2.976_318_224_715_369_4];
    const P: [f64; 3] = [0.4, -0.2, 0.1];

    fn close(x: &Mat<3>, expected: [f64; 3]) {
        let error = (x - so::hat::<3>(&expected)).amax();
        assert!(error < 5e-15, "{error:e}");
    }

    /// Checks values from an independent program, whose W is from differences of the truncated
    /// series.
    fn known_values<A: Skew<3>>() {
        let [x, xi, p] = [X, XI, P].map(|v| A::from_matrix(&so::hat(&v)));
        let beta = inverse_dexp_coefficients(4);
        let mut chains = Chains::<3, A>::new(4);
        close(
            &chains.image(&beta, &x, &xi).matrix(),
            [-0.565_021_332_530_603_2, -1.445_737_737_443_126, 3.124_479_054_224_541_3],
        );
        close(
            &chains.dual_image(&beta, &x, &p).matrix(),
            [0.403_373_036_458_333_4, -0.175_375_453_125, 0.130_584_038_194_444_4],
        );
        close(
            &chains.adjoint_of_derivative(&beta).matrix(),
            [-0.203_170_790_860_448, -0.646_592_490_317_658_4, -0.383_483_604_026_257_8],
        );
        close(
            &x.dexp(&p).matrix(),
            [0.401_731_625_509_484_4, -0.175_897_963_059_85, 0.130_981_632_247_210_4],
        );
        // Here twenty terms are as good as all of them.
        let beta = inverse_dexp_coefficients(MAX_TRUNCATION);
        let mut chains = Chains::<3, A>::new(MAX_TRUNCATION);
        let image = chains.image(&beta, &x, &xi);
        chains.dual_image(&beta, &x, &p);
        close(
            &chains.adjoint_of_derivative(&beta).matrix(),
            [-0.203_170_724_598_603_4, -0.646_592_601_639_862_3, -0.383_483_497_863_978_5],
        );
        close(&x.dexp(&image).matrix(), XI);
    }

    #[test]
    fn the_maps_have_their_known_values() {
        known_values::<Vector3<f64>>();
        known_values::<Mat<3>>();
    }

    #[test]
    fn dexp_is_the_same_in_both_readings() {
        for size in [1e-9, 0.1, 1.7, 2.1, 9.0, 60.0] {
            let [x, v] = [X, P].map(|v| so::hat::<3>(&v));
            let x = x * (size / so::inner(&x, &x).sqrt());
            let [x3, v3] = [X, P].map(Vector3::from);
            let closed = Skew::<3>::dexp(&(x3 * (size / x3.norm())), &v3);
            let closed = Skew::<3>::matrix(&closed);
            assert!((x.dexp(&v) - closed).amax() < 1e-14, "at {size}");
        }
    }

    #[test]
    fn adjoints_in_every_dimension() {
        fn law<const N: usize>() {
            let skew = |seed: f64| {
                so::asym(&Mat::<N>::from_fn(|i, j| {
                    let place = (N * i + j) as f64;
                    0.3 * (seed * (place + 1.0)).rem_euclid(1.0)
                }))
            };
            let [x, xi, p, d] = [0.618, 0.414, 0.732, 0.236].map(skew);
            for q in [0, 1, 2, 4, 6] {
                let beta = inverse_dexp_coefficients(q);
                let mut chains = Chains::<N, Mat<N>>::new(q);
                // The truncated series is a polynomial: differences of sixth order are nearly
                // exact.
                let e = 0.05;
                let mut at = |k: f64| so::inner(&p, &chains.image(&beta, &(x + d * (k * e)), &xi));
                let difference = (45.0 * (at(1.0) - at(-1.0)) - 9.0 * (at(2.0) - at(-2.0))
                    + (at(3.0) - at(-3.0)))
                    / (60.0 * e);
                let image = chains.image(&beta, &x, &xi);
                let dual = chains.dual_image(&beta, &x, &p);
                let w = chains.adjoint_of_derivative(&beta);
                assert!((so::inner(&w, &d) - difference).abs() < 1e-13, "n = {N}, q = {q}");
                assert!((so::inner(&p, &image) - so::inner(&dual, &xi)).abs() < 1e-14);
            }
            // <dexp_{-X} P, D> = <P, dexp_X D>
            let (left, right) = (so::inner(&(-x).dexp(&p), &d), so::inner(&p, &x.dexp(&d)));
            assert!((left - right).abs() < 1e-14, "n = {N}");
        }
        law::<2>();
        law::<3>();
        law::<4>();
        law::<5>();
    }
}
