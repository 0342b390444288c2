//! Summaries of an ensemble.

/// One quantity: where it is, and how uncertain by source.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Summary {
    /// Mean over the members.
    pub mean: f64,
    /// Total standard deviation: root of the sum of squares of the three below.
    pub sd: f64,
    /// Spread of the members: features, noise realisations, initial pressures, parameters.
    pub epistemic_sd: f64,
    /// Sensor noise; 0 for what is derived.
    pub aleatoric_sd: f64,
    /// Spread of the members' discrepancies; 0 without a discrepancy in the model.
    pub model_sd: f64,
    /// 5 % quantile of the true quantity, without sensor noise.
    pub q05: f64,
    /// 95 % quantile of the true quantity, without sensor noise.
    pub q95: f64,
}

/// Summarises one quantity over the members; `values` is sorted on return.
#[must_use]
pub fn summarise(values: &mut [f64], aleatoric_sd: f64, model_sd: f64) -> Summary {
    let (mean, epistemic_sd) = mean_and_sd(values);
    values.sort_unstable_by(f64::total_cmp);
    Summary {
        mean,
        sd: (epistemic_sd * epistemic_sd + aleatoric_sd * aleatoric_sd + model_sd * model_sd).sqrt(),
        epistemic_sd,
        aleatoric_sd,
        model_sd,
        q05: quantile(values, 0.05),
        q95: quantile(values, 0.95),
    }
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
