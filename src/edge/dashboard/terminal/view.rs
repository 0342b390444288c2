//! The screen as a whole: what is on it, a pure function of what is known, what is chosen, and the time.

use std::time::Duration;

use ratatui::Frame;
use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::Span;

use super::super::ward::Ward;
use super::bedside::{self, Shown};
use super::paper::put;
use super::ui::Ui;
use super::{alarms, header, keys, list, style};

const LEAST_WIDTH: u16 = 40;
const LEAST_HEIGHT: u16 = 10;

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
    let row = |y: u16| Rect { y, height: 1, ..area };
    let body = Rect { y: area.y + 2, height: area.height - 3, ..area };
    if ui.is_list {
        header::draw_ward(buf, row(area.y), ward, now);
        alarms::draw_ward_line(buf, row(area.y + 1), ward, |bed| bed.newest_ns(now));
        list::draw(buf, body, ward, ui, now);
    } else {
        header::draw_bed(buf, row(area.y), ward, ui, now);
        draw_bed(buf, row(area.y + 1), body, ward, ui, now);
    }
    keys::draw(buf, row(area.bottom() - 1), ui, now);
    if ui.shows_help {
        keys::draw_help(buf, body);
    }
}

fn draw_bed(buf: &mut Buffer, alarm_line: Rect, body: Rect, ward: &Ward, ui: &Ui, now: Duration) {
    match ui.shown(ward, now) {
        Some((name, bed, at)) => {
            let present_ns = ward.beds.get(name).unwrap_or(bed).newest_ns(now);
            alarms::draw_line(buf, alarm_line, ward, name, present_ns);
            bedside::draw(buf, body, Shown { name, bed, at, now }, ward, ui);
        }
        None => draw_waiting(buf, body, ward, ui),
    }
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
