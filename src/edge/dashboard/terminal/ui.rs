//! What the person at the keyboard has chosen.

use std::time::Duration;

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::super::bed::Bed;
use super::super::errand::{Errand, Outcome};
use super::super::ward::Ward;
use super::HISTORY_S;
use super::group::Group;
use super::order::{Order, listed, natural};
use super::pause::Frozen;
use super::prompt::{Prompt, Reply};
use super::urgency;
use crate::estimate::time::EventTime;

/// Time spans to choose from \[s\].
const SPANS_S: [u32; 7] = [2, 4, 6, 10, 15, 30, HISTORY_S as u32];
const USUAL_SPAN: usize = 2;
/// Rows of the list that a page key passes.
const PAGE: usize = 10;
/// How long it is said what has become of an errand, or until the next key.
const SAID_FOR: Duration = Duration::from_secs(10);

/// Whether to go on after a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Next {
    /// Go on.
    Continue,
    /// Leave.
    Quit,
    /// Tell the daemon.
    Tell(Errand),
}

/// A line at the bottom for a while.
struct Said {
    outcome: Outcome,
    until: Duration,
}

/// The choices.
pub(super) struct Ui {
    /// The bed asked for; without one, the first.
    bed: Option<String>,
    /// Whether the list of beds is shown instead of a bed.
    pub(super) is_list: bool,
    pub(super) order: Order,
    /// Part of the names of the beds that are listed.
    pub(super) filter: String,
    pub(super) frozen: Option<Frozen>,
    span: usize,
    pub(super) group: Group,
    /// Whether the sources of the uncertainty are shown in place of values.
    pub(super) shows_sources: bool,
    pub(super) shows_help: bool,
    pub(super) prompt: Option<Prompt>,
    said: Option<Said>,
    /// Messages that this screen was too slow for.
    pub(super) dropped: u64,
    /// Whether last values are still being asked for.
    pub(super) is_connecting: bool,
}

impl Ui {
    pub(super) fn new(bed: Option<&str>) -> Self {
        Self {
            bed: bed.map(str::to_owned),
            is_list: false,
            order: Order::Name,
            filter: String::new(),
            frozen: None,
            span: USUAL_SPAN,
            group: Group::Pressures,
            shows_sources: false,
            shows_help: false,
            prompt: None,
            said: None,
            dropped: 0,
            is_connecting: false,
        }
    }

    /// Time across the screen \[s\].
    pub(super) fn span_s(&self) -> u32 {
        SPANS_S[self.span]
    }

    /// Name of the bed that is chosen, heard or not.
    pub(super) fn bed_name<'a>(&'a self, ward: &'a Ward) -> Option<&'a str> {
        let first = || ward.beds.keys().min_by_key(|name| natural(name)).map(String::as_str);
        self.bed.as_deref().or_else(first)
    }

    /// The bed to draw, and the time for which to draw it.
    pub(super) fn shown<'a>(&'a self, ward: &'a Ward, now: Duration) -> Option<(&'a str, &'a Bed, Duration)> {
        if let Some(frozen) = &self.frozen {
            return Some((&frozen.name, frozen.shown(), frozen.at));
        }
        let (name, bed) = ward.beds.get_key_value(self.bed_name(ward)?)?;
        Some((name, bed, now))
    }

    /// What is to be said at the bottom, if anything.
    pub(super) fn said(&self, now: Duration) -> Option<&Outcome> {
        self.said.as_ref().filter(|said| now < said.until).map(|said| &said.outcome)
    }

    /// Says at the bottom what has become of something.
    pub(super) fn say(&mut self, outcome: Outcome, now: Duration) {
        self.said = Some(Said { outcome, until: now + SAID_FOR });
    }

    /// Obeys a key.
    pub(super) fn press(&mut self, key: KeyEvent, ward: &Ward, now: Duration) -> Next {
        if key.kind == KeyEventKind::Release {
            return Next::Continue;
        }
        if key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL) {
            return Next::Quit;
        }
        self.said = None;
        if let Some(prompt) = self.prompt.take() {
            return self.answer(prompt, key, ward, now);
        }
        if std::mem::take(&mut self.shows_help) {
            return Next::Continue;
        }
        match key.code {
            KeyCode::Char('q') => return Next::Quit,
            KeyCode::Esc if !self.is_list => return Next::Quit,
            KeyCode::Char('?') => self.shows_help = true,
            KeyCode::Char('b') => self.is_list = !self.is_list,
            KeyCode::Char('o') => self.order = self.order.next(),
            KeyCode::Char('/') => {
                self.is_list = true;
                self.prompt = Some(Prompt::Filter(self.filter.clone()));
            }
            KeyCode::Char('a') => self.ask_what_was_seen(ward, now),
            KeyCode::Char('n') => self.ask_for_note(ward, now),
            KeyCode::Tab | KeyCode::Down => self.step(ward, 1, now),
            KeyCode::BackTab | KeyCode::Up => self.step(ward, -1, now),
            code if self.is_list => self.press_in_list(code, ward, now),
            code => self.press_at_bed(code, ward, now),
        }
        Next::Continue
    }

    fn press_in_list(&mut self, code: KeyCode, ward: &Ward, now: Duration) {
        match code {
            KeyCode::Esc | KeyCode::Enter => self.is_list = false,
            KeyCode::PageDown => self.jump(ward, now, |at, last| (at + PAGE).min(last)),
            KeyCode::PageUp => self.jump(ward, now, |at, _| at.saturating_sub(PAGE)),
            KeyCode::Home => self.jump(ward, now, |_, _| 0),
            KeyCode::End => self.jump(ward, now, |_, last| last),
            _ => {}
        }
    }

    fn press_at_bed(&mut self, code: KeyCode, ward: &Ward, now: Duration) {
        match code {
            KeyCode::Char('p' | ' ') if self.frozen.is_none() => self.freeze(ward, now),
            KeyCode::Char('p' | ' ' | 'l') | KeyCode::End => self.frozen = None,
            KeyCode::Left | KeyCode::Right => self.scrub(code == KeyCode::Left, ward, now),
            KeyCode::Char('+' | '=') => self.span = (self.span + 1).min(SPANS_S.len() - 1),
            KeyCode::Char('-' | '_') => self.span = self.span.saturating_sub(1),
            KeyCode::Char('f') => self.group = self.group.next(),
            KeyCode::Char('u') => self.shows_sources = !self.shows_sources,
            _ => {}
        }
    }

    fn answer(&mut self, mut prompt: Prompt, key: KeyEvent, ward: &Ward, now: Duration) -> Next {
        let reply = prompt.press(key);
        if let Prompt::Filter(text) = &mut prompt {
            if reply == (Reply::Closed { is_withdrawn: true }) {
                text.clear();
            }
            self.filter.clone_from(text);
            self.jump(ward, now, |at, _| at);
        }
        match reply {
            Reply::Open => self.prompt = Some(prompt),
            Reply::Closed { .. } => {}
            Reply::Errand(errand) => {
                self.say(Outcome { text: errand.announcement(), is_failure: false }, now);
                return Next::Tell(errand);
            }
        }
        Next::Continue
    }

    fn ask_what_was_seen(&mut self, ward: &Ward, now: Duration) {
        let Some((name, ..)) = self.shown(ward, now) else { return };
        // Of the present, also where a past is shown: that is what the daemon knows.
        let alarms = ward.beds.get(name).map(urgency::raised).unwrap_or_default();
        let waiting = alarms.into_iter().filter(|alarm| urgency::is_unseen(alarm));
        let alarms: Vec<String> = waiting.map(|alarm| alarm.name.clone()).collect();
        let bed = name.to_owned();
        if alarms.is_empty() {
            self.say(Outcome { text: format!("no alarm of {bed} waits to be acknowledged"), is_failure: false }, now);
        } else {
            self.prompt = Some(Prompt::Acknowledge { bed, alarms, at: 0 });
        }
    }

    fn ask_for_note(&mut self, ward: &Ward, now: Duration) {
        let Some((name, bed, at)) = self.shown(ward, now) else { return };
        let (name, time) = (name.to_owned(), bed.newest_ns(at).map(EventTime));
        match time {
            Some(time) => self.prompt = Some(Prompt::Note { bed: name, time, text: String::new() }),
            None => {
                let text = format!("nothing is known of {name} yet that a note could be about");
                self.say(Outcome { text, is_failure: true }, now);
            }
        }
    }

    /// Goes to the next or the previous bed, around the ends.
    fn step(&mut self, ward: &Ward, by: isize, now: Duration) {
        let beds = listed(ward, self.order, &self.filter, now);
        let at = beds.iter().position(|(name, _)| Some(*name) == self.bed_name(ward));
        let Some(last) = beds.len().checked_sub(1) else { return };
        let to = match (at, by > 0) {
            (Some(at), true) if at < last => at + 1,
            (Some(at), false) if at > 0 => at - 1,
            (Some(_) | None, true) => 0,
            (Some(_) | None, false) => last,
        };
        let name = beds[to].0.to_owned();
        self.go_to(name, ward, now);
    }

    /// Goes to another place in the list; from outside of it, to its first bed.
    fn jump(&mut self, ward: &Ward, now: Duration, to: impl Fn(usize, usize) -> usize) {
        let beds = listed(ward, self.order, &self.filter, now);
        let Some(last) = beds.len().checked_sub(1) else { return };
        let at = beds.iter().position(|(name, _)| Some(*name) == self.bed_name(ward));
        let name = beds[at.map_or(0, |at| to(at, last))].0.to_owned();
        self.go_to(name, ward, now);
    }

    fn go_to(&mut self, name: String, ward: &Ward, now: Duration) {
        if self.bed.as_ref() == Some(&name) {
            return;
        }
        self.bed = Some(name);
        if self.frozen.is_some() {
            self.freeze(ward, now);
        }
    }

    fn freeze(&mut self, ward: &Ward, now: Duration) {
        let chosen = self.bed_name(ward).and_then(|name| ward.beds.get_key_value(name));
        self.frozen = chosen.map(|(name, bed)| Frozen::new(name, bed, now));
    }

    /// Goes through the past by a quarter of the screen.
    fn scrub(&mut self, to_the_past: bool, ward: &Ward, now: Duration) {
        if self.frozen.is_none() && to_the_past {
            self.freeze(ward, now);
        }
        let quarter_ns = i64::from(self.span_s()) * 250_000_000;
        let Some(frozen) = &mut self.frozen else { return };
        if !frozen.scrub(if to_the_past { -quarter_ns } else { quarter_ns }, quarter_ns) && to_the_past {
            let text = format!("this is the oldest that is kept, {HISTORY_S} s at most");
            self.say(Outcome { text, is_failure: false }, now);
        }
    }
}
