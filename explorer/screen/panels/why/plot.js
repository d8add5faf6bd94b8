// Line charts by uPlot, which is loaded with the first one, in the page's colours.

import { find, make, variable } from "../../page/dom.js";

const FONT = "12px Inter, Helvetica, Arial";
const LIBRARY = "../../vendor/uplot.js"; // TypeScript reads no module that a constant names
const STYLE = "screen/vendor/uplot.css";
const load = async () => {
  if (!find(`link[href="${STYLE}"]`)) document.head.append(make("link", { rel: "stylesheet", href: STYLE }));
  return (await import(LIBRARY)).default;
};

/**
 * Draw lines in a box, in place of what it holds; the legend has the values under the pointer.
 * @param {any} box
 * @param {object} chart
 * @param {string} chart.label what the chart shows, for screen readers
 * @param {number[]} chart.x
 * @param {[string, string]} chart.axes what x and y are
 * @param {string} chart.name of x in the legend
 * @param {boolean} [chart.dots] points are drawn
 * @param {{label: string, values: any[], colour: string, dash?: number[], text?: (value: number) => string}[]} chart.lines
 * @param {(value: number) => string} [chart.text] of a value of x
 * @param {boolean} [chart.logX]
 * @param {boolean} [chart.logY]
 * @param {boolean} [chart.down] small values of y stand above
 * @param {[number, number]} [chart.range] of y
 * @param {number[]} [chart.ticks] of x
 * @param {boolean} [chart.turned] long texts of x stand upright
 * @param {number} [chart.mark] a place of x that has a line
 * @param {number} [chart.height]
 * @param {(position: number) => void} [chart.pick] a point was clicked
 */
export const plot = async (box, chart) => {
  const UPlot = await load();
  if (!box.isConnected || !box.clientWidth) return;
  const [ink, soft, line] = ["--ink", "--soft", "--line"].map(variable);
  const text = chart.text ?? String;
  const axis = { stroke: soft, font: FONT, labelFont: FONT, labelSize: 18, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1, size: 4 } };
  // Of a logarithmic scale, the powers of ten have lines.
  const lined = (log) => (log ? { filter: (_, splits) => splits.map((one) => (Number.isInteger(Math.log10(one)) ? one : null)) } : {});
  const stand = (drawn) => {
    if (chart.mark === undefined || chart.mark < drawn.scales.x.min || chart.mark > drawn.scales.x.max) return;
    const [at, { top, height }] = [drawn.valToPos(chart.mark, "x", true), drawn.bbox];
    drawn.ctx.fillStyle = ink;
    drawn.ctx.fillRect(at - 1, top, 2, height);
  };
  const made = new UPlot(
    {
      width: box.clientWidth,
      height: chart.height ?? 170,
      cursor: { drag: { x: false, y: false }, points: { size: 7 } },
      legend: { live: true },
      scales: { x: { time: false, distr: chart.logX ? 3 : 1, ...(chart.logX ? { range: [chart.x[0], chart.x[chart.x.length - 1]] } : {}) }, y: { distr: chart.logY ? 3 : 1, dir: chart.down ? -1 : 1, ...(chart.range ? { range: chart.range } : {}) } },
      axes: [
        { ...axis, grid: { ...axis.grid, ...lined(chart.logX) }, ...(chart.axes[0] ? { label: chart.axes[0] } : {}), size: 28, values: (_, values) => values.map((one) => (one === null ? "" : text(one))), ...(chart.ticks ? { splits: () => chart.ticks, filter: (_, splits) => splits, grid: axis.grid } : {}), ...(chart.turned ? { rotate: -60, size: 82 } : {}) },
        { ...axis, grid: { ...axis.grid, ...lined(chart.logY) }, label: chart.axes[1], size: 44 },
      ],
      series: [
        { label: chart.name, value: (_, one) => (one === null ? "" : text(one)) },
        ...chart.lines.map(({ label, colour, dash, text: said }) => ({ label, stroke: colour, width: 1.75, dash, points: { size: 5, fill: colour, show: chart.dots ?? false }, value: (_, one) => (one === null ? "" : said ? said(one) : String(one)) })),
      ],
      hooks: { draw: [stand] },
    },
    [chart.x, ...chart.lines.map((one) => one.values)],
    (drawn, init) => {
      box.replaceChildren(drawn.root);
      init();
    },
  );
  box.setAttribute("role", "img");
  box.setAttribute("aria-label", chart.label);
  if (chart.pick) made.over.addEventListener("click", () => made.cursor.idx !== null && chart.pick(made.cursor.idx));
};
