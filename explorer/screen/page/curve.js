// The curve under the photo: the truth's rank, or the nearest distance, against the angle.

import { find, make, shown, turned } from "./dom.js";

/** @returns {number} the angle at a place of the curve, in CSS pixels from its left edge */
export const angleAt = (plot, x) => Math.max(-180, Math.min(180, Math.round((x / plot.clientWidth) * 360 - 180)));

/**
 * Draw the curve.
 * @param {any} box
 * @param {any[]} points angle, rank or null, and distance of each
 * @param {any} result of the shown angle
 * @param {number} angle at which the line stands
 * @param {boolean} stale the result is not yet that of the angle
 * @param {number | null} hovered the angle under the pointer
 */
export const drawCurve = (box, points, result, angle, stale, hovered) => {
  const ranked = result.rank !== null && result.headline.found !== null;
  const value = (point) => (ranked ? (point[1] ?? 1) : point[2]);
  const own = [result.angle, result.rank, Number(result.nearest)];
  const known = points.length > 1 ? points : [own];
  const most = ranked ? Math.max(6, ...known.map(value), value(own)) : result.scale.total;
  const left = (degrees) => `${(degrees + 180) / 3.6}%`;
  const down = (point) => 100 * (ranked ? Math.log(value(point)) / Math.log(most) : 1 - Math.min(value(point) / most, 1));
  const sign = (point) => (!ranked ? "" : value(point) === 1 ? "right" : "wrong");
  const dot = (point, kind = "") => make("i", { class: `${kind} ${sign(point)}`, style: { left: left(point[0]), top: `${down(point)}%` } });
  // The curve is closed: 180 degrees are -180.
  const closed = known.length > 1 && known[0][0] === -180 ? [...known, [180, ...known[0].slice(1)]] : known;
  const texts = { first: ranked ? "rank 1" : "", middle: ranked ? "" : "distance", last: ranked && known.some((one) => value(one) > 1) ? most : "", now: stale ? "" : ranked ? result.rank : shown(own[2]) };
  for (const [name, text] of Object.entries(texts)) find(`.${name}`, box).textContent = text;
  find(".now", box).className = `now ${sign(own)}`;
  find("polyline", box).setAttribute("points", closed.map((point) => `${point[0]},${down(point)}`).join(" "));
  find(".dots", box).replaceChildren(...closed.map((point) => dot(point)), ...(stale ? [] : [dot(own, "own")]));
  find(".line", box).style.left = left(angle);
  box.setAttribute("aria-label", `Rank against angle; at ${angle}°: ${result.rank ?? "not known"}`);
  const told = find(".value", box);
  told.hidden = hovered === null;
  if (hovered !== null) {
    const near = closed.reduce((best, one) => (Math.abs(one[0] - hovered) < Math.abs(best[0] - hovered) ? one : best));
    told.textContent = `${turned(near[0])}: ${ranked ? `rank ${value(near)}` : shown(near[2])}`;
    told.style.left = left(near[0]);
  }
  // The whole panorama lies behind its curve, with a frame around the part that the photo shows.
  const whole = find(".whole", box);
  whole.hidden = !result.photo.around;
  if (whole.hidden) return;
  whole.style.backgroundImage = `url("${result.photo.src}")`;
  const wide = 100 / result.photo.aspect;
  whole.replaceChildren(...[-360, 0, 360].map((turn) => make("u", { style: { width: `${wide}%`, left: `calc(${left(angle + turn)} - ${wide / 2}%)` } })));
};
