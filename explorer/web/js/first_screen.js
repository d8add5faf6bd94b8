// The first screen: it lies over the rest of the page, which takes no focus meanwhile.
(() => {
  const lpn = window.lpn;
  if (lpn.first) return;
  const { SELECTORS } = lpn.viser;
  const AT_ONCE = ["copy", "dark", "glossary", "north", "upload", "choose", "not-now"]; // these need no answer
  const LATE = 20000; // ms after which the first answer is late
  let newest = ""; // the screen's content when it was last shown
  /** @type {"" | "first" | "all"} */
  let shown = ""; // "first", "all", or nothing before the first answer

  lpn.screen = () => shown;

  // What was pressed has been answered.
  const settled = () => document.querySelectorAll("#lpn-first .waiting").forEach((one) => one.classList.remove("waiting"));

  const close = () => {
    document.getElementById("lpn-first")?.remove();
    // A class, as `:has` on the root is looked at again with each change of the page.
    document.documentElement.classList.remove("lpn-starts");
    document.querySelector(SELECTORS.app)?.removeAttribute("inert");
    lpn.placeStage(); // it was out of sight
  };
  lpn.leaveFirst = close;

  const STOPS = "a[href], button, summary, [tabindex]"; // of the keyboard
  const named = (/** @type {HTMLElement} */ one) => one.dataset.act || one.textContent.trim();

  // Return a function that focuses the stop that had the focus, after the page has got new content.
  const keptFocus = (page) => {
    const focused = document.activeElement;
    if (!(focused instanceof HTMLElement) || !page.contains(focused) || !focused.matches(STOPS)) return () => {};
    const alike = () => [...page.querySelectorAll(STOPS)].filter((one) => named(one) === name);
    const name = named(focused), position = alike().indexOf(focused);
    return () => alike()[position]?.focus({ preventScroll: true });
  };

  // Return a function that opens and closes again what a person has opened and closed, in new content for the same picture.
  const keptDetails = (page) => {
    const all = () => [...page.querySelectorAll("details")], summary = (one) => named(one.querySelector("summary"));
    const changed = new Map(all().filter((one) => String(one.open) !== one.dataset.opened).map((one) => [summary(one), one.open]));
    return (same) => {
      for (const one of all()) {
        one.dataset.opened = String(one.open);
        if (same && changed.has(summary(one))) one.open = changed.get(summary(one));
      }
    };
  };

  const open = (html) => {
    const before = document.getElementById("lpn-first");
    const page = before || document.body.appendChild(document.createElement("main"));
    // A phone's sheet begins at its top when it is next seen.
    if (!before) for (const panel of document.querySelectorAll(`${SELECTORS.sheet} ${SELECTORS.scrolled}`)) panel.scrollTop = 0;
    page.id = "lpn-first";
    document.documentElement.classList.add("lpn-starts");
    page.className = "lpn";
    const explained = page.querySelector(".reason"), query = page.querySelector("[data-query]")?.dataset.query;
    const scrolled = page.scrollTop, restoreFocus = keptFocus(page), restoreDetails = keptDetails(page), offer = page.querySelector(".offer");
    page.innerHTML = lpn.named(html);
    for (const picture of /** @type {NodeListOf<HTMLImageElement>} */ (page.querySelectorAll("figure img:not(.pins img)"))) lpn.enlargeable(picture);
    page.onclick = (event) => {
      // A part that unfolds below the window's edge comes into sight.
      const unfolded = /** @type {HTMLDetailsElement | null} */ (event.target.closest("summary")?.parentElement);
      if (unfolded) setTimeout(() => unfolded.open && unfolded.scrollIntoView({ block: unfolded.offsetHeight > page.clientHeight ? "start" : "nearest" }));
      const pressed = event.target.closest("[data-act]");
      if (!pressed || AT_ONCE.includes(pressed.dataset.act)) return;
      pressed.classList.add("waiting");
      // Another place may take long to open; any other answer may be a notification.
      setTimeout(() => pressed.classList.remove("waiting"), pressed.classList.contains("choice") ? 120000 : 10000);
    };
    const pair = page.querySelector("[data-query]"), reason = page.querySelector(".reason");
    const another = query && pair && pair.dataset.query !== query;
    lpn.pins(page, pair?.dataset.query);
    /** @type {HTMLElement | null} */
    const place = page.querySelector(".choice.chosen");
    if (place) place.parentElement.scrollLeft = place.offsetLeft + place.offsetWidth - place.parentElement.clientWidth; // a phone has no room for all
    restoreDetails(!another);
    if (offer && !another) page.querySelector(".acts:has([data-act=upload])")?.after(offer); // an answer to all pictures may come meanwhile
    if (reason && !explained && query) page.querySelector("[data-act=why]")?.focus({ preventScroll: true });
    else restoreFocus(); // a page that opens with a reason has its first stop at the top
    // Another picture comes into sight, and the button that brought it stays there. A reason does with its button, and with the
    // pictures where they leave it room; a screen that comes back, as after the tour, begins at its top.
    if (another) {
      page.scrollTop = 0;
      if (!reason) page.scrollTop = Math.min(scrolled, pair.getBoundingClientRect().top - 8);
    }
    if (reason && query && (another || !explained)) {
      const button = page.querySelector("[data-act=why]").getBoundingClientRect(), pictures = pair.getBoundingClientRect().top;
      const seen = pair.matches(".matched") || button.bottom - pictures < 0.75 * page.clientHeight;
      const top = seen ? pictures - 8 : button.top - 8;
      const beyond = reason.getBoundingClientRect().bottom - page.clientHeight;
      const heading = page.querySelector("h1").getBoundingClientRect().top - 8; // no half of the header stays
      if (beyond > 0) page.scrollTop += Math.min(Math.max(beyond, heading), top);
    }
    document.querySelector(SELECTORS.app)?.setAttribute("inert", "");
  };

  // Escape closes the reason, or the wrong answers, unless it closes what lies over it; in the capture phase all of that is still there.
  const OVER = "#lpn-term, " + SELECTORS.dialog;
  const escaped = (event) => {
    if (event.key !== "Escape" || lpn.telling() || document.querySelector(OVER)) return;
    document.querySelector("#lpn-first:has(.reason) [data-act='why'], #lpn-first .wrong [data-act='start']")?.click();
  };
  window.addEventListener("keydown", escaped, true);

  // Tell how far the details of an own picture are compared with the map, wherever the page says it.
  lpn.comparing = (text) => {
    if (text) document.querySelectorAll(".lpn .comparing .so-far").forEach((line) => (line.innerHTML = text));
  };

  // Say which own pictures suit and where they go, before they are chosen; or close that again.
  lpn.offer = () => {
    const open = document.querySelector("#lpn-first .offer");
    if (open) return open.remove();
    const offer = document.createElement("section");
    offer.className = "offer";
    offer.setAttribute("aria-label", "Your own picture");
    offer.innerHTML = '<p></p><p><button type="button" data-act="choose">Choose pictures</button><button type="button" class="quiet" data-act="not-now">Not now</button></p>';
    offer.querySelector("p").textContent = lpn.named(lpn.ownHint);
    const [choose, leave] = offer.querySelectorAll("button");
    choose.onclick = () => lpn.upload();
    leave.onclick = () => lpn.offer();
    document.querySelector("#lpn-first .acts").after(offer);
    choose.focus({ preventScroll: true });
    offer.scrollIntoView({ block: "nearest" });
  };

  // Show the answers north up, or turned to lie like the query.
  lpn.northUp = (link) => {
    const north = link.closest(".pair").classList.toggle("north-up");
    link.dataset.turned ||= link.textContent;
    link.textContent = north ? "north up" : link.dataset.turned;
    link.setAttribute("aria-pressed", String(!north));
  };

  // Until the first answer the page says that it is coming, or why there is none. A session that has died says nothing.
  let late = 0;
  lpn.opening = () => {
    clearTimeout(late);
    late = setTimeout(() => lpn.unopened("This takes longer than usual. The server may be busy, or have lost this page."), LATE);
    if (!document.getElementById("lpn-first")) open('<p class="wait"><span class="busy"></span>Looking at the first picture …</p>');
  };
  lpn.unopened = (reason, goesOn = false) => {
    const page = document.getElementById("lpn-first");
    if (!page || page.querySelector("[data-query]")) return;
    open('<p class="wait"><span class="why"></span><br><button type="button">Load the page again</button> <button type="button" hidden>Another picture</button></p>');
    page.querySelector(".why").textContent = reason;
    const [again, other] = page.querySelectorAll("button");
    again.onclick = () => location.reload();
    other.hidden = !goesOn;
    other.onclick = () => lpn.send("screen", "next");
  };

  // Show the screen at once as it was last; the server will send it again.
  lpn.firstAgain = () => newest && open(newest);

  // Show the screen of another place at once; its session then takes the place of this one, and gets what is pressed meanwhile.
  lpn.preview = (html) => {
    open((newest = html));
    lpn.holdMessages();
  };

  // Show the screen, or close it for an empty text; a story comes only to the plain stage (`free`), unasked only if `unasked`.
  lpn.first = (html, free, unasked) => {
    const now = html ? "first" : "all", before = shown;
    shown = now;
    clearTimeout(late);
    const same = html === newest && document.querySelector("#lpn-first [data-query]");
    if (html) return same ? settled() : open((newest = html));
    close();
    if (before === "first") lpn.unfoldSheet(); // what is asked for may be in it
    if (now !== before && free) lpn.reveal("#lpn-header");
    if (free && !lpn.telling()) lpn.welcome(unasked);
  };
})();
