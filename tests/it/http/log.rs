//! The log as viewers fetch it: ranges, validators, other origins.

use super::{Answer, Server, assert_whole_log, directory, service};
use vpd::serve::Cors;

fn path(id: &str) -> String {
    format!("/jobs/{id}/log.mcap")
}

fn vary_free(answer: &Answer) {
    assert_eq!(answer.header("content-encoding"), "");
    assert_eq!(answer.header("transfer-encoding"), "");
    assert_eq!(answer.header("accept-ranges"), "bytes");
}

#[test]
fn the_whole_log_comes_with_what_viewers_need() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let log = server
        .get_with(&format!("{}?token=x", path(&id)), &[("accept-encoding", "gzip, br, zstd")]);
    assert_eq!(log.status, 200);
    assert_whole_log(&log.body);
    vary_free(&log);
    assert_eq!(log.header("content-length"), log.body.len().to_string());
    assert_eq!(log.header("content-type"), "application/octet-stream");
    assert_eq!(
        log.header("content-disposition"),
        format!("attachment; filename=\"vpd-{id}.mcap\"")
    );
    assert_eq!(log.header("x-content-type-options"), "nosniff");
    assert!(!log.header("last-modified").is_empty());
    let etag = log.header("etag");
    assert!(etag.starts_with('"') && etag.ends_with('"') && etag.len() > 2, "{etag}");

    let head = server.send("HEAD", &path(&id), &[], None);
    assert_eq!(head.status, 200);
    vary_free(&head);
    for name in ["content-length", "etag", "last-modified", "content-type"] {
        assert_eq!(head.header(name), log.header(name), "{name}");
    }
}

#[test]
fn single_ranges_hold_the_right_bytes() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let whole = server.get(&path(&id)).body;
    let size = whole.len();
    let last = size - 1;
    for (range, from, to) in [
        ("bytes=0-7".to_owned(), 0, 7),
        ("bytes=8-8".to_owned(), 8, 8),
        ("bytes=-8".to_owned(), size - 8, last),
        (format!("bytes={}-", size - 3), size - 3, last),
        (format!("bytes=0-{}", 10 * size), 0, last),
        ("bytes=0008-0009".to_owned(), 8, 9),
        ("bytes=7-99999999999999999999999".to_owned(), 7, last),
        // A file that is shorter than the end that is asked for is that end (RFC 9110, 14.1.2).
        (format!("bytes=-{}", size + 1), 0, last),
        ("bytes=-18446744073709551615".to_owned(), 0, last),
        ("bytes=-99999999999999999999999".to_owned(), 0, last),
    ] {
        let part = server.get_with(&path(&id), &[("range", &range)]);
        assert_eq!(part.status, 206, "{range}");
        vary_free(&part);
        assert_eq!(part.body, &whole[from..=to], "{range}");
        assert_eq!(part.header("content-range"), format!("bytes {from}-{to}/{size}"));
        assert_eq!(part.header("content-length"), (to - from + 1).to_string());
    }
    let many = (0..1000).map(|i| format!("{i}-{i}")).collect::<Vec<_>>().join(",");
    for range in [
        format!("bytes={size}-"),
        format!("bytes={size}-{}", size + 1),
        "bytes=99999999999999999999999-".to_owned(),
        "bytes=99999999999999999999998-99999999999999999999999".to_owned(),
        "bytes=-0".to_owned(),
    ] {
        let refused = server.get_with(&path(&id), &[("range", &range)]);
        refused.problem(416, "bad_range");
        assert_eq!(refused.header("content-range"), format!("bytes */{size}"), "{range}");
    }
    // A header that is no range of bytes is ignored (RFC 9110, 14.2), and so are several ranges.
    for range in [
        "bytes=0-1,4-5",
        "bytes=0-1, -1",
        &format!("bytes={many}"),
        "items=0-1",
        "bytes=5-2",
        "bytes=9-1",
        "bytes=100000000000000000000-99999999999999999999",
        "bytes=",
        "bytes=a-b",
        "bytes=0-1,5-2",
        "bytes=--1",
        "bytes",
        "0-7",
    ] {
        let answer = server.get_with(&path(&id), &[("range", range)]);
        assert_eq!((answer.status, answer.body.len()), (200, size), "{range}");
        vary_free(&answer);
    }
    let part = server.get_with(&path(&id), &[("range", "bytes=8-8 ")]);
    assert_eq!((part.status, part.body.len()), (206, 1));
}

#[test]
fn dates_of_any_time_are_answered() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    for date in [
        "Thu, 01 Jan 1970 00:00:00 GMT",
        "Wed, 31 Dec 1969 23:59:59 GMT",
        "Mon, 01 Jan 1900 00:00:00 GMT",
        "Sat, 01 Jan 0001 00:00:00 GMT",
        "Fri, 31 Dec 9999 23:59:59 GMT",
        "Sunday, 06-Nov-94 08:49:37 GMT",
        "Sunday, 06-Nov-69 08:49:37 GMT",
        "Sun Nov  6 08:49:37 1960",
        "nonsense",
    ] {
        for header in ["if-modified-since", "if-unmodified-since", "if-range"] {
            let answer = server.get_with(&path(&id), &[(header, date), ("range", "bytes=0-7")]);
            assert!(answer.status < 500, "{header}: {date}: {}", answer.status);
        }
    }
    // A machine whose clock was wrong leaves files from before 1970.
    let log = super::record(&data, &id).join("log.mcap");
    let file = std::fs::File::options().write(true).open(&log).expect("a log");
    let before = std::time::UNIX_EPOCH - std::time::Duration::from_secs(86_400);
    file.set_modified(before).expect("set");
    assert_eq!(server.get(&path(&id)).status, 200);
    assert_eq!(server.send("HEAD", &path(&id), &[], None).status, 200);
}

#[test]
fn validators_keep_two_files_apart() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let path = path(&id);
    let whole = server.get(&path);
    let etag = whole.header("etag").to_owned();
    let date = whole.header("last-modified").to_owned();

    let same = server.get_with(&path, &[("if-none-match", &etag)]);
    assert_eq!((same.status, same.body.len()), (304, 0));
    assert_eq!(same.header("etag"), etag);
    assert_eq!(server.get_with(&path, &[("if-none-match", "\"other\"")]).status, 200);
    assert_eq!(server.get_with(&path, &[("if-match", &etag)]).status, 200);
    server.get_with(&path, &[("if-match", "\"other\"")]).problem(412, "precondition_failed");

    let part = server.get_with(&path, &[("range", "bytes=0-7"), ("if-range", &etag)]);
    assert_eq!((part.status, part.body.len()), (206, 8));
    // An old ETag, a weak one, a date: the whole file, so that no download is spliced from two.
    for stale in ["\"other\"", &format!("W/{etag}"), &date] {
        let answer = server.get_with(&path, &[("range", "bytes=0-7"), ("if-range", stale)]);
        assert_eq!(answer.status, 200, "{stale}");
        assert_eq!(answer.body, whole.body);
        let beyond = server.get_with(&path, &[("range", "bytes=99999999-"), ("if-range", stale)]);
        assert_eq!(beyond.status, 200, "{stale}");
    }

    server.stop().0.expect("stops in order");
    let server = service(&data).start();
    assert_eq!(server.get(&path).header("etag"), etag);
}

fn preflight(server: &Server, path: &str, origin: &str) -> Answer {
    let headers = [
        ("origin", origin),
        ("access-control-request-method", "GET"),
        ("access-control-request-headers", "range"),
    ];
    server.send("OPTIONS", path, &headers, None)
}

fn words(list: &str) -> Vec<String> {
    let mut words: Vec<_> = list.split(',').map(|word| word.trim().to_lowercase()).collect();
    words.sort();
    words
}

#[test]
fn pages_of_other_origins_may_read_logs_and_nothing_else() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let origin = [("origin", "https://app.foxglove.dev")];
    for headers in
        [&origin[..], &[("range", "bytes=0-7"), origin[0]], &[("range", "bytes=9-1"), origin[0]]]
    {
        let answer = server.get_with(&path(&id), headers);
        assert_eq!(answer.header("access-control-allow-origin"), "*");
        assert_eq!(answer.header("cross-origin-resource-policy"), "cross-origin");
        let exposed = words(answer.header("access-control-expose-headers"));
        let wanted = [
            "accept-ranges",
            "content-length",
            "content-range",
            "content-type",
            "etag",
            "last-modified",
        ];
        assert_eq!(exposed, wanted);
    }
    let allowed = preflight(&server, &path(&id), origin[0].1);
    assert_eq!(allowed.status, 200);
    assert_eq!(allowed.header("access-control-allow-origin"), "*");
    assert_eq!(words(allowed.header("access-control-allow-methods")), ["get", "head", "options"]);
    let wanted =
        ["authorization", "content-type", "if-match", "if-none-match", "if-range", "range"];
    assert_eq!(words(allowed.header("access-control-allow-headers")), wanted);
    assert_eq!(allowed.header("access-control-max-age"), "600");
    // The answer to a viewer that came too early says why.
    let missing = server.get_with("/jobs/01999999-9999-7999-8999-999999999999/log.mcap", &origin);
    missing.problem(404, "unknown_job");
    assert_eq!(missing.header("access-control-allow-origin"), "*");

    for path in ["/jobs", &format!("/jobs/{id}")] {
        assert_eq!(server.get_with(path, &origin).header("access-control-allow-origin"), "");
        preflight(&server, path, origin[0].1).problem(405, "method_not_allowed");
    }
}

#[test]
fn the_list_of_origins_is_kept() {
    let data = directory();
    let listed = "https://app.foxglove.dev, https://embed.foxglove.dev".parse().expect("origins");
    let server = service(&data).cors(listed).start();
    let id = server.finished();
    for (origin, answer) in
        [("https://embed.foxglove.dev", "https://embed.foxglove.dev"), ("https://evil.example", "")]
    {
        let log = server.get_with(&path(&id), &[("origin", origin)]);
        assert_eq!(log.header("access-control-allow-origin"), answer);
        assert_eq!(
            preflight(&server, &path(&id), origin).header("access-control-allow-origin"),
            answer
        );
    }
    server.stop().0.expect("stops in order");

    let server = service(&data).cors(Cors::Nobody).start();
    let log = server.get_with(&path(&id), &[("origin", "https://app.foxglove.dev")]);
    assert_eq!((log.status, log.header("access-control-allow-origin")), (200, ""));
    preflight(&server, &path(&id), "https://app.foxglove.dev").problem(405, "method_not_allowed");

    assert!("app.foxglove.dev".parse::<Cors>().is_err());
    assert_eq!("*".parse(), Ok(Cors::Any));
}

#[cfg(unix)]
#[test]
fn a_link_planted_as_a_log_leads_nowhere() {
    let data = directory();
    let server = service(&data).start();
    let id = server.finished();
    let secret = data.path().join("secret");
    std::fs::write(&secret, "secret").expect("written");
    let log = super::record(&data, &id).join("log.mcap");
    std::fs::remove_file(&log).expect("removed");
    std::os::unix::fs::symlink(&secret, &log).expect("linked");
    server.get(&path(&id)).problem(500, "log_damaged");
}

/// A log that was damaged after the end of the job is reported, on every request, and no byte of it
/// is served.
#[test]
fn a_log_that_is_not_what_the_job_wrote_is_not_served() {
    let data = directory();
    let server = service(&data).start();
    let ids: Vec<_> = (0..3).map(|_| server.finished()).collect();
    let log = |id: &String| super::record(&data, id).join("log.mcap");
    let whole = std::fs::read(log(&ids[0])).expect("a log");
    let job = server.job(&ids[0]);
    assert_eq!(job["log"]["bytes"], whole.len());
    let flip = |id: &String| {
        let mut bytes = std::fs::read(log(id)).expect("a log");
        bytes[whole.len() / 2] ^= 1;
        std::fs::write(log(id), bytes).expect("written");
    };
    flip(&ids[0]);
    std::fs::write(log(&ids[1]), &whole[..whole.len() / 2]).expect("written");
    for id in &ids[..2] {
        for name in ["log.mcap", "live.mcap", "charts/energy.svg", "attitudes.json"] {
            server.get(&format!("/jobs/{id}/{name}")).problem(500, "log_damaged");
        }
    }
    server.stop().0.expect("stops in order");
    flip(&ids[2]);
    let server = service(&data).start();
    for id in &ids {
        server.get(&path(id)).problem(500, "log_damaged");
    }
    flip(&ids[2]);
    assert_eq!(server.get(&path(&ids[2])).body, whole);
}
