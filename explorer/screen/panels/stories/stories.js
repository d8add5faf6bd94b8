// The panel of stories: the steps of one, which are opened, renamed, moved, removed, told, and saved as a page.

import { find, make } from "../../page/dom.js";
import { listen, put } from "../../page/fragment.js";
import { tell } from "./tell.js";

/** Show the stories. */
export const open = (content, context) => {
  const { act, go } = context;
  const box = content.appendChild(make("div", { class: "stories" }));
  let shown = null;
  const change = (action, given = {}) => act(action, { story: shown.story, ...given });
  /** Save a step's words at a position in the story; without a position it is removed. */
  const keep = (row, to) => {
    const at = Number(row.dataset.at);
    change("step", { at, shows: shown.steps[at].shows, to, caption: find(".caption", row).value, notes: find(".notes", row).value });
  };
  const presses = {
    tell: () => tell({ name: shown.story, steps: shown.steps }, context),
    export: () => change("export"),
    delete: () => confirm(`Delete ${shown.story}?`) && change("delete"),
    look: (row) => go(`${shown.steps[row.dataset.at].shows}&panel=stories&story=${encodeURIComponent(shown.story)}`),
  };
  listen(box, context);
  const pressed = ({ target }) => {
    const { act: name, to } = target.closest("button")?.dataset ?? {};
    const row = target.closest("li");
    if (name) presses[name](row);
    else if (to !== undefined) keep(row, to ? Number(to) : null);
  };
  const changed = ({ target }) => {
    const row = target.closest("li");
    if (row) keep(row, Number(row.dataset.at));
    else if (target.matches("input")) change("rename", { name: target.value });
  };
  box.addEventListener("click", pressed);
  box.addEventListener("change", changed);
  return {
    receive: (message) => {
      shown = message;
      const draw = () => put(box, message.html);
      // A button that is being pressed stays until it is clicked.
      if (find("li button:active", box)) addEventListener("pointerup", () => setTimeout(draw), { once: true });
      else draw();
    },
    draw() {},
    close: () => box.remove(),
  };
};
