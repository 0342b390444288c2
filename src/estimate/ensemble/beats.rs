//! The beats of the members, right also where windows are solved again by another clock.

use super::Ensemble;
use super::review::REMEMBERED_S;
use crate::estimate::batch::{Look, read};
use crate::estimate::beat::{BeatCounter, BeatEstimate};
use crate::estimate::statistics::summarise;
use crate::estimate::time::{EventTime, ns_from_s};
use crate::estimate::timing::TimingSource;
use crate::model::Model;

/// Pressures are looked at this often \[ns\], or at the end of every window where that is less often.
const LOOK_NS: i64 = 4_000_000;

/// What is known of the beat under way.
#[derive(Debug, Clone)]
pub(super) struct Beats {
    /// Taken back with the members when windows are solved again; what they did meanwhile is with the members.
    pub(super) counter: BeatCounter,
    /// How far the clock of each member was ahead of that of the ensemble when the beat began \[beats\].
    pub(super) ahead: Vec<f64>,
    /// End of the last window.
    pub(super) end: EventTime,
    /// Beats that are over and not told yet.
    over: Vec<BeatEstimate>,
    /// A beat that began before was told already.
    told_to: EventTime,
}

impl Beats {
    /// Forgets the beat under way.
    pub(super) fn begin_again(&mut self) {
        self.counter = BeatCounter::default();
    }

    /// Forgets what ended after `time`, which is looked at again.
    pub(super) fn take_back(&mut self, time: EventTime) {
        self.over.retain(|beat| beat.end <= time);
    }
}

impl<M: Model> Ensemble<M> {
    /// Reads what is clinical off every beat from now on; `start` is where the next window begins.
    pub fn follow_beats(&mut self, start: EventTime) {
        self.beats = Some(Beats {
            counter: BeatCounter::default(),
            ahead: Vec::new(),
            end: start,
            over: Vec::new(),
            told_to: EventTime(i64::MIN),
        });
    }

    /// Beats that are over and were not told yet. Where clocks may be set in what was solved already, a beat is told when
    /// that can no longer happen to it, or when this is the `last` time.
    pub fn take_beats(&mut self, last: bool) -> Vec<BeatEstimate> {
        let may_change = self.settings.live.timing != TimingSource::Clock && !last;
        let Some(beats) = &mut self.beats else { return Vec::new() };
        let settled = if may_change { beats.end.plus_ns(-ns_from_s(REMEMBERED_S)) } else { beats.end };
        let (now, later): (Vec<_>, Vec<_>) = beats.over.drain(..).partition(|beat| beat.end <= settled);
        beats.over = later;
        if let Some(beat) = now.last() {
            // Half a beat: what is found again in a second look begins a little earlier or later.
            beats.told_to = beat.start.plus_ns(beat.end.ns_since(beat.start) / 2);
        }
        now
    }

    /// What members are to look at by the end of the next window.
    pub(super) fn next_look(&self) -> Look {
        let Some(beats) = self.beats.as_ref().filter(|_| self.listening) else { return Look::default() };
        let end = beats.end.plus_ns(self.settings.window.length_ns);
        Look { is_due: beats.end.0.div_euclid(LOOK_NS) != end.0.div_euclid(LOOK_NS), last_s: beats.counter.due_s }
    }

    /// Counts on to the end of the window that was just solved; members have looked at it.
    pub(super) fn follow(&mut self) {
        let look = self.next_look();
        if look.is_due && !self.settings.coupling.is_xtfc() {
            let (tools, batches, _) = self.take_apart();
            batches.iter_mut().for_each(|batch| batch.look(&tools));
        }
        let Some(beats) = &mut self.beats else { return };
        beats.end = beats.end.plus_ns(self.settings.window.length_ns);
        let end = beats.end;
        if !self.listening {
            // Before the beat is found, clocks say nothing.
            beats.begin_again();
        }
        if !look.is_due {
            return;
        }
        let (Some(clock), Some(beats)) = (self.cycles().zip(self.rate_hz()), &mut self.beats) else { return };
        let Some(onset) = beats.counter.look(end, clock) else { return };
        let ahead = self.ahead_of(clock.0);
        let over = onset.before_s.map(|start_s| self.read_beat((start_s, onset.at_s), &ahead));
        self.batches.iter_mut().for_each(|batch| batch.curve.begin());
        let Some(beats) = &mut self.beats else { return };
        beats.over.extend(over.filter(|beat| beat.start >= beats.told_to));
        beats.ahead = ahead;
    }

    /// What members have looked at last goes into what they remember of the beat.
    pub(super) fn take_in_looks(&mut self) {
        let Some(dt_s) = self.beats.as_mut().and_then(|beats| beats.counter.due_s.take()) else { return };
        for batch in &mut self.batches {
            batch.curve.take_in(dt_s, self.settings.instructions);
        }
    }

    /// How far the clock of each member is ahead of one that says `beats`.
    fn ahead_of(&self, beats: f64) -> Vec<f64> {
        let phase = self.model.cycle().map(|cycle| cycle.phase);
        phase.map_or_else(Vec::new, |phase| self.parameter_of_members(phase).map(|own| own - beats).collect())
    }

    /// Reads the figures of the beat that ends now off what every member did.
    fn read_beat(&self, (start_s, end_s): (f64, f64), ahead: &[f64]) -> BeatEstimate {
        let (model, members, n) = (&self.model, self.len(), self.model.n_states());
        let (n_derived, n_clinical) = (model.derived().len(), model.clinical().len());
        let before = self.beats.as_ref().map_or(&[][..], |beats| &beats.ahead);
        let duration_s = end_s - start_s;
        let mut figures = vec![0.0; n_clinical * members];
        let (mut theta, mut row) = (Vec::new(), vec![0.0; n_clinical]);
        let places = self.batches.iter().flat_map(|batch| (0..batch.len()).map(move |lane| (batch, lane)));
        for (i, (batch, lane)) in places.enumerate() {
            let whole = |q: usize| batch.curve.extent(q, lane, duration_s);
            let (states, derived): (Vec<_>, Vec<_>) =
                ((0..n).map(whole).collect(), (n..n + n_derived).map(whole).collect());
            // The extents are those of the same stretch of time for all; a member thinks that it was a little more or less
            // than one beat.
            let gained = ahead.get(i).zip(before.get(i)).map_or(0.0, |(now, before)| now - before);
            read(&batch.theta, lane, &mut theta);
            model.read_cycle(duration_s / (1.0 + gained).max(0.1), &theta, &states, &derived, &mut row);
            row.iter().enumerate().for_each(|(k, value)| figures[k * members + i] = *value);
        }
        BeatEstimate {
            start: EventTime::from_s(start_s),
            end: EventTime::from_s(end_s),
            values: figures.chunks_exact_mut(members).map(|values| summarise(values, 0.0, 0.0)).collect(),
        }
    }
}
