//! The waveforms: six traces above each other, each with its numbers.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Band, Bed, FORECAST_AFTER_S, Liveness, Origin, event_time, quantity_names};
use super::group::Group;
use super::paper::{DOTS_X, DOTS_Y, Ink, Raster, panel, put, put_right};
use super::style;

/// Room for the numbers at the ends of the vertical axis.
const LABEL_WIDTH: u16 = 5;
/// A wide band may take this much of the height on each side of the mean, in swings of the mean.
const BAND_ROOM: f64 = 1.5;

/// The stretch of event time on the screen, in whole dots of it: the picture moves by dots and does not shimmer.
#[derive(Clone, Copy)]
struct Window {
    first_dot: i64,
    dot_ns: i64,
}

impl Window {
    fn new(end_ns: i64, span_s: u32, dots: u16) -> Self {
        let dot_ns = (i64::from(span_s) * 1_000_000_000 / i64::from(dots.max(1))).max(1);
        Self { first_dot: end_ns.div_euclid(dot_ns) - i64::from(dots) + 1, dot_ns }
    }

    fn start_ns(self) -> i64 {
        self.first_dot.saturating_mul(self.dot_ns)
    }

    fn x(self, time_ns: i64) -> i64 {
        time_ns.div_euclid(self.dot_ns) - self.first_dot
    }
}

/// The vertical axis.
#[derive(Clone, Copy)]
struct Scale {
    low: f64,
    high: f64,
    dots: u16,
    /// Digits after the point that tell the ends.
    decimals: usize,
}

impl Scale {
    /// Round numbers around everything that must be seen.
    fn around(seen: (f64, f64), least: f64, dots: u16) -> Self {
        let (centre, half) = (0.5 * (seen.0 + seen.1), 0.5 * (seen.1 - seen.0).max(least));
        let step = round_step(half / 5.0);
        let (low, high) = (((centre - half) / step).floor() * step, ((centre + half) / step).ceil() * step);
        Self { low, high, dots, decimals: usize::from(step < 1.0) }
    }

    fn y(self, value: f64) -> Option<i64> {
        let from_top = (self.high - value) / (self.high - self.low) * f64::from(self.dots - 1);
        from_top.is_finite().then(|| from_top.round().clamp(-1e6, 1e6) as i64)
    }
}

/// The next of 1, 2, 5, 10, ...
fn round_step(least: f64) -> f64 {
    let decade = 10f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0].map(|m| m * decade).into_iter().find(|step| *step >= least).unwrap_or(10.0 * decade)
}

/// A line through points that arrive in order of time.
struct Pen {
    last: Option<(i64, i64, i64)>,
    longest_gap_ns: i64,
}

impl Pen {
    fn new(times: impl Iterator<Item = i64> + Clone, window: Window) -> Self {
        const MEAN_SPACINGS: i64 = 5;
        const DOTS: i64 = 4;
        let spacings = i64::try_from(times.clone().count()).unwrap_or(i64::MAX) - 1;
        let stretch_ns = times.clone().last().unwrap_or(0).saturating_sub(times.clone().next().unwrap_or(0));
        let longest_gap_ns = (DOTS * window.dot_ns).max((stretch_ns / spacings.max(1)).saturating_mul(MEAN_SPACINGS));
        Self { last: None, longest_gap_ns }
    }

    /// Moves to a point; `dot` gets the columns on the way and the heights in each.
    fn to(&mut self, time_ns: i64, x: i64, y: Option<i64>, mut dot: impl FnMut(i64, i64, i64)) {
        let Some(y) = y else {
            self.last = None;
            return;
        };
        match self.last {
            Some((t0, x0, y0)) if time_ns - t0 <= self.longest_gap_ns => {
                let mut before = y0;
                for column in x0..=x {
                    let at = if x == x0 { y } else { y0 + (y - y0) * (column - x0) / (x - x0) };
                    dot(column, before, at);
                    before = at;
                }
            }
            _ => dot(x, y, y),
        }
        self.last = Some((time_ns, x, y));
    }
}

/// What of a bed is drawn.
#[derive(Clone, Copy)]
pub(super) struct Picture {
    pub(super) group: Group,
    pub(super) span_s: u32,
    /// Whether the right edge is not the present.
    pub(super) is_past: bool,
}

/// Draws the six traces of a group; without room for a time axis where `height` is scarce.
pub(super) fn draw(buf: &mut Buffer, area: Rect, bed: &Bed, picture: Picture, now: Duration) {
    let Picture { group, span_s, is_past } = picture;
    let quantities = group.quantities();
    let mut inner = panel(buf, area, title(bed, group, area.width));
    let traces = quantities.len() as u16;
    let has_axis = inner.height % traces >= 1 && inner.height / traces >= 3;
    let readout = readout_width(area.width);
    let plot_width = inner.width.saturating_sub(LABEL_WIDTH + 1 + readout);
    let Some(end_ns) = bed.newest_ns(now) else { return };
    let window = Window::new(end_ns, span_s, plot_width * DOTS_X);
    if has_axis {
        inner.height -= 1;
        let axis = Rect { x: inner.x + LABEL_WIDTH, y: inner.bottom(), width: plot_width, height: 1 };
        draw_time_axis(buf, axis, span_s, is_past.then_some(end_ns));
    }
    let height = (inner.height / traces).max(1);
    let liveness = bed.liveness(now);
    for (row, quantity) in (0..).zip(quantities) {
        let strip = Rect { y: inner.y + row * height, height, ..inner }.intersection(inner);
        if strip.is_empty() {
            break;
        }
        let plot = Rect { x: strip.x + LABEL_WIDTH, width: plot_width, ..strip };
        let numbers = Rect { x: plot.right() + 1, width: readout, ..strip };
        draw_trace(buf, plot, bed, quantity, window, liveness);
        draw_readout(buf, numbers, bed, quantity);
        if !liveness.is_live() {
            buf.set_style(numbers, style::PAST);
        }
    }
}

fn readout_width(width: u16) -> u16 {
    match width {
        0..58 => 15,
        58..100 => 19,
        _ => 22,
    }
}

fn title(bed: &Bed, group: Group, width: u16) -> Vec<Span<'static>> {
    let mut title = vec![
        Span::styled(group.name(), style::STRONG),
        Span::styled(format!(" {}  ", group.unit()), style::QUIET),
        Span::styled("━", style::OBSERVED),
        Span::styled("━", style::INFERRED),
        Span::styled(if width < 58 { " mean " } else { " mean  " }, style::QUIET),
        Span::styled("⢕⢕", style::BAND),
        Span::styled(if width < 58 { " 5–95% " } else { " 5–95 % (± half)  " }, style::QUIET),
    ];
    if group == Group::Pressures && width >= 58 {
        title.extend([Span::styled("⠢⠔", style::SAMPLE), Span::styled(" samples  ", style::QUIET)]);
    }
    if bed.truth.newest_ns().is_some() {
        title.extend([Span::styled("╍╍", style::TRUTH), Span::styled(" truth", style::QUIET)]);
    }
    title
}

/// Seconds before the right edge, which is the present unless its time is given.
fn draw_time_axis(buf: &mut Buffer, area: Rect, span_s: u32, end_ns: Option<i64>) {
    const LEAST_CELLS_PER_MARK: u32 = 10;
    let marks = [1, 2, 5, 10, 20, 30];
    let fits = |step: &u32| span_s / step * LEAST_CELLS_PER_MARK <= u32::from(area.width);
    let step = marks.into_iter().find(fits).unwrap_or(span_s);
    for back in (step..=span_s).step_by(step as usize) {
        let cells = u32::from(area.width) * (span_s - back) / span_s;
        let mark = Rect { x: area.x + cells as u16, ..area }.intersection(area);
        put(buf, mark, 0, Span::styled(format!("╵-{back} s"), style::QUIET));
    }
    let (end, look) = end_ns.map_or(("now".to_owned(), style::QUIET), |t| (event_time(t), style::WARNING));
    put_right(buf, area, 0, Span::styled(format!("{end}╵"), look));
}

/// Smallest and largest value that must be seen.
fn seen(bed: &Bed, quantity: usize, window: Window) -> Option<(f64, f64)> {
    let from_ns = window.start_ns();
    let fold = |values: &mut dyn Iterator<Item = f32>| {
        let finite = values.filter(|v| v.is_finite()).map(f64::from);
        let (low, high) = finite.fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        (low <= high).then_some((low, high))
    };
    let bands = || bed.history.since(from_ns).map(|(_, row)| row.bands[quantity]);
    let truth = fold(&mut bed.truth.since(from_ns).map(|(_, row)| row[quantity]));
    let Some(mean) = fold(&mut bands().map(|b| b.mean)) else {
        let samples = bed.samples.get(quantity)?;
        return truth.or_else(|| fold(&mut samples.since(from_ns).map(|(_, v)| *v)));
    };
    let room = BAND_ROOM * (mean.1 - mean.0);
    let low = fold(&mut bands().map(|b| b.low)).map_or(mean.0, |low| low.0.clamp(mean.0 - room, mean.0));
    let high = fold(&mut bands().map(|b| b.high)).map_or(mean.1, |high| high.1.clamp(mean.1, mean.1 + room));
    let truth = truth.unwrap_or(mean);
    Some((low.min(truth.0.max(mean.0 - room)), high.max(truth.1.min(mean.1 + room))))
}

fn draw_trace(buf: &mut Buffer, area: Rect, bed: &Bed, quantity: usize, window: Window, liveness: Liveness) {
    let Some(seen) = seen(bed, quantity, window) else { return };
    let scale = Scale::around(seen, Group::of(quantity).least_range(), area.height * DOTS_Y);
    draw_labels(buf, area, scale);
    let mut raster = Raster::new(area.width, area.height);
    draw_band(&mut raster, bed, quantity, window, scale);
    if let Some(samples) = bed.samples.get(quantity) {
        for (t, value) in samples.since(window.start_ns()) {
            if let Some(y) = scale.y(f64::from(*value)) {
                raster.set(Ink::Sample, window.x(t), y);
            }
        }
    }
    draw_mean(&mut raster, bed, quantity, window, scale);
    draw_truth(&mut raster, bed, quantity, window, scale);
    let line = line_style(bed.origin(quantity));
    raster.paint(buf, area, |ink| match (ink, liveness) {
        (Ink::Band, _) => style::BAND,
        (Ink::Sample, Liveness::Live { .. } | Liveness::NoEstimate) => style::SAMPLE,
        (Ink::Mean, Liveness::Live { .. }) => line,
        (Ink::Truth, Liveness::Live { .. }) => style::TRUTH,
        _ => style::PAST,
    });
}

fn line_style(origin: Origin) -> Style {
    match origin {
        Origin::Observed => style::OBSERVED,
        Origin::Silent | Origin::Inferred => style::INFERRED,
    }
}

fn draw_labels(buf: &mut Buffer, area: Rect, scale: Scale) {
    let margin = Rect { x: area.x - LABEL_WIDTH, width: LABEL_WIDTH, ..area };
    for row in 0..area.height {
        let value = match row {
            0 => scale.high,
            _ if row + 1 == area.height => scale.low,
            _ => {
                put_right(buf, margin, row, Span::styled("│", style::RULE));
                continue;
            }
        };
        let number = style::number(value, scale.decimals);
        put_right(
            buf,
            margin,
            row,
            Line::from(vec![Span::styled(number, style::QUIET), Span::styled("┤", style::RULE)]),
        );
    }
}

fn draw_band(raster: &mut Raster, bed: &Bed, quantity: usize, window: Window, scale: Scale) {
    let rows = bed.history.since(window.start_ns());
    let mut edges = [(); 2].map(|()| Pen::new(rows.clone().map(|(t, _)| t), window));
    for (t, row) in rows {
        let Band { low, high, .. } = row.bands[quantity];
        // Column by column, so that a band of few points is as filled as one of many.
        let mut columns = [Vec::new(), Vec::new()];
        for ((pen, value), out) in edges.iter_mut().zip([low, high]).zip(&mut columns) {
            pen.to(t, window.x(t), scale.y(f64::from(value)), |x, _, y| out.push((x, y)));
        }
        for ((x, low), (_, high)) in columns[0].iter().zip(&columns[1]) {
            for y in (*high).max(0)..=(*low).min(i64::from(scale.dots)) {
                if (x + window.first_dot + y) % 2 == 0 {
                    raster.set(Ink::Band, *x, y);
                }
            }
        }
    }
}

fn draw_mean(raster: &mut Raster, bed: &Bed, quantity: usize, window: Window, scale: Scale) {
    let rows = bed.history.since(window.start_ns());
    let mut pen = Pen::new(rows.clone().map(|(t, _)| t), window);
    for (t, row) in rows {
        let is_forecast = row.since_data_s > FORECAST_AFTER_S;
        let y = scale.y(f64::from(row.bands[quantity].mean));
        pen.to(t, window.x(t), y, |x, y0, y1| {
            if !is_forecast || (x + window.first_dot) % 3 == 0 {
                raster.column(Ink::Mean, x, y0, y1);
            }
        });
    }
}

fn draw_truth(raster: &mut Raster, bed: &Bed, quantity: usize, window: Window, scale: Scale) {
    // Dashes: where truth and estimate agree, both are seen.
    const DASH: i64 = 2;
    const PERIOD: i64 = 8;
    let rows = bed.truth.since(window.start_ns());
    let mut pen = Pen::new(rows.clone().map(|(t, _)| t), window);
    for (t, row) in rows {
        pen.to(t, window.x(t), scale.y(f64::from(row[quantity])), |x, y0, y1| {
            if (x + window.first_dot).rem_euclid(PERIOD) < DASH {
                raster.column(Ink::Truth, x, y0, y1);
            }
        });
    }
}

/// Name, origin, value, and what else there is room for.
fn draw_readout(buf: &mut Buffer, area: Rect, bed: &Bed, quantity: usize) {
    let origin = bed.origin(quantity);
    let line = line_style(origin);
    let name = quantity_names().nth(quantity).unwrap_or_default();
    let tag = match origin {
        Origin::Observed => Span::styled("observed", line),
        Origin::Silent => Span::styled("no signal", style::WARNING),
        Origin::Inferred => Span::styled("inferred", style::QUIET),
    };
    put(buf, area, 0, vec_line([Span::styled(format!("{name:<5}"), line.patch(style::BOLD)), tag]));
    let band = bed.state.as_ref().map(|(_, row)| row.bands[quantity]);
    let value = band.map_or((style::NONE.to_owned(), String::new()), reading);
    put(buf, area, 1, vec_line([Span::styled(value.0, style::STRONG), Span::styled(value.1, style::STRONG)]));

    let truth = Some(bed.truth_now(quantity)).filter(|v| v.is_finite());
    let truth = truth.map(|v| Span::styled(format!("◆{}", style::number(v, 1)), style::TRUTH));
    let extremes = bed.extremes(quantity).map(|(high, low)| {
        let [high, low] = [high, low].map(|v| style::number(f64::from(v), 0));
        Span::styled(format!("{high}/{low} "), style::PLAIN)
    });
    if area.height > 3 {
        put(buf, area, 2, extremes.unwrap_or_default());
        put(buf, area, 3, truth.unwrap_or_default());
        put(buf, area, 4, Span::styled(description(name), style::QUIET));
    } else {
        put(buf, area, 2, vec_line([extremes.unwrap_or_default(), truth.unwrap_or_default()]));
    }
}

fn vec_line<const N: usize>(spans: [Span<'static>; N]) -> Line<'static> {
    Line::from(spans.to_vec())
}

/// Mean, and half the width of the band; no digits that the band makes meaningless.
pub(super) fn reading(band: Band) -> (String, String) {
    let half = 0.5 * f64::from(band.high - band.low);
    let mean = f64::from(band.mean);
    let (mean_digits, half_digits) = match half {
        h if h < 0.095 => (if mean.abs() < 99.95 { 2 } else { 1 }, 2),
        h if h < 9.95 => (1, 1),
        _ => (0, 0),
    };
    (style::number(mean, mean_digits), format!(" ±{}", style::number(half, half_digits)))
}

fn description(name: &str) -> &'static str {
    match name {
        "p_l" | "v_l" => "left ventricle",
        "p_a" | "v_a" => "systemic arteries",
        "p_v" | "v_v" => "systemic veins",
        "p_r" | "v_r" => "right ventricle",
        "p_pa" | "v_pa" => "pulmonary arteries",
        "p_pv" | "v_pv" => "pulmonary veins",
        "q_li" => "mitral valve",
        "q_lo" => "aortic valve",
        "q_a" => "systemic flow",
        "q_ri" => "tricuspid valve",
        "q_ro" => "pulmonary valve",
        "q_pv" => "pulmonary flow",
        _ => "",
    }
}
