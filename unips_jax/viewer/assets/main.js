// The page: loads the pictures, fills the menus, connects everything.

/** All layers that this file has: name, kind, texture, and how it is called. */
function layersOf(textures) {
  const layers = ["lit", "environment", "normals"].map((kind) => ({ id: kind, kind, title: () => say(`layer_${kind}`) }));
  for (const kind of ["depth", "confidence"]) {
    if (data[kind]) layers.push({ id: kind, kind, title: () => say(`layer_${kind}`) });
  }
  if (data.color) {
    const title = () => say(`layer_${data.color.kind}`);
    layers.push({ id: "color", kind: "picture", texture: async () => textures.color, title });
  }
  data.photographs.forEach(({ name, image }, index) => {
    let made = null; // decoded when first shown
    const texture = () => (made ??= picture(image).then((loaded) => textureOf(loaded)));
    layers.push({ id: `photograph-${index}`, kind: "picture", texture, title: () => name });
  });
  return layers;
}

async function start() {
  const images = {};
  for (const [name, source] of [
    ["normals", data.normals],
    ["color", data.color?.image],
    ["depth", data.depth?.image],
    ["confidence", data.confidence?.image],
  ]) {
    if (source) images[name] = await picture(source);
  }
  const normalBytes = bytesOf(images.normals);
  const depthBytes = images.depth ? bytesOf(images.depth) : null;
  const textures = {};
  for (const [name, image] of Object.entries(images)) {
    textures[name] = textureOf(image, { exact: name === "depth" });
  }
  for (const name of ["color", "depth", "confidence"]) textures[name] ??= textures.normals;

  const stage = new Stage(byId("canvas"), textures, depthBytes);
  const measure = new Measure(stage, normalBytes, depthBytes);
  const light = new Light((direction) => {
    stage.shared.light.value.set(...direction);
    stage.changed();
  });
  const layers = layersOf(textures);
  connectLayers(stage, layers);
  connectLight(stage, normalBytes);
  const page = connectTools(stage, measure);
  listen(byId("stage"), stage, light, measure, page.stopTurning);
  const notes = new Notes(stage, viewStates(stage, light, page));
  measure.onNote = (place) => notes.add(place);
  connectSaving(stage, notes, normalBytes);

  const translate = () => {
    texts(layers);
    light.apply();
    measure.tell();
    page.describe();
    notes.fill();
    byId("left").dispatchEvent(new Event("change"));
  };
  connectScale(measure, () => {
    translate();
    notes.changed();
  });
  byId("language").value = language;
  byId("language").addEventListener("change", () => {
    language = byId("language").value;
    translate();
  });
  stage.onDrawn = () => byId("overlay").replaceChildren(...measure.parts(), ...notes.parts(), ...scaleBar(stage));
  translate();
  stage.draw();
  document.body.dataset.ready = "true";
}

/** Menus of layers, the line between two, its labels and the legend. */
function connectLayers(stage, layers) {
  const [left, right, split] = [byId("left"), byId("right"), byId("split")];
  const find = (select) => layers.find((layer) => layer.id === select.value);
  right.append(new Option("", ""));
  layers.forEach((layer) => {
    left.append(new Option("", layer.id));
    right.append(new Option("", layer.id));
  });

  const moved = () => {
    const two = right.value !== "";
    stage.split = two ? split.value / 1000 : 1;
    byId("divider").style.left = `${split.value / 10}%`;
    split.setAttribute("aria-valuetext", `${Math.round(split.value / 10)} %`);
    for (const part of [split, byId("divider"), byId("tag-left"), byId("tag-right")]) part.hidden = !two;
    stage.changed();
  };
  const chosen = async () => {
    for (const [side, select] of Object.entries({ left, right })) {
      const layer = find(select);
      const material = stage[side];
      if (!layer) continue;
      stage.layers[side] = layer;
      if (layer.texture) {
        const texture = await layer.texture();
        if (find(select) !== layer) continue; // another was chosen meanwhile
        material.uniforms.pictureMap.value = texture;
      }
      material.uniforms.kind.value = KINDS[layer.kind];
    }
    byId("tag-left").textContent = find(left).title();
    byId("tag-right").textContent = find(right)?.title() ?? "";
    legend([find(left), find(right)]);
    moved();
  };
  left.addEventListener("change", chosen);
  right.addEventListener("change", chosen);
  listenToDivider(stage, moved);
}

/** What the colours of depth and of the spread mean, if they are shown. */
function legend(layers) {
  const parts = [];
  for (const kind of ["depth", "confidence"]) {
    if (!layers.some((layer) => layer?.kind === kind)) continue;
    const bar = document.createElement("i");
    const colors = data.palettes[kind].map((rgb) => `rgb(${rgb.map((c) => Math.round(255 * c)).join(" ")})`);
    bar.style.background = `linear-gradient(90deg, ${colors.join(", ")})`;
    const ends = document.createElement("div");
    const { near, far } = data.depth ?? {};
    const texts =
      kind === "depth"
        ? [say("far"), scale.text(far - near, 2), say("near")]
        : ["0°", say("layer_confidence"), `${number(data.confidence.top, 0)}°`];
    ends.append(...texts.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
    parts.push(bar, ends);
  }
  byId("legend").hidden = parts.length === 0;
  byId("legend").replaceChildren(...parts);
}

function connectLight(stage, normalBytes) {
  const environment = byId("environment");
  Object.keys(data.environments).forEach((name) => environment.append(new Option("", name)));
  const apply = () => {
    stage.shared.gloss.value = byId("gloss").value / 100;
    stage.shared.colored.value = byId("colored").checked && data.color !== null;
    const light = data.environments[environment.value];
    light.forEach((rgb, index) => stage.shared.harmonics.value[index].set(...rgb));
    stage.changed();
  };
  byId("detail").addEventListener("input", () => {
    const share = byId("detail").value / 100;
    if (share && !stage.hasDetail) {
      stage.hasDetail = true; // made when it is first wanted
      stage.shared.aroundMap.value = meansAround(normalBytes);
    }
    stage.shared.detail.value = 4 * share;
    stage.changed();
  });
  byId("colored").disabled = data.color === null;
  for (const name of ["gloss", "colored", "environment"]) byId(name).addEventListener("input", apply);
  environment.addEventListener("input", () => {
    const shown = [byId("left").value, byId("right").value];
    if (shown.includes("environment")) return;
    byId("left").value = "environment"; // what was chosen is shown
    byId("left").dispatchEvent(new Event("change"));
  });
  apply();
}

/** Buttons over the stage. */
function connectTools(stage, measure) {
  const press = (group, name, value) => {
    for (const button of byId(group).children) {
      button.setAttribute("aria-pressed", String(button.dataset[name] === value));
    }
  };
  const describe = () => {
    const what = measure.active ? measure.tool : stage.mode === "surface" ? "surface" : "light";
    byId("keys").textContent = say(`keys_${what}`);
    byId("turning").hidden = stage.mode !== "surface";
    byId("turning").setAttribute("aria-pressed", String(stage.turning && stage.mode === "surface"));
  };
  const turn = (on) => {
    if (!stage.solid) return;
    stage.setTurning(on);
    describe();
  };
  const mode = (value) => {
    const first = !stage.solid;
    if (value === "surface" && measure.active) tool("light");
    stage.setMode(value);
    press("modes", "mode", value);
    const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (value === "surface" && first && !still) stage.setTurning(true);
    describe();
  };
  const tool = (value) => {
    if (value !== "light" && stage.mode === "surface") mode("picture");
    measure.setTool(value);
    press("tools", "tool", value);
    describe();
  };
  for (const button of byId("modes").children) button.addEventListener("click", () => mode(button.dataset.mode));
  for (const button of byId("tools").children) button.addEventListener("click", () => tool(button.dataset.tool));
  if (!data.depth) {
    document.querySelector("[data-mode=surface]").hidden = true;
    document.querySelector("[data-tool=profile]").hidden = true;
  }
  byId("nearer").addEventListener("click", () => stage.zoomBy(1.25));
  byId("farther").addEventListener("click", () => stage.zoomBy(0.8));
  byId("whole").addEventListener("click", () => stage.showWhole());
  byId("turning").addEventListener("click", () => turn(!stage.turning));
  stage.onTooSlow = () => turn(false);
  return { describe, mode, stopTurning: () => stage.turning && turn(false) };
}

/** The length between two points gives everything a unit. */
function connectScale(measure, changed) {
  const field = byId("millimetres");
  const apply = () => {
    const length = Number(field.value.replace(",", "."));
    if (!(length > 0) || !Number.isFinite(length) || !(measure.distance > 0)) return field.focus();
    scale.mm = length / measure.distance;
    changed();
  };
  byId("apply-scale").addEventListener("click", apply);
  field.addEventListener("keydown", (event) => event.key === "Enter" && apply());
  byId("drop-scale").addEventListener("click", () => {
    scale.mm = null;
    changed();
  });
}

/** What is shown as values to keep, and shown again from them. */
function viewStates(stage, light, page) {
  const fields = ["left", "right", "split", "gloss", "detail", "environment"];
  const capture = () => ({
    mode: stage.mode,
    ...Object.fromEntries(fields.map((name) => [name, byId(name).value])),
    colored: byId("colored").checked,
    light: [light.azimuth, light.elevation],
    zoom: stage.zoom,
    center: resultPlace(stage.center),
    camera: stage.solid && {
      position: stage.camera.position.toArray().map((value) => value / stage.solid.geometry.userData.radius),
      target: stage.controls.target.toArray().map((value) => value / stage.solid.geometry.userData.radius),
    },
  });
  const restore = (state) => {
    page.mode(state.mode === "surface" && data.depth ? "surface" : "picture");
    page.stopTurning();
    for (const name of fields) byId(name).value = state[name];
    byId("left").value ||= "lit"; // a layer that is no more
    byId("right").value ||= "";
    const left = byId("left").value;
    byId("colored").checked = state.colored;
    for (const name of ["left", "environment", "gloss", "detail", "split"]) {
      byId(name).dispatchEvent(new Event(name === "left" ? "change" : "input"));
    }
    byId("left").value = left; // the environment's field may have changed it
    byId("left").dispatchEvent(new Event("change"));
    [light.azimuth, light.elevation] = state.light;
    light.apply();
    stage.zoom = state.zoom;
    stage.center = picturePlace(state.center);
    stage.moveBy(0, 0);
    if (stage.mode === "surface" && state.camera) {
      const { radius } = stage.solid.geometry.userData;
      stage.controls.target.set(...state.camera.target.map((value) => value * radius));
      stage.camera.position.set(...state.camera.position.map((value) => value * radius));
      stage.controls.update();
    }
    stage.changed();
  };
  return { capture, restore };
}

/** Puts all texts in the chosen language. */
function texts(layers) {
  document.documentElement.lang = language;
  for (const element of document.querySelectorAll("[data-text]")) {
    element.textContent = say(element.dataset.text);
  }
  for (const element of document.querySelectorAll("[data-label]")) {
    element.setAttribute("aria-label", say(element.dataset.label));
  }
  for (const option of byId("environment").options) option.textContent = say(`environment_${option.value}`);
  for (const select of [byId("left"), byId("right")]) {
    for (const option of select.options) {
      option.textContent = layers.find((layer) => layer.id === option.value)?.title() ?? say("nothing");
    }
  }
  const facts = data.facts.flatMap(([key, value]) => {
    const term = Object.assign(document.createElement("dt"), { textContent: say(`fact_${key}`) });
    const shown = [].concat(value).join("; ");
    return [term, Object.assign(document.createElement("dd"), { textContent: shown })];
  });
  byId("facts").replaceChildren(...facts);
}

/** Where nothing can be drawn: a reason, and the normals as a picture. */
function fail(error) {
  const context = document.createElement("canvas").getContext("webgl2");
  byId("failure").textContent = context ? say("broken", error.message) : say("no_webgl");
  byId("failure").hidden = false;
  texts([]);
  // What would do nothing now.
  const idle = "header label, .bar, #divider, .tag, #settings > :not(details)";
  for (const element of document.querySelectorAll(idle)) element.hidden = true;
  byId("canvas").replaceWith(Object.assign(new Image(), { src: data.normals, alt: say("layer_normals") }));
}

start().catch(fail);
window.unipsRuns = true;
