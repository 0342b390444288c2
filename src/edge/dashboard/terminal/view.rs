//! The screen as a whole: header, what is between, keys.

use std::time::Duration;

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, FORECAST_AFTER_S, Liveness};
use super::super::ward::Ward;
use super::paper::{put, put_right};
use super::ui::Ui;
use super::{beds, panels, style, traces};

const LEAST_WIDTH: u16 = 40;
const LEAST_HEIGHT: u16 = 10;
/// From this width on there is a column of panels beside the traces.
const WIDTH_WITH_PANELS: u16 = 76;
/// From this height on the events stand below the traces, not below everything.
const TALL: u16 = 34;
const TRACES: u16 = 6;
/// Estimates of data older than this are marked.
const LATE: Duration = Duration::from_millis(500);
/// More of the name of a bed would push the rest off the header.
const LONGEST_NAME: usize = 20;

/// Draws everything; nothing but the arguments decides what it looks like.
pub(super) fn draw(frame: &mut Frame<'_>, ward: &Ward, ui: &Ui, now: Duration) {
    let area = frame.area();
    let buf = frame.buffer_mut();
    buf.set_style(area, style::SCREEN);
    if area.width < LEAST_WIDTH || area.height < LEAST_HEIGHT {
        let text = format!("{}x{} is too small, {LEAST_WIDTH}x{LEAST_HEIGHT} is needed", area.width, area.height);
        put(buf, area, 0, Span::styled(text, style::WARNING));
        return;
    }
    let header = Rect { height: 1, ..area };
    let keys = Rect { y: area.bottom() - 1, height: 1, ..area };
    let body = Rect { y: area.y + 1, height: area.height - 2, ..area };
    draw_keys(buf, keys, ui);
    draw_header(buf, header, ward, ui, now);
    if ui.is_list {
        beds::draw(buf, body, ward, ui, now);
    } else if let Some((_, bed, at)) = ui.shown(ward, now) {
        draw_bed(buf, body, (bed, at), ward, ui);
    } else {
        draw_waiting(buf, body, ward, ui);
    }
}

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

fn draw_header(buf: &mut Buffer, area: Rect, ward: &Ward, ui: &Ui, now: Duration) {
    let name = ui.shown(ward, now).map(|(name, ..)| name).or_else(|| ui.bed_name(ward)).unwrap_or(style::NONE);
    let place = ward.position(name).map_or(String::new(), |at| format!(" {}/{}", at + 1, ward.beds.len()));
    let is_wide = area.width >= WIDTH_WITH_PANELS + 24;
    let mut spans = vec![
        Span::styled(if is_wide { " hemostream " } else { " " }, style::QUIET),
        Span::styled(name.chars().take(LONGEST_NAME).collect::<String>(), style::STRONG),
        Span::styled(format!("{place}  "), style::QUIET),
    ];
    let Some((_, bed, at)) = ui.shown(ward, now) else {
        spans.push(Span::styled(" WAITING ", style::ALARM));
        put(buf, area, 0, Line::from(spans));
        return;
    };
    let liveness = bed.liveness(at);
    let (state, look) = match &ui.frozen {
        Some(frozen) => {
            let ago = now.saturating_sub(frozen.at).as_secs_f64();
            (format!(" PAUSED {} ago ", style::duration(ago)), style::ALARM)
        }
        None => badge(liveness),
    };
    spans.push(Span::styled(state, look));
    let heart_rate = bed.heart_rate_bpm().map_or(style::NONE.to_owned(), |v| style::number(v, 0));
    spans.extend([
        Span::styled("  HR ", style::QUIET),
        Span::styled(heart_rate, style::STRONG),
        Span::styled("/min", style::QUIET),
    ]);
    if let Some(output) = bed.of_beat("cardiac_output").filter(|_| area.width >= WIDTH_WITH_PANELS) {
        let (mean, half) = panels::beat_reading(output);
        spans.extend([
            Span::styled("  CO ", style::QUIET),
            Span::styled(mean, style::STRONG),
            Span::styled(half, style::QUIET),
        ]);
    }
    put(buf, area, 0, Line::from(spans));
    let age = bed.age(at);
    let is_late = age.is_some_and(|age| age > LATE);
    let age = age.map_or(style::NONE.to_owned(), |age| style::duration(age.as_secs_f64()));
    let time = bed.newest_ns(at).map_or(style::NONE.to_owned(), style::event_time);
    let right = vec![
        Span::styled(if is_wide { "  event time " } else { "  t " }, style::QUIET),
        Span::styled(time, style::STRONG),
        Span::styled("  age ", style::QUIET),
        Span::styled(
            format!("{age}{}", if is_late { "!" } else { " " }),
            if is_late { style::WARNING } else { style::STRONG },
        ),
    ];
    put_right(buf, area, 0, Line::from(right));
}

fn draw_keys(buf: &mut Buffer, area: Rect, ui: &Ui) {
    let pause = if ui.frozen.is_some() { "resume" } else { "pause" };
    let keys = [
        ("q", "quit".to_owned()),
        ("Tab", "next bed".to_owned()),
        ("b", if ui.is_list { "back".to_owned() } else { "beds".to_owned() }),
        ("p", pause.to_owned()),
        ("+/-", format!("{} s", ui.span_s())),
        ("f", "pressures/flows/volumes".to_owned()),
    ];
    let mut spans = Vec::new();
    for (key, meaning) in keys {
        spans.push(Span::styled(format!(" {key} "), style::KEY));
        spans.push(Span::styled(format!(" {meaning} "), style::QUIET));
    }
    put(buf, area, 0, Line::from(spans));
}

fn draw_waiting(buf: &mut Buffer, area: Rect, ward: &Ward, ui: &Ui) {
    let first = if ui.is_connecting { "asking for last values" } else { "nothing has arrived" };
    let of = ui.bed_name(ward).map_or(String::new(), |bed| format!(" of {bed}"));
    let heard: Vec<&str> = ward.beds.keys().take(10).map(String::as_str).collect();
    let mut lines = vec![
        format!("{first} under {}/**{of}", ward.prefix()),
        format!("{} messages, {} of them unreadable", ward.messages, ward.unreadable),
    ];
    if !heard.is_empty() {
        lines.push(format!("beds heard: {} (Tab goes there)", heard.join(", ")));
    }
    let top = area.height / 3;
    for (row, line) in (top..).zip(lines) {
        let indented = Rect { x: area.x + 4, width: area.width - 4, ..area };
        put(buf, indented, row, Span::styled(line, style::PLAIN));
    }
}

fn draw_bed(buf: &mut Buffer, area: Rect, (bed, at): (&Bed, Duration), ward: &Ward, ui: &Ui) {
    let panel_width = match area.width {
        0..WIDTH_WITH_PANELS => 0,
        w if w < 100 => 33,
        w => (w * 7 / 20).min(80),
    };
    let is_tall = area.height + 2 >= TALL;
    let gap = u16::from(panel_width > 0);
    let mut left = Rect { width: area.width - panel_width - gap, ..area };
    let mut right = Rect { x: left.right() + gap, width: panel_width, ..area };
    let events_height = events_height(area.height);
    let split = area.height - events_height;
    left.height = split;
    if !is_tall {
        right.height = split;
    }
    let events_width = if is_tall { left.width } else { area.width };
    let events = Rect { y: area.y + split, height: events_height, width: events_width, ..area };
    traces::draw(buf, left, bed, ui.group, ui.span_s(), at);
    panels::draw_events(buf, events, bed);
    if panel_width > 0 {
        draw_panels(buf, right, (bed, at), ward, ui);
    }
}

/// What the traces leave, which share out whole rows among themselves and prefer to be high.
fn events_height(height: u16) -> u16 {
    const LEAST: u16 = 3;
    const LOWEST_TRACE: u16 = 2;
    let without_titles = height.saturating_sub(1 + LEAST);
    let each = without_titles / TRACES;
    if each < LOWEST_TRACE {
        return 0;
    }
    let axis = u16::from(height > 1 + LEAST + 1 + 3 * TRACES);
    let each = if axis == 1 { (without_titles - 1) / TRACES } else { each };
    // A few more events are worth more than the tenth row of a trace.
    let each = each.min(3 + height / 10);
    height - 1 - axis - each * TRACES
}

fn draw_panels(buf: &mut Buffer, area: Rect, (bed, at): (&Bed, Duration), ward: &Ward, ui: &Ui) {
    const LEAST_HEALTH: u16 = 5;
    const MORE_ROWS_PER_PARAMETER: [u16; 5] = [6, 5, 4, 3, 2];
    let health = panels::health(bed, ward, ui, at);
    let health_rows = 1 + u16::try_from(health.len()).unwrap_or(u16::MAX);
    let one_each = panels::parameter_rows(bed, 1).min(area.height.saturating_sub(LEAST_HEALTH));
    let rest = area.height - one_each;
    let values = if rest >= panels::VALUE_ROWS + LEAST_HEALTH { panels::VALUE_ROWS } else { 0 };
    let has_room = rest >= values + panels::BEAT_ROWS + health_rows;
    let beat = if has_room && bed.has_beats() { panels::BEAT_ROWS } else { 0 };
    let spare = rest.saturating_sub(beat + values + health_rows);
    let fits = |rows: &u16| panels::parameter_rows(bed, *rows) <= one_each + spare;
    let rows_each = MORE_ROWS_PER_PARAMETER.into_iter().find(fits).unwrap_or(1);
    let parameters = if rows_each > 1 { panels::parameter_rows(bed, rows_each) } else { one_each };

    let mut top = area.y;
    let mut next = |height: u16| {
        let part = Rect { y: top, height, ..area }.intersection(area);
        top += height;
        part
    };
    panels::draw_parameters(buf, next(parameters), bed, rows_each);
    if beat > 0 {
        panels::draw_beat(buf, next(beat), bed);
    }
    if values > 0 {
        panels::draw_values(buf, next(values), bed, ui.group);
    }
    if !bed.liveness(at).is_live() {
        buf.set_style(Rect { height: parameters + beat + values, ..area }.intersection(area), style::PAST);
    }
    panels::draw_health(buf, next(area.height.saturating_sub(parameters + beat + values)), health);
}
