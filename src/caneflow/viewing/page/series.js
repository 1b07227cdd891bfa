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

  // Times between two times, with one sample more on either side, and what each of `values` gives there: functions of
  // the rows and where a row begins. Where there are more than `most`, the least and the greatest of so many samples
  // stand for them, so that no peak is lost; after a silence there is an empty point, so that no line is drawn over it.
  between(from, to, values, most = 4000) {
    const begin = Math.max(0, this.upTo(from) - 1);
    const end = Math.min(this.length, this.upTo(to) + 1);
    const step = Math.ceil((end - begin) / most);
    const size = step > 1 ? 2 * step : 1;
    const times = [];
    const found = values.map(() => []);
    const silence = Math.max(SILENCE, 3 * this.spacing);
    for (let at = begin; at < end; ) {
      if (at > begin && this.times[at] - this.times[at - 1] > silence) {
        times.push(this.times[at] - 1e-6);
        for (const column of found) column.push(null);
      }
      const last = Math.min(end, (Math.floor(at / size) + 1) * size); // the same samples together in each drawing
      let next = at + 1;
      while (next < last && this.times[next] - this.times[next - 1] <= silence) next += 1;
      times.push(this.times[at]);
      if (next - at > 1) times.push(this.times[next - 1]);
      values.forEach((value, i) => this.extremes(value, at, next, found[i]));
      at = next;
    }
    return [times, ...found];
  }

  // The least and the greatest value of the samples from `begin` on, before `end`, in the order in which they come.
  extremes(value, begin, end, into) {
    let [least, most, leastAt, mostAt] = [Infinity, -Infinity, 0, 0];
    for (let at = begin; at < end; at += 1) {
      const number = value(this.rows, at * this.width);
      if (Number.isFinite(number) && number < least) [least, leastAt] = [number, at];
      if (Number.isFinite(number) && number > most) [most, mostAt] = [number, at];
    }
    const known = least <= most;
    into.push(known ? (leastAt <= mostAt ? least : most) : null);
    if (end - begin > 1) into.push(known ? (leastAt <= mostAt ? most : least) : null);
  }
}

export function named(series, time, values) {
  const found = { time };
  for (let i = 0; i < series.width; i += 1) found[series.columns[i]] = values[i];
  return found;
}
