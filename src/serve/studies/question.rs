//! Requests for studies, and the making of their answers.
//!
//! Invariant: a [`Question`] can be carried out: a request of a client is checked as a scenario is,
//! with the pointer of the field at fault.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::chart::{self, ChartError};
use crate::scenario::{Method, Scenario, ScenarioError};
use crate::study::long_term::long_term;
use crate::study::precision::precision;
use crate::study::stability::stability;
use crate::study::table::Table;
use crate::study::{Entry, StudyError, Watch, all_methods, tell_apart, usual_methods};
use crate::sweep::{self, Options, Sweep, SweepError, SweepFile};

/// Most methods of a study.
const MAX_METHODS: usize = 40;
/// Most steps of a run of a long-term study: all methods make them.
const MAX_STEPS: u64 = 1_000_000;

/// The table of a study; that of a sweep is a file next to its record.
pub(super) const TABLE: &str = "table.csv";
/// The picture of a sweep.
pub(super) const PICTURE: &str = "sweep.svg";

/// Kind of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[schemars(rename = "StudyKind")]
pub(in crate::serve) enum Kind {
    /// Error against step and work.
    Precision,
    /// Energy and orthogonality over the scenario's run.
    LongTerm,
    /// Map of where each method fails.
    Stability,
    /// Many runs over fields of the scenario.
    Sweep,
}

/// Request of a client.
#[derive(JsonSchema)]
#[schemars(untagged, rename = "StudyRequest")]
#[expect(dead_code, reason = "only its schema is used")]
pub(in crate::serve) enum Body {
    /// A study of methods.
    Methods(Request),
    /// A sweep, as in a file, that holds its scenario.
    Sweep(Box<SweepFile>),
}

/// The kinds of a study of methods.
#[derive(JsonSchema)]
#[serde(rename_all = "snake_case")]
#[expect(dead_code, reason = "only its schema is used")]
enum MethodsKind {
    /// Error against step and work.
    Precision,
    /// Energy and orthogonality over the scenario's run.
    LongTerm,
    /// Map of where each method fails.
    Stability,
}

/// A study of methods on a scenario.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "MethodsRequest")]
pub(in crate::serve) struct Request {
    /// Kind of the study.
    #[schemars(with = "MethodsKind")]
    kind: Kind,
    /// The scenario, as of a job.
    #[schemars(with = "Scenario")]
    scenario: Value,
    /// The methods, as in a scenario; the usual ones if absent.
    #[serde(default)]
    methods: Vec<Method>,
    /// Precision: compare the errors at this time, in seconds; after about one turn if absent.
    #[serde(default)]
    until_s: Option<f64>,
}

/// A request that can be carried out.
#[derive(Clone, Debug)]
pub(in crate::serve) enum Question {
    /// A study of methods.
    Methods(Box<Methods>),
    /// Many runs over fields of a scenario.
    Sweep(Box<Sweep>),
}

/// A study of methods that can be made.
#[derive(Clone, Debug)]
pub(in crate::serve) struct Methods {
    kind: Kind,
    scene: Scenario,
    entries: Vec<Entry>,
    until_s: Option<f64>,
}

impl Question {
    /// Reads and checks a request.
    pub(in crate::serve) fn from_json(text: &[u8]) -> Result<Self, ScenarioError> {
        let tree = crate::scenario::read_tree(text)?;
        if tree["kind"] != "sweep" {
            return Ok(Self::Methods(Box::new(Methods::from_tree(tree)?)));
        }
        let sweep = Sweep::from_tree(tree)?;
        if sweep.kept_logs().is_empty() {
            return Ok(Self::Sweep(Box::new(sweep)));
        }
        let message =
            "is only for `vpd sweep`; on the service, run a member as a job to get its log";
        Err(ScenarioError::invalid("/keep_logs", message))
    }

    pub(super) fn kind(&self) -> Kind {
        match self {
            Self::Methods(methods) => methods.kind,
            Self::Sweep(_) => Kind::Sweep,
        }
    }

    /// Returns the name of its scenario.
    pub(in crate::serve) fn name(&self) -> &str {
        match self {
            Self::Methods(methods) => methods.scene.name(),
            Self::Sweep(sweep) => sweep.name(),
        }
    }

    /// Makes the study; the table of a sweep is written into `folder`, where that of an interrupted
    /// one is resumed.
    ///
    /// # Errors
    /// If the scene cannot be studied, the table cannot be written, or the study is cancelled.
    pub(in crate::serve) fn answer(
        &self,
        watch: &Watch,
        folder: &Path,
    ) -> Result<Answer, Unanswered> {
        match self {
            Self::Methods(methods) => methods.answer(watch),
            Self::Sweep(sweep) => swept(sweep, watch, &folder.join(TABLE)),
        }
    }
}

/// Runs a sweep, unless its table is finished, and draws it.
fn swept(sweep: &Sweep, watch: &Watch, table: &Path) -> Result<Answer, Unanswered> {
    // Nothing else writes here: a file that is there is of this sweep, or of an older build.
    if !table.is_file() {
        let options = Options { threads: sweep::cores(), shard: None, replaces: true };
        sweep::run(sweep, table, options, watch, |_| Ok::<(), SweepError>(()))?;
    }
    let picture = chart::sweep(&sweep.shown(table, None)?)?;
    Ok(Answer { files: named(vec![(PICTURE, picture)]), ..Answer::default() })
}

impl Methods {
    /// Reads and checks a request.
    fn from_tree(tree: Value) -> Result<Self, ScenarioError> {
        let Request { kind, scenario, methods, until_s } = crate::scenario::from_tree(tree)?;
        let within = |place: String| {
            move |error: ScenarioError| ScenarioError {
                pointer: format!("{place}{}", error.pointer),
                ..error
            }
        };
        let text = scenario.to_string();
        let scene = Scenario::from_json(text.as_bytes()).map_err(within("/scenario".to_owned()))?;
        let refuse = |wrong: bool, pointer: &str, message: String| {
            if wrong { Err(ScenarioError::invalid(pointer, message)) } else { Ok(()) }
        };
        let steps = scene.step_count();
        refuse(
            kind == Kind::LongTerm && !(1..=MAX_STEPS).contains(&steps),
            "/scenario/steps",
            format!("{steps} steps, 1 to {MAX_STEPS} are allowed in a long-term study"),
        )?;
        refuse(
            scene.accuracy.is_some(),
            "/scenario/accuracy",
            "is not allowed in a study, which serves to choose a method and a step; give `method` and `step_s`".to_owned(),
        )?;
        refuse(
            methods.len() > MAX_METHODS,
            "/methods",
            format!("{} given, at most {MAX_METHODS} are allowed", methods.len()),
        )?;
        refuse(
            until_s.is_some_and(|until_s| !(until_s > 0.0 && until_s <= 1e9)),
            "/until_s",
            format!(
                "{:?} given, a time above 0 and up to 1e9 s is needed",
                until_s.unwrap_or_default()
            ),
        )?;
        let mut entries = match (methods.is_empty(), kind) {
            (true, Kind::Stability) => all_methods(&scene),
            (true, _) => usual_methods(&scene),
            (false, _) => methods
                .into_iter()
                .enumerate()
                .map(|(at, method)| {
                    Entry::new(&scene, method).map_err(|error| {
                        let pointer =
                            error.pointer.replacen("/method", &format!("/methods/{at}"), 1);
                        ScenarioError { pointer, ..error }
                    })
                })
                .collect::<Result<Vec<_>, _>>()?,
        };
        tell_apart(&mut entries);
        Ok(Self { kind, scene, entries, until_s })
    }

    /// Makes the study.
    ///
    /// # Errors
    /// If the scene cannot be studied, or the study is cancelled.
    fn answer(&self, watch: &Watch) -> Result<Answer, Unanswered> {
        let Self { kind, scene, entries, until_s } = self;
        let name = scene.name();
        let mut answer = Answer::default();
        let table: Table = match kind {
            Kind::Precision => {
                let study = precision(scene, entries, *until_s, watch)?;
                let known = &study.reference;
                answer.reference = Some([known.time_s, known.error, known.cross_check]);
                answer.files = named(chart::precision(name, entries, &study)?);
                study.table
            }
            Kind::LongTerm => {
                let study = long_term(scene, entries, watch)?;
                answer.files = named(chart::long_term(name, entries, &study)?);
                study.table
            }
            Kind::Stability => {
                let map = stability(scene, entries, watch)?;
                answer.files = named(vec![("stability.svg", chart::stability_map(name, &map)?)]);
                answer.borders = json(&map.borders);
                map.table()
            }
            Kind::Sweep => unreachable!("a sweep is a question of its own"),
        };
        answer.files.push((TABLE.to_owned(), table.to_csv()));
        answer.rows = json(&table.rows);
        Ok(answer)
    }
}

/// Results of a study, as they are kept and shown: rows and borders are plain JSON, so that a newer
/// build can show those that an older one found.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(in crate::serve) struct Answer {
    /// File name and content.
    pub(super) files: Vec<(String, String)>,
    pub(super) rows: Vec<Value>,
    pub(super) borders: Vec<Value>,
    /// Time, stated error and cross-check of the reference.
    pub(super) reference: Option<[f64; 3]>,
}

#[derive(Debug, thiserror::Error)]
pub(in crate::serve) enum Unanswered {
    #[error(transparent)]
    Study(#[from] StudyError),
    #[error(transparent)]
    Chart(#[from] ChartError),
    #[error(transparent)]
    Sweep(#[from] SweepError),
}

fn named(files: Vec<(&str, String)>) -> Vec<(String, String)> {
    files.into_iter().map(|(name, text)| (name.to_owned(), text)).collect()
}

fn json(rows: &[impl Serialize]) -> Vec<Value> {
    rows.iter().filter_map(|row| serde_json::to_value(row).ok()).collect()
}
