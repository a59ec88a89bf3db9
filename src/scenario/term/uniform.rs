//! A uniform field.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::super::range::{Check, direction, point, strength};
use super::{
    Drawn, FIXED, Law, Mobility, NO_STRENGTH, example_vector, is_zero, length, unit, vector,
};
use crate::solve::hamiltonian;

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

impl Uniform {
    pub(super) const FORMULA: &'static str = "weight * direction . (g body_point)";

    pub(super) fn example(n: usize) -> Self {
        Self { weight: 1.5, body_point: example_vector(n, 0.3), direction: example_vector(n, 0.7) }
    }

    pub(super) fn modelled<const N: usize>(&self) -> hamiltonian::Law<N> {
        hamiltonian::Law::Uniform { weight: self.weight, body_point: vector(&self.body_point) }
    }
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

    fn largest_torque(&self) -> f64 {
        self.weight.abs() * length(&self.body_point) * length(&self.direction)
    }

    fn squared_rate(&self, _near_m: f64, mobility: &Mobility<'_>) -> f64 {
        let arms = length(&self.body_point) * length(&self.direction);
        self.weight.abs() * arms * (mobility.at)(&unit(&self.body_point))
    }

    fn drawn(&self) -> Drawn<'_> {
        Drawn {
            body_point: Some(&self.body_point),
            direction: Some(&self.direction),
            ..Drawn::default()
        }
    }
}
