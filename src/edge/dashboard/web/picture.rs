//! What one page is shown: composed anew for every frame from what the page has not seen yet.
//!
//! There is no queue between the ward and a page: a page that does not read is simply not written to, and catches up
//! from the history when it reads again.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Value, json};

use super::super::bed::{Band, Bed, EventLine, StateRow, quantity_names};
use super::super::history::History;
use super::super::ward::Ward;
use super::describe;
use super::frame::{Parts, frame, seconds_after, time};
use crate::model::cvsim6::Pressures;

/// How well the dashboard is in touch with the daemon.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach {
    /// Whether there is a link to the daemon.
    pub(super) connected: bool,
    /// Messages that the dashboard was too slow for.
    pub(super) dropped: u64,
}

/// The tiles of all beds.
pub(super) fn ward_frame(ward: &Ward, now: Duration, reset: bool, reach: Reach) -> Vec<u8> {
    let beds: Vec<Value> = ward.beds.iter().map(|(name, bed)| tile(name, bed, now)).collect();
    let head = json!({
        "kind": "ward", "reset": reset, "prefix": ward.prefix(), "connected": reach.connected,
        "lost": { "dropped": reach.dropped, "unreadable": ward.unreadable, "refused": ward.refused },
        "beds": beds,
    });
    frame(&head, &[])
}

fn tile(name: &str, bed: &Bed, now: Duration) -> Value {
    let mut tile = describe::condition(name, bed, now);
    let status = bed.status.as_ref();
    let alarms = bed.alarms.iter().filter(|a| a.state != "normal").map(|a| {
        json!({ "name": a.name, "priority": a.priority, "state": a.state, "acknowledged": a.acknowledged, "text": a.text })
    });
    tile.insert("lag_ms".to_owned(), json!(status.map(|s| s.lag_p99_ms)));
    tile.insert("members".to_owned(), json!(status.map(|s| s.members)));
    tile.insert("members_alive".to_owned(), json!(status.map(|s| s.members_alive)));
    tile.insert("alarms".to_owned(), alarms.collect());
    tile.insert("values".to_owned(), describe::beat(bed.beat()));
    Value::Object(tile)
}

/// How far a page has got with one bed.
pub(super) struct BedPicture {
    bed: String,
    quantities: Vec<usize>,
    spacing_ns: i64,
    /// None before the first frame, and where event time begins anew.
    generation: Option<u64>,
    /// Event time of the last point sent, by part and name.
    sent: BTreeMap<(&'static str, String), i64>,
    events: u64,
}

impl BedPicture {
    /// A picture of which nothing is sent yet.
    pub(super) fn new(bed: String, names: &[String], spacing_ns: i64) -> Self {
        let quantities = quantity_names().enumerate().filter(|(_, name)| names.iter().any(|n| n == name));
        let quantities = quantities.map(|(q, _)| q).collect();
        Self { bed, quantities, spacing_ns, generation: None, sent: BTreeMap::new(), events: 0 }
    }

    /// What is new; `with_rest` adds what a person reads rather than sees move. None if there is nothing to tell.
    pub(super) fn next(&mut self, ward: &Ward, now: Duration, with_rest: bool, reach: Reach) -> Option<Vec<u8>> {
        let Some(bed) = ward.beds.get(&self.bed) else {
            return with_rest.then(|| self.unknown(reach));
        };
        let reset = self.generation != Some(bed.generation());
        if reset {
            self.generation = Some(bed.generation());
            self.sent.clear();
            self.events = 0;
        }
        let mut head = describe::condition(&self.bed, bed, now);
        head.insert("kind".to_owned(), json!("bed"));
        head.insert("reset".to_owned(), json!(reset));
        head.insert("known".to_owned(), json!(true));
        head.insert("now_ns".to_owned(), bed.newest_ns(now).map_or(Value::Null, time));
        let mut parts = Parts::default();
        self.add_waveforms(bed, &mut parts);
        if parts.is_empty() && !with_rest {
            return None;
        }
        head.insert("connected".to_owned(), json!(reach.connected));
        if with_rest || reset {
            self.add_trends(bed, &mut parts);
            head.insert("quantities".to_owned(), json!(describe::quantities(bed)));
            head.insert("parameters".to_owned(), json!(describe::parameters(bed)));
            head.insert("beat".to_owned(), describe::beat(bed.beat()));
            head.insert("alarms".to_owned(), json!(describe::alarms(bed)));
            head.insert("status".to_owned(), describe::status(bed));
            head.insert("events".to_owned(), self.events(bed));
        }
        Some(parts.into_frame(Value::Object(head)))
    }

    fn unknown(&mut self, reach: Reach) -> Vec<u8> {
        let (bed, connected) = (&self.bed, reach.connected);
        self.generation = None;
        let head =
            json!({ "kind": "bed", "reset": true, "bed": bed, "known": false, "connected": connected, "parts": [] });
        frame(&head, &[])
    }

    /// The rows of a part that are not sent yet, thinned to the spacing asked for; they count as sent.
    fn unsent<'a, T>(&mut self, part: &'static str, name: &str, history: &'a History<T>) -> Vec<(i64, &'a T)> {
        let sent = self.sent.entry((part, name.to_owned())).or_insert(i64::MIN);
        let mut rows = Vec::new();
        for (t, row) in history.after(*sent) {
            if t.saturating_sub(*sent) >= self.spacing_ns {
                *sent = t;
                rows.push((t, row));
            }
        }
        rows
    }

    fn add_waveforms(&mut self, bed: &Bed, parts: &mut Parts) {
        let quantities = self.quantities.clone();
        let names: Vec<&str> =
            quantity_names().enumerate().filter(|(q, _)| quantities.contains(q)).map(|(_, n)| n).collect();
        let rows = self.unsent("estimate", "", &bed.history);
        if let Some((t0, _)) = rows.first() {
            let head = json!({ "part": "estimate", "t0_ns": time(*t0), "n": rows.len(), "quantities": names });
            parts.add(head, estimate_numbers(&rows, &quantities));
        }
        for (channel, name) in Pressures::NAMES.iter().enumerate().filter(|(q, _)| quantities.contains(q)) {
            let rows = self.unsent("samples", name, &bed.samples[channel]);
            let Some((t0, _)) = rows.first() else { continue };
            let head = json!({ "part": "samples", "t0_ns": time(*t0), "n": rows.len(), "channel": name });
            let values = rows.iter().map(|(_, value)| **value);
            parts.add(head, times(&rows).into_iter().chain(values));
        }
        let rows = self.unsent("truth", "", &bed.truth);
        if let Some((t0, _)) = rows.first() {
            let head = json!({ "part": "truth", "t0_ns": time(*t0), "n": rows.len(), "quantities": names });
            let values = quantities.iter().flat_map(|&q| rows.iter().map(move |(_, row)| row[q]));
            parts.add(head, times(&rows).into_iter().chain(values));
        }
    }

    fn add_trends(&mut self, bed: &Bed, parts: &mut Parts) {
        for parameter in &bed.parameters {
            let rows = self.unsent("parameters", &parameter.name, &parameter.trend);
            let Some((t0, _)) = rows.first() else { continue };
            let head = json!({
                "part": "parameters", "t0_ns": time(*t0), "n": rows.len(), "name": parameter.name,
                "unit": parameter.unit,
            });
            let informed = rows.iter().map(|(_, p)| f32::from(u8::from(p.is_informed)));
            let bands = band_columns(rows.iter().map(|(_, p)| p.band));
            let truth = rows.iter().map(|(_, p)| p.truth);
            parts.add(head, times(&rows).into_iter().chain(bands).chain(informed).chain(truth));
        }
        for (name, trend) in &bed.beat_trends {
            let rows = self.unsent("beats", name, trend);
            let Some((t0, _)) = rows.first() else { continue };
            let unit = bed.beat_unit(name);
            let head = json!({ "part": "beats", "t0_ns": time(*t0), "n": rows.len(), "name": name, "unit": unit });
            parts.add(head, times(&rows).into_iter().chain(band_columns(rows.iter().map(|(_, band)| **band))));
        }
    }

    fn events(&mut self, bed: &Bed) -> Value {
        let new = bed.events_taken.saturating_sub(self.events);
        self.events = bed.events_taken;
        let first = bed.events.len().saturating_sub(usize::try_from(new).unwrap_or(usize::MAX));
        let entry =
            |e: &EventLine| json!({ "time_ns": time(e.time_ns), "kind": e.kind, "channel": e.channel, "text": e.text });
        bed.events.range(first..).map(entry).collect()
    }
}

fn times<T>(rows: &[(i64, T)]) -> Vec<f32> {
    let t0 = rows.first().map_or(0, |(t, _)| *t);
    seconds_after(t0, rows.iter().map(|(t, _)| *t))
}

/// Means, then lows, then highs.
fn band_columns(bands: impl Iterator<Item = Band> + Clone) -> Vec<f32> {
    let means = bands.clone().map(|b| b.mean);
    means.chain(bands.clone().map(|b| b.low)).chain(bands.map(|b| b.high)).collect()
}

#[allow(clippy::cast_possible_truncation)]
fn estimate_numbers(rows: &[(i64, &StateRow)], quantities: &[usize]) -> Vec<f32> {
    let mut numbers = times(rows);
    numbers.extend(rows.iter().map(|(_, row)| row.since_data_s as f32));
    for &q in quantities {
        numbers.extend(band_columns(rows.iter().map(|(_, row)| row.bands[q])));
    }
    numbers
}

// What is sent is what was said, to the last bit.
#[cfg(test)]
#[allow(clippy::float_cmp)]
mod tests {
    use super::super::super::ward::Memory;
    use super::*;
    use crate::edge::bus::{Encoding, Message};
    use crate::edge::wire::{self, Event, Header, SCHEMA, STATE_STATISTICS, StateEstimate};

    const REACH: Reach = Reach { connected: true, dropped: 0 };
    const MS: i64 = 1_000_000;

    fn header(time_ns: i64) -> Header {
        Header { schema: SCHEMA, seed: 1, config_hash: 2, sequence: 0, time_ns }
    }

    fn ward() -> Ward {
        Ward::new("ward", Memory { history_s: 60, rows: 10_000 })
    }

    fn say<T: serde::Serialize>(ward: &mut Ward, topic: &str, message: &T) {
        let payload = wire::encode(message).unwrap();
        let message = Message { key: format!("ward/bed1/{topic}"), encoding: Encoding::Bincode, payload };
        ward.apply(&message, Duration::from_secs(1));
    }

    /// An estimate of two pressures; the mean of the first is its time in ms.
    #[allow(clippy::cast_precision_loss)]
    fn estimate(ward: &mut Ward, ms: i64) {
        let row = |mean: f64| [mean, 1.0, 0.5, 0.6, 0.7, mean - 1.0, mean + 2.0];
        let values: Vec<f64> = [ms as f64, 7.0].into_iter().flat_map(row).collect();
        assert_eq!(values.len(), 2 * STATE_STATISTICS.len());
        let names = ["p_a", "p_pv"].map(str::to_owned).to_vec();
        let (times_ns, since_data_s) = (vec![ms * MS], vec![0.0]);
        let message = StateEstimate { header: header(ms * MS), members: 9, times_ns, since_data_s, names, values };
        say(ward, "estimate/state", &message);
    }

    fn event(ward: &mut Ward, ms: i64, kind: &str) {
        let (kind, channel, text) = (kind.to_owned(), String::new(), "text".to_owned());
        say(ward, "event", &Event { header: header(ms * MS), kind, channel, text });
    }

    fn read(bytes: &[u8]) -> (Value, Vec<f32>) {
        let length = usize::try_from(u32::from_le_bytes(bytes[..4].try_into().unwrap())).unwrap();
        let numbers = bytes[(4 + length).next_multiple_of(4)..].chunks_exact(4);
        let numbers = numbers.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        (serde_json::from_slice(&bytes[4..4 + length]).unwrap(), numbers)
    }

    fn next(picture: &mut BedPicture, ward: &Ward, with_rest: bool) -> Option<(Value, Vec<f32>)> {
        picture.next(ward, Duration::from_secs(1), with_rest, REACH).map(|bytes| read(&bytes))
    }

    fn picture(spacing_ms: i64) -> BedPicture {
        BedPicture::new("bed1".to_owned(), &["p_a".to_owned()], spacing_ms * MS)
    }

    #[test]
    fn the_past_comes_first_and_then_only_what_is_new() {
        let (mut ward, mut picture) = (ward(), picture(8));
        event(&mut ward, 0, "start");
        (0..3).for_each(|i| estimate(&mut ward, 20 * i));
        let (head, numbers) = next(&mut picture, &ward, false).unwrap();
        assert_eq!((&head["reset"], &head["parts"][0]["n"]), (&json!(true), &json!(3)));
        assert_eq!(head["parts"][0]["quantities"], json!(["p_a"]));
        // Times, then time since data, means, 5 % and 95 %.
        let expected = [0.0, 0.02, 0.04, 0.0, 0.0, 0.0, 0.0, 20.0, 40.0, -1.0, 19.0, 39.0, 2.0, 22.0, 42.0];
        assert_eq!(numbers, expected);
        assert_eq!(head["events"][0]["kind"], "start");
        assert_eq!(head["quantities"][5]["epistemic_sd"], json!(0.5));

        assert!(next(&mut picture, &ward, false).is_none());
        estimate(&mut ward, 60);
        event(&mut ward, 60, "gap");
        let (head, numbers) = next(&mut picture, &ward, false).unwrap();
        assert_eq!((&head["reset"], &head["parts"][0]["t0_ns"]), (&json!(false), &json!("60000000")));
        assert_eq!(numbers, [0.0, 0.0, 60.0, 59.0, 62.0]);
        assert!(head.get("events").is_none());
        let (head, _) = next(&mut picture, &ward, true).unwrap();
        assert_eq!(head["events"].as_array().unwrap().len(), 1);
        assert_eq!(head["events"][0]["kind"], "gap");
    }

    #[test]
    fn points_closer_than_asked_for_are_left_out() {
        let (mut ward, mut picture) = (ward(), picture(100));
        (0..20).for_each(|i| estimate(&mut ward, 20 * i));
        let (head, _) = next(&mut picture, &ward, false).unwrap();
        assert_eq!(head["parts"][0]["n"], 4);
    }

    #[test]
    fn event_time_that_begins_anew_begins_the_picture_anew() {
        let (mut ward, mut picture) = (ward(), picture(8));
        estimate(&mut ward, 100_000);
        assert_eq!(next(&mut picture, &ward, false).unwrap().0["reset"], true);
        estimate(&mut ward, 0);
        let (head, _) = next(&mut picture, &ward, false).unwrap();
        assert_eq!((&head["reset"], &head["now_ns"]), (&json!(true), &json!("0")));
    }

    #[test]
    fn a_bed_that_nobody_knows_is_said_to_be_unknown_until_it_appears() {
        let (mut ward, mut picture) = (ward(), picture(8));
        assert!(next(&mut picture, &ward, false).is_none());
        assert_eq!(next(&mut picture, &ward, true).unwrap().0["known"], false);
        estimate(&mut ward, 0);
        let (head, _) = next(&mut picture, &ward, false).unwrap();
        assert_eq!((&head["known"], &head["reset"]), (&json!(true), &json!(true)));
    }
}
