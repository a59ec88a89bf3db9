//! Control of a body by samples, the magnetic field that coils act on, and conditions that end a run.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::driven::{apart, orbit_frame};
use super::range::{
    Check, LARGEST_SEED, attitude, direction, ensure, limit, number, only_three, strength,
};
use super::{Attitude, FieldOrbit, Scenario, Turning};

/// Control by samples: every so often the attitude and the angular velocity are read, a command computed, and held until the next
/// sample. Steps end at the samples, so that a method keeps its order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Control {
    /// Time between samples in s.
    pub every_s: f64,
    /// The attitude aimed at; needed by the law `attitude`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<Target>,
    /// The laws, 1 to 10; their commands add up.
    pub laws: Vec<Law>,
    /// What the commands act through.
    pub through: Through,
    /// Time from a sample to when its command acts, in s; at most `every_s`.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub delay_s: f64,
    /// Commands of torque are whole multiples of this, in N m; 0 for any.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub quantum_n_m: f64,
    /// Largest size of each component of a command through `torque`, in N m; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_n_m: Option<f64>,
    /// Noise; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise: Option<Noise>,
}

/// Noise of the sensors and of a torque, normally distributed, drawn anew at each sample: numbers by seed, stream and sample, the same
/// on any machine, whatever the step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Noise {
    /// Seed of the generator; 0 if absent.
    #[serde(default)]
    pub seed: u64,
    /// Which of the independent streams of that seed; 0 if absent. Member m of an ensemble takes the one m further.
    #[serde(default, skip_serializing_if = "is_none")]
    pub stream: u64,
    /// Standard deviation of the attitude that is read: the turn about each body axis (for n > 3 in each coordinate plane), in rad; 0
    /// if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub attitude_rad: f64,
    /// Standard deviation of each component of the angular velocity that is read, in rad/s; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub rate_rad_s: f64,
    /// Standard deviation of each component of a torque on the body, which is held between samples, in N m; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub torque_n_m: f64,
}

/// An attitude to aim at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// One that stays.
    Attitude(Attitude),
    /// One that turns at a constant rate in a plane of space.
    Turning(TurningTarget),
    /// n = 3: the frame of a circular orbit. Its z points along a direction that turns, its y against the angular momentum of the
    /// orbit, and x = y cross z: for a direction to the planet, x is the direction of flight.
    Orbit(OrbitTarget),
}

/// An attitude that turns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TurningTarget {
    /// The attitude at t = 0; the identity if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<Attitude>,
    /// Vector from which it turns.
    pub from: Vec<f64>,
    /// Vector towards which it turns; the two need not be orthogonal, nor of length one.
    pub towards: Vec<f64>,
    /// Rate in rad/s.
    pub rate_rad_s: f64,
}

/// The frame of a circular orbit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OrbitTarget {
    /// The direction of z at t = 0, for instance to the planet.
    pub from: [f64; 3],
    /// The direction towards which z turns; the two need not be orthogonal, nor of length one.
    pub towards: [f64; 3],
    /// Mean motion, 2 pi over the period, in rad/s.
    pub mean_motion_rad_s: f64,
    /// The attitude aimed at relative to that frame; the frame itself if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attitude: Option<Attitude>,
}

/// A law of control, in body coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Law {
    /// Towards the target: `-gain e - rate_gain (Omega - Omega_target) - integral_gain sum(e every_s)`, e the error from the target
    /// to the body: for n = 3 twice the vector of its quaternion, with the sign of its scalar; else its skew part.
    Attitude(AttitudeLaw),
    /// Against the angular velocity: `-rate_gain Omega`.
    Damping(DampingLaw),
    /// A magnetic moment against the change of the field in the body; for magnetorquers.
    BDot(BDotLaw),
    /// Against the speed w of each wheel relative to the body: `-coefficient w`; for wheels.
    WheelFriction(WheelFriction),
}

/// Towards the target.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AttitudeLaw {
    /// In N m.
    pub gain_n_m: f64,
    /// In N m s.
    pub rate_gain_n_m_s: f64,
    /// In N m / s; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub integral_gain_n_m_per_s: f64,
    /// Also the torque that makes up for the momentum of the turning body, `Omega cross mu`; `false` if absent.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub feed_forward: bool,
}

/// Against the angular velocity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DampingLaw {
    /// In N m s.
    pub rate_gain_n_m_s: f64,
}

/// Against the speed of a wheel relative to the body, about its axis: a bearing, or a fluid in a ring.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WheelFriction {
    /// In N m s; at most the moment of the wheel over `every_s`, which stops it within one sample.
    pub coefficient_n_m_s: f64,
}

/// Against the change of the field.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BDotLaw {
    /// In A m^2 s / T.
    pub gain_a_m2_s_per_t: f64,
}

/// What commands act through.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Through {
    /// A torque on the body.
    Torque,
    /// n = 3: reaction wheels.
    Wheels(Wheels),
    /// n = 3: three coils along the body axes, in the field of the scene.
    Magnetorquers(Magnetorquers),
}

/// Reaction wheels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Wheels {
    /// Their axes in the body, of any length but zero: up to three that are independent, or more that span space.
    pub axes: Vec<[f64; 3]>,
    /// Their moments of inertia about these in kg m^2, which the inertia of the body includes; 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moments_kg_m2: Option<Vec<f64>>,
    /// Their momenta about these at t = 0 in N m s: `j (w + a . Omega)`, w the speed relative to the body; those of wheels at rest in the body if absent (in an ensemble those of the scene's own start, for every member).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub momenta: Option<Vec<f64>>,
    /// Largest motor torque in N m; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_n_m: Option<f64>,
    /// Largest momentum relative to the body in N m s; none if absent. A command that would pass it is cut at its sample.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_n_m_s: Option<f64>,
}

/// Coils.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Magnetorquers {
    /// Largest size of each component of the moment in A m^2; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit_a_m2: Option<f64>,
}

/// A magnetic field; n = 3.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Field {
    /// That of a dipole, along an orbit about it.
    Dipole(Dipole),
}

/// The field of a dipole, along an orbit about it: `B = moment / r^3 (3 (d . x) x - d)`, d being -z, tilted, as for the Earth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Dipole {
    /// Strength in T m^3; 7.96e15 for the Earth.
    pub moment_t_m3: f64,
    /// Angle of the dipole from the z axis, towards x at t = 0, in rad; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub tilt_rad: f64,
    /// Rate at which it turns about z in rad/s, 7.292e-5 for the Earth; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub rotation_rad_s: f64,
    /// The orbit.
    pub orbit: FieldOrbit,
    /// A permanent magnetic moment of the body in A m^2: the term `-m . g^T B` of the potential; none if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub permanent_moment_a_m2: Option<[f64; 3]>,
}

/// Where the body points, at each sample: its attitude and rate relative to a frame, and one of its axes against a direction; n = 3.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Pointing {
    /// The frame; the target of the control if neither it nor `orbit_frame` is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<Target>,
    /// The number of a term of `driven`, from 0, that follows an orbit, as in the start: the frame of that orbit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub orbit_frame: Option<u32>,
    /// An axis of the body, of any length; z if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axis: Option<[f64; 3]>,
    /// Where it is to point, in coordinates of the frame, of any length; as `axis` in the body if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub towards: Option<[f64; 3]>,
}

/// A condition that ends a run; it is then a success that says so.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Stop {
    /// Several bodies: the name of that whose rate or angle it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub body: Option<String>,
    /// The angle to the target of the control is below this, in rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pointing_error_below_rad: Option<f64>,
    /// The size of the angular velocity is below this, in rad/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_below_rad_s: Option<f64>,
    /// The angle to an attitude is above a limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub angle_above_rad: Option<AngleAbove>,
    /// The size of the energy error is above this, in J.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub energy_error_above_j: Option<f64>,
    /// Several bodies: the distance of two points is below a limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_below_m: Option<DistanceLimit>,
    /// Several bodies: the distance of two points is above a limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance_above_m: Option<DistanceLimit>,
    /// For how long it must hold, in s; 0 if absent.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub for_s: f64,
    /// Whether the run ends within the step in which it comes to hold, at a time located to 1e-9 s; after that step if absent.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub exact: bool,
}

/// An angle to an attitude.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AngleAbove {
    /// The limit in rad.
    pub angle_rad: f64,
    /// The attitude; that at the start if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<Attitude>,
}

/// A distance of two bodies, or of points of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DistanceLimit {
    /// The limit in m.
    pub distance_m: f64,
    /// Names of the bodies; one may be `space`, which does not move.
    pub between: [String; 2],
    /// A point of each, in its body's coordinates, for `space` a point of space; if absent the centres of mass, of a pinned body
    /// its pivot, of space the origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub points: Option<[Vec<f64>; 2]>,
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = self.body.as_ref().map_or_else(String::new, |body| format!(" of {body}"));
        for (limit, is) in [(&self.distance_below_m, "below"), (&self.distance_above_m, "above")] {
            if let Some(DistanceLimit { distance_m, between: [one, other], .. }) = limit {
                write!(f, "distance of {one} and {other} {is} {distance_m} m")?;
            }
        }
        if let Some(angle) = self.pointing_error_below_rad {
            write!(f, "pointing error below {angle} rad")?;
        }
        if let Some(rate) = self.rate_below_rad_s {
            write!(f, "rate{of} below {rate} rad/s")?;
        }
        if let Some(above) = &self.angle_above_rad {
            write!(f, "angle{of} above {} rad", above.angle_rad)?;
        }
        if let Some(energy) = self.energy_error_above_j {
            write!(f, "energy error above {energy} J")?;
        }
        if self.for_s > 0.0 { write!(f, " for {} s", self.for_s) } else { Ok(()) }
    }
}

pub(super) fn is_zero(x: &f64) -> bool {
    *x == 0.0
}

fn is_none(number: &u64) -> bool {
    *number == 0
}

impl Control {
    /// Checks form and range for a body of n dimensions, in a field or not.
    pub(super) fn check(&self, n: usize, has_field: bool) -> Check {
        /// Most laws.
        const MOST: usize = 10;
        let at = "/scene/control";
        ensure(self.every_s >= 1e-9 && self.every_s <= 1e9, format!("{at}/every_s"), || {
            format!("{:?} given, a time between samples is from 1e-9 to 1e9 s", self.every_s)
        })?;
        ensure((0.0..=self.every_s).contains(&self.delay_s), format!("{at}/delay_s"), || {
            format!(
                "{:?} given, a delay is from 0 to `every_s`, {:?} s",
                self.delay_s, self.every_s
            )
        })?;
        limit(&format!("{at}/quantum_n_m"), Some(self.quantum_n_m), true)?;
        limit(&format!("{at}/limit_n_m"), self.limit_n_m, false)?;
        let plain = matches!(self.through, Through::Torque);
        ensure(self.limit_n_m.is_none() || plain, format!("{at}/limit_n_m"), || {
            "is for commands through `torque`; wheels and magnetorquers have limits of their own"
                .to_owned()
        })?;
        ensure((1..=MOST).contains(&self.laws.len()), format!("{at}/laws"), || {
            format!("{} laws given, 1 to {MOST} are allowed", self.laws.len())
        })?;
        let coils = matches!(self.through, Through::Magnetorquers(_));
        for (index, law) in self.laws.iter().enumerate() {
            let at = format!("{at}/laws/{index}");
            match law {
                Law::Attitude(law) => {
                    let at = format!("{at}/attitude");
                    ensure(self.target.is_some(), "/scene/control/target", || {
                        format!("is missing; the law at {at} needs one")
                    })?;
                    strength(&format!("{at}/gain_n_m"), law.gain_n_m)?;
                    strength(&format!("{at}/rate_gain_n_m_s"), law.rate_gain_n_m_s)?;
                    strength(
                        &format!("{at}/integral_gain_n_m_per_s"),
                        law.integral_gain_n_m_per_s,
                    )?;
                }
                Law::Damping(law) => {
                    strength(&format!("{at}/damping/rate_gain_n_m_s"), law.rate_gain_n_m_s)?;
                }
                Law::BDot(law) => {
                    ensure(coils, format!("{at}/b_dot"), || {
                        "acts through magnetorquers alone; `\"through\": {\"magnetorquers\": {}}` is needed"
                            .to_owned()
                    })?;
                    strength(&format!("{at}/b_dot/gain_a_m2_s_per_t"), law.gain_a_m2_s_per_t)?;
                }
                Law::WheelFriction(law) => {
                    self.check_friction(&format!("{at}/wheel_friction"), *law)?;
                }
            }
        }
        if let Some(target) = &self.target {
            target.check("/scene/control/target", n)?;
        }
        if let Some(noise) = &self.noise {
            noise.check()?;
        }
        self.through.check(n, has_field)
    }
}

impl Control {
    fn check_friction(&self, at: &str, law: WheelFriction) -> Check {
        let Through::Wheels(wheels) = &self.through else {
            return ensure(false, at, || {
                "acts on wheels alone; `\"through\": {\"wheels\": ...}` is needed".to_owned()
            });
        };
        let moments = wheels.moments_kg_m2.as_deref().unwrap_or_default();
        let least = moments.iter().copied().reduce(f64::min).unwrap_or_default();
        ensure(least > 0.0, "/scene/control/through/wheels/moments_kg_m2", || {
            format!("is needed, with numbers above 0; the law at {at} slows wheels by their speed")
        })?;
        let at = format!("{at}/coefficient_n_m_s");
        limit(&at, Some(law.coefficient_n_m_s), true)?;
        let most = least / self.every_s;
        ensure(law.coefficient_n_m_s <= most, at, || {
            format!(
                "{:?} given, but held for `every_s` more than {most:e} turns a wheel back; give less, or samples closer together",
                law.coefficient_n_m_s
            )
        })
    }
}

impl Noise {
    fn check(&self) -> Check {
        let at = "/scene/control/noise";
        for (name, number) in [("seed", self.seed), ("stream", self.stream)] {
            ensure(number <= LARGEST_SEED, format!("{at}/{name}"), || {
                format!("{number} given, it is at most {LARGEST_SEED}")
            })?;
        }
        let turn = self.attitude_rad;
        ensure((0.0..=std::f64::consts::PI).contains(&turn), format!("{at}/attitude_rad"), || {
            format!("{turn:?} given, a deviation of turns is from 0 to pi")
        })?;
        limit(&format!("{at}/attitude_rad"), Some(turn), true)?;
        limit(&format!("{at}/rate_rad_s"), Some(self.rate_rad_s), true)?;
        limit(&format!("{at}/torque_n_m"), Some(self.torque_n_m), true)?;
        ensure(turn > 0.0 || self.rate_rad_s > 0.0 || self.torque_n_m > 0.0, at, || {
            "has no deviation above 0; give `attitude_rad`, `rate_rad_s` or `torque_n_m`".to_owned()
        })
    }
}

impl Pointing {
    pub(super) fn check(&self, scenario: &Scenario, n: usize) -> Check {
        let at = "/pointing";
        only_three(at, n)?;
        let scene = &scenario.scene;
        let has_target = scene.control.as_ref().is_some_and(|control| control.target.is_some());
        match (&self.frame, self.orbit_frame) {
            (Some(frame), None) => frame.check(&format!("{at}/frame"), n)?,
            (None, Some(index)) => {
                orbit_frame(&format!("{at}/orbit_frame"), &scene.driven, index)?;
            }
            (Some(_), Some(_)) => ensure(false, format!("{at}/orbit_frame"), || {
                "is given together with `frame`; give one of the two".to_owned()
            })?,
            (None, None) => ensure(has_target, at, || {
                "needs `frame` or `orbit_frame`, for there is no /scene/control/target".to_owned()
            })?,
        }
        for (name, axis) in [("axis", &self.axis), ("towards", &self.towards)] {
            if let Some(axis) = axis {
                direction(&format!("{at}/{name}"), axis, 3)?;
            }
        }
        Ok(())
    }
}

impl Target {
    fn check(&self, at: &str, n: usize) -> Check {
        match self {
            Self::Attitude(given) => attitude(&format!("{at}/attitude"), given, n),
            Self::Turning(TurningTarget { attitude: start, from, towards, rate_rad_s }) => {
                let at = format!("{at}/turning");
                if let Some(given) = start {
                    attitude(&format!("{at}/attitude"), given, n)?;
                }
                let (from, towards) = (from.clone(), towards.clone());
                Turning { from, towards, rate_rad_s: *rate_rad_s }.check(&at, n)
            }
            Self::Orbit(orbit) => {
                let at = format!("{at}/orbit");
                only_three(&at, n)?;
                if let Some(given) = &orbit.attitude {
                    attitude(&format!("{at}/attitude"), given, n)?;
                }
                plane(&at, &orbit.from, &orbit.towards)?;
                strength(&format!("{at}/mean_motion_rad_s"), orbit.mean_motion_rad_s)
            }
        }
    }
}

impl Through {
    fn check(&self, n: usize, has_field: bool) -> Check {
        /// Most wheels.
        const MOST: usize = 100;
        let at = "/scene/control/through";
        match self {
            Self::Torque => Ok(()),
            Self::Wheels(wheels) => {
                let at = format!("{at}/wheels");
                only_three(&at, n)?;
                let count = wheels.axes.len();
                ensure((1..=MOST).contains(&count), format!("{at}/axes"), || {
                    format!("{count} axes given, 1 to {MOST} wheels are allowed")
                })?;
                for (index, axis) in wheels.axes.iter().enumerate() {
                    direction(&format!("{at}/axes/{index}"), axis, 3)?;
                }
                let of_each = |name: &str, given: &Option<Vec<f64>>| {
                    let Some(given) = given else { return Ok(()) };
                    let at = format!("{at}/{name}");
                    ensure(given.len() == count, &at, || {
                        format!("{} numbers given for {count} axes", given.len())
                    })?;
                    given
                        .iter()
                        .enumerate()
                        .try_for_each(|(i, &x)| strength(&format!("{at}/{i}"), x))
                };
                of_each("moments_kg_m2", &wheels.moments_kg_m2)?;
                of_each("momenta", &wheels.momenta)?;
                for (index, &moment) in wheels.moments_kg_m2.iter().flatten().enumerate() {
                    ensure(moment >= 0.0, format!("{at}/moments_kg_m2/{index}"), || {
                        format!("{moment:?} given, a moment of inertia is not below 0")
                    })?;
                }
                limit(&format!("{at}/limit_n_m"), wheels.limit_n_m, false)?;
                limit(&format!("{at}/limit_n_m_s"), wheels.limit_n_m_s, false)
            }
            Self::Magnetorquers(coils) => {
                let at = format!("{at}/magnetorquers");
                only_three(&at, n)?;
                ensure(has_field, &at, || {
                    "needs a field; `\"field\": {\"dipole\": ...}` in the scene gives one"
                        .to_owned()
                })?;
                limit(&format!("{at}/limit_a_m2"), coils.limit_a_m2, false)
            }
        }
    }
}

impl Field {
    pub(super) fn check(&self, n: usize) -> Check {
        let Self::Dipole(dipole) = self;
        let at = "/scene/field/dipole";
        only_three(at, n)?;
        strength(&format!("{at}/moment_t_m3"), dipole.moment_t_m3 / 1e15)?;
        number(&format!("{at}/tilt_rad"), dipole.tilt_rad)?;
        strength(&format!("{at}/rotation_rad_s"), dipole.rotation_rad_s)?;
        if let Some(moment) = &dipole.permanent_moment_a_m2 {
            super::range::point(&format!("{at}/permanent_moment_a_m2"), moment, 3)?;
        }
        dipole.orbit.check(&format!("{at}/orbit"))
    }
}

/// Checks the conditions that end a run.
pub(super) fn stops(scenario: &Scenario, n: usize) -> Check {
    /// Most conditions.
    const MOST: usize = 100;
    let count = scenario.until.len();
    ensure(count <= MOST, "/until", || format!("{count} given, at most {MOST} are allowed"))?;
    for (index, stop) in scenario.until.iter().enumerate() {
        let at = format!("/until/{index}");
        let given = [
            stop.pointing_error_below_rad.is_some(),
            stop.rate_below_rad_s.is_some(),
            stop.angle_above_rad.is_some(),
            stop.energy_error_above_j.is_some(),
            stop.distance_below_m.is_some(),
            stop.distance_above_m.is_some(),
        ];
        let given = given.into_iter().filter(|&given| given).count();
        ensure(given == 1, &at, || {
            let which = match scenario.bodies() {
                None => {
                    "`pointing_error_below_rad`, `rate_below_rad_s`, `angle_above_rad`, `energy_error_above_j`"
                }
                Some(_) => {
                    "`rate_below_rad_s`, `angle_above_rad`, `energy_error_above_j`, `distance_below_m`, `distance_above_m`"
                }
            };
            format!("{given} conditions given, one of {which} is needed")
        })?;
        match scenario.bodies() {
            Some(bodies) => bodies.check_stop(&at, stop, n)?,
            None => only_of_several(&at, stop)?,
        }
        limit(&format!("{at}/pointing_error_below_rad"), stop.pointing_error_below_rad, false)?;
        limit(&format!("{at}/rate_below_rad_s"), stop.rate_below_rad_s, false)?;
        limit(&format!("{at}/energy_error_above_j"), stop.energy_error_above_j, true)?;
        limit(&format!("{at}/for_s"), Some(stop.for_s), true)?;
        if let Some(AngleAbove { angle_rad, from }) = &stop.angle_above_rad {
            let angle_at = format!("{at}/angle_above_rad/angle_rad");
            limit(&angle_at, Some(*angle_rad), true)?;
            // Half a turn in each plane.
            let largest = std::f64::consts::PI * libm::sqrt((n / 2) as f64);
            ensure(*angle_rad < largest, angle_at, || {
                format!(
                    "{angle_rad:?} given, no angle is above {largest:.6} rad; give a smaller one"
                )
            })?;
            if let Some(given) = from {
                attitude(&format!("{at}/angle_above_rad/from"), given, n)?;
            }
        }
        ensure(!stop.exact || stop.for_s == 0.0, format!("{at}/exact"), || {
            "a condition that must hold for some time is looked at after steps; leave out `exact` or `for_s`".to_owned()
        })?;
        let has_target = scenario.scene.control.as_ref().is_some_and(|it| it.target.is_some());
        let aims = stop.pointing_error_below_rad.is_some();
        ensure(has_target || !aims, format!("{at}/pointing_error_below_rad"), || {
            "needs a target, `/scene/control/target`".to_owned()
        })?;
    }
    Ok(())
}

/// Refuses what several bodies have alone.
fn only_of_several(at: &str, stop: &Stop) -> Check {
    let given = [
        ("body", stop.body.is_some()),
        ("distance_below_m", stop.distance_below_m.is_some()),
        ("distance_above_m", stop.distance_above_m.is_some()),
    ];
    given.into_iter().try_for_each(|(field, given)| {
        ensure(!given, format!("{at}/{field}"), || {
            "is for scenes of several bodies, this one has one".to_owned()
        })
    })
}

pub(super) fn plane(at: &str, from: &[f64; 3], towards: &[f64; 3]) -> Check {
    direction(&format!("{at}/from"), from, 3)?;
    direction(&format!("{at}/towards"), towards, 3)?;
    apart(&format!("{at}/towards"), from, towards, "`from`")
}
