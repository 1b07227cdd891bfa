// Time series, drawn by uPlot. Lines are told apart by colour, by dashes and by the letters at their ends.

import { FONT, haloed, ink, sizeOf, STROKES, watch } from "./ink.js";

/* global uPlot */

export class Chart {
  // lines: [{label, column}]; the first may have {band: column}, a half-width to either side.
  constructor(holder, { unit, lines, least }) {
    this.holder = holder;
    this.lines = lines;
    this.unit = unit;
    this.least = least;
    this.now = null;
    this.visible = true;
    new IntersectionObserver(([entry]) => {
      this.visible = entry.isIntersecting;
    }).observe(holder);
    watch(holder, () => this.resize());
  }

  build() {
    this.plot?.destroy();
    const band = this.lines[0].band;
    const axis = { stroke: ink("muted"), font: FONT, grid: { stroke: ink("faint"), width: 1 }, ticks: { show: false } };
    const drawn = this.lines.map(({ label }, i) => {
      const { colour, dash } = STROKES[i % STROKES.length];
      return { label, stroke: ink(colour), dash, width: 2, points: { show: false } };
    });
    const edges = band ? [{ label: "upper" }, { label: "lower" }].map((s) => ({ ...s, stroke: "transparent", points: { show: false } })) : [];
    this.plot = new uPlot(
      {
        width: sizeOf(this.holder).width || 300,
        height: sizeOf(this.holder).height || 160,
        legend: { show: false },
        cursor: { show: false },
        scales: {
          x: { time: false },
          y: { range: (_, low, high) => this.range(low, high) },
        },
        series: [{}, ...drawn, ...edges],
        bands: band ? [{ series: [drawn.length + 1, drawn.length + 2], fill: `${ink("blue")}38` }] : [],
        axes: [
          { ...axis, size: 26, values: (_, ticks) => ticks.map((t) => `${t} s`) },
          { ...axis, size: 48, values: (_, ticks) => ticks.map((v) => String(+v.toFixed(6)).replace("-", "−")) },
        ],
        hooks: { draw: [(plot) => this.annotate(plot)] },
      },
      [[], ...drawn.map(() => []), ...edges.map(() => [])],
      this.holder,
    );
  }

  range(low, high) {
    const [least, most] = this.least;
    const bottom = Math.min(low ?? least, least);
    const top = Math.max(high ?? most, most);
    const margin = 0.05 * (top - bottom);
    return [bottom < least ? bottom - margin : bottom, top > most ? top + margin : top];
  }

  resize() {
    const { width, height } = sizeOf(this.holder);
    if (this.plot && width) this.plot.setSize({ width, height });
  }

  draw(series, from, to, now) {
    if (!this.visible) return;
    if (!this.plot) this.build();
    this.now = now;
    const most = sizeOf(this.holder).width; // more than one point for a column of pixels is not seen
    const data = series.between(from, to, this.values(series), most);
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: from, max: to });
    });
  }

  // What is drawn of a row. Speeds that are not valid leave a gap; the band is the speed plus and minus its quality.
  values({ index }) {
    const [{ column, band }] = this.lines;
    if (!band) return this.lines.map((line) => (rows, at) => rows[at + index[line.column]]);
    const [value, width, valid] = [index[column], index[band], index.valid];
    return [0, 1, -1].map((side) => (rows, at) => {
      if (!rows[at + valid]) return NaN;
      return side ? rows[at + value] + side * rows[at + width] : rows[at + value];
    });
  }

  // The names of the lines at their ends, and the time cursor.
  annotate(plot) {
    const { ctx: context, bbox } = plot;
    const ratio = window.devicePixelRatio || 1;
    context.save();
    context.font = `${12 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    context.textAlign = "right";
    context.textBaseline = "middle";
    const placed = [];
    this.lines.forEach(({ label }, i) => {
      const values = plot.data[i + 1];
      const last = values?.findLast((value) => value !== null);
      if (last === undefined || this.lines.length === 1) return;
      let y = plot.valToPos(last, "y", true);
      for (const other of placed) if (Math.abs(other - y) < 13 * ratio) y = other + 13 * ratio;
      placed.push(y);
      context.fillStyle = ink(STROKES[i % STROKES.length].colour);
      haloed(context, label, bbox.left + bbox.width - 4, y - 8 * ratio);
    });
    if (this.now !== null) {
      const x = plot.valToPos(this.now, "x", true);
      if (x < bbox.left + bbox.width - 2) {
        context.strokeStyle = ink("cursor");
        context.setLineDash([]);
        context.lineWidth = 2 * ratio;
        context.beginPath();
        context.moveTo(x, bbox.top);
        context.lineTo(x, bbox.top + bbox.height);
        context.stroke();
      }
    }
    context.restore();
  }
}
