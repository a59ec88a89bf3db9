//! An orbit by its elements, of a scene with a field or with air.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::ScenarioError;
use super::control::{is_zero, plane};
use super::range::{Check, ensure, number, strength};

/// A Kepler orbit about the centre of space, by its elements, or by the direction to its pericentre and another one in its plane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FieldOrbit {
    /// Semi-major axis in m.
    pub semi_major_axis_m: f64,
    /// Mean motion, 2 pi over the period, in rad/s.
    pub mean_motion_rad_s: f64,
    /// Eccentricity, from 0 to 0.99.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub eccentricity: f64,
    /// Mean anomaly at t = 0 in rad; 0 is the pericentre.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub mean_anomaly_rad: f64,
    /// Inclination against the x-y plane in rad; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub inclination_rad: f64,
    /// Angle of the ascending node from x in rad, at t = 0; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub node_rad: f64,
    /// Angle of the pericentre from the node in rad; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub argument_rad: f64,
    /// Direction to the pericentre at t = 0, in the place of inclination, node and argument.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<[f64; 3]>,
    /// With `from`: from the pericentre it turns towards this direction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub towards: Option<[f64; 3]>,
    /// Oblateness of the central body, by which the plane of the orbit turns about z; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub j2: Option<Oblateness>,
}

/// Oblateness of the body at the centre, whose axis is z. The node drifts at its secular rate, `-3/2 n J2 (R / p)^2 cos i`, with p the
/// semi-latus rectum; pericentre and mean motion stay as they are given.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Oblateness {
    /// The second zonal coefficient; 1.08263e-3 for the Earth.
    pub j2: f64,
    /// The equatorial radius that belongs to it in m; 6378137 for the Earth.
    pub equatorial_radius_m: f64,
    /// The semi-major axis in m, for the orbit of a path; one by its elements has its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub semi_major_axis_m: Option<f64>,
}

impl FieldOrbit {
    pub(super) fn check(&self, at: &str) -> Check {
        let axis = self.semi_major_axis_m;
        ensure((1.0..=1e12).contains(&axis), format!("{at}/semi_major_axis_m"), || {
            format!("{axis:?} given, a semi-major axis is from 1 to 1e12 m")
        })?;
        strength(&format!("{at}/mean_motion_rad_s"), self.mean_motion_rad_s)?;
        let e = self.eccentricity;
        ensure((0.0..=0.99).contains(&e), format!("{at}/eccentricity"), || {
            format!("{e} given, an eccentricity must be from 0 to 0.99")
        })?;
        let elements = [
            ("inclination_rad", self.inclination_rad),
            ("node_rad", self.node_rad),
            ("argument_rad", self.argument_rad),
        ];
        number(&format!("{at}/mean_anomaly_rad"), self.mean_anomaly_rad)?;
        for (name, angle) in elements {
            number(&format!("{at}/{name}"), angle)?;
            let both = self.from.is_some() && angle != 0.0;
            ensure(!both, format!("{at}/{name}"), || {
                "is given together with `from`; give one of the two".to_owned()
            })?;
        }
        match (&self.from, &self.towards) {
            (None, None) => {}
            (Some(from), Some(towards)) => plane(at, from, towards)?,
            (Some(_), None) => {
                return Err(ScenarioError::invalid(
                    at,
                    "missing field `towards`, which `from` needs",
                ));
            }
            (None, Some(_)) => {
                return Err(ScenarioError::invalid(
                    at,
                    "missing field `from`, which `towards` needs",
                ));
            }
        }
        let Some(oblateness) = &self.j2 else { return Ok(()) };
        let at = format!("{at}/j2");
        ensure(oblateness.semi_major_axis_m.is_none(), format!("{at}/semi_major_axis_m"), || {
            format!("is given, and the orbit has {axis:?} m of its own; leave it out here")
        })?;
        oblateness.check(&at, axis, e)
    }
}

impl Oblateness {
    /// Checks that of an orbit of a path.
    pub(super) fn check_on_path(&self, at: &str, eccentricity: f64) -> Check {
        let Some(axis) = self.semi_major_axis_m else {
            return Err(ScenarioError::invalid(
                at,
                "missing field `semi_major_axis_m`, which the orbit of a path needs",
            ));
        };
        ensure((1.0..=1e12).contains(&axis), format!("{at}/semi_major_axis_m"), || {
            format!("{axis:?} given, a semi-major axis is from 1 to 1e12 m")
        })?;
        self.check(at, axis, eccentricity)
    }

    fn check(&self, at: &str, semi_major_axis_m: f64, eccentricity: f64) -> Check {
        /// Above it nothing round is left.
        const MOST: f64 = 0.5;
        let Self { j2, equatorial_radius_m: radius_m, .. } = *self;
        ensure(j2.abs() <= MOST, format!("{at}/j2"), || {
            format!("{j2:?} given, the size of a second zonal coefficient is at most {MOST}")
        })?;
        let lowest_m = semi_major_axis_m * (1.0 - eccentricity);
        let fits = radius_m > 0.0 && radius_m <= lowest_m;
        ensure(fits, format!("{at}/equatorial_radius_m"), || {
            format!(
                "{radius_m:?} given, a radius is above 0 and at most the distance of the pericentre, {lowest_m:?} m"
            )
        })
    }
}
