//! Whether chains have mixed: split R-hat and effective samples (Gelman et al., *Bayesian Data Analysis*, 3rd edition,
//! 11.4 and 11.5), the latter with Geyer's monotone sequence.

/// Square root of the variance of all draws over the mean variance within half chains; NaN below four draws a chain.
pub(super) fn r_hat(chains: &[&[f64]]) -> f64 {
    let halves = halves(chains);
    (pooled_variance(&halves) / within(&halves)).sqrt()
}

/// How many independent draws the chains are worth.
pub(super) fn effective_samples(chains: &[&[f64]]) -> f64 {
    let halves = halves(chains);
    let n = halves.first().map_or(0, |half| half.len());
    let (within, pooled) = (within(&halves), pooled_variance(&halves));
    let correlation = |lag: usize| 1.0 - (within - mean(halves.iter().map(|half| covariance(half, lag)))) / pooled;
    let mut time = -1.0;
    let mut last = f64::INFINITY;
    for lag in (0..n.saturating_sub(1)).step_by(2) {
        let pair = (correlation(lag) + correlation(lag + 1)).min(last);
        // What follows is noise.
        if pair <= 0.0 {
            break;
        }
        time += 2.0 * pair;
        last = pair;
    }
    (n * halves.len()) as f64 / time
}

/// Both halves of each chain, of equal lengths.
fn halves<'a>(chains: &[&'a [f64]]) -> Vec<&'a [f64]> {
    chains.iter().flat_map(|chain| chain.chunks_exact((chain.len() / 2).max(1)).take(2)).collect()
}

/// Mean variance within chains.
fn within(chains: &[&[f64]]) -> f64 {
    mean(chains.iter().map(|chain| variance(chain)))
}

/// Variance of all draws: within chains and between their means.
fn pooled_variance(chains: &[&[f64]]) -> f64 {
    let n = chains.first().map_or(0, |chain| chain.len()) as f64;
    let means: Vec<f64> = chains.iter().map(|chain| mean(chain.iter().copied())).collect();
    within(chains) * (n - 1.0) / n + variance(&means)
}

/// Sample variance.
fn variance(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    covariance(values, 0) * n / (n - 1.0)
}

/// Between each value and the one `lag` later, over all values.
fn covariance(values: &[f64], lag: usize) -> f64 {
    let centre = mean(values.iter().copied());
    let products = values.iter().zip(&values[lag..]).map(|(a, b)| (a - centre) * (b - centre));
    products.sum::<f64>() / values.len() as f64
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / n
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// First-order autoregression: `(1 + a) / (1 - a)` draws are worth one.
    fn chain(stream: u64, a: f64, shift: f64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        rng.set_stream(stream);
        let mut x = 0.0;
        let mut next = || {
            let z: f64 = StandardNormal.sample(&mut rng);
            x = a * x + (1.0 - a * a).sqrt() * z;
            x + shift
        };
        (0..4_000).map(|_| next()).collect()
    }

    #[test]
    fn independent_draws_are_worth_themselves() {
        let (a, b) = (chain(0, 0.0, 0.0), chain(1, 0.0, 0.0));
        assert!((r_hat(&[&a, &b]) - 1.0).abs() < 2e-3);
        assert!((effective_samples(&[&a, &b]) / 8_000.0 - 1.0).abs() < 0.1);
    }

    #[test]
    fn correlated_draws_are_worth_less() {
        let (a, b) = (chain(0, 0.8, 0.0), chain(1, 0.8, 0.0));
        assert!((effective_samples(&[&a, &b]) * 9.0 / 8_000.0 - 1.0).abs() < 0.2);
    }

    #[test]
    fn chains_in_different_places_show() {
        let (a, b) = (chain(0, 0.0, 0.0), chain(1, 0.0, 3.0));
        assert!(r_hat(&[&a, &b]) > 1.5);
        assert!(effective_samples(&[&a, &b]) < 10.0);
    }
}
