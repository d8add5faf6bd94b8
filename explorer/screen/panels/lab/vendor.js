// Kept libraries as their makers publish them, which are loaded when they are first needed.

import { make } from "../../page/dom.js";

const known = new Map();

/** @returns {Promise<any>} the module of a library of `vendor`, once its style sheet is there, too */
export const load = (name) => {
  if (!known.has(name)) {
    const sheet = make("link", { rel: "stylesheet", href: new URL(`../../vendor/${name}.css`, import.meta.url).href });
    const styled = new Promise((done) => (sheet.onload = sheet.onerror = done));
    document.head.prepend(sheet); // the page's own style stands above it
    known.set(name, Promise.all([import(`../../vendor/${name}.js`), styled]).then(([module]) => module));
  }
  return known.get(name);
};
