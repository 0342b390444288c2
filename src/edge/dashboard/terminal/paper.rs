//! What everything is drawn with: lines of text, panels with a title, and a raster of braille dots.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::style;

/// Dots per character cell.
pub(super) const DOTS_X: u16 = 2;
/// Dots per character cell.
pub(super) const DOTS_Y: u16 = 4;

/// Writes a line into row `row` of `area`; what does not fit is cut off.
pub(super) fn put(buf: &mut Buffer, area: Rect, row: u16, line: impl Into<Line<'static>>) {
    let area = area.intersection(buf.area);
    if row < area.height {
        buf.set_line(area.x, area.y + row, &line.into(), area.width);
    }
}

/// Writes a line at the right end of row `row`.
pub(super) fn put_right(buf: &mut Buffer, area: Rect, row: u16, line: impl Into<Line<'static>>) {
    let line = line.into();
    let width = u16::try_from(line.width()).unwrap_or(u16::MAX).min(area.width);
    put(buf, Rect { x: area.right() - width, width, ..area }, row, line);
}

/// A rule with a title; returns what is left below it.
pub(super) fn panel(buf: &mut Buffer, area: Rect, title: Vec<Span<'static>>) -> Rect {
    if area.height == 0 {
        return area;
    }
    put(buf, area, 0, Span::styled("─".repeat(usize::from(area.width)), style::RULE));
    let mut spans = vec![Span::raw(" ")];
    spans.extend(title);
    spans.push(Span::raw(" "));
    put(buf, Rect { x: area.x + 1, width: area.width.saturating_sub(1), ..area }, 0, Line::from(spans));
    Rect { y: area.y + 1, height: area.height - 1, ..area }
}

/// Words in lines of at most `width` characters; a longer word is a line of its own.
pub(super) fn wrap(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// What a dot stands for; in a cell that holds several, the last of these gives the colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ink {
    /// Between the quantiles.
    Band,
    /// A measured value.
    Sample,
    /// The estimate.
    Mean,
    /// What is really so.
    Truth,
}

/// Dots in four inks, two by four per cell.
pub(super) struct Raster {
    width: u16,
    height: u16,
    /// Per cell and ink, the dots as braille counts them.
    cells: Vec<[u8; 4]>,
}

impl Raster {
    pub(super) fn new(width: u16, height: u16) -> Self {
        Self { width, height, cells: vec![[0; 4]; usize::from(width) * usize::from(height)] }
    }

    /// Sets a dot, counted from the upper left; outside, nothing happens.
    pub(super) fn set(&mut self, ink: Ink, x: i64, y: i64) {
        const BITS: [[u8; 4]; 2] = [[0x01, 0x02, 0x04, 0x40], [0x08, 0x10, 0x20, 0x80]];
        let (Ok(x), Ok(y)) = (u16::try_from(x), u16::try_from(y)) else { return };
        let (column, row) = (x / DOTS_X, y / DOTS_Y);
        if column < self.width && row < self.height {
            let cell = usize::from(row) * usize::from(self.width) + usize::from(column);
            self.cells[cell][ink as usize] |= BITS[usize::from(x % DOTS_X)][usize::from(y % DOTS_Y)];
        }
    }

    /// Sets the dots of a column between two heights, both included.
    pub(super) fn column(&mut self, ink: Ink, x: i64, y0: i64, y1: i64) {
        let last = i64::from(self.height) * i64::from(DOTS_Y) - 1;
        for y in y0.min(y1).max(0)..=y0.max(y1).min(last) {
            self.set(ink, x, y);
        }
    }

    /// Paints the cells that hold dots.
    pub(super) fn paint(&self, buf: &mut Buffer, area: Rect, look: impl Fn(Ink) -> Style) {
        for (cell, dots) in (0u16..).zip(&self.cells) {
            let Some((pattern, ink)) = top(dots) else { continue };
            let position = (area.x + cell % self.width, area.y + cell / self.width);
            let symbol = char::from_u32(0x2800 + u32::from(pattern)).unwrap_or(' ');
            if let Some(target) = buf.cell_mut(position) {
                target.set_char(symbol).set_style(look(ink));
            }
        }
    }
}

/// The dots that a cell shows. The band gives way, or else it would thicken the lines.
fn top(dots: &[u8; 4]) -> Option<(u8, Ink)> {
    let [band, sample, mean, truth] = *dots;
    [(truth | mean, truth, Ink::Truth), (mean, mean, Ink::Mean), (sample, sample, Ink::Sample), (band, band, Ink::Band)]
        .into_iter()
        .find(|(_, own, _)| *own != 0)
        .map(|(pattern, _, ink)| (pattern, ink))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dots_land_where_braille_has_them_and_nothing_lands_outside() {
        let area = Rect::new(0, 0, 2, 1);
        let mut buf = Buffer::empty(area);
        let mut raster = Raster::new(2, 1);
        for (x, y) in [(0, 0), (3, 3), (4, 0), (0, 4), (-1, 0)] {
            raster.set(Ink::Mean, x, y);
        }
        raster.paint(&mut buf, area, |_| style::PLAIN);
        assert_eq!((buf[(0, 0)].symbol(), buf[(1, 0)].symbol()), ("⠁", "⢀"));
    }

    #[test]
    fn words_are_kept_whole() {
        assert_eq!(wrap("low output, 4.1 L/min", 11), ["low output,", "4.1 L/min"]);
        assert_eq!(wrap("  unbelievable  ", 4), ["unbelievable"]);
        assert!(wrap("", 4).is_empty());
    }

    #[test]
    fn the_estimate_hides_the_band_but_not_the_truth() {
        assert_eq!(top(&[0xff, 0x01, 0x02, 0]), Some((0x02, Ink::Mean)));
        assert_eq!(top(&[0xff, 0, 0x02, 0x04]), Some((0x06, Ink::Truth)));
        assert_eq!(top(&[0; 4]), None);
    }
}
