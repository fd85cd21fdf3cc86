import { defineConfig } from "vite";

import { onefile } from "./scripts/onefile.ts";

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    modulePreload: false,
    cssCodeSplit: false,
    assetsInlineLimit: 1_000_000,
    outDir: "dist",
    reportCompressedSize: false,
  },
  // No module: browsers start none of a blob on a page that comes from the disk.
  worker: { format: "iife" },
  plugins: [onefile()],
});
