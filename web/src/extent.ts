/** The extent of a scene's splats, without the few that lie far out, and what of it is shown. */

import type { Header } from "./format";
import { cross, dot, normalize, scale, subtract } from "./math";
import type { Mat3, Vec3 } from "./math";

/** Half the range from the 5th to the 95th percentile over the spread, for evenly spread positions. */
const PERCENTILES_PER_SPREAD = 1.2;
/** Half the length of the largest crop box over that of the extent. */
const REACH = 2.5;
/** Largest number that shaders compare with. */
export const UNLIMITED = 3e38;

/** Box of most splats, aligned with the file's axes. */
export interface Extent {
  readonly centre: Vec3;
  /** Half the lengths of its sides. */
  readonly half: Vec3;
}

/** Limits outside of which splats are not drawn. */
export interface Clip {
  /** Axes of the crop box in the world, one a row; the last one is the vertical. */
  readonly axes: Mat3;
  readonly low: Vec3;
  readonly high: Vec3;
  /** Largest score of floaters, which are whole numbers from 0 to 255. */
  readonly floating: number;
  /** Whether only the subject is shown. */
  readonly isAlone: boolean;
}

/** Shares of the largest crop box, 0 to 1, at which it begins and ends along width, depth and height. */
export interface Crop {
  readonly from: Vec3;
  readonly to: Vec3;
}

export const WHOLE: Crop = { from: [0, 0, 0], to: [1, 1, 1] };

/** Return the extent that follows from the positions' quantization: their median, and the spread that holds three quarters. */
export function extentOf([x, y, z]: Header["means"]): Extent {
  const half = (spread: number): number => Math.max(PERCENTILES_PER_SPREAD * spread, 1e-6);
  return { centre: [x[0], y[0], z[0]], half: [half(x[1]), half(y[1]), half(z[1])] };
}

/** Return half the width of the ellipsoid of an extent along a unit axis. */
export function halfAlong({ half }: Extent, axis: Vec3): number {
  return Math.hypot(axis[0] * half[0], axis[1] * half[1], axis[2] * half[2]);
}

/**
 * Return limits for a crop box that stands upright.
 *
 * @param floaters - strictness, 0 to 1, with which floaters are hidden
 */
export function clipOf(extent: Extent, up: Vec3, { from, to }: Crop, floaters: number, isAlone = false): Clip {
  const axes = uprightAxes(up);
  const low = (k: 0 | 1 | 2): number => (from[k] > 0 ? placeAt(extent, axes[k], from[k]) : -UNLIMITED);
  const high = (k: 0 | 1 | 2): number => (to[k] < 1 ? placeAt(extent, axes[k], to[k]) : UNLIMITED);
  // A whole number, since float32 would round 255 · (1 − 0.8) up to a score (a2tg_jax/io/edit_file.py).
  const floating = Math.floor(255 * (1 - floaters) + 0.5);
  return { axes, low: [low(0), low(1), low(2)], high: [high(0), high(1), high(2)], floating, isAlone };
}

/** Return where a share of the largest crop box is along a unit axis. */
export function placeAt(extent: Extent, axis: Vec3, share: number): number {
  return dot(axis, extent.centre) + (2 * share - 1) * REACH * halfAlong(extent, axis);
}

/** Return the share, 0 to 1, of the largest crop box at a place along a unit axis. */
export function shareAt(extent: Extent, axis: Vec3, place: number): number {
  const share = ((place - dot(axis, extent.centre)) / (REACH * halfAlong(extent, axis)) + 1) / 2;
  return Math.min(Math.max(share, 0), 1);
}

/** Return horizontal axes, the first one close to the world's x (or y), and the vertical. */
export function uprightAxes(up: Vec3): Mat3 {
  const near: Vec3 = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const across = normalize(subtract(near, scale(up, near[0] * up[0] + near[1] * up[1])));
  return [across, cross(up, across), up];
}
