// Homographies, as 9 numbers by rows.
(() => {
  const lpn = window.lpn;
  if (lpn.homography) return;
  // The point that a homography, 9 numbers by rows, maps a point to.
  lpn.through = (h, [x, y]) => {
    const depth = h[6] * x + h[7] * y + h[8];
    return [(h[0] * x + h[1] * y + h[2]) / depth, (h[3] * x + h[4] * y + h[5]) / depth];
  };
  // The homography, 9 numbers by rows, that maps four points to four others; null if there is none.
  lpn.homography = (from, to) => {
    const [x0, y0] = to[0]; // the equations are about the first point, so that large coordinates cost no precision
    const rows = from.flatMap(([x, y], i) => {
      const [u, v] = [to[i][0] - x0, to[i][1] - y0];
      return [[x, y, 1, 0, 0, 0, -u * x, -u * y, u], [0, 0, 0, x, y, 1, -v * x, -v * y, v]];
    });
    for (let column = 0; column < 8; column++) {
      let best = column;
      for (let row = column; row < 8; row++) if (Math.abs(rows[row][column]) > Math.abs(rows[best][column])) best = row;
      [rows[column], rows[best]] = [rows[best], rows[column]];
      if (Math.abs(rows[column][column]) < 1e-12) return null;
      for (let row = 0; row < 8; row++) {
        if (row === column) continue;
        const factor = rows[row][column] / rows[column][column];
        for (let k = column; k < 9; k++) rows[row][k] -= factor * rows[column][k];
      }
    }
    const h = [...rows.map((row, i) => row[8] / row[i]), 1];
    for (const k of [0, 1, 2]) {
      h[k] += x0 * h[6 + k];
      h[3 + k] += y0 * h[6 + k];
    }
    return h;
  };
  // The product of two matrices.
  lpn.product = (one, other) =>
    [0, 3, 6].flatMap((row) => [0, 1, 2].map((k) => one[row] * other[k] + one[row + 1] * other[3 + k] + one[row + 2] * other[6 + k]));
  // The value of the CSS property `transform` of an element whose origin is its upper left corner.
  lpn.transform = (h) => {
    const [a, b, c, d, e, f, g, i, j] = h.map((value) => value / h[8]);
    return `matrix3d(${[a, d, 0, g, b, e, 0, i, 0, 0, 1, 0, c, f, 0, j].join(",")})`;
  };
})();
