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
    this.split = 1; // share of the width that shows the left layer
    this.mode = "picture";
    this.onDrawn = () => {};
    this.onTooSlow = () => {};
    this.depthBytes = depthBytes;
    this.flat = new THREE.Mesh(flatGeometry(), this.left);
    this.scene = new THREE.Scene();
    this.scene.add(this.flat);
    this.flatCamera = new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1);
    this.camera = new THREE.PerspectiveCamera(30, 1, 0.01, 100);
    this.solid = null;
    this.controls = null;
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
    this.controls.addEventListener("change", () => this.changed());
    this.controls.autoRotateSpeed = 3;
    this.showWhole();
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
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), 40);
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

  /** Turns the surface by angles in degrees. */
  turnBy(around, over) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const place = new THREE.Spherical().setFromVector3(offset);
    place.theta -= (around * Math.PI) / 180;
    place.phi -= (over * Math.PI) / 180;
    place.makeSafe();
    this.camera.position.setFromSpherical(place).add(this.controls.target);
    this.controls.update();
    this.changed();
  }

  changed() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
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
      if (this.controls.autoRotate) this.controls.update();
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
    for (const [material, from, to] of [[this.left, 0, edge], [this.right, edge, width]]) {
      if (to <= from) continue;
      shown.material = material;
      this.renderer.setScissor(from, 0, to - from, height);
      this.renderer.render(this.scene, camera);
    }
    this.onDrawn();
    if (this.mode === "surface" && this.controls.autoRotate) this.goOnTurning();
  }
}

const SLOW_MS = 300; // a frame
const SLOW_FRAMES = 3;

/** The picture's rectangle: a pixel is 1 x 1, the first row on top, at y = 0. */
function flatGeometry() {
  const { width, height } = data;
  const corners = [[0, 0], [width, 0], [0, height], [width, height]];
  const geometry = new THREE.BufferGeometry();
  const position = corners.flatMap(([x, y]) => [x, -y, 0]);
  const uv = corners.flatMap(([x, y]) => [x / width, y / height]);
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(position), 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uv), 2));
  geometry.setIndex([0, 2, 3, 0, 3, 1]);
  return geometry;
}
