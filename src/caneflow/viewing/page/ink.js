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

const EXACT = "devicePixelContentBoxSize" in ResizeObserverEntry.prototype;
const sizes = new WeakMap(); // of the elements that are watched
const callbacks = new WeakMap();
const observer = new ResizeObserver((entries) => {
  for (const entry of entries) {
    sizes.set(entry.target, sizeIn(entry));
    callbacks.get(entry.target)();
  }
});

function sizeIn({ contentRect: { width, height }, devicePixelContentBoxSize: exact }) {
  const ratio = window.devicePixelRatio || 1;
  const [wide, high] = exact ? [exact[0].inlineSize, exact[0].blockSize] : [width * ratio, height * ratio].map(Math.round);
  return { width: Math.round(width), height: Math.round(height), wide, high };
}

// Know this element's size from now on, so that nobody has to ask for it while drawing: to ask lays out the page again.
export function watch(element, changed) {
  callbacks.set(element, changed);
  observer.observe(element, EXACT ? { box: "device-pixel-content-box" } : {});
}

// In CSS pixels, and as wide and high in those of the screen: a picture of just as many need not be scaled.
export function sizeOf(element) {
  return sizes.get(element) ?? sizeIn({ contentRect: { width: element.clientWidth, height: element.clientHeight } });
}

// The canvas's context, in CSS pixels, as empty as the card below; null while it is not laid out. `like`: of that
// one's size; `clear`: see-through instead, which costs more to lay over the page.
export function begin(canvas, { like = canvas, clear = false } = {}) {
  const { wide, high } = sizeOf(like);
  if (!wide || !high) return null;
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [wide / ratio, high / ratio];
  if (canvas.width !== wide || canvas.height !== high) {
    canvas.width = wide;
    canvas.height = high;
  }
  const context = canvas.getContext("2d", { alpha: clear });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  if (clear) context.clearRect(0, 0, width, height);
  else {
    context.fillStyle = ink("card");
    context.fillRect(0, 0, width, height);
  }
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
