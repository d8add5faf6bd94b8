// The timeline of a flight, by uPlot: how far each photo's answer lies from its tag, in the colour of its state.

import { find, make, variable } from "../../page/dom.js";

const LIBRARY = "../../vendor/uplot.js"; // which has no types
const TURNS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 10, PageDown: -10 };
export const INK = { right: "--right", contradicted: "--wrong", unknown: "--soft" };
const HEIGHT = 96;

export class Timeline {
  /**
   * @param {any} box
   * @param {any} flight what all parts of the panel share, see flight.js
   * @param {(frame: number) => void} choose
   */
  constructor(box, flight, choose) {
    this.box = box;
    this.flight = flight;
    this.choose = choose;
    this.plot = null;
    this.data = null; // the flight that is drawn
    this.drawn = "";
    const style = "screen/vendor/uplot.css";
    if (!find(`link[href="${style}"]`)) document.head.append(make("link", { rel: "stylesheet", href: style }));
    this.library = import(LIBRARY).then((module) => module.default);
    box.addEventListener("keydown", (event) => {
      const last = flight.data?.names.length - 1;
      if (event.key in TURNS) flight.step(TURNS[event.key]);
      else if (event.key === "Home" || event.key === "End") choose(event.key === "Home" ? 0 : last);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    new ResizeObserver(() => this.plot?.setSize({ width: box.clientWidth, height: HEIGHT })).observe(box);
  }

  async draw() {
    const { data, chosen } = this.flight;
    if (!data) return;
    const say = { "aria-valuemax": data.names.length, "aria-valuenow": chosen + 1, "aria-valuetext": data.names[chosen] ?? "your own photo" };
    for (const [name, value] of Object.entries(say)) this.box.setAttribute(name, value);
    const UPlot = await this.library;
    if (!this.box.isConnected || !this.box.clientWidth) return;
    const drawn = `${document.documentElement.className}`;
    if (this.plot && this.data === this.flight.data && this.drawn === drawn) return this.plot.redraw(false);
    [this.data, this.drawn] = [this.flight.data, drawn];
    this.plot?.destroy();
    this.plot = new UPlot(this.options(this.flight.data), this.series(this.flight.data), this.box);
    this.plot.over.addEventListener("click", (event) => this.choose(this.nearest(event.offsetX)));
  }

  close() {
    this.plot?.destroy();
    this.plot = null;
  }

  /** Errors, or radii where no photo has a tag, by state; a photo without a place lies on the ground line. */
  series(data) {
    const radii = data.stages.map((stage, i) => data.tracks[stage]?.radius[i] ?? null);
    const values = (data.errors.some((error) => error !== null) ? data.errors : radii).map((value, i) => (data.marks[i] === "✗" ? 0 : value)); // a guess may lie far away
    return [data.times ?? data.names.map((_, i) => i), ...Object.keys(data.words).map((word) => values.map((value, i) => (data.states[i] === word ? value : null)))];
  }
  nearest(left) {
    const [times] = this.plot.data;
    const at = this.plot.posToVal(left, "x");
    return times.reduce((best, time, i) => (Math.abs(time - at) < Math.abs(times[best] - at) ? i : best), 0);
  }

  options(data) {
    const [soft, line] = ["--soft", "--line"].map(variable);
    const axis = { stroke: soft, font: "12px Inter, Helvetica, Arial", grid: { stroke: line, width: 1 }, ticks: { show: false } };
    const small = data.names.length > 300 ? 4 : 7;
    const points = Object.keys(data.words).map((word) => ({ stroke: variable(INK[word]), width: 0, points: { show: true, size: small, fill: variable(INK[word]) } }));
    const mark = (plot) => {
      const [from, to] = [plot.scales.x.min, plot.scales.x.max];
      const time = plot.data[0][this.flight.chosen];
      if (time === undefined || time < from || time > to) return;
      plot.ctx.fillStyle = variable("--ink");
      plot.ctx.fillRect(plot.valToPos(time, "x", true) - 1, plot.bbox.top - 4, 2, plot.bbox.height + 8);
    };
    return {
      width: this.box.clientWidth,
      height: HEIGHT,
      padding: [6, 8, 6, 0],
      legend: { show: false },
      cursor: { y: false, drag: { x: false, y: false }, points: { show: false } },
      // One wrong place far away must not flatten the others: metres are drawn by their square roots.
      scales: { x: { time: false }, y: { distr: 100, fwd: Math.sqrt, inv: (value) => value * value, range: (_, low, high) => [0, Math.max(high ?? 0, 1) * 1.1] } },
      axes: [{ show: false }, { ...axis, size: 44, space: 22, filter: (_, all) => all, splits: (plot) => splits(plot.scales.y.max), values: (_, all) => all.map((value) => `${value} m`) }],
      series: [{}, ...points],
      hooks: { draw: [mark] },
    };
  }
}

/** The largest round number below the top of the scale, a quarter of it, and 0. */
const splits = (top) => {
  const power = 10 ** Math.floor(Math.log10(top));
  const round = [5, 2, 1].map((one) => one * power).find((one) => one <= top) ?? top;
  return [0, round / 4, round];
};
