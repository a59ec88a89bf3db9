//! Links for viewers, which can send no header: signed, to read one thing, for a day.
//!
//! Invariant: a link holds no token. What it opens and when it ends are what was signed; the key does not leave
//! the data directory.

use std::fmt;
use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use hmac::{Hmac, Mac};
use sha2::Sha256;
use tempfile::NamedTempFile;
use uuid::Uuid;

#[cfg(feature = "cluster")]
use super::store::bucket::Bucket;
use super::store::{parse_id, put_aside};
#[cfg(feature = "cluster")]
use super::{ServeError, chain};

/// Longest time that a link is valid, seconds.
const LIFE_S: u64 = 86_400;

/// Ends of links are whole hours: a job that is requested twice looks the same twice.
const GRAIN_S: u64 = 3600;

/// The file of the key, in the data directory.
const FILE: &str = "link-key";

const KEY_BYTES: usize = 32;

/// Target of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Subject {
    /// The log of a job, finished or growing.
    Log(Uuid),
    /// The live view.
    Live,
}

impl Subject {
    /// Returns the target at a path, if links lead there.
    pub(super) fn at(path: &str) -> Option<Self> {
        let (id, file) = path.strip_prefix("/jobs/")?.split_once('/')?;
        let is_log = matches!(file, "log.mcap" | "live.mcap");
        parse_id(id).filter(|_| is_log).map(Self::Log)
    }
}

/// The text that is signed.
impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Log(id) => write!(f, "read the log of {id}"),
            Self::Live => f.write_str("read the live view"),
        }
    }
}

/// Makes links and recognises its own.
#[derive(Clone)]
pub(super) struct LinkKey(Hmac<Sha256>);

/// Does not show the key.
impl fmt::Debug for LinkKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a key of links")
    }
}

impl LinkKey {
    /// Returns the key of a data directory, made if there is none: links outlive a restart.
    pub(super) fn of(data: &Path) -> io::Result<Self> {
        let path = data.join(FILE);
        // Opening anything but a file may block forever.
        if path.symlink_metadata().is_ok_and(|found| !found.is_file()) {
            put_aside(&path)?;
        }
        let key = match std::fs::read(&path) {
            Ok(key) if key.len() == KEY_BYTES => key,
            Ok(_) => {
                tracing::warn!("the key of links is damaged: links made before are void");
                make(data, &path)?
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => make(data, &path)?,
            Err(error) => return Err(error),
        };
        Hmac::new_from_slice(&key).map(Self).map_err(io::Error::other)
    }

    /// Returns the key of a bucket, which all its services have.
    #[cfg(feature = "cluster")]
    pub(super) async fn shared(bucket: &Bucket) -> Result<Self, ServeError> {
        let unreadable = |message: String| ServeError::Record { message };
        let key = bucket.link_key(drawn()?).await.map_err(|error| unreadable(chain(&error)))?;
        Hmac::new_from_slice(&key).map(Self).map_err(|error| unreadable(error.to_string()))
    }

    /// Returns the query of a link that is valid for about a day.
    pub(super) fn query(&self, subject: Subject) -> String {
        let end_s = (now_s() / GRAIN_S) * GRAIN_S + LIFE_S;
        let signature = self.signed(subject, end_s).finalize().into_bytes();
        let hex: String = signature.iter().map(|byte| format!("{byte:02x}")).collect();
        format!("expires={end_s}&signature={hex}")
    }

    /// Returns whether a query is that of a link of ours to `subject`, and has not ended. Takes as
    /// long for a wrong signature as for the right one.
    pub(super) fn opens(&self, subject: Subject, query: &str) -> bool {
        let field = |name| query.split('&').find_map(|pair| pair.strip_prefix(name));
        let end_s = field("expires=").and_then(|text| text.parse().ok());
        let signature = field("signature=").and_then(bytes_of_hex);
        let (Some(end_s), Some(signature)) = (end_s, signature) else { return false };
        now_s() < end_s && self.signed(subject, end_s).verify_slice(&signature).is_ok()
    }

    fn signed(&self, subject: Subject, end_s: u64) -> Hmac<Sha256> {
        self.0.clone().chain_update(format!("{subject} until {end_s}"))
    }
}

fn drawn() -> io::Result<Vec<u8>> {
    let mut key = vec![0; KEY_BYTES];
    getrandom::fill(&mut key).map_err(io::Error::other)?;
    Ok(key)
}

/// Draws a key and puts it in its place, whole or not at all, for the owner alone.
fn make(data: &Path, path: &Path) -> io::Result<Vec<u8>> {
    let key = drawn()?;
    // A file of this kind has the mode 600.
    let mut file = NamedTempFile::new_in(data)?;
    file.write_all(&key)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(key)
}

fn bytes_of_hex(text: &str) -> Option<Vec<u8>> {
    let digit = |digit: &u8| char::from(*digit).to_digit(16).map(|digit| digit as u8);
    let pairs = text.as_bytes().chunks(2);
    pairs.map(|pair| Some(digit(pair.first()?)? << 4 | digit(pair.get(1)?)?)).collect()
}

fn now_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO).as_secs()
}
