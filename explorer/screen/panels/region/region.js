// Cells of the photo are painted; the tiles are ranked by them alone.

import { find, make, makeSvg } from "../../page/dom.js";
import { listen, put } from "../../page/fragment.js";
import { makePicture, rollPicture, showPicture } from "../../page/pictures.js";

const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export const open = (box, { set, act, view }) => {
  const figure = makePicture();
  const [mask, mark] = [makeSvg("path", { class: "mask" }), makeSvg("rect", { class: "at", width: 1, height: 1 })];
  const grid = makeSvg("svg", { class: "cells", preserveAspectRatio: "none", tabindex: 0, role: "application", "aria-label": "Cells of the photo: arrows move, Space paints or erases" }, mask, mark);
  find(".pan", figure).append(grid);
  const [why, found] = [make("p"), make("div", { class: "fade" })];
  const clear = make("button", { class: "clear button", text: "Clear" });
  const page = make("div", { class: "region" }, figure, why, clear, found);
  box.append(page);
  listen(found, { set, act });
  let told = null;
  /** @type {Set<number>} */
  let cells = new Set();
  let [at, paints, pressed] = [0, true, false];

  const draw = () => {
    if (!told || !view.result) return;
    const none = !told.rows;
    figure.hidden = none;
    why.textContent = told.why ?? (cells.size ? "" : "Draw over what the search is to go by. Start on a painted cell to erase.");
    clear.hidden = !cells.size;
    if (none) return;
    const photo = { ...view.result.photo, heat: null };
    showPicture(figure, photo, view.focus, view.page.parts, "none", photo.name);
    rollPicture(figure, photo, view.result.angle);
    const { rows, columns } = told;
    const place = (cell) => [cell % columns, Math.floor(cell / columns)];
    grid.setAttribute("viewBox", `0 0 ${columns} ${rows}`);
    mask.setAttribute("d", cells.size ? `M0 0h${columns}v${rows}h${-columns}z${[...cells].map((cell) => `M${place(cell)}h1v1h-1z`).join("")}` : "");
    [mark.style.x, mark.style.y] = place(at).map((one) => `${one}px`);
  };
  const cellAt = (event) => {
    const { left, top, width, height } = grid.getBoundingClientRect();
    const [column, row] = [Math.floor(((event.clientX - left) / width) * told.columns), Math.floor(((event.clientY - top) / height) * told.rows)];
    return column < 0 || row < 0 || column >= told.columns || row >= told.rows ? -1 : row * told.columns + column;
  };
  const paint = (cell) => {
    if (cell < 0) return;
    at = cell;
    if (paints) cells.add(cell);
    else cells.delete(cell);
    draw();
  };
  const send = () => set({ region_cells: [...cells] });
  grid.addEventListener("pointerdown", (event) => {
    const cell = cellAt(event);
    paints = !cells.has(cell);
    pressed = true;
    grid.setPointerCapture(event.pointerId);
    paint(cell);
  });
  grid.addEventListener("pointermove", (event) => pressed && paint(cellAt(event)));
  for (const end of ["pointerup", "pointercancel"]) grid.addEventListener(end, () => {
    if (pressed) send();
    pressed = false;
  });
  grid.addEventListener("keydown", (event) => {
    const step = KEYS[event.key];
    if (!told?.rows || (!step && event.key !== " ")) return;
    event.preventDefault();
    event.stopPropagation(); // the page's keys turn the photo
    if (step) {
      const column = Math.min(told.columns - 1, Math.max(0, (at % told.columns) + step[0]));
      at = Math.min(told.rows - 1, Math.max(0, Math.floor(at / told.columns) + step[1])) * told.columns + column;
      return draw();
    }
    paints = !cells.has(at);
    paint(at);
    send();
  });
  clear.onclick = () => {
    cells = new Set();
    draw();
    send();
  };
  return {
    receive: (message) => {
      told = message;
      if (!pressed) cells = new Set(message.cells ?? []);
      draw();
      put(found, message.html ?? "");
    },
    draw,
    close: () => page.remove(),
  };
};
