/** Conversion between views and URL fragments. */

import type { Fit, Lens, Pose } from "./camera";
import { isVector, normalize, orthonormal } from "./math";
import type { Vec3 } from "./math";
import { MODES } from "./shaders";
import type { Mode } from "./shaders";

export interface View {
  readonly pose: Pose;
  readonly lens: Lens;
  readonly mode: Mode;
  readonly fit: Fit;
  /** The vertical; null if it is estimated. */
  readonly up: Vec3 | null;
}

/** Position, right, forward; focus; fx, fy, cx, cy, skew, width, height. */
type ViewNumbers = readonly [...Vec3, ...Vec3, ...Vec3, number, ...Vec3, ...Vec3, number];

/** Return the fragment of a view, such as #view=…&mode=depth. */
export function linkOf({ pose, lens, mode, fit, up }: View): string {
  const numbers: ViewNumbers = [
    ...pose.position,
    ...pose.rotation[0],
    ...pose.rotation[2],
    pose.focus,
    lens.fx,
    lens.fy,
    lens.cx,
    lens.cy,
    lens.skew,
    lens.width,
    lens.height,
  ];
  const fields = [`view=${textOf(numbers)}`];
  if (mode !== "full") fields.push(`mode=${mode}`);
  if (fit !== "whole") fields.push(`fit=${fit}`);
  if (up !== null) fields.push(`up=${textOf(up)}`);
  return `#${fields.join("&")}`;
}

/** Parse a fragment. Returns null if it holds no valid view. */
export function viewOf(hash: string): View | null {
  const fields = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = numbersOf(fields.get("view"));
  const up = numbersOf(fields.get("up"));
  if (!isVector<ViewNumbers>(numbers, 17) || numbers.some((x) => Math.abs(x) >= 1e9)) return null;
  const [x, y, z, rightX, rightY, rightZ, forwardX, forwardY, forwardZ, focus, ...image] = numbers;
  const [fx, fy, cx, cy, skew, width, height] = image;
  if (!(fx > 0 && fy > 0 && width >= 1 && height >= 1 && focus > 0)) return null;
  const rotation = orthonormal([
    [rightX, rightY, rightZ],
    [0, 0, 0],
    [forwardX, forwardY, forwardZ],
  ]);
  const mode = MODES.find((name) => name === fields.get("mode")) ?? "full";
  return {
    pose: { position: [x, y, z], rotation, focus },
    lens: { fx, fy, cx, cy, skew, width, height },
    mode,
    fit: fields.get("fit") === "close" ? "close" : "whole",
    up: isVector<Vec3>(up, 3) ? normalize(up) : null,
  };
}

const textOf = (numbers: readonly number[]): string =>
  numbers.map((x) => Number(x.toPrecision(7)).toString()).join(",");

const numbersOf = (text: string | null): readonly number[] => (text ?? "").split(",").map(Number);
