// The phone's page: cues as sound, vibration and words; the phone's motion to the flow. Nothing begins without a tap.
const SILENCE = 1000; // ms without a word from the flow, which is as good as blind
const PITCH = { low: 330, waist: 660, head: 1320 };
const TONE = 0.03, DROP_TONE = 0.2, EARS = 0.0006, WIDEST = Math.PI / 3; // s, s, s, rad
const PINGS = 20; // round trips of which the shortest one tells the offset
const $ = (id) => document.getElementById(id);

const state = { cue: null, text: "", heard: performance.now(), open: false, blind: true, audio: null, on: {}, guidance: { volume: 0.5, range: 3, levels: Object.keys(PITCH).concat("drop"), tick: 5 }, trips: [], sent: 0, lost: 0, waiting: [], orientation: null, played: [] };
window.caneflow = state; // for tests
let socket = null, timer = 0, spoken = "";

const now = () => performance.timeOrigin + performance.now(); // ms of this phone's clock

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/phone?key=${encodeURIComponent(location.hash.slice(1))}`);
  socket.onopen = () => { state.open = true; state.trips = []; ping(); };
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => { state.open = false; look(); setTimeout(connect, 500); };
}

function take(message) {
  state.heard = performance.now();
  if (message.hello) greet(message.hello);
  if (message.pong !== undefined) state.trips.push({ delay: now() - message.pong, offset: message.at - (message.pong + now()) / 2 });
  if (state.trips.length > PINGS) state.trips.shift();
  if (message.cue) { state.cue = message.cue; state.cueAt = performance.now(); }
  look();
}

function greet(hello) {
  state.hello = hello;
  Object.assign(state.guidance, hello.guidance);
  const missing = [];
  offer("sound", hello.hears, "AudioContext" in window || "webkitAudioContext" in window, "sound", missing);
  offer("vibration", hello.hears, "vibrate" in navigator, "vibration", missing);
  offer("voice", hello.hears, "speechSynthesis" in window, "a voice of its own: use the screen reader", missing);
  offer("motion", hello.senses, "DeviceMotionEvent" in window && window.isSecureContext, "motion sensors on this page", missing);
  $("missing").replaceChildren(...missing.map((each) => Object.assign(document.createElement("li"), { textContent: `This browser has no ${each}.` })));
}

function offer(id, wanted, there, name, missing) {
  $(id).hidden = !(wanted && there);
  if (wanted && !there) missing.push(name);
}

// --- what is told ---------------------------------------------------------------------------------------------

function look() {
  const silent = performance.now() - state.heard > SILENCE;
  const stale = state.hello?.hears && (!state.cueAt || performance.now() - state.cueAt > SILENCE);
  const why = !state.open ? "the link is lost" : silent || stale ? "nothing comes from the cane" : "";
  const blind = Boolean(why) || state.cue?.kind === "blind";
  $("link").textContent = why ? `Not connected: ${why}` : "Connected";
  document.body.classList.toggle("blind", blind && (state.hello?.hears ?? true));
  if (state.hello?.hears || !state.open) words(why ? `Not seeing: ${why}` : state.cue?.text || "Nothing yet");
  else words("This phone's motion goes to the flow when you ask for it.");
  const was = state.sounding;
  state.blind = blind;
  state.sounding = blind ? "blind" : ["obstacle", "drop"].includes(state.cue?.kind) && state.cue.distance <= state.guidance.range && state.guidance.levels.includes(state.cue.level) ? state.cue.level : "none";
  if (was !== state.sounding && (["blind", "drop"].includes(state.sounding) || ["none", "blind", undefined].includes(was))) { clearTimeout(timer); beat(); }
}

function words(text) {
  if (text === spoken) return;
  spoken = text;
  $("cue").textContent = text;
  if (!state.on.voice) return; // the live region tells it
  speechSynthesis.cancel();
  speechSynthesis.speak(new SpeechSynthesisUtterance(text));
}

function beat() {
  const level = state.sounding, cue = state.cue;
  let next = 250;
  if (level === "blind") { play(150, 0.16, 0, 0); play(150, 0.16, 0, 0.24); buzz([300, 100, 300]); next = 10000; }
  else if (level && level !== "none") {
    const share = (Math.min(Math.max(cue.distance, 0.5), 3) - 0.5) / 2.5;
    next = 1000 * (0.12 + 0.83 * share);
    if (level === "drop") { play(220, DROP_TONE, cue.azimuth, 0, 110); buzz(200); next = Math.max(next, 300); }
    else { play(PITCH[level], TONE, cue.azimuth, 0); buzz(40); }
  } else if (state.guidance.tick) { play(2000, 0.008, 0, 0, 0, 0.12); next = 1000 * state.guidance.tick; }
  timer = setTimeout(beat, next);
}

function play(pitch, seconds, azimuth, later, until = 0, loudness = 1) {
  state.played.push({ at: performance.now(), pitch, azimuth });
  if (state.played.length > 1000) state.played.shift();
  const audio = state.audio;
  if (!audio || !state.on.sound) return;
  const begin = audio.currentTime + later, wave = audio.createOscillator(), gain = audio.createGain();
  wave.type = pitch < 300 ? "triangle" : "sine"; // a small loudspeaker needs the harmonics of a low tone
  wave.frequency.setValueAtTime(pitch, begin);
  if (until) wave.frequency.exponentialRampToValueAtTime(until, begin + seconds);
  gain.gain.setValueAtTime(0, begin);
  gain.gain.linearRampToValueAtTime(loudness * state.guidance.volume, begin + 0.003);
  gain.gain.exponentialRampToValueAtTime(0.001, begin + seconds);
  wave.connect(gain);
  const merger = audio.createChannelMerger(2), side = Math.min(Math.max(azimuth / WIDEST, -1), 1);
  [0, 1].forEach((ear) => {
    const delay = audio.createDelay(0.01), share = audio.createGain();
    delay.delayTime.value = (ear === 0 ? azimuth < 0 : azimuth > 0) ? EARS * Math.abs(Math.sin(azimuth)) : 0;
    share.gain.value = ear === 0 ? Math.cos((1 - side) * Math.PI / 4) : Math.sin((1 - side) * Math.PI / 4);
    gain.connect(delay); delay.connect(share); share.connect(merger, 0, ear);
  });
  merger.connect(audio.destination);
  wave.start(begin); wave.stop(begin + seconds + 0.01);
}

function buzz(pattern) { if (state.on.vibration) navigator.vibrate(pattern); }

// --- what is asked for by a tap -------------------------------------------------------------------------------

function press(id, on) { state.on[id] = on; $(id).setAttribute("aria-pressed", String(on)); }

$("sound").onclick = async () => {
  press("sound", !state.on.sound);
  if (!state.audio) state.audio = new (window.AudioContext || window.webkitAudioContext)();
  if (state.on.sound) await state.audio.resume();
};
$("vibration").onclick = () => { press("vibration", !state.on.vibration); navigator.vibrate(state.on.vibration ? 100 : [100, 100, 100]); };
$("voice").onclick = () => {
  press("voice", !state.on.voice);
  $("cue").setAttribute("aria-live", state.on.voice ? "off" : "polite"); // never both
  if (!state.on.voice) speechSynthesis.cancel();
};
$("motion").onclick = async () => {
  const ask = window.DeviceMotionEvent?.requestPermission;
  if (!state.on.motion && ask && (await DeviceMotionEvent.requestPermission()) !== "granted") {
    $("sent").textContent = "The browser does not let this page read the motion sensors.";
    return;
  }
  press("motion", !state.on.motion);
};

// --- what is sent ---------------------------------------------------------------------------------------------

const isApple = /iPhone|iPad|iPod/.test(navigator.userAgent); // there, gravity has the other sign
window.addEventListener("deviceorientation", (event) => {
  if (event.alpha !== null) state.orientation = { t: performance.timeOrigin + event.timeStamp, angles: [event.alpha, event.beta, event.gamma] };
});
window.addEventListener("devicemotion", (event) => {
  if (!state.on.motion || event.rotationRate?.alpha == null) return;
  const t = performance.timeOrigin + event.timeStamp, rate = event.rotationRate, sign = isApple ? -1 : 1;
  const reading = { t, rate: [rate.beta, rate.gamma, rate.alpha] };
  if (event.accelerationIncludingGravity?.x != null) { const a = event.accelerationIncludingGravity; reading.accel = [sign * a.x, sign * a.y, sign * a.z]; }
  if (event.acceleration?.x != null) { const a = event.acceleration; reading.linear = [sign * a.x, sign * a.y, sign * a.z]; }
  if (state.orientation && t - state.orientation.t < 100) reading.angles = state.orientation.angles;
  state.waiting.push(reading);
});

function flush() {
  if (!state.waiting.length) return;
  const best = state.trips.reduce((a, b) => (b.delay < a.delay ? b : a), state.trips[0] ?? null);
  if (!state.open || !best) { if (state.waiting.length > 200) { state.lost += state.waiting.length; state.waiting = []; } return; }
  const readings = state.waiting.splice(0, 50);
  socket.send(JSON.stringify({ readings, offset: best.offset, delay: best.delay, lost: state.lost }));
  state.sent += readings.length;
  $("sent").textContent = state.lost ? `${state.lost} readings were lost without a link.` : "";
}

function ping() { if (state.open && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ping: now() })); }

document.addEventListener("visibilitychange", () => {
  if (document.hidden) { state.cueAt = 0; state.away = true; look(); } // in the background nothing is sure to be heard
  else if (state.away) { state.away = false; state.audio?.resume(); look(); }
});
setInterval(look, 100);
setInterval(flush, 20);
setInterval(ping, 500);
connect();
