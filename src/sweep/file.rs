//! The file of a sweep: JSON → types, and the checks of their form and range.

use std::collections::HashSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::MOST_MEMBERS;
use crate::scenario::{
    LARGEST_SEED, MAX_SIZE, Scenario, ScenarioError, SchemaAddress, ensure, semidefinite,
};

/// Largest number of fields that are varied, and of scores.
const MOST_COLUMNS: usize = 32;
/// Longest pointer of a field in bytes.
const LONGEST_POINTER: usize = 200;
/// Largest number of members whose whole motion is logged.
const MOST_LOGS: usize = 1000;
/// Smallest end of a logarithmic range.
const SMALLEST: f64 = 1e-30;

/// A sweep: one scenario, the fields of it that are varied, and what is asked of each run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SweepFile {
    /// Where an editor finds the JSON Schema of sweeps; nothing here looks there.
    #[serde(rename = "$schema", default, skip_serializing)]
    pub(crate) schema: SchemaAddress,
    /// `sweep`, so that the file as it stands is also the body of `POST /studies`.
    #[serde(default)]
    pub(crate) kind: SweepKind,
    /// The scenario that is varied; in a file also the path of one, as seen from that file.
    #[schemars(with = "Base")]
    pub(crate) scenario: Value,
    /// The fields that are varied, 1 to 32 of them. They are set in this order.
    pub(crate) vary: Vec<Vary>,
    /// Combination of their values.
    #[serde(default)]
    pub(crate) combine: Combine,
    /// Correlation of fields with `normal` values, of a sweep that combines them `side_by_side`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) correlation: Option<Correlation>,
    /// Seed of all random values: the same seed, the same values. At most 2^53 - 1.
    #[serde(default)]
    pub(crate) seed: u64,
    /// Scores of each run in addition to its end and its errors, a column each; at most 32.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) scores: Vec<Score>,
    /// The column that the picture shows; by default the first score, else the largest energy error.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) picture: Option<String>,
    /// Members whose whole motion `vpd sweep` logs as well, at most 1000.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) keep_logs: Vec<u64>,
}

/// Kind of the document.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum SweepKind {
    /// Many runs over fields of one scenario.
    #[default]
    Sweep,
}

/// A scenario, or the path of one.
#[derive(JsonSchema)]
#[schemars(untagged)]
#[expect(dead_code, reason = "only its schema is used")]
enum Base {
    /// The scenario itself.
    Scenario(Box<Scenario>),
    /// The path of its file.
    Path(String),
}

/// A field and its values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Vary {
    /// JSON pointer (RFC 6901) of the field in the scenario.
    pub(crate) pointer: String,
    /// Its column in the table; the pointer if absent. 1 to 64 letters, digits or `_`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    /// Its values.
    pub(crate) values: Values,
}

/// Correlation of some of the fields that are varied; of all others each is independent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Correlation {
    /// Their pointers, as in `vary`.
    pub(crate) pointers: Vec<String>,
    /// A row of each: ones on the diagonal, symmetric, positive semidefinite.
    pub(crate) matrix: Vec<Vec<f64>>,
}

impl Correlation {
    fn check(&self, vary: &[Vary], combine: Combine) -> Result<(), ScenarioError> {
        const AT: &str = "/correlation";
        let Self { pointers, matrix } = self;
        ensure(combine == Combine::SideBySide, AT, || {
            "needs `\"combine\": \"side_by_side\"`, which takes the values of its fields in pairs"
                .into()
        })?;
        let mut seen = HashSet::new();
        for (at, pointer) in pointers.iter().enumerate() {
            let place = format!("{AT}/pointers/{at}");
            let normal = vary.iter().any(|field| {
                field.pointer == *pointer && matches!(field.values, Values::Normal(_))
            });
            ensure(normal, place.clone(), || {
                format!(
                    "{pointer:?} given, one of the fields of `vary` with `normal` values is needed"
                )
            })?;
            ensure(seen.insert(pointer), place, || format!("names {pointer} again"))?;
        }
        let rows = pointers.len();
        let at = format!("{AT}/matrix");
        ensure(
            matrix.len() == rows && matrix.iter().all(|row| row.len() == rows),
            at.clone(),
            || {
                format!(
                    "has another shape; {rows} rows of {rows} numbers are needed, one for each of `pointers`"
                )
            },
        )?;
        for (i, row) in matrix.iter().enumerate() {
            for (j, &x) in row.iter().enumerate() {
                let fits = if i == j { x == 1.0 } else { (-1.0..=1.0).contains(&x) };
                ensure(fits, format!("{at}/{i}/{j}"), || {
                    format!("{x:?} given, a correlation is from -1 to 1, and 1 on the diagonal")
                })?;
            }
        }
        semidefinite(&at, matrix).map(|_| ())
    }

    /// Returns for a field the weights of the independent normal numbers of which its own is made, by the numbers of their fields;
    /// none for one that is not in it.
    pub(super) fn weights(&self, vary: &[Vary], field: usize) -> Vec<(u64, f64)> {
        let number = |pointer: &String| vary.iter().position(|field| field.pointer == *pointer);
        let row = self.pointers.iter().position(|pointer| *pointer == vary[field].pointer);
        let factor = semidefinite("/correlation/matrix", &self.matrix);
        let of_row = row.zip(factor.ok()).map(|(row, mut factor)| factor.swap_remove(row));
        let weights = self.pointers.iter().zip(of_row.into_iter().flatten());
        let weights = weights.filter(|(_, weight)| *weight != 0.0);
        weights.filter_map(|(pointer, weight)| Some((number(pointer)? as u64, weight))).collect()
    }
}

impl Vary {
    /// Returns the head of its column.
    pub(crate) fn column(&self) -> &str {
        self.name.as_deref().unwrap_or(&self.pointer)
    }
}

/// The values of a field. A whole number is written as one, so that it also fits where nothing else does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Values {
    /// Listed values, of any JSON type.
    List(Vec<Value>),
    /// At even distances, both ends included.
    Linear(Span),
    /// At even ratios, both ends included and above zero.
    Logarithmic(Span),
    /// At random, evenly distributed.
    Uniform(Span),
    /// At random, one in each of `count` parts of equal length, in random order (McKay, Beckman, Conover 1979): side by
    /// side several of these make a Latin hypercube.
    LatinHypercube(Span),
    /// At random, normally distributed.
    Normal(Normal),
}

/// A range of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Span {
    pub(crate) from: f64,
    pub(crate) to: f64,
    /// Number of values.
    pub(crate) count: u64,
}

/// A normal distribution.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Normal {
    pub(crate) mean: f64,
    /// The standard deviation, above zero.
    pub(crate) deviation: f64,
    /// Number of values.
    pub(crate) count: u64,
}

impl Values {
    /// Returns the number of values.
    pub(crate) fn count(&self) -> u64 {
        match self {
            Self::List(values) => values.len() as u64,
            Self::Linear(span)
            | Self::Logarithmic(span)
            | Self::Uniform(span)
            | Self::LatinHypercube(span) => span.count,
            Self::Normal(normal) => normal.count,
        }
    }

    fn check(&self, at: &str) -> Result<(), ScenarioError> {
        let count = self.count();
        let (word, counted) = match self {
            Self::List(_) => ("list", String::new()),
            Self::Linear(_) => ("linear", "/count".to_owned()),
            Self::Logarithmic(_) => ("logarithmic", "/count".to_owned()),
            Self::Uniform(_) => ("uniform", "/count".to_owned()),
            Self::LatinHypercube(_) => ("latin_hypercube", "/count".to_owned()),
            Self::Normal(_) => ("normal", "/count".to_owned()),
        };
        let at = format!("{at}/values/{word}");
        ensure((1..=MOST_MEMBERS).contains(&count), format!("{at}{counted}"), || {
            format!("{count} values given, 1 to {MOST_MEMBERS} are allowed")
        })?;
        let number = |field: &str, x: f64| {
            ensure(x.abs() <= MAX_SIZE, format!("{at}/{field}"), || {
                format!("{x:e} given, the size of a number is at most {MAX_SIZE:e}")
            })
        };
        match self {
            Self::List(_) => Ok(()),
            Self::Normal(Normal { mean, deviation, .. }) => {
                number("mean", *mean)?;
                number("deviation", *deviation)?;
                ensure(*deviation > 0.0, format!("{at}/deviation"), || {
                    format!("{deviation:e} given, a deviation is above 0")
                })
            }
            Self::Linear(Span { from, to, .. })
            | Self::Logarithmic(Span { from, to, .. })
            | Self::Uniform(Span { from, to, .. })
            | Self::LatinHypercube(Span { from, to, .. }) => {
                number("from", *from)?;
                number("to", *to)?;
                let logarithmic = matches!(self, Self::Logarithmic(_));
                for (field, x) in [("from", from), ("to", to)] {
                    ensure(!logarithmic || *x >= SMALLEST, format!("{at}/{field}"), || {
                        format!(
                            "{x:e} given, an end of a logarithmic range is at least {SMALLEST:e}"
                        )
                    })?;
                }
                Ok(())
            }
        }
    }
}

/// Combination of the values of several fields.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Combine {
    /// Every value of one with every value of the others; the last field runs through its values first.
    #[default]
    Product,
    /// The first of each, the second of each, ..: all have as many values.
    SideBySide,
    /// For Sobol's indices (Saltelli et al. 2010), of 2 N values of each field from a scrambled sequence of Sobol: N rows, each of a member with the first
    /// halves, one with the second halves, and for each field one with the first halves but for that.
    Saltelli,
}

/// A column of the table that is asked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Score {
    /// Its head: 1 to 64 letters, digits or `_`.
    pub(crate) name: String,
    /// Several bodies: the name of that whose tilt or angular speed it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) body: Option<String>,
    /// Content of the column.
    pub(crate) measure: Measure,
}

/// Measure of a run, taken at its samples: see `log.every` of the scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Measure {
    /// The largest value.
    Largest(Quantity),
    /// The smallest value.
    Smallest(Quantity),
    /// The value at the last sample.
    Last(Quantity),
    /// The time of the first sample at which a condition holds, in seconds; empty if there is none.
    FirstTime(Condition),
    /// The time of the first sample from which on a condition holds at all others, in seconds; empty if it does not at the last.
    SettledTime(Condition),
    /// The largest Lyapunov exponent over the time of the run, in 1/s: the mean rate at which a shadow trajectory leaves
    /// the run, brought back to its distance at each sample (Benettin, Galgani, Giorgilli, Strelcyn 1980). Empty if a run
    /// fails, or the shadow gets too far between two samples.
    LyapunovExponent(Lyapunov),
}

/// A number that each sample has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Quantity {
    /// The angle between an axis of the body and one of space, in radians from 0 to pi.
    Tilt(Tilt),
    /// The size of the angular velocity, in rad/s.
    AngularSpeed,
    /// The kinetic energy, in J; of several bodies that of all.
    KineticEnergy,
    /// Several bodies: the distance of two of them, or of points of them, in m.
    Distance(Separation),
    /// The angle between an axis of the body and its direction, in radians: see `pointing` of the scenario.
    AxisError,
}

/// Two axes: n numbers each, of any length but zero.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Tilt {
    /// In body coordinates.
    pub(crate) body_axis: Vec<f64>,
    /// In space coordinates.
    pub(crate) space_axis: Vec<f64>,
}

/// Two bodies, or points of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Separation {
    /// Names of the bodies; one may be `space`, which does not move.
    pub(crate) between: [String; 2],
    /// A point of each, in its body's coordinates, for `space` a point of space; if absent the centres of mass, of a pinned body
    /// its pivot, of space the origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) points: Option<[Vec<f64>; 2]>,
}

/// A quantity beyond a limit: either `above` or `below`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Condition {
    /// The quantity.
    pub(crate) of: Quantity,
    /// It is above this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) above: Option<f64>,
    /// It is below this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) below: Option<f64>,
}

/// Options of the measurement of a Lyapunov exponent.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Lyapunov {
    /// The distance at which the shadow begins, and to which it is brought back: of turns in radians, of angular velocities
    /// in parts of how fast the body moves at the start. 1e-12 to 1e-4.
    #[serde(default = "Lyapunov::default_distance")]
    pub(crate) distance: f64,
    /// Time in seconds before which the run is left out of the mean: until then the shadow turns
    /// into the direction that grows most.
    #[serde(default)]
    pub(crate) skip_s: f64,
}

impl Lyapunov {
    fn default_distance() -> f64 {
        1e-8
    }
}

impl Quantity {
    fn check(&self, at: &str, n: usize) -> Result<(), ScenarioError> {
        let Self::Tilt(Tilt { body_axis, space_axis }) = self else { return Ok(()) };
        for (name, axis) in [("body_axis", body_axis), ("space_axis", space_axis)] {
            let pointer = format!("{at}/tilt/{name}");
            ensure(axis.len() == n, pointer.clone(), || {
                format!("{} numbers given, n = {n} are needed", axis.len())
            })?;
            let largest = axis.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
            ensure((1e-15..=MAX_SIZE).contains(&largest), pointer, || {
                format!(
                    "has {largest:e} as its largest number; it must be from 1e-15 to {MAX_SIZE:e}"
                )
            })?;
        }
        Ok(())
    }
}

impl Condition {
    fn check(&self, at: String, n: usize) -> Result<(), ScenarioError> {
        self.of.check(&format!("{at}/of"), n)?;
        ensure(self.above.is_some() != self.below.is_some(), at, || {
            "needs one of `above` and `below`".into()
        })
    }

    /// Does it hold for a value?
    pub(super) fn holds(&self, x: f64) -> bool {
        self.above.is_some_and(|limit| x > limit) || self.below.is_some_and(|limit| x < limit)
    }
}

impl Measure {
    /// Returns the quantity that is looked at, if it is one.
    pub(super) fn quantity(&self) -> Option<&Quantity> {
        match self {
            Self::Largest(quantity) | Self::Smallest(quantity) | Self::Last(quantity) => {
                Some(quantity)
            }
            Self::FirstTime(condition) | Self::SettledTime(condition) => Some(&condition.of),
            Self::LyapunovExponent(_) => None,
        }
    }

    /// Returns the pointer of its quantity, from its own.
    fn path(&self) -> &'static str {
        match self {
            Self::Largest(_) => "/largest",
            Self::Smallest(_) => "/smallest",
            Self::Last(_) => "/last",
            Self::FirstTime(_) => "/first_time/of",
            Self::SettledTime(_) => "/settled_time/of",
            Self::LyapunovExponent(_) => "/lyapunov_exponent",
        }
    }

    /// Does it need to know where the body points?
    pub(super) fn needs_pointing(&self) -> bool {
        matches!(self.quantity(), Some(Quantity::AxisError))
    }

    fn check(&self, at: &str, n: usize) -> Result<(), ScenarioError> {
        match self {
            Self::Largest(quantity) => quantity.check(&format!("{at}/largest"), n),
            Self::Smallest(quantity) => quantity.check(&format!("{at}/smallest"), n),
            Self::Last(quantity) => quantity.check(&format!("{at}/last"), n),
            Self::FirstTime(condition) => condition.check(format!("{at}/first_time"), n),
            Self::SettledTime(condition) => condition.check(format!("{at}/settled_time"), n),
            Self::LyapunovExponent(Lyapunov { distance, skip_s }) => {
                let at = format!("{at}/lyapunov_exponent");
                ensure((1e-12..=1e-4).contains(distance), format!("{at}/distance"), || {
                    format!("{distance:e} given, a distance must be from 1e-12 to 1e-4")
                })?;
                ensure((0.0..=MAX_SIZE).contains(skip_s), format!("{at}/skip_s"), || {
                    format!("{skip_s:e} given, a time is 0 or more")
                })
            }
        }
    }
}

impl SweepFile {
    /// Checks form and range of all but the scenario; `columns` are those that every table has.
    pub(super) fn check(&self, n: usize, columns: &[String]) -> Result<(), ScenarioError> {
        let Self { vary, seed, scores, picture, keep_logs, .. } = self;
        ensure((1..=MOST_COLUMNS).contains(&vary.len()), "/vary", || {
            format!("{} fields given, 1 to {MOST_COLUMNS} are allowed", vary.len())
        })?;
        ensure(scores.len() <= MOST_COLUMNS, "/scores", || {
            format!("{} given, at most {MOST_COLUMNS} are allowed", scores.len())
        })?;
        ensure(*seed <= LARGEST_SEED, "/seed", || {
            format!("{seed} given, a seed is at most {LARGEST_SEED}")
        })?;
        let mut heads: HashSet<&str> = columns.iter().map(String::as_str).collect();
        let mut pointers = HashSet::new();
        for (at, field) in vary.iter().enumerate() {
            let at = format!("/vary/{at}");
            let Vary { pointer, name, values } = field;
            ensure(
                pointer.starts_with('/')
                    && pointer.len() <= LONGEST_POINTER
                    && !pointer.contains(char::is_control),
                format!("{at}/pointer"),
                || {
                    format!(
                        "{pointer:?} given; a pointer has the form /name/of/field and at most {LONGEST_POINTER} bytes"
                    )
                },
            )?;
            ensure(pointers.insert(pointer), format!("{at}/pointer"), || {
                format!("{pointer} is varied twice")
            })?;
            let place = format!("{at}/{}", if name.is_some() { "name" } else { "pointer" });
            if let Some(name) = name {
                self::name(&place, name)?;
            }
            ensure(heads.insert(field.column()), place, || {
                format!("there is already a column {}", field.column())
            })?;
            values.check(&at)?;
        }
        if let Some(correlation) = &self.correlation {
            correlation.check(vary, self.combine)?;
        }
        for (at, score) in scores.iter().enumerate() {
            let at = format!("/scores/{at}");
            let Score { name, measure, .. } = score;
            self::name(&format!("{at}/name"), name)?;
            ensure(heads.insert(name), format!("{at}/name"), || {
                format!("there is already a column {name}")
            })?;
            measure.check(&format!("{at}/measure"), n)?;
        }
        let exponents = scores.iter().map(|score| &score.measure);
        let exponents =
            exponents.enumerate().filter(|(_, m)| matches!(m, Measure::LyapunovExponent(_)));
        if let Some((at, _)) = exponents.skip(1).last() {
            let message = "is a second Lyapunov exponent; a sweep can have only one";
            return Err(ScenarioError::invalid(format!("/scores/{at}"), message));
        }
        if let Some(column) = picture {
            ensure(heads.contains(column.as_str()), "/picture", || {
                format!("there is no column {column:?}")
            })?;
        }
        ensure(keep_logs.len() <= MOST_LOGS, "/keep_logs", || {
            format!("{} members given, at most {MOST_LOGS} are allowed", keep_logs.len())
        })
    }

    /// Checks of which bodies of a scenario the scores are.
    pub(super) fn check_bodies(&self, base: &Scenario) -> Result<(), ScenarioError> {
        for (at, Score { body, measure, .. }) in self.scores.iter().enumerate() {
            let at = format!("/scores/{at}");
            let refused = |field: &str, message: &str| {
                Err(ScenarioError::invalid(format!("{at}/{field}"), message))
            };
            let Some(scene) = base.bodies() else {
                let message = "is for scenes of several bodies, this one has one";
                return match (body, measure.quantity()) {
                    (Some(_), _) => refused("body", message),
                    (None, Some(Quantity::Distance(_))) => refused("measure", message),
                    _ => continue,
                };
            };
            let of_one = match measure.quantity() {
                Some(Quantity::Tilt(_) | Quantity::AngularSpeed) => true,
                Some(Quantity::KineticEnergy) => false,
                Some(Quantity::Distance(Separation { between, points })) => {
                    let at = format!("{at}/measure{}/distance", measure.path());
                    scene.check_between(&at, between, points.as_ref(), base.dimension())?;
                    false
                }
                Some(Quantity::AxisError) | None => {
                    return refused("measure", "is for scenes of one body");
                }
            };
            match body {
                Some(body) if of_one => {
                    scene.known(&format!("{at}/body"), body)?;
                }
                Some(_) => {
                    return refused("body", "is given, but the measure is not that of one body");
                }
                None if of_one => {
                    let message = "missing field `body`, the name of that whose measure it is";
                    return Err(ScenarioError::invalid(at, message));
                }
                None => {}
            }
        }
        Ok(())
    }

    /// Refuses scores of where the body points if the scenario does not say relative to what.
    pub(super) fn check_pointing(&self, base: &Scenario) -> Result<(), ScenarioError> {
        let asks = self.scores.iter().position(|score| score.measure.needs_pointing());
        let Some(at) = asks.filter(|_| base.pointing.is_none()) else { return Ok(()) };
        let message = "needs to know where the body is to point; give `pointing` in the scenario";
        Err(ScenarioError::invalid(format!("/scores/{at}/measure"), message))
    }

    /// Checks that something is left of the runs for the exponent, where all last as long as that
    /// of the scenario.
    pub(super) fn check_skips(&self, base: &Scenario) -> Result<(), ScenarioError> {
        let lasting = ["/step_s", "/steps", "/duration_s"];
        let duration_s = base.duration_s.or_else(|| Some(base.steps? as f64 * base.step_s?));
        let Some(duration_s) = duration_s else { return Ok(()) };
        if self.vary.iter().any(|field| lasting.contains(&field.pointer.as_str())) {
            return Ok(());
        }
        for (at, score) in self.scores.iter().enumerate() {
            let Measure::LyapunovExponent(Lyapunov { skip_s, .. }) = &score.measure else {
                continue;
            };
            let at = format!("/scores/{at}/measure/lyapunov_exponent/skip_s");
            ensure(*skip_s < duration_s, at, || {
                format!(
                    "{skip_s:e} given, a time below the {duration_s} s that the runs last is needed"
                )
            })?;
        }
        Ok(())
    }

    /// Returns whether a Lyapunov exponent is asked for.
    #[cfg(feature = "serve")]
    pub(super) fn has_exponent(&self) -> bool {
        self.scores.iter().any(|score| matches!(score.measure, Measure::LyapunovExponent(_)))
    }

    /// Returns the number of members.
    pub(super) fn members(&self) -> Result<u64, ScenarioError> {
        let counts: Vec<u64> = self.vary.iter().map(|field| field.values.count()).collect();
        match self.combine {
            Combine::Product => {
                let product = counts.iter().try_fold(1_u64, |product, &count| {
                    product.checked_mul(count).filter(|&members| members <= MOST_MEMBERS)
                });
                product.ok_or_else(|| {
                    let counts: Vec<String> = counts.iter().map(u64::to_string).collect();
                    let message = format!(
                        "{} values make more than {MOST_MEMBERS} members",
                        counts.join(" x ")
                    );
                    ScenarioError::invalid("/vary", message)
                })
            }
            Combine::SideBySide => {
                let count = counts[0];
                let other = counts.iter().position(|&other| other != count);
                other.map_or(Ok(count), |at| {
                    let message = format!(
                        "has {} values, but the first field has {count}; with `side_by_side` all must have the same number",
                        counts[at]
                    );
                    Err(ScenarioError::invalid(format!("/vary/{at}/values"), message))
                })
            }
            Combine::Saltelli => {
                for (at, (field, &count)) in self.vary.iter().zip(&counts).enumerate() {
                    let random = matches!(field.values, Values::Uniform(_) | Values::Normal(_));
                    let first = counts[0];
                    let fits = random && count == first && count % 2 == 0;
                    ensure(fits, format!("/vary/{at}/values"), || {
                        format!(
                            "has {count} values; with `saltelli` each field has an even number of values, the same for all ({first}), `uniform` or `normal`"
                        )
                    })?;
                }
                let members = counts[0] / 2 * (counts.len() as u64 + 2);
                ensure(members <= MOST_MEMBERS, "/vary", || {
                    format!(
                        "{} values of {} fields make {members} members, at most {MOST_MEMBERS} are allowed",
                        counts[0],
                        counts.len()
                    )
                })?;
                Ok(members)
            }
        }
    }
}

fn name(at: &str, name: &str) -> Result<(), ScenarioError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
    ensure((1..=64).contains(&name.len()) && name.chars().all(plain), at, || {
        format!("{name:?} given; a name has 1 to 64 letters, digits or _")
    })
}
