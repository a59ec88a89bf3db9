//! The samples of a log one after another, each with all that its channels say of it: for tables and comparisons.
//!
//! Invariant: one row a sample, in the order of time; memory for one at a time.

use std::ops::ControlFlow;
use std::path::Path;

use super::LogError;
pub use super::messages::Row;
use super::order::read_by_time;
use super::reader::{Ending, Item, Message};
use super::schema::Topic;

/// Shows the samples of a run, or of a member of an ensemble (a run is member 0), to `visit`, until that breaks off.
///
/// Damage is no error: it ends the reading and is reported in the [`Ending`].
///
/// # Errors
/// If the file cannot be opened or read.
pub fn read_rows(
    path: &Path,
    member: u64,
    mut visit: impl FnMut(Row) -> ControlFlow<()>,
) -> Result<Ending, LogError> {
    let mut open: Option<(u32, Row)> = None;
    let mut stopped = false;
    let ending = read_by_time(path, |item| {
        let Item::Message { topic, schema, time_ns, sequence, data } = item else {
            return ControlFlow::Continue(());
        };
        let topic = Topic::parse(topic).filter(|topic| topic.member == member);
        let decoded = |topic: Topic| {
            Message::decode(topic.channel.topic(), schema, data).map(|message| (topic, message))
        };
        let Some((topic, message)) = topic.and_then(decoded) else {
            return ControlFlow::Continue(());
        };
        // Some programs number messages anew, each topic by itself.
        if let Some((number, row)) = &mut open
            && row.time_ns == time_ns
            && (*number == sequence || !row.holds(topic))
        {
            row.take_in(topic.body, message);
            return ControlFlow::Continue(());
        }
        let mut row = Row { time_ns, ..Row::default() };
        row.take_in(topic.body, message);
        match open.replace((sequence, row)) {
            Some((_, whole)) => {
                let flow = visit(whole);
                stopped = flow.is_break();
                flow
            }
            None => ControlFlow::Continue(()),
        }
    })?;
    if !stopped && let Some((_, row)) = open {
        // Nothing comes after it.
        let _ = visit(row);
    }
    Ok(ending)
}
