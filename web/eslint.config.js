import tseslint from "typescript-eslint";

export default tseslint.config(
  { ignores: ["dist", "node_modules", "eslint.config.js"] },
  ...tseslint.configs.strictTypeChecked,
  {
    languageOptions: { parserOptions: { projectService: true } },
    rules: {
      curly: ["error", "multi-line"],
      // Handlers may be one call: () => this.draw().
      "@typescript-eslint/no-confusing-void-expression": ["error", { ignoreArrowShorthand: true }],
      // Messages contain numbers.
      "@typescript-eslint/restrict-template-expressions": ["error", { allowNumber: true }],
      // Text from scene files must never become markup.
      "no-restricted-properties": [
        "error",
        { property: "innerHTML", message: "use textContent" },
        { property: "outerHTML", message: "use textContent" },
        { property: "insertAdjacentHTML", message: "use textContent" },
      ],
    },
  },
  {
    // Hot loops over every row and byte of a scene: bounds keep indices valid, and a check per access would be slow.
    files: ["src/chunks.ts", "src/crc32.ts", "src/packing.ts", "src/parts.ts", "src/sort.ts"],
    rules: { "@typescript-eslint/no-non-null-assertion": "off" },
  },
);
