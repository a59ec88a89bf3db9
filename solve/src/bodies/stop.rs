//! Conditions that end a run of several bodies before its time.

use super::trajectory::BodySample;
use super::{Bodies, Site};
use crate::so::{self, Vector};
use crate::stop::Condition;

/// A condition that ends a run of several bodies once it has held for some time: as [`crate::stop::Stop`].
#[derive(Clone, Debug, PartialEq)]
pub struct BodiesStop<const N: usize> {
    /// What must hold after a step.
    pub condition: BodiesCondition<N>,
    /// For how long it must hold, in s; zero for at once.
    pub for_s: f64,
    /// Whether the time at which it comes to hold is located within the step.
    pub exact: bool,
}

/// What may hold after a step.
#[derive(Clone, Debug, PartialEq)]
pub enum BodiesCondition<const N: usize> {
    /// A condition of a body, by number; its energy error is that of all.
    Of(usize, Condition<N>),
    /// Two points are nearer to each other than a distance in m.
    DistanceBelow([Site<N>; 2], f64),
    /// Two points are farther from each other than a distance in m.
    DistanceAbove([Site<N>; 2], f64),
}

impl<const N: usize> BodiesCondition<N> {
    /// Returns a number above zero where the condition holds, and continuous: at a time in seconds, for bodies that are seen so, and
    /// the energy error.
    pub(super) fn margin(
        &self,
        time_s: f64,
        seen: &[BodySample<N>],
        energy_error: impl Fn() -> f64,
    ) -> f64 {
        match self {
            Self::Of(body, condition) => {
                let BodySample { attitude, angular_velocity, .. } = &seen[*body];
                condition.margin(time_s, attitude, Some(*angular_velocity), energy_error)
            }
            Self::DistanceBelow(sites, distance_m) => distance_m - distance(sites, seen),
            Self::DistanceAbove(sites, distance_m) => distance(sites, seen) - distance_m,
        }
    }
}

/// Returns the distance of two points, in m.
pub fn distance<const N: usize>(sites: &[Site<N>; 2], seen: &[BodySample<N>]) -> f64 {
    let [one, other] = sites.each_ref().map(|site| place(site, seen));
    (one - other).norm()
}

fn place<const N: usize>(site: &Site<N>, seen: &[BodySample<N>]) -> Vector<N> {
    match site {
        Site::Body(body, point) => {
            let BodySample { attitude, position, .. } = &seen[*body];
            position + so::to_space(attitude, point)
        }
        Site::Space(point) => *point,
    }
}

impl<const N: usize> Bodies<N> {
    /// Returns the same system, of which a run ends where one of the conditions holds.
    ///
    /// # Panics
    /// If a condition is of a body that there is not.
    pub fn with_stops(self, stops: Vec<BodiesStop<N>>) -> Self {
        let of_site = |site: &Site<N>| match site {
            Site::Body(body, _) => Some(*body),
            Site::Space(_) => None,
        };
        let known = stops.iter().all(|stop| {
            let bodies = match &stop.condition {
                BodiesCondition::Of(body, _) => [Some(*body), None],
                BodiesCondition::DistanceBelow(sites, _)
                | BodiesCondition::DistanceAbove(sites, _) => sites.each_ref().map(of_site),
            };
            bodies.into_iter().flatten().all(|body| body < self.bodies.len())
        });
        assert!(known, "a condition is of bodies that there are");
        Self { stops, ..self }
    }

    /// The conditions that end a run.
    pub fn stops(&self) -> &[BodiesStop<N>] {
        &self.stops
    }
}
