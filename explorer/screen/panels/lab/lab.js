// The laboratory beside the rings: all queries in a table, in charts, and on maps, and the shown query's note.

import { find, findAll, make } from "../../page/dom.js";
import { Fragment, listen, put } from "../../page/fragment.js";
import { PointMap } from "./map.js";
import { QueryTable } from "./table.js";

const PAUSE = 250; // milliseconds after the last letter of a filter
const STEPS = { n: 1, arrowdown: 1, p: -1, arrowup: -1, pagedown: 10, pageup: -10 };
const NO_NOTE = { query: -1, tags: "", text: "" };
export const open = async (box, context) => {
  box.innerHTML = await (await fetch("screen/panels/lab/lab.html")).text();
  return new Laboratory(box, context);
};

class Laboratory {
  constructor(box, context) {
    this.context = context;
    this.head = this.query = null;
    this.typing = 0;
    this.selecting = false;
    this.note = NO_NOTE; // as it is stored
    this.box = find(".lab", box);
    const { set, act } = context;
    // A choice in a chart or by a lasso shows one of its queries.
    const select = (change) => (...given) => {
      this.selecting = true;
      change(...given);
    };
    this.table = new QueryTable(find(".body .table", box), { set, marked: () => this.drawMarked() });
    this.charts = new Fragment(find(".body .charts", box), { set });
    this.map = new PointMap(find(".body .map", box), { set, act: (name, args) => (name === "lasso" ? select(act) : act)(name, args) });
    listen(this.box, { set: (values) => ("lab_where" in values || values.lab_picked ? select(set) : set)(values), act });
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
    this.box.addEventListener("change", (event) => {
      if (!event.target.closest(".columns")) return;
      const names = findAll(".columns input:checked", box).map((one) => one.value);
      set({ lab_columns: names.join(",") || "-" });
    });
    this.form = find(".note", box);
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.saveNote();
    });
    this.form.addEventListener("input", () => this.saySaved("Not saved yet"));
    this.keys = (event) => this.pressed(event);
    addEventListener("keydown", this.keys, true);
  }

  close() {
    removeEventListener("keydown", this.keys, true);
    this.map.close();
    this.table.close();
  }

  clicked(target) {
    const { act, column } = target.closest("button")?.dataset ?? {};
    if (act === "only") this.context.act("pick", { rows: this.table.takeMarked() });
    else if (act === "none") this.table.takeMarked();
    else if (column) {
      this.input.value = `${this.input.value}${this.input.value ? " and " : ""}${column} `;
      this.input.focus();
    }
  }

  /** The arrow keys, N, and P walk the rows. */
  pressed(event) {
    const by = STEPS[event.key.toLowerCase()];
    if (event.ctrlKey || event.metaKey || event.altKey || by === undefined) return;
    if (event.target.closest?.("input, textarea, select, dialog, .leaflet-container, summary")) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    this.context.act("step", { by });
  }

  receive(message) {
    const [[kind, value]] = Object.entries(message);
    if (kind === "table") {
      this.head = value;
      this.table.show(value);
      for (const [name, html] of Object.entries(value.html)) put(find(`[data-html=${name}]`, this.box), html);
      this.input.placeholder = value.placeholder;
      this.drawMarked();
    } else if (kind === "query") {
      this.query = value;
      this.table.choose(value.at);
      this.showNote(value);
      if (this.selecting && value.at < 0 && this.head?.total) this.context.act("step", { by: 0 });
      this.selecting = false;
    } else if (kind === "charts") this.charts.show(value.html);
    else if (kind === "map") this.map.show(value, this.context.view);
    else if (kind === "tip") this.map.tip(value);
    else if (kind === "busy") this.showBusy(value);
    else if (kind === "saved") this.showSaved(value);
  }

  draw(view) {
    const { lab_tab: tab, lab_where: where } = view.state;
    for (const one of findAll("[data-tab]", this.box)) one.setAttribute("aria-pressed", String(one.dataset.tab === tab));
    for (const one of find(".body", this.box).children) one.hidden = !one.classList.contains(tab);
    find("[data-html=columns]", this.box).hidden = tab !== "table";
    if (!this.typing && document.activeElement !== this.input) this.input.value = where;
    this.form.hidden = tab === "charts" || this.note.query < 0;
    if (tab === "table") this.table.redraw();
    else if (tab === "charts") this.charts.draw();
    else this.map.draw(view);
  }

  drawMarked() {
    const marked = this.table.marked().length;
    const chips = [make("button", { class: "chip", "data-act": "only", text: `Only the ${marked.toLocaleString("en")} marked` }), make("button", { class: "chip", "data-act": "none", "aria-label": "Mark none", text: "✕" })];
    find(".marked", this.box).replaceChildren(...(marked ? chips : []));
  }

  showBusy({ text, failed, done = 0, total = 0 }) {
    const line = find(".busy", this.box);
    line.hidden = !text;
    line.classList.toggle("failed", failed);
    line.replaceChildren(total ? `${text}: ${done.toLocaleString("en")} of ${total.toLocaleString("en")}` : text);
    if (total) line.append(make("progress", { max: total, value: done, "aria-label": text }));
  }

  /** Save the typed tags and note. */
  saveNote() {
    const { query, task, tags, text } = this.note;
    this.context.act("note", { query, task, ...this.typed(), before: { tags, text } });
  }

  saySaved(text, wrong = false) {
    const said = find("span", this.form);
    said.textContent = text;
    said.classList.toggle("wrong", wrong);
  }

  typed() {
    return { tags: find("input", this.form).value, text: find("textarea", this.form).value };
  }

  /** Show the query's note, unless the user is editing another state of it. */
  showNote({ query, name, task, note }) {
    const { form, note: { query: of, task: ofTask, place: ofPlace, tags: oldTags, text: oldText } } = this;
    const [typed, { place }] = [this.typed(), this.context.view.state];
    const other = query !== of || task !== ofTask || place !== ofPlace;
    if (other && place === ofPlace && (typed.tags !== oldTags || typed.text !== oldText)) this.saveNote();
    form.hidden = !note || this.context.view.state.lab_tab === "charts";
    if (!note) return (this.note = NO_NOTE);
    const { tags, text } = note;
    if (!other && ((tags === oldTags && text === oldText) || form.contains(document.activeElement))) return;
    this.note = { query, task, place, tags, text };
    [find("b", form).textContent, find("input", form).value, find("textarea", form).value] = [name, tags, text];
    if (other) this.saySaved("");
  }

  showSaved({ text, good, query, stored }) {
    if (query < 0) {
      if (good) find(".tag", this.box).value = "";
      return this.showBusy({ text, failed: !good });
    }
    if (query !== this.note.query) return good || this.showBusy({ text, failed: true });
    this.saySaved(text, !good);
    this.note = { ...this.note, ...(good ? this.typed() : stored) };
  }
}
