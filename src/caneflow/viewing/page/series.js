// The samples of one stream, in the order of their stamps: times in s since the origin, and rows of numbers.

const MOST_LIVE = 60_000; // samples of a running flow: 10 minutes at 100 Hz; then the older half is forgotten

export const SILENCE = 1; // s without a sample, over which no line is drawn

export class Series {
  constructor(name, type, columns) {
    this.name = name;
    this.type = type;
    this.columns = columns;
    this.index = Object.fromEntries(columns.map((column, i) => [column, i]));
    this.width = columns.length;
    this.length = 0;
    this.times = new Float64Array(1024);
    this.rows = new Float64Array(1024 * this.width);
    this.method = "";
    this.gaps = 0;
    this.every = 1;
    this.of = null;
    this.lastSeq = null;
    this.fromStart = false; // whether the stream's first sample is the first one here
  }

  append(times, rows, endless) {
    if (endless && this.length + times.length > MOST_LIVE) this.forget(this.length >> 1);
    while (this.length + times.length > this.times.length) this.grow();
    this.times.set(times, this.length);
    this.rows.set(rows, this.length * this.width);
    this.length += times.length;
  }

  grow() {
    const times = new Float64Array(2 * this.times.length);
    const rows = new Float64Array(2 * this.rows.length);
    times.set(this.times);
    rows.set(this.rows);
    this.times = times;
    this.rows = rows;
  }

  forget(count) {
    this.times.copyWithin(0, count, this.length);
    this.rows.copyWithin(0, count * this.width, this.length * this.width);
    this.length -= count;
  }

  // How many samples lie at or before `time`.
  upTo(time) {
    let low = 0;
    let high = this.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  // Mean s between samples.
  get spacing() {
    return this.length > 1 ? (this.lastTime - this.times[0]) / (this.length - 1) : 0;
  }

  get lastTime() {
    return this.length ? this.times[this.length - 1] : -Infinity;
  }

  sample(number) {
    if (number < 0 || number >= this.length) return null;
    const values = this.rows.subarray(number * this.width, (number + 1) * this.width);
    return named(this, this.times[number], values);
  }

  // Times and the columns of that name between two times, with one sample more on either side; after a silence there
  // is an empty point, so that no line is drawn over it.
  between(from, to, columns, most = 4000) {
    const begin = Math.max(0, this.upTo(from) - 1);
    const end = Math.min(this.length, this.upTo(to) + 1);
    const step = Math.max(1, Math.ceil((end - begin) / most));
    const times = [];
    const found = columns.map(() => []);
    const places = columns.map((column) => this.index[column]);
    const silence = Math.max(SILENCE, 3 * step * this.spacing);
    for (let at = begin; at < end; at += step) {
      const time = this.times[at];
      if (times.length && time - times[times.length - 1] > silence) {
        times.push(time - 1e-6);
        for (const column of found) column.push(null);
      }
      times.push(time);
      for (let c = 0; c < places.length; c += 1) {
        const number = this.rows[at * this.width + places[c]];
        found[c].push(Number.isFinite(number) ? number : null);
      }
    }
    return [times, ...found];
  }
}

export function named(series, time, values) {
  const found = { time };
  for (let i = 0; i < series.width; i += 1) found[series.columns[i]] = values[i];
  return found;
}
