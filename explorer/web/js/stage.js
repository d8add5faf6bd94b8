// The controls over the stage: they lie where the server's layout has the pictures, and link what belongs to one part.
(() => {
  const lpn = window.lpn;
  if (lpn.stage) return;
  // Milliseconds between two angles that are sent while the query is turned by hand.
  const PERIOD = 120;
  const hud = document.body.appendChild(document.createElement("div"));
  hud.id = "lpn-hud";

  lpn.placeStage = () => {
    const box = lpn.canvas()?.getBoundingClientRect();
    if (!box) return;
    for (const side of /** @type {const} */ (["left", "top", "width", "height"])) hud.style[side] = box[side] + "px";
  };
  lpn.stage = (html) => {
    if (!held) hud.innerHTML = html;
    else late = html;
    hud.hidden = !html;
    document.documentElement.classList.add("lpn-staged");
    lpn.placeStage();
    link(linked);
  };

  // Another place is coming: its pictures will lie about where those of the last one lay.
  lpn.clearStage = () => {
    held = late = null;
    link(-1);
    lpn.stageMap(null);
    lpn.stagePhoto(null);
    const places = [...hud.querySelectorAll("#lpn-stage-query, #lpn-stage-tile, #lpn-stage-cards")];
    hud.replaceChildren(...places.map((place) => {
      const coming = document.createElement("div");
      coming.className = "place coming";
      coming.style.cssText = /** @type {HTMLElement} */ (place).style.cssText;
      return coming;
    }));
  };

  // ---- a part under the mouse: its borders on both pictures, its bars, its rows, and its share of each tile
  let linked = -1;
  const SVG = "http://www.w3.org/2000/svg";
  /** @type {(place: HTMLElement, part: number) => void} */
  const outline = (place, part) => {
    place.querySelector("svg")?.remove();
    /** @type {[number, number, number, number][]} */
    const boxes = JSON.parse(place.dataset.boxes || "[]");
    if (part < 0 || !boxes[part]) return;
    const rectangle = ([left, top, right, bottom]) => `M${left} ${top}H${right}V${bottom}H${left}Z`;
    const area = ([left, top, right, bottom]) => (right - left) * (bottom - top);
    // The next smaller box inside is that of the ring within.
    const inner = boxes.filter((one) => area(one) < area(boxes[part])).sort((one, other) => area(other) - area(one))[0];
    const within = inner && inner[0] >= boxes[part][0] && inner[2] <= boxes[part][2] && inner[1] >= boxes[part][1] && inner[3] <= boxes[part][3];
    const drawn = place.insertBefore(document.createElementNS(SVG, "svg"), place.firstChild);
    drawn.setAttribute("viewBox", "0 0 1 1");
    drawn.setAttribute("preserveAspectRatio", "none");
    const path = drawn.appendChild(document.createElementNS(SVG, "path"));
    path.setAttribute("d", "M0 0H1V1H0Z" + rectangle(boxes[part]) + (within ? rectangle(inner) : ""));
  };
  /** @type {(part: number) => void} */
  const link = (part) => {
    linked = part;
    document.documentElement.classList.toggle("lpn-linked", part >= 0);
    for (const one of document.querySelectorAll("[data-part].linked")) one.classList.remove("linked");
    if (part >= 0) for (const one of document.querySelectorAll(`[data-part="${part}"]`)) one.classList.add("linked");
    for (const place of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("[data-boxes]"))) outline(place, part);
  };
  /** @type {(event: PointerEvent) => number} */
  const under = (event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    const own = target.closest?.("[data-part]");
    if (own) return Number(own.getAttribute("data-part"));
    const map = target.closest?.("[data-boxes]");
    const places = target === lpn.canvas() ? hud.querySelectorAll("[data-boxes]") : map ? [map] : [];
    for (const place of /** @type {Iterable<HTMLElement>} */ (places)) {
      const size = place.getBoundingClientRect(), x = (event.clientX - size.left) / size.width, y = (event.clientY - size.top) / size.height;
      /** @type {[number, number, number, number][]} */
      const boxes = JSON.parse(place.dataset.boxes || "[]");
      const around = boxes.map((_, part) => part).filter((part) => boxes[part][0] <= x && x <= boxes[part][2] && boxes[part][1] <= y && y <= boxes[part][3]);
      const area = (part) => (boxes[part][2] - boxes[part][0]) * (boxes[part][3] - boxes[part][1]);
      if (around.length) return around.reduce((best, part) => (area(part) < area(best) ? part : best));
    }
    return -1;
  };
  // A finger that moves over the pictures would turn the camera until they are out of sight. It turns the map, and rings that are
  // taken apart.
  let finger = null; // the touch that began on the stage
  const FINGER = 0.3; // of the turn by a mouse: a phone's stage is low, and one swipe would throw the rings out of sight
  window.addEventListener("pointerdown", ({ pointerType, target, pointerId }) => {
    const controls = lpn.viser.cameraControls(), slow = pointerType === "touch" && !document.getElementById("lpn-stage-map");
    if (controls && target === lpn.canvas()) controls.azimuthRotateSpeed = controls.polarRotateSpeed = slow ? FINGER : 1;
    const flat = pointerType === "touch" && target === lpn.canvas() && !hud.hidden && hud.querySelector("[data-flat]") && straight();
    if (flat) finger = pointerId;
  }, true);
  window.addEventListener("pointermove", (event) => event.pointerId === finger && event.stopImmediatePropagation(), true);
  for (const kind of /** @type {const} */ (["pointerup", "pointercancel"])) window.addEventListener(kind, (event) => event.pointerId === finger && (finger = null), true);

  const straight = () => !document.getElementById("lpn-straighten");
  window.addEventListener("pointermove", (event) => {
    if (held || event.pointerType !== "mouse" || event.buttons) return;
    const part = straight() ? under(event) : -1;
    if (part !== linked) link(part);
  }, { passive: true });
  document.documentElement.addEventListener("pointerleave", () => link(-1));
  document.addEventListener("focusin", ({ target }) => {
    const own = /** @type {HTMLElement} */ (target).closest?.("#lpn-bars [data-part]");
    if (own || linked >= 0) link(own ? Number(own.getAttribute("data-part")) : -1);
  });

  // ---- the handle that turns the query
  let held = null; // the pointer's angle and the query's, when the handle was taken
  let late = null; // controls that came while it was held
  let newest = 0, sending = 0;
  const wrap = (angle) => Math.round(((((angle + 180) % 360) + 360) % 360) - 180);
  const pointed = (event, size) => (Math.atan2(-(event.clientY - size.top - size.height / 2), event.clientX - size.left - size.width / 2) * 180) / Math.PI;
  const turned = (angle) => {
    const knob = document.getElementById("lpn-turn"), shown = /** @type {HTMLElement} */ (hud.querySelector(".angle"));
    if (!knob) return;
    const radians = (angle * Math.PI) / 180;
    knob.style.left = 50 - 42 * Math.sin(radians) + "%";
    knob.style.top = 50 - 42 * Math.cos(radians) + "%";
    knob.setAttribute("aria-valuenow", String(angle));
    shown.hidden = !angle;
    shown.textContent = (angle > 0 ? "+" : angle < 0 ? "\u2212" : "") + Math.abs(angle) + "°";
  };
  const send = () => {
    sending ||= setTimeout(() => {
      sending = 0;
      lpn.send("stage-turn", newest);
    }, PERIOD);
  };
  const turn = (angle) => {
    newest = wrap(angle);
    turned(newest);
    send();
  };
  const now = () => Number(document.getElementById("lpn-turn")?.getAttribute("aria-valuenow"));
  hud.addEventListener("pointerdown", (event) => {
    const knob = /** @type {HTMLElement} */ (event.target).closest("#lpn-turn");
    if (!knob) return;
    event.preventDefault();
    const size = document.getElementById("lpn-stage-query").getBoundingClientRect();
    held = { size, from: pointed(event, size), angle: now() };
  });
  window.addEventListener("pointermove", (event) => {
    if (held) turn(held.angle + pointed(event, held.size) - held.from);
  });
  for (const kind of ["pointerup", "pointercancel"])
    window.addEventListener(kind, () => {
      if (!held) return;
      held = null;
      if (late !== null) [hud.innerHTML, late] = [late, null];
    });
  hud.addEventListener("dblclick", (event) => /** @type {HTMLElement} */ (event.target).id === "lpn-turn" && turn(0));
  hud.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: 1, ArrowUp: 1, ArrowRight: -1, ArrowDown: -1, PageUp: 15, PageDown: -15 }[event.key];
    if (/** @type {HTMLElement} */ (event.target).id !== "lpn-turn" || !(step || event.key === "Home")) return;
    event.preventDefault();
    event.stopPropagation();
    turn(step ? now() + step : 0);
  });
})();
