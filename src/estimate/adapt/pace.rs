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

/// One of them: a scalar filter that believes in its pace.
#[derive(Debug, Clone, Copy)]
struct Hypothesis {
    /// In units of the pace believed.
    factor: f64,
    mean: f64,
    variance: f64,
    probability: f64,
}

impl Hypothesis {
    /// Takes an observation; returns its log likelihood.
    fn update(&mut self, observed: f64, noise: f64) -> f64 {
        let (innovation, variance) = (observed - self.mean, self.variance + noise);
        let gain = self.variance / variance;
        self.mean += gain * innovation;
        self.variance *= 1.0 - gain;
        -0.5 * (innovation * innovation / variance + variance.ln())
    }
}

/// The paces of one parameter, in its coordinate.
#[derive(Debug, Clone)]
pub struct Pace {
    /// \[1/sqrt(s)\]
    nominal: f64,
    /// Pull to `centre` \[1/s\].
    reversion: f64,
    centre: f64,
    hypotheses: [Hypothesis; N],
    /// Of the block so far.
    elapsed_s: f64,
    information: f64,
    score: f64,
}

impl Pace {
    /// Every hypothesis at the starting guess, the user's believed most.
    #[must_use]
    pub fn new(nominal: f64, reversion: f64, centre: f64, sd: f64) -> Self {
        let hypothesis = |factor: f64| Hypothesis {
            factor,
            mean: centre,
            variance: sd * sd,
            probability: if factor.to_bits() == 1.0_f64.to_bits() { 0.5 } else { 0.125 },
        };
        Self {
            nominal,
            reversion,
            centre,
            hypotheses: FACTORS.map(hypothesis),
            elapsed_s: 0.0,
            information: 0.0,
            score: 0.0,
        }
    }

    /// The pace now \[1/sqrt(s)\].
    #[must_use]
    pub fn now(&self) -> f64 {
        self.nominal * self.hypotheses.iter().map(|h| h.probability * h.factor).sum::<f64>()
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
        self.mix();
        let decay = (-self.reversion * self.elapsed_s).exp();
        let noise = diffusion(self.reversion, self.elapsed_s);
        for hypothesis in &mut self.hypotheses {
            let pace = self.nominal * hypothesis.factor;
            hypothesis.mean = self.centre + decay * (hypothesis.mean - self.centre);
            hypothesis.variance = decay * decay * hypothesis.variance + pace * pace * noise;
        }
        if self.information > 0.0 {
            self.weigh();
        }
        (self.elapsed_s, self.information, self.score) = (0.0, 0.0, 0.0);
        before < AWAKE * self.nominal && self.now() >= AWAKE * self.nominal
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
        let before = self.hypotheses;
        for (to, hypothesis) in self.hypotheses.iter_mut().enumerate() {
            let into = || before.iter().enumerate().map(|(from, h)| (h.probability * switch(from, to), h));
            let total: f64 = into().map(|(p, _)| p).sum();
            let mean = into().map(|(p, h)| p * h.mean).sum::<f64>() / total;
            let spread = |(p, h): (f64, &Hypothesis)| p * (h.variance + (h.mean - mean) * (h.mean - mean));
            *hypothesis = Hypothesis {
                factor: hypothesis.factor,
                mean,
                variance: into().map(spread).sum::<f64>() / total,
                probability: total,
            };
        }
    }

    fn weigh(&mut self) {
        let (observed, noise) = (self.score / self.information, 1.0 / self.information);
        let log = self.hypotheses.each_mut().map(|hypothesis| hypothesis.update(observed, noise));
        let best = log.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        for (hypothesis, log) in self.hypotheses.iter_mut().zip(log) {
            // No probability reaches zero, so that nothing is ruled out for ever.
            hypothesis.probability = (hypothesis.probability * (log - best).exp()).max(1e-12);
        }
        let total: f64 = self.hypotheses.iter().map(|h| h.probability).sum();
        self.hypotheses.iter_mut().for_each(|h| h.probability /= total);
    }
}

/// Variance of a random walk of pace 1 after `dt_s`, with a pull of `reversion` \[1/s\].
#[must_use]
pub fn diffusion(reversion: f64, dt_s: f64) -> f64 {
    if reversion * dt_s > 1e-8 { -(-2.0 * reversion * dt_s).exp_m1() / (2.0 * reversion) } else { dt_s }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::{Pace, diffusion};

    /// A scalar Kalman filter with the pace that is learnt, on observations of noise 0.05 every 0.1 s of a parameter that
    /// moves as `truth` says; returns the pace at the end of every block, and when it awoke.
    fn follow(truth: impl Fn(usize) -> f64, blocks: usize) -> (Vec<f64>, Vec<usize>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let (mut mean, mut variance) = (0.0, 0.09);
        let mut pace = Pace::new(0.02, 0.0, 0.0, 0.3);
        let (mut paces, mut awoke) = (Vec::new(), Vec::new());
        for block in 0..blocks {
            let e: f64 = StandardNormal.sample(&mut rng);
            variance += pace.now().powi(2) * 0.1;
            let gain = variance / (variance + 0.0025);
            let after = (mean + gain * (truth(block) + 0.05 * e - mean), variance * (1.0 - gain));
            pace.hear((mean, after.0), (variance, after.1));
            (mean, variance) = after;
            if pace.advance(0.1) {
                awoke.push(block);
            }
            paces.push(pace.now());
        }
        (paces, awoke)
    }

    #[test]
    fn what_stands_still_is_believed_to() {
        let (paces, _) = follow(|_| 0.1, 600);
        assert!(paces[599] < 0.01, "half of what was believed: {}", paces[599]);
    }

    #[test]
    fn a_step_awakes_it_within_two_blocks_and_it_calms_down() {
        let (paces, awoke) = follow(|block| if block < 300 { 0.0 } else { 0.5 }, 600);
        let late: Vec<usize> = awoke.into_iter().filter(|block| *block >= 100).collect();
        assert!(late.first().is_some_and(|block| (300..302).contains(block)), "{late:?}");
        assert!(paces[330] < 0.1 && paces[599] < 0.01, "{} {}", paces[330], paces[599]);
    }

    #[test]
    fn what_wanders_is_believed_to() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut walk = vec![0.0];
        for _ in 0..600 {
            let e: f64 = StandardNormal.sample(&mut rng);
            walk.push(walk.last().copied().unwrap_or(0.0) + 0.1 * 0.1_f64.sqrt() * e);
        }
        let (paces, _) = follow(|block| walk[block], 600);
        let late = paces[300..].iter().sum::<f64>() / 300.0;
        assert!((0.05..0.25).contains(&late), "true 0.1, found {late}");
    }

    #[test]
    fn a_pull_bounds_the_walk() {
        assert!((diffusion(0.3, 1e6) - 1.0 / 0.6).abs() < 1e-9 && (diffusion(0.0, 2.0) - 2.0).abs() < 1e-12);
    }
}
