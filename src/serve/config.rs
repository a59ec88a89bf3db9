//! Configuration of the service: addresses, access, and limits.

use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::str::FromStr;

use subtle::ConstantTimeEq;

#[cfg(feature = "cluster")]
use super::ClusterConfig;
use super::engine::Refusal;
use crate::plan::{LOG_FIXED_BYTES, Plan};
use crate::scenario::twelve_digits;

/// Shortest token that is taken, bytes: long enough not to be guessed.
const SHORTEST_TOKEN: usize = 16;

/// Configuration of the service.
#[derive(Clone, Debug)]
pub struct ServeConfig {
    /// Directory of jobs and logs; made if it is not there. One service at a time.
    pub data: PathBuf,
    /// Number of jobs that run at once, at least 1.
    pub workers: usize,
    /// Limits of what is taken on.
    pub limits: Limits,
    /// Web pages that may read the logs.
    pub cors: Cors,
    /// Address under which viewers reach the service, as `https://example.org/vpd`; absent: the one
    /// that the client used.
    pub public_url: Option<String>,
    /// Names under which clients may call the service, in addition to `localhost`, addresses and the name in
    /// `public_url`. Any other name is a sign of DNS rebinding.
    pub hosts: Vec<String>,
    /// Tokens with their scopes; without any token, every client may do everything.
    pub tokens: Tokens,
    /// Whether to serve other machines without tokens.
    pub insecure: bool,
    /// Address on which viewers follow while a job runs; port 0 for any.
    pub live: Option<SocketAddr>,
    /// The `vpd` program, which runs jobs that may have ended this process in a process of their
    /// own; if absent, such jobs run within this one.
    pub program: Option<PathBuf>,
    /// Way to the other machines that run the jobs; if absent, this one runs them. Otherwise `data`
    /// holds copies of logs and nothing that is missed.
    #[cfg(feature = "cluster")]
    pub cluster: Option<ClusterConfig>,
}

impl ServeConfig {
    /// Returns the configuration of a service of one worker on `data` with the limits of
    /// [`Limits::default`], for this machine.
    pub fn new(data: impl Into<PathBuf>) -> Self {
        Self {
            data: data.into(),
            workers: 1,
            limits: Limits::default(),
            cors: Cors::Any,
            public_url: None,
            hosts: Vec::new(),
            tokens: Tokens::default(),
            insecure: false,
            live: None,
            program: None,
            #[cfg(feature = "cluster")]
            cluster: None,
        }
    }
}

/// Limits of what the service takes on. Anything beyond is refused with the figures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Jobs that may wait; one more is answered 429.
    pub queue: usize,
    /// Longest estimated computing time of a job in seconds; more is answered 422.
    pub run_s: f64,
    /// Largest estimated log in bytes; more is answered 422.
    pub log_bytes: u64,
    /// Bytes of memory that the runs at one time may take by estimate; a job that takes more by itself is answered
    /// 422, the others wait for each other.
    pub memory_bytes: u64,
    /// Bytes of the disk that logs leave free; a job without room is answered 507.
    pub reserve_bytes: u64,
    /// Connections at once; more are answered 503.
    pub connections: usize,
    /// Connections at once from one address; more are answered 503.
    pub connections_per_client: usize,
    /// Requests a second from one address, on average; more are answered 429.
    pub requests_per_s: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            queue: 10_000,
            run_s: 7.0 * 86_400.0,
            log_bytes: 16 << 30,
            memory_bytes: 4 << 30,
            reserve_bytes: 64 << 20,
            connections: 1024,
            connections_per_client: 64,
            requests_per_s: 1000,
        }
    }
}

impl Limits {
    /// Refuses a job that is too large by itself.
    pub(super) fn admit(&self, plan: &Plan) -> Result<(), Refusal> {
        if !(plan.run_s <= self.run_s) {
            let (estimate_s, limit_s) = (plan.run_s, self.run_s);
            let pointer = if plan.asked.steps.is_some() { "/steps" } else { "/duration_s" };
            return Err(Refusal::TooExpensive { estimate_s, limit_s, pointer });
        }
        if plan.log_bytes > self.log_bytes {
            // In proportion, and a little more to be on the safe side.
            let samples_bytes = |log_bytes: u64| log_bytes.saturating_sub(LOG_FIXED_BYTES) as f64;
            let too_many_times =
                samples_bytes(plan.log_bytes) / samples_bytes(self.log_bytes).max(1.0);
            let every = ((plan.every as f64 * too_many_times * 1.01).ceil() as u64).min(plan.steps);
            // Is it too large even with the first and the last sample alone?
            let least = LOG_FIXED_BYTES as f64
                + 2.0 * samples_bytes(plan.log_bytes) / plan.samples.max(2) as f64;
            let (pointer, advice) = match plan.asked.log.every_s {
                _ if least > self.log_bytes as f64 => {
                    ("/log/channels", "log fewer channels".to_owned())
                }
                None => ("/log/every", format!("log every {every} steps, or fewer channels")),
                Some(_) => {
                    let spacing_s = spacing_s(plan, every);
                    ("/log/every_s", format!("log every {spacing_s} s, or fewer channels"))
                }
            };
            let (estimate, limit) = (plan.log_bytes, self.log_bytes);
            return Err(Refusal::LogTooLarge { estimate, limit, advice, pointer });
        }
        if plan.memory_bytes > self.memory_bytes {
            let (estimate, limit) = (plan.memory_bytes, self.memory_bytes);
            return Err(Refusal::TooMuchMemory { estimate, limit });
        }
        Ok(())
    }
}

/// Returns a `log.every_s` that the scenario is accepted with, of at least `every` steps of the
/// plan.
fn spacing_s(plan: &Plan, every: u64) -> f64 {
    let spacing_s = twelve_digits(every as f64 * plan.step_s);
    match (plan.asked.step_s, plan.asked.duration_s) {
        // The step is chosen anew: it divides what the spacing divides.
        (None, Some(duration_s)) => duration_s / (duration_s / spacing_s).floor().max(1.0),
        _ => spacing_s,
    }
}

/// Rights of a client; each includes the ones before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scope {
    /// Look at jobs, logs and figures.
    Read,
    /// Submit and cancel jobs.
    Submit,
    /// Forget jobs.
    Admin,
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Read => "read",
            Self::Submit => "submit",
            Self::Admin => "admin",
        })
    }
}

/// Bearer tokens and their scopes.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Tokens(Vec<(Scope, String)>);

impl Tokens {
    /// Returns true if there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the scope of a token; `None` if it is not one of ours. Takes as long for a wrong one
    /// as for a right one of the same length.
    pub(super) fn scope(&self, token: &str) -> Option<Scope> {
        let same = |known: &str| bool::from(known.as_bytes().ct_eq(token.as_bytes()));
        let found = self.0.iter().filter(|(_, known)| same(known));
        found.map(|(scope, _)| *scope).max()
    }
}

/// Tokens are shown nowhere.
impl fmt::Debug for Tokens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} tokens", self.0.len())
    }
}

impl FromStr for Tokens {
    type Err = String;

    /// Parses lines of `read TOKEN`, `submit TOKEN` or `admin TOKEN`; empty ones and those that
    /// begin with # are skipped.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut tokens = Vec::new();
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            // The message does not repeat the line: it may hold a token.
            let wrong = |what: &str| format!("line {number} of the tokens: {what}");
            let (scope, token) = line
                .split_once(char::is_whitespace)
                .ok_or_else(|| wrong("write SCOPE TOKEN, as in: submit 4bd1..."))?;
            let scope = [Scope::Read, Scope::Submit, Scope::Admin]
                .into_iter()
                .find(|known| known.to_string() == scope)
                .ok_or_else(|| wrong("the scope must be read, submit or admin"))?;
            let token = token.trim();
            if token.len() < SHORTEST_TOKEN || !token.bytes().all(|b| b.is_ascii_graphic()) {
                return Err(wrong(
                    "a token needs at least 16 printable ASCII characters, without spaces",
                ));
            }
            tokens.push((scope, token.to_owned()));
        }
        Ok(Self(tokens))
    }
}

/// Web pages (viewers) that may read logs from this service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Cors {
    /// All pages.
    Any,
    /// Only our own.
    Nobody,
    /// Those of the listed origins, as `https://app.foxglove.dev`.
    Origins(Vec<String>),
}

impl Cors {
    /// Returns whether a page of this origin may read.
    pub(super) fn admits(&self, origin: &str) -> bool {
        *self == Self::Any || self.names(origin)
    }

    /// Returns whether the origin was named.
    pub(super) fn names(&self, origin: &str) -> bool {
        matches!(self, Self::Origins(origins) if origins.iter().any(|named| named == origin))
    }
}

impl FromStr for Cors {
    type Err = String;

    /// Parses `*`, `none`, or origins with commas between.
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "*" => Ok(Self::Any),
            "none" => Ok(Self::Nobody),
            _ => text
                .split(',')
                .map(|origin| checked_origin(origin.trim()))
                .collect::<Result<_, _>>()
                .map(Self::Origins),
        }
    }
}

fn checked_origin(text: &str) -> Result<String, String> {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://"));
    match host {
        Some(host)
            if !host.is_empty()
                && host.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.:[]".contains(&b)) =>
        {
            Ok(text.to_owned())
        }
        _ => Err(format!(
            "{text:?} is not an origin: write `*`, `none`, or http[s]://host[:port], several separated by commas"
        )),
    }
}
