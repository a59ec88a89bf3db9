//! A service that is short of resources of the system: file handles, and a client that reads its
//! answers.

use std::io::Write;
use std::net::TcpStream;
use std::process::{Command, Stdio};

use super::dipole;
use super::process::Service;

#[test]
fn half_sent_heads_do_not_fail_accepted_jobs() {
    const HEADS: usize = 300;
    const JOBS: usize = 12;
    let folder = tempfile::tempdir().expect("a folder");
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -n 256 && exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_vpd")]);
    let service = Service::start_as(command, folder.path(), &["--workers", "2"]);
    let before = service.submit(&dipole(20_000));
    let heads: Vec<_> = (0..HEADS)
        .filter_map(|_| {
            let mut stream = TcpStream::connect(service.address).ok()?;
            stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: loc").ok()?;
            Some(stream)
        })
        .collect();
    let jobs: Vec<_> = (0..JOBS).map(|_| service.submit(&dipole(2000))).collect();
    for id in jobs.iter().chain([&before]) {
        assert_eq!(service.ended(id)["state"], "succeeded");
    }
    let said = std::fs::read_to_string(folder.path().join("stderr")).expect("readable");
    assert!(
        said.contains("the limit of file handles is low") && said.contains("granted=256"),
        "{said}"
    );
    println!("{} half-sent heads, {} jobs done", heads.len(), JOBS + 1);
    assert!(heads.len() > 256);
}

#[test]
fn a_service_that_nobody_listens_to_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut command = Command::new(env!("CARGO_BIN_EXE_vpd"));
    // A pipe holds 64 KiB; each request says more than 300 bytes of itself.
    command.env("RUST_LOG", "trace").stderr(Stdio::piped());
    let service = Service::start_unheard(command, folder.path(), &[]);
    for _ in 0..2000 {
        assert_eq!(service.get("/healthz").status, 200);
    }
    let id = service.submit(&dipole(2000));
    assert_eq!(service.ended(&id)["state"], "succeeded");
    let (status, _) = service.terminate();
    assert!(status.success(), "{status}");
}
