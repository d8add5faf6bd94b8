// Cells of a picture: the parts that they belong to, and the heat, in one perceptual map of colours on one scale.

// Dark violet to magenta to near white; lightness rises evenly. On light ground the map runs to dark.
const DARK = [[26, 10, 40, 0], [104, 24, 112, 0.4], [182, 34, 146, 0.74], [244, 104, 184, 0.88], [255, 184, 218, 0.95], [255, 246, 251, 1]];
const LIGHT = [[255, 255, 255, 0], [246, 196, 222, 0.6], [226, 110, 178, 0.9], [176, 40, 146, 0.95], [104, 16, 108, 0.97], [40, 4, 52, 1]];
// Evidence against a pair is green, as far from magenta in all kinds of colour vision.
const DARK_AGAINST = [[8, 30, 14, 0], [18, 74, 36, 0.4], [34, 122, 58, 0.74], [82, 178, 92, 0.88], [166, 226, 160, 0.95], [240, 255, 238, 1]];
const LIGHT_AGAINST = [[255, 255, 255, 0], [190, 230, 186, 0.6], [110, 184, 112, 0.9], [48, 128, 64, 0.95], [18, 82, 40, 0.97], [4, 40, 18, 1]];
const BARE = 0.3; // the weakest third keeps the grey picture

export const isLight = () => document.documentElement.classList.contains("light");
const tone = (value) => Math.pow(Math.max(0, (value - BARE) / (1 - BARE)), 1.15);

/** @returns {number[]} red, green, blue, and opacity of a value from 0 to 1, or from -1 to 1 if it is signed */
const colourOf = (value, signed) => {
  const map = value < 0 ? (isLight() ? LIGHT_AGAINST : DARK_AGAINST) : isLight() ? LIGHT : DARK;
  // The cells of outer rings are many, so each has little of its ring's evidence: the power keeps it visible.
  const at = Math.max(0, Math.min(0.9999, signed ? Math.pow(Math.abs(value), 0.6) : tone(value))) * 5;
  const from = Math.floor(at);
  return map[from].map((one, channel) => one + (map[from + 1][channel] - one) * (at - from));
};

const decoded = new Map();
/** @returns {Uint8Array} bytes that the server has sent as base64 */
const bytes = (text) => {
  let known = decoded.get(text);
  if (!known) {
    known = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    if (decoded.size > 200) decoded.delete(decoded.keys().next().value);
    decoded.set(text, known);
  }
  return known;
};

/** @returns {number} the part at a place of a picture, in shares of its sides; -1 for none */
export const partAt = (parts, x, y) => {
  if (!parts || x < 0 || y < 0 || x >= 1 || y >= 1) return -1;
  const label = bytes(parts.labels)[Math.floor(y * parts.rows) * parts.columns + Math.floor(x * parts.columns)];
  return label === 255 ? -1 : label;
};

/** @returns {Path2D} the outline of a part's cells in a picture of a width and height, for clipping */
export const cellsOf = (parts, part, width, height) => {
  const path = new Path2D();
  const labels = bytes(parts.labels);
  const [across, down] = [width / parts.columns, height / parts.rows];
  for (let row = 0; row < parts.rows; row++)
    for (let column = 0, begin = -1; column <= parts.columns; column++) {
      const inside = column < parts.columns && labels[row * parts.columns + column] === part;
      if (inside && begin < 0) begin = column;
      if (inside || begin < 0) continue;
      path.rect(begin * across, row * down, (column - begin) * across, down + 0.5);
      begin = -1;
    }
  return path;
};

const cells = document.createElement("canvas");
/** Paint the heat of a described picture, or of one of its parts alone, whose cells are then not smoothed. */
export const paintHeat = (pen, width, height, described, only = -1) => {
  const { parts, heat } = described;
  pen.clearRect(0, 0, width, height);
  if (!parts || !heat) return;
  [cells.width, cells.height] = [parts.columns, parts.rows];
  const [values, labels] = [bytes(heat), bytes(parts.labels)];
  const small = cells.getContext("2d");
  const image = small.createImageData(parts.columns, parts.rows);
  values.forEach((value, cell) => {
    const colour = colourOf(described.signed ? (value - 128) / 127 : value / 255, described.signed);
    const seen = only < 0 || labels[cell] === only;
    image.data.set([colour[0], colour[1], colour[2], seen ? 255 * colour[3] : 0], 4 * cell);
  });
  small.putImageData(image, 0, 0);
  pen.imageSmoothingEnabled = only < 0;
  pen.imageSmoothingQuality = "high";
  pen.drawImage(cells, 0, 0, width, height);
};
