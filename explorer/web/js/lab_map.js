// The laboratory's map of queries: wheel and pinch zoom, drags move it or draw a lasso, a click opens a query.
// Points are blended into pixels by hand from small pictures of each mark, so that 10^5 of them take no GPU.
(() => {
  const lpn = window.lpn;
  if (lpn.labMap) return;
  const SELECTED = 1, FAILED = 2, CHOSEN = 4, UNKNOWN = 255;
  // Pixels within which the mouse points at a query, and milliseconds that it rests before a tip is asked for.
  const REACH = 9, REST = 120;
  // Corners of a lasso that the server takes, and pixels between them.
  const CORNERS = 300, APART = 5;
  // A drag is straight if it leaves the line between its ends by at most this share of their distance; it spans a box, each side of
  // which has some pixels.
  const STRAIGHT = 0.12, LEAST_SIDE = 6;
  // Selected queries beyond which marks are small and have hard edges.
  const MANY = 15000;
  const GREY = "#8a8a8a", PALE = "#515357", TILE = "#9aa1a8";
  const { clamp } = lpn;
  // The corners of what a drag encloses: its own, or those of the box that a straight one spans; null if it encloses nothing.
  const enclosed = (drag) => {
    if (drag.length < 2) return null;
    const [[x0, y0], [x1, y1]] = [drag[0], drag[drag.length - 1]], [right, down] = [x1 - x0, y1 - y0];
    const far = Math.hypot(right, down), off = ([x, y]) => Math.abs((x - x0) * down - (y - y0) * right) / far;
    const along = ([x, y]) => ((x - x0) * right + (y - y0) * down) / far;
    const slack = STRAIGHT * far;
    if (!far || drag.some((at) => !(off(at) <= slack && along(at) >= -slack && along(at) <= far + slack))) return drag.length > 2 ? drag : null;
    return Math.min(Math.abs(right), Math.abs(down)) < LEAST_SIDE ? null : [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
  };
  const views = new Map(); // middle and pixels per unit of each map that was looked at
  let mode = "move", data = null, root = null, current = null;

  // ---- what the server publishes, by address; the newest few
  const fetched = new Map();
  const get = (address, type) => {
    const known = fetched.get(address);
    if (known) return known;
    const coming = fetch(address).then(async (answer) => {
      if (!answer.ok) throw new Error(String(answer.status));
      const bytes = await answer.arrayBuffer();
      return type === "picture" ? createImageBitmap(new Blob([bytes])) : new type(bytes);
    });
    coming.catch(() => setTimeout(() => fetched.delete(address), 1000));
    fetched.set(address, coming);
    for (const key of fetched.keys()) if (fetched.size > 8) fetched.delete(key);
    return coming;
  };

  // ---- marks as lists of pixels: offsets from the middle, colour, and opacity
  const marks = new Map();
  const mark = (shape, colour, radius, outline, hard) => {
    const key = [shape, colour, radius, outline, hard].join();
    if (marks.has(key)) return marks.get(key);
    if (marks.size > 1500) marks.clear();
    const side = 2 * Math.ceil(radius + 2) + 1, middle = side / 2;
    const canvas = Object.assign(document.createElement("canvas"), { width: side, height: side });
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.lineCap = "round";
    const draw = (grown, ink) => {
      pen.beginPath();
      pen.strokeStyle = pen.fillStyle = ink;
      if (shape === "cross") {
        const arm = radius * 0.72;
        pen.moveTo(middle - arm, middle - arm), pen.lineTo(middle + arm, middle + arm);
        pen.moveTo(middle + arm, middle - arm), pen.lineTo(middle - arm, middle + arm);
        pen.lineWidth = Math.max(radius * 0.45, 1.2) + 2 * grown;
        pen.stroke();
      } else if (shape === "square") pen.fillRect(middle - radius - grown, middle - radius - grown, 2 * (radius + grown), 2 * (radius + grown));
      else pen.arc(middle, middle, radius + grown, 0, 7), pen.fill();
    };
    if (outline) draw(0.9, "rgba(10,10,12,.85)");
    draw(0, colour);
    const pixels = pen.getImageData(0, 0, side, side).data;
    const found = { dx: [], dy: [], rgba: [] };
    for (let i = 0; i < side * side; i++)
      if (pixels[4 * i + 3] > (hard ? 110 : 8)) {
        found.dx.push((i % side) - (side >> 1));
        found.dy.push(Math.floor(i / side) - (side >> 1));
        found.rgba.push(...pixels.slice(4 * i, 4 * i + 3), hard ? 255 : pixels[4 * i + 3]);
      }
    const made = { dx: Int16Array.from(found.dx), dy: Int16Array.from(found.dy), rgba: Uint8Array.from(found.rgba), offsets: null, stride: 0 };
    made.ink = new Uint32Array(made.rgba.buffer);
    marks.set(key, made);
    return made;
  };

  const LabMap = (box) => {
    const [ground, points, overlay] = box.querySelectorAll("canvas");
    const counted = box.querySelector(".counted"), position = box.querySelector(".read");
    let plane = null, flags = null, codes = null, palette = [], picture = null, order = null, groups = null;
    let view = null, frame = 0, buffer = null, rest = 0, hovered = -1, lasso = null, asked = 0;
    const fingers = new Map();
    let pinch = 0, dragged = 0, last = null;
    const size = () => [box.clientWidth, box.clientHeight];
    const ratio = () => Math.min(window.devicePixelRatio || 1, 2);
    const x = (i) => plane[2 * i], y = (i) => plane[2 * i + 1];
    const toPixels = (px, py) => [box.clientWidth / 2 + (px - view.x) * view.scale, box.clientHeight / 2 - (py - view.y) * view.scale];
    /** @param {Point} at */
    const toPlane = ([left, top]) => [view.x + (left - box.clientWidth / 2) / view.scale, view.y - (top - box.clientHeight / 2) / view.scale];
    const soon = () => (frame ||= requestAnimationFrame(draw));
    const ready = () => plane && flags && codes && view && box.isConnected;

    // Fit the view to points; `share` of it is theirs.
    const fit = (which, share = 0.92) => {
      let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
      const grow = (px, py) => {
        if (px !== px) return;
        low = [Math.min(low[0], px), Math.min(low[1], py)];
        high = [Math.max(high[0], px), Math.max(high[1], py)];
      };
      const total = data.queries + (which ? 0 : data.tiles);
      for (let i = 0; i < total; i++) if (!which || which(i)) grow(x(i), y(i));
      if (!which && data.ground) data.ground.corners.forEach((corner) => grow(...corner));
      if (low[0] > high[0]) return;
      const [width, height] = size();
      const scale = share * Math.min(width / Math.max(high[0] - low[0], 1e-3), height / Math.max(high[1] - low[1], 1e-3));
      view = { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale: scale };
      views.set(data.view, view);
      soon();
    };
    const zoom = (factor, at) => {
      const [px, py] = toPlane(at);
      view.scale = clamp(view.scale * factor, 20, 1e7);
      view.x = px - (at[0] - box.clientWidth / 2) / view.scale;
      view.y = py + (at[1] - box.clientHeight / 2) / view.scale;
      soon();
    };
    const pan = (right, down) => {
      view.x -= right / view.scale;
      view.y += down / view.scale;
      soon();
    };

    // The order of drawing: tiles, queries that are not selected, those found, those failed. Many are drawn in the order of the
    // queries: failures on top would hide all others.
    const sort = () => {
      const layers = [[], [], [], []];
      for (let i = 0; i < data.tiles && !data.ground; i++) layers[0].push(data.queries + i);
      groups = null;
      const alone = data.ground ? grouped() : null;
      for (let i = 0; i < data.queries; i++) {
        if (!(flags[i] & SELECTED)) layers[1].push(i);
        else if (!alone || alone[i]) layers[flags[i] & FAILED && data.selected <= MANY ? 3 : 2].push(i);
      }
      order = layers.map((layer) => Int32Array.from(layer));
    };
    // On the ground, selected queries of one place are one pie.
    const grouped = () => {
      const at = new Map(), alone = new Uint8Array(data.queries).fill(1);
      for (let i = 0; i < data.queries; i++) {
        if (!(flags[i] & SELECTED) || x(i) !== x(i)) continue;
        const key = x(i) + "," + y(i);
        at.has(key) ? at.get(key).push(i) : at.set(key, [i]);
      }
      groups = [...at.values()].filter((members) => members.length > 1);
      for (const members of groups) for (const i of members) alone[i] = 0;
      return alone;
    };
    const colour = (i) => (codes[i] === UNKNOWN ? GREY : palette[codes[i]] || GREY);

    const draw = () => {
      frame = 0;
      if (!ready()) return;
      const begun = performance.now(), k = ratio();
      const [width, height] = size().map((side) => Math.round(side * k));
      if (!width || !height) return;
      for (const canvas of [ground, points, overlay]) if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      drawGround(ground.getContext("2d"), k);
      drawPoints(points.getContext("2d"), width, height, k);
      drawOverlay(k);
      box.dataset.frame = (performance.now() - begun).toFixed(1);
      box.dataset.frames = Number(box.dataset.frames || 0) + 1;
    };
    const drawGround = (pen, k) => {
      pen.setTransform(k, 0, 0, k, 0, 0);
      pen.clearRect(0, 0, ...size());
      if (!data.ground || !picture) return;
      const [left, top] = toPixels(...data.ground.corners[0]), [right, bottom] = toPixels(...data.ground.corners[1]);
      pen.imageSmoothingQuality = "high";
      pen.drawImage(picture, left, top, right - left, bottom - top);
      pen.fillStyle = "rgba(0,0,0,.45)"; // points stand out
      pen.fillRect(left, top, right - left, bottom - top);
    };
    const drawPoints = (pen, width, height, k) => {
      const pad = 16, stride = width + 2 * pad, lines = height + 2 * pad;
      if (!buffer || buffer.width !== stride || buffer.height !== lines) buffer = new ImageData(stride, lines);
      const bytes = buffer.data, words = new Uint32Array(bytes.buffer);
      words.fill(0);
      const count = order[2].length + order[3].length;
      const near = Math.sqrt(Math.max(view.scale / (views.get(data.view + "fit") || view.scale), 1));
      const radius = clamp((count <= 400 ? 4.6 : count <= 3000 ? 3.6 : count <= MANY ? 2.6 : 1.7) * Math.min(near, 2), 1.5, 6) * k;
      const quiet = Math.max(radius * 0.6, 1.2 * k);
      const [a, b] = [view.scale * k, width / 2 + pad - view.x * view.scale * k];
      const c = height / 2 + pad + view.y * view.scale * k;
      const outline = radius > 2.4 * k;
      // Many points have hard edges: a pixel of theirs is written, not blended.
      const hard = count > MANY;
      const at = (one) => {
        if (one.stride !== stride) {
          one.stride = stride;
          one.offsets = Int32Array.from(one.dx, (dx, m) => one.dy[m] * stride + dx);
        }
        return one;
      };
      let crosses = [];
      // `made` has a mark for each code, or is the mark of all.
      const stamp = (which, made) => {
        const same = Array.isArray(made) ? null : at(made);
        const [right, bottom] = [stride - pad + 8, lines - pad + 8];
        for (let n = 0; n < which.length; n++) {
          const i = which[n], left = (plane[2 * i] * a + b + 0.5) | 0, top = (c - plane[2 * i + 1] * a + 0.5) | 0;
          if (!(left >= pad - 8 && left < right && top >= pad - 8 && top < bottom)) continue;
          const { offsets, ink, rgba } = same || (hard && flags[i] & FAILED ? crosses : made)[codes[i]], from = top * stride + left;
          if (hard) {
            for (let m = 0; m < offsets.length; m++) words[from + offsets[m]] = ink[m];
            continue;
          }
          for (let m = 0; m < offsets.length; m++) {
            const to = from + offsets[m], alpha = rgba[4 * m + 3];
            if (alpha > 250 || !words[to]) words[to] = ink[m];
            else {
              const at = 4 * to, part = alpha / 255;
              bytes[at] += (rgba[4 * m] - bytes[at]) * part;
              bytes[at + 1] += (rgba[4 * m + 1] - bytes[at + 1]) * part;
              bytes[at + 2] += (rgba[4 * m + 2] - bytes[at + 2]) * part;
              bytes[at + 3] = Math.max(bytes[at + 3], alpha);
            }
          }
        }
      };
      stamp(order[0], mark("square", TILE, Math.max(radius * 0.5, k), false, hard));
      stamp(order[1], mark("dot", PALE, quiet, false, hard));
      const styled = (shape, grown) => {
        const made = palette.map((ink) => at(mark(shape, ink, grown, outline, hard)));
        made[UNKNOWN] = at(mark(shape, GREY, grown, outline, hard));
        return made;
      };
      crosses = styled("cross", radius * 1.25);
      stamp(order[2], styled("dot", radius));
      stamp(order[3], crosses);
      pen.setTransform(1, 0, 0, 1, 0, 0);
      pen.clearRect(0, 0, width, height);
      pen.putImageData(buffer, -pad, -pad);
    };
    const drawPie = (pen, members) => {
      const [left, top] = toPixels(x(members[0]), y(members[0]));
      const [width, height] = size();
      if (left < -20 || top < -20 || left > width + 20 || top > height + 20) return;
      const radius = clamp(4 + 1.2 * Math.sqrt(members.length), 5, 12), shares = new Map();
      for (const i of members) shares.set(colour(i), (shares.get(colour(i)) || 0) + 1);
      let angle = -Math.PI / 2;
      pen.beginPath();
      pen.arc(left, top, radius + 1.5, 0, 7);
      pen.fillStyle = "rgba(10,10,12,.85)";
      pen.fill();
      for (const [ink, many] of [...shares].sort()) {
        const next = angle + (2 * Math.PI * many) / members.length;
        pen.beginPath();
        pen.moveTo(left, top);
        pen.arc(left, top, radius, angle, next);
        pen.fillStyle = ink;
        pen.fill();
        angle = next;
      }
    };
    const drawOverlay = (k) => {
      const pen = overlay.getContext("2d");
      pen.setTransform(k, 0, 0, k, 0, 0);
      pen.clearRect(0, 0, ...size());
      const line = (from, to, ink, width) => {
        if (plane[2 * to] !== plane[2 * to] || x(from) !== x(from)) return;
        pen.beginPath();
        pen.moveTo(...toPixels(x(from), y(from)));
        pen.lineTo(...toPixels(x(to), y(to)));
        lpn.pens.stroke(pen, ink, width);
      };
      const style = getComputedStyle(document.documentElement);
      const wrong = style.getPropertyValue("--lpn-map-false").trim(), right = style.getPropertyValue("--lpn-map-true").trim();
      for (const [query, tile] of data.lines) line(query, data.queries + tile, wrong, 1);
      for (const members of groups || []) drawPie(pen, members);
      if (data.query && x(data.query[0]) === x(data.query[0])) {
        const [query, answer, positive] = data.query;
        const tiles = [];
        if (answer >= 0 && answer !== positive) tiles.push([answer, wrong]);
        if (positive >= 0 && !data.ground) tiles.push([positive, right]);
        for (const [tile, ink] of tiles) {
          line(query, data.queries + tile, ink, 1.5);
          const [left, top] = toPixels(x(data.queries + tile), y(data.queries + tile));
          pen.fillStyle = "#0a0a0c";
          pen.fillRect(left - 5.5, top - 5.5, 11, 11);
          pen.fillStyle = ink;
          pen.fillRect(left - 4.5, top - 4.5, 9, 9);
        }
        ring(pen, query, data.ground ? 13 : 9, "#fff", 2.5);
      }
      for (let i = 0; data.chosen && data.chosen < MANY && i < data.queries; i++) if (flags[i] & CHOSEN && x(i) === x(i)) ring(pen, i, data.ground ? 12 : 7, "#e69f00", 2);
      if (hovered >= 0) ring(pen, hovered, data.ground ? 13 : 8, "#56b4e9", 2);
      if (lasso && lasso.length > 1) {
        pen.beginPath();
        (enclosed(lasso) || lasso).forEach((at, i) => pen[i ? "lineTo" : "moveTo"](...at));
        pen.closePath();
        pen.fillStyle = "rgba(86,180,233,.18)";
        pen.fill("evenodd");
        lpn.pens.stroke(pen, "#fff", 1.5, [5, 4]);
      }
      if (!data.ground) return;
      const [width, height] = size();
      box.dataset.metres = lpn.mapMarks.bar(pen, [12, height - 12], view.scale / data.ground.metres, width);
      lpn.mapMarks.north(pen, [22, 58]);
    };
    const ring = (pen, i, radius, ink, width) => {
      pen.beginPath();
      pen.arc(...toPixels(x(i), y(i)), radius, 0, 7);
      lpn.pens.stroke(pen, ink, width);
    };

    // The query nearest to a place; selected ones go before others.
    /** @param {Point} at */
    const near = ([left, top]) => {
      const best = [[REACH, -1], [REACH, -1]];
      for (let i = 0; i < data.queries; i++) {
        const [px, py] = [(x(i) - view.x) * view.scale + box.clientWidth / 2, box.clientHeight / 2 - (y(i) - view.y) * view.scale];
        const far = Math.hypot(px - left, py - top), which = flags[i] & SELECTED ? 0 : 1;
        if (far < best[which][0]) best[which] = [far, i];
      }
      return best[0][1] >= 0 ? best[0][1] : best[1][1];
    };
    const inLasso = (corners) => {
      let low = [Infinity, Infinity], high = [-Infinity, -Infinity], found = 0;
      for (const [px, py] of corners) low = [Math.min(low[0], px), Math.min(low[1], py)], high = [Math.max(high[0], px), Math.max(high[1], py)];
      for (let i = 0; i < data.queries; i++) {
        const [px, py] = [x(i), y(i)];
        if (!(flags[i] & SELECTED) || !(px >= low[0] && px <= high[0] && py >= low[1] && py <= high[1])) continue;
        let inside = false;
        for (let n = 0, m = corners.length - 1; n < corners.length; m = n++) {
          const [x0, y0] = corners[n], [x1, y1] = corners[m];
          if (y0 > py !== y1 > py && px < x0 + ((py - y0) / (y1 - y0)) * (x1 - x0)) inside = !inside;
        }
        if (inside) found++;
      }
      return found;
    };
    // On the ground: the latitude and longitude of a place in pixels; without one, nothing.
    const read = (at) => {
      const place = at && data.ground ? toPlane(at) : null;
      position.textContent = place ? lpn.mapMarks.degrees([1, 0].map((axis, i) => data.ground.degrees[i][0] + place[axis] * data.ground.degrees[i][1])) : "";
    };
    const tell = (count) => (counted.textContent = count.toLocaleString("en") + " of " + data.queries.toLocaleString("en"));

    // ---- mouse, fingers, keys
    const at = (event) => {
      const { left, top } = box.getBoundingClientRect();
      return [event.clientX - left, event.clientY - top];
    };
    const hideTips = () => document.querySelectorAll(".lab-tip").forEach((tip) => (tip.style.display = "none"));
    overlay.addEventListener("pointerdown", (event) => {
      if (!ready()) return;
      overlay.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, at(event));
      hideTips();
      dragged = 0;
      last = at(event);
      read(last);
      if (fingers.size === 2) (lasso = null), (pinch = apart());
      else lasso = (mode === "lasso") !== event.shiftKey && event.button === 0 ? [at(event)] : null;
    });
    const apart = () => {
      const [[x0, y0], [x1, y1]] = fingers.values();
      return Math.hypot(x1 - x0, y1 - y0);
    };
    overlay.addEventListener("pointermove", (event) => {
      if (!ready()) return;
      const now = at(event);
      read(now);
      clearTimeout(rest);
      if (fingers.has(event.pointerId)) {
        fingers.set(event.pointerId, now);
        dragged += Math.hypot(now[0] - last[0], now[1] - last[1]);
        if (fingers.size === 2) {
          const [[x0, y0], [x1, y1]] = fingers.values(), far = apart();
          if (pinch > 0 && far > 0) zoom(far / pinch, [(x0 + x1) / 2, (y0 + y1) / 2]);
          pinch = far;
        } else if (lasso) {
          const [left, top] = lasso[lasso.length - 1];
          if (Math.hypot(now[0] - left, now[1] - top) > APART) lasso.push(now);
          asked ||= requestAnimationFrame(() => {
            asked = 0;
            if (!lasso) return; // it was sent meanwhile
            const corners = enclosed(lasso);
            tell(corners ? inLasso(corners.map(toPlane)) : data.selected);
          });
          soon();
        } else if (dragged > 4) pan(now[0] - last[0], now[1] - last[1]);
        last = now;
        return;
      }
      hideTips();
      const found = near(now);
      if (found !== hovered) (hovered = found), soon();
      overlay.style.cursor = found >= 0 ? "pointer" : mode === "lasso" || event.shiftKey ? "crosshair" : "grab";
      if (found < 0) return;
      lpn.mouse = [event.clientX, event.clientY];
      rest = setTimeout(() => lpn.send("lab-tip", [data.map, found]), REST);
    });
    const sendLasso = (pixels) => {
      const step = Math.ceil(pixels.length / CORNERS);
      const places = pixels.filter((_, i) => i % step === 0).map(toPlane);
      lpn.send("lab-lasso", [data.map, places.map((place) => place.map((value) => +value.toFixed(6)))]);
    };
    // The corners of the map in pixels, and the number of selected queries between them.
    const corners = () => {
      const [right, down] = size();
      return [[0, 0], [right, 0], [right, down], [0, down]];
    };
    const inSight = () => inLasso(corners().map(toPlane));
    const release = (event) => {
      const known = fingers.delete(event.pointerId);
      if (!known || !ready()) return;
      const drawn = lasso;
      lasso = null;
      soon();
      if (event.type !== "pointerup") return tell(data.selected);
      const chosen = drawn && dragged > 12 ? enclosed(drawn) : null;
      if (chosen) sendLasso(chosen);
      else if (dragged <= 4 && !fingers.size) {
        const found = near(at(event));
        const toggles = event.ctrlKey || event.metaKey;
        if (found >= 0) toggles ? lpn.send("lab-rows", [found, found, "toggle"]) : lpn.send("lab-point", [data.map, found]);
        tell(data.selected);
      } else tell(data.selected);
    };
    overlay.addEventListener("pointerup", release);
    overlay.addEventListener("pointercancel", release);
    overlay.addEventListener("pointerleave", (event) => {
      if (event.pointerType === "mouse") read(null); // what a finger has pointed at stays
      clearTimeout(rest);
      hideTips();
      if (hovered >= 0) (hovered = -1), soon();
    });
    overlay.addEventListener(
      "wheel",
      (event) => {
        if (!ready()) return;
        event.preventDefault();
        hideTips();
        // Lines and pages of a wheel are in pixels here; a pinch on a touchpad comes with Ctrl, in small steps.
        const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : event.deltaMode === 2 ? 400 : 1);
        zoom(Math.exp(-clamp(pixels, -300, 300) * (event.ctrlKey ? 0.01 : 0.0018)), at(event));
      },
      { passive: false },
    );
    const acts = {
      move: () => (mode = "move"),
      lasso: () => (mode = "lasso"),
      in: () => zoom(1.5, size().map((side) => side / 2)),
      out: () => zoom(1 / 1.5, size().map((side) => side / 2)),
      all: () => fit(null),
      chosen: () => fit((i) => flags[i] & SELECTED, 0.8),
    };
    const pressed = () => {
      box.querySelector(".hint").hidden = mode !== "lasso";
      box.querySelectorAll("button").forEach((one) => ["move", "lasso"].includes(one.dataset.act) && one.setAttribute("aria-pressed", one.dataset.act === mode));
    };
    box.querySelectorAll("button").forEach((one) => one.addEventListener("click", () => (ready() && acts[one.dataset.act](), pressed())));
    overlay.addEventListener("keydown", (event) => {
      if (!ready() || event.ctrlKey || event.metaKey || event.altKey) return;
      const steps = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      const keys = { "+": "in", "=": "in", "-": "out", 0: "all" };
      if (event.key in steps) {
        const before = view, seen = inSight();
        view = { ...view };
        pan(...steps[event.key]);
        if (seen && !inSight()) (view = before), lpn.say("No point lies further that way.", 2);
        views.set(data.view, view);
      } else if (event.key === "Enter") inSight() ? sendLasso(corners()) : lpn.say("No query is in sight.", 2);
      else if (event.key in keys) acts[keys[event.key]]();
      else if (event.key === "Escape" && lasso) (lasso = null), tell(data.selected), soon();
      else if (event.key === "Escape" && data.lasso) lpn.send("lab-unpick", "in " + data.map);
      else return;
      read(null);
      event.preventDefault();
      event.stopPropagation();
    });
    new ResizeObserver(soon).observe(box);
    pressed();

    const legend = () => {
      const key = box.parentElement.querySelector(".lab-key");
      const { labels, counts, ends } = data.legend;
      const entry = (ink, words, sign = "●") => {
        const one = document.createElement("span"), dot = one.appendChild(document.createElement("b"));
        dot.textContent = sign;
        dot.style.color = ink;
        one.append(" " + words);
        return one;
      };
      const crosses = order[3].length > 0; // of queries that share their place there are none
      const entries = labels.map((label, code) => entry(data.palette[code], label + ": " + counts[code].toLocaleString("en"), data.colour || code === 0 || !crosses ? "●" : "✕"));
      if (ends) {
        const bar = document.createElement("i");
        bar.className = "scale";
        bar.style.background = "linear-gradient(90deg," + [0, 63, 127, 190, 254].map((code) => data.palette[code]).join() + ")";
        const one = document.createElement("span");
        one.append(ends[0] + " ", bar, " " + ends[1]);
        entries.push(one);
      }
      const none = counts[counts.length - 1];
      if (none) entries.push(entry(GREY, (data.colour ? "no value: " : "place not known: ") + none.toLocaleString("en")));
      if (data.colour && crosses) entries.push(entry("currentColor", "failed", "✕"));
      if (groups?.length) entries.push(entry("currentColor", "a pie: the queries of one place", "◕"));
      if (!data.ground) entries.push(entry(TILE, "tiles", "■"));
      if (data.axes) entries.push(data.axes);
      if (data.query) entries.push("ringed: the query");
      key.replaceChildren(...entries.map((one) => (typeof one === "string" ? Object.assign(document.createElement("span"), { textContent: one }) : one)));
    };

    return {
      box: box,
      view: () => view,
      pixels: (i) => toPixels(x(i), y(i)),
      update: async (next) => {
        const select = /** @type {HTMLSelectElement} */ (document.getElementById("lpn-lab-colour"));
        if (select && select.value !== next.colour) select.value = next.colour;
        const address = next.address;
        const wanted = [get(address + next.plane + "0", Float32Array), get(address + next.flags + "0", Uint8Array), get(address + next.codes + "0", Uint8Array)];
        if (next.ground) wanted.push(get(address + next.ground.picture + "0", "picture"));
        let came;
        try {
          came = await Promise.all(wanted);
        } catch {
          if (data === next && box.isConnected) setTimeout(() => data === next && lpn.labMap(next), 1200);
          return;
        }
        if (data !== next) return; // a newer state has come meanwhile
        [plane, flags, codes, picture] = came;
        palette = next.palette; // it belongs to these codes
        sort();
        view = views.get(next.view) || null;
        if (!view) {
          fit(null);
          if (view) views.set(next.view + "fit", view.scale);
        }
        tell(next.selected);
        legend();
        draw();
      },
    };
  };

  const labMap = (next, tries = 60) => {
    data = next;
    root = document.querySelector("#lpn-lab-map .lab-map");
    if (!root || root.dataset.map !== next.map) return tries && setTimeout(() => data === next && lpn.labMap(next, tries - 1), 50);
    if (current?.box !== root) current = LabMap(root);
    current.update(next);
  };
  lpn.labMap = Object.assign(labMap, { pixels: (i) => current.pixels(i) });
})();
