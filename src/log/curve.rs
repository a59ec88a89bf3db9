//! The quantities that charts show over time, and where a log holds them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::messages::Message;
use super::schema::Channel;

/// Quantity that a chart shows over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Curve {
    /// Total energy minus that at the start, in joule.
    EnergyError,
    /// Distance of the attitude from the group.
    OrthogonalityError,
    /// Change of the part of the spatial momentum that the scene conserves, in kg m^2/s.
    MomentumDrift,
    /// Angular velocity in body coordinates, in rad/s.
    AngularVelocity,
    /// Angular momentum in body coordinates, in kg m^2/s.
    BodyMomentum,
    /// Spatial angular momentum, in kg m^2/s.
    SpatialMomentum,
    /// Angle of each axis of the body to the axis of space of the same number, in rad.
    AxisAngle,
    /// Length of an adaptive step, in s.
    Step,
    /// Angle between an axis of the body and its direction, in rad.
    AxisError,
    /// Roll, pitch and yaw relative to a frame, in rad.
    RollPitchYaw,
    /// Angular velocity relative to that frame, in body coordinates and rad/s.
    RelativeRate,
    /// Angle between the body and the target of its control, as the sensors show it, in rad.
    PointingError,
    /// Commands of a control after their limits: torques or motor torques in N m, moments of coils in A m^2.
    ControlCommand,
    /// Momentum of each driven wheel about its axis, in N m s.
    WheelMomenta,
    /// Speed of each of these relative to the body, in rad/s.
    WheelSpeeds,
}

impl Curve {
    /// All quantities.
    pub const ALL: [Self; 15] = [
        Self::EnergyError,
        Self::OrthogonalityError,
        Self::MomentumDrift,
        Self::AngularVelocity,
        Self::BodyMomentum,
        Self::SpatialMomentum,
        Self::AxisAngle,
        Self::Step,
        Self::AxisError,
        Self::RollPitchYaw,
        Self::RelativeRate,
        Self::PointingError,
        Self::ControlCommand,
        Self::WheelMomenta,
        Self::WheelSpeeds,
    ];

    /// Returns its name in queries and answers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::EnergyError => "energy_error",
            Self::OrthogonalityError => "orthogonality_error",
            Self::MomentumDrift => "momentum_drift",
            Self::AngularVelocity => "angular_velocity",
            Self::BodyMomentum => "body_momentum",
            Self::SpatialMomentum => "spatial_momentum",
            Self::AxisAngle => "axis_angle",
            Self::Step => "step",
            Self::AxisError => "axis_error",
            Self::RollPitchYaw => "roll_pitch_yaw",
            Self::RelativeRate => "relative_rate",
            Self::PointingError => "pointing_error",
            Self::ControlCommand => "control_command",
            Self::WheelMomenta => "wheel_momenta",
            Self::WheelSpeeds => "wheel_speeds",
        }
    }

    /// The unit of its values; empty for a number.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::EnergyError => "J",
            Self::OrthogonalityError => "",
            Self::AngularVelocity | Self::RelativeRate | Self::WheelSpeeds => "rad/s",
            Self::AxisAngle | Self::AxisError | Self::RollPitchYaw | Self::PointingError => "rad",
            Self::Step => "s",
            Self::ControlCommand => "N m, of coils A m²",
            Self::WheelMomenta => "N m s",
            Self::MomentumDrift | Self::BodyMomentum | Self::SpatialMomentum => "kg m²/s",
        }
    }

    /// Returns the channel whose messages hold it.
    pub const fn channel(self) -> Channel {
        match self {
            Self::EnergyError => Channel::Energy,
            Self::OrthogonalityError => Channel::Orthogonality,
            Self::MomentumDrift | Self::SpatialMomentum => Channel::Momentum,
            Self::AngularVelocity | Self::BodyMomentum | Self::AxisAngle => Channel::State,
            Self::Step => Channel::Pace,
            Self::AxisError | Self::RollPitchYaw | Self::RelativeRate => Channel::Pointing,
            Self::PointingError | Self::ControlCommand | Self::WheelMomenta | Self::WheelSpeeds => {
                Channel::Control
            }
        }
    }

    /// Adds its values from a message of its channel; nothing if the message holds none.
    pub(super) fn values(self, message: &Message, velocity: Velocity<'_>, values: &mut Vec<f64>) {
        match (self, message) {
            (Self::EnergyError, Message::Energy(energy)) => values.push(energy.error),
            (Self::OrthogonalityError, Message::Orthogonality(found)) => values.push(found.error),
            (Self::MomentumDrift, Message::Momentum(momentum)) => values.extend(momentum.drift),
            (Self::SpatialMomentum, Message::Momentum(momentum)) => {
                values.extend_from_slice(&momentum.spatial_momentum);
            }
            (Self::BodyMomentum, Message::State(state)) => {
                values.extend_from_slice(&state.body_momentum);
            }
            (Self::AngularVelocity, Message::State(state)) => {
                // Logs of earlier builds hold the momentum alone.
                match state.angular_velocity.as_slice() {
                    [] => values.extend(velocity(&state.body_momentum)),
                    found => values.extend_from_slice(found),
                }
            }
            (Self::AxisAngle, Message::State(state)) => {
                let n = state.attitude.len().isqrt();
                let cosine = |k: usize| state.attitude[k * (n + 1)].clamp(-1.0, 1.0);
                values.extend((0..n).map(|k| libm::acos(cosine(k))));
            }
            (Self::Step, Message::Pace(pace)) => values.push(pace.step_s),
            (Self::AxisError, Message::Pointing(seen)) => values.push(seen.axis_error_rad),
            (Self::RollPitchYaw, Message::Pointing(seen)) => {
                values.extend([seen.roll_rad, seen.pitch_rad, seen.yaw_rad]);
            }
            (Self::RelativeRate, Message::Pointing(seen)) => values.extend_from_slice(&seen.rate),
            (Self::PointingError, Message::Control(seen)) => values.extend(seen.pointing_error_rad),
            (Self::ControlCommand, Message::Control(seen)) => {
                values.extend_from_slice(&seen.command);
            }
            (Self::WheelMomenta, Message::Control(seen)) => {
                values.extend_from_slice(&seen.wheel_momenta);
            }
            (Self::WheelSpeeds, Message::Control(seen)) => {
                values.extend_from_slice(&seen.wheel_speeds);
            }
            _ => {}
        }
    }
}

/// Function that returns the angular velocity of a momentum, both in body coordinates.
pub type Velocity<'a> = &'a (dyn Fn(&[f64]) -> Vec<f64> + Sync);
