// The console: jobs of one tenant, over the JSON API of the same server. Text of others (labels, names, messages)
// enters the page as text nodes only, so that none of it can become markup.

const STATES = {
  JOB_STATE_QUEUED: ["Queued", "mute"],
  JOB_STATE_RUNNING: ["Running", "busy"],
  JOB_STATE_SUCCEEDED: ["Succeeded", "good"],
  JOB_STATE_FAILED: ["Failed", "bad-ink"],
  JOB_STATE_CANCELLED: ["Cancelled", "fair"],
  JOB_STATE_DEADLINE_EXCEEDED: ["Deadline exceeded", "bad-ink"],
};
const ACTIVE = ["JOB_STATE_QUEUED", "JOB_STATE_RUNNING"];
const GRADES = { METRIC: "good", WEAK: "fair", PROJECTIVE_ONLY: "bad-ink" };
const GRADE_MEANS = {
  METRIC: "focal length better than 2 %",
  WEAK: "focal length between 2 % and 10 %, or a warning lowers the grade",
  PROJECTIVE_ONLY: "no calibration can be relied on",
};
const STAGES = {
  PREPARE: "Preparing", SEARCH: "Searching a consensus", REFINE: "Refining", EXTEND: "Registering further views",
  CALIBRATE: "Calibrating", CLASSIFY: "Classifying tracks and observations",
};
const TASKS = {
  ADJUST: "adjustment round", WINDOWS: "window", CLASSIFY: "verdict", CAMERAS: "camera group", HEADS: "network head",
};
const PHASES = { RELAXATION: "relaxation", RANK: "rank", GROWTH: "growth" };
const ATTEMPT_ENDS = { ENDED: "ended the job", GIVEN_BACK: "given back by its server", LOST: "lost with its server" };
const PROPOSALS = {
  NETWORK: "paper's network", IRLS: "reweighted least squares", CONSISTENCY: "consistency of motion",
  UNIFORM: "uniform sampling", RIGIDITY: "rigidity", LEARNED: "trained network",
};
const STRUCTURE_KINDS = {
  MOVING_BODY: "moving body", REPEATED_STRUCTURE: "repeated structure or a body that stands still at times",
};
const LEFT_OUT = {
  NO_OBSERVATIONS: "no observations", OUTSIDE_BLOCK: "outside the block that was solved",
  NOT_REGISTERED: "too few points agree on a pose",
};
const WARNINGS = {
  PLANAR_OR_ROTATION: "A plane and a turning camera explain the views alike",
  UNOBSERVABLE_FOCAL: "The motion does not determine the focal length",
  SECOND_MINIMUM: "Another focal length fits about as well",
  MODEL_MISMATCH: "The model with one calibration fits worse than a freer one",
  FOCAL_PRIOR_CONTRADICTED: "A focal length that was given contradicts the tracks, or another one",
  FEW_INLIERS: "Too few inlier tracks to verify or to calibrate",
  CHEIRALITY: "Points lie behind cameras",
  NO_CONSENSUS: "No set of tracks agrees on one geometry",
  VIEWS_LEFT_OUT: "Views are not registered",
  ASSUMED_IMAGE_SIZE: "No image size was given",
  CAMERA_GROUPS_MERGED: "Views of several sizes or groups were solved as one camera",
  PLANAR_SCENE: "The points lie on a plane",
  PURE_ROTATION: "The camera only turned about its centre",
  PURE_TRANSLATION: "The camera moved without turning",
  PRINCIPAL_POINT_UNOBSERVABLE: "The data do not determine the principal point",
  SECOND_STRUCTURE: "Rejected tracks agree on another rigid motion",
  POINTS_OUTSIDE_IMAGE: "Points do not lie as pixels of the images do",
  UNVERIFIED_RANKING: "Nothing was verified; weights are a network's ranking",
  DUPLICATE_TRACKS: "Tracks have the same observations",
  STATIC_TRACKS: "Tracks stay in place in the image",
  HIGH_NOISE: "The inliers fit at a noise far above the one assumed",
  LITTLE_MOTION: "The views hardly differ",
};

const JOB_NAME = /^tenants\/[a-z0-9-]{1,63}\/jobs\/[a-z0-9-]{1,63}$/;
const PAGE_SIZE = 50;
/** Jobs of a state are listed to count them: the API has no counts. Above this many the count is a lower bound. */
const COUNT_LIMIT = 500;
const POLL_SECONDS = 3;
const LONGEST_PAUSE_SECONDS = 30;
/** The server sends a comment every 15 s: a stream that is silent for three of these is dead. */
const SILENCE_SECONDS = 45;
/** Calls answer within this time, or the server is taken to be away; results and events may take longer. */
const CALL_SECONDS = 60;
/** Larger results are read when asked for: their JSON takes several times these bytes in the browser. */
const AUTOMATIC_RESULT_BYTES = 8 << 20;
const MOST_ROWS = 100;
const MOST_POINTS = 30000;
const MOST_SAMPLES = 1500;
const KEY_STORE = "scpsfm-api-key";

// ---- Small helpers -------------------------------------------------------------------------------------------------

const byId = (id) => document.getElementById(id);

/** An element; strings among the children become text nodes. */
function make(tag, properties, ...children) {
  const element = document.createElement(tag);
  fill(element, properties);
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== ""));
  return element;
}

function fill(element, properties) {
  for (const [name, value] of Object.entries(properties || {})) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name === "className" ? "class" : name, value === true ? "" : String(value));
  }
}

function drawn(tag, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  if (text !== undefined) element.textContent = text;
  return element;
}

/** Sets text only where it differs: a screen reader and the focus are left alone. */
function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function announce(text) {
  say(byId("live"), text);
}

/** An enum value without its prefix: GRADE_METRIC is METRIC. */
const bare = (value, prefix) => (value || "").replace(`${prefix}_`, "");
const number = (value) => (value === undefined || value === null || value === "" ? NaN : Number(value));
const count = (value) => Math.round(Number(value || 0)).toLocaleString("en");
const plural = (value, one, many = `${one}s`) => `${count(value)} ${Number(value || 0) === 1 ? one : many}`;

function figure(value, digits = 4) {
  const number = Number(value);
  if (!Number.isFinite(number)) return "-";
  const size = Math.abs(number);
  if (size !== 0 && (size < 1e-3 || size >= 1e7)) return number.toExponential(2);
  if (size >= 1e4) return number.toLocaleString("en", { maximumFractionDigits: 0 });
  return String(Number(number.toPrecision(digits)));
}

function bytes(value) {
  const size = Number(value || 0);
  if (size < 1e3) return `${size} B`;
  return size < 1e6 ? `${figure(size / 1e3, 3)} kB` : `${figure(size / 1e6, 3)} MB`;
}

function seconds(value) {
  const all = Math.max(0, value);
  if (all > 0 && all < 1) return `${figure(1000 * all, 3)} ms`;
  if (all < 60) return `${figure(all, 3)} s`;
  const whole = Math.round(all);
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor((whole % 3600) / 60)];
  return hours ? `${hours} h ${minutes} min` : `${minutes} min ${whole % 60} s`;
}

/** Seconds of a Duration, `1.5s`. */
const duration = (text) => Number.parseFloat(text || "0") || 0;

function localTime(text) {
  const time = new Date(text);
  if (!text || Number.isNaN(time.getTime())) return null;
  const two = (value) => String(value).padStart(2, "0");
  const day = `${time.getFullYear()}-${two(time.getMonth() + 1)}-${two(time.getDate())}`;
  return `${day} ${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}`;
}

const timeOf = (text) => (localTime(text) ? make("time", { datetime: text }, localTime(text)) : "-");

/** Seconds that a job ran, or has run so far. */
function ranSeconds(job) {
  if (!job.startTime) return NaN;
  const end = job.endTime ? Date.parse(job.endTime) : Date.now();
  return (end - Date.parse(job.startTime)) / 1000;
}

/** Text of others, isolated: its direction marks do not reorder the text around it. */
const foreign = (text) => make("bdi", {}, text);
const stateOf = (job) => job.state || "JOB_STATE_UNSPECIFIED";
const stateWords = (state) => (STATES[state] || [bare(state, "JOB_STATE"), "mute"])[0];

function stateBadge(job) {
  const state = stateOf(job);
  const words = job.cancelRequested && ACTIVE.includes(state) ? "Cancelling" : stateWords(state);
  return make("span", { className: `badge ${(STATES[state] || ["", "mute"])[1]}` }, words);
}

function facts(pairs, className) {
  const entry = ([name, value, note]) =>
    make("div", {}, make("dt", {}, name), make("dd", {}, value, note ? make("small", {}, note) : null));
  return make("dl", { className }, pairs.filter(([, value]) => value !== null && value !== undefined).map(entry));
}

function table(caption, columns, rows) {
  const className = (column) => column.className;
  const head = make("tr", {}, columns.map((column) =>
    make("th", { scope: "col", className: className(column) }, column.title)));
  const body = make("tbody", {}, rows.map((row) =>
    make("tr", {}, columns.map((column) => make("td", { className: className(column) }, column.cell(row))))));
  const whole = make("table", {}, caption ? make("caption", {}, caption) : null, make("thead", {}, head), body);
  // The keyboard scrolls what has the focus.
  return make("div", { className: "table", tabindex: 0, role: "group", "aria-label": caption || "Table" }, whole);
}

const column = (title, cell, className) => ({ title, cell, className });

/** Waits; ends early, with an error, when the signal says so. */
function pause(waitSeconds, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, waitSeconds * 1000);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    }, { once: true });
  });
}

/** Resolves when the page is seen: a hidden tab asks nothing of the server. */
function seen(signal) {
  if (document.visibilityState === "visible") return Promise.resolve();
  return new Promise((resolve, reject) => {
    document.addEventListener("visibilitychange", resolve, { once: true, signal });
    signal.addEventListener("abort", () => reject(signal.reason), { once: true });
  });
}

// ---- Notices and dialogs -------------------------------------------------------------------------------------------

/** Shows what went wrong until it is closed or another takes its place. Violations name fields. */
function notice(kind, text, violations = [], id = "call", action = null) {
  clearNotice(id);
  const close = make("button", { type: "button", onclick: () => clearNotice(id) }, "Close");
  const list = violations.length ? make("ul", {}, violations.map((words) => make("li", {}, words))) : null;
  const box = make("div", { className: `notice ${kind}`, role: kind === "bad" ? "alert" : "status" });
  box.dataset.id = id;
  byId("notices").append(box);
  // Filled after it is in the page: screen readers speak what changes in a live region.
  box.append(make("div", {}, make("p", {}, text), list), make("div", { className: "buttons" }, action, close));
}

function clearNotice(id) {
  for (const box of byId("notices").querySelectorAll(".notice")) {
    if (box.dataset.id === id) box.remove();
  }
}

function tellError(error, what, id) {
  if (error.name === "AbortError") return;
  const violations = (error.violations || []).map((one) => `${one.field}: ${one.description}`);
  const reason = error.reason ? ` (${error.reason})` : "";
  // The page begins anew, which asks for the key.
  const action = error.code === 401 ? make("button", { type: "button", onclick: show }, "Enter API key") : null;
  notice("bad", `${what}: ${error.message}${reason}`, violations, id, action);
}

/** Asks before something that cannot be taken back. */
function confirmed(title, text, verb) {
  const dialog = byId("confirm-dialog");
  say(byId("confirm-title"), title);
  say(byId("confirm-text"), text);
  say(byId("confirm-yes"), verb);
  dialog.returnValue = "";
  dialog.showModal();
  byId("confirm-no").focus();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}

let keyQuestion = null;

/** Asks for the API key, once for all calls that wait for it. Resolves to whether there is a new one. */
function askKey(reason) {
  if (keyQuestion) return keyQuestion;
  const dialog = byId("key-dialog");
  dialog.returnValue = "";
  byId("key").value = "";
  dialog.showModal();
  say(byId("key-reason"), reason);
  byId("key").focus();
  keyQuestion = new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      const key = byId("key").value.trim();
      byId("key").value = "";
      const given = dialog.returnValue === "use" && key !== "";
      if (given) sessionStorage.setItem(KEY_STORE, key);
      showKeyButton();
      keyQuestion = null;
      resolve(given);
    }, { once: true });
  });
  return keyQuestion;
}

function showKeyButton() {
  byId("forget").hidden = !sessionStorage.getItem(KEY_STORE);
}

function prepareDialogs() {
  byId("key-form").addEventListener("submit", (event) => {
    event.preventDefault();
    // Other characters cannot be in a header.
    if (!/^[\x21-\x7e]+$/.test(byId("key").value.trim())) {
      say(byId("key-reason"), "A key has only letters, digits and signs of ASCII, and no spaces.");
      return;
    }
    byId("key-dialog").close("use");
  });
  byId("key-cancel").addEventListener("click", () => byId("key-dialog").close(""));
  byId("confirm-no").addEventListener("click", () => byId("confirm-dialog").close(""));
  byId("confirm-yes").addEventListener("click", () => byId("confirm-dialog").close("yes"));
  byId("forget").addEventListener("click", () => {
    sessionStorage.removeItem(KEY_STORE);
    showKeyButton();
    say(byId("tenant"), "");
    announce("The API key is forgotten.");
    location.hash = "#/";
    show();
  });
}

// ---- Calls ---------------------------------------------------------------------------------------------------------

class CallError extends Error {
  constructor(message, { code = 0, reason = "", violations = [], retrySeconds = 0 } = {}) {
    super(message);
    this.name = "CallError";
    Object.assign(this, { code, reason, violations, retrySeconds });
  }

  /** Whether the same call may succeed later. */
  get mayPass() {
    return this.code === 0 || this.code === 429 || this.code >= 500;
  }
}

/** The refusal in google.rpc's JSON form. */
function refusal(body, code, retryAfter) {
  const error = (body && body.error) || {};
  const details = Array.isArray(error.details) ? error.details : [];
  const of = (kind) => details.find((detail) => String(detail["@type"] || "").endsWith(kind)) || {};
  return new CallError(error.message || `the server answered ${code}`, {
    code: error.code || code,
    reason: of("ErrorInfo").reason || error.status,
    violations: of("BadRequest").fieldViolations || [],
    retrySeconds: Number(retryAfter) || duration(of("RetryInfo").retryDelay),
  });
}

/** One request, which asks for a key as often as it needs one; the answer is not read yet. */
async function request(method, path, { body, signal, headers = {}, limit = CALL_SECONDS } = {}) {
  for (;;) {
    const sent = sessionStorage.getItem(KEY_STORE);
    const all = { ...headers };
    if (sent) all.authorization = `Bearer ${sent}`;
    if (body !== undefined) all["content-type"] = "application/json";
    const signals = [signal, limit ? AbortSignal.timeout(limit * 1000) : null].filter(Boolean);
    let answer;
    try {
      answer = await fetch(path, {
        method, signal: AbortSignal.any(signals), headers: all,
        body: body === undefined ? undefined : JSON.stringify(body),
        cache: "no-store", credentials: "omit", redirect: "error", referrerPolicy: "no-referrer",
      });
    } catch (error) {
      if (signal && signal.aborted) throw error;
      throw new CallError("the server cannot be reached");
    }
    if (answer.ok) return answer;
    const told = refusal(await answer.json().catch(() => null), answer.status, answer.headers.get("retry-after"));
    if (answer.status !== 401) throw told;
    // Another call may have asked for the key meanwhile.
    if (sessionStorage.getItem(KEY_STORE) !== sent) continue;
    sessionStorage.removeItem(KEY_STORE);
    if (!(await askKey(`${told.message} (${told.reason})`))) throw told;
  }
}

async function call(method, path, options) {
  const answer = await request(method, path, options);
  try {
    return await answer.json();
  } catch (error) {
    if (options && options.signal && options.signal.aborted) throw error;
    throw new CallError("the answer broke off or is no JSON");
  }
}

/** Takes server-sent events apart; bytes may come in pieces of any size. */
class EventParser {
  constructor(onEvent) {
    this.onEvent = onEvent;
    this.rest = "";
    this.clear();
  }

  clear() {
    this.event = { type: "message", data: [], id: null };
  }

  push(text) {
    this.rest += text;
    // A final \r may be half of a \r\n.
    const lines = this.rest.split(/\r\n|\n|\r(?!$)/);
    this.rest = lines.pop();
    for (const line of lines) this.line(line);
  }

  line(line) {
    if (line === "") {
      const { type, data, id } = this.event;
      this.clear();
      if (data.length) this.onEvent({ type, data: data.join("\n"), id });
      return;
    }
    const colon = line.indexOf(":");
    if (colon === 0) return;
    const field = colon < 0 ? line : line.slice(0, colon);
    const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
    if (field === "data") this.event.data.push(value);
    else if (field === "event") this.event.type = value;
    else if (field === "id" && !value.includes("\0")) this.event.id = value;
  }
}

/** Reads one stream of events to its end; returns when the server has ended it. */
async function readEvents(path, lastId, signal, onEvent) {
  // Of this stream alone: silence ends it, and not what it is for.
  const silent = new AbortController();
  const either = AbortSignal.any([signal, silent.signal]);
  const headers = { accept: "text/event-stream" };
  if (lastId) headers["last-event-id"] = lastId;
  const answer = await request("GET", path, { signal: either, headers, limit: 0 });
  let failure = null;
  const parser = new EventParser((event) => {
    const content = JSON.parse(event.data);
    // How a stream ends that breaks off; no event of a job has this field.
    if (content.error) failure = refusal(content, 0, null);
    else onEvent(content, event.id);
  });
  const reader = answer.body.getReader();
  const decoder = new TextDecoder();
  let timer = 0;
  const hide = () => document.visibilityState === "hidden" && silent.abort();
  // A browser has few connections to a server: hidden tabs leave theirs to others.
  document.addEventListener("visibilitychange", hide, { signal: either });
  try {
    for (;;) {
      timer = setTimeout(() => silent.abort(), SILENCE_SECONDS * 1000);
      const { done, value } = await reader.read();
      clearTimeout(timer);
      if (done) break;
      parser.push(decoder.decode(value, { stream: true }));
      if (failure) throw failure;
    }
  } catch (error) {
    if (signal.aborted || error instanceof CallError) throw error;
    throw new CallError("the stream of events broke off");
  } finally {
    clearTimeout(timer);
    silent.abort();
  }
}

/**
 * Follows a job's events to its end, over broken connections: goes on after the last event that it has, and waits
 * longer each time that nothing came. A final state is the end unless more follows: the job may have been retried.
 */
async function follow(name, signal, onEvent, onTrouble) {
  let lastId = null;
  let wait = 1;
  let ended = false;
  while (!ended) {
    await seen(signal);
    let trouble = null;
    try {
      await readEvents(`/v1/${name}/events`, lastId, signal, (event, id) => {
        if (id) lastId = id;
        wait = 1;
        onTrouble(null, 0);
        const state = event.stateChange && event.stateChange.state;
        if (state) ended = !ACTIVE.includes(state);
        onEvent(event);
      });
    } catch (error) {
      if (signal.aborted || (error instanceof CallError && !error.mayPass)) throw error;
      trouble = error;
    }
    if (ended) return;
    // A draining server ends streams too; another one goes on.
    const pauseSeconds = Math.max(wait, (trouble && trouble.retrySeconds) || 0);
    if (trouble && document.visibilityState === "visible") onTrouble(trouble, pauseSeconds);
    await pause(pauseSeconds, signal);
    wait = Math.min(LONGEST_PAUSE_SECONDS, wait * 2);
  }
}

/** Does something again and again while the page is seen; later and later while the server is away. */
async function repeat(signal, everySeconds, what, work) {
  let wait = everySeconds;
  for (;;) {
    try {
      await seen(signal);
      await work();
      wait = everySeconds;
      clearNotice("poll");
    } catch (error) {
      if (signal.aborted) return;
      if (!(error instanceof CallError)) throw error;
      if (!error.mayPass) {
        tellError(error, what, "poll");
        return;
      }
      wait = Math.min(LONGEST_PAUSE_SECONDS, Math.max(wait * 2, error.retrySeconds));
      notice("bad", `${what}: ${error.message}. Next try in ${Math.round(wait)} s.`, [], "poll");
    }
    try {
      await pause(wait, signal);
    } catch {
      return;
    }
  }
}

function uuid() {
  // randomUUID is missing where the page came without TLS from another machine.
  if (crypto.randomUUID) return crypto.randomUUID();
  const random = crypto.getRandomValues(new Uint8Array(16));
  random[6] = (random[6] & 0x0f) | 0x40;
  random[8] = (random[8] & 0x3f) | 0x80;
  const hex = [...random].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return hex.replace(/^(.{8})(.{4})(.{4})(.{4})/, "$1-$2-$3-$4-");
}

// ---- The list of jobs ----------------------------------------------------------------------------------------------

/** `labels.KEY = "VALUE"` of `KEY=VALUE`. Throws for what the API's filter cannot say. */
function labelFilter(text) {
  const equals = text.indexOf("=");
  if (equals < 1) throw new Error("A label filter is KEY=VALUE.");
  const [key, value] = [text.slice(0, equals).trim(), text.slice(equals + 1).trim()];
  if (/[\s="]/.test(key)) {
    throw new Error("A label whose key holds spaces, = or quotes cannot be filtered by.");
  }
  return `labels.${key} = "${value.replace(/["\\]/g, "\\$&")}"`;
}

function listHash(states, label) {
  const parameters = new URLSearchParams();
  if (states.length) parameters.set("state", states.map((state) => bare(state, "JOB_STATE")).join(","));
  if (label) parameters.set("label", label);
  const text = parameters.toString();
  return text ? `#/?${text}` : "#/";
}

function labelLinks(labels) {
  return Object.entries(labels || {}).sort(([a], [b]) => (a < b ? -1 : 1)).map(([key, value]) =>
    make("a", { className: "label", href: listHash([], `${key}=${value}`) }, foreign(`${key}=${value}`)));
}

function outcome(job) {
  const summary = job.summary;
  if (summary && summary.status) {
    if (bare(summary.status, "RESULT_STATUS") !== "SOLVED") {
      return make("span", { className: "bad-ink" }, "No reconstruction");
    }
    const grade = bare(summary.grade, "GRADE") || "-";
    const focal = summary.focalPx === undefined ? "" : `${figure(summary.focalPx)} px`;
    return make("span", {}, make("b", { className: GRADES[grade] || "" }, grade), " ",
      make("span", { className: "focal" }, focal));
  }
  if (job.error) return make("span", { className: "bad-ink" }, foreign(job.error.reason || "Failed"));
  if (stateOf(job) === "JOB_STATE_RUNNING") return `${Math.round(100 * ((job.progress || {}).fraction || 0))} %`;
  return "";
}

const JOB_COLUMNS = [
  column("Job", (job) => make("a", { href: `#/${job.name}` }, job.name.split("/").pop()), "name job"),
  column("State", stateBadge, "state"),
  column("Result", outcome),
  column("Method", (job) => bare((job.settings || {}).method, "METHOD")),
  column("Views", (job) => count(job.viewCount), "number"),
  column("Tracks", (job) => count(job.trackCount), "number"),
  column("Labels", (job) => labelLinks(job.labels), "name"),
  column("Created", (job) => timeOf(job.createTime), "time"),
  column("Ran for", (job) => (job.startTime ? seconds(ranSeconds(job)) : "-"), "number"),
];

/** Rows that stay the same elements while their jobs change: the focus and the reader's place are kept. */
class JobRows {
  constructor(body) {
    this.body = body;
    this.rows = new Map();
  }

  update(jobs) {
    const names = new Set(jobs.map((job) => job.name));
    for (const [name, row] of this.rows) {
      if (names.has(name)) continue;
      row.remove();
      this.rows.delete(name);
    }
    jobs.forEach((job, place) => {
      let row = this.rows.get(job.name);
      if (!row) {
        row = make("tr", {}, JOB_COLUMNS.map(({ className }) => make("td", { className })));
        this.rows.set(job.name, row);
      }
      JOB_COLUMNS.forEach(({ cell }, index) => {
        const fresh = make("td", { className: JOB_COLUMNS[index].className }, cell(job));
        if (!row.children[index].isEqualNode(fresh)) row.children[index].replaceWith(fresh);
      });
      if (this.body.children[place] !== row) this.body.insertBefore(row, this.body.children[place] || null);
    });
  }
}

/** Numbers of jobs by state, each a button that filters the list. */
class Overview {
  constructor(states, label, signal) {
    this.signal = signal;
    this.buttons = new Map();
    this.counts = new Map();
    this.sinceEnded = Infinity;
    const entry = (state) => {
      const shown = make("b", {}, "-");
      const others = states.includes(state) ? states.filter((other) => other !== state) : [...states, state];
      const button = make("button", {
        type: "button", "aria-pressed": String(states.includes(state)),
        onclick: () => { location.hash = listHash(others, label); },
      }, shown, stateWords(state));
      this.buttons.set(state, shown);
      return make("li", {}, button);
    };
    this.element = make("section", { "aria-labelledby": "overview-title" },
      make("h3", { id: "overview-title" }, "Jobs by state"),
      make("ul", { className: "states" }, Object.keys(STATES).map(entry)));
  }

  async list(states) {
    const filter = states.map((state) => `state = ${bare(state, "JOB_STATE")}`).join(" OR ");
    const query = new URLSearchParams({ pageSize: COUNT_LIMIT, filter });
    const answer = await call("GET", `/v1/tenants/-/jobs?${query}`, { signal: this.signal });
    return [answer.jobs || [], Boolean(answer.nextPageToken)];
  }

  set(state, jobs, more) {
    const text = `${count(jobs)}${more ? "+" : ""}`;
    const changed = this.counts.get(state) !== text;
    this.counts.set(state, text);
    say(this.buttons.get(state), text);
    return changed;
  }

  async refresh() {
    let changed = false;
    for (const state of ACTIVE) {
      const [jobs, more] = await this.list([state]);
      changed = this.set(state, jobs.length, more) || changed;
    }
    // Ended jobs may be many: they are counted again when others come and go, and else seldom.
    this.sinceEnded += 1;
    if (!changed && this.sinceEnded < 10) return;
    this.sinceEnded = 0;
    for (const state of Object.keys(STATES)) {
      if (ACTIVE.includes(state)) continue;
      const [jobs, more] = await this.list([state]);
      this.set(state, jobs.length, more);
    }
  }
}

/** The form that filters by a label. */
function filterForm(states, label) {
  const input = make("input", { id: "label", placeholder: "site=north", autocomplete: "off", spellcheck: "false" });
  input.value = label;
  const submit = (event) => {
    event.preventDefault();
    const text = input.value.trim();
    try {
      if (text) labelFilter(text);
      clearNotice("call");
      location.hash = listHash(states, text);
    } catch (error) {
      notice("bad", error.message);
    }
  };
  const clear = states.length || label ? make("a", { href: "#/" }, "Show all jobs") : null;
  return make("form", { className: "filter", onsubmit: submit },
    make("div", {}, make("label", { for: "label" }, "Label (key=value)"), input),
    make("button", { type: "submit" }, "Filter"), clear);
}

function showList(parameters, main, signal) {
  document.title = "Jobs - scpsfm";
  const known = Object.keys(STATES);
  const states = (parameters.get("state") || "").split(",").map((name) => `JOB_STATE_${name}`)
    .filter((state) => known.includes(state));
  const label = parameters.get("label") || "";
  const overview = new Overview(states, label, signal);
  const body = make("tbody");
  const rows = new JobRows(body);
  const head = make("tr", {}, JOB_COLUMNS.map(({ title, className }) =>
    make("th", { scope: "col", className }, title)));
  const empty = make("p", { className: "empty" }, "Loading.");
  const jobs = make("table", { hidden: true }, make("caption", { className: "hidden" }, "Jobs"),
    make("thead", {}, head), body);
  const where = make("span", { className: "mute" });
  const tokens = [""];
  let next = "";
  const turn = (change) => async () => {
    change();
    await load().catch((error) => tellError(error, "The page cannot be read"));
    announce(where.textContent);
  };
  const previousButton = make("button", { type: "button", onclick: turn(() => tokens.length > 1 && tokens.pop()) },
    "Newer jobs");
  const nextButton = make("button", { type: "button", onclick: turn(() => next && tokens.push(next)) }, "Older jobs");

  async function load() {
    const terms = states.map((state) => `state = ${bare(state, "JOB_STATE")}`).join(" OR ");
    const filter = [terms, label ? labelFilter(label) : ""].filter(Boolean).join(" AND ");
    const token = tokens[tokens.length - 1];
    const query = new URLSearchParams({ pageSize: PAGE_SIZE });
    if (filter) query.set("filter", filter);
    if (token) query.set("pageToken", token);
    const answer = await call("GET", `/v1/tenants/-/jobs?${query}`, { signal });
    // The reader has turned the page meanwhile.
    if (token !== tokens[tokens.length - 1]) return;
    const listed = answer.jobs || [];
    rows.update(listed);
    next = answer.nextPageToken || "";
    jobs.hidden = listed.length === 0;
    empty.hidden = listed.length > 0;
    say(empty, states.length || label ? "No job matches the filter." : "There are no jobs yet.");
    say(where, `Page ${tokens.length}, ${plural(listed.length, "job")}`);
    previousButton.disabled = tokens.length === 1;
    nextButton.disabled = !next;
    if (listed.length) say(byId("tenant"), `Tenant ${listed[0].name.split("/")[1]}`);
  }

  main.replaceChildren(
    make("h2", { tabindex: -1 }, "Jobs"), overview.element,
    make("section", { "aria-labelledby": "jobs-title" },
      make("h3", { id: "jobs-title" }, label || states.length ? "Jobs that match" : "All jobs, newest first"),
      filterForm(states, label), make("div", { className: "table" }, jobs), empty,
      make("div", { className: "buttons tools" }, previousButton, nextButton, where)));
  try {
    if (label) labelFilter(label);
  } catch (error) {
    say(empty, error.message);
    return;
  }
  repeat(signal, POLL_SECONDS, "The jobs cannot be read", async () => {
    await load();
    await overview.refresh();
  });
}

// ---- Curves --------------------------------------------------------------------------------------------------------

const CHART = { width: 320, height: 150, left: 46, right: 8, top: 10, bottom: 22 };

/** One quantity over the seconds of an attempt. */
class Chart {
  constructor(title, unit) {
    this.title = title;
    this.unit = unit;
    this.values = [];
    this.latest = make("b", {}, "-");
    this.svg = drawn("svg", { viewBox: `0 0 ${CHART.width} ${CHART.height}`, role: "img" });
    this.element = make("figure", { hidden: true }, make("figcaption", {}, `${title}: `, this.latest), this.svg);
  }

  clear() {
    this.values = [];
    this.element.hidden = true;
  }

  add(time, value) {
    if (!Number.isFinite(value)) return;
    this.values.push([time, value]);
    // Every second one of the older values goes: the curve keeps its shape.
    if (this.values.length > MOST_SAMPLES) {
      this.values = this.values.filter((_, place) => place % 2 || place > MOST_SAMPLES / 2);
    }
  }

  draw() {
    const values = this.values;
    if (!values.length) return;
    this.element.hidden = false;
    const unit = this.unit ? ` ${this.unit}` : "";
    const last = values[values.length - 1];
    let [low, high] = [Infinity, -Infinity];
    for (const [, value] of values) [low, high] = [Math.min(low, value), Math.max(high, value)];
    // Losses fall over orders of magnitude.
    const isLogarithmic = low > 0 && high / low > 50;
    const scale = (value) => (isLogarithmic ? Math.log(value) : value);
    const [begin, end] = [values[0][0], Math.max(last[0], values[0][0] + 1e-9)];
    const [bottom, top] = high > low ? [scale(low), scale(high)] : [scale(low) - 1, scale(low) + 1];
    const { width, height, left, right } = CHART;
    const [floor, room] = [height - CHART.bottom, height - CHART.top - CHART.bottom];
    const x = (time) => left + ((time - begin) / (end - begin)) * (width - left - right);
    const y = (value) => floor - ((scale(value) - bottom) / (top - bottom)) * room;
    say(this.latest, `${figure(last[1])}${unit}`);
    const words = `${this.title}: from ${figure(values[0][1])} to ${figure(last[1])}${unit} in ${seconds(end)}`;
    this.svg.setAttribute("aria-label", words);
    const marks = high > low ? [low, high] : [low];
    const foot = (at, anchor, text) => drawn("text", { x: at, y: height - 6, "text-anchor": anchor }, text);
    const points = values.map(([time, value]) => `${x(time).toFixed(1)},${y(value).toFixed(1)}`).join(" ");
    this.svg.replaceChildren(
      ...marks.flatMap((value) => [
        drawn("line", { class: "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }),
        drawn("text", { x: left - 5, y: y(value) + 4, "text-anchor": "end" }, figure(value, 3)),
      ]),
      foot(left, "start", seconds(begin)), foot(width - right, "end", seconds(end)),
      ...(isLogarithmic ? [foot((left + width) / 2, "middle", "logarithmic")] : []),
      drawn("polyline", { class: "line", points }),
      drawn("circle", { class: "dot", cx: x(last[0]), cy: y(last[1]), r: 3 }));
  }
}

/** Progress as it comes: stage, share, curves. */
class Live {
  constructor() {
    this.attempt = 0;
    this.stage = "";
    this.asked = false;
    this.isLive = true;
    this.isDone = false;
    this.bar = make("progress", { max: 1, "aria-label": "Share of the work done" });
    this.bar.value = 0;
    this.steps = make("p", { className: "steps" }, "No progress yet.");
    this.charts = {
      inliers: new Chart("Inlier tracks so far", ""), focal: new Chart("Focal length", "px"),
      views: new Chart("Registered views", ""), num: new Chart("L_num", ""), proj: new Chart("L_proj", ""),
      daq: new Chart("L_DAQ", ""),
    };
    this.noLosses = make("p", { className: "note" },
      "No losses yet: the paper's network has not run. Method AUTO usually does not need it.");
    this.element = make("section", { "aria-labelledby": "progress-title" },
      make("h3", { id: "progress-title" }, "Progress"), this.bar, this.steps,
      make("div", { className: "charts" }, Object.values(this.charts).map((chart) => chart.element)), this.noLosses);
  }

  add(progress, attempt) {
    if (attempt > this.attempt) {
      // Times and shares begin anew with an attempt.
      this.attempt = attempt;
      for (const chart of Object.values(this.charts)) chart.clear();
    }
    this.told(progress);
    const time = duration(progress.elapsedDuration);
    const { charts } = this;
    const { losses, reconstruction } = progress;
    charts.inliers.add(time, progress.inlierTrackCount || 0);
    charts.focal.add(time, number(progress.focalPx));
    if (reconstruction) charts.views.add(time, reconstruction.registeredViewCount || 0);
    if (losses) {
      charts.num.add(time, number(losses.num || 0));
      charts.proj.add(time, number(losses.proj || 0));
      charts.daq.add(time, number(losses.daq || 0));
      this.noLosses.hidden = true;
    }
    this.drawSoon();
  }

  /** Where the job is now, without the curves. */
  told(progress) {
    this.bar.value = this.isDone ? 1 : progress.fraction || 0;
    // The last event comes before the end: what it says is not how the job ended.
    say(this.steps, `${this.isLive ? "" : "Last progress: "}${this.words(progress)}`);
    this.tell(progress);
  }

  words(progress) {
    const parts = [`${Math.round(100 * (progress.fraction || 0))} %`];
    const stage = bare(progress.stage, "STAGE");
    if (stage && stage !== "UNSPECIFIED") parts.push(STAGES[stage] || stage);
    const views = progress.reconstruction || {};
    if (views.block) parts.push(`block ${views.block} of at most ${views.blockCount || views.block}`);
    if (views.part) parts.push(`part ${views.part}`);
    const registered = views.registeredViewCount || 0;
    if (views.viewCount) parts.push(`${registered} of ${plural(views.viewCount, "view")} registered`);
    const task = bare(views.task, "TASK");
    if (task && views.stepCount) parts.push(`${TASKS[task] || task} ${views.step || 0} of at most ${views.stepCount}`);
    if (progress.iterationCount) parts.push(`network iteration ${count(progress.iterationCount)}`);
    const head = progress.head;
    if (head) {
      const phase = PHASES[bare(head.phase, "PHASE")];
      if (task !== "HEADS") parts.push(`network head ${head.head || 1}`);
      if (phase) parts.push(`phase ${phase}`);
      parts.push(`sum of weights ${figure(head.weightSum || 0)}`);
    }
    if (progress.bestCost !== undefined) parts.push(`cost ${figure(progress.bestCost, 3)} of all-outlier cost`);
    parts.push(seconds(duration(progress.elapsedDuration)));
    return parts.join(" · ");
  }

  /** Stages are announced, each figure is not: half a second is too often to listen to. */
  tell(progress) {
    if (progress.stage === this.stage) return;
    this.stage = progress.stage;
    const stage = bare(progress.stage, "STAGE");
    if (this.isLive) announce(STAGES[stage] || "");
  }

  drawSoon() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      for (const chart of Object.values(this.charts)) chart.draw();
    });
  }

  end(succeeded) {
    this.isDone = succeeded;
    if (succeeded) this.bar.value = 1;
    say(this.steps, this.steps.textContent.replace(/^(?=\d)/, "Last progress: "));
    if (this.attempt === 0) say(this.steps, "No progress is known of this job.");
    say(this.noLosses, "No losses: the paper's network did not run.");
  }
}

// ---- One job -------------------------------------------------------------------------------------------------------

function warningList(warnings) {
  const words = (warning) => {
    const code = bare(warning.code, "WARNING_CODE");
    const group = warning.cameraGroup === undefined ? "" : ` (camera group ${warning.cameraGroup})`;
    return make("li", {}, make("b", {}, WARNINGS[code] || code), `${group}. `, foreign(warning.detail || ""),
      " ", make("span", { className: "mute" }, code));
  };
  return make("ul", { className: "warnings" }, warnings.map(words));
}

/** Focal length and one standard deviation of it. */
function focalWords(focal, sigmaLog) {
  if (focal === undefined) return ["-", "no calibration"];
  if (sigmaLog === undefined) return [`${figure(focal, 5)} px`, "σ unobservable"];
  return [`${figure(focal, 5)} ± ${figure(focal * sigmaLog, 2)} px`, `σ of the logarithm ${figure(sigmaLog, 3)}`];
}

function summarySection(job) {
  const summary = job.summary;
  const isSolved = bare(summary.status, "RESULT_STATUS") === "SOLVED";
  const grade = bare(summary.grade, "GRADE");
  const [focal, sigma] = focalWords(summary.focalPx, summary.sigmaLogFocal);
  const rms = summary.reprojectionRmsPx;
  const proposal = bare(summary.winningProposal, "PROPOSAL");
  const pairs = [
    ["Status", isSolved ? "Solved" : "No reconstruction", isSolved ? null : "the warnings say why"],
    ["Grade", make("span", { className: GRADES[grade] || "mute" }, grade || "-"), GRADE_MEANS[grade]],
    ["Focal length ± σ", focal, sigma],
    ["Inlier tracks", count(summary.inlierTrackCount), `of ${count(job.trackCount)}`],
    ["Registered views", count(summary.registeredViewCount), `of ${count(job.viewCount)}`],
    ["RMS of inlier observations", rms === undefined ? "-" : `${figure(rms, 3)} px`],
    ["Proposed by", PROPOSALS[proposal] || "-"],
    ["Time of the solve", seconds(duration(summary.solveDuration)),
      summary.iterationCount ? plural(summary.iterationCount, "network iteration") : null],
  ];
  const warnings = summary.warnings || [];
  return make("section", { "aria-labelledby": "summary-title" }, make("h3", { id: "summary-title" }, "Summary"),
    facts(pairs, "large"),
    warnings.length ? [make("h4", {}, plural(warnings.length, "warning")), warningList(warnings)] : null);
}

function failureBox(job) {
  const state = stateOf(job);
  if (state === "JOB_STATE_DEADLINE_EXCEEDED") {
    return make("div", { className: "failure" }, make("h3", {}, "Deadline exceeded"),
      make("p", {}, "The job had no result at its deadline. Create it again with a later one, or with fewer views."));
  }
  if (!job.error) return null;
  const attempts = job.error.attempts || [];
  const columns = [
    column("Attempt", (attempt) => count(attempt.attempt), "number"),
    column("Server", (attempt) => foreign(attempt.server || "-"), "name"),
    column("Start", (attempt) => timeOf(attempt.startTime), "time"),
    column("End", (attempt) => timeOf(attempt.endTime), "time"),
    column("How it ended", (attempt) => ATTEMPT_ENDS[bare(attempt.end, "ATTEMPT_END")] || "-"),
  ];
  return make("div", { className: "failure" },
    make("h3", {}, "Failed: ", foreign(job.error.reason || "no reason given")),
    make("p", {}, foreign(job.error.message || "")),
    attempts.length ? table("Attempts at the job", columns, attempts) : null);
}

/** How far the delivery of a webhook has come. */
function webhookWords(webhook) {
  const words = [bare(webhook.state, "WEBHOOK_STATE"), plural(webhook.attemptCount, "attempt")];
  return words.concat(webhook.lastError ? [webhook.lastError] : []).join(", ");
}

function jobFacts(job) {
  const labels = labelLinks(job.labels);
  const settings = Object.entries(job.settings || {});
  const columns = [column("Setting", ([name]) => name, "name"), column("Value", ([, value]) => foreign(String(value)))];
  return [
    facts([
      ["Created", timeOf(job.createTime)],
      ["Started", timeOf(job.startTime), job.startTime && job.endTime ? `ran for ${seconds(ranSeconds(job))}` : null],
      ["Ended", timeOf(job.endTime)],
      ["Attempts", count(job.attemptCount)],
      ["Views", count(job.viewCount)],
      ["Tracks", count(job.trackCount), plural(job.observationCount, "observation")],
      ["Method", bare((job.settings || {}).method, "METHOD") || "-"],
      ["Priority", String(job.priority || 0)],
      ["Deadline", job.deadlineTime ? timeOf(job.deadlineTime) : null],
      ["Removed at", job.expireTime ? timeOf(job.expireTime) : null],
      ["Uploaded input", job.input ? foreign(job.input) : null],
      ["Webhook", job.webhook ? foreign(job.webhook.url) : null, job.webhook ? webhookWords(job.webhook) : null],
      ["Labels", labels.length ? labels : "-"],
    ]),
    make("details", {}, make("summary", {}, "Settings"), table("Settings that were used", columns, settings)),
  ];
}

/** The page of one job. */
class JobPage {
  constructor(name, main, signal) {
    Object.assign(this, { name, signal, job: null, etag: "", resultAsked: false, requestId: uuid() });
    this.id = name.split("/").pop();
    document.title = `Job ${this.id} - scpsfm`;
    this.badge = make("span");
    const button = (words, work, className) =>
      make("button", { type: "button", className, hidden: true, onclick: work }, words);
    this.cancelButton = button("Cancel job", () => this.cancel());
    this.retryButton = button("Retry job", () => this.retry());
    this.againButton = button("Create again", () => this.createAgain());
    this.deleteButton = button("Delete job", () => this.remove(), "danger");
    this.againNote = make("p", { className: "note", hidden: true },
      "The input came with the job, and the API does not give it back: upload an input to be able to create again.");
    this.details = make("div", {}, make("p", { className: "empty" }, "Loading."));
    this.failure = make("div");
    this.summary = make("div");
    this.live = new Live();
    this.result = make("div");
    main.replaceChildren(
      make("div", { className: "head" },
        make("h2", { tabindex: -1 }, `Job ${this.id}`, this.badge),
        make("div", { className: "buttons" }, ...this.buttons())),
      this.failure, this.summary, this.live.element, this.result,
      make("section", { "aria-labelledby": "details-title" }, make("h3", { id: "details-title" }, "Job"),
        this.details, this.againNote));
    this.run();
  }

  buttons() {
    return [this.cancelButton, this.retryButton, this.againButton, this.deleteButton];
  }

  async run() {
    try {
      await this.refresh();
      const onTrouble = (trouble, waitSeconds) => this.onTrouble(trouble, waitSeconds);
      await follow(this.name, this.signal, (event) => this.onEvent(event), onTrouble);
      clearNotice("stream");
      await this.refresh();
    } catch (error) {
      if (!this.signal.aborted) this.onGone(error);
    }
  }

  /** Reads the job; waits where the server is away. */
  async refresh() {
    for (let wait = 1; ; wait = Math.min(LONGEST_PAUSE_SECONDS, wait * 2)) {
      try {
        this.show(await call("GET", `/v1/${this.name}`, { signal: this.signal }));
        clearNotice("stream");
        return;
      } catch (error) {
        if (!(error instanceof CallError) || !error.mayPass) throw error;
        const pauseSeconds = Math.max(wait, error.retrySeconds);
        this.onTrouble(error, pauseSeconds);
        await pause(pauseSeconds, this.signal);
      }
    }
  }

  onTrouble(trouble, waitSeconds) {
    if (!trouble) {
      clearNotice("stream");
      return;
    }
    const text = `No live events: ${trouble.message}. Next try in ${Math.round(waitSeconds)} s.`;
    notice("bad", text, [], "stream");
  }

  onGone(error) {
    clearNotice("stream");
    const words = error.code === 404 ? "The job does not exist, or is of another tenant" : "The job cannot be read";
    tellError(error, words);
    if (error.code !== 404) return;
    for (const button of this.buttons()) button.hidden = true;
    this.live.element.hidden = true;
    this.details.replaceChildren(make("p", { className: "empty" }, "There is no such job. ",
      make("a", { href: "#/" }, "Show the jobs")));
  }

  onEvent(event) {
    if (event.progress) this.live.add(event.progress, event.attempt || 0);
    const change = event.stateChange;
    // Older events are told again from the first: only what the job is not yet is news.
    if (change && this.job && Number(event.sequence || 0) > Number(this.job.lastSequence || 0)) {
      this.refresh().catch((error) => this.signal.aborted || this.onGone(error));
    }
  }

  show(job) {
    const before = this.job;
    this.job = job;
    const state = stateOf(job);
    const isEnded = !ACTIVE.includes(state);
    this.live.isLive = !isEnded;
    if (before && stateOf(before) !== state) announce(`Job ${this.id}: ${stateWords(state)}`);
    const badge = stateBadge(job);
    if (!this.badge.isEqualNode(badge)) {
      this.badge.replaceWith(badge);
      this.badge = badge;
    }
    this.showButtons(isEnded, job);
    say(byId("tenant"), `Tenant ${job.name.split("/")[1]}`);
    replaceIfNew(this.details, jobFacts(job));
    replaceIfNew(this.failure, failureBox(job));
    replaceIfNew(this.summary, job.summary ? summarySection(job) : null);
    if (job.progress && job.progress.stage && !this.live.attempt) this.live.told(job.progress);
    if (isEnded) this.live.end(state === "JOB_STATE_SUCCEEDED");
    if (state === "JOB_STATE_SUCCEEDED" && !this.resultAsked) this.offerResult();
  }

  showButtons(isEnded, job) {
    const focused = document.activeElement;
    this.cancelButton.hidden = isEnded;
    this.cancelButton.disabled = Boolean(job.cancelRequested);
    this.deleteButton.hidden = !isEnded;
    this.retryButton.hidden = !isEnded || stateOf(job) === "JOB_STATE_SUCCEEDED";
    this.againButton.hidden = !isEnded || !job.input;
    this.againNote.hidden = !isEnded || Boolean(job.input);
    // A hidden button loses the focus to nothing; the keyboard would begin at the top again.
    if (focused === this.cancelButton && (isEnded || job.cancelRequested)) document.querySelector("h2").focus();
  }

  async cancel() {
    const text = `${this.id} stops, and cannot be continued.`;
    if (!(await confirmed("Cancel this job?", text, "Cancel job"))) return;
    try {
      this.show(await call("POST", `/v1/${this.name}:cancel`, { body: {}, signal: this.signal }));
      announce(`Job ${this.id}: cancel asked for`);
    } catch (error) {
      tellError(error, "The job was not cancelled");
    }
  }

  async retry() {
    try {
      await call("POST", `/v1/${this.name}:retry`, { body: { etag: this.job.etag || "" }, signal: this.signal });
      // The page begins anew: the events of both runs follow.
      told = `The job ${this.id} waits again.`;
      show();
    } catch (error) {
      tellError(error, "The job was not retried");
    }
  }

  async remove() {
    const input = this.job.input ? "events and result; the uploaded input stays" : "input, events and result";
    const text = `${this.id} is removed with its ${input}. This cannot be undone.`;
    if (!(await confirmed("Delete this job?", text, "Delete job"))) return;
    try {
      const query = new URLSearchParams({ etag: this.job.etag || "" });
      await call("DELETE", `/v1/${this.name}?${query}`, { signal: this.signal });
      told = `The job ${this.id} is deleted.`;
      location.hash = "#/";
    } catch (error) {
      tellError(error, "The job was not deleted");
    }
  }

  /** A new job of the same input, settings and webhook; a deadline is not taken over, since it has mostly passed. */
  async createAgain() {
    const { settings, labels, priority, input, name } = this.job;
    const webhook = this.job.webhook && { url: this.job.webhook.url };
    const body = { job: { settings, labels, priority, webhook }, input, requestId: this.requestId };
    this.againButton.disabled = true;
    try {
      const parent = name.split("/").slice(0, 2).join("/");
      const created = await call("POST", `/v1/${parent}/jobs`, { body, signal: this.signal });
      // The same id until the answer is there: a call that is repeated makes no second job.
      this.requestId = uuid();
      announce(`Job ${created.name.split("/").pop()} is created.`);
      location.hash = `#/${created.name}`;
    } catch (error) {
      tellError(error, "The job was not created");
    } finally {
      this.againButton.disabled = false;
    }
  }

  offerResult() {
    this.resultAsked = true;
    const size = Number((this.job.summary || {}).resultSizeBytes || 0);
    if (size <= AUTOMATIC_RESULT_BYTES) {
      this.loadResult();
      return;
    }
    const words = `Read the result (${bytes(size)})`;
    const button = make("button", { type: "button", onclick: () => this.loadResult() }, words);
    this.result.replaceChildren(make("section", {}, make("h3", {}, "Result"), button));
  }

  async loadResult() {
    const loading = make("p", { className: "empty" }, "Loading.");
    this.result.replaceChildren(make("section", {}, make("h3", {}, "Result"), loading));
    try {
      const result = await call("GET", `/v1/${this.name}/result`, { signal: this.signal, limit: 0 });
      // A job of less than half a second may have told no progress: its result has the curves.
      if (!this.live.attempt) {
        for (const progress of result.progressRecords || []) this.live.add(progress, this.job.attemptCount || 1);
      }
      this.result.replaceChildren(...resultSections(result, this.job));
      announce("The result is shown.");
    } catch (error) {
      if (this.signal.aborted) return;
      const again = make("button", { type: "button", onclick: () => this.loadResult() }, "Read again");
      const large = error.reason === "RESULT_TOO_LARGE" ? " The command scpsfm result reads it over gRPC." : "";
      this.result.replaceChildren(make("section", {}, make("h3", {}, "Result"),
        make("p", { role: "alert" }, `The result cannot be read: ${error.message}.${large}`), again));
    }
  }
}

/** Replaces children where they differ; a table that is read is not torn away. */
function replaceIfNew(element, children) {
  const fresh = make("div", {}, children);
  // What was opened stays open.
  for (const [place, details] of fresh.querySelectorAll("details").entries()) {
    details.open = Boolean((element.querySelectorAll("details")[place] || {}).open);
  }
  const same = fresh.childNodes.length === element.childNodes.length &&
    [...fresh.childNodes].every((child, place) => child.isEqualNode(element.childNodes[place]));
  if (!same) element.replaceChildren(...fresh.childNodes);
}

// ---- Result --------------------------------------------------------------------------------------------------------

/** A table that shows its first rows, and the others when asked. */
function longTable(caption, columns, rows) {
  const holder = make("div", {}, table(caption, columns, rows.slice(0, MOST_ROWS)));
  if (rows.length > MOST_ROWS) {
    const more = make("button", {
      type: "button",
      onclick: () => {
        holder.replaceChildren(table(caption, columns, rows));
        holder.firstChild.focus();
      },
    }, `Show all ${count(rows.length)} rows`);
    holder.append(make("p", { className: "tools" }, more));
  }
  return holder;
}

const withSigma = (value, sigma, unit = "") =>
  sigma === undefined ? `${figure(value)}${unit}` : `${figure(value)} ± ${figure(sigma, 2)}${unit}`;

/** Centre of a view in the metric frame, -R^T t. */
function centreOf(view) {
  const [R, t] = [view.rotation, view.translation];
  if (!R || !t || R.length !== 9 || t.length !== 3) return null;
  return [0, 1, 2].map((k) => -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2]));
}

function calibrationTable(result) {
  const rows = result.calibrations || [];
  const distortion = (row) => {
    const names = [
      ["k1", "radialK1"], ["k2", "radialK2"], ["k3", "radialK3"], ["p1", "tangentialP1"], ["p2", "tangentialP2"],
    ];
    const given = names.filter(([, field]) => row[field]);
    const sigma = (field) => row[`sigma${field[0].toUpperCase()}${field.slice(1)}`];
    return given.map(([name, field]) => `${name} ${withSigma(row[field], sigma(field))}`).join(", ") || "none";
  };
  const columns = [
    column("Group", (row) => String(row.cameraGroup || 0), "number"),
    column("Grade", (row) => bare(row.grade, "GRADE") || "-"),
    column("Focal length ± σ", (row) => focalWords(row.focalPx, row.sigmaLogFocal)[0], "number"),
    column("Principal point x", (row) =>
      withSigma(row.principalPointXPx || 0, row.sigmaPrincipalPointXPx, " px"), "number"),
    column("Principal point y", (row) =>
      withSigma(row.principalPointYPx || 0, row.sigmaPrincipalPointYPx, " px"), "number"),
    column("Aspect", (row) => withSigma(row.aspect || 0, row.sigmaAspect), "number"),
    column("Lens", (row) => bare(row.lensProjection, "LENS_PROJECTION").toLowerCase() || "-"),
    column("Distortion", distortion),
  ];
  return rows.length ? table("Cameras, one row for each camera group", columns, rows)
    : make("p", { className: "note" }, "There is no metric reconstruction, so there is no calibration.");
}

/** What is known of the rigid motions that rejected tracks agree on; nothing where there is none. */
function structureTable(result) {
  const structures = result.secondStructures || [];
  const numbers = (result.tracks || {}).secondStructureNumbers || [];
  const kind = (row) => bare(row.kind, "SECOND_STRUCTURE_KIND");
  const columns = [
    column("Number", (row) => String(row.number), "number"),
    column("Kind", (row) => STRUCTURE_KINDS[kind(row)] || kind(row) || "-"),
    column("Tracks", (row) => count(numbers.filter((number) => number === row.number).length), "number"),
    column("Views with poses", (row) => count((row.poses || []).length), "number"),
    column("Points", (row) => count((row.points || []).length), "number"),
  ];
  const title = make("h4", {}, "Second structures");
  const caption = "Rigid motions that rejected tracks agree on";
  return structures.length ? [title, longTable(caption, columns, structures)] : null;
}

function viewTable(views) {
  const rows = views.map((view, place) => ({ ...view, place, centre: centreOf(view) }));
  const leftOut = (row) => {
    if (!row.leftOut) return "";
    const reason = bare(row.leftOut.reason, "LEFT_OUT_REASON");
    const counts = row.leftOut.pointCount ? ` (${row.leftOut.agreeingPointCount || 0} of ${row.leftOut.pointCount})` : "";
    return `${LEFT_OUT[reason] || reason}${counts}`;
  };
  const isRegistered = (row) => Boolean(row.projection && row.projection.length);
  const columns = [
    column("View", (row) => String(row.place), "number"),
    column("Name", (row) => (row.name ? foreign(row.name) : "-"), "name"),
    column("Registered", (row) => (isRegistered(row) ? "yes" : "no")),
    column("Part", (row) => (isRegistered(row) ? String(row.part || 0) : "-"), "number"),
    column("Group", (row) => String(row.cameraGroup || 0), "number"),
    column("Centre (own scale)", (row) =>
      (row.centre ? row.centre.map((value) => figure(value, 3)).join(", ") : "-"), "number"),
  ];
  if (views.some((view) => view.focalPx !== undefined)) {
    const focal = (row) => (row.focalPx === undefined ? "-" : `${figure(row.focalPx, 5)} px`);
    columns.push(column("Focal length", focal, "number"));
  }
  if (views.some((view) => view.leftOut)) columns.push(column("Why left out", leftOut));
  return longTable("Views", columns, rows);
}

function resultSections(result, job) {
  const views = result.views || [];
  const tracks = result.tracks || {};
  const observations = result.observations || {};
  const right = (flags) => (flags || []).reduce((sum, flag) => sum + (flag ? 1 : 0), 0);
  const warnings = result.warnings || [];
  const isMore = warnings.length > ((job.summary || {}).warnings || []).length;
  const pixels = (value) => (value === undefined ? "-" : `${figure(value, 3)} px`);
  const registered = views.filter((view) => view.projection && view.projection.length).length;
  const pairs = [
    ["Tracks", count((tracks.inliers || []).length), `${count(right(tracks.inliers))} inliers`],
    ["Observations", count((observations.inliers || []).length),
      `${count(right(observations.inliers))} inliers, ${count(right(observations.classified))} classified`],
    ["Views", count(views.length), `${count(registered)} registered`],
    ["Points", count((tracks.pointTrackIndices || []).length),
      (result.trackSplits || []).length ? `${count(result.trackSplits.length)} more of tracks that join several` : null],
    ["Reprojection error, RMS", pixels(result.reprojectionRmsPx), `mean ${pixels(result.reprojectionMeanPx)}`],
    ["Noise σ", pixels(result.noisePx)],
    ["Method", bare(result.method, "METHOD"), `seed ${result.seed || 0}, version ${result.serverVersion || "-"}`],
  ];
  const times = [
    column("Stage", (row) => STAGES[bare(row.stage, "STAGE")] || bare(row.stage, "STAGE")),
    column("Time", (row) => seconds(duration(row.duration)), "number"),
  ];
  return [
    make("section", { "aria-labelledby": "result-title" }, make("h3", { id: "result-title" }, "Result"),
      facts(pairs), isMore ? [make("h4", {}, "All warnings"), warningList(warnings)] : null,
      make("h4", {}, "Cameras"), calibrationTable(result), structureTable(result),
      make("details", {}, make("summary", {}, `Views (${count(views.length)})`), viewTable(views)),
      make("details", {}, make("summary", {}, "Times"), table("Time by stage", times, result.stageDurations || []))),
    sceneSection(result, views),
  ];
}

// ---- Scene in 3D ---------------------------------------------------------------------------------------------------

/** Products of 3 x 3 matrices, row by row. */
function times(a, b) {
  const product = [];
  for (let row = 0; row < 3; row += 1) {
    for (let col = 0; col < 3; col += 1) {
      product.push(a[3 * row] * b[col] + a[3 * row + 1] * b[3 + col] + a[3 * row + 2] * b[6 + col]);
    }
  }
  return product;
}

const turnY = (angle) => [Math.cos(angle), 0, Math.sin(angle), 0, 1, 0, -Math.sin(angle), 0, Math.cos(angle)];
const turnX = (angle) => [1, 0, 0, 0, Math.cos(angle), -Math.sin(angle), 0, Math.sin(angle), Math.cos(angle)];

/** Extent of all but the farthest values: a few far points would shrink all others to a dot. */
function extent(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  const last = sorted.length - 1;
  return last < 0 ? [] : [sorted[Math.floor(share * last)], sorted[Math.ceil((1 - share) * last)]];
}

/** Points and cameras of one part; the parts have no common frame. */
function partOf(result, views, part) {
  const tracks = result.tracks || {};
  const parts = tracks.pointParts || [];
  const all = [];
  for (let k = 0; k < (tracks.pointTrackIndices || []).length; k += 1) {
    const point = (tracks.points || []).slice(3 * k, 3 * k + 3).map(Number);
    if ((parts[k] || 0) === part && point.every(Number.isFinite)) all.push(point);
  }
  const step = Math.max(1, Math.ceil(all.length / MOST_POINTS));
  const points = all.filter((_, place) => place % step === 0);
  const cameras = views.filter((view) => (view.part || 0) === part)
    .map((view) => ({ centre: centreOf(view), rotation: view.rotation }))
    .filter((camera) => camera.centre);
  return { points, cameras, pointCount: all.length };
}

/** Draws a part; turned by pointer and keyboard. */
class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.part = null;
    this.listen();
  }

  reset() {
    // From above and beside the first camera.
    [this.yaw, this.pitch, this.zoom] = [0.5, -0.35, 1];
    if (this.part) this.fit();
  }

  /** As large as the picture has room for. */
  fit() {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const project = this.projector(width, height);
    const used = (place) => {
      const seen = project(place);
      return seen ? Math.max(Math.abs(2 * seen[0] / width - 1), Math.abs(2 * seen[1] / height - 1)) : 0;
    };
    const ends = extent(this.part.points.map(used), 0.03).slice(1);
    const most = Math.max(...ends, ...this.part.cameras.map((camera) => used(camera.centre)), 0.05);
    this.zoom = 0.85 / most;
  }

  show(part) {
    this.part = part;
    const centres = part.cameras.map((camera) => camera.centre);
    const [lows, highs] = [[], []];
    for (let k = 0; k < 3; k += 1) {
      const along = (places) => places.map((place) => place[k]);
      const ends = [...extent(along(part.points), 0.05), ...along(centres)];
      lows.push(ends.reduce((least, end) => Math.min(least, end), Infinity));
      highs.push(ends.reduce((most, end) => Math.max(most, end), -Infinity));
    }
    this.middle = lows.map((low, k) => (low + highs[k]) / 2);
    // Where all centres are one, a camera that only turned, nothing gives a scale.
    this.radius = Math.hypot(...highs.map((high, k) => (high - lows[k]) / 2)) || 1;
    this.base = part.cameras.length ? part.cameras[0].rotation : [1, 0, 0, 0, 1, 0, 0, 0, 1];
    this.reset();
    this.draw();
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.55, Math.max(-1.55, this.pitch + pitch));
    this.draw();
  }

  scale(factor) {
    this.zoom = Math.min(40, Math.max(0.1, this.zoom * factor));
    this.draw();
  }

  act(key) {
    const acts = {
      ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0), ArrowUp: () => this.turn(0, 0.1),
      ArrowDown: () => this.turn(0, -0.1), "+": () => this.scale(1.2), "=": () => this.scale(1.2),
      "-": () => this.scale(1 / 1.2), 0: () => { this.reset(); this.draw(); },
    };
    if (!acts[key]) return false;
    acts[key]();
    return true;
  }

  listen() {
    const { canvas } = this;
    let held = null;
    canvas.addEventListener("pointerdown", (event) => {
      held = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!held) return;
      this.turn((event.clientX - held[0]) * 0.008, (held[1] - event.clientY) * 0.008);
      held = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = null; });
    canvas.addEventListener("keydown", (event) => {
      if (!event.ctrlKey && !event.metaKey && !event.altKey && this.act(event.key)) event.preventDefault();
    });
    canvas.addEventListener("wheel", (event) => {
      // Only where it was chosen: else the wheel scrolls the page.
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
    new ResizeObserver(() => this.part && this.draw()).observe(canvas);
    for (const query of ["(prefers-color-scheme: dark)", `(resolution: ${window.devicePixelRatio}dppx)`]) {
      matchMedia(query).addEventListener("change", () => this.part && this.draw());
    }
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const project = this.projector(width, height);
    this.drawPoints(context, project, colour("--accent"));
    this.drawCameras(context, project, colour("--third"), colour("--ink"));
  }

  projector(width, height) {
    const R = times(turnX(this.pitch), times(turnY(this.yaw), this.base));
    const [middle, radius] = [this.middle, this.radius];
    const away = 3;
    const size = 0.42 * Math.min(width, height) * away * this.zoom;
    return (place) => {
      const [x, y, z] = place.map((value, k) => (value - middle[k]) / radius);
      const depth = R[6] * x + R[7] * y + R[8] * z + away;
      if (depth < 0.05) return null;
      return [
        width / 2 + (size * (R[0] * x + R[1] * y + R[2] * z)) / depth,
        height / 2 + (size * (R[3] * x + R[4] * y + R[5] * z)) / depth,
        depth,
      ];
    };
  }

  drawPoints(context, project, colour) {
    const { points } = this.part;
    const size = points.length > 4000 ? 1.5 : 3.5;
    context.fillStyle = colour;
    for (const point of points) {
      const seen = project(point);
      if (!seen) continue;
      // Far points are fainter.
      context.globalAlpha = Math.min(1, Math.max(0.45, 1.7 - seen[2] / 3.4));
      context.fillRect(seen[0] - size / 2, seen[1] - size / 2, size, size);
    }
    context.globalAlpha = 1;
  }

  drawCameras(context, project, colour, first) {
    const { cameras } = this.part;
    const size = this.radius * (cameras.length > 100 ? 0.04 : 0.09);
    const corners = [[-1, -0.75, 1.4], [1, -0.75, 1.4], [1, 0.75, 1.4], [-1, 0.75, 1.4]];
    context.lineWidth = 1.2;
    cameras.forEach((camera, place) => {
      const R = camera.rotation;
      // From camera axes to the frame: R^T c.
      const inFrame = ([x, y, z]) => [0, 1, 2].map((k) =>
        camera.centre[k] + (size / 2) * (R[k] * x + R[3 + k] * y + R[6 + k] * z));
      const apex = project(camera.centre);
      const frame = corners.map((corner) => project(inFrame(corner)));
      if (!apex || frame.includes(null)) return;
      context.strokeStyle = place === 0 ? first : colour;
      context.beginPath();
      frame.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.closePath();
      for (const [x, y] of frame) {
        context.moveTo(apex[0], apex[1]);
        context.lineTo(x, y);
      }
      context.stroke();
    });
  }
}

function sceneSection(result, views) {
  const section = make("section", { "aria-labelledby": "scene-title" },
    make("h3", { id: "scene-title" }, "Cameras and points"));
  const parts = [...new Set(views.filter(centreOf).map((view) => view.part || 0))].sort((a, b) => a - b);
  if (!parts.length) {
    section.append(make("p", { className: "empty" },
      "There is no metric reconstruction to draw: distances and angles of a projective one have no meaning."));
    return section;
  }
  const canvas = make("canvas", { id: "scene", tabindex: 0, role: "img", "aria-describedby": "scene-hint" });
  const scene = new Scene(canvas);
  const note = make("p", { className: "note" });
  const choose = (part) => {
    const content = partOf(result, views, part);
    const words = `${plural(content.cameras.length, "camera")} and ${plural(content.pointCount, "point")}`;
    canvas.setAttribute("aria-label", `3D view of ${words}`);
    const some = content.points.length < content.pointCount ? `; ${count(content.points.length)} points are drawn` : "";
    say(note, `${words}${some}. The first camera has the colour of the text. The scale is arbitrary.`);
    requestAnimationFrame(() => scene.show(content));
  };
  const tool = (words, key) => make("button", { type: "button", onclick: () => scene.act(key) }, words);
  const tools = make("div", { className: "buttons tools" },
    tool("Turn left", "ArrowLeft"), tool("Turn right", "ArrowRight"), tool("Tilt up", "ArrowUp"),
    tool("Tilt down", "ArrowDown"), tool("Nearer", "+"), tool("Farther", "-"), tool("Reset", "0"));
  if (parts.length > 1) {
    const options = parts.map((part) => make("option", { value: part }, `Part ${part}`));
    const select = make("select", { id: "part", onchange: () => choose(Number(select.value)) }, options);
    tools.append(make("label", { for: "part" }, "Part"), select);
  }
  section.append(canvas, tools, note, make("p", { id: "scene-hint", className: "hint" },
    "Drag to turn. With the focus on the picture: arrow keys turn, + and - or the wheel change the size, 0 resets."));
  choose(parts[0]);
  return section;
}

// ---- Pages ---------------------------------------------------------------------------------------------------------

/** Ends what the page that is shown does. */
let leaving = null;

/** What the next page tells first. */
let told = "";

/** Shows the page that the address names. */
function show(isFirst) {
  if (leaving) leaving.abort();
  leaving = new AbortController();
  for (const id of ["poll", "stream", "call"]) clearNotice(id);
  if (told) notice("", told);
  told = "";
  const main = byId("main");
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  if (JOB_NAME.test(path)) {
    new JobPage(path, main, leaving.signal);
  } else if (path === "") {
    showList(new URLSearchParams(query || ""), main, leaving.signal);
  } else {
    document.title = "Not found - scpsfm";
    main.replaceChildren(make("h2", { tabindex: -1 }, "There is no such page"),
      make("p", {}, make("a", { href: "#/" }, "Show the jobs")));
  }
  const heading = main.querySelector("h2");
  // A new page begins at its heading, for readers of any kind; the first one where the browser begins.
  if (heading && isFirst !== true) {
    heading.focus();
    window.scrollTo(0, 0);
  }
}

async function showServer() {
  try {
    const capabilities = await call("GET", "/v1/capabilities");
    const queue = capabilities.queueLimits || {};
    const most = Number(queue.maxJobs || 0);
    say(byId("server"), `Version ${capabilities.serverVersion}${most ? `, at most ${count(most)} jobs wait` : ""}`);
  } catch {
    // The page itself says what is wrong; this line is an extra.
    say(byId("server"), "");
  }
}

prepareDialogs();
showKeyButton();
document.querySelector(".skip").addEventListener("click", (event) => {
  // The address names the page, not a place within it.
  event.preventDefault();
  byId("main").focus();
});
window.addEventListener("hashchange", show);
show(true);
showServer();
