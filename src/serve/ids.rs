//! Ids of jobs and studies, and the time of day.
//!
//! Invariant: the order of the ids of a record is the order in which it took them, whatever the clock of the machine did in
//! between; an id also holds the time that the clock showed. No time of day is too early to be told.
//!
//! ```text
//! number in the record: 48 bits | version 8 and 12 random bits | variant and 14 random bits | time: 48 bits, in ms
//! ```
//!
//! The number is the time, or one more than the last number if that is larger. Ids of older builds (version 7) begin with the
//! time as well.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use chrono::{DateTime, Utc};
use uuid::{Builder, Uuid};

/// The last time that a number is taken from, in the year 6429: above it there is room to count on.
const LATEST_MS: u64 = 1 << 47;

/// Makes the ids of one record.
#[derive(Debug)]
pub(super) struct Ids {
    last: AtomicU64,
}

impl Ids {
    /// Returns ids that follow all of `taken`.
    pub(super) fn after(taken: impl IntoIterator<Item = Uuid>) -> Self {
        let numbers = taken.into_iter().map(number).filter(|number| *number <= LATEST_MS);
        Self { last: AtomicU64::new(numbers.max().unwrap_or(0)) }
    }

    /// Returns the id of a job or a study that is taken now.
    pub(super) fn next(&self) -> Uuid {
        let time_ms = now_ms();
        let following = |last: u64| time_ms.max(last + 1);
        let last = self.last.update(Ordering::Relaxed, Ordering::Relaxed, following);
        id(following(last), time_ms)
    }
}

fn id(number: u64, time_ms: u64) -> Uuid {
    let mut bytes = Uuid::new_v4().into_bytes();
    bytes[..6].copy_from_slice(&number.to_be_bytes()[2..]);
    bytes[10..].copy_from_slice(&time_ms.to_be_bytes()[2..]);
    Builder::from_custom_bytes(bytes).into_uuid()
}

fn number(id: Uuid) -> u64 {
    (id.as_u128() >> 80) as u64
}

/// Returns the time when a job or a study was taken, which its id holds; `None` if the id is not ours.
pub(super) fn created(id: Uuid) -> Option<DateTime<Utc>> {
    let time_ms = match id.get_version_num() {
        7 => number(id),
        8 => id.as_u128() as u64 & ((1 << 48) - 1),
        _ => return None,
    };
    DateTime::from_timestamp_millis(time_ms.cast_signed())
}

/// Returns the time of day, to the millisecond; 1970 for a clock that shows an earlier one.
pub(super) fn now() -> DateTime<Utc> {
    DateTime::from_timestamp_millis(now_ms().cast_signed()).unwrap_or_default()
}

/// Returns whether HTTP can express the date that the clock shows: one from 1970 to 9999.
pub(super) fn is_sane() -> bool {
    const YEAR_10000_S: u64 = 253_402_300_800;
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.is_ok_and(|since| since.as_secs() < YEAR_10000_S)
}

fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(LATEST_MS).min(LATEST_MS)
}

#[cfg(test)]
mod tests {
    use super::{Ids, LATEST_MS, created, id, now};

    #[test]
    fn ids_follow_each_other_and_hold_the_time() {
        let ahead = id(LATEST_MS - 1, 5);
        let ids = Ids::after([ahead, uuid::Uuid::from_u128(u128::MAX), id(3, 9)]);
        let taken: Vec<_> = (0..100).map(|_| ids.next()).collect();
        assert!(ahead < taken[0] && taken.is_sorted_by(|a, b| a < b), "{taken:?}");
        assert_eq!(created(ahead).map(|time| time.timestamp_millis()), Some(5));
        for id in taken {
            let time = created(id).expect("ours");
            assert!((now() - time).num_seconds().abs() < 3600, "{time}");
        }
        // As older builds made them.
        let older = uuid::Uuid::now_v7();
        assert!(Ids::after([older]).next() > older);
        assert!((now() - created(older).expect("a time")).num_seconds().abs() < 3600);
        assert_eq!(created(uuid::Uuid::new_v4()), None);
    }
}
