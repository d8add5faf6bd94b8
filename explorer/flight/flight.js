// The flight panel: the verdict on a photo, the map with the photo over it, the timeline, the doubtful photos, and the accuracy.

import { find, findAll, make } from "../../page/dom.js";
import { FlightMap } from "./map.js";
import { LaidPhoto } from "./photo.js";
import { makeTimeline } from "./timeline.js";

const ASK = 150; // ms between two requests of a drag over the timeline
const PICTURES = 5000; // ms after which a photo is shown without its pictures
const INK = { right: "right", contradicted: "wrong", unknown: "soft" };
const OPENING = "Opening the flight";

const picture = (label, source) =>
  make("figure", {}, source ? make("img", { src: source, alt: label }) : make("i", { class: "none", text: "?" }), make("figcaption", { text: label }));
const said = (text) => make("p", { class: "soft", text });

/** @param {any} box @param {{set: (values: any) => void, act: (name: string, args?: any) => void, say: (text: string) => void, view: any}} context */
export const open = async (box, context) => {
  box.innerHTML = await (await fetch("screen/panels/flight/flight.html")).text();
  const root = find(".flight", box);
  root.classList.toggle("live", Boolean(context.view.page?.live));
  if (context.view.page?.live) find(".swipe", root).value = 0; // show the whole photo
  const select = find(".paint", root);

  let wanted = null; // the requested photo, until it arrives
  let asked = 0;
  let [newest, arrived] = [0, 0]; // numbers of the server's messages about a photo
  let drawn = [];
  let scores = null;
  let progress = ""; // progress of a running registration, in words
  const state = () => context.view.state;

  // The state that all parts of the panel share.
  const flight = {
    data: null,
    photo: null, // the shown photo with its card
    answered: null, // middle and side of retrieval's window, in metres
    spotted: null, // a spot of the map with the photos that show it
    get chosen() {
      return flight.photo?.frame ?? -1;
    },
    get own() {
      return flight.photo?.own ? { ...flight.photo.own, key: flight.photo.card.name } : null;
    },
    get over() {
      return state().flight_over;
    },
    get view() {
      return state().flight_view;
    },
    /** Whether the photo is compared with the map below it, which other photos' marks would hide. */
    get compares() {
      return flight.over === "swipe" && !flight.data.live && Boolean(flight.photo?.homography);
    },
    /** The visible tracks with their names. */
    shown: () => Object.entries(flight.data.tracks).filter(([name]) => on().includes(name)),
    step: (by) => choose((wanted ?? flight.chosen) + by),
  };
  const on = () => {
    const chosen = state().flight_tracks;
    return chosen ? chosen.split(".") : Object.keys(flight.data.tracks).filter((name) => ["tag", "corrected", flight.data.main].includes(name));
  };

  // A drag over the timeline requests only some of the photos on its way.
  const choose = (frame) => {
    const total = flight.data?.names.length ?? 0;
    frame = Math.min(Math.max(frame, 0), total - 1);
    if (!total || frame === (wanted ?? flight.chosen)) return;
    wanted = frame;
    if (!asked) ask();
    tell();
  };
  const ask = () => {
    const frame = wanted;
    context.set({ query: frame, ...(state().own ? { own: "" } : {}) });
    asked = setTimeout(() => {
      asked = 0;
      if (wanted !== null && wanted !== frame) ask();
    }, ASK);
  };
  const tell = () => {
    if (!flight.data) return;
    const comes = wanted === null ? "" : ` ${flight.data.names[wanted]} is coming.`;
    find(".status", root).textContent = (progress || flight.data.counts) + comes;
  };

  const map = new FlightMap(find(".view", root), flight, {
    choose,
    spot: (at) => context.set({ flight_spot: at }),
    moved: () => context.set({ flight_view: map.view }),
    drawn: () => photo.lay(),
  });
  const photo = new LaidPhoto(root, flight, map, { use: (mode) => context.set({ flight_over: mode }), act: context.act, say: context.say });
  const drawTimeline = makeTimeline(find(".line", root), flight, choose);

  // Messages of the server.
  const loaded = (source) => {
    const image = new Image();
    image.src = source;
    return image.decode().catch(() => {});
  };
  const receive = {
    flight: (data) => {
      flight.data = data;
      select.replaceChildren(...[["off", "No scores"], ["all", "Scores"], ...(data.parts.length > 1 ? data.parts.map((name, i) => [String(i), `Scores: ${name}`]) : [])].map(([value, text]) => make("option", { value, text })));
      root.classList.remove("waiting");
      map.show(data);
      map.paint(scores);
      redraw();
    },
    photo: async (told) => {
      // Wait for the pictures, so that no words stand beside another photo's pictures; show the first photo at once.
      const number = ++newest;
      const sources = [told.square, told.ground, flight.over !== "off" && told.homography ? told.photo : ""].filter(Boolean);
      if (flight.photo) await Promise.race([new Promise((done) => setTimeout(done, PICTURES)), Promise.all(sources.map(loaded))]);
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
      if (!painted) return;
      find("img", plate).src = flight.data.bar;
      find("span", plate).textContent = painted.label;
    },
    spot: (spot) => {
      flight.spotted = spot;
      redraw();
    },
    progress: (text) => {
      progress = text;
      tell();
      if (!flight.data) find(".verdict", root).replaceChildren(said(text || OPENING));
    },
  };

  // Drawing.
  const redraw = () => {
    if (!flight.data) return;
    drawPhoto();
    drawFlight();
    mark();
    map.draw();
    drawTimeline();
    tell();
  };
  const drawPhoto = () => {
    const told = flight.photo;
    if (!told) return;
    const { card } = told;
    find(".verdict", root).replaceChildren(make("h3", { class: INK[card.state], text: `${card.mark} ${card.headline}` }), make("p", { class: "soft" }, make("b", { text: card.name }), ` ${card.facts.join(", ")}`));
    find(".sight", root).replaceChildren(picture("photo", told.square), picture(told.ground ? `map, by ${card.stage ?? "registration"}` : "no place", told.ground));
    const lines = card.lines.map((text) => make("p", { text }));
    if (card.at) lines.unshift(make("p", {}, make("span", { class: "soft", text: `${card.what}: ` }), card.at, card.link ? " " : "", card.link ? make("a", { href: card.link, target: "_blank", rel: "noopener noreferrer", text: "OpenStreetMap", title: "openstreetmap.org then sees this coordinate" }) : ""));
    if (told.own) lines.push(make("button", { class: "button", "data-act": "photos", text: "The photos of the flight" }));
    find(".lines", root).replaceChildren(...lines);
  };
  const drawFlight = () => {
    const { data, chosen, spotted } = flight;
    find(".tracks", root).replaceChildren(...Object.entries(data.tracks).map(([name, track]) =>
      make("button", { class: "chip", role: "switch", "data-track": name, "aria-checked": String(on().includes(name)), title: track.method }, make("i", { style: { background: data.colours[name] } }), track.label)));
    find(".off", root).textContent = data.errors.some((error) => error !== null) ? data.off : "1-sigma radius";
    find(".accuracy", root).replaceChildren(make("table", {}, make("tbody", {}, ...data.accuracy.map(([name, figure, source]) => make("tr", {}, make("th", { scope: "row", text: name }), make("td", { text: figure }), make("td", { class: "soft", text: source }))))));
    const entries = spotted ? spotted.frames.map((i) => [i, data.states[i], ""]) : data.doubtful;
    find(".list-title", root).textContent = spotted ? "Photos that show the spot" : "Not placed, or in doubt";
    find(".listed", root).replaceChildren(
      ...(spotted ? [said(spotted.sentence), make("button", { class: "chip", "data-act": "unspot", text: "Clear the spot" })] : entries.length ? [] : [said("Every photo is placed.")]),
      ...entries.map(([frame, of, reason]) => make("button", { class: "entry", "data-frame": frame, "aria-current": String(frame === chosen), title: reason }, make("b", { class: INK[of], text: `${data.marks[frame]} ${data.names[frame]}` }), ` ${reason}`)));
    find(".notes div", root).replaceChildren(...data.notes.map(said), ...(data.kept ? [said(`Corrections are kept in ${data.kept}.`)] : []));
    find(".notes", root).hidden = !data.notes.length && !data.kept;
  };
  const mark = () => {
    findAll("[data-over]", root).forEach((one) => one.setAttribute("aria-pressed", String(one.dataset.over === flight.over)));
    find("[data-act=spot]", root).setAttribute("aria-pressed", String(map.asking));
    find("[data-over=swipe]", root).disabled = !flight.photo?.homography;
    find("[data-over=correct]", root).hidden = find(".save", root).hidden = Boolean(flight.own);
    select.value = state().flight_paint;
    find(".view", root).classList.toggle("asking", map.asking);
  };

  // Buttons.
  const acts = {
    fit: () => map.fit(), spot: () => (map.asking = !map.asking), unspot: () => context.set({ flight_spot: [] }),
    save: () => photo.save(), cancel: () => photo.cancel(), forget: () => photo.forget(), photos: () => context.set({ own: "" }),
  };
  root.addEventListener("click", (event) => {
    const one = event.target.closest("button");
    if (!one || !flight.data) return;
    const { act, over, track, frame, save } = one.dataset;
    acts[act]?.();
    if (over) context.set({ flight_over: over });
    if (frame) choose(Number(frame));
    if (save) context.act("positions", { suffix: save });
    if (track) {
      const left = on().includes(track) ? on().filter((name) => name !== track) : [...on(), track];
      context.set({ flight_tracks: left.filter((name) => name !== "none").join(".") || "none" });
    }
    mark();
  });
  select.addEventListener("change", () => context.set({ flight_paint: select.value }));

  return {
    receive: (message) => {
      for (const [kind, value] of Object.entries(message)) receive[kind]?.(value);
    },
    draw: (view) => {
      const { flight_over, flight_tracks, flight_paint, theme } = view.state;
      const now = [flight_over, flight_tracks, flight_paint, theme];
      if (!flight.data || now.every((one, i) => one === drawn[i])) return;
      drawn = now;
      redraw();
    },
    close: () => {
      clearTimeout(asked);
      map.close();
    },
  };
};
