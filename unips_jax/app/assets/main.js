// Which object is shown; the server is asked again and again what is known of it.

import { request } from "./api.js";
import { byId, el, fill, message } from "./dom.js";
import * as draft from "./draft.js";
import * as exports from "./exports.js";
import { hover } from "./hover.js";
import * as mask from "./mask.js";
import * as result from "./result.js";
import * as text from "./text.js";
import * as uploads from "./uploads.js";

const { t } = text;
const STEPS = ["draft", "running", "ended", "done"];
const stepOf = (state) => ({ draft: "draft", waiting: "running", running: "running", done: "done" })[state] ?? "ended";

let object = null;
let timer = null;
let asking = false;
let askAgain = false;

const idOf = () => decodeURIComponent(location.hash.slice(1));

/** IDs of the objects that this browser made. */
const known = () => JSON.parse(localStorage.getItem("unips-objects") ?? "[]");
function remember(id) {
  localStorage.setItem("unips-objects", JSON.stringify([id, ...known().filter((other) => other !== id)].slice(0, 500)));
}

function poll() {
  if (asking) {
    askAgain = true;
    return;
  }
  clearTimeout(timer);
  ask();
}

async function ask() {
  asking = true;
  askAgain = false;
  let pause = 1000;
  const id = idOf();
  try {
    if (id) await askObject(id);
    else {
      showList(await request("GET", `/objects?ids=${known().join(",")}`));
      pause = 3000;
    }
    byId("connection").hidden = true;
    if (object?.state === "done") pause = 10000;
  } catch (problem) {
    if (problem.lost) byId("connection").hidden = false;
    else if (problem.status === 404) {
      if (id === idOf()) {
        message(problem.message);
        history.replaceState(null, "", "#"); // "back" would lead here again
        showHome();
      }
      askAgain = true;
    } else if (problem.status) message(problem.message);
    else console.error(problem);
  }
  asking = false;
  timer = setTimeout(ask, askAgain ? 100 : document.hidden ? 5 * pause : pause);
}

async function askObject(id) {
  const answer = await request("GET", `/objects/${encodeURIComponent(id)}`);
  if (id !== idOf()) return;
  const before = object;
  object = answer;
  remember(id);
  showObject();
  if (before?.id === id && before.state !== object.state) window.scrollTo({ top: 0 });
  if (before?.id !== id || stepOf(before.state) !== stepOf(object.state)) refocus("object");
}

/** Where what had the focus is gone, the heading has it: a screen reader goes on there. */
function refocus(part) {
  const active = document.activeElement;
  const lost = active === document.body || active.closest("[hidden]");
  if (lost && document.body.dataset.ready) byId(part).querySelector("h1").focus({ preventScroll: true });
}

function showObject() {
  const step = stepOf(object.state);
  byId("home").hidden = true;
  byId("object").hidden = false;
  for (const name of STEPS) byId(name).hidden = name !== step;
  byId("object-name").textContent = object.name;
  byId("object-name").classList.toggle("unseen", step === "draft");
  document.title = `${object.name} · unips`;
  if (step !== "running") byId("announced").textContent = step === "done" ? `${object.name}: ${t("state_done")}` : "";
  if (step === "draft") draft.show(object);
  else draft.leave();
  if (step === "running") result.showRunning(object);
  if (step === "ended") result.showEnded(object);
  if (step === "done") result.showDone(object);
}

function showHome() {
  object = null;
  draft.leave();
  byId("home").hidden = false;
  byId("object").hidden = true;
  document.title = t("title");
  byId("announced").textContent = "";
  refocus("home");
}

function showList({ objects }) {
  byId("list-part").hidden = !objects.length;
  fill(byId("list"), [text.current(), objects], () =>
    objects.map((item) => {
      const source = item.thumbnail && `/api/objects/${item.id}/pictures/${encodeURIComponent(item.thumbnail)}`;
      const picture = source ? el("img", { src: source, alt: "", loading: "lazy" }) : el("div", { className: "pending" });
      const words = `${t("count", { n: item.count })} · ${text.moment(item.time)}`;
      const state = el("span", { className: `state ${item.state}`, textContent: t(`state_${item.state}`) });
      const link = el("a", { href: `#${item.id}` }, picture, el("b", { textContent: item.name }), state, el("span", { className: "note", textContent: words }));
      const label = t("remove");
      const away = el("button", { type: "button", className: "x", textContent: "×", title: label, ariaLabel: `${label}: ${item.name}` });
      away.addEventListener("click", () => remove(item));
      return el("li", {}, link, away);
    })
  );
}

async function attempt(action) {
  try {
    await action();
  } catch (problem) {
    message(problem.message);
  }
  poll();
}

function remove(item) {
  attempt(async () => {
    await request("POST", `/objects/${item.id}/remove`);
    const home = idOf() === item.id;
    if (home) location.hash = "";
    message(t("removed", { name: item.name }), t("undo"), () =>
      attempt(async () => {
        await request("POST", `/objects/${item.id}/restore`);
        if (home) location.hash = item.id;
      })
    );
  });
}

async function begin(example, files, name) {
  const { id } = await uploads.begin(example, name);
  remember(id);
  if (files) draft.take(id, files);
  location.hash = id;
}

function build() {
  const select = byId("language");
  select.append(...text.languages().map(([value, name]) => el("option", { value, textContent: name })));
  select.value = text.current();
  select.addEventListener("change", () => {
    text.choose(select.value);
    text.apply();
    if (object) showObject();
    poll();
  });
  uploads.dropZone(byId("first-drop"), (files, name) => attempt(() => begin(false, files, name)));
  draft.build(poll);
  exports.build();
  byId("example").addEventListener("click", () => attempt(() => begin(true)));
  byId("cancel").addEventListener("click", () => attempt(() => request("POST", `/objects/${object.id}/cancel`)));
  for (const button of document.querySelectorAll("[data-do=again]")) {
    button.addEventListener("click", () =>
      attempt(async () => {
        const { id } = await request("POST", `/objects/${object.id}/again`);
        remember(id);
        location.hash = id;
      })
    );
  }
  for (const button of document.querySelectorAll("[data-do=remove]")) button.addEventListener("click", () => remove(object));
  text.apply();
}

function route() {
  if (!idOf()) showHome();
  window.scrollTo({ top: 0 });
  poll();
}

await text.load();
build();
route();
window.addEventListener("hashchange", route);
document.addEventListener("visibilitychange", () => document.hidden || poll());
window.addEventListener("online", poll);
window.addEventListener("keydown", (event) => event.key === "Escape" && message(""));
// A file dropped beside its place would replace the page.
for (const kind of ["dragover", "drop"]) window.addEventListener(kind, (event) => event.preventDefault());
window.addEventListener("beforeunload", (event) => {
  if (uploads.anyBusy() || !mask.flush()) event.preventDefault();
});
window.addEventListener("pagehide", () => mask.flush()); // phones know no other
hover(byId("hover"), "/assets/example.png").catch(() => {});
document.body.dataset.ready = "true";
