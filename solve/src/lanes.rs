//! Numbers in lanes: one formula for one number, for the stages of a step side by side, and for the members of
//! an ensemble side by side.
//!
//! A lane holds the same bits whatever runs next to it and whatever instruction set runs it: there are only
//! additions, multiplications, divisions and square roots, each rounded by itself, in an order that is written
//! down here.
//!
//! Everything is inlined into its caller, so that it is compiled for the instruction set of the caller.

use std::ops::{Add, Div, Index, IndexMut, Mul, Neg, Sub};

use fearless_simd::{Simd, f64x2, f64x4, f64x8, prelude::*};

/// The most lanes that there are.
pub const WIDTH: usize = 8;

/// The numbers of up to [`WIDTH`] lanes, as they lie in memory.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Row(pub [f64; WIDTH]);

impl Row {
    /// Returns the row with the same number in all lanes.
    pub const fn splat(value: f64) -> Self {
        Self([value; WIDTH])
    }
}

/// A 64-byte aligned zero on the stack: forces the alignment of the frame, so that spilled vectors do not cross cache
/// lines (10 % otherwise).
#[inline(always)]
pub fn aligned_zero() -> Row {
    std::hint::black_box(Row::splat(0.0))
}

impl Index<usize> for Row {
    type Output = f64;

    #[inline(always)]
    fn index(&self, k: usize) -> &f64 {
        &self.0[k]
    }
}

impl IndexMut<usize> for Row {
    #[inline(always)]
    fn index_mut(&mut self, k: usize) -> &mut f64 {
        &mut self.0[k]
    }
}

/// Does the work in lanes of a wide instruction set, compiled for it, if there is one; else the other.
// Not for every instruction set: a piece of work is compiled once for each. The additional
// registers of AVX-512 make few lanes of n = 3 faster by a tenth, and four lanes of n = 16; two
// lanes of matrices gain nothing.
macro_rules! widest {
    (@on $token:ident, $vector:ident, $lanes:ident => $work:expr) => {{
        $token.vectorize(
            #[inline(always)]
            || {
                let $lanes = $vector::splat($token, 0.0);
                $work
            },
        )
    }};
    ($level:expr, $vector:ident, $lanes:ident => $work:expr, else $other:expr) => {
        match $level {
            #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
            fearless_simd::Level::Avx512(token) => widest!(@on token, $vector, $lanes => $work),
            #[allow(unreachable_patterns)]
            level => widest!(level below Avx512, $vector, $lanes => $work, else $other),
        }
    };
    ($level:ident below Avx512, $vector:ident, $lanes:ident => $work:expr, else $other:expr) => {{
        #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
        let token = fearless_simd::Level::as_avx2($level);
        #[cfg(target_arch = "aarch64")]
        let token = fearless_simd::Level::as_neon($level);
        #[cfg(not(any(target_arch = "x86", target_arch = "x86_64", target_arch = "aarch64")))]
        let token = Some($level).and(None::<fearless_simd::Fallback>);
        match token {
            Some(token) => widest!(@on token, $vector, $lanes => $work),
            None => $other,
        }
    }};
}

/// Does the work on the stages of a step in as many lanes as they need, compiled for the widest instruction set; or
/// one number at a time. The last type parameter of the work says whether it calls user-defined potentials. That call
/// keeps no register, which would cost bodies without such potentials a tenth of their time: they have work without
/// it. With it, lanes are compiled for many stages only, where they save a third.
macro_rules! in_stage_lanes {
    ($level:expr, $stages:expr, $body:expr, $module:ident::$work:ident, $($argument:expr),*) => {{
        let in_lanes = match ($level, $stages, $body.has_user_potential()) {
            (Some(level), 2, false) => widest!(
                level, f64x2, lanes => Some($module::$work::<_, false>(lanes, $($argument),*)), else None
            ),
            (Some(level), 3 | 4, false) => widest!(
                level, f64x4, lanes => Some($module::$work::<_, false>(lanes, $($argument),*)), else None
            ),
            (Some(level), 5.., false) => widest!(
                level, f64x8, lanes => Some($module::$work::<_, false>(lanes, $($argument),*)), else None
            ),
            (Some(level), 5.., true) => widest!(
                level below Avx512, f64x8,
                lanes => Some($module::$work::<_, true>(lanes, $($argument),*)), else None
            ),
            _ => None,
        };
        // Each call is written once: compiling it takes long.
        match (in_lanes, $stages) {
            (Some(done), _) => done,
            (None, 1) => $module::$work::<_, true>(Rows([0.0; 1]), $($argument),*),
            (None, 2) => $module::$work::<_, true>(Rows([0.0; 2]), $($argument),*),
            (None, 3 | 4) => $module::$work::<_, true>(Rows([0.0; 4]), $($argument),*),
            (None, _) => $module::$work::<_, true>(Rows([0.0; 8]), $($argument),*),
        }
    }};
}

/// Methods of a type with a method `lanes` whose bodies are compiled for the instruction set of these lanes, each once.
macro_rules! in_lanes {
    ($($(#[$attribute:meta])* fn $name:ident(&mut $this:ident $(, $argument:ident: $type:ty)*) $(-> $result:ty)? $body:block)*) => {
        $($(#[$attribute])*
        #[inline(never)]
        fn $name(&mut $this $(, $argument: $type)*) $(-> $result)? {
            $this.lanes().vectorized(
                #[inline(always)]
                || $body,
            )
        })*
    };
}

pub(crate) use {in_lanes, in_stage_lanes, widest};

/// A number, or one in each lane.
pub trait Real:
    Copy
    + Neg<Output = Self>
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Add<f64, Output = Self>
    + Mul<f64, Output = Self>
{
    /// A constant, in as many lanes as `self` has.
    fn constant(self, value: f64) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// The absolute value.
    fn abs(self) -> Self;
    /// The larger of two numbers if neither is NaN.
    fn max_or_nan(self, other: Self) -> Self;
    /// `self` where `measure` is a number up to `limit`, elsewhere `other`.
    fn select(self, measure: Self, limit: f64, other: Self) -> Self;
}

/// Quantity of a step as a whole: one number, or one for each member of an ensemble.
pub trait StepScalar: Real {
    /// Layout in memory.
    type Storage: Copy;
    /// Loads from memory, like `self`.
    fn load(self, plain: &Self::Storage) -> Self;
    /// Stores to memory.
    fn store(self, plain: &mut Self::Storage);
    /// Number of lanes: one for a single number, else as many as there are members.
    const LANES: usize;
    /// The number in a lane.
    fn lane(self, lane: usize) -> f64;
    /// Builds the value from the numbers of the lanes.
    fn of_lanes(self, lanes: &Row) -> Self;
}

/// A number, or one in each lane, that lies in memory lane by lane.
pub trait Stored: Real {
    /// Lanes.
    const LANES: usize;
    /// Group of them side by side, as many as a register holds.
    type Wide: Real;
    /// Number of them in a group.
    const GROUP: usize;
    /// Reads from the beginning of a slice, like `self`.
    fn get(self, from: &[f64]) -> Self;
    /// Writes to the beginning of a slice.
    fn put(self, to: &mut [f64]);
    /// Reads a group from the beginning of a slice.
    fn get_wide(self, from: &[f64]) -> Self::Wide;
    /// Writes a group to the beginning of a slice.
    fn put_wide(wide: Self::Wide, to: &mut [f64]);
    /// Reads one from the beginning of a slice and repeats it to fill a group.
    fn repeated(self, from: &[f64]) -> Self::Wide;
    /// The sum over a group, by halves.
    fn folded(wide: Self::Wide) -> Self;
}

/// Quantity of the stages of a step: a number for each.
pub trait StageScalar: Stored {
    /// Quantity of the step as a whole.
    type StepScalar: StepScalar + Stored;
    /// Layout in memory.
    type Storage: Copy;
    /// Largest number of stages.
    const STAGES: usize;
    /// Loads from memory, like `self`.
    fn load(self, plain: &Self::Storage) -> Self;
    /// Stores to memory.
    fn store(self, plain: &mut Self::Storage);
    /// Constants, one for each stage.
    fn row(self, row: &Row) -> Self;
    /// Returns the same number for all stages.
    fn spread(self, whole: Self::StepScalar) -> Self;
    /// The number of stage `k`.
    fn stage(self, k: usize) -> Self::StepScalar;
    /// The sum over the stages, by halves.
    fn sum(self) -> Self::StepScalar;
    /// `sum_j columns[j] self_j`, summed by halves.
    fn apply_tableau(self, columns: &[Row; WIDTH]) -> Self;
    /// Rows of constants.
    fn rows(self, rows: &[Row; WIDTH]) -> [Self; WIDTH];
    /// `sum_j columns[j] x_j`, summed by halves, x at the beginning of a slice.
    fn combination(x: &[f64], columns: &[Self; WIDTH]) -> Self;
    /// Does some work, compiled for the instruction set.
    fn vectorized<T>(self, work: impl FnOnce() -> T) -> T;
    /// The largest over the stages.
    fn largest(self) -> Self::StepScalar;
    /// Applies a law that is not written in lanes to three rows of three numbers, lane by lane.
    fn lane_by_lane(
        numbers: [[Self; 3]; 3],
        law: &mut dyn FnMut([[f64; 3]; 3]) -> [f64; 4],
    ) -> [Self; 4];
}

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

/// The sum of the given number of terms by halves: the order of the additions does not depend on the lanes, and they do not
/// wait for one another.
macro_rules! by_halves {
    (1, $term:ident) => {
        $term!(0)
    };
    (2, $term:ident) => {
        $term!(0) + $term!(1)
    };
    (3, $term:ident) => {
        ($term!(0) + $term!(1)) + $term!(2)
    };
    (4, $term:ident) => {
        ($term!(0) + $term!(1)) + ($term!(2) + $term!(3))
    };
    (8, $term:ident) => {
        (($term!(0) + $term!(1)) + ($term!(2) + $term!(3)))
            + (($term!(4) + $term!(5)) + ($term!(6) + $term!(7)))
    };
}

macro_rules! stage_lanes {
    ($vector:ident, $lanes:tt, $group:literal, $repeated:expr, $folded:expr, $each:expr) => {
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
                let mut largest = self[0];
                for k in 1..$lanes {
                    largest = Real::max_or_nan(largest, self[k]);
                }
                largest
            }

            #[inline(always)]
            fn lane_by_lane(
                numbers: [[Self; 3]; 3],
                law: &mut dyn FnMut([[f64; 3]; 3]) -> [f64; 4],
            ) -> [Self; 4] {
                let mut made = [Row::splat(0.0); 4];
                for lane in 0..$lanes {
                    let found = law(numbers.map(|row| row.map(|x| x[lane])));
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
    |x: Self| [x.zip_low(x), x.zip_high(x)]
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
    }
);

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
            fn lane_by_lane(
                numbers: [[Self; 3]; 3],
                law: &mut dyn FnMut([[f64; 3]; 3]) -> [f64; 4],
            ) -> [Self; 4] {
                let mut made = [numbers[0][0]; 4];
                for k in 0..$stages {
                    let mut lanes = [Row::splat(0.0); 4];
                    for lane in 0..<$whole as StepScalar>::LANES {
                        let found = law(numbers.map(|row| row.map(|x| x.0[k].lane(lane))));
                        for (row, x) in lanes.iter_mut().zip(found) {
                            row[lane] = x;
                        }
                    }
                    for (stages, lanes) in made.iter_mut().zip(&lanes) {
                        stages.0[k] = stages.0[k].of_lanes(lanes);
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
