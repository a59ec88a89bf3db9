//! Parts of a body that change with time, push it without being a potential, or spin in it.
//!
//! A driven body is evaluated at the times of the stages: [`RigidBody::at`] gives its potential as it is then, and the torques. In
//! the extended phase space the momentum of time changes by `-dH/dt`, so that
//!
//! ```text
//! H(t) - H(0) = integral of dH/dt + <F_tau, Omega>
//! ```
//!
//! is what the drive has put in: [`BodyAtTime::input`], summed by the stepper with the weights of its tableau. Along rotations that
//! leave the potential as it is, the spatial momentum changes by the torques alone, by the integral of `g F_tau g^T`.
//!
//! Invariant: [`BodyAtTime::input`] is the rate of the energy along the motion that [`BodyAtTime::gradient`] makes.

use super::RigidBody;
mod faces;
mod table;

use faces::FacesAtTime;
pub use faces::{Face, Faces, Stream};
pub use table::{Interpolation, Table};

use super::term::{Law, Space, Term};
use crate::failure::{Failure, FailureCode};
use crate::kepler::{Orbit, Place, about_z, eccentric_anomaly, z_axis};
use crate::so::{self, Mat, Vector};
use crate::system::Energy;
use crate::time::Time;

/// Motion of the space vector of a term.
#[derive(Clone, Debug, PartialEq)]
pub enum Path<const N: usize> {
    /// No motion.
    Fixed,
    /// Turns at a constant rate, from one of two orthonormal vectors towards the other; its part
    /// across their plane stays.
    Turning {
        /// The plane.
        plane: [Vector<N>; 2],
        /// Turn rate, in rad/s.
        rate: f64,
    },
    /// Follows a Kepler orbit: the term's own vector points to the pericentre, and turns from there
    /// towards `across`. A place has the semi-major axis for its length, and comes nearer and goes
    /// farther; a direction keeps its length, and the gradient of gravity along it is multiplied by
    /// the inverse cube of the distance in semi-major axes.
    Orbit {
        /// Unit vector, orthogonal to the term's own vector.
        across: Vector<N>,
        /// Mean motion, in rad/s.
        mean_motion: f64,
        /// Eccentricity, from 0 to less than 1.
        eccentricity: f64,
        /// Mean anomaly at t = 0, in rad.
        mean_anomaly: f64,
        /// Rate at which the plane turns about z, in rad/s; n = 3.
        node_rate: f64,
    },
    /// The vector is a magnetic field along an orbit, in T; the term's own vector plays no part. n = 3.
    Dipole(Box<DipoleField>),
}

/// The magnetic field of a dipole along a circular or elliptic orbit about it; n = 3, in space coordinates.
///
/// ```text
/// B = moment / r^3 (3 (d . x) x - d),    x the direction of the orbit's place, r its distance
/// ```
///
/// d is `-z`, tilted: for the Earth, whose field points north at the equator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DipoleField {
    /// Strength of the dipole, in T m^3 (7.96e15 for the Earth).
    pub moment_t_m3: f64,
    /// Angle of the dipole from the z axis, towards x at t = 0, in rad.
    pub tilt_rad: f64,
    /// Rate at which the dipole turns about z, in rad/s.
    pub rotation_rad_s: f64,
    /// The orbit.
    pub orbit: Orbit,
}

impl DipoleField {
    /// The field at a time, in T, and its rate, in T/s, in space coordinates.
    pub(super) fn at<const N: usize>(&self, t: Time) -> (Vector<N>, Vector<N>) {
        let Place { direction: at, turning: at_rate, distance: r, receding } = self.orbit.at(t);
        let (sin, cos) = libm::sincos(self.tilt_rad);
        let (turned_sin, turned_cos) = libm::sincos(t.angle(self.rotation_rad_s, 0.0));
        let d = [-sin * turned_cos, -sin * turned_sin, -cos];
        let d_rate = [-d[1] * self.rotation_rad_s, d[0] * self.rotation_rad_s, 0.0];
        let distance_m = self.orbit.semi_major_axis_m * r;
        let size = self.moment_t_m3 / (distance_m * distance_m * distance_m);
        let dot = |a: &[f64; 3], b: &[f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let along = dot(&d, &at);
        let along_rate = dot(&d_rate, &at) + dot(&d, &at_rate);
        let field = |i: usize| size * (3.0 * along * at[i] - d[i]);
        let rate = |i: usize| {
            size * (3.0 * (along_rate * at[i] + along * at_rate[i]) - d_rate[i])
                - 3.0 * receding / r * field(i)
        };
        let vector =
            |f: &dyn Fn(usize) -> f64| Vector::from_fn(|i, _| if i < 3 { f(i) } else { 0.0 });
        (vector(&field), vector(&rate))
    }
}

/// Driven wheels: how fast the momentum of all of them changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spin<const N: usize> {
    /// Motor torques along their axes, added up: skew, in N m.
    pub(super) rate: Mat<N>,
    /// The time at which the wheels have the momentum of the body's `wheels`, in s.
    pub(super) since_s: f64,
}

/// Factor by which the strength of a term is multiplied.
#[derive(Clone, Debug, PartialEq)]
pub enum Factor {
    /// One.
    Constant,
    /// `mean + amplitude cos(rate t + phase)`
    Harmonic {
        /// The mean.
        mean: f64,
        /// The amplitude.
        amplitude: f64,
        /// Rate, in rad/s.
        rate: f64,
        /// Phase, in rad.
        phase: f64,
    },
    /// Given by a table.
    Table(Table<1>),
}

impl Factor {
    /// Its value and the rate of that at a time.
    fn at(&self, t: Time) -> (f64, f64) {
        match self {
            Self::Constant => (1.0, 0.0),
            Self::Harmonic { mean, amplitude, rate, phase } => {
                let (sin, cos) = libm::sincos(t.angle(*rate, *phase));
                (mean + amplitude * cos, -amplitude * rate * sin)
            }
            Self::Table(table) => {
                let ([value], [rate]) = table.at(t);
                (value, rate)
            }
        }
    }
}

/// A term of the potential that changes with time.
#[derive(Clone, Debug, PartialEq)]
pub struct DrivenTerm<const N: usize> {
    /// The term.
    pub term: Term<N>,
    /// Motion of its space vector.
    pub path: Path<N>,
    /// Factor on its strength.
    pub factor: Factor,
}

/// A torque on the body that is no potential's.
#[derive(Clone, Debug, PartialEq)]
pub enum Torque<const N: usize> {
    /// Constant in the body: skew, in N m.
    Body(Mat<N>),
    /// Constant in space coordinates: skew, in N m.
    Space(Mat<N>),
    /// Along a fixed element of so(n) in the body, with the strength of a table.
    Table {
        /// Element of so(n), skew.
        along: Mat<N>,
        /// Are these space coordinates?
        spatial: bool,
        /// Strength, in N m.
        table: Table<1>,
    },
    /// `-c_ij Omega_ij`: viscous, with a coefficient for each plane, in N m s.
    Viscous(Mat<N>),
    /// `-rate mu`, in 1/s.
    OfMomentum(f64),
    /// A stream on flat faces.
    Faces(Box<Faces<N>>),
}

/// Parts of a body that change with time, or push it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Driven<const N: usize> {
    pub(super) terms: Vec<DrivenTerm<N>>,
    pub(super) torques: Vec<Torque<N>>,
    pub(super) spin: Option<Spin<N>>,
    /// Which of the torques, or of the terms, is the command of a control.
    pub(super) commanded: usize,
}

impl<const N: usize> Driven<N> {
    pub(super) fn is_empty(&self) -> bool {
        self.terms.is_empty() && self.torques.is_empty() && self.spin.is_none()
    }

    /// Refuses a time that a table does not cover, and orbits that do not close.
    pub(super) fn check(&self, t: Time) -> Result<(), Failure> {
        for DrivenTerm { path, factor, .. } in &self.terms {
            if let Path::Orbit { eccentricity, .. } = path
                && !(0.0..1.0).contains(eccentricity)
            {
                return Err(Failure::new(FailureCode::OpenOrbit, None, *eccentricity, 1.0));
            }
            if let Factor::Table(table) = factor {
                table.check(t.seconds())?;
            }
        }
        self.torques.iter().try_for_each(|torque| match torque {
            Torque::Table { table, .. } => table.check(t.seconds()),
            Torque::Faces(faces) => faces.check(t.seconds()),
            _ => Ok(()),
        })
    }

    /// The faces on which streams act.
    pub(super) fn faces(&self) -> impl Iterator<Item = &Faces<N>> {
        self.torques.iter().filter_map(|torque| match torque {
            Torque::Faces(faces) => Some(faces.as_ref()),
            _ => None,
        })
    }

    /// The torques by tables: how large a torque of strength one is, and the table.
    fn torque_tables(&self) -> impl Iterator<Item = (f64, &Table<1>)> {
        self.torques.iter().filter_map(|torque| match torque {
            Torque::Table { along, table, .. } => Some((so::inner(along, along).sqrt(), table)),
            _ => None,
        })
    }

    /// The tables of factors on terms.
    fn factor_tables(&self) -> impl Iterator<Item = &Table<1>> {
        self.terms.iter().filter_map(|term| match &term.factor {
            Factor::Table(table) => Some(table),
            Factor::Constant | Factor::Harmonic { .. } => None,
        })
    }

    /// The first time later than `t` at which a table changes its polynomial; infinite if there is none.
    pub(super) fn next_knot(&self, t: f64) -> f64 {
        let next = |table: &Table<1>| {
            let knots = table.knots();
            knots.get(knots.partition_point(|&knot| knot <= t)).copied().unwrap_or(f64::INFINITY)
        };
        let of_faces = self.faces().filter_map(|faces| match &faces.factor {
            Factor::Table(table) => Some(table),
            Factor::Constant | Factor::Harmonic { .. } => None,
        });
        let tables = self.factor_tables().chain(self.torque_tables().map(|(_, table)| table));
        let tables = tables.chain(of_faces);
        tables.map(next).fold(f64::INFINITY, f64::min)
    }

    /// The exact impulse of the torques by tables from t = 0 to `t`, by [`Driven::torque_tables`]; `None` without any.
    pub(super) fn table_impulse(&self, t: f64) -> Option<f64> {
        let of = |(size, table): (f64, &Table<1>)| {
            size * (table.integral(t)[0] - table.integral(0.0)[0])
        };
        self.torque_tables().map(of).reduce(|sum, impulse| sum + impulse)
    }

    /// Do torques act?
    pub(super) fn has_torques(&self) -> bool {
        !self.torques.is_empty()
    }

    /// The space vectors through which the driven terms see the attitude at any time.
    pub(super) fn space_vectors(&self) -> Vec<Vector<N>> {
        let unit = |axis: usize| Vector::from_fn(|i, _| f64::from(i == axis));
        let of = |driven: &DrivenTerm<N>| {
            let own = driven.term.space;
            match &driven.path {
                Path::Fixed => vec![own],
                Path::Turning { plane: [a, b], .. } => vec![own, *a, *b],
                Path::Orbit { across, node_rate: 0.0, .. } => vec![own, *across],
                // Its plane turns about z, too.
                Path::Orbit { across, .. } => vec![own, *across, unit(0), unit(1)],
                // It has no direction that stays in a plane.
                Path::Dipole(_) => (0..N).map(unit).collect(),
            }
        };
        self.terms.iter().flat_map(of).collect()
    }
}

impl<const N: usize> Driven<N> {
    /// The common rate of the driven terms, if each turns uniformly with a constant strength: see
    /// [`crate::system::System::turning_frame`]. Also `None` if that frame moves one of the `fixed` vectors, or torques act.
    pub(super) fn turning_frame<'a>(
        &self,
        fixed: impl Iterator<Item = &'a Vector<N>>,
    ) -> Option<Mat<N>> {
        /// Relative to the rate: rounding of the numbers in a scenario.
        const NEAR: f64 = 1e-12;
        let rates: Option<Vec<Mat<N>>> = self.terms.iter().map(DrivenTerm::turning).collect();
        let rates = rates.filter(|_| self.torques.is_empty() && self.spin.is_none())?;
        let rate = *rates.first()?;
        let norm = |x: &Mat<N>| so::inner(x, x).sqrt();
        let near = NEAR * norm(&rate);
        let alike = rates.iter().all(|other| norm(&(other - rate)) <= near);
        let length = |v: &Vector<N>| so::norm(v.as_slice());
        let stay = |v: &Vector<N>| length(&so::to_space(&rate, v)) <= near * length(v);
        (alike && fixed.into_iter().all(stay)).then_some(rate)
    }
}

/// A driven body at one moment.
#[derive(Clone, Debug)]
pub(crate) struct BodyAtTime<const N: usize> {
    /// The body with its potential at that moment.
    pub(crate) body: RigidBody<N>,
    torques: Vec<Torque<N>>,
    faces: Vec<FacesAtTime<N>>,
    /// Strengths of the torques by tables, added up.
    tables: f64,
    /// Rate of the momentum of driven wheels.
    spin: Option<Mat<N>>,
    changing: Vec<Changing<N>>,
    /// Failure, if there is no such moment.
    refused: Option<Failure>,
}

/// Input of time and torques to a driven body: at a moment, or, times the weights of a step, in a
/// step.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct WorkAndImpulse<const N: usize> {
    /// Input to the energy.
    pub(crate) power: f64,
    /// Input of torques that are no potential's to the spatial momentum; `None` if none act.
    pub(crate) torque: Option<Mat<N>>,
    /// Strengths of the torques by tables, added up: see [`crate::system::System::table_impulse`].
    pub(crate) tables: f64,
}

impl<const N: usize> WorkAndImpulse<N> {
    /// Adds the input at a stage of the given weight.
    pub(crate) fn add(&mut self, weight: f64, at_stage: &Self) {
        self.power += weight * at_stage.power;
        self.tables += weight * at_stage.tables;
        if let Some(torque) = &at_stage.torque {
            *self.torque.get_or_insert_with(Mat::zeros) += torque * weight;
        }
    }
}

/// A driven term at a moment.
#[derive(Clone, Debug)]
struct Changing<const N: usize> {
    /// The law, with its strength replaced by the rate of that.
    strengthening: Law<N>,
    law: Law<N>,
    space: Vector<N>,
    /// The rate of the space vector.
    moving: Vector<N>,
}

/// What drives a term at a moment.
#[derive(Clone, Copy, Debug)]
pub(super) struct Driving<const N: usize> {
    /// Factor on the strength.
    pub(super) strength: f64,
    /// The rate of the factor.
    pub(super) strengthening: f64,
    pub(super) space: Vector<N>,
    /// The rate of the space vector.
    pub(super) moving: Vector<N>,
}

impl<const N: usize> DrivenTerm<N> {
    /// Its space vector at a time in seconds.
    pub fn space_at(&self, t: f64) -> Vector<N> {
        self.at(Time::of(t)).space
    }

    /// The rate `W` by which its space vector v turns, `v' = W v`, if that and its strength are constant.
    fn turning(&self) -> Option<Mat<N>> {
        match (&self.factor, &self.path) {
            (Factor::Constant, Path::Turning { plane: [a, b], rate }) => {
                Some(so::wedge(b, a) * *rate)
            }
            (
                Factor::Constant,
                Path::Orbit { across, mean_motion, eccentricity: 0.0, node_rate: 0.0, .. },
            ) => {
                let length = so::norm(self.term.space.as_slice());
                (length > 0.0)
                    .then(|| so::wedge(across, &(self.term.space / length)) * *mean_motion)
            }
            _ => None,
        }
    }

    fn at(&self, t: Time) -> Changing<N> {
        let Driving { strength, strengthening, space, moving } = self.driving(t);
        let law = |factor: f64| self.term.law.times(factor);
        Changing { strengthening: law(strengthening), law: law(strength), space, moving }
    }

    /// Its factor and its space vector at a time, and their rates.
    pub(super) fn driving(&self, t: Time) -> Driving<N> {
        let own = self.term.space;
        let (mut strength, mut strengthening) = self.factor.at(t);
        let (space, moving) = match &self.path {
            Path::Fixed => (own, Vector::zeros()),
            Path::Dipole(field) => field.at(t),
            Path::Turning { plane: [a, b], rate } => {
                let part = |v: &Vector<N>| so::dot(v.as_slice(), own.as_slice());
                let (x, y) = (part(a), part(b));
                let (sin, cos) = libm::sincos(t.angle(*rate, 0.0));
                let rest = own - a * x - b * y;
                let (now_x, now_y) = (x * cos - y * sin, x * sin + y * cos);
                (rest + a * now_x + b * now_y, (b * now_x - a * now_y) * *rate)
            }
            Path::Orbit { across, mean_motion, eccentricity: e, mean_anomaly, node_rate } => {
                let (sin, cos) = eccentric_anomaly(t.angle(*mean_motion, *mean_anomaly), *e);
                // r / a, and the direction by the true anomaly.
                let (r, root) = (1.0 - e * cos, (1.0 - e * e).sqrt());
                let (x, y) = ((cos - e) / r, root * sin / r);
                let turning = mean_motion * root / (r * r);
                let receding = mean_motion * e * sin / r;
                let length = so::norm(own.as_slice());
                let mut direction = own * x + across * (length * y);
                let mut sideways = (across * (length * x) - own * y) * turning;
                if *node_rate != 0.0 {
                    let turn = about_z(t.angle(*node_rate, 0.0));
                    direction = so::to_space(&turn, &direction);
                    sideways = so::to_space(&turn, &sideways)
                        + so::to_space(&z_axis(), &direction) * *node_rate;
                }
                match self.term.law.space() {
                    Space::Direction => (direction, sideways),
                    Space::Place => (direction * r, sideways * r + direction * receding),
                    Space::Tide => {
                        let cube = 1.0 / (r * r * r);
                        strengthening = strengthening * cube - 3.0 * strength * cube / r * receding;
                        strength *= cube;
                        (direction, sideways)
                    }
                }
            }
        };
        Driving { strength, strengthening, space, moving }
    }
}

impl<const N: usize> BodyAtTime<N> {
    /// The torque that is no potential's: left-trivialised, in the body.
    fn torque(&self, g: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let mut sum = Mat::zeros();
        for torque in &self.torques {
            sum += match torque {
                Torque::Body(torque) => *torque,
                Torque::Space(torque) => so::conjugate(&g.transpose(), torque),
                Torque::Viscous(coefficients) => -omega.component_mul(coefficients),
                Torque::OfMomentum(rate) => mu * -rate,
                Torque::Table { .. } | Torque::Faces(_) => Mat::zeros(),
            };
        }
        for faces in &self.faces {
            sum += faces.torque(g);
        }
        sum
    }

    /// `dH/dg - F_tau` at `g`, left-trivialised: minus all that turns the body.
    pub(crate) fn gradient(&self, g: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        self.body.gradient(g) - self.torque(g, mu, omega)
    }

    /// `mu' = [mu, Omega] - dH/dg + F_tau`: see [`RigidBody::momentum_rate`].
    pub(crate) fn momentum_rate(&self, g: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        so::asym(&so::product(mu, omega)) - self.gradient(g, mu, omega)
    }

    /// Returns `dH/dg - F_tau` at fixed spatial momentum, right-trivialised:
    /// `v (g dU/dq)^T - ... - g F_tau g^T`.
    pub(crate) fn spatial_gradient(&self, g: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> Mat<N> {
        let torque = self.torque(g, mu, omega);
        self.body.spatial_gradient(g) - so::conjugate(g, &torque)
    }

    /// Returns the input: `dH/dt + <F_tau, Omega>` to the energy, `g F_tau g^T` to the spatial momentum.
    pub(crate) fn input(&self, g: &Mat<N>, mu: &Mat<N>, omega: &Mat<N>) -> WorkAndImpulse<N> {
        let pushed = !(self.torques.is_empty() && self.faces.is_empty());
        let torque = pushed.then(|| self.torque(g, mu, omega));
        let mut power = torque.map_or(0.0, |torque| so::inner(&torque, omega));
        if let Some(spin) = &self.spin {
            power -= so::inner(spin, omega);
        }
        for Changing { strengthening, law, space, moving } in &self.changing {
            let q = so::to_body(g, space);
            power += strengthening.value(&q) + law.numbers().change(&q, &so::to_body(g, moving));
        }
        WorkAndImpulse {
            power,
            torque: torque.map(|torque| so::conjugate(g, &torque)),
            tables: self.tables,
        }
    }

    /// Refuses a time that the drive does not know, and an attitude at which the potential has lost its meaning.
    pub(crate) fn check(&self, g: &Mat<N>) -> Result<(), Failure> {
        if let Some(refused) = &self.refused {
            return Err(refused.clone());
        }
        self.body.check_distances(g)
    }

    /// Returns the energy at that moment.
    pub(crate) fn energy(&self, g: &Mat<N>, mu: &Mat<N>) -> Energy {
        self.body.energy(g, mu)
    }
}

impl<const N: usize> RigidBody<N> {
    /// Adds a term that changes with time.
    pub fn with_driven_term(mut self, term: DrivenTerm<N>) -> Self {
        self.driven.terms.push(term);
        self
    }

    /// Adds a torque that is no potential's.
    pub fn with_torque(mut self, torque: Torque<N>) -> Self {
        self.driven.torques.push(torque);
        self
    }

    /// Sets wheels whose angular momentum relative to the body is constant:
    /// `mu = J Omega + wheels`, skew.
    pub fn with_wheels(mut self, wheels: Mat<N>) -> Self {
        self.wheels = Some(wheels);
        self
    }

    /// The largest rate at which torques damp the momentum, in 1/s, or a little more: of a viscous one
    /// `max c_ij max |J^-1_ij|`.
    pub fn damping_rate(&self) -> f64 {
        let rates = self.driven.torques.iter().map(|torque| match torque {
            Torque::Viscous(coefficients) => coefficients.amax() * self.mobility(),
            Torque::OfMomentum(rate) => rate.abs(),
            Torque::Body(_) | Torque::Space(_) | Torque::Table { .. } | Torque::Faces(_) => 0.0,
        });
        rates.sum()
    }

    /// Does its energy change with time, or by torques that are no potential's?
    pub fn is_driven(&self) -> bool {
        !self.driven.is_empty()
    }

    /// Returns the body at a moment.
    pub(crate) fn at(&self, t: Time) -> BodyAtTime<N> {
        let changing: Vec<_> = self.driven.terms.iter().map(|driven| driven.at(t)).collect();
        // Built without the drive: its tables may be long.
        let mut body = RigidBody {
            kinetic: self.kinetic.clone(),
            terms: self.terms.clone(),
            inverse_arms_squared: self.inverse_arms_squared.clone(),
            constant: self.constant,
            user: self.user.clone(),
            driven: Driven::default(),
            wheels: self.wheels_at(t),
            control: None,
            stops: Vec::new(),
            pointing: None,
            work: self.work.clone(),
        };
        for Changing { law, space, .. } in &changing {
            body.push(Term { law: law.clone(), space: *space });
        }
        let now = |torque: &Torque<N>| match torque {
            Torque::Table { along, spatial, table } => {
                let torque = along * table.at(t).0[0];
                if *spatial { Torque::Space(torque) } else { Torque::Body(torque) }
            }
            other => other.clone(),
        };
        let refused = self.driven.check(t).err();
        let plain = |torque: &&Torque<N>| !matches!(torque, Torque::Faces(_));
        let torques = self.driven.torques.iter().filter(plain).map(now).collect();
        let faces = self.driven.faces().map(|faces| faces.at(t)).collect();
        let tables = self.driven.torque_tables().map(|(size, table)| size * table.at(t).0[0]).sum();
        let spin = self.driven.spin.map(|spin| spin.rate);
        BodyAtTime { body, torques, faces, tables, spin, changing, refused }
    }

    /// The momentum of the wheels at a time.
    pub(super) fn wheels_at(&self, t: Time) -> Option<Mat<N>> {
        match (&self.wheels, &self.driven.spin) {
            (Some(wheels), Some(Spin { rate, since_s })) => Some(wheels + rate * t.since(*since_s)),
            (wheels, _) => *wheels,
        }
    }

    /// The energy by which the potential jumps at a knot.
    pub(super) fn jump(&self, knot: f64, g: &Mat<N>) -> f64 {
        if self.driven.factor_tables().next().is_none() {
            return 0.0;
        }
        let potential = |t: Time| self.at(t).energy(g, &Mat::zeros()).potential;
        potential(Time::of(knot)) - potential(Time::before(knot))
    }

    /// The body at the nodes of a step from `t`, and at its end.
    pub(crate) fn over(
        &self,
        begun: f64,
        h: f64,
        nodes: impl Iterator<Item = f64>,
    ) -> Vec<BodyAtTime<N>> {
        nodes.chain([1.0]).map(|c| self.at(Time::in_step(begun, h, c * h))).collect()
    }
}
