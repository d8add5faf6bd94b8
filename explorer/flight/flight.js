// The flight panel: the map with tracks and timeline, the chosen photo's card with its rings, and lists of photos.

import { find, findAll, make, makeSvg } from "../../page/dom.js";
import { photoTurn, showPicture } from "../../page/pictures.js";
import { showSums } from "../../page/rows.js";
import { term } from "../../page/terms.js";
import { FlightMap, makeMap } from "./map.js";
import { LaidPhoto } from "./photo.js";
import { Timeline } from "./timeline.js";

const ASK = 150; // ms between two photos that a drag over the timeline asks for
const PICTURES = 5000; // ms after which a photo is shown without its pictures
const TICK = 50; // ms
const OVER = { off: "Map alone", swipe: "Swipe", blink: "Blink", correct: "Correct" };
const PLOTS = { error: "Off tag", radius: "Radius", height: "Height" };
const MARKS = { true: "✓", null: "?", false: "✗" };
const INK = { right: "right", contradicted: "wrong", unknown: "soft" };

const ringed = () =>
  make("figure", {}, make("div", { class: "frame" }, make("div", { class: "pan" }, make("div", { class: "picture", role: "img" }), make("canvas", { class: "heat", "aria-hidden": "true" }), makeSvg("svg", { "aria-hidden": "true" }))), make("figcaption"));
const chips = (name, words, label) => make("span", { class: "chips", role: "group", "aria-label": label }, ...Object.entries(words).map(([value, text]) => make("button", { class: "chip", [`data-${name}`]: value, "aria-pressed": "false", text })));
const picture = (label, source) =>
  make("figure", {}, source ? make("img", { src: source, alt: label }) : make("i", { class: "none", text: "?" }), make("figcaption", { text: label }));

/** @param {any} box @param {{set: (values: any) => void, act: (name: string, args?: any) => void, say: (text: string) => void, view: any}} context */
export const open = (box, context) => {
  const root = make("div", { class: `flight waiting${context.view.page?.live ? " live" : ""}` },
    make("div", { class: "left" },
      make("div", { class: "bar" }, chips("over", OVER, "Photo over the map"),
        make("label", { class: "field paint" }, "Scores", make("select", { "aria-label": "Scores painted over the map" })),
        make("button", { class: "chip", "data-act": "spot", "aria-pressed": "false", title: "Then click on the map, or Shift and click", text: "Who saw?" }),
        make("button", { class: "chip", "data-act": "fit", title: "The whole flight", text: "Fit" }),
        make("span", { class: "save" }, "Positions ", ...[".csv", ".geojson"].map((suffix) => make("button", { class: "chip", "data-save": suffix, text: suffix.slice(1).toUpperCase().replace("GEOJSON", "GeoJSON"), title: "One position a photo, of the stage that counts" })))),
      make("div", { class: "how", hidden: true }, make("p", { text: "Drag the corners, or the middle, until the photo lies on the map. " }, make("b", { hidden: true, text: "Not saved yet; this browser keeps the corners." })),
        ...[["save", "Save"], ["cancel", "Cancel"], ["forget", "Forget the saved place"]].map(([act, text]) => make("button", { class: act === "save" ? "button main" : "button", "data-act": act, text }))),
      makeMap(),
      make("div", { class: "time" },
        make("div", { class: "bar" },
          ...[["back", "‹", "Previous photo (P)"], ["play", "▶", "Play or pause (Space)"], ["next", "›", "Next photo (N)"]].map(([act, text, title]) => make("button", { class: "chip", "data-act": act, title, "aria-label": title, text })),
          make("select", { class: "field", "aria-label": "Photos a second" }, ...[0.5, 1, 2, 5].map((value) => make("option", { value, text: `${value} per s`, selected: value === 1 }))),
          chips("plot", PLOTS, "Plot"), make("span", { class: "status soft", role: "status" }), make("span", { class: "now soft" })),
        make("div", { class: "line" }, make("canvas", { tabindex: 0, role: "slider", "aria-label": "Photo", "aria-valuemin": 1 }), make("div", { class: "plate why", hidden: true })))),
    make("div", { class: "right-side", tabindex: 0, role: "region", "aria-label": "The photo, and the flight" },
      make("div", { class: "about", "aria-live": "polite" }, make("p", { class: "soft", text: "Opening the flight" })),
      make("div", { class: "sums" }), make("div", { class: "lines" }), make("div", { class: "legend" }),
      make("div", { class: "tabs", role: "group", "aria-label": "Lists" }), make("div", { class: "listed" }), make("div", { class: "accuracy" })));
  box.replaceChildren(root);
  if (context.view.page?.live) find(".swipe", root).value = 0; // all of the photo is laid
  const figures = { photo: ringed(), tile: ringed() };
  const select = find(".paint select", root);
  const speed = find(".time select", root);

  let wanted = null; // the photo that was asked for and has not come yet
  let asked = 0;
  let [newest, arrived] = [0, 0]; // numbers of the server's messages about a photo
  let playing = 0;
  let due = 0;
  let drawn = [];
  const state = () => context.view.state;

  // What all parts of the panel share.
  const flight = {
    data: null,
    photo: null, // the photo that is shown, with its card
    answered: null, // the middle and the side of the window that retrieval answers, in metres
    spotted: null, // a spot of the map, and the photos that show it
    span: { times: [], low: 0, high: 0 },
    get chosen() {
      return flight.photo?.frame ?? -1;
    },
    get own() {
      return flight.photo?.own ? { ...flight.photo.own, key: flight.photo.card.name } : null;
    },
    get over() {
      return state().flight_over;
    },
    get plot() {
      return state().flight_plot;
    },
    get view() {
      return state().flight_view;
    },
    /** The photo is compared with the map below it, which marks of other photos would hide. */
    get compares() {
      return ["swipe", "blink"].includes(flight.over) && !flight.data.live && Boolean(flight.photo?.homography);
    },
    /** The tracks that are switched on, with their names. */
    shown: () => Object.entries(flight.data.tracks).filter(([name]) => on().includes(name)),
    /** An answer counts, and another answer or the map contradicts it. */
    doubted: (name, i) => name === "registration" && flight.data.stages[i] === name && flight.data.signs[i] === null,
    step: (by) => choose((wanted ?? flight.chosen) + by),
  };
  const on = () => {
    const chosen = state().flight_tracks;
    return chosen ? chosen.split(".") : Object.keys(flight.data.tracks).filter((name) => ["tag", "corrected", flight.data.main].includes(name));
  };

  const map = new FlightMap(find(".view", root), flight, {
    choose: (frame) => choose(frame),
    spot: (at) => context.set({ flight_spot: at, flight_list: "spot" }),
    moved: () => context.set({ flight_view: map.view }),
    drawn: () => photo.lay(),
  });
  const photo = new LaidPhoto(root, flight, map, { use: (mode) => context.set({ flight_over: mode }), act: context.act, say: context.say });
  const timeline = new Timeline(find(".line canvas", root), find(".line .why", root), flight, (frame) => choose(frame));

  // A drag over the timeline asks for few of the photos on its way.
  const choose = (frame) => {
    const total = flight.data?.names.length ?? 0;
    frame = Math.min(Math.max(frame, 0), total - 1);
    if (!total || frame === (wanted ?? flight.chosen)) return;
    wanted = frame;
    if (!asked) ask();
    tellNow();
  };
  const ask = () => {
    const frame = wanted;
    context.set({ query: frame, ...(state().own ? { own: "" } : {}) });
    asked = setTimeout(() => {
      asked = 0;
      if (wanted !== null && wanted !== frame) ask();
    }, ASK);
  };
  const play = (start = !playing) => {
    clearInterval(playing);
    playing = 0;
    if (start && flight.data) {
      if (flight.chosen >= flight.data.names.length - 1) choose(0);
      due = performance.now() + 1000 / speed.value;
      // The next photo is the next one, however long the last one took.
      playing = setInterval(() => {
        if (performance.now() < due || wanted !== null) return;
        if (flight.chosen >= flight.data.names.length - 1) return play(false);
        due = performance.now() + 1000 / speed.value;
        flight.step(1);
      }, TICK);
    }
    const button = find("[data-act=play]", root);
    button.textContent = playing ? "❚❚" : "▶";
  };
  const tellNow = () => {
    const { data, chosen } = flight;
    if (!data) return;
    const since = data.times && chosen >= 0 ? data.times[chosen] - data.times[0] : null;
    const clock = since === null ? "" : `, ${Math.floor(since / 60)}:${String(Math.floor(since % 60)).padStart(2, "0")}`;
    const comes = wanted === null ? "" : `, ${data.names[wanted]} is coming`;
    find(".status", root).textContent = progress || data.counts;
    find(".now", root).textContent = (chosen < 0 ? "your own photo" : `${chosen + 1} of ${data.names.length}${clock}`) + comes;
  };

  // Messages of the server.
  const loaded = (source) => {
    const image = new Image();
    image.src = source;
    return image.decode().catch(() => {});
  };
  const receive = {
    flight: (data) => {
      const times = data.times ?? data.names.map((_, i) => i);
      flight.span = { times, low: Math.min(...times), high: Math.max(...times) };
      flight.data = data;
      select.replaceChildren(...[["off", "none"], ["all", data.parts.length > 1 ? "all parts" : "shown"], ...(data.parts.length > 1 ? data.parts.map((name, i) => [String(i), name]) : [])].map(([value, text]) => make("option", { value, text })));
      root.classList.remove("waiting");
      map.show(data);
      map.paint(scores);
      redraw();
    },
    photo: async (told) => {
      // Shown when its pictures are there, so that no words stand beside the pictures of another photo.
      const number = ++newest;
      const sources = [told.square, told.ground, flight.over !== "off" && told.homography ? told.photo : ""].filter(Boolean);
      await Promise.race([new Promise((done) => setTimeout(done, PICTURES)), Promise.all(sources.map(loaded))]);
      if (number < arrived) return;
      arrived = number;
      const before = flight.photo;
      flight.photo = told;
      if (wanted === flight.chosen || !wanted) wanted = null;
      if (Boolean(before?.own) !== Boolean(told.own) && flight.data) map.fit();
      photo.arrived();
      root.dataset.frame = String(told.frame);
      redraw();
    },
    answer: (window) => {
      flight.answered = window;
      map.draw();
    },
    scores: (painted) => {
      scores = painted;
      map.paint(painted);
      const plate = find(".plate.scores", root);
      plate.hidden = !painted;
      if (painted) {
        find("img", plate).src = flight.data.bar;
        find("span", plate).textContent = painted.label;
      }
    },
    spot: (spot) => {
      flight.spotted = spot;
      redraw();
    },
    progress: (text) => {
      progress = text;
      tellNow();
      if (!flight.data) find(".about", root).replaceChildren(make("p", { class: "soft", text: text || "Opening the flight" }));
    },
    file: ({ address, name }) => make("a", { href: address, download: name }).click(),
  };
  let scores = null;
  let progress = ""; // of a registration that goes on

  // Drawing.
  const redraw = () => {
    if (!flight.data) return;
    drawAbout();
    drawLegend();
    drawLists();
    drawRings();
    mark();
    map.draw();
    timeline.draw();
    tellNow();
  };
  const drawAbout = () => {
    const { photo: told, data } = flight;
    if (!told) return;
    const { card } = told;
    const lines = card.lines.map((text) => make("p", { text }));
    if (card.at) lines.unshift(make("p", {}, make("span", { class: "soft", text: `${card.what}: ` }), card.at, card.link ? " " : "", card.link ? make("a", { href: card.link, target: "_blank", rel: "noopener noreferrer", text: "OpenStreetMap", title: "openstreetmap.org then sees this coordinate" }) : ""));
    if (told.own) lines.push(make("button", { class: "button", "data-act": "photos", text: "The photos of the flight" }));
    const sight = data.live ? [picture("photo", told.square)] : [figures.photo, figures.tile];
    find(".about", root).replaceChildren(
      make("div", { class: "verdict" }, make("b", { class: INK[card.state], text: `${MARKS[card.sign]} ${card.headline}` })),
      make("div", { class: "facts" }, make("b", { text: card.name }), make("span", { class: "soft", text: ` ${card.facts.join(", ")}` })),
      make("div", { class: "sight" }, ...sight, picture(told.ground ? `map by ${card.stage ?? "registration"}` : "no place", told.ground)));
    find(".lines", root).replaceChildren(...lines);
  };
  /** The rings of the photo and of the window that retrieval answers. */
  const drawRings = () => {
    const { result, page } = context.view;
    const told = flight.photo;
    const shows = result && told && (told.own ? result.state.own : !result.state.own && result.state.query === told.frame);
    find(".sums", root).hidden = !shows;
    for (const figure of Object.values(figures)) figure.classList.toggle("late", !shows);
    if (!shows) return;
    const answer = result.tiles[result.answer];
    const sign = answer.true === null ? "" : answer.true ? " ✓" : " ✗";
    showPicture(figures.photo, result.photo, -1, page.parts, photoTurn(result.photo, result.angle), `Photo ${result.photo.name}`);
    showPicture(figures.tile, answer, -1, page.parts, `rotate(${-90 * answer.quarter}deg)`, `Window ${answer.name}`);
    find("figcaption", figures.photo).textContent = "photo";
    find("figcaption", figures.tile).textContent = `retrieval${sign}`;
    showSums(find(".sums", root), result);
  };
  const drawLegend = () => {
    const { data, chosen } = flight;
    const metres = (value) => (value === null || value === undefined ? "" : value.toFixed(value < 100 ? 1 : 0));
    const rows = Object.entries(data.tracks).map(([name, track]) => {
      const known = chosen >= 0 && track.x[chosen] !== null;
      const sign = chosen < 0 || name === "tag" ? "" : track.state[chosen] === 2 ? MARKS.false : known ? MARKS[flight.doubted(name, chosen) || track.state[chosen] === 1 ? "null" : "true"] : "";
      const toggle = make("button", { role: "switch", "data-track": name, "aria-checked": String(on().includes(name)), title: track.method }, make("i", { style: { background: data.colours[name] } }), track.label);
      const of = chosen < 0 ? ["", "", ""] : [make("span", { title: track.reason[chosen] ?? "", text: sign }), metres(track.radius[chosen]), metres(track.error[chosen])];
      return make("tr", { "data-state": track.state[chosen] ?? "" }, ...[toggle, track.count || "not verified", ...of].map((cell) => make("td", {}, cell)));
    });
    const head = ["show", "accepted", "", term("radius", "± m"), term("tag", "m off tag")].map((cell) => make("th", { scope: "col" }, cell));
    const words = Object.entries(data.words).map(([name, text]) => make("span", { class: "key" }, make("i", { style: { background: data.colours[name] } }), text));
    const unfolded = Boolean(find(".legend details", root)?.open);
    find(".legend", root).replaceChildren(make("table", {}, make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...rows)),
      make("p", { class: "soft" }, "Frames: ", ...words),
      make("details", { class: "soft", open: unfolded }, make("summary", { text: "Marks on the map" }),
        make("p", { text: "Frame: the ground that the photo shows. Thick: its top. Dashed: by tag and camera alone. Hollow: refused. Diamond: in doubt." }),
        make("p", { text: `Dotted: retrieval's window. Numbers: matched details, from photo to map. ${data.circle}` })));
  };
  const drawLists = () => {
    const { data, chosen } = flight;
    const lists = { ...data.lists, spot: flight.spotted?.list ?? { title: "Spot", sentence: "Shift and click on the map: the photos that show the spot.", entries: [], total: 0 } };
    const list = state().flight_list;
    const { sentence, entries, total } = lists[list];
    find(".tabs", root).replaceChildren(...Object.entries(lists).map(([name, { title }]) => make("button", { "data-list": name, "aria-pressed": String(name === list), text: title })));
    find(".listed", root).replaceChildren(
      ...sentence.split("\n").map((text) => make("p", { class: "soft", text })),
      ...entries.map(([frame, name, lines]) => make("button", { class: "entry", "data-frame": frame, "aria-current": String(frame === chosen) }, make("b", { text: name }), ...lines.map((text) => make("span", { text: ` ${text}` })))),
      total > entries.length ? make("p", { class: "soft", text: `The first ${entries.length} of ${total}.` }) : "");
    const rows = data.accuracy.map((cells) => make("tr", {}, make("th", { scope: "row", text: cells[0] }), make("td", { text: cells[1] }), make("td", { text: cells[2] })));
    find(".accuracy", root).replaceChildren(make("h3", { text: "Accuracy" }), rows.length ? make("table", {}, make("tbody", {}, ...rows)) : "",
      make("p", { class: "soft", text: `More: lpn locate --json; against surveyed points: --positions.${data.kept ? ` Corrections are kept in ${data.kept}.` : ""}` }));
  };
  const mark = () => {
    const press = (name, value) => findAll(`[data-${name}]`, root).forEach((one) => one.setAttribute("aria-pressed", String(one.dataset[name] === value)));
    press("over", state().flight_over);
    press("plot", state().flight_plot);
    find("[data-act=spot]", root).setAttribute("aria-pressed", String(map.asking));
    find("[data-plot=height]", root).hidden = !flight.data.heights.some((height) => height !== null);
    for (const name of ["swipe", "blink"]) find(`[data-over=${name}]`, root).disabled = !flight.photo?.homography;
    find("[data-over=correct]", root).hidden = find(".save", root).hidden = Boolean(flight.own);
    select.value = state().flight_paint;
    find(".view", root).classList.toggle("asking", map.asking);
  };

  // Buttons and keys.
  const acts = {
    fit: () => map.fit(), spot: () => (map.asking = !map.asking), play: () => play(), back: () => flight.step(-1), next: () => flight.step(1),
    save: () => photo.save(), cancel: () => photo.cancel(), forget: () => photo.forget(), photos: () => context.set({ own: "" }),
  };
  root.addEventListener("click", (event) => {
    const one = event.target.closest("button");
    if (!one || !flight.data) return;
    const { act, over, plot, list, track, frame, save } = one.dataset;
    acts[act]?.();
    if (over) context.set({ flight_over: over });
    if (plot) context.set({ flight_plot: plot });
    if (list) context.set({ flight_list: list });
    if (frame) choose(Number(frame));
    if (save) context.act("positions", { suffix: save });
    if (track) {
      const left = on().includes(track) ? on().filter((name) => name !== track) : [...on(), track];
      context.set({ flight_tracks: left.filter((name) => name !== "none").join(".") || "none" });
    }
    mark();
  });
  select.addEventListener("change", () => context.set({ flight_paint: select.value }));
  root.addEventListener("keydown", (event) => {
    if (event.key !== " " || event.target.closest("button, select, input, a") || flight.own) return;
    play();
    event.preventDefault();
    event.stopPropagation();
  });

  return {
    receive: (message) => {
      for (const [kind, value] of Object.entries(message)) receive[kind]?.(value);
    },
    draw: (view) => {
      const { flight_over, flight_plot, flight_list, flight_tracks, flight_paint, theme } = view.state;
      const now = [flight_over, flight_plot, flight_list, flight_tracks, flight_paint, theme, view.result];
      if (!flight.data || now.every((one, i) => one === drawn[i])) return;
      drawn = now;
      redraw();
    },
    close: () => {
      play(false);
      clearTimeout(asked);
      map.close();
    },
  };
};
