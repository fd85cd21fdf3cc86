/** Edits: what the page hides, turns and colours, as a file that a2tg applies with --edit (docs/formats.md). */

import { UNLIMITED } from "./extent";
import type { Clip } from "./extent";
import type { Vec3 } from "./math";

export interface Edit {
  readonly clip: Clip;
  /** Strictness with which floaters are hidden, 0 to 1. */
  readonly floaters: number;
  /** The vertical and the background; null where they were not chosen. */
  readonly up: Vec3 | null;
  readonly background: Vec3 | null;
}

/** Return the text of an edit; null if it changes nothing. */
export function textOfEdit({ clip, floaters, up, background }: Edit): string | null {
  const limit = (x: number): number | null => (Math.abs(x) < UNLIMITED ? x : null);
  const [low, high] = [clip.low.map(limit), clip.high.map(limit)];
  const isCropped = [...low, ...high].some((x) => x !== null);
  const changes = {
    ...(isCropped ? { crop: { axes: clip.axes, low, high } } : {}),
    ...(floaters > 0 ? { floaters } : {}),
    ...(clip.isAlone ? { subject: true } : {}),
    ...(up === null ? {} : { up }),
    ...(background === null ? {} : { background }),
  };
  if (Object.keys(changes).length === 0) return null;
  return JSON.stringify({ format: "a2tg-jax edit", version: 1, ...changes }, null, 1);
}

/** Return a colour of a picker, such as #ff8000, as numbers from 0 to 1. */
export function colorOf(text: string): Vec3 {
  const code = Number.parseInt(text.slice(1), 16);
  return [((code >> 16) & 255) / 255, ((code >> 8) & 255) / 255, (code & 255) / 255];
}

/** Return a colour as a picker has it. */
export function hexOf(color: Vec3): string {
  const byte = (x: number): string =>
    Math.round(255 * Math.min(Math.max(x, 0), 1))
      .toString(16)
      .padStart(2, "0");
  return `#${color.map(byte).join("")}`;
}
