/** A small scene and its contents as read in Python (tests/viewer_cases.py). */

import { readFileSync } from "node:fs";
import { inflateSync } from "node:zlib";

import { HEAD_BYTES, parseHead } from "../src/format";

const at = (name: string): URL => new URL(name, import.meta.url);

export const SMALL: Uint8Array<ArrayBuffer> = Uint8Array.from(readFileSync(at("small.a2tgz")));
/** Kept scene whose kernels have shapes. */
export const SHAPED: Uint8Array<ArrayBuffer> = Uint8Array.from(readFileSync(at("../../tests/data/shaped-web.a2tgz")));
export const NUMBERS = JSON.parse(readFileSync(at("small.json"), "utf8")) as Record<
  "means" | "log_scales" | "quats" | "opacities" | "degrees" | "sizes" | "sh" | "texels",
  number[]
>;

/** Return the header of a file as text. */
export const headerText = (file: Uint8Array): string =>
  inflateSync(file.subarray(HEAD_BYTES, HEAD_BYTES + parseHead(file).codedBytes)).toString();
