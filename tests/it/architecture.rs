//! The invariants of ARCHITECTURE.md that the text of the code can show.

use std::fs;
use std::path::{Path, PathBuf};

/// Returns every Rust file below `path`, or the file itself.
fn sources(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = fs::read_dir(path).expect("a folder of the crate");
    entries
        .map(|entry| entry.expect("readable").path())
        .filter(|path| path.is_dir() || path.extension().is_some_and(|suffix| suffix == "rs"))
        .flat_map(|path| sources(&path))
        .collect()
}

/// Returns the lines of a module that contain one of the words.
fn lines_with(module: &str, words: &[&str]) -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let source = root.join("src");
    let places = match module {
        "solve" => vec![root.join("solve/src")],
        _ => vec![source.join(format!("{module}.rs")), source.join(module)],
    };
    let files = places.iter().filter(|place| place.exists()).flat_map(|place| sources(place));
    let mut found = Vec::new();
    for file in files {
        let text = fs::read_to_string(&file).expect("readable");
        let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let hits = code.filter(|line| words.iter().any(|word| line.contains(word)));
        found.extend(hits.map(|line| format!("{}: {line}", file.display())));
    }
    found
}

/// The compiler ensures that it knows nothing of the program, and no serde.
#[test]
fn solve_is_pure() {
    let impure = ["std::fs", "std::io", "std::time", "std::thread", "std::net", "print!("];
    assert_eq!(lines_with("solve", &impure), Vec::<String>::new());
}

/// The law of a term, which stands in the term's file, is the exception.
#[test]
fn scenarios_do_not_know_the_mathematics() {
    let mut known = lines_with("scenario", &["crate::solve", "nalgebra"]);
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/scenario/term");
    known.retain(|line| !line.starts_with(&root.display().to_string()));
    assert_eq!(known, Vec::<String>::new());
}

#[test]
fn the_machines_mathematics_library_is_not_used() {
    let functions =
        [".sin(", ".cos(", ".tan(", ".exp(", ".ln(", ".powf(", ".log10(", ".acos(", ".sin_cos("];
    for module in ["solve", "plan", "assemble", "study", "advise", "sweep", "log"] {
        assert_eq!(lines_with(module, &functions), Vec::<String>::new());
    }
}

/// Functions of libraries that give a wrong answer without a word: nalgebra's iteration from a matrix ends at the identity for a
/// half turn, and its axis of an exact one is none; readers of the MCAP library compare no checksums.
#[test]
fn functions_that_fail_in_silence_are_not_called() {
    let wrong = [
        "Rotation3::from_matrix(",
        "UnitQuaternion::from_matrix(",
        ".axis_angle()",
        "MessageStream",
        "IndexedReader",
    ];
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let modules = fs::read_dir(root).expect("a folder of the crate").map(|entry| {
        let path = entry.expect("readable").path();
        path.file_stem().expect("a name").to_string_lossy().into_owned()
    });
    for module in modules.chain(["solve".to_owned()]) {
        assert_eq!(lines_with(&module, &wrong), Vec::<String>::new());
    }
}
