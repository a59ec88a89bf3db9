//! Motion along a Kepler orbit.
//!
//! Invariant: solutions are exact to round-off for every eccentricity below one.

use super::time::Time;

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
