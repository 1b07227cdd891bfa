// The page: takes batches from the server, keeps the series, draws what the time cursor points at.

import { Chart } from "./charts.js";
import { readColours } from "./ink.js";
import { isUnsure, Plan } from "./plan.js";
import { ObstaclePicture, obstacleRows, obstaclesInWords } from "./obstacles.js";
import { RadarMap } from "./radar.js";
import { named, Series } from "./series.js";
import { edgeRow, nodeRow, recordedRow, streamRow, Table } from "./tables.js";
import { decode } from "./wire.js";
import { degrees, medianEdge, number, pictureInWords, sentence } from "./words.js";

const MOST_PICTURES = 1200; // range-Doppler maps kept of a running flow: two minutes
const TROUBLES = { failed: "has failed", waiting: "has ended and is started again" }; // what a node's state means
const STALE = 1.5; // s without a new position, from which on it is said
const RETRY = 1000; // ms between two attempts to connect
const CALM_DRAWING = 500; // ms between two drawings when reduced motion is wanted
const CALM_SCRUBBING = 700; // ms between two sentences while the time cursor is moved by hand
const LONG_FRAME = 8; // ms that a frame may take on average; if longer, fewer charts are drawn with each
const SHORT_FRAME = 4; // ms, below which there may be more
const SMOOTHING = 0.1; // of that mean
const MOST_TURNS = 100;
const MOST_COSTS = 1000;
const MOST_LATENCIES = 20_000;

const $ = (id) => document.getElementById(id);
const still = matchMedia("(prefers-reduced-motion: reduce)");
const dark = matchMedia("(prefers-color-scheme: dark)");

const plan = new Plan($("plan"));
const radar = new RadarMap($("radar"));
const charts = {
  speed: new Chart($("speed"), { least: [-0.1, 1], lines: [{ label: "speed", column: "speed", band: "quality" }] }),
  gyro: new Chart($("gyro"), { least: [-1, 1], lines: ["x", "y", "z"].map((a) => ({ label: a, column: `gyro_${a}` })) }),
  accel: new Chart($("accel"), { least: [-2, 10], lines: ["x", "y", "z"].map((a) => ({ label: a, column: `accel_${a}` })) }),
};
const targetCharts = new Map();
const nodes = new Table($("nodes"), 6);
const edges = new Table($("edges"), 10);
const obstacles = new Table($("obstacles"), 4);
const obstaclePicture = new ObstaclePicture($("obstacles-picture"));

let state = fresh();
let socket = null;
let dirty = false;
let shownUnsure = false;
let lastDrawn = 0;
let lastSaid = 0;
let turn = 0; // whose turn it is to be drawn
let owed = 0; // how many of the charts and the map have not been drawn since something changed
let share = 1; // how many of them are drawn with each frame
let frame = LONG_FRAME; // ms that a frame takes, on average
let undrawn = []; // of a live flow: stamps of the poses that have come since the last drawing, s of the epoch
const latencies = []; // s from a pose's stamp to the end of the frame that shows it
const costs = []; // ms of the last drawings
const shownWords = {}; // by id: what was put there last

function fresh() {
  return {
    hello: null,
    origin: 0,
    series: new Map(),
    pictures: [],
    at: null, // a recording's answer for the cursor
    asked: null,
    cursor: null, // s; null: the newest
    playing: false,
    playedAt: 0,
    ended: false,
    primary: null,
    newestTime: 0,
    cameAt: 0, // ms, when the last position came
    states: {},
    span: 0,
  };
}

// --- what comes ---------------------------------------------------------------------------------------------------

function connect() {
  const key = location.hash.slice(1);
  if (!key) {
    connection("bad", "✕ no key");
    $("trouble").textContent = "This address lacks its key. Open the whole one that caneflow view printed.";
    return;
  }
  socket = new WebSocket(`ws://${location.host}/samples?key=${encodeURIComponent(key)}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => take(decode(data));
  socket.onclose = ({ code }) => {
    connection("bad", state.ended ? "■ ended" : "✕ not connected");
    if (code === 4403 || (code === 1006 && !state.hello)) {
      $("trouble").textContent = "The view does not answer to this address. Is it the newest that caneflow view printed?";
    }
    setTimeout(connect, RETRY);
  };
}

function connection(className, words) {
  const place = $("connection");
  if (place.textContent !== words) place.textContent = words;
  place.className = className;
}

function take(message) {
  if (message.kind === "hello") takeHello(message);
  else if (message.kind === "batch") takeBatch(message);
  else if (message.kind === "pictures") takePictures(message);
  else if (message.kind === "at") takeAnswer(message);
  else if (message.kind === "skipped") {
    $("skipped").textContent = `⚠ This page was too slow for ${message.batches} batches.`;
  } else if (message.kind === "read" && message.problem) {
    $("trouble").textContent = message.problem;
  }
  const samples = message.kind !== "batch" || Object.keys(message.streams ?? {}).length > 0;
  if (message.kind === "pictures") owed = MOST_TURNS; // it is drawn with the next batch
  else if (samples) touch();
  else if (owed) again();
}

function takeHello(hello) {
  state = fresh();
  undrawn = [];
  state.hello = hello;
  state.span = hello.span ?? 0;
  const recorded = hello.source === "recording";
  $("flow").textContent = hello.flow;
  document.title = `${hello.flow} – caneflow`;
  $("trouble").textContent = "";
  $("note").textContent = hello.note;
  $("note").hidden = !hello.note;
  $("pace-label").hidden = !recorded;
  $("newest").textContent = recorded ? "End" : "Newest";
  if (recorded) state.cursor = state.span; // the whole track
  connection("good", { live: "● live", replay: "● replay", recording: "■ recording" }[hello.source]);
  showPause();
}

function takeBatch(batch) {
  state.origin = batch.origin;
  const endless = state.hello.source !== "recording";
  for (const [name, sent] of Object.entries(batch.streams ?? {})) {
    const times = new Float64Array(sent.times);
    const rows = new Float64Array(sent.rows);
    const series = seriesOf(name, sent);
    if (!series.width && rows.length) continue;
    series.append(times, rows, endless);
    series.gaps = sent.gaps;
    series.every = sent.every ?? 1;
    series.of = sent.of ?? null;
    series.method = sent.method || series.method;
    series.lastSeq = sent.first_seq + (times.length - 1) * series.every;
    state.newestTime = Math.max(state.newestTime, series.lastTime);
    if (series.type !== "Pose") continue;
    if (times.length) state.cameAt = performance.now();
    if (batch.ended !== undefined) for (const time of times) undrawn.push(batch.origin + time); // not what was before
  }
  if (batch.traffic) showTables(batch);
  if (!endless) edges.show([...state.series.values()].map(recordedRow));
  if (batch.ended && !state.ended) {
    state.ended = true;
    connection("wait", "■ the flow has ended");
  }
}

function takePictures({ pictures }) {
  state.pictures.push(...pictures.map(opened));
  if (state.pictures.length > MOST_PICTURES) state.pictures.splice(0, MOST_PICTURES / 4);
}

function seriesOf(name, sent) {
  let series = state.series.get(name);
  if (!series || (!series.width && sent.columns.length)) {
    series = new Series(name, sent.type, sent.columns);
    series.fromStart = sent.first_seq === 0;
    state.series.set(name, series);
    showPanels();
  }
  return series;
}

function opened(picture) {
  const found = { ...picture, levels: new Uint8Array(picture.levels), edges: new Float64Array(picture.edges) };
  found.edge = medianEdge(found.edges);
  return found;
}

function takeAnswer(answer) {
  state.asked = null;
  state.at = { ...answer, pictures: answer.pictures.map(opened) };
}

// --- what is shown ------------------------------------------------------------------------------------------------

function all(type) {
  return [...state.series.values()].filter((series) => series.type === type);
}

function first(type) {
  return all(type)[0] ?? null;
}

function tracks() {
  const rank = (name) => (name === "truth/pose" ? "" : name); // not the order in which they came
  const poses = all("Pose").sort((a, b) => (rank(a.name) < rank(b.name) ? -1 : 1));
  const estimates = poses.filter(({ name }) => name !== "truth/pose");
  const primary = poses.find(({ name }) => name === state.primary) ?? estimates.find(isSure) ?? estimates[0] ?? poses[0];
  const absolute = Object.keys(state.hello?.sensors ?? {}).length > 0;
  return poses.map((series) => {
    const truth = series.name === "truth/pose";
    const shift = truth && !absolute && primary && primary !== series ? between(series, primary) : [0, 0];
    return { series, truth, primary: series === primary, shift };
  });
}

// Whether a track has ever said how far off it may be: such a one is shown first.
function isSure(series) {
  series.sure ||= Number.isFinite(series.sample(series.length - 1)?.major);
  return series.sure;
}

// From where a truth begins to where the estimate begins: a cane knows only its own start.
function between(truth, estimate) {
  const to = estimate.sample(0);
  const from = truth.sample(Math.max(0, truth.upTo(to?.time ?? 0) - 1));
  return to && from ? [to.x - from.x, to.y - from.y] : [0, 0];
}

function showPanels() {
  const found = tracks();
  $("tracks").hidden = found.length < 2;
  $("primary").replaceChildren(
    ...found.map(({ series, primary }) => new Option(series.name, series.name, primary, primary)),
  );
  $("speed-card").hidden = !first("GroundSpeed");
  $("gyro-card").hidden = $("accel-card").hidden = !first("Imu");
  $("radar-card").hidden = !first("RadarFrame");
  $("obstacles-card").hidden = !first("Obstacles");
  $("target-card").hidden = !first("DopplerTarget");
  for (const series of all("DopplerTarget")) {
    if (targetCharts.has(series.name)) continue;
    const holder = document.createElement("div");
    holder.className = "chart";
    holder.setAttribute("role", "img");
    const words = document.createElement("p");
    words.className = "hint";
    $("targets").append(holder, words);
    const chart = new Chart(holder, { least: [-1, 1], lines: [{ label: series.name, column: "range_rate" }] });
    targetCharts.set(series.name, { chart, words, holder });
  }
}

function showTables({ traffic, status, unheard }) {
  const found = status ?? { nodes: [], edges: [] };
  $("nodes-card").hidden = !found.nodes.length;
  nodes.show(found.nodes.map(nodeRow));
  edges.show([
    ...found.edges.map(edgeRow),
    ...Object.entries(traffic).map(([name, seen]) => streamRow(name, seen)),
  ]);
  for (const { node, state: now, said } of found.nodes) {
    const trouble = TROUBLES[now];
    if (trouble && state.states[node] !== now) $("trouble").textContent = `${node} ${trouble}: ${said}`;
    if (now === "ready" && $("trouble").textContent.startsWith(`${node} ${TROUBLES.waiting}`)) $("trouble").textContent = "";
    state.states[node] = now;
  }
  if (unheard) $("trouble").textContent = `The view itself was too slow for ${unheard} samples; the flow lost none.`;
}

function now() {
  return state.cursor ?? state.newestTime;
}

function end() {
  return state.hello?.source === "recording" ? state.span : state.newestTime;
}

// The sample of a series at the cursor: exact, in a thinned recording as well.
function sampleAt(series) {
  const exact = state.at?.at === state.cursor ? state.at?.values[series.name] : null;
  if (exact) return named(series, exact.time, new Float64Array(exact.row));
  return series.sample(series.upTo(now()) - 1);
}

// What costs time to draw: it takes turns, while the plan and all numbers come with every batch.
function drawing() {
  const time = now();
  const span = Number($("span").value);
  const to = state.cursor === null ? time : Math.min(Math.max(time + 0.25 * span, span), Math.max(end(), span));
  const from = to - span;
  const ground = first("GroundSpeed");
  const imu = first("Imu");
  const turns = state.cursor === null ? [showTime] : [];
  const show = (chart, series, words) => {
    if (!series) return;
    turns.push(() => {
      chart.draw(series, from, to, time);
      words(sampleAt(series));
    });
  };
  show(charts.speed, ground, speedInWords);
  if (first("RadarFrame")) turns.push(showPicture);
  if (first("Obstacles")) turns.push(showObstacles);
  show(charts.gyro, imu, imuInWords);
  show(charts.accel, imu, () => {});
  for (const [name, target] of targetCharts) {
    show(target.chart, state.series.get(name), (sample) => targetInWords(name, target, sample));
  }
  return turns;
}

// Draw as many as there is time for in a frame, going on where the last one left off.
function drawInTurns() {
  const turns = drawing();
  const count = still.matches ? turns.length : Math.min(owed, share, turns.length);
  for (let i = 0; i < count; i += 1) {
    turn = (turn + 1) % turns.length;
    turns[turn]();
  }
  owed = Math.max(0, Math.min(owed, turns.length) - count);
}

function draw() {
  const found = tracks();
  const primary = found.find((track) => track.primary);
  if (primary && $("primary").value !== primary.series.name) $("primary").value = primary.series.name;
  const pose = primary ? sampleAt(primary.series) : null;
  const stale = staleness(primary);
  const ground = first("GroundSpeed");
  const speed = ground ? sampleAt(ground) : null;
  plan.draw(found, state.hello ?? {}, now(), stale);
  showNumbers(pose, speed, primary, stale);
  if (state.cursor !== null) showTime(); // someone moves it
  drawInTurns();
}

function staleness(primary) {
  if (!primary || state.cursor !== null || state.hello.source === "recording" || !primary.series.length) return null;
  const waited = (performance.now() - state.cameAt) / 1000;
  return waited > STALE ? waited : null;
}

function put(id, words) {
  if (shownWords[id] === words) return;
  $(id).textContent = shownWords[id] = words;
}

function showNumbers(pose, speed, primary, stale) {
  put("at-x", pose ? `${number(pose.x)} m` : "–");
  put("at-y", pose ? `${number(pose.y)} m` : "–");
  put("at-yaw", pose ? degrees(pose.yaw) : "–");
  put("at-sure", !pose ? "–" : Number.isFinite(pose.major) ? `±${number(pose.major)} m` : "not known");
  const unsure = Boolean(pose && isUnsure(pose));
  if (unsure !== shownUnsure) $("at-sure").classList.toggle("unsure", (shownUnsure = unsure));
  put("at-speed", speed ? (speed.valid ? `${number(speed.speed)} m/s` : "not valid") : pose ? `${number(Math.hypot(pose.vx, pose.vy))} m/s` : "–");
  put("at-quality", speed?.valid ? `±${number(speed.quality)} m/s` : "–");
  put("at-seq", primary && state.cursor === null && primary.series.lastSeq !== null ? String(primary.series.lastSeq) : pose ? `at ${number(pose.time)} s` : "–");
  if (!primary || !pose) return;
  const words = sentence(pose, primary.series, speed?.valid ? speed.speed : null, stale);
  put("words", words);
  const calm = Number($("calm").value);
  const waited = performance.now() - lastSaid;
  const moved = state.cursor !== null && !state.playing && state.cursor !== state.saidAt; // by hand: soon
  if (calm && (lastSaid === 0 || waited > 1000 * calm || (moved && waited > CALM_SCRUBBING))) say(words);
  else if (calm && moved) soon();
}

function soon() {
  clearTimeout(state.soon);
  state.soon = setTimeout(() => {
    touch();
  }, CALM_SCRUBBING);
}

// To screen readers: the words are there at any time, and are spoken only now and then.
function say(words) {
  lastSaid = performance.now();
  state.saidAt = state.cursor;
  put("said", words);
}

function speedInWords(speed) {
  if (!speed) return;
  const said = `${number(speed.speed)} m/s, quality ±${number(speed.quality)} m/s`;
  put("speed-words", speed.valid ? `${said}, ${speed.rays} rays` : `not valid: ${speed.rays} rays`);
}

function imuInWords(imu) {
  if (!imu) return;
  const three = (name) => ["x", "y", "z"].map((axis) => `${axis} ${number(imu[`${name}_${axis}`])}`).join(", ");
  put("gyro-words", `${three("gyro")} rad/s`);
  put("accel-words", `${three("accel")} m/s²`);
}

function targetInWords(name, { words, holder }, target) {
  if (!target) return;
  const valid = target.valid ? "" : ", not valid";
  const said = `${name}: ${number(target.range_rate)} m/s, ${number(target.snr, 0)} dB${valid}`;
  if (words.textContent === said) return;
  words.textContent = said;
  holder.setAttribute("aria-label", `Doppler target ${said}`);
}

function showObstacles() {
  const found = sampleAt(first("Obstacles"));
  if (!found) return;
  const cues = first("Cue");
  const cue = cues ? sampleAt(cues) : null;
  obstacles.show(obstacleRows(found));
  obstaclePicture.draw(found, cue);
  const said = obstaclesInWords(found, cue);
  if ($("obstacles-words").textContent !== said) $("obstacles-words").textContent = said;
}

function showPicture() {
  let picture = null;
  if (state.hello.source === "recording") picture = state.at?.pictures[0] ?? null;
  else {
    const time = now();
    picture = state.pictures.findLast((each) => each.time <= time + 1e-9) ?? null;
  }
  if (picture && picture !== state.drawn && radar.isVisible()) {
    radar.draw(picture);
    put("radar-words", pictureInWords(picture, picture.edge));
  } else if (!picture) put("radar-words", "There are too few scans for a map yet.");
  state.drawn = picture;
}

function showTime() {
  const cursor = $("cursor");
  cursor.max = Math.max(end(), 0.01);
  cursor.value = now();
  const behind = state.hello && state.hello.source !== "recording" && state.cursor !== null ? end() - now() : 0;
  const words = state.hello?.source === "recording" ? `${number(now())} of ${number(end())} s` : `${number(now())} s`;
  put("time", behind > 0.05 ? `${words} (−${number(behind, 1)})` : words);
  cursor.setAttribute("aria-valuetext", behind > 0.05 ? `${number(now(), 1)} seconds, ${number(behind, 0)} behind` : `${number(now(), 1)} seconds`);
}

function showPause() {
  const held = state.hello?.source === "recording" ? !state.playing : state.cursor !== null;
  $("pause").textContent = state.hello?.source === "recording" ? (held ? "Play" : "Pause") : held ? "Go on" : "Pause";
  if (state.hello && state.hello.source !== "recording" && !state.ended) {
    connection(held ? "wait" : "good", held ? "❚❚ paused" : state.hello.source === "replay" ? "● replay" : "● live");
  }
}

// --- the clock of the page ----------------------------------------------------------------------------------------

// Something has changed: draw with the next frame. Without changes there are no frames.
function touch() {
  owed = MOST_TURNS;
  again();
}

// Draw what is still owed with the next frame.
function again() {
  if (dirty) return;
  dirty = true;
  requestAnimationFrame(tick);
}

function tick(at) {
  dirty = false;
  if (!state.hello) return;
  const wait = CALM_DRAWING - (at - lastDrawn);
  if (still.matches && wait > 0) {
    setTimeout(touch, wait);
    return;
  }
  lastDrawn = at;
  if (state.playing) play(at);
  ask();
  const begin = performance.now();
  draw();
  costs.push(performance.now() - begin);
  if (costs.length > MOST_COSTS) costs.shift();
  measure(begin);
  if (state.playing) touch();
  else if (owed && state.cursor !== null) again(); // the rest, when nothing comes any more
}

function play(at) {
  const pace = Number($("pace").value);
  state.cursor = Math.min(state.span, state.cursor + (pace * (at - state.playedAt)) / 1000);
  state.playedAt = at;
  if (state.cursor >= state.span) {
    state.playing = false;
    showPause();
  }
}

// Of a recording: the exact samples and the map at the cursor, one question at a time.
function ask() {
  if (state.hello.source !== "recording" || state.asked !== null || state.at?.at === state.cursor) return;
  if (socket.readyState !== WebSocket.OPEN) return;
  state.asked = state.cursor;
  socket.send(JSON.stringify({ at: state.cursor }));
}

// How long the frame took, and the samples that have just been drawn: taken after the frame has been handed on.
function measure(begin) {
  const drawn = state.cursor === null && state.hello.source === "live" ? undrawn : [];
  undrawn = [];
  const channel = new MessageChannel();
  channel.port1.onmessage = () => {
    const end = performance.now();
    budget(end - begin);
    const seen = (performance.timeOrigin + end) / 1000;
    for (const taken of drawn) latencies.push(seen - taken);
    if (latencies.length > MOST_LATENCIES) latencies.splice(0, latencies.length - MOST_LATENCIES);
  };
  channel.port2.postMessage(null);
}

// More charts with each frame while frames are short, fewer when they are long: position and numbers come first.
function budget(took) {
  frame += SMOOTHING * (took - frame);
  if (frame > LONG_FRAME && share > 1) share -= 1;
  else if (frame < SHORT_FRAME && share < MOST_TURNS) share += 1;
}

function showLatency() {
  const recent = latencies.slice(-2000).sort((a, b) => a - b);
  $("latency").hidden = !recent.length || state.hello?.source !== "live";
  if (!recent.length) return;
  const part = (share) => number(1000 * recent[Math.min(recent.length - 1, Math.floor(share * recent.length))], 0);
  $("latency").textContent = `pose to screen: median ${part(0.5)} ms, 99 % ${part(0.99)} ms`;
}

// --- what one does ------------------------------------------------------------------------------------------------

function hold(time) {
  state.cursor = Math.min(Math.max(time, 0), end());
  state.playing = false;
  showPause();
  touch();
}

function newest() {
  if (state.hello?.source === "recording") hold(end());
  else {
    state.cursor = null;
    showPause();
    touch();
  }
}

function pause() {
  if (state.hello?.source === "recording") {
    state.playing = !state.playing;
    state.playedAt = performance.now();
    if (state.playing && state.cursor >= state.span) state.cursor = 0;
    showPause();
    touch();
  } else if (state.cursor === null) hold(now());
  else newest();
}

function mode(name) {
  plan.mode = name;
  showMode();
}

function showMode() {
  $("fit").setAttribute("aria-pressed", String(plan.mode === "fit"));
  $("follow").setAttribute("aria-pressed", String(plan.mode === "follow"));
  touch();
}

function zoom(factor) {
  plan.zoom(factor);
  showMode();
}

function sayNow() {
  put("said", ""); // so that the same words are said again
  say($("words").textContent);
}

function movePlan(key) {
  const [x, y] = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[key];
  plan.shift(x, y);
  showMode();
}

function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || !$("single").checked || $("keys-dialog").open) return;
  const on = document.activeElement;
  if (on === $("plan") && event.key.startsWith("Arrow")) {
    movePlan(event.key);
    event.preventDefault();
    return;
  }
  if (on.matches("select, input[type=text]") || (on.matches("button, a") && (event.key === " " || event.key === "Enter"))) return;
  const step = event.shiftKey ? 1 : 0.1;
  const does = {
    " ": pause,
    ArrowLeft: () => hold(now() - step),
    ArrowRight: () => hold(now() + step),
    Home: () => hold(0),
    End: newest,
    w: sayNow,
    "+": () => zoom(1.25),
    "-": () => zoom(0.8),
    a: () => mode("fit"),
    f: () => mode("follow"),
    "?": () => $("keys-dialog").showModal(),
  }[event.key];
  if (!does) return;
  event.preventDefault();
  does();
}

function theme() {
  const chosen = $("theme").value;
  document.documentElement.toggleAttribute("data-dark", chosen ? chosen === "dark" : dark.matches);
  readColours();
  for (const { chart } of [...Object.values(charts).map((chart) => ({ chart })), ...targetCharts.values()]) {
    if (chart.plot) chart.build();
  }
  state.drawn = undefined;
  touch();
}

plan.changed = showMode;
plan.resized = touch;
radar.resized = () => {
  state.drawn = undefined;
  touch();
};
$("pause").onclick = pause;
$("newest").onclick = newest;
$("cursor").oninput = () => hold(Number($("cursor").value));
$("fit").onclick = () => mode("fit");
$("follow").onclick = () => mode("follow");
$("closer").onclick = () => zoom(1.25);
$("wider").onclick = () => zoom(0.8);
$("keys").onclick = () => $("keys-dialog").showModal();
$("primary").onchange = () => {
  state.primary = $("primary").value;
  lastSaid = 0;
  touch();
};
$("span").onchange = touch;
$("theme").onchange = theme;
dark.addEventListener("change", theme);
addEventListener("keydown", onKey);
new ResizeObserver(() => {
  state.drawn = undefined;
  touch();
}).observe($("main"));
setInterval(showLatency, 1000);

theme();
connect();
setInterval(() => {
  if (state.hello && state.cursor === null && performance.now() - state.cameAt > 1000 * STALE) touch(); // it grows old
}, CALM_DRAWING);

// For tests, and for the curious: what the page knows.
window.caneflow = {
  latencies,
  costs,
  get state() {
    return state;
  },
};
