//! The service between two ends of a bus within this process: from topics to topics.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use hemostream::edge::bus::{Bus, Delivery, Encoding, MemoryBus, Message, Subscription};
use hemostream::edge::config::Config;
use hemostream::edge::inlet;
use hemostream::edge::outlet::Outlet;
use hemostream::edge::wire::{
    self, Event, FLAG_LAST_BLOCK, ParameterEstimate, PressureBlock, SCHEMA, StateEstimate, Status,
};
use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimate, Estimator, Input, Output};
use hemostream::estimate::statistics::Summary;
use hemostream::estimate::time::{ArrivalTime, EventTime, s_from_ns};
use hemostream::estimate::window::RawSample;
use hemostream::runtime::bed::Account;
use hemostream::runtime::clock::Clock;
use hemostream::runtime::service::{Inlet, Limits, Service};
use hemostream::runtime::workers::Workers;

const MS: i64 = 1_000_000;

/// Spacing of the samples: 200 Hz.
const PERIOD_NS: i64 = 5 * MS;

/// Samples in a block.
const BLOCK: usize = 10;

/// Where the channels stand in the settings.
const CHANNELS: [&str; 2] = ["p_a", "p_pa"];

/// Longest wait for the service.
const PATIENCE: Duration = Duration::from_secs(30);

/// Small, and deaf to the wall clock: only what arrives closes windows.
fn config(sets: &[&str]) -> Config {
    let small = [
        "estimator.members=8",
        "window.length_s=0.005",
        "window.allowed_lateness_s=600",
        "observed=[\"p_a\", \"p_pa\"]",
        "service.workers=2",
        "publish.status_rate_hz=10",
    ];
    let sets: Vec<String> = small.iter().chain(sets).map(|s| (*s).to_owned()).collect();
    Config::load_from(None, [], &sets).unwrap().0
}

/// A running daemon on a bus of its own, and everything it has said.
pub(crate) struct Daemon {
    bus: MemoryBus,
    inlet: Inlet,
    outlet: Arc<Outlet>,
    service: tokio::task::JoinHandle<Account>,
    said: Arc<Mutex<Vec<Message>>>,
    subscriptions: Vec<Subscription>,
}

impl Daemon {
    fn start(config: &Config) -> Self {
        Self::start_on(MemoryBus::new(), config, &["estimate/state", "estimate/parameters", "status", "event"])
    }

    /// Hears these topics only.
    pub(crate) fn start_on(bus: MemoryBus, config: &Config, topics: &[&str]) -> Self {
        Self::start_forgetting(bus, config, topics, Duration::MAX)
    }

    /// The same; a bed that has been silent for so long makes room where there is none.
    fn start_forgetting(bus: MemoryBus, config: &Config, topics: &[&str], forget_after: Duration) -> Self {
        let said = Arc::new(Mutex::new(Vec::new()));
        let hear = |topic: &&str| {
            let hearing = Arc::clone(&said);
            let hear = move |message: Message| hearing.lock().unwrap().push(message);
            bus.subscribe(&format!("hemostream/*/{topic}"), Arc::new(hear)).unwrap()
        };
        let mut subscriptions: Vec<Subscription> = topics.iter().map(hear).collect();
        let workers = Arc::new(Workers::start(config.service.workers).unwrap());
        let outlet = Arc::new(Outlet::start(Arc::new(bus.clone()), config).unwrap());
        let limits = Limits {
            max_beds: config.service.max_beds,
            forget_after,
            queue_tasks: config.service.queue_blocks,
            report_every: Duration::from_secs_f64(1.0 / config.publish.status_rate_hz),
        };
        let settings = config.estimator_settings().unwrap();
        let sink = Arc::clone(&outlet);
        let (service, inlet) =
            Service::new(config.circulation().unwrap(), settings, limits, workers, sink, Clock::start()).unwrap();
        let service = tokio::spawn(service.run());
        subscriptions.extend(inlet::listen(&bus, config, inlet.clone(), outlet.recent()).unwrap());
        Self { bus, inlet, outlet, service, said, subscriptions }
    }

    pub(crate) fn send(&self, message: Message) {
        self.bus.publish(message, Delivery::Samples).unwrap();
    }

    /// The last value under a key, if there is one.
    pub(crate) fn last(&self, pattern: &str) -> Option<Message> {
        self.bus.last_values(pattern, Duration::from_secs(1)).unwrap().pop()
    }

    /// Asks for last values until one is as wanted.
    pub(crate) async fn wait_for(&self, pattern: &str, wanted: impl Fn(&Message) -> bool) -> Message {
        let asked = async {
            loop {
                if let Some(message) = self.last(pattern).filter(|m| wanted(m)) {
                    return message;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(PATIENCE, asked).await.unwrap_or_else(|_| panic!("nothing as wanted under {pattern}"))
    }

    /// Finishes what is waiting; returns all that was said.
    pub(crate) async fn stop(self) -> Said {
        self.inlet.stop().await;
        tokio::time::timeout(PATIENCE, self.service).await.expect("the service stops").expect("without a panic");
        assert_eq!(self.inlet.dropped(), 0);
        assert_eq!(Arc::strong_count(&self.outlet), 1, "nobody publishes any more");
        // Publishes what is queued.
        drop(self.outlet);
        drop(self.subscriptions);
        Said(std::mem::take(&mut *self.said.lock().unwrap()))
    }
}

/// Messages in the order of their publication.
pub(crate) struct Said(Vec<Message>);

impl Said {
    pub(crate) fn payloads(&self, key: &str) -> Vec<&[u8]> {
        self.0.iter().filter(|m| m.key == key).map(|m| m.payload.as_slice()).collect()
    }

    pub(crate) fn all<T: serde::de::DeserializeOwned>(&self, bed: &str, topic: &str) -> Vec<T> {
        let payloads = self.payloads(&format!("hemostream/{bed}/{topic}"));
        payloads.into_iter().map(|p| wire::decode(p, Encoding::Bincode).unwrap()).collect()
    }

    fn states(&self, bed: &str) -> Vec<StateEstimate> {
        self.all(bed, "estimate/state")
    }

    pub(crate) fn events(&self, bed: &str) -> Vec<Event> {
        self.all(bed, "event")
    }

    fn kinds(&self, bed: &str) -> Vec<String> {
        self.events(bed).into_iter().map(|e| e.kind).collect()
    }

    fn last_status(&self, bed: &str) -> Status {
        self.all(bed, "status").pop().unwrap_or_else(|| panic!("no status of {bed}"))
    }

    pub(crate) fn counters(&self, bed: &str) -> BTreeMap<String, u64> {
        self.last_status(bed).counters.into_iter().collect()
    }

    /// Who was heard of.
    pub(crate) fn beds(&self) -> Vec<&str> {
        let mut beds: Vec<&str> = self.0.iter().filter_map(|m| m.key.split('/').nth(1)).collect();
        beds.sort_unstable();
        beds.dedup();
        beds
    }
}

/// Something like a pressure \[mmHg\], different from bed to bed.
fn pressure(bed: &str, channel: usize, time_ns: i64) -> f64 {
    let phase = TAU * 1.2 * s_from_ns(time_ns) + bed.len() as f64;
    if channel == 0 { 93.0 + 22.0 * phase.sin() } else { 16.0 + 5.0 * phase.sin() }
}

/// Block number `k` of a channel.
fn block(bed: &str, channel: usize, k: usize) -> PressureBlock {
    let start_ns = (k * BLOCK) as i64 * PERIOD_NS;
    PressureBlock {
        schema: SCHEMA,
        sequence: k as u64,
        flags: 0,
        start_ns,
        period_ns: PERIOD_NS,
        offsets_ns: Vec::new(),
        values: (0..BLOCK as i64).map(|i| pressure(bed, channel, start_ns + i * PERIOD_NS)).collect(),
    }
}

fn message(bed: &str, channel: &str, payload: Vec<u8>) -> Message {
    Message { key: format!("hemostream/{bed}/pressure/{channel}"), encoding: Encoding::Bincode, payload }
}

fn encoded(bed: &str, channel: usize, block: &PressureBlock) -> Message {
    message(bed, CHANNELS[channel], wire::encode(block).unwrap())
}

/// A record of so many blocks per channel, channels in turn; the last ones say so.
fn record(bed: &str, blocks: usize) -> Vec<Message> {
    let one = |k: usize, channel: usize| {
        let flags = if k + 1 == blocks { FLAG_LAST_BLOCK } else { 0 };
        encoded(bed, channel, &PressureBlock { flags, ..block(bed, channel, k) })
    };
    (0..blocks).flat_map(|k| [one(k, 0), one(k, 1)]).collect()
}

/// Event time of the last sample of such a record \[ns\].
fn end_of_record(blocks: usize) -> i64 {
    ((blocks * BLOCK) as i64 - 1) * PERIOD_NS
}

/// What a daemon says to messages.
async fn said_to(config: &Config, messages: impl IntoIterator<Item = Message>) -> Said {
    let daemon = Daemon::start(config);
    messages.into_iter().for_each(|m| daemon.send(m));
    daemon.stop().await
}

fn in_turn(records: Vec<Vec<Message>>) -> Vec<Message> {
    let longest = records.iter().map(Vec::len).max().unwrap_or(0);
    (0..longest).flat_map(|i| records.iter().filter_map(move |r| r.get(i).cloned())).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn beds_appear_with_their_first_sample() {
    let beds = ["icu-1", "icu-02", "ward"];
    let said = said_to(&config(&[]), in_turn(beds.iter().map(|bed| record(bed, 20)).collect())).await;
    assert_eq!(said.beds(), ["icu-02", "icu-1", "ward"]);
    for bed in beds {
        let states = said.states(bed);
        let times: Vec<i64> = states.iter().map(|s| s.header.time_ns / MS).collect();
        assert_eq!(times, (0..=end_of_record(20) / MS).step_by(20).collect::<Vec<_>>());
        assert!(states.iter().enumerate().all(|(k, s)| s.header.sequence == k as u64 && s.members == 8));
        assert!(states.iter().all(|s| s.values.iter().all(|v| v.is_finite())));
        let parameters: Vec<ParameterEstimate> = said.all(bed, "estimate/parameters");
        assert_eq!(parameters.len(), states.len());
        assert_eq!(parameters[0].names, ["r_pv", "c_a"]);
        assert_eq!(said.kinds(bed), ["start"]);
        let status = said.last_status(bed);
        assert_eq!((status.windows, status.windows_without_data), (199, 0));
        assert_eq!((status.members_alive, status.members), (8, 8));
        assert_eq!(status.counters, []);
        assert!(status.channels.iter().all(|c| c.samples_used == 200 && c.state == "live"));
    }
    assert_ne!(said.states(beds[0])[49].values, said.states(beds[1])[49].values);
}

/// One message that is wrong, and what it is counted as.
struct Bad {
    what: &'static str,
    message: Message,
    cause: &'static str,
    count: u64,
}

/// The bytes of a block, whatever its length.
fn raw_bytes(sequence: u64, values: &[f64]) -> Vec<u8> {
    let mut bytes = SCHEMA.to_le_bytes().to_vec();
    bytes.extend(sequence.to_le_bytes());
    bytes.extend(0_u32.to_le_bytes());
    bytes.extend(0_i64.to_le_bytes());
    bytes.extend(PERIOD_NS.to_le_bytes());
    bytes.extend(0_u64.to_le_bytes());
    bytes.extend((values.len() as u64).to_le_bytes());
    values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    bytes
}

/// Everything wrong that we can think of, each for a bed of its own.
fn bad_messages() -> Vec<(String, Bad)> {
    let base = block("bad", 0, 1);
    let good = wire::encode(&base).unwrap();
    let bytes = |what, cause, payload: Vec<u8>| (what, cause, 1_u64, "p_a", Encoding::Bincode, payload);
    let json = |what, cause, text: &str| (what, cause, 1_u64, "p_a", Encoding::Json, text.as_bytes().to_vec());
    let with = |what, cause, count, block: PressureBlock| {
        (what, cause, count, "p_a", Encoding::Bincode, wire::encode(&block).unwrap())
    };
    let values = |v: f64| PressureBlock { values: vec![80.0, v, 81.0, v], ..base.clone() };
    let garbage: Vec<u8> = (0..200_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let mut schema_and_garbage = SCHEMA.to_le_bytes().to_vec();
    schema_and_garbage.extend(&garbage);
    let mut huge_length = good[..38].to_vec();
    huge_length.extend(u64::MAX.to_le_bytes());
    let offsets = vec![0, PERIOD_NS];
    let all = vec![
        bytes("nothing", "malformed", Vec::new()),
        bytes("one byte", "malformed", vec![1]),
        bytes("garbage", "wrong_schema", garbage),
        bytes("garbage after the version", "malformed", schema_and_garbage),
        bytes("truncated", "malformed", good[..good.len() - 1].to_vec()),
        bytes("only the version", "malformed", good[..2].to_vec()),
        bytes("trailing bytes", "malformed", [good.as_slice(), &[0]].concat()),
        bytes("a length beyond memory", "malformed", huge_length),
        bytes("a million samples", "oversized", raw_bytes(1, &vec![80.0; 1_000_000])),
        bytes("too many samples", "oversized", raw_bytes(1, &vec![80.0; 16_385])),
        with("another version", "wrong_schema", 1, PressureBlock { schema: 3, ..base.clone() }),
        with("NaN", "not_finite", 2, values(f64::NAN)),
        with("infinite", "not_finite", 2, values(f64::INFINITY)),
        with("minus infinite", "not_finite", 2, values(f64::NEG_INFINITY)),
        with("1e9 mmHg", "implausible", 2, values(1e9)),
        with("period and offsets", "malformed", 1, PressureBlock { offsets_ns: vec![0; BLOCK], ..base.clone() }),
        with("neither period nor offsets", "malformed", 1, PressureBlock { period_ns: 0, ..base.clone() }),
        with("too few offsets", "malformed", 1, PressureBlock { period_ns: 0, offsets_ns: offsets, ..base.clone() }),
        with("a negative period", "malformed", 1, PressureBlock { period_ns: -1, ..base.clone() }),
        with("times beyond the integers", "malformed", 1, PressureBlock { start_ns: i64::MAX, ..base.clone() }),
        with(
            "the last possible time",
            "clock_jump",
            1,
            PressureBlock { start_ns: i64::MAX, values: vec![80.0], ..base.clone() },
        ),
        with(
            "the first possible time",
            "clock_jump",
            1,
            PressureBlock { start_ns: i64::MIN, values: vec![80.0], ..base.clone() },
        ),
        with("an hour ahead", "clock_jump", 10, PressureBlock { start_ns: 3_600_000 * MS, ..base.clone() }),
        ("unknown channel", "unknown_channel", 1, "spirit_level", Encoding::Bincode, good.clone()),
        json("JSON garbage", "malformed", "{\"schema\": 2, \"values\": [80"),
        json("no JSON", "malformed", "\u{0}\u{1}"),
        json("JSON of something else", "malformed", "[1, 2, 3]"),
        json("JSON of another version", "wrong_schema", "{\"schema\": 7}"),
        json("JSON with a NaN", "malformed", &json_block(&base).replace("80.0", "NaN")),
        json("JSON with a number too large", "malformed", &json_block(&base).replace("80.0", "1e999")),
        json("JSON with 1e9 mmHg", "implausible", &json_block(&base).replace("80.0", "1e9")),
        json("bottomless JSON", "malformed", &"[".repeat(100_000)),
    ];
    let named = |(i, (what, cause, count, channel, encoding, payload)): (usize, (_, _, _, &str, _, _))| {
        let bed = format!("bad-{i}");
        let message = Message { encoding, ..message(&bed, channel, payload) };
        (bed, Bad { what, message, cause, count })
    };
    all.into_iter().enumerate().map(named).collect()
}

/// A block whose only value is 80.0, as JSON without what may be left out.
fn json_block(block: &PressureBlock) -> String {
    format!(
        "{{\"schema\": {}, \"sequence\": {}, \"flags\": 0, \"start_ns\": {}, \"period_ns\": 0, \"values\": [80.0]}}",
        block.schema, block.sequence, block.start_ns
    )
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bad_input_is_counted_and_disturbs_nobody_else() {
    let config = config(&[]);
    let good = record("good", 20);
    let alone = said_to(&config, good.clone()).await;

    let bad = bad_messages();
    let mut messages = Vec::new();
    let mut rest = good.into_iter();
    for (bed, bad) in &bad {
        messages.push(encoded(bed, 0, &block(bed, 0, 0)));
        messages.push(encoded(bed, 1, &block(bed, 1, 0)));
        messages.push(bad.message.clone());
        messages.extend(rest.next());
        // What comes after is understood again.
        messages.push(encoded(bed, 1, &block(bed, 1, 1)));
    }
    messages.extend(rest);
    let said = said_to(&config, messages).await;

    for (bed, Bad { what, cause, count, .. }) in &bad {
        let counters = said.counters(bed);
        assert_eq!(counters.get(*cause), Some(count), "{what}: {counters:?}");
        assert_eq!(counters.len(), 1, "{what}: {counters:?}");
        let rejected: Vec<Event> = said.events(bed).into_iter().filter(|e| e.kind == "rejected").collect();
        assert_eq!(rejected.len(), 1, "{what}");
        assert!(rejected[0].text.contains(cause), "{what}: {}", rejected[0].text);
        assert!(!said.kinds(bed).iter().any(|kind| kind == "lost"), "{what}");
        assert!(!said.states(bed).is_empty(), "{what}");
        assert_eq!(said.last_status(bed).channels[1].last_sample_ns, end_of_record(2), "{what}");
    }
    for topic in ["estimate/state", "estimate/parameters", "event"] {
        let key = format!("hemostream/good/{topic}");
        assert!(!alone.payloads(&key).is_empty());
        assert_eq!(said.payloads(&key), alone.payloads(&key), "{topic}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_nobody_understands_makes_no_bed() {
    let mut messages = vec![message("ghost", "p_a", vec![7; 30]), message("ghost", "spirit_level", vec![7; 30])];
    // A state that is known and not listened to is no error.
    messages.push(message("ghost", "p_v", vec![7; 30]));
    messages.extend(record("icu", 2));
    let said = said_to(&config(&[]), messages).await;
    assert_eq!(said.beds(), ["icu"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn json_and_labels_are_the_same_blocks() {
    let config = config(&[]);
    let plain = record("icu", 4);
    let other = plain.iter().map(|m| {
        let block: PressureBlock = wire::decode(&m.payload, Encoding::Bincode).unwrap();
        let key = m.key.replace("/p_a", "/ART").replace("/p_pa", "/PAP");
        Message { key, encoding: Encoding::Json, payload: serde_json::to_vec(&block).unwrap() }
    });
    let (a, b) = (said_to(&config, plain.clone()).await, said_to(&config, other).await);
    assert_eq!(a.states("icu").len(), 10);
    assert_eq!(a.states("icu"), b.states("icu"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn explicit_times_are_the_same_as_a_period() {
    let config = config(&[]);
    let plain = record("icu", 4);
    let explicit = plain.iter().map(|m| {
        let block: PressureBlock = wire::decode(&m.payload, Encoding::Bincode).unwrap();
        let offsets_ns = (0..block.values.len() as i64).map(|i| i * PERIOD_NS).collect();
        let block = PressureBlock { period_ns: 0, offsets_ns, ..block };
        Message { payload: wire::encode(&block).unwrap(), ..m.clone() }
    });
    let (a, b) = (said_to(&config, plain.clone()).await, said_to(&config, explicit).await);
    assert_eq!(a.states("icu"), b.states("icu"));
}

/// Sequence numbers are only for counting, and counting never fails.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_blocks_are_counted() {
    let numbered = |bed: &str, sequences: &[u64]| -> Vec<Message> {
        let one = |(k, &sequence)| encoded(bed, 0, &PressureBlock { sequence, ..block(bed, 0, k) });
        sequences.iter().enumerate().map(one).collect()
    };
    let max = u64::MAX;
    let mut messages = numbered("some", &[5, 6, 9, 10, 20]);
    messages.extend(numbered("again", &[0, 1, 2, 0, 1, 2]));
    messages.extend(numbered("absurd", &[0, max, 0, max, max, 3, max - 1]));
    let said = said_to(&config(&[]), messages).await;
    assert_eq!(said.counters("some").get("lost_blocks"), Some(&11));
    assert_eq!(said.counters("again").get("lost_blocks"), None);
    assert_eq!(said.counters("absurd").get("lost_blocks"), Some(&max));
    assert!(!said.kinds("absurd").iter().any(|kind| kind == "lost"));
}

/// Bits of everything in a published state estimate.
fn state_bits(estimate: &StateEstimate) -> (i64, Vec<u64>) {
    (estimate.header.time_ns, estimate.values.iter().chain(&estimate.since_data_s).map(|v| v.to_bits()).collect())
}

fn parameter_bits(estimate: &ParameterEstimate) -> Vec<u64> {
    estimate.values.iter().map(|v| v.to_bits()).collect()
}

/// The same record through the state machine, without bus, service or threads.
fn estimated_directly(config: &Config, blocks: usize) -> Vec<Estimate> {
    let mut estimator = Estimator::new(config.circulation().unwrap(), config.estimator_settings().unwrap()).unwrap();
    let mut outputs = Vec::new();
    for k in 0..blocks {
        for channel in 0..CHANNELS.len() {
            let block = block("icu", channel, k);
            let raw = |(i, value): (usize, &f64)| RawSample {
                time: EventTime(block.start_ns + i as i64 * PERIOD_NS),
                value: *value,
            };
            let samples = block.values.iter().enumerate().map(raw).collect();
            estimator.handle(Input::Samples { channel, samples }, ArrivalTime(0), &Serial, &mut outputs);
        }
    }
    estimator.handle(Input::End, ArrivalTime(0), &Serial, &mut outputs);
    let estimate = |output| if let Output::Estimate(estimate) = output { Some(estimate) } else { None };
    outputs.into_iter().filter_map(estimate).collect()
}

fn direct_state_bits(estimate: &Estimate) -> (i64, Vec<u64>) {
    let row = |s: &Summary| [s.mean, s.sd, s.epistemic_sd, s.aleatoric_sd, s.model_sd, s.q05, s.q95];
    let since = s_from_ns(estimate.since_data_ns);
    (estimate.time.0, estimate.quantities.iter().flat_map(row).chain([since]).map(f64::to_bits).collect())
}

fn direct_parameter_bits(estimate: &Estimate) -> Vec<u64> {
    let row = |(p, since): &(hemostream::estimate::ensemble::ParameterSummary, i64)| {
        let s = &p.summary;
        let identifiable = if p.is_identifiable() { 1.0 } else { 0.0 };
        [s.mean, s.sd, s.q05, s.q95, p.identifiability, s_from_ns(*since), identifiable]
    };
    estimate.parameters.iter().flat_map(row).map(f64::to_bits).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn estimates_do_not_depend_on_threads_or_on_the_service() {
    let blocks = 30;
    // Members enough for several threads.
    let members = "estimator.members=40";
    let direct = estimated_directly(&config(&[members]), blocks);
    assert_eq!(direct.len() as i64, end_of_record(blocks) / (20 * MS) + 1);
    for threads in [1, 2, 3] {
        let config = config(&[members, &format!("service.workers={threads}")]);
        let said = said_to(&config, record("icu", blocks)).await;
        let states: Vec<_> = said.states("icu").iter().map(state_bits).collect();
        assert_eq!(states, direct.iter().map(direct_state_bits).collect::<Vec<_>>(), "{threads} threads");
        let parameters: Vec<ParameterEstimate> = said.all("icu", "estimate/parameters");
        let parameters: Vec<_> = parameters.iter().map(parameter_bits).collect();
        assert_eq!(parameters, direct.iter().map(direct_parameter_bits).collect::<Vec<_>>(), "{threads} threads");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_late_joiner_gets_the_last_values() {
    let daemon = Daemon::start(&config(&[]));
    assert!(daemon.last("hemostream/**").is_none());
    record("icu", 10).into_iter().for_each(|m| daemon.send(m));
    record("ward", 6).into_iter().for_each(|m| daemon.send(m));
    // The last published time before the end of the record.
    let last_ns = |blocks| end_of_record(blocks) / (20 * MS) * 20 * MS;
    let time = |m: &Message| wire::decode::<StateEstimate>(&m.payload, Encoding::Bincode).unwrap().header.time_ns;
    let icu = daemon.wait_for("hemostream/icu/estimate/state", |m| time(m) == last_ns(10)).await;
    daemon.wait_for("hemostream/ward/estimate/state", |m| time(m) == last_ns(6)).await;
    let ask = |pattern: &str| daemon.bus.last_values(pattern, Duration::from_secs(1)).unwrap();

    let mut states = ask("hemostream/*/estimate/state");
    states.sort_by(|a, b| a.key.cmp(&b.key));
    assert_eq!(
        states.iter().map(|m| m.key.as_str()).collect::<Vec<_>>(),
        ["hemostream/icu/estimate/state", "hemostream/ward/estimate/state"]
    );
    assert_eq!(states[0], icu);

    let twins = ask("hemostream/icu/*/*/json");
    assert_eq!(twins.len(), 2, "state and parameters");
    let twin = twins.iter().find(|m| m.key == "hemostream/icu/estimate/state/json").unwrap();
    assert_eq!(twin.encoding, Encoding::Json);
    let json: serde_json::Value = serde_json::from_slice(&twin.payload).unwrap();
    let state: StateEstimate = wire::decode(&icu.payload, Encoding::Bincode).unwrap();
    assert_eq!(json["time_ns"], state.header.time_ns);
    assert_eq!(json["quantities"]["p_l"]["mean"][0].as_f64().unwrap().to_bits(), state.values[0].to_bits());

    daemon.wait_for("hemostream/icu/status/json", |_| true).await;
    let event = daemon.wait_for("hemostream/icu/event/json", |_| true).await;
    assert_eq!(serde_json::from_slice::<serde_json::Value>(&event.payload).unwrap()["kind"], "start");
    assert!(ask("hemostream/nobody/**").is_empty());
    assert!(ask("hemostream/icu/pressure/*").is_empty(), "pressures are not ours");

    let bus = daemon.bus.clone();
    let said = daemon.stop().await;
    assert_eq!(said.payloads("hemostream/icu/estimate/state").last(), Some(&icu.payload.as_slice()));
    assert!(bus.last_values("hemostream/**", Duration::from_secs(1)).unwrap().is_empty(), "it offers no longer");
}

/// The JSON twins and the whole ensemble, which are made for subscribers only.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscribers_get_what_they_want() {
    let topics = ["estimate/state", "estimate/state/json", "estimate/members", "status"];
    let daemon = Daemon::start_on(MemoryBus::new(), &config(&["publish.status_rate_hz=100"]), &topics);
    let mut blocks = record("icu", 40).into_iter();
    blocks.by_ref().take(20).for_each(|m| daemon.send(m));
    daemon.wait_for("hemostream/icu/status", |_| true).await;
    blocks.for_each(|m| daemon.send(m));
    let said = daemon.stop().await;
    let twins = said.payloads("hemostream/icu/estimate/state/json");
    assert_eq!(twins.len(), said.states("icu").len());
    let members: Vec<wire::Members> = said.all("icu", "estimate/members");
    let last = members.last().expect("the ensemble is wanted");
    assert_eq!(last.values.len(), 8 * last.names.len());
    assert_eq!(last.header.time_ns, said.states("icu").last().unwrap().header.time_ns);
    assert!(said.payloads("hemostream/icu/estimate/members/json").is_empty());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_bed_more_than_allowed_is_refused() {
    let config = config(&["service.max_beds=2"]);
    let two = said_to(&config, in_turn(vec![record("one", 8), record("two", 8)])).await;
    let three = said_to(&config, in_turn(vec![record("one", 8), record("two", 8), record("three", 8)])).await;
    assert_eq!(three.beds(), ["one", "two"]);
    for bed in ["one", "two"] {
        assert_eq!(three.states(bed).len(), 20);
        assert_eq!(three.states(bed), two.states(bed));
        assert_eq!(three.counters(bed), BTreeMap::new());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bed_that_has_been_silent_for_long_makes_room() {
    let bus = MemoryBus::new();
    let config = config(&["service.max_beds=1"]);
    let topics = ["estimate/state", "status", "event"];
    let daemon = Daemon::start_forgetting(bus, &config, &topics, Duration::from_millis(300));
    let time = |m: &Message| wire::decode::<StateEstimate>(&m.payload, Encoding::Bincode).unwrap().header.time_ns;
    record("one", 8).into_iter().for_each(|m| daemon.send(m));
    daemon.wait_for("hemostream/one/estimate/state", |m| time(m) == end_of_record(8) / (20 * MS) * 20 * MS).await;
    // It has spoken just now.
    record("two", 8).into_iter().for_each(|m| daemon.send(m));
    tokio::time::sleep(Duration::from_millis(400)).await;
    record("three", 8).into_iter().for_each(|m| daemon.send(m));
    daemon.wait_for("hemostream/three/estimate/state", |_| true).await;
    assert!(daemon.last("hemostream/one/**").is_none(), "what has gone is no news for late joiners");
    let said = daemon.stop().await;
    assert_eq!(said.beds(), ["one", "three"]);
    assert_eq!([said.states("one").len(), said.states("three").len()], [20, 20]);
    assert_eq!(said.kinds("one"), ["start", wire::GONE], "and dashboards are told");
}

/// A subscriber that hangs until its gate is opened.
fn gated(bus: &MemoryBus) -> (Subscription, Sender<()>) {
    let (open, gate) = channel::<()>();
    let gate = Mutex::new(gate);
    let hang = move |message: Message| {
        if message.key.contains("/estimate/") {
            // Opened for good when the sender is dropped.
            let _ = gate.lock().unwrap().recv();
        }
    };
    (bus.subscribe("hemostream/**", Arc::new(hang)).unwrap(), open)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_subscriber_that_hangs_does_not_stop_the_service() {
    let bus = MemoryBus::new();
    let (_hanging, open) = gated(&bus);
    let config = config(&["publish.rate_hz=200", "publish.json=false"]);
    let daemon = Daemon::start_on(bus, &config, &["estimate/state"]);
    // More estimates than the queue of the outlet takes.
    let blocks = 300;
    in_turn(vec![record("icu", blocks), record("ward", blocks)]).into_iter().for_each(|m| daemon.send(m));
    for bed in ["icu", "ward"] {
        let time = |m: &Message| wire::decode::<StateEstimate>(&m.payload, Encoding::Bincode).unwrap().header.time_ns;
        daemon.wait_for(&format!("hemostream/{bed}/estimate/state"), |m| time(m) == end_of_record(blocks)).await;
    }
    let status = |m: &Message| wire::decode::<Status>(&m.payload, Encoding::Bincode).unwrap();
    let dropped = |m: &Message| status(m).counters.iter().any(|(cause, n)| cause == "publish_dropped" && *n > 0);
    daemon.wait_for("hemostream/icu/status", dropped).await;
    drop(open);
    let said = daemon.stop().await;
    let (heard, made) = (said.states("icu"), end_of_record(blocks) / PERIOD_NS + 1);
    assert!(!heard.is_empty() && (heard.len() as i64) < made);
    assert!(heard.windows(2).all(|pair| pair[0].header.sequence < pair[1].header.sequence), "in order, with holes");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn more_than_a_bed_can_queue_is_counted() {
    let config = config(&["service.queue_blocks=16", "service.workers=1", "estimator.members=40"]);
    let daemon = Daemon::start(&config);
    let blocks = 200;
    record("icu", blocks).into_iter().for_each(|m| daemon.send(m));
    // Another bed is served all the same.
    let status = daemon.wait_for("hemostream/icu/status", |m| {
        let status: Status = wire::decode(&m.payload, Encoding::Bincode).unwrap();
        status.queue_depth == 0 && status.counters.iter().any(|(cause, _)| cause == "queue_full")
    });
    status.await;
    record("ward", 4).into_iter().for_each(|m| daemon.send(m));
    let said = daemon.stop().await;
    assert_eq!(said.states("ward").len(), 10);
}
