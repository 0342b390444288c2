//! The first line: which bed, whether it is live, its most important numbers, its time.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, FORECAST_AFTER_S, Liveness, event_time, seconds};
use super::super::ward::Ward;
use super::order::listed;
use super::paper::{put, put_right};
use super::ui::Ui;
use super::values::beat_reading;
use super::{style, urgency};

/// From this width on there is room for cardiac output.
const WIDTH_WITH_OUTPUT: u16 = 76;
/// From this width on there is room for words.
const WIDE: u16 = 100;
/// Estimates of data older than this are marked.
const LATE: Duration = Duration::from_millis(500);
/// More of the name of a bed would push the rest off the header.
const LONGEST_NAME: usize = 20;

/// How a state of the connection is named and shown.
pub(super) fn badge(liveness: Liveness) -> (String, Style) {
    match liveness {
        Liveness::Live { since_data_s } if since_data_s > FORECAST_AFTER_S => {
            (format!(" FORECAST no data {} ", style::duration(since_data_s)), style::ALARM)
        }
        Liveness::Live { .. } => (" LIVE ".to_owned(), style::GOOD),
        Liveness::NoEstimate => (" NO ESTIMATE ".to_owned(), style::ALARM),
        Liveness::Stale(age) => (format!(" STALE for {} ", style::duration(age.as_secs_f64())), style::ALARM),
        Liveness::NotHeard => (" STALE last values ".to_owned(), style::ALARM),
    }
}

/// How many beds there are, and how many of them need somebody.
pub(super) fn draw_ward(buf: &mut Buffer, area: Rect, ward: &Ward, now: Duration) {
    let mut spans = vec![
        Span::styled(" hemostream ", style::QUIET),
        Span::styled(format!(" {}", style::beds(ward.beds.len())), style::STRONG),
    ];
    for (priority, sign, look) in
        [("high", "▲", style::HIGH_SEEN), ("medium", "◆", style::MEDIUM_SEEN), ("low", "●", style::LOW_SEEN)]
    {
        let is_highest = |bed: &&Bed| urgency::highest(bed).is_some_and(|alarm| alarm.priority == priority);
        let n = ward.beds.values().filter(is_highest).count();
        spans.push(Span::styled(format!("  {sign} {n} {priority}"), if n > 0 { look } else { style::QUIET }));
    }
    let stale = ward.beds.values().filter(|bed| !bed.liveness(now).is_live()).count();
    spans.push(Span::styled(format!("  {stale} not live"), if stale > 0 { style::WARNING } else { style::QUIET }));
    put(buf, area, 0, Line::from(spans));
}

/// The chosen bed.
pub(super) fn draw_bed(buf: &mut Buffer, area: Rect, ward: &Ward, ui: &Ui, now: Duration) {
    let name = ui.shown(ward, now).map(|(name, ..)| name).or_else(|| ui.bed_name(ward)).unwrap_or(style::NONE);
    let beds = listed(ward, ui.order, &ui.filter, now);
    let place = beds.iter().position(|(listed, _)| *listed == name);
    let place = place.map_or(String::new(), |at| format!(" {}/{}", at + 1, beds.len()));
    let is_wide = area.width >= WIDE;
    let mut spans = vec![
        Span::styled(if is_wide { " hemostream " } else { " " }, style::QUIET),
        Span::styled(style::fit(name, LONGEST_NAME), style::STRONG),
        Span::styled(format!("{place}  "), style::QUIET),
    ];
    let Some((_, bed, at)) = ui.shown(ward, now) else {
        spans.push(Span::styled(" WAITING ", style::ALARM));
        put(buf, area, 0, Line::from(spans));
        return;
    };
    let (state, look) = paused(ui, now).unwrap_or_else(|| badge(bed.liveness(at)));
    spans.push(Span::styled(state, look));
    spans.extend(numbers(bed, area.width));
    put(buf, area, 0, Line::from(spans));
    put_right(buf, area, 0, time_and_age(bed, at, is_wide));
}

fn paused(ui: &Ui, now: Duration) -> Option<(String, Style)> {
    let frozen = ui.frozen.as_ref()?;
    let ago_s = now.saturating_sub(frozen.at).as_secs_f64();
    let text = match frozen.back_ns() {
        0 => format!(" PAUSED {} ago ", style::duration(ago_s)),
        back_ns => format!(" PAST {} ago ", style::duration(ago_s + seconds(back_ns))),
    };
    Some((text, style::ALARM))
}

fn numbers(bed: &Bed, width: u16) -> Vec<Span<'static>> {
    let heart_rate = bed.heart_rate_bpm().map_or(style::NONE.to_owned(), |v| style::number(v, 0));
    let mut spans = vec![
        Span::styled("  HR ", style::QUIET),
        Span::styled(heart_rate, style::STRONG),
        Span::styled("/min", style::QUIET),
    ];
    if let Some(output) = bed.of_beat("cardiac_output").filter(|_| width >= WIDTH_WITH_OUTPUT) {
        let (mean, half) = beat_reading(output);
        spans.extend([
            Span::styled("  CO ", style::QUIET),
            Span::styled(mean, style::STRONG),
            Span::styled(half, style::QUIET),
        ]);
    }
    spans
}

fn time_and_age(bed: &Bed, at: Duration, is_wide: bool) -> Line<'static> {
    let age = bed.age(at);
    let is_late = age.is_some_and(|age| age > LATE);
    let age = age.map_or(style::NONE.to_owned(), |age| style::duration(age.as_secs_f64()));
    let time = bed.newest_ns(at).map_or(style::NONE.to_owned(), event_time);
    Line::from(vec![
        Span::styled(if is_wide { "  event time " } else { "  t " }, style::QUIET),
        Span::styled(time, style::STRONG),
        Span::styled("  age ", style::QUIET),
        Span::styled(
            format!("{age}{}", if is_late { "!" } else { " " }),
            if is_late { style::WARNING } else { style::STRONG },
        ),
    ])
}
