//! The gradient of gravity.

use nalgebra::DMatrix;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::super::parse::given;
use super::super::range::{Check, direction, ensure, largest, matrix, size, strength, symmetry};
use super::{Drawn, Law, Mobility, NO_STRENGTH, example_vector, length};
use crate::solve::hamiltonian;
use crate::solve::so::{self, Mat};

/// The gradient of a distant body's gravity over this one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GravityGradient {
    /// Strength; 3 G M / r^3 for a body of mass M at distance r. On an `orbit`, if absent, that of the orbit:
    /// `3 mean_motion^2 / |direction|^2`.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    #[schemars(with = "f64")]
    pub strength: Option<f64>,
    /// Direction to the other body, in space coordinates; used as given, not normalised.
    pub direction: Vec<f64>,
    /// Symmetric matrix in body coordinates; the inertia matrix if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matrix: Option<Vec<Vec<f64>>>,
}

impl GravityGradient {
    /// Returns a term that acts on the inertia, as in a scenario that gives no matrix.
    pub fn of(strength: f64, direction: Vec<f64>) -> Self {
        Self { strength: Some(strength), direction, matrix: None }
    }

    pub(super) const FORMULA: &'static str =
        "strength / 2 * (g^T direction) . matrix (g^T direction)";

    pub(super) fn example(n: usize) -> Self {
        let entry = |i, j| if i == j { 1.0 + i as f64 } else { 0.1 };
        let matrix = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
        Self { strength: Some(0.6), direction: example_vector(n, 1.0), matrix: Some(matrix) }
    }

    pub(super) fn modelled<const N: usize>(&self) -> hamiltonian::Law<N> {
        let rows = self.matrix.as_ref().expect("the plan filled in the matrix");
        let entry =
            |i: usize, j: usize| rows.get(i).and_then(|row| row.get(j)).copied().unwrap_or(0.0);
        // Exactly symmetric: text may leave the two halves a digit apart.
        let matrix = so::symmetric_part(&Mat::from_fn(entry));
        hamiltonian::Law::GravityGradient { strength: self.strength(), matrix }
    }

    /// Returns the strength of a gradient on an orbit of this mean motion in rad/s: that of a mass M at the distance a has
    /// `3 G M / a^3`, and `G M = n^2 a^3` (Kepler's third law).
    pub(crate) fn strength_on_orbit(&self, mean_motion_rad_s: f64) -> f64 {
        let square: f64 = self.direction.iter().map(|x| x * x).sum();
        3.0 * (mean_motion_rad_s * mean_motion_rad_s) / square
    }

    /// Returns the strength, which the plan has filled in.
    pub(crate) fn strength(&self) -> f64 {
        self.strength.unwrap_or_default()
    }

    /// Returns M, which the plan has filled in.
    pub(crate) fn matrix(&self) -> DMatrix<f64> {
        let rows = self.matrix.as_deref().unwrap_or_default();
        DMatrix::from_fn(rows.len(), rows.len(), |i, j| rows[i][j])
    }
}

impl Law for GravityGradient {
    fn check(&self, at: &str, n: usize) -> Check {
        direction(&format!("{at}/direction"), &self.direction, n)?;
        ensure(self.strength.is_some(), at, || {
            "missing field `strength`, which a path `orbit` alone makes up for".to_owned()
        })?;
        strength(&format!("{at}/strength"), self.strength())?;
        let Some(rows) = &self.matrix else { return Ok(()) };
        let at = format!("{at}/matrix");
        matrix(&at, rows, n)?;
        size(&at, rows.iter().flatten())?;
        symmetry(&at, rows, 1.0, "symmetric")
    }

    /// Returns `strength / 2 |direction|^2 c` where the matrix, which the plan has filled in, is c
    /// I.
    fn constant(&self) -> Option<(f64, &'static str)> {
        /// Relative error of a number by rounding: a few units in its last place.
        const ROUNDED: f64 = 8.0 * f64::EPSILON;
        const ROUND: &str =
            "is the same at every attitude: its matrix is a multiple of I, to rounding";
        if self.strength() == 0.0 {
            return Some((0.0, NO_STRENGTH));
        }
        let m = self.matrix.as_ref()?;
        let level = m[0][0];
        let off: Vec<f64> = (0..m.len())
            .flat_map(|i| (0..m.len()).map(move |j| (i, j)))
            .map(|(i, j)| if i == j { m[i][j] - level } else { m[i][j] })
            .collect();
        let square: f64 = self.direction.iter().map(|x| x * x).sum();
        (largest(&off) <= ROUNDED * largest(m.iter().flatten()))
            .then_some((0.5 * self.strength() * level * square, ROUND))
    }

    fn singular_points(&self) -> Option<(&[f64], &[f64])> {
        None
    }

    fn space_vector(&self) -> &[f64] {
        &self.direction
    }

    fn largest_torque(&self) -> f64 {
        let m = self.matrix();
        let n = m.nrows();
        let level = m.trace() / n as f64;
        let reach = length(&self.direction);
        self.strength().abs() * (m - DMatrix::identity(n, n) * level).norm() * reach * reach
    }

    fn squared_rate(&self, _near_m: f64, mobility: &Mobility<'_>) -> f64 {
        let most = largest(self.matrix.iter().flatten().flatten());
        let size = length(&self.direction);
        self.strength().abs() * size * size * most * mobility.most
    }

    fn drawn(&self) -> Drawn<'_> {
        Drawn { direction: Some(&self.direction), ..Drawn::default() }
    }
}
