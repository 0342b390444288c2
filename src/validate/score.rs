//! Scores of estimates against the truth.
//!
//! Errors, widths and CRPS are in per cent of the root mean square of the truth, so that mmHg and mL can stand in one
//! table; `truth_rms` brings them back.
//!
//! The continuous ranked probability score judges the whole distribution: `CRPS = E|X - y| - E|X - X'| / 2` for the
//! truth `y` and independent draws `X, X'`; for a sure estimate it is the absolute error. It is taken over the members,
//! in its fair form (pairs of different members only: the score of the distribution that they are drawn from, so that
//! few members are no disadvantage). What is published without members, as the figures of a beat are, is taken for normal
//! with the published mean and 90 % band.

use crate::estimate::statistics::{Summary, mean_and_sd, quantile};

/// 75 % and 95 % quantile of the standard normal distribution.
const NORMAL_75: f64 = 0.674_489_750_196_081_7;
const NORMAL_95: f64 = 1.644_853_626_951_472_7;

/// An estimate that stays within this share of the truth has converged.
const CONVERGED: f64 = 0.05;

/// Share of the way after a step at which it counts as seen.
const SEEN: f64 = 0.9;

/// An estimate of one number at one time, and the truth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// When \[s\].
    pub time_s: f64,
    /// What is true.
    pub truth: f64,
    /// Mean of what is believed.
    pub mean: f64,
    /// Quantiles of 25 and 75 %.
    pub half: (f64, f64),
    /// Quantiles of 5 and 95 %.
    pub band: (f64, f64),
    /// Continuous ranked probability score.
    pub crps: f64,
}

impl Point {
    /// Of a published summary and the members behind it, sorted on return; without members, or where they have no
    /// spread, what is believed is taken for normal.
    ///
    /// A published band can be wider than its members, where the model is known not to fit, and members may be of a
    /// moment later; so they are moved and stretched to the published mean and band.
    #[must_use]
    pub fn new(time_s: f64, truth: f64, published: &Summary, members: &mut [f64]) -> Self {
        let Summary { mean, q05, q95, .. } = *published;
        members.sort_unstable_by(f64::total_cmp);
        let own = quantile(members, 0.95) - quantile(members, 0.05);
        let (half, crps) = if own > 0.0 {
            let (centre, stretch) = (mean_and_sd(members).0, (q95 - q05) / own);
            members.iter_mut().for_each(|x| *x = mean + (*x - centre) * stretch);
            ((quantile(members, 0.25), quantile(members, 0.75)), crps_of_members(members, truth))
        } else {
            let sd = (q95 - q05) / (2.0 * NORMAL_95);
            ((mean - NORMAL_75 * sd, mean + NORMAL_75 * sd), crps_of_normal(mean, sd, truth))
        };
        Self { time_s, truth, mean, half, band: (q05, q95), crps }
    }
}

/// Fair CRPS of ascending members.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn crps_of_members(sorted: &[f64], truth: f64) -> f64 {
    let n = sorted.len() as f64;
    let error = sorted.iter().map(|x| (x - truth).abs()).sum::<f64>() / n;
    if sorted.len() < 2 {
        return error;
    }
    // Over ascending values the sum over pairs needs one pass.
    let pairs: f64 = sorted.iter().enumerate().map(|(i, x)| (2.0 * i as f64 - n + 1.0) * x).sum();
    error - pairs / (n * (n - 1.0))
}

/// CRPS of a normal distribution (Gneiting and Raftery 2007).
#[must_use]
pub fn crps_of_normal(mean: f64, sd: f64, truth: f64) -> f64 {
    let error = (truth - mean).abs();
    if sd <= 0.0 {
        return error;
    }
    let z = error / sd;
    let density = (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
    let inside = 1.0 - erfc(z / std::f64::consts::SQRT_2);
    sd * (z * inside + 2.0 * density - 1.0 / std::f64::consts::PI.sqrt())
}

/// Complementary error function of a positive number, to 1e-7 (Chebyshev fit of Press et al., Numerical Recipes).
fn erfc(x: f64) -> f64 {
    const FIT: [f64; 10] = [
        -1.265_512_23,
        1.000_023_68,
        0.374_091_96,
        0.096_784_18,
        -0.186_288_06,
        0.278_868_07,
        -1.135_203_98,
        1.488_515_87,
        -0.822_152_23,
        0.170_872_77,
    ];
    let t = 1.0 / (1.0 + 0.5 * x);
    t * (-x * x + FIT.iter().rev().fold(0.0, |sum, c| sum * t + c)).exp()
}

/// One quantity over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name of the quantity.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// In order of time.
    pub points: Vec<Point>,
}

/// How good one series is. NaN where there is nothing to score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Number of times scored.
    pub count: usize,
    /// Root mean square of the truth, in the unit of the quantity.
    pub truth_rms: f64,
    /// Root mean square error of the mean \[% of `truth_rms`\].
    pub rmse: f64,
    /// Mean of estimate minus truth \[% of `truth_rms`\].
    pub bias: f64,
    /// Share of times with the truth between the 25 and 75 % quantiles \[%\].
    pub coverage_50: f64,
    /// Share of times with the truth between the 5 and 95 % quantiles \[%\].
    pub coverage_90: f64,
    /// Mean width of the latter band \[% of `truth_rms`\].
    pub width_90: f64,
    /// Mean continuous ranked probability score \[% of `truth_rms`\].
    pub crps: f64,
    /// First time after which a parameter stays within 5 % of the truth, up to the step \[s\]; NaN if it never does.
    pub converged_s: f64,
    /// From the step to 90 % of the way, for a parameter that steps \[s\]; NaN if it does not, or never gets there.
    pub lag_s: f64,
}

impl Score {
    /// Of the times from `from_s` on.
    #[must_use]
    pub fn new(series: &Series, from_s: f64) -> Self {
        let first = series.points.partition_point(|point| point.time_s < from_s);
        let points = &series.points[first..];
        let truth_rms = mean(points, |p| p.truth * p.truth).sqrt();
        let percent = |value: f64| 100.0 * value / truth_rms;
        let inside = |(low, high): (f64, f64), truth: f64| f64::from(u8::from((low..=high).contains(&truth)));
        Self {
            count: points.len(),
            truth_rms,
            rmse: percent(mean(points, |p| (p.mean - p.truth).powi(2)).sqrt()),
            bias: percent(mean(points, |p| p.mean - p.truth)),
            coverage_50: 100.0 * mean(points, |p| inside(p.half, p.truth)),
            coverage_90: 100.0 * mean(points, |p| inside(p.band, p.truth)),
            width_90: percent(mean(points, |p| p.band.1 - p.band.0)),
            crps: percent(mean(points, |p| p.crps)),
            converged_s: f64::NAN,
            lag_s: f64::NAN,
        }
    }

    /// With what only parameters have.
    #[must_use]
    pub fn of_parameter(series: &Series, from_s: f64, step_s: Option<f64>) -> Self {
        Self {
            converged_s: converged_s(&series.points, step_s).unwrap_or(f64::NAN),
            lag_s: step_s.and_then(|step_s| lag_s(&series.points, step_s)).unwrap_or(f64::NAN),
            ..Self::new(series, from_s)
        }
    }
}

#[allow(clippy::cast_precision_loss)]
fn mean(points: &[Point], of: impl Fn(&Point) -> f64) -> f64 {
    points.iter().map(of).sum::<f64>() / points.len() as f64
}

/// First time after which the mean stays within 5 % of the truth until `until_s`.
fn converged_s(points: &[Point], until_s: Option<f64>) -> Option<f64> {
    let until = until_s.map_or(points.len(), |until_s| points.partition_point(|p| p.time_s < until_s));
    let points = &points[..until];
    let close = |p: &Point| (p.mean - p.truth).abs() <= CONVERGED * p.truth.abs();
    let last_off = points.iter().rposition(|p| !close(p));
    points.get(last_off.map_or(0, |i| i + 1)).map(|p| p.time_s)
}

/// From the step until the mean has gone 90 % of the way from where it was to the truth after the step; None where the
/// truth does not step.
fn lag_s(points: &[Point], step_s: f64) -> Option<f64> {
    let at = points.partition_point(|p| p.time_s < step_s);
    let (before, after) = (points.get(at.checked_sub(1)?)?, &points[at..]);
    let way = after.first()?.truth - before.truth;
    // A parameter that only wanders moves far less between two estimates.
    if way.abs() < 2.0 * CONVERGED * before.truth.abs() {
        return None;
    }
    let gone = |p: &&Point| (p.mean - before.mean) * way.signum() >= SEEN * (p.truth - before.mean) * way.signum();
    after.iter().find(gone).map(|p| p.time_s - step_s)
}

/// Median of what is a number; NaN of nothing.
#[must_use]
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    quantile(&values, 0.5)
}

/// Mean of what is a number; NaN of nothing.
#[must_use]
pub fn mean_of_numbers(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    mean_and_sd(&values).0
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn series(points: Vec<Point>) -> Series {
        Series { name: "x", unit: "", points }
    }

    fn point(time_s: f64, truth: f64, mean: f64) -> Point {
        Point { time_s, truth, mean, half: (mean - 1.0, mean + 1.0), band: (mean - 2.0, mean + 2.0), crps: 0.5 }
    }

    #[test]
    fn the_error_function_is_that_of_the_tables() {
        for (x, expected) in [(0.0, 1.0), (0.5, 0.479_500_122_2), (1.0, 0.157_299_207_1), (2.0, 0.004_677_735_0)] {
            assert!((erfc(x) - expected).abs() < 2e-7, "erfc({x}) = {}", erfc(x));
        }
    }

    #[test]
    fn crps_of_many_normal_members_is_that_of_the_normal_distribution() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut members: Vec<f64> = (0..200_000)
            .map(|_| {
                let e: f64 = StandardNormal.sample(&mut rng);
                5.0 + 2.0 * e
            })
            .collect();
        members.sort_unstable_by(f64::total_cmp);
        for truth in [5.0, 6.0, 2.0, 15.0] {
            let (sampled, exact) = (crps_of_members(&members, truth), crps_of_normal(5.0, 2.0, truth));
            assert!((sampled - exact).abs() < 0.01, "{truth}: {sampled} against {exact}");
        }
        // At the centre: sd (sqrt(2) - 1) / sqrt(pi).
        let centre = 2.0 * (2f64.sqrt() - 1.0) / std::f64::consts::PI.sqrt();
        assert!((crps_of_normal(5.0, 2.0, 5.0) - centre).abs() < 1e-6);
    }

    /// The fair form of few members is right on average.
    #[test]
    fn crps_does_not_depend_on_the_number_of_members() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let repeats = 20_000;
        let mut sum = 0.0;
        for _ in 0..repeats {
            let mut members: Vec<f64> = (0..5).map(|_| StandardNormal.sample(&mut rng)).collect();
            members.sort_unstable_by(f64::total_cmp);
            sum += crps_of_members(&members, 0.7);
        }
        let (few, exact) = (sum / f64::from(repeats), crps_of_normal(0.0, 1.0, 0.7));
        assert!((few - exact).abs() < 0.01, "{few} against {exact}");
    }

    #[test]
    fn a_sure_estimate_has_its_error_as_crps() {
        assert!((crps_of_normal(3.0, 0.0, 5.0) - 2.0).abs() < 1e-12);
        assert!((crps_of_members(&[3.0, 3.0, 3.0], 5.0) - 2.0).abs() < 1e-12);
    }

    #[test]
    fn members_are_stretched_to_the_published_band() {
        let mut members: Vec<f64> = (0..99).map(f64::from).collect();
        let own =
            Summary { mean: 49.0, q05: quantile(&members, 0.05), q95: quantile(&members, 0.95), ..Summary::default() };
        let same = Point::new(0.0, 50.0, &own, &mut members.clone());
        assert!((same.half.0 - 24.0).abs() < 1e-9 && (same.half.1 - 74.0).abs() < 1e-9, "{same:?}");
        let wider = Summary { mean: 100.0, q05: 100.0 - 90.0, q95: 100.0 + 90.0, ..Summary::default() };
        let wide = Point::new(0.0, 50.0, &wider, &mut members);
        assert!((wide.half.0 - 50.0).abs() < 1e-9 && (wide.half.1 - 150.0).abs() < 1e-9, "{wide:?}");
        let normal = Point::new(0.0, 100.0, &wider, &mut []);
        assert!((normal.half.1 - 100.0 - 90.0 * NORMAL_75 / NORMAL_95).abs() < 1e-9, "{normal:?}");
        assert!((normal.crps - crps_of_normal(100.0, 90.0 / NORMAL_95, 100.0)).abs() < 1e-9);
    }

    #[test]
    fn scores_of_a_known_series() {
        // Errors 0, 1.5 and 3: one in the half band, two in the band.
        let score = Score::new(&series([0.0, 1.5, 3.0].map(|e| point(1.0, 10.0, 10.0 + e)).to_vec()), 1.0);
        assert_eq!(score.count, 3);
        assert!((score.truth_rms - 10.0).abs() < 1e-12);
        assert!((score.rmse - 10.0 * (11.25_f64 / 3.0).sqrt()).abs() < 1e-9);
        assert!((score.bias - 15.0).abs() < 1e-9);
        assert!((score.coverage_50 - 100.0 / 3.0).abs() < 1e-9 && (score.coverage_90 - 200.0 / 3.0).abs() < 1e-9);
        assert!((score.width_90 - 40.0).abs() < 1e-9 && (score.crps - 5.0).abs() < 1e-9);
        assert!(Score::new(&series(vec![point(0.5, 1.0, 1.0)]), 1.0).rmse.is_nan(), "nothing to score");
    }

    #[test]
    fn converging_is_staying_close() {
        // Close, off, close from 3 s on, and off again after the step at 6 s.
        let means = [10.0, 12.0, 12.0, 10.4, 10.1, 9.6, 10.0, 10.0, 14.0, 15.0];
        let curve: Vec<Point> =
            (0..10_u8).map(|t| point(f64::from(t), if t < 6 { 10.0 } else { 15.0 }, means[usize::from(t)])).collect();
        let score = Score::of_parameter(&series(curve.clone()), 0.0, Some(6.0));
        assert!((score.converged_s - 3.0).abs() < 1e-12, "{}", score.converged_s);
        // 90 % of the way from 9.6 to 15 is 14.46.
        assert!((score.lag_s - 3.0).abs() < 1e-12, "{}", score.lag_s);
        assert!(Score::of_parameter(&series(curve), 0.0, None).converged_s > 8.5, "until the end without a step");
    }

    #[test]
    fn what_never_comes_is_not_a_number() {
        let flat: Vec<Point> = (0..10_u8).map(|t| point(f64::from(t), if t < 6 { 10.0 } else { 5.0 }, 20.0)).collect();
        let score = Score::of_parameter(&series(flat), 0.0, Some(6.0));
        assert!(score.converged_s.is_nan() && score.lag_s.is_nan());
        let still: Vec<Point> = (0..10_u8).map(|t| point(f64::from(t), 10.0, 10.0)).collect();
        assert!(Score::of_parameter(&series(still), 0.0, Some(6.0)).lag_s.is_nan(), "no step, no lag");
    }

    #[test]
    fn medians_leave_out_what_is_no_number() {
        assert!((median([3.0, f64::NAN, 1.0, 2.0].into_iter()) - 2.0).abs() < 1e-12);
        assert!(median(std::iter::empty()).is_nan() && mean_of_numbers(std::iter::empty()).is_nan());
    }
}
