//! The messages of a log: our own, generated from `vpd.proto`, and how a sample fills them.
//!
//! Invariant: a message depends on its sample alone, and the sign of a quaternion on the sample before, so that a job that is
//! run again, or resumed in the middle, writes the same bytes.

use prost::Message as _;

use foxglove::messages::{FrameTransform, FrameTransforms, Quaternion, Vector3};

use super::field::Field;
use super::schema::{BodyName, Channel, Topic, timestamp};
use crate::solve::bodies::trajectory as bodies;
use crate::solve::control;
use crate::solve::nonlinear::{Convergence, Rung};
use crate::solve::pointing::Pointed;
pub use crate::solve::so::quaternion;
use crate::solve::so::{self, Mat, Vector};
use crate::solve::state;
use crate::solve::system;
use crate::solve::trajectory::Sample;

include!(concat!(env!("OUT_DIR"), "/vpd.rs"));

/// The lowest logarithm of an error: below every non-zero error that doubles near 1 can show.
pub const LOG10_FLOOR: f64 = -20.0;

/// Returns the decimal logarithm of the size of `x`, not below [`LOG10_FLOOR`]: zero has a place in
/// a plot.
///
/// By the `libm` crate, so that the bits do not depend on the machine.
pub fn log10_size(x: f64) -> f64 {
    libm::log10(x.abs()).max(LOG10_FLOOR)
}

macro_rules! messages_of_samples {
    ($($(#[doc = $doc:literal])* $field:ident: $message:ident {
        $($column:ident: $kind:ident($value:ident)),*
    },)*) => {
        $(impl $message {
            /// Returns its fields in a table.
            pub(crate) fn fields(&self) -> Vec<Field> {
                vec![$(Field::$kind(stringify!($column), &self.$value)),*]
            }
        })*

        /// A message of our own that belongs to a sample, named by its channel.
        #[derive(Clone, Debug, PartialEq)]
        #[allow(missing_docs)]
        pub enum Message {
            BodyState(BodyState),
            $($message($message),)*
        }

        impl Message {
            /// The channels of these messages.
            pub const CHANNELS: &[Channel] = &[Channel::BodyState, $(Channel::$message),*];

            /// Decodes the message behind `data`; `None` if the topic or the type is not ours or it
            /// cannot be decoded.
            pub fn decode(topic: &str, schema: &str, data: &[u8]) -> Option<Self> {
                let channel = Channel::from_topic(topic)?;
                if channel.schema_name() != schema {
                    return None;
                }
                match channel {
                    Channel::BodyState => BodyState::decode(data).ok().map(Self::BodyState),
                    $(Channel::$message => $message::decode(data).ok().map(Self::$message),)*
                    _ => None,
                }
            }
        }

        /// Contents of a log for one sample; `None` where a channel is not logged, or has nothing
        /// for it.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct Row {
            /// Log time, in nanoseconds since 1970.
            pub time_ns: u64,
            /// The states of several bodies, in the order of the log.
            pub bodies: Vec<(BodyName, BodyState)>,
            $($(#[doc = $doc])* pub $field: Option<$message>,)*
        }

        impl Row {
            /// Returns its time since the start in seconds, if a state says it.
            pub(crate) fn time_s(&self) -> Option<f64> {
                let of_body = || self.bodies.first().map(|(_, state)| state.time_s);
                self.state.as_ref().map(|state| state.time_s).or_else(of_body)
            }

            /// Returns the fields of a channel in a table.
            pub(crate) fn fields(&self, channel: Channel) -> Vec<Field> {
                match channel {
                    $(Channel::$message => Field::of(self.$field.as_ref(), $message::fields),)*
                    Channel::BodyState => self.bodies.iter().flat_map(BodyState::named).collect(),
                    _ => Vec::new(),
                }
            }

            /// Returns whether it has a message of a topic.
            pub(super) fn holds(&self, topic: Topic) -> bool {
                match topic.channel {
                    $(Channel::$message => self.$field.is_some(),)*
                    _ => self.bodies.iter().any(|(body, _)| Some(*body) == topic.body),
                }
            }

            /// Takes in a message of a topic; of a body, if the topic names one.
            pub(super) fn take_in(&mut self, body: Option<BodyName>, message: Message) {
                match message {
                    Message::BodyState(state) => {
                        self.bodies.extend(body.map(|body| (body, state)));
                    }
                    $(Message::$message(message) => self.$field = Some(message),)*
                }
            }
        }

        impl Message {
            /// Returns the message of a sample on a channel; `None` if there is none. `turn` is its
            /// quaternion with the sign to be shown.
            pub fn of_sample<const N: usize>(
                channel: Channel,
                sample: &Sample<N>,
                turn: Option<[f64; 4]>,
            ) -> Option<Self> {
                let mut message = match channel {
                    $(Channel::$message => Option::from($message::of(sample)).map(Self::$message),)*
                    _ => None,
                };
                if let Some(Self::State(state)) = &mut message {
                    state.quaternion = turn.map_or_else(Vec::new, |turn| turn.to_vec());
                }
                message
            }

            /// Adds its bytes in a log.
            pub fn encode(&self, out: &mut Vec<u8>) {
                match self {
                    Self::BodyState(message) => message.encode(out).expect("a vector has room"),
                    $(Self::$message(message) => message.encode(out).expect("a vector has room"),)*
                }
            }
        }
    };
}

// A message, and its columns in a table: the logarithms follow from the errors and are left out.
messages_of_samples! {
    /// Attitude, body momentum and velocity.
    state: State {
        attitude: numbers(attitude), quaternion: numbers(quaternion),
        body_momentum: numbers(body_momentum), angular_velocity: numbers(angular_velocity)
    },
    /// Energy.
    energy: Energy {
        energy_kinetic: number(kinetic), energy_potential: number(potential),
        energy_total: number(total), energy_error: number(error),
        jacobi_error: number(jacobi_error), energy_work: number(work)
    },
    /// Distance from the group.
    orthogonality: Orthogonality { orthogonality_error: number(error) },
    /// Spatial momentum.
    momentum: Momentum {
        spatial_momentum: numbers(spatial_momentum), momentum_drift: number(drift),
        momentum_impulse: numbers(impulse), momentum_table_impulse_error: number(table_impulse_error),
        linear_momentum: numbers(linear)
    },
    /// How the step was solved.
    solver: Solver {
        solver_iterations: count(iterations), solver_increment: number(increment),
        solver_rung: word(rung), solver_sigma_min: number(sigma_min)
    },
    /// Rate of time for adaptive steps.
    pace: Pace {
        pace_sigma: number(sigma), pace_step_s: number(step_s), pace_own_steps: count(own_steps),
        pace_least_sigma: number(least_sigma), pace_time_error_s: number(time_error_s)
    },
    /// A sample of the control.
    control: Control {
        control_wanted: numbers(wanted), control_command: numbers(command),
        control_saturated: count(saturated), pointing_error_rad: number(pointing_error_rad),
        attitude_error: numbers(attitude_error), rate_error: numbers(rate_error),
        wheel_momenta: numbers(wheel_momenta), wheel_speeds: numbers(wheel_speeds),
        control_field: numbers(field), control_disturbance: numbers(disturbance)
    },
    /// Where the body points.
    pointing: Pointing {
        axis_error_rad: number(axis_error_rad), roll_rad: number(roll_rad),
        pitch_rad: number(pitch_rad), yaw_rad: number(yaw_rad),
        relative_rate: numbers(rate), frame_quaternion: numbers(frame)
    },
    /// Derivatives by the start and by parameters.
    derivatives: Derivatives {
        transition: numbers(transition), sensitivity: numbers(sensitivity), covariance: numbers(covariance)
    },
}

impl Member {
    /// Returns the pointer of the condition that ended it before its time.
    pub(crate) fn stopped_by_pointer(&self) -> Option<String> {
        self.stopped_by.map(|number| format!("/until/{number}"))
    }

    /// Returns the time of its end in seconds; `None` if it has no state there.
    pub(crate) fn end_s(&self) -> Option<f64> {
        let of_body = || self.bodies.first()?.last.as_ref().map(|last| last.time_s);
        self.last.as_ref().map(|last| last.time_s).or_else(of_body)
    }
}

impl State {
    /// Returns attitude and momentum of a sample.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Self {
        let velocity = sample.angular_velocity.as_ref();
        Self::at(sample.time_s, sample.attitude.as_ref(), &sample.momentum, velocity)
    }

    /// Returns an attitude, where there is one, a momentum and, where it has a name, its velocity
    /// at a time.
    pub fn at<const N: usize>(
        time_s: f64,
        attitude: Option<&Mat<N>>,
        momentum: &Mat<N>,
        velocity: Option<&Mat<N>>,
    ) -> Self {
        Self {
            time_s,
            // nalgebra stores columns; the rows of g are the columns of its transpose.
            attitude: attitude.map_or_else(Vec::new, |g| g.transpose().as_slice().to_vec()),
            body_momentum: so::vee(momentum),
            quaternion: attitude.and_then(quaternion).map_or_else(Vec::new, |q| q.to_vec()),
            angular_velocity: velocity.map_or_else(Vec::new, so::vee),
        }
    }

    /// Returns attitude and momentum; `None` if one is missing or of another size.
    pub fn point<const N: usize>(&self) -> Option<state::State<N>> {
        (self.attitude.len() == N * N && self.body_momentum.len() == so::dimension(N)).then(|| {
            state::State {
                attitude: Mat::from_row_slice(&self.attitude),
                momentum: so::hat(&self.body_momentum),
            }
        })
    }
}

impl Message {
    /// Returns the message of a sample of several bodies on a channel; of one of each body, that of the body of this number.
    /// `None` if there is none. `turn` is the quaternion of the body with the sign to be shown.
    pub fn of_bodies<const N: usize>(
        channel: Channel,
        body: usize,
        sample: &bodies::Sample<N>,
        turn: Option<[f64; 4]>,
    ) -> Option<Self> {
        match channel {
            Channel::BodyState => {
                let state = BodyState::of(sample.time_s, sample.bodies.get(body)?, turn);
                Some(Self::BodyState(state))
            }
            Channel::Energy => {
                let (energy, error) = sample.energy.zip(sample.energy_error)?;
                Some(Self::Energy(Energy::with_error(energy, error)))
            }
            Channel::Orthogonality => {
                sample.orthogonality_error.map(Orthogonality::with_error).map(Self::Orthogonality)
            }
            Channel::Momentum => {
                let angular = sample.angular_momentum.as_ref();
                let linear = sample.linear_momentum.as_ref();
                (angular.is_some() || linear.is_some()).then(|| {
                    Self::Momentum(Momentum {
                        spatial_momentum: angular.map_or_else(Vec::new, so::vee),
                        drift: sample.momentum_drift,
                        log10_drift: sample.momentum_drift.map(log10_size),
                        linear: linear.map_or_else(Vec::new, |p| p.as_slice().to_vec()),
                        ..Momentum::default()
                    })
                })
            }
            Channel::Solver => Some(Self::Solver(sample.convergence?.into())),
            Channel::Pace => Some(Self::Pace(sample.pace?.into())),
            _ => None,
        }
    }
}

impl BodyState {
    /// Returns the state of a body at a time. `turn` is its quaternion with the sign to be shown.
    pub fn of<const N: usize>(
        time_s: f64,
        body: &bodies::BodySample<N>,
        turn: Option<[f64; 4]>,
    ) -> Self {
        Self {
            time_s,
            attitude: body.attitude.transpose().as_slice().to_vec(),
            body_momentum: so::vee(&body.momentum),
            quaternion: turn.map_or_else(Vec::new, |turn| turn.to_vec()),
            angular_velocity: so::vee(&body.angular_velocity),
            position: body.position.as_slice().to_vec(),
            velocity: body.velocity.as_slice().to_vec(),
            linear_momentum: body.linear_momentum.as_slice().to_vec(),
        }
    }

    /// Returns what was seen of the body; `None` if a list is of another size.
    pub(crate) fn body<const N: usize>(&self) -> Option<bodies::BodySample<N>> {
        let d = so::dimension(N);
        let is_whole = self.attitude.len() == N * N
            && self.body_momentum.len() == d
            && self.angular_velocity.len() == d
            && [&self.position, &self.velocity, &self.linear_momentum].map(Vec::len) == [N; 3];
        is_whole.then(|| bodies::BodySample {
            attitude: Mat::from_row_slice(&self.attitude),
            momentum: so::hat(&self.body_momentum),
            angular_velocity: so::hat(&self.angular_velocity),
            position: Vector::from_row_slice(&self.position),
            velocity: Vector::from_row_slice(&self.velocity),
            linear_momentum: Vector::from_row_slice(&self.linear_momentum),
        })
    }

    /// Returns its fields in a table.
    pub(crate) fn fields(&self) -> Vec<Field> {
        self.lists().map(|(name, list)| Field::numbers(name, list)).into()
    }

    /// Returns its lists of numbers by name.
    pub(super) fn lists(&self) -> [(&'static str, &[f64]); 7] {
        [
            ("attitude", &self.attitude),
            ("quaternion", &self.quaternion),
            ("body_momentum", &self.body_momentum),
            ("angular_velocity", &self.angular_velocity),
            ("position", &self.position),
            ("velocity", &self.velocity),
            ("linear_momentum", &self.linear_momentum),
        ]
    }

    /// Returns the fields of a body in a table, which begin with its name.
    fn named((body, state): &(BodyName, Self)) -> impl Iterator<Item = Field> {
        let before = format!("{}_", body.as_str());
        state.fields().into_iter().map(move |field| field.after(&before))
    }
}

impl Energy {
    fn with_error(energy: system::Energy, error: f64) -> Self {
        Self {
            kinetic: energy.kinetic,
            potential: energy.potential,
            total: energy.total(),
            error,
            log10_abs_error: log10_size(error),
            jacobi_error: None,
            work: None,
        }
    }

    /// Returns the energy of a sample, if it has any.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        let (energy, error) = sample.energy.zip(sample.energy_error)?;
        Some(Self {
            jacobi_error: sample.jacobi_error,
            work: sample.work,
            ..Self::with_error(energy, error)
        })
    }
}

impl Orthogonality {
    fn with_error(error: f64) -> Self {
        Self { error, log10_error: log10_size(error) }
    }

    /// Returns the distance of a sample's attitude from the group, if computed.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        sample.orthogonality_error.map(Self::with_error)
    }
}

impl Momentum {
    /// Returns the spatial momentum of a sample, if computed.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        if sample.spatial_momentum.is_none() && sample.momentum_drift.is_none() {
            return None;
        }
        Some(Self {
            spatial_momentum: sample.spatial_momentum.as_ref().map_or_else(Vec::new, so::vee),
            drift: sample.momentum_drift,
            log10_drift: sample.momentum_drift.map(log10_size),
            impulse: sample.impulse.as_ref().map_or_else(Vec::new, so::vee),
            table_impulse_error: sample.table_impulse_error,
            linear: Vec::new(),
        })
    }
}

impl Solver {
    /// Returns how a sample's step was solved; `None` at the start.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        Some(Self { sigma_min: sample.sigma_min, ..sample.convergence?.into() })
    }

    /// Returns the convergence from which it was made; `None` if this build does not know its rung.
    pub fn convergence(&self) -> Option<Convergence> {
        let &Self { iterations, increment, .. } = self;
        let rung = Rung::ALL.into_iter().find(|rung| rung.as_str() == self.rung)?;
        Some(Convergence { iterations, increment, rung })
    }
}

impl From<Convergence> for Solver {
    fn from(Convergence { iterations, increment, rung }: Convergence) -> Self {
        Self { iterations, increment, rung: rung.as_str().to_owned(), sigma_min: None }
    }
}

impl Pace {
    /// Returns the rate of time up to a sample, for adaptive steps.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        sample.pace.map(Into::into)
    }
}

impl From<state::Pace> for Pace {
    fn from(pace: state::Pace) -> Self {
        let state::Pace { sigma, step_s, steps, least_sigma, time_error_s } = pace;
        Self { sigma, step_s, own_steps: steps, least_sigma, time_error_s }
    }
}

impl Control {
    /// Returns the sample of the control at the time of a sample, if there is one.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        let seen = sample.control.as_ref()?;
        Some(Self {
            time_s: seen.time_s,
            wanted: seen.wanted.clone(),
            command: seen.command.clone(),
            saturated: seen.is_saturated,
            pointing_error_rad: seen.pointing_error_rad,
            attitude_error: seen.attitude_error.clone(),
            rate_error: seen.rate_error.clone(),
            wheel_momenta: seen.wheel_momenta.clone(),
            wheel_speeds: seen.wheel_speeds.clone(),
            field: seen.field.clone(),
            disturbance: seen.disturbance.clone(),
        })
    }
}

impl Pointing {
    /// Returns where the body points at a sample, if that was asked for.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        let Pointed { axis_error_rad, roll_pitch_yaw_rad, rate_rad_s, frame } = sample.pointing?;
        let [roll_rad, pitch_rad, yaw_rad] = roll_pitch_yaw_rad;
        let (rate, frame) = (rate_rad_s.to_vec(), frame.to_vec());
        Some(Self { axis_error_rad, roll_rad, pitch_rad, yaw_rad, rate, frame })
    }
}

impl Derivatives {
    /// Returns whether they can be those of a state on SO(n).
    fn is_of(&self, n: usize) -> bool {
        let rows = 2 * so::dimension(n);
        let Self { transition, sensitivity, covariance } = self;
        let is_square = |rows_of: &[f64]| rows_of.is_empty() || rows_of.len() == rows * rows;
        is_square(transition) && is_square(covariance) && sensitivity.len().is_multiple_of(rows)
    }

    /// Returns the derivatives of a sample, if it has any.
    pub fn of<const N: usize>(sample: &Sample<N>) -> Option<Self> {
        sample.derivatives.as_ref().map(Into::into)
    }
}

impl From<&state::Derivatives> for Derivatives {
    fn from(derivatives: &state::Derivatives) -> Self {
        let state::Derivatives { transition, sensitivity, covariance } = derivatives.clone();
        Self { transition, sensitivity, covariance }
    }
}

impl From<&Derivatives> for state::Derivatives {
    fn from(derivatives: &Derivatives) -> Self {
        let Derivatives { transition, sensitivity, covariance } = derivatives.clone();
        Self { transition, sensitivity, covariance }
    }
}

impl From<&control::ControlState> for ControlState {
    fn from(state: &control::ControlState) -> Self {
        let control::ControlState { samples, acting, since_s, waiting, momenta, integral, field } =
            state.clone();
        Self { samples, acting, since_s, waiting, momenta, integral, field }
    }
}

impl From<&ControlState> for control::ControlState {
    fn from(state: &ControlState) -> Self {
        let ControlState { samples, acting, since_s, waiting, momenta, integral, field } =
            state.clone();
        Self { samples, acting, since_s, waiting, momenta, integral, field }
    }
}

impl Checkpoint {
    /// Returns the place of a trajectory, and the figures of its samples so far.
    pub fn of<const N: usize>(checkpoint: &state::Checkpoint<N>, figures: Figures) -> Self {
        // nalgebra stores columns; the rows of a matrix are the columns of its transpose.
        let rows = |matrix: &Mat<N>| matrix.transpose().as_slice().to_vec();
        let none = checkpoint.impulse.iter().all(|x| *x == 0.0);
        Self {
            step: checkpoint.step,
            samples: checkpoint.samples,
            attitude: checkpoint.attitude.as_ref().map_or_else(Vec::new, rows),
            body_momentum: rows(&checkpoint.momentum),
            iterations: checkpoint.iterations,
            solver: checkpoint.convergence.map(Into::into),
            figures: Some(figures),
            work: checkpoint.work,
            impulse: if none { Vec::new() } else { rows(&checkpoint.impulse) },
            table_impulse: checkpoint.table_impulse,
            own_time: checkpoint.own_time.as_ref().map(|own| OwnTime {
                attitude: rows(&own.attitude),
                body_momentum: rows(&own.momentum),
                time_s: own.time_s,
                carry_s: own.carry_s,
                steps: own.steps,
                numbers: Vec::new(),
            }),
            control: checkpoint.control.as_ref().map(Into::into),
            held: checkpoint.holds_since_s.iter().map(|&since_s| Held { since_s }).collect(),
            numbers: Vec::new(),
            derivatives: checkpoint.derivatives.as_ref().map(Into::into),
        }
    }

    /// Returns the place of a trajectory of several bodies, and the figures of its samples so far.
    pub fn of_bodies(checkpoint: &bodies::Checkpoint, figures: Figures) -> Self {
        let bodies::Checkpoint {
            step,
            samples,
            iterations,
            convergence,
            numbers,
            holds_since_s,
            own_time,
        } = checkpoint;
        Self {
            step: *step,
            samples: *samples,
            iterations: *iterations,
            solver: convergence.map(Into::into),
            figures: Some(figures),
            numbers: numbers.clone(),
            held: holds_since_s.iter().map(|&since_s| Held { since_s }).collect(),
            own_time: own_time.as_ref().map(|own| OwnTime {
                time_s: own.time_s,
                carry_s: own.carry_s,
                steps: own.steps,
                numbers: own.numbers.clone(),
                ..OwnTime::default()
            }),
            ..Self::default()
        }
    }

    /// Returns whether a trajectory of several bodies can go on from it, as far as a log knows.
    pub(super) fn is_of_bodies(&self) -> bool {
        !self.numbers.is_empty()
            && self.solver.as_ref().is_none_or(|solver| solver.convergence().is_some())
    }

    /// Returns the place of the trajectory of several bodies; `None` if it is of one body.
    pub fn bodies(&self) -> Option<bodies::Checkpoint> {
        self.is_of_bodies().then(|| bodies::Checkpoint {
            step: self.step,
            samples: self.samples,
            iterations: self.iterations,
            convergence: self.solver.as_ref().and_then(Solver::convergence),
            numbers: self.numbers.clone(),
            holds_since_s: self.held.iter().map(|held| held.since_s).collect(),
            own_time: self.own_time.as_ref().map(|own| bodies::OwnTime {
                numbers: own.numbers.clone(),
                time_s: own.time_s,
                carry_s: own.carry_s,
                steps: own.steps,
            }),
        })
    }

    /// Returns whether a trajectory on SO(n) can go on from it.
    pub(super) fn is_of(&self, n: usize) -> bool {
        let matrix = |rows: &Vec<f64>| rows.len() == n * n;
        let absent = |rows: &Vec<f64>| rows.is_empty() || matrix(rows);
        absent(&self.attitude)
            && absent(&self.impulse)
            && matrix(&self.body_momentum)
            && self
                .own_time
                .as_ref()
                .is_none_or(|own| matrix(&own.attitude) && matrix(&own.body_momentum))
            && self.solver.as_ref().is_none_or(|solver| solver.convergence().is_some())
            && self.derivatives.as_ref().is_none_or(|found| found.is_of(n))
    }

    /// Returns the place of the trajectory; `None` if it is of another dimension.
    pub fn trajectory<const N: usize>(&self) -> Option<state::Checkpoint<N>> {
        let present = |rows: &[f64]| (!rows.is_empty()).then(|| Mat::from_row_slice(rows));
        self.is_of(N).then(|| state::Checkpoint {
            step: self.step,
            samples: self.samples,
            attitude: present(&self.attitude),
            momentum: Mat::from_row_slice(&self.body_momentum),
            iterations: self.iterations,
            convergence: self.solver.as_ref().and_then(Solver::convergence),
            work: self.work,
            impulse: present(&self.impulse).unwrap_or_else(Mat::zeros),
            table_impulse: self.table_impulse,
            own_time: self.own_time.as_ref().map(|own| state::OwnTime {
                attitude: Mat::from_row_slice(&own.attitude),
                momentum: Mat::from_row_slice(&own.body_momentum),
                time_s: own.time_s,
                carry_s: own.carry_s,
                steps: own.steps,
            }),
            control: self.control.as_ref().map(Into::into),
            holds_since_s: self.held.iter().map(|held| held.since_s).collect(),
            derivatives: self.derivatives.as_ref().map(Into::into),
        })
    }
}

impl Figures {
    /// Takes a sample into account.
    pub fn keep<const N: usize>(&mut self, sample: &Sample<N>) {
        self.keep_figures(Kept {
            energy: sample.energy.zip(sample.energy_error),
            orthogonality_error: sample.orthogonality_error,
            momentum_drift: sample.momentum_drift,
            table_impulse_error: sample.table_impulse_error,
            control: sample
                .control
                .as_ref()
                .map(|seen| (seen.is_saturated, seen.pointing_error_rad)),
        });
    }

    /// Takes a sample of several bodies into account.
    pub fn keep_bodies<const N: usize>(&mut self, sample: &bodies::Sample<N>) {
        self.keep_figures(Kept {
            energy: sample.energy.zip(sample.energy_error),
            orthogonality_error: sample.orthogonality_error,
            momentum_drift: sample.momentum_drift,
            table_impulse_error: None,
            control: None,
        });
    }

    fn keep_figures(&mut self, sample: Kept) {
        if let Some((energy, error)) = sample.energy {
            let total = energy.total();
            self.energy_initial.get_or_insert(total);
            self.energy_least = Some(self.energy_least.map_or(total, |least| least.min(total)));
            self.energy_largest = Some(self.energy_largest.map_or(total, |most| most.max(total)));
            self.energy_last = Some(total);
            let before = self.energy_max_abs_error.unwrap_or_default();
            self.energy_max_abs_error = Some(error.abs().max(before));
            self.energy_final_error = Some(error);
            self.kinetic_max = Some(energy.kinetic.max(self.kinetic_max.unwrap_or_default()));
        }
        if let Some(error) = sample.orthogonality_error {
            let before = self.orthogonality_max.unwrap_or_default();
            self.orthogonality_max = Some(error.max(before));
            self.orthogonality_sum = Some(self.orthogonality_sum.unwrap_or_default() + error);
        }
        if let Some(drift) = sample.momentum_drift {
            let before = self.momentum_max_drift.unwrap_or_default();
            self.momentum_max_drift = Some(drift.max(before));
        }
        if let Some(error) = sample.table_impulse_error {
            let before = self.table_impulse_max_error.unwrap_or_default();
            self.table_impulse_max_error = Some(error.abs().max(before));
        }
        if let Some((is_saturated, pointing_error_rad)) = sample.control {
            *self.control_samples.get_or_insert_default() += 1;
            *self.control_saturated.get_or_insert_default() += u64::from(is_saturated);
            self.pointing_error_last = pointing_error_rad;
        }
    }
}

/// Figures of a sample that its log keeps.
struct Kept {
    /// Energy and its error.
    energy: Option<(system::Energy, f64)>,
    orthogonality_error: Option<f64>,
    momentum_drift: Option<f64>,
    table_impulse_error: Option<f64>,
    /// Whether a command is saturated, and the angle to the target, at a sample of the control.
    control: Option<(bool, Option<f64>)>,
}

/// Returns the body's frame as seen from space, for viewers, and behind it those of what moves
/// around it.
pub fn frames(
    turn: [f64; 4],
    time_ns: u64,
    body_frame: &str,
    sources: Vec<FrameTransform>,
) -> FrameTransforms {
    let body = frame(turn, [0.0; 3], time_ns, body_frame);
    FrameTransforms { transforms: std::iter::once(body).chain(sources).collect() }
}

/// Returns the frame relative to which the body points, as seen from space, if there is one.
pub(crate) fn reference_frame(frame: Option<[f64; 4]>, time_ns: u64) -> Option<FrameTransform> {
    let name = super::scene::REFERENCE_FRAME;
    frame.map(|turn| self::frame(turn, [0.0; 3], time_ns, name))
}

/// Returns the frame of a body at a place, as seen from space.
pub(super) fn frame(
    [qw, qx, qy, qz]: [f64; 4],
    [x, y, z]: [f64; 3],
    time_ns: u64,
    body_frame: &str,
) -> FrameTransform {
    FrameTransform {
        timestamp: timestamp(time_ns),
        parent_frame_id: super::scene::SPACE_FRAME.to_owned(),
        child_frame_id: body_frame.to_owned(),
        translation: Some(Vector3 { x, y, z }),
        rotation: Some(Quaternion { x: qx, y: qy, z: qz, w: qw }),
    }
}

/// Returns the quaternion of a sample with the sign that is nearer to the quaternion of the sample
/// before, so that its components have no jumps; the first as it is found.
pub fn nearer_sign(before: Option<[f64; 4]>, found: [f64; 4]) -> [f64; 4] {
    let along = |before: [f64; 4]| before.iter().zip(found).map(|(a, b)| a * b).sum::<f64>();
    let turned = before.is_some_and(|before| along(before) < 0.0);
    if turned { found.map(|x| -x) } else { found }
}
