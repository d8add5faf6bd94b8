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

  // The keyboard's focus keeps its tip: the page scrolls to what gets the focus, and may then have another element under the mouse.
  const keep = () => {
    const term = document.querySelector(".term[aria-describedby]:focus-visible");
    term ? show(term) : lpn.hideTip();
  };

  // A tap is followed by moves of a mouse that is not there, which may lie beside what was tapped.
  document.addEventListener("pointerover", (event) => event.pointerType === "mouse" && (termOf(event) ? show(termOf(event)) : keep()));
  document.addEventListener("focusin", (event) => termOf(event) && show(termOf(event)));
  document.addEventListener("click", (event) => (termOf(event) ? show(termOf(event)) : lpn.hideTip()));
  document.addEventListener("focusout", lpn.hideTip);
  document.addEventListener("scroll", keep, true);
  document.addEventListener("keydown", (event) => event.key === "Escape" && lpn.hideTip(), true);
})();
