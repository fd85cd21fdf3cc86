/** A small scene and its contents as read in Python (tests/viewer_cases.py). */

import { readFileSync } from "node:fs";

const at = (name: string): URL => new URL(name, import.meta.url);

export const SMALL: Uint8Array<ArrayBuffer> = Uint8Array.from(readFileSync(at("small.a2tgw")));
/** Kept scene whose kernels have shapes. */
export const SHAPED: Uint8Array<ArrayBuffer> = Uint8Array.from(readFileSync(at("../../tests/data/shaped.a2tgw")));
export const NUMBERS = JSON.parse(readFileSync(at("small.json"), "utf8")) as Record<
  "means" | "log_scales" | "quats" | "opacities" | "degrees" | "sizes" | "sh" | "texels",
  number[]
>;
