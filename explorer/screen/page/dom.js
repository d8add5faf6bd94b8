// Small helpers for elements, colours, and numbers.

/** @returns {any} the first element of a selector */
export const find = (selector, within = document) => within.querySelector(selector);
/** @returns {any[]} all elements of a selector */
export const findAll = (selector, within = document) => [...within.querySelectorAll(selector)];

/**
 * Make an element.
 * @param {string} name
 * @param {Record<string, any>} attributes `text` sets the text, and `style` is an object
 * @param {...any} children
 * @returns {any}
 */
export const make = (name, attributes = {}, ...children) => {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "text") element.textContent = value;
    else if (key === "style") for (const [property, one] of Object.entries(value)) element.style.setProperty(property, String(one));
    else if (value !== null && value !== false) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children);
  return element;
};

const NAMESPACE = "http://www.w3.org/2000/svg";
/** @returns {any} an element of SVG */
export const makeSvg = (name, attributes = {}, ...children) => {
  const element = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.append(...children);
  return element;
};

const sheets = new Map();
/** Add a style sheet once, after or before those of the page. @returns {Promise<any>} resolves when it is loaded */
export const addStyle = (address, before = false) => {
  if (!sheets.has(address)) {
    const sheet = make("link", { rel: "stylesheet", href: address });
    sheets.set(address, new Promise((done) => (sheet.onload = sheet.onerror = done)));
    document.head[before ? "prepend" : "append"](sheet);
  }
  return sheets.get(address);
};
/** @returns {Promise<any>} an unchanged library of `vendor`, after its style sheet, inserted before the page's */
export const load = async (name) => {
  await addStyle(`screen/vendor/${name}.css`, true);
  return import(`../vendor/${name}.js`);
};

/** Entries of a list that the server sends at once. */
export const PIECE = 100;
/** @returns {Promise<any[]>} a piece of a list by its address; empty if the list has ended, or the connection is lost */
export const fetchPiece = (address) => fetch(address).then((answer) => (answer.ok ? answer.json() : [])).catch(() => []);

const variables = new Map();
/** @returns {string} the value of a CSS variable that is a colour of the theme */
export const variable = (name) => {
  const key = `${document.documentElement.className} ${name}`;
  if (!variables.has(key)) variables.set(key, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return variables.get(key);
};
/** @returns {string} the colour of one of `count` parts; a single part is neutral */
export const partColour = (part, count, on = "") => variable(count === 1 ? `--${on}soft` : `--${on}part${part % 4}`);
/** @returns {string} the colour of a text on a part's colour */
export const partInk = (part, count) => partColour(part, count, "on-");

export const wrap = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;
/** @returns {string} a turn for display, with an arrow, because readers differ on its sign */
export const turned = (angle) => `${angle > 0 ? "↺ " : angle < 0 ? "↻ " : ""}${Math.abs(Math.round(angle))}°`;
export const shown = (value) => value.toFixed(3);
export const isPhone = () => innerWidth <= 760;

// Pictures by their addresses; each requests a redraw when it has loaded.
const pictures = new Map();
let whenLoaded = () => {};
export const onPicture = (callback) => (whenLoaded = callback);
/** @returns {HTMLImageElement} a picture, which may still be loading */
export const picture = (source) => {
  let known = pictures.get(source);
  if (!known) {
    known = new Image();
    known.onload = () => whenLoaded();
    known.src = source;
    if (pictures.size > 400) pictures.delete(pictures.keys().next().value);
    pictures.set(source, known);
  }
  return known;
};
