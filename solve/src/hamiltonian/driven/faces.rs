//! The torque of a stream on flat faces of a body: of thin air against a satellite, of sunlight.
//!
//! A face counts where it looks into the stream. With its outward normal n, its centre r from the centre of mass, and the stream's
//! origin q (the velocity through the air, or the direction to the Sun) in the body, the force on it and the torque are
//!
//! ```text
//! F = -c (along q + (mirrored c + scattered) n),   c = max(n . q, 0),      F_tau = r x F
//! ```
//!
//! ```text
//!            q              along                       mirrored        scattered
//! air        v              rho C A / 2                 0               0
//! light      s, |s| = 1     P A (absorbed + diffuse)    2 P A specular  2/3 P A diffuse
//! ```
//!
//! (Wertz 1978, Spacecraft Attitude Determination and Control, section 17.2). The force is continuous where a face turns
//! edge-on and has a kink there: the step that contains it is of second order. No face shades another one, and air meets a face with
//! the velocity of the centre of mass.

use super::Factor;
use crate::failure::Failure;
use crate::kepler::Orbit;
use crate::lanes::Real;
use crate::so::{self, Mat, Vector};
use crate::space::{Vec3, vec3};
use crate::time::Time;

/// A flat face, in body coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct Face<const N: usize> {
    /// Its outward normal, of length one.
    pub normal: Vector<N>,
    /// Its centre from the centre of mass, in m.
    pub centre: Vector<N>,
    /// Part of the force along the stream.
    pub along: f64,
    /// Part along the normal that grows with the square of the component of the stream there.
    pub mirrored: f64,
    /// Part along the normal that grows with that component.
    pub scattered: f64,
}

/// Where a stream comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum Stream<const N: usize> {
    /// A direction of space, of length one.
    Direction(Vector<N>),
    /// Air at rest in space, through which the body flies along an orbit: the velocity in m/s; n = 3.
    Flight(Orbit),
}

/// Faces in a stream.
#[derive(Clone, Debug, PartialEq)]
pub struct Faces<const N: usize> {
    /// The faces.
    pub faces: Vec<Face<N>>,
    /// The stream.
    pub stream: Stream<N>,
    /// Factor on the force: a density or a pressure that changes with time.
    pub factor: Factor,
}

/// Faces in a stream at a moment.
#[derive(Clone, Debug)]
pub(super) struct FacesAtTime<const N: usize> {
    faces: Vec<Face<N>>,
    stream: Vector<N>,
    factor: f64,
}

impl<const N: usize> Faces<N> {
    /// Refuses a time that the table of its factor does not cover.
    pub(super) fn check(&self, time_s: f64) -> Result<(), Failure> {
        match &self.factor {
            Factor::Table(table) => table.check(time_s),
            Factor::Constant | Factor::Harmonic { .. } => Ok(()),
        }
    }

    /// The stream in space coordinates, and the factor on it.
    pub(in crate::hamiltonian) fn driving(&self, t: Time) -> (Vector<N>, f64) {
        let stream = match &self.stream {
            Stream::Direction(direction) => *direction,
            Stream::Flight(orbit) => {
                let velocity = orbit.velocity_at(t);
                Vector::from_fn(|i, _| velocity.get(i).copied().unwrap_or_default())
            }
        };
        (stream, self.factor.at(t).0)
    }

    pub(super) fn at(&self, t: Time) -> FacesAtTime<N> {
        let (stream, factor) = self.driving(t);
        FacesAtTime { faces: self.faces.clone(), stream, factor }
    }
}

impl<const N: usize> FacesAtTime<N> {
    /// The torque at an attitude, in the body: `hat(r x F) = F r^T - r F^T`.
    pub(super) fn torque(&self, g: &Mat<N>) -> Mat<N> {
        let q = so::to_body(g, &self.stream);
        let mut sum = Mat::zeros();
        for Face { normal, centre, along, mirrored, scattered } in &self.faces {
            let c = so::dot(normal.as_slice(), q.as_slice());
            // Also where it is NaN: a failure is found elsewhere.
            if c <= 0.0 {
                continue;
            }
            let force = q * (-along * c) - normal * (c * (mirrored * c + scattered));
            sum += so::wedge(&force, centre);
        }
        sum * self.factor
    }
}

impl Face<3> {
    /// Adds the torque of a stream from `q`, in the body, to `sum`.
    #[inline(always)]
    pub(in crate::hamiltonian) fn add_torque<R: Real>(&self, q: &Vec3<R>, sum: &mut Vec3<R>) {
        let (n, r) = (&self.normal, &self.centre);
        let zero = q[0].constant(0.0);
        let c = (q[0] * n[0] + q[1] * n[1] + q[2] * n[2]).max_or_nan(zero);
        let along = c * self.along;
        let outward = c * (c * self.mirrored + self.scattered);
        let force = vec3!(i => -(q[i] * along + outward * n[i]));
        sum[0] = sum[0] + (force[2] * r[1] - force[1] * r[2]);
        sum[1] = sum[1] + (force[0] * r[2] - force[2] * r[0]);
        sum[2] = sum[2] + (force[1] * r[0] - force[0] * r[1]);
    }
}
