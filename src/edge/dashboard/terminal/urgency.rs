//! How urgent alarms are: their order, and the signs, words and colours they go by.
//!
//! Invariant: no colour is alone; a sign and a word say the same.

use ratatui::style::Style;

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::style;
use crate::edge::wire::Alarm;

/// Whether it demands to be looked at: it is on, or was on and nobody has seen it.
pub(super) fn is_raised(alarm: &Alarm) -> bool {
    matches!(alarm.state.as_str(), "active" | "latched")
}

/// Whether it waits for somebody to acknowledge it.
pub(super) fn is_unseen(alarm: &Alarm) -> bool {
    is_raised(alarm) && !alarm.acknowledged
}

/// The larger, the more urgent; 0 unless it is raised.
fn urgency(alarm: &Alarm) -> u8 {
    if !is_raised(alarm) {
        return 0;
    }
    let rank = match alarm.priority.as_str() {
        "high" => 3,
        "medium" => 2,
        "low" => 1,
        _ => 0,
    };
    1 + 4 * rank + 2 * u8::from(!alarm.acknowledged) + u8::from(alarm.state == "active")
}

/// All alarms of a bed, most urgent first; those that are about to be raised come before the quiet ones.
pub(super) fn sorted(bed: &Bed) -> Vec<&Alarm> {
    let mut alarms: Vec<&Alarm> = bed.alarms.iter().collect();
    alarms.sort_by_key(|alarm| std::cmp::Reverse((urgency(alarm), alarm.state == "pending")));
    alarms
}

/// The raised alarms of a bed, most urgent first.
pub(super) fn raised(bed: &Bed) -> Vec<&Alarm> {
    sorted(bed).into_iter().filter(|alarm| is_raised(alarm)).collect()
}

/// The most urgent raised alarm.
pub(super) fn highest(bed: &Bed) -> Option<&Alarm> {
    raised(bed).into_iter().next()
}

/// Urgency of the most urgent alarm; 0 if none is raised.
pub(super) fn of_bed(bed: &Bed) -> u8 {
    highest(bed).map_or(0, urgency)
}

/// The bed with the most urgent raised alarm among those that are `wanted`.
pub(super) fn most_urgent_bed(ward: &Ward, wanted: impl Fn(&str, &Alarm) -> bool) -> Option<(&str, &Alarm)> {
    let alarms =
        ward.beds.iter().flat_map(|(name, bed)| raised(bed).into_iter().map(move |alarm| (name.as_str(), alarm)));
    // Of equals the first.
    alarms.filter(|(name, alarm)| wanted(name, alarm)).min_by_key(|(_, alarm)| std::cmp::Reverse(urgency(alarm)))
}

/// Shape and exclamation marks of a priority.
pub(super) fn sign(alarm: &Alarm) -> &'static str {
    match alarm.priority.as_str() {
        _ if !is_raised(alarm) => "○",
        "high" => "▲!!!",
        "medium" => "◆!!",
        _ => "●!",
    }
}

/// How a raised alarm looks: as a block until it has been seen.
pub(super) fn look(alarm: &Alarm) -> Style {
    match (alarm.priority.as_str(), is_unseen(alarm)) {
        _ if !is_raised(alarm) => style::QUIET,
        ("high", true) => style::HIGH,
        ("medium", true) => style::MEDIUM,
        (_, true) => style::LOW,
        ("high", false) => style::HIGH_SEEN,
        ("medium", false) => style::MEDIUM_SEEN,
        (_, false) => style::LOW_SEEN,
    }
}

/// The state in a word.
pub(super) fn word(alarm: &Alarm) -> &str {
    match alarm.state.as_str() {
        "active" if alarm.acknowledged => "seen",
        // It was active, and nobody has seen it.
        "latched" => "was on",
        other => other,
    }
}
