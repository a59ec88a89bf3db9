//! The planned model with its const size: the body, its potential, and the state at the start.

use nalgebra::{DMatrix, DVector};

use super::control::{kepler_orbit, node_rate_on_path};
use super::model::with_matrix;
use super::rotation::{across, skew, unit_vector};
use super::{Model, ModelKinetic};
use crate::scenario::{
    Drag, DragFace, DrivenTerm, Entry, Factor, Framed, Interpolation, LitFace, Path, PotentialTerm,
    SolarPressure, Table, Torque, TorqueTable, vector,
};
use crate::solve::hamiltonian::{self as body, Kinetic, RigidBody, Term};
use crate::solve::so::{self, Mat};
use crate::solve::state::State;
use crate::solve::system::System as _;

impl Model {
    /// Returns the body and its state at the start, with their const size.
    pub(crate) fn problem<const N: usize>(&self) -> (RigidBody<N>, State<N>) {
        let kinetic = match &self.kinetic {
            ModelKinetic::Principal { weights } => {
                Kinetic::Principal { weights: Mat::from_fn(|i, j| weights[(i, j)]) }
            }
            ModelKinetic::Tensor { inertia } => Kinetic::of_tensor(*inertia)
                .expect("the plan checked that the inertia is positive definite"),
        };
        let terms = self.terms.iter().map(term).collect();
        let state = State {
            attitude: self.rotation(),
            momentum: Mat::from_fn(|i, j| self.momentum[(i, j)]),
        };
        let mut body = RigidBody::new(kinetic, terms, self.constant);
        for driven in &self.driven {
            body = body.with_driven_term(driven_term(driven));
        }
        for torque in &self.torques {
            body = body.with_torque(self.torque(torque));
        }
        if let Some(wheels) = &self.wheels {
            body = body.with_wheels(Mat::from_fn(|i, j| wheels[(i, j)]));
        }
        (self.control.put_on(body), state)
    }

    /// Returns whether anything changes with time, applies a torque without being a potential, or
    /// spins.
    pub(crate) fn is_driven(&self) -> bool {
        !(self.driven.is_empty() && self.torques.is_empty() && self.control.is_empty())
    }

    fn torque<const N: usize>(&self, given: &Torque) -> body::Torque<N> {
        let own = |entries: &[Entry]| {
            let skew = skew(entries);
            Mat::from_fn(|i, j| skew[(i, j)])
        };
        match given {
            Torque::Constant(Framed::Body(entries)) => body::Torque::Body(own(entries)),
            Torque::Constant(Framed::Space(entries)) => body::Torque::Space(own(entries)),
            Torque::Table(TorqueTable { along, table }) => {
                let (entries, spatial) = match along {
                    Framed::Body(entries) => (entries, false),
                    Framed::Space(entries) => (entries, true),
                };
                body::Torque::Table { along: own(entries), spatial, table: over_time(table) }
            }
            Torque::Viscous(viscous) => {
                let rows = viscous.planes(N).unwrap_or_default();
                body::Torque::Viscous(Mat::from_fn(|i, j| if i == j { 0.0 } else { rows[i][j] }))
            }
            Torque::OfMomentum(of) => body::Torque::OfMomentum(of.rate_per_s),
            Torque::Drag(drag) => body::Torque::Faces(Box::new(air(drag))),
            Torque::SolarPressure(light) => body::Torque::Faces(Box::new(sunlight(light))),
        }
    }

    /// Returns the value of a term at the start.
    pub(super) fn value_at_start(&self, given: &PotentialTerm) -> f64 {
        potential([given]).energy(&self.rotation(), &Mat::zeros()).potential
    }

    /// Returns whether nothing moves at the start, and no torque acts.
    pub(super) fn is_at_rest(&self) -> bool {
        let torque = || potential(&self.terms).gradient(&self.rotation());
        !self.is_driven()
            && self.wheels.is_none()
            && self.momentum.iter().all(|&x| x == 0.0)
            && torque().iter().all(|&x| x == 0.0)
    }

    /// Returns the attitude at the start. Decimal text puts a rotation a digit off the group; the
    /// run starts on it. In more dimensions than the body has, it turns nothing.
    fn rotation<const N: usize>(&self) -> Mat<N> {
        let n = self.attitude.nrows();
        let own = |i: usize, j: usize| {
            if i.max(j) < n { self.attitude[(i, j)] } else { f64::from(i == j) }
        };
        so::polar(&Mat::from_fn(own)).expect("the plan checked that the attitude is a rotation")
    }
}

/// Size into which every body fits: the rest of it is zero.
const LARGEST: usize = 16;

impl Model {
    /// Returns the tables over time.
    fn tables(&self) -> impl Iterator<Item = &Table> {
        let factors = self.driven.iter().filter_map(|driven| driven.factor.as_ref()?.table());
        factors.chain(self.torques.iter().filter_map(Torque::table))
    }

    /// Returns the number of faces in streams.
    pub(super) fn faces(&self) -> usize {
        let of = |torque: &Torque| match torque {
            Torque::Drag(drag) => drag.faces.len(),
            Torque::SolarPressure(light) => light.faces.len(),
            _ => 0,
        };
        self.torques.iter().map(of).sum()
    }

    /// Returns how many knots of tables there are within a run: a step ends at each.
    pub(super) fn knots_within(&self, duration_s: f64, step_s: f64) -> f64 {
        let inside = |&&time: &&f64| time > 0.0 && time < duration_s;
        let of = |table: &Table| over_time(table).knots().iter().filter(inside).count();
        self.tables().map(of).sum::<usize>() as f64 + self.control.knots_within(duration_s, step_s)
    }

    /// Returns the fastest rate in rad/s at which a driven term or a stream changes, with its pointer: that of its factor, or of its
    /// path where it is fastest.
    pub(super) fn fastest_change(&self) -> Option<(String, f64)> {
        // At the pericentre: n (1 + e)^(1/2) / (1 - e)^(3/2).
        let on_orbit = |mean_motion: f64, e: f64| {
            mean_motion.abs() * (1.0 + e).sqrt() / ((1.0 - e) * (1.0 - e).sqrt())
        };
        let of_factor = |factor: &Option<Factor>| factor.as_ref().map_or(0.0, Factor::rate_rad_s);
        let rate = |driven: &DrivenTerm| {
            let path = match &driven.path {
                None => 0.0,
                Some(Path::Turning(turning)) => turning.rate_rad_s.abs(),
                Some(Path::Orbit(orbit)) => on_orbit(orbit.mean_motion_rad_s, orbit.eccentricity),
            };
            of_factor(&driven.factor).max(path)
        };
        let of_torque = |torque: &Torque| match torque {
            Torque::Drag(Drag { orbit, factor, .. }) => {
                let path = orbit
                    .as_ref()
                    .map_or(0.0, |orbit| on_orbit(orbit.mean_motion_rad_s, orbit.eccentricity));
                of_factor(factor).max(path)
            }
            Torque::SolarPressure(light) => of_factor(&light.factor),
            _ => 0.0,
        };
        let terms = self.driven.iter().map(rate).enumerate();
        let terms = terms.map(|(index, rate)| (format!("/scene/driven/{index}"), rate));
        let torques = self.torques.iter().map(of_torque).enumerate();
        let torques = torques.map(|(index, rate)| (format!("/scene/torques/{index}"), rate));
        let rates = terms.chain(torques);
        rates.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|&(_, rate)| rate > 0.0)
    }

    /// Returns whether everything that changes turns at one constant rate, and no torque acts.
    pub(super) fn turns_alike(&self) -> bool {
        if !(self.torques.is_empty() && self.control.is_empty()) {
            return false;
        }
        let moving = self.driven.iter().map(driven_term);
        let body = moving.fold(potential(&self.terms), RigidBody::with_driven_term);
        body.turning_frame().is_some()
    }
}

/// Returns a body with these terms, and nothing that moves, in any dimension.
fn potential<'a>(terms: impl IntoIterator<Item = &'a PotentialTerm>) -> RigidBody<LARGEST> {
    let kinetic = Kinetic::Principal { weights: Mat::zeros() };
    RigidBody::new(kinetic, terms.into_iter().map(term).collect(), 0.0)
}

fn over_time(given: &Table) -> body::Table<1> {
    let values = given.values.iter().map(|&value| [value]).collect();
    let interpolation = match given.between() {
        Interpolation::Monotone => body::Interpolation::Monotone,
        Interpolation::Linear => body::Interpolation::Linear,
        Interpolation::Hold => body::Interpolation::Hold,
    };
    body::Table::new(given.times_s.clone(), values, interpolation)
}

pub(crate) fn driven_term<const N: usize>(given: &DrivenTerm) -> body::DrivenTerm<N> {
    let vector = |v: DVector<f64>| vector::<N>(v.as_slice());
    let term: Term<N> = term(&given.term);
    let path = match &given.path {
        None => body::Path::Fixed,
        Some(Path::Turning(turning)) => {
            let from = unit_vector(&turning.from);
            let towards = across(&turning.towards, &from);
            let plane = [from, towards].map(vector);
            body::Path::Turning { plane, rate: turning.rate_rad_s }
        }
        Some(Path::Orbit(orbit)) => {
            let pericentre = unit_vector(given.term.law().space_vector());
            let across = across(&orbit.towards, &pericentre);
            let node_rate = node_rate_on_path(orbit, pericentre.as_slice(), across.as_slice());
            body::Path::Orbit {
                across: vector(across),
                mean_motion: orbit.mean_motion_rad_s,
                eccentricity: orbit.eccentricity,
                mean_anomaly: orbit.mean_anomaly_rad,
                node_rate,
            }
        }
    };
    let factor = factor(given.factor.as_ref());
    body::DrivenTerm { term, path, factor }
}

fn factor(given: Option<&Factor>) -> body::Factor {
    match given {
        None => body::Factor::Constant,
        Some(Factor::Harmonic(harmonic)) => body::Factor::Harmonic {
            mean: harmonic.mean,
            amplitude: harmonic.amplitude,
            rate: harmonic.rate_rad_s,
            phase: harmonic.phase_rad,
        },
        Some(Factor::Table(table)) => body::Factor::Table(over_time(table)),
    }
}

/// Returns faces in the air: see the formulas of [`body::Faces`].
fn air<const N: usize>(given: &Drag) -> body::Faces<N> {
    let face = |face: &DragFace| body::Face {
        normal: vector(unit_vector(&face.normal).as_slice()),
        centre: vector(&face.centre_m),
        along: 0.5 * given.density_kg_m3 * face.coefficient * face.area_m2,
        mirrored: 0.0,
        scattered: 0.0,
    };
    let orbit = given.orbit.as_ref().map(kepler_orbit);
    body::Faces {
        faces: given.faces.iter().map(face).collect(),
        stream: body::Stream::Flight(orbit.expect("the check found an orbit")),
        factor: factor(given.factor.as_ref()),
    }
}

/// Returns faces in sunlight.
fn sunlight<const N: usize>(given: &SolarPressure) -> body::Faces<N> {
    let face = |face: &LitFace| {
        let force = given.pressure_n_m2 * face.area_m2;
        body::Face {
            normal: vector(unit_vector(&face.normal).as_slice()),
            centre: vector(&face.centre_m),
            along: force * (face.absorption + face.diffuse),
            mirrored: 2.0 * force * face.specular,
            scattered: 2.0 / 3.0 * force * face.diffuse,
        }
    };
    body::Faces {
        faces: given.faces.iter().map(face).collect(),
        stream: body::Stream::Direction(vector(unit_vector(&given.sun).as_slice())),
        factor: factor(given.factor.as_ref()),
    }
}

/// Returns the axes of the frame of an orbit at t = 0 in space coordinates, as columns: z along the direction or position of
/// the term, y against the angular momentum of the orbit, x = y cross z. `None` for a term that follows no orbit.
pub(super) fn orbit_axes(driven: &DrivenTerm, inertia: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let Some(Path::Orbit(orbit)) = &driven.path else { return None };
    let whole =
        DrivenTerm { term: with_matrix(&driven.with_strength(), inertia), ..driven.clone() };
    let z = driven_term::<3>(&whole).space_at(0.0).normalize();
    let pericentre = unit_vector(driven.term.law().space_vector());
    let onwards = unit_vector(&orbit.towards) * orbit.mean_motion_rad_s.signum();
    let y = onwards.cross(&pericentre).normalize();
    let y = vector::<3>(y.as_slice());
    let axes = [y.cross(&z), y, z];
    Some(DMatrix::from_fn(3, 3, |i, j| axes[j][i]))
}

pub(super) fn term<const N: usize>(given: &PotentialTerm) -> Term<N> {
    Term { law: given.modelled(), space: vector(given.law().space_vector()) }
}
