//! Figures of samples: each with an interval that says how sure it is.
//!
//! Invariant: no distribution is assumed; an interval that the samples do not bound is open at that end.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde::Serialize;
use statrs::distribution::{Beta, Binomial, ContinuousCDF, DiscreteCDF, Normal};

/// A figure with its interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figure {
    /// The estimate.
    pub value: f64,
    /// The lower end of the interval; absent where it is open.
    pub low: Option<f64>,
    /// The upper end.
    pub high: Option<f64>,
}

/// Returns the `part`-quantile of samples in rising order, at least one, with an interval that holds that of the distribution
/// with probability `confidence` or more: between two of the samples, by the binomial distribution of how many lie below (David
/// and Nagaraja, Order Statistics, 2003, section 7.1). The estimate lies between the samples next to it (type 7 of Hyndman and
/// Fan 1996).
pub fn quantile(rising: &[f64], part: f64, confidence: f64) -> Figure {
    let count = rising.len();
    let place = part * (count - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(count - 1);
    let value = rising[below] + (place - below as f64) * (rising[above] - rising[below]);
    let Ok(number_below) = Binomial::new(part, count as u64) else {
        return Figure { value, low: None, high: None };
    };
    let tail = 0.5 * (1.0 - confidence);
    // P(X_(l) <= q <= X_(u)) = P(l <= B < u), samples counted from 1
    let least = |holds: &dyn Fn(u64) -> bool| {
        let (mut low, mut high) = (0, count as u64 + 1);
        while low < high {
            let middle = (low + high) / 2;
            if holds(middle) { high = middle } else { low = middle + 1 }
        }
        low
    };
    // The largest l with P(B <= l - 1) <= tail, and the smallest u with P(B <= u - 1) >= 1 - tail.
    let l = least(&|l| number_below.cdf(l) > tail);
    let u = least(&|u| u > 0 && number_below.cdf(u - 1) >= 1.0 - tail);
    let sample = |k: u64| k.checked_sub(1).and_then(|k| rising.get(k as usize)).copied();
    Figure { value, low: sample(l), high: sample(u) }
}

/// Returns the part of `count` trials that succeeded, with the interval of Clopper and Pearson (1934).
pub fn proportion(succeeded: u64, count: u64, confidence: f64) -> Figure {
    let tail = 0.5 * (1.0 - confidence);
    let (x, n) = (succeeded as f64, count as f64);
    let at = |a: f64, b: f64, p: f64| Beta::new(a, b).ok().map(|beta| beta.inverse_cdf(p));
    let low = if succeeded == 0 { Some(0.0) } else { at(x, n - x + 1.0, tail) };
    let high = if succeeded == count { Some(1.0) } else { at(x + 1.0, n - x, 1.0 - tail) };
    Figure { value: x / n, low, high }
}

/// Returns the mean of samples and its standard error.
pub fn mean(samples: &[f64]) -> (f64, f64) {
    let count = samples.len() as f64;
    let mean = samples.iter().sum::<f64>() / count;
    let squares: f64 = samples.iter().map(|x| (x - mean) * (x - mean)).sum();
    (mean, (squares / (count - 1.0).max(1.0) / count).sqrt())
}

/// Returns the ranks of samples, from 1 on; equal ones share the mean of theirs.
pub fn ranks(samples: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..samples.len()).collect();
    order.sort_by(|&a, &b| samples[a].total_cmp(&samples[b]));
    let mut ranks = vec![0.0; samples.len()];
    let mut first = 0;
    while first < order.len() {
        let equal = order[first..].iter().take_while(|&&k| samples[k] == samples[order[first]]);
        let end = first + equal.count().max(1);
        for &k in &order[first..end] {
            ranks[k] = 0.5 * (first + 1 + end) as f64;
        }
        first = end;
    }
    ranks
}

/// Returns the rank correlation of two quantities (Spearman 1904) by their ranks, with the interval of Fisher's transform and
/// the variance of Bonett and Wright (2000); `None` if one of them does not change.
pub fn rank_correlation(x: &[f64], y: &[f64], confidence: f64) -> Option<Figure> {
    let count = x.len() as f64;
    let middle = 0.5 * (count + 1.0);
    let product = |a: &[f64], b: &[f64]| -> f64 {
        a.iter().zip(b).map(|(a, b)| (a - middle) * (b - middle)).sum()
    };
    let (xx, yy) = (product(x, x), product(y, y));
    if !(xx > 0.0 && yy > 0.0) {
        return None;
    }
    let value = (product(x, y) / (xx * yy).sqrt()).clamp(-1.0, 1.0);
    let deviations = Normal::new(0.0, 1.0).ok()?.inverse_cdf(0.5 * (1.0 + confidence));
    let bound = |sign: f64| {
        (count > 3.0).then(|| {
            let width = deviations * ((1.0 + 0.5 * value * value) / (count - 3.0)).sqrt();
            libm::tanh(libm::atanh(value.clamp(-1.0 + 1e-15, 1.0 - 1e-15)) + sign * width)
        })
    };
    Some(Figure { value, low: bound(-1.0), high: bound(1.0) })
}

/// How much of a quantity's variance a field explains.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Sobol {
    /// By itself: `V(E(y | x_i)) / V(y)`.
    pub first: Figure,
    /// With all that it does together with others: `E(V(y | x_others)) / V(y)`.
    pub total: Figure,
}

/// Returns Sobol's indices of each field from rows of runs: with the values of the first half A, of the second B, and of A with one
/// field of B, for each field. First indices by Saltelli et al. (2010), total ones by Jansen (1999), intervals by 200 samples with
/// repetition from the rows.
pub fn sobol(rows: &[Vec<f64>], confidence: f64) -> Vec<Sobol> {
    const RESAMPLES: usize = 200;
    let fields = rows.first().map_or(0, |row| row.len().saturating_sub(2));
    if rows.is_empty() {
        return Vec::new();
    }
    // About their mean the products scatter least, and the squares lose no digits. In parts, for numbers near the largest double.
    let numbers = rows.iter().flatten();
    let each = 1.0 / (rows.len() * (fields + 2)) as f64;
    let origin = numbers.fold(0.0, |sum, x| sum + x * each);
    let of = |chosen: &mut dyn Iterator<Item = &Vec<f64>>| -> Vec<(f64, f64)> {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        let mut sums = vec![(0.0, 0.0); fields];
        for row in chosen {
            let (a, b) = (row[0] - origin, row[1] - origin);
            count += 2.0;
            sum += a + b;
            squares += a * a + b * b;
            for ((first, total), mixed) in sums.iter_mut().zip(&row[2..]) {
                let mixed = mixed - origin;
                *first += b * (mixed - a);
                *total += 0.5 * (a - mixed) * (a - mixed);
            }
        }
        let variance = squares / count - (sum / count) * (sum / count);
        let each = 0.5 * count * variance;
        sums.iter().map(|(first, total)| (first / each, total / each)).collect()
    };
    let whole = of(&mut rows.iter());
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut resampled: Vec<Vec<(f64, f64)>> = Vec::with_capacity(RESAMPLES);
    for _ in 0..RESAMPLES {
        let mut chosen = (0..rows.len()).map(|_| {
            let at = (u128::from(random.next_u64()) * rows.len() as u128) >> 64;
            &rows[at as usize]
        });
        resampled.push(of(&mut chosen));
    }
    let ends = |value: f64, mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        let tail = 0.5 * (1.0 - confidence);
        let [low, high] = [tail, 1.0 - tail].map(|part| quantile(&values, part, 0.5).value);
        Figure { value, low: Some(low), high: Some(high) }
    };
    let index = |k: usize| Sobol {
        first: ends(whole[k].0, resampled.iter().map(|found| found[k].0).collect()),
        total: ends(whole[k].1, resampled.iter().map(|found| found[k].1).collect()),
    };
    (0..fields).map(index).collect()
}

/// The mean of attitudes for n = 3 and how they lie about it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeanAttitude {
    /// The intrinsic mean, as a quaternion w, x, y, z: the sum of the squared angles from it is least.
    pub quaternion: [f64; 4],
    /// The covariance of the turns from it, in its body coordinates, in rad^2.
    pub covariance_rad2: [[f64; 3]; 3],
}

/// Returns the mean of attitudes, quaternions w, x, y, z; `None` if they lie all around, so that there is none (Karcher 1977).
pub fn mean_attitude(quaternions: &[[f64; 4]]) -> Option<MeanAttitude> {
    let attitudes: Vec<UnitQuaternion<f64>> = quaternions
        .iter()
        .map(|[w, x, y, z]| UnitQuaternion::from_quaternion(Quaternion::new(*w, *x, *y, *z)))
        .collect();
    let mut mean = *attitudes.first()?;
    let turns = |mean: &UnitQuaternion<f64>| -> Vec<Vector3<f64>> {
        attitudes.iter().map(|q| turn(&(mean.inverse() * q))).collect()
    };
    for _ in 0..200 {
        let step: Vector3<f64> = turns(&mean).iter().sum::<Vector3<f64>>() / attitudes.len() as f64;
        mean *= UnitQuaternion::from_scaled_axis(step);
        if step.norm() < 1e-14 {
            let mut covariance = Matrix3::zeros();
            for turn in turns(&mean) {
                covariance += turn * turn.transpose();
            }
            covariance /= (attitudes.len() as f64 - 1.0).max(1.0);
            let q = mean.quaternion();
            return Some(MeanAttitude {
                quaternion: [q.w, q.i, q.j, q.k],
                covariance_rad2: std::array::from_fn(|i| {
                    std::array::from_fn(|j| covariance[(i, j)])
                }),
            });
        }
    }
    None
}

/// Returns the rotation vector of a turn by at most pi.
fn turn(q: &UnitQuaternion<f64>) -> Vector3<f64> {
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    let vector = Vector3::new(q.i, q.j, q.k) * sign;
    let sine = vector.norm();
    let angle = 2.0 * libm::atan2(sine, q.w * sign);
    if sine > 0.0 { vector * (angle / sine) } else { Vector3::zeros() }
}
