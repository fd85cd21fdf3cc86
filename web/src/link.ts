/** Conversion between views and URL fragments. */

import type { Fit, Lens, Pose } from "./camera";
import { WHOLE } from "./extent";
import type { Crop } from "./extent";
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
  readonly crop: Crop;
  readonly floaters: number;
  /** Whether only the subject is shown. */
  readonly isAlone: boolean;
  /** The background; null if it is the scene's. */
  readonly background: Vec3 | null;
  readonly exposure: number;
  /** Whether the page flies past the cameras. */
  readonly isFlying: boolean;
  /** Whether the page has its panel, which a page around it may hide. */
  readonly hasPanel: boolean;
}

/** Position, right, forward; focus; fx, fy, cx, cy, skew, width, height. */
type ViewNumbers = readonly [...Vec3, ...Vec3, ...Vec3, number, ...Vec3, ...Vec3, number];

/** Return the fragment of a view, such as #view=…&mode=depth. */
export function linkOf({ pose, lens, mode, fit, up, crop, floaters, ...rest }: View): string {
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
  if (isCropped(crop)) fields.push(`crop=${textOf([...crop.from, ...crop.to])}`);
  if (floaters > 0) fields.push(`floaters=${textOf([floaters])}`);
  if (rest.isAlone) fields.push("subject=yes");
  if (rest.background !== null) fields.push(`background=${textOf(rest.background)}`);
  if (rest.exposure !== 0) fields.push(`exposure=${textOf([rest.exposure])}`);
  if (rest.isFlying) fields.push("fly=yes");
  if (!rest.hasPanel) fields.push("panel=no");
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
    crop: cropOf(fields.get("crop")),
    floaters: sharesOf(fields.get("floaters"), 1)?.[0] ?? 0,
    isAlone: fields.get("subject") === "yes",
    background: sharesOf<Vec3>(fields.get("background"), 3),
    exposure: Math.min(Math.max(Number(fields.get("exposure")) || 0, -3), 3),
    isFlying: fields.get("fly") === "yes",
    hasPanel: hasPanel(hash),
  };
}

/** Return whether a fragment, with or without a view, leaves the panel. */
export const hasPanel = (hash: string): boolean => new URLSearchParams(hash.replace(/^#/, "")).get("panel") !== "no";

const isCropped = ({ from, to }: Crop): boolean => from.some((x) => x > 0) || to.some((x) => x < 1);

function cropOf(text: string | null): Crop {
  const shares = sharesOf<readonly [...Vec3, ...Vec3]>(text, 6);
  return shares === null ? WHOLE : { from: [shares[0], shares[1], shares[2]], to: [shares[3], shares[4], shares[5]] };
}

/** Parse numbers from 0 to 1. Returns null if there are not this many. */
function sharesOf<T extends readonly number[] = readonly [number]>(text: string | null, length: T["length"]): T | null {
  const shares = numbersOf(text);
  return text !== null && isVector<T>(shares, length) && shares.every((x) => x >= 0 && x <= 1) ? shares : null;
}

const textOf = (numbers: readonly number[]): string =>
  numbers.map((x) => Number(x.toPrecision(7)).toString()).join(",");

const numbersOf = (text: string | null): readonly number[] => (text ?? "").split(",").map(Number);
