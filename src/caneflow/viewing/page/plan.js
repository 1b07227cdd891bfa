// The plan: where one is and was, which way one faces, and how sure that is.

import { begin, decimals, haloed, ink, niceStep, STROKES } from "./ink.js";
import { SILENCE } from "./series.js";

const UNSURE = 1.0; // m of the 2-sigma ellipse, from which on a position is called uncertain
const CORRIDOR_STEP = 0.4; // semi-axes between two ellipses of the corridor
const FIT = 2; // steps per m in which the whole is fitted
const PAST_PERIOD = 700; // ms
const LEAST_SPAN = 4; // m that are shown at least

export function isUnsure(pose) {
  return !(pose.major <= UNSURE);
}

export class Plan {
  constructor(canvas) {
    this.canvas = canvas;
    this.centre = [0, 0];
    this.scale = 60; // CSS pixels per m
    this.past = document.createElement("canvas"); // what does not change with every sample
    this.pastKey = "";
    this.pastEnds = [];
    this.pastAt = 0;
    this.mode = "fit"; // fit: all of the track; follow: the position in the middle; free
    canvas.addEventListener("pointerdown", (event) => this.drag(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  zoom(factor) {
    if (this.mode === "fit") this.mode = "free";
    this.scale = Math.min(2000, Math.max(2, this.scale * factor));
  }

  shift(x, y) {
    this.mode = "free";
    this.centre = [this.centre[0] + x / this.scale, this.centre[1] + y / this.scale];
  }

  drag(event) {
    this.canvas.setPointerCapture(event.pointerId);
    let [x, y] = [event.clientX, event.clientY];
    const move = (next) => {
      this.shift(x - next.clientX, next.clientY - y);
      [x, y] = [next.clientX, next.clientY];
      this.changed();
    };
    const end = () => {
      this.canvas.removeEventListener("pointermove", move);
      this.canvas.removeEventListener("pointerup", end);
    };
    this.canvas.addEventListener("pointermove", move);
    this.canvas.addEventListener("pointerup", end);
  }

  wheel(event) {
    if (!event.ctrlKey && document.activeElement !== this.canvas) return; // the page scrolls
    event.preventDefault();
    this.zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15);
    this.changed();
  }

  changed() {}

  // tracks: {series, truth, primary}; now: s; stale: s since the last position when it is too old, else null.
  draw(tracks, room, now, stale) {
    const opened = begin(this.canvas);
    if (!opened) return;
    const { context, width, height } = opened;
    const ends = tracks.map(({ series }) => series.upTo(now));
    this.look(tracks, ends, room, width, height);
    const place = (x, y) => [
      width / 2 + (x - this.centre[0]) * this.scale,
      height / 2 - (y - this.centre[1]) * this.scale,
    ];
    const strokes = strokesOf(tracks);
    this.drawPast(context, tracks, ends, strokes, room, width, height, place);
    tracks.forEach((track, i) => this.trail(context, track, this.pastEnds[i] - 1, ends[i], strokes[i], place));
    tracks.forEach((track, i) => {
      const pose = track.series.sample(ends[i] - 1);
      if (!pose) return;
      if (track.truth) this.truth(context, track, pose, place);
      else this.position(context, track, pose, strokes[i], place, track.primary ? stale : null, tracks.length > 1);
    });
  }

  // Grid, room, corridor and all of the trail but its end: kept as a picture, renewed when the view changes or now
  // and then.
  drawPast(context, tracks, ends, strokes, room, width, height, place) {
    const key = [this.centre, this.scale, width, height, ink("ink"), ...tracks.map(({ series, shift }) => series.name + shift)].join();
    const renewed = performance.now() - this.pastAt > PAST_PERIOD && ends.some((end, i) => end > this.pastEnds[i]);
    if (key !== this.pastKey || renewed || ends.some((end, i) => end < this.pastEnds[i])) {
      const { context: behind } = begin(this.past, this.canvas);
      this.grid(behind, width, height, place);
      this.room(behind, room, place);
      tracks.forEach((track, i) => this.corridor(behind, track, ends[i], strokes[i], place));
      tracks.forEach((track, i) => this.trail(behind, track, 0, ends[i], strokes[i], place));
      tracks.forEach((track, i) => this.beginning(behind, track, ends[i], strokes[i], place));
      [this.pastKey, this.pastEnds, this.pastAt] = [key, ends, performance.now()];
    }
    context.save();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(this.past, 0, 0);
    context.restore();
  }

  look(tracks, ends, room, width, height) {
    const primary = tracks.findIndex((track) => track.primary);
    if (this.mode === "follow" && primary >= 0) {
      const pose = tracks[primary].series.sample(ends[primary] - 1);
      if (pose) this.centre = [pose.x, pose.y];
    }
    if (this.mode !== "fit") return;
    const box = boxOf(tracks, ends, room);
    const [left, right] = [Math.floor(box[0] * FIT) / FIT, Math.ceil(box[1] * FIT) / FIT]; // in steps: no creeping
    const [low, high] = [Math.floor(box[2] * FIT) / FIT, Math.ceil(box[3] * FIT) / FIT];
    const span = [Math.max(right - left, LEAST_SPAN), Math.max(high - low, LEAST_SPAN * 0.6)];
    this.centre = [(left + right) / 2, (low + high) / 2];
    this.scale = Math.min((width - 90) / span[0], (height - 80) / span[1]);
  }

  grid(context, width, height, place) {
    const step = niceStep(width / this.scale, 8);
    const places = decimals(step);
    const [left, top] = [this.centre[0] - width / 2 / this.scale, this.centre[1] + height / 2 / this.scale];
    const [right, bottom] = [this.centre[0] + width / 2 / this.scale, this.centre[1] - height / 2 / this.scale];
    context.lineWidth = 1;
    context.strokeStyle = ink("faint");
    context.beginPath();
    for (let x = Math.ceil(left / step) * step; x < right; x += step) {
      const [at] = place(x, 0);
      context.moveTo(at, 0);
      context.lineTo(at, height);
    }
    for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
      const [, at] = place(0, y);
      context.moveTo(0, at);
      context.lineTo(width, at);
    }
    context.stroke();
    context.fillStyle = ink("muted");
    context.textAlign = "center";
    for (let x = Math.ceil(left / step) * step; x < right; x += step) {
      const [at] = place(x, 0);
      if (at > 44 && at < width - 60) haloed(context, tidy(x, places), at, height - 10);
    }
    context.textAlign = "left";
    for (let y = Math.ceil(bottom / step) * step; y < top; y += step) {
      const [, at] = place(0, y);
      if (at > 14 && at < height - 26) haloed(context, tidy(y, places), 6, at);
    }
    context.textAlign = "right";
    haloed(context, "x₀, m", width - 8, height - 10);
    context.textAlign = "left";
    haloed(context, "y₀, m", 6, 12);
  }

  room(context, room, place) {
    if (room.area) {
      const [x0, x1, y0, y1] = room.area;
      const [left, top] = place(x0, y1);
      const [right, bottom] = place(x1, y0);
      context.strokeStyle = ink("muted");
      context.lineWidth = 2;
      context.strokeRect(left, top, right - left, bottom - top);
    }
    context.fillStyle = ink("ink");
    context.textAlign = "left";
    for (const [name, [x, y, azimuth]] of Object.entries(room.sensors || {})) {
      const [px, py] = place(x, y);
      context.save();
      context.translate(px, py);
      context.rotate(-azimuth);
      context.beginPath();
      context.moveTo(10, 0);
      context.lineTo(-6, 7);
      context.lineTo(-6, -7);
      context.closePath();
      context.fill();
      context.restore();
      haloed(context, name, px + 12, py - 10);
    }
  }

  // All places where one may have been, as one shape: it widens as the position becomes uncertain.
  corridor(context, { series, truth }, end, stroke, place) {
    if (truth) return;
    context.save();
    context.fillStyle = ink(stroke.colour);
    context.globalAlpha = 0.13;
    context.beginPath();
    let last = null;
    for (let i = 0; i < end; i += 1) {
      const at = i * series.width;
      const [x, y] = [series.rows[at], series.rows[at + 1]];
      const [major, minor, turn] = [series.rows[at + 7], series.rows[at + 8], series.rows[at + 9]];
      const far = last === null || Math.hypot(x - last[0], y - last[1]) > Math.max(1.5 / this.scale, CORRIDOR_STEP * minor);
      if (!Number.isFinite(major) || !(far || i === end - 1)) continue;
      last = [x, y];
      ellipse(context, place(x, y), major * this.scale, minor * this.scale, turn);
    }
    context.fill("nonzero");
    context.restore();
  }

  trail(context, { series, truth, shift }, from, end, stroke, place) {
    if (end - from < 2) return;
    const at = (i) => place(series.rows[i * series.width] + shift[0], series.rows[i * series.width + 1] + shift[1]);
    context.save();
    context.strokeStyle = ink(stroke.colour);
    context.setLineDash(stroke.dash);
    context.lineWidth = truth ? 3 : 2;
    context.beginPath();
    let last = [Infinity, Infinity];
    const silence = Math.max(SILENCE, 3 * series.spacing);
    for (let i = Math.max(from, 0); i < end; i += 1) {
      const next = at(i);
      if (i > from && i > 0 && series.times[i] - series.times[i - 1] > silence) {
        context.moveTo(...next);
        last = next;
        continue;
      }
      if (i < end - 1 && Math.abs(next[0] - last[0]) + Math.abs(next[1] - last[1]) < 1.5) continue; // one pixel
      context.lineTo(...next);
      last = next;
    }
    context.stroke();
    context.restore();
  }

  beginning(context, { series, truth, shift }, end, stroke, place) {
    if (!end || (truth && shift[0])) return;
    const [x, y] = place(series.rows[0], series.rows[1]);
    context.save();
    context.strokeStyle = ink(stroke.colour);
    context.lineWidth = 2;
    context.fillStyle = ink("card");
    context.beginPath();
    context.arc(x, y, 5, 0, 7);
    context.fill();
    context.stroke();
    if (!truth) {
      context.fillStyle = ink("muted");
      context.textAlign = "left";
      haloed(context, series.fromStart ? "start" : "joined here", x + 9, y + 11);
    }
    context.restore();
  }

  truth(context, { shift }, pose, place) {
    const [x, y] = place(pose.x + shift[0], pose.y + shift[1]);
    context.strokeStyle = ink("muted");
    context.fillStyle = ink("muted");
    context.lineWidth = 3;
    context.beginPath();
    context.moveTo(x - 6, y - 6);
    context.lineTo(x + 6, y + 6);
    context.moveTo(x - 6, y + 6);
    context.lineTo(x + 6, y - 6);
    context.stroke();
    context.textAlign = "left";
    haloed(context, shift[0] ? "truth, laid on the start" : "truth", x + 10, y + 12);
  }

  position(context, { series, primary }, pose, stroke, place, stale, several) {
    const [x, y] = place(pose.x, pose.y);
    const known = Number.isFinite(pose.major);
    const unsure = isUnsure(pose);
    const colour = stale === null ? ink(stroke.colour) : ink("muted");
    context.save();
    context.strokeStyle = colour;
    context.lineWidth = primary ? 2 : 1.5;
    context.setLineDash(unsure ? [7, 5] : []);
    context.beginPath();
    if (known) ellipse(context, [x, y], Math.max(pose.major * this.scale, 1), Math.max(pose.minor * this.scale, 1), pose.turn);
    else context.arc(x, y, 30, 0, 7);
    context.save();
    context.fillStyle = colour;
    context.globalAlpha = 0.12;
    context.fill();
    context.restore();
    context.stroke();
    context.setLineDash([]);
    arrow(context, x, y, pose.yaw, colour, unsure || stale !== null);
    context.fillStyle = ink("ink");
    context.textAlign = "left";
    const said = [];
    if (several) said.push(series.method || series.name);
    if (stale !== null) said.push(`no position for ${stale.toFixed(0)} s`);
    else if (!known) said.push("uncertainty not known");
    else if (unsure) said.push(`uncertain: ±${pose.major.toFixed(1)} m`);
    said.forEach((words, line) => haloed(context, words, x + 18, y - 18 - 15 * line));
    context.restore();
  }
}

function strokesOf(tracks) {
  let next = 0;
  return tracks.map(({ truth }) => {
    if (truth) return { colour: "muted", dash: [1, 6] };
    next += 1;
    return STROKES[(next - 1) % STROKES.length];
  });
}

function ellipse(context, [x, y], major, minor, turn) {
  context.moveTo(x + major * Math.cos(turn), y - major * Math.sin(turn));
  context.ellipse(x, y, major, minor, -turn, 0, 2 * Math.PI);
}

function arrow(context, x, y, yaw, colour, hollow) {
  context.save();
  context.translate(x, y);
  context.fillStyle = hollow ? ink("card") : colour;
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  if (Number.isFinite(yaw)) {
    context.rotate(-yaw);
    context.moveTo(16, 0);
    context.lineTo(-9, 9);
    context.lineTo(-4, 0);
    context.lineTo(-9, -9);
    context.closePath();
  } else {
    context.arc(0, 0, 7, 0, 7);
  }
  context.fill();
  context.stroke();
  context.restore();
}

function boxOf(tracks, ends, room) {
  let box = room.area ? [...room.area] : [Infinity, -Infinity, Infinity, -Infinity];
  const add = (x, y, around) => {
    box = [Math.min(box[0], x - around), Math.max(box[1], x + around), Math.min(box[2], y - around), Math.max(box[3], y + around)];
  };
  for (const [x, y] of Object.values(room.sensors || {})) add(x, y, 0.3);
  tracks.forEach(({ series, shift: [dx, dy] }, i) => {
    const step = Math.max(1, Math.floor(ends[i] / 1000));
    for (let n = 0; n < ends[i]; n += step) add(series.rows[n * series.width] + dx, series.rows[n * series.width + 1] + dy, 0);
    const pose = series.sample(ends[i] - 1);
    if (pose) add(pose.x + dx, pose.y + dy, Math.min(pose.major || 0, 20));
  });
  return Number.isFinite(box[0]) ? box : [-2, 2, -2, 2];
}

function tidy(number, places) {
  return (Math.abs(number) < 1e-9 ? 0 : number).toFixed(places).replace("-", "−");
}
