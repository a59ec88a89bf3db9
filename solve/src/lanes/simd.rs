//! Lanes of SIMD instructions.

use fearless_simd::{Simd, f64x2, f64x4, f64x8, prelude::*};

use super::{LawOfLanes, Real, Row, StageScalar, StepScalar, Stored, WIDTH};

macro_rules! stage_lanes {
    ($vector:ident, $lanes:tt, $group:literal, $repeated:expr, $folded:expr, $each:expr, $largest:expr) => {
        impl<S: Simd> Stored for $vector<S> {
            const LANES: usize = $lanes;
            type Wide = f64x8<S>;
            const GROUP: usize = $group;

            #[inline(always)]
            fn get(self, from: &[f64]) -> Self {
                Self::from_slice(self.simd, &from[..$lanes])
            }

            #[inline(always)]
            fn put(self, to: &mut [f64]) {
                self.store_slice(&mut to[..$lanes]);
            }

            #[inline(always)]
            fn get_wide(self, from: &[f64]) -> f64x8<S> {
                f64x8::from_slice(self.simd, &from[..8])
            }

            #[inline(always)]
            fn put_wide(wide: f64x8<S>, to: &mut [f64]) {
                wide.store_slice(&mut to[..8]);
            }

            #[inline(always)]
            fn repeated(self, from: &[f64]) -> f64x8<S> {
                $repeated(self.get(from))
            }

            #[inline(always)]
            fn folded(wide: f64x8<S>) -> Self {
                $folded(wide)
            }
        }

        impl<S: Simd> Real for $vector<S> {
            #[inline(always)]
            fn constant(self, value: f64) -> Self {
                Self::splat(self.simd, value)
            }

            #[inline(always)]
            fn sqrt(self) -> Self {
                <Self as fearless_simd::SimdFloat<S>>::sqrt(self)
            }

            #[inline(always)]
            fn abs(self) -> Self {
                <Self as fearless_simd::SimdBase<S>>::abs(self)
            }

            #[inline(always)]
            fn max_or_nan(self, other: Self) -> Self {
                other.simd_le(self).select(self, other)
            }

            #[inline(always)]
            fn select(self, measure: Self, limit: f64, other: Self) -> Self {
                measure.simd_le(self.constant(limit)).select(self, other)
            }
        }

        impl<S: Simd> StageScalar for $vector<S> {
            type StepScalar = f64;
            type Storage = Row;
            const STAGES: usize = $lanes;

            #[inline(always)]
            fn load(self, plain: &Row) -> Self {
                Self::from_slice(self.simd, &plain.0[..$lanes])
            }

            #[inline(always)]
            fn store(self, plain: &mut Row) {
                self.store_slice(&mut plain.0[..$lanes]);
            }

            #[inline(always)]
            fn row(self, row: &Row) -> Self {
                Self::from_slice(self.simd, &row.0[..$lanes])
            }

            #[inline(always)]
            fn spread(self, whole: f64) -> Self {
                Self::splat(self.simd, whole)
            }

            #[inline(always)]
            fn stage(self, k: usize) -> f64 {
                self[k]
            }

            #[inline(always)]
            fn sum(self) -> f64 {
                macro_rules! term {
                    ($j:literal) => {
                        self[$j]
                    };
                }
                by_halves!($lanes, term)
            }

            #[inline(always)]
            fn apply_tableau(self, columns: &[Row; WIDTH]) -> Self {
                let each: [Self; $lanes] = $each(self);
                macro_rules! term {
                    ($j:literal) => {
                        self.row(&columns[$j]) * each[$j]
                    };
                }
                by_halves!($lanes, term)
            }

            #[inline(always)]
            fn apply_tableau_to<const K: usize>(x: [Self; K], columns: &[Row; WIDTH]) -> [Self; K] {
                let mut sums = x;
                if $lanes < WIDTH {
                    for i in 0..K {
                        sums[i] = x[i].apply_tableau(columns);
                    }
                    return sums;
                }
                // All through memory at once, so that the columns are loaded once.
                let mut values = [Row::splat(0.0); K];
                for i in 0..K {
                    x[i].store_slice(&mut values[i].0[..$lanes]);
                }
                let values = std::hint::black_box(&values);
                let columns = x[0].rows(columns);
                for i in 0..K {
                    macro_rules! term {
                        ($j:literal) => {
                            columns[$j] * Self::splat(x[0].simd, values[i].0[$j])
                        };
                    }
                    sums[i] = by_halves!($lanes, term);
                }
                sums
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
                let x = &x[..$lanes];
                macro_rules! term {
                    ($j:literal) => {
                        columns[$j] * Self::splat(columns[0].simd, x[$j])
                    };
                }
                by_halves!($lanes, term)
            }

            #[inline(always)]
            fn vectorized<T>(self, work: impl FnOnce() -> T) -> T {
                self.simd.vectorize(work)
            }

            #[inline(always)]
            fn largest(self) -> f64 {
                let [a, b] = $largest(self);
                Real::max_or_nan(a, b)
            }

            #[inline(always)]
            fn out_of_lanes(numbers: [[Self; 3]; 3], law: LawOfLanes<'_>) -> [Self; 4] {
                let given: [_; $lanes] =
                    std::array::from_fn(|lane| numbers.map(|row| row.map(|x| x[lane])));
                let mut found = [[0.0; 4]; $lanes];
                law(&given, &mut found);
                let mut made = [Row::splat(0.0); 4];
                for (lane, found) in found.into_iter().enumerate() {
                    for (row, x) in made.iter_mut().zip(found) {
                        row[lane] = x;
                    }
                }
                made.map(|row| numbers[0][0].row(&row))
            }
        }
    };
}

stage_lanes!(
    f64x2,
    2,
    4,
    |x: Self| {
        let four = x.combine(x);
        four.combine(four)
    },
    |x: f64x8<S>| {
        let (low, high) = x.split();
        let (low, high) = (low + high).split();
        low + high
    },
    // With few lanes latency dominates, and a store and reload takes longer.
    |x: Self| [x.zip_low(x), x.zip_high(x)],
    |x: Self| [x[0], x[1]]
);
stage_lanes!(
    f64x4,
    4,
    2,
    |x: Self| x.combine(x),
    |x: f64x8<S>| {
        let (low, high) = x.split();
        low + high
    },
    |x: Self| {
        let (low, high) = x.split();
        let both = |half: f64x2<S>| half.combine(half);
        [
            both(low.zip_low(low)),
            both(low.zip_high(low)),
            both(high.zip_low(high)),
            both(high.zip_high(high)),
        ]
    },
    |x: Self| {
        let (low, high) = x.split();
        let two = Real::max_or_nan(low, high);
        [two[0], two[1]]
    }
);
stage_lanes!(
    f64x8,
    8,
    1,
    |x: Self| x,
    |x: Self| x,
    // Extracting eight numbers would use the shuffle port that half the arithmetic needs; broadcasts from memory are
    // free. (A row: see `aligned_zero`.)
    |x: Self| {
        let mut values = Row::splat(0.0);
        // To a slice: stored to the array itself it is compiled to a step longer by 6 %.
        x.store_slice(&mut values.0[..8]);
        let values = std::hint::black_box(&values);
        let mut each = [x; 8];
        for k in 0..8 {
            each[k] = Self::splat(x.simd, values[k]);
        }
        each
    },
    |x: Self| {
        let (low, high) = x.split();
        let (low, high) = Real::max_or_nan(low, high).split();
        let two = Real::max_or_nan(low, high);
        [two[0], two[1]]
    }
);

impl<S: Simd> StepScalar for f64x8<S> {
    type Storage = Row;

    #[inline(always)]
    fn load(self, plain: &Row) -> Self {
        Self::from_slice(self.simd, &plain.0)
    }

    #[inline(always)]
    fn store(self, plain: &mut Row) {
        self.store_slice(&mut plain.0);
    }

    const LANES: usize = WIDTH;

    #[inline(always)]
    fn lane(self, lane: usize) -> f64 {
        self[lane]
    }

    #[inline(always)]
    fn of_lanes(self, lanes: &Row) -> Self {
        StepScalar::load(self, lanes)
    }
}
