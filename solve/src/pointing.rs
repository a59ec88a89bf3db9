//! Where a body points: its attitude and its rate relative to a frame, and one of its axes against a direction there; n = 3.
//!
//! Invariant: nothing of it changes a motion; it is computed at samples alone, and only for those who ask.

use super::control::Target;
use super::kepler::{about_z, eccentric_anomaly, z_axis};
use super::so::{self, Mat, Vector};
use super::time::Time;

/// A frame and an axis of the body.
#[derive(Clone, Debug, PartialEq)]
pub struct Pointing<const N: usize> {
    /// The frame.
    pub frame: Frame<N>,
    /// An axis of the body, of length one.
    pub axis: Vector<N>,
    /// Where it is to point, of length one, in coordinates of the frame.
    pub towards: Vector<N>,
}

/// A frame in space.
#[derive(Clone, Debug, PartialEq)]
pub enum Frame<const N: usize> {
    /// One that stays, or turns at a constant rate.
    Target(Target<N>),
    /// That of a Kepler orbit: z along a direction that follows it, y against its angular momentum, x = y cross z.
    Orbit {
        /// Orthonormal vectors of space: z at the pericentre, and towards which z turns there if `mean_motion` is positive.
        plane: [Vector<N>; 2],
        /// Mean motion, in rad/s.
        mean_motion: f64,
        /// Eccentricity, from 0 to less than 1.
        eccentricity: f64,
        /// Mean anomaly at t = 0, in rad.
        mean_anomaly: f64,
        /// Rate at which the plane turns about z, in rad/s.
        node_rate: f64,
    },
}

/// What a sample shows of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pointed {
    /// Angle between the axis of the body and its direction, in rad.
    pub axis_error_rad: f64,
    /// The attitude relative to the frame, `R_z(yaw) R_y(pitch) R_x(roll)`: roll, pitch, yaw in rad, pitch from -pi/2 to pi/2. Where
    /// that is at its end roll is zero, for yaw alone says the rest.
    pub roll_pitch_yaw_rad: [f64; 3],
    /// Angular velocity relative to the frame, in body coordinates and rad/s.
    pub rate_rad_s: [f64; 3],
    /// The frame: unit quaternion (w, x, y, z) from its coordinates to those of space.
    pub frame: [f64; 4],
}

impl Pointed {
    /// Is every number of it finite?
    pub(crate) fn is_finite(&self) -> bool {
        let Self { axis_error_rad, roll_pitch_yaw_rad, rate_rad_s, frame } = self;
        let lists = roll_pitch_yaw_rad.iter().chain(rate_rad_s).chain(frame);
        axis_error_rad.is_finite() && lists.copied().all(f64::is_finite)
    }
}

impl<const N: usize> Frame<N> {
    /// Its axes as columns, and the rate at which it turns, skew, in space coordinates, at a time in seconds.
    fn at(&self, time_s: f64) -> (Mat<N>, Mat<N>) {
        match self {
            Self::Target(target) => (target.attitude(time_s), target.rate()),
            Self::Orbit {
                plane: [p, q],
                mean_motion,
                eccentricity: e,
                mean_anomaly,
                node_rate,
            } => {
                let anomaly = Time::of(time_s).angle(*mean_motion, *mean_anomaly);
                let (sin, cos) = eccentric_anomaly(anomaly, *e);
                // r / a, and the direction by the true anomaly.
                let (r, root) = (1.0 - e * cos, (1.0 - e * e).sqrt());
                let (along, across) = ((cos - e) / r, root * sin / r);
                let z = p * along + q * across;
                // Against the motion of z, which is that to the planet; z' = W z, and the plane stays.
                let x = (p * across - q * along).scale(mean_motion.signum());
                let turning = mean_motion * root / (r * r);
                let y = so::to_space(&so::hat(z.as_slice()), &x);
                let axes = [&x, &y, &z];
                let axes = Mat::from_fn(|i, j| axes[j][i]);
                let rate = so::wedge(q, p) * turning;
                if *node_rate == 0.0 {
                    return (axes, rate);
                }
                let turn = about_z(Time::of(time_s).angle(*node_rate, 0.0));
                let drift = z_axis::<N>() * *node_rate;
                (so::product(&turn, &axes), so::conjugate(&turn, &rate) + drift)
            }
        }
    }
}

impl<const N: usize> Pointing<N> {
    /// Returns what there is to be seen at a time in seconds, for an attitude and an angular velocity; `None` if n is not 3.
    pub(crate) fn at(&self, time_s: f64, g: &Mat<N>, omega: &Mat<N>) -> Option<Pointed> {
        /// Cosine of a pitch at which roll and yaw are lost in round-off.
        const LOCKED: f64 = 1e-9;
        if N != 3 {
            return None;
        }
        let (axes, turning) = self.frame.at(time_s);
        let frame = so::quaternion(&axes)?;
        let r = so::transposed_product(&axes, g);
        let cosine = so::norm(&[r[(0, 0)], r[(1, 0)]]);
        let pitch = libm::atan2(-r[(2, 0)], cosine);
        let (roll, yaw) = if cosine > LOCKED {
            (libm::atan2(r[(2, 1)], r[(2, 2)]), libm::atan2(r[(1, 0)], r[(0, 0)]))
        } else {
            (0.0, libm::atan2(-r[(0, 1)], r[(1, 1)]))
        };
        let seen = so::to_space(&r, &self.axis);
        // Twice the angle of the half: exact next to 0 and to pi (Kahan 2006).
        let length = |sign: f64| so::norm((seen + self.towards * sign).as_slice());
        let rate = so::vee(&(omega - so::conjugate(&g.transpose(), &turning)));
        Some(Pointed {
            axis_error_rad: 2.0 * libm::atan2(length(-1.0), length(1.0)),
            roll_pitch_yaw_rad: [roll, pitch, yaw],
            rate_rad_s: std::array::from_fn(|i| rate.get(i).copied().unwrap_or_default()),
            frame,
        })
    }
}
