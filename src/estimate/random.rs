//! Random numbers over the members, with the moments they ought to have.
//!
//! A hundred independent draws have a mean that is not zero and correlations that are not there: the noise that is
//! added to the members in every window would feed both into the covariance of the ensemble, and the members would
//! contract faster than the data allow. Here every row of draws is centred, has variance 1, and is orthogonal to the
//! other rows and to the deviations of the members themselves (second-order exact sampling; Pham 2001, Hoteit et al.
//! 2015). For a linear model the ensemble then has exactly the mean and covariance of the Kalman filter, whatever the
//! number of members.

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::cloud::{Cloud, centre, degrees};
use super::statistics::dot;
use crate::model::lanes::InstructionSet;

/// Directions that are taken out of a row at a time.
const GROUP: usize = 8;

/// A source of exact normals. Their sequence does not depend on when they are drawn.
#[derive(Debug, Clone)]
pub struct Normals {
    rng: ChaCha8Rng,
    instructions: InstructionSet,
    /// Drawn and not used yet, the next one last.
    ahead: Vec<f64>,
}

impl Normals {
    /// From a generator.
    #[must_use]
    pub fn new(rng: ChaCha8Rng, instructions: InstructionSet) -> Self {
        Self { rng, instructions, ahead: Vec::new() }
    }

    /// Draws ahead as much as the next window may need, where it costs nothing: beside other work.
    pub fn draw_ahead(&mut self, count: usize) {
        if self.ahead.len() < count {
            let missing = count - self.ahead.len();
            // The next one last: what there is goes behind what comes after it.
            let known = self.ahead.len();
            self.ahead.resize(count, 0.0);
            self.ahead.copy_within(0..known, missing);
            for value in self.ahead[..missing].iter_mut().rev() {
                *value = StandardNormal.sample(&mut self.rng);
            }
        }
    }

    /// `rows x members` standard normals, row-major, into `out`: centred, of sample variance 1 and, where there are members
    /// enough, orthogonal to each other and to the deviations of the members in `against`.
    pub fn draw(&mut self, rows: usize, members: usize, against: Option<&Cloud>, out: &mut Vec<f64>) {
        self.draw_ahead(rows * members);
        out.clear();
        let left = self.ahead.len() - rows * members;
        out.extend(self.ahead.drain(left..).rev());
        // Few members have too few directions left to be random in.
        let exact = members > 2 * (rows + against.map_or(0, Cloud::len)) + 1;
        let against = against.filter(|_| exact).map_or(&[][..], Cloud::directions);
        self.instructions.run(Exact { members, against, exact, rows: out });
    }
}

/// What runs in code for an instruction set.
struct Exact<'a> {
    members: usize,
    against: &'a [f64],
    exact: bool,
    rows: &'a mut [f64],
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for Exact<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { members, against, exact, rows } = self;
        let degrees = degrees(members);
        for i in 0..rows.len().checked_div(members).unwrap_or(0) {
            let (known, rest) = rows.split_at_mut(i * members);
            let row = &mut rest[..members];
            centre(row);
            take_out(row, against, degrees);
            if exact {
                take_out(row, known, degrees);
            }
            let variance = dot(row, row) / degrees;
            if variance > 0.0 {
                let factor = 1.0 / variance.sqrt();
                for value in row {
                    *value *= factor;
                }
            }
        }
    }
}

/// Takes orthogonal directions of sample variance 1 (or none) out of a random row, of which they are a small part: once is
/// enough.
#[allow(clippy::inline_always)]
#[inline(always)]
fn take_out(row: &mut [f64], directions: &[f64], degrees: f64) {
    let members = row.len();
    for group in directions.chunks(GROUP * members) {
        // All of a group at once: one after the other, each would have to wait for the one before.
        let mut along = [0.0; GROUP];
        for (along, direction) in along.iter_mut().zip(group.chunks_exact(members)) {
            *along = dot(direction, row) / degrees;
        }
        for (along, direction) in along.iter().zip(group.chunks_exact(members)) {
            for (value, d) in row.iter_mut().zip(direction) {
                *value -= along * d;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::{Cloud, InstructionSet, Normals};

    fn normals() -> Normals {
        Normals::new(ChaCha8Rng::seed_from_u64(5), InstructionSet::best())
    }

    fn draw(normals: &mut Normals, rows: usize, members: usize, against: &[f64]) -> Vec<f64> {
        let mut out = Vec::new();
        let cloud = Cloud::of(against, members, InstructionSet::best());
        normals.draw(rows, members, Some(&cloud), &mut out);
        out
    }

    #[test]
    fn draws_are_centred_of_variance_one_and_orthogonal_to_each_other_and_to_what_is_given() {
        let (members, mut normals) = (30, normals());
        let given = draw(&mut normals, 3, members, &[]);
        let all: Vec<f64> = given.iter().copied().chain(draw(&mut normals, 4, members, &given)).collect();
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
        let draws = draw(&mut normals(), 2, 2, &[1.0, -1.0]);
        assert!(draws.chunks_exact(2).all(|row| (row[0] + row[1]).abs() < 1e-12 && row[0].abs() > 0.1));
    }

    #[test]
    fn drawing_ahead_changes_nothing() {
        let (mut one, mut other) = (normals(), normals());
        let expected: Vec<Vec<f64>> = (1..6).map(|rows| draw(&mut one, rows, 10, &[])).collect();
        for (rows, expected) in (1..6).zip(&expected) {
            other.draw_ahead(7 * rows);
            assert_eq!(draw(&mut other, rows, 10, &[]), *expected);
        }
    }
}
