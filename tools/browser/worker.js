// Runs the networks next to the page: photographs in, a mask or normals out.
import { maskFrom, networkInputs } from "./mask.js";

// Members of sets (a pixel in one photograph) decoded at a time: what stays in cache
// takes half the time of four times as many.
const CHUNK = 2048;
const KEEP_EVERY = 4000; // milliseconds between normals sent to be kept

let started;
const sessions = {};

async function session(part) {
  started ??= (async () => {
    const ort = await import("./vendor/onnxruntime-web/ort.wasm.bundle.min.mjs");
    const threads = self.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, 8) : 1;
    ort.env.wasm.numThreads = threads;
    ort.env.wasm.wasmPaths = new URL("./vendor/onnxruntime-web/", self.location).href;
    return { ort, threads };
  })();
  const { ort, threads } = await started;
  sessions[part] ??= ort.InferenceSession.create(`./network/${part}.onnx`, {
    executionProviders: ["wasm"],
  });
  return { ort, threads, run: await sessions[part] };
}

async function findMask({ picture, width, height }) {
  postMessage({ stage: "mask" });
  const { ort, run } = await session("mask");
  const answers = [];
  for (const values of networkInputs(picture, width, height)) {
    const input = new ort.Tensor("float32", values, [1, 3, 320, 320]);
    const found = await run.run({ [run.inputNames[0]]: input });
    answers.push(found[run.outputNames[0]].data);
  }
  postMessage({ found: maskFrom(...answers, picture, width, height) });
}

// Masked pixels: every fourth row and column first, then every second, then the rest.
function passes(mask, width) {
  const found = [[], [], []];
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    const place = i % width | Math.floor(i / width);
    found[place & 1 ? 2 : place & 2 ? 1 : 0].push(i);
  }
  return found;
}

async function decodePart({ ort, run }, encoded, images, inside, n, width, size) {
  const pixels = new Float32Array(inside.length * n * 3);
  const rows = new Int32Array(inside.length);
  const columns = new Int32Array(inside.length);
  inside.forEach((place, i) => {
    rows[i] = Math.floor(place / width);
    columns[i] = place % width;
    for (let k = 0; k < n; k++) {
      const from = (k * size + place) * 3;
      pixels.set(images.subarray(from, from + 3), (i * n + k) * 3);
    }
  });
  const count = inside.length;
  const { normals } = await run.run({
    ...encoded,
    pixels: new ort.Tensor("float32", pixels, [count, n, 3]),
    rows: new ort.Tensor("int32", rows, [count]),
    columns: new ort.Tensor("int32", columns, [count]),
  });
  return normals.data;
}

// `known` are normals of an earlier run that was cut off: 0 where there are none.
async function estimate({ images, mask, n, width, height, known }) {
  postMessage({ stage: "loading" });
  const encoder = await session("encoder");
  const decoder = await session("decoder");
  postMessage({ stage: "encoding" });
  const began = performance.now();
  const encoded = await encoder.run.run({
    images: new encoder.ort.Tensor("float32", images, [n, height, width, 3]),
    mask: new encoder.ort.Tensor("bool", mask, [height, width]),
  });
  const size = width * height;
  const normals = known ?? new Float32Array(size * 3);
  const chunk = Math.max(16, Math.floor(CHUNK / n));
  const total = mask.reduce((a, b) => a + b, 0);
  let [done, shown, kept] = [0, 0, performance.now()];
  for (const [level, all] of passes(mask, width).entries()) {
    const places = all.filter((at) => !normals[3 * at] && !normals[3 * at + 1] && !normals[3 * at + 2]);
    done += all.length - places.length;
    for (let start = 0; start < places.length; start += chunk) {
      const part = places.slice(start, start + chunk);
      const values = await decodePart(decoder, encoded, images, part, n, width, size);
      part.forEach((place, i) => normals.set(values.subarray(i * 3, i * 3 + 3), place * 3));
      done += part.length;
      const now = performance.now();
      if (now - shown > 500) {
        shown = now;
        postMessage({ done, total });
      }
      if (now - kept > KEEP_EVERY) {
        kept = now;
        postMessage({ partial: normals });
      }
    }
    if (level < 2 && all.length) postMessage({ normals, step: level ? 2 : 4 });
  }
  const seconds = (performance.now() - began) / 1000;
  postMessage({ normals, step: 1, seconds, threads: decoder.threads });
}

onmessage = async ({ data }) => {
  try {
    await (data.kind === "mask" ? findMask(data) : estimate(data));
  } catch (error) {
    for (const part of Object.keys(sessions)) delete sessions[part];
    postMessage({ error: String(error?.message ?? error) });
  }
};
