//! An ensemble in a scenario: how many members, and how they are spread.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::range::{Check, LARGEST_SEED, MAX_SIZE, MAX_STEPS, ensure, spread};
#[cfg(feature = "serve")]
use super::{Attitude, Entry, Framed, Initial, Scenario};

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
    /// Standard deviation of each component of the body momentum, in kg m^2/s.
    #[serde(default)]
    pub momentum_spread: f64,
    /// Members whose whole motion is logged in addition to that of member 0: at most seven.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub in_full: Vec<u64>,
}

#[cfg(feature = "serve")]
impl Scenario {
    /// Returns one member of its ensemble as a run of its own. It begins at `attitude`, a matrix
    /// row by row, and `momentum`, in body coordinates: for n = 3 the vector, else the entries
    /// above the diagonal, row by row. `None` if these are of another dimension.
    pub(crate) fn member(
        mut self,
        number: u64,
        attitude: &[f64],
        momentum: &[f64],
    ) -> Option<Self> {
        let n = self.dimension();
        if attitude.len() != n * n || momentum.len() != n * (n - 1) / 2 {
            return None;
        }
        let entries = match n {
            3 => momentum.iter().copied().map(Entry::Number).collect(),
            _ => {
                let mut rows = vec![vec![0.0; n]; n];
                let above = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
                for ((i, j), &entry) in above.zip(momentum) {
                    (rows[i][j], rows[j][i]) = (entry, -entry);
                }
                rows.into_iter().map(Entry::Row).collect()
            }
        };
        self.scene.initial = Initial {
            attitude: Some(Attitude::Matrix(attitude.chunks(n).map(<[f64]>::to_vec).collect())),
            orbit_frame: None,
            momentum: Some(Framed::Body(entries)),
            angular_velocity: None,
        };
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
            in_full: Vec::new(),
        }
    }

    /// Checks its form, for runs of `steps` with noise or without.
    pub(super) fn check(&self, steps: u64, has_noise: bool) -> Check {
        let Self { members, seed, attitude_spread_rad, momentum_spread, in_full } = self;
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
        let differs = *attitude_spread_rad > 0.0 || *momentum_spread > 0.0 || has_noise;
        ensure(differs, "/ensemble", || {
            "has no spread; give `attitude_spread_rad` or `momentum_spread`, or noise to a control"
                .into()
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
