// What the pictures show, in words: for a screen reader, and for everybody.

import { isUnsure } from "./plan.js";

export function number(value, places = 2) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const text = value.toFixed(places);
  return /^-0(\.0+)?$/.test(text) ? text.slice(1) : text.replace("-", "−");
}

export function degrees(radians) {
  return Number.isFinite(radians) ? `${number((radians * 180) / Math.PI, 0)}°` : "–";
}

// One calm sentence or two on where one is.
export function sentence(pose, series, speed, stale) {
  if (!pose) return "No position yet.";
  const said = [];
  if (stale !== null) said.push(`No new position for ${stale.toFixed(0)} seconds. The last one:`);
  const start = series.sample(0);
  const away = Math.hypot(pose.x - start.x, pose.y - start.y);
  const begin = series.fromStart ? "the start" : "where this page began to look";
  const place = `x ${spoken(pose.x)}, y ${spoken(pose.y)}`;
  said.push(`At ${pose.time.toFixed(0)} s: ${away < 0.05 ? `at ${begin}` : `${metres(away)} from ${begin}`}, ${place}.`);
  said.push(
    !Number.isFinite(pose.major)
      ? "Its uncertainty is not known."
      : isUnsure(pose)
        ? `This is uncertain, by ${metres(pose.major)}.`
        : `Probably within ${metres(pose.major)} of that.`,
  );
  if (Number.isFinite(pose.yaw)) said.push(`Facing ${spokenTurn(pose.yaw)}.`);
  const pace = speed ?? Math.hypot(pose.vx, pose.vy);
  said.push(pace < 0.08 ? "At rest." : `Moving at ${pace.toFixed(1)} metres per second.`);
  return said.join(" ");
}

function metres(length) {
  if (length < 0.995) return `${Math.max(1, Math.round(length * 100))} centimetres`;
  return `${length.toFixed(1)} metres`;
}

function spoken(value) {
  return `${value < -0.05 ? "minus " : ""}${Math.abs(value).toFixed(1)}`;
}

function spokenTurn(yaw) {
  const turn = Math.round((yaw * 180) / Math.PI);
  if (turn === 0) return "along x";
  return `${Math.abs(turn)} degrees ${turn > 0 ? "left" : "right"} of x`;
}

export function pictureInWords(picture, edge) {
  const [range, speed, level] = picture.strongest;
  const way = speed >= 0 ? "approaching" : "receding";
  const strongest = `strongest return at ${number(range)} m, ${way} at ${number(Math.abs(speed))} m/s, ${number(level, 0)} dB above the noise`;
  const edges = edge === null ? "no superior edge" : `superior edge at ${number(edge)} m/s in the median`;
  return `${strongest}; ${edges}`;
}

export function medianEdge(edges) {
  const found = [...edges].filter(Number.isFinite).sort((a, b) => a - b);
  return found.length ? found[found.length >> 1] : null;
}
