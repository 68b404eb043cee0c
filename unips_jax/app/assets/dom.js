// Small helps for the page's elements.

export const byId = (name) => document.getElementById(name);

/** An element with properties and children. */
export function el(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children.filter((child) => child !== null));
  return element;
}

export async function image(source) {
  const loaded = new Image();
  loaded.src = source;
  await loaded.decode();
  return loaded;
}

/** Replaces an element's children, unless what they show is the same; the focus stays in
 * its place. */
export function fill(element, key, children) {
  const text = JSON.stringify(key);
  if (element.dataset.key === text) return;
  element.dataset.key = text;
  const controls = () => [...element.querySelectorAll("a, button")];
  const at = controls().indexOf(document.activeElement);
  element.replaceChildren(...children());
  if (at >= 0) controls()[Math.min(at, controls().length - 1)]?.focus({ preventScroll: true });
}

export function message(text, button, action) {
  const bar = byId("message");
  bar.querySelector("span").textContent = text;
  const does = bar.querySelector("button");
  does.hidden = !button;
  does.textContent = button ?? "";
  does.onclick = () => {
    bar.hidden = true;
    action?.();
  };
  bar.hidden = !text;
  clearTimeout(message.timer);
  // By keys the way to its button takes longer.
  const byKeys = button && document.querySelector(":focus-visible");
  if (!byKeys) message.timer = setTimeout(() => (bar.hidden = true), 12000);
}
