// Detail: what normals differ by from those around them, as an unsharp mask has it.

/** Means of the normals around each pixel, over the surface alone, as a texture. */
function meansAround(normalBytes) {
  const { width, height } = data;
  const radius = Math.max(2, Math.round(Math.max(width, height) / 170));
  let sums = new Float32Array(4 * width * height); // of x, y, z, and their number
  for (let row = 0; row < height; row++) {
    for (let column = 0; column < width; column++) {
      const n = normalAt(normalBytes, column, row);
      if (n) sums.set([...n, 1], 4 * (row * width + column));
    }
  }
  // Three boxes are nearly a Gaussian.
  for (let pass = 0; pass < 3; pass++) {
    sums = boxSums(sums, height, width, 4 * width, 4, radius);
    sums = boxSums(sums, width, height, 4, 4 * width, radius);
  }
  const halves = new Uint16Array(sums.length);
  for (let at = 0; at < sums.length; at += 4) {
    const count = sums[at + 3] || 1;
    for (let axis = 0; axis < 3; axis++) {
      halves[at + axis] = THREE.DataUtils.toHalfFloat(sums[at + axis] / count);
    }
  }
  const texture = new THREE.DataTexture(halves, width, height, THREE.RGBAFormat, THREE.HalfFloatType);
  texture.minFilter = texture.magFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

/** Running means of 2 radius + 1 along lines of four-valued pixels: `step` apart in a
 * line of `length`, lines `line` apart. */
function boxSums(values, lines, length, line, step, radius) {
  const result = new Float32Array(values.length);
  const share = 1 / (2 * radius + 1);
  for (let l = 0; l < lines; l++) {
    for (let axis = 0; axis < 4; axis++) {
      const first = l * line + axis;
      let sum = 0;
      for (let i = 0; i < Math.min(radius, length); i++) sum += values[first + i * step];
      for (let i = 0; i < length; i++) {
        if (i + radius < length) sum += values[first + (i + radius) * step];
        result[first + i * step] = sum * share;
        if (i >= radius) sum -= values[first + (i - radius) * step];
      }
    }
  }
  return result;
}
