// The truth against the answer, and a second model beside the first.

export { open } from "../../page/fragment.js";
