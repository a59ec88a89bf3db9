//! 5 · The live view: the samples of a running job over Foxglove's WebSocket protocol.
//!
//! Invariant: a viewer changes nothing about a run. At most one run is on show, and of its samples no more
//! than viewers draw; the log has them all.

use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use foxglove::messages::SceneUpdate;
use foxglove::websocket::Capability;
use foxglove::{
    Context, FoxgloveError, PartialMetadata, RawChannel, Schema, WebSocketServerHandle,
};
use prost::Message;

use crate::log::log_time;
use crate::log::messages;
use crate::log::scene::{BODY_FRAME, SceneGeometry};
use crate::log::schema::{Channel, ENCODING};
use crate::solve::trajectory::Sample;

/// Pause between samples on show: 30 a second.
const FRAME: Duration = Duration::from_millis(33);

/// Pause between drawings of the scene: a viewer that comes late misses what was sent before.
const SCENE: Duration = Duration::from_secs(1);

/// A server of viewers. It ends when it is dropped.
pub struct Live {
    server: WebSocketServerHandle,
    address: SocketAddr,
    /// Holds the channels; the server does not.
    _context: Arc<Context>,
    channels: Vec<(Channel, Arc<RawChannel>)>,
    floor: Mutex<Floor>,
}

/// Who is on show, and what is due.
#[derive(Debug)]
struct Floor {
    holder: Option<u64>,
    next_id: u64,
    next: Instant,
    next_scene: Instant,
}

impl fmt::Debug for Live {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Live").field("address", &self.address).finish_non_exhaustive()
    }
}

impl Live {
    /// Listens on `address`; port 0 for any.
    ///
    /// # Errors
    /// If the address cannot be had.
    pub async fn listen(address: SocketAddr) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let channels = Channel::all().into_iter().map(|channel| {
            let schema = channel.schema();
            let schema = Schema::new(schema.name, ENCODING, schema.descriptors.into_owned());
            let built = context.channel_builder(channel.topic()).message_encoding(ENCODING);
            Ok((channel, built.schema(schema).build_raw()?))
        });
        let channels = channels.collect::<Result<_, FoxgloveError>>()?;
        let server = context
            .websocket_server()
            .name("vpd")
            .capabilities([Capability::Time])
            .bind(address.ip().to_string(), address.port())
            .start()
            .await?;
        let now = Instant::now();
        let floor = Floor { holder: None, next_id: 0, next: now, next_scene: now };
        let address = SocketAddr::new(address.ip(), server.port());
        Ok(Self { server, address, _context: context, channels, floor: Mutex::new(floor) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Announces a run: it is on show as soon as no other is.
    pub(crate) fn announce(self: &Arc<Self>, epoch_ns: u64, scene: SceneGeometry) -> Show {
        let mut floor = self.floor();
        floor.next_id += 1;
        Show { live: self.clone(), id: floor.next_id, epoch_ns, scene }
    }

    fn floor(&self) -> MutexGuard<'_, Floor> {
        self.floor.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn send(&self, channel: Channel, time_ns: u64, bytes: &[u8]) {
        if let Some((_, out)) = self.channels.iter().find(|(own, _)| *own == channel) {
            out.log_with_meta(bytes, PartialMetadata::with_log_time(time_ns));
        }
    }
}

/// A run that wants to be seen.
#[derive(Debug)]
pub(crate) struct Show {
    live: Arc<Live>,
    id: u64,
    epoch_ns: u64,
    scene: SceneGeometry,
}

impl Show {
    /// Shows a sample, if this run is on show, somebody looks, and the last one was shown long enough ago.
    pub(crate) fn sample<const N: usize>(&self, sample: &Sample<N>) {
        let live = &self.live;
        let now = Instant::now();
        let mut floor = live.floor();
        if live.server.client_count() == 0 || now < floor.next {
            return;
        }
        match floor.holder {
            Some(holder) if holder != self.id => return,
            Some(_) => {}
            None => {
                floor.holder = Some(self.id);
                floor.next_scene = now;
            }
        }
        let Some(time_ns) = log_time(self.epoch_ns, sample.time_s) else { return };
        floor.next = now + FRAME;
        live.server.broadcast_time(time_ns);
        if now >= floor.next_scene {
            floor.next_scene = now + SCENE;
            self.draw(N, time_ns);
        }
        for (channel, _) in &live.channels {
            if let Some(bytes) = messages::of_sample(*channel, sample, time_ns, BODY_FRAME) {
                live.send(*channel, time_ns, &bytes);
            }
        }
    }

    fn draw(&self, n: usize, time_ns: u64) {
        let send = |channel, update: &SceneUpdate| {
            self.live.send(channel, time_ns, &update.encode_to_vec());
        };
        if n == 3 {
            send(Channel::SceneBody, &self.scene.body(time_ns));
        }
        if let Some(sources) = self.scene.sources(time_ns) {
            send(Channel::SceneSources, &sources);
        }
    }
}

impl Drop for Show {
    fn drop(&mut self) {
        let mut floor = self.live.floor();
        if floor.holder == Some(self.id) {
            floor.holder = None;
        }
    }
}
