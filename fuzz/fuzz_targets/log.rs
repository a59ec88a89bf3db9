//! Any bytes as a log, finished or to be resumed: read to an end without a panic and within bounds.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vpd::log::inspect::inspect;
use vpd::log::part_path;
use vpd::log::resume::last_checkpoint;

fuzz_target!(|bytes: &[u8]| {
    let path = std::env::temp_dir().join(format!("vpd-fuzz-{}.mcap", std::process::id()));
    let part = part_path(&path);
    std::fs::write(&part, bytes).expect("a temporary file");
    let found = inspect(&part).expect("readable");
    assert!(found.finished != found.damage.is_some());
    assert_eq!(last_checkpoint(&path).expect("readable"), found.resumes_at_step);
});
