//! A display that stands still, and the past that is gone through then.

use super::*;

#[test]
fn pause_keeps_the_picture_while_the_ward_goes_on() {
    let mut ward = filled();
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('p'));
    let before = screen(&ward, &ui, 10 * SECOND, (120, 40));
    for i in 0..100 {
        ward.apply(&state("bed1", (10_000 + 20 * i) * MS, 0.0), 12 * SECOND);
    }
    let after = screen(&ward, &ui, 10 * SECOND, (120, 40));
    assert_eq!(before, after);
    assert_shows(&after, &["PAUSED", "l live"]);
    press(&mut ui, &ward, KeyCode::Char('p'));
    assert_shows(&screen(&ward, &ui, 12 * SECOND, (120, 40)), &["LIVE", "12.0 s"]);
}

/// What the readout of the arterial pressure says at a time.
fn value(time_ns: i64) -> String {
    format!("{:.1} ±4.0", pulse(time_ns))
}

#[test]
fn the_arrows_go_through_the_past_and_everything_is_as_it_was() {
    let mut ward = filled();
    ward.apply(&note("bed1", 8700 * MS, "later"), 9 * SECOND);
    let mut ui = Ui::new(None);
    // A quarter of six seconds before 9.98 s.
    press(&mut ui, &ward, KeyCode::Left);
    let past = screen(&ward, &ui, 12 * SECOND, (120, 40));
    assert_shows(&past, &["PAST 3.5 s ago", "8.5 s╵", "event time 8.5 s", &value(8480 * MS)]);
    assert!(!past.contains("later") && !past.contains("now╵"), "{past}");
    press(&mut ui, &ward, KeyCode::Left);
    assert_shows(&screen(&ward, &ui, 12 * SECOND, (120, 40)), &["PAST 5.0 s ago", "event time 7.0 s"]);
    press(&mut ui, &ward, KeyCode::Right);
    assert_eq!(screen(&ward, &ui, 12 * SECOND, (120, 40)), past);
    press(&mut ui, &ward, KeyCode::Right);
    press(&mut ui, &ward, KeyCode::Right);
    assert_shows(&screen(&ward, &ui, 12 * SECOND, (120, 40)), &["PAUSED 2.0 s ago", "later"]);
    for code in [KeyCode::Char('l'), KeyCode::End, KeyCode::Char('p')] {
        press(&mut ui, &ward, KeyCode::Left);
        press(&mut ui, &ward, code);
        assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["LIVE", "now╵"]);
    }
}

#[test]
fn the_past_has_an_end_and_it_is_said() {
    let ward = filled();
    let mut ui = Ui::new(None);
    for _ in 0..20 {
        press(&mut ui, &ward, KeyCode::Left);
    }
    let oldest = screen(&ward, &ui, 10 * SECOND, (120, 40));
    assert_shows(&oldest, &["event time 1.5 s", "this is the oldest that is kept"]);
}

#[test]
fn what_has_no_past_is_not_made_up() {
    let ward = filled();
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('u'));
    press(&mut ui, &ward, KeyCode::Left);
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["kept for the newest estimate only"]);
}

#[test]
fn beats_and_parameters_of_the_past_are_those_of_then() {
    let mut ward = filled();
    let mut later: BeatEstimate = wire::decode(&beat("bed1", 9050 * MS).payload, Encoding::Bincode).unwrap();
    later.values[0] = 3.21;
    ward.apply(&message("ward/bed1/estimate/beat", &later), 10 * SECOND);
    let mut newer: ParameterEstimate = wire::decode(&parameters("bed1", 9950 * MS).payload, Encoding::Bincode).unwrap();
    newer.values[0] = 0.0999;
    ward.apply(&message("ward/bed1/estimate/parameters", &newer), 10 * SECOND);
    let mut ui = Ui::new(None);
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["CO 3.21", "r_pv 0.0999"]);
    press(&mut ui, &ward, KeyCode::Left);
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (120, 40)), &["CO 5.12", "r_pv 0.0812"]);
}
