// The timeline of a flight: a value of each frame over time, and a mark that says what may be believed of it.
(() => {
  const lpn = window.lpn;
  const { flight } = lpn;
  if (flight.timeline) return;
  const TURNS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 10, PageDown: -10 };
  const EMPTY = { error: "No frame has a tag to compare with.", radius: "No stage tells a radius." };
  const LABELS = { error: ["Off tag", "Metres from GPS"], radius: ["Radius", "May be off"], height: ["Height", "Height"] };
  // How tall the marks of verdicts are, in pixels: to believe, to doubt, without a position.
  const SIGNS = { true: 9, null: 5, false: 2 };
  // Where a frame lies between the left and the right border, in pixels.
  const across = (i, width, data) => {
    const { times, low, high } = data.span;
    return 44 + ((width - 56) * (times[i] - low)) / (high - low || 1);
  };
  const nearest = (left) => {
    const far = (i) => Math.abs(across(i, element.clientWidth, flight.data) - left);
    return flight.data.names.reduce((best, _, i) => (far(i) < far(best) ? i : best), 0);
  };
  // Values at which the scale has lines, from 0 to the largest: the ones that have room for their numbers.
  const ticks = (top, level) => {
    const chosen = [top, 0], apart = (value) => chosen.every((other) => Math.abs(level(value) - level(other)) >= 15);
    for (let power = 10 ** Math.floor(Math.log10(top)); power >= 0.1; power /= 10)
      for (const value of [5 * power, 2 * power, power]) if (value < top && apart(value)) chosen.push(value);
    return chosen;
  };
  // Pixels within which the pointer is at a mark, and the marks that are drawn: left, top, frame, and why it is doubted or refused, or "".
  const REACH = 10;
  let marks = [];
  let held = null; // the frame and the plot whose reason a tap has brought
  const reasonOf = (name, i) => flight.data.tracks[name]?.reason?.[i];
  const hush = () => {
    held = null;
    flight.find(".time .why").textContent = "";
  };
  // Say why the nearest of some marks is contradicted or refused, if a place is as near as `reach` pixels; above the controls, which
  // stay free. On a phone the style sheet puts it below the timeline.
  const explain = ([left, top], chosen, reach) => {
    const far = (mark) => Math.hypot(mark[0] - left, mark[1] - top);
    const mark = chosen.reduce((best, one) => (far(one) < far(best) ? one : best), [0, -1000, 0, ""]);
    const reason = far(mark) < reach ? mark[3] : "";
    const at = [mark[0], -flight.find(".controls").offsetHeight];
    flight.tell(flight.find(".time .why"), reason && flight.data.names[mark[2]] + ". " + reason, at, element.clientWidth, 4, { above: true });
  };
  // Draw lines, each with values, states (2: refused), and a colour, between two heights of the canvas.
  const band = (pen, data, { plot, lines }, colour, width, head, foot) => {
    const values = lines.flatMap((one) => one.values.filter((value) => value !== null)).sort((a, b) => a - b);
    const top = values[values.length - 1] || 1;
    const low = plot === "height" && values.length ? Math.max(values[0] - 0.3 * (top - values[0]) - 1, 0) : 0;
    // One wrong guess far away must not flatten the others: errors are drawn by their square roots.
    const scaled = (value) => (plot === "height" ? value : Math.sqrt(value));
    const level = (value) => foot - ((foot - head) * (scaled(value) - scaled(low))) / (scaled(top) - scaled(low) || 1);
    pen.strokeStyle = pen.fillStyle = colour;
    pen.globalAlpha = 0.25;
    pen.lineWidth = 1;
    pen.strokeRect(44, head - 0.5, width - 56, foot - head + 0.5);
    pen.globalAlpha = 0.85;
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const value of plot === "height" ? [top, low] : ticks(top, level)) {
      const at = level(value), unit = value === top ? " m" : "";
      pen.fillText(value.toFixed(value && value < 10 ? 1 : 0) + unit, 40, lpn.clamp(at, head + 5, foot - 4));
      pen.globalAlpha = 0.25;
      pen.fillRect(44, at, width - 56, 1);
      pen.globalAlpha = 0.85;
    }
    pen.textAlign = "center";
    pen.globalAlpha = 1;
    if (!values.length) pen.fillText((plot === "error" && data.elsewhere && data.elsewhere + ", so they were left out.") || EMPTY[plot], width / 2, (head + foot) / 2);
    for (const { name, values: known, state, colour: ink, line } of lines) {
      pen.strokeStyle = pen.fillStyle = ink;
      pen.beginPath();
      known.forEach((value, i) => {
        if (line && value !== null) pen[i && known[i - 1] !== null ? "lineTo" : "moveTo"](across(i, width, data), level(value));
      });
      pen.lineWidth = 1.5;
      pen.stroke();
      known.forEach((value, i) => {
        if (value === null) return;
        const at = [across(i, width, data), level(value)], small = data.names.length > 300;
        marks.push([...at, i, reasonOf(name, i) || ""]);
        if (flight.doubted(name, i)) return lpn.pens.diamond(pen, at, small ? 3 : 5, lpn.colour("contradicted"));
        pen.fillStyle = pen.strokeStyle = ink;
        pen.beginPath();
        pen.arc(at[0], at[1], small ? 1.5 : 2.5, 0, 7);
        pen.lineWidth = 1;
        state[i] === 2 ? pen.stroke() : pen.fill();
      });
    }
  };
  const series = (plot) =>
    plot === "height"
      ? [{ name: "", colour: flight.ink(), values: flight.data.heights, state: flight.data.heights.map(() => 0), line: true }]
      : flight
          .tracks()
          .filter(([name]) => name !== "tag" && (plot === "error" || !["retrieval", "corrected"].includes(name)))
          .map(([name, track]) => ({ name, colour: track.colour, values: track[plot], state: track.state }));
  // Return whether the panel beside the window shows another photo still; the line is written again until it does not.
  const panelFollows = () => {
    const shown = document.getElementById("lpn-status")?.dataset.query;
    const follows = shown !== undefined && flight.chosen >= 0 && Number(shown) !== flight.chosen;
    if (follows) setTimeout(flight.draw, 300);
    return follows;
  };
  // Say what the timeline shows, also to screen readers.
  const say = () => {
    const { data, chosen } = flight;
    element.setAttribute("aria-valuemax", flight.total());
    element.setAttribute("aria-valuenow", chosen + 1);
    element.setAttribute("aria-valuetext", chosen < 0 ? "no frame" : data.names[chosen]);
    const since = data.times && chosen >= 0 ? data.times[chosen] - data.times[0] : null;
    const clock = since === null ? "" : ", " + Math.floor(since / 60) + ":" + String(Math.floor(since % 60)).padStart(2, "0");
    const { on, skipped, slow, late } = flight.play;
    const pace = skipped ? ", " + skipped + " skipped" : on && slow ? ", every frame, slower than asked" : on ? ", every frame" : "";
    const comes = late() ? ", " + data.names[flight.wanted] + " is coming …" : panelFollows() ? ", the panel follows …" : "";
    flight.find(".now").textContent = (chosen < 0 ? "your own picture" : chosen + 1 + " of " + flight.total() + clock) + pace + comes;
  };
  // Draw the plots one below the other.
  const draw = () => {
    const { data, chosen } = flight, colour = flight.ink();
    element.classList.toggle("stacked", timeline.plot === "all");
    const plots = timeline.plot === "all" ? ["error", "radius", ...(timeline.highs() ? ["height"] : [])] : [timeline.plot];
    const [pen] = lpn.pens.canvas(element);
    const [width, height] = [element.clientWidth, element.clientHeight];
    const foot = height - 16, tall = foot / plots.length;
    marks = [];
    plots.forEach((plot, i) => {
      band(pen, data, { plot, lines: series(plot) }, colour, width, i * tall + 8, (i + 1) * tall);
      if (plots.length === 1) return;
      pen.fillStyle = colour;
      pen.textAlign = "left";
      pen.fillText(LABELS[plot][data.plain ? 1 : 0], 48, i * tall + 17);
    });
    data.signs.forEach((sign, i) => {
      pen.fillStyle = lpn.colour(data.states[i], "mark");
      pen.fillRect(across(i, width, data) - 2, foot + 13 - SIGNS[sign], 4, SIGNS[sign]);
      const reason = sign ? "" : reasonOf(data.stages[i], i) || reasonOf("registration", i);
      marks.push([across(i, width, data), foot + 9, i, reason || ""]);
    });
    if (held && (held.frame !== (flight.wanted ?? chosen) || held.plot !== timeline.plot)) hush();
    say();
    if (flight.wanted !== null) {
      // The frame that was asked for, until it comes.
      pen.fillStyle = "#e6c300";
      pen.fillRect(across(flight.wanted, width, data) - 4, foot + 14, 8, 2);
    }
    if (chosen < 0) return;
    pen.strokeStyle = lpn.colour("accent");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(across(chosen, width, data), 4);
    pen.lineTo(across(chosen, width, data), foot + 14);
    pen.stroke();
  };

  let element = null;
  document.addEventListener("pointerdown", (event) => element?.isConnected && event.target !== element && hush());
  const timeline = (flight.timeline = {
    plot: "error", // or "radius", "height", or "all"
    draw,
    // Tell if the height of any photo is known.
    highs: () => flight.data.heights.some((height) => height !== null),
    // Return whether a key is one of the timeline's.
    key: (key) => {
      const last = flight.total() - 1;
      if (key in TURNS) flight.step(TURNS[key]);
      else if (key === "Home" || key === "End") flight.choose(key === "Home" ? 0 : last);
      else return false;
      return true;
    },
    attach: () => {
      element = flight.find(".time canvas");
      const choose = (event) => flight.data && flight.choose(nearest(event.offsetX));
      // A finger that moves across scrolls the page, so it chooses by a tap alone.
      let finger = false;
      element.addEventListener("click", (event) => {
        if (!finger) return;
        const frame = nearest(event.offsetX);
        choose(event);
        held = { frame, plot: timeline.plot };
        explain([event.offsetX, event.offsetY], marks.filter((mark) => mark[2] === frame && mark[3]), Infinity);
        flight.see(".view"); // a phone's sheet may have scrolled the map, which has the answer, out of sight
      });
      element.addEventListener("pointerdown", (event) => {
        finger = event.pointerType === "touch";
        if (finger) return;
        element.setPointerCapture(event.pointerId);
        choose(event);
      });
      element.addEventListener("pointermove", (event) => {
        if (event.pointerType === "touch" || !flight.data) return;
        explain([event.offsetX, event.offsetY], marks, REACH);
        if (element.hasPointerCapture(event.pointerId)) choose(event);
      });
      element.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && hush());
    },
  });
})();
