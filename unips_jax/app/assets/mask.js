// The mask's editor: a brush, a box that the server cuts out, pieces, undo.

import { request } from "./api.js";
import { image } from "./dom.js";
import { t } from "./text.js";

const SIDE = 1024;
const LEAST_SIDE = 640; // small pictures have a fine mask too
const LEAVING_BYTES = 60000; // browsers send no more of a page that is gone
const VEIL = "rgb(30 0 45 / 80%)";
const LIGHT_VEIL = "rgb(30 0 45 / 25%)"; // while there is no mask at all

const byId = (name) => document.getElementById(name);
const pixelsOf = (c) => c.getContext("2d", { willReadFrequently: true });
const tell = (text) => (byId("mask-status").textContent = text);

let canvas, context, picture, mask, tool, history, cursor, stroke;
let byKeys = false; // who moves the cursor
let address = null; // of the object whose mask this is
let inside = 0; // pixels
let changes = 0; // that the server doesn't have yet
let flushed = 0; // of these, sent by a page that was about to go
let saving = null; // the save that runs
let edits = 0; // since the page was opened
let known = 0; // the number of the server's mask that this is, or follows
let finding = Promise.resolve(); // the answers that are waited for
let turn = 0; // changes with each object: answers for an earlier one come too late
let listeners = { changed: () => {} };

/** Shows the picture; of another size or object, everything begins anew. */
export async function load(id, version, how, changed) {
  const [base, mine, before] = [`/objects/${id}`, turn, edits];
  const shown = await image(`/api${base}/pictures/picture.jpg?${version}`);
  if (mine !== turn) return;
  const same = address === base && picture?.width === shown.width && picture?.height === shown.height;
  // What was drawn meanwhile stays: the server has it, or is about to.
  const drawn = () => same && (changes || edits !== before || (stroke && tool !== "box"));
  listeners.changed = changed;
  picture = shown;
  if (!same) begin(base);
  if (!drawn() && how.mask === "auto") {
    const name = how.found.mask === "none" ? null : "mask.png";
    if (same) remember();
    if (!name) clear();
    else if (!(await take(`/api${base}/pictures/${name}?${version}`, drawn))) return;
    if (!same) choose(name ? "add" : "box");
  } else if (!drawn() && (!same || how.mask_version > known)) {
    if (same) remember();
    if (!(await take(`/api${base}/pictures/drawn.png?${version}-${how.mask_version}`, drawn))) return;
    if (!same) choose(how.mask === "empty" ? "box" : "add");
  }
  if (!same) {
    changes = 0;
    tell("");
  }
  known = how.mask_version;
  draw();
  byId("mask-editor").dataset.ready = "true";
}

function begin(base) {
  address = base;
  canvas = byId("mask-canvas");
  const longer = Math.max(picture.width, picture.height);
  const scale = Math.min(Math.max(longer, LEAST_SIDE), SIDE) / longer;
  canvas.width = Math.round(picture.width * scale);
  canvas.height = Math.round(picture.height * scale);
  context = canvas.getContext("2d");
  mask = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
  history = [];
  cursor = null;
  stroke = null;
  listen();
}

export function forget() {
  flush();
  turn += 1;
  changes = 0;
  address = null;
  byId("mask-editor").dataset.ready = "false";
}

export const empty = () => inside === 0;

/** Whether another page changed the mask, and nothing waits to be sent from here. */
export const isBehind = (object) => object.mask_version > known && !changes;

/** Resolves when the server has the mask. */
export async function settled() {
  while (changes) await save();
}

/** The page may go: sends what the server doesn't have; whether it can be relied on. */
export function flush() {
  if (!changes || !address || flushed === changes) return true;
  const text = atob(picked().toDataURL("image/png").split(",")[1]);
  const body = new Blob([Uint8Array.from(text, (c) => c.charCodeAt(0))]);
  const keepalive = body.size < LEAVING_BYTES;
  fetch(`/api${address}/mask?kind=${kind()}`, { method: "PUT", body, keepalive }).catch(() => {});
  if (keepalive) flushed = changes;
  return keepalive;
}

function clear() {
  pixelsOf(mask).clearRect(0, 0, mask.width, mask.height);
}

/** Takes a mask from the server, unless another is kept: white is the object. */
async function take(source, keeps = () => false) {
  const mine = turn;
  const loaded = await image(source);
  if (mine !== turn) return false;
  if (keeps()) return true;
  const c = pixelsOf(mask);
  clear();
  c.drawImage(loaded, 0, 0, mask.width, mask.height);
  const pixels = c.getImageData(0, 0, mask.width, mask.height);
  for (let at = 0; at < pixels.data.length; at += 4) {
    const object = pixels.data[at] > 127 && pixels.data[at + 3] > 127;
    pixels.data.fill(255, at, at + 3);
    pixels.data[at + 3] = object ? 255 : 0;
  }
  c.putImageData(pixels, 0, 0);
  return true;
}

function remember() {
  history.push(pixelsOf(mask).getImageData(0, 0, mask.width, mask.height));
  if (history.length > 20) history.shift();
}

function undo() {
  const before = history.pop();
  if (!before) return;
  pixelsOf(mask).putImageData(before, 0, 0);
  edited();
}

function fill(all) {
  remember();
  clear();
  const c = pixelsOf(mask);
  c.fillStyle = "#fff";
  if (all) c.fillRect(0, 0, mask.width, mask.height);
  edited();
}

/** After a change: shows it, and sends it to the server at once. */
function edited() {
  edits += 1;
  changes += 1;
  flushed = 0;
  draw();
  save();
  listeners.changed();
}

const kind = () => (inside === 0 ? "empty" : inside === mask.width * mask.height ? "whole" : "drawn");

/** The mask as a picture: white on black. */
function picked() {
  const sent = Object.assign(document.createElement("canvas"), { width: mask.width, height: mask.height });
  const c = sent.getContext("2d");
  c.fillRect(0, 0, sent.width, sent.height);
  c.drawImage(mask, 0, 0);
  return sent;
}

/** One save after the other; what changes meanwhile follows. */
function save() {
  saving ??= send().finally(() => (saving = null));
  return saving;
}

async function send() {
  while (changes) {
    const upTo = changes;
    const [base, how] = [address, kind()];
    const blob = await new Promise((done) => picked().toBlob(done, "image/png"));
    try {
      const answer = await request("PUT", `${base}/mask?kind=${how}`, blob);
      if (base === address) known = answer.mask_version;
    } catch (problem) {
      if (base !== address) return 0;
      if (problem.status === 404 || problem.status === 409) return (changes = 0);
      tell(t("mask_not_saved"));
      await new Promise((done) => setTimeout(done, 1000));
      continue;
    }
    if (base === address && changes === upTo) changes = 0;
    listeners.changed();
  }
  return 0;
}

function choose(name) {
  tool = name;
  stroke = null;
  for (const button of document.querySelectorAll("[data-mask-tool]")) {
    button.setAttribute("aria-pressed", String(button.dataset.maskTool === name));
  }
}

function count() {
  const { data } = pixelsOf(mask).getImageData(0, 0, mask.width, mask.height);
  inside = 0;
  for (let at = 3; at < data.length; at += 4) inside += data[at] > 127;
  byId("mask-editor").dataset.share = (inside / (mask.width * mask.height)).toFixed(3);
}

/** The picture, veiled where it is not the object. */
function draw() {
  if (!stroke) count();
  context.globalCompositeOperation = "source-over";
  context.drawImage(picture, 0, 0, canvas.width, canvas.height);
  const veil = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
  const v = veil.getContext("2d");
  v.fillStyle = inside || stroke ? VEIL : LIGHT_VEIL;
  if (stroke && tool === "box" && !inside) v.fillStyle = LIGHT_VEIL;
  v.fillRect(0, 0, veil.width, veil.height);
  v.globalCompositeOperation = "destination-out";
  v.drawImage(mask, 0, 0);
  context.drawImage(veil, 0, 0);
  context.strokeStyle = "#ffe066";
  context.lineWidth = Math.max(2, canvas.width / 400);
  if (stroke && tool === "box") {
    context.setLineDash([8, 5]);
    context.strokeRect(...rectangle());
  }
  const paints = tool === "add" || tool === "erase";
  if (cursor && (paints || byKeys)) {
    context.setLineDash([]);
    context.beginPath();
    context.arc(...cursor, paints ? brush() / 2 : 3 * context.lineWidth, 0, 2 * Math.PI);
    context.stroke();
  }
}

const brush = () => (Number(byId("mask-brush").value) / 100) * Math.max(canvas.width, canvas.height);

function rectangle() {
  const [[a, b], [c, d]] = [stroke.from, stroke.to];
  return [Math.min(a, c), Math.min(b, d), Math.abs(a - c), Math.abs(b - d)];
}

function paint(from, to) {
  const c = pixelsOf(mask);
  c.globalCompositeOperation = tool === "add" ? "source-over" : "destination-out";
  c.strokeStyle = "#fff";
  c.lineWidth = brush();
  c.lineCap = "round";
  c.beginPath();
  c.moveTo(...from);
  c.lineTo(to[0] + 0.01, to[1]);
  c.stroke();
  c.globalCompositeOperation = "source-over";
}

/** What the server finds in the picture becomes the mask, one answer after the other. */
function find(what, body, words) {
  finding = finding.catch(() => {}).then(() => ask(what, body, words));
  return finding;
}

async function ask(what, body, words) {
  const base = address;
  if (!base) return;
  if (what === "piece") {
    changes += 1;
    await settled(); // the server must have the mask for that
  }
  if (base !== address) return;
  const before = edits;
  tell(t("looking"));
  try {
    await request("POST", `${base}/${what}`, body);
    if (base !== address) return;
    if (edits !== before || stroke) return tell(t("mask_edited")); // drawn meanwhile: it stays
    remember();
    if (!(await take(`/api${base}/pictures/cut.png?${Date.now()}`))) return;
  } catch (problem) {
    tell(problem.message);
    return;
  }
  tell(words);
  edited();
}

/** GrabCut in the box. */
async function cut() {
  const [x, y, w, h] = rectangle().map((value) => (value * picture.width) / canvas.width);
  if (w < 8 || h < 8) tell(t("box_small"));
  else await find("cut", { box: [x, y, x + w, y + h] }, t("box_found"));
}

async function endBox() {
  const cutting = cut();
  stroke = null;
  draw();
  await cutting;
}

/** Takes or drops the piece at a place. */
async function piece(at) {
  await find("piece", { point: at.map((value) => (value * picture.width) / canvas.width) }, "");
}

function place(event) {
  const box = canvas.getBoundingClientRect(); // the picture lies in its middle: object-fit
  const scale = Math.min(box.width / canvas.width, box.height / canvas.height);
  return [
    (event.clientX - box.left - box.width / 2) / scale + canvas.width / 2,
    (event.clientY - box.top - box.height / 2) / scale + canvas.height / 2,
  ];
}

function listen() {
  if (canvas.dataset.listening) return;
  canvas.dataset.listening = "true";
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button || !event.isPrimary) return; // a second finger draws nothing
    canvas.setPointerCapture(event.pointerId);
    const at = place(event);
    if (tool === "piece") return piece(at);
    stroke = { from: at, to: at };
    if (tool !== "box") {
      remember();
      paint(at, at);
    }
    draw();
    return undefined;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!event.isPrimary) return;
    cursor = place(event);
    byKeys = false;
    if (stroke) {
      if (tool !== "box") paint(stroke.to, cursor);
      stroke.to = cursor;
    }
    draw();
  });
  canvas.addEventListener("pointerleave", () => {
    if (stroke) return;
    cursor = null;
    draw();
  });
  canvas.addEventListener("pointerup", async (event) => {
    if (!stroke || !event.isPrimary) return;
    if (tool === "box") await endBox();
    else {
      stroke = null;
      edited();
    }
  });
  canvas.addEventListener("pointercancel", (event) => {
    if (!event.isPrimary) return;
    if (stroke && tool !== "box") undo();
    stroke = null;
    draw();
  });
  canvas.addEventListener("keydown", keys);
  for (const button of document.querySelectorAll("[data-mask-tool]")) {
    button.addEventListener("click", () => choose(button.dataset.maskTool));
  }
  byId("mask-undo").addEventListener("click", undo);
  byId("mask-clear").addEventListener("click", () => fill(false));
  byId("mask-all").addEventListener("click", () => fill(true));
}

function keys(event) {
  const arrow = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const paints = tool === "add" || tool === "erase";
  cursor ??= [canvas.width / 2, canvas.height / 2];
  byKeys = true;
  const before = [...cursor];
  if (arrow) {
    const limits = [canvas.width, canvas.height];
    cursor = cursor.map((value, axis) => Math.min(Math.max(value + (arrow[axis] * brush()) / 2, 0), limits[axis]));
    if (stroke) stroke.to = cursor;
    if (event.shiftKey && paints) {
      if (!event.repeat) remember();
      paint(before, cursor);
      edited();
    }
  } else if (event.key === " " && tool === "box") {
    if (stroke) endBox();
    else stroke = { from: cursor, to: cursor };
  } else if (event.key === "Escape" && stroke) stroke = null;
  else if (event.key === " " && tool === "piece") piece(cursor);
  else if (event.key === " " && paints) {
    remember();
    paint(cursor, cursor);
    edited();
  } else if (event.key === "z") undo();
  else return;
  event.preventDefault();
  draw();
}
