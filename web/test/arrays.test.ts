import { expect, test } from "vitest";

import { at } from "../src/arrays";
import { isVector } from "../src/math";
import type { Vec3 } from "../src/math";

test("indices outside an array throw", () => {
  expect([at([7, 8], 0), at(Uint8Array.of(7, 8), 1)]).toEqual([7, 8]);
  for (const index of [-1, 2, 0.5, NaN]) expect(() => at([7, 8], index), `${index}`).toThrow(RangeError);
});

test("vectors have the right length and finite numbers", () => {
  expect(isVector<Vec3>([1, 2, 3], 3)).toBe(true);
  for (const values of [[1, 2], [1, 2, 3, 4], [1, 2, NaN], [1, 2, "3"], [1, 2, null], "123", null]) {
    expect(isVector<Vec3>(values, 3), JSON.stringify(values)).toBe(false);
  }
});
