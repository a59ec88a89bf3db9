//! Where each method fails: a sweep of the step, and the border of what is usable.
//!
//! Invariant: a cell has exactly one class, the first that fits in the order of [`Class`] from the bottom up.

use serde::Serialize;

use super::long_term::trend;
use super::measure::{End, Measured, Probe, measure};
use super::table::{Row, Table};
use super::{Entry, Scales, StudyError, Watch, usual_time, with_tableau};
use crate::scenario::{MethodName, Scenario, TableauName};
use crate::solve::failure::FailureCode;

/// What became of a method at a step.
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
    /// The class in tables.
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

    /// Does a run of this class mean something? One whose energy drifts does, for a while.
    pub fn is_usable(self) -> bool {
        matches!(self, Self::Stable | Self::EnergyDrifts)
    }
}

/// A method at a step.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// What became of it.
    pub class: Class,
    /// The figures.
    pub row: Row,
}

/// The largest step at which a method is usable, and every smaller one of the sweep too.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Border {
    /// The method with its tableau and solver.
    pub label: String,
    /// Largest usable step in seconds, to 5 %; absent if no step of the sweep is.
    pub usable_step_s: Option<f64>,
    /// By how much the body turns in it where it is fastest, rad.
    pub turn_rad: Option<f64>,
    /// Smallest step beyond it that was tried, in seconds; absent if the whole sweep is usable.
    pub broken_step_s: Option<f64>,
    /// What happens there.
    pub broken: Option<&'static str>,
}

/// The map of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// The steps of the sweep in seconds, rising.
    pub steps_s: Vec<f64>,
    /// Of each method, in the order of the entries, a cell for each step.
    pub cells: Vec<Vec<Cell>>,
    /// Of each method its border.
    pub borders: Vec<Border>,
    /// The energy that moves, J: errors of the energy are seen in parts of it.
    pub energy_scale: f64,
    /// The fastest turn of the body, rad/s.
    pub fastest_rad_s: f64,
}

/// Steps of the sweep.
const SWEEP: usize = 24;
/// Angle by which the body turns in the smallest and the largest step of the sweep where it is fastest.
const TURNS_RAD: (f64, f64) = (0.03, 6.0);
/// Steps of each run: long enough for an instability to show, and a drift.
const RUN_STEPS: u64 = 4000;
/// A drift is one that goes on in a run so many times as long. What only swings slower than a run comes back.
const LONGER: u64 = 4;
/// By at least so much: by [`LONGER`] if it is steady; on the dipole by 1.9 to 5, and by 1.2 at most where it swings.
const GOES_ON: f64 = 1.5;
/// Steps of each run that are held against where they should have ended, beside the one that begins fastest.
const CHECKED_STEPS: usize = 8;
/// The step beyond the border is at most so many times the largest usable one.
const BORDER_RATIO: f64 = 1.05;
/// An energy error beyond this part of the kinetic energy is no integration.
const MEANINGLESS: f64 = 0.1;
/// An attitude this far from orthogonal is no rotation.
const OFF_GROUP: f64 = 1e-6;
/// A step that ends further than this from where it should has gone to another branch: 60 degrees.
const WRONG_BRANCH: f64 = 1.0;

/// Sweeps the step for each method and bisects the border of what is usable.
///
/// # Errors
/// If the scene cannot be studied, or the study is cancelled.
pub fn stability(scene: &Scenario, entries: &[Entry], watch: &Watch) -> Result<Map, StudyError> {
    let judge = Judge::of(scene, watch)?;
    let steps_s = judge.sweep();
    watch.expect((entries.len() * SWEEP) as u64);
    let mut map = Map {
        cells: Vec::new(),
        borders: Vec::new(),
        energy_scale: judge.scales.kinetic,
        fastest_rad_s: judge.scales.fastest_rad_s,
        steps_s,
    };
    for entry in entries {
        let mut cells = Vec::with_capacity(SWEEP);
        for &step_s in &map.steps_s {
            cells.push(judge.cell(entry, step_s, watch)?);
            watch.advance(1)?;
        }
        let broken = cells.iter().position(|cell| !cell.class.is_usable());
        let bracket = Bracket {
            usable_step_s: match broken {
                Some(at) => at.checked_sub(1).map(|at| map.steps_s[at]),
                None => map.steps_s.last().copied(),
            },
            broken: broken.map(|at| (map.steps_s[at], cells[at].class)),
        };
        map.borders.push(judge.border(entry, bracket, watch)?);
        map.cells.push(cells);
    }
    Ok(map)
}

impl Map {
    /// All cells as one table, the class as the outcome.
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
pub struct Judge<'a> {
    scene: &'a Scenario,
    scales: Scales,
}

impl<'a> Judge<'a> {
    /// Measures the scales of the scene over about ten turns.
    ///
    /// # Errors
    /// If no step works on the scene.
    pub fn of(scene: &'a Scenario, watch: &Watch) -> Result<Self, StudyError> {
        let time_s = 10.0 * usual_time(scene)?;
        Ok(Self { scene, scales: Scales::of(scene, time_s, watch)? })
    }

    fn sweep(&self) -> Vec<f64> {
        let (low, high) = TURNS_RAD;
        let ratio = libm::pow(high / low, 1.0 / (SWEEP - 1) as f64);
        (0..SWEEP).map(|k| low * libm::pow(ratio, k as f64) / self.scales.fastest_rad_s).collect()
    }

    /// A method at a step.
    ///
    /// # Errors
    /// If the scene cannot be planned with the method, or the study is cancelled.
    pub fn cell(&self, entry: &Entry, step_s: f64, watch: &Watch) -> Result<Cell, StudyError> {
        let energy_limit = MEANINGLESS * self.scales.kinetic;
        let whole = Probe::of(&entry.method, step_s, RUN_STEPS);
        let probe = Probe { every: 1, energy_limit, keep: true, ..whole };
        let run = measure(self.scene, probe, watch)?;
        watch.advance(0)?;
        let class = self.class(probe, &run, watch)?;
        Ok(Cell { class, row: Row::new(entry, step_s, &run, None) })
    }

    fn class(&self, probe: Probe<'_>, run: &Measured, watch: &Watch) -> Result<Class, StudyError> {
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

    /// Has the energy error a trend beyond chance over a run?
    fn drifts(&self, run: &Measured) -> bool {
        let errors: Vec<f64> = run.series.iter().map(|&(_, energy, _)| energy).collect();
        let (change, chance) = trend(&errors);
        // The same way from quarter to quarter: a swing slower than the run has a trend too, but turns.
        let quarter = errors.len() / 4;
        let mean = |k: usize| {
            errors[k * quarter..(k + 1) * quarter].iter().sum::<f64>() / quarter.max(1) as f64
        };
        let onwards = (0..3).all(|k| (mean(k + 1) - mean(k)) / change > 0.08);
        // Beyond chance, beyond the amplitude of what only swings, and beyond round-off.
        let largest = run.energy_error();
        onwards
            && change.abs() > 5.0 * chance
            && change.abs() > 0.6 * largest
            && largest > 1e-12 * self.scales.kinetic
    }

    /// Does the trend of a run go on in a longer one?
    fn drifts_on(
        &self,
        probe: Probe<'_>,
        run: &Measured,
        watch: &Watch,
    ) -> Result<bool, StudyError> {
        let probe = Probe { steps: LONGER * probe.steps, every: LONGER, keep: false, ..probe };
        let longer = measure(self.scene, probe, watch)?;
        watch.advance(0)?;
        let late = |run: &Measured| {
            let late = &run.series[run.series.len() * 3 / 4..];
            late.iter().map(|&(_, energy, _)| energy).sum::<f64>() / late.len() as f64
        };
        Ok(!longer.completed() || self.drifts(&longer) && late(&longer) / late(run) > GOES_ON)
    }

    /// Does a step end where it should not? Told by a solution of order 16 in steps that are known to work.
    ///
    /// Each step is followed from its own start: by how much the run has strayed before, in phase or because errors
    /// grow on the scene, does not count.
    fn leaves_branch(
        &self,
        step_s: f64,
        run: &Measured,
        watch: &Watch,
    ) -> Result<bool, StudyError> {
        let exact = with_tableau(MethodName::Vpd, TableauName::Gauss8);
        let parts = (step_s / self.scales.easy_step_s).ceil().max(1.0) as u64;
        let made = run.points.len().saturating_sub(1);
        let spread = (0..CHECKED_STEPS).map(|k| k * made / CHECKED_STEPS);
        for at in spread.chain([run.fastest_sample]) {
            let [start, end] = run.points.get(at..at + 2).unwrap_or_default() else { continue };
            let whole = Probe::of(&exact, step_s / parts as f64, parts);
            let probe = Probe { from: Some(start), ..whole };
            let exact = measure(self.scene, probe, watch)?;
            if exact.completed() && end.attitude_distance(&exact.last) > WRONG_BRANCH {
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn border(
        &self,
        entry: &Entry,
        mut bracket: Bracket,
        watch: &Watch,
    ) -> Result<Border, StudyError> {
        while let Bracket { usable_step_s: Some(usable), broken: Some((broken, _)) } = bracket
            && broken > BORDER_RATIO * usable
        {
            let middle = (usable * broken).sqrt();
            let class = self.cell(entry, middle, watch)?.class;
            if class.is_usable() {
                bracket.usable_step_s = Some(middle);
            } else {
                bracket.broken = Some((middle, class));
            }
        }
        let Bracket { usable_step_s, broken } = bracket;
        Ok(Border {
            label: entry.label(),
            usable_step_s,
            turn_rad: usable_step_s.map(|step_s| step_s * self.scales.fastest_rad_s),
            broken_step_s: broken.map(|(step_s, _)| step_s),
            broken: broken.map(|(_, class)| class.as_str()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{CHECKED_STEPS, Judge, Probe, measure};
    use crate::scenario::{MethodName, SHIPPED, Scenario, TableauName};
    use crate::study::{Watch, with_tableau};

    #[test]
    fn a_late_step_that_ends_elsewhere_is_told() {
        let (_, text) = SHIPPED[0];
        let scene = Scenario::from_json(text.as_bytes()).expect("the dipole");
        let watch = Watch::default();
        let judge = Judge::of(&scene, &watch).expect("scales");
        let method = with_tableau(MethodName::Vpd, TableauName::Gauss2);
        let step_s = 0.05;
        let probe = Probe { every: 1, keep: true, ..Probe::of(&method, step_s, 400) };
        let mut run = measure(&scene, probe, &watch).expect("a run");
        assert!(!judge.leaves_branch(step_s, &run, &watch).expect("judged"));
        // Half a turn about the body's third axis: a rotation still, of the same energy where it is a symmetry.
        let made = run.points.len() - 1;
        let end = &mut run.points[3 * made / CHECKED_STEPS + 1].attitude;
        end.column_mut(0).neg_mut();
        end.column_mut(1).neg_mut();
        assert!(judge.leaves_branch(step_s, &run, &watch).expect("judged"));
    }
}
