// The mask's editor: a brush, a box that the server cuts out, undo. Plain DOM.

"use strict";

window.unipsMask = (() => {
  const SIDE = 1024;
  let canvas, context, picture, mask, tool, history, cursor, stroke, address;

  const pixelsOf = (c) => c.getContext("2d", { willReadFrequently: true });
  const byId = (name) => document.getElementById(name);
  const tell = (text) => (byId("mask-status").textContent = text);

  async function image(source) {
    const loaded = new Image();
    loaded.src = source;
    await loaded.decode();
    return loaded;
  }

  /** Shows the picture, and the mask that is known of it, if there is one. */
  async function load(base, maskName) {
    address = base;
    picture = await image(`${base}/about/picture.jpg?${Date.now()}`);
    canvas = byId("mask-canvas");
    const scale = Math.min(1, SIDE / Math.max(picture.width, picture.height));
    canvas.width = Math.round(picture.width * scale);
    canvas.height = Math.round(picture.height * scale);
    context = canvas.getContext("2d");
    mask = document.createElement("canvas");
    mask.width = canvas.width;
    mask.height = canvas.height;
    history = [];
    cursor = null;
    stroke = null;
    if (maskName) await take(`${base}/about/${maskName}?${Date.now()}`);
    choose("add");
    listen();
    draw();
    byId("mask-editor").dataset.ready = "true";
  }

  /** Takes a mask from the server: white is the object. */
  async function take(source) {
    const loaded = await image(source);
    const c = pixelsOf(mask);
    c.clearRect(0, 0, mask.width, mask.height);
    c.drawImage(loaded, 0, 0, mask.width, mask.height);
    const pixels = c.getImageData(0, 0, mask.width, mask.height);
    for (let at = 0; at < pixels.data.length; at += 4) {
      const inside = pixels.data[at] > 127 && pixels.data[at + 3] > 127;
      pixels.data.fill(255, at, at + 3);
      pixels.data[at + 3] = inside ? 255 : 0;
    }
    c.putImageData(pixels, 0, 0);
  }

  function remember() {
    history.push(pixelsOf(mask).getImageData(0, 0, mask.width, mask.height));
    if (history.length > 20) history.shift();
  }

  function undo() {
    const before = history.pop();
    if (before) pixelsOf(mask).putImageData(before, 0, 0);
    draw();
  }

  function fill(inside) {
    remember();
    const c = pixelsOf(mask);
    c.clearRect(0, 0, mask.width, mask.height);
    c.fillStyle = "#fff";
    if (inside) c.fillRect(0, 0, mask.width, mask.height);
    draw();
  }

  function choose(name) {
    tool = name;
    for (const button of document.querySelectorAll("[data-mask-tool]")) {
      button.setAttribute("aria-pressed", String(button.dataset.maskTool === name));
    }
  }

  /** The picture, dark where it is not the object. */
  function draw() {
    context.globalCompositeOperation = "source-over";
    context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    const veil = document.createElement("canvas");
    veil.width = canvas.width;
    veil.height = canvas.height;
    const v = veil.getContext("2d");
    v.fillStyle = "rgb(30 0 45 / 85%)";
    v.fillRect(0, 0, veil.width, veil.height);
    v.globalCompositeOperation = "destination-out";
    v.drawImage(mask, 0, 0);
    context.drawImage(veil, 0, 0);
    if (stroke && tool === "box") {
      const [x, y, w, h] = rectangle();
      context.setLineDash([6, 4]);
      context.strokeStyle = "#ffe066";
      context.lineWidth = 2;
      context.strokeRect(x, y, w, h);
    }
    if (cursor) {
      context.setLineDash([]);
      context.strokeStyle = "#ffe066";
      context.lineWidth = 2;
      context.beginPath();
      context.arc(...cursor, brush() / 2, 0, 2 * Math.PI);
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

  /** GrabCut in the box, by the server. */
  async function cut() {
    const [x, y, w, h] = rectangle().map((value) => (value * picture.width) / canvas.width);
    if (w < 8 || h < 8) return tell("The box is too small.");
    tell("Looking for the object in the box …");
    const answer = await fetch(`${address}/cut?left=${x}&top=${y}&right=${x + w}&bottom=${y + h}`);
    if (!answer.ok) return tell(await answer.text());
    remember();
    await take(`${address}/about/cut.png?${Date.now()}`);
    tell("This is the object as found in the box.");
    draw();
  }

  function place(event) {
    const box = canvas.getBoundingClientRect();
    return [
      ((event.clientX - box.left) * canvas.width) / box.width,
      ((event.clientY - box.top) * canvas.height) / box.height,
    ];
  }

  function listen() {
    if (canvas.dataset.listening) return;
    canvas.dataset.listening = "true";
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const at = place(event);
      stroke = { from: at, to: at };
      if (tool !== "box") {
        remember();
        paint(at, at);
      }
      draw();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!stroke) return;
      const at = place(event);
      if (tool !== "box") paint(stroke.to, at);
      stroke.to = at;
      draw();
    });
    canvas.addEventListener("pointerup", async () => {
      if (stroke && tool === "box") await cut();
      stroke = null;
      draw();
    });
    canvas.addEventListener("keydown", (event) => {
      const arrows = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      const arrow = arrows[event.key];
      cursor ??= [canvas.width / 2, canvas.height / 2];
      const before = [...cursor];
      if (arrow) {
        const limits = [canvas.width, canvas.height];
        cursor = cursor.map((value, axis) =>
          Math.min(Math.max(value + (arrow[axis] * brush()) / 2, 0), limits[axis])
        );
        if (event.shiftKey && tool !== "box") paint(before, cursor);
      } else if (event.key === " " && tool !== "box") {
        remember();
        paint(cursor, cursor);
      } else if (event.key === "z") undo();
      else return;
      event.preventDefault();
      draw();
    });
    for (const button of document.querySelectorAll("[data-mask-tool]")) {
      button.addEventListener("click", () => choose(button.dataset.maskTool));
    }
    byId("mask-undo").addEventListener("click", undo);
    byId("mask-clear").addEventListener("click", () => fill(false));
    byId("mask-all").addEventListener("click", () => fill(true));
  }

  /** Sends the mask; resolves to "drawn", or "none" if nothing is left out. */
  async function send() {
    const data = pixelsOf(mask).getImageData(0, 0, mask.width, mask.height).data;
    let inside = 0;
    for (let at = 3; at < data.length; at += 4) inside += data[at] > 127;
    if (inside === 0) return "empty";
    if (inside === data.length / 4) return "none";
    const sent = document.createElement("canvas");
    sent.width = mask.width;
    sent.height = mask.height;
    const c = sent.getContext("2d");
    c.fillRect(0, 0, sent.width, sent.height);
    c.drawImage(mask, 0, 0);
    const blob = await new Promise((done) => sent.toBlob(done, "image/png"));
    const answer = await fetch(`${address}/mask`, { method: "PUT", body: blob });
    return answer.ok ? "drawn" : "failed";
  }

  return { load, send };
})();
