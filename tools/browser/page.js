// The page: files in, a mask, a lit surface out. All of it stays in this browser.
import { ask, end } from "./ask.js";
import { Editor } from "./editor.js";
import { find } from "./find.js";
import { forget, keep, recall, stayAwake } from "./keep.js";
import {
  brightestOfAll, filesOf, isMap, isMask, leaveOut, linearImages, maskOf, readFile, requireAlike, requireMaskFits,
} from "./photographs.js";
import { normalsPng, viewerPage } from "./surface.js";
import { current, offer, Refusal, t } from "./text.js";

const MOST_VALUES = 3e8; // numbers of all photographs: more does not fit a browser
const MOST_KEPT = 4e8; // bytes of files
const $ = (id) => document.getElementById(id);
const state = { photographs: [], files: [], leftOut: [], brightest: null, mask: null, result: null };
let dropped = 0;
let shown = 0; // which drop's photographs are shown

// What the status shows: a function, so that it can change its language.
let status = () => "";
const say = (text, bad = false) => {
  status = text;
  $("status").textContent = status();
  $("status").classList.toggle("bad", bad);
};
const tell = (key, values) => say(() => t(key, values));
const refuse = ({ key, values }) => say(() => t(key, values), true);
const stage = (name) => tell(`stage_${name}`);
const editor = new Editor($("photograph"), (...box) => findObject(box), () => {
  $("undo").disabled = !editor.past.length;
  keep("mask", state.mask);
});

// Reads files; what is wrong with them is reported, and what was there before stays.
// `again`: they were kept, with `mask` if there was one. Gives whether they are shown now.
async function take(list, mask = null, again = false) {
  const turn = again ? 0 : ++dropped;
  const files = [...list].filter((file) => file.size && !file.name.startsWith("."))
    .filter((file) => /^image\//.test(file.type) || /\.(hei[cf]|hif)$/i.test(file.name))
    .sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
  const masks = files.filter((file) => isMask(file.name));
  const rest = files.filter((file) => !isMask(file.name));
  const plain = rest.filter((file) => !isMap(file.name));
  const others = plain.length ? plain : rest;
  const leftOut = rest.filter((file) => !others.includes(file)).map((file) => file.name);
  try {
    if (masks.length > 1 && !again) throw new Refusal("masks", { name: masks[0].name, other: masks[1].name });
    if (rest.length && !plain.length && state.photographs.length) {
      throw new Refusal("map", { name: rest[0].name });
    }
    const read = [];
    for (const file of others) {
      tell("reading", { name: file.name });
      read.push(await readFile(file));
    }
    if (read.length) requireAlike(read, again || $("transfer").value !== "auto");
    const photographs = read.length ? read : state.photographs;
    if (!photographs.length || !files.length) throw new Refusal("no_photographs");
    const maskFile = masks.length ? await readFile(masks.at(-1)) : null;
    if (maskFile) requireMaskFits(maskFile, photographs[0]);
    if (turn < shown) return false; // later ones were read sooner
    if (read.length) {
      shown = turn;
      stop();
      if (!again) forget().then(keepOptions); // what is kept is of other photographs
      Object.assign(state, { photographs, files, leftOut, result: null });
    } else state.files = [...state.files.filter((file) => !isMask(file.name)), ...masks];
    const bytes = state.files.reduce((sum, file) => sum + file.size, 0);
    if (bytes <= MOST_KEPT) keep("files", state.files); // an object may be looked for long
    await show(maskFile, mask);
    return turn >= shown;
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    refuse(error);
    if (error.key === "refused_tag") { // what it advises is there
      $("choices").hidden = false;
      $("choices").open = true;
    }
    return false;
  }
}

async function show(maskFile, mask) {
  const { width, height } = state.photographs[0];
  state.brightest = brightestOfAll(state.photographs);
  state.mask = mask ?? (maskFile ? maskOf(maskFile) : new Uint8Array(width * height).fill(1));
  if (maskFile) keep("mask", state.mask);
  translate();
  for (const id of ["drop", "result", "normals"]) $(id).hidden = true;
  for (const id of ["choices", "work"]) $(id).hidden = false;
  $("work").style.setProperty("--shape", width / height);
  refocus("work");
  editor.show(picture(), state.mask, width, height);
  const names = state.leftOut.join(", ");
  const aside = () => (names ? t("left_out", { names }) : "");
  const count = () => t("count", { n: state.photographs.length, width, height }) + aside();
  if (mask || maskFile) say(() => t("ready", { count: count() }));
  else {
    $("estimate").disabled = true; // until the object is found
    await findObject(null, count).finally(() => { $("estimate").disabled = false; });
  }
}

// The brightest of all photographs as RGB of 0 to 255: [h, w, 3].
function picture() {
  const [{ width, height, top }] = state.photographs;
  const out = new Uint8ClampedArray(width * height * 3);
  const shown = transferOf() === "srgb" ? 1 : 1 / 2.2;
  const table = Float32Array.from({ length: top + 1 }, (_, v) => 255 * (v / top) ** shown);
  for (const { values, channels } of state.photographs) {
    for (let i = 0; i < out.length; i++) {
      const value = table[values[channels === 3 ? i : (i / 3) | 0]];
      if (value > out[i]) out[i] = value;
    }
  }
  return out;
}

const transferOf = () => {
  const chosen = $("transfer").value;
  return chosen === "auto" ? state.photographs[0].tag : chosen;
};

function stop() {
  end();
  $("estimate").disabled = false;
  busy(false);
}

// Looks for the object, in a box if there is one, and makes it the mask.
async function findObject(box = null, count = null) {
  const edited = state.mask;
  const after = (key, values = {}) => () => (count ? `${count()}: ` : "") + t(key, values);
  try {
    const mask = await find(state.photographs, transferOf(), box, stage);
    if (edited !== state.mask) return; // other files were dropped meanwhile
    if (!mask) {
      say(after(box ? "none_kept" : "none"), !count);
      return;
    }
    editor.replace(mask);
    say(after("found"));
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    say(() => after("not_looked_for", { error: t(error.key, error.values) })(), true);
  }
}

function showNormals(normals, mask, width, height, step) {
  const shown = new ImageData(width, height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const i = y * width + x;
      if (!mask[i]) continue;
      const from = 3 * ((y - (y % step)) * width + x - (x % step));
      if (!normals[from] && !normals[from + 1] && !normals[from + 2]) continue;
      for (let c = 0; c < 3; c++) {
        shown.data[i * 4 + c] = Math.round((normals[from + c] + 1) * 127.5);
      }
      shown.data[i * 4 + 3] = 255;
    }
  }
  $("normals").hidden = false;
  $("normals").width = width;
  $("normals").height = height;
  $("normals").getContext("2d").putImageData(shown, 0, 0);
}

// How many pixels of a side are averaged to one, by the largest side that was chosen.
function stepNow() {
  const [{ width, height }] = state.photographs;
  const most = Number($("side").value);
  return most ? Math.max(1, Math.ceil(Math.max(width, height) / most)) : 1;
}

const CHOICES = ["side", "transfer"];
const optionsNow = () => Object.fromEntries(CHOICES.map((id) => [id, $(id).value]));
const keepOptions = () => keep("options", optionsNow());
for (const id of CHOICES) $(id).addEventListener("change", keepOptions);

const insideNow = () => leaveOut(state.mask.slice(), state.photographs, state.brightest, transferOf());
const toCompute = () => linearImages(state.photographs, insideNow(), transferOf(), stepNow());

// `known`: normals of a run that was cut off.
async function estimate(known = null) {
  const [first] = state.photographs;
  const n = state.photographs.length;
  if ((n * first.width * first.height * 3) / stepNow() ** 2 > MOST_VALUES) {
    refuse(new Refusal("too_much"));
    return;
  }
  const { mask, width, height, images } = toCompute();
  if (!mask.some((value) => value)) {
    refuse(new Refusal("empty_mask"));
    return;
  }
  let from = null; // when pixels began, and the share that was done
  const options = optionsNow();
  const right = known?.length === width * height * 3 ? known : null;
  if (right) mask.forEach((there, i) => there || right.fill(0, 3 * i, 3 * i + 3)); // mended since
  keep("running", { options, normals: right });
  busy(true);
  try {
    const message = { kind: "normals", images, mask, width, height, n, known: right };
    const { normals, seconds, threads } = await ask(message, "normals", stage, (data) => {
      if (data.total) {
        const share = data.done / data.total;
        $("status").ariaLive = share < 1 ? "off" : "polite"; // no number is read aloud
        const percent = Math.round(100 * share);
        $("progress").value = share;
        from ??= [performance.now(), share]; // what came before says nothing of the rest
        const speed = (share - from[1]) / (performance.now() - from[0]);
        if (share - from[1] < 0.03) tell("percent", { percent });
        else tell("progress", { percent, seconds: Math.ceil((1 - share) / speed / 1000) });
      } else if (data.normals) showNormals(data.normals, mask, width, height, data.step);
      else if (data.partial) keep("running", { options, normals: data.partial });
    });
    showNormals(normals, mask, width, height, 1);
    const names = state.photographs.map(({ name }) => name);
    state.result = { normals, mask, images, width, height, names, seconds };
    tell("stage_surface");
    // Files are kept: of these the photographs' light is read again.
    const { images: _, ...result } = state.result;
    keep("result", { ...result, options }).then(() => forget("running"));
    if (!(await showResult())) return;
    tell("done", { n: threads, threads, seconds: seconds.toFixed(1) });
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    refuse(error);
  } finally {
    busy(false);
  }
}

// Gives whether it is shown now: other photographs may be dropped meanwhile.
async function showResult() {
  const { result } = state;
  const answer = await fetch("./viewer.html").catch((error) => ({ statusText: error.message }));
  for (const id of ["viewer", "save"]) $(id).hidden = !answer.ok;
  if (!answer.ok) {
    $("result").hidden = result !== state.result; // the normals can be saved
    throw new Refusal("viewer", { error: answer.statusText });
  }
  const template = await answer.text();
  const page = await viewerPage(template, result, t("surface"));
  if (result !== state.result) return false;
  state.page = page;
  $("viewer").lang = current(); // saved, it has the one of whoever opens it
  $("viewer").srcdoc = page;
  $("result").hidden = false;
  $("result").scrollIntoView();
  return true;
}

// Where what had the focus is hidden now, this has it.
function refocus(id) {
  const active = document.activeElement;
  if (active === document.body || active.closest("[hidden]")) $(id).focus({ preventScroll: true });
}

function busy(now) {
  stayAwake(now);
  $("status").ariaLive = "polite";
  $("estimate").hidden = now;
  $("cancel").hidden = !now;
  refocus("work");
  $("progress").hidden = !now;
  $("progress").value = 0;
  $("download").hidden = now || !state.result;
}

function save(name, content, type) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

$("choose").onclick = () => $("files").click();
$("files").onchange = async ({ target }) => {
  const files = [...target.files];
  target.value = ""; // so that the same files can be chosen again
  await startOver();
  take(files);
};
document.ondragover = (event) => event.preventDefault();
document.ondrop = async (event) => {
  event.preventDefault();
  const entries = [...event.dataTransfer.items].map((item) => item.webkitGetAsEntry?.());
  const files = [...event.dataTransfer.files];
  take([...files, ...(await filesOf(entries))].filter((f) => f.size));
};
for (const button of document.querySelectorAll("[data-tool]")) {
  button.onclick = () => {
    const tool = editor.tool === button.dataset.tool ? null : button.dataset.tool;
    editor.choose(tool);
    for (const other of document.querySelectorAll("[data-tool]")) {
      other.setAttribute("aria-pressed", String(other.dataset.tool === tool));
    }
  };
}
editor.choose(null);
$("brush").oninput = ({ target }) => { editor.brush = target.value / 1000; };
$("undo").onclick = () => editor.undo();
$("find").onclick = () => findObject();
$("whole").onclick = () => editor.replace(new Uint8Array(state.mask.length).fill(1));
$("transfer").oninput = () => {
  if (!state.photographs.length) return; // chosen for those that are dropped next
  editor.setPicture(picture());
};
$("estimate").onclick = () => {
  state.result = null;
  $("result").hidden = true;
  estimate();
};
$("cancel").onclick = () => {
  stop();
  forget("running");
  tell("stopped");
};
$("restart").onclick = async () => {
  $("cancel").onclick();
  $("transfer").value = "auto"; // what was said of those holds for no others
  await startOver();
  say(() => "");
};
$("download").onclick = () => save("normals.png", normalsPng(state.result), "image/png");
$("save").onclick = () => {
  const viewer = $("viewer").contentDocument; // with notes, where it could draw
  if (viewer.body?.dataset.ready) viewer.getElementById("save-page").click();
  else save("surface.html", state.page, "text/html");
};

async function startOver() {
  await forget();
  Object.assign(state, { photographs: [], files: [], mask: null, result: null });
  for (const id of ["choices", "work", "result", "download"]) $(id).hidden = true;
  $("drop").hidden = false;
  refocus("choose");
}

// What a phone closed with its screen, or a reload: taken up again.
async function takeUp() {
  const files = await recall("files");
  if (!files?.length) return;
  const [mask, running, result] = [await recall("mask"), await recall("running"), await recall("result")];
  const chosen = (running ?? result)?.options ?? (await recall("options")); // by 0.3.0: none
  for (const id of CHOICES) if (chosen?.[id]) $(id).value = chosen[id];
  if (!(await take(files, mask ?? null, true))) return;
  if (running) {
    estimate(running.normals);
  } else if (result) {
    const { images } = result.images ? result : toCompute();
    state.result = { ...result, images };
    showNormals(result.normals, result.mask, result.width, result.height, 1);
    $("download").hidden = false;
    try {
      if (await showResult()) tell("as_left");
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      refuse(error);
    }
  }
}

function translate() {
  $("status").textContent = status();
  const tag = state.photographs[0]?.tag;
  if (tag) $("auto").textContent = t(`auto_${tag}`);
}
offer($("language"), translate);

// Threads need headers that few servers send: a service worker adds them, once.
if (!crossOriginIsolated && "serviceWorker" in navigator && !sessionStorage.isolated) {
  navigator.serviceWorker.register("./isolate.js").then(async () => {
    await navigator.serviceWorker.ready;
    sessionStorage.isolated = "tried";
    location.reload();
  }, takeUp); // without threads it goes on, too
} else takeUp();
// A page that "back" brings from memory may be the one before the reload.
addEventListener("pageshow", (event) => {
  if (event.persisted && !crossOriginIsolated) location.reload();
});
// For tests, and for those who look into pages.
window.unips = { state, normalsPng: () => normalsPng(state.result), editor };
