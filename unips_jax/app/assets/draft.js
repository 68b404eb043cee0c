// An object before its estimate: photographs, mask, options.

import { request } from "./api.js";
import { byId, el, fill, message } from "./dom.js";
import * as mask from "./mask.js";
import { current, knows, some, t } from "./text.js";
import * as uploads from "./uploads.js";

let shown = null; // the object as the server last described it
let loaded = ""; // which picture the mask's editor has
let hooks = { poll: () => {} };

const path = (more = "") => `/objects/${shown.id}${more}`;
const options = () => [...document.querySelectorAll("[data-option]")];

export function build(poll) {
  hooks = { poll };
  uploads.dropZone(byId("more-drop"), (files, name) => take(shown.id, files, name));
  for (const input of [...options(), byId("name")]) input.addEventListener("change", saveOptions);
  byId("estimate").addEventListener("click", estimate);
}

/** Sends files; a folder's name, if there is one, becomes that of the object shown. */
export function take(id, files, name) {
  uploads.send(id, files, () => {
    if (shown?.id === id) refresh();
    hooks.poll();
  });
  if (name && byId("name").value === "object") {
    byId("name").value = name;
    saveOptions();
  }
}

export function show(object) {
  const other = shown?.id !== object.id;
  shown = object;
  if (other) {
    mask.forget();
    loaded = "";
    byId("name").value = object.name;
    for (const input of options()) setOption(input, object.options[input.dataset.option]);
  }
  refresh();
  if (object.found && object.ready) showMask(object);
}

export function leave() {
  shown = null;
  loaded = "";
}

const setOption = (input, value) => {
  if (input.type === "checkbox") input.checked = value ?? input.dataset.option === "mesh";
  else input.value = value ?? "auto";
};

const chosen = () =>
  Object.fromEntries(options().map((input) => [input.dataset.option, input.type === "checkbox" ? input.checked : input.value]));

async function saveOptions() {
  try {
    await request("POST", path("/options"), { name: byId("name").value, options: chosen() });
  } catch (problem) {
    message(problem.message);
  }
  hooks.poll();
}

async function showMask(object) {
  const which = `${object.id} ${object.version}`;
  if (loaded === which && !mask.isBehind(object)) return;
  loaded = which;
  try {
    await mask.load(object.id, object.version, object, refresh);
  } catch {
    if (loaded === which) loaded = ""; // again with the next answer
  }
  refresh();
}

function refresh() {
  if (!shown) return;
  const sending = uploads.state(shown.id);
  showStatus(sending);
  showPhotographs();
  showAside(sending.failed);
  showAdvice();
  byId("mask-step").hidden = !shown.found;
  if (shown.found) {
    const kind = shown.mask === "auto" ? shown.found.mask : "drawn";
    byId("mask-note").textContent = kind === "drawn" ? "" : t(`mask_${kind}`);
    const { focal } = shown.found;
    const perspective = document.querySelector("[data-option=perspective]");
    perspective.disabled = !focal;
    if (!focal) perspective.checked = false;
    byId("focal-note").textContent = focal ? t("focal_known", { n: Math.round(focal) }) : t("focal_none");
  }
  const missing = whatIsMissing(sending);
  byId("estimate").disabled = missing !== null;
  byId("missing").textContent = missing === null ? "" : t(missing);
}

function whatIsMissing(sending) {
  if (sending.busy) return "missing_upload";
  const count = shown.photographs.length;
  if (!count) return "missing_photographs";
  if (!shown.ready) return "missing_reading";
  if (!shown.found) return "missing_usable";
  if (byId("mask-editor").dataset.ready !== "true") return "missing_reading";
  return mask.empty() ? "missing_mask" : null;
}

function showStatus(sending) {
  const status = byId("photographs-status");
  const bar = byId("upload-progress");
  const new_ = shown.photographs.filter((photo) => photo.state === "new" || photo.state === "receiving").length;
  const total = shown.photographs.length;
  status.classList.toggle("problem", Boolean(shown.problem) && shown.ready);
  bar.hidden = !sending.busy && shown.ready;
  if (sending.busy) {
    status.textContent = t("status_uploading", sending);
    bar.value = sending.share;
  } else if (new_) {
    status.textContent = t("status_reading", { done: total - new_, total });
    bar.value = (total - new_) / total;
  } else if (!total) status.textContent = t("status_none");
  else if (!shown.ready) {
    status.textContent = t("status_together");
    bar.removeAttribute("value");
  } else if (shown.found) {
    const { names, width, height } = shown.found;
    status.textContent = t("status_ready", { n: names.length, width, height });
  } else {
    const word = `problem_${shown.problem}`;
    status.textContent = knows(word) ? t(word) : shown.problem || t("missing_usable");
  }
}

function showPhotographs() {
  const there = shown.photographs.filter((photo) => photo.state === "used" || photo.state === "new" || photo.state === "mask");
  there.sort((a, b) => a.file.localeCompare(b.file, "en", { numeric: true }));
  fill(byId("thumbnails"), [current(), shown.id, there], () =>
    there.map((photo) => {
      const source = `/api${path(`/pictures/${encodeURIComponent(photo.file)}.jpg`)}`;
      const picture = photo.picture ? el("img", { src: source, alt: "", loading: "lazy" }) : el("div", { className: "pending" });
      const label = t("leave_out", { name: photo.name });
      const out = el("button", { type: "button", className: "x", textContent: "×", title: label, ariaLabel: label });
      out.addEventListener("click", () => use(photo, false));
      const caption = photo.state === "mask" ? `${t("mask")}: ${photo.name}` : photo.name;
      return el("li", { title: caption }, picture, el("span", { textContent: caption }), out);
    })
  );
}

function showAside(failed) {
  const aside = shown.photographs.filter((photo) => photo.state === "aside");
  byId("aside-part").hidden = !aside.length && !failed.length;
  const key = [current(), shown.id, aside, failed.map((f) => [f.file.name, f.text])];
  fill(byId("aside"), key, () => [
    ...failed.map((failure) => {
      const again = el("button", { type: "button", textContent: t("try_again") });
      again.addEventListener("click", () => uploads.retry(shown.id, failure, () => (refresh(), hooks.poll())));
      const away = el("button", { type: "button", textContent: t("dismiss") });
      away.addEventListener("click", () => (uploads.dismiss(shown.id, failure), refresh()));
      return line(failure.file.name, failure.text, failure.lost ? again : null, away);
    }),
    ...aside.map((photo) => {
      const mine = { you: "use_again", second_mask: "use_mask", map: "use_map" }[photo.why];
      const back = mine ? el("button", { type: "button", textContent: t(mine) }) : null;
      back?.addEventListener("click", () => use(photo, true));
      return line(photo.name, t(`why_${photo.why}`, photo), back, null, photo.why !== "you");
    }),
  ]);
}

function line(name, text, first, second, problem = true) {
  const words = el("span", { className: problem ? "problem" : "" }, el("b", { textContent: name }), `: ${text}`);
  return el("li", {}, words, first, second);
}

async function use(photo, wanted) {
  try {
    await request("POST", path("/use"), { file: photo.file, use: wanted });
    hooks.poll();
  } catch (problem) {
    message(problem.message);
  }
}

function showAdvice() {
  const findings = (shown.ready && shown.found?.findings) || [];
  advice(byId("advice"), findings.filter((finding) => finding.kind !== "no object")); // the mask's step says so
}

/** Where the light is, of a finding that measured it, and the side opposite. */
function sides({ figures }) {
  if (figures?.azimuth === undefined) return {};
  const side = Math.round(figures.azimuth / 45);
  const name = (index) => t(`side_${((index % 8) + 8) % 8}`);
  return { side: name(side), other: name(side + 4) };
}

/** What was found wrong with the photographs. */
export function advice(list, findings) {
  fill(list, [current(), findings], () =>
    findings.map((finding) => {
      const key = `finding_${finding.kind}`;
      const words = t(key, { files: some(finding.files), ...sides(finding) });
      return el("li", { textContent: words === key ? finding.text : words });
    })
  );
}

async function estimate() {
  byId("estimate").disabled = true;
  const { id } = shown;
  try {
    await mask.settled();
    if (shown?.id !== id) return; // another object was opened meanwhile
    await request("POST", path("/estimate"), { name: byId("name").value, options: chosen() });
    window.scrollTo({ top: 0 });
  } catch (problem) {
    message(problem.message);
  }
  hooks.poll();
}
