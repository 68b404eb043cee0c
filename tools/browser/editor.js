// The mask over the photograph: drawn, painted and boxed on one canvas.
import { paint } from "./mask.js";

const MOST_UNDONE = 12;
const ARROWS = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Editor {
  // `onBox(left, top, right, bottom)` is called with places in pixels.
  constructor(canvas, onBox, onChange) {
    Object.assign(this, { canvas, onBox, onChange, tool: null, brush: 0.03, past: [] });
    canvas.onpointerdown = (event) => this.#down(event);
    canvas.onpointermove = (event) => this.#move(event);
    canvas.onpointerup = (event) => this.#up(event);
    canvas.onpointercancel = () => this.#cancel();
    canvas.onkeydown = (event) => this.#key(event);
    canvas.onblur = () => this.#forgetCursor();
  }

  // `picture` is RGB of [h, w, 3], 0 to 255; `mask` [h, w] is changed in place.
  show(picture, mask, width, height) {
    Object.assign(this, { picture, mask, width, height, past: [] });
    this.canvas.width = width;
    this.canvas.height = height;
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
    [left, top] = [Math.max(0, Math.floor(left)), Math.max(0, Math.floor(top))];
    [right, bottom] = [Math.min(this.width, Math.ceil(right)), Math.min(this.height, Math.ceil(bottom))];
    if (right <= left || bottom <= top) return;
    const wide = right - left;
    const part = new ImageData(wide, bottom - top);
    for (let y = top; y < bottom; y++) {
      for (let x = left; x < right; x++) {
        const [at, to] = [y * this.width + x, ((y - top) * wide + x - left) * 4];
        for (let c = 0; c < 3; c++) {
          const value = this.picture[at * 3 + c];
          part.data[to + c] = this.mask[at] ? value : value * 0.3 + (c === 2 ? 60 : 15);
        }
        part.data[to + 3] = 255;
      }
    }
    this.canvas.getContext("2d").putImageData(part, left, top);
  }

  #place(event) {
    const box = this.canvas.getBoundingClientRect();
    return [
      ((event.clientX - box.left) / box.width) * this.width,
      ((event.clientY - box.top) / box.height) * this.height,
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
    if (!this.from) return;
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

  #cancel() {
    if (this.from && this.tool === "box") this.draw();
    else if (this.from) this.undo();
    this.from = null;
  }
}
