// What leaves the page as files: a picture, the page with its notes, the surface.

function download(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

/** The object's name, as a file's. */
const fileName = () => document.querySelector("h1").textContent.replace(/[^\p{L}\p{N}._ -]+/gu, "_") || "view";

const LEAST_SIDE = 2000; // pixels of a saved picture's longer side

/** What the stage shows, with lines, notes and scale bar, as a PNG. */
async function pictureOf(stage) {
  const [width, height] = stage.size;
  const ratio = Math.min(4, Math.max(window.devicePixelRatio, LEAST_SIDE / Math.max(width, height)));
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width * ratio, height * ratio].map(Math.round);
  const context = canvas.getContext("2d");
  stage.renderer.setPixelRatio(ratio);
  stage.renderer.setSize(width, height, false);
  stage.draw();
  context.drawImage(stage.canvas, 0, 0, canvas.width, canvas.height);
  const overlay = byId("overlay").cloneNode(true);
  stage.resize();
  overlay.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  overlay.setAttribute("width", canvas.width);
  overlay.setAttribute("height", canvas.height);
  overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
  overlay.append(...halves(stage));
  const text = new XMLSerializer().serializeToString(overlay);
  const image = await picture(`data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`);
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}

/** The line between two layers and their names. */
function halves(stage) {
  if (byId("right").value === "") return [];
  const [width, height] = stage.size;
  const x = stage.split * width;
  const right = label(width - 8, 22, byId("tag-right").textContent);
  right.setAttribute("text-anchor", "end");
  return [...marked("path", { d: `M${x} 0V${height}`, stroke: "#fff" }), label(8, 22, byId("tag-left").textContent), right];
}

/** The page as it came, with other notes in it. */
function pageWith(notes) {
  const text = JSON.stringify(notes).replaceAll("<", "\\u003c");
  const page = source.replace(/(id="notes">)[^<]*/, (_, mark) => mark + text);
  return new Blob([page], { type: "text/html" });
}

/** The surface as a GLB file, in metres; without a scale its longest side is 1 m. */
function glbOf(stage, normalBytes) {
  const geometry = stage.solid?.geometry ?? surfaceGeometry(stage.depthBytes);
  const all = Object.fromEntries(["position", "uv"].map((name) => [name, geometry.getAttribute(name).array]));
  const triangles = geometry.index.array;
  const numbers = new Int32Array(all.position.length / 3).fill(-1); // those in use, anew
  const used = [];
  const indices = triangles.map((k) => {
    if (numbers[k] < 0) numbers[k] = used.push(k) - 1;
    return numbers[k];
  });
  const position = Float32Array.from(used.flatMap((k) => [...all.position.subarray(3 * k, 3 * k + 3)]));
  const uv = Float32Array.from(used.flatMap((k) => [...all.uv.subarray(2 * k, 2 * k + 2)]));
  const normal = Float32Array.from(
    used.flatMap((k) => normalAt(normalBytes, all.uv[2 * k] * data.width, all.uv[2 * k + 1] * data.height) ?? [0, 0, 1])
  );
  const ends = [0, 1, 2].map((axis) => {
    let [low, high] = [Infinity, -Infinity];
    for (let i = axis; i < position.length; i += 3) [low, high] = [Math.min(low, position[i]), Math.max(high, position[i])];
    return [low, high];
  });
  const metres = scale.mm === null ? 1 / Math.max(...ends.map(([low, high]) => high - low)) : scale.mm / 1000;
  for (let i = 0; i < position.length; i++) position[i] *= metres;
  const bounds = [0, 1].map((end) => ends.map((pair) => Math.fround(pair[end] * metres)));
  return packedGlb({ position, normal, uv, indices, bounds }, data.color?.image);
}

/** glTF 2.0 in one file; https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html */
function packedGlb({ position, normal, uv, indices, bounds }, color) {
  const FLOAT = 5126, UNSIGNED_INT = 5125, VERTICES = 34962, INDICES = 34963;
  const chunks = [];
  let length = 0;
  const views = [];
  const view = (bytes, target) => {
    views.push({ buffer: 0, byteOffset: length, byteLength: bytes.byteLength, ...(target && { target }) });
    const padding = new Uint8Array((4 - (bytes.byteLength % 4)) % 4);
    chunks.push(bytes, padding);
    length += bytes.byteLength + padding.length;
    return views.length - 1;
  };
  const count = position.length / 3;
  const accessor = (array, type, more = {}) => ({
    bufferView: view(array, more.target ?? VERTICES), componentType: FLOAT, count, type, ...more, target: undefined,
  });
  const accessors = [
    accessor(position, "VEC3", { min: bounds[0], max: bounds[1] }),
    accessor(normal, "VEC3"),
    accessor(uv, "VEC2"),
    accessor(indices, "SCALAR", { target: INDICES, componentType: UNSIGNED_INT, count: indices.length }),
  ];
  const surface = { metallicFactor: 0, roughnessFactor: 0.7 };
  const picture = {};
  if (color) {
    const bytes = Uint8Array.from(atob(color.split(",")[1]), (letter) => letter.charCodeAt(0));
    picture.images = [{ bufferView: view(bytes), mimeType: color.slice(5, color.indexOf(";")) }];
    picture.textures = [{ source: 0 }];
    surface.baseColorTexture = { index: 0 };
  }
  const attributes = { POSITION: 0, NORMAL: 1, TEXCOORD_0: 2 };
  const head = JSON.stringify({
    asset: { version: "2.0", generator: "unips_jax" },
    scene: 0, scenes: [{ nodes: [0] }], nodes: [{ mesh: 0, name: fileName() }],
    meshes: [{ primitives: [{ attributes, indices: 3, material: 0 }] }],
    materials: [{ doubleSided: true, pbrMetallicRoughness: surface }],
    ...picture, accessors, bufferViews: views, buffers: [{ byteLength: length }],
  });
  const json = new TextEncoder().encode(head);
  const blanks = new Uint8Array((4 - (json.length % 4)) % 4).fill(32);
  const jsonLength = json.length + blanks.length;
  const begin = Uint32Array.of(0x46546c67, 2, 28 + jsonLength + length, jsonLength, 0x4e4f534a);
  return new Blob([begin, json, blanks, Uint32Array.of(length, 0x004e4942), ...chunks], { type: "model/gltf-binary" });
}

/** The buttons of this file. */
function connectSaving(stage, notes, normalBytes) {
  byId("save-picture").addEventListener("click", async () => download(`${fileName()}.png`, await pictureOf(stage)));
  byId("save-page").addEventListener("click", () => {
    download(data.tiles ? "index.html" : `${fileName()}.html`, pageWith(notes.values));
    notes.unsaved = false;
  });
  byId("save-surface").hidden = !data.depth;
  byId("save-surface").addEventListener("click", () => download(`${fileName()}.glb`, glbOf(stage, normalBytes)));
}
