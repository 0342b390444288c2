//! The ward: one row per bed, and below them what there is to say about the chosen one.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::columns::{self, Row};
use super::order::listed;
use super::paper::{panel, put};
use super::ui::Ui;
use super::{alarms, log, style};

/// Before the first column: which bed is chosen.
const MARGIN: u16 = 2;
/// Alarms of the chosen bed that are always shown, where there are so many.
const LEAST_ALARMS: usize = 2;
/// Beds that are seen on the lowest screens.
const LEAST_BEDS: u16 = 6;
/// Events of the chosen bed at most.
const MOST_EVENTS: u16 = 8;

/// The beds in order, the chosen one in view, and its details.
pub(super) fn draw(buf: &mut Buffer, area: Rect, ward: &Ward, ui: &Ui, now: Duration) {
    let beds = listed(ward, ui.order, &ui.filter, now);
    let chosen = ui.bed_name(ward).unwrap_or_default();
    let needed = 2 + u16::try_from(beds.len().max(1)).unwrap_or(u16::MAX - 2);
    let details_height = details_height(area.height, needed);
    let list = Rect { height: area.height - details_height, ..area };
    let inner = panel(buf, list, title(ward, ui, beds.len()));
    let chosen_at = beds.iter().position(|(name, _)| *name == chosen);
    let fit = usize::from(inner.height.saturating_sub(1));
    let first = chosen_at.map_or(0, |at| (at + 1).saturating_sub(fit));
    let columns = columns::fitting(inner.width.saturating_sub(MARGIN));
    let table = Rect { x: inner.x + MARGIN, width: inner.width.saturating_sub(MARGIN), ..inner };
    put(buf, table, 0, columns::heading(&columns));
    for (row, (name, bed)) in (1..inner.height).zip(beds.iter().skip(first)) {
        let is_chosen = *name == chosen;
        if is_chosen {
            put(buf, inner, row, Span::styled("▶", style::STRONG));
        }
        put(buf, table, row, columns::line(&columns, &Row { name, bed, now, is_chosen }));
    }
    if beds.is_empty() {
        put(buf, table, 1, Span::styled(nothing_text(ward, ui), style::PLAIN));
    }
    if let Some((name, bed)) = chosen_at.map(|at| beds[at]) {
        let details = Rect { y: list.bottom(), height: details_height, ..area };
        draw_details(buf, details, name, bed, now);
    }
}

fn title(ward: &Ward, ui: &Ui, listed: usize) -> Vec<Span<'static>> {
    let mut title = vec![
        Span::styled(format!("{} under {}", style::beds(ward.beds.len()), ward.prefix()), style::STRONG),
        Span::styled(format!("  {}", ui.order.name()), style::QUIET),
    ];
    if !ui.filter.is_empty() {
        title.push(Span::styled(format!("  {listed} with \"{}\"", ui.filter), style::WARNING));
    }
    title
}

fn nothing_text(ward: &Ward, ui: &Ui) -> String {
    match (ward.beds.len(), ui.is_connecting) {
        (0, true) => "asking for last values".to_owned(),
        (0, false) => "no bed has been heard yet".to_owned(),
        _ => format!("no bed with \"{}\" in its name; / then Esc shows all", ui.filter),
    }
}

/// What the beds leave, and more than nothing where there are too many of them.
fn details_height(height: u16, needed: u16) -> u16 {
    let least = 2 + LEAST_ALARMS as u16 + 2;
    if height < 2 + LEAST_BEDS + least {
        return 0;
    }
    height.saturating_sub(needed).max(least.max(height / 4)).min(height - needed.min(2 + LEAST_BEDS))
}

fn draw_details(buf: &mut Buffer, area: Rect, name: &str, bed: &Bed, now: Duration) {
    let (quality, look) = columns::quality(bed);
    let (_, reason) = bed.quality();
    let members = bed.status.as_ref().map_or(String::new(), |s| format!("{}/{}", s.members_alive, s.members));
    let title = vec![
        Span::styled(name.to_owned(), style::STRONG),
        Span::styled("  quality ", style::QUIET),
        Span::styled(quality, look),
        Span::styled("  members ", style::QUIET),
        Span::styled(members, style::PLAIN),
    ];
    let inner = panel(buf, area, title);
    if !reason.is_empty() {
        put(
            buf,
            inner,
            0,
            Line::from(vec![Span::styled("because ", style::QUIET), Span::styled(reason, style::PLAIN)]),
        );
    } else if !inner.is_empty() {
        put(buf, inner, 0, Span::styled("all sensors deliver, and the model fits them", style::QUIET));
    }
    let rest = Rect { y: inner.y + 1, height: inner.height.saturating_sub(1), ..inner }.intersection(area);
    let event_rows = (rest.height / 3).clamp(2, 1 + MOST_EVENTS).min(rest.height);
    let alarm_rows = match alarms::rows(bed, usize::MAX) {
        0 => 0,
        // Room for what is the matter as well.
        rows => (1 + 3 * (rows - 1)).min(rest.height - event_rows),
    };
    alarms::draw_panel(buf, Rect { height: alarm_rows, ..rest }, bed, bed.newest_ns(now), false);
    let events = Rect { y: rest.y + alarm_rows, height: (rest.height - alarm_rows).min(1 + MOST_EVENTS), ..rest };
    log::draw(buf, events, bed);
}
