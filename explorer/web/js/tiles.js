// The tiles of a map, drawn with what is there so far.
(() => {
  const lpn = window.lpn;
  if (lpn.tiles) return;
  const SIDE = 256, KEPT = 300;

  // `redraw` is called when a tile has come.
  lpn.tiles = (redraw) => {
    const loader = lpn.pictureLoader(redraw, KEPT);

    // Draw the tiles in sight, and return how many are missing. `map` is a `PanZoom` in metres.
    const draw = (pen, ratio, data, map) => {
      const { west, north, side, levels } = data.pyramid;
      const address = (level, column, row) => `${data.address}tile/${level}/${column}/${row}`;
      const image = (...of) => loader.image(address(...of));
      const level = Math.min(Math.max(Math.ceil(Math.log2((side * map.view.scale * ratio) / SIDE) - 0.2), 0), levels);
      const step = side / 2 ** level, most = 2 ** level - 1;
      const number = (metres) => Math.min(Math.max(Math.floor(metres / step), 0), most);
      const [left, top] = map.toPlane([0, 0]), [right, bottom] = map.toPlane(map.size());
      const columns = [number(left - west), number(Math.min(right, data.bounds[2] - 1e-6) - west)];
      const rows = [number(north - top), number(north - Math.max(bottom, data.bounds[1] + 1e-6))];
      const missing = [];
      for (let row = rows[0]; row <= rows[1]; row++)
        for (let column = columns[0]; column <= columns[1]; column++) {
          const corners = [0, 1].map((far) => map.toPixels([west + (column + far) * step, north - (row + far) * step]).map(Math.round));
          const box = [...corners[0], corners[1][0] - corners[0][0], corners[1][1] - corners[0][1]];
          let found = image(level, column, row);
          if (found) {
            pen.drawImage(found, ...box);
            continue;
          }
          const far = Math.hypot(column - (columns[0] + columns[1]) / 2, row - (rows[0] + rows[1]) / 2);
          missing.push([far, address(level, column, row)]);
          // A part of a coarser tile stands for it.
          for (let up = 1; up <= level && !found; up++) {
            found = image(level - up, column >> up, row >> up);
            const part = SIDE / 2 ** up;
            if (found) pen.drawImage(found, (column % 2 ** up) * part, (row % 2 ** up) * part, part, part, ...box);
          }
          // A plain square shows that something is still to come there, so that no part of a map passes for the whole.
          if (!found) {
            pen.fillStyle = "rgba(128,128,128,.22)";
            pen.fillRect(box[0] + 1, box[1] + 1, box[2] - 2, box[3] - 2);
          }
        }
      const wanted = missing.sort((one, two) => one[0] - two[0]).map((one) => one[1]);
      // The coarsest tile comes last: it may take seconds on a large map, and stands only for tiles that are not there yet.
      loader.request(image(0, 0, 0) || !level ? wanted : [...wanted, address(0, 0, 0)]);
      return missing.length;
    };
    return { draw: draw, clear: loader.clear };
  };
})();
