// The table of queries: Tabulator draws the rows in sight, and the server sends them in pieces, sorted and filtered.

import { PIECE, fetchPiece, find, load, make } from "../../page/dom.js";

const ROW = 33; // pixels without the line below; lab.css has the same height for rows that are still empty
const WIDTHS = { rank: 62, margin: 88, part: 84, answer: 104, number: 88, text: 112 };

export class QueryTable {
  constructor(box, { set, marked }) {
    this.set = set;
    this.onMarked = marked;
    this.inner = box.appendChild(make("div"));
    this.head = this.drawn = this.grid = null; // the newest message, and the one that is shown
    this.at = -1;
    this.pieces = new Map();
    this.queries = [];
    this.ready = load("tabulator").then(({ TabulatorFull }) => (this.made = TabulatorFull));
  }

  close() {
    this.head = null;
    this.grid?.destroy();
  }

  /** Show the rows of a message; the grid is kept if its columns are unchanged. */
  async show(head) {
    this.head = head;
    await this.ready;
    await this.built;
    if (head !== this.head) return;
    const before = this.drawn;
    this.drawn = head;
    const heading = (one) => JSON.stringify([one.columns, one.sort, one.descending]);
    if (this.grid && head.feed === before.feed && heading(head) === heading(before)) return;
    this.pieces.clear();
    const rows = Array.from({ length: head.total }, (_, at) => ({ at }));
    if (!this.grid) {
      this.grid = new this.made(this.inner, {
        data: rows, columns: this.columns(), index: "at", nestedFieldSeparator: false, height: "100%", rowHeight: ROW, headerSortElement: "", movableColumns: true,
        columnDefaults: { headerSort: false, resizable: "header" }, placeholder: "No photo is left by these choices.",
        selectableRows: true, selectableRowsRangeMode: "click", rowFormatter: (row) => row.getElement().classList.toggle("shown", row.getData().at === this.at),
      });
      this.built = new Promise((resolve) => this.grid.on("tableBuilt", resolve)); // before it, the grid takes no rows
      this.grid.on("tableBuilt", () => {
        this.holder = find(".tabulator-tableholder", this.inner);
        find(".tabulator", this.inner.parentElement).setAttribute("aria-label", "Queries: arrow keys walk; Control or Shift and a click mark");
        this.holder.setAttribute("role", "rowgroup"); // it takes the focus, so it needs a role
        find(".tabulator-table", this.holder).setAttribute("role", "presentation");
        this.holder.addEventListener("scroll", () => this.fill());
        this.queries = [];
        this.choose(this.at, true);
      });
      this.grid.on("rowClick", (event, row) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        const query = this.queries[row.getData().at];
        if (query !== undefined) this.set({ query, own: "" });
        setTimeout(() => this.grid.deselectRow()); // a click opens, and marks nothing
      });
      this.grid.on("rowSelectionChanged", () => this.onMarked());
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
      button.onclick = () => this.set({ lab_sort: name === sort && !descending ? `-${name}` : name });
      return button;
    };
    return [
      { title: "photo", field: "query", width: 46, frozen: true, formatter: "html", titleFormatter: () => make("span", { class: "unseen", text: "photo" }) },
      ...columns.map((column) => ({
        title: column.name, field: `=${column.name}`, width: width(column),
        hozAlign: column.kind === "number" ? "right" : "left", headerHozAlign: column.kind === "number" ? "right" : "left",
        titleFormatter: () => title(column), formatter: "html",
      })),
    ];
  }

  /** @returns {number[]} the rows that the user has marked, in their order */
  marked() {
    return (this.grid?.getSelectedData() ?? []).map((row) => row.at).sort((one, other) => one - other);
  }

  /** @returns {number[]} the marked rows, after unmarking them */
  takeMarked() {
    const rows = this.marked();
    this.grid.deselectRow();
    return rows;
  }

  /** Highlight the row of the shown query, and bring it in sight. */
  async choose(at, again = false) {
    const before = this.at;
    this.at = at;
    if (!this.holder) return;
    for (const one of [before, at]) {
      const row = one >= 0 && one < this.grid.getDataCount() && this.grid.getRow(one);
      if (row) row.reformat();
    }
    if (at >= 0 && (at !== before || again)) await this.grid.scrollToRow(at, "center", false).catch(() => {}); // the row may be gone by now
    this.fill();
  }

  /** Ask for the rows in sight. */
  async fill() {
    if (!this.head) return;
    const { feed, total, address, columns, thumbnails } = this.head;
    const seen = this.grid.getRows("visible").map((row) => row.getData().at);
    const [first, last] = [seen[0], seen.at(-1)].map((at) => Math.floor((at ?? 0) / PIECE));
    for (let number = first; number <= last && number * PIECE < total; number++) {
      if (this.pieces.has(number)) continue;
      this.pieces.set(number, true);
      const entries = await fetchPiece(`${address}${feed}${number}`);
      if (feed !== this.head?.feed) return;
      if (!entries.length) {
        this.pieces.delete(number); // asked for again
        continue;
      }
      const rows = entries.map(([query, cells], place) => {
        this.queries[number * PIECE + place] = query;
        return { at: number * PIECE + place, query: `<img src="${thumbnails}${query}" alt="">`, ...Object.fromEntries(columns.map(({ name }, column) => [`=${name}`, cells[column]])) };
      });
      await this.grid.updateData(rows);
    }
  }
}
