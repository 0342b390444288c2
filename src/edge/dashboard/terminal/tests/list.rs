//! The ward: what its rows say, their order, and the way through them.

use super::*;

fn named(ward: &mut Ward, beds: &[&str]) {
    for bed in beds {
        ward.apply(&state(bed, 0, 0.0), 10 * SECOND);
    }
}

/// Names of the beds in the order in which they stand in the list.
fn order(shown: &str, beds: &[&str]) -> Vec<String> {
    let rows = shown.lines().skip(4).map(|row| row.trim_start_matches(['▶', ' ']));
    let first = rows.filter_map(|row| row.split_whitespace().next()).filter(|word| beds.contains(word));
    first.take(beds.len()).map(str::to_owned).collect()
}

#[test]
fn the_list_shows_every_bed_and_escape_leaves_the_list_first() {
    let mut ward = filled();
    ward.apply(&state("bed2", 0, 0.0), 7 * SECOND);
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('b'));
    for size in SIZES {
        let list = screen(&ward, &ui, 10 * SECOND, size);
        assert_shows(&list, &["2 beds under ward", "▶ bed1", "bed2", "LIVE", "STALE 3s", "5.12 ±0.12", "1 not live"]);
    }
    assert_eq!(press(&mut ui, &ward, KeyCode::Esc), Next::Continue);
    assert!(!ui.is_list);
    assert_eq!(press(&mut ui, &ward, KeyCode::Esc), Next::Quit);
    assert_eq!(press(&mut ui, &ward, KeyCode::Char('q')), Next::Quit);
    let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
    assert_eq!(ui.press(control_c, &ward, SECOND), Next::Quit);
}

#[test]
fn a_row_says_what_the_screen_has_room_for_and_why_the_quality_is_what_it_is() {
    let mut ward = filled();
    let both = vec![alarm("pulmonary", "high", "active", false), alarm("second", "low", "active", false)];
    ward.apply(&alarms("bed1", both), 10 * SECOND);
    let mut ui = Ui::new(None);
    ui.is_list = true;
    for size in SIZES {
        let list = screen(&ward, &ui, 10 * SECOND, size);
        let row = list.lines().find(|row| row.starts_with('▶')).unwrap();
        assert_shows(row, &["bed1", "▲!!!", "LIVE", "degraded", "75", "5.12 ±0.12"]);
        assert_shows(&list, &["because p_v silent, 98 of 100 members", "▲ 1 high", "0 not live"]);
        assert_shows(&list, &["what is the matter with pulmonary", "nothing heard for 3 s"]);
        match size.0 {
            80 => assert_shows(row, &["120/70 (88)", "25/10 (15)"]),
            120 => assert_shows(row, &["120/70 (88)", "25/10 (15)", "0.93 ±0.04", "0.081 ±0.004"]),
            _ => assert_shows(
                row,
                &[
                    "120±2/70±.4 (88±1)",
                    "25±1/10±1 (15±1)",
                    "0.93 ±0.04",
                    "0.081 ±0.004",
                    "▲!!! pulmonary +1",
                    "2.2",
                    "gap p_v nothing heard",
                ],
            ),
        }
    }
}

#[test]
fn beds_stand_in_order_of_name_or_the_most_urgent_alarm_first() {
    let beds = ["icu-1", "icu-2", "icu-10", "icu-11"];
    let mut ward = Ward::new("ward", MEMORY);
    named(&mut ward, &beds);
    ward.apply(&alarms("icu-2", vec![alarm("a", "high", "active", true)]), 10 * SECOND);
    ward.apply(&alarms("icu-10", vec![alarm("a", "high", "active", false)]), 10 * SECOND);
    ward.apply(&alarms("icu-11", vec![alarm("a", "medium", "active", false)]), 10 * SECOND);
    let mut ui = Ui::new(None);
    ui.is_list = true;
    let list = |ui: &Ui| screen(&ward, ui, 10 * SECOND, (120, 40));
    assert_eq!(order(&list(&ui), &beds), beds);
    press(&mut ui, &ward, KeyCode::Char('o'));
    assert_eq!(order(&list(&ui), &beds), ["icu-10", "icu-2", "icu-11", "icu-1"]);
    assert_shows(&list(&ui), &["alarms first", "▲!!! HIGH  icu-10: a"]);
    // The keys go the same way.
    press(&mut ui, &ward, KeyCode::Home);
    press(&mut ui, &ward, KeyCode::Down);
    assert_eq!(ui.bed_name(&ward), Some("icu-2"));
}

#[test]
fn a_filter_leaves_the_beds_that_it_names_and_escape_takes_it_away() {
    let mut ward = Ward::new("ward", MEMORY);
    let beds = ["icu-1", "icu-2", "or-1"];
    named(&mut ward, &beds);
    let mut ui = Ui::new(None);
    for code in [KeyCode::Char('/'), KeyCode::Char('O'), KeyCode::Char('R')] {
        press(&mut ui, &ward, code);
    }
    let list = |ui: &Ui| screen(&ward, ui, 10 * SECOND, (80, 24));
    assert_shows(&list(&ui), &["beds with", "OR▏", "1 with \"OR\""]);
    assert_eq!((order(&list(&ui), &beds), ui.bed_name(&ward)), (vec!["or-1".to_owned()], Some("or-1")));
    press(&mut ui, &ward, KeyCode::Char('q'));
    assert_shows(&list(&ui), &["no bed with \"ORq\" in its name"]);
    press(&mut ui, &ward, KeyCode::Backspace);
    press(&mut ui, &ward, KeyCode::Enter);
    assert_shows(&list(&ui), &["? help", "1 with \"OR\""]);
    press(&mut ui, &ward, KeyCode::Char('/'));
    press(&mut ui, &ward, KeyCode::Esc);
    assert_eq!(order(&list(&ui), &beds), beds);
    assert!(ui.is_list);
}

#[test]
fn the_chosen_bed_is_in_view_wherever_it_stands() {
    let mut ward = Ward::new("ward", MEMORY);
    for i in 0..100 {
        ward.apply(&state(&format!("bed{i}"), 0, 0.0), 10 * SECOND);
    }
    let mut ui = Ui::new(None);
    ui.is_list = true;
    for (code, expected) in [
        (KeyCode::End, "▶ bed99"),
        (KeyCode::PageUp, "▶ bed89"),
        (KeyCode::Home, "▶ bed0 "),
        (KeyCode::PageDown, "▶ bed10 "),
        (KeyCode::Up, "▶ bed9 "),
    ] {
        press(&mut ui, &ward, code);
        for size in SIZES {
            assert_shows(&screen(&ward, &ui, 10 * SECOND, size), &[expected]);
        }
    }
}
