//! What is said to the daemon from the keyboard, and help.

use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};

use super::super::super::errand::{self, Errand, Outcome};
use super::*;
use crate::edge::bus::{Bus, MemoryBus};
use crate::edge::wire::Acknowledge;
use crate::estimate::time::EventTime;

fn typed(ui: &mut Ui, ward: &Ward, text: &str) -> Next {
    let all = text.chars().map(|c| press(ui, ward, KeyCode::Char(c)));
    all.last().unwrap_or(Next::Continue)
}

fn last_line(ward: &Ward, ui: &Ui) -> String {
    screen(ward, ui, 10 * SECOND, (80, 24)).lines().last().unwrap().to_owned()
}

#[test]
fn an_alarm_is_acknowledged_by_two_keys() {
    let mut ward = filled();
    let all = vec![
        alarm("quiet", "high", "normal", false),
        alarm("minor", "low", "latched", false),
        alarm("major", "high", "active", false),
        alarm("seen", "high", "active", true),
    ];
    ward.apply(&alarms("bed1", all), 10 * SECOND);
    let errand = |alarms: &[&str]| {
        let alarms = alarms.iter().map(|alarm| (*alarm).to_owned()).collect();
        Next::Tell(Errand::Acknowledge { bed: "bed1".to_owned(), alarms })
    };
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('a'));
    assert_shows(&last_line(&ward, &ui), &["acknowledge in bed1 1/3", "major", "Enter sends, Esc"]);
    assert_eq!(press(&mut ui, &ward, KeyCode::Enter), errand(&["major"]));
    assert_shows(&last_line(&ward, &ui), &["acknowledging in bed1: major"]);
    press(&mut ui, &ward, KeyCode::Char('a'));
    press(&mut ui, &ward, KeyCode::Down);
    assert_eq!(press(&mut ui, &ward, KeyCode::Enter), errand(&["minor"]));
    press(&mut ui, &ward, KeyCode::Char('a'));
    press(&mut ui, &ward, KeyCode::Char('A'));
    assert_shows(&last_line(&ward, &ui), &["all 2"]);
    assert_eq!(press(&mut ui, &ward, KeyCode::Enter), errand(&["major", "minor"]));
    press(&mut ui, &ward, KeyCode::Char('a'));
    assert_eq!(press(&mut ui, &ward, KeyCode::Esc), Next::Continue);
    assert_shows(&last_line(&ward, &ui), &["? help"]);
}

#[test]
fn nothing_that_was_seen_is_asked_for_again() {
    let mut ward = filled();
    ward.apply(&alarms("bed1", vec![alarm("a", "high", "active", true)]), 10 * SECOND);
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('a'));
    assert!(ui.prompt.is_none());
    assert_shows(&last_line(&ward, &ui), &["no alarm of bed1 waits to be acknowledged"]);
}

#[test]
fn a_note_is_about_what_was_on_the_screen_when_it_was_begun() {
    let mut ward = filled();
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('n'));
    // The keys of the screen are letters now.
    assert_eq!(typed(&mut ui, &ward, "q bolus"), Next::Continue);
    ward.apply(&state("bed1", 12_000 * MS, 0.0), 12 * SECOND);
    assert_shows(&last_line(&ward, &ui), &["note on bed1 at 10.0 s", "q bolus▏", "Enter sends, Esc"]);
    let note = |ns: i64, text: &str| {
        Next::Tell(Errand::Note { bed: "bed1".to_owned(), time: Some(EventTime(ns)), text: text.to_owned() })
    };
    assert_eq!(press(&mut ui, &ward, KeyCode::Enter), note(9980 * MS, "q bolus"));
    press(&mut ui, &ward, KeyCode::Left);
    press(&mut ui, &ward, KeyCode::Left);
    press(&mut ui, &ward, KeyCode::Char('n'));
    typed(&mut ui, &ward, "then");
    assert_eq!(press(&mut ui, &ward, KeyCode::Enter), note(9000 * MS, "then"));
    press(&mut ui, &ward, KeyCode::Char('n'));
    typed(&mut ui, &ward, "nothing");
    assert_eq!(press(&mut ui, &ward, KeyCode::Esc), Next::Continue);
    assert!(ui.prompt.is_none());
}

#[test]
fn a_bed_of_which_nothing_is_known_takes_no_note() {
    let mut ward = Ward::new("ward", MEMORY);
    ward.apply(&status("bed1", 0), SECOND);
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('n'));
    assert!(ui.prompt.is_none());
    assert_shows(&last_line(&ward, &ui), &["nothing is known of bed1 yet"]);
}

#[test]
fn what_is_said_goes_away_by_itself_or_with_the_next_key() {
    let (ward, mut ui) = (filled(), Ui::new(None));
    let outcome = Outcome { text: "sent".to_owned(), is_failure: false };
    ui.say(outcome.clone(), 10 * SECOND);
    assert_eq!((ui.said(19 * SECOND), ui.said(20 * SECOND)), (Some(&outcome), None));
    press(&mut ui, &ward, KeyCode::Char('f'));
    assert_eq!(ui.said(10 * SECOND), None);
}

#[test]
fn help_names_every_key_and_any_key_closes_it() {
    let (ward, mut ui) = (filled(), Ui::new(None));
    press(&mut ui, &ward, KeyCode::Char('?'));
    for size in SIZES {
        let shown = screen(&ward, &ui, 10 * SECOND, size);
        assert_shows(&shown, &["any key closes it", "acknowledge an alarm", "write a note", "order of the list"]);
        assert_shows(&shown, &["back and forth in time", "where the uncertainty comes from", "▲!!! ◆!! ●!"]);
    }
    assert_eq!(press(&mut ui, &ward, KeyCode::Char('q')), Next::Continue);
    assert!(!screen(&ward, &ui, 10 * SECOND, (80, 24)).contains("any key closes it"));
}

/// A daemon that answers for `bed1` and clears an alarm as soon as it is acknowledged.
fn daemon(bus: &MemoryBus) -> [crate::edge::bus::Subscription; 2] {
    let raised = Arc::new(Mutex::new(true));
    let raised_still = Arc::clone(&raised);
    let answer = bus.offer_last_values(
        "ward/bed1/**",
        Arc::new(move |pattern| match pattern {
            "ward/bed1/alarm" => {
                let state = if *raised_still.lock().unwrap() { "latched" } else { "normal" };
                vec![alarms("bed1", vec![alarm("a", "high", state, false)])]
            }
            "ward/bed1/estimate/state" => vec![state("bed1", 4000 * MS, 0.0)],
            _ => Vec::new(),
        }),
    );
    let acknowledged = bus.subscribe(
        "ward/bed1/acknowledge",
        Arc::new(move |message| {
            let seen: Acknowledge = wire::decode(&message.payload, message.encoding).unwrap();
            assert_eq!((seen.alarm.as_str(), seen.author.as_str()), ("a", "Dr. Weber"));
            *raised.lock().unwrap() = false;
        }),
    );
    [answer.unwrap(), acknowledged.unwrap()]
}

#[test]
fn errands_are_run_in_order_and_what_became_of_them_is_said() {
    let bus = MemoryBus::new();
    let _daemon = daemon(&bus);
    let notes = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&notes);
    let handler = Arc::new(move |message: Message| heard.lock().unwrap().push(message));
    let _listens = bus.subscribe("ward/*/note", handler).unwrap();
    let (sender, errands) = sync_channel(errand::QUEUE);
    let (outcome_sender, outcomes) = sync_channel(errand::QUEUE);
    let acknowledge = |bed: &str| Errand::Acknowledge { bed: bed.to_owned(), alarms: vec!["a".to_owned()] };
    let note = Errand::Note { bed: "bed1".to_owned(), time: Some(EventTime(3000 * MS)), text: "bolus".to_owned() };
    for errand in [acknowledge("bed1"), acknowledge("bed1"), note, acknowledge("bed9")] {
        sender.send(errand).unwrap();
    }
    drop(sender);
    errand::serve(&bus, "ward", "Dr. Weber", &errands, &outcome_sender);
    drop(outcome_sender);
    let outcomes: Vec<Outcome> = outcomes.iter().collect();
    let texts: Vec<&str> = outcomes.iter().map(|outcome| outcome.text.as_str()).collect();
    assert_eq!(
        texts[..3],
        [
            "sent and confirmed by the daemon: a of bed1 acknowledged",
            "nothing sent: no alarm of bed1 waits any more",
            "sent: note about bed1 at 3.0 s",
        ]
    );
    assert!(texts[3].starts_with("failed: bed: found \"bed9\""), "{}", texts[3]);
    assert_eq!(outcomes.iter().map(|o| o.is_failure).collect::<Vec<_>>(), [false, false, false, true]);
    let sent = notes.lock().unwrap();
    let said: Note = wire::decode(&sent[0].payload, sent[0].encoding).unwrap();
    assert_eq!((sent.len(), said.time_ns, said.text.as_str()), (1, 3000 * MS, "bolus"));
}
