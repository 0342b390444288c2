//! The log: events and notes of a bed.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, EventLine};
use super::paper::{panel, put};
use super::style;

/// Events that say that all is well, or well again.
const GOOD_EVENTS: [&str; 8] = [
    "start",
    "recovered",
    "artefact_over",
    "model_fits",
    "beat_found",
    "overload_over",
    "alarm_over",
    "alarm_acknowledged",
];

/// The newest events and notes, the newest of all at the bottom.
pub(super) fn draw(buf: &mut Buffer, area: Rect, bed: &Bed) {
    let inner = panel(buf, area, vec![Span::styled("events", style::STRONG), Span::styled(" and notes", style::QUIET)]);
    if bed.events.is_empty() {
        put(buf, inner, 0, Span::styled("none", style::QUIET));
    }
    let first = bed.events.len().saturating_sub(usize::from(inner.height));
    for (row, event) in (0..).zip(bed.events.range(first..)) {
        put(buf, inner, row, line(event));
    }
}

fn look(kind: &str) -> Style {
    match kind {
        "note" => style::INFERRED.patch(style::BOLD),
        _ if GOOD_EVENTS.contains(&kind) => style::OBSERVED,
        _ => style::WARNING,
    }
}

/// An event in one line.
pub(super) fn line(event: &EventLine) -> Line<'static> {
    let mut spans = vec![
        Span::styled(format!("{:>9}  ", style::event_time(event.time_ns)), style::QUIET),
        Span::styled(event.kind.replace('_', " "), look(&event.kind)),
    ];
    if !event.channel.is_empty() {
        spans.push(Span::styled(format!(" {}", event.channel), style::STRONG));
    }
    spans.push(Span::styled(format!("  {}", event.text), style::PLAIN));
    Line::from(spans)
}
