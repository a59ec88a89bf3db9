//! A scene of several bodies: pinned, free or jointed, with a potential of one body and of pairs.
//!
//! Invariant: after [`Bodies::check`] every name is that of a body, all bodies have the same n, and the joints make trees:
//! each body has one parent at most. Whether the points of a joint meet at the start is for [`crate::plan`].

use std::collections::{HashMap, HashSet};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::json;

use super::range::{
    Check, MAX_SIZE, SMALLEST_SIZE, attitude, ensure, framed, inertia, number, point, size,
    strength,
};
use super::{
    Attitude, DistanceLimit, Framed, Inertia, Initial, Method, MethodName, PotentialTerm, Scenario,
    ScenarioError, Scene, SolverKind, Stop,
};
use crate::log::schema::BodyName;
use crate::method::Integrator;

/// Name of what does not move, the parent of a body that a joint holds at a point of space.
pub const SPACE: &str = "space";
/// Most bodies of a scene.
const MOST_BODIES: usize = 64;
/// Most bodies of a tree of joints: its mass matrix is dense.
const MOST_IN_A_TREE: usize = 16;
/// Most terms of the potential: more than there are pairs.
const MOST_TERMS: usize = 4096;
/// Largest n of several bodies.
const MAX_DIMENSION: usize = 8;
/// Message for a field of one body next to `bodies`.
pub(super) const TOGETHER: &str =
    "is given together with `bodies`, each of which has its own `inertia` and `initial`";

/// Several bodies.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct Bodies {
    /// The bodies, 1 to 64, all of one n.
    pub bodies: Vec<Body>,
    /// The terms of the potential, each on one `body` or `between` two.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub potential: Vec<Interaction>,
    /// The joints: trees of at most 16 bodies.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joints: Vec<Joint>,
}

/// A body of several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Body {
    /// Its name: 1 to 40 letters, digits, `_` or `-`, a letter first.
    pub name: String,
    /// Mass in kg, for a body that is not pinned.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mass: Option<f64>,
    /// The point of space about which a pinned body turns; a body without it is free, or held by a joint.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pivot: Option<Vec<f64>>,
    /// Inertia about the pivot, or about the centre of mass; n follows from it.
    pub inertia: Inertia,
    /// State at the start.
    #[serde(default, skip_serializing_if = "BodyInitial::is_default")]
    pub initial: BodyInitial,
}

/// The state of a body at t = 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BodyInitial {
    /// Free bodies: the centre of mass in space, in m; the origin if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<Vec<f64>>,
    /// Free bodies: the velocity of the centre of mass in space coordinates, in m/s; either this or `linear_momentum`, at
    /// rest if both are absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity: Option<Vec<f64>>,
    /// Free bodies: the linear momentum in space coordinates, in kg m/s; either this or `velocity`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linear_momentum: Option<Vec<f64>>,
    /// The attitude; the identity if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<Attitude>,
    /// The angular velocity; either this or `momentum`, at rest if both are absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angular_velocity: Option<Framed>,
    /// The angular momentum; either this or `angular_velocity`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub momentum: Option<Framed>,
}

impl BodyInitial {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// One term of the potential of several bodies.
// Read by hand, in `parse`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Interaction {
    /// A term that acts on one body, as in a scene of one: the points of a free body move with its position.
    On {
        /// The term; first, because reading begins with its kind.
        #[serde(flatten)]
        term: PotentialTerm,
        /// Name of the body.
        body: String,
    },
    /// A term that acts on two bodies.
    Between {
        /// Names of the bodies.
        between: [String; 2],
        /// Its law.
        #[serde(flatten)]
        law: PairLaw,
    },
}

/// The laws between two bodies a and b; r_ab is the vector from the point of b to that of a.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum PairLaw {
    /// stiffness / 2 * (|r_ab| - rest_length)^2
    Spring(PairSpring),
    /// strength / |r_ab|
    PointSource(PairSource),
    /// n = 3: -constant (m_a m_b / r + (m_b (tr J_a - 3 u . J_a u) + m_a (tr J_b - 3 u . J_b u)) / (2 r^3)), u the unit
    /// vector between the centres of mass in the coordinates of each body
    MutualGravity(MutualGravity),
}

/// Value of `kind` next to `between`.
#[derive(Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PairKind {
    Spring,
    PointSource,
    MutualGravity,
}

impl PairKind {
    /// Reads a law of this kind from the other fields.
    pub(super) fn read<'de, D: Deserializer<'de>>(self, fields: D) -> Result<PairLaw, D::Error> {
        match self {
            Self::Spring => PairSpring::deserialize(fields).map(PairLaw::Spring),
            Self::PointSource => PairSource::deserialize(fields).map(PairLaw::PointSource),
            Self::MutualGravity => MutualGravity::deserialize(fields).map(PairLaw::MutualGravity),
        }
    }
}

impl PairLaw {
    pub(super) const MUTUAL_GRAVITY: &'static str = "mutual_gravity";
}

/// A spring between points of two bodies.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PairSpring {
    /// A point of each body, in its coordinates.
    pub points: [Vec<f64>; 2],
    /// Stiffness in N/m.
    pub stiffness: f64,
    /// Length at rest in m, at least 0.
    #[serde(default)]
    pub rest_length: f64,
}

/// Points of two bodies that attract or repel each other.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PairSource {
    /// A point of each body, in its coordinates.
    pub points: [Vec<f64>; 2],
    /// Strength; positive repels.
    pub strength: f64,
}

/// The gravity of two bodies, to the second degree in their extents.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MutualGravity {
    /// The constant of gravity in the units of the scene: 6.674e-11 m^3/(kg s^2) in SI.
    pub constant: f64,
}

/// A joint between two bodies.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Joint {
    /// Kind of joint.
    pub kind: JointKind,
    /// Names of the parent and of the body it holds; the parent may be `space`, which does not move.
    pub between: [String; 2],
    /// The point of each that is the same: in its body's coordinates; for `space` a point of space.
    pub points: [Vec<f64>; 2],
}

/// The kinds of joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// Holds a point and leaves all turns free.
    Ball,
}

impl Serialize for Scene {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match &self.bodies {
            Some(bodies) => bodies.serialize(serializer),
            None => Self::serialize(self, serializer),
        }
    }
}

/// Returns the schema of a scene: of one body, or of several.
pub(super) fn scene_schema(generator: &mut SchemaGenerator) -> Schema {
    json_schema!({
        "anyOf": [generator.subschema_for::<Scene>(), generator.subschema_for::<Bodies>()]
    })
}

impl Interaction {
    /// Returns whether steps can adapt to it: it is a point source, or mutual gravity.
    pub(crate) fn is_close(&self) -> bool {
        match self {
            Self::On { term, .. } => term.as_point_source().is_some(),
            Self::Between { law, .. } => !matches!(law, PairLaw::Spring(_)),
        }
    }
}

impl JsonSchema for Interaction {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Interaction".into()
    }

    /// Returns the forms of terms and of laws, each with its field that names what it acts on.
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let mut body = String::json_schema(generator);
        body.insert("description".into(), "Name of the body.".into());
        let mut between = <[String; 2]>::json_schema(generator);
        between.insert("description".into(), "Names of the two bodies.".into());
        let forms = |schema: Schema, key: &str, value: Schema| {
            let forms = schema.get("oneOf").and_then(|forms| forms.as_array().cloned());
            let with_key = forms.unwrap_or_default().into_iter().map(move |mut form| {
                form["properties"][key] = value.clone().to_value();
                if let Some(required) = form["required"].as_array_mut() {
                    required.push(json!(key));
                }
                form
            });
            with_key.collect::<Vec<_>>()
        };
        let mut all = forms(PotentialTerm::json_schema(generator), "body", body);
        all.extend(forms(PairLaw::json_schema(generator), "between", between));
        json_schema!({
            "oneOf": all,
            "description": "One term of the potential, on one `body` or `between` two.",
        })
    }
}

/// Checks what stands next to `bodies`: what several bodies cannot have yet.
pub(super) fn check(scenario: &Scenario, bodies: &Bodies) -> Check {
    let Scene { inertia, potential, driven, torques, wheels, control, field, initial, .. } =
        &scenario.scene;
    let absent =
        |given: bool, pointer: &str, message: &str| ensure(!given, pointer, || message.to_owned());
    absent(inertia.is_some(), "/scene/inertia", TOGETHER)?;
    absent(*initial != Initial::default(), "/scene/initial", TOGETHER)?;
    absent(!potential.is_empty(), "/scene/potential", "has a term that names no body")?;
    let only_one = "is given together with `bodies`; it is for scenes of one body";
    absent(!driven.is_empty(), "/scene/driven", only_one)?;
    absent(!torques.is_empty(), "/scene/torques", only_one)?;
    absent(wheels.is_some(), "/scene/wheels", only_one)?;
    absent(control.is_some(), "/scene/control", only_one)?;
    absent(field.is_some(), "/scene/field", only_one)?;
    absent(scenario.pointing.is_some(), "/pointing", only_one)?;
    absent(scenario.derivatives.is_some(), "/derivatives", only_one)?;
    let expected = scenario.expect.as_ref().is_some_and(|expect| expect.final_attitude.is_some());
    absent(expected, "/expect/final_attitude", only_one)?;
    bodies.take(&scenario.method)?;
    bodies.check()
}

/// The methods of several bodies.
const METHODS: [Integrator; 5] = [
    Integrator::Vpd,
    Integrator::VpdAdaptive,
    Integrator::RkProjected,
    Integrator::Rkmk,
    Integrator::Splitting,
];

impl Bodies {
    /// Checks that a method can run the bodies.
    ///
    /// # Errors
    /// At its field, with what is allowed.
    pub(crate) fn take(&self, method: &Method) -> Check {
        let name = method.name;
        let listed = name.integrator().is_none_or(|method| METHODS.contains(&method));
        ensure(listed, "/method/name", || {
            let names = METHODS.map(Integrator::as_str).join(", ");
            format!("{} given; for several bodies auto, {names} are allowed", name.as_str())
        })?;
        let splits = name == MethodName::Splitting;
        ensure(!splits || self.joints.is_empty(), "/method/name", || {
            "splitting given; it is for bodies without joints, whose kinetic energies are separate"
                .to_owned()
        })?;
        let newton = method.solver.kind == SolverKind::Newton;
        ensure(!newton, "/method/solver/kind", || {
            "\"newton\" given; for several bodies fixed_point and auto are allowed".to_owned()
        })
    }

    /// Returns the number of the body with a name.
    pub fn number(&self, name: &str) -> Option<usize> {
        self.bodies.iter().position(|body| body.name == name)
    }

    /// Returns the bodies that move freely.
    pub fn free(&self) -> impl Iterator<Item = &Body> {
        let is_held = |body: &Body| self.joints.iter().any(|joint| joint.between[1] == body.name);
        self.bodies.iter().filter(move |body| body.pivot.is_none() && !is_held(body))
    }

    /// Returns for each body the number of the joint that holds it at its parent.
    pub fn joint_of_each(&self) -> Vec<Option<usize>> {
        let held = |body: &Body| self.joints.iter().position(|joint| joint.between[1] == body.name);
        self.bodies.iter().map(held).collect()
    }

    fn check(&self) -> Check {
        let at = "/scene/bodies";
        let count = self.bodies.len();
        ensure((1..=MOST_BODIES).contains(&count), at, || {
            format!("{count} bodies given, 1 to {MOST_BODIES} are allowed")
        })?;
        let mut names = HashSet::new();
        for (i, body) in self.bodies.iter().enumerate() {
            let name = &body.name;
            let pointer = format!("{at}/{i}/name");
            is_name(&pointer, name)?;
            ensure(names.insert(name.as_str()), pointer, || {
                format!("`{name}` given, which an earlier body is named")
            })?;
        }
        for (i, body) in self.bodies.iter().enumerate() {
            let name = &body.name;
            for (suffix, both) in [
                ("_angular", "the velocity of one and the angular velocity of the other"),
                ("_initial", "the end of one and the start of the other"),
            ] {
                let other = name.strip_suffix(suffix).filter(|other| names.contains(other));
                ensure(other.is_none(), format!("{at}/{i}/name"), || {
                    let other = other.unwrap_or_default();
                    format!(
                        "`{name}` given next to `{other}`: in tables, {both} would have one name"
                    )
                })?;
            }
        }
        let n = self.dimension()?;
        // First, because whether a body is free depends on them.
        self.check_joints(n)?;
        for (i, body) in self.bodies.iter().enumerate() {
            let jointed = self.joints.iter().any(|joint| joint.between[1] == body.name);
            body.check(&format!("{at}/{i}"), n, jointed)?;
        }
        let at = "/scene/potential";
        let count = self.potential.len();
        ensure(count <= MOST_TERMS, at, || {
            format!("{count} terms given, at most {MOST_TERMS} are allowed")
        })?;
        let mut terms = self.potential.iter().enumerate();
        terms.try_for_each(|(i, term)| self.check_term(&format!("{at}/{i}"), term, n))
    }

    /// Returns n, the same for all bodies.
    fn dimension(&self) -> Result<usize, ScenarioError> {
        let mut first = None;
        for (i, body) in self.bodies.iter().enumerate() {
            let at = format!("/scene/bodies/{i}/inertia");
            inertia(&at, &body.inertia)?;
            let n = body.inertia.dimension();
            ensure(n <= MAX_DIMENSION, &at, || {
                format!("is for n = {n}; for several bodies n = 2 to {MAX_DIMENSION} are allowed")
            })?;
            let first = *first.get_or_insert(n);
            ensure(n == first, at, || {
                format!("is for n = {n}, the first body has n = {first}; all bodies need one n")
            })?;
        }
        Ok(first.unwrap_or_default())
    }

    /// Returns the number of a body, whose name stands at `pointer`.
    pub(crate) fn known(&self, pointer: &str, name: &str) -> Result<usize, ScenarioError> {
        self.number(name).ok_or_else(|| {
            let names = || self.bodies.iter().map(|body| body.name.as_str());
            let else_ = match nearest(name, names()) {
                Some(near) => format!("; did you mean `{near}`?"),
                None => format!("; there are {}", names().take(8).collect::<Vec<_>>().join(", ")),
            };
            let message = format!("`{name}` given, but no body has that name{else_}");
            ScenarioError::invalid(pointer, message)
        })
    }

    /// Checks a condition that ends the run, but for its limits of one body.
    pub(super) fn check_stop(&self, at: &str, stop: &Stop, n: usize) -> Check {
        ensure(
            stop.pointing_error_below_rad.is_none(),
            format!("{at}/pointing_error_below_rad"),
            || "is for scenes of one body, whose control has a target".to_owned(),
        )?;
        let of_one = stop.rate_below_rad_s.is_some() || stop.angle_above_rad.is_some();
        let pointer = format!("{at}/body");
        match &stop.body {
            Some(body) => {
                ensure(of_one, &pointer, || {
                    "is given, but the condition is not that of one body".to_owned()
                })?;
                self.known(&pointer, body)?;
            }
            None => ensure(!of_one, at, || {
                "missing field `body`, the name of that whose condition it is".to_owned()
            })?,
        }
        let limits = [
            ("distance_below_m", &stop.distance_below_m),
            ("distance_above_m", &stop.distance_above_m),
        ];
        for (field, limit) in limits {
            let Some(DistanceLimit { distance_m, between, points: given }) = limit else {
                continue;
            };
            let at = format!("{at}/{field}");
            self.check_between(&at, between, given.as_ref(), n)?;
            let pointer = format!("{at}/distance_m");
            number(&pointer, *distance_m)?;
            size(&pointer, [distance_m])?;
            ensure(*distance_m > 0.0, pointer, || {
                format!("{distance_m:?} given, a distance above 0 is needed")
            })?;
        }
        Ok(())
    }

    /// Checks the names of two bodies, or of one and of space, and the points of them whose distance is looked at.
    pub(crate) fn check_between(
        &self,
        at: &str,
        between: &[String; 2],
        given: Option<&[Vec<f64>; 2]>,
        n: usize,
    ) -> Check {
        for (i, name) in between.iter().enumerate().filter(|(_, name)| *name != SPACE) {
            self.known(&format!("{at}/between/{i}"), name)?;
        }
        Self::different(at, between)?;
        given.map_or(Ok(()), |given| points(at, given, n))
    }

    fn different(at: &str, between: &[String; 2]) -> Check {
        let [first, second] = between;
        ensure(first != second, format!("{at}/between"), || {
            format!("`{first}` given twice; two different bodies are needed")
        })
    }

    fn check_term(&self, at: &str, term: &Interaction, n: usize) -> Check {
        let (between, law) = match term {
            Interaction::On { body, term } => {
                self.known(&format!("{at}/body"), body)?;
                return term.law().check(at, n);
            }
            Interaction::Between { between, law } => (between, law),
        };
        let mut bodies = Vec::new();
        for (i, name) in between.iter().enumerate() {
            bodies.push(self.known(&format!("{at}/between/{i}"), name)?);
        }
        Self::different(at, between)?;
        match law {
            PairLaw::Spring(spring) => {
                let length = format!("{at}/rest_length");
                points(at, &spring.points, n)?;
                strength(&format!("{at}/stiffness"), spring.stiffness)?;
                number(&length, spring.rest_length)?;
                size(&length, [&spring.rest_length])?;
                ensure(spring.rest_length >= 0.0, length, || {
                    format!("{} given, a length is at least 0", spring.rest_length)
                })
            }
            PairLaw::PointSource(source) => {
                points(at, &source.points, n)?;
                strength(&format!("{at}/strength"), source.strength)
            }
            PairLaw::MutualGravity(gravity) => {
                ensure(n == 3, at, || format!("is for n = 3, these bodies have n = {n}"))?;
                let pointer = format!("{at}/constant");
                strength(&pointer, gravity.constant)?;
                ensure(gravity.constant >= 0.0, pointer, || {
                    format!("{:?} given, a constant of gravity is at least 0", gravity.constant)
                })?;
                bodies.into_iter().try_for_each(|body| {
                    let pointer = format!("/scene/bodies/{body}/mass");
                    let Body { name, mass, .. } = &self.bodies[body];
                    ensure(mass.is_some(), pointer, || {
                        format!("is missing; `{name}` needs a mass for its gravity")
                    })
                })
            }
        }
    }

    /// Checks that the joints make trees.
    fn check_joints(&self, n: usize) -> Check {
        // The joint and the parent of each body that has one; no parent for space.
        let mut held: HashMap<usize, (usize, Option<usize>)> = HashMap::new();
        for (i, joint) in self.joints.iter().enumerate() {
            let at = format!("/scene/joints/{i}");
            let [parent, child] = &joint.between;
            ensure(child != SPACE, format!("{at}/between/1"), || {
                format!("`{SPACE}` given; it can only be the first of the two, the parent")
            })?;
            let of_space = parent == SPACE;
            let parent_at = format!("{at}/between/0");
            let known = || self.known(&parent_at, parent);
            let parent = (!of_space).then(known).transpose()?;
            let child_at = format!("{at}/between/1");
            let number = self.known(&child_at, child)?;
            Self::different(&at, &joint.between)?;
            points(&at, &joint.points, n)?;
            if let Some((earlier, _)) = held.get(&number) {
                let message = format!(
                    "`{child}` given, which joint {earlier} holds already; a body has one joint to a parent"
                );
                return Err(ScenarioError::invalid(child_at, message));
            }
            let above = std::iter::successors(parent, |body| {
                held.get(body).and_then(|(_, parent)| *parent)
            });
            ensure(!above.into_iter().any(|body| body == number), &at, || {
                "closes a loop of joints; they must make trees".to_owned()
            })?;
            held.insert(number, (i, parent));
        }
        let root = |body: usize| {
            let parent = |body: &usize| held.get(body).and_then(|(_, parent)| *parent);
            std::iter::successors(Some(body), parent).last()
        };
        let mut sizes = HashMap::new();
        for body in 0..self.bodies.len() {
            let size = sizes.entry(root(body)).or_insert(0);
            *size += 1;
            let too_many = *size > MOST_IN_A_TREE;
            ensure(!too_many, "/scene/joints", || {
                let first = root(body).map_or("", |root| &self.bodies[root].name);
                format!(
                    "join more than {MOST_IN_A_TREE} bodies to the tree of `{first}`, {MOST_IN_A_TREE} are allowed"
                )
            })?;
        }
        Ok(())
    }
}

impl Body {
    /// Checks all but name and inertia.
    fn check(&self, at: &str, n: usize, jointed: bool) -> Check {
        let Self { name, mass, pivot, initial, .. } = self;
        let held = if jointed { "a joint" } else { "a pivot" };
        ensure(!jointed || pivot.is_none(), format!("{at}/pivot"), || {
            format!("is given, but a joint holds `{name}` already; give one of the two")
        })?;
        let pinned = pivot.is_some();
        ensure(pinned || mass.is_some(), format!("{at}/mass"), || {
            let without = if jointed { "a body with a joint" } else { "a body without a pivot" };
            format!("is missing; `{name}` is {without}, which needs one")
        })?;
        if let Some(mass) = *mass {
            ensure((SMALLEST_SIZE..=MAX_SIZE).contains(&mass), format!("{at}/mass"), || {
                format!("{mass:?} given, a mass must be from {SMALLEST_SIZE:e} to {MAX_SIZE:e} kg")
            })?;
        }
        if let Some(pivot) = pivot {
            point(&format!("{at}/pivot"), pivot, n)?;
        }
        let at = format!("{at}/initial");
        let BodyInitial { position, velocity, linear_momentum, .. } = initial;
        let in_space =
            [("position", position), ("velocity", velocity), ("linear_momentum", linear_momentum)];
        for (key, given) in in_space {
            let Some(given) = given else { continue };
            let pointer = format!("{at}/{key}");
            ensure(!pinned && !jointed, &pointer, || {
                format!("is given for `{name}`, which {held} holds; it has none of its own")
            })?;
            point(&pointer, given, n)?;
        }
        let one_of = |both: bool, key: &str, other: &str| {
            ensure(!both, format!("{at}/{key}"), || {
                format!("is given together with `{other}`; give one of the two")
            })
        };
        let both = velocity.is_some() && linear_momentum.is_some();
        one_of(both, "velocity", "linear_momentum")?;
        let both = initial.angular_velocity.is_some() && initial.momentum.is_some();
        one_of(both, "angular_velocity", "momentum")?;
        if let Some(given) = &initial.attitude {
            attitude(&format!("{at}/attitude"), given, n)?;
        }
        if let Some(momentum) = &initial.momentum {
            framed(&format!("{at}/momentum"), momentum, n)?;
        }
        match &initial.angular_velocity {
            Some(velocity) => framed(&format!("{at}/angular_velocity"), velocity, n),
            None => Ok(()),
        }
    }
}

fn is_name(pointer: &str, name: &str) -> Check {
    ensure(BodyName::of(name).is_some(), pointer, || {
        let most = BodyName::MOST;
        format!("`{name}` given; a name is 1 to {most} letters, digits, _ or -, a letter first")
    })?;
    ensure(name != SPACE, pointer, || {
        format!("`{SPACE}` given, which names what does not move; another name is needed")
    })
}

fn points(at: &str, points: &[Vec<f64>; 2], n: usize) -> Check {
    let mut points = points.iter().enumerate();
    points.try_for_each(|(i, given)| point(&format!("{at}/points/{i}"), given, n))
}

/// Returns the name that is most like one that was given, if one is at all.
fn nearest<'a>(given: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let scored = names.map(|name| (strsim::jaro_winkler(given, name), name));
    let alike = scored.filter(|(score, _)| *score > 0.7);
    alike.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, name)| name)
}
