// The timeline of a flight: the distance from each photo's answer to its tag, in the colour of its state.

import { make } from "../../page/dom.js";
import { plot } from "../../page/plot.js";

const TURNS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 10, PageDown: -10 };
const INK = { right: "--right", contradicted: "--wrong", unknown: "--soft" };

/**
 * @param {any} box
 * @param {any} flight the state that all parts of the panel share, see flight.js
 * @param {(frame: number) => void} choose
 * @returns {() => void} draws it anew
 */
export const makeTimeline = (box, flight, choose) => {
  const chart = box.appendChild(make("div"));
  const draw = () => {
    const { data, chosen } = flight;
    if (!data) return;
    const say = { "aria-valuemax": data.names.length, "aria-valuenow": chosen + 1, "aria-valuetext": data.names[chosen] ?? "your own photo" };
    for (const [name, value] of Object.entries(say)) box.setAttribute(name, value);
    const times = data.times ?? data.names.map((_, i) => i);
    const words = Object.keys(data.words);
    const lines = words.map((word) => ({ label: word, colour: INK[word], values: values(data).map((value, i) => (data.states[i] === word ? value : null)) }));
    plot(chart, {
      label: "Photos by time", name: "", axes: ["", ""], x: times, lines, dots: data.names.length > 300 ? 4 : 7,
      of_y: [0, " m"], roots: true, bare: true, height: 96, mark: times[chosen],
    }, (time) => choose(times.indexOf(time)));
  };
  box.addEventListener("keydown", (event) => {
    if (event.key in TURNS) flight.step(TURNS[event.key]);
    else if (event.key === "Home" || event.key === "End") choose(event.key === "Home" ? 0 : flight.data?.names.length - 1);
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  new ResizeObserver(draw).observe(box);
  return draw;
};

/** Draw errors, or radii if no photo has a tag. A photo without a place lies on the base line, as a guess may be far off. */
const values = (data) => {
  const radii = data.stages.map((stage, i) => data.tracks[stage]?.radius[i] ?? null);
  return (data.errors.some((error) => error !== null) ? data.errors : radii).map((value, i) => (data.marks[i] === "✗" ? 0 : value));
};
