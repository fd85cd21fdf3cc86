/** The vertical of a scene, estimated from its cameras or taken from a view, and the roll of views about it. */

import type { Pose } from "./camera";
import { add, cross, dot, lookingAlong, norm, normalize, scale, subtract, turned } from "./math";
import type { Mat3, Vec3 } from "./math";

/** Fewest cameras whose right axes tell more than their mean up. */
const FEWEST = 4;
/** Least second eigenvalue of the right axes' moments: headings that spread by 9°. */
const LEAST_SPREAD = 0.025;
/** Largest ratio of their first to their second eigenvalue. */
const LARGEST_RATIO = 0.25;
/** Smallest cosine between the vertical and the cameras' mean up. */
const LEAST_COSINE = 0.5;

/**
 * Return the vertical of a scene from the axes of its cameras (right, down, forward).
 *
 * Photographers tilt their cameras more than they roll them. The vertical is therefore the axis that is closest to
 * perpendicular to all right axes, in least squares. If the right axes do not determine it, it is the cameras' mean up.
 */
export function verticalOf(rotations: readonly Mat3[]): Vec3 {
  const up = normalize(mean(rotations.map(([, down]) => scale(down, -1))));
  const axis = rotations.length < FEWEST ? null : mostPerpendicular(rotations.map(([right]) => right));
  if (axis === null || Math.abs(dot(axis, up)) < LEAST_COSINE) return up;
  return scale(axis, Math.sign(dot(axis, up)));
}

/** Return the axis closest to perpendicular to unit vectors. Returns null if they do not determine it. */
function mostPerpendicular(vectors: readonly Vec3[]): Vec3 | null {
  const moments = (k: 0 | 1 | 2): Vec3 => mean(vectors.map((vector) => scale(vector, vector[k])));
  const rows: Mat3 = [moments(0), moments(1), moments(2)];
  const [least, middle] = eigenvalues(rows);
  if (middle < LEAST_SPREAD || least > LARGEST_RATIO * middle) return null;
  const [x, y, z] = shifted(rows, least);
  const [first, ...others] = [cross(x, y), cross(y, z), cross(z, x)] as const;
  return normalize(others.reduce((longest, other) => (norm(other) > norm(longest) ? other : longest), first));
}

/** Return the eigenvalues, in ascending order, of a symmetric matrix whose trace is 1. */
function eigenvalues(rows: Mat3): Vec3 {
  const [x, y, z] = shifted(rows, 1 / 3);
  const size = Math.sqrt((dot(x, x) + dot(y, y) + dot(z, z)) / 6);
  const cosine = dot(x, cross(y, z)) / Math.max(2 * size ** 3, 1e-30);
  const angle = Math.acos(Math.min(Math.max(cosine, -1), 1)) / 3;
  const [least, most] = [1 / 3 + 2 * size * Math.cos(angle + (2 * Math.PI) / 3), 1 / 3 + 2 * size * Math.cos(angle)];
  return [least, 1 - least - most, most];
}

/** Return a matrix minus a multiple of the identity. */
function shifted([x, y, z]: Mat3, by: number): Mat3 {
  return [subtract(x, [by, 0, 0]), subtract(y, [0, by, 0]), subtract(z, [0, 0, by])];
}

function mean(vectors: readonly Vec3[]): Vec3 {
  return scale(
    vectors.reduce((sum, vector) => add(sum, vector), [0, 0, 0]),
    1 / Math.max(vectors.length, 1),
  );
}

/** Return the angle by which a view is rolled clockwise against the vertical; 0 if it looks along the vertical. */
export function rollOf({ rotation: [right, down] }: Pose, up: Vec3): number {
  return Math.hypot(dot(right, up), dot(down, up)) < 1e-6 ? 0 : Math.atan2(-dot(right, up), -dot(down, up));
}

/** Turn a view about its own axis until it is rolled by `roll` against the vertical. */
export function rolled(pose: Pose, up: Vec3, roll: number): Pose {
  const [, , forward] = pose.rotation;
  const [right, down] = lookingAlong(forward, up);
  return { ...pose, rotation: [turned(right, forward, roll), turned(down, forward, roll), forward] };
}

/** Return the vertical against which a view is level, at the same pitch as it has now. */
export function verticalIn({ rotation: [, down, forward] }: Pose, up: Vec3): Vec3 {
  const pitch = Math.min(Math.max(dot(forward, up), -0.99), 0.99);
  return subtract(scale(forward, pitch), scale(down, Math.sqrt(1 - pitch * pitch)));
}
