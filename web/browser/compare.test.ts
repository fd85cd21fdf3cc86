/**
 * Comparison of the page with the JAX renderer. A2TG_CASES is a folder with one folder per scene. Each holds
 * scene.a2tgz, views.json and, for view i, the renderer's colours as float32 in i.f32. tests/viewer_cases.py writes
 * these files.
 */

import { existsSync, readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";

import type { Browser } from "playwright-core";
import { afterAll, beforeAll, describe, expect, test } from "vitest";

import { at } from "../src/arrays";
import type { Intrinsics, Viewmat } from "../src/camera";
import type { Vec2, Vec3 } from "../src/math";
import { CHROMIUM, launch, serve } from "./chromium";

interface CaseView {
  readonly viewmat: Viewmat;
  readonly K: Intrinsics;
  readonly size: Vec2;
  readonly mode: string;
  /** Source of the renderer's picture: the original model, or the model decoded from the file. */
  readonly of: "the model" | "the file";
}

interface Case {
  readonly background: Vec3;
  readonly views: CaseView[];
}

const FOLDER = process.env.A2TG_CASES ?? "";
const NAMES = FOLDER !== "" && existsSync(FOLDER) ? readdirSync(FOLDER) : [];
/** Largest mean absolute differences in 1/255. The model's limit includes the rounding of the file. */
const LIMITS = { "the model": 1, "the file": 0.15 } as const;
/** Limit for depths and normals, for which half floats are coarser than for colours in [0, 1]. */
const GEOMETRY_LIMIT = 0.5;
const PAGE = new URL("../../a2tg_jax/web/viewer.html", import.meta.url);

/** Composite colours over the background: [h, w, 3]. */
function composited(found: Float32Array, background: Vec3): Float32Array {
  const num = found.length / 4;
  const colors = new Float32Array(3 * num);
  for (let i = 0; i < num; i++) {
    const rest = 1 - at(found, 4 * i + 3);
    for (const [k, behind] of background.entries()) colors[3 * i + k] = at(found, 4 * i + k) + rest * behind;
  }
  return colors;
}

/** Drop alpha and keep the weighted sums: [h, w, 3]. */
const withoutAlpha = (found: Float32Array): Float32Array => found.filter((_, i) => i % 4 !== 3);

/** Script after which the page cannot blend floats. */
const WITHOUT_FLOATS = `
const { prototype } = WebGL2RenderingContext, get = prototype.getExtension;
prototype.getExtension = function (name) { return name === "EXT_float_blend" ? null : get.call(this, name); };`;

const clipped = (x: number): number => Math.min(Math.max(x, 0), 1);

describe.skipIf(CHROMIUM === undefined || NAMES.length === 0)("the page shows what the JAX renderer shows", () => {
  let browser: Browser;
  beforeAll(async () => {
    browser = await launch();
  });
  afterAll(async () => {
    await browser.close();
  });

  // In software the page draws in floats; one scene is drawn in half floats, too, as graphics processors do.
  const cases = NAMES.flatMap((name, i) =>
    i === 0
      ? [
          [name, "half floats"],
          [name, "floats"],
        ]
      : [[name, "floats"]],
  );
  test.each(cases)("%s in %s", async (name, numbers) => {
    const folder = join(FOLDER, name);
    const { background, views } = JSON.parse(readFileSync(join(folder, "views.json"), "utf8")) as Case;
    const served = await serve({ "/": readFileSync(PAGE), "/scene.a2tgz": readFileSync(join(folder, "scene.a2tgz")) });
    // The canvas is drawn too, slowly in software, so keep it small.
    const page = await browser.newPage({ viewport: { width: 160, height: 120 }, deviceScaleFactor: 0.25 });
    const errors: string[] = [];
    page.on("pageerror", (error) => errors.push(error.message));
    page.on("console", (message) => {
      if (message.type() === "error") errors.push(message.text());
    });
    if (numbers === "half floats") await page.addInitScript({ content: WITHOUT_FLOATS });
    await page.goto(served.address);
    await page.evaluate(() => window.a2tg?.loaded);
    for (const [index, view] of views.entries()) {
      const text = await page.evaluate(async ({ viewmat, K, size, mode }) => {
        const found = await window.a2tg?.render(viewmat, K, size, mode);
        const bytes = new Uint8Array(found?.buffer ?? new ArrayBuffer(0));
        let binary = "";
        for (let i = 0; i < bytes.length; i += 8192) binary += String.fromCharCode(...bytes.subarray(i, i + 8192));
        return btoa(binary);
      }, view);
      const bytes = Uint8Array.from(Buffer.from(text, "base64"));
      const isColor = view.mode === "full" || view.mode === "plain";
      const picture = new Float32Array(bytes.buffer);
      const found = isColor ? composited(picture, background) : withoutAlpha(picture);
      const wanted = new Float32Array(Uint8Array.from(readFileSync(join(folder, `${index}.f32`))).buffer);
      expect(found.length).toBe(wanted.length);
      let [sum, largest, far] = [0, 0, 0];
      found.forEach((x, i) => {
        const difference = isColor ? Math.abs(clipped(x) - clipped(at(wanted, i))) : Math.abs(x - at(wanted, i));
        sum += difference;
        largest = Math.max(largest, difference);
        if (difference > 8 / 255) far++;
      });
      const mean = (255 * sum) / found.length;
      console.log(
        `${name} in ${numbers}, ${view.of}, ${index} ${view.mode}: mean ${mean.toFixed(4)}/255, largest ${(255 * largest).toFixed(1)}/255, ` +
          `${((100 * far) / found.length).toFixed(3)}% beyond 8/255`,
      );
      expect(mean).toBeLessThan(isColor ? LIMITS[view.of] : GEOMETRY_LIMIT);
    }
    expect(errors.filter((error) => !error.includes("404"))).toEqual([]);
    await page.close();
    served.close();
  });
});
