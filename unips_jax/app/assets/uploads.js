// Files on their way to the server: one request each, two at a time.

import { request, upload } from "./api.js";
import { message } from "./dom.js";
import { t } from "./text.js";

const AT_A_TIME = 2;
const queues = new Map(); // of objects, by their id

const queueOf = (id) => {
  if (!queues.has(id)) queues.set(id, { waiting: [], running: new Map(), failed: [], done: 0, total: 0 });
  return queues.get(id);
};

/** Counts and failures of an object's files. */
export function state(id) {
  const { running, waiting, failed, done, total } = queueOf(id);
  const bytes = [...running.values()].reduce((sum, part) => sum + part, 0);
  return { busy: running.size + waiting.length > 0, done, total, failed, share: total ? (done + bytes) / total : 0 };
}

export const anyBusy = () => [...queues.keys()].some((id) => state(id).busy);

export function send(id, files, changed) {
  const queue = queueOf(id);
  if (!state(id).busy) [queue.done, queue.total] = [0, 0];
  queue.waiting.push(...files);
  queue.total += files.length;
  for (let n = queue.running.size; n < AT_A_TIME; n++) next(id, changed);
  changed();
}

async function next(id, changed) {
  const queue = queueOf(id);
  const file = queue.waiting.shift();
  if (!file) return;
  queue.running.set(file, 0);
  try {
    await upload(id, file, (sent) => {
      queue.running.set(file, file.size ? sent / file.size : 0);
      changed();
    });
  } catch (problem) {
    queue.failed.push({ file, text: problem.message, lost: problem.lost });
  }
  queue.running.delete(file);
  queue.done += 1;
  changed();
  next(id, changed);
}

export function retry(id, failure, changed) {
  dismiss(id, failure);
  send(id, [failure.file], changed);
}

export function dismiss(id, failure) {
  const queue = queueOf(id);
  queue.failed = queue.failed.filter((other) => other !== failure);
}

/** Files of a drop; of folders the files in them. */
async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.some((entry) => entry.isDirectory)) return { files: [...transfer.files], name: "" };
  const files = [];
  for (const entry of entries) {
    if (entry.isFile) files.push(await new Promise((done, failed) => entry.file(done, failed)));
    else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((done, failed) => reader.readEntries(done, failed));
        if (!some.length) break;
        for (const inner of some) if (inner.isFile) files.push(await new Promise((done, failed) => inner.file(done, failed)));
      }
    }
  }
  return { files: files.filter((file) => !file.name.startsWith(".")), name: entries.find((e) => e.isDirectory).name };
}

/** Makes a place for drops and choices; taken gets files, and a folder's name. */
export function dropZone(element, taken) {
  element.append(document.getElementById("drop-template").content.cloneNode(true));
  if (element.classList.contains("small")) element.querySelector("strong").dataset.t = "drop_more";
  const input = element.querySelector("input");
  input.addEventListener("change", () => {
    const files = [...input.files];
    input.value = "";
    if (files.length) taken(files, "");
  });
  for (const kind of ["dragenter", "dragover"]) {
    element.addEventListener(kind, (event) => {
      event.preventDefault();
      element.classList.add("over");
    });
  }
  element.addEventListener("dragleave", (event) => {
    if (!element.contains(event.relatedTarget)) element.classList.remove("over");
  });
  element.addEventListener("drop", async (event) => {
    event.preventDefault();
    element.classList.remove("over");
    const { files, name } = await dropped(event.dataTransfer);
    if (files.length) taken(files, name);
    else if (name) message(t("no_files", { name }));
  });
}

export const begin = (example, name) => request("POST", "/objects", { example, name });
