// The laboratory beside the rings: all queries in a table, in charts, and on maps, and the note of the one that is shown.

import { find, findAll, make } from "../../page/dom.js";
import { Charts } from "./charts.js";
import { PointMap } from "./map.js";
import { QueryTable } from "./table.js";

const TABS = { table: "Table", charts: "Charts", map: "Map" };
const SHOWN = { all: "All", missed: "✗ Missed", near: "Near", found: "✓ Found", "only A": "Only A", "only B": "Only B" };
const HELP = "Join conditions by and, such as rank > 5 and margin < -0.1. Numbers take = != < <= > >=. Texts take = and !=, or ~ and !~ for a part of them. The word none stands for an unknown value.";
const PAUSE = 250; // milliseconds after the last letter of a filter
const STEPS = { n: 1, arrowdown: 1, p: -1, arrowup: -1, pagedown: 10, pageup: -10 };

const chip = (text, attributes = {}) => make("button", { class: "chip", text, ...attributes });

export const open = (box, context) => new Laboratory(box, context);

class Laboratory {
  constructor(box, context) {
    this.context = context;
    this.head = this.query = null;
    this.typing = 0;
    this.selecting = false;
    this.note = { query: -1, tags: "", text: "" }; // as it is stored
    box.append(
      make("div", { class: "lab" },
        make("div", { class: "line" },
          make("div", { class: "tabs" }, ...Object.entries(TABS).map(([name, text]) => make("button", { text, "data-tab": name }))), make("i", { class: "gap" }),
          make("details", { class: "columns" }, make("summary", { class: "chip", text: "Columns" }), make("div")),
          chip("CSV", { class: "chip csv", title: "Save these rows with all columns" })),
        make("div", { class: "line shown" }, ...Object.keys(SHOWN).map((name) => chip("", { "data-show": name }))),
        make("div", { class: "line filter" },
          make("input", { class: "field", type: "search", "aria-label": "Filter", maxlength: 1000, spellcheck: "false", autocomplete: "off" }),
          make("details", { class: "help" }, make("summary", { class: "chip", text: "?", title: "How to filter", "aria-label": "How to filter" }), make("div"))),
        make("div", { class: "error", role: "alert", hidden: true }),
        make("div", { class: "line counts" }, make("span", { role: "status" }), make("i", { class: "gap" }), make("input", { class: "field tag", "aria-label": "Tags for all these rows", placeholder: "Tag all", maxlength: 1000 }), make("select", { class: "field", "aria-label": "Ranks of a second model" })),
        make("div", { class: "line busy", role: "status", hidden: true }),
        make("div", { class: "body" }, ...Object.keys(TABS).map((name) => make("div", { class: name }))),
        make("form", { class: "note", hidden: true },
          make("b"), make("input", { class: "field", "aria-label": "Tags", placeholder: "Tags", maxlength: 1000 }), make("textarea", { class: "field", "aria-label": "Note", placeholder: "Note", rows: 1, maxlength: 2000 }),
          make("button", { class: "chip", text: "Save" }), make("span", { role: "status" }))),
    );
    this.box = find(".lab", box);
    const { set, act } = context;
    this.table = new QueryTable(find(".body .table", box), {
      open: (query) => set({ query, own: "" }),
      sort: (column) => set({ lab_sort: this.head.sort === column && !this.head.descending ? `-${column}` : column }),
      chosen: () => this.drawCounts(),
    });
    const select = (change) => {
      this.selecting = true;
      change();
    };
    this.charts = new Charts(find(".body .charts", box), (click) => select(() => set(click)));
    this.map = new PointMap(find(".body .map", box), { set, act: (name, args) => (name === "lasso" ? select(() => act(name, args)) : act(name, args)) });
    this.box.addEventListener("click", (event) => this.clicked(event.target));
    this.input = find(".filter input", box);
    this.input.addEventListener("input", () => {
      clearTimeout(this.typing);
      this.typing = setTimeout(() => {
        this.typing = 0;
        set({ lab_where: this.input.value });
      }, PAUSE);
    });
    const tag = find(".tag", box);
    tag.addEventListener("keydown", (event) => event.key === "Enter" && tag.value.trim() && act("tag", { tags: tag.value }));
    find(".counts select", box).addEventListener("change", (event) => set({ lab_second: event.target.value }));
    find(".columns", box).addEventListener("change", () => {
      const names = findAll(".columns input:checked", box).map((one) => one.value);
      set({ lab_columns: names.join(",") || "-" });
    });
    const form = find(".note", box);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.saveNote();
    });
    form.addEventListener("input", () => (find("span", form).textContent = "Not saved yet"));
    this.keys = (event) => this.pressed(event);
    addEventListener("keydown", this.keys, true);
  }

  close() {
    removeEventListener("keydown", this.keys, true);
    this.map.close();
    this.charts.close();
    this.table.close();
  }

  clicked(target) {
    const { set, act } = this.context;
    const button = target.closest("button");
    if (button?.dataset.tab) set({ lab_tab: button.dataset.tab });
    else if (button?.dataset.show) set({ lab_show: button.dataset.show });
    else if (button?.dataset.act === "only") act("pick", { rows: this.table.takeMarked() });
    else if (button?.dataset.act === "none") this.table.takeMarked();
    else if (button?.dataset.act === "picked") set({ lab_picked: "" });
    else if (button?.dataset.act === "calibrate") act("calibrate");
    else if (button?.classList.contains("csv")) act("csv");
    else if (button?.dataset.column) {
      this.input.value = `${this.input.value}${this.input.value ? " and " : ""}${button.dataset.column} `;
      this.input.focus();
    }
  }

  /** The arrow keys, N, and P walk the rows; Space marks the row that is shown. */
  pressed(event) {
    const { target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || target.closest?.("input, textarea, select, dialog, .leaflet-container, summary")) return;
    const by = STEPS[event.key.toLowerCase()];
    const marks = event.key === " " && target.closest(".tabulator");
    if (by === undefined && !marks) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (marks) this.table.mark(this.query?.at ?? -1, event.shiftKey);
    else this.context.act("step", { by });
  }

  receive(message) {
    const [[kind, value]] = Object.entries(message);
    if (kind === "table") {
      this.head = value;
      this.table.show(value);
      this.map.head = value;
      this.charts.head = value;
      this.drawHead();
    } else if (kind === "query") {
      this.query = value;
      this.table.choose(value.at);
      this.showNote(value);
      if (this.selecting && value.at < 0 && this.head?.total) this.context.act("step", { by: 0 }); // a choice shows one of its queries
      this.selecting = false;
    } else if (kind === "charts") this.charts.show(value);
    else if (kind === "map") this.map.show(value, this.context.view);
    else if (kind === "tip") this.map.tip(value);
    else if (kind === "busy") this.showBusy(value);
    else if (kind === "saved") this.showSaved(value);
    else if (kind === "file") make("a", { href: value.address, download: value.name }).click();
  }

  draw(view) {
    const { state } = view;
    for (const one of findAll("[data-tab]", this.box)) one.setAttribute("aria-pressed", String(one.dataset.tab === state.lab_tab));
    for (const one of findAll("[data-show]", this.box)) one.setAttribute("aria-pressed", String(one.dataset.show === state.lab_show));
    for (const one of find(".body", this.box).children) one.hidden = !one.classList.contains(state.lab_tab);
    find(".columns", this.box).hidden = state.lab_tab !== "table";
    if (!this.typing && document.activeElement !== this.input) this.input.value = state.lab_where;
    find(".note", this.box).hidden = state.lab_tab === "charts" || this.note.query < 0;
    if (state.lab_tab === "table") this.table.redraw();
    if (state.lab_tab === "charts") this.charts.draw(state.theme);
    if (state.lab_tab === "map") this.map.draw(view);
  }

  drawHead() {
    const { head } = this;
    for (const button of findAll("[data-show]", this.box)) {
      const count = head.counts[button.dataset.show];
      button.hidden = count === undefined;
      if (button.dataset.show === "near") button.title = "Missed, with the truth among the first five tiles";
      button.replaceChildren(SHOWN[button.dataset.show], " ", make("i", { text: (count ?? 0).toLocaleString("en") }));
    }
    const middle = head.names.includes("altitude") ? "altitude > 120" : "margin < -0.1";
    this.input.placeholder = `Filter, such as ${head.models ? "rank A > 1 and rank B = 1" : `rank > 5 and ${middle}`}`;
    find(".help div", this.box).replaceChildren(make("p", { text: HELP }), ...head.names.map((name) => chip(name, { "data-column": name })));
    const error = find(".error", this.box);
    error.textContent = [head.error && `${head.error} The rows are those of ${head.where || "no filter"}.`, head.notes_error, head.unlike].filter(Boolean).join(" ");
    if (head.unlike) error.append(" ", chip("Calibrate B, too", { "data-act": "calibrate" }));
    error.hidden = !error.textContent;
    const shown = head.columns.map(({ name }) => name);
    const open = head.further.map((name) => make("label", {}, make("input", { type: "checkbox", value: name, checked: shown.includes(name) }), name));
    find(".columns div", this.box).replaceChildren(...open);
    const select = find(".counts select", this.box);
    const second = this.context.view.state.lab_second;
    const models = [["", "Model B"], ...Object.entries(head.beside)];
    select.replaceChildren(...models.map(([number, label]) => make("option", { value: number, selected: number === second, text: number ? `B: ${label}` : label })));
    select.title = second ? `Rank B is that of ${head.beside[second]}` : "Compare with the ranks of a second model";
    select.hidden = models.length < 2;
    this.drawCounts();
  }

  drawCounts() {
    const { head } = this;
    const number = (value) => value.toLocaleString("en");
    const photos = head.total === head.queries ? `${number(head.queries)} photos` : `${number(head.total)} of ${number(head.queries)}`;
    const share = head.graded ? `, ${((100 * head.missed) / head.graded).toFixed(1)} % missed` : "";
    const ungraded = head.total - head.graded;
    const title = `${number(head.missed)} of ${number(head.graded)} missed, under equal part weights. Level of evidence: ${head.claim}`;
    const marked = this.table.marked.size;
    find(".counts span", this.box).replaceChildren(
      make("span", { text: `${photos}${share}${ungraded ? `, ${number(ungraded)} not graded` : ""}`, title }), " ",
      ...(head.picked ? [chip(`${number(head.picked)} picked ✕`, { "data-act": "picked", title: "Show the others again" })] : []),
      ...(marked ? [chip(`Only the ${number(marked)} marked`, { "data-act": "only" }), chip("✕", { "data-act": "none", "aria-label": "Mark none" })] : []),
    );
  }

  showBusy({ text, failed, done = 0, total = 0 }) {
    const line = find(".busy", this.box);
    line.hidden = !text;
    line.classList.toggle("failed", failed);
    line.replaceChildren(total ? `${text}: ${done.toLocaleString("en")} of ${total.toLocaleString("en")}` : text);
    if (total) line.append(make("progress", { max: total, value: done, "aria-label": text }));
  }

  /** Save what is typed. */
  saveNote() {
    const { query, task, tags, text } = this.note;
    this.context.act("note", { query, task, ...this.typed(), before: { tags, text } });
  }

  typed() {
    const form = find(".note", this.box);
    return { tags: find("input", form).value, text: find("textarea", form).value };
  }

  /** Show the note of the query, unless a person is writing on another state of it. */
  showNote({ query, name, task, note }) {
    const [form, left, { place }] = [find(".note", this.box), this.typed(), this.context.view.state];
    const other = query !== this.note.query || task !== this.note.task || place !== this.note.place;
    if (other && place === this.note.place && (left.tags !== this.note.tags || left.text !== this.note.text)) this.saveNote();
    form.hidden = !note || this.context.view.state.lab_tab === "charts";
    if (!note) return (this.note = { query: -1, tags: "", text: "" });
    const { tags, text } = note;
    if (!other && tags === this.note.tags && text === this.note.text) return;
    const [words, area, said] = ["input", "textarea", "span"].map((one) => find(one, form));
    if (!other && form.contains(document.activeElement)) return;
    this.note = { query, task, place, tags, text };
    find("b", form).textContent = name;
    [words.value, area.value] = [tags, text];
    if (other) said.textContent = "";
  }

  showSaved({ text, good, query, stored }) {
    if (query < 0) {
      if (good) find(".tag", this.box).value = "";
      return this.showBusy({ text, failed: !good });
    }
    if (query !== this.note.query) return good || this.showBusy({ text, failed: true });
    const form = find(".note", this.box);
    const said = find("span", form);
    said.textContent = text;
    said.classList.toggle("wrong", !good);
    if (good) Object.assign(this.note, this.typed());
    else if (stored) Object.assign(this.note, stored);
  }
}
