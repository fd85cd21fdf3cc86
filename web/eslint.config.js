import tseslint from "typescript-eslint";

export default tseslint.config(
  { ignores: ["dist", "node_modules", "eslint.config.js"] },
  ...tseslint.configs.strictTypeChecked,
  {
    languageOptions: { parserOptions: { projectService: true } },
    rules: {
      // Handlers are one call long: () => this.draw().
      "@typescript-eslint/no-confusing-void-expression": ["error", { ignoreArrowShorthand: true }],
      // Words of text are numbers and strings alike here.
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      // What a scene file says is text and never becomes markup.
      "no-restricted-properties": [
        "error",
        { property: "innerHTML", message: "use textContent" },
        { property: "outerHTML", message: "use textContent" },
        { property: "insertAdjacentHTML", message: "use textContent" },
      ],
    },
  },
  {
    // Loops over every row and byte of a scene: their bounds keep indices inside, and a check of each would cost time.
    files: ["src/chunks.ts", "src/crc32.ts", "src/packing.ts", "src/sort.ts"],
    rules: { "@typescript-eslint/no-non-null-assertion": "off" },
  },
);
