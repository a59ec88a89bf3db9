//! Compiles `src/log/vpd.proto`: message types for the code, a descriptor set for the logs
//! themselves.

use std::error::Error;
use std::path::Path;
use std::{env, fs};

const PROTO: &str = "src/log/vpd.proto";

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed={PROTO}");
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
