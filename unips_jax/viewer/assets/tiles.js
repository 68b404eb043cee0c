// Full resolution: tiles, scripts next to the page, fetched where the view needs them.

const MOST_TILES = 240; // kept, each 1 MB on the graphics card
const AT_ONCE = 6;

/** Draws tiles over the flat picture: as fine as the screen shows it. */
class Tiles {
  constructor(stage) {
    this.stage = stage;
    this.found = new Map(); // name -> texture; null: on its way; false: not there
    this.meshes = new Map(); // "level-row-column" -> mesh
    this.wanted = [];
    this.loading = new Map(); // name -> what its script calls
    globalThis.unipsTile = (name, address) => this.loading.get(name)?.(address);
  }

  /** What a layer of this kind reads of its tiles. */
  needs({ kind, id }) {
    if (kind === "picture") return { pictureMap: id };
    if (kind === "normals") return { normalMap: "normals" };
    if (kind !== "lit" && kind !== "environment") return null; // smooth enough
    return data.color ? { normalMap: "normals", colorMap: "color" } : { normalMap: "normals" };
  }

  /** Tiles to be drawn for a half, coarse ones first; asks for those that are missing. */
  shown(side, layer) {
    const needs = this.needs(layer);
    const finest = this.finest();
    if (!needs || finest === null) return [];
    const meshes = [];
    for (let level = data.tiles.levels.length - 1; level >= finest; level--) {
      for (const place of this.places(level)) {
        const mesh = this.meshes.get(place) ?? this.make(level, place);
        const material = mesh.userData[side];
        let ready = true;
        for (const [uniform, name] of Object.entries(needs)) {
          const texture = this.texture(`${name}-${place}`, level === finest);
          if (texture) material.uniforms[uniform].value = texture;
          else ready = false;
        }
        mesh.renderOrder = data.tiles.levels.length - level;
        if (ready) meshes.push([mesh, material]);
      }
    }
    return meshes;
  }

  /** The level whose pixels are the screen's, or finer; null: the picture is enough. */
  finest() {
    const magnified = this.stage.magnification * this.stage.renderer.getPixelRatio();
    if (magnified <= 1) return null;
    const level = Math.floor(Math.log2(Math.max(1, data.scale / magnified)));
    return Math.min(level, data.tiles.levels.length - 1);
  }

  /** Names of the tiles of a level that are in sight. */
  places(level) {
    const { size, levels } = data.tiles;
    const [first, last] = [[0, 0], this.stage.size].map((corner) => this.stage.pixelAt(...corner));
    const range = (axis, total, shown) => {
      const least = Math.max(0, Math.floor(((first[axis] / shown) * total) / size));
      const most = Math.min(Math.ceil(total / size) - 1, Math.floor(((last[axis] / shown) * total) / size));
      return Array.from({ length: Math.max(0, most - least + 1) }, (_, i) => least + i);
    };
    const columns = range(0, levels[level].width, data.width);
    const rows = range(1, levels[level].height, data.height);
    return rows.flatMap((row) => columns.map((column) => `${level}-${row}-${column}`));
  }

  make(level, place) {
    const { size, border, levels } = data.tiles;
    const [, row, column] = place.split("-").map(Number);
    const spans = [[column, levels[level].width], [row, levels[level].height]].map(([index, total]) => ({
      own: [index * size, Math.min((index + 1) * size, total)].map((value) => value / total),
      stored: [Math.max(index * size - border, 0), Math.min((index + 1) * size + border, total)].map((value) => value / total),
    }));
    const [x, y] = spans.map(({ own }) => own);
    const [left, top] = spans.map(({ stored }) => stored);
    const part = new THREE.Vector4(left[0], top[0], 1 / (left[1] - left[0]), 1 / (top[1] - top[0]));
    const mesh = new THREE.Mesh(rectangle(x, y), this.stage.left);
    for (const side of ["left", "right"]) {
      const { kind } = this.stage[side].uniforms;
      const own = Object.fromEntries(["normalMap", "colorMap", "pictureMap"].map((name) => [name, { value: null }]));
      const blank = this.stage.shared.normalMap.value;
      for (const map of Object.values(own)) map.value = blank;
      mesh.userData[side] = layerMaterial(this.stage.shared, blank, { ...own, kind, part: { value: part } });
      mesh.userData[side].depthTest = false;
    }
    mesh.frustumCulled = false;
    mesh.visible = false;
    this.stage.scene.add(mesh);
    this.meshes.set(place, mesh);
    return mesh;
  }

  /** A tile's texture; null until it is there. Only if `ask`, it is fetched. */
  texture(name, ask) {
    const found = this.found.get(name);
    if (found === undefined && ask) {
      this.found.set(name, null);
      this.wanted.push(name);
      this.fetch();
    }
    if (!found) return null;
    this.found.delete(name); // to the end: those used last are kept
    this.found.set(name, found);
    return found;
  }

  fetch() {
    while (this.wanted.length && this.loading.size < AT_ONCE) {
      const name = this.wanted.pop(); // what was asked for last is in sight
      const script = document.createElement("script");
      const done = (texture) => {
        script.remove();
        this.loading.delete(name);
        this.found.set(name, texture);
        this.forget();
        this.fetch();
        this.stage.changed();
      };
      this.loading.set(name, (address) =>
        picture(address).then((image) => done(textureOf(image)), () => done(false))
      );
      script.onerror = () => done(false);
      script.src = `tiles/${name}.js`;
      document.head.append(script);
    }
  }

  forget() {
    for (const [name, texture] of this.found) {
      if (this.found.size <= MOST_TILES) return;
      if (!texture) continue;
      texture.dispose();
      this.found.delete(name);
    }
  }
}
