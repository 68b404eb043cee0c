// The second, mirrored view is decoded at few pixels: what it changes is smooth, and is
// spread to those around. As `unips estimate --fast` does (unips_jax/estimation).

// Every how many rows and columns; 1: at all pixels, where few would not be fewer.
export function stepOf(side) {
  const step = Math.min(4, Math.floor(side / 96));
  return step < 2 ? 1 : step;
}

// The masked pixels of the grid.
export function gridOf(mask, width, step) {
  const start = Math.floor(step / 2);
  const found = [];
  for (let i = 0; i < mask.length; i++) {
    const [x, y] = [i % width, Math.floor(i / width)];
    const at = (place) => place >= start && (place - start) % step === 0;
    if (mask[i] && at(x) && at(y)) found.push(i);
  }
  return found;
}

// The mean over both views, from the first's normals and the second's at `places`.
export function blend(normals, mask, width, height, places, second, step) {
  const change = new Float32Array(normals.length);
  const weight = new Float32Array(mask.length);
  places.forEach((at, i) => {
    weight[at] = 1;
    for (let c = 0; c < 3; c++) change[3 * at + c] = second[3 * i + c] - normals[3 * at + c];
  });
  const spread = smooth(change, width, height, 3, 0.6 * step);
  const share = smooth(weight, width, height, 1, 0.6 * step);
  const out = new Float32Array(normals.length);
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    const total = [0, 1, 2].map((c) =>
      2 * normals[3 * i + c] + (share[i] > 1e-4 ? spread[3 * i + c] / share[i] : 0));
    const length = Math.hypot(...total) || 1;
    for (let c = 0; c < 3; c++) out[3 * i + c] = total[c] / length;
  }
  return out;
}

// A Gaussian blur that mirrors what is beyond the border, as SciPy's.
function smooth(values, width, height, channels, sigma) {
  const radius = Math.floor(4 * sigma + 0.5);
  const taps = Float32Array.from({ length: 2 * radius + 1 }, (_, i) =>
    Math.exp(-((i - radius) ** 2) / (2 * sigma ** 2)));
  const sum = taps.reduce((a, b) => a + b);
  const pass = (from, length, count, step, stride) => {
    const inside = (i) => {
      const at = ((i % (2 * length)) + 2 * length) % (2 * length);
      return at < length ? at : 2 * length - 1 - at;
    };
    const to = new Float32Array(from.length);
    for (let i = 0; i < length; i++) {
      for (let k = -radius; k <= radius; k++) {
        const [tap, other] = [taps[k + radius] / sum, inside(i + k) * step];
        for (let line = 0; line < count; line++) {
          const start = line * stride;
          for (let c = 0; c < channels; c++) {
            to[(start + i * step) * channels + c] += tap * from[(start + other) * channels + c];
          }
        }
      }
    }
    return to;
  };
  return pass(pass(values, width, height, 1, width), height, width, width, 1);
}
