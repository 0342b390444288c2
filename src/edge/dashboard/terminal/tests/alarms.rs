//! Alarms on the screen: most urgent first, told by sign and word, never hidden.

use super::*;

fn with(all: Vec<Alarm>) -> Ward {
    let mut ward = filled();
    ward.apply(&alarms("bed1", all), 10 * SECOND);
    ward
}

/// The line below the header.
fn line(screen: &str) -> &str {
    screen.lines().nth(1).unwrap()
}

#[test]
fn the_most_urgent_alarm_is_below_the_header_and_all_are_in_the_panel() {
    let ward = with(vec![
        alarm("quiet", "high", "normal", false),
        alarm("slow", "low", "active", false),
        alarm("coming", "high", "pending", false),
        alarm("seen", "high", "active", true),
        alarm("over", "high", "latched", false),
    ]);
    for size in SIZES {
        let shown = screen(&ward, &Ui::new(None), 10 * SECOND, size);
        assert_shows(line(&shown), &["▲!!! HIGH", "over", "was on 3.0 s", "+2 more"]);
        let at = |text: &str| shown.find(text).unwrap_or_else(|| panic!("`{text}` is missing from\n{shown}"));
        assert!(at("▲!!! over") < at("▲!!! seen") && at("▲!!! seen") < at("●!   slow"), "{shown}");
    }
    let tall = screen(&ward, &Ui::new(None), 10 * SECOND, (200, 60));
    assert_shows(&tall, &["seen 3.0 s", "active 3.0 s", "pending 3.0 s", "○    quiet", "> 25 mmHg"]);
    assert_shows(
        &tall,
        &["high since 7.0 s: what is the matter with over", "low since 7.0 s: what is the matter with slow"],
    );
    assert_shows(line(&tall), &["what is the matter with over"]);
    assert!(!tall.contains("matter with quiet"), "{tall}");
}

#[test]
fn where_nothing_is_raised_it_is_said() {
    let shown = |all| screen(&with(all), &Ui::new(None), 10 * SECOND, (80, 24));
    assert_shows(line(&shown(vec![])), &["no alarm is set for this bed"]);
    assert_shows(line(&shown(vec![alarm("a", "low", "normal", false)])), &["no alarm of 1 is raised"]);
    assert_shows(line(&shown(vec![alarm("a", "low", "pending", false)])), &["no alarm of 1 is raised, 1 pending"]);
}

#[test]
fn an_alarm_of_another_bed_is_told_until_somebody_has_seen_it() {
    let mut ward = filled();
    ward.apply(&state("bed2", 0, 0.0), 10 * SECOND);
    let ui = Ui::new(Some("bed1"));
    ward.apply(&alarms("bed2", vec![alarm("a", "medium", "active", false)]), 10 * SECOND);
    for size in SIZES {
        assert_shows(line(&screen(&ward, &ui, 10 * SECOND, size)), &["◆!! in bed2"]);
    }
    // Behind one that somebody has seen as well.
    let seen_first = vec![alarm("a", "medium", "active", false), alarm("b", "high", "active", true)];
    ward.apply(&alarms("bed2", seen_first), 10 * SECOND);
    assert_shows(line(&screen(&ward, &ui, 10 * SECOND, (120, 40))), &["◆!! in bed2"]);
    ward.apply(&alarms("bed2", vec![alarm("a", "medium", "active", true)]), 10 * SECOND);
    assert!(!screen(&ward, &ui, 10 * SECOND, (80, 24)).contains("in bed2"));
}

#[test]
fn more_alarms_than_rows_are_counted() {
    let all = (0..20).map(|i| alarm(&format!("number{i}"), "low", "active", false)).collect();
    assert_shows(&screen(&with(all), &Ui::new(None), 10 * SECOND, (80, 24)), &["number0", "+17 more", "+19 more"]);
}

#[test]
fn a_pause_hides_no_alarm() {
    let mut ward = filled();
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('p'));
    ward.apply(&alarms("bed1", vec![alarm("new", "high", "active", false)]), 10 * SECOND);
    let shown = screen(&ward, &ui, 10 * SECOND, (120, 40));
    assert_shows(line(&shown), &["▲!!! HIGH", "new"]);
    assert_shows(&shown, &["PAUSED", "alarms of the present"]);
}

#[test]
fn notes_stand_among_the_events_and_the_newest_stays() {
    let mut ward = filled();
    ward.apply(&note("bed1", 9500 * MS, "heparin"), 10 * SECOND);
    for size in SIZES {
        assert_shows(&screen(&ward, &Ui::new(None), 10 * SECOND, size), &["9.5 s  note  heparin (Dr. Weber)"]);
    }
    for i in 0..50 {
        ward.apply(&event("bed1", (9600 + i) * MS, &format!("event {i}")), 10 * SECOND);
    }
    assert_shows(&screen(&ward, &Ui::new(None), 10 * SECOND, (120, 40)), &["note  heparin (Dr. Weber)", "event 49"]);
}

#[test]
fn the_split_of_the_uncertainty_is_shown_in_place_of_values() {
    let ward = filled();
    let mut ui = Ui::new(None);
    press(&mut ui, &ward, KeyCode::Char('u'));
    for size in SIZES {
        let shown = screen(&ward, &ui, 10 * SECOND, size);
        // Three equal parts.
        assert_shows(&shown, &["█epi", "▒ale", "░mod", "p_a      2.0", "  33  33  33"]);
    }
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (200, 60)), &["v_pv     2.0", "epistemic", "aleatoric"]);
    press(&mut ui, &ward, KeyCode::Char('f'));
    assert_shows(&screen(&ward, &ui, 10 * SECOND, (80, 24)), &["q_li     2.0"]);
}

#[test]
fn a_parameter_of_which_the_data_said_nothing_lately_is_marked() {
    let mut ward = filled();
    let mut estimate: ParameterEstimate =
        wire::decode(&parameters("bed1", 9900 * MS).payload, Encoding::Bincode).unwrap();
    // `since_informed_s` of the first.
    estimate.values[5] = 7.0;
    ward.apply(&message("ward/bed1/estimate/parameters", &estimate), 10 * SECOND);
    for size in SIZES {
        let shown = screen(&ward, &Ui::new(None), 10 * SECOND, size);
        assert!(shown.contains("0812?") && !shown.contains("1.61?"), "{shown}");
    }
    assert_shows(&screen(&ward, &Ui::new(None), 10 * SECOND, (120, 40)), &["uninformed 7.0 s"]);
}
