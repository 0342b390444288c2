//! Summaries of an ensemble.

use super::random::Directions;
use crate::model::lanes::InstructionSet;

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

/// Summarises one quantity over the members; `values` is sorted on return. `model_share` is the share of their variance
/// that belongs to the model ([`Explainers::share_of`]).
#[must_use]
pub fn summarise(values: &mut [f64], aleatoric_sd: f64, model_share: f64) -> Summary {
    let (mean, spread) = mean_and_sd(values);
    values.sort_unstable_by(f64::total_cmp);
    Summary {
        mean,
        sd: (spread * spread + aleatoric_sd * aleatoric_sd).sqrt(),
        epistemic_sd: spread * (1.0 - model_share).sqrt(),
        aleatoric_sd,
        model_sd: spread * model_share.sqrt(),
        q05: quantile(values, 0.05),
        q95: quantile(values, 0.95),
    }
}

/// Variables over the members (their discrepancies) that may explain the spread of others.
#[derive(Debug, Clone, Default)]
pub struct Explainers {
    members: usize,
    directions: Directions,
}

impl Explainers {
    /// From the rows of `variables`, each `[n_members]`.
    #[must_use]
    pub fn new(variables: &[f64], members: usize) -> Self {
        let mut directions = Directions::new(members, InstructionSet::default());
        variables.chunks_exact(members).for_each(|variable| directions.add(variable));
        Self { members, directions }
    }

    /// The share of the variance of `values` `[n_members]` that a linear regression on these variables explains,
    /// without what chance alone would explain (adjusted R squared, not below 0).
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn share_of(&self, values: &[f64]) -> f64 {
        let count = self.directions.len();
        if count == 0 || self.members < count + 2 {
            return 0.0;
        }
        let centred = centred(values);
        let explained: f64 = self.directions.along(&centred).map(|along| along * along).sum();
        let total = norm(&centred).powi(2);
        if total <= 0.0 {
            return 0.0;
        }
        let chance = (self.members as f64 - 1.0) / (self.members - 1 - count) as f64;
        (1.0 - (1.0 - explained / total) * chance).clamp(0.0, 1.0)
    }
}

#[allow(clippy::cast_precision_loss)]
pub(super) fn centred(values: &[f64]) -> Vec<f64> {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter().map(|v| v - mean).collect()
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
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
    let mean = values.iter().sum::<f64>() / n;
    if values.len() < 2 {
        return (mean, 0.0);
    }
    let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
    (mean, (squares / (n - 1.0)).sqrt())
}

/// Quantile of ascending values, interpolated so that `n` draws are unbiased for a uniform distribution
/// (plotting position `k / (n + 1)`, Weibull; type 6 of Hyndman and Fan).
#[must_use]
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return f64::NAN;
    };
    let position = (share * (sorted.len() as f64 + 1.0) - 1.0).clamp(0.0, last as f64);
    let below = position.floor() as usize;
    let above = (below + 1).min(last);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}
