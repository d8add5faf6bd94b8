// The map of the flight window: tiles, scores, tracks, and the chosen frame's outline, on two canvases.
(() => {
  const lpn = window.lpn;
  const { flight } = lpn;
  if (flight.map) return;
  // Pixels within which the mouse points at a frame, and metres around the map within which a frame counts as near.
  const REACH = 12, AROUND = 500;
  const { canvas, stroke, dot, diamond, text } = lpn.pens;
  const { find } = flight;
  const tiles = lpn.tiles(flight.draw);
  const overlay = { picture: null, source: "" };
  let box = null; // the map's element
  let map = null; // its `PanZoom`
  let offered = -1; // the frame of the answer whose reason is told
  let linked = null; // the middle and the metres from side to side that a link tells, until the map is moved
  let moved = false; // the user has moved the map since it was fitted
  let seen = ""; // the frame of a flight that goes on which was last looked for

  const place = (track, i) => (track.x[i] === null || track.y[i] === null ? null : [track.x[i], track.y[i]]);
  const degrees = ([x, y]) => {
    const [west, south, east, north] = flight.data.bounds;
    const u = (2 * x - west - east) / (east - west), v = (2 * y - south - north) / (north - south);
    const terms = [1, u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
    return flight.data.degrees.map((row) => row.reduce((sum, value, i) => sum + value * terms[i], 0));
  };
  const around = () => flight.data.bounds.map((border, i) => border + (i < 2 ? -AROUND : AROUND));

  const near = () => {
    const [west, south, east, north] = around();
    const track = Object.entries(flight.data.tracks).flatMap(([name, one]) =>
      name === "retrieval" ? [] : flight.data.names.map((_, i) => (one.state[i] < 2 ? place(one, i) : null)).filter(Boolean),
    );
    return track.filter(([x, y]) => x > west && x < east && y > south && y < north);
  };
  // The places of an own picture that lie on the map or near it.
  const ofOwn = (own) => {
    const [west, south, east, north] = around();
    const all = [...(own.outline || []).slice(0, 4), own.place, own.tag].filter(Boolean);
    return all.filter(([x, y]) => x > west && x < east && y > south && y < north);
  };
  // The map and the frames near it: the view is moved within them.
  const bounds = () => {
    const [west, south, east, north] = flight.data.bounds, all = [[west, south], [east, north], ...near()];
    const [across, up] = [0, 1].map((axis) => flight.range(all.map((at) => at[axis])));
    return [across[0], up[0], across[1], up[1]];
  };

  // The corners of the newest photo of a flight that goes on.
  const newest = () => (flight.goesOn && flight.data.outlines[flight.chosen]?.slice(0, 4)) || [];
  // Show the flight, or the whole map if nothing of it lies there, and at least 40 m of ground.
  const fit = () => {
    moved = false;
    linked = null;
    if (!box?.clientWidth) return;
    const own = flight.own(), inside = own ? ofOwn(own) : [...near(), ...newest()], whole = flight.data.bounds;
    const [across, up] = inside.length > 1 ? [0, 1].map((axis) => flight.range(inside.map((at) => at[axis]))) : [0, 1].map((axis) => [whole[axis], whole[axis + 2]]);
    map.fit([across[0], up[0]], [across[1], up[1]], inside.length > 1 ? 0.72 : 0.9, 40);
    flight.draw();
  };

  // Fit a flight that goes on again when its newest photo is out of sight, unless the user has looked elsewhere.
  const keep = () => {
    const frame = `${flight.total()} ${flight.chosen}`, [width, height] = map.size();
    if (moved || !flight.goesOn || frame === seen) return;
    seen = frame;
    if (newest().map(map.toPixels).some(([left, top]) => left < 0 || left > width || top < 0 || top > height)) fit();
  };

  // ---- drawing
  const path = (pen, points, close = false) => {
    pen.beginPath();
    points.forEach((point, i) => pen[i ? "lineTo" : "moveTo"](...map.toPixels(point)));
    if (close) pen.closePath();
  };
  const drawTracks = (pen) => {
    for (const [name, track] of flight.tracks()) {
      // A line joins neighbours that were not refused; nothing has verified the retrieval, so it has no line.
      if (name !== "retrieval") {
        pen.beginPath();
        let down = false;
        for (let i = 0; i < flight.total(); i++) {
          const at = place(track, i);
          if (track.state[i] === 2) continue;
          if (!at) {
            down = false;
            continue;
          }
          pen[down ? "lineTo" : "moveTo"](...map.toPixels(at));
          down = true;
        }
        // The tags are there to be compared with, and keep behind the answers.
        pen.globalAlpha = name === "tag" ? 0.75 : 1;
        stroke(pen, track.colour, name === "tag" ? 1 : 2, name === "tag" ? [5, 4] : []);
        pen.globalAlpha = 1;
      }
      for (let i = 0; i < flight.total(); i++) {
        const at = place(track, i);
        const refused = track.state[i] === 2;
        if (!at) continue;
        if (flight.doubted(name, i)) diamond(pen, map.toPixels(at), 6, lpn.colour("contradicted"));
        else dot(pen, map.toPixels(at), name === "tag" ? 2 : 4, (refused && flight.data.refused) || track.colour, refused);
      }
    }
  };
  const drawSpot = (pen) => {
    for (const i of flight.spotted.frames) {
      path(pen, flight.data.outlines[i].slice(0, 4), true);
      pen.fillStyle = "rgba(255,255,255,.05)";
      pen.fill();
      pen.lineWidth = 1;
      pen.strokeStyle = "rgba(255,255,255,.6)";
      pen.stroke();
    }
    const [left, top] = map.toPixels(flight.spotted.spot);
    pen.beginPath();
    for (const [right, down] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(left + 4 * right, top + 4 * down);
      pen.lineTo(left + 13 * right, top + 13 * down);
    }
    stroke(pen, "#fff", 2);
  };
  // The place of an own picture with its radius, its GPS tag, and the line between them.
  const drawOwn = (pen, { place: at, radius, tag, doubted }) => {
    if (at && tag) {
      path(pen, [at, tag]);
      stroke(pen, lpn.colour("tag"), 1.5, [5, 4]);
    }
    if (at) {
      pen.beginPath();
      pen.arc(...map.toPixels(at), Math.max(radius * map.view.scale, 1), 0, 7);
      stroke(pen, lpn.colour(doubted ? "contradicted" : "registration"), 1.5);
      if (doubted) diamond(pen, map.toPixels(at), 9, lpn.colour("contradicted"));
      else dot(pen, map.toPixels(at), 7, lpn.colour("registration"), false);
    }
    if (tag) dot(pen, map.toPixels(tag), 5, lpn.colour("tag"), false);
  };
  const drawChosen = (pen) => {
    const { data, chosen, answered, followed } = flight, own = flight.own();
    const outline = own ? own.outline : data.outlines[chosen];
    if (outline) {
      const colour = lpn.colour(own ? own.state : data.states[chosen]);
      path(pen, outline.slice(0, 4), true);
      stroke(pen, colour, 2, outline[4] ? [] : [7, 5]);
      // The picture's top edge is thicker.
      path(pen, outline.slice(0, 2));
      stroke(pen, colour, 4);
    }
    if (answered && followed && followed.frame === chosen && (!own || own.place) && !flight.hidden.has("retrieval")) {
      const [x, y, side] = answered;
      const half = side / 2;
      path(pen, [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]], true);
      stroke(pen, lpn.colour("retrieval"), 1.5, [2, 3]);
    }
    // From where the photo has a place to where the map has it.
    const pins = followed?.frame === chosen && (!data.plain || flight.photo.compares()) ? followed.pins : [];
    for (const [i, [x, y, east, north]] of pins.entries()) {
      path(pen, [[x, y], [x + east, y + north]]);
      stroke(pen, lpn.colour("accent"), 2);
      const [left, top] = map.toPixels([x + east, y + north]);
      dot(pen, [left, top], 3, lpn.colour("accent"), false);
      text(pen, String(i + 1), left + 6, top - 6);
    }
    if (own) drawOwn(pen, own);
    // The answer that counts is there, too, where its track is switched off.
    const counts = data.stages[chosen], shown = flight.tracks();
    if (counts && flight.hidden.has(counts)) shown.push([counts, data.tracks[counts]]);
    for (const [name, track] of shown) {
      const at = place(track, chosen);
      if (!at) continue;
      const [left, top] = map.toPixels(at);
      if (track.radius[chosen]) {
        pen.beginPath();
        pen.arc(left, top, Math.max(track.radius[chosen] * map.view.scale, 1), 0, 7);
        stroke(pen, flight.doubted(name, chosen) ? lpn.colour("contradicted") : track.colour, 1.5, track.state[chosen] === 2 ? [3, 4] : []);
      }
      if (flight.doubted(name, chosen)) diamond(pen, [left, top], 9, lpn.colour("contradicted"));
      else dot(pen, [left, top], name === "tag" ? 5 : 7, track.colour, track.state[chosen] === 2);
    }
  };
  const drawFrame = (pen) => {
    const [width, height] = map.size();
    for (const sheet of flight.data.sheets) {
      path(pen, sheet.outline, true);
      stroke(pen, sheet.colour, 2);
      const corner = sheet.outline.reduce((best, p) => (p[1] - p[0] > best[1] - best[0] ? p : best));
      const [left, top] = map.toPixels(corner);
      text(pen, sheet.name, lpn.clamp(left + 8, 8, width - 60), lpn.clamp(top + 14, 14, height - 40));
    }
    box.dataset.metres = String(lpn.mapMarks.bar(pen, [12, height - 38], map.view.scale, width));
    lpn.mapMarks.north(pen, [width - 20, 30]);
  };
  const drawScores = (pen) => {
    const [west, south, east, north] = flight.painted.bounds;
    const [left, top] = map.toPixels([west, north]), [right, bottom] = map.toPixels([east, south]);
    pen.globalAlpha = 0.6;
    pen.imageSmoothingEnabled = false;
    pen.drawImage(overlay.picture, left, top, right - left, bottom - top);
    pen.globalAlpha = 1;
  };
  // Return whether there is a map to draw.
  const draw = () => {
    if (!box?.clientWidth) return false;
    if (!map.view) fit();
    keep();
    const [ground, ratio] = canvas(find(".ground"));
    ground.imageSmoothingEnabled = true;
    const missing = tiles.draw(ground, ratio, flight.data, map);
    box.dataset.missing = String(missing);
    box.classList.toggle("loads", missing > 0);
    const words = missing ? "The map is loading …" : "";
    if (find(".loading").textContent !== words) find(".loading").textContent = words;
    if (flight.painted && overlay.picture) drawScores(ground);
    const [pen] = canvas(find(".over"));
    if (!flight.photo.compares()) drawTracks(pen);
    if (flight.spotted) drawSpot(pen);
    if (flight.chosen >= 0 || flight.own()) drawChosen(pen);
    drawFrame(pen);
    return true;
  };

  // ---- the pointer
  // Return the frame of the nearest dot, and its track; -1 where none is near.
  const hit = (at) => {
    /** @type {[number, number, any]} */
    let best = [REACH, -1, null];
    for (const [, track] of flight.tracks())
      for (let i = 0; i < flight.total(); i++) {
        const point = place(track, i);
        if (!point) continue;
        const [left, top] = map.toPixels(point);
        const far = Math.hypot(left - at[0], top - at[1]);
        if (far < best[0]) best = [far, i, track];
      }
    return { frame: best[1], track: best[2] };
  };
  // Say beside an answer's mark why it is refused or contradicted.
  const explain = ({ frame, track }, offers = false) => {
    const reason = track?.reason?.[frame];
    if (!reason) return void (find(".why").textContent = "");
    offered = frame;
    const more = offers ? ' <a data-act="turnto" role="button" tabindex="0">Show this photo</a>' : "";
    // The buttons on the right stay free.
    flight.tell(find(".why"), flight.data.names[frame] + ". " + reason, map.toPixels(place(track, frame)), find(".zoom").offsetLeft - 6, REACH, { more });
  };
  const read = (at) => {
    const [x, y] = map.toPlane(at), pointed = hit(at), { frame } = pointed;
    explain(pointed);
    find(".read").textContent =
      (frame >= 0 ? flight.data.names[frame] + " · " : "") + (flight.data.degrees ? lpn.mapMarks.degrees(degrees([x, y])) + " · " : "") + x.toFixed(1) + " m E, " + y.toFixed(1) + " m N";
  };
  const tapped = (at, { shiftKey, pointerType }) => {
    if (shiftKey || flight.asking) {
      flight.asking = false;
      lpn.send("flight-spot", map.toPlane(at).map((value) => Math.round(100 * value) / 100));
      return true;
    }
    const pointed = hit(at);
    // A finger cannot point, so that its tap on a refused answer tells the reason, and does not leave the photo.
    const asks = pointerType === "touch" && pointed.track?.state[pointed.frame] === 2 && pointed.frame !== flight.chosen;
    explain(pointed, asks);
    if (!asks) flight.choose(pointed.frame);
    return pointed.frame >= 0;
  };

  flight.pixels = (at) => map.toPixels(at);
  flight.map = {
    draw,
    fit,
    stepIn: () => map.stepIn(),
    stepOut: () => map.stepOut(),
    key: (event) => map.key(event),
    view: () => map.view,
    size: () => map.size(),
    toPixels: (at) => map.toPixels(at),
    // Look anew at what is shown, wherever the person has looked before.
    look: () => {
      if (map) map.view = null;
    },
    // Show the photo whose refused answer is explained.
    turnTo: () => {
      find(".why").textContent = "";
      flight.choose(offered);
    },
    // Look at a place, and at some metres from side to side, also while the window still changes its size.
    show: (middle, across) => {
      const [west, south, east, north] = bounds(), x = lpn.clamp(middle[0], west, east), y = lpn.clamp(middle[1], south, north);
      map.fit([x - across / 2, y], [x + across / 2, y], 1, Number.EPSILON);
      linked = [middle, across];
      moved = true;
      flight.draw();
    },
    // Look at some points, unless all of them are in sight.
    include: (points) => {
      const [width, height] = map.size();
      if (points.map(map.toPixels).every(([left, top]) => left > 0 && left < width && top > 0 && top < height)) return;
      const [across, up] = [0, 1].map((axis) => flight.range(points.map((at) => at[axis])));
      map.fit([across[0], up[0]], [across[1], up[1]], 0.8, 10);
      moved = true;
      linked = null;
      flight.draw();
    },
    // Look at some points, unless they are in sight and fill nearly half of it.
    approach: (points) => {
      const [across, up] = [0, 1].map((axis) => flight.range(points.map((at) => at[axis]))), [width, height] = map.size();
      const large = Math.max((across[1] - across[0]) / width, (up[1] - up[0]) / height) * map.view.scale;
      const seen = points.map(map.toPixels).every(([left, top]) => left > -0.2 * width && left < 1.2 * width && top > -0.2 * height && top < 1.2 * height);
      if (seen && large > 0.45) return;
      map.fit([across[0], up[0]], [across[1], up[1]], 0.85, 10);
      moved = true;
      linked = null;
      flight.draw();
    },
    // Another flight or map has taken the place of the one before, which may be null.
    replaced: (before) => {
      if (before && before.address !== flight.data.address) tiles.clear();
      if (map && String(before?.bounds) !== String(flight.data.bounds)) map.view = null;
    },
    // The flight is fitted into the window again when that changes its size, unless the user has looked elsewhere.
    resized: () => {
      if (linked) flight.map.show(...linked);
      else if (!moved) map.view = null;
    },
    // Show another picture of scores.
    paint: (source) => {
      if (overlay.source === source) return;
      overlay.source = source;
      const picture = new Image();
      picture.onload = () => ((overlay.picture = picture), flight.draw());
      picture.src = source;
    },
    attach: () => {
      const view = map?.view; // the window was drawn anew
      box = find(".view");
      map = lpn.panZoom(box, {
        limits: () => [20 / flight.data.pyramid.side, 8 / flight.data.resolution],
        bounds,
        ready: () => !!(flight.data && map.view),
        changed: () => {
          moved = true;
          linked = null;
          flight.draw();
        },
        home: fit,
        pointed: read,
        tapped,
        ignores: ".swipe, .zoom, .why a, .ties *",
      });
      map.view = view;
      box.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && (find(".read").textContent = find(".why").textContent = ""));
      // A finger that is lifted points at nothing more; why an answer is refused stays to be read.
      for (const kind of ["pointerup", "pointercancel"]) box.addEventListener(kind, (event) => event.pointerType !== "mouse" && (find(".read").textContent = ""));
    },
  };
})();
