// The chosen photo over the map: swiped, or dragged to its place by tie points.

import { find, findAll } from "../../page/dom.js";

// The photo's corners, in shares of its sides; the user drags them to their places on the map.
const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const HANDLE = 36; // pixels of the slider's handle, as in the style sheet
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** Map a point by a homography, 9 numbers by rows. */
const through = (h, /** @type {any} */ [x, y]) => {
  const depth = h[6] * x + h[7] * y + h[8];
  return [(h[0] * x + h[1] * y + h[2]) / depth, (h[3] * x + h[4] * y + h[5]) / depth];
};
/** The homography that maps four points to four others; null if there is none. */
export const homography = (from, to) => {
  const [x0, y0] = to[0]; // relative to the first point, so that large coordinates cost no precision
  const rows = from.flatMap(([x, y], i) => {
    const [u, v] = [to[i][0] - x0, to[i][1] - y0];
    return [[x, y, 1, 0, 0, 0, -u * x, -u * y, u], [0, 0, 0, x, y, 1, -v * x, -v * y, v]];
  });
  for (let column = 0; column < 8; column++) {
    let best = column;
    for (let row = column; row < 8; row++) if (Math.abs(rows[row][column]) > Math.abs(rows[best][column])) best = row;
    [rows[column], rows[best]] = [rows[best], rows[column]];
    if (Math.abs(rows[column][column]) < 1e-12) return null;
    for (let row = 0; row < 8; row++) {
      if (row === column) continue;
      const factor = rows[row][column] / rows[column][column];
      for (let k = column; k < 9; k++) rows[row][k] -= factor * rows[column][k];
    }
  }
  const h = [...rows.map((row, i) => row[8] / row[i]), 1];
  for (const k of [0, 1, 2]) {
    h[k] += x0 * h[6 + k];
    h[3 + k] += y0 * h[6 + k];
  }
  return h;
};
const product = (one, other) => [0, 3, 6].flatMap((row) => [0, 1, 2].map((k) => one[row] * other[k] + one[row + 1] * other[3 + k] + one[row + 2] * other[6 + k]));
/** The CSS transform of an element whose origin is its upper left corner. */
const transform = (h) => {
  const [a, b, c, d, e, f, g, i, j] = h.map((value) => value / h[8]);
  return `matrix3d(${[a, d, 0, g, b, e, 0, i, 0, 0, 1, 0, c, f, 0, j].join(",")})`;
};

export class LaidPhoto {
  /**
   * @param {any} root the panel's element
   * @param {any} flight the state that all parts of the panel share, see flight.js
   * @param {any} map
   * @param {{use: (mode: string) => void, act: (name: string, args: any) => void, say: (text: string) => void}} on
   */
  constructor(root, flight, map, on) {
    this.root = root;
    this.flight = flight;
    this.map = map;
    this.on = on;
    this.ties = null; // frame, points in metres, and the number of saves when they were sent
    this.near = ""; // the photo and the mode that were last brought into view
    find(".swipe", root).addEventListener("input", () => this.lay());
    const box = find(".ties", root);
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "keydown"]) box.addEventListener(kind, (event) => this.onTie(event));
    // Dragging tie points or the slider must not move the map.
    for (const one of [box, find(".swipe", root)]) for (const kind of ["mousedown", "touchstart", "dblclick", "click", "pointerdown"]) one.addEventListener(kind, (event) => event.stopPropagation());
  }

  get mode() {
    return this.flight.over;
  }
  /** @param {any} share */
  pixel([x, y]) {
    const [width, height] = this.flight.photo.size;
    return [x * width - 0.5, y * height - 0.5];
  }
  get corners() {
    return CORNERS.map((tie) => this.pixel(tie));
  }

  start() {
    const { photo, data, chosen } = this.flight;
    const outline = data.outlines[chosen];
    let h = photo.homography;
    if (!h && outline) h = homography(this.corners, outline.slice(0, 4));
    if (!h) {
      // The photo has no known place: it starts in the middle of the view, north up.
      const [x, y, across] = this.map.view;
      const [half, tall] = [0.2 * across, (0.2 * across * photo.size[1]) / photo.size[0]];
      h = homography(this.corners, [[-1, 1], [1, 1], [1, -1], [-1, -1]].map(([right, up]) => [x + right * half, y + up * tall]));
    }
    this.ties = { frame: chosen, points: this.corners.map((tie) => through(h, tie)), sent: null };
    this.map.approach(this.ties.points, false);
  }
  get tied() {
    return homography(this.corners, this.ties.points);
  }
  move(which, /** @type {any} */ [right, up]) {
    const { ties } = this;
    ties.points = ties.points.map(([x, y], i) => (which === "all" || which === String(i) ? [x + right, y + up] : [x, y]));
    ties.sent = null; // the sent points are outdated
    this.map.draw();
  }
  onTie(event) {
    const tie = event.target.closest("[data-tie]");
    if (!tie || !this.ties) return;
    const { scale } = this.map.affine;
    if (event.type === "keydown") {
      if (!(event.key in ARROWS)) return;
      this.move(tie.dataset.tie, ARROWS[event.key].map((one) => (one * (event.shiftKey ? 10 : 1)) / scale));
      event.preventDefault();
    } else if (event.type === "pointerdown") {
      tie.setPointerCapture(event.pointerId);
      this.grip = [event.clientX, event.clientY];
    } else if (event.type === "pointermove" && this.grip) {
      this.move(tie.dataset.tie, [(event.clientX - this.grip[0]) / scale, (this.grip[1] - event.clientY) / scale]);
      this.grip = [event.clientX, event.clientY];
    } else if (event.type !== "pointermove") this.grip = null;
    event.stopPropagation();
  }

  save() {
    const h = this.ties && this.tied;
    if (!h) return this.on.say("The tie points do not span a picture.");
    this.ties.sent = this.flight.photo.saves;
    const corners = this.corners.map((tie) => through(h, tie).map((value) => Math.round(1000 * value) / 1000));
    this.on.act("correct", { frame: this.ties.frame, corners });
  }
  forget() {
    if (this.ties) this.ties.sent = this.flight.photo.saves;
    this.on.act("forget", { frame: this.flight.chosen });
  }
  cancel() {
    this.ties = null;
    this.on.use("off");
  }
  /** Take another photo, or another state of it; a saved or removed correction ends the mode. */
  arrived() {
    const { ties, flight } = this;
    if (!ties || !flight.photo) return;
    if (ties.sent !== null && ties.sent !== flight.photo.saves) this.cancel();
    else if (ties.frame !== flight.chosen) this.ties = null;
  }

  /** From the photo's pixels to metres; null while it has no place. */
  get matrix() {
    const { photo, own } = this.flight;
    if (!photo) return null;
    if (this.mode !== "correct" || own) return photo.homography;
    if (this.ties?.frame !== this.flight.chosen) this.start();
    return this.tied;
  }
  /** Lay the photo by one projective transform. */
  lay() {
    const { root, mode, flight } = this;
    const matrix = mode === "off" || !this.map.map ? null : this.matrix;
    const [layer, swipe, edge] = [".laid", ".swipe", ".edge"].map((one) => find(one, root));
    const correcting = mode === "correct" && Boolean(this.ties) && !flight.own;
    layer.hidden = !matrix;
    layer.style.opacity = correcting ? "0.6" : "1";
    swipe.hidden = edge.hidden = !matrix || mode !== "swipe";
    find(".ties", root).hidden = find(".how", root).hidden = !correcting;
    if (correcting) this.placeTies();
    if (!matrix) return;
    const key = `${flight.chosen} ${mode} ${flight.own?.key ?? ""}`;
    if (mode === "swipe" && key !== this.near) {
      this.near = key;
      if (!flight.data.live && this.map.approach(this.corners.map((one) => through(matrix, one)))) return;
    }
    const image = find("img", layer);
    if (image.getAttribute("src") !== flight.photo.photo) {
      image.onload = () => this.lay();
      image.setAttribute("src", flight.photo.photo);
    }
    if (!image.complete || !image.naturalWidth) return;
    const { x, y, scale } = this.map.affine;
    const [width, height] = this.map.size;
    const { size } = flight.photo;
    // From the served picture's edges to the photo's pixels (whole numbers are centres), to metres, to the view.
    const pixels = [size[0] / image.naturalWidth, 0, -0.5, 0, size[1] / image.naturalHeight, -0.5, 0, 0, 1];
    const look = [scale, 0, x, 0, -scale, y, 0, 0, 1];
    image.style.width = `${image.naturalWidth}px`;
    image.style.transform = transform(product(look, product(matrix, pixels)));
    // The slider spans the visible part of the photo, so that it starts in the middle of it.
    const [seen, whole] = [layer.getBoundingClientRect(), image.getBoundingClientRect()];
    const left = clamp(whole.left - seen.left, 0, width);
    const right = clamp(whole.right - seen.left, left, width);
    const top = clamp(whole.top - seen.top, 0, height);
    const foot = clamp(whole.bottom - seen.top, top, height);
    const border = left + ((right - left) * swipe.value) / 100;
    // The handle's middle lies on the line; without this, its width would stop it before the photo's edge.
    Object.assign(swipe.style, { left: `${left - HANDLE / 2}px`, width: `${right - left + HANDLE}px`, top: `${(top + foot - HANDLE) / 2}px` });
    Object.assign(edge.style, { left: `${border}px`, top: `${top}px`, height: `${foot - top}px` });
    layer.style.clipPath = mode === "swipe" ? `inset(0 0 0 ${border}px)` : "none";
  }
  placeTies() {
    const middle = through(this.tied ?? [0, 0, 0, 0, 0, 0, 0, 0, 1], this.pixel([0.5, 0.5]));
    for (const one of findAll("[data-tie]", this.root)) {
      const [left, top] = this.map.toPixels(one.dataset.tie === "all" ? middle : this.ties.points[Number(one.dataset.tie)]);
      Object.assign(one.style, { left: `${left}px`, top: `${top}px` });
    }
    find("[data-act=forget]", this.root).hidden = !this.flight.photo.corrected;
  }
}
