//! The invariants of ARCHITECTURE.md that the text of the code can show.

use std::collections::{BTreeMap, BTreeSet};
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

/// A module by its path from the root of its crate: one file.
type Module = Vec<String>;

/// Returns the modules of a crate, each with its code: without comments and unit tests.
fn modules(source: &Path) -> BTreeMap<Module, String> {
    let mut modules = BTreeMap::new();
    for file in sources(source) {
        let path = file.strip_prefix(source).expect("below").with_extension("");
        let mut module: Module =
            path.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        if module == ["lib"] || module == ["main"] {
            module.clear();
        }
        let text = fs::read_to_string(&file).expect("readable");
        let code = text.split("#[cfg(test)]\nmod tests").next().expect("one part");
        let lines = code.lines().map(|line| line.split("//").next().expect("one part"));
        modules
            .entry(module)
            .or_insert_with(String::new)
            .extend(lines.map(|line| line.to_owned() + "\n"));
    }
    modules
}

/// Reads the tree of paths at the start of `code`, such as `a::{b, c::d}`, below `before`, and returns what follows it.
fn read_paths<'a>(mut code: &'a str, before: &[String], paths: &mut Vec<Module>) -> &'a str {
    let mut path = before.to_vec();
    loop {
        code = code.trim_start();
        if let Some(mut list) = code.strip_prefix('{') {
            loop {
                list = list.trim_start();
                match list.strip_prefix('}') {
                    Some(rest) => return rest,
                    None if list.is_empty() => return list,
                    None => {}
                }
                let rest = read_paths(list, &path, paths);
                // A name that is given another, or a glob.
                let end = rest.find([',', '}', '{']).unwrap_or(rest.len());
                list = &rest[end..];
                list = list.strip_prefix(',').unwrap_or(list);
            }
        }
        let end = code.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(code.len());
        path.push(code[..end].to_owned());
        code = &code[end..];
        match code.strip_prefix("::") {
            Some(rest) if !rest.starts_with('<') => code = rest,
            _ => {
                paths.push(path);
                return code;
            }
        }
    }
}

/// Returns the modules of the same crate that the code of a module names, except those around it and in it: a module
/// and those in it are one.
fn named(module: &Module, all: &BTreeMap<Module, String>) -> BTreeSet<Module> {
    let code = &all[module];
    let mut paths = Vec::new();
    for (root, start) in ["crate::", "super::"]
        .iter()
        .flat_map(|root| code.match_indices(root).map(|(start, root)| (root, start)))
    {
        let before = code[..start].chars().next_back();
        if before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let mut rest = &code[start..];
        let mut base = if root == "crate::" { Module::new() } else { module.clone() };
        rest = rest.strip_prefix("crate::").unwrap_or(rest);
        while let Some(above) = rest.strip_prefix("super::") {
            base.pop();
            rest = above;
        }
        read_paths(rest, &base, &mut paths);
    }
    let file = |path: &Module| {
        (1..=path.len()).rev().map(|end| path[..end].to_vec()).find(|part| all.contains_key(part))
    };
    let mut found: BTreeSet<Module> = paths.iter().filter_map(file).collect();
    found.retain(|other| !other.starts_with(module) && !module.starts_with(other));
    found
}

/// Returns the circles of a crate: modules that lead to one another by what they name.
fn circles(source: &Path) -> Vec<Vec<String>> {
    let all = modules(source);
    let mut reached: BTreeMap<&Module, BTreeSet<Module>> =
        all.keys().map(|module| (module, named(module, &all))).collect();
    for between in all.keys() {
        let beyond = reached[between].clone();
        for found in reached.values_mut().filter(|found| found.contains(between)) {
            found.extend(beyond.iter().cloned());
        }
    }
    let mut circles = BTreeSet::new();
    for (module, found) in &reached {
        let circle: BTreeSet<_> =
            found.iter().filter(|other| reached[*other].contains(*module)).collect();
        if !circle.is_empty() {
            circles.insert(circle.into_iter().map(|module| module.join("/")).collect::<Vec<_>>());
        }
    }
    circles.into_iter().collect()
}

#[test]
fn no_modules_of_the_mathematics_need_one_another() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    assert_eq!(circles(&root.join("solve/src")), Vec::<Vec<String>>::new());
}

/// Those that are left are named here, and no more come.
#[test]
fn few_modules_of_the_program_need_one_another() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let left = [
        vec!["serve/engine", "serve/job", "serve/store"],
        vec!["serve/engine/cluster/sweeps", "serve/engine/cluster/work"],
    ];
    assert_eq!(circles(&root.join("src")), left);
}

/// The search finds circles, and follows every form of a path.
#[test]
fn circles_are_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = [
        ("lib.rs", "pub mod a;\npub mod b;\npub mod c;\n"),
        ("a.rs", "use crate::{b::{self, Of}, c as other};\n// crate::d\nmod inner;\n"),
        ("a/inner.rs", "use super::Of;\nuse super::super::d::This;\n"),
        ("b.rs", "fn f() { crate::c::<u8>() }\n"),
        ("c.rs", "use super::a;\n#[cfg(test)]\nmod tests { use crate::d; }\n"),
        ("d.rs", "use crate::a::inner::{Of, That};\n"),
    ];
    for (name, code) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs::write(path, code).expect("written");
    }
    assert_eq!(circles(folder.path()), [vec!["a", "b", "c"], vec!["a/inner", "d"]]);
}
