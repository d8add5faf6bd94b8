// The map of a flight by Leaflet: its tiles, the tracks, and the chosen photo's marks. Metres east and north are x and y.

import { find, make } from "../../page/dom.js";

const LEAFLET = "../../vendor/leaflet.js"; // it has no types; its style sheet, in flight.css, must follow the page's own
await import(LEAFLET);
const L = /** @type {any} */ (globalThis).L;
const AROUND = 500; // metres around the map within which a photo counts as near
const TILE = 256;
const RETRIES = 3;
const RETRY = 2000; // ms
const DARK = { color: "#000", opacity: 0.55, interactive: false };

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const place = (track, i) => (track.x[i] === null || track.y[i] === null ? null : [track.x[i], track.y[i]]);
const at = ([x, y]) => [y, x];
const said = (text) => () => make("span", { text }); // Leaflet would parse a string as HTML

export class FlightMap {
  /**
   * @param {any} box the map's element
   * @param {any} flight the state that all parts of the panel share, see flight.js
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
    this.base = this.heat = this.marks = this.shown = null;
    this.asking = false; // whether the next click on the map requests the photos of a spot
    this.moved = false; // whether the user has moved the map since it was fitted
    this.fitting = false;
    this.seen = ""; // the live flight's frame that was last brought into view
    new ResizeObserver(() => {
      this.map?.invalidateSize({ animate: false });
      if (this.map && !this.moved) this.fit();
      this.on.drawn();
    }).observe(box);
  }

  /** Show the tiles of a flight's map; an unchanged map is kept. */
  show(data) {
    const key = JSON.stringify([data.bounds, data.addresses.tiles]);
    if (key === this.key) return;
    const same = this.map && String(data.bounds) === String(this.bounds);
    [this.key, this.bounds] = [key, data.bounds];
    if (!same) this.open(data);
    this.base?.remove();
    const [left, south, right, top] = data.bounds.map((edge, i) => edge + (i < 2 ? 0.5 : -0.5) * data.resolution); // no tile that only touches an edge
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
      if (this.flight.view?.length === 3) this.look(this.flight.view);
      else this.fit();
    }
    this.base.addTo(this.map);
  }
  open(data) {
    this.map?.remove();
    const { west, north, side } = data.pyramid;
    const scale = (this.scale = TILE / side);
    const crs = L.extend({}, L.CRS.Simple, { transformation: new L.Transformation(scale, -scale * west, -scale, scale * north) });
    const zooms = { minZoom: Math.log2(20 / TILE), maxZoom: Math.log2(8 / (data.resolution * scale)), zoomSnap: 0, zoomDelta: 0.6, wheelPxPerZoomLevel: 110 };
    // Without animation: the photo follows each step.
    const still = { zoomAnimation: false, fadeAnimation: false, inertia: false, boxZoom: false };
    this.map = L.map(find(".tiles", this.box), { crs, ...zooms, ...still, renderer: L.canvas({ tolerance: 6 }), attributionControl: false });
    this.map.zoomControl.setPosition("topright");
    L.control.scale({ imperial: false, maxWidth: 130, position: "bottomright" }).addTo(this.map);
    this.marks = L.layerGroup().addTo(this.map);
    this.shown = L.layerGroup().addTo(this.map);
    this.moved = false;
    this.map.on("move zoom viewreset", () => this.on.drawn());
    this.map.on("moveend", () => {
      if (this.fitting || !this.map) return;
      this.moved = true;
      this.on.moved();
    });
    this.map.on("mousemove", ({ latlng }) => (find(".read", this.box).textContent = this.told([latlng.lng, latlng.lat])));
    this.map.on("mouseout", () => (find(".read", this.box).textContent = ""));
    this.map.on("click", ({ latlng, originalEvent }) => {
      if (!originalEvent.shiftKey && !this.asking) return;
      this.asking = false;
      this.on.spot([latlng.lng, latlng.lat].map((value) => Math.round(100 * value) / 100));
    });
  }
  told(/** @type {any} */ [x, y]) {
    const { degrees } = this.flight.data;
    const metres = `${x.toFixed(1)} m E, ${y.toFixed(1)} m N`;
    if (!degrees) return metres;
    const [west, south, east, north] = this.bounds;
    const [u, v] = [(2 * x - west - east) / (east - west), (2 * y - south - north) / (north - south)];
    const terms = [1, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
    const [latitude, longitude] = degrees.map((row) => row.reduce((sum, value, i) => sum + value * terms[i], 0));
    return `${latitude.toFixed(6)}, ${(longitude - 360 * Math.round(longitude / 360)).toFixed(6)} · ${metres}`;
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
    const { x, y } = this.map.project([0, 0]).subtract(this.map.getPixelOrigin()).add(this.map.layerPointToContainerPoint([0, 0]));
    return { x, y, scale: this.scale * 2 ** this.map.getZoom() };
  }
  /** @param {any} point @returns {[number, number]} */
  toPixels([east, north]) {
    const { x, y, scale } = this.affine;
    return [x + scale * east, y - scale * north];
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
  set(middle, scale) {
    this.fitting = true;
    this.map.setView(at(middle), Math.log2(scale / this.scale), { animate: false });
    this.fitting = false;
    this.on.drawn();
  }
  /** Fit the view so that some points fill a share of the map. */
  frame(points, share, least = 10) {
    const [[west, east], [south, north]] = [0, 1].map((axis) => [Math.min(...points.map((one) => one[axis])), Math.max(...points.map((one) => one[axis]))]);
    const [width, height] = this.size;
    this.set([(west + east) / 2, (south + north) / 2], share * Math.min(width / Math.max(east - west, least), height / Math.max(north - south, least)));
  }
  /** Show the flight, or the whole map if no part of the flight lies on it. */
  fit() {
    if (!this.map || !this.box.clientWidth) return;
    this.moved = false;
    const { own, data } = this.flight;
    const [west, south, east, north] = this.bounds;
    const tracks = Object.entries(data.tracks).filter(([name]) => name !== "retrieval").map(([, track]) => track);
    const placed = tracks.flatMap((track) => data.names.map((_, i) => (track.state[i] < 2 ? place(track, i) : null)));
    const points = own ? [...(own.outline ?? []).slice(0, 4), own.place, own.tag] : [...placed, ...this.newest()];
    const near = points.filter((one) => one && one[0] > west - AROUND && one[0] < east + AROUND && one[1] > south - AROUND && one[1] < north + AROUND);
    if (near.length > 1) this.frame(near, 0.72, 40);
    else this.frame([[west, south], [east, north]], 0.9);
  }
  /** The corners of a live flight's newest photo. */
  newest() {
    const { data, chosen } = this.flight;
    return (data.live && data.outlines[chosen]?.slice(0, 4)) || [];
  }
  sees(points, beyond = 0) {
    const [width, height] = this.size;
    return points.map((one) => this.toPixels(one)).every(([left, top]) => left > -beyond * width && left < (1 + beyond) * width && top > -beyond * height && top < (1 + beyond) * height);
  }
  /** Bring a photo's corners into view, unless they are visible and large enough; return whether the map moves. */
  approach(points, large = true) {
    const across = [0, 1].map((axis) => Math.max(...points.map((one) => one[axis])) - Math.min(...points.map((one) => one[axis])));
    const [width, height] = this.size;
    const fills = Math.max(across[0] / width, across[1] / height) * this.affine.scale > 0.45;
    if (this.sees(points, large ? 0.2 : 0) && (fills || !large)) return false;
    this.frame(points, 0.85);
    this.moved = true;
    return true;
  }

  // Marks.

  draw() {
    const { data, chosen, own, compares, over, spotted } = this.flight;
    if (!this.map || !data || !this.box.clientWidth) return;
    const followed = `${data.names.length} ${chosen}`;
    if (data.live && !this.moved && followed !== this.seen) {
      this.seen = followed;
      if (!this.sees(this.newest())) this.fit();
    }
    this.marks.clearLayers();
    this.shown.clearLayers();
    for (const { outline, colour, name } of data.sheets) this.line([...outline, outline[0]], colour, 2).bindTooltip(said(name), { permanent: true, direction: "center" });
    if (!own && !compares && over !== "correct") for (const [name, track] of this.flight.shown()) this.drawTrack(name, track);
    for (const i of spotted?.frames ?? []) this.line([...data.outlines[i].slice(0, 4), data.outlines[i][0]], "#fff", 1);
    if (spotted) this.dot(spotted.spot, 6, "#fff", true);
    if (this.flight.photo) this.drawChosen();
    this.on.drawn();
  }
  line(points, colour, weight, dashArray = "") {
    L.polyline(points.map(at), { ...DARK, weight: weight + 2 }).addTo(this.marks);
    return L.polyline(points.map(at), { color: colour, weight, dashArray, interactive: false }).addTo(this.marks);
  }
  dot(point, radius, colour, hollow = false, to = this.marks) {
    return L.circleMarker(at(point), { radius, weight: hollow ? 2 : 1, color: hollow ? colour : "#000c", fillColor: hollow ? "#000" : colour, fillOpacity: hollow ? 0.35 : 1 }).addTo(to);
  }
  drawTrack(name, track) {
    const { data } = this.flight;
    const tag = name === "tag";
    // A line joins neighbours that were not refused. Retrieval is unverified, so it has no line.
    let run = [];
    const end = () => run.length > 1 && this.line(run.splice(0), data.colours[name], tag ? 1 : 2, tag ? "5 4" : "");
    data.names.forEach((file, i) => {
      const point = place(track, i);
      if (name !== "retrieval" && track.state[i] !== 2) {
        if (point) run.push(point);
        else end();
        if (!point) run = [];
      }
      if (!point) return;
      const doubted = name === data.stages[i] && data.states[i] === "contradicted";
      const mark = this.dot(point, tag ? 2 : doubted ? 6 : 4, doubted ? data.colours.contradicted : data.colours[name], track.state[i] === 2, this.shown);
      mark.bindTooltip(said(data.reasons[i] && !tag ? `${file}: ${data.words[data.states[i]]}. ${data.reasons[i]}` : file), { className: "reason" });
      mark.on("click", ({ originalEvent }) => !this.asking && !originalEvent.shiftKey && this.on.choose(i));
    });
    end();
  }
  /** Draw outline, details, and places of the chosen photo, which may be the user's own. */
  drawChosen() {
    const { data, photo, own, answered, chosen, compares } = this.flight;
    const { colours } = data;
    const colour = colours[photo.card.state];
    const outline = own ? own.outline : data.outlines[chosen];
    if (outline) {
      this.line([...outline.slice(0, 4), outline[0]], colour, 2, outline[4] ? "" : "7 5");
      this.line(outline.slice(0, 2), colour, 4); // the picture's top edge
    }
    if (answered && !compares && (!own || own.place)) {
      const [x, y, half] = [answered[0], answered[1], answered[2] / 2];
      this.line([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half], [x - half, y - half]], colours.retrieval, 1.5, "2 3");
    }
    for (const [x, y, east, north] of compares ? photo.pins : []) {
      this.line([[x, y], [x + east, y + north]], colours.accent, 2);
      this.dot([x + east, y + north], 3, colours.accent);
    }
    const mark = (point, radius, tint, size) => {
      if (radius) L.circle(at(point), { radius, color: tint, weight: 1.5, fill: false, interactive: false }).addTo(this.marks);
      this.dot(point, size, tint);
    };
    const counts = data.tracks[data.stages[chosen]];
    const [spot, radius] = own ? [own.place, own.radius] : counts ? [place(counts, chosen), counts.radius[chosen]] : [null, 0];
    const tag = own ? own.tag : place(data.tracks.tag, chosen);
    if (own && spot && tag) this.line([spot, tag], colours.tag, 1.5, "5 4");
    if (tag) mark(tag, 0, colours.tag, 5);
    if (spot) mark(spot, radius, colour, 7);
  }
  close() {
    this.map?.remove();
    this.map = null;
  }
}
