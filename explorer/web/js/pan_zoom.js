// The one way to move a map: a drag or an arrow moves it; wheel, pinch, double click, plus, and minus zoom it; 0 brings it home.
// A map shows a plane whose axes point right and up. Where its `touch-action` lets the page scroll, one finger is left to the page.
(() => {
  const lpn = window.lpn;
  if (lpn.panZoom) return;
  // Pixels that a press moves before it is a drag.
  const STILL = 4;
  // The factors of one key or button and of a double click, and the share of the map by which an arrow moves it.
  const STEP = 1.5, DOUBLE = 2, ARROW = 1 / 6;
  const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  // The pixels of a wheel's line and page, the most that count at once, and the logarithm of the factor of one pixel: a pinch on a
  // touchpad comes as a wheel with Ctrl, in small steps.
  const LINE = 16, PAGE = 400, MOST = 300, WHEEL = 0.0025, TOUCHPAD = 0.01;

  lpn.panZoom = (element, { limits, bounds, ready, changed, home, pointed = () => {}, tapped = () => false, pen = null, ignores = "" }) => {
    const fingers = new Map(); // where each finger is that is down
    let start = null; // where the first finger went down
    let dragged = false, draws = false; // the press has become a drag; the pen has it
    let taken = false; // the last tap was on something, so a second one does not zoom
    /** @returns {[number, number]} */
    const size = () => [element.clientWidth, element.clientHeight];

    /** @type {PanZoom} */
    const map = {
      view: null,
      size,
      toPixels: ([x, y]) => [element.clientWidth / 2 + (x - map.view.x) * map.view.scale, element.clientHeight / 2 - (y - map.view.y) * map.view.scale],
      toPlane: ([left, top]) => [map.view.x + (left - element.clientWidth / 2) / map.view.scale, map.view.y - (top - element.clientHeight / 2) / map.view.scale],
      fit: ([west, south], [east, north], share, least) => {
        const [width, height] = size();
        const scale = share * Math.min(width / Math.max(east - west, least), height / Math.max(north - south, least));
        map.view = { x: (west + east) / 2, y: (south + north) / 2, scale: lpn.clamp(scale, ...limits()) };
      },
      zoom: (factor, at = size().map((side) => side / 2)) => {
        const [x, y] = map.toPlane(at);
        map.view.scale = lpn.clamp(map.view.scale * factor, ...limits());
        const [left, top] = map.toPixels([x, y]);
        pan(at[0] - left, at[1] - top);
      },
      stepIn: () => ready() && map.zoom(STEP),
      stepOut: () => ready() && map.zoom(1 / STEP),
      key: ({ key }) => {
        if (!ready()) return false;
        if (key in ARROWS) pan(ARROWS[key][0] * ARROW * element.clientWidth, ARROWS[key][1] * ARROW * element.clientHeight);
        else if (["+", "="].includes(key)) map.stepIn();
        else if (["-", "\u2212"].includes(key)) map.stepOut();
        else if (key === "0") home();
        else return false;
        return true;
      },
    };
    // The middle stays within the bounds, so that no map is lost.
    const pan = (right, down) => {
      const { view } = map, [west, south, east, north] = bounds();
      view.x = lpn.clamp(view.x - right / view.scale, west, east);
      view.y = lpn.clamp(view.y + down / view.scale, south, north);
      changed();
    };

    const place = (event) => {
      const { left, top } = element.getBoundingClientRect();
      return [event.clientX - left, event.clientY - top];
    };
    // Listen to an event while there is a map, unless it happens to what lies on the map.
    const on = (kind, act) => {
      const heard = (event) => ready() && !(ignores && event.target.closest(ignores)) && act(event, place(event));
      element.addEventListener(kind, heard, { passive: false });
    };
    // The middle between the fingers, and how far apart they are.
    const spread = () => {
      const [[x0, y0], [x1, y1]] = fingers.values();
      return { middle: [(x0 + x1) / 2, (y0 + y1) / 2], apart: Math.hypot(x1 - x0, y1 - y0) };
    };
    const scrolls = (event) => event.pointerType === "touch" && getComputedStyle(element).touchAction !== "none";
    // A second finger ends the scrolling that the first one might begin.
    element.addEventListener("touchmove", (event) => event.touches.length > 1 && event.cancelable && event.preventDefault(), { passive: false });
    const drop = () => {
      if (draws) pen.cancel();
      draws = false;
    };
    on("pointerdown", (event, at) => {
      if (fingers.size > 1) return;
      element.setPointerCapture(event.pointerId);
      pointed(at, event, true);
      fingers.set(event.pointerId, at);
      dragged = fingers.size > 1;
      drop();
      if (dragged) return;
      start = at;
      draws = !!pen?.down(at, event);
    });
    on("pointermove", (event, at) => {
      const last = fingers.get(event.pointerId);
      const before = fingers.size > 1 ? spread() : null;
      if (last) fingers.set(event.pointerId, at);
      if (last && before) {
        const { middle, apart } = spread();
        pan(middle[0] - before.middle[0], middle[1] - before.middle[1]);
        if (apart > 0 && before.apart > 0) map.zoom(apart / before.apart, middle);
      } else if (last) {
        const began = dragged ? last : start;
        dragged ||= Math.hypot(at[0] - start[0], at[1] - start[1]) > STILL;
        if (draws) pen.move(at);
        else if (dragged && !scrolls(event)) pan(at[0] - began[0], at[1] - began[1]);
      }
      pointed(at, event, Boolean(last));
    });
    // A finger is lifted also where there is no map any more.
    const lifted = (event) => {
      if (!fingers.delete(event.pointerId) || fingers.size) return;
      const ends = event.type === "pointerup" && ready();
      if (!ends || !dragged) drop();
      if (ends && !dragged) taken = tapped(place(event), event);
      if (draws) pen.up();
      draws = false;
    };
    for (const kind of ["pointerup", "pointercancel"]) element.addEventListener(kind, lifted);
    on("wheel", (event, at) => {
      event.preventDefault();
      event.stopPropagation();
      const pixels = event.deltaY * [1, LINE, PAGE][event.deltaMode];
      map.zoom(Math.exp(-lpn.clamp(pixels, -MOST, MOST) * (event.ctrlKey ? TOUCHPAD : WHEEL)), at);
      pointed(at, event);
    });
    on("dblclick", (event, at) => taken || map.zoom(DOUBLE, at));
    return map;
  };
})();
