// Colours of the theme for what is drawn on canvases, and canvases as sharp as the screen.

const NAMES = ["ink", "muted", "faint", "card", "blue", "orange", "green", "purple", "cursor"];
let colours = {};

export function readColours() {
  const style = getComputedStyle(document.documentElement);
  colours = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

export function ink(name) {
  return colours[name];
}

// Streams of one kind are told apart by colour, by dashes and by their names beside the lines.
export const STROKES = [
  { colour: "blue", dash: [] },
  { colour: "orange", dash: [8, 4] },
  { colour: "green", dash: [2, 3] },
  { colour: "purple", dash: [10, 3, 2, 3] },
];

export const FONT = '12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

// The canvas's context, in CSS pixels, cleared; null while it is not laid out. `like`: of that one's size.
export function begin(canvas, like = canvas) {
  const { clientWidth: width, clientHeight: height } = like;
  if (!width || !height) return null;
  const ratio = window.devicePixelRatio || 1;
  const wide = Math.round(width * ratio);
  const high = Math.round(height * ratio);
  if (canvas.width !== wide || canvas.height !== high) {
    canvas.width = wide;
    canvas.height = high;
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = FONT;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineCap = "round";
  return { context, width, height };
}

// Text that stays legible on whatever lies below it.
export function haloed(context, words, x, y) {
  context.save();
  context.lineWidth = 4;
  context.setLineDash([]);
  context.strokeStyle = ink("card");
  context.strokeText(words, x, y);
  context.restore();
  context.fillText(words, x, y);
}

export function niceStep(span, most) {
  const rough = span / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
}

export function decimals(step) {
  return Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
}
