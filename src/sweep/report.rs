//! What a table says: quantiles, probabilities, and which field matters.
//!
//! Invariant: only members that succeeded count, and how many did not is said; the figures depend on the lines of the table alone.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use serde::Serialize;

use super::file::Combine;
use super::statistics::{
    Figure, MeanAttitude, Sobol, mean, mean_attitude, proportion, quantile, rank_correlation,
    ranks, sobol,
};
use super::{Counts, Sweep, SweepError};
use crate::scenario::ScenarioError;

/// A condition on a column, of which the probability is asked.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Holds {
    /// The column.
    pub column: String,
    /// Whether it must lie below the limit, or above.
    pub below: bool,
    /// The limit.
    pub limit: f64,
}

impl FromStr for Holds {
    type Err = String;

    /// Parses `energy_error_max<1e-9`, or one with `>`.
    fn from_str(text: &str) -> Result<Self, String> {
        let wanted = || format!("{text:?} is not of the form column<number or column>number");
        let at = text.find(['<', '>']).ok_or_else(wanted)?;
        let limit = text[at + 1..].trim().parse().map_err(|_| wanted())?;
        let column = text[..at].trim().to_owned();
        Ok(Self { column, below: text[at..].starts_with('<'), limit })
    }
}

/// Options of a report.
#[derive(Clone, Debug)]
pub struct Asked {
    /// The quantiles, each between 0 and 1.
    pub quantiles: Vec<f64>,
    /// Conditions of which the probability is asked.
    pub holds: Vec<Holds>,
    /// With what probability an interval holds the true figure.
    pub confidence: f64,
}

/// What a table says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The name of the scenario.
    pub name: String,
    /// Members that succeeded, failed and were refused.
    pub counts: Counts,
    /// Members that have no line yet.
    pub missing: u64,
    /// The probability of every interval.
    pub confidence: f64,
    /// Each column that holds different numbers.
    pub columns: Vec<Column>,
    /// The probabilities that were asked for.
    pub probabilities: Vec<Probability>,
    /// The mean of the last attitudes; n = 3, of one body.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub attitude: Option<MeanAttitude>,
}

/// A column of results.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Column {
    /// Its head.
    pub name: String,
    /// Members with a number in it.
    pub count: u64,
    /// The mean, with its standard error.
    pub mean: f64,
    /// The standard error of the mean.
    pub standard_error: f64,
    /// The quantiles that were asked for, and each with its interval.
    pub quantiles: Vec<(f64, Figure)>,
    /// The rank correlation with each varied field that changes.
    pub rank_correlations: BTreeMap<String, Figure>,
    /// Sobol's indices of each field; of a sweep that combines by `saltelli`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub sobol: BTreeMap<String, Sobol>,
    /// Mean and its standard error after so many members, the number doubled each time.
    pub convergence: Vec<(u64, f64, f64)>,
    /// How many values lie in each of so many equal parts from the least to the largest.
    pub histogram: Histogram,
}

/// Numbers of values in equal parts of a range.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// The least value.
    pub from: f64,
    /// The largest.
    pub to: f64,
    /// The numbers.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// Counts values in rising order, of which the ends differ.
    fn of(rising: &[f64]) -> Self {
        const PARTS: usize = 40;
        let (from, to) = (rising[0], rising[rising.len() - 1]);
        let mut counts = vec![0; PARTS];
        for x in rising {
            // In halves, for a range beyond the largest double.
            let part = (0.5 * x - 0.5 * from) / (0.5 * to - 0.5 * from);
            counts[((part * PARTS as f64) as usize).min(PARTS - 1)] += 1;
        }
        Self { from, to, counts }
    }
}

/// The probability of a condition.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Probability {
    /// The condition.
    #[serde(flatten)]
    pub holds: Holds,
    /// The part of the members that succeeded for which it holds; one without a number does not.
    pub part: Figure,
}

impl Sweep {
    /// Reads a table of this sweep, finished or not, and says what is in it.
    ///
    /// # Errors
    /// If it cannot be read, is not of this sweep, or lacks a column that is asked for.
    pub fn report(&self, table: &Path, asked: &Asked) -> Result<Report, SweepError> {
        let wrong = |message: String| SweepError::from(ScenarioError::invalid("", message));
        let place = |name: &str| self.columns.iter().position(|known| known == name);
        let outcome = place("outcome").unwrap_or_default();
        for Holds { column, .. } in &asked.holds {
            if place(column).is_none_or(|at| at <= outcome + 1) {
                let known = self.columns[outcome + 2..].join(", ");
                return Err(wrong(format!(
                    "there is no column {column:?} of results; there are {known}"
                )));
            }
        }
        let fields = 1..outcome;
        // Of each member that has a line, by columns; NaN where there is no number.
        let mut numbers: Vec<Vec<f64>> = vec![Vec::new(); self.columns.len()];
        let mut counts = Counts::default();
        let mut succeeded = Vec::new();
        self.lines(table, |_, _, cells| {
            let has = match cells[outcome].as_str() {
                "succeeded" => {
                    counts.succeeded += 1;
                    true
                }
                "failed" => {
                    counts.failed += 1;
                    false
                }
                _ => {
                    counts.refused += 1;
                    false
                }
            };
            succeeded.push(has);
            for (at, (column, cell)) in numbers.iter_mut().zip(cells).enumerate() {
                let counts = has || fields.contains(&at);
                let number = cell.parse::<f64>().ok().filter(|x| counts && x.is_finite());
                column.push(number.unwrap_or(f64::NAN));
            }
        })?;
        let read = succeeded.len();
        // The others of Saltelli's members share values with these: an interval counts on runs that do not.
        let kinds = self.file.vary.len() + 2;
        let is_own = |k: &usize| self.file.combine != Combine::Saltelli || k % kinds < 2;
        let mut columns = Vec::new();
        for at in outcome + 2..self.columns.len() {
            let known = (0..read).filter(is_own).filter(|&k| !numbers[at][k].is_nan());
            let known: Vec<usize> = known.collect();
            let values: Vec<f64> = known.iter().map(|&k| numbers[at][k]).collect();
            let mut rising = values.clone();
            rising.sort_by(f64::total_cmp);
            if rising.first() == rising.last() {
                continue;
            }
            let of_values = ranks(&values);
            let correlation = |field: usize| {
                let x: Vec<f64> = known.iter().map(|&k| numbers[field][k]).collect();
                let all = x.iter().all(|x| !x.is_nan());
                let found = rank_correlation(&ranks(&x), &of_values, asked.confidence);
                found.filter(|_| all).map(|found| (self.columns[field].clone(), found))
            };
            let (mean_of_all, standard_error) = mean(&values);
            let doubled = (3..).map(|k| 1_usize << k).take_while(|&k| k < values.len());
            let so_far = |k: usize| {
                let (mean, error) = mean(&values[..k]);
                (k as u64, mean, error)
            };
            columns.push(Column {
                name: self.columns[at].clone(),
                count: values.len() as u64,
                mean: mean_of_all,
                standard_error,
                quantiles: asked
                    .quantiles
                    .iter()
                    .map(|&part| (part, quantile(&rising, part, asked.confidence)))
                    .collect(),
                rank_correlations: fields.clone().filter_map(correlation).collect(),
                sobol: self.sobol_of(&numbers[at], asked.confidence),
                convergence: doubled.chain([values.len()]).map(so_far).collect(),
                histogram: Histogram::of(&rising),
            });
        }
        let probability = |holds: &Holds| {
            let at = place(&holds.column).unwrap_or_default();
            let limit = holds.limit;
            let met = |x: f64| if holds.below { x < limit } else { x > limit };
            let met = (0..read).filter(is_own).filter(|&k| met(numbers[at][k])).count() as u64;
            let own = (0..read).filter(is_own).filter(|&k| succeeded[k]).count() as u64;
            (own > 0).then(|| Probability {
                holds: holds.clone(),
                part: proportion(met, own, asked.confidence),
            })
        };
        let probabilities = asked.holds.iter().filter_map(probability).collect();
        Ok(Report {
            name: self.name().to_owned(),
            missing: self.members - read as u64,
            confidence: asked.confidence,
            columns,
            probabilities,
            attitude: self.attitude(&numbers),
            counts,
        })
    }

    /// Returns Sobol's indices of a column by fields: of the rows of which all members have a number.
    fn sobol_of(&self, numbers: &[f64], confidence: f64) -> BTreeMap<String, Sobol> {
        let fields = &self.file.vary;
        if self.file.combine != Combine::Saltelli {
            return BTreeMap::new();
        }
        let whole = |row: &&[f64]| row.iter().all(|x| !x.is_nan());
        let rows = numbers.chunks_exact(fields.len() + 2).filter(whole).map(<[f64]>::to_vec);
        let rows: Vec<Vec<f64>> = rows.collect();
        let names = fields.iter().map(|field| field.column().to_owned());
        names.zip(sobol(&rows, confidence)).collect()
    }

    fn attitude(&self, numbers: &[Vec<f64>]) -> Option<MeanAttitude> {
        let place = |name: &str| self.columns.iter().position(|known| known == name);
        let [w, x, y, z] =
            ["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"].map(place);
        let places = [w?, x?, y?, z?];
        let all = (0..numbers[places[0]].len()).map(|k| places.map(|at| numbers[at][k]));
        let all: Vec<[f64; 4]> = all.filter(|q| q.iter().all(|x| !x.is_nan())).collect();
        if all.len() < 2 {
            return None;
        }
        mean_attitude(&all)
    }
}
