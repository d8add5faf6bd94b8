// Every map has a scale bar, a north arrow, and positions in words; north is up unless a map is turned.
(() => {
  const lpn = window.lpn;
  if (lpn.mapMarks) return;
  const { stroke, text } = lpn.pens;
  // Draw a scale bar of 1, 2, or 5 times a power of ten metres from a place to the right, and return its metres.
  // `scale` is in pixels per metre, `width` that of the map: on a phone the bar is shorter.
  const bar = (pen, [left, top], scale, width) => {
    const longest = Math.min(130, 0.3 * width) / scale, power = 10 ** Math.floor(Math.log10(longest));
    const metres = Number(([5, 2, 1].find((n) => n * power <= longest) * power).toPrecision(1)), right = left + metres * scale;
    pen.beginPath();
    pen.moveTo(left, top - 5);
    pen.lineTo(left, top);
    pen.lineTo(right, top);
    pen.lineTo(right, top - 5);
    stroke(pen, "#fff", 2);
    text(pen, metres >= 1000 ? metres / 1000 + " km" : metres + " m", right + 8, top - 3);
    return metres;
  };
  // Draw an arrow that points north, which is `turn` radians clockwise from up.
  const north = (pen, [x, y], turn = 0) => {
    /** @type {(at: Point) => [number, number]} */
    const turned = ([right, down]) => [x + right * Math.cos(turn) - down * Math.sin(turn), y + right * Math.sin(turn) + down * Math.cos(turn)];
    pen.beginPath();
    for (const corner of [[0, -18], [7, 4], [0, -1], [-7, 4]]) pen.lineTo(...turned(corner));
    pen.closePath();
    stroke(pen, "#fff", 1);
    pen.fillStyle = "#fff";
    pen.fill();
    text(pen, "N", ...turned([0, 13]), "center");
  };
  // Latitude and longitude in words; a map over the date line counts on beyond 180 degrees.
  const degrees = ([latitude, longitude]) => latitude.toFixed(6) + ", " + (longitude - 360 * Math.round(longitude / 360)).toFixed(6);
  // Metres east and north of the middle, for a place that is rendered.
  const metres = ([east, north]) => Math.abs(east).toFixed(0) + " m " + (east < 0 ? "W" : "E") + ", " + Math.abs(north).toFixed(0) + " m " + (north < 0 ? "S" : "N") + " (no real place)";
  lpn.mapMarks = { bar: bar, north: north, degrees: degrees, metres: metres };
})();
