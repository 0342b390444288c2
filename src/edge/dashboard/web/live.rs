//! One page: what it asks for, and frames at its pace.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::{Message as Frame, WebSocket};
use serde::Deserialize;
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};

use super::super::errand::Errand;
use super::hub::Hub;
use super::orders::{Order, Orders};
use super::picture::{BedPicture, Reach, ward_frame};
use crate::estimate::time::EventTime;

/// Time between two frames of a bed; the page shows evenly what comes in steps.
const FRAME: Duration = Duration::from_millis(50);
/// So many times that between two frames of a bed that hold the rest too, and between two of the ward: half a second.
const TICKS_PER_REST: u64 = 10;
/// A page that takes nothing for so long is let go; it connects again by itself.
const PATIENCE: Duration = Duration::from_secs(30);
/// A page is asked for a sign of life this often, and let go if it has given none for so long: a hidden one gets no frames
/// that would tell.
const ASK_EVERY: Duration = Duration::from_secs(20);
const SILENT_FOR: Duration = Duration::from_secs(60);
/// Closest points of a waveform, and the furthest apart \[ms\].
const SPACING_MS: (f64, f64) = (4.0, 1000.0);

/// What a page may ask; see the protocol.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Request {
    show: Option<String>,
    bed: String,
    quantities: Vec<String>,
    spacing_ms: f64,
    acknowledge: Option<Vec<String>>,
    note: Option<String>,
    author: String,
    time_ns: Option<String>,
}

/// What a page is shown.
enum Shown {
    Nothing,
    Ward { reset: bool },
    Bed(BedPicture),
}

/// Serves a page until it goes.
pub(super) async fn serve(mut socket: WebSocket, hub: Arc<Hub>) {
    let _open = OpenPage::new(&hub);
    let mut shown = Shown::Ward { reset: true };
    let mut orders = Orders::new();
    let (mut pace, mut asking) = (paced(FRAME), paced(ASK_EVERY));
    let mut heard = hub.now();
    let mut ticks = 0_u64;
    loop {
        tokio::select! {
            received = socket.recv() => match received {
                Some(Ok(Frame::Text(text))) => {
                    heard = hub.now();
                    let refusal = obey(&text, &hub, &mut shown, &mut ticks, &orders);
                    if let Some(text) = refusal && !sent(&mut socket, Frame::Text(text.into())).await {
                        break;
                    }
                }
                Some(Ok(Frame::Close(_)) | Err(_)) | None => break,
                Some(Ok(_)) => heard = hub.now(),
            },
            _ = asking.tick() => {
                if hub.now().saturating_sub(heard) > SILENT_FOR || !sent(&mut socket, Frame::Ping(Bytes::new())).await {
                    break;
                }
            }
            Some(answer) = orders.next() => {
                if !sent(&mut socket, Frame::Text(answer.into())).await {
                    break;
                }
            }
            _ = pace.tick() => {
                let frame = compose(&hub, &mut shown, ticks.is_multiple_of(TICKS_PER_REST));
                ticks += 1;
                if let Some(bytes) = frame && !sent(&mut socket, Frame::Binary(bytes.into())).await {
                    break;
                }
            }
        }
    }
}

/// A page counts as long as this is there.
struct OpenPage<'a>(&'a Hub);

impl<'a> OpenPage<'a> {
    fn new(hub: &'a Hub) -> Self {
        hub.pages.fetch_add(1, Ordering::Relaxed);
        Self(hub)
    }
}

impl Drop for OpenPage<'_> {
    fn drop(&mut self) {
        self.0.pages.fetch_sub(1, Ordering::Relaxed);
    }
}

fn paced(period: Duration) -> Interval {
    let mut pace = interval(period);
    pace.set_missed_tick_behavior(MissedTickBehavior::Skip);
    pace
}

/// Whether the page took the frame; while it does not, none is composed.
async fn sent(socket: &mut WebSocket, frame: Frame) -> bool {
    matches!(timeout(PATIENCE, socket.send(frame)).await, Ok(Ok(())))
}

/// The next frame, if there is something to tell.
fn compose(hub: &Hub, shown: &mut Shown, with_rest: bool) -> Option<Vec<u8>> {
    let now = hub.now();
    let reach = || Reach { connected: hub.is_connected(), dropped: hub.dropped() };
    match shown {
        Shown::Ward { reset } if with_rest => {
            let (reach, first) = (reach(), std::mem::take(reset));
            Some(hub.with_ward(|ward| ward_frame(ward, now, first, reach)))
        }
        Shown::Nothing | Shown::Ward { .. } => None,
        Shown::Bed(picture) => {
            let reach = reach();
            hub.with_ward(|ward| picture.next(ward, now, with_rest, reach))
        }
    }
}

/// Shows something else, or starts an order; the answer to one that cannot be started.
fn obey(text: &str, hub: &Arc<Hub>, shown: &mut Shown, ticks: &mut u64, orders: &Orders) -> Option<String> {
    let request: Request = match serde_json::from_str(text) {
        Ok(request) => request,
        Err(error) => {
            tracing::warn!(%error, "a page asked for something unknown");
            return None;
        }
    };
    if let Some(what) = &request.show {
        // The first frame holds everything.
        *ticks = 0;
        *shown = match what.as_str() {
            "ward" => Shown::Ward { reset: true },
            "bed" => Shown::Bed(request.picture()),
            _ => Shown::Nothing,
        };
    }
    orders.start(request.order()?, hub).err()
}

impl Request {
    fn picture(&self) -> BedPicture {
        let (closest, furthest) = SPACING_MS;
        let spacing_ms = self.spacing_ms.clamp(closest, furthest);
        #[allow(clippy::cast_possible_truncation)]
        let spacing_ns = (spacing_ms * 1e6) as i64;
        BedPicture::new(self.bed.clone(), &self.quantities, spacing_ns)
    }

    fn order(self) -> Option<Order> {
        let Self { bed, author, acknowledge, note, time_ns, .. } = self;
        // Without names it would be all, also those that nobody has seen on a page.
        if let Some(alarms) = acknowledge.filter(|alarms| !alarms.is_empty()) {
            return Some(Order { word: "acknowledge", errand: Errand::Acknowledge { bed, alarms }, author });
        }
        let time = time_ns.and_then(|ns| ns.parse().ok()).map(EventTime);
        Some(Order { word: "note", errand: Errand::Note { bed, time, text: note? }, author })
    }
}
