// Gaussians drawn by the page itself, back to front, in their colour seen from everywhere: a footprint is the ellipse of
// the projected covariance, J R S S R^T J^T and 0.3 pixels squared, as renderers of 3DGS have it.
function bytes(id) {
  const text = atob(document.getElementById(id).textContent.trim());
  return Uint8Array.from(text, c => c.charCodeAt(0)).buffer;
}

function replay(canvas) {
  const told = JSON.parse(canvas.dataset.told);
  const place = new Uint16Array(bytes("replay-places"));  // frames x moving x 3, then still x 3
  const turn = new Int8Array(bytes("replay-turns"));  // likewise, quaternions w x y z
  const look = new Uint8Array(bytes("replay-looks"));  // per Gaussian r, g, b, opacity, three widths
  const n = told.moving + told.still;
  const [w, h] = [canvas.width, canvas.height];
  const pen = canvas.getContext("2d");
  const picture = pen.createImageData(w, h);
  const light = new Float32Array(3 * w * h);
  const depth = new Float32Array(n), u = new Float32Array(n), v = new Float32Array(n);
  const order = Uint32Array.from({ length: n }, (_, i) => i);
  const view = { azimuth: told.azimuth, elevation: told.elevation, distance: told.distance };
  const focal = 0.5 * Math.min(w, h) / Math.tan(Math.PI / 12);
  const width = Float32Array.from({ length: 256 }, (_, i) => told.widest * (i / 255) ** 2);

  function draw(seconds) {
    const frame = Math.min(told.frames - 1, Math.floor(seconds * told.fps + 1e-6));
    const at = i => i < told.moving ? frame * told.moving + i : told.frames * told.moving + i - told.moving;
    const [ca, sa, ce, se] = [Math.cos(view.azimuth), Math.sin(view.azimuth), Math.cos(view.elevation), Math.sin(view.elevation)];
    const axes = { right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce], back: [ce * ca, ce * sa, se] };
    for (let i = 0; i < n; i++) {
      const p = 3 * at(i);
      const [x, y, z] = [0, 1, 2].map(k => told.lower[k] + told.size[k] * place[p + k] / 65535 - told.centre[k]);
      const along = axis => axis[0] * x + axis[1] * y + axis[2] * z;
      depth[i] = view.distance - along(axes.back);
      u[i] = along(axes.right) / depth[i];
      v[i] = along(axes.up) / depth[i];
    }
    order.sort((a, b) => depth[b] - depth[a]);
    for (let p = 0; p < light.length; p++) light[p] = told.background[p % 3];
    for (const i of order) if (depth[i] > 0.05 * told.distance) splat(i, 4 * at(i), axes);
    for (let p = 0, q = 0; p < light.length; p += 3, q += 4) {
      for (let c = 0; c < 3; c++) picture.data[q + c] = light[p + c];
      picture.data[q + 3] = 255;
    }
    pen.putImageData(picture, 0, 0);
  }

  function splat(i, q, { right, up, back }) {
    const size = Math.hypot(turn[q], turn[q + 1], turn[q + 2], turn[q + 3]);
    const [a, b, c, d] = [0, 1, 2, 3].map(k => turn[q + k] / size);
    const columns = [
      [1 - 2 * (c * c + d * d), 2 * (b * c + a * d), 2 * (b * d - a * c)],
      [2 * (b * c - a * d), 1 - 2 * (b * b + d * d), 2 * (c * d + a * b)],
      [2 * (b * d + a * c), 2 * (c * d - a * b), 1 - 2 * (b * b + c * c)],
    ];
    let [xx, xy, yy] = [0.3, 0, 0.3];
    for (let k = 0; k < 3; k++) {
      const s = focal / depth[i] * width[look[7 * i + 4 + k]];
      let [du, dv] = [0, 0];
      for (let j = 0; j < 3; j++) {
        du += s * columns[k][j] * (right[j] + u[i] * back[j]);
        dv -= s * columns[k][j] * (up[j] + v[i] * back[j]);
      }
      xx += du * du, xy += du * dv, yy += dv * dv;
    }
    const det = xx * yy - xy * xy;
    const [x, y] = [w / 2 + focal * u[i], h / 2 - focal * v[i]];
    const [reachX, reachY] = [3 * Math.sqrt(xx), 3 * Math.sqrt(yy)];
    const [x0, x1] = [Math.max(0, Math.ceil(x - reachX)), Math.min(w - 1, Math.floor(x + reachX))];
    const [y0, y1] = [Math.max(0, Math.ceil(y - reachY)), Math.min(h - 1, Math.floor(y + reachY))];
    for (let row = y0; row <= y1; row++) {
      for (let column = x0; column <= x1; column++) {
        const [dx, dy] = [column - x, row - y];
        const power = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det;
        if (power > 9) continue;
        const alpha = look[7 * i + 3] / 255 * Math.exp(-0.5 * power);
        const p = 3 * (row * w + column);
        for (let k = 0; k < 3; k++) light[p + k] += alpha * (look[7 * i + k] - light[p + k]);
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
