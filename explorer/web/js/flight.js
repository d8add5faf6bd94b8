// The flight window: a map in tiles with tracks, a timeline, and a registered photo, on 2-D canvases.
// The server hands over data by `show`, `lists`, `follow`, `answer`, `paint`, and `spot`, in any order; the elements come and go.
(() => {
  const lpn = window.lpn;
  if (lpn.flight) return;
  /** @type {Record<string, any>} */
  const flight = (lpn.flight = {});
  // Pixels within which the mouse points at a frame, and seconds that playing waits for the stage.
  const REACH = 12, PATIENCE = 8;

  let root, data, followed, painted, spotted, answer;
  let chosen = -1; // the frame that the window shows; the stage may still be on its way to it
  let pending = null; // the frame that the stage was asked for, and since when
  let view = null; // metres in the middle of the map, and pixels per metre
  let moved = false; // the user has moved the map since it was fitted
  let mouse = null, photo = "off", blinking = 0, plot = "error", list = "refused", asking = false;
  let playing = 0, position = 0, last = 0, skipped = 0;
  const hidden = new Set();
  const tiles = lpn.tiles(() => draw());
  const { canvas, stroke, dot, text } = lpn.pens;
  const overlay = { picture: null, source: "" };

  const find = (selector) => root && root.querySelector(selector);
  const all = (selector) => (root ? [...root.querySelectorAll(selector)] : []);
  const ink = () => getComputedStyle(root).color;
  const total = () => data.names.length;
  const range = (values) => [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  const { clamp } = lpn;

  // ---- from metres to pixels and to degrees
  const size = () => [root.map.clientWidth, root.map.clientHeight];
  /** @param {Point} at */
  const toPixels = ([x, y]) => {
    const [width, height] = size();
    return [width / 2 + (x - view.x) * view.scale, height / 2 - (y - view.y) * view.scale];
  };
  /** @param {Point} at */
  const toMetres = ([left, top]) => {
    const [width, height] = size();
    return [view.x + (left - width / 2) / view.scale, view.y - (top - height / 2) / view.scale];
  };
  flight.pixels = (at) => toPixels(at);
  flight.followed = () => followed;
  flight.degrees = ([x, y]) => {
    const [west, south, east, north] = data.bounds;
    const u = (2 * x - west - east) / (east - west), v = (2 * y - south - north) / (north - south);
    const terms = [1, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
    return data.degrees.map((row) => row.reduce((sum, value, i) => sum + value * terms[i], 0));
  };
  const place = (track, i) => (track.x[i] === null || track.y[i] === null ? null : [track.x[i], track.y[i]]);

  // Show points in a share of the view, and at least 40 m of ground.
  const look = (points, share) => {
    const [width, height] = size();
    if (!points.length || !width) return;
    const span = (axis) => range(points.map((p) => p[axis]));
    const [west, east] = span(0), [south, north] = span(1);
    const scale = share * Math.min(width / Math.max(east - west, 40), height / Math.max(north - south, 40));
    view = { x: (west + east) / 2, y: (south + north) / 2, scale: limited(scale) };
  };
  const limited = (scale) => clamp(scale, 20 / data.pyramid.side, 8 / data.resolution);
  flight.fit = () => {
    moved = false;
    const [west, south, east, north] = data.bounds;
    const track = Object.entries(data.tracks).flatMap(([name, one]) =>
      name === "retrieval" ? [] : data.names.map((_, i) => (one.state[i] < 2 ? place(one, i) : null)).filter(Boolean),
    );
    const inside = track.filter(([x, y]) => x > west - 500 && x < east + 500 && y > south - 500 && y < north + 500);
    inside.length > 1 ? look(inside, 0.72) : look([[west, south], [east, north]], 0.9);
    draw();
  };
  const zoom = (factor, at) => {
    moved = true;
    const [width, height] = size();
    const [left, top] = at || [width / 2, height / 2];
    const [x, y] = toMetres([left, top]);
    view.scale = limited(view.scale * factor);
    view.x = x - (left - width / 2) / view.scale;
    view.y = y + (top - height / 2) / view.scale;
    draw();
  };

  // ---- drawing
  const path = (pen, points, close) => {
    pen.beginPath();
    points.forEach((point, i) => pen[i ? "lineTo" : "moveTo"](...toPixels(point)));
    if (close) pen.closePath();
  };
  const shown = () => Object.entries(data.tracks).filter(([name]) => !hidden.has(name));

  const drawTracks = (pen) => {
    for (const [name, track] of shown()) {
      // A line joins neighbours that were not refused; nothing has verified the retrieval, so it has no line.
      if (name !== "retrieval") {
        pen.beginPath();
        let down = false;
        for (let i = 0; i < total(); i++) {
          const at = place(track, i);
          if (track.state[i] === 2) continue;
          if (!at) {
            down = false;
            continue;
          }
          pen[down ? "lineTo" : "moveTo"](...toPixels(at));
          down = true;
        }
        stroke(pen, track.colour, name === "tag" ? 1.5 : 2, name === "tag" ? [5, 4] : []);
      }
      for (let i = 0; i < total(); i++) {
        const at = place(track, i);
        if (at) dot(pen, toPixels(at), name === "tag" ? 3 : 4, track.colour, track.state[i] === 2);
      }
    }
  };

  const drawChosen = (pen) => {
    if (spotted) {
      for (const i of spotted.frames) {
        path(pen, data.outlines[i].slice(0, 4), true);
        pen.fillStyle = "rgba(255,255,255,.05)";
        pen.fill();
        pen.lineWidth = 1;
        pen.strokeStyle = "rgba(255,255,255,.6)";
        pen.stroke();
      }
      const [left, top] = toPixels(spotted.spot);
      pen.beginPath();
      for (const [right, down] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(left + 4 * right, top + 4 * down);
        pen.lineTo(left + 13 * right, top + 13 * down);
      }
      stroke(pen, "#fff", 2);
    }
    if (chosen < 0) return;
    const outline = data.outlines[chosen];
    if (outline) {
      path(pen, outline.slice(0, 4), true);
      stroke(pen, "#ffe14d", 2, outline[4] ? [] : [7, 5]);
      // The picture's top edge is thicker.
      path(pen, outline.slice(0, 2));
      stroke(pen, "#ffe14d", 4);
    }
    if (answer && followed && followed.frame === chosen) {
      const [x, y, side] = answer;
      const half = side / 2;
      path(pen, [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]], true);
      stroke(pen, data.tracks.retrieval ? data.tracks.retrieval.colour : "#e69f00", 1.5, [2, 3]);
    }
    for (const [name, track] of shown()) {
      const at = place(track, chosen);
      if (!at) continue;
      const [left, top] = toPixels(at);
      if (track.radius[chosen]) {
        pen.beginPath();
        pen.arc(left, top, Math.max(track.radius[chosen] * view.scale, 1), 0, 7);
        stroke(pen, track.colour, 1.5, track.state[chosen] === 2 ? [3, 4] : []);
      }
      dot(pen, [left, top], name === "tag" ? 5 : 7, track.colour, track.state[chosen] === 2);
    }
  };

  const drawFrame = (pen) => {
    const [width, height] = size();
    for (const sheet of data.sheets) {
      path(pen, sheet.outline, true);
      stroke(pen, sheet.colour, 2);
      const corner = sheet.outline.reduce((best, p) => (p[1] - p[0] > best[1] - best[0] ? p : best));
      const [left, top] = toPixels(corner);
      text(pen, sheet.name, clamp(left + 8, 8, width - 60), clamp(top + 14, 14, height - 40));
    }
    root.map.dataset.metres = lpn.mapMarks.bar(pen, [12, height - 38], view.scale, width);
    lpn.mapMarks.north(pen, [width - 20, 30]);
  };

  let drawing = 0;
  const draw = () => {
    if (!drawing) drawing = requestAnimationFrame(paintAll);
  };
  const paintAll = () => {
    drawing = 0;
    if (!root || !root.isConnected || !data || !root.map.clientWidth) return;
    if (!view) flight.fit();
    if (!view) return;
    const [ground, ratio] = canvas(find(".ground"));
    ground.imageSmoothingEnabled = true;
    const shown = { size: size(), scale: view.scale, toPixels: toPixels, toMetres: toMetres };
    root.map.dataset.missing = tiles.draw(ground, ratio, data, shown);
    if (painted && overlay.picture) {
      const [west, south, east, north] = painted.bounds;
      const [left, top] = toPixels([west, north]), [right, bottom] = toPixels([east, south]);
      ground.globalAlpha = 0.6;
      ground.imageSmoothingEnabled = false;
      ground.drawImage(overlay.picture, left, top, right - left, bottom - top);
      ground.globalAlpha = 1;
    }
    layPhoto();
    const [pen] = canvas(find(".over"));
    drawTracks(pen);
    drawChosen(pen);
    drawFrame(pen);
    drawTime();
  };

  // ---- tie points: four points of the photo that a person drags to their places on the map
  const TIES = [[0.15, 0.15], [0.85, 0.15], [0.85, 0.85], [0.15, 0.85]];
  let ties = null; // { frame, points: metres of each tie point, saves: how many were saved when these were sent }
  /** @param {Point} at */
  const pixel = ([x, y]) => [x * followed.size[0] - 0.5, y * followed.size[1] - 0.5];
  const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];
  const startTies = () => {
    if (!followed || followed.frame !== chosen) return (ties = null);
    let h = followed.homography;
    const outline = data.outlines[chosen];
    if (!h && outline) h = lpn.homography(CORNERS.map(pixel), outline.slice(0, 4));
    if (!h) {
      // Nothing tells where the photo lies: it starts in the middle of the view, north up.
      const half = (0.2 * root.map.clientWidth) / view.scale, tall = (half * followed.size[1]) / followed.size[0];
      h = lpn.homography(CORNERS.map(pixel), [[-1, 1], [1, 1], [1, -1], [-1, -1]].map(([x, y]) => [view.x + x * half, view.y + y * tall]));
    }
    ties = { frame: chosen, points: TIES.map((tie) => lpn.through(h, pixel(tie))) };
  };
  const tied = () => lpn.homography(TIES.map(pixel), ties.points);
  const moveTie = (which, [right, up]) => {
    ties.points = ties.points.map(([x, y], i) => (which === "all" || which === String(i) ? [x + right, y + up] : [x, y]));
    draw();
  };
  const onTie = (event) => {
    const tie = event.target.closest("[data-tie]");
    if (!tie || !ties) return;
    if (event.type === "keydown") {
      const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!turn) return;
      const far = (event.shiftKey ? 10 : 1) / view.scale;
      moveTie(tie.dataset.tie, turn.map((one) => one * far));
      event.preventDefault();
    } else if (event.type === "pointerdown") {
      tie.setPointerCapture(event.pointerId);
      tie._at = [event.clientX, event.clientY];
    } else if (event.type === "pointermove" && tie._at) {
      moveTie(tie.dataset.tie, [(event.clientX - tie._at[0]) / view.scale, (tie._at[1] - event.clientY) / view.scale]);
      tie._at = [event.clientX, event.clientY];
    } else if (event.type !== "pointermove") tie._at = null;
    event.stopPropagation();
  };
  const placeTies = () => {
    const on = photo === "correct" && ties && ties.frame === chosen;
    find(".ties").style.display = on ? "block" : "none";
    if (!on) return;
    const middle = lpn.through(tied() || [0, 0, 0, 0, 0, 0, 0, 0, 1], pixel([0.5, 0.5]));
    all("[data-tie]").forEach((one) => {
      const [left, top] = toPixels(one.dataset.tie === "all" ? middle : ties.points[Number(one.dataset.tie)]);
      one.style.left = left + "px";
      one.style.top = top + "px";
    });
    find("[data-act=forget]").style.display = followed.corrected ? "" : "none";
  };

  // ---- the photo over the map: one projective transform of the page lays it there
  const laid = () => {
    if (!followed || followed.frame !== chosen) return null;
    if (photo !== "correct") return followed.homography;
    if (!ties || ties.frame !== chosen) startTies();
    return ties && tied();
  };
  const layPhoto = () => {
    const layer = find(".laid"), swipe = find(".swipe");
    const matrix = laid(), there = photo !== "off" && matrix;
    layer.style.opacity = photo === "correct" ? 0.6 : 1;
    placeTies();
    layer.style.display = there ? "block" : "none";
    swipe.style.display = there && photo === "swipe" ? "block" : "none";
    find("#lpn-flight-photo").title = matrix ? "Lay the registered photo over the map" : "This frame is not registered, so there is no photo to lay over the map";
    all("[data-photo]").forEach((one) => one.classList.toggle("off", ["swipe", "blink"].includes(one.dataset.photo) && !followed?.homography));
    if (!there) return;
    const image = layer.firstElementChild, source = data.address + "photo/" + chosen;
    if (image.getAttribute("src") !== source) {
      image.dataset.failures = 0;
      image.onerror = () => flight.again(image);
      image.setAttribute("src", source);
    }
    if (!image.naturalWidth) {
      image.onload = draw;
      return;
    }
    const [width, height] = size();
    // From the edges of the served picture to the pixels of the photo, whose whole numbers are centres, to metres, to the view.
    const pixels = [followed.size[0] / image.naturalWidth, 0, -0.5, 0, followed.size[1] / image.naturalHeight, -0.5, 0, 0, 1];
    const look = [view.scale, 0, width / 2 - view.x * view.scale, 0, -view.scale, height / 2 + view.y * view.scale, 0, 0, 1];
    image.style.width = image.naturalWidth + "px";
    image.style.transform = lpn.transform(lpn.product(look, lpn.product(matrix, pixels)));
    layer.style.clipPath = photo === "swipe" ? `inset(0 0 0 ${swipe.value}%)` : "none";
  };
  // Ask twice more for a picture that could not be loaded: the server may have been busy.
  flight.again = (image) => {
    const failures = Number(image.dataset.failures || 0) + 1, source = image.getAttribute("src");
    image.dataset.failures = failures;
    if (failures > 2) return;
    setTimeout(() => image.isConnected && image.getAttribute("src") === source && image.setAttribute("src", source), 2000 * failures);
  };
  const setPhoto = (mode) => {
    if (mode !== photo) ties = null;
    photo = mode;
    clearInterval(blinking);
    blinking = 0;
    if (!root) return;
    const layer = find(".laid");
    layer.style.visibility = "visible";
    if (mode === "blink") blinking = lpn.every(600, () => (layer.style.visibility = layer.style.visibility === "hidden" ? "visible" : "hidden"));
    mark();
    draw();
  };

  // ---- the timeline
  const series = (kind) =>
    kind === "height"
      ? [{ colour: ink(), values: data.heights, state: data.heights.map(() => 0), line: true }]
      : shown()
          .filter(([name]) => name !== "tag" && (kind === "error" || !["retrieval", "corrected"].includes(name)))
          .map(([, track]) => ({ colour: track.colour, values: track[kind], state: track.state }));
  const drawTime = () => {
    const element = find(".time canvas");
    element.classList.toggle("stacked", plot === "all");
    const plots = plot === "all" ? ["error", "radius", "height"] : [plot];
    lpn.timeline.draw(element, data, plots.map((kind) => ({ plot: kind, lines: series(kind) })), chosen, ink());
    element.setAttribute("aria-valuemax", total());
    element.setAttribute("aria-valuenow", chosen + 1);
    element.setAttribute("aria-valuetext", chosen < 0 ? "no frame" : data.names[chosen]);
    const since = data.times && chosen >= 0 ? data.times[chosen] - data.times[0] : null;
    const clock = since === null ? "" : ", " + Math.floor(since / 60) + ":" + String(Math.floor(since % 60)).padStart(2, "0");
    find(".now").textContent =
      (chosen < 0 ? "your own picture" : chosen + 1 + " of " + total() + clock) + (skipped ? ", " + skipped + " skipped" : "");
  };
  // ---- choosing a frame: the window follows at once, the stage when it can
  flight.choose = (frame) => {
    if (!data || frame < 0 || frame >= total()) return;
    if (frame === chosen && !pending) return;
    chosen = frame;
    position = frame;
    fill(find(".legend"), legend());
    pending = { frame: frame, since: performance.now() };
    if (!asked) ask();
    draw();
  };
  // A drag over the timeline asks for few of the frames on its way.
  let asked = 0;
  const ask = () => {
    const { frame } = pending;
    lpn.send("flight-frame", frame);
    asked = setTimeout(() => {
      asked = 0;
      if (pending && pending.frame !== frame) ask();
    }, 150);
  };
  const tick = () => {
    if (!playing) return;
    if (!root || !root.isConnected) return flight.play(false);
    const now = performance.now();
    position += (Number(find("[data-act=speed]").value) * (now - last)) / 1000;
    last = now;
    const frame = Math.min(Math.floor(position), total() - 1);
    // A frame that comes while the stage still works on an earlier one is skipped; the next takes its place.
    const busy = pending && now - pending.since < 1000 * PATIENCE;
    if (frame !== chosen && !busy) {
      skipped += Math.max(frame - chosen - 1, 0);
      const at = position;
      flight.choose(frame);
      position = at;
    }
    if (frame >= total() - 1 && !busy) flight.play(false);
  };
  flight.play = (on = !playing) => {
    clearInterval(playing);
    playing = 0;
    if (on && data) {
      skipped = 0;
      if (chosen >= total() - 1) flight.choose(0);
      position = Math.max(chosen, 0);
      last = performance.now();
      playing = lpn.every(50, tick);
    }
    mark();
  };

  // ---- from the server
  flight.show = (given) => {
    if (data && data.address !== given.address) {
      tiles.clear();
      spotted = null;
    }
    const same = data && String(data.bounds) === String(given.bounds);
    data = given;
    const times = data.times || data.names.map((_, i) => i), [low, high] = range(times);
    data.span = { times: times, low: low, high: high };
    if (!same) view = null;
    refresh();
  };
  flight.sentence = (text) => ((flight.words = text), refresh());
  flight.status = (text) => ((flight.state = text), refresh());
  flight.lists = (given) => ((flight.html = { ...flight.html, ...given }), refresh());
  flight.follow = (given) => {
    followed = given;
    if (pending && given && given.frame !== pending.frame && performance.now() - pending.since < 1000 * PATIENCE) return refresh();
    pending = null;
    const frame = given ? given.frame : -1;
    if (frame !== chosen && !playing) position = frame;
    chosen = frame;
    // A saved or forgotten correction starts anew from what the server has.
    const saved = ties && given && ties.saves !== undefined && ties.saves !== given.saves;
    if (ties && given && (ties.frame !== frame || saved)) ties = null;
    refresh();
  };
  flight.answer = (given) => ((answer = given), draw());
  flight.paint = (given) => {
    painted = given;
    if (given && overlay.source !== given.picture) {
      overlay.source = given.picture;
      const picture = new Image();
      picture.onload = () => ((overlay.picture = picture), draw());
      picture.src = given.picture;
    }
    refresh();
  };
  flight.spot = (given) => {
    spotted = given;
    list = "spot";
    flight.html = { ...flight.html, spot: given.html };
    refresh();
  };

  // ---- elements
  const fill = (element, html) => {
    if (element && element._html !== html) element.innerHTML = element._html = html;
  };
  const SIGNS = ["\u2713", "?", "\u2717"];
  const legend = () => {
    const metres = (value) => (value === null ? "" : value.toFixed(value < 100 ? 1 : 0) + " m");
    const rows = Object.entries(data.tracks).map(([name, track]) => {
      const here = chosen >= 0 && (track.x[chosen] !== null || track.state[chosen] === 2) ? SIGNS[track.state[chosen]] + " " : "";
      const cells = [
        `<a role="switch" tabindex="0" data-track="${name}" aria-checked="${!hidden.has(name)}"><i style="background:${track.colour}"></i>${track.label}</a>`,
        ...(name === "retrieval" ? ["not verified", ""] : [track.count, name === "tag" || chosen < 0 ? "" : here + metres(track.radius[chosen])]),
        chosen < 0 ? "" : metres(track.error[chosen]),
      ];
      return `<tr data-state="${chosen < 0 ? "" : track.state[chosen]}">${cells.map((cell) => `<td>${cell}</td>`).join("")}</tr>`;
    });
    return `<table class="num"><tr class="dim"><th title="Switch a track on or off">hollow: refused</th><th>accepted</th><th title="1-sigma radius of the chosen frame">± here</th><th title="Distance of the chosen frame's answer from its tag">off tag</th></tr>${rows.join("")}</table>`;
  };
  const refresh = () => {
    if (!root || !data) return;
    const html = flight.html || {};
    fill(find(".legend"), legend());
    find(".sentence").textContent = flight.words || "";
    find(".status").textContent = flight.state || "";
    fill(find(".lists"), html.counts || "");
    fill(find(".listed"), html[list] || '<p class="dim"><span class="for-mouse">Shift and click on the map</span><span class="for-touch">Tap Who saw? and then the map</span>: the frames that show the spot.</p>');
    if (followed && followed.frame === chosen) fill(find(".about"), followed.card);
    find(".about").classList.toggle("late", chosen >= 0 && followed?.frame !== chosen);
    if (chosen < 0) fill(find(".about"), "<p>Your own picture is not a frame of this flight.</p>");
    const bar = find(".scores");
    bar.style.display = painted ? "flex" : "none";
    if (painted) {
      bar.querySelector("img").src = data.bar;
      for (const [name, key] of [["low", "low"], ["what", "label"], ["high", "high"]]) bar.querySelector("." + name).textContent = painted[key];
    }
    mark();
    draw();
  };
  const mark = () => {
    if (!root) return;
    const set = (selector, name, value) =>
      all(selector).forEach((one) => {
        one.classList.toggle("chosen", one.dataset[name] === String(value));
        one.setAttribute("aria-pressed", one.dataset[name] === String(value));
      });
    set("[data-part]", "part", painted ? painted.part : "off");
    set("[data-photo]", "photo", photo);
    set("[data-plot]", "plot", plot);
    set("[data-list]", "list", list);
    all("[data-act=spot]").forEach((one) => one.classList.toggle("chosen", asking));
    all(".entry").forEach((one) => one.classList.toggle("chosen", Number(one.dataset.frame) === chosen));
    all("[data-act=play]").forEach((one) => (one.textContent = playing ? "❚❚" : "▶"));
    root.map.classList.toggle("asking", asking);
  };
  const acts = {
    fit: () => flight.fit(),
    in: () => zoom(1.5),
    out: () => zoom(1 / 1.5),
    spot: () => ((asking = !asking), mark()),
    play: () => flight.play(),
    save: () => {
      const h = ties && tied();
      if (!h) return lpn.say("The tie points do not span a picture.");
      const millimetres = (value) => Math.round(1000 * value) / 1000;
      ties.saves = followed.saves;
      lpn.send("flight-correct", [ties.frame, CORNERS.map((corner) => lpn.through(h, pixel(corner)).map(millimetres))]);
    },
    forget: () => {
      if (ties) ties.saves = followed.saves;
      lpn.send("flight-forget", chosen);
    },
  };
  const onClick = (event) => {
    const link = event.target.closest("[data-act],[data-photo],[data-plot],[data-list],[data-track]");
    if (!link || !data) return;
    const given = link.dataset;
    if (given.act && acts[given.act]) acts[given.act]();
    if (given.photo) setPhoto(given.photo);
    if (given.plot) plot = given.plot;
    if (given.list) list = given.list;
    if (given.track) hidden.has(given.track) ? hidden.delete(given.track) : hidden.add(given.track);
    refresh();
  };
  const onKey = (event) => {
    const key = event.key;
    if (event.ctrlKey || event.metaKey || event.altKey || !data) return;
    if (event.target.closest("select,input")) return event.stopPropagation();
    if (["Enter", " "].includes(key) && event.target.matches("a")) {
      event.preventDefault();
      event.stopPropagation();
      return event.target.click();
    }
    const timeline = event.target.closest(".time");
    const turn = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 10, PageDown: -10 }[key];
    const [width, height] = size();
    const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[key];
    if (key === " ") flight.play();
    else if (timeline && turn) flight.choose(clamp(chosen + turn, 0, total() - 1));
    else if (timeline && key === "Home") flight.choose(0);
    else if (timeline && key === "End") flight.choose(total() - 1);
    else if (!timeline && move) {
      moved = true;
      view.x += (move[0] * width) / 6 / view.scale;
      view.y += (move[1] * height) / 6 / view.scale;
      draw();
    } else if (["+", "="].includes(key)) zoom(1.5);
    else if (["-", "−"].includes(key)) zoom(1 / 1.5);
    else if (key === "0") flight.fit();
    else return;
    event.preventDefault();
    event.stopPropagation();
  };
  const hit = (at) => {
    let best = [REACH, -1];
    for (const [, track] of shown())
      for (let i = 0; i < total(); i++) {
        const point = place(track, i);
        if (!point) continue;
        const [left, top] = toPixels(point);
        const far = Math.hypot(left - at[0], top - at[1]);
        if (far < best[0]) best = [far, i];
      }
    return best[1];
  };
  const read = (at) => {
    const [x, y] = toMetres(at), frame = hit(at);
    find(".read").textContent =
      (frame >= 0 ? data.names[frame] + " · " : "") + lpn.mapMarks.degrees(flight.degrees([x, y])) + " · " + x.toFixed(1) + " m E, " + y.toFixed(1) + " m N";
  };
  const onMap = (event) => {
    if (!view || event.target.closest(".swipe,.zoom,.ties *")) return;
    const box = root.map.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    if (event.type === "wheel") {
      event.preventDefault();
      event.stopPropagation();
      return zoom(Math.exp(-clamp(event.deltaY, -240, 240) / 300), at);
    }
    if (event.type === "pointerdown") {
      root.map.setPointerCapture(event.pointerId);
      mouse = { at: at, from: at, moved: false };
    } else if (event.type === "pointermove") {
      if (mouse && (mouse.moved || Math.hypot(at[0] - mouse.from[0], at[1] - mouse.from[1]) > 4)) {
        mouse.moved = moved = true;
        view.x -= (at[0] - mouse.at[0]) / view.scale;
        view.y += (at[1] - mouse.at[1]) / view.scale;
        mouse.at = at;
        draw();
      }
      read(at);
    } else if (mouse) {
      const dragged = mouse.moved;
      mouse = null;
      if (dragged || event.type !== "pointerup") return;
      if (event.shiftKey || asking) {
        asking = false;
        return lpn.send("flight-spot", toMetres(at).map((value) => Math.round(100 * value) / 100));
      }
      const frame = hit(at);
      if (frame >= 0) flight.choose(frame);
    }
  };
  new MutationObserver(draw).observe(document.documentElement, { attributeFilter: [lpn.viser.SCHEME] });
  // The flight is fitted into the window again when that changes its size, unless the user has looked elsewhere.
  const resized = new ResizeObserver(() => {
    if (!moved) view = null;
    draw();
  });

  flight.attach = () => {
    const found = document.getElementById("lpn-flight");
    if (!found || found === root) return refresh();
    root = found;
    root.map = find(".view");
    root.addEventListener("click", onClick);
    root.addEventListener("keydown", onKey);
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) root.map.addEventListener(kind, onMap);
    root.map.addEventListener("wheel", onMap, { passive: false });
    root.map.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && (find(".read").textContent = ""));
    find(".swipe").addEventListener("input", layPhoto);
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel", "keydown"]) find(".ties").addEventListener(kind, onTie);
    const time = find(".time canvas");
    let held = false;
    time.addEventListener("pointerdown", (event) => {
      held = true;
      time.setPointerCapture(event.pointerId);
      flight.choose(lpn.timeline.nearest(event.offsetX, time, data));
    });
    time.addEventListener("pointermove", (event) => held && flight.choose(lpn.timeline.nearest(event.offsetX, time, data)));
    for (const kind of ["pointerup", "pointercancel"]) time.addEventListener(kind, () => (held = false));
    resized.disconnect();
    resized.observe(root.map);
    resized.observe(time);
    setPhoto(photo);
    refresh();
  };
})();
