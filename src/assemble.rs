//! 3 · Plan → body, stepper and state at the start, with their const size.
//!
//! Invariant: the only place that turns runtime n into const N.

use crate::plan::{Formulation, Motion, Plan};
use crate::scenario::MethodName;
use crate::solve::ensemble::{Apart, Members};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::lanes::WIDTH;
use crate::solve::stepper::Stepper;
use crate::solve::stepper::at_rest::AtRest;
use crate::solve::stepper::lgvi::Lgvi;
use crate::solve::stepper::quaternion_gauss::QuaternionGauss;
use crate::solve::stepper::rk::Rk;
use crate::solve::stepper::rkmk::Rkmk;
use crate::solve::stepper::splitting::Splitting;
use crate::solve::stepper::vpd::Vpd;
use crate::solve::stepper::vpd_lagrangian::VpdLagrangian;
use crate::solve::stepper::vpd_plane::{Plane, VpdPlane};
use crate::solve::stepper::vpd_reduced::VpdReduced;
use crate::solve::stepper::vpd_space::VpdSpace;
use crate::solve::stepper::vpd_space::ensemble::VpdEnsemble;
use crate::solve::stepper::vrkmk::Vrkmk;
use crate::solve::trajectory::State;

/// What a plan is made of once its size is known.
pub(crate) struct Assembly<const N: usize> {
    pub(crate) body: RigidBody<N>,
    pub(crate) stepper: Box<dyn Stepper<N>>,
    pub(crate) initial: State<N>,
    /// Of an ensemble.
    pub(crate) members: Option<Box<dyn Members<N>>>,
}

/// Something to be done with a planned body, whatever its n: a run that writes a log, a run of a study.
pub(crate) trait Task {
    /// What comes of it.
    type Output;

    /// Does it.
    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output;
}

/// Builds what the plan holds and hands it to `task`.
pub(crate) fn assembled<T: Task>(plan: &Plan, task: T) -> T::Output {
    macro_rules! for_dimension {
        ($($n:literal)*) => {
            match plan.dimension {
                3 => perform(plan, in_space, together, task),
                $($n => perform::<$n, T>(plan, in_any_dimension, |_| None, task),)*
                n => unreachable!("the plan refuses n = {n}"),
            }
        };
    }
    for_dimension!(2 4 5 6 7 8 9 10 11 12 13 14 15 16)
}

fn perform<const N: usize, T: Task>(
    plan: &Plan,
    stepper: impl Fn(&Plan) -> Option<Box<dyn Stepper<N>>>,
    together: impl Fn(&Plan) -> Option<Box<dyn Members<N>>>,
    task: T,
) -> T::Output {
    let stepper = || {
        let stepper = stepper(plan).expect("the plan refuses a method that cannot run the scene");
        match plan.formulation.motion {
            Motion::AtRest => Box::new(AtRest::new(stepper)),
            Motion::General | Motion::InPlane => stepper,
        }
    };
    let members = plan.ensemble.is_some().then(|| {
        together(plan).unwrap_or_else(|| Box::new(Apart(std::array::from_fn(|_| stepper()))))
    });
    let (body, initial) = plan.model.problem::<N>();
    task.perform(Assembly { body, stepper: stepper(), initial, members })
}

/// Members side by side, where that is quicker than one after the other; `None` elsewhere. (Free bodies go one after the
/// other: each step begins where that member's steps before lead.)
fn together(plan: &Plan) -> Option<Box<dyn Members<3>>> {
    match plan.formulation.method {
        MethodName::Auto | MethodName::Vpd => {
            Some(Box::new(VpdEnsemble::new(&plan.model.tableau, plan.model.stop)?))
        }
        _ => None,
    }
}

/// The stepper that the plan chose, of those for any n; `None` for the others.
fn in_any_dimension<const N: usize>(plan: &Plan) -> Option<Box<dyn Stepper<N>>> {
    let Formulation { method, carries_attitude, .. } = plan.formulation;
    let (tableau, stop) = (plan.model.tableau.clone(), plan.model.stop);
    Some(match method {
        MethodName::Auto | MethodName::Vpd => Box::new(Vpd::new(tableau, stop)),
        MethodName::VpdLagrangian => Box::new(VpdLagrangian::new(tableau, stop)),
        MethodName::VpdReduced => Box::new(VpdReduced::new(tableau, stop, carries_attitude)),
        MethodName::Vrkmk => Box::new(Vrkmk::new(tableau, stop)),
        MethodName::VrkmkProjected => Box::new(Vrkmk::new(tableau, stop).projected()),
        MethodName::Rkmk => Box::new(Rkmk::new(tableau)?),
        MethodName::Rk => Box::new(Rk::new(tableau, false)?),
        MethodName::RkProjected => Box::new(Rk::new(tableau, true)?),
        MethodName::Splitting | MethodName::Lgvi | MethodName::QuaternionGauss => return None,
    })
}

/// The stepper that the plan chose, for n = 3.
fn in_space(plan: &Plan) -> Option<Box<dyn Stepper<3>>> {
    let stepper = out_of_plane(plan)?;
    let (body, start) = plan.model.problem::<3>();
    let plane = Plane::of(&body, &start).filter(|_| plan.formulation.motion == Motion::InPlane);
    let (tableau, stop) = (&plan.model.tableau, plan.model.stop);
    Some(match plane {
        Some(plane) => Box::new(VpdPlane::new(plane, tableau.clone(), stop, stepper)),
        None => stepper,
    })
}

/// The same wherever the body goes.
fn out_of_plane(plan: &Plan) -> Option<Box<dyn Stepper<3>>> {
    let Formulation { method, order, stages, carries_attitude, .. } = plan.formulation;
    let (tableau, stop) = (&plan.model.tableau, plan.model.stop);
    Some(match method {
        // As many stages as there are lanes; more of them go the way of general n.
        MethodName::Auto | MethodName::Vpd if stages <= WIDTH => {
            Box::new(VpdSpace::new(tableau.clone(), stop)?)
        }
        MethodName::VpdReduced if stages <= WIDTH => {
            Box::new(VpdSpace::new(tableau.clone(), stop)?.reduced(carries_attitude))
        }
        MethodName::Splitting => Box::new(Splitting::new(order)?),
        MethodName::Lgvi => Box::new(Lgvi::new(order, stop)?),
        MethodName::QuaternionGauss => Box::new(QuaternionGauss::new(stages, stop)?),
        _ => return in_any_dimension(plan),
    })
}
