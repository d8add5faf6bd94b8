// Charts by uPlot, which is loaded with the first one, in the page's colours.

import { load, variable } from "./dom.js";

const FONT = "12px Inter, Helvetica, Arial";
const signed = (text) => text.replace("-", "−");
const drawn = new Map(); // by its box

/**
 * Replace a box's contents by a chart that Python describes; the legend has the values under the pointer.
 * @param {any} box
 * @param {object} chart
 * @param {string} chart.label description for screen readers
 * @param {number[]} chart.x
 * @param {[string, string]} chart.axes names of x and y
 * @param {string} chart.name of x in the legend
 * @param {{label: string, values: any[], colour: string, dash?: boolean}[]} chart.lines `colour` names a variable of the theme
 * @param {[number, string]} [chart.of_y] decimals and unit of the lines' values
 * @param {string[]} [chart.names] of the values of x, which then stand upright
 * @param {boolean} [chart.bars] in place of lines
 * @param {number} [chart.dots] pixels of the points, which then stand alone
 * @param {boolean} [chart.bare] without a legend, and without an axis of x
 * @param {boolean} [chart.roots] y is drawn by its square roots, so that one value far away does not flatten the others
 * @param {boolean} [chart.log_x]
 * @param {boolean} [chart.log_y]
 * @param {boolean} [chart.down] small values of y stand above
 * @param {[number, number]} [chart.range] of y
 * @param {number[]} [chart.ticks] of x
 * @param {number} [chart.mark] a place of x that has a line
 * @param {number} [chart.height]
 * @param {(position: number) => void} pick a point was clicked
 */
export const plot = async (box, chart, pick) => {
  const { default: UPlot } = await load("uplot");
  if (!box.isConnected || !box.clientWidth) return;
  const [ink, soft, line] = ["--ink", "--soft", "--line"].map(variable);
  const [decimals, unit] = chart.of_y ?? [0, ""];
  const ofX = (one) => (one === null ? "" : chart.names ? (chart.names[chart.x.indexOf(one)] ?? "") : signed(String(Number(one.toPrecision(3)))));
  const ofY = (_, one) => (one === null ? "" : signed(one.toFixed(decimals)) + unit);
  const axis = { stroke: soft, font: FONT, labelFont: FONT, labelSize: 18, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1, size: 4 } };
  // On a logarithmic scale, the powers of ten have lines.
  const grid = (log) => ({ ...axis.grid, ...(log ? { filter: (_, splits) => splits.map((one) => (Number.isInteger(Math.log10(one)) ? one : null)) } : {}) });
  const ticks = chart.names ? chart.x : chart.ticks;
  const stand = ({ scales, ctx, bbox, valToPos }) => {
    const { min, max } = scales.x;
    if (chart.mark === undefined || chart.mark === null || chart.mark < min || chart.mark > max) return;
    ctx.fillStyle = ink;
    ctx.fillRect(valToPos(chart.mark, "x", true) - 1, bbox.top, 2, bbox.height);
  };
  const style = (colour) => (chart.dots ? { width: 0, points: { show: true, size: chart.dots, fill: colour } } : chart.bars ? { paths: UPlot.paths.bars({ size: [0.92, 60] }), fill: colour, points: { show: false } } : { points: { size: 5, fill: colour, show: chart.x.length < 60 } });
  const options = {
    width: box.clientWidth,
    height: chart.height ?? 170,
    ...(chart.bare ? { padding: [6, 8, 6, 0] } : {}),
    cursor: { drag: { x: false, y: false }, points: { show: !chart.bare, size: 7 } },
    legend: { show: !chart.bare },
    scales: {
      x: { time: false, distr: chart.log_x ? 3 : 1, ...(chart.log_x ? { range: [chart.x[0], chart.x[chart.x.length - 1]] } : {}) },
      y: { distr: chart.log_y ? 3 : 1, dir: chart.down ? -1 : 1, ...(chart.range ? { range: chart.range } : {}), ...(chart.roots ? ROOTS : {}) },
    },
    axes: [
      { ...axis, show: !chart.bare, grid: grid(chart.log_x && !ticks), label: chart.axes[0] || null, size: 28, values: (_, values) => values.map(ofX), ...(ticks ? { splits: () => ticks, filter: (_, splits) => splits } : {}), ...(chart.names ? { rotate: -60, size: 82 } : {}) },
      { ...axis, grid: grid(chart.log_y), label: chart.axes[1] || null, size: 44, ...(chart.roots ? { space: 22, filter: (_, all) => all, splits: roundOnes, values: (_, all) => all.map((one) => `${one}${unit}`) } : {}) },
    ],
    series: [{ label: chart.name, value: (_, one) => ofX(one) }, ...chart.lines.map(({ label, colour, dash }) => ({ label, stroke: variable(colour), width: 1.75, dash: dash ? [5, 4] : [], value: ofY, ...style(variable(colour)) }))],
    hooks: { draw: [stand] },
  };
  for (const [one, chart] of drawn) {
    if (one !== box && one.isConnected) continue;
    chart.destroy();
    drawn.delete(one);
  }
  const made = new UPlot(options, [chart.x, ...chart.lines.map((one) => one.values)], (shown, init) => {
    box.replaceChildren(shown.root);
    init();
  });
  drawn.set(box, made);
  box.setAttribute("role", "img");
  box.setAttribute("aria-label", chart.label);
  made.over.addEventListener("click", () => made.cursor.idx !== null && pick(chart.x[made.cursor.idx]));
};

const ROOTS = { distr: 100, fwd: Math.sqrt, inv: (value) => value * value, range: (_, low, high) => [0, Math.max(high ?? 0, 1) * 1.1] };
/** The largest round number below the top of the scale, a quarter of it, and 0. */
const roundOnes = ({ scales }) => {
  const top = scales.y.max;
  const power = 10 ** Math.floor(Math.log10(top));
  const round = [5, 2, 1].map((one) => one * power).find((one) => one <= top) ?? top;
  return [0, round / 4, round];
};
