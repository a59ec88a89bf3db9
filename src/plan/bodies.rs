//! The plan of several bodies: their mathematical objects, and what is estimated of them.

use nalgebra::DMatrix;
use schemars::JsonSchema;
use serde::Serialize;

use super::adaptive::RAD_A_STAGE;
use super::model::{inertia_matrix, rungs, tableau, tableau_choice};
use super::rotation::{attitude, rows, skew};
use super::{
    ChannelPlan, Counts, FirstSteps, Formulation, Model, OwnSteps, Plan, TermPlan, channels,
};
use crate::log::schema::Channel;
use crate::method::Integrator;
use crate::scenario::{
    Bodies, Framed, Inertia, Interaction, Joint, PairLaw, PotentialTerm, SPACE, Scenario,
    ScenarioError, Solver, Stop,
};
use crate::solve::bodies::apart::BodiesApart;
use crate::solve::bodies::{self, BodiesCondition, BodiesState, BodiesStop, Hold, Site, Start};
use crate::solve::control::Target;
use crate::solve::nonlinear::StopRule;
use crate::solve::so::{self, Mat, Vector};
use crate::solve::stop::Condition;

/// Treatment of a body.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct BodyPlan {
    /// Its name.
    pub name: String,
    /// `free`, `pinned` or `jointed`.
    pub hold: &'static str,
    /// What acts on it.
    pub why: String,
    /// Whether it moves by its exact motion, apart from the others: nothing acts on it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub exact: bool,
}

/// Returns the system of the bodies of a scene, with the conditions that end its run, and its state at the start.
///
/// # Errors
/// Where the numbers of a body or of a condition make none, with the pointer of the field.
pub(crate) fn system<const N: usize>(
    scenario: &Scenario,
    scene: &Bodies,
) -> Result<(bodies::Bodies<N>, BodiesState<N>), ScenarioError> {
    let joints = scene.joint_of_each();
    let mut made = Vec::new();
    let mut starts = Vec::new();
    let mut momenta = Vec::new();
    for (index, body) in scene.bodies.iter().enumerate() {
        let at = format!("/scene/bodies/{index}");
        let joint = joints[index].map(|number| &scene.joints[number]);
        made.push(bodies::Body {
            second_moments: second_moments(&body.inertia),
            mass_kg: body.mass.unwrap_or_default(),
            hold: match (joint, &body.pivot) {
                (Some(joint), _) => hold(scene, joint),
                (None, Some(pivot)) => Hold::Pivot(vector(pivot)),
                (None, None) => Hold::Free,
            },
        });
        let given = &body.initial;
        let pointer = format!("{at}/initial/attitude");
        let turned = attitude(&pointer, given.attitude.as_ref(), N)?;
        let in_body = |framed: &Framed| -> Mat<N> {
            let skew = match framed {
                Framed::Body(entries) => skew(entries),
                Framed::Space(entries) => turned.transpose() * skew(entries) * &turned,
            };
            matrix(&skew)
        };
        if let (Some(_), Some(_)) = (&given.momentum, joint) {
            let message = "is given for a body in a joint, whose momentum depends on the others; give its angular_velocity";
            return Err(ScenarioError::invalid(format!("{at}/initial/momentum"), message));
        }
        let or_zero =
            |given: &Option<Vec<f64>>| given.as_deref().map_or_else(Vector::zeros, vector);
        let velocity = match (&given.linear_momentum, body.mass) {
            (Some(momentum), Some(mass)) => vector::<N>(momentum) / mass,
            _ => or_zero(&given.velocity),
        };
        starts.push(Start {
            attitude: matrix(&turned),
            angular_velocity: given.angular_velocity.as_ref().map_or_else(Mat::zeros, in_body),
            position: or_zero(&given.position),
            velocity,
        });
        momenta.push(given.momentum.as_ref().map(in_body));
    }
    let of_system = |error: bodies::BodiesError| match error {
        bodies::BodiesError::Inertia(body) => {
            let message = "is not positive definite";
            ScenarioError::invalid(format!("/scene/bodies/{body}/inertia"), message)
        }
        error => ScenarioError::invalid("/scene/bodies", error.to_string()),
    };
    let interactions = scene.potential.iter().map(|term| interaction(scene, term)).collect();
    let system = bodies::Bodies::new(made, interactions).map_err(of_system)?;
    let mut state = system.state(&starts);
    for (own, given) in state.momenta.iter_mut().zip(momenta) {
        *own = given.unwrap_or(*own);
    }
    // A singular or overflowing start is the scene's fault, and a run of it would end at once.
    let seen = system.seen(&state).filter(|seen| system.energy(&state, seen).total().is_finite());
    if seen.is_none() {
        let message = "makes no finite energy at the start: points of a singular term meet, or numbers are too large";
        return Err(ScenarioError::invalid("/scene/bodies", message));
    }
    let stops = stops(scenario, scene, &state)?;
    Ok((system.with_stops(stops), state))
}

/// Steps that adapt, and about how fast everything changes in their time, in rad/s.
type Adapting = Option<(OwnSteps, f64)>;

/// Returns the steps of bodies that adapt, if they do.
///
/// # Errors
/// Those of [`system`].
fn own_steps(scenario: &Scenario, scene: &Bodies, step_s: f64) -> Result<Adapting, ScenarioError> {
    fn of<const N: usize>(
        scenario: &Scenario,
        scene: &Bodies,
        step_s: f64,
    ) -> Result<Adapting, ScenarioError> {
        let (bodies, initial) = system::<N>(scenario, scene)?;
        Ok(scenario.adaptive().map(|asked| {
            let own = OwnSteps::of_bodies(&asked, step_s, &scene.potential, &bodies, &initial);
            let rate = own.scale_of_bodies().rate(&bodies, &initial);
            (own, rate)
        }))
    }
    match scenario.dimension() {
        2 => of::<2>(scenario, scene, step_s),
        3 => of::<3>(scenario, scene, step_s),
        4 => of::<4>(scenario, scene, step_s),
        5 => of::<5>(scenario, scene, step_s),
        6 => of::<6>(scenario, scene, step_s),
        7 => of::<7>(scenario, scene, step_s),
        _ => of::<8>(scenario, scene, step_s),
    }
}

/// Returns a step in seconds that a tableau of `stages` stages takes easily in the time of steps that adapt.
///
/// # Errors
/// Those of [`system`].
pub(super) fn easy_own_step_s(
    scenario: &Scenario,
    scene: &Bodies,
    stages: usize,
) -> Result<f64, ScenarioError> {
    let rate = own_steps(scenario, scene, 1.0)?.map_or(0.0, |(_, rate)| rate);
    Ok(RAD_A_STAGE * stages as f64 / rate)
}

/// Returns the conditions that end a run of bodies that begin at `initial`.
fn stops<const N: usize>(
    scenario: &Scenario,
    scene: &Bodies,
    initial: &BodiesState<N>,
) -> Result<Vec<BodiesStop<N>>, ScenarioError> {
    let stop = |(number, stop): (usize, &Stop)| {
        let body = stop.body.as_ref().and_then(|name| scene.number(name)).unwrap_or_default();
        let condition = match stop {
            Stop { angle_above_rad: Some(above), .. } => {
                let from = match &above.from {
                    Some(from) => {
                        let pointer = format!("/until/{number}/angle_above_rad/from");
                        matrix(&attitude(&pointer, Some(from), N)?)
                    }
                    None => initial.attitudes[body],
                };
                let from = Target::fixed(from);
                BodiesCondition::Of(body, Condition::AngleAbove(from, above.angle_rad))
            }
            Stop { rate_below_rad_s: Some(rate), .. } => {
                BodiesCondition::Of(body, Condition::RateBelow(*rate))
            }
            Stop { distance_below_m: Some(limit), .. } => {
                let sites = sites(scene, &limit.between, limit.points.as_ref());
                BodiesCondition::DistanceBelow(sites, limit.distance_m)
            }
            Stop { distance_above_m: Some(limit), .. } => {
                let sites = sites(scene, &limit.between, limit.points.as_ref());
                BodiesCondition::DistanceAbove(sites, limit.distance_m)
            }
            Stop { energy_error_above_j, .. } => {
                let energy = energy_error_above_j.unwrap_or(f64::MAX);
                BodiesCondition::Of(body, Condition::EnergyErrorAbove(energy))
            }
        };
        Ok(BodiesStop { condition, for_s: stop.for_s, exact: stop.exact })
    };
    scenario.until.iter().enumerate().map(stop).collect()
}

/// Returns the points of bodies, or of space, whose distance is looked at.
pub(crate) fn sites<const N: usize>(
    scene: &Bodies,
    between: &[String; 2],
    points: Option<&[Vec<f64>; 2]>,
) -> [Site<N>; 2] {
    std::array::from_fn(|i| {
        let point = points.map_or_else(Vector::zeros, |points| vector(&points[i]));
        match scene.number(&between[i]) {
            Some(body) => Site::Body(body, point),
            None => Site::Space(point),
        }
    })
}

fn vector<const N: usize>(given: &[f64]) -> Vector<N> {
    Vector::from_column_slice(given)
}

fn matrix<const N: usize>(given: &DMatrix<f64>) -> Mat<N> {
    Mat::from_fn(|i, j| given[(i, j)])
}

/// The second moments of an inertia. `d_1 = (J_2 + J_3 - J_1) / 2`, the difference of the two nearest first: of a thin body the
/// least moment is a small part of the others, and keeps its digits.
fn second_moments<const N: usize>(inertia: &Inertia) -> Mat<N> {
    match inertia {
        Inertia::Principal(moments) => {
            let of = |i: usize| {
                let [j, k] = [(i + 1) % 3, (i + 2) % 3].map(|other| moments[other]);
                let (near, far) =
                    if (j - moments[i]).abs() <= (k - moments[i]).abs() { (j, k) } else { (k, j) };
                ((near - moments[i]) + far) * 0.5
            };
            Mat::from_fn(|i, j| if i == j { of(i) } else { 0.0 })
        }
        Inertia::SecondMoments(moments) => {
            Mat::from_fn(|i, j| if i == j { moments[i] } else { 0.0 })
        }
        Inertia::Matrix(_) => {
            let inertia: Mat<N> = matrix(&inertia_matrix(inertia));
            let symmetric = (inertia + inertia.transpose()) * 0.5;
            Mat::identity() * (0.5 * symmetric.trace()) - symmetric
        }
    }
}

fn hold<const N: usize>(scene: &Bodies, joint: &Joint) -> Hold<N> {
    let [parent_point, own_point] = [0, 1].map(|i| vector(&joint.points[i]));
    Hold::Joint { parent: scene.number(&joint.between[0]), parent_point, own_point }
}

fn interaction<const N: usize>(scene: &Bodies, term: &Interaction) -> bodies::Interaction<N> {
    let number = |name: &str| scene.number(name).unwrap_or_default();
    match term {
        Interaction::Between { between, law } => {
            let [one, other] = [0, 1].map(|i| number(&between[i]));
            let sites = |points: &[Vec<f64>; 2]| {
                [Site::Body(one, vector(&points[0])), Site::Body(other, vector(&points[1]))]
            };
            match law {
                PairLaw::Spring(spring) => bodies::Interaction::Spring {
                    sites: sites(&spring.points),
                    stiffness: spring.stiffness,
                    rest_length: spring.rest_length,
                },
                PairLaw::PointSource(source) => bodies::Interaction::PointSource {
                    sites: sites(&source.points),
                    strength: source.strength,
                },
                PairLaw::MutualGravity(gravity) => bodies::Interaction::MutualGravity {
                    bodies: [one, other],
                    constant: gravity.constant,
                },
            }
        }
        Interaction::On { body, term } => {
            let body = number(body);
            let to_space = |point: &[f64], position: &[f64]| {
                [Site::Body(body, vector(point)), Site::Space(vector(position))]
            };
            match term {
                PotentialTerm::Uniform(uniform) => bodies::Interaction::Uniform {
                    body,
                    point: vector(&uniform.body_point),
                    weight: uniform.weight,
                    direction: vector(&uniform.direction),
                },
                PotentialTerm::Spring(spring) => bodies::Interaction::Spring {
                    sites: to_space(&spring.body_point, &spring.position),
                    stiffness: spring.stiffness,
                    rest_length: spring.rest_length,
                },
                PotentialTerm::PointSource(source) => bodies::Interaction::PointSource {
                    sites: to_space(&source.body_point, &source.position),
                    strength: source.strength,
                },
                PotentialTerm::GravityGradient(gradient) => {
                    let own = inertia_matrix(&scene.bodies[body].inertia);
                    let given = gradient.matrix.as_deref().map_or(own, rows);
                    bodies::Interaction::GravityGradient {
                        body,
                        strength: gradient.strength(),
                        matrix: so::symmetric_part(&matrix(&given)),
                        direction: vector(&gradient.direction),
                    }
                }
            }
        }
    }
}

impl Plan {
    /// Plans a scenario of several bodies, with a method and a step.
    ///
    /// # Errors
    /// Where the numbers make no bodies or no tableau, with the pointer of the field.
    pub(super) fn of_bodies(
        scenario: &Scenario,
        scene: &Bodies,
        step_s: f64,
    ) -> Result<Self, ScenarioError> {
        let n = scenario.dimension();
        let own = own_steps(scenario, scene, step_s)?;
        let chosen = own.is_none() && scenario.method.name.integrator().is_none();
        let exact = if n == 3 && chosen {
            let (bodies, initial) = system::<3>(scenario, scene)?;
            BodiesApart::exact(&bodies, &initial, step_s)
        } else {
            Vec::new()
        };
        let choice = tableau_choice(&scenario.method);
        let tableau = tableau(&choice, &scenario.method)?;
        let Solver { kind, tolerance, max_iterations } = scenario.method.solver;
        let stop =
            StopRule { tolerance, max_iterations, rungs: rungs(kind), ..StopRule::default() };
        let mut plan = Self::begun(scenario, step_s, Model::of_none(n, tableau, stop));
        plan.channels = channels(scenario);
        plan.own_steps = own.map(|(own_steps, _)| own_steps);
        plan.formulation = formulation(scenario, &plan);
        for (index, term) in scene.potential.iter().enumerate() {
            let why = match term {
                Interaction::On { body, .. } => format!("acts on {body}"),
                Interaction::Between { between: [one, other], .. } => {
                    format!("acts between {one} and {other}")
                }
            };
            let pointer = format!("/scene/potential/{index}");
            plan.potential.push(TermPlan { pointer, kept: true, why });
        }
        plan.bodies = scene
            .bodies
            .iter()
            .enumerate()
            .map(|(index, body)| {
                let jointed = scene.joints.iter().any(|joint| joint.between.contains(&body.name));
                let hold = match (scene.joint_of_each()[index], &body.pivot) {
                    (Some(_), _) => "jointed",
                    (None, Some(_)) => "pinned",
                    (None, None) => "free",
                };
                let terms = scene.potential.iter().filter(|term| match term {
                    Interaction::On { body: name, .. } => *name == body.name,
                    Interaction::Between { between, .. } => between.contains(&body.name),
                });
                let terms = terms.count();
                let exact = exact.contains(&index);
                let why = match (terms, jointed) {
                    (0, false) if exact => {
                        "nothing acts on it: moved exactly, by itself".to_owned()
                    }
                    (0, false) => "nothing acts on it".to_owned(),
                    (terms, false) => format!("{terms} terms act on it"),
                    (terms, true) => format!("in joints; {terms} terms act on it"),
                };
                BodyPlan { name: body.name.clone(), hold, why, exact }
            })
            .collect();
        plan.warnings.extend(
            scene
                .bodies
                .iter()
                .filter_map(|body| super::whole_turns(&body.name, body.initial.attitude.as_ref())),
        );
        plan.free_directions = conserved(scenario, scene);
        for ChannelPlan { topic, computes } in &mut plan.channels {
            *computes = match topic {
                Channel::Momentum if plan.free_directions < 2 => {
                    "the total momenta, angular about the origin and linear"
                }
                Channel::Momentum => {
                    "the total momenta, angular about the origin and linear, and the drift of the conserved angular part"
                }
                Channel::Solver => "how the steps were solved",
                _ => continue,
            };
        }
        plan.estimate(FirstSteps::default());
        Ok(plan)
    }

    /// Returns about what steps of several bodies cost, in nanoseconds.
    pub(super) fn work_of_bodies_ns(&self, work: Counts) -> f64 {
        /// Cost of a stage of a sweep, for a body and for a term, n = 3.
        const BODY_NS: f64 = 250.0;
        const TERM_NS: f64 = 90.0;
        /// For a body in a joint, times the bodies in joints.
        const JOINT_NS: f64 = 150.0;
        /// Parts of these that a stage costs which is computed once.
        const ONCE: f64 = 0.3;
        let Some(scene) = self.settled.bodies() else { return 0.0 };
        let size = libm::pow(self.dimension as f64 / 3.0, 3.0);
        let jointed = scene.joint_of_each().iter().flatten().count() as f64;
        let solved = self.bodies.iter().filter(|body| !body.exact).count();
        let of_stage = solved as f64 * BODY_NS * size
            + scene.potential.len() as f64 * TERM_NS
            + jointed * jointed * JOINT_NS * size;
        let stages = self.formulation.stages as f64;
        if matches!(self.formulation.method, Integrator::Vpd | Integrator::VpdAdaptive) {
            (work.sweeps + work.steps) * stages * of_stage
        } else {
            ONCE * work.sweeps * stages * of_stage
        }
    }
}

/// Returns the number of directions of space among which rotations of everything about the origin change nothing.
fn conserved(scenario: &Scenario, scene: &Bodies) -> usize {
    let mut vectors: Vec<&[f64]> = Vec::new();
    vectors.extend(scene.bodies.iter().filter_map(|body| body.pivot.as_deref()));
    for joint in scene.joints.iter().filter(|joint| joint.between[0] == SPACE) {
        vectors.push(&joint.points[0]);
    }
    for term in &scene.potential {
        if let Interaction::On { term, .. } = term {
            vectors.push(term.law().space_vector());
        }
    }
    let moved = vectors.into_iter().filter(|vector| vector.iter().any(|x| *x != 0.0));
    super::free_directions(scenario.dimension(), moved)
}

/// Chooses the integrator.
fn formulation(scenario: &Scenario, plan: &Plan) -> Formulation {
    let asked = match &plan.own_steps {
        Some(_) => Some(Integrator::VpdAdaptive),
        None => scenario.method.name.integrator(),
    };
    let method = asked.unwrap_or(Integrator::Vpd);
    let tableau = &plan.model.tableau;
    let (name, stages, order) = if method.is_composition() {
        let order = scenario.method.order.unwrap_or(4);
        let parts = crate::solve::composition::Composition::new(order);
        (None, parts.map_or(1, |composition| composition.parts().len()), order)
    } else if method.is_explicit() {
        (super::tableau_name(scenario), tableau.stages(), tableau.classical_order())
    } else {
        (super::tableau_name(scenario), tableau.stages(), tableau.order())
    };
    let why = match asked {
        Some(_) => "asked for",
        None => {
            "symplectic, all attitudes on the group to round-off, of the tableau's order, for any potential"
        }
    };
    Formulation {
        method,
        tableau: name,
        stages,
        order,
        carries_attitude: true,
        why,
        ..Formulation::default()
    }
}
