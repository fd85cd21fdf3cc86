import { expect, test } from "vitest";

import { at } from "../src/arrays";
import type { Row4 } from "../src/math";
import { DepthSorter } from "../src/sort";

function drawn(num: number, seed: number): Float32Array {
  let state = seed;
  return Float32Array.from({ length: 3 * num }, () => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return Math.round((state / 2 ** 32 - 0.5) * 400) / 10;
  });
}

test.each([0, 1, 2, 257, 5000])("%i positions, from the farthest to the nearest, ties from the last", (num) => {
  const means = drawn(num, num + 1);
  const row: Row4 = [0.25, -0.5, 1, 2];
  const depths = Float32Array.from({ length: num }, (_, i) => {
    const [x, y, z] = [at(means, 3 * i), at(means, 3 * i + 1), at(means, 3 * i + 2)];
    return row[0] * x + row[1] * y + row[2] * z + row[3];
  });
  const wanted = [...depths.keys()].sort((a, b) => at(depths, b) - at(depths, a) || b - a);
  const found = new DepthSorter().sort(means, num, row);
  expect([...found.subarray(0, num)]).toEqual(wanted);
  expect(found.length % 4).toBe(0);
});

test("buffers are reused for fewer and for more positions", () => {
  const sorter = new DepthSorter();
  const means = drawn(300, 3);
  const first = sorter.sort(means, 300, [0, 0, 1, 0]);
  expect(sorter.sort(means, 10, [0, 0, 1, 0]).length).toBe(12);
  expect([...sorter.sort(means, 300, [0, 0, 1, 0])]).toEqual([...first]);
});
