// An exported story: one slide at a time, by buttons, arrow keys, and Page keys. Without this script all slides stand below each other.
(() => {
  const slides = [...document.querySelectorAll(".slide")];
  const [previous, next] = /** @type {NodeListOf<HTMLButtonElement>} */ (document.querySelectorAll("nav button"));
  let at = 0;
  const show = (to) => {
    at = Math.min(Math.max(to, 0), slides.length - 1);
    slides.forEach((slide, i) => (slide.hidden = i !== at));
    document.getElementById("count").textContent = at + 1 + " of " + slides.length;
    previous.disabled = at === 0;
    next.disabled = at === slides.length - 1;
    document.querySelector("main").scrollTo(0, 0);
  };
  const STEPS = {
    ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1,
    ArrowLeft: -1, ArrowUp: -1, PageUp: -1, Backspace: -1,
    Home: -Infinity, End: Infinity,
  };
  addEventListener("keydown", (event) => {
    if (!(event.key in STEPS) || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === " " && event.target.matches("button")) return;
    event.preventDefault();
    show(at + STEPS[event.key]);
  });
  previous.onclick = () => show(at - 1);
  next.onclick = () => show(at + 1);
  document.querySelector("nav").hidden = false;
  document.body.classList.add("moving");
  show(0);
})();
