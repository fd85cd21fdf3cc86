/** Conversion between views and URL fragments. */

import type { Lens, Pose } from "./camera";
import { isVector, orthonormal } from "./math";
import type { Vec3 } from "./math";
import { MODES } from "./shaders";
import type { Mode } from "./shaders";

export interface View {
  readonly pose: Pose;
  readonly lens: Lens;
  readonly mode: Mode;
}

/** Position, right, forward; focus; fx, fy, cx, cy, skew, width, height. */
type ViewNumbers = readonly [...Vec3, ...Vec3, ...Vec3, number, ...Vec3, ...Vec3, number];

/** Return the fragment of a view, such as #view=…&mode=depth. */
export function linkOf({ pose, lens, mode }: View): string {
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
  const view = numbers.map((x) => Number(x.toPrecision(7)).toString()).join(",");
  return mode === "full" ? `#view=${view}` : `#view=${view}&mode=${mode}`;
}

/** Parse a fragment. Returns null if it holds no valid view. */
export function viewOf(hash: string): View | null {
  const fields = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers: readonly number[] = (fields.get("view") ?? "").split(",").map(Number);
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
  };
}
