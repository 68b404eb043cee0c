// The page's words, in the visitor's language. All of them stand in strings.json.
const table = await (await fetch("./strings.json")).json();
const KEPT = "unips-language";

function kept() {
  try {
    return localStorage.getItem(KEPT);
  } catch { // a private window
    return null;
  }
}

let language =
  [kept(), ...navigator.languages].map((code) => code?.slice(0, 2)).find((code) => code in table) ?? "en";

export const current = () => language;

// A text with its gaps {name} filled; `key_one` where values.n is 1.
export function t(key, values = {}) {
  const words = table[language];
  const text = (values.n === 1 && words[`${key}_one`]) || words[key];
  return text.replace(/\{(\w+)\}/g, (gap, name) => values[name] ?? gap);
}

// Fills in the words of elements: data-t their text, data-t-label what they are called.
export function apply() {
  document.documentElement.lang = language;
  document.title = t("page_title");
  for (const element of document.querySelectorAll("[data-t]")) {
    element.textContent = t(element.dataset.t);
  }
  for (const element of document.querySelectorAll("[data-t-label]")) {
    element.setAttribute("aria-label", t(element.dataset.tLabel));
  }
}

// The menu of languages; `changed` is called after another was chosen.
export function offer(select, changed) {
  for (const [code, words] of Object.entries(table)) {
    select.append(new Option(words.language_name, code, false, code === language));
  }
  select.onchange = () => {
    language = select.value;
    try {
      localStorage.setItem(KEPT, language);
    } catch { /* a private window */ }
    apply();
    changed();
  };
  apply();
}

// What can't be done: a key of the table and its values, so that its language can change.
export class Refusal extends Error {
  constructor(key, values = {}) {
    super(t(`refused_${key}`, values));
    Object.assign(this, { key: `refused_${key}`, values });
  }
}
