// Depth from normals, and the product's own viewer around a result.
import { encode } from "fast-png";

const SIDE = 1024; // of the viewer's pictures
const MARGIN = 0.04;
const ROUNDS = 400;

// Depth away from the viewer, in pixels, by least squares over neighbours: conjugate
// gradients, from half the size up. `normals` [h, w, 3]; 0 outside.
export function depthOf(normals, w, h) {
  let start = null;
  if (Math.max(w, h) > 48) {
    const [hw, hh] = [w >> 1, h >> 1];
    const half = new Float32Array(hw * hh * 3);
    for (let y = 0; y < hh; y++) {
      for (let x = 0; x < hw; x++) {
        for (let c = 0; c < 3; c++) {
          half[(y * hw + x) * 3 + c] = [0, 1, w, w + 1].reduce(
            (sum, at) => sum + normals[((2 * y * w) + 2 * x + at) * 3 + c], 0);
        }
        const at = (y * hw + x) * 3;
        const length = Math.hypot(half[at], half[at + 1], half[at + 2]);
        for (let c = 0; c < 3; c++) half[at + c] /= length || 1;
      }
    }
    const coarse = depthOf(half, hw, hh);
    start = new Float32Array(w * h);
    for (let i = 0; i < w * h; i++) {
      const [x, y] = [Math.min((i % w) >> 1, hw - 1), Math.min(Math.floor(i / w) >> 1, hh - 1)];
      start[i] = 2 * coarse[y * hw + x];
    }
  }
  return solve(normals, w, h, start);
}

// 16 bits, as `unips estimate` writes it: (n + 1) / 2 of full scale, green is up.
export function normalsPng({ normals, width, height }) {
  const data = Uint16Array.from(normals, (n) =>
    Math.min(65535, Math.floor(n * 32767.5 + 32768)));
  return encode({ width, height, data, depth: 16, channels: 3 });
}

// Only pixels that are there take part: an object fills a fraction of its picture.
function solve(normals, w, h, start) {
  const { places, joined, weight, right, diagonal } = equations(normals, w, h);
  const size = places.length;
  const depth = Float32Array.from(places, (i) => (start ? start[i] : 0));
  const residual = right.slice();
  const image = new Float32Array(size);
  // What the equations make of values.
  const apply = (v) => {
    image.fill(0);
    for (const axis of [0, 1]) {
      const [next, trust] = [joined[axis], weight[axis]];
      for (let i = 0; i < size; i++) {
        if (!trust[i]) continue;
        const flow = trust[i] * (v[i] - v[next[i]]);
        image[i] += flow;
        image[next[i]] -= flow;
      }
    }
  };
  apply(depth);
  for (let i = 0; i < size; i++) residual[i] -= image[i];
  const ease = (from, to) => {
    let sum = 0; // of products with what it was
    for (let i = 0; i < size; i++) {
      to[i] = diagonal[i] ? from[i] / diagonal[i] : 0;
      sum += to[i] * from[i];
    }
    return sum;
  };
  const z = new Float32Array(size);
  const enough = 1e-8 * ease(right, z);
  let power = ease(residual, z);
  const along = z.slice();
  for (let round = 0; round < ROUNDS && power > enough; round++) {
    apply(along);
    let across = 0;
    for (let i = 0; i < size; i++) across += along[i] * image[i];
    const length = power / (across || 1);
    for (let i = 0; i < size; i++) {
      depth[i] += length * along[i];
      residual[i] -= length * image[i];
    }
    const next = ease(residual, z);
    const share = next / power;
    for (let i = 0; i < size; i++) along[i] = z[i] + share * along[i];
    power = next;
  }
  const all = start ?? new Float32Array(w * h);
  depth.forEach((value, i) => { all[places[i]] = value; });
  return all;
}

// Between each pixel and its right (0) and lower (1) neighbour: their numbers, how far
// each is trusted, and by how much depth differs there.
function equations(normals, w, h) {
  const there = (i) => normals[3 * i] || normals[3 * i + 1] || normals[3 * i + 2];
  const facing = (i) => Math.max(normals[3 * i + 2], 0.08);
  const number = new Int32Array(w * h).fill(-1);
  const places = [];
  for (let i = 0; i < w * h; i++) if (there(i)) number[i] = places.push(i) - 1;
  const of = (kind) => [0, 1].map(() => new kind(places.length));
  const [joined, weight] = [of(Int32Array), of(Float32Array)];
  const right = new Float32Array(places.length);
  const diagonal = new Float32Array(places.length);
  places.forEach((i, a) => {
    for (const axis of [0, 1]) {
      const j = i + (axis ? w : 1);
      if (j >= w * h || (axis === 0 && j % w === 0) || number[j] < 0) continue;
      const slope = (k) => (axis === 0 ? normals[3 * k] : -normals[3 * k + 1]) / facing(k);
      const value = (slope(i) + slope(j)) / 2;
      const trust = Math.min(facing(i), facing(j)) ** 2;
      const b = number[j];
      [joined[axis][a], weight[axis][a]] = [b, trust];
      diagonal[a] += trust;
      diagonal[b] += trust;
      right[a] -= trust * value;
      right[b] += trust * value;
    }
  });
  return { places, joined, weight, right, diagonal };
}

// The part that is shown, means over `step` x `step` pixels of what is inside.
function partOf(values, inside, w, h, channels) {
  const xs = [];
  const ys = [];
  for (let i = 0; i < inside.length; i++) {
    if (!inside[i]) continue;
    xs.push(i % w);
    ys.push(Math.floor(i / w));
  }
  const least = (list) => list.reduce((a, b) => Math.min(a, b), Infinity);
  const most = (list) => list.reduce((a, b) => Math.max(a, b), 0);
  const margin = Math.ceil(MARGIN * Math.max(most(xs) - least(xs), most(ys) - least(ys)));
  const left = Math.max(0, least(xs) - margin);
  const top = Math.max(0, least(ys) - margin);
  const [wide, high] = [Math.min(w, most(xs) + margin + 1) - left, Math.min(h, most(ys) + margin + 1) - top];
  const step = Math.max(1, Math.ceil(Math.max(wide, high) / SIDE));
  const [width, height] = [Math.max(1, Math.floor(wide / step)), Math.max(1, Math.floor(high / step))];
  const shrink = (from, count) => {
    const out = new Float32Array(width * height * count);
    for (let y = 0; y < height * step; y++) {
      for (let x = 0; x < width * step; x++) {
        const to = (Math.floor(y / step) * width + Math.floor(x / step)) * count;
        const at = ((top + y) * w + left + x) * count;
        for (let c = 0; c < count; c++) out[to + c] += from[at + c] / step ** 2;
      }
    }
    return out;
  };
  return { left, top, width, height, step, shrink };
}

const address = (bytes, type) => new Promise((resolve) => {
  const reader = new FileReader();
  reader.onload = () => resolve(reader.result);
  reader.readAsDataURL(new Blob([bytes], { type }));
});

const png = (data, width, height) =>
  address(encode({ width, height, data, depth: 8, channels: 3 }), "image/png");

async function jpeg(linear, white, width, height) {
  const picture = new ImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) {
      const x = Math.min(linear[3 * i + c] / white, 1);
      picture.data[4 * i + c] = 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
    }
    picture.data[4 * i + 3] = 255;
  }
  const canvas = new OffscreenCanvas(width, height);
  canvas.getContext("2d").putImageData(picture, 0, 0);
  return address(await canvas.convertToBlob({ type: "image/jpeg", quality: 0.82 }), "image/jpeg");
}

// The page of `unips view` for a result: {normals, mask, width, height, images, names}.
export async function viewerPage(template, result, title) {
  const { normals, mask, images, names } = result;
  const part = partOf(normals, mask, result.width, result.height);
  const { width, height, step, left, top } = part;
  const shown = part.shrink(normals, 3);
  const inside = part.shrink(Float32Array.from(mask), 1).map((share) => (share > 0.5 ? 1 : 0));
  const bytes = new Uint8Array(width * height * 3).fill(128);
  for (let i = 0; i < width * height; i++) {
    const length = inside[i] ? Math.hypot(...shown.subarray(3 * i, 3 * i + 3)) : 0;
    for (let c = 0; c < 3; c++) {
      shown[3 * i + c] = length ? shown[3 * i + c] / length : 0;
      bytes[3 * i + c] = Math.round(shown[3 * i + c] * 127.5 + 127.5);
    }
  }
  const depth = depthOf(shown, width, height);
  const pixels = width * height;
  const found = { facts: [["size", `${result.width} x ${result.height}`], ["photographs", String(names.length)]] };
  const photographs = [];
  const mean = new Float32Array(pixels * 3);
  const size = result.width * result.height * 3;
  for (const [k, name] of names.entries()) {
    const linear = part.shrink(images.subarray(k * size, (k + 1) * size), 3);
    linear.forEach((value, i) => { mean[i] += value / names.length; });
    photographs.push({ name, image: await jpeg(linear, whiteOf(linear, inside), width, height) });
  }
  return withData(template, title, {
    ...found, width, height, scale: step, first: [left, top], unit_mm: null,
    camera: {
      focal: null, distance: 1,
      column: ((result.width - 1) / 2 - left + 0.5) / step - 0.5,
      row: ((result.height - 1) / 2 - top + 0.5) / step - 0.5,
    },
    normals: await png(bytes, width, height),
    depth: await depthPicture(depth, inside, width, height, step),
    confidence: null,
    color: { image: await jpeg(mean, whiteOf(mean, inside), width, height), kind: "mean" },
    photographs,
  });
}

function whiteOf(linear, inside) {
  const values = [];
  for (let i = 0; i < inside.length; i++) {
    if (inside[i]) values.push(Math.max(linear[3 * i], linear[3 * i + 1], linear[3 * i + 2]));
  }
  values.sort((a, b) => a - b);
  return values[Math.floor(0.995 * (values.length - 1))] || 1;
}

async function depthPicture(depth, inside, width, height, step) {
  let [near, far] = [Infinity, -Infinity];
  depth.forEach((value, i) => {
    if (!inside[i]) return;
    near = Math.min(near, value);
    far = Math.max(far, value);
  });
  const bytes = new Uint8Array(width * height * 3);
  depth.forEach((value, i) => {
    if (!inside[i]) return;
    const level = 1 + Math.round(((value - near) / (far - near || 1)) * 65534);
    bytes[3 * i] = level >> 8;
    bytes[3 * i + 1] = level & 255;
  });
  const image = await png(bytes, width, height);
  return { image, near: near * step, far: far * step, unit: "pixels", pixel: step };
}

function withData(template, title, data) {
  const open = '<script type="application/json" id="data">';
  const from = template.indexOf(open) + open.length;
  const to = template.indexOf("</script>", from);
  const all = { ...JSON.parse(template.slice(from, to)), ...data };
  const escaped = title.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
  return template.slice(0, from).replaceAll("TITLE", escaped) +
    JSON.stringify(all).replaceAll("<", "\\u003c") + template.slice(to);
}
