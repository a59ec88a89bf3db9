//! Torques of streams on flat faces of the body: thin air along an orbit, and sunlight.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::driven::Factor;
use super::range::{Check, direction, ensure, limit, only_three, point};
use super::{FieldOrbit, Table};

/// The torque of thin air on flat faces, for n = 3. A face counts where it looks into the stream: `F = -1/2 density coefficient area
/// (normal . v) v`, v the velocity of the centre of mass on its orbit; the air is at rest in space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Drag {
    /// The faces, 1 to 1000.
    pub faces: Vec<DragFace>,
    /// Density of the air in kg/m^3.
    pub density_kg_m3: f64,
    /// Factor on the density; one if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub factor: Option<Factor>,
    /// The orbit; that of the field of the scene if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orbit: Option<FieldOrbit>,
}

/// A flat face in the air.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DragFace {
    /// Its outward normal in the body, of any length.
    pub normal: [f64; 3],
    /// Its centre in the body, from the fixed point (the centre of mass), in m.
    pub centre_m: [f64; 3],
    /// Its area in m^2.
    pub area_m2: f64,
    /// Its drag coefficient; 2.2 is usual.
    pub coefficient: f64,
}

/// The torque of sunlight on flat faces, for n = 3. A face counts where it looks to the Sun; nothing shades it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SolarPressure {
    /// The faces, 1 to 1000.
    pub faces: Vec<LitFace>,
    /// Direction to the Sun in space, of any length.
    pub sun: [f64; 3],
    /// Pressure of the light on a black face in N/m^2; 4.56e-6 next to the Earth.
    pub pressure_n_m2: f64,
    /// Factor on the pressure: with a table that holds 1 and 0, an orbit through the shadow of the planet; one if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub factor: Option<Factor>,
}

/// A flat face in the light. Its three parts add up to one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LitFace {
    /// Its outward normal in the body, of any length.
    pub normal: [f64; 3],
    /// Its centre in the body, from the fixed point (the centre of mass), in m.
    pub centre_m: [f64; 3],
    /// Its area in m^2.
    pub area_m2: f64,
    /// Part of the light that is absorbed.
    pub absorption: f64,
    /// Part that is reflected as by a mirror.
    pub specular: f64,
    /// Part that is reflected in all directions (by Lambert's law).
    pub diffuse: f64,
}

/// Most faces.
const MOST: usize = 1000;

impl Drag {
    /// Checks form and range; `has_orbit` is whether the scene has a field, with its orbit.
    pub(super) fn check(
        &self,
        at: &str,
        n: usize,
        duration_s: Option<f64>,
        has_orbit: bool,
    ) -> Check {
        only_three(at, n)?;
        count(at, self.faces.len())?;
        for (index, face) in self.faces.iter().enumerate() {
            let at = format!("{at}/faces/{index}");
            shape(&at, &face.normal, &face.centre_m, face.area_m2)?;
            limit(&format!("{at}/coefficient"), Some(face.coefficient), true)?;
        }
        limit(&format!("{at}/density_kg_m3"), Some(self.density_kg_m3), true)?;
        factor(at, self.factor.as_ref(), duration_s)?;
        match &self.orbit {
            Some(orbit) => orbit.check(&format!("{at}/orbit")),
            None => ensure(has_orbit, at, || {
                "missing field `orbit`, for the scene has no field whose orbit it could be"
                    .to_owned()
            }),
        }
    }
}

impl SolarPressure {
    pub(super) fn check(&self, at: &str, n: usize, duration_s: Option<f64>) -> Check {
        only_three(at, n)?;
        count(at, self.faces.len())?;
        for (index, face) in self.faces.iter().enumerate() {
            let at = format!("{at}/faces/{index}");
            shape(&at, &face.normal, &face.centre_m, face.area_m2)?;
            let parts = [
                ("absorption", face.absorption),
                ("specular", face.specular),
                ("diffuse", face.diffuse),
            ];
            for (name, part) in parts {
                ensure((0.0..=1.0).contains(&part), format!("{at}/{name}"), || {
                    format!("{part:?} given, a part of the light is from 0 to 1")
                })?;
            }
            let sum = face.absorption + face.specular + face.diffuse;
            ensure((sum - 1.0).abs() <= 1e-9, &at, || {
                format!(
                    "has {sum} as the sum of `absorption`, `specular` and `diffuse`, which must be 1"
                )
            })?;
        }
        direction(&format!("{at}/sun"), &self.sun, 3)?;
        limit(&format!("{at}/pressure_n_m2"), Some(self.pressure_n_m2), true)?;
        factor(at, self.factor.as_ref(), duration_s)
    }
}

fn count(at: &str, given: usize) -> Check {
    ensure((1..=MOST).contains(&given), format!("{at}/faces"), || {
        format!("{given} faces given, 1 to {MOST} are allowed")
    })
}

fn shape(at: &str, normal: &[f64; 3], centre_m: &[f64; 3], area_m2: f64) -> Check {
    direction(&format!("{at}/normal"), normal, 3)?;
    point(&format!("{at}/centre_m"), centre_m, 3)?;
    limit(&format!("{at}/area_m2"), Some(area_m2), true)
}

/// Checks a factor on a density or a pressure, which is never below zero.
fn factor(at: &str, given: Option<&Factor>, duration_s: Option<f64>) -> Check {
    let Some(given) = given else { return Ok(()) };
    given.check(&format!("{at}/factor"), duration_s)?;
    match given {
        Factor::Harmonic(harmonic) => {
            let lowest = harmonic.mean - harmonic.amplitude.abs();
            ensure(lowest >= 0.0, format!("{at}/factor/harmonic/amplitude"), || {
                format!(
                    "{:?} given about a mean of {:?}; the factor must not fall below 0",
                    harmonic.amplitude, harmonic.mean
                )
            })
        }
        Factor::Table(Table { values, .. }) => {
            values.iter().enumerate().try_for_each(|(row, &value)| {
                ensure(value >= 0.0, format!("{at}/factor/table/values/{row}"), || {
                    format!("{value:?} given, the factor must not fall below 0")
                })
            })
        }
    }
}
