//! 3 · Plan → body, stepper and state at the start, with their const size.
//!
//! Invariant: what runs gets its const N here; `plan/bodies.rs` does the same for what it looks at.

use std::any::Any;

use crate::method::{Integrator, Parts};
use crate::plan::bodies::system;
use crate::plan::{Motion, Plan};
use crate::solve::bodies::apart::BodiesApart;
use crate::solve::bodies::explicit::{Attitudes, BodiesRk};
use crate::solve::bodies::splitting::BodiesSplitting;
use crate::solve::bodies::trajectory::BodiesStepper;
use crate::solve::bodies::vpd::BodiesVpd;
use crate::solve::bodies::vpd_adaptive::BodiesVpdAdaptive;
use crate::solve::bodies::{Bodies, BodiesState};
use crate::solve::ensemble::{Members, Sequential};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::nonlinear::Rungs;
use crate::solve::state::State;
use crate::solve::stepper::Stepper;
use crate::solve::stepper::at_rest::AtRest;
use crate::solve::stepper::controlled::Controlled;
use crate::solve::stepper::vpd_plane::{Plane, VpdPlane};
use crate::solve::tangent::WithDerivatives;

/// Parts that are made from a plan once its size is known.
pub(crate) struct Assembly<const N: usize> {
    pub(crate) body: RigidBody<N>,
    pub(crate) stepper: Box<dyn Stepper<N>>,
    pub(crate) initial: State<N>,
    /// Members of an ensemble.
    pub(crate) members: Option<Box<dyn Members<N>>>,
    /// A second stepper of the same kind, to follow a motion next to the run.
    pub(crate) shadow: Option<Box<dyn Stepper<N>>>,
}

/// Task for a planned body, whatever its n: a run that writes a log, a run of a study.
pub(crate) trait Task {
    /// Result of the task.
    type Output;

    /// Returns whether a second stepper is needed.
    fn has_shadow(&self) -> bool {
        false
    }

    /// Performs the task.
    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output;
}

/// Builds what the plan holds and hands it to `task`.
pub(crate) fn assembled<T: Task>(plan: &Plan, task: T) -> T::Output {
    let shadow = task.has_shadow();
    macro_rules! for_dimension {
        ($($n:literal)*) => {
            match plan.dimension {
                3 => task.perform(assembly(plan, in_three_dimensions, together, shadow)),
                $($n => task.perform(assembly::<$n>(plan, in_any_dimension, |_| None, shadow)),)*
                n => unreachable!("the plan refuses n = {n}"),
            }
        };
    }
    for_dimension!(2 4 5 6 7 8 9 10 11 12 13 14 15 16 32)
}

fn assembly<const N: usize>(
    plan: &Plan,
    stepper: fn(&Plan) -> Option<Box<dyn Stepper<N>>>,
    together: fn(&Plan) -> Option<Box<dyn Members<N>>>,
    shadow: bool,
) -> Assembly<N> {
    let (body, initial) = plan.model.problem::<N>();
    let stepper = || -> Box<dyn Stepper<N>> {
        let stepper = stepper(plan).expect("the plan refuses a method that cannot run the scene");
        match plan.formulation.motion {
            Motion::AtRest => Box::new(AtRest::new(stepper)),
            Motion::General | Motion::InPlane if body.control().is_some() => {
                let controlled = Controlled::new(stepper, body.clone());
                Box::new(controlled.expect("the body has a control"))
            }
            Motion::General | Motion::InPlane => match &plan.settled.derivatives {
                Some(asked) => {
                    let tableau = plan.model.tableau.clone();
                    let with = WithDerivatives::new(
                        stepper,
                        &body,
                        tableau,
                        asked.state,
                        plan.parameters(),
                    );
                    let with = with.expect("the scenario was checked: nothing drives the body");
                    Box::new(match plan.uncertainty() {
                        Some(uncertainty) => with.with_uncertainty(uncertainty),
                        None => with,
                    })
                }
                None => stepper,
            },
        }
    };
    let together = |plan: &Plan| together(plan).filter(|_| body.control().is_none());
    let members = plan.ensemble.is_some().then(|| {
        together(plan)
            .unwrap_or_else(|| Box::new(Sequential::new(std::array::from_fn(|_| stepper()))))
    });
    let shadow = shadow.then(stepper);
    let stepper = stepper();
    Assembly { body, stepper, initial, members, shadow }
}

/// Returns the parts from which the stepper of the plan's method is made.
fn parts(plan: &Plan) -> Parts {
    Parts {
        tableau: plan.model.tableau.clone(),
        order: plan.formulation.order,
        stop: plan.model.stop,
        carries_attitude: plan.formulation.carries_attitude,
        own_steps: plan.own_steps.as_ref().map(|own| (own.scale(), own.largest_step_s)),
    }
}

fn together(plan: &Plan) -> Option<Box<dyn Members<3>>> {
    plan.formulation.method.side_by_side(&parts(plan))
}

/// Returns the stepper that the plan chose, of those for any n; `None` for the others.
fn in_any_dimension<const N: usize>(plan: &Plan) -> Option<Box<dyn Stepper<N>>> {
    plan.formulation.method.in_any_dimension(parts(plan))
}

/// Returns the stepper that the plan chose, for n = 3.
fn in_three_dimensions(plan: &Plan) -> Option<Box<dyn Stepper<3>>> {
    let method = plan.formulation.method;
    // The reduced form has wheels in matrices alone; Newton's method for a driven body goes farther there.
    let model = &plan.model;
    let spins = model.wheels.is_some() || model.control.has_wheels();
    let wheels = method == Integrator::VpdReduced && spins;
    if wheels || model.is_driven() && model.stop.rungs == Rungs::Newton {
        return method.in_any_dimension(parts(plan));
    }
    let stepper = method.in_three_dimensions(parts(plan))?;
    let (body, start) = plan.model.problem::<3>();
    let plane = Plane::of(&body, &start).filter(|_| plan.formulation.motion == Motion::InPlane);
    let (tableau, stop) = (&plan.model.tableau, plan.model.stop);
    Some(match plane {
        Some(plane) => Box::new(VpdPlane::new(plane, tableau.clone(), stop, stepper)),
        None => stepper,
    })
}

/// Parts that are made from a plan of several bodies once their n is known.
pub(crate) struct BodiesAssembly<const N: usize> {
    pub(crate) bodies: Bodies<N>,
    pub(crate) stepper: Box<dyn BodiesStepper<N>>,
    pub(crate) initial: BodiesState<N>,
    /// Steppers for the members of an ensemble that are logged in full; none without one.
    pub(crate) members: Vec<Box<dyn BodiesStepper<N>>>,
}

/// Task for several planned bodies, whatever their n.
pub(crate) trait BodiesTask {
    /// Result of the task.
    type Output;

    /// Performs the task.
    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Self::Output;
}

/// Builds the bodies that the plan holds and hands them to `task`.
///
/// # Panics
/// If the plan is not of several bodies.
pub(crate) fn assembled_bodies<T: BodiesTask>(plan: &Plan, task: T) -> T::Output {
    fn perform<const N: usize, T: BodiesTask>(plan: &Plan, task: T) -> T::Output {
        let scene = plan.settled.bodies().expect("a plan of several bodies");
        let (bodies, initial) = system::<N>(&plan.settled, scene).expect("the plan made them");
        let stepper = || {
            bodies_stepper(plan, &bodies, &initial)
                .expect("the plan refuses a method that cannot run the scene")
        };
        let in_full = plan.ensemble.iter().flat_map(|ensemble| &ensemble.in_full);
        let members = in_full.map(|_| stepper()).collect();
        let stepper = stepper();
        task.perform(BodiesAssembly { bodies, stepper, initial, members })
    }
    macro_rules! at {
        ($n:literal) => {
            perform::<$n, T>(plan, task)
        };
    }
    match plan.dimension {
        2 => at!(2),
        3 => at!(3),
        4 => at!(4),
        5 => at!(5),
        6 => at!(6),
        7 => at!(7),
        8 => at!(8),
        n => unreachable!("a scenario refuses several bodies with n = {n}"),
    }
}

/// Returns the stepper that the plan chose for several bodies.
fn bodies_stepper<const N: usize>(
    plan: &Plan,
    bodies: &Bodies<N>,
    initial: &BodiesState<N>,
) -> Option<Box<dyn BodiesStepper<N>>> {
    let exact: Vec<usize> = (0..plan.bodies.len()).filter(|&a| plan.bodies[a].exact).collect();
    if exact.is_empty() {
        return coupled_stepper(plan, bodies, initial);
    }
    let (bodies, initial) = in_three(bodies, initial)?;
    let others =
        |bodies: &Bodies<3>, initial: &BodiesState<3>| coupled_stepper(plan, bodies, initial);
    of_three(Box::new(BodiesApart::new(&exact, bodies, initial, others)?))
}

/// Returns the stepper of bodies that something acts on.
fn coupled_stepper<const N: usize>(
    plan: &Plan,
    bodies: &Bodies<N>,
    initial: &BodiesState<N>,
) -> Option<Box<dyn BodiesStepper<N>>> {
    let tableau = plan.model.tableau.clone();
    let explicit = |kind| -> Option<Box<dyn BodiesStepper<N>>> {
        Some(Box::new(BodiesRk::new(tableau.clone(), kind, initial)?))
    };
    match plan.formulation.method {
        Integrator::RkProjected => explicit(Attitudes::Projected),
        Integrator::Rkmk => explicit(Attitudes::Lie),
        Integrator::Splitting => {
            let (bodies, initial) = in_three(bodies, initial)?;
            of_three(Box::new(BodiesSplitting::new(plan.formulation.order, bodies, initial)?))
        }
        Integrator::VpdAdaptive => {
            let own = plan.own_steps.as_ref()?;
            let scale = own.scale_of_bodies();
            let stepper = BodiesVpdAdaptive::new(tableau, plan.model.stop, scale, initial);
            Some(Box::new(stepper.with_steps_of(own.largest_step_s)))
        }
        _ => Some(Box::new(BodiesVpd::new(tableau.clone(), plan.model.stop, initial))),
    }
}

/// Returns bodies of n = 3 as such, which the compiler does not know.
fn in_three<'a, const N: usize>(
    bodies: &'a Bodies<N>,
    initial: &'a BodiesState<N>,
) -> Option<(&'a Bodies<3>, &'a BodiesState<3>)> {
    let (bodies, initial): (&dyn Any, &dyn Any) = (bodies, initial);
    Some((bodies.downcast_ref()?, initial.downcast_ref()?))
}

/// Returns a stepper of n = 3 as one of this dimension, which it is.
fn of_three<const N: usize>(
    stepper: Box<dyn BodiesStepper<3>>,
) -> Option<Box<dyn BodiesStepper<N>>> {
    let stepper: Box<dyn Any> = Box::new(stepper);
    stepper.downcast().ok().map(|stepper| *stepper)
}
