// The map of a flight: its tiles and their movement by Leaflet; tracks, frames, and the chosen photo's marks on a canvas over them.

import { find, make, prepare } from "../../page/dom.js";

const LEAFLET = "../../vendor/leaflet.js"; // which has no types
await import(LEAFLET);
const L = /** @type {any} */ (globalThis).L;
// Pixels within which the pointer is at a photo's mark, metres around the map within which a photo counts as near.
const REACH = 12;
const AROUND = 500;
const TILE = 256;
const RETRIES = 3;
const RETRY = 2000; // ms

const range = (values) => [Math.min(...values), Math.max(...values)];
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// A line, a dot, a diamond, and words that can be seen on any ground.
const stroke = (pen, colour, width, dash = []) => {
  pen.setLineDash([]);
  pen.lineWidth = width + 2;
  pen.strokeStyle = "rgba(0,0,0,.55)";
  pen.stroke();
  pen.setLineDash(dash);
  pen.lineWidth = width;
  pen.strokeStyle = colour;
  pen.stroke();
  pen.setLineDash([]);
};
export const dot = (pen, /** @type {any} */ [left, top], radius, colour, hollow = false) => {
  pen.beginPath();
  pen.arc(left, top, radius, 0, 7);
  pen.fillStyle = hollow ? "rgba(0,0,0,.35)" : colour;
  pen.fill();
  pen.lineWidth = hollow ? 2 : 1;
  pen.strokeStyle = hollow ? colour : "rgba(0,0,0,.75)";
  pen.stroke();
};
export const diamond = (pen, /** @type {any} */ [left, top], radius, colour) => {
  pen.beginPath();
  for (const [right, down] of [[0, -1], [1, 0], [0, 1], [-1, 0]]) pen.lineTo(left + radius * right, top + radius * down);
  pen.closePath();
  pen.fillStyle = colour;
  pen.fill();
  pen.lineWidth = 1;
  pen.strokeStyle = "rgba(0,0,0,.75)";
  pen.stroke();
};
const write = (pen, words, left, top) => {
  pen.font = "12px Inter, system-ui, sans-serif";
  pen.textBaseline = "middle";
  pen.lineWidth = 3;
  pen.strokeStyle = "rgba(0,0,0,.75)";
  pen.strokeText(words, left, top);
  pen.fillStyle = "#fff";
  pen.fillText(words, left, top);
};

/** Write a text beside a mark, within its parent; an empty one hides it. */
export const tell = (tip, text, /** @type {any} */ [left, top], reach = REACH) => {
  tip.textContent = text;
  tip.hidden = !text;
  if (!text) return;
  const { clientWidth, clientHeight } = tip.parentElement;
  tip.style.left = `${clamp(left - tip.offsetWidth / 2, 0, Math.max(clientWidth - tip.offsetWidth, 0))}px`;
  const above = top - reach - tip.offsetHeight;
  tip.style.top = `${clamp(above < 0 ? top + reach : above, 0, Math.max(clientHeight - tip.offsetHeight, 0))}px`;
};

export class FlightMap {
  /**
   * @param {any} box the map's element
   * @param {any} flight what all parts of the panel share, see flight.js
   * @param {{choose: (frame: number) => void, spot: (at: number[]) => void, moved: () => void, drawn: () => void}} on
   */
  constructor(box, flight, on) {
    this.box = box;
    this.flight = flight;
    this.on = on;
    this.map = null;
    this.key = "";
    this.bounds = [0, 0, 0, 0];
    this.scale = 1;
    this.base = null;
    this.heat = null;
    this.asking = false; // the next click on the map asks which photos show the spot
    this.moved = false; // a person has moved the map since it was fitted
    this.fitting = false;
    this.seen = ""; // the frame of a flight that goes on which was last looked for
    new ResizeObserver(() => {
      this.map?.invalidateSize({ animate: false });
      if (this.map && !this.moved) this.fit();
      this.draw();
    }).observe(box);
    box.addEventListener("pointermove", (event) => this.map && this.point(this.at(event)));
    box.addEventListener("pointerleave", () => {
      find(".read", box).textContent = "";
      tell(find(".why", box), "", [0, 0]);
    });
  }

  at(event) {
    const { left, top } = this.box.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  /** Lay the tiles of a flight's map; the same map stays as it is. */
  show(data) {
    const key = JSON.stringify([data.bounds, data.addresses.tiles]);
    if (key === this.key) return;
    const same = this.map && String(data.bounds) === String(this.bounds);
    [this.key, this.bounds] = [key, data.bounds];
    const { west, north, side } = data.pyramid;
    const scale = TILE / side;
    const [left, south, right, top] = data.bounds;
    if (!same) {
      this.map?.remove();
      const crs = L.extend({}, L.CRS.Simple, { transformation: new L.Transformation(scale, -scale * west, -scale, scale * north) });
      const zooms = { minZoom: Math.log2(20 / TILE), maxZoom: Math.log2(8 / (data.resolution * scale)) };
      // Without animation: the photo and the marks follow each step.
      const still = { zoomAnimation: false, fadeAnimation: false, inertia: false, boxZoom: false };
      this.map = L.map(find(".tiles", this.box), { crs, ...zooms, ...still, zoomSnap: 0, zoomDelta: 0.6, wheelPxPerZoomLevel: 110, attributionControl: false });
      this.map.zoomControl.setPosition("topright");
      L.control.scale({ imperial: false, maxWidth: 130 }).addTo(this.map);
      this.scale = scale;
      this.moved = false;
      this.map.on("move zoom viewreset", () => this.draw());
      this.map.on("moveend", () => {
        if (this.fitting || !this.map) return;
        this.moved = true;
        this.on.moved();
      });
      this.map.on("click", (event) => this.click([event.containerPoint.x, event.containerPoint.y], event.originalEvent));
    }
    this.base?.remove();
    const levels = data.addresses.tiles;
    const Tiles = L.TileLayer.extend({ getTileUrl: ({ x, y, z }) => `${levels[z]}${y * 2 ** z + x}` });
    this.base = new Tiles("", { noWrap: true, bounds: [[south, left], [top, right]], minNativeZoom: 0, maxNativeZoom: levels.length - 1, minZoom: -9, maxZoom: 40, tileSize: TILE, keepBuffer: 1 });
    this.base.on("loading", () => (this.box.dataset.loaded = "false"));
    this.base.on("load", () => (this.box.dataset.loaded = "true"));
    // The server may be busy.
    this.base.on("tileerror", ({ tile }) => {
      tile.failures = (tile.failures ?? 0) + 1;
      const source = tile.src;
      if (tile.failures <= RETRIES) setTimeout(() => (tile.src = source), RETRY * tile.failures);
    });
    if (!same) {
      const { view } = this.flight;
      if (view?.length === 3) this.look(view);
      else this.fit();
    }
    this.base.addTo(this.map);
  }

  /** Paint scores over the map; null for none. */
  paint(scores) {
    this.heat?.remove();
    this.heat = null;
    if (!scores || !this.map) return;
    const [west, south, east, north] = scores.bounds;
    this.heat = L.imageOverlay(scores.picture, [[south, west], [north, east]], { opacity: 0.6, className: "scores-laid" }).addTo(this.map);
  }

  // The view.

  /** From metres to pixels: left = x + scale * east, top = y - scale * north. */
  get affine() {
    const map = this.map;
    const { x, y } = map.project([0, 0]).subtract(map.getPixelOrigin()).add(map.layerPointToContainerPoint([0, 0]));
    return { x, y, scale: this.scale * 2 ** map.getZoom() };
  }
  /** @param {any} point @returns {[number, number]} */
  toPixels(point, { x, y, scale } = this.affine) {
    const [east, north] = point;
    return [x + scale * east, y - scale * north];
  }
  /** @param {any} pixels @returns {[number, number]} */
  toMetres([left, top]) {
    const { x, y, scale } = this.affine;
    return [(left - x) / scale, (y - top) / scale];
  }
  get size() {
    return [this.box.clientWidth, this.box.clientHeight];
  }
  /** The middle, and the metres from side to side. */
  get view() {
    const { lat, lng } = this.map.getCenter();
    return [lng, lat, this.box.clientWidth / this.affine.scale].map((value) => Math.round(10 * value) / 10);
  }
  /** @param {any} view */
  look([x, y, across]) {
    const [west, south, east, north] = this.bounds;
    this.set([clamp(x, west - AROUND, east + AROUND), clamp(y, south - AROUND, north + AROUND)], this.box.clientWidth / across);
    this.moved = true;
  }
  /** @param {any} middle */
  set([x, y], scale) {
    this.fitting = true;
    this.map.setView([y, x], Math.log2(scale / this.scale), { animate: false });
    this.fitting = false;
    this.draw();
  }
  /** Show some points, so that they fill a share of the map. */
  frame(points, share, least = 10) {
    const [[west, east], [south, north]] = [0, 1].map((axis) => range(points.map((at) => at[axis])));
    const [width, height] = this.size;
    this.set([(west + east) / 2, (south + north) / 2], share * Math.min(width / Math.max(east - west, least), height / Math.max(north - south, least)));
  }
  /** Show the flight, or the whole map if nothing of it lies there. */
  fit() {
    if (!this.map || !this.box.clientWidth) return;
    this.moved = false;
    const { own } = this.flight;
    const shown = own ? this.near([...(own.outline ?? []).slice(0, 4), own.place, own.tag]) : [...this.placed(), ...this.newest()];
    const [west, south, east, north] = this.bounds;
    if (shown.length > 1) this.frame(shown, 0.72, 40);
    else this.frame([[west, south], [east, north]], 0.9);
  }
  near(points) {
    const [west, south, east, north] = this.bounds;
    return points.filter((at) => at && at[0] > west - AROUND && at[0] < east + AROUND && at[1] > south - AROUND && at[1] < north + AROUND);
  }
  placed() {
    const { data } = this.flight;
    return this.near(Object.entries(data.tracks).flatMap(([name, track]) => (name === "retrieval" ? [] : data.names.map((_, i) => (track.state[i] < 2 ? place(track, i) : null)))));
  }
  /** The corners of the newest photo of a flight that goes on. */
  newest() {
    const { data, chosen } = this.flight;
    return (data.live && data.outlines[chosen]?.slice(0, 4)) || [];
  }
  sees(points, beyond = 0) {
    const [width, height] = this.size;
    return points.map((at) => this.toPixels(at)).every(([left, top]) => left > -beyond * width && left < (1 + beyond) * width && top > -beyond * height && top < (1 + beyond) * height);
  }
  /** Look at a photo's corners, unless they are in sight and fill nearly half of it. */
  approach(points) {
    const [across, up] = [0, 1].map((axis) => range(points.map((at) => at[axis])));
    const [width, height] = this.size;
    const large = Math.max((across[1] - across[0]) / width, (up[1] - up[0]) / height) * this.affine.scale;
    if (this.sees(points, 0.2) && large > 0.45) return;
    this.frame(points, 0.85);
    this.moved = true;
  }
  include(points) {
    if (this.sees(points)) return;
    this.frame(points, 0.8);
    this.moved = true;
  }

  // Drawing.

  draw() {
    const { data } = this.flight;
    if (!this.map || !data || !this.box.clientWidth) return;
    const followed = `${data.names.length} ${this.flight.chosen}`;
    if (data.live && !this.moved && followed !== this.seen) {
      this.seen = followed;
      if (!this.sees(this.newest())) return this.fit();
    }
    const { pen } = prepare(find(".over", this.box));
    const at = this.affine;
    const path = (points, close = false) => {
      pen.beginPath();
      points.forEach((point, i) => pen[i ? "lineTo" : "moveTo"](...this.toPixels(point, at)));
      if (close) pen.closePath();
    };
    if (!this.flight.own && !this.flight.compares && this.flight.over !== "correct") this.drawTracks(pen, at);
    if (this.flight.spotted) this.drawSpot(pen, path);
    if (this.flight.photo) this.drawChosen(pen, path, at);
    for (const sheet of data.sheets) {
      path(sheet.outline, true);
      stroke(pen, sheet.colour, 2);
      const [left, top] = this.toPixels(sheet.outline.reduce((best, p) => (p[1] - p[0] > best[1] - best[0] ? p : best)), at);
      write(pen, sheet.name, clamp(left + 8, 8, this.size[0] - 60), clamp(top + 14, 14, this.size[1] - 40));
    }
    this.on.drawn();
  }

  drawTracks(pen, at) {
    const { data, shown, doubted } = this.flight;
    for (const [name, track] of shown()) {
      const colour = data.colours[name];
      // A line joins neighbours that were not refused; nothing has verified the retrieval, so it has no line.
      if (name !== "retrieval") {
        pen.beginPath();
        let down = false;
        data.names.forEach((_, i) => {
          const point = place(track, i);
          if (track.state[i] === 2) return;
          if (point) pen[down ? "lineTo" : "moveTo"](...this.toPixels(point, at));
          down = Boolean(point);
        });
        pen.globalAlpha = name === "tag" ? 0.75 : 1;
        stroke(pen, colour, name === "tag" ? 1 : 2, name === "tag" ? [5, 4] : []);
        pen.globalAlpha = 1;
      }
      data.names.forEach((_, i) => {
        const point = place(track, i);
        if (!point) return;
        if (doubted(name, i)) diamond(pen, this.toPixels(point, at), 6, data.colours.contradicted);
        else dot(pen, this.toPixels(point, at), name === "tag" ? 2 : 4, colour, track.state[i] === 2);
      });
    }
  }

  drawSpot(pen, path) {
    const { data, spotted } = this.flight;
    for (const i of spotted.frames) {
      path(data.outlines[i].slice(0, 4), true);
      pen.fillStyle = "rgba(255,255,255,.05)";
      pen.fill();
      pen.lineWidth = 1;
      pen.strokeStyle = "rgba(255,255,255,.6)";
      pen.stroke();
    }
    const [left, top] = this.toPixels(spotted.spot);
    pen.beginPath();
    for (const [right, down] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(left + 4 * right, top + 4 * down);
      pen.lineTo(left + 13 * right, top + 13 * down);
    }
    stroke(pen, "#fff", 2);
  }

  /** Outline, answer, details, and places of the chosen photo, which may be a person's own. */
  drawChosen(pen, path, at) {
    const { data, photo, own, answered, shown, doubted, chosen } = this.flight;
    const { colours } = data;
    const outline = own ? own.outline : data.outlines[chosen];
    if (outline) {
      const colour = colours[own ? photo.card.state : data.states[chosen]];
      path(outline.slice(0, 4), true);
      stroke(pen, colour, 2, outline[4] ? [] : [7, 5]);
      path(outline.slice(0, 2)); // the picture's top edge is thicker
      stroke(pen, colour, 4);
    }
    if (answered && (!own || own.place)) {
      const [x, y, half] = [answered[0], answered[1], answered[2] / 2];
      path([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]], true);
      stroke(pen, colours.retrieval, 1.5, [2, 3]);
    }
    for (const [i, [x, y, east, north]] of (this.flight.compares ? photo.pins : []).entries()) {
      path([[x, y], [x + east, y + north]]);
      stroke(pen, colours.accent, 2);
      const [left, top] = this.toPixels([x + east, y + north], at);
      dot(pen, [left, top], 3, colours.accent);
      write(pen, String(i + 1), left + 6, top - 6);
    }
    const mark = (point, radius, colour, size, hollow, doubt) => {
      const pixels = this.toPixels(point, at);
      if (radius) {
        pen.beginPath();
        pen.arc(...pixels, Math.max(radius * at.scale, 1), 0, 7);
        stroke(pen, doubt ? colours.contradicted : colour, 1.5, hollow ? [3, 4] : []);
      }
      if (doubt) diamond(pen, pixels, 9, colours.contradicted);
      else dot(pen, pixels, size, colour, hollow);
    };
    if (own) {
      if (own.place && own.tag) {
        path([own.place, own.tag]);
        stroke(pen, colours.tag, 1.5, [5, 4]);
      }
      if (own.place) mark(own.place, own.radius, colours.registration, 7, false, photo.card.sign === null);
      if (own.tag) mark(own.tag, 0, colours.tag, 5, false, false);
      return;
    }
    // The answer that counts is there, too, where its track is switched off.
    const counts = data.stages[chosen];
    const tracks = new Map([...shown(), ...(counts ? [[counts, data.tracks[counts]]] : [])]);
    for (const [name, track] of tracks) {
      const point = place(track, chosen);
      if (point) mark(point, track.radius[chosen], colours[name], name === "tag" ? 5 : 7, track.state[chosen] === 2, doubted(name, chosen));
    }
  }

  // The pointer.

  /** The frame of the nearest dot, and its track; -1 where none is near. */
  hit(at) {
    let [best, frame, found] = [REACH, -1, null];
    for (const [, track] of this.flight.shown())
      this.flight.data.names.forEach((_, i) => {
        const point = place(track, i);
        if (!point) return;
        const [left, top] = this.toPixels(point);
        const far = Math.hypot(left - at[0], top - at[1]);
        if (far < best) [best, frame, found] = [far, i, track];
      });
    return { frame, track: found };
  }
  point(at) {
    const { data, own } = this.flight;
    if (!data) return;
    const { frame, track } = own ? { frame: -1, track: null } : this.hit(at);
    const reason = track?.reason[frame];
    tell(find(".why", this.box), reason ? `${data.names[frame]}. ${reason}` : "", reason ? this.toPixels(place(track, frame)) : [0, 0]);
    const metres = this.toMetres(at);
    const name = frame >= 0 ? `${data.names[frame]} · ` : "";
    find(".read", this.box).textContent = `${name}${data.degrees ? `${degrees(data, metres)} · ` : ""}${metres[0].toFixed(1)} m E, ${metres[1].toFixed(1)} m N`;
  }
  click(at, { shiftKey }) {
    if (shiftKey || this.asking) {
      this.asking = false;
      return this.on.spot(this.toMetres(at).map((value) => Math.round(100 * value) / 100));
    }
    const { frame } = this.flight.own ? { frame: -1 } : this.hit(at);
    this.point(at);
    if (frame >= 0) this.on.choose(frame);
  }
  close() {
    this.map?.remove();
    this.map = null;
  }
}

const place = (track, i) => (track.x[i] === null || track.y[i] === null ? null : [track.x[i], track.y[i]]);

const degrees = (data, /** @type {any} */ [x, y]) => {
  const [west, south, east, north] = data.bounds;
  const [u, v] = [(2 * x - west - east) / (east - west), (2 * y - south - north) / (north - south)];
  const terms = [1, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
  const [latitude, longitude] = data.degrees.map((row) => row.reduce((sum, value, i) => sum + value * terms[i], 0));
  return `${latitude.toFixed(6)}, ${(longitude - 360 * Math.round(longitude / 360)).toFixed(6)}`;
};

/** Make the elements of a map. */
export const makeMap = () =>
  make("div", { class: "view" }, make("div", { class: "tiles", tabindex: 0, role: "application", "aria-label": "Map: arrows move it, plus and minus zoom" }),
    make("div", { class: "laid" }, make("img", { alt: "" })), make("canvas", { class: "over", "aria-hidden": "true" }), make("div", { class: "plate scores", hidden: true }, make("img", { alt: "" }), make("span")),
    make("div", { class: "plate read" }), make("div", { class: "plate why", role: "status", hidden: true }),
    make("div", { class: "ties", hidden: true },
      ...["upper left", "upper right", "lower right", "lower left"].map((name, i) => make("button", { "data-tie": i, title: `Tie point, ${name}: drag it, or move it with arrows`, "aria-label": `Tie point, ${name}` })),
      make("button", { "data-tie": "all", title: "The whole photo: drag it, or move it with arrows", "aria-label": "The whole photo", text: "✥" })),
    make("div", { class: "edge", "aria-hidden": "true", hidden: true }, make("span", { text: "map" }), make("span", { text: "photo" })),
    make("input", { class: "swipe", type: "range", min: 0, max: 100, value: 50, hidden: true, "aria-label": "Swipe: left of it the map, right of it the photo" }));
