// Charts of margins and ranks by uPlot, and cards of what is missed: a click on a line of a card sets the filter.

import { find, make, partColour, variable } from "../../page/dom.js";
import { load } from "./vendor.js";

const HEIGHT = 130; // pixels

export class Charts {
  constructor(box, set) {
    this.box = box;
    this.message = this.head = null;
    this.plots = [];
    this.drawn = [];
    this.ready = load("uplot").then((module) => (this.made = module.default));
    box.addEventListener("click", (event) => {
      const line = event.target.closest("[data-line]");
      if (line) set(this.message.cards[line.dataset.card].lines[line.dataset.line].click);
    });
    this.watch = new ResizeObserver(() => this.draw(this.theme));
    this.watch.observe(box);
  }

  close() {
    this.watch.disconnect();
    for (const plot of this.plots) plot.destroy();
  }

  show(message) {
    this.message = message;
    this.draw(this.theme);
  }

  async draw(theme) {
    this.theme = theme;
    await this.ready;
    const { message, box } = this;
    const from = [message, theme, box.clientWidth];
    if (!message || !box.clientWidth || from.every((one, at) => one === this.drawn[at])) return;
    this.drawn = from;
    const top = box.scrollTop;
    const focused = /** @type {any} */ (document.activeElement)?.dataset ?? {};
    this.close();
    this.watch.observe(box);
    const plots = make("div", { class: "plots" });
    box.replaceChildren(make("p", { text: message.sentence }), plots, ...message.cards.map((card, number) => this.card(card, number)));
    this.plots = [this.margins(plots), this.recall(plots)].filter(Boolean);
    box.scrollTop = top;
    if (focused.line) find(`[data-card="${focused.card}"][data-line="${focused.line}"]`, box)?.focus();
  }

  options(title, extra) {
    const axis = { stroke: variable("--soft"), grid: { stroke: variable("--line"), width: 1 }, ticks: { show: false }, font: "12px Inter, Arial", size: 34 };
    const width = Math.max(240, Math.floor(this.box.clientWidth - 12));
    return { width, height: HEIGHT, legend: { show: false }, cursor: { y: false, points: { show: false } }, ...extra, axes: [{ ...axis, size: 26, ...extra.axes?.[0] }, { ...axis, ...extra.axes?.[1] }] };
  }

  plot(box, title, options, data) {
    const figure = box.appendChild(make("figure", { "aria-label": title }, make("figcaption", { text: title })));
    return new this.made(options, data, figure);
  }

  /** Bars of the margins: missed ones at the left of 0, found ones at its right. */
  margins(box) {
    const { at, found, missed } = this.message.margins;
    const bars = this.made.paths.bars({ size: [0.92, 60] });
    const series = (name, colour) => ({ label: name, paths: bars, fill: variable(colour), stroke: variable(colour), points: { show: false } });
    const options = this.options("", { scales: { x: { time: false } }, series: [{}, series("✓ found", "--right"), series("✗ missed", "--wrong")] });
    return this.plot(box, "Photos by margin (d²): ✗ missed below 0, ✓ found above", options, [at, found, missed]);
  }

  /** The share of queries whose truth is among the first k tiles, on a logarithmic scale of k. */
  recall(box) {
    const { k, models, percent } = this.message.recall;
    if (!k.length) return null;
    const lines = [{ stroke: variable("--ink"), width: 2 }, { stroke: variable("--part1"), width: 2, dash: [5, 4] }];
    const options = this.options("", {
      scales: { x: { time: false, distr: 3, range: [1, k.at(-1)] }, y: { range: [10 * Math.floor(Math.min(...percent.flat()) / 10 - 0.01), 100] } },
      series: [{}, ...models.map((label, number) => ({ label, points: { show: false }, ...lines[number] }))],
      axes: [{ values: (_, splits) => splits.map((one) => (Math.log10(one) % 1 === 0 ? one : "")) }, {}],
    });
    const names = models.length > 1 ? `: A (line) ${models[0]}, B (dashes) ${models[1]}` : "";
    return this.plot(box, `Percent of photos with the truth among the first k tiles${names}`, options, [k, ...percent]);
  }

  card({ title, about, term, lines }, card) {
    return make("section", { class: "card" },
      make("h3", {}, term ? make("span", { class: "term", tabindex: 0, text: title, "data-term": term }) : title, about ? make("small", { text: ` ${about}` }) : ""),
      ...lines.map((line, number) => make("button", { class: "bar-line", "data-card": card, "data-line": number, "aria-pressed": String(line.chosen), title: line.hint ?? "" }, ...this.line(line))));
  }

  line({ text, part, tiles, count, value, share, low, high, overall }) {
    const pictures = (tiles ?? []).filter((one) => one >= 0).map((one) => make("img", { src: `${this.head.thumbnails[1]}${one}`, alt: "" }));
    const swatch = part === undefined ? "" : make("i", { class: "swatch", style: { background: partColour(part, 2) } });
    const percent = (number) => `${100 * number}%`;
    const bar = share === undefined ? "" : make("span", { class: "track" },
      make("i", { style: { width: percent(share), background: part === undefined ? variable("--wrong") : partColour(part, 2) } }),
      ...(low === undefined ? [] : [make("u", { style: { left: percent(low), width: percent(high - low) } }), make("s", { style: { left: percent(overall) } })]));
    return [make("span", { class: "words" }, ...pictures, swatch, text), bar, make("b", { text: value ?? count })];
  }
}
