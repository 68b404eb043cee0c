// The surface of the depth, as triangles; see unips_jax/surface/mesh.py.

const MOST_VERTICES = 260000;
const CUT = 20; // pixels of depth that a triangle of neighbours may range over

/** Points in the normals' frame (x right, y up, z towards the viewer), centred. */
function surfaceGeometry(depthBytes) {
  const { width, height } = data;
  let inside = 0;
  for (let at = 0; at < width * height; at++) {
    inside += depthBytes[4 * at] + depthBytes[4 * at + 1] > 0;
  }
  const step = Math.max(1, Math.ceil(Math.sqrt(inside / MOST_VERTICES)));
  const columns = Math.floor((width - 1) / step) + 1;
  const rows = Math.floor((height - 1) / step) + 1;
  const depths = new Float32Array(columns * rows);
  for (let j = 0; j < rows; j++) {
    for (let i = 0; i < columns; i++) {
      depths[j * columns + i] = depthAt(depthBytes, i * step, j * step);
    }
  }
  const position = new Float32Array(3 * depths.length);
  const uv = new Float32Array(2 * depths.length);
  for (let k = 0; k < depths.length; k++) {
    const column = (k % columns) * step;
    const row = Math.floor(k / columns) * step;
    const reach = pixelSize(depths[k]);
    position[3 * k] = (column - data.camera.column) * reach || 0;
    position[3 * k + 1] = -(row - data.camera.row) * reach || 0;
    position[3 * k + 2] = -depths[k] || 0;
    uv[2 * k] = (column + 0.5) / width;
    uv[2 * k + 1] = (row + 0.5) / height;
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
  geometry.setIndex(new THREE.BufferAttribute(triangles(depths, columns, rows, step), 1));
  centre(geometry, depths);
  geometry.userData.limit = turnLimit(position, depths, columns, rows);
  return geometry;
}

/** Two triangles between four neighbours, unless they bridge a jump; seen from in front
 * they are counter-clockwise. */
function triangles(depths, columns, rows, step) {
  const found = [];
  const add = (a, b, c) => {
    const low = Math.min(depths[a], depths[b], depths[c]);
    const high = Math.max(depths[a], depths[b], depths[c]);
    if (high - low <= CUT * step * pixelSize(low)) found.push(a, b, c); // not with NaN
  };
  for (let j = 0; j + 1 < rows; j++) {
    for (let i = 0; i + 1 < columns; i++) {
      const a = j * columns + i;
      const [b, c, d] = [a + 1, a + columns, a + columns + 1];
      add(a, c, d);
      add(a, d, b);
    }
  }
  return Uint32Array.from(found);
}

/** Moves the middle of the surface to the origin, and tells the radius around it. */
function centre(geometry, depths) {
  const position = geometry.getAttribute("position").array;
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < depths.length; k++) {
    if (Number.isNaN(depths[k])) continue;
    for (let axis = 0; axis < 3; axis++) {
      low[axis] = Math.min(low[axis], position[3 * k + axis]);
      high[axis] = Math.max(high[axis], position[3 * k + axis]);
    }
  }
  const middle = low.map((value, axis) => (value + high[axis]) / 2);
  for (let k = 0; k < depths.length; k++) {
    for (let axis = 0; axis < 3; axis++) position[3 * k + axis] -= middle[axis];
  }
  let squared = 0;
  for (let k = 0; k < depths.length; k++) {
    if (Number.isNaN(depths[k])) continue;
    const point = position.subarray(3 * k, 3 * k + 3);
    squared = Math.max(squared, point[0] ** 2 + point[1] ** 2 + point[2] ** 2);
  }
  geometry.userData = { radius: Math.sqrt(squared) || 1, middle };
}

const [LEAST_TURN, MOST_TURN] = [35, 60].map((degrees) => (degrees * Math.PI) / 180);

/** How far the surface may turn from the viewer, as an angle: not so far that it is seen
 * from behind. Where the surface sinks towards its edge at a slope, as a bowl does within
 * its rim, its back comes into sight beyond 90 degrees less the slope. The steepest 5% of
 * the edge may show theirs. Beyond 60 degrees a view is more guessed than seen. */
function turnLimit(position, depths, columns, rows) {
  const height = (k) => position[3 * k + 2];
  const angles = [];
  for (let j = 1; j + 1 < rows; j++) {
    for (let i = 1; i + 1 < columns; i++) {
      const k = j * columns + i;
      if (Number.isNaN(depths[k])) continue;
      for (const step of [1, -1, columns, -columns]) {
        if (!Number.isNaN(depths[k + step]) || Number.isNaN(depths[k - step])) continue;
        const across = Math.hypot(
          position[3 * k] - position[3 * (k - step)],
          position[3 * k + 1] - position[3 * (k - step) + 1]
        );
        angles.push(Math.atan2(across, Math.max(height(k) - height(k - step), 0)));
      }
    }
  }
  angles.sort((a, b) => a - b);
  const found = angles[Math.floor(0.05 * angles.length)] ?? MOST_TURN;
  return Math.min(Math.max(found, LEAST_TURN), MOST_TURN);
}
