//! `coupled`: every window with data is a small Bayesian update, and the ensemble carries the posterior on.
//!
//! Prior of each member: its own forecast as mean, the ensemble's sample covariance of (initial state, parameter
//! coordinates) as covariance. With perturbed observations this is randomised maximum likelihood; for a linear model
//! it is the stochastic ensemble Kalman filter, and tends to the exact Kalman filter as members are added.

use crate::estimate::statistics::{centred, dot};
use crate::xtfc::lu::substitute;

/// Pivots below this share of the variance they came from are rounding: the direction has no spread left.
const SINGULAR: f64 = 1e-12;

/// `root root^T` into `out`, `[n x n]`.
pub fn square(root: &[f64], n: usize, out: &mut Vec<f64>) {
    out.clear();
    for a in root.chunks_exact(n) {
        out.extend(root.chunks_exact(n).map(|b| dot(a, b)));
    }
}

/// Inverse covariance of samples in units of their noise `sd`, `[m x m]`, into `out`, from the covariance of what is
/// expected of them, which is gone on return.
pub fn precision(factor: &mut [f64], sd: &[f64], out: &mut Vec<f64>) {
    let m = sd.len();
    for (j, row) in factor.chunks_exact_mut(m).enumerate() {
        row.iter_mut().zip(sd).for_each(|(entry, other)| *entry /= sd[j] * other);
        row[j] += 1.0;
    }
    semidefinite_cholesky(factor, m);
    out.clear();
    out.resize(m * m, 0.0);
    for (j, row) in out.chunks_exact_mut(m).enumerate() {
        row[j] = 1.0;
        substitute(factor, m, row);
    }
}

/// Sample covariance of two sets of rows over the members, `[n_a x n_b]`.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn covariance(a: &[f64], b: &[f64], members: usize) -> Vec<f64> {
    let (a, b): (Vec<_>, Vec<_>) =
        (a.chunks_exact(members).map(centred).collect(), b.chunks_exact(members).map(centred).collect());
    let degrees = members as f64 - 1.0;
    let mut out = Vec::with_capacity(a.len() * b.len());
    for a in &a {
        out.extend(b.iter().map(|b| dot(a, b) / degrees));
    }
    out
}

/// The covariance of samples from that of what is expected of them `[m x m]`, and the noise of each.
pub(crate) fn with_noise(mut expected: Vec<f64>, sd: &[f64]) -> Vec<f64> {
    let m = sd.len();
    sd.iter().enumerate().for_each(|(j, sd)| expected[j * m + j] += sd * sd);
    expected
}

/// `cross S^-1` for symmetric `S` `[m x m]`, `[n x m]`; None if `S` is not definite.
pub(crate) fn gain(cross: &[f64], innovation: &[f64], m: usize) -> Option<Vec<f64>> {
    let mut factor = innovation.to_vec();
    semidefinite_cholesky(&mut factor, m);
    if (0..m).any(|i| factor[i * m + i] <= 0.0) {
        return None;
    }
    let mut gain = cross.to_vec();
    gain.chunks_exact_mut(m).for_each(|row| substitute(&factor, m, row));
    Some(gain)
}

/// Cholesky in place on the lower triangle; columns without variance become zero.
#[allow(clippy::inline_always)]
#[inline(always)]
pub(crate) fn semidefinite_cholesky(a: &mut [f64], n: usize) {
    for j in 0..n {
        let variance = a[j * n + j];
        let mut pivot = variance;
        for k in 0..j {
            pivot -= a[j * n + k] * a[j * n + k];
        }
        if pivot <= SINGULAR * variance || pivot.is_nan() {
            (j..n).for_each(|i| a[i * n + j] = 0.0);
            continue;
        }
        let diagonal = pivot.sqrt();
        a[j * n + j] = diagonal;
        for i in j + 1..n {
            let mut rest = a[i * n + j];
            for k in 0..j {
                rest -= a[i * n + k] * a[j * n + k];
            }
            a[i * n + j] = rest / diagonal;
        }
    }
}
