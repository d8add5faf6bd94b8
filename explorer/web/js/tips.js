// The meaning of a term, beside it: under the mouse, at the focus, or after a tap. Escape hides it.
(() => {
  const lpn = window.lpn;
  if (lpn.hideTip) return;
  const GAP = 6;
  const termOf = (event) => event.target.closest?.(".term");

  lpn.hideTip = () => {
    document.getElementById("lpn-term")?.remove();
    document.querySelectorAll(".term[aria-describedby]").forEach((term) => term.removeAttribute("aria-describedby"));
  };

  const show = (term) => {
    lpn.hideTip();
    const tip = document.body.appendChild(document.createElement("div"));
    tip.id = "lpn-term";
    tip.setAttribute("role", "tooltip");
    tip.textContent = term.dataset.tip;
    term.setAttribute("aria-describedby", tip.id);
    const box = term.getBoundingClientRect();
    const left = Math.min(box.left, innerWidth - tip.offsetWidth - GAP);
    const below = box.bottom + GAP + tip.offsetHeight < innerHeight;
    tip.style.left = Math.max(left, GAP) + "px";
    tip.style.top = Math.max(below ? box.bottom + GAP : box.top - GAP - tip.offsetHeight, GAP) + "px";
  };

  for (const kind of ["mouseover", "focusin", "click"])
    document.addEventListener(kind, (event) => (termOf(event) ? show(termOf(event)) : kind !== "focusin" && lpn.hideTip()));
  document.addEventListener("focusout", lpn.hideTip);
  // The page scrolls to what gets the focus.
  document.addEventListener("scroll", () => (document.activeElement?.matches(".term[aria-describedby]") ? show(document.activeElement) : lpn.hideTip()), true);
  document.addEventListener("keydown", (event) => event.key === "Escape" && lpn.hideTip(), true);
})();
