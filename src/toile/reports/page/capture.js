"use strict";
// One current frame for picture, body and garment in 3D, and the cursors of the charts.
toile.startViewer = () => {
  const data = toile.json("viewer-data");
  const at = (id) => document.getElementById(id);
  const [slider, play, clock, space] = ["frame", "play", "clock", "playback"].map(at);
  const meshes = data.meshes.map((mesh) => ({ n: mesh.vertices, x: toile.floats(mesh.positions) }));
  const maps = Object.fromEntries(data.maps.map((map) => [map.key, { ...map, values: map.values && toile.floats(map.values) }]));
  const followers = [...document.querySelectorAll("[data-cursors]")];
  const n = data.frames.length;
  let current = -1;
  let playing = null;

  const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;

  // World (y up) to the axes of the 3D view: x, towards the viewer, up.
  function axes({ n: count, x }, f) {
    const out = [new Array(count), new Array(count), new Array(count)];
    for (let k = 0; k < count; k++) {
      const p = 3 * (f * count + k);
      out[0][k] = x[p];
      out[1][k] = -x[p + 2];
      out[2][k] = x[p + 1];
    }
    return out;
  }

  function colour() {
    const map = maps[chosen("map")];
    const values = map.values
      ? Array.from(map.values.subarray(current * meshes[1].n, (current + 1) * meshes[1].n), (v) => (isNaN(v) ? 0 : v))
      : new Array(meshes[1].n).fill(0);
    return {
      intensity: [values],
      cmax: map.limit,
      colorscale: [map.scale],
      showscale: Boolean(map.values),
      "colorbar.title.text": map.values ? `${map.title} [${map.unit}]` : "",
    };
  }

  const drawPicture = () => (at("frame-picture").src = data.pictures[chosen("view")][current]);

  async function drawSpace() {
    const now = meshes.map((mesh) => axes(mesh, current));
    await Plotly.restyle(space, Object.fromEntries(["x", "y", "z"].map((name, k) => [name, now.map((a) => a[k])])), [0, 1]);
    return Plotly.restyle(space, colour(), [1]);
  }

  function drawCursors() {
    return followers.map((place) => {
      const layout = {};
      for (let k = 0; k < Number(place.dataset.cursors); k++)
        layout[`shapes[${k}].x0`] = layout[`shapes[${k}].x1`] = data.frames[current];
      return Plotly.relayout(place, layout);
    });
  }

  function show(frame) {
    const f = Math.min(n - 1, Math.max(0, Math.round(frame)));
    if (f === current) return Promise.resolve();
    current = f;
    slider.value = f;
    const number = data.frames[f];
    slider.setAttribute("aria-valuetext", `frame ${number} of ${data.total - 1}`);
    clock.innerHTML = `frame ${number} <span>of ${data.total - 1}</span> · ${(number / data.fps).toFixed(2)} s`;
    drawPicture();
    return Promise.all([drawSpace(), ...drawCursors()]);
  }

  function setPlaying(on) {
    if (on === (playing !== null)) return;
    play.setAttribute("aria-pressed", String(on));
    play.setAttribute("aria-label", on ? "Pause" : "Play");
    if (!on) {
      cancelAnimationFrame(playing);
      playing = null;
      return;
    }
    const rate = data.fps / (n > 1 ? data.frames[1] - data.frames[0] : 1);
    let position = current >= n - 1 ? 0 : current;
    let last = performance.now();
    let busy = false;
    const tick = (now) => {
      position += ((now - last) / 1000) * rate;
      last = now;
      if (position >= n) position = 0;
      if (!busy) {
        busy = true;
        show(Math.floor(position)).then(() => (busy = false));
      }
      playing = requestAnimationFrame(tick);
    };
    playing = requestAnimationFrame(tick);
  }

  const pauseAt = (frame) => {
    setPlaying(false);
    return show(frame);
  };
  slider.addEventListener("input", () => pauseAt(Number(slider.value)));
  play.addEventListener("click", () => setPlaying(playing === null));
  document.querySelectorAll("input[name=view]").forEach((input) => input.addEventListener("change", drawPicture));
  document
    .querySelectorAll("input[name=map]")
    .forEach((input) => input.addEventListener("change", () => Plotly.restyle(space, colour(), [1])));
  at("show-body").addEventListener("change", (e) => Plotly.restyle(space, { visible: e.target.checked }, [0]));
  toile.rearranged.push(drawCursors);
  const nearest = (x) => data.frames.reduce((best, f, k) => (Math.abs(f - x) < Math.abs(data.frames[best] - x) ? k : best), 0);
  for (const place of followers) place.on("plotly_click", ({ points: [p] }) => pauseAt(nearest(p.x)));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("select, button, summary, a, input:not(#frame)")) return;
    const steps = { ArrowLeft: current - 1, ArrowRight: current + 1, Home: 0, End: n - 1 };
    if (event.key === " ") setPlaying(playing === null);
    else if (event.key in steps) pauseAt(steps[event.key]);
    else return;
    event.preventDefault();
  });
  return show(Math.floor(n / 2));
};
