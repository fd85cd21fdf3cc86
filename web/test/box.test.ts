import { describe, expect, test } from "vitest";

import { at } from "../src/arrays";
import { boxOf, edgesOf, handleOf, placeUnder, withFace } from "../src/box";
import { poseOf, projection } from "../src/camera";
import type { Lens } from "../src/camera";
import { WHOLE, clipOf, placeAt, shareAt } from "../src/extent";
import type { Crop, Extent } from "../src/extent";
import { add, scale } from "../src/math";
import type { Vec3 } from "../src/math";
import { History } from "../src/history";
import { expectClose } from "./close";

const UP: Vec3 = [0, 0.6, 0.8];
const EXTENT: Extent = { centre: [0.1, 0.2, 0.3], half: [0.2, 0.1, 0.4] };
const CROP: Crop = { from: [0.3, 0.4, 0.2], to: [0.6, 0.7, 0.9] };
const LENS: Lens = { fx: 300, fy: 310, cx: 200, cy: 150, skew: 4, width: 400, height: 300 };
const POSE = poseOf([1, 0, 0, 0.1, 0, 0.6, 0.8, 0, 0, -0.8, 0.6, 4, 0, 0, 0, 1], 4);

function pixel(point: Vec3): Vec3 {
  const [x, y, z] = projection(POSE, LENS).map(
    (row) => row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3],
  );
  return [(x ?? NaN) / (z ?? NaN), (y ?? NaN) / (z ?? NaN), z ?? NaN];
}

describe("the box of a crop", () => {
  test("has the faces that cut, and the faces at the sliders' ends", () => {
    const box = boxOf(EXTENT, UP, CROP);
    const clip = clipOf(EXTENT, UP, CROP, 0);
    expect([box.axes, box.low, box.high]).toEqual([clip.axes, clip.low, clip.high]);
    const whole = boxOf(EXTENT, UP, WHOLE);
    for (const k of [0, 1, 2] as const) expect(shareAt(EXTENT, whole.axes[k], whole.high[k])).toBe(1);
    expect(shareAt(EXTENT, [1, 0, 0], placeAt(EXTENT, [1, 0, 0], 0.3))).toBeCloseTo(0.3, 9);
    expect(shareAt(EXTENT, [1, 0, 0], 1e9)).toBe(1);
  });

  test("has twelve edges between its corners as the picture shows them", () => {
    const box = boxOf(EXTENT, UP, CROP);
    const edges = edgesOf(box, POSE, LENS, 0.1);
    expect(edges.length).toBe(12);
    const corner = add(
      add(scale(box.axes[0], box.low[0]), scale(box.axes[1], box.low[1])),
      scale(box.axes[2], box.low[2]),
    );
    const [x, y] = pixel(corner);
    const ends = edges.flat().filter((end) => Math.hypot(end[0] - x, end[1] - y) < 1e-6);
    expect(ends.length).toBe(3);
  });

  test("is cut off before the camera", () => {
    const box = boxOf({ centre: [0, 0, 0], half: [9, 9, 9] }, UP, WHOLE);
    const edges = edgesOf(box, POSE, LENS, 0.1);
    expect(edges.length).toBeGreaterThan(3);
    expect(edges.length).toBeLessThan(12);
    expect(edges.flat(2).every(Number.isFinite)).toBe(true);
    expect(edgesOf(boxOf(EXTENT, UP, CROP), POSE, LENS, 99)).toEqual([]);
  });

  test("has handles on its faces, or where the way to a face leaves the canvas", () => {
    const box = boxOf(EXTENT, UP, CROP);
    const middle = scale(add(box.low, box.high), 0.5);
    const place = add(
      add(scale(box.axes[0], box.high[0]), scale(box.axes[1], middle[1])),
      scale(box.axes[2], middle[2]),
    );
    expectClose(handleOf(box, 0, true, POSE, LENS, 0.1) ?? [], pixel(place).slice(0, 2));
    const large = boxOf({ centre: [0, 0, 0], half: [9, 9, 9] }, UP, WHOLE);
    const [x, y] = handleOf(large, 0, true, POSE, LENS, 0.1) ?? [NaN, NaN];
    expect([x > 300 && x <= 386, y >= 14 && y <= 286]).toEqual([true, true]);
    expect(handleOf(box, 0, true, POSE, LENS, 99)).toBeNull();
  });

  test.each([0, 1, 2] as const)("a handle's pixel gives the place of face %i", (k) => {
    const box = boxOf(EXTENT, UP, CROP);
    for (const isHigh of [false, true]) {
      const found = handleOf(box, k, isHigh, POSE, LENS, 0.1);
      expect(placeUnder(box, k, POSE, LENS, found ?? [NaN, NaN])).toBeCloseTo((isHigh ? box.high : box.low)[k], 6);
    }
  });

  test("an axis that points at the camera is not moved", () => {
    const box = boxOf({ centre: [0, 0, 0], half: [1, 1, 1] }, [0, 0, 1], WHOLE);
    const above = poseOf([1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 5, 0, 0, 0, 1], 5);
    expect(placeUnder(box, 2, above, { ...LENS, skew: 0 }, [200, 150])).toBeNull();
  });

  test("keeps its faces in order", () => {
    expect(at(withFace(CROP, 0, true, 0.1).to, 0)).toBeCloseTo(0.305, 9);
    expect(withFace(CROP, 0, false, -1).from).toEqual([0, 0.4, 0.2]);
    expect(withFace(CROP, 2, true, 0.5)).toEqual({ from: CROP.from, to: [0.6, 0.7, 0.5] });
  });
});

test("states are taken back and made again, until another one is added", () => {
  const history = new History({ x: 0 });
  expect([history.undo(), history.redo(), history.canUndo]).toEqual([null, null, false]);
  for (const x of [1, 1, 2]) history.add({ x });
  expect([history.undo(), history.undo(), history.undo()]).toEqual([{ x: 1 }, { x: 0 }, null]);
  expect([history.redo(), history.canUndo, history.canRedo]).toEqual([{ x: 1 }, true, true]);
  history.add({ x: 3 });
  expect([history.redo(), history.canRedo, history.undo()]).toEqual([null, false, { x: 1 }]);
});
