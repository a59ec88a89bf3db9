//! The free rigid body in three dimensions, solved exactly.
//!
//! Body momentum, in principal axes x, y, z (right-handed, y the axis of the middle moment of inertia),
//! `w = 1 / J`, `alpha = w_z - w_y`, `beta = w_x - w_z`, `gamma = w_y - w_x`:
//!
//! ```text
//! x' = alpha y z,   y' = beta z x,   z' = gamma x y
//! a = -alpha beta z^2 + alpha gamma y^2,   b = -beta gamma x^2 + alpha gamma y^2     (kept, not negative)
//! S' = c d,  c' = -a S d,  d' = -b S c,  c^2 = 1 - a S^2,  d^2 = 1 - b S^2,  S(0) = 0
//! D = 1 - alpha gamma S^2 y0^2
//! x(t) = (x0 c   + alpha S d y0 z0) / D
//! y(t) = (y0 c d + beta  S   z0 x0) / D
//! z(t) = (z0 d   + gamma S c x0 y0) / D
//! ```
//!
//! This is Jacobi's solution with `S = sn(u, k) / l`, `l^2 = a`, `(k l)^2 = b`, `u = l t`, brought
//! by the addition theorems of sn, cn, dn into a form in which no cases need to be distinguished:
//! spins about an axis, separatrices, bodies with equal moments.
//!
//! Attitude, after Celledoni, Fasso, Saefstroem, Zanna (2008), section 2: with `G = |mu|`, e a body axis
//! with `e . mu > 0` and `p(mu)` the shortest rotation from e to mu, `q = const Y(psi) p(mu)*`,
//!
//! ```text
//! psi' = (2 T + G e . Omega) / (G + e . mu) = G w_e + (2 T - G^2 w_e) / (G + e . mu)
//! ```
//!
//! The integral of the last term (an elliptic one of the third kind) is computed by Gauss
//! quadrature on pieces so short that it is exact to round-off.
//!
//! The momentum has the period `4 K / l = 2 pi / agm(sqrt(max(a, b)), sqrt(|a - b|))` (Gauss 1799;
//! Abramowitz, Stegun, 17.6), and `e . mu`, a dn, half of it. In a longer motion whole periods
//! leave the momentum unchanged, and each adds the same to psi. So a motion costs at most a period
//! and a half, however long it is.
//!
//! Invariant: the spatial momentum and the kinetic energy are kept to round-off.

use nalgebra::{Matrix3, Quaternion, Vector3};

use super::composition::Drift;

pub(crate) mod short;

/// Longest piece in units of the argument u of Jacobi's functions. The nearest poles are at least pi / 2
/// away from the real axis: eight terms of the series of S^2 leave 1e-17, five nodes leave 1e-18.
const LONGEST_PIECE: f64 = 0.125;
/// Terms of the series of S^2.
const TERMS: usize = 8;
/// Largest number of pieces of a motion without a period; with one, some hundreds are enough.
const MAX_PIECES: f64 = 1e5;
/// Largest turn of a motion, in radians. The rounding of the momentum and of the time alone moves the attitude by some
/// 1e-16 of its turn: beyond this the third digit of the attitude means nothing.
pub const MOST_TURN_RAD: f64 = 1e12;
/// Length up to which three nodes leave 1e-17.
const SHORT: f64 = 0.02;
/// Nodes and weights of Gauss quadrature on [0, 1] (Abramowitz, Stegun, table 25.4).
const RULE: [(f64, f64); 5] = [
    (0.046_910_077_030_668_004, 0.118_463_442_528_094_54),
    (0.230_765_344_947_158_45, 0.239_314_335_249_683_24),
    (0.5, 0.284_444_444_444_444_45),
    (0.769_234_655_052_841_6, 0.239_314_335_249_683_24),
    (0.953_089_922_969_332, 0.118_463_442_528_094_54),
];
/// Nodes and weights with three nodes.
const SHORT_RULE: [(f64, f64); 3] = [
    (0.112_701_665_379_258_31, 0.277_777_777_777_777_8),
    (0.5, 0.444_444_444_444_444_4),
    (0.887_298_334_620_741_7, 0.277_777_777_777_777_8),
];

/// Returns the motion of a free body in `h`, given its inverse principal moments of inertia and its
/// momentum, and the number of pieces in which it was computed: see [`pieces`].
///
/// `None` if the values are not finite, if the body turns by more than [`MOST_TURN_RAD`], or if its momentum comes back
/// only after more than 10^4 radians (a separatrix, to the last bit): then rounding decides where it is.
pub fn flow(inverse: &Vector3<f64>, mu: &Vector3<f64>, h: f64) -> Option<(Drift, f64)> {
    let size = mu.norm();
    if size == 0.0 {
        let none = Drift { turn: Quaternion::identity(), momentum_increment: Vector3::zeros() };
        return Some((none, 1.0));
    }
    let axes = Axes::new(inverse);
    let m = axes.0.map(|axis| mu[axis]);
    let constants = Constants::new(axes.0.map(|axis| inverse[axis]), m);
    let [a, b] = constants.squares;
    let turn_rad = size * inverse.amax() * h.abs();
    let course = constants.course(h);
    // A comparison that a NaN fails.
    let is_short = |t: f64| constants.length(t) <= MAX_PIECES * LONGEST_PIECE;
    if !(turn_rad <= MOST_TURN_RAD && is_short(course.rest) && is_short(course.period)) {
        return None;
    }
    // The one of x and z that keeps its sign: it belongs to dn.
    let place = if a >= b { 2 } else { 0 };
    let pole = Pole { axis: axes.0[place], sign: 1.0_f64.copysign(m[place]) };
    // From m on: the integral of 1 / (G + e . mu), and the change of m.
    let along = |h: f64, mut m: [f64; 3]| {
        let longest = constants.length(h);
        let rule: &[(f64, f64)] = if longest <= SHORT { &SHORT_RULE } else { &RULE };
        let pieces = count(longest);
        let t = h / pieces;
        let series = constants.series(t);
        let (mut integral, mut gains) = (0.0, [0.0; 3]);
        for _ in 0..pieces as u32 {
            for &(node, weight) in rule {
                let [numerator, divisor] = constants.place(place, m, series.at(node));
                integral += weight * t * divisor / (size * divisor + pole.sign * numerator);
            }
            let change = constants.change(m, &series);
            for i in 0..3 {
                (m[i], gains[i]) = (m[i] + change[i], gains[i] + change[i]);
            }
        }
        (integral, gains, pieces)
    };
    let Course { periods, period, rest } = course;
    let (mut integral, gains, mut pieces) = along(rest, m);
    if periods > 0.0 {
        let (of_half, _, more) = along(0.5 * period, m);
        integral += 2.0 * periods * of_half;
        pieces += more;
    }
    let mut momentum_increment = Vector3::zeros();
    for (axis, value) in axes.0.into_iter().zip(gains) {
        momentum_increment[axis] = value;
    }
    let momentum_increment = on_orbit(&Matrix3::from_diagonal(inverse), mu, momentum_increment);
    let w = inverse[pole.axis];
    // 2 T - G^2 w_e, without the difference of large numbers.
    let remainder: f64 =
        (0..3).filter(|&i| i != pole.axis).map(|i| (inverse[i] - w) * mu[i] * mu[i]).sum();
    let half = 0.5 * (size * w * h + remainder * integral);
    let mut direction = Vector3::zeros();
    direction[pole.axis] = pole.sign;
    let turn = Quaternion::from_parts(libm::cos(half), direction * libm::sin(half));
    let (start, end) = (pole.to(mu, size), pole.to(&(mu + momentum_increment), size));
    Some((Drift { turn: (start * turn * end.conjugate()).normalize(), momentum_increment }, pieces))
}

/// Returns the number of pieces in which [`flow`] computes a motion of a body given by its inverse
/// principal moments and its momentum: the cost is about proportional to it.
pub fn pieces(inverse: &Vector3<f64>, mu: &Vector3<f64>, h: f64) -> f64 {
    let axes = Axes::new(inverse);
    let constants = Constants::new(axes.0.map(|axis| inverse[axis]), axes.0.map(|axis| mu[axis]));
    let Course { periods, period, rest } = constants.course(h);
    let of_period = if periods > 0.0 { count(constants.length(0.5 * period)) } else { 0.0 };
    count(constants.length(rest)) + of_period
}

/// Returns the number of pieces of a motion over which the argument u goes by `length`.
fn count(length: f64) -> f64 {
    (length / LONGEST_PIECE).ceil().clamp(1.0, MAX_PIECES)
}

/// A motion: whole periods of the momentum, and a remainder with its sign.
struct Course {
    periods: f64,
    period: f64,
    rest: f64,
}

/// Puts `mu + gain` back to where the size of the momentum and the energy are those of `mu`.
///
/// The constants of the exact solution are the same numbers at every step of a body whose motion is
/// regular, and so is the effect of their rounding on the conserved quantities: it would accumulate
/// linearly (Vilmart 2008, Journal of Computational Physics 227). To first order, for
/// `d_G = gain . (2 mu + gain)` and, `w` being the mean of J^-1 along mu,
/// `d_T = gain . (J^-1 - w) (2 mu + gain)`,
///
/// ```text
/// gain <- gain - d_G mu / (2 |mu|^2) - d_T n / (2 |n|^2),     n = (J^-1 - w) mu, which is across mu
/// ```
pub fn on_orbit(
    inverse: &Matrix3<f64>,
    mu: &Vector3<f64>,
    momentum_increment: Vector3<f64>,
) -> Vector3<f64> {
    let square = mu.norm_squared();
    if square == 0.0 {
        return momentum_increment;
    }
    let both = mu * 2.0 + momentum_increment;
    // The gradients at the end of the step.
    let end = mu + momentum_increment;
    let rate = inverse * end;
    let mean = rate.dot(&end) / square;
    let across = rate - end * mean;
    let part = |defect: f64, size: f64| if size > 0.0 { -0.5 * defect / size } else { 0.0 };
    let longer = part(momentum_increment.dot(&both), square);
    let defect = momentum_increment.dot(&(inverse * both - both * mean));
    momentum_increment + (end * longer + across * part(defect, across.norm_squared()))
}

/// The axes x, y, z, y that of the middle moment, right-handed.
struct Axes([usize; 3]);

impl Axes {
    fn new(inverse: &Vector3<f64>) -> Self {
        let between = |y: usize| {
            let (x, z) = ((y + 2) % 3, (y + 1) % 3);
            (inverse[z] - inverse[y]) * (inverse[y] - inverse[x]) >= 0.0
        };
        let y = (0..3).find(|&y| between(y)).unwrap_or(1);
        Self([(y + 2) % 3, y, (y + 1) % 3])
    }
}

/// Constants of the motion.
struct Constants {
    /// alpha, beta, gamma.
    rates: [f64; 3],
    /// a and b.
    squares: [f64; 2],
    /// a - b, without the term that both share.
    difference: f64,
}

impl Constants {
    fn new([wx, wy, wz]: [f64; 3], [x, y, z]: [f64; 3]) -> Self {
        let [alpha, beta, gamma] = [wz - wy, wx - wz, wy - wx];
        let middle = alpha * gamma * y * y;
        let squares = [middle - alpha * beta * z * z, middle - beta * gamma * x * x];
        let difference = beta * (gamma * x * x - alpha * z * z);
        Self { rates: [alpha, beta, gamma], squares, difference }
    }

    /// Returns how far the argument u goes in `h`.
    fn length(&self, h: f64) -> f64 {
        let [a, b] = self.squares;
        // The sum keeps a NaN, a maximum would not.
        h.abs() * (a + b).sqrt()
    }

    /// Returns the period of the momentum; infinite on a separatrix and where it rests.
    fn period(&self) -> f64 {
        let [a, b] = self.squares;
        std::f64::consts::TAU / agm(a.max(b).sqrt(), self.difference.abs().sqrt())
    }

    /// Splits `h` into whole periods of the momentum and a remainder.
    fn course(&self, h: f64) -> Course {
        // K is at least pi / 2.
        if self.length(h) < 6.0 {
            return Course { periods: 0.0, period: 0.0, rest: h };
        }
        let period = self.period();
        if !period.is_finite() {
            return Course { periods: 0.0, period: 0.0, rest: h };
        }
        // The remainder is exact.
        let rest = h % period;
        Course { periods: ((h - rest) / period).abs().round(), period: period.copysign(h), rest }
    }

    /// `S^2(s t) / (s t)^2` as a polynomial in s^2: with `p = a + b`, `q = a b`,
    /// `(S^2)'' = 2 - 4 p S^2 + 6 q S^4`.
    fn series(&self, t: f64) -> Series {
        let [a, b] = self.squares.map(|square| square * t * t);
        let (p, q) = (a + b, a * b);
        let mut w = [0.0; TERMS];
        w[0] = 1.0;
        for n in 1..TERMS {
            let products: f64 = (0..n - 1).map(|i| w[i] * w[n - 2 - i]).sum();
            w[n] = (6.0 * q * products - 4.0 * p * w[n - 1]) / ((2 * n + 2) * (2 * n + 1)) as f64;
        }
        Series { t, squares: [a, b], w }
    }

    /// Returns the change of x, y, z in a piece.
    ///
    /// Computed in the small numbers c - 1 and d - 1: ratios near one would round the same way in
    /// every piece, and the size of the momentum would drift.
    fn change(&self, [x, y, z]: [f64; 3], series: &Series) -> [f64; 3] {
        let [alpha, beta, gamma] = self.rates;
        let [s, c, d] = series.at(1.0);
        let [c1, d1] = series.remainder();
        let rest = alpha * gamma * (s * y) * (s * y);
        let scale = 1.0 / (1.0 - rest);
        [
            (x * (c1 + rest) + alpha * s * d * y * z) * scale,
            (y * (c1 + d1 + c1 * d1 + rest) + beta * s * z * x) * scale,
            (z * (d1 + rest) + gamma * s * c * x * y) * scale,
        ]
    }

    /// Returns numerator and divisor of x or z at the time of S, c and d, from the momentum at
    /// time 0.
    fn place(&self, i: usize, [x, y, z]: [f64; 3], [s, c, d]: [f64; 3]) -> [f64; 2] {
        let [alpha, _, gamma] = self.rates;
        let numerator =
            if i == 0 { x * c + alpha * s * d * y * z } else { z * d + gamma * s * c * x * y };
        [numerator, 1.0 - alpha * gamma * (s * y) * (s * y)]
    }
}

/// Returns the arithmetic-geometric mean of two numbers that are not negative.
fn agm(mut arithmetic: f64, mut geometric: f64) -> f64 {
    // The number of correct digits doubles in each round, once the two are of one size.
    while geometric > 0.0 && (arithmetic - geometric).abs() > 4.0 * f64::EPSILON * arithmetic {
        let product = arithmetic.sqrt() * geometric.sqrt();
        (arithmetic, geometric) = (0.5 * (arithmetic + geometric), product);
    }
    if geometric > 0.0 { arithmetic } else { 0.0 }
}

/// S, c and d on one piece.
struct Series {
    t: f64,
    /// a t^2, b t^2.
    squares: [f64; 2],
    w: [f64; TERMS],
}

impl Series {
    /// Returns S, c, d at the fraction `s` of the piece.
    fn at(&self, s: f64) -> [f64; 3] {
        let square = s * s;
        let ratio = self.w.iter().rev().fold(0.0, |sum, w| sum * square + w);
        let full = ratio * square;
        let [a, b] = self.squares;
        [self.t * s * ratio.sqrt(), (1.0 - a * full).sqrt(), (1.0 - b * full).sqrt()]
    }
}

impl Series {
    /// Returns c - 1 and d - 1 at the end of the piece.
    fn remainder(&self) -> [f64; 2] {
        let full: f64 = self.w.iter().rev().sum();
        self.squares.map(|square| -square * full / (1.0 + (1.0 - square * full).sqrt()))
    }
}

/// The body axis e.
struct Pole {
    axis: usize,
    sign: f64,
}

impl Pole {
    /// Returns the shortest rotation from e to `m`, whose size is `size`, not normalised:
    /// `(G + e . m, e cross m)`.
    fn to(&self, m: &Vector3<f64>, size: f64) -> Quaternion<f64> {
        let mut e = Vector3::zeros();
        e[self.axis] = self.sign;
        Quaternion::from_parts(size + e.dot(m), e.cross(m))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::so3::{self, Top};

    /// Returns the body after `h`.
    fn after(inverse: &Vector3<f64>, top: &Top, h: f64) -> Option<Top> {
        let (Drift { turn, momentum_increment }, _) = flow(inverse, &top.momentum, h)?;
        let attitude = so3::renormalised(&(top.attitude * turn));
        Some(Top { attitude, momentum: top.momentum + momentum_increment })
    }

    #[test]
    fn a_long_step_is_many_short_ones_and_keeps_what_is_kept() {
        let bodies = [[1.0, 0.5, 0.25], [0.99, 1.0, 100.0], [0.7, 0.7, 2.0], [2.0, 0.7, 0.7]];
        let momenta = [
            [0.3, -0.2, 0.5],
            [1e-9, 1.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, 0.0, -2.0],
            // On the separatrix of the first body: 2 T = G^2 w_y.
            [1.0, 0.4, std::f64::consts::SQRT_2],
        ];
        for inverse in bodies.map(Vector3::from) {
            for momentum in momenta.map(Vector3::from) {
                let attitude = Quaternion::new(0.1, -0.7, 0.5, 0.5);
                let start = Top { attitude, momentum };
                let start = Top { attitude: start.attitude.normalize(), ..start };
                let long = after(&inverse, &start, 1.0).expect("finite");
                let short = (0..400)
                    .fold(start, |top, _| after(&inverse, &top, 1.0 / 400.0).expect("finite"));
                let scale = 1.0 + momentum.norm() * inverse.amax();
                assert!((long.momentum - short.momentum).amax() < 4e-15 * scale);
                assert!((long.attitude - short.attitude).norm() < 1e-14 * scale);
                let back = after(&inverse, &long, -1.0).expect("finite");
                assert!((back.attitude - start.attitude).norm() < 1e-14 * scale);
                let energy = |m: &Vector3<f64>| 0.5 * m.dot(&m.component_mul(&inverse));
                let change = energy(&long.momentum) - energy(&momentum);
                assert!(change.abs() < 1e-14 * scale * scale, "{change:e}");
                let space = |top: &Top| so3::rotation(&top.attitude) * top.momentum;
                assert!((space(&long) - space(&start)).amax() < 4e-15 * scale);
            }
        }
        let spin = Top { momentum: Vector3::new(1.0, 0.0, 0.0), ..Top::at_rest() };
        assert_eq!(after(&Vector3::repeat(f64::NAN), &spin, 1.0), None);
        assert_eq!(after(&Vector3::new(1.0, 2.0, 3.0), &spin, 2.0 * MOST_TURN_RAD), None);
        assert!(after(&Vector3::new(1.0, 2.0, 3.0), &spin, 0.9 * MOST_TURN_RAD / 3.0).is_some());
    }

    #[test]
    fn whole_periods_are_what_their_pieces_are() {
        let bodies =
            [[1.0, 0.5, 0.25], [0.99, 1.0, 100.0], [0.7, 0.7, 2.0], [1.0, 1.0 + 1e-9, 1.2]];
        let momenta = [
            [3.0, -2.0, 5.0],
            [1e-2, 4.0, 1e-2],
            [0.1, 0.2, -7.0],
            // Near the separatrix of the first body.
            [1.0, 0.4, 1.41],
        ];
        let mut periods_seen = 0.0;
        for inverse in bodies.map(Vector3::from) {
            for momentum in momenta.map(Vector3::from) {
                let attitude = Quaternion::new(0.1, -0.7, 0.5, 0.5).normalize();
                let start = Top { attitude, momentum };
                let axes = Axes::new(&inverse);
                let constants = Constants::new(
                    axes.0.map(|axis| inverse[axis]),
                    axes.0.map(|axis| momentum[axis]),
                );
                let period = constants.period();
                // Parts of a period, one after the other, none of which is a whole one.
                let around = |top: &Top| {
                    (0..8).fold(*top, |top, _| after(&inverse, &top, period / 8.0).expect("finite"))
                };
                let apart = |one: &Top, other: &Top| {
                    let turned = (one.attitude - other.attitude).norm();
                    turned + (one.momentum - other.momentum).norm() / momentum.norm()
                };
                let long = |top: &Top| after(&inverse, top, 2.0 * period).expect("finite");
                let end = long(&start);
                // Effect of rounding of the start alone, which is large near a separatrix.
                let nudged = |axis: usize| {
                    let mut top = start;
                    top.momentum[axis] += 1e-15 * momentum.norm();
                    apart(&long(&top), &end)
                };
                let turns = momentum.norm() * inverse.amax() * period;
                let nudges: f64 = (0..3).map(nudged).sum();
                let least = 1e-15 * (8.0 + turns) + 16.0 * nudges;
                let apart = [
                    apart(&around(&start), &Top { attitude: around(&start).attitude, ..start }),
                    apart(&around(&around(&start)), &end),
                    apart(&after(&inverse, &end, -2.0 * period).expect("finite"), &start),
                ];
                assert!(apart.iter().all(|x| *x < least), "{apart:?}, {least:e}");
                assert!(least < 1e-9, "{least:e}");
                // At most a period and a half, however long the motion.
                let most = 1.5 * constants.length(period) / LONGEST_PIECE + 2.0;
                for k in 0..40 {
                    let h = period * 1.37 * f64::from(k);
                    assert!(pieces(&inverse, &momentum, h) <= most);
                    periods_seen += constants.course(h).periods;
                }
            }
        }
        assert!(periods_seen > 1000.0);
        assert_eq!((agm(1.0, 0.0), agm(3.0, 3.0)), (0.0, 3.0));
        // Gauss's constant is 1 / agm(1, sqrt 2).
        assert!((agm(1.0, std::f64::consts::SQRT_2) - 1.198_140_234_735_592_2).abs() < 4e-16);
    }

    /// The state of the body J = (1, 2, 3) that starts with Omega = (0.1, 0.2, 0.3), from a Taylor series of Euler's
    /// equations with 50 digits over a period, whose rotation was then repeated.
    #[test]
    fn a_step_of_millions_of_periods_is_what_fifty_digits_say() {
        let inverse = Vector3::new(1.0, 1.0 / 2.0, 1.0 / 3.0);
        let momentum = Vector3::new(0.1, 0.2 * 2.0, 0.3 * 3.0);
        let start = Top { attitude: Quaternion::identity(), momentum };
        let known = [
            (
                1e5,
                [-0.206_017_540_930_466_26, -0.173_859_400_999_355_4, 0.952_538_545_946_099_2],
                [
                    -0.771_736_654_975_601,
                    0.270_088_717_806_358_6,
                    -0.193_667_034_173_032_37,
                    -0.542_187_882_339_147_2,
                ],
            ),
            (
                1e8,
                [0.192_952_191_870_768_36, -0.226_003_996_887_366_55, 0.944_294_257_656_585_2],
                [
                    0.338_355_215_062_754_25,
                    -0.257_692_888_958_371_7,
                    -0.101_894_918_222_811_74,
                    -0.899_292_804_964_263_1,
                ],
            ),
        ];
        for (t, momentum, [w, x, y, z]) in known {
            let end = after(&inverse, &start, t).expect("a motion within what doubles give");
            // Some roundings of a turn of 0.37 rad/s.
            let most = 8.0 * f64::EPSILON * 0.4 * t;
            let attitude = Quaternion::new(w, x, y, z);
            let apart = (end.attitude - attitude).norm().min((end.attitude + attitude).norm());
            assert!(apart < most, "{t}: {apart:e}");
            let apart = (end.momentum - Vector3::from(momentum)).norm();
            assert!(apart < most, "{t}: {apart:e}");
        }
    }

    #[test]
    fn the_rates_are_eulers_equations() {
        let inverse = Vector3::new(1.3, 0.4, 0.9);
        let start = Top { momentum: Vector3::new(0.3, -0.8, 0.5), ..Top::at_rest() };
        // Five points, fourth order.
        let e = 1e-3;
        let at = |k: f64| after(&inverse, &start, k * e).expect("finite");
        let (one, two) =
            (at(1.0).momentum - at(-1.0).momentum, at(2.0).momentum - at(-2.0).momentum);
        let omega = start.momentum.component_mul(&inverse);
        let rate = (one * 8.0 - two) / (12.0 * e);
        assert!((rate - start.momentum.cross(&omega)).amax() < 1e-11);
        let one = at(1.0).attitude.vector() - at(-1.0).attitude.vector();
        let two = at(2.0).attitude.vector() - at(-2.0).attitude.vector();
        assert!(((one * 8.0 - two) / (12.0 * e) - omega * 0.5).amax() < 1e-11);
    }
}
