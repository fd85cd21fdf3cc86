import { expect, test } from "vitest";

import { viewmatOf } from "../src/camera";
import type { Pose } from "../src/camera";
import { poseAt, tourOf } from "../src/flight";
import type { SceneCamera } from "../src/format";
import { dot, lookingAlong, norm, scale, subtract } from "../src/math";
import type { Vec3 } from "../src/math";
import { expectClose } from "./close";

const UP: Vec3 = [0, 0, 1];

/** Cameras on a half circle that look at its middle, the angles in degrees. */
function camerasAt(angles: readonly number[]): SceneCamera[] {
  return angles.map((angle) => {
    const place: Vec3 = [4 * Math.cos((angle * Math.PI) / 180), 4 * Math.sin((angle * Math.PI) / 180), 1];
    const pose: Pose = { position: place, rotation: lookingAlong(scale(place, -1), UP), focus: 1 };
    return { name: "", isTest: false, viewmat: viewmatOf(pose), K: [9, 0, 5, 0, 9, 5, 0, 0, 1], size: [10, 10] };
  });
}

test("a tour goes from one end to the other, with few stops", () => {
  const angleOf = ({ position: [x, y] }: Pose): number => Math.round((Math.atan2(y, x) * 180) / Math.PI);
  const angles = tourOf(camerasAt([90, 0, 135, 45, 180])).map(angleOf);
  expect([angles, angles.toReversed()]).toContainEqual([0, 45, 90, 135, 180]);
  expect(tourOf(camerasAt(Array.from({ length: 100 }, (_, i) => i))).length).toBe(15);
});

test("a tour of thousands of cameras takes no seconds", () => {
  const angles = Array.from({ length: 20_000 }, (_, i) => (180 * ((i * 7919) % 20_000)) / 20_000);
  expect(tourOf(camerasAt(angles)).length).toBeLessThanOrEqual(16);
});

test("a flight is level, has no jumps, and comes back", () => {
  const stops = tourOf(camerasAt([0, 30, 60, 90]));
  const poses = Array.from({ length: 121 }, (_, i) => poseAt(stops, i / 20, UP));
  for (const [i, pose] of poses.entries()) {
    expect(Math.abs(dot(pose.rotation[0], UP))).toBeLessThan(1e-9);
    expect(norm(pose.position)).toBeGreaterThan(3.5);
    const next = poses[i + 1] ?? pose;
    expect(norm(subtract(next.position, pose.position))).toBeLessThan(0.15);
  }
  expectClose(poses[120]?.position ?? [], poses[0]?.position ?? [], 9);
  expect(norm(subtract(poses[60]?.position ?? UP, stops[3]?.position ?? UP))).toBeLessThan(0.5);
});
