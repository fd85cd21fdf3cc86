import { expect, test } from "vitest";

import { aimed, dollied, fitted, moved, orbited, overview, poseOf, projection, target, viewmatOf } from "../src/camera";
import type { Lens, Pose } from "../src/camera";
import type { Extent } from "../src/extent";
import { WHOLE } from "../src/extent";
import type { Crop } from "../src/extent";
import { linkOf, viewOf } from "../src/link";
import { cross, dot, norm, orthonormal, subtract } from "../src/math";
import type { Row4, Vec3 } from "../src/math";
import { expectClose } from "./close";

const LENS: Lens = { fx: 500, fy: 510, cx: 320.5, cy: 230, skew: 0.5, width: 640, height: 480 };
const UP: Vec3 = [0, 0, 1];
const EXTENT: Extent = { centre: [0.3, -0.2, 0.1], half: [1.3, 0.9, 0.6] };
const POSE: Pose = overview(EXTENT, UP, LENS);

function pixel(pose: Pose, lens: Lens, point: Vec3): [number, number, number] {
  const along = ([a, b, c, d]: Row4): number => dot([a, b, c], point) + d;
  const [first, second, third] = projection(pose, lens);
  const [x, y, z] = [along(first), along(second), along(third)];
  return [x / z, y / z, z];
}

function expectRotation(pose: Pose): void {
  const [x, y, z] = pose.rotation;
  for (const axis of pose.rotation) expect(norm(axis)).toBeCloseTo(1, 9);
  expectClose(cross(x, y), z);
}

test("the target lies in the middle, at the focus", () => {
  expectClose(pixel(POSE, LENS, target(POSE)), [LENS.cx, LENS.cy, POSE.focus]);
});

test("the world's up direction is up on the screen", () => {
  const above = pixel(POSE, LENS, [0.3, -0.2, 0.6]);
  expect(above[1]).toBeLessThan(LENS.cy);
  expectRotation(POSE);
});

test("a pose survives conversion to a matrix and back", () => {
  const viewmat = viewmatOf(POSE);
  const again = poseOf(viewmat, POSE.focus);
  expectClose(again.position, POSE.position);
  expectClose(viewmatOf(again), viewmat);
});

test("orbits keep the target and its distance", () => {
  let pose = POSE;
  for (let i = 0; i < 50; i++) {
    pose = orbited(pose, UP, 0.3, 0.2);
    expectClose(target(pose), target(POSE));
    expect(norm(subtract(pose.position, target(pose)))).toBeCloseTo(POSE.focus, 9);
    expectRotation(pose);
    expect(Math.abs(dot(pose.rotation[2], UP))).toBeLessThan(0.9999);
  }
});

test("dollies keep the target and a minimum distance", () => {
  expectClose(target(dollied(POSE, 0.5, 0.01)), target(POSE));
  expect(dollied(POSE, 1e-9, 0.25).focus).toBe(0.25);
});

test("moves follow the camera's own axes", () => {
  const by = subtract(moved(POSE, [0, 0, 2]).position, POSE.position);
  expect(dot(by, POSE.rotation[2])).toBeCloseTo(2, 9);
});

test("aiming puts a point in the middle", () => {
  const at: Vec3 = [0.5, 0.1, -0.3];
  const found = pixel(aimed(POSE, at), LENS, at);
  expectClose(found.slice(0, 2), [LENS.cx, LENS.cy]);
});

test.each([
  [1280, 480],
  [390, 844],
  [640, 480],
])("a canvas of %i × %i shows the whole image", (width, height) => {
  const lens = fitted(LENS, width, height);
  const s = Math.min(width / 640, height / 480);
  expect(lens.cx - width / 2).toBeCloseTo(s * (LENS.cx - 320), 9);
  expect(lens.fy / lens.fx).toBeCloseTo(LENS.fy / LENS.fx, 9);
});

test.each([
  [1280, 480],
  [390, 844],
  [1100, 700],
])("a close image covers most of a canvas of %i × %i, and is in its middle", (width, height) => {
  const [whole, close] = [fitted(LENS, width, height), fitted(LENS, width, height, "close")];
  const s = close.fx / LENS.fx;
  expect(s).toBeGreaterThanOrEqual(whole.fx / LENS.fx);
  expect(Math.min((s * LENS.width) / width, (s * LENS.height) / height)).toBeGreaterThan(0.599);
  expect(close.cx - width / 2).toBeCloseTo(s * (LENS.cx - 320), 9);
});

test("an image of nearly the canvas' shape is shown whole at first, too", () => {
  expect(fitted(LENS, 1100, 700, "close")).toEqual(fitted(LENS, 1100, 700));
});

test.each([
  [1100, 700],
  [390, 844],
])("an overview on %i × %i shows the extent's ellipsoid from as near as it can", (width, height) => {
  const lens = { ...LENS, fx: 500, fy: 500, cx: width / 2, cy: height / 2, skew: 0, width, height };
  const pose = overview(EXTENT, UP, lens);
  const { centre, half } = EXTENT;
  const shares = Array.from({ length: 4000 }, (_, i) => {
    const [z, azimuth] = [1 - (2 * i + 1) / 4000, 2.4 * i];
    const [x, y] = [Math.sqrt(1 - z * z) * Math.cos(azimuth), Math.sqrt(1 - z * z) * Math.sin(azimuth)];
    const seen = pixel(pose, lens, [centre[0] + half[0] * x, centre[1] + half[1] * y, centre[2] + half[2] * z]);
    return Math.max(Math.abs(seen[0] / width - 0.5), Math.abs(seen[1] / height - 0.5));
  });
  expect(Math.max(...shares)).toBeGreaterThan(0.45);
  expect(Math.max(...shares)).toBeLessThan(0.55);
});

test("links preserve a view", () => {
  const crop: Crop = { from: [0, 0.25, 0], to: [1, 1, 0.5] };
  const edit = {
    crop,
    floaters: 0.3,
    isAlone: true,
    background: [1, 0.5, 0] as const,
    exposure: -1.5,
    isFlying: true,
    hasPanel: false,
  };
  const view = viewOf(linkOf({ pose: POSE, lens: LENS, mode: "depth", fit: "close", up: [0, 0.6, 0.8], ...edit }));
  expect([view?.crop, view?.floaters, view?.background, view?.isAlone]).toEqual([crop, 0.3, [1, 0.5, 0], true]);
  expect([view?.exposure, view?.isFlying, view?.hasPanel]).toEqual([-1.5, true, false]);
  expect(view?.mode).toBe("depth");
  expectClose(view?.pose.position ?? [], POSE.position, 5);
  expectClose(view?.pose.rotation.flat() ?? [], POSE.rotation.flat(), 5);
  expect(view?.lens).toEqual(LENS);
  expect([view?.fit, view?.up]).toEqual(["close", [0, 0.6, 0.8]]);
  const none = {
    crop: WHOLE,
    floaters: 0,
    isAlone: false,
    background: null,
    exposure: 0,
    isFlying: false,
    hasPanel: true,
  };
  const link = linkOf({ pose: POSE, lens: LENS, mode: "full", fit: "whole", up: null, ...none });
  const plain = viewOf(link);
  expect([plain?.fit, plain?.up, plain?.crop]).toEqual(["whole", null, WHOLE]);
  expect(viewOf(`${link}&crop=0,0,2,1,1,1&floaters=x&background=1,1&exposure=x&fly=no`)).toEqual(plain);
});

test.each([
  "",
  "#view=",
  "#view=1,2,3",
  `#view=${"1,".repeat(16)}x`,
  `#view=${Array(17).fill("-1").join()}`,
  "#view=<b>",
  `#view=${Array(17).fill("1e99").join()}`,
])("other links hold no view: %s", (hash) => {
  expect(viewOf(hash)).toBeNull();
});

test("degenerate rows become a rotation", () => {
  const [x, y, z] = orthonormal([
    [0, 0, 0],
    [0, 0, 0],
    [0, 0, 0],
  ]);
  expectClose(cross(x, y), z);
});
