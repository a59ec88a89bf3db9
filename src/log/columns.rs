//! The samples of a run in memory, one array for each quantity: of a run as it goes, or of a log.
//!
//! Invariant: the numbers are those of a table of the log ([`crate::export`]), to the bit and under the same names.

use std::borrow::Cow;
use std::ops::ControlFlow;
use std::path::Path;

use super::messages::{self, Message, Row};
use super::reader::Ending;
use super::rows::read_rows;
use super::schema::{BodyName, Channel};
use super::{LogError, log_time};
use crate::solve::bodies::trajectory as bodies;
use crate::solve::so::Mat;
use crate::solve::trajectory::Sample;

/// The samples of a run, or of one member of an ensemble.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    channels: Vec<Channel>,
    epoch_ns: u64,
    expected: usize,
    log_time_ns: Vec<u64>,
    time_s: Vec<f64>,
    /// The states of several bodies: see [`messages::BodyState`].
    bodies: Vec<(BodyName, [Vectors; 7])>,
    attitude: Vectors,
    quaternion: Vectors,
    body_momentum: Vectors,
    angular_velocity: Vectors,
    energy: [Vectors; 6],
    orthogonality_error: Vectors,
    spatial_momentum: Vectors,
    momentum_drift: Vectors,
    momentum_impulse: Vectors,
    momentum_table_impulse_error: Vectors,
    linear_momentum: Vectors,
    solver_iterations: Vec<u64>,
    solver_increment: Vectors,
    solver_rung: Vec<Cow<'static, str>>,
    solver_sigma_min: Vectors,
    pace: [Vectors; 4],
    pace_own_steps: Vec<u64>,
    control: [Vectors; 8],
    control_saturated: Vec<u64>,
    pointing_error_rad: Vectors,
    pointing: [Vectors; 4],
    relative_rate: Vectors,
    frame_quaternion: Vectors,
    transition: Vectors,
    sensitivity: Vectors,
    covariance: Vectors,
    /// The last quaternion: the next has the nearer sign.
    turn: Option<[f64; 4]>,
    /// The same of each of several bodies.
    turns: Vec<Option<[f64; 4]>>,
    /// Room for the numbers of a matrix.
    room: Vec<f64>,
}

const ENERGY: [&str; 6] = [
    "energy_kinetic",
    "energy_potential",
    "energy_total",
    "energy_error",
    "jacobi_error",
    "energy_work",
];
const PACE: [&str; 4] = ["pace_sigma", "pace_step_s", "pace_least_sigma", "pace_time_error_s"];

const POINTING: [&str; 4] = ["axis_error_rad", "roll_rad", "pitch_rad", "yaw_rad"];

const CONTROL: [&str; 8] = [
    "control_wanted",
    "control_command",
    "attitude_error",
    "rate_error",
    "wheel_momenta",
    "wheel_speeds",
    "control_field",
    "control_disturbance",
];

/// One quantity of all samples.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Numbers, sample after sample; NaN where a sample has none.
    Numbers {
        /// Shape of a sample's: empty for a number, n by n for a matrix, which stands row by row.
        shape: Vec<usize>,
        /// Those of all samples.
        values: Vec<f64>,
    },
    /// Counts; 0 where a sample has none.
    Counts(Vec<u64>),
    /// Words; empty where a sample has none.
    Words(Vec<Cow<'static, str>>),
}

/// The place of a sample: after `before` others, of about `expected`.
#[derive(Clone, Copy)]
struct Place {
    before: usize,
    expected: usize,
}

/// Vectors of one length, one for each sample.
#[derive(Clone, Debug, Default, PartialEq)]
struct Vectors {
    /// Zero while no sample had one.
    width: usize,
    values: Vec<f64>,
}

impl Vectors {
    /// Adds that of a sample; none if it is empty.
    fn push(&mut self, at: Place, numbers: &[f64]) {
        if self.width < numbers.len() {
            // The start has no step, so its columns begin later.
            self.width = numbers.len();
            self.values = Vec::with_capacity(at.expected * self.width);
            self.values.resize(at.before * self.width, f64::NAN);
        }
        if numbers.is_empty() {
            self.values.extend(std::iter::repeat_n(f64::NAN, self.width));
        } else {
            self.values.extend_from_slice(numbers);
        }
    }

    fn of_shape(self, shape: Vec<usize>) -> Option<Values> {
        (self.width > 0).then_some(Values::Numbers { shape, values: self.values })
    }

    fn numbers(self) -> Option<Values> {
        self.of_shape(Vec::new())
    }

    fn vectors(self) -> Option<Values> {
        let width = self.width;
        self.of_shape(vec![width])
    }

    fn matrices(self) -> Option<Values> {
        let n = self.width.isqrt();
        self.of_shape(vec![n, n])
    }
}

/// Samples for which memory is set aside before there are any.
const MOST_EXPECTED: u64 = 1 << 20;

/// Returns a number as a message gives it back that leaves out a zero: without its sign.
fn as_logged(x: f64) -> f64 {
    x + 0.0
}

/// The entries of a matrix, row by row, in `room`.
fn rows<'a, const N: usize>(m: &Mat<N>, room: &'a mut Vec<f64>) -> &'a [f64] {
    room.clear();
    for i in 0..N {
        room.extend((0..N).map(|j| m[(i, j)]));
    }
    room
}

/// The coordinates of a skew matrix, in `room`: see [`crate::solve::so::vee`].
fn vee<'a, const N: usize>(m: &Mat<N>, room: &'a mut Vec<f64>) -> &'a [f64] {
    room.clear();
    if N == 3 {
        room.extend([m[(2, 1)], m[(0, 2)], m[(1, 0)]]);
    } else {
        for i in 0..N {
            room.extend((i + 1..N).map(|j| m[(i, j)]));
        }
    }
    room
}

/// Adds the states of several bodies; columns without numbers for a body that has none.
fn add_bodies(
    bodies: &mut Vec<(BodyName, [Vectors; 7])>,
    at: Place,
    states: &[(BodyName, messages::BodyState)],
) {
    for (name, _) in states {
        if !bodies.iter().any(|(known, _)| known == name) {
            bodies.push((*name, Default::default()));
        }
    }
    for (i, (name, columns)) in bodies.iter_mut().enumerate() {
        let same = states.get(i).filter(|(of, _)| of == name);
        let found = same.or_else(|| states.iter().find(|(of, _)| of == name));
        let none = messages::BodyState::default();
        let state = found.map_or(&none, |(_, state)| state);
        for (column, (_, list)) in columns.iter_mut().zip(state.lists()) {
            column.push(at, list);
        }
    }
}

impl Columns {
    /// Returns columns without a sample, for about `samples` of them, with these channels of a log that begins at `epoch_ns`.
    pub fn new(channels: Vec<Channel>, epoch_ns: u64, samples: u64) -> Self {
        let expected = samples.min(MOST_EXPECTED) as usize;
        let (log_time_ns, time_s) = (Vec::with_capacity(expected), Vec::with_capacity(expected));
        Self { channels, epoch_ns, expected, log_time_ns, time_s, ..Self::default() }
    }

    /// Reads those of a log, finished or not; of an ensemble, of a member. Of these channels, or of all if there are none.
    ///
    /// Damage is no error: it ends the reading and is reported in the [`Ending`].
    ///
    /// # Errors
    /// If the file cannot be opened or read.
    pub fn read(log: &Path, member: u64, channels: &[Channel]) -> Result<(Self, Ending), LogError> {
        let all = channels.is_empty();
        let channels = if all { Message::CHANNELS } else { channels };
        let mut columns = Self::new(channels.to_vec(), 0, 0);
        let mut start_ns = None;
        let ending = read_rows(log, member, |row| {
            let start_ns = *start_ns.get_or_insert(row.time_ns);
            columns.add_row(row, start_ns);
            ControlFlow::Continue(())
        })?;
        Ok((columns, ending))
    }

    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Returns whether there is no sample.
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }

    /// Adds a sample of a run; returns whether a log could hold its time.
    pub(crate) fn record<const N: usize>(&mut self, sample: &Sample<N>) -> bool {
        let Some(log_time_ns) = log_time(self.epoch_ns, sample.time_s) else { return false };
        let at = Place { before: self.len(), expected: self.expected };
        self.log_time_ns.push(log_time_ns);
        self.time_s.push(sample.time_s);
        let mut room = std::mem::take(&mut self.room);
        let room = &mut room;
        let has = |channel| self.channels.contains(&channel);
        if has(Channel::State) {
            let attitude = sample.attitude.as_ref();
            let found = attitude.and_then(messages::quaternion);
            if let Some(found) = found {
                self.turn = Some(messages::nearer_sign(self.turn, found));
            }
            let turn = found.and(self.turn.as_ref()).map_or(&[][..], |turn| turn);
            self.quaternion.push(at, turn);
            self.attitude.push(at, attitude.map_or(&[], |g| rows(g, room)));
            self.body_momentum.push(at, vee(&sample.momentum, room));
            let velocity = sample.angular_velocity.as_ref();
            self.angular_velocity.push(at, velocity.map_or(&[], |omega| vee(omega, room)));
        }
        if has(Channel::Energy) {
            let energy = sample.energy.as_ref();
            let figures = [
                energy.map(|energy| as_logged(energy.kinetic)),
                energy.map(|energy| as_logged(energy.potential)),
                energy.map(|energy| as_logged(energy.total())),
                sample.energy_error.map(as_logged),
                sample.jacobi_error,
                sample.work,
            ];
            for (column, figure) in self.energy.iter_mut().zip(figures) {
                column.push(at, figure.as_slice());
            }
        }
        if has(Channel::Orthogonality) {
            let error = sample.orthogonality_error.map(as_logged);
            self.orthogonality_error.push(at, error.as_slice());
        }
        if has(Channel::Momentum) {
            let momentum = sample.spatial_momentum.as_ref();
            self.spatial_momentum.push(at, momentum.map_or(&[], |m| vee(m, room)));
            self.momentum_drift.push(at, sample.momentum_drift.as_slice());
            let impulse = sample.impulse.as_ref();
            self.momentum_impulse.push(at, impulse.map_or(&[], |m| vee(m, room)));
            let error = sample.table_impulse_error;
            self.momentum_table_impulse_error.push(at, error.as_slice());
        }
        if has(Channel::Solver) {
            let solved = sample.convergence;
            self.solver_iterations.push(solved.map_or(0, |solved| solved.iterations.into()));
            let increment = solved.map(|solved| as_logged(solved.increment));
            self.solver_increment.push(at, increment.as_slice());
            let rung = solved.map_or("", |solved| solved.rung.as_str());
            self.solver_rung.push(Cow::Borrowed(rung));
            let sigma_min = sample.sigma_min.filter(|_| solved.is_some());
            self.solver_sigma_min.push(at, sigma_min.as_slice());
        }
        if has(Channel::Pace) {
            let figures = sample.pace.map_or([None; 4], |pace| {
                [pace.sigma, pace.step_s, pace.least_sigma, pace.time_error_s]
                    .map(|x| Some(as_logged(x)))
            });
            for (column, figure) in self.pace.iter_mut().zip(figures) {
                column.push(at, figure.as_slice());
            }
            self.pace_own_steps.push(sample.pace.map_or(0, |pace| pace.steps));
        }
        if has(Channel::Derivatives) {
            let derivatives = sample.derivatives.as_ref();
            self.transition.push(at, derivatives.map_or(&[], |found| &found.transition));
            self.sensitivity.push(at, derivatives.map_or(&[], |found| &found.sensitivity));
            self.covariance.push(at, derivatives.map_or(&[], |found| &found.covariance));
        }
        let points = has(Channel::Pointing);
        if has(Channel::Control) {
            self.add_control(at, messages::Control::of(sample).unwrap_or_default());
        }
        if points {
            self.add_pointing(at, messages::Pointing::of(sample));
        }
        self.room = std::mem::take(room);
        true
    }

    /// Adds a sample of several bodies of these names; returns whether a log could hold its time.
    pub fn record_bodies<const N: usize>(
        &mut self,
        names: &[BodyName],
        sample: &bodies::Sample<N>,
    ) -> bool {
        let Some(time_ns) = log_time(self.epoch_ns, sample.time_s) else { return false };
        self.turns.resize(names.len(), None);
        for (turn, body) in self.turns.iter_mut().zip(&sample.bodies) {
            let found = messages::quaternion(&body.attitude);
            *turn = found.map(|found| messages::nearer_sign(*turn, found));
        }
        let mut row = Row { time_ns, ..Row::default() };
        for &channel in &self.channels {
            let named = names.iter().copied().map(Some).enumerate();
            let of_each = channel.is_of_each_body();
            for (body, name) in named.filter(|_| of_each).chain((!of_each).then_some((0, None))) {
                let turn = self.turns.get(body).copied().flatten();
                let message = Message::of_bodies(channel, body, sample, turn);
                message.into_iter().for_each(|message| row.take_in(name, message));
            }
        }
        let start_ns = self.log_time_ns.first().copied().unwrap_or(time_ns);
        self.add_row(row, start_ns);
        true
    }

    /// Adds a sample of the control; one without numbers where there is none.
    fn add_control(&mut self, at: Place, seen: messages::Control) {
        let lists = [
            &seen.wanted,
            &seen.command,
            &seen.attitude_error,
            &seen.rate_error,
            &seen.wheel_momenta,
            &seen.wheel_speeds,
            &seen.field,
            &seen.disturbance,
        ];
        for (column, list) in self.control.iter_mut().zip(lists) {
            column.push(at, list);
        }
        self.control_saturated.push(seen.saturated.into());
        self.pointing_error_rad.push(at, seen.pointing_error_rad.as_slice());
    }

    /// Adds where the body points at a sample, if that is known.
    fn add_pointing(&mut self, at: Place, seen: Option<messages::Pointing>) {
        let figures = seen.as_ref().map_or([None; 4], |seen| {
            [seen.axis_error_rad, seen.roll_rad, seen.pitch_rad, seen.yaw_rad]
                .map(|x| Some(as_logged(x)))
        });
        for (column, figure) in self.pointing.iter_mut().zip(figures) {
            column.push(at, figure.as_slice());
        }
        let seen = seen.unwrap_or_default();
        self.relative_rate.push(at, &seen.rate);
        self.frame_quaternion.push(at, &seen.frame);
    }

    /// Adds a sample of a log that begins at `start_ns`.
    fn add_row(&mut self, row: Row, start_ns: u64) {
        let at = Place { before: self.len(), expected: self.expected };
        let since_s = row.time_ns.saturating_sub(start_ns) as f64 / 1e9;
        self.log_time_ns.push(row.time_ns);
        self.time_s.push(row.time_s().unwrap_or(since_s));
        let has = |channel| self.channels.contains(&channel);
        let row = Row {
            state: row.state.filter(|_| has(Channel::State)),
            energy: row.energy.filter(|_| has(Channel::Energy)),
            orthogonality: row.orthogonality.filter(|_| has(Channel::Orthogonality)),
            momentum: row.momentum.filter(|_| has(Channel::Momentum)),
            solver: row.solver.filter(|_| has(Channel::Solver)),
            pace: row.pace.filter(|_| has(Channel::Pace)),
            control: row.control.filter(|_| has(Channel::Control)),
            pointing: row.pointing.filter(|_| has(Channel::Pointing)),
            derivatives: row.derivatives.filter(|_| has(Channel::Derivatives)),
            ..row
        };
        let bodies = if has(Channel::BodyState) { &row.bodies[..] } else { &[] };
        add_bodies(&mut self.bodies, at, bodies);
        let state = row.state.unwrap_or_default();
        self.attitude.push(at, &state.attitude);
        self.quaternion.push(at, &state.quaternion);
        self.body_momentum.push(at, &state.body_momentum);
        self.angular_velocity.push(at, &state.angular_velocity);
        let energy = row.energy.map_or([None; 6], |energy| {
            [
                Some(as_logged(energy.kinetic)),
                Some(as_logged(energy.potential)),
                Some(as_logged(energy.total)),
                Some(as_logged(energy.error)),
                energy.jacobi_error,
                energy.work,
            ]
        });
        for (column, figure) in self.energy.iter_mut().zip(energy) {
            column.push(at, figure.as_slice());
        }
        let error = row.orthogonality.map(|found| as_logged(found.error));
        self.orthogonality_error.push(at, error.as_slice());
        let momentum = row.momentum.unwrap_or_default();
        self.spatial_momentum.push(at, &momentum.spatial_momentum);
        self.momentum_drift.push(at, momentum.drift.as_slice());
        self.momentum_impulse.push(at, &momentum.impulse);
        self.momentum_table_impulse_error.push(at, momentum.table_impulse_error.as_slice());
        self.linear_momentum.push(at, &momentum.linear);
        let increment = row.solver.as_ref().map(|solver| as_logged(solver.increment));
        self.solver_increment.push(at, increment.as_slice());
        let solver = row.solver.unwrap_or_default();
        self.solver_iterations.push(solver.iterations.into());
        self.solver_rung.push(Cow::Owned(solver.rung));
        self.solver_sigma_min.push(at, solver.sigma_min.as_slice());
        let pace = row.pace.map_or(([None; 4], 0), |pace| {
            let figures = [pace.sigma, pace.step_s, pace.least_sigma, pace.time_error_s];
            (figures.map(Some), pace.own_steps)
        });
        for (column, figure) in self.pace.iter_mut().zip(pace.0) {
            column.push(at, figure.as_slice());
        }
        self.pace_own_steps.push(pace.1);
        let points = has(Channel::Pointing);
        if has(Channel::Control) {
            self.add_control(at, row.control.unwrap_or_default());
        }
        if points {
            self.add_pointing(at, row.pointing);
        }
        let derivatives = row.derivatives.unwrap_or_default();
        self.transition.push(at, &derivatives.transition);
        self.sensitivity.push(at, &derivatives.sensitivity);
        self.covariance.push(at, &derivatives.covariance);
    }

    /// Returns the quantities that any sample has, under the names of a table, which adds an axis or row and column to those of
    /// vectors and matrices.
    pub fn into_all(self) -> Vec<(Cow<'static, str>, Values)> {
        let time_s = Values::Numbers { shape: Vec::new(), values: self.time_s };
        let mut all = vec![
            (Cow::Borrowed("log_time_ns"), Values::Counts(self.log_time_ns)),
            (Cow::Borrowed("time_s"), time_s),
        ];
        let quantities = messages::BodyState::default().lists().map(|(quantity, _)| quantity);
        for (name, columns) in self.bodies {
            let named = quantities.into_iter().zip(columns).filter_map(|(quantity, column)| {
                let values = match quantity {
                    "attitude" => column.matrices(),
                    _ => column.vectors(),
                };
                Some((Cow::Owned(format!("{}_{quantity}", name.as_str())), values?))
            });
            all.extend(named);
        }
        let of_state = [
            ("attitude", self.attitude.matrices()),
            ("quaternion", self.quaternion.vectors()),
            ("body_momentum", self.body_momentum.vectors()),
            ("angular_velocity", self.angular_velocity.vectors()),
        ];
        let energy = ENERGY.into_iter().zip(self.energy.map(Vectors::numbers));
        let of_momentum = [
            ("orthogonality_error", self.orthogonality_error.numbers()),
            ("spatial_momentum", self.spatial_momentum.vectors()),
            ("momentum_drift", self.momentum_drift.numbers()),
            ("momentum_impulse", self.momentum_impulse.vectors()),
            ("momentum_table_impulse_error", self.momentum_table_impulse_error.numbers()),
            ("linear_momentum", self.linear_momentum.vectors()),
        ];
        let steps = self.solver_increment.width > 0;
        let of_solver = [
            ("solver_iterations", steps.then_some(Values::Counts(self.solver_iterations))),
            ("solver_increment", self.solver_increment.numbers()),
            ("solver_rung", steps.then_some(Values::Words(self.solver_rung))),
            ("solver_sigma_min", self.solver_sigma_min.numbers()),
        ];
        let own = self.pace[0].width > 0;
        let pace = PACE.into_iter().zip(self.pace.map(Vectors::numbers));
        let own_steps = ("pace_own_steps", own.then_some(Values::Counts(self.pace_own_steps)));
        let found = of_state.into_iter().chain(energy).chain(of_momentum).chain(of_solver);
        let controlled = self.control[0].width > 0;
        let saturated = controlled.then_some(Values::Counts(self.control_saturated));
        let control = CONTROL.into_iter().zip(self.control.map(Vectors::vectors));
        let found = found.chain(pace).chain([own_steps]).chain(control).chain([
            ("control_saturated", saturated),
            ("pointing_error_rad", self.pointing_error_rad.numbers()),
            ("relative_rate", self.relative_rate.vectors()),
            ("frame_quaternion", self.frame_quaternion.vectors()),
            ("transition", self.transition.matrices()),
            ("sensitivity", self.sensitivity.vectors()),
            ("covariance", self.covariance.matrices()),
        ]);
        let pointing = POINTING.into_iter().zip(self.pointing.map(Vectors::numbers));
        let found = found.chain(pointing);
        all.extend(found.filter_map(|(name, values)| Some((Cow::Borrowed(name), values?))));
        all
    }
}
