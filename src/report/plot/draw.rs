//! From figures to SVG: panels and matrices. Lengths in px.

use super::axis::decimal;
use super::chart;
use super::render::{Canvas, Font};
use super::{Figure, HeatMap, Panel, PlotError};

use kurbo::Rect;

/// Width and height.
const PANEL: (f64, f64) = (420.0, 300.0);

/// Height of the heading of a figure.
const HEADING_ROOM: f64 = 34.0;

/// Between anything and its neighbour.
pub(super) const GAP: f64 = 6.0;

/// The longest name of a row or column of a matrix.
const NAME_WIDTH: f64 = 110.0;

const HEADING: Font = Font { size: 15.0, bold: true, ..TICK };
const TITLE: Font = Font { size: 12.0, bold: true, ..TICK };
pub(super) const LABEL: Font = Font { size: 11.0, ..TICK };
pub(super) const TICK: Font = Font { size: 10.0, bold: false, upright: false, colour: "#222" };

const MISSING: &str = "#ececec";
const POSITIVE: [u8; 3] = [178, 24, 43];
const NEGATIVE: [u8; 3] = [33, 102, 172];

/// Lays out a figure.
pub(super) fn figure(figure: &Figure) -> Result<String, PlotError> {
    let columns = figure.columns.clamp(1, figure.panels.len().max(1));
    let rows = figure.panels.len().div_ceil(columns).max(1);
    let top = if figure.title.is_empty() { 0.0 } else { HEADING_ROOM };
    let width = PANEL.0 * columns as f64;
    let mut canvas = Canvas::new(width, top + PANEL.1 * rows as f64)?;
    canvas.text(&figure.title, (0.5 * width, 0.6 * top), HEADING, "middle", width - 4.0 * GAP);
    for column in 0..columns {
        // Panels above each other share their left border.
        let panels = figure.panels.iter().skip(column).step_by(columns);
        let gutter = panels.clone().map(|panel| gutter(&canvas, panel)).fold(0.0, f64::max);
        for (row, panel) in panels.enumerate() {
            let room = Rect::from_origin_size((PANEL.0 * column as f64, top + PANEL.1 * row as f64), PANEL);
            match panel {
                Panel::Chart(chart) => chart::draw(&mut canvas, chart, &room, gutter)?,
                Panel::Heat(map) => heat_map(&mut canvas, map, &room, gutter),
            }
        }
    }
    Ok(canvas.svg + "</svg>\n")
}

/// Room a panel needs left of its axes.
fn gutter(canvas: &Canvas, panel: &Panel) -> f64 {
    let (names, label) = match panel {
        Panel::Chart(chart) => (chart::y_names(chart), &*chart.y_label),
        Panel::Heat(map) => (map.rows.clone(), ""),
    };
    2.0 * GAP + widest(canvas, &names) + if label.is_empty() { GAP } else { LABEL.size + 2.0 * GAP }
}

/// Room the longest name gets.
fn widest(canvas: &Canvas, names: &[String]) -> f64 {
    names.iter().map(|name| canvas.width(name, TICK)).fold(0.0, f64::max).min(NAME_WIDTH)
}

/// Writes the title of a panel; the result is what that, tick labels and the `gutter` on the left leave of its `room`.
pub(super) fn plot_area(canvas: &mut Canvas, title: &str, room: &Rect, gutter: f64) -> Rect {
    let (left, right) = (room.x0 + gutter, room.x1 - 2.5 * GAP);
    let area = Rect::new(left, room.y0 + GAP + 1.6 * TITLE.size, right, room.y1 - 2.5 * GAP - TICK.size);
    let at = (area.center().x, area.y0 - GAP - 0.5 * TITLE.size);
    canvas.text(title, at, TITLE, "middle", 2.0 * (room.x1 - at.0) - GAP);
    area
}

fn heat_map(canvas: &mut Canvas, map: &HeatMap, room: &Rect, gutter: f64) {
    let mut area = plot_area(canvas, &map.title, room, gutter);
    let (rows, columns) = (map.rows.len(), map.columns.len());
    let width = area.width() / columns.max(1) as f64;
    let widest = widest(canvas, &map.columns);
    let upright = widest + GAP > width;
    area.y1 -= if upright { widest - TICK.size } else { 0.0 };
    let height = area.height() / rows.max(1) as f64;
    let middle =
        |row: usize, column: usize| (area.x0 + width * (column as f64 + 0.5), area.y0 + height * (row as f64 + 0.5));
    for (row, name) in map.rows.iter().enumerate() {
        canvas.text(name, (area.x0 - GAP, middle(row, 0).1), TICK, "end", NAME_WIDTH);
    }
    let (below, anchor) = if upright { (GAP, "end") } else { (GAP + 0.5 * TICK.size, "middle") };
    for (column, name) in map.columns.iter().enumerate() {
        canvas.text(name, (middle(0, column).0, area.y1 + below), Font { upright, ..TICK }, anchor, NAME_WIDTH);
    }
    for i in 0..rows * columns {
        let value = map.values.get(i).copied().filter(|value| value.is_finite());
        let size = (width - 1.0, height - 1.0);
        cell(canvas, value, &Rect::from_center_size(middle(i / columns, i % columns), size));
    }
}

fn cell(canvas: &mut Canvas, value: Option<f64>, area: &Rect) {
    canvas.fill(area, &value.map_or_else(|| MISSING.to_owned(), diverging), 1.0);
    let text = value.map_or_else(|| "–".to_owned(), |value| decimal(value, 2));
    // A number must not be cut.
    let size = TICK.size * ((area.width() - 2.0) / canvas.width(&text, TICK)).clamp(0.5, 1.0);
    let colour = if value.is_some_and(|value| value.abs() > 0.75) { "#fff" } else { TICK.colour };
    let at = (area.center().x, area.center().y);
    canvas.text(&text, at, Font { size, colour, ..TICK }, "middle", f64::INFINITY);
}

/// White at 0, saturated at -1 and 1.
fn diverging(value: f64) -> String {
    let end = if value < 0.0 { NEGATIVE } else { POSITIVE };
    let share = value.abs().min(1.0);
    let [red, green, blue] = end.map(|channel| (255.0 - share * (255.0 - f64::from(channel))).round() as u8);
    format!("#{red:02x}{green:02x}{blue:02x}")
}
