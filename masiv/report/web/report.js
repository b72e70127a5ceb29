// The report: charts, the 3D view and the cameras, all driven by one time slider. Plotly is in the page.
"use strict";

const INK = "#1c2430", SOFT = "#5b6675", LINE = "#d8dde4", ORANGE = "#d97706", GREY = "#8a8f98", UNKNOWN = 65535;
const SLOWER = 4, MIN_STEP_MS = 40; // a fall lasts half a second: at real speed, nothing is seen
const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"] };
const byId = (id) => document.getElementById(id);

async function loadLibrary() {
  const bytes = Uint8Array.from(atob(byId("library").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

// ---- charts -------------------------------------------------------------------------------------------------------

const cursor = (time) => ({ type: "line", xref: "x", yref: "paper", x0: time, x1: time, y0: 0, y1: 1,
  line: { color: INK, width: 1.5 } });

function drawChart(box, chart) {
  const bands = chart.bands.map((b) => ({ type: "rect", xref: "x", yref: "paper", x0: b.from, x1: b.to, y0: 0, y1: 1,
    layer: "below", fillcolor: b.colour, opacity: b.opacity, line: { width: 0 } }));
  const levels = chart.levels.map((l) => ({ type: "line", xref: "paper", yref: "y", x0: 0, x1: 1, y0: l.value,
    y1: l.value, line: { color: SOFT, width: 1.2, dash: "dash" } }));
  const names = chart.bands.filter((b) => !b.listed).map((b) => ({ text: b.name, x: (b.from + b.to) / 2, xref: "x", y: 1, yref: "paper",
    yanchor: "bottom", showarrow: false, font: { size: 11, color: SOFT } }));
  const traces = chart.lines.map((l) => ({ x: l.x, y: l.y, name: l.name, type: "scatter",
    mode: l.points ? "markers" : l.x.length <= 60 ? "lines+markers" : "lines",
    marker: { size: l.points ? 4 : 5, color: l.colour }, line: { color: l.colour, width: 2, dash: l.dash } }));
  const axis = { gridcolor: LINE, zerolinecolor: LINE, linecolor: SOFT, ticks: "outside", automargin: true };
  return Plotly.newPlot(box, traces, {
    margin: { l: 58, r: 10, t: 20, b: 44 }, font: { size: 13, color: INK }, hovermode: "x unified",
    xaxis: { ...axis, title: { text: chart.x } },
    yaxis: { ...axis, title: { text: chart.y }, type: chart.log ? "log" : "linear",
      rangemode: chart.fromZero ? "tozero" : "normal" },
    shapes: [...(chart.time ? [cursor(0)] : []), ...bands, ...levels], annotations: names, showlegend: false,
  }, config);
}

// ---- the 3D view --------------------------------------------------------------------------------------------------

function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Float64Array.from({ length: bytes.length / 2 }, (_, k) => {
    const value = view.getUint16(2 * k, true);
    return value === UNKNOWN ? NaN : value / (UNKNOWN - 1);
  });
}

function places(motion, values, frame) { // x, y, z of one frame
  const out = [[], [], []];
  for (let p = 0; p < motion.points; p++) for (let a = 0; a < 3; a++) {
    const value = values[3 * (frame * motion.points + p) + a];
    out[a].push(Number.isNaN(value) ? null : motion.low[a] + motion.span[a] * value);
  }
  return out;
}

class Space {
  constructor(box, data) {
    this.box = box;
    this.data = data;
    for (const motion of data.motions) for (const name of ["observed", "simulated", "error"]) {
      motion[name] = unpack(motion[name]);
    }
    this.show = "both";
    this.choose(0);
  }

  choose(index) {
    const m = (this.motion = this.data.motions[index]);
    const few = m.points < 100, up = this.data.up;
    const marks = { type: "scatter3d", mode: "markers", x: [], y: [], z: [], hoverinfo: "skip" };
    const traces = [
      { ...marks, name: "observed", marker: { size: few ? 7 : 2.2, color: SOFT, opacity: few ? 0.9 : 0.45,
        symbol: few ? "circle-open" : "circle" } },
      { ...marks, name: "simulated", hoverinfo: "text", marker: { size: few ? 6 : 3, cmin: 0, cmax: this.data.errorTop,
        colorscale: "Viridis", color: [], showscale: true, line: { width: 0 },
        colorbar: { title: { text: "error [mm]", side: "right" }, thickness: 12, len: 0.8, x: 1, outlinewidth: 0 } } },
    ];
    if (m.paths) for (const [name, colour] of [["observed", SOFT], ["simulated", ORANGE]]) {
      traces.push({ ...this.paths(m, name), type: "scatter3d", mode: "lines", line: { color: colour, width: 2 },
        opacity: 0.6, hoverinfo: "skip", showlegend: false });
    }
    const ground = this.ground(m);
    if (ground) traces.push(ground);
    const axis = (k) => ({ title: { text: `${"xyz"[k]} [m]` }, range: this.range(k), backgroundcolor: "#f5f7fa",
      gridcolor: LINE, showbackground: true, showspikes: false, nticks: 5, tickfont: { size: 11 } });
    this.ready = Plotly.react(this.box, traces, {
      margin: { l: 0, r: 0, t: 0, b: 0 }, font: { size: 12, color: INK }, showlegend: false, uirevision: `m${index}`,
      scene: { xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: "data", dragmode: "orbit",
        camera: { up: { x: up[0], y: up[1], z: up[2] }, eye: this.eye(), projection: { type: "orthographic" } } },
    }, { ...config, modeBarButtons: [["resetCameraDefault3d", "toImage"]] });
  }

  range(k) {
    const m = this.motion, pad = 0.06 * Math.max(...m.span);
    let low = m.low[k] - pad, high = m.low[k] + m.span[k] + pad;
    const g = this.data.ground;
    if (g && Math.abs(g.normal[k]) > 0.99) {
      low = Math.min(low, g.height * g.normal[k] - pad / 3);
      high = Math.max(high, g.height * g.normal[k] + pad / 3);
    }
    return [low, high];
  }

  ground(m) { // a square below the motion, if the ground is along two axes
    const g = this.data.ground, k = g ? g.normal.findIndex((n) => Math.abs(n) > 0.99) : -1;
    if (k < 0) return null;
    const [a, b] = [0, 1, 2].filter((axis) => axis !== k);
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([i, j]) => {
      const corner = [0, 0, 0];
      corner[k] = g.height * g.normal[k];
      corner[a] = this.range(a)[i];
      corner[b] = this.range(b)[j];
      return corner;
    });
    return { type: "mesh3d", x: corners.map((c) => c[0]), y: corners.map((c) => c[1]), z: corners.map((c) => c[2]),
      i: [0, 0], j: [1, 2], k: [2, 3], color: "#b9a77c", opacity: 0.35, hoverinfo: "skip", flatshading: true };
  }

  paths(m, name) {
    const out = { x: [], y: [], z: [] };
    const frames = m.times.map((_, k) => places(m, m[name], k));
    for (let p = 0; p < m.points; p++) {
      for (const frame of frames) ["x", "y", "z"].forEach((key, a) => out[key].push(frame[a][p]));
      for (const key of ["x", "y", "z"]) out[key].push(null);
    }
    return out;
  }

  eye() { // from where the view looks at first: obliquely from above
    const up = this.data.up, k = up.map(Math.abs).indexOf(Math.max(...up.map(Math.abs)));
    const [a, b] = [[1, 2], [2, 0], [0, 1]][k];
    const far = this.box.clientWidth < 500 ? 2 : 1.2;
    const eye = up.map((value) => 0.55 * far * value);
    eye[a] += 0.55 * far;
    eye[b] += 0.84 * far;
    return { x: eye[0], y: eye[1], z: eye[2] };
  }

  look(from) {
    const up = this.data.up, k = up.map(Math.abs).indexOf(Math.max(...up.map(Math.abs)));
    const axes = [[1, 2], [2, 0], [0, 1]][k];
    let eye = this.eye(), top = up;
    if (from !== "corner") {
      const v = [0, 0, 0];
      if (from === "above") { up.forEach((value, i) => { v[i] = 2 * value; }); top = [0, 0, 0]; top[axes[1]] = -1; }
      else v[axes[from === "front" ? 1 : 0]] = 2;
      eye = { x: v[0], y: v[1], z: v[2] };
    }
    Plotly.relayout(this.box, { "scene.camera.eye": eye, "scene.camera.center": { x: 0, y: 0, z: 0 },
      "scene.camera.up": { x: top[0], y: top[1], z: top[2] } });
  }

  async set(frame) {
    const m = this.motion;
    const [seen, made] = [places(m, m.observed, frame), places(m, m.simulated, frame)];
    const error = Array.from({ length: m.points }, (_, p) => m.error[frame * m.points + p] * m.errorScale);
    const known = error.some((e) => !Number.isNaN(e));
    const text = error.map((e) => (Number.isNaN(e) ? "not observed" : `${e.toPrecision(3)} mm`));
    await this.ready;
    await Plotly.restyle(this.box, {
      x: [seen[0], made[0]], y: [seen[1], made[1]], z: [seen[2], made[2]], text: [[], text],
      "marker.color": [SOFT, known ? error.map((e) => (Number.isNaN(e) ? 0 : e)) : GREY],
      visible: [this.show !== "simulated", this.show !== "observed"],
    }, [0, 1]);
  }
}

// ---- through the cameras ------------------------------------------------------------------------------------------

class Cameras {
  constructor(cameras) {
    this.cameras = cameras;
    this.canvas = byId("pictures");
    this.share = 0.5;
    this.right = "twin";
    this.frame = 0;
    this.choose(0);
    const move = (event) => {
      if (event.type === "pointermove" && !event.buttons) return;
      const box = this.canvas.getBoundingClientRect();
      const width = Math.min(box.width, (box.height * this.canvas.width) / this.canvas.height); // of the picture itself
      this.wipe((event.clientX - box.left - (box.width - width) / 2) / width);
    };
    for (const type of ["pointerdown", "pointermove"]) this.canvas.addEventListener(type, move);
    byId("wipe").addEventListener("input", (event) => this.wipe(event.target.value / 1000));
  }

  choose(index) {
    this.camera = this.cameras[index];
    this.canvas.width = 2 * this.camera.width;
    this.canvas.height = 2 * this.camera.height;
    for (const name of ["observed", "reconstruction", "twin"]) {
      this.camera[name] = this.camera[name].map((source) => {
        if (source === null || source instanceof Image) return source;
        const image = new Image();
        image.addEventListener("load", () => this.draw());
        image.src = source;
        return image;
      });
    }
    this.draw();
  }

  wipe(share) {
    this.share = Math.min(Math.max(share, 0), 1);
    byId("wipe").value = 1000 * this.share;
    this.draw();
  }

  set(frame) {
    this.frame = frame;
    this.draw();
  }

  draw() {
    const { width, height } = this.canvas, context = this.canvas.getContext("2d"), at = Math.round(width * this.share);
    const [left, right] = [this.camera.observed[this.frame], this.camera[this.right][this.frame]];
    context.fillStyle = "#000";
    context.fillRect(0, 0, width, height);
    for (const [image, from, to] of [[left, 0, at], [right, at, width]]) {
      context.save();
      context.beginPath();
      context.rect(from, 0, to - from, height);
      context.clip();
      if (image && image.complete && image.naturalWidth) context.drawImage(image, 0, 0, width, height);
      else if (!image) {
        context.fillStyle = "#444";
        context.fillRect(from, 0, to - from, height);
      }
      context.restore();
    }
    context.fillStyle = "#fff";
    context.fillRect(at - width / 600, 0, width / 300, height);
    byId("right-name").textContent = right ? this.right : "not reconstructed";
  }
}

// ---- one time for all ---------------------------------------------------------------------------------------------

class Player {
  constructor(space, motions, cameras, boxes) {
    Object.assign(this, { space, motions, cameras, boxes, index: 0, frame: 0, timer: null, busy: false, wanted: false });
    this.slider = byId("time");
    this.button = byId("play");
    this.slider.addEventListener("input", () => this.set(Number(this.slider.value)));
    this.button.addEventListener("click", () => (this.timer ? this.stop() : this.play()));
  }

  get motion() { return this.motions[this.index]; }

  choose(index) {
    this.index = index;
    this.slider.max = this.motion.times.length - 1;
    if (this.space) this.space.choose(index);
    this.set(Math.min(this.frame, this.motion.times.length - 1));
  }

  play() {
    const times = this.motion.times, step = times.length > 1 ? 1000 * (times[1] - times[0]) : 100;
    this.timer = setInterval(() => this.set((this.frame + 1) % times.length), Math.max(SLOWER * step, MIN_STEP_MS));
    this.button.textContent = "Pause";
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.button.textContent = "Play";
  }

  set(frame) {
    this.frame = frame;
    this.slider.value = frame;
    const m = this.motion, number = m.frames[frame], mean = m.meanError[frame];
    const error = mean === null ? "not observed here"
      : `error: mean ${mean.toPrecision(3)} mm, largest ${m.largestError[frame].toPrecision(3)} mm`;
    const part = m.parts[frame] ? ` (${m.parts[frame]})` : "";
    byId("now").textContent =
      `${m.times[frame].toFixed(3)} s, frame ${number} of 0 to ${m.frameCount - 1}${part}; ${error}`;
    this.slider.setAttribute("aria-valuetext", `${m.times[frame].toFixed(3)} seconds`);
    if (this.cameras) this.cameras.set(frame);
    this.draw();
  }

  async draw() { // the newest frame that was asked for, never two at once
    this.wanted = true;
    if (this.busy) return;
    this.busy = true;
    while (this.wanted) {
      this.wanted = false;
      const time = this.motion.times[this.frame];
      if (this.space) await this.space.set(this.frame);
      for (const box of this.boxes) await Plotly.relayout(box, { "shapes[0].x0": time, "shapes[0].x1": time });
    }
    this.busy = false;
    document.body.dataset.shown = this.frame;
  }
}

function choices(id, chosen) { // buttons of which one is pressed
  const box = byId(id);
  if (!box) return;
  for (const button of box.querySelectorAll("button")) button.addEventListener("click", () => {
    for (const other of box.querySelectorAll("button")) other.setAttribute("aria-pressed", other === button);
    chosen(button.value);
  });
}

function select(id, names, chosen) {
  const box = byId(id);
  if (!box) return;
  names.forEach((name, k) => box.add(new Option(name, k)));
  box.addEventListener("change", () => chosen(Number(box.value)));
  box.hidden = names.length < 2;
}

async function start() {
  const data = JSON.parse(byId("data").textContent);
  await loadLibrary();
  const boxes = [...document.querySelectorAll(".chart")];
  let player = null;
  if (data.motion) {
    const space = byId("space") && new Space(byId("space"), data.motion);
    const cameras = data.cameras && new Cameras(data.cameras);
    const timed = boxes.filter((box) => data.charts[box.dataset.chart].time);
    player = new Player(space, data.motion.motions, cameras, timed);
    select("motion", data.motion.motions.map((m) => m.name), (k) => player.choose(k));
    select("camera", (data.cameras || []).map((c) => c.name), (k) => cameras.choose(k));
    choices("show", (value) => { space.show = value; player.draw(); });
    choices("look", (value) => space.look(value));
    choices("against", (value) => { cameras.right = value; cameras.draw(); });
  }
  for (const box of boxes) await drawChart(box, data.charts[box.dataset.chart]);
  if (player) player.choose(0);
  document.body.dataset.ready = "yes";
}

start().catch((error) => {
  console.error(error);
  for (const box of document.querySelectorAll(".chart, #space")) {
    box.classList.add("failed");
    box.textContent = `This browser cannot draw it: ${error.message}`;
  }
});
