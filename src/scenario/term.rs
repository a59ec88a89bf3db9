//! The terms of the potential, one file each: its fields, their range, the parts that the plan may
//! drop, its law, its drawing, an example.
//!
//! The list is that of the laws, `solve/hamiltonian/term.rs`; everything that goes over the terms is made from it here. A new
//! term is its file next to this one, and its file and its entry there: nothing compiles until all of it is there. It
//! counts as the most expensive until `benches/costs.rs` has a scene of it and its costs are measured.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use super::range::Check;
use crate::solve::hamiltonian;
use crate::solve::so::Vector;

macro_rules! terms {
    ($($(#[$doc:meta])* $module:ident $term:ident { $($fields:tt)* })*) => {
        // `cargo fmt` does not see these: .ci/run and CONTRIBUTING.md name the files.
        $(
            mod $module;
            pub use $module::$term;
        )*

        /// One term of the potential. `g` turns body coordinates into space coordinates.
        #[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
        #[serde(tag = "kind", rename_all = "snake_case")]
        pub enum PotentialTerm {
            $(
                #[doc = concat!("See [`", stringify!($term), "`].")]
                #[schemars(description = $term::FORMULA)]
                $term($term),
            )*
        }

        /// Value of `kind`.
        #[derive(Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub(super) enum Kind {
            $($term,)*
        }

        impl Kind {
            /// Reads a term of this kind from the other fields.
            pub(super) fn read<'de, D: Deserializer<'de>>(
                self,
                fields: D,
            ) -> Result<PotentialTerm, D::Error> {
                match self {
                    $(Self::$term => $term::deserialize(fields).map(PotentialTerm::$term),)*
                }
            }
        }

        impl PotentialTerm {
            /// Returns one term of each kind, every field given, in n dimensions, for the tests of
            /// every term.
            pub fn examples(n: usize) -> Vec<Self> {
                vec![$(Self::$term($term::example(n)),)*]
            }

            /// Returns the interface that every term has.
            pub(crate) fn law(&self) -> &dyn Law {
                match self {
                    $(Self::$term(term) => term,)*
                }
            }

            /// Returns the name in scenarios and in the table of costs.
            pub(crate) fn kind(&self) -> &'static str {
                match self {
                    $(Self::$term(_) => stringify!($module),)*
                }
            }

            /// Returns the law that is modelled, once the plan has filled in what may be absent.
            pub(crate) fn modelled<const N: usize>(&self) -> hamiltonian::Law<N> {
                match self {
                    $(Self::$term(term) => term.modelled(),)*
                }
            }
        }
    };
}

crate::solve::laws!(terms);

impl PotentialTerm {
    /// Returns the term as a point source, if it is one.
    pub(crate) fn as_point_source(&self) -> Option<&PointSource> {
        match self {
            Self::PointSource(source) => Some(source),
            _ => None,
        }
    }
}

/// Interface that every term has.
pub(crate) trait Law {
    /// Checks form and range of the fields of the term with the pointer `at`.
    fn check(&self, at: &str, n: usize) -> Check;

    /// Returns the value of a term that does not depend on the attitude, and the reason; `None` if
    /// it does.
    fn constant(&self) -> Option<(f64, &'static str)>;

    /// Returns body point and place of a law that is singular where the two meet.
    fn singular_points(&self) -> Option<(&[f64], &[f64])>;

    /// Returns the space vector through whose body image the term depends on the attitude.
    fn space_vector(&self) -> &[f64];

    /// Returns a bound on the torque at any attitude; infinite if the body point may come too near
    /// to its place. With `|y x F| <= |y| |F|` and, the force pointing from z to y, `|y x F| = |F|
    /// |y x z| / r`.
    fn largest_torque(&self) -> f64;

    /// Returns about the square of the fastest rate that it gives the body, in 1/s^2; a body point
    /// no nearer to its place than `near_m`, if that is positive.
    fn squared_rate(&self, near_m: f64, mobility: &Mobility<'_>) -> f64;

    /// Returns its drawing for viewers.
    fn drawn(&self) -> Drawn<'_>;
}

/// Ease with which a body is turned, in 1/(kg m^2).
pub(crate) struct Mobility<'a> {
    /// Mobility under a force at a body point, times the square of its arm.
    pub(crate) at: &'a dyn Fn(&[f64]) -> f64,
    /// Largest mobility under a torque.
    pub(crate) most: f64,
}

/// Drawing of a term for viewers.
#[derive(Default)]
pub(crate) struct Drawn<'a> {
    pub(crate) body_point: Option<&'a [f64]>,
    /// A point of space.
    pub(crate) position: Option<&'a [f64]>,
    pub(crate) direction: Option<&'a [f64]>,
    /// Charge: the points are as red or as blue as its sign.
    pub(crate) charge: f64,
}

const NO_STRENGTH: &str = "has no strength";
const FIXED: &str =
    "is the same at every attitude: its body point or its position is the fixed point";

fn is_zero(v: &[f64]) -> bool {
    v.iter().all(|&x| x == 0.0)
}

fn length(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn unit(v: &[f64]) -> Vec<f64> {
    let length = length(v);
    v.iter().map(|x| x / length).collect()
}

/// Returns the smallest distance of two points at these distances from the fixed point; zero if
/// they may meet.
fn apart(y: f64, z: f64) -> f64 {
    let distance = (y - z).abs();
    if distance > hamiltonian::CLOSEST_APPROACH * (y + z) { distance } else { 0.0 }
}

/// Returns a vector of this length along no axis.
fn example_vector(n: usize, length: f64) -> Vec<f64> {
    let direction: Vec<f64> = (0..n).map(|i| 1.0 + i as f64).collect();
    unit(&direction).iter().map(|x| length * x).collect()
}

/// Returns the first n coordinates, or zeros beyond them.
pub(crate) fn vector<const N: usize>(v: &[f64]) -> Vector<N> {
    Vector::from_fn(|i, _| v.get(i).copied().unwrap_or(0.0))
}

fn distance(y: &[f64], z: &[f64]) -> f64 {
    y.iter().zip(z).map(|(y, z)| (y - z) * (y - z)).sum::<f64>().sqrt()
}
