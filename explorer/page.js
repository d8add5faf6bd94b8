// What happens in the page without asking the server: a linked cursor over a pair's cells, painting, and messages.
// A message goes to the server through a hidden text control of viser's, as {"kind": ..., "value": ..., "count": ...}.
(() => {
  if (window.lpn) return;
  let count = 0;
  const lpn = (window.lpn = {});

  lpn.field = (uuid) => {
    let row = document.querySelector('label[for="' + uuid + '"]');
    while (row && !row.querySelector("input")) row = row.parentElement;
    return row && row.querySelector("input");
  };

  lpn.send = (kind, value) => {
    const input = lpn.field(lpn.bridge);
    if (!input) return kind === "hello" || kind === "small" || lpn.say("Unfold the panel on the right first.");
    const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
    set.call(input, JSON.stringify({ kind: kind, value: value, count: ++count }));
    input.dispatchEvent(new Event("input", { bubbles: true }));
  };

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

  const other = (map) => [...map.closest(".lpn-pair").querySelectorAll(".lpn-map")].find((found) => found !== map);
  const signed = (value) => (value < 0 ? "\u2212" : "+") + Math.abs(value).toFixed(4);

  lpn.hover = (map, event, held) => {
    const pair = map.closest(".lpn-pair");
    if (pair.dataset.held && !held) return;
    const cell = lpn.cell(map, event);
    const mate = numbers(map, "mates")[cell];
    const [, columns] = sized(map);
    mark(map, "here", cell);
    mark(other(map), "there", mate);
    mark(map, "there", -1);
    mark(other(map), "here", -1);
    const place = (index, width) => "row " + (Math.floor(index / width) + 1) + ", column " + ((index % width) + 1);
    let said = map.dataset.side + ", " + place(cell, columns) + ": " + signed(numbers(map, "cells")[cell]) + " of the score";
    if (mate >= 0)
      said += "; with the " + other(map).dataset.side + "\u2019s " + place(mate, sized(other(map))[1]) + " " + signed(numbers(map, "shares")[cell]);
    pair.parentElement.querySelector(".lpn-read").textContent = said;
  };

  lpn.leave = (map) => {
    const pair = map.closest(".lpn-pair");
    if (pair.dataset.held) return;
    for (const shown of [map, other(map)]) for (const name of ["here", "there"]) mark(shown, name, -1);
    pair.parentElement.querySelector(".lpn-read").textContent = pair.dataset.hint;
  };

  // A click keeps the pair of cells marked until the next one on the same cell.
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

  // Painting: the first cell touched decides whether the stroke paints or erases; the server hears of whole strokes.
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
    map.querySelectorAll(".paint").forEach((box) => (box.style.opacity = map._painted.has(+box.dataset.cell) ? 1 : 0));
    event.preventDefault();
  };
})();
