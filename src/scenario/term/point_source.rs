//! A charge.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::super::range::{Check, point, strength};
use super::{
    Drawn, FIXED, Law, Mobility, NO_STRENGTH, apart, distance, example_vector, is_zero, length,
    vector,
};
use crate::solve::hamiltonian;

/// A point of space that attracts or repels a body point.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PointSource {
    /// Strength; positive repels.
    pub strength: f64,
    /// Point of the body, in body coordinates.
    pub body_point: Vec<f64>,
    /// Place of the source, in space coordinates.
    pub position: Vec<f64>,
}

impl PointSource {
    pub(super) const FORMULA: &'static str = "strength / |g body_point - position|";

    pub(super) fn example(n: usize) -> Self {
        Self {
            strength: -0.5,
            body_point: example_vector(n, 0.3),
            position: example_vector(n, 2.0),
        }
    }

    pub(super) fn modelled<const N: usize>(&self) -> hamiltonian::Law<N> {
        let body_point = vector(&self.body_point);
        hamiltonian::Law::PointSource { strength: self.strength, body_point }
    }
}

impl Law for PointSource {
    fn check(&self, at: &str, n: usize) -> Check {
        strength(&format!("{at}/strength"), self.strength)?;
        point(&format!("{at}/body_point"), &self.body_point, n)?;
        point(&format!("{at}/position"), &self.position, n)
    }

    fn constant(&self) -> Option<(f64, &'static str)> {
        if self.strength == 0.0 {
            return Some((0.0, NO_STRENGTH));
        }
        let fixed = is_zero(&self.body_point) || is_zero(&self.position);
        fixed.then(|| (self.strength / distance(&self.body_point, &self.position), FIXED))
    }

    fn singular_points(&self) -> Option<(&[f64], &[f64])> {
        (self.strength != 0.0).then_some((&self.body_point, &self.position))
    }

    fn space_vector(&self) -> &[f64] {
        &self.position
    }

    fn largest_torque(&self) -> f64 {
        let (y, z) = (length(&self.body_point), length(&self.position));
        let r = apart(y, z);
        self.strength.abs() * y * z / (r * r * r)
    }

    fn squared_rate(&self, near_m: f64, mobility: &Mobility<'_>) -> f64 {
        self.strength.abs() * (mobility.at)(&self.body_point) / (near_m * near_m * near_m)
    }

    fn drawn(&self) -> Drawn<'_> {
        Drawn {
            body_point: Some(&self.body_point),
            position: Some(&self.position),
            charge: self.strength,
            ..Drawn::default()
        }
    }
}
