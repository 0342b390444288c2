//! Colours and numbers.
//!
//! Colours are the Okabe-Ito set, nearest of the 256 that every terminal has, on black; none carries a meaning
//! that a word or a shape does not carry as well.

use ratatui::style::{Color, Modifier, Style};

pub(super) const BACKGROUND: Color = Color::Indexed(16);
const WHITE: Color = Color::Indexed(254);
const GREY: Color = Color::Indexed(246);
const DARK_GREY: Color = Color::Indexed(240);
const SKY_BLUE: Color = Color::Indexed(81);
const BLUISH_GREEN: Color = Color::Indexed(43);
const ORANGE: Color = Color::Indexed(214);
const YELLOW: Color = Color::Indexed(227);
const VERMILLION: Color = Color::Indexed(202);

pub(super) const SCREEN: Style = Style::new().fg(WHITE).bg(BACKGROUND);
pub(super) const BOLD: Style = Style::new().add_modifier(Modifier::BOLD);
pub(super) const STRONG: Style = Style::new().fg(WHITE).add_modifier(Modifier::BOLD);
pub(super) const PLAIN: Style = Style::new().fg(WHITE);
pub(super) const QUIET: Style = Style::new().fg(GREY);
/// What was, and may be no longer.
pub(super) const PAST: Style = Style::new().fg(GREY).remove_modifier(Modifier::BOLD);
pub(super) const RULE: Style = Style::new().fg(DARK_GREY);
pub(super) const OBSERVED: Style = Style::new().fg(BLUISH_GREEN);
pub(super) const INFERRED: Style = Style::new().fg(SKY_BLUE);
pub(super) const BAND: Style = Style::new().fg(Color::Indexed(242));
pub(super) const SAMPLE: Style = Style::new().fg(WHITE);
pub(super) const TRUTH: Style = Style::new().fg(ORANGE).add_modifier(Modifier::BOLD);
pub(super) const WARNING: Style = Style::new().fg(YELLOW).add_modifier(Modifier::BOLD);
pub(super) const ALARM: Style = Style::new().fg(BACKGROUND).bg(YELLOW).add_modifier(Modifier::BOLD);
pub(super) const GOOD: Style = Style::new().fg(BACKGROUND).bg(BLUISH_GREEN).add_modifier(Modifier::BOLD);
/// Alarms that nobody has seen, by priority.
pub(super) const HIGH: Style = Style::new().fg(BACKGROUND).bg(VERMILLION).add_modifier(Modifier::BOLD);
pub(super) const MEDIUM: Style = ALARM;
pub(super) const LOW: Style = Style::new().fg(BACKGROUND).bg(SKY_BLUE).add_modifier(Modifier::BOLD);
/// The same, once they have been seen.
pub(super) const HIGH_SEEN: Style = Style::new().fg(VERMILLION).add_modifier(Modifier::BOLD);
pub(super) const MEDIUM_SEEN: Style = WARNING;
pub(super) const LOW_SEEN: Style = Style::new().fg(SKY_BLUE).add_modifier(Modifier::BOLD);
/// Sources of uncertainty.
pub(super) const EPISTEMIC: Style = INFERRED;
pub(super) const ALEATORIC: Style = OBSERVED;
pub(super) const MODEL: Style = Style::new().fg(ORANGE);
/// Over what else is on the screen.
pub(super) const HELP: Style = Style::new().fg(WHITE).bg(Color::Indexed(236));
pub(super) const KEY: Style = Style::new().fg(BACKGROUND).bg(GREY);

/// What stands in place of a number that is not there.
pub(super) const NONE: &str = "–";

/// Digits after the point that make `value` readable to two digits of `resolution`, and no longer than needed.
pub(super) fn decimals(value: f64, resolution: f64) -> usize {
    let magnitude = |v: f64| if v.is_finite() && v.abs() > 0.0 { v.abs().log10().floor() } else { 0.0 };
    let by_resolution = if resolution.is_finite() && resolution > 0.0 { 1.0 - magnitude(resolution) } else { 3.0 };
    let by_length = 3.0 - magnitude(value);
    by_resolution.min(by_length.max(0.0)).clamp(0.0, 5.0) as usize
}

/// A number with so many digits after the point; huge ones in powers of ten.
pub(super) fn number(value: f64, decimals: usize) -> String {
    match value {
        v if !v.is_finite() => NONE.to_owned(),
        v if v.abs() >= 1e6 => format!("{v:.1e}"),
        v => {
            let text = format!("{v:.decimals$}");
            // A minus before nothing but zeros says nothing.
            let is_zero = text.bytes().all(|b| matches!(b, b'-' | b'0' | b'.'));
            if is_zero { text.trim_start_matches('-').to_owned() } else { text }
        }
    }
}

/// The same without the zero before the point.
pub(super) fn short_number(value: f64, decimals: usize) -> String {
    let text = number(value, decimals);
    match text.strip_prefix('-').unwrap_or(&text).strip_prefix("0.") {
        Some(digits) if text.starts_with('-') => format!("-.{digits}"),
        Some(digits) => format!(".{digits}"),
        None => text,
    }
}

/// A count in about four characters: where it is cut off at the edge, it would be a wrong one.
pub(super) fn count(n: u64) -> String {
    match n as f64 {
        _ if n < 10_000 => n.to_string(),
        v if v < 1e6 => format!("{:.0}k", v / 1e3),
        v if v < 1e7 => format!("{:.1}M", v / 1e6),
        v if v < 1e9 => format!("{:.0}M", v / 1e6),
        v if v < 1e12 => format!("{:.0}G", v / 1e9),
        v => format!("{v:.0e}"),
    }
}

/// A duration \[s\] in a few characters.
pub(super) fn duration(seconds: f64) -> String {
    match seconds {
        s if !s.is_finite() => NONE.to_owned(),
        s if s < 10.0 => format!("{s:.1} s"),
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.0} h", s / 3600.0),
    }
}

/// `text` in at most so many characters; where it is cut, it shows.
pub(super) fn fit(text: &str, longest: usize) -> String {
    if text.chars().count() <= longest {
        return text.to_owned();
    }
    text.chars().take(longest.saturating_sub(1)).chain((longest > 0).then_some('…')).collect()
}

/// So many beds, in words.
pub(super) fn beds(count: usize) -> String {
    if count == 1 { "1 bed".to_owned() } else { format!("{count} beds") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_as_long_as_their_band_is_wide() {
        let shown = |value: f64, half: f64| number(value, decimals(value, half));
        assert_eq!(shown(0.08, 0.0043), "0.0800");
        assert_eq!(shown(1.6, 0.21), "1.60");
        assert_eq!(shown(72.0, 0.000_1), "72.00");
        assert_eq!(shown(3001.4, 12.0), "3001");
        assert_eq!(shown(f64::NAN, 1.0), NONE);
        assert_eq!(shown(1e300, 1.0), "1.0e300");
        assert_eq!([number(-0.04, 1), number(-0.06, 1)], ["0.0", "-0.1"]);
        assert_eq!([short_number(0.25, 2), short_number(-0.25, 2), short_number(10.25, 2)], [".25", "-.25", "10.25"]);
    }

    #[test]
    fn what_is_cut_shows_it() {
        assert_eq!(["abc", "abcd", "äöüß"].map(|text| fit(text, 3)), ["abc", "ab…", "äö…"]);
        assert_eq!([0, 1].map(|longest| fit("ab", longest)), ["", "…"]);
    }
}
