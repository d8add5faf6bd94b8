// The panel of stories: the steps of one, which are opened, renamed, moved, removed, told, and saved as a page.

import { find, make } from "../../page/dom.js";
import { tell } from "./tell.js";

/** Show the stories in a box. */
export const open = (box, context) => {
  const { act, go, set } = context;
  let shown = null;
  const story = make("select", { "aria-label": "Story" });
  const tellIt = make("button", { class: "main", text: "Tell", title: "Full screen, by the arrow keys" });
  const save = make("button", { text: "Save as a page", title: "One file that needs no server" });
  const name = make("input", { "aria-label": "Name of the story", maxlength: 80, spellcheck: false });
  const remove = make("button", { text: "Delete the story" });
  const [hint, steps, foot] = [make("p", { class: "hint" }), make("ol"), make("footer", {}, remove)];
  box.append(make("div", { class: "bar" }, story, tellIt, save), name, hint, steps, foot);

  const change = (action, given) => act(action, { story: shown.story, ...given });
  story.onchange = () => set({ stories_chosen: story.value });
  name.onchange = () => change("rename", { name: name.value });
  tellIt.onclick = () => tell({ name: shown.story, steps: shown.steps }, context);
  save.onclick = () => change("export");
  remove.onclick = () => confirm(`Delete ${shown.story}?`) && change("delete");

  const row = (step, at) => {
    const said = `step ${at + 1}`;
    const text = (label, value, most) => make("textarea", { "aria-label": `${label} of ${said}`, placeholder: label, maxlength: most, rows: 1, text: value });
    const [caption, notes] = [text("Caption", step.caption, 400), text("Notes for the presenter", step.notes, 2000)];
    notes.className = "notes";
    const put = (to = null) => change("step", { at, shows: step.shows, to, caption: caption.value, notes: notes.value });
    for (const one of [caption, notes]) one.onchange = () => put(at);
    const button = (sign, label, press, disabled = false) => {
      const made = make("button", { text: sign, title: label, "aria-label": `${label}: ${said}`, disabled });
      made.onclick = press;
      return made;
    };
    const look = make("button", { class: "look", title: "Open", "aria-label": `Open ${said}`, style: step.picture ? { "background-image": `url("${step.picture}")` } : {} }, make("b", { text: at + 1 }));
    look.onclick = () => go(`${step.shows}&panel=stories&story=${encodeURIComponent(shown.story)}`);
    return make("li", {}, look, make("div", {}, caption, notes), make("span", {},
      button("↑", "Move up", () => put(at - 1), at === 0),
      button("↓", "Move down", () => put(at + 1), at === shown.steps.length - 1),
      button("✕", "Remove", () => put())));
  };

  const draw = () => {
    const names = [...shown.names, shown.new];
    story.replaceChildren(...names.map((one) => make("option", { value: one, text: one === shown.new ? "New story" : one, selected: one === (shown.story || shown.new) })));
    [tellIt.disabled, save.disabled, name.hidden, remove.hidden] = [!shown.steps.length, !shown.steps.length, !shown.own, !shown.own];
    name.value = shown.story;
    hint.textContent = shown.error || (shown.steps.length ? "" : "S keeps what is shown as the first step.");
    const focused = /** @type {any} */ (document.activeElement)?.getAttribute("aria-label");
    steps.replaceChildren(...shown.steps.map(row));
    if (focused) find(`[aria-label="${CSS.escape(focused)}"]`, steps)?.focus();
    foot.replaceChildren(remove, make("span", { text: `S keeps a step in ${shown.place}.` }));
  };
  const receive = (message) => {
    shown = message;
    // A button that is being pressed stays until it is clicked.
    if (find(":active", steps)) addEventListener("pointerup", () => setTimeout(draw), { once: true });
    else draw();
  };
  return { receive, draw() {}, close() {} };
};
