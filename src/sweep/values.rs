//! The values of a field, each by its number alone.
//!
//! Invariant: a value depends on its number, the number of its field and the seed, not on earlier
//! calls.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde_json::{Number, Value};

use super::file::{Normal, Span, Values};

/// Values of a field, computed on request.
#[derive(Clone, Debug)]
pub(super) struct Axis {
    values: Values,
    seed: u64,
    /// Number of the field in the sweep.
    field: u64,
    /// Of correlated normal values the fields of whose numbers theirs are made, with their weights.
    weights: Vec<(u64, f64)>,
    /// Of a sweep for Sobol's indices the sequence from which its values are.
    sequence: Option<Sequence>,
    /// The parts of a Latin hypercube in their random order.
    order: Vec<u32>,
}

/// The even sequence of Sobol (1967), scrambled at random by its seed (Owen 1995; Burley 2020), that fills all fields of both halves
/// of [`super::file::Combine::Saltelli`]: the error of the indices falls faster with the number of rows than that of independent values.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sequence {
    /// Number of fields.
    pub(super) fields: u64,
    /// Number of values of a half.
    pub(super) rows: u64,
}

impl Axis {
    /// Returns the values of a field; `weights` are those of [`super::file::Correlation::weights`].
    pub(super) fn new(values: &Values, seed: u64, field: usize, weights: Vec<(u64, f64)>) -> Self {
        let (values, field) = (values.clone(), field as u64);
        let (order, sequence) = (Vec::new(), None);
        let mut axis = Self { values, seed, field, weights, sequence, order };
        if let Values::LatinHypercube(span) = axis.values {
            axis.order = axis.shuffled(span.count as u32);
        }
        axis
    }

    /// Returns the same with values from a sequence.
    pub(super) fn in_sequence(self, sequence: Sequence) -> Self {
        Self { sequence: Some(sequence), ..self }
    }

    /// Returns value number `at`, counted from 0.
    pub(super) fn value(&self, at: u64) -> Value {
        let between = |Span { from, to, .. }: Span, part: f64| from + (to - from) * part;
        match &self.values {
            Values::List(values) => values[at as usize].clone(),
            Values::Linear(span) => number(between(*span, part(at, span.count))),
            Values::Logarithmic(span) => {
                let Span { from, to, count } = *span;
                // The ends are those that were given.
                let ratio = libm::pow(to / from, part(at, count));
                number(if count > 1 && at == count - 1 { to } else { from * ratio })
            }
            Values::Uniform(span) => number(between(*span, self.unit(at))),
            Values::LatinHypercube(span) => {
                let place = f64::from(self.order[at as usize]) + self.unit(at);
                number(between(*span, place / span.count as f64))
            }
            Values::Normal(Normal { mean, deviation, .. }) if self.sequence.is_some() => {
                number(mean + deviation * normal_quantile(self.unit(at)))
            }
            Values::Normal(Normal { mean, deviation, .. }) => {
                // x = L z, z the independent numbers of the fields.
                let own = [(self.field, 1.0)];
                let weights = if self.weights.is_empty() { &own[..] } else { &self.weights };
                let x = weights.iter().fold(0.0, |sum, (field, weight)| {
                    let z: f64 = StandardNormal.sample(&mut self.random_of(*field, at));
                    sum + weight * z
                });
                number(mean + deviation * x)
            }
        }
    }

    /// Returns the random numbers of a value.
    fn random(&self, at: u64) -> ChaCha8Rng {
        self.random_of(self.field, at)
    }

    /// Returns those of a value of another field.
    fn random_of(&self, field: u64, at: u64) -> ChaCha8Rng {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream((field << 32) | at);
        random
    }

    /// Returns a number evenly distributed from 0 to 1, 1 excluded.
    fn unit(&self, at: u64) -> f64 {
        const SPACING: f64 = 1.0 / (1_u64 << 53) as f64;
        if let Some(sequence) = self.sequence {
            return self.of_sequence(sequence, at);
        }
        (self.random(at).next_u64() >> 11) as f64 * SPACING
    }

    /// Returns number `at` of the sequence, between 0 and 1: the middle of the part of 2^-23 that it says.
    fn of_sequence(&self, Sequence { fields, rows }: Sequence, at: u64) -> f64 {
        const MIDDLE: f64 = 1.0 / (1_u64 << 24) as f64;
        // So long is one sequence; after that comes another, with its own scrambling.
        const LENGTH: u64 = 1 << 16;
        let (half, row) = (at / rows, at % rows);
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        // These streams belong to no value.
        random.set_stream(u64::MAX - row / LENGTH);
        let (index, dimension) = ((row % LENGTH) as u32, (self.field + half * fields) as u32);
        f64::from(sobol_burley::sample(index, dimension, random.next_u32())) + MIDDLE
    }

    /// Returns the numbers below `count` in random order (Fisher, Yates 1938; Durstenfeld 1964).
    fn shuffled(&self, count: u32) -> Vec<u32> {
        // This stream belongs to no value.
        let mut random = self.random(u64::from(u32::MAX));
        let mut order: Vec<u32> = (0..count).collect();
        for last in (1..order.len()).rev() {
            let other = (u128::from(random.next_u64()) * (last as u128 + 1)) >> 64;
            order.swap(last, other as usize);
        }
        order
    }
}

/// Returns the place of value `at` of `count` from 0 to 1, both ends included.
fn part(at: u64, count: u64) -> f64 {
    if count > 1 { at as f64 / (count - 1) as f64 } else { 0.0 }
}

/// Returns a number of a scenario: whole numbers without a point, which also fit where steps are
/// counted.
fn number(x: f64) -> Value {
    const EXACT: f64 = 9_007_199_254_740_992.0;
    if x == x.trunc() && x.abs() <= EXACT {
        Value::from(x as i64)
    } else {
        Number::from_f64(x).map_or(Value::Null, Value::Number)
    }
}

/// Returns the number below which a standard normal one lies with probability `p`, from 1e-10 to 1 - 1e-10, to 1e-15 relative
/// (Wichura 1988, algorithm AS 241 without its tails), by `libm`, so that its bits do not depend on the machine.
fn normal_quantile(p: f64) -> f64 {
    type Ratio = [[f64; 8]; 2];
    const CENTRE: Ratio = [
        [
            3.387_132_872_796_366_5,
            133.141_667_891_784_38,
            1_971.590_950_306_551_3,
            13_731.693_765_509_46,
            45_921.953_931_549_87,
            67_265.770_927_008_7,
            33_430.575_583_588_13,
            2_509.080_928_730_122_7,
        ],
        [
            1.0,
            42.313_330_701_600_91,
            687.187_007_492_057_9,
            5_394.196_021_424_751,
            21_213.794_301_586_597,
            39_307.895_800_092_71,
            28_729.085_735_721_943,
            5_226.495_278_852_854,
        ],
    ];
    const SIDES: Ratio = [
        [
            1.423_437_110_749_683_5,
            4.630_337_846_156_546,
            5.769_497_221_460_691,
            3.647_848_324_763_204_5,
            1.270_458_252_452_368_4,
            0.241_780_725_177_450_6,
            0.022_723_844_989_269_184,
            0.000_774_545_014_278_341_4,
        ],
        [
            1.0,
            2.053_191_626_637_759,
            1.676_384_830_183_803_8,
            0.689_767_334_985_1,
            0.148_103_976_427_480_08,
            0.015_198_666_563_616_457,
            0.000_547_593_808_499_534_5,
            1.050_750_071_644_416_9e-9,
        ],
    ];
    let ratio = |[above, below]: Ratio, r: f64| {
        let sum = |of: [f64; 8]| of.iter().rev().fold(0.0, |sum, x| sum * r + x);
        sum(above) / sum(below)
    };
    let q = p - 0.5;
    if q.abs() <= 0.425 {
        return q * ratio(CENTRE, 0.180_625 - q * q);
    }
    let r = (-libm::log(p.min(1.0 - p))).sqrt();
    ratio(SIDES, r - 1.6).copysign(q)
}

#[cfg(test)]
mod tests {
    use super::normal_quantile;

    /// scipy.stats.norm.ppf, scipy 1.17.1
    #[test]
    fn quantiles_of_a_normal_number_are_those_of_a_table() {
        for (p, expected) in QUANTILES {
            for (p, expected) in [(p, expected), (1.0 - p, -expected)] {
                let found = normal_quantile(p);
                let rounding = 1e-16 / p.min(1.0 - p);
                let error = (found - expected).abs();
                assert!(error <= 2e-15 * expected.abs() + rounding, "{p}: {found} for {expected}");
            }
        }
        assert_eq!(normal_quantile(0.5), 0.0);
    }

    const QUANTILES: [(f64, f64); 6] = [
        (0.49, -0.02506890825871106),
        (0.3, -0.5244005127080409),
        (0.0751, -1.4388253927525403),
        (0.07, -1.4757910281791706),
        (0.001, -3.090232306167813),
        (1e-08, -5.612001244174789),
    ];
}
