//! One page: what it asks for, and frames at its pace.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::extract::ws::{Message as Frame, WebSocket};
use serde::Deserialize;
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};

use super::hub::Hub;
use super::picture::{BedPicture, Reach, ward_frame};
use crate::edge::bus::{Delivery, Encoding, Message};
use crate::edge::wire::{self, Acknowledge, Note, SCHEMA};

/// Time between two frames of a bed.
const FRAME: Duration = Duration::from_millis(33);
/// So many times that between two frames of a bed that hold the rest too, and between two of the ward: half a second.
const TICKS_PER_REST: u64 = 15;
/// A page that takes nothing for so long is let go; it connects again by itself.
const PATIENCE: Duration = Duration::from_secs(30);
/// Closest points of a waveform, and the furthest apart \[ms\].
const SPACING_MS: (f64, f64) = (4.0, 1000.0);
/// Characters of a note and of its author.
const MAX_NOTE: usize = 500;
const MAX_AUTHOR: usize = 40;

/// What a page may ask; see the protocol.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Request {
    show: Option<String>,
    bed: String,
    quantities: Vec<String>,
    spacing_ms: f64,
    acknowledge: Option<String>,
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
    hub.pages.fetch_add(1, Ordering::Relaxed);
    let mut shown = Shown::Ward { reset: true };
    let mut pace = paced();
    let mut ticks = 0_u64;
    loop {
        tokio::select! {
            received = socket.recv() => match received {
                Some(Ok(Frame::Text(text))) => obey(&text, &hub, &mut shown, &mut ticks).await,
                Some(Ok(Frame::Close(_)) | Err(_)) | None => break,
                Some(Ok(_)) => {}
            },
            _ = pace.tick() => {
                let frame = compose(&hub, &mut shown, ticks.is_multiple_of(TICKS_PER_REST));
                ticks += 1;
                if let Some(bytes) = frame && !sent(&mut socket, bytes).await {
                    break;
                }
            }
        }
    }
    hub.pages.fetch_sub(1, Ordering::Relaxed);
}

fn paced() -> Interval {
    let mut pace = interval(FRAME);
    pace.set_missed_tick_behavior(MissedTickBehavior::Skip);
    pace
}

/// Whether the page took the frame; while it does not, none is composed.
async fn sent(socket: &mut WebSocket, bytes: Vec<u8>) -> bool {
    matches!(timeout(PATIENCE, socket.send(Frame::Binary(bytes.into()))).await, Ok(Ok(())))
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

async fn obey(text: &str, hub: &Arc<Hub>, shown: &mut Shown, ticks: &mut u64) {
    let request: Request = match serde_json::from_str(text) {
        Ok(request) => request,
        Err(error) => {
            tracing::warn!(%error, "a page asked for something unknown");
            return;
        }
    };
    if let Some(what) = &request.show {
        // The first frame holds everything.
        *ticks = 0;
        *shown = match what.as_str() {
            "ward" => Shown::Ward { reset: true },
            "bed" => {
                let (closest, furthest) = SPACING_MS;
                let spacing_ms = request.spacing_ms.clamp(closest, furthest);
                #[allow(clippy::cast_possible_truncation)]
                let spacing_ns = (spacing_ms * 1e6) as i64;
                Shown::Bed(BedPicture::new(request.bed.clone(), &request.quantities, spacing_ns))
            }
            _ => Shown::Nothing,
        };
    }
    if let Some((topic, payload)) = to_publish(&request, hub) {
        publish(hub, &request.bed, topic, payload).await;
    }
}

/// The message that a request asks to be published.
fn to_publish(request: &Request, hub: &Hub) -> Option<(&'static str, Vec<u8>)> {
    let short = |text: &str, longest: usize| text.chars().take(longest).collect::<String>();
    let author = short(&request.author, MAX_AUTHOR);
    if let Some(alarm) = &request.acknowledge {
        let message = Acknowledge { schema: SCHEMA, alarm: short(alarm, MAX_NOTE), author };
        return Some(("acknowledge", wire::encode(&message).ok()?));
    }
    let text = short(request.note.as_deref()?, MAX_NOTE);
    let told = request.time_ns.as_deref().and_then(|ns| ns.parse().ok());
    let newest = || hub.with_ward(|ward| ward.beds.get(&request.bed).and_then(|bed| bed.newest_ns(hub.now())));
    let time_ns = told.or_else(newest)?;
    Some(("note", wire::encode(&Note { schema: SCHEMA, time_ns, author, text }).ok()?))
}

/// Publishes under a bed that is known; publishing may block.
async fn publish(hub: &Arc<Hub>, bed: &str, topic: &str, payload: Vec<u8>) {
    let key = hub.with_ward(|ward| ward.beds.contains_key(bed).then(|| format!("{}/{bed}/{topic}", ward.prefix())));
    let (Some(key), Some(bus)) = (key, hub.bus().cloned()) else { return };
    let message = Message { key, encoding: Encoding::Bincode, payload };
    let published = tokio::task::spawn_blocking(move || bus.publish(message, Delivery::Events)).await;
    if let Ok(Err(error)) = published {
        tracing::warn!(%error, topic, "a page's message was not published");
    }
}
