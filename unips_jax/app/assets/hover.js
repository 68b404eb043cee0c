// A result to hover over: the example's normals, lit from the pointer's side.

export async function hover(canvas, source) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const { width, height } = image;
  const work = Object.assign(document.createElement("canvas"), { width, height });
  const context = work.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const stored = context.getImageData(0, 0, width, height);
  const out = context.createImageData(width, height);
  const shown = canvas.getContext("2d");

  function light(x, y) {
    const length = Math.hypot(x, y);
    const scale = length > 0.85 ? 0.85 / length : 1;
    const [lx, ly] = [x * scale, y * scale];
    const lz = Math.sqrt(1 - lx * lx - ly * ly);
    for (let at = 0; at < stored.data.length; at += 4) {
      const nx = stored.data[at] / 127.5 - 1;
      const ny = stored.data[at + 1] / 127.5 - 1;
      const nz = stored.data[at + 2] / 127.5 - 1;
      const matte = Math.max(0, nx * lx + ny * ly + nz * lz);
      const gloss = Math.max(0, 2 * nz * matte - lz) ** 24;
      const value = 255 * Math.min(1, (0.04 + 0.8 * matte + 0.35 * gloss)) ** (1 / 2.2);
      out.data[at] = value;
      out.data[at + 1] = value * 0.96;
      out.data[at + 2] = value * 0.9;
      out.data[at + 3] = stored.data[at + 3];
    }
    context.putImageData(out, 0, 0);
    shown.clearRect(0, 0, canvas.width, canvas.height);
    shown.drawImage(work, 0, 0, canvas.width, canvas.height);
  }

  let touched = false;
  canvas.addEventListener("pointermove", (event) => {
    touched = true;
    const box = canvas.getBoundingClientRect();
    light(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
  });
  light(-0.5, 0.5);
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  let last = 0;
  const turn = (now) => {
    if (touched) return;
    if (now - last > 50 && canvas.offsetParent) {
      last = now;
      light(0.7 * Math.cos(now / 1200), 0.7 * Math.sin(now / 1200));
    }
    requestAnimationFrame(turn);
  };
  requestAnimationFrame(turn);
}
