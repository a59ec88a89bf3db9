//! Compiles `src/log/vpd.proto`: message types for the code, a descriptor set for the logs
//! themselves. Names the build by its sources, so that no build resumes the log of another.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

const PROTO: &str = "src/log/vpd.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rustc-env=VPD_BUILD={:016x}", fingerprint()?);
    let includes = ["src/log"];

    // With comments: they become the documentation of the message types.
    let commented = protox::Compiler::new(includes)?
        .include_imports(true)
        .include_source_info(true)
        .open_file(PROTO)?
        .file_descriptor_set();
    prost_build::Config::new().compile_fds(commented)?;

    // Without comments: this copy is part of every log.
    let descriptors = protox::Compiler::new(includes)?
        .include_imports(true)
        .include_source_info(false)
        .open_file(PROTO)?
        .encode_file_descriptor_set();
    fs::write(Path::new(&env::var("OUT_DIR")?).join("vpd.descriptors"), descriptors)?;
    Ok(())
}

/// Sources that can change a byte of a log.
const SOURCES: [&str; 4] = ["src", "solve/src", "build.rs", "Cargo.lock"];

/// Parts of `src` that cannot: those that accept jobs, and those that show results.
const DOORS: [&str; 14] = [
    "src/main.rs",
    "src/cli.rs",
    "src/cli",
    "src/serve.rs",
    "src/serve",
    "src/live.rs",
    "src/verify.rs",
    "src/export.rs",
    "src/export",
    "src/diff.rs",
    "src/log/columns.rs",
    "src/log/rows.rs",
    "src/log/layout.json",
    "src/study/table.rs",
];

/// Returns the FNV-1a (Fowler, Noll, Vo) of names and contents of all files, and of whether logs
/// hold charts.
fn fingerprint() -> io::Result<u64> {
    let mut files = Vec::new();
    for source in SOURCES {
        collect(Path::new(source), &mut files)?;
    }
    files.sort();
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    let mut take = |bytes: &[u8]| {
        for &byte in bytes {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    };
    take(&[u8::from(env::var_os("CARGO_FEATURE_CHART").is_some())]);
    for file in files {
        println!("cargo:rerun-if-changed={}", file.display());
        take(file.to_string_lossy().as_bytes());
        take(&fs::read(&file)?);
    }
    Ok(hash)
}

fn collect(path: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    if DOORS.iter().any(|door| path == Path::new(door)) {
        return Ok(());
    }
    if path.is_dir() {
        println!("cargo:rerun-if-changed={}", path.display());
        for entry in fs::read_dir(path)? {
            collect(&entry?.path(), files)?;
        }
    } else if path.exists() {
        files.push(path.to_owned());
    }
    Ok(())
}
