// The place in 3-D: viser's page in a frame, made once the first result is painted. The server draws in it.

import { tab } from "./channel.js";
import { find, findAll, make } from "./dom.js";

const PATIENCE = 1500; // ms after which the frame is made even if the page is busy

const whenIdle = (work) => (window.requestIdleCallback ? requestIdleCallback(work, { timeout: PATIENCE }) : setTimeout(work, PATIENCE));

export class SceneFrame {
  /**
   * @param {any} box
   * @param {{act: (name: string, args?: any) => void}} channel
   * @param {{press: (event: KeyboardEvent) => void, release: (event: KeyboardEvent) => void}} keys handlers of keys
   * @param {(found: any) => void} picked receives the target of the pointer, a tile, a part, or nothing, and `why`
   */
  constructor(box, channel, keys, picked) {
    this.box = box;
    this.channel = channel;
    this.keys = keys;
    this.picked = picked;
    /** @type {any} */
    this.frame = null;
    /** @type {boolean | null | undefined} whether this browser has WebGL; null before it is looked for */
    this.live = null;
  }

  /** Make the frame, or hide the box: without WebGL, and for a task without a place (a city or a map). */
  show(views, view, place) {
    find("[data-view=city]", this.box).textContent = place;
    this.box.hidden = this.live === false || !views.length;
    for (const button of findAll("[data-view]", this.box)) {
      button.hidden = !views.includes(button.dataset.view);
      button.setAttribute("aria-pressed", String(button.dataset.view === (views.includes(view) ? view : views[0])));
    }
    if (this.box.hidden || this.live !== null) return;
    this.live = undefined; // WebGL is looked for once
    whenIdle(() => {
      this.live = Boolean(document.createElement("canvas").getContext("webgl2"));
      if (this.live) this.begin();
      else this.box.hidden = true;
    });
  }

  begin() {
    this.frame = make("iframe", { title: "The place in 3-D", tabindex: -1 });
    this.frame.src = `scene/${tab}/?darkMode&hideViserLogo&fixedDpr=1`;
    this.frame.addEventListener("load", () => this.listen());
    this.box.append(this.frame);
  }

  /** The server has drawn in the frame. */
  ready() {
    this.box.classList.add("ready");
  }

  /** Hide viser's page, because the connection is lost, or another place comes. */
  away() {
    this.box.classList.remove("ready");
  }

  /** viser's page connects again by itself only while it has the focus, which this page keeps. */
  reload() {
    this.away();
    this.frame?.setAttribute("src", this.frame.src); // the user cannot reload the browser's error page in it
  }

  /** Send keys to the screen, and the pointer's position to the server. */
  listen() {
    if (!this.frame.contentDocument) return; // the browser's error page
    const inner = this.frame.contentWindow;
    inner.addEventListener("keydown", (event) => {
      event.stopImmediatePropagation();
      this.keys.press(event);
    }, true);
    inner.addEventListener("keyup", this.keys.release, true);
    let down = null;
    const place = (event) => {
      const canvas = find("canvas", inner.document);
      if (!canvas) return null;
      const box = canvas.getBoundingClientRect();
      return { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height };
    };
    const ask = (event, why) => {
      const at = place(event);
      if (!at || Math.min(at.x, at.y) < 0 || Math.max(at.x, at.y) > 1) return;
      this.channel.act("pick", { ...at, why });
    };
    inner.addEventListener("pointerdown", (event) => (down = event), true);
    inner.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < 4) ask(event, "click");
      down = null;
    }, true);
    let last = 0;
    inner.addEventListener("pointermove", (event) => {
      if (down || event.timeStamp - last < 60) return;
      last = event.timeStamp;
      ask(event, "hover");
    }, true);
  }
}
