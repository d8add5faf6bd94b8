// The keyboard's focus: into a window that opens, back to what opened it when it closes, and onto the element that replaces one
// that was drawn anew.
(() => {
  const lpn = window.lpn;
  if (lpn.refocus) return;
  // Milliseconds between two looks, and until an element that is gone is given up.
  const PERIOD = 150, WAIT = 3000;
  const { SELECTORS } = lpn.viser;
  const DIALOG = `${SELECTORS.dialog}, ${SELECTORS.palette}`;
  const WHY = "#lpn-why, #lpn-heatmaps, #lpn-counterfactual, #lpn-profile, #lpn-region, #lpn-model-comparison";
  // The element that shows that a window is open, and the one in it that takes the focus.
  const WINDOWS = [
    ["#lpn-first", "#lpn-first [data-act=why]"],
    ["#lpn-told", "#lpn-told .next"],
    [".lab-bar", "#lpn-lab-rows, .lab-map .marks, #lpn-lab-breakdown [tabindex]"],
    ["#lpn-lab-tag", "#lpn-lab-tag input"],
    ["#lpn-lab-views", "#lpn-lab-views input"],
    ["#lpn-flight", "#lpn-flight [tabindex='0']"],
    ["#lpn-stage-map", "#lpn-stage-map button"],
    [WHY, WHY.split(", ").map((tab) => tab + " [tabindex='0']").join(", ")],
  ];
  // Elements that keep the focus when a window opens: a person may go on with its keys.
  const KEEPS = "input, textarea, select, [contenteditable]:not([contenteditable=false]), [role=slider], [role=tab]";
  const focused = new Map(); // what had the focus when a window was first seen, by window
  const openers = new Map(); // what had the focus when a window was opened, by window
  let last = null; // what had the focus last, outside dialogs
  let lastHome = null; // the window that it lay in
  let gone = 0; // since when the element of the focus is gone
  let acted = false; // a window of the page's address opens by itself, and leaves the focus where it is
  const there = (element) => element?.isConnected && element.getClientRects().length > 0;
  const lost = () => !document.activeElement || document.activeElement === document.body;
  // The first selector's visible element, else the next one's.
  const shown = (selectors) => selectors.split(", ").flatMap((one) => [...document.querySelectorAll(one)]).find(there);
  const focus = (selectors) => shown(selectors)?.focus({ preventScroll: true });
  const ANSWER = "#lpn-first [data-act=why], #lpn-matches [tabindex], #lpn-header [tabindex='0']";
  // The window that an element lies in, in its panel.
  const home = (element) => WINDOWS.find(([selector]) => element.closest(selector) || element.closest(SELECTORS.window)?.querySelector(selector));

  // An element that stands for one that is gone: of the same id, or that does the same.
  const successor = (element) => {
    if (there(element)) return element;
    const twin = element.id && document.getElementById(element.id);
    if (there(twin)) return twin;
    const does = element.getAttribute("onclick");
    if (!does) return null;
    return [...document.querySelectorAll('[role="button"][onclick]')].find((one) => one.getAttribute("onclick") === does && there(one));
  };
  lpn.refocus = (element) => (element ? successor(element) : null)?.focus({ preventScroll: true });
  lpn.lastFocus = () => last;
  // viser brings a window in front when it is pressed.
  lpn.raise = (element) => element?.dispatchEvent(new PointerEvent("pointerdown", { bubbles: true }));
  lpn.revealReasons = () => lpn.reveal(WHY);
  lpn.raiseReasons = () => lpn.raise(shown(WHY));

  document.addEventListener("focusin", ({ target }) => {
    if (target.closest(DIALOG) || target === document.body) return;
    const panel = home(target); // its window may be closed by a button of the panel before it is first seen
    for (const one of WINDOWS) if (!openers.has(one[0]) && (one === panel || target.closest(one[0]))) openers.set(one[0], last);
    [last, lastHome] = [target, panel];
  });
  for (const act of ["keydown", "pointerdown"]) window.addEventListener(act, ({ isTrusted }) => (acted ||= isTrusted), true);
  // A press beside all controls takes the focus away on purpose.
  window.addEventListener("pointerdown", ({ target, isTrusted }) => isTrusted && !target.closest?.("a, button, input, textarea, select, [tabindex]") && (last = null), true);

  const follow = () => {
    for (const [selector, inside] of WINDOWS) {
      const root = shown(selector), open = !!root;
      if (!open) focused.delete(selector);
      else if (!focused.has(selector)) focused.set(selector, document.activeElement);
      if (open && !openers.has(selector)) {
        // Its content may be still to come.
        const target = shown(inside);
        if (!target) continue;
        openers.set(selector, last);
        const before = focused.get(selector), moved = before?.isConnected && before !== document.activeElement;
        const keeps = moved || document.activeElement?.matches(KEEPS);
        if (acted && !keeps && !document.querySelector(DIALOG) && !root.contains(document.activeElement)) target.focus({ preventScroll: true });
      } else if (!open && openers.has(selector)) {
        const opener = openers.get(selector);
        openers.delete(selector);
        if (!lost()) continue;
        lpn.refocus(opener);
        if (lost() && !document.querySelector(DIALOG)) focus(ANSWER);
      }
    }
    if (!lost() || !last || last.isConnected) return void (gone = 0);
    gone ||= performance.now();
    if (document.querySelector(DIALOG)) return;
    if (performance.now() - gone < WAIT) return lpn.refocus(last);
    last = null;
    if (lastHome) focus(lastHome[1]);
    if (lost()) focus(ANSWER);
  };
  lpn.every(PERIOD, follow);

  const skip = document.body.insertBefore(document.createElement("a"), document.body.firstChild);
  skip.id = "lpn-skip";
  skip.href = "#lpn-matches";
  skip.textContent = "Skip to the answer";
  skip.onclick = (event) => {
    event.preventDefault();
    focus(ANSWER);
  };
})();
