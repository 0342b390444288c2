//! Charts: axes, and items over them. Lengths in px.

use super::axis::{Axis, Tick};
use super::draw::{GAP, LABEL, TICK, plot_area};
use super::geometry::{Xy, snap, thin};
use super::legend::Legend;
use super::render::{BAND_OPACITY, Canvas, DOT_RADIUS, Font, Ink, LINE_WIDTH};
use super::{Chart, Item, PlotError};

use kurbo::{Rect, Vec2};

use std::collections::BTreeSet;

/// At most this many labelled ticks.
const X_TICKS: usize = 7;
const Y_TICKS: usize = 8;

/// A legend leaves the axes at least this height.
const LEAST_HEIGHT: f64 = 60.0;

const AXIS: &str = "#555";
const GRID: &str = "#e2e2e2";
const FAINT_GRID: &str = "#f2f2f2";
const STRIPE_OPACITY: f64 = 0.075;
const STRIPE_LABEL: Font = Font { colour: "#787878", ..TICK };

/// A chart laid out: its axes and where they span.
struct Plot<'a> {
    chart: &'a Chart,
    x: Axis,
    y: Axis,
    area: Rect,
}

/// Draws a chart with its left axis `gutter` from the left border of `room`.
pub(super) fn draw(canvas: &mut Canvas, chart: &Chart, room: &Rect, gutter: f64) -> Result<(), PlotError> {
    let mut area = plot_area(canvas, &chart.title, room, gutter);
    area.y1 -= if chart.x_label.is_empty() { 0.0 } else { LABEL.size + GAP };
    let legend = Legend::new(canvas, chart, area.width());
    let empty = canvas.svg.len();
    let ink = Plot::new(chart, area).draw(canvas, room)?;
    if !legend.corner(canvas, &area, &ink) {
        canvas.svg.truncate(empty);
        area.y0 = f64::min(area.y0 + legend.strip(canvas, &area), area.y1 - LEAST_HEIGHT);
        Plot::new(chart, area).draw(canvas, room)?;
    }
    Ok(())
}

/// What stands left of the vertical axis.
pub(super) fn y_names(chart: &Chart) -> Vec<String> {
    y_ticks(chart, &axes(chart).1).into_iter().map(|tick| tick.label).collect()
}

fn y_ticks(chart: &Chart, axis: &Axis) -> Vec<Tick> {
    if chart.y_names.is_empty() {
        return axis.ticks(Y_TICKS);
    }
    let tick = |(k, name): (usize, &String)| Tick { at: axis.place(k as f64), label: name.clone() };
    chart.y_names.iter().enumerate().map(tick).collect()
}

fn axes(chart: &Chart) -> (Axis, Axis) {
    let (xs, ys): (Vec<_>, Vec<_>) = chart.items.iter().map(Item::values).unzip();
    let x = Axis::fit(&xs.concat(), chart.x_range, chart.log_x, 0.02);
    (x, Axis::fit(&ys.concat(), chart.y_range, chart.log_y, 0.06))
}

impl Item {
    /// Every x and every y that should be seen.
    fn values(&self) -> (Vec<f64>, Vec<f64>) {
        match self {
            Self::Line { points, .. } | Self::Points { points, .. } => points.iter().copied().unzip(),
            Self::Band { edges, .. } => edges.iter().flat_map(|&(x, low, high)| [(x, low), (x, high)]).unzip(),
            Self::ErrorBars { points, .. } => {
                points.iter().flat_map(|&(x, y, half)| [(x, y), (x, y - half), (x, y + half)]).unzip()
            }
            Self::Region { from, to, .. } => (vec![*from, *to], Vec::new()),
        }
    }
}

impl<'a> Plot<'a> {
    fn new(chart: &'a Chart, area: Rect) -> Self {
        let (x, y) = axes(chart);
        Self { chart, x, y, area: area.round() + Vec2::new(0.5, 0.5) }
    }

    /// The result is what a legend should not hide.
    fn draw(&self, canvas: &mut Canvas, room: &Rect) -> Result<Ink, PlotError> {
        self.ticks(canvas, room.x1);
        self.axis_labels(canvas, room);
        for stripe in self.chart.items.iter().filter_map(|item| self.stripe(item)) {
            canvas.fill(&stripe, "#000", STRIPE_OPACITY);
        }
        let start = canvas.svg.len();
        self.items(canvas);
        let mut ink = canvas.ink(start)?;
        self.stripe_labels(canvas, &mut ink);
        let Rect { x0, y0, x1, y1 } = self.area;
        canvas.rule((x0, y0), (x0, y1), AXIS);
        canvas.rule((x0, y1), (x1, y1), AXIS);
        Ok(ink)
    }

    fn axis_labels(&self, canvas: &mut Canvas, room: &Rect) {
        let (middle, upright) = (self.area.center(), Font { upright: true, ..LABEL });
        let (foot, side) = (room.y1 - GAP - 0.4 * LABEL.size, room.x0 + GAP + 0.5 * LABEL.size);
        canvas.text(&self.chart.x_label, (middle.x, foot), LABEL, "middle", self.area.width());
        canvas.text(&self.chart.y_label, (side, middle.y), upright, "middle", self.area.height());
    }

    /// Grid lines, ticks and their labels.
    fn ticks(&self, canvas: &mut Canvas, border: f64) {
        let (Rect { x0, y0, x1, y1 }, xs) = (self.area, self.ticks_that_fit(canvas, border));
        let mut tick = |label: &str, [far, near, end, text]: [Xy; 4], anchor| {
            canvas.rule(near, far, if label.is_empty() { FAINT_GRID } else { GRID });
            if !label.is_empty() {
                canvas.rule(near, end, AXIS);
                canvas.text(label, text, TICK, anchor, f64::INFINITY);
            }
        };
        for Tick { at, label } in xs {
            let x = snap(x0 + at * self.area.width());
            tick(&label, [(x, y0), (x, y1), (x, y1 + 3.0), (x, y1 + GAP + 0.6 * TICK.size)], "middle");
        }
        for Tick { at, label } in y_ticks(self.chart, &self.y) {
            let y = snap(y1 - at * self.area.height());
            tick(&label, [(x1, y), (x0, y), (x0 - 3.0, y), (x0 - GAP, y)], "end");
        }
    }

    /// As many ticks of the horizontal axis as have room for their labels; none may reach over `border`.
    fn ticks_that_fit(&self, canvas: &Canvas, border: f64) -> Vec<Tick> {
        let fits = |ticks: &Vec<Tick>| {
            let mut free = f64::NEG_INFINITY;
            ticks.iter().filter(|tick| !tick.label.is_empty()).all(|tick| {
                let at = self.area.x0 + tick.at * self.area.width();
                let half = 0.5 * canvas.width(&tick.label, TICK);
                let apart = at - half >= free && at + half <= border;
                free = at + half + GAP;
                apart
            })
        };
        (1..=X_TICKS).rev().map(|most| self.x.ticks(most)).find(fits).unwrap_or_default()
    }

    /// Bands, lines and error bars within the axes, then dots.
    fn items(&self, canvas: &mut Canvas) {
        let mut items: Vec<_> = self.chart.items.iter().collect();
        items.sort_by_key(|item| match item {
            Item::Band { .. } => 0,
            Item::Line { .. } => 1,
            Item::ErrorBars { .. } => 2,
            Item::Points { .. } | Item::Region { .. } => 3,
        });
        // With a margin, so that a line along the border keeps its width.
        canvas.clipped(&self.area.inflate(0.5 * LINE_WIDTH, 0.5 * LINE_WIDTH), |canvas| {
            for item in &items {
                match item {
                    Item::Band { edges, colour, .. } => self.band(canvas, edges, colour.hex()),
                    Item::Line { points, colour, dashed, .. } => self.line(canvas, points, *dashed, colour.hex()),
                    Item::ErrorBars { points, colour, .. } => self.bars(canvas, points, colour.hex()),
                    Item::Points { .. } | Item::Region { .. } => {}
                }
            }
        });
        for item in items {
            match item {
                Item::ErrorBars { points, colour, .. } => {
                    self.dots(canvas, points.iter().map(|&(x, mean, _)| (x, mean)), colour.hex());
                }
                Item::Points { points, colour, .. } => self.dots(canvas, points.iter().copied(), colour.hex()),
                _ => {}
            }
        }
    }

    fn band(&self, canvas: &mut Canvas, edges: &[(f64, f64, f64)], colour: &str) {
        let placed: Vec<_> = edges.iter().map(|&(x, low, high)| (self.px(x, low), self.px(x, high))).collect();
        for run in placed.split(|&(low, high)| !finite(low) || !finite(high)).filter(|run| run.len() > 1) {
            let (low, high): (Vec<_>, Vec<_>) = run.iter().copied().unzip();
            let mut outline = thin(&low, &self.area);
            outline.extend(thin(&high, &self.area).into_iter().rev());
            canvas.polygon(&outline, colour, BAND_OPACITY);
        }
    }

    fn line(&self, canvas: &mut Canvas, points: &[(f64, f64)], dashed: bool, colour: &str) {
        let placed: Vec<_> = points.iter().map(|&(x, y)| self.px(x, y)).collect();
        for run in placed.split(|&point| !finite(point)) {
            match run {
                [] => {}
                [alone] => canvas.dot(*alone, LINE_WIDTH, colour),
                _ => canvas.polyline(&thin(run, &self.area), dashed, colour),
            }
        }
    }

    fn bars(&self, canvas: &mut Canvas, points: &[(f64, f64, f64)], colour: &str) {
        for &(x, mean, half) in points {
            let (at, (_, low), (_, high)) = (self.px(x, mean), self.px(x, mean - half), self.px(x, mean + half));
            if !finite(at) || !high.is_finite() || half.is_nan() || half <= 0.0 {
                continue;
            }
            // On a log axis the lower end may lie infinitely far down.
            let low = if low.is_nan() { self.area.y1 + GAP } else { low };
            canvas.rule((at.0, low), (at.0, high), colour);
            for y in [low, high] {
                canvas.rule((at.0 - 3.0, y), (at.0 + 3.0, y), colour);
            }
        }
    }

    fn dots(&self, canvas: &mut Canvas, points: impl Iterator<Item = (f64, f64)>, colour: &str) {
        // With a margin, as the border belongs to the axes.
        let area = self.area.inflate(0.5, 0.5);
        let mut taken = BTreeSet::new();
        for at in points.map(|(x, y)| self.px(x, y)).filter(|&at| finite(at) && area.contains(at)) {
            // Thousands of points on the same spot need one dot.
            if taken.insert(((2.0 * at.0).round() as i64, (2.0 * at.1).round() as i64)) {
                canvas.dot(at, DOT_RADIUS, colour);
            }
        }
    }

    /// What the stripes are called, at that end where less is in the way.
    fn stripe_labels(&self, canvas: &mut Canvas, ink: &mut Ink) {
        let mut taken = f64::NEG_INFINITY;
        for item in &self.chart.items {
            let (Some(stripe), Item::Region { label: Some(label), .. }) = (self.stripe(item), item) else { continue };
            let length = canvas.width(label, STRIPE_LABEL);
            let upright = length + GAP > stripe.width();
            let (width, height) = if upright { (TICK.size, length) } else { (length, TICK.size) };
            let x = stripe.center().x;
            if x - 0.5 * width < taken {
                continue;
            }
            taken = x + 0.5 * width;
            let ends = [stripe.y0 + GAP + 0.5 * height, stripe.y1 - GAP - 0.5 * height];
            let [high, low] = ends.map(|y| Rect::from_center_size((x, y), (width, height)));
            let place = if ink.under(&high) <= ink.under(&low) { high } else { low };
            ink.add(&place);
            canvas.text(label, (x, place.center().y), Font { upright, ..STRIPE_LABEL }, "middle", f64::INFINITY);
        }
    }

    /// The part of the axes a region covers, if any of it is seen.
    fn stripe(&self, item: &Item) -> Option<Rect> {
        let Item::Region { from, to, .. } = item else { return None };
        let end = |value: f64| match self.px(value, 0.0).0 {
            x if x.is_nan() && value > 0.0 => self.area.x1,
            x if x.is_nan() => self.area.x0,
            x => x.clamp(self.area.x0, self.area.x1),
        };
        let (x0, x1) = (end(from.min(*to)), end(from.max(*to)));
        (!from.is_nan() && !to.is_nan() && x0 < x1).then_some(Rect { x0, x1, ..self.area })
    }

    fn px(&self, x: f64, y: f64) -> Xy {
        let Rect { x0, y1, .. } = self.area;
        (x0 + self.x.place(x) * self.area.width(), y1 - self.y.place(y) * self.area.height())
    }
}

fn finite((x, y): Xy) -> bool {
    x.is_finite() && y.is_finite()
}
