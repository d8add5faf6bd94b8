// The chosen frame's photo over the map of the flight window: swiped, blinking, or dragged to its place by tie points.
(() => {
  const lpn = window.lpn;
  const { flight } = lpn;
  if (flight.photo) return;
  const { find, all } = flight;
  // The photo's corners, in shares of it, which a person drags to their places on the map.
  const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  // Pixels of the slider's handle, as in the style sheet.
  const HANDLE = 36;
  // Metres within which a tie point lies where the photo's corner does.
  const SAME = 0.02;
  let at = -1; // the frame whose photo was brought near last
  // { frame, draft: its key, points: metres of each tie point, saved, forgot: how many saves there were when that was sent }
  let ties = null;

  // Tie points that are not saved stay in the browser until Save or Cancel: neither another photo, nor closing the window, nor
  // closing the page, nor forgetting the saved ones loses them.
  const drafts = new Map(); // for a browser that denies its storage
  const draftKey = () => ["lpn-ties", lpn.title, flight.data.bounds.join(), flight.data.names[flight.chosen]].join(" ");
  const draftOf = (key) => {
    try {
      const points = JSON.parse(lpn.stored("local", key) ?? "null") || drafts.get(key);
      return points.length === CORNERS.length && points.every((at) => at.length === 2 && at.every(Number.isFinite)) ? points : null;
    } catch {
      return null; // there is none, or another program's text
    }
  };
  // Those of the photo that is shown; null where the photo lies by now.
  const unsaved = () => {
    const points = here() && !flight.own() ? draftOf(draftKey()) : null, h = flight.followed?.homography;
    const same = points && h && CORNERS.map((tie) => lpn.through(h, pixel(tie))).every(([x, y], i) => Math.hypot(x - points[i][0], y - points[i][1]) < SAME);
    return same ? null : points;
  };
  const keepDraft = (key, points) => {
    if (points) drafts.set(key, points);
    else drafts.delete(key);
    lpn.store("local", key, points && JSON.stringify(points));
  };
  // The tie points leave the map; a sentence says that those which are not saved are kept.
  const putAway = () => {
    if (ties && ties.saved === undefined && draftOf(ties.draft)) lpn.say("The tie points are kept, and not saved yet: Correct shows them again.", 8);
    ties = null;
  };

  /** @param {Point} at */
  const pixel = ([x, y]) => [x * flight.followed.size[0] - 0.5, y * flight.followed.size[1] - 0.5];
  const here = () => flight.followed && flight.followed.frame === flight.chosen;
  const startTies = () => {
    const { size, homography } = flight.followed, outline = flight.data.outlines[flight.chosen];
    let h = homography;
    if (!h && outline) h = lpn.homography(CORNERS.map(pixel), outline.slice(0, 4));
    if (!h) {
      // Nothing tells where the photo lies: it starts in the middle of the view, north up.
      const { x, y, scale } = flight.map.view();
      const half = (0.2 * flight.map.size()[0]) / scale, tall = (half * size[1]) / size[0];
      h = lpn.homography(CORNERS.map(pixel), [[-1, 1], [1, 1], [1, -1], [-1, -1]].map(([right, up]) => [x + right * half, y + up * tall]));
    }
    ties = { frame: flight.chosen, draft: draftKey(), points: unsaved() ?? CORNERS.map((tie) => lpn.through(h, pixel(tie))) };
    flight.map.include(ties.points);
  };
  const tied = () => lpn.homography(CORNERS.map(pixel), ties.points);
  const moveTie = (which, [right, up]) => {
    ties.points = ties.points.map(([x, y], i) => (which === "all" || which === String(i) ? [x + right, y + up] : [x, y]));
    ties.saved = ties.forgot = undefined; // what was sent are other points
    keepDraft(ties.draft, ties.points);
    flight.draw();
  };
  const onTie = (event) => {
    const tie = event.target.closest("[data-tie]");
    if (!tie || !ties) return;
    if (!flight.map.view()) flight.map.fit(); // the window has changed its size since it was drawn
    const { scale } = flight.map.view();
    if (event.type === "keydown") {
      if (!(event.key in ARROWS)) return;
      moveTie(tie.dataset.tie, ARROWS[event.key].map((one) => (one * (event.shiftKey ? 10 : 1)) / scale));
      event.preventDefault();
    } else if (event.type === "pointerdown") {
      tie.setPointerCapture(event.pointerId);
      tie._at = [event.clientX, event.clientY];
    } else if (event.type === "pointermove" && tie._at) {
      moveTie(tie.dataset.tie, [(event.clientX - tie._at[0]) / scale, (tie._at[1] - event.clientY) / scale]);
      tie._at = [event.clientX, event.clientY];
    } else if (event.type !== "pointermove") tie._at = null;
    event.stopPropagation();
  };
  const placeTies = () => {
    const on = photo.mode === "correct" && ties && ties.frame === flight.chosen;
    find(".ties").style.display = on ? "block" : "none";
    find(".how").style.display = on ? "flex" : "none";
    const waits = unsaved() !== null;
    find("[data-photo=correct]").classList.toggle("unsaved", waits);
    find(".how .unsaved").hidden = !waits;
    if (!on) return;
    const middle = lpn.through(tied() || [0, 0, 0, 0, 0, 0, 0, 0, 1], pixel([0.5, 0.5]));
    all("[data-tie]").forEach((one) => {
      const [left, top] = flight.map.toPixels(one.dataset.tie === "all" ? middle : ties.points[Number(one.dataset.tie)]);
      one.style.left = left + "px";
      one.style.top = top + "px";
    });
    find("[data-act=forget]").style.display = flight.followed.corrected ? "" : "none";
  };

  // From the photo's pixels to metres; nothing while the photo has no place.
  const matrixOf = () => {
    if (!here()) return null;
    if (photo.mode !== "correct") return flight.followed.homography;
    if (ties?.frame !== flight.chosen) startTies();
    return tied();
  };
  // One projective transform of the page lays the photo.
  const lay = () => {
    const { mode } = photo, matrix = matrixOf(), laid = mode !== "off" && matrix;
    const layer = find(".laid"), swipe = find(".swipe"), edge = find(".edge");
    layer.style.opacity = mode === "correct" ? "0.6" : "1";
    layer.style.display = laid ? "block" : "none";
    layer.classList.toggle("blinks", mode === "blink");
    swipe.style.display = edge.style.display = laid && mode === "swipe" ? "block" : "none";
    placeTies();
    find("#lpn-flight-photo").title = matrix ? "Lay the registered photo over the map" : "This frame is not registered, so there is no photo to lay over the map";
    all("[data-photo]").forEach((one) => one.classList.toggle("off", ["swipe", "blink"].includes(one.dataset.photo) && !flight.followed?.homography));
    if (!laid) return;
    const image = layer.querySelector("img"), source = photo.address(flight.of, flight.followed);
    if (image.getAttribute("src") !== source) {
      image.dataset.failures = "0";
      image.onerror = () => flight.again(image);
      image.setAttribute("src", source);
    }
    if (!image.naturalWidth) {
      image.onload = flight.draw;
      return;
    }
    const { x, y, scale } = flight.map.view(), [width, height] = flight.map.size(), { size } = flight.followed;
    // From the edges of the served picture to the pixels of the photo, whose whole numbers are centres, to metres, to the view.
    const pixels = [size[0] / image.naturalWidth, 0, -0.5, 0, size[1] / image.naturalHeight, -0.5, 0, 0, 1];
    const look = [scale, 0, width / 2 - x * scale, 0, -scale, height / 2 + y * scale, 0, 0, 1];
    image.style.width = image.naturalWidth + "px";
    image.style.transform = lpn.transform(lpn.product(look, lpn.product(matrix, pixels)));
    // The slider spans what is seen of the photo, so that it opens in the photo's middle.
    const seen = layer.getBoundingClientRect(), whole = image.getBoundingClientRect();
    const left = lpn.clamp(whole.left - seen.left, 0, width), right = lpn.clamp(whole.right - seen.left, left, width);
    const top = lpn.clamp(whole.top - seen.top, 0, height), foot = lpn.clamp(whole.bottom - seen.top, top, height);
    const border = left + ((right - left) * swipe.value) / 100;
    // The handle's middle lies on the line; its own width would end it before the photo does.
    swipe.style.left = left - HANDLE / 2 + "px";
    swipe.style.width = right - left + HANDLE + "px";
    swipe.style.top = (top + foot - HANDLE) / 2 + "px";
    Object.assign(edge.style, { left: border + "px", top: top + "px", height: foot - top + "px" });
    layer.style.clipPath = mode === "swipe" ? `inset(0 0 0 ${border}px)` : "none";
  };

  // A photo that is compared with the map is brought near, so that it can be seen.
  const approach = () => {
    at = flight.chosen;
    if (flight.whole() && flight.map.view() && photo.compares()) flight.map.approach(CORNERS.map((corner) => lpn.through(flight.followed.homography, pixel(corner))));
  };

  const photo = (flight.photo = {
    mode: "off", // or "swipe", "blink", or "correct"
    address: (folder, { frame, own }) => own?.photo || folder + "photo/" + frame,
    lay,
    use: (mode) => {
      if (mode !== photo.mode) putAway();
      photo.mode = mode;
      approach();
    },
    // Return true if the photo is compared with the map below it, which marks of other photos would hide.
    compares: () => ["swipe", "blink"].includes(photo.mode) && !flight.root?.classList.contains("live") && !!matrixOf(),
    // A saved or forgotten correction ends the mode; another frame starts anew from what the server has.
    followed: () => {
      if (at !== flight.chosen) approach();
      if (!ties || !flight.followed) return;
      const ended = (sent) => sent !== undefined && sent !== flight.followed.saves;
      if (ended(ties.saved)) photo.cancel();
      else if (ended(ties.forgot)) photo.use("off");
      else if (ties.frame !== flight.chosen) putAway();
    },
    cancel: () => {
      if (ties) keepDraft(ties.draft, null);
      photo.use("off");
    },
    save: () => {
      const h = ties && tied();
      if (!h) return lpn.say("The tie points do not span a picture.");
      const millimetres = (value) => Math.round(1000 * value) / 1000;
      [ties.saved, ties.forgot] = [flight.followed.saves, undefined];
      lpn.send("flight-correct", [ties.frame, CORNERS.map((corner) => lpn.through(h, pixel(corner)).map(millimetres))]);
    },
    forget: () => {
      if (ties) [ties.saved, ties.forgot] = [undefined, flight.followed.saves];
      lpn.send("flight-forget", flight.chosen);
    },
    attach: () => {
      find(".swipe").addEventListener("input", lay);
      for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "keydown"]) find(".ties").addEventListener(kind, onTie);
    },
  });
})();
