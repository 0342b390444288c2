//! Alarms of a synthetic patient who gets worse and better: over the bus, from a file, and through an operator.

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use hemostream::edge::bus::{Encoding, MemoryBus, Message};
use hemostream::edge::config::Config;
use hemostream::edge::operator::{Operator, OperatorError};
use hemostream::edge::synthetic::SyntheticPatient;
use hemostream::edge::wire::{self, Acknowledge, Alarm, Alarms, Event, PressureBlock, SCHEMA};
use hemostream::estimate::time::{EventTime, s_from_ns};

use crate::service::{Daemon, Said};

const PERIOD_NS: i64 = 5_000_000;
const BLOCK: usize = 10;
const SECONDS: i64 = 18;

/// The ventricle fails at 4 s, which halves the output, and recovers at 10 s.
const SETS: [&str; 9] = [
    // No overload leaves fewer of them.
    "estimator.members=16",
    "window.length_s=0.005",
    "window.allowed_lateness_s=600",
    "observed=[\"p_a\", \"p_pa\"]",
    "service.workers=2",
    "publish.status_rate_hz=10",
    "estimator.estimate=[\"c_l_sys\"]",
    "patient.script=[{ at_s = 4.0, scale = { c_l_sys = 4.0 } }, { at_s = 10.0, scale = { c_l_sys = 0.25 } }]",
    "alarms=[{ name = \"low output\", quantity = \"cardiac_output\", below = 4.0, for_s = 2.0, clear_margin = 0.2, \
     clear_for_s = 1.5, priority = \"high\" }, \
     { name = \"stiff\", quantity = \"c_l_sys\", above = 3.0 }]",
];

fn config() -> Config {
    let sets: Vec<String> = SETS.iter().map(|set| (*set).to_owned()).collect();
    Config::load_from(None, [], &sets).unwrap().0
}

/// Times and what the two sensors read.
fn record(config: &Config) -> Vec<(i64, [f64; 2])> {
    let mut patient = SyntheticPatient::new(config, 5).unwrap();
    let sample = |k: i64| {
        patient.advance_to(s_from_ns(k * PERIOD_NS)).unwrap();
        let read = patient.observe();
        (k * PERIOD_NS, [read[1], read[4]])
    };
    (0..=SECONDS * 200).map(sample).collect()
}

fn blocks(record: &[(i64, [f64; 2])]) -> Vec<Message> {
    let message = |k: usize, samples: &[(i64, [f64; 2])], channel: usize| {
        let block = PressureBlock {
            schema: SCHEMA,
            sequence: k as u64,
            flags: 0,
            start_ns: samples[0].0,
            period_ns: PERIOD_NS,
            offsets_ns: Vec::new(),
            values: samples.iter().map(|(_, values)| values[channel]).collect(),
        };
        let key = format!("hemostream/icu/pressure/{}", ["p_a", "p_pa"][channel]);
        Message { key, encoding: Encoding::Bincode, payload: wire::encode(&block).unwrap() }
    };
    let chunks = record.chunks(BLOCK).enumerate();
    chunks.flat_map(|(k, samples)| [message(k, samples, 0), message(k, samples, 1)]).collect()
}

fn alarms(message: &Message) -> Vec<Alarm> {
    wire::decode::<Alarms>(&message.payload, message.encoding).unwrap().alarms
}

fn acknowledge(encoding: Encoding, alarm: &str) -> Message {
    let message = Acknowledge { schema: SCHEMA, alarm: alarm.to_owned(), author: "Dr. Weber".to_owned() };
    let payload = match encoding {
        Encoding::Bincode => wire::encode(&message).unwrap(),
        Encoding::Json => serde_json::to_vec(&message).unwrap(),
    };
    Message { key: "hemostream/icu/acknowledge".to_owned(), encoding, payload }
}

/// Events of alarms: time, kind, text.
fn of_alarms(events: &[Event]) -> Vec<(i64, String, String)> {
    let alarms = events.iter().filter(|event| event.kind.starts_with("alarm"));
    alarms.map(|event| (event.header.time_ns, event.kind.clone(), event.text.clone())).collect()
}

/// Time, kind and text of the events of alarms that the command writes for the same samples.
fn from_a_file(record: &[(i64, [f64; 2])], folder: &Path) -> Vec<(i64, String, String)> {
    let mut table = "time_s,p_a,p_pa\n".to_owned();
    for (time_ns, [a, pa]) in record {
        writeln!(table, "{},{a},{pa}", s_from_ns(*time_ns)).unwrap();
    }
    let [input, output, events] = ["in.csv", "out.csv", "events.csv"].map(|name| folder.join(name));
    std::fs::write(&input, table).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_hemostream"));
    command.arg("estimate").arg(&input).arg("--output").arg(&output).arg("--events").arg(&events);
    SETS.iter().for_each(|set| _ = command.args(["--set", set]));
    let done = command.output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let text = std::fs::read_to_string(events).unwrap();
    let row = |line: &str| {
        let mut cells = line.splitn(4, ',');
        let (time_s, kind) = (cells.next()?.parse().ok()?, cells.next()?.to_owned());
        let text = cells.nth(1)?.to_owned();
        kind.starts_with("alarm").then_some((EventTime::from_s(time_s).0, kind, text))
    };
    text.lines().filter_map(row).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failing_heart_raises_an_alarm_that_latches_and_is_acknowledged() {
    let config = config();
    let record = record(&config);
    let topics = ["alarm", "alarm/json", "event", "status", "estimate/beat"];
    let daemon = Daemon::start_on(MemoryBus::new(), &config, &topics);
    let mut messages = blocks(&record).into_iter();

    // Once when the bed begins.
    messages.by_ref().take(40).for_each(|m| daemon.send(m));
    let first = daemon.wait_for("hemostream/icu/alarm", |_| true).await;
    assert!(alarms(&first).iter().all(|alarm| alarm.state == "normal" && alarm.band[0].is_nan()), "{first:?}");
    daemon.send(Message { payload: vec![7; 3], ..acknowledge(Encoding::Bincode, "") });
    daemon.send(Message { payload: b"{\"schema\": 2}".to_vec(), ..acknowledge(Encoding::Json, "") });
    daemon.send(acknowledge(Encoding::Json, "lovv output"));
    messages.for_each(|m| daemon.send(m));

    let latched =
        daemon.wait_for("hemostream/icu/alarm/json", |m| String::from_utf8_lossy(&m.payload).contains("latched"));
    let twin: serde_json::Value = serde_json::from_slice(&latched.await.payload).unwrap();
    assert_eq!(twin["alarms"][0]["name"], "low output");
    assert_eq!(twin["alarms"][0]["band"][0].as_f64().map(f64::is_finite), Some(true));
    assert_eq!(twin["alarms"][1]["band"][0], serde_json::Value::Null, "never seen beyond its limit");
    daemon.send(acknowledge(Encoding::Json, "low output"));
    daemon.wait_for("hemostream/icu/alarm", |m| alarms(m)[0].state == "normal").await;

    let said = daemon.stop().await;
    let counters = said.counters("icu");
    assert_eq!((counters.get("malformed"), counters.get("unknown_alarm")), (Some(&1), Some(&1)), "{counters:?}");
    assert_eq!(counters.get("wrong_schema"), Some(&1), "{counters:?}");
    check_what_was_said(&said, &record);
}

fn check_what_was_said(said: &Said, record: &[(i64, [f64; 2])]) {
    let mut all: Vec<Alarms> = said.all("icu", "alarm");
    let n_said = all.len();
    // With every status they are said again.
    all.dedup_by(|again, before| again.alarms[0].state == before.alarms[0].state);
    assert!(n_said > all.len(), "a dashboard that was away hears of them all the same");
    let states: Vec<&str> = all.iter().map(|m| m.alarms[0].state.as_str()).collect();
    assert_eq!(states, ["normal", "pending", "active", "latched", "normal"], "{all:#?}");
    let [began, pending, active, latched, _] = &all[..] else { panic!("five of them") };
    assert_eq!(began.header.time_ns, 0);
    let (low, raised) = (&pending.alarms[0], &active.alarms[0]);
    println!("failed at 4 s: pending at {} s, active at {} s", s_from_ns(low.since_ns), s_from_ns(raised.since_ns));
    println!("recovered at 10 s: latched at {} s; {}", s_from_ns(latched.alarms[0].since_ns), raised.text);
    assert!((4.0..7.5).contains(&s_from_ns(low.since_ns)), "{low:?}");
    let delay_s = s_from_ns(raised.since_ns - low.since_ns);
    assert!((2.0..2.05).contains(&delay_s), "raised {delay_s} s after it was first below");
    assert!(raised.band[2] < 4.0 && raised.band[1] < raised.band[0], "{raised:?}");
    assert_eq!((raised.priority.as_str(), raised.unit.as_str(), raised.limit), ("high", "L/min", 4.0));
    let events = of_alarms(&said.events("icu"));
    let kinds: Vec<&str> = events.iter().map(|(_, kind, _)| kind.as_str()).collect();
    assert_eq!(kinds, ["alarm", "alarm_over", "alarm_acknowledged"]);
    assert!(events[0].2.starts_with("cardiac output below 4 L/min with 95 % probability for 2 s: "), "{events:?}");
    assert_eq!(events[2].2, "low output acknowledged by Dr. Weber");
    assert_eq!(said.payloads("hemostream/icu/alarm/json").len(), n_said);

    let folder = tempfile::tempdir().unwrap();
    assert_eq!(from_a_file(record, folder.path()), events[..2], "the same from a file");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_acknowledgement_makes_no_bed() {
    let daemon = Daemon::start_on(MemoryBus::new(), &config(), &["alarm", "status", "event"]);
    daemon.send(acknowledge(Encoding::Bincode, ""));
    assert!(daemon.stop().await.beds().is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_operator_is_told_what_is_wrong_and_what_was_done() {
    let config = config();
    let bus = MemoryBus::new();
    let daemon = Daemon::start_on(bus.clone(), &config, &["note"]);
    // As far as the alarm is active.
    blocks(&record(&config)[..9 * 200]).into_iter().for_each(|m| daemon.send(m));
    daemon.wait_for("hemostream/icu/alarm", |m| alarms(m)[0].state == "active").await;
    daemon.wait_for("hemostream/icu/estimate/state", |m| newest(m) >= 8_940_000_000).await;

    let operator = |bed: &'static str| Operator { bus: &bus, prefix: "hemostream", bed };
    assert!(matches!(operator("i*").note("x", "", None), Err(OperatorError::Bed(_))));
    assert!(matches!(operator("ward").note("x", "", None), Err(OperatorError::UnknownBed { .. })));
    assert!(matches!(operator("ward").acknowledge(&[], ""), Err(OperatorError::UnknownBed { .. })));
    assert!(matches!(operator("icu").note("", "", None), Err(OperatorError::Length { what: "text", .. })));
    let unknown = operator("icu").acknowledge(&["lovv output".to_owned()], "").unwrap_err();
    assert_eq!(unknown.to_string(), "alarm: found \"lovv output\", expected one of low output, stiff");
    assert!(unknown.is_input());

    let told = EventTime::from_s(3.5);
    assert_eq!(operator("icu").note("250 mL", "Dr. Weber", Some(told)).unwrap(), (told, true));
    let (now, heard) = operator("icu").note("better", "", None).unwrap();
    assert!(heard && now.0 >= 8_940_000_000, "{now:?}");
    let seen = operator("icu").acknowledge(&["low output".to_owned()], "Dr. Weber").unwrap();
    assert_eq!(seen.iter().map(|alarm| alarm.name.as_str()).collect::<Vec<_>>(), ["low output"]);
    let still = alarms(&daemon.last("hemostream/icu/alarm").unwrap());
    assert_eq!((still[0].state.as_str(), still[0].acknowledged), ("active", true));
    assert!(operator("icu").acknowledge(&[], "").unwrap().is_empty(), "seen is seen");

    let said = daemon.stop().await;
    let notes: Vec<wire::Note> = said.all("icu", "note");
    let notes: Vec<_> = notes.iter().map(|n| (n.time_ns, n.author.as_str(), n.text.as_str())).collect();
    assert_eq!(notes, [(told.0, "Dr. Weber", "250 mL"), (now.0, "", "better")]);
    // A daemon that has gone says nothing.
    let gone = Operator { bus: &bus, prefix: "hemostream", bed: "icu" };
    assert!(matches!(gone.note("x", "", None), Err(OperatorError::UnknownBed { .. })));
}

fn newest(message: &Message) -> i64 {
    let state: wire::StateEstimate = wire::decode(&message.payload, message.encoding).unwrap();
    state.header.time_ns
}
