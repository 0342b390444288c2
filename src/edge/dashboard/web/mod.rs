//! The web dashboard: a server of one page and what it shows.
//!
//! A thread takes in what is on the bus (`hub`); every page has a task that composes frames from it at the page's own
//! pace (`live`, `picture`), so that a page that hangs costs nothing and holds up nobody. The page itself is in the
//! binary (`assets`). Beside it: `/api/beds`, Prometheus metrics, health.
//!
//! Deliberately absent: access control. The server listens where it is told, on loopback unless told otherwise; who may
//! reach it from elsewhere is for a reverse proxy to say. Pages of other sites are turned away.
//!
//! # What server and page say to each other
#![doc = include_str!("protocol.md")]

mod assets;
mod describe;
mod frame;
mod hub;
mod live;
mod metrics;
mod orders;
mod picture;
mod snapshot;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use axum::Router;
use axum::extract::State;
use axum::extract::ws::WebSocketUpgrade;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use self::assets::{DOCUMENT, JAVASCRIPT, MODULES, plotly_js};
pub use self::hub::Connect;
use self::hub::Hub;
use self::metrics::{Dashboard, Own};
pub use super::feed::Topics;
use crate::edge::config::Config;

/// Pages open at the same time.
const MAX_PAGES: usize = 64;
/// Longest request of a page \[bytes\].
const MAX_REQUEST: usize = 16 * 1024;
/// The page and nothing else; plotly sets styles and makes pictures of its own.
const POLICY: &str = "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; \
                      connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

/// A running server.
pub struct Web {
    hub: Arc<Hub>,
    address: SocketAddr,
    server: JoinHandle<()>,
    feed: std::thread::JoinHandle<()>,
}

impl Web {
    /// Starts serving the beds of a daemon with this configuration; `topics` says whether with the page, or metrics and
    /// health alone. Needs a tokio runtime.
    ///
    /// # Errors
    /// When the listener or the system does not work.
    pub fn start(listener: TcpListener, config: &Config, topics: Topics, connect: Connect) -> io::Result<Self> {
        let hub = Arc::new(Hub::new(config, topics));
        let address = listener.local_addr()?;
        // A dashboard is of use while it has a link to the daemon; the daemon itself needs nobody.
        let router = if hub.has_page() {
            page_routes().merge(health_routes(Hub::is_connected))
        } else {
            health_routes(Hub::has_bus)
        };
        let feeding = Arc::clone(&hub);
        let feed = std::thread::Builder::new().name("dashboard".to_owned()).spawn(move || feeding.feed(&connect))?;
        let router = router.with_state(Arc::clone(&hub));
        let server = tokio::spawn(async move {
            if let Err(error) = axum::serve(listener, router).await {
                tracing::error!(%error, "the web server stopped");
            }
        });
        Ok(Self { hub, address, server, feed })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Ends all connections and stops.
    pub async fn stop(self) {
        self.hub.stop();
        self.server.abort();
        let _ = tokio::task::spawn_blocking(move || self.feed.join()).await;
    }
}

fn page_routes() -> Router<Arc<Hub>> {
    let mut router = Router::new()
        .route("/plotly.js", get(|| async { file(JAVASCRIPT, plotly_js(), "max-age=86400") }))
        .route("/live", get(live))
        .route("/api/beds", get(beds));
    for asset in DOCUMENT.iter().chain(MODULES) {
        router = router.route(asset.path, get(move || async { file(asset.content_type, asset.text, "no-cache") }));
    }
    router
}

fn health_routes(is_ready: fn(&Hub) -> bool) -> Router<Arc<Hub>> {
    let ready = async move |State(hub): State<Arc<Hub>>| {
        if is_ready(&hub) {
            "ready\n".into_response()
        } else {
            (StatusCode::SERVICE_UNAVAILABLE, "no link to the daemon\n").into_response()
        }
    };
    Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(|| async { "ok\n" }))
        .route("/readyz", get(ready))
}

fn file(content_type: &'static str, text: &'static str, caching: &'static str) -> Response {
    let headers = [
        (header::CONTENT_TYPE, content_type),
        (header::CACHE_CONTROL, caching),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    ];
    (headers, text).into_response()
}

async fn beds(State(hub): State<Arc<Hub>>) -> Response {
    let now = hub.now();
    let text = hub.with_ward(|ward| snapshot::beds(ward, now)).to_string();
    ([(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, "no-store")], text).into_response()
}

async fn metrics(State(hub): State<Arc<Hub>>) -> Response {
    let pages = hub.pages.load(Ordering::Relaxed);
    let dashboard = hub.has_page().then(|| Dashboard { pages, connected: hub.is_connected() });
    let own = Own { dropped: hub.dropped(), dashboard };
    let now = hub.now();
    match hub.with_ward(|ward| metrics::text(ward, now, own)) {
        Ok(text) => ([(header::CONTENT_TYPE, metrics::CONTENT_TYPE)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn live(State(hub): State<Arc<Hub>>, headers: HeaderMap, upgrade: WebSocketUpgrade) -> Response {
    if !is_own_page(&headers) {
        return (StatusCode::FORBIDDEN, "only the dashboard's own page may connect\n").into_response();
    }
    if hub.pages.load(Ordering::Relaxed) >= MAX_PAGES {
        return (StatusCode::SERVICE_UNAVAILABLE, "too many pages are open\n").into_response();
    }
    upgrade.max_message_size(MAX_REQUEST).on_upgrade(move |socket| live::serve(socket, hub))
}

/// Browsers tell where a page came from, and let pages of any site connect anywhere.
fn is_own_page(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).map(HeaderValue::to_str);
    match (text(header::ORIGIN), text(header::HOST)) {
        // No browser.
        (None, _) => true,
        (Some(Ok(origin)), Some(Ok(host))) => origin.split_once("://").is_some_and(|(_, site)| site == host),
        _ => false,
    }
}
