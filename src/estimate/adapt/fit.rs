//! Whether sensors and model do what the settings say, channel by channel.
//!
//! With the right model the normalised innovations of a channel are white with variance 1. Three things are told apart:
//! noise that is larger or smaller than stated shows in the differences of neighbouring innovations; a state that does
//! what the model does not say, in innovations that agree with their neighbours, so that their sum over a moment or half
//! a beat is larger than it should be; a model that does not fit, in innovations that come back with every beat.

/// Stretches over which innovations are summed up \[s\], and how many there must be in each: what a model misses may
/// last for a moment or for half a beat.
const BLOCKS_S: [f64; 2] = [0.1, 0.4];
const BLOCK_MIN: usize = 5;

/// Longest time between neighbours \[s\].
const NEIGHBOURS_S: f64 = 0.1;

/// Memory of the noise, in samples, and how many samples' worth the setting is at the start: a wrong one must not be
/// taken for a model that does not fit.
const NOISE_MEMORY: f64 = 1000.0;
const NOISE_BELIEF: f64 = 100.0;

/// Memory of the mean squares of blocks \[s\]: some tens of blocks each.
const MEMORY_S: [f64; 2] = [4.0, 10.0];

/// Largest square of a block that counts: a beat that the model missed is not a thousand.
const MAX_SQUARE: f64 = 9.0;

/// Above this mean square of blocks the states are believed to do what the model does not say: by itself, and where
/// as much comes back with the beat.
const ARMED: [f64; 2] = [1.5, 1.3];
const ARMED_RECURRENCE: f64 = 2.0;

/// Mean square that extra noise aims at once it is.
const AIM: f64 = 1.2;

/// Change of the logarithm of the extra noise per second and unit of excess.
const GAIN_PER_S: [f64; 2] = [2.0, 0.7];

/// Phases of the beat that are told apart, and the share of what they say that is kept from beat to beat: what a model
/// misses comes back with every beat, and stands out from the noise when some tens of beats are laid over each other.
const PHASES: usize = 16;
const KEPT_PER_BEAT: f64 = 0.98;

/// Mean square of the phases up to which what comes back may well be an accident.
const SYSTEMATIC: f64 = 1.4;

/// Beyond this the model does not fit.
const MISFIT_RECURRENCE: f64 = 3.0;
/// Nor does it where so much extra noise is needed, and what it covers comes back with the beat (if there is one): with
/// the right model it is now and then asked for by accident, for some seconds.
///
/// Where much process noise was stated from the start (`pressure_drift` above 0.03), so much more is never asked for.
const MISFIT_EXCESS: f64 = 300.0;

/// Innovations of one phase of the beat.
#[derive(Debug, Clone, Copy, Default)]
struct Phase {
    sum: f64,
    weight: f64,
    square_weight: f64,
}

/// Where a phase in `[0, 1)` belongs.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn bin(phase: f64) -> usize {
    ((phase * PHASES as f64) as usize).min(PHASES - 1)
}

/// Fit of one channel.
#[derive(Debug, Clone)]
pub struct ChannelFit {
    /// Bounds of the noise found, as shares of the one stated.
    noise_range: (f64, f64),
    /// Square of the noise over that stated.
    noise_square: f64,
    /// Samples that it rests on.
    noise_weight: f64,
    /// Residual \[in stated noise sd\] and time of the last sample.
    last: Option<(f64, f64)>,
    /// Blocks: start, sum of normalised innovations, their number.
    blocks: [(f64, f64, usize); 2],
    /// Mean square of blocks of each length, lately.
    whiteness: [f64; 2],
    phases: [Phase; PHASES],
    /// Phase of the last sample.
    phase: usize,
    /// Variance that members and noise give to a sample \[mmHg^2\].
    variance: f64,
    /// Logarithm of the extra noise of the state.
    log_excess: f64,
    max_log_excess: f64,
}

impl ChannelFit {
    /// Everything as stated.
    #[must_use]
    pub fn new(noise_range: (f64, f64), max_excess: f64) -> Self {
        Self {
            noise_range,
            noise_square: 1.0,
            noise_weight: NOISE_BELIEF,
            last: None,
            blocks: [(f64::NEG_INFINITY, 0.0, 0); 2],
            whiteness: [1.0; 2],
            phases: [Phase::default(); PHASES],
            phase: 0,
            variance: 0.0,
            log_excess: 0.0,
            max_log_excess: max_excess.max(1.0).ln(),
        }
    }

    /// Noise of the sensor over that stated.
    #[must_use]
    pub fn noise_factor(&self) -> f64 {
        self.noise_square.sqrt().clamp(self.noise_range.0, self.noise_range.1)
    }

    /// Process noise of the observed state over that stated.
    #[must_use]
    pub fn excess(&self) -> f64 {
        self.log_excess.exp()
    }

    /// Mean square of sums of neighbouring normalised innovations, lately: 1 when they are white.
    #[must_use]
    pub fn whiteness(&self) -> f64 {
        self.whiteness[0].max(self.whiteness[1])
    }

    /// Mean square of the innovations averaged over beats at the same phase, in units of what noise leaves of them: 1 when
    /// nothing comes back with every beat.
    #[must_use]
    pub fn recurrence(&self) -> f64 {
        self.known_recurrence().unwrap_or(1.0)
    }

    /// None before half a beat has been seen.
    #[allow(clippy::cast_precision_loss)]
    fn known_recurrence(&self) -> Option<f64> {
        let known = || self.phases.iter().filter(|phase| phase.square_weight > 0.0);
        let squares = known().map(|phase| phase.sum * phase.sum / phase.square_weight);
        let count = known().count();
        (count >= PHASES / 2).then(|| squares.sum::<f64>() / count as f64)
    }

    /// Whether the model does not fit: what it misses comes back with every beat, or is only covered by extra noise.
    #[must_use]
    pub fn is_misfit(&self) -> bool {
        let recurrence = self.known_recurrence();
        recurrence.is_some_and(|recurrence| recurrence > MISFIT_RECURRENCE)
            || self.log_excess > MISFIT_EXCESS.ln() && recurrence.is_none_or(|recurrence| recurrence > ARMED_RECURRENCE)
    }

    /// Standard deviation of what the model misses in every beat, as far as it stands out of the noise \[mmHg\]: over the
    /// whole beat, or at a phase of it where that is more.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn systematic_sd(&self, phase: Option<f64>) -> f64 {
        let recurrence = self.recurrence();
        if recurrence <= SYSTEMATIC {
            return 0.0;
        }
        // The square of a mean is larger than that of what it estimates, by the variance of the mean.
        let square = |phase: &Phase| (phase.sum * phase.sum - phase.square_weight) / (phase.weight * phase.weight);
        let known = || self.phases.iter().filter(|phase| phase.weight > 0.0);
        let mean = known().map(square).sum::<f64>() / known().count() as f64;
        let here = phase.map(|phase| &self.phases[bin(phase)]).filter(|phase| phase.weight > 0.0).map_or(0.0, square);
        // The less it stands out, the more of it is chance that has been picked.
        let share = (recurrence - SYSTEMATIC) / (recurrence - 1.0);
        (share * mean.max(here) * self.variance).max(0.0).sqrt()
    }

    /// Hears of a sample: its time and phase of the beat in `[0, 1)`, residual in units of the stated noise, and the sd
    /// that members and noise give it \[mmHg\], with the innovation in that unit.
    pub fn hear(&mut self, time_s: f64, phase: Option<f64>, residual: f64, sd: f64, innovation: f64) {
        if !(residual.is_finite() && innovation.is_finite()) {
            return;
        }
        self.variance = sd * sd;
        if let Some(phase) = phase {
            self.hear_phase(phase, innovation.clamp(-3.0, 3.0));
        }
        if let Some((before, _)) = self.last.filter(|(_, at)| time_s - at <= NEIGHBOURS_S && time_s > *at) {
            let square = 0.5 * (residual - before) * (residual - before);
            // Spikes are not noise.
            let square = square.min(MAX_SQUARE * self.noise_square);
            self.noise_weight = (self.noise_weight + 1.0).min(NOISE_MEMORY);
            self.noise_square += (square - self.noise_square) / self.noise_weight;
        }
        self.last = Some((residual, time_s));
        for (block, length_s) in BLOCKS_S.into_iter().enumerate() {
            let (start, sum, count) = &mut self.blocks[block];
            let over = time_s - *start;
            if over >= length_s && *count >= BLOCK_MIN || over > 10.0 * length_s {
                self.close(block);
                self.blocks[block] = (time_s, innovation, 1);
            } else {
                *sum += innovation;
                *count += 1;
            }
        }
    }

    fn hear_phase(&mut self, phase: f64, innovation: f64) {
        let now = bin(phase);
        // Not where the clock was only set back a little.
        if now + PHASES / 2 < self.phase {
            for phase in &mut self.phases {
                phase.sum *= KEPT_PER_BEAT;
                phase.weight *= KEPT_PER_BEAT;
                phase.square_weight *= KEPT_PER_BEAT * KEPT_PER_BEAT;
            }
        }
        self.phase = now;
        let phase = &mut self.phases[now];
        phase.sum += innovation;
        phase.weight += 1.0;
        phase.square_weight += 1.0;
    }

    #[allow(clippy::cast_precision_loss)]
    fn close(&mut self, block: usize) {
        let (_, sum, count) = self.blocks[block];
        if count < BLOCK_MIN {
            return;
        }
        let square = (sum * sum / count as f64).min(MAX_SQUARE);
        let length_s = BLOCKS_S[block];
        self.whiteness[block] += length_s / MEMORY_S[block] * (square - self.whiteness[block]);
        let step = GAIN_PER_S[block] * length_s * (square - AIM);
        let armed = ARMED[usize::from(self.recurrence() > ARMED_RECURRENCE)];
        let step = if self.whiteness() > armed { step } else { step.min(0.0) };
        self.log_excess = (self.log_excess + step).clamp(0.0, self.max_log_excess);
    }
}
