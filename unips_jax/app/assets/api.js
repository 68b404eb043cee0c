// Requests to the server, and what it refuses as words.

import { t, knows } from "./text.js";

export class Problem extends Error {
  constructor(text, lost = false) {
    super(text);
    this.lost = lost; // nobody answered
  }
}

const words = (answer) =>
  answer?.code && knows(`problem_${answer.code}`) ? t(`problem_${answer.code}`, answer.values) : answer?.error || t("problem_failed");

export async function request(method, path, body) {
  let answer;
  const binary = body instanceof Blob;
  const content = body === undefined || binary ? body : JSON.stringify(body);
  try {
    answer = await fetch(`/api${path}`, { method, body: content ?? (method === "POST" ? "{}" : undefined) });
  } catch {
    throw new Problem(t("problem_lost"), true);
  }
  const data = await answer.json().catch(() => null);
  if (!answer.ok) throw Object.assign(new Problem(words(data)), { status: answer.status });
  return data;
}

/** One file, one request; progress is called with the bytes that were sent. */
export function upload(id, file, progress) {
  return new Promise((done, failed) => {
    const sent = new XMLHttpRequest();
    sent.open("PUT", `/api/objects/${id}/files?name=${encodeURIComponent(file.name)}`);
    sent.responseType = "json";
    sent.upload.addEventListener("progress", (event) => progress(event.loaded));
    sent.addEventListener("load", () => (sent.status === 200 ? done(sent.response) : failed(new Problem(words(sent.response), sent.status === 408))));
    sent.addEventListener("error", () => failed(new Problem(t("problem_lost"), true)));
    sent.send(file);
  });
}
