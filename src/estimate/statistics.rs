//! Summaries of an ensemble.

use super::cloud::{Cloud, degrees};
use crate::model::lanes::{InstructionSet, WIDTH};

/// One quantity: where it is, and how uncertain by source.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Summary {
    /// Mean over the members.
    pub mean: f64,
    /// Total standard deviation: root of the sum of squares of the three below.
    pub sd: f64,
    /// Spread of the members: features, noise realisations, initial pressures, parameters. Without the model's part.
    pub epistemic_sd: f64,
    /// Sensor noise; 0 for what is derived.
    pub aleatoric_sd: f64,
    /// What the members' discrepancies explain of their spread; 0 without a discrepancy in the model.
    pub model_sd: f64,
    /// 5 % quantile of the true quantity, without sensor noise.
    pub q05: f64,
    /// 95 % quantile of the true quantity, without sensor noise.
    pub q95: f64,
}

impl Summary {
    /// With an error of the model of this sd beside what the members know of it.
    #[must_use]
    pub fn widened(self, model_sd: f64) -> Self {
        if model_sd <= 0.0 {
            return self;
        }
        let spread = self.epistemic_sd.hypot(self.model_sd);
        let wider = spread.hypot(model_sd);
        // Spread evenly, as far as it is known; a Gaussian where the members know no better.
        let (low, high) = if spread > 0.0 {
            ((self.mean - self.q05) * wider / spread, (self.q95 - self.mean) * wider / spread)
        } else {
            (NORMAL_95 * model_sd, NORMAL_95 * model_sd)
        };
        Self {
            sd: self.sd.hypot(model_sd),
            model_sd: self.model_sd.hypot(model_sd),
            q05: self.mean - low,
            q95: self.mean + high,
            ..self
        }
    }
}

/// 95 % quantile of the standard normal distribution.
const NORMAL_95: f64 = 1.644_853_626_951_472_7;

/// Summarises one quantity over the members; `values` is in another order on return. `model_share` is the share of their variance
/// that belongs to the model ([`Explainers::share_of`]).
#[must_use]
pub fn summarise(values: &mut [f64], aleatoric_sd: f64, model_share: f64) -> Summary {
    let (mean, spread) = mean_and_sd(values);
    let (q05, q95) = outer_quantiles(values, 0.05, (mean, spread));
    Summary {
        mean,
        sd: (spread * spread + aleatoric_sd * aleatoric_sd).sqrt(),
        epistemic_sd: spread * (1.0 - model_share).sqrt(),
        aleatoric_sd,
        model_sd: spread * model_share.sqrt(),
        q05,
        q95,
    }
}

/// Variables over the members (their discrepancies) that may explain the spread of others.
#[derive(Debug, Clone, Default)]
pub struct Explainers {
    variables: Cloud,
}

impl Explainers {
    /// From the rows of `variables`, each `[n_members]`.
    #[must_use]
    pub fn new(variables: &[f64], members: usize) -> Self {
        Self { variables: Cloud::of(variables, members, InstructionSet::default()) }
    }

    /// The share of the variance of `values` `[n_members]` that a linear regression on these variables explains,
    /// without what chance alone would explain (adjusted R squared, not below 0).
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn share_of(&self, values: &[f64]) -> f64 {
        let (count, members) = (self.variables.rank(), self.variables.members());
        if count == 0 || members < count + 2 {
            return 0.0;
        }
        let centred = centred(values);
        let along = |direction: &[f64]| dot(direction, &centred).powi(2) / degrees(members);
        let explained: f64 = self.variables.directions().chunks_exact(members).map(along).sum();
        let total = norm(&centred).powi(2);
        if total <= 0.0 {
            return 0.0;
        }
        let chance = (members as f64 - 1.0) / (members - 1 - count) as f64;
        (1.0 - (1.0 - explained / total) * chance).clamp(0.0, 1.0)
    }
}

// Sums in eight parts, whatever the instruction set: the same bits everywhere.

#[allow(clippy::inline_always)]
#[inline(always)]
pub(super) fn sum(row: &[f64], of: impl Fn(f64) -> f64) -> f64 {
    let (whole, rest) = row.as_chunks::<WIDTH>();
    let mut parts = [0.0; WIDTH];
    for chunk in whole {
        for (part, v) in parts.iter_mut().zip(chunk) {
            *part += of(*v);
        }
    }
    parts.iter().sum::<f64>() + rest.iter().map(|v| of(*v)).sum::<f64>()
}

#[allow(clippy::inline_always)]
#[inline(always)]
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((whole_a, rest_a), (whole_b, rest_b)) = (a.as_chunks::<WIDTH>(), b.as_chunks::<WIDTH>());
    let mut parts = [0.0; WIDTH];
    for (a, b) in whole_a.iter().zip(whole_b) {
        for ((part, a), b) in parts.iter_mut().zip(a).zip(b) {
            *part += a * b;
        }
    }
    parts.iter().sum::<f64>() + rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum::<f64>()
}

#[allow(clippy::cast_precision_loss)]
pub(super) fn centred(values: &[f64]) -> Vec<f64> {
    let mean = sum(values, |v| v) / values.len() as f64;
    values.iter().map(|v| v - mean).collect()
}

/// Length of a row.
#[allow(clippy::inline_always)]
#[inline(always)]
pub(super) fn norm(values: &[f64]) -> f64 {
    dot(values, values).sqrt()
}

/// Correlation of the rows of `values` `[n x n_members]`, `[n x n]`, row-major; NaN where a row has no spread.
#[must_use]
pub fn correlation(values: &[f64], members: usize) -> Vec<f64> {
    let rows: Vec<Vec<f64>> = values
        .chunks_exact(members)
        .map(|row| {
            let row = centred(row);
            let length = norm(&row);
            row.iter().map(|v| v / length).collect()
        })
        .collect();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum();
    rows.iter().flat_map(|a| rows.iter().map(|b| dot(a, b))).collect()
}

/// Mean and sample standard deviation (0 for fewer than two values, NaN for none).
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn mean_and_sd(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = sum(values, |v| v) / n;
    if values.len() < 2 {
        return (mean, 0.0);
    }
    let squares = sum(values, |v| (v - mean) * (v - mean));
    (mean, (squares / (n - 1.0)).sqrt())
}

/// Quantile of ascending values, interpolated so that `n` draws are unbiased for a uniform distribution
/// (plotting position `k / (n + 1)`, Weibull; type 6 of Hyndman and Fan). NaN of none.
#[must_use]
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    if sorted.is_empty() {
        return f64::NAN;
    }
    let (below, weight) = plotting_position(sorted.len(), share);
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + weight * (sorted[above] - sorted[below])
}

/// How far out candidates for an outer quantile are looked for \[sd\], and how many there is room for.
const OUTSIDE: f64 = 1.15;

const CANDIDATES: usize = 48;

/// The quantiles of `share` (below a tenth) and `1 - share` of values in any order, which may be in another one on
/// return, from their mean and sd.
fn outer_quantiles(values: &mut [f64], share: f64, (mean, sd): (f64, f64)) -> (f64, f64) {
    let (mut low, mut high) = ([0.0; CANDIDATES], [0.0; CANDIDATES]);
    let (mut lows, mut highs) = (0, 0);
    let (below, above) = (mean - OUTSIDE * sd, mean + OUTSIDE * sd);
    for value in &*values {
        // Written anyhow, counted if it lies there: no jump depends on it.
        low[lows.min(CANDIDATES - 1)] = *value;
        lows += usize::from(*value < below);
        high[highs.min(CANDIDATES - 1)] = -*value;
        highs += usize::from(*value > above);
    }
    let mut of = |candidates: &mut [f64], sign: f64, share_of_all: f64| {
        let (at, weight) = plotting_position(values.len(), share);
        if candidates.len() >= CANDIDATES || candidates.len() < at + 2 {
            return quantile_of(values, share_of_all);
        }
        candidates.sort_unstable_by(f64::total_cmp);
        sign * (candidates[at] + weight * (candidates[at + 1] - candidates[at]))
    };
    let q_low = of(&mut low[..lows.min(CANDIDATES)], 1.0, share);
    (q_low, of(&mut high[..highs.min(CANDIDATES)], -1.0, 1.0 - share))
}

/// [`quantile`] of values in any order, which are in another one on return.
fn quantile_of(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let (below, weight) = plotting_position(values.len(), share);
    let (_, &mut low, above) = values.select_nth_unstable_by(below, f64::total_cmp);
    let high = above.iter().copied().min_by(f64::total_cmp).unwrap_or(low);
    low + weight * (high - low)
}

/// The value below a quantile, and how far it is from there to the next.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn plotting_position(count: usize, share: f64) -> (usize, f64) {
    let position = (share * (count as f64 + 1.0) - 1.0).clamp(0.0, count as f64 - 1.0);
    let below = position.floor() as usize;
    (below, position - below as f64)
}

#[cfg(test)]
mod tests {
    use super::{mean_and_sd, outer_quantiles, quantile};

    /// Candidates in the tails give what sorting gives, and where there are too few or too many, so does the rest.
    #[test]
    fn outer_quantiles_are_those_of_the_sorted_values() {
        for count in [1, 2, 3, 17, 40, 100, 300, 1000] {
            for shape in 0..4 {
                let value = |k: usize| match shape {
                    0 => (1.7 * k as f64).sin(),
                    1 => (12.9898 * k as f64).sin() * 43_758.545_3 % 1.0,
                    2 => f64::from(u8::from(k % 20 == 3)),
                    _ => (0.3 * (7.1 * k as f64).cos()).exp().powi(9),
                };
                let mut values: Vec<f64> = (0..count).map(value).collect();
                let mut sorted = values.clone();
                sorted.sort_by(f64::total_cmp);
                let found = outer_quantiles(&mut values, 0.05, mean_and_sd(&sorted));
                let expected = (quantile(&sorted, 0.05), quantile(&sorted, 0.95));
                let off = (found.0 - expected.0).abs().max((found.1 - expected.1).abs());
                assert!(off < 1e-14 * sorted[count - 1].abs().max(1.0), "{count} {shape}: {found:?} {expected:?}");
            }
        }
    }
}
