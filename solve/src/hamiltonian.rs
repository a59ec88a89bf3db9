//! Hamiltonians on T*SO(n), left-trivialised, and the one that is built in, the rotating body: H(g, mu) = T(mu) + U(g).
//!
//! Every potential term depends on the attitude through the body images `g^T v` of a few space vectors v
//! alone (a direction, a source, an anchor; of a user-defined [`Potential`] the axes of space). In the frame of g0, where
//! a step works, the same formulas hold with `g0^T v` in the place of v: see [`RigidBody::seen_from`].
//!
//! Invariant: [`RigidBody::gradient`] is the derivative of [`RigidBody::energy`].

use nalgebra::{Matrix3, Vector3};

use super::failure::{Failure, FailureCode};
use super::lanes::extras;
use super::pointing::{Pointed, Pointing};
use super::so::{self, Mat, Vector};
use super::stop::Stop;
use super::system::{Energy, System, free_directions};
use super::time::Time;
use super::work::Work;

mod control;
mod drive;
mod driven;
mod frequency;
mod plane;
mod potential;
mod rate;
mod rescaled;
mod term;
mod torque;

pub use control::{Actuator, Control, ReactionWheels, magnetic_term};
pub(crate) use drive::{Drive, DriveInFrame};
use driven::Driven;
pub(crate) use driven::{BodyAtTime, WorkAndImpulse};
pub use driven::{
    DipoleField, DrivenTerm, Face, Faces, Factor, Interpolation, Path, Stream, Table, Torque,
};
use potential::UserPotentials;
pub use potential::{Potential, gradient_error};
pub use rate::BodyRate;
pub(crate) use rescaled::{AtStages, Scale, StageForces};
pub use rescaled::{Rescaled, TimeScale};
pub use term::{Law, Term};
pub(crate) use torque::{Terms, Torques};

/// A Hamiltonian H(g, mu) by its two derivatives, for [`crate::stepper::vpd::Vpd`].
///
/// It need not fall into kinetic and potential energy. The equations are
///
/// ```text
/// g' = g Omega,    mu' = [mu, Omega] - dH/dg,    Omega = dH/dmu
/// ```
///
/// with the attitude `g` (body to space, n x n) and the momentum `mu` in the body frame (skew n x n, kg m^2/s).
pub trait Hamiltonian<const N: usize>: System<N> {
    /// dH/dmu at `g` and `mu`: the body angular velocity, skew n x n, in rad/s, with
    /// `<velocity, nu> = d/de H(g, mu + e nu)` and `<X, Y> = tr(X Y^T) / 2`.
    fn velocity(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N>;

    /// dH/dg at `g` and a fixed body momentum `mu`, left-trivialised and skew, n x n, in J, in the body frame:
    /// `<gradient, eta> = d/de H(g exp(e eta), mu)`; minus the torque.
    fn gradient(&self, g: &Mat<N>, mu: &Mat<N>) -> Mat<N>;

    /// The system as a rigid body, if it is one: a step then looks at its potential once from where it begins.
    fn as_body(&self) -> Option<&RigidBody<N>> {
        None
    }

    /// The system as a rigid body in a time of its own, if it is one: a step then looks at its potential and at its time
    /// together.
    fn as_rescaled(&self) -> Option<&Rescaled<'_, N>> {
        None
    }
}

/// Kinetic energy, a quadratic form on so(n)*.
#[derive(Clone, Debug, PartialEq)]
pub enum Kinetic<const N: usize> {
    /// `Omega_ij = w_ij mu_ij`: second moments d_i about the body axes, `w_ij = 1 / (d_i + d_j)`.
    Principal {
        /// The weights w, symmetric.
        weights: Mat<N>,
    },
    /// n = 3 with products of inertia: `mu = hat(J vee(Omega))`.
    Tensor {
        /// J, symmetric positive definite.
        inertia: Matrix3<f64>,
        /// J^-1.
        inverse: Matrix3<f64>,
    },
}

impl Kinetic<3> {
    /// Returns the kinetic energy for principal moments of inertia, in kg m^2: the plane (i, j)
    /// turns about the third axis.
    pub fn of_moments(moments: [f64; 3]) -> Self {
        let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / moments[3 - i - j] });
        Self::Principal { weights }
    }
}

impl<const N: usize> Kinetic<N> {
    /// Returns the kinetic energy for second moments about the body axes, in kg m^2.
    pub fn of_second_moments(d: [f64; N]) -> Self {
        let weights = Mat::from_fn(|i, j| if i == j { 0.0 } else { 1.0 / (d[i] + d[j]) });
        Self::Principal { weights }
    }

    /// Returns the kinetic energy for an inertia tensor in kg m^2, for n = 3; `None` if it is not
    /// symmetric to rounding and positive definite.
    pub fn of_tensor(inertia: Matrix3<f64>) -> Option<Self> {
        const ROUNDING: f64 = 1e-12;
        if !((inertia - inertia.transpose()).amax() <= ROUNDING * inertia.amax()) {
            return None;
        }
        let inverse = inertia.cholesky()?.inverse();
        Some(Self::Tensor { inertia, inverse })
    }
}

/// Closest approach to a point of the potential, relative to the lengths of the two arms: nearer than
/// this the difference `y - q` has lost half its digits and the force means nothing.
pub const CLOSEST_APPROACH: f64 = 1e-8;

/// A body that turns about a fixed point, in a potential.
#[derive(Clone, Debug)]
pub struct RigidBody<const N: usize> {
    kinetic: Kinetic<N>,
    terms: Vec<Term<N>>,
    /// [`Term::inverse_arm_squared`] of each.
    inverse_arms_squared: Vec<f64>,
    constant: f64,
    /// Potentials that are no terms.
    user: UserPotentials<N>,
    driven: Driven<N>,
    /// The angular momentum of wheels relative to the body; if they are driven, at the time that `driven` names.
    wheels: Option<Mat<N>>,
    control: Option<Box<Control<N>>>,
    stops: Vec<Stop<N>>,
    pointing: Option<Box<Pointing<N>>>,
    work: Work,
}

impl<const N: usize> RigidBody<N> {
    /// A body with its kinetic energy, the terms of its potential (none: a free body) and the part of the
    /// potential energy that does not depend on the attitude.
    ///
    /// # Panics
    /// Panics if `kinetic` is a tensor and n is not 3.
    pub fn new(kinetic: Kinetic<N>, terms: Vec<Term<N>>, constant: f64) -> Self {
        assert!(
            N == 3 || !matches!(kinetic, Kinetic::Tensor { .. }),
            "an inertia tensor is for n = 3"
        );
        let inverse_arms_squared = terms.iter().map(Term::inverse_arm_squared).collect();
        Self {
            kinetic,
            terms,
            inverse_arms_squared,
            constant,
            user: UserPotentials::default(),
            driven: Driven::default(),
            wheels: None,
            control: None,
            stops: Vec::new(),
            pointing: None,
            work: Work::default(),
        }
    }

    /// Adds a term.
    fn push(&mut self, term: Term<N>) {
        self.inverse_arms_squared.push(term.inverse_arm_squared());
        self.terms.push(term);
    }

    /// `w` of `Omega_ij = w_ij mu_ij`, in principal axes and without wheels.
    pub(crate) fn principal(&self) -> Option<&Mat<N>> {
        match &self.kinetic {
            Kinetic::Principal { weights } if self.wheels.is_none() => Some(weights),
            Kinetic::Principal { .. } | Kinetic::Tensor { .. } => None,
        }
    }

    /// dH/dmu: the body angular velocity `Omega = J^-1 (mu - wheels)`, skew: [`Hamiltonian::velocity`], at any attitude.
    pub fn velocity(&self, mu: &Mat<N>) -> Mat<N> {
        match &self.wheels {
            None => self.velocity_without_wheels(mu),
            Some(wheels) => self.velocity_without_wheels(&(mu - wheels)),
        }
    }

    fn velocity_without_wheels(&self, mu: &Mat<N>) -> Mat<N> {
        match &self.kinetic {
            Kinetic::Principal { weights } => mu.component_mul(weights),
            Kinetic::Tensor { inverse, .. } => {
                skew_of(inverse * Vector3::new(mu[(2, 1)], mu[(0, 2)], mu[(1, 0)]))
            }
        }
    }

    /// The largest velocity that belongs to a momentum of size one, in 1/(kg m^2).
    pub(crate) fn mobility(&self) -> f64 {
        match &self.kinetic {
            Kinetic::Principal { weights } => weights.amax(),
            Kinetic::Tensor { inverse, .. } => inverse.amax(),
        }
    }

    /// The body momentum of a body angular velocity: the inverse of [`RigidBody::velocity`].
    pub fn momentum(&self, omega: &Mat<N>) -> Mat<N> {
        let own = match &self.kinetic {
            Kinetic::Principal { weights } => {
                omega.zip_map(weights, |omega, w| if w == 0.0 { 0.0 } else { omega / w })
            }
            Kinetic::Tensor { inertia, .. } => {
                skew_of(inertia * Vector3::new(omega[(2, 1)], omega[(0, 2)], omega[(1, 0)]))
            }
        };
        self.wheels.map_or(own, |wheels| own + wheels)
    }

    /// mu' = `[mu, Omega] - dH/dg` at `g = g0 u`, given the space vectors `seen` from g0 and
    /// `omega = dH/dmu`: Hamilton's equations, left-trivialised, with `g' = g Omega`.
    pub fn momentum_rate(
        &self,
        u: &Mat<N>,
        mu: &Mat<N>,
        omega: &Mat<N>,
        seen: &[Vector<N>],
    ) -> Mat<N> {
        so::asym(&so::product(mu, omega)) - self.gradient_seen(u, seen)
    }

    /// Lets `work` count the work for the body, and end it.
    pub fn with_work(self, work: Work) -> Self {
        Self { work, ..self }
    }

    /// Ends runs early where one of the conditions holds.
    pub fn with_stops(self, stops: Vec<Stop<N>>) -> Self {
        Self { stops, ..self }
    }

    /// Lets samples show where the body points.
    pub fn with_pointing(self, pointing: Pointing<N>) -> Self {
        Self { pointing: Some(Box::new(pointing)), ..self }
    }

    /// Takes over the counts of a body that made steps in its place.
    pub(crate) fn count_as(&self, other: &Self) {
        self.work.take_over(&other.work);
    }

    /// Goes on with the counts and limits of another body.
    pub(crate) fn work_as(&mut self, other: &Self) {
        self.work.clone_from(&other.work);
    }

    /// Returns the work done for the body since it was made. No gradients are counted for a free
    /// body.
    pub fn work(&self) -> &Work {
        &self.work
    }

    pub(super) fn count(&self, gradients: u64) {
        if !self.is_free() {
            self.work.add_gradients(gradients);
        }
    }

    /// Is H independent of the attitude?
    pub fn is_free(&self) -> bool {
        self.terms.is_empty() && self.user.is_empty() && self.driven.is_empty()
    }

    /// The space vectors of the potential: one a term, and the axes if there is a user-defined potential.
    pub fn space_vectors(&self) -> impl Iterator<Item = &Vector<N>> {
        self.terms.iter().map(|term| &term.space).chain(&self.user.axes)
    }

    /// The space vectors of the potential in the frame of `g0`, `g0^T v`, written to `seen`.
    pub fn seen_from(&self, g0: &Mat<N>, seen: &mut Vec<Vector<N>>) {
        seen.clear();
        seen.extend(self.space_vectors().map(|v| so::to_body(g0, v)));
    }

    /// [`RigidBody::gradient`] at `g = g0 u`, given the space vectors `seen` from g0.
    ///
    /// A term U(q) with `q = u^T v` has `dH/dg = q (dU/dq)^T - (dU/dq) q^T`: from `x = g y` the paper's
    /// `asym(g^T grad_g U)`.
    pub fn gradient_seen(&self, u: &Mat<N>, seen: &[Vector<N>]) -> Mat<N> {
        let mut sum = self.terms_gradient_seen(u, seen);
        if self.has_user_potential() {
            sum += self.user.gradient(&self.attitude_of(u, seen));
        }
        sum
    }

    /// The part of the terms.
    fn terms_gradient_seen(&self, u: &Mat<N>, seen: &[Vector<N>]) -> Mat<N> {
        self.count(1);
        let mut sum = Mat::zeros();
        for (term, v) in self.terms.iter().zip(seen) {
            let q = so::to_body(u, v);
            let slope = term.law.numbers().slope(&q, 0.0, &mut 0.0);
            for j in 0..N {
                for i in 0..N {
                    sum[(i, j)] += q[i] * slope[j] - slope[i] * q[j];
                }
            }
        }
        sum
    }

    /// [`Self::gradient_seen`] at several attitudes, with each user-defined potential called once.
    pub(crate) fn gradients_seen(&self, u: &[Mat<N>], seen: &[Vector<N>]) -> Vec<Mat<N>> {
        let g: Vec<_> = u.iter().map(|u| self.attitude_of(u, seen)).collect();
        let own = self.user.gradients(&g);
        u.iter().zip(own).map(|(u, own)| self.terms_gradient_seen(u, seen) + own).collect()
    }

    /// `g = g0 u`, as user-defined potentials see it.
    fn attitude_of(&self, u: &Mat<N>, seen: &[Vector<N>]) -> Mat<N> {
        UserPotentials::attitude(u, seen.get(self.terms.len()..).unwrap_or_default())
    }

    /// dH/dg at `g`, left-trivialised and skew: [`Hamiltonian::gradient`], at any momentum.
    pub fn gradient(&self, g: &Mat<N>) -> Mat<N> {
        let mut seen = Vec::new();
        self.seen_from(g, &mut seen);
        self.gradient_seen(&Mat::identity(), &seen)
    }

    /// Refuses an attitude at which the potential has lost its meaning.
    ///
    /// # Errors
    /// [`FailureCode::PotentialSingularity`] with the relative distance and its limit; those of [`Potential::check`].
    pub fn check_distances(&self, g: &Mat<N>) -> Result<(), Failure> {
        let mut seen = Vec::new();
        self.seen_from(g, &mut seen);
        self.check_distances_seen(&Mat::identity(), &seen)
    }

    /// dU/dg at `g`, right-trivialised and skew, in space coordinates: `<gradient, eta> = d/de U(exp(e eta) g)`.
    ///
    /// A term U(q) with `q = g^T v` has `v (g dU/dq)^T - (g dU/dq) v^T`. On the group this is `g X g^T`, X
    /// the left-trivialised gradient; next to it only this form keeps the symmetries that the space vectors
    /// leave to the bit.
    pub fn spatial_gradient(&self, g: &Mat<N>) -> Mat<N> {
        self.count(1);
        let mut sum = Mat::zeros();
        for Term { law, space } in &self.terms {
            let q = so::to_body(g, space);
            let slope = so::to_space(g, &law.numbers().slope(&q, 0.0, &mut 0.0));
            for j in 0..N {
                for i in 0..N {
                    sum[(i, j)] += space[i] * slope[j] - slope[i] * space[j];
                }
            }
        }
        if self.has_user_potential() {
            sum += so::conjugate(g, &self.user.gradient(g));
        }
        sum
    }

    /// [`RigidBody::check_distances`] of an attitude `u` in the frame that `seen` belongs to.
    ///
    /// # Errors
    /// The same.
    pub fn check_distances_seen(&self, u: &Mat<N>, seen: &[Vector<N>]) -> Result<(), Failure> {
        for (term, v) in self.terms.iter().zip(seen) {
            if let Some(distance) = term.law.relative_distance(&so::to_body(u, v))
                && !(distance >= CLOSEST_APPROACH)
            {
                let code = FailureCode::PotentialSingularity;
                return Err(Failure::new(code, None, distance, CLOSEST_APPROACH));
            }
        }
        if self.has_user_potential() { self.user.check(&self.attitude_of(u, seen)) } else { Ok(()) }
    }

    /// Kinetic and potential energy at an attitude and a body momentum.
    pub fn energy(&self, attitude: &Mat<N>, momentum: &Mat<N>) -> Energy {
        // T = <mu - wheels, Omega> / 2
        let own = self.wheels.map_or(*momentum, |wheels| momentum - wheels);
        let kinetic = 0.5 * so::inner(&own, &self.velocity_without_wheels(&own));
        let terms: f64 =
            self.terms.iter().map(|term| term.law.value(&so::to_body(attitude, &term.space))).sum();
        Energy { kinetic, potential: self.user.energy(terms + self.constant, attitude) }
    }

    /// The projection `Q` onto the space directions that the potential leaves free: rotations of that
    /// subspace are symmetries, so by Noether `Q m Q` is conserved, m the spatial momentum. `None` if
    /// fewer than two directions are free.
    pub fn conserved_directions(&self) -> Option<Mat<N>> {
        let (own, driven) = (self.user.space_vectors(), self.driven.space_vectors());
        free_directions(self.terms.iter().map(|term| &term.space).chain(&own).chain(&driven))
    }
}

impl<const N: usize> System<N> for RigidBody<N> {
    fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        self.energy(g, mu)
    }

    fn conserved_directions(&self) -> Option<Mat<N>> {
        self.conserved_directions()
    }

    fn turning_frame(&self) -> Option<Mat<N>> {
        let own = self.user.space_vectors();
        self.driven.turning_frame(self.terms.iter().map(|term| &term.space).chain(&own))
    }

    fn observed_velocity(&self, time_s: f64, _g: &Mat<N>, mu: &Mat<N>) -> Option<Mat<N>> {
        // Motors change the momentum of the wheels between samples of a control.
        let without_wheels = match self.wheels_at(Time::of(time_s)) {
            None => *mu,
            Some(wheels) => mu - wheels,
        };
        Some(self.velocity_without_wheels(&without_wheels))
    }

    fn energy_at(&self, t: f64, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        if self.is_driven() { self.at(Time::of(t)).energy(g, mu) } else { self.energy(g, mu) }
    }

    fn is_driven(&self) -> bool {
        self.is_driven()
    }

    fn is_pushed(&self) -> bool {
        self.driven.has_torques()
    }

    fn next_knot(&self, after_s: f64) -> f64 {
        let of_control = self.control.as_ref().map(|control| control.next_knot(after_s));
        self.driven.next_knot(after_s).min(of_control.unwrap_or(f64::INFINITY))
    }

    fn jump(&self, knot_s: f64, g: &Mat<N>) -> f64 {
        self.jump(knot_s, g)
    }

    fn stops(&self) -> &[Stop<N>] {
        &self.stops
    }

    fn pointed(&self, time_s: f64, g: &Mat<N>, omega: &Mat<N>) -> Option<Pointed> {
        self.pointing.as_ref()?.at(time_s, g, omega)
    }

    fn table_impulse(&self, time_s: f64) -> Option<f64> {
        self.driven.table_impulse(time_s)
    }

    fn check(&self, g: &Mat<N>) -> Result<(), Failure> {
        self.check_distances(g)
    }

    fn begin_sweep(&self) -> Result<(), Failure> {
        self.work.begin_sweep()
    }
}

impl<const N: usize> Hamiltonian<N> for RigidBody<N> {
    fn velocity(&self, _g: &Mat<N>, mu: &Mat<N>) -> Mat<N> {
        self.velocity(mu)
    }

    fn gradient(&self, g: &Mat<N>, _mu: &Mat<N>) -> Mat<N> {
        self.gradient(g)
    }

    fn as_body(&self) -> Option<&RigidBody<N>> {
        Some(self)
    }
}

impl RigidBody<3> {
    /// What a step takes into account besides the terms of the potential: [`super::lanes::extras`].
    pub(crate) fn extras(&self) -> u8 {
        let user = if self.has_user_potential() { extras::USER } else { 0 };
        let driven = self.is_driven() || self.wheels.is_some();
        user | if driven { extras::DRIVEN } else { 0 }
    }

    /// Constant wheels as a vector, in kg m^2/s.
    pub(crate) fn wheels(&self) -> Option<[f64; 3]> {
        self.wheels.as_ref().map(|wheels| super::so3::vee(wheels).into())
    }

    /// J^-1, the inverse of the inertia tensor: `vee(Omega) = J^-1 vee(mu)`.
    pub fn inverse_inertia(&self) -> Matrix3<f64> {
        match &self.kinetic {
            Kinetic::Principal { weights } => Matrix3::from_diagonal(&Vector3::new(
                weights[(2, 1)],
                weights[(0, 2)],
                weights[(1, 0)],
            )),
            Kinetic::Tensor { inverse, .. } => *inverse,
        }
    }
}

/// hat, for a matrix whose size is known to be 3 only at run time.
fn skew_of<const N: usize>(v: Vector3<f64>) -> Mat<N> {
    let mut skew = Mat::zeros();
    for (&value, (i, j)) in v.iter().zip([(2, 1), (0, 2), (1, 0)]) {
        skew[(i, j)] = value;
        skew[(j, i)] = -value;
    }
    skew
}
