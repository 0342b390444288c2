//! The screen as its user sees it, fed with made-up messages.

mod alarms;
mod keyboard;
mod list;
mod past;

use std::time::Duration;

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::super::bed::{Liveness, Origin};
use super::super::ward::{MAX_BEDS, Ward};
use super::MEMORY;
use super::ui::{Next, Ui};
use super::view;
use crate::edge::bus::{Encoding, Message};
use crate::edge::wire::{
    self, Alarm, Alarms, BeatEstimate, ChannelStatus, Event, Header, Note, PARAMETER_STATISTICS, ParameterEstimate,
    PressureBlock, SCHEMA, STATE_STATISTICS, StateEstimate, Status, Truth,
};
use crate::model::cvsim6::{FlowsAndVolumes, Pressures};

const MS: i64 = 1_000_000;
const SECOND: Duration = Duration::from_secs(1);
const SIZES: [(u16, u16); 3] = [(80, 24), (120, 40), (200, 60)];

fn message<T: serde::Serialize>(key: &str, content: &T) -> Message {
    Message { key: key.to_owned(), encoding: Encoding::Bincode, payload: wire::encode(content).unwrap() }
}

fn header(time_ns: i64) -> Header {
    Header { schema: SCHEMA, seed: 1, config_hash: 2, sequence: time_ns.unsigned_abs(), time_ns }
}

fn names() -> Vec<String> {
    Pressures::NAMES.iter().chain(FlowsAndVolumes::NAMES).map(|n| (*n).to_owned()).collect()
}

/// A pulse between 70 and 120, 75 times a minute; band of 4 on either side.
fn pulse(time_ns: i64) -> f64 {
    let phase = (time_ns % (800 * MS)) as f64 / (800 * MS) as f64;
    if phase < 0.4 { 70.0 + 50.0 * (phase * std::f64::consts::PI / 0.4).sin() } else { 70.0 }
}

fn state(bed: &str, time_ns: i64, since_data_s: f64) -> Message {
    let row = |mean: f64| [mean, 2.0, 1.0, 1.0, 1.0, mean - 4.0, mean + 4.0];
    assert_eq!(row(0.0).len(), STATE_STATISTICS.len());
    let estimate = StateEstimate {
        header: header(time_ns),
        members: 100,
        times_ns: vec![time_ns],
        since_data_s: vec![since_data_s],
        names: names(),
        values: names().iter().flat_map(|_| row(pulse(time_ns))).collect(),
    };
    message(&format!("ward/{bed}/estimate/state"), &estimate)
}

fn parameters(bed: &str, time_ns: i64) -> Message {
    let values = vec![0.0812, 0.002, 0.0771, 0.0853, 0.9, 0.1, 1.0, 1.61, 0.1, 1.52, 1.77, 0.9, 0.1, 1.0];
    assert_eq!(values.len(), 2 * PARAMETER_STATISTICS.len());
    let names = vec!["r_pv".to_owned(), "c_a".to_owned()];
    let estimate = ParameterEstimate { header: header(time_ns), members: 100, names, values };
    message(&format!("ward/{bed}/estimate/parameters"), &estimate)
}

/// Name, unit, mean and half the band of what a beat is told by.
const BEAT: [(&str, &str, f64, f64); 10] = [
    ("cardiac_output", "L/min", 5.12, 0.12),
    ("svr", "mmHg s/mL", 0.93, 0.04),
    ("pvr", "mmHg s/mL", 0.081, 0.004),
    ("p_a_systolic", "mmHg", 120.0, 2.0),
    ("p_a_diastolic", "mmHg", 70.0, 0.4),
    ("p_a_mean", "mmHg", 88.0, 1.0),
    ("p_pa_systolic", "mmHg", 25.0, 1.0),
    ("p_pa_diastolic", "mmHg", 10.0, 1.0),
    ("p_pa_mean", "mmHg", 15.0, 1.0),
    ("unheard_of", "", 1.0, 0.0),
];

fn beat(bed: &str, time_ns: i64) -> Message {
    let estimate = BeatEstimate {
        header: header(time_ns),
        members: 100,
        end_ns: time_ns + 800 * MS,
        names: BEAT.map(|(name, ..)| name.to_owned()).to_vec(),
        units: BEAT.map(|(_, unit, ..)| unit.to_owned()).to_vec(),
        values: BEAT.iter().flat_map(|(.., mean, half)| [*mean, *half, mean - half, mean + half]).collect(),
    };
    message(&format!("ward/{bed}/estimate/beat"), &estimate)
}

fn truth(bed: &str, time_ns: i64) -> Message {
    let (mut names, mut values) = (names(), vec![pulse(time_ns) + 1.0; 18]);
    names.push("r_pv".to_owned());
    values.push(0.0799);
    message(&format!("ward/{bed}/truth"), &Truth { schema: SCHEMA, time_ns, names, values })
}

fn samples(bed: &str, channel: &str, time_ns: i64) -> Message {
    let block = PressureBlock {
        schema: SCHEMA,
        sequence: 0,
        flags: 0,
        start_ns: time_ns,
        period_ns: 5 * MS,
        offsets_ns: vec![],
        values: (0..4).map(|i| pulse(time_ns + i * 5 * MS)).collect(),
    };
    message(&format!("ward/{bed}/pressure/{channel}"), &block)
}

fn status(bed: &str, time_ns: i64) -> Message {
    let channel = |name: &str, state: &str, innovation_rms: f64| ChannelStatus {
        name: name.to_owned(),
        state: state.to_owned(),
        last_sample_ns: time_ns - 3000 * MS,
        samples_used: 1234,
        innovation_rms,
        noise_sd: 2.0,
        whiteness: 1.0,
        recurrence: 1.0,
        misfit: false,
        artefact: String::new(),
    };
    let status = Status {
        header: header(time_ns),
        members_alive: 98,
        members: 100,
        windows: 6000,
        windows_without_data: 7,
        lag_p50_ms: 0.81,
        lag_p99_ms: 2.22,
        lag_max_ms: 9.43,
        solve_ms: 0.61,
        iterations: 2.2,
        not_converged: 3,
        queue_depth: 5,
        counters: vec![("late".to_owned(), 42)],
        channels: vec![channel("p_a", "live", 1.04), channel("p_v", "silent", 2.5)],
        disagreement: Vec::new(),
    };
    message(&format!("ward/{bed}/status"), &status)
}

/// An alarm on something of which a limit of 25 was passed at 7 s.
fn alarm(name: &str, priority: &str, state: &str, acknowledged: bool) -> Alarm {
    Alarm {
        name: name.to_owned(),
        quantity: "p_pa_mean".to_owned(),
        unit: "mmHg".to_owned(),
        priority: priority.to_owned(),
        state: state.to_owned(),
        acknowledged,
        side: "above".to_owned(),
        limit: 25.0,
        since_ns: 7000 * MS,
        band: [29.0, 28.0, 30.0],
        text: format!("what is the matter with {name}"),
    }
}

fn alarms(bed: &str, alarms: Vec<Alarm>) -> Message {
    message(&format!("ward/{bed}/alarm"), &Alarms { header: header(0), alarms })
}

fn note(bed: &str, time_ns: i64, text: &str) -> Message {
    let note = Note { schema: SCHEMA, time_ns, author: "Dr. Weber".to_owned(), text: text.to_owned() };
    message(&format!("ward/{bed}/note"), &note)
}

fn event(bed: &str, time_ns: i64, text: &str) -> Message {
    let (kind, channel) = ("gap".to_owned(), "p_v".to_owned());
    let event = Event { header: header(time_ns), kind, channel, text: text.to_owned() };
    message(&format!("ward/{bed}/event"), &event)
}

/// Ten seconds of `bed`; they arrive as fast as they happen.
fn fill(ward: &mut Ward, bed: &str) {
    for i in 0..500 {
        let (t, now) = (i * 20 * MS, Duration::from_millis(20 * i.unsigned_abs()));
        for message in [samples(bed, "ABP", t), state(bed, t, 0.0), truth(bed, t)] {
            ward.apply(&message, now);
        }
        if i % 50 == 0 {
            ward.apply(&parameters(bed, t), now);
            ward.apply(&beat(bed, t), now);
            ward.apply(&status(bed, t), now);
        }
    }
    ward.apply(&event(bed, 9000 * MS, "nothing heard for 3 s"), 9 * SECOND);
}

fn filled() -> Ward {
    let mut ward = Ward::new("ward", MEMORY);
    fill(&mut ward, "bed1");
    ward
}

fn screen(ward: &Ward, ui: &Ui, now: Duration, (width, height): (u16, u16)) -> String {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| view::draw(frame, ward, ui, now)).unwrap();
    let cells = terminal.backend().buffer().content();
    let rows = cells.chunks(usize::from(width)).map(|row| row.iter().map(|c| c.symbol()).collect::<String>());
    rows.collect::<Vec<_>>().join("\n")
}

fn assert_shows(screen: &str, expected: &[&str]) {
    for text in expected {
        assert!(screen.contains(text), "`{text}` is missing from\n{screen}");
    }
}

fn press(ui: &mut Ui, ward: &Ward, code: KeyCode) -> Next {
    ui.press(KeyEvent::new(code, KeyModifiers::NONE), ward, 10 * SECOND)
}

#[test]
fn names_numbers_truth_health_events_and_keys_are_on_the_screen() {
    let (ward, ui) = (filled(), Ui::new(None));
    for size in SIZES {
        let screen = screen(&ward, &ui, 10 * SECOND, size);
        assert_shows(&screen, &["bed1", "LIVE", "HR 75/min", "age 0.0 s", "t", "10.0 s"]);
        assert_shows(&screen, &["p_l", "p_a", "p_v", "p_r", "p_pa", "p_pv", "q_lo", "v_pv"]);
        assert_shows(&screen, &["70.0 ±4.0", "◆71.0", "120/70", "observed", "inferred", "no signal", "5–95"]);
        let narrow = ["r_pv", ".0812", "[.0771,.0853]", "◆.0799", "1.61", "[1.52,1.77]"];
        let wide = ["r_pv", "0.0812", "[0.0771, 0.0853]", "◆0.0799", "1.61", "[1.52, 1.77]"];
        assert_shows(&screen, if size.0 < 100 { &narrow } else { &wide });
        assert_shows(
            &screen,
            &["98/100", "p50 0.81", "p99 2.22", "max 9.43", "solve 0.61", "queue 5", "without data 7"],
        );
        assert_shows(&screen, &["not converged 3!", "rms 1.04", "rms 2.50!", "silent"]);
        assert_shows(&screen, &["gap", "nothing heard for 3 s"]);
        for keys in ["? help", "q quit", "Tab", "b beds", "p ", "←→ ", "+- ", "f ", "u ", "a ack", "n note"] {
            let (key, meaning) = keys.split_once(' ').unwrap_or((keys, ""));
            let last = screen.lines().last().unwrap();
            let (short, long) = (format!("{key} {meaning}"), format!("{key}  {meaning}"));
            assert!(last.contains(&short) || last.contains(&long), "`{keys}` is missing from\n{last}");
        }
        assert!(screen.contains(|c| ('\u{2801}'..='\u{28ff}').contains(&c)), "no waveform in\n{screen}");
        assert!(!screen.contains("STALE"), "{screen}");
    }
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["late 42"]);
}

#[test]
fn the_last_beat_is_on_the_screen_and_cardiac_output_in_the_header_and_the_list() {
    let (ward, mut ui) = (filled(), Ui::new(None));
    for size in SIZES {
        assert_shows(screen(&ward, &ui, 10 * SECOND, size).lines().next().unwrap(), &["CO 5.12±0.12"]);
    }
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (200, 60)), &["last beat", "CO   5.12 ±0.12", "PVR 0.081 ±0.004"]);
    press(&mut ui, &ward, KeyCode::Char('b'));
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["CO L/min", "5.12 ±0.12"]);
}

#[test]
fn what_the_data_do_not_say_is_grey_and_marked() {
    let mut ward = Ward::new("ward", MEMORY);
    ward.apply(&state("bed1", 0, 0.0), SECOND);
    let mut estimate: ParameterEstimate = wire::decode(&parameters("bed1", 0).payload, Encoding::Bincode).unwrap();
    *estimate.values.last_mut().unwrap() = 0.0;
    ward.apply(&message("ward/bed1/estimate/parameters", &estimate), SECOND);
    for size in SIZES {
        let shown = screen(&ward, &Ui::new(None), SECOND, size);
        assert_shows(&shown, &["1.61?"]);
        assert!(shown.contains("0812 ") && !shown.contains("0812?"), "{shown}");
    }
    assert_shows(&screen(&ward, &Ui::new(None), SECOND, (120, 40)), &["not identifiable"]);
}

#[test]
fn a_channel_that_is_set_aside_and_one_that_the_model_does_not_fit_are_marked() {
    let mut ward = filled();
    let mut health: Status = wire::decode(&status("bed1", 9500 * MS).payload, Encoding::Bincode).unwrap();
    health.channels[0].artefact = "flush".to_owned();
    ward.apply(&message("ward/bed1/status", &health), 10 * SECOND);
    assert_eq!(ward.beds["bed1"].origin(1), Origin::Silent, "its samples are not what is shown");
    for size in SIZES {
        let shown = screen(&ward, &Ui::new(None), 10 * SECOND, size);
        assert_shows(&shown, &["flush"]);
        assert!(!shown.contains("misfit!"), "{shown}");
    }
    health.channels[0].artefact.clear();
    health.channels[0].misfit = true;
    ward.apply(&message("ward/bed1/status", &health), 10 * SECOND);
    assert_shows(&screen(&ward, &Ui::new(None), 10 * SECOND, (120, 40)), &["p_a  live", "misfit!"]);
}

#[test]
fn a_heart_that_stands_still_has_no_rate_and_no_output() {
    let mut ward = filled();
    let estimate = ParameterEstimate {
        header: header(0),
        members: 100,
        names: vec!["heart_rate".to_owned()],
        values: vec![75.0, 0.5, 74.0, 76.0, 0.9, 0.1, 1.0],
    };
    ward.apply(&message("ward/bed1/estimate/parameters", &estimate), 10 * SECOND);
    let shown = |ward: &Ward| screen(ward, &Ui::new(None), 14 * SECOND, (120, 40));
    assert_shows(&shown(&ward), &["HR 75/min", "CO 5.12"]);
    assert!(!shown(&ward).contains("r_pv"), "what is estimated no more is known no more");
    // The last beat ended at 9.8 s.
    ward.apply(&state("bed1", 13_900 * MS, 0.0), 14 * SECOND);
    let still = shown(&ward);
    assert!(!still.contains("HR 75") && !still.contains("CO 5.12"), "{still}");
}

#[test]
fn beats_of_another_run_are_not_of_this_one() {
    let mut ward = filled();
    assert_eq!(ward.beds["bed1"].beat_trends.len(), BEAT.len());
    ward.apply(&state("bed1", 1000 * MS, 0.0), 10 * SECOND);
    let bed = &ward.beds["bed1"];
    assert!(bed.beat().is_empty() && bed.beat_trends.is_empty() && !bed.has_beats());
    assert!(bed.parameters.iter().all(|parameter| parameter.trend.len() == 0));
}

#[test]
fn silence_is_called_stale_after_two_seconds() {
    let (ward, ui) = (filled(), Ui::new(None));
    for size in SIZES {
        assert!(!screen(&ward, &ui, Duration::from_millis(11_900), size).contains("STALE"));
        let later = screen(&ward, &ui, Duration::from_millis(12_000), size);
        assert_shows(&later, &["STALE for 2.0 s"]);
        assert!(!later.contains("LIVE"), "{later}");
    }
}

#[test]
fn pressures_without_estimates_and_estimates_without_pressures_are_told_apart() {
    let mut ward = filled();
    ward.apply(&samples("bed1", "p_a", 15_000 * MS), 15 * SECOND);
    let shown = |ward: &Ward| screen(ward, &Ui::new(None), 15 * SECOND, (80, 24));
    assert_shows(&shown(&ward), &["NO ESTIMATE"]);
    ward.apply(&state("bed1", 15_000 * MS, 5.0), 15 * SECOND);
    assert_shows(&shown(&ward), &["FORECAST no data 5.0 s"]);
}

#[test]
fn last_values_are_shown_but_are_no_sign_of_life() {
    let mut ward = Ward::new("ward", MEMORY);
    ward.apply_last_value(&state("bed1", 0, 0.0));
    assert_eq!(ward.beds["bed1"].liveness(SECOND), Liveness::NotHeard);
    assert_shows(&screen(&ward, &Ui::new(None), SECOND, (80, 24)), &["STALE last values", "70.0 ±4.0"]);
    ward.apply(&state("bed1", MS, 0.0), SECOND);
    assert_eq!(ward.beds["bed1"].liveness(SECOND), Liveness::Live { since_data_s: 0.0 });
}

#[test]
fn an_estimate_that_lags_is_compared_with_the_truth_of_its_time_and_called_late() {
    let mut ward = Ward::new("ward", MEMORY);
    for i in 0..100 {
        let (t, now) = (i * 20 * MS, Duration::from_millis(20 * i.unsigned_abs()));
        ward.apply(&truth("bed1", t), now);
        ward.apply(&samples("bed1", "p_a", t), now);
    }
    ward.apply(&state("bed1", 190 * MS, 0.0), 2 * SECOND);
    let bed = &ward.beds["bed1"];
    let between = 0.5 * (pulse(180 * MS) + pulse(200 * MS)) + 1.0;
    assert!((bed.truth_now(0) - between).abs() < 1e-4, "{}", bed.truth_now(0));
    assert_shows(&screen(&ward, &Ui::new(None), 2 * SECOND, (80, 24)), &["age 1.8 s!"]);
    ward.apply(&state("bed1", 5000 * MS, 0.0), 2 * SECOND);
    assert!(ward.beds["bed1"].truth_now(0).is_nan());
}

#[test]
fn an_event_that_arrives_twice_is_shown_once() {
    let mut ward = Ward::new("ward", MEMORY);
    ward.apply_last_value(&event("bed1", 0, "again"));
    ward.apply(&event("bed1", 0, "again"), SECOND);
    assert_eq!(ward.beds["bed1"].events.len(), 1);
}

#[test]
fn garbage_is_counted_and_makes_no_bed() {
    let mut ward = Ward::new("ward", MEMORY);
    let topics = ["estimate/state", "estimate/parameters", "estimate/beat", "status", "event", "truth", "pressure/p_a"];
    for topic in topics {
        for payload in [vec![], vec![1], vec![1, 0, 255], vec![0xff; 300], vec![9, 0, 0, 0]] {
            let key = format!("ward/noise/{topic}");
            ward.apply(&Message { key, encoding: Encoding::Bincode, payload }, SECOND);
        }
    }
    assert_eq!((ward.unreadable, ward.beds.len()), (35, 0));
    assert_shows(&screen(&ward, &Ui::new(None), SECOND, (80, 24)), &["35 messages, 35 of them unreadable", "WAITING"]);

    let elsewhere =
        ["ward", "ward/bed1", "wardrobe/bed1/status", "ward/bed1/estimate/state/json", "ward/b/pressure/ICP"];
    for key in elsewhere {
        ward.apply(&Message { key: key.to_owned(), encoding: Encoding::Json, payload: vec![1] }, SECOND);
    }
    assert_eq!((ward.messages, ward.beds.len()), (35, 0));
}

#[test]
fn tables_whose_lengths_disagree_are_unreadable() {
    let mut ward = Ward::new("ward", MEMORY);
    let header = header(0);
    let state = StateEstimate {
        header: header.clone(),
        members: 1,
        times_ns: vec![0],
        since_data_s: vec![],
        names: names(),
        values: vec![0.0; 18 * STATE_STATISTICS.len()],
    };
    ward.apply(&message("ward/bed1/estimate/state", &state), SECOND);
    let parameters = ParameterEstimate { header, members: 1, names: vec!["r_pv".to_owned()], values: vec![1.0] };
    ward.apply(&message("ward/bed1/estimate/parameters", &parameters), SECOND);
    let truth = Truth { schema: SCHEMA, time_ns: 0, names: vec![], values: vec![1.0] };
    ward.apply(&message("ward/bed1/truth", &truth), SECOND);
    assert_eq!((ward.unreadable, ward.beds.len()), (3, 0));
}

#[test]
fn numbers_that_are_none_are_drawn_as_none() {
    let mut ward = Ward::new("ward", MEMORY);
    for (i, value) in (0..).zip([f64::NAN, f64::INFINITY, -1e300, 1e300]) {
        let state = StateEstimate {
            header: header(0),
            members: 1,
            times_ns: vec![i64::MAX, i64::MIN, 0, i],
            since_data_s: vec![value; 4],
            names: names(),
            values: vec![value; 4 * 18 * STATE_STATISTICS.len()],
        };
        ward.apply(&message("ward/bed1/estimate/state", &state), SECOND);
        let values = vec![value; PARAMETER_STATISTICS.len()];
        let parameters = ParameterEstimate { header: header(0), members: 1, names: vec!["r_pv".to_owned()], values };
        ward.apply(&message("ward/bed1/estimate/parameters", &parameters), SECOND);
        for (width, height) in SIZES {
            screen(&ward, &Ui::new(None), SECOND, (width, height));
        }
    }
}

#[test]
fn any_size_is_drawn_without_fault() {
    let mut ui = Ui::new(None);
    let mut ward = filled();
    let states = ["active", "latched", "pending", "normal"];
    let all = states.into_iter().flat_map(|state| ["high", "medium", "low"].map(|p| alarm(state, p, state, false)));
    ward.apply(&alarms("bed1", all.collect()), 10 * SECOND);
    for (list, sources, help) in [(false, false, false), (true, false, false), (false, true, true)] {
        (ui.is_list, ui.shows_sources, ui.shows_help) = (list, sources, help);
        for width in (1..210).step_by(3) {
            for height in (1..70).step_by(2) {
                screen(&ward, &ui, 10 * SECOND, (width, height));
            }
        }
    }
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (39, 24)), &["too small"]);
}

#[test]
fn a_million_messages_leave_a_bounded_past() {
    let mut ward = Ward::new("ward", MEMORY);
    let (state, samples, truth) = (state("bed1", 0, 0.0), samples("bed1", "p_a", 0), truth("bed1", 0));
    // Times are patched into ready bytes: encoding a million states is not the subject.
    let retime = |message: &Message, at: usize, t: i64| {
        let mut message = message.clone();
        message.payload[at..at + 8].copy_from_slice(&t.to_le_bytes());
        message
    };
    // Behind the header (34 bytes), `members` (4) and the length of `times_ns` (8); see the layout in `wire`.
    let (state_time, block_start, truth_time) = (46, 14, 2);
    for i in 0..333_334_i64 {
        let now = Duration::from_millis(10 * i.unsigned_abs());
        let t = i * 10 * MS;
        ward.apply(&retime(&state, state_time, t), now);
        ward.apply(&retime(&samples, block_start, t), now);
        ward.apply(&retime(&truth, truth_time, t), now);
    }
    assert_eq!((ward.messages, ward.unreadable), (1_000_002, 0));
    let bed = &ward.beds["bed1"];
    for rows in [bed.history.len(), bed.samples[1].len(), bed.truth.len()] {
        assert!((6000..=7500).contains(&rows), "{rows} rows");
    }
    let newest_ns = bed.history.newest_ns().unwrap();
    assert_eq!(newest_ns, 3_333_330 * MS);
    assert!(bed.history.since(i64::MIN).all(|(t, _)| t >= newest_ns - 60_000 * MS));
}

#[test]
fn beds_names_and_events_are_limited() {
    let mut ward = Ward::new("ward", MEMORY);
    for i in 0..MAX_BEDS + 5 {
        ward.apply(&state(&format!("bed{i:04}"), 0, 0.0), SECOND);
    }
    assert_eq!((ward.beds.len(), ward.refused), (MAX_BEDS, 5));
    for i in 0..300 {
        let names = (0..300).map(|n| format!("new{i}.{n}")).collect();
        let values = vec![1.0; 300 * PARAMETER_STATISTICS.len()];
        let parameters = ParameterEstimate { header: header(i), members: 1, names, values };
        ward.apply(&message("ward/bed0000/estimate/parameters", &parameters), SECOND);
        ward.apply(&event("bed0000", i, &"\u{1b}[2J".repeat(1000)), SECOND);
    }
    let bed = &ward.beds["bed0000"];
    assert_eq!((bed.parameters.len(), bed.events.len()), (64, 200));
    assert!(bed.events.iter().all(|e| e.text.chars().count() <= 200 && !e.text.contains('\u{1b}')));
}

#[test]
fn time_that_jumps_back_begins_a_new_picture() {
    let mut ward = filled();
    ward.apply(&state("bed1", 100 * MS, 0.0), 10 * SECOND);
    let bed = &ward.beds["bed1"];
    assert_eq!((bed.history.len(), bed.newest_ns(10 * SECOND)), (1, Some(100 * MS)));
}

#[test]
fn a_channel_is_found_by_its_label_and_by_its_status() {
    let ward = filled();
    let origins: Vec<Origin> = (0..18).map(|q| ward.beds["bed1"].origin(q)).collect();
    assert_eq!(origins[..3], [Origin::Inferred, Origin::Observed, Origin::Silent]);
    assert!(origins[3..].iter().all(|o| *o == Origin::Inferred));
}

#[test]
fn keys_choose_the_bed_the_span_and_the_quantities() {
    let mut ward = filled();
    ward.apply(&state("bed2", 0, 0.0), 10 * SECOND);
    ward.apply(&state("bed3", 0, 0.0), 10 * SECOND);
    let mut ui = Ui::new(Some("bed2"));
    let mut walk = Vec::new();
    for code in [KeyCode::Tab, KeyCode::Tab, KeyCode::Down, KeyCode::BackTab, KeyCode::Up] {
        press(&mut ui, &ward, code);
        walk.push(ui.bed_name(&ward).unwrap().to_owned());
    }
    assert_eq!(walk, ["bed3", "bed1", "bed2", "bed1", "bed3"]);
    press(&mut ui, &ward, KeyCode::Char('+'));
    assert_eq!(ui.span_s(), 10);
    for _ in 0..20 {
        press(&mut ui, &ward, KeyCode::Char('-'));
    }
    assert_eq!(ui.span_s(), 2);
    for expected in ["flows mL/s", "volumes mL", "pressures mmHg"] {
        press(&mut ui, &ward, KeyCode::Char('f'));
        assert_shows(screen(&ward, &ui, 10 * SECOND, (80, 24)).lines().nth(2).unwrap(), &[expected]);
    }
}

#[test]
fn a_bed_that_was_asked_for_is_waited_for() {
    let (ward, ui) = (filled(), Ui::new(Some("bed7")));
    assert_shows(&screen(&ward, &ui, SECOND, (80, 24)), &["bed7", "WAITING", "beds heard: bed1"]);
}
