//! Viewers of the live view that send without end and read nothing, and one too many of them.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde_json::json;

use super::load::memory;
use super::process::{PATIENCE, Service};

/// Returns a service with a live view, and its address.
fn watched(folder: &std::path::Path) -> (Service, SocketAddr) {
    let free = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = free.local_addr().expect("an address");
    drop(free);
    let service =
        Service::start(folder, &["--workers", "1", "--foxglove-listen", &address.to_string()]);
    let begun = Instant::now();
    while TcpStream::connect(address).is_err() {
        assert!(begun.elapsed() < PATIENCE, "no live view");
        std::thread::sleep(Duration::from_millis(2));
    }
    (service, address)
}

/// Connects a viewer; returns the connection, and the status of the answer.
fn connect(address: SocketAddr) -> (TcpStream, String) {
    let mut stream = TcpStream::connect(address).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
    stream.set_write_timeout(Some(PATIENCE)).expect("a socket");
    let request = "GET / HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
        Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\
        Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n";
    stream.write_all(request.as_bytes()).expect("sent");
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).expect("an answer");
        head.push(byte[0]);
    }
    let status = String::from_utf8_lossy(&head).split(' ').nth(1).expect("a status").to_owned();
    (stream, status)
}

/// Returns a frame of a client, masked with zeros.
fn frame(code: u8, payload: &[u8]) -> Vec<u8> {
    let mut frame = vec![0x80 | code];
    match payload.len() {
        short @ 0..126 => frame.push(0x80 | short as u8),
        long => {
            frame.push(0x80 | 127);
            frame.extend((long as u64).to_be_bytes());
        }
    }
    frame.extend([0; 4]);
    frame.extend(payload);
    frame
}

/// Whatever viewers send, and however little they read, each takes 2 MiB at most, and is closed.
#[test]
fn viewers_that_read_nothing_are_closed_and_nothing_piles_up_for_them() {
    const VIEWERS: usize = 12;
    let folder = tempfile::tempdir().expect("a folder");
    let (service, address) = watched(folder.path());
    let mut shown = super::dipole(10_000_000_000);
    shown["log"]["every"] = json!(1000);
    let id = service.submit(&shown);
    while service.job(&id)["state"] != "running" {
        std::thread::sleep(Duration::from_millis(1));
    }
    let everything: Vec<_> = (0..256).map(|id| json!({ "id": id, "channelId": id % 9 })).collect();
    let everything = json!({ "op": "subscribe", "subscriptions": everything }).to_string();
    let kinds = [
        ("pings", frame(9, &[7; 125]).repeat(500)),
        ("pongs", frame(10, &[7; 125]).repeat(500)),
        ("a frame of 15 MiB", frame(1, &vec![b' '; 15 << 20])),
        ("a subscription of everything, and pings", {
            [frame(1, everything.as_bytes()), frame(9, &[7; 125]).repeat(500)].concat()
        }),
    ];
    let before = memory(service.pid());
    let (most, over, sent) = (AtomicU64::new(0), AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                most.fetch_max(memory(service.pid()), Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        let viewers: Vec<_> = (0..VIEWERS)
            .map(|k| {
                let (kind, bytes) = &kinds[k % kinds.len()];
                let (mut stream, status) = connect(address);
                assert_eq!(status, "101");
                let sent = &sent;
                scope.spawn(move || {
                    let begun = Instant::now();
                    // Pongs ask for no answer: such a viewer stays, and is left alone.
                    let patience =
                        if *kind == "pongs" { Duration::from_secs(15) } else { PATIENCE };
                    while stream.write_all(bytes).is_ok() {
                        sent.fetch_add(bytes.len() as u64, Ordering::Relaxed);
                        if begun.elapsed() > patience {
                            assert_eq!(*kind, "pongs", "a viewer with {kind} is not closed");
                            return;
                        }
                    }
                    println!("a viewer with {kind} was closed after {:.1?}", begun.elapsed());
                })
            })
            .collect();
        for viewer in viewers {
            viewer.join().expect("closed");
        }
        over.store(true, Ordering::Relaxed);
    });
    let grown = most.load(Ordering::Relaxed).saturating_sub(before);
    println!(
        "memory grew by {:.1} MiB at most while {} MiB were sent",
        grown as f64 / 1024.0,
        sent.load(Ordering::Relaxed) >> 20
    );
    assert!(grown < VIEWERS as u64 * (2 << 10), "memory grew by {grown} KiB");
    assert_eq!(service.job(&id)["state"], "running");
}

/// A viewer that finds no seat is no error of the service.
#[test]
fn viewers_that_are_refused_are_no_errors_in_the_log() {
    let folder = tempfile::tempdir().expect("a folder");
    let (service, address) = watched(folder.path());
    let seated: Vec<_> = (0..64).map(|_| connect(address)).collect();
    assert!(seated.iter().all(|(_, status)| status == "101"));
    for _ in 0..10 {
        assert_eq!(connect(address).1, "503");
    }
    // What is said to be full, or not made here, is none either.
    let body = r#"{"op":1}"#;
    assert_eq!(service.send("POST", "/jobs", Some(body)).status / 100, 4);
    assert!(service.terminate().0.success());
    let said = std::fs::read_to_string(folder.path().join("stderr")).expect("its log");
    assert!(said.contains("stopped") && !said.contains("ERROR"), "{said}");
}
