import { expect } from "vitest";

import { at } from "../src/arrays";

/** Expects as many numbers as wanted, each equal to so many decimal places. */
export function expectClose(found: readonly number[], wanted: readonly number[], digits = 9): void {
  expect(found.length).toBe(wanted.length);
  for (const [i, x] of found.entries()) expect(x, `number ${i}`).toBeCloseTo(at(wanted, i), digits);
}
