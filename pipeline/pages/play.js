"use strict";
// One slider moves everything on the page that moves: films, each a sheet of frames, and the moving Gaussians.
const clock = { seconds: 0, playing: false, length: 0, shown: [] };

function show(seconds) {
  clock.seconds = seconds;
  for (const draw of clock.shown) draw(seconds);
  for (const slider of document.querySelectorAll(".time")) slider.value = seconds;
  for (const text of document.querySelectorAll(".now")) text.textContent = seconds.toFixed(2) + " s";
}

function film(canvas) {
  const { frames, columns, width, height, fps } = JSON.parse(canvas.dataset.film);
  const sheet = document.getElementById(canvas.dataset.sheet);
  const pen = canvas.getContext("2d");
  clock.shown.push(seconds => {
    const i = Math.min(frames - 1, Math.floor(seconds * fps + 1e-6));
    const [u, v] = [i % columns * width, Math.floor(i / columns) * height];
    pen.drawImage(sheet, u, v, width, height, 0, 0, canvas.width, canvas.height);
  });
  clock.length = Math.max(clock.length, (frames - 1) / fps);
}

function start() {
  for (const canvas of document.querySelectorAll("canvas[data-film]")) film(canvas);
  if (document.getElementById("replay")) replay(document.getElementById("replay"));
  for (const slider of document.querySelectorAll(".time")) {
    slider.max = clock.length;
    slider.step = 0.001;
    slider.addEventListener("input", () => { clock.playing = false; label(); show(+slider.value); });
  }
  const label = () => document.querySelectorAll(".play").forEach(b => b.textContent = clock.playing ? "Pause" : "Play");
  let before = 0;
  const step = now => {
    if (!clock.playing) return;
    show((clock.seconds + (now - before) / 1000) % (clock.length || 1));
    before = now;
    requestAnimationFrame(step);
  };
  for (const button of document.querySelectorAll(".play")) {
    button.addEventListener("click", () => {
      clock.playing = !clock.playing;
      label();
      before = performance.now();
      if (clock.playing) requestAnimationFrame(step);
    });
  }
  label();
  show(clock.length * 0.3);
}
window.addEventListener("load", start);
