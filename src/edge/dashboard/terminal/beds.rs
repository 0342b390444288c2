//! The list of all beds.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, quantity_names};
use super::super::ward::Ward;
use super::panels::beat_reading;
use super::paper::{panel, put};
use super::style;
use super::traces::reading;
use super::ui::Ui;
use super::view::badge;

const NAME_WIDTH: usize = 12;
/// Of the longest state with its number.
const STATE_WIDTH: usize = 25;

/// One row per bed, the chosen one in view.
pub(super) fn draw(buf: &mut Buffer, area: Rect, ward: &Ward, ui: &Ui, now: Duration) {
    let title = format!("{} beds under {}", ward.beds.len(), ward.prefix());
    let inner = panel(buf, area, vec![Span::styled(title, style::STRONG)]);
    put(buf, inner, 0, Span::styled(format!("  {}", heading()), style::QUIET));
    let rows = Rect { y: inner.y + 1, height: inner.height.saturating_sub(1), ..inner };
    let chosen = ui.bed_name(ward).unwrap_or_default();
    let fit = usize::from(rows.height);
    let first = ward.position(chosen).map_or(0, |at| (at + 1).saturating_sub(fit));
    for (row, (name, bed)) in (0..rows.height).zip(ward.beds.iter().skip(first)) {
        let is_chosen = name == chosen;
        let mut spans = vec![Span::styled(if is_chosen { "▶ " } else { "  " }, style::STRONG)];
        spans.extend(summary(name, bed, now, is_chosen));
        put(buf, rows, row, Line::from(spans));
    }
}

fn heading() -> String {
    format!(
        "{:<NAME_WIDTH$}  {:<STATE_WIDTH$}{:>4}  {:<14} {:<14} {:<14} {:>8} {:>8}  {}",
        "bed", "state", "HR", "p_a mmHg", "p_pv mmHg", "CO L/min", "members", "p99 ms", "last event"
    )
}

fn summary(name: &str, bed: &Bed, now: Duration, is_chosen: bool) -> Vec<Span<'static>> {
    let pressure = |wanted: &str| {
        let quantity = quantity_names().position(|n| n == wanted);
        let band = bed.state.as_ref().zip(quantity).map(|((_, row), q)| row.bands[q]);
        band.map_or(style::NONE.to_owned(), |b| {
            let (mean, half) = reading(b);
            mean + &half
        })
    };
    let heart_rate = bed.heart_rate_bpm().map_or(style::NONE.to_owned(), |v| style::number(v, 0));
    let output = bed.of_beat("cardiac_output").map(beat_reading);
    let output = output.map_or(style::NONE.to_owned(), |(mean, half)| format!("{mean} {half}"));
    let status = bed.status.as_ref();
    let members = status.map_or(style::NONE.to_owned(), |s| format!("{}/{}", s.members_alive, s.members));
    let lag = status.map_or(style::NONE.to_owned(), |s| style::number(s.lag_p99_ms, 2));
    let event = bed.events.back().map(|e| format!("{} {}", e.kind, e.channel)).unwrap_or_default();
    let (state, look) = badge(bed.liveness(now));
    let name: String = name.chars().take(NAME_WIDTH).collect();
    vec![
        Span::styled(format!("{name:<NAME_WIDTH$} "), if is_chosen { style::STRONG } else { style::PLAIN }),
        Span::styled(state.clone(), look),
        Span::raw(" ".repeat(STATE_WIDTH.saturating_sub(state.chars().count()))),
        Span::styled(format!(" {heart_rate:>4}  "), style::STRONG),
        Span::styled(format!("{:<14} {:<14} {output:<14} ", pressure("p_a"), pressure("p_pv")), style::PLAIN),
        Span::styled(format!("{members:>8} {lag:>8}  "), style::QUIET),
        Span::styled(event, style::PLAIN),
    ]
}
