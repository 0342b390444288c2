//! What is asked for at the bottom of the screen: a name to filter by, a note, an alarm to acknowledge.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

use super::super::errand::Errand;
use crate::estimate::time::EventTime;

/// Longest note \[characters\].
pub(super) const MAX_NOTE: usize = 500;
/// Longest part of a name to look for \[characters\].
const MAX_FILTER: usize = 40;

/// A question that has not been answered yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Prompt {
    /// Part of the names of the beds to list.
    Filter(String),
    /// A note about what was on the screen when it was begun.
    Note {
        /// The bed that it is about.
        bed: String,
        /// What was on the screen.
        time: EventTime,
        /// As far as it is written.
        text: String,
    },
    /// Which alarm to acknowledge.
    Acknowledge {
        /// The bed.
        bed: String,
        /// Names of those that wait, most urgent first.
        alarms: Vec<String>,
        /// Which of them is chosen; one more for all of them.
        at: usize,
    },
}

/// What a key made of a question.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Reply {
    /// It is still open.
    Open,
    /// It is answered, or withdrawn, and nothing is to be done.
    Closed {
        /// Whether it was withdrawn.
        is_withdrawn: bool,
    },
    /// Something is to be told to the daemon.
    Errand(Errand),
}

impl Prompt {
    /// Obeys a key.
    pub(super) fn press(&mut self, key: KeyEvent) -> Reply {
        match (key.code, &mut *self) {
            (KeyCode::Esc, _) => return Reply::Closed { is_withdrawn: true },
            (KeyCode::Enter, _) => return self.answer(),
            (_, Self::Filter(text)) => edit(text, key, MAX_FILTER),
            (_, Self::Note { text, .. }) => edit(text, key, MAX_NOTE),
            (code, Self::Acknowledge { alarms, at, .. }) => {
                let choices = choices(alarms);
                match code {
                    KeyCode::Down | KeyCode::Right | KeyCode::Tab => *at = (*at + 1) % choices,
                    KeyCode::Up | KeyCode::Left | KeyCode::BackTab => *at = (*at + choices - 1) % choices,
                    KeyCode::Char('A') => *at = choices - 1,
                    _ => {}
                }
            }
        }
        Reply::Open
    }

    fn answer(&self) -> Reply {
        match self {
            Self::Note { bed, time, text } if !text.trim().is_empty() => {
                Reply::Errand(Errand::Note { bed: bed.clone(), time: Some(*time), text: text.trim().to_owned() })
            }
            Self::Acknowledge { bed, alarms, at } => {
                let chosen = alarms.get(*at).map_or_else(|| alarms.clone(), |alarm| vec![alarm.clone()]);
                Reply::Errand(Errand::Acknowledge { bed: bed.clone(), alarms: chosen })
            }
            Self::Filter(_) | Self::Note { .. } => Reply::Closed { is_withdrawn: false },
        }
    }
}

/// Every alarm, and all of them where there are several.
pub(super) fn choices(alarms: &[String]) -> usize {
    alarms.len() + usize::from(alarms.len() > 1)
}

fn edit(text: &mut String, key: KeyEvent, longest: usize) {
    let is_command = key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT);
    match key.code {
        KeyCode::Backspace => drop(text.pop()),
        KeyCode::Char('u') if is_command => text.clear(),
        KeyCode::Char(c) if !is_command && !c.is_control() && text.chars().count() < longest => text.push(c),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn press(prompt: &mut Prompt, code: KeyCode) -> Reply {
        prompt.press(KeyEvent::new(code, KeyModifiers::NONE))
    }

    #[test]
    fn a_line_is_edited_and_has_an_end() {
        let mut prompt = Prompt::Filter(String::new());
        for _ in 0..100 {
            press(&mut prompt, KeyCode::Char('ä'));
        }
        assert_eq!(prompt, Prompt::Filter("ä".repeat(MAX_FILTER)));
        prompt.press(KeyEvent::new(KeyCode::Char('u'), KeyModifiers::CONTROL));
        for code in [KeyCode::Char('q'), KeyCode::Char('\u{1b}'), KeyCode::Char('x'), KeyCode::Backspace] {
            assert_eq!(press(&mut prompt, code), Reply::Open);
        }
        assert_eq!(prompt, Prompt::Filter("q".to_owned()));
    }

    #[test]
    fn an_empty_note_is_not_sent() {
        let mut prompt = Prompt::Note { bed: "bed1".to_owned(), time: EventTime(7), text: String::new() };
        press(&mut prompt, KeyCode::Char(' '));
        assert_eq!(press(&mut prompt, KeyCode::Enter), Reply::Closed { is_withdrawn: false });
        press(&mut prompt, KeyCode::Char('x'));
        let errand = Errand::Note { bed: "bed1".to_owned(), time: Some(EventTime(7)), text: "x".to_owned() };
        assert_eq!(press(&mut prompt, KeyCode::Enter), Reply::Errand(errand));
    }

    #[test]
    fn one_alarm_or_all_of_them_can_be_chosen() {
        let chosen = |names: &[&str], codes: &[KeyCode]| {
            let alarms = names.iter().map(|name| (*name).to_owned()).collect();
            let mut prompt = Prompt::Acknowledge { bed: "bed1".to_owned(), alarms, at: 0 };
            for code in codes {
                press(&mut prompt, *code);
            }
            match press(&mut prompt, KeyCode::Enter) {
                Reply::Errand(Errand::Acknowledge { alarms, .. }) => alarms,
                other => panic!("{other:?}"),
            }
        };
        let both = ["low", "high"];
        assert_eq!(chosen(&both, &[]), ["low"]);
        assert_eq!(chosen(&both, &[KeyCode::Down]), ["high"]);
        assert_eq!(chosen(&both, &[KeyCode::Up]), both);
        assert_eq!(chosen(&both, &[KeyCode::Char('A')]), both);
        assert_eq!(chosen(&both, &[KeyCode::Tab; 3]), ["low"]);
        assert_eq!(chosen(&["low"], &[KeyCode::Tab]), ["low"]);
    }
}
