//! Random numbers over the members, with the moments they ought to have.
//!
//! A hundred independent draws have a mean that is not zero and correlations that are not there: the noise that is
//! added to the members in every window would feed both into the covariance of the ensemble, and the members would
//! contract faster than the data allow. Here every row of draws is centred, has variance 1, and is orthogonal to the
//! other rows and to the deviations of the members themselves (second-order exact sampling; Pham 2001, Hoteit et al.
//! 2015). For a linear model the ensemble then has exactly the mean and covariance of the Kalman filter, whatever the
//! number of members.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::statistics::{dot, norm, sum};
use crate::model::lanes::InstructionSet;

/// Rows over the members, as an orthonormal and centred set.
#[derive(Debug, Clone, Default)]
pub struct Directions {
    members: usize,
    rows: Vec<f64>,
    instructions: InstructionSet,
    rest: Vec<f64>,
}

impl Directions {
    /// No direction yet.
    #[must_use]
    pub fn new(members: usize, instructions: InstructionSet) -> Self {
        Self { members, rows: Vec::new(), instructions, rest: Vec::new() }
    }

    /// Number of directions.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rows.len().checked_div(self.members).unwrap_or(0)
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Centres `row` `[n_members]` and takes the directions out of it; returns what is left of its length, as a share.
    pub fn reduce(&self, row: &mut [f64]) -> f64 {
        // Twice, because once is not orthogonal to rounding.
        self.instructions.run(Reduction { directions: &self.rows, row, passes: 2 })
    }

    /// The same for a random row, of which the directions are a small part: once is enough.
    fn reduce_random(&self, row: &mut [f64]) {
        self.instructions.run(Reduction { directions: &self.rows, row, passes: 1 });
    }

    /// Adds what `row` has beyond the directions known; nothing if that is rounding.
    pub fn add(&mut self, row: &[f64]) {
        let mut rest = std::mem::take(&mut self.rest);
        rest.clear();
        rest.extend_from_slice(row);
        if self.reduce(&mut rest) > 1e-9 {
            self.add_reduced(&rest);
        }
        self.rest = rest;
    }

    /// Adds a row that has been reduced.
    fn add_reduced(&mut self, row: &[f64]) {
        let length = norm(row);
        self.rows.extend(row.iter().map(|r| r / length));
    }

    /// Projections of the centred `row` on the directions.
    pub fn along<'a>(&'a self, row: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        self.rows.chunks_exact(self.members.max(1)).map(move |d| d.iter().zip(row).map(|(a, b)| a * b).sum())
    }
}

/// What runs in code for an instruction set.
struct Reduction<'a> {
    directions: &'a [f64],
    row: &'a mut [f64],
    passes: usize,
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for Reduction<'_> {
    type Output = f64;

    #[allow(clippy::cast_precision_loss)]
    #[inline(always)]
    fn call(self) -> f64 {
        let Self { directions, row, passes } = self;
        let mean = sum(row, |v| v) / row.len() as f64;
        row.iter_mut().for_each(|v| *v -= mean);
        let before = norm(row);
        for _ in 0..passes {
            for direction in directions.chunks_exact(row.len().max(1)) {
                let along = dot(direction, row);
                row.iter_mut().zip(direction).for_each(|(r, d)| *r -= along * d);
            }
        }
        if before > 0.0 { norm(row) / before } else { 0.0 }
    }
}

/// `rows x members` standard normals, row-major: centred, of sample variance 1 and, where there are members enough,
/// orthogonal to each other and to the rows of `against` `[any x members]`.
#[allow(clippy::cast_precision_loss)]
pub fn exact_normals<R: Rng>(
    rows: usize,
    members: usize,
    against: &[f64],
    rng: &mut R,
    instructions: InstructionSet,
) -> Vec<f64> {
    let mut taken = Directions::new(members, instructions);
    // Few members have too few directions left to be random in.
    let exact = members > 2 * (rows + against.len() / members.max(1)) + 1;
    if exact {
        against.chunks_exact(members).for_each(|row| taken.add(row));
    }
    let mut out = Vec::with_capacity(rows * members);
    let target = (members as f64 - 1.0).max(1.0).sqrt();
    for _ in 0..rows {
        let at = out.len();
        out.extend((0..members).map(|_| -> f64 { StandardNormal.sample(rng) }));
        let row = &mut out[at..];
        taken.reduce_random(row);
        let length = norm(row);
        if length > 0.0 {
            row.iter_mut().for_each(|v| *v *= target / length);
        }
        if exact {
            taken.add_reduced(row);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::InstructionSet;

    fn exact_normals(rows: usize, members: usize, against: &[f64], rng: &mut ChaCha8Rng) -> Vec<f64> {
        super::exact_normals(rows, members, against, rng, InstructionSet::best())
    }

    #[test]
    fn draws_are_centred_of_variance_one_and_orthogonal_to_each_other_and_to_what_is_given() {
        let (members, mut rng) = (30, ChaCha8Rng::seed_from_u64(5));
        let given = exact_normals(3, members, &[], &mut rng);
        let all: Vec<f64> = given.iter().copied().chain(exact_normals(4, members, &given, &mut rng)).collect();
        for (i, a) in all.chunks_exact(members).enumerate() {
            assert!(a.iter().sum::<f64>().abs() < 1e-12, "centred");
            for (j, b) in all.chunks_exact(members).enumerate() {
                let product: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / 29.0;
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((product - expected).abs() < 1e-12, "{product} against {expected}");
            }
        }
    }

    #[test]
    fn two_members_still_differ() {
        let draws = exact_normals(2, 2, &[1.0, -1.0], &mut ChaCha8Rng::seed_from_u64(5));
        assert!(draws.chunks_exact(2).all(|row| (row[0] + row[1]).abs() < 1e-12 && row[0].abs() > 0.1));
    }
}
