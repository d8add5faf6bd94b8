// The table of queries: Tabulator draws the rows in sight, and the server sends them in pieces, sorted and filtered.

import { find, make, partColour } from "../../page/dom.js";
import { load } from "./vendor.js";

const ROW = 33; // pixels without the line below; lab.css has the same height for rows that are still empty
const PIECE = 100; // rows that the server sends at once
const WIDTHS = { rank: 62, margin: 88, part: 84, answer: 104, number: 88, text: 112 };

const verdict = (found) => (found === null ? "" : make("b", { class: found ? "right" : "wrong", text: found ? "✓" : "✗" }));

const thumbnail = (source) => (source ? make("img", { src: source, alt: "" }) : "");

export class QueryTable {
  constructor(box, { open, sort, chosen }) {
    this.open = open;
    this.sort = sort;
    this.chosen = chosen;
    this.inner = box.appendChild(make("div"));
    this.head = this.grid = null;
    this.at = this.from = -1;
    this.marked = new Set();
    this.pieces = new Map();
    this.queries = [];
    this.ready = load("tabulator").then(({ TabulatorFull }) => (this.made = TabulatorFull));
  }

  close() {
    this.head = null;
    this.grid?.destroy();
  }

  /** Show the rows of a message; the grid stays where its columns do. */
  async show(head) {
    const before = this.head;
    this.head = head;
    await this.ready;
    if (head !== this.head) return;
    const heading = (one) => JSON.stringify([one.columns, one.sort, one.descending, one.limit]);
    if (this.grid && head.feed === before.feed && heading(head) === heading(before)) return;
    this.pieces.clear();
    this.marked.clear();
    const rows = Array.from({ length: head.total }, (_, at) => ({ at }));
    if (!this.grid) {
      this.grid = new this.made(this.inner, {
        data: rows, columns: this.columns(), index: "at", nestedFieldSeparator: false, height: "100%", rowHeight: ROW, headerSortElement: "", movableColumns: true,
        columnDefaults: { headerSort: false, resizable: "header" }, placeholder: "No photo is left by these choices.",
        rowFormatter: (row) => this.decorate(row),
      });
      this.grid.on("tableBuilt", () => {
        this.holder = find(".tabulator-tableholder", this.inner);
        find(".tabulator", this.inner.parentElement).setAttribute("aria-label", "Queries: arrow keys walk, Space marks a row");
        this.holder.setAttribute("role", "rowgroup"); // it has the focus, so that it needs a role
        find(".tabulator-table", this.holder).setAttribute("role", "presentation");
        this.holder.addEventListener("scroll", () => this.fill());
        this.queries = [];
        this.choose(this.at, true);
      });
      this.grid.on("rowClick", (event, row) => this.clicked(event, row.getData().at));
      return;
    }
    if (heading(head) !== heading(before)) this.grid.setColumns(this.columns());
    this.queries = [];
    await this.grid.setData(rows);
    this.choose(this.at, true);
  }

  redraw() {
    if (this.holder && this.inner.clientHeight !== this.height) {
      this.height = this.inner.clientHeight;
      this.grid.redraw();
      this.fill();
    }
  }

  columns() {
    const { columns, sort, descending, longest } = this.head;
    const width = ({ name, kind }) => (name === "name" ? Math.max(84, Math.min(170, 8 * longest + 14)) : WIDTHS[kind]);
    const title = ({ name, unit, hint }) => {
      const sign = name === sort ? (descending ? " ▾" : " ▴") : "";
      const button = make("button", { title: `${hint}; click to sort`, text: `${name}${unit ? ` ${unit}` : ""}${sign}` });
      button.onclick = () => this.sort(name);
      return button;
    };
    return [
      { title: "photo", field: "query", width: 46, frozen: true, formatter: (cell) => thumbnail(cell.getValue()), titleFormatter: () => make("span", { class: "unseen", text: "photo" }) },
      ...columns.map((column) => ({
        title: column.name, field: `=${column.name}`, width: width(column),
        hozAlign: column.kind === "number" ? "right" : "left", headerHozAlign: column.kind === "number" ? "right" : "left",
        titleFormatter: () => title(column), formatter: (cell) => this.cell(column.kind, cell.getValue()),
      })),
    ];
  }

  cell(kind, value) {
    if (value === undefined || value === null) return "";
    if (kind === "rank") return make("span", {}, verdict(value[1]), ` ${value[0]}`);
    if (kind === "answer") return make("span", { title: value[0] }, thumbnail(value[1]), value[0]);
    if (kind === "part") return make("span", {}, make("i", { class: "swatch", style: { background: value[1] < 0 ? "none" : partColour(value[1], 2) } }), value[0]);
    if (kind !== "margin") return make("span", { text: value, title: value });
    const share = (50 * Math.abs(value)) / this.head.limit;
    const bar = make("i", { class: value < 0 ? "less" : "more", style: { left: `${value < 0 ? 50 - share : 50}%`, width: `${share}%` } });
    return make("span", { class: "margin" }, value.toFixed(2).replace("-", "−"), make("u", {}, bar));
  }

  decorate(row) {
    const { at } = row.getData();
    const element = row.getElement();
    element.classList.toggle("shown", at === this.at);
    element.classList.toggle("marked", this.marked.has(at));
    element.setAttribute("aria-selected", String(at === this.at || this.marked.has(at)));
  }

  clicked(event, at) {
    if (event.ctrlKey || event.metaKey || event.shiftKey) this.mark(at, event.shiftKey);
    else if (this.queries[at] !== undefined) this.open(this.queries[at]);
  }

  /** Mark a row, or take its mark; with `range` all rows from the last one. */
  mark(at, range) {
    if (at < 0) return;
    const [low, high] = range && this.from >= 0 ? [Math.min(at, this.from), Math.max(at, this.from)] : [at, at];
    for (let one = low; one <= high; one++)
      if (range || !this.marked.has(one)) this.marked.add(one);
      else this.marked.delete(one);
    this.from = at;
    this.decorateAll();
  }

  /** @returns {number[]} the marked rows, which are marked no longer */
  takeMarked() {
    const rows = [...this.marked];
    this.marked.clear();
    this.decorateAll();
    return rows;
  }

  decorateAll() {
    for (const row of this.grid.getRows("visible")) this.decorate(row);
    this.chosen();
  }

  /** Highlight the row of the shown query, and bring it in sight. */
  async choose(at, again = false) {
    const before = this.at;
    this.at = at;
    if (!this.holder) return;
    for (const one of [before, at]) {
      const row = one >= 0 && one < this.grid.getDataCount() && this.grid.getRow(one);
      if (row) this.decorate(row);
    }
    if (at >= 0 && (at !== before || again)) await this.grid.scrollToRow(at, "center", false).catch(() => {}); // it may have gone meanwhile
    this.fill();
  }

  /** Ask for the rows in sight. */
  async fill() {
    if (!this.head) return;
    const { feed, total, address, columns, thumbnails } = this.head;
    const shown = (kind, value) => (kind === "answer" ? [value[0], value[1] < 0 ? "" : thumbnails[1] + value[1]] : value);
    const seen = this.grid.getRows("visible").map((row) => row.getData().at);
    const [first, last] = [seen[0], seen.at(-1)].map((at) => Math.floor((at ?? 0) / PIECE));
    for (let number = first; number <= last && number * PIECE < total; number++) {
      if (this.pieces.has(number)) continue;
      this.pieces.set(number, true);
      const answer = await fetch(`${address}${feed}${number}`).catch(() => null);
      const entries = answer?.ok && answer.headers.get("Content-Length") !== "0" ? await answer.json().catch(() => []) : [];
      if (feed !== this.head?.feed) return;
      if (!entries.length) {
        this.pieces.delete(number); // asked for again
        continue;
      }
      const rows = entries.map(([query, cells], place) => {
        this.queries[number * PIECE + place] = query;
        return { at: number * PIECE + place, query: thumbnails[0] + query, ...Object.fromEntries(columns.map(({ name, kind }, column) => [`=${name}`, shown(kind, cells[column])])) };
      });
      await this.grid.updateData(rows);
    }
  }
}
