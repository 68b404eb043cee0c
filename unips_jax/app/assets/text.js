// The page's words, in the visitor's language.

let table = {};
let language = "en";

export const languages = () => Object.entries(table).map(([code, words]) => [code, words.language_name]);
export const current = () => language;

export async function load() {
  table = await (await fetch("/assets/strings.json")).json();
  const wished = [localStorage.getItem("unips-language"), ...navigator.languages];
  language = wished.map((w) => w?.slice(0, 2)).find((w) => w in table) ?? "en";
}

export function choose(code) {
  language = code;
  localStorage.setItem("unips-language", code);
}

/** A text with its gaps {name} filled; `key_one` where values.n is 1. */
export function t(key, values = {}) {
  const words = table[language];
  const text = (values.n === 1 && words[`${key}_one`]) || words[key] || key;
  return text.replace(/\{(\w+)\}/g, (gap, name) => values[name] ?? gap);
}

export const knows = (key) => key in table[language];

/** Fills in the words of all elements that have data-t or data-t-label. */
export function apply(root = document) {
  document.documentElement.lang = language;
  for (const element of root.querySelectorAll("[data-t]")) element.textContent = t(element.dataset.t);
  for (const element of root.querySelectorAll("[data-t-title]")) element.title = t(element.dataset.tTitle);
  for (const element of root.querySelectorAll("[data-t-label]")) {
    element.setAttribute("aria-label", t(element.dataset.tLabel));
  }
}

/** Names, the first few and how many more. */
export function some(names, limit = 4) {
  const shown = names.slice(0, limit).join(", ");
  return names.length > limit ? `${shown} ${t("and_more", { n: names.length - limit })}` : shown;
}

export function bytes(count) {
  const [value, unit] = count < 1e6 ? [Math.max(count / 1e3, 1), "kB"] : [count / 1e6, "MB"];
  return `${value.toLocaleString(language, { maximumFractionDigits: value < 10 ? 1 : 0 })} ${unit}`;
}

export function moment(seconds) {
  return new Date(seconds * 1000).toLocaleString(language, { dateStyle: "medium", timeStyle: "short" });
}

export function duration(seconds) {
  return seconds < 100 ? t("seconds", { n: Math.max(1, Math.round(seconds)) }) : t("minutes", { n: Math.round(seconds / 60) });
}
