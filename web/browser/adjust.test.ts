/** What the page shows in Chromium: the first view on a phone, level views, the crop box and floaters. */

import { readFileSync, writeFileSync } from "node:fs";

import type { Browser, BrowserContextOptions, Page } from "playwright-core";
import { afterAll, beforeAll, describe, expect, test } from "vitest";

import { expectClose } from "../test/close";
import { CHROMIUM, DESK, launch, serve } from "./chromium";
import type { Served } from "./chromium";

const PAGE = readFileSync(new URL("../../a2tg_jax/web/viewer.html", import.meta.url), "utf8");
const SCENE = Uint8Array.from(readFileSync(new URL("../test/small.a2tgz", import.meta.url)));
const PHONE: BrowserContextOptions = { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true };

describe.skipIf(CHROMIUM === undefined)("the page", () => {
  let browser: Browser;
  let served: Served;
  beforeAll(async () => {
    browser = await launch();
    served = await serve({ "/": PAGE, "/scene.a2tgz": SCENE });
  });
  afterAll(async () => {
    await browser.close();
    served.close();
  });

  async function opened(options: BrowserContextOptions, hash = ""): Promise<Page> {
    const page = await browser.newPage(options);
    await page.goto(served.address + hash);
    await page.evaluate(() => window.a2tg?.loaded);
    return page;
  }

  /** Sum of alpha over a picture of the first camera. */
  const shownOn = (page: Page): Promise<number> =>
    page.evaluate(async () => {
      const camera = window.a2tg?.viewer.splats?.header.cameras[0];
      if (camera === undefined) return NaN;
      const found = await window.a2tg?.render(camera.viewmat, camera.K, camera.size, "full");
      return (found ?? new Float32Array(0)).reduce((sum, x, i) => (i % 4 === 3 ? sum + x : sum), 0);
    });

  /** The camera's right axis and the vertical. */
  const axesOn = (page: Page): Promise<{ right: readonly number[]; up: readonly number[] }> =>
    page.evaluate(() => ({
      right: window.a2tg?.viewer.pose.rotation[0] ?? [],
      up: window.a2tg?.viewer.up ?? [],
    }));

  const tilt = ({ right, up }: { right: readonly number[]; up: readonly number[] }): number =>
    Math.abs(right.reduce((sum, x, k) => sum + x * (up[k] ?? NaN), 0));

  test("a phone's first view is mostly the first camera's image", async () => {
    const page = await opened(PHONE);
    const share = await page.evaluate(() => {
      const viewer = window.a2tg?.viewer;
      if (viewer === undefined) return NaN;
      return ((viewer.lens.fy / viewer.image.fy) * viewer.image.height) / viewer.canvas.clientHeight;
    });
    expect(share).toBeGreaterThan(0.599);
    await page.close();
  });

  test("a phone lists gestures in whole lines, and no keys", async () => {
    const page = await opened(PHONE);
    await page.click("#panel > summary");
    await page.click("#help > summary");
    const boxes = await page
      .locator("#help dd:visible")
      .evaluateAll((found) =>
        found.map((row) => row.getBoundingClientRect().height / parseFloat(getComputedStyle(row).lineHeight)),
      );
    expect(boxes.length).toBe(4);
    expect(Math.max(...boxes)).toBeLessThan(1.1);
    expect(await page.locator("#help .key:visible").count()).toBe(0);
    await page.close();
  });

  test("a narrow window lists keys in whole lines, too", async () => {
    const page = await opened({ viewport: { width: 390, height: 844 } });
    await page.click("#panel > summary");
    await page.click("#help > summary");
    const widths = await page.locator("#help dd.key").evaluateAll((found) => found.map((row) => row.clientWidth));
    expect(Math.min(...widths)).toBeGreaterThan(250);
    await page.close();
  });

  test("the vertical is what the cameras tell", async () => {
    const page = await opened(DESK);
    const up = await page.evaluate(() => window.a2tg?.viewer.splats?.header.cameras[0]?.viewmat.slice(4, 7));
    expectClose((await axesOn(page)).up, up?.map((x) => -x) ?? []);
    await page.close();
  });

  test("the view is rolled, and made level by a button and a key", async () => {
    const page = await opened(DESK);
    await page.click("#leveling > summary");
    await page.fill("#roll", "20");
    expect(tilt(await axesOn(page))).toBeCloseTo(Math.sin(Math.PI / 9), 3);
    await page.click("#level");
    expect(tilt(await axesOn(page))).toBeLessThan(1e-9);
    await page.fill("#roll", "-7");
    await page.focus("#view");
    await page.keyboard.press("l");
    expect(tilt(await axesOn(page))).toBeLessThan(1e-9);
    await page.close();
  });

  test("a view that is called upright gives the vertical, and the address keeps it", async () => {
    const page = await opened(DESK);
    await page.click("#leveling > summary");
    await page.fill("#roll", "20");
    const before = await axesOn(page);
    await page.click("#upright");
    const after = await axesOn(page);
    expect([after.right, tilt(after) < 1e-9]).toEqual([before.right, true]);
    await page.waitForFunction(() => location.hash.includes("&up="));
    const other = await opened(DESK, new URL(page.url()).hash);
    expect(tilt(await axesOn(other))).toBeLessThan(1e-5);
    await page.click("#start");
    expect((await axesOn(page)).up).toEqual(before.up);
    await page.close();
    await other.close();
  });

  test("the crop box and the floaters' slider leave out splats, and a button brings them back", async () => {
    const page = await opened(DESK);
    await page.click("#cropping > summary");
    const all = await shownOn(page);
    await page.fill("#to-height", "0.5");
    const half = await shownOn(page);
    await page.fill("#from-height", "0.49");
    const slice = await shownOn(page);
    expect([half < 0.9 * all, slice < 0.3 * half]).toEqual([true, true]);
    expect(await page.textContent("#height-range")).toBe("49 to 50 %");
    await page.click("#uncrop");
    expect(await shownOn(page)).toBe(all);
    await page.fill("#floaters", "0.8");
    expect(await shownOn(page)).toBeLessThan(all);
    expect(await page.textContent("#floaters-value")).toBe("80 %");
    await page.close();
  });

  test("handles in the scene move the box by keys and pointer, and edits are taken back and made again", async () => {
    const page = await opened(DESK);
    expect(await page.isVisible("#box")).toBe(false);
    expect([await page.isDisabled("#undo"), await page.isDisabled("#alone")]).toEqual([true, true]);
    await page.click("#cropping > summary");
    const handle = page.locator('#box circle[aria-label="Width, from, of the box"]');
    await handle.waitFor({ state: "visible" });
    await handle.focus();
    await page.keyboard.press("ArrowRight");
    expect(Number(await page.inputValue("#from-width"))).toBeCloseTo(0.01, 9);
    await page.keyboard.press("Control+z");
    expect(await page.inputValue("#from-width")).toBe("0");
    await page.keyboard.press("Control+Shift+z");
    expect(Number(await page.inputValue("#from-width"))).toBeCloseTo(0.01, 9);
    const before = await handle.boundingBox();
    const [x, y] = [(before?.x ?? NaN) + 8, (before?.y ?? NaN) + 8];
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 40, y, { steps: 4 });
    await page.mouse.up();
    const moved = Number(await page.inputValue("#from-width"));
    expect(moved).toBeGreaterThan(0.05);
    await page.click("#undo");
    expect(Number(await page.inputValue("#from-width"))).toBeCloseTo(0.01, 9);
    await page.click("#redo");
    expect(Number(await page.inputValue("#from-width"))).toBe(moved);
    await page.click("#uncrop");
    await page.keyboard.press("Control+z");
    expect(Number(await page.inputValue("#from-width"))).toBe(moved);
    await page.close();
  });

  test("sliders set the lens and the exposure, and the address keeps them", async () => {
    const page = await opened(DESK);
    expect(await page.isHidden("#fly")).toBe(true); // It takes two cameras.
    await page.click("#leveling > summary");
    await page.fill("#angle", "90");
    await page.fill("#exposure", "1");
    const stateOf = (of: Page): Promise<readonly (number | undefined)[]> =>
      of.evaluate(() => {
        const viewer = window.a2tg?.viewer;
        return [(viewer?.image.fx ?? NaN) / (viewer?.image.width ?? NaN), viewer?.exposure];
      });
    expectClose((await stateOf(page)).map(Number), [0.5, 1]);
    // The text follows with the next frame.
    await page.waitForFunction(() => document.getElementById("angle-value")?.textContent === "90°");
    await page.waitForFunction(() => location.hash.includes("&exposure=1"));
    const other = await opened(DESK, new URL(page.url()).hash);
    expectClose((await stateOf(other)).map(Number), [0.5, 1]);
    await page.click("#start");
    expect((await stateOf(page))[1]).toBe(0);
    await page.close();
    await other.close();
  });

  test("what is hidden, turned and coloured is saved as an edit, and the address keeps it", async () => {
    const page = await opened(DESK);
    expect(await page.isDisabled("#save-edit")).toBe(true);
    await page.click("#cropping > summary");
    await page.fill("#to-height", "0.55");
    await page.fill("#floaters", "0.8");
    await page.fill("#background", "#ff8000");
    await page.click("#leveling > summary");
    await page.fill("#roll", "20");
    await page.click("#upright");
    const [download] = await Promise.all([page.waitForEvent("download"), page.click("#save-edit")]);
    const text = readFileSync(await download.path(), "utf8");
    const edit = JSON.parse(text) as { background: number[]; crop: { high: (number | null)[] }; floaters: number };
    expect([download.suggestedFilename(), edit.floaters]).toEqual(["edit.json", 0.8]);
    expectClose(edit.background, [1, 128 / 255, 0]);
    expect(edit.crop.high.map((x) => x === null)).toEqual([true, true, false]);
    await page.waitForFunction(() => location.hash.includes("&background="));
    const other = await opened(DESK, new URL(page.url()).hash);
    expect(await shownOn(other)).toBeCloseTo(await shownOn(page), 1);
    expect(await other.inputValue("#to-height")).toBe("0.55");
    // tests/test_viewer_browser.py applies the edit and compares.
    const folder = process.env.A2TG_EDIT;
    if (folder !== undefined) {
      const picture = await page.evaluate(async () => {
        const camera = window.a2tg?.viewer.splats?.header.cameras[0];
        if (camera === undefined) return [];
        return Array.from((await window.a2tg?.render(camera.viewmat, camera.K, camera.size, "full")) ?? []);
      });
      writeFileSync(`${folder}/edit.json`, text);
      writeFileSync(`${folder}/picture.json`, JSON.stringify(picture));
    }
    await page.close();
    await other.close();
  });
});
