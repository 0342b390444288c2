// Rows reduced to what a screen can show. Where there are more rows than pixels, neighbouring rows become one bucket:
// its widest band, and its least and largest value. Buckets begin at fixed rows, so that nothing flickers as time goes on.

/** Rows per bucket where there are so many rows per pixel. */
export const strideOf = (rowsPerPixel) => (rowsPerPixel > 1.5 ? Math.ceil(rowsPerPixel) : 1);

/** Calls `visit(from, to)` for every bucket of rows `[from, to)` of `series`. */
function forBuckets(series, from, to, stride, visit) {
  for (let i = from; i < to; ) {
    const next = Math.min(i + stride - ((i + series.dropped) % stride), to);
    visit(i, next);
    i = next;
  }
}

/** Corners of a line through a column: time, value, time, value, ... */
export function lineOf(series, column, from, to, stride) {
  const line = [];
  forBuckets(series, from, to, stride, (start, end) => {
    let [least, most] = [start, start];
    for (let i = start; i < end; i += 1) {
      if (column[i] < column[least]) least = i;
      if (column[i] > column[most]) most = i;
    }
    const [one, other] = least < most ? [least, most] : [most, least];
    line.push(series.times[one], column[one]);
    if (other !== one) line.push(series.times[other], column[other]);
  });
  return line;
}

/** Corners of a band between two columns: time, low, high, time, ... */
export function bandOf(series, low, high, from, to, stride) {
  const band = [];
  forBuckets(series, from, to, stride, (start, end) => {
    let [least, most] = [Infinity, -Infinity];
    for (let i = start; i < end; i += 1) {
      if (low[i] < least) least = low[i];
      if (high[i] > most) most = high[i];
    }
    if (least <= most) band.push(series.times[start], least, most);
  });
  return band;
}

/** A line in dashes of `on` seconds with `off` between them: pieces `[time, value, time, value]`. Where a dash is only
 * its time decides. */
export function dashes(line, on, off) {
  const pieces = [];
  for (let k = 2; k < line.length; k += 2) {
    const [t0, v0, t1, v1] = line.slice(k - 2, k + 2);
    const valueAt = (time) => (t1 > t0 ? v0 + ((time - t0) / (t1 - t0)) * (v1 - v0) : v1);
    for (let start = Math.floor(t0 / (on + off)) * (on + off); start < t1; start += on + off) {
      const [from, to] = [Math.max(t0, start), Math.min(t1, start + on)];
      if (from < to) pieces.push([from, valueAt(from), to, valueAt(to)]);
    }
  }
  return pieces;
}
