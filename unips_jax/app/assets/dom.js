// Small helps for the page's elements.

export const byId = (name) => document.getElementById(name);

/** An element with properties and children. */
export function el(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children.filter((child) => child !== null));
  return element;
}

/** Replaces an element's children, unless what they show is the same. */
export function fill(element, key, children) {
  const text = JSON.stringify(key);
  if (element.dataset.key === text) return;
  element.dataset.key = text;
  element.replaceChildren(...children());
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
  message.timer = setTimeout(() => (bar.hidden = true), 12000);
}
