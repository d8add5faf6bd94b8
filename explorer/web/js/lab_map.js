// The laboratory's map of queries: it is moved and zoomed as any map, a drag may draw a lasso, and a click opens a query.
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
  // How much smaller and larger than with all in sight a map may be drawn.
  const FARTHEST = 8, NEAREST = 1e5;
  // Side in pixels of the cells whose queries are one pie on the ground.
  const PIE_CELL = 26;
  // Sides in pixels of a picture that stands for a point and of its room, the zoom from which pictures stand, and the number of
  // selected queries up to which they always stand.
  const PICTURE = 60, ROOM = 70, CLOSE = 2, FEW = 60;
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
  let pictured = true; // pictures stand for points where the map is close enough
  let mode = "move", newest = null, maps = []; // the newest state, and the maps that show it

  // ---- what the server publishes, by address; the newest few
  const fetched = new Map();
  const get = (address, type) => {
    const known = fetched.get(address);
    if (known) return known;
    const coming = fetch(address).then(async (answer) => {
      if (answer.status !== 200) throw new Error(String(answer.status));
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
    const kept = { dx: [], dy: [], rgba: [] };
    for (let i = 0; i < side * side; i++)
      if (pixels[4 * i + 3] > (hard ? 110 : 8)) {
        kept.dx.push((i % side) - (side >> 1));
        kept.dy.push(Math.floor(i / side) - (side >> 1));
        kept.rgba.push(...pixels.slice(4 * i, 4 * i + 3), hard ? 255 : pixels[4 * i + 3]);
      }
    const made = { dx: Int16Array.from(kept.dx), dy: Int16Array.from(kept.dy), rgba: Uint8Array.from(kept.rgba), offsets: null, stride: 0 };
    made.ink = new Uint32Array(made.rgba.buffer);
    marks.set(key, made);
    return made;
  };

  // Which of the maps a box is: that of the second model stands after the first one's.
  const LabMap = (box, number) => {
    let data = null;
    const [ground, points, overlay] = box.querySelectorAll("canvas");
    const counted = box.querySelector(".counted"), position = box.querySelector(".read"), empty = box.querySelector(".empty");
    let plane = null, flags = null, codes = null, palette = [], picture = null, order = null, groups = null, gathered = 0;
    let placed = [], placedAt = 0; // points that have a picture, and the scale at which they were chosen
    let bounds = null, frame = 0, buffer = null, rest = 0, hovered = -1, lasso = null, asked = 0;
    const ratio = () => Math.min(window.devicePixelRatio || 1, 2);
    const x = (i) => plane[2 * i], y = (i) => plane[2 * i + 1];
    const soon = () => (frame ||= requestAnimationFrame(draw));
    const ready = () => data && plane && flags && codes && map.view && box.isConnected;

    // West, south, east, and north of points; of all, tiles and the ground included, without a choice. Nothing if none has a place.
    const extent = (which = null) => {
      let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
      const grow = (px, py) => {
        if (px !== px) return;
        low = [Math.min(low[0], px), Math.min(low[1], py)];
        high = [Math.max(high[0], px), Math.max(high[1], py)];
      };
      const total = data.queries + (which ? 0 : data.tiles);
      for (let i = 0; i < total; i++) if (!which || which(i)) grow(x(i), y(i));
      if (!which && data.ground) data.ground.corners.forEach((corner) => grow(...corner));
      return low[0] > high[0] ? null : [...low, ...high];
    };
    const fit = (borders, share = 0.92) => {
      if (!borders) return;
      map.fit(borders.slice(0, 2), borders.slice(2), share, 1e-3);
      views.set(data.view, map.view);
      soon();
    };
    const fitted = () => views.get(data.view + "fit") || map.view.scale; // pixels per unit with all in sight

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
    // On the ground, selected queries that would cover one another at this zoom are one pie. The cells that gather them do not
    // move with the map, so a pie stays what it is while the map is dragged.
    const grouped = () => {
      const cells = new Map(), alone = new Uint8Array(data.queries).fill(1), side = PIE_CELL / (gathered = map.view ? map.view.scale : 1);
      for (let i = 0; i < data.queries; i++) {
        if (!(flags[i] & SELECTED) || x(i) !== x(i)) continue;
        const key = Math.floor(x(i) / side) + "," + Math.floor(y(i) / side);
        cells.has(key) ? cells.get(key).push(i) : cells.set(key, [i]);
      }
      groups = [...cells.values()].filter((members) => members.length > 1);
      for (const members of groups) for (const i of members) alone[i] = 0;
      return alone;
    };
    // Points whose pictures do not cover one another at this zoom, failures first and tiles last. They are chosen from all, in sight
    // or not, so that a picture stays while the map is dragged.
    const place = () => {
      placedAt = map.view.scale;
      placed = [];
      if (data.ground || !pictured || (map.view.scale < CLOSE * fitted() && data.selected > FEW)) return;
      const cells = new Map(), room = ROOM / map.view.scale;
      const free = (i) => {
        const [column, row] = [Math.floor(x(i) / room), Math.floor(y(i) / room)];
        for (let c = column - 1; c <= column + 1; c++)
          for (let r = row - 1; r <= row + 1; r++) {
            const other = cells.get(c + "," + r);
            if (other !== undefined && Math.abs(x(other) - x(i)) < room && Math.abs(y(other) - y(i)) < room) return false;
          }
        cells.set(column + "," + row, i);
        return true;
      };
      for (const layer of [order[3], order[2], order[0]]) for (const i of layer) if (x(i) === x(i) && free(i)) placed.push(i);
    };
    const inPicture = ([left, top]) =>
      placed.find((i) => {
        const [px, py] = map.toPixels([x(i), y(i)]);
        return Math.max(Math.abs(px - left), Math.abs(py - top)) < PICTURE / 2;
      });
    const thumbnails = lpn.thumbnails(() => soon());
    const drawPictures = (pen) => {
      const [width, height] = map.size();
      const seen = placed.map((i) => ({ i: i, at: map.toPixels([x(i), y(i)]) })).filter(({ at: [left, top] }) => left > -PICTURE && top > -PICTURE && left < width + PICTURE && top < height + PICTURE);
      const images = thumbnails.all(seen.map(({ i }) => (i < data.queries ? data.pictures[0] + i : data.pictures[1] + (i - data.queries))));
      let drawn = 0;
      seen.forEach(({ i, at: [left, top] }, n) => {
        const image = images[n], tile = i >= data.queries;
        if (!image) return;
        const side = PICTURE - 6, cut = Math.min(image.naturalWidth, image.naturalHeight);
        pen.fillStyle = "#0a0a0c";
        pen.fillRect(left - PICTURE / 2, top - PICTURE / 2, PICTURE, PICTURE);
        pen.fillStyle = tile ? TILE : colour(i);
        pen.fillRect(left - PICTURE / 2 + 1, top - PICTURE / 2 + 1, PICTURE - 2, PICTURE - 2);
        pen.drawImage(image, (image.naturalWidth - cut) / 2, (image.naturalHeight - cut) / 2, cut, cut, left - side / 2, top - side / 2, side, side);
        drawn++;
      });
      box.dataset.pictures = String(drawn);
    };
    const colour = (i) => (codes[i] === UNKNOWN ? GREY : palette[codes[i]] || GREY);

    const draw = () => {
      frame = 0;
      if (!ready()) return;
      const begun = performance.now(), k = ratio();
      if (data.ground && gathered !== map.view.scale) sort(); // a zoom gathers other queries
      if (placedAt !== map.view.scale) place();
      const [width, height] = map.size().map((side) => Math.round(side * k));
      if (!width || !height) return;
      for (const canvas of [ground, points, overlay]) if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      drawGround(ground.getContext("2d"), k);
      drawPoints(points.getContext("2d"), width, height, k);
      drawOverlay(k);
      empty.hidden = anyInSight();
      box.dataset.frame = (performance.now() - begun).toFixed(1);
      box.dataset.frames = Number(box.dataset.frames || 0) + 1;
    };
    const drawGround = (pen, k) => {
      pen.setTransform(k, 0, 0, k, 0, 0);
      pen.clearRect(0, 0, ...map.size());
      if (!data.ground || !picture) return;
      const [left, top] = map.toPixels(data.ground.corners[0]), [right, bottom] = map.toPixels(data.ground.corners[1]);
      pen.imageSmoothingQuality = "high";
      pen.drawImage(picture, left, top, right - left, bottom - top);
      pen.fillStyle = "rgba(0,0,0,.3)"; // points stand out
      pen.fillRect(left, top, right - left, bottom - top);
    };
    const drawPoints = (pen, width, height, k) => {
      const pad = 16, stride = width + 2 * pad, lines = height + 2 * pad;
      if (!buffer || buffer.width !== stride || buffer.height !== lines) buffer = new ImageData(stride, lines);
      const bytes = buffer.data, words = new Uint32Array(bytes.buffer);
      words.fill(0);
      const count = order[2].length + order[3].length;
      const near = Math.sqrt(Math.max(map.view.scale / fitted(), 1));
      const radius = clamp((count <= 400 ? 4.6 : count <= 3000 ? 3.6 : count <= MANY ? 2.6 : 1.7) * Math.min(near, 2), 1.5, 6) * k;
      const quiet = Math.max(radius * 0.6, 1.2 * k);
      const { view } = map;
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
      const middle = (axis) => members.reduce((sum, i) => sum + axis(i), 0) / members.length;
      const [left, top] = map.toPixels([middle(x), middle(y)]);
      const [width, height] = map.size();
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
      pen.clearRect(0, 0, ...map.size());
      const line = (from, to, ink, width) => {
        if (plane[2 * to] !== plane[2 * to] || x(from) !== x(from)) return;
        pen.beginPath();
        pen.moveTo(...map.toPixels([x(from), y(from)]));
        pen.lineTo(...map.toPixels([x(to), y(to)]));
        lpn.pens.stroke(pen, ink, width);
      };
      const wrong = lpn.colour("wrong"), right = lpn.colour("right");
      for (const [query, tile] of data.lines) line(query, data.queries + tile, wrong, 1);
      for (const members of groups || []) drawPie(pen, members);
      drawPictures(pen);
      if (data.query && x(data.query[0]) === x(data.query[0])) {
        const [query, answer = -1, positive = -1] = data.query; // a doubtful judge marks no tile
        const tiles = [];
        if (!number && answer >= 0 && answer !== positive) tiles.push([answer, wrong]);
        if (positive >= 0 && !data.ground) tiles.push([positive, right]);
        for (const [tile, ink] of tiles) {
          line(query, data.queries + tile, ink, 1.5);
          const [left, top] = map.toPixels([x(data.queries + tile), y(data.queries + tile)]);
          pen.fillStyle = "#0a0a0c";
          pen.fillRect(left - 5.5, top - 5.5, 11, 11);
          pen.fillStyle = ink;
          pen.fillRect(left - 4.5, top - 4.5, 9, 9);
        }
        ring(pen, query, placed.includes(query) ? PICTURE * 0.72 : data.ground ? 13 : 9, "#fff", 2.5);
      }
      for (let i = 0; data.chosen && data.chosen < MANY && i < data.queries; i++) if (flags[i] & CHOSEN && x(i) === x(i)) ring(pen, i, data.ground ? 12 : 7, lpn.colour("accent"), 2);
      if (hovered >= 0) ring(pen, hovered, placed.includes(hovered) ? PICTURE * 0.72 : data.ground ? 13 : 8, "#fff", 2);
      if (lasso && lasso.length > 1) {
        pen.beginPath();
        (enclosed(lasso) || lasso).forEach((at, i) => pen[i ? "lineTo" : "moveTo"](...at));
        pen.closePath();
        pen.fillStyle = "rgba(255,255,255,.14)";
        pen.fill("evenodd");
        lpn.pens.stroke(pen, "#fff", 1.5, [5, 4]);
      }
      if (!data.ground) return;
      const [width, height] = map.size();
      box.dataset.metres = lpn.mapMarks.bar(pen, [12, height - 12], map.view.scale / data.ground.metres, width);
      lpn.mapMarks.north(pen, [22, 58]);
    };
    const ring = (pen, i, radius, ink, width) => {
      pen.beginPath();
      pen.arc(...map.toPixels([x(i), y(i)]), radius, 0, 7);
      lpn.pens.stroke(pen, ink, width);
    };

    // The queries of the pie that a query is in, if they were taken at several places.
    const apart = (query) => groups?.find((members) => members.includes(query) && members.some((i) => x(i) !== x(query) || y(i) !== y(query)));

    // The query nearest to a place; selected ones go before others.
    /** @param {Point} at */
    const near = ([left, top]) => {
      const picture = inPicture([left, top]);
      if (picture !== undefined) return picture < data.queries ? picture : -1;
      const best = [[REACH, -1], [REACH, -1]];
      for (let i = 0; i < data.queries; i++) {
        const [px, py] = map.toPixels([x(i), y(i)]);
        const far = Math.hypot(px - left, py - top), which = flags[i] & SELECTED ? 0 : 1;
        if (far < best[which][0]) best[which] = [far, i];
      }
      return best[0][1] >= 0 ? best[0][1] : best[1][1];
    };
    const inLasso = (corners) => {
      let low = [Infinity, Infinity], high = [-Infinity, -Infinity], inside = 0;
      for (const [px, py] of corners) low = [Math.min(low[0], px), Math.min(low[1], py)], high = [Math.max(high[0], px), Math.max(high[1], py)];
      for (let i = 0; i < data.queries; i++) {
        const [px, py] = [x(i), y(i)];
        if (!(flags[i] & SELECTED) || !(px >= low[0] && px <= high[0] && py >= low[1] && py <= high[1])) continue;
        let odd = false; // borders crossed
        for (let n = 0, m = corners.length - 1; n < corners.length; m = n++) {
          const [x0, y0] = corners[n], [x1, y1] = corners[m];
          if (y0 > py !== y1 > py && px < x0 + ((py - y0) / (y1 - y0)) * (x1 - x0)) odd = !odd;
        }
        if (odd) inside++;
      }
      return inside;
    };
    // On the ground: the latitude and longitude of a place in pixels, or metres where the place is rendered; without one, nothing.
    const located = (place) => {
      const { degrees, middle, metres } = data.ground;
      if (!degrees) return lpn.mapMarks.metres(place.map((value, axis) => middle[axis] + value * metres));
      return lpn.mapMarks.degrees([1, 0].map((axis, i) => degrees[i][0] + place[axis] * degrees[i][1]));
    };
    const read = (at) => (position.textContent = at && data.ground ? located(map.toPlane(at)) : "");
    const tell = (count) => (counted.textContent = count.toLocaleString("en") + " of " + data.queries.toLocaleString("en"));

    // ---- pointer and keys
    const hideTips = () => document.querySelectorAll(".lab-tip").forEach((tip) => (tip.style.display = "none"));
    const pointed = (at, event, pressed = false) => {
      read(at);
      clearTimeout(rest);
      hideTips();
      if (pressed) return;
      const query = near(at);
      if (query !== hovered) maps.forEach((one) => one.hover(query));
      const several = query >= 0 && apart(query);
      overlay.style.cursor = several ? "zoom-in" : query >= 0 ? "pointer" : mode === "lasso" || event.shiftKey ? "crosshair" : "grab";
      if (query < 0 || several) return;
      lpn.mouse = [event.clientX, event.clientY];
      rest = setTimeout(() => lpn.send("lab-tip", [data.map, query]), REST);
    };
    const tapped = (at, { ctrlKey, metaKey }) => {
      const query = near(at), several = query >= 0 && !ctrlKey && !metaKey && apart(query);
      if (several) fit(extent((i) => several.includes(i)), 0.6);
      else if (query >= 0) ctrlKey || metaKey ? lpn.send("lab-rows", [query, query, "toggle"]) : lpn.send("lab-point", [data.map, query]);
      return query >= 0;
    };
    // A drag in the lasso's mode, or with Shift held in the other, draws.
    const endLasso = () => {
      lasso = null;
      tell(data.selected);
      soon();
    };
    const pen = {
      down: (at, event) => {
        lasso = (mode === "lasso") !== event.shiftKey && event.button === 0 ? [at] : null;
        return lasso !== null;
      },
      move: (at) => {
        if (!lasso) return; // Escape has ended it
        const [left, top] = lasso[lasso.length - 1];
        if (Math.hypot(at[0] - left, at[1] - top) > APART) lasso.push(at);
        asked ||= requestAnimationFrame(() => {
          asked = 0;
          if (!lasso) return; // it was sent meanwhile
          const corners = enclosed(lasso);
          tell(corners ? inLasso(corners.map(map.toPlane)) : data.selected);
        });
        soon();
      },
      up: () => {
        const corners = lasso && enclosed(lasso);
        endLasso();
        if (corners) sendLasso(corners);
      },
      cancel: endLasso,
    };
    const sendLasso = (pixels) => {
      const step = Math.ceil(pixels.length / CORNERS);
      const places = pixels.filter((_, i) => i % step === 0).map(map.toPlane);
      lpn.send("lab-lasso", [data.map, places.map((place) => place.map((value) => +value.toFixed(6))), number > 0]);
      data.lasso = true; // Escape may come before the answer
    };
    // The corners of the map in pixels, and the number of selected queries between them.
    const corners = () => {
      const [right, down] = map.size();
      return [[0, 0], [right, 0], [right, down], [0, down]];
    };
    const anyInSight = () => {
      const [[west, north], , [east, south]] = corners().map(map.toPlane);
      for (let i = 0; 2 * i < plane.length; i++) if (x(i) >= west && x(i) <= east && y(i) >= south && y(i) <= north) return true;
      return false;
    };
    const inSight = () => inLasso(corners().map(map.toPlane));
    // A map that nobody moved fits its room, also in a room of another size.
    const home = () => {
      fit(extent());
      if (map.view) views.set(data.view + "home", { ...map.view });
    };
    const unmoved = () => {
      const kept = views.get(data.view + "home");
      return kept && ["x", "y", "scale"].every((key) => kept[key] === map.view[key]);
    };
    /** @returns {[number, number]} */
    const limits = () => {
      const all = views.get(data.view + "fit");
      return all ? [all / FARTHEST, all * NEAREST] : [0, Infinity];
    };
    const map = lpn.panZoom(overlay, { limits, bounds: () => bounds, ready, changed: soon, home, pointed, tapped, pen });
    overlay.addEventListener("pointerleave", (event) => {
      if (event.pointerType === "mouse") read(null); // what a finger has pointed at stays
      clearTimeout(rest);
      hideTips();
      if (hovered >= 0) maps.forEach((one) => one.hover(-1));
    });
    const acts = {
      move: () => (mode = "move"),
      lasso: () => (mode = "lasso"),
      in: map.stepIn,
      out: map.stepOut,
      all: home,
      chosen: () => fit(extent((i) => flags[i] & SELECTED), 0.8),
      pictures: () => {
        pictured = !pictured;
        maps.forEach((one) => one.anew());
      },
    };
    const pressed = () => {
      box.querySelector(".hint").hidden = mode !== "lasso";
      box.querySelectorAll("button").forEach((one) => ["move", "lasso"].includes(one.dataset.act) && one.setAttribute("aria-pressed", one.dataset.act === mode));
      box.querySelector("[data-act=pictures]")?.setAttribute("aria-pressed", pictured);
    };
    box.querySelectorAll("button").forEach((one) => one.addEventListener("click", () => (ready() && acts[one.dataset.act](), maps.forEach((other) => other.pressed()))));
    overlay.addEventListener("keydown", (event) => {
      if (!ready() || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key.startsWith("Arrow")) {
        const before = { ...map.view }, seen = inSight();
        map.key(event);
        if (seen && !inSight()) Object.assign(map.view, before), lpn.say("No point lies further that way.", 2);
      } else if (event.key === "Enter") inSight() ? sendLasso(corners()) : lpn.say("No query is in sight.", 2);
      else if (event.key === "Escape" && lasso) endLasso();
      else if (event.key === "Escape" && data.lasso) lpn.send("lab-unpick", "in " + data.map);
      else if (!map.key(event)) return;
      read(null);
      event.preventDefault();
      event.stopPropagation();
    });
    new ResizeObserver(soon).observe(box);
    pressed();

    const legend = () => {
      const key = document.querySelector("#lpn-lab-mapped .lab-key");
      if (!key || number) return;
      const { labels, counts, ends } = data.legend;
      const entry = (ink, words, sign = "●") => {
        const one = document.createElement("span"), dot = one.appendChild(document.createElement("b"));
        dot.textContent = sign;
        dot.style.color = ink;
        one.append(" " + words);
        return one;
      };
      const crosses = order[3].length > 0; // of queries that share their place there are none
      const entries = labels.map((label, code) => entry(data.palette[code], label + ": " + counts[code].toLocaleString("en"), data.colour || code !== 1 || !crosses ? "●" : "✕"));
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
      if (groups?.length) entries.push(entry("currentColor", `a pie: ${data.words[1]} that lie close together`, "◕"));
      if (!data.ground) entries.push(entry(TILE, "tiles", "■"));
      if (data.axes) entries.push(data.axes);
      if (data.query) entries.push("ringed: the " + data.words[0]);
      key.replaceChildren(...entries.map((one) => (typeof one === "string" ? Object.assign(document.createElement("span"), { textContent: one }) : one)));
    };

    return {
      box: box,
      pixels: (i) => map.toPixels([x(i), y(i)]),
      hover: (query) => {
        if (query !== hovered) (hovered = query), soon();
      },
      anew: () => ((placedAt = 0), soon()),
      pressed: pressed,
      update: async (state) => {
        const next = { ...state, ...state.maps[number] };
        const stale = () => newest !== state || !box.isConnected;
        const select = /** @type {HTMLSelectElement} */ (document.getElementById("lpn-lab-colour"));
        if (select && select.value !== next.colour) select.value = next.colour;
        const address = next.address;
        const wanted = [get(address + next.plane + "0", Float32Array), get(address + next.flags + "0", Uint8Array), get(address + next.codes + "0", Uint8Array)];
        if (next.ground) wanted.push(get(address + next.ground.picture + "0", "picture"));
        let came;
        try {
          came = await Promise.all(wanted);
        } catch {
          if (!stale()) setTimeout(() => newest === state && lpn.labMap(state), 1200);
          return;
        }
        if (stale()) return; // a newer state has come meanwhile
        data = next;
        [plane, flags, codes, picture] = came;
        palette = next.palette; // it belongs to these codes
        bounds = extent() || [0, 0, 0, 0];
        map.view = views.get(next.view) || null;
        if (!map.view || unmoved()) {
          home();
          if (map.view) views.set(next.view + "fit", map.view.scale);
        }
        sort();
        placedAt = 0; // others may be selected
        tell(next.selected);
        legend();
        draw();
      },
    };
  };

  const labMap = (next, tries = 60) => {
    newest = next;
    const boxes = [...document.querySelectorAll("#lpn-lab-map .lab-map")];
    if (boxes.length !== next.maps.length || boxes[0].dataset.map !== next.map) return tries && setTimeout(() => newest === next && lpn.labMap(next, tries - 1), 50);
    if (boxes.some((box, number) => maps[number]?.box !== box) || maps.length > boxes.length) maps = boxes.map(LabMap);
    maps.forEach((one) => one.update(next));
  };
  lpn.labMap = Object.assign(labMap, { pixels: (i, number = 0) => maps[number].pixels(i) });
})();
