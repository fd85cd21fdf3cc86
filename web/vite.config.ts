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
  // A classic script: on pages opened from disk, browsers do not start module workers from blobs.
  worker: { format: "iife" },
  plugins: [onefile()],
});
