// The dialog of photos and commands: `/` opens it for photos, Ctrl K for commands, `?` for keys; Enter takes the first.

import { find, make } from "./dom.js";
import { ownButton, queryButton } from "./rail.js";

const SHOWN = 40;

/**
 * @typedef {{label: string, act: () => void, key?: string, keys?: string[], hidden?: boolean}} Command
 * A user's action: `key` is shown, `keys` trigger it, and `hidden` lists it among the keys only.
 */

export class Commands {
  /**
   * @param {any} dialog
   * @param {any} list a RailList
   * @param {() => Command[]} commands
   * @param {() => any} yours the own photos
   * @param {(text: string) => void} search requests the list of photos that match a text
   */
  constructor(dialog, list, commands, yours, search) {
    this.dialog = dialog;
    this.list = list;
    this.commands = commands;
    this.yours = yours;
    /** @type {Command[]} */
    this.shown = [];
    this.input = find("input", dialog);
    this.input.addEventListener("input", () => {
      if (this.dialog.dataset.for === "photos") search(this.input.value);
      this.draw();
    });
    this.input.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      (find(".photos button", dialog) ?? find(".actions button", dialog))?.click();
    });
    dialog.addEventListener("keydown", (event) => {
      const buttons = [this.input, ...dialog.querySelectorAll("button")];
      const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!by) return;
      event.preventDefault();
      buttons[(buttons.indexOf(document.activeElement) + by + buttons.length) % buttons.length].focus();
    });
    dialog.addEventListener("click", (event) => {
      const chosen = event.target.closest("button");
      if (chosen?.dataset.for) return this.open(chosen.dataset.for);
      if (chosen?.dataset.filter) return;
      if (event.target === dialog || chosen) dialog.close();
      if (chosen?.dataset.number) this.shown[chosen.dataset.number].act();
    });
    this.clear = () => {
      if (this.input.value && this.dialog.dataset.for === "photos") search("");
      this.input.value = "";
    };
    dialog.addEventListener("close", this.clear);
  }

  /** Open the dialog for "photos", "commands", or "keys". */
  open(what) {
    this.clear();
    this.dialog.dataset.for = what;
    if (!this.dialog.open) this.dialog.showModal();
    this.draw();
    this.input.focus();
  }

  /** Draw the commands whose labels contain the text, and the photos that the server lists. */
  async draw() {
    if (!this.dialog.open) return;
    const keys = this.dialog.dataset.for === "keys";
    const text = this.input.value.trim().toLowerCase();
    const of = this.commands().filter((one) => (keys ? one.key : !one.hidden));
    this.shown = of.filter((one) => one.label.toLowerCase().includes(text));
    find(".actions", this.dialog).replaceChildren(...this.shown.map((one, number) =>
      make("button", { "data-number": number }, make("span", { text: one.label }), make("kbd", { text: one.key ?? "" }))));
    const ofPhotos = this.dialog.dataset.for === "photos";
    const entries = this.list.rail && ofPhotos ? await this.list.piece(0) : [];
    const { photos, thumbnails } = this.yours();
    const yours = !ofPhotos ? [] : photos.filter((photo) => photo[2].toLowerCase().includes(text));
    find(".photos", this.dialog).replaceChildren(
      ...yours.map((photo) => ownButton(thumbnails, photo, "", true)),
      ...entries.slice(0, SHOWN).map((entry) => queryButton(this.list.rail, entry, this.list.query, true)));
  }
}
