// The timeline of a flight: a value of each frame over time, and a mark that says what may be believed of it.

import { prepare, variable } from "../../page/dom.js";
import { diamond, tell } from "./map.js";

const TURNS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 10, PageDown: -10 };
const EMPTY = { error: "No photo has a tag to compare with.", radius: "No stage tells a radius.", height: "No height is known." };
// How tall the marks of verdicts are, in pixels: placed, in doubt, without a place.
const SIGNS = { true: 9, null: 5, false: 2 };
const [LEFT, RIGHT] = [44, 12];
const REACH = 10;
const FEW = 300; // frames from which on dots are small

export class Timeline {
  /**
   * @param {any} canvas
   * @param {any} tip
   * @param {any} flight what all parts of the panel share, see flight.js
   * @param {(frame: number) => void} choose
   */
  constructor(canvas, tip, flight, choose) {
    this.canvas = canvas;
    this.flight = flight;
    this.choose = choose;
    this.marks = []; // left, top, frame, and why it is in doubt or refused
    const pick = (event) => flight.data && choose(this.nearest(event.offsetX));
    canvas.addEventListener("click", (event) => event.pointerType === "touch" && pick(event));
    canvas.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch") return; // a finger that moves across scrolls the page
      canvas.setPointerCapture(event.pointerId);
      pick(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.pointerType === "touch") return;
      if (canvas.hasPointerCapture(event.pointerId)) pick(event);
      const far = (mark) => Math.hypot(mark[0] - event.offsetX, mark[1] - event.offsetY);
      const mark = this.marks.reduce((best, one) => (far(one) < far(best) ? one : best), [0, -1000, 0, ""]);
      const reason = far(mark) < REACH ? mark[3] : "";
      tell(tip, reason && `${flight.data.names[mark[2]]}. ${reason}`, [mark[0], mark[1]], -2000);
    });
    canvas.addEventListener("pointerleave", () => tell(tip, "", [0, 0]));
    canvas.addEventListener("keydown", (event) => {
      const last = flight.data?.names.length - 1;
      if (event.key in TURNS) flight.step(TURNS[event.key]);
      else if (event.key === "Home" || event.key === "End") choose(event.key === "Home" ? 0 : last);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  across(i) {
    const { times, low, high } = this.flight.span;
    return LEFT + ((this.canvas.clientWidth - LEFT - RIGHT) * (times[i] - low)) / (high - low || 1);
  }
  nearest(left) {
    return this.flight.data.names.reduce((best, _, i) => (Math.abs(this.across(i) - left) < Math.abs(this.across(best) - left) ? i : best), 0);
  }

  draw() {
    const { data, chosen, plot } = this.flight;
    if (!data || !this.canvas.clientWidth) return;
    const { pen, width, height } = prepare(this.canvas);
    const foot = height - 16;
    this.marks = [];
    this.band(pen, width, 8, foot);
    data.signs.forEach((sign, i) => {
      pen.fillStyle = variable({ right: "--right", contradicted: "--wrong", unknown: "--soft" }[data.states[i]]);
      pen.fillRect(this.across(i) - 2, foot + 13 - SIGNS[sign], 4, SIGNS[sign]);
      const reason = sign ? "" : (data.tracks[data.stages[i]]?.reason[i] ?? data.tracks.registration?.reason[i]);
      this.marks.push([this.across(i), foot + 9, i, reason ?? ""]);
    });
    const say = { "aria-valuemax": data.names.length, "aria-valuenow": chosen + 1, "aria-valuetext": data.names[chosen] ?? "your own photo" };
    for (const [name, value] of Object.entries(say)) this.canvas.setAttribute(name, value);
    if (chosen < 0) return;
    pen.strokeStyle = variable("--ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(this.across(chosen), 4);
    pen.lineTo(this.across(chosen), foot + 14);
    pen.stroke();
    this.canvas.dataset.plot = plot;
  }

  /** The lines of the plot, each with values, states (2: refused), and a colour. */
  get lines() {
    const { data, plot, shown } = this.flight;
    if (plot === "height") return [{ name: "", colour: variable("--soft"), values: data.heights, state: [] }];
    const told = shown().filter(([name]) => name !== "tag" && (plot === "error" || !["retrieval", "corrected"].includes(name)));
    return told.map(([name, track]) => ({ name, colour: data.colours[name], values: track[plot], state: track.state }));
  }

  band(pen, width, head, foot) {
    const { data, plot, doubted } = this.flight;
    const values = this.lines.flatMap((one) => one.values.filter((value) => value !== null)).sort((a, b) => a - b);
    const top = values.at(-1) || 1;
    const low = plot === "height" && values.length ? Math.max(values[0] - 0.3 * (top - values[0]) - 1, 0) : 0;
    // One wrong guess far away must not flatten the others: errors are drawn by their square roots.
    const scaled = plot === "height" ? (value) => value : Math.sqrt;
    const level = (value) => foot - ((foot - head) * (scaled(value) - scaled(low))) / (scaled(top) - scaled(low) || 1);
    pen.fillStyle = variable("--soft");
    pen.font = "12px Inter, system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    const ticks = [top, low];
    for (let power = 10 ** Math.floor(Math.log10(top)); plot !== "height" && power >= 0.1; power /= 10)
      for (const value of [5 * power, 2 * power, power]) if (value < top && ticks.every((other) => Math.abs(level(value) - level(other)) >= 15)) ticks.push(value);
    for (const value of ticks) {
      pen.fillText(value.toFixed(value && value < 10 ? 1 : 0) + (value === top ? " m" : ""), LEFT - 4, Math.min(Math.max(level(value), head + 5), foot - 4));
      pen.globalAlpha = 0.25;
      pen.fillRect(LEFT, level(value), width - LEFT - RIGHT, 1);
      pen.globalAlpha = 1;
    }
    pen.textAlign = "center";
    if (!values.length) pen.fillText((plot === "error" && data.elsewhere && `${data.elsewhere}, so they were left out.`) || EMPTY[plot], width / 2, (head + foot) / 2);
    const small = data.names.length > FEW;
    for (const { name, values: known, state, colour } of this.lines)
      known.forEach((value, i) => {
        if (value === null) return;
        const at = [this.across(i), level(value)];
        this.marks.push([...at, i, data.tracks[name]?.reason[i] ?? ""]);
        if (doubted(name, i)) return diamond(pen, at, small ? 3 : 5, data.colours.contradicted);
        pen.fillStyle = pen.strokeStyle = colour;
        pen.beginPath();
        pen.arc(at[0], at[1], small ? 1.5 : 2.5, 0, 7);
        pen.lineWidth = 1;
        if (state[i] === 2) pen.stroke();
        else {
          pen.fill();
          pen.strokeStyle = "rgba(0,0,0,.5)"; // light colours on light ground
          pen.stroke();
        }
      });
  }
}
