// What is drawn: the flat picture or the surface, one layer on each side of a line.

/** Draws into `canvas` when asked by `changed()`, at most once per frame. */
class Stage {
  constructor(canvas, textures, depthBytes) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.autoClear = false;
    this.renderer.setClearColor(0x121212);
    this.shared = sharedUniforms(textures);
    this.left = layerMaterial(this.shared, textures.normals);
    this.right = layerMaterial(this.shared, textures.normals);
    this.layers = { left: { kind: "lit" }, right: { kind: "lit" } };
    this.split = 1; // share of the width that shows the left layer
    this.mode = "picture";
    this.turning = false; // by itself
    this.onDrawn = () => {};
    this.onTooSlow = () => {};
    this.depthBytes = depthBytes;
    this.flat = new THREE.Mesh(rectangle([0, 1], [0, 1]), this.left);
    this.scene = new THREE.Scene();
    this.scene.add(this.flat);
    this.flatCamera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1);
    this.camera = new THREE.PerspectiveCamera(30, 1, 0.01, 100);
    this.solid = null;
    this.controls = null;
    this.tiles = data.tiles ? new Tiles(this) : null;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.showWhole();
    this.resize();
  }

  /** "picture", or "surface" if there is a depth. */
  setMode(mode) {
    this.mode = mode;
    if (mode === "surface" && !this.solid) this.makeSolid();
    this.flat.visible = mode === "picture";
    if (this.solid) this.solid.visible = mode === "surface";
    if (this.controls) this.controls.enabled = mode === "surface";
    this.changed();
  }

  makeSolid() {
    this.solid = new THREE.Mesh(surfaceGeometry(this.depthBytes), this.left);
    this.solid.frustumCulled = false;
    this.scene.add(this.solid);
    this.controls = new THREE.OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => {
      this.holdBack();
      this.changed();
    });
    this.showWhole();
  }

  /** Turns the camera back to where the surface is seen from in front. */
  holdBack() {
    const { position } = this.camera;
    const { target } = this.controls;
    const offset = position.clone().sub(target);
    const length = offset.length();
    const { limit } = this.solid.geometry.userData;
    if (Math.acos(Math.min(Math.max(offset.z / length, -1), 1)) <= limit + 1e-4) return;
    const aside = Math.hypot(offset.x, offset.y) || 1;
    const share = (length * Math.sin(limit)) / aside;
    offset.set(offset.x * share, offset.y * share, length * Math.cos(limit));
    position.copy(target).add(offset);
    this.camera.lookAt(target);
  }

  /** Where the camera is around the surface: angles in radians to the right and up. */
  turnTo(around, over) {
    const length = this.camera.position.distanceTo(this.controls.target);
    const place = new THREE.Spherical(length, Math.PI / 2 - over, around);
    this.camera.position.setFromSpherical(place).add(this.controls.target);
    this.controls.update();
    this.holdBack();
    this.changed();
  }

  /** A place of the picture on the surface, as a place of the stage. */
  solidAt(column, row) {
    const space = spaceAt(this.depthBytes, [column, row]);
    if (Number.isNaN(space[2])) return null;
    const { middle } = this.solid.geometry.userData;
    const point = new THREE.Vector3(...space.map((value, axis) => value - middle[axis]));
    point.project(this.camera);
    return [((point.x + 1) / 2) * this.size[0], ((1 - point.y) / 2) * this.size[1]];
  }

  /** The depth's unit per pixel of the screen; of the surface, at its middle. */
  unitPerScreenPixel() {
    if (this.mode === "picture") return pixelSize() / this.magnification;
    const distance = this.camera.position.distanceTo(this.controls.target);
    const angle = (this.camera.fov * Math.PI) / 180;
    return (2 * distance * Math.tan(angle / 2)) / this.size[1];
  }

  /** Shows all of the picture, and the surface from in front. */
  showWhole() {
    this.center = [data.width / 2, data.height / 2];
    this.zoom = 1;
    if (this.solid) {
      const radius = this.solid.geometry.userData.radius;
      const narrow = Math.min(1, this.camera.aspect);
      const distance = (1.05 * radius) / Math.sin((15 * Math.PI) / 180) / narrow;
      this.camera.near = distance / 100;
      this.camera.far = distance * 20;
      this.camera.position.set(0, 0, distance);
      this.camera.up.set(0, 1, 0);
      this.controls.target.set(0, 0, 0);
      this.controls.update();
    }
    this.changed();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.size = [width, height];
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.changed();
  }

  /** Screen pixels per pixel of the picture. */
  get magnification() {
    const [width, height] = this.size;
    return this.zoom * 0.96 * Math.min(width / data.width, height / data.height);
  }

  /** The picture's place under a place of the stage: column and row. */
  pixelAt(x, y) {
    const scale = this.magnification;
    return [
      this.center[0] + (x - this.size[0] / 2) / scale,
      this.center[1] + (y - this.size[1] / 2) / scale,
    ];
  }

  /** The opposite of `pixelAt`. */
  screenAt(column, row) {
    const scale = this.magnification;
    return [
      (column - this.center[0]) * scale + this.size[0] / 2,
      (row - this.center[1]) * scale + this.size[1] / 2,
    ];
  }

  /** Magnifies, keeping what is under a place of the stage there. */
  zoomBy(factor, x = this.size[0] / 2, y = this.size[1] / 2) {
    if (this.mode === "surface") {
      const offset = this.camera.position.clone().sub(this.controls.target);
      this.camera.position.copy(this.controls.target).addScaledVector(offset, 1 / factor);
      this.controls.update();
      return this.changed();
    }
    const before = this.pixelAt(x, y);
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), 40 * Math.max(1, data.scale / 4));
    const after = this.pixelAt(x, y);
    this.moveBy(before[0] - after[0], before[1] - after[1]);
  }

  /** Moves the view over the picture, by pixels of the picture, not beyond its edges. */
  moveBy(columns, rows) {
    [columns, rows].forEach((step, axis) => {
      const length = axis ? data.height : data.width;
      const half = Math.min(length / 2, this.size[axis] / 2 / this.magnification);
      const least = half;
      this.center[axis] = Math.min(Math.max(this.center[axis] + step, least), length - least);
    });
    this.changed();
  }

  /** Moves the view as far as it takes to see a place of the picture. */
  reveal(column, row) {
    const steps = [column, row].map((value, axis) => {
      const half = Math.max(0, this.size[axis] / 2 / this.magnification - 1);
      const away = value + 0.5 - this.center[axis];
      return away - Math.min(Math.max(away, -half), half);
    });
    this.moveBy(...steps);
  }

  /** Turns the surface by angles in degrees. */
  turnBy(around, over) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const { theta, phi } = new THREE.Spherical().setFromVector3(offset);
    const [right, up] = [around, over].map((angle) => (angle * Math.PI) / 180);
    this.turnTo(theta - right, Math.PI / 2 - phi + up);
  }

  changed() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  /** Swings a step on, to both sides of the front as far as the surface allows. */
  swing() {
    const now = performance.now();
    this.phase += Math.min(now - (this.swungAt ?? now), 100) / 1600;
    this.swungAt = now;
    const reach = 0.8 * this.solid.geometry.userData.limit;
    this.turnTo(reach * Math.sin(this.phase), 0.25 * reach * Math.sin(2 * this.phase));
  }

  /** Turns by itself, or stops. */
  setTurning(on) {
    this.turning = on;
    this.drawnAt = this.swungAt = undefined; // the time until now was no frame
    const offset = this.camera.position.clone().sub(this.controls.target);
    const { limit } = this.solid.geometry.userData;
    const share = new THREE.Spherical().setFromVector3(offset).theta / (0.8 * limit);
    this.phase = Math.asin(Math.min(Math.max(share, -1), 1)); // from where it is
    this.changed();
  }

  /** Asks for the next frame, unless they take so long that nothing else gets done. */
  goOnTurning() {
    const now = performance.now();
    const late = now - (this.drawnAt ?? now) > SLOW_MS;
    this.drawnAt = now;
    this.slow = late ? (this.slow ?? 0) + 1 : 0;
    if (this.slow < SLOW_FRAMES) return this.changed();
    this.slow = 0;
    this.onTooSlow();
  }

  draw() {
    if (!this.size) return;
    const [width, height] = this.size;
    const camera = this.mode === "surface" ? this.camera : this.flatCamera;
    if (this.mode === "surface") {
      if (this.turning) this.swing();
      this.camera.updateProjectionMatrix();
      this.camera.updateMatrixWorld();
      this.shared.turn.value.setFromMatrix4(this.camera.matrixWorldInverse);
    } else {
      const scale = this.magnification;
      const [column, row] = this.center;
      camera.left = column - width / 2 / scale;
      camera.right = column + width / 2 / scale;
      camera.top = -row + height / 2 / scale;
      camera.bottom = -row - height / 2 / scale;
      camera.updateProjectionMatrix();
      this.shared.turn.value.identity();
    }
    const shown = this.mode === "surface" ? this.solid : this.flat;
    const edge = Math.round(width * this.split);
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(0, 0, width, height);
    this.renderer.clear();
    for (const [side, from, to] of [["left", 0, edge], ["right", edge, width]]) {
      if (to <= from) continue;
      shown.material = this[side];
      const tiles = this.mode === "picture" && this.tiles?.shown(side, this.layers[side]);
      for (const [mesh, material] of tiles || []) Object.assign(mesh, { visible: true, material });
      this.renderer.setScissor(from, 0, to - from, height);
      this.renderer.render(this.scene, camera);
      for (const [mesh] of tiles || []) mesh.visible = false;
    }
    this.onDrawn();
    if (this.mode === "surface" && this.turning) this.goOnTurning();
  }
}

const SLOW_MS = 300; // a frame
const SLOW_FRAMES = 3;

/** A part of the picture, by shares of its sides: a pixel is 1 x 1, the first row on
 * top, at y = 0. */
function rectangle([left, right], [top, bottom]) {
  const corners = [[left, top], [right, top], [left, bottom], [right, bottom]];
  const geometry = new THREE.BufferGeometry();
  const position = corners.flatMap(([x, y]) => [x * data.width, -y * data.height, 0]);
  const uv = corners.flat();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(position), 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uv), 2));
  geometry.setIndex([0, 2, 3, 0, 3, 1]);
  return geometry;
}
