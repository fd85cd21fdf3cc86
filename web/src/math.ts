/**
 * Vectors, and cameras in OpenCV's frame: x right, y down, z forward. A rotation's rows are the camera's axes in the
 * world, so that rotation · x + translation leads from the world to the camera.
 */

export type Vec2 = readonly [number, number];
export type Vec3 = readonly [number, number, number];
export type Mat3 = readonly [Vec3, Vec3, Vec3];
/** A row (x, y, z, constant): linear in a position. */
export type Row4 = readonly [number, number, number, number];

/** Whether `values` are as many finite numbers as the tuple type T has, which `length` names again. */
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

/** The unit vector of a's direction; `otherwise` where a has none. */
export function normalize(a: Vec3, otherwise: Vec3 = [0, 0, 1]): Vec3 {
  const length = norm(a);
  return length > 1e-12 ? scale(a, 1 / length) : otherwise;
}

/** v turned about a unit axis by an angle (Rodrigues). */
export function turned(v: Vec3, axis: Vec3, angle: number): Vec3 {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/** Axes that look along `forward` with `up` upwards on the screen, as far as that can be. */
export function lookingAlong(forward: Vec3, up: Vec3): Mat3 {
  const z = normalize(forward);
  let x = cross(z, up);
  if (norm(x) < 1e-6) x = cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  x = normalize(x);
  return [x, cross(z, x), z];
}

/** The rotation whose rows are nearly those given, made orthonormal; z is kept. */
export function orthonormal(rows: Mat3): Mat3 {
  const z = normalize(rows[2]);
  const x = normalize(subtract(rows[0], scale(z, dot(rows[0], z))), lookingAlong(z, [0, 0, 1])[0]);
  return [x, cross(z, x), z];
}
