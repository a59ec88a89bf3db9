//! A short motion of the free body in lanes: one piece, a turn of at most two radians.

use super::{Axes, LONGEST_PIECE, RULE, SHORT, SHORT_RULE, TERMS};
use crate::lanes::{Real, StageScalar, StepScalar};
use crate::space::{
    Quaternion, SERIES_UP_TO, Vec3, cross, dot, minus, plus, scaled, sine_series, vec3,
};
use nalgebra::Vector3;

/// A short motion.
pub(crate) struct ShortFlow<R> {
    /// f of `g1 = g0 f`.
    pub(crate) turn: Quaternion<R>,
    /// Change of the body momentum.
    pub(crate) momentum_increment: Vec3<R>,
    /// Below zero where the motion is short.
    pub(crate) doubt: R,
}

/// Returns the motion in `h` given inverse principal moments of inertia and the momentum: the formulas of [`super::flow`].
#[inline(always)]
pub(crate) fn short_flow<R: StageScalar>(
    inverse: &Vector3<f64>,
    mu: &Vec3<R>,
    h: f64,
) -> ShortFlow<R> {
    let axes = Axes::new(inverse).0;
    let w = axes.map(|axis| inverse[axis]);
    let m: Vec3<R> = vec3!(i => mu[axes[i]]);
    let one = m[0].constant(1.0);
    let zero = m[0].constant(0.0);
    let [alpha, beta, gamma] = [w[2] - w[1], w[0] - w[2], w[1] - w[0]];
    let middle = m[1] * m[1] * (alpha * gamma);
    let a = middle - m[2] * m[2] * (alpha * beta);
    let b = middle - m[0] * m[0] * (beta * gamma);
    let size = dot(&m, &m).sqrt();
    let length = (a + b).sqrt() * h.abs();
    let whole = length.stage(0);
    // Of one body the rest is not needed.
    if R::LANES == 1 && !(whole.lane(0) <= LONGEST_PIECE) {
        let turn = Quaternion { w: one, v: [zero; 3] };
        return ShortFlow { turn, momentum_increment: [zero; 3], doubt: one };
    }

    // S^2 / t^2, its series.
    let (a, b) = (a * (h * h), b * (h * h));
    let (four_p, six_q) = ((a + b) * 4.0, a * b * 6.0);
    let mut series = [one; TERMS];
    for n in 1..TERMS {
        let mut products = zero;
        for i in 0..n - 1 {
            products = products + series[i] * series[n - 2 - i];
        }
        let divisor = 1.0 / ((2 * n + 2) * (2 * n + 1)) as f64;
        series[n] = (six_q * products - four_p * series[n - 1]) * divisor;
    }

    // The pole: z where that keeps its sign, else x.
    let is_z = b - a;
    let along = m[2].select(is_z, 0.0, m[0]);
    let sign = one.select(-along, 0.0, -one);
    let pole = [zero.select(is_z, 0.0, sign), zero, sign.select(is_z, 0.0, zero)];
    let products = [m[1] * m[2] * alpha, m[2] * m[0] * beta, m[0] * m[1] * gamma];
    let middle = m[1] * m[1] * (alpha * gamma);
    let data = Piece { m, products, middle, series, squares: [a, b], h, is_z, sign, size };
    let mut integral = data.integral(&SHORT_RULE);
    let mut all_short = true;
    for lane in 0..<R::StepScalar as StepScalar>::LANES {
        all_short &= whole.lane(lane) <= SHORT;
    }
    if !all_short {
        integral = integral.select(length, SHORT, data.integral(&RULE));
    }

    // The change of the momentum, in the small numbers c - 1 and d - 1.
    let [s, c, d, full] = data.at(1.0);
    let (c1, d1) = (-(a * full) / (c + 1.0), -(b * full) / (d + 1.0));
    let rest = s * s * middle;
    let scale = one / (one - rest);
    let gains = [
        (m[0] * (c1 + rest) + s * d * products[0]) * scale,
        (m[1] * (c1 + d1 + c1 * d1 + rest) + s * products[1]) * scale,
        (m[2] * (d1 + rest) + s * c * products[2]) * scale,
    ];
    let (end, both) = (plus(&m, &gains), plus(&plus(&m, &m), &gains));
    let of_end = vec3!(i => end[i] * w[i]);
    let of_both = vec3!(i => both[i] * w[i]);
    let gains = on_orbit(&m, &gains, &of_end, &of_both);
    let end = plus(&m, &gains);

    // 2 T - G^2 w_e, without the difference of large numbers.
    let by_y = m[1] * m[1];
    let of_z = m[0] * m[0] * (w[0] - w[2]) + by_y * (w[1] - w[2]);
    let of_x = by_y * (w[1] - w[0]) + m[2] * m[2] * (w[2] - w[0]);
    let remainder = of_z.select(is_z, 0.0, of_x);
    let w_e = one.constant(w[2]).select(is_z, 0.0, one.constant(w[0]));
    let half = (size * w_e * h + remainder * integral) * 0.5;
    let square = half * half;
    let [sine, versine] = sine_series(square);
    let about = Quaternion { w: one - square * versine, v: scaled(&pole, half * sine) };
    // The shortest rotations from the pole to the momentum, not normalised; the second back.
    let from = Quaternion { w: size + dot(&pole, &m), v: cross(&pole, &m) };
    let back = Quaternion { w: size + dot(&pole, &end), v: cross(&end, &pole) };
    let turn = from.times(&about).times(&back).normalised();

    let (mut v, mut momentum_increment) = ([zero; 3], [zero; 3]);
    for i in 0..3 {
        v[axes[i]] = turn.v[i];
        momentum_increment[axes[i]] = gains[i];
    }
    let doubt = (length + -LONGEST_PIECE).max_or_nan(square + -SERIES_UP_TO);
    ShortFlow { turn: Quaternion { w: turn.w, v }, momentum_increment, doubt }
}

/// One piece of a motion: its constants.
struct Piece<R> {
    m: Vec3<R>,
    /// alpha y z, beta z x, gamma x y.
    products: Vec3<R>,
    /// alpha gamma y^2
    middle: R,
    series: [R; TERMS],
    /// a h^2, b h^2.
    squares: [R; 2],
    h: f64,
    /// Not above zero where the pole is z.
    is_z: R,
    sign: R,
    size: R,
}

impl<R: Real> Piece<R> {
    /// S, c, d and S^2 / t^2 at a fraction of the piece.
    #[inline(always)]
    fn at(&self, part: f64) -> [R; 4] {
        let square = part * part;
        let mut ratio = self.series[TERMS - 1];
        for n in (0..TERMS - 1).rev() {
            ratio = ratio * square + self.series[n];
        }
        let full = ratio * square;
        let [a, b] = self.squares;
        let one = full.constant(1.0);
        let s = ratio.sqrt() * (self.h * part);
        [s, (one - a * full).sqrt(), (one - b * full).sqrt(), full]
    }

    /// The integral of `1 / (G + e . mu)`.
    #[inline(always)]
    fn integral<const K: usize>(&self, rule: &[(f64, f64); K]) -> R {
        let [x, _, z] = self.m;
        let mut sum = x.constant(0.0);
        for &(node, weight) in rule {
            let [s, c, d, _] = self.at(node);
            let of_z = z * d + s * c * self.products[2];
            let of_x = x * c + s * d * self.products[0];
            let numerator = of_z.select(self.is_z, 0.0, of_x);
            let divisor = -(s * s * self.middle) + 1.0;
            sum = sum + divisor * (weight * self.h) / (self.size * divisor + self.sign * numerator);
        }
        sum
    }
}

/// [`super::on_orbit`], given the inverse inertia times the end `mu + gain` and times `2 mu + gain`.
#[inline(always)]
pub(crate) fn on_orbit<R: Real>(
    mu: &Vec3<R>,
    gain: &Vec3<R>,
    of_end: &Vec3<R>,
    of_both: &Vec3<R>,
) -> Vec3<R> {
    let square = dot(mu, mu);
    let end = plus(mu, gain);
    let both = plus(&plus(mu, mu), gain);
    let mean = dot(of_end, &end) / square;
    let across = minus(of_end, &scaled(&end, mean));
    let size = dot(&across, &across);
    let longer = dot(gain, &both) * -0.5 / square;
    let defect = dot(gain, &minus(of_both, &scaled(&both, mean)));
    // Nothing is across a momentum along an axis.
    let part = (defect * -0.5 / size).select(-size, -f64::MIN_POSITIVE, square.constant(0.0));
    vec3!(i => gain[i] + (end[i] * longer + across[i] * part))
}
