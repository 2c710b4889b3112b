"use strict";
// One current frame for everything on the page that depends on it: picture, cloth in 3D, maps, cursors.
toile.startViewer = () => {
  const data = toile.json("viewer-data");
  const { frames: n, rows: H, columns: W, fps } = data;
  const at = (id) => document.getElementById(id);
  const [slider, play, speed, clock, space] = ["frame", "play", "speed", "clock", "playback"].map(at);
  const positions = toile.floats(data.positions);
  const cloud = data.cloud && { points: toile.floats(data.cloud.points), starts: data.cloud.starts };
  const fields = Object.fromEntries(Object.entries(data.fields).map(([key, text]) => [key, toile.floats(text)]));
  const gridLines = {
    rows: [...Array(H).keys()].filter((i) => i % data.wire_every === 0 || i === H - 1),
    columns: [...Array(W).keys()].filter((j) => j % data.wire_every === 0 || j === W - 1),
  };
  let current = -1;
  let playing = null;

  const point = (f, i, j) => {
    const k = 3 * ((f * H + i) * W + j);
    return [positions[k], positions[k + 1], positions[k + 2]];
  };
  // The values of a field in one frame, row by row of the cloth.
  const grid = (values, f) =>
    Array.from({ length: H }, (_, i) => Array.from(values.subarray((f * H + i) * W, (f * H + i + 1) * W)));

  // The same turned as the cloth lies in the image.
  function asSeen(rows) {
    const { transposed, flipped } = data.upright;
    let turned = transposed ? rows[0].map((_, j) => rows.map((row) => row[j])) : rows;
    if (flipped[0]) turned = [...turned].reverse();
    return flipped[1] ? turned.map((row) => [...row].reverse()) : turned;
  }

  // Camera frame (x right, y down, z away) to the axes of the 3D view: right, away, up.
  const shown = ([x, y, z]) => [x, z, -y];

  function surface(f) {
    const axes = [[], [], []];
    for (let i = 0; i < H; i++) {
      const row = [[], [], []];
      for (let j = 0; j < W; j++) shown(point(f, i, j)).forEach((v, k) => row[k].push(v));
      row.forEach((values, k) => axes[k].push(values));
    }
    return axes;
  }

  function wires(f) {
    const axes = [[], [], []];
    const lift = data.towards_camera;
    const add = (i, j) => shown(point(f, i, j)).forEach((v, k) => axes[k].push(lift * v));
    const gap = () => axes.forEach((values) => values.push(null));
    for (const i of gridLines.rows) { for (let j = 0; j < W; j++) add(i, j); gap(); }
    for (const j of gridLines.columns) { for (let i = 0; i < H; i++) add(i, j); gap(); }
    return axes;
  }

  function truePoints(f) {
    const axes = [[], [], []];
    for (let k = 3 * cloud.starts[f]; k < 3 * cloud.starts[f + 1]; k += 3)
      shown(cloud.points.subarray(k, k + 3)).forEach((v, a) => axes[a].push(v));
    return axes;
  }

  function drawSpace(f) {
    const traces = [surface(f), wires(f)];
    if (cloud) traces.push(truePoints(f));
    const change = Object.fromEntries(["x", "y", "z"].map((axis, k) => [axis, traces.map((t) => t[k])]));
    if (data.shade) {
      // A hidden vertex may have no value; a hole in the cloth would say something else.
      const known = (v) => (isNaN(v) ? 0 : v);
      change.surfacecolor = [grid(fields[data.shade], f).map((row) => row.map(known))];
    }
    return Plotly.restyle(space, change, traces.map((_, k) => k));
  }

  function drawPicture(f) {
    if (!data.video) return;
    const view = document.querySelector("input[name=view]:checked").value;
    at("frame-picture").src = data.video.pictures[view][f];
    const grid = at("frame-grid");
    grid.parentElement.style.display = at("show-grid").checked ? "" : "none";
    const { fx, fy, cx, cy } = data.video.camera;
    const pixel = (i, j) => {
      const [x, y, z] = point(f, i, j);
      return `${((fx * x) / z + cx).toFixed(1)} ${((fy * y) / z + cy).toFixed(1)}`;
    };
    const lines = [];
    for (let i = 0; i < H; i++) lines.push([...Array(W).keys()].map((j) => pixel(i, j)));
    for (let j = 0; j < W; j++) lines.push([...Array(H).keys()].map((i) => pixel(i, j)));
    grid.setAttribute("d", lines.map((line) => "M" + line.join("L")).join(""));
  }

  // Figures in step with the frame: data-cursors is the number of lines that mark it, data-field names the map.
  const followers = [...document.querySelectorAll("[data-cursors]")].map((place) => ({ place, frame: -1 }));

  function drawFollower(follower) {
    const { place } = follower;
    follower.frame = current;
    const layout = {};
    for (let k = 0; k < Number(place.dataset.cursors); k++)
      layout[`shapes[${k}].x0`] = layout[`shapes[${k}].x1`] = current;
    if (!place.dataset.field) return Plotly.relayout(place, layout);
    const z = asSeen(grid(fields[place.dataset.field], current));
    layout["annotations[1].text"] = `frame ${current}`;
    return Plotly.update(place, { z: [z] }, layout, [1]);
  }

  // Figures out of sight wait until they are scrolled to, or playing would be slow.
  const inSight = ({ place }) => {
    const box = place.getBoundingClientRect();
    return box.bottom > -200 && box.top < innerHeight + 200;
  };
  const catchUp = (all) => followers.filter((f) => f.frame !== current && (all || inSight(f))).map(drawFollower);

  function show(frame, all = false) {
    const f = Math.min(n - 1, Math.max(0, Math.round(frame)));
    if (f === current) return Promise.resolve();
    current = f;
    slider.value = f;
    slider.setAttribute("aria-valuetext", `frame ${f} of ${n - 1}`);
    clock.innerHTML = `frame ${f} <span>of ${n - 1}</span> · ${(data.times ? data.times[f] : f / fps).toFixed(2)} s`;
    drawPicture(f);
    return Promise.all([drawSpace(f), ...catchUp(all)]);
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
    // From the clock, not by counting: a slow machine leaves out frames but keeps the speed.
    let position = current >= n - 1 ? 0 : current;
    let last = performance.now();
    let busy = false;
    const tick = (now) => {
      position += ((now - last) / 1000) * fps * Number(speed.value);
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
  addEventListener("scroll", () => catchUp(false), { passive: true });
  // Their cursors are where the page began.
  toile.rearranged.push(() => followers.map(drawFollower));
  addEventListener("beforeprint", () => catchUp(true));
  addEventListener("hashchange", () => pauseAt(fromAddress()));
  document.querySelectorAll("input[name=view], #show-grid").forEach((input) =>
    input.addEventListener("change", () => drawPicture(current)),
  );
  if (at("show-truth"))
    at("show-truth").addEventListener("change", (e) =>
      Plotly.restyle(space, { visible: e.target.checked }, [2]),
    );
  for (const { place } of followers)
    place.on("plotly_click", ({ points: [p] }) => {
      if (!place.dataset.field || p.curveNumber === 2) pauseAt(p.x);
    });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    // The slider answers to the arrow keys by itself; the space bar presses whatever has the focus.
    if (event.target.closest("select, button, summary, a, input:not(#frame)")) return;
    const steps = { ArrowLeft: current - 1, ArrowRight: current + 1, Home: 0, End: n - 1 };
    if (event.key === " ") setPlaying(playing === null);
    else if (event.key in steps) pauseAt(steps[event.key]);
    else return;
    event.preventDefault();
  });

  // "#frame=12" at the end of the address opens the page at that frame; else the middle, where the cloth has moved.
  const fromAddress = () => {
    const found = /^#frame=(\d+)$/.exec(location.hash);
    return found ? Number(found[1]) : Math.floor(n / 2);
  };
  return show(fromAddress(), true);
};
