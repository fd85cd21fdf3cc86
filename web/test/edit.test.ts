import { expect, test } from "vitest";

import { colorOf, hexOf, textOfEdit } from "../src/edit";
import { WHOLE, clipOf } from "../src/extent";
import type { Extent } from "../src/extent";

const EXTENT: Extent = { centre: [1, 2, 3], half: [2, 1, 4] };
const NOTHING = { clip: clipOf(EXTENT, [0, 0, 1], WHOLE, 0), floaters: 0, up: null, background: null };

test("an edit that changes nothing has no text", () => {
  expect(textOfEdit(NOTHING)).toBeNull();
});

test("an edit holds what was changed, with null where a box is open", () => {
  const clip = clipOf(EXTENT, [0, 0, 1], { from: [0, 0, 0.5], to: [1, 1, 1] }, 0.25);
  const text = textOfEdit({ clip, floaters: 0.25, up: [0, 0, 1], background: [1, 0, 0] });
  const [low, high] = [
    [null, null, 3],
    [null, null, null],
  ];
  expect(JSON.parse(text ?? "")).toEqual({
    format: "a2tg-jax edit",
    version: 1,
    crop: { axes: clip.axes, low, high },
    floaters: 0.25,
    up: [0, 0, 1],
    background: [1, 0, 0],
  });
});

test("the subject alone is an edit", () => {
  const text = textOfEdit({ ...NOTHING, clip: clipOf(EXTENT, [0, 0, 1], WHOLE, 0, true) });
  expect(JSON.parse(text ?? "")).toEqual({ format: "a2tg-jax edit", version: 1, subject: true });
});

test("colours of the picker are numbers and back", () => {
  expect(hexOf(colorOf("#ff8001"))).toBe("#ff8001");
  expect(colorOf("#ff0000")).toEqual([1, 0, 0]);
});
