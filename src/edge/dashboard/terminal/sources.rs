//! Where the uncertainty comes from: shares of the variance of each quantity, by source.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, QUANTITIES, Spread, quantity_names};
use super::group::Group;
use super::paper::{panel, put};
use super::style;

/// Each source with what it is drawn with: shapes say the same as colours.
const SOURCES: [(&str, &str, Style); 3] =
    [("epistemic", "█", style::EPISTEMIC), ("aleatoric", "▒", style::ALEATORIC), ("model", "░", style::MODEL)];
/// Rows for the six quantities that are drawn.
pub(super) const ROWS: u16 = 7;
/// Rows for all of them.
pub(super) const ALL_ROWS: u16 = 1 + QUANTITIES as u16;
/// From this width on the title has room for words.
const WIDTH_WITH_WORDS: u16 = 66;
/// Name, standard deviation, three percentages.
const TEXT_WIDTH: u16 = 5 + 8 + 13;

/// Shares of the variance in per cent.
fn shares(spread: &Spread) -> Option<[f64; 3]> {
    let variances = [spread.epistemic, spread.aleatoric, spread.model].map(|sd| sd * sd);
    let whole: f64 = variances.iter().sum();
    (whole.is_finite() && whole > 0.0).then(|| variances.map(|variance| 100.0 * variance / whole))
}

/// The quantities of a group, or with room all of them.
pub(super) fn draw(buf: &mut Buffer, area: Rect, bed: &Bed, drawn: Group) {
    let is_narrow = area.width < WIDTH_WITH_WORDS;
    let by = if is_narrow { ", %" } else { " with sensor noise, % by source:" };
    let mut title = vec![Span::styled("sd", style::STRONG), Span::styled(by, style::QUIET)];
    for (name, symbol, look) in SOURCES {
        let name = if is_narrow { &name[..3] } else { name };
        title.push(Span::styled(format!(" {symbol}{name}"), look));
    }
    let inner = panel(buf, area, title);
    if bed.spread.is_empty() {
        put(buf, inner, 0, Span::styled("kept for the newest estimate only", style::QUIET));
        return;
    }
    let all = inner.height >= ALL_ROWS - 1;
    let quantities = if all { 0..QUANTITIES } else { drawn.quantities() };
    for (row, quantity) in (0..).zip(quantities) {
        let name = quantity_names().nth(quantity).unwrap_or_default();
        let Some(spread) = bed.spread.get(quantity) else { continue };
        draw_quantity(buf, inner, row, name, spread);
    }
}

fn draw_quantity(buf: &mut Buffer, area: Rect, row: u16, name: &str, spread: &Spread) {
    let sd = style::number(spread.total, style::decimals(spread.total, spread.total));
    let mut spans =
        vec![Span::styled(format!("{name:<5}"), style::INFERRED), Span::styled(format!("{sd:>7} "), style::STRONG)];
    if let Some(shares) = shares(spread) {
        let width = area.width.saturating_sub(TEXT_WIDTH);
        for ((_, symbol, look), cells) in SOURCES.into_iter().zip(cells(shares, width)) {
            spans.push(Span::styled(symbol.repeat(cells), look));
        }
        for ((.., look), share) in SOURCES.into_iter().zip(shares) {
            spans.push(Span::styled(format!(" {share:>3.0}"), look));
        }
    }
    put(buf, area, row, Line::from(spans));
}

/// Cells of a bar for each share, `width` in all.
fn cells(shares: [f64; 3], width: u16) -> [usize; 3] {
    let edge = |share: f64| (share / 100.0 * f64::from(width)).round() as usize;
    let (first, second) = (edge(shares[0]), edge(shares[0] + shares[1]));
    [first, second - first, usize::from(width) - second.min(usize::from(width))]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_of_the_variance_and_fill_the_bar() {
        let spread = Spread { total: 5.0, epistemic: 3.0, aleatoric: 4.0, model: 0.0 };
        let found = shares(&spread).unwrap();
        assert!(found.iter().zip([36.0, 64.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        assert_eq!(cells(found, 10), [4, 6, 0]);
        assert!(shares(&Spread { epistemic: f64::NAN, ..spread }).is_none());
        assert!(shares(&Spread { epistemic: 0.0, aleatoric: 0.0, ..spread }).is_none());
        for width in 0..40 {
            for (a, b) in [(0.0, 0.0), (33.4, 33.3), (100.0, 0.0), (0.5, 99.0)] {
                assert_eq!(cells([a, b, 100.0 - a - b], width).iter().sum::<usize>(), usize::from(width));
            }
        }
    }
}
