//! State carried from step to step in n dimensions: the attitude, the spatial momentum, and the
//! part of each lost to rounding.
//!
//! A step adds to each what is small relative to it: rounding makes a random walk and no drift (Brouwer's law; Hairer,
//! McLachlan, Razakarivony 2008, BIT 48).
//!
//! Invariant: only forces change the spatial momentum; the attitude is a rotation to round-off.

use fearless_simd::{Level, f64x4, prelude::*};

use crate::compensated::Sum;
use crate::lanes::{Rows, StageScalar, widest};
use crate::so::{self, Mat};
use crate::state::State;
use crate::stepper::motion::ROUNDING_SQUARE;

/// The motion of a body.
#[derive(Clone, Debug)]
pub(crate) struct Motion<const N: usize> {
    attitude: Sum<Mat<N>>,
    /// Spatial momentum.
    momentum: Sum<Mat<N>>,
    /// Body momentum; for a free and for a driven body `g^T pi g` and no sum.
    body_momentum: Sum<Mat<N>>,
}

impl<const N: usize> Motion<N> {
    /// Begins at a state.
    pub(crate) fn new(state: &State<N>) -> Self {
        Self {
            attitude: Sum::new(state.attitude, Mat::zeros()),
            momentum: Sum::new(
                so::skew(&so::conjugate(&state.attitude, &state.momentum)),
                Mat::zeros(),
            ),
            body_momentum: Sum::new(state.momentum, Mat::zeros()),
        }
    }

    /// g.
    pub(crate) fn attitude(&self) -> &Mat<N> {
        &self.attitude.value
    }

    /// The momentum in the body.
    pub(crate) fn body_momentum(&self) -> &Mat<N> {
        &self.body_momentum.value
    }

    /// Advances by a step that turns by `I + turn` and pushes by `impulse`, both in the frame of its beginning, compiled for a
    /// wide instruction set if there is one: the bits are the same. `momentum_increment` is what the body momentum gains.
    pub(crate) fn advance(
        &mut self,
        level: Option<Level>,
        [turn, impulse]: [&Mat<N>; 2],
        momentum_increment: Option<&Mat<N>>,
    ) {
        let changes = [turn, impulse];
        match level {
            Some(level) => {
                widest!(level below Avx512, f64x4, lanes => self.advance_in(lanes, changes, momentum_increment),
                else self.advance_in(Rows([0.0; 4]), changes, momentum_increment))
            }
            None => self.advance_in(Rows([0.0; 4]), changes, momentum_increment),
        }
    }

    #[inline(always)]
    fn advance_in<R: StageScalar>(
        &mut self,
        lanes: R,
        [turn, impulse]: [&Mat<N>; 2],
        momentum_increment: Option<&Mat<N>>,
    ) {
        let g = self.attitude.value;
        let is_pushed = impulse.iter().any(|x| *x != 0.0);
        if is_pushed {
            self.momentum.add(&so::skew(&conjugate(lanes, &g, impulse)));
        }
        // The norm error I - g^T g is corrected before the turn, and rotated along with the carried part: corrected after it,
        // `f^T e f - sym(f^T e)` would be left of an error e, which grows where f turns by more than a sixth of a circle.
        let norm_error = so::norm_error(&g) * 0.5;
        let mended = product(lanes, &g, &norm_error);
        let carried = product(lanes, &(self.attitude.carry + mended), turn);
        self.attitude.add(&(product(lanes, &g, turn) + (carried + mended)));
        let inverse = self.attitude.value.transpose();
        let seen = so::skew(&conjugate(lanes, &inverse, &self.momentum.value));
        match momentum_increment {
            Some(momentum_increment) if is_pushed => {
                self.add_momentum_increment(lanes, momentum_increment, &seen)
            }
            _ => self.body_momentum = Sum::new(seen, Mat::zeros()),
        }
    }

    /// Adds `momentum_increment` to the body momentum, and turns the attitude so that rounding does not separate
    /// it from the spatial momentum as `seen` from the body: `g <- g (I + theta)` with
    /// `theta = [p - seen, seen] / (2 |seen|^2)`, a step downhill of
    /// `|p - seen - [seen, theta]|^2`, and less where the step has added more than there is, or not at all. See
    /// [`crate::stepper::motion::Motion::add_momentum_increment`].
    #[inline(always)]
    fn add_momentum_increment<R: StageScalar>(
        &mut self,
        lanes: R,
        momentum_increment: &Mat<N>,
        seen: &Mat<N>,
    ) {
        self.body_momentum.add(momentum_increment);
        let apart = self.body_momentum.value - seen;
        let square = so::inner(seen, seen) + so::inner(momentum_increment, momentum_increment);
        if so::inner(&apart, &apart) > ROUNDING_SQUARE * square {
            return;
        }
        let scale = 0.5 / square.max(f64::MIN_POSITIVE);
        // of skew matrices: seen apart = (apart seen)^T
        let theta = so::asym(&product(lanes, &apart, seen)) * scale;
        // The turn is tiny: it is added at the next step.
        self.attitude.carry += product(lanes, &self.attitude.value, &theta);
    }
}

/// `A B`
#[inline(never)]
fn product<R: StageScalar, const N: usize>(lanes: R, a: &Mat<N>, b: &Mat<N>) -> Mat<N> {
    lanes.vectorized(
        #[inline(always)]
        || so::product_here(a, b),
    )
}

/// `g X g^T`
fn conjugate<R: StageScalar, const N: usize>(lanes: R, g: &Mat<N>, x: &Mat<N>) -> Mat<N> {
    product(lanes, &product(lanes, g, x), &g.transpose())
}
