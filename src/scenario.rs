//! 1 · A scenario: JSON from a file or a request becomes a checked [`Scenario`].
//!
//! The types below are the format: the JSON Schema is generated from them, and a scenario is written back
//! as they stand. Whether the numbers make a body (a rotation, a positive inertia, ...) is for
//! [`crate::plan`], which knows the mathematics.
//!
//! In Rust, `of` takes the fields that JSON requires and sets the others to their defaults;
//! `Default` exists where none is required.
//!
//! Invariant: a [`Scenario`] exists only if every field has a legal form; every error carries the JSON
//! pointer of the field at fault.

mod bodies;
mod change;
mod check;
mod control;
mod derivatives;
mod driven;
mod ensemble;
mod faces;
mod orbit;
mod parse;
mod range;
mod steps;
mod suggest;
mod term;

pub use bodies::{
    Bodies, Body, BodyInitial, Interaction, Joint, JointKind, MutualGravity, PairLaw, PairSource,
    PairSpring, SPACE,
};
pub(crate) use change::set;
pub(crate) use check::dividing;
pub(crate) use check::twelve_digits;
pub use control::{
    AngleAbove, AttitudeLaw, BDotLaw, Control, DampingLaw, Dipole, DistanceLimit, Field, Law,
    Magnetorquers, Noise, OrbitTarget, Pointing, Stop, Target, Through, TurningTarget,
    WheelFriction, Wheels,
};
pub use derivatives::{Covariance, Derivatives};
pub use driven::{
    DrivenTerm, Factor, Harmonic, Interpolation, OfMomentum, Orbit, Path, Table, Torque,
    TorqueTable, Turning, Viscous,
};
pub use ensemble::Ensemble;
pub use faces::{Drag, DragFace, LitFace, SolarPressure};
pub use orbit::{FieldOrbit, Oblateness};
pub(crate) use parse::{from_tree, read_text, tree as read_tree, without_mark};
pub(crate) use range::{
    LARGEST_SEED, MAX_SIZE, SMALLEST_STEP_S, SMALLEST_STRENGTH, ensure, semidefinite,
};
pub use steps::{Adaptive, Steps};
pub use term::*;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::log::schema::{Channel, Compression};
pub use crate::method::{MethodName, TableauName};

/// A job: a scene, how to integrate it and for how long, and what to log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[non_exhaustive]
pub struct Scenario {
    /// Where an editor finds the JSON Schema of scenarios; nothing here looks there.
    #[serde(rename = "$schema", default, skip_serializing)]
    pub(crate) schema: SchemaAddress,
    /// The version of this format, of which there is one so far; 1 if absent.
    #[serde(default, skip_serializing)]
    pub(crate) format: FormatVersion,
    /// A short name: 1 to 200 bytes, printable.
    pub name: String,
    /// Description of the scene.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub description: String,
    /// The body, its potential and where it starts; or `bodies`, their potential and their joints.
    #[schemars(schema_with = "bodies::scene_schema")]
    pub scene: Scene,
    /// Method of integration.
    #[serde(default)]
    pub method: Method,
    /// The step in seconds; either this or `accuracy`. Adaptive steps may do without: then an easy one is found.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "parse::given")]
    #[schemars(with = "f64")]
    pub step_s: Option<f64>,
    /// Steps that are not all of one length.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step: Option<Steps>,
    /// Accuracy of the end of the run; the program then chooses method and step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accuracy: Option<Accuracy>,
    /// Number of steps; either this or `duration_s`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<u64>,
    /// Duration in seconds, a whole number of steps; either this or `steps`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub duration_s: Option<f64>,
    /// Many runs of the scene, from starts that are spread about the given one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ensemble: Option<Ensemble>,
    /// Conditions that end the run before its time, looked at after each step: the first that holds does.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub until: Vec<Stop>,
    /// Where the body points, in the log: relative to a frame, as that of an orbit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pointing: Option<Pointing>,
    /// Derivatives of the run by its start and by fields of the scenario, carried along.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub derivatives: Option<Derivatives>,
    /// Contents of the log.
    #[serde(default)]
    pub log: LogOptions,
    /// Bounds that a good run of this scenario keeps to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expect: Option<Expect>,
}

/// An address that is read and forgotten.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SchemaAddress;

/// The version of the format that this build reads, which is not written because there is no other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct FormatVersion;

impl FormatVersion {
    const NUMBER: u64 = 1;
}

/// An accuracy in the place of a method and a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Accuracy {
    /// Largest error at the end: of the attitude (for n = 3 the spectral norm), plus of the body
    /// momentum in parts of its largest size. For an ensemble, the error of every member.
    pub error: f64,
    /// Symplectic methods only: for long runs whose energy must not drift. `false` if absent.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub symplectic: bool,
}

impl Accuracy {
    /// Returns this accuracy for any method.
    pub fn of(error: f64) -> Self {
        Self { error, symplectic: false }
    }
}

/// A body that turns about a fixed point.
// Written and read by hand, in `bodies` and `parse`: with `bodies` it has no field of one body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(remote = "Self", deny_unknown_fields)]
pub struct Scene {
    /// Inertia about the fixed point; n follows from it.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "parse::given")]
    #[schemars(with = "Inertia")]
    pub inertia: Option<Inertia>,
    /// The terms of the potential; none for a free body.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub potential: Vec<PotentialTerm>,
    /// Terms of the potential that change with time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub driven: Vec<DrivenTerm>,
    /// Torques that are no potential's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub torques: Vec<Torque>,
    /// The angular momentum of wheels relative to the body, constant in body coordinates, in kg m^2/s: the momentum is
    /// that of the body plus this. 3 numbers or a skew matrix.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wheels: Option<Vec<Entry>>,
    /// Control by samples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub control: Option<Control>,
    /// The magnetic field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<Field>,
    /// Attitude and momentum at the start.
    #[serde(default)]
    pub initial: Initial,
    /// Several bodies, in the place of all fields above.
    #[serde(default, skip_serializing, deserialize_with = "parse::late_bodies")]
    #[schemars(skip)]
    pub bodies: Option<Box<Bodies>>,
}

impl Scene {
    /// Returns whether nothing changes with time, applies a torque without being a potential, or
    /// spins in the body.
    pub(crate) fn is_plain(&self) -> bool {
        self.driven.is_empty()
            && self.torques.is_empty()
            && self.wheels.is_none()
            && self.control.is_none()
            && self.field.is_none()
    }

    /// Returns its torques, of which each that flies along an orbit has one: that of the field if it was left out.
    pub(crate) fn torques_on_orbits(&self) -> Vec<Torque> {
        let mut torques = self.torques.clone();
        for torque in &mut torques {
            if let (Torque::Drag(drag), Some(Field::Dipole(dipole))) = (torque, &self.field) {
                drag.orbit.get_or_insert_with(|| dipole.orbit.clone());
            }
        }
        torques
    }

    /// Returns the time in seconds at which the first of its tables ends, if it has any.
    pub(crate) fn known_until_s(&self) -> Option<f64> {
        let factors = self.driven.iter().filter_map(|term| term.factor.as_ref()?.table());
        let torques = self.torques.iter().filter_map(Torque::table);
        factors.chain(torques).filter_map(|table| table.times_s.last().copied()).reduce(f64::min)
    }

    /// Returns a free body with an inertia, at rest in the attitude of the identity.
    pub fn free(inertia: Inertia) -> Self {
        Self { inertia: Some(inertia), ..Self::nothing() }
    }

    /// Returns a scene of several bodies.
    pub fn of_bodies(bodies: Bodies) -> Self {
        Self { bodies: Some(Box::new(bodies)), ..Self::nothing() }
    }

    fn nothing() -> Self {
        Self {
            inertia: None,
            potential: Vec::new(),
            driven: Vec::new(),
            torques: Vec::new(),
            wheels: None,
            control: None,
            field: None,
            initial: Initial::default(),
            bodies: None,
        }
    }
}

/// Inertia of the body, in SI units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Inertia {
    /// n = 3: the moments about the body axes.
    Principal([f64; 3]),
    /// n = 3: the inertia matrix, symmetric positive definite.
    Matrix(Vec<Vec<f64>>),
    /// Any n: the second moments d_i along the body axes; mu_ij = (d_i + d_j) Omega_ij.
    SecondMoments(Vec<f64>),
}

impl Inertia {
    /// Returns n of SO(n).
    pub fn dimension(&self) -> usize {
        match self {
            Self::Principal(_) | Self::Matrix(_) => 3,
            Self::SecondMoments(moments) => moments.len(),
        }
    }
}

/// The state at t = 0.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Initial {
    /// The attitude; the identity if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<Attitude>,
    /// n = 3: the number of a term of `driven`, from 0, that follows an orbit: the attitude is then relative to the frame of
    /// that orbit at t = 0. Its z points along the term's direction or position, its y against the angular momentum of the
    /// orbit, and x = y cross z: for a direction to the planet and a circle, the direction of flight.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orbit_frame: Option<u32>,
    /// The momentum; either this or `angular_velocity`, at rest if both are absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub momentum: Option<Framed>,
    /// The angular velocity; either this or `momentum`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angular_velocity: Option<Framed>,
}

/// A rotation from body to space coordinates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Attitude {
    /// Any n: the rotation matrix, row by row, orthogonal to 1e-8.
    Matrix(Vec<Vec<f64>>),
    /// n = 3: unit quaternion [w, x, y, z]; normalised if its norm is within 1 % of one.
    Quaternion([f64; 4]),
    /// n = 3: a turn about an axis.
    AxisAngle(AxisAngle),
    /// n = 3: three turns one after another, each about an axis of the body as it is by then.
    Euler(Euler),
    /// n = 3: turns by roll about x, pitch about y and yaw about z, all axes of space, in this order: the same as the Euler
    /// angles yaw, pitch, roll of the sequence `zyx`.
    RollPitchYaw(RollPitchYaw),
    /// n = 3: modified Rodrigues parameters, the axis times tan(angle / 4).
    Mrp([f64; 3]),
}

impl Attitude {
    /// Returns the largest of the angles that are given in radians; zero if none is.
    pub(crate) fn largest_angle_rad(&self) -> f64 {
        let angles = match self {
            Self::AxisAngle(AxisAngle { angle_rad, .. }) => angle_rad.map(|angle| [angle; 3]),
            Self::Euler(Euler { angles_rad, .. })
            | Self::RollPitchYaw(RollPitchYaw { angles_rad, .. }) => *angles_rad,
            Self::Matrix(_) | Self::Quaternion(_) | Self::Mrp(_) => None,
        };
        angles.into_iter().flatten().fold(0.0, |largest, angle| largest.max(angle.abs()))
    }
}

/// A turn about an axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AxisAngle {
    /// The axis, of any length but zero.
    pub axis: [f64; 3],
    /// The angle in radians; either this or `angle_deg`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angle_rad: Option<f64>,
    /// The angle in degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angle_deg: Option<f64>,
}

impl AxisAngle {
    /// Returns a turn by an angle in radians.
    pub fn of(axis: [f64; 3], angle_rad: f64) -> Self {
        Self { axis, angle_rad: Some(angle_rad), angle_deg: None }
    }
}

/// Euler angles: turns about the named axes of the body, the first one first, each as it is after the turns before
/// (intrinsic). The attitude is R_i(first) R_j(second) R_k(third), R_x(a) being a turn by a about x.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Euler {
    /// The axes of the turns.
    pub sequence: Sequence,
    /// The three angles in radians; either this or `angles_deg`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angles_rad: Option<[f64; 3]>,
    /// The three angles in degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angles_deg: Option<[f64; 3]>,
}

/// The axes of three turns of which no two successive ones are about the same axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sequence {
    /// About x, y, z.
    Xyz,
    /// About x, z, y.
    Xzy,
    /// About y, x, z.
    Yxz,
    /// About y, z, x.
    Yzx,
    /// About z, x, y.
    Zxy,
    /// About z, y, x: yaw, pitch, roll.
    Zyx,
    /// About x, y, x.
    Xyx,
    /// About x, z, x.
    Xzx,
    /// About y, x, y.
    Yxy,
    /// About y, z, y.
    Yzy,
    /// About z, x, z: precession, nutation, spin.
    Zxz,
    /// About z, y, z.
    Zyz,
}

impl Sequence {
    /// Returns the axes by number, x = 0.
    pub fn axes(self) -> [usize; 3] {
        const X: usize = 0;
        const Y: usize = 1;
        const Z: usize = 2;
        match self {
            Self::Xyz => [X, Y, Z],
            Self::Xzy => [X, Z, Y],
            Self::Yxz => [Y, X, Z],
            Self::Yzx => [Y, Z, X],
            Self::Zxy => [Z, X, Y],
            Self::Zyx => [Z, Y, X],
            Self::Xyx => [X, Y, X],
            Self::Xzx => [X, Z, X],
            Self::Yxy => [Y, X, Y],
            Self::Yzy => [Y, Z, Y],
            Self::Zxz => [Z, X, Z],
            Self::Zyz => [Z, Y, Z],
        }
    }
}

/// Roll, pitch and yaw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RollPitchYaw {
    /// Roll, pitch and yaw in radians; either this or `angles_deg`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angles_rad: Option<[f64; 3]>,
    /// Roll, pitch and yaw in degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angles_deg: Option<[f64; 3]>,
}

/// An element of so(n) or its dual, in one of the two frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Framed {
    /// In body coordinates.
    Body(Vec<Entry>),
    /// In space coordinates.
    Space(Vec<Entry>),
}

/// A 3-vector is made of numbers, a skew n x n matrix of rows.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum Entry {
    /// A component of a 3-vector (n = 3).
    Number(f64),
    /// A row of a skew matrix.
    Row(Vec<f64>),
}

/// Method of integration of the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Method {
    /// The integrator.
    #[serde(default)]
    pub name: MethodName,
    /// The Butcher tableau, of methods that have one. If absent: gauss2, and rk4 for explicit methods.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tableau: Option<TableauChoice>,
    /// The order 2, 4, 6 or 8 of methods that are compositions (splitting, lgvi); 4 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<u32>,
    /// The solver of the implicit equations.
    #[serde(default)]
    pub solver: Solver,
}

/// A Butcher tableau, by name or by its coefficients.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(untagged)]
pub enum TableauChoice {
    /// A tableau by name.
    Named(TableauName),
    /// A tableau by its coefficients.
    Custom(Coefficients),
}

/// The coefficients of a tableau.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Coefficients {
    /// a_ij, row by row.
    pub a: Vec<Vec<f64>>,
    /// b_j, none of them zero.
    pub b: Vec<f64>,
}

/// The solver of the implicit equations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Solver {
    /// Kind of iteration.
    #[serde(default)]
    pub kind: SolverKind,
    /// Relative increment at which the iteration ends; round-off by default.
    #[serde(default = "Solver::default_tolerance")]
    pub tolerance: f64,
    /// Sweeps, or corrections of Newton's method, after which a step fails.
    #[serde(default = "Solver::default_max_iterations")]
    pub max_iterations: u32,
}

impl Solver {
    fn default_tolerance() -> f64 {
        1e-15
    }

    fn default_max_iterations() -> u32 {
        100
    }
}

impl Default for Solver {
    fn default() -> Self {
        Self {
            kind: SolverKind::Auto,
            tolerance: Self::default_tolerance(),
            max_iterations: Self::default_max_iterations(),
        }
    }
}

/// The iterations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SolverKind {
    /// Fixed-point sweeps, and Newton's method in the steps where they do not converge.
    #[default]
    Auto,
    /// Fixed-point sweeps alone.
    FixedPoint,
    /// Newton's method alone.
    Newton,
}

/// Contents of the log.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LogOptions {
    /// A sample every k steps, in addition to the start and the end. By default at most 60 samples per
    /// second of simulated time, which is what viewers like.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub every: Option<u64>,
    /// The same in seconds of simulated time, a whole number of steps; either this or `every`. Where the program chooses
    /// the step, it chooses one that fits, and the duration is a whole number of these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub every_s: Option<f64>,
    /// The topics to log; all that the scene has if absent. What is not logged is not computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub channels: Option<Vec<Channel>>,
    /// Compression of the log's chunks.
    #[serde(default)]
    pub compression: Compression,
    /// Log time of t = 0 (RFC 3339), in the years 1990 to 2099.
    #[serde(default = "LogOptions::default_epoch")]
    pub epoch: Epoch,
}

impl LogOptions {
    fn default_epoch() -> Epoch {
        Epoch::default()
    }
}

/// A moment, as RFC 3339 text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Epoch(pub String);

impl Default for Epoch {
    fn default() -> Self {
        Self("2026-01-01T00:00:00Z".to_owned())
    }
}

/// Bounds that a good run of the scenario keeps to; the run says where it does not.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Expect {
    /// Largest |H - H0| over the samples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub energy_error_max: Option<f64>,
    /// Largest spectral norm of g g^T - I over the samples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orthogonality_error_max: Option<f64>,
    /// Largest drift of the conserved spatial momentum over the samples.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub momentum_drift_max: Option<f64>,
    /// Rotation matrix that the run ends at, row by row, with `final_attitude_error_max`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub final_attitude: Option<Vec<Vec<f64>>>,
    /// Largest entry by which the final attitude may differ.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub final_attitude_error_max: Option<f64>,
}

/// Error of a scenario, with its place.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{}: {message}", if pointer.is_empty() { "the scenario" } else { pointer })]
pub struct ScenarioError {
    /// Whether the text is JSON at all.
    pub kind: ScenarioErrorKind,
    /// JSON pointer (RFC 6901) of the field at fault; empty for the whole document.
    pub pointer: String,
    /// Text that says what was given and what is allowed.
    pub message: String,
}

/// The two ways in which a scenario can be wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScenarioErrorKind {
    /// The text is not JSON.
    Malformed,
    /// A field is not as it must be.
    Invalid,
}

impl ScenarioError {
    /// Returns the error of a field that is not as it must be.
    pub(crate) fn invalid(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Self::new(ScenarioErrorKind::Invalid, pointer.into(), message.into())
    }

    /// Returns an error that repeats no more of the given text than a person reads.
    fn new(kind: ScenarioErrorKind, pointer: String, message: String) -> Self {
        // A list of all methods is longer than a line; names of ours and places in lists are short.
        const POINTER: usize = 200;
        const MESSAGE: usize = 600;
        Self { kind, pointer: shortened(pointer, POINTER), message: shortened(message, MESSAGE) }
    }
}

/// Shortens a text to at most `most` characters: beginning and end of a longer one.
fn shortened(text: String, most: usize) -> String {
    let count = text.chars().count();
    if count <= most {
        return text;
    }
    let head: String = text.chars().take(most / 2).collect();
    let tail: String = text.chars().skip(count + 1 - most.div_ceil(2)).collect();
    format!("{head}…{tail}")
}

impl Scenario {
    /// Returns a scenario without JSON: `scene` under `name`, with `steps` steps of `step_s`
    /// seconds, and the defaults for all else. Further fields are set on the result, and checked by
    /// [`Scenario::check`].
    ///
    /// ```
    /// use vpd::plan::Plan;
    /// use vpd::scenario::{
    ///     Attitude, AxisAngle, Entry, Framed, Inertia, Initial, MethodName, PotentialTerm, Scenario, Scene,
    ///     Uniform,
    /// };
    ///
    /// let weight = Uniform {
    ///     weight: 4.905,
    ///     body_point: vec![0.0, 0.0, 0.1],
    ///     direction: vec![0.0, 0.0, 1.0],
    /// };
    /// let tilt = AxisAngle::of([1.0, 0.0, 0.0], 0.3);
    /// let spin = [0.0, 0.0, 40.0].map(Entry::Number).to_vec();
    /// let top = Scene {
    ///     potential: vec![PotentialTerm::Uniform(weight)],
    ///     initial: Initial {
    ///         attitude: Some(Attitude::AxisAngle(tilt)),
    ///         angular_velocity: Some(Framed::Body(spin)),
    ///         ..Initial::default()
    ///     },
    ///     ..Scene::free(Inertia::Principal([0.02, 0.02, 0.01]))
    /// };
    /// let mut scenario = Scenario::of("heavy-top", top, 0.002, 1000)?;
    /// scenario.method.name = MethodName::VpdLagrangian;
    /// scenario.check()?;
    /// assert_eq!(Plan::new(&scenario)?.steps, 1000);
    /// # Ok::<(), vpd::scenario::ScenarioError>(())
    /// ```
    ///
    /// # Errors
    /// The first fault found, with the pointer of its field.
    pub fn of(
        name: impl Into<String>,
        scene: Scene,
        step_s: f64,
        steps: u64,
    ) -> Result<Self, ScenarioError> {
        let (step_s, steps) = (Some(step_s), Some(steps));
        let scenario = Self { step_s, steps, ..Self::blank(name.into(), scene) };
        scenario.check()?;
        Ok(scenario)
    }

    /// Returns the same to an accuracy, for which the program chooses method and step: see
    /// [`crate::advise::plan`].
    ///
    /// # Errors
    /// The first fault found, with the pointer of its field.
    pub fn to_accuracy(
        name: impl Into<String>,
        scene: Scene,
        accuracy: Accuracy,
        duration_s: f64,
    ) -> Result<Self, ScenarioError> {
        let (accuracy, duration_s) = (Some(accuracy), Some(duration_s));
        let scenario = Self { accuracy, duration_s, ..Self::blank(name.into(), scene) };
        scenario.check()?;
        Ok(scenario)
    }

    fn blank(name: String, scene: Scene) -> Self {
        Self {
            schema: SchemaAddress,
            format: FormatVersion,
            name,
            description: String::new(),
            scene,
            method: Method::default(),
            step_s: None,
            step: None,
            accuracy: None,
            steps: None,
            duration_s: None,
            until: Vec::new(),
            ensemble: None,
            pointing: None,
            derivatives: None,
            log: LogOptions::default(),
            expect: None,
        }
    }

    /// Returns the default log time of t = 0 of a scenario, in nanoseconds since 1970.
    pub(crate) fn default_epoch_ns() -> u64 {
        check::epoch_ns(&Epoch::default().0).unwrap_or_default()
    }

    /// Reads and checks a scenario.
    ///
    /// # Errors
    /// The first fault found, with the pointer of its field.
    pub fn from_json(text: &[u8]) -> Result<Self, ScenarioError> {
        let tree = parse::tree(text)?;
        let scenario: Self =
            parse::typed(&tree).map_err(|error| suggest::with_suggestion(error, &tree))?;
        scenario.check()?;
        Ok(scenario)
    }

    /// Checks form and range of every field, once more after fields were set: [`crate::run::execute`] does so, too.
    ///
    /// # Errors
    /// The first fault found, with the pointer of its field.
    pub fn check(&self) -> Result<(), ScenarioError> {
        check::check(self)
    }

    /// Returns the canonical text of the scenario, with every default written out.
    pub fn to_json(&self) -> Vec<u8> {
        let mut text = serde_json::to_vec_pretty(self)
            .expect("the types of a scenario are JSON by construction");
        text.push(b'\n');
        text
    }

    /// Returns the scenario's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns n of SO(n), the same for all bodies.
    pub fn dimension(&self) -> usize {
        let first = || self.bodies()?.bodies.first().map(|body| &body.inertia);
        self.scene.inertia.as_ref().or_else(first).map_or(0, Inertia::dimension)
    }

    /// Refuses a scene of several bodies, where only one can be.
    ///
    /// # Errors
    /// At `/scene/bodies`.
    pub(crate) fn one_body(&self) -> Result<(), ScenarioError> {
        ensure(self.bodies().is_none(), "/scene/bodies", || {
            "is not possible here: simulations that are stepped are for one body".to_owned()
        })
    }

    /// Returns the scene of several bodies; `None` if it is one of one body.
    pub fn bodies(&self) -> Option<&Bodies> {
        self.scene.bodies.as_deref()
    }

    /// Returns the number of steps, whichever way the duration was given; 0 while no step has been
    /// chosen.
    pub fn step_count(&self) -> u64 {
        match (self.steps, self.duration_s) {
            (Some(steps), _) => steps,
            // This was checked to be whole.
            (None, Some(duration_s)) => {
                self.step_s.map_or(0, |step_s| (duration_s / step_s).round() as u64)
            }
            (None, None) => 0,
        }
    }

    /// Returns k, where a sample is taken every k steps.
    pub fn sample_every(&self) -> u64 {
        const VIEWER_RATE_HZ: f64 = 60.0;
        let step_s = self.step_s.unwrap_or(f64::INFINITY);
        match (self.log.every, self.log.every_s) {
            (Some(every), _) => every,
            // This was checked to be whole.
            (None, Some(every_s)) => ((every_s / step_s).round() as u64).max(1),
            (None, None) => {
                // A rate of 60 that only rounding lifts above 60 stays.
                let for_viewers = 1.0 / (VIEWER_RATE_HZ * step_s) - 1e-9;
                (for_viewers.ceil() as u64).max(1)
            }
        }
    }

    /// Returns the number of which the number of steps is a multiple where the program chooses the
    /// step, so that each sample is at the end of one.
    pub(crate) fn multiple_of_steps(&self) -> u64 {
        let times = self.duration_s.zip(self.log.every_s);
        // This was checked to be whole.
        times.map_or(1, |(duration_s, every_s)| ((duration_s / every_s).round() as u64).max(1))
    }

    /// Returns whether the given times are whole numbers of `step_s`, in place of the given step.
    pub(crate) fn fits(&self, step_s: f64) -> bool {
        let times_s = [self.duration_s, self.log.every_s];
        times_s.into_iter().flatten().all(|time_s| check::is_whole(time_s, step_s))
    }

    /// Returns the log time of t = 0 in nanoseconds since 1970.
    pub fn epoch_ns(&self) -> u64 {
        check::epoch_ns(&self.log.epoch.0).unwrap_or_default()
    }
}

/// Returns the text of a scenario with the values of some fields, named by their JSON pointers, replaced or added; null removes
/// one. The text itself only has to be JSON without duplicate keys: a change may be what makes it a scenario.
///
/// # Errors
/// If it is no JSON, or a pointer names no place.
pub fn with_changes(
    text: &[u8],
    changes: impl IntoIterator<Item = (String, serde_json::Value)>,
) -> Result<Vec<u8>, ScenarioError> {
    let mut document = read_tree(text)?;
    for (pointer, value) in changes {
        set(&mut document, &pointer, value)?;
    }
    Ok(document.to_string().into_bytes())
}

/// Returns the JSON Schema of a scenario, generated from the types.
pub fn schema() -> serde_json::Value {
    schemars::schema_for!(Scenario).to_value()
}

/// The shipped scenarios: name and JSON text.
pub const SHIPPED: &[(&str, &str)] = &[
    ("binary-asteroid", include_str!("../scenarios/binary-asteroid.json")),
    ("chain", include_str!("../scenarios/chain.json")),
    ("compass-needles", include_str!("../scenarios/compass-needles.json")),
    ("cubesat", include_str!("../scenarios/cubesat.json")),
    ("detumble", include_str!("../scenarios/detumble.json")),
    ("dipole", include_str!("../scenarios/dipole.json")),
    ("dual-spin", include_str!("../scenarios/dual-spin.json")),
    ("flyby", include_str!("../scenarios/flyby.json")),
    ("free-body", include_str!("../scenarios/free-body.json")),
    ("gyroscope-on-a-string", include_str!("../scenarios/gyroscope-on-a-string.json")),
    ("heavy-top", include_str!("../scenarios/heavy-top.json")),
    ("nutation-damper", include_str!("../scenarios/nutation-damper.json")),
    ("orbit-and-attitude", include_str!("../scenarios/orbit-and-attitude.json")),
    ("pendulum", include_str!("../scenarios/pendulum.json")),
    ("satellite", include_str!("../scenarios/satellite.json")),
    ("satellite-elliptic", include_str!("../scenarios/satellite-elliptic.json")),
    ("satellite-ensemble", include_str!("../scenarios/satellite-ensemble.json")),
    ("slew", include_str!("../scenarios/slew.json")),
    ("so4-free", include_str!("../scenarios/so4-free.json")),
    ("so5-spring", include_str!("../scenarios/so5-spring.json")),
    ("tether", include_str!("../scenarios/tether.json")),
];
