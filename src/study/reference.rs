//! The reference solution of any scene, computed by the program.
//!
//! For n = 3 VPD with Gauss 8 stages (order 16), its step halved until two solutions agree; then
//! Gauss with 6 stages in quaternions, which has other variables, another discretisation and
//! another round-off, must agree with it. Where something drives the body, that is Dormand and
//! Prince's eighth order, projected, whose round-off is a hundred times that of VPD: what it hides,
//! a variational method on the group shows. The same checks several bodies. For other n Dormand and Prince's steps, which cost a
//! twentieth there, are the first, and VPD must agree with them.
//!
//! Where errors grow with time no step brings two solutions closer than round-off has grown: that distance is
//! then the error of the reference, and nothing below it can be measured. Its growth shows whether
//! the motion is chaotic. In that case two solutions may be near each other by luck; so others,
//! from starts moved a little in orthogonal directions, show how far the roundings of the start
//! grow.
//!
//! Invariant: two families of methods agree with a [`Reference`] to within its stated error.

use std::fmt;
use std::ops::AddAssign;

use nalgebra::DMatrix;
use thiserror::Error;

use super::measure::{Begin, Measured, Point, Probe, Sizes, measure};
use super::{Scales, StudyError, Watch, with_tableau};
use crate::method::Integrator;
use crate::scenario::{Method, Scenario, TableauName};

/// Reason why a scene has no reference at a time.
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
        "{growth}; two solutions computed to round-off differ by {difference:.1e} at t = {time_s:.4} s, double precision reaches {asked:.1e} until t = {until_s:.3} s; ask for that time or a shorter one"
    )]
    Chaotic {
        /// The time.
        time_s: f64,
        /// Difference of the solutions.
        difference: f64,
        /// The error they had to show.
        asked: f64,
        /// Time until which they know it.
        until_s: f64,
        /// Growth of the difference.
        growth: Growth,
    },
    /// The two families do not agree.
    #[error(
        "the reference is in doubt: two families of methods differ by {difference:.1e} at t = {time_s} s, at most {allowed:.1e} is allowed"
    )]
    Disagree {
        /// The time.
        time_s: f64,
        /// Difference of the families.
        difference: f64,
        /// Difference allowed.
        allowed: f64,
    },
}

impl ReferenceError {
    /// The distance of two solutions that should agree; infinite where there are no two.
    fn difference(&self) -> f64 {
        match self {
            Self::Chaotic { difference, .. } | Self::Disagree { difference, .. } => *difference,
            Self::NoStep { .. } | Self::TooFar { .. } => f64::INFINITY,
        }
    }
}

/// Growth of the distance of two solutions that differ by round-off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Growth {
    /// Tenfold every this many seconds.
    Exponential {
        /// Seconds.
        tenfold_s: f64,
    },
    /// As this power of time, or too little to be distinguished from one.
    Power {
        /// The exponent.
        exponent: f64,
    },
}

impl fmt::Display for Growth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exponential { tenfold_s } => {
                write!(f, "this motion is chaotic: errors grow 10x every {tenfold_s:.2} s")
            }
            Self::Power { exponent } => write!(f, "errors grow as t^{exponent:.1}"),
        }
    }
}

/// The state of a scene at a time, and how accurately it is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// The time in seconds.
    pub time_s: f64,
    /// The state at each quarter of the time, for a long one at each sixty-fourth, the start first.
    pub points: Vec<Point>,
    /// The largest sizes on the way, in parts of which errors are measured.
    pub sizes: Sizes,
    /// Distance of the last two solutions of the first family, or a hundredth of that of the second
    /// if that is more, or all of it where the second scatters or nothing explains it; no error below it can be measured.
    pub error: f64,
    /// Distance of the second family from the first.
    pub cross_check: f64,
    /// Steps of the solution that was taken.
    pub steps: u64,
    /// Largest distance of the two until each of the points.
    pub apart: Vec<f64>,
    /// The method of the solution.
    method: Method,
}

/// Number of times at which solutions are compared; their steps come in multiples of it.
pub(crate) const QUARTERS: u64 = 4;
/// The same number for a reference of at least [`LONG_STEPS`].
const SIXTY_FOURTHS: u64 = 64;
const LONG_STEPS: u64 = 512;
/// Factor by which a rough family may miss the accuracy for the other to be tried.
const ROUGH: f64 = 1e3;
/// Distances of two solutions between these show how errors grow: above noise, below the size of the motion.
const GROWTH_SEEN: std::ops::Range<f64> = 1e-13..1e-2;
/// Least growth of distances that counts as exponential.
const LEAST_GROWTH: f64 = 1e3;
/// Largest power of time: faster growth is an exponential seen at few points.
const STEEPEST: f64 = 6.0;
/// Largest number of steps of the first solution.
pub(crate) const MOST_STEPS: f64 = 20_000.0;
/// Distance to which two solutions have to agree.
const AGREED: f64 = 1e-13;
/// A reference worse than this is of no use.
const USELESS: f64 = 1e-6;
/// Distance by which a start is moved, relative to the momentum: a thousand roundings, so that
/// those of the run do not matter.
const MOVED: f64 = 1e-13;
/// Part of the requested error within which two solutions do not agree by luck.
const NO_LUCK: f64 = 1e-4;
/// The rounding of a number, in which a start and the body are off in each direction.
const ROUNDED: f64 = 0.5 * f64::EPSILON;
/// The same for adaptive steps, where `H - H0` is what a few roundings leave of it.
const ROUNDED_ENERGY: f64 = 10.0 * ROUNDED;
/// Number of directions in which a start is moved.
const MOST_DIRECTIONS: usize = 3;
/// If the first of them shows less than this part of the requested error, the others show little.
const FAR_FROM_IT: f64 = 1e-2;
/// Growth by less may be that of a power of time: of as many radians as a reference may have.
const CARRIED_OFF: f64 = 1e6;
/// The second family may differ by this many errors of the first, its own round-off having grown as well. If it differs by
/// more, two solutions of the first have met by luck: its error is taken to be that much larger.
const OTHER_ROUND_OFF: f64 = 100.0;

impl Reference {
    /// Returns the reference of a scene at `time_s`.
    ///
    /// # Errors
    /// If there is none, or it is in doubt.
    pub fn at(
        scene: &Scenario,
        time_s: f64,
        scales: &Scales,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        Self::known_to(scene, time_s, USELESS, scales, watch)
    }

    /// Returns the reference of a scene where an error of `asked` is enough.
    ///
    /// # Errors
    /// The errors of [`Self::at`].
    pub(crate) fn known_to(
        scene: &Scenario,
        time_s: f64,
        asked: f64,
        scales: &Scales,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        Self::of(scene, 0, time_s, asked, scales, watch)
    }

    /// Returns the reference of a member of the scene's ensemble.
    ///
    /// # Errors
    /// The errors of [`Self::at`].
    pub(crate) fn of(
        scene: &Scenario,
        member: u64,
        time_s: f64,
        asked: f64,
        scales: &Scales,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        let most_s = MOST_STEPS * scales.easy_step_s;
        // The last digit of a quotient must not add a step.
        if time_s > most_s * (1.0 + 1e-12) {
            return Err(ReferenceError::TooFar { time_s, most_s }.into());
        }
        let easy = (time_s / scales.easy_step_s).ceil();
        let solve = |families: [Family; 2]| -> Result<Self, StudyError> {
            let mut reference =
                Self::solved(scene, member, &families[0], (time_s, easy), asked, watch)?;
            if reference.error <= asked {
                reference.check(scene, member, &families[1], asked, easy, watch)?;
            }
            reference.round_start(scene, member, asked, watch)?;
            Ok(reference)
        };
        let [first, second] = if scales.adapts { adaptive_families() } else { families(scene) };
        let is_rough = first.is_rough || second.is_rough;
        let mut solved = solve([first.clone(), second.clone()]);
        let known = match &solved {
            Ok(reference) => reference.error,
            Err(StudyError::Reference(error)) => error.difference(),
            Err(_) => f64::INFINITY,
        };
        // A family with less round-off may show what these do not.
        if is_rough && known > asked && known < ROUGH * asked {
            let others = match (scales.adapts, scene.dimension()) {
                (true, _) => in_short_steps(scene),
                (false, 3) => [first, of_little_round_off()],
                (false, _) => [second, first],
            };
            match solve(others) {
                Ok(other) if other.error < known => solved = Ok(other),
                Ok(_) | Err(StudyError::Reference(_)) => {}
                Err(error) => return Err(error),
            }
        }
        let reference = solved?;
        if reference.error > asked {
            return Err(reference.chaotic(asked).into());
        }
        Ok(reference)
    }

    /// Returns the solution of one family to round-off, or until it knows an error of `asked` no
    /// better.
    fn solved(
        scene: &Scenario,
        member: u64,
        family: &Family,
        (time_s, easy): (f64, f64),
        asked: f64,
        watch: &Watch,
    ) -> Result<Self, StudyError> {
        let first = family.method.clone();
        let least = family.easy_steps * easy;
        let points = if least >= LONG_STEPS as f64 { SIXTY_FOURTHS } else { QUARTERS };
        let mut steps = points * (least / points as f64).ceil().max(1.0) as u64;
        let mut before: Option<Vec<Point>> = None;
        let mut best: Option<Self> = None;
        for _ in 0..8 {
            let start = Start { member, begin: Begin::Scene };
            let run = solution(scene, start, &first, time_s, (steps, points), watch)?;
            if let (Some(before), Some(run)) = (&before, &run) {
                let reference = Self::of_runs(time_s, &first, run, before);
                let further = |than: &Self, by: f64| {
                    reference.error < than.error / by.powi(4)
                        || reference.until(asked) > by * than.until(asked)
                };
                let better = best.as_ref().is_none_or(|best| further(best, 1.0));
                // Order 16 gains 65536 a halving; a gain of less than 4 is round-off. Where
                // round-off has grown past the requested error, the time counts until which it has
                // not.
                let fell = best.as_ref().is_none_or(|best| further(best, std::f64::consts::SQRT_2));
                if better {
                    best = Some(reference);
                }
                let error = best.as_ref().map_or(f64::INFINITY, |best| best.error);
                if error <= AGREED || !fell {
                    break;
                }
            }
            before = run.map(|run| run.points);
            steps *= 2;
        }
        Ok(best.ok_or(ReferenceError::NoStep { time_s })?)
    }

    /// Returns the error of a reference that does not know an error of `asked`.
    pub(crate) fn chaotic(&self, asked: f64) -> ReferenceError {
        ReferenceError::Chaotic {
            time_s: self.time_s,
            difference: self.error,
            asked,
            until_s: self.until(asked),
            growth: self.growth(),
        }
    }

    /// Returns the same solution from the start of a member of the scene's ensemble, compared with
    /// one of halved steps; `None` if one of them fails.
    pub(crate) fn of_member(
        &self,
        scene: &Scenario,
        member: u64,
        asked: f64,
        watch: &Watch,
    ) -> Result<Option<Self>, StudyError> {
        let solved = |steps: u64| {
            let start = Start { member, begin: Begin::Scene };
            solution(scene, start, &self.method, self.time_s, (steps, QUARTERS), watch)
        };
        let (Some(half), Some(whole)) = (solved(self.steps / 2)?, solved(self.steps)?) else {
            return Ok(None);
        };
        let mut reference = Self::of_runs(self.time_s, &self.method, &whole, &half.points);
        reference.round_start(scene, member, asked, watch)?;
        Ok(Some(reference))
    }

    /// Where errors grow exponentially, takes the grown roundings of the start as the error, if
    /// they are larger.
    ///
    /// ```text
    /// error(t) = rounding (sum_i |dz_i(t)|^2 / |dz_i(0)|^2)^(1/2),      dz_i from starts moved in orthogonal directions
    /// ```
    pub(crate) fn round_start(
        &mut self,
        scene: &Scenario,
        member: u64,
        asked: f64,
        watch: &Watch,
    ) -> Result<(), StudyError> {
        if self.error <= NO_LUCK * asked {
            return Ok(());
        }
        let directions = self.directions();
        if directions.is_empty() {
            return Ok(());
        }
        let adapts = self.method.name.integrator() == Some(Integrator::VpdAdaptive);
        let rounding = if adapts { ROUNDED_ENERGY } else { ROUNDED };
        let mut squares = vec![0.0; self.points.len()];
        let steps = (self.steps, (self.points.len() - 1) as u64);
        for along in &directions {
            for moved in self.moved_starts(along) {
                let from = Start { member, begin: Begin::Near(&moved) };
                let Some(run) = solution(scene, from, &self.method, self.time_s, steps, watch)?
                else {
                    continue;
                };
                let began = self.apart_from(&self.points[0], &moved);
                for (sum, (own, point)) in
                    squares.iter_mut().zip(self.points.iter().zip(&run.points))
                {
                    let grown = self.apart_from(own, point) / began;
                    *sum += grown * grown;
                }
            }
            let most = squares.iter().copied().fold(0.0, f64::max).sqrt();
            if rounding * most <= FAR_FROM_IT * asked {
                break;
            }
        }
        // In more dimensions these are a part.
        let start = &self.points[0];
        let (n, bodies) = (start.dimension(), start.attitude.nrows() / start.dimension());
        let each = n * (n - 1) / 2;
        let whole = bodies * each + start.position.len();
        let all = if directions.len() == MOST_DIRECTIONS { whole } else { 1 };
        let parts = (all as f64 / directions.len() as f64).max(1.0);
        let mut most = 0.0_f64;
        let grown: Vec<f64> = squares
            .iter()
            .map(|square| {
                most = most.max((parts * square).sqrt());
                most
            })
            .collect();
        if most > CARRIED_OFF {
            for (apart, grown) in self.apart.iter_mut().zip(grown) {
                *apart = apart.max(rounding * grown);
            }
            self.error = self.error.max(rounding * most);
        }
        Ok(())
    }

    /// Returns orthogonal directions of a momentum, three at most: those of the momenta met, so
    /// that a motion which stays in a plane has one.
    fn directions(&self) -> Vec<DMatrix<f64>> {
        /// A direction that is less than this part of a momentum is one of the earlier ones.
        const NEW: f64 = 0.1;
        let mut found: Vec<DMatrix<f64>> = Vec::new();
        for Point { momentum, .. } in &self.points[1..] {
            let mut rest = momentum.clone();
            for direction in &found {
                rest -= direction * direction.dot(momentum);
            }
            let (size, whole) = (rest.norm(), momentum.norm());
            if size > NEW * whole && found.len() < MOST_DIRECTIONS {
                found.push(rest / size);
            }
        }
        found
    }

    /// Returns the start with its momenta moved along a direction, and with its attitudes turned
    /// about it.
    fn moved_starts(&self, along: &DMatrix<f64>) -> [Point; 2] {
        let start = &self.points[0];
        let n = start.dimension();
        let [mut pushed, mut turned] = [start.clone(), start.clone()];
        pushed.momentum += along * (MOVED * self.sizes.momentum);
        for first in (0..start.attitude.nrows()).step_by(n) {
            let turn = start.attitude.rows(first, n) * along.rows(first, n) * MOVED;
            turned.attitude.rows_mut(first, n).add_assign(&turn);
        }
        [pushed, turned]
    }

    /// Returns the reference of a run, as accurate as another run shows it to be.
    pub(crate) fn of_runs(time_s: f64, method: &Method, run: &Measured, other: &[Point]) -> Self {
        let mut reference = Self::from_run(time_s, method, run);
        reference.compare(other);
        reference
    }

    fn from_run(time_s: f64, method: &Method, run: &Measured) -> Self {
        Self {
            time_s,
            points: run.points.clone(),
            sizes: run.sizes,
            error: 0.0,
            cross_check: 0.0,
            steps: run.steps,
            apart: vec![0.0; run.points.len()],
            method: method.clone(),
        }
    }

    /// Takes the distance from another solution as the error.
    fn compare(&mut self, other: &[Point]) {
        let mut most = 0.0_f64;
        let apart = self.points.iter().zip(other).map(|(own, point)| {
            most = most.max(self.apart_from(own, point));
            most
        });
        self.apart = apart.collect();
        self.error = most;
    }

    /// Returns the time until which the two solutions differ by no more than `error`.
    pub(crate) fn until(&self, error: f64) -> f64 {
        let interval_s = self.time_s / (self.apart.len() - 1) as f64;
        let Some(past) = self.apart.iter().position(|&apart| apart > error) else {
            return self.time_s;
        };
        let Some(before) = past.checked_sub(1) else { return 0.0 };
        // Between two points their logarithms lie on a line.
        let (low, high) = (self.apart[before].max(AGREED), self.apart[past]);
        let part = (libm::log(error / low) / libm::log(high / low)).clamp(0.0, 1.0);
        (before as f64 + part) * interval_s
    }

    /// Returns how the two solutions came apart: `log d` is fitted as a line of t and as a line of
    /// log t, and the better is taken unless its power is none.
    pub(crate) fn growth(&self) -> Growth {
        let interval_s = self.time_s / (self.apart.len() - 1) as f64;
        let seen: Vec<(f64, f64)> = self
            .apart
            .iter()
            .enumerate()
            .skip(1)
            .filter(|(_, apart)| GROWTH_SEEN.contains(apart))
            .map(|(k, &apart)| (k as f64 * interval_s, libm::log10(apart)))
            .collect();
        let (first, last) = match (seen.first(), seen.last()) {
            (Some(first), Some(last)) if seen.len() > 2 => (first, last),
            // It grew between two points, or at once: from the round-off of the start to where it
            // is past all measure.
            _ if self.error > GROWTH_SEEN.end => {
                let decades = libm::log10(GROWTH_SEEN.end / f64::EPSILON);
                return Growth::Exponential { tenfold_s: self.until(GROWTH_SEEN.end) / decades };
            }
            _ => return Growth::Power { exponent: 1.0 },
        };
        let in_log: Vec<(f64, f64)> = seen.iter().map(|&(t, d)| (libm::log10(t), d)).collect();
        let ((rate, miss), (exponent, power_miss)) = (line(&seen), line(&in_log));
        let grown = libm::pow(10.0, last.1 - first.1);
        let bends = miss < power_miss || exponent > STEEPEST;
        if rate > 0.0 && bends && grown > LEAST_GROWTH {
            Growth::Exponential { tenfold_s: 1.0 / rate }
        } else {
            Growth::Power { exponent }
        }
    }

    /// Lets the second family approach the first: within a hundred errors, or else as nearly as its
    /// own solutions agree.
    fn check(
        &mut self,
        scene: &Scenario,
        member: u64,
        family: &Family,
        asked: f64,
        easy: f64,
        watch: &Watch,
    ) -> Result<(), StudyError> {
        let points = (self.points.len() - 1) as u64;
        let least = (family.easy_steps * easy / points as f64).ceil().max(1.0) as u64;
        let (second, steps) = (family.method.clone(), points * least);
        let near = (OTHER_ROUND_OFF * self.error).max(10.0 * AGREED);
        // Distance of its solutions from the first, and of the last two from each other.
        let (mut difference, mut own) = (f64::INFINITY, 0.0_f64);
        let mut before: Option<Self> = None;
        for halvings in 0..4 {
            let (start, steps) = (Start { member, begin: Begin::Scene }, steps << halvings);
            let run = solution(scene, start, &second, self.time_s, (steps, points), watch)?;
            if let Some(run) = &run {
                difference = difference.min(self.worst(&run.points));
                own = before.as_ref().map_or(0.0, |before| before.worst(&run.points));
            }
            if difference <= near {
                break;
            }
            before = run.map(|run| Self::from_run(self.time_s, &self.method, &run));
        }
        if difference <= near.max(asked) {
            // What its own solutions do not explain may be an error of the first family.
            let is_explained = difference <= near.max(own);
            let part = if is_explained { OTHER_ROUND_OFF } else { 1.0 };
            self.error = self.error.max(difference / part);
            self.cross_check = difference;
            return Ok(());
        }
        // If its solutions agree no better with each other than with the first, round-off has grown
        // here, too.
        if let Some(scattered) = before.filter(|_| own > 0.1 * difference) {
            self.compare(&scattered.points);
            self.cross_check = self.error;
            return if self.error <= asked { Ok(()) } else { Err(self.chaotic(asked).into()) };
        }
        let allowed = near.max(asked);
        Err(ReferenceError::Disagree { time_s: self.time_s, difference, allowed }.into())
    }

    /// Returns the error of a state: that of the attitude (for n = 3 the spectral norm) plus that
    /// of the body momentum in parts of its largest size. Of several bodies the largest of each, and likewise of their places
    /// in parts of the longest way, and of their linear momenta.
    pub fn distance(&self, point: &Point) -> f64 {
        self.apart_from(self.end(), point)
    }

    /// Returns the error of a state at a quarter of the time.
    pub(crate) fn distance_at(&self, quarter: usize, point: &Point) -> f64 {
        let parts = (self.points.len() - 1) / QUARTERS as usize;
        self.apart_from(&self.points[parts * quarter], point)
    }

    fn apart_from(&self, own: &Point, point: &Point) -> f64 {
        let part = |distance: f64, size: f64| distance / if size > 0.0 { size } else { 1.0 };
        let Sizes { momentum, way_m, linear_momentum } = self.sizes;
        own.attitude_distance(point)
            + part(own.momentum_distance(point), momentum)
            + part(own.position_distance(point), way_m)
            + part(own.linear_momentum_distance(point), linear_momentum)
    }

    /// Returns the state at the end.
    pub fn end(&self) -> &Point {
        &self.points[self.points.len() - 1]
    }

    /// Returns the largest error at any of the points.
    fn worst(&self, points: &[Point]) -> f64 {
        let errors = self.points.iter().zip(points).map(|(own, point)| self.apart_from(own, point));
        errors.fold(0.0, f64::max)
    }
}

/// A method whose solutions are compared with those of another.
#[derive(Clone)]
struct Family {
    method: Method,
    /// Its number of steps at first, for each easy one.
    easy_steps: f64,
    /// Whether it has much round-off of its own.
    is_rough: bool,
}

/// Returns the two families of a scene, the one to solve with first.
fn families(scene: &Scenario) -> [Family; 2] {
    let family = |method, easy_steps| Family { method, easy_steps, is_rough: false };
    let vpd = family(with_tableau(Integrator::Vpd, TableauName::Gauss8), 1.0);
    let explicit = family(with_tableau(Integrator::RkProjected, TableauName::Rk8), 3.0);
    if scene.bodies().is_some() {
        return [vpd, explicit];
    }
    let explicit = Family { is_rough: true, ..explicit };
    match (scene.dimension(), scene.scene.is_plain()) {
        (3, true) => {
            [vpd, family(with_tableau(Integrator::QuaternionGauss, TableauName::Gauss6), 2.0)]
        }
        (3, false) => [vpd, explicit],
        _ => [explicit, vpd],
    }
}

/// Returns, for a scene that passes a point source closely, two tableaux in adaptive steps, because
/// steps of one length may be of no use there. Near the source a rounding of the energy weighs more
/// in their time than in that of the body.
fn adaptive_families() -> [Family; 2] {
    let family = |tableau, easy_steps| Family {
        method: with_tableau(Integrator::VpdAdaptive, tableau),
        easy_steps,
        is_rough: true,
    };
    [family(TableauName::Gauss8, 1.0), family(TableauName::Gauss6, 1.5)]
}

/// Returns, for a body that is driven, a family that sums what it adds to the momentum with the part lost to rounding.
fn of_little_round_off() -> Family {
    let method = with_tableau(Integrator::Vrkmk, TableauName::Gauss6);
    Family { method, easy_steps: 2.0, is_rough: false }
}

/// Returns the families in steps of one length, as short as a passage needs them.
fn in_short_steps(scene: &Scenario) -> [Family; 2] {
    /// Factor by which these steps are shorter than far from a source.
    const SHORT: f64 = 4.0;
    families(scene).map(|family| Family { easy_steps: SHORT * family.easy_steps, ..family })
}

/// Returns the slope of the line of least squares, and the sum of the squares that it leaves.
fn line(points: &[(f64, f64)]) -> (f64, f64) {
    let count = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / count;
    let (x0, y0) = (mean(|p| p.0), mean(|p| p.1));
    let spread: f64 = points.iter().map(|p| (p.0 - x0) * (p.0 - x0)).sum();
    let slope = points.iter().map(|p| (p.0 - x0) * (p.1 - y0)).sum::<f64>() / spread;
    let missed = |p: &(f64, f64)| p.1 - y0 - slope * (p.0 - x0);
    (slope, points.iter().map(|p| missed(p) * missed(p)).sum())
}

/// Start of a solution.
#[derive(Clone, Copy)]
struct Start<'a> {
    /// The member of the scene's ensemble.
    member: u64,
    begin: Begin<'a>,
}

/// Returns the end of a run in `steps` steps, with the states at `points` points on its way; `None`
/// if it fails.
fn solution(
    scene: &Scenario,
    Start { member, begin }: Start<'_>,
    method: &Method,
    time_s: f64,
    (steps, points): (u64, u64),
    watch: &Watch,
) -> Result<Option<Measured>, StudyError> {
    let every = steps / points;
    let whole = Probe::of(method, time_s / steps as f64, steps);
    let probe = Probe { every, keep: true, member, begin, ..whole };
    watch.expect(1);
    let run = measure(scene, probe, watch)?;
    watch.advance(1)?;
    Ok(run.completed().then_some(run))
}
