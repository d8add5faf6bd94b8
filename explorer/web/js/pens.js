// Lines, dots, and words that can be seen on any ground, on a 2-D canvas.
(() => {
  const lpn = window.lpn;
  if (lpn.pens) return;
  // Clear a canvas, and return its context in CSS pixels and the ratio of its own pixels to them.
  /** @type {Lpn["pens"]["canvas"]} */
  const canvas = (element) => {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(element.clientWidth * ratio), Math.round(element.clientHeight * ratio)];
    if (element.width !== width || element.height !== height) [element.width, element.height] = [width, height];
    const pen = element.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, element.clientWidth, element.clientHeight);
    return [pen, ratio];
  };
  // A line with a dark border can be seen on any ground.
  const stroke = (pen, colour, width, dash = []) => {
    pen.setLineDash([]);
    pen.lineWidth = width + 2;
    pen.strokeStyle = "rgba(0,0,0,.55)";
    pen.stroke();
    pen.setLineDash(dash);
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.stroke();
    pen.setLineDash([]);
  };
  const dot = (pen, [left, top], radius, colour, hollow) => {
    pen.beginPath();
    pen.arc(left, top, radius, 0, 7);
    pen.fillStyle = hollow ? "rgba(0,0,0,.35)" : colour;
    pen.fill();
    pen.lineWidth = hollow ? 2 : 1;
    pen.strokeStyle = hollow ? colour : "rgba(0,0,0,.75)";
    pen.stroke();
  };
  // A filled square that stands on its corner.
  const diamond = (pen, [left, top], radius, colour) => {
    pen.beginPath();
    for (const [right, down] of [[0, -1], [1, 0], [0, 1], [-1, 0]]) pen.lineTo(left + radius * right, top + radius * down);
    pen.closePath();
    pen.fillStyle = colour;
    pen.fill();
    pen.lineWidth = 1;
    pen.strokeStyle = "rgba(0,0,0,.75)";
    pen.stroke();
  };
  const text = (pen, words, left, top, align = "left") => {
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = align;
    pen.textBaseline = "middle";
    pen.lineWidth = 3;
    pen.strokeStyle = "rgba(0,0,0,.75)";
    pen.strokeText(words, left, top);
    pen.fillStyle = "#fff";
    pen.fillText(words, left, top);
  };
  // A colour by its name in lpn/drawing/theme.py: over pictures, or as a "mark" on the page's ground.
  lpn.colour = (name, kind = "raw") => getComputedStyle(document.documentElement).getPropertyValue(`--${kind}-${name}`).trim();
  lpn.pens = { canvas: canvas, stroke: stroke, dot: dot, diamond: diamond, text: text };
})();
