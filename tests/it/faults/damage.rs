//! Damaged files of the store: every one is detected, none harms another job.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use uuid::Uuid;
use vpd::log::LogError;
use vpd::log::inspect::inspect;
use vpd::plan::Plan;
use vpd::scenario::Scenario;

use super::process::Service;
use super::{Random, damage, dipole, scale};

#[test]
fn every_damaged_file_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let service = Service::start(folder.path(), &[]);
    let sound = service.submit(&dipole(20_000));
    assert_eq!(service.ended(&sound)["state"], "succeeded");
    let digest = service.digest(&sound);
    assert!(service.terminate().0.success());

    let jobs = folder.path().join("data/jobs");
    let file = |name: &str| fs::read(jobs.join(&sound).join(name)).expect("a file");
    let (scenario, result, log) = (file("scenario.json"), file("result.json"), file("log.mcap"));
    let count = 200 * scale();
    let make = |files: &[(&str, &[u8])]| {
        let id = Uuid::now_v7().to_string();
        fs::create_dir_all(jobs.join(&id)).expect("made");
        for (name, bytes) in files {
            fs::write(jobs.join(&id).join(name), bytes).expect("written");
        }
        id
    };
    let results: Vec<_> = (0..count)
        .map(|_| {
            let result = damage(&mut random, &result);
            make(&[
                ("scenario.json", &scenario),
                ("log.mcap", &log[..100]),
                ("result.json", &result),
            ])
        })
        .collect();
    let scenarios: Vec<_> =
        (0..count).map(|_| make(&[("scenario.json", &damage(&mut random, &scenario))])).collect();
    let index = folder.path().join("data/index.jsonl");
    fs::write(&index, damage(&mut random, &fs::read(&index).expect("an index"))).expect("written");

    let service = Service::start(folder.path(), &[]);
    for id in &results {
        let job = service.job(id);
        assert_eq!(job["diagnosis"]["code"], "record_damaged", "{job}");
    }
    for id in &scenarios {
        let job = service.ended(id);
        assert_eq!(
            (&job["state"], &job["diagnosis"]["code"]),
            (&"failed".into(), &"record_damaged".into()),
            "{job}"
        );
    }
    assert_eq!(service.job(&sound)["state"], "succeeded");
    assert_eq!(service.digest(&sound), digest);
    assert_eq!(service.reference(&dipole(20_000)), digest);

    let damaged = folder.path().join("damaged.mcap");
    for _ in 0..count {
        fs::write(&damaged, damage(&mut random, &log)).expect("written");
        let found = inspect(&damaged).expect("readable");
        assert!(!found.finished && found.damage.is_some(), "{found}");
    }
    println!("{} damaged files, all reported", 3 * count);
}

/// A kind of damage: its name, and the function that applies it to a path.
type Manner = (&'static str, fn(&Path));

/// Change of a data directory.
type Act = Box<dyn Fn(&Path)>;

const MANNERS: [Manner; 7] = [
    ("removed", |path| drop(remove(path))),
    ("emptied", |path| replace(path, |path| fs::write(path, ""))),
    ("garbage", |path| replace(path, |path| fs::write(path, [0xff; 300]))),
    ("a directory", |path| replace(path, |path| fs::create_dir(path))),
    ("a loop of links", |path| replace(path, |path| std::os::unix::fs::symlink(path, path))),
    ("a pipe", |path| {
        replace(path, |path| {
            let made = Command::new("mkfifo").arg(path).status()?;
            if made.success() { Ok(()) } else { Err(std::io::Error::other("no mkfifo")) }
        });
    }),
    ("without rights", |path| {
        use std::os::unix::fs::PermissionsExt;
        let _ = fs::set_permissions(path, fs::Permissions::from_mode(0o000));
    }),
];

fn remove(path: &Path) -> std::io::Result<()> {
    if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) }
}

fn replace(path: &Path, make: impl Fn(&Path) -> std::io::Result<()>) {
    let _ = remove(path);
    make(path).expect("made");
}

/// Returns all files below a directory.
fn files(directory: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => found.extend(files(&entry.path())),
            _ => found.push(entry.path()),
        }
    }
    found
}

/// Whatever the damage to the data directory, a start serves the rest and removes nothing.
#[test]
fn no_kind_of_damage_stops_a_start_or_is_swept_away() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut blocker = dipole(10_000_000_000);
    blocker["log"]["every"] = 1_000_000.into();
    let service = Service::start(folder.path(), &["--workers", "1"]);
    let [sound, victim] = [(); 2].map(|()| service.submit(&dipole(2_000)));
    assert_eq!(service.ended(&victim)["state"], "succeeded");
    let digest = service.digest(&sound);
    let study = serde_json::json!({ "kind": "precision", "scenario": dipole(10),
        "methods": [{"name": "vpd", "tableau": "gauss2"}] });
    let answer = service.send("POST", "/studies", Some(&study.to_string())).json();
    let study = answer["id"].as_str().expect("an id").to_owned();
    assert_eq!(service.study(&study)["state"], "succeeded");
    let (running, waiting) = (service.submit(&blocker), service.submit(&dipole(2_000)));
    while service.job(&running)["state"] != "running" {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    service.kill();
    for id in [&running, &waiting] {
        fs::write(folder.path().join("data/jobs").join(id).join("cancel"), "").expect("written");
    }
    let data = folder.path().join("data");
    let jobs = data.join("jobs");
    let mut places: Vec<PathBuf> = ["jobs", "studies", "trash", "index.jsonl", "link-key", "lock"]
        .iter()
        .map(|name| data.join(name))
        .collect();
    places.extend(
        ["scenario.json", "result.json", "log.mcap"].map(|name| jobs.join(&victim).join(name)),
    );
    places.extend(
        ["scenario.json", "cancel", "log.mcap.part", "attempt-1"]
            .map(|name| jobs.join(&running).join(name)),
    );
    places.extend(
        ["request.json", "result.json"].map(|name| data.join("studies").join(&study).join(name)),
    );
    places.push(jobs.join(&waiting));
    let mut cases: Vec<(String, Act)> = Vec::new();
    for place in &places {
        let name = place.strip_prefix(&data).expect("below").to_owned();
        for (manner, act) in MANNERS {
            let name = name.clone();
            cases.push((
                format!("{} {manner}", name.display()),
                Box::new(move |data| act(&data.join(&name))),
            ));
        }
    }
    for odd in ["jobs/lost+found", "jobs/../jobs/ ", "jobs/0190", "studies/lost+found"] {
        cases.push((
            odd.to_owned(),
            Box::new(move |data| fs::create_dir_all(data.join(odd)).expect("made")),
        ));
    }
    cases.push((
        "a name that is not UTF-8".to_owned(),
        Box::new(|data| {
            use std::os::unix::ffi::OsStrExt;
            let name = std::ffi::OsStr::from_bytes(b"jobs/\xff\xfe");
            fs::create_dir(data.join(name)).expect("made");
        }),
    ));
    for (number, (name, act)) in cases.iter().enumerate() {
        let place = folder.path().join(format!("case-{number}"));
        fs::create_dir(&place).expect("made");
        let copied = Command::new("cp").arg("-a").args([&data, &place.join("data")]).status();
        assert!(copied.expect("cp").success());
        let copy = place.join("data");
        act(&copy);
        let before = files(&copy);
        let service = Service::start(&place, &["--workers", "2"]);
        assert_eq!(service.get("/healthz").status, 200, "{name}");
        if copy.join("jobs").join(&sound).join("log.mcap").is_file() {
            assert_eq!(service.digest(&sound), digest, "{name}");
        }
        assert_eq!(service.reference(&dipole(2_000)), digest, "{name}");
        assert!(service.terminate().0.success(), "{name}");
        // Every file is still there, under its name or under that of a file set aside, except those
        // that running jobs changed themselves.
        let after = files(&copy);
        // Without its result a job runs again, and may not have come to the end.
        let again = name.starts_with(&format!("jobs/{victim}/result.json"));
        let kept = |file: &PathBuf| {
            after.contains(file)
                || file.starts_with(copy.join("jobs").join(&running))
                || (again && *file == copy.join("jobs").join(&victim).join("log.mcap"))
                || file.parent().is_some_and(|parent| parent.ends_with("trash"))
                || after.iter().any(|other| {
                    let (file, other) = (file.to_string_lossy(), other.to_string_lossy());
                    other.starts_with(&*format!("{file}.set-aside"))
                })
        };
        let gone: Vec<_> = before.iter().filter(|file| !kept(file)).collect();
        assert!(gone.is_empty(), "{name}: {gone:?}");
        fs::remove_dir_all(&place).expect("removed");
    }
    println!("{} kinds of damage, each start served the rest", cases.len());
    assert!(cases.len() >= 70);
}

/// Returns the files of a corpus.
fn corpus(name: &str) -> Vec<Vec<u8>> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(name);
    let entries = fs::read_dir(corpus).expect("a corpus");
    entries.map(|entry| fs::read(entry.expect("an entry").path()).expect("a file")).collect()
}

#[test]
fn ranges_of_the_corpus_and_their_neighbours_give_the_whole_the_right_part_or_416() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let service = Service::start(folder.path(), &[]);
    let id = service.submit(&dipole(2_000));
    assert_eq!(service.ended(&id)["state"], "succeeded");
    let path = format!("/jobs/{id}/log.mcap");
    let whole = service.get(&path).body;
    let mut answers = [0; 3];
    for seed in corpus("range") {
        for k in 0..20 * scale() {
            let range = if k == 0 { seed.clone() } else { damage(&mut random, &seed) };
            // No client sends such bytes; the fuzzer does.
            if !range.iter().all(|byte| (b' '..=b'~').contains(byte)) {
                continue;
            }
            let range = std::str::from_utf8(&range).expect("ASCII");
            let answer = service.try_send("GET", &path, &[("range", range)], None);
            let answer = answer.expect("an answer");
            match answer.status {
                200 => assert_eq!(answer.body, whole, "{range}"),
                206 => assert!(
                    whole.windows(answer.body.len().max(1)).any(|part| part == answer.body),
                    "{range}"
                ),
                416 => {}
                status => panic!("{range:?}: {status}"),
            }
            answers[usize::from(answer.status == 206) + 2 * usize::from(answer.status == 416)] += 1;
        }
    }
    println!("{} whole, {} parts, {} refused", answers[0], answers[1], answers[2]);
    assert!(answers[1] > 0 && answers[2] > 0);
}

#[test]
fn the_corpus_of_the_fuzzers_and_its_neighbours_are_read_without_a_panic() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = Random::new();
    let (mut taken, mut refused) = (0, 0);
    for text in corpus("scenario") {
        Scenario::from_json(&text).expect("the corpus begins with good ones");
        for _ in 0..200 * scale() {
            match Scenario::from_json(&damage(&mut random, &text)) {
                Ok(scenario) => {
                    // A scenario that can be read can be planned, or is refused with its field.
                    let _ = Plan::new(&scenario);
                    assert_eq!(
                        Scenario::from_json(&scenario.to_json()).expect("read back"),
                        scenario
                    );
                    taken += 1;
                }
                Err(_) => refused += 1,
            }
        }
    }
    let part = folder.path().join("log.mcap.part");
    for bytes in corpus("log") {
        fs::write(&part, &bytes).expect("written");
        assert!(inspect(&part).expect("readable").finished);
        for _ in 0..100 * scale() {
            fs::write(&part, damage(&mut random, &bytes)).expect("written");
            match inspect(&part) {
                Ok(found) => assert!(!found.finished),
                // Where the name of the program is damaged, and nothing else tells whose log it is.
                Err(error) => assert!(matches!(error, LogError::Foreign { .. }), "{error}"),
            }
        }
    }
    println!("scenarios: {taken} taken, {refused} refused");
    assert!(taken > 0 && refused > 0);
}
