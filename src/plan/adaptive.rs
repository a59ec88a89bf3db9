//! Adaptive steps near the point sources of a scene: near which of them, from where on, and how
//! long a step is easy.

use schemars::JsonSchema;
use serde::Serialize;

use super::{Model, ModelKinetic};
use crate::scenario::{Adaptive, Interaction, Mobility, PointSource, PotentialTerm};
use crate::solve::bodies::{Bodies, BodiesState, BodiesTimeScale};
use crate::solve::hamiltonian::TimeScale;

/// Steps in a time of their own.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct OwnSteps {
    /// The longest, in seconds: that far from all point sources.
    pub largest_step_s: f64,
    /// Distance in metres below which steps shorten, for each modelled term; 0 for one that is no
    /// point source, nor mutual gravity.
    pub near_m: Vec<f64>,
}

impl OwnSteps {
    /// Returns the adaptive steps of a scenario with the terms `given`, of which `modelled` are
    /// left.
    pub(super) fn new(
        asked: &Adaptive,
        step_s: f64,
        given: &[PotentialTerm],
        modelled: &[PotentialTerm],
    ) -> Self {
        let sources: Vec<&PointSource> =
            given.iter().filter_map(PotentialTerm::as_point_source).collect();
        let near_of = |k: usize| match asked.near_m.as_slice() {
            [] => length(&sources[k].body_point),
            [all] => *all,
            each => each[k],
        };
        // Sources between the same points count as one.
        let near = |term: &PotentialTerm| {
            let Some(own) = term.as_point_source() else { return 0.0 };
            let is_own = |other: &&PointSource| {
                (&other.body_point, &other.position) == (&own.body_point, &own.position)
            };
            let all = sources.iter().enumerate().filter(|(_, other)| is_own(other));
            all.map(|(k, _)| near_of(k)).fold(0.0, f64::max)
        };
        Self {
            largest_step_s: asked.largest_step_s.unwrap_or(step_s),
            near_m: modelled.iter().map(near).collect(),
        }
    }

    /// Returns the adaptive steps of several bodies under `terms`, which begin at `initial`.
    pub(super) fn of_bodies<const N: usize>(
        asked: &Adaptive,
        step_s: f64,
        terms: &[Interaction],
        bodies: &Bodies<N>,
        initial: &BodiesState<N>,
    ) -> Self {
        let own = BodiesTimeScale::of(bodies, initial);
        let mut given = asked.near_m.iter();
        let near = |(term, own): (&Interaction, &f64)| match asked.near_m.as_slice() {
            _ if !term.is_close() => 0.0,
            [] => *own,
            [all] => *all,
            _ => *given.next().unwrap_or(own),
        };
        Self {
            largest_step_s: asked.largest_step_s.unwrap_or(step_s),
            near_m: terms.iter().zip(own.near_m()).map(near).collect(),
        }
    }

    /// Returns the rate of their time.
    pub(crate) fn scale(&self) -> TimeScale {
        TimeScale::new(self.near_m.clone())
    }

    /// Returns the same of several bodies.
    pub(crate) fn scale_of_bodies(&self) -> BodiesTimeScale {
        BodiesTimeScale::new(self.near_m.clone())
    }
}

/// Turn in a stage of an easy step.
pub(super) const RAD_A_STAGE: f64 = 0.1;

impl Model {
    /// Returns a step in seconds that a tableau of `stages` stages takes easily in a time of its
    /// own. Near a source of strength s at the distance d turns go as fast as `sqrt(s |y|^2 / (J
    /// d^3))`, and sigma takes the last of it away. What is left is about the sum of the squares
    /// with near in the place of d, of those of the other terms, and of the start.
    pub(super) fn easy_own_step_s(&self, near_m: &[f64], stages: usize) -> f64 {
        let mobility = |y: &[f64]| match &self.kinetic {
            ModelKinetic::Principal { weights } => (0..y.len())
                .flat_map(|i| (0..i).map(move |j| (i, j)))
                .map(|(i, j)| weights[(i, j)] * (y[i] * y[i] + y[j] * y[j]))
                .fold(0.0, f64::max),
            ModelKinetic::Tensor { .. } => self.kinetic.mobility() * length(y) * length(y),
        };
        // The part of the start is the square of |Omega|.
        let mut square = match &self.kinetic {
            ModelKinetic::Principal { weights } => {
                self.momentum.component_mul(weights).norm_squared() / 2.0
            }
            ModelKinetic::Tensor { .. } => {
                self.momentum.norm_squared() / 2.0 * self.kinetic.mobility().powi(2)
            }
        };
        let mobility = Mobility { at: &mobility, most: self.kinetic.mobility() };
        for (term, near) in self.terms.iter().zip(near_m) {
            square += term.law().squared_rate(*near, &mobility);
        }
        RAD_A_STAGE * stages as f64 / square.sqrt()
    }
}

fn length(v: &[f64]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}
