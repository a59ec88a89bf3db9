//! What is done for a job or a study away from those who ask: in this process, or in one of its own (`apart`).
//!
//! Invariant: an errand takes all it needs with it and gives all it found back, so that it does not matter where it is
//! carried out.

use std::fs::File;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::chain;
use super::job::{Fault, Trouble};
use super::store::{Settled, StoreError};
use super::studies::{Answer, Question, Unanswered};
use crate::advise;
use crate::plan::Plan;
use crate::run::{Control, JobContext, RunError, Summary, execute_planned, give_up};
use crate::scenario::{Scenario, ScenarioError};

/// Something to be done.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Errand {
    /// Find a method and a step for an accuracy.
    Settle(Task),
    /// Run a job to its end.
    Run {
        task: Task,
        /// Where its log goes.
        log: PathBuf,
        /// Where the run leaves a note of each step.
        trace: Option<PathBuf>,
    },
    /// Give the log of a job that is run no more an end.
    GiveUp {
        task: Task,
        log: PathBuf,
        /// Why.
        fault: Fault,
    },
    /// Make a study.
    Study {
        /// The request, as it was sent.
        request: String,
    },
}

/// A scenario as accepted, and what its accuracy came to.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Task {
    scenario: String,
    settled: Option<Settled>,
}

/// What came of an errand.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Done {
    Settled(Settled),
    Ran(Box<Summary>),
    Studied(Answer),
}

/// Why nothing came of it.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Broken {
    /// The job has failed.
    Fault(Fault),
    /// Somebody stopped it.
    Stopped,
    /// The store refuses something for now.
    Trouble(Trouble),
    /// The record cannot be used; nobody knows whether for good.
    Aside(Fault),
    /// The study has no answer, for a person.
    Unanswered(String),
}

impl From<Fault> for Broken {
    fn from(fault: Fault) -> Self {
        Self::Fault(fault)
    }
}

impl From<StoreError> for Broken {
    fn from(error: StoreError) -> Self {
        let told = chain(&error);
        if error.is_transient() {
            Self::Trouble(Trouble::new(error.code(), format!("the service {error}")))
        } else {
            tracing::error!(error = told, "record unusable");
            Self::Aside(Fault::damaged(Some(&error)))
        }
    }
}

impl Task {
    pub(super) fn new(scenario: &[u8], settled: Option<Settled>) -> Self {
        Self { scenario: String::from_utf8_lossy(scenario).into_owned(), settled }
    }

    /// The scenario as accepted.
    pub(super) fn scenario(&self) -> Result<Scenario, Fault> {
        Scenario::from_json(self.scenario.as_bytes()).map_err(|error| Fault::rejected(&error))
    }

    /// The plan, if method and step are settled.
    pub(super) fn plan(&self, scenario: &Scenario) -> Result<Option<Plan>, Fault> {
        let planned = match (&scenario.accuracy, &self.settled) {
            (None, _) => advise::plan_of(scenario, None),
            (Some(_), None) => return Ok(None),
            (Some(_), Some(settled)) => Scenario::from_json(settled.scenario())
                .and_then(|scenario| advise::plan_of(&scenario, Some(settled.advice.clone()))),
        };
        planned.map(Some).map_err(|error| Fault::rejected(&error))
    }

    fn planned(&self) -> Result<(Scenario, Plan), Broken> {
        let scenario = self.scenario()?;
        let plan = match self.plan(&scenario)? {
            Some(plan) => plan,
            None => Plan::new(&scenario).map_err(|error| Fault::rejected(&error))?,
        };
        Ok((scenario, plan))
    }
}

impl Errand {
    /// Does it.
    pub(super) fn carry_out(&self, control: &Control) -> Result<Done, Broken> {
        match self {
            Self::Settle(task) => settle(task, control),
            Self::Run { task, log, .. } => {
                let (scenario, plan) = task.planned()?;
                let ran = execute_planned(&scenario, &plan, &JobContext { log, control });
                ran.map(|summary| Done::Ran(Box::new(summary))).map_err(|error| broken(&error))
            }
            Self::GiveUp { task, log, fault } => {
                let (scenario, plan) = task.planned()?;
                let ended = give_up(&scenario, &plan, log, fault.reason());
                ended.map(|summary| Done::Ran(Box::new(summary))).map_err(|error| broken(&error))
            }
            Self::Study { request } => {
                let unanswered = |error: String| Broken::Unanswered(error);
                let question = Question::from_json(request.as_bytes());
                let question = question.map_err(|error| unanswered(error.to_string()))?;
                match question.answer(&control.settling) {
                    Ok(answer) => Ok(Done::Studied(answer)),
                    Err(Unanswered::Study(crate::study::StudyError::Cancelled)) => {
                        Err(Broken::Stopped)
                    }
                    Err(error) => Err(unanswered(error.to_string())),
                }
            }
        }
    }

    /// The file for the notes of each step, made anew.
    pub(super) fn trace(&self) -> Option<File> {
        match self {
            Self::Run { trace, .. } => File::create(trace.as_ref()?).ok(),
            _ => None,
        }
    }
}

fn settle(task: &Task, control: &Control) -> Result<Done, Broken> {
    let scenario = task.scenario()?;
    let (settled, advice) = advise::settled(&scenario, &control.settling)
        .map_err(|error| Fault::unsettled(&error).map_or(Broken::Stopped, Broken::Fault))?;
    let missing = || ScenarioError::invalid("/accuracy", "is missing: there is nothing to settle");
    let settled = advice.and_then(|advice| Settled::new(&settled, advice).ok());
    Ok(Done::Settled(settled.ok_or_else(|| Fault::rejected(&missing()))?))
}

fn broken(error: &RunError) -> Broken {
    match error {
        RunError::Interrupted => Broken::Stopped,
        RunError::Log(error) if error.is_transient() => {
            let message = "the service could not write the log".to_owned();
            Broken::Trouble(Trouble::new(error.code(), message))
        }
        RunError::Log(error) if error.code() == "storage_error" => {
            tracing::error!(error = chain(error), "log out of reach");
            Broken::Aside(Fault::damaged(None))
        }
        error => {
            tracing::error!(error = chain(error), "run broke off");
            Broken::Fault(Fault::run(error))
        }
    }
}
