//! 5 · The live view: the samples of a running job, for viewers that follow it.
//!
//! Invariant: a viewer changes nothing about a run. At most one run is on show, and of its samples no more
//! than viewers draw; the log has them all. A run hands a sample over once, however many follow, and never waits:
//! a follower that takes it too late misses it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use prost::Message as _;
use tokio::sync::broadcast;

use crate::log::log_time;
use crate::log::messages::{self, Message};
use crate::log::scene::{BODY_FRAME, SceneGeometry};
use crate::log::schema::Channel;
use crate::solve::trajectory::Sample;

/// Pause between samples on show: 30 a second.
const FRAME: Duration = Duration::from_millis(33);

/// Pause between drawings of the scene: a viewer that comes late misses what was sent before.
const SCENE: Duration = Duration::from_secs(1);

/// Frames that are kept for viewers that are behind.
const KEPT: usize = 8;

/// A sample as viewers see it.
#[derive(Debug)]
pub struct Frame {
    /// Log time in nanoseconds.
    pub time_ns: u64,
    /// One message a channel, encoded as in a log.
    pub messages: Vec<(Channel, Vec<u8>)>,
}

/// The stage: runs show themselves on it, one at a time.
#[derive(Debug)]
pub struct Live {
    frames: broadcast::Sender<Arc<Frame>>,
    floor: Mutex<Floor>,
}

/// The run on show, and when its next messages are due.
#[derive(Debug)]
struct Floor {
    holder: Option<u64>,
    next_id: u64,
    next: Instant,
    next_scene: Instant,
    /// The last quaternion on show: the next has the nearer sign.
    turn: Option<[f64; 4]>,
}

impl Default for Live {
    fn default() -> Self {
        let now = Instant::now();
        let floor = Floor { holder: None, next_id: 0, next: now, next_scene: now, turn: None };
        Self { frames: broadcast::Sender::new(KEPT), floor: Mutex::new(floor) }
    }
}

impl Live {
    /// Subscribes to the frames shown from now on. Nothing is prepared unless a client follows.
    pub fn watch(&self) -> broadcast::Receiver<Arc<Frame>> {
        self.frames.subscribe()
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
    /// Shows a sample, if this run is on show, a client follows, and the last one was shown long enough ago.
    pub(crate) fn sample<const N: usize>(&self, sample: &Sample<N>) {
        let live = &self.live;
        let now = Instant::now();
        let mut floor = live.floor();
        if now < floor.next || live.frames.receiver_count() == 0 {
            return;
        }
        match floor.holder {
            Some(holder) if holder != self.id => return,
            Some(_) => {}
            None => {
                floor.holder = Some(self.id);
                floor.next_scene = now;
                floor.turn = None;
            }
        }
        let Some(time_ns) = log_time(self.epoch_ns, sample.time_s) else { return };
        floor.next = now + FRAME;
        let mut messages = Vec::new();
        if now >= floor.next_scene {
            floor.next_scene = now + SCENE;
            let body = (N == 3).then(|| self.scene.body(time_ns));
            let sources = self.scene.sources(time_ns);
            let drawn = [(Channel::SceneBody, body), (Channel::SceneSources, sources)];
            let drawn = drawn.into_iter().filter_map(|(channel, scene)| Some((channel, scene?)));
            messages.extend(drawn.map(|(channel, scene)| (channel, scene.encode_to_vec())));
        }
        let found = sample.attitude.as_ref().and_then(messages::quaternion);
        let turn = found.map(|found| messages::nearer_sign(floor.turn, found));
        floor.turn = turn;
        messages.extend(Channel::all().into_iter().filter_map(|channel| {
            let bytes = match channel {
                Channel::Tf => {
                    let mut sources = self.scene.frames(sample.time_s, time_ns);
                    let reference = sample.pointing.map(|pointed| pointed.frame);
                    sources.extend(messages::reference_frame(reference, time_ns));
                    messages::frames(turn?, time_ns, BODY_FRAME, sources).encode_to_vec()
                }
                _ => {
                    let mut bytes = Vec::new();
                    Message::of_sample(channel, sample, turn)?.encode(&mut bytes);
                    bytes
                }
            };
            Some((channel, bytes))
        }));
        // It is no error if no receiver is left.
        let _ = live.frames.send(Arc::new(Frame { time_ns, messages }));
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
