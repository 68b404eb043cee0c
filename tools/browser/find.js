// The object is looked for: in the whole picture, or in a box.
import { ask } from "./ask.js";
import { isOnlyShine, meanPicture, resize } from "./mask.js";
import { linearImages } from "./photographs.js";

const SEEN_SIDE = 640; // of the picture that the mask is looked for in
const BOX_MARGIN = 0.1; // of the box, around it

// The mask [h, w] of the object, null if none stands out; `box` [left, top, right, bottom].
export async function find(photographs, transfer, box, onStage) {
  const [{ width, height }] = photographs;
  const step = Math.max(1, Math.ceil(Math.max(width, height) / SEEN_SIDE));
  const whole = new Uint8Array(width * height).fill(1);
  const small = linearImages(photographs, whole, transfer, step);
  const n = photographs.length;
  let seen = meanPicture(small.images, n, small.width * small.height);
  let [left, top, w, h] = [0, 0, small.width, small.height];
  if (box) {
    const [x0, y0, x1, y1] = box.map((value) => value / step);
    const margin = BOX_MARGIN * Math.max(x1 - x0, y1 - y0);
    [left, top] = [Math.max(0, Math.floor(x0 - margin)), Math.max(0, Math.floor(y0 - margin))];
    w = Math.min(small.width, Math.ceil(x1 + margin)) - left;
    h = Math.min(small.height, Math.ceil(y1 + margin)) - top;
    const part = new Float32Array(w * h * 3);
    for (let y = 0; y < h; y++) {
      const from = ((top + y) * small.width + left) * 3;
      part.set(seen.subarray(from, from + 3 * w), y * w * 3);
    }
    seen = part;
  }
  const { found } = await ask({ kind: "mask", picture: seen, width: w, height: h }, "found", onStage);
  if (!found || (!box && isOnlyShine(small.images, n, found))) return null;
  const full = resize(Float32Array.from(found), w, h, w * step, h * step);
  const mask = new Uint8Array(width * height);
  for (let y = 0; y < h * step && top * step + y < height; y++) {
    for (let x = 0; x < w * step && left * step + x < width; x++) {
      const [px, py] = [left * step + x, top * step + y];
      const inBox = !box || (px >= box[0] && px < box[2] && py >= box[1] && py < box[3]);
      if (inBox && full[y * w * step + x] > 0.5) mask[py * width + px] = 1;
    }
  }
  return mask;
}
