"use strict";
const byId = id => document.getElementById(id);
const palette = ["#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f",
  "#bcbd22", "#17becf", "#393b79", "#e7ba52", "#637939", "#843c39", "#a55194", "#3182bd"];
const canvas = byId("picture"), brush = canvas.getContext("2d");
let scene = null, state = null, frame = null, socket = null, isPilot = false, hovered = null;

// --- Talking to the server ---

const tab = sessionStorage.tab || (sessionStorage.tab = Math.random().toString(36).slice(2));
function send(type, fields = {}) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({type, ...fields}));
}
let isOver = false;  // the server has said that there is no use in trying again
function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/ws?tab=${tab}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({data}) => typeof data === "string" ? hear(JSON.parse(data)) : receive(data);
  socket.onclose = event => {
    if (event.code === 4000) { isOver = true; say("This page is open elsewhere.", true); }
    if (isOver) return;
    say("The connection is lost; trying again …", true);
    setTimeout(connect, 1000);
  };
  socket.onopen = () => say("");
}
function say(text, isError = false) {
  byId("say").textContent = text;
  byId("say").className = isError ? "error" : "";
}
function hear(event) {
  if (event.type === "welcome") { scene = event; drawScene(); }
  else if (event.type === "state") { state = event; drawState(); }
  else if (event.type === "training") drawTraining(event);
  else if (event.type === "role") {
    isPilot = event.pilot;
    byId("take").hidden = isPilot;
    if (!isPilot) say("Another page steers; this one looks on.");
    else if (byId("say").textContent.startsWith("Another page")) say("");
  }
  else if (event.type === "notice") say(event.message);
  else if (event.type === "error") { if (event.fatal) isOver = true; say(event.message, true); }
}

// --- Pictures ---

let isDecoding = false, waiting = null;
function receive(buffer) {
  waiting = buffer;
  if (!isDecoding) decode();
}
async function decode() {
  isDecoding = true;
  while (waiting) {
    const buffer = waiting;
    waiting = null;
    const length = new DataView(buffer).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const image = await createImageBitmap(new Blob([new Uint8Array(buffer, 4 + length)], {type: "image/jpeg"}));
    if (canvas.width !== image.width || canvas.height !== image.height) {
      canvas.width = image.width;
      canvas.height = image.height;
    }
    frame = header;
    brush.drawImage(image, 0, 0);
    drawOverlay();
    drawNow();
    image.close();
  }
  isDecoding = false;
}
const colours = new Map();
function colourOf(behavior) {
  if (!colours.has(behavior)) {
    const k = colours.size;  // more behaviours than the palette has: turns by the golden angle
    colours.set(behavior, palette[k] || `hsl(${Math.round(k * 137.5) % 360} 65% ${k % 2 ? 35 : 60}%)`);
  }
  return colours.get(behavior);
}
function line(path, colour, width, alpha, dash = []) {
  brush.globalAlpha = alpha;
  brush.strokeStyle = colour;
  brush.lineWidth = width * canvas.width / 480;
  brush.setLineDash(dash);
  brush.beginPath();
  for (const [x, y] of path) brush.lineTo(x * canvas.width, y * canvas.height);
  brush.stroke();
  brush.globalAlpha = 1;
  brush.setLineDash([]);
}
function drawOverlay() {
  for (const trail of (state && state.trails) || [])
    line(trail.path, colourOf(trail.behavior), 1.5, .45, trail.success ? [] : [3, 4]);
  const paths = (scene && scene.map && scene.map.paths) || {};
  const shown = hovered !== null ? hovered : frame.style;
  if (paths[shown]) line(paths[shown], "#111", 1.5, .6, [6, 5]);
  if (hand.place && frame.tool) line([frame.tool, hand.place], "#1f6fb2", 1.5, .6);
}
function drawNow() {
  const parts = [];
  if (frame.phase === "waiting") parts.push("Waiting for your first move");
  else parts.push(`step ${frame.steps}`);
  if (frame.requested) parts.push(`requested ${frame.requested}`);
  if (frame.behavior) parts.push(`shown ${frame.behavior}`);
  if (frame.phase === "over") parts.push(frame.success ? "success" : "no success");
  if (frame.paused) parts.push("paused");
  byId("now").textContent = parts.join(" · ");
  byId("pause").textContent = frame.paused ? "Go on" : "Pause";
  byId("speed").value = String(frame.speed);
  const ended = scene && scene.mode === "record" && frame.phase === "over";
  byId("ended").hidden = !ended;
  byId("keep").hidden = !frame.success;
  byId("discard").firstChild.textContent = frame.success ? "Throw away " : "Try again ";
}

// --- The hand: pointer, keys, gamepad ---

const hand = {place: null, push: [0, 0, 0]};
const keys = new Set();
let sent = "", number = 0;
const held = {ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
  PageUp: [0, 0, 1], PageDown: [0, 0, -1]};
function placeOf(event) {
  const box = canvas.getBoundingClientRect();
  const share = (value, low, size) => Math.min(2, Math.max(-1, (value - low) / size));
  return [share(event.clientX, box.left, box.width), share(event.clientY, box.top, box.height)];
}
function sendHand() {
  const now = JSON.stringify([hand.place, hand.push]);
  if (now === sent) return;
  sent = now;
  send("hand", {place: hand.place, push: hand.push, n: ++number});
}
canvas.onpointerdown = event => {
  canvas.setPointerCapture(event.pointerId);
  canvas.focus({preventScroll: true});
  hand.place = placeOf(event);
  sendHand();
  event.preventDefault();
};
canvas.onpointermove = event => { if (hand.place) hand.place = placeOf(event); };
canvas.onpointerup = canvas.onpointercancel = () => { hand.place = null; sendHand(); };
canvas.onwheel = event => {
  if (!scene || scene.axes < 3) return;
  event.preventDefault();
  wheel = Math.max(-1, Math.min(1, -event.deltaY / 50));
  clearTimeout(stopWheel);
  stopWheel = setTimeout(() => { wheel = 0; }, 120);
};
let wheel = 0, stopWheel = 0;
const isTyping = event => ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName);
window.onkeydown = event => {
  if (isTyping(event)) return;
  if (event.key in held) { keys.add(event.key); event.preventDefault(); return; }
  if (event.repeat || event.target.tagName === "BUTTON") return;
  if (event.key === "Enter" && !byId("ended").hidden && !byId("keep").hidden) send("keep");
  else if (["Delete", "Backspace"].includes(event.key) && !byId("ended").hidden) send("discard");
  else if (event.key === " ") { togglePause(); event.preventDefault(); }
};
window.onkeyup = event => keys.delete(event.key);
window.onblur = () => { keys.clear(); hand.place = null; sendHand(); };
let buttonsBefore = [];
function gamepad() {
  const pad = [...(navigator.getGamepads ? navigator.getGamepads() : [])].find(Boolean);
  if (!pad) return [0, 0, 0];
  const axis = k => Math.abs(pad.axes[k] || 0) > .15 ? pad.axes[k] : 0;
  const buttons = pad.buttons.map(button => button.pressed);
  if (!byId("ended").hidden) {
    if (buttons[0] && !buttonsBefore[0] && frame.success) send("keep");
    if (buttons[1] && !buttonsBefore[1]) send("discard");
  }
  buttonsBefore = buttons;
  return [axis(0), -axis(1), -axis(3)];
}
function readHand() {
  const sum = [0, 0, wheel];
  for (const key of keys) held[key].forEach((value, k) => { sum[k] += value; });
  gamepad().forEach((value, k) => { sum[k] += value; });
  hand.push = sum.map(value => Math.round(1000 * Math.max(-1, Math.min(1, value))) / 1000);
  sendHand();
  requestAnimationFrame(readHand);
}

// --- Buttons ---

function togglePause() { send("pause", {on: !(frame && frame.paused)}); }
for (const id of ["keep", "discard", "undo", "save", "restart", "perturb", "free", "clear", "take", "stop", "record"])
  byId(id).onclick = () => { send(id); canvas.focus({preventScroll: true}); };
byId("pause").onclick = togglePause;
byId("speed").onchange = () => send("speed", {factor: Number(byId("speed").value)});
byId("train").onclick = () => send("train", {steps: Math.round(Number(byId("steps").value)) || 0});
byId("filter-form").onsubmit = event => {
  event.preventDefault();
  if (byId("filter").value.trim()) send("filter", {text: byId("filter").value});
};
byId("named").onchange = () => { if (byId("named").value) send("filter", {text: byId("named").value}); };
byId("copy").onclick = () => {
  byId("flag").select();
  if (navigator.clipboard) navigator.clipboard.writeText(byId("flag").value);
};

// --- What there is to know ---

function drawScene() {
  byId("title").textContent = `${scene.mode === "record" ? "Record" : "Steer"}: ${scene.env} ${scene.task || ""}`;
  byId("recording").hidden = scene.mode !== "record";
  for (const element of document.querySelectorAll(".steer")) element.hidden = scene.mode !== "steer";
  byId("record").hidden = !scene.can_record_more;
  const keysFor = scene.axes > 2 ? "arrow keys, PageUp and PageDown (or the wheel)" : "arrow keys";
  const by = `hold the mouse or a finger on the picture, or use ${keysFor} or a gamepad`;
  byId("how").textContent = !scene.has_pointer ? "" : scene.mode === "record"
    ? `${scene.instruction} To move: ${by}. It runs at ${scene.rate} steps a second.`
    : `To drag the robot off its path: ${by}. Let go, and the policy goes on.`;
  if (scene.map) drawMapOptions();
}
function bars(box, counts) {
  box.replaceChildren();
  const largest = Math.max(1, ...Object.values(counts).map(([saved, kept]) => saved + kept));
  for (const [behavior, [saved, kept]] of Object.entries(counts).sort()) {
    const row = document.createElement("div"), name = document.createElement("span");
    const bar = document.createElement("i"), count = document.createElement("span");
    row.className = "bar";
    name.textContent = name.title = behavior || "(none)";
    bar.style.setProperty("--colour", colourOf(behavior));
    bar.style.width = `${100 * (saved + kept) / largest}%`;
    count.textContent = kept ? `${saved + kept} (+${kept})` : String(saved);
    row.append(name, bar, count);
    box.append(row);
  }
}
function drawState() {
  const {recording, steering} = state;
  if (recording) {
    const counts = {};
    for (const [behavior, n] of Object.entries(recording.saved)) counts[behavior] = [n, 0];
    for (const [behavior, n] of Object.entries(recording.kept))
      counts[behavior] = [(counts[behavior] || [0])[0], n];
    bars(byId("histogram"), counts);
    byId("counts").textContent =
      `${recording.n_saved} saved in ${recording.root}, ${recording.n_kept} kept and not saved yet`;
    byId("save").disabled = byId("undo").disabled = !recording.n_kept;
    byId("train").disabled = recording.n_saved + recording.n_kept < 2;
  }
  if (steering) drawSteering(steering);
}
function drawSteering(steering) {
  const n = steering.asked.length;
  byId("asked").textContent = !n ? "Any style, drawn anew for every rollout."
    : `Requested: ${n === 1 ? "the style of demonstration" : `${n} styles, of demonstrations`} ` +
      steering.asked.slice(0, 20).join(", ") + (n > 20 ? " …" : "");
  byId("flag").value = steering.flag;
  byId("score").textContent = steering.episodes
    ? `${steering.successes} of ${steering.episodes} rollouts succeeded` : "No rollout has ended yet.";
  const table = byId("outcomes");
  table.replaceChildren();
  for (const [requested, shown] of Object.entries(steering.outcomes).sort()) {
    const row = table.insertRow();
    row.insertCell().textContent = requested || "(no label)";
    row.insertCell().textContent =
      Object.entries(shown).map(([behavior, count]) => `${behavior || "(none)"} ${count}×`).join(", ");
  }
  if (scene && scene.map) drawMap();
}
function drawTraining(training) {
  const isRunning = training.state === "running";
  byId("progress").hidden = byId("stop").hidden = !isRunning;
  byId("train").hidden = isRunning;
  byId("progress").value = training.total ? training.done / training.total : 0;
  byId("training").textContent = {
    running: training.total ? `${training.done} of ${training.total} steps, ${training.seconds} s` : "Starting …",
    done: `Trained in ${training.seconds} s: ${training.folder}`,
    stopped: "Stopped.", failed: training.message}[training.state] + ` · ${training.command}`;
}

// --- The map ---

function drawMapOptions() {
  const {map} = scene;
  const fill = (select, names) => select.replaceChildren(...names.map(([text, value]) => new Option(text, value)));
  fill(byId("color"), Object.keys(map.columns).map(name => [name, name]));
  fill(byId("projection"), Object.keys(map.projections).map(name => [name, name]));
  fill(byId("named"), [["", ""], ...Object.entries(map.filters).map(([name, text]) => [`${name}: ${text}`, name])]);
  byId("named-label").hidden = !Object.keys(map.filters).length;
  if (map.color) byId("color").value = map.color;
  drawMap();
}
const escaped = value => String(value === "" ? "(none)" : value).slice(0, 80)
  .replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const maxEpisodes = 10000;  // as messages.py has it
let mapIsHeard = false;
function drawMap() {
  const {map} = scene, column = byId("color").value, values = map.columns[column] || map.episodes;
  const points = map.projections[byId("projection").value];
  const asked = new Set(state && state.steering ? state.steering.asked : []);
  const isNumber = map.kinds[column] !== undefined ? map.kinds[column] === "number" : true;
  const trace = (rows, name, marker) => ({
    type: "scatter", mode: "markers", name, x: rows.map(r => points[r][0]), y: rows.map(r => points[r][1]),
    customdata: rows.map(r => map.episodes[r]), hoverinfo: "text",
    text: rows.map(r => `demonstration ${map.episodes[r]}<br>${escaped(column)}: ${escaped(values[r])}`),
    marker: {size: rows.map(r => asked.has(map.episodes[r]) ? 17 : 11),
      line: {width: rows.map(r => asked.has(map.episodes[r]) ? 3 : .5), color: "#111"}, ...marker},
    selected: {marker: {opacity: 1}}, unselected: {marker: {opacity: 1}}});
  const all = map.episodes.map((_, r) => r);
  const traces = isNumber
    ? [trace(all, column, {color: values, colorscale: "Viridis", showscale: true})]
    : [...new Set(values)].sort().map(name =>
      trace(all.filter(r => values[r] === name), escaped(name), {color: colourOf(name)}));
  Plotly.react("map", traces, {margin: {l: 30, r: 8, t: 32, b: 28}, dragmode: "lasso", hovermode: "closest",
    showlegend: !isNumber && innerWidth > 600, xaxis: {zeroline: false}, yaxis: {zeroline: false}},
    {responsive: true, displaylogo: false, scrollZoom: false,
      modeBarButtonsToRemove: ["toImage", "zoomIn2d", "zoomOut2d", "autoScale2d"]});
  if (mapIsHeard) return;
  mapIsHeard = true;
  byId("map").on("plotly_click", event => send("style", {episodes: [event.points[0].customdata]}));
  byId("map").on("plotly_hover", event => { hovered = event.points[0].customdata; });
  byId("map").on("plotly_unhover", () => { hovered = null; });
  byId("map").on("plotly_selected", event => {
    if (!event || !event.points.length) return;
    if (event.points.length > maxEpisodes) say(`At most ${maxEpisodes} styles at once; type a filter for more.`, true);
    else send("style", {episodes: event.points.map(point => point.customdata)});
    Plotly.relayout("map", {selections: []});
  });
}
byId("color").onchange = byId("projection").onchange = () => drawMap();

connect();
readHand();
