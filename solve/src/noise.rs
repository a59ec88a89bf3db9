//! Normal random numbers by number, for the noise of a sampled control.
//!
//! Invariant: a draw is a function of seed, stream, kind and number alone. So it needs no place in a checkpoint, and neither steps,
//! threads nor other members of an ensemble change it.

use std::f64::consts::PI;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng as _, SeedableRng as _};

use super::so::{self, Mat};

/// Noise of the sensors and of the torque, by standard deviations of each component. A new draw for each sample of the control.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Noise {
    /// Seed of the generator.
    pub seed: u64,
    /// Which of the independent streams of that seed.
    pub stream: u64,
    /// Of the attitude that is read: a turn about each body axis (else in each coordinate plane), in rad.
    pub attitude: f64,
    /// Of the angular velocity that is read, in rad/s.
    pub rate: f64,
    /// Of a torque on the body, held from one sample to the next, in N m.
    pub torque: f64,
}

/// What a draw is for.
#[derive(Clone, Copy)]
pub(crate) enum Kind {
    Attitude,
    Rate,
    Torque,
}

impl Noise {
    /// Returns the noise of a kind at sample `number`, skew, in body coordinates; zero without drawing if it has no deviation.
    pub(crate) fn draw<const N: usize>(&self, kind: Kind, number: u64) -> Mat<N> {
        let (place, deviation) = match kind {
            Kind::Attitude => (0, self.attitude),
            Kind::Rate => (1, self.rate),
            Kind::Torque => (2, self.torque),
        };
        if deviation == 0.0 {
            return Mat::zeros();
        }
        // Two numbers of 64 bits make two normal ones.
        let pairs = so::dimension(N).div_ceil(2);
        let words = 4 * pairs as u128;
        let mut random = self.generator();
        random.set_word_pos((3 * u128::from(number) + place) * words);
        let mut normal = Vec::with_capacity(2 * pairs);
        for _ in 0..pairs {
            normal.extend(normal_pair(random.next_u64(), random.next_u64()));
        }
        for x in &mut normal {
            *x *= deviation;
        }
        normal.truncate(so::dimension(N));
        so::hat(&normal)
    }

    /// The generator at the start of its stream. Its key is no other use's of the same seed.
    fn generator(&self) -> ChaCha8Rng {
        let mut key = *b"________noise of sampled control";
        key[..8].copy_from_slice(&self.seed.to_le_bytes());
        let mut random = ChaCha8Rng::from_seed(key);
        random.set_stream(self.stream);
        random
    }
}

/// Two independent normal numbers from two uniform ones (Box, Muller 1958).
fn normal_pair(a: u64, b: u64) -> [f64; 2] {
    /// 2^-53
    const UNIT: f64 = 0.5 * f64::EPSILON;
    // Above zero, and at most one.
    let a = ((a >> 11) + 1) as f64 * UNIT;
    let b = (b >> 11) as f64 * UNIT;
    let size = (-2.0 * libm::log(a)).sqrt();
    let (sin, cos) = libm::sincos(2.0 * PI * b);
    [size * cos, size * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean, variance, fourth moment and correlations of 1e5 samples of each kind, within five deviations of their estimates.
    #[test]
    fn draws_are_normal_and_independent() {
        const SAMPLES: u64 = 100_000;
        let noise = Noise { seed: 5, stream: 0, attitude: 1.0, rate: 1.0, torque: 1.0 };
        let other = Noise { stream: 1, ..noise };
        let kinds = [Kind::Attitude, Kind::Rate, Kind::Torque];
        let row = |number: u64| -> Vec<f64> {
            let of = |noise: &Noise, number: u64| -> Vec<f64> {
                kinds.iter().flat_map(|&kind| so::vee(&noise.draw::<3>(kind, number))).collect()
            };
            [of(&noise, number), of(&noise, number + SAMPLES), of(&other, number)].concat()
        };
        let rows: Vec<Vec<f64>> = (0..SAMPLES).map(row).collect();
        let mean =
            |f: &dyn Fn(&[f64]) -> f64| rows.iter().map(|row| f(row)).sum::<f64>() / SAMPLES as f64;
        let near = |found: f64, right: f64, variance: f64| {
            let most = 5.0 * (variance / SAMPLES as f64).sqrt();
            assert!((found - right).abs() < most, "{found} for {right}, at most {most} off");
        };
        for i in 0..27 {
            near(mean(&|row| row[i]), 0.0, 1.0);
            near(mean(&|row| row[i] * row[i]), 1.0, 2.0);
            near(mean(&|row| row[i].powi(4)), 3.0, 96.0);
            for j in 0..i {
                near(mean(&|row| row[i] * row[j]), 0.0, 1.0);
            }
        }
    }

    /// The largest number there is, and every dimension: draws stay finite and do not overlap.
    #[test]
    fn draws_are_by_number() {
        let noise =
            Noise { seed: u64::MAX, stream: u64::MAX, attitude: 2.0, rate: 0.0, torque: 1.0 };
        for number in [0, 1, 7, 1 << 40] {
            let draw = noise.draw::<5>(Kind::Attitude, number);
            assert_eq!(draw, noise.draw::<5>(Kind::Attitude, number));
            assert_ne!(draw, noise.draw::<5>(Kind::Attitude, number + 1));
            assert_ne!(draw, noise.draw::<5>(Kind::Torque, number) * 2.0);
            assert_eq!(noise.draw::<5>(Kind::Rate, number), Mat::<5>::zeros());
            assert!(draw.iter().all(|x| x.is_finite()) && draw == -draw.transpose());
        }
    }
}
