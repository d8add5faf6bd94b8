// The flight window: what the server hands over, its elements, buttons, and keys. Other scripts draw its map and timeline, lay the
// photo over the map, and play. The server's calls come in any order, and the elements come and go.
(() => {
  const lpn = window.lpn;
  if (lpn.flight) return;
  const SIGNS = ["\u2713", "?", "\u2717"];
  /** @type {Record<string, any>} */
  const flight = (lpn.flight = {
    root: null, // the window's element
    data: null, // the flight and its map
    chosen: -1, // the frame that all of the window shows; it changes with one message of the server
    wanted: null, // the frame that was asked for and has not come yet
    followed: null, // what the server told of the frame that is shown
    of: null, // the address of the flight that the frame belongs to
    painted: null, // the scores over the map
    spotted: null, // a spot of the map, and the frames that show it
    answered: null, // the middle and the side of the window that answers, in metres
    goesOn: false, // the flight is being flown
    asking: false, // the next click on the map asks who saw the spot
    hidden: new Set(), // the tracks that are switched off
  });
  let switched = false; // a person has switched a track
  const html = { accuracy: "", counts: "", spot: "" };
  let list = "refused", sentence = "", status = "";
  let more = false; // in plain words, all controls are shown
  const find = (flight.find = (selector) => flight.root?.querySelector(selector));
  const all = (flight.all = (selector) => (flight.root ? [...flight.root.querySelectorAll(selector)] : []));
  flight.total = () => flight.data.names.length;
  // The frame that is shown may be that of another flight until both have come.
  flight.whole = () => flight.data !== null && flight.data.address === flight.of;
  flight.ink = () => getComputedStyle(flight.root).color;
  flight.range = (values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  // The tracks that are switched on, by name.
  flight.tracks = () => (flight.own() ? [] : Object.entries(flight.data.tracks).filter(([name]) => !flight.hidden.has(name)));
  // Whether a frame's answer counts, and another answer or the map contradicts it.
  flight.doubted = (name, i) => name === "registration" && flight.data.stages[i] === name && flight.data.signs[i] === null;
  // Return the marks of a person's own picture, which stands alone on the map; null without one.
  flight.own = () => flight.followed?.own ?? null;

  // Draw the canvases at the next frame of the screen.
  let drawing = 0;
  flight.draw = () => {
    drawing ||= requestAnimationFrame(() => {
      drawing = 0;
      if (!flight.root?.isConnected || !flight.whole() || !flight.map.draw()) return;
      if (typeof lpn.look === "string" && flight.followed && !flight.own()) relook();
      flight.photo.lay();
      if (!flight.own()) flight.timeline.draw();
    });
  };

  // What a link has of the window, which the server does not know: photo and slider, the middle and the width of the view in metres, the
  // methods that are switched on, the plot, and the list; of a spot its place, too.
  flight.link = () => {
    if (!flight.root?.isConnected || !flight.whole() || flight.own() || !flight.map.view()) return "";
    const { x, y, scale } = flight.map.view(), { mode } = flight.photo, { spotted } = flight;
    const metres = [x, y, flight.map.size()[0] / scale, ...(list === "spot" && spotted ? spotted.spot : [])].map((value) => value.toFixed(1));
    const on = Object.keys(flight.data.tracks).filter((name) => !flight.hidden.has(name));
    const shown = [mode === "correct" ? "off" : mode, find(".swipe").value, ...metres.slice(0, 3), on.join("."), flight.timeline.plot, list];
    return "&look=" + [...shown, ...metres.slice(3)].join();
  };
  const NUMBER = /^-?\d+(\.\d+)?$/;
  // Show what a link tells, and say what of it is damaged. Older links tell the view alone.
  const relook = () => {
    const told = lpn.look, [mode, ...rest] = told.split(","), view = rest.slice(0, 4), [on, plot, named, ...spot] = rest.slice(4);
    lpn.look = null;
    const faults = [];
    const read = (good, expected, show) => void (good ? show() : faults.push(expected));
    const [slider, x, y, across] = view.map(Number);
    read(["off", "swipe", "blink"].includes(mode) && view.length === 4 && view.every((text) => NUMBER.test(text)) && across > 0, "off, swipe, or blink with four numbers", () => {
      flight.photo.use(mode);
      find(".swipe").value = slider;
      flight.map.show([x, y], across);
    });
    if (on !== undefined) {
      const known = Object.keys(flight.data.tracks), names = on ? on.split(".") : [];
      read(names.every((name) => known.includes(name)), `methods such as ${known.join(".")}`, () => {
        switched = true;
        flight.hidden = new Set(known.filter((name) => !names.includes(name)));
      });
    }
    const choices = (kind) => all(`[data-${kind}]`).map((one) => one.dataset[kind]);
    const plots = choices("plot").filter((name) => name !== "height" || flight.timeline.highs());
    if (plot !== undefined) read(plots.includes(plot), `a plot among ${plots.join(", ")}`, () => (flight.timeline.plot = plot));
    if (named !== undefined) {
      const [right, up] = spot.map(Number), placed = spot.length === 2 && spot.every((text) => NUMBER.test(text));
      read(choices("list").includes(named) && (placed || !spot.length), `a list among ${choices("list").join(", ")}`, () => {
        list = named;
        more ||= list === "spot"; // whose tab is one of those
        if (placed) lpn.send("flight-spot", [right, up]);
      });
    }
    if (faults.length) lpn.say(`Not all of the link can be shown. look=${told.slice(0, 60)}: expected ${faults.join("; then ")}. Take the link from the flight again.`, 12);
    refresh();
  };
  // Write a text into a tip beside a mark, within a width in pixels; an empty one hides it. `more`: HTML that follows the text; `above`:
  // it may rise over what lies above.
  flight.tell = (tip, text, [left, top], width, reach, { more = "", above = false } = {}) => {
    tip.textContent = text;
    if (!text) return;
    tip.insertAdjacentHTML("beforeend", more);
    const below = !above && top < tip.offsetHeight + reach;
    tip.style.left = lpn.clamp(left - tip.offsetWidth / 2, 0, Math.max(width - tip.offsetWidth, 0)) + "px";
    const wanted = below ? top + reach : top - reach - tip.offsetHeight;
    tip.style.top = (above ? wanted : lpn.clamp(wanted, 0, Math.max(tip.parentElement.clientHeight - tip.offsetHeight, 0))) + "px";
  };

  // ---- from the server
  flight.show = (data) => {
    const before = flight.data;
    const times = data.times || data.names.map((_, i) => i), [low, high] = flight.range(times);
    data.span = { times, low, high };
    flight.data = data;
    if (flight.timeline.plot === "height" && !flight.timeline.highs()) flight.timeline.plot = "error";
    // In plain words the map starts with the GPS tags and one more track, that of the method that places most photos.
    if (!switched) flight.hidden = new Set(data.plain ? Object.keys(data.tracks).filter((name) => ![data.main, "tag", "corrected"].includes(name)) : []);
    flight.map.replaced(before);
    refresh();
  };
  flight.sentence = (text) => ((sentence = text), refresh());
  flight.accuracy = (text) => ((html.accuracy = text), refresh());
  flight.status = (text) => ((status = text), refresh());
  flight.lists = (lists) => (Object.assign(html, lists), refresh());
  // The window opens with the whole flight and no photo over it, or with a person's own picture laid over its map.
  const open = () => {
    flight.photo.use(flight.own() && flight.followed.homography ? "swipe" : "off");
    flight.map.look();
  };
  // It was closed, by whatever control, and opens again so.
  flight.leave = () => {
    if (!flight.data) return;
    open();
    refresh();
  };
  // Everything that belongs to a frame is shown at once: its flight's address, card, answer, scores, and the number of the message.
  flight.arrive = ({ address, frame, answer, scores, sequence }) => {
    if (flight.of !== null && flight.of !== address) {
      flight.wanted = flight.spotted = null;
      flight.photo.use("off");
    }
    flight.of = address;
    const before = flight.own(), { own } = frame ?? {};
    flight.followed = frame;
    flight.answered = answer;
    flight.painted = scores;
    if (scores) flight.map.paint(scores.picture);
    flight.play.arrived();
    flight.photo.followed();
    if (before?.key !== own?.key) open();
    if (flight.root) flight.root.dataset.seq = sequence;
    refresh();
  };
  // A flight that goes on, and that has no frame yet.
  flight.waits = (text) => {
    lpn.leaveFirst();
    flight.sentence(text);
  };
  // Each photo is laid over the map as it comes.
  flight.live = () => {
    lpn.leaveFirst();
    flight.goesOn = true;
    flight.photo.use("swipe");
    refresh();
  };
  flight.spot = (spot) => {
    flight.spotted = spot;
    list = "spot";
    html.spot = spot.html;
    refresh();
  };

  // ---- elements
  const fill = (element, text) => {
    if (element && element._html !== text) element.innerHTML = element._html = text;
  };
  const escaped = (text) => text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);
  // The sign of a track's answer for a frame; that of a refused one tells its reason.
  const sign = (name, track, frame) => {
    if (track.state[frame] === 2) return `<span class="term" tabindex="0" data-tip="${escaped(track.reason[frame])}">${SIGNS[2]}</span> `;
    return track.x[frame] === null ? "" : SIGNS[flight.doubted(name, frame) ? 1 : track.state[frame]] + " ";
  };
  const byPointer = (mouse, touch) => `<span class="for-mouse">${mouse}</span><span class="for-touch">${touch}</span>`;
  // Explain the marks on the map, as far as their tracks are switched on.
  const legend = () => {
    const shown = flight.tracks().map(([, track]) => track), parts = [];
    if (shown.some((track) => track.state.includes(2)))
      parts.push(`Hollow dot: refused; ${byPointer("point at it, or at its ✗,", "tap it, or its ✗,")} for the reason.`);
    if (flight.tracks().some(([name]) => flight.data.names.some((_, i) => flight.doubted(name, i))))
      parts.push(`Red diamond: in doubt, contradicted by its GPS tag, its neighbours, or the map away from its middle; ${byPointer("point at it", "tap it")}<span class="beside">, here or on the timeline,</span> for the metres.`);
    const key = (colour, words) => `<span class="key"><i style="background:${colour}"></i>${words}</span>`;
    const states = [["right", "placed"], ["contradicted", "in doubt"], ["unknown", "by its neighbours only, a guess, or not placed"]];
    const keys = states.map(([name, words]) => key(`var(--raw-${name})`, words)).join(", ");
    parts.push(`Frame on the map: the ground that the photo shows, in the colour of what may be believed of its place: ${keys}. Its thick side is the photo’s top; dashed, if only tag and camera tell it.`);
    if (!flight.hidden.has("tag") && flight.data.tracks.tag.x.some((x) => x !== null)) parts.push(escaped(flight.data.tracks.tag.mark));
    if (shown.some((track) => track.radius[flight.chosen])) parts.push(escaped(flight.data.circle));
    if (!flight.hidden.has("retrieval")) parts.push("Dotted: the piece of the map that looks most like it.");
    parts.push(`Pins${flight.data.plain ? ", with Swipe" : ""}, numbered as the details of Why?: the head is where the map has a place, the other end where the photo has it.`);
    // The table of the tracks, which stands above, is left out where the map stands alone.
    const marks = flight.tracks().filter(([name]) => name !== "tag").map(([, track]) => `<p class="dim marks">${key(track.colour, "")}${escaped(track.mark)}</p>`);
    return marks.join("") + parts.map((part) => `<p class="dim">${part}</p>`).join("");
  };
  flight.fillLegend = () => {
    const { data, chosen, hidden } = flight;
    const metres = (value) => (value === null ? "" : value.toFixed(value < 100 ? 1 : 0) + (data.plain ? " m" : ""));
    const rows = Object.entries(data.tracks).map(([name, track]) => {
      const cells = [
        `<a role="switch" tabindex="0" data-track="${name}" aria-checked="${!hidden.has(name)}"><b class="check"></b><i style="background:${track.colour}"></i>${track.label}</a>`,
        ...(name === "retrieval" ? ["not verified", "", ""] : [track.count, name === "tag" || chosen < 0 ? "" : sign(name, track, chosen), chosen < 0 ? "" : metres(track.radius[chosen])]),
        chosen < 0 ? "" : metres(track.error[chosen]),
      ];
      return `<tr data-state="${chosen < 0 ? "" : track.state[chosen]}">${cells.map((cell) => `<td>${cell}</td>`).join("")}</tr>`;
    });
    fill(
      find(".legend"),
      `<table class="num"><tr class="dim"><th></th><th>all photos</th><th colspan="3">this photo</th></tr><tr class="dim"><th>press to show</th><th title="Photos whose answer this stage accepts by itself">accepted</th><th title="✓ accepted, ? in doubt, ✗ refused"></th>${data.plain ? '<th title="The metres that its place may be off: nearly all lie nearer">may be off</th>' : '<th title="In metres: 1 sigma along each axis">± m</th>'}<th title="Metres between the answer's place on the map and the GPS tag, or the correction by hand">${data.plain ? "from GPS" : "m off tag"}</th></tr>${rows.join("")}</table><p class="methods">${escaped(data.methods)}</p>${legend()}`,
    );
  };
  const refresh = () => {
    const { root, data, followed, painted } = flight;
    if (!root) return;
    if (sentence) fill(find(".sentence"), sentence);
    fill(find(".status"), status);
    const unfolded = find(".accuracy details")?.open;
    fill(find(".accuracy"), html.accuracy);
    if (unfolded) find(".accuracy details")?.setAttribute("open", "");
    if (!flight.whole()) return;
    flight.fillLegend();
    fill(find(".lists"), html.counts);
    fill(find(".listed"), html[list] || `<p class="dim">${byPointer("Shift and click on the map", "Tap Who saw? and then the map")}: the frames that show the spot.</p>`);
    if (followed) {
      const before = find(".about details"), { open } = before ?? {};
      fill(find(".about"), followed.card);
      const after = find(".about details");
      // Folded or not, it stays so from photo to photo; other words begin as they do at first.
      if (before && before.dataset.words === after?.dataset.words) after.toggleAttribute("open", open);
    }
    const bar = find(".scores");
    bar.style.display = painted ? "flex" : "none";
    if (painted) {
      bar.querySelector("img").src = data.bar;
      for (const [name, key] of [["low", "low"], ["what", "label"], ["high", "high"]]) bar.querySelector("." + name).textContent = painted[key];
    }
    root.classList.toggle("plainly", data.plain);
    root.classList.toggle("own", flight.own() !== null);
    root.classList.toggle("elsewhere", data.elsewhere !== "");
    root.classList.toggle("more", more);
    flight.mark();
    flight.draw();
    edges();
  };
  // Mark the columns and lists whose end is out of sight.
  const edges = () =>
    all(".side, .upper, .listed, .accuracy").forEach((one) => one.classList.toggle("below", one.scrollHeight - one.scrollTop - one.clientHeight > 8));
  // Mark the buttons of what is chosen.
  flight.mark = () => {
    if (!flight.root) return;
    flight.root.classList.toggle("late", flight.wanted !== null);
    const set = (selector, name, value) =>
      all(selector).forEach((one) => {
        one.classList.toggle("chosen", one.dataset[name] === String(value));
        one.setAttribute("aria-pressed", one.dataset[name] === String(value));
      });
    set("[data-part]", "part", flight.painted ? flight.painted.part : "off");
    set("[data-photo]", "photo", flight.photo.mode);
    const highs = !flight.data || flight.timeline.highs();
    all("[data-plot=height]").forEach((one) => (one.style.display = highs ? "" : "none"));
    set("[data-plot]", "plot", flight.timeline.plot);
    set("[data-list]", "list", list);
    all("[data-act=more]").forEach((one) => {
      one.classList.toggle("chosen", more);
      one.setAttribute("aria-pressed", more);
    });
    all("[data-act=spot]").forEach((one) => one.classList.toggle("chosen", flight.asking));
    all(".entry").forEach((one) => one.classList.toggle("chosen", Number(one.dataset.frame) === flight.chosen));
    all("[data-act=play]").forEach((one) => (one.textContent = flight.play.on ? "❚❚" : "▶"));
    all("[data-act=skip]").forEach((one) => {
      one.classList.toggle("chosen", flight.play.skips);
      one.setAttribute("aria-pressed", flight.play.skips);
    });
    find(".view").classList.toggle("asking", flight.asking);
    find(".scale").hidden = flight.timeline.plot === "height"; // its axis alone is even
  };
  // Ask twice more for a picture that could not be loaded: the server may have been busy.
  flight.again = (image) => {
    const failures = Number(image.dataset.failures || 0) + 1, source = image.getAttribute("src");
    image.dataset.failures = failures;
    if (failures > 2) return;
    setTimeout(() => image.isConnected && image.getAttribute("src") === source && image.setAttribute("src", source), 2000 * failures);
  };

  // ---- buttons and keys
  const acts = {
    fit: () => flight.map.fit(),
    in: () => flight.map.stepIn(),
    out: () => flight.map.stepOut(),
    more: () => (more = !more),
    spot: () => (flight.asking = !flight.asking),
    play: () => flight.play.turn(),
    back: () => flight.step(-1),
    next: () => flight.step(1),
    skip: () => (flight.play.skips = !flight.play.skips),
    save: () => flight.photo.save(),
    cancel: () => flight.photo.cancel(),
    forget: () => flight.photo.forget(),
    turnto: () => flight.map.turnTo(),
  };
  const see = (flight.see = (selector) => find(selector).scrollIntoView({ block: "nearest" }));
  const onClick = (event) => {
    // The verdict on a photo of a list comes into sight.
    if (event.target.closest(".entry")) see(".about");
    const link = event.target.closest("[data-act],[data-photo],[data-plot],[data-list],[data-track]");
    if (!link || !flight.data) return;
    const { act, photo, plot, list: named, track } = link.dataset;
    acts[act]?.();
    if (photo) flight.photo.use(photo);
    if (plot) flight.timeline.plot = plot;
    if (named) list = named;
    if (track) {
      switched = true;
      if (!flight.hidden.delete(track)) flight.hidden.add(track);
    }
    refresh();
    if (named) see(".lower");
  };
  const onKey = (event) => {
    const { key, target } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || !flight.data) return;
    if (target.closest("select,input")) return event.stopPropagation();
    if (["Enter", " "].includes(key) && target.matches("a")) target.click();
    else if (key === " " && !flight.own()) flight.play.turn();
    else if (!(target.closest(".time") && flight.timeline.key(key)) && !flight.map.key(event)) return;
    event.preventDefault();
    event.stopPropagation();
  };
  new MutationObserver(flight.draw).observe(document.documentElement, { attributeFilter: [lpn.viser.SCHEME] });
  const resized = new ResizeObserver(() => {
    flight.map.resized();
    flight.draw();
    edges();
  });

  flight.attach = () => {
    const root = document.getElementById("lpn-flight");
    if (!root || root === flight.root) return refresh();
    flight.root = root;
    root.closest(lpn.viser.SELECTORS.sheetParts)?.classList.add("lpn-parts");
    root.addEventListener("click", onClick);
    root.addEventListener("keydown", onKey);
    root.addEventListener("scroll", edges, { capture: true, passive: true });
    root.addEventListener("toggle", edges, { capture: true });
    for (const part of [flight.map, flight.photo, flight.timeline]) part.attach();
    resized.disconnect();
    for (const canvas of [find(".view"), find(".time canvas")]) resized.observe(canvas);
    refresh();
  };
})();
