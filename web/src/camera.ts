/** The camera: pose, lens, projection from the world to pixels, and motions. */

import { halfAlong } from "./extent";
import type { Extent } from "./extent";
import { add, cross, dot, lookingAlong, normalize, orthonormal, scale, subtract, turned } from "./math";
import type { Mat3, Row4, Vec2, Vec3 } from "./math";

/** Pinhole intrinsics in pixels for an image of width × height. Pixel centres lie at +0.5. */
export interface Lens {
  readonly fx: number;
  readonly fy: number;
  readonly cx: number;
  readonly cy: number;
  readonly skew: number;
  readonly width: number;
  readonly height: number;
}

/** Intrinsics K row by row: fx, skew, cx, 0, fy, cy, 0, 0, 1. */
export type Intrinsics = readonly [...Vec3, ...Vec3, ...Vec3];
/** World-to-camera matrix row by row. */
export type Viewmat = readonly [...Row4, ...Row4, ...Row4, ...Row4];

export interface Pose {
  readonly position: Vec3;
  /** Camera axes in the world, one a row: right, down, forward. */
  readonly rotation: Mat3;
  /** Distance to the target, the centre of orbits. */
  readonly focus: number;
}

/** Rows of K·[R | t], which maps world positions to homogeneous pixels. The last row gives the depth. */
export type Projection = readonly [Row4, Row4, Row4];

export const target = (pose: Pose): Vec3 => add(pose.position, scale(pose.rotation[2], pose.focus));

/** Whether all of an image fits into a canvas, or so much that it covers most of the canvas. */
export type Fit = "whole" | "close";
/** Share of a canvas that a close image covers at least. */
const LEAST_COVERED = 0.6;

/** Scale and centre the lens so that its image fits a canvas. */
export function fitted(lens: Lens, width: number, height: number, fit: Fit = "whole"): Lens {
  const [across, down] = [width / lens.width, height / lens.height];
  const [least, most] = [Math.min(across, down), Math.max(across, down)];
  const s = fit === "whole" ? least : Math.max(least, LEAST_COVERED * most);
  return {
    fx: lens.fx * s,
    fy: lens.fy * s,
    cx: lens.cx * s + (width - lens.width * s) / 2,
    cy: lens.cy * s + (height - lens.height * s) / 2,
    skew: lens.skew * s,
    width,
    height,
  };
}

export function projection(pose: Pose, lens: Lens): Projection {
  const row = (axis: Vec3): Row4 => [...axis, -dot(axis, pose.position)];
  const [x, y, z] = [row(pose.rotation[0]), row(pose.rotation[1]), row(pose.rotation[2])];
  const combined = (a: number, b: number, c: number): Row4 => {
    const entry = (k: 0 | 1 | 2 | 3): number => a * x[k] + b * y[k] + c * z[k];
    return [entry(0), entry(1), entry(2), entry(3)];
  };
  return [combined(lens.fx, lens.skew, lens.cx), combined(0, lens.fy, lens.cy), z];
}

/** Build a lens from intrinsics and `size` = [width, height]. */
export function lensOf(K: Intrinsics, size: Vec2): Lens {
  const [fx, skew, cx, , fy, cy] = K;
  return { fx, fy, cx, cy, skew, width: size[0], height: size[1] };
}

export function intrinsicsOf({ fx, fy, cx, cy, skew }: Lens): Intrinsics {
  return [fx, skew, cx, 0, fy, cy, 0, 0, 1];
}

/** Convert a world-to-camera matrix to a pose. */
export function poseOf(viewmat: Viewmat, focus: number): Pose {
  const [xx, xy, xz, tx, yx, yy, yz, ty, zx, zy, zz, tz] = viewmat;
  const position: Vec3 = [
    -(xx * tx + yx * ty + zx * tz),
    -(xy * tx + yy * ty + zy * tz),
    -(xz * tx + yz * ty + zz * tz),
  ];
  return {
    position,
    rotation: [
      [xx, xy, xz],
      [yx, yy, yz],
      [zx, zy, zz],
    ],
    focus,
  };
}

/** Convert a pose to its world-to-camera matrix. */
export function viewmatOf({ position, rotation: [x, y, z] }: Pose): Viewmat {
  return [...x, -dot(x, position), ...y, -dot(y, position), ...z, -dot(z, position), 0, 0, 0, 1];
}

/** Orbit the target: `yaw` about `up`, then `pitch` about the camera's right axis. Stops short of the poles. */
export function orbited(pose: Pose, up: Vec3, yaw: number, pitch: number): Pose {
  const centre = target(pose);
  const rotation = looked(pose.rotation, up, yaw, pitch);
  return { ...pose, rotation, position: subtract(centre, scale(rotation[2], pose.focus)) };
}

/** Turn the camera in place. */
export function panned(pose: Pose, up: Vec3, yaw: number, pitch: number): Pose {
  return { ...pose, rotation: looked(pose.rotation, up, yaw, pitch) };
}

function looked(rotation: Mat3, up: Vec3, yaw: number, pitch: number): Mat3 {
  const around = (rows: Mat3, axis: Vec3, angle: number): Mat3 => [
    turned(rows[0], axis, angle),
    turned(rows[1], axis, angle),
    turned(rows[2], axis, angle),
  ];
  const level = around(rotation, up, yaw);
  const pitched = around(level, level[0], pitch);
  const steep = Math.abs(dot(pitched[2], up));
  const isOver = steep > 0.995 && steep > Math.abs(dot(level[2], up));
  return orthonormal(isOver ? level : pitched);
}

/** Move the camera along its own axes (right, down, forward) in world units. */
export function moved(pose: Pose, by: Vec3): Pose {
  const [x, y, z] = pose.rotation;
  return { ...pose, position: add(pose.position, add(add(scale(x, by[0]), scale(y, by[1])), scale(z, by[2]))) };
}

/** Multiply the distance to the target by `factor`, but keep it at or above `least`. */
export function dollied(pose: Pose, factor: number, least: number): Pose {
  const focus = Math.max(pose.focus * factor, least);
  return { ...pose, focus, position: subtract(target(pose), scale(pose.rotation[2], focus)) };
}

/** Move the camera so that `at` becomes the target. The rotation and the depth of `at` stay the same. */
export function aimed(pose: Pose, at: Vec3): Pose {
  const offset = subtract(at, pose.position);
  const focus = Math.max(dot(offset, pose.rotation[2]), 1e-6);
  return { ...pose, focus, position: subtract(at, scale(pose.rotation[2], focus)) };
}

/** Return a view in which the ellipsoid of an extent just fits into the narrower angle of a lens. */
export function overview(extent: Extent, up: Vec3, { fx, fy, width, height }: Lens): Pose {
  const side = Math.abs(up[0]) < 0.9 ? cross(up, [1, 0, 0]) : cross(up, [0, 1, 0]);
  const rotation = lookingAlong(subtract(normalize(side), scale(up, 0.35)), up);
  const [right, down, forward] = rotation;
  const depth = halfAlong(extent, forward);
  const across = Math.hypot(depth, (2 * halfAlong(extent, right) * fx) / width);
  const focus = Math.max(across, Math.hypot(depth, (2 * halfAlong(extent, down) * fy) / height));
  return { position: subtract(extent.centre, scale(forward, focus)), rotation, focus };
}
