//! How fast a parameter moves.
//!
//! A constant pace is a compromise: fast enough for a step, and the bands of a patient who stands still are too wide;
//! narrow bands, and a step takes a minute to arrive. So a few hypotheses run side by side, from nearly constant to
//! nearly free, each a scalar filter of the one parameter, with a small probability of changing from one to another
//! (interacting multiple models; Blom and Bar-Shalom 1988). What they see is what the updates of the ensemble said of
//! the parameter, as one observation per block of time. The pace in force is their mean.

/// Paces under test, in units of the pace the user believes in.
const FACTORS: [f64; N] = [0.05, 0.25, 1.0, 5.0, 25.0];
const N: usize = 5;

/// Time after which the hypotheses are weighed again \[s\].
const BLOCK_S: f64 = 0.1;

/// Pace, in units of the one believed, at which a parameter has begun to move.
const AWAKE: f64 = 4.0;

/// How long each holds on average \[s\]: what jumps has soon arrived.
const PERSISTENCE_S: [f64; N] = [10.0, 10.0, 10.0, 2.0, 0.4];

/// The paces of one parameter, in its coordinate.
#[derive(Debug, Clone)]
pub struct Pace {
    /// \[1/sqrt(s)\]
    nominal: f64,
    /// Pull to `centre` \[1/s\].
    reversion: f64,
    centre: f64,
    mean: [f64; N],
    variance: [f64; N],
    weight: [f64; N],
    /// Of the block so far.
    elapsed_s: f64,
    information: f64,
    score: f64,
}

impl Pace {
    /// Every hypothesis at the starting guess, the user's believed most.
    #[must_use]
    pub fn new(nominal: f64, reversion: f64, centre: f64, sd: f64) -> Self {
        Self {
            nominal,
            reversion,
            centre,
            mean: [centre; N],
            variance: [sd * sd; N],
            weight: [1.0 / 8.0, 1.0 / 8.0, 1.0 / 2.0, 1.0 / 8.0, 1.0 / 8.0],
            elapsed_s: 0.0,
            information: 0.0,
            score: 0.0,
        }
    }

    /// The pace now \[1/sqrt(s)\].
    #[must_use]
    pub fn now(&self) -> f64 {
        self.nominal * self.weight.iter().zip(FACTORS).map(|(w, f)| w * f).sum::<f64>()
    }

    /// Hears of an update: mean before and after, variance before and after.
    pub fn hear(&mut self, mean: (f64, f64), variance: (f64, f64)) {
        let information = 1.0 / variance.1 - 1.0 / variance.0;
        if information > 0.0 && information.is_finite() {
            // The observation with this information that moves the one Gaussian to the other.
            self.information += information;
            self.score += mean.0 * information + (mean.1 - mean.0) / variance.1;
        }
    }

    /// Time passes; at the end of a block the hypotheses are weighed. True if the parameter has begun to move.
    pub fn advance(&mut self, dt_s: f64) -> bool {
        self.elapsed_s += dt_s;
        if self.elapsed_s < BLOCK_S - 1e-9 {
            return false;
        }
        let before = self.now();
        self.weigh_block();
        before < AWAKE * self.nominal && self.now() >= AWAKE * self.nominal
    }

    fn weigh_block(&mut self) {
        self.mix();
        let decay = (-self.reversion * self.elapsed_s).exp();
        let noise = diffusion(self.reversion, self.elapsed_s);
        for i in 0..N {
            let q = self.nominal * FACTORS[i];
            self.mean[i] = self.centre + decay * (self.mean[i] - self.centre);
            self.variance[i] = decay * decay * self.variance[i] + q * q * noise;
        }
        if self.information > 0.0 {
            self.weigh();
        }
        (self.elapsed_s, self.information, self.score) = (0.0, 0.0, 0.0);
    }

    /// A hypothesis may have taken over from another: each goes on from the mixture that leads to it.
    fn mix(&mut self) {
        let leave = PERSISTENCE_S.map(|persistence| 1.0 - (-self.elapsed_s / persistence).exp());
        // To a neighbour only: what moves slowly now is not a jump in the next moment unless the data say so twice.
        let switch = |from: usize, to: usize| match from.abs_diff(to) {
            0 if from == 0 || from == N - 1 => 1.0 - 0.5 * leave[from],
            0 => 1.0 - leave[from],
            1 => 0.5 * leave[from],
            _ => 0.0,
        };
        let (mean, variance, weight) = (self.mean, self.variance, self.weight);
        for to in 0..N {
            let into: [f64; N] = std::array::from_fn(|from| weight[from] * switch(from, to));
            let total: f64 = into.iter().sum();
            let m = into.iter().zip(mean).map(|(w, m)| w * m).sum::<f64>() / total;
            let spread = |(w, (mean, v)): (&f64, (f64, f64))| w * (v + (mean - m) * (mean - m));
            self.variance[to] = into.iter().zip(mean.into_iter().zip(variance)).map(spread).sum::<f64>() / total;
            self.mean[to] = m;
            self.weight[to] = total;
        }
    }

    fn weigh(&mut self) {
        let (observed, noise) = (self.score / self.information, 1.0 / self.information);
        let mut log = [0.0; N];
        for i in 0..N {
            let (innovation, variance) = (observed - self.mean[i], self.variance[i] + noise);
            log[i] = -0.5 * (innovation * innovation / variance + variance.ln());
            let gain = self.variance[i] / variance;
            self.mean[i] += gain * innovation;
            self.variance[i] *= 1.0 - gain;
        }
        let best = log.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut total = 0.0;
        for (w, log) in self.weight.iter_mut().zip(log) {
            *w *= (log - best).exp();
            total += *w;
        }
        self.weight.iter_mut().for_each(|w| *w /= total);
    }
}

/// Variance of a random walk of pace 1 after `dt_s`, with a pull of `reversion` \[1/s\].
#[must_use]
pub fn diffusion(reversion: f64, dt_s: f64) -> f64 {
    if reversion * dt_s > 1e-8 { -(-2.0 * reversion * dt_s).exp_m1() / (2.0 * reversion) } else { dt_s }
}
