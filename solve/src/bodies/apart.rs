//! Bodies that nothing acts on, n = 3: each moves exactly, by itself, and the others are solved without them.
//!
//! Invariant: the step of the others is that of a system without these, to the bit.

use nalgebra::Matrix3;

use super::motion::BodiesMotion;
use super::trajectory::BodiesStepper;
use super::{Bodies, BodiesState, Body, Hold, Interaction, Site};
use crate::failure::Failure;
use crate::nonlinear::Convergence;
use crate::so::{Mat, Vector};
use crate::so3::{self, Top};
use crate::stepper::splitting::PrincipalAxes;

/// The stepper.
pub struct BodiesApart {
    /// The bodies that nothing acts on, with their trees and axes.
    free: Vec<(usize, usize, PrincipalAxes)>,
    /// Of all; what it says of the others is that of the start.
    motion: BodiesMotion<3>,
    masses_kg: Vec<f64>,
    others: Option<Others>,
}

/// What is left without them.
struct Others {
    system: Bodies<3>,
    stepper: Box<dyn BodiesStepper<3>>,
    /// Their numbers in the whole, and those of their trees.
    bodies: Vec<usize>,
    trees: Vec<usize>,
}

impl Others {
    /// Returns the part of a state that is theirs.
    fn part(&self, state: &BodiesState<3>) -> BodiesState<3> {
        part(&self.bodies, &self.trees, state)
    }
}

fn part(bodies: &[usize], trees: &[usize], state: &BodiesState<3>) -> BodiesState<3> {
    BodiesState {
        attitudes: bodies.iter().map(|&a| state.attitudes[a]).collect(),
        momenta: bodies.iter().map(|&a| state.momenta[a]).collect(),
        places: trees.iter().map(|&tree| state.places[tree]).collect(),
        linear_momenta: trees.iter().map(|&tree| state.linear_momenta[tree]).collect(),
    }
}

impl BodiesApart {
    /// Returns the bodies whose steps of `step_s` seconds are taken by their exact motion: those that nothing acts on, but
    /// for one whose motion doubles do not give that far.
    pub fn exact(bodies: &Bodies<3>, state: &BodiesState<3>, step_s: f64) -> Vec<usize> {
        let moves = |&a: &usize| {
            let top = Top { momentum: so3::vee(&state.momenta[a]), ..Top::at_rest() };
            principal_axes(&bodies.bodies[a]).is_some_and(|axes| axes.free(&top, step_s).is_some())
        };
        (0..bodies.bodies.len()).filter(|&a| bodies.is_idle(a)).filter(moves).collect()
    }

    /// Creates the stepper in which the bodies `exact`, of [`Self::exact`], move by themselves, and `stepper` makes that of the
    /// system and the state of the others; `None` if something acts on one of them.
    pub fn new(
        exact: &[usize],
        bodies: &Bodies<3>,
        state: &BodiesState<3>,
        stepper: impl FnOnce(&Bodies<3>, &BodiesState<3>) -> Option<Box<dyn BodiesStepper<3>>>,
    ) -> Option<Self> {
        let alone = |&a: &usize| {
            let body = bodies.bodies.get(a).filter(|_| bodies.is_idle(a))?;
            Some((a, bodies.tree_of[a].0, principal_axes(body)?))
        };
        let free: Vec<_> = exact.iter().map(alone).collect::<Option<_>>()?;
        let rest: Vec<usize> = (0..bodies.bodies.len()).filter(|a| !exact.contains(a)).collect();
        let mut trees: Vec<usize> = rest.iter().map(|&a| bodies.tree_of[a].0).collect();
        trees.sort_unstable();
        trees.dedup();
        let others = if rest.is_empty() {
            None
        } else {
            let system = bodies.only(&rest)?;
            let stepper = stepper(&system, &part(&rest, &trees, state))?;
            Some(Others { system, stepper, bodies: rest, trees })
        };
        let masses_kg = bodies.bodies.iter().map(|body| body.mass_kg).collect();
        Some(Self { free, motion: BodiesMotion::new(state), masses_kg, others })
    }
}

impl BodiesStepper<3> for BodiesApart {
    fn order(&self) -> u32 {
        self.others.as_ref().map_or(u32::MAX, |others| others.stepper.order())
    }

    fn start(&mut self, state: &BodiesState<3>) {
        self.motion = BodiesMotion::new(state);
        if let Some(others) = &mut self.others {
            let own = others.part(state);
            others.stepper.start(&own);
        }
    }

    fn step(&mut self, bodies: &Bodies<3>, h: f64) -> Result<Convergence, Failure> {
        let drifts = self.free.iter().map(|(a, _, axes)| {
            let top = Top { momentum: so3::vee(self.motion.momentum(*a)), ..Top::at_rest() };
            axes.free(&top, h).map(|(drift, _)| drift).ok_or(Failure::not_finite(None))
        });
        let drifts: Vec<_> = drifts.collect::<Result<_, _>>()?;
        let solved = match &mut self.others {
            Some(Others { system, stepper, .. }) => {
                // Counted, and limited, as if it were the whole.
                system.work = bodies.work().clone();
                let solved = stepper.step(system, h);
                bodies.work().take_over(system.work());
                solved?
            }
            None => {
                bodies.work().begin_sweep()?;
                Convergence::EXPLICIT
            }
        };
        for ((a, tree, _), drift) in self.free.iter().zip(drifts) {
            let turn = so3::rotation(&drift.turn) - Mat::identity();
            let gain = so3::hat(&drift.momentum_increment);
            self.motion.turn(None, *a, [&turn, &Mat::zeros()], &gain);
            let way = self.motion.linear_momentum(*tree) * (h / self.masses_kg[*a]);
            self.motion.shift(*tree, &way, &Vector::zeros());
        }
        Ok(solved)
    }

    fn state(&self) -> BodiesState<3> {
        let mut state = self.motion.state();
        if let Some(Others { stepper, bodies, trees, .. }) = &self.others {
            let own = stepper.state();
            for (&a, (attitude, momentum)) in
                bodies.iter().zip(own.attitudes.iter().zip(&own.momenta))
            {
                (state.attitudes[a], state.momenta[a]) = (*attitude, *momentum);
            }
            for (&tree, (place, p)) in trees.iter().zip(own.places.iter().zip(&own.linear_momenta))
            {
                (state.places[tree], state.linear_momenta[tree]) = (*place, *p);
            }
        }
        state
    }
}

/// Returns the axes of a body in which its motion is computed; `None` if its inertia has no inverse.
pub(super) fn principal_axes(body: &Body<3>) -> Option<PrincipalAxes> {
    let moments = &body.second_moments;
    let inertia = Matrix3::identity() * moments.trace() - moments;
    Some(PrincipalAxes::of(&inertia.try_inverse()?))
}

impl<const N: usize> Bodies<N> {
    /// Is the body free, and does nothing act on it?
    fn is_idle(&self, body: usize) -> bool {
        let (tree, _) = self.tree_of[body];
        matches!(self.bodies[body].hold, Hold::Free)
            && self.trees[tree].bodies.len() == 1
            && !self.interactions.iter().any(|interaction| interaction.bodies().any(|a| a == body))
    }

    /// Returns the system of these bodies alone; `None` if another one is joined to them, or acts on them.
    fn only(&self, kept: &[usize]) -> Option<Self> {
        let number = |body: usize| kept.iter().position(|&kept| kept == body);
        let body = |&a: &usize| {
            let mut body = self.bodies.get(a)?.clone();
            if let Hold::Joint { parent: Some(parent), .. } = &mut body.hold {
                *parent = number(*parent)?;
            }
            Some(body)
        };
        let renumbered = |interaction: &Interaction<N>| {
            let mut own = interaction.clone();
            let rename = |body: &mut usize| -> Option<()> {
                *body = number(*body)?;
                Some(())
            };
            match &mut own {
                Interaction::Uniform { body, .. } | Interaction::GravityGradient { body, .. } => {
                    rename(body)?;
                }
                Interaction::Spring { sites, .. } | Interaction::PointSource { sites, .. } => {
                    for site in sites {
                        if let Site::Body(body, _) = site {
                            rename(body)?;
                        }
                    }
                }
                Interaction::MutualGravity { bodies, .. } => {
                    bodies.iter_mut().try_for_each(rename)?;
                }
            }
            Some(own)
        };
        let bodies = kept.iter().map(body).collect::<Option<_>>()?;
        let interactions = self.interactions.iter().map(renumbered).collect::<Option<_>>()?;
        Self::new(bodies, interactions).ok()
    }
}
