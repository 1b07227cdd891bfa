// The plan: where one is and was, which way one faces, and how sure that is.

import { begin, decimals, haloed, ink, niceStep, STROKES, watch } from "./ink.js";
import { SILENCE } from "./series.js";

const UNSURE = 1.0; // m of the 2-sigma ellipse, from which on a position is called uncertain
const CORRIDOR_STEP = 0.4; // semi-axes between two ellipses of the corridor
const FIT = 0.5; // m: steps in which the whole is fitted, of a small one
const WASTE = 0.7; // of what is shown is needed at least; below, the whole is fitted again
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
    this.box = null; // m: what is shown of the whole
    this.bounds = new WeakMap(); // of each series: the box around its samples so far
    this.past = document.createElement("canvas"); // what does not change with every sample
    this.trails = document.createElement("canvas"); // of it the trails; they grow at their ends
    this.clouds = []; // and of each track the shape of all its ellipses
    this.reached = []; // where each of them ends: samples, the last point and the last ellipse, pixels of trail
    this.pastKey = "";
    this.pastEnds = [];
    this.pastAt = 0;
    this.mode = "fit"; // fit: all of the track; follow: the position in the middle; free
    canvas.addEventListener("pointerdown", (event) => this.drag(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    watch(canvas, () => this.resized());
  }

  resized() {}

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
    tracks.forEach((track, i) => this.trail(context, track, { ...this.reached[i] }, ends[i], strokes[i], place));
    tracks.forEach((track, i) => {
      const pose = track.series.sample(ends[i] - 1);
      if (!pose) return;
      if (track.truth) this.truth(context, track, pose, place);
      else this.position(context, track, pose, strokes[i], place, track.primary ? stale : null, tracks.length > 1);
    });
  }

  // Grid, room, corridor and all of the trail but its end: kept as a picture; what has come since is added now and
  // then, and all of it is drawn again when the view changes.
  drawPast(context, tracks, ends, strokes, room, width, height, place) {
    const key = [this.centre, this.scale, width, height, ink("ink"), ...tracks.map(({ series, shift }) => series.name + shift)].join();
    const again = key !== this.pastKey || ends.some((end, i) => end < this.pastEnds[i]);
    if (again) this.forget(tracks);
    if (again || (performance.now() - this.pastAt > PAST_PERIOD && ends.some((end, i) => end > this.pastEnds[i]))) {
      this.extend(tracks, ends, strokes, place);
      const { context: behind } = begin(this.past, { like: this.canvas });
      this.grid(behind, width, height, place);
      this.room(behind, room, place);
      behind.globalAlpha = 0.13;
      tracks.forEach(({ truth }, i) => truth || copy(behind, this.clouds[i]));
      behind.globalAlpha = 1;
      copy(behind, this.trails);
      tracks.forEach((track, i) => this.beginning(behind, track, ends[i], strokes[i], place));
      [this.pastKey, this.pastEnds, this.pastAt] = [key, ends, performance.now()];
    }
    copy(context, this.past);
  }

  forget(tracks) {
    const clear = { like: this.canvas, clear: true };
    begin(this.trails, clear);
    tracks.forEach(({ truth }, i) => {
      if (!truth) begin((this.clouds[i] ??= document.createElement("canvas")), clear);
    });
    this.reached = tracks.map(() => ({ samples: 0, point: null, ellipse: null, length: 0 }));
  }

  // Add what has come to the trails and to the clouds.
  extend(tracks, ends, strokes, place) {
    tracks.forEach((track, i) => {
      if (!track.truth) this.corridor(this.clouds[i].getContext("2d"), track, this.reached[i], ends[i], strokes[i], place);
      this.trail(this.trails.getContext("2d"), track, this.reached[i], ends[i], strokes[i], place);
    });
  }

  look(tracks, ends, room, width, height) {
    const primary = tracks.findIndex((track) => track.primary);
    if (this.mode === "follow" && primary >= 0) {
      const pose = tracks[primary].series.sample(ends[primary] - 1);
      if (pose) this.centre = [pose.x, pose.y];
    }
    if (this.mode !== "fit") return;
    this.box = fitted(this.box, this.whole(tracks, ends, room));
    const [left, right, low, high] = this.box;
    const span = [Math.max(right - left, LEAST_SPAN), Math.max(high - low, LEAST_SPAN * 0.6)];
    this.centre = [(left + right) / 2, (low + high) / 2];
    this.scale = Math.min((width - 90) / span[0], (height - 80) / span[1]);
  }

  // The box around the room, the tracks, and the ellipses at their ends.
  whole(tracks, ends, room) {
    const box = room.area ? [...room.area] : [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y] of Object.values(room.sensors || {})) widen(box, x, y, 0.3);
    tracks.forEach(({ series, shift: [dx, dy] }, i) => {
      const [left, right, low, high] = this.around(series, ends[i]);
      widen(box, left + dx, low + dy, 0);
      widen(box, right + dx, high + dy, 0);
      const pose = series.sample(ends[i] - 1);
      if (pose) widen(box, pose.x + dx, pose.y + dy, Math.min(pose.major || 0, 20));
    });
    return box[0] <= box[1] ? box : [-2, 2, -2, 2];
  }

  // The box around the first `end` samples; only those are looked at that have come since.
  around(series, end) {
    let known = this.bounds.get(series);
    if (!known || end < known.end) known = { end: 0, box: [Infinity, -Infinity, Infinity, -Infinity] };
    for (let i = known.end; i < end; i += 1) widen(known.box, series.rows[i * series.width], series.rows[i * series.width + 1], 0);
    known.end = end;
    this.bounds.set(series, known);
    return known.box;
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

  // All places where one may have been, as one shape: it widens as the position becomes uncertain. Opaque: what shines
  // through is the picture of all of them.
  corridor(context, { series }, reached, end, stroke, place) {
    context.fillStyle = ink(stroke.colour);
    for (let i = reached.samples; i < end; i += 1) {
      const at = i * series.width;
      const [x, y, major, minor] = [series.rows[at], series.rows[at + 1], series.rows[at + 7], series.rows[at + 8]];
      if (!Number.isFinite(major)) continue;
      const step = Math.max(1.5 / this.scale, CORRIDOR_STEP * minor);
      if (i < end - 1 && reached.ellipse && Math.hypot(x - reached.ellipse[0], y - reached.ellipse[1]) <= step) continue;
      reached.ellipse = [x, y];
      context.beginPath();
      ellipse(context, place(x, y), major * this.scale, minor * this.scale, series.rows[at + 9]);
      context.fill();
    }
  }

  // The track from where it was drawn to; dashes go on where they were.
  trail(context, { series, truth, shift }, reached, end, stroke, place) {
    context.save();
    context.strokeStyle = ink(stroke.colour);
    context.setLineDash(stroke.dash);
    context.lineDashOffset = reached.length;
    context.lineWidth = truth ? 3 : 2;
    context.beginPath();
    if (reached.point) context.moveTo(...reached.point);
    const silence = Math.max(SILENCE, 3 * series.spacing);
    for (let i = reached.samples; i < end; i += 1) {
      const [x, y] = place(series.rows[i * series.width] + shift[0], series.rows[i * series.width + 1] + shift[1]);
      const apart = !reached.point || series.times[i] - series.times[i - 1] > silence;
      const way = apart ? 0 : Math.hypot(x - reached.point[0], y - reached.point[1]);
      if (!apart && i < end - 1 && way < 1.2) continue; // one pixel
      if (apart) context.moveTo(x, y);
      else context.lineTo(x, y);
      reached.length += way;
      reached.point = [x, y];
    }
    reached.samples = Math.max(reached.samples, end);
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

// What is shown of the whole: `needed` in steps, so that it does not creep, and as before while that fits well.
function fitted(before, needed) {
  const inside = before && needed.every((side, i) => (i % 2 ? side <= before[i] : side >= before[i]));
  const span = (box) => Math.max(box[1] - box[0], box[3] - box[2], LEAST_SPAN);
  if (inside && span(needed) > WASTE * span(before)) return before;
  const step = FIT * 2 ** Math.floor(Math.log2(span(needed) / LEAST_SPAN));
  return needed.map((side, i) => (i % 2 ? Math.ceil(side / step) : Math.floor(side / step)) * step);
}

function widen(box, x, y, around) {
  if (x - around < box[0]) box[0] = x - around;
  if (x + around > box[1]) box[1] = x + around;
  if (y - around < box[2]) box[2] = y - around;
  if (y + around > box[3]) box[3] = y + around;
}

// Lay a picture of the same size over it, pixel on pixel.
function copy(context, picture) {
  context.save();
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.drawImage(picture, 0, 0);
  context.restore();
}

function tidy(number, places) {
  return (Math.abs(number) < 1e-9 ? 0 : number).toFixed(places).replace("-", "−");
}
