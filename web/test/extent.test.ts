import { describe, expect, test } from "vitest";

import { parseHead, parseHeader } from "../src/format";
import { WHOLE, clipOf, extentOf, halfAlong } from "../src/extent";
import type { Extent } from "../src/extent";
import { cross, dot } from "../src/math";
import type { Vec3 } from "../src/math";
import { expectClose } from "./close";
import { NUMBERS, SMALL, headerText } from "./small";

const UP: Vec3 = [0, 0.6, 0.8];
const EXTENT: Extent = { centre: [1, 2, 3], half: [2, 1, 4] };

test("the extent of a scene is about its 5th to 95th percentile", () => {
  const { means } = parseHeader(new TextEncoder().encode(headerText(SMALL)), parseHead(SMALL));
  const { centre, half } = extentOf(means);
  for (const k of [0, 1, 2] as const) {
    const values = NUMBERS.means.filter((_, i) => i % 3 === k);
    const share = values.filter((x) => Math.abs(x - centre[k]) < half[k]).length / values.length;
    expect(share).toBeGreaterThan(0.75);
    expect(share).toBeLessThan(0.95);
  }
});

test("a scene of one point has an extent", () => {
  const axis = [0, 0, 0, 0] as const;
  expect(Math.min(...extentOf([axis, axis, axis]).half)).toBeGreaterThan(0);
});

describe("the crop box", () => {
  const inside = (point: Vec3, clip: ReturnType<typeof clipOf>): boolean =>
    clip.axes.every((axis, k) => {
      const x = dot(axis, point);
      return x >= (clip.low[k] ?? NaN) && x <= (clip.high[k] ?? NaN);
    });

  test("stands upright", () => {
    const { axes } = clipOf(EXTENT, UP, WHOLE, 0);
    expectClose(axes[2], UP);
    expectClose(cross(axes[0], axes[1]), axes[2]);
    expectClose(clipOf(EXTENT, [1, 0, 0], WHOLE, 0).axes[2], [1, 0, 0]);
  });

  test("has no limit at the ends of its sliders", () => {
    const clip = clipOf(EXTENT, UP, WHOLE, 0);
    expect(inside([1e12, -1e12, 1e12], clip)).toBe(true);
    expect(clip.floating).toBe(255);
  });

  test("cuts what is above or beside it", () => {
    const clip = clipOf(EXTENT, [0, 0, 1], { from: [0.4, 0, 0], to: [1, 1, 0.5] }, 0);
    expect(inside(EXTENT.centre, clip)).toBe(true);
    expect(inside([1, 2, 3.01], clip)).toBe(false);
    expect(inside([1, 1e6, -1e6], clip)).toBe(true);
    expect(inside([1 - 1.01 * 0.2 * 2.5 * 2, 2, 3], clip)).toBe(false);
    expect(inside([1 - 0.99 * 0.2 * 2.5 * 2, 2, 3], clip)).toBe(true);
  });

  test("is as wide along a slanted axis as the extent's ellipsoid", () => {
    expect(halfAlong(EXTENT, UP)).toBeCloseTo(Math.hypot(0.6, 3.2), 9);
  });
});

test("the stricter, the fewer floaters are shown", () => {
  const limits = [0, 0.2, 0.5, 0.8, 0.9, 1].map((floaters) => clipOf(EXTENT, UP, WHOLE, floaters).floating);
  expect(limits).toEqual([255, 204, 128, 51, 25, 0]); // As in tests/test_edits.py.
});
