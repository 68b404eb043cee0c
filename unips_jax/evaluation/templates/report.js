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

// Sheets: enlarged in a dialog, zoomed by the wheel, moved by dragging.
const dialog = byId("zoom");
if (dialog) {
  const image = dialog.querySelector("img");
  let scale = 1, x = 0, y = 0, held = null;
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
  dialog.addEventListener("wheel", (event) => {
    event.preventDefault();
    const factor = Math.exp(-event.deltaY / 400);
    x = event.clientX - (event.clientX - x) * factor;
    y = event.clientY - (event.clientY - y) * factor;
    scale *= factor;
    place();
  }, { passive: false });
  dialog.addEventListener("dblclick", fit);
  image.addEventListener("pointerdown", (event) => {
    held = [event.clientX - x, event.clientY - y];
    image.setPointerCapture(event.pointerId);
  });
  image.addEventListener("pointermove", (event) => {
    if (!held) return;
    [x, y] = [event.clientX - held[0], event.clientY - held[1]];
    place();
  });
  image.addEventListener("pointerup", () => { held = null; });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
}
