// The curve under the photo: the truth's rank, or the nearest distance, against the angle.

import { picture, prepare, shown, variable } from "./dom.js";

const LEFT = 52;
const RIGHT = 46;
const FONT = "Inter, Helvetica, Arial";

/** @returns {number} the angle at a place of the curve, in CSS pixels from its left edge */
export const angleAt = (canvas, x) => Math.max(-180, Math.min(180, Math.round(((x - LEFT) / (canvas.clientWidth - LEFT - RIGHT)) * 360 - 180)));

/**
 * Draw the curve.
 * @param {any[]} points angle, rank or null, and distance of each
 * @param {any} result of the shown angle
 * @param {number} angle at which the line stands
 * @param {boolean} stale the result is not yet that of the angle
 */
export const drawCurve = (canvas, points, result, angle, stale) => {
  const { pen, width, height } = prepare(canvas);
  if (!width) return;
  const ranked = result.rank !== null && result.headline.found !== null;
  const value = (point) => (ranked ? (point[1] ?? 1) : point[2]);
  const own = [result.angle, result.rank, Number(result.nearest)];
  const known = points.length > 1 ? points : [own];
  const most = ranked ? Math.max(6, ...known.map(value), value(own)) : result.scale.total;
  const right = width - RIGHT;
  const x = (degrees) => LEFT + ((degrees + 180) / 360) * (right - LEFT);
  const y = (one) => (ranked ? 7 + (Math.log(one) / Math.log(most)) * (height - 26) : height - 19 - (Math.min(one / most, 1)) * (height - 26));
  if (result.photo.around) drawWhole(pen, result.photo, x, angle, height);
  const [soft, ink, good, bad] = ["--soft", "--ink", "--right", "--wrong"].map(variable);
  pen.font = `12px ${FONT}`;
  pen.textBaseline = "middle";
  pen.fillStyle = soft;
  pen.textAlign = "right";
  if (ranked) {
    pen.strokeStyle = variable("--line");
    pen.beginPath();
    pen.moveTo(LEFT, y(1) + 0.5);
    pen.lineTo(right, y(1) + 0.5);
    pen.stroke();
    pen.fillText("rank 1", LEFT - 8, y(1));
    if (known.some((point) => value(point) > 1)) pen.fillText(String(most), LEFT - 8, y(most));
  } else pen.fillText("distance", LEFT - 2, height / 2 - 6);
  pen.textAlign = "center";
  for (const degrees of [-180, -90, 0, 90, 180]) pen.fillText(`${degrees < 0 ? "−" : ""}${Math.abs(degrees)}°`, x(degrees), height - 5);
  // The curve is closed: 180 degrees are -180.
  const closed = known.length > 1 && known[0][0] === -180 ? [...known, [180, ...known[0].slice(1)]] : known;
  pen.strokeStyle = soft;
  pen.lineWidth = 1.25;
  pen.beginPath();
  closed.forEach((point, at) => pen[at ? "lineTo" : "moveTo"](x(point[0]), y(value(point))));
  pen.stroke();
  for (const point of closed) mark(pen, x(point[0]), y(value(point)), ranked ? value(point) === 1 : null, { soft, good, bad });
  pen.strokeStyle = ink;
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(x(angle), 1);
  pen.lineTo(x(angle), height - 13);
  pen.stroke();
  if (stale) return;
  pen.fillStyle = ink;
  pen.beginPath();
  pen.arc(x(angle), y(value(own)), 4.5, 0, 7);
  pen.fill();
  mark(pen, x(angle), y(value(own)), ranked ? value(own) === 1 : null, { soft, good, bad });
  pen.textAlign = "right";
  pen.font = `600 15px ${FONT}`;
  pen.fillStyle = ranked ? (value(own) === 1 ? good : bad) : ink;
  pen.fillText(ranked ? String(result.rank) : shown(own[2]), width, 17);
};

/** The whole panorama behind its curve: the line stands in the middle of what the photo shows of it. */
const drawWhole = (pen, photo, x, angle, height) => {
  const image = picture(photo.src);
  const [left, right, low] = [x(-180), x(180), height - 14];
  if (!image.complete || !image.naturalWidth) return;
  pen.save();
  pen.beginPath();
  pen.rect(left, 0, right - left, low);
  pen.clip();
  pen.globalAlpha = 0.4;
  pen.drawImage(image, left, 0, right - left, low);
  pen.globalAlpha = 1;
  pen.strokeStyle = variable("--ink");
  const wide = (right - left) / photo.aspect;
  for (const turn of [-360, 0, 360]) pen.strokeRect(x(angle + turn) - wide / 2, 0.5, wide, low - 1);
  pen.restore();
};

/** A point: a dot for the first rank or where no truth is known, a square for another. */
const mark = (pen, x, y, first, { soft, good, bad }) => {
  pen.beginPath();
  pen.fillStyle = first === null ? soft : first ? good : bad;
  if (first === false) pen.rect(x - 2.2, y - 2.2, 4.4, 4.4);
  else pen.arc(x, y, first === null ? 2 : 3, 0, 7);
  pen.fill();
};
