//! An ensemble in a scenario: how many members, and how they are spread.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Scenario;
use super::range::{Check, LARGEST_SEED, MAX_SIZE, MAX_STEPS, ensure, spread};
#[cfg(feature = "serve")]
use super::{Attitude, BodyInitial, Entry, Framed, Initial};
#[cfg(feature = "serve")]
use crate::log::messages::Member;

/// Many runs of the scene. Member 0 starts as the scene says, the others at normally distributed distances from there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ensemble {
    /// Number of members, 2 to 100,000.
    pub members: u64,
    /// Seed of the distances: the same seed, the same members.
    #[serde(default)]
    pub seed: u64,
    /// Standard deviation of the turn about each body axis (for n > 3 in each coordinate plane), in radians.
    #[serde(default)]
    pub attitude_spread_rad: f64,
    /// Standard deviation of each component of the body momentum, in kg m^2/s; of a body in a joint, of the change of its
    /// angular velocity times its own inertia.
    #[serde(default)]
    pub momentum_spread: f64,
    /// Several bodies: standard deviation of each component of the position of each free body, in m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_spread_m: Option<f64>,
    /// Several bodies: standard deviation of each component of the velocity of each free body, in m/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity_spread_m_s: Option<f64>,
    /// Members whose whole motion is logged in addition to that of member 0: at most seven.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub in_full: Vec<u64>,
}

#[cfg(feature = "serve")]
impl Scenario {
    /// Returns one member of its ensemble, which began so, as a run of its own. `None` if it is of another dimension, or of
    /// other bodies.
    pub(crate) fn member(mut self, begun: &Member) -> Option<Self> {
        let number = begun.member;
        let n = self.dimension();
        if let Some(bodies) = &mut self.scene.bodies {
            let joints = bodies.joint_of_each();
            if bodies.bodies.len() != begun.bodies.len() {
                return None;
            }
            for ((body, of_member), joint) in
                bodies.bodies.iter_mut().zip(&begun.bodies).zip(joints)
            {
                let state = of_member.initial.as_ref().filter(|_| of_member.name == body.name)?;
                let (velocity, momentum) = (&state.angular_velocity, &state.body_momentum);
                let is_free = joint.is_none() && body.pivot.is_none();
                let in_space = |x: &Vec<f64>| (is_free && x.len() == n).then(|| x.clone());
                body.initial = BodyInitial {
                    position: in_space(&state.position),
                    velocity: None,
                    linear_momentum: in_space(&state.linear_momentum),
                    attitude: Some(rows(n, &state.attitude)?),
                    // The momentum of a body in a joint depends on the others.
                    angular_velocity: match joint {
                        Some(_) => Some(in_body(n, velocity)?),
                        None => None,
                    },
                    momentum: match joint {
                        Some(_) => None,
                        None => Some(in_body(n, momentum)?),
                    },
                };
            }
        } else {
            let state = begun.initial.as_ref()?;
            self.scene.initial = Initial {
                attitude: Some(rows(n, &state.attitude)?),
                orbit_frame: None,
                momentum: Some(in_body(n, &state.body_momentum)?),
                angular_velocity: None,
            };
        }
        let mut name: String = self.name.clone();
        // A name has at most 200 bytes.
        while name.len() > 180 {
            name.pop();
        }
        self.name = format!("{name}, member {number}");
        if let Some(channels) = &mut self.log.channels {
            channels.retain(|channel| !channel.is_of_ensembles());
        }
        if let Some(noise) = self.scene.control.as_mut().and_then(|it| it.noise.as_mut()) {
            noise.stream += number;
        }
        self.ensemble = None;
        self.expect = None;
        Some(self)
    }
}

/// Returns an attitude from its matrix row by row; `None` if it is of another size.
#[cfg(feature = "serve")]
fn rows(n: usize, attitude: &[f64]) -> Option<Attitude> {
    (attitude.len() == n * n)
        .then(|| Attitude::Matrix(attitude.chunks(n).map(<[f64]>::to_vec).collect()))
}

/// Returns a skew matrix in body coordinates from its entries above the diagonal, row by row, for n = 3 from its vector; `None` if
/// it is of another size.
#[cfg(feature = "serve")]
fn in_body(n: usize, numbers: &[f64]) -> Option<Framed> {
    if numbers.len() != n * (n - 1) / 2 {
        return None;
    }
    if n == 3 {
        return Some(Framed::Body(numbers.iter().copied().map(Entry::Number).collect()));
    }
    let mut rows = vec![vec![0.0; n]; n];
    let above = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    for ((i, j), &entry) in above.zip(numbers) {
        (rows[i][j], rows[j][i]) = (entry, -entry);
    }
    Some(Framed::Body(rows.into_iter().map(Entry::Row).collect()))
}

impl Ensemble {
    /// Largest number of members.
    pub const MOST: u64 = 100_000;
    /// Largest number of members logged in full in addition to member 0: with it, as many as run
    /// side by side.
    pub const MOST_IN_FULL: usize = 7;

    /// Returns an ensemble of `members` members that are not spread yet.
    pub fn of(members: u64) -> Self {
        Self {
            members,
            seed: 0,
            attitude_spread_rad: 0.0,
            momentum_spread: 0.0,
            position_spread_m: None,
            velocity_spread_m_s: None,
            in_full: Vec::new(),
        }
    }

    /// Checks its form, for runs of this scenario.
    pub(super) fn check(&self, scenario: &Scenario) -> Check {
        let Self { members, seed, attitude_spread_rad, momentum_spread, in_full, .. } = self;
        let steps = scenario.step_count();
        ensure((2..=Self::MOST).contains(members), "/ensemble/members", || {
            format!("{members} given, 2 to {} are allowed", Self::MOST)
        })?;
        ensure(steps.saturating_mul(*members) <= MAX_STEPS, "/ensemble/members", || {
            format!("{members} members of {steps} steps make more than {MAX_STEPS} steps")
        })?;
        ensure(*seed <= LARGEST_SEED, "/ensemble/seed", || {
            format!("{seed} given, a seed is at most {LARGEST_SEED}")
        })?;
        let most = std::f64::consts::PI;
        spread("/ensemble/attitude_spread_rad", *attitude_spread_rad, most)?;
        spread("/ensemble/momentum_spread", *momentum_spread, MAX_SIZE)?;
        let has_free = scenario.bodies().is_some_and(|bodies| bodies.free().next().is_some());
        let of_free = [
            ("/ensemble/position_spread_m", self.position_spread_m),
            ("/ensemble/velocity_spread_m_s", self.velocity_spread_m_s),
        ];
        for (pointer, given) in of_free {
            let Some(given) = given else { continue };
            ensure(has_free, pointer, || {
                "is for scenes of several bodies with a free one, which has a position of its own"
                    .into()
            })?;
            spread(pointer, given, MAX_SIZE)?;
        }
        let control = scenario.scene.control.as_ref();
        let has_noise = control.is_some_and(|control| control.noise.is_some());
        let [(_, position), (_, velocity)] = of_free;
        let spreads = [Some(*attitude_spread_rad), Some(*momentum_spread), position, velocity];
        let differs = spreads.into_iter().flatten().any(|spread| spread > 0.0) || has_noise;
        ensure(differs, "/ensemble", || {
            let which = match (scenario.bodies(), has_free) {
                (None, _) => "`attitude_spread_rad` or `momentum_spread`, or noise to a control",
                (Some(_), false) => "`attitude_spread_rad` or `momentum_spread`",
                (Some(_), true) => {
                    "`attitude_spread_rad`, `momentum_spread`, `position_spread_m` or `velocity_spread_m_s`"
                }
            };
            format!("has no spread; give {which}")
        })?;
        ensure(in_full.len() <= Self::MOST_IN_FULL, "/ensemble/in_full", || {
            format!(
                "{} members given, at most {} are allowed in addition to member 0",
                in_full.len(),
                Self::MOST_IN_FULL
            )
        })?;
        let mut seen = HashSet::from([0]);
        for (i, member) in in_full.iter().enumerate() {
            let pointer = format!("/ensemble/in_full/{i}");
            ensure(member < members, pointer.clone(), || {
                format!("{member} given, the members are numbered from 0 to {}", members - 1)
            })?;
            ensure(seen.insert(*member), pointer, || {
                format!("names member {member} again; member 0 is always logged in full")
            })?;
        }
        Ok(())
    }
}
