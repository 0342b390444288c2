//! Rows over the members as a cloud of points: mean, covariance, and directions in which it has spread.

use super::coupling::coupled::semidefinite_cholesky;
use super::statistics::{dot, sum};
use crate::model::lanes::InstructionSet;

/// Rows over the members, taken apart. Reuse it.
#[derive(Debug, Clone, Default)]
pub struct Cloud {
    members: usize,
    mean: Vec<f64>,
    /// `[n x n]`, lower triangular: `root root^T` is the sample covariance.
    root: Vec<f64>,
    /// `[n x n_members]`: `root` times these are the deviations from the mean.
    directions: Vec<f64>,
}

impl Cloud {
    /// Of `rows` `[n x n_members]`.
    #[must_use]
    pub fn of(rows: &[f64], members: usize, instructions: InstructionSet) -> Self {
        let mut cloud = Self::default();
        cloud.set(rows, members, instructions);
        cloud
    }

    /// Takes the place of what it was, by `rows` `[n x n_members]`.
    pub fn set(&mut self, rows: &[f64], members: usize, instructions: InstructionSet) {
        let n = rows.len().checked_div(members).unwrap_or(0);
        self.members = members;
        self.directions.clear();
        self.directions.extend_from_slice(rows);
        self.mean.clear();
        self.mean.resize(n, 0.0);
        self.root.clear();
        self.root.resize(n * n, 0.0);
        let Self { mean, root, directions, .. } = self;
        instructions.run(TakeApart { members, mean, root, directions });
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.mean.len()
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.mean.is_empty()
    }

    /// Number of members.
    #[must_use]
    pub fn members(&self) -> usize {
        self.members
    }

    /// Mean of each row.
    #[must_use]
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// Standard deviation of a row.
    #[must_use]
    pub fn sd(&self, row: usize) -> f64 {
        let root = &self.root[row * self.len()..][..=row];
        root.iter().map(|r| r * r).sum::<f64>().sqrt()
    }

    /// A triangular root of the sample covariance, `[n x n]`. A singular covariance (fewer members than rows, something
    /// known exactly) leaves zero columns: directions without spread.
    #[must_use]
    pub fn root(&self) -> &[f64] {
        &self.root
    }

    /// `root^-1` times the deviations, `[n x n_members]`: centred, of sample variance 1, without correlation; zero where
    /// there is no spread.
    #[must_use]
    pub fn directions(&self) -> &[f64] {
        &self.directions
    }

    /// Directions with spread.
    #[must_use]
    pub fn rank(&self) -> usize {
        let n = self.len();
        (0..n).filter(|i| self.root[i * n + i] > 0.0).count()
    }
}

/// What runs in code for an instruction set.
struct TakeApart<'a> {
    members: usize,
    mean: &'a mut [f64],
    root: &'a mut [f64],
    directions: &'a mut [f64],
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for TakeApart<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { members, mean, root, directions } = self;
        let n = mean.len();
        for (mean, row) in mean.iter_mut().zip(directions.chunks_exact_mut(members)) {
            *mean = centre(row);
        }
        let degrees = degrees(members);
        for i in 0..n {
            let a = &directions[i * members..][..members];
            for j in 0..=i {
                root[i * n + j] = dot(a, &directions[j * members..][..members]) / degrees;
            }
        }
        semidefinite_cholesky(root, n);
        for i in 0..n {
            let (known, rest) = directions.split_at_mut(i * members);
            let row = &mut rest[..members];
            let factors = &root[i * n..][..=i];
            let pivot = if factors[i] > 0.0 { 1.0 / factors[i] } else { 0.0 };
            for (other, factor) in known.chunks_exact(members).zip(factors) {
                for (value, z) in row.iter_mut().zip(other) {
                    *value -= factor * z;
                }
            }
            for value in row {
                *value *= pivot;
            }
        }
    }
}

/// Takes the mean out of a row and returns it.
#[allow(clippy::inline_always, clippy::cast_precision_loss)]
#[inline(always)]
pub(super) fn centre(row: &mut [f64]) -> f64 {
    let mean = sum(row, |v| v) / row.len() as f64;
    for value in row {
        *value -= mean;
    }
    mean
}

/// Degrees of freedom of a sample variance.
#[allow(clippy::cast_precision_loss)]
pub(super) fn degrees(members: usize) -> f64 {
    (members as f64 - 1.0).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::Cloud;
    use crate::model::lanes::InstructionSet;

    #[test]
    fn the_root_squares_to_the_sample_covariance_and_the_directions_to_one() {
        // Third row = first + second: singular.
        let (a, b) = ([1.0, 0.5, -2.0, 0.1, 0.7], [2.0, -1.0, 0.3, 0.4, -0.6]);
        let rows: Vec<f64> = a.into_iter().chain(b).chain(std::array::from_fn::<f64, 5, _>(|i| a[i] + b[i])).collect();
        for instructions in InstructionSet::ALL {
            let cloud = Cloud::of(&rows, 5, instructions);
            for i in 0..3 {
                let row = |k: usize| &rows[5 * k..5 * k + 5];
                let mean = |k: usize| row(k).iter().sum::<f64>() / 5.0;
                assert!((cloud.mean()[i] - mean(i)).abs() < 1e-15);
                for j in 0..3 {
                    let product: f64 = (0..3).map(|k| cloud.root()[i * 3 + k] * cloud.root()[j * 3 + k]).sum();
                    let terms = row(i).iter().zip(row(j)).map(|(x, y)| (x - mean(i)) * (y - mean(j)));
                    let covariance: f64 = terms.sum::<f64>() / 4.0;
                    assert!((product - covariance).abs() < 1e-12, "{product} against {covariance}");
                    let directions = |k: usize| &cloud.directions()[5 * k..5 * k + 5];
                    let along: f64 = directions(i).iter().zip(directions(j)).map(|(x, y)| x * y).sum::<f64>() / 4.0;
                    let expected = if i == j && i < 2 { 1.0 } else { 0.0 };
                    assert!((along - expected).abs() < 1e-12, "{along} against {expected}");
                }
                assert!(
                    (cloud.sd(i).powi(2) - (0..3).map(|k| cloud.root()[i * 3 + k].powi(2)).sum::<f64>()).abs() < 1e-12
                );
            }
            assert_eq!(cloud.rank(), 2, "the dependent direction has no spread of its own");
        }
    }
}
