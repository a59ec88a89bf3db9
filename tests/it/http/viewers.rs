//! The live view: which clients may follow, what they see, and that a run is not affected.

use std::io::Read;
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::handshake::HandshakeError;
use tungstenite::{Error, Message, WebSocket};

use super::{PATIENCE, Server, directory, long, service, until};

const READ: &str = "read-token-0123456789";

/// Connects a viewer; returns a socket, or the status with which it was refused.
fn connect(address: &str, headers: &[(&'static str, &str)]) -> Result<WebSocket<TcpStream>, u16> {
    let mut request = address.into_client_request().expect("an address");
    let place: SocketAddr =
        request.uri().authority().expect("an address").as_str().parse().expect("a number");
    let own = request.headers_mut();
    own.insert("sec-websocket-protocol", "foxglove.sdk.v1".parse().expect("text"));
    for (name, value) in headers {
        own.insert(*name, value.parse().expect("text"));
    }
    let stream = TcpStream::connect(place).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
    match tungstenite::client(request, stream) {
        Ok((socket, _)) => Ok(socket),
        Err(HandshakeError::Failure(Error::Http(answer))) => Err(answer.status().as_u16()),
        Err(error) => panic!("{error}"),
    }
}

fn say(socket: &mut WebSocket<TcpStream>, text: &Value) {
    socket.send(Message::text(text.to_string())).expect("sent");
}

/// Reads on until something has the wanted form.
fn read<T>(socket: &mut WebSocket<TcpStream>, wanted: impl Fn(&Message) -> Option<T>) -> T {
    loop {
        if let Some(found) = wanted(&socket.read().expect("a message")) {
            return found;
        }
    }
}

/// Subscribes to a topic under the number 7, and reads a message of it.
fn watch(socket: &mut WebSocket<TcpStream>, topic: &str) -> (u64, Vec<u8>) {
    let channels = read(socket, |message| {
        let text: Value = serde_json::from_str(message.to_text().ok()?).ok()?;
        (text["op"] == "advertise").then(|| text["channels"].clone())
    });
    let channels = channels.as_array().expect("channels");
    let channel = channels.iter().find(|channel| channel["topic"] == topic).expect("the topic");
    let wanted = json!([{ "id": 7, "channelId": channel["id"] }]);
    // A message that is not understood is ignored.
    socket.send(Message::text("nonsense")).expect("sent");
    socket.send(Message::binary(vec![1, 2, 3])).expect("sent");
    say(socket, &json!({ "op": "subscribe", "subscriptions": [{ "id": 9, "channelId": 10_000 }] }));
    say(socket, &json!({ "op": "subscribe", "subscriptions": wanted }));
    read(socket, |message| match message {
        Message::Binary(bytes) if bytes.first() == Some(&1) => {
            assert_eq!(bytes[1..5], 7_u32.to_le_bytes());
            let time_ns = u64::from_le_bytes(bytes[5..13].try_into().expect("eight bytes"));
            Some((time_ns, bytes[13..].to_vec()))
        }
        _ => None,
    })
}

/// Returns a job for hours, with samples often enough to be shown.
fn shown() -> Value {
    let mut scenario = long();
    scenario["log"]["every"] = json!(1000);
    scenario
}

/// Returns such a job, once it runs.
fn running(server: &Server) -> String {
    let id = server.submit(&shown());
    server.wait(&id, "running");
    id
}

/// Returns the address of the live view, as a job that runs has it.
fn address(server: &Server, id: &str, headers: &[(&str, &str)]) -> String {
    let job = server.get_with(&format!("/jobs/{id}"), headers).json();
    job["links"]["live_viewers"]["address"].as_str().expect("an address").to_owned()
}

#[test]
fn a_viewer_sees_the_samples_of_a_running_job() {
    let data = directory();
    let server = service(&data).live().start();
    let id = running(&server);
    let address = address(&server, &id, &[]);
    let mut socket = connect(&address, &[]).expect("a seat");
    let (first_ns, bytes) = watch(&mut socket, "/tf");
    assert!(!bytes.is_empty());
    // The clock is that of the log, which begins in 2026.
    let epoch_ns = 1_767_225_600_000_000_000;
    assert!((epoch_ns..epoch_ns + 1_000_000_000_000_000_000).contains(&first_ns));
    let times: Vec<u64> = (0..3)
        .map(|_| {
            read(&mut socket, |message| match message {
                Message::Binary(bytes) if bytes.first() == Some(&2) => {
                    Some(u64::from_le_bytes(bytes[1..9].try_into().expect("eight bytes")))
                }
                _ => None,
            })
        })
        .collect();
    assert!(times.iter().all(|time_ns| *time_ns > first_ns) && times.is_sorted(), "{times:?}");
    // A viewer that unsubscribes is sent nothing more, and stays connected.
    say(&mut socket, &json!({ "op": "unsubscribe", "subscriptionIds": [7] }));
    socket.send(Message::Ping(vec![1].into())).expect("sent");
    read(&mut socket, |message| matches!(message, Message::Pong(_)).then_some(()));
    socket.get_mut().set_read_timeout(Some(Duration::from_millis(300))).expect("a socket");
    let rest = socket.read();
    assert!(matches!(rest, Err(Error::Io(_))), "{rest:?}");
}

#[test]
fn a_viewer_comes_in_through_the_gate() {
    let data = directory();
    let named = "https://app.foxglove.dev".parse().expect("an origin");
    let tokens = format!("submit {READ}");
    let server = service(&data).cors(named).tokens(&tokens).live().start();
    let bearer = format!("Bearer {READ}");
    let headers = [("authorization", bearer.as_str()), ("content-type", "application/json")];
    let body = shown().to_string();
    let id = server.send("POST", "/jobs", &headers, Some(body.as_bytes())).json()["id"].clone();
    let id = id.as_str().expect("an id");
    until("it runs", || {
        let job = server.get_with(&format!("/jobs/{id}"), &headers).json();
        (job["state"] == "running").then_some(())
    });
    let signed = address(&server, id, &headers);
    let (plain, query) = signed.split_once("/?").expect("a signed address");

    let come =
        |address: &str, headers: &[(&'static str, &str)]| connect(address, headers).map(drop);
    // Admitted: the link, the token, the desktop (no page), pages that were named.
    assert_eq!(come(&signed, &[]), Ok(()));
    assert_eq!(come(plain, &[("authorization", &bearer)]), Ok(()));
    assert_eq!(come(&signed, &[("origin", "https://app.foxglove.dev")]), Ok(()));
    let own = plain.replace("ws://", "http://");
    assert_eq!(come(&signed, &[("origin", &own)]), Ok(()));
    assert_eq!(come(&signed, &[("sec-websocket-protocol", "foxglove.websocket.v1")]), Ok(()));
    assert_eq!(come(&signed, &[("sec-websocket-protocol", "x, foxglove.sdk.v1")]), Ok(()));

    assert_eq!(come(plain, &[]), Err(401));
    assert_eq!(come(plain, &[("authorization", "Bearer another-token-0123456789")]), Err(401));
    let (begin, last) = signed.split_at(signed.len() - 1);
    let other = if last == "0" { "1" } else { "0" };
    assert_eq!(come(&format!("{begin}{other}"), &[]), Err(401));
    // The link of a log opens the log alone.
    let job = server.get_with(&format!("/jobs/{id}"), &headers).json();
    let (_, of_log) =
        job["links"]["live"].as_str().expect("a link").split_once('?').expect("signed");
    assert_eq!(come(&format!("{plain}/?{of_log}"), &[]), Err(401));
    server.get(&format!("/jobs/{id}/live.mcap?{query}")).problem(401, "unauthorized");
    for origin in ["https://evil.example", "http://app.foxglove.dev", "null", "http://127.0.0.1:1"]
    {
        assert_eq!(come(&signed, &[("origin", origin)]), Err(403), "{origin}");
    }
    assert_eq!(come(&signed, &[("sec-fetch-site", "cross-site")]), Err(403));
    assert_eq!(come(&signed, &[("host", "evil.example")]), Err(421));
    assert_eq!(come(&signed, &[("sec-websocket-protocol", "other")]), Err(400));
}

#[test]
fn a_viewer_that_says_nothing_is_closed() {
    let data = directory();
    let server = service(&data).live().start();
    let id = running(&server);
    let address = address(&server, &id, &[]);
    let place = address.strip_prefix("ws://").expect("an address");
    let mut silent = TcpStream::connect(place).expect("a connection");
    silent.set_read_timeout(Some(PATIENCE)).expect("a socket");
    let mut rest = Vec::new();
    silent.read_to_end(&mut rest).expect("closed, not left waiting");
}

#[test]
fn viewers_beyond_the_seats_wait_outside_and_no_run_notices() {
    const ATTEMPTS: usize = 500;
    let data = directory();
    let limits = |limits: &mut vpd::serve::Limits| limits.connections_per_client = 1024;
    let server = service(&data).live().limits(limits).start();
    let id = running(&server);
    let address = address(&server, &id, &[]);
    let steps = || server.job(&id)["progress"]["steps_done"].as_u64().expect("steps");
    let made_in = |span: Duration| {
        let before = steps();
        std::thread::sleep(span);
        steps() - before
    };
    let alone = made_in(Duration::from_millis(500));
    let mut seated = Vec::new();
    let mut turned_away = 0;
    for _ in 0..ATTEMPTS {
        match connect(&address, &[]) {
            Ok(mut socket) => {
                watch(&mut socket, "/state");
                seated.push(socket);
            }
            Err(status) => {
                assert_eq!(status, 503);
                turned_away += 1;
            }
        }
    }
    let followed = made_in(Duration::from_millis(500));
    println!(
        "{} of {ATTEMPTS} viewers seated: {followed} steps in half a second with them, {alone} alone",
        seated.len()
    );
    assert_eq!((seated.len(), turned_away), (64, ATTEMPTS - 64));
    assert!(followed > 0);
    // A viewer that leaves makes room.
    seated.pop();
    until("a free seat", || connect(&address, &[]).ok());
}
