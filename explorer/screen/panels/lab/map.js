// The map of queries and tiles: Leaflet moves and zooms it, and one canvas has the points. A lasso picks queries.

import { find, make, picture, prepare, variable } from "../../page/dom.js";
import { load } from "./vendor.js";

const SELECTED = 1;
const MISSED = 2;
const UNKNOWN = 255;
const REACH = 10; // pixels within which the mouse points at a query
const CORNERS = 300; // of a lasso
const REST = 150; // milliseconds that the mouse rests before a tip

export class PointMap {
  constructor(box, { set, act }) {
    this.box = box;
    this.set = set;
    this.act = act;
    this.plane = this.marks = null;
    this.head = this.message = this.view = this.map = null;
    this.hovered = -1;
    this.loaded = { plane: "", marks: "", picture: "" };
    this.lasso = null;
    this.drawing = false;
    box.append(
      make("div", { class: "line" },
        make("select", { class: "field kind", "aria-label": "Map" }), make("select", { class: "field by", "aria-label": "Colour by" }), make("i", { class: "gap" }),
        make("button", { class: "chip lassoing", text: "Lasso", "aria-pressed": "false", title: "Draw a loop around queries; Shift and a drag do so, too" }),
        make("button", { class: "chip all", text: "⤢", title: "Show all", "aria-label": "Show all" })),
      make("div", { class: "plane", role: "application", "aria-label": "Map of the queries: arrow keys move it, plus and minus zoom" }),
      make("div", { class: "tip", hidden: true }), make("div", { class: "read" }), make("div", { class: "line legend" }));
    find(".kind", box).onchange = (event) => set({ lab_map: event.target.value });
    find(".by", box).onchange = (event) => set({ lab_colour: event.target.value });
    find(".all", box).onclick = () => this.fit();
    const button = find(".lassoing", box);
    button.onclick = () => {
      this.drawing = !this.drawing;
      button.setAttribute("aria-pressed", String(this.drawing));
      this.map?.dragging[this.drawing ? "disable" : "enable"]();
    };
  }

  close() {
    clearTimeout(this.resting);
    this.map?.remove();
    this.map = null;
    this.closed = true;
  }

  async show(message, view) {
    this.message = message;
    this.view = view;
    await load("leaflet");
    const { address } = this.head;
    const get = async (feed) => (await fetch(address + feed)).arrayBuffer();
    const { loaded } = this;
    const moved = loaded.plane !== message.plane;
    const [plane, marks] = await Promise.all([moved ? get(message.plane) : null, loaded.marks !== message.marks ? get(message.marks) : null]);
    if (message !== this.message || this.closed) return;
    if (plane) [this.plane, loaded.plane] = [new Float32Array(plane), message.plane];
    if (marks) [this.marks, loaded.marks] = [new Uint8Array(marks), message.marks];
    this.map ??= this.make();
    if (moved) this.ground();
    this.drawLegend();
    this.draw(view);
    this.paint();
    if (moved) this.fit();
  }

  /** @returns {any} the map, whose layer is one canvas */
  make() {
    const { L } = /** @type {any} */ (window);
    const plane = find(".plane", this.box);
    const map = L.map(plane, { crs: L.CRS.Simple, zoomSnap: 0, zoomDelta: 0.7, wheelPxPerZoomLevel: 90, minZoom: -30, maxZoom: 30, attributionControl: false, boxZoom: false, zoomAnimation: false, fadeAnimation: false, center: [0, 0], zoom: 0 });
    this.canvas = map.getPane("overlayPane").appendChild(make("canvas", { class: "points" }));
    this.scale = L.control.scale({ imperial: false });
    map.on("move zoom resize", () => this.paint());
    plane.addEventListener("pointerdown", (event) => this.down(event), true);
    plane.addEventListener("pointermove", (event) => this.hover(event));
    plane.addEventListener("pointerleave", () => this.point(-1));
    map.on("click", ({ containerPoint }) => {
      const query = this.nearest(containerPoint);
      if (query >= 0 && !this.lasso) this.set({ query, own: "" });
    });
    new ResizeObserver(() => this.map?.invalidateSize({ pan: false })).observe(plane);
    return map;
  }

  fillSelects() {
    const { head, message, view } = this;
    const kind = message?.kind ?? (view.state.lab_map || Object.keys(head.maps)[0]);
    const options = (pairs, chosen) => pairs.map(([value, text]) => make("option", { value, text, selected: value === chosen }));
    find(".kind", this.box).replaceChildren(...options(Object.entries(head.maps), kind));
    find(".by", this.box).replaceChildren(...options([["", "by outcome"], ...head.names.map((name) => [name, `by ${name}`])], view.state.lab_colour));
  }

  /** Lay the picture of the ground under the points, with its scale; a map of descriptors has none. */
  ground() {
    const { L } = /** @type {any} */ (window);
    this.image?.remove();
    this.scale.remove();
    const { ground, picture } = this.message;
    this.image = null;
    if (!ground) return;
    const corners = ground.corners.map(([x, y]) => [y, x]);
    this.image = L.imageOverlay(this.head.address + picture, corners, { opacity: 0.8, alt: "" }).addTo(this.map);
    this.map.getPane("overlayPane").append(this.canvas); // above the picture
    this.scale.addTo(this.map);
  }

  /** Zoom to all that have a place. */
  fit() {
    const corners = this.message.ground?.corners.map(([x, y]) => [y, x]) ?? [];
    const { plane } = this;
    let [west, south, east, north] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = 0; i < plane.length; i += 2) {
      if (plane[i] !== plane[i]) continue;
      [west, east] = [Math.min(west, plane[i]), Math.max(east, plane[i])];
      [south, north] = [Math.min(south, plane[i + 1]), Math.max(north, plane[i + 1])];
    }
    if (west <= east) corners.push([south, west], [north, east]);
    if (corners.length) this.map.fitBounds(corners, { animate: false, padding: [12, 12] });
  }

  drawLegend() {
    const { legend, axes, queries } = this.message;
    const colour = (code) => this.colour(code);
    const entry = (code, text, count) => make("span", {}, make("i", { class: "swatch", style: { background: colour(code) } }), `${text} `, make("b", { text: count?.toLocaleString("en") ?? "" }));
    const scale = legend.ends ? [legend.ends[0], make("i", { class: "ramp", style: { background: `linear-gradient(90deg, ${legend.palette.filter((_, at) => at % 16 === 0).join(",")})` } }), legend.ends[1]] : [];
    find(".legend", this.box).replaceChildren(
      ...legend.labels.map((text, code) => entry(code, text, legend.counts[code])), ...scale,
      ...(legend.unknown ? [entry(UNKNOWN, this.message.colour ? "not known" : "? not graded", legend.unknown)] : []),
      make("span", { class: "soft", text: `× missed, □ tile${axes ? `; ${axes}` : ""}` }));
    this.box.dataset.points = String(queries);
  }

  colour(code) {
    const named = this.message.legend.palette[code];
    return named === undefined ? variable("--soft") : named.startsWith("--") ? variable(named) : named;
  }

  draw(view) {
    const changed = this.view?.state.theme !== view.state.theme || view.state.query !== this.shown;
    this.view = view;
    this.shown = view.state.query;
    if (this.head) this.fillSelects();
    if (this.map && this.message && (changed || !this.painted)) this.paint();
  }

  paint() {
    if (!this.due) this.due = requestAnimationFrame(() => this.paintNow());
  }

  pixel(i) {
    const [x, y] = [this.plane[2 * i], this.plane[2 * i + 1]];
    return x === x ? this.map.latLngToContainerPoint([y, x]) : null;
  }

  /** Draw all points: squares for tiles, dots for found queries, crosses for missed ones, those out of the choice pale. */
  paintNow() {
    this.due = 0;
    if (!this.map || !this.plane || !this.marks) return;
    const { x: width, y: height } = this.map.getSize();
    Object.assign(this.canvas.style, { width: `${width}px`, height: `${height}px` });
    /** @type {any} */ (window).L.DomUtil.setPosition(this.canvas, this.map.containerPointToLayerPoint([0, 0]));
    const { pen } = prepare(this.canvas);
    const { queries, lines, ground, answers } = this.message;
    const total = this.plane.length / 2;
    const size = queries > 15000 ? 1.6 : queries > 2000 ? 2.6 : 4;
    const { x: left, y: top } = this.map.latLngToContainerPoint([0, 0]);
    const scale = 2 ** this.map.getZoom();
    const shapes = new Map();
    const path = (key) => shapes.get(key) ?? shapes.set(key, new Path2D()).get(key);
    for (let i = ground ? queries - 1 : total - 1; i >= 0; i--) {
      const [x, y] = [left + scale * this.plane[2 * i], top - scale * this.plane[2 * i + 1]];
      if (!(x > -9 && y > -9 && x < width + 9 && y < height + 9)) continue;
      if (i >= queries) path("tile").rect(x - size, y - size, 2 * size, 2 * size);
      else {
        const flags = this.marks[2 * i];
        const shape = path(flags & SELECTED ? `${flags & MISSED} ${this.marks[2 * i + 1]}` : "pale");
        if (flags & MISSED && flags & SELECTED) {
          shape.moveTo(x - size, y - size), shape.lineTo(x + size, y + size);
          shape.moveTo(x + size, y - size), shape.lineTo(x - size, y + size);
        } else shape.moveTo(x + size, y), shape.arc(x, y, size, 0, 7);
      }
    }
    const order = [...shapes.keys()].sort((one, other) => ["pale", "tile"].indexOf(other) - ["pale", "tile"].indexOf(one) || one.localeCompare(other));
    for (const key of order) {
      pen.globalAlpha = key === "pale" ? 0.3 : 1;
      const [missed, code] = key.split(" ");
      const colour = code === undefined ? variable("--soft") : this.colour(Number(code));
      [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [colour, colour, key === "tile" ? 1 : Math.max(1.2, size / 2)];
      if (missed === "2" || key === "tile") pen.stroke(shapes.get(key));
      else pen.fill(shapes.get(key));
    }
    pen.globalAlpha = 1;
    const join = (from, to, colour) => {
      const [start, end] = [this.pixel(from), this.pixel(to)];
      if (!start || !end) return;
      [pen.strokeStyle, pen.lineWidth] = [colour, 1.5];
      pen.beginPath(), pen.moveTo(start.x, start.y), pen.lineTo(end.x, end.y), pen.stroke();
    };
    for (const [query, tile] of lines) join(query, queries + tile, variable("--soft"));
    const shown = this.view.state.own ? -1 : this.view.state.query;
    if (shown >= 0) answers.forEach((tile, of) => tile >= 0 && join(shown, queries + tile, variable(of ? "--right" : tile === answers[1] ? "--right" : "--wrong")));
    for (const [query, wide] of [[shown, 9], [this.hovered, 7]]) this.ring(pen, query, wide);
    if (this.lasso) {
      pen.beginPath();
      this.lasso.forEach(([x, y]) => pen.lineTo(x, y));
      [pen.strokeStyle, pen.lineWidth] = [variable("--ink"), 2];
      pen.stroke();
    }
    this.painted = true;
    this.box.dataset.painted = String(Number(this.box.dataset.painted ?? 0) + 1);
  }

  ring(pen, query, radius) {
    const at = query >= 0 && this.pixel(query);
    if (!at) return;
    for (const [colour, wide] of [["--ground", 5], ["--ink", 2]]) {
      [pen.strokeStyle, pen.lineWidth] = [variable(colour), wide];
      pen.beginPath(), pen.arc(at.x, at.y, radius, 0, 7), pen.stroke();
    }
  }

  /** @returns {number} the selected query nearest to a pixel; -1 if none is near */
  nearest({ x, y }) {
    let [best, least] = [-1, REACH * REACH];
    const middle = this.map.latLngToContainerPoint([0, 0]);
    const scale = 2 ** this.map.getZoom();
    for (let i = 0; i < this.message.queries; i++) {
      const far = (middle.x + scale * this.plane[2 * i] - x) ** 2 + (middle.y - scale * this.plane[2 * i + 1] - y) ** 2;
      if (far < least && this.marks[2 * i] & SELECTED) [best, least] = [i, far];
    }
    return best;
  }

  at(event) {
    const frame = find(".plane", this.box).getBoundingClientRect();
    return { x: event.clientX - frame.left, y: event.clientY - frame.top };
  }

  hover(event) {
    if (!this.plane || !this.marks || this.lasso || event.buttons) return;
    const at = this.at(event);
    const { degrees } = this.message.ground ?? {};
    const { lat, lng } = this.map.containerPointToLatLng([at.x, at.y]);
    const place = degrees ? `${(degrees[0] + lat * degrees[2]).toFixed(6)}, ${(degrees[1] + lng * degrees[3]).toFixed(6)}` : `${lng.toFixed(0)} m east, ${lat.toFixed(0)} m north`;
    find(".read", this.box).textContent = this.message.ground ? `${place} · north is up` : "";
    this.point(this.nearest(at));
  }

  point(query) {
    if (query === this.hovered) return;
    this.hovered = query;
    clearTimeout(this.resting);
    find(".tip", this.box).hidden = true;
    find(".plane", this.box).style.cursor = query < 0 ? "" : "pointer";
    if (query >= 0) this.resting = setTimeout(() => this.act("tip", { query }), REST);
    this.paint();
  }

  /** Show what a query is beside its point. */
  tip({ query, name, text }) {
    const at = query === this.hovered && this.map && this.pixel(query);
    if (!at) return;
    const box = find(".tip", this.box);
    box.replaceChildren(make("img", { src: picture(`${this.head.thumbnails[0]}${query}`).src, alt: "" }), make("div", {}, make("b", { text: name }), make("div", { text })));
    box.hidden = false;
    const plane = find(".plane", this.box);
    const left = Math.min(plane.offsetLeft + at.x + 14, plane.offsetLeft + plane.clientWidth - box.offsetWidth);
    const below = at.y + box.offsetHeight + 18 < plane.clientHeight;
    Object.assign(box.style, { left: `${Math.max(0, left)}px`, top: `${plane.offsetTop + at.y + (below ? 14 : -14 - box.offsetHeight)}px` });
  }

  /** Draw a lasso while the pointer is held; a straight one is the diagonal of a box. */
  down(event) {
    if (event.button || !(this.drawing || event.shiftKey) || event.target.closest(".leaflet-control")) return;
    event.preventDefault();
    event.stopPropagation();
    const plane = find(".plane", this.box);
    const { x, y } = this.at(event);
    this.lasso = [[x, y]];
    plane.setPointerCapture(event.pointerId);
    const move = (next) => {
      const to = this.at(next);
      this.lasso.push([to.x, to.y]);
      this.paint();
    };
    const up = () => {
      plane.removeEventListener("pointermove", move);
      const drag = this.lasso;
      setTimeout(() => (this.lasso = null), 0); // the click that ends the drag opens no query
      const [[x0, y0], [x1, y1]] = [drag[0], drag.at(-1)];
      const far = Math.hypot(x1 - x0, y1 - y0);
      const straight = far > 12 && drag.every(([px, py]) => Math.abs((px - x0) * (y1 - y0) - (py - y0) * (x1 - x0)) < 0.12 * far * far);
      const loop = straight ? [[x0, y0], [x1, y0], [x1, y1], [x0, y1]] : drag;
      const every = Math.ceil(loop.length / CORNERS);
      const corners = loop.filter((_, at) => at % every === 0).map((one) => this.map.containerPointToLatLng(one)).map(({ lat, lng }) => [lng, lat]);
      if (corners.length > 2) this.act("lasso", { corners });
      this.paint();
    };
    plane.addEventListener("pointermove", move);
    plane.addEventListener("pointerup", up, { once: true });
  }
}
