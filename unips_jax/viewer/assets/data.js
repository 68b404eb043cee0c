// The file's data: pictures as textures and as numbers, and texts by language.

// The file as it came, before anything is changed: what "save with notes" saves again.
const source = `<!doctype html>\n${document.documentElement.outerHTML}\n`;

const byId = (name) => document.getElementById(name);
const data = JSON.parse(byId("data").textContent);
const kept = JSON.parse(byId("notes").textContent); // what a reader saved: see notes.js

// Of a frame it may be that of the page around.
let language = (location.hash.slice(1) || window.frameElement?.lang || navigator.language).startsWith("de") ? "de" : "en";

/** A text of the table; {0}, {1}, ... are the values. */
function say(key, ...values) {
  const table = data.strings[language];
  const text = table[key] ?? data.strings.en[key] ?? key;
  return text.replace(/\{(\d)\}/g, (_, index) => String(values[index]));
}

function number(value, digits = 1) {
  return value.toLocaleString(language, { maximumFractionDigits: digits, minimumFractionDigits: digits });
}

/** Decodes a picture; resolves to an image element. */
async function picture(source) {
  const image = new Image();
  image.src = source;
  await image.decode();
  return image;
}

/** A picture's bytes, RGBA, row by row. All of ours are opaque, so none is altered. */
function bytesOf(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, canvas.width, canvas.height).data;
}

/** A texture of values: no mipmaps, no colour conversion, first row on top. */
function textureOf(image, { exact = false } = {}) {
  const texture = new THREE.Texture(image);
  texture.flipY = false;
  texture.generateMipmaps = false;
  texture.minFilter = texture.magFilter = exact ? THREE.NearestFilter : THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

/** The normal at a pixel, a unit vector [x, y, z]; null where there is no surface. */
function normalAt(bytes, column, row) {
  const at = pixelAt(column, row);
  if (at < 0) return null;
  const n = [0, 1, 2].map((channel) => bytes[4 * at + channel] / 127.5 - 1);
  const length = Math.hypot(...n);
  return length < 0.5 ? null : n.map((value) => value / length);
}

/** Depth at a pixel, in the data's unit; NaN where there is no surface. */
function depthAt(bytes, column, row) {
  const at = pixelAt(column, row);
  if (at < 0) return NaN;
  const level = 256 * bytes[4 * at] + bytes[4 * at + 1];
  if (level === 0) return NaN;
  const { near, far } = data.depth;
  return near + ((level - 1) / 65534) * (far - near);
}

/** Depth between pixels' middles, bilinear; the pixel's own at the surface's edge. */
function depthBetween(bytes, column, row) {
  const [left, top] = [Math.floor(column - 0.5), Math.floor(row - 0.5)];
  const [right, down] = [column - 0.5 - left, row - 0.5 - top];
  const [a, b] = [0, 1].map((y) => {
    const pair = [0, 1].map((x) => depthAt(bytes, left + x, top + y));
    return pair[0] + right * (pair[1] - pair[0]);
  });
  const between = a + down * (b - a);
  return Number.isNaN(between) ? depthAt(bytes, column, row) : between;
}

/** Side of a pixel of this picture, in the depth's unit; at the mean distance, if the
 * camera is not orthographic and there is no depth. */
function pixelSize(depth = NaN) {
  const { focal, distance } = data.camera;
  if (focal === null) return data.depth?.pixel ?? data.scale;
  return (Number.isNaN(depth) ? distance : depth) / focal;
}

/** A place of this picture as a point in space, in the depth's unit: x right, y up, z
 * towards the viewer; z is NaN where there is no surface. */
function spaceAt(depthBytes, [column, row]) {
  const depth = depthBytes ? depthBetween(depthBytes, column, row) : NaN;
  const side = pixelSize(depth);
  return [
    (column - 0.5 - data.camera.column) * side,
    -(row - 0.5 - data.camera.row) * side,
    -depth,
  ];
}

/** Pixels of the result from those of this picture, and back: files may hold pictures
 * of other sizes, notes stay where they are. */
const resultPlace = (place) => place.map((value, axis) => data.first[axis] + value * data.scale);
const picturePlace = (place) => place.map((value, axis) => (value - data.first[axis]) / data.scale);

/** The result's size, as text, and its pixels to one of the result that a reader's notes
 * were kept from, across and down; pages of earlier versions do not say its size. */
const resultSize = new Map(data.facts).get("size");
const grown = [0, 1].map((axis) => (kept.size ? resultSize.split(" x ")[axis] / kept.size.split(" x ")[axis] : 1));
const sameShape = Math.abs(grown[0] / grown[1] - 1) < 0.01;
const keptPlace = (place) => place.map((value, axis) => value * grown[axis]);

function pixelAt(column, row) {
  const x = Math.floor(column);
  const y = Math.floor(row);
  return x < 0 || y < 0 || x >= data.width || y >= data.height ? -1 : y * data.width + x;
}
