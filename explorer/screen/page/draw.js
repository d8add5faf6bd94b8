// Head, headline, and the two large pictures, drawn from the view.

import { find, findAll, make, turned, variable } from "./dom.js";
import { photoTurn, rollPicture, showPicture } from "./pictures.js";
import { sign } from "./rows.js";

/** The kinds of heat with their legends. */
export const HEATS = {
  activation: { name: "response", ends: ["weak", "strong"], meaning: "How strongly the network responds to each cell, on one scale for all parts of a picture." },
  evidence: { name: "evidence", ends: ["against", "for"], meaning: "Exact evidence: what each cell adds to the score of photo and answer; green cells speak against it." },
  occlusion: { name: "occlusion", ends: ["against", "for"], meaning: "Occlusion: what the score loses when a square is covered; covering a green one raises it." },
};
const [photoBox, tileBox] = ["#photo", "#tile"].map((one) => find(one));

/** @returns {number} the tile beside the photo: the truth while T is pressed, the pinned one, or the answer */
export const shownTile = ({ result, truth }) => (truth && result.truth !== null ? result.truth : result.pinned ? result.rival : result.answer);

export const drawHead = ({ page, state, rail }) => {
  const ranked = { plain: "", calibrated: "calibrated ", csls: "CSLS " }[state.scoring];
  find("#about i").textContent = page.parts === 1
    ? `The baseline compares whole pictures, as one part${ranked && `, by ${ranked}distances`}.`
    : `Both are cut into ${page.word}s, whose ${ranked}distances add up.`;
  const [model, models] = [find("#model"), find("#models")];
  const names = page.models.map((label) => `Model: ${label.replace(/\.onnx$/, "")}`);
  model.textContent = names[Number(state.model)];
  [model.hidden, models.hidden] = [names.length !== 2, names.length < 3];
  if (models.length !== names.length) models.replaceChildren(...names.map((text, value) => make("option", { text, value })));
  models.value = state.model;
  const full = page.panels.find((one) => one.place === "full");
  find("#full").hidden = !full;
  if (full) find("#full").textContent = full.title;
  for (const button of findAll("[data-filter]")) button.setAttribute("aria-pressed", String(button.dataset.filter === state.filter));
  find("#rail .filter small").hidden = state.filter !== "missed";
  find("#commands .meaning").textContent = `LPN describes each ${page.word} of a picture by a vector. The share of a ${page.word} is the squared distance between its vectors of photo and tile; the shares add up to the tile's distance. Hatched bars are the shares of the tile that the answer is compared with; a bar with a hatched end is longer than its scale.`;
  find("#rail .filter [data-filter=missed]").title = rail ? `${rail.missed} of ${rail.queries} missed (M)` : "";
};

export const drawHeadline = ({ said, note, page, result }) => {
  const [title, reason] = [find("#headline h1 button"), find("#headline p")];
  title.disabled = Boolean(said) || !result;
  document.documentElement.classList.toggle("said", Boolean(said || note));
  if (said) {
    title.textContent = said.text;
    reason.replaceChildren(...(said.busy || !result ? [] : [make("button", { class: "button", "data-back": true, text: "Back" })]));
  } else if (!result) {
    title.textContent = page ? `Comparing with ${page.tiles.toLocaleString("en")} ${page.tiles === 1 ? "tile" : "tiles"}` : "Opening";
    reason.textContent = "";
  } else {
    const { found, title: rest, reason: why } = result.headline;
    const judged = found === null ? [] : [make("b", { class: found ? "right" : "wrong", text: found ? "✓ Found" : "✗ Missed" }), ", "];
    title.replaceChildren(...judged, rest, make("i", { class: "more", "aria-hidden": "true", text: "?" }));
    reason.textContent = note || why;
  }
};

/** Show the state's photo, perhaps before its result. */
export const drawTurn = ({ state, result, angle }) => {
  const frame = find(".frame", photoBox);
  const coming = !result || state.photo !== result.photo.src;
  photoBox.classList.toggle("coming", coming);
  if (coming) {
    find(".picture", photoBox).style.backgroundImage = `url("${state.photo}")`;
    if (!result) return;
  }
  rollPicture(photoBox, result.photo, angle);
  frame.setAttribute("aria-valuenow", String(angle));
  frame.setAttribute("aria-valuetext", `${Math.abs(angle)} degrees ${angle < 0 ? "clockwise" : "counter-clockwise"}`);
  find("#degrees").textContent = turned(angle);
};

export const drawPictures = (view) => {
  const { page, result, mark, focus, angle } = view;
  const own = result.photo;
  showPicture(photoBox, own, focus, page.parts, photoTurn(own, angle), `${own.name}`);
  find(".frame", photoBox).classList.toggle("fixed", !page.turns);
  find("figcaption b", photoBox).textContent = page.photo[0].toUpperCase() + page.photo.slice(1);
  find("figcaption .name", photoBox).textContent = own.name;
  find("figcaption .hint", photoBox).textContent = own.own ? "yours" : page.turns ? (own.around ? "drag to roll" : "drag to turn") : "";
  const key = find(".key", photoBox);
  const { name, ends, meaning } = HEATS[own.signed ? result.state.heat : "activation"];
  key.hidden = !own.heat;
  key.title = `${meaning} A click, or E, shows another kind; F held shows full colour.`;
  find("em", key).textContent = name;
  key.classList.toggle("signed", Boolean(own.signed));
  findAll("u", key).forEach((word, end) => (word.textContent = ends[end]));
  if (result.measured) find("u", key).textContent = result.measured;
  const shown = shownTile(view);
  const answer = result.tiles[shown];
  const role = shown === result.answer ? "Answer" : shown === result.truth ? "Truth" : "Pinned";
  const colour = answer.true === null ? "--line" : role === "Pinned" ? "--ink" : answer.true ? "--right" : "--wrong";
  tileBox.style.setProperty("--verdict", variable(colour));
  find("figcaption b", tileBox).replaceChildren(role, " ", sign(answer.true));
  find("figcaption .name", tileBox).textContent = answer.name;
  find("figcaption .key", tileBox).textContent = role === "Pinned" ? `rank ${answer.rank} · Esc` : "";
  const checked = mark?.own === result.state.own ? mark : null;
  const marks = role === "Answer" ? [...result.marks, checked].filter(Boolean) : [];
  const place = find("figcaption .mark", tileBox);
  place.replaceChildren(...marks.flatMap((one) => [sign(one.sign), ` ${one.text}`]));
  place.title = marks.map((one) => one.why ?? "").join(" ");
  showPicture(tileBox, answer, focus, page.parts, `rotate(${-90 * answer.quarter}deg)`, `Tile ${answer.name}`);
};

/** Light one part in both pictures. */
export const focusPictures = (view, part) => {
  const { page, result } = view;
  for (const [figure, described] of [[photoBox, result.photo], [tileBox, result.tiles[shownTile(view)]]])
    showPicture(figure, described, part, page.parts, find(".picture", figure).style.transform, "");
};
