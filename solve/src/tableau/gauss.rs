//! The coefficients of Gauss collocation, computed in twice the digits of a double and rounded once.
//!
//! Weights that do not sum to one are a clock that is off: the body turns too far in every step, by
//! the same part. So the outermost pair is one minus the others.
//!
//! Invariant: the weights are symmetric and sum to one without a rounding; each coefficient is good to its last place.

use std::ops::{Add, Div, Mul, Sub};

use crate::compensated::two_sum;

/// `a` and `b` of Gauss collocation with `stages` nodes, 1 to 8.
///
/// The nodes are the roots of the shifted Legendre polynomial, and with `P_k` shifted to [0, 1] and Gauss quadrature
/// exact, `a_ij = b_j sum_{k<s} (2k+1) P_k(c_j) int_0^{c_i} P_k` (Hairer, Wanner, Solving ODEs II, IV.5).
pub(super) fn coefficients(stages: usize) -> (Vec<Vec<f64>>, Vec<f64>) {
    let nodes: Vec<Twice> = (0..stages).map(|i| legendre_root(stages, i)).collect();
    let values: Vec<Vec<Twice>> = nodes.iter().map(|&c| legendre(stages + 1, c)).collect();
    // 1 / b = sum_{k<s} (2k+1) P_k(c)^2, the Christoffel numbers on [0, 1].
    let christoffel: Vec<Twice> = values
        .iter()
        .map(|p| total((0..stages).map(|k| p[k] * p[k] * Twice::from((2 * k + 1) as f64))))
        .collect();
    let mut b: Vec<f64> = christoffel.iter().map(|&inverse| (ONE / inverse).high).collect();
    if stages > 1 {
        let inner = total(b[1..stages - 1].iter().map(|&weight| Twice::from(weight)));
        let outer = ((ONE - inner) * Twice::from(0.5)).high;
        (b[0], b[stages - 1]) = (outer, outer);
    }
    let part = |i: usize, j: usize| {
        total((0..stages).map(|k| values[j][k] * integral(&values[i], nodes[i], k)))
    };
    let a = (0..stages)
        .map(|i| (0..stages).map(|j| (part(i, j) * Twice::from(b[j])).high).collect())
        .collect();
    (a, b)
}

/// `P_0(t), ..., P_n(t)` at `t = 2 c - 1`, given the node `c` in [0, 1].
fn legendre(n: usize, c: Twice) -> Vec<Twice> {
    let t = c + c - ONE;
    let mut p = vec![ONE, t];
    for k in 1..n {
        let [k0, k1, odd] = [k, k + 1, 2 * k + 1].map(|k| Twice::from(k as f64));
        // (k+1) P_{k+1} = (2k+1) t P_k - k P_{k-1}
        p.push((odd * t * p[k] - k0 * p[k - 1]) / k1);
    }
    p
}

/// `(2k+1) int_0^c P_k = (P_{k+1} - P_{k-1}) / 2` on [0, 1], and `c` for k = 0.
fn integral(p: &[Twice], c: Twice, k: usize) -> Twice {
    if k == 0 { c } else { (p[k + 1] - p[k - 1]) * Twice::from(0.5) }
}

/// Root number `i` (ascending) of the shifted Legendre polynomial of degree `n`, by Newton from
/// Tricomi's estimate. The pair of roots c and 1 - c is made exact.
fn legendre_root(n: usize, i: usize) -> Twice {
    if 2 * i + 1 == n {
        return Twice::from(0.5);
    }
    if 2 * i + 1 > n {
        return ONE - legendre_root(n, n - 1 - i);
    }
    let guess = libm::cos(std::f64::consts::PI * (i as f64 + 0.75) / (n as f64 + 0.5));
    let mut c = Twice::from(0.5 * (1.0 - guess));
    // The digits double each time.
    for _ in 0..8 {
        let p = legendre(n, c);
        let t = c + c - ONE;
        // (t^2 - 1) P_n' = n (t P_n - P_{n-1}); dt = 2 dc
        let slope = Twice::from(2.0 * n as f64) * (t * p[n] - p[n - 1]) / (t * t - ONE);
        c = c - p[n] / slope;
    }
    c
}

/// A number of some 32 digits, the sum of two doubles that do not overlap (Dekker 1971, Numerische Mathematik 18).
#[derive(Clone, Copy, Debug)]
pub(super) struct Twice {
    pub(super) high: f64,
    pub(super) low: f64,
}

const ONE: Twice = Twice { high: 1.0, low: 0.0 };

impl Twice {
    fn of((high, low): (f64, f64)) -> Self {
        Self { high, low }
    }

    /// The product of two doubles, exactly.
    fn product(a: f64, b: f64) -> Self {
        // 2^27 + 1: halves of 26 bits each.
        let split = |x: f64| {
            let big = x * 134_217_729.0;
            let high = big - (big - x);
            (high, x - high)
        };
        let ((a1, a2), (b1, b2)) = (split(a), split(b));
        let high = a * b;
        Self { high, low: a2 * b2 - (((high - a1 * b1) - a2 * b1) - a1 * b2) }
    }
}

/// Returns the sum of `numbers`.
pub(super) fn total(numbers: impl Iterator<Item = Twice>) -> Twice {
    numbers.fold(Twice::from(0.0), |sum, x| sum + x)
}

impl From<f64> for Twice {
    fn from(high: f64) -> Self {
        Self { high, low: 0.0 }
    }
}

impl Add for Twice {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let (high, rest) = two_sum(self.high, other.high);
        let (low, lowest) = two_sum(self.low, other.low);
        let (high, rest) = two_sum(high, rest + low);
        Self::of(two_sum(high, rest + lowest))
    }
}

impl Sub for Twice {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        self + Self { high: -other.high, low: -other.low }
    }
}

impl Mul for Twice {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        let Self { high, low } = Self::product(self.high, other.high);
        let across = self.high * other.low + self.low * other.high;
        Self::of(two_sum(high, low + across))
    }
}

impl Div for Twice {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        let first = Self::from(self.high / other.high);
        let rest = self - first * other;
        let second = Self::from(rest.high / other.high);
        let rest = rest - second * other;
        first + second + Self::from(rest.high / other.high)
    }
}
