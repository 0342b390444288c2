//! The constrained expression of one member, orthonormalised.
//!
//! On a window of length `h` that starts at `x_k`, with `s` in `[0, 1]` the position in the window,
//!
//! ```text
//! x(s) = x_k + (sigma(s) - sigma(0))^T a = x_k + phi(s)^T beta        dx/dt = phi'(s)^T beta
//! ```
//!
//! Five tanh features with weights in `[-1, 1]` on a short interval are nearly dependent, so `a` itself is
//! numerically useless. The derivatives `d sigma/ds` are orthonormalised once per member in `L2(0, 1)`; directions
//! below [`RANK_TOLERANCE`] span nothing that double precision can tell apart and are dropped. That leaves the
//! function space unchanged. Since the window length is constant, so is everything here.
//!
//! With as many directions as nodes the basis is rotated further until the node derivatives are the identity:
//! `beta` then *is* `dx/dt` \[mmHg/s\] at the nodes, and the method is a collocation Runge-Kutta scheme.
//!
//! A function of which nothing is known at the start of the window has a free expression `sigma(s)^T a = psi(s)^T beta`
//! instead, with the values orthonormalised ([`Basis::with_free`]), and with values at the nodes for `beta` where
//! possible.

use std::sync::OnceLock;

use faer::Mat;

use super::dense::one_thread;
use super::features::{FeatureError, RandomFeatures, gauss_legendre};

/// Singular values below this share of the largest are rounding, not functions.
pub const RANK_TOLERANCE: f64 = 1e-12;

/// Node matrices worse conditioned than this are not inverted: the general solver copes.
const MAX_NODAL_CONDITION: f64 = 1e6;

/// The constrained expression of one member on windows of one length.
#[derive(Debug, Clone)]
pub struct Basis {
    features: RandomFeatures,
    /// `sigma_j(0)`.
    at_start: Vec<f64>,
    /// From features to directions, `[n_features x rank]`, row-major.
    transform: Vec<f64>,
    rank: usize,
    length_s: f64,
    /// Node positions in `[0, 1]`.
    positions: Vec<f64>,
    /// `phi` at the nodes \[s\], `[n_nodes x rank]`, row-major.
    values: Vec<f64>,
    /// `phi'` at the nodes, `[n_nodes x rank]`, row-major.
    rates: Vec<f64>,
    /// `phi` at the end of the window \[s\], `[rank]`.
    end: Vec<f64>,
    nodal: bool,
    condition: f64,
    free: Option<FreeExpression>,
}

/// `psi`, for functions without continuity.
#[derive(Debug, Clone)]
struct FreeExpression {
    /// From features to directions, `[n_features x rank]`, row-major.
    transform: Vec<f64>,
    /// `psi` at the nodes, `[n_nodes x rank]`, row-major.
    values: Vec<f64>,
    /// `psi` at the end of the window, `[rank]`.
    end: Vec<f64>,
}

impl Basis {
    /// Orthonormalises the features for windows of `length_s`.
    ///
    /// # Errors
    /// When the features span nothing.
    pub fn new(features: RandomFeatures, length_s: f64) -> Result<Self, FeatureError> {
        let (transform, condition) = orthonormalise(&features, slopes)?;
        let positions = features.spec.placement.positions(features.spec.nodes);
        let nodal = nodal_rotation(&transform, positions.len(), || slopes(&features, &positions));
        let (transform, is_nodal) = nodal.map_or((transform, false), |rotated| (rotated, true));

        let rank = transform.ncols();
        let flat = |m: &Mat<f64>| (0..m.nrows()).flat_map(|i| (0..rank).map(move |j| m[(i, j)])).collect();
        let mut basis = Self {
            at_start: features.at(0.0).map(|(value, _)| value).collect(),
            transform: flat(&transform),
            rank,
            length_s,
            values: vec![0.0; positions.len() * rank],
            rates: vec![0.0; positions.len() * rank],
            end: vec![0.0; rank],
            nodal: is_nodal,
            condition,
            free: None,
            features,
            positions: positions.clone(),
        };
        let (mut values, mut rates, mut end) = (basis.values.clone(), basis.rates.clone(), basis.end.clone());
        for (n, &s) in positions.iter().enumerate() {
            let here = n * rank..(n + 1) * rank;
            basis.values_and_rates_at(s, &mut values[here.clone()], &mut rates[here]);
        }
        basis.values_at(1.0, &mut end);
        (basis.values, basis.rates, basis.end) = (values, rates, end);
        Ok(basis)
    }

    /// With the free expression as well, in as many directions as the constrained one.
    ///
    /// # Errors
    /// When the features span nothing.
    pub fn with_free(mut self) -> Result<Self, FeatureError> {
        let rank = self.rank;
        let (all, _) = orthonormalise(&self.features, values)?;
        // The features have no more to say than their derivatives, up to a constant: directions beyond are dropped,
        // missing ones are zero, which the general solver copes with.
        let transform = Mat::from_fn(all.nrows(), rank, |i, j| if j < all.ncols() { all[(i, j)] } else { 0.0 });
        let at_nodes = values(&self.features, &self.positions);
        let nodal =
            if self.nodal { nodal_rotation(&transform, self.positions.len(), || at_nodes.clone()) } else { None };
        self.nodal = nodal.is_some();
        let transform = nodal.unwrap_or(transform);
        let at_end = values(&self.features, &[1.0]) * &transform;
        let at_nodes = at_nodes * &transform;
        let flat = |m: &Mat<f64>| (0..m.nrows()).flat_map(|i| (0..rank).map(move |j| m[(i, j)])).collect();
        self.free = Some(FreeExpression { transform: flat(&transform), values: flat(&at_nodes), end: flat(&at_end) });
        Ok(self)
    }

    /// Number of directions, the coefficients per state.
    #[must_use]
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// Window length \[s\].
    #[must_use]
    pub fn length_s(&self) -> f64 {
        self.length_s
    }

    /// Node positions in `[0, 1]`.
    #[must_use]
    pub fn positions(&self) -> &[f64] {
        &self.positions
    }

    /// `phi` at the nodes \[s\], `[n_nodes x rank]`.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// `phi'` at the nodes, `[n_nodes x rank]`; the identity if [`Basis::is_nodal`].
    #[must_use]
    pub fn rates(&self) -> &[f64] {
        &self.rates
    }

    /// `phi` at the end of the window \[s\].
    #[must_use]
    pub fn end(&self) -> &[f64] {
        &self.end
    }

    /// `psi` at the nodes, `[n_nodes x rank]`; the identity if [`Basis::is_nodal`], empty without a free expression.
    #[must_use]
    pub fn free_values(&self) -> &[f64] {
        self.free.as_ref().map_or(&[], |free| &free.values)
    }

    /// `psi` at the end of the window; empty without a free expression.
    #[must_use]
    pub fn free_end(&self) -> &[f64] {
        self.free.as_ref().map_or(&[], |free| &free.end)
    }

    /// Whether the coefficients are the derivatives (the values, where free) at the nodes.
    #[must_use]
    pub fn is_nodal(&self) -> bool {
        self.nodal
    }

    /// Condition number of the raw features before orthonormalisation (retained directions).
    #[must_use]
    pub fn condition(&self) -> f64 {
        self.condition
    }

    /// `phi(s)` \[s\] into `out` `[rank]`.
    pub fn values_at(&self, s: f64, out: &mut [f64]) {
        let shifted = self.features.at(s).zip(&self.at_start).map(|((value, _), start)| value - start);
        combine(shifted, self.length_s, &self.transform, out);
    }

    /// `phi(s)` \[s\] and `phi'(s)`, each `[rank]`.
    fn values_and_rates_at(&self, s: f64, values: &mut [f64], rates: &mut [f64]) {
        let features: Vec<(f64, f64)> = self.features.at(s).collect();
        let shifted = features.iter().zip(&self.at_start).map(|((value, _), start)| value - start);
        combine(shifted, self.length_s, &self.transform, values);
        combine(features.iter().map(|(_, slope)| *slope), 1.0, &self.transform, rates);
    }

    /// `psi(s)` into `out` `[rank]`; zero without a free expression.
    pub fn free_values_at(&self, s: f64, out: &mut [f64]) {
        match &self.free {
            Some(free) => combine(self.features.at(s).map(|(value, _)| value), 1.0, &free.transform, out),
            None => out.fill(0.0),
        }
    }
}

/// `scale transform^T features` into `out` `[rank]`.
fn combine(features: impl Iterator<Item = f64>, scale: f64, transform: &[f64], out: &mut [f64]) {
    out.fill(0.0);
    for (feature, row) in features.zip(transform.chunks_exact(out.len())) {
        for (o, t) in out.iter_mut().zip(row) {
            *o += scale * feature * t;
        }
    }
}

/// A rule of at least `points` points. Every member needs the same one, and finding it costs more than using it.
fn quadrature(points: usize) -> &'static [(f64, f64)] {
    static RULES: [OnceLock<Vec<(f64, f64)>>; 6] = [const { OnceLock::new() }; 6];
    // 32, 64, ... 1024 points, the last for any number of features that a member can have.
    let size = (0..RULES.len() - 1).find(|size| 32 << size >= points).unwrap_or(RULES.len() - 1);
    RULES[size].get_or_init(|| gauss_legendre(32 << size))
}

/// Values of the features at positions `s`, `[s.len() x n_features]`.
fn values(features: &RandomFeatures, s: &[f64]) -> Mat<f64> {
    let rows: Vec<Vec<f64>> = s.iter().map(|&s| features.at(s).map(|(value, _)| value).collect()).collect();
    Mat::from_fn(s.len(), features.count(), |i, j| rows[i][j])
}

/// Derivatives of the features at positions `s`, `[s.len() x n_features]`.
fn slopes(features: &RandomFeatures, s: &[f64]) -> Mat<f64> {
    let rows: Vec<Vec<f64>> = s.iter().map(|&s| features.at(s).map(|(_, slope)| slope).collect()).collect();
    Mat::from_fn(s.len(), features.count(), |i, j| rows[i][j])
}

/// The transform that makes values or derivatives orthonormal in `L2(0, 1)`, and the condition number it removed.
fn orthonormalise(
    features: &RandomFeatures,
    evaluate: fn(&RandomFeatures, &[f64]) -> Mat<f64>,
) -> Result<(Mat<f64>, f64), FeatureError> {
    let rule = quadrature(2 * features.count());
    let s: Vec<f64> = rule.iter().map(|(x, _)| 0.5 * (1.0 + x)).collect();
    let mut m = evaluate(features, &s);
    for (i, (_, weight)) in rule.iter().enumerate() {
        for j in 0..m.ncols() {
            m[(i, j)] *= (0.5 * weight).sqrt();
        }
    }
    one_thread();
    let svd = m.thin_svd().map_err(|_| FeatureError::Degenerate)?;
    let sigma: Vec<f64> = svd.S().column_vector().iter().copied().collect();
    let largest = sigma.first().copied().unwrap_or(0.0);
    if !(largest.is_finite() && largest > 0.0) {
        return Err(FeatureError::Degenerate);
    }
    let rank = sigma.iter().take_while(|&&s| s > RANK_TOLERANCE * largest).count();
    let v = svd.V();
    let transform = Mat::from_fn(features.count(), rank, |i, j| v[(i, j)] / sigma[j]);
    Ok((transform, largest / sigma[rank - 1]))
}

/// The transform rotated so that what it makes of the features `at_nodes` `[n_nodes x n_features]` is the identity,
/// where there are as many directions as nodes.
fn nodal_rotation(transform: &Mat<f64>, nodes: usize, at_nodes: impl FnOnce() -> Mat<f64>) -> Option<Mat<f64>> {
    if nodes != transform.ncols() {
        return None;
    }
    let at_nodes = at_nodes() * transform;
    one_thread();
    let svd = at_nodes.thin_svd().ok()?;
    let sigma: Vec<f64> = svd.S().column_vector().iter().copied().collect();
    let (largest, smallest) = (*sigma.first()?, *sigma.last()?);
    if !(smallest > 0.0 && largest < MAX_NODAL_CONDITION * smallest) {
        return None;
    }
    let (u, v) = (svd.U(), svd.V());
    let scaled = Mat::from_fn(v.nrows(), v.ncols(), |i, j| v[(i, j)] / sigma[j]);
    Some(transform * (scaled * u.transpose()))
}
