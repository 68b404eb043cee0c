// The mask over the photograph: drawn, painted and boxed on one canvas. Places are in the
// photograph's pixels, of which step x step are one of the canvas.
import { paint } from "./mask.js";

const SIDE = 1024; // of the canvas, nearly: all of it is drawn again and again
const MOST_UNDONE = 12;
const ARROWS = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Editor {
  // `onBox(left, top, right, bottom)` is called with places in pixels.
  constructor(canvas, onBox, onChange) {
    Object.assign(this, { canvas, onBox, onChange, tool: null, brush: 0.03, past: [] });
    canvas.onpointerdown = (event) => this.#down(event);
    canvas.onpointermove = (event) => this.#move(event);
    canvas.onpointerup = (event) => this.#up(event);
    canvas.onpointercancel = (event) => this.#cancel(event);
    canvas.onkeydown = (event) => this.#key(event);
    canvas.onblur = () => this.#forgetCursor();
  }

  // `picture` is RGB of [h, w, 3], 0 to 255; `mask` [h, w] is changed in place.
  show(picture, mask, width, height) {
    const step = Math.max(1, Math.round(Math.max(width, height) / SIDE));
    Object.assign(this, { mask, width, height, step, past: [] });
    this.canvas.width = Math.ceil(width / step);
    this.canvas.height = Math.ceil(height / step);
    this.setPicture(picture);
  }

  setPicture(picture) {
    this.picture = shrunk(picture, this.width, this.height, this.step);
    this.draw();
  }

  choose(tool) {
    this.tool = tool;
    this.#forgetCursor();
    this.canvas.classList.toggle("idle", tool === null);
  }

  replace(mask) {
    this.remember();
    this.mask.set(mask);
    this.draw();
    this.onChange();
  }

  remember() {
    this.past.push(this.mask.slice());
    if (this.past.length > MOST_UNDONE) this.past.shift();
  }

  undo() {
    const mask = this.past.pop();
    if (mask) this.mask.set(mask);
    this.draw();
    this.onChange();
  }

  draw(left = 0, top = 0, right = this.width, bottom = this.height) {
    const { step, width, canvas } = this;
    [left, top] = [left, top].map((value) => Math.max(0, Math.floor(value / step)));
    right = Math.min(canvas.width, Math.ceil(right / step));
    bottom = Math.min(canvas.height, Math.ceil(bottom / step));
    if (right <= left || bottom <= top) return;
    const wide = right - left;
    const part = new ImageData(wide, bottom - top);
    for (let y = top; y < bottom; y++) {
      for (let x = left; x < right; x++) {
        const [at, to] = [y * canvas.width + x, ((y - top) * wide + x - left) * 4];
        const inside = this.mask[y * step * width + x * step];
        for (let c = 0; c < 3; c++) {
          const value = this.picture[at * 3 + c];
          part.data[to + c] = inside ? value : value * 0.3 + (c === 2 ? 60 : 15);
        }
        part.data[to + 3] = 255;
      }
    }
    canvas.getContext("2d").putImageData(part, left, top);
  }

  #place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [
      ((event.clientX - box.left) / box.width) * this.canvas.width * this.step,
      ((event.clientY - box.top) / box.height) * this.canvas.height * this.step,
    ];
  }

  #down(event) {
    if (!this.tool || !event.isPrimary || event.button) return;
    event.preventDefault();
    this.canvas.focus({ preventScroll: true }); // keys go on from here
    this.#forgetCursor();
    this.canvas.setPointerCapture(event.pointerId);
    this.from = this.start = this.#place(event);
    if (this.tool !== "box") {
      this.remember();
      this.#stroke(this.from);
    }
  }

  #move(event) {
    if (!this.from || !event.isPrimary) return;
    const place = this.#place(event);
    if (this.tool === "box") this.#frame(this.start, place);
    else this.#stroke(place);
    this.from = place;
  }

  #frame([x, y], to) {
    this.draw();
    this.#pen().strokeRect(x, y, to[0] - x, to[1] - y);
  }

  #pen() {
    const context = this.canvas.getContext("2d");
    context.setTransform(1 / this.step, 0, 0, 1 / this.step, 0, 0);
    context.lineWidth = Math.max(2, this.width / 300);
    context.strokeStyle = "#ffb000";
    return context;
  }

  get #radius() {
    return Math.max(1, this.brush * Math.max(this.width, this.height));
  }

  #stroke(to) {
    const radius = this.#radius;
    const [a, b] = [this.from, to];
    paint(this.mask, this.width, this.height, a, b, radius, this.tool === "paint" ? 1 : 0);
    const low = (axis) => Math.min(a[axis], b[axis]) - radius - 1;
    const high = (axis) => Math.max(a[axis], b[axis]) + radius + 2;
    this.draw(low(0), low(1), high(0), high(1));
  }

  #up(event) {
    if (!this.from || !event.isPrimary) return; // a second finger ends nothing
    this.from = null;
    if (this.tool !== "box") this.onChange();
    else this.#endBox(this.start, this.#place(event));
  }

  #endBox([x0, y0], [x1, y1]) {
    this.draw();
    const [left, right] = [Math.max(0, Math.min(x0, x1)), Math.min(this.width, Math.max(x0, x1))];
    const [top, bottom] = [Math.max(0, Math.min(y0, y1)), Math.min(this.height, Math.max(y0, y1))];
    if (right - left > 8 && bottom - top > 8) this.onBox(left, top, right, bottom);
  }

  // Arrows move a cursor, with Shift they paint; the space bar dabs, or sets a corner.
  #key(event) {
    const arrow = ARROWS[event.key];
    const sets = event.key === " ";
    if (event.key === "z") this.undo();
    if (!this.tool || this.from || !(arrow || sets || event.key === "Escape")) return;
    event.preventDefault();
    const limits = [this.width, this.height];
    const before = this.cursor ?? limits.map((most) => most / 2);
    const step = (arrow ?? [0, 0]).map((sign) => sign * this.#radius);
    const at = before.map((value, axis) => Math.min(Math.max(value + step[axis], 0), limits[axis]));
    const { corner } = this;
    if (this.tool !== "box" && (sets || (arrow && event.shiftKey))) {
      if (!event.repeat) this.remember();
      this.from = before;
      this.#stroke(at);
      this.from = null;
      this.onChange();
    } else if (sets || !arrow) this.corner = sets && !corner ? at : null;
    this.cursor = at;
    this.#frame(this.corner ?? at, at);
    const pen = this.#pen();
    pen.beginPath();
    pen.arc(...at, this.tool === "box" ? 3 * pen.lineWidth : this.#radius, 0, 2 * Math.PI);
    pen.stroke();
    if (sets && corner) this.#endBox(corner, at);
  }

  #forgetCursor() {
    if (!this.cursor) return;
    this.cursor = this.corner = null;
    this.draw();
  }

  #cancel(event) {
    if (!event.isPrimary) return;
    if (this.from && this.tool === "box") this.draw();
    else if (this.from) this.undo();
    this.from = null;
  }
}

// A picture's means over step x step pixels; at the right and lower edge over fewer.
function shrunk(picture, width, height, step) {
  if (step === 1) return picture;
  const [w, h] = [Math.ceil(width / step), Math.ceil(height / step)];
  const out = new Uint8ClampedArray(w * h * 3);
  for (let i = 0; i < w * h; i++) {
    const [left, top] = [(i % w) * step, Math.floor(i / w) * step];
    const [right, bottom] = [Math.min(left + step, width), Math.min(top + step, height)];
    for (let c = 0; c < 3; c++) {
      let sum = 0;
      for (let y = top; y < bottom; y++) {
        for (let x = left; x < right; x++) sum += picture[(y * width + x) * 3 + c];
      }
      out[i * 3 + c] = sum / ((right - left) * (bottom - top));
    }
  }
  return out;
}
