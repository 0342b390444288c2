//! Alarms of a bed: the line below the header, and the panel.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, event_time, seconds};
use super::super::ward::Ward;
use super::paper::{panel, put, put_right, wrap};
use super::{style, urgency};
use crate::edge::wire::Alarm;

/// From this width on the line says what is the matter, not only its name.
const WIDTH_WITH_TEXT: u16 = 100;

/// State and how long it has lasted, in event time.
fn state(alarm: &Alarm, now_ns: Option<i64>) -> String {
    let lasts = now_ns.map_or(f64::NAN, |now_ns| seconds(now_ns.saturating_sub(alarm.since_ns)).max(0.0));
    format!("{} {}", urgency::word(alarm), style::duration(lasts))
}

/// The most urgent alarm of a bed, and whether another bed needs somebody.
pub(super) fn draw_line(buf: &mut Buffer, area: Rect, ward: &Ward, name: &str, now_ns: Option<i64>) {
    let alarms = ward.beds.get(name).map(urgency::raised).unwrap_or_default();
    match alarms.first() {
        Some(highest) => draw_raised(buf, area, highest, now_ns, alarms.len() - 1, None),
        None => put(buf, area, 0, Span::styled(quiet_text(ward.beds.get(name)), style::QUIET)),
    }
    let elsewhere = urgency::most_urgent_bed(ward, |other, alarm| other != name && urgency::is_unseen(alarm));
    if let Some((other, alarm)) = elsewhere {
        let text = format!(" {} in {} ", urgency::sign(alarm), style::fit(other, 12));
        put_right(buf, area, 0, Line::from(vec![Span::raw(" "), Span::styled(text, urgency::look(alarm))]));
    }
}

/// The most urgent alarm of all beds.
pub(super) fn draw_ward_line(buf: &mut Buffer, area: Rect, ward: &Ward, now_ns: impl Fn(&Bed) -> Option<i64>) {
    let Some((name, alarm)) = urgency::most_urgent_bed(ward, |_, _| true) else {
        put(buf, area, 0, Span::styled(" no alarm in any bed", style::QUIET));
        return;
    };
    let others: usize = ward.beds.values().map(|bed| urgency::raised(bed).len()).sum();
    draw_raised(buf, area, alarm, ward.beds.get(name).and_then(now_ns), others - 1, Some(name));
}

fn draw_raised(buf: &mut Buffer, area: Rect, alarm: &Alarm, now_ns: Option<i64>, others: usize, bed: Option<&str>) {
    let look = urgency::look(alarm);
    let mut text = format!(" {} {}  ", urgency::sign(alarm), alarm.priority.to_uppercase());
    if let Some(bed) = bed {
        text += &format!("{bed}: ");
    }
    text += &format!("{}  {}", alarm.name, state(alarm, now_ns));
    if others > 0 {
        text += &format!("  +{others} more");
    }
    if area.width >= WIDTH_WITH_TEXT && !alarm.text.is_empty() {
        text += &format!("  {}", alarm.text);
    }
    buf.set_style(area, look);
    put(buf, area, 0, Span::styled(text, look));
}

fn quiet_text(bed: Option<&Bed>) -> String {
    let alarms = bed.map_or(&[][..], |bed| &bed.alarms);
    let pending = alarms.iter().filter(|alarm| alarm.state == "pending").count();
    match (alarms.len(), pending) {
        (0, _) => " no alarm is set for this bed".to_owned(),
        (n, 0) => format!(" no alarm of {n} is raised"),
        (n, pending) => format!(" no alarm of {n} is raised, {pending} pending"),
    }
}

/// Rows that the panel needs with the title for one row per alarm, up to so many.
pub(super) fn rows(bed: &Bed, most: usize) -> u16 {
    match bed.alarms.len().min(most) {
        0 => 0,
        n => 1 + u16::try_from(n).unwrap_or(u16::MAX),
    }
}

/// All alarms, most urgent first, each with its state; below those raised or about to be, as far as there is room, since
/// when and what is the matter.
pub(super) fn draw_panel(buf: &mut Buffer, area: Rect, bed: &Bed, now_ns: Option<i64>, is_past_shown: bool) {
    let mut title = vec![Span::styled("alarms", style::STRONG)];
    if is_past_shown {
        title.push(Span::styled(" of the present", style::WARNING));
    }
    let inner = panel(buf, area, title);
    let alarms = urgency::sorted(bed);
    let fit = usize::from(inner.height);
    let shown = if fit < alarms.len() { fit.saturating_sub(1) } else { alarms.len() };
    let mut spare = fit.saturating_sub(alarms.len());
    let mut row = 0;
    for alarm in alarms.iter().take(shown) {
        draw_alarm(buf, inner, row, alarm, now_ns);
        row += 1;
        for text in details(alarm, usize::from(inner.width).saturating_sub(5)).into_iter().take(spare) {
            let indented = Rect { x: inner.x + 5, width: inner.width.saturating_sub(5), ..inner };
            put(buf, indented, row, Span::styled(text, style::PLAIN));
            row += 1;
            spare -= 1;
        }
    }
    if shown < alarms.len() {
        put(buf, inner, row, Span::styled(format!("+{} more", alarms.len() - shown), style::QUIET));
    }
}

fn draw_alarm(buf: &mut Buffer, area: Rect, row: u16, alarm: &Alarm, now_ns: Option<i64>) {
    let look = urgency::look(alarm);
    let state = match alarm.state.as_str() {
        "normal" => {
            let side = if alarm.side == "below" { "<" } else { ">" };
            format!("{side} {} {}", limit(alarm.limit), alarm.unit)
        }
        _ => state(alarm, now_ns),
    };
    let state = state.trim_end().to_owned();
    let room = usize::from(area.width).saturating_sub(5 + 1 + state.chars().count());
    let is_quiet = alarm.state == "normal";
    put(
        buf,
        area,
        row,
        Line::from(vec![
            Span::styled(format!("{:<4}", urgency::sign(alarm)), look),
            Span::raw(" "),
            Span::styled(style::fit(&alarm.name, room), if is_quiet { style::QUIET } else { style::STRONG }),
        ]),
    );
    let state_look = match alarm.state.as_str() {
        "normal" => style::QUIET,
        "pending" => style::PLAIN,
        _ => look,
    };
    put_right(buf, area, row, Span::styled(state, state_look));
}

/// As it was configured, unless that is long.
fn limit(limit: f64) -> String {
    const LONGEST: usize = 7;
    Some(limit.to_string()).filter(|text| text.len() <= LONGEST).unwrap_or_else(|| style::number(limit, 3))
}

fn details(alarm: &Alarm, width: usize) -> Vec<String> {
    if alarm.state == "normal" {
        return Vec::new();
    }
    let priority = if urgency::is_raised(alarm) { format!("{} since", alarm.priority) } else { "since".to_owned() };
    wrap(&format!("{priority} {}: {}", event_time(alarm.since_ns), alarm.text), width)
}
