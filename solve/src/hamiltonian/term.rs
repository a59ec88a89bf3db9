//! The terms of the potential: each law is written once, in its file, for one attitude in n dimensions and for several
//! attitudes in lanes.
//!
//! A new law is its file, its variant here and its line in each `match`, none of which compiles without it.

use super::super::lanes::Real;
use super::super::so::{Mat, Vector};
use super::super::stack::Dimension;
use super::plane::is_axis;

mod gravity_gradient;
mod point_source;
mod spring;
mod uniform;

/// One term of the potential, `x = g y` being the place of the body point y.
#[derive(Clone, Debug, PartialEq)]
pub struct Term<const N: usize> {
    /// The law and its strength.
    pub law: Law<N>,
    /// The space vector v: direction, source or anchor.
    pub space: Vector<N>,
}

/// How a term depends on `q = g^T v`.
#[derive(Clone, Debug, PartialEq)]
pub enum Law<const N: usize> {
    /// `weight v . (g y) = weight y . q`
    Uniform {
        /// Weight.
        weight: f64,
        /// Body point y.
        body_point: Vector<N>,
    },
    /// `strength / |g y - v| = strength / |y - q|`
    PointSource {
        /// Strength.
        strength: f64,
        /// Body point y.
        body_point: Vector<N>,
    },
    /// `stiffness / 2 (|g y - v| - rest_length)^2`
    Spring {
        /// Stiffness.
        stiffness: f64,
        /// Length at rest.
        rest_length: f64,
        /// Body point y.
        body_point: Vector<N>,
    },
    /// `strength / 2 q . M q`
    GravityGradient {
        /// Strength.
        strength: f64,
        /// The symmetric matrix M.
        matrix: Mat<N>,
    },
}

impl<const N: usize> Law<N> {
    /// U(q).
    pub(super) fn value(&self, q: &Vector<N>) -> f64 {
        self.numbers().value(q)
    }

    /// The same law, so many times as strong.
    pub(super) fn times(&self, factor: f64) -> Self {
        let mut law = self.clone();
        match &mut law {
            Self::Uniform { weight: strength, .. }
            | Self::PointSource { strength, .. }
            | Self::Spring { stiffness: strength, .. }
            | Self::GravityGradient { strength, .. } => *strength *= factor,
        }
        law
    }

    /// `dU/dq . q'`
    pub(super) fn change(&self, q: &Vector<N>, rate: &Vector<N>) -> f64 {
        match self {
            Self::Uniform { weight, body_point } => weight * body_point.dot(rate),
            Self::PointSource { strength, body_point } => {
                let arm = body_point - q;
                let distance = arm.norm();
                strength * arm.dot(rate) / (distance * distance * distance)
            }
            Self::Spring { stiffness, rest_length, body_point } => {
                let arm = q - body_point;
                let bent = if *rest_length > 0.0 { rest_length / arm.norm() } else { 0.0 };
                stiffness * (1.0 - bent) * arm.dot(rate)
            }
            Self::GravityGradient { strength, matrix } => strength * (matrix * q).dot(rate),
        }
    }

    /// The law as its formulas see it.
    pub(crate) fn numbers(&self) -> Numbers<'_> {
        match self {
            Self::Uniform { weight, body_point } => {
                Numbers::Uniform { weight: *weight, body_point: body_point.as_slice() }
            }
            Self::PointSource { strength, body_point } => {
                Numbers::PointSource { strength: *strength, body_point: body_point.as_slice() }
            }
            Self::Spring { stiffness, rest_length, body_point } => Numbers::Spring {
                stiffness: *stiffness,
                rest_length: *rest_length,
                body_point: body_point.as_slice(),
            },
            Self::GravityGradient { strength, matrix } => {
                Numbers::GravityGradient { strength: *strength, matrix: matrix.as_slice() }
            }
        }
    }

    /// `|y - q|` relative to the arms where the law is singular at zero distance.
    pub(super) fn relative_distance(&self, q: &Vector<N>) -> Option<f64> {
        self.singular_point().map(|y| (y - q).norm() / (y.norm() + q.norm()))
    }

    /// The body point at which a law is singular, if it is.
    fn singular_point(&self) -> Option<&Vector<N>> {
        match self {
            Self::PointSource { body_point, .. } => Some(body_point),
            Self::Spring { rest_length, body_point, .. } => {
                (*rest_length > 0.0).then_some(body_point)
            }
            Self::Uniform { .. } | Self::GravityGradient { .. } => None,
        }
    }
}

impl Law<3> {
    /// The law in the plane of axes i and j, if it never pulls out of it.
    pub(super) fn in_plane(&self, axes: [usize; 3]) -> Option<Law<2>> {
        let [i, j, k] = axes;
        let point = |y: &Vector<3>| (y[k] == 0.0).then_some(Vector::<2>::new(y[i], y[j]));
        Some(match self {
            Self::Uniform { weight, body_point } => {
                Law::Uniform { weight: *weight, body_point: point(body_point)? }
            }
            Self::PointSource { strength, body_point } => {
                Law::PointSource { strength: *strength, body_point: point(body_point)? }
            }
            Self::Spring { stiffness, rest_length, body_point } => Law::Spring {
                stiffness: *stiffness,
                rest_length: *rest_length,
                body_point: point(body_point)?,
            },
            Self::GravityGradient { strength, matrix: m } => {
                let block = Mat::<2>::new(m[(i, i)], m[(i, j)], m[(j, i)], m[(j, j)]);
                is_axis(m, axes)
                    .then_some(Law::GravityGradient { strength: *strength, matrix: block })?
            }
        })
    }
}

impl<const N: usize> Term<N> {
    /// `1 / (|y| + |v|)^2` where the law is singular at zero distance, else zero.
    pub(super) fn reach(&self) -> f64 {
        self.law.singular_point().map_or(0.0, |y| {
            let arms = y.norm() + self.space.norm();
            1.0 / (arms * arms)
        })
    }
}

/// A law as its formulas see it: vectors and matrices (column by column) by their numbers.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Numbers<'a> {
    Uniform { weight: f64, body_point: &'a [f64] },
    PointSource { strength: f64, body_point: &'a [f64] },
    Spring { stiffness: f64, rest_length: f64, body_point: &'a [f64] },
    GravityGradient { strength: f64, matrix: &'a [f64] },
}

impl Numbers<'_> {
    /// U(q).
    #[inline(always)]
    pub(super) fn value<V: Image>(&self, q: &V) -> V::Number {
        match *self {
            Self::Uniform { weight, body_point } => uniform::value(weight, body_point, q),
            Self::PointSource { strength, body_point } => {
                point_source::value(strength, body_point, q)
            }
            Self::Spring { stiffness, rest_length, body_point } => {
                spring::value(stiffness, rest_length, body_point, q)
            }
            Self::GravityGradient { strength, matrix } => {
                gravity_gradient::value(strength, matrix, q)
            }
        }
    }

    /// dU/dq, up to multiples of q where that is cheaper (they cancel in the gradient). Where the law is singular at zero
    /// distance, `nearness` becomes at least `-reach` times the square of the distance.
    #[inline(always)]
    pub(super) fn slope<V: Image>(&self, q: &V, reach: f64, nearness: &mut V::Number) -> V {
        match *self {
            Self::Uniform { weight, body_point } => uniform::slope(weight, body_point, q),
            Self::PointSource { strength, body_point } => {
                point_source::slope(strength, body_point, q, reach, nearness)
            }
            Self::Spring { stiffness, rest_length, body_point } => {
                spring::slope(stiffness, rest_length, body_point, q, reach, nearness)
            }
            Self::GravityGradient { strength, matrix } => {
                gravity_gradient::slope(strength, matrix, q)
            }
        }
    }
}

/// What a law is written in: the body image q of a space vector at one attitude, or at several in lanes.
pub(super) trait Image {
    type Number: Real;
    /// A number, in as many lanes.
    fn number(&self, value: f64) -> Self::Number;
    /// A body vector, in as many lanes.
    fn vector(&self, y: &[f64]) -> Self;
    fn minus(&self, other: &Self) -> Self;
    fn dot(&self, other: &Self) -> Self::Number;
    fn square(&self) -> Self::Number;
    fn scaled(&self, c: Self::Number) -> Self;
    /// `m q`
    fn times(&self, m: &[f64]) -> Self;
}

impl<const N: usize> Image for Vector<N> {
    type Number = f64;

    #[inline(always)]
    fn number(&self, value: f64) -> f64 {
        value
    }

    #[inline(always)]
    fn vector(&self, y: &[f64]) -> Self {
        Self::from_column_slice(y)
    }

    #[inline(always)]
    fn minus(&self, other: &Self) -> Self {
        self - other
    }

    #[inline(always)]
    fn dot(&self, other: &Self) -> f64 {
        Self::dot(self, other)
    }

    #[inline(always)]
    fn square(&self) -> f64 {
        self.norm_squared()
    }

    #[inline(always)]
    fn scaled(&self, c: f64) -> Self {
        self * c
    }

    #[inline(always)]
    fn times(&self, m: &[f64]) -> Self {
        Mat::from_column_slice(m) * self
    }
}

/// A vector in lanes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lanes<R: Copy, D: Dimension> {
    pub(super) dimension: D,
    pub(super) numbers: D::Vector<R>,
}

impl<R: Real, D: Dimension> Image for Lanes<R, D> {
    type Number = R;

    #[inline(always)]
    fn number(&self, value: f64) -> R {
        self.numbers[0].constant(value)
    }

    #[inline(always)]
    fn vector(&self, y: &[f64]) -> Self {
        let mut vector = *self;
        for i in 0..self.dimension.n() {
            vector.numbers[i] = self.number(y[i]);
        }
        vector
    }

    #[inline(always)]
    fn minus(&self, other: &Self) -> Self {
        let mut difference = *self;
        for i in 0..self.dimension.n() {
            difference.numbers[i] = self.numbers[i] - other.numbers[i];
        }
        difference
    }

    #[inline(always)]
    fn dot(&self, other: &Self) -> R {
        let mut sum = self.numbers[0] * other.numbers[0];
        for i in 1..self.dimension.n() {
            sum = sum + self.numbers[i] * other.numbers[i];
        }
        sum
    }

    #[inline(always)]
    fn square(&self) -> R {
        self.dot(self)
    }

    #[inline(always)]
    fn scaled(&self, c: R) -> Self {
        let mut scaled = *self;
        for i in 0..self.dimension.n() {
            scaled.numbers[i] = self.numbers[i] * c;
        }
        scaled
    }

    #[inline(always)]
    fn times(&self, m: &[f64]) -> Self {
        let (mut image, n) = (*self, self.dimension.n());
        for i in 0..n {
            let mut sum = self.numbers[0] * m[i];
            for j in 1..n {
                sum = sum + self.numbers[j] * m[j * n + i];
            }
            image.numbers[i] = sum;
        }
        image
    }
}
