//! 6 · Two logs, compared: how far their motions are apart, over time.
//!
//! Invariant: samples are compared where both logs have one of the same time since their start; memory is bounded, and every
//! extreme is kept.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::mpsc::{self, Receiver};
use std::thread;

use nalgebra::DMatrix;
use serde::Serialize;
use thiserror::Error;

use crate::log::LogError;
use crate::log::messages::BodyState;
use crate::log::rows::{Row, read_rows};

/// Reason why two logs cannot be compared.
#[derive(Debug, Error)]
pub enum DiffError {
    /// A log could not be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The logs have no sample at the same time, or no quantity in common.
    #[error("there is nothing to compare: {} and {} have no time at which both log /state, /bodies/*/state of one body, /energy or /momentum", .0.display(), .1.display())]
    NothingShared(PathBuf, PathBuf),
    /// Their bodies turn in spaces of different dimension.
    #[error("the bodies of {} and {} turn in spaces of different dimension", .0.display(), .1.display())]
    Dimensions(PathBuf, PathBuf),
}

/// Quantity that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// The largest angle by which the attitudes turn a direction apart, in rad.
    Angle,
    /// Size of the difference of the momenta in body coordinates, in kg m^2/s.
    BodyMomentum,
    /// Size of the difference of the spatial momenta, in kg m^2/s.
    SpatialMomentum,
    /// Size of the difference of the total energies, in J.
    Energy,
    /// Distance of the positions of a body of several, in m.
    Position,
    /// Size of the difference of the linear momenta of a body of several, in kg m/s.
    LinearMomentum,
}

/// Number of quantities.
const QUANTITIES: usize = 6;

impl Quantity {
    /// All quantities.
    pub const ALL: [Self; QUANTITIES] = [
        Self::Angle,
        Self::BodyMomentum,
        Self::SpatialMomentum,
        Self::Energy,
        Self::Position,
        Self::LinearMomentum,
    ];

    /// Returns its name in queries and answers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Angle => "angle",
            Self::BodyMomentum => "body_momentum",
            Self::SpatialMomentum => "spatial_momentum",
            Self::Energy => "energy",
            Self::Position => "position",
            Self::LinearMomentum => "linear_momentum",
        }
    }

    /// Returns its unit.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Angle => "rad",
            Self::BodyMomentum | Self::SpatialMomentum => "kg m^2/s",
            Self::Energy => "J",
            Self::Position => "m",
            Self::LinearMomentum => "kg m/s",
        }
    }
}

/// The largest difference that counts as none: of one quantity, or of each in its own unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Quantity to which it applies; all if absent.
    pub quantity: Option<Quantity>,
    /// Tolerated difference, in the unit of the quantity.
    pub largest: f64,
}

impl FromStr for Tolerance {
    type Err = String;

    /// Parses `1e-6`, or `energy=1e-6`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (quantity, number) = match text.split_once('=') {
            None => (None, text),
            Some((name, number)) => {
                let found = Quantity::ALL.into_iter().find(|quantity| quantity.name() == name);
                let names = Quantity::ALL.map(Quantity::name).join(", ");
                let unknown = || format!("{name:?} is not compared; use one of {names}");
                (Some(found.ok_or_else(unknown)?), number)
            }
        };
        let wanted = || format!("{number:?} is not a tolerance: a number, 0 or more, is needed");
        let largest = number.parse().map_err(|_| wanted())?;
        // Also refuses NaN.
        if !(0.0..f64::INFINITY).contains(&largest) {
            return Err(wanted());
        }
        Ok(Self { quantity, largest })
    }
}

/// Differences at one time, or the largest of several, in the order of [`Quantity::ALL`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Time since the start in seconds; for several samples, that of the last.
    pub time_s: f64,
    /// Difference of each quantity; `None` if not both logs have it.
    #[serde(flatten, serialize_with = "named")]
    pub by: [Option<f64>; QUANTITIES],
}

fn named<S: serde::Serializer>(
    by: &[Option<f64>; QUANTITIES],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_map(Quantity::ALL.map(Quantity::name).iter().zip(by))
}

/// A difference beyond what is tolerated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Beyond {
    /// Time in seconds since the start.
    pub time_s: f64,
    /// Quantity that differs.
    pub quantity: Quantity,
    /// Difference found.
    pub difference: f64,
    /// Difference tolerated.
    pub tolerance: f64,
}

/// The largest difference of a quantity, and the last.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Largest {
    /// Quantity that is compared.
    pub quantity: Quantity,
    /// Its unit.
    pub unit: &'static str,
    /// The largest difference.
    pub largest: f64,
    /// Time of the largest difference, in seconds since the start.
    pub time_s: f64,
    /// The difference at the last time of both.
    pub last: f64,
}

/// Comparison of two logs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Comparison {
    /// Times at which both have a sample.
    pub samples: u64,
    /// Samples of the first one alone.
    pub only_first: u64,
    /// Samples of the second one alone.
    pub only_second: u64,
    /// Largest differences of the quantities that both have.
    pub largest: Vec<Largest>,
    /// The first difference beyond what is tolerated.
    pub first_beyond: Option<Beyond>,
    /// Why each of the two logs is unfinished; absent for a finished one.
    pub unfinished: [Option<String>; 2],
    /// Differences over time, in few rows that keep every extreme.
    pub over_time: Vec<Difference>,
    /// Largest number of samples behind a row.
    #[serde(skip)]
    each: u64,
    #[serde(skip)]
    held: u64,
}

/// Largest number of rows over time.
const LIMIT: usize = 1 << 12;

/// Number of rows that go from a reader to the comparison at once.
const BATCH: usize = 1 << 10;

/// Compares the samples of two logs, finished or not; for ensembles, those of one member.
/// Quantities without a tolerance are not judged; without any at all, each difference counts.
///
/// # Errors
/// If a log cannot be read, or they have nothing that can be compared.
pub fn diff(
    [a, b]: [&Path; 2],
    member: u64,
    tolerances: &[Tolerance],
) -> Result<Comparison, DiffError> {
    let mut limits = [if tolerances.is_empty() { 0.0 } else { f64::INFINITY }; QUANTITIES];
    for Tolerance { quantity, largest } in tolerances {
        for (limit, of) in limits.iter_mut().zip(Quantity::ALL) {
            if quantity.is_none_or(|quantity| quantity == of) {
                *limit = *largest;
            }
        }
    }
    let mut found = Comparison { each: 1, held: 1, ..Comparison::default() };
    let mut largest: [Option<Largest>; QUANTITIES] = [None; QUANTITIES];
    let mut same_size = true;
    thread::scope(|scope| {
        let (mut left, to_left) = Rows::new();
        let (mut right, to_right) = Rows::new();
        let readers = [(a, to_left), (b, to_right)].map(|(path, send)| {
            scope.spawn(move || {
                let mut batch = Vec::with_capacity(BATCH);
                let read = read_rows(path, member, |row| {
                    batch.push(row);
                    if batch.len() < BATCH {
                        return ControlFlow::Continue(());
                    }
                    match send.send(std::mem::take(&mut batch)) {
                        Ok(()) => ControlFlow::Continue(()),
                        Err(_) => ControlFlow::Break(()),
                    }
                });
                // The receiver is gone if the other log is not readable.
                let _ = send.send(batch);
                read.map(|ending| ending.damage)
            })
        });
        let (mut x, mut y) = (left.next(), right.next());
        loop {
            match (x.take(), y.take()) {
                (None, None) => break,
                (Some(_), None) => {
                    found.only_first += 1;
                    x = left.next();
                }
                (None, Some(_)) => {
                    found.only_second += 1;
                    y = right.next();
                }
                (Some(p), Some(q)) if p.0 < q.0 => {
                    found.only_first += 1;
                    (x, y) = (left.next(), Some(q));
                }
                (Some(p), Some(q)) if p.0 > q.0 => {
                    found.only_second += 1;
                    (x, y) = (Some(p), right.next());
                }
                (Some((since_ns, p)), Some((_, q))) => {
                    let difference = Difference { time_s: since_ns as f64 / 1e9, by: by(&p, &q) };
                    same_size &= sizes_agree(&p, &q);
                    found.take_in(difference, &limits, &mut largest);
                    (x, y) = (left.next(), right.next());
                }
            }
        }
        drop((left, right));
        let [first, second] = readers.map(|reader| match reader.join() {
            Ok(read) => read,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        found.unfinished = [first?, second?];
        Ok::<(), DiffError>(())
    })?;
    if !same_size {
        return Err(DiffError::Dimensions(a.to_owned(), b.to_owned()));
    }
    found.largest = largest.into_iter().flatten().collect();
    if found.largest.is_empty() {
        return Err(DiffError::NothingShared(a.to_owned(), b.to_owned()));
    }
    Ok(found)
}

/// The rows of a log as they come from its reader, with their time since the first.
struct Rows {
    receive: Receiver<Vec<Row>>,
    batch: std::vec::IntoIter<Row>,
    start_ns: Option<u64>,
}

impl Rows {
    fn new() -> (Self, mpsc::SyncSender<Vec<Row>>) {
        let (send, receive) = mpsc::sync_channel(2);
        (Self { receive, batch: Vec::new().into_iter(), start_ns: None }, send)
    }
}

impl Iterator for Rows {
    type Item = (u64, Row);

    fn next(&mut self) -> Option<(u64, Row)> {
        if self.batch.len() == 0 {
            self.batch = self.receive.recv().ok()?.into_iter();
        }
        let row = self.batch.next()?;
        let start_ns = *self.start_ns.get_or_insert(row.time_ns);
        Some((row.time_ns.saturating_sub(start_ns), row))
    }
}

/// Returns whether the quantities of both rows have the same number of entries.
fn sizes_agree(a: &Row, b: &Row) -> bool {
    let [states, momenta] = [
        a.state.as_ref().zip(b.state.as_ref()).is_none_or(|(a, b)| {
            a.attitude.len() == b.attitude.len() || a.attitude.is_empty() || b.attitude.is_empty()
        }),
        a.momentum
            .as_ref()
            .zip(b.momentum.as_ref())
            .is_none_or(|(a, b)| a.spatial_momentum.len() == b.spatial_momentum.len()),
    ];
    let of_one_size = |(a, b): (&BodyState, &BodyState)| a.position.len() == b.position.len();
    states && momenta && bodies(a, b).all(of_one_size)
}

/// Returns the differences between two samples; of several bodies, the largest of bodies of one name.
fn by(a: &Row, b: &Row) -> [Option<f64>; QUANTITIES] {
    let states = || a.state.as_ref().zip(b.state.as_ref());
    let momenta = a.momentum.as_ref().zip(b.momentum.as_ref());
    let energies = a.energy.as_ref().zip(b.energy.as_ref());
    let most = |of: fn(&BodyState, &BodyState) -> Option<f64>| {
        let differences = bodies(a, b).filter_map(|(a, b)| of(a, b));
        differences.reduce(f64::max)
    };
    [
        states()
            .and_then(|(a, b)| angle(&a.attitude, &b.attitude))
            .or_else(|| most(|a, b| angle(&a.attitude, &b.attitude))),
        states()
            .and_then(|(a, b)| distance(&a.body_momentum, &b.body_momentum))
            .or_else(|| most(|a, b| distance(&a.body_momentum, &b.body_momentum))),
        momenta.and_then(|(a, b)| distance(&a.spatial_momentum, &b.spatial_momentum)),
        energies.map(|(a, b)| (a.total - b.total).abs()),
        most(|a, b| distance(&a.position, &b.position)),
        most(|a, b| distance(&a.linear_momentum, &b.linear_momentum)),
    ]
}

/// Returns the bodies that both samples have.
fn bodies<'a>(a: &'a Row, b: &'a Row) -> impl Iterator<Item = (&'a BodyState, &'a BodyState)> {
    a.bodies.iter().enumerate().filter_map(|(i, (name, of_a))| {
        // Nearly always in one order.
        let same = b.bodies.get(i).filter(|(other, _)| other == name);
        let found = same.or_else(|| b.bodies.iter().find(|(other, _)| other == name));
        found.map(|(_, of_b)| (of_a, of_b))
    })
}

/// Returns the size of the difference of two vectors; `None` if there are none, or of different
/// length.
fn distance(a: &[f64], b: &[f64]) -> Option<f64> {
    let pairs = || a.iter().zip(b);
    (!a.is_empty() && a.len() == b.len())
        .then(|| pairs().map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt())
}

/// Returns the largest angle by which two rotations, given row by row, turn a direction apart, in
/// rad.
///
/// With theta the largest angle in a plane of `a^T b`, the spectral norm of `a - b` is 2 sin(theta / 2): small angles lose no
/// digits, as they would to a cosine.
fn angle(a: &[f64], b: &[f64]) -> Option<f64> {
    let apart = distance(a, b)?;
    let n = a.len().isqrt();
    let norm = match n {
        // One plane turns, with two equal singular values.
        2 | 3 => apart / std::f64::consts::SQRT_2,
        _ if apart == 0.0 => 0.0,
        _ => {
            let between = a.iter().zip(b).map(|(a, b)| a - b);
            let singular = DMatrix::from_iterator(n, n, between).singular_values();
            singular.iter().copied().fold(0.0, f64::max)
        }
    };
    if norm < std::f64::consts::SQRT_2 {
        return Some(2.0 * libm::asin(0.5 * norm));
    }
    // Near half a turn the sine is flat: the smallest singular value of a + b is 2 cos(theta / 2).
    let sum = a.iter().zip(b).map(|(a, b)| a + b);
    let least = DMatrix::from_iterator(n, n, sum).singular_values().min();
    Some(2.0 * libm::atan2(norm, least))
}

impl Comparison {
    fn take_in(
        &mut self,
        found: Difference,
        limits: &[f64; QUANTITIES],
        largest: &mut [Option<Largest>; QUANTITIES],
    ) {
        self.samples += 1;
        let time_s = found.time_s;
        for (((quantity, by), limit), largest) in
            Quantity::ALL.into_iter().zip(found.by).zip(limits).zip(largest)
        {
            let Some(by) = by else { continue };
            let unit = quantity.unit();
            let most =
                largest.get_or_insert(Largest { quantity, unit, largest: by, time_s, last: by });
            most.last = by;
            if by > most.largest {
                (most.largest, most.time_s) = (by, time_s);
            }
            if by > *limit && self.first_beyond.is_none() {
                let tolerance = *limit;
                self.first_beyond = Some(Beyond { time_s, quantity, difference: by, tolerance });
            }
        }
        if self.held < self.each
            && let Some(last) = self.over_time.last_mut()
        {
            self.held += 1;
            *last = last.and(&found);
            return;
        }
        if self.over_time.len() == LIMIT {
            self.over_time = thinned(&self.over_time, 2);
            self.each *= 2;
        }
        self.held = 1;
        self.over_time.push(found);
    }

    /// Returns whether no difference is beyond what is tolerated, and no log breaks off before the other.
    pub fn agrees(&self) -> bool {
        let [first, second] = [&self.unfinished[0], &self.unfinished[1]].map(Option::is_some);
        let is_cut = (first && self.only_second > 0) || (second && self.only_first > 0);
        self.first_beyond.is_none() && !is_cut
    }

    /// Returns the differences over time in at most `most` rows, each with the largest since the
    /// row before.
    pub fn rows(&self, most: usize) -> Vec<Difference> {
        thinned(&self.over_time, self.over_time.len().div_ceil(most.max(1)).max(1))
    }
}

impl Difference {
    /// Returns the larger differences of the two, at the later time.
    fn and(&self, later: &Self) -> Self {
        let by = std::array::from_fn(|k| match (self.by[k], later.by[k]) {
            (Some(a), Some(b)) => Some(a.max(b)),
            (a, b) => a.or(b),
        });
        Self { time_s: later.time_s, by }
    }
}

fn thinned(rows: &[Difference], each: usize) -> Vec<Difference> {
    let largest = |rows: &[Difference]| rows.iter().copied().reduce(|a, b| a.and(&b));
    rows.chunks(each).filter_map(largest).collect()
}

#[cfg(test)]
mod tests {
    use super::{Comparison, Difference, QUANTITIES, angle};

    #[test]
    fn the_angle_is_that_of_the_rotation_between() {
        let turn = |angle: f64| {
            let (s, c) = (libm::sin(angle), libm::cos(angle));
            [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0]
        };
        for theta in [0.0, 1e-12, 1e-3, 1.0, 1.57, 1.6, 3.0] {
            let found = angle(&turn(0.4), &turn(0.4 + theta)).expect("an angle");
            assert!((found - theta).abs() <= 1e-15 + 1e-4 * theta.min(1e-3), "{theta}: {found}");
        }
        // At half a turn and near it, where a sine or a cosine alone keeps eight digits.
        for less in [0.0, 1e-12, 1e-9, 1e-6, 1e-3] {
            let theta = std::f64::consts::PI - less;
            let found = angle(&turn(0.4), &turn(0.4 + theta)).expect("an angle");
            assert!((found - theta).abs() <= 2e-15, "{less:e}: {:e}", found - theta);
        }
        // In four dimensions the larger of two planes.
        let double = |a: f64, b: f64| {
            let (s, c, t, d) = (libm::sin(a), libm::cos(a), libm::sin(b), libm::cos(b));
            [c, -s, 0.0, 0.0, s, c, 0.0, 0.0, 0.0, 0.0, d, -t, 0.0, 0.0, t, d]
        };
        for (apart, other) in [(0.3, 0.05), (std::f64::consts::PI - 1e-9, 0.05), (2.0, 1.9)] {
            let found = angle(&double(0.1, 0.2), &double(0.1 + apart, 0.2 + other));
            assert!((found.expect("an angle") - apart).abs() < 1e-14, "{found:?}");
        }
        assert_eq!(angle(&[1.0], &[1.0, 0.0]), None);
    }

    #[test]
    fn rows_keep_every_extreme() {
        let mut found = Comparison { each: 1, held: 1, ..Comparison::default() };
        for k in 0..100_000_u32 {
            let peak = if k == 77_777 { 5.0 } else { 0.0 };
            let difference =
                Difference { time_s: k.into(), by: [Some(peak), None, None, None, None, None] };
            found.take_in(difference, &[1.0; QUANTITIES], &mut [None; QUANTITIES]);
        }
        assert!(found.over_time.len() <= super::LIMIT);
        for rows in [found.over_time.clone(), found.rows(7)] {
            let peaks: Vec<f64> =
                rows.iter().filter(|row| row.by[0] == Some(5.0)).map(|row| row.time_s).collect();
            assert!(matches!(peaks[..], [time_s] if time_s >= 77_777.0), "{peaks:?}");
        }
        assert!(found.rows(7).len() <= 7);
        assert_eq!(found.first_beyond.map(|beyond| beyond.time_s), Some(77_777.0));
    }
}
