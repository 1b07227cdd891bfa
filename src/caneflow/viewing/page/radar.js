// The range-Doppler map with its superior edge.

import { begin, decimals, ink, niceStep, watch } from "./ink.js";

// Dark to light in even steps of brightness, told apart by the colour-blind too (cividis).
const STOPS = [
  [0, 32, 77], [0, 53, 107], [60, 77, 110], [96, 99, 111], [124, 123, 120], [155, 147, 119], [187, 174, 109],
  [222, 203, 90], [255, 234, 70],
];
const RAMP = new Uint32Array(256);
for (let i = 0; i < 256; i += 1) {
  const at = (i / 255) * (STOPS.length - 1);
  const low = Math.min(Math.floor(at), STOPS.length - 2);
  const [r, g, b] = STOPS[low].map((from, c) => Math.round(from + (STOPS[low + 1][c] - from) * (at - low)));
  RAMP[i] = (255 << 24) | (b << 16) | (g << 8) | r;
}

const LEFT = 46;
const RIGHT = 58;
const TOP = 10;
const BOTTOM = 34;

export class RadarMap {
  constructor(canvas) {
    this.canvas = canvas;
    this.image = document.createElement("canvas");
    this.visible = true;
    new IntersectionObserver(([entry]) => {
      this.visible = entry.isIntersecting;
    }).observe(canvas);
    watch(canvas, () => this.resized());
  }

  resized() {}

  draw(picture) {
    const opened = begin(this.canvas);
    if (!opened || !picture) return;
    const { context, width, height } = opened;
    const wide = width - LEFT - RIGHT;
    const high = height - TOP - BOTTOM;
    this.paint(picture);
    context.imageSmoothingEnabled = true;
    context.drawImage(this.image, LEFT, TOP, wide, high);
    const limit = picture.speed_limit;
    const near = picture.range_start;
    const far = near + picture.ranges * picture.range_step;
    const x = (speed) => LEFT + ((speed + limit) / (2 * limit)) * wide;
    const y = (range) => TOP + high - ((range - near) / (far - near)) * high;
    this.edge(context, picture, x, y);
    this.axes(context, { limit, near, far, x, y, wide, high });
    this.scale(context, picture.top, LEFT + wide + 10, high);
  }

  isVisible() {
    return this.visible;
  }

  paint({ levels, ranges, speeds }) {
    this.image.width = speeds;
    this.image.height = ranges;
    const drawing = this.image.getContext("2d");
    const pixels = drawing.createImageData(speeds, ranges);
    const colours = new Uint32Array(pixels.data.buffer);
    for (let row = 0; row < ranges; row += 1) {
      const from = (ranges - 1 - row) * speeds; // near ranges at the bottom
      for (let column = 0; column < speeds; column += 1) colours[row * speeds + column] = RAMP[levels[from + column]];
    }
    drawing.putImageData(pixels, 0, 0);
  }

  edge(context, { edges, range_start: start, range_step: step }, x, y) {
    const path = new Path2D();
    let drawing = false;
    edges.forEach((speed, row) => {
      if (Number.isFinite(speed)) {
        const at = [x(speed), y(start + (row + 0.5) * step)];
        if (drawing) path.lineTo(...at);
        else path.moveTo(...at);
        drawing = true;
      } else drawing = false;
    });
    context.lineWidth = 5;
    context.strokeStyle = "#000";
    context.stroke(path);
    context.lineWidth = 2;
    context.strokeStyle = "#fff";
    context.stroke(path);
  }

  axes(context, { limit, near, far, x, y, wide, high }) {
    context.fillStyle = ink("muted");
    context.strokeStyle = ink("faint");
    context.lineWidth = 1;
    context.strokeRect(LEFT, TOP, wide, high);
    context.textAlign = "center";
    const speedStep = niceStep(2 * limit, 6);
    for (let speed = Math.ceil(-limit / speedStep) * speedStep; speed <= limit + 1e-9; speed += speedStep) {
      context.fillText(label(speed, speedStep), x(speed), TOP + high + 10);
    }
    context.fillText("← receding   m/s   approaching →", LEFT + wide / 2, TOP + high + 25);
    context.textAlign = "right";
    const rangeStep = niceStep(far - near, 5);
    for (let range = Math.ceil(near / rangeStep) * rangeStep; range <= far; range += rangeStep) {
      context.fillText(`${label(range, rangeStep)} m`, LEFT - 5, y(range));
    }
    context.save();
    context.setLineDash([2, 4]);
    context.strokeStyle = "#ffffff90";
    context.beginPath();
    context.moveTo(x(0), TOP);
    context.lineTo(x(0), TOP + high);
    context.stroke();
    context.restore();
  }

  scale(context, top, left, high) {
    const fill = context.createLinearGradient(0, TOP + high, 0, TOP);
    STOPS.forEach((rgb, i) => fill.addColorStop(i / (STOPS.length - 1), `rgb(${rgb.join(",")})`));
    context.fillStyle = fill;
    context.fillRect(left, TOP, 10, high);
    context.fillStyle = ink("muted");
    context.textAlign = "left";
    context.fillText(`${top}`, left + 14, TOP + 6);
    context.fillText("dB", left + 14, TOP + high / 2);
    context.fillText("0", left + 14, TOP + high - 6);
  }
}

function label(number, step) {
  return (Math.abs(number) < 1e-9 ? 0 : number).toFixed(decimals(step)).replace("-", "−");
}
