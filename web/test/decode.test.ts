import { readFileSync } from "node:fs";
import { expect, test } from "vitest";

import { readNumbers } from "../src/decode";
import { SceneError } from "../src/format";
import { NUMBERS, SHAPED, SMALL } from "./small";

const DATA = new URL("../../tests/data/", import.meta.url);
const KEPT = JSON.parse(readFileSync(new URL("numbers.json", DATA), "utf8")) as Record<
  string,
  Record<string, number[]>
>;
const NAMES = { logScales: "log_scales" } as const;

function near(found: ArrayLike<number>, wanted: readonly number[], tolerance: number): void {
  for (const [i, value] of wanted.entries()) {
    expect(Math.abs((found[i] ?? NaN) - value)).toBeLessThan(tolerance * (1 + Math.abs(value)));
  }
}

test.each(["means", "quats", "logScales", "opacities", "degrees", "sh", "sizes", "texels"] as const)(
  "%s of the kept file are those of the Python reader",
  async (name) => {
    const found = await readNumbers(Uint8Array.from(readFileSync(new URL("web.a2tgz", DATA))));
    const wanted = KEPT["web.a2tgz"]?.[name === "logScales" ? NAMES[name] : name] ?? [];
    expect(found[name].length).toBe(wanted.length);
    near(found[name], wanted, 2e-6);
  },
);

test("kernels have the exponents of the Python reader, and are Gaussians without shapes", async () => {
  const wanted = KEPT["shaped-web.a2tgz"]?.exponents ?? [];
  const found = await readNumbers(SHAPED);
  near(found.texels, KEPT["shaped-web.a2tgz"]?.texels ?? [], 2e-6); // Of which all alpha factors are equal.
  expect(found.exponents.length).toBe(wanted.length);
  near(found.exponents, wanted, 2e-6);
  expect(new Set((await readNumbers(SMALL)).exponents)).toEqual(new Set([1]));
});

test("a scene of several chunks is decoded in full", async () => {
  const found = await readNumbers(SMALL);
  near(found.means, NUMBERS.means, 3e-5);
  near(found.texels, NUMBERS.texels, 3e-5);
  near(found.sh, NUMBERS.sh, 3e-5);
  expect(Array.from(found.sizes)).toEqual(NUMBERS.sizes);
});

test("a scene that is cut off is refused", async () => {
  await expect(readNumbers(SMALL.slice(0, -7))).rejects.toThrow(SceneError);
});
