//! Compensated sums: a sum, and the part of it lost to rounding, which the next change takes along.
//!
//! Where each step adds what is small relative to the sum, rounding then makes a random walk and no drift (Brouwer's law; Hairer,
//! McLachlan, Razakarivony 2008, BIT 48).

use super::lanes::{Real, Row, StepScalar};
use super::so::Mat;

/// Returns `a + b`, and the part of it lost to rounding (Knuth's two-sum).
#[inline(always)]
pub fn two_sum<T: Real>(a: T, b: T) -> (T, T) {
    let sum = a + b;
    let part = sum - a;
    (sum, (a - (sum - part)) + (b - part))
}

/// A sum of numbers, vectors or matrices, and the part of it lost to rounding.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Sum<V> {
    pub(crate) value: V,
    pub(crate) carry: V,
}

impl<V> Sum<V> {
    /// Begins with `value`, of which nothing is lost yet: `zero` of the same kind.
    pub(crate) fn new(value: V, zero: V) -> Self {
        Self { value, carry: zero }
    }
}

impl Sum<f64> {
    /// Adds `change` and the carried part.
    #[inline(always)]
    pub(crate) fn add(&mut self, change: f64) {
        (self.value, self.carry) = two_sum(self.value, change + self.carry);
    }
}

impl<const N: usize> Sum<Mat<N>> {
    /// Adds `change` and the carried part.
    #[inline(always)]
    pub(crate) fn add(&mut self, change: &Mat<N>) {
        for i in 0..N * N {
            let (sum, left) = two_sum(self.value[i], change[i] + self.carry[i]);
            (self.value[i], self.carry[i]) = (sum, left);
        }
    }
}

/// `P` is a number in memory, or one for each member.
impl<P: Copy, const K: usize> Sum<[P; K]> {
    /// Adds `change` and the carried part.
    #[inline(always)]
    pub(crate) fn add<W: StepScalar<Storage = P>>(&mut self, change: &[W; K]) {
        for i in 0..K {
            let value = change[i].load(&self.value[i]);
            let change = change[i] + change[i].load(&self.carry[i]);
            let (value, carry) = two_sum(value, change);
            value.store(&mut self.value[i]);
            carry.store(&mut self.carry[i]);
        }
    }
}

impl<const K: usize> Sum<[Row; K]> {
    /// Stores the sum of a member in its lane.
    pub(crate) fn take(&mut self, lane: usize, member: &Sum<[f64; K]>) {
        for i in 0..K {
            self.value[i][lane] = member.value[i];
            self.carry[i][lane] = member.carry[i];
        }
    }

    /// The sum of a member.
    pub(crate) fn member(&self, lane: usize) -> Sum<[f64; K]> {
        Sum {
            value: self.value.each_ref().map(|row| row[lane]),
            carry: self.carry.each_ref().map(|row| row[lane]),
        }
    }
}
