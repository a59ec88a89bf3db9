//! A spring.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::super::range::{Check, ensure, number, point, size, strength};
use super::{
    Drawn, FIXED, Law, Mobility, NO_STRENGTH, apart, distance, example_vector, is_zero, length,
    unit, vector,
};
use crate::solve::hamiltonian;

/// A spring from a body point to a point of space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Spring {
    /// Stiffness.
    pub stiffness: f64,
    /// Length at rest, at least 0.
    #[serde(default)]
    pub rest_length: f64,
    /// Point of the body, in body coordinates.
    pub body_point: Vec<f64>,
    /// The anchor, in space coordinates.
    pub position: Vec<f64>,
}

impl Spring {
    /// Returns a spring without a length at rest, as in a scenario that gives none.
    pub fn of(stiffness: f64, body_point: Vec<f64>, position: Vec<f64>) -> Self {
        Self { stiffness, rest_length: 0.0, body_point, position }
    }

    pub(super) const FORMULA: &'static str =
        "stiffness / 2 * (|g body_point - position| - rest_length)^2";

    pub(super) fn example(n: usize) -> Self {
        Self {
            stiffness: 2.0,
            rest_length: 0.1,
            body_point: example_vector(n, 0.3),
            position: example_vector(n, 2.0),
        }
    }

    pub(super) fn modelled<const N: usize>(&self) -> hamiltonian::Law<N> {
        hamiltonian::Law::Spring {
            stiffness: self.stiffness,
            rest_length: self.rest_length,
            body_point: vector(&self.body_point),
        }
    }
}

impl Law for Spring {
    fn check(&self, at: &str, n: usize) -> Check {
        let length = format!("{at}/rest_length");
        strength(&format!("{at}/stiffness"), self.stiffness)?;
        number(&length, self.rest_length)?;
        size(&length, [&self.rest_length])?;
        ensure(self.rest_length >= 0.0, length, || {
            format!("{} given, a length is at least 0", self.rest_length)
        })?;
        point(&format!("{at}/body_point"), &self.body_point, n)?;
        point(&format!("{at}/position"), &self.position, n)
    }

    fn constant(&self) -> Option<(f64, &'static str)> {
        if self.stiffness == 0.0 {
            return Some((0.0, NO_STRENGTH));
        }
        let stretch = distance(&self.body_point, &self.position) - self.rest_length;
        let fixed = is_zero(&self.body_point) || is_zero(&self.position);
        fixed.then_some((0.5 * self.stiffness * stretch * stretch, FIXED))
    }

    fn singular_points(&self) -> Option<(&[f64], &[f64])> {
        let bent = self.stiffness != 0.0 && self.rest_length > 0.0;
        bent.then_some((&self.body_point, &self.position))
    }

    fn space_vector(&self) -> &[f64] {
        &self.position
    }

    fn largest_torque(&self) -> f64 {
        let (y, z) = (length(&self.body_point), length(&self.position));
        let bent = if self.rest_length > 0.0 { self.rest_length / apart(y, z) } else { 0.0 };
        self.stiffness.abs() * y * z * (1.0 + bent)
    }

    fn squared_rate(&self, _near_m: f64, mobility: &Mobility<'_>) -> f64 {
        let arms = length(&self.body_point) * length(&self.position);
        self.stiffness * arms * (mobility.at)(&unit(&self.body_point))
    }

    fn drawn(&self) -> Drawn<'_> {
        Drawn {
            body_point: Some(&self.body_point),
            position: Some(&self.position),
            ..Drawn::default()
        }
    }
}
