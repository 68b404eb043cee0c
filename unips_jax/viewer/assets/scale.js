// Lengths and their unit: millimetres, once two points and their distance are known.

/** What a scale holds for: the depth's unit, and the focal length in the result's pixels. */
const measured = {
  unit: data.depth?.unit ?? "pixels",
  focal: data.camera.focal === null ? null : Math.round(data.camera.focal * data.scale),
};

const scale = {
  // Per unit of the depth; null: not known. A kept one is of what it was set for.
  mm: kept.scale && holds(kept.scale) ? keptMm(kept.scale) : data.unit_mm,

  /** A length in the depth's unit, as text. */
  text(length, digits = 1) {
    if (this.mm === null) return `${number(length, digits)} ${unitName()}`;
    return metric(length * this.mm);
  },

  /** A length in pixels of the picture across the view, as text. */
  across(pixels, depth = NaN) {
    if (this.mm === null) return say("in_pixels", number(pixels * data.scale, 0));
    return metric(pixels * pixelSize(depth) * this.mm);
  },
};

/** Whether a kept scale is of this result; those of earlier versions name no camera. */
function holds({ unit, focal }) {
  const then = focal ? focal * grown[0] : measured.focal;
  return sameShape && unit === measured.unit && Math.abs(then - measured.focal) <= 1;
}

/** A kept scale for pixels of this result's size. */
function keptMm({ mm, unit }) {
  return mm && unit === "pixels" ? mm / grown[0] : mm;
}

function unitName() {
  return data.strings[language][`unit_${measured.unit}`] ?? measured.unit;
}

/** Millimetres as text, of three digits, in the unit that fits. */
function metric(mm) {
  const size = Math.abs(mm);
  const [value, unit] = size >= 1000 ? [mm / 1000, "m"] : size < 0.1 && size > 0 ? [mm * 1000, "µm"] : [mm, "mm"];
  return `${value.toLocaleString(language, { maximumSignificantDigits: 3 })} ${unit}`;
}

/** Distance of two places in the depth's unit: in space where both are on the surface,
 * else in the picture's plane. */
function distanceOf(depthBytes, a, b) {
  const [p, q] = [a, b].map((place) => spaceAt(depthBytes, place));
  if (!Number.isNaN(p[2]) && !Number.isNaN(q[2])) {
    return Math.hypot(...p.map((value, axis) => value - q[axis]));
  }
  return Math.hypot(a[0] - b[0], a[1] - b[1]) * pixelSize();
}

/** A bar of a round length in the stage's corner, as parts of the overlay. */
function scaleBar(stage) {
  if (scale.mm === null) return [];
  const perPixel = stage.unitPerScreenPixel() * scale.mm;
  const most = Math.min(180, stage.size[0] / 3) * perPixel;
  const power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map((digit) => digit * power).find((value) => value <= most);
  const [x, y, width] = [14, stage.size[1] - 14, length / perPixel];
  const path = `M${x} ${y - 8}V${y}H${x + width}V${y - 8}`;
  return [...marked("path", { d: path }), label(x, y - 13, metric(length), "scale-bar")];
}

/** A line drawn twice, so that it is seen on any ground. */
function marked(name, attributes) {
  return [["#000", 4], ["#ffe066", 2]].map(([stroke, width]) =>
    svg(name, { fill: "none", stroke, "stroke-width": width, ...attributes })
  );
}

function label(x, y, text, id = "") {
  const look = { fill: "#ffe066", stroke: "#000", "stroke-width": 3, "paint-order": "stroke" };
  return svg("text", { x, y, id, ...look, "font-size": 14, "font-family": "system-ui, sans-serif" }, text);
}

function svg(name, attributes, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  Object.entries(attributes).forEach(([key, value]) => value !== "" && element.setAttribute(key, value));
  element.textContent = text;
  return element;
}
