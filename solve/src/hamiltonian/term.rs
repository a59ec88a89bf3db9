//! The terms of the potential: each law is written once, in its file, for one attitude in n dimensions and for several
//! attitudes in lanes.
//!
//! A new law is its file, its variant here and its line in each `match`, none of which compiles without it.

use super::super::lanes::Real;
use super::super::so::{Mat, Vector};
use super::super::space::{self, Vec3, vec3};

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
        match self {
            Self::Uniform { weight, body_point } => uniform::value(*weight, body_point, q),
            Self::PointSource { strength, body_point } => {
                point_source::value(*strength, body_point, q)
            }
            Self::Spring { stiffness, rest_length, body_point } => {
                spring::value(*stiffness, *rest_length, body_point, q)
            }
            Self::GravityGradient { strength, matrix } => {
                gravity_gradient::value(*strength, matrix, q)
            }
        }
    }

    /// dU/dq, up to multiples of q where that is cheaper (they cancel in the gradient). Where the law is singular at zero
    /// distance, `nearness` becomes at least `-reach` times the square of the distance.
    #[inline(always)]
    pub(super) fn slope<V: Image<N>>(&self, q: &V, reach: f64, nearness: &mut V::Number) -> V {
        match self {
            Self::Uniform { weight, body_point } => uniform::slope(*weight, body_point, q),
            Self::PointSource { strength, body_point } => {
                point_source::slope(*strength, body_point, q, reach, nearness)
            }
            Self::Spring { stiffness, rest_length, body_point } => {
                spring::slope(*stiffness, *rest_length, body_point, q, reach, nearness)
            }
            Self::GravityGradient { strength, matrix } => {
                gravity_gradient::slope(*strength, matrix, q)
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

impl<const N: usize> Term<N> {
    /// `1 / (|y| + |v|)^2` where the law is singular at zero distance, else zero.
    pub(super) fn reach(&self) -> f64 {
        self.law.singular_point().map_or(0.0, |y| {
            let arms = y.norm() + self.space.norm();
            1.0 / (arms * arms)
        })
    }
}

/// What a law is written in: the body image q of a space vector at one attitude, or for n = 3 at several in lanes.
pub(super) trait Image<const N: usize> {
    type Number: Real;
    /// A number, in as many lanes.
    fn number(&self, value: f64) -> Self::Number;
    /// A body vector, in as many lanes.
    fn vector(&self, y: &Vector<N>) -> Self;
    fn minus(&self, other: &Self) -> Self;
    fn square(&self) -> Self::Number;
    fn scaled(&self, c: Self::Number) -> Self;
    /// `m q`
    fn times(&self, m: &Mat<N>) -> Self;
}

impl<const N: usize> Image<N> for Vector<N> {
    type Number = f64;

    #[inline(always)]
    fn number(&self, value: f64) -> f64 {
        value
    }

    #[inline(always)]
    fn vector(&self, y: &Vector<N>) -> Self {
        *y
    }

    #[inline(always)]
    fn minus(&self, other: &Self) -> Self {
        self - other
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
    fn times(&self, m: &Mat<N>) -> Self {
        m * self
    }
}

impl<R: Real> Image<3> for Vec3<R> {
    type Number = R;

    #[inline(always)]
    fn number(&self, value: f64) -> R {
        self[0].constant(value)
    }

    #[inline(always)]
    fn vector(&self, y: &Vector<3>) -> Self {
        vec3!(i => self.number(y[i]))
    }

    #[inline(always)]
    fn minus(&self, other: &Self) -> Self {
        space::minus(self, other)
    }

    #[inline(always)]
    fn square(&self) -> R {
        space::dot(self, self)
    }

    #[inline(always)]
    fn scaled(&self, c: R) -> Self {
        space::scaled(self, c)
    }

    #[inline(always)]
    fn times(&self, m: &Mat<3>) -> Self {
        vec3!(i => self[0] * m[(i, 0)] + self[1] * m[(i, 1)] + self[2] * m[(i, 2)])
    }
}
