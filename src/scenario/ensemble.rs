//! An ensemble in a scenario: how many members, and how they are spread.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::check::{Check, LARGEST_SEED, MAX_SIZE, MAX_STEPS, SMALLEST_SIZE, ensure};

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

impl Ensemble {
    /// The most members.
    pub const MOST: u64 = 100_000;
    /// The most members logged in full in addition to member 0: with it, as many as go side by side.
    pub const MOST_IN_FULL: usize = 7;

    /// Checks its form, for runs of `steps`.
    pub(super) fn check(&self, steps: u64) -> Check {
        let Self { members, seed, attitude_spread_rad, momentum_spread, in_full } = self;
        ensure((2..=Self::MOST).contains(members), "/ensemble/members", || {
            format!("{members} given, their number lies from 2 to {}", Self::MOST)
        })?;
        ensure(steps.saturating_mul(*members) <= MAX_STEPS, "/ensemble/members", || {
            format!("{members} members of {steps} steps make more than {MAX_STEPS} steps")
        })?;
        ensure(*seed <= LARGEST_SEED, "/ensemble/seed", || {
            format!("{seed} given, a seed is at most {LARGEST_SEED}")
        })?;
        ensure(
            (0.0..=std::f64::consts::PI).contains(attitude_spread_rad),
            "/ensemble/attitude_spread_rad",
            || format!("{attitude_spread_rad:e} given, a spread of turns lies from 0 to pi"),
        )?;
        ensure((0.0..=MAX_SIZE).contains(momentum_spread), "/ensemble/momentum_spread", || {
            format!("{momentum_spread:e} given, a spread lies from 0 to {MAX_SIZE:e}")
        })?;
        for (name, spread) in
            [("attitude_spread_rad", attitude_spread_rad), ("momentum_spread", momentum_spread)]
        {
            ensure(
                *spread == 0.0 || *spread >= SMALLEST_SIZE,
                format!("/ensemble/{name}"),
                || format!("{spread:e} given, a spread is 0 or at least {SMALLEST_SIZE:e}"),
            )?;
        }
        ensure(*attitude_spread_rad > 0.0 || *momentum_spread > 0.0, "/ensemble", || {
            "has no spread; give `attitude_spread_rad` or `momentum_spread`".into()
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
