// What stands around the user: a picture of three sectors, a table, and words. Shapes tell the levels apart, not colours.

import { begin, ink, watch } from "./ink.js";
import { number } from "./words.js";

const SECTORS = ["left", "ahead", "right"];
const LEVELS = ["low", "waist", "head", "drop"];
const KINDS = ["none", "obstacle", "drop", "blind"];
const FEW_KNOWN = 0.2; // share of a sector's cells, below which nothing found means little
const FARTHEST = 3; // m ahead
const BESIDE = 1.5; // m ahead, to which the sectors at the sides reach
const ASIDE = 1.1; // m to either side
const SHOULDER = 0.35; // m

export function obstacleRows(found) {
  return SECTORS.map((sector) => [sector, LEVELS.map((level) => cell(found, `${sector}_${level}`))]);
}

function cell(found, place) {
  const distance = found[place];
  if (distance > 0) return `${number(distance, 1)} m`;
  return found[`known_${place}`] < FEW_KNOWN ? "?" : "–";
}

export function obstaclesInWords(found, cue) {
  const kind = cue ? KINDS[cue.kind] : "none";
  if (kind === "blind") return "Blind: a sensor or the position is missing.";
  const told =
    kind === "none" ? "Nothing is told of." : `Told of: ${LEVELS[cue.level]}, ${number(cue.distance, 1)} m ahead.`;
  const beside = ["left", "right"].map((sector) => {
    const near = LEVELS.filter((level) => found[`${sector}_${level}`] > 0);
    return `${sector}: ${near.map((level) => `${level} ${number(found[`${sector}_${level}`], 1)} m`).join(", ") || "nothing"}`;
  });
  return `${told} Beside, ${beside.join("; ")}.${found.walking ? "" : " Not walking."}`;
}

export class ObstaclePicture {
  constructor(canvas) {
    this.canvas = canvas;
    this.last = null;
    watch(canvas, () => this.last && this.draw(...this.last));
  }

  // Seen from above, the way ahead upwards; each obstacle is a mark in its sector, at its distance.
  draw(found, cue) {
    this.last = [found, cue];
    const opened = begin(this.canvas);
    if (!opened) return;
    const { context, width, height } = opened;
    const scale = Math.min((height - 40) / FARTHEST, (width - 60) / (2 * ASIDE));
    const x = (aside) => width / 2 - aside * scale;
    const y = (ahead) => height - 20 - ahead * scale;
    context.strokeStyle = ink("muted");
    context.lineWidth = 1;
    context.strokeRect(x(SHOULDER), y(FARTHEST), 2 * SHOULDER * scale, FARTHEST * scale);
    context.strokeRect(x(ASIDE), y(BESIDE), 2 * ASIDE * scale, BESIDE * scale);
    context.fillStyle = ink("muted");
    for (const ahead of [1, 2, 3]) {
      context.fillRect(x(-SHOULDER), y(ahead), 6, 1);
      context.fillText(`${ahead} m`, x(-SHOULDER) + 9, y(ahead) + (ahead === 3 ? 12 : 4));
    }
    context.fillStyle = context.strokeStyle = ink("ink");
    context.lineWidth = 2;
    SECTORS.forEach((sector, side) => {
      LEVELS.forEach((level, i) => {
        const distance = found[`${sector}_${level}`];
        if (!(distance > 0)) return;
        const middle = side === 1 ? 0 : (side === 0 ? 1 : -1) * 0.5 * (SHOULDER + ASIDE);
        const told = side === 1 && cue && LEVELS[cue.level] === level;
        mark(context, level, x(middle + (1.5 - i) * 0.16), y(distance), told);
      });
    });
    context.beginPath();
    context.arc(x(0), y(0), 5, 0, 2 * Math.PI);
    context.fill();
  }
}

function mark(context, level, x, y, told) {
  const size = 7;
  context.beginPath();
  if (level === "low") context.rect(x - size, y + 2, 2 * size, 4);
  else if (level === "waist") context.rect(x - size, y - size, 2 * size, 2 * size);
  else {
    const way = level === "head" ? -1 : 1;
    context.moveTo(x, y + way * size);
    context.lineTo(x + size, y - way * size);
    context.lineTo(x - size, y - way * size);
    context.closePath();
  }
  if (level === "drop") context.stroke();
  else context.fill();
  if (!told) return;
  context.beginPath();
  context.arc(x, y, 1.9 * size, 0, 2 * Math.PI);
  context.stroke();
}
