//! The panels of numbers that are not drawn as waveforms: the last beat, and the other quantities.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::{BeatReading, Bed, quantity_names};
use super::group::Group;
use super::paper::{panel, put};
use super::style;
use super::traces::reading;

/// What a beat is told by, with the names that bedsides know.
const BEAT: [(&str, &str); 6] = [
    ("cardiac_output", "CO"),
    ("stroke_volume", "SV"),
    ("ejection_fraction", "EF"),
    ("heart_rate", "HR"),
    ("svr", "SVR"),
    ("pvr", "PVR"),
];
/// Rows of [`draw_beat`].
pub(super) const BEAT_ROWS: u16 = 4;

/// The last beat in two columns of numbers.
pub(super) fn draw_beat(buf: &mut Buffer, area: Rect, bed: &Bed) {
    const WIDTH_WITH_UNITS: u16 = 29;
    let inner = panel(buf, area, vec![Span::styled("last beat", style::STRONG), Span::styled(" mean ±", style::QUIET)]);
    let width = inner.width / 2;
    for (i, (name, label)) in (0..).zip(BEAT) {
        let Some(reading) = bed.of_beat(name) else { continue };
        let (mean, half) = beat_reading(reading);
        let mut spans = vec![
            Span::styled(format!("{label:<4}"), style::INFERRED),
            Span::styled(format!("{mean:>5}"), style::STRONG),
            // A place is saved where columns would touch.
            Span::styled(format!(" {:<6}", if width < 18 { half.replace("±0.", "±.") } else { half }), style::QUIET),
        ];
        if width >= WIDTH_WITH_UNITS {
            spans.push(Span::styled(format!(" {}", reading.unit), style::QUIET));
        }
        let half = Rect { x: inner.x + (i % 2) * width, width, ..inner };
        put(buf, half, i / 2, Line::from(spans));
    }
}

/// Mean, and half the width of the band.
pub(super) fn beat_reading(reading: &BeatReading) -> (String, String) {
    let (mean, half) = (f64::from(reading.band.mean), 0.5 * f64::from(reading.band.high - reading.band.low));
    let digits = digits(&reading.name, mean, half);
    (style::number(mean, digits), format!("±{}", style::number(half, digits)))
}

/// Digits after the point as bedsides write them, and one more where the band would not be seen as one.
fn digits(name: &str, mean: f64, half: f64) -> usize {
    let usual: u8 = match name {
        "heart_rate" | "stroke_volume" => 0,
        "cardiac_output" | "ejection_fraction" | "svr" => 2,
        "pvr" => 3,
        _ => return style::decimals(mean, half),
    };
    usize::from(usual) + usize::from(2.0 * half < 0.1_f64.powi(usual.into()))
}

/// Rows of [`draw`].
pub(super) const ROWS: u16 = 7;

/// The two groups that are not drawn as waveforms, side by side.
pub(super) fn draw(buf: &mut Buffer, area: Rect, bed: &Bed, drawn: Group) {
    const WIDTH_WITH_TRUTH: u16 = 27;
    let others: Vec<Group> = Group::ALL.into_iter().filter(|g| *g != drawn).collect();
    let width = area.width / 2;
    let mean_width = if width < 19 { 5 } else { 7 };
    for (column, group) in (0..).zip(others) {
        let half = Rect { x: area.x + column * width, width: width.max(1), ..area };
        let title =
            vec![Span::styled(group.name(), style::STRONG), Span::styled(format!(" {}", group.unit()), style::QUIET)];
        let inner = panel(buf, half, title);
        for (row, quantity) in (0..).zip(group.quantities()) {
            let name = quantity_names().nth(quantity).unwrap_or_default();
            let band = bed.state.as_ref().map(|(_, state)| state.bands[quantity]);
            let (mean, half) = band.map_or((style::NONE.to_owned(), String::new()), reading);
            let mut spans = vec![
                Span::styled(format!("{name:<5}"), style::INFERRED),
                Span::styled(format!("{mean:>mean_width$}"), style::STRONG),
                Span::styled(format!("{half:<6}"), style::QUIET),
            ];
            let truth = bed.truth_now(quantity);
            if truth.is_finite() && width >= WIDTH_WITH_TRUTH {
                spans.push(Span::styled(format!(" ◆{}", style::number(truth, 1)), style::TRUTH));
            }
            put(buf, inner, row, Line::from(spans));
        }
    }
}
