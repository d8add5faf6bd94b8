// The page's script: messages to the server, the linked cursor over a pair's cells, and painting.
// A message goes to the server through a hidden text control of viser, as {"kind": ..., "value": ..., "count": ...}.
(() => {
  const lpn = window.lpn;
  if (lpn.send) return;
  let count = 0;

  lpn.clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  // The page's address is this computer's own, where another one may answer by a forwarded port. Texts name the computer that runs the
  // server by "{computer}".
  lpn.isHere = /^(localhost|127(\.\d+){3}|\[::1\])$/.test(location.hostname);
  lpn.named = (text) => text.replaceAll("{computer}", lpn.isHere ? "this one, unless its port is forwarded" : location.hostname);

  // The canvas of the stage; null while there is none.
  lpn.canvas = () => document.querySelector(lpn.viser.SELECTORS.canvas);

  // A text in the browser's "local" or "session" storage: null without one, undefined if the browser denies its storage.
  lpn.stored = (storage, key) => {
    try {
      return window[storage + "Storage"].getItem(key);
    } catch {}
  };

  // Store a text, or remove it by null; nothing happens if the browser denies its storage.
  lpn.store = (storage, key, text) => {
    try {
      if (text === null) window[storage + "Storage"].removeItem(key);
      else window[storage + "Storage"].setItem(key, text);
    } catch {}
  };

  // Sizes that wait for the hidden control: viser removes it while the right panel is folded.
  const sizes = new Map();
  const write = (kind, value) => {
    const input = lpn.viser.field(lpn.bridge);
    sizes.delete(kind);
    if (!input && ["small", "viewport"].includes(kind)) return sizes.set(kind, value);
    if (!input) return kind === "hello" || lpn.say("Unfold the panel on the right first.");
    const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
    set.call(input, JSON.stringify({ kind: kind, value: value, count: ++count }));
    input.dispatchEvent(new Event("input", { bubbles: true }));
  };

  // viser sends the control's last value every 50 ms, so each message waits until the one before is sent. Each timer starts
  // when a message is written: timers that were set in advance expire together on a page that is busy.
  const waiting = [];
  let sending = false;
  let paused = false; // another session is about to begin, which gets the messages
  const next = () => {
    sending = waiting.length > 0 && !paused;
    if (!sending) return;
    setTimeout(next, 60); // before `write`, which may throw
    if (!lpn.begins() || lpn.viser.field(lpn.bridge)) write(...waiting.shift()); // viser may yet have to draw the control
  };
  // Send messages again, and return those that waited for this session.
  lpn.resume = () => {
    paused = false;
    return waiting.splice(0);
  };
  // Hold messages from now on, and confirm the preview to the session that ends, unless the next one has begun by then.
  lpn.holdMessages = () => {
    paused = true;
    // The message before may still wait to be sent by viser.
    const confirm = () => paused && !lpn.begins() && (sending ? setTimeout(confirm, 20) : write("previewed"));
    requestAnimationFrame(() => requestAnimationFrame(confirm));
  };
  lpn.send = (kind, value) => {
    const same = kind === "hello" && waiting.find(([other]) => other === kind);
    if (same) same[1] = value;
    else waiting.push([kind, value]);
    if (!sending) next();
  };
  lpn.onChange(100, () => {
    if (!sizes.size || !lpn.viser.field(lpn.bridge)) return;
    const ready = [...sizes];
    sizes.clear();
    ready.forEach(([kind, value]) => lpn.send(kind, value));
  });

  const sized = (map) => map.dataset.size.split(",").map(Number);
  const numbers = (map, name) => (map["_" + name] ||= JSON.parse(map.dataset[name]));

  lpn.cell = (map, event) => {
    const box = map.getBoundingClientRect();
    const [rows, columns] = sized(map);
    const at = (part, length) => Math.min(Math.max(Math.floor(part * length), 0), length - 1);
    const row = at((event.clientY - box.top) / box.height, rows);
    return row * columns + at((event.clientX - box.left) / box.width, columns);
  };

  const mark = (map, name, cell) => {
    const box = map.querySelector("." + name);
    const [rows, columns] = sized(map);
    box.style.display = cell < 0 ? "none" : "block";
    box.style.left = (100 * (cell % columns)) / columns + "%";
    box.style.top = (100 * Math.floor(cell / columns)) / rows + "%";
    box.style.width = 100 / columns + "%";
    box.style.height = 100 / rows + "%";
  };

  const other = (map) => [...map.closest(".lpn-pair").querySelectorAll(".lpn-map")].find((one) => one !== map);
  const signed = (value) => (value < 0 ? "\u2212" : "+") + Math.abs(value).toFixed(4);

  // Write a text in a line in place of its hint, and bring the hint back.
  const tell = (line, text) => {
    line._hint ??= line.innerHTML;
    line.textContent = text;
  };
  const untell = (line) => line._hint && (line.innerHTML = line._hint);

  lpn.hover = (map, event, held) => {
    const pair = map.closest(".lpn-pair");
    if (pair.dataset.held && !held) return;
    const cell = lpn.cell(map, event);
    const mate = numbers(map, "correspondences")[cell];
    const [, columns] = sized(map);
    mark(map, "here", cell);
    mark(other(map), "there", mate);
    mark(map, "there", -1);
    mark(other(map), "here", -1);
    const place = (index, width) => "row " + (Math.floor(index / width) + 1) + ", column " + ((index % width) + 1);
    let text = map.dataset.side + ", " + place(cell, columns) + ": " + signed(numbers(map, "cells")[cell]) + " of the score";
    if (mate >= 0)
      text += "; with the " + other(map).dataset.side + "\u2019s " + place(mate, sized(other(map))[1]) + " " + signed(numbers(map, "shares")[cell]);
    tell(pair.parentElement.querySelector(".lpn-read"), text);
  };

  lpn.leave = (map) => {
    const pair = map.closest(".lpn-pair");
    if (pair.dataset.held) return;
    for (const shown of [map, other(map)]) for (const name of ["here", "there"]) mark(shown, name, -1);
    untell(pair.parentElement.querySelector(".lpn-read"));
  };

  // A click keeps a pair of cells marked until the next click on the same cell.
  lpn.hold = (map, event) => {
    const pair = map.closest(".lpn-pair");
    const cell = map.dataset.side + lpn.cell(map, event);
    if (pair.dataset.held === cell) {
      delete pair.dataset.held;
      return lpn.hover(map, event);
    }
    pair.dataset.held = cell;
    lpn.hover(map, event, true);
  };

  // Write texts into the elements that have these values of a data attribute.
  lpn.fill = (name, texts) =>
    Object.entries(texts).forEach(([key, text]) => {
      document.querySelectorAll(`[data-${name}="${key}"]`).forEach((one) => (one.innerHTML = text));
    });

  // Show the value of the cell of a heatmap under the mouse.
  lpn.value = (map, event) => {
    const read = map.closest(".lpn").querySelector(".lpn-value");
    const cell = lpn.cell(map, event);
    const [, columns] = sized(map);
    const value = event.type === "mouseleave" ? null : numbers(map, "cells")[cell];
    const place = ", row " + (Math.floor(cell / columns) + 1) + ", column " + ((cell % columns) + 1) + ": ";
    if (value === null) untell(read);
    else tell(read, map.alt + place + String(value).replaceAll("-", "\u2212"));
  };

  // The first cell of a stroke decides whether the stroke paints or erases; the server receives whole strokes.
  lpn.stroke = (map, event) => {
    if (event.type === "pointerdown") {
      map.setPointerCapture(event.pointerId);
      map._painted = new Set(numbers(map, "painted"));
      map._erase = map._painted.has(lpn.cell(map, event));
    }
    if (!map._painted) return;
    if (event.type === "pointerup" || event.type === "pointercancel") {
      const painted = [...map._painted].sort((one, two) => one - two);
      map._painted = null;
      return lpn.send("region", painted);
    }
    const cell = lpn.cell(map, event);
    map._painted[map._erase ? "delete" : "add"](cell);
    map.querySelectorAll(".paint").forEach((box) => (box.style.opacity = map._painted.has(+box.dataset.cell) ? "1" : "0"));
    event.preventDefault();
  };

  // Send the text of a box when typing pauses.
  lpn.typed = (box, kind) => {
    clearTimeout(box._timer);
    box._timer = setTimeout(() => lpn.send(kind, box.value), 250);
  };

  // Enter in a box of a drawer sends its text, and Escape closes the drawer; no key typed there is a shortcut.
  lpn.entered = (box, event, kind) => {
    event.stopPropagation();
    if (event.key === "Enter") lpn.send(kind, box.value);
    else if (event.key === "Escape") lpn.send("lab-drawer", "");
  };

  lpn.tip = (tip) => {
    tip.style.display = "flex";
    const origin = tip.offsetParent.getBoundingClientRect();
    const left = Math.min(lpn.mouse[0] - origin.left + 14, tip.offsetParent.clientWidth - tip.offsetWidth - 4);
    const above = lpn.mouse[1] - origin.top - tip.offsetHeight - 10;
    tip.style.left = Math.max(left, 0) + "px";
    tip.style.top = (above < 0 ? lpn.mouse[1] - origin.top + 18 : above) + "px";
  };
})();
