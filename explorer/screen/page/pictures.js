// The two large pictures with their rings, and the crops of one ring.

import { find, isPhone, make, makeSvg, partColour, partInk, picture, variable } from "./dom.js";
import { cellsOf, isLight, paintHeat } from "./heat.js";

const HEAT_SIDE = 320;
const MOST_WIDE = 2.5; // limit of a crop's width by height; a whole strip looks thin

/** The CSS turn of the photo; the page turns it like the server. */
export const photoTurn = (photo, angle) => (photo.around ? "none" : `rotate(${-angle}deg) scale(${photo.zoom})`);

/** @returns {any} a figure for `showPicture`, as wide as its place */
export const makePicture = () => {
  const layers = [make("div", { class: "picture", role: "img" }), make("canvas", { class: "heat", "aria-hidden": "true" }), makeSvg("svg", { "aria-hidden": "true" })];
  return make("figure", { class: "fitted" }, make("div", { class: "frame" }, make("div", { class: "pan" }, ...layers)));
};

const drawnParts = new WeakMap();

/** Show a picture in its frame: `described` has its address, parts, and heat. */
export const showPicture = (figure, described, focus, count, transform, label) => {
  const pan = find(".pan", figure);
  const shown = find(".picture", figure);
  pan.style.setProperty("--aspect", described.aspect ?? 1);
  const source = `url("${described.src}")`;
  if (shown.style.backgroundImage !== source) shown.style.backgroundImage = source;
  shown.style.transform = transform;
  if (label) shown.setAttribute("aria-label", label);
  figure.classList.toggle("plain", !described.heat);
  const canvas = find(".heat", figure);
  canvas.width = Math.round(HEAT_SIDE * (described.aspect ?? 1));
  canvas.height = HEAT_SIDE;
  paintHeat(canvas.getContext("2d"), canvas.width, canvas.height, described, focus);
  const svg = find("svg", figure);
  // Draw once for each picture, size, and theme: an element replaced under the pointer loses its events.
  const drawn = drawnParts.get(svg);
  if (drawn?.described !== described || drawn.size !== innerWidth || drawn.light !== isLight()) drawParts(svg, described, count);
  drawnParts.set(svg, { described, size: innerWidth, light: isLight() });
  markFocus(svg, focus);
};

/** Turn a panorama by rolling its columns; another picture is turned by its transform. */
export const rollPicture = (figure, photo, angle) => {
  const shown = find(".picture", figure);
  shown.style.backgroundPositionX = photo.around ? `${(-angle / 360) * shown.clientWidth}px` : "";
  shown.style.transform = photoTurn(photo, angle);
  find(".heat", figure).style.clipPath = outline(photo, angle);
};

/** The corners of a turned photo: the area beyond them is black for the network, and has no heat. */
const outline = ({ around, zoom }, angle) => {
  if (around) return "none";
  const [cos, sin] = [Math.cos, Math.sin].map((of) => 50 * zoom * of((-angle * Math.PI) / 180));
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => `${50 + x * cos - y * sin}% ${50 + x * sin + y * cos}%`);
  return `polygon(${corners.join(",")})`;
};

/** Draw the borders of the parts, and the strongest cell of each with its number. */
const drawParts = (svg, described, count) => {
  const { parts, strongest } = described;
  const aspect = described.aspect ?? 1;
  svg.setAttribute("viewBox", `0 0 ${100 * aspect} 100`);
  svg.setAttribute("preserveAspectRatio", "none");
  svg.replaceChildren();
  if (!parts) return;
  const boxes = parts.straight ? parts.boxes.map((box, part) => ({ box, part })) : [];
  boxes.sort((one, other) => area(other.box) - area(one.box));
  for (const { box, part } of boxes) {
    const [left, top, right, bottom] = box;
    const rect = { x: 100 * aspect * left + 0.25, y: 100 * top + 0.25, width: 100 * aspect * (right - left) - 0.5, height: 100 * (bottom - top) - 0.5 };
    svg.append(makeSvg("rect", { ...rect, "data-part": part, style: `stroke:${partColour(part, count)}` }));
  }
  if (!described.heat || count > 6) return;
  const size = isPhone() ? 1.9 : 1;
  const [across, down] = [(100 * aspect) / parts.columns, 100 / parts.rows];
  strongest.forEach((cell, part) => {
    if (!cell.length) return;
    const [x, y] = [cell[0] * across, cell[1] * down];
    const colour = partColour(part, count);
    const mark = makeSvg("g", { "data-part": part });
    mark.append(makeSvg("rect", { x, y, width: across, height: down, style: `stroke:${isLight() ? "#14181c" : "#fff"}` }));
    if (count > 1) {
      const left = x + across + 3.9 * size > 100 * aspect ? x - 3.9 * size : x + across;
      const top = Math.min(y, 100 - 4.4 * size);
      mark.append(makeSvg("path", { d: `M${left} ${top}h${3.9 * size}v${4.4 * size}h${-3.9 * size}z`, fill: colour }));
      const text = makeSvg("text", { x: left + 1.95 * size, y: top + 3.45 * size, "font-size": 3.5 * size, "font-weight": 700, "text-anchor": "middle", fill: partInk(part, count) });
      text.textContent = part + 1;
      mark.append(text);
    }
    svg.append(mark);
  });
};

const area = ([left, top, right, bottom]) => (right - left) * (bottom - top);

/** Highlight one part in an element, or all parts for -1. */
export const markFocus = (element, focus) => {
  element.classList.toggle("focused", focus >= 0);
  for (const one of element.querySelectorAll("[data-part]")) one.classList.toggle("on", Number(one.dataset.part) === focus);
};

// The heat of a picture is painted once for all of its crops.
const layers = new WeakMap();
const heatLayer = (described, aspect) => {
  const known = layers.get(described);
  if (known?.light === isLight()) return known.canvas;
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [Math.round(160 * aspect), 160];
  paintHeat(canvas.getContext("2d"), canvas.width, canvas.height, described);
  layers.set(described, { light: isLight(), canvas });
  return canvas;
};

/**
 * Draw one part of a picture, enlarged to fill the canvas: grey under its heat, or in full colour.
 * @param {number} turn degrees clockwise by which the picture is turned
 */
export const drawCrop = (canvas, described, part, count, turn, colour, angle = 0) => {
  const pen = canvas.getContext("2d");
  const side = canvas.width;
  pen.clearRect(0, 0, side, side);
  const { parts } = described;
  const image = picture(described.src);
  if (!parts) return;
  const aspect = described.aspect ?? 1;
  let [left, top, right, bottom] = parts.boxes[part];
  const most = (MOST_WIDE * (bottom - top)) / aspect;
  if (right - left > most) [left, right] = [(left + right - most) / 2, (left + right + most) / 2];
  const scale = side / Math.max((right - left) * aspect, bottom - top);
  const [width, height] = [scale * aspect, scale];
  pen.save();
  pen.translate(side / 2 - (width * (left + right)) / 2, side / 2 - (height * (top + bottom)) / 2);
  pen.clip(cellsOf(parts, part, width, height));
  pen.fillStyle = "#000";
  pen.fillRect(0, 0, width, height);
  if (image.complete && image.naturalWidth) {
    if (described.around) {
      const roll = ((((-angle / 360) * width) % width) + width) % width;
      pen.drawImage(image, roll, 0, width, height);
      pen.drawImage(image, roll - width, 0, width, height);
    } else {
      const upright = pen.getTransform();
      pen.translate(width / 2, height / 2);
      pen.rotate((turn * Math.PI) / 180);
      const zoom = described.zoom ?? 1;
      const whole = /** @type {const} */ ([(-zoom * width) / 2, (-zoom * height) / 2, zoom * width, zoom * height]);
      pen.drawImage(image, ...whole);
      pen.beginPath();
      pen.rect(...whole);
      pen.clip();
      pen.setTransform(upright);
    }
  }
  if (!colour && described.heat) {
    // Grey and dim by two layers: filters of a canvas do not exist in all browsers.
    pen.globalCompositeOperation = "saturation";
    pen.fillStyle = "#808080";
    pen.fillRect(0, 0, width, height);
    pen.globalCompositeOperation = "source-over";
    pen.fillStyle = isLight() ? "#ffffff66" : "#00000073";
    pen.fillRect(0, 0, width, height);
    pen.drawImage(heatLayer(described, aspect), 0, 0, width, height);
  }
  pen.restore();
  pen.strokeStyle = count === 1 ? variable("--soft") : partColour(part, count);
  pen.lineWidth = 3;
  pen.strokeRect(1.5, 1.5, side - 3, side - 3);
};
