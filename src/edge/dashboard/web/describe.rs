//! Beds in JSON: what the frames of the page and `/api/beds` say with the same words.

use std::time::Duration;

use serde_json::{Map, Value, json};

use super::super::bed::{
    Band, BeatReading, Bed, FORECAST_AFTER_S, Liveness, Origin, Parameter, Quality, quantity_infos,
};
use super::frame::time;
use crate::edge::wire::{Alarm, Status};
use crate::model::Quantity;

/// Whether what is said of a bed is the present, in a word.
pub(super) fn liveness(bed: &Bed, now: Duration) -> &'static str {
    match bed.liveness(now) {
        Liveness::Live { since_data_s } if since_data_s > FORECAST_AFTER_S => "forecast",
        Liveness::Live { .. } => "live",
        Liveness::NoEstimate => "no_estimate",
        Liveness::Stale(_) => "stale",
        Liveness::NotHeard => "not_heard",
    }
}

/// What a tile and a bed's head say alike.
pub(super) fn condition(name: &str, bed: &Bed, now: Duration) -> Map<String, Value> {
    let (quality, text) = bed.quality();
    let quality = match quality {
        Quality::Unknown => "unknown",
        Quality::Good => "good",
        Quality::Degraded => "degraded",
        Quality::Bad => "bad",
    };
    let fields = [
        ("bed", json!(name)),
        ("liveness", json!(liveness(bed, now))),
        ("age_s", json!(bed.silence(now).map(|age| age.as_secs_f64()))),
        ("quality", json!(quality)),
        ("quality_text", json!(text)),
    ];
    fields.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

fn band(band: Band) -> Map<String, Value> {
    let fields = [("mean", band.mean), ("q05", band.low), ("q95", band.high)];
    fields.into_iter().map(|(key, value)| (key.to_owned(), json!(value))).collect()
}

/// The last beat, by name.
pub(super) fn beat(readings: &[BeatReading]) -> Value {
    let entry = |reading: &BeatReading| {
        let mut fields = band(reading.band);
        fields.insert("unit".to_owned(), json!(reading.unit));
        (reading.name.clone(), Value::Object(fields))
    };
    Value::Object(readings.iter().map(entry).collect())
}

/// All quantities now: bands, spread by source, where they come from.
pub(super) fn quantities(bed: &Bed) -> Vec<Value> {
    let Some((_, row)) = &bed.state else { return Vec::new() };
    let entry = |(q, about): (usize, &Quantity)| {
        let mut fields = band(row.bands[q]);
        fields.insert("name".to_owned(), json!(about.name));
        fields.insert("unit".to_owned(), json!(about.unit));
        let origin = match bed.origin(q) {
            Origin::Observed => "observed",
            Origin::Silent => "silent",
            Origin::Inferred => "inferred",
        };
        fields.insert("origin".to_owned(), json!(origin));
        if let Some(spread) = bed.spread.get(q) {
            fields.insert("sd".to_owned(), json!(spread.total));
            fields.insert("epistemic_sd".to_owned(), json!(spread.epistemic));
            fields.insert("aleatoric_sd".to_owned(), json!(spread.aleatoric));
            fields.insert("model_sd".to_owned(), json!(spread.model));
        }
        Value::Object(fields)
    };
    quantity_infos().enumerate().map(entry).collect()
}

/// All parameters now.
pub(super) fn parameters(bed: &Bed) -> Vec<Value> {
    let entry = |p: &Parameter| {
        json!({
            "name": p.name, "unit": p.unit, "mean": p.mean, "q05": p.low, "q95": p.high,
            "since_informed_s": p.since_informed_s, "identifiable": p.is_identifiable,
            "truth": bed.true_parameters.get(p.name.as_str()),
        })
    };
    bed.parameters.iter().map(entry).collect()
}

/// All alarms.
pub(super) fn alarms(bed: &Bed) -> Vec<Value> {
    let entry = |a: &Alarm| {
        let [mean, q05, q95] = a.band;
        json!({
            "name": a.name, "quantity": a.quantity, "unit": a.unit, "priority": a.priority, "state": a.state,
            "acknowledged": a.acknowledged, "side": a.side, "limit": a.limit, "since_ns": time(a.since_ns),
            "mean": mean, "q05": q05, "q95": q95, "text": a.text,
        })
    };
    bed.alarms.iter().map(entry).collect()
}

/// How the daemon does with a bed; null if it has not said.
pub(super) fn status(bed: &Bed) -> Value {
    let Some(status) = &bed.status else { return Value::Null };
    let Status { members, members_alive, windows, windows_without_data, not_converged, queue_depth, .. } = status;
    let channel = |c: &crate::edge::wire::ChannelStatus| {
        json!({
            "name": c.name, "state": c.state, "samples_used": c.samples_used, "innovation_rms": c.innovation_rms,
            "noise_sd": c.noise_sd, "misfit": c.misfit, "artefact": c.artefact,
        })
    };
    let counters: Map<String, Value> = status.counters.iter().map(|(cause, n)| (cause.clone(), json!(n))).collect();
    json!({
        "members": members, "members_alive": members_alive, "windows": windows,
        "windows_without_data": windows_without_data, "not_converged": not_converged, "queue_depth": queue_depth,
        "lag_p50_ms": status.lag_p50_ms, "lag_p99_ms": status.lag_p99_ms, "lag_max_ms": status.lag_max_ms,
        "solve_ms": status.solve_ms, "counters": counters,
        "channels": status.channels.iter().map(channel).collect::<Vec<_>>(),
    })
}
