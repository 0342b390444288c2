//! Points on the sheet \[px\].

use kurbo::Rect;

/// Right and down from the upper left corner.
pub(super) type Xy = (f64, f64);

/// Longer runs are thinned.
const MAX_POINTS: usize = 2000;

/// The nearest line of the pixel grid, so that rules stay sharp.
pub(super) fn snap(length: f64) -> f64 {
    length.round() + 0.5
}

/// Keeps the ends and the extremes of every stretch within one column of pixels, which look like all of it. What lies
/// beside `area` is a column on either side.
pub(super) fn thin(points: &[Xy], area: &Rect) -> Vec<Xy> {
    if points.len() <= MAX_POINTS {
        return points.to_vec();
    }
    let column = |point: &Xy| point.0.clamp(area.x0 - 1.0, area.x1 + 1.0).floor() as i64;
    let stretches = points.chunk_by(|a, b| column(a) == column(b));
    stretches.flat_map(|stretch| extremes(stretch).into_iter().map(|i| stretch[i])).collect()
}

/// Which points are first, last, or farthest to a side.
fn extremes(points: &[Xy]) -> Vec<usize> {
    let mut indices = vec![0, points.len() - 1];
    for along in [|point: &Xy| point.0, |point: &Xy| point.1] {
        let order = |&i: &usize, &j: &usize| along(&points[i]).total_cmp(&along(&points[j]));
        indices.extend((0..points.len()).min_by(order).into_iter().chain((0..points.len()).max_by(order)));
    }
    indices.sort_unstable();
    indices.dedup();
    indices
}
