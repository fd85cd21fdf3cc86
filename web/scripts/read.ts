/**
 * Prints the numbers of a scene: `npm run reader`, then `node dist/read.js scene.a2tgz`.
 *
 * One line of JSON, with the names of `Numbers`; `--summary` prints their lengths instead.
 */

import { readFileSync } from "node:fs";

import { readNumbers } from "../src/decode";

const names = process.argv.slice(2).filter((argument) => argument !== "--summary");
const [name] = names;
if (name === undefined || names.length > 1) {
  console.error("usage: node dist/read.js [--summary] scene.a2tgz");
  process.exit(2);
}
try {
  const found = await readNumbers(Uint8Array.from(readFileSync(name)));
  const isSummary = process.argv.includes("--summary");
  const shown = Object.entries(found)
    .filter(([, value]) => ArrayBuffer.isView(value))
    .map(([key, value]) => [key, isSummary ? (value as Uint8Array).length : Array.from(value as Uint8Array)]);
  console.log(JSON.stringify({ header: found.header, ...Object.fromEntries(shown) }));
} catch (error) {
  console.error(`${name}: ${error instanceof Error ? error.message : String(error)}`);
  process.exit(1);
}
