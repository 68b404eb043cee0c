// Measuring between two points of the picture: an angle of normals, a profile of depth.

const SAMPLES = 400;

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
  }

  setTool(tool) {
    this.tool = tool;
    this.reset();
  }

  get active() {
    return this.tool !== "light";
  }

  reset() {
    this.points = [];
    this.showCross = false;
    byId("profile").hidden = true;
    this.tell();
    this.draw();
  }

  /** Sets a point; the third begins anew. */
  set(column, row) {
    if (!this.normal([column, row])) {
      byId("reading").textContent = say("outside");
      return;
    }
    if (this.points.length === 2) this.points = [];
    this.points.push([column, row]);
    this.tell();
    this.draw();
  }

  moveCross(right, down) {
    const limits = [data.width, data.height];
    this.cross = [right, down].map((step, axis) =>
      Math.min(Math.max(this.cross[axis] + step, 0), limits[axis] - 1)
    );
    this.showCross = true;
    this.draw();
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

  /** Says in the reading what is to be done, or what was found. */
  tell() {
    const reading = byId("reading");
    byId("profile").hidden = true;
    if (!this.active) reading.textContent = "";
    else if (this.points.length < 2) {
      reading.textContent = say(`${this.tool}_${this.points.length ? "second" : "first"}`);
    } else if (this.tool === "angle") reading.textContent = this.angle();
    else reading.textContent = this.profile();
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

  profile() {
    const [from, to] = this.points;
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
    const heights = Array.from({ length: SAMPLES + 1 }, (_, i) => {
      const at = from.map((value, axis) => value + ((to[axis] - value) * i) / SAMPLES);
      return -depthBetween(this.depthBytes, ...at);
    });
    const there = heights.filter((value) => !Number.isNaN(value));
    const [low, high] = [Math.min(...there), Math.max(...there)];
    const unit = unitName(data.depth.unit);
    const digits = data.camera.focal === null ? 1 : 4;
    this.chart(heights, length * data.scale, low, high, unit, digits);
    const difference = heights.at(-1) - heights[0];
    return say(
      "profile_result",
      number(length * data.scale, 0),
      number(difference, digits),
      unit,
      number(high - low, digits)
    );
  }

  chart(heights, length, low, high, unit, digits) {
    const [left, right, top, bottom] = [52, 310, 12, 130];
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
    const parts = [
      svg("line", { x1: left, y1: bottom, x2: right, y2: bottom }),
      svg("line", { x1: left, y1: top, x2: left, y2: bottom }),
      svg("path", { d: path }),
      svg("text", { x: left - 4, y: top + 4, "text-anchor": "end" }, number(reach, digits)),
      svg("text", { x: left - 4, y: bottom + 4, "text-anchor": "end" }, "0"),
      svg("text", { x: left, y: bottom + 15 }, "1"),
      svg("text", { x: right, y: bottom + 15, "text-anchor": "end" }, `2 (${number(length, 0)})`),
      svg("text", { x: (left + right) / 2, y: bottom + 32, "text-anchor": "middle" }, say("profile_axis")),
      svg("text", { x: left + 6, y: top + 4 }, say("profile_height", unit)),
    ];
    byId("chart").replaceChildren(...parts);
    byId("chart").setAttribute("aria-label", say("profile_chart", 0, number(reach, digits), unit));
    byId("profile").hidden = false;
  }

  /** Draws points, line and cross over the picture. */
  draw() {
    const parts = [];
    const add = (name, attributes) => {
      parts.push(svg(name, { ...attributes, class: "mark" }), svg(name, { ...attributes, class: "mark" }));
    };
    if (this.active && this.stage.mode === "picture") {
      const places = this.points.map((point) => this.stage.screenAt(...point));
      if (this.tool === "profile" && places.length === 2) {
        const [[x1, y1], [x2, y2]] = places;
        add("line", { x1, y1, x2, y2 });
      }
      places.forEach(([x, y], index) => {
        add("circle", { cx: x, cy: y, r: 6 });
        parts.push(svg("text", { x: x + 10, y: y - 8 }, String(index + 1)));
      });
      if (this.showCross) {
        const [x, y] = this.stage.screenAt(this.cross[0] + 0.5, this.cross[1] + 0.5);
        add("path", { d: `M${x - 12} ${y}H${x - 3}M${x + 3} ${y}H${x + 12}M${x} ${y - 12}V${y - 3}M${x} ${y + 3}V${y + 12}` });
      }
    }
    byId("overlay").replaceChildren(...parts);
  }
}

function svg(name, attributes, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, value));
  element.textContent = text;
  return element;
}
