//! Numbers in lanes: one formula for one number, for the stages of a step side by side, and for the members of
//! an ensemble side by side.
//!
//! A lane holds the same bits whatever runs next to it and whatever instruction set runs it: there are only
//! additions, multiplications, divisions and square roots, each rounded by itself, in an order that is written
//! down here.
//!
//! | trait | a number | stages side by side | stages one after the other |
//! |---|---|---|---|
//! | [`Real`] | `f64` | `f64x2`, `f64x4`, `f64x8` | `Rows<T, K>` |
//! | [`StepScalar`]: of a whole step | `f64` | `f64x8`, a member a lane | |
//! | [`Stored`] | `f64` | `f64x2`, `f64x4`, `f64x8` | `Rows<f64, K>`, `Rows<f64x8, K>` |
//! | [`StageScalar`]: of the stages | | `f64x2`, `f64x4`, `f64x8` | `Rows<f64, K>`, `Rows<f64x8, K>` |
//!
//! Everything is inlined into its caller, so that it is compiled for the instruction set of the caller.

use std::ops::{Add, Div, Index, IndexMut, Mul, Neg, Sub};

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

mod dispatch;
mod serial;
mod simd;

pub(crate) use dispatch::{
    extras, has_member_lanes, in_eight_stage_lanes, in_lanes, in_member_lanes, in_stage_lanes,
    widest,
};
pub use serial::Rows;

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

/// A law of three rows of three numbers for all lanes at once: it sets four numbers for each.
pub type LawOfLanes<'a> = &'a mut dyn FnMut(&[[[f64; 3]; 3]], &mut [[f64; 4]]);

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
    /// [`Self::apply_tableau`] of several numbers.
    #[inline(always)]
    fn apply_tableau_to<const K: usize>(x: [Self; K], columns: &[Row; WIDTH]) -> [Self; K] {
        let mut sums = x;
        for i in 0..K {
            sums[i] = x[i].apply_tableau(columns);
        }
        sums
    }
    /// Rows of constants.
    fn rows(self, rows: &[Row; WIDTH]) -> [Self; WIDTH];
    /// `sum_j columns[j] x_j`, summed by halves, x at the beginning of a slice.
    fn combination(x: &[f64], columns: &[Self; WIDTH]) -> Self;
    /// Does some work, compiled for the instruction set.
    fn vectorized<T>(self, work: impl FnOnce() -> T) -> T;
    /// The largest over the stages.
    fn largest(self) -> Self::StepScalar;
    /// Applies a law that is not written in lanes to three rows of three numbers: it is given those of all lanes, and sets four
    /// numbers for each.
    fn out_of_lanes(numbers: [[Self; 3]; 3], law: LawOfLanes<'_>) -> [Self; 4];
}
