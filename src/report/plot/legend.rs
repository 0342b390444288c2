//! The legend of a chart: in the emptiest corner, or above the axes if every corner has data.

use super::draw::{GAP, TICK};
use super::geometry::Xy;
use super::render::{BAND_OPACITY, Canvas, DOT_RADIUS, Ink};
use super::{Chart, Item};

use kurbo::Rect;

/// Height of a row \[px\].
const ROW: f64 = 14.0;

/// Width of what is drawn before a name \[px\].
const SWATCH: f64 = 18.0;

/// This much may lie behind the legend, in the measure of [`Ink::under`].
const MAY_HIDE: f64 = 15.0;

/// What is named in a chart.
pub(super) struct Legend<'a> {
    entries: Vec<(&'a str, Vec<&'a Item>)>,
    /// Of each entry, with swatch and gaps \[px\].
    widths: Vec<f64>,
}

impl<'a> Legend<'a> {
    /// Collects the labels of a chart with axes `width` px wide.
    pub(super) fn new(canvas: &Canvas, chart: &'a Chart, width: f64) -> Self {
        let mut entries: Vec<(&str, Vec<&Item>)> = Vec::new();
        for item in &chart.items {
            // Regions carry their label themselves.
            let (Item::Line { label: Some(label), .. }
            | Item::Band { label: Some(label), .. }
            | Item::Points { label: Some(label), .. }
            | Item::ErrorBars { label: Some(label), .. }) = item
            else {
                continue;
            };
            match entries.iter_mut().find(|known| known.0 == label) {
                Some(known) => known.1.push(item),
                None => entries.push((label, vec![item])),
            }
        }
        let width = |label| SWATCH + 3.0 * GAP + canvas.width(label, TICK).min(0.6 * width);
        Self { widths: entries.iter().map(|entry| width(entry.0)).collect(), entries }
    }

    /// Draws into a corner of `area` unless that hides some of the `ink`.
    pub(super) fn corner(&self, canvas: &mut Canvas, area: &Rect, ink: &Ink) -> bool {
        if self.entries.is_empty() {
            return true;
        }
        let size = (self.widths.iter().copied().fold(0.0, f64::max), ROW * self.entries.len() as f64 + GAP);
        let Rect { x0, y0, x1, y1 } = area.inset(-GAP);
        // The best liked first.
        let origins = [(x1 - size.0, y0), (x0, y0), (x1 - size.0, y1 - size.1), (x0, y1 - size.1)];
        let corners = origins.map(|origin| Rect::from_origin_size(origin, size));
        let costs = corners.map(|corner| (ink.under(&corner), corner));
        let best = costs.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).filter(|best| best.0 <= MAY_HIDE);
        let Some((_, corner)) = best else { return false };
        canvas.fill(&corner, "#fff", 0.8);
        for i in 0..self.entries.len() {
            self.entry(canvas, i, (corner.x0, corner.y0 + 0.5 * GAP + ROW * (i as f64 + 0.5)));
        }
        true
    }

    /// Draws rows at the top of `area`; the result is their height.
    pub(super) fn strip(&self, canvas: &mut Canvas, area: &Rect) -> f64 {
        let (mut x, mut y) = (area.x0, area.y0 + 0.5 * ROW);
        for (i, width) in self.widths.iter().enumerate() {
            if x > area.x0 && x + width > area.x1 {
                (x, y) = (area.x0, y + ROW);
            }
            self.entry(canvas, i, (x, y));
            x += width;
        }
        y + 0.5 * ROW + 0.5 * GAP - area.y0
    }

    fn entry(&self, canvas: &mut Canvas, i: usize, (left, y): Xy) {
        let ((label, items), (from, to)) = (&self.entries[i], (left + GAP, left + GAP + SWATCH));
        items.iter().for_each(|item| swatch(canvas, item, from, to, y));
        canvas.text(label, (to + GAP, y), TICK, "start", self.widths[i] - SWATCH - 3.0 * GAP);
    }
}

/// What an item looks like.
fn swatch(canvas: &mut Canvas, item: &Item, left: f64, right: f64, y: f64) {
    let middle = 0.5 * (left + right);
    match item {
        Item::Band { colour, .. } => {
            canvas.fill(&Rect::new(left, y - 4.0, right, y + 4.0), colour.hex(), BAND_OPACITY);
        }
        Item::Line { colour, dashed, .. } => canvas.polyline(&[(left, y), (right, y)], *dashed, colour.hex()),
        Item::Points { colour, .. } => canvas.dot((middle, y), DOT_RADIUS, colour.hex()),
        Item::ErrorBars { colour, .. } => {
            canvas.rule((middle, y - 5.0), (middle, y + 5.0), colour.hex());
            canvas.dot((middle, y), DOT_RADIUS, colour.hex());
        }
        Item::Region { .. } => {}
    }
}
