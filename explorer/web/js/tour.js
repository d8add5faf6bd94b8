// The tour: cards beside their subjects, shown at the first visit and on request.
(() => {
  const lpn = window.lpn;
  if (lpn.tour) return;
  const GAP = 12;
  const STORAGE_KEY = "lpn-tour";
  let at = -1; // the step that is shown, -1 for none

  const seen = () => {
    try {
      return localStorage.getItem(STORAGE_KEY) !== null;
    } catch {
      return true; // without storage, the tour would start at every visit
    }
  };

  // Return the rectangle of a step's subject on the screen: a visible element, else a box on the stage.
  const subject = (step) => {
    for (const selector of step.selectors) {
      const box = document.querySelector(selector)?.getBoundingClientRect();
      if (!box || !box.width) continue;
      const scrolled = document.querySelector(selector).closest(".mantine-ScrollArea-viewport")?.getBoundingClientRect();
      const frame = scrolled || { left: 0, top: 0, right: innerWidth, bottom: innerHeight };
      const left = Math.max(box.left, frame.left), top = Math.max(box.top, frame.top);
      const right = Math.min(box.right, frame.right), bottom = Math.min(box.bottom, frame.bottom);
      const enough = Math.min(60, 0.8 * box.height);
      if (bottom - top > enough && right - left > 20) return { left, top, right, bottom };
    }
    const canvas = document.querySelector("canvas[data-engine]")?.getBoundingClientRect();
    if (!step.box || !canvas) return null;
    const { height, width, middle } = lpn.scene;
    const unit = canvas.height / Math.max(height, (width * canvas.height) / canvas.width);
    const x = (value) => canvas.left + canvas.width / 2 + (value - middle[0]) * unit;
    const y = (value) => canvas.top + canvas.height / 2 - (value - middle[1]) * unit;
    return { left: x(step.box[0]), top: y(step.box[3]), right: x(step.box[2]), bottom: y(step.box[1]) };
  };

  // Place the card beside its subject or in a corner, wherever it covers least of the subject.
  const placed = (card, box) => {
    const width = card.offsetWidth, height = card.offsetHeight;
    const right = innerWidth - width - GAP, bottom = innerHeight - height - GAP;
    const inside = ([x, y]) => [Math.min(Math.max(x, GAP), right), Math.min(Math.max(y, GAP), bottom)];
    if (!box) return [GAP, bottom];
    const places = [
      [box.right + GAP, box.top],
      [box.left - width - GAP, box.top],
      [box.left, box.bottom + GAP],
      [box.left, box.top - height - GAP],
      [GAP, GAP],
      [right, GAP],
      [GAP, bottom],
      [right, bottom],
    ].map(inside);
    const covers = ([x, y]) =>
      Math.max(0, Math.min(x + width, box.right) - Math.max(x, box.left)) *
      Math.max(0, Math.min(y + height, box.bottom) - Math.max(y, box.top));
    return places.reduce((best, place) => (covers(place) < covers(best) ? place : best));
  };

  const element = (id) => {
    const node = document.getElementById(id) || document.body.appendChild(document.createElement("div"));
    node.id = id;
    return node;
  };

  const show = () => {
    const step = lpn.steps[at];
    const card = element("lpn-tour"), spot = element("lpn-spot");
    const last = at === lpn.steps.length - 1;
    card.setAttribute("role", "dialog");
    card.setAttribute("aria-label", "Tour");
    card.innerHTML = step.html +
      '<div class="foot"><span></span><button class="skip" title="Escape">Skip</button><button class="next"></button></div>';
    card.querySelector(".foot span").textContent = at + 1 + " of " + lpn.steps.length;
    card.querySelector(".next").textContent = last ? "Done" : "Next";
    card.querySelector(".skip").hidden = last;
    card.querySelector(".skip").onclick = end;
    card.querySelector(".next").onclick = () => (last ? end() : (at++, show()));
    const box = subject(step);
    spot.hidden = !box;
    if (box) {
      const edge = 4;
      spot.style.left = box.left - edge + "px";
      spot.style.top = box.top - edge + "px";
      spot.style.width = box.right - box.left + 2 * edge + "px";
      spot.style.height = box.bottom - box.top + 2 * edge + "px";
    }
    const [x, y] = placed(card, box);
    card.style.left = x + "px";
    card.style.top = y + "px";
  };

  const end = () => {
    at = -1;
    for (const id of ["lpn-tour", "lpn-spot"]) document.getElementById(id)?.remove();
    try {
      localStorage.setItem(STORAGE_KEY, "seen");
    } catch {}
  };

  lpn.tour = () => {
    at = 0;
    show();
  };
  window.addEventListener("resize", () => at >= 0 && show());
  window.addEventListener("keydown", (event) => event.key === "Escape" && at >= 0 && end(), true);

  // Called when the first analysis is shown.
  lpn.welcome = () => !seen() && setTimeout(() => at < 0 && lpn.tour(), 700);
})();
