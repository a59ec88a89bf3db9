//! Steps that are not all of one length.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::range::{Check, LARGEST_STEP_S, MAX_SIZE, SMALLEST_SIZE, SMALLEST_STEP_S, ensure};
use super::{MethodName, PotentialTerm, Scenario};

/// Steps that are not all of one length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Steps {
    /// Shorter near the point sources of the potential, of several bodies also where they come close under mutual gravity, and
    /// symplectic all the same.
    Adaptive(Adaptive),
}

/// Steps of one length in a time that passes more slowly near point sources: `dt = sigma dtau` with
/// `sigma = (1 + sum (near / distance)^3)^(-1/2)`. Samples still come every `log.every` times `step_s`, or every `log.every_s`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Adaptive {
    /// The longest step, dtau, in seconds: that far from all point sources. `step_s` if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest_step_s: Option<f64>,
    /// The distance in metres below which steps shorten: a list of one number for all point sources, or of one for each in
    /// their order; of several bodies mutual gravity is one, too. If absent, for each the distance of its body point from the
    /// fixed point; of several bodies the distance at the start, or half the long axis of the ellipse of two that are bound, if
    /// that is longer.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub near_m: Vec<f64>,
}

impl Scenario {
    /// Returns the options of adaptive steps, if the steps adapt.
    pub(crate) fn adaptive(&self) -> Option<Adaptive> {
        match (&self.step, self.method.name) {
            (Some(Steps::Adaptive(adaptive)), _) => Some(adaptive.clone()),
            (None, MethodName::VpdAdaptive) => Some(Adaptive::default()),
            (None, _) => None,
        }
    }
}

/// Checks form and range.
pub(super) fn check(scenario: &Scenario) -> Check {
    let Some(adaptive) = scenario.adaptive() else { return Ok(()) };
    let name = scenario.method.name;
    let is_vpd = matches!(name, MethodName::Auto | MethodName::Vpd | MethodName::VpdAdaptive);
    let at = if scenario.step.is_some() { "/step/adaptive" } else { "/method/name" };
    ensure(is_vpd, at, || format!("is for vpd, not for {}", name.as_str()))?;
    let (sources, which) = match scenario.bodies() {
        Some(bodies) => {
            let located = scenario.until.iter().position(|stop| stop.exact);
            ensure(
                located.is_none(),
                format!("/until/{}/exact", located.unwrap_or_default()),
                || {
                    "steps that adapt cannot end at a time that is located; leave it out, or choose another method".into()
                },
            )?;
            let sources = bodies.potential.iter().filter(|term| term.is_close()).count();
            (sources, "the point sources and the mutual gravity")
        }
        None => {
            let potential = &scenario.scene.potential;
            let sources = potential.iter().filter_map(PotentialTerm::as_point_source).count();
            (sources, "the point sources")
        }
    };
    ensure(sources > 0, at, || {
        format!("steps adapt to {which} of `scene.potential`, and there are none")
    })?;
    let Adaptive { largest_step_s, near_m } = adaptive;
    let (low, high) = (SMALLEST_STEP_S, LARGEST_STEP_S);
    ensure(
        largest_step_s.is_none_or(|h| h >= low && h <= high),
        "/step/adaptive/largest_step_s",
        || {
            let given = largest_step_s.unwrap_or_default();
            format!("{given:?} given, a step must be from {low:e} to {high:e} s")
        },
    )?;
    let count = near_m.len();
    ensure(count <= 1 || count == sources, "/step/adaptive/near_m", || {
        format!("{count} numbers given, 1 or {sources} (one for each point source) are needed")
    })?;
    near_m.iter().enumerate().try_for_each(|(i, &near)| {
        ensure(
            (SMALLEST_SIZE..=MAX_SIZE).contains(&near),
            format!("/step/adaptive/near_m/{i}"),
            || format!("{near:?} given, a distance must be from {SMALLEST_SIZE:e} to {MAX_SIZE:e}"),
        )
    })
}
