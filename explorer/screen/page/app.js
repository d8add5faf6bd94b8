// The screen: one state, one result, and one function that draws both.

import { connect, tab } from "./channel.js";
import { Commands } from "./commands.js";
import { angleAt, drawCurve } from "./curve.js";
import { find, findAll, isPhone, make, onPicture, variable, wrap } from "./dom.js";
import { paintKey, partAt } from "./heat.js";
import { Panels } from "./panels.js";
import { markFocus, photoTurn, rollPicture, showPicture } from "./pictures.js";
import { RailList } from "./rail.js";
import { showRows, showStrip, showSums, sign } from "./rows.js";
import { SceneFrame } from "./scene.js";
import "./terms.js";
import { makeTurnable } from "./turn.js";

const STEP = 15; // degrees of a key
const MOST = 30_000_000; // bytes of a photo
const KEPT = "lpn-theme";

/** @type {{page: any, state: any, result: any, rail: any, curve: any, angle: number, focus: number, truth: boolean, colour: boolean, waiting: boolean, said: string, lost: boolean}} */
const view = { page: null, state: null, result: null, rail: null, curve: null, angle: 0, focus: -1, truth: false, colour: false, waiting: false, said: "", lost: false };
const [photo, tile, rows, curve, strip, sum] = ["#photo", "#tile", "#rows", "#curve", "#strip", "#sum"].map((one) => find(one));
const list = new RailList(find("#list"));

// What a result depends on: while the state differs from it, the numbers are faded.
const OF_RESULT = ["place", "task", "model", "scoring", "query", "own", "compare", "weights", "heat"];
const isStale = () => view.result.angle !== view.angle || OF_RESULT.some((name) => JSON.stringify(view.result.state[name]) !== JSON.stringify(view.state[name]));

// Messages of the server.
const channel = connect(
  {
    page: (page) => {
      view.page = page;
      [view.result, view.curve] = [null, null];
      soon();
    },
    state: (state) => {
      const moved = !view.state || ["place", "task", "query", "own", "model"].some((name) => state[name] !== view.state[name]);
      view.state = state;
      if (moved) view.angle = state.angle;
      setTheme(state.theme);
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
      [view.result, view.said] = [result, ""];
      if (view.curve?.sequence !== result.curve) view.curve = null;
      arrived();
      soon();
    },
    curve: (points) => {
      view.curve = points;
      soon();
    },
    scene: () => scene.ready(),
    picked: (found) => scene.picked(found),
    occlusion: ({ number, done, squares, photo: covered }) => {
      if (view.result?.number !== number) return;
      view.result = { ...view.result, photo: { ...view.result.photo, ...covered }, measured: done < squares ? `${done} of ${squares}` : "" };
      soon();
    },
    panel: ({ name, message }) => panels.receive(name, message),
    busy: (text) => say(text),
    error: (text) => {
      say(text);
      arrived();
    },
  },
  () => {
    if (view.lost) scene.reload();
    view.lost = false;
    const search = new URLSearchParams(location.search);
    let kept = null;
    try {
      kept = localStorage.getItem(KEPT);
    } catch {} // the browser may deny its storage
    if (!search.has("theme")) search.set("theme", kept ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark"));
    channel.act("open", { search: `?${search}` });
  },
  () => {
    view.lost = true;
    arrived();
    say("Connection lost. Trying again.");
  },
);

/** Say something in the headline's place; the last result stays, faded. */
const say = (text) => {
  view.said = text;
  soon();
};

// One request is in flight, and the newest angle is next.
let sent = null;
const turnTo = (angle) => {
  if (!view.result || !view.page.turns) return;
  view.angle = Math.round(wrap(angle) * 10) / 10;
  view.focus = -1;
  if (sent === null && view.angle !== view.state.angle) sendAngle(); // the server answers a change only
  soon();
};
const sendAngle = () => {
  sent = view.angle;
  channel.set({ angle: sent });
};
const arrived = () => {
  const before = sent;
  sent = null;
  if (before !== null && before !== view.angle && !view.lost) sendAngle();
};
const set = (values) => channel.set(values);
const dragged = makeTurnable(photo, { photo: () => (view.page?.turns ? view.result?.photo : null), angle: () => view.angle, turn: turnTo, end: () => turnTo(view.angle) });

const setTheme = (theme) => {
  const root = document.documentElement;
  if (root.classList.contains(theme)) return;
  root.classList.remove("light", "dark");
  root.classList.add(theme);
};
const flipTheme = () => {
  const theme = view.state.theme === "dark" ? "light" : "dark";
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
// What pictures, rows, and strip were drawn from: a turn of the photo alone leaves them as they are.
let drawn = [];

const draw = () => {
  due = 0;
  const { page, state, result } = view;
  document.body.classList.toggle("wait", !result);
  document.body.classList.toggle("down", Boolean(view.said && result));
  if (!page || !state) return drawHeadline();
  drawHead();
  drawHeadline();
  panels.show(page.panels, state.panel);
  if (!result) return;
  const stale = isStale();
  document.body.classList.toggle("turning", stale);
  document.body.classList.toggle("color", view.colour);
  const from = [result, state.theme, view.colour, view.truth, view.focus, loaded, innerWidth];
  if (from.some((one, at) => one !== drawn[at])) {
    drawn = from;
    drawPictures();
    showRows(rows, page, result, view.colour);
    showSums(sum, result);
    showStrip(strip, result);
    for (const one of [rows, strip, sum]) markFocus(one, view.focus);
  }
  drawTurn();
  scene.show(result.scene, state.view, page.place);
  drawCurve(find("canvas", curve), view.curve?.points ?? [], result, view.angle, stale);
  find("canvas", curve).setAttribute("aria-label", `Rank against angle; at ${view.angle}°: ${result.rank ?? "not known"}`);
  document.body.dataset.sequence = String(Number(document.body.dataset.sequence ?? 0) + 1);
};

const drawHead = () => {
  const { page, state, rail } = view;
  find("#about").textContent = page.parts === 1 ? "The baseline compares whole pictures: one part." : `Photo and tile are cut into ${page.word}s; their distances add up.`;
  const model = find("#model");
  model.textContent = `Model: ${page.models[Number(state.model)].replace(/\.onnx$/, "")}`;
  model.hidden = page.models.length < 2;
  for (const button of findAll("#rail .filter button")) button.setAttribute("aria-pressed", String(button.dataset.filter === state.filter));
  find("#rail .filter [data-filter=missed]").title = rail ? `${rail.missed} of ${rail.queries} missed (M)` : "";
};

const drawHeadline = () => {
  const [title, reason] = [find("#headline h1"), find("#headline p")];
  const { result, page } = view;
  if (view.said) {
    title.textContent = view.said;
    reason.textContent = "";
  } else if (!result) {
    title.textContent = page ? `Comparing with ${page.tiles.toLocaleString("en")} tiles` : "Opening";
    reason.textContent = "";
  } else {
    const { found, title: rest, reason: why } = result.headline;
    if (found === null) title.textContent = rest;
    else title.replaceChildren(make("b", { class: found ? "right" : "wrong", text: found ? "✓ Found" : "✗ Missed" }), `, ${rest}`);
    reason.textContent = why;
  }
};

const drawTurn = () => {
  const frame = find(".frame", photo);
  rollPicture(photo, view.result.photo, view.angle);
  frame.setAttribute("aria-valuenow", String(view.angle));
  frame.setAttribute("aria-valuetext", `${view.angle} degrees`);
  find("#degrees").textContent = `${Math.round(view.angle)}°`;
};

const drawPictures = () => {
  const { page, result } = view;
  const own = result.photo;
  showPicture(photo, own, view.focus, page.parts, photoTurn(own, view.angle), `${own.name}`);
  find(".frame", photo).classList.toggle("fixed", !page.turns);
  find("figcaption b", photo).textContent = page.photo[0].toUpperCase() + page.photo.slice(1);
  find("figcaption .hint", photo).textContent = own.own ? "yours" : page.turns ? (own.around ? "drag to roll" : "drag to turn") : "";
  find("figcaption .key", photo).hidden = !own.heat;
  paintKey(find(".key canvas", photo), own.signed);
  findAll(".key u", photo).forEach((word, end) => (word.textContent = (own.signed ? ["against", "for"] : ["weak", "strong"])[end]));
  if (result.measured) find(".key u", photo).textContent = result.measured;
  const shown = view.truth && result.truth !== null ? result.truth : result.pinned ? result.rival : result.answer;
  const answer = result.tiles[shown];
  const role = shown === result.answer ? "Answer" : shown === result.truth ? "Truth" : "Pinned";
  const colour = answer.true === null ? "--line" : role === "Pinned" ? "--ink" : answer.true ? "--right" : "--wrong";
  tile.style.setProperty("--verdict", variable(colour));
  find("figcaption b", tile).replaceChildren(role, " ", sign(answer.true));
  find("figcaption .name", tile).textContent = answer.name;
  find("figcaption .key", tile).textContent = role === "Pinned" ? `rank ${answer.rank} · Esc` : "";
  showPicture(tile, answer, view.focus, page.parts, `rotate(${-90 * answer.quarter}deg)`, `Tile ${answer.name}`);
};

// One part is lit wherever it is drawn; never in a drag.
const focusOn = (part) => {
  if (part === view.focus || dragged() || !view.result || view.page.parts === 1 || isStale()) return;
  view.focus = part;
  channel.act("hover", { part });
  const { result } = view;
  const shown = view.truth && result.truth !== null ? result.truth : result.pinned ? result.rival : result.answer;
  for (const one of [rows, strip, sum]) markFocus(one, part);
  for (const [figure, described] of [[photo, result.photo], [tile, result.tiles[shown]]])
    showPicture(figure, described, part, view.page.parts, find(".picture", figure).style.transform, "");
};
for (const figure of [photo, tile]) {
  const frame = find(".frame", figure);
  frame.addEventListener("pointermove", (event) => {
    if (!view.result || dragged()) return;
    const box = find(".pan", figure).getBoundingClientRect();
    const { result } = view;
    const shown = view.truth && result.truth !== null ? result.truth : result.pinned ? result.rival : result.answer;
    const { parts } = figure === photo ? result.photo : result.tiles[shown];
    focusOn(partAt(parts, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height));
  });
  frame.addEventListener("pointerleave", () => focusOn(-1));
}
for (const one of [rows, strip, sum]) {
  one.addEventListener("pointerover", (event) => focusOn(Number(event.target.closest("[data-part]")?.dataset.part ?? -1)));
  one.addEventListener("pointerleave", () => focusOn(-1));
}

// Part weights: the number at a row's head is dragged.
rows.addEventListener("pointerdown", (event) => {
  const head = event.target.closest("[data-weight]");
  if (!head || !view.result) return;
  event.preventDefault();
  head.setPointerCapture(event.pointerId);
  const part = Number(head.dataset.weight);
  const before = view.result.weights.length ? view.result.weights : Array(view.page.parts).fill(1);
  const weigh = (move) => {
    const weights = [...before];
    weights[part] = Math.round(20 * Math.max(0, Math.min(2, before[part] + (move.clientX - event.clientX) / 60))) / 20;
    if (weights.some(Boolean)) set({ weights });
  };
  head.addEventListener("pointermove", weigh);
  head.addEventListener("pointerup", () => head.removeEventListener("pointermove", weigh), { once: true });
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
curve.addEventListener("pointerdown", (event) => {
  const canvas = find("canvas", curve);
  turnTo(angleAt(canvas, event.clientX - canvas.getBoundingClientRect().left));
});
document.addEventListener("click", (event) => {
  const target = /** @type {Element} */ (event.target);
  const query = /** @type {any} */ (target.closest("[data-query]"));
  if (query) set({ query: Number(query.dataset.query), own: "" });
  const seen = /** @type {any} */ (target.closest("[data-view]"));
  if (seen) set({ view: seen.dataset.view });
  const filter = /** @type {any} */ (target.closest("[data-filter]"));
  if (filter) set({ filter: filter.dataset.filter });
});
const step = (by) => channel.act("step", { by });
find("#previous").onclick = () => step(-1);
find("#next").onclick = () => step(1);
find("#random").onclick = () => channel.act("random");
find("#find").onclick = () => commands.open();
find("#palette").onclick = () => commands.open();
find("#model").onclick = () => set({ model: String((Number(view.state.model) + 1) % view.page.models.length) });
find("#scene .enlarge").onclick = () => enlarge();
find("#own").onclick = () => find("#file").click();
const key = find(".key", photo);
key.addEventListener("pointerenter", () => show({ colour: true }));
key.addEventListener("pointerleave", () => show({ colour: false }));
const show = (values) => {
  Object.assign(view, values);
  soon();
};

// A photo of one's own: chosen, or dropped anywhere.
const sendPhoto = (file) => {
  if (!file) return;
  if (file.size > MOST) say(`${file.name} has ${Math.round(file.size / 1e6)} MB; up to 30 MB are taken.`);
  else channel.sendFile(file);
};
find("#file").addEventListener("change", (event) => {
  sendPhoto(event.target.files[0]);
  event.target.value = "";
});
addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("drop");
});
addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("drop");
});
addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("drop");
  sendPhoto(event.dataTransfer.files[0]);
});

// Commands and keys.
const commands = new Commands(find("#commands"), list, () => {
  const { page, state } = view;
  const others = (name, values, label) => values.filter((one) => one !== state[name]).map((one) => ({ label: label(one), act: () => set({ [name]: one }) }));
  return [
    { label: state.filter === "all" ? "Missed only, worst first" : "All photos", key: "M", act: toggleFilter },
    { label: "Random photo", key: "R", act: () => channel.act("random") },
    { label: "Your photo", act: () => find("#file").click() },
    ...(state.own ? [{ label: "Forget your photo", act: () => channel.act("forget") }] : []),
    ...page.models.map((label, number) => ({ label: `Model: ${label}`, act: () => set({ model: String(number) }) })).filter((_, number) => String(number) !== state.model),
    ...(view.result?.photo.heat ? others("heat", HEATS, (one) => `Heat: ${one}`) : []),
    ...(state.weights.length ? [{ label: "Equal weights", act: () => set({ weights: [] }) }] : []),
    ...others("task", page.tasks, (one) => `Task: ${one}`),
    ...others("scoring", page.scorings, (one) => `Ranking: ${one}`),
    ...others("place", Object.keys(page.places), (one) => `Place: ${page.places[one]}`),
    ...(view.result?.scene.length > 1 ? [{ label: state.view === "city" ? "Rings apart" : view.page.place, key: "X", act: () => KEYS.x() }] : []),
    ...page.panels.map((one) => ({ label: one.title, key: one.key.toUpperCase(), act: () => openPanel(one.name) })),
    { label: state.theme === "dark" ? "Light" : "Dark", key: "D", act: flipTheme },
    { label: "Former page: laboratory, map, flight, stories", href: `classic/?${classicAddress()}` },
  ];
}, (text) => set({ find: text.slice(0, 200) }));

/** The former page's address of the same photo. */
const classicAddress = () => {
  const { state } = view;
  return new URLSearchParams({ show: state.place, task: state.task, query: state.query_name, angle: String(state.angle), screen: "all" });
};

const openPanel = (name) => set({ panel: view.state.panel === name ? "" : name });
const panels = new Panels(find("#panel"), { set, act: channel.act, say, view });

const toggleFilter = () => set({ filter: view.state.filter === "all" ? "missed" : "all" });
const escape = () => {
  if (view.state.panel) panels.close();
  else if (document.body.classList.contains("large")) enlarge(false);
  else if (view.said && view.result) say("");
  else if (view.result?.pinned) set({ compare: null });
  else if (view.state.filter !== "all") set({ filter: "all" });
};
const enlarge = (large = !document.body.classList.contains("large")) => {
  document.body.classList.toggle("large", large);
  const button = find("#scene .enlarge");
  button.textContent = large ? "✕" : "⤢";
  button.title = large ? "Close (Esc)" : "Enlarge (G)";
  button.setAttribute("aria-label", large ? "Close" : "Enlarge");
  scene.resized();
};
const HEATS = ["activation", "evidence", "occlusion"];
const KEYS = {
  x: () => set({ view: view.state.view === "city" ? "apart" : "city" }), g: () => enlarge(),
  n: () => step(1), arrowdown: () => step(1), p: () => step(-1), arrowup: () => step(-1),
  r: () => channel.act("random"), m: toggleFilter, d: flipTheme, escape,
  j: () => turnTo(view.angle + STEP), arrowleft: () => turnTo(view.angle + STEP),
  l: () => turnTo(view.angle - STEP), arrowright: () => turnTo(view.angle - STEP), 0: () => turnTo(0),
  e: () => view.result?.photo.heat && set({ heat: HEATS[(HEATS.indexOf(view.state.heat) + 1) % HEATS.length] }),
  "/": () => commands.open(), t: () => show({ truth: true }), f: () => show({ colour: true }),
};
export const press = (event) => {
  const name = event.key.toLowerCase();
  if ((event.ctrlKey || event.metaKey) && name === "k") {
    event.preventDefault();
    commands.open();
  }
  if (event.ctrlKey || event.metaKey || event.altKey || find("#commands").open || !view.state) return;
  const typing = /** @type {any} */ (event.target)?.closest?.("input, textarea, select, [contenteditable]");
  if (typing && name !== "escape") return;
  const part = Number(name) - 1;
  const panel = view.page?.panels.find((one) => one.key === name);
  if (name.length === 1 && part >= 0 && part < (view.page?.parts ?? 0)) focusOn(view.focus === part ? -1 : part);
  else if (panel && !event.repeat) openPanel(panel.name);
  else if (KEYS[name] && !(event.repeat && "tf".includes(name))) {
    event.preventDefault();
    KEYS[name]();
  }
};
addEventListener("keydown", press);
addEventListener("keyup", (event) => {
  if (event.key.toLowerCase() === "t") show({ truth: false });
  if (event.key.toLowerCase() === "f") show({ colour: false });
});

const scene = new SceneFrame(find("#scene"), channel, press, (found, why) => {
  if (why === "hover") {
    if (found.part !== undefined || view.focus >= 0) focusOn(found.part ?? -1);
  } else if (found.tile !== undefined) compare(found.tile);
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
