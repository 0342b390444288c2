//! The columns of the ward: which fit into a width, and what stands in them.

use std::time::Duration;

use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, FORECAST_AFTER_S, Liveness, Quality};
use super::header::badge;
use super::values::beat_reading;
use super::{style, urgency};

/// What a column is about, in the order in which they stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Column {
    Bed,
    Alarm,
    State,
    Quality,
    Rate,
    Arterial,
    Pulmonary,
    Output,
    Svr,
    Pvr,
    Lag,
    Event,
}

/// What is worth its width, most worthy first; a column that is there already becomes wider.
const WORTH: [(Column, u16); 18] = [
    (Column::Bed, 10),
    (Column::Alarm, 5),
    (Column::Rate, 4),
    (Column::Arterial, 12),
    (Column::State, 9),
    (Column::Output, 12),
    (Column::Pulmonary, 10),
    (Column::Quality, 8),
    (Column::Svr, 13),
    (Column::Pvr, 13),
    (Column::Alarm, 18),
    (Column::Lag, 7),
    (Column::Arterial, LONG_PRESSURE),
    (Column::Pulmonary, LONG_PRESSURE),
    (Column::Event, 20),
    (Column::Bed, 16),
    (Column::Alarm, 28),
    (Column::State, 24),
];
/// From this width on a pressure has bands.
const LONG_PRESSURE: u16 = 22;
/// From this width on an alarm has a name.
const LONG_ALARM: usize = 12;
/// From this width on a state is told as in the header.
const LONG_STATE: usize = 20;

/// What a row is made from.
pub(super) struct Row<'a> {
    pub(super) name: &'a str,
    pub(super) bed: &'a Bed,
    pub(super) now: Duration,
    pub(super) is_chosen: bool,
}

/// The columns that fit, with their widths; the last one gets what is left.
pub(super) fn fitting(width: u16) -> Vec<(Column, u16)> {
    let mut columns: Vec<(Column, u16)> = Vec::new();
    let mut left = width + 1;
    for (column, wanted) in WORTH {
        let known = columns.iter_mut().find(|(known, _)| *known == column);
        let cost = known.as_ref().map_or(1 + wanted, |(_, width)| wanted - width);
        if cost > left {
            continue;
        }
        left -= cost;
        match known {
            Some((_, width)) => *width = wanted,
            None => columns.push((column, wanted)),
        }
    }
    columns.sort_unstable();
    if let Some((Column::Event, width)) = columns.last_mut() {
        *width += left;
    }
    columns
}

pub(super) fn heading(columns: &[(Column, u16)]) -> Line<'static> {
    line_of(columns, |column, _| (column.heading().to_owned(), style::QUIET))
}

pub(super) fn line(columns: &[(Column, u16)], row: &Row<'_>) -> Line<'static> {
    line_of(columns, |column, width| column.cell(row, width))
}

fn line_of(columns: &[(Column, u16)], cell: impl Fn(Column, usize) -> (String, Style)) -> Line<'static> {
    let spans = columns.iter().flat_map(|(column, width)| {
        let width = usize::from(*width);
        let (text, look) = cell(*column, width);
        let text = style::fit(&text, width);
        let padding = " ".repeat(width + 1 - text.chars().count());
        if column.is_number() {
            [Span::raw(padding[1..].to_owned()), Span::styled(text, look), Span::raw(" ")]
        } else {
            [Span::raw(""), Span::styled(text, look), Span::raw(padding)]
        }
    });
    Line::from(spans.collect::<Vec<_>>())
}

impl Column {
    /// Whether it stands at the right end of its column.
    fn is_number(self) -> bool {
        matches!(self, Self::Rate | Self::Lag)
    }

    fn heading(self) -> &'static str {
        match self {
            Self::Bed => "bed",
            Self::Alarm => "alarm",
            Self::State => "state",
            Self::Quality => "quality",
            Self::Rate => "HR",
            Self::Arterial => "ABP mmHg",
            Self::Pulmonary => "PAP mmHg",
            Self::Output => "CO L/min",
            Self::Svr => "SVR mmHg s/mL",
            Self::Pvr => "PVR mmHg s/mL",
            Self::Lag => "p99 ms",
            Self::Event => "last event",
        }
    }

    fn cell(self, row: &Row<'_>, width: usize) -> (String, Style) {
        let Row { name, bed, now, is_chosen } = *row;
        let is_live = bed.liveness(now).is_live();
        // What is no longer so must not look as if it were.
        let value = |text: String| (text, if is_live { style::PLAIN } else { style::PAST });
        match self {
            Self::Bed => (name.to_owned(), if is_chosen { style::STRONG } else { style::PLAIN }),
            Self::Alarm => alarm(bed, width),
            Self::State => state(bed, now, width),
            Self::Quality => quality(bed),
            Self::Rate => value(bed.heart_rate_bpm().map_or(style::NONE.to_owned(), |v| style::number(v, 0))),
            Self::Arterial => value(pressure(bed, "p_a", width)),
            Self::Pulmonary => value(pressure(bed, "p_pa", width)),
            Self::Output => value(of_beat(bed, "cardiac_output")),
            Self::Svr => value(of_beat(bed, "svr")),
            Self::Pvr => value(of_beat(bed, "pvr")),
            Self::Lag => {
                let lag = bed.status.as_ref().map(|s| s.lag_p99_ms);
                (lag.map_or(style::NONE.to_owned(), |ms| style::number(ms, usize::from(ms < 99.95))), style::QUIET)
            }
            Self::Event => {
                let last = bed.events.back();
                (last.map_or(String::new(), |e| format!("{} {} {}", e.kind, e.channel, e.text)), style::QUIET)
            }
        }
    }
}

fn of_beat(bed: &Bed, name: &str) -> String {
    let reading = bed.of_beat(name).map(beat_reading);
    reading.map_or(style::NONE.to_owned(), |(mean, half)| format!("{mean} {half}"))
}

/// As bedsides write it: `120/70 (90)`, with room also the bands: `120±2/70±1 (90±1)`.
fn pressure(bed: &Bed, name: &str, width: usize) -> String {
    let part = |part: &str| {
        let Some(reading) = bed.of_beat(&format!("{name}_{part}")) else { return style::NONE.to_owned() };
        let mean = style::number(f64::from(reading.band.mean), 0);
        let half = 0.5 * f64::from(reading.band.high - reading.band.low);
        if width < usize::from(LONG_PRESSURE) {
            return mean;
        }
        format!("{mean}±{}", style::short_number(half, usize::from(half < 0.95)))
    };
    match ["systolic", "diastolic", "mean"].map(part) {
        parts if parts.iter().all(|part| part == style::NONE) => style::NONE.to_owned(),
        [systolic, diastolic, mean] => format!("{systolic}/{diastolic} ({mean})"),
    }
}

fn alarm(bed: &Bed, width: usize) -> (String, Style) {
    let raised = urgency::raised(bed);
    // One that nobody has seen is not hidden behind one that somebody has.
    let unseen = raised.iter().find(|alarm| urgency::is_unseen(alarm));
    let Some(shown) = unseen.or(raised.first()) else { return (String::new(), style::QUIET) };
    let sign = urgency::sign(shown);
    if width < LONG_ALARM {
        return (sign.to_owned(), urgency::look(shown));
    }
    let others = if raised.len() > 1 { format!(" +{}", raised.len() - 1) } else { String::new() };
    let seen = if urgency::is_unseen(shown) { "" } else { " seen" };
    let room = width.saturating_sub(sign.chars().count() + 1 + seen.len() + others.len());
    (format!("{sign} {}{seen}{others}", style::fit(&shown.name, room)), urgency::look(shown))
}

fn state(bed: &Bed, now: Duration, width: usize) -> (String, Style) {
    let liveness = bed.liveness(now);
    let (long, look) = badge(liveness);
    if width >= LONG_STATE {
        return (long, look);
    }
    let short = match liveness {
        Liveness::Live { since_data_s } if since_data_s > FORECAST_AFTER_S => "FORECAST".to_owned(),
        Liveness::Live { .. } => "LIVE".to_owned(),
        Liveness::NoEstimate => "NO ESTIM.".to_owned(),
        Liveness::Stale(age) if age.as_secs() < 1000 => format!("STALE {:.0}s", age.as_secs_f64()),
        Liveness::Stale(_) | Liveness::NotHeard => "STALE".to_owned(),
    };
    (short, look)
}

/// How far a bed can be trusted, in a word.
pub(super) fn quality(bed: &Bed) -> (String, Style) {
    let (word, look) = match bed.quality().0 {
        Quality::Unknown => ("unknown", style::QUIET),
        Quality::Good => ("good", style::OBSERVED),
        Quality::Degraded => ("degraded", style::WARNING),
        Quality::Bad => ("bad", style::ALARM),
    };
    (word.to_owned(), look)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_fit_and_none_is_lost_on_a_wider_screen() {
        let mut before = 0;
        for width in 0..300 {
            let columns = fitting(width);
            let used: u16 = columns.iter().map(|(_, width)| 1 + width).sum();
            assert!(used <= width + 1, "{used} of {width}");
            assert!(columns.len() + 1 >= before, "{} after {before} at {width}", columns.len());
            before = columns.len();
        }
        let names = |width| fitting(width).into_iter().map(|(column, _)| column).collect::<Vec<_>>();
        use Column::{Alarm, Arterial, Bed, Event, Lag, Output, Pulmonary, Pvr, Quality, Rate, State, Svr};
        assert_eq!(names(78), [Bed, Alarm, State, Quality, Rate, Arterial, Pulmonary, Output]);
        assert_eq!(names(198), [Bed, Alarm, State, Quality, Rate, Arterial, Pulmonary, Output, Svr, Pvr, Lag, Event]);
    }
}
