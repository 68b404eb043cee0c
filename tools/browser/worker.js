// Runs the networks next to the page: photographs in, a mask or normals out.
import { maskFrom, networkInputs } from "./mask.js";
import { blend, gridOf, stepOf } from "./spread.js";

// Members of sets (a pixel in one photograph) decoded at a time.
const CHUNK = 2048;
const KEEP_EVERY = 4000; // milliseconds between normals sent to be kept

let started;
const sessions = {};
const decoders = [];

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

async function findMask({ picture, width, height }, answer) {
  answer({ stage: "mask" });
  const { ort, run } = await session("mask");
  const answers = [];
  for (const values of networkInputs(picture, width, height)) {
    const input = new ort.Tensor("float32", values, [1, 3, 320, 320]);
    const found = await run.run({ [run.inputNames[0]]: input });
    answers.push(found[run.outputNames[0]].data);
  }
  answer({ found: maskFrom(...answers, picture, width, height) });
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

// Decoders on all cores, which know the object's views.
async function startDecoders(encoded) {
  // Phones have more cores than memory; browsers that don't say how much get four.
  const count = Math.min(navigator.hardwareConcurrency || 2, navigator.deviceMemory || 4, 8);
  const { contexts, views, gains } = encoded;
  const [number, ...dims] = contexts.dims;
  const size = contexts.data.length / number;
  const known = Array.from({ length: number }, (_, v) => ({
    contexts: contexts.data.slice(v * size, (v + 1) * size),
    dims: [1, ...dims],
    place: views.data.slice(4 * v, 4 * v + 4),
  }));
  while (decoders.length < Math.max(count, 1)) decoders.push(new Decoder());
  await Promise.all(decoders.map((one) => one.ask({ views: known, gains: gains.data })));
}

class Decoder {
  constructor() {
    this.worker = new Worker(new URL("./decoder.js", self.location), { type: "module" });
    this.waiting = [];
    this.worker.onmessage = ({ data }) => {
      const { resolve, reject } = this.waiting.shift();
      if (data.error) reject(new Error(data.error));
      else resolve(data);
    };
    this.worker.onerror = (event) => {
      event.preventDefault?.();
      for (const { reject } of this.waiting.splice(0)) reject(new Error(event.message));
    };
  }

  ask(message, moved = []) {
    return new Promise((resolve, reject) => {
      this.waiting.push({ resolve, reject });
      this.worker.postMessage(message, moved);
    });
  }
}

// Decodes places by one view, on all cores; `take(part, normals)` gets what is done.
async function decodeAll(places, view, { images, n, width, size }, take) {
  const chunk = Math.max(16, Math.floor(CHUNK / n));
  let next = 0;
  await Promise.all(decoders.map(async (decoder) => {
    while (next < places.length) {
      const part = places.slice(next, next + chunk);
      next += chunk;
      const pixels = new Float32Array(part.length * n * 3);
      part.forEach((place, i) => {
        for (let k = 0; k < n; k++) {
          const from = (k * size + place) * 3;
          pixels.set(images.subarray(from, from + 3), (i * n + k) * 3);
        }
      });
      const rows = Int32Array.from(part, (place) => Math.floor(place / width));
      const columns = Int32Array.from(part, (place) => place % width);
      const moved = [pixels.buffer, rows.buffer, columns.buffer];
      const { normals } = await decoder.ask({ view, pixels, rows, columns, n }, moved);
      take(part, normals);
    }
  }));
}

// `known` are normals of an earlier run that was cut off: 0 where there are none.
async function estimate({ images, mask, n, width, height, known }, answer) {
  answer({ stage: "loading" });
  const encoder = await session("encoder");
  answer({ stage: "encoding" });
  const began = performance.now();
  const encoded = await encoder.run.run({
    images: new encoder.ort.Tensor("float32", images, [n, height, width, 3]),
    mask: new encoder.ort.Tensor("bool", mask, [height, width]),
  });
  await startDecoders(encoded);
  const object = { images, n, width, size: width * height };
  const step = encoded.contexts.dims[0] > 1 ? stepOf(encoded.views.data[2]) : 0;
  const normals = known ?? new Float32Array(object.size * 3);
  const grid = step > 1 ? gridOf(mask, width, step) : [];
  const inside = mask.reduce((a, b) => a + b, 0);
  const total = (step === 1 ? 2 : 1) * inside + grid.length;
  let [done, shown, kept] = [0, 0, performance.now()];
  const count = (more) => {
    done += more;
    const now = performance.now();
    if (now - shown > 500) {
      shown = now;
      answer({ done, total });
    }
    if (now - kept > KEEP_EVERY) {
      kept = now;
      answer({ partial: normals });
    }
  };
  for (const [level, all] of passes(mask, width).entries()) {
    const places = all.filter((at) => !normals[3 * at] && !normals[3 * at + 1] && !normals[3 * at + 2]);
    done += (step === 1 ? 2 : 1) * (all.length - places.length);
    const first = new Map(); // by the first view, where the second follows
    const take = (part, found) => {
      if (step === 1) part.forEach((place, i) => first.set(place, found.subarray(3 * i, 3 * i + 3)));
      else part.forEach((place, i) => normals.set(found.subarray(3 * i, 3 * i + 3), 3 * place));
      count(part.length);
    };
    await decodeAll(places, 0, object, take);
    if (step === 1) {
      await decodeAll(places, 1, object, (part, found) => {
        part.forEach((place, i) => {
          const mean = first.get(place).map((value, c) => value + found[3 * i + c]);
          const length = Math.hypot(...mean) || 1;
          normals.set(mean.map((value) => value / length), 3 * place);
        });
        count(part.length);
      });
    }
    if (level < 2 && all.length) answer({ normals, step: level ? 2 : 4 });
  }
  let mean = normals;
  if (grid.length) {
    const order = new Map(grid.map((place, i) => [place, i]));
    const second = new Float32Array(3 * grid.length);
    await decodeAll(grid, 1, object, (part, found) => {
      part.forEach((place, i) => second.set(found.subarray(3 * i, 3 * i + 3), 3 * order.get(place)));
      count(part.length);
    });
    mean = blend(normals, mask, width, height, grid, second, step);
  }
  const seconds = (performance.now() - began) / 1000;
  answer({ normals: mean, step: 1, seconds, threads: decoders.length });
}

onmessage = async ({ data }) => {
  const answer = (values) => postMessage({ ...values, id: data.id });
  try {
    await (data.kind === "mask" ? findMask(data, answer) : estimate(data, answer));
  } catch (error) {
    started = undefined; // a file that could not be fetched is asked for again
    for (const part of Object.keys(sessions)) delete sessions[part];
    if (data.kind !== "mask") for (const { worker } of decoders.splice(0)) worker.terminate();
    answer({ error: String(error?.message ?? error) });
  }
};
