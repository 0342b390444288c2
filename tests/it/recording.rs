//! Recordings: everything that crosses the bus, on the disk and back.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use hemostream::edge::bus::{Bus, BusError, Delivery, Encoding, Handler, LastValues, MemoryBus, Message, Subscription};
use hemostream::edge::config::Config;
use hemostream::edge::files::columnar::{Column, Reader};
use hemostream::edge::files::units::Units;
use hemostream::edge::inlet;
use hemostream::edge::outlet::Outlet;
use hemostream::edge::recording::layout::{self, Parts};
use hemostream::edge::recording::merge::{Job, merge};
use hemostream::edge::recording::playback::{Playback, play};
use hemostream::edge::recording::recorder::{self, RecordOptions, Recorder, Summary};
use hemostream::edge::replay::{Bed, ReplayOptions, Source, run};
use hemostream::edge::wire::{
    self, Acknowledge, Alarm, Alarms, Beats, Header, Note, PressureBlock, SCHEMA, StateEstimate, Truth,
};
use hemostream::runtime::clock::Clock;
use hemostream::runtime::service::{Limits, Service};
use hemostream::runtime::workers::Workers;
use serde::Serialize;

const S: i64 = 1_000_000_000;
/// 2026-01-01T00:59:50Z: an hour is over soon.
const START: i64 = 1_767_229_190 * S;

fn config() -> Config {
    let sets = [
        "estimator.members=8",
        "window.length_s=0.005",
        "window.allowed_lateness_s=600",
        "observed=[\"p_a\", \"p_pa\"]",
        "service.workers=2",
        "publish.rate_hz=50",
    ];
    Config::load_from(None, [], &sets.map(str::to_owned)).unwrap().0
}

fn options() -> RecordOptions {
    RecordOptions { prefix: "hemostream".to_owned(), beds: Vec::new(), members: false, flush_s: 2.0, max_beds: 4 }
}

fn open(directory: &Path, now_ns: i64) -> Recorder {
    Recorder::open(directory, options(), Units::of_model(&config().circulation().unwrap()), now_ns).unwrap()
}

fn message(bed: &str, topic: &str, content: &impl Serialize) -> Message {
    let payload = wire::encode(content).unwrap();
    Message { key: format!("hemostream/{bed}/{topic}"), encoding: Encoding::Bincode, payload }
}

fn block(sequence: u64, start_ns: i64, values: &[f64]) -> PressureBlock {
    let (values, offsets_ns) = (values.to_vec(), (0..values.len() as i64).map(|i| i * 5_000_000 + i % 3).collect());
    PressureBlock { schema: SCHEMA, sequence, flags: 0, start_ns, period_ns: 0, offsets_ns, values }
}

/// Every file of a table and bed that counts, in order.
fn files(directory: &Path, table: &str, bed: &str) -> Vec<PathBuf> {
    let beds = layout::beds(directory, table).unwrap();
    let Some((_, folder)) = beds.into_iter().find(|(name, _)| name == bed) else { return Vec::new() };
    let hours = layout::hours(&folder).unwrap();
    hours.iter().flat_map(|hour| Parts::of(hour).unwrap().live).map(|part| part.path).collect()
}

/// All rows of a table and bed as text with the bits of floats; columns are named before each.
fn rows(directory: &Path, table: &str, bed: &str, without: &[&str]) -> Vec<String> {
    let mut rows = Vec::new();
    for path in files(directory, table, bed) {
        let mut reader = Reader::open(&path).unwrap();
        let names: Vec<String> = reader.fields().iter().map(|f| f.name.clone()).collect();
        while let Some(batch) = reader.next_batch(1000).unwrap() {
            for row in 0..batch.rows() {
                let cell = |column: &Column| match column {
                    Column::Int(cells) => format!("{:?}", cells[row]),
                    Column::Float(cells) => format!("{:?}", cells[row].map(f64::to_bits)),
                    Column::Text(cells) => cells[row].to_string(),
                };
                let named = names.iter().zip(batch.columns()).filter(|(name, _)| !without.contains(&name.as_str()));
                rows.push(named.map(|(name, column)| format!("{name}={}", cell(column))).collect::<Vec<_>>().join(" "));
            }
        }
    }
    rows
}

fn played(directory: &Path, beds: &[&str]) -> Vec<(i64, Message)> {
    let beds: Vec<String> = beds.iter().map(|b| (*b).to_owned()).collect();
    let mut playback = Playback::open(directory, &beds, "hemostream").unwrap();
    std::iter::from_fn(|| playback.next_message().unwrap()).collect()
}

#[test]
fn what_came_in_comes_back_bit_for_bit_in_the_order_of_arrival() {
    let directory = tempfile::tempdir().unwrap();
    let nan = f64::from_bits(0x7ff8_0000_dead_beef);
    let (empty, last) = (block(u64::MAX, -7, &[]), PressureBlock { flags: 1, ..block(2, 5, &[nan]) });
    let truth = Truth { schema: SCHEMA, time_ns: 3, names: vec!["p_l".into(), "r_pv".into()], values: vec![-0.0, 0.1] };
    let period = PressureBlock { period_ns: 8, offsets_ns: vec![], ..block(0, 100, &[1.0, 2.0, 3.0]) };
    let note = Note { schema: SCHEMA, time_ns: 4, author: "N. N.".into(), text: "\"flush\",\nthen quiet".into() };
    let sent = [
        ("bed 1/x", "pressure/ART", message("b", "t", &block(0, 10, &[80.0, f64::INFINITY, nan, 5e-324]))),
        ("icu", "pressure/p_pa", message("b", "t", &empty)),
        ("icu", "truth", message("b", "t", &truth)),
        ("icu", "beat", message("b", "t", &Beats { schema: SCHEMA, onsets_ns: vec![5, i64::MIN] })),
        ("bed 1/x", "note", message("b", "t", &note)),
        (
            "icu",
            "acknowledge",
            message("b", "t", &Acknowledge { schema: SCHEMA, alarm: "low".into(), author: "me".into() }),
        ),
        ("icu", "pressure/p_pa", message("b", "t", &last)),
        // Twice the same at the same time.
        ("icu", "pressure/p_pa", message("b", "t", &last)),
        ("icu", "pressure/p_a", message("b", "t", &period)),
    ];
    let mut recorder = open(directory.path(), START);
    let mut expected = Vec::new();
    for (i, (bed, topic, content)) in sent.into_iter().enumerate() {
        // A slash cannot be in the name of a bed on the bus.
        let message = Message { key: format!("hemostream/{}/{topic}", bed.replace('/', "+")), ..content };
        let arrival = START + (i as i64).min(7) * 3 * S;
        recorder.take(message.clone(), arrival).unwrap();
        expected.push((arrival + i64::from(i == 8), message));
    }
    let explicit = PressureBlock { period_ns: 0, offsets_ns: vec![0, 8, 16], ..period };
    expected[8].1.payload = wire::encode(&explicit).unwrap();
    let summary = recorder.close().unwrap();
    assert_eq!((summary.beds, summary.rows["samples"], summary.rows["events"]), (2, 10, 4));
    assert!(summary.refused.is_empty());

    assert!(played(directory.path(), &[]) == expected);
    let icu: Vec<_> = expected.iter().filter(|(_, m)| m.key.contains("/icu/")).cloned().collect();
    assert!(played(directory.path(), &["icu"]) == icu);
    assert!(directory.path().join("samples/bed=bed%201%2Bx/hour=2026-01-01T00").is_dir());
    assert!(directory.path().join("samples/bed=icu/hour=2026-01-01T01").is_dir());
    let nobody = Playback::open(directory.path(), &["nobody".to_owned()], "p").err().unwrap().to_string();
    assert!(nobody.contains("found no bed `nobody`"), "{nobody}");
    assert!(Playback::open(&directory.path().join("none"), &[], "p").is_err());
}

#[test]
fn what_is_not_understood_is_counted_and_names_cannot_break_a_table() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START);
    let truth = |names: &[&str], values: &[f64]| Truth {
        schema: SCHEMA,
        time_ns: 0,
        names: names.iter().map(|n| (*n).to_owned()).collect(),
        values: values.to_vec(),
    };
    let odd = PressureBlock { offsets_ns: vec![0], ..block(0, 0, &[1.0, 2.0]) };
    let bad = [
        message("a", "truth", &truth(&["x", "x"], &[1.0, 2.0])),
        message("a", "truth", &truth(&["time_ns"], &[1.0])),
        message("a", "truth", &truth(&[""], &[1.0])),
        message("a", "truth", &truth(&["x"], &[])),
        message("a", "pressure/p_a", &odd),
        Message { payload: vec![1, 2, 3], ..message("a", "status", &1_u8) },
    ];
    bad.iter().for_each(|m| recorder.take(m.clone(), START).unwrap());
    for bed in 0..6 {
        recorder.take(message(&format!("bed{bed}"), "truth", &truth(&["x"], &[1.0])), START).unwrap();
    }
    recorder.take(message("bed0", "elsewhere", &1_u8), START).unwrap();
    recorder.take(Message { key: "other/bed0/truth".to_owned(), ..bad[0].clone() }, START).unwrap();
    let summary = recorder.close().unwrap();
    let causes = [("malformed", 5), ("too_many_beds", 2), ("unknown_topic", 1), ("wrong_schema", 1)];
    assert_eq!(summary.refused, BTreeMap::from(causes));
    assert_eq!(summary.rows, BTreeMap::from([("truth", 4)]));
}

fn one_truth() -> Truth {
    Truth { schema: SCHEMA, time_ns: 0, names: vec!["x".to_owned()], values: vec![1.0] }
}

#[test]
fn a_bed_that_is_silent_for_an_hour_makes_room_for_another() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START);
    let take = |recorder: &mut Recorder, bed: &str, s: i64| {
        recorder.take(message(bed, "truth", &one_truth()), START + s * S).unwrap();
        recorder.flush_due(START + (s + 4) * S).unwrap();
    };
    for bed in ["a", "b", "c", "d", "e"] {
        take(&mut recorder, bed, 0);
    }
    take(&mut recorder, "b", 1800);
    take(&mut recorder, "e", 3590);
    // All but one have been silent by now.
    take(&mut recorder, "b", 3610);
    for bed in ["e", "f", "g", "h"] {
        take(&mut recorder, bed, 3620);
    }
    let summary = recorder.close().unwrap();
    assert_eq!(summary.refused, BTreeMap::from([("too_many_beds", 3)]));
    assert_eq!((summary.beds, summary.rows["truth"]), (7, 9));
}

#[test]
fn what_never_came_is_counted_by_sequence_numbers() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START);
    for sequence in [10, 11, 15, 2, 3] {
        recorder.take(message("icu", "pressure/p_a", &block(sequence, 0, &[1.0])), START).unwrap();
        recorder.take(message("icu", "pressure/p_pa", &block(sequence / 3, 0, &[])), START).unwrap();
    }
    for sequence in [7, 9] {
        recorder.take(message("icu", "estimate/state", &state(sequence, &["p_a"])), START).unwrap();
    }
    // 12, 13, 14 of p_a; 4 of p_pa; 8 of the estimates. A sender that begins again has lost nothing.
    let summary = recorder.close().unwrap();
    assert_eq!((summary.lost, summary.recovered), (5, 0));
}

#[test]
fn of_alarms_the_changes_are_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START);
    let alarm = |name: &str, state: &str, acknowledged: bool| Alarm {
        name: name.to_owned(),
        quantity: "p_a".to_owned(),
        unit: "mmHg".to_owned(),
        priority: "high".to_owned(),
        state: state.to_owned(),
        acknowledged,
        side: "below".to_owned(),
        limit: 60.0,
        since_ns: 1,
        band: [50.0, 45.0, 55.0],
        text: format!("{name} is {state}"),
    };
    let steps = [
        [("map", "normal", false), ("pap", "normal", false)],
        [("map", "active", false), ("pap", "normal", false)],
        [("map", "active", true), ("pap", "pending", false)],
    ];
    for (i, step) in steps.iter().enumerate() {
        let header =
            Header { schema: SCHEMA, seed: 7, config_hash: u64::MAX - 1, sequence: i as u64, time_ns: i as i64 };
        let alarms = Alarms { header, alarms: step.iter().map(|(n, s, a)| alarm(n, s, *a)).collect() };
        recorder.take(message("icu", "alarm", &alarms), START + i as i64).unwrap();
    }
    recorder.close().unwrap();
    let rows = rows(directory.path(), "events", "icu", &["arrival", "detail", "author"]);
    let row = |kind: &str, name: &str, i: usize| {
        format!(
            "source=alarm kind={kind} channel=p_a name={name} text={name} is {kind} time_ns=Some({i}) \
             sequence=Some({i}) seed=Some(7) config_hash=fffffffffffffffe"
        )
    };
    let expected =
        [("normal", "map", 0), ("normal", "pap", 0), ("active", "map", 1), ("active", "map", 2), ("pending", "pap", 2)];
    assert_eq!(rows, expected.map(|(kind, name, i)| row(kind, name, i)));
}

fn state(sequence: u64, names: &[&str]) -> StateEstimate {
    let header = Header { schema: SCHEMA, seed: 1, config_hash: 2, sequence, time_ns: sequence as i64 };
    let values = (0..names.len() * 7).map(|i| sequence as f64 + i as f64 / 100.0).collect();
    let names = names.iter().map(|n| (*n).to_owned()).collect();
    StateEstimate { header, members: 8, times_ns: vec![sequence as i64], since_data_s: vec![0.0], names, values }
}

#[test]
fn parts_are_merged_when_many_and_when_the_hour_is_over_and_other_columns_begin_another_file() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START - 200 * S);
    let mut expected = Vec::new();
    for i in 0..40_u64 {
        let now = START + (i as i64 - 40) * 3 * S;
        recorder.take(message("icu", "estimate/state", &state(i, &["p_a"])), now).unwrap();
        recorder.flush_due(now + 2 * S).unwrap();
        expected.push(i);
    }
    recorder.take(message("icu", "estimate/state", &state(40, &["p_a", "p_v"])), START).unwrap();
    recorder.take(message("icu", "estimate/state", &state(41, &["p_a"])), START + 1).unwrap();
    // Another hour.
    recorder.take(message("icu", "estimate/state", &state(42, &["p_a"])), START + 11 * S).unwrap();
    expected.extend([40, 41, 42]);
    recorder.close().unwrap();
    let names: Vec<String> = files(directory.path(), "estimates", "icu")
        .iter()
        .map(|path| path.file_name().unwrap().to_str().unwrap().to_owned())
        .collect();
    let merged = ["part-000000-000039.parquet", "part-000040.parquet", "part-000041.parquet", "part-000000.parquet"];
    assert_eq!(names, merged);
    let sequences: Vec<String> = rows(directory.path(), "estimates", "icu", &[])
        .iter()
        .map(|row| row.split(' ').find(|cell| cell.starts_with("sequence=")).unwrap().to_owned())
        .collect();
    assert_eq!(sequences, expected.iter().map(|i| format!("sequence=Some({i})")).collect::<Vec<_>>());
    let reader = Reader::open(&files(directory.path(), "estimates", "icu")[0]).unwrap();
    let unit = |name: &str| reader.fields()[reader.column(name).unwrap()].unit.clone();
    assert_eq!((unit("p_a_q05"), unit("since_data_s")), ("mmHg".to_owned(), "s".to_owned()));
    assert_eq!(
        (reader.metadata("hemostream.wire"), reader.metadata("hemostream.table")),
        (Some("2"), Some("estimates"))
    );
}

/// Every state in which a crash can leave a merge, and what the next start makes of it.
#[test]
fn nothing_is_lost_or_doubled_by_an_interruption() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = open(directory.path(), START);
    for i in 0..5 {
        recorder.take(message("icu", "pressure/p_a", &block(i, 0, &[1.0, 2.0])), START + i as i64).unwrap();
        recorder.flush_due(START + 3 * S).unwrap();
    }
    // What waits in memory dies with the recorder; what was flushed does not.
    recorder.take(message("icu", "pressure/p_a", &block(5, 0, &[3.0])), START + 9).unwrap();
    drop(recorder);
    let before = rows(directory.path(), "samples", "icu", &[]);
    assert_eq!(before.len(), 10);
    let folder = files(directory.path(), "samples", "icu")[0].parent().unwrap().to_owned();
    let kept: Vec<(PathBuf, Vec<u8>)> = files(directory.path(), "samples", "icu")
        .into_iter()
        .map(|path| (path.clone(), std::fs::read(path).unwrap()))
        .collect();
    merge(&Job { folder: folder.clone(), all: false }).unwrap();
    assert_eq!(rows(directory.path(), "samples", "icu", &[]), before);
    // As if the crash had come before the parts were removed: all of them, then some.
    for from in [0, 3] {
        for (path, bytes) in &kept[from..] {
            std::fs::write(path, bytes).unwrap();
        }
        std::fs::write(folder.join(".part-000005.parquet.tmp"), "half").unwrap();
        assert_eq!(rows(directory.path(), "samples", "icu", &[]), before, "readers of ours pass over leftovers");
        let recorder = open(directory.path(), START + 60 * S);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1, "the next start removes them");
        drop(recorder);
        assert_eq!(rows(directory.path(), "samples", "icu", &[]), before);
    }
    // It goes on behind what is there.
    let mut recorder = open(directory.path(), START + 60 * S);
    recorder.take(message("icu", "pressure/p_a", &block(6, 0, &[4.0])), START + S).unwrap();
    recorder.close().unwrap();
    assert!(folder.join("part-000005.parquet").exists());
    assert_eq!(rows(directory.path(), "samples", "icu", &[]).len(), 11);
    // A later hour: what is over is merged at the start.
    drop(open(directory.path(), START + 7200 * S));
    assert!(folder.join("part-000000-000005.parquet").exists());
    assert_eq!(rows(directory.path(), "samples", "icu", &[]).len(), 11);
}

#[test]
fn older_hours_are_tidied_beside_the_recording_and_those_to_come_are_left_alone() {
    let directory = tempfile::tempdir().unwrap();
    // The last first, so that none finds what another left.
    let hours = [1, 0, -1, -30].map(|hour| START + hour * 3600 * S);
    let folders = hours.map(|ns| layout::folder(directory.path(), "truth", "icu", &layout::hour(ns)));
    for (ns, folder) in hours.into_iter().zip(&folders) {
        let mut recorder = open(directory.path(), ns);
        for s in [0, 4] {
            recorder.take(message("icu", "truth", &one_truth()), ns + s * S).unwrap();
            recorder.flush_due(ns + (s + 4) * S).unwrap();
        }
        drop(recorder);
        std::fs::write(folder.join(".part-000007.parquet.tmp"), "half").unwrap();
    }
    let names = |folder: &PathBuf| {
        let entries = std::fs::read_dir(folder).unwrap();
        let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    let (parts, merged) = (["part-000000.parquet", "part-000001.parquet"], ["part-000000-000001.parquet"]);
    let recorder = open(directory.path(), START);
    assert_eq!(names(&folders[1]), parts, "what was unfinished is gone at once");
    drop(recorder);
    assert_eq!(names(&folders[1]), parts);
    assert_eq!([&folders[2], &folders[3]].map(names), [merged, merged]);
    assert_eq!(names(&folders[0])[0], ".part-000007.parquet.tmp", "somebody may be writing it by then");
}

#[test]
fn two_recorders_do_not_share_a_directory_and_a_file_is_none() {
    let directory = tempfile::tempdir().unwrap();
    let one = open(directory.path(), START);
    let other = |path: &Path| Recorder::open(path, options(), Units::default(), START).err().unwrap().to_string();
    assert!(other(directory.path()).contains("another recorder at work"), "{}", other(directory.path()));
    drop(one);
    drop(open(directory.path(), START));
    let file = directory.path().join("file");
    std::fs::write(&file, "").unwrap();
    assert!(other(&file).contains("file"), "{}", other(&file));
}

/// What is between the bus and a recorder.
#[derive(Clone, Copy, PartialEq)]
enum Link {
    Lossless,
    /// Drops some samples and estimates, among them the first and the last.
    Drops,
    /// The same, and nobody answers requests.
    DropsAndNobodyAnswers,
}

/// A bus that loses what a busy network may.
struct Dropping {
    bus: MemoryBus,
    link: Link,
}

impl Dropping {
    fn drops(message: &Message) -> bool {
        let topic = message.key.splitn(3, '/').nth(2).unwrap();
        let is_last = topic.starts_with("pressure/")
            && wire::decode::<PressureBlock>(&message.payload, message.encoding).unwrap().flags != 0;
        let sequence = wire::sequence(topic, &message.payload, message.encoding);
        is_last || sequence.is_some_and(|n| [0, 3, 4].contains(&(n % 7)) || (100..130).contains(&n))
    }
}

impl Bus for Dropping {
    fn publish(&self, message: Message, delivery: Delivery) -> Result<(), BusError> {
        self.bus.publish(message, delivery)
    }

    fn is_wanted(&self, key: &str) -> bool {
        self.bus.is_wanted(key)
    }

    fn subscribe(&self, pattern: &str, handler: Handler) -> Result<Subscription, BusError> {
        let is_lossless = self.link == Link::Lossless;
        let lossy = move |message: Message| {
            if is_lossless || !Self::drops(&message) {
                handler(message);
            }
        };
        self.bus.subscribe(pattern, Arc::new(lossy))
    }

    fn offer_last_values(&self, pattern: &str, answer: LastValues) -> Result<Subscription, BusError> {
        self.bus.offer_last_values(pattern, answer)
    }

    fn last_values(&self, pattern: &str, timeout: Duration) -> Result<Vec<Message>, BusError> {
        let is_answered = self.link != Link::DropsAndNobodyAnswers;
        if is_answered { self.bus.last_values(pattern, timeout) } else { Ok(Vec::new()) }
    }
}

/// A recorder on a bus, in a thread of its own.
struct Recording {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Summary>,
}

impl Recording {
    fn start(bus: &MemoryBus, link: Link, directory: &Path) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (directory, stopped) = (directory.to_owned(), Arc::clone(&stop));
        let wanted = bus.clone();
        let to_recorder = Dropping { bus: bus.clone(), link };
        let thread = std::thread::spawn(move || {
            let units = Units::of_model(&config().circulation().unwrap());
            recorder::run(&to_recorder, &directory, options(), units, &stopped, &mut |_, _| {}).unwrap()
        });
        while !wanted.is_wanted("hemostream/bed1/alarm") {
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(!wanted.is_wanted("hemostream/bed1/estimate/members"));
        assert!(!wanted.is_wanted("hemostream/bed1/estimate/state/json"));
        Self { stop, thread }
    }

    fn stop(self) -> Summary {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap()
    }
}

/// Runs a daemon on a bus while `publish` does its work, and records it all over a link.
async fn recorded(directory: &Path, link: Link, publish: impl FnOnce(&MemoryBus) + Send + 'static) -> Summary {
    let (bus, config) = (MemoryBus::new(), config());
    let recording = Recording::start(&bus, link, directory);
    let workers = Arc::new(Workers::start(2).unwrap());
    let outlet = Arc::new(Outlet::start(Arc::new(bus.clone()), &config).unwrap());
    let limits =
        Limits { max_beds: 8, forget_after: Duration::MAX, queue_tasks: 1 << 16, report_every: Duration::from_secs(1) };
    let (model, settings) = (config.circulation().unwrap(), config.estimator_settings().unwrap());
    let sink = Arc::clone(&outlet);
    let (service, inlet) = Service::new(model, settings, limits, workers, sink, Clock::start()).unwrap();
    let service = tokio::spawn(service.run());
    let subscriptions = inlet::listen(&bus, &config, inlet.clone(), outlet.recent()).unwrap();
    let published = bus.clone();
    tokio::task::spawn_blocking(move || publish(&published)).await.unwrap();
    inlet.stop().await;
    service.await.unwrap();
    assert_eq!(inlet.dropped(), 0);
    // What is queued is published, and the daemon still remembers it.
    let remembered = outlet.recent().offer(&bus, "hemostream").unwrap();
    drop((subscriptions, outlet));
    let summary = recording.stop();
    drop(remembered);
    summary
}

/// Records synthetic patients, and the estimates of what is recorded played back; compares all tables but the arrivals.
async fn recorded_and_again(link: Link, first: &Path, second: &Path) -> Summary {
    let go = AtomicBool::new(false);
    let original = recorded(first, link, move |bus| {
        let config = config();
        let source = |seed| Source::synthetic(&config, seed).unwrap();
        let mut beds = [Bed::new("bed1", source(1)), Bed::new("bed2", source(2))];
        let options = ReplayOptions { seconds: Some(3.0), speed: 4.0, ..ReplayOptions::default() };
        run(bus, &config, &options, &mut beds, &go).unwrap();
    })
    .await;
    assert_eq!((original.beds, original.dropped, original.lost, original.refused.len()), (2, 0, 0, 0));
    assert!(original.rows["estimates"] >= 2 * 140, "{:?}", original.rows);

    let directory = first.to_owned();
    let counted = Arc::new(Mutex::new(0.0));
    let seconds = Arc::clone(&counted);
    let again = recorded(second, Link::Lossless, move |bus| {
        let mut playback = Playback::open(&directory, &[], "hemostream").unwrap();
        assert_eq!(playback.beds(), ["bed1", "bed2"]);
        let go = AtomicBool::new(false);
        *seconds.lock().unwrap() = play(bus, &mut playback, 4.0, None, &go, &mut |_| {}).unwrap().seconds;
    })
    .await;
    assert_eq!((again.beds, again.dropped, again.lost, again.recovered), (2, 0, 0, 0));
    let seconds = *counted.lock().unwrap();
    assert!((0.6..10.0).contains(&seconds), "arrivals of 3 s at four times the speed: {seconds} s");

    for bed in ["bed1", "bed2"] {
        for table in ["estimates", "parameters", "beats", "samples", "truth"] {
            let by_channel = |directory| {
                let mut rows = rows(directory, table, bed, &["arrival"]);
                // Stable: the samples of each channel keep their order.
                rows.sort_by_key(|row| {
                    row.split(' ').next().filter(|cell| cell.starts_with("channel=")).map(str::to_owned)
                });
                rows
            };
            let (a, b) = (by_channel(first), by_channel(second));
            println!("{bed} {table}: {} rows", a.len());
            assert!(!a.is_empty(), "{bed} {table}");
            assert!(a == b, "{bed} {table}");
        }
    }
    original
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_recording_that_is_played_back_is_estimated_to_the_same_bits() {
    let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let original = recorded_and_again(Link::Lossless, first.path(), second.path()).await;
    assert_eq!(original.recovered, 0);
    let headers = |m: &Message| m.key.clone();
    let (a, b) = (played(first.path(), &[]), played(second.path(), &[]));
    assert!(a.iter().map(|(_, m)| headers(m)).eq(b.iter().map(|(_, m)| headers(m))), "all beds in one order");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn so_is_one_whose_recorder_missed_much_of_it() {
    let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let original = recorded_and_again(Link::Drops, first.path(), second.path()).await;
    // Three of seven, and the second row of blocks altogether.
    let blocks: u64 = 2 * 2 * 300;
    assert!(original.recovered > blocks * 3 / 7, "{original:?}");
    for bed in ["bed1", "bed2"] {
        for table in ["estimates", "parameters", "status"] {
            let sequence = |row: &String| {
                let cell = row.split(' ').find_map(|cell| cell.strip_prefix("sequence=Some(")).unwrap().to_owned();
                cell.trim_end_matches(')').parse::<u64>().unwrap()
            };
            let sequences: Vec<u64> = rows(first.path(), table, bed, &[]).iter().map(sequence).collect();
            assert_eq!(sequences, (0..sequences.len() as u64).collect::<Vec<_>>(), "{bed} {table}");
        }
    }
    let arrivals: Vec<i64> = played(first.path(), &[]).iter().map(|(arrival, _)| *arrival).collect();
    assert!(arrivals.is_sorted_by(|a, b| a < b));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_nobody_has_is_lost() {
    let directory = tempfile::tempdir().unwrap();
    let go = AtomicBool::new(false);
    let summary = recorded(directory.path(), Link::DropsAndNobodyAnswers, move |bus| {
        let config = config();
        let mut beds = [Bed::new("bed1", Source::synthetic(&config, 1).unwrap())];
        let options = ReplayOptions { seconds: Some(1.0), speed: 4.0, ..ReplayOptions::default() };
        run(bus, &config, &options, &mut beds, &go).unwrap();
    })
    .await;
    assert!(summary.lost > 2 * 30 && summary.recovered == 0, "{summary:?}");
}

/// Rows of two tables wait, and a file stands where the folder of one of them should be.
fn half_broken(directory: &Path) -> Recorder {
    let mut recorder = open(directory, START);
    recorder.take(message("a", "pressure/p_a", &block(0, 0, &[1.0])), START).unwrap();
    recorder.take(message("b", "truth", &one_truth()), START).unwrap();
    recorder.flush_due(START + 3 * S / 2).unwrap();
    std::fs::write(directory.join("samples"), "").unwrap();
    recorder.take(message("c", "truth", &one_truth()), START + 2 * S).unwrap();
    let error = recorder.flush_due(START + 5 * S / 2).unwrap_err().to_string();
    assert!(error.contains("samples"), "{error}");
    recorder
}

#[test]
fn what_is_not_written_stays_and_what_else_there_is_gets_to_the_disk() {
    let directory = tempfile::tempdir().unwrap();
    let error = half_broken(directory.path()).close().unwrap_err().to_string();
    assert!(error.contains("samples"), "{error}");
    for bed in ["b", "c"] {
        assert_eq!(rows(directory.path(), "truth", bed, &[]).len(), 1, "{bed}");
    }

    let directory = tempfile::tempdir().unwrap();
    let recorder = half_broken(directory.path());
    std::fs::remove_file(directory.path().join("samples")).unwrap();
    recorder.close().unwrap();
    for (table, bed) in [("samples", "a"), ("truth", "b"), ("truth", "c")] {
        assert_eq!(rows(directory.path(), table, bed, &[]).len(), 1, "{table} of {bed}");
    }
}

#[test]
fn a_disk_that_does_not_take_it_ends_the_recording_with_what_is_wrong() {
    let directory = tempfile::tempdir().unwrap();
    // A file where the folder of a table should be.
    std::fs::write(directory.path().join("samples"), "").unwrap();
    let bus = MemoryBus::new();
    let stop = AtomicBool::new(false);
    let ended = std::thread::scope(|scope| {
        let recording = scope.spawn(|| {
            let quick = RecordOptions { flush_s: 0.01, ..options() };
            recorder::run(&bus, directory.path(), quick, Units::default(), &stop, &mut |_, _| {})
        });
        while !bus.is_wanted("hemostream/icu/alarm") && !recording.is_finished() {
            std::thread::sleep(Duration::from_millis(2));
        }
        bus.publish(message("icu", "pressure/p_a", &block(0, 0, &[1.0])), Delivery::Samples).unwrap();
        recording.join().unwrap()
    });
    let error = ended.unwrap_err().to_string();
    assert!(error.starts_with("recording: ") && error.contains("samples"), "{error}");
}

#[test]
fn a_disk_that_does_not_take_all_of_it_gets_the_rest_before_the_recording_ends() {
    let directory = tempfile::tempdir().unwrap();
    let bus = MemoryBus::new();
    let stop = AtomicBool::new(false);
    let ended = std::thread::scope(|scope| {
        let recording =
            scope.spawn(|| recorder::run(&bus, directory.path(), options(), Units::default(), &stop, &mut |_, _| {}));
        while !bus.is_wanted("hemostream/icu/alarm") && !recording.is_finished() {
            std::thread::sleep(Duration::from_millis(2));
        }
        std::fs::write(directory.path().join("samples"), "").unwrap();
        bus.publish(message("icu", "pressure/p_a", &block(0, 0, &[1.0])), Delivery::Samples).unwrap();
        bus.publish(message("other", "truth", &one_truth()), Delivery::Samples).unwrap();
        recording.join().unwrap()
    });
    let error = ended.unwrap_err().to_string();
    assert!(error.contains("samples"), "{error}");
    assert_eq!(rows(directory.path(), "truth", "other", &[]).len(), 1);
}
