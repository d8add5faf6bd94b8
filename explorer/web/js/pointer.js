// A frame around a place of the page, and a card beside it that covers neither the place nor what people read.
(() => {
  const lpn = window.lpn;
  if (lpn.point) return;
  const GAP = 12, EDGE = 4;
  let placing = 0;

  // Return the rectangle of a place on the screen, and the left end of the panel around it: that of a visible element.
  const subject = ({ selectors }) => {
    for (const selector of selectors) {
      const found = document.querySelector(selector)?.getBoundingClientRect();
      if (!found || !found.width) continue;
      const scrolled = document.querySelector(selector).closest(lpn.viser.SELECTORS.scrolled)?.getBoundingClientRect();
      const frame = scrolled || { left: 0, top: 0, right: innerWidth, bottom: innerHeight };
      const left = Math.max(found.left, frame.left), top = Math.max(found.top, frame.top);
      const right = Math.min(found.right, frame.right), bottom = Math.min(found.bottom, frame.bottom);
      const enough = Math.min(60, 0.8 * found.height);
      if (bottom - top > enough && right - left > 20) return { left, top, right, bottom, panel: frame.left };
    }
    return null;
  };

  // The texts that people read meanwhile.
  const read = () =>
    [...lpn.places.verdict.selectors, ...lpn.places.window.selectors]
      .map((selector) => document.querySelector(selector)?.getBoundingClientRect())
      .filter(Boolean);

  // Place the card beside its subject or in a corner, wherever it covers least of the subject, then of what people read.
  const placed = (card, box) => {
    const width = card.offsetWidth, height = card.offsetHeight;
    const right = innerWidth - width - GAP, bottom = innerHeight - height - GAP;
    /** @param {Point} at */
    const inside = ([x, y]) => [Math.min(Math.max(x, GAP), right), Math.min(Math.max(y, GAP), bottom)];
    box ||= { left: 0, top: innerHeight, right: 0, bottom: innerHeight, panel: 0 };
    const places = [
      [box.right + GAP, box.top],
      [box.left - width - GAP, box.top],
      [box.panel - width - GAP, box.top],
      [box.left, box.bottom + GAP],
      [box.left, box.top - height - GAP],
      [GAP, GAP],
      [right, GAP],
      [GAP, bottom],
      [right, bottom],
    ].map(inside);
    const common = ([x, y], other) =>
      Math.max(0, Math.min(x + width, other.right) - Math.max(x, other.left)) *
      Math.max(0, Math.min(y + height, other.bottom) - Math.max(y, other.top));
    const others = read();
    const covers = (at) => 1e3 * common(at, box) + others.reduce((sum, other) => sum + common(at, other), 0);
    return places.reduce((best, place) => (covers(place) < covers(best) ? place : best));
  };

  // Frame a place by its name, and keep a card beside it; without a name, frame nothing and leave the card to the style sheet.
  lpn.point = (card, name) => {
    clearInterval(placing);
    const old = document.getElementById("lpn-spot");
    const where = lpn.places[name];
    if (!where) {
      old?.remove();
      if (card) card.style.left = card.style.top = "";
      return;
    }
    const spot = old || document.body.appendChild(document.createElement("div"));
    spot.id = "lpn-spot";
    // A step before may have scrolled its panel away from it.
    where.selectors.map((selector) => document.querySelector(selector)).find((one) => one?.getBoundingClientRect().width)?.scrollIntoView({ block: "nearest" });
    const place = () => {
      const box = subject(where);
      spot.hidden = !box;
      if (box) {
        spot.style.left = box.left - EDGE + "px";
        spot.style.top = box.top - EDGE + "px";
        spot.style.width = box.right - box.left + 2 * EDGE + "px";
        spot.style.height = box.bottom - box.top + 2 * EDGE + "px";
      }
      [card.style.left, card.style.top] = placed(card, box).map((pixels) => pixels + "px");
    };
    place();
    placing = lpn.every(200, place); // the stage and the panels move when they are fitted anew, seconds after a resize
  };
})();
