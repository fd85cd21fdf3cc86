/**
 * Vectors and rotations. Cameras follow OpenCV: x right, y down, z forward. The rows of a rotation are the camera's
 * axes in the world, so rotation · x + translation maps from the world to the camera.
 */

export type Vec2 = readonly [number, number];
export type Vec3 = readonly [number, number, number];
export type Mat3 = readonly [Vec3, Vec3, Vec3];
/** Row of an affine map: (x, y, z, constant). */
export type Row4 = readonly [number, number, number, number];

/** Return whether `values` is an array of `length` finite numbers. `length` must be the length of the tuple type T. */
export function isVector<T extends readonly number[]>(values: unknown, length: T["length"]): values is T {
  return Array.isArray(values) && values.length === length && values.every(Number.isFinite);
}

export const add = (a: Vec3, b: Vec3): Vec3 => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const subtract = (a: Vec3, b: Vec3): Vec3 => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a: Vec3, s: number): Vec3 => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a: Vec3, b: Vec3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const norm = (a: Vec3): number => Math.hypot(a[0], a[1], a[2]);

export function cross(a: Vec3, b: Vec3): Vec3 {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Return a / |a|, or `otherwise` if a is zero. */
export function normalize(a: Vec3, otherwise: Vec3 = [0, 0, 1]): Vec3 {
  const length = norm(a);
  return length > 1e-12 ? scale(a, 1 / length) : otherwise;
}

/** Rotate v about a unit axis by an angle (Rodrigues' formula). */
export function turned(v: Vec3, axis: Vec3, angle: number): Vec3 {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/** Return camera axes that look along `forward`, with `up` pointing up on the screen. */
export function lookingAlong(forward: Vec3, up: Vec3): Mat3 {
  const z = normalize(forward);
  let x = cross(z, up);
  if (norm(x) < 1e-6) x = cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  x = normalize(x);
  return [x, cross(z, x), z];
}

/** Orthonormalize the rows of a rotation. The direction of z is kept. */
export function orthonormal(rows: Mat3): Mat3 {
  const z = normalize(rows[2]);
  const x = normalize(subtract(rows[0], scale(z, dot(rows[0], z))), lookingAlong(z, [0, 0, 1])[0]);
  return [x, cross(z, x), z];
}
