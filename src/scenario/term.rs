//! The terms of the potential, one file each: its fields, their range, what of it the plan may drop, what viewers draw.
//!
//! A new term is its file here and its line below, its law in `solve/hamiltonian/term`, and what `plan` makes of it:
//! nothing compiles until all of it is there.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use super::check::Check;

mod gravity_gradient;
mod point_source;
mod spring;
mod uniform;

pub use gravity_gradient::GravityGradient;
pub use point_source::PointSource;
pub use spring::Spring;
pub use uniform::Uniform;

macro_rules! terms {
    ($($(#[doc = $doc:literal])* $term:ident,)*) => {
        /// One term of the potential. `g` turns body coordinates into space coordinates.
        #[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
        #[serde(tag = "kind", rename_all = "snake_case")]
        pub enum PotentialTerm {
            $($(#[doc = $doc])* $term($term),)*
        }

        /// What stands at `kind`.
        #[derive(Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub(super) enum Kind {
            $($term,)*
        }

        impl Kind {
            /// A term of this kind from the other fields.
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
            /// What every term can be asked.
            pub(crate) fn law(&self) -> &dyn Law {
                match self {
                    $(Self::$term(term) => term,)*
                }
            }
        }
    };
}

terms! {
    /// weight * direction . (g body_point)
    Uniform,
    /// strength / |g body_point - position|
    PointSource,
    /// stiffness / 2 * (|g body_point - position| - rest_length)^2
    Spring,
    /// strength / 2 * (g^T direction) . matrix (g^T direction)
    GravityGradient,
}

impl PotentialTerm {
    /// The term as a point source, if it is one.
    pub(crate) fn as_point_source(&self) -> Option<&PointSource> {
        match self {
            Self::PointSource(source) => Some(source),
            _ => None,
        }
    }
}

/// What every term can be asked.
pub(crate) trait Law {
    /// Checks form and range of the fields of the term with the pointer `at`.
    fn check(&self, at: &str, n: usize) -> Check;

    /// The value of a term that does not depend on the attitude, and the reason; `None` if it does.
    fn constant(&self) -> Option<(f64, &'static str)>;

    /// Body point and place, of a law that is singular where the two meet.
    fn singular_points(&self) -> Option<(&[f64], &[f64])>;

    /// The space vector through whose body image the term depends on the attitude.
    fn space_vector(&self) -> &[f64];

    /// What viewers draw.
    fn drawn(&self) -> Drawn<'_>;
}

/// What viewers draw of a term.
#[derive(Default)]
pub(crate) struct Drawn<'a> {
    pub(crate) body_point: Option<&'a [f64]>,
    /// A point of space.
    pub(crate) position: Option<&'a [f64]>,
    pub(crate) direction: Option<&'a [f64]>,
    /// The points are as red or as blue as its sign.
    pub(crate) charge: f64,
}

const NO_STRENGTH: &str = "has no strength";
const FIXED: &str = "is the same at every attitude: its body point or its place is the fixed point";

fn is_zero(v: &[f64]) -> bool {
    v.iter().all(|&x| x == 0.0)
}

fn distance(y: &[f64], z: &[f64]) -> f64 {
    y.iter().zip(z).map(|(y, z)| (y - z) * (y - z)).sum::<f64>().sqrt()
}
