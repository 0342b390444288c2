//! The panel of health: how the estimator does, its channels, and this screen.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::{Bed, seconds};
use super::super::ward::Ward;
use super::paper::{panel, put};
use super::style::{self, count};
use super::ui::Ui;
use crate::edge::wire::{ChannelStatus, Status};

/// Innovations beyond this factor of what is expected are marked.
const MISFIT: f64 = 1.5;
/// Status is sent once a second; older than this, it is marked.
const STATUS_OVERDUE: Duration = Duration::from_secs(3);

/// Text of labels and values: labels quiet, values plain, those that worry marked.
#[derive(Default)]
struct Facts(Vec<Span<'static>>);

impl Facts {
    fn add(mut self, label: &'static str, value: impl Into<String>, worries: bool) -> Self {
        let gap = if self.0.is_empty() { "" } else { " " };
        self.0.push(Span::styled(format!("{gap}{label} "), style::QUIET));
        let value = if worries { format!("{}!", value.into()) } else { value.into() };
        self.0.push(Span::styled(value, if worries { style::WARNING } else { style::PLAIN }));
        self
    }

    fn line(self) -> Line<'static> {
        Line::from(self.0)
    }
}

/// The health of the estimator and of this screen, most important first.
pub(super) fn lines(bed: &Bed, ward: &Ward, ui: &Ui, now: Duration) -> Vec<Line<'static>> {
    let mut lines = Vec::new();
    match &bed.status {
        None => lines.push(Line::styled("no status yet", style::QUIET)),
        Some(status) => {
            lines.extend(solver_health(status));
            lines.extend(status.channels.iter().map(|c| channel_health(c, status)));
            lines.extend(counters(&status.counters));
        }
    }
    if let Some(age) = bed.status_arrival.map(|at| now.saturating_sub(at)).filter(|age| *age > STATUS_OVERDUE) {
        let text = format!("status {} old!", style::duration(age.as_secs_f64()));
        lines.insert(0, Line::styled(text, style::WARNING));
    }
    let screen = [("dropped", ui.dropped), ("unreadable", ward.unreadable), ("beds refused", ward.refused)];
    for (what, n) in screen.into_iter().filter(|(_, n)| *n > 0) {
        lines.push(Facts::default().add("this screen:", format!("{} {what}", count(n)), true).line());
    }
    lines
}

fn solver_health(status: &Status) -> Vec<Line<'static>> {
    let ms = |value: f64| style::number(value, if value < 9.995 { 2 } else { usize::from(value < 99.95) });
    vec![
        Facts::default()
            .add(
                "members",
                format!("{}/{}", status.members_alive, status.members),
                status.members_alive < status.members,
            )
            .add("queue", count(status.queue_depth.into()), false)
            .add("iter", style::number(status.iterations, 1), false)
            .line(),
        Facts::default()
            .add("windows", count(status.windows), false)
            .add("without data", count(status.windows_without_data), false)
            .line(),
        Facts::default()
            .add("lag p50", ms(status.lag_p50_ms), false)
            .add("p99", ms(status.lag_p99_ms), false)
            .add("max", ms(status.lag_max_ms), false)
            .line(),
        Facts::default()
            .add("solve", ms(status.solve_ms), false)
            .add("not converged", count(status.not_converged), status.not_converged > 0)
            .line(),
    ]
}

fn channel_health(channel: &ChannelStatus, status: &Status) -> Line<'static> {
    let is_set_aside = !channel.artefact.is_empty();
    let is_used = channel.state == "live" && !is_set_aside;
    let silence_s = seconds(status.header.time_ns.saturating_sub(channel.last_sample_ns));
    let state = match channel.state.as_str() {
        "live" if is_set_aside => channel.artefact.clone(),
        "silent" if silence_s < 10.0 => format!("silent {silence_s:.0} s"),
        "silent" => format!("silent {}", style::duration(silence_s)),
        other => other.to_owned(),
    };
    let rms = channel.innovation_rms;
    let mut spans = vec![
        Span::styled(format!("{:<5}", channel.name), style::OBSERVED),
        Span::styled(format!("{state:<11} "), if is_used { style::PLAIN } else { style::WARNING }),
    ];
    let mut fit = Facts::default().add("rms", style::number(rms, 2), rms > MISFIT);
    if channel.misfit {
        fit.0.push(Span::styled(" misfit!", style::WARNING));
    }
    spans.extend(fit.add("n", count(channel.samples_used), false).0);
    Line::from(spans)
}

/// Causes and counts, as many per line as a narrow panel takes.
fn counters(counters: &[(String, u64)]) -> Vec<Line<'static>> {
    const LINE: usize = 30;
    let mut lines: Vec<String> = Vec::new();
    for (cause, n) in counters {
        let text = format!("{cause} {}", count(*n));
        match lines.last_mut() {
            Some(line) if line.chars().count() + text.chars().count() + 2 <= LINE => {
                line.push_str("  ");
                line.push_str(&text);
            }
            _ => lines.push(text),
        }
    }
    lines.into_iter().map(|line| Line::styled(line, style::WARNING)).collect()
}

/// Writes the health lines.
pub(super) fn draw(buf: &mut Buffer, area: Rect, lines: Vec<Line<'static>>) {
    let inner =
        panel(buf, area, vec![Span::styled("health", style::STRONG), Span::styled(" lag, solve in ms", style::QUIET)]);
    for (row, line) in (0..inner.height).zip(lines) {
        put(buf, inner, row, line);
    }
}
