//! The last line: the keys, or what is asked or said; and the help over everything.

use std::time::Duration;

use ratatui::buffer::Buffer;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::bed::event_time;
use super::HISTORY_S;
use super::paper::{panel, put, put_right};
use super::prompt::{MAX_NOTE, Prompt, choices};
use super::style;
use super::ui::Ui;

/// What the keys do at a bed, shortest; `?` stands first so that no screen is too narrow for it.
fn at_bed(ui: &Ui) -> Vec<(&'static str, String, String)> {
    let both = |text: &str| (text.to_owned(), text.to_owned());
    let entry = |key, (short, long)| (key, short, long);
    let pause = if ui.frozen.is_some() { ("l", "live") } else { ("p", "hold") };
    let span = format!("{} s", ui.span_s());
    vec![
        entry("?", both("help")),
        entry("q", both("quit")),
        entry("Tab", ("bed".to_owned(), "next bed".to_owned())),
        entry("b", both("beds")),
        entry(pause.0, (pause.1.to_owned(), if ui.frozen.is_some() { "live" } else { "pause" }.to_owned())),
        entry("←→", ("time".to_owned(), "back in time".to_owned())),
        entry("+-", (span.replace(' ', ""), span)),
        entry("f", ("flows".to_owned(), "pressures/flows/volumes".to_owned())),
        entry("u", ("split".to_owned(), if ui.shows_sources { "values" } else { "uncertainty" }.to_owned())),
        entry("a", ("ack".to_owned(), "acknowledge".to_owned())),
        entry("n", both("note")),
    ]
}

fn in_list(ui: &Ui) -> Vec<(&'static str, String, String)> {
    let order = if ui.order == super::order::Order::Name { "alarms first" } else { "by name" };
    [
        ("?", "help", "help"),
        ("q", "quit", "quit"),
        ("↑↓", "bed", "choose"),
        ("Enter", "open", "open"),
        ("o", order, order),
        ("/", "find", "find by name"),
        ("a", "ack", "acknowledge"),
        ("n", "note", "note"),
    ]
    .map(|(key, short, long)| (key, short.to_owned(), long.to_owned()))
    .to_vec()
}

/// What is asked, or said, or else the keys.
pub(super) fn draw(buf: &mut Buffer, area: Rect, ui: &Ui, now: Duration) {
    if let Some(prompt) = &ui.prompt {
        draw_prompt(buf, area, prompt);
    } else if let Some(outcome) = ui.said(now) {
        let look = if outcome.is_failure { style::ALARM } else { style::GOOD };
        buf.set_style(area, look);
        put(buf, area, 0, Span::styled(format!(" {}", outcome.text), look));
    } else {
        draw_keys(buf, area, &if ui.is_list { in_list(ui) } else { at_bed(ui) });
    }
}

fn draw_keys(buf: &mut Buffer, area: Rect, keys: &[(&'static str, String, String)]) {
    let long = Line::from_iter(keys.iter().flat_map(|(key, _, long)| {
        [Span::styled(format!(" {key} "), style::KEY), Span::styled(format!(" {long} "), style::QUIET)]
    }));
    let short = || {
        Line::from_iter(keys.iter().flat_map(|(key, short, _)| {
            [Span::styled(*key, style::KEY), Span::styled(format!(" {short} "), style::QUIET)]
        }))
    };
    put(buf, area, 0, if long.width() <= usize::from(area.width) { long } else { short() });
}

fn draw_prompt(buf: &mut Buffer, area: Rect, prompt: &Prompt) {
    let (question, text, hint) = match prompt {
        Prompt::Filter(text) => ("beds with".to_owned(), text.clone(), "Enter keeps, Esc shows all".to_owned()),
        Prompt::Note { bed, time, text } => {
            let left = MAX_NOTE.saturating_sub(text.chars().count());
            let hint =
                if left < 100 { format!("{left} left, Enter sends, Esc") } else { "Enter sends, Esc".to_owned() };
            (format!("note on {} at {}", style::fit(bed, 12), event_time(time.0)), text.clone(), hint)
        }
        Prompt::Acknowledge { bed, alarms, at } => {
            let what = alarms.get(*at).cloned().unwrap_or_else(|| format!("all {}", alarms.len()));
            let others = if alarms.len() > 1 { "↑↓ other, A all, " } else { "" };
            let n = choices(alarms);
            let place = if n > 1 { format!(" {}/{n}", at + 1) } else { String::new() };
            (format!("acknowledge in {}{place}", style::fit(bed, 12)), what, format!("{others}Enter sends, Esc"))
        }
    };
    let question = format!(" {question} ");
    let hint = format!(" {hint} ");
    let room = usize::from(area.width).saturating_sub(question.chars().count() + hint.chars().count() + 2);
    // The end of a long text is where it is written.
    let skipped = text.chars().count().saturating_sub(room);
    let text: String = text.chars().skip(skipped).collect();
    let spans = [
        Span::styled(question, style::ALARM),
        Span::styled(format!(" {text}"), style::STRONG),
        Span::styled(if matches!(prompt, Prompt::Acknowledge { .. }) { "" } else { "▏" }, style::WARNING),
    ];
    put(buf, area, 0, Line::from_iter(spans));
    put_right(buf, area, 0, Span::styled(hint, style::QUIET));
}

/// Every key and every sign, over the middle of the screen.
pub(super) fn draw_help(buf: &mut Buffer, area: Rect) {
    const WIDTH: u16 = 74;
    let rows = help();
    let height = (2 + u16::try_from(rows.len()).unwrap_or(u16::MAX)).min(area.height);
    let width = WIDTH.min(area.width);
    let place = Rect { x: area.x + (area.width - width) / 2, y: area.y + (area.height - height) / 2, width, height };
    for row in 0..height {
        put(buf, place, row, " ".repeat(usize::from(width)));
    }
    buf.set_style(place, style::HELP);
    let inner =
        panel(buf, place, vec![Span::styled("help", style::STRONG), Span::styled(" any key closes it", style::QUIET)]);
    for (row, (keys, meaning)) in (0..inner.height).zip(rows) {
        let line = vec![Span::styled(format!(" {keys:<16}"), style::STRONG), Span::styled(meaning, style::PLAIN)];
        put(buf, inner, row, Line::from(line));
    }
}

fn help() -> Vec<(&'static str, String)> {
    let text = |(keys, meaning): (&'static str, &str)| (keys, meaning.to_owned());
    let mut rows: Vec<(&'static str, String)> = [
        ("q  Ctrl-C", "quit; Esc too, at a bed"),
        ("b  Enter  Esc", "list of beds and back"),
        ("Tab Shift-Tab ↑↓", "next and previous bed; PgUp PgDn Home End in the list"),
        ("o", "order of the list: by name, or the most urgent alarm first"),
        ("/", "list only beds with a text in their name; Esc lists all"),
        ("a", "acknowledge an alarm (↑↓ chooses, A all, Enter sends)"),
        ("n", "write a note about what is shown (Enter sends)"),
        ("p  Space", "pause and go on"),
        ("←  →", "back and forth in time by a quarter of the width; ← pauses"),
        ("l  End", "live again"),
    ]
    .map(text)
    .to_vec();
    rows.push(("", format!("{HISTORY_S} s of the past are kept; alarms are always those of now")));
    rows.extend(
        [
            ("+  -", "more or less time across"),
            ("f", "pressures, flows or volumes as waveforms"),
            ("u", "where the uncertainty comes from, in place of values"),
            ("▲!!! ◆!! ●!", "alarm of high, medium, low priority; a block until acknowledged"),
            ("○", "quiet alarm with its limit, or pending: beyond it, not for long"),
            ("◆12.3", "truth of a synthetic patient"),
            ("?", "after a parameter and grey: data do not say what it is"),
        ]
        .map(text),
    );
    rows
}
