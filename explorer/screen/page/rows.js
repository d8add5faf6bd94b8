// The row of each ring, the two sums, and the strip of the nearest tiles.

import { find, findAll, make, partColour, partInk, shown } from "./dom.js";
import { drawCrop } from "./pictures.js";
import { hide, tip } from "./terms.js";

export const sign = (true_) => (true_ === null ? "" : make("i", { class: true_ ? "right" : "wrong", text: true_ ? "✓" : "✗" }));

/** The stacked shares of a tile, as segments as wide as their shares on the one scale. */
const stack = (tile, total, least) => {
  const count = tile.shares.length;
  const sum = tile.shares.reduce((one, other) => one + other, 0);
  const segments = tile.shares.map((share, part) => {
    const width = (100 * Math.max(share, 0)) / Math.max(total, sum); // all parts stay visible
    const colour = partColour(part, count);
    const number = count > 1 && width >= least ? String(part + 1) : "";
    return make("i", { "data-part": part, text: number, style: { width: `${width}%`, background: colour, color: partInk(part, count) } });
  });
  return make("div", { class: sum > total ? "stack cut" : "stack", title: sum > total ? "Longer than the scale" : null }, ...segments);
};

/** Make the rows of `count` parts once. */
const layRows = (rows, count) => {
  if (rows.dataset.parts === String(count)) return;
  rows.dataset.parts = count;
  document.documentElement.style.setProperty("--parts", count);
  rows.classList.toggle("many", count > 6);
  const row = (part) => {
    const made = find("#row").content.firstElementChild.cloneNode(true);
    made.dataset.part = find(".number", made).dataset.weight = part;
    find(".number", made).setAttribute("aria-label", `Weight of part ${part + 1}`);
    return made;
  };
  rows.replaceChildren(make("div", { class: "head" }), ...Array.from({ length: count }, (_, part) => row(part)), make("p", { class: "beside" }));
};

/** Show the words over the rows; unchanged words stay, because the user may be reading their tips. */
const showHead = (head, page, result) => {
  const { rival_word: word, headline: { found }, tiles, weights } = result;
  const rival = tiles[result.rival];
  const end = Number(result.scale.part.toFixed(2));
  const prefers = result.rows.some((one) => one.prefers !== null);
  const said = JSON.stringify([page.photo, page.word, tiles[result.answer].true, rival?.true, word, found === null, end, prefers, weights.length]);
  if (head.dataset.said === said) return;
  head.dataset.said = said;
  const meaning = { truth: "the true tile", next: found === null ? "the next one" : "the nearest wrong one", pinned: "the one that you clicked" }[word];
  const gains = prefers ? `✓: the ${page.word} is nearer to the true tile than to the wrong one, by so much. ✗: the wrong tile is nearer.` : `By how much the answer is nearer in this ${page.word}.`;
  const focused = findAll(".term", head).indexOf(document.activeElement);
  hide();
  head.replaceChildren(
    make("span", { text: page.photo }),
    make("span", { text: "answer " }, sign(tiles[result.answer].true)),
    make("span", {}, ...(rival ? [make("u", { ...tip(`The tile that the answer is compared with: ${meaning}. Its shares are hatched.`), text: word }), " ", sign(rival.true), " ", make("u", { class: "hatched" })] : [])),
    make("span", {}, make("u", { ...tip(`Each ${page.word}'s share of the squared distance: that between its two descriptors. All bars end at ${end}.`), text: `share to ${end}` }),
      weights.length ? make("button", { class: "reset", "data-equal": true, text: "equal weights" }) : rival ? make("i", { ...tip(gains), text: prefers ? "prefers" : "nearer" }) : ""),
  );
  findAll(".term", head)[focused]?.focus({ preventScroll: true });
};

/** Show the rows of a result. */
export const showRows = (rows, page, result, colour) => {
  const count = page.parts;
  layRows(rows, count);
  const answer = result.tiles[result.answer];
  const rival = result.rival === null ? null : result.tiles[result.rival];
  showHead(find(".head", rows), page, result);
  findAll(".row", rows).forEach((row, part) => {
    const [photo, own, other] = findAll("canvas", row);
    drawCrop(photo, result.photo, part, count, -result.angle, colour, result.angle);
    drawCrop(own, answer, part, count, -90 * answer.quarter, colour);
    if (rival) drawCrop(other, rival, part, count, -90 * rival.quarter, colour);
    else other.getContext("2d").clearRect(0, 0, other.width, other.height);
    const tone = partColour(part, count);
    const number = find(".number", row);
    number.textContent = part + 1;
    number.hidden = count === 1;
    number.title = "Drag, or arrows, to weigh this part";
    number.style.background = tone;
    number.style.color = partInk(part, count);
    number.setAttribute("aria-valuenow", String(result.weights[part] ?? 1));
    if (result.weights.length) number.append(make("u", { text: `×${result.weights[part]}` }));
    find("b", row).textContent = shown(answer.shares[part]);
    const { gain, minus, prefers } = result.rows[part];
    const told = find(".line i", row);
    told.className = prefers === null ? "" : prefers ? "right" : "wrong";
    told.textContent = gain && (prefers === null ? (minus ? "−" : "+") : prefers ? "✓ " : "✗ ") + gain;
    told.title = prefers === null ? "" : `This part prefers the ${prefers ? "truth" : "wrong tile"} by ${gain}`;
    fill(find(".track", row), answer.shares[part], result.scale.part, tone);
    fill(find(".track2", row), rival ? rival.shares[part] : 0, result.scale.part);
    row.title = rival ? `Share: answer ${shown(answer.shares[part])}, ${result.rival_word} ${shown(rival.shares[part])}` : "";
    const against = rival ? `, ${result.rival_word} ${shown(rival.shares[part])}` : "";
    row.setAttribute("aria-label", `${page.word} ${page.names[part]}: answer ${shown(answer.shares[part])}${against}`);
  });
  const line = find(".beside", rows);
  line.hidden = count > 1;
  if (count === 1) showBeside(line, result);
};

/** Beside the one part of a baseline: the rank of the truth by each other model. */
const showBeside = (line, result) =>
  line.replaceChildren(...result.beside.flatMap(([label, rank]) => [
    `${label.replace(/\.onnx$/, "")} on this photo: `, sign(rank === 1), make("b", { text: rank === 1 ? " found" : ` truth is ${rank}.` }), make("br")]));

const fill = (track, share, most, colour = "") => {
  track.classList.toggle("cut", share > most);
  const bar = find("i", track);
  bar.style.width = `${Math.min(100, (100 * Math.max(share, 0)) / most)}%`;
  if (colour) bar.style.background = colour;
};

/** Show the sums of answer and rival on one scale. */
export const showSums = (sum, result) => {
  const total = result.scale.total;
  const line = (word, tile) => make("div", { class: "total" }, make("span", {}, sign(tile.true), ` ${word}`), stack(tile, total, 3.4), make("b", { text: tile.distance }));
  const lines = [line("answer", result.tiles[result.answer])];
  if (result.rival !== null) lines.push(line(result.rival_word, result.tiles[result.rival]));
  const axis = ["0", result.state.scoring === "csls" ? "squared distance" : "squared distance, at most 4", String(total)].map((text) => make("u", { text }));
  sum.replaceChildren(...lines, make("div", { class: "axis" }, ...axis));
};

/** Show the strip of the nearest tiles. */
export const showStrip = (strip, result) => {
  const tiles = result.strip.map((index, place) => {
    const tile = result.tiles[index];
    const judged = tile.true ? "true" : tile.true === false && index === result.answer ? "false" : "";
    const further = place > 0 && Number(tile.rank) > place + 1 ? "gap" : "";
    const pressed = result.pinned && index === result.rival;
    const image = make("u", { style: { "background-image": `url("${tile.src}")`, transform: `rotate(${-90 * tile.quarter}deg)` } });
    const words = { true: " ✓", false: " ✗", "": "" }[judged];
    return make("button", { class: `tile ${judged} ${further}`, "data-tile": index, "aria-pressed": String(pressed), title: `Rank ${tile.rank}, squared distance ${tile.distance}: ${tile.name}`, "aria-label": `${tile.rank}: ${tile.name}, distance ${tile.distance}` },
      make("div", { class: "image" }, image),
      make("div", { class: "words" }, make("i", { class: judged === "true" ? "right" : judged === "false" ? "wrong" : "", text: tile.rank + words }), make("span", { text: tile.distance })),
      stack(tile, result.scale.total, 7));
  });
  strip.replaceChildren(...tiles);
};
