//! The endpoint of the live view: the frames of a run, over Foxglove's WebSocket protocol.
//!
//! Invariants: a viewer comes in through the gate, as every request does. None of its messages
//! reaches a run; frames that it does not take in time are lost to it, and one that takes nothing,
//! or sends nothing, is disconnected. A viewer that owes us the taking of an answer is not read from:
//! nothing piles up for it, whatever it sends.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use axum::Router;
use axum::extract::State as Shared;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::middleware::from_fn_with_state;
use axum::response::Response;
use axum::routing::get;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use futures_util::SinkExt;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::gate::{self, Gate};
use super::problem::Problem;
use crate::live::{Frame, Live};
use crate::log::schema::{Channel, ENCODING};

/// Names of the protocol, of which we use the common part.
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Number of viewers at once.
pub(super) const SEATS: usize = 64;

/// Longest message of a viewer, bytes: it asks for channels, no more.
const MAX_MESSAGE: usize = 64 << 10;

/// Number of subscriptions of one viewer.
const MAX_SUBSCRIPTIONS: usize = 256;

/// Longest time in which a viewer does not take what is sent.
const WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// Interval in which a viewer has to send something; it answers a ping.
const PULSE: Duration = Duration::from_secs(20);

/// First bytes of binary messages.
const MESSAGE_DATA: u8 = 1;
const TIME: u8 = 2;

#[derive(Clone, Debug)]
struct House {
    live: Arc<Live>,
    seats: Arc<Semaphore>,
    stop: watch::Receiver<bool>,
}

/// Returns the router of the live view: one path, for WebSockets.
pub(super) fn router(live: Arc<Live>, gate: Gate, stop: watch::Receiver<bool>) -> Router {
    let house = House { live, seats: Arc::new(Semaphore::new(SEATS)), stop };
    Router::new()
        .route("/", get(come_in).route_layer(from_fn_with_state(gate, gate::look_on)))
        .with_state(house)
}

async fn come_in(
    Shared(house): Shared<House>,
    upgrade: WebSocketUpgrade,
) -> Result<Response, Problem> {
    // A frame is not gathered first and measured then.
    let upgrade =
        upgrade.protocols(PROTOCOLS).max_message_size(MAX_MESSAGE).max_frame_size(MAX_MESSAGE);
    if upgrade.selected_protocol().is_none() {
        return Err(Problem::other_protocol());
    }
    let seat = house.seats.clone().try_acquire_owned().map_err(|_| Problem::no_seat())?;
    Ok(upgrade.on_upgrade(move |socket| Viewer::new(socket, house.live).look_on(house.stop, seat)))
}

/// Messages that viewers are sent first.
static WELCOME: LazyLock<[String; 2]> = LazyLock::new(|| {
    // Topics of several bodies have names that only a scene knows.
    let known =
        Channel::all().into_iter().zip(0..).filter(|(channel, _)| !channel.is_of_each_body());
    let channels: Vec<Value> = known.map(advertised).collect();
    let info = json!({ "op": "serverInfo", "name": "vpd", "capabilities": ["time"] });
    [info.to_string(), json!({ "op": "advertise", "channels": channels }).to_string()]
});

fn advertised((channel, id): (Channel, u64)) -> Value {
    let schema = channel.schema();
    json!({
        "id": id,
        "topic": channel.topic(),
        "encoding": ENCODING,
        "schemaName": schema.name,
        "schemaEncoding": ENCODING,
        "schema": BASE64_STANDARD.encode(schema.descriptors),
    })
}

/// Messages of a viewer; we do not offer the rest of the protocol.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
enum Wish {
    Subscribe { subscriptions: Vec<Subscription> },
    Unsubscribe { subscription_ids: Vec<u32> },
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: usize,
}

/// Reason why the view of a viewer ends.
enum Gone {
    /// It has left, or reads nothing: no reason is sent.
    Left,
    /// It is to be disconnected.
    Dismissed,
}

struct Viewer {
    socket: WebSocket,
    live: Arc<Live>,
    subscriptions: BTreeMap<u32, Channel>,
    /// Receiver of frames while it subscribes to anything.
    frames: Option<broadcast::Receiver<Arc<Frame>>>,
}

impl Viewer {
    fn new(socket: WebSocket, live: Arc<Live>) -> Self {
        Self { socket, live, subscriptions: BTreeMap::new(), frames: None }
    }

    /// Serves the viewer until it leaves, is disconnected, or the service stops.
    async fn look_on(mut self, mut stop: watch::Receiver<bool>, _seat: OwnedSemaphorePermit) {
        let welcome = async {
            for text in WELCOME.iter() {
                self.socket.feed(Message::text(text.as_str())).await?;
            }
            self.socket.flush().await
        };
        let mut shown = in_time(welcome).await;
        let mut pulse = tokio::time::interval(PULSE);
        let mut heard = true;
        while shown.is_ok() {
            shown = tokio::select! {
                said = self.socket.recv() => {
                    heard = true;
                    match said {
                        Some(Ok(said)) => self.hear(&said).await,
                        _ => Err(Gone::Left),
                    }
                }
                frame = next(&mut self.frames) => self.show(&frame).await,
                _ = pulse.tick() => match std::mem::take(&mut heard) {
                    true => self.send(Message::Ping(Default::default())).await,
                    false => Err(Gone::Dismissed),
                },
                _ = stop.changed() => Err(Gone::Dismissed),
            };
        }
        if let Err(Gone::Dismissed) = shown {
            let _ = self.send(Message::Close(None)).await;
        }
    }

    /// Follows a message of the viewer; one that is not allowed, or not understood, is ignored.
    async fn hear(&mut self, said: &Message) -> Result<(), Gone> {
        match said {
            Message::Text(text) => self.follow(text.as_bytes()),
            // The protocol layer has prepared its answer: it goes out before the next is read.
            Message::Ping(_) | Message::Close(_) => return in_time(self.socket.flush()).await,
            Message::Binary(_) | Message::Pong(_) => {}
        }
        Ok(())
    }

    fn follow(&mut self, text: &[u8]) {
        match serde_json::from_slice(text) {
            Ok(Wish::Subscribe { subscriptions }) => {
                for Subscription { id, channel_id } in subscriptions {
                    if let Some(channel) = Channel::all().get(channel_id)
                        && self.subscriptions.len() < MAX_SUBSCRIPTIONS
                    {
                        self.subscriptions.entry(id).or_insert(*channel);
                    }
                }
            }
            Ok(Wish::Unsubscribe { subscription_ids }) => {
                self.subscriptions.retain(|id, _| !subscription_ids.contains(id));
            }
            Err(_) => return,
        }
        let watches = !self.subscriptions.is_empty();
        match &self.frames {
            None if watches => self.frames = Some(self.live.watch()),
            Some(_) if !watches => self.frames = None,
            _ => {}
        }
    }

    async fn show(&mut self, frame: &Frame) -> Result<(), Gone> {
        let time = [&[TIME][..], &frame.time_ns.to_le_bytes()].concat();
        let Self { socket, subscriptions, .. } = self;
        // Each message is made once there is room for it.
        in_time(async {
            socket.feed(Message::binary(time)).await?;
            for (channel, bytes) in &frame.messages {
                for (id, wanted) in &*subscriptions {
                    if wanted == channel {
                        let (id, time) = (id.to_le_bytes(), frame.time_ns.to_le_bytes());
                        let message = [&[MESSAGE_DATA][..], &id, &time, bytes].concat();
                        socket.feed(Message::binary(message)).await?;
                    }
                }
            }
            socket.flush().await
        })
        .await
    }

    /// Sends a message.
    async fn send(&mut self, message: Message) -> Result<(), Gone> {
        in_time(self.socket.send(message)).await
    }
}

/// Waits until messages are sent; a viewer that does not take them in time has left.
async fn in_time(sent: impl Future<Output = Result<(), axum::Error>>) -> Result<(), Gone> {
    let sent = tokio::time::timeout(WRITE_TIMEOUT, sent).await;
    sent.ok().and_then(Result::ok).ok_or(Gone::Left)
}

/// Returns the next frame; never, for a viewer that watches nothing.
async fn next(frames: &mut Option<broadcast::Receiver<Arc<Frame>>>) -> Arc<Frame> {
    if let Some(frames) = frames {
        loop {
            match frames.recv().await {
                Ok(frame) => return frame,
                // Missed frames are lost.
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => break,
            }
        }
    }
    std::future::pending().await
}
