//! The reference solution of any scene, computed by the program.
//!
//! VPD with Gauss 8 stages (order 16), its step halved until two solutions agree; then VRKMK with Gauss 6
//! stages, which has other variables, another discretisation and another round-off, must meet it.
//!
//! Where errors grow with time no step brings two solutions closer than round-off has grown: that distance is
//! then the error of the reference, and nothing below it can be told.
//!
//! Invariant: a [`Reference`] is met by two families of methods to within its stated error.

use thiserror::Error;

use super::measure::{Measured, Point, Probe, measure};
use super::{Scales, StudyError, Watch, with_tableau};
use crate::scenario::{Method, MethodName, Scenario, TableauName};

/// Why a scene has no reference at a time.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ReferenceError {
    /// No step was small enough.
    #[error("no step gives a solution at t = {time_s} s: the scene cannot be studied")]
    NoStep {
        /// The time.
        time_s: f64,
    },
    /// The reference would take too many steps.
    #[error("t = {time_s} s is too far for a reference on this scene: at most {most_s:.3} s")]
    TooFar {
        /// The time.
        time_s: f64,
        /// The longest time allowed.
        most_s: f64,
    },
    /// Round-off grows too much.
    #[error(
        "errors grow so fast on this scene that two solutions of order 16 differ by {difference:.1e} at t = {time_s} s: ask for a shorter time"
    )]
    Chaotic {
        /// The time.
        time_s: f64,
        /// By how much they differ.
        difference: f64,
    },
    /// The two families do not meet.
    #[error(
        "the reference is in doubt: vpd and vrkmk differ by {difference:.1e} at t = {time_s} s, {allowed:.1e} is allowed"
    )]
    Disagree {
        /// The time.
        time_s: f64,
        /// By how much they differ.
        difference: f64,
        /// By how much they may.
        allowed: f64,
    },
}

/// The state of a scene at a time, and how well it is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// The time in seconds.
    pub time_s: f64,
    /// The state at each eighth of the time, the start first.
    pub points: Vec<Point>,
    /// Largest size of the body momentum on the way, in which errors of the momentum are measured.
    pub momentum_scale: f64,
    /// How far the last two solutions of the first family are apart, or a hundredth of how far the second is if that is
    /// more; no error below it can be told.
    pub error: f64,
    /// How far the second family is from the first.
    pub cross_check: f64,
    /// Steps of the solution that was taken.
    pub steps: u64,
}

/// Solutions are compared at so many times; their steps come in multiples of it.
pub(crate) const EIGHTHS: u64 = 8;
/// Steps of the first solution at most.
const MOST_STEPS: f64 = 20_000.0;
/// Two solutions that agree to this are taken.
const AGREED: f64 = 1e-13;
/// A reference worse than this is none.
const USELESS: f64 = 1e-6;
/// The second family may differ by so many errors of the first, its own round-off having grown as well. If it differs by
/// more, two solutions of the first have met by luck: its error is taken for as much larger.
const OTHER_ROUND_OFF: f64 = 100.0;

impl Reference {
    /// The reference of a scene at `time_s`.
    ///
    /// # Errors
    /// If there is none, or it is in doubt.
    pub fn at(
        scene: &Scenario,
        time_s: f64,
        scales: &Scales,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        let most_s = MOST_STEPS * scales.easy_step_s;
        if time_s > most_s {
            return Err(ReferenceError::TooFar { time_s, most_s }.into());
        }
        let first = with_tableau(MethodName::Vpd, TableauName::Gauss8);
        let start = EIGHTHS * (time_s / scales.easy_step_s / EIGHTHS as f64).ceil().max(1.0) as u64;
        let mut before: Option<Vec<Point>> = None;
        let mut best: Option<Self> = None;
        let mut steps = start;
        for _ in 0..8 {
            let run = solution(scene, &first, time_s, steps, watch)?;
            if let (Some(before), Some(run)) = (&before, &run) {
                let mut reference = Self::from_run(time_s, run);
                reference.error = reference.worst(before);
                let better = best.as_ref().is_none_or(|best| reference.error < best.error);
                let fell = best.as_ref().is_none_or(|best| reference.error < 0.25 * best.error);
                if better {
                    best = Some(reference);
                }
                let error = best.as_ref().map_or(f64::INFINITY, |best| best.error);
                // Order 16 gains 65536 a halving; what gains less than 4 is round-off.
                if error <= AGREED || !fell {
                    break;
                }
            }
            before = run.map(|run| run.points);
            steps *= 2;
        }
        let mut reference = best.ok_or(ReferenceError::NoStep { time_s })?;
        if reference.error > USELESS {
            return Err(ReferenceError::Chaotic { time_s, difference: reference.error }.into());
        }
        reference.check(scene, watch)?;
        Ok(reference)
    }

    fn from_run(time_s: f64, run: &Measured) -> Self {
        Self {
            time_s,
            points: run.points.clone(),
            momentum_scale: run.largest_momentum,
            error: 0.0,
            cross_check: 0.0,
            steps: run.steps,
        }
    }

    /// Lets the second family meet the first: within a hundred errors, or else as nearly as its own solutions meet.
    fn check(&mut self, scene: &Scenario, watch: &Watch) -> Result<(), StudyError> {
        let second = with_tableau(MethodName::Vrkmk, TableauName::Gauss6);
        let near = (OTHER_ROUND_OFF * self.error).max(10.0 * AGREED);
        // How near its solutions come to the first, and the last two to each other.
        let (mut difference, mut own) = (f64::INFINITY, 0.0_f64);
        let mut before: Option<Self> = None;
        for halvings in 0..4 {
            let run = solution(scene, &second, self.time_s, self.steps << halvings, watch)?;
            if let Some(run) = &run {
                difference = difference.min(self.worst(&run.points));
                own = before.map_or(0.0, |before| before.worst(&run.points));
            }
            if difference <= near {
                break;
            }
            before = run.map(|run| Self::from_run(self.time_s, &run));
        }
        let allowed = near.max(own.min(USELESS));
        if difference <= allowed {
            self.error = self.error.max(difference / OTHER_ROUND_OFF);
            self.cross_check = difference;
            return Ok(());
        }
        Err(ReferenceError::Disagree { time_s: self.time_s, difference, allowed }.into())
    }

    /// The error of a state: that of the attitude (for n = 3 the spectral norm) plus that of the body
    /// momentum in parts of its largest size.
    pub fn distance(&self, point: &Point) -> f64 {
        self.distance_at(self.points.len() - 1, point)
    }

    /// The error of a state at an eighth of the time.
    pub(crate) fn distance_at(&self, eighth: usize, point: &Point) -> f64 {
        let scale = if self.momentum_scale > 0.0 { self.momentum_scale } else { 1.0 };
        let own = &self.points[eighth];
        own.attitude_distance(point) + own.momentum_distance(point) / scale
    }

    /// The state at the end.
    pub fn end(&self) -> &Point {
        &self.points[self.points.len() - 1]
    }

    /// The largest error at any eighth.
    fn worst(&self, points: &[Point]) -> f64 {
        let errors =
            points.iter().enumerate().map(|(eighth, point)| self.distance_at(eighth, point));
        errors.fold(0.0, f64::max)
    }
}

/// The end of a run in so many steps; `None` if it fails.
fn solution(
    scene: &Scenario,
    method: &Method,
    time_s: f64,
    steps: u64,
    watch: &Watch,
) -> Result<Option<Measured>, StudyError> {
    let every = steps / EIGHTHS;
    let probe = Probe { every, keep: true, ..Probe::of(method, time_s / steps as f64, steps) };
    watch.expect(1);
    let run = measure(scene, probe, watch)?;
    watch.advance(1)?;
    Ok(run.completed().then_some(run))
}
