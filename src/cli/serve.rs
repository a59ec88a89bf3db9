//! `vpd serve`: the arguments, and the service they start.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::thread;

use clap::{Args, ValueEnum};
use tokio::net::{TcpListener, TcpSocket};

use super::process::{
    CLUSTER, ClusterArgs, LogFormat, own_log, program, stop_signal, tell_of_lost_lines,
};
use super::{CliError, Status};
use crate::serve::{self, Cors, Limits, ServeConfig, ServeError, Tokens};

#[derive(Debug, Args)]
pub(super) struct ServeArgs {
    /// Address to listen on.
    #[arg(long, env = "VPD_LISTEN", default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
    /// Directory of the jobs and their logs; made if it is not there.
    #[arg(long, env = "VPD_DATA", default_value = "vpd-data", value_name = "DIR")]
    data: PathBuf,
    /// Jobs that run at once; one a core by default.
    #[arg(long, env = "VPD_WORKERS", value_name = "N")]
    workers: Option<NonZeroUsize>,
    /// Jobs that may wait; one more is answered 429.
    #[arg(long, env = "VPD_QUEUE", default_value_t = Limits::default().queue, value_name = "N")]
    queue: usize,
    /// Pages that may read logs: `*`, `none`, or origins separated by commas.
    #[arg(long, env = "VPD_CORS", default_value = "*", value_name = "ORIGINS")]
    cors: Cors,
    /// Address under which viewers reach the service, if it is not the one that clients use.
    #[arg(long, env = "VPD_PUBLIC_URL", value_name = "URL")]
    public_url: Option<String>,
    /// Names under which clients may call the service, in addition to localhost and its addresses.
    #[arg(long = "host", env = "VPD_HOSTS", value_name = "NAME", value_delimiter = ',')]
    hosts: Vec<String>,
    /// File with lines of SCOPE TOKEN; the scopes are read, submit, admin. Or the lines in VPD_TOKENS.
    #[arg(long, env = "VPD_TOKENS_FILE", value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Serve other machines without tokens.
    #[arg(long)]
    insecure: bool,
    /// Longest job that is taken, in seconds of estimated computing.
    #[arg(long, env = "VPD_MAX_RUN_S", default_value_t = Limits::default().run_s, value_name = "S")]
    max_run_s: f64,
    /// Largest log that is taken on, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_LOG_BYTES", default_value_t = Limits::default().log_bytes, value_name = "N")]
    max_log_bytes: u64,
    /// Memory that runs may take at one time, in bytes as estimated.
    #[arg(long, env = "VPD_MAX_MEMORY_BYTES", default_value_t = Limits::default().memory_bytes, value_name = "N")]
    max_memory_bytes: u64,
    /// Bytes of the disk that logs leave free.
    #[arg(long, env = "VPD_RESERVE_BYTES", default_value_t = Limits::default().reserve_bytes, value_name = "N")]
    reserve_bytes: u64,
    /// Connections at once.
    #[arg(long, env = "VPD_CONNECTIONS", default_value_t = Limits::default().connections, value_name = "N")]
    connections: usize,
    /// Connections at once from one address.
    #[arg(long, env = "VPD_CONNECTIONS_PER_CLIENT", default_value_t = Limits::default().connections_per_client, value_name = "N")]
    connections_per_client: usize,
    /// Requests a second from one address.
    #[arg(long, env = "VPD_REQUESTS_PER_S", default_value_t = Limits::default().requests_per_s, value_name = "N")]
    requests_per_s: u32,
    /// Address on which Foxglove and Lichtblick watch a running job live, as 127.0.0.1:8765.
    #[arg(long, env = "VPD_FOXGLOVE_LISTEN", value_name = "ADDRESS")]
    foxglove_listen: Option<SocketAddr>,
    /// Engine that runs the jobs: this machine, or workers on many (vpd worker, in a build with
    /// --features cluster), which need --bucket and --temporal.
    #[arg(long, env = "VPD_ENGINE", value_enum, default_value_t = EngineName::Local)]
    engine: EngineName,
    #[command(flatten)]
    cluster: ClusterArgs,
    /// Seconds within which a worker gives a sign of life, or its job goes to another one (after seven tenths of them); 4 to
    /// 3600.
    #[arg(long, env = "VPD_LEASE_S", default_value_t = 30.0, value_parser = lease, hide = !CLUSTER, value_name = "S")]
    lease_s: f64,
    /// How the service's own log is written, on stderr: text, or JSON with one object a line.
    #[arg(long, env = "VPD_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    log_format: LogFormat,
}

/// Engine that runs the jobs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum EngineName {
    Local,
    Cluster,
}

fn lease(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(seconds @ 4.0..=3600.0) => Ok(seconds),
        _ => Err(format!("{text:?} given, 4 to 3600 s are allowed")),
    }
}

/// Serves until it is asked to stop.
pub(super) fn serve(args: &ServeArgs) -> Result<Status, CliError> {
    let (_rest, lost) = own_log(args.log_format);
    #[cfg(feature = "cluster")]
    let cluster = match args.engine {
        EngineName::Local if args.cluster.bucket.is_some() => return Err(CliError::BucketAlone),
        EngineName::Local => None,
        EngineName::Cluster if args.foxglove_listen.is_some() => return Err(CliError::NoView),
        EngineName::Cluster => Some(args.cluster.config(args.lease_s)?),
    };
    #[cfg(not(feature = "cluster"))]
    if args.engine == EngineName::Cluster || args.cluster.bucket.is_some() {
        return Err(CliError::Feature { wanted: "--engine cluster", feature: "cluster" });
    }
    let tokens = tokens(args.tokens.as_deref())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let served = runtime.block_on(async {
        let stop = stop_signal().map_err(ServeError::System)?;
        tokio::spawn(tell_of_lost_lines(lost));
        let listener = listener(args.listen)
            .map_err(|source| CliError::Listen { address: args.listen, source })?;
        let workers = args.workers.or_else(|| thread::available_parallelism().ok());
        let config = ServeConfig {
            data: args.data.clone(),
            workers: workers.map_or(1, NonZeroUsize::get),
            limits: Limits {
                queue: args.queue,
                run_s: args.max_run_s,
                log_bytes: args.max_log_bytes,
                memory_bytes: args.max_memory_bytes,
                reserve_bytes: args.reserve_bytes,
                connections: args.connections,
                connections_per_client: args.connections_per_client,
                requests_per_s: args.requests_per_s,
            },
            cors: args.cors.clone(),
            public_url: args.public_url.clone(),
            hosts: args.hosts.clone(),
            tokens,
            insecure: args.insecure,
            live: args.foxglove_listen,
            program: program(),
            #[cfg(feature = "cluster")]
            cluster,
        };
        serve::serve(listener, config, stop).await?;
        Ok(Status::SUCCESS)
    });
    // A blocking task of a client that is gone must not hold up the exit.
    runtime.shutdown_background();
    served
}

/// Listens with room for many clients that connect at once; the usual 128 make the others wait a
/// second.
fn listener(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
    // As usual: a restart need not wait for earlier connections.
    socket.set_reuseaddr(cfg!(unix))?;
    socket.bind(address)?;
    socket.listen(4096)
}

/// Reads the tokens from a file, or else from the environment.
fn tokens(path: Option<&Path>) -> Result<Tokens, CliError> {
    let text = match path {
        // An editor may have put a byte order mark before it.
        Some(path) => fs::read_to_string(path)
            .map(|text| text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
            .map_err(|source| CliError::Read { path: path.to_owned(), source })?,
        None => std::env::var("VPD_TOKENS").unwrap_or_default(),
    };
    text.parse().map_err(CliError::Tokens)
}
