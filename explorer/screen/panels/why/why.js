// The page behind the verdict.

export { open } from "../../page/fragment.js";
