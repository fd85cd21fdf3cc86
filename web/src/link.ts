/** A view as the end of an address, and back. */

import type { Lens, Pose } from "./camera";
import { orthonormal } from "./math";
import type { Vec3 } from "./math";
import { MODES } from "./shaders";
import type { Mode } from "./shaders";

export interface View {
  readonly pose: Pose;
  readonly lens: Lens;
  readonly mode: Mode;
}

const LENGTH = 17;

/** Such as #view=…&mode=depth: position, right, forward, focus, and the lens. */
export function linkOf({ pose, lens, mode }: View): string {
  const numbers = [
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

/** null where it says no view. */
export function viewOf(hash: string): View | null {
  const fields = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (fields.get("view") ?? "").split(",").map(Number);
  if (numbers.length !== LENGTH || !numbers.every((x) => Number.isFinite(x) && Math.abs(x) < 1e9)) return null;
  const vector = (i: number): Vec3 => [numbers[i], numbers[i + 1], numbers[i + 2]];
  const [fx, fy, cx, cy, skew, width, height] = numbers.slice(10);
  if (!(fx > 0 && fy > 0 && width >= 1 && height >= 1 && numbers[9] > 0)) return null;
  const rotation = orthonormal([vector(3), [0, 0, 0], vector(6)]);
  const mode = MODES.find((name) => name === fields.get("mode")) ?? "full";
  return {
    pose: { position: vector(0), rotation, focus: numbers[9] },
    lens: { fx, fy, cx, cy, skew, width, height },
    mode,
  };
}
