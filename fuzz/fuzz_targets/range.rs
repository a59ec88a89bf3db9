//! Any Range header on a file of a hundred bytes, as `log.mcap` is served: the whole, the right part, or 416.
#![no_main]

use std::sync::LazyLock;

use axum::body::{Body, to_bytes};
use axum::http::{HeaderValue, Request, StatusCode};
use libfuzzer_sys::fuzz_target;
use tokio::runtime::{Builder, Runtime};
use tower_http::services::ServeFile;

static RUNTIME: LazyLock<Runtime> =
    LazyLock::new(|| Builder::new_current_thread().build().expect("a runtime"));

fuzz_target!(|range: &[u8]| {
    let Ok(range) = HeaderValue::from_bytes(range) else { return };
    let path = std::env::temp_dir().join(format!("vpd-fuzz-{}.bytes", std::process::id()));
    let content: Vec<u8> = (0..100).collect();
    if !path.exists() {
        std::fs::write(&path, &content).expect("a temporary file");
    }
    let mut request = Request::new(Body::empty());
    request.headers_mut().insert("range", range);
    RUNTIME.block_on(async {
        let answer = ServeFile::new(&path).try_call(request).await.expect("readable");
        let (status, length) = (answer.status(), answer.headers().get("content-range").cloned());
        let body = to_bytes(Body::new(answer.into_body()), 1000).await.expect("a body");
        match status {
            StatusCode::OK => assert_eq!(body, content),
            StatusCode::PARTIAL_CONTENT => {
                let length = length.expect("a range").to_str().expect("text").to_owned();
                let from: usize = length["bytes ".len()..].split('-').next().and_then(|n| n.parse().ok()).expect("a number");
                assert_eq!(body, content[from..from + body.len()]);
            }
            status => assert_eq!(status, StatusCode::RANGE_NOT_SATISFIABLE),
        }
    });
});
