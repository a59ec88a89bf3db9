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
    /// The parts of a Latin hypercube in their random order.
    order: Vec<u32>,
}

impl Axis {
    /// Returns the values of a field; `weights` are those of [`super::file::Correlation::weights`].
    pub(super) fn new(values: &Values, seed: u64, field: usize, weights: Vec<(u64, f64)>) -> Self {
        let (values, field) = (values.clone(), field as u64);
        let mut axis = Self { values, seed, field, weights, order: Vec::new() };
        if let Values::LatinHypercube(span) = axis.values {
            axis.order = axis.shuffled(span.count as u32);
        }
        axis
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
        (self.random(at).next_u64() >> 11) as f64 * SPACING
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
