// The dialog of photos and commands: `/` and Ctrl K open it, Enter takes the first.

import { find, make } from "./dom.js";
import { queryButton } from "./rail.js";

const SHOWN = 40;

export class Commands {
  /**
   * @param {() => any[]} commands label, key, and what to do (a function, or an address) of each
   * @param {(text: string) => void} search has the server list the photos of a text
   */
  constructor(dialog, list, commands, search) {
    this.dialog = dialog;
    this.list = list;
    this.commands = commands;
    this.shown = [];
    this.input = find("input", dialog);
    this.input.addEventListener("input", () => {
      search(this.input.value);
      this.draw();
    });
    this.input.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault();
      find(".actions :is(button, a), .photos button", dialog)?.click();
    });
    dialog.addEventListener("click", (event) => {
      const chosen = event.target.closest("button");
      if (event.target === dialog || chosen) dialog.close();
      if (chosen?.dataset.number) this.shown[chosen.dataset.number].act();
    });
    dialog.addEventListener("close", () => {
      if (this.input.value) search("");
    });
  }

  open(text = "") {
    this.input.value = text;
    if (!this.dialog.open) this.dialog.showModal();
    this.draw();
    this.input.focus();
  }

  /** Draw the commands whose labels contain the text, and the photos that the server lists. */
  async draw() {
    if (!this.dialog.open) return;
    const text = this.input.value.trim().toLowerCase();
    this.shown = text ? this.commands().filter((one) => one.label.toLowerCase().includes(text)) : this.commands();
    find(".actions", this.dialog).replaceChildren(...this.shown.map((one, number) => {
      const content = [make("span", { text: one.label }), make("kbd", { text: one.key ?? "" })];
      return one.href ? make("a", { href: one.href }, ...content) : make("button", { "data-number": number }, ...content);
    }));
    const entries = this.list.rail ? await this.list.piece(0) : [];
    find(".photos", this.dialog).replaceChildren(...entries.slice(0, SHOWN).map((entry) => queryButton(this.list.rail, entry, this.list.query, true)));
  }
}
