// The screen: one state, one result, and one function that draws both.

import { connect, tab } from "./channel.js";
import { Commands } from "./commands.js";
import { angleAt, drawCurve } from "./curve.js";
import { find, isPhone, make, onPicture, wrap } from "./dom.js";
import { HEATS, drawHead, drawHeadline, drawPictures, drawTurn, focusPictures, shownTile } from "./draw.js";
import { partAt } from "./heat.js";
import { makeOwnSender } from "./own.js";
import { Panels } from "./panels.js";
import { markFocus } from "./pictures.js";
import { RailList, showYours } from "./rail.js";
import { showRows, showStrip, showSums } from "./rows.js";
import { SceneFrame } from "./scene.js";
import "./terms.js";
import { makeTurnable } from "./turn.js";

const STEP = 15; // degrees of a key
const NOTED = 8000; // ms of a note
const KEPT = "lpn-theme";

/**
 * `said` is a sentence in the headline's place: a `busy` one disappears with the next result, others with the next action.
 * @type {{page: any, state: any, result: any, rail: any, curve: any, yours: any, mark: any, angle: number, focus: number, pin: number, hovered: number | null, truth: boolean, colour: boolean, said: {text: string, busy: boolean, result: any} | null, note: string, lost: boolean}}
 */
const view = { page: null, state: null, result: null, rail: null, curve: null, yours: { photos: [], thumbnails: "" }, mark: null, angle: 0, focus: -1, pin: -1, hovered: null, truth: false, colour: false, said: null, note: "", lost: false };
const [photo, tile, rows, curve, strip, sum] = ["#photo", "#tile", "#rows", "#curve", "#strip", "#sum"].map((one) => find(one));
const list = new RailList(find("#list"));

let kept = null;
// The inputs of a result: while the state differs in them, the numbers are faded.
const OF_PAGE = ["place", "task", "model"];
const OF_RESULT = [...OF_PAGE, "scoring", "query", "own", "compare", "weights", "heat"];
const isStale = () => view.result.angle !== view.angle || OF_RESULT.some((name) => JSON.stringify(view.result.state[name]) !== JSON.stringify(view.state[name]));

// Messages of the server.
const channel = connect(
  {
    // Its state comes with it.
    page: (page) => {
      view.page = page;
      if (view.pin >= 0) channel.act("hover", { part: -1 });
      [view.result, view.curve, view.focus, view.pin] = [null, null, -1, -1];
    },
    state: (state) => {
      const moved = !view.state || ["place", "task", "query", "own", "model"].some((name) => state[name] !== view.state[name]);
      if (view.state && state.place !== view.state.place) {
        scene.away();
        panels.leave();
      }
      if (moved) strip.scrollLeft = 0;
      view.state = state;
      if (moved || sent === null) view.angle = state.angle;
      showYours(find("#yours"), view.yours, state.own);
      for (const theme of ["light", "dark"]) document.documentElement.classList.toggle(theme, theme === state.theme);
      history.replaceState(null, "", state.address ? `?${state.address}` : location.pathname);
      soon();
    },
    rail: (rail) => {
      view.rail = rail;
      list.show(rail, view.state.query);
      commands.draw();
      soon();
    },
    result: (result) => {
      if (OF_PAGE.some((name) => result.state[name] !== view.state[name])) return; // the new page's result will follow
      view.result = result;
      if (view.said?.busy) view.said = null;
      if (view.curve?.sequence !== result.curve) view.curve = null;
      arrived();
      soon();
    },
    curve: (points) => {
      if (points.sequence === view.result?.curve) view.curve = points;
      soon();
    },
    yours: (yours) => {
      view.yours = yours;
      own.received(yours.taken);
      showYours(find("#yours"), yours, view.state.own);
      commands.draw();
    },
    mark: (mark) => {
      view.mark = mark;
      soon();
    },
    scene: (place) => place === view.state.place && scene.ready(),
    picked: (found) => scene.picked(found),
    occlusion: ({ number, done, squares, photo: covered }) => {
      if (view.result?.number !== number) return;
      view.result = { ...view.result, photo: { ...view.result.photo, ...covered }, measured: done < squares ? `${done} of ${squares}` : "" };
      soon();
    },
    panel: ({ name, message }) => panels.receive(name, message),
    note: (text) => note(text),
    download: ({ address, name }) => make("a", { href: address, download: name }).click(),
    busy: (text) => say(text, true),
    error: (text) => {
      say(text);
      arrived();
    },
  },
  () => {
    if (view.lost) scene.reload();
    view.lost = false;
    const search = new URLSearchParams(location.search);
    if (!search.has("theme")) search.set("theme", kept ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark"));
    channel.act("open", { search: `?${search}` });
  },
  () => {
    view.lost = true;
    arrived();
    own.lost();
    scene.away();
    say("Connection lost. Trying again.", true);
  },
);

// While the connection opens.
try {
  kept = localStorage.getItem(KEPT);
} catch {} // the browser may deny its storage

/** Show a sentence in the headline's place; the current result stays, faded. */
const say = (text, busy = false) => {
  if (text || view.said?.busy === busy) view.said = text ? { text, busy, result: view.result } : null;
  soon();
};
const act = (name, args = {}) => {
  say("");
  channel.act(name, args);
};

/** Show a note in place of the headline's reason, which returns after a while. */
let noted = 0;
const note = (text) => {
  view.note = text;
  clearTimeout(noted);
  noted = setTimeout(() => note(""), NOTED);
  soon();
};

// One request is in flight; the newest angle is sent next.
let sent = null;
const turnTo = (angle) => {
  if (!view.result || !view.page.turns) return;
  say("");
  view.angle = Math.round(wrap(angle) * 10) / 10;
  view.focus = view.pin;
  if (sent === null && view.angle !== view.state.angle) sendAngle(); // the server answers only changes
  soon();
};
const sendAngle = () => {
  sent = view.angle;
  channel.set({ angle: sent });
};
const arrived = () => {
  sent = null;
  // The newest angle's result has arrived, or will.
  if (view.result && view.angle !== view.state.angle && view.angle !== view.result.angle && !view.lost) sendAngle();
};
const set = (values) => {
  say("");
  channel.set(values);
};
const dragged = makeTurnable(photo, { photo: () => (view.page?.turns ? view.result?.photo : null), angle: () => view.angle, turn: turnTo, end: () => turnTo(view.angle) });

const flipTheme = () => {
  const theme = view.state.theme === "dark" ? "light" : "dark";
  kept = theme;
  try {
    localStorage.setItem(KEPT, theme);
  } catch {}
  set({ theme });
};

// Drawing.
let due = 0;
const soon = () => {
  if (!due) due = requestAnimationFrame(draw);
};
let loaded = 0;
onPicture(() => {
  loaded++;
  soon();
});
// The inputs of each part of the page; it is redrawn when they change.
const drawnFrom = new Map();
const redraw = (part, from, draws) => {
  const before = drawnFrom.get(part);
  drawnFrom.set(part, from);
  if (!before || from.some((one, at) => one !== before[at])) draws();
};

const draw = () => {
  due = 0;
  const { page, state, result } = view;
  document.body.classList.toggle("wait", !result);
  document.body.classList.toggle("down", Boolean(view.said && result && view.said.result === result));
  drawHeadline(view);
  if (!page || !state) return;
  redraw("head", [page, state, view.rail, view.said], () => drawHead(view)); // a model that fails to open is not selected
  panels.show(page.panels, state.panel);
  if (!result) return drawTurn(view);
  const stale = isStale();
  document.body.classList.toggle("turning", stale);
  document.body.classList.toggle("color", view.colour);
  const from = [result, state.theme, innerWidth, innerHeight];
  redraw("pictures", [...from, view.truth, view.focus, view.mark], () => drawPictures(view));
  redraw("rows", [...from, view.colour, loaded], () => showRows(rows, page, result, view.colour));
  redraw("sum", from, () => {
    showSums(sum, result);
    showStrip(strip, result);
  });
  redraw("focus", [...from, view.colour, loaded, view.focus], () => focusShares(view.focus));
  drawTurn(view);
  redraw("scene", [...from, state.view], () => scene.show(result.scene, state.view, page.place));
  drawCurve(curve, view.curve?.points ?? [], result, view.angle, stale, view.hovered);
  document.body.dataset.sequence = String(Number(document.body.dataset.sequence ?? 0) + 1);
};

// One part is highlighted everywhere: the one under the pointer, else the pinned one; none in a drag.
const focusOn = (hovered) => {
  const part = hovered < 0 ? view.pin : hovered;
  if (part !== view.focus && !dragged() && view.result && view.page.parts > 1 && !isStale()) light(part);
};
const focusShares = (part) => {
  for (const one of [rows, strip, sum]) markFocus(one, part);
};
const light = (part) => {
  view.focus = part;
  channel.act("hover", { part });
  focusShares(part);
  focusPictures(view, part);
};
/** Pin a part, or unpin it. */
const pin = (part) => {
  if (!view.result || view.page.parts === 1) return;
  view.pin = part === view.pin ? -1 : part;
  light(view.pin);
};
for (const figure of [photo, tile]) {
  const frame = find(".frame", figure);
  const partUnder = (event) => {
    const box = find(".pan", figure).getBoundingClientRect();
    const { parts } = figure === photo ? view.result.photo : view.result.tiles[shownTile(view)];
    return partAt(parts, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  };
  frame.addEventListener("pointermove", (event) => view.result && focusOn(partUnder(event)));
  frame.addEventListener("click", (event) => view.result && pin(partUnder(event)));
  frame.addEventListener("pointerleave", () => focusOn(-1));
}
for (const one of [rows, strip, sum]) {
  one.addEventListener("pointerover", (event) => focusOn(Number(event.target.closest("[data-part]")?.dataset.part ?? -1)));
  one.addEventListener("pointerleave", () => focusOn(-1));
}
for (const one of [rows, sum])
  one.addEventListener("click", ({ target }) => {
    const part = target.closest("[data-part]")?.dataset.part;
    if (part && !target.closest("[data-weight]")) pin(Number(part));
  });

// Part weights: drag the number at a row's head, or use the arrow keys.
const weigh = (before, part, by) => {
  const weights = [...before];
  weights[part] = Math.round(20 * Math.max(0, Math.min(2, before[part] + by))) / 20;
  if (weights.some(Boolean)) set({ weights });
};
const weightsNow = () => (view.result.weights.length ? view.result.weights : Array(view.page.parts).fill(1));
rows.addEventListener("pointerdown", (event) => {
  const head = event.target.closest("[data-weight]");
  if (!head || !view.result) return;
  head.setPointerCapture(event.pointerId);
  const before = weightsNow();
  const drag = (move) => weigh(before, Number(head.dataset.weight), (move.clientX - event.clientX) / 60);
  head.addEventListener("pointermove", drag);
  head.addEventListener("lostpointercapture", () => head.removeEventListener("pointermove", drag), { once: true });
});
rows.addEventListener("keydown", (event) => {
  const head = event.target.closest("[data-weight]");
  const by = { ArrowRight: 0.1, ArrowUp: 0.1, ArrowLeft: -0.1, ArrowDown: -0.1 }[event.key];
  if (!head || !by) return;
  event.preventDefault();
  event.stopPropagation();
  weigh(weightsNow(), Number(head.dataset.weight), by);
});

// Clicks.
const compare = (index) => {
  const { result } = view;
  if (result) set({ compare: index === result.answer || (result.pinned && index === result.rival) ? null : index });
};
strip.addEventListener("click", (event) => {
  const button = event.target.closest("[data-tile]");
  if (button) compare(Number(button.dataset.tile));
});
const pointedAt = (event) => {
  const plot = find(".plot", curve);
  return angleAt(plot, event.clientX - plot.getBoundingClientRect().left);
};
curve.addEventListener("pointerdown", (event) => turnTo(pointedAt(event)));
curve.addEventListener("pointermove", (event) => show({ hovered: pointedAt(event) }));
curve.addEventListener("pointerleave", () => show({ hovered: null }));
document.addEventListener("click", (event) => {
  const chosen = /** @type {any} */ (event.target).closest("[data-query], [data-own], [data-view], [data-filter], [data-back], [data-equal], [data-press]");
  const { query, own: mine, view: seen, filter, back, equal, press: name } = chosen?.dataset ?? {};
  if (query) set({ query: Number(query), own: "" });
  if (mine) set({ own: mine });
  if (seen) set({ view: seen });
  if (filter) set({ filter });
  if (name && view.page) commandsNow().find((one) => one.keys?.includes(name))?.act();
  if (back !== undefined) say("");
  if (equal !== undefined) set({ weights: [] });
});
const step = (by) => act("step", { by });
find("#model").onclick = () => set({ model: String((Number(view.state.model) + 1) % view.page.models.length) });
find("#models").onchange = (event) => {
  set({ model: event.target.value });
  event.target.blur(); // return the keys to the page
};
find("#full").onclick = () => openPanel(view.page.panels.find((one) => one.place === "full").name);
find("#own").onclick = () => own.choose();
const key = find(".key", photo);
key.addEventListener("pointerenter", () => show({ colour: true }));
key.addEventListener("pointerleave", () => show({ colour: false }));
const show = (values) => {
  Object.assign(view, values);
  soon();
};

const own = makeOwnSender(channel, say);

// Commands and keys: one table.
const nextHeat = () => {
  const kinds = Object.keys(HEATS);
  const heat = kinds[(kinds.indexOf(view.state.heat) + 1) % kinds.length];
  view.colour = false; // the pointer is on the key
  set({ heat });
  note(HEATS[heat].meaning);
};
const commandsNow = () => {
  const { page, state, result } = view;
  const others = (name, values, label) => values.filter((one) => one !== state[name]).map((one) => ({ label: label(one), act: () => set({ [name]: one }) }));
  const scenes = result?.scene ?? [];
  return [
    { label: "Next photo", key: "N ↓", keys: ["n", "arrowdown"], act: () => step(1), hidden: true },
    { label: "Previous photo", key: "P ↑", keys: ["p", "arrowup"], act: () => step(-1), hidden: true },
    { label: "Random photo", key: "R", keys: ["r"], act: () => act("random") },
    { label: state.filter === "all" ? "Missed only, worst first" : "All photos", key: "M", keys: ["m"], act: () => set({ filter: state.filter === "all" ? "missed" : "all" }) },
    { label: "Search photos", key: "/", keys: ["/"], act: () => commands.open("photos"), hidden: true },
    ...(page.turns ? [{ label: "Your photos", act: () => own.choose() }, { label: "Your photos: a folder", act: () => own.choose(true) }] : []),
    ...(view.yours.photos.length ? [{ label: "Forget your photos", act: () => act("forget") }] : []),
    ...page.commands.map((one) => ({ label: one.title, key: one.key.toUpperCase(), keys: [one.key], act: () => act(one.name) })),
    { label: "Copy the link", act: copyLink },
    ...page.panels.map((one) => ({ label: one.title, key: one.key.toUpperCase(), keys: [one.key], act: () => openPanel(one.name) })),
    ...(page.turns
      ? [
          { label: "Turn left by 15°", key: "J ←", keys: ["j", "arrowleft"], act: () => turnTo(view.angle + STEP), hidden: true },
          { label: "Turn right by 15°", key: "L →", keys: ["l", "arrowright"], act: () => turnTo(view.angle - STEP), hidden: true },
          { label: "Upright", key: "0", keys: ["0"], act: () => turnTo(0), hidden: true },
        ]
      : []),
    ...(page.parts > 1 ? [{ label: "One part alone", key: `1 to ${Math.min(page.parts, 9)}`, act: () => {}, hidden: true }] : []),
    ...(result?.photo.heat
      ? [...others("heat", Object.keys(HEATS), (one) => `Heat: ${HEATS[one].name}`), { label: "Next kind of heat", key: "E", keys: ["e"], act: nextHeat, hidden: true }]
      : []),
    { label: "Full colour, while held", key: "F", keys: ["f"], act: () => show({ colour: true }), hidden: true },
    { label: "True tile, while held", key: "T", keys: ["t"], act: () => show({ truth: true }), hidden: true },
    ...(state.weights.length ? [{ label: "Equal weights", act: () => set({ weights: [] }) }] : []),
    ...page.models.map((label, number) => ({ label: `Model: ${label}`, act: () => set({ model: String(number) }) })).filter((_, number) => String(number) !== state.model),
    ...others("task", page.tasks, (one) => `Task: ${one}`),
    ...(page.calibrates ? [{ label: "Ranking: calibrate", act: () => act("calibrate") }] : []),
    ...others("scoring", page.scorings, (one) => `Ranking: ${one}`),
    ...others("place", Object.keys(page.places), (one) => `Place: ${page.places[one]}`),
    ...(scenes.length > 1 ? [{ label: state.view === "city" ? "Rings apart" : page.place, key: "X", keys: ["x"], act: () => set({ view: state.view === "city" ? "apart" : "city" }) }] : []),
    ...(scenes.length ? [{ label: "Large scene", key: "G", keys: ["g"], act: () => enlarge() }] : []),
    { label: state.theme === "dark" ? "Light" : "Dark", key: "D", keys: ["d"], act: flipTheme },
    { label: "Keys", key: "?", keys: ["?"], act: () => commands.open("keys") },
    { label: "All commands", key: "Ctrl K", keys: ["ctrl k"], act: () => commands.open("commands"), hidden: true },
    { label: "Back", key: "Esc", keys: ["escape"], act: escape, hidden: true },
  ];
};
const commands = new Commands(find("#commands"), list, commandsNow, () => view.yours, (text) => channel.set({ find: text.slice(0, 200) }));

const copyLink = () =>
  Promise.resolve(navigator.clipboard?.writeText(location.href)).then(
    () => note(navigator.clipboard ? "The link is copied." : "The address bar has the link."),
    () => note("The address bar has the link."),
  );

const openPanel = (name) => set({ panel: view.state.panel === name ? "" : name });
/** Show the state of an address. */
const go = (search) => channel.act("open", { search });
const panels = new Panels(find("#panel"), { set, go, act, say, view });

const escape = () => {
  if (view.state.panel) panels.close();
  else if (document.body.classList.contains("large")) enlarge(false);
  else if (view.said) say("");
  else if (view.pin >= 0) pin(-1);
  else if (view.result?.pinned) set({ compare: null });
  else if (view.state.weights.length) set({ weights: [] });
  else if (view.state.filter !== "all") set({ filter: "all" });
};
const enlarge = (large = !document.body.classList.contains("large")) => {
  document.body.classList.toggle("large", large);
  const button = find("#scene .enlarge");
  button.textContent = large ? "✕" : "⤢";
  button.title = large ? "Close (Esc)" : "Enlarge (G)";
  button.setAttribute("aria-label", large ? "Close" : "Enlarge");
};
const HELD = "tf";
export const press = (event) => {
  const name = event.key.toLowerCase();
  if (!view.page || !view.state) return;
  if ((event.ctrlKey || event.metaKey) && name === "k") {
    event.preventDefault();
    commands.open("commands");
  }
  if (event.ctrlKey || event.metaKey || event.altKey || find("#commands").open) return;
  const typing = /** @type {any} */ (event.target)?.closest?.("input, textarea, select, [contenteditable]");
  if (typing && name !== "escape") return;
  const part = Number(name) - 1;
  const command = commandsNow().find((one) => one.keys?.includes(name));
  if (name.length === 1 && part >= 0 && part < view.page.parts) pin(part);
  else if (command && !(event.repeat && (HELD.includes(name) || [...view.page.panels, ...view.page.commands].some((one) => one.key === name)))) {
    event.preventDefault();
    command.act();
  }
};
addEventListener("keydown", press);
const release = (event) => {
  if (event.key.toLowerCase() === "t") show({ truth: false });
  if (event.key.toLowerCase() === "f") show({ colour: false });
};
addEventListener("keyup", release);
addEventListener("blur", () => show({ truth: false, colour: false }));

const scene = new SceneFrame(find("#scene"), channel, { press, release }, (found) => {
  if (found.why === "hover") {
    if (found.part !== undefined || view.focus >= 0) focusOn(found.part ?? -1);
  } else if (found.tile !== undefined) compare(found.tile);
  else if (found.part !== undefined) pin(found.part);
});

// On a phone the curve stands below the pictures.
const place = () => {
  if (isPhone()) find("#stage").insertBefore(curve, rows);
  else find("#low").prepend(curve);
  soon();
};
addEventListener("resize", () => {
  place();
  if (list.rail) list.draw();
});
place();
document.documentElement.dataset.tab = tab;
