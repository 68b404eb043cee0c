// An object while and after it is estimated.

import { byId, el, fill } from "./dom.js";
import { advice } from "./draft.js";
import * as exports from "./exports.js";
import { bytes, current, duration, t } from "./text.js";

const KINDS = [
  ["view", /^view\.html$/],
  ["sheet", /^sheet\.png$/],
  ["normals", /^normals\.(png|npy|exr|mat)$/],
  ["depth", /^(depth\.|height\.)/],
  ["mesh", /\.(glb|ply|obj|stl)$/],
  ["color", /^base_color\./],
  ["lights", /^lights\./],
  ["rti", /^(relight\.ptm|info\.json|plane_)/],
  ["confidence", /^(confidence\.|unreliable\.)/],
  ["mask", /^mask\.png$/],
  ["record", /^normals\.json$/],
  ["other", /./],
];

export function showRunning(object) {
  const stage = byId("stage");
  const bar = byId("share");
  const picture = `/api/objects/${object.id}/pictures/picture.jpg`;
  if (!byId("running-picture").src.endsWith(picture)) byId("running-picture").src = picture;
  stage.textContent = stageOf(object, 100);
  byId("announced").textContent = stageOf(object, 4); // in quarters: not without end
  if (object.phase === "normals") bar.value = object.share;
  else bar.removeAttribute("value");
  byId("left").textContent = object.left ? t("left", { time: duration(object.left) }) : "";
  const preview = byId("running-preview");
  preview.hidden = !object.preview;
  if (object.preview) {
    const source = `/api/objects/${object.id}/pictures/preview.png?${object.time}`;
    if (!preview.src.endsWith(source)) preview.src = source;
  }
}

/** What is done now, with the share that is done in so many steps. */
function stageOf(object, steps) {
  if (object.state === "waiting") return object.ahead ? t("stage_waiting", { n: object.ahead }) : t("stage_next");
  return t(`stage_${object.phase}`, { percent: Math.floor(steps * object.share) * (100 / steps) });
}

export function showEnded(object) {
  byId("ended-text").classList.toggle("problem", object.state !== "cancelled");
  byId("ended-text").textContent = t(`ended_${object.state}`, { error: object.error });
}

export function showDone(object) {
  const base = `/api/objects/${object.id}`;
  const files = object.results;
  const there = files.some((file) => file.name === "view.html");
  byId("gone").hidden = files.length > 0;
  byId("zip").href = `${base}/zip/all.zip`;
  byId("zip").hidden = byId("own-tab").hidden = !files.length;
  byId("own-tab").href = `${base}/results/view.html#${current()}`;
  const page = `${base}/results/view.html#${current()}`;
  const shown = byId("viewer").getAttribute("src")?.startsWith(`${base}/`); // in whatever language
  if (there && !shown) renew(base, page);
  Object.assign(byId("viewer"), { hidden: !there, title: object.name });
  byId("folder").textContent = object.folder ? t("folder", { folder: object.folder }) : "";
  fill(byId("files"), [current(), object.id, files], () => {
    const rest = new Set(files);
    return KINDS.flatMap(([kind, pattern]) => {
      const mine = [...rest].filter((file) => pattern.test(file.name));
      mine.forEach((file) => rest.delete(file));
      if (!mine.length) return [];
      const links = mine.flatMap((file) => [
        el("a", { href: `${base}/results/${encodeURIComponent(file.name)}?save`, textContent: file.name, download: "" }),
        el("span", { className: "note", textContent: ` ${bytes(file.bytes)} ` }),
      ]);
      return [el("dt", { textContent: t(`file_${kind}`) }), el("dd", {}, ...links)];
    });
  });
  exports.show(object);
  advice(byId("done-advice"), object.findings);
}

/** Another frame, not another page in it: "back" would lead through all of them. One with
 * notes that are not saved waits, hidden, until its result is shown again. */
function renew(base, page) {
  const old = byId("viewer");
  let frame = frames().find((other) => other.getAttribute("src")?.startsWith(`${base}/`));
  if (!frame) {
    frame = old.cloneNode();
    frame.removeAttribute("data-unsaved");
    frame.src = page;
    old.after(frame);
  }
  if (old.dataset.unsaved === "true") old.hidden = true;
  else old.remove();
  old.id = "";
  frame.id = "viewer";
}

const frames = () => [...document.querySelectorAll("#done iframe")];

// Viewers say whether all notes in them are saved.
window.addEventListener("message", ({ source, data }) => {
  const frame = frames().find((one) => one.contentWindow === source);
  if (frame) frame.dataset.unsaved = data?.unsaved;
});
