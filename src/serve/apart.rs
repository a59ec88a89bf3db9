//! Errands in a process of their own: for jobs and studies during which the service ended before.
//! If they caused that, they now end this process, and the service sees it; if not, nothing happens
//! to them.
//!
//! ```text
//! service ── errand, one line of JSON; then c (cancel) or i (interrupt) ──→ child
//!         ←── progress, lines of JSON; at last the result ──────────────────
//! ```
//!
//! Invariants: a child does not outlive the service. Only a death that the service saw, and that no signal to stop
//! caused, counts against an errand.

use std::fs;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::errand::{Broken, Done, Errand};
use super::job::{Fault, Trouble};
use crate::run::Control;

/// The subcommand of the program that carries out an errand.
pub(crate) const SUBCOMMAND: &str = "apart";

/// Interval at which the two sides exchange messages.
const BEAT: Duration = Duration::from_millis(50);

/// An errand that ends its process at the same step this many times in a row is abandoned.
const MAX_DEATHS_AT_ONE_PLACE: u32 = 3;

/// An errand is abandoned after this many processes in a row that ended without further progress,
/// wherever that was.
pub(super) const MAX_FRUITLESS: u32 = 20;

/// Message of a child.
#[derive(Debug, Serialize, Deserialize)]
enum Line {
    Progress { steps_done: u64, resumed_step: u64, durable_step: u64, durable_bytes: u64 },
    End(Result<Done, Broken>),
}

/// The deaths of an errand's processes.
#[derive(Debug, Default)]
struct Deaths {
    last: Option<u64>,
    furthest: u64,
    at_one_place: u32,
    fruitless: u32,
}

impl Deaths {
    /// Takes note of a death at a step.
    fn add(&mut self, step: u64) {
        self.at_one_place = if self.last == Some(step) { self.at_one_place + 1 } else { 1 };
        self.fruitless = if step > self.furthest { 1 } else { self.fruitless + 1 };
        self.furthest = self.furthest.max(step);
        self.last = Some(step);
    }

    /// Returns whether the errand itself is to blame.
    fn convict(&self) -> bool {
        self.at_one_place >= MAX_DEATHS_AT_ONE_PLACE || self.fruitless >= MAX_FRUITLESS
    }
}

/// Carries out an errand in processes of its own, until one returns or the errand is found to end
/// them. Blocks.
pub(super) fn carry_out(
    program: &Path,
    errand: &Errand,
    control: &Control,
    max_deaths: Option<u32>,
) -> Result<Done, Broken> {
    let mut deaths = Deaths::default();
    loop {
        match in_a_child(program, errand, control) {
            Ok(Ended::Back(result)) => return result,
            Ok(Ended::Died(status)) => {
                if control.interrupted.load(Ordering::Relaxed) {
                    return Err(Broken::Stopped);
                }
                if asked_to_stop(status) {
                    continue;
                }
                let step = traced(errand);
                deaths.add(step);
                tracing::error!(%status, step, deaths = deaths.fruitless, "the separate process of a job or a study ended");
                let worn_out = max_deaths.is_some_and(|most| deaths.fruitless >= most);
                if worn_out || deaths.convict() {
                    return Err(Broken::Fault(Fault::worker_crashed()));
                }
            }
            Err(error) if crate::log::is_transient(&error) => {
                let message = format!("the service could not start a process: {error}");
                return Err(Broken::Trouble(Trouble::new("storage_error", message)));
            }
            Err(error) => {
                tracing::error!(%error, "no separate process can be started; it is computed in this one");
                return errand.carry_out(control);
            }
        }
    }
}

/// Returns the last step that a run has noted.
fn traced(errand: &Errand) -> u64 {
    let Errand::Run { trace: Some(trace), .. } = errand else { return 0 };
    let noted = fs::read(trace).ok().and_then(|bytes| bytes.try_into().ok());
    noted.map_or(0, u64::from_le_bytes)
}

/// Returns whether a process ended because it was asked to, and not by what it did.
fn asked_to_stop(status: ExitStatus) -> bool {
    #[cfg(unix)]
    {
        use rustix::process::Signal;
        let signal = std::os::unix::process::ExitStatusExt::signal(&status);
        [Signal::TERM, Signal::INT, Signal::HUP].iter().any(|stop| signal == Some(stop.as_raw()))
    }
    #[cfg(not(unix))]
    {
        let _ = status;
        false
    }
}

/// End of a child.
enum Ended {
    Back(Result<Done, Broken>),
    Died(ExitStatus),
}

fn in_a_child(program: &Path, errand: &Errand, control: &Control) -> io::Result<Ended> {
    let mut command = Command::new(program);
    command.arg(SUBCOMMAND).stdin(Stdio::piped()).stdout(Stdio::piped());
    // A stop from the terminal is for the service.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut child = command.spawn()?;
    let over = AtomicBool::new(false);
    let end = thread::scope(|scope| {
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
        scope.spawn(|| pass_on(stdin, errand, control, &over));
        let end = stdout.and_then(|stdout| listen(stdout, control));
        over.store(true, Ordering::Relaxed);
        end
    });
    let status = reaped(&mut child, end.is_some())?;
    Ok(end.map_or(Ended::Died(status), Ended::Back))
}

/// Returns how a child ended; one that sent its last message has nothing more to do.
fn reaped(child: &mut Child, has_ended: bool) -> io::Result<ExitStatus> {
    if has_ended {
        let _ = child.kill();
    }
    child.wait()
}

/// Sends the errand, and then the signals that arrive here. A child that has ended receives
/// nothing.
fn pass_on(stdin: Option<ChildStdin>, errand: &Errand, control: &Control, over: &AtomicBool) {
    let Some(mut stdin) = stdin else { return };
    let Ok(mut text) = serde_json::to_vec(errand) else { return };
    text.push(b'\n');
    if stdin.write_all(&text).is_err() {
        return;
    }
    let words = [(&control.cancelled, b"c"), (&control.interrupted, b"i")];
    let mut said = [false; 2];
    while !over.load(Ordering::Relaxed) {
        for ((flag, word), said) in words.iter().zip(&mut said) {
            if !*said && flag.load(Ordering::Relaxed) {
                *said = true;
                let _ = stdin.write_all(*word);
            }
        }
        thread::sleep(BEAT);
    }
}

/// Follows the messages of a child to their end; `None` if it ends without a result.
fn listen(stdout: impl Read, control: &Control) -> Option<Result<Done, Broken>> {
    for line in BufReader::new(stdout).lines() {
        match serde_json::from_slice(line.ok()?.as_bytes()).ok()? {
            Line::Progress { steps_done, resumed_step, durable_step, durable_bytes } => {
                control.steps_done.store(steps_done, Ordering::Relaxed);
                control.resumed_step.store(resumed_step, Ordering::Relaxed);
                control.durable_bytes.store(durable_bytes, Ordering::Release);
                control.durable_step.store(durable_step, Ordering::Release);
            }
            Line::End(result) => return Some(result),
        }
    }
    None
}

/// Runs the child: reads an errand from stdin, carries it out and writes the result to stdout.
///
/// # Errors
/// If stdin holds no errand or stdout is closed.
pub(crate) fn child() -> io::Result<()> {
    // The service may have no time to announce that it ends.
    #[cfg(target_os = "linux")]
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::KILL))?;
    let mut text = String::new();
    let mut stdin = BufReader::new(io::stdin());
    stdin.read_line(&mut text)?;
    let errand: Errand = serde_json::from_slice(text.as_bytes())?;
    let control = Control { trace: errand.trace(), ..Control::default() };
    let control = std::sync::Arc::new(control);
    let hearing = control.clone();
    thread::spawn(move || hear(stdin, &hearing));
    let over = AtomicBool::new(false);
    let end = thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                thread::sleep(BEAT);
                // There is no reader: the service is gone, and `hear` knows it.
                let _ = say(&progress(&control));
            }
        });
        let end = catch_unwind(AssertUnwindSafe(|| errand.carry_out(&control)));
        over.store(true, Ordering::Relaxed);
        end
    });
    say(&progress(&control))?;
    say(&Line::End(end.unwrap_or_else(|_| Err(Broken::Fault(Fault::panicked())))))
}

fn progress(control: &Control) -> Line {
    Line::Progress {
        steps_done: control.steps_done.load(Ordering::Relaxed),
        resumed_step: control.resumed_step.load(Ordering::Relaxed),
        // Loaded before its bytes, of which there are then enough.
        durable_step: control.durable_step.load(Ordering::Acquire),
        durable_bytes: control.durable_bytes.load(Ordering::Acquire),
    }
}

fn say(line: &Line) -> io::Result<()> {
    let mut text = serde_json::to_vec(line)?;
    text.push(b'\n');
    let mut out = io::stdout().lock();
    out.write_all(&text)?;
    out.flush()
}

/// Follows the messages of the service; if there are no more, it is gone.
fn hear(stdin: impl BufRead, control: &Control) {
    for word in stdin.bytes() {
        match word {
            Ok(b'c') => control.cancel(),
            Ok(_) => control.interrupt(),
            Err(_) => break,
        }
    }
    control.interrupt();
}

#[cfg(test)]
mod tests {
    use super::Deaths;

    fn after(steps: impl IntoIterator<Item = u64>) -> bool {
        let mut deaths = Deaths::default();
        steps.into_iter().for_each(|step| deaths.add(step));
        deaths.convict()
    }

    #[test]
    fn three_deaths_at_one_step_convict_and_twenty_without_progress() {
        assert!(!after([7, 7]));
        assert!(after([7, 7, 7]));
        assert!(!after([7, 7, 8, 8, 7, 7]));
        // Each process came further than all before.
        assert!(!after(1..100));
        // The step goes up and down, and never further.
        assert!(!after((0..19).map(|k| 9 - k % 2)));
        assert!(after((0..21).map(|k| 9 - k % 2)));
    }
}
