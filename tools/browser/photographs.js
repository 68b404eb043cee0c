// Files to linear photographs and a mask, by the rules of unips_jax.io.
import { decode } from "fast-png";
import { Refusal } from "./text.js";

const BLACK = 2; // levels of 255, see unips_jax/io/masks.py
const NEARLY = 0.0145; // of white light
const LEVELS_SHARE = 0.9;
const LEVEL = 1 / 16;

// A file's pixels: {name, width, height, channels (1 or 3), top, values, alpha, tag}.
export async function readFile(file) {
  const bytes = new Uint8Array(await file.arrayBuffer().catch(() => {
    throw new Refusal("unread", { name: file.name }); // it was moved, or lies in a cloud
  }));
  const png = bytes[0] === 0x89 && bytes[1] === 0x50;
  if (png) {
    const depth = bytes[24];
    const palette = bytes[25] === 3;
    if (depth >= 8 && !palette) return ofPng(file.name, bytes);
  }
  return ofBrowser(file, png ? tagOf(bytes, 8) : "srgb");
}

function ofPng(name, bytes) {
  let png;
  try {
    png = decode(bytes, { checkCrc: true });
  } catch (error) {
    throw new Refusal("png", { name, error: error.message });
  }
  const { width, height, channels: stored, depth, data } = png;
  const channels = stored > 2 ? 3 : 1;
  const values = depth === 16 ? new Uint16Array(width * height * channels)
    : new Uint8Array(width * height * channels);
  const alpha = stored % 2 ? null : new values.constructor(width * height);
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < channels; c++) values[i * channels + c] = data[i * stored + c];
    if (alpha) alpha[i] = data[i * stored + stored - 1];
  }
  const top = depth === 16 ? 65535 : 255;
  return { name, width, height, channels, top, values, alpha, tag: tagOf(bytes, depth) };
}

// How a PNG's values encode light: by its colour chunks, else by its depth.
function tagOf(bytes, depth) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  for (let at = 8; at + 12 <= bytes.length; ) {
    const length = view.getUint32(at);
    const kind = String.fromCharCode(...bytes.subarray(at + 4, at + 8));
    if (kind === "sRGB" || kind === "iCCP") return "srgb";
    if (kind === "cICP") return bytes[at + 9] === 8 ? "linear" : "srgb";
    if (kind === "gAMA") return view.getUint32(at + 8) > 95000 ? "linear" : "srgb";
    if (kind === "IDAT") break;
    at += 12 + length;
  }
  return depth === 16 ? "linear" : "srgb";
}

async function ofBrowser(file, tag) {
  const bitmap = await decoded(file);
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(bitmap, 0, 0);
  const data = context.getImageData(0, 0, width, height).data;
  const values = new Uint8Array(width * height * 3);
  const alpha = new Uint8Array(width * height);
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) values[i * 3 + c] = data[i * 4 + c];
    alpha[i] = data[i * 4 + 3];
  }
  const clear = alpha.some((value) => value < 255);
  return {
    name: file.name, width, height, channels: 3, top: 255, values,
    alpha: clear ? alpha : null, tag,
  };
}

// An image as the browser decodes it, turned as its EXIF data says.
async function decoded(file) {
  const options = {
    colorSpaceConversion: "none", premultiplyAlpha: "none", imageOrientation: "from-image",
  };
  const image = new Image();
  try {
    return await createImageBitmap(file, options);
  } catch { // Safari decodes HEIC as an element first
    try {
      image.src = URL.createObjectURL(file);
      await image.decode();
      return await createImageBitmap(image, options);
    } catch {
      const heic = /\.(hei[cf]|hif)$/i.test(file.name) || /hei[cf]/.test(file.type);
      throw new Refusal(heic ? "heic" : "image", { name: file.name });
    } finally {
      URL.revokeObjectURL(image.src);
    }
  }
}

// What files are by their names, as unips_jax/io/selection.py has it among an output.
const MAPS = "normals?|nrm|masks?|depth|base[ _-]?colou?r|roughness|metal(?:lic|ness)?";
const MAP = new RegExp(
  `\\b(?:${MAPS}|albedo|gt)\\b|^shading\\b|^sheet$|^height$|^confidence$|^unreliable$|^plane [0-5]$`, "i",
);
const stem = (name) => name.replace(/\.[^.]*$/, "");
export const isMask = (name) => /^(.*\.)?mask$/i.test(stem(name));
export const isMap = (name) => {
  const words = stem(name).replace(/([a-z0-9])([A-Z])/g, "$1 $2");
  return MAP.test(words.replace(/[^\p{L}\p{N}]+|(?<=[a-zA-Z])(?=\d)/gu, " ").trim());
};

// `chosen`: somebody said how values encode light, so that files need not agree on it.
export function requireAlike(files, chosen) {
  const [first] = files;
  for (const file of files) {
    if (file.width !== first.width || file.height !== first.height) {
      throw new Refusal("size", differing(file, first));
    }
    if (file.top !== first.top) {
      const bits = (top) => (top === 255 ? 8 : 16);
      const values = { name: file.name, first: first.name, bits: bits(first.top), got: bits(file.top) };
      throw new Refusal("bits", values);
    }
    if (!chosen && file.tag !== first.tag) {
      throw new Refusal("tag", { name: file.name, first: first.name });
    }
  }
}

export function requireMaskFits(mask, first) {
  if (mask.width === first.width && mask.height === first.height) return;
  throw new Refusal("mask_size", differing(mask, first));
}

const differing = (file, first) => ({
  name: file.name, first: first.name,
  size: `${first.width} x ${first.height}`, got: `${file.width} x ${file.height}`,
});

export const brightestOf = (file) => {
  const { values, channels } = file;
  const out = new values.constructor(file.width * file.height);
  for (let i = 0; i < values.length; i++) {
    const at = (i / channels) | 0;
    if (values[i] > out[at]) out[at] = values[i];
  }
  return out;
};

const largest = (values) => values.reduce((a, b) => (a > b ? a : b), 0);

const aboveHalf = (values) => {
  const half = largest(values) / 2;
  return Uint8Array.from(values, (value) => (value > half ? 1 : 0));
};

// What a mask's image marks; the rule is that of unips_jax/io/masks.py.
export function maskOf(file) {
  const values = brightestOf(file);
  const { alpha } = file;
  if (!alpha || alpha.every((value) => value === alpha[0])) return aboveHalf(values);
  const mask = aboveHalf(alpha);
  const inside = values.filter((_, i) => mask[i]);
  const top = largest(inside);
  let dark = 0;
  let bright = 0;
  for (const value of inside) {
    if (value <= top * LEVEL) dark++;
    if (value >= top * (1 - LEVEL)) bright++;
  }
  if (top > 0 && dark > 0 && dark + bright >= LEVELS_SHARE * inside.length) {
    for (let i = 0; i < mask.length; i++) if (values[i] <= top / 2) mask[i] = 0;
  }
  return mask;
}

// The brightest of all photographs, from 0 to 255: what a threshold is set on.
export function brightestOfAll(files) {
  const all = brightestOf(files[0]);
  for (const file of files.slice(1)) {
    const values = brightestOf(file);
    for (let i = 0; i < all.length; i++) if (values[i] > all[i]) all[i] = values[i];
  }
  return all;
}

function lightOf(x, transfer) {
  if (transfer === "linear") return x;
  return x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
}

// The level that all but half a percent of the mask's pixels have at most.
function whiteIn(mask, brightest) {
  const counts = new Array(256).fill(0);
  let inside = 0;
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    counts[brightest[i]]++;
    inside++;
  }
  let left = Math.floor(0.995 * (inside - 1));
  return Math.max(counts.findIndex((count) => (left -= count) < 0), 0);
}

// Takes from a mask what is black in all photographs, or transparent in one.
export function leaveOut(mask, files, brightest, transfer) {
  const { width, top } = files[0];
  for (const { alpha } of files) {
    if (!alpha || alpha.every((value) => value === 255 || value === 65535)) continue;
    if (alpha.every((value) => value === 0)) continue; // by programs that know no alpha
    const opaque = aboveHalf(alpha);
    for (let i = 0; i < mask.length; i++) if (!opaque[i]) mask[i] = 0;
  }
  if (top !== 255) {
    for (let i = 0; i < mask.length; i++) if (!brightest[i]) mask[i] = 0;
    return mask;
  }
  // In 8 bits what is nearly black next to black is left out too.
  const nearly = NEARLY * lightOf(whiteIn(mask, brightest) / 255, transfer);
  const isDark = Array.from({ length: 256 }, (_, level) => lightOf(level / 255, transfer) <= nearly);
  const seen = new Uint8Array(mask.length);
  const open = [];
  for (let i = 0; i < mask.length; i++) {
    if (brightest[i] > BLACK || seen[i]) continue;
    seen[i] = 1;
    open.push(i);
    while (open.length) {
      const at = open.pop();
      mask[at] = 0;
      const x = at % width;
      for (let dy = -width; dy <= width; dy += width) {
        for (let dx = x ? -1 : 0; dx <= (x < width - 1 ? 1 : 0); dx++) {
          const near = at + dy + dx;
          if (near < 0 || near >= mask.length || seen[near]) continue;
          if (brightest[near] > BLACK && !isDark[brightest[near]]) continue;
          seen[near] = 1;
          open.push(near);
        }
      }
    }
  }
  return mask;
}

// Linear light [N, H, W, 3] and the mask, averaged over step x step pixels.
export function linearImages(files, mask, transfer, step) {
  const { width, height, top } = files[0];
  const [w, h] = [Math.floor(width / step), Math.floor(height / step)];
  const images = new Float32Array(files.length * h * w * 3);
  const table = Float32Array.from({ length: top + 1 }, (_, value) => lightOf(value / top, transfer));
  const share = 1 / (step * step);
  files.forEach(({ values, channels }, k) => {
    for (let y = 0; y < h * step; y++) {
      for (let x = 0; x < w * step; x++) {
        const to = ((k * h + Math.floor(y / step)) * w + Math.floor(x / step)) * 3;
        const from = (y * width + x) * channels;
        for (let c = 0; c < 3; c++) {
          images[to + c] += share * table[values[from + (channels === 3 ? c : 0)]];
        }
      }
    }
  });
  const counts = new Uint32Array(h * w);
  for (let y = 0; y < h * step; y++) {
    for (let x = 0; x < w * step; x++) {
      counts[Math.floor(y / step) * w + Math.floor(x / step)] += mask[y * width + x];
    }
  }
  const inside = Uint8Array.from(counts, (count) => (2 * count > step * step ? 1 : 0));
  return { images, mask: inside, width: w, height: h };
}

// The files of folders that were dropped; files themselves came with the event.
export async function filesOf(entries) {
  const found = [];
  for (const entry of entries) {
    if (!entry?.isDirectory) continue;
    const reader = entry.createReader();
    for (let batch; (batch = await new Promise((ok, no) => reader.readEntries(ok, no))).length; ) {
      for (const inner of batch) {
        if (inner.isFile) found.push(await new Promise((ok, no) => inner.file(ok, no)));
      }
    }
  }
  return found;
}
