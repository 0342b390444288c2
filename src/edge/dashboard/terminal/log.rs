//! The log: events and notes of a bed.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, EventLine, event_time};
use super::paper::{panel, put};
use super::style;

const NOTE: &str = "note";
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
    for (row, event) in (0..).zip(newest(bed, usize::from(inner.height))) {
        put(buf, inner, row, line(event));
    }
}

/// The newest so many. The newest note stays among them: what people said is worth more than what happened in between.
fn newest(bed: &Bed, rows: usize) -> Vec<&EventLine> {
    const LEAST_WITH_OLD_NOTE: usize = 3;
    let first = bed.events.len().saturating_sub(rows);
    let mut events: Vec<&EventLine> = bed.events.range(first..).collect();
    let note = bed.events.iter().rposition(|event| event.kind == NOTE);
    if let Some(note) = note.filter(|note| *note < first && rows >= LEAST_WITH_OLD_NOTE) {
        events[0] = &bed.events[note];
    }
    events
}

fn look(kind: &str) -> Style {
    match kind {
        NOTE => style::INFERRED.patch(style::BOLD),
        _ if GOOD_EVENTS.contains(&kind) => style::OBSERVED,
        _ => style::WARNING,
    }
}

/// An event in one line.
pub(super) fn line(event: &EventLine) -> Line<'static> {
    let mut spans = vec![
        Span::styled(format!("{:>9}  ", event_time(event.time_ns)), style::QUIET),
        Span::styled(event.kind.replace('_', " "), look(&event.kind)),
    ];
    if !event.channel.is_empty() {
        spans.push(Span::styled(format!(" {}", event.channel), style::STRONG));
    }
    spans.push(Span::styled(format!("  {}", event.text), style::PLAIN));
    Line::from(spans)
}
