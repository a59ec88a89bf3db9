//! The terms of the potential: each law is written once, in its file, for one attitude in n dimensions and for several
//! attitudes in lanes.
//!
//! A new law is its file, its `mod` here and its entry in the list, which the program reads, too (`scenario/term`). Nothing
//! compiles until its file has all that is asked of it:
//!
//! ```text
//! SPACE                                            what its space vector is
//! value(fields.., q)                               U(q)
//! slope(fields.., q, inverse_arm_squared, proximity)              dU/dq, see [`LawRef::slope`]
//! change(fields.., q, rate)                        dU/dq . q', rate being q'
//! slope_rate((fields..), (their rates..), q, q')    the rate of that slope
//! singular_point(fields..)                         the body point y, if U is singular at q = y
//! ```

use super::super::lanes::Real;
use super::super::so::{self, Mat, Vector};
use super::super::so3::is_axis;
use super::super::stack::Dimension;

mod gravity_gradient;
mod point_source;
mod spring;
mod uniform;

/// The list of the laws, handed to the macro `$then`: for each its module, its name and its fields,
/// each a `number`, a body `vector` or a symmetric `matrix` of the body. The first is the strength:
/// U is proportional to it.
#[doc(hidden)]
#[macro_export]
macro_rules! laws {
    ($then:ident) => {
        $then! {
            /// `weight v . (g y) = weight y . q`
            uniform Uniform {
                /// Weight.
                weight: number,
                /// Body point y.
                body_point: vector,
            }
            /// `strength / |g y - v| = strength / |y - q|`
            point_source PointSource {
                /// Strength.
                strength: number,
                /// Body point y.
                body_point: vector,
            }
            /// `stiffness / 2 (|g y - v| - rest_length)^2`
            spring Spring {
                /// Stiffness.
                stiffness: number,
                /// Length at rest.
                rest_length: number,
                /// Body point y.
                body_point: vector,
            }
            /// `strength / 2 q . M q`
            gravity_gradient GravityGradient {
                /// Strength.
                strength: number,
                /// The symmetric matrix M.
                matrix: matrix,
            }
        }
    };
}

/// One term of the potential, `x = g y` being the place of the body point y.
#[derive(Clone, Debug, PartialEq)]
pub struct Term<const N: usize> {
    /// The law and its strength.
    pub law: Law<N>,
    /// The space vector v: direction, source or anchor.
    pub space: Vector<N>,
}

/// Kind of the space vector of a law.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Space {
    /// A direction.
    Direction,
    /// A place.
    Place,
    /// The direction of a mass whose pull falls with the cube of its distance.
    Tide,
}

/// For each kind of field: its type in a law, its type in [`LawRef`] and the conversion; the same
/// in a plane; an example.
macro_rules! field {
    (type number $n:ident) => { f64 };
    (type vector $n:ident) => { Vector<$n> };
    (type matrix $n:ident) => { Mat<$n> };
    (numbers number $life:lifetime) => { f64 };
    (numbers $kind:ident $life:lifetime) => { &$life [f64] };
    (seen number $own:ident) => { *$own };
    (seen $kind:ident $own:ident) => { $own.as_slice() };
    (plane number $own:ident $axes:ident) => { *$own };
    (plane vector $own:ident $axes:ident) => { point_in_plane($own, $axes)? };
    (plane matrix $own:ident $axes:ident) => { matrix_in_plane($own, $axes)? };
    (quotient $kind:ident $law:ident $field:ident $other:ident $divisor:ident) => {
        if let Self::$law { $field: other, .. } = $other {
            *$field = (*$field - other) / $divisor;
        }
    };
    (zero number) => { 0.0 };
    (zero vector) => { Vector::zeros() };
    (zero matrix) => { Mat::zeros() };
    (example number $next:ident) => { 0.2 + $next().abs() };
    (example vector $next:ident) => { Vector::from_fn(|_, _| $next()) };
    (example matrix $next:ident) => { so::symmetric_part(&Mat::from_fn(|_, _| $next())) };
}

macro_rules! declare {
    ($(
        $(#[$doc:meta])*
        $module:ident $law:ident {
            $(#[$first_doc:meta])* $first:ident: number,
            $($(#[$field_doc:meta])* $field:ident: $kind:ident,)*
        }
    )*) => {
        /// Dependence of a term on `q = g^T v`.
        #[derive(Clone, Debug, PartialEq)]
        pub enum Law<const N: usize> {
            $(
                $(#[$doc])*
                $law {
                    $(#[$first_doc])*
                    $first: f64,
                    $($(#[$field_doc])* $field: field!(type $kind N),)*
                },
            )*
        }

        /// A law as its formulas see it: vectors and matrices (column by column) by their numbers.
        #[derive(Clone, Copy, Debug)]
        pub(crate) enum LawRef<'a> {
            $($law { $first: f64, $($field: field!(numbers $kind 'a),)* },)*
        }

        impl<const N: usize> Law<N> {
            /// Returns one of each law, its fields from numbers in [-1, 1), for the tests of every
            /// law.
            pub fn examples(mut next: impl FnMut() -> f64) -> Vec<Self> {
                vec![$(Self::$law {
                    $first: field!(example number next),
                    $($field: field!(example $kind next),)*
                },)*]
            }

            /// Returns the kind of the space vector.
            pub(super) fn space(&self) -> Space {
                match self {
                    $(Self::$law { .. } => $module::SPACE,)*
                }
            }

            /// Returns the law `factor` times as strong.
            pub(super) fn times(&self, factor: f64) -> Self {
                let mut law = self.clone();
                match &mut law {
                    $(Self::$law { $first: strength, .. })|* => *strength *= factor,
                }
                law
            }

            /// Returns the law of the same kind whose fields are zero: as a rate, one that changes nothing.
            pub fn zero(&self) -> Self {
                match self {
                    $(Self::$law { .. } => Self::$law {
                        $first: 0.0,
                        $($field: field!(zero $kind),)*
                    },)*
                }
            }

            fn strength(&self) -> f64 {
                match self {
                    $(Self::$law { $first: strength, .. })|* => *strength,
                }
            }

            /// Returns `(self - other) / divisor`, field by field; `None` if the kinds differ.
            pub(super) fn quotient(&self, other: &Self, divisor: f64) -> Option<Self> {
                let mut law = self.clone();
                match (&mut law, other) {
                    $((
                        Self::$law { $first: strength, $($field,)* },
                        Self::$law { .. },
                    ) => {
                        *strength = (*strength - other.strength()) / divisor;
                        $(field!(quotient $kind $law $field other divisor);)*
                    })*
                    _ => return None,
                }
                Some(law)
            }

            /// The rate of dU/dq, up to multiples of q, where the fields change at the rates in `rate`, a law of the same
            /// kind, and q at `q_rate`. `None` if the kinds differ.
            #[inline(always)]
            pub(super) fn slope_rate<V: BodyVector>(
                &self,
                rate: &Self,
                q: &V,
                q_rate: &V,
            ) -> Option<V> {
                match self.numbers() {
                    $(LawRef::$law { $first, $($field,)* } => {
                        let fields = ($first, $($field,)*);
                        let LawRef::$law { $first, $($field,)* } = rate.numbers() else {
                            return None;
                        };
                        Some($module::slope_rate(fields, ($first, $($field,)*), q, q_rate))
                    })*
                }
            }

            /// The law as its formulas see it.
            pub(crate) fn numbers(&self) -> LawRef<'_> {
                match self {
                    $(Self::$law { $first, $($field,)* } => LawRef::$law {
                        $first: *$first,
                        $($field: field!(seen $kind $field),)*
                    },)*
                }
            }

            /// The body point at which a law is singular, if it is.
            fn singular_point(&self) -> Option<&Vector<N>> {
                match self {
                    $(Self::$law { $first, $($field,)* } => {
                        $module::singular_point(*$first, $($field,)*)
                    })*
                }
            }
        }

        impl Law<3> {
            /// The law in the plane of axes i and j, if it never pulls out of it. A [`BodyVector`] knows no handedness: a law
            /// whose body vectors are in the plane, and whose matrices leave its normal alone, does not.
            pub(super) fn in_plane(&self, axes: [usize; 3]) -> Option<Law<2>> {
                Some(match self {
                    $(Self::$law { $first, $($field,)* } => Law::$law {
                        $first: *$first,
                        $($field: field!(plane $kind $field axes),)*
                    },)*
                })
            }
        }

        impl LawRef<'_> {
            /// U(q).
            #[inline(always)]
            pub(super) fn value<V: BodyVector>(&self, q: &V) -> V::Number {
                match *self {
                    $(Self::$law { $first, $($field,)* } => $module::value($first, $($field,)* q),)*
                }
            }

            /// `dU/dq . q'`
            #[inline(always)]
            pub(super) fn change<V: BodyVector>(&self, q: &V, rate: &V) -> V::Number {
                match *self {
                    $(Self::$law { $first, $($field,)* } => {
                        $module::change($first, $($field,)* q, rate)
                    })*
                }
            }

            /// dU/dq, up to multiples of q where that is cheaper (they cancel in the gradient). Where the law is singular
            /// at zero distance, `proximity` becomes at least `-inverse_arm_squared` times the square of the distance.
            #[inline(always)]
            pub(super) fn slope<V: BodyVector>(&self, q: &V, inverse_arm_squared: f64, proximity: &mut V::Number) -> V {
                match *self {
                    $(Self::$law { $first, $($field,)* } => {
                        $module::slope($first, $($field,)* q, inverse_arm_squared, proximity)
                    })*
                }
            }
        }
    };
}

laws!(declare);

fn point_in_plane(y: &Vector<3>, [i, j, k]: [usize; 3]) -> Option<Vector<2>> {
    (y[k] == 0.0).then_some(Vector::<2>::new(y[i], y[j]))
}

fn matrix_in_plane(m: &Mat<3>, axes: [usize; 3]) -> Option<Mat<2>> {
    let [i, j, _] = axes;
    is_axis(m, axes).then_some(Mat::<2>::new(m[(i, i)], m[(i, j)], m[(j, i)], m[(j, j)]))
}

impl<const N: usize> Law<N> {
    /// U(q).
    pub(super) fn value(&self, q: &Vector<N>) -> f64 {
        self.numbers().value(q)
    }

    /// `|y - q|` relative to the arms where the law is singular at zero distance.
    pub(super) fn relative_distance(&self, q: &Vector<N>) -> Option<f64> {
        let norm = |v: &Vector<N>| so::norm(v.as_slice());
        self.singular_point().map(|y| norm(&(y - q)) / (norm(y) + norm(q)))
    }

    /// `1 / (|y| + |v|)^2` for the space vector v where the law is singular at zero distance, else zero.
    pub(super) fn inverse_arm_squared(&self, space: &Vector<N>) -> f64 {
        self.singular_point().map_or(0.0, |y| {
            let arms = so::norm(y.as_slice()) + so::norm(space.as_slice());
            1.0 / (arms * arms)
        })
    }
}

impl<const N: usize> Term<N> {
    /// [`Law::inverse_arm_squared`] for its own space vector.
    pub(super) fn inverse_arm_squared(&self) -> f64 {
        self.law.inverse_arm_squared(&self.space)
    }
}

/// Argument of a law: the body image q of a space vector at one attitude, or at several in lanes.
pub(super) trait BodyVector {
    type Number: Real;
    /// A number, in as many lanes.
    fn number(&self, value: f64) -> Self::Number;
    /// A body vector, in as many lanes.
    fn vector(&self, y: &[f64]) -> Self;
    fn plus(&self, other: &Self) -> Self;
    fn minus(&self, other: &Self) -> Self;
    fn dot(&self, other: &Self) -> Self::Number;
    fn square(&self) -> Self::Number;
    fn scaled(&self, c: Self::Number) -> Self;
    /// `m q`
    fn times(&self, m: &[f64]) -> Self;
}

impl<const N: usize> BodyVector for Vector<N> {
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
    fn plus(&self, other: &Self) -> Self {
        self + other
    }

    #[inline(always)]
    fn minus(&self, other: &Self) -> Self {
        self - other
    }

    #[inline(always)]
    fn dot(&self, other: &Self) -> f64 {
        so::dot(self.as_slice(), other.as_slice())
    }

    #[inline(always)]
    fn square(&self) -> f64 {
        so::dot(self.as_slice(), self.as_slice())
    }

    #[inline(always)]
    fn scaled(&self, c: f64) -> Self {
        self * c
    }

    #[inline(always)]
    fn times(&self, m: &[f64]) -> Self {
        so::to_space(&Mat::from_column_slice(m), self)
    }
}

/// A vector in lanes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lanes<R: Copy, D: Dimension> {
    pub(super) dimension: D,
    pub(super) numbers: D::Vector<R>,
}

impl<R: Real, D: Dimension> BodyVector for Lanes<R, D> {
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
    fn plus(&self, other: &Self) -> Self {
        let mut sum = *self;
        for i in 0..self.dimension.n() {
            sum.numbers[i] = self.numbers[i] + other.numbers[i];
        }
        sum
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
