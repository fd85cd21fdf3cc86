/** The page in Chromium: its texts, its controls and its error messages. */

import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

import type { Browser, Page } from "playwright-core";
import { afterAll, beforeAll, describe, expect, test } from "vitest";

import { at } from "../src/arrays";
import { target } from "../src/camera";
import type { Pose } from "../src/camera";
import { norm, subtract } from "../src/math";
import type { Vec3 } from "../src/math";
import { expectClose } from "../test/close";
import { CHROMIUM, DESK, launch, serve } from "./chromium";
import type { Served } from "./chromium";

const PAGE = readFileSync(new URL("../../a2tg_jax/web/viewer.html", import.meta.url), "utf8");
const SCENE = Uint8Array.from(readFileSync(new URL("../test/small.a2tgz", import.meta.url)));
/** A scene without textures, with three cameras. */
const PLAIN = Uint8Array.from(readFileSync(new URL("../test/plain.a2tgz", import.meta.url)));

describe.skipIf(CHROMIUM === undefined)("the page", () => {
  let browser: Browser;
  let served: Served;
  beforeAll(async () => {
    browser = await launch();
    served = await serve({ "/": PAGE, "/scene.a2tgz": SCENE, "/photographs.json": "[0]", "/photographs/0.jpg": "" });
  });
  afterAll(async () => {
    await browser.close();
    served.close();
  });

  /** Open the page and wait for the scene. `elsewhere` collects requests to other servers. */
  async function opened(hash = "", options = DESK): Promise<{ page: Page; elsewhere: string[] }> {
    const page = await browser.newPage(options);
    const elsewhere: string[] = [];
    page.on("request", (request) => {
      if (!/^(blob|data):/.test(request.url()) && !request.url().startsWith(served.address)) {
        elsewhere.push(request.url());
      }
    });
    await page.goto(served.address + hash);
    await page.evaluate(() => window.a2tg?.loaded);
    return { page, elsewhere };
  }

  async function poseOn(page: Page): Promise<Pose> {
    const pose = await page.evaluate(() => window.a2tg?.viewer.pose);
    if (pose === undefined) throw new Error("The page has no viewer.");
    return pose;
  }

  /** Resolve when the camera is farther than `distance` from a position. */
  async function movedFrom(page: Page, from: Vec3, distance: number): Promise<void> {
    await page.waitForFunction(
      ([x, y, z, least]) => {
        const position = window.a2tg?.viewer.pose.position;
        return position !== undefined && Math.hypot(position[0] - x, position[1] - y, position[2] - z) > least;
      },
      [...from, distance] as const,
    );
  }

  test("names are shown as text and nothing is fetched from other servers", async () => {
    const { page, elsewhere } = await opened();
    expect(await page.title()).toBe("small · a2tg view");
    expect(await page.textContent("#note")).toBe("a note");
    expect(await page.locator("#camera option").allTextContents()).toEqual(["free", "<b>a</b>.png"]);
    expect(await page.locator("#camera b").count()).toBe(0);
    expect(await page.textContent("#figures")).toContain("300");
    expect(elsewhere).toEqual([]);
    await page.close();
  });

  test("injected scripts do not run", async () => {
    const { page } = await opened();
    const isRun = await page.evaluate(async () => {
      const script = document.createElement("script");
      script.textContent = "window.wasRun = true";
      document.body.append(script);
      await new Promise((resolve) => setTimeout(resolve, 50));
      return "wasRun" in window;
    });
    expect(isRun).toBe(false);
    await page.close();
  });

  test("keys select modes and cameras, and fly", async () => {
    const { page } = await opened();
    await page.focus("#view");
    await page.keyboard.press("5");
    expect(await page.inputValue("#mode")).toBe("depth");
    expect(await page.textContent("#legend")).toContain("near");
    const before = await poseOn(page);
    await page.keyboard.down("w");
    await movedFrom(page, before.position, 0.01);
    await page.keyboard.up("w");
    expect(await page.inputValue("#camera")).toBe("-1");
    await page.keyboard.press(".");
    expect(await page.inputValue("#camera")).toBe("0");
    expect((await poseOn(page)).position).toEqual(before.position);
    await page.close();
  });

  test("dragging orbits the target and the wheel zooms", async () => {
    const { page } = await opened();
    const before = await poseOn(page);
    await page.mouse.move(200, 200);
    await page.mouse.down();
    await page.mouse.move(260, 220, { steps: 4 });
    await page.mouse.up();
    const turned = await poseOn(page);
    expectClose(target(turned), target(before), 5);
    expect(norm(subtract(turned.position, before.position))).toBeGreaterThan(0.1);
    await page.mouse.wheel(0, -300);
    await movedFrom(page, turned.position, 2e-3);
    expectClose(target(await poseOn(page)), target(before), 5);
    await page.close();
  });

  test("the address preserves the view", async () => {
    const { page } = await opened();
    await page.mouse.move(200, 200);
    await page.mouse.down();
    await page.mouse.move(300, 240, { steps: 3 });
    await page.mouse.up();
    await page.selectOption("#mode", "normals");
    await page.waitForFunction(() => location.hash.includes("mode=normals"));
    const hash = new URL(page.url()).hash;
    const other = await opened(`${hash}&panel=no`);
    expect(await page.isVisible("#panel")).toBe(true);
    expect(await other.page.isVisible("#panel")).toBe(false);
    const [here, there] = [await poseOn(page), await poseOn(other.page)];
    expectClose(there.position, here.position, 4);
    expect(await other.page.inputValue("#mode")).toBe("normals");
    await other.page.keyboard.press("ArrowRight");
    await other.page.waitForFunction((old) => location.hash !== old, `${hash}&panel=no`);
    expect(new URL(other.page.url()).hash).toContain("panel=no");
    await page.close();
    await other.page.close();
  });

  test("an address ends a flight", async () => {
    const other = await serve({ "/": PAGE, "/scene.a2tgz": PLAIN });
    const page = await browser.newPage(DESK);
    await page.goto(other.address);
    await page.evaluate(() => window.a2tg?.loaded);
    await page.click("#fly");
    await page.waitForFunction(() => document.getElementById("fly")?.textContent === "Stop");
    const view = [1, 2, -3, 1, 0, 0, 0, 0, 1, 4, 60, 60, 32, 24, 0, 64, 48];
    await page.evaluate((hash) => (location.hash = hash), `#view=${view.join(",")}`);
    await page.waitForFunction(() => document.getElementById("fly")?.textContent === "Fly");
    await page.waitForTimeout(300);
    expect((await poseOn(page)).position).toEqual([1, 2, -3]);
    await page.close();
    other.close();
  });

  test("slow pictures are coarse in motion and complete at rest", async () => {
    const { page } = await opened("", { viewport: { width: 320, height: 240 } });
    const isWhole = (): Promise<unknown> =>
      page.waitForFunction(() => document.querySelector<HTMLCanvasElement>("#view")?.width === 320);
    await isWhole();
    // Within the page, for the coarse picture may be gone when the next call arrives; what pictures really cost is
    // measured, and thrown away.
    await page.evaluate(async () => {
      const { viewer } = window.a2tg ?? {};
      const canvas = document.querySelector<HTMLCanvasElement>("#view");
      if (viewer === undefined) return;
      const watch = viewer["watch"];
      const take = watch.take.bind(watch);
      watch.take = () => {
        take();
        return null;
      };
      viewer["cost"] = 1e4;
      viewer.onMove();
      while (canvas?.width !== 80) await new Promise(requestAnimationFrame);
    });
    await isWhole();
    await page.close();
  });

  test("a slider shows the camera's photograph", async () => {
    const { page } = await opened();
    await page.waitForSelector("#wipe");
    await page.fill("#wipe", "0.5");
    const style = await page.evaluate(() => document.getElementById("photograph")?.style.clipPath);
    expect(style).toBe("inset(0px 50% 0px 0px)");
    await page.mouse.move(200, 200);
    await page.mouse.wheel(0, -300);
    await page.waitForSelector("#photo", { state: "hidden" });
    await page.close();
  });

  test("a hint vanishes with the first motion, and a drag leaves no frame", async () => {
    const { page } = await opened();
    expect(await page.isVisible("#hint")).toBe(true);
    await page.keyboard.press("Tab");
    await page.mouse.move(200, 200);
    await page.mouse.down();
    await page.mouse.move(240, 200);
    await page.mouse.up();
    await page.keyboard.press("a");
    expect(await page.isVisible("#hint")).toBe(false);
    expect(
      await page.evaluate(() => getComputedStyle(document.querySelector("#view") ?? document.body).outlineStyle),
    ).toBe("none");
    await page.close();
  });

  test("textures on and off, side by side", async () => {
    const { page } = await opened();
    await page.check("#divide");
    await page.fill("#divider", "0.25");
    expect(await page.evaluate(() => window.a2tg?.viewer.divided)).toBe(0.25);
    await page.uncheck("#divide");
    expect(await page.evaluate(() => window.a2tg?.viewer.divided)).toBeNull();
    await page.close();
  });

  test("kept views are saved as a path", async () => {
    const { page } = await opened();
    expect(await page.isDisabled("#save")).toBe(true);
    await page.click("#keep");
    await page.click("#keep");
    const [download] = await Promise.all([page.waitForEvent("download"), page.click("#save")]);
    const path = JSON.parse(readFileSync(await download.path(), "utf8")) as {
      format: string;
      version: number;
      views: { viewmat: number[]; K: number[]; size: number[] }[];
    };
    expect([path.format, path.version, path.views.length]).toEqual(["a2tg-jax path", 1, 2]);
    const { viewmat, K, size } = at(path.views, 0);
    const camera = await page.evaluate(() => window.a2tg?.viewer.splats?.header.cameras[0]);
    expectClose(viewmat, camera?.viewmat ?? [], 5);
    expect([K, size]).toEqual([camera?.K, camera?.size]);
    await page.close();
  });

  test("a page without a training asks for its own files alone", async () => {
    const page = await browser.newPage(DESK);
    const asked: string[] = [];
    page.on("request", (request) => asked.push(request.url().replace(served.address, "/")));
    await page.goto(served.address);
    await page.evaluate(() => window.a2tg?.loaded);
    await page.waitForLoadState("networkidle");
    expect(asked.filter((url) => url.startsWith("/")).sort()).toEqual([
      "/",
      "/photographs.json",
      "/photographs/0.jpg",
      "/scene.a2tgz",
    ]);
    await page.close();
  });

  test("a training is followed, paused and resumed", async () => {
    const status = {
      version: 0,
      stage: "textures",
      iteration: 20,
      iterations: 100,
      loss: 0.1,
      psnr: 20,
      num: 300,
      bytes: 9e4,
      is_paused: false,
    };
    let scene = PLAIN;
    const tell = (is_paused: boolean): string => JSON.stringify(Object.assign(status, { is_paused }));
    const other = await serve({
      "/": PAGE.replace("<html ", '<html data-training="yes" '),
      "/scene.a2tgz": () => scene,
      "/training.json": () => tell(status.is_paused),
      "/pause": () => tell(true),
      "/resume": () => tell(false),
    });
    const page = await browser.newPage(DESK);
    await page.goto(other.address);
    await page.waitForSelector("#training:not([hidden])");
    expect(await page.textContent("#state")).toContain("20 of 100");
    expect(await page.evaluate(() => window.a2tg?.viewer.splats)).toBeNull();
    const shown = (num: number): Promise<unknown> =>
      page.waitForFunction((wanted) => window.a2tg?.viewer.splats?.numDrawn === wanted, num);
    status.version = 1;
    await shown(40);
    const textures = page.locator('#mode option[value="texture"]');
    expect(await textures.isDisabled()).toBe(true);
    await page.keyboard.press("3");
    expect(await page.inputValue("#mode")).toBe("full");
    // A snapshot that does not arrive whole is no end.
    scene = SCENE.subarray(0, SCENE.length - 100);
    status.version = 2;
    await page.waitForSelector("#message:not([hidden])");
    expect(await page.textContent("#message")).toContain("cut off");
    await shown(40);
    scene = SCENE;
    status.version = 3;
    await shown(300);
    await page.waitForSelector("#message", { state: "hidden" });
    expect(await textures.isDisabled()).toBe(false);
    const before = await page.evaluateHandle(() => window.a2tg?.viewer.splats);
    status.version = 4;
    await page.waitForFunction((old) => window.a2tg?.viewer.splats !== old, before);
    await shown(300);
    await page.click("#pause");
    await page.waitForFunction(() => document.getElementById("pause")?.textContent === "Resume");
    expect(status.is_paused).toBe(true);
    await page.evaluate(() =>
      window.a2tg?.viewer.canvas.getContext("webgl2")?.getExtension("WEBGL_lose_context")?.loseContext(),
    );
    status.version = 5;
    await page.waitForTimeout(2500);
    expect(await page.textContent("#message")).toContain("connection to the GPU was lost");
    await page.click("#pause");
    await page.waitForFunction(() => document.getElementById("pause")?.textContent === "Pause");
    other.close();
    await page.waitForFunction(() => document.getElementById("state")?.textContent.includes("has ended"));
    await page.close();
  });

  test("the panel fits on a phone's screen", async () => {
    const { page } = await opened("", { viewport: { width: 390, height: 844 } });
    expect(await page.evaluate(() => document.documentElement.scrollWidth)).toBe(390);
    const closed = await page.locator("#panel").boundingBox();
    expect(closed?.height).toBeLessThan(60);
    await page.click("#panel > summary");
    const open = await page.locator("#panel").boundingBox();
    expect(open?.height).toBeLessThan(0.5 * 844);
    for (const id of ["mode", "camera", "start", "keep"]) {
      const box = await page.locator(`#${id}`).boundingBox();
      expect((box?.x ?? -1) >= 0 && (box?.x ?? 0) + (box?.width ?? 999) <= 390).toBe(true);
    }
    await page.close();
  });

  test("every control has a name", async () => {
    const { page } = await opened();
    const unnamed = await page.evaluate(() =>
      [...document.querySelectorAll("input, select, button, canvas, progress")]
        .filter((found) => {
          const labels =
            found instanceof HTMLInputElement || found instanceof HTMLSelectElement ? (found.labels?.length ?? 0) : 0;
          return labels === 0 && (found.getAttribute("aria-label") ?? found.textContent) === "";
        })
        .map((found) => found.id),
    );
    expect(unnamed).toEqual([]);
    await page.close();
  });

  async function message(
    files: Record<string, Uint8Array | string>,
    prepare?: (page: Page) => Promise<unknown>,
  ): Promise<string | null> {
    const other = await serve({ "/": PAGE, ...files });
    const page = await browser.newPage(DESK);
    await prepare?.(page);
    await page.goto(other.address);
    const found = await page.locator("#message:not([hidden])").textContent();
    await page.close();
    other.close();
    return found;
  }

  test("damaged scenes give clear errors", async () => {
    expect(await message({ "/scene.a2tgz": SCENE.subarray(0, SCENE.length - 100) })).toContain("cut off");
    expect(
      await message({ "/scene.a2tgz": SCENE.map((byte, i) => (i === SCENE.length - 2000 ? byte ^ 85 : byte)) }),
    ).toContain("damaged");
    expect(await message({ "/scene.a2tgz": "<script>alert(1)</script> and more text" })).toContain("not a scene");
    expect(await message({})).toContain("no scene.a2tgz");
  });

  test("a browser without WebGL 2 gives a clear error", async () => {
    const found = await message({ "/scene.a2tgz": SCENE }, (page) =>
      page.addInitScript(() => {
        HTMLCanvasElement.prototype.getContext = () => null;
      }),
    );
    expect(found).toContain("no WebGL 2");
  });

  test("a single file opens from disk and the bare page explains why it cannot", async () => {
    const folder = mkdtempSync(join(tmpdir(), "a2tg-"));
    const data = `<script type="text/plain" id="scene-data">${Buffer.from(SCENE).toString("base64")}</script>`;
    const path = join(folder, "one.html");
    writeFileSync(
      path,
      PAGE.replace('<script type="module">', () => `${data}\n<script type="module">`),
    );
    const page = await browser.newPage(DESK);
    await page.goto(pathToFileURL(path).href);
    await page.evaluate(() => window.a2tg?.loaded);
    expect(await page.evaluate(() => window.a2tg?.viewer.splats?.num)).toBe(300);
    writeFileSync(path, PAGE);
    await page.goto(pathToFileURL(path).href);
    expect(await page.locator("#message:not([hidden])").textContent()).toContain("--web OUT.html");
    await page.close();
    rmSync(folder, { recursive: true });
  });
});
