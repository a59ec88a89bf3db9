//! Stiffness of a potential.

use super::RigidBody;
use crate::so::{self, Mat};
use crate::time::Time;

impl<const N: usize> RigidBody<N> {
    /// The fastest frequency, in rad/s, of small turns about the attitude `g` in the potential alone: the root of the
    /// largest eigenvalue, by its size, of
    ///
    /// ```text
    /// xi -> J^-1 d/de (dH/dg)(g exp(e xi))
    /// ```
    ///
    /// by power iteration from a difference of two gradients, at the time `time_s`. Zero for a free body, and where the potential
    /// makes no sense.
    pub fn fastest_frequency(&self, time_s: f64, g: &Mat<N>) -> f64 {
        if self.is_driven() {
            self.at(Time::of(time_s)).body.frequency(g)
        } else {
            self.frequency(g)
        }
    }

    fn frequency(&self, g: &Mat<N>) -> f64 {
        /// To a few percent, unless the two fastest are that near each other; then it is between them.
        const ROUNDS: u32 = 30;
        /// Short relative to a turn, long relative to rounding.
        const APART: f64 = 1e-5;
        if self.is_free() {
            return 0.0;
        }
        let size = |xi: &Mat<N>| so::inner(xi, xi).sqrt();
        // No direction stands out.
        let start: Vec<f64> = (0..so::dimension(N)).map(|i| 1.0 / (i as f64 + 1.0)).collect();
        let mut xi = so::hat::<N>(&start);
        let mut square = 0.0;
        for _ in 0..ROUNDS {
            xi /= size(&xi);
            let Some(turn) = so::retraction(&(xi * APART)) else { return 0.0 };
            let ahead = self.gradient(&so::product(g, &turn));
            let behind = self.gradient(&so::product(g, &turn.transpose()));
            xi = self.velocity_without_wheels(&((ahead - behind) / (2.0 * APART)));
            square = size(&xi);
            if !(square > 0.0 && square.is_finite()) {
                return 0.0;
            }
        }
        square.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hamiltonian::{DrivenTerm, Factor, Kinetic, Law, Path, Term};
    use crate::so::Vector;

    #[test]
    fn a_pendulum_on_a_spring() {
        // k / 2 |g y - v|^2 with |y| = |v| = 1 is k (1 - cos): J w^2 = k about the axes across y.
        let weights = Mat::<3>::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (1 + i + j) as f64 });
        let y = Vector::<3>::new(0.0, 0.0, 1.0);
        let law = Law::Spring { stiffness: 50.0, rest_length: 0.0, body_point: y };
        let body =
            RigidBody::new(Kinetic::Principal { weights }, vec![Term { law, space: y }], 0.0);
        // The smaller moment of the two, about the second axis, is that of entry (0, 2).
        let found = body.fastest_frequency(0.0, &Mat::identity());
        assert!((found - (50.0_f64 / 3.0).sqrt()).abs() < 1e-3 * found, "{found}");
        let free = RigidBody::<3>::new(Kinetic::Principal { weights }, Vec::new(), 0.0);
        assert_eq!(free.fastest_frequency(0.0, &Mat::identity()), 0.0);
        // Wheels change no stiffness; a factor does, at its time.
        let wheels = so::hat(&[3.0, -2.0, 5.0]);
        let term = body.terms[0].clone();
        let with_wheels = body.with_wheels(wheels).fastest_frequency(0.0, &Mat::identity());
        assert!((with_wheels - found).abs() < 1e-12 * found, "{with_wheels}");
        let factor = Factor::Harmonic { mean: 2.5, amplitude: 1.5, rate: 1.0, phase: 0.0 };
        let driven = free.with_driven_term(DrivenTerm { term, path: Path::Fixed, factor });
        for (time_s, factor) in [(0.0, 4.0_f64), (std::f64::consts::PI, 1.0)] {
            let seen = driven.fastest_frequency(time_s, &Mat::identity());
            assert!((seen - factor.sqrt() * found).abs() < 1e-9 * found, "{seen}");
        }
    }
}
