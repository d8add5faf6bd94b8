// The truth against the answer, and a second model beside the first.

import { find, make, partColour } from "../../page/dom.js";
import { makePicture, rollPicture, showPicture } from "../../page/pictures.js";
import { sign, stack } from "../../page/rows.js";

const PLACES = ["st", "nd", "rd"];
const ordinal = (rank) => `${rank}${Math.floor(rank / 10) % 10 === 1 ? "th" : (PLACES[(rank % 10) - 1] ?? "th")}`;

export const open = (box, { set, act, view }) => {
  const [pair, models] = [make("section", { class: "pair" }), make("section", { class: "models" })];
  const page = make("div", { class: "compare fade" }, pair, models);
  box.append(page);
  const told = { pair: null, models: null };
  const lines = (texts) => texts.filter(Boolean).map((text) => make("p", { text }));

  const drawPair = () => {
    const { said, rows, change, weights, effect, trying, photo, places, account } = told.pair;
    const several = rows.length > 1;
    pair.replaceChildren(make("h3", { text: "The two tiles of the verdict" }), ...lines(said));
    if (!rows.length) return;
    if (several) {
      const moved = rows.some((row) => row.then);
      const head = [view.page.word, "prefers", "rank without it", "by it alone", ...(moved ? ["weights, %"] : [])];
      pair.append(make("table", {}, make("tr", {}, ...head.map((text) => make("th", { scope: "col", text }))), ...rows.map((row, part) => {
        const prefers = row.prefers === null ? (row.minus ? "−" : "+") : row.prefers ? "✓ " : "✗ ";
        const ranks = [row.without, row.alone].map((rank) => make("td", { text: rank === null ? "none" : ordinal(rank) }));
        return make("tr", {}, make("th", { scope: "row" }, make("i", { class: "dot", style: { background: partColour(part, rows.length) } }), row.name),
          make("td", { class: row.prefers === null ? "" : row.prefers ? "right" : "wrong", text: prefers + row.gain }), ...ranks, ...(moved ? [make("td", { text: row.then ? `${row.now} → ${row.then}` : row.now })] : []));
      })));
      pair.append(...lines([change]));
    }
    if (weights.length) {
      const actions = make("div", { class: "actions" }, make("button", { class: "button", text: "Use these weights" }));
      find("button", actions).onclick = () => set({ weights });
      if (trying) actions.append(make("span", { text: "Ranking all photos" }));
      else if (!effect.length) {
        const trial = make("button", { class: "button", text: "Try on all photos" });
        trial.onclick = () => set({ compare_tried: "yes" });
        actions.append(trial);
      }
      pair.append(actions, ...lines(effect));
    }
    if (account) {
      const head = [view.page.word, "cells for", "cells against", "constant", "sum"].map((text) => make("th", { scope: "col", text }));
      const body = account.parts.map((terms, part) => make("tr", {}, make("th", { scope: "row", text: rows[part].name }), ...terms.map((text) => make("td", { text }))));
      pair.append(make("details", {}, make("summary", { text: "The exact account of the answer" }), make("table", {}, make("tr", {}, ...head), ...body), ...lines(account.said)));
    }
    if (!photo) return;
    const figure = makePicture();
    pair.append(figure, ...lines([places]));
    const shown = { ...view.result.photo, ...photo };
    showPicture(figure, shown, view.focus, view.page.parts, "none", "The photo, painted by what its places speak for");
    rollPicture(figure, shown, view.result.angle);
  };

  const drawModels = () => {
    const all = told.models;
    models.hidden = !all;
    if (!all) return;
    models.replaceChildren(make("h3", { text: "A second model" }));
    if (all.labels.length > 2) {
      const choice = make("select", { class: "field", "aria-label": "Second model" }, ...all.labels.map((text, value) => make("option", { text, value, disabled: value === all.own })));
      choice.value = all.other;
      choice.onchange = () => set({ compare_model: choice.value });
      models.append(choice);
    }
    models.append(...lines([all.text, all.unlike]));
    if (all.again) {
      const again = make("button", { class: "button", text: "Try again" });
      again.onclick = () => act("again");
      models.append(again);
    }
    if (!all.columns) return;
    models.append(make("div", { class: "columns" }, ...all.columns.map(column)));
    if (!all.alone) return models.append(...lines([all.text ? "" : "All photos are still being ranked by both models."]));
    const [count, mine, theirs] = all.alone;
    const [one, other] = all.columns.map((of) => of.model);
    models.append(...lines([`Of ${count.toLocaleString("en")} photos, ${one} alone finds ${mine.toLocaleString("en")}, and ${other} alone ${theirs.toLocaleString("en")}.`]),
      ...photos(`${other} ranks better: truth by ${one} → by ${other}`, all.better), ...photos(`${other} ranks worse`, all.worse));
  };
  const column = ({ model, parts, recall, sign: found, rank, headline, tiles }) => {
    const most = Math.max(...tiles.map((tile) => Number(tile.distance)), 1e-9);
    const verdict = found === null ? "" : make("b", { class: found ? "right" : "wrong", text: found ? "✓ Found" : `✗ Missed${rank && `, truth ${rank}`}` });
    return make("div", { class: "column" }, make("h4", { text: model }), make("p", { text: `${parts}${recall && `, R@1 ${recall}`}` }), make("p", {}, verdict), make("p", { text: headline }),
      ...tiles.map((tile) => {
        const image = make("u", { class: "image", style: tile.src ? { "background-image": `url("${tile.src}")` } : {} });
        const button = make("button", { class: "one", title: `Compare ${tile.name}`, "aria-label": `${tile.rank}: ${tile.name}, distance ${tile.distance}` },
          image, make("span", {}, `${tile.rank} `, sign(tile.true), ` ${tile.name}`), make("span", { text: tile.distance }), stack(tile, most, 12));
        button.disabled = !tile.src;
        button.onclick = () => set({ compare: tile.index });
        return button;
      }));
  };
  const photos = (title, list) => (!list.length ? [] : [make("h4", { text: title }), make("div", { class: "photos" }, ...list.map(({ query, name, src, ranks }) => make("button", { "data-query": query, title: name }, make("u", { class: "image", style: { "background-image": `url("${src}")` } }), make("span", { text: `${ranks[0]} → ${ranks[1]}` }))))]);

  /** @type {any[]} */
  let drawn = [];
  return {
    receive: (message) => {
      Object.assign(told, message);
      if (message.pair && view.result) drawPair();
      if ("models" in message) drawModels();
    },
    draw: () => {
      const now = [view.result, view.focus, view.state?.theme];
      if (!told.pair || !view.result || now.every((one, at) => one === drawn[at])) return;
      drawn = now;
      drawPair();
      if (told.models) drawModels();
    },
    close: () => page.remove(),
  };
};
