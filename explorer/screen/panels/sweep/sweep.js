// Curves of one photo over shifts, zooms, turns, or weathers.

export { open } from "../../page/fragment.js";
