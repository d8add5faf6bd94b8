// Panels beside or over the rings. The server lists them; script and style sheet of a panel are loaded when it opens.
//
// A panel without a script shows the HTML of its Python, see fragment.js. The script of a panel has
// `open(box, context)`, which returns `{receive(message), draw(view), close()}`: `receive` takes its Python's messages, `draw` is
// called after each change of the view. `context` is `{set, go, act, say, view}`; `go` shows an address.

import { addStyle, find } from "./dom.js";

export class Panels {
  /**
   * @param {any} box
   * @param {{set: (values: any) => void, go: (search: string) => void, act: (name: string, args?: any) => void, say: (text: string) => void, view: any}} context
   */
  constructor(box, context) {
    this.box = box;
    this.context = context;
    this.name = "";
    this.panel = null;
    /** @type {any[]} */
    this.waiting = [];
    this.turn = 0;
    /** @type {any} */
    this.before = null;
    find(".close", box).onclick = () => this.close();
  }

  /** Show the panel of the state; its module comes once. */
  async show(panels, name) {
    if (name === this.name) return this.panel?.draw(this.context.view);
    const had = this.name;
    if (!had) this.before = document.activeElement;
    this.panel?.close();
    [this.name, this.panel] = [name, null];
    const turn = ++this.turn;
    this.waiting = this.waiting.filter((one) => one.name === name);
    const known = panels.find((one) => one.name === name);
    this.box.hidden = !known;
    document.documentElement.dataset.panel = known?.place ?? "";
    dispatchEvent(new Event("resize")); // the rings take the remaining space
    // A panel that is still opening writes into a removed box.
    const left = find(".content", this.box);
    const content = left.cloneNode();
    left.replaceWith(content);
    if (!known) {
      if (had) this.before?.focus();
      return;
    }
    this.box.dataset.name = name;
    find("h2", this.box).textContent = known.title;
    if (had || this.context.view.result) find("h2", this.box).focus({ preventScroll: true }); // not on a page's opening
    await addStyle(`screen/panels/${name}/${name}.css`);
    const { open } = await import(known.script ? `../panels/${name}/${name}.js` : "./fragment.js");
    const { set, go, say, view } = this.context;
    if (turn !== this.turn) return; // closed meanwhile, and perhaps opened again
    const panel = await open(content, { set, go, say, view, act: (action, args) => this.context.act(`${name}.${action}`, args) });
    if (turn !== this.turn) return panel.close();
    this.panel = panel;
    for (const { message } of this.waiting.splice(0)) this.panel.receive(message);
    this.panel.draw(view);
  }

  /** Hand a message to its panel, which may still be loading or about to open. */
  receive(name, message) {
    if (name === this.name && this.panel) this.panel.receive(message);
    else this.waiting.push({ name, message });
  }

  /** Another place is shown, where the panel opens anew. */
  leave() {
    this.panel?.close();
    [this.name, this.panel] = ["", null];
  }

  close() {
    this.context.set({ panel: "" });
  }
}
