//! The control of a scene with its numbers, its magnetic field, and the conditions that end a run.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::rotation::{across, attitude, skew, unit_vector};
use crate::scenario::{
    Control, Dipole, Field, FieldOrbit, Framed, Initial, Law, Oblateness, Orbit, OrbitTarget, Path,
    Pointing, Scenario, ScenarioError, Target, Through, TurningTarget, Wheels, vector,
};
use crate::solve::control::{self, ControlLaw};
use crate::solve::hamiltonian::{self as body, Actuator, DipoleField, ReactionWheels, RigidBody};
use crate::solve::kepler;
use crate::solve::noise::Noise;
use crate::solve::pointing::{self, Frame};
use crate::solve::so::Mat;
use crate::solve::stop::{Condition, Stop};

/// What a scene has of control, a field and conditions.
#[derive(Clone, Debug, Default)]
pub(crate) struct ModelControl {
    control: Option<Control>,
    target: Option<ModelTarget>,
    wheels: Option<ModelWheels>,
    field: Option<DipoleField>,
    /// A permanent moment of the body, in A m^2.
    moment: Option<[f64; 3]>,
    /// The noise that has an effect.
    noise: Option<Noise>,
    stops: Vec<ModelStop>,
    pointing: Option<ModelPointing>,
}

/// A frame, and an axis of the body with its direction there.
#[derive(Clone, Debug)]
struct ModelPointing {
    frame: ModelFrame,
    axis: [f64; 3],
    towards: [f64; 3],
}

#[derive(Clone, Debug)]
enum ModelFrame {
    Target(ModelTarget),
    /// Unit vectors across one another, of which the first turns towards the second.
    Orbit([DVector<f64>; 2], Orbit),
}

/// An attitude to aim at.
#[derive(Clone, Debug)]
struct ModelTarget {
    start: DMatrix<f64>,
    /// Two orthonormal vectors, of which the first turns towards the second.
    plane: [Vec<f64>; 2],
    rate: f64,
}

/// Driven wheels.
#[derive(Clone, Debug)]
pub(super) struct ModelWheels {
    axes: Vec<[f64; 3]>,
    moments: Vec<f64>,
    momenta: Vec<f64>,
    limits: [f64; 2],
}

/// A condition that ends a run.
#[derive(Clone, Debug)]
enum ModelCondition {
    PointingErrorBelow(f64),
    RateBelow(f64),
    AngleAbove(DMatrix<f64>, f64),
    EnergyErrorAbove(f64),
}

#[derive(Clone, Debug)]
struct ModelStop {
    condition: ModelCondition,
    for_s: f64,
    exact: bool,
}

impl ModelWheels {
    /// Reads the wheels of a body whose inertia includes them, at rest in the body unless their momenta are given; also returns the
    /// inertia without them about their axes, if they have any.
    pub(super) fn new(
        given: &Wheels,
        initial: &Initial,
        attitude: &DMatrix<f64>,
        inertia: &DMatrix<f64>,
    ) -> Result<(Self, Option<Matrix3<f64>>), ScenarioError> {
        let at = "/scene/control/through/wheels";
        let axes: Vec<[f64; 3]> =
            given.axes.iter().map(|&axis| Vector3::from(axis).normalize().into()).collect();
        let count = axes.len();
        let moments = given.moments_kg_m2.clone().unwrap_or_else(|| vec![0.0; count]);
        let whole = Matrix3::from_fn(|i, j| inertia[(i, j)]);
        let omega = start_velocity(initial, attitude, &whole);
        let at_rest = || {
            axes.iter()
                .zip(&moments)
                .map(|(axis, j)| j * Vector3::from(*axis).dot(&omega))
                .collect()
        };
        let momenta = given.momenta.clone().unwrap_or_else(at_rest);
        let mut own_inertia = None;
        if moments.iter().any(|&moment| moment > 0.0) {
            let mut own = whole;
            for (axis, moment) in axes.iter().zip(&moments) {
                let axis = Vector3::from(*axis);
                own -= axis * axis.transpose() * *moment;
            }
            let smallest = own.symmetric_eigenvalues().min();
            if !(smallest > 1e-12 * own.amax()) {
                let message = format!(
                    "the inertia of the body includes its wheels, but without them about their axes its smallest moment is \
                     {smallest:e}"
                );
                return Err(ScenarioError::invalid(format!("{at}/moments_kg_m2"), message));
            }
            own_inertia = Some((own + own.transpose()) * 0.5);
        }
        let limits =
            [given.limit_n_m, given.limit_n_m_s].map(|limit| limit.unwrap_or(f64::INFINITY));
        let wheels = Self { axes, moments, momenta, limits };
        if wheels.of::<3>().is_none() {
            let message = if count < 4 {
                "depend on one another; up to three axes must be independent"
            } else {
                "lie in a plane; more than three axes must span space"
            };
            return Err(ScenarioError::invalid(format!("{at}/axes"), message));
        }
        Ok((wheels, own_inertia))
    }

    fn of<const N: usize>(&self) -> Option<ReactionWheels<N>> {
        let [torque, momentum] = self.limits;
        let (moments, momenta) = (self.moments.clone(), self.momenta.clone());
        ReactionWheels::new(&self.axes, moments, momenta, torque, momentum)
    }

    /// The momentum of all of them at the start, skew.
    pub(super) fn momentum(&self) -> DMatrix<f64> {
        let along = self.axes.iter().zip(&self.momenta);
        let sum = along.fold(Vector3::zeros(), |sum, (axis, h)| sum + Vector3::from(*axis) * *h);
        skew(&[sum.x, sum.y, sum.z].map(crate::scenario::Entry::Number))
    }
}

/// The angular velocity at the start of a body with an inertia, in the body.
fn start_velocity(
    initial: &Initial,
    attitude: &DMatrix<f64>,
    inertia: &Matrix3<f64>,
) -> Vector3<f64> {
    let in_body = |framed: &Framed| {
        let skew = match framed {
            Framed::Body(entries) => skew(entries),
            Framed::Space(entries) => attitude.transpose() * skew(entries) * attitude,
        };
        Vector3::new(skew[(2, 1)], skew[(0, 2)], skew[(1, 0)])
    };
    match (&initial.angular_velocity, &initial.momentum) {
        (Some(velocity), _) => in_body(velocity),
        (None, Some(momentum)) => {
            inertia.try_inverse().map_or_else(Vector3::zeros, |inverse| inverse * in_body(momentum))
        }
        (None, None) => Vector3::zeros(),
    }
}

impl ModelControl {
    /// Reads the control, the field and the conditions of a scenario whose body starts with an attitude.
    pub(super) fn new(
        scenario: &Scenario,
        wheels: Option<ModelWheels>,
        start: &DMatrix<f64>,
    ) -> Result<Self, ScenarioError> {
        let n = scenario.dimension();
        let control = scenario.scene.control.clone();
        let target = control.as_ref().and_then(|control| control.target.as_ref());
        let at = "/scene/control/target";
        let target = target.map(|target| ModelTarget::new(at, target, n)).transpose()?;
        let pointing = scenario.pointing.as_ref();
        let pointing = pointing.map(|asked| ModelPointing::new(asked, scenario, target.as_ref()));
        let dipole = scenario.scene.field.as_ref().map(|Field::Dipole(dipole)| dipole);
        let stops = scenario.until.iter().enumerate().map(|(number, stop)| {
            let condition = match (&stop.angle_above_rad, stop.pointing_error_below_rad) {
                (Some(above), _) => {
                    let from = match &above.from {
                        Some(from) => attitude(
                            &format!("/until/{number}/angle_above_rad/from"),
                            Some(from),
                            n,
                        )?,
                        None => start.clone(),
                    };
                    ModelCondition::AngleAbove(from, above.angle_rad)
                }
                (None, Some(angle)) => ModelCondition::PointingErrorBelow(angle),
                (None, None) => match (stop.rate_below_rad_s, stop.energy_error_above_j) {
                    (Some(rate), _) => ModelCondition::RateBelow(rate),
                    (None, energy) => ModelCondition::EnergyErrorAbove(energy.unwrap_or(f64::MAX)),
                },
            };
            Ok(ModelStop { condition, for_s: stop.for_s, exact: stop.exact })
        });
        Ok(Self {
            target,
            wheels,
            field: dipole.map(field),
            moment: dipole.and_then(|dipole| dipole.permanent_moment_a_m2),
            noise: control.as_ref().and_then(noise),
            pointing: pointing.transpose()?.flatten(),
            stops: stops.collect::<Result<_, ScenarioError>>()?,
            control,
        })
    }

    /// Refuses samples of the control that are too many for a step, which cannot be stopped within, or for a run.
    pub(super) fn check_samples(&self, step_s: f64, steps: u64) -> Result<(), ScenarioError> {
        /// As many as rows of a table.
        const MOST_IN_A_STEP: f64 = 1e5;
        /// Times of samples are told apart.
        const MOST: f64 = 1e12;
        let Some(control) = &self.control else { return Ok(()) };
        let in_a_step = step_s / control.every_s;
        let all = in_a_step * steps as f64;
        if in_a_step <= MOST_IN_A_STEP && all <= MOST {
            return Ok(());
        }
        let message = format!(
            "{:?} given, which is {in_a_step:.1e} samples in a step and {all:.1e} in all; at most {MOST_IN_A_STEP:e} and \
             {MOST:e} are allowed",
            control.every_s
        );
        Err(ScenarioError::invalid("/scene/control/every_s", message))
    }

    /// Is nothing changed by it in the motion?
    pub(crate) fn is_empty(&self) -> bool {
        self.control.is_none() && self.moment.is_none()
    }

    /// Refuses conditions that are located within a step, which adaptive steps cannot do.
    pub(super) fn check_exact(&self) -> Result<(), ScenarioError> {
        let Some(number) = self.stops.iter().position(|stop| stop.exact) else { return Ok(()) };
        let message = "steps that adapt cannot end at a time that is located; leave it out, or choose another method";
        Err(ScenarioError::invalid(format!("/until/{number}/exact"), message))
    }

    /// Are there conditions that end a run?
    pub(crate) fn has_stops(&self) -> bool {
        !self.stops.is_empty()
    }

    /// How many steps a duration in steps of one length is cut into in addition, at most.
    pub(super) fn knots_within(&self, duration_s: f64, step_s: f64) -> f64 {
        let Some(control) = &self.control else { return 0.0 };
        let on_steps = |time_s: f64| {
            let steps = time_s / step_s;
            (steps - steps.round()).abs() <= 1e-9 * steps
        };
        let samples = (duration_s / control.every_s).floor();
        let cuts = f64::from(u8::from(!on_steps(control.every_s)))
            + f64::from(u8::from(!on_steps(control.delay_s)));
        cuts * samples
    }

    /// Returns what of it takes part, as lines of a plan: pointer, whether it is kept, and why.
    pub(super) fn parts(&self) -> Vec<(&'static str, bool, &'static str)> {
        let field = self.field.map(|_| {
            let kept = self.is_magnetic();
            let why =
                if kept { "acts on magnetic moments" } else { "nothing in the scene feels it" };
            ("/scene/field", kept, why)
        });
        let control = self.control.as_ref().map(|control| {
            let why = match control.through {
                Through::Torque => "torques that are held between samples",
                Through::Wheels(_) => {
                    "motor torques that are held between samples; wheels are a part of the body"
                }
                Through::Magnetorquers(_) => "magnetic moments that are held between samples",
            };
            ("/scene/control", true, why)
        });
        let noise = self.control.as_ref().and_then(|control| control.noise).map(|_| {
            let why = match &self.noise {
                None => "no law reads what it changes",
                Some(Noise { torque: 0.0, .. }) => "changes what the laws read",
                Some(Noise { attitude: 0.0, rate: 0.0, .. }) => {
                    "a torque that is held between samples"
                }
                Some(_) => "changes what the laws read, and a torque that is held between samples",
            };
            ("/scene/control/noise", self.noise.is_some(), why)
        });
        field.into_iter().chain(control).chain(noise).collect()
    }

    /// Is there a torque of noise?
    pub(crate) fn is_disturbed(&self) -> bool {
        self.noise.is_some_and(|noise| noise.torque > 0.0)
    }

    /// Do its commands push the body by torques that are no potential's?
    pub(crate) fn is_pushed(&self) -> bool {
        self.control.as_ref().is_some_and(|control| control.through == Through::Torque)
    }

    /// Are there wheels that are driven?
    pub(crate) fn has_wheels(&self) -> bool {
        self.wheels.is_some()
    }

    /// Does the energy depend on the attitude by it?
    pub(crate) fn is_magnetic(&self) -> bool {
        self.moment.is_some()
            || self
                .control
                .as_ref()
                .is_some_and(|control| matches!(control.through, Through::Magnetorquers(_)))
    }

    /// Adds it to a body.
    pub(super) fn put_on<const N: usize>(&self, mut body: RigidBody<N>) -> RigidBody<N> {
        let target = self.target.as_ref().map(ModelTarget::of::<N>);
        if let (Some(moment), Some(field)) = (&self.moment, self.field) {
            body = body.with_driven_term(body::magnetic_term(moment, field));
        }
        if let Some(control) = &self.control {
            let limit = |limit: Option<f64>| limit.unwrap_or(f64::INFINITY);
            let actuator = match (&control.through, &self.wheels, self.field) {
                (Through::Wheels(_), Some(wheels), _) => {
                    Actuator::Wheels(wheels.of().expect("the plan checked the axes"))
                }
                (Through::Magnetorquers(coils), _, Some(field)) => {
                    Actuator::Magnetorquers { limit: limit(coils.limit_a_m2), field }
                }
                _ => Actuator::Torque { limit: limit(control.limit_n_m) },
            };
            body = body.with_control(body::Control {
                every_s: control.every_s,
                delay_s: control.delay_s,
                quantum_n_m: control.quantum_n_m,
                target: target.clone(),
                laws: control.laws.iter().map(law).collect(),
                actuator,
                noise: self.noise,
            });
        }
        let stop = |stop: &ModelStop| {
            let condition = match (&stop.condition, &target) {
                (ModelCondition::PointingErrorBelow(angle), Some(target)) => {
                    Condition::PointingErrorBelow(target.clone(), *angle)
                }
                (ModelCondition::PointingErrorBelow(angle), None) => {
                    Condition::PointingErrorBelow(control::Target::fixed(Mat::identity()), *angle)
                }
                (ModelCondition::RateBelow(rate), _) => Condition::RateBelow(*rate),
                (ModelCondition::AngleAbove(from, angle), _) => {
                    Condition::AngleAbove(control::Target::fixed(square(from)), *angle)
                }
                (ModelCondition::EnergyErrorAbove(energy), _) => {
                    Condition::EnergyErrorAbove(*energy)
                }
            };
            Stop { condition, for_s: stop.for_s, exact: stop.exact }
        };
        let body = body.with_stops(self.stops.iter().map(stop).collect());
        match &self.pointing {
            Some(pointing) => body.with_pointing(pointing.of()),
            None => body,
        }
    }
}

fn square<const N: usize>(given: &DMatrix<f64>) -> Mat<N> {
    Mat::from_fn(|i, j| given[(i, j)])
}

/// Returns the noise of a control that has an effect: of an angle that a law reads, and the like.
fn noise(control: &Control) -> Option<Noise> {
    let given = control.noise?;
    let (mut attitude, mut rate) = (0.0, 0.0);
    for law in &control.laws {
        match law {
            Law::Attitude(_) => (attitude, rate) = (given.attitude_rad, given.rate_rad_s),
            Law::Damping(_) => rate = given.rate_rad_s,
            Law::BDot(_) | Law::WheelFriction(_) => {}
        }
    }
    let torque = given.torque_n_m;
    let acts = attitude > 0.0 || rate > 0.0 || torque > 0.0;
    acts.then_some(Noise { seed: given.seed, stream: given.stream, attitude, rate, torque })
}

fn law(given: &Law) -> ControlLaw {
    match given {
        Law::Attitude(law) => ControlLaw::Attitude {
            gain: law.gain_n_m,
            rate_gain: law.rate_gain_n_m_s,
            integral_gain: law.integral_gain_n_m_per_s,
            feed_forward: law.feed_forward,
        },
        Law::Damping(law) => ControlLaw::Damping { rate_gain: law.rate_gain_n_m_s },
        Law::BDot(law) => ControlLaw::BDot { gain: law.gain_a_m2_s_per_t },
        Law::WheelFriction(law) => ControlLaw::WheelFriction { coefficient: law.coefficient_n_m_s },
    }
}

fn field(dipole: &Dipole) -> DipoleField {
    DipoleField {
        moment_t_m3: dipole.moment_t_m3,
        tilt_rad: dipole.tilt_rad,
        rotation_rad_s: dipole.rotation_rad_s,
        orbit: kepler_orbit(&dipole.orbit),
    }
}

/// Returns an orbit with its plane, and with the rate of its node.
pub(super) fn kepler_orbit(orbit: &FieldOrbit) -> kepler::Orbit {
    let plane = match (&orbit.from, &orbit.towards) {
        (Some(from), Some(towards)) => {
            let from = unit_vector(from);
            let towards = across(towards, &from);
            [from, towards].map(|v| std::array::from_fn(|i| v[i]))
        }
        _ => {
            let (sin_i, cos_i) = libm::sincos(orbit.inclination_rad);
            let (sin_n, cos_n) = libm::sincos(orbit.node_rad);
            let (sin_w, cos_w) = libm::sincos(orbit.argument_rad);
            // Columns of R_z(node) R_x(inclination) R_z(argument).
            [
                [
                    cos_n * cos_w - sin_n * cos_i * sin_w,
                    sin_n * cos_w + cos_n * cos_i * sin_w,
                    sin_i * sin_w,
                ],
                [
                    -cos_n * sin_w - sin_n * cos_i * cos_w,
                    -sin_n * sin_w + cos_n * cos_i * cos_w,
                    sin_i * cos_w,
                ],
            ]
        }
    };
    let axes = (orbit.semi_major_axis_m, orbit.eccentricity);
    let node_rate = |given| node_rate_rad_s(given, &plane, orbit.mean_motion_rad_s, axes);
    kepler::Orbit {
        plane,
        semi_major_axis_m: orbit.semi_major_axis_m,
        mean_motion_rad_s: orbit.mean_motion_rad_s,
        eccentricity: orbit.eccentricity,
        mean_anomaly_rad: orbit.mean_anomaly_rad,
        node_rate_rad_s: orbit.j2.as_ref().map_or(0.0, node_rate),
    }
}

/// Returns the secular rate of the node of an orbit, whose pericentre and the direction across it are `plane`, by the oblateness of the
/// central body: `-3/2 n J2 (R / p)^2 cos i`, p = a (1 - e^2), to the first order in J2 (Kozai 1959, The Astronomical Journal 64, 367).
fn node_rate_rad_s(
    given: &Oblateness,
    [p, q]: &[[f64; 3]; 2],
    mean_motion_rad_s: f64,
    (semi_major_axis_m, eccentricity): (f64, f64),
) -> f64 {
    let cos_i = p[0] * q[1] - p[1] * q[0];
    let latus_rectum_m = semi_major_axis_m * (1.0 - eccentricity * eccentricity);
    let ratio = given.equatorial_radius_m / latus_rectum_m;
    -1.5 * mean_motion_rad_s * given.j2 * ratio * ratio * cos_i
}

/// Returns the rate of the node of the orbit of a path, by its directions to the pericentre and across it; 0 without oblateness.
pub(super) fn node_rate_on_path(orbit: &Orbit, pericentre: &[f64], across: &[f64]) -> f64 {
    let plane = [pericentre, across].map(|v| std::array::from_fn(|i| v.get(i).map_or(0.0, |&x| x)));
    orbit.j2.as_ref().map_or(0.0, |given| {
        // The check asked for the semi-major axis.
        let axes = (given.semi_major_axis_m.unwrap_or(f64::INFINITY), orbit.eccentricity);
        node_rate_rad_s(given, &plane, orbit.mean_motion_rad_s, axes)
    })
}

impl ModelPointing {
    /// Reads what a scenario asks for, next to the target of its control; `None` if there is no frame, which a check refuses.
    fn new(
        asked: &Pointing,
        scenario: &Scenario,
        target: Option<&ModelTarget>,
    ) -> Result<Option<Self>, ScenarioError> {
        let followed = asked.orbit_frame.and_then(|k| scenario.scene.driven.get(k as usize));
        let frame = match (&asked.frame, followed) {
            (Some(frame), _) => {
                Some(ModelFrame::Target(ModelTarget::new("/pointing/frame", frame, 3)?))
            }
            (None, Some(driven)) => match &driven.path {
                Some(Path::Orbit(orbit)) => {
                    let pericentre = unit_vector(driven.term.law().space_vector());
                    let plane = [pericentre.clone(), across(&orbit.towards, &pericentre)];
                    Some(ModelFrame::Orbit(plane, orbit.clone()))
                }
                _ => None,
            },
            (None, None) => target.cloned().map(ModelFrame::Target),
        };
        let axis = asked.axis.unwrap_or([0.0, 0.0, 1.0]);
        let towards = asked.towards.unwrap_or(axis);
        let unit = |v: [f64; 3]| -> [f64; 3] { Vector3::from(v).normalize().into() };
        Ok(frame.map(|frame| Self { frame, axis: unit(axis), towards: unit(towards) }))
    }

    fn of<const N: usize>(&self) -> pointing::Pointing<N> {
        let frame = match &self.frame {
            ModelFrame::Target(target) => Frame::Target(target.of()),
            ModelFrame::Orbit([from, towards], orbit) => Frame::Orbit {
                plane: [vector(from.as_slice()), vector(towards.as_slice())],
                mean_motion: orbit.mean_motion_rad_s,
                eccentricity: orbit.eccentricity,
                mean_anomaly: orbit.mean_anomaly_rad,
                node_rate: node_rate_on_path(orbit, from.as_slice(), towards.as_slice()),
            },
        };
        pointing::Pointing { frame, axis: vector(&self.axis), towards: vector(&self.towards) }
    }
}

impl ModelTarget {
    fn new(at: &str, given: &Target, n: usize) -> Result<Self, ScenarioError> {
        let read = |of: &str, given: Option<&_>| attitude(&format!("{at}/{of}attitude"), given, n);
        let still = || [vec![0.0; n], vec![0.0; n]];
        Ok(match given {
            Target::Attitude(given) => {
                Self { start: read("", Some(given))?, plane: still(), rate: 0.0 }
            }
            Target::Turning(TurningTarget { attitude, from, towards, rate_rad_s }) => {
                let from = unit_vector(from);
                let towards = across(towards, &from);
                let plane = [from, towards].map(|v: DVector<f64>| v.as_slice().to_vec());
                Self { start: read("turning/", attitude.as_ref())?, plane, rate: *rate_rad_s }
            }
            Target::Orbit(OrbitTarget { from, towards, mean_motion_rad_s, attitude }) => {
                let z = unit_vector(from);
                let onwards = across(towards, &z);
                let [z, onwards] = [z, onwards].map(|v| Vector3::new(v[0], v[1], v[2]));
                let y = (onwards * mean_motion_rad_s.signum()).cross(&z);
                let axes = [y.cross(&z), y, z];
                let frame = DMatrix::from_fn(3, 3, |i, j| axes[j][i]);
                let plane = [z, onwards].map(|v| v.as_slice().to_vec());
                Self {
                    start: frame * read("orbit/", attitude.as_ref())?,
                    plane,
                    rate: *mean_motion_rad_s,
                }
            }
        })
    }

    fn of<const N: usize>(&self) -> control::Target<N> {
        let [a, b] = &self.plane;
        control::Target {
            start: square(&self.start),
            plane: [vector(a), vector(b)],
            rate: self.rate,
        }
    }
}
