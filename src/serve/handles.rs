//! File handles: how many the system grants, and how many of them connections may take.
//!
//! Invariant: whatever comes in from outside, the store and each worker can still open what they need. A job that was
//! accepted does not fail for want of a handle.

use super::listen::REFUSALS;
use super::{Limits, viewers};

/// Handles for the store, the listeners, the service's own log and everything else.
const STORE: u64 = 64;

/// Handles of a worker: its log, its record, what it syncs.
const WORKER: u64 = 16;

/// Handles of a connection: its socket, and the file that it reads.
const CONNECTION: u64 = 2;

/// Connections that are granted in any case: fewer are of no use.
const FEWEST: usize = 16;

/// Returns the limits with as many connections as the handles carry; says so if those are fewer
/// than were asked for.
pub(super) fn within(limits: Limits, workers: usize, with_viewers: bool) -> Limits {
    let Some(granted) = raised() else { return limits };
    let viewers = if with_viewers { viewers::SEATS as u64 } else { 0 };
    let connections = connections(granted, workers as u64, viewers).min(limits.connections);
    if connections < limits.connections {
        let asked = limits.connections;
        tracing::warn!(
            granted,
            asked,
            connections,
            "fewer connections: the limit of file handles is low"
        );
    }
    Limits { connections, ..limits }
}

/// Returns the number of connections that `granted` handles carry in addition to the workers and
/// viewers.
fn connections(granted: u64, workers: u64, viewers: u64) -> usize {
    let kept = STORE.saturating_add(WORKER.saturating_mul(workers)).saturating_add(viewers);
    let free = granted.saturating_sub(kept);
    // For each four of them one more may be refused with an answer, up to a number.
    let few = free / (4 * CONNECTION + 1) * 4;
    let carried = few.max(free.saturating_sub(REFUSALS as u64) / CONNECTION);
    usize::try_from(carried).unwrap_or(usize::MAX).max(FEWEST)
}

/// Raises the limit of this process as far as it may and returns it; `None` if there is no limit.
#[cfg(unix)]
fn raised() -> Option<u64> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current == maximum {
        return current;
    }
    match setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
        Ok(()) => maximum,
        Err(error) => {
            tracing::warn!(%error, "the limit of file handles cannot be raised");
            current
        }
    }
}

#[cfg(not(unix))]
fn raised() -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::super::listen::refusals;
    use super::connections;

    #[test]
    fn connections_leave_what_the_store_and_the_workers_need() {
        for granted in 0..5000 {
            for workers in [1, 2, 8, 64] {
                for viewers in [0, 64] {
                    let carried = connections(granted, workers, viewers);
                    let taken = 2 * carried as u64 + refusals(carried) as u64;
                    let left = granted.saturating_sub(taken + viewers);
                    assert!(carried == 16 || left >= 64 + 16 * workers, "{granted} {workers}");
                    // They are not fewer than that either.
                    let more = granted.saturating_sub(taken + 9 + viewers);
                    assert!(more < 64 + 16 * workers, "{granted} {workers}");
                }
            }
        }
        assert_eq!(connections(256, 2, 0), 68);
        assert_eq!(connections(u64::MAX, u64::MAX, 64), 16);
    }
}
