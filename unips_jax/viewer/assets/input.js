// Mouse, touch, pen and keyboard on the stage.

/** Connects the stage's element with what it moves. */
function listen(element, stage, light, measure, stopTurning) {
  const pointers = new Map(); // those that are down: id -> place
  let press = null; // where a click may end
  let line = null; // where a line that is drawn begins: column and row

  const place = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  // A middle or right button, or Shift, moves the picture where a drag draws.
  const moves = (event) => event.shiftKey || (event.buttons & 6) > 0;

  element.addEventListener("pointerdown", (event) => {
    if (event.target.id === "divider") return;
    const at = place(event);
    pointers.set(event.pointerId, at);
    press = pointers.size === 1 && event.button === 0 ? at : null;
    line = null;
    stopTurning();
    if (event.pointerType !== "mouse" && stage.mode === "picture" && !measure.active) {
      light.follow(...at, stage.size);
    }
    if (stage.mode === "picture" && measure.drags && press && !event.shiftKey) line = stage.pixelAt(...at);
  });

  element.addEventListener("pointermove", (event) => {
    const at = place(event);
    const before = pointers.get(event.pointerId);
    const follows = !measure.active && (event.pointerType === "mouse" || stage.mode === "picture");
    if (before === undefined) {
      if (follows && event.pointerType === "mouse") light.follow(...at, stage.size);
      return;
    }
    if (press && Math.hypot(at[0] - press[0], at[1] - press[1]) > 5) press = null;
    if (stage.mode === "picture") {
      if (pointers.size === 2) pinch(event.pointerId, at);
      else if (line && !moves(event)) press ?? measure.drag(line, stage.pixelAt(...at));
      else if (event.pointerType === "mouse" || measure.active) pan(before, at);
      else if (follows) light.follow(...at, stage.size);
    }
    pointers.set(event.pointerId, at);
  });

  function pan(before, at) {
    const scale = stage.magnification;
    stage.moveBy((before[0] - at[0]) / scale, (before[1] - at[1]) / scale);
  }

  function pinch(id, at) {
    const [other] = [...pointers].filter(([key]) => key !== id).map(([, value]) => value);
    const before = pointers.get(id);
    const distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
    const middle = [(at[0] + other[0]) / 2, (at[1] + other[1]) / 2];
    pan([(before[0] + other[0]) / 2, (before[1] + other[1]) / 2], middle);
    stage.zoomBy(distance(at) / distance(before), ...middle);
  }

  for (const name of ["pointerup", "pointercancel", "pointerleave"]) {
    element.addEventListener(name, (event) => {
      const down = pointers.delete(event.pointerId);
      if (name === "pointerup" && down && press && measure.active) {
        measure.set(...stage.pixelAt(...place(event)));
      }
      press = line = null;
    });
  }
  element.addEventListener("contextmenu", (event) => event.preventDefault());

  listenToWheel(element, stage, place);

  element.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const arrows = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const arrow = arrows[event.key];
    if (arrow) {
      stopTurning();
      moveByKey(arrow, event.shiftKey);
    } else if (event.key === "+" || event.key === "=") stage.zoomBy(1.25);
    else if (event.key === "-") stage.zoomBy(0.8);
    else if (event.key === "0") stage.showWhole();
    else if (event.key === "Enter" && measure.active) {
      if (measure.showCross) measure.set(measure.cross[0] + 0.5, measure.cross[1] + 0.5);
    } else if (event.key === "Escape" && measure.active) measure.reset();
    else return;
    event.preventDefault();
  });

  function moveByKey([right, up], shift) {
    if (measure.active) measure.moveCross((shift ? 10 : 1) * right, (shift ? -10 : -1) * up);
    else if (stage.mode === "picture" && shift) pan([40 * right, -40 * up], [0, 0]);
    else if (stage.mode === "surface" && !shift) stage.turnBy(5 * right, 5 * up);
    else light.nudge(5 * right, 5 * up);
  }
}

/** The wheel zooms. Where it would scroll this page or one around it, it does so only
 * once the stage was clicked, until a click elsewhere. */
function listenToWheel(element, stage, place) {
  let clicked = false;
  const scrolls = () =>
    window.parent !== window || document.documentElement.scrollHeight > window.innerHeight + 1;
  document.addEventListener("pointerdown", (event) => (clicked = element.contains(event.target)), { capture: true });
  window.addEventListener("blur", () => (clicked = false));
  element.addEventListener("focus", () => (clicked ||= element.matches(":focus-visible")));
  let hiding;
  element.addEventListener(
    "wheel",
    (event) => {
      event.stopPropagation(); // before the surface's controls, which zoom otherwise
      if (!clicked && !event.ctrlKey && scrolls()) {
        byId("hint").hidden = false;
        clearTimeout(hiding);
        hiding = setTimeout(() => (byId("hint").hidden = true), 1500);
        return;
      }
      byId("hint").hidden = true;
      event.preventDefault();
      stage.zoomBy(Math.exp(-event.deltaY / 400), ...place(event));
    },
    { passive: false, capture: true }
  );
}

/** The line between both layers, moved by its own handle or by a slider. */
function listenToDivider(stage, moved) {
  const [divider, slider] = [byId("divider"), byId("split")];
  const drag = (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    const box = stage.canvas.getBoundingClientRect();
    slider.value = Math.round((1000 * (event.clientX - box.left)) / box.width);
    moved();
  };
  divider.addEventListener("pointerdown", (event) => {
    divider.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  divider.addEventListener("pointermove", drag);
  slider.addEventListener("input", moved);
}
