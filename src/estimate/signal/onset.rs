//! When the beats begin in a pressure waveform, and how fast they follow each other.
//!
//! The waveform is taken as linear between its samples, with the integral `I(t)`. The edge
//!
//! ```text
//! E(t) = mean over (t, t + w] - mean over (t - w, t] = [I(t + w) - 2 I(t) + I(t - w)] / w
//! ```
//!
//! is then continuous in `t`, whatever the sample rate and however irregular the spacing. A beat begins where `E` has
//! a maximum above a threshold: a share of what was usual lately. Its time is the vertex of a parabola fitted to `E`
//! over `w` around the maximum, which averages noise that would move the maximum itself.
//!
//! A beat is reported `1.5 w` to `2 w` and a sample after its steepest upstroke, a weak one `w / 2` later. The usual
//! edge is a median over beats, so a spike or a flush counts as one beat; when nothing comes, the threshold falls until
//! something does. The first 1.6 s teach what is usual; then they are gone through again, for the beats in them.
//! There is no clock here, and whether a channel is to be trusted is not asked.

use std::collections::VecDeque;
use std::f64::consts::SQRT_2;

/// A silence longer than this is not bridged by a straight line: half of the shortest beat.
const GAP_S: f64 = 0.15;

/// Samples closer than this add nothing and are skipped, which bounds the memory.
const MIN_SPACING_S: f64 = 0.000_5;

/// What the fit reaches back for, in lengths of the edge window, with one sample to spare.
const SPAN: f64 = 4.0;

/// The largest edge of this long is the first idea of what is usual: one beat at 40 per minute.
const LEARNING_S: f64 = 1.6;

/// Without a beat for this long (40 per minute), the threshold begins to fall,
const PATIENCE_S: f64 = 1.5;

/// by a factor of e in this time: half a second later a beat of a third of the usual edge is found.
const FORGETTING_S: f64 = 1.0;

/// Edges of pure noise are below this many standard deviations of theirs.
const NOISE_SDS: f64 = 4.0;

/// Median of the absolute second difference of white noise of unit standard deviation: 0.674 √6.
const NOISE_CURVATURE: f64 = 1.652;

/// Share of the usual edge below which a beat is weak: pulses with a slow foot have a first, smaller maximum there.
const WEAK: f64 = 0.6;

/// Beats over which the usual edge and interval are medians: two odd ones change nothing.
const MEMORY: usize = 5;

/// Points of the fit to either side of the maximum.
const FIT_SIDE: i32 = 4;

/// Longer intervals (20 per minute) are pauses or missing data.
const LONGEST_INTERVAL_S: f64 = 3.0;

/// How beats are found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OnsetSettings {
    /// Length `w` of the means before and after the edge: about the upstroke.
    pub window_s: f64,
    /// Share of the usual edge from which on it is a beat: above rebounds of the notch, below weak premature beats.
    pub threshold: f64,
    /// No beat follows another sooner.
    pub refractory_s: f64,
    /// Smaller edges are never beats. \[mmHg\]
    pub smallest_mmhg: f64,
}

impl Default for OnsetSettings {
    fn default() -> Self {
        Self { window_s: 0.05, threshold: 0.35, refractory_s: 0.25, smallest_mmhg: 0.5 }
    }
}

/// The beginning of a beat.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Onset {
    /// When the upstroke is steepest.
    pub time_s: f64,
    /// The edge there. \[mmHg\]
    pub strength: f64,
}

#[derive(Debug, Clone, Copy)]
struct Sample {
    time_s: f64,
    value: f64,
    /// Of the waveform, since the last gap. \[mmHg s\]
    integral: f64,
}

/// Finds the beats of one channel.
#[derive(Debug, Clone)]
pub struct OnsetDetector {
    settings: OnsetSettings,
    /// Ascending in time, without gaps.
    samples: VecDeque<Sample>,
    /// Largest edge of an upstroke that is not over.
    peak: Option<Onset>,
    /// What was reported last.
    last_s: Option<f64>,
    /// Since when a beat is waited for.
    waiting_since_s: Option<f64>,
    /// The largest edge so far, until enough is seen.
    learning: Option<f64>,
    /// Everything taken in while learning; and beats found in it, to be reported one by one.
    early: Vec<(f64, f64)>,
    found: VecDeque<Onset>,
    /// Edges of the last beats.
    strengths: Recent,
    /// Running median of the absolute second difference. \[mmHg\]
    curvature: f64,
}

impl OnsetDetector {
    /// Nothing seen yet.
    #[must_use]
    pub fn new(settings: OnsetSettings) -> Self {
        Self {
            settings,
            samples: VecDeque::new(),
            peak: None,
            last_s: None,
            waiting_since_s: None,
            learning: Some(0.0),
            early: Vec::new(),
            found: VecDeque::new(),
            strengths: Recent::default(),
            curvature: 0.0,
        }
    }

    /// Takes the next sample; the beat that it confirms, if any. Samples that go back in time are skipped, unless
    /// they go back by more than a gap: then time has changed.
    pub fn take(&mut self, time_s: f64, value: f64) -> Option<Onset> {
        if !(time_s.is_finite() && value.is_finite()) {
            return None;
        }
        if let Some(last) = self.samples.back() {
            let step_s = time_s - last.time_s;
            if step_s.abs() > GAP_S {
                self.start_again(step_s < 0.0);
            } else if step_s < MIN_SPACING_S {
                return None;
            }
        }
        if self.learning.is_some() {
            self.early.push((time_s, value));
        }
        let now = self.take_sample(time_s, value);
        self.found.extend(now);
        self.found.pop_front()
    }

    fn take_sample(&mut self, time_s: f64, value: f64) -> Option<Onset> {
        self.push(time_s, value);
        self.listen_to_noise();
        let at_s = time_s - self.settings.window_s;
        let strength = self.edge(at_s)?;
        self.follow(Onset { time_s: at_s, strength })
    }

    /// Goes through what it learnt from once more, now that it knows what is usual.
    fn look_again(&mut self) {
        let mut again = Self {
            learning: None,
            strengths: std::mem::take(&mut self.strengths),
            curvature: self.curvature,
            ..Self::new(self.settings)
        };
        for (time_s, value) in std::mem::take(&mut self.early) {
            let onset = again.take_sample(time_s, value);
            again.found.extend(onset);
        }
        // What was only learnt has become a beat.
        if again.strengths.values.len() > 1 {
            again.strengths.values.pop_front();
        }
        *self = again;
    }

    fn start_again(&mut self, time_changed: bool) {
        self.samples.clear();
        self.early.clear();
        self.peak = None;
        self.waiting_since_s = None;
        if time_changed {
            self.last_s = None;
        }
    }

    fn push(&mut self, time_s: f64, value: f64) {
        let added = self.samples.back().map_or(0.0, |s| s.integral + 0.5 * (s.value + value) * (time_s - s.time_s));
        self.samples.push_back(Sample { time_s, value, integral: added });
        let oldest_s = time_s - SPAN * self.settings.window_s;
        while self.samples.get(1).is_some_and(|s| s.time_s <= oldest_s) {
            self.samples.pop_front();
        }
    }

    /// The running median goes up or down by a share of itself, so that a spike weighs no more than anything else.
    fn listen_to_noise(&mut self) {
        let n = self.samples.len();
        if n < 3 {
            return;
        }
        let [a, b, c] = [n - 3, n - 2, n - 1].map(|i| self.samples[i].value);
        let size = (a - 2.0 * b + c).abs();
        let step = if size > self.curvature { 1.02 } else { 1.0 / 1.02 };
        self.curvature = (self.curvature * step).clamp(1e-3, 1e3);
    }

    /// `I(t)` for a time within the samples.
    fn integral(&self, time_s: f64) -> Option<f64> {
        let after = self.samples.partition_point(|s| s.time_s <= time_s);
        let a = self.samples.get(after.checked_sub(1)?)?;
        let Some(b) = self.samples.get(after) else {
            return Some(a.integral);
        };
        let passed_s = time_s - a.time_s;
        let slope = (b.value - a.value) / (b.time_s - a.time_s);
        Some(a.integral + passed_s * (a.value + 0.5 * passed_s * slope))
    }

    /// `E(t)`, where the samples reach far enough.
    fn edge(&self, time_s: f64) -> Option<f64> {
        let w = self.settings.window_s;
        Some((self.integral(time_s + w)? - 2.0 * self.integral(time_s)? + self.integral(time_s - w)?) / w)
    }

    fn follow(&mut self, now: Onset) -> Option<Onset> {
        let waiting_since_s = *self.waiting_since_s.get_or_insert(now.time_s);
        if let Some(largest) = self.learning {
            let largest = largest.max(now.strength);
            self.learning = Some(largest);
            if now.time_s - waiting_since_s >= LEARNING_S {
                self.learning = None;
                self.strengths.push(largest);
                self.look_again();
            }
            return None;
        }
        match self.peak {
            Some(peak) if now.strength > peak.strength => self.peak = Some(now),
            Some(peak) if now.time_s - peak.time_s >= self.patience_s(peak) => return Some(self.report(peak)),
            Some(_) => {}
            None if now.strength > self.threshold(now.time_s - waiting_since_s) && self.may_beat(now.time_s) => {
                self.peak = Some(now);
            }
            None => {}
        }
        None
    }

    /// How long a maximum must stand; a weak one longer, because it may be the foot of a stronger one.
    fn patience_s(&self, peak: Onset) -> f64 {
        let weak = self.strengths.median().is_some_and(|usual| peak.strength < WEAK * usual);
        self.settings.window_s * if weak { 1.0 } else { 0.5 }
    }

    fn may_beat(&self, time_s: f64) -> bool {
        self.last_s.is_none_or(|last_s| time_s - last_s >= self.settings.refractory_s)
    }

    fn threshold(&self, waited_s: f64) -> f64 {
        let usual = self.strengths.median().unwrap_or(0.0);
        let impatience = (-(waited_s - PATIENCE_S).max(0.0) / FORGETTING_S).exp();
        let relative = self.settings.threshold * usual * impatience;
        relative.max(self.noise_edge()).max(self.settings.smallest_mmhg)
    }

    /// The edge that noise alone does not reach: it is the difference of two means of a window of samples.
    #[allow(clippy::cast_precision_loss)]
    fn noise_edge(&self) -> f64 {
        let per_window = self.samples.len() as f64 / SPAN;
        NOISE_SDS * self.curvature / NOISE_CURVATURE * SQRT_2 / per_window.max(1.0).sqrt()
    }

    fn report(&mut self, peak: Onset) -> Onset {
        let newest_s = self.samples.back().map_or(peak.time_s, |s| s.time_s) - 1.5 * self.settings.window_s;
        // Around its own result once more: the maximum that it starts from is where noise put it.
        let first_s = self.vertex(peak.time_s.min(newest_s)).unwrap_or(peak.time_s);
        let time_s = self.vertex(first_s.min(newest_s)).unwrap_or(first_s);
        self.peak = None;
        self.last_s = Some(time_s);
        self.waiting_since_s = Some(time_s);
        self.strengths.push(peak.strength);
        Onset { time_s, strength: peak.strength }
    }

    /// Vertex of the least-squares parabola through `E` over half a window to either side.
    fn vertex(&self, centre_s: f64) -> Option<f64> {
        let spacing_s = 0.5 * self.settings.window_s / f64::from(FIT_SIDE);
        // With k = -n..n, the sums of odd powers vanish: slope = Σ k E / Σ k², and the curvature follows from
        // k² - mean of k², which is orthogonal to the constant.
        let ks = || (-FIT_SIDE..=FIT_SIDE).map(f64::from);
        let k2: f64 = ks().map(|k| k * k).sum();
        let mean_k2 = k2 / f64::from(2 * FIT_SIDE + 1);
        let (mut slope, mut bend, mut bend_norm) = (0.0, 0.0, 0.0);
        for k in ks() {
            let e = self.edge(centre_s + k * spacing_s)?;
            let q = k * k - mean_k2;
            slope += k * e / k2;
            bend += q * e;
            bend_norm += q * q;
        }
        bend /= bend_norm;
        let side = f64::from(FIT_SIDE);
        (bend < 0.0).then(|| centre_s + spacing_s * (-slope / (2.0 * bend)).clamp(-side, side))
    }
}

/// The beat interval from its onsets.
#[derive(Debug, Clone, Default)]
pub struct RateTracker {
    last_s: Option<f64>,
    intervals: Recent,
}

impl RateTracker {
    /// No beats yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a beat. What is longer than a beat can be is a pause, and not counted.
    pub fn take(&mut self, onset: &Onset) {
        let interval_s = self.last_s.map(|last_s| onset.time_s - last_s);
        self.last_s = Some(onset.time_s);
        if let Some(interval_s) = interval_s.filter(|i| *i > 0.0 && *i <= LONGEST_INTERVAL_S) {
            self.intervals.push(interval_s);
        }
    }

    /// Median of the last intervals: a premature beat with its pause, or a beat missed, does not move it.
    #[must_use]
    pub fn interval_s(&self) -> Option<f64> {
        self.intervals.median()
    }
}

/// The last few values of something.
#[derive(Debug, Clone, Default)]
pub struct Recent {
    values: VecDeque<f64>,
}

impl Recent {
    /// Adds a value; the oldest goes.
    pub fn push(&mut self, value: f64) {
        if self.values.len() == MEMORY {
            self.values.pop_front();
        }
        self.values.push_back(value);
    }

    /// Of an even number, the lower one in the middle: the first flush is not half of what is usual.
    #[must_use]
    pub fn median(&self) -> Option<f64> {
        let mut sorted = [f64::INFINITY; MEMORY];
        for (slot, value) in sorted.iter_mut().zip(&self.values) {
            *slot = *value;
        }
        sorted.sort_unstable_by(f64::total_cmp);
        self.values.len().checked_sub(1).map(|last| sorted[last / 2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Uniform noise of unit standard deviation.
    struct Noise(u64);

    impl Noise {
        #[allow(clippy::cast_precision_loss)]
        fn next(&mut self) -> f64 {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            ((self.0 >> 11) as f64 / (1_u64 << 53) as f64 - 0.5) * 12_f64.sqrt()
        }
    }

    /// Beats that begin at `onsets`, with heights in pulse pressures of 40 mmHg and a rebound after the notch.
    fn waveform(onsets: &[(f64, f64)], time_s: f64) -> f64 {
        waveform_with_rebound(0.34, onsets, time_s)
    }

    fn waveform_with_rebound(rebound_s: f64, onsets: &[(f64, f64)], time_s: f64) -> f64 {
        let pulse = |&(onset_s, height): &(f64, f64)| {
            let t = time_s - onset_s;
            let rise = 1.0 / (1.0 + (-t / 0.015).exp());
            let rebound = 0.12 * (-((t - rebound_s) / 0.04).powi(2)).exp();
            height * 40.0 * (rise * (-t.max(0.0) / 0.5).exp() + rebound)
        };
        70.0 + onsets.iter().map(pulse).sum::<f64>()
    }

    fn regular(interval_s: f64, n: u32) -> Vec<(f64, f64)> {
        (0..n).map(|i| (0.503 + f64::from(i) * interval_s, 1.0)).collect()
    }

    fn run(rate_hz: f64, length_s: f64, mut value: impl FnMut(f64) -> f64) -> Vec<(Onset, f64)> {
        let mut detector = OnsetDetector::new(OnsetSettings::default());
        let mut found = Vec::new();
        let mut i = 0;
        while f64::from(i) / rate_hz < length_s {
            let t = f64::from(i) / rate_hz;
            found.extend(detector.take(t, value(t)).map(|onset| (onset, t)));
            i += 1;
        }
        found
    }

    /// Onsets against the true ones later than 2.2 s: (missed, false, errors).
    fn compare(found: &[(Onset, f64)], truth: &[(f64, f64)]) -> (usize, usize, Vec<f64>) {
        let found: Vec<f64> = found.iter().map(|(o, _)| o.time_s).filter(|t| *t > 2.2).collect();
        let truth: Vec<f64> = truth.iter().map(|t| t.0).filter(|t| *t > 2.2).collect();
        let errors: Vec<f64> =
            truth.iter().filter_map(|t| found.iter().map(|f| f - t).find(|d| d.abs() < 0.05)).collect();
        (truth.len() - errors.len(), found.len() - errors.len(), errors)
    }

    fn moments(errors: &[f64]) -> (f64, f64) {
        let n = f64::from(u32::try_from(errors.len()).unwrap());
        let mean = errors.iter().sum::<f64>() / n;
        (mean, (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt())
    }

    #[test]
    fn every_beat_is_found_once_at_any_rate_of_heart_and_samples() {
        for rate_hz in [60.0, 125.0, 250.0, 500.0] {
            for beats_per_min in [40.0, 75.0, 140.0, 215.0] {
                let truth = regular(60.0 / beats_per_min, 60);
                let end_s = truth.last().unwrap().0 + 0.15;
                let rebound_s = (36.0 / beats_per_min).min(0.34);
                let found = run(rate_hz, end_s, |t| waveform_with_rebound(rebound_s, &truth, t));
                let (missed, wrong, errors) = compare(&found, &truth);
                assert_eq!((missed, wrong), (0, 0), "{rate_hz} Hz, {beats_per_min} per min");
                let (mean, sd) = moments(&errors);
                assert!(mean.abs() < 0.008 && sd < 0.001, "{rate_hz} Hz, {beats_per_min} per min: {mean} {sd}");
                // Those of the first 1.6 s are reported at their end.
                let later = found.iter().filter(|(o, _)| o.time_s > 2.2);
                let latest = later.map(|(o, at)| at - o.time_s).fold(0.0, f64::max);
                assert!(found.iter().any(|(o, _)| o.time_s < 1.6), "beats before it knew what is usual");
                assert!(latest <= 0.1 + 1.0 / rate_hz, "{rate_hz} Hz, {beats_per_min} per min: {latest} s late");
            }
        }
    }

    #[test]
    fn noise_does_not_move_the_time() {
        let truth = regular(0.8, 250);
        let mut noise = Noise(41);
        let clean = run(125.0, 200.0, |t| waveform(&truth, t));
        let noisy = run(125.0, 200.0, |t| waveform(&truth, t) + 2.0 * noise.next());
        let reference: Vec<(f64, f64)> = clean.iter().map(|(o, _)| (o.time_s, 1.0)).collect();
        let (missed, wrong, errors) = compare(&noisy, &reference);
        assert_eq!((missed, wrong), (0, 0));
        let (bias, sd) = moments(&errors);
        assert!(bias.abs() < 0.002 && sd < 0.005, "{bias} {sd}");
    }

    #[test]
    fn a_weak_premature_beat_is_found() {
        let mut truth = regular(0.9, 12);
        truth.insert(7, (truth[6].0 + 0.5, 0.45));
        let found = run(125.0, 10.5, |t| waveform(&truth, t));
        assert_eq!(compare(&found, &truth).0, 0);
    }

    #[test]
    fn irregular_spacing_is_no_matter_and_a_gap_is_not_a_beat() {
        let truth = regular(0.8, 30);
        let mut noise = Noise(7);
        let mut detector = OnsetDetector::new(OnsetSettings::default());
        let mut found = Vec::new();
        let mut t = 0.0;
        while t < 24.0 {
            t += 0.008 * (1.0 + 0.5 * noise.next());
            // From the end of one diastole into the next systole.
            if !(10.0..10.3).contains(&t) {
                found.extend(detector.take(t, waveform(&truth, t)).map(|o| (o, t)));
            }
        }
        let lost = truth.iter().filter(|(o, _)| (9.9..10.35).contains(o)).count();
        let (missed, wrong, errors) = compare(&found, &truth);
        assert_eq!((missed, wrong), (lost, 0));
        assert!(moments(&errors).1 < 0.002);
    }

    #[test]
    fn a_flush_does_not_deafen() {
        let truth = regular(0.8, 30);
        let flushed = |t: f64| if (8.2..9.4).contains(&t) { 270.0 } else { waveform(&truth, t) };
        let found = run(125.0, 23.0, flushed);
        let after: Vec<(f64, f64)> = truth.iter().copied().filter(|o| o.0 > 12.4 && o.0 < 22.9).collect();
        let later: Vec<_> = found.iter().copied().filter(|o| o.0.time_s > 12.2).collect();
        assert_eq!(compare(&later, &after).0, 0);
        let during = found.iter().filter(|o| (8.1..9.6).contains(&o.0.time_s)).count();
        assert!(during <= 2, "{during}");
    }

    #[test]
    fn a_flush_at_the_start_is_forgotten() {
        let truth = regular(0.8, 12);
        let found = run(125.0, 9.0, |t| if t > 0.2 && t < 1.0 { 270.0 } else { waveform(&truth, t) });
        assert!(found.iter().filter(|o| o.0.time_s > 5.0).count() >= 5);
    }

    #[test]
    fn rubbish_is_ignored() {
        let mut detector = OnsetDetector::new(OnsetSettings::default());
        for t in [f64::NAN, 0.0, 0.0, -1.0, -1.0, f64::INFINITY, 1e18, 0.0] {
            for v in [f64::NAN, 1e300, 0.0] {
                assert_eq!(detector.take(t, v), None);
            }
        }
        assert!(detector.samples.len() <= 2);
    }

    #[test]
    fn the_interval_is_the_median() {
        let mut rate = RateTracker::new();
        let mut take = |times: &[f64]| {
            for &time_s in times {
                rate.take(&Onset { time_s, strength: 1.0 });
            }
            rate.interval_s()
        };
        assert_eq!(take(&[0.0]), None);
        assert!((take(&[0.8]).unwrap() - 0.8).abs() < 1e-9);
        // A premature beat and its pause; then a beat missed; then silence.
        assert!((take(&[1.6, 2.1, 3.2, 4.0, 4.8]).unwrap() - 0.8).abs() < 1e-9);
        assert!((take(&[6.4]).unwrap() - 0.8).abs() < 1e-9);
        assert!((take(&[60.0, 60.8]).unwrap() - 0.8).abs() < 1e-9);
        // Three beats of a new rate are enough.
        assert!((take(&[61.2, 61.6, 62.0]).unwrap() - 0.4).abs() < 1e-9);
    }
}
