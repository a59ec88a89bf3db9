//! A uniform field.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::super::check::{Check, direction, point, strength};
use super::{Drawn, FIXED, Law, NO_STRENGTH, is_zero};

/// A uniform field that pulls at a body point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Uniform {
    /// Weight.
    pub weight: f64,
    /// Point of the body, in body coordinates.
    pub body_point: Vec<f64>,
    /// Direction in space coordinates, against the pull; used as given, not normalised.
    pub direction: Vec<f64>,
}

impl Law for Uniform {
    fn check(&self, at: &str, n: usize) -> Check {
        strength(&format!("{at}/weight"), self.weight)?;
        point(&format!("{at}/body_point"), &self.body_point, n)?;
        direction(&format!("{at}/direction"), &self.direction, n)
    }

    fn constant(&self) -> Option<(f64, &'static str)> {
        if self.weight == 0.0 {
            return Some((0.0, NO_STRENGTH));
        }
        is_zero(&self.body_point).then_some((0.0, FIXED))
    }

    fn singular_points(&self) -> Option<(&[f64], &[f64])> {
        None
    }

    fn space_vector(&self) -> &[f64] {
        &self.direction
    }

    fn drawn(&self) -> Drawn<'_> {
        Drawn {
            body_point: Some(&self.body_point),
            direction: Some(&self.direction),
            ..Drawn::default()
        }
    }
}
