//! A look back: what the members were at published times of the last moments, corrected by every sample that came
//! since (ensemble Kalman smoother with a fixed lag; Evensen and van Leeuwen 2000).
//!
//! A sample changes the past through its covariance with what the members expected of it, with the same perturbations
//! as in the present. That costs a few products per remembered time and no solve.

use std::collections::VecDeque;

use super::coupling::coupled::{covariance, gain, with_noise};
use super::statistics::centred;
use super::time::EventTime;

/// The members at a time in the past.
#[derive(Debug, Clone)]
pub struct Remembered {
    /// When.
    pub time: EventTime,
    /// Window it lies in, counted from the start, and position in it.
    pub window: u64,
    /// Position in the window, in `[0, 1]`.
    pub s: f64,
    /// States, then parameter coordinates, `[n_u x n_members]`.
    pub rows: Vec<f64>,
    /// Parameters of the first member there: those not estimated are the same in all.
    pub theta: Vec<f64>,
}

/// The last moments.
#[derive(Debug, Clone, Default)]
pub struct Smoother {
    past: VecDeque<Remembered>,
}

/// What the samples of a window said, ready to be applied to the past.
pub struct Correction {
    members: usize,
    /// Centred expectations, `[n_observations x n_members]`.
    expected: Vec<f64>,
    /// `S^-1 (observed + noise - expected)`, `[n_observations x n_members]`.
    weights: Vec<f64>,
}

impl Correction {
    /// From what members expected and how far off the perturbed samples are, both `[n_observations x n_members]`, and the
    /// noise of each. None if the samples cannot be told apart.
    #[must_use]
    pub fn new(expected: &[f64], off: &[f64], sd: &[f64], members: usize) -> Option<Self> {
        let m = sd.len();
        let innovation = with_noise(covariance(expected, expected, members), sd);
        let of_members: Vec<f64> = (0..members).flat_map(|i| (0..m).map(move |j| off[j * members + i])).collect();
        let solved = gain(&of_members, &innovation, m)?;
        let weights = (0..m).flat_map(|j| solved.iter().skip(j).step_by(m).copied()).collect();
        let expected = expected.chunks_exact(members).flat_map(centred).collect();
        Some(Self { members, expected, weights })
    }

    #[allow(clippy::cast_precision_loss)]
    fn apply(&self, rows: &mut [f64]) {
        let degrees = self.members as f64 - 1.0;
        for row in rows.chunks_exact_mut(self.members) {
            let deviations = centred(row);
            for (expected, weights) in
                self.expected.chunks_exact(self.members).zip(self.weights.chunks_exact(self.members))
            {
                let covariance = deviations.iter().zip(expected).map(|(a, b)| a * b).sum::<f64>() / degrees;
                row.iter_mut().zip(weights).for_each(|(value, w)| *value += covariance * w);
            }
        }
    }
}

impl Smoother {
    /// Takes in the members at a time.
    pub fn remember(&mut self, moment: Remembered) {
        self.past.push_back(moment);
    }

    /// Lets the samples of a window say what they say about the times in windows from `from` on.
    pub fn correct(&mut self, correction: &Correction, from: u64) {
        let recent = self.past.iter_mut().filter(|moment| moment.window >= from);
        recent.for_each(|moment| correction.apply(&mut moment.rows));
    }

    /// The moments of a window that is solved again, to be filled in anew.
    pub fn in_window(&mut self, window: u64) -> impl Iterator<Item = &mut Remembered> + '_ {
        self.past.iter_mut().filter(move |moment| moment.window == window)
    }

    /// The oldest moment, if it is not after `until`.
    pub fn release(&mut self, until: EventTime) -> Option<Remembered> {
        if self.past.front()?.time > until { None } else { self.past.pop_front() }
    }
}

#[cfg(test)]
mod tests {
    use super::Correction;

    /// Scalar case with exact sample moments: the update of the past is the Kalman gain of its covariance.
    #[test]
    fn the_past_moves_by_its_covariance_with_the_expectation() {
        let (past, expected) = ([1.0, 2.0, 3.0, 4.0], [2.0, 3.0, 7.0, 8.0]);
        let off = [0.5, -0.3, 0.2, 1.0];
        let sd = 2.0;
        let correction = Correction::new(&expected, &off, &[sd], 4).unwrap();
        let mut rows = past;
        correction.apply(&mut rows);
        // Deviations: past -1.5 -0.5 0.5 1.5; expected -3 -2 2 3: covariance 11/3, variance 26/3.
        let gain = (11.0 / 3.0) / (26.0 / 3.0 + sd * sd);
        for ((after, before), off) in rows.iter().zip(past).zip(off) {
            assert!((after - before - gain * off).abs() < 1e-12);
        }
    }

    #[test]
    fn two_samples_at_once_are_one_after_the_other_where_noise_is_large() {
        let expected = [1.0, -1.0, 0.5, -0.5, 0.3, 0.7, -0.2, -0.8];
        let off = [0.4, 0.1, -0.2, 0.3, 0.1, -0.1, 0.2, 0.6];
        let both = Correction::new(&expected, &off, &[1.0, 2.0], 4).unwrap();
        // S W = off, checked against the definition.
        let covariance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / 3.0;
        let e: Vec<&[f64]> = both.expected.chunks_exact(4).collect();
        for member in 0..4 {
            for i in 0..2 {
                let noise: f64 = if i == 0 { 1.0 } else { 4.0 };
                let product: f64 = (0..2)
                    .map(|j| (covariance(e[i], e[j]) + if i == j { noise } else { 0.0 }) * both.weights[j * 4 + member])
                    .sum();
                assert!((product - off[i * 4 + member]).abs() < 1e-12);
            }
        }
    }
}
