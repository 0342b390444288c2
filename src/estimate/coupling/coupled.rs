//! `coupled`: every window with data is a small Bayesian update, and the ensemble carries the posterior on.
//!
//! Prior of each member: its own forecast as mean, the ensemble's sample covariance of (initial state, parameter
//! coordinates) as covariance. With perturbed observations this is randomised maximum likelihood; for a linear model
//! it is the stochastic ensemble Kalman filter, and tends to the exact Kalman filter as members are added.

use crate::estimate::statistics::{centred, dot};
use crate::xtfc::lu::substitute;

/// Pivots below this share of the variance they came from are rounding: the direction has no spread left.
const SINGULAR: f64 = 1e-12;

/// A triangular root of the sample covariance of `rows` `[n x n_members]`: `root root^T = covariance`.
///
/// `root` is `[n x n]`, row-major, lower triangular. A singular covariance (fewer members than unknowns, something
/// known exactly) leaves zero columns: directions without spread do not move.
#[allow(clippy::cast_precision_loss)]
pub fn covariance_root(rows: &[f64], members: usize, root: &mut Vec<f64>) {
    let n = rows.len() / members;
    let centred: Vec<Vec<f64>> = rows.chunks_exact(members).map(centred).collect();
    root.clear();
    root.resize(n * n, 0.0);
    for (i, a) in centred.iter().enumerate() {
        for (j, b) in centred[..=i].iter().enumerate() {
            root[i * n + j] = dot(a, b) / (members as f64 - 1.0);
        }
    }
    semidefinite_cholesky(root, n);
}

/// `root root^T`, `[n x n]`.
#[must_use]
pub fn square(root: &[f64], n: usize) -> Vec<f64> {
    root.chunks_exact(n).flat_map(|a| root.chunks_exact(n).map(|b| dot(a, b)).collect::<Vec<_>>()).collect()
}

/// Inverse covariance of samples in units of their noise, `[m x m]`, from the covariance of what is expected of them.
#[must_use]
pub fn precision(expected: &[f64], sd: &[f64]) -> Vec<f64> {
    let m = sd.len();
    let mut factor = expected.to_vec();
    for (j, row) in factor.chunks_exact_mut(m).enumerate() {
        row.iter_mut().zip(sd).for_each(|(entry, other)| *entry /= sd[j] * other);
        row[j] += 1.0;
    }
    semidefinite_cholesky(&mut factor, m);
    let mut inverse = vec![0.0; m * m];
    for (j, row) in inverse.chunks_exact_mut(m).enumerate() {
        row[j] = 1.0;
        substitute(&factor, m, row);
    }
    inverse
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
pub(crate) fn semidefinite_cholesky(a: &mut [f64], n: usize) {
    for j in 0..n {
        let variance = a[j * n + j];
        let known: f64 = (0..j).map(|k| a[j * n + k] * a[j * n + k]).sum();
        let pivot = variance - known;
        if pivot <= SINGULAR * variance || pivot.is_nan() {
            (j..n).for_each(|i| a[i * n + j] = 0.0);
            continue;
        }
        let diagonal = pivot.sqrt();
        a[j * n + j] = diagonal;
        for i in j + 1..n {
            let known: f64 = (0..j).map(|k| a[i * n + k] * a[j * n + k]).sum();
            a[i * n + j] = (a[i * n + j] - known) / diagonal;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::covariance_root;

    #[test]
    fn the_root_squares_to_the_sample_covariance() {
        // Third column = first + second: singular.
        let (a, b) = ([1.0, 0.5, -2.0, 0.1], [2.0, -1.0, 0.3, 0.4]);
        let rows: Vec<f64> = a.into_iter().chain(b).chain(std::array::from_fn::<f64, 4, _>(|i| a[i] + b[i])).collect();
        let mut root = Vec::new();
        covariance_root(&rows, 4, &mut root);
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = (0..3).map(|k| root[i * 3 + k] * root[j * 3 + k]).sum();
                let (a, b) = (&rows[4 * i..4 * i + 4], &rows[4 * j..4 * j + 4]);
                let (ma, mb) = (a.iter().sum::<f64>() / 4.0, b.iter().sum::<f64>() / 4.0);
                let covariance: f64 = a.iter().zip(b).map(|(x, y)| (x - ma) * (y - mb)).sum::<f64>() / 3.0;
                assert!((product - covariance).abs() < 1e-12, "{product} against {covariance}");
            }
        }
        assert!(root[8].abs() < 1e-6, "the dependent direction has no spread of its own");
    }
}
