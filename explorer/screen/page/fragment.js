// A panel whose Python sends HTML, see `explorer/screen/fragments.py`. Attributes of its elements:
// `data-set` sets fields, `data-field` sets one field to the chosen value, `data-do` runs an action, and `data-chart` is a chart.

import { find, findAll, make } from "./dom.js";
import { makePicture, rollPicture, showPicture } from "./pictures.js";
import { plot } from "./plot.js";

const LIVE = "button, select, input, textarea, summary";

/** Put HTML into a box, and preserve open, focused, and scrolled elements. */
export const put = (box, html) => {
  const open = findAll("details[open] > summary", box).map((one) => one.textContent);
  const focused = findAll(LIVE, box).indexOf(document.activeElement);
  box.innerHTML = html;
  for (const one of findAll("details > summary", box)) one.parentElement.open = open.includes(one.textContent);
  if (focused >= 0) findAll(LIVE, box)[focused]?.focus({ preventScroll: true });
};

/** Handle events of a box's elements. */
export const listen = (box, { set, act }) => {
  box.addEventListener("click", (event) => {
    const one = event.target.closest("[data-set], [data-do]");
    if (one?.dataset.set) set(JSON.parse(one.dataset.set));
    if (one?.dataset.do) act(one.dataset.do);
  });
  box.addEventListener("change", (event) => {
    const { field } = event.target.dataset;
    if (field) set({ [field]: event.target.value });
  });
};

/** HTML with charts, in the theme's colours and at the available width. */
export class Fragment {
  constructor(box, { set }) {
    this.box = box;
    this.set = set;
    this.html = this.drawn = "";
  }

  /** Show other HTML. */
  show(html) {
    if (html === this.html) return;
    this.html = html;
    put(this.box, html);
    this.drawn = "";
    this.draw();
  }

  /** Redraw the charts if the theme or the available width has changed. */
  async draw() {
    const { box } = this;
    const now = `${document.documentElement.className} ${box.clientWidth}`;
    if (now === this.drawn) return;
    this.drawn = now;
    const frame = box.closest(".content") ?? box;
    const [top, within] = [frame.scrollTop, box.scrollTop];
    await Promise.all(findAll("[data-chart]", box).map((one) => {
      const chart = JSON.parse(one.dataset.chart);
      return plot(one, chart, (at) => chart.pick && this.set({ [chart.pick]: at }));
    }));
    [frame.scrollTop, box.scrollTop] = [top, within];
  }
}

/** Open such a panel. At `data-photo` it draws the result's photo with the changes in a message's `photo`. */
export const open = (box, { set, act, view }) => {
  const page = box.appendChild(make("div", { class: "fragment" }));
  const fragment = new Fragment(page, { set });
  const figure = makePicture();
  let photo = null;
  listen(page, { set, act });
  const drawPhoto = () => {
    find("[data-photo]", page)?.replaceWith(figure);
    if (!photo || !view.result) return;
    const shown = { ...view.result.photo, ...photo };
    showPicture(figure, shown, view.focus, view.page.parts, "none", "The photo, painted by what its places speak for");
    rollPicture(figure, shown, view.result.angle);
  };
  return {
    receive: (message) => {
      photo = message.photo ?? null;
      fragment.show(message.html);
      drawPhoto();
    },
    draw: () => {
      fragment.draw();
      drawPhoto();
    },
    close: () => page.remove(),
  };
};
