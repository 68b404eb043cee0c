// What a reader adds: notes at places, views to come back to. Saved with the file.

const MOST_LETTERS = 40; // of a note over the picture

/** Lists of notes and views, and their fields in the settings. */
class Notes {
  #unsaved = false;

  /** `capture` gives what is shown as a view's state, `restore` shows one. */
  constructor(stage, { capture, restore }) {
    this.stage = stage;
    this.capture = capture;
    this.restore = restore;
    this.notes = (kept.notes ?? []).map((note) => ({ ...note, place: keptPlace(note.place) }));
    this.views = (kept.views ?? []).map(({ name, state }) => ({
      name,
      state: { ...state, center: keptPlace(state.center) },
    }));
    byId("add-view").addEventListener("click", () => this.addView());
    byId("notes-shown").addEventListener("input", () => stage.changed());
    window.addEventListener("beforeunload", (event) => this.unsaved && event.preventDefault());
  }

  get unsaved() {
    return this.#unsaved;
  }

  /** Is shown, and told a page around this one, which may keep it until they are saved. */
  set unsaved(value) {
    this.#unsaved = value;
    byId("unsaved").hidden = !value;
    parent.postMessage({ unsaved: value }, "*");
  }

  /** A note at a place of the picture; its field waits for the text. */
  add(place) {
    this.notes.push({ place: resultPlace(place), text: "" });
    this.changed();
    byId("notes-list").lastElementChild.querySelector("input").focus();
  }

  addView() {
    this.views.push({ name: say("view_name", this.views.length + 1), state: this.capture() });
    this.changed();
  }

  changed() {
    this.unsaved = true;
    this.fill();
    this.stage.changed();
  }

  /** What the file keeps. */
  get values() {
    const { notes, views } = this;
    return { size: resultSize, scale: { mm: scale.mm, ...measured }, notes, views };
  }

  /** Fills both lists. */
  fill() {
    byId("other-shape").hidden = sameShape;
    byId("other-shape").textContent = say("other_shape", kept.size);
    byId("no-notes").hidden = this.notes.length > 0;
    byId("notes-shown").parentElement.hidden = this.notes.length === 0;
    this.list(byId("notes-list"), this.notes, "text", (note) => this.goTo(note));
    this.list(byId("views-list"), this.views, "name", (view) => this.restore(view.state));
  }

  list(element, items, field, show) {
    const rows = items.map((item, index) => {
      const row = document.createElement("li");
      const go = button(field === "text" ? String(index + 1) : "▶", say("show_item", index + 1));
      const input = document.createElement("input");
      input.value = item[field];
      input.placeholder = say(`${field}_hint`);
      input.setAttribute("aria-label", say(`${field}_label`, index + 1));
      const drop = button("×", say("drop_item", index + 1));
      go.addEventListener("click", () => show(item));
      drop.addEventListener("click", () => {
        items.splice(items.indexOf(item), 1);
        this.changed();
        const next = element.children[Math.min(index, items.length - 1)];
        (next?.lastElementChild ?? byId("add-view")).focus(); // not lost with the row
      });
      input.addEventListener("input", () => {
        item[field] = input.value;
        this.unsaved = true;
        this.stage.changed();
      });
      row.append(go, input, drop);
      return row;
    });
    element.replaceChildren(...rows);
  }

  /** Brings a note to the middle of the picture. */
  goTo(note) {
    const place = picturePlace(note.place);
    this.stage.moveBy(...place.map((value, axis) => value - this.stage.center[axis]));
  }

  /** The notes' places and texts, as parts of the overlay. */
  parts() {
    if (!byId("notes-shown").checked) return [];
    return this.notes.flatMap(({ place, text }, index) => {
      const at = picturePlace(place);
      const screen = this.stage.mode === "picture" ? this.stage.screenAt(...at) : this.stage.solidAt(...at);
      if (!screen) return [];
      const [x, y] = screen;
      const left = x > this.stage.size[0] / 2; // where there is more room
      const room = (left ? x : this.stage.size[0] - x) - 40; // a letter takes some 8
      const most = Math.min(MOST_LETTERS, Math.max(3, Math.floor(room / 8)));
      const letters = [...text]; // not units of UTF-16, of which an emoji has two
      const shown = letters.length > most ? `${letters.slice(0, most - 1).join("")}…` : text;
      const pin = `M${x} ${y}L${x - 6} ${y - 14}A7 7 0 1 1 ${x + 6} ${y - 14}Z`;
      const words = label(x + (left ? -12 : 12), y - 12, `${index + 1}  ${shown}`);
      if (left) words.setAttribute("text-anchor", "end");
      return [...marked("path", { d: pin }), words];
    });
  }
}

function button(text, name) {
  const element = Object.assign(document.createElement("button"), { type: "button", textContent: text });
  element.setAttribute("aria-label", name);
  return element;
}
