//! No unfinished or damaged log counts as whole.

use std::fs;

use vpd::log::inspect::inspect;
use vpd::log::part_path;
use vpd::log::resume::last_checkpoint;
use vpd::log::samples::{Curve, Window, read_course};
use vpd::log::schema::Compression;
use vpd::log::stretch::{Wanted, read_stretch};
use vpd::log::writer::{Level, LogHeader, LogWriter};

use super::fixture::*;
use crate::faults::disk::Disk;

#[test]
fn a_dropped_writer_leaves_nothing() {
    let (folder, path) = place();
    let mut log = LogWriter::create(&path, &header()).expect("create");
    run_dipole(&mut log, 25);
    assert!(part_path(&path).exists());
    assert!(!path.exists());
    drop(log);
    assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 0);
}

#[test]
fn a_running_log_reads_up_to_its_last_chunk() {
    let (_folder, path) = place();
    let mut log = LogWriter::create(&path, &header()).expect("create");
    run_dipole(&mut log, 25);
    // Closed chunks are written by a thread.
    while log.durable_step() < 19 {
        std::thread::yield_now();
    }
    let found = inspect(&part_path(&path)).expect("read");
    assert!(!found.finished);
    assert_eq!((found.samples, found.chunks), (20, 2), "the third chunk of ten is open");
    assert!(found.job.is_some());
    assert!(found.outcome.is_none());
    log.finish(succeeded()).expect("finish");
}

#[test]
fn a_whole_file_without_outcome_is_not_finished() {
    // The file that the MCAP layer leaves when it is dropped in a panic.
    let (_folder, path) = place();
    mcap::WriteOptions::new()
        .library("vpd/0.1.0")
        .create(fs::File::create(&path).expect("create"))
        .expect("start")
        .finish()
        .expect("finish");
    let found = inspect(&path).expect("read");
    assert!(!found.finished);
    assert_eq!(found.damage.as_deref(), Some("the log does not say how the job ended"));
}

#[test]
fn a_cut_file_is_read_to_the_cut_and_reported() {
    let (_folder, path) = write_dipole(35);
    let bytes = fs::read(&path).expect("read");
    let whole = all_messages(&path);
    let stride = bytes.len() / 300 + 1;
    let mut cuts: Vec<_> = (0..bytes.len()).step_by(stride).collect();
    cuts.extend(record_ends(&bytes));
    cuts.extend(bytes.len() - 60..bytes.len());
    let cut = path.with_extension("cut");
    let mut most = 0;
    for at in cuts.into_iter().filter(|&at| at < bytes.len()) {
        fs::write(&cut, &bytes[..at]).expect("write");
        let found = inspect(&cut).expect("read");
        assert!(!found.finished, "cut at {at}");
        assert!(found.damage.is_some(), "cut at {at}");
        let messages = all_messages(&cut);
        assert!(whole.starts_with(&messages), "cut at {at}");
        most = most.max(messages.len());
    }
    assert_eq!(most, whole.len(), "a cut in the index costs no sample");
}

#[test]
fn a_flipped_bit_is_always_reported() {
    for compression in [Compression::Zstd, Compression::Lz4, Compression::None] {
        let (_folder, path) = place();
        let header = LogHeader { compression, ..header() };
        let mut log = LogWriter::create(&path, &header).expect("create");
        run_dipole(&mut log, 25);
        log.finish(succeeded()).expect("finish");
        let bytes = fs::read(&path).expect("read");
        let whole = all_messages(&path);
        let flipped = path.with_extension("flipped");
        let seed = 0x5eed_0001_u64 + compression as u64;
        let mut random = seed;
        let ends = record_ends(&bytes);
        for k in 0..400 {
            let draw = next(&mut random);
            // Every other flip is in the opcode or length of a record, where it does most damage.
            let byte = if k % 2 == 0 {
                (ends[draw as usize % ends.len()] + (draw >> 32) as usize % 9).min(bytes.len() - 1)
            } else {
                draw as usize % bytes.len()
            };
            let bit = next(&mut random) % 8;
            let mut damaged = bytes.clone();
            damaged[byte] ^= 1 << bit;
            fs::write(&flipped, damaged).expect("write");
            let found = inspect(&flipped).expect("read");
            assert!(
                !found.finished && found.damage.is_some(),
                "{compression:?}, seed {seed:#x}, byte {byte}, bit {bit}: {found}"
            );
            let messages = all_messages(&flipped);
            assert!(
                messages.iter().all(|message| whole.contains(message)),
                "{compression:?}, seed {seed:#x}, byte {byte}, bit {bit}"
            );
        }
    }
}

#[test]
fn storage_errors_are_told_and_nothing_stays() {
    let (folder, _) = place();
    let missing = folder.path().join("missing").join("a.mcap");
    let error = LogWriter::create(&missing, &header()).err().expect("no such folder");
    assert_eq!(error.code(), "storage_error");
    assert!(error.to_string().contains("cannot create"), "{error}");
}

#[test]
fn a_link_in_the_place_of_the_log_is_not_written_through() {
    let (folder, path) = place();
    let target = folder.path().join("target");
    fs::write(&target, "kept").expect("written");
    std::os::unix::fs::symlink(&target, part_path(&path)).expect("symlink");
    let error = LogWriter::create(&path, &header()).err().expect("a link");
    assert_eq!(error.code(), "storage_error");
    assert_eq!(fs::read(&target).expect("a file"), b"kept");
}

#[test]
fn a_full_disk_fails_the_log_and_leaves_what_it_holds() {
    let (folder, _) = place();
    let disk = folder.path().join("disk");
    let Some(_disk) = Disk::mount(&disk, 512 << 10) else {
        println!(
            "SKIPPED: cannot mount a tmpfs here; no_space_at_each_write_in_turn stands in for it"
        );
        return;
    };
    let path = disk.join("a.mcap");
    let header = LogHeader { samples_per_chunk: 100, ..header() };
    let mut log = LogWriter::create(&path, &header).expect("room");
    let (body, state) = crate::given::dipole();
    let error = try_run(&body, state, &mut log, 100_000).expect_err("no space");
    assert_eq!(error.code(), "storage_full", "{error}");
    assert!(error.is_transient());
    assert_eq!(
        log.message(Level::Error, 10.0, "full").expect_err("given up").code(),
        "log_given_up"
    );
    assert_eq!(log.finish(succeeded()).expect_err("given up").code(), "log_given_up");
    assert!(!path.exists());
    assert!(last_checkpoint(&path).expect("readable") > Some(0));
}

/// Charts and drawings look for a part by the index at the end: where that is damaged they say so, or show samples.
#[test]
fn a_damaged_end_leads_to_samples_or_to_an_error() {
    let (_folder, path) = write_dipole(25);
    let bytes = fs::read(&path).expect("read");
    let summary = mcap::Summary::read(&bytes).expect("whole").expect("has a summary");
    let last = summary.chunk_indexes.last().expect("chunks");
    let end = (last.chunk_start_offset + last.chunk_length) as usize;
    let damaged = path.with_extension("damaged");
    let energies = |from_s: f64| {
        let window = Window { from_s, to_s: f64::MAX, points: 100 };
        read_course(&damaged, Curve::EnergyError, window, &|_| Vec::new(), &|| false)
            .map(|course| course.expect("nobody stopped it").low.concat())
    };
    let attitudes = || {
        let wanted = Wanted { from_s: 0.1, every_s: 0.0, samples: 100 };
        read_stretch(&damaged, wanted).map(|stretch| stretch.attitude)
    };
    fs::write(&damaged, &bytes).expect("write");
    let (all, some) = (energies(0.0).expect("whole"), energies(0.1).expect("whole"));
    let turned = attitudes().expect("whole");
    assert_eq!((all.len(), some.len(), turned.len()), (26, 16, 16));
    let (mut errors, mut others) = (0, 0);
    // Testing every byte takes seconds per kilobyte.
    for at in (end..bytes.len()).step_by(11) {
        let flip = [1, 0x80, 0xff][at % 3];
        let mut bytes = bytes.clone();
        bytes[at] ^= flip;
        fs::write(&damaged, bytes).expect("write");
        for from_s in [0.0, 0.1] {
            match energies(from_s) {
                Ok(found) => {
                    assert!(found.iter().all(|x| all.contains(x)), "byte {at}, {flip:#x}");
                    others += usize::from(found.len() != if from_s > 0.0 { 16 } else { 26 });
                }
                Err(_) => errors += 1,
            }
        }
        errors += usize::from(attitudes().is_err());
    }
    assert!(errors > 0 && others > 0, "{errors} errors, {others} other answers");
}
