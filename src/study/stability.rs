//! Maps where each method fails: a sweep of the step, and the border of what is usable.
//!
//! Invariant: a cell has exactly one class, the first that fits in the order of [`Class`] from the bottom up.

use schemars::JsonSchema;
use serde::Serialize;

use super::long_term::trend;
use super::measure::{Begin, End, Measured, Probe, measure};
use super::table::{Row, Table};
use super::{Entry, Scales, StudyError, Watch, of_each, of_those_before, usual_time, with_tableau};
use crate::method::Integrator;
use crate::scenario::{Scenario, TableauName};
use crate::solve::failure::FailureCode;

/// Outcome of a method at a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Bounded energy error, on the group, on the right branch.
    Stable,
    /// The energy error has a trend: it would grow with a longer run.
    EnergyDrifts,
    /// A step turned the attitude elsewhere, while energy and orthogonality look fine.
    WrongBranch,
    /// The attitude is no rotation any more.
    LeftGroup,
    /// The energy error is beyond a tenth of the energy that moves: the run means nothing.
    BlewUp,
    /// A step could not be made.
    Failed(FailureCode),
}

impl Class {
    /// Returns the class in tables.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Stable => "stable",
            Self::EnergyDrifts => "energy_drifts",
            Self::WrongBranch => "wrong_branch",
            Self::LeftGroup => "left_group",
            Self::BlewUp => "blew_up",
            Self::Failed(code) => code.as_str(),
        }
    }

    /// Returns whether a run of this class means something. One whose energy drifts does, for a
    /// while.
    pub fn is_usable(self) -> bool {
        matches!(self, Self::Stable | Self::EnergyDrifts)
    }
}

/// A method at a step.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Outcome of the method.
    pub class: Class,
    /// The figures.
    pub row: Row,
    /// Angle by which the strongest swing of the motion goes on in a step, rad: see `swing_rad`.
    pub swing_rad: Option<f64>,
}

/// Steps in which a scheme loses its hold on the energy, though smaller and larger ones keep it:
/// the swing of the motion and the steps meet again after a few of them, and the errors of the
/// steps add up.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Resonance {
    /// Number of steps in one swing.
    pub steps_per_swing: u32,
    /// The window, in seconds: the steps tried on either side of it that keep the energy.
    pub window_s: [f64; 2],
    /// The worst of the steps tried in it.
    pub worst_step_s: f64,
    /// The largest |H - H0| there, J.
    pub energy_error: f64,
    /// The energy error expected there, by the steps on either side.
    pub usual_energy_error: f64,
}

/// The largest step at which a method is usable, and every smaller one of the sweep too.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Border {
    /// The method with its tableau and solver.
    pub label: String,
    /// Largest usable step in seconds, to 5 %; absent if no step of the sweep is.
    pub usable_step_s: Option<f64>,
    /// Angle by which the body turns in it where it is fastest, rad.
    pub turn_rad: Option<f64>,
    /// Smallest step beyond it that was tried, in seconds; absent if the whole sweep is usable.
    pub broken_step_s: Option<f64>,
    /// Outcome at that step.
    pub broken: Option<&'static str>,
    /// Windows below the largest usable step in which the energy is lost.
    pub resonances: Vec<Resonance>,
}

/// The map of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// The steps of the sweep in seconds, rising.
    pub steps_s: Vec<f64>,
    /// A cell for each step, for each method in the order of the entries.
    pub cells: Vec<Vec<Cell>>,
    /// The border of each method.
    pub borders: Vec<Border>,
    /// The energy that moves, J: errors of the energy are seen in parts of it.
    pub energy_scale: f64,
    /// The fastest turn of the body, rad/s.
    pub fastest_rad_s: f64,
}

/// Number of steps of the sweep.
const SWEEP: usize = 24;
/// Angle by which the body turns in the smallest and the largest step of the sweep where it is fastest.
const TURNS_RAD: (f64, f64) = (0.03, 6.0);
/// Number of steps of each run: long enough for an instability to show, and a drift.
const RUN_STEPS: u64 = 4000;
/// A drift is one that goes on in a run this many times as long. A swing slower than a run comes
/// back.
const LONGER: u64 = 4;
/// Least number of steps of a run where tables end early.
const LEAST_STEPS: f64 = 16.0;
/// Least factor by which it goes on: [`LONGER`] if it is steady; on the dipole 1.9 to 5, and 1.2 at
/// most where it swings.
const GOES_ON: f64 = 1.5;
/// Number of steps of each run that are compared with their exact ends, in addition to the one that
/// begins fastest.
const CHECKED_STEPS: usize = 8;
/// Largest ratio of the step beyond the border to the largest usable one.
const BORDER_RATIO: f64 = 1.05;
/// An energy error beyond this part of the kinetic energy is no integration.
const MEANINGLESS: f64 = 0.1;
/// An attitude this far from orthogonal is no rotation.
const OFF_GROUP: f64 = 1e-6;
/// A step that ends further than this from its exact end has gone to another branch: 60 degrees.
const WRONG_BRANCH: f64 = 1.0;

/// Numbers of steps to a swing of the resonances that are looked for. That of order m grows by the
/// nonlinearity of degree m - 1 and is the weaker the larger m is; with two steps a swing the
/// scheme is at its border.
const STEPS_PER_SWING: [u32; 2] = [4, 3];
/// Largest number of times that a step is moved until its swing is that of the resonance ...
const AIMS: u32 = 3;
/// ... to this part.
const AIMED: f64 = 2e-3;
/// Factors on the steps about it that are tried; windows are some hundredths wide.
const ABOUT: [f64; 9] = [0.955, 0.97, 0.98, 0.99, 1.0, 1.01, 1.02, 1.03, 1.045];
/// An energy error this many times that of the steps on either side is a resonance.
const STANDS_OUT: f64 = 3.0;
/// Number of samples from which the strongest swing is found.
const SWING_SAMPLES: usize = 1024;

/// Sweeps the step for each method and bisects the border of what is usable; methods on all cores.
///
/// # Errors
/// If the scene cannot be studied, or the study is cancelled.
pub fn stability(scene: &Scenario, entries: &[Entry], watch: &Watch) -> Result<Map, StudyError> {
    let mapper = Judge::of(scene, watch)?.0;
    let steps_s = mapper.sweep();
    watch.expect((entries.len() * SWEEP) as u64);
    let methods = of_each(entries, watch, |entry| mapper.along(entry, &steps_s, watch))?;
    Ok(mapper.map(steps_s, methods))
}

/// Does the same, and if it is cancelled returns the map of the methods before that; it has fewer rows then.
///
/// # Errors
/// If the scene cannot be studied, or the study is cancelled before its first method is done.
pub fn stability_so_far(
    scene: &Scenario,
    entries: &[Entry],
    watch: &Watch,
) -> Result<Map, StudyError> {
    let mapper = Judge::of(scene, watch)?.0;
    let steps_s = mapper.sweep();
    watch.expect((entries.len() * SWEEP) as u64);
    let along = |entry: &Entry| mapper.along(entry, &steps_s, watch);
    let methods = of_those_before(entries, watch, along)?;
    if methods.is_empty() && !entries.is_empty() {
        return Err(StudyError::Cancelled);
    }
    Ok(mapper.map(steps_s, methods))
}

impl Map {
    /// Returns all cells as one table, the class as the outcome.
    pub fn table(&self) -> Table {
        let row = |cell: &Cell| Row { outcome: cell.class.as_str().to_owned(), ..cell.row.clone() };
        Table { rows: self.cells.iter().flatten().map(row).collect() }
    }
}

/// Between these steps lies a border.
#[derive(Clone, Copy, Debug)]
struct Bracket {
    usable_step_s: Option<f64>,
    broken: Option<(f64, Class)>,
}

/// Judges cells of one scene.
#[derive(Debug)]
pub struct Judge<'a>(Mapper<OfScene<'a>>);

impl<'a> Judge<'a> {
    /// Measures the scales of the scene over about ten turns.
    ///
    /// # Errors
    /// If no step works on the scene.
    pub fn of(scene: &'a Scenario, watch: &Watch) -> Result<Self, StudyError> {
        let known_s = scene.scene.known_until_s().unwrap_or(f64::INFINITY);
        let time_s = (10.0 * usual_time(scene)?).min(known_s);
        let scales = Scales::of(scene, time_s, watch)?;
        let exact = Entry::new(scene, with_tableau(Integrator::Vpd, TableauName::Gauss8))?;
        Ok(Self(Mapper { runs: OfScene { scene, exact }, scales }))
    }

    /// Returns the cell of a method at a step.
    ///
    /// # Errors
    /// If the scene cannot be planned with the method, or the study is cancelled.
    pub fn cell(&self, entry: &Entry, step_s: f64, watch: &Watch) -> Result<Cell, StudyError> {
        self.0.cell(entry, step_s, watch)
    }
}

/// Subject of a map: methods on a scene, or on a user-defined system.
pub(super) trait Runs {
    /// A method.
    type Method;

    /// Makes a run.
    fn run(&self, probe: Probe<'_, Self::Method>, watch: &Watch) -> Result<Measured, StudyError>;

    /// Returns the time in seconds beyond which nothing is known of what acts: the end of a table.
    fn known_until_s(&self) -> Option<f64>;

    /// Returns the longest step in seconds that is one step: at samples of a control each step ends.
    fn longest_step_s(&self) -> Option<f64>;

    /// Returns the method that is taken as exact in steps that are known to work.
    fn exact(&self) -> &Self::Method;

    /// Returns a method's name, for the map.
    fn label(&self, method: &Self::Method) -> String;

    /// Returns the figures of a run.
    fn row(&self, method: &Self::Method, step_s: f64, run: &Measured) -> Row;
}

#[derive(Debug)]
struct OfScene<'a> {
    scene: &'a Scenario,
    exact: Entry,
}

impl Runs for OfScene<'_> {
    type Method = Entry;

    fn run(&self, probe: Probe<'_, Entry>, watch: &Watch) -> Result<Measured, StudyError> {
        Ok(measure(self.scene, probe.with(&probe.method.method), watch)?)
    }

    fn known_until_s(&self) -> Option<f64> {
        self.scene.scene.known_until_s()
    }

    fn longest_step_s(&self) -> Option<f64> {
        self.scene.scene.control.as_ref().map(|control| control.every_s)
    }

    fn exact(&self) -> &Entry {
        &self.exact
    }

    fn label(&self, entry: &Entry) -> String {
        entry.label()
    }

    fn row(&self, entry: &Entry, step_s: f64, run: &Measured) -> Row {
        Row::new(entry, step_s, run, None)
    }
}

/// Makes the cells of a map, and finds borders and resonances among them.
#[derive(Debug)]
pub(super) struct Mapper<R> {
    pub(super) runs: R,
    pub(super) scales: Scales,
}

impl<R: Runs> Mapper<R> {
    pub(super) fn map(self, steps_s: Vec<f64>, methods: Vec<(Vec<Cell>, Border)>) -> Map {
        let (cells, borders) = methods.into_iter().unzip();
        let Scales { kinetic: energy_scale, fastest_rad_s, .. } = self.scales;
        Map { steps_s, cells, borders, energy_scale, fastest_rad_s }
    }

    /// Returns the cells of a method, and its border.
    pub(super) fn along(
        &self,
        method: &R::Method,
        steps_s: &[f64],
        watch: &Watch,
    ) -> Result<(Vec<Cell>, Border), StudyError> {
        let mut cells = Vec::with_capacity(SWEEP);
        for &step_s in steps_s {
            cells.push(self.cell(method, step_s, watch)?);
            watch.advance(1)?;
        }
        let broken = cells.iter().position(|cell| !cell.class.is_usable());
        let bracket = Bracket {
            usable_step_s: match broken {
                Some(at) => at.checked_sub(1).map(|at| steps_s[at]),
                None => steps_s.last().copied(),
            },
            broken: broken.map(|at| (steps_s[at], cells[at].class)),
        };
        let (mut border, tried) = self.border(method, bracket, watch)?;
        let usable =
            |cell: &&Cell| cell.class.is_usable() && Some(cell.row.step_s) <= border.usable_step_s;
        let mut along: Vec<Cell> = cells.iter().chain(&tried).filter(usable).cloned().collect();
        along.sort_by(|a, b| a.row.step_s.total_cmp(&b.row.step_s));
        border.resonances = self.resonances(method, &along, watch)?;
        Ok((cells, border))
    }

    /// Returns the steps of the sweep in seconds, rising.
    pub(super) fn sweep(&self) -> Vec<f64> {
        let (low, high) = TURNS_RAD;
        let ratio = libm::pow(high / low, 1.0 / (SWEEP - 1) as f64);
        let longest_s = self.runs.known_until_s().map(|end_s| end_s / LEAST_STEPS);
        let longest_s = longest_s.into_iter().chain(self.runs.longest_step_s());
        let longest_s = longest_s.fold(f64::INFINITY, f64::min);
        // Where the tables end before the body has turned, the sweep ends with them.
        let less = (longest_s / (high / self.scales.fastest_rad_s)).min(1.0);
        let step_s = |k: usize| low * libm::pow(ratio, k as f64) / self.scales.fastest_rad_s;
        (0..SWEEP).map(|k| less * step_s(k)).collect()
    }

    /// Returns how many steps a run may make, of those that are wanted: it ends with the tables.
    fn within(&self, wanted: u64, step_s: f64) -> u64 {
        let known = self.runs.known_until_s().map_or(f64::INFINITY, |end_s| end_s / step_s);
        wanted.min((known * (1.0 + 1e-12)) as u64).max(1)
    }

    fn cell(&self, method: &R::Method, step_s: f64, watch: &Watch) -> Result<Cell, StudyError> {
        let energy_limit = MEANINGLESS * self.scales.kinetic;
        let whole = Probe::of(method, step_s, self.within(RUN_STEPS, step_s));
        let probe = Probe { every: 1, energy_limit, keep: true, ..whole };
        let run = self.runs.run(probe, watch)?;
        watch.advance(0)?;
        let class = self.class(probe, &run, watch)?;
        let row = self.runs.row(method, step_s, &run);
        Ok(Cell { class, row, swing_rad: swing_rad(&run) })
    }

    fn class(
        &self,
        probe: Probe<'_, R::Method>,
        run: &Measured,
        watch: &Watch,
    ) -> Result<Class, StudyError> {
        if let End::Failed(failure) = &run.end {
            return Ok(Class::Failed(failure.code));
        }
        if run.end == End::BlewUp {
            return Ok(Class::BlewUp);
        }
        if run.orthogonality_error() > OFF_GROUP {
            return Ok(Class::LeftGroup);
        }
        if self.leaves_branch(probe.step_s, run, watch)? {
            return Ok(Class::WrongBranch);
        }
        let drifts = self.drifts(run) && self.drifts_on(probe, run, watch)?;
        Ok(if drifts { Class::EnergyDrifts } else { Class::Stable })
    }

    /// Returns whether the energy error has a trend beyond chance over a run.
    fn drifts(&self, run: &Measured) -> bool {
        let errors: Vec<f64> = run.series.iter().map(|&(_, energy, _)| energy).collect();
        let (change, chance) = trend(&errors);
        // The trend goes the same way from quarter to quarter: a swing slower than the run has one
        // too, but turns.
        let quarter = errors.len() / 4;
        let mean = |k: usize| {
            errors[k * quarter..(k + 1) * quarter].iter().sum::<f64>() / quarter.max(1) as f64
        };
        let onwards = (0..3).all(|k| (mean(k + 1) - mean(k)) / change > 0.08);
        // The trend is beyond chance, beyond the amplitude of a mere swing, and beyond round-off.
        let largest = run.energy_error();
        onwards
            && change.abs() > 5.0 * chance
            && change.abs() > 0.6 * largest
            && largest > 1e-12 * self.scales.kinetic
    }

    /// Returns whether the trend of a run goes on in a longer one.
    fn drifts_on(
        &self,
        probe: Probe<'_, R::Method>,
        run: &Measured,
        watch: &Watch,
    ) -> Result<bool, StudyError> {
        let steps = LONGER * probe.steps;
        if self.within(steps, probe.step_s) < steps {
            // All that is known of the motion was run.
            return Ok(true);
        }
        let probe = Probe { steps, every: LONGER, keep: false, ..probe };
        let longer = self.runs.run(probe, watch)?;
        watch.advance(0)?;
        let late = |run: &Measured| {
            let late = &run.series[run.series.len() * 3 / 4..];
            late.iter().map(|&(_, energy, _)| energy).sum::<f64>() / late.len() as f64
        };
        Ok(!longer.completed() || self.drifts(&longer) && late(&longer) / late(run) > GOES_ON)
    }

    /// Returns whether a step ends where it should not. Decided by a solution of order 16 in steps
    /// that are known to work.
    ///
    /// Each step is followed from its own start: the distance that the run has strayed before, in
    /// phase or because errors grow on the scene, does not count.
    fn leaves_branch(
        &self,
        step_s: f64,
        run: &Measured,
        watch: &Watch,
    ) -> Result<bool, StudyError> {
        let exact = self.runs.exact();
        let parts = (step_s / self.scales.easy_step_s).ceil().max(1.0) as u64;
        let made = run.points.len().saturating_sub(1);
        let spread = (0..CHECKED_STEPS).map(|k| k * made / CHECKED_STEPS);
        for at in spread.chain([run.fastest_sample]) {
            let [start, end] = run.points.get(at..at + 2).unwrap_or_default() else { continue };
            let whole = Probe::of(exact, step_s / parts as f64, parts);
            let begin = Begin::State { point: start, step: at as u64 * parts };
            let probe = Probe { begin, ..whole };
            let solved = self.runs.run(probe, watch)?;
            if solved.completed() && end.attitude_distance(&solved.last) > WRONG_BRANCH {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn border(
        &self,
        method: &R::Method,
        mut bracket: Bracket,
        watch: &Watch,
    ) -> Result<(Border, Vec<Cell>), StudyError> {
        let mut tried = Vec::new();
        while let Bracket { usable_step_s: Some(usable), broken: Some((broken, _)) } = bracket
            && broken > BORDER_RATIO * usable
        {
            let middle = (usable * broken).sqrt();
            let cell = self.cell(method, middle, watch)?;
            let class = cell.class;
            tried.push(cell);
            if class.is_usable() {
                bracket.usable_step_s = Some(middle);
            } else {
                bracket.broken = Some((middle, class));
            }
        }
        let Bracket { usable_step_s, broken } = bracket;
        let border = Border {
            label: self.runs.label(method),
            usable_step_s,
            turn_rad: usable_step_s.map(|step_s| step_s * self.scales.fastest_rad_s),
            broken_step_s: broken.map(|(step_s, _)| step_s),
            broken: broken.map(|(_, class)| class.as_str()),
            resonances: Vec::new(),
        };
        Ok((border, tried))
    }

    /// Looks for step resonances between the steps of `along`, which rise and are usable.
    ///
    /// The swing of a step is measured, so that no scheme's own function of h omega is needed; where it passes
    /// `2 pi / m` steps are tried close by.
    fn resonances(
        &self,
        method: &R::Method,
        along: &[Cell],
        watch: &Watch,
    ) -> Result<Vec<Resonance>, StudyError> {
        let mut found = Vec::new();
        for steps_per_swing in STEPS_PER_SWING {
            let target = std::f64::consts::TAU / f64::from(steps_per_swing);
            let passes = |pair: &&[Cell]| {
                let [low, high] = [&pair[0], &pair[1]].map(|cell| cell.swing_rad);
                low.is_some_and(|low| low < target) && high.is_some_and(|high| high >= target)
            };
            let Some(pair) = along.windows(2).find(passes) else { continue };
            let at = self.aimed(method, target, [pair[0].clone(), pair[1].clone()], watch)?;
            let largest = along.last().map_or(at, |cell| cell.row.step_s);
            let mut cells = Vec::with_capacity(ABOUT.len());
            for step_s in ABOUT.map(|part| part * at).into_iter().filter(|&h| h <= largest) {
                cells.push(self.cell(method, step_s, watch)?);
            }
            found.extend(self.window(steps_per_swing, &cells));
        }
        Ok(found)
    }

    /// Returns the step between two at which the motion swings by `target`.
    fn aimed(
        &self,
        method: &R::Method,
        target: f64,
        [mut low, mut high]: [Cell; 2],
        watch: &Watch,
    ) -> Result<f64, StudyError> {
        let swing = |cell: &Cell| cell.swing_rad.unwrap_or(target);
        let between = |low: &Cell, high: &Cell| {
            let part = (target - swing(low)) / (swing(high) - swing(low)).max(f64::MIN_POSITIVE);
            low.row.step_s * libm::pow(high.row.step_s / low.row.step_s, part.clamp(0.0, 1.0))
        };
        for _ in 0..AIMS {
            let cell = self.cell(method, between(&low, &high), watch)?;
            match cell.swing_rad {
                Some(swing) if (swing - target).abs() > AIMED * target => {
                    if swing < target {
                        low = cell
                    } else {
                        high = cell
                    }
                }
                _ => return Ok(cell.row.step_s),
            }
        }
        Ok(between(&low, &high))
    }

    /// Returns the steps of `cells` whose energy stands out, if there are any.
    fn window(&self, steps_per_swing: u32, cells: &[Cell]) -> Option<Resonance> {
        let error = |cell: &Cell| match (cell.class, cell.row.energy_error) {
            (Class::Failed(_), _) | (_, None) => self.scales.kinetic,
            (_, Some(error)) => error,
        };
        let (first, last) = (cells.first()?, cells.last()?);
        // The larger of the two: a window at the rim hides none.
        let usual = error(first).max(error(last)).max(1e-13 * self.scales.kinetic);
        let stands_out = |cell: &Cell| error(cell) > STANDS_OUT * usual;
        let (from, to) = (cells.iter().position(stands_out)?, cells.iter().rposition(stands_out)?);
        let worst = cells.iter().max_by(|a, b| error(a).total_cmp(&error(b)))?;
        Some(Resonance {
            steps_per_swing,
            window_s: [cells.get(from.checked_sub(1)?)?.row.step_s, cells.get(to + 1)?.row.step_s],
            worst_step_s: worst.row.step_s,
            energy_error: error(worst),
            usual_energy_error: usual,
        })
    }
}

/// Returns the angle by which the strongest swing of a motion goes on in a step, rad, between 0 and
/// pi: where the periodogram of the momentum's liveliest component, with Hann's window, is largest.
/// `None` for a run too short, or a momentum that stays.
fn swing_rad(run: &Measured) -> Option<f64> {
    let points = run.points.get(..SWING_SAMPLES)?;
    let n = points[0].dimension();
    let series = |i: usize, j: usize| -> Vec<f64> {
        let values: Vec<f64> = points.iter().map(|point| point.momentum[(i, j)]).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        values.into_iter().map(|x| x - mean).collect()
    };
    let power = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>();
    let liveliest = (0..points[0].momentum.nrows())
        .flat_map(|i| (0..i % n).map(move |j| (i, j)))
        .map(|(i, j)| series(i, j))
        .max_by(|a, b| power(a).total_cmp(&power(b)))?;
    if !(power(&liveliest) > 0.0) {
        return None;
    }
    let unit = std::f64::consts::TAU / SWING_SAMPLES as f64;
    let windowed: Vec<f64> =
        liveliest.iter().enumerate().map(|(k, x)| x * (1.0 - libm::cos(unit * k as f64))).collect();
    // Goertzel's recurrence for each line.
    let strength = |line: usize| {
        let c = 2.0 * libm::cos(unit * line as f64);
        let [a, b] = windowed.iter().fold([0.0, 0.0], |[a, b], x| [x + c * a - b, a]);
        (a * a + b * b - c * a * b).max(0.0).sqrt()
    };
    let spectrum: Vec<f64> = (0..=SWING_SAMPLES / 2).map(strength).collect();
    // The lines next to zero are the mean under the window.
    let line = (2..SWING_SAMPLES / 2).max_by(|&a, &b| spectrum[a].total_cmp(&spectrum[b]))?;
    // With Hann's window two lines give the place between them (Grandke 1983).
    let (left, peak, right) = (spectrum[line - 1], spectrum[line], spectrum[line + 1]);
    let (next, side) = if right > left { (right, 1.0) } else { (left, -1.0) };
    let ratio = next / peak;
    Some(unit * (line as f64 + side * (2.0 * ratio - 1.0) / (ratio + 1.0)))
}
