// The page behind the verdict.

import { make, partColour, variable } from "../../page/dom.js";
import { plot } from "./plot.js";

export const open = (box, { view }) => {
  const page = make("div", { class: "why" });
  box.append(page);
  let told = null;
  let light = false;
  const paragraphs = (texts) => texts.map((one) => (typeof one === "string" ? make("p", { text: one }) : make("p", {}, one.href ? make("a", { href: one.href, target: "_blank", rel: "noreferrer", text: one.text }) : one.text)));
  const section = (title, ...content) => make("section", {}, make("h3", { text: title }), ...content);
  const figures = (rows) => make("table", {}, ...rows.map(([name, value, meaning]) => make("tr", {}, make("th", { scope: "row", text: name }), make("td", { text: value }), make("td", { text: meaning }))));

  const draw = () => {
    if (!told) return;
    light = document.documentElement.classList.contains("light");
    const [metres, leads] = [make("div", { class: "chart" }), make("div", { class: "chart" })];
    const ranked = told.error || (told.ranked.length ? `Ranking all photos: ${told.ranked[0]} of ${told.ranked[1]}.` : "");
    const word = view.page.word;
    page.replaceChildren(
      section("What LPN did", ...paragraphs(told.did)),
      section("How good it is here", ...(ranked ? paragraphs([ranked]) : []), figures(told.figures), ...(told.metres ? [metres] : [])),
      section("How found is judged", ...paragraphs(told.judged), make("details", {}, make("summary", { text: "The protocol in full" }), make("p", { text: told.protocol }))),
      section("How sure this answer is", ...paragraphs(told.answer.said), ...(told.leads ? [leads] : [])),
      ...(told.rings ? [section(`What each ${word} adds`, make("p", { text: `Mean of its share of the truth's lead over the best wrong tile. ${word[0].toUpperCase()}${word.slice(1)}s below 0 prefer the wrong tile.` }), rings(told.rings))] : []),
      section("How distances are made", ...paragraphs(told.scored)),
      section("Pictures, credits, licence", ...paragraphs(told.pictures)),
    );
    const colour = variable("--part1");
    if (told.metres)
      plot(metres, {
        label: "Share of photos whose answer lies within so many metres", x: told.metres[0], axes: ["metres from the place to the answer", "% of photos"], name: "metres", logX: true, range: [0, 100],
        lines: [{ label: "photos as near", values: told.metres[1], colour, text: (one) => `${one.toFixed(0)} %` }], text: (one) => `${Number(one.toPrecision(2))}`,
      });
    if (told.leads)
      plot(leads, {
        label: "Share of photos found, by their lead", x: told.leads.map((one) => one[0]), axes: ["lead over the next tile; the line is this photo's", "% found"], name: "lead", dots: true, range: [0, 100],
        lines: [{ label: "found", values: told.leads.map((one) => one[1]), colour, text: (one) => `${one.toFixed(0)} %` }], text: (one) => one.toFixed(2), mark: told.answer.lead,
      });
  };
  const rings = (all) => {
    const count = all.length;
    const most = Math.max(...all.flatMap((one) => [Math.abs(one.found ?? 0), Math.abs(one.missed ?? 0)]), 1e-9);
    const bar = (value, part) => (value === null ? make("td", { text: "none" }) : make("td", {}, make("span", { class: value < 0 ? "bar minus" : "bar" }, make("i", { style: { width: `${(50 * Math.abs(value)) / most}%`, background: partColour(part, count) } })), `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(3)}`));
    const head = ["", "found photos", "missed photos", "adds most in"].map((text) => make("th", { scope: "col", text }));
    return make("table", { class: "rings" }, make("tr", {}, ...head), ...all.map((one, part) => make("tr", {}, make("th", { scope: "row", text: one.name }), bar(one.found, part), bar(one.missed, part), make("td", { text: `${one.most.toLocaleString("en")} photos` }))));
  };
  return {
    receive: (message) => {
      if (JSON.stringify(message) === JSON.stringify(told)) return;
      told = message;
      draw();
    },
    draw: () => {
      if (light !== document.documentElement.classList.contains("light")) draw();
    },
    close: () => page.remove(),
  };
};
