// The tables of nodes and edges, changed in place: a screen reader keeps its cell, a keyboard its focus.

import { number } from "./words.js";

const STATES = {
  ready: ["●", "good"],
  starting: ["◌", "wait"],
  waiting: ["↻", "wait"],
  failed: ["✕", "bad"],
};
const PLACES = ["sender", "wire", "decode", "queue", "late"];

export class Table {
  constructor(body, columns) {
    this.body = body;
    this.columns = columns;
    this.rows = new Map();
  }

  // rows: [name, [cells]]; a cell is text, or {text, className}.
  show(rows) {
    const names = new Set(rows.map(([name]) => name));
    for (const [name, row] of this.rows) {
      if (!names.has(name)) {
        row.remove();
        this.rows.delete(name);
      }
    }
    for (const [name, cells] of rows) this.fill(this.rows.get(name) ?? this.add(name), cells);
  }

  add(name) {
    const row = this.body.insertRow();
    const head = document.createElement("th");
    head.scope = "row";
    head.textContent = name;
    row.append(head);
    for (let i = 0; i < this.columns; i += 1) row.insertCell();
    this.rows.set(name, row);
    return row;
  }

  fill(row, cells) {
    cells.forEach((cell, i) => {
      const { text, className = "" } = typeof cell === "string" ? { text: cell } : cell;
      const place = row.cells[i + 1];
      if (place.textContent !== text) place.textContent = text;
      if (place.className !== className) place.className = className;
    });
  }
}

export function nodeRow(node) {
  const silent = node.counted !== null && node.counted > 3;
  const [symbol, className] = silent && node.state === "ready" ? ["▲", "bad"] : (STATES[node.state] ?? ["?", "wait"]);
  const state = silent && node.state === "ready" ? `silent for ${number(node.counted, 0)} s` : node.state;
  const sent = Object.entries(node.sent).map(([port, count]) => `${port} ${count}`);
  return [
    node.node,
    [
      { text: `${symbol} ${state}`, className },
      node.program.replace(/^caneflow\./, ""),
      sent.join(", ") || "–",
      { text: String(node.restarts), className: node.restarts ? "bad" : "" },
      node.cpu === null ? "–" : `${number(100 * node.cpu, 0)} %`,
      node.memory === null ? "–" : `${number(node.memory / 1e6, 0)} MB`,
    ],
  ];
}

export function edgeRow(edge) {
  return [
    `${edge.writer} → ${edge.reader}`,
    [
      hertz(edge.rate),
      milliseconds(edge.delays.latency_p50),
      milliseconds(edge.delays.latency_p99),
      milliseconds(edge.delays.age_p50),
      String(edge.received),
      ...PLACES.map((place) => lost(edge[place])),
    ],
  ];
}

// What this page itself hears: for a flow without a launcher here, and for recordings.
export function streamRow(name, traffic) {
  return [
    `${name} → this page`,
    [
      hertz(traffic.rate),
      "–",
      "–",
      milliseconds(traffic.age_p50),
      String(traffic.count),
      "–",
      lost(traffic.gaps),
      "–",
      lost(traffic.left_out),
      "–",
    ],
  ];
}

// A stream of a recording: what it holds.
export function recordedRow(series) {
  const rate = series.length > 1 ? ((series.length - 1) * series.every) / (series.lastTime - series.times[0]) : null;
  const of = series.of ?? series.length;
  return [series.name, [hertz(rate), "–", "–", "–", String(of), "–", lost(series.gaps), "–", "–", "–"]];
}

function lost(count) {
  return count ? { text: `⚠ ${count}`, className: "bad" } : "0";
}

function hertz(rate) {
  return rate === null || rate === undefined ? "–" : `${number(rate, 1)} Hz`;
}

function milliseconds(seconds) {
  return seconds === null || seconds === undefined ? "–" : `${number(1000 * seconds, 1)} ms`;
}
