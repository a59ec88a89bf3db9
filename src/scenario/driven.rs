//! Terms of the potential that change with time, torques that are no potential's, and wheels.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::range::{
    Check, direction, ensure, framed, largest, matrix, number, only_three, size, strength, symmetry,
};
use super::term::PotentialTerm;
use super::{Drag, Entry, Framed, Oblateness, SolarPressure};

/// A term of the potential that changes with time: its vector moves, or its strength.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DrivenTerm {
    /// The term, as it is at t = 0; on an orbit, see there.
    pub term: PotentialTerm,
    /// Motion of its direction or position; it stays if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<Path>,
    /// Factor on its strength; one if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub factor: Option<Factor>,
}

impl DrivenTerm {
    /// Returns a term that stays as it is until a path or a factor is set.
    pub fn of(term: PotentialTerm) -> Self {
        Self { term, path: None, factor: None }
    }
}

/// Motion of the direction or position of a term in space.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Path {
    /// It turns at a constant rate.
    Turning(Turning),
    /// It follows a Kepler orbit.
    Orbit(Orbit),
}

/// A turn at a constant rate, in the plane of two vectors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Turning {
    /// Vector from which it turns.
    pub from: Vec<f64>,
    /// Vector towards which it turns; the two need not be orthogonal, nor of length one.
    pub towards: Vec<f64>,
    /// Rate in rad/s.
    pub rate_rad_s: f64,
}

/// A Kepler orbit. The term's own direction or position points to the pericentre. The length of a position is the
/// semi-major axis: it comes nearer and goes farther. A direction only turns; the strength of a gravity gradient is that at
/// the distance of the semi-major axis, and changes with the inverse cube of the distance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Orbit {
    /// From the pericentre it turns towards this vector; it need not be orthogonal, nor of length one.
    pub towards: Vec<f64>,
    /// Mean motion, 2 pi over the period, in rad/s.
    pub mean_motion_rad_s: f64,
    /// Eccentricity, from 0 to 0.99.
    #[serde(default)]
    pub eccentricity: f64,
    /// Mean anomaly at t = 0 in rad; 0 is the pericentre.
    #[serde(default)]
    pub mean_anomaly_rad: f64,
    /// n = 3: oblateness of the central body, by which the plane of the orbit turns about z; with `semi_major_axis_m`. None if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub j2: Option<Oblateness>,
}

impl Orbit {
    /// Returns a circle, from the pericentre.
    pub fn of(towards: Vec<f64>, mean_motion_rad_s: f64) -> Self {
        Self { towards, mean_motion_rad_s, eccentricity: 0.0, mean_anomaly_rad: 0.0, j2: None }
    }
}

/// Factor on a strength.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Factor {
    /// mean + amplitude cos(rate t + phase)
    Harmonic(Harmonic),
    /// By a table over time.
    Table(Table),
}

/// mean + amplitude cos(rate t + phase)
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Harmonic {
    /// The mean; 1 if absent.
    #[serde(default = "Harmonic::one")]
    pub mean: f64,
    /// The amplitude.
    pub amplitude: f64,
    /// Rate in rad/s.
    pub rate_rad_s: f64,
    /// Phase in rad; 0 if absent.
    #[serde(default)]
    pub phase_rad: f64,
}

impl Harmonic {
    /// Returns an oscillation about a mean of one, from its crest.
    pub fn of(amplitude: f64, rate_rad_s: f64) -> Self {
        Self { mean: Self::one(), amplitude, rate_rad_s, phase_rad: 0.0 }
    }

    fn one() -> f64 {
        1.0
    }
}

/// Values at times that cover the whole run. Steps end at its times, so that methods keep their order wherever these lie.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// Times, ascending, in s. Two equal times are a jump, from the first value to the second.
    pub times_s: Vec<f64>,
    /// Values, one for each time.
    pub values: Vec<f64>,
    /// What is between the times; `monotone` if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interpolation: Option<Interpolation>,
    /// The older form of `interpolation`: `true` for `monotone`, `false` for `linear`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub smooth: Option<bool>,
}

/// What is between the times of a table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Cubic, smooth, and between two times never above or below both of their values.
    #[default]
    Monotone,
    /// Straight lines.
    Linear,
    /// Each value holds from its time to the next.
    Hold,
}

impl Table {
    /// Returns a table that is cubic between the times.
    pub fn of(times_s: Vec<f64>, values: Vec<f64>) -> Self {
        Self { times_s, values, interpolation: None, smooth: None }
    }

    /// Returns what is between the times, in whichever form it was given.
    pub fn between(&self) -> Interpolation {
        match (self.interpolation, self.smooth) {
            (Some(interpolation), _) => interpolation,
            (None, Some(false)) => Interpolation::Linear,
            (None, Some(true) | None) => Interpolation::default(),
        }
    }
}

/// A torque that is no potential's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Torque {
    /// Constant in the body or in space, in N m.
    Constant(Framed),
    /// By a table over time, in N m, along a direction that is constant in the body or in space.
    Table(TorqueTable),
    /// Against the angular velocity.
    Viscous(Viscous),
    /// `-rate` times the body momentum.
    OfMomentum(OfMomentum),
    /// n = 3: of thin air along an orbit, on flat faces.
    Drag(Drag),
    /// n = 3: of sunlight on flat faces.
    SolarPressure(SolarPressure),
}

/// A torque by a table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TorqueTable {
    /// Its direction, used as given, not normalised.
    pub along: Framed,
    /// Strength over time, in N m.
    pub table: Table,
}

/// A torque against the angular velocity; one of the two is given.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Viscous {
    /// The same coefficient about all axes, in N m s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coefficient: Option<f64>,
    /// n = 3: one for each body axis; any n: a symmetric matrix, c_ij for the plane of the axes i and j.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coefficients: Option<Vec<Entry>>,
}

/// A torque along the momentum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OfMomentum {
    /// Rate in 1/s; the momentum falls as `exp(-rate t)` where it is above zero.
    pub rate_per_s: f64,
}

impl Turning {
    pub(super) fn check(&self, at: &str, n: usize) -> Check {
        direction(&format!("{at}/from"), &self.from, n)?;
        direction(&format!("{at}/towards"), &self.towards, n)?;
        apart(&format!("{at}/towards"), &self.from, &self.towards, "`from`")?;
        strength(&format!("{at}/rate_rad_s"), self.rate_rad_s)
    }
}

impl DrivenTerm {
    /// Returns the term with the strength that its orbit gives it, if it was left out.
    pub(crate) fn with_strength(&self) -> PotentialTerm {
        let mut term = self.term.clone();
        if let (PotentialTerm::GravityGradient(gradient), Some(Path::Orbit(orbit))) =
            (&mut term, &self.path)
        {
            let strength = gradient.strength_on_orbit(orbit.mean_motion_rad_s);
            gradient.strength.get_or_insert(strength);
        }
        term
    }

    pub(super) fn check(&self, at: &str, n: usize, duration_s: Option<f64>) -> Check {
        self.with_strength().law().check(&format!("{at}/term"), n)?;
        match &self.path {
            None => {}
            Some(Path::Turning(turning)) => turning.check(&format!("{at}/path/turning"), n)?,
            Some(Path::Orbit(orbit)) => {
                let at = format!("{at}/path/orbit");
                let own = self.term.law().space_vector();
                direction(&format!("{at}/towards"), &orbit.towards, n)?;
                apart(&format!("{at}/towards"), own, &orbit.towards, "the term's own vector")?;
                strength(&format!("{at}/mean_motion_rad_s"), orbit.mean_motion_rad_s)?;
                number(&format!("{at}/mean_anomaly_rad"), orbit.mean_anomaly_rad)?;
                let e = orbit.eccentricity;
                ensure((0.0..=0.99).contains(&e), format!("{at}/eccentricity"), || {
                    format!("{e} given, an eccentricity must be from 0 to 0.99")
                })?;
                if let Some(oblateness) = &orbit.j2 {
                    let at = format!("{at}/j2");
                    only_three(&at, n)?;
                    oblateness.check_on_path(&at, e)?;
                }
            }
        }
        let factor = self.factor.as_ref();
        factor.map_or(Ok(()), |factor| factor.check(&format!("{at}/factor"), duration_s))
    }
}

impl Factor {
    pub(super) fn check(&self, at: &str, duration_s: Option<f64>) -> Check {
        match self {
            Self::Harmonic(harmonic) => {
                let at = format!("{at}/harmonic");
                number(&format!("{at}/mean"), harmonic.mean)?;
                strength(&format!("{at}/amplitude"), harmonic.amplitude)?;
                strength(&format!("{at}/rate_rad_s"), harmonic.rate_rad_s)?;
                number(&format!("{at}/phase_rad"), harmonic.phase_rad)
            }
            Self::Table(table) => table.check(&format!("{at}/table"), duration_s),
        }
    }

    /// Returns its table, if it is one.
    pub(crate) fn table(&self) -> Option<&Table> {
        match self {
            Self::Harmonic(_) => None,
            Self::Table(table) => Some(table),
        }
    }

    /// Returns the rate in rad/s at which it oscillates; 0 if it does not.
    pub(crate) fn rate_rad_s(&self) -> f64 {
        match self {
            Self::Harmonic(harmonic) if harmonic.amplitude != 0.0 => harmonic.rate_rad_s.abs(),
            Self::Harmonic(_) | Self::Table(_) => 0.0,
        }
    }
}

impl Table {
    fn check(&self, at: &str, duration_s: Option<f64>) -> Check {
        /// Largest number of rows.
        const MOST: usize = 100_000;
        let (times, values) = (&self.times_s, &self.values);
        ensure((2..=MOST).contains(&times.len()), format!("{at}/times_s"), || {
            format!("{} times given, a table has 2 to {MOST}", times.len())
        })?;
        ensure(values.len() == times.len(), format!("{at}/values"), || {
            format!("{} values given for {} times", values.len(), times.len())
        })?;
        let both = self.interpolation.is_some() && self.smooth.is_some();
        ensure(!both, format!("{at}/smooth"), || {
            "given next to `interpolation`, of which it is the older form; give one of the two"
                .to_owned()
        })?;
        for (i, (&time, &value)) in times.iter().zip(values).enumerate() {
            number(&format!("{at}/times_s/{i}"), time)?;
            strength(&format!("{at}/values/{i}"), value)?;
            let Some(&before) = i.checked_sub(1).and_then(|i| times.get(i)) else { continue };
            let pointer = format!("{at}/times_s/{i}");
            ensure(time == before || time - before >= 1e-12, &pointer, || {
                format!(
                    "{time} given after {before}; times must ascend, by 1e-12 s at least, or be equal for a jump"
                )
            })?;
            let third = i > 1 && times[i - 2] == time;
            ensure(!third, pointer, || {
                format!("{time} given a third time; a jump takes two equal times")
            })?;
        }
        let (first, last) = (times[0], times[times.len() - 1]);
        ensure(first < last, format!("{at}/times_s"), || {
            format!(
                "{first} and {last} given as first and last time; a table covers a span of time"
            )
        })?;
        ensure(first <= 0.0, format!("{at}/times_s/0"), || {
            format!("{first} given; the table must cover the run, which begins at 0")
        })?;
        let Some(end) = duration_s else { return Ok(()) };
        // A run ends on a step, a rounding away from the duration that was meant.
        ensure(last >= end * (1.0 - 1e-12), format!("{at}/times_s/{}", times.len() - 1), || {
            format!("{last} given; the table must cover the run, which ends at {end}")
        })
    }
}

impl Torque {
    /// Returns the table over time that it has, if any.
    pub(crate) fn table(&self) -> Option<&Table> {
        match self {
            Self::Table(torque) => Some(&torque.table),
            Self::Drag(Drag { factor, .. }) | Self::SolarPressure(SolarPressure { factor, .. }) => {
                factor.as_ref().and_then(Factor::table)
            }
            Self::Constant(_) | Self::Viscous(_) | Self::OfMomentum(_) => None,
        }
    }

    /// Checks form and range; `has_orbit` is whether the scene has a field, with its orbit.
    pub(super) fn check(
        &self,
        at: &str,
        n: usize,
        duration_s: Option<f64>,
        has_orbit: bool,
    ) -> Check {
        match self {
            Self::Constant(torque) => framed(&format!("{at}/constant"), torque, n),
            Self::Table(given) => {
                framed(&format!("{at}/table/along"), &given.along, n)?;
                given.table.check(&format!("{at}/table/table"), duration_s)
            }
            Self::Viscous(viscous) => viscous.check(&format!("{at}/viscous"), n),
            Self::OfMomentum(of) => {
                strength(&format!("{at}/of_momentum/rate_per_s"), of.rate_per_s)
            }
            Self::Drag(drag) => drag.check(&format!("{at}/drag"), n, duration_s, has_orbit),
            Self::SolarPressure(light) => {
                light.check(&format!("{at}/solar_pressure"), n, duration_s)
            }
        }
    }
}

impl Viscous {
    fn check(&self, at: &str, n: usize) -> Check {
        match (&self.coefficient, &self.coefficients) {
            (Some(coefficient), None) => strength(&format!("{at}/coefficient"), *coefficient),
            (None, Some(_)) => {
                let pointer = format!("{at}/coefficients");
                let rows = self.planes(n).ok_or_else(|| {
                    let allowed = if n == 3 { "3 numbers or " } else { "" };
                    super::ScenarioError::invalid(
                        &pointer,
                        format!("{allowed}{n} rows of {n} numbers are needed"),
                    )
                })?;
                matrix(&pointer, &rows, n)?;
                size(&pointer, rows.iter().flatten())?;
                symmetry(&pointer, &rows, 1.0, "symmetric")
            }
            _ => ensure(false, at, || "needs either `coefficient` or `coefficients`".to_owned()),
        }
    }

    /// Returns c_ij; `None` if there is no such matrix.
    pub(crate) fn planes(&self, n: usize) -> Option<Vec<Vec<f64>>> {
        if let Some(coefficient) = self.coefficient {
            return Some(vec![vec![coefficient; n]; n]);
        }
        let entries = self.coefficients.as_ref()?;
        let mut axes = Vec::new();
        let mut rows = Vec::new();
        for entry in entries {
            match entry {
                Entry::Number(x) => axes.push(*x),
                Entry::Row(row) => rows.push(row.clone()),
            }
        }
        match (axes.as_slice(), rows.is_empty()) {
            // The plane of two axes is across the third.
            ([x, y, z], true) if n == 3 => {
                Some(vec![vec![0.0, *z, *y], vec![*z, 0.0, *x], vec![*y, *x, 0.0]])
            }
            ([], false) if rows.len() == n => Some(rows),
            _ => None,
        }
    }
}

/// Checks the wheels.
pub(super) fn wheels(entries: &[Entry], n: usize) -> Check {
    framed("/scene/wheels", &Framed::Body(entries.to_vec()), n).map_err(|error| {
        super::ScenarioError { pointer: error.pointer.replace("/wheels/body", "/wheels"), ..error }
    })
}

/// Checks the number of a term that follows an orbit.
pub(super) fn orbit_frame(pointer: &str, driven: &[DrivenTerm], index: u32) -> Check {
    let term = driven.get(index as usize);
    let on_orbit = term.is_some_and(|term| matches!(term.path, Some(Path::Orbit(_))));
    ensure(on_orbit, pointer, || {
        let count = driven.len();
        format!(
            "{index} given, the number of a term of `driven` ({count} given, from 0) with the path `orbit` is needed"
        )
    })
}

/// Refuses two vectors along one line.
pub(super) fn apart(pointer: &str, a: &[f64], b: &[f64], name: &str) -> Check {
    let (a_size, b_size) = (largest(a), largest(b));
    let unit = |v: &[f64], size: f64| -> Vec<f64> { v.iter().map(|x| x / size).collect() };
    let (a, b) = (unit(a, a_size), unit(b, b_size));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let sine_square = 1.0 - dot(&a, &b) * dot(&a, &b) / (dot(&a, &a) * dot(&b, &b));
    ensure(sine_square > 1e-12, pointer, || {
        format!("is parallel to {name}; the two must span a plane")
    })
}
