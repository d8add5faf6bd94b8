// The map of queries and tiles: Leaflet moves and zooms it, and draws the points. A lasso picks queries.

import { find, findAll, load, make, variable } from "../../page/dom.js";
import { put } from "../../page/fragment.js";

const [SELECTED, MISSED] = [1, 2]; // flags of a query
const CORNERS = 300; // of a lasso
const REST = 150; // milliseconds that the mouse rests before a tip
const FIT = { animate: false, padding: [12, 12] };
const VIEW = { zoomSnap: 0, zoomDelta: 0.7, wheelPxPerZoomLevel: 90, minZoom: -30, maxZoom: 30, attributionControl: false, boxZoom: false, zoomAnimation: false, fadeAnimation: false, center: [0, 0], zoom: 0 };

/** Points of a map on one canvas: a dot, or a cross for a missed query. */
const pointClass = (L) =>
  L.CircleMarker.extend({
    _updatePath() {
      if (!this.options.cross) return L.CircleMarker.prototype._updatePath.call(this);
      const { _renderer: canvas, _point: { x, y }, _radius: size } = this;
      if (!canvas._drawing || this._empty()) return;
      canvas._ctx.beginPath();
      for (const side of [-1, 1]) {
        canvas._ctx.moveTo(x - size, y - side * size);
        canvas._ctx.lineTo(x + size, y + side * size);
      }
      canvas._fillStroke(canvas._ctx, this);
    },
  });

export class PointMap {
  constructor(box, { set, act }) {
    this.box = box;
    this.set = set;
    this.act = act;
    this.message = this.view = this.map = this.hovered = null;
    this.plane = "";
    this.points = [];
    find(".all", box).onclick = () => this.map?.fitBounds(this.message.bounds, FIT);
    find(".lassoing", box).onclick = ({ target }) => {
      this.drawing = !this.drawing;
      target.setAttribute("aria-pressed", String(this.drawing));
      this.map?.dragging[this.drawing ? "disable" : "enable"]();
    };
  }

  close() {
    clearTimeout(this.resting);
    this.map?.remove();
    this.closed = true;
  }

  async show(message, view) {
    [this.message, this.view] = [message, view];
    for (const one of findAll("[data-html]", this.box)) put(one, message.html[one.dataset.html]);
    await load("leaflet");
    const get = async (feed) => (await fetch(message.address + feed)).arrayBuffer();
    const moved = message.plane !== this.plane;
    const [plane, marks] = await Promise.all([moved ? get(message.plane) : null, get(message.marks)]);
    if (message !== this.message || this.closed) return;
    this.map ??= this.make();
    this.marks = new Uint8Array(marks);
    if (plane) this.place(new Float32Array(plane));
    this.paint();
  }

  make() {
    const { L } = /** @type {any} */ (window);
    const plane = find(".plane", this.box);
    const map = L.map(plane, { crs: L.CRS.Simple, ...VIEW });
    this.L = L;
    this.Point = pointClass(L);
    this.canvas = L.canvas({ padding: 0.3, tolerance: 4 });
    this.layers = L.featureGroup().addTo(map);
    this.over = L.layerGroup().addTo(map);
    this.scale = L.control.scale({ imperial: false });
    this.layers.on("click", ({ layer }) => this.lassoed || this.set({ query: layer.options.query, own: "" }));
    this.layers.on("mouseover", ({ layer }) => this.hover(layer));
    this.layers.on("mouseout", () => this.hover(null));
    plane.addEventListener("pointerdown", (event) => this.lasso(event), true);
    new ResizeObserver(() => this.closed || map.invalidateSize({ pan: false })).observe(plane);
    return map;
  }

  /** Lay out all points over the picture of the ground; a map of descriptors has tiles in place of it. */
  place(plane) {
    const { ground, queries, picture, address, bounds } = this.message;
    this.plane = this.message.plane;
    this.layers.clearLayers();
    this.image?.remove();
    this.scale.remove();
    this.image = ground ? this.L.imageOverlay(address + picture, ground, { opacity: 0.8, alt: "" }).addTo(this.map) : null;
    if (ground) this.scale.addTo(this.map);
    this.places = Array.from({ length: plane.length / 2 }, (_, at) => (Number.isNaN(plane[2 * at]) ? null : [plane[2 * at + 1], plane[2 * at]]));
    this.points = this.places.map((at, query) => at && new this.Point(at, { renderer: this.canvas, query, interactive: query < queries }));
    const shown = ground ? this.points.slice(0, queries) : [...this.points.slice(queries), ...this.points.slice(0, queries)];
    for (const point of shown) point?.addTo(this.layers);
    this.map.fitBounds(bounds, FIT);
  }

  /** Paint the points: found queries are dots, missed ones crosses, tiles rings, and unselected points pale. */
  paint() {
    const { queries, palette } = this.message;
    const soft = variable("--soft");
    const radius = queries > 15000 ? 1.6 : queries > 2000 ? 2.6 : 4;
    const colours = palette.map((one) => (one.startsWith("--") ? variable(one) : one));
    this.points.forEach((point, at) => {
      if (!point) return;
      const flags = at < queries ? this.marks[2 * at] : 0;
      const selected = Boolean(flags & SELECTED);
      const cross = selected && Boolean(flags & MISSED);
      const colour = selected ? (colours[this.marks[2 * at + 1]] ?? soft) : soft;
      const line = cross || at >= queries;
      point.setStyle({ cross, radius, interactive: selected, stroke: line, color: colour, weight: Math.max(1.2, radius / 2), fill: !line, fillColor: colour, fillOpacity: selected ? 1 : 0.3 });
      if (selected) point.bringToFront();
    });
    this.mark();
  }

  /** Mark the shown query, and join it with its answers, and misses with theirs. */
  mark() {
    const { L, over, message: { queries, lines, answers } } = this;
    const { state } = this.view;
    const shown = state.own ? -1 : state.query;
    over.clearLayers();
    const join = (query, tile, colour) => {
      const ends = [this.places[query], this.places[queries + tile]];
      if (ends.every(Boolean)) L.polyline(ends, { color: variable(colour), weight: 1.5, interactive: false, renderer: this.canvas }).addTo(over);
    };
    for (const [query, tile] of lines) join(query, tile, "--soft");
    answers.forEach((tile, of) => tile >= 0 && shown >= 0 && join(shown, tile, of || tile === answers[1] ? "--right" : "--wrong"));
    if (this.places[shown]) L.circleMarker(this.places[shown], { radius: 9, color: variable("--ink"), weight: 2, fill: false, interactive: false, renderer: this.canvas }).addTo(over);
    this.box.dataset.painted = String(Number(this.box.dataset.painted ?? 0) + 1);
  }

  draw(view) {
    const before = this.view?.state;
    this.view = view;
    if (!this.map || !before) return;
    if (before.theme !== view.state.theme) this.paint();
    else if (before.query !== view.state.query || before.own !== view.state.own) this.mark();
  }

  hover(point) {
    clearTimeout(this.resting);
    this.hovered?.unbindTooltip();
    this.hovered = point;
    if (point) this.resting = setTimeout(() => this.act("tip", { query: point.options.query }), REST);
  }

  /** Describe a query beside its point. */
  tip({ query, name, text }) {
    if (this.hovered?.options.query !== query) return;
    const said = make("div", {}, make("img", { src: `${this.message.thumbnails}${query}`, alt: "" }), make("div", {}, make("b", { text: name }), make("div", { text })));
    this.hovered.bindTooltip(said, { className: "tip", opacity: 1 }).openTooltip();
  }

  /** Draw a lasso while the pointer is held. */
  lasso(event) {
    if (event.button || !(this.drawing || event.shiftKey) || event.target.closest(".leaflet-control")) return;
    event.preventDefault();
    event.stopPropagation();
    const { map, act } = this;
    const plane = event.currentTarget;
    const line = this.L.polyline([map.mouseEventToLatLng(event)], { color: variable("--ink"), weight: 2, interactive: false, renderer: this.canvas }).addTo(map);
    plane.setPointerCapture(event.pointerId);
    const move = (next) => line.addLatLng(map.mouseEventToLatLng(next));
    plane.addEventListener("pointermove", move);
    plane.addEventListener("pointerup", () => {
      plane.removeEventListener("pointermove", move);
      this.lassoed = true; // the click that ends the lasso must not open a query
      setTimeout(() => (this.lassoed = false), 0);
      line.remove();
      const drawn = line.getLatLngs();
      const every = Math.ceil(drawn.length / CORNERS);
      const corners = drawn.filter((_, at) => at % every === 0).map(({ lat, lng }) => [lng, lat]);
      if (corners.length > 2) act("lasso", { corners });
    }, { once: true });
  }
}
