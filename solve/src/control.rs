//! What a controlled body aims at, by which laws, and what its controller knows. The control of a body is
//! [`crate::hamiltonian::Control`].
//!
//! Invariant: the error of an attitude is zero on its target alone, or half a turn away where n is not 3.

use super::so::{self, Mat, Vector};
use super::time::Time;

/// An attitude to aim at, which may turn in a plane of space: `R(t) start`.
#[derive(Clone, Debug, PartialEq)]
pub struct Target<const N: usize> {
    /// The attitude at t = 0.
    pub start: Mat<N>,
    /// Two orthonormal vectors of space; it turns from the first towards the second.
    pub plane: [Vector<N>; 2],
    /// Turn rate, in rad/s.
    pub rate: f64,
}

/// A law of control. The torque wanted is in body coordinates, with `e` the error, from the target to the body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ControlLaw {
    /// `-gain e - rate_gain (Omega - Omega_target) - integral_gain (sum of e every_s)`; for n = 3 `e = 2 sign(q0) (q1, q2, q3)`
    /// of the quaternion of the error, else the skew part of `g_target^T g`.
    Attitude {
        /// In N m.
        gain: f64,
        /// In N m s.
        rate_gain: f64,
        /// In N m / s.
        integral_gain: f64,
        /// Is `-[mu, Omega]` added, which the torque of the spinning body would be?
        feed_forward: bool,
    },
    /// `-rate_gain Omega`.
    Damping {
        /// In N m s.
        rate_gain: f64,
    },
    /// A moment `-gain (B - B at the sample before) / every_s`, B the field in the body; for magnetorquers.
    BDot {
        /// In A m^2 s / T.
        gain: f64,
    },
    /// `-coefficient w` on each wheel, w its speed relative to the body; for wheels with moments of inertia. It is internal: no
    /// limit of a motor cuts it, and it is not of the torque wanted.
    WheelFriction {
        /// In N m s.
        coefficient: f64,
    },
}

/// What a controller knows: enough to go on from a checkpoint.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ControlState {
    /// Samples taken.
    pub samples: u64,
    /// The command that acts: components of a torque, motor torques, or a moment.
    pub acting: Vec<f64>,
    /// Since when it does, in s.
    pub since_s: f64,
    /// A command that waits for its delay; empty if none does.
    pub waiting: Vec<f64>,
    /// Momenta of the wheels about their axes when the command began to act, in N m s.
    pub momenta: Vec<f64>,
    /// Sum of the attitude error times the time between samples.
    pub integral: Vec<f64>,
    /// The field in the body at the last sample, in T; empty before.
    pub field: Vec<f64>,
}

/// What a sample of the control saw and did; errors are those that the sensors show.
#[derive(Clone, Debug, PartialEq)]
pub struct ControlSample {
    /// Its time, in s.
    pub time_s: f64,
    /// Torque wanted, in N m; of a law that names a moment, that moment in A m^2.
    pub wanted: Vec<f64>,
    /// The command after limits and quantum: a torque in N m, motor torques in N m, or a moment in A m^2.
    pub command: Vec<f64>,
    /// Did a limit change it?
    pub is_saturated: bool,
    /// Attitude error: the angle of `g_target^T g` in rad (n = 3; else the norm of its skew part); `None` without a target.
    pub pointing_error_rad: Option<f64>,
    /// The attitude error by its components, from the target to the body.
    pub attitude_error: Vec<f64>,
    /// `Omega - Omega_target` by its components, in rad/s.
    pub rate_error: Vec<f64>,
    /// Momenta of the wheels about their axes, in N m s.
    pub wheel_momenta: Vec<f64>,
    /// Speeds of the wheels relative to the body, in rad/s; of those with a moment of inertia.
    pub wheel_speeds: Vec<f64>,
    /// The field in the body, in T.
    pub field: Vec<f64>,
    /// Noise of the torque until the next sample, in N m; empty without.
    pub disturbance: Vec<f64>,
}

impl ControlSample {
    /// Is every number of it finite?
    pub(crate) fn is_finite(&self) -> bool {
        let lists = [
            &self.wanted,
            &self.command,
            &self.attitude_error,
            &self.rate_error,
            &self.wheel_momenta,
            &self.wheel_speeds,
            &self.field,
            &self.disturbance,
        ];
        self.pointing_error_rad.is_none_or(f64::is_finite)
            && lists.into_iter().flatten().all(|x| x.is_finite())
    }
}

impl<const N: usize> Target<N> {
    /// A target that stays.
    pub fn fixed(start: Mat<N>) -> Self {
        Self { start, plane: [Vector::zeros(); 2], rate: 0.0 }
    }

    /// Its attitude at a time in seconds.
    pub fn attitude(&self, time_s: f64) -> Mat<N> {
        if self.rate == 0.0 {
            return self.start;
        }
        let [a, b] = &self.plane;
        let (sin, cos) = libm::sincos(Time::of(time_s).angle(self.rate, 0.0));
        // R = I + (cos - 1) (a a^T + b b^T) + sin (b a^T - a b^T)
        let turned = Mat::from_fn(|i, j| {
            let both = a[i] * a[j] + b[i] * b[j];
            let across = b[i] * a[j] - a[i] * b[j];
            f64::from(i == j) + (cos - 1.0) * both + sin * across
        });
        so::product(&turned, &self.start)
    }

    /// The rate at which it turns, skew, in space coordinates and rad/s.
    pub fn rate(&self) -> Mat<N> {
        let [a, b] = &self.plane;
        so::wedge(b, a) * self.rate
    }

    /// The error of an attitude at a time, from the target to the body: skew, and its angle in rad. For n = 3 the vector is
    /// `2 sign(q0) (q1, q2, q3)`; else the skew part of `g_target^T g`, which is small at half a turn as well. The angle is [`so::angle`].
    pub fn error(&self, time_s: f64, g: &Mat<N>) -> (Mat<N>, f64) {
        let turn = so::transposed_product(&self.attitude(time_s), g);
        if let Some([w, x, y, z]) = so::quaternion(&turn) {
            let vector = [2.0 * x, 2.0 * y, 2.0 * z];
            let sine = so::norm(&[x, y, z]);
            return (so::hat(&vector), 2.0 * libm::atan2(sine, w));
        }
        (so::asym(&turn) * 0.5, so::angle(&turn))
    }
}
