//! What the person at the keyboard has chosen.

use std::ops::{Bound, Range};
use std::time::Duration;

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::HISTORY_S;
use crate::model::cvsim6::Pressures;

/// Time spans to choose from \[s\].
const SPANS_S: [u32; 7] = [2, 4, 6, 10, 15, 30, HISTORY_S as u32];
const USUAL_SPAN: usize = 2;

/// Quantities that are drawn together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Group {
    /// The six pressures.
    Pressures,
    /// The six flows.
    Flows,
    /// The six volumes.
    Volumes,
}

impl Group {
    pub(super) const ALL: [Self; 3] = [Self::Pressures, Self::Flows, Self::Volumes];

    /// Positions of its quantities.
    pub(super) fn quantities(self) -> Range<usize> {
        let first = self as usize * Pressures::LEN;
        first..first + Pressures::LEN
    }

    pub(super) fn of(quantity: usize) -> Self {
        Self::ALL.into_iter().find(|g| g.quantities().contains(&quantity)).unwrap_or(Self::Pressures)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Pressures => "pressures",
            Self::Flows => "flows",
            Self::Volumes => "volumes",
        }
    }

    pub(super) fn unit(self) -> &'static str {
        match self {
            Self::Pressures => "mmHg",
            Self::Flows => "mL/s",
            Self::Volumes => "mL",
        }
    }

    /// Shortest vertical axis: less than this is no movement worth filling the height with.
    pub(super) fn least_range(self) -> f64 {
        match self {
            Self::Pressures => 2.0,
            Self::Flows => 20.0,
            Self::Volumes => 8.0,
        }
    }

    fn next(self) -> Self {
        match self {
            Self::Pressures => Self::Flows,
            Self::Flows => Self::Volumes,
            Self::Volumes => Self::Pressures,
        }
    }
}

/// A bed as it was when the display was stopped.
pub(super) struct Frozen {
    pub(super) name: String,
    pub(super) bed: Bed,
    pub(super) at: Duration,
}

/// Whether to go on after a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Next {
    /// Go on.
    Continue,
    /// Leave.
    Quit,
}

/// The choices.
pub(super) struct Ui {
    /// The bed asked for; without one, the first.
    bed: Option<String>,
    /// Whether the list of beds is shown instead of a bed.
    pub(super) is_list: bool,
    pub(super) frozen: Option<Frozen>,
    span: usize,
    pub(super) group: Group,
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
            frozen: None,
            span: USUAL_SPAN,
            group: Group::Pressures,
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
        self.bed.as_deref().or_else(|| ward.beds.keys().next().map(String::as_str))
    }

    /// The bed to draw, and the time for which to draw it.
    pub(super) fn shown<'a>(&'a self, ward: &'a Ward, now: Duration) -> Option<(&'a str, &'a Bed, Duration)> {
        if let Some(Frozen { name, bed, at }) = &self.frozen {
            return Some((name, bed, *at));
        }
        let (name, bed) = ward.beds.get_key_value(self.bed_name(ward)?)?;
        Some((name, bed, now))
    }

    /// Obeys a key.
    pub(super) fn press(&mut self, key: KeyEvent, ward: &Ward, now: Duration) -> Next {
        if key.kind == KeyEventKind::Release {
            return Next::Continue;
        }
        match key.code {
            KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => return Next::Quit,
            KeyCode::Char('q') => return Next::Quit,
            KeyCode::Esc if !self.is_list => return Next::Quit,
            KeyCode::Esc | KeyCode::Enter => self.is_list = false,
            KeyCode::Char('b') => self.is_list = !self.is_list,
            KeyCode::Tab | KeyCode::Right | KeyCode::Down => self.step(ward, true, now),
            KeyCode::BackTab | KeyCode::Left | KeyCode::Up => self.step(ward, false, now),
            KeyCode::Char('p' | ' ') => match self.frozen {
                Some(_) => self.frozen = None,
                None => self.freeze(ward, now),
            },
            KeyCode::Char('+' | '=') => self.span = (self.span + 1).min(SPANS_S.len() - 1),
            KeyCode::Char('-' | '_') => self.span = self.span.saturating_sub(1),
            KeyCode::Char('f') => self.group = self.group.next(),
            _ => {}
        }
        Next::Continue
    }

    /// Goes to the next or the previous bed, around the ends.
    fn step(&mut self, ward: &Ward, forward: bool, now: Duration) {
        let current = self.bed_name(ward).unwrap_or_default();
        let after = || ward.beds.range::<str, _>((Bound::Excluded(current), Bound::Unbounded)).next();
        let before = || ward.beds.range::<str, _>((Bound::Unbounded, Bound::Excluded(current))).next_back();
        let to = if forward {
            after().or_else(|| ward.beds.first_key_value())
        } else {
            before().or_else(|| ward.beds.last_key_value())
        };
        let Some((name, _)) = to else { return };
        self.bed = Some(name.clone());
        if self.frozen.is_some() {
            self.freeze(ward, now);
        }
    }

    fn freeze(&mut self, ward: &Ward, now: Duration) {
        let chosen = self.bed_name(ward).and_then(|name| ward.beds.get_key_value(name));
        self.frozen = chosen.map(|(name, bed)| Frozen { name: name.clone(), bed: bed.clone(), at: now });
    }
}
