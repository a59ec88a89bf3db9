//! Compiles `src/log/vpd.proto`: message types for the code, a descriptor set for the logs
//! themselves. Names the build by its sources, so that no build goes on with the log of another.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

const PROTO: &str = "src/log/vpd.proto";

fn main() -> Result<(), Box<dyn Error>> {
    let sources = ["src", "build.rs", "Cargo.lock"];
    for source in sources {
        println!("cargo:rerun-if-changed={source}");
    }
    println!("cargo:rustc-env=VPD_BUILD={:016x}", fingerprint(&sources)?);
    let includes = ["src/log"];

    // With comments: they become the documentation of the message types.
    let commented = protox::Compiler::new(includes)?
        .include_imports(true)
        .include_source_info(true)
        .open_file(PROTO)?
        .file_descriptor_set();
    prost_build::Config::new().compile_fds(commented)?;

    // Without: this copy rides in every log.
    let descriptors = protox::Compiler::new(includes)?
        .include_imports(true)
        .include_source_info(false)
        .open_file(PROTO)?
        .encode_file_descriptor_set();
    fs::write(Path::new(&env::var("OUT_DIR")?).join("vpd.descriptors"), descriptors)?;
    Ok(())
}

/// FNV-1a (Fowler, Noll, Vo) of names and contents of all files.
fn fingerprint(sources: &[&str]) -> io::Result<u64> {
    let mut files = Vec::new();
    for source in sources {
        collect(Path::new(source), &mut files)?;
    }
    files.sort();
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for file in files {
        let name = file.to_string_lossy().into_owned().into_bytes();
        for byte in name.into_iter().chain(fs::read(&file)?) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
    Ok(hash)
}

fn collect(path: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    if path.is_dir() {
        for entry in fs::read_dir(path)? {
            collect(&entry?.path(), files)?;
        }
    } else if path.exists() {
        files.push(path.to_owned());
    }
    Ok(())
}
