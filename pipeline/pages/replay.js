// Gaussians drawn by the page itself, back to front: round, as wide as their mean standard deviation, in their colour
// seen from everywhere. Positions are 16-bit numbers within a box, so that a few megabytes hold the motion.
function bytes(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  return Uint8Array.from(text, c => c.charCodeAt(0)).buffer;
}

function replay(canvas) {
  const told = JSON.parse(canvas.dataset.told);
  const place = new Uint16Array(bytes("replay-places"));  // frames x moving x 3, then still x 3
  const look = new Uint8Array(bytes("replay-looks"));  // per Gaussian r, g, b, opacity, radius
  const n = told.moving + told.still;
  const [w, h] = [canvas.width, canvas.height];
  const pen = canvas.getContext("2d");
  const picture = pen.createImageData(w, h);
  const light = new Float32Array(3 * w * h);
  const depth = new Float32Array(n), u = new Float32Array(n), v = new Float32Array(n);
  const order = Uint32Array.from({ length: n }, (_, i) => i);
  const view = { azimuth: told.azimuth, elevation: told.elevation, distance: told.distance };
  const focal = 0.5 * Math.min(w, h) / Math.tan(Math.PI / 12);

  function draw(seconds) {
    const frame = Math.min(told.frames - 1, Math.floor(seconds * told.fps + 1e-6));
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    for (let i = 0; i < n; i++) {
      const at = 3 * (i < told.moving ? frame * told.moving + i : told.frames * told.moving + i - told.moving);
      const [x, y, z] = [0, 1, 2].map(k => told.lower[k] + told.size[k] * place[at + k] / 65535 - told.centre[k]);
      const out = ca * x + sa * y;
      depth[i] = view.distance - ce * out - se * z;
      u[i] = w / 2 + focal * (ca * y - sa * x) / depth[i];
      v[i] = h / 2 - focal * (ce * z - se * out) / depth[i];
    }
    order.sort((a, b) => depth[b] - depth[a]);
    for (let p = 0; p < light.length; p++) light[p] = told.background[p % 3];
    for (const i of order) if (depth[i] > 0.05 * told.distance) splat(i);
    for (let p = 0, q = 0; p < light.length; p += 3, q += 4) {
      for (let c = 0; c < 3; c++) picture.data[q + c] = light[p + c];
      picture.data[q + 3] = 255;
    }
    pen.putImageData(picture, 0, 0);
  }

  function splat(i) {
    const sigma = Math.min(40, Math.max(0.6, focal * told.widest * (look[5 * i + 4] / 255) ** 2 / depth[i]));
    const reach = 2.5 * sigma;
    const [x0, x1] = [Math.max(0, Math.ceil(u[i] - reach)), Math.min(w - 1, Math.floor(u[i] + reach))];
    const [y0, y1] = [Math.max(0, Math.ceil(v[i] - reach)), Math.min(h - 1, Math.floor(v[i] + reach))];
    for (let y = y0; y <= y1; y++) {
      for (let x = x0; x <= x1; x++) {
        const r2 = (x - u[i]) ** 2 + (y - v[i]) ** 2;
        const a = look[5 * i + 3] / 255 * Math.exp(-0.5 * r2 / (sigma * sigma));
        const p = 3 * (y * w + x);
        for (let c = 0; c < 3; c++) light[p + c] += a * (look[5 * i + c] - light[p + c]);
      }
    }
  }

  let held = null;
  canvas.addEventListener("pointerdown", e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => held = null);
  canvas.addEventListener("pointermove", e => {
    if (!held) return;
    view.azimuth -= 0.008 * (e.clientX - held[0]);
    view.elevation = Math.min(1.5, Math.max(-1.5, view.elevation + 0.008 * (e.clientY - held[1])));
    held = [e.clientX, e.clientY];
    draw(clock.seconds);
  });
  canvas.addEventListener("wheel", e => {
    e.preventDefault();
    view.distance *= Math.exp(0.001 * e.deltaY);
    draw(clock.seconds);
  }, { passive: false });
  clock.shown.push(draw);
  clock.length = Math.max(clock.length, (told.frames - 1) / told.fps);
}
