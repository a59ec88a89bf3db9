//! One number at a time, and the stages one after the other.

use std::ops::{Add, Div, Mul, Neg, Sub};

use fearless_simd::{Simd, f64x8};

use super::{LawOfLanes, Real, Row, StageScalar, StepScalar, Stored, WIDTH};

impl Real for f64 {
    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        value
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        f64::abs(self)
    }

    #[inline(always)]
    fn max_or_nan(self, other: Self) -> Self {
        if other <= self { self } else { other }
    }

    #[inline(always)]
    fn select(self, measure: Self, limit: f64, other: Self) -> Self {
        if measure <= limit { self } else { other }
    }
}

impl Stored for f64 {
    const LANES: usize = 1;
    type Wide = Rows<f64, 4>;
    const GROUP: usize = 4;

    #[inline(always)]
    fn get(self, from: &[f64]) -> Self {
        from[0]
    }

    #[inline(always)]
    fn put(self, to: &mut [f64]) {
        to[0] = self;
    }

    #[inline(always)]
    fn get_wide(self, from: &[f64]) -> Self::Wide {
        let from = &from[..4];
        Rows([from[0], from[1], from[2], from[3]])
    }

    #[inline(always)]
    fn put_wide(wide: Self::Wide, to: &mut [f64]) {
        to[..4].copy_from_slice(&wide.0);
    }

    #[inline(always)]
    fn repeated(self, from: &[f64]) -> Self::Wide {
        Rows([from[0]; 4])
    }

    #[inline(always)]
    fn folded(wide: Self::Wide) -> Self {
        let Rows([a, b, c, d]) = wide;
        (a + c) + (b + d)
    }
}

impl StepScalar for f64 {
    type Storage = f64;

    #[inline(always)]
    fn load(self, plain: &f64) -> Self {
        *plain
    }

    #[inline(always)]
    fn store(self, plain: &mut f64) {
        *plain = self;
    }

    const LANES: usize = 1;

    #[inline(always)]
    fn lane(self, _lane: usize) -> f64 {
        self
    }

    #[inline(always)]
    fn of_lanes(self, lanes: &Row) -> Self {
        lanes[0]
    }
}

/// The stages of a step one after the other, each of which is a number, or members of an ensemble side by side.
#[derive(Clone, Copy, Debug)]
pub struct Rows<T, const K: usize>(pub [T; K]);

/// Elementwise, in place: no closure, which would not be compiled for the instruction set of its caller.
macro_rules! elementwise {
    ($self:ident, $k:ident => $element:expr) => {
        elementwise!($self, K = K, $k => $element)
    };
    ($self:ident, K = $stages:expr, $k:ident => $element:expr) => {{
        let mut result = $self.0;
        for $k in 0..$stages {
            result[$k] = $element;
        }
        Self(result)
    }};
}

macro_rules! rows_operator {
    ($operator:ident, $function:ident, $symbol:tt) => {
        impl<T: StepScalar, const K: usize> $operator for Rows<T, K> {
            type Output = Self;

            #[inline(always)]
            fn $function(self, other: Self) -> Self {
                elementwise!(self, k => self.0[k] $symbol other.0[k])
            }
        }
    };
}

rows_operator!(Add, add, +);
rows_operator!(Sub, sub, -);
rows_operator!(Mul, mul, *);
rows_operator!(Div, div, /);

impl<T: StepScalar, const K: usize> Add<f64> for Rows<T, K> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: f64) -> Self {
        elementwise!(self, k => self.0[k] + other)
    }
}

impl<T: StepScalar, const K: usize> Mul<f64> for Rows<T, K> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: f64) -> Self {
        elementwise!(self, k => self.0[k] * other)
    }
}

impl<T: StepScalar, const K: usize> Neg for Rows<T, K> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        elementwise!(self, k => -self.0[k])
    }
}

impl<T: StepScalar, const K: usize> Real for Rows<T, K> {
    #[inline(always)]
    fn constant(self, value: f64) -> Self {
        elementwise!(self, k => self.0[k].constant(value))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        elementwise!(self, k => self.0[k].sqrt())
    }

    #[inline(always)]
    fn abs(self) -> Self {
        elementwise!(self, k => self.0[k].abs())
    }

    #[inline(always)]
    fn max_or_nan(self, other: Self) -> Self {
        elementwise!(self, k => self.0[k].max_or_nan(other.0[k]))
    }

    #[inline(always)]
    fn select(self, measure: Self, limit: f64, other: Self) -> Self {
        elementwise!(self, k => self.0[k].select(measure.0[k], limit, other.0[k]))
    }
}

/// Rows of `$stages` stages: `$whole` is the quantity of the step as a whole, `$plain` the stages
/// as they lie in memory.
macro_rules! stages_in_turn {
    ($stages:tt, $whole:ty, $plain:ty, $group:tt $(, $simd:ident)?) => {
        impl$(<$simd: Simd>)? Stored for Rows<$whole, $stages> {
            const LANES: usize = $stages * <$whole as Stored>::LANES;
            type Wide = Rows<$whole, { $stages * $group }>;
            const GROUP: usize = $group;

            #[inline(always)]
            fn get(self, from: &[f64]) -> Self {
                let from = &from[..Self::LANES];
                elementwise!(self, K = $stages, k => self.0[0].get(&from[k * <$whole as Stored>::LANES..]))
            }

            #[inline(always)]
            fn put(self, to: &mut [f64]) {
                let to = &mut to[..Self::LANES];
                for k in 0..$stages {
                    self.0[k].put(&mut to[k * <$whole as Stored>::LANES..]);
                }
            }

            #[inline(always)]
            fn get_wide(self, from: &[f64]) -> Self::Wide {
                let from = &from[..$group * Self::LANES];
                let mut wide = [self.0[0]; $stages * $group];
                for k in 0..$stages * $group {
                    wide[k] = self.0[0].get(&from[k * <$whole as Stored>::LANES..]);
                }
                Rows(wide)
            }

            #[inline(always)]
            fn put_wide(wide: Self::Wide, to: &mut [f64]) {
                let to = &mut to[..$group * Self::LANES];
                for k in 0..$stages * $group {
                    wide.0[k].put(&mut to[k * <$whole as Stored>::LANES..]);
                }
            }

            #[inline(always)]
            fn repeated(self, from: &[f64]) -> Self::Wide {
                let one = self.get(from);
                let mut wide = [self.0[0]; $stages * $group];
                for group in wide.chunks_exact_mut($stages) {
                    group.copy_from_slice(&one.0);
                }
                Rows(wide)
            }

            #[inline(always)]
            fn folded(wide: Self::Wide) -> Self {
                let (mut sums, mut count) = (wide.0, $group);
                while count > 1 {
                    count /= 2;
                    for k in 0..$stages * count {
                        let sum = sums[k] + sums[k + $stages * count];
                        sums[k] = sum;
                    }
                }
                let mut whole = [sums[0]; $stages];
                whole.copy_from_slice(&sums[..$stages]);
                Self(whole)
            }
        }

        impl$(<$simd: Simd>)? StageScalar for Rows<$whole, $stages> {
            type StepScalar = $whole;
            type Storage = $plain;
            const STAGES: usize = $stages;

            #[inline(always)]
            fn load(self, plain: &Self::Storage) -> Self {
                elementwise!(self, K = $stages, k => StepScalar::load(self.0[0], &plain[k]))
            }

            #[inline(always)]
            fn store(self, plain: &mut Self::Storage) {
                for k in 0..$stages {
                    StepScalar::store(self.0[k], &mut plain[k]);
                }
            }

            #[inline(always)]
            fn row(self, row: &Row) -> Self {
                elementwise!(self, K = $stages, k => self.0[0].constant(row[k]))
            }

            #[inline(always)]
            fn spread(self, whole: $whole) -> Self {
                Self([whole; $stages])
            }

            #[inline(always)]
            fn stage(self, k: usize) -> $whole {
                self.0[k]
            }

            #[inline(always)]
            fn sum(self) -> $whole {
                macro_rules! term {
                    ($j:literal) => {
                        self.0[$j]
                    };
                }
                by_halves!($stages, term)
            }

            #[inline(always)]
            fn apply_tableau(self, columns: &[Row; WIDTH]) -> Self {
                let mut rows = self.0;
                for k in 0..$stages {
                    macro_rules! term {
                        ($j:literal) => {
                            self.0[$j] * columns[$j][k]
                        };
                    }
                    rows[k] = by_halves!($stages, term);
                }
                Self(rows)
            }

            #[inline(always)]
            fn rows(self, rows: &[Row; WIDTH]) -> [Self; WIDTH] {
                let mut lanes = [self; WIDTH];
                for k in 0..WIDTH {
                    lanes[k] = self.row(&rows[k]);
                }
                lanes
            }

            #[inline(always)]
            fn combination(x: &[f64], columns: &[Self; WIDTH]) -> Self {
                let x = columns[0].get(x);
                let mut rows = x.0;
                for k in 0..$stages {
                    macro_rules! term {
                        ($j:literal) => {
                            x.0[$j] * columns[$j].0[k]
                        };
                    }
                    rows[k] = by_halves!($stages, term);
                }
                Self(rows)
            }

            #[inline(always)]
            fn vectorized<T>(self, work: impl FnOnce() -> T) -> T {
                work()
            }

            #[inline(always)]
            fn largest(self) -> $whole {
                let mut largest = self.0[0];
                for other in &self.0[1..] {
                    largest = Real::max_or_nan(largest, *other);
                }
                largest
            }

            #[inline(always)]
            fn out_of_lanes(
                numbers: [[Self; 3]; 3],
                law: LawOfLanes<'_>,
            ) -> [Self; 4] {
                let lanes = <$whole as StepScalar>::LANES;
                let at = |k: usize, lane: usize| {
                    numbers.map(|row| row.map(|x| x.0[k].lane(lane)))
                };
                let given: Vec<_> =
                    (0..$stages * lanes).map(|i| at(i / lanes, i % lanes)).collect();
                let mut found = vec![[0.0; 4]; given.len()];
                law(&given, &mut found);
                let mut made = [numbers[0][0]; 4];
                for (k, found) in found.chunks_exact(lanes).enumerate() {
                    let mut rows = [Row::splat(0.0); 4];
                    for (lane, found) in found.iter().enumerate() {
                        for (row, &x) in rows.iter_mut().zip(found) {
                            row[lane] = x;
                        }
                    }
                    for (stages, row) in made.iter_mut().zip(&rows) {
                        stages.0[k] = stages.0[k].of_lanes(row);
                    }
                }
                made
            }
        }
    };
}

stages_in_turn!(1, f64x8<S>, [Row; 1], 1, S);
stages_in_turn!(2, f64x8<S>, [Row; 2], 1, S);
stages_in_turn!(3, f64x8<S>, [Row; 3], 1, S);
stages_in_turn!(4, f64x8<S>, [Row; 4], 1, S);
// One number at a time.
stages_in_turn!(1, f64, Row, 1);
stages_in_turn!(2, f64, Row, 4);
stages_in_turn!(3, f64, Row, 1);
stages_in_turn!(4, f64, Row, 2);
stages_in_turn!(8, f64, Row, 1);
