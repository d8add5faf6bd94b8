// The list of queries at the left. Only visible entries are in the page; the server sends the list in pieces.

import { PIECE, fetchPiece, find, findAll, make } from "./dom.js";

const ENTRY = 62; // pixels of an entry

/** A photo's button: its thumbnail, its mark, and perhaps its name. */
const photoButton = (data, name, said, source, chosen, title, ...marks) =>
  make("button", { class: "query", ...data, title: name, "aria-label": said, "aria-current": String(chosen), style: { "background-image": `url("${source}")` } }, ...marks, title ? make("span", { text: name }) : "");

/** A query's button. */
export const queryButton = (rail, [query, name, rank], chosen, title = false) =>
  photoButton({ "data-query": query }, name, `${name}${rank > 1 ? `, truth ${rank}.` : rank === 1 ? ", found" : ""}`, rail.thumbnails + query, query === chosen, title,
    rank ? make("b", { class: rank === 1 ? "right" : "wrong", text: rank === 1 ? "✓" : rank }) : "");

/** An own photo's button. */
export const ownButton = (thumbnails, [number, own, name], chosen, title = false) => photoButton({ "data-own": own }, name, name, thumbnails + number, own === chosen, title);

/** Show the own photos above the list, if there are any. */
export const showYours = (box, { photos, thumbnails }, chosen) => {
  box.hidden = !photos.length;
  find(".items", box).replaceChildren(...photos.map((photo) => ownButton(thumbnails, photo, chosen)));
  find("[aria-current=true]", box)?.scrollIntoView({ block: "nearest" });
};

export class RailList {
  constructor(list) {
    this.list = list;
    this.inner = find("div", list);
    this.rail = null;
    this.query = -1;
    this.pieces = new Map();
    list.addEventListener("scroll", () => this.draw());
  }

  /** Show a list: another chosen query scrolls into view, another list starts at its top. */
  show(rail, query) {
    if (rail.feed !== this.rail?.feed) this.pieces.clear();
    const moved = query !== this.query || rail.feed !== this.rail?.feed;
    const others = this.rail && (rail.worst_first !== this.rail.worst_first || rail.find !== this.rail.find);
    [this.rail, this.query] = [rail, query];
    this.inner.style.height = `${ENTRY * rail.total + 8}px`;
    if (others) this.list.scrollTop = 0;
    if (moved && rail.chosen >= 0 && !(others && rail.worst_first)) {
      const top = ENTRY * rail.chosen;
      const { scrollTop, clientHeight } = this.list;
      if (top < scrollTop || top + 2 * ENTRY > scrollTop + clientHeight) this.list.scrollTop = Math.max(0, top - clientHeight / 3);
    }
    this.draw();
  }

  /** @returns {Promise<any[]>} the entries of a piece of the list */
  async piece(number) {
    const { address, feed } = this.rail;
    if (!this.pieces.has(number)) this.pieces.set(number, fetchPiece(`${address}${feed}${number}`));
    return this.pieces.get(number);
  }

  async draw() {
    const rail = this.rail;
    const first = Math.max(0, Math.floor(this.list.scrollTop / ENTRY) - 2);
    const last = Math.min(rail.total, first + Math.ceil(this.list.clientHeight / ENTRY) + 5);
    const entries = [];
    for (let at = first; at < last; ) {
      const piece = await this.piece(Math.floor(at / PIECE));
      if (rail !== this.rail) return;
      const end = Math.min(last, (Math.floor(at / PIECE) + 1) * PIECE);
      for (; at < end; at++) if (piece[at % PIECE]) entries.push([at, piece[at % PIECE]]);
    }
    const focused = document.activeElement?.closest?.("#list .query")?.getAttribute("data-query");
    this.inner.replaceChildren(...entries.map(([at, entry]) => {
      const button = queryButton(rail, entry, rail.chosen < 0 ? -1 : this.query);
      button.style.top = `${ENTRY * at + 4}px`;
      if (entry[0] !== this.query) button.tabIndex = -1;
      return button;
    }));
    if (focused) findAll(".query", this.inner).find((one) => one.dataset.query === focused)?.focus();
  }
}
