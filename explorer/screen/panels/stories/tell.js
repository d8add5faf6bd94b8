// The telling of a story: full screen, a large caption below the rings; arrow keys go, Escape ends, N shows the notes.

import { find, make } from "../../page/dom.js";

const STEPS = { ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1, Enter: 1, ArrowLeft: -1, ArrowUp: -1, PageUp: -1, Backspace: -1, Home: -Infinity, End: Infinity };

/**
 * Tell a story; its end restores the previous state.
 * @param {{name: string, steps: {shows: string, caption: string, notes: string}[]}} story
 * @param {{go: (search: string) => void, set: (values: any) => void, view: any}} context
 */
export const tell = ({ name, steps }, { go, set, view }) => {
  const { place, address, own } = view.state;
  const root = document.documentElement;
  let at = 0;
  const button = (sign, label, press) => {
    const made = make("button", { text: sign, title: label, "aria-label": label });
    made.onclick = press;
    return made;
  };
  const [caption, notes, count] = [make("p", { "aria-live": "polite" }), make("p", { class: "notes", hidden: true }), make("span")];
  const previous = button("‹", "Previous step (left)", () => show(at - 1));
  const next = button("›", "Next step (right)", () => (at + 1 < steps.length ? show(at + 1) : end()));
  const bar = make("section", { id: "told", "aria-label": name }, make("div", {}, caption, notes), make("nav", {}, previous, count, next, button("✕", "End (Esc)", () => end())));

  const show = (to) => {
    at = Math.min(Math.max(to, 0), steps.length - 1);
    [caption.textContent, notes.textContent, count.textContent] = [steps[at].caption, steps[at].notes, `${at + 1} of ${steps.length}`];
    previous.disabled = at === 0;
    go(steps[at].shows);
  };
  const keys = (event) => {
    const press = event.key === "Enter" || event.key === " ";
    if (event.ctrlKey || event.altKey || event.metaKey || find("#commands").open || (press && event.target.matches("button"))) return;
    if (event.key in STEPS) show(at + STEPS[event.key]);
    else if (event.key === "Escape") end(); // outside full screen, where the browser takes it for itself
    else if (event.key.toLowerCase() === "n") notes.hidden = !notes.hidden;
    else return;
    event.preventDefault();
    event.stopImmediatePropagation();
  };
  // A resting pointer highlights nothing when the page moves below it.
  const moves = (event) => (event.movementX || event.movementY) && (root.dataset.told = "");
  const left = () => document.fullscreenElement || end();
  const end = () => {
    removeEventListener("keydown", keys, true);
    removeEventListener("pointermove", moves, true);
    document.removeEventListener("fullscreenchange", left);
    if (document.fullscreenElement) document.exitFullscreen();
    bar.remove();
    delete root.dataset.told;
    dispatchEvent(new Event("resize"));
    go(`show=${encodeURIComponent(place)}&${address}`);
    if (own) set({ own });
  };

  document.body.append(bar);
  root.dataset.told = "still";
  scrollTo(0, 0);
  dispatchEvent(new Event("resize"));
  addEventListener("keydown", keys, true);
  addEventListener("pointermove", moves, true);
  document.addEventListener("fullscreenchange", left);
  root.requestFullscreen?.().catch(() => {});
  next.focus({ preventScroll: true });
  show(0);
};
