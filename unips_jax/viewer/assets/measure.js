// Tools with points: angles of normals, profiles of depth, a scale, places of notes.

const SAMPLES = 400;
const TOOLS = {
  light: { points: 0 },
  angle: { points: 2 },
  profile: { points: 2, drags: true },
  scale: { points: 2, drags: true, anywhere: true },
  note: { points: 1, anywhere: true },
};

/** Points that were set, and the cross that keys move. Places are columns and rows. */
class Measure {
  constructor(stage, normalBytes, depthBytes) {
    this.stage = stage;
    this.normalBytes = normalBytes;
    this.depthBytes = depthBytes;
    this.tool = "light";
    this.points = [];
    this.cross = [data.width / 2, data.height / 2];
    this.showCross = false;
    this.onNote = () => {};
  }

  setTool(tool) {
    this.tool = tool;
    this.reset();
  }

  get active() {
    return this.tool !== "light";
  }

  get drags() {
    return Boolean(TOOLS[this.tool].drags);
  }

  reset() {
    this.points = [];
    this.showCross = false;
    this.tell();
    this.stage.changed();
  }

  allowed(point) {
    if (TOOLS[this.tool].anywhere) return pixelAt(...point) >= 0;
    if (this.tool === "profile" && Number.isNaN(depthBetween(this.depthBytes, ...point))) return false;
    return this.normal(point) !== null;
  }

  /** Sets a point; after the last it begins anew. */
  set(column, row) {
    const point = [column, row];
    if (!this.allowed(point)) {
      byId("reading").textContent = say("outside");
      return;
    }
    if (this.tool === "note") return this.onNote(point);
    if (this.points.length === 2) this.points = [];
    this.points.push(point);
    this.tell();
    this.stage.changed();
  }

  /** Draws a line: its first point stays, its second follows. */
  drag(from, to) {
    if (!this.allowed(from)) {
      byId("reading").textContent = say("outside");
      return;
    }
    if (this.allowed(to)) this.points = [from, to];
    this.tell();
    this.stage.changed();
  }

  moveCross(right, down) {
    const limits = [data.width, data.height];
    this.cross = [right, down].map((step, axis) =>
      Math.min(Math.max(this.cross[axis] + step, 0), limits[axis] - 1)
    );
    this.showCross = true;
    this.stage.reveal(...this.cross);
  }

  /** Mean of the 3 x 3 normals around a point, a unit vector; null off the surface. */
  normal([column, row]) {
    if (!normalAt(this.normalBytes, column, row)) return null;
    const sum = [0, 0, 0];
    for (let dy = -1; dy <= 1; dy++) {
      for (let dx = -1; dx <= 1; dx++) {
        const n = normalAt(this.normalBytes, column + dx, row + dy) ?? [0, 0, 0];
        n.forEach((value, axis) => (sum[axis] += value));
      }
    }
    const length = Math.hypot(...sum);
    return sum.map((value) => value / length);
  }

  /** Distance of the two points in the depth's unit. */
  get distance() {
    return distanceOf(this.depthBytes, ...this.points);
  }

  /** Shows in the reading what is to be done, or what was found. */
  tell() {
    const reading = byId("reading");
    const whole = this.points.length === TOOLS[this.tool].points;
    byId("profile").hidden = !(this.tool === "profile" && whole);
    byId("set-scale").hidden = !(this.tool === "scale" && whole);
    if (!this.active) reading.textContent = "";
    else if (!whole) reading.textContent = say(`${this.tool}_${this.points.length ? "second" : "first"}`);
    else reading.textContent = this[this.tool]();
  }

  angle() {
    const [a, b] = this.points.map((point) => this.normal(point));
    const cross = [
      a[1] * b[2] - a[2] * b[1],
      a[2] * b[0] - a[0] * b[2],
      a[0] * b[1] - a[1] * b[0],
    ];
    const dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const degrees = (Math.atan2(Math.hypot(...cross), dot) * 180) / Math.PI;
    const shown = [a, b].map((n) => n.map((value) => number(value, 2)).join("; "));
    return say("angle_result", number(degrees), ...shown);
  }

  scale() {
    const pixels = Math.hypot(...this.points[0].map((value, axis) => value - this.points[1][axis]));
    // Once it is known, the length that was measured: through space, on the surface.
    const length = scale.mm === null ? scale.across(pixels) : scale.text(this.distance);
    return say("scale_length", length);
  }

  profile() {
    const [from, to] = this.points;
    const pixels = Math.hypot(to[0] - from[0], to[1] - from[1]);
    const heights = Array.from({ length: SAMPLES + 1 }, (_, i) => {
      const at = from.map((value, axis) => value + ((to[axis] - value) * i) / SAMPLES);
      return -depthBetween(this.depthBytes, ...at);
    });
    const there = heights.filter((value) => !Number.isNaN(value));
    const [low, high] = [Math.min(...there), Math.max(...there)];
    const digits = data.camera.focal === null ? 1 : 4;
    const text = (height) => scale.text(height, digits);
    const length = scale.across(pixels, -(low + high) / 2);
    this.chart(heights, length, low, high, text);
    const [rise, range] = [heights.at(-1) - heights[0], high - low];
    return say("profile_result", length, text(rise), text(range), text(this.distance));
  }

  chart(heights, length, low, high, text) {
    const [left, right, top, bottom] = [64, 310, 12, 130];
    const reach = high - low || 1;
    const x = (i) => left + ((right - left) * i) / SAMPLES;
    const y = (height) => bottom - ((bottom - top) * (height - low)) / reach;
    let path = "";
    let pen = "M";
    heights.forEach((height, i) => {
      if (Number.isNaN(height)) pen = "M";
      else {
        path += `${pen}${x(i).toFixed(1)} ${y(height).toFixed(1)}`;
        pen = "L";
      }
    });
    byId("chart").replaceChildren(
      svg("line", { x1: left, y1: bottom, x2: right, y2: bottom }),
      svg("line", { x1: left, y1: top, x2: left, y2: bottom }),
      svg("path", { d: path }),
      svg("text", { x: left - 4, y: top + 4, "text-anchor": "end" }, text(reach).replace(/ .*/, "")),
      svg("text", { x: left - 4, y: bottom + 4, "text-anchor": "end" }, "0"),
      svg("text", { x: left, y: bottom + 15 }, "1"),
      svg("text", { x: right, y: bottom + 15, "text-anchor": "end" }, `2 (${length})`),
      svg("text", { x: (left + right) / 2, y: bottom + 32, "text-anchor": "middle" }, say("profile_axis")),
      svg("text", { x: left + 6, y: top + 4 }, say("profile_height", text(reach).replace(/^\S+ /, "")))
    );
    byId("chart").setAttribute("aria-label", say("profile_chart", text(reach)));
  }

  /** Points, line and cross over the picture, as parts of the overlay. */
  parts() {
    if (!this.active || this.stage.mode !== "picture") return [];
    const places = this.points.map((point) => this.stage.screenAt(...point));
    const parts = [];
    if (this.drags && places.length === 2) {
      const [[x1, y1], [x2, y2]] = places;
      parts.push(...marked("line", { x1, y1, x2, y2 }));
    }
    places.forEach(([x, y], index) => {
      parts.push(...marked("circle", { cx: x, cy: y, r: 6 }), label(x + 10, y - 8, String(index + 1)));
    });
    if (this.showCross) {
      const [x, y] = this.stage.screenAt(this.cross[0] + 0.5, this.cross[1] + 0.5);
      const arms = `M${x - 12} ${y}H${x - 3}M${x + 3} ${y}H${x + 12}M${x} ${y - 12}V${y - 3}M${x} ${y + 3}V${y + 12}`;
      parts.push(...marked("path", { d: arms }));
    }
    return parts;
  }
}
