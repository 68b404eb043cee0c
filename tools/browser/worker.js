// Runs the network beside the page: photographs in, normals out, a coarse grid first.
// Members of sets (a pixel in one photograph) decoded at a time: what stays in cache
// takes half the time of four times as many.
const CHUNK = 2048;

let sessions;

async function load(provider) {
  const threads = self.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency, 8) : 1;
  const name = provider === "webgpu" ? "webgpu" : "wasm";
  const ort = await import(`./vendor/onnxruntime-web/ort.${name}.bundle.min.mjs`);
  ort.env.wasm.numThreads = threads;
  ort.env.wasm.wasmPaths = new URL("./vendor/onnxruntime-web/", self.location).href;
  const options = { executionProviders: [provider] };
  const created = [];
  for (const part of ["encoder", "decoder"]) {
    postMessage({ stage: `loading the ${part}` });
    created.push(await ort.InferenceSession.create(`./network/${part}.onnx`, options));
  }
  return { ort, encoder: created[0], decoder: created[1], threads, provider };
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

async function decodePart(encoded, images, inside, n, width, size) {
  const { ort, decoder } = sessions;
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
  const { normals } = await decoder.run({
    ...encoded,
    pixels: new ort.Tensor("float32", pixels, [count, n, 3]),
    rows: new ort.Tensor("int32", rows, [count]),
    columns: new ort.Tensor("int32", columns, [count]),
  });
  return normals.data;
}

async function estimate({ images, mask, n, width, height, provider }) {
  if (sessions?.provider !== provider) sessions = await load(provider);
  const { ort, encoder, threads } = sessions;
  postMessage({ stage: "encoding the photographs", threads });
  const began = performance.now();
  const encoded = await encoder.run({
    images: new ort.Tensor("float32", images, [n, height, width, 3]),
    mask: new ort.Tensor("bool", mask, [height, width]),
  });
  const size = width * height;
  const normals = new Float32Array(size * 3);
  const chunk = Math.max(16, Math.floor(CHUNK / n));
  const total = mask.reduce((a, b) => a + b, 0);
  let done = 0;
  let shown = 0;
  for (const [level, places] of passes(mask, width).entries()) {
    for (let start = 0; start < places.length; start += chunk) {
      const part = places.slice(start, start + chunk);
      const values = await decodePart(encoded, images, part, n, width, size);
      part.forEach((place, i) => normals.set(values.subarray(i * 3, i * 3 + 3), place * 3));
      done += part.length;
      if (performance.now() - shown > 500) {
        shown = performance.now();
        postMessage({ done, total });
      }
    }
    if (level < 2 && places.length) postMessage({ normals, step: level ? 2 : 4 });
  }
  const seconds = (performance.now() - began) / 1000;
  postMessage({ normals, step: 1, seconds, threads });
}

onmessage = async ({ data }) => {
  try {
    await estimate(data);
  } catch (error) {
    sessions = undefined;
    postMessage({ error: String(error?.message ?? error) });
  }
};
