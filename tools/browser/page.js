// The page: files in, a mask, normals out. All of it stays in this browser.
import { encode } from "fast-png";
import {
  brightestOfAll, leaveOut, linearImages, maskOf, readFile, Refusal, requireAlike,
} from "./photographs.js";

const MOST_VALUES = 3e8; // numbers of all photographs: more does not fit a browser
const $ = (id) => document.getElementById(id);
const state = { photographs: [], maskFile: null, brightest: null, result: null };
let worker;

const say = (text, bad = false) => {
  $("status").textContent = text;
  $("status").classList.toggle("bad", bad);
};

async function take(list) {
  const files = [...list].filter((file) => file.size && !file.name.startsWith("."))
    .filter((file) => /^image\//.test(file.type))
    .sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
  const stem = (file) => file.name.replace(/\.[^.]*$/, "").toLowerCase();
  const masks = files.filter((file) => stem(file) === "mask");
  const others = files.filter((file) => stem(file) !== "mask");
  try {
    const read = [];
    for (const file of others) {
      say(`reading ${file.name}`);
      read.push(await readFile(file));
    }
    if (read.length) {
      requireAlike(read);
      state.photographs = read;
      state.maskFile = null;
    }
    if (masks.length) state.maskFile = await readFile(masks[0]);
    if (!state.photographs.length) throw new Refusal("expected photographs, got none");
    if (state.maskFile) requireMaskFits();
    state.brightest = brightestOfAll(state.photographs);
    $("mask-kind").value = state.maskFile ? "file" : "none";
    $("mask-kind").options[0].disabled = !state.maskFile;
    $("options").hidden = false;
    const { width, height, tag } = state.photographs[0];
    $("auto").textContent = `as the files say (${tag})`;
    say(`${state.photographs.length} photographs of ${width} x ${height}`);
    showMask();
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    say(error.message, true);
  }
}

function requireMaskFits() {
  const [first] = state.photographs;
  const { name, width, height } = state.maskFile;
  if (width === first.width && height === first.height) return;
  state.maskFile = null;
  throw new Refusal(
    `${name}: expected a mask of ${first.width} x ${first.height} pixels as ` +
      `${first.name}, got ${width} x ${height}`,
  );
}

function currentMask() {
  const kind = $("mask-kind").value;
  const [first] = state.photographs;
  let mask;
  if (kind === "file") mask = maskOf(state.maskFile);
  else if (kind === "threshold") {
    // On the square root, where dark parts are told apart best.
    const level = ($("threshold").value / 100) ** 2 * first.top;
    mask = Uint8Array.from(state.brightest, (value) => (value > level ? 1 : 0));
  } else mask = new Uint8Array(first.width * first.height).fill(1);
  return leaveOut(mask, state.photographs, state.brightest);
}

function showMask() {
  $("threshold").disabled = $("mask-kind").value !== "threshold";
  const mask = currentMask();
  const [file] = state.photographs;
  const { width, height, values, channels, top } = file;
  const picture = new ImageData(width, height);
  const encoded = transferOf() === "srgb" ? 1 : 1 / 2.2;
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) {
      const value = (values[i * channels + (channels === 3 ? c : 0)] / top) ** encoded;
      picture.data[i * 4 + c] = mask[i] ? 255 * value : 64 * value + (c === 2 ? 90 : 20);
    }
    picture.data[i * 4 + 3] = 255;
  }
  draw($("photograph"), picture);
}

const transferOf = () => {
  const chosen = $("transfer").value;
  return chosen === "auto" ? state.photographs[0].tag : chosen;
};

function draw(canvas, picture) {
  canvas.width = picture.width;
  canvas.height = picture.height;
  canvas.getContext("2d").putImageData(picture, 0, 0);
}

function showNormals(normals, mask, width, height, step) {
  const picture = new ImageData(width, height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const i = y * width + x;
      if (!mask[i]) continue;
      const from = 3 * ((y - (y % step)) * width + x - (x % step));
      if (!normals[from] && !normals[from + 1] && !normals[from + 2]) continue;
      for (let c = 0; c < 3; c++) {
        picture.data[i * 4 + c] = Math.round((normals[from + c] + 1) * 127.5);
      }
      picture.data[i * 4 + 3] = 255;
    }
  }
  draw($("normals"), picture);
}

async function estimate(provider) {
  const [first] = state.photographs;
  const most = Number($("side").value);
  const step = most ? Math.max(1, Math.ceil(Math.max(first.width, first.height) / most)) : 1;
  const values = (state.photographs.length * first.width * first.height * 3) / step ** 2;
  if (values > MOST_VALUES) {
    say("expected less to compute than a browser has memory for; choose a smaller side", true);
    return;
  }
  const given = linearImages(state.photographs, currentMask(), transferOf(), step);
  const { mask, width, height } = given;
  if (!mask.some((value) => value)) {
    say("expected a mask with something inside, got none; choose another", true);
    return;
  }
  const began = performance.now();
  worker ??= new Worker("./worker.js", { type: "module" });
  busy(true);
  worker.onmessage = ({ data }) => {
    if (data.error && provider === "webgpu") {
      stop();
      estimate("wasm"); // the processor can do all that a graphics card may refuse
    } else if (data.error) {
      say(data.error, true);
      busy(false);
    } else if (data.stage) say(`${data.stage}...`);
    else if (data.total) {
      const share = data.done / data.total;
      const left = ((performance.now() - began) / 1000) * (1 / share - 1);
      $("progress").value = share;
      say(`${Math.round(100 * share)}%, about ${Math.ceil(left)} s left`);
    } else if (data.normals) {
      showNormals(data.normals, mask, width, height, data.step);
      if (data.step > 1) return;
      state.result = { normals: data.normals, mask, width, height, seconds: data.seconds };
      const how = provider === "webgpu" ? "graphics card" : `${data.threads} threads`;
      say(`done in ${data.seconds.toFixed(1)} s (${how})`);
      busy(false);
    }
  };
  worker.onerror = (event) => {
    say(event.message || "the network could not be started", true);
    busy(false);
  };
  worker.postMessage({ ...given, n: state.photographs.length, provider });
}

function busy(now) {
  $("estimate").hidden = now;
  $("cancel").hidden = !now;
  $("progress").hidden = !now;
  $("progress").value = 0;
  $("download").hidden = now || !state.result;
}

function stop() {
  worker?.terminate();
  worker = undefined;
}

// 16 bits, as `unips estimate` writes it: (n + 1) / 2 of full scale, green is up.
function normalsPng() {
  const { normals, width, height } = state.result;
  const data = Uint16Array.from(normals, (n) =>
    Math.min(65535, Math.floor(n * 32767.5 + 32768)));
  return encode({ width, height, data, depth: 16, channels: 3 });
}

$("choose").onclick = () => $("files").click();
$("files").onchange = ({ target }) => {
  const files = [...target.files];
  target.value = ""; // so that the same files can be chosen again
  take(files);
};
document.ondragover = (event) => event.preventDefault();
document.ondrop = async (event) => {
  event.preventDefault();
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.());
  take([...event.dataTransfer.files, ...(await filesOf(entries))].filter((f) => f.size));
};
for (const id of ["mask-kind", "threshold", "transfer"]) $(id).oninput = showMask;
$("provider").options[1].disabled = !navigator.gpu;
$("estimate").onclick = () => {
  state.result = null;
  estimate($("provider").value);
};
$("cancel").onclick = () => {
  stop();
  busy(false);
  say("stopped");
};
$("download").onclick = () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([normalsPng()], { type: "image/png" }));
  link.download = "normals.png";
  link.click();
};
// For tests, and for those who look into pages.
window.unips = { state, normalsPng };

// The files of folders that were dropped; files themselves came with the event.
async function filesOf(entries) {
  const found = [];
  for (const entry of entries) {
    if (!entry?.isDirectory) continue;
    const reader = entry.createReader();
    for (let batch; (batch = await new Promise((ok, no) => reader.readEntries(ok, no))).length; ) {
      for (const inner of batch) {
        if (inner.isFile) found.push(await new Promise((ok, no) => inner.file(ok, no)));
      }
    }
  }
  return found;
}

// Threads need headers that few servers send: a service worker adds them, once.
if (!crossOriginIsolated && "serviceWorker" in navigator && !sessionStorage.isolated) {
  navigator.serviceWorker.register("./isolate.js").then(async () => {
    await navigator.serviceWorker.ready;
    sessionStorage.isolated = "tried";
    location.reload();
  }, () => {});
}
