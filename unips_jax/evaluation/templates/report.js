"use strict";

// Tables: a click on a heading sorts; "#sort=TABLE.COLUMN" or "...desc" does at start.
function cellKey(row, column) {
  const cell = row.cells[column];
  if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
  return cell.textContent === "–" ? null : cell.textContent;
}

function compare(a, b) {
  if (a === null || b === null) return (a === null) - (b === null);
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
  return typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true });
}

function sortTable(table, column, descending) {
  const sign = descending ? -1 : 1;
  // Each body for itself: what was published stays apart.
  for (const body of table.querySelectorAll("tbody:not(.heading)")) {
    const rows = [...body.rows];
    rows.sort((first, second) => {
      const a = cellKey(first, column), b = cellKey(second, column);
      return a === null || b === null ? compare(a, b) : sign * compare(a, b);
    });
    body.append(...rows);
  }
  for (const heading of table.tHead.rows[0].cells) heading.removeAttribute("aria-sort");
  const order = descending ? "descending" : "ascending";
  table.tHead.rows[0].cells[column].setAttribute("aria-sort", order);
}

for (const table of document.querySelectorAll("table")) {
  [...table.tHead.rows[0].cells].forEach((heading, column) => {
    heading.querySelector("button").addEventListener("click", () => {
      sortTable(table, column, heading.getAttribute("aria-sort") === "ascending");
    });
  });
}

const asked = /^#sort=([\w-]+)\.(\d+)(\.desc)?$/.exec(location.hash);
if (asked) {
  const table = document.querySelector(`table[data-name="${asked[1]}"]`);
  if (table) sortTable(table, Number(asked[2]), Boolean(asked[3]));
}

// Legends: pointing at a method shows its line alone, a click hides or shows it.
for (const chart of document.querySelectorAll(".chart")) {
  for (const button of chart.querySelectorAll(".legend button")) {
    const line = chart.querySelector(`[id$="-${button.dataset.line}"]`);
    const light = (on) => {
      chart.classList.toggle("picked", on);
      line.classList.toggle("lit", on);
    };
    for (const event of ["pointerenter", "focus"]) button.addEventListener(event, () => light(true));
    for (const event of ["pointerleave", "blur"]) button.addEventListener(event, () => light(false));
    button.addEventListener("click", () => {
      const shown = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", shown);
      line.classList.toggle("off", !shown);
    });
  }
}

// The slider between truth and estimate.
const pictures = JSON.parse(document.getElementById("pictures").textContent);
const byId = (id) => document.getElementById(id);

function option(text, value) {
  const made = document.createElement("option");
  made.textContent = text;
  made.value = value;
  return made;
}

function showPair() {
  const { truth, estimates } = pictures[byId("object").value];
  const estimate = estimates[byId("method").value];
  byId("truth").src = truth;
  byId("estimate").src = estimate.normals;
  byId("errors").src = estimate.errors;
  byId("line").textContent = `${estimate.label}: ${estimate.line}`;
}

function showMethods() {
  const wanted = byId("method").selectedOptions[0]?.textContent;
  const { estimates } = pictures[byId("object").value];
  byId("method").replaceChildren(...estimates.map((e, i) => option(e.label, i)));
  byId("method").value = Math.max(0, estimates.findIndex((e) => e.label === wanted));
  showPair();
}

if (byId("compare")) {
  if (pictures.length) {
    byId("object").append(...pictures.map((p, i) => option(p.name, i)));
    byId("object").addEventListener("change", showMethods);
    byId("method").addEventListener("change", showPair);
    byId("divide").addEventListener("input", (event) => {
      event.target.parentElement.style.setProperty("--at", `${event.target.value}%`);
    });
    showMethods();
  } else {
    byId("compare").hidden = true;
  }
}

// Sheets: enlarged in a dialog, zoomed by the wheel, fingers or keys, moved by dragging.
const dialog = byId("zoom");
if (dialog) {
  const image = dialog.querySelector("img");
  let scale = 1, x = 0, y = 0;
  const held = new Map(); // pointers that are down: id -> place
  const place = () => { image.style.transform = `translate(${x}px, ${y}px) scale(${scale})`; };
  const fit = () => {
    scale = Math.min(innerWidth / image.naturalWidth, innerHeight / image.naturalHeight);
    x = (innerWidth - scale * image.naturalWidth) / 2;
    y = (innerHeight - scale * image.naturalHeight) / 2;
    place();
  };
  image.addEventListener("load", fit);
  for (const button of document.querySelectorAll(".sheet")) {
    button.addEventListener("click", () => {
      image.src = button.querySelector("img").src;
      dialog.showModal();
      if (image.complete) fit();
    });
  }
  const move = (right, down) => {
    x += right;
    y += down;
    place();
  };
  const zoom = (factor, atX = innerWidth / 2, atY = innerHeight / 2) => {
    scale *= factor;
    move((atX - x) * (1 - factor), (atY - y) * (1 - factor));
  };
  dialog.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 400), event.clientX, event.clientY);
  }, { passive: false });
  dialog.addEventListener("dblclick", fit);
  dialog.addEventListener("keydown", (event) => {
    const arrow = { ArrowRight: [-1, 0], ArrowLeft: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (arrow) move(40 * arrow[0], 40 * arrow[1]);
    else if (event.key === "+" || event.key === "=") zoom(1.25);
    else if (event.key === "-") zoom(0.8);
    else if (event.key === "0") fit();
    else return;
    event.preventDefault();
  });
  image.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    image.setPointerCapture(event.pointerId);
  });
  image.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const at = [event.clientX, event.clientY];
    held.set(event.pointerId, at);
    if (held.size === 1) return move(at[0] - before[0], at[1] - before[1]);
    const [other] = [...held].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
    const distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
    zoom(distance(at) / distance(before), ...other);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    image.addEventListener(name, (event) => held.delete(event.pointerId));
  }
  dialog.querySelector("button").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
}
