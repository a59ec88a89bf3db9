//! The members of an ensemble: a quantity of all of them over time, and those that stand out.
//!
//! Invariant: what is kept of a member is one number a point and its row of the table, however large its state is.

use std::collections::BTreeMap;
use std::fs::File;
use std::ops::ControlFlow;
use std::path::Path;

use prost::Message as _;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::LogError;
use super::end::End;
use super::messages::{BodyWaypoints, Figures, Member, MemberBody, Waypoints};
use super::reader::{self, Item};
use super::schema::Channel;

/// Quantity by which the members of an ensemble are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MemberQuantity {
    /// Angle between the attitudes of a member and of member 0, in rad. For n > 3 the root of the sum of the squares
    /// of its angles as long as they are small, at most pi. Of several bodies the largest, as for what follows.
    Distance,
    /// Several bodies: distance of the centre of mass from that in member 0, in m.
    PlaceDistance,
    /// Angle of an axis of the body to the axis of space of the same number, in rad.
    AxisAngle,
    /// Size of the angular velocity, in rad/s.
    AngularVelocity,
    /// Total energy minus that at the start, in joule.
    EnergyError,
    /// Distance of the attitude from the group.
    OrthogonalityError,
    /// Change of the part of the spatial momentum that the scene conserves, in kg m^2/s.
    MomentumDrift,
}

impl MemberQuantity {
    /// All quantities.
    pub const ALL: [Self; 7] = [
        Self::Distance,
        Self::PlaceDistance,
        Self::AxisAngle,
        Self::AngularVelocity,
        Self::EnergyError,
        Self::OrthogonalityError,
        Self::MomentumDrift,
    ];

    /// Returns its name in queries and answers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Distance => "distance",
            Self::PlaceDistance => "place_distance",
            Self::AxisAngle => "axis_angle",
            Self::AngularVelocity => "angular_velocity",
            Self::EnergyError => "energy_error",
            Self::OrthogonalityError => "orthogonality_error",
            Self::MomentumDrift => "momentum_drift",
        }
    }

    /// The unit of its values; empty for a number.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Distance | Self::AxisAngle => "rad",
            Self::PlaceDistance => "m",
            Self::AngularVelocity => "rad/s",
            Self::EnergyError => "J",
            Self::OrthogonalityError => "",
            Self::MomentumDrift => "kg m²/s",
        }
    }

    /// Returns its value at each point on the way of a member, up to the end of member 0 if it is
    /// compared with that; of several bodies the largest.
    fn values(self, way: &Ways, nominal: &Ways, axis: usize) -> Vec<f32> {
        let of_all = match self {
            Self::EnergyError => &way.of_all.energy_error,
            Self::OrthogonalityError => &way.of_all.orthogonality_error,
            Self::MomentumDrift => &way.of_all.momentum_drift,
            _ => {
                let bodies = way.bodies.iter().zip(nominal.of_each());
                let each = bodies.map(|(body, nominal_body)| {
                    self.of_body((&way.of_all.time_s, body), nominal_body, axis)
                });
                // All have the same times.
                let larger = |mut most: Vec<f32>, values: Vec<f32>| {
                    most.iter_mut().zip(values).for_each(|(most, value)| *most = most.max(value));
                    most
                };
                return each.reduce(larger).unwrap_or_default();
            }
        };
        of_all.clone()
    }

    /// Does the same of one body.
    fn of_body(
        self,
        (time_s, way): (&[f64], &BodyWaypoints),
        nominal: Option<(&[f64], &BodyWaypoints)>,
        axis: usize,
    ) -> Vec<f32> {
        let count = time_s.len().max(1);
        let from_nominal = |mine: &[f32], of: fn(&BodyWaypoints) -> &[f32], by: Compare| {
            let Some((its_s, nominal)) = nominal else { return Vec::new() };
            let size = mine.len() / count;
            if size == 0 {
                return Vec::new();
            }
            let both = mine.chunks_exact(size).zip(of(nominal).chunks_exact(size));
            let times = time_s.iter().zip(its_s);
            let together = both.zip(times).take_while(|(_, (mine, its))| mine == its);
            together.map(|((x, x0), _)| by(x, x0)).collect()
        };
        match self {
            Self::Distance => from_nominal(&way.attitude, |way| &way.attitude, between),
            Self::PlaceDistance => from_nominal(&way.position, |way| &way.position, apart),
            Self::AxisAngle => {
                let n = way.axis_angle.len() / count;
                way.axis_angle
                    .chunks_exact(n.max(1))
                    .filter_map(|at| at.get(axis))
                    .copied()
                    .collect()
            }
            _ => way.angular_velocity.clone(),
        }
    }

    /// Returns the largest value of all samples, where the figures of a member hold it.
    const fn largest(self, figures: &Figures) -> Option<f64> {
        match self {
            Self::EnergyError => figures.energy_max_abs_error,
            Self::OrthogonalityError => figures.orthogonality_max,
            Self::MomentumDrift => figures.momentum_max_drift,
            Self::Distance | Self::PlaceDistance | Self::AxisAngle | Self::AngularVelocity => None,
        }
    }
}

/// Returns the angle between two attitudes: the chord of two turns by an angle apart has the length
/// `2 sqrt 2 sin(angle / 2)`.
fn between(g: &[f32], g0: &[f32]) -> f32 {
    let squares = g.iter().zip(g0).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2));
    let chord = (squares.sum::<f64>() / 8.0).sqrt();
    (2.0 * libm::asin(chord.min(1.0))) as f32
}

/// Compares what two members are at a time.
type Compare = fn(&[f32], &[f32]) -> f32;

/// Returns the distance of two points.
fn apart(x: &[f32], x0: &[f32]) -> f32 {
    let squares = x.iter().zip(x0).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2));
    squares.sum::<f64>().sqrt() as f32
}

/// The points on the way of a member, those of each body by themselves.
#[derive(Debug, Default)]
struct Ways {
    of_all: Waypoints,
    bodies: Vec<BodyWaypoints>,
}

impl Ways {
    fn of(way: Waypoints, bodies: Vec<MemberBody>) -> Self {
        let one = BodyWaypoints {
            attitude: way.attitude.clone(),
            axis_angle: way.axis_angle.clone(),
            angular_velocity: way.angular_velocity.clone(),
            position: Vec::new(),
        };
        let several: Vec<_> = bodies.into_iter().map(|body| body.way.unwrap_or_default()).collect();
        Self { of_all: way, bodies: if several.is_empty() { vec![one] } else { several } }
    }

    /// Returns the times and points of each body, and nothing for bodies that it has not.
    fn of_each(&self) -> impl Iterator<Item = Option<(&[f64], &BodyWaypoints)>> {
        let known = self.bodies.iter().map(|body| Some((self.of_all.time_s.as_slice(), body)));
        known.chain(std::iter::repeat(None))
    }
}

/// The order of members.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MemberOrder {
    /// By the largest value on the way, the largest first.
    Largest,
    /// By the same value, the smallest first.
    Smallest,
    /// Failed members first, in the order of their failures.
    Failed,
    /// By number.
    Member,
}

impl MemberOrder {
    /// All orders.
    pub const ALL: [Self; 4] = [Self::Largest, Self::Smallest, Self::Failed, Self::Member];

    /// Returns its name in queries.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Largest => "largest",
            Self::Smallest => "smallest",
            Self::Failed => "failed",
            Self::Member => "member",
        }
    }
}

/// Query for the members of an ensemble.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    /// Quantity by which they are compared.
    pub quantity: MemberQuantity,
    /// Number of the axis for an angle of axes, from 0.
    pub axis: usize,
    /// The order of the rows.
    pub order: MemberOrder,
    /// Rows that are left out before the first.
    pub offset: usize,
    /// Largest number of rows.
    pub limit: usize,
}

/// A quantity of all members over time, and some of the members.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Members {
    /// Quantity by which they are compared.
    pub channel: MemberQuantity,
    /// The unit of the values; empty for a number.
    pub unit: &'static str,
    /// Members that have ended.
    pub members: u64,
    /// Number of failed members, by code.
    pub failed: BTreeMap<String, u64>,
    /// Times in seconds.
    pub time_s: Vec<f64>,
    /// Members that got to each time.
    pub count: Vec<u64>,
    /// Quantiles of their values at each time.
    pub quantiles: Vec<MemberQuantile>,
    /// The members in the order asked for.
    pub rows: Vec<MemberRow>,
}

/// A part of the members lies at or below these values.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct MemberQuantile {
    /// The part, from 0 (the least value) to 1 (the largest).
    pub part: f64,
    /// One value a time: the least that this part of the members does not exceed.
    pub values: Vec<f32>,
}

/// One member.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct MemberRow {
    /// Its number.
    pub member: u64,
    /// `succeeded`, or the code of its failure.
    pub outcome: String,
    /// Steps made.
    pub steps: u64,
    /// Time of the end in seconds.
    pub end_s: f64,
    /// The largest size of the quantity, of all samples; absent if there is none.
    pub largest: Option<f64>,
    /// Time of the point that shows it, in seconds.
    pub largest_at_s: Option<f64>,
    /// Its value at each time, as far as it came.
    pub values: Vec<f32>,
}

/// The parts of the members that a fan shows.
const PARTS: [f64; 7] = [0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0];

/// Reads the members that have ended. Returns `None` if `stopped` said so on the way.
///
/// # Errors
/// If the file cannot be read, or its index is damaged.
pub fn read_members(
    path: &Path,
    wanted: Wanted,
    stopped: &dyn Fn() -> bool,
) -> Result<Option<Members>, LogError> {
    let mut reading = Reading {
        wanted,
        nominal: Ways::default(),
        rows: Vec::new(),
        last_s: Vec::new(),
        time_s: Vec::new(),
    };
    let mut stop = false;
    each(path, |member| {
        stop = stopped();
        if stop {
            return ControlFlow::Break(());
        }
        reading.note(member);
        ControlFlow::Continue(())
    })?;
    Ok((!stop).then(|| reading.members()))
}

/// Reads how a member began and ended; `None` if it has not ended yet, there is none of this number, or `stopped` said so.
///
/// # Errors
/// If the file cannot be read, or its index is damaged.
pub fn read_member(
    path: &Path,
    member: u64,
    stopped: &dyn Fn() -> bool,
) -> Result<Option<Member>, LogError> {
    let mut found = None;
    each(path, |end| {
        if end.member == member {
            found = Some(end);
            return ControlFlow::Break(());
        }
        if stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    Ok(found)
}

/// Passes on the ends of members; in an unfinished log, those in whole chunks.
fn each(path: &Path, mut visit: impl FnMut(Member) -> ControlFlow<()>) -> Result<(), LogError> {
    let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
    let topic = Channel::EnsembleMembers.topic();
    let mut seen = |data: &[u8]| match Member::decode(data) {
        Ok(member) => visit(member),
        Err(_) => ControlFlow::Continue(()),
    };
    let Some(end) = End::read(&mut file) else {
        reader::read(path, |item| match item {
            Item::Message { topic: of, data, .. } if of == topic => seen(data),
            _ => ControlFlow::Continue(()),
        })?;
        return Ok(());
    };
    end.messages(&mut file, |of| of == topic, 0..u64::MAX, |_, _, data| seen(data))
        .map_err(|source| LogError::mcap(path, "read", source))
}

struct Reading {
    wanted: Wanted,
    /// The way of member 0, which ends first.
    nominal: Ways,
    rows: Vec<MemberRow>,
    /// Time of the last value of each row.
    last_s: Vec<Option<f64>>,
    /// The longest list of times: that of all members but for the last time of one that ended early.
    time_s: Vec<f64>,
}

impl Reading {
    fn note(&mut self, end: Member) {
        let Wanted { quantity, axis, .. } = self.wanted;
        let end_s = end.end_s().unwrap_or_default();
        let ways = Ways::of(end.way.unwrap_or_default(), end.bodies);
        let nominal = if end.member == 0 { &ways } else { &self.nominal };
        let values = quantity.values(&ways, nominal, axis);
        let way = &ways.of_all;
        self.last_s
            .push(values.len().checked_sub(1).and_then(|last| way.time_s.get(last).copied()));
        let sizes = values.iter().enumerate().map(|(k, value)| (k, value.abs()));
        let peak = sizes.reduce(|a, b| if b.1 > a.1 { b } else { a });
        let known = quantity.largest(&end.figures.unwrap_or_default());
        self.rows.push(MemberRow {
            member: end.member,
            outcome: end.outcome,
            steps: end.steps,
            end_s,
            largest: known.or(peak.map(|(_, size)| f64::from(size))),
            largest_at_s: peak.and_then(|(k, _)| way.time_s.get(k).copied()),
            values,
        });
        if way.time_s.len() > self.time_s.len() {
            self.time_s.clone_from(&way.time_s);
        }
        if end.member == 0 {
            self.nominal = ways;
        }
    }

    fn members(mut self) -> Members {
        let Wanted { quantity, order, offset, limit, .. } = self.wanted;
        // The last point of a member that ended early may lie between two of the others: on these it was not seen.
        for (row, last_s) in self.rows.iter_mut().zip(&self.last_s) {
            let shown_s = row.values.len().checked_sub(1).map(|last| self.time_s[last]);
            if shown_s != *last_s {
                row.values.pop();
            }
        }
        let mut quantiles = PARTS.map(|part| MemberQuantile { part, values: Vec::new() });
        let mut count = Vec::new();
        for k in 0..self.time_s.len() {
            let mut values: Vec<f32> =
                self.rows.iter().filter_map(|row| row.values.get(k)).copied().collect();
            if values.is_empty() {
                break;
            }
            values.sort_unstable_by(f32::total_cmp);
            count.push(values.len() as u64);
            for MemberQuantile { part, values: line } in &mut quantiles {
                line.push(values[(*part * (values.len() - 1) as f64).ceil() as usize]);
            }
        }
        self.time_s.truncate(count.len());
        let mut failed = BTreeMap::new();
        for row in self.rows.iter().filter(|row| row.failed()) {
            *failed.entry(row.outcome.clone()).or_default() += 1;
        }
        let members = self.rows.len() as u64;
        // A member without a value comes last, whatever the order.
        let size = |row: &MemberRow, last: f64| row.largest.unwrap_or(last);
        match order {
            MemberOrder::Member => self.rows.sort_by_key(|row| row.member),
            MemberOrder::Smallest => {
                self.rows.sort_by(|a, b| size(a, f64::INFINITY).total_cmp(&size(b, f64::INFINITY)))
            }
            MemberOrder::Largest => {
                self.rows.sort_by(|a, b| size(b, -1.0).total_cmp(&size(a, -1.0)))
            }
            MemberOrder::Failed => {
                self.rows.sort_by_key(|row| (!row.failed(), row.steps, row.member))
            }
        }
        Members {
            channel: quantity,
            unit: quantity.unit(),
            members,
            failed,
            time_s: self.time_s,
            count,
            quantiles: quantiles.into(),
            rows: self.rows.into_iter().skip(offset).take(limit).collect(),
        }
    }
}

impl MemberRow {
    fn failed(&self) -> bool {
        self.outcome != "succeeded"
    }
}

#[cfg(test)]
mod tests {
    use super::{MemberOrder, MemberQuantity, between};

    #[test]
    fn names_are_those_of_answers() {
        for quantity in MemberQuantity::ALL {
            assert_eq!(serde_json::to_value(quantity).expect("a name"), quantity.name());
        }
        for order in MemberOrder::ALL {
            assert_eq!(serde_json::to_value(order).expect("a name"), order.name());
        }
    }

    #[test]
    fn the_angle_between_attitudes_is_that_of_the_turn() {
        let still = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        for angle in [0.0, 0.01, 1.0, 3.0] {
            let (sin, cos) = f32::sin_cos(angle);
            let turned = [cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0];
            let off = (between(&turned, &still) - angle).abs();
            assert!(off < 1e-6, "{angle}: off by {off}");
        }
    }
}
