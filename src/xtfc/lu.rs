//! LU factorisation with partial pivoting of small dense matrices, in the storage of the caller.

/// Factorises a square matrix `a` `[n x n]`, row-major, in place: L below the diagonal (unit diagonal), U on and above;
/// row `k` was exchanged with row `pivots[k]` `[n]` at step `k`. Returns the ratio of the largest to the smallest pivot,
/// infinite if singular.
pub(super) fn factorise(a: &mut [f64], pivots: &mut [usize]) -> f64 {
    let n = pivots.len();
    let (mut largest, mut smallest) = (0.0_f64, f64::INFINITY);
    for k in 0..n {
        let mut pivot_row = k;
        for i in k + 1..n {
            if a[i * n + k].abs() > a[pivot_row * n + k].abs() {
                pivot_row = i;
            }
        }
        pivots[k] = pivot_row;
        if pivot_row != k {
            let (upper, lower) = a.split_at_mut(pivot_row * n);
            upper[k * n..(k + 1) * n].swap_with_slice(&mut lower[..n]);
        }
        let pivot = a[k * n + k];
        largest = largest.max(pivot.abs());
        smallest = smallest.min(pivot.abs());
        let (upper, lower) = a.split_at_mut((k + 1) * n);
        let row_k = &upper[k * n + k + 1..];
        let reciprocal = 1.0 / pivot;
        for row in lower.chunks_exact_mut(n) {
            let factor = row[k] * reciprocal;
            row[k] = factor;
            // The matrices are sparse until fill-in.
            if factor.to_bits() << 1 != 0 {
                for (a, b) in row[k + 1..].iter_mut().zip(row_k) {
                    *a -= factor * b;
                }
            }
        }
    }
    if smallest > 0.0 && largest.is_finite() { largest / smallest } else { f64::INFINITY }
}

/// Solves `A x = b` in place, for a matrix that [`factorise`] has taken apart.
pub(super) fn solve(a: &[f64], pivots: &[usize], b: &mut [f64]) {
    let n = pivots.len();
    for (k, &p) in pivots.iter().enumerate() {
        b.swap(k, p);
    }
    for i in 1..n {
        let (known, rest) = b.split_at_mut(i);
        rest[0] -= super::problem::dot(&a[i * n..i * n + i], known);
    }
    for i in (0..n).rev() {
        let (rest, known) = b.split_at_mut(i + 1);
        let sum = super::problem::dot(&a[i * n + i + 1..(i + 1) * n], known);
        rest[i] = (rest[i] - sum) / a[i * n + i];
    }
}

/// Solves `A^T x = b` in place, likewise.
pub(super) fn solve_transposed(a: &[f64], pivots: &[usize], b: &mut [f64]) {
    let n = pivots.len();
    for i in 0..n {
        let value = b[i] / a[i * n + i];
        b[i] = value;
        for (j, x) in b.iter_mut().enumerate().skip(i + 1) {
            *x -= a[i * n + j] * value;
        }
    }
    for i in (1..n).rev() {
        let value = b[i];
        for (x, l) in b[..i].iter_mut().zip(&a[i * n..i * n + i]) {
            *x -= l * value;
        }
    }
    for (k, &p) in pivots.iter().enumerate().rev() {
        b.swap(k, p);
    }
}

/// Solves the symmetric positive definite `n x n` system in place by Cholesky; false if it is not definite.
pub(super) fn solve_spd(a: &mut [f64], n: usize, b: &mut [f64]) -> bool {
    for j in 0..n {
        for i in j..n {
            let (row_i, row_j) = (i * n, j * n);
            let sum: f64 = (0..j).map(|k| a[row_i + k] * a[row_j + k]).sum();
            let value = a[row_i + j] - sum;
            if i == j {
                if value.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
                    return false;
                }
                a[row_i + j] = value.sqrt();
            } else {
                a[row_i + j] = value / a[row_j + j];
            }
        }
    }
    substitute(a, n, b);
    true
}

/// `(L L^T)^-1 b` in place, for a lower triangular `L` `[n x n]` without zeros on the diagonal.
pub(crate) fn substitute(l: &[f64], n: usize, b: &mut [f64]) {
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| l[i * n + k] * b[k]).sum();
        b[i] = (b[i] - sum) / l[i * n + i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| l[k * n + i] * b[k]).sum();
        b[i] = (b[i] - sum) / l[i * n + i];
    }
}
