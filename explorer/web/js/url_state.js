// The page's address: its query string goes to the server when the page opens, and then follows the state.
(() => {
  const lpn = window.lpn;
  if (lpn.greet) return;
  // viser rewrites the address without escaping it; the navigation entry has it as the user typed it.
  const opened = performance.getEntriesByType("navigation")[0];
  let search = new URL(opened ? opened.name : location.href).search;
  // What a link has of a flight's map, which the page shows by itself, see `lpn.flight.link`; it is no part of the address.
  const given = new URLSearchParams(search);
  lpn.look = given.get("look");
  given.delete("look");
  if (lpn.look !== null) search = "?" + given;
  let greeting = 0;
  let writing = 0; // the timer of the address that waits to be written
  let waiting = null; // that address, and whether it came unasked
  let written = 0; // when one that a person asked for was written last
  let ready = false;
  let begun = false; // a session of the server has begun, and has not answered yet
  lpn.begins = () => begun;

  // Each action of a person is a step of the browser's history, which Back undoes. A drag, which changes one thing many times, is one
  // step; what changes by itself, such as the frame of a flight that plays, is none. A change of these is always a step.
  const STEPS = ["show", "task", "query", "screen", "why", "fails"];
  // Back keeps these as they are.
  const KEPT = ["theme", "words"];
  let acts = 0; // what the person has done so far
  let actsAtBack = -1; // what the person had done when the browser last went back or forward
  let last = { act: 0, changed: "" }; // the last step: the act that it was made by, and what it changed
  window.addEventListener("pointerdown", ({ isTrusted }) => isTrusted && acts++, { capture: true, passive: true });
  window.addEventListener("keydown", ({ isTrusted, repeat, key, target }) => {
    const types = key !== "Enter" && target.matches?.("textarea, input:not([type=range], [type=checkbox])");
    if (isTrusted && !repeat && !types) acts++;
  }, { capture: true, passive: true });
  window.addEventListener("drop", ({ isTrusted }) => isTrusted && acts++, true);
  window.addEventListener("click", ({ isTrusted, detail }) => isTrusted && detail === 0 && acts++, true); // by assistive technology
  /** Tell if the page's next address is a step of its history. */
  const isStep = (next) => {
    const [before, after] = [location.search, next].map((text) => new URLSearchParams(text));
    const changed = [...new Set([...before.keys(), ...after.keys()])].filter((key) => !KEPT.includes(key) && before.get(key) !== after.get(key));
    // In a flight, which plays, a frame is none: Back leaves the flight.
    const left = before.has("flight") && after.has("flight") ? changed.filter((key) => key !== "query") : changed;
    if (!left.length || (!left.some((key) => STEPS.includes(key)) && acts === last.act && left.join() === last.changed)) return false;
    if (!acts && !left.some((key) => STEPS.includes(key))) return false;
    last = { act: acts, changed: left.join() };
    return true;
  };
  let quiet = false; // the page itself goes back
  window.addEventListener("popstate", () => {
    clearTimeout(writing);
    waiting = null;
    actsAtBack = acts;
    search = location.search;
    if (!quiet && !lpn.backClosesGlossary() && !lpn.backClosesPicture() && !lpn.backEndsStory()) lpn.send("back", search);
    quiet = false;
  });
  lpn.backQuietly = () => {
    quiet = true;
    history.back();
  };

  // templates/connection.js reads it.
  lpn.keepTheme = (name) => lpn.store("local", "lpn-theme", name);

  // The cover of a page that opens goes when the page has the theme that the server gave it, or when no server has answered.
  const UNANSWERED = 10000; // ms
  const cover = () => document.getElementById("lpn-loading");
  lpn.themed = (name) => {
    if (document.documentElement.getAttribute(lpn.viser.SCHEME) === name) cover()?.remove();
    else if (cover()) requestAnimationFrame(() => lpn.themed(name));
  };

  // Plain words, until somebody asks for the field's terms, which the browser keeps. Those that come unasked with the workbench are the
  // tab's, as long as that shows the workbench.
  const WORDS = "lpn-words";
  lpn.keepWords = (name) => lpn.store("local", WORDS, name);
  lpn.tellWords = () => lpn.say("The workbench speaks the field’s terms. Its link “Plain words” brings the plain ones back.", 10);

  // Repeat the greeting until the server answers: the page may not be connected yet.
  lpn.greet = () => {
    clearInterval(greeting);
    const now = (lpn.greeted = performance.now());
    begun = true;
    setTimeout(() => cover()?.remove(), UNANSWERED); // the page says below it what it waits for
    const names = [...new URLSearchParams(search).keys()].filter((key) => !["theme", "words"].includes(key) && lpn.keys.includes(key));
    lpn.linked ??= names.some((key) => key !== "screen" && key !== "show"); // these two alone point at no picture
    // Another place may take seconds to open; its first screen says so, too.
    if (!names.length || new URLSearchParams(search).get("screen") === "first") lpn.opening();
    const chosen = lpn.stored("local", WORDS), words = (names.length && lpn.stored("session", WORDS)) || chosen;
    const speech = { plain: words !== "expert", start_plain: chosen !== "expert" };
    const hello = () => lpn.send("hello", { search: search, small: lpn.folded(), ...speech, light: window.lpnWay.theme(search) === "light", viewport: lpn.openingSize() });
    lpn.settled(() => {
      if (now !== lpn.greeted) return; // the page has been drawn anew
      const held = lpn.resume();
      greeting = lpn.every(500, hello);
      hello();
      held.filter(([kind]) => kind !== "hello").forEach(([kind, value]) => lpn.send(kind, value));
    });
  };

  // Browsers limit how often the address may change, so the newest is written after this many milliseconds.
  const PAUSE = 200;
  const commit = () => {
    clearTimeout(writing);
    const write = lpn.storyAddress() || (waiting.unasked || !isStep(waiting.search) ? "replaceState" : "pushState");
    history[write](history.state, "", location.pathname + waiting.search + location.hash);
    if (!waiting.unasked) written = performance.now(); // a step that comes right after the page's first address is not lost
    waiting = null;
  };
  const stepsOf = (text) => STEPS.map((key) => new URLSearchParams(text).get(key)).join();

  lpn.address = (query, keys) => {
    clearInterval(greeting);
    const server = new URLSearchParams(location.search).get("websocket"); // viser's own parameter, which viser may change
    const others = new URLSearchParams(search);
    for (const key of [...keys, "websocket"]) others.delete(key);
    if (server) others.set("websocket", server);
    search = "?" + [query, others.toString()].filter(Boolean).join("&");
    lpn.store("session", WORDS, new URLSearchParams(query).get("words") || "expert");
    // A step that still waits is not lost to the next one.
    if (waiting && stepsOf(waiting.search) !== stepsOf(search) && performance.now() - written > PAUSE) commit();
    // The first address is no step, nor is one that comes after Back, before anything was done: it may answer what was done before.
    waiting = { search, unasked: !ready || acts === actsAtBack };
    clearTimeout(writing);
    writing = setTimeout(commit, PAUSE);
    lpn.watch();
    begun = false;
    ready = true;
  };

  // Without https, browsers offer only this old way to copy.
  const copyFromField = (text) => {
    const field = document.body.appendChild(document.createElement("textarea"));
    field.value = text;
    field.style = "position:fixed;opacity:0";
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    return done;
  };

  const copied = async (text) => {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {
      return copyFromField(text);
    }
  };

  lpn.copy = async () => {
    const shown = new URLSearchParams(search);
    if (shown.get("query") === "own") return lpn.say(lpn.noLink, 8);
    const flies = shown.has("flight"), look = (flies && lpn.flight?.link()) || "";
    // While the next photo is coming, the link is of that one.
    const coming = flies ? lpn.flight?.wanted : null;
    if (typeof coming === "number") shown.set("query", "~" + coming);
    const state = typeof coming === "number" ? "?" + shown : search;
    // A page that opens a link speaks plain words, unless the link asks for others.
    const words = shown.has("words") ? "" : `${search ? "&" : "?"}words=expert`;
    const where = lpn.isHere ? ` on this computer only, as its address is ${location.hostname}` : "";
    const photo = /^&look=(swipe|blink)/.exec(look)?.[1];
    const mode = photo ? `, with ${photo === "swipe" ? "Swipe" : "Blink"}` : "";
    if (!(await copied(location.origin + location.pathname + state + words + look + location.hash)))
      lpn.say("This browser does not let pages copy: take the link from the address bar.");
    else if (look) lpn.say(`Link copied: it opens this photo, and the map, the methods, and the lists as you see them${mode}${where && `,${where}`}.`);
    else lpn.say(`Link copied: it opens what you see${where && `,${where}`}.`);
  };

  lpn.copyText = async (id) => {
    const done = await copied(document.getElementById(id)?.textContent ?? "");
    lpn.say(done ? "Copied." : "This browser does not let pages copy: select the lines, and copy them.");
  };
})();
