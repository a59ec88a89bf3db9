//! Motion along a Kepler orbit.
//!
//! Invariant: solutions are exact to round-off for every eccentricity below one.

use super::so::Mat;
use super::time::Time;

/// A circular or elliptic orbit about the origin, whose plane may turn about z; n = 3, in space coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// Unit vectors at t = 0: to the pericentre, and across it in the plane of the orbit in the direction of flight.
    pub plane: [[f64; 3]; 2],
    /// Semi-major axis, in m.
    pub semi_major_axis_m: f64,
    /// Mean motion, in rad/s.
    pub mean_motion_rad_s: f64,
    /// Eccentricity, from 0 to less than 1.
    pub eccentricity: f64,
    /// Mean anomaly at t = 0, in rad.
    pub mean_anomaly_rad: f64,
    /// Rate at which its plane turns about z, in rad/s.
    pub node_rate_rad_s: f64,
}

/// A place on an orbit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    /// Its direction, a unit vector.
    pub(crate) direction: [f64; 3],
    /// The rate of that, in 1/s.
    pub(crate) turning: [f64; 3],
    /// Its distance in semi-major axes.
    pub(crate) distance: f64,
    /// The rate of that, in 1/s.
    pub(crate) receding: f64,
}

impl Orbit {
    pub(crate) fn at(&self, t: Time) -> Place {
        let e = self.eccentricity;
        let (sin, cos) =
            eccentric_anomaly(t.angle(self.mean_motion_rad_s, self.mean_anomaly_rad), e);
        // r / a, the direction by the true anomaly, and their rates.
        let (distance, root) = (1.0 - e * cos, (1.0 - e * e).sqrt());
        let (x, y) = ((cos - e) / distance, root * sin / distance);
        let rate = self.mean_motion_rad_s * root / (distance * distance);
        let receding = self.mean_motion_rad_s * e * sin / distance;
        let [p, q] = self.plane;
        let mut direction: [f64; 3] = std::array::from_fn(|i| p[i] * x + q[i] * y);
        let mut turning: [f64; 3] = std::array::from_fn(|i| (q[i] * x - p[i] * y) * rate);
        let drift = self.node_rate_rad_s;
        if drift != 0.0 {
            let (sin, cos) = libm::sincos(t.angle(drift, 0.0));
            let about_z = |v: [f64; 3]| [v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos, v[2]];
            direction = about_z(direction);
            turning = about_z(turning);
            turning[0] -= drift * direction[1];
            turning[1] += drift * direction[0];
        }
        Place { direction, turning, distance, receding }
    }

    /// The velocity at a time in seconds, in m/s: the rate of its place.
    pub fn velocity(&self, time_s: f64) -> [f64; 3] {
        self.velocity_at(Time::of(time_s))
    }

    pub(crate) fn velocity_at(&self, t: Time) -> [f64; 3] {
        let Place { direction, turning, distance, receding } = self.at(t);
        let along = |i: usize| turning[i] * distance + direction[i] * receding;
        std::array::from_fn(|i| self.semi_major_axis_m * along(i))
    }
}

/// The sine and cosine of the eccentric anomaly E, by Kepler's equation `E - e sin E = M`, to round-off.
///
/// By the quartic iteration of Danby (1987, Celestial Mechanics 40, 303), with his start, which is good for every e below one.
pub(crate) fn eccentric_anomaly(mean: f64, e: f64) -> (f64, f64) {
    /// Two or three rounds are usual; near e = 1 it takes more.
    const ROUNDS: usize = 60;
    /// The fourth power of a change of this size, next to the whole, is below round-off.
    const LAST_CHANGE: f64 = 3e-5;
    let mean = Time::of(mean).angle(1.0, 0.0);
    if e == 0.0 {
        return libm::sincos(mean);
    }
    let mut anomaly = if mean == 0.0 { 0.0 } else { mean + (0.85 * e).copysign(mean) };
    for _ in 0..ROUNDS {
        let (sin, cos) = libm::sincos(anomaly);
        let (defect, slope, bend) = (anomaly - e * sin - mean, 1.0 - e * cos, e * sin);
        let first = -defect / slope;
        let second = -defect / (slope + 0.5 * first * bend);
        let change = -defect / (slope + second * (0.5 * bend + second * (e * cos) / 6.0));
        anomaly += change;
        if change.abs() <= LAST_CHANGE * anomaly.abs() {
            // The addition theorem, to the fifth order.
            let square = change * change;
            let (by_sin, by_cos) = (change * (1.0 - square / 6.0), square * (0.5 - square / 24.0));
            return (sin + (cos * by_sin - sin * by_cos), cos - (sin * by_sin + cos * by_cos));
        }
    }
    libm::sincos(anomaly)
}

/// The rotation by an angle about z; n = 3.
pub(crate) fn about_z<const N: usize>(angle: f64) -> Mat<N> {
    let (sin, cos) = libm::sincos(angle);
    Mat::from_fn(|i, j| match (i, j) {
        (0, 0) | (1, 1) => cos,
        (1, 0) => sin,
        (0, 1) => -sin,
        _ => f64::from(i == j),
    })
}

/// `hat(z)`; n = 3.
pub(crate) fn z_axis<const N: usize>() -> Mat<N> {
    Mat::from_fn(|i, j| match (i, j) {
        (1, 0) => 1.0,
        (0, 1) => -1.0,
        _ => 0.0,
    })
}
