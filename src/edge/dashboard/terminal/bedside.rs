//! One bed: what stands where.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::ui::Ui;
use super::{alarms, health, log, parameters, sources, style, traces, values};

/// From this width on there is a column of panels beside the traces.
const WIDTH_WITH_PANELS: u16 = 76;
/// From this height on the events stand below the traces, not below everything.
const TALL: u16 = 31;
const TRACES: u16 = 6;
/// Alarms that always have a row.
const LEAST_ALARMS: usize = 4;
const LEAST_HEALTH: u16 = 5;

/// The bed that is shown, and the time for which.
#[derive(Clone, Copy)]
pub(super) struct Shown<'a> {
    pub(super) name: &'a str,
    pub(super) bed: &'a Bed,
    pub(super) at: Duration,
    /// The time at which it is looked at.
    pub(super) now: Duration,
}

/// Traces, panels and the log.
pub(super) fn draw(buf: &mut Buffer, area: Rect, shown: Shown<'_>, ward: &Ward, ui: &Ui) {
    let panel_width = match area.width {
        0..WIDTH_WITH_PANELS => 0,
        w if w < 100 => 33,
        w => (w * 7 / 20).min(80),
    };
    let is_tall = area.height >= TALL;
    let gap = u16::from(panel_width > 0);
    let mut left = Rect { width: area.width - panel_width - gap, ..area };
    let mut right = Rect { x: left.right() + gap, width: panel_width, ..area };
    let log_height = log_height(area.height);
    let split = area.height - log_height;
    left.height = split;
    if !is_tall {
        right.height = split;
    }
    let log_width = if is_tall { left.width } else { area.width };
    let log = Rect { y: area.y + split, height: log_height, width: log_width, ..area };
    let picture = traces::Picture { group: ui.group, span_s: ui.span_s(), is_past: ui.frozen.is_some() };
    traces::draw(buf, left, shown.bed, picture, shown.at);
    log::draw(buf, log, shown.bed);
    if panel_width > 0 {
        draw_panels(buf, right, shown, ward, ui);
    }
}

/// What the traces leave, which share out whole rows among themselves and prefer to be high.
fn log_height(height: u16) -> u16 {
    const LEAST: u16 = 2;
    const LOWEST_TRACE: u16 = 2;
    let without_titles = height.saturating_sub(1 + LEAST);
    let each = without_titles / TRACES;
    if each < LOWEST_TRACE {
        return 0;
    }
    let axis = u16::from(height > 1 + LEAST + 1 + 3 * TRACES);
    let each = if axis == 1 { (without_titles - 1) / TRACES } else { each };
    // A few more events are worth more than the tenth row of a trace.
    let each = each.min(3 + height / 10);
    height - 1 - axis - each * TRACES
}

/// Rows of the panels; that of health gets the rest.
struct Rows {
    parameters: u16,
    per_parameter: u16,
    alarms: u16,
    beat: u16,
    /// Values, or sources.
    numbers: u16,
}

impl Rows {
    fn share_out(height: u16, bed: &Bed, present: &Bed, shows_sources: bool, health: u16) -> Self {
        const MORE_PER_PARAMETER: [u16; 5] = [6, 5, 4, 3, 2];
        let alarms = alarms::rows(present, LEAST_ALARMS).min(height.saturating_sub(LEAST_HEALTH));
        let one_each = parameters::rows(bed, 1).min(height - alarms);
        let rest = height - alarms - one_each;
        let numbers = match (shows_sources, rest >= values::ROWS + LEAST_HEALTH) {
            (true, _) => sources::ROWS.min(rest),
            (false, true) => values::ROWS,
            (false, false) => 0,
        };
        // Channels, the last of health, are worth more than a beat beside other numbers.
        let health_beside = if numbers > 0 && !shows_sources { health.max(LEAST_HEALTH) } else { LEAST_HEALTH };
        let has_room = rest >= numbers + values::BEAT_ROWS + health_beside;
        let beat = if has_room && bed.has_beats() { values::BEAT_ROWS } else { 0 };
        let mut spare = rest.saturating_sub(numbers + beat + health);
        let mut take = |wanted: u16| {
            let taken = wanted.min(spare);
            spare -= taken;
            taken
        };
        let more_sources = sources::ALL_ROWS - sources::ROWS;
        let numbers = numbers + if shows_sources && take(more_sources) == more_sources { more_sources } else { 0 };
        // Room for what is the matter with the most urgent ones, whether it is needed now or not: panels stand still.
        let all_alarms = alarms::rows(present, usize::MAX);
        let alarms = alarms + take((all_alarms - alarms) + 2 * LEAST_ALARMS.min(usize::from(all_alarms)) as u16);
        let fits = |rows: &u16| parameters::rows(bed, *rows) <= one_each + spare;
        let per_parameter = MORE_PER_PARAMETER.into_iter().find(fits).unwrap_or(1);
        let parameters = if per_parameter > 1 { parameters::rows(bed, per_parameter) } else { one_each };
        Self { parameters, per_parameter, alarms, beat, numbers }
    }
}

fn draw_panels(buf: &mut Buffer, area: Rect, shown: Shown<'_>, ward: &Ward, ui: &Ui) {
    let Shown { name, bed, at, now } = shown;
    // Alarms are those of the present whatever is shown beside them: a pause must hide none.
    let present = ward.beds.get(name).unwrap_or(bed);
    let health = health::lines(bed, ward, ui, at);
    let health_rows = 1 + u16::try_from(health.len()).unwrap_or(u16::MAX);
    let rows = Rows::share_out(area.height, bed, present, ui.shows_sources, health_rows);
    let mut top = area.y;
    let mut next = |height: u16| {
        let part = Rect { y: top, height, ..area }.intersection(area);
        top += height;
        part
    };
    alarms::draw_panel(buf, next(rows.alarms), present, present.newest_ns(now), ui.frozen.is_some());
    let estimates = Rect { y: area.y + rows.alarms, height: rows.parameters + rows.beat + rows.numbers, ..area };
    parameters::draw(buf, next(rows.parameters), bed, rows.per_parameter);
    if rows.beat > 0 {
        values::draw_beat(buf, next(rows.beat), bed);
    }
    if rows.numbers > 0 {
        let numbers = next(rows.numbers);
        if ui.shows_sources {
            sources::draw(buf, numbers, bed, ui.group);
        } else {
            values::draw(buf, numbers, bed, ui.group);
        }
    }
    if !bed.liveness(at).is_live() {
        buf.set_style(estimates.intersection(area), style::PAST);
    }
    health::draw(buf, next(area.bottom().saturating_sub(estimates.bottom())), health);
}
