// The file's data: pictures as textures and as numbers, and texts by language.

const data = JSON.parse(document.getElementById("data").textContent);

const byId = (name) => document.getElementById(name);

let language = navigator.language.startsWith("de") ? "de" : "en";

/** A text of the table; {0}, {1}, ... are the values. */
function say(key, ...values) {
  const table = data.strings[language];
  const text = table[key] ?? data.strings.en[key] ?? key;
  return text.replace(/\{(\d)\}/g, (_, index) => String(values[index]));
}

function number(value, digits = 1) {
  return value.toLocaleString(language, { maximumFractionDigits: digits, minimumFractionDigits: digits });
}

function unitName(unit) {
  const known = data.strings[language][`unit_${unit}`];
  return known ?? unit;
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

function pixelAt(column, row) {
  const x = Math.floor(column);
  const y = Math.floor(row);
  return x < 0 || y < 0 || x >= data.width || y >= data.height ? -1 : y * data.width + x;
}
