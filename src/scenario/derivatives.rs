//! Derivatives of a run by its start and by fields of its scenario.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::range::{Check, ensure};
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
}

/// Checks what is asked for, and what stands next to it.
pub(super) fn check(scenario: &Scenario, n: usize) -> Check {
    const AT: &str = "/derivatives";
    let Some(Derivatives { state, parameters }) = &scenario.derivatives else { return Ok(()) };
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
    Ok(())
}
