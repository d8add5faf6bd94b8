// The meaning of a term of the glossary, beside it: under the mouse, at the focus, or after a tap. Escape hides it.

import { find, make } from "./dom.js";

const GAP = 6;

/** The attributes of words outside the glossary, with their meaning. */
export const tip = (meaning) => ({ class: "term", tabindex: 0, "data-tip": meaning });

/** @type {Promise<Record<string, string>> | null} */
let loading = null;
/** @returns {Promise<Record<string, string>>} the meanings of all terms by their names */
const meanings = () =>
  (loading ??= fetch("screen/terms.json").then((answer) => answer.json()).catch(() => {
    loading = null;
    return {};
  }));

/** @type {any} */
let explainedTerm = null;
/** Hide the shown meaning. */
export const hide = () => {
  find("#tip")?.remove();
  explainedTerm?.removeAttribute("aria-describedby");
  explainedTerm = null;
};
const explain = async (one) => {
  if (one === explainedTerm) return;
  hide();
  explainedTerm = one;
  const { term: name, tip: own } = one.dataset;
  const text = own ?? `${name}: ${(await meanings())[name] ?? ""}`;
  if (one !== explainedTerm) return;
  // A modal dialog covers what lies outside it.
  const tip = (one.closest("dialog") ?? document.body).appendChild(make("div", { id: "tip", role: "tooltip", text }));
  one.setAttribute("aria-describedby", "tip");
  const box = one.getBoundingClientRect();
  const below = box.bottom + GAP + tip.offsetHeight < innerHeight;
  tip.style.left = `${Math.max(GAP, Math.min(box.left, innerWidth - tip.offsetWidth - GAP))}px`;
  tip.style.top = `${Math.max(GAP, below ? box.bottom + GAP : box.top - GAP - tip.offsetHeight)}px`;
};

const termAt = (event) => event.target.closest?.(".term");
document.addEventListener("pointerover", (event) => {
  if (event.pointerType !== "mouse") return;
  const one = termAt(event) ?? find(".term:focus-visible");
  if (one) explain(one);
  else hide();
});
for (const kind of ["focusin", "click"])
  document.addEventListener(kind, (event) => {
    const one = termAt(event);
    if (one) explain(one);
    else hide();
  });
document.addEventListener("scroll", hide, true);
document.addEventListener("keydown", (event) => event.key === "Escape" && hide(), true);
