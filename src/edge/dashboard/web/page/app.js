// The page: which view is shown, what the server is asked for, when something is drawn.

import { Bed } from "./bed.js";
import { startCommands } from "./commands.js";
import { Connection } from "./connection.js";
import { byId, setAttribute, setHidden, setText } from "./dom.js";
import { save } from "./export.js";
import { decodeFrame } from "./frame.js";
import { Meter } from "./meter.js";
import { duration } from "./numbers.js";
import { onTheme, startTheme } from "./theme.js";
import { SPANS_S } from "./viewport.js";
import { Ward } from "./ward.js";

const SPAN_KEYS = "12345";
/** An arrow key goes by so much of what is shown. */
const STEP_SPANS = 0.25;

/** Time between two pictures of a bed [ms]. */
const PICTURE_EVERY_MS = 45;

const meter = new Meter();
let view = "ward";
let isDue = false;

startTheme(byId("theme"));
const ward = new Ward();
const connection = new Connection({ onFrame: takeFrame, onText: takeText, onState: showConnection });
const bed = new Bed({ show: (wish) => connection.show(wish), send: (order) => connection.send(order), changed: requestDraw });

function takeFrame(buffer) {
  try {
    const { head, numbers } = decodeFrame(buffer);
    if (head.kind === "ward" && view === "ward") ward.take(head);
    else if (head.kind === "bed" && view === "bed") bed.take(head, numbers);
    else return;
    showBus(head.connected);
    setHidden(byId("misread"), true);
  } catch (error) {
    setText(byId("misread"), `A frame of the server was not understood: ${error.message}`);
    setHidden(byId("misread"), false);
  }
  if (view === "ward") requestDraw();
}

function takeText(text) {
  const message = JSON.parse(text);
  if (message.kind === "answer") bed.answer(message);
}

// One picture at most is due, of whatever is newest by then: a slow browser skips pictures instead of falling behind.
function requestDraw() {
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(draw);
}

function draw() {
  const now = performance.now();
  isDue = false;
  if (view === "ward") ward.draw();
  if (view === "ward" || bed.draw(now)) meter.tick(now);
}

// Waveforms go on between two frames of the server; they are shown a little later than they come, and evenly. Nothing
// else on the page changes with them, so that they do not wait for a frame of the page.
setInterval(() => {
  if (view === "bed" && !document.hidden) draw();
}, PICTURE_EVERY_MS);

function showConnection(state) {
  setAttribute(byId("connection"), "data-state", state);
  setText(byId("connection"), state === "open" ? "● connected" : "✕ lost");
  document.body.dataset.connection = state;
  byId("lost").hidden = state === "open";
  if (state === "lost") bed.lose();
}

function showBus(isConnected) {
  setHidden(byId("bus"), isConnected !== false);
}

setInterval(() => {
  if (connection.state !== "lost") return;
  setText(byId("lost-age"), `What you see is ${duration(connection.silentFor())} old. Trying again by itself.`);
}, 500);

function route() {
  const before = bed.name;
  const name = location.hash.startsWith("#bed/") ? decode(location.hash.slice("#bed/".length)) : "";
  view = name ? "bed" : "ward";
  byId("ward-view").hidden = view !== "ward";
  byId("bed-view").hidden = view !== "bed";
  byId("back").hidden = view !== "bed";
  byId("export-png").disabled = view !== "bed";
  document.body.dataset.view = view;
  if (name) {
    scrollTo(0, 0);
    bed.open(name);
    return;
  }
  if (before) bed.close();
  connection.show({ show: "ward" });
  requestDraw();
  if (before) requestAnimationFrame(() => ward.focus(before));
}

function decode(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

function exportCsv() {
  if (view === "bed") bed.export("csv");
  else save(new Blob([ward.csv()], { type: "text/csv" }), "ward.csv");
}

function showKeys() {
  byId("keys").showModal();
}

const inWard = { views: ["ward"], where: "ward" };
const inBed = { views: ["bed"], where: "bed" };
const anywhere = { where: "everywhere" };

const commands = [
  { names: ["↑ ↓ ← →"], keys: ["ArrowDown", "ArrowRight"], text: "move between beds", ...inWard, run: () => ward.focus(null) },
  { names: ["Enter"], keys: [], text: "open the bed", ...inWard },
  { names: ["/"], keys: ["/"], text: "find a bed by name", ...inWard, run: () => byId("filter").focus() },
  { names: ["Esc"], keys: ["Escape"], text: "back to the ward", ...inBed, run: () => (location.hash = "#ward") },
  { names: ["Space"], keys: [" "], text: "pause, go on", ...inBed, run: () => bed.viewport.toggle() },
  { names: ["←", "→"], keys: ["ArrowLeft", "ArrowRight"], text: "back and forth in time", ...inBed, run: stepInTime },
  { names: ["l", "End"], keys: ["l", "End"], text: "back to live", ...inBed, run: () => bed.viewport.live() },
  { names: ["1 … 5"], keys: [...SPAN_KEYS], text: `show ${SPANS_S.join(", ")} s`, ...inBed, run: chooseSpan },
  { names: ["a"], keys: ["a"], text: "to the alarm to acknowledge (Enter does it)", ...inBed, run: () => bed.alarms.focus() },
  { names: ["n"], keys: ["n"], text: "write a note", ...inBed, run: () => byId("note-text").focus() },
  { names: ["t"], keys: ["t"], text: "light, dark, as the system", ...anywhere, run: () => byId("theme").click() },
  { names: ["?"], keys: ["?"], text: "these keys", ...anywhere, run: showKeys },
];

function stepInTime(key) {
  bed.viewport.step(key === "ArrowLeft" ? -STEP_SPANS : STEP_SPANS);
}

function chooseSpan(key) {
  bed.viewport.setSpan(SPANS_S[SPAN_KEYS.indexOf(key)]);
}

startCommands(commands, () => view);
byId("export-csv").addEventListener("click", exportCsv);
byId("export-png").addEventListener("click", () => bed.export("png"));
byId("help").addEventListener("click", showKeys);
onTheme(requestDraw);
addEventListener("hashchange", route);
showConnection("lost");
route();

/** What tests may look at. */
const account = Object.freeze({
  get fps() {
    return meter.fps();
  },
  get frames() {
    return meter.frames;
  },
  get view() {
    return view;
  },
  get bed() {
    return bed.name;
  },
  get newest_ns() {
    return bed.newestNs;
  },
  get drawn() {
    return view === "bed" ? bed.drawn() : {};
  },
});
Object.defineProperty(window, "hemostream", { value: account, enumerable: true });
