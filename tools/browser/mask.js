// Where the object is: the network's saliency, its outline laid anew, and a brush.
// The rules are those of unips_jax/capture/salient.py, but that holes stay as they are.
const INPUT = 320;
const MEAN = [0.485, 0.456, 0.406];
const DEVIATION = [0.229, 0.224, 0.225];
const RADIUS = 0.012; // of the longer side
const SMOOTH = 5e-4;
const LEAST = 0.03; // of the picture
const PART = 0.02; // of the largest part
const [SHINE_SAMPLES, SHINE_DARK, SHINE_MEAN, SHINE_MEDIAN] = [60000, 0.1, 0.27, 0.05];
const STEADY = 0.86; // overlap of the masks at 30 and 70 % of saliency

// The square root of the mean photograph, 1 at its 99.5th percentile: [h, w, 3].
export function meanPicture(images, n, size) {
  const mean = new Float32Array(size * 3);
  for (let k = 0; k < n; k++) {
    for (let i = 0; i < size * 3; i++) mean[i] += images[k * size * 3 + i] / n;
  }
  const sorted = mean.slice().sort();
  const top = sorted[Math.floor(0.995 * (sorted.length - 1))] || 1;
  return mean.map((value) => Math.sqrt(Math.min(Math.max(value / top, 0), 1)));
}

// Weights of a resize along one axis: means over areas, linear where it grows.
function taps(from, to) {
  const scale = from / to;
  return Array.from({ length: to }, (_, i) => {
    const found = [];
    if (scale > 1) {
      const [start, end] = [i * scale, (i + 1) * scale];
      for (let j = Math.floor(start); j < Math.min(Math.ceil(end - 1e-9), from); j++) {
        found.push([j, (Math.min(end, j + 1) - Math.max(start, j)) / scale]);
      }
      return found;
    }
    const at = Math.min(Math.max((i + 0.5) * scale - 0.5, 0), from - 1);
    const [low, share] = [Math.floor(at), at - Math.floor(at)];
    return share ? [[low, 1 - share], [low + 1, share]] : [[low, 1]];
  });
}

export function resize(values, w, h, toW, toH, channels = 1) {
  const wide = new Float32Array(toW * h * channels);
  const across = taps(w, toW);
  for (let y = 0; y < h; y++) {
    across.forEach((found, x) => {
      for (const [j, weight] of found) {
        for (let c = 0; c < channels; c++) {
          wide[(y * toW + x) * channels + c] += weight * values[(y * w + j) * channels + c];
        }
      }
    });
  }
  const out = new Float32Array(toW * toH * channels);
  const row = toW * channels;
  taps(h, toH).forEach((found, y) => {
    for (const [j, weight] of found) {
      for (let x = 0; x < row; x++) out[y * row + x] += weight * wide[j * row + x];
    }
  });
  return out;
}

// What the network is given: [1, 3, 320, 320], and its mirror image.
export function networkInputs(picture, w, h) {
  const small = resize(picture, w, h, INPUT, INPUT, 3);
  const top = small.reduce((a, b) => Math.max(a, b), 1e-6);
  const area = INPUT * INPUT;
  const [seen, mirrored] = [new Float32Array(3 * area), new Float32Array(3 * area)];
  for (let i = 0; i < area; i++) {
    const back = i - (i % INPUT) + (INPUT - 1 - (i % INPUT));
    for (let c = 0; c < 3; c++) {
      const value = (small[i * 3 + c] / top - MEAN[c]) / DEVIATION[c];
      seen[c * area + i] = value;
      mirrored[c * area + back] = value;
    }
  }
  return [seen, mirrored];
}

// The mask [h, w] from the network's two answers; null if nothing stands out.
export function maskFrom(seen, mirrored, picture, w, h) {
  const area = INPUT * INPUT;
  const salient = new Float32Array(area);
  let [low, half, high, border] = [0, 0, 0, 0];
  for (let i = 0; i < area; i++) {
    const x = i % INPUT;
    const value = (seen[i] + mirrored[i - x + INPUT - 1 - x]) / 2;
    salient[i] = value;
    low += value > 0.3;
    half += value > 0.5;
    high += value > 0.7;
    const atBorder = x === 0 || x === INPUT - 1 || i < INPUT || i >= area - INPUT;
    border += atBorder && value > 0.5;
  }
  if (half < LEAST * area || border > 2 * INPUT || high < STEADY * low) return null;
  const filtered = guided(picture, resize(salient, INPUT, INPUT, w, h), w, h);
  return largeParts(filtered.map((value) => (value > 0.5 ? 1 : 0)), w, h);
}

// Whether only highlights in the dark were found; the rule of unips_jax/capture/shine.py.
// `images` [n, size, 3] are linear, `mask` [size].
export function isOnlyShine(images, n, mask) {
  const size = mask.length;
  const value = (k, i) => Math.max(...images.subarray(3 * (k * size + i), 3 * (k * size + i) + 3));
  const middle = (values, share = 0.5) => {
    const sorted = Float32Array.from(values).sort();
    const at = share * (sorted.length - 1);
    return (sorted[Math.floor(at)] + sorted[Math.ceil(at)]) / 2;
  };
  const [means, medians, tops, behind] = [[], [], [], []];
  const step = Math.max(1, Math.floor(size / SHINE_SAMPLES));
  for (let i = 0; i < size; i += step) {
    const seen = Array.from({ length: n }, (_, k) => value(k, i));
    const top = Math.max(...seen, 1e-12);
    if (!mask[i]) behind.push(top);
    else {
      tops.push(top);
      means.push(seen.reduce((a, b) => a + b) / n / top);
      medians.push(middle(seen) / top);
    }
  }
  if (n < 4 || !tops.length || !behind.length) return false;
  if (middle(behind) > SHINE_DARK * middle(tops, 0.99)) return false;
  return middle(means) < SHINE_MEAN && middle(medians) < SHINE_MEDIAN;
}

// Means over squares, by running sums; beyond the border the border's values count.
function boxMean(values, w, h, r) {
  const pass = (from, count, length, step, stride) => {
    const to = new Float32Array(from.length);
    for (let line = 0; line < count; line++) {
      const start = line * stride;
      const at = (i) => from[start + Math.min(Math.max(i, 0), length - 1) * step];
      let sum = 0;
      for (let i = -r; i <= r; i++) sum += at(i);
      for (let i = 0; i < length; i++) {
        to[start + i * step] = sum / (2 * r + 1);
        sum += at(i + r + 1) - at(i - r);
      }
    }
    return to;
  };
  return pass(pass(values, h, w, 1, w), w, h, w, 1);
}

// The guided filter (He et al., 2013): values as a local linear function of colours.
function guided(picture, values, w, h) {
  const size = w * h;
  const r = Math.max(2, Math.round(RADIUS * Math.max(w, h)));
  const mean = (array) => boxMean(array, w, h, r);
  const colours = [0, 1, 2].map((c) => Float32Array.from({ length: size }, (_, i) => picture[i * 3 + c]));
  const times = (a, b) => a.map((value, i) => value * b[i]);
  const centre = colours.map(mean);
  const level = mean(values);
  const shared = colours.map((colour, c) =>
    mean(times(colour, values)).map((value, i) => value - centre[c][i] * level[i]));
  const spread = {};
  for (let a = 0; a < 3; a++) {
    for (let b = a; b < 3; b++) {
      const products = mean(times(colours[a], colours[b]));
      spread[`${a}${b}`] = products.map((value, i) =>
        value - centre[a][i] * centre[b][i] + (a === b ? SMOOTH : 0));
    }
  }
  const slopes = colours.map(() => new Float32Array(size));
  const offset = new Float32Array(size);
  for (let i = 0; i < size; i++) {
    const [p, q, s, t, u, v] = ["00", "01", "02", "11", "12", "22"].map((k) => spread[k][i]);
    // The inverse of a symmetric matrix, by cofactors.
    const rows = [
      [t * v - u * u, s * u - q * v, q * u - s * t],
      [s * u - q * v, p * v - s * s, q * s - p * u],
      [q * u - s * t, q * s - p * u, p * t - q * q],
    ];
    const determinant = p * rows[0][0] + q * rows[0][1] + s * rows[0][2];
    offset[i] = level[i];
    rows.forEach((row, c) => {
      const slope = (row[0] * shared[0][i] + row[1] * shared[1][i] + row[2] * shared[2][i]) / determinant;
      slopes[c][i] = slope;
      offset[i] -= slope * centre[c][i];
    });
  }
  const out = mean(offset);
  slopes.map(mean).forEach((slope, c) => slope.forEach((value, i) => {
    out[i] += value * colours[c][i];
  }));
  return out;
}

// Drops what is far smaller than the largest connected part.
export function largeParts(mask, w, h) {
  const label = new Int32Array(w * h);
  const areas = [0];
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i] || label[i]) continue;
    const part = areas.push(0) - 1;
    const open = [i];
    label[i] = part;
    while (open.length) {
      const at = open.pop();
      areas[part]++;
      const x = at % w;
      for (const near of [x ? at - 1 : -1, x < w - 1 ? at + 1 : -1, at - w, at + w]) {
        if (near < 0 || near >= mask.length || !mask[near] || label[near]) continue;
        label[near] = part;
        open.push(near);
      }
    }
  }
  const least = PART * areas.reduce((a, b) => Math.max(a, b), 0);
  return Uint8Array.from(label, (part) => (part && areas[part] >= least ? 1 : 0));
}

// Paints a stroke from one place to another: discs of a radius, of value 0 or 1.
export function paint(mask, w, h, [x0, y0], [x1, y1], radius, value) {
  const steps = Math.max(1, Math.ceil(Math.hypot(x1 - x0, y1 - y0) / (radius / 2)));
  for (let k = 0; k <= steps; k++) {
    const [cx, cy] = [x0 + (k / steps) * (x1 - x0), y0 + (k / steps) * (y1 - y0)];
    const [top, bottom] = [Math.max(0, Math.floor(cy - radius)), Math.min(h - 1, Math.ceil(cy + radius))];
    for (let y = top; y <= bottom; y++) {
      const half = Math.sqrt(Math.max(radius * radius - (y - cy) ** 2, 0));
      const [left, right] = [Math.max(0, Math.ceil(cx - half)), Math.min(w - 1, Math.floor(cx + half))];
      if (left <= right) mask.fill(value, y * w + left, y * w + right + 1);
    }
  }
}
