//! The panel of estimated parameters: mean, band, truth, gauge and trend of each.

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::{Band, Bed, Parameter, seconds};
use super::paper::{DOTS_X, DOTS_Y, Ink, Raster, panel, put, put_right};
use super::style;

/// Below this the gauge of a band says nothing.
const LEAST_GAUGE: u16 = 8;
/// Below this a trend says nothing.
const LEAST_TREND: u16 = 12;
/// From this width of a panel on its title says more.
const WIDTH_WITH_TREND_TITLE: u16 = 44;
/// From this on there is room for a gauge and a trend side by side.
const GAUGE_AND_TREND: u16 = 26;

/// How far back a trend goes \[ns\].
const TREND_NS: i64 = 120_000_000_000;
/// How far back the axis of a gauge looks \[ns\].
const GAUGE_LOOK_BACK_NS: i64 = 30_000_000_000;

/// A parameter as text.
struct ParameterText {
    name: String,
    mean: String,
    band: String,
    truth: String,
}

impl ParameterText {
    fn new(parameter: &Parameter, truth: Option<f64>, is_short: bool) -> Self {
        let Parameter { mean, low, high, .. } = *parameter;
        let digits = style::decimals(mean, 0.5 * (high - low));
        let number = |value| if is_short { style::short_number(value, digits) } else { style::number(value, digits) };
        let comma = if is_short { "," } else { ", " };
        Self {
            name: parameter.name.clone(),
            // Grey alone would not do for everyone.
            mean: number(mean) + if parameter.is_informed() { "" } else { "?" },
            band: format!("[{}{comma}{}]", number(low), number(high)),
            truth: truth.map(|v| format!("◆{}", number(v))).unwrap_or_default(),
        }
    }
}

/// Widths of the columns of [`ParameterText`].
#[derive(Clone, Copy)]
struct Columns {
    name: usize,
    mean: usize,
    band: usize,
    truth: usize,
}

impl Columns {
    fn of(texts: &[ParameterText]) -> Self {
        let widest = |field: fn(&ParameterText) -> &String| {
            texts.iter().map(|text| field(text).chars().count()).max().unwrap_or(0)
        };
        Self {
            name: widest(|t| &t.name),
            mean: widest(|t| &t.mean),
            band: widest(|t| &t.band),
            truth: widest(|t| &t.truth),
        }
    }

    fn without_truth(self) -> usize {
        self.name + self.mean + self.band + 3
    }

    fn with_truth(self) -> usize {
        self.without_truth() + self.truth
    }
}

/// Rows that the parameters need with the title, at so many each.
pub(super) fn rows(bed: &Bed, rows_each: u16) -> u16 {
    1 + rows_each * u16::try_from(bed.parameters.len().max(1)).unwrap_or(u16::MAX)
}

/// Name, mean, band, truth, and where there is room a gauge of the band and the trend.
pub(super) fn draw(buf: &mut Buffer, area: Rect, bed: &Bed, rows_each: u16) {
    let mut title = vec![Span::styled("parameters", style::STRONG), Span::styled(" mean [5 %, 95 %]", style::QUIET)];
    if rows_each > 1 && area.width >= WIDTH_WITH_TREND_TITLE {
        title.push(Span::styled("  trend 2 min", style::QUIET));
    }
    let inner = panel(buf, area, title);
    if bed.parameters.is_empty() {
        put(buf, inner, 0, Span::styled("none published", style::QUIET));
        return;
    }
    let truth = |p: &Parameter| bed.true_parameters.get(p.name.as_str()).copied();
    let as_text = |is_short| bed.parameters.iter().map(|p| ParameterText::new(p, truth(p), is_short)).collect();
    let mut texts: Vec<ParameterText> = as_text(false);
    if rows_each == 1 && Columns::of(&texts).with_truth() > usize::from(area.width) {
        texts = as_text(true);
    }
    let columns = Columns::of(&texts);
    let fit = usize::from(inner.height / rows_each);
    let shown = if fit < texts.len() { fit.saturating_sub(1) } else { texts.len() };
    for (row, (parameter, text)) in (0..).zip(bed.parameters.iter().zip(&texts).take(shown)) {
        let block = Rect { y: inner.y + row * rows_each, height: rows_each, ..inner };
        draw_parameter(buf, block, (parameter, text), truth(parameter), columns);
    }
    if shown < texts.len() {
        let row = rows_each * u16::try_from(shown).unwrap_or(u16::MAX);
        put(buf, inner, row, Span::styled(format!("+{} more", texts.len() - shown), style::QUIET));
    }
}

fn draw_parameter(
    buf: &mut Buffer,
    area: Rect,
    (parameter, text): (&Parameter, &ParameterText),
    truth: Option<f64>,
    columns: Columns,
) {
    let Columns { name, mean, band, truth: true_value } = columns;
    let grey = |look| if parameter.is_informed() { look } else { style::PAST };
    let mut spans = vec![
        Span::styled(format!("{:<name$} ", text.name), grey(style::INFERRED)),
        Span::styled(format!("{:>mean$} ", text.mean), grey(style::STRONG)),
        Span::styled(format!("{:>band$} ", text.band), grey(style::PLAIN)),
    ];
    let is_truth_inline = columns.with_truth() <= usize::from(area.width);
    if is_truth_inline {
        spans.push(Span::styled(format!("{:<true_value$} ", text.truth), style::TRUTH));
    }
    put(buf, area, 0, Line::from(spans));
    let used = if is_truth_inline { columns.with_truth() + 1 } else { columns.without_truth() };
    let used = u16::try_from(used).unwrap_or(u16::MAX).min(area.width);
    let rest = Rect { x: area.x + used, width: area.width - used, ..area };
    if area.height == 1 {
        draw_beside(buf, rest, parameter, truth);
        return;
    }
    let mut below = Rect { y: area.y + 1, height: 1, ..area };
    if rest.width >= LEAST_TREND {
        draw_trend(buf, rest, parameter);
        below.width = used - 1;
    } else {
        draw_trend(buf, Rect { y: area.y + 2, height: area.height - 2, ..area }, parameter);
    }
    if !is_truth_inline {
        put_right(buf, below, 0, Span::styled(text.truth.clone(), style::TRUTH));
        below.width = below.width.saturating_sub(u16::try_from(true_value).unwrap_or(u16::MAX).saturating_add(1));
    }
    draw_unit_and_gauge(buf, below, parameter, truth);
}

fn draw_unit_and_gauge(buf: &mut Buffer, area: Rect, parameter: &Parameter, truth: Option<f64>) {
    let text = if !parameter.is_identifiable {
        Span::styled("not identifiable ", style::QUIET)
    } else if parameter.since_informed_s.is_infinite() {
        Span::styled("uninformed ", style::WARNING)
    } else if !parameter.is_informed() {
        Span::styled(format!("uninformed {} ", style::duration(parameter.since_informed_s)), style::WARNING)
    } else {
        // As wide as the widest unit, so that the gauges stand in line.
        Span::styled(format!("{:<9} ", parameter.unit), style::QUIET)
    };
    let shift = u16::try_from(text.width()).unwrap_or(u16::MAX).min(area.width);
    put(buf, area, 0, text);
    draw_gauge(buf, Rect { x: area.x + shift, width: area.width - shift, ..area }, parameter, truth);
}

fn draw_beside(buf: &mut Buffer, area: Rect, parameter: &Parameter, truth: Option<f64>) {
    if area.width >= GAUGE_AND_TREND {
        let width = area.width / 2;
        draw_gauge(buf, Rect { width: width - 1, ..area }, parameter, truth);
        draw_trend(buf, Rect { x: area.x + width, width: area.width - width, ..area }, parameter);
    } else {
        draw_gauge(buf, area, parameter, truth);
    }
}

/// The range of a parameter since a time, its present values and its truth included.
///
/// The extreme tenths of the past may leave the picture, or else a wide first guess would rule it for minutes.
fn range(parameter: &Parameter, from_ns: i64, truth: Option<f64>) -> Option<(f64, f64)> {
    let past = |bound: fn(&Band) -> f32| {
        let mut values: Vec<f64> = parameter.trend.since(from_ns).map(|(_, b)| f64::from(bound(&b.band))).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (lows, highs) = (past(|b| b.low), past(|b| b.high));
    let extremes = [lows.get(lows.len() / 10), highs.iter().rev().nth(highs.len() / 10)];
    let all = extremes.into_iter().flatten().copied().chain([parameter.low, parameter.high]).chain(truth);
    let (low, high) = all.filter(|v| v.is_finite()).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    (low < high).then_some((low, high))
}

/// The band on an axis as wide as the bands were lately: `··━━●━━◆··`.
fn draw_gauge(buf: &mut Buffer, area: Rect, parameter: &Parameter, truth: Option<f64>) {
    let from_ns = parameter.trend.newest_ns().unwrap_or(i64::MIN).saturating_sub(GAUGE_LOOK_BACK_NS);
    let Some((low, high)) = range(parameter, from_ns, truth) else { return };
    if area.width < LEAST_GAUGE || area.height == 0 {
        return;
    }
    let cell = |v: f64| ((v - low) / (high - low) * f64::from(area.width - 1)).round();
    let at = |v: f64, column: u16| v.is_finite() && (cell(v) - f64::from(column)).abs() < 0.5;
    for column in 0..area.width {
        let is_within = (cell(parameter.low)..=cell(parameter.high)).contains(&f64::from(column));
        let (symbol, look) = match () {
            () if truth.is_some_and(|v| at(v, column)) => ("◆", style::TRUTH),
            () if at(parameter.mean, column) => {
                ("●", if parameter.is_informed() { style::STRONG } else { style::PAST })
            }
            () if is_within => ("━", if parameter.is_informed() { style::INFERRED } else { style::PAST }),
            () => ("·", style::RULE),
        };
        put(buf, Rect { x: area.x + column, width: 1, ..area }, 0, Span::styled(symbol, look));
    }
}

/// Mean and band of the last two minutes.
fn draw_trend(buf: &mut Buffer, area: Rect, parameter: &Parameter) {
    let Some(newest_ns) = parameter.trend.newest_ns() else { return };
    let from_ns = newest_ns.saturating_sub(TREND_NS);
    let Some((low, high)) = range(parameter, from_ns, None) else { return };
    let oldest_ns = parameter.trend.since(from_ns).next().map_or(newest_ns, |(t, _)| t);
    let (dots_x, dots_y) = (i64::from(area.width * DOTS_X), f64::from(area.height * DOTS_Y));
    let span_s = seconds(newest_ns.saturating_sub(oldest_ns)).max(1.0);
    let mut raster = Raster::new(area.width, area.height);
    let y = |v: f32| ((high - f64::from(v)) / (high - low) * (dots_y - 1.0)).round() as i64;
    let mut drawn = -1;
    for (t, point) in parameter.trend.since(from_ns) {
        let band = point.band;
        let x = (seconds(t.saturating_sub(oldest_ns)) / span_s * (dots_x - 1) as f64) as i64;
        for column in drawn + 1..=x {
            raster.column(Ink::Band, column, y(band.high), y(band.low));
            raster.set(Ink::Mean, column, y(band.mean));
        }
        drawn = drawn.max(x);
    }
    raster.paint(buf, area, |ink| if ink == Ink::Mean { style::INFERRED } else { style::RULE });
}
