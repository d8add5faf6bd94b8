// Stories: the telling of one, full screen and by keys, or in cards beside what they speak of.
(() => {
  const lpn = window.lpn;
  if (lpn.tell) return;
  let told = null, at = 0, withNotes = false, wasFull = false;
  let begunOnFirst = null; // a story of the workbench that the first screen asked for
  let before = ""; // the screen that the story was begun on, see `lpn.screen`
  let moved = false; // a step has changed the state
  let pushed = false; // the browser's history has the story as one step of its own
  let notes = null; // the presenter's window
  let wanted = null; // a story that waits for the workbench
  const SEEN = "lpn-tour";

  const make = (tag, parent, name, text = "") => {
    const node = parent.appendChild(parent.ownerDocument.createElement(tag));
    node.className = name;
    node.textContent = text;
    return node;
  };

  const button = (parent, text, label, press) => {
    const node = make("button", parent, "", text);
    node.setAttribute("aria-label", label);
    node.title = label;
    node.onclick = press;
    return node;
  };

  // A step that points at the page as it is leaves the page to the person: any key or press elsewhere ends it.
  const free = (step) => !!step.points_at && !step.shows;

  // On a phone a window of its own would lie over the story.
  const phone = matchMedia("(max-width: 36em), (pointer: coarse)");

  // A button of a card has a word in place of its sign, and names its key only while that key does not end the story.
  const rename = (node, word, alone) => {
    node._sign ||= node.textContent;
    node._label ||= node.title;
    node.textContent = word || node._sign;
    node.title = alone ? "" : node._label;
    node.setAttribute("aria-label", word || (alone ? node._label.replace(/ \(.*/, "") : node._label));
  };

  const build = () => {
    const bar = make("div", document.body, "");
    bar.id = "lpn-told";
    bar.setAttribute("role", "region");
    const words = make("div", bar, "words");
    make("div", words, "caption").setAttribute("aria-live", "polite");
    make("div", words, "notes");
    const buttons = make("div", bar, "buttons");
    button(buttons, "‹", "Previous step (left arrow)", () => go(at - 1));
    make("span", buttons, "count");
    button(buttons, "›", "Next step (right arrow)", () => (at + 1 < told.steps.length ? go(at + 1) : end())).classList.add("next");
    button(buttons, "Notes", "Presenter's notes in a window of their own; N shows them here", openNotes);
    button(buttons, "Stay here", "End the story, and go on from what it shows", () => end(true)).classList.add("stay");
    button(buttons, "✕", "End (Escape): back to what was shown before", () => end()).classList.add("end");
    new ResizeObserver(() => document.documentElement.style.setProperty("--lpn-told", bar.offsetHeight + "px")).observe(bar);
    return bar;
  };

  const draw = () => {
    const bar = document.getElementById("lpn-told") || build();
    const step = told.steps[at], last = at === told.steps.length - 1, alone = free(step);
    bar.className = (step.points_at ? "card" : "") + (alone ? " free" : "") + (late ? " waiting" : "");
    bar.setAttribute("aria-label", told.name);
    document.documentElement.classList.toggle("lpn-telling", !step.points_at);
    const caption = bar.querySelector(".caption"), lines = step.caption.split("\n");
    caption.replaceChildren();
    lines.forEach((line, i) => make(i || lines.length === 1 ? "p" : "b", caption, /^(Keys|Panels): /.exec(line)?.[1].toLowerCase() ?? "", line.replace(/^Panels: /, "")));
    bar.querySelector(".notes").textContent = step.notes;
    bar.querySelector(".notes").hidden = !withNotes || !step.notes;
    bar.querySelector(".count").textContent = at + 1 + " of " + told.steps.length;
    const [previous, next, ofNotes, stay, close] = bar.querySelectorAll("button");
    previous.disabled = at === 0;
    ofNotes.disabled = !told.steps.some((one) => one.notes);
    stay.hidden = !!step.points_at;
    rename(previous, "", alone);
    rename(next, last ? "Done" : step.points_at && "Next", alone);
    rename(close, alone && "Skip", alone);
    close.hidden = alone && last;
    lpn.point(bar, step.points_at);
    if (step.points_at) next.focus({ preventScroll: true });
    if (!notes || notes.closed) return;
    const page = notes.document.body;
    page.replaceChildren();
    make("p", page, "", told.name + ", step " + (at + 1) + " of " + told.steps.length);
    make("h1", page, "", step.caption);
    make("p", page, "notes", step.notes || "No notes for this step.");
    make("p", page, "", at + 1 < told.steps.length ? "Next: " + told.steps[at + 1].caption : "This is the last step.");
  };

  const showNotes = () => {
    withNotes = !withNotes;
    draw();
  };

  const openNotes = () => {
    if (phone.matches) return showNotes();
    wasFull = false; // browsers leave full screen when a window opens; the next step enters it again
    notes = window.open("", "lpn-notes", "popup,width=720,height=520");
    if (!notes) {
      withNotes = true; // the browser opens no windows
      return draw();
    }
    notes.document.title = "Presenter's notes";
    const style = notes.document.head.appendChild(notes.document.createElement("style"));
    style.textContent = "body{font:20px/1.4 system-ui,sans-serif;margin:1.5em;background:#16181b;color:#eceef0}" +
      "h1{font-size:24px}.notes{font-size:26px;white-space:pre-line}";
    notes.onkeydown = keys;
    draw();
  };

  // A step of another query begins with the picture of the one before: its caption waits until the server has drawn it.
  const LONGEST_WAIT = 5000;
  let stopWaiting = () => {}, late = 0; // late: what shows the caption anyway, while it waits
  const drawn = () => document.getElementById("lpn-status")?.dataset.name;
  const wait = (query) => {
    stopWaiting();
    clearTimeout(late);
    late = 0;
    if (query !== null && drawn() !== query) {
      stopWaiting = lpn.onChange(50, () => drawn() === query && wait(null));
      late = setTimeout(() => wait(null), LONGEST_WAIT);
    }
    document.getElementById("lpn-told")?.classList.toggle("waiting", late !== 0);
  };

  const go = (to) => {
    if (to < 0 || to >= told.steps.length) return;
    at = to;
    draw();
    if (!free(told.steps[at]) && !document.fullscreenElement) document.documentElement.requestFullscreen?.().catch(() => {});
    if (!told.steps[at].shows) return;
    moved = true;
    wait(new URLSearchParams(told.steps[at].shows).get("query"));
    lpn.send("story-step", [at, told.steps[at].shows]);
  };

  // The page goes back to the state before the story, unless the person stays.
  const end = (stay = false, byBack = false) => {
    if (told.name === lpn.tour.name) lpn.store("local", SEEN, "seen");
    told = null;
    wait(null);
    notes?.close();
    lpn.point(null);
    document.getElementById("lpn-told")?.remove();
    document.documentElement.classList.remove("lpn-telling");
    if (document.fullscreenElement) document.exitFullscreen();
    wasFull = false;
    if (pushed && !stay && !byBack) lpn.backQuietly();
    if (before === "first" && !stay) lpn.firstAgain();
    if (moved) lpn.send("story-end", stay);
    else if (before === "first" && !stay) lpn.send("screen", "start");
  };

  const STEPS = {
    ArrowRight: 1, ArrowDown: 1, PageDown: 1, " ": 1,
    ArrowLeft: -1, ArrowUp: -1, PageUp: -1, Backspace: -1,
    Home: -Infinity, End: Infinity,
  };
  const keys = (event) => {
    if (told && free(told.steps[at])) {
      const pressed = document.getElementById("lpn-told").contains(event.target) && ["Enter", " "].includes(event.key);
      if (pressed || ["Tab", "Shift", "Control", "Alt", "Meta"].includes(event.key)) return;
      if (event.key !== "Escape") return end(true);
      event.stopImmediatePropagation(); // it closes nothing else
      return end();
    }
    if (!told || event.ctrlKey || event.altKey || event.metaKey || event.target.matches?.('input, textarea, select, [role="slider"]')) return;
    if (event.key === " " && event.target.matches?.('button, [role="button"], [role="tab"]')) return;
    if (event.key in STEPS) go(Math.min(Math.max(at + STEPS[event.key], 0), told.steps.length - 1));
    else if (event.key === "Escape") end();
    else if (event.key === "n" || event.key === "N") {
      showNotes();
    } else return;
    event.preventDefault();
    event.stopImmediatePropagation();
  };
  window.addEventListener("keydown", keys, true);
  // A notice may be pressed meanwhile; all but its button lets presses through.
  const inNotice = ({ clientX, clientY }) =>
    [...document.querySelectorAll(lpn.viser.SELECTORS.notification)].some((notice) => {
      const { left, right, top, bottom } = notice.getBoundingClientRect();
      return clientX >= left && clientX <= right && clientY >= top && clientY <= bottom;
    });
  const pressed = (event) => event.isTrusted && told && free(told.steps[at]) && !document.getElementById("lpn-told").contains(event.target) && !inNotice(event) && end(true);
  // A finger that scrolls presses nothing: its pointer is cancelled before it is up.
  window.addEventListener("pointerdown", (event) => event.pointerType !== "touch" && pressed(event), true);
  window.addEventListener("pointerup", (event) => event.pointerType === "touch" && pressed(event), true);
  // How a step of a story writes its address: all steps are one step of the browser's history, which Back ends with the story.
  lpn.storyAddress = () => {
    if (!told || !moved) return null;
    const write = pushed ? "replaceState" : "pushState";
    pushed = true;
    return write;
  };
  lpn.backEndsStory = () => {
    const ends = told !== null && pushed;
    if (told) end(!ends, ends);
    return ends;
  };
  // In full screen the browser takes Escape for itself.
  document.addEventListener("fullscreenchange", () => {
    if (document.fullscreenElement) wasFull = true;
    else if (told && wasFull) end();
  });

  // Mark what the style sheet changes: the stage takes the whole of the frame in which viser docks panels beside it.
  const frame = () => {
    /** @type {HTMLElement} */
    let stage = lpn.canvas();
    while (stage.parentElement && !stage.parentElement.querySelector("#lpn-header")) stage = stage.parentElement;
    stage.classList.add("lpn-undocked");
    stage.parentElement?.classList.add("lpn-frame");
  };

  lpn.telling = () => told !== null;
  lpn.tell = (story, first = 0) => {
    if (free(story.steps[first]) && lpn.screen() === "first") {
      wanted = begunOnFirst = story;
      return lpn.send("screen", "workbench"); // in the words that are spoken
    }
    if (!told) [before, moved, pushed] = [story === begunOnFirst ? "first" : lpn.screen(), false, false];
    begunOnFirst = null;
    told = story;
    if (free(story.steps[first])) lpn.straighten(); // it frames the pictures where they lie when nobody has turned them
    frame();
    go(first);
  };

  // Without storage, the tour would start at every visit.
  const seen = () => lpn.stored("local", SEEN) !== null;
  // Called when the workbench is shown: it tells the story that waits for it, or unasked to a new visitor the tour, unless a link led
  // here. On a phone, whose stage a card would cover, the tour waits until it is asked for.
  lpn.welcome = (unasked) => {
    const story = wanted || (unasked && !phone.matches && !seen() && !lpn.linked ? lpn.tour : null);
    wanted = null;
    if (story) setTimeout(() => !told && lpn.screen() === "all" && lpn.tell(story), 700);
  };
})();
