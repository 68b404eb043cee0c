// Questions to the worker that runs the networks, and its answers.
import { Refusal } from "./text.js";

let worker;
let asked = 0;
const waiting = new Map(); // who waits for answers, by the question's number

// One answer to what is asked, which has this field; what comes before is reported.
export function ask(message, field, onStage, onOther = () => {}) {
  if (!worker) {
    worker = new Worker("./worker.js", { type: "module" });
    worker.onmessage = ({ data }) => waiting.get(data.id)?.(data);
    worker.onerror = (event) =>
      waiting.forEach((answer) => answer({ error: event.message || "?" }));
  }
  const id = ++asked;
  return new Promise((resolve, reject) => {
    waiting.set(id, (data) => {
      if (data.error) {
        waiting.delete(id);
        if (!waiting.size) end(); // a runtime that did not load is not asked for again
        reject(new Refusal("network", { error: data.error }));
      } else if (data.stage) onStage(data.stage);
      else if (field in data && (data.step ?? 1) === 1) resolve(data);
      else onOther(data);
    });
    worker.postMessage({ ...message, id });
  }).finally(() => waiting.delete(id));
}

// Ends what the worker does; nobody waits for it any more.
export function end() {
  worker?.terminate();
  worker = undefined;
  waiting.clear();
}
