import { expect } from "vitest";

import { at } from "../src/arrays";

/** Expect equal lengths, and numbers equal to `digits` decimal places. */
export function expectClose(found: readonly number[], wanted: readonly number[], digits = 9): void {
  expect(found.length).toBe(wanted.length);
  for (const [i, x] of found.entries()) expect(x, `number ${i}`).toBeCloseTo(at(wanted, i), digits);
}
