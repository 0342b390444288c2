// Rows of numbers over time in typed arrays, oldest first, with a limit: the oldest rows make room for new ones.

const FIRST_CAPACITY = 1024;

export class Series {
  /** Columns by name; at most `limit` rows. */
  constructor(names, limit) {
    this.limit = limit;
    this.times = new Float64Array(Math.min(FIRST_CAPACITY, limit));
    this.columns = new Map();
    this.first = 0;
    this.end = 0;
    /** Rows ever slid out of the arrays: `dropped + index` numbers a row for good. */
    this.dropped = 0;
    this.setColumns(names);
  }

  /** Columns kept from now on; what a new one was before is not known. */
  setColumns(names) {
    const kept = new Map();
    for (const name of names) {
      kept.set(name, this.columns.get(name) ?? new Float32Array(this.times.length).fill(NaN));
    }
    this.columns = kept;
  }

  get length() {
    return this.end - this.first;
  }

  get oldest() {
    return this.length ? this.times[this.first] : null;
  }

  get newest() {
    return this.length ? this.times[this.end - 1] : null;
  }

  /** Values of a column, to be indexed like `times`; undefined if there is no such column. */
  column(name) {
    return this.columns.get(name);
  }

  /** First index whose time is at least `time`. */
  lower(time) {
    let [low, high] = [this.first, this.end];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** Index of the last row not after `time`; -1 if there is none. */
  at(time) {
    const index = this.lower(time + 1e-6) - 1;
    return index < this.first ? -1 : index;
  }

  /** Appends rows at `origin + offsets[i]`; rows that are not after the last one are left out. */
  append(origin, offsets, values) {
    for (let row = 0; row < offsets.length; row += 1) {
      const time = origin + offsets[row];
      if (!Number.isFinite(time) || (this.length && time <= this.times[this.end - 1])) continue;
      this.#makeRoom();
      this.times[this.end] = time;
      for (const [name, column] of this.columns) column[this.end] = values[name]?.[row] ?? NaN;
      this.end += 1;
    }
  }

  /** Forgets rows from `time` on: something better is known about them. */
  truncateFrom(time) {
    this.end = this.lower(time);
  }

  /** Forgets rows before `time`. */
  dropBefore(time) {
    this.first = this.lower(time);
  }

  clear() {
    this.first = 0;
    this.end = 0;
  }

  #makeRoom() {
    const capacity = this.times.length;
    if (this.end < capacity) return;
    if (this.first < capacity / 8 && capacity < this.limit) {
      this.#grow(Math.min(2 * capacity, this.limit));
    } else {
      this.first = Math.max(this.first, Math.ceil(capacity / 8));
      this.#slide();
    }
  }

  #grow(capacity) {
    const larger = (array, type) => {
      const copy = new type(capacity);
      copy.set(array);
      return copy;
    };
    this.times = larger(this.times, Float64Array);
    for (const [name, column] of this.columns) this.columns.set(name, larger(column, Float32Array));
  }

  #slide() {
    for (const array of [this.times, ...this.columns.values()]) array.copyWithin(0, this.first, this.end);
    this.dropped += this.first;
    this.end -= this.first;
    this.first = 0;
  }
}
