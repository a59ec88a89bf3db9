//! Work for a job or a study away from the threads that answer: in this process, or in one of its
//! own (`apart`).
//!
//! Invariant: an errand takes all it needs with it and gives all it found back, so that it does not matter where it is
//! carried out.

use std::fs::File;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::chain;
use super::job::{Fault, Trouble};
use super::store::StoreError;
use super::studies::{Answer, Question, Unanswered};
use crate::advise::Settled;
use crate::log::is_transient;
use crate::run::{Control, JobContext, RunError, Summary, execute, give_up};
use crate::scenario::Scenario;
use crate::study::StudyError;
use crate::sweep::SweepError;

/// Work to be done.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Errand {
    /// Find what only runs can show of a scenario: a method and a step for its accuracy, the work
    /// of its steps.
    Settle {
        /// The scenario, as accepted.
        scenario: Box<Scenario>,
    },
    /// Run a job to its end.
    Run {
        settled: Box<Settled>,
        /// Path of its log.
        log: PathBuf,
        /// File in which the run leaves a note of each step.
        trace: Option<PathBuf>,
    },
    /// End the log of a job that is run no more.
    GiveUp {
        settled: Box<Settled>,
        log: PathBuf,
        /// Reason for that.
        fault: Fault,
    },
    /// Make a study.
    Study {
        /// The request, as it was sent.
        request: String,
        /// Folder for the table of a sweep.
        folder: PathBuf,
    },
}

/// Result of an errand.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Done {
    Settled(Box<Settled>),
    Ran(Box<Summary>),
    Studied(Answer),
}

/// Reason why there is no result.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Broken {
    /// The job has failed.
    Fault(Fault),
    /// It was cancelled.
    Stopped,
    /// The store refuses something for now.
    Trouble(Trouble),
    /// The record cannot be used; whether for good is unknown.
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
        let reported = chain(&error);
        if error.is_transient() {
            Self::Trouble(Trouble::new(error.code(), format!("the service {error}")))
        } else {
            tracing::error!(error = reported, "record unusable");
            Self::Aside(Fault::damaged(Some(&error)))
        }
    }
}

impl Errand {
    /// Carries out the errand.
    pub(super) fn carry_out(&self, control: &Control) -> Result<Done, Broken> {
        match self {
            Self::Settle { scenario } => match Settled::new(scenario, &control.settling) {
                Ok(settled) => Ok(Done::Settled(Box::new(settled))),
                Err(error) => Err(Fault::unsettled(&error).map_or(Broken::Stopped, Broken::Fault)),
            },
            Self::Run { settled, log, .. } => {
                let plan = settled.plan().map_err(|error| Fault::rejected(&error))?;
                let ran = execute(&plan, &JobContext { log, control });
                ran.map(|summary| Done::Ran(Box::new(summary))).map_err(|error| broken(&error))
            }
            Self::GiveUp { settled, log, fault } => {
                let plan = settled.plan().map_err(|error| Fault::rejected(&error))?;
                let ended = give_up(&plan, log, fault.reason());
                ended.map(|summary| Done::Ran(Box::new(summary))).map_err(|error| broken(&error))
            }
            Self::Study { request, folder } => {
                let unanswered = |error: String| Broken::Unanswered(error);
                let question = Question::from_json(request.as_bytes());
                let question = question.map_err(|error| unanswered(error.to_string()))?;
                match question.answer(&control.settling, folder) {
                    Ok(answer) => Ok(Done::Studied(answer)),
                    Err(
                        Unanswered::Study(StudyError::Cancelled)
                        | Unanswered::Sweep(SweepError::Interrupted { .. }),
                    ) => Err(Broken::Stopped),
                    Err(Unanswered::Sweep(SweepError::Io { source, .. }))
                        if is_transient(&source) =>
                    {
                        let message = "the service could not write the table".to_owned();
                        Err(Broken::Trouble(Trouble::new("storage_error", message)))
                    }
                    Err(error) => Err(unanswered(error.to_string())),
                }
            }
        }
    }

    /// Returns the file for the notes of each step, made anew.
    pub(super) fn trace(&self) -> Option<File> {
        match self {
            Self::Run { trace, .. } => File::create(trace.as_ref()?).ok(),
            _ => None,
        }
    }
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
