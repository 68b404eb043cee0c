// What survives the page: photographs, mask, options and normals, in this browser alone.
// A phone that turns its screen off may end the page; opened again, it goes on.
const NAME = "unips";

function database() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => request.result.createObjectStore("work");
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

// Of several tabs the first keeps what it has; the others work as private windows do.
// A reload may come before its page has gone: hence the second and a half.
const first = !navigator.locks ? aloneHere() : new Promise((resolve) => {
  const given = new AbortController();
  const late = setTimeout(() => given.abort(), 1500);
  navigator.locks.request(NAME, { signal: given.signal }, () => {
    clearTimeout(late);
    resolve(true);
    return new Promise(() => {}); // held as long as the page lives
  }).catch(() => resolve(false));
});

// By plain http from another machine there are no locks: the others are asked.
function aloneHere() {
  const channel = new BroadcastChannel(NAME);
  let mine = false;
  return new Promise((resolve) => {
    const late = setTimeout(() => resolve((mine = true)), 400);
    channel.onmessage = ({ data }) => {
      if (data === "anyone?" && mine) channel.postMessage("here");
      if (data !== "here" || mine) return;
      clearTimeout(late);
      channel.close();
      resolve(false);
    };
    channel.postMessage("anyone?");
  });
}

async function transact(mode, act) {
  let base;
  if (!(await first)) return undefined;
  try {
    base = await database();
    return await new Promise((resolve, reject) => {
      const transaction = base.transaction("work", mode);
      const request = act(transaction.objectStore("work"));
      transaction.oncomplete = () => resolve(request?.result);
      transaction.onerror = transaction.onabort = () => reject(transaction.error);
    });
  } catch (error) {
    // Private windows and full disks keep nothing; the page works without.
    console.warn(`not kept: ${error}`);
    return undefined;
  } finally {
    base?.close();
  }
}

export const keep = (key, value) => transact("readwrite", (store) => store.put(value, key));
export const recall = (key) => transact("readonly", (store) => store.get(key));
export const forget = (key) => transact("readwrite", (store) =>
  key === undefined ? store.clear() : store.delete(key));

// The screen stays on while something runs, where the browser can.
let lock;
export async function stayAwake(on) {
  wanted = on;
  if (!on) {
    await lock?.release().catch(() => {});
    lock = undefined;
  } else if (document.visibilityState === "visible") {
    lock = await navigator.wakeLock?.request("screen").catch(() => undefined);
  }
}
let wanted = false;
document.addEventListener("visibilitychange", () => wanted && stayAwake(true));
