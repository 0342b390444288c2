//! Beat by beat: what clinicians read off a pressure curve, for every member, so that each figure has its band.

use super::statistics::Summary;
use super::time::EventTime;
use crate::model::Extent;
use crate::model::lanes::{InstructionSet, Lanes, WIDTH};

/// A beat that is over.
#[derive(Debug, Clone, PartialEq)]
pub struct BeatEstimate {
    /// Its onset.
    pub start: EventTime,
    /// The onset of the next.
    pub end: EventTime,
    /// One per clinical quantity of the model.
    pub values: Vec<Summary>,
}

/// What the quantities of eight members have done since the beat began, `[n_quantities]` each, states first.
#[derive(Debug, Default)]
pub(super) struct Curve {
    /// At the last look.
    now: Vec<[f64; WIDTH]>,
    smallest: Vec<[f64; WIDTH]>,
    largest: Vec<[f64; WIDTH]>,
    integral: Vec<[f64; WIDTH]>,
    first: Vec<[f64; WIDTH]>,
}

impl Clone for Curve {
    fn clone(&self) -> Self {
        let mut clone = Self::default();
        clone.clone_from(self);
        clone
    }

    /// Into the vectors that are there.
    fn clone_from(&mut self, other: &Self) {
        let Self { now, smallest, largest, integral, first } = other;
        self.now.clone_from(now);
        self.smallest.clone_from(smallest);
        self.largest.clone_from(largest);
        self.integral.clone_from(integral);
        self.first.clone_from(first);
    }
}

impl Curve {
    /// Looks at where they are now: `x` and `derived`.
    pub(super) fn look(&mut self, x: &[Lanes], derived: &[Lanes]) {
        self.now.clear();
        self.now.extend(x.iter().chain(derived).map(|lanes| lanes.0));
    }

    /// A member takes the place of another one, but for what it did before.
    pub(super) fn replace(&mut self, lane: usize, (donor, of): (&Self, usize)) {
        self.now.iter_mut().zip(&donor.now).for_each(|(own, donor)| own[lane] = donor[of]);
    }

    /// A beat begins where they are now.
    pub(super) fn begin(&mut self) {
        for rows in [&mut self.smallest, &mut self.largest, &mut self.first] {
            rows.clone_from(&self.now);
        }
        self.integral.clear();
        self.integral.resize(self.now.len(), [0.0; WIDTH]);
    }

    /// Takes in where they are now, which stands for the last `dt_s`.
    pub(super) fn take_in(&mut self, dt_s: f64, instructions: InstructionSet) {
        instructions.run(TakeIn { curve: self, dt_s });
    }

    /// What one quantity of a member did in a beat of `duration_s` that ends now.
    pub(super) fn extent(&self, quantity: usize, lane: usize, duration_s: f64) -> Extent {
        let of = |rows: &[[f64; WIDTH]]| rows[quantity][lane];
        Extent {
            min: of(&self.smallest),
            max: of(&self.largest),
            mean: of(&self.integral) / duration_s,
            change: of(&self.now) - of(&self.first),
        }
    }
}

/// What runs in code for an instruction set.
struct TakeIn<'a> {
    curve: &'a mut Curve,
    dt_s: f64,
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for TakeIn<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { curve: Curve { now, smallest, largest, integral, .. }, dt_s } = self;
        // Flat: of rows of eight, the compiler would make gathers across them.
        let now = now.as_flattened();
        for (smallest, now) in smallest.as_flattened_mut().iter_mut().zip(now) {
            *smallest = if *now < *smallest { *now } else { *smallest };
        }
        for (largest, now) in largest.as_flattened_mut().iter_mut().zip(now) {
            *largest = if *now > *largest { *now } else { *largest };
        }
        for (integral, now) in integral.as_flattened_mut().iter_mut().zip(now) {
            *integral += now * dt_s;
        }
    }
}

/// Counts beats by the clock of the ensemble.
#[derive(Debug, Clone, Default)]
pub(super) struct BeatCounter {
    /// Time and beats counted, when last heard of.
    last: Option<(EventTime, f64)>,
    /// Onset of the beat under way \[s\]; None before the first onset seen.
    onset_s: Option<f64>,
    /// What the last look stands for \[s\], as long as it is not in the curves.
    pub(super) due_s: Option<f64>,
}

/// A beat has begun.
#[derive(Debug, Clone, Copy)]
pub(super) struct Onset {
    /// When \[s\].
    pub(super) at_s: f64,
    /// When the one before it did, if that was seen.
    pub(super) before_s: Option<f64>,
}

impl BeatCounter {
    /// After a look at a time when the clock says how many beats there were and how fast they follow each other \[1/s\].
    pub(super) fn look(&mut self, time: EventTime, (beats, rate_hz): (f64, f64)) -> Option<Onset> {
        self.due_s = None;
        let (before, beats_before) = self.last.replace((time, beats))?;
        let dt_s = time.as_s() - before.as_s();
        let mut onset = None;
        if beats.floor() > beats_before.floor() {
            // The onset lies between two looks; flows through the outlets are zero there.
            let at_s = time.as_s() - ((beats - beats.floor()) / rate_hz).min(dt_s);
            onset = Some(Onset { at_s, before_s: self.onset_s.replace(at_s) });
        }
        self.due_s = self.onset_s.map(|_| dt_s);
        onset
    }
}
