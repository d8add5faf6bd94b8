// Kept libraries as their makers publish them, which are loaded when they are first needed.

import { addStyle } from "./dom.js";

/** @returns {Promise<any>} the module of a library of `vendor`, once its style sheet is there, below the page's own */
export const load = async (name) => {
  await addStyle(`screen/vendor/${name}.css`, true);
  return import(`../vendor/${name}.js`);
};
