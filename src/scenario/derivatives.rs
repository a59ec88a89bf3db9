//! Derivatives of a run by its start and by fields of its scenario.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::range::{self, Check, MAX_SIZE, ensure, spread};
use super::{Field, MethodName, Scenario};

/// Largest n: the derivatives by the start are (n (n - 1))^2 numbers a sample.
const MAX_DIMENSION: usize = 16;
/// Most fields by which a run is differentiated.
const MAX_PARAMETERS: usize = 64;
/// The sections whose numbers may be named.
const SECTIONS: [&str; 4] = [
    "/scene/inertia/",
    "/scene/potential/",
    "/scene/initial/momentum/",
    "/scene/initial/angular_velocity/",
];

/// What a run carries along in addition to its state: how the state depends on the start and on fields of the scenario, by
/// the exact derivative of each step. For `vpd`, and scenes that nothing drives.
///
/// A state changes by (xi, nu), n (n - 1) numbers: `dg = g hat(xi)` and `dmu = hat(nu)`, each half ordered like the body
/// momentum.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Derivatives {
    /// By the state at the start: the state transition matrix.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub state: bool,
    /// By these fields, JSON pointers of numbers of the inertia, the potential, and the momentum or the angular velocity at
    /// the start. The start changes with the inertia where it is given by its angular velocity.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parameters: Vec<String>,
    /// How uncertain the start and the parameters are: the run then carries the covariance of its state along.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance: Option<Covariance>,
}

/// Covariance of a start and of parameters, to first order: that of (xi, nu), and independent of it that of each parameter. The
/// two spreads are those of an ensemble.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Covariance {
    /// Standard deviation of the turn about each body axis (for n > 3 in each coordinate plane), in radians.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub attitude_spread_rad: f64,
    /// Standard deviation of each component of the body momentum, in kg m^2/s.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub momentum_spread: f64,
    /// In place of the two: the covariance of (xi, nu), n (n - 1) rows, symmetric and positive semidefinite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matrix: Option<Vec<Vec<f64>>>,
    /// Standard deviation of each of `parameters`, in its unit.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub parameter_spreads: Vec<f64>,
}

// serde hands over a reference.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

impl Covariance {
    /// Is anything of the start uncertain?
    fn is_of_start(&self) -> bool {
        self.attitude_spread_rad > 0.0 || self.momentum_spread > 0.0 || self.matrix.is_some()
    }

    fn check(&self, asked: &Derivatives, n: usize) -> Check {
        const AT: &str = "/derivatives/covariance";
        let Self { attitude_spread_rad, momentum_spread, matrix, parameter_spreads } = self;
        let most = std::f64::consts::PI;
        spread(&format!("{AT}/attitude_spread_rad"), *attitude_spread_rad, most)?;
        spread(&format!("{AT}/momentum_spread"), *momentum_spread, MAX_SIZE)?;
        if let Some(given) = matrix {
            let at = format!("{AT}/matrix");
            ensure(*attitude_spread_rad == 0.0 && *momentum_spread == 0.0, at.clone(), || {
                "stands in place of `attitude_spread_rad` and `momentum_spread`; give one or the other"
                    .into()
            })?;
            let rows = n * (n - 1);
            let is_square = given.len() == rows && given.iter().all(|row| row.len() == rows);
            ensure(is_square, at.clone(), || {
                format!("has another shape; {rows} rows of {rows} numbers are needed for n = {n}")
            })?;
            range::matrix(&at, given, rows)?;
            range::semidefinite(&at, given)?;
        }
        let at = format!("{AT}/parameter_spreads");
        let [given, needed] = [parameter_spreads.len(), asked.parameters.len()];
        ensure(given == 0 || given == needed, at.clone(), || {
            format!("{given} given, one for each of the {needed} `parameters` is needed")
        })?;
        for (index, &x) in parameter_spreads.iter().enumerate() {
            spread(&format!("{at}/{index}"), x, MAX_SIZE)?;
        }
        ensure(self.is_of_start() || parameter_spreads.iter().any(|&x| x > 0.0), AT, || {
            "says that all is certain; give `attitude_spread_rad`, `momentum_spread`, `matrix` or `parameter_spreads`".into()
        })?;
        ensure(asked.state || !self.is_of_start(), AT, || {
            "of the start is carried by the state transition matrix; give `\"state\": true`".into()
        })
    }
}

/// Checks what is asked for, and what stands next to it.
pub(super) fn check(scenario: &Scenario, n: usize) -> Check {
    const AT: &str = "/derivatives";
    let Some(asked) = &scenario.derivatives else { return Ok(()) };
    let Derivatives { state, parameters, covariance } = asked;
    ensure(*state || !parameters.is_empty(), AT, || {
        "asks for nothing: give `\"state\": true`, or `parameters`".into()
    })?;
    let name = scenario.method.name;
    ensure(matches!(name, MethodName::Auto | MethodName::Vpd), "/method/name", || {
        format!("{} given, `derivatives` need vpd", name.as_str())
    })?;
    ensure(n <= MAX_DIMENSION, AT, || {
        format!("are for n up to {MAX_DIMENSION}, this body has n = {n}")
    })?;
    let scene = &scenario.scene;
    // The field alone turns nothing.
    let dipole = scene.field.as_ref().map(|Field::Dipole(dipole)| dipole);
    let moment = dipole.and_then(|dipole| dipole.permanent_moment_a_m2);
    let others = [
        (scenario.ensemble.is_some(), "`ensemble`"),
        (scenario.accuracy.is_some(), "`accuracy`, which chooses the method; give a step"),
        (scenario.adaptive().is_some(), "steps that adapt"),
        (!scene.driven.is_empty(), "`scene.driven`"),
        (!scene.torques.is_empty(), "`scene.torques`"),
        (scene.control.is_some(), "`scene.control`"),
        (moment.is_some(), "`permanent_moment_a_m2` of `scene.field`"),
    ];
    for (given, what) in others {
        ensure(!given, AT, || {
            format!(
                "are given together with {what}; they are for one run of a scene that nothing drives, with steps of one length"
            )
        })?;
    }
    ensure(parameters.len() <= MAX_PARAMETERS, format!("{AT}/parameters"), || {
        format!("{} given, at most {MAX_PARAMETERS} are allowed", parameters.len())
    })?;
    let document = serde_json::to_value(scenario).unwrap_or_default();
    let mut seen = HashSet::new();
    for (index, pointer) in parameters.iter().enumerate() {
        let at = format!("{AT}/parameters/{index}");
        ensure(seen.insert(pointer), at.clone(), || "names a field that was named before".into())?;
        let named = SECTIONS.iter().any(|section| pointer.starts_with(section));
        let is_number = document.pointer(pointer).is_some_and(Value::is_number);
        ensure(named && is_number, at, || {
            format!(
                "{pointer:?} given, the pointer of a number of this scenario that begins with one of {} is needed",
                SECTIONS.join(", ")
            )
        })?;
    }
    covariance.as_ref().map_or(Ok(()), |given| given.check(asked, n))
}
