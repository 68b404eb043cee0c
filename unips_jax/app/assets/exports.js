// Files for a purpose, made from a result.

import { request } from "./api.js";
import { byId, el } from "./dom.js";
import { bytes, current, t } from "./text.js";

let shown = null; // the id of the object whose result it is

const buttons = () => [...document.querySelectorAll("[data-export]")];

export function build() {
  for (const button of buttons()) button.addEventListener("click", () => make(button));
}

export function show(object) {
  byId("exports").hidden = !object.results.length;
  if (shown === object.id) return;
  shown = object.id;
  byId("longest").value = "";
  byId("directx").checked = false;
  say("");
}

function say(text, problem = false) {
  byId("export-status").textContent = text;
  byId("export-status").classList.toggle("problem", problem);
}

async function make(pressed) {
  const purpose = pressed.dataset.export;
  const id = shown;
  const field = byId("longest");
  const given = field.value.trim();
  if (!field.validity.valid || (given && !(Number(given) > 0))) return say(t("problem_length"), true);
  for (const button of buttons()) button.disabled = true;
  say(t("export_making"));
  try {
    const wish = { purpose, directx: byId("directx").checked, longest_mm: given ? Number(given) : null };
    const made = await request("POST", `/objects/${id}/exports`, wish);
    const link = el("a", { href: `/api/objects/${id}/exports/${encodeURIComponent(made.file)}?${Date.now()}`, download: "" });
    link.click();
    if (id === shown) say(facts(made, given));
  } catch (problem) {
    if (id === shown) say(problem.message, true);
  } finally {
    for (const button of buttons()) button.disabled = false;
    if (document.activeElement === document.body) pressed.focus({ preventScroll: true });
  }
  return undefined;
}

function facts(made, given) {
  const number = (value) => value.toLocaleString(current(), { maximumSignificantDigits: 4 });
  const words = [t("export_saved", { file: made.file, bytes: bytes(made.bytes) })];
  if (made.faces) {
    words.push(t("export_faces", { n: made.faces.toLocaleString(current()) }));
    words.push(t(given ? "export_side" : "export_side_unknown", { side: `${number(made.longest_side)} ${made.unit}` }));
  }
  return words.join(" ");
}
