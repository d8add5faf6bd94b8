// Curves of one photo over shifts, zooms, turns, or weathers.

import { make, partColour, variable } from "../../page/dom.js";
import { plot } from "../why/plot.js";

const AXES = { rotation: "degrees counter-clockwise", shift: "pixels to the right", "shift-down": "pixels down", zoom: "zoom", weather: "" };

export const open = (box, { set, view }) => {
  const [choices, state, charts, said] = ["chips", "state soft", "charts", "said"].map((name) => make("div", { class: name }));
  const [rank, distance, shares] = ["rank", "distance", "shares"].map((name) => make("div", { class: `chart ${name}` }));
  charts.append(rank, distance, shares);
  const page = make("div", { class: "sweep" }, choices, state, charts, said);
  box.append(page);
  state.setAttribute("aria-live", "polite");
  let told = null;
  let drawn = "";

  const draw = () => {
    if (!told) return;
    choices.replaceChildren(...Object.entries(told.choices).map(([over, label]) => {
      const button = make("button", { class: "chip", text: label, "aria-pressed": String(over === told.over) });
      button.onclick = () => set({ sweep_over: over });
      return button;
    }));
    charts.hidden = Boolean(told.why);
    state.textContent = told.why ?? (told.done < told.total ? `${told.done} of ${told.total} steps` : "");
    said.replaceChildren(...(told.said ?? []).map((text) => make("p", { text })));
    if (told.why || told.done < 2) return;
    const weathers = told.over === "weather";
    const text = (one) => (weathers ? (told.labels[one] ?? "") : String(Number(one.toPrecision(3))).replace("-", "−"));
    const common = {
      x: told.x, axes: [AXES[told.over], ""], name: told.over === "weather" ? "weather" : told.choices[told.over].toLowerCase(), text, dots: true, mark: told.now, logX: told.over === "zoom",
      ...(told.over === "rotation" ? { pick: (at) => set({ angle: told.x[at] }), ticks: [-180, -90, 0, 90, 180] } : {}),
      ...(weathers ? { ticks: told.x, turned: true } : {}),
      ...(told.over === "zoom" ? { ticks: [0.5, 0.7, 1, 1.4, 2] } : {}),
    };
    const many = Math.max(...told.rank) > 1;
    const [ink, soft] = [variable("--ink"), variable("--soft")];
    const decimals = (one) => one.toFixed(3);
    plot(rank, { ...common, label: `Rank of the ${told.follows}`, axes: [common.axes[0], "rank"], logY: many, down: true, ...(many ? {} : { range: [0.5, 2] }), lines: [{ label: `rank of the ${told.follows}`, values: told.rank, colour: ink }], height: weathers ? 220 : 150 });
    plot(distance, {
      ...common, label: "Distance", axes: [common.axes[0], "distance"], height: weathers ? 220 : 150,
      lines: [{ label: told.follows, values: told.distance, colour: ink, text: decimals }, { label: "nearest tile", values: told.nearest, colour: soft, dash: [5, 4], text: decimals }],
    });
    const count = told.shares.length;
    shares.hidden = count === 1;
    if (count > 1)
      plot(shares, {
        ...common, label: `Share of each ${view.page.word}`, axes: [common.axes[0], "share"], height: weathers ? 240 : 180,
        lines: told.shares.map((values, part) => ({ label: view.page.names[part], values, colour: partColour(part, count), text: decimals })),
      });
  };
  return {
    receive: (message) => {
      told = message;
      draw();
    },
    draw: () => {
      const now = `${document.documentElement.className} ${box.clientWidth}`;
      if (now !== drawn) draw();
      drawn = now;
    },
    close: () => page.remove(),
  };
};
