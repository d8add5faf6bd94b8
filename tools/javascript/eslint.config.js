// The former page's scripts are joined and run as one, so each is a script, not a module, and shares only `window.lpn`.
import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  {
    files: ["**/*.js"],
    languageOptions: { sourceType: "script", ecmaVersion: 2022, globals: globals.browser },
    linterOptions: { reportUnusedDisableDirectives: "error" },
    rules: {
      eqeqeq: "error",
      "no-empty": ["error", { allowEmptyCatch: true }],
      "no-var": "error",
      "prefer-const": ["error", { destructuring: "all" }],
    },
  },
  { files: ["**/screen/{page,panels}/**/*.js"], languageOptions: { sourceType: "module" } },
  { ignores: ["**/screen/vendor/*"] },
];
