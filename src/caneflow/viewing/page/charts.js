// Time series, drawn by uPlot. Lines are told apart by colour, by dashes and by the letters at their ends.

import { FONT, haloed, ink, STROKES } from "./ink.js";

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
    new ResizeObserver(() => this.resize()).observe(holder);
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
        width: this.holder.clientWidth || 300,
        height: this.holder.clientHeight || 160,
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
    if (this.plot && this.holder.clientWidth) {
      this.plot.setSize({ width: this.holder.clientWidth, height: this.holder.clientHeight });
    }
  }

  draw(series, from, to, now) {
    if (!this.visible || !series) return;
    if (!this.plot) this.build();
    this.now = now;
    const band = this.lines[0].band;
    const columns = this.lines.map((line) => line.column);
    const most = 2 * this.holder.clientWidth;
    const data = series.between(from, to, band ? [...columns, band, "valid"] : columns, most);
    this.plot.batch(() => {
      this.plot.setData(band ? banded(data, columns.length) : data, false);
      this.plot.setScale("x", { min: from, max: to });
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

// Speeds that are not valid leave a gap; the band is the speed plus and minus its quality.
function banded(data, count) {
  const [times, ...columns] = data;
  const [width, valid] = columns.slice(count);
  const shown = columns[0].map((value, i) => (valid[i] ? value : null));
  const upper = shown.map((value, i) => (value === null || width[i] === null ? null : value + width[i]));
  const lower = shown.map((value, i) => (value === null || width[i] === null ? null : value - width[i]));
  return [times, shown, ...columns.slice(1, count), upper, lower];
}
