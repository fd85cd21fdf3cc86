import { describe, expect, test } from "vitest";

import { orbited, poseOf } from "../src/camera";
import { dot, lookingAlong, normalize, scale, turned } from "../src/math";
import type { Mat3, Vec3 } from "../src/math";
import { rollOf, rolled, verticalIn, verticalOf } from "../src/vertical";
import { expectClose } from "./close";

const UP: Vec3 = [0, 0, 1];
const degrees = (a: Vec3, b: Vec3): number => (180 / Math.PI) * Math.acos(Math.min(dot(a, b), 1));
/** Level cameras that look at the origin from a direction, by azimuth and elevation. */
const level = (azimuth: number, elevation: number): Mat3 =>
  lookingAlong(
    [-Math.cos(elevation) * Math.cos(azimuth), -Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation)],
    UP,
  );
const around = (num: number, camera: (phase: number, index: number) => Mat3): Mat3[] =>
  Array.from({ length: num }, (_, i) => camera((2 * Math.PI * (i + 0.5)) / num, i));
const turnedBy = (rotation: Mat3, axis: Vec3, angle: number): Mat3 => [
  turned(rotation[0], axis, angle),
  turned(rotation[1], axis, angle),
  turned(rotation[2], axis, angle),
];
const meanUp = (rotations: readonly Mat3[]): Vec3 =>
  normalize(
    rotations.reduce<Vec3>((sum, [, down]) => [sum[0] - down[0], sum[1] - down[1], sum[2] - down[2]], [0, 0, 0]),
  );
/** Cameras of the built-in scene: an arc of 80°, 15° to 37° above the target. */
const BUILT_IN = around(28, (phase) =>
  level(-Math.PI / 2 + (40 / 180) * Math.PI * Math.sin(phase), (26 + 11 * Math.sin(2 * phase + 0.6)) * (Math.PI / 180)),
);

describe("the vertical of cameras", () => {
  test("is exact for level cameras on one side of the scene, however they tilt", () => {
    expect(degrees(meanUp(BUILT_IN), UP)).toBeGreaterThan(20);
    expect(degrees(verticalOf(BUILT_IN), UP)).toBeLessThan(1e-5);
  });

  test("does not depend on the world's axes", () => {
    const [axis, angle] = [normalize([1, 2, -1]), 2.2];
    const elsewhere = BUILT_IN.map((rotation) => turnedBy(rotation, axis, angle));
    expectClose(verticalOf(elsewhere), turned(UP, axis, angle), 6);
  });

  test("averages the rolls of hand-held cameras", () => {
    const shaky = BUILT_IN.map((rotation, i) => turnedBy(rotation, rotation[2], 0.07 * Math.sin(5 * i)));
    expect(degrees(verticalOf(shaky), UP)).toBeLessThan(2);
  });

  test("points up for cameras that hang upside down, as their photographs do", () => {
    const hanging = BUILT_IN.map((rotation) => turnedBy(rotation, rotation[2], Math.PI));
    expectClose(verticalOf(hanging), scale(UP, -1), 6);
  });

  test.each([
    ["few cameras", BUILT_IN.slice(0, 3)],
    ["headings nearly alike", around(20, (phase) => level(0.08 * Math.sin(phase), 0.4 + 0.3 * Math.cos(phase)))],
    ["rolls as large as the turns", around(21, (phase, i) => turnedBy(level(phase, 0.2), [1, 0, 0], i))],
  ])("is the mean up of %s", (_, rotations) => {
    expectClose(verticalOf(rotations), meanUp(rotations));
  });

  test("is +z without cameras", () => {
    expect(verticalOf([])).toEqual(UP);
  });
});

describe("the roll of a view", () => {
  const pose = poseOf([1, 0, 0, 0.3, 0, -0.6, -0.8, 0.1, 0, 0.8, -0.6, 2, 0, 0, 0, 1], 2.2);

  test("stays zero in orbits about the vertical of level cameras", () => {
    const up = verticalOf(BUILT_IN);
    for (const rotation of BUILT_IN) {
      const turn = orbited({ ...pose, rotation }, up, -300 / 250, 0.1);
      expect(Math.abs(rollOf(turn, UP))).toBeLessThan(1e-6);
    }
  });

  test.each([-3, -0.4, 0, 1.2, 3])("is set to %f", (roll) => {
    const turn = rolled(pose, UP, roll);
    expect(rollOf(turn, UP)).toBeCloseTo(roll, 9);
    expect(turn.rotation[2]).toEqual(pose.rotation[2]);
    expect(rollOf(rolled(turn, UP, 0), UP)).toBeCloseTo(0, 9);
  });

  test("is clockwise on the screen, as seen by the camera", () => {
    expect(rolled(pose, UP, 0.1).rotation[0][2]).toBeLessThan(0);
  });

  test.each([-2, 0.3, 1.57])("of %f is none against the vertical of that view, and the pitch is the same", (roll) => {
    const turn = rolled(pose, UP, roll);
    const up = verticalIn(turn, UP);
    expect(rollOf(turn, up)).toBeCloseTo(0, 9);
    expect(dot(turn.rotation[2], up)).toBeCloseTo(dot(turn.rotation[2], UP), 9);
    expect(dot(up, up)).toBeCloseTo(1, 9);
  });
});
