// The page around the panels: styles, notices, the size of the stage, and keyboard events.
(() => {
  const lpn = window.lpn;
  if (lpn.head) return;

  const element = (id, parent) => {
    const node = document.getElementById(id) || parent.appendChild(document.createElement("div"));
    node.id = id;
    return node;
  };

  // Styles live outside the panels, because viser removes the content of a folded panel.
  lpn.head = (html) => {
    const holder = element("lpn-head", document.body);
    holder.hidden = true;
    if (holder.innerHTML !== html) holder.innerHTML = html;
  };

  lpn.say = (text, seconds = 4) => {
    const notice = element("lpn-notice", document.body);
    notice.setAttribute("role", "status");
    notice.textContent = lpn.named(text);
    notice.classList.add("shown");
    clearTimeout(notice.hiding);
    if (seconds) notice.hiding = setTimeout(() => notice.classList.remove("shown"), 1000 * seconds);
  };

  // Show at the upper edge how far work is that goes on whatever the page shows; nothing at a total of 0.
  lpn.work = (done, total) => {
    const bar = /** @type {HTMLProgressElement} */ (document.getElementById("lpn-work") || document.body.appendChild(Object.assign(document.createElement("progress"), { id: "lpn-work", className: "lpn-progress", ariaLabel: "work in progress" })));
    bar.hidden = !total;
    if (total) Object.assign(bar, { max: total, value: done });
  };

  const { SELECTORS } = lpn.viser;
  // viser calls its page after itself. Screen readers are told the verdict, whose element is replaced whenever it changes.
  const live = element("lpn-live", document.body);
  live.setAttribute("role", "status");
  // A part that can be unfolded stays as it was left, also when its element is replaced.
  const OPEN = "lpn-open";
  const unfolded = new Set((lpn.stored("local", OPEN) || "").split(" "));
  const reopen = () => {
    for (const one of /** @type {NodeListOf<HTMLDetailsElement>} */ (document.querySelectorAll("details[id]"))) {
      if (one.dataset.seen) continue;
      one.dataset.seen = "1";
      one.open = unfolded.has(one.id);
      one.addEventListener("toggle", () => {
        unfolded[one.open ? "add" : "delete"](one.id);
        lpn.store("local", OPEN, [...unfolded].join(" "));
      });
    }
  };
  const mended = new MutationObserver(() => {
    const verdict = document.getElementById("lpn-verdict")?.textContent.replace(/\s+/g, " ").trim() || live.textContent;
    if (live.textContent !== verdict) live.textContent = verdict;
    lpn.viser.mend();
    reopen();
    if (lpn.title && document.title !== lpn.title) document.title = lpn.title;
    if (softwareNotice()) seeOnce();
  });

  // viser's notice about software WebGL would stay over the page, and return whenever it is loaded. viser may draw it twice.
  const NOTICE_SEEN = "lpn-software-webgl", NOTICE_SHOWN = 12000;
  const softwareNotice = () => document.querySelector(SELECTORS.softwareNotice);
  const noticeSeen = lpn.stored("session", NOTICE_SEEN) === "seen";
  let noticeLeaves = 0;
  const seeOnce = () => {
    if (noticeSeen) softwareNotice().style.display = "none";
    if (noticeLeaves) return;
    lpn.store("session", NOTICE_SEEN, "seen");
    const leave = () => {
      softwareNotice()?.querySelector("button")?.click();
      noticeLeaves = 0;
    };
    noticeLeaves = setTimeout(leave, noticeSeen ? 0 : NOTICE_SHOWN);
  };
  mended.observe(document.head, { childList: true, subtree: true, characterData: true });
  mended.observe(document.body, { childList: true, subtree: true });

  // After some thirty failures to open a websocket, Chromium opens each up to 5 s later, so none would open any more. A try of viser
  // therefore waits for an answer to a request, and for its end.
  const PATIENCE = 6000;
  let trying = false;
  let lost = false;
  lpn.viser.onRetry((goOn) => {
    if (trying) return;
    const asked = fetch("pictures/", { cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
    trying = true;
    const answered = asked.then((answer) => answer.status < 500, () => false);
    answered.then((up) => {
      if (up) goOn();
      // Pages come through, but websockets may not: a proxy was changed meanwhile.
      if (up) window.lpnWay?.look().then((fault) => fault && lost && lpn.say(fault, 0));
      setTimeout(() => (trying = false), up ? PATIENCE : 0);
    });
  });

  // viser shades the panels while the connection is lost, and reconnects by itself.
  lpn.onChange(1000, () => {
    const now = lpn.viser.shaded();
    if (now && !lost) lpn.say("The server does not answer. Start it again: the page goes on with what you see.", 0);
    if (lost && now === false) lpn.say("The server answers again.");
    if (now !== null) lost = now;
  });

  // The closing command palette restores the focus; set it afterwards.
  lpn.focus = (uuid) =>
    setTimeout(() => (lpn.viser.field(uuid) ? lpn.viser.field(uuid).focus() : lpn.say("Unfold the panel Query first.")), 400);

  // viser would move the camera by these keys, which are the app's shortcuts.
  document.documentElement.addEventListener("keydown", (event) => {
    if (/^Key[WASDQE]$/.test(event.code)) event.stopPropagation();
  });

  document.documentElement.addEventListener("keydown", (event) => {
    if (!["Enter", " "].includes(event.key) || !event.target.matches?.('[role="button"]:is([onclick], [data-lpn-folder], [data-list], [data-large])')) return;
    event.preventDefault();
    event.stopPropagation();
    event.target.click();
  });

  lpn.small = matchMedia("(max-width: 1100px)");
  lpn.small.addEventListener("change", () => lpn.send("small", lpn.folded()));
  // The panel of the query is folded, unless the browser remembers that it was left open.
  const PANELS = "lpn-panels", BESIDE = "lpn-beside";
  lpn.folded = () => lpn.small.matches || lpn.stored("local", PANELS) !== "open";
  const keepPanels = () => {
    if (lpn.small.matches) return;
    const open = document.querySelector(SELECTORS.leftOpen), size = lpn.stageSize();
    lpn.store("local", PANELS, open ? "open" : "folded");
    if (open && size) lpn.store("local", BESIDE, String(innerWidth - size[0]));
  };
  // viser lets no click on what folds the panel through. What is done elsewhere may draw the panel anew, and unfolded for a moment.
  const folds = ({ target, isTrusted }) => isTrusted && target.closest?.(SELECTORS.left) && setTimeout(keepPanels, 400);
  for (const act of ["pointerup", "keyup"]) document.addEventListener(act, folds, true);

  // On a phone the way back to the first screen stays above the stage, however the sheet is scrolled or folded.
  const back = document.body.appendChild(document.createElement("button"));
  back.id = "lpn-start";
  back.type = "button";
  back.textContent = "‹ Start";
  back.setAttribute("aria-label", "Start");
  back.title = "Back to one picture and its answer";
  back.onclick = () => lpn.send("screen", "start");

  lpn.unfoldSheet = () => {
    /** @type {HTMLElement | null} */
    const head = document.querySelector(SELECTORS.sheetHead);
    const content = /** @type {HTMLElement | null} */ (head?.nextElementSibling);
    if (content?.style.height === lpn.viser.FOLDED) head.click(); // while a story is told, an open sheet has no height, either
  };

  // On a phone the panels are a sheet over the page, and the stage takes the rest.
  const phone = matchMedia("(max-width: 36em)");
  const sheet = new ResizeObserver(([entry]) => {
    const height = entry.target.getBoundingClientRect().height;
    document.documentElement.style.setProperty("--lpn-sheet", height + "px");
  });
  // Width and height of the stage in pixels; null while there is none. The canvas itself takes a new size some frames later.
  lpn.stageSize = () => {
    const room = lpn.canvas()?.parentElement;
    return room?.clientWidth && room.clientHeight ? [room.clientWidth, room.clientHeight] : null;
  };
  // viser draws the panels beside the stage one after the other, and moves them into their places; a busy browser takes its time.
  const FRAMELESS = 3000; // ms, as a page that is hidden draws no frames
  const LAID = 10000; // ms from the page's greeting, after which the stage's size counts as it is
  const laid = () => !lpn.docked || phone.matches || document.querySelector(SELECTORS.left);
  lpn.settled = (act) => {
    const before = String(lpn.stageSize());
    let looked = false;
    const look = () => {
      if (looked) return;
      looked = true;
      if ((laid() && String(lpn.stageSize()) === before) || performance.now() - lpn.greeted > LAID) act();
      else lpn.settled(act);
    };
    requestAnimationFrame(() => requestAnimationFrame(look));
    setTimeout(look, FRAMELESS);
  };
  // The size that the stage of a page that opens will have: a panel that was left open unfolds only when the server knows of it.
  lpn.openingSize = () => {
    const size = lpn.stageSize(), beside = Number(lpn.stored("local", BESIDE));
    return size && !lpn.folded() && beside ? [innerWidth - beside, size[1]] : size;
  };
  let sizing = 0;
  const tellSize = () => {
    const size = lpn.stageSize();
    if (size) lpn.send("viewport", size);
    // On a resize viser may report the camera with the size of before, and the stage would be framed for that.
    lpn.viser.sendCamera();
  };
  const stage = new ResizeObserver(() => {
    lpn.placeStage();
    clearTimeout(sizing);
    sizing = setTimeout(() => lpn.settled(tellSize), 250);
  });
  // viser draws no frame of a stage that is out of sight, and draws the next one a second after it has come into sight.
  const sight = new IntersectionObserver((seen) => seen.at(-1)?.isIntersecting && lpn.viser.draw());
  lpn.watch = () => {
    const canvas = lpn.canvas();
    if (canvas) stage.observe(canvas);
    if (canvas) sight.observe(canvas);
    canvas?.setAttribute("role", "img");
    canvas?.setAttribute("aria-label", "Stage: the query, the compared tile, and the ranked tiles");
    canvas?.closest(SELECTORS.stageFrame)?.classList.add("lpn-stage");
    sheet.disconnect();
    const panel = document.querySelector(SELECTORS.sheet);
    if (panel) sheet.observe(panel);
  };
  // The page itself never scrolls: a finger could not scroll it back. Focus and scrollIntoView may scroll what only hides its overflow.
  const unscroll = ({ target }) => {
    const box = target === document ? document.scrollingElement : target;
    if (box.matches(SELECTORS.scrollRoot) || (lpn.canvas() && box.contains(lpn.canvas()))) box.scrollTo({ left: 0, top: 0, behavior: "instant" });
  };
  document.addEventListener("scroll", unscroll, { capture: true, passive: true });
  // Scroll the panel around an element to it, and nothing else.
  const panelOf = (target) => target.closest(SELECTORS.scrolled);
  const belowTop = (target) => target.getBoundingClientRect().top - panelOf(target).getBoundingClientRect().top;
  const scrollPanel = (target) => panelOf(target)?.scrollBy({ top: belowTop(target), behavior: "smooth" });
  // A part of the sheet that opens lies below its visible part: scroll to it. What comes later around it moves it, so it is followed
  // until the person acts, or has let it lie for a time.
  const ACTS = ["pointerdown", "wheel", "keydown"], FOLLOWED = 60000, GLIDE = 250; // ms
  let stopFollowing = () => {};
  // The page itself sends such events to viser's tabs and windows.
  for (const act of ACTS) window.addEventListener(act, ({ isTrusted }) => isTrusted && stopFollowing(), { capture: true, passive: true });
  lpn.reveal = (selector) => follow(() => [...document.querySelectorAll(selector)].find((one) => one.offsetHeight));
  const follow = (find) => {
    stopFollowing();
    if (!phone.matches) return;
    let gliding = 0, leaving = 0, before = -1;
    const look = () => {
      const target = find(), panel = target && panelOf(target);
      if (!panel) return;
      for (const moved of [panel, ...panel.children]) sizes.observe(moved); // again for what is observed already does nothing
      if (panel.scrollTop !== before) {
        before = panel.scrollTop;
        clearTimeout(leaving);
        leaving = setTimeout(stopFollowing, FOLLOWED);
      }
      const below = belowTop(target), atEnd = panel.scrollTop + panel.clientHeight >= panel.scrollHeight - 1;
      if (below > -2 && (below < 60 || atEnd)) return; // the tabs above it may stay
      scrollPanel(target);
      clearTimeout(gliding);
      gliding = setTimeout(look, GLIDE);
    };
    const sizes = new ResizeObserver(look), stop = lpn.onChange(GLIDE, look);
    stopFollowing = () => {
      stop();
      sizes.disconnect();
      clearTimeout(gliding);
      clearTimeout(leaving);
    };
  };
  // A window that takes a phone's whole screen, or gives it back, is what one goes on to read.
  document.addEventListener("click", ({ target }) => {
    const whole = target.closest?.("#lpn-flight-tall, #lpn-lab-tall");
    if (whole) lpn.reveal(whole.id === "lpn-flight-tall" ? "#lpn-flight" : ".lab-bar");
  });
  // A folded panel at the end of the sheet would unfold below it, after a time on a slow phone. viser renames its head at once.
  const { EXPAND } = lpn.viser;
  const unfolds = ({ target }) => {
    const name = phone.matches && target.closest?.(`[aria-label^="${EXPAND}"]`)?.ariaLabel.slice(EXPAND.length);
    if (name) follow(() => tabs().find((one) => one.textContent.trim() === name));
  };
  document.addEventListener("click", unfolds, true);
  // Open a tab of a window by its name, as soon as the window is in the page, and bring the window in front of others.
  let opening = 0;
  let newest = ""; // the tab that was opened last
  const tabs = () => [...document.querySelectorAll(SELECTORS.tab)].filter((one) => one.offsetHeight);
  lpn.tab = (name, tries = 40) => {
    clearTimeout(opening);
    newest = name;
    const tab = tabs().find((one) => one.textContent.trim() === name);
    if (!tab) return tries && (opening = setTimeout(() => lpn.tab(name, tries - 1), 250));
    tab.click(); // viser's tabs take it on a phone only, and a key elsewhere only
    tab.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true }));
    lpn.raise(tab.closest(SELECTORS.window));
    if (phone.matches) setTimeout(() => scrollPanel(tab), 300);
  };
  // viser draws a panel anew when it is unfolded, and runs the scripts in it again; `run_once` asks here first.
  const done = new Set();
  lpn.once = (key) => !done.has(key) && Boolean(done.add(key));
  // Tell the server which tab a person opened: a link opens it, too.
  const selected = (one) => one.ariaSelected === "true";
  let stopKeeping = () => {};
  const told = ({ target, type, isTrusted }) => {
    const tab = isTrusted && target.closest?.(SELECTORS.tab);
    if (!tab) return;
    if (type === "click") newest = tab.textContent.trim(); // at once, as the page may be drawn anew before it is told
    const list = tab.closest(SELECTORS.window);
    const tell = () => {
      const open = tabs().find((one) => list?.contains(one) && selected(one));
      if (open) lpn.send("tab", (newest = open.textContent.trim()));
    };
    setTimeout(tell, 50);
  };
  for (const act of ["click", "keyup"]) window.addEventListener(act, told, true);
  // viser draws all windows anew, each with its first tab, and takes its time on a busy machine.
  const KEPT = 5000; // ms
  phone.addEventListener("change", () => {
    stopKeeping();
    const stop = (stopKeeping = lpn.onChange(300, () => {
      lpn.watch();
      const again = tabs().filter((one) => one.textContent.trim() === newest);
      if (again.length && !again.some(selected)) lpn.tab(newest);
    }));
    setTimeout(stop, KEPT);
  });
})();
